"""Figures of global localization on the map of 24 x 24 landmarks, with windows of an L.

Only the cell filter is tested. It receives synthetic observations: the code of the map (or, if a
landmark is misread, another code at each visit) as the only hypothesis with a probability of 1, a
pose with the covariance of a single pass, and odometry with nominal errors. Whole sessions are in
:mod:`.sessions`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERNS, code_of, rotated
from locatk.core.landmarks.localization.cell_filter import (
    MIN_CELL_PROBABILITY,
    Belief,
    CellEstimate,
    CellModel,
    OtherFloor,
    map_probability,
)
from locatk.core.landmarks.map.floor import STEPS, Cell, FloorMap, neighbour
from locatk.core.landmarks.map.windows import window_path, window_readings
from locatk.core.landmarks.simulation.options import Errors
from locatk.core.landmarks.simulation.sensors import odometry
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.trajectory import PROVISIONAL_PROBABILITY
from locatk.formats.artifacts.map_library import library_maps
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]

MAP_SIDE = 24

MISREAD_FRACTION = 0.05

WALK_LANDMARKS = 8

START_STRIDE = 1
"""Step between measured starts, in the list of all starts of a floor."""

MAX_LISTED_WALKS = 10

STOP_SIGMA_M, STOP_SIGMA_RAD = 2.4e-3, math.radians(1.0)
"""Standard deviations of the pose at which the robot stops at a landmark: 3 mm on average."""

POSE_SIGMA_M, POSE_SIGMA_RAD = 0.5e-3, math.radians(0.5)
"""Standard deviations of the poses of synthetic observations along each axis."""

WINDOW_NAMES = {"L": "L", "I2": "I2", "I3": "I3", "S": "2x2"}
"""Letters of windows in the names of published maps."""

PUBLISHED_SIDES = {
    "id6_L_7x7": 7, "id6_S_17x17": 17, "or16_I2_8x8": 8, "or16_I3_28x28": 28,
    "or16_L_24x24": 24, "or16_S_100x100": 100,
}  # fmt: skip
"""Maps of the data folder, and their sides."""


def read_published(folder: Path, name: str) -> FloorMap:
    """Read a published map: a title, and a line of letters for each row.

    Raises
    ------
    OSError
        The file cannot be read.
    ValueError
        The file is not a map of this size.
    """
    alphabet, window, _ = name.split("_")
    lines = (folder / f"{name}.txt").read_text(encoding="ascii").split("\n")[1:]
    values = np.array([[int(letter, 16) for letter in line] for line in lines if line.strip()])
    if values.shape != (PUBLISHED_SIDES[name],) * 2:
        raise ValueError(f"{name}.txt has {values.shape} letters")
    if alphabet == "id6":
        values = np.array([code_of(letters) for letters in PATTERNS])[values]
    return FloorMap(
        values.astype(np.int64),
        alphabet="6" if alphabet == "id6" else "16",
        window=WINDOW_NAMES[window],
    )


def standard_floor(folder: Path) -> tuple[FloorMap, str]:
    """Return the published map of 24 x 24, or a part of the supplied map; and its source."""
    try:
        return read_published(folder, "or16_L_24x24"), "published map"
    except OSError:
        return supplied_floor()


def supplied_floor() -> tuple[FloorMap, str]:
    """Return a part of 24 x 24 landmarks of the supplied map, and its source."""
    entry = next(e for e in library_maps() if (e.alphabet, e.window, e.detect) == ("16", "L", 0))
    codes = entry.codes()[:MAP_SIDE, :MAP_SIDE]
    return FloorMap(codes), f"cut of {entry.file}, which ships"


def global_figures(folder: Path) -> list[Figure]:
    """Return all figures of the filter; ``folder`` contains the published maps."""
    floor, source = standard_floor(folder)
    return [*perfect_figures(floor, source), *misread_figures(floor, source)]


# ---- synthetic observations


@dataclass(frozen=True)
class Walk:
    """Stops of a robot, in order.

    Attributes
    ----------
    cells : tuple of cell
    quarters : tuple of int
        Heading at each stop, in quarter turns.
    """

    cells: tuple[Cell, ...]
    quarters: tuple[int, ...]

    @property
    def stops(self) -> list[tuple[Cell, int]]:
        """Cell and heading of each stop."""
        return list(zip(self.cells, self.quarters, strict=True))


def window_walks(floor: FloorMap) -> list[Walk]:
    """Return the walk over the window from each start (cell, heading) that has one."""
    readings = window_readings(floor)
    steps = np.diff(window_path(floor.window, 0), axis=0, prepend=[[0, -1]])
    turns = [STEPS.index((int(rows), int(columns))) for rows, columns in steps]
    return [
        Walk(
            tuple((int(row), int(column)) for row, column in cells),
            tuple((int(heading) + turn) % 4 for turn in turns),
        )
        for cells, heading in zip(readings.cells, readings.heading, strict=True)
    ]


def random_walk(
    floor: FloorMap,
    start: Cell,
    heading: int,
    rng: np.random.Generator,
    count: int = WALK_LANDMARKS,
) -> Walk:
    """Walk over ``count`` landmarks, straight ahead or to a side, if possible to new cells."""
    cells, quarters = [start], [heading]
    while len(cells) < count:
        passable = [
            h for h in ((heading + turn) % 4 for turn in (0, 1, 3))
            if floor.is_passable(cells[-1], h)
        ] or [(heading + 2) % 4]  # fmt: skip
        new = [h for h in passable if neighbour(cells[-1], h) not in cells] or passable
        heading = int(rng.choice(new))
        cells.append(neighbour(cells[-1], heading))
        quarters.append(heading)
    return Walk(tuple(cells), tuple(quarters))


def simulate_observations(
    floor: FloorMap, walk: Walk, misread: dict[Cell, int], rng: np.random.Generator
) -> list[VisitHypotheses]:
    """Simulate the observations of a walk; ``misread`` gives the codes of misread landmarks."""
    poses = _stop_poses(floor, walk, rng)
    odometry_poses = _simulate_odometry(poses, rng)
    sigma = np.array([POSE_SIGMA_M, POSE_SIGMA_M, POSE_SIGMA_RAD])
    unknown = np.full(4, np.nan)
    observations = []
    for n, (cell, quarters) in enumerate(walk.stops):
        code = misread.get(cell, int(floor.codes[cell]))
        angle = quarters * math.pi / 2
        cos, sin = math.cos(angle), math.sin(angle)
        x, y = poses[n, :2] - floor.position(cell)
        heading = math.remainder(poses[n, 2] - angle, math.tau)
        pose = [cos * x + sin * y, cos * y - sin * x, heading]
        hypothesis = Hypothesis(
            int(rotated(code, -quarters)), 1.0, pose + sigma * rng.standard_normal(3),
            np.diag(sigma**2), unknown, unknown,
        )  # fmt: skip
        observations.append(VisitHypotheses("robot", n, n, n + 1, odometry_poses[n], (hypothesis,)))
    return observations


def _stop_poses(floor: FloorMap, walk: Walk, rng: np.random.Generator) -> Array:
    """Return poses (n, 3) close to the landmarks' centres, with unwrapped headings."""
    turns = np.array([math.remainder(turn, 4) for turn in np.diff(walk.quarters)])
    heading = (walk.quarters[0] + np.concatenate([[0.0], np.cumsum(turns)])) * math.pi / 2
    position = np.array([floor.position(cell) for cell in walk.cells])
    count = len(walk.cells)
    position = position + rng.normal(0, STOP_SIGMA_M, (count, 2))
    return np.column_stack([position, heading + rng.normal(0, STOP_SIGMA_RAD, count)])


def _simulate_odometry(stops: Array, rng: np.random.Generator) -> Array:
    """Return the odometry (n, 3) at the stops, with nominal errors: rotate, drive, rotate."""
    poses, indices = [stops[0]], [0]
    for target in stops[1:]:
        start = poses[-1]
        offset = target[:2] - start[:2]
        direction = math.atan2(offset[1], offset[0])
        heading = start[2] + math.remainder(direction - start[2], math.tau)
        for corner in ([*start[:2], heading], [*target[:2], heading], target):
            fractions = np.linspace(0, 1, 11)[1:, None]
            poses += list(poses[-1] + fractions * (np.asarray(corner) - poses[-1]))
        indices.append(len(poses) - 1)
    return odometry(np.array(poses), Errors(), rng)[0][indices]


def random_misreadings(floor: FloorMap, rng: np.random.Generator) -> dict[Cell, int]:
    """Return other codes for a random twentieth of the landmarks."""
    cells = np.argwhere(rng.random(floor.shape) < MISREAD_FRACTION)
    return {
        (int(row), int(column)): int(
            (floor.codes[row, column] + rng.integers(1, CODE_COUNT)) % CODE_COUNT
        )
        for row, column in cells
    }


class LocalizedStop(NamedTuple):
    """Estimated cell and heading, and the probabilities of both and of the floor."""

    cell: Cell
    quarters: int
    probability: float
    map_probability: float

    @property
    def pose(self) -> tuple[Cell, int]:
        return self.cell, self.quarters


def localize_stops(
    floor: FloorMap, observations: Sequence[VisitHypotheses]
) -> tuple[list[LocalizedStop], list[LocalizedStop]]:
    """Return the estimate of each stop: after this stop, and after all stops."""
    model = CellModel(observations, floor, misread=SolveOptions().misread, drift=OdometryDrift())
    other, log_ratio = OtherFloor(model), 0.0
    beliefs: list[Belief] = []
    current: list[LocalizedStop] = []
    for number in range(len(observations)):
        belief, evidence = model.advance(beliefs[-1], number) if number else model.initial_belief()
        log_ratio += math.log(evidence / other.advance(number))
        beliefs.append(belief)
        current += _stops(model.estimates([belief]), log_ratio)
    return current, _stops(model.estimates(beliefs), log_ratio)


def _stops(estimates: Sequence[CellEstimate], log_ratio: float) -> list[LocalizedStop]:
    of_map = map_probability(log_ratio)
    return [LocalizedStop(each.cell, each.quarters, each.probability, of_map) for each in estimates]


# ---- figures


def perfect_figures(floor: FloorMap, source: str) -> list[Figure]:
    """Localize the three landmarks of the L from each start, all read correctly."""
    rng = np.random.default_rng(FIRST_SEED + 40)
    walks = window_walks(floor)[::START_STRIDE]
    correct, probability = [], []
    for walk in walks:
        _, stops = localize_stops(floor, simulate_observations(floor, walk, {}, rng))
        correct.append([stop.pose for stop in stops] == walk.stops)
        probability.append(stops[-1].probability)
    smallest, mean = min(probability), float(np.mean(probability))
    has_poses = [c and p >= MIN_CELL_PROBABILITY for c, p in zip(correct, probability, strict=True)]
    how = (
        f"{len(walks)} starts (cell, heading) with an L, {source}; the filter alone, all landmarks "
        "read correctly, nominal odometry"
    )
    return [
        Figure("24x24, 16/L: right after three landmarks", 100 * float(np.mean(correct)), "%",
               f"{how}: cell and heading of all three", 100.0, "higher",
               "paper: three landmarks", 100.0),
        Figure("24x24, 16/L: right and poses given after three",
               100 * float(np.mean(has_poses)), "%",
               f"of the same starts, at a probability of {MIN_CELL_PROBABILITY} or more; "
               f"smallest {smallest:.4f}, mean {mean:.4f}",
               100.0, "higher"),
    ]  # fmt: skip


def misread_figures(floor: FloorMap, source: str) -> list[Figure]:
    """Walk over a floor with a twentieth of the landmarks misread."""
    rows, columns = floor.shape
    starts = [(r, c, h) for r in range(rows) for c in range(columns) for h in range(4)]
    silently_wrong, remarked, landmarks_needed, walks_with_misreadings = [], 0, [], 0
    walks = starts[::START_STRIDE]
    for number, (row, column, heading) in enumerate(walks):
        rng = np.random.default_rng([FIRST_SEED + 41, number])
        walk = random_walk(floor, (row, column), heading, rng)
        misread = random_misreadings(floor, rng)
        walks_with_misreadings += any(cell in misread for cell in walk.cells)
        current, final = localize_stops(floor, simulate_observations(floor, walk, misread, rng))
        wrong = max(
            (
                each.probability * each.map_probability
                for each, true in zip([*current, *final], [*walk.stops, *walk.stops], strict=True)
                if each.pose != true
            ),
            default=0.0,
        )
        if wrong >= PROVISIONAL_PROBABILITY:
            silently_wrong.append(number)
        remarked += MIN_CELL_PROBABILITY <= wrong < PROVISIONAL_PROBABILITY
        certain = (
            number
            for number, each in enumerate(current, 1)
            if each.probability * each.map_probability >= PROVISIONAL_PROBABILITY
        )
        landmarks_needed.append(next(certain, math.inf))
    localized = [n for n in landmarks_needed if math.isfinite(n)] or [math.nan]
    how = (
        f"{len(walks)} random walks over {WALK_LANDMARKS} landmarks from every start, {source}, "
        f"{100 * MISREAD_FRACTION:.0f} % of the landmarks with another code at every visit "
        f"({walks_with_misreadings} walks met one); the filter alone"
    )
    listed = ", ".join(map(str, silently_wrong[:MAX_LISTED_WALKS]))
    return [
        Figure("5 % misread: wrong silently", float(len(silently_wrong)), "walks",
               f"{how}: a wrong cell or heading at a probability of {PROVISIONAL_PROBABILITY} or "
               f"more, after any of the landmarks or at the end{listed and f'; walks {listed}'}",
               0.0),
        Figure("5 % misread: wrong with a remark", 100 * remarked / len(walks), "%",
               f"of the same walks, at {MIN_CELL_PROBABILITY} to {PROVISIONAL_PROBABILITY}: poses "
               "are provisional"),
        Figure("5 % misread: landmarks needed", float(np.mean(localized)), "landmarks",
               f"mean until {PROVISIONAL_PROBABILITY} is reached; 99 % within "
               f"{np.quantile(localized, 0.99):.0f}", peer="paper, no fault", peer_value=3.0),
        Figure(f"5 % misread: certain within {WALK_LANDMARKS} landmarks",
               100 * float(np.mean(np.isfinite(landmarks_needed))), "%", "of the same walks",
               better="higher"),
    ]  # fmt: skip
