"""Joint adjustment of stations and of rigid devices seen at many moments.

As :mod:`locatk.core.lighthouse.scene.bundle_adjustment`, with devices of known shape in place of points: they
bring the scale with them. The poses and rates of the moments are eliminated one by one (Schur
complement). The first station holds the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    PHASE_TILT_SIGMA_RAD,
    predict_with_gradient,
)
from locatk.core.lighthouse.devices.pose_fit import (
    SPEED_SIGMA,
    UNSEEN,
    DeviceStates,
    Stations,
    SweepObservations,
    photodiode_positions,
)
from locatk.core.lighthouse.scene.bundle_adjustment import (
    STATION_UNKNOWNS,
    calibration_parameters,
    with_parameters,
)
from locatk.core.robust import descend

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigidAdjustment:
    """Result of :func:`adjust_rigid`.

    Attributes
    ----------
    stations : Stations
    poses : DeviceStates
    residual : (m, n) ndarray
        Predicted minus observed angle in radians; ``nan`` where unseen.
    covariance : (s, 6, 6) ndarray
        Of position and rotation of each station in the first station's frame, of which
        that itself has none.
    iterations : int
    """

    stations: Stations
    poses: DeviceStates
    residual: Array
    covariance: Array
    iterations: int


@dataclass(frozen=True)
class _System:
    stations: Array  # (s * 10, s * 10)
    stations_rhs: Array  # (s * 10,)
    poses: Array  # (m, 12, 12)
    poses_rhs: Array  # (m, 12)
    mixed: Array  # (m, s * 10, 12)
    residual: Array  # (m, n) radians
    cost: float


def adjust_rigid(
    looks: SweepObservations,
    stations: Stations,
    poses: DeviceStates,
    *,
    sigma: float,
    soft: float,
    share: Array,
    calibrate: NDArray[np.bool_],
    iterations: int = 40,
) -> RigidAdjustment:
    """Stations and poses that explain the angles best.

    Parameters
    ----------
    looks : SweepObservations
    stations, poses
        Starting values; the first station stays where it is.
    sigma : float
        Standard deviation of an angle in radians.
    soft : float
        Residual in radians from which on a sweep counts less (Cauchy's loss).
    share : (m,) ndarray
        Weight of each moment, 0 to 1: moments at one place repeat each other's errors.
    calibrate : (s,) bool ndarray
        Stations of which tilts and phases are estimated, about the mean of other units.
    iterations : int
    """

    def attempt(
        state: tuple[Stations, DeviceStates], system: _System, damping: float, _: int
    ) -> tuple[tuple[Stations, DeviceStates], _System]:
        trial = _step(system, *state, damping, calibrate)
        return trial, _linearise(looks, *trial, sigma, soft, share, calibrate)

    begin = _linearise(looks, stations, poses, sigma, soft, share, calibrate)
    (stations, poses), system, steps = descend(
        (stations, poses), begin, attempt, damping=1e-4, iterations=iterations
    )
    free = _free(calibrate)
    reduced = _reduce(system, 0.0)[0][np.ix_(free, free)]
    full = np.zeros((len(free), len(free)))
    full[np.ix_(free, free)] = np.linalg.pinv(reduced, hermitian=True)
    blocks = full.reshape(len(calibrate), STATION_UNKNOWNS, len(calibrate), STATION_UNKNOWNS)
    covariance = np.stack([blocks[i, :6, i, :6] for i in range(len(calibrate))])
    return RigidAdjustment(stations, poses, system.residual, covariance, steps)


def _free(calibrate: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(s * 10,) unknowns that are estimated."""
    free = np.ones((len(calibrate), STATION_UNKNOWNS), bool)
    free[0, :6] = False
    # The first phase is zero in every unit.
    free[:, 6:] = calibrate[:, None] & np.array([True, True, False, True])
    return free.ravel()


def _linearise(
    looks: SweepObservations,
    stations: Stations,
    poses: DeviceStates,
    sigma: float,
    soft: float,
    share: Array,
    calibrate: NDArray[np.bool_],
) -> _System:
    m, s = len(looks), len(stations[2])
    lever, place = photodiode_positions(looks, poses)
    missed = np.full(looks.angle.shape, np.nan)
    by_place = np.zeros((*looks.angle.shape, 3))
    own = np.zeros((*looks.angle.shape, STATION_UNKNOWNS))
    for i, calibration in enumerate(stations[2]):
        seen = looks.seen & (looks.station == i)
        offset = place[seen] - stations[0][i]
        angles, gradient, by_tilt = predict_with_gradient(offset @ stations[1][i], calibration)
        rows, plane = np.arange(len(offset)), looks.plane[seen]
        missed[seen] = angles[rows, plane] - looks.angle[seen]
        by_place[seen] = gradient[rows, plane] @ stations[1][i].T
        jacobian = np.zeros((len(offset), STATION_UNKNOWNS))
        jacobian[:, 0:3] = -by_place[seen]
        jacobian[:, 3:6] = np.cross(by_place[seen], offset)
        jacobian[rows, 6 + plane] = by_tilt[rows, plane]
        jacobian[rows, 8 + plane] = -1.0
        own[seen] = jacobian
    lost = looks.seen & ~np.isfinite(missed)
    scaled = np.where(lost, UNSEEN, np.nan_to_num(missed) / sigma)
    width = soft / sigma
    ratio = (scaled / width) ** 2
    loss = 0.5 * width**2 * np.sum(np.log1p(ratio), axis=1, where=looks.seen)
    weight = np.where(looks.seen & ~lost, share[:, None] / (1.0 + ratio), 0.0)
    root = np.sqrt(weight)[..., None]
    by_pose = np.concatenate([by_place, np.cross(lever, by_place)], axis=-1)
    by_pose = np.concatenate([by_pose, by_pose * looks.since_s[..., None]], axis=-1)
    by_pose = np.nan_to_num(by_pose) * root / sigma
    own = np.nan_to_num(own) * root / sigma
    pulled = scaled[..., None] * root

    across = np.swapaxes(by_pose, -1, -2)
    blocks, blocks_rhs = across @ by_pose, (across @ pulled)[..., 0]
    blocks[:, range(6, 12), range(6, 12)] += share[:, None] * SPEED_SIGMA**-2
    blocks_rhs[:, 6:] += share[:, None] * poses.rate / SPEED_SIGMA**2
    cost = float(share @ (loss + 0.5 * np.sum((poses.rate / SPEED_SIGMA) ** 2, axis=1)))

    full, rhs = (
        np.zeros((s, STATION_UNKNOWNS, s, STATION_UNKNOWNS)),
        np.zeros((s, STATION_UNKNOWNS)),
    )
    mixed = np.zeros((m, s, STATION_UNKNOWNS, 12))
    spread = np.concatenate([PHASE_TILT_SIGMA_RAD[:, 1], PHASE_TILT_SIGMA_RAD[:, 0]])
    prior = np.where(spread > 0, 1.0 / np.where(spread > 0, spread, 1.0) ** 2, 0.0)
    for i in range(s):
        seen = looks.station == i
        mine = own * seen[..., None]
        flat = mine[seen]
        full[i, :, i, :] = flat.T @ flat
        rhs[i] = flat.T @ pulled[seen][:, 0]
        mixed[:, i] = np.swapaxes(mine, -1, -2) @ by_pose
        if calibrate[i]:
            away = calibration_parameters(stations[2][i]) - calibration_parameters(
                GENERIC_CALIBRATION
            )
            full[i, range(6, 10), i, range(6, 10)] += prior
            rhs[i, 6:] += prior * away
            cost += 0.5 * float(prior @ away**2)
    size = s * STATION_UNKNOWNS
    return _System(
        full.reshape(size, size),
        rhs.ravel(),
        blocks,
        blocks_rhs,
        mixed.reshape(m, size, 12),
        np.where(looks.seen, missed, np.nan),
        cost,
    )


def _reduce(system: _System, damping: float) -> tuple[Array, Array, Array]:
    """Reduced matrix and right side of the stations, and the inverses of the poses' blocks."""
    blocks = system.poses.copy()
    diagonal = np.einsum("mii->mi", blocks)
    diagonal *= 1.0 + damping
    diagonal += 1e-12 * np.max(diagonal, axis=1, keepdims=True) + 1e-12
    inverses = np.linalg.inv(blocks).astype(np.float64, copy=False)
    full = system.stations.copy()
    full[np.diag_indices(len(full))] *= 1.0 + damping
    eliminated = system.mixed @ inverses
    full -= np.einsum("mac,mbc->ab", eliminated, system.mixed)
    rhs = system.stations_rhs - np.asarray(np.einsum("mac,mc->a", eliminated, system.poses_rhs))
    return full, rhs, inverses


def _step(
    system: _System,
    stations: Stations,
    poses: DeviceStates,
    damping: float,
    calibrate: NDArray[np.bool_],
) -> tuple[Stations, DeviceStates]:
    free = _free(calibrate)
    reduced, rhs, inverses = _reduce(system, damping)
    delta = np.zeros(len(free))
    delta[free] = -np.linalg.lstsq(reduced[np.ix_(free, free)], rhs[free], rcond=1e-14)[0]
    back = system.poses_rhs + np.einsum("mac,a->mc", system.mixed, delta)
    change = delta.reshape(-1, STATION_UNKNOWNS)
    moved = (
        stations[0] + change[:, 0:3],
        rotation_exp(change[:, 3:6]) @ stations[1],
        tuple(with_parameters(c, d) for c, d in zip(stations[2], change[:, 6:], strict=True)),
    )
    return moved, poses.stepped(-(inverses @ back[..., None])[..., 0])
