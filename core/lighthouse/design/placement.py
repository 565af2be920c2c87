"""Placement of base stations in a room.

Stations are chosen from candidates (positions on walls, the ceiling and tripods, each with several
directions of view) by a greedy search, improved by exchanging one station at a time, and then moved
continuously along their mounts. The information matrices of all candidates at all points of a grid
are computed once; those of several stations are their sums.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.design.accuracy import (
    angle_gradients,
    information,
    variance_of,
)
from locatk.core.lighthouse.design.calibration_errors import calibration_sigma
from locatk.core.lighthouse.design.solved_accuracy import predict_solved_positions
from locatk.core.lighthouse.design.visibility import (
    FIELD_OF_VIEW_RAD,
    MAX_RANGE_M,
    blocked_fraction,
    faces,
    has_line_of_sight,
    in_field_of_view,
    in_obstacle,
)
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.room import Room
from locatk.core.polygons import is_inside, signed_area

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_STATIONS = 16
"""Channels of Lighthouse V2."""

MOUNT_DEPTH_M = 0.1
"""Distance of a rotor from the wall or the ceiling [m]: half the housing and a short bracket."""

SEARCH_POINTS = 400
"""Number of points of the working volume at which placements are compared."""

REFINEMENT_POINTS = 1200
"""Number of points at which the result of the search is refined."""

COVERAGE_TOLERANCE = 0.005
"""Fraction of the working volume that may stay without coverage in favour of accuracy elsewhere:
the last corners would cost a third of the accuracy of a 10 x 10 m room."""

POSITION_DECIMALS = 2
"""Decimals to which positions are rounded, in metres; angles are rounded to degrees."""

SOLVED_POINTS = 200
"""Number of points at which accuracy in a solved scene is compared."""

SOLVED_EVALUATIONS = 12_000
"""Number of comparisons in solved scenes, times the square of the number of stations: about four
seconds."""

MAX_PART = 250
"""Largest number of random placements, and of comparisons in a refinement."""

REFINED_STARTS = 2
"""Number of placements that are refined in solved scenes."""

WALL_POSITIONS = 44
"""Number of positions along the walls that are tried, at each height."""

CEILING_POSITIONS = 25
"""Number of positions under the ceiling that are tried."""

LOW_CLEARANCE_M = 0.5
"""Lowest mount above the highest photodiode [m], unless the room is lower: below it, robots and
people hide the stations."""

HEIGHT_FRACTIONS = (0.0, 0.5, 1.0)
"""Heights of stations on walls, between the lowest and the highest mount."""

PRIOR_SIGMA_M = 1.0
"""Standard deviation of a position before any station is seen [m]: it makes places comparable that
are not yet determined. Covered places have errors of millimetres."""

MAX_TILT_RAD = float(np.radians(90.0))

REFINEMENT_STEPS = ((0.5, 0.2), (0.25, 0.1), (0.1, 0.05), (0.05, 0.02))
"""Steps of positions [m] and of angles [rad] of the refinement, one after the other."""

UNDETERMINED_SIGMA_M = 0.25
"""Standard deviation from which on a place counts as not covered, however many stations it sees:
they are at almost the same position or in line with it."""

TYPICAL_ROUNDS = 3
"""Number of rounds of exchanges until a search ends."""

MAX_REFINEMENT_ROUNDS = 20
"""Largest number of rounds over all stations with one step."""

SHORTFALL_WEIGHT_M = 1e3
"""Cost of a place without the wanted stations, relative to errors in metres: coverage is first."""

PERCENTILE = 95.0
"""Percentile of the standard deviations that the criterion ``worst`` compares."""

MEAN_WEIGHT = 0.1
"""Weight of the mean standard deviation in the criterion ``worst``. Without it, no single station
of a symmetric placement can be moved to advantage."""

MIN_SEPARATION_M = 0.3
"""Smallest distance of two stations [m]: nearer ones hide each other."""

MAX_STARTS = 100
"""Largest number of searches, of which the best is kept."""

SEARCH_BUDGET = 30_000_000
"""Number of evaluations of one candidate at one point after which no search is started: about three
seconds."""


@dataclass(frozen=True)
class RoomRequest:
    """Wishes for the stations of a room.

    Attributes
    ----------
    stations : int or None
        Number of stations, 1 to 16; None for the smallest number that reaches ``accuracy_m``.
    accuracy_m : float or None
        Largest standard deviation of positions at 95 % of the places.
    criterion : str
        ``"worst"`` minimises the 95th percentile of the standard deviations, ``"mean"`` their mean.
    min_seen : int or None
        Number of stations that each place must see; None for 1 if the room is planar, otherwise 2.
    facing : str
        ``"up"`` for photodiodes that receive light from above only, ``"all"`` from everywhere.
    max_range_m : float
    field_of_view_rad : (horizontal, vertical)
    calibration : str
        ``"factory"`` if the solver will have the factory calibrations of the stations (OOTX),
        otherwise ``"generic"``.
    """

    stations: int | None = 4
    accuracy_m: float | None = None
    criterion: Literal["worst", "mean"] = "worst"
    min_seen: int | None = None
    facing: Literal["up", "all"] = "up"
    max_range_m: float = MAX_RANGE_M
    field_of_view_rad: tuple[float, float] = FIELD_OF_VIEW_RAD
    calibration: Literal["generic", "factory"] = "generic"

    def __post_init__(self) -> None:
        """Check the numbers; raise InputError if they are out of range."""
        if self.stations is None and self.accuracy_m is None:
            raise InputError(
                "neither a number of stations nor an accuracy", hint="Give one of them"
            )
        if self.stations is not None and not 1 <= self.stations <= MAX_STATIONS:
            raise InputError(
                f"{self.stations} stations", hint=f"Lighthouse V2 has channels 1 to {MAX_STATIONS}"
            )
        if self.accuracy_m is not None and not self.accuracy_m > 0:
            raise InputError("the accuracy must be above 0")
        if self.min_seen is not None and not 1 <= self.min_seen <= MAX_STATIONS:
            raise InputError(f"{self.min_seen} stations in view", hint="Give 1 to 16")
        if not self.max_range_m > 0:
            raise InputError("the range must be above 0")
        horizontal, vertical = self.field_of_view_rad
        if not (0 < horizontal <= 2 * np.pi and 0 < vertical < np.radians(120.0)):
            raise InputError(
                "the field of view is not up to 360 degrees wide and below 120 degrees high",
                hint="The planes of a station end 60 degrees above and below its horizon",
            )

    def seen_by(self, room: Room) -> int:
        """Return the number of stations that each place of a room must see."""
        if self.min_seen is not None:
            return self.min_seen
        return 1 if room.is_planar else 2


CEILING, TRIPOD = -1, -2
"""Values of :attr:`StationPoses.wall` for stations that are not on a wall."""


@dataclass(frozen=True)
class StationPoses:
    """Poses of s stations, and how they are mounted.

    Attributes
    ----------
    position_m : (s, 3) ndarray
    yaw_rad, tilt_rad : (s,) ndarray
        Direction of view: its azimuth, and its angle above the horizon. There is no roll.
    wall : (s,) int ndarray
        Index of the edge of the outline, -1 for the ceiling and -2 for a tripod.
    """

    position_m: Array
    yaw_rad: Array
    tilt_rad: Array
    wall: IntArray

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.yaw_rad)

    @property
    def rotation(self) -> Array:
        """Rotations (s, 3, 3) from station to room."""
        return view_rotation(self.yaw_rad, self.tilt_rad)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the mounts of the stations, of :data:`~locatk.core.lighthouse.room.MOUNTS`."""
        names = {CEILING: "ceiling", TRIPOD: "tripod"}
        return tuple(names.get(wall, "wall") for wall in self.wall.tolist())

    def take(self, index: Sequence[int] | IntArray) -> StationPoses:
        """Return the stations with these indices."""
        rows = np.asarray(index, int)
        return StationPoses(
            self.position_m[rows], self.yaw_rad[rows], self.tilt_rad[rows], self.wall[rows]
        )


def view_rotation(yaw_rad: Array, tilt_rad: Array) -> Array:
    """Return the rotations (..., 3, 3) of stations that look to azimuths and elevations (...)."""
    cy, sy, ct, st = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(tilt_rad), np.sin(tilt_rad)
    forward = np.stack([cy * ct, sy * ct, st], axis=-1)
    left = np.stack([-sy, cy, np.zeros_like(cy)], axis=-1)
    up = np.stack([-cy * st, -sy * st, ct], axis=-1)
    return np.stack([forward, left, up], axis=-1)


def working_points(room: Room, count: int) -> Array:
    """Return about ``count`` points (p, 3) on a regular grid in the working volume.

    They are the centres of equal cells; those in obstacles are omitted.

    Raises
    ------
    InputError
        No point is in the room and outside of obstacles.
    """
    outline = room.working_outline_m
    low_z, high_z = room.photodiode_z_m
    area = abs(signed_area(outline))
    if room.is_planar:
        step, levels = float(np.sqrt(area / count)), np.array([low_z])
    else:
        depth = high_z - low_z
        step = float((area * depth / count) ** (1 / 3))
        number = int(np.clip(round(depth / step), 2, 8))
        levels = low_z + depth * np.linspace(0.0, 1.0, number)
        step = float(np.sqrt(area * number / count))
    low, high = outline.min(axis=0), outline.max(axis=0)
    cells = [max(1, round(size / step)) for size in high - low]
    x, y = (
        start + (np.arange(n) + 0.5) * (end - start) / n
        for start, end, n in zip(low, high, cells, strict=True)
    )
    grid = np.stack(np.meshgrid(x, y, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    is_free = is_inside(outline, grid[:, :2]) & is_inside(room.outline_m, grid[:, :2])
    points = grid[is_free & ~in_obstacle(room, grid)]
    if not len(points):
        raise InputError(
            "the working volume is empty: it is outside the room or inside obstacles",
            hint="Check the working area, the heights of photodiodes and the obstacles",
        )
    return points


def candidates(room: Room, points_m: Array) -> StationPoses:
    """Return positions on the mounts of a room, each with several directions of view.

    Parameters
    ----------
    room : Room
    points_m : (p, 3) ndarray
        Points of the working volume: the stations look to their centre and to those of their parts.
    """
    position, wall = _mount_positions(room)
    targets = _targets(points_m)
    offset = targets[None] - position[:, None]
    across = np.hypot(offset[..., 0], offset[..., 1])
    # The azimuth of a view straight down is arbitrary.
    yaw = np.where(across > 1e-9, np.arctan2(offset[..., 1], offset[..., 0]), 0.0)
    tilt = np.clip(np.arctan2(offset[..., 2], across), -MAX_TILT_RAD, MAX_TILT_RAD)
    n = len(targets)
    poses = StationPoses(
        np.repeat(position, n, axis=0), yaw.ravel(), tilt.ravel(), np.repeat(wall, n)
    )
    down = np.flatnonzero(wall == CEILING)
    if not len(down):
        return poses
    turned = np.repeat(down, 2)
    extra = StationPoses(
        position[turned],
        np.tile([0.0, np.pi / 2], len(down)),
        np.full(len(turned), -MAX_TILT_RAD),
        wall[turned],
    )
    return _concatenate(poses, extra)


def mount_heights(room: Room) -> tuple[float, float]:
    """Return the lowest and the highest height of a station on a wall."""
    high = room.height_m - min(MOUNT_DEPTH_M, 0.25 * room.height_m)
    low = max(room.photodiode_z_m[1] + LOW_CLEARANCE_M, 0.5 * room.height_m)
    return min(low, high), high


def _mount_positions(room: Room) -> tuple[Array, IntArray]:
    """Return the positions (n, 3) of all mounts, and their kinds as in ``StationPoses.wall``."""
    low, high = mount_heights(room)
    heights = np.unique(np.round([low + f * (high - low) for f in HEIGHT_FRACTIONS], 6))
    found: list[tuple[Array, int]] = []
    if "wall" in room.mounts:
        lengths = np.array([length for _, _, length in _wall_frames(room)])
        step = lengths.sum() / WALL_POSITIONS
        for edge, (start, along, length) in enumerate(_wall_frames(room)):
            inset = min(MOUNT_DEPTH_M, 0.5 * length)
            number = max(2, int(np.ceil((length - 2 * inset) / step)) + 1)
            distances = np.linspace(inset, length - inset, number)
            if length < step:
                # Of the short walls of a rounded outline, those at multiples of the step.
                before = lengths[:edge].sum()
                is_used = before // step != (before + length) // step
                distances = np.full(int(is_used), 0.5 * length)
            for distance in distances:
                x, y = start + distance * along + _depth(room) * np.array([-along[1], along[0]])
                found += [(np.array([x, y, z]), edge) for z in heights]
    if "ceiling" in room.mounts:
        low_xy, high_xy = room.outline_m.min(axis=0), room.outline_m.max(axis=0)
        step = np.sqrt(abs(signed_area(room.outline_m)) / CEILING_POSITIONS)
        cells = np.maximum(1, np.round((high_xy - low_xy) / step).astype(int))
        x, y = (
            low_xy[k] + (np.arange(cells[k]) + 0.5) * (high_xy[k] - low_xy[k]) / cells[k]
            for k in (0, 1)
        )
        for each in np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2):
            found.append((np.array([*each, high]), CEILING))
    if "tripod" in room.mounts:
        found += [(each, TRIPOD) for each in room.tripods_m]
    position = np.array([each for each, _ in found]).reshape(-1, 3)
    kind = np.array([edge for _, edge in found], int)
    is_free = is_inside(room.outline_m, position[:, :2]) & ~in_obstacle(room, position)
    if not np.any(is_free):
        raise InputError(
            "no station can be mounted: all mounts are outside the room or in obstacles",
            hint="Check the outline, the obstacles and the positions of tripods",
        )
    return position[is_free], kind[is_free]


def _depth(room: Room) -> float:
    """Return the distance of stations from walls, smaller in very small rooms."""
    return float(min(MOUNT_DEPTH_M, 0.05 * np.ptp(room.outline_m, axis=0).min()))


def _wall_frames(room: Room) -> list[tuple[Array, Array, float]]:
    """Return start, direction and length of each wall; the room is to its left."""
    edges = np.roll(room.outline_m, -1, axis=0) - room.outline_m
    lengths = np.hypot(*edges.T)
    return [
        (start, edge / length, float(length))
        for start, edge, length in zip(room.outline_m, edges, lengths, strict=True)
    ]


def _targets(points_m: Array) -> Array:
    """Return the centre of points, and the centres of their four quarters in plan."""
    centre = points_m.mean(axis=0)
    targets = [centre]
    for right in (False, True):
        for upper in (False, True):
            is_part = ((points_m[:, 0] > centre[0]) == right) & (
                (points_m[:, 1] > centre[1]) == upper
            )
            if np.any(is_part):
                targets.append(points_m[is_part].mean(axis=0))
    return np.array(targets)


def _concatenate(first: StationPoses, second: StationPoses) -> StationPoses:
    return StationPoses(
        np.concatenate([first.position_m, second.position_m]),
        np.concatenate([first.yaw_rad, second.yaw_rad]),
        np.concatenate([first.tilt_rad, second.tilt_rad]),
        np.concatenate([first.wall, second.wall]),
    )


def percentile(sigma: Array) -> float:
    """Return the 95th percentile of values of which some may be infinite."""
    return float(np.sort(sigma)[int(np.ceil(PERCENTILE / 100 * len(sigma))) - 1])


# ---- the cost of a placement


def seen_stations(
    room: Room,
    position_m: Array,
    rotation: Array,
    points_m: Array,
    request: RoomRequest,
    *,
    gradient: Array | None = None,
) -> NDArray[np.bool_]:
    """Return True (s, p) for the stations in view of points, without robots in between.

    ``gradient`` is that of :func:`~locatk.core.lighthouse.design.accuracy.angle_gradients`, if it
    is known already.
    """
    # Several stations at one position differ in their direction of view only.
    position, which = np.unique(position_m, axis=0, return_inverse=True)
    is_clear = has_line_of_sight(room, position, points_m)
    if request.facing == "up":
        is_clear &= faces(position, points_m)
    is_seen = is_clear[np.asarray(which).ravel()] & in_field_of_view(
        position_m, rotation, points_m, request.field_of_view_rad, request.max_range_m
    )
    if gradient is None:
        gradient = angle_gradients(position_m, rotation, points_m)
    return np.asarray(is_seen & np.all(np.isfinite(gradient), axis=(-2, -1)))


@dataclass(frozen=True)
class Views:
    """What c candidates contribute at p points.

    Attributes
    ----------
    info : (c, p, d, d) ndarray
        Information, with the noise and the calibration errors of the angles; 0 if unseen.
    is_seen : (c, p) bool ndarray
    free : (c, p) ndarray
        Fraction of time in which the point receives the station: 0 if unseen, otherwise reduced by
        other robots only.
    position_m : (c, 3) ndarray
    """

    info: Array
    is_seen: NDArray[np.bool_]
    free: Array
    position_m: Array

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.free)

    def take(self, index: Sequence[int] | IntArray) -> Views:
        """Return those of the candidates with these indices."""
        rows = np.asarray(index, int)
        return Views(self.info[rows], self.is_seen[rows], self.free[rows], self.position_m[rows])


def joined_views(first: Views, second: Views) -> Views:
    """Return the views of the candidates of both."""
    return Views(
        np.concatenate([first.info, second.info]),
        np.concatenate([first.is_seen, second.is_seen]),
        np.concatenate([first.free, second.free]),
        np.concatenate([first.position_m, second.position_m]),
    )


class PlacementProblem:
    """Cost of stations in a room: places without enough stations first, then standard deviations.

    Parameters
    ----------
    room : Room
    request : RoomRequest
    points_m : (p, 3) ndarray, optional
        Places that are compared.

    Attributes
    ----------
    points_m : (p, 3) ndarray
    """

    def __init__(self, room: Room, request: RoomRequest, points_m: Array | None = None) -> None:
        self.room, self.request = room, request
        self.points_m = working_points(room, SEARCH_POINTS) if points_m is None else points_m
        self.min_seen = request.seen_by(room)
        self._dims = 2 if room.is_planar else 3
        self._area_m2 = abs(signed_area(room.working_outline_m))
        self._prior = np.eye(self._dims) / PRIOR_SIGMA_M**2

    def views(self, poses: StationPoses) -> Views:
        """Return the views of stations."""
        return self.views_of(poses.position_m, poses.rotation)

    def views_of(self, position_m: Array, rotation: Array) -> Views:
        """Return the views of stations at positions (c, 3) with rotations (c, 3, 3)."""
        points = self.points_m
        position, which = np.unique(position_m, axis=0, return_inverse=True)
        which = np.asarray(which).ravel()
        gradient = angle_gradients(position_m, rotation, points)
        is_seen = seen_stations(
            self.room, position_m, rotation, points, self.request, gradient=gradient
        )
        blocked = blocked_fraction(self.room.robots, self._area_m2, position, points)[which]
        local = np.einsum("spi,sij->spj", points[None] - position_m[:, None], rotation)
        systematic = calibration_sigma(local, self.request.calibration == "factory")
        sigma_rad = np.hypot(ANGLE_SIGMA_RAD, systematic)
        info = information(gradient, is_seen, self._dims, sigma_rad)
        return Views(info, is_seen, np.where(is_seen, 1.0 - blocked, 0.0), position_m)

    def cost(self, views: Views) -> float:
        """Return the cost of all stations of ``views`` together."""
        state = self._state(views)
        return float(self._costs(state.info[None], state.seen[None])[0])

    def costs_with(self, stations: Views, views: Views) -> Array:
        """Return the costs (c,) of ``stations`` with each one of ``views`` added.

        They are infinite for those that are closer than :data:`MIN_SEPARATION_M` to a station.
        """
        state = self._state(stations)
        costs = np.empty(len(views))
        chunk = max(1, 200_000 // len(self.points_m))
        for first in range(0, len(costs), chunk):
            rows = slice(first, first + chunk)
            more = state.added(views.info[rows], views.free[rows])
            costs[rows] = self._costs(more.info, more.seen)
        offset = views.position_m[:, None] - stations.position_m[None]
        is_close = np.any(np.linalg.norm(offset, axis=-1) < MIN_SEPARATION_M, axis=1)
        return np.where(is_close, np.inf, costs)

    def _state(self, views: Views) -> _State:
        """Return the sums over the stations of ``views``."""
        p = len(self.points_m)
        seen = np.zeros((p, self.min_seen))
        seen[:, 0] = 1.0
        state = _State(np.zeros((p, self._dims, self._dims)), seen)
        for k in range(len(views)):
            state = state.added(views.info[k], views.free[k])
        return state

    def _costs(self, info: Array, seen: Array) -> Array:
        """Return the costs (c,) by information (c, p, d, d) and probabilities (c, p, k)."""
        # Expected number of stations that are missing: column j is the probability of j < k.
        missing = seen @ np.arange(self.min_seen, 0, -1.0) / self.min_seen
        sigma = np.sqrt(variance_of(info + self._prior))
        mean = sigma.mean(axis=1)
        is_undetermined = sigma > UNDETERMINED_SIGMA_M
        missing = np.where(is_undetermined, np.maximum(missing, 1.0 / self.min_seen), missing)
        spread = mean
        if self.request.criterion == "worst":
            spread = np.percentile(sigma, PERCENTILE, axis=1) + MEAN_WEIGHT * mean
        return np.asarray(SHORTFALL_WEIGHT_M * missing.mean(axis=1) + spread)


@dataclass(frozen=True)
class _State:
    """Sums over some stations: information (..., p, d, d), and probabilities (..., p, k) that 0 to
    k - 1 stations are seen."""

    info: Array
    seen: Array

    def added(self, info: Array, free: Array) -> _State:
        seen = self.seen * (1.0 - free[..., None])
        seen[..., 1:] += self.seen[..., :-1] * free[..., None]
        return _State(self.info + info, seen)


# ---- search


def choose_stations(problem: PlacementProblem, views: Views, count: int) -> list[int]:
    """Choose candidates by greedy searches with exchanges.

    The first search is greedy; the others begin with random candidates, as many as
    :data:`SEARCH_BUDGET` allows.

    Parameters
    ----------
    problem : PlacementProblem
    views : Views
        Of all candidates.
    count : int

    Returns
    -------
    list of int
        Indices of the candidates of the best search; fewer than ``count`` if the mounts are too
        close to each other.
    """
    random = np.random.default_rng(0)
    steps = views.is_seen.size * count * (1 + TYPICAL_ROUNDS)
    searches = int(np.clip(SEARCH_BUDGET // steps, 1, MAX_STARTS))
    best: tuple[float, list[int]] | None = None
    for search in range(searches):
        chosen: list[int] = []
        if search:
            chosen = random.choice(len(views), min(count, len(views)), replace=False).tolist()
            chosen = _separated(views, chosen)
        while len(chosen) < count:
            extended = extend(problem, views, chosen)
            if len(extended) == len(chosen):
                break
            chosen = extended
        chosen, cost = exchange(problem, views, chosen)
        if best is None or (-len(chosen), cost) < (-len(best[1]), best[0]):
            best = cost, chosen
    assert best is not None  # there is at least one search
    return best[1]


def _separated(views: Views, chosen: list[int]) -> list[int]:
    """Return the candidates that are not too close to earlier ones."""
    kept: list[int] = []
    for index in chosen:
        offset = views.position_m[kept] - views.position_m[index]
        if np.all(np.linalg.norm(offset, axis=-1) >= MIN_SEPARATION_M):
            kept.append(index)
    return kept


def extend(problem: PlacementProblem, views: Views, chosen: list[int]) -> list[int]:
    """Return ``chosen`` with the candidate that lowers the cost most, if one has space."""
    costs = problem.costs_with(views.take(chosen), views)
    best = int(np.argmin(costs))
    return [*chosen, best] if np.isfinite(costs[best]) else chosen


def exchange(
    problem: PlacementProblem, views: Views, chosen: list[int], max_rounds: int = 20
) -> tuple[list[int], float]:
    """Replace one station at a time by a better candidate until none is better.

    Returns
    -------
    chosen : list of int
    cost : float
    """
    chosen = list(chosen)
    cost = problem.cost(views.take(chosen))
    for _ in range(max_rounds):
        before = cost
        for k in range(len(chosen)):
            costs = problem.costs_with(views.take(chosen[:k] + chosen[k + 1 :]), views)
            best = int(np.argmin(costs))
            if costs[best] < cost * (1 - 1e-9):
                chosen[k], cost = best, float(costs[best])
        if not cost < before * (1 - 1e-4):
            break
    return chosen, cost


def refine(
    problem: PlacementProblem, poses: StationPoses, fixed: Views | None = None
) -> StationPoses:
    """Move stations along their mounts, and turn them, as long as the cost falls.

    A station on a wall moves along it and in height, one under the ceiling in both horizontal
    directions; one on a tripod turns only. ``fixed`` are the views of stations that stay.
    """
    views = problem.views(poses)
    if fixed is not None:
        views = joined_views(views, fixed)
    cost = problem.cost(views)
    for length_m, angle_rad in REFINEMENT_STEPS:
        for _ in range(MAX_REFINEMENT_ROUNDS):
            before = cost
            for k in range(len(poses)):
                others = views.take([i for i in range(len(views)) if i != k])
                moves = _moves(problem.room, poses.take([k]), length_m, angle_rad)
                seen = problem.views(moves)
                costs = problem.costs_with(others, seen)
                best = int(np.argmin(costs))
                if costs[best] < cost:
                    cost = float(costs[best])
                    poses = _replaced(poses, k, moves.take([best]))
                    views = _with_view(views, k, seen.take([best]))
            if not cost < before * (1 - 1e-3):
                break
    return poses


def _replaced(poses: StationPoses, k: int, new: StationPoses) -> StationPoses:
    order = [*range(k), len(poses), *range(k + 1, len(poses))]
    return _concatenate(poses, new).take(order)


def _with_view(views: Views, k: int, new: Views) -> Views:
    info, is_seen, free = views.info.copy(), views.is_seen.copy(), views.free.copy()
    position_m = views.position_m.copy()
    info[k], is_seen[k], free[k] = new.info[0], new.is_seen[0], new.free[0]
    position_m[k] = new.position_m[0]
    return Views(info, is_seen, free, position_m)


def _moves(room: Room, pose: StationPoses, length_m: float, angle_rad: float) -> StationPoses:
    """Return the poses one step from that of a station."""
    wall = int(pose.wall[0])
    low, high = mount_heights(room)
    shifts = np.zeros((0, 3))
    if wall >= 0:
        along = np.array([*_wall_frames(room)[wall][1], 0.0])
        shifts = length_m * np.array([along, -along, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    elif wall == CEILING:
        shifts = length_m * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    position = pose.position_m + shifts
    position[:, 2] = np.clip(position[:, 2], low, high) if wall >= 0 else position[:, 2]
    if wall >= 0:
        start, direction, length = _wall_frames(room)[wall]
        inset = min(MOUNT_DEPTH_M, 0.5 * length)
        distance = np.clip((position[:, :2] - start) @ direction, inset, length - inset)
        inwards = np.array([-direction[1], direction[0]])
        position[:, :2] = start + distance[:, None] * direction + _depth(room) * inwards
    is_free = is_inside(room.outline_m, position[:, :2]) & ~in_obstacle(room, position)
    position = position[is_free]
    n = len(position)
    yaw, tilt = float(pose.yaw_rad[0]), float(pose.tilt_rad[0])
    moved = StationPoses(position, np.full(n, yaw), np.full(n, tilt), np.full(n, wall))
    turns = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]) * angle_rad
    turned = StationPoses(
        np.repeat(pose.position_m, 4, axis=0),
        yaw + turns[:, 0],
        np.clip(tilt + turns[:, 1], -MAX_TILT_RAD, MAX_TILT_RAD),
        np.full(4, wall),
    )
    return _concatenate(moved, turned)


def place_stations(
    problem: PlacementProblem, count: int, evaluations: int | None = None
) -> StationPoses:
    """Return the poses of ``count`` stations with a low cost.

    The result of the search and random placements are compared by their accuracy in a solved scene
    (:class:`SolvedCost`), which takes more time to compute than that of the search; the best ones
    are refined. ``evaluations`` limits this effort, see :data:`SOLVED_EVALUATIONS`.
    """
    poses = candidates(problem.room, problem.points_m)
    views = problem.views(poses)
    found = refine(problem, poses.take(choose_stations(problem, views, count)))
    # The grid of the search has gaps at the edges of beams.
    fine = working_points(problem.room, REFINEMENT_POINTS)
    found = refine(PlacementProblem(problem.room, problem.request, fine), found)
    effort = SOLVED_EVALUATIONS if evaluations is None else evaluations
    part = min(effort // (len(found) ** 2 * (1 + REFINED_STARTS)), MAX_PART)
    function = SolvedCost(problem.room, problem.request)
    useful = np.flatnonzero(np.any(views.is_seen, axis=1))
    random = np.random.default_rng(0)
    starts = [found]
    for _ in range(part if len(useful) >= count else 0):
        start = poses.take(random.choice(useful, count, replace=False))
        if is_separated(start.position_m):
            starts.append(start)
    costs = [function(start) for start in starts]
    order = np.argsort(costs, kind="stable")[:REFINED_STARTS]
    refined = [refine_solved(problem.room, function, starts[k], part) for k in order]
    return rounded(min(refined, key=function))


def refine_solved(
    room: Room, function: SolvedCost, poses: StationPoses, evaluations: int
) -> StationPoses:
    """Move and turn stations as long as positions in the solved scene become more accurate.

    At most about ``evaluations`` placements are compared.
    """
    cost = function(poses)
    for length_m, angle_rad in REFINEMENT_STEPS:
        improves = True
        while improves:
            improves = False
            for k in range(len(poses)):
                if evaluations <= 0:
                    return poses
                moves = _moves(room, poses.take([k]), length_m, angle_rad)
                options = [_replaced(poses, k, moves.take([i])) for i in range(len(moves))]
                options = [each for each in options if is_separated(each.position_m)]
                evaluations -= len(options)
                costs = [function(each) for each in options]
                if costs and min(costs) < cost * (1 - 1e-3):
                    cost = min(costs)
                    poses = options[costs.index(cost)]
                    improves = True
    return poses


class SolvedCost:
    """Cost of stations in a solved scene: uncovered places first, then standard deviations.

    Parameters
    ----------
    room : Room
    request : RoomRequest
    """

    def __init__(self, room: Room, request: RoomRequest) -> None:
        self.room, self.request = room, request
        self.points_m = working_points(room, SOLVED_POINTS)
        self._coverage_points_m = working_points(room, REFINEMENT_POINTS)
        self.min_seen = request.seen_by(room)

    def __call__(self, poses: StationPoses) -> float:
        """Return the cost in metres."""
        return self.cost(poses.position_m, poses.rotation)

    def cost(self, position_m: Array, rotation: Array) -> float:
        """Return the cost of stations at positions (s, 3) with rotations (s, 3, 3)."""
        sigma = self.sigmas(position_m, rotation)
        is_covered = np.isfinite(sigma)
        if not np.any(is_covered):
            return SHORTFALL_WEIGHT_M
        # Places without coverage count by the finer grid.
        sigma = np.minimum(sigma[is_covered], PRIOR_SIGMA_M)
        mean = float(sigma.mean())
        spread = mean
        if self.request.criterion == "worst":
            spread = float(np.percentile(sigma, PERCENTILE)) + MEAN_WEIGHT * mean
        uncovered = self.uncovered_fraction(position_m, rotation)
        uncovered = max(0.0, uncovered - COVERAGE_TOLERANCE)
        uncovered += float(np.mean(sigma > UNDETERMINED_SIGMA_M))
        return SHORTFALL_WEIGHT_M * uncovered + spread

    def uncovered_fraction(self, position_m: Array, rotation: Array) -> float:
        """Return the fraction of the working volume that sees too few stations."""
        is_seen = seen_stations(
            self.room, position_m, rotation, self._coverage_points_m, self.request
        )
        return float(np.mean(is_seen.sum(axis=0) < self.min_seen))

    def sigmas(self, position: Array, rotation: Array) -> Array:
        """Return the standard deviations (p,) of positions; infinite for places not covered."""
        points = self.points_m
        is_seen = seen_stations(self.room, position, rotation, points, self.request)
        accuracy = predict_solved_positions(
            position,
            rotation,
            points,
            is_seen,
            is_planar=self.room.is_planar,
            has_factory_data=[self.request.calibration == "factory"] * len(position),
        )
        is_covered = is_seen.sum(axis=0) >= self.min_seen
        return np.where(is_covered, accuracy.sigma_m, np.inf)


def rounded(poses: StationPoses) -> StationPoses:
    """Return poses in centimetres and degrees, which can be measured by hand."""
    return replace(
        poses,
        position_m=np.round(poses.position_m, POSITION_DECIMALS),
        yaw_rad=np.radians(np.round(np.degrees(poses.yaw_rad))),
        tilt_rad=np.radians(np.round(np.degrees(poses.tilt_rad))),
    )


def is_separated(position_m: Array) -> bool:
    """Return True if no two positions (s, 3) are closer than :data:`MIN_SEPARATION_M`."""
    offset = position_m[:, None] - position_m[None]
    distance = np.linalg.norm(offset, axis=-1) + np.eye(len(position_m)) * MIN_SEPARATION_M
    return bool(np.all(distance >= MIN_SEPARATION_M))


def grow_placements(problem: PlacementProblem) -> Iterator[StationPoses]:
    """Yield placements of 1, 2, ... stations, each grown from the one before.

    A station is added, and each one is exchanged once, so that they are not quite as good as those
    of :func:`place_stations`.
    """
    poses = candidates(problem.room, problem.points_m)
    views = problem.views(poses)
    chosen: list[int] = []
    for _ in range(MAX_STATIONS):
        extended = extend(problem, views, chosen)
        if len(extended) == len(chosen):
            return
        chosen, _ = exchange(problem, views, extended, max_rounds=1)
        yield poses.take(chosen)


def ordered(room: Room, poses: StationPoses) -> StationPoses:
    """Return stations counter-clockwise around the room, so that channels are easy to find."""
    centre = 0.5 * (room.outline_m.min(axis=0) + room.outline_m.max(axis=0))
    offset = poses.position_m[:, :2] - centre
    # From the corner at the smallest x and y on, as the outline of a rectangle.
    angle = (np.arctan2(offset[:, 1], offset[:, 0]) + 0.75 * np.pi + 1e-3) % (2 * np.pi)
    return replace(poses.take(np.argsort(angle, kind="stable")))
