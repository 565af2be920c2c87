"""Design and check of rooms with Lighthouse stations."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from locatk.core.errors import InputError
from locatk.core.lighthouse.design.markers import propose_markers
from locatk.core.lighthouse.design.mounts import StationPoses, ordered
from locatk.core.lighthouse.design.placement import (
    SOLVED_EVALUATIONS,
    PlacementProblem,
    RoomRequest,
    SolvedCost,
    grow_placements,
    percentile_95,
    place_stations,
)
from locatk.core.lighthouse.design.report import (
    RoomReport,
    assumed_room,
    report_room,
    station_of,
)
from locatk.core.lighthouse.room import Room
from locatk.core.lighthouse.scene import Scene

SEARCH_EFFORTS = ((2.0, SOLVED_EVALUATIONS // 8), (1.3, SOLVED_EVALUATIONS))
"""Efforts of searches for the smallest number of stations: ratios of the standard deviation before
to the wanted one up to which it is tried, and numbers of comparisons."""

FRAME = "room"
"""Name of the frame of designed scenes."""


@dataclass(frozen=True)
class RoomDesign:
    """Stations of a room, and their predicted accuracy.

    Attributes
    ----------
    scene : Scene
        With the room and markers. Its stations have the covariance of their mounting.
    poses : StationPoses
        The stations in the order of the scene, with their mounts.
    report : RoomReport
        With the stations solved from a recording in the room.
    mounted_report : RoomReport
        With the stations as they are mounted by hand, before anything is solved.
    is_reached : bool
        The wanted accuracy is reached at 95 % of the points; True if none is wanted.
    warnings : tuple of str
        Of the report, and wishes that are not fulfilled.
    """

    scene: Scene
    poses: StationPoses
    report: RoomReport
    mounted_report: RoomReport
    is_reached: bool
    warnings: tuple[str, ...]

    @property
    def mounts(self) -> dict[str, int]:
        """Number of stations by kind of mount."""
        return dict(Counter(self.poses.kinds))


def design_room(room: Room, request: RoomRequest) -> RoomDesign:
    """Place stations in a room.

    With ``request.stations``, the accuracy of this number is as good as possible. Otherwise it is
    the smallest number that reaches ``request.accuracy_m`` at 95 % of the points; if 16 do not, the
    best placement is returned with a warning that tells what is possible.

    Raises
    ------
    InputError
        No station can be mounted, or the working volume is empty.
    """
    problem = PlacementProblem(room, request)
    if request.stations is not None:
        poses = place_stations(problem, request.stations)
        design = _design(room, request, poses)
    else:
        design = _smallest_design(problem)
    warnings = list(design.warnings)
    if request.stations is not None and len(design.poses) < request.stations:
        warnings.append(
            f"only {len(design.poses)} of {request.stations} stations have space on the mounts"
        )
    if design.report.min_seen > len(design.poses):
        warnings.append(
            f"each place must see {design.report.min_seen} stations, but there are only "
            f"{len(design.poses)}: give more stations"
        )
    if not design.is_reached and request.accuracy_m is not None:
        warnings.append(_unreached(design, request.accuracy_m, request.stations is None))
    return replace(design, warnings=tuple(warnings))


def check_room(
    scene: Scene,
    room: Room | None = None,
    request: RoomRequest | None = None,
    *,
    given_errors: bool | None = None,
) -> RoomReport:
    """Predict accuracy and coverage of a scene.

    Parameters
    ----------
    scene : Scene
        In metres.
    room : Room, optional
        The default is that of the scene, or the smallest one around its stations.
    request : RoomRequest, optional
        Its photodiodes, range and number of stations in view.
    given_errors : bool, optional
        Include the covariances of the stations; the default is True for scenes that were solved.

    Raises
    ------
    InputError
        The scene has no stations or no scale, or nothing is known of its floor.
    """
    request = RoomRequest() if request is None else request
    if not scene.stations:
        raise InputError(
            "the scene has no stations", hint="Place stations with `locatk room design`"
        )
    if scene.scale == "unit":
        raise InputError(
            "the scale of the scene is unknown",
            hint="Fix it with markers, a distance or `locatk calibrate scene`",
        )
    notes: list[str] = []
    if room is None and scene.room is None:
        room = assumed_room(scene)
        notes.append(
            "the scene has no room: the rectangle around its stations is taken as working area"
        )
    used = room or scene.room
    assert used is not None
    if given_errors is None:
        given_errors = scene.frame_source != "design"
    report = report_room(scene, used, request, given_errors=given_errors)
    return replace(report, notes=(*notes, *report.notes))


def _design(room: Room, request: RoomRequest, poses: StationPoses) -> RoomDesign:
    poses = ordered(room, poses)
    stations = tuple(
        station_of(channel, position, rotation)
        for channel, position, rotation in zip(
            range(1, len(poses) + 1), poses.position_m, poses.rotation, strict=True
        )
    )
    scene = Scene(
        stations=stations,
        planar=room.is_planar,
        floor_z=room.photodiode_z_m[0] if room.is_planar else 0.0,
        scale="design",
        frame=FRAME,
        notes=("stations as designed: calibrate the scene after mounting them",),
        frame_source="design",
        room=room,
    )
    report = report_room(scene, room, request)
    markers = propose_markers(room, report.points_m[report.is_covered])
    scene = replace(scene, markers=markers)
    mounted = report_room(scene, room, request, given_errors=True, points_m=report.points_m)
    is_reached = request.accuracy_m is None or report.p95_sigma_m <= request.accuracy_m
    return RoomDesign(scene, poses, report, mounted, is_reached, report.warnings)


def _smallest_design(problem: PlacementProblem) -> RoomDesign:
    """Return the design with the smallest number of stations that reaches the accuracy."""
    room, request = problem.room, problem.request
    accuracy_m = request.accuracy_m
    assert accuracy_m is not None  # checked by the request
    solved_cost = SolvedCost(room, request)
    best: RoomDesign | None = None
    best_count, best_sigma_m = 0, np.inf
    for poses in grow_placements(problem):
        count = len(poses)
        sigma_m = percentile_95(solved_cost.sigmas(poses.position_m, poses.rotation))
        if not sigma_m >= best_sigma_m or np.isinf(best_sigma_m):
            best_count, best_sigma_m = count, sigma_m
        # The search improves what was grown; with little effort first.
        for gain, evaluations in SEARCH_EFFORTS:
            if count < problem.min_seen or sigma_m > gain * accuracy_m:
                break
            design = _design(room, request, place_stations(problem, count, evaluations))
            if best is None or _rank(design) < _rank(best):
                best = design
            if design.is_reached:
                return design
            sigma_m = design.report.p95_sigma_m
    if best is None:
        best = _design(room, request, place_stations(problem, best_count))
    return best


def _rank(design: RoomDesign) -> tuple[float, float]:
    return 1.0 - design.report.covered_fraction, design.report.p95_sigma_m


def _unreached(design: RoomDesign, accuracy_m: float, is_largest: bool) -> str:
    report = design.report
    possible = f"{1e3 * report.p95_sigma_m:.2g} mm at 95 % of the places"
    if report.covered_fraction < 0.95:
        possible = f"{100 * report.covered_fraction:.0f} % of the places are covered"
    remedy = "more stations, or a smaller working volume"
    if is_largest:
        remedy = "a smaller working volume, more mounts, or factory calibrations of the stations"
    return (
        f"{1e3 * accuracy_m:.3g} mm are not reached with {len(design.poses)} stations: {possible}. "
        f"It takes {remedy}"
    )
