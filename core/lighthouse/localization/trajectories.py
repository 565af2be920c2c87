"""Trajectories of single photodiodes in continuous time, where they move.

A photodiode that reports each sweep at its own time, many times a second, has a path; its sweeps
are treated as those of rigid devices (:mod:`locatk.core.lighthouse.motion`). Reports of a few
sweeps with one time stamp are located one by one
(:mod:`locatk.core.lighthouse.localization.photodiodes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.devices.alignment import align_points
from locatk.core.lighthouse.devices.device_sweeps import (
    DeviceSweeps,
    rotation_limits_ns,
    select_device_sweeps,
)
from locatk.core.lighthouse.localization.positions import estimate_positions
from locatk.core.lighthouse.motion.frames import PathFrame
from locatk.core.lighthouse.motion.parameters import make_parameters, scene_size
from locatk.core.lighthouse.motion.recording import PathRecording
from locatk.core.lighthouse.motion.results import refined_scene
from locatk.core.lighthouse.motion.solver import PathEstimate
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.reframing import transform_trajectory
from locatk.core.solution import SolverWarning, add_counts
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_POSE_INTERVAL_S = 0.05
"""Longest usual time between rough positions on a path: over longer times, a robot may turn."""

MIN_OWN_TIMES = 0.7
"""Smallest fraction of sweeps of a photodiode whose time differs from that of the sweep before."""

MIN_PATH_POSES = 20
"""Fewest rough positions of a path."""


@dataclass(frozen=True)
class PhotodiodePaths:
    """Trajectories in continuous time.

    Attributes
    ----------
    scene : Scene
        With refined stations if it was estimated from the same sweeps.
    trajectories : tuple of Trajectory
    rejected : dict of str to int
    sigma_rad : float
        Standard deviation of an angle.
    warnings : list of SolverWarning
    """

    scene: Scene
    trajectories: tuple[Trajectory, ...]
    rejected: dict[str, int]
    sigma_rad: float
    warnings: list[SolverWarning]


def refine_photodiodes(
    sweeps: Sweeps,
    channels: Sequence[int],
    rough: Sequence[Trajectory],
    scene: Scene,
    markers: tuple[Array, Array],
    *,
    is_estimated: bool,
    rate_hz: float | None = None,
) -> PhotodiodePaths | None:
    """Estimate the paths of moving photodiodes, and the stations with them.

    Parameters
    ----------
    sweeps : Sweeps
    channels : sequence of int
        Stations of the scene that were received.
    rough : sequence of Trajectory
        Of all photodiodes.
    scene : Scene
    markers : ((k, 3) ndarray, (k, s, 2) ndarray)
        Positions and angles of visits of markers
        (:func:`~locatk.core.lighthouse.scene.frame.marker_angles`). They define the frame if it is
        that of markers.
    is_estimated : bool
        True if the scene was estimated from the same sweeps. Otherwise it is returned unchanged.
    rate_hz : float, optional
        Poses per second, infinite for a pose at each sweep; by default, one per rotation of the
        fastest station.

    Returns
    -------
    PhotodiodePaths or None
        None if a photodiode does not move on a path.

    Raises
    ------
    DegenerateError
        See :func:`~locatk.core.lighthouse.motion.solver.estimate_paths`.
    """
    if len(channels) < 2:
        return None
    parts = [_select_photodiode(sweeps, t.device, channels) for t in rough]
    if not all(_is_path(own, t) for own, t in zip(parts, rough, strict=True)):
        return None
    common = make_parameters(
        scene,
        channels,
        np.zeros((0, 3)),
        is_estimated=is_estimated,
        size_m=scene_size(
            np.stack([s.position for s in scene.stations]),
            np.concatenate([t.position for t in rough]),
        ),
    )
    fastest_ns, _ = rotation_limits_ns(channels)
    floor_z = scene.floor_z if scene.planar else None
    recording = PathRecording(
        parts,
        [np.zeros(0, np.int64)] * len(parts),
        rough,
        common,
        fastest_ns // 2,
        rate_hz,
        [None] * len(parts),
        floor_z=floor_z,
    )
    sample = recording.require_sample(channels)
    estimate = sample.estimate
    to_frame, alignment, frame = Similarity.identity(), None, None
    if is_estimated:
        frame = PathFrame.of(estimate, np.ones(len(estimate.path), bool), with_scale=True)
        if scene.frame_source == "markers":
            points, angles = markers
            position = estimate_positions(angles, *estimate.common.stations, floor_z=floor_z)
            alignment = align_points(position.position, points)
        to_frame = alignment.transform if alignment else _rough_frame(estimate, rough)
        refined = refined_scene(scene, channels, estimate, frame.station_covariance(estimate))
        scene = refined.transformed(to_frame)
    paths = [recording.trace(k, sample, frame) for k in range(len(rough))]
    rejected = {
        "sweep_contradicts_pose": sum(
            int(np.count_nonzero(np.isfinite(path.residual) & ~path.is_used)) for path in paths
        ),
        "pose_not_determined": sum(path.undetermined for path in paths),
    }
    trajectories = [transform_trajectory(p.trajectory, to_frame, scene.frame) for p in paths]
    if alignment is not None:
        trajectories = [alignment.add_uncertainty(t) for t in trajectories]
    return PhotodiodePaths(
        scene,
        tuple(trajectories),
        add_counts(rejected),
        estimate.sigma_rad,
        recording.warnings(sample, channels),
    )


def _select_photodiode(sweeps: Sweeps, name: str, channels: Sequence[int]) -> DeviceSweeps:
    """Return the sweeps of a photodiode, ``device`` or ``device/sensor``."""
    if name in sweeps.devices:
        device, sensor = name, None
    else:
        device, _, number = name.rpartition("/")
        sensor = int(number)
    count = int(np.max(sweeps.sensor, initial=0)) + 1
    index = sweeps.devices.index(device)
    selected, _ = select_device_sweeps(sweeps, index, Receiver(np.zeros((count, 3))), channels)
    if sensor is not None:
        selected = selected.take(selected.sensor == sensor)
    return replace(selected, sensor=np.zeros(len(selected), np.int64))


def _is_path(own: DeviceSweeps, rough: Trajectory) -> bool:
    """Return whether sweeps come at their own times, often enough for a path."""
    if len(rough) < MIN_PATH_POSES:
        return False
    interval_s = float(np.median(np.diff(rough.time_ns))) * 1e-9
    return interval_s < MAX_POSE_INTERVAL_S and bool(
        np.mean(np.diff(own.time_ns) > 0) > MIN_OWN_TIMES
    )


def _rough_frame(estimate: PathEstimate, rough: Sequence[Trajectory]) -> Similarity:
    """Return the transform of paths to the frame of the rough trajectories."""
    source, target = [], []
    for device, trajectory in enumerate(rough):
        knots = np.flatnonzero(estimate.device == device)
        if len(knots):
            knot_ns, own = estimate.time_ns[knots], estimate.path.position[knots]
            next_knot = np.minimum(np.searchsorted(knot_ns, trajectory.time_ns), len(knots) - 1)
            apart_ns = np.abs(knot_ns[next_knot] - trajectory.time_ns)
            is_near = apart_ns < MAX_POSE_INTERVAL_S * 1e9
            time_ns = trajectory.time_ns[is_near]
            source.append(np.stack([np.interp(time_ns, knot_ns, axis) for axis in own.T], axis=1))
            target.append(trajectory.position[is_near])
    a, b = np.concatenate(source), np.concatenate(target)
    distance = np.linalg.norm(umeyama(a, b).apply(a) - b, axis=1)
    is_close = distance <= 3 * np.median(distance)
    return umeyama(a[is_close], b[is_close])
