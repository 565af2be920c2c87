"""DeviceStates of a rigid device over time in a known scene, and why some moments have none.

Moments are located roughly (:mod:`locatk.core.lighthouse.devices.propagation`) and then fitted again
with the noise that the recording itself shows.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_matrix
from locatk.core.lighthouse.channels import TICK_HZ, period_ticks
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps, make_windows
from locatk.core.lighthouse.devices.pnp import LOSS_SCALE_RAD
from locatk.core.lighthouse.devices.pose_fit import DeviceStates, PoseFit, Stations, fit_poses
from locatk.core.lighthouse.devices.propagation import (
    BLOCK,
    FAILED,
    LOST,
    SOLVED,
    DeviceTrack,
    from_behind,
    has_enough_sweeps,
    locate_all,
)
from locatk.core.lighthouse.noise import (
    ANGLE_SIGMA_RAD,
    CALIBRATION_SIGMA_RAD,
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

LOOSEST = np.repeat([1.0, 0.5], 3)
"""Standard deviations (m, rad) from which on a pose is none."""

SURE = 10.0
"""Half sum of squares, in sigmas, by which a reading must be worse to be ruled out."""

REPEATS = 2.0
"""How often a moment holds the same plane at the same photodiode: once a rotation."""

AGAIN_NS = 30_000_000
"""The next rotation comes within this time."""


@dataclass(frozen=True)
class TrackedDevice:
    """A device's poses.

    Attributes
    ----------
    trajectory : Trajectory
    residual : (n,) ndarray
        Of each sweep in radians, at the moment next to it; ``nan`` where it was in none.
    used : (n,) bool ndarray
        Sweeps that a pose stands on.
    sigma, lasting_sigma : float
        Standard deviation of an angle in radians, in all and of its lasting part.
    rejected : dict of str to int
    rate : (m, 6) ndarray
        Velocity in m/s and turning rate in rad/s of each pose, in the frame's axes.
    from_behind : float
        Share of the sweeps that came from behind their photodiodes.
    ambiguous : int
        Moments that were reached from an anchor with two readings of much the same cost.
    """

    trajectory: Trajectory
    residual: Array
    used: NDArray[np.bool_]
    sigma: float
    lasting_sigma: float
    rejected: dict[str, int]
    rate: Array
    from_behind: float
    ambiguous: int


def rotation_ns(channels: list[int]) -> tuple[int, int]:
    """Shortest and longest rotation of stations, in nanoseconds."""
    ticks = period_ticks(channels) * 1e9 / TICK_HZ
    return int(np.min(ticks)), int(np.max(ticks))


def track_device(
    name: str,
    frame: str,
    mine: DeviceSweeps,
    receiver: Receiver,
    stations: Stations,
    channels: list[int],
    every_ns: int | None = None,
) -> TrackedDevice:
    """DeviceStates of one device in a known scene.

    Parameters
    ----------
    name, frame : str
        Of the device and of the scene.
    mine : DeviceSweeps
    receiver : Receiver
    stations : Stations
    channels : list of int
        Of the stations.
    every_ns : int, optional
        Time from pose to pose; without it, a rotation of the fastest station.

    Notes
    -----
    A moment has the sweeps of one rotation before and after it, so that poses next to each
    other share half of theirs and are not independent.
    """
    fastest, slowest = rotation_ns(channels)
    around = make_windows(mine, every_ns or fastest, slowest)
    m = len(around)
    track = DeviceTrack(
        mine,
        receiver,
        stations,
        around,
        slowest,
        DeviceStates.at_rest(np.zeros((m, 3)), np.tile(np.eye(3), (m, 1, 1))),
        np.zeros(m, np.int64),
        np.full(m, -1),
    )
    few = ~has_enough_sweeps(mine, around.sweep)
    track.status[few] = FAILED
    track.reject("moment_with_too_few_sweeps", np.count_nonzero(few))
    locate_all(track)
    track.reject("moment_inconsistent", np.count_nonzero((track.status != SOLVED) & ~few))
    return _finish(name, frame, track)


# ---- the end


def _finish(name: str, frame: str, track: DeviceTrack) -> TrackedDevice:
    """PoseFit all solved moments again, with the noise and the gate that the recording shows."""
    solved = np.flatnonzero(track.status == SOLVED)
    rough = _refit(track, solved[::4], ANGLE_SIGMA_RAD, LOSS_SCALE_RAD, iterations=0)
    noise = max(ANGLE_SIGMA_RAD, robust_sigma(rough.residual))
    last = _refit(track, solved, noise, 3 * noise, iterations=10)
    sweep = track.around.sweep[solved]
    residual = _nearest(track, solved, last.residual)
    gate = float(
        np.clip(INLIER_GATE_SIGMAS * robust_sigma(residual), MIN_INLIER_GATE_RAD, INLIER_GATE_RAD)
    )
    with np.errstate(invalid="ignore"):
        used = np.abs(residual) < gate
        few = ~has_enough_sweeps(track.mine, np.where(np.abs(last.residual) < gate, sweep, -1))
    sigma, lasting = _noise(track.mine, residual, used, sweep)

    guessed = any(c.source in ("generic", "estimated") for c in track.stations[2])
    # What a photodiode's plane repeats in a window, it does not average.
    variance = sigma**2 + (REPEATS - 1.0) * lasting**2
    variance += REPEATS * CALIBRATION_SIGMA_RAD**2 if guessed else 0.0
    covariance = np.linalg.inv(last.information)[:, :6, :6] * variance / noise**2
    bent = _unsteady(track.around.time_ns[solved], last.poses.rate, track.reach_ns)
    covariance += bent[:, :, None] * bent[:, None, :]
    loose = np.any(np.sqrt(np.einsum("mii->mi", covariance)) > LOOSEST, axis=1)
    track.reject("moment_with_too_few_sweeps", np.count_nonzero(few))
    track.reject("pose_not_determined", np.count_nonzero(loose & ~few))
    track.reject("sweep_contradicts_pose", np.count_nonzero(np.isfinite(residual) & ~used))
    good = ~(few | loose)
    poses = last.poses.take(good)
    trajectory = Trajectory(
        name,
        frame,
        track.around.time_ns[solved[good]],
        poses.position,
        quaternion_from_matrix(poses.rotation),
        covariance[good],
    )
    unsure = np.array(track.margin) < SURE
    ambiguous = int(np.count_nonzero(unsure[track.source[solved[good]]])) if len(unsure) else 0
    some = solved[good][:: max(1, np.count_nonzero(good) // BLOCK)]
    behind = from_behind(track, some, track.poses.take(some))
    return TrackedDevice(
        trajectory,
        residual,
        used,
        sigma,
        lasting,
        track.rejected,
        poses.rate,
        float(np.mean(behind)) if len(some) else 0.0,
        ambiguous,
    )


def _refit(
    track: DeviceTrack, moments: NDArray[np.int64], sigma: float, soft: float, iterations: int
) -> PoseFit:
    """All moments fitted from where they are; residuals (m, n) as the windows' sweeps."""
    wide = track.around.sweep.shape[1]
    parts = []
    for k in range(0, max(len(moments), 1), BLOCK):
        rows = moments[k : k + BLOCK]
        looks, start = track.looks(rows), track.poses.take(rows)
        found = fit_poses(
            looks,
            track.stations,
            start,
            sigma=sigma,
            soft=soft,
            iterations=iterations,
            settled=1e-3,
            lost=LOST,
        )
        residual = np.full((len(rows), wide), np.nan)
        residual[:, : looks.angle.shape[1]] = found.residual
        parts.append(replace(found, residual=residual))
    poses = DeviceStates(
        *(np.concatenate([getattr(p.poses, f.name) for p in parts]) for f in fields(DeviceStates))
    )
    residual, information, cost = (
        np.concatenate([getattr(p, name) for p in parts])
        for name in ("residual", "information", "cost")
    )
    return PoseFit(poses, residual, information, cost)


def _nearest(track: DeviceTrack, moments: NDArray[np.int64], residual: Array) -> Array:
    """(n,) residual of each sweep at the moment next to it; ``nan`` where it was in none."""
    seen = np.isfinite(residual)
    sweep = track.around.sweep[moments][seen]
    time = np.repeat(track.around.time_ns[moments], np.count_nonzero(seen, axis=1))
    away = np.abs(track.mine.time_ns[sweep] - time)
    # Of several values for one place the last stays.
    order = np.argsort(-away, kind="stable")
    nearest = np.full(len(track.mine), np.nan)
    nearest[sweep[order]] = residual[seen][order]
    return nearest


def _unsteady(time_ns: NDArray[np.int64], rate: Array, reach_ns: int) -> Array:
    """(m, 6) by how much acceleration moves and turns what is taken as steady in a window.

    Half the acceleration times the mean square of time in it; the acceleration from the
    rates of the moments before and after, where they are near.
    """
    bent = np.zeros((len(time_ns), 6))
    if len(time_ns) < 3:
        return bent
    span = (time_ns[2:] - time_ns[:-2]) * 1e-9
    near = span < 6e-9 * reach_ns
    change = (rate[2:] - rate[:-2]) / span[:, None]
    bent[1:-1][near] = 0.5 * change[near] * (reach_ns * 1e-9) ** 2 / 3
    return bent


def _noise(
    mine: DeviceSweeps, residual: Array, used: NDArray[np.bool_], sweep: NDArray[np.int64]
) -> tuple[float, float]:
    """Standard deviation of an angle in radians, in all and of what lasts.

    What a photodiode shows of one plane again and again (its place, its cover, a guessed
    calibration) does not average out over rotations; the differences of one rotation from
    the last tell the rest of the noise.
    """
    each = np.count_nonzero(sweep >= 0, axis=1)
    if not len(each) or not np.any(used):
        return ANGLE_SIGMA_RAD, 0.0
    number = float(np.median(each))
    inflated = np.sqrt(number / max(number - 12.0, 0.25 * number))
    total = max(ANGLE_SIGMA_RAD, inflated * robust_sigma(residual[used]))
    kind = np.ravel_multi_index(
        (mine.station, mine.sensor, mine.plane), (16, int(np.max(mine.sensor)) + 1, 2)
    )
    rows = np.flatnonzero(used)
    rows = rows[np.argsort(kind[rows], kind="stable")]
    again = (np.diff(kind[rows]) == 0) & (np.diff(mine.time_ns[rows]) < AGAIN_NS)
    if not np.any(again):
        return total, total
    passing = robust_sigma(np.diff(residual[rows])[again]) / np.sqrt(2)
    return total, float(np.sqrt(max(0.0, total**2 - passing**2)))
