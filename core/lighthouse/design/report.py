"""Report about the stations of a room: accuracy, coverage, worst points and the best addition."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION
from locatk.core.lighthouse.design.accuracy import (
    AngleErrors,
    PositionAccuracy,
    predict_poses,
    predict_positions,
)
from locatk.core.lighthouse.design.mounts import MOUNT_DEPTH_M, candidates, rounded
from locatk.core.lighthouse.design.placement import (
    MAX_STATIONS,
    SEARCH_POINTS,
    PlacementProblem,
    RoomRequest,
    SolvedCost,
    percentile_95,
    seen_stations,
    working_points,
)
from locatk.core.lighthouse.design.solved_accuracy import predict_solved_positions
from locatk.core.lighthouse.design.visibility import (
    MAX_RANGE_M,
    MEASURED_RANGE_M,
    blocked_fraction,
)
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.room import Room, hand_mounting_covariance
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.model import stack_stations
from locatk.core.lighthouse.scene.scene_errors import SceneErrors
from locatk.core.polygons import rectangle, signed_area

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

REPORT_POINTS = 2000
"""Number of points of the working volume of which a report consists."""

MAX_GAIN_M = 100.0
"""Position error per angle error [m/rad] from which on a point counts as not covered, however many
stations it sees: they are at almost the same position or in line with it."""

COMPARED_ADDITIONS = 40
"""Number of candidates for an additional station whose accuracy in a solved scene is compared."""

WORST_POINTS = 3
"""Number of points that a report names."""

MIN_POINT_DISTANCE_M = 1.0
"""Smallest distance of two points that a report names [m]."""

NEGLIGIBLE_FRACTION = 0.01
"""Fraction of the points below which a report does not mention them: edges of the volume."""

MIN_AVAILABILITY = 0.99
"""Fraction of time, below which a report warns of robots that hide each other."""


@dataclass(frozen=True)
class RoomReport:
    """Predicted accuracy and coverage at p points of the working volume.

    Attributes
    ----------
    points_m : (p, 3) ndarray
    stations_seen : (p,) int ndarray
        Number of stations in view, without robots in between.
    availability : (p,) ndarray
        Fraction of time in which at least ``min_seen`` stations are in view.
    sigma_m, noise_sigma_m : (p,) ndarray
        Standard deviations of the distance from the true position, in all, and of repeated
        measurements at rest. Infinite if the stations in view do not determine a position.
    dilution : (p,) ndarray
        See :class:`~locatk.core.lighthouse.design.accuracy.PositionAccuracy`.
    is_covered : (p,) bool ndarray
        Enough stations are in view, and they determine a position.
    min_seen : int
    is_planar : bool
    channels : tuple of int
        Of the stations.
    station_points : (s,) int ndarray
        Number of points that see each station.
    warnings : tuple of str
        Deficiencies of the room.
    notes : tuple of str
        Assumptions that matter for this room.
    """

    points_m: Array
    stations_seen: NDArray[np.int64]
    availability: Array
    sigma_m: Array
    noise_sigma_m: Array
    dilution: Array
    is_covered: BoolArray
    min_seen: int
    is_planar: bool
    channels: tuple[int, ...]
    station_points: NDArray[np.int64]
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def covered_fraction(self) -> float:
        """Fraction of the points that are covered."""
        return float(np.mean(self.is_covered))

    @property
    def p95_sigma_m(self) -> float:
        """95th percentile of ``sigma_m`` of all points; infinite if more are not covered."""
        return percentile_95(np.where(self.is_covered, self.sigma_m, np.inf))

    @property
    def p95_noise_sigma_m(self) -> float:
        """95th percentile of ``noise_sigma_m`` of all points."""
        return percentile_95(np.where(self.is_covered, self.noise_sigma_m, np.inf))

    @property
    def mean_sigma_m(self) -> float:
        """Mean of ``sigma_m`` of the covered points; infinite without any."""
        return float(self.sigma_m[self.is_covered].mean()) if np.any(self.is_covered) else np.inf

    @property
    def worst_points(self) -> tuple[int, ...]:
        """Indices of up to three points with the largest errors, points without coverage first."""
        order = np.lexsort((-np.nan_to_num(self.sigma_m, posinf=1e9), self.is_covered))
        found: list[int] = []
        for index in order.tolist():
            offset = self.points_m[found] - self.points_m[index]
            if np.all(np.linalg.norm(offset, axis=1) > MIN_POINT_DISTANCE_M):
                found.append(index)
            if len(found) == WORST_POINTS:
                break
        return tuple(found)


@dataclass(frozen=True)
class Addition:
    """Station that improves a room most.

    Attributes
    ----------
    station : Station
    report : RoomReport
        With the station.
    """

    station: Station
    report: RoomReport


def station_of(channel: int, position_m: Array, rotation: Array) -> Station:
    """Return a designed station with the covariance of its mounting by hand."""
    return Station(
        channel, position_m, rotation, GENERIC_CALIBRATION, covariance=hand_mounting_covariance()
    )


def report_room(
    scene: Scene,
    room: Room,
    request: RoomRequest | None = None,
    *,
    given_errors: bool = False,
    points_m: Array | None = None,
) -> RoomReport:
    """Predict accuracy and coverage of the stations of a scene.

    Parameters
    ----------
    scene : Scene
        In metres, with z up and 0 on the floor of ``room``.
    room : Room
    request : RoomRequest, optional
        Its photodiodes, range and number of stations in view.
    given_errors : bool
        Include the covariances of the stations of the scene. Otherwise, or if it has none, the
        stations are taken as solved from a recording in the whole working volume, with the errors
        of :mod:`~locatk.core.lighthouse.design.solved_accuracy`.
    points_m : (p, 3) ndarray, optional
        Points; the default is a grid in the working volume.
    """
    request = RoomRequest() if request is None else request
    points = working_points(room, REPORT_POINTS) if points_m is None else points_m
    min_seen = request.required_stations(room)
    position, rotation, _ = stack_stations(scene.stations)
    is_seen = seen_stations(room, position, rotation, points, request)
    accuracy = _accuracy(scene, room, request, points, is_seen, given_errors)
    blocked = blocked_fraction(
        room.robots, abs(signed_area(room.working_outline_m)), position, points
    )
    count = is_seen.sum(axis=0)
    report = RoomReport(
        points_m=points,
        stations_seen=count,
        availability=_availability(np.where(is_seen, 1.0 - blocked, 0.0), min_seen),
        sigma_m=accuracy.sigma_m,
        noise_sigma_m=accuracy.noise_sigma_m,
        dilution=accuracy.dilution,
        is_covered=(count >= min_seen) & (accuracy.noise_sigma_m < MAX_GAIN_M * ANGLE_SIGMA_RAD),
        min_seen=min_seen,
        is_planar=room.is_planar,
        channels=tuple(s.channel for s in scene.stations),
        station_points=is_seen.sum(axis=1),
    )
    distance = np.linalg.norm(points[None] - position[:, None], axis=-1)
    is_near = is_seen & (distance <= MEASURED_RANGE_M)
    is_far = (count >= min_seen) & (is_near.sum(axis=0) < min_seen)
    notes = _notes(len(position), float(is_far.mean()))
    return replace(report, warnings=tuple(_warnings(report)), notes=tuple(notes))


def deck_heading_sigma(scene: Scene, report: RoomReport, room: Room, request: RoomRequest) -> float:
    """Return the standard deviation of the heading of a deck at 95 % of the points [rad].

    It is that of a single epoch of a level :data:`~locatk.core.lighthouse.receiver.DECK`.
    """
    position, rotation, _ = stack_stations(scene.stations)
    is_seen = seen_stations(room, position, rotation, report.points_m, request)
    poses = predict_poses(position, rotation, report.points_m, is_seen, DECK.position_m)
    return percentile_95(poses.heading_sigma_rad)


def best_addition(scene: Scene, room: Room, request: RoomRequest) -> Addition | None:
    """Find the station that improves a scene most, if it is solved again.

    Its channel is the lowest free one. Returns None if all channels are used, or if no candidate
    improves the scene.
    """
    used = {station.channel for station in scene.stations}
    free_channels = [c for c in range(1, MAX_STATIONS + 1) if c not in used]
    if not free_channels:
        return None
    problem = PlacementProblem(room, request)
    position, rotation, _ = stack_stations(scene.stations)
    poses = candidates(room, problem.points_m)
    costs = problem.costs_with(problem.views_of(position, rotation), problem.views(poses))
    order = np.argsort(costs, kind="stable")[:COMPARED_ADDITIONS]
    solved_cost = SolvedCost(room, request)

    def rank(positions: Array, rotations: Array) -> tuple[float, float]:
        uncovered = solved_cost.uncovered_fraction(positions, rotations)
        sigma_m = percentile_95(solved_cost.sigmas(positions, rotations))
        return max(uncovered, NEGLIGIBLE_FRACTION), sigma_m

    ranks = [
        rank(
            np.concatenate([position, poses.position_m[[k]]]),
            np.concatenate([rotation, poses.rotation[[k]]]),
        )
        for k in order.tolist()
        if np.isfinite(costs[k])
    ]
    if not ranks or not min(ranks) < rank(position, rotation):
        return None
    best = rounded(poses.take([int(order[ranks.index(min(ranks))])]))
    station = station_of(free_channels[0], best.position_m[0], best.rotation[0])
    more = replace(scene, stations=(*scene.stations, station), covariance=None)
    return Addition(station, report_room(more, room, request))


def assumed_room(scene: Scene) -> Room:
    """Return the smallest room around the stations and markers of a scene without a room.

    Raises
    ------
    InputError
        The scene has no stations, or its z axis is not up.
    """
    if not scene.stations:
        raise InputError("the scene has no stations", hint="Give a solved or designed scene")
    if not scene.is_on_floor and not scene.planar:
        raise InputError(
            "the floor of the scene is unknown: its z axis is not known to be up from the floor",
            hint="Give the room with --room, or fix the frame with `locatk calibrate scene`",
        )
    position, _, _ = stack_stations(scene.stations)
    points = np.concatenate([position, *[m.position[None] for m in scene.markers]])
    low, high = points[:, :2].min(axis=0) - MOUNT_DEPTH_M, points[:, :2].max(axis=0) + MOUNT_DEPTH_M
    size = np.maximum(high - low, 1.0)
    low = 0.5 * (low + high) - 0.5 * size
    top = float(position[:, 2].max())
    if top <= 0:
        raise InputError("all stations are below the floor", hint="Check the frame of the scene")
    z = (max(scene.floor_z, 0.0),) * 2 if scene.planar else (0.0, 0.5 * top)
    outline = rectangle(float(size[0]), float(size[1]), (float(low[0]), float(low[1])))
    return Room(outline, top + MOUNT_DEPTH_M, z)


def _accuracy(
    scene: Scene,
    room: Room,
    request: RoomRequest,
    points: Array,
    is_seen: BoolArray,
    given_errors: bool,
) -> PositionAccuracy:
    """Predict the accuracy with the errors of solved stations, or with those of the scene."""
    position, rotation, _ = stack_stations(scene.stations)
    # Devices move through the whole working volume when the scene is recorded.
    grid = working_points(room, SEARCH_POINTS)
    everywhere = np.concatenate([points, grid])
    on_grid = seen_stations(room, position, rotation, grid, request)
    is_factory = request.calibration == "factory"
    solved = predict_solved_positions(
        position,
        rotation,
        everywhere,
        np.concatenate([is_seen, on_grid], axis=1),
        is_planar=room.is_planar,
        has_factory_data=[is_factory or s.calibration.source == "factory" for s in scene.stations],
    )
    n = len(points)
    accuracy = PositionAccuracy(
        solved.noise_covariance[:n], solved.covariance[:n], solved.dilution[:n]
    )
    if not given_errors:
        return accuracy
    if scene.covariance is not None:
        added = _joint_errors(scene, room, points, is_seen)
        return replace(accuracy, covariance=accuracy.noise_covariance + added)
    given = predict_positions(
        position,
        rotation,
        points,
        is_seen,
        is_planar=room.is_planar,
        errors=AngleErrors(calibration_rad=0.0),
        station_covariances=[s.covariance for s in scene.stations],
    )
    with np.errstate(invalid="ignore"):  # Points without a position are infinite in both.
        added = given.covariance - given.noise_covariance
    added = np.nan_to_num(added, nan=0.0, posinf=0.0)
    return replace(accuracy, covariance=accuracy.covariance + added)


def _joint_errors(scene: Scene, room: Room, points: Array, is_seen: BoolArray) -> Array:
    """Return the covariances (p, d, d) by the joint covariance of stations and calibrations."""
    dims = 2 if room.is_planar else 3
    height_m = room.photodiode_z_m[0] if room.is_planar else None
    errors = SceneErrors(scene, scene.stations, height_m)
    added = np.zeros((len(points), dims, dims))
    for k, point in enumerate(points.tolist()):
        members = np.flatnonzero(is_seen[:, k]).tolist()
        if members:
            added[k] = errors.position_covariance(point, members)[:dims, :dims]
    return added


def _availability(free_fraction: Array, min_seen: int) -> Array:
    """Return the probability (p,) that at least ``min_seen`` of independent events (s, p) occur."""
    fewer = np.zeros((free_fraction.shape[1], min_seen))
    fewer[:, 0] = 1.0
    for each in free_fraction:
        more = fewer * (1.0 - each[:, None])
        more[:, 1:] += fewer[:, :-1] * each[:, None]
        fewer = more
    return np.asarray(1.0 - fewer.sum(axis=1))


def _warnings(report: RoomReport) -> list[str]:
    messages: list[str] = []
    blind = [c for c, n in zip(report.channels, report.station_points, strict=True) if n == 0]
    if blind:
        stations = "station" if len(blind) == 1 else "stations"
        sees = "sees" if len(blind) == 1 else "see"
        messages.append(
            f"{stations} {', '.join(map(str, blind))} {sees} nothing of the working volume: turn "
            "or move"
        )
    uncovered = 1.0 - report.covered_fraction
    if uncovered > NEGLIGIBLE_FRACTION:
        needed = f"{report.min_seen} station" + "s" * (report.min_seen > 1)
        messages.append(
            f"{_percent(uncovered)} of the working volume is not covered: it sees fewer than "
            f"{needed}, or only ones in line with it"
        )
    hidden = report.is_covered & (report.availability < MIN_AVAILABILITY)
    if np.any(hidden):
        worst = float(report.availability[report.is_covered].min())
        messages.append(
            f"robots hide each other: at the worst place, {report.min_seen} or more stations are "
            f"received in {100 * worst:.1f} % of the time. Mount stations higher, or photodiodes"
        )
    return messages


def _notes(stations: int, far_fraction: float) -> list[str]:
    notes = []
    if stations == 1:
        notes.append(
            "the scene of a single station is solved from four or more markers, on which a robot "
            "stops (`locatk calibrate scene`)"
        )
    if far_fraction > NEGLIGIBLE_FRACTION:
        notes.append(
            f"{_percent(far_fraction)} of the working volume needs stations more than "
            f"{MEASURED_RANGE_M:g} m away. HTC states a range of {MAX_RANGE_M:g} m, but reception "
            f"was published up to {MEASURED_RANGE_M:g} m only: try it before you drill"
        )
    return notes


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.1f} %" if fraction < 0.1 else f"{100 * fraction:.0f} %"
