"""Recordings with rigid devices: their full poses, and the other devices in the same scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import (
    Similarity,
    quaternion_from_matrix,
    quaternion_multiply,
    umeyama,
)
from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.devices.rigid_solver import DeviceSolution, solve_rigid_devices
from locatk.core.lighthouse.devices.verification import verify_devices
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import (
    LighthouseFacts,
    SceneVerification,
    StationDetection,
    StationVerification,
)
from locatk.core.lighthouse.scene import MarkerVisit, Scene
from locatk.core.lighthouse.scene.frame import MAX_MARKER_MISFIT_M, transform_covariance
from locatk.core.robust import robust_sigma
from locatk.core.solution import Solution, SolverWarning, from_json, to_json
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

LEAST_MARKERS = 3

LEAST_PHOTODIODES = 3
"""Photodiodes of known place that fix an orientation."""


def rigid_devices(sweeps: Sweeps, receivers: Mapping[str, Receiver]) -> dict[str, Receiver]:
    """The receivers with which devices of a recording get full poses."""
    present = {sweeps.devices[k] for k in np.unique(sweeps.device)}
    return {
        name: receiver
        for name, receiver in receivers.items()
        if len(receiver) >= LEAST_PHOTODIODES and name in present
    }


def solve_devices(sweeps: Sweeps, scene: Scene, rigid: Mapping[str, Receiver]) -> Solution:
    """Estimate the poses of the rigid devices of a recording, in a given scene or their own.

    Parameters
    ----------
    sweeps, scene
        As for :func:`~locatk.core.lighthouse.solver.solve`.
    rigid : mapping of str to Receiver
        By device; of at least one device of the recording.
    """
    answer = solve_rigid_devices(sweeps, rigid, scene)
    if not scene.stations and scene.markers:
        answer = _on_markers(answer, scene.frame)
    if answer.scene.scale == "device" and not scene.stations:
        answer.notes.append("the scale is that of the device's own photodiodes")
        if scene.distances:
            answer.notes.append("distances are not used")
    checks = verify_devices(sweeps, rigid, answer)
    if checks:
        answer.facts["verification"] = to_json(
            SceneVerification(
                bool(scene.stations), sum(check.epochs for check in checks), tuple(checks)
            )
        )
    return _solution(answer, checks)


def _on_markers(answer: DeviceSolution, frame: str) -> DeviceSolution:
    """The scene and the poses moved onto the markers on which devices stood.

    Markers lie farther apart than photodiodes, so that they give the scale as well.
    """
    known, seen = [], []
    for marker in answer.scene.markers:
        for sighting in marker.visits:
            place = _stood(sighting, answer.trajectories)
            if place is not None:
                known.append(marker.position)
                seen.append(place)
    try:
        if len(known) < LEAST_MARKERS:
            raise DegenerateError(f"{len(known)} were seen")
        to = umeyama(np.stack(seen), np.stack(known))
    except DegenerateError:
        answer.notes.append(
            f"fewer than {LEAST_MARKERS} markers, not on one line, were stood on by a device: they "
            "fix no frame"
        )
        return answer
    misfit = float(np.sqrt(np.mean(np.sum((to.apply(seen) - known) ** 2, axis=1))))
    notes = [*answer.notes]
    if misfit > MAX_MARKER_MISFIT_M:
        notes.append(
            f"the markers are {1e3 * misfit:.0f} mm (rms) from where the device stood: a marker is "
            "measured wrong, or the scene is"
        )
    stations = tuple(
        replace(
            station,
            position=to.apply(station.position),
            rotation=to.rotation @ station.rotation,
            covariance=None
            if station.covariance is None
            else transform_covariance(station.covariance, to.scale, to.rotation),
        )
        for station in answer.scene.stations
    )
    framed = replace(answer.scene, stations=stations, frame=frame, scale="markers")
    facts = {**answer.facts, "marker_misfit_m": misfit, "marker_scale": to.scale}
    tracks = tuple(_moved(track, to, frame) for track in answer.trajectories)
    return replace(answer, scene=framed, trajectories=tracks, facts=facts, notes=notes)


def _moved(track: Trajectory, to: Similarity, frame: str) -> Trajectory:
    """Poses in another frame. Their photodiodes keep their distances: scale differs by less
    than a part in a hundred, or a note has told that the markers do not fit."""
    return replace(
        track,
        frame=frame,
        position=to.apply(track.position),
        quaternion=quaternion_multiply(quaternion_from_matrix(to.rotation), track.quaternion),
        covariance=transform_covariance(track.covariance, to.scale, to.rotation),
    )


def _stood(sighting: MarkerVisit, trajectories: tuple[Trajectory, ...]) -> Array | None:
    """Median position (3,) of a device during a sighting; None where it has no pose."""
    for trajectory in trajectories:
        if trajectory.device == sighting.device:
            start, end = sighting.start_ns or 0, sighting.end_ns or 0
            inside = (trajectory.time_ns >= start) & (trajectory.time_ns <= end)
            if np.any(inside):
                place: Array = np.median(trajectory.position[inside], axis=0)
                return place
    return None


def _solution(answer: DeviceSolution, checks: tuple[StationVerification, ...]) -> Solution:
    """What the rigid devices alone say."""
    checked = {check.channel: check for check in checks}
    rows: list[dict[str, object]] = []
    for k, channel in enumerate(sorted(answer.used)):
        station = answer.scene.station(channel)
        rows.append(
            {
                "station": k,
                "channel": channel,
                "id": None if station is None or station.id is None else f"{station.id:08x}",
                "period_ticks": int(period_ticks(channel)),
                "calibration": "none" if station is None else station.calibration.source,
                "sweeps": answer.used[channel],
                "rejected": answer.unused[channel],
                "residual_rad": robust_sigma(answer.residuals[channel]),
            }
        )
        if channel in checked:
            rows[-1]["verification_rad"] = checked[channel].residual_rad
            rows[-1]["verification_m"] = checked[channel].residual_m
    return Solution(
        "lighthouse",
        "bundle",
        answer.trajectories,
        dict(answer.rejected),
        [from_json(StationDetection, row) for row in rows],
        answer.scene,
        facts=from_json(LighthouseFacts, answer.facts),
        warnings=tuple(SolverWarning("device", note) for note in answer.notes),
    )
