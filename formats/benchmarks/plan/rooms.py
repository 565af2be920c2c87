"""Figures of the placement of Lighthouse stations: against exhaustive search, and its time."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from locatk.core.lighthouse.design import RoomRequest, design_room
from locatk.core.lighthouse.design.mounts import candidates
from locatk.core.lighthouse.design.placement import (
    PlacementProblem,
    Views,
    choose_stations,
    is_separated,
    refine,
    working_points,
)
from locatk.core.lighthouse.room import Obstacle, Room
from locatk.core.polygons import rectangle
from locatk.formats.benchmarks.figures import Figure, measure_or_explain
from locatk.formats.benchmarks.timing import time_call

ROOMS = 20

CANDIDATES = {2: 120, 3: 40, 4: 24}
"""Candidates of a room by the number of stations: 7,140, 9,880 and 10,626 combinations."""

POINTS = 80

FIRST_SEED = 25_700

LARGE_ROOM = Room(rectangle(10.0, 10.0), 3.0, (0.0, 1.5))


def figures(data: Path) -> list[Figure]:
    """Return the figures; no recording is used."""
    time = Figure(
        "room design: 4 stations, 10 x 10 x 3 m",
        None,
        "s",
        "places in space up to 1.5 m, with the report; processor time of one call",
        target=10.0,
        workload="numpy",
    )
    placement = Figure("station placement: excess over exhaustive search", None, "%", "")
    return [
        *measure_or_explain(_excess, placement),
        time.timed(time_call(lambda: design_room(LARGE_ROOM, RoomRequest(4)), repeats=1)),
    ]


def _excess() -> list[Figure]:
    """Compare the search with the best combination of the same candidates."""
    found, refined = [], []
    for number in range(ROOMS):
        best, own, after = compare_room(number)
        found.append(own / best - 1.0)
        refined.append(after / best - 1.0)
    return [
        Figure(
            "station placement: excess over exhaustive search",
            100.0 * max(found),
            "%",
            f"largest of {ROOMS} random rooms with 2 to 4 stations, from the same candidates "
            f"({', '.join(f'{n} stations: {c}' for n, c in CANDIDATES.items())}); cost is "
            f"coverage, then the 95th percentile of sigma. Mean {100 * np.mean(found):.2f} %; "
            f"after the continuous refinement {100 * np.mean(refined):.0f} % (largest "
            f"{100 * max(refined):.0f} %)",
            target=5.0,
        )
    ]


def compare_room(number: int) -> tuple[float, float, float]:
    """Return the costs of exhaustive search, of the search, and after its refinement."""
    rng = np.random.default_rng(FIRST_SEED + number)
    count = 2 + number % 3
    room = draw_room(rng)
    problem = PlacementProblem(room, RoomRequest(count), working_points(room, POINTS))
    poses = candidates(room, problem.points_m)
    poses = poses.take(rng.permutation(len(poses))[: CANDIDATES[count]])
    views = problem.views(poses)
    chosen = choose_stations(problem, views, count)
    after = refine(problem, poses.take(chosen))
    return (
        exhaustive_cost(problem, views, count),
        problem.cost(views.take(chosen)),
        problem.cost(problem.views(after)),
    )


def draw_room(rng: np.random.Generator) -> Room:
    """Draw a room: half of them planar, half of them with an obstacle, a third L-shaped."""
    length, width = rng.uniform(3.0, 8.0, 2).tolist()
    outline = rectangle(length, width)
    if rng.random() < 1 / 3:
        x, y = 0.6 * length, 0.55 * width
        outline = np.array([[0, 0], [length, 0], [length, y], [x, y], [x, width], [0, width]])
    obstacles: tuple[Obstacle, ...] = ()
    if rng.random() < 0.5:
        obstacles = (Obstacle(rectangle(0.6, 0.6, (0.2 * length, 0.2 * width)), 0.0, 1.8),)
    z = (0.1, 0.1) if rng.random() < 0.5 else (0.0, 1.2)
    return Room(outline, float(rng.uniform(2.4, 3.5)), z, obstacles=obstacles)


def exhaustive_cost(problem: PlacementProblem, views: Views, count: int) -> float:
    """Return the lowest cost of all combinations of candidates."""
    best = np.inf
    for chosen in itertools.combinations(range(len(views)), count - 1):
        last = range(chosen[-1] + 1, len(views))
        if len(last) and is_separated(views.position_m[list(chosen)]):
            costs = problem.costs_with(views.take(list(chosen)), views.take(list(last)))
            best = min(best, float(costs.min()))
    return best
