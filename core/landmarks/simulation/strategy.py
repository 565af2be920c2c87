"""Paths of a simulated robot that is steered by the truth: search and tour, a path, one pass.

The robot is steered by the truth and by the errors of its aims, not by its sensors: sessions of a
robot that follows a solver would favour that solver. A robot that is driven by its sensors is in
:mod:`.closed_loop`.
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
from locatk.core.landmarks.map.floor import HOLE_CODE, STEPS, Cell, FloorMap, neighbour
from locatk.core.landmarks.simulation.floor import InstalledLandmark
from locatk.core.landmarks.simulation.options import (
    MAX_HEADING_OFFSET_RAD,
    PASS_LENGTH_M,
    START_RADIUS_M,
    SimulationOptions,
)
from locatk.core.landmarks.simulation.robot import Robot

Array = NDArray[np.float64]

QUARTER_TURN_RAD = math.pi / 2

TOURS: dict[str, tuple[int, ...]] = {
    "L": (0, 1),
    "I2": (0,),
    "I3": (0, 0),
    "2x2": (0, 1, 2),
    "3x3": (0, 0, 1, 2, 2, 1, 0, 0),
}
"""Headings of the steps between the landmarks of a window, in quarter turns from the first."""

MAX_TERRITORY_M = 0.060
"""Distance from a landmark beyond which a sensor is outside its territory: r2 = 54 mm and a
margin."""

VISIT_RADIUS_M = 0.045
"""A sensor this close to a landmark's centre is in its territory in any direction (r1)."""

SPIN_RAD = math.radians(370)
"""Rotation of a spin: a revolution, and a margin for the error of the odometry."""

MAX_BACKING_M = 0.05
"""Largest distance that a robot drives backwards to save a rotation."""

MAX_START_DRAWS = 2000
"""Random starts that are tried before giving up."""

CHECK_STEP_M = 0.005
"""Distance between the points of a path at which the floor is checked."""


@dataclass(frozen=True)
class _Task:
    """Inputs of a strategy; ``notes`` are appended."""

    floor: FloorMap
    landmarks: Mapping[Cell, InstalledLandmark]
    options: SimulationOptions
    rng: np.random.Generator
    notes: list[str]


def steer(
    floor: FloorMap, landmarks: Mapping[Cell, InstalledLandmark], options: SimulationOptions
) -> tuple[Robot, list[str]]:
    """Return a robot at the end of its path, and notes on what a user may not expect.

    Raises
    ------
    InputError
        There is no landmark, or none with which the strategy is possible.
    """
    if not landmarks:
        raise InputError("a map without any landmark")
    rng = np.random.default_rng([options.seed, 20])
    notes: list[str] = []
    strategy = {"paper": _search_and_tour, "path": _follow_path, "pass": _single_pass}
    robot = strategy[options.strategy](_Task(floor, landmarks, options, rng, notes))
    robot.wait(options.rest_s)
    return robot, notes


def start_of_search(
    floor: FloorMap, landmarks: Mapping[Cell, InstalledLandmark], options: SimulationOptions
) -> Robot:
    """Return a robot at rest at the start of a search, facing the first landmark on its path.

    Raises
    ------
    InputError
        There is no landmark, or no start from which one is met.
    """
    if not landmarks:
        raise InputError("a map without any landmark")
    rng = np.random.default_rng([options.seed, 20])
    pose, _, _ = _find_start(_Task(floor, landmarks, options, rng, []))
    return _at_rest(pose, options)


def _at_rest(pose: Sequence[float] | Array, options: SimulationOptions) -> Robot:
    robot = Robot(np.asarray(pose, float), options.limits)
    robot.wait(options.rest_s)
    return robot


def _draw_aim(position: Sequence[float], mean_m: float, rng: np.random.Generator) -> Array:
    """Draw a position near another: ``mean_m`` off on average, and 3 sigma at most."""
    sigma = mean_m / math.sqrt(math.pi / 2)  # The mean of a Rayleigh distribution.
    offset = rng.normal(0.0, sigma, 2)
    distance = float(np.hypot(*offset))
    factor = min(1.0, 3 * sigma / distance if distance > 0 else 1.0)
    return np.asarray(position, float) + offset * factor


# ---- search and tour


def _search_and_tour(task: _Task) -> Robot:
    """Follow steps (a) to (p) of Fig. 12."""
    floor, landmarks, options, rng = task.floor, task.landmarks, task.options, task.rng
    aims = options.aims
    pose, cell, path_m = _find_start(task)
    robot = _at_rest(pose, options)
    robot.straight(path_m)
    mark = landmarks[cell]
    robot.drive_to(_draw_aim((mark.x_m, mark.y_m), aims.first_m, rng))
    tour = TOURS[floor.window]
    count = len(tour) + 1 if options.landmarks is None else options.landmarks
    spins = len(tour) + 1 if options.spins is None else options.spins
    headings = _plan_tour(task, cell, float(robot.pose[2]), tour, count)
    for number in range(len(headings) + 1):
        if number:
            heading = headings[number - 1]
            cell = neighbour(cell, heading)
            mark = landmarks[cell]
            robot.face(heading * QUARTER_TURN_RAD + rng.normal(0.0, aims.heading_rad))
            robot.land_at(_draw_aim((mark.x_m, mark.y_m), aims.step_m, rng))
        if number < spins:
            robot.rotate(SPIN_RAD)
            aim = _draw_aim((mark.x_m, mark.y_m), aims.second_m, rng)
            robot.drive_to(aim, back_m=MAX_BACKING_M)
            quarters = round((robot.pose[2] - mark.heading_rad) / QUARTER_TURN_RAD)
            aligned = mark.heading_rad + quarters * QUARTER_TURN_RAD
            robot.face(aligned + rng.normal(0.0, aims.heading_rad))
        robot.wait(options.stop_s)
    return robot


def _find_start(task: _Task) -> tuple[Array, Cell, float]:
    """Return the start, the landmark that is met first, and the path length to pass it."""
    floor, landmarks, options, rng = task.floor, task.landmarks, task.options, task.rng
    cells = list(landmarks)
    centres = np.array([[landmarks[cell].x_m, landmarks[cell].y_m] for cell in cells])
    range_m = floor.geometry.circle_m + MAX_TERRITORY_M
    if options.start is not None:
        met = _first_landmark_ahead(floor, cells, centres, options.start)
        if met is None:
            x, y, heading = options.start
            raise InputError(
                f"a robot that starts at {x * 1e3:.0f},{y * 1e3:.0f} mm under "
                f"{math.degrees(heading):.0f} degrees meets no landmark",
                hint="Choose another start, or leave it out to have one drawn",
            )
        return np.array(options.start), *met
    for _ in range(MAX_START_DRAWS):
        row, column = cells[rng.integers(len(cells))]
        x, y = floor.position((row, column)) + rng.uniform(-0.5, 0.5, 2) * floor.pitch_m
        start = (float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
        if np.hypot(*(centres - start[:2]).T).min() > range_m:
            met = _first_landmark_ahead(floor, cells, centres, start)
            if met is not None:
                return np.array(start), *met
    raise InputError(
        "no position on the floor from which a robot could meet a landmark",
        hint="Set start in the table robot of the --config file, or use a pitch above "
        f"{2 * range_m / math.sqrt(2) * 1e3:.0f} mm",
    )


def _first_landmark_ahead(
    floor: FloorMap, cells: Sequence[Cell], centres: Array, start: Sequence[float]
) -> tuple[Cell, float] | None:
    """Return the first landmark straight ahead and the path length to pass it.

    None if there is none, or if the floor is not free up to there.
    """
    ahead = np.array([math.cos(start[2]), math.sin(start[2])])
    offset = centres - np.asarray(start[:2])
    along = offset @ ahead
    lateral = offset @ [-ahead[1], ahead[0]]
    range_m = floor.geometry.circle_m + MAX_TERRITORY_M
    met = (along > 0) & (np.abs(lateral) < floor.geometry.circle_m + VISIT_RADIUS_M)
    candidates = np.flatnonzero(met)
    if not len(candidates):
        return None
    k = candidates[np.argmin(along[candidates])]
    path_m = float(along[k] + math.sqrt(range_m**2 - lateral[k] ** 2))
    steps = np.arange(0.0, path_m + CHECK_STEP_M, CHECK_STEP_M)
    if not is_free(floor, np.asarray(start[:2]) + steps[:, None] * ahead):
        return None
    return cells[k], path_m


def is_free(floor: FloorMap, points: Array) -> bool:
    """Return whether a robot can drive along points (n, 2): no hole, no wall, not off the map.

    A point belongs to the nearest cell.
    """
    x, y = floor.origin_m
    cells = np.rint((points[:, ::-1] - [y, x]) / floor.pitch_m).astype(int)
    if (cells < 0).any() or (cells >= floor.shape).any():
        return False
    if (floor.codes[cells[:, 0], cells[:, 1]] == HOLE_CODE).any():
        return False
    for k in np.flatnonzero(np.any(np.diff(cells, axis=0), axis=1)):
        start = (int(cells[k, 0]), int(cells[k, 1]))
        row, column = cells[k + 1] - cells[k]
        headings = [STEPS.index(step) for step in ((int(row), 0), (0, int(column))) if any(step)]
        # A diagonal step is free if one of the two paths around the corner is.
        for order in (headings, headings[::-1]):
            cell = start
            for heading in order:
                if not floor.is_passable(cell, heading):
                    break
                cell = neighbour(cell, heading)
            else:
                break
        else:
            return False
    return True


def _plan_tour(
    task: _Task, cell: Cell, heading_rad: float, tour: Sequence[int], count: int
) -> list[int]:
    """Return headings from landmark to landmark in quarter turns: the window's tour, then random.

    Of the possible tours, the one with the smallest rotation is taken; the mirrored ones only if
    none of the others is possible.
    """
    floor, notes = task.floor, task.notes
    facing = heading_rad / QUARTER_TURN_RAD
    starts = sorted(range(4), key=lambda q: abs(math.remainder(q - facing, 4)))
    tours = [[(q + side * step) % 4 for step in tour] for side in (1, -1) for q in starts]
    headings: list[int] = next((tour for tour in tours if _is_open(floor, cell, tour)), [])
    if not headings and count > 1:
        notes.append(f"no window {floor.window} from cell {cell[0]},{cell[1]}: went at random")
    del headings[count - 1 :]
    last = cell
    for heading in headings:
        last = neighbour(last, heading)
    while len(headings) < count - 1:
        choice = [q for q in range(4) if floor.is_passable(last, q)]
        if not choice:
            missing = count - 1 - len(headings)
            notes.append(
                f"no step on from cell {last[0]},{last[1]}: {missing} landmarks not reached"
            )
            break
        onward = [q for q in choice if not headings or (q - headings[-1]) % 4 != 2]
        headings.append(int(task.rng.choice(onward or choice)))
        last = neighbour(last, headings[-1])
    return headings


def _is_open(floor: FloorMap, cell: Cell, headings: Sequence[int]) -> bool:
    for heading in headings:
        if not floor.is_passable(cell, heading):
            return False
        cell = neighbour(cell, heading)
    return True


# ---- path and single pass


def _follow_path(task: _Task) -> Robot:
    """Drive from waypoint to waypoint, with a rotation at each and a stop at cells."""
    floor, landmarks, options = task.floor, task.landmarks, task.options
    positions: list[Sequence[float]] = list(options.waypoints)
    for cell in options.cells:
        mark = landmarks.get(cell)
        if mark is None:
            raise InputError(
                f"a path over cell {cell[0]},{cell[1]}, where the map has no landmark",
                hint=f"Name cells row,column of {floor.shape[0]} x {floor.shape[1]}",
            )
        positions.append((mark.x_m, mark.y_m))
    aims = [_draw_aim(position, options.aims.step_m, task.rng) for position in positions]
    line = np.concatenate(
        [
            np.linspace(start, end, 2 + int(np.hypot(*(end - start)) / CHECK_STEP_M))
            for start, end in pairwise(aims)
        ]
    )
    if not is_free(floor, line):
        task.notes.append("the path leaves the map, or goes over a hole or through a wall")
    dx, dy = aims[1] - aims[0]
    robot = _at_rest([*aims[0], math.atan2(dy, dx)], options)
    for aim in aims[1:]:
        robot.drive_to(aim)
        if options.cells:
            robot.wait(options.stop_s)
    return robot


def _single_pass(task: _Task) -> Robot:
    """Drive one straight pass over one landmark from the circle of starts (section 3.5)."""
    landmarks, options, rng = task.landmarks, task.options, task.rng
    cells = [
        cell
        for cell, mark in landmarks.items()
        if options.pattern in ("", pattern(mark.designed)) and options.cell in (None, cell)
    ]
    if not cells:
        where = "" if options.cell is None else f" in cell {options.cell[0]},{options.cell[1]}"
        raise InputError(
            f"the map has no landmark {options.pattern}{where}".replace("  ", " "),
            hint="A cell is row,column from 0; `locatk info` draws the map",
        )
    cell = cells[rng.integers(len(cells))]
    mark = landmarks[cell]
    angle = rng.uniform(-math.pi, math.pi)
    offset_rad = rng.uniform(-MAX_HEADING_OFFSET_RAD, MAX_HEADING_OFFSET_RAD)
    if options.approach_rad is not None:
        angle = options.approach_rad
    if options.lateral_m is not None:
        # The robot is to the left of the centre if the centre is to the right of its path.
        offset_rad = math.asin(options.lateral_m / START_RADIUS_M)
    robot = _at_rest(
        [
            mark.x_m + START_RADIUS_M * math.cos(angle),
            mark.y_m + START_RADIUS_M * math.sin(angle),
            angle + math.pi + offset_rad,
        ],
        options,
    )
    robot.straight(PASS_LENGTH_M)
    return robot
