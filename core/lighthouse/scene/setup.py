"""Setup of a scene by standstills: which rest was on which marker, or at which point of the floor.

A user rests a device on markers, or at the origin, on the x axis and on the floor, and tells only
the order. :func:`assign_standstills` gives each rest its role, :func:`add_to_prior` hands markers
and a known distance to the solver, and :func:`place_on_floor` transforms its solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from locatk.core.errors import DegenerateError, InputError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.core.lighthouse.results import FrameFacts, LighthouseFacts, StandstillFacts
from locatk.core.lighthouse.scene.floor_frame import ASSUMED_BASELINE_M, fit_floor_frame
from locatk.core.lighthouse.scene.frame import MAX_MARKER_MISFIT_M
from locatk.core.lighthouse.scene.gravity import UpMeasurement, estimate_up, station_ups, with_ups
from locatk.core.lighthouse.scene.model import Distance, Marker, MarkerVisit, Scene
from locatk.core.lighthouse.scene.reframing import median_position, transform_solution
from locatk.core.lighthouse.scene.standstills import Standstill
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

ORIGIN, X_AXIS, FLOOR = "origin", "x axis", "floor"
"""Roles of standstills on the floor; the role of one on a marker is its name."""


@dataclass(frozen=True)
class SceneSetup:
    """Points at which a device rested, in the order of its standstills.

    Attributes
    ----------
    markers : tuple of (str, (float, float, float))
        Names and positions in metres, in the order of the standstills.
    has_floor : bool
        The device rested at the origin, on the x axis and on the floor. Not together with markers.
    origin, x_axis : int, optional
        Numbers of these standstills, from 1; by default the first and the second.
    x_distance_m : float, optional
        Distance of the point on the x axis from the origin. It determines the scale.
    ignored : tuple of int
        Numbers of standstills at other points.
    device : str, optional
        Device that rested; needed if several did.
    height_m : float
        Height of the photodiode, or of the origin of a rigid device, above markers and floor.
    """

    markers: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    has_floor: bool = False
    origin: int | None = None
    x_axis: int | None = None
    x_distance_m: float | None = None
    ignored: tuple[int, ...] = ()
    device: str | None = None
    height_m: float = 0.0


@dataclass(frozen=True)
class AssignedStandstill:
    """Standstill with its number, from 1 in the order of time, and its role; "" if unused."""

    number: int
    standstill: Standstill
    role: str = ""

    @property
    def visit(self) -> MarkerVisit:
        """Its device and time."""
        rest = self.standstill
        return MarkerVisit(rest.device, rest.start_ns, rest.end_ns)


def assign_standstills(
    setup: SceneSetup, standstills: Sequence[Standstill]
) -> tuple[AssignedStandstill, ...]:
    """Give each standstill its role.

    Raises
    ------
    InputError
        Several devices rested and the setup names none, a number does not exist, or there are
        fewer standstills than points.
    """
    devices = sorted({each.device for each in standstills})
    needs_points = bool(setup.markers) or setup.has_floor
    if setup.device is not None:
        # The photodiode of a device, as in ``robot/0``, goes by the name of the device as well.
        standstills = [
            each
            for each in standstills
            if setup.device in (each.device, each.device.rpartition("/")[0])
        ]
        if not standstills:
            raise InputError(
                f"device {setup.device!r} did not rest",
                hint=f"devices that rested: {', '.join(devices) or 'none'}",
            )
    elif needs_points and len(devices) > 1:
        raise InputError(
            f"{len(devices)} devices rested: {', '.join(devices)}",
            hint="name the one that was set on the points with --device",
        )
    numbered = [AssignedStandstill(k, each) for k, each in enumerate(standstills, 1)]
    if not needs_points:
        return tuple(numbered)
    for number in (*setup.ignored, setup.origin, setup.x_axis):
        if number is not None and not 1 <= number <= len(numbered):
            raise InputError(
                f"there is no standstill {number}", hint=_describe_standstills(numbered)
            )
    used = [each for each in numbered if each.number not in setup.ignored]
    roles = _marker_roles(setup, used) if setup.markers else _floor_roles(setup, used)
    return tuple(replace(each, role=roles.get(each.number, "")) for each in numbered)


def _marker_roles(setup: SceneSetup, used: Sequence[AssignedStandstill]) -> dict[int, str]:
    if len(used) < len(setup.markers):
        raise InputError(
            f"{len(setup.markers)} markers and {len(used)} standstills",
            hint=_describe_standstills(used),
        )
    names = (name for name, _ in setup.markers)
    return {each.number: name for each, name in zip(used, names, strict=False)}


def _floor_roles(setup: SceneSetup, used: Sequence[AssignedStandstill]) -> dict[int, str]:
    chosen = {setup.origin, setup.x_axis} - {None}
    free = [each.number for each in used if each.number not in chosen]
    origin = setup.origin or (free.pop(0) if free else None)
    x_axis = setup.x_axis or (free.pop(0) if free else None)
    if origin is None or x_axis is None:
        raise InputError(
            f"the floor needs two standstills, at the origin and on the x axis, not {len(used)}",
            hint=_describe_standstills(used),
        )
    if origin == x_axis:
        raise InputError("the origin and the point on the x axis are the same standstill")
    return dict.fromkeys(free, FLOOR) | {origin: ORIGIN, x_axis: X_AXIS}


def _describe_standstills(standstills: Sequence[AssignedStandstill]) -> str:
    """List the standstills by their times since the first one."""
    if not standstills:
        return "rest the device for two seconds or more at each point"
    first_ns = standstills[0].standstill.start_ns
    times = ", ".join(
        f"{each.number} after {(each.standstill.start_ns - first_ns) / NANOSECONDS_PER_S:.0f} s "
        f"({each.standstill.duration_s:.1f} s long)"
        for each in standstills
    )
    return f"standstills of {standstills[0].standstill.device}: {times}"


def add_to_prior(
    prior: Scene,
    setup: SceneSetup,
    assigned: Sequence[AssignedStandstill],
    *,
    is_rigid: bool,
) -> Scene:
    """Return the prior with the markers of a setup, or with the known length of its x axis.

    Markers with visits of the prior are replaced. The scale of rigid devices does not need the
    distance; :func:`place_on_floor` refines it.
    """
    by_role = {each.role: each for each in assigned if each.role}
    if setup.markers:
        raised = np.array([0.0, 0.0, setup.height_m])
        markers = tuple(
            Marker(name, np.array(position) + raised, (by_role[name].visit,))
            for name, position in setup.markers
        )
        return replace(prior, markers=markers)
    if setup.has_floor:
        # Other markers of the session would fix another frame.
        prior = replace(prior, markers=())
        if setup.x_distance_m is not None and not is_rigid:
            distance = Distance(by_role[ORIGIN].visit, by_role[X_AXIS].visit, setup.x_distance_m)
            prior = replace(prior, distances=(distance,))
    return prior


def place_on_floor(
    solution: Solution,
    setup: SceneSetup,
    assigned: Sequence[AssignedStandstill],
    prior: Scene,
    devices: Sequence[UpMeasurement] = (),
) -> Solution:
    """Transform a solution to the frame of the floor on which a device rested.

    Parameters
    ----------
    solution : Solution
        With a scene that was estimated.
    setup, assigned : SceneSetup, sequence of AssignedStandstill
    prior : Scene
        Its ``ups`` are the directions of the accelerometers of the stations by channel.
    devices : sequence of UpMeasurement
        Directions from the IMUs of devices, in the frame of the solution.

    Raises
    ------
    DegenerateError
        A point was not located, or the points do not determine the frame, or contradict the scene.
    InputError
        The setup has a height, and the scale is unknown.
    """
    scene = with_ups(solution.artifact, prior.ups)
    order = sorted(
        (each for each in assigned if each.role),
        key=lambda each: ((ORIGIN, X_AXIS, FLOOR).index(each.role), each.number),
    )
    located = [(each, median_position(solution.trajectories, each.visit)) for each in order]
    for each, position in located[:2]:
        if position is None:
            raise DegenerateError(
                f"standstill {each.number} ({each.role}) has no position",
                hint="at least two stations must receive the device there, or one station a "
                "device with several photodiodes of known positions",
            )
    known = [(each, position) for each, position in located if position is not None]
    is_metric = scene.scale != "unit" or setup.x_distance_m is not None
    if setup.height_m and not is_metric:
        raise InputError(
            "a height needs a known scale", hint="give the distance of the point on the x axis"
        )
    stations = np.stack([station.position for station in scene.stations])
    frame = fit_floor_frame(
        np.stack([position for _, position in known]),
        stations,
        estimate_up([*station_ups(scene), *devices]),
        x_distance_m=setup.x_distance_m,
        height_m=setup.height_m,
        metres_per_unit=1.0 if is_metric else ASSUMED_BASELINE_M,
        normal=np.array([0.0, 0.0, 1.0]) if scene.planar else None,
    )
    warnings = list(solution.warnings)
    worst = int(np.argmax(np.abs(frame.heights_m)))
    if (frame.misfit_m or 0.0) > MAX_MARKER_MISFIT_M and is_metric:
        warnings.append(
            SolverWarning(
                "floor_misfit",
                f"the points on the floor are {1e3 * (frame.misfit_m or 0.0):.0f} mm (rms) from "
                f"one plane: was standstill {known[worst][0].number} on the floor? It is "
                f"{1e3 * frame.heights_m[worst]:+.0f} mm from the plane",
            )
        )
    if len(known) < len(located):
        missing = [str(each.number) for each, position in located if position is None]
        warnings.append(
            SolverWarning(
                "visits_not_used",
                f"standstills without a position are not used: {', '.join(missing)}",
            )
        )
    moved = replace(
        scene.transformed(frame.to_floor),
        frame="floor",
        frame_source="floor",
        room=None,
        scale="distance" if setup.x_distance_m is not None else scene.scale,
        level_sigma_rad=frame.level_sigma_rad,
    )
    facts = FrameFacts(
        "floor",
        frame.level_sigma_rad,
        origin_sigma_m=frame.origin_sigma_m,
        heading_sigma_rad=frame.heading_sigma_rad,
        scale_sigma=frame.scale_sigma,
        misfit_m=frame.misfit_m if is_metric else None,
    )
    return replace(
        transform_solution(solution, frame.to_floor, moved),
        facts=replace(solution.facts or LighthouseFacts(), frame=facts),
        warnings=tuple(warnings),
    )


def with_standstills(solution: Solution, assigned: Sequence[AssignedStandstill]) -> Solution:
    """Return the solution with the standstills and their positions among its facts."""
    facts = solution.facts or LighthouseFacts()
    frame = facts.frame or FrameFacts(solution.artifact.frame_source or "unknown")
    standstills = _standstill_facts(assigned, solution.trajectories)
    return replace(solution, facts=replace(facts, frame=replace(frame, standstills=standstills)))


def _standstill_facts(
    assigned: Sequence[AssignedStandstill], trajectories: Sequence[Trajectory]
) -> tuple[StandstillFacts, ...]:
    facts = []
    for each in assigned:
        rest = each.standstill
        position = median_position(trajectories, each.visit)
        facts.append(
            StandstillFacts(
                each.number,
                rest.device,
                rest.start_ns,
                rest.end_ns,
                each.role,
                None
                if position is None
                else (float(position[0]), float(position[1]), float(position[2])),
            )
        )
    return tuple(facts)
