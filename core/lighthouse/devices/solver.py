"""Recordings with rigid devices: their full poses, and the other devices in the same scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

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
from locatk.core.lighthouse.job import LARGEST_MISFIT_M
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import MarkerVisit, Scene
from locatk.core.lighthouse.scene.frame import transform_covariance
from locatk.core.lighthouse.scene.verification import StationCheck
from locatk.core.robust import robust_sigma
from locatk.core.solution import Solution, SolverWarning, from_json, to_json
from locatk.core.trajectory import Trajectory

if TYPE_CHECKING:
    from locatk.core.lighthouse.solver import SolveOptions

Array = NDArray[np.float64]

LEAST_MARKERS = 3

COUNTED = ("sweeps", "rejected")
"""Of a detection: numbers that add up over devices."""

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


def solve_devices(
    sweeps: Sweeps, scene: Scene, options: SolveOptions, rigid: Mapping[str, Receiver]
) -> Solution:
    """Solve the rigid devices, then the others in the scene of the rigid ones.

    Parameters
    ----------
    sweeps, scene, options
        As for :func:`~locatk.core.lighthouse.solver.solve`.
    rigid : mapping of str to Receiver
        By device; of at least one device of the recording.
    """
    from locatk.core.lighthouse.solver import solve

    answer = solve_rigid_devices(sweeps, rigid, scene)
    if not scene.stations and scene.markers:
        answer = _on_markers(answer, scene.frame)
    if answer.scene.scale == "device" and not scene.stations:
        answer.notes.append("the scale is that of the device's own photodiodes")
        if scene.distances:
            answer.notes.append("distances are not used")
    checks = verify_devices(sweeps, rigid, answer)
    if checks:
        answer.facts["verification"] = {
            "held_out": bool(scene.stations),
            "moments": sum(check.moments for check in checks),
            "stations": [check.as_facts() for check in checks],
        }
    own = _solution(answer, options, checks)
    numbers = [k for k, name in enumerate(sweeps.devices) if name not in rigid]
    left = np.flatnonzero(np.isin(sweeps.device, numbers))
    if len(left) == 0:
        return own
    others = solve(sweeps.take(left), answer.scene, options)
    return _together(own, others, tuple(rigid))


def _on_markers(answer: DeviceSolution, frame: str) -> DeviceSolution:
    """The scene and the poses moved onto the markers on which devices stood.

    Markers lie farther apart than photodiodes, so that they give the scale as well.
    """
    known, seen = [], []
    for marker in answer.scene.markers:
        for sighting in marker.sightings:
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
    if misfit > LARGEST_MISFIT_M:
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


def _solution(
    answer: DeviceSolution, options: SolveOptions, checks: tuple[StationCheck, ...]
) -> Solution:
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
        options.method,
        answer.trajectories,
        dict(answer.rejected),
        tuple(from_json(StationDetection, row) for row in rows),
        answer.scene,
        tuple(SolverWarning("unspecified", text) for text in dict.fromkeys(answer.notes)),
        from_json(LighthouseFacts, answer.facts),
    )


def _together(rigid: Solution, others: Solution, names: tuple[str, ...]) -> Solution:
    """One solution of two over the same scene."""
    rejected = dict(Counter(rigid.rejected) + Counter(others.rejected))
    rows = {row.channel: to_json(row) for row in others.detections}
    for row in map(to_json, rigid.detections):
        both = rows.setdefault(row["channel"], {**row, **dict.fromkeys(COUNTED, 0)})
        both.update({name: both[name] + row[name] for name in COUNTED})
    points = [t for t in others.trajectories if t.device not in names]
    return replace(
        others,
        trajectories=(*rigid.trajectories, *points),
        rejected=rejected,
        detections=tuple(
            from_json(StationDetection, {**rows[c], "station": k})
            for k, c in enumerate(sorted(rows))
        ),
        warnings=tuple(dict.fromkeys((*rigid.warnings, *others.warnings))),
        facts=replace(others.facts, rigid=rigid.facts),
    )
