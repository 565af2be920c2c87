"""Placement of base stations in a room.

Stations are chosen from candidates on the mounts by a greedy search, improved by exchanging one
station at a time, and then moved continuously along their mounts
(:mod:`~locatk.core.lighthouse.design.mounts`). The information matrices of all candidates at all
points of a grid are computed once; those of several stations are their sums.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
from locatk.core.lighthouse.design.mounts import StationPoses, candidates, moves, rounded
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

SEARCH_POINTS = 400
"""Number of points of the working volume at which placements are compared."""

REFINEMENT_POINTS = 1200
"""Number of points at which the result of the search is refined."""

COVERAGE_TOLERANCE = 0.005
"""Fraction of the working volume that may stay without coverage in favour of accuracy elsewhere:
the last corners would cost a third of the accuracy of a 10 x 10 m room."""

SOLVED_POINTS = 200
"""Number of points at which accuracy in a solved scene is compared."""

SOLVED_EVALUATIONS = 12_000
"""Number of comparisons in solved scenes, times the square of the number of stations: about four
seconds."""

MAX_EVALUATIONS_PER_STAGE = 250
"""Largest number of random placements, and of comparisons in a refinement."""

REFINED_STARTS = 2
"""Number of placements that are refined in solved scenes."""

PRIOR_SIGMA_M = 1.0
"""Standard deviation of a position before any station is seen [m]: it makes points comparable that
are not yet determined. Covered points have errors of millimetres."""

REFINEMENT_STEPS = ((0.5, 0.2), (0.25, 0.1), (0.1, 0.05), (0.05, 0.02))
"""Steps of positions [m] and of angles [rad] of the refinement, one after the other."""

UNDETERMINED_SIGMA_M = 0.25
"""Standard deviation from which on a point counts as not covered, however many stations it sees:
they are at almost the same position or in line with it."""

ESTIMATED_EXCHANGE_ROUNDS = 3
"""Number of rounds of exchanges until a search ends."""

MAX_REFINEMENT_ROUNDS = 20
"""Largest number of rounds over all stations with one step."""

SHORTFALL_WEIGHT_M = 1e3
"""Cost of a point without the wanted stations, relative to errors in metres: coverage is first."""

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
        Largest standard deviation of positions at 95 % of the points.
    criterion : str
        ``"worst"`` minimises the 95th percentile of the standard deviations, ``"mean"`` their mean.
    min_seen : int or None
        Number of stations that each point must see; None for 1 if the room is planar, otherwise 2.
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

    def required_stations(self, room: Room) -> int:
        """Return the number of stations that each point of a room must see."""
        if self.min_seen is not None:
            return self.min_seen
        return 1 if room.is_planar else 2


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


def percentile_95(sigma: Array) -> float:
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
    """Information and visibility of c candidates at p points.

    Attributes
    ----------
    info : (c, p, d, d) ndarray
        Information, with the noise and the calibration errors of the angles; 0 if unseen.
    is_seen : (c, p) bool ndarray
    free_fraction : (c, p) ndarray
        Fraction of time in which the point receives the station: 0 if unseen, otherwise reduced by
        other robots only.
    position_m : (c, 3) ndarray
    """

    info: Array
    is_seen: NDArray[np.bool_]
    free_fraction: Array
    position_m: Array

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.free_fraction)

    def take(self, index: Sequence[int] | IntArray) -> Views:
        """Return those of the candidates with these indices."""
        rows = np.asarray(index, int)
        return Views(
            self.info[rows], self.is_seen[rows], self.free_fraction[rows], self.position_m[rows]
        )

    def joined(self, other: Views) -> Views:
        """Return the views of the candidates of both."""
        return Views(
            np.concatenate([self.info, other.info]),
            np.concatenate([self.is_seen, other.is_seen]),
            np.concatenate([self.free_fraction, other.free_fraction]),
            np.concatenate([self.position_m, other.position_m]),
        )

    def replaced(self, index: int, new: Views) -> Views:
        """Return the views with that of ``new`` in place of the one with this index."""
        return self.joined(new).take([*range(index), len(self), *range(index + 1, len(self))])


class PlacementProblem:
    """Cost of stations in a room: points without enough stations first, then standard deviations.

    Parameters
    ----------
    room : Room
    request : RoomRequest
    points_m : (p, 3) ndarray, optional
        Points that are compared.

    Attributes
    ----------
    points_m : (p, 3) ndarray
    """

    def __init__(self, room: Room, request: RoomRequest, points_m: Array | None = None) -> None:
        self.room, self.request = room, request
        self.points_m = working_points(room, SEARCH_POINTS) if points_m is None else points_m
        self.min_seen = request.required_stations(room)
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
            more = state.added(views.info[rows], views.free_fraction[rows])
            costs[rows] = self._costs(more.info, more.seen)
        offset = views.position_m[:, None] - stations.position_m[None]
        is_close = np.any(np.linalg.norm(offset, axis=-1) < MIN_SEPARATION_M, axis=1)
        return np.where(is_close, np.inf, costs)

    def _state(self, views: Views) -> _StationSums:
        """Return the sums over the stations of ``views``."""
        p = len(self.points_m)
        seen = np.zeros((p, self.min_seen))
        seen[:, 0] = 1.0
        state = _StationSums(np.zeros((p, self._dims, self._dims)), seen)
        for k in range(len(views)):
            state = state.added(views.info[k], views.free_fraction[k])
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
class _StationSums:
    """Sums over some stations: information (..., p, d, d), and probabilities (..., p, k) that 0 to
    k - 1 stations are seen."""

    info: Array
    seen: Array

    def added(self, info: Array, free_fraction: Array) -> _StationSums:
        seen = self.seen * (1.0 - free_fraction[..., None])
        seen[..., 1:] += self.seen[..., :-1] * free_fraction[..., None]
        return _StationSums(self.info + info, seen)


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
    steps = views.is_seen.size * count * (1 + ESTIMATED_EXCHANGE_ROUNDS)
    searches = int(np.clip(SEARCH_BUDGET // steps, 1, MAX_STARTS))
    starts: list[list[int]] = [[]]
    for _ in range(searches - 1):
        start = random.choice(len(views), min(count, len(views)), replace=False).tolist()
        starts.append(_separated(views, start))
    found = [exchange(problem, views, _filled(problem, views, start, count)) for start in starts]
    chosen, _ = min(found, key=lambda each: (-len(each[0]), each[1]))
    return chosen


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


def _filled(problem: PlacementProblem, views: Views, chosen: list[int], count: int) -> list[int]:
    """Return ``chosen`` extended to ``count`` candidates, or to as many as have space."""
    while len(chosen) < count:
        extended = extend(problem, views, chosen)
        if len(extended) == len(chosen):
            break
        chosen = extended
    return chosen


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


def refine(problem: PlacementProblem, poses: StationPoses) -> StationPoses:
    """Move stations along their mounts, and turn them, as long as the cost falls."""
    views = problem.views(poses)
    cost = problem.cost(views)
    for length_m, angle_rad in REFINEMENT_STEPS:
        for _ in range(MAX_REFINEMENT_ROUNDS):
            before = cost
            for k in range(len(poses)):
                others = views.take([i for i in range(len(views)) if i != k])
                steps = moves(problem.room, poses.take([k]), length_m, angle_rad)
                seen = problem.views(steps)
                costs = problem.costs_with(others, seen)
                best = int(np.argmin(costs))
                if costs[best] < cost:
                    cost = float(costs[best])
                    poses = poses.replaced(k, steps.take([best]))
                    views = views.replaced(k, seen.take([best]))
            if not cost < before * (1 - 1e-3):
                break
    return poses


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
    part = min(effort // (len(found) ** 2 * (1 + REFINED_STARTS)), MAX_EVALUATIONS_PER_STAGE)
    starts = [found, *_random_starts(poses, views, count, part)]
    solved_cost = SolvedCost(problem.room, problem.request)
    costs = [solved_cost(start) for start in starts]
    order = np.argsort(costs, kind="stable")[:REFINED_STARTS]
    refined = [refine_solved(problem.room, solved_cost, starts[k], part) for k in order]
    return rounded(min(refined, key=solved_cost))


def _random_starts(
    poses: StationPoses, views: Views, count: int, number: int
) -> list[StationPoses]:
    """Return up to ``number`` placements of random candidates that see a point each."""
    useful = np.flatnonzero(np.any(views.is_seen, axis=1))
    if len(useful) < count:
        return []
    random = np.random.default_rng(0)
    starts = [poses.take(random.choice(useful, count, replace=False)) for _ in range(number)]
    return [start for start in starts if is_separated(start.position_m)]


def refine_solved(
    room: Room, solved_cost: SolvedCost, poses: StationPoses, evaluations: int
) -> StationPoses:
    """Move and turn stations as long as positions in the solved scene become more accurate.

    At most about ``evaluations`` placements are compared.
    """
    cost = solved_cost(poses)
    for length_m, angle_rad in REFINEMENT_STEPS:
        improves = True
        while improves:
            improves = False
            for k in range(len(poses)):
                if evaluations <= 0:
                    return poses
                options = _separated_moves(room, poses, k, length_m, angle_rad)
                evaluations -= len(options)
                costs = [solved_cost(each) for each in options]
                if costs and min(costs) < cost * (1 - 1e-3):
                    cost = min(costs)
                    poses = options[costs.index(cost)]
                    improves = True
    return poses


def _separated_moves(
    room: Room, poses: StationPoses, k: int, length_m: float, angle_rad: float
) -> list[StationPoses]:
    """Return the placements one step of station ``k`` away in which no stations are too close."""
    steps = moves(room, poses.take([k]), length_m, angle_rad)
    options = [poses.replaced(k, steps.take([i])) for i in range(len(steps))]
    return [each for each in options if is_separated(each.position_m)]


class SolvedCost:
    """Cost of stations in a solved scene: uncovered points first, then standard deviations.

    Parameters
    ----------
    room : Room
    request : RoomRequest
    """

    def __init__(self, room: Room, request: RoomRequest) -> None:
        self.room, self.request = room, request
        self.points_m = working_points(room, SOLVED_POINTS)
        self._coverage_points_m = working_points(room, REFINEMENT_POINTS)
        self.min_seen = request.required_stations(room)

    def __call__(self, poses: StationPoses) -> float:
        """Return the cost in metres."""
        return self.cost(poses.position_m, poses.rotation)

    def cost(self, position_m: Array, rotation: Array) -> float:
        """Return the cost of stations at positions (s, 3) with rotations (s, 3, 3)."""
        sigma = self.sigmas(position_m, rotation)
        is_covered = np.isfinite(sigma)
        if not np.any(is_covered):
            return SHORTFALL_WEIGHT_M
        # Points without coverage count by the finer grid.
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
        """Return the standard deviations (p,) of positions; infinite for points not covered."""
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
