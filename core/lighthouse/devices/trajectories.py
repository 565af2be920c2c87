"""Trajectories of rigid devices in continuous time, from their rough poses.

Each sweep counts at its own time; stations, light planes and photodiodes are uncertain
(:mod:`locatk.core.lighthouse.motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import rotation_limits_ns
from locatk.core.lighthouse.devices.tracking import TrackedDevice, lasting_noise
from locatk.core.lighthouse.motion.frames import PathFrame
from locatk.core.lighthouse.motion.parameters import make_parameters, scene_size
from locatk.core.lighthouse.motion.recording import PathRecording, Visit
from locatk.core.lighthouse.motion.results import refined_scene
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.reframing import transform_trajectory
from locatk.core.solution import SolverWarning, add_counts

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
    rate_hz: float | None = None,
    imu: Sequence[InertialSamples] = (),
) -> tuple[Scene, tuple[TrackedDevice, ...], list[SolverWarning]]:
    """Estimate trajectories in continuous time, and the stations with them.

    Parameters
    ----------
    tracked : sequence of TrackedDevice
        With rough poses in ``scene``.
    receivers : mapping of str to Receiver
    scene : Scene
    is_estimated : bool
        True if the scene was estimated from the same sweeps. Otherwise it is returned unchanged.
    rate_hz : float, optional
        Poses per second, infinite for a pose at each sweep; by default, one per rotation of the
        fastest station.
    imu : sequence of InertialSamples

    Returns
    -------
    scene : Scene
    tracked : tuple of TrackedDevice
    warnings : list of SolverWarning
        IMUs that contradict the light, and stations that were moved.

    Raises
    ------
    DegenerateError
        See :func:`~locatk.core.lighthouse.motion.solver.estimate_paths`.
    """
    channels = tracked[0].channels
    levers = [receivers[device.trajectory.device].position_m for device in tracked]
    edge = np.cumsum([0, *map(len, levers)]).tolist()
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
    recording = PathRecording(
        [device.sweeps for device in tracked],
        [np.arange(first, end) for first, end in pairwise(edge)],
        [device.trajectory for device in tracked],
        common,
        fastest_ns // 2,
        rate_hz,
        [by_device.get(device.trajectory.device) for device in tracked],
        _visits(scene, [device.trajectory.device for device in tracked]) if is_estimated else (),
    )
    sample = recording.require_sample(channels)
    estimate = sample.estimate
    to_frame, frame = Similarity.identity(), None
    if is_estimated:
        on_marker = recording.marker_knots(estimate)
        has_markers = len(np.unique(on_marker[on_marker >= 0])) >= MIN_FRAME_MARKERS
        is_fixed = on_marker >= 0 if has_markers else np.ones(len(estimate.path), bool)
        frame = PathFrame.of(estimate, is_fixed, with_scale=has_markers)
        # The first station keeps its pose: it defines the frame of a scene without markers.
        positions, rotations, _ = estimate.common.stations
        turn = common.rotations[0] @ rotations[0].T
        to_frame = Similarity(1.0, turn, common.positions[0] - turn @ positions[0])
        refined = refined_scene(scene, channels, estimate, frame.station_covariance(estimate))
        scene = refined.transformed(to_frame)
    result = []
    for number, device in enumerate(tracked):
        path = recording.trace(number, sample, frame)
        rejected = dict(device.rejected)
        rejected["pose_not_determined"] = path.undetermined
        rejected["sweep_contradicts_pose"] = int(
            np.count_nonzero(np.isfinite(path.residual) & ~path.is_used)
        )
        result.append(
            replace(
                device,
                trajectory=transform_trajectory(path.trajectory, to_frame, scene.frame),
                residual=path.residual,
                is_used=path.is_used,
                sigma_rad=estimate.sigma_rad,
                lasting_sigma_rad=lasting_noise(
                    device.sweeps, path.residual, path.is_used, estimate.sigma_rad
                ),
                rejected=add_counts(rejected),
            )
        )
    return scene, tuple(result), recording.warnings(sample, channels)


def _visits(scene: Scene, names: Sequence[str]) -> list[Visit]:
    """Return the visits of markers by devices."""
    return [
        Visit(names.index(visit.device), marker, visit.start_ns, visit.end_ns)
        for marker, own in enumerate(scene.markers)
        for visit in own.visits
        if visit.device in names and visit.start_ns is not None and visit.end_ns is not None
    ]
