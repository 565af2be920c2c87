"""What a simulated robot does: the paper's search and tour, a path, or a single pass.

It steers by the truth and by the errors of its aims, not by its sensors: a simulator that
asked a solver where it is could not tell anything about that solver.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import pattern
from locatk.core.landmarks.map.floor import HOLE, STEPS, Cell, FloorMap, neighbour
from locatk.core.landmarks.simulation.floor import Laid
from locatk.core.landmarks.simulation.options import ASIDE_RAD, PASS_M, START_M, SimulationOptions
from locatk.core.landmarks.simulation.robot import Robot

Array = NDArray[np.float64]

QUARTER = math.pi / 2

TOURS: dict[str, tuple[int, ...]] = {
    "L": (0, 1),
    "I2": (0,),
    "I3": (0, 0),
    "2x2": (0, 1, 2),
    "3x3": (0, 0, 1, 2, 2, 1, 0, 0),
}
"""Headings of the steps from landmark to landmark of a window, in quarter turns from the
first one."""

TERRITORY_M = 0.060
"""Beyond this distance from a landmark a sensor feels none of its territory (54 mm)."""

VISIT_M = 0.045
"""A sensor as near to a landmark's centre is in its territory under any heading (r1)."""

SPIN_RAD = math.radians(370)

BACK_M = 0.05
"""A robot goes that far backwards rather than to turn around."""

TRIES = 2000

STEP_M = 0.005
"""Between points of a way that are asked whether the floor is free there."""


@dataclass(frozen=True)
class _Job:
    """What a robot is to do, where, and by which chance; ``notes`` are added to."""

    floor: FloorMap
    laid: Mapping[Cell, Laid]
    options: SimulationOptions
    rng: np.random.Generator
    notes: list[str]


def steer(
    floor: FloorMap, laid: Mapping[Cell, Laid], options: SimulationOptions
) -> tuple[Robot, list[str]]:
    """Drive; returns the robot at the end of its way, and what a user may not expect.

    Raises
    ------
    InputError
        There is no landmark, or none that the robot can do this with.
    """
    if not laid:
        raise InputError("a map without any landmark")
    rng = np.random.default_rng([options.seed, 20])
    notes: list[str] = []
    way = {"paper": _paper, "path": _path, "pass": _pass}[options.strategy]
    robot = way(_Job(floor, laid, options, rng, notes))
    robot.stand(options.rest_s)
    return robot, notes


def _begin(pose: Sequence[float] | Array, options: SimulationOptions) -> Robot:
    robot = Robot(np.asarray(pose, float), options.limits)
    robot.stand(options.rest_s)
    return robot


def _aim(place: Sequence[float], mean_m: float, rng: np.random.Generator) -> Array:
    """A place near another, off by ``mean_m`` on average, and never by much more."""
    sigma = mean_m / math.sqrt(QUARTER)
    off = rng.normal(0.0, sigma, 2)
    far = float(np.hypot(*off))
    return np.asarray(place, float) + off * min(1.0, 3 * sigma / far if far > 0 else 1.0)


# ---- the paper's way


def _paper(job: _Job) -> Robot:
    """Steps (a) to (p) of Fig. 12."""
    floor, laid, options, rng = job.floor, job.laid, job.options, job.rng
    aims = options.aims
    pose, cell, way = _search(job)
    robot = _begin(pose, options)
    robot.straight(way)
    mark = laid[cell]
    robot.go(_aim((mark.x_m, mark.y_m), aims.first_m, rng))
    tour = TOURS[floor.window]
    count = len(tour) + 1 if options.landmarks is None else options.landmarks
    spins = len(tour) + 1 if options.spins is None else options.spins
    headings = _tour(job, cell, float(robot.pose[2]), tour, count)
    for number in range(len(headings) + 1):
        if number:
            heading = headings[number - 1]
            cell = neighbour(cell, heading)
            mark = laid[cell]
            robot.face(heading * QUARTER + rng.normal(0.0, aims.heading_rad))
            robot.land(_aim((mark.x_m, mark.y_m), aims.step_m, rng))
        if number < spins:
            robot.turn(SPIN_RAD)
            robot.go(_aim((mark.x_m, mark.y_m), aims.second_m, rng), back_m=BACK_M)
            nearest = round((robot.pose[2] - mark.heading_rad) / QUARTER) * QUARTER
            robot.face(mark.heading_rad + nearest + rng.normal(0.0, aims.heading_rad))
        robot.stand(options.stop_s)
    return robot


def _search(job: _Job) -> tuple[Array, Cell, float]:
    """Where it starts, which landmark it meets, and how far it goes to pass that one."""
    floor, laid, options, rng = job.floor, job.laid, job.options, job.rng
    cells = list(laid)
    centre = np.array([[laid[cell].x_m, laid[cell].y_m] for cell in cells])
    reach = floor.geometry.circle_m + TERRITORY_M
    if options.start is not None:
        found = _met(floor, cells, centre, options.start)
        if found is None:
            x, y, heading = options.start
            raise InputError(
                f"a robot that starts at {x * 1e3:.0f},{y * 1e3:.0f} mm under "
                f"{math.degrees(heading):.0f} degrees meets no landmark",
                hint="Start it elsewhere, or leave it out for anywhere",
            )
        return np.array(options.start), *found
    for _ in range(TRIES):
        row, column = cells[rng.integers(len(cells))]
        x, y = floor.place((row, column)) + rng.uniform(-0.5, 0.5, 2) * floor.pitch_m
        start = (float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
        if np.hypot(*(centre - start[:2]).T).min() > reach:
            found = _met(floor, cells, centre, start)
            if found is not None:
                return np.array(start), *found
    raise InputError(
        "no place on the floor from which a robot could come upon a landmark",
        hint=f"Give --start x,y,deg, or a pitch above {2 * reach / math.sqrt(2) * 1e3:.0f} mm",
    )


def _met(
    floor: FloorMap, cells: Sequence[Cell], centre: Array, start: Sequence[float]
) -> tuple[Cell, float] | None:
    """The first landmark straight ahead, and the way to beyond it if the floor is free."""
    ahead = np.array([math.cos(start[2]), math.sin(start[2])])
    offset = centre - np.asarray(start[:2])
    along = offset @ ahead
    aside = offset @ [-ahead[1], ahead[0]]
    reach = floor.geometry.circle_m + TERRITORY_M
    near = np.flatnonzero((along > 0) & (np.abs(aside) < floor.geometry.circle_m + VISIT_M))
    if not len(near):
        return None
    k = near[np.argmin(along[near])]
    way = float(along[k] + math.sqrt(reach**2 - aside[k] ** 2))
    steps = np.arange(0.0, way + STEP_M, STEP_M)
    if not free(floor, np.asarray(start[:2]) + steps[:, None] * ahead):
        return None
    return cells[k], way


def free(floor: FloorMap, points: Array) -> bool:
    """Whether a robot can go along points (n, 2): no hole, no wall, no end of the map.

    A point belongs to the nearest cell.
    """
    x, y = floor.origin_m
    cells = np.rint((points[:, ::-1] - [y, x]) / floor.pitch_m).astype(int)
    if (cells < 0).any() or (cells >= floor.shape).any():
        return False
    if (floor.codes[cells[:, 0], cells[:, 1]] == HOLE).any():
        return False
    for k in np.flatnonzero(np.any(np.diff(cells, axis=0), axis=1)):
        here = (int(cells[k, 0]), int(cells[k, 1]))
        row, column = cells[k + 1] - cells[k]
        turns = [STEPS.index(step) for step in ((int(row), 0), (0, int(column))) if any(step)]
        # Over a corner it goes if one of the ways around it is free.
        for order in (turns, turns[::-1]):
            at = here
            for heading in order:
                if not floor.open(at, heading):
                    break
                at = neighbour(at, heading)
            else:
                break
        else:
            return False
    return True


def _tour(job: _Job, cell: Cell, heading_rad: float, tour: Sequence[int], count: int) -> list[int]:
    """Headings in quarter turns, from landmark to landmark: the window's tour, then any.

    The tour goes the way that needs the least turn, mirrored where it goes none.
    """
    floor, notes = job.floor, job.notes
    facing = heading_rad / QUARTER
    ways = sorted(range(4), key=lambda q: abs(math.remainder(q - facing, 4)))
    tours = [[(q + side * turn) % 4 for turn in tour] for side in (1, -1) for q in ways]
    headings: list[int] = next((way for way in tours if _open(floor, cell, way)), [])
    if not headings and count > 1:
        notes.append(f"no window {floor.window} from cell {cell[0]},{cell[1]}: went at random")
    del headings[count - 1 :]
    at = cell
    for heading in headings:
        at = neighbour(at, heading)
    while len(headings) < count - 1:
        choice = [q for q in range(4) if floor.open(at, q)]
        if not choice:
            notes.append(f"no way on from cell {at[0]},{at[1]}: {count} landmarks not reached")
            break
        onward = [q for q in choice if not headings or (q - headings[-1]) % 4 != 2]
        headings.append(int(job.rng.choice(onward or choice)))
        at = neighbour(at, headings[-1])
    return headings


def _open(floor: FloorMap, cell: Cell, headings: Sequence[int]) -> bool:
    for heading in headings:
        if not floor.open(cell, heading):
            return False
        cell = neighbour(cell, heading)
    return True


# ---- other ways


def _path(job: _Job) -> Robot:
    """From waypoint to waypoint, turning on each, with a stop on cells."""
    floor, laid, options = job.floor, job.laid, job.options
    places: list[Sequence[float]] = list(options.waypoints)
    for cell in options.cells:
        mark = laid.get(cell)
        if mark is None:
            raise InputError(
                f"a path over cell {cell[0]},{cell[1]}, where the map has no landmark",
                hint=f"Name cells row,column of {floor.shape[0]} x {floor.shape[1]}",
            )
        places.append((mark.x_m, mark.y_m))
    aimed = [_aim(place, options.aims.step_m, job.rng) for place in places]
    line = np.concatenate(
        [
            np.linspace(one, other, 2 + int(np.hypot(*(other - one)) / STEP_M))
            for one, other in pairwise(aimed)
        ]
    )
    if not free(floor, line):
        job.notes.append("the path leaves the map, or goes over a hole or through a wall")
    dx, dy = aimed[1] - aimed[0]
    robot = _begin([*aimed[0], math.atan2(dy, dx)], options)
    for place in aimed[1:]:
        robot.go(place)
        if options.cells:
            robot.stand(options.stop_s)
    return robot


def _pass(job: _Job) -> Robot:
    """One straight pass over one landmark from the circle of starts (section 3.5)."""
    laid, options, rng = job.laid, job.options, job.rng
    cells = [
        cell
        for cell, mark in laid.items()
        if options.pattern in ("", pattern(mark.designed)) and options.cell in (None, cell)
    ]
    if not cells:
        where = "" if options.cell is None else f" in cell {options.cell[0]},{options.cell[1]}"
        raise InputError(f"the map has no landmark {options.pattern}{where}".replace("  ", " "))
    cell = cells[rng.integers(len(cells))]
    mark = laid[cell]
    angle = rng.uniform(-math.pi, math.pi)
    aside = rng.uniform(-ASIDE_RAD, ASIDE_RAD)
    if options.approach_rad is not None:
        angle = options.approach_rad
    if options.lateral_m is not None:
        # To the left of a centre is where that lies to the right of the way.
        aside = math.asin(options.lateral_m / START_M)
    robot = _begin(
        [
            mark.x_m + START_M * math.cos(angle),
            mark.y_m + START_M * math.sin(angle),
            angle + math.pi + aside,
        ],
        options,
    )
    robot.straight(PASS_M)
    return robot
