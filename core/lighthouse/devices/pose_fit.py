"""DeviceStates of rigid devices from the angles of their photodiodes, many at once.

Each sweep tells one angle of one photodiode at its own time: a tracker that moves at half a
metre a second moves 10 mm in a rotation, so that a rotation is no instant. The unknowns of a
moment are its pose and, where asked for, how fast the device moves and turns, which is taken
as steady within the moment. Levenberg-Marquardt with a Cauchy loss on the observed angles;
all moments of a batch step together and each stops by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import Calibration, predict_with_gradient

Array = NDArray[np.float64]
Stations = tuple[Array, Array, tuple[Calibration, ...]]
"""Positions (s, 3), rotations (s, 3, 3) station to frame, and calibrations."""

SPEED_SIGMA = np.repeat([2.0, 10.0], 3)
"""Velocities (m/s) and turning rates (rad/s) that a hand or a drone gives a device: what a
rate is held to where the sweeps do not tell it."""

UNSEEN = 1e3
"""Residual, in sigmas, of an angle at which no plane meets the photodiode."""


@dataclass(frozen=True)
class SweepObservations:
    """Sweeps by moment: (m, n) each, padded where ``seen`` is False.

    Attributes
    ----------
    place : (m, n, 3) ndarray
        Of the photodiode in the device's axes, in metres.
    station, plane : (m, n) int ndarray
        Column of the station, and which of its two planes.
    angle : (m, n) ndarray
        Observed rotor angle in radians.
    since_s : (m, n) ndarray
        Time of the sweep since the moment, in seconds.
    seen : (m, n) bool ndarray
    """

    place: Array
    station: NDArray[np.int64]
    plane: NDArray[np.int64]
    angle: Array
    since_s: Array
    seen: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> SweepObservations:
        """The chosen moments."""
        return SweepObservations(*(getattr(self, f.name)[chosen] for f in fields(self)))


@dataclass(frozen=True)
class DeviceStates:
    """Device to frame, with rates.

    Attributes
    ----------
    position : (m, 3) ndarray
    rotation : (m, 3, 3) ndarray
    rate : (m, 6) ndarray
        Velocity in m/s and turning rate in rad/s, in the frame's axes.
    """

    position: Array
    rotation: Array
    rate: Array

    @classmethod
    def at_rest(cls, position: Array, rotation: Array) -> DeviceStates:
        """DeviceStates (m, 3), (m, 3, 3) of devices that stand still."""
        return cls(position, rotation, np.zeros((len(position), 6)))

    def __len__(self) -> int:
        return len(self.position)

    def take(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> DeviceStates:
        """The chosen moments."""
        return DeviceStates(self.position[chosen], self.rotation[chosen], self.rate[chosen])

    def put(self, chosen: NDArray[np.int64] | NDArray[np.bool_], other: DeviceStates) -> None:
        """Overwrite the chosen moments in place."""
        for f in fields(self):
            getattr(self, f.name)[chosen] = getattr(other, f.name)

    def later(self, seconds: Array) -> DeviceStates:
        """Where the devices are after (m,) seconds at their rates."""
        return DeviceStates(
            self.position + self.rate[:, :3] * seconds[:, None],
            rotation_exp(self.rate[:, 3:] * seconds[:, None]) @ self.rotation,
            self.rate.copy(),
        )

    def stepped(self, change: Array) -> DeviceStates:
        """Moved by (m, 12): shift, turn in the frame's axes, changes of both rates."""
        return DeviceStates(
            self.position + change[:, 0:3],
            rotation_exp(change[:, 3:6]) @ self.rotation,
            self.rate + change[:, 6:12],
        )


@dataclass(frozen=True)
class PoseFit:
    """Result of :func:`fit_poses`.

    Attributes
    ----------
    poses : DeviceStates
    residual : (m, n) ndarray
        Predicted minus observed angle in radians; ``nan`` where unseen.
    information : (m, 12, 12) ndarray
        Inverse covariance of pose and rates for angles of the given sigma.
    cost : (m,) ndarray
        Half the robust sum of squares.
    """

    poses: DeviceStates
    residual: Array
    information: Array
    cost: Array


def fit_poses(
    looks: SweepObservations,
    stations: Stations,
    start: DeviceStates,
    *,
    sigma: float,
    soft: float | Array,
    rates: bool = True,
    iterations: int = 30,
    settled: float = 1e-4,
    lost: float = np.inf,
) -> PoseFit:
    """DeviceStates at which the sweeps' angles fit best, from starting values.

    Parameters
    ----------
    looks : SweepObservations
    stations : Stations
    start : DeviceStates
    sigma : float
        Standard deviation of an angle in radians.
    soft : float or (m,) ndarray
        Residual in radians from which on a sweep counts less (Cauchy's loss).
    rates : bool
        False for devices that stand, or moments too short to tell.
    iterations : int
    settled : float
        Gain of a step, in parts of the cost, from which on a moment is done; the step after
        it would gain about the square of that.
    lost : float
        Residual in radians from which on a sweep does not count at all: a hundred of a moved
        station pull, however little each. Starting values must be better than this.

    Returns
    -------
    PoseFit
    """
    poses = DeviceStates(*(np.array(getattr(start, f.name)) for f in fields(DeviceStates)))
    m, n = looks.angle.shape
    residual, information = np.full((m, n), np.nan), np.zeros((m, 12, 12))
    right, cost = np.zeros((m, 12)), np.zeros(m)
    width = np.broadcast_to(np.asarray(soft) / sigma, m)[:, None]

    def evaluate(rows: NDArray[np.int64], trial: DeviceStates) -> tuple[Array, Array, Array, Array]:
        chosen = looks if len(rows) == m else looks.take(rows)
        missed, gradient = linearize(chosen, stations, trial)
        return _normal(
            chosen, trial, missed / sigma, gradient / sigma, width[rows], rates, lost / sigma
        )

    open_ = np.arange(m)
    residual[:], information[:], right[:], cost[:] = evaluate(open_, poses)
    damping = np.full(m, 1e-4)
    for _ in range(iterations):
        if not len(open_):
            break
        matrix = information[open_]
        diagonal = np.einsum("mii->mi", matrix)
        diagonal *= 1.0 + damping[open_, None]
        diagonal += 1e-12 * np.max(diagonal, axis=1, keepdims=True) + 1e-12
        change: Array = -np.linalg.solve(matrix, right[open_, :, None])[..., 0].astype(float)
        # No step may turn a device over: the angles are far from linear in that.
        far = np.linalg.norm(change[:, 3:6], axis=1, keepdims=True)
        change *= np.minimum(1.0, 0.7 / np.maximum(far, 1e-12))
        trial = poses.take(open_).stepped(change)
        found = evaluate(open_, trial)
        better = found[3] < cost[open_]
        gain = (cost[open_] - found[3]) / np.maximum(cost[open_], 1e-12)
        rows = open_[better]
        poses.put(rows, trial.take(better))
        for into, fresh in zip((residual, information, right, cost), found, strict=True):
            into[rows] = fresh[better]
        damping[rows] = np.maximum(damping[rows] / 10, 1e-9)
        damping[open_[~better]] *= 10
        small = np.linalg.norm(change[:, :6], axis=1) < 1e-8
        done = (better & (gain < settled)) | small | (damping[open_] > 1e6)
        open_ = open_[~done]
    missed = np.where(looks.seen, residual * sigma, np.nan)
    return PoseFit(poses, missed, information, cost)


def linearize(
    looks: SweepObservations, stations: Stations, poses: DeviceStates
) -> tuple[Array, Array]:
    """Angles missed (m, n) in radians, and their derivatives (m, n, 6) by shift and turn of
    the device at the time of each sweep; ``nan`` where no plane meets the photodiode.

    The turn at the moment is taken for that at the sweep's time: within a rotation a device
    turns little, and the steps only have to lead downhill.
    """
    lever, place = photodiode_positions(looks, poses)
    missed = np.full(looks.angle.shape, np.nan)
    by_place = np.full((*looks.angle.shape, 3), np.nan)
    for i, calibration in enumerate(stations[2]):
        mine = looks.seen & (looks.station == i)
        if not np.any(mine):
            continue
        rotation = stations[1][i]
        local = (place[mine] - stations[0][i]) @ rotation
        angles, gradient, _ = predict_with_gradient(local, calibration)
        rows, plane = np.arange(len(local)), looks.plane[mine]
        missed[mine] = angles[rows, plane] - looks.angle[mine]
        by_place[mine] = gradient[rows, plane] @ rotation.T
    return missed, np.concatenate([by_place, np.cross(lever, by_place)], axis=-1)


def photodiode_positions(looks: SweepObservations, poses: DeviceStates) -> tuple[Array, Array]:
    """Photodiodes (m, n, 3) about their device and in the frame, at the times of their sweeps."""
    lever = looks.place @ np.swapaxes(poses.rotation, -1, -2)
    since = looks.since_s[..., None]
    if np.any(poses.rate):
        lever = _turned(lever, poses.rate[:, None, 3:] * since)
    return lever, poses.position[:, None] + poses.rate[:, None, :3] * since + lever


def _turned(vectors: Array, turns: Array) -> Array:
    """``vectors`` (..., 3) turned by rotation vectors (Rodrigues, without matrices)."""
    angle = np.sqrt(np.einsum("...i,...i->...", turns, turns))[..., None]
    once = np.cross(turns, vectors)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return vectors + np.sinc(angle / np.pi) * once + versine * np.cross(turns, once)


def _normal(
    looks: SweepObservations,
    poses: DeviceStates,
    missed: Array,
    gradient: Array,
    width: Array,
    rates: bool,
    gate: float,
) -> tuple[Array, Array, Array, Array]:
    """Residuals, normal matrices (m, 12, 12), right sides (m, 12) and costs (m,), in sigmas."""
    lost = looks.seen & ~np.isfinite(missed)
    missed = np.where(lost, UNSEEN, np.nan_to_num(missed))
    lost |= np.abs(missed) > gate
    ratio = (np.minimum(np.abs(missed), gate) / width) ** 2
    weight = np.where(looks.seen & ~lost, 1.0 / (1.0 + ratio), 0.0)
    cost = 0.5 * width[:, 0] ** 2 * np.sum(np.log1p(ratio), axis=1, where=looks.seen)
    root = np.sqrt(weight)[..., None]
    near = np.nan_to_num(gradient) * root
    pulled = missed[..., None] * root
    matrix, right = np.zeros((len(looks), 12, 12)), np.zeros((len(looks), 12))
    if not rates:
        matrix[:, :6, :6] = np.swapaxes(near, -1, -2) @ near
        matrix[:, range(6, 12), range(6, 12)] = 1.0
        right[:, :6] = (np.swapaxes(near, -1, -2) @ pulled)[..., 0]
        return missed, matrix, right, cost
    both = np.concatenate([near, near * looks.since_s[..., None]], axis=-1)
    across = np.swapaxes(both, -1, -2)
    matrix += across @ both
    right += (across @ pulled)[..., 0]
    matrix[:, range(6, 12), range(6, 12)] += SPEED_SIGMA**-2
    right[:, 6:] += poses.rate / SPEED_SIGMA**2
    cost = cost + 0.5 * np.sum((poses.rate / SPEED_SIGMA) ** 2, axis=1)
    return missed, matrix, right, cost
