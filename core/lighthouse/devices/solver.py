"""Solver for rigid devices: scene and trajectories from sweeps of several photodiodes per device.

:func:`solve_devices` runs the pipeline: the scene is estimated from the devices if it has no
stations, the devices are tracked in it, scene and trajectories are aligned with the markers, and
every station is verified against the others. :func:`merge_solutions` adds the single photodiodes,
which are solved by other modules in the scene of the rigid devices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.devices.alignment import (
    align_to_markers,
    alignment_warnings,
)
from locatk.core.lighthouse.devices.device_sweeps import (
    MIN_SENSORS,
    received_channels,
    select_device_sweeps,
)
from locatk.core.lighthouse.devices.scene_initialization import (
    DeviceSceneEstimate,
    estimate_scene_from_devices,
)
from locatk.core.lighthouse.devices.tracking import (
    MAX_FROM_BEHIND_FRACTION,
    TrackedDevice,
    track_devices,
)
from locatk.core.lighthouse.devices.trajectories import refine_tracks
from locatk.core.lighthouse.devices.verification import verify_devices
from locatk.core.lighthouse.motion.recording import MovedStationError
from locatk.core.lighthouse.noise import CALIBRATION_SIGMA_RAD
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import (
    LighthouseFacts,
    SceneVerification,
    StationDetection,
    StationVerification,
)
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.frame import unused_visits_warnings
from locatk.core.lighthouse.scene.reframing import transform_trajectory
from locatk.core.robust import robust_sigma
from locatk.core.solution import Solution, SolverWarning, add_counts
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


def select_rigid_receivers(
    sweeps: Sweeps, receivers: Mapping[str, Receiver]
) -> dict[str, Receiver]:
    """Return the receivers of devices in the recording with enough photodiodes for a full pose."""
    present = {sweeps.devices[k] for k in np.unique(sweeps.device)}
    return {
        name: receiver
        for name, receiver in receivers.items()
        if len(receiver) >= MIN_SENSORS and name in present
    }


def solve_devices(
    sweeps: Sweeps,
    receivers: Mapping[str, Receiver],
    scene: Scene | None = None,
    *,
    rate_hz: float | None = None,
    imu: Sequence[InertialSamples] = (),
) -> Solution:
    """Solve the rigid devices of a recording.

    Parameters
    ----------
    sweeps : Sweeps
        Sweeps of devices without a receiver are ignored.
    receivers : mapping of str to Receiver
        By device; photodiodes at known positions.
    scene : Scene, optional
        With stations: they are used unchanged. Without stations: these are estimated from the
        devices, whose size gives the scale, with the scene's calibrations where it has them. The
        markers on which a device rested then give frame and scale; without them, the frame is that
        of the first station.
    rate_hz : float, optional
        Poses per second, infinite for a pose at each sweep; by default, one per rotation of the
        fastest station.
    imu : sequence of InertialSamples
        Of any of the devices. An IMU that contradicts the light is left out with a warning.

    Returns
    -------
    Solution
        With :class:`~locatk.core.lighthouse.results.LighthouseFacts`, and a
        :class:`~locatk.core.lighthouse.results.StationDetection` per station. Its ``artifact`` is
        the scene with stations. One trajectory per device with a receiver.

    Raises
    ------
    DegenerateError
        No device with a receiver has a sweep, the scene contains none of the stations of the
        recording, or no station determines the pose of a device.
    """
    scene = scene or Scene()
    estimate = DeviceSceneEstimate(scene, LighthouseFacts(), ())
    if not scene.stations:
        estimate = _estimate_scene(sweeps, receivers, scene)
    tracked = track_devices(sweeps, receivers, estimate.scene)
    path_warnings: list[SolverWarning] = []
    try:
        refined, tracked, path_warnings = refine_tracks(
            tracked,
            receivers,
            estimate.scene,
            is_estimated=not scene.stations,
            rate_hz=rate_hz,
            imu=imu,
        )
        estimate = replace(estimate, scene=refined)
    except DegenerateError as error:
        if any(len(device.trajectory) for device in tracked):
            path_warnings.extend(paths_warnings(error))
    trajectories = tuple(device.trajectory for device in tracked)
    detections = station_detections(tracked, estimate.scene)
    facts = _tracking_facts(estimate.facts, tracked, estimate.scene, detections)
    warnings = [
        *estimate.warnings,
        *path_warnings,
        *device_warnings(tracked),
        *contradiction_warnings(detections, trajectories),
    ]

    solved = estimate.scene
    if not scene.stations and scene.markers:
        alignment = align_to_markers(scene.markers, trajectories)
        warnings.extend(alignment_warnings(alignment))
        if alignment is not None:
            transform = alignment.transform
            solved = replace(
                solved.transformed(transform),
                frame=scene.frame,
                scale="markers",
                frame_source="markers",
            )
            trajectories = tuple(
                alignment.add_uncertainty(transform_trajectory(t, transform, scene.frame))
                for t in trajectories
            )
            warnings.extend(unused_visits_warnings(scene.markers, alignment.visits))
            facts = replace(facts, marker_misfit_m=alignment.misfit_m, marker_scale=transform.scale)
    if not scene.stations and solved.scale == "device":
        warnings.extend(_scale_warnings(scene))

    verifications = verify_devices(sweeps, receivers, solved, trajectories)
    if verifications:
        verification = SceneVerification(
            held_out=bool(scene.stations),
            epochs=sum(v.epochs for v in verifications),
            stations=verifications,
        )
        facts = replace(facts, verification=verification)
        detections = _add_verifications(detections, verifications)
    return Solution(
        "lighthouse",
        "bundle",
        trajectories,
        rejected=add_counts(*(device.rejected for device in tracked)),
        detections=detections,
        artifact=solved,
        facts=facts,
        warnings=_distinct(warnings),
    )


def merge_solutions(rigid: Solution, photodiodes: Solution) -> Solution:
    """Merge the solution of rigid devices with that of single photodiodes in the same scene.

    Both have typed detections, facts and warnings. Numbers of sweeps are added by station; the
    facts of the rigid devices become ``LighthouseFacts.rigid``.
    """
    rigid_devices = {trajectory.device for trajectory in rigid.trajectories}
    single = [t for t in photodiodes.trajectories if t.device not in rigid_devices]
    by_channel = {row.channel: row for row in photodiodes.detections}
    for row in rigid.detections:
        if row.channel in by_channel:
            other = by_channel[row.channel]
            row = replace(
                other, sweeps=other.sweeps + row.sweeps, rejected=other.rejected + row.rejected
            )
        by_channel[row.channel] = row
    return replace(
        photodiodes,
        trajectories=(*rigid.trajectories, *single),
        rejected=add_counts(rigid.rejected, photodiodes.rejected),
        detections=tuple(
            replace(by_channel[channel], station=k) for k, channel in enumerate(sorted(by_channel))
        ),
        facts=replace(photodiodes.facts, rigid=rigid.facts),
        warnings=_distinct((*rigid.warnings, *photodiodes.warnings)),
    )


def _estimate_scene(
    sweeps: Sweeps, receivers: Mapping[str, Receiver], scene: Scene
) -> DeviceSceneEstimate:
    """Estimate the stations from the devices."""
    channels = received_channels(sweeps, receivers)
    devices = [
        (select_device_sweeps(sweeps, k, receivers[name], channels)[0], receivers[name])
        for k, name in enumerate(sweeps.devices)
        if name in receivers
    ]
    return estimate_scene_from_devices(devices, channels, scene)


def _distinct(warnings: Sequence[SolverWarning]) -> tuple[SolverWarning, ...]:
    """Return the warnings without repeated messages."""
    by_message: dict[str, SolverWarning] = {}
    for warning in warnings:
        by_message.setdefault(warning.message, warning)
    return tuple(by_message.values())


# ---- detections and facts


def station_detections(
    tracked: Sequence[TrackedDevice], scene: Scene
) -> tuple[StationDetection, ...]:
    """Return the number and the residuals of the sweeps of each station, by ascending channel.

    ``tracked`` are devices tracked in ``scene``.
    """
    station_index = np.concatenate([device.sweeps.station for device in tracked])
    is_used = np.concatenate([device.is_used for device in tracked])
    residual = np.concatenate([device.residual for device in tracked])
    detections = []
    for k, channel in enumerate(tracked[0].channels):
        station = scene.station(channel)
        assert station is not None
        is_own = station_index == k
        detections.append(
            StationDetection(
                station=k,
                channel=channel,
                id=None if station.id is None else f"{station.id:08x}",
                period_ticks=int(period_ticks(channel)),
                calibration=station.calibration.source,
                sweeps=int(np.count_nonzero(is_own & is_used)),
                rejected=int(np.count_nonzero(is_own & ~is_used)),
                residual_rad=robust_sigma(residual[is_own & is_used]),
            )
        )
    return tuple(detections)


def _add_verifications(
    detections: Sequence[StationDetection], verifications: Sequence[StationVerification]
) -> tuple[StationDetection, ...]:
    by_channel = {v.channel: v for v in verifications}
    return tuple(
        replace(
            row,
            verification_rad=by_channel[row.channel].residual_rad,
            verification_m=by_channel[row.channel].residual_m,
        )
        if row.channel in by_channel
        else row
        for row in detections
    )


def _tracking_facts(
    facts: LighthouseFacts,
    tracked: Sequence[TrackedDevice],
    scene: Scene,
    detections: Sequence[StationDetection],
) -> LighthouseFacts:
    """Return ``facts`` with the noise of the tracked devices."""
    is_generic = any(s.calibration.is_generic for s in scene.stations)
    return replace(
        facts,
        angle_sigma_rad=max(device.sigma_rad for device in tracked),
        lasting_angle_sigma_rad=max(device.lasting_sigma_rad for device in tracked),
        calibration_sigma_rad=CALIBRATION_SIGMA_RAD if is_generic else None,
        station_residual_rad={
            str(row.channel): row.residual_rad for row in detections if row.residual_rad is not None
        },
    )


# ---- warnings


def device_warnings(tracked: Sequence[TrackedDevice]) -> list[SolverWarning]:
    """Return the doubts about each device."""
    warnings = []
    for device in tracked:
        name = device.trajectory.device
        if len(device.trajectory) == 0:
            warnings.append(
                SolverWarning(
                    "no_device_pose",
                    f"{name}: no pose was found. The receiver's file describes another device, "
                    "the scene is that of another site, or too few photodiodes receive light at "
                    "a time",
                )
            )
            continue
        if device.from_behind_fraction > MAX_FROM_BEHIND_FRACTION:
            warnings.append(
                SolverWarning(
                    "light_from_behind",
                    f"{name}: {device.from_behind_fraction:.0%} of the sweeps come from behind "
                    "their photodiodes: positions or normals in the receiver's file are mirrored "
                    "or in the wrong order",
                )
            )
        if device.ambiguous_epochs:
            warnings.append(
                SolverWarning(
                    "ambiguous_orientation",
                    f"{name}: {device.ambiguous_epochs} poses may have the wrong one of two "
                    "orientations, which explain the angles of a coplanar device under one "
                    "station equally well",
                )
            )
    return warnings


def paths_warnings(error: DegenerateError) -> list[SolverWarning]:
    """Return the warnings for poses that are not on estimated paths."""
    warnings = [
        SolverWarning(
            "paths_not_estimated",
            f"{error}: each pose is estimated from the sweeps around it, and its covariance "
            "contains no errors of the stations",
        )
    ]
    if isinstance(error, MovedStationError):
        warnings.append(SolverWarning("station_moved", error.move))
    return warnings


def contradiction_warnings(
    detections: Sequence[StationDetection], trajectories: Sequence[Trajectory]
) -> list[SolverWarning]:
    """Return a warning if most sweeps of some stations, but not of all, contradict the poses."""
    wrong = [str(row.channel) for row in detections if row.sweeps < row.rejected]
    if not wrong or len(wrong) == len(detections) or not any(len(t) for t in trajectories):
        return []
    return [
        SolverWarning(
            "station_contradicts_others",
            f"most sweeps of the station on channel {', '.join(wrong)} contradict the other "
            "stations: it was moved after the scene was estimated, or received by reflection",
        )
    ]


def _scale_warnings(scene: Scene) -> list[SolverWarning]:
    warnings = [SolverWarning("device_scale", "the scale comes from the size of the rigid devices")]
    if scene.distances:
        warnings.append(SolverWarning("distances_not_used", "distances are not used"))
    return warnings
