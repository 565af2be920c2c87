"""Stamped poses with covariance: the common result of all systems."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

MAX_ODOMETRY = 1e9
"""Largest coordinate [m] and angle [rad] of odometry. No vehicle reaches it, and a double resolves
0.1 micrometres there."""

PROVISIONAL_PROBABILITY = 0.999
"""Probability of a pose below which it is provisional: of a thousand poses, one may be wrong."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of one device over time.

    Attributes
    ----------
    device : str
        Name of the device; there is one trajectory per device.
    frame : str
        Name of the frame of the poses, as in ``"floor"``.
    time_ns : (n,) int64 ndarray
        Nanoseconds since the epoch, ascending.
    position : (n, 3) ndarray
        In metres.
    quaternion : (n, 4) ndarray
        Orientation from device to frame as (x, y, z, w), unit length.
    covariance : (n, 6, 6) ndarray
        Of (x, y, z, rotation about x, y, z) in m and rad; ``nan`` in the rows and columns of
        unobserved components (a single photodiode has no heading).
    probability : (n,) ndarray or None
        Posterior probability that the pose is right within its covariance, and not one of
        another position that the readings fit as well; ``nan`` if unknown. None if the system
        does not estimate it.
    """

    device: str
    frame: str
    time_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    covariance: NDArray[np.float64]
    probability: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        shapes = {
            "position": (n, 3),
            "quaternion": (n, 4),
            "covariance": (n, 6, 6),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, not {shape}")
        if self.probability is not None and self.probability.shape != (n,):
            raise ValueError(f"probability has shape {self.probability.shape}, not {(n,)}")

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        span_s = float(self.time_ns[-1] - self.time_ns[0]) * 1e-9 if len(self) else 0.0
        return f"<Trajectory of {self.device!r}: {len(self)} poses, {span_s:.1f} s, {self.frame!r}>"

    @classmethod
    def from_positions(
        cls,
        device: str,
        frame: str,
        time_ns: NDArray[np.int64],
        position: NDArray[np.float64],
        covariance: NDArray[np.float64] | None = None,
    ) -> Trajectory:
        """Create the trajectory of a point: identity orientations with unknown covariance.

        ``position`` is (n, 3) in metres; ``covariance`` is (n, 3, 3) in m^2, or None if it is
        unknown as well.
        """
        n = len(time_ns)
        quaternion = np.zeros((n, 4))
        quaternion[:, 3] = 1.0
        full = np.full((n, 6, 6), np.nan)
        if covariance is not None:
            full[:, :3, :3] = covariance
        return cls(device, frame, np.asarray(time_ns, np.int64), position, quaternion, full)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations (n, 6) in m and rad; ``nan`` for unobserved components."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))

    @property
    def min_probability(self) -> float:
        """Probability of the least probable pose; ``nan`` if none is known."""
        if self.probability is None or np.isnan(self.probability).all():
            return float("nan")
        return float(np.nanmin(self.probability))

    @property
    def is_provisional(self) -> bool:
        """True if a pose is less probable than :data:`PROVISIONAL_PROBABILITY`."""
        return self.min_probability < PROVISIONAL_PROBABILITY

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Trajectory:
        """Return only the poses that a mask (n,) or indices choose, in the order of the indices."""
        time_ns, covariance = self.time_ns[chosen], self.covariance
        if len(covariance) and covariance.strides[0] == 0:
            # One unknown covariance is broadcast to all poses and stays one matrix in memory.
            covariance = np.broadcast_to(covariance[0], (len(time_ns), 6, 6))
        else:
            covariance = covariance[chosen]
        return replace(
            self,
            time_ns=time_ns,
            position=self.position[chosen],
            quaternion=self.quaternion[chosen],
            covariance=covariance,
            probability=None if self.probability is None else self.probability[chosen],
        )

    def shifted(self, shift_ns: int) -> Trajectory:
        """Return the same poses with ``shift_ns`` added to their stamps."""
        return self if shift_ns == 0 else replace(self, time_ns=self.time_ns + shift_ns)


def has_orientation(trajectory: Trajectory, *, trust_identity: bool = False) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses that report an orientation.

    A pose reports none if its position has a covariance and its heading has none (a single
    photodiode). Nor do the poses of a trajectory without any variance of the heading whose
    orientations are all the identity (a point), unless ``trust_identity`` is set.
    """
    has_heading_variance = np.isfinite(trajectory.covariance[:, 5, 5])
    is_point = not has_heading_variance.any() and bool(np.all(trajectory.quaternion[:, :3] == 0.0))
    if is_point and not trust_identity:
        return has_heading_variance
    return has_heading_variance | np.isnan(trajectory.covariance[:, 0, 0])
