"""Trajectories of rigid devices in continuous time, from their rough poses.

Each sweep counts at its own time; stations, light planes and photodiodes are uncertain
(:mod:`locatk.core.lighthouse.motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import rotation_limits_ns
from locatk.core.lighthouse.devices.tracking import TrackedDevice
from locatk.core.lighthouse.motion.frames import fix_frame
from locatk.core.lighthouse.motion.parameters import make_parameters, scene_size
from locatk.core.lighthouse.motion.results import (
    make_trajectory,
    pose_covariances,
    refined_scene,
)
from locatk.core.lighthouse.motion.solver import PathEstimate, estimate_paths
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.reframing import transform_trajectory
from locatk.core.solution import add_counts

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MIN_FRAME_MARKERS = 3
"""Fewest visited markers that define a frame."""


def refine_tracks(
    tracked: Sequence[TrackedDevice],
    receivers: Mapping[str, Receiver],
    scene: Scene,
    *,
    is_estimated: bool,
    interval_ns: int | None = None,
    imu: Sequence[InertialSamples] = (),
) -> tuple[Scene, tuple[TrackedDevice, ...], tuple[str, ...]]:
    """Estimate trajectories in continuous time, and the stations with them.

    Parameters
    ----------
    tracked : sequence of TrackedDevice
        With rough poses in ``scene``.
    receivers : mapping of str to Receiver
    scene : Scene
    is_estimated : bool
        True if the scene was estimated from the same sweeps. Otherwise it is returned unchanged.
    interval_ns : int, optional
        Time from pose to pose; by default, a rotation of the fastest station.
    imu : sequence of InertialSamples

    Returns
    -------
    scene : Scene
    tracked : tuple of TrackedDevice
    contradicting : tuple of str
        Devices whose IMU contradicts the light and was not used.

    Raises
    ------
    DegenerateError
        See :func:`~locatk.core.lighthouse.motion.solver.estimate_paths`.
    """
    channels = tracked[0].channels
    levers = [receivers[device.trajectory.device].position_m for device in tracked]
    first = np.cumsum([0, *map(len, levers)])[:-1].tolist()
    fastest_ns, _ = rotation_limits_ns(channels)
    common = make_parameters(
        scene,
        channels,
        np.nan_to_num(np.concatenate(levers)),
        is_estimated=is_estimated,
        size_m=scene_size(
            np.stack([s.position for s in scene.stations]),
            np.concatenate([device.trajectory.position for device in tracked]),
        ),
    )
    by_device = {samples.device: samples for samples in imu}
    estimate = estimate_paths(
        [device.sweeps for device in tracked],
        first,
        [device.trajectory for device in tracked],
        common,
        fastest_ns // 2,
        [by_device.get(device.trajectory.device) for device in tracked],
    )
    to_frame = Similarity.identity()
    if is_estimated:
        on_marker = _marker_knots(estimate, scene, tracked)
        has_markers = len(np.unique(on_marker[on_marker >= 0])) >= MIN_FRAME_MARKERS
        is_fixed = on_marker >= 0 if has_markers else np.ones(len(estimate.path), bool)
        estimate = fix_frame(estimate, is_fixed, with_scale=has_markers)
        # The first station keeps its pose: it defines the frame of a scene without markers.
        positions, rotations, _ = estimate.common.stations
        turn = common.rotations[0] @ rotations[0].T
        to_frame = Similarity(1.0, turn, common.positions[0] - turn @ positions[0])
        scene = refined_scene(scene, channels, estimate).transformed(to_frame)
    covariance = pose_covariances(estimate)
    refined, begin = [], 0
    for number, device in enumerate(tracked):
        end = begin + len(device.sweeps)
        own = (estimate.sweep >= begin) & (estimate.sweep < end)
        residual, is_used = np.full(end - begin, np.nan), np.zeros(end - begin, bool)
        residual[estimate.sweep[own] - begin] = estimate.residual[own]
        is_used[estimate.sweep[own] - begin] = estimate.is_used[own]
        begin = end
        made = make_trajectory(
            estimate,
            covariance,
            number,
            device.trajectory.device,
            device.trajectory.frame,
            interval_ns or fastest_ns,
        )
        rejected = dict(device.rejected)
        rejected["pose_not_determined"] = made.undetermined
        rejected["sweep_contradicts_pose"] = int(np.count_nonzero(np.isfinite(residual) & ~is_used))
        refined.append(
            replace(
                device,
                trajectory=transform_trajectory(made.trajectory, to_frame, scene.frame),
                residual=residual,
                is_used=is_used,
                sigma_rad=estimate.sigma_rad,
                rejected=add_counts(rejected),
            )
        )
    return scene, tuple(refined), estimate.contradicting_imus


def _marker_knots(
    estimate: PathEstimate, scene: Scene, tracked: Sequence[TrackedDevice]
) -> IntArray:
    """Return the number of the marker on which a device is at each knot, or -1."""
    number = np.full(len(estimate.path), -1)
    names = [device.trajectory.device for device in tracked]
    for k, marker in enumerate(scene.markers):
        for visit in marker.visits:
            if visit.device not in names or visit.start_ns is None or visit.end_ns is None:
                continue
            is_visit = estimate.device == names.index(visit.device)
            is_visit &= (estimate.time_ns >= visit.start_ns) & (estimate.time_ns <= visit.end_ns)
            number[is_visit] = k
    return number
