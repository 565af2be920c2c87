"""Knots of paths and the sweeps between them, from rough trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import (
    matrix_from_quaternion,
    quaternion_angle,
    quaternion_inverse,
    quaternion_multiply,
    slerp,
)
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps
from locatk.core.lighthouse.motion.equations import PathSweeps
from locatk.core.lighthouse.motion.path import Path
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_PAUSE_S = 1.0
"""Longest time between neighbouring knots over which a path continues."""

MAX_GAP_S = 0.3
"""Longest gap without sweeps that is filled with knots."""

MAX_START_GAP_S = 0.25
"""Longest time from a sweep to the nearest pose of the rough trajectory."""

MAX_JUMP_RAD = 0.6
"""Largest turn between neighbouring rough poses: 30 rad/s at 50 poses a second."""

MAX_TURN_RATE_RAD_S = 1.0
"""Added to :data:`MAX_JUMP_RAD` for each second of a gap between rough poses."""

JUMP_COST_S = 1.5
"""Time of the poses that are given up rather than keep a jump of the orientation. A wrong
orientation between two jumps is left out if it lasts less than twice as long."""

MAX_CHAIN_PARTS = 200
"""Number of earlier parts that are tried as the predecessor of a part."""


@dataclass(frozen=True)
class PathLayout:
    """Knots of the devices of a recording, and the sweeps between them.

    Attributes
    ----------
    path : Path
        With the rough poses.
    device : (k,) int ndarray
        Device of each knot.
    time_ns : (k,) int64 ndarray
        Of the knots.
    sweeps : PathSweeps
    sweep : (p,) int ndarray
        Their rows among the given sweeps, all devices one after the other.
    """

    path: Path
    device: IntArray
    time_ns: IntArray
    sweeps: PathSweeps
    sweep: IntArray


def lay_out(
    sweeps: Sequence[DeviceSweeps],
    first_photodiode: Sequence[int],
    start: Sequence[Trajectory],
    knot_ns: int,
    *,
    is_rigid: bool,
) -> PathLayout | None:
    """Place knots at multiples of ``knot_ns`` around each sweep near a rough pose, and in gaps."""
    times_ns, devices, knots, rows, poses = [], [], [], [], []
    count = offset = 0
    for number, (own, rough) in enumerate(zip(sweeps, start, strict=True)):
        trajectory = interpolate_flips(rough) if is_rigid else rough
        near = _near(own.time_ns, rough.time_ns)
        if len(near):
            cell, of_sweep = np.unique(own.time_ns[near] // knot_ns, return_inverse=True)
            cells = np.unique(np.concatenate([cell, cell + 1]))
            edge = _fill_gaps(cells, round(MAX_GAP_S * 1e9) // knot_ns)
            time_ns = edge * knot_ns
            times_ns.append(time_ns)
            devices.append(np.full(len(edge), number))
            knots.append(count + np.searchsorted(edge, cell)[of_sweep.ravel()])
            rows.append(offset + near)
            poses.append(_interpolate(trajectory, time_ns))
            count += len(edge)
        offset += len(own)
    if not count:
        return None
    time_ns, device = np.concatenate(times_ns), np.concatenate(devices)
    sweep, knot = np.concatenate(rows), np.concatenate(knots)
    start_ns = int(time_ns.min())
    time_s = np.asarray((time_ns - start_ns) * 1e-9, np.float64)
    position = np.concatenate([p for p, _ in poses])
    quaternion = np.concatenate([q for _, q in poses])
    is_linked = (np.diff(device) == 0) & (np.abs(np.diff(time_s)) < MAX_PAUSE_S)
    path = Path(
        time_s,
        is_linked,
        position,
        np.zeros_like(position),
        matrix_from_quaternion(quaternion) if is_rigid else None,
        np.zeros_like(position) if is_rigid else None,
    )
    all_ns, station, plane, sensor, angle = (
        np.concatenate([getattr(s, name) for s in sweeps])[sweep]
        for name in ("time_ns", "station", "plane", "sensor", "angle")
    )
    photodiode = sensor + np.array(first_photodiode)[device[knot]]
    weights = path.hermite_weights(knot, (all_ns - start_ns) * 1e-9)
    return PathLayout(
        path,
        device,
        time_ns,
        PathSweeps(knot, weights, station, plane, photodiode, angle),
        sweep,
    )


def _fill_gaps(edge: IntArray, max_count: int) -> IntArray:
    """Return ascending numbers of knots with those in gaps of up to ``max_count``."""
    gap = np.diff(edge)
    steps = np.where(gap <= max_count, gap, 1)
    start = np.repeat(edge[:-1], steps)
    step = np.arange(len(start)) - np.repeat(np.cumsum(steps) - steps, steps)
    return np.append(start + step, edge[-1])


def without_flips(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without short parts in which a device has a wrong orientation.

    A coplanar device has two poses that explain its angles almost equally. Of the parts between
    jumps of the orientation, those are kept that follow from each other and have the most poses; a
    jump that remains costs as many poses as :data:`JUMP_COST_S` has.
    """
    if len(trajectory) < 2:
        return trajectory
    quaternion, time_s = trajectory.quaternion, 1e-9 * (trajectory.time_ns - trajectory.time_ns[0])
    edge = np.flatnonzero(_turn(quaternion[:-1], quaternion[1:]) > MAX_JUMP_RAD) + 1
    start, stop = np.r_[0, edge], np.r_[edge, len(trajectory)]
    jump_cost = JUMP_COST_S / float(np.median(np.diff(time_s)))
    # The largest number of poses in a chain that ends with each part, and the part before it.
    poses, previous = (stop - start).astype(float), np.full(len(start), -1)
    for part in range(1, len(start)):
        before = np.arange(max(0, part - MAX_CHAIN_PARTS), part)
        end, begin = stop[before] - 1, start[part]
        turn = _turn(quaternion[end], quaternion[begin][None])
        limit = MAX_JUMP_RAD + MAX_TURN_RATE_RAD_S * (time_s[begin] - time_s[end])
        chain = poses[before] - np.where(turn < limit, 0.0, jump_cost)
        best = int(np.argmax(chain))
        if chain[best] > 0.0:
            poses[part] += chain[best]
            previous[part] = before[best]
    kept = np.zeros(len(trajectory), bool)
    part = int(np.argmax(poses))
    while part >= 0:
        kept[start[part] : stop[part]] = True
        part = int(previous[part])
    return trajectory.select(kept)


def interpolate_flips(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory with interpolated poses where a device has a wrong orientation."""
    if not len(trajectory):
        return trajectory
    position, quaternion = _interpolate(without_flips(trajectory), trajectory.time_ns)
    return replace(trajectory, position=position, quaternion=quaternion)


def _turn(first: Array, second: Array) -> Array:
    """Return the angles (n,) between orientations (n, 4) in radians."""
    return quaternion_angle(quaternion_multiply(quaternion_inverse(first), second))


def _near(time_ns: IntArray, pose_ns: IntArray) -> IntArray:
    """Return the sweeps that are near a pose of the rough trajectory."""
    if not len(pose_ns):
        return np.zeros(0, np.int64)
    after = np.clip(np.searchsorted(pose_ns, time_ns), 0, len(pose_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap_ns = np.minimum(np.abs(pose_ns[after] - time_ns), np.abs(time_ns - pose_ns[before]))
    return np.flatnonzero(gap_ns <= MAX_START_GAP_S * 1e9)


def _interpolate(trajectory: Trajectory, time_ns: IntArray) -> tuple[Array, Array]:
    """Return positions and quaternions at times; beyond the ends, those of the ends."""
    pose_s = (trajectory.time_ns - trajectory.time_ns[0]) * 1e-9
    time_s = np.clip((time_ns - trajectory.time_ns[0]) * 1e-9, 0.0, pose_s[-1])
    after = np.clip(np.searchsorted(pose_s, time_s), 1, max(len(pose_s) - 1, 1))
    after = np.minimum(after, len(pose_s) - 1)
    before = np.maximum(after - 1, 0)
    span_s = np.maximum(pose_s[after] - pose_s[before], 1e-9)
    fraction = np.clip((time_s - pose_s[before]) / span_s, 0.0, 1.0)
    position = trajectory.position[before] + fraction[:, None] * (
        trajectory.position[after] - trajectory.position[before]
    )
    return position, slerp(trajectory.quaternion[before], trajectory.quaternion[after], fraction)
