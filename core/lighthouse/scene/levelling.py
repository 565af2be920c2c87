"""Level of the frame of a solved scene: set by gravity, or verified against it.

Without markers and a floor, the axes of a scene are those of its first station, which hangs tilted
on a wall. The accelerometers of the stations, and devices with an IMU at rest, tell the vertical:
:func:`level_solution` turns z upwards. A frame of markers or of a floor is kept and compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity, matrix_from_quaternion, skew
from locatk.core.inertial import STANDARD_GRAVITY_M_S2, InertialSamples
from locatk.core.lighthouse.results import FrameFacts, LighthouseFacts
from locatk.core.lighthouse.scene.gravity import (
    MAX_UP_CHI2,
    UpEstimate,
    UpMeasurement,
    angles_between,
    estimate_up,
    station_ups,
    with_ups,
)
from locatk.core.lighthouse.scene.model import Marker, Scene
from locatk.core.lighthouse.scene.reframing import rotation_between, transform_solution
from locatk.core.lighthouse.scene.standstills import Standstill
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory, has_orientation

Array = NDArray[np.float64]

MARKER_SIGMA_M = 0.002
"""Standard deviation of a position measured by hand, along each axis [m]."""

IMU_UP_SIGMA_RAD = float(np.deg2rad(1.0))
"""Standard deviation of the direction of an IMU at rest, about each axis: offsets of 10 mg and the
mounting on its device."""

MAX_GRAVITY_ERROR_M_S2 = 0.5
"""Largest difference of the mean specific force at rest from gravity [m/s^2]: offset and scale of
common accelerometers. Beyond, the sensor is faulty or moves."""

MIN_FORWARD_EXTENT = 0.2
"""Smallest horizontal part of a unit vector that gives the direction of the x axis: 12 degrees from
the vertical. Below, a small error of the vertical turns it far."""

VERTICAL = np.array([0.0, 0.0, 1.0])


def inertial_ups(
    imus: Sequence[InertialSamples],
    trajectories: Sequence[Trajectory],
    standstills: Sequence[Standstill],
) -> list[UpMeasurement]:
    """Return the direction against gravity that each device with an IMU measured at rest.

    The direction is in the frame of the trajectories; it needs the orientation of the device, so
    that single photodiodes have none. All rests of a device count as one measurement, because they
    have the errors of its accelerometer and its mounting in common.
    """
    measurements = []
    for samples in imus:
        track = next((t for t in trajectories if t.device == samples.device), None)
        if track is None:
            continue
        is_known = has_orientation(track)
        directions = []
        for rest in standstills:
            if rest.device != samples.device:
                continue
            poses = np.flatnonzero(_is_within(track.time_ns, rest) & is_known)
            rows = samples.acceleration[_is_within(samples.time_ns, rest)]
            rows = rows[np.isfinite(rows).all(axis=1)]
            if len(poses) == 0 or len(rows) == 0:
                continue
            force = rows.mean(axis=0)
            strength = float(np.linalg.norm(force))
            if abs(strength - STANDARD_GRAVITY_M_S2) > MAX_GRAVITY_ERROR_M_S2:
                continue
            middle = track.quaternion[poses[len(poses) // 2]]
            directions.append(matrix_from_quaternion(middle) @ force / strength)
        if directions:
            mean = np.mean(directions, axis=0)
            measurements.append(
                UpMeasurement(
                    f"the IMU of {samples.device}", mean / np.linalg.norm(mean), IMU_UP_SIGMA_RAD
                )
            )
    return measurements


def _is_within(time_ns: NDArray[np.int64], rest: Standstill) -> NDArray[np.bool_]:
    return (time_ns >= rest.start_ns) & (time_ns <= rest.end_ns)


def level_solution(
    solution: Solution, prior: Scene, devices: Sequence[UpMeasurement] = ()
) -> Solution:
    """Level the frame of a solution by gravity, or compare it with gravity.

    Parameters
    ----------
    solution : Solution
        With a scene as its artifact.
    prior : Scene
        Scene that was given to the solver: with stations, these are not moved. Its ``ups`` are the
        directions of the accelerometers by channel.
    devices : sequence of UpMeasurement
        Directions from the IMUs of devices at rest, in the frame of the solution.

    Returns
    -------
    Solution
        With the directions of the stations in its scene and the facts of its frame. If the frame
        was that of the first station and the vertical is known, z is up, and x is the horizontal
        direction of view of this station, which remains the origin.
    """
    scene: Scene = with_ups(solution.artifact, prior.ups)
    solution = replace(solution, artifact=scene)
    warnings: list[SolverWarning] = []
    up = estimate_up([*station_ups(scene), *devices])
    if up is not None and up.contradicting:
        warnings.append(_contradiction_warning(up))
    if up is not None and up.direction is not None:
        if scene.frame_source == "station" and not prior.stations:
            solution = _turn_upright(solution, up.direction, up.sigma_rad)
            scene = solution.artifact
            warnings.append(_level_warning(scene, up))
        elif scene.is_level:
            deviation_rad = float(angles_between(up.direction, VERTICAL))
            variance = up.sigma_rad**2 + (scene.level_sigma_rad or 0.0) ** 2
            if deviation_rad**2 > MAX_UP_CHI2 * variance:
                warnings.append(_tilt_warning(scene, deviation_rad))
    if scene.frame_source == "markers" and scene.level_sigma_rad is None:
        level_rad, _, _, _ = marker_frame_sigmas(scene.markers, _marker_misfit(solution.facts))
        scene = replace(scene, level_sigma_rad=level_rad)
    known = solution.facts.frame if solution.facts else None
    facts = _frame_facts(scene, up, _marker_misfit(solution.facts), known)
    if not prior.stations:
        notes = tuple(warning.message for warning in warnings)
        scene = replace(scene, notes=(*scene.notes, *notes))
    return replace(
        solution,
        artifact=scene,
        facts=replace(solution.facts or LighthouseFacts(), frame=facts),
        warnings=(*solution.warnings, *warnings),
    )


def upright_rotation(station_rotation: Array, up: Array) -> Array:
    """Return the rotation to a frame with z along ``up`` and x along a station's horizontal view.

    If the station looks almost straight up or down, x is along the horizontal direction of its top
    (looking down) or bottom (looking up).
    """
    upright = rotation_between(up, VERTICAL)
    forward, _, top = (upright @ station_rotation).T
    if np.hypot(forward[0], forward[1]) < MIN_FORWARD_EXTENT:
        forward = -np.sign(forward[2]) * top
    heading = float(np.arctan2(forward[1], forward[0]))
    cosine, sine = np.cos(heading), np.sin(heading)
    about_z = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ upright)


def marker_frame_sigmas(
    markers: Sequence[Marker], misfit_m: float | None
) -> tuple[float | None, float | None, float | None, float | None]:
    """Return the standard deviations of a frame that visited markers fix.

    Returns
    -------
    level_rad, heading_rad, origin_m, scale : float or None
        Of the inclination of z, the direction of x, the origin along each axis, and relative; None
        if the markers do not determine them.
    """
    points = np.array([m.position for m in markers if m.visits]).reshape(-1, 3)
    sigma_m = max(MARKER_SIGMA_M, misfit_m or 0.0)
    centre = points.mean(axis=0) if len(points) else np.zeros(3)
    cross = skew(points - centre)
    information = np.einsum("nij,nkj->ik", cross, cross)
    if len(points) < 3 or np.linalg.cond(information) > 1e9:
        return None, None, None, None
    rotation = sigma_m**2 * np.linalg.inv(information)
    lever = skew(centre)
    origin = sigma_m**2 / len(points) * np.eye(3) + lever @ rotation @ lever.T
    extent = float(np.sum((points - centre) ** 2))
    return (
        float(np.sqrt(np.linalg.eigvalsh(rotation[:2, :2])[-1])),
        float(np.sqrt(rotation[2, 2])),
        float(np.sqrt(np.linalg.eigvalsh(origin)[-1])),
        sigma_m / float(np.sqrt(extent)),
    )


def _turn_upright(solution: Solution, up: Array, sigma_rad: float) -> Solution:
    """Transform a solution in the frame of its first station so that z is up."""
    scene: Scene = solution.artifact
    first = scene.stations[0]
    to = Similarity(1.0, upright_rotation(first.rotation, up), np.zeros(3))
    to = replace(to, translation=-to.apply(first.position))
    scene = replace(
        scene.transformed(to),
        frame=f"station-{first.channel}-level",
        frame_source="gravity",
        level_sigma_rad=sigma_rad,
    )
    return transform_solution(solution, to, scene)


def _frame_facts(
    scene: Scene, up: UpEstimate | None, misfit_m: float | None, known: FrameFacts | None
) -> FrameFacts | None:
    """Return the facts of the frame of a scene; None if nothing is known of it."""
    if scene.frame_source is None and up is None:
        return None
    facts = known or FrameFacts(scene.frame_source or "unknown", scene.level_sigma_rad)
    if scene.frame_source == "markers":
        _, heading_rad, origin_m, scale = marker_frame_sigmas(scene.markers, misfit_m)
        facts = replace(
            facts, heading_sigma_rad=heading_rad, origin_sigma_m=origin_m, scale_sigma=scale
        )
    own = estimate_up(station_ups(scene))
    if own is not None and own.direction is not None:
        deviation_rad = float(angles_between(own.direction, VERTICAL))
        facts = replace(facts, up_deviation_rad=deviation_rad, up_sigma_rad=own.sigma_rad)
    return facts


def _marker_misfit(facts: LighthouseFacts | None) -> float | None:
    return None if facts is None else facts.marker_misfit_m


def _contradiction_warning(up: UpEstimate) -> SolverWarning:
    return SolverWarning(
        "up_contradicts_others",
        f"gravity from {_join(up.contradicting)} contradicts the others by more than three "
        "standard deviations: a station was tilted after the scene was estimated, or the "
        "arrangement of the stations is wrong",
    )


def _level_warning(scene: Scene, up: UpEstimate) -> SolverWarning:
    return SolverWarning(
        "level_by_gravity",
        f"z is up by gravity from {_join(up.used)}, level within "
        f"{np.degrees(up.sigma_rad):.1f} deg (one sigma). The origin is the station on channel "
        f"{scene.stations[0].channel}; its height above the floor is unknown",
    )


def _tilt_warning(scene: Scene, deviation_rad: float) -> SolverWarning:
    return SolverWarning(
        "frame_not_level",
        f"the z axis of the frame is {np.degrees(deviation_rad):.0f} deg from the vertical of the "
        f"stations' accelerometers. Its source is {_SOURCES[scene.frame_source or 'markers']}",
    )


_SOURCES: Mapping[str, str] = {
    "markers": "the markers: check their coordinates, and that x and y are counterclockwise seen "
    "from above",
    "floor": "the floor on which the devices are assumed: is it level, and are the devices on it?",
    "gravity": "gravity at an earlier time: was a station moved?",
}


def _join(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
