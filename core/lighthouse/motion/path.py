"""Paths of devices in continuous time under a Gaussian-process prior.

A path has states at knots: pose and rate of change. Between neighbouring knots, white noise drives
the acceleration. The mean of this process between two states is the cubic Hermite polynomial, so
that a pose at any time is linear in the two states beside it (Barfoot, Tong and Sarkka 2014;
Anderson and Barfoot 2015). Rotations are treated alike in the tangent space of the first of the
two knots.

States have ``2 n`` unknowns, ``n`` of the pose and ``n`` of its rate: position in the frame, and
for rigid devices a rotation vector in the device's axes (n = 6, otherwise 3).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.geometry import rotation_exp

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_TURN_RAD = 0.5
"""Largest rotation of a knot in one step of the estimation."""


@dataclass(frozen=True)
class Path:
    """States at knots, of one device after the other.

    Attributes
    ----------
    time_s : (k,) ndarray
        Ascending within a device.
    is_linked : (k - 1,) bool ndarray
        True if a knot and the next one are of one device, with no long pause between them.
    position, velocity : (k, 3) ndarray
        In the frame, in m and m/s.
    rotation : (k, 3, 3) ndarray, optional
        Device to frame; None for single photodiodes.
    spin : (k, 3) ndarray, optional
        Angular velocity in the device's axes in rad/s.
    """

    time_s: Array
    is_linked: Mask
    position: Array
    velocity: Array
    rotation: Array | None = None
    spin: Array | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def span_s(self) -> Array:
        """Times (k - 1,) from each knot to the next; 1 where they are not linked."""
        return np.where(self.is_linked, np.diff(self.time_s), 1.0)

    @property
    def pose_size(self) -> int:
        """Unknowns of a pose: 3 or 6."""
        return 3 if self.rotation is None else 6

    def stepped(self, change: Array) -> Path:
        """Return the path after a change (k, 2 n) of its states."""
        n = self.pose_size
        arrays: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        arrays["position"] = self.position + change[:, :3]
        arrays["velocity"] = self.velocity + change[:, n : n + 3]
        if self.rotation is not None:
            angle = np.linalg.norm(change[:, 3:6], axis=1, keepdims=True)
            turn = change[:, 3:6] * np.minimum(1.0, MAX_TURN_RAD / np.maximum(angle, 1e-12))
            arrays["rotation"] = self.rotation @ rotation_exp(turn)
            arrays["spin"] = arrays["spin"] + change[:, n + 3 :]
        return Path(**arrays)

    def turns(self) -> Array:
        """Return the rotation vectors (k - 1, 3) from each knot to the next."""
        assert self.rotation is not None
        relative = self.rotation[:-1].mT @ self.rotation[1:]
        return np.asarray(Rotation.from_matrix(relative).as_rotvec())

    def hermite_weights(self, knot: IntArray, time_s: Array) -> Array:
        """Return the weights (n, 4) of pose and rate at a knot and at the next one."""
        start_s = self.time_s[knot]
        span_s = self.time_s[knot + 1] - start_s
        u = (time_s - start_s) / span_s
        return np.stack(
            [
                (1 + 2 * u) * (1 - u) ** 2,
                span_s * u * (1 - u) ** 2,
                u**2 * (3 - 2 * u),
                span_s * u**2 * (u - 1),
            ],
            axis=1,
        )

    def poses(self, knot: IntArray, weights: Array) -> tuple[Array, Array | None]:
        """Return positions (n, 3), and rotations (n, 3, 3) if any, between knots.

        ``weights`` are the :meth:`hermite_weights` of the times after ``knot`` (n,).
        """
        after = knot + 1
        w = weights[:, :, None]
        position = w[:, 0] * self.position[knot] + w[:, 1] * self.velocity[knot]
        position += w[:, 2] * self.position[after] + w[:, 3] * self.velocity[after]
        if self.rotation is None or self.spin is None:
            return position, None
        turn = self.turns()
        end_rate = _inverse_right_jacobian(turn, self.spin[1:])
        vector = w[:, 1] * self.spin[knot] + w[:, 2] * turn[knot] + w[:, 3] * end_rate[knot]
        return position, self.rotation[knot] @ rotation_exp(vector)

    def window_sums(self, values: Array, window: int) -> Array:
        """Return sums of values (m, k - 1) of steps over windows of steps around each.

        Windows end where knots are not linked.
        """
        index = np.arange(len(self) - 1)
        segment = np.cumsum(np.r_[0, ~self.is_linked[:-1]])
        low = np.maximum(index - window // 2, np.searchsorted(segment, segment))
        high = np.minimum(index + (window + 1) // 2, np.searchsorted(segment, segment, "right"))
        total = np.concatenate([np.zeros((len(values), 1)), np.cumsum(values, axis=1)], axis=1)
        return np.asarray(np.maximum(total[:, high] - total[:, low], 0.0))

    def prior_errors(self) -> Array:
        """Return how far each state (k - 1, 2, n) is from the one that follows from the last."""
        span_s = self.span_s[:, None]
        parts = [
            np.stack(
                [
                    np.diff(self.position, axis=0) - span_s * self.velocity[:-1],
                    np.diff(self.velocity, axis=0),
                ],
                axis=1,
            )
        ]
        if self.rotation is not None and self.spin is not None:
            turn = self.turns()
            end_rate = _inverse_right_jacobian(turn, self.spin[1:])
            parts.append(
                np.stack([turn - span_s * self.spin[:-1], end_rate - self.spin[:-1]], axis=1)
            )
        return np.concatenate(parts, axis=2)


def _inverse_right_jacobian(turn: Array, rate: Array) -> Array:
    """Return the rate (n, 3) of a rotation vector ``turn``, to the second order in it."""
    cross = np.cross(turn, rate)
    return np.asarray(rate + cross / 2 + np.cross(turn, cross) / 12)


def prior_information(span_s: Array) -> Array:
    """Return the information (k, 4, 4) of steps for a power of one.

    It is that of pose and rate at both ends of spans (k,), for the noise of white acceleration.
    """
    one, zero, t = np.ones_like(span_s), np.zeros_like(span_s), span_s
    error = np.stack(
        [np.stack([-one, -t, one, zero], axis=1), np.stack([zero, -one, zero, one], axis=1)], axis=1
    )
    inverse = np.stack(
        [np.stack([12 / t**3, -6 / t**2], axis=1), np.stack([-6 / t**2, 4 / t], axis=1)], axis=1
    )
    return np.asarray(error.mT @ inverse @ error)


def lever_jacobian(by_position: Array, rotation: Array, lever: Array) -> Array:
    """Return the derivatives (n, 6) by position and rotation of a device.

    ``by_position`` (n, 3) are those by the position of a photodiode at ``lever`` (n, 3) in the
    device's axes.
    """
    in_device = (by_position[:, None] @ rotation)[:, 0]
    return np.concatenate([by_position, np.cross(lever, in_device)], axis=1)
