"""Global localization on the map of 24 x 24 landmarks read with their orientation, by L.

The filter alone is fed by hand-made sightings: what the map says (or, where a landmark is
misread, any other code, each time that it is visited) as the only hypothesis, with a
probability of 1, a pose with the covariance of a plain pass, and odometry of nominal
errors. Whole sessions are in :mod:`.landmarks_sessions`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERNS, code_of, rotated
from locatk.core.landmarks.localization import cell_filter as globalize
from locatk.core.landmarks.localization.cell_filter import MIN_CELL_PROBABILITY
from locatk.core.landmarks.localization.consistency import CERTAIN_PROBABILITY
from locatk.core.landmarks.map.floor import STEPS, Cell, FloorMap, neighbour
from locatk.core.landmarks.map.windows import window_path, window_readings
from locatk.core.landmarks.simulation.options import Errors
from locatk.core.landmarks.simulation.sensors import odometry
from locatk.core.landmarks.solver import SolveOptions
from locatk.formats.artifacts.map_library import entries
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import SEED

Array = NDArray[np.float64]

SIDE = 24

MISREAD = 0.05

LONGEST = 8
"""Landmarks of a walk."""

WALKS = 1
"""From each start, with misread landmarks."""

EVERY = 1
"""One start in so many is measured."""

STOP_M, STOP_RAD = 2.4e-3, math.radians(1.0)
"""How far off a landmark's centre and its heading the robot stops: 3 mm in the mean."""

SEEN_M, SEEN_RAD = 0.5e-3, math.radians(0.5)
"""Standard deviations of poses of hand-made sightings along each axis."""

WINDOWS = {"L": "L", "I2": "I2", "I3": "I3", "S": "2x2"}
"""Letters in the names of published maps."""

PUBLISHED = {
    "id6_L_7x7": 7, "id6_S_17x17": 17, "or16_I2_8x8": 8, "or16_I3_28x28": 28,
    "or16_L_24x24": 24, "or16_S_100x100": 100,
}  # fmt: skip
"""Maps of the data folder and their sides."""


def read_published(folder: Path, name: str) -> FloorMap:
    """A published map: a line that says what it is, and a line of letters for each row.

    Raises
    ------
    OSError, ValueError
        It is not there, or no such map.
    """
    alphabet, window, _ = name.split("_")
    lines = (folder / f"{name}.txt").read_text(encoding="ascii").split("\n")[1:]
    values = np.array([[int(letter, 16) for letter in line] for line in lines if line.strip()])
    if values.shape != (PUBLISHED[name],) * 2:
        raise ValueError(f"{name}.txt has {values.shape} letters")
    if alphabet == "id6":
        values = np.array([code_of(letters) for letters in PATTERNS])[values]
    return FloorMap(
        values.astype(np.int64),
        alphabet="6" if alphabet == "id6" else "16",
        window=WINDOWS[window],
    )


def the_floor(folder: Path) -> tuple[FloorMap, str]:
    """The published map of 24 x 24, else one cut of the map that ships; and which it is."""
    try:
        return read_published(folder, "or16_L_24x24"), "published map"
    except OSError:
        entry = next(e for e in entries() if (e.alphabet, e.window, e.detect) == ("16", "L", 0))
        return FloorMap(entry.codes()[:SIDE, :SIDE]), f"cut of {entry.file}, which ships"


def global_figures(folder: Path) -> list[Figure]:
    """All figures of the filter; ``folder`` has the published maps."""
    floor, which = the_floor(folder)
    return [
        *perfect_figures(floor, which),
        *misread_figures(floor, which),
    ]


# ---- sightings by hand


@dataclass(frozen=True)
class Walk:
    """Where a robot has stopped, in order.

    Attributes
    ----------
    cells : tuple of cell
    quarters : tuple of int
        Its heading at each, in quarter turns.
    """

    cells: tuple[Cell, ...]
    quarters: tuple[int, ...]


def windows_of(floor: FloorMap) -> list[Walk]:
    """The window from every start (cell, heading) that has one."""
    found = window_readings(floor)
    turns = np.diff(window_path(floor.window, 0), axis=0, prepend=[[0, -1]])
    turn = [STEPS.index((int(a), int(b))) for a, b in turns]
    return [
        Walk(
            tuple((int(r), int(c)) for r, c in cells),
            tuple((int(heading) + t) % 4 for t in turn),
        )
        for cells, heading in zip(found.cells, found.heading, strict=True)
    ]


def random_walk(floor: FloorMap, start: Cell, heading: int, rng: np.random.Generator) -> Walk:
    """On from a start, straight or after a turn, to cells not visited yet if there are any."""
    cells, quarters = [start], [heading]
    while len(cells) < LONGEST:
        open_ = [
            h for h in ((heading + t) % 4 for t in (0, 1, 3)) if floor.is_passable(cells[-1], h)
        ] or [(heading + 2) % 4]
        fresh = [h for h in open_ if neighbour(cells[-1], h) not in cells] or open_
        heading = int(rng.choice(fresh))
        cells.append(neighbour(cells[-1], heading))
        quarters.append(heading)
    return Walk(tuple(cells), tuple(quarters))


def sightings(
    floor: FloorMap, walk: Walk, laid: dict[Cell, int], rng: np.random.Generator
) -> list[VisitHypotheses]:
    """What is seen on a walk over landmarks laid as ``laid`` says, else as the map does."""
    stops = _stops(floor, walk, rng)
    told = _odometry(stops, rng)
    sigma = np.array([SEEN_M, SEEN_M, SEEN_RAD])
    unknown = np.full(4, np.nan)
    seen = []
    for n, (cell, quarters) in enumerate(zip(walk.cells, walk.quarters, strict=True)):
        code = laid.get(cell, int(floor.codes[cell]))
        turn = quarters * math.pi / 2
        cos, sin = math.cos(turn), math.sin(turn)
        x, y = stops[n, :2] - floor.position(cell)
        pose = [cos * x + sin * y, cos * y - sin * x, math.remainder(stops[n, 2] - turn, math.tau)]
        hypothesis = Hypothesis(
            int(rotated(code, -quarters)), 1.0, pose + sigma * rng.standard_normal(3),
            np.diag(sigma**2), unknown, unknown,
        )  # fmt: skip
        seen.append(VisitHypotheses("robot", n, n, n + 1, told[n], (hypothesis,)))
    return seen


def _stops(floor: FloorMap, walk: Walk, rng: np.random.Generator) -> Array:
    """Poses (n, 3) near the landmarks' centres, the heading without jumps."""
    turns = np.array([math.remainder(t, 4) for t in np.diff(walk.quarters)])
    heading = (walk.quarters[0] + np.concatenate([[0.0], np.cumsum(turns)])) * math.pi / 2
    place = np.array([floor.position(cell) for cell in walk.cells])
    count = len(walk.cells)
    place = place + rng.normal(0, STOP_M, (count, 2))
    return np.column_stack([place, heading + rng.normal(0, STOP_RAD, count)])


def _odometry(stops: Array, rng: np.random.Generator) -> Array:
    """Poses (n, 3) at the stops by wheels of nominal errors: turn, go straight, turn."""
    poses, at = [stops[0]], [0]
    for target in stops[1:]:
        here = poses[-1]
        way = target[:2] - here[:2]
        along = here[2] + math.remainder(math.atan2(way[1], way[0]) - here[2], math.tau)
        for corner in ([*here[:2], along], [*target[:2], along], target):
            steps = np.linspace(0, 1, 11)[1:, None]
            poses += list(poses[-1] + steps * (np.asarray(corner) - poses[-1]))
        at.append(len(poses) - 1)
    return odometry(np.array(poses), Errors(), rng)[0][at]


def misread(floor: FloorMap, rng: np.random.Generator) -> dict[Cell, int]:
    """Landmarks that are taken for any other code, one in twenty."""
    hit = np.argwhere(rng.random(floor.shape) < MISREAD)
    return {
        (int(r), int(c)): int((floor.codes[r, c] + rng.integers(1, CODE_COUNT)) % CODE_COUNT)
        for r, c in hit
    }


def told_places(
    floor: FloorMap, seen: Sequence[VisitHypotheses]
) -> tuple[list[tuple[Cell, int, float]], list[tuple[Cell, int, float]]]:
    """Cell, heading and probability of the last sighting after each of them, and of all
    sightings in the end."""
    drift, rate = OdometryDrift(), SolveOptions().misread
    so_far, places = [], []
    for count in range(1, len(seen) + 1):
        places = globalize.identify_cells(seen[:count], floor, misread=rate, drift=drift)
        last = places[-1]
        so_far.append((last.cell, last.quarters, last.probability))
    return so_far, [(one.cell, one.quarters, one.probability) for one in places]


# ---- the filter alone


def perfect_figures(floor: FloorMap, which: str) -> list[Figure]:
    """Three landmarks of the L from every start, each read as the map has it."""
    rng = np.random.default_rng(SEED + 40)
    walks = windows_of(floor)[::EVERY]
    right, probability = [], []
    for walk in walks:
        _, places = told_places(floor, sightings(floor, walk, {}, rng))
        true = list(zip(walk.cells, walk.quarters, strict=True))
        right.append([(cell, quarters) for cell, quarters, _ in places] == true)
        probability.append(places[-1][2])
    least, mean = min(probability), float(np.mean(probability))
    given = [r and p >= MIN_CELL_PROBABILITY for r, p in zip(right, probability, strict=True)]
    how = (
        f"{len(walks)} starts (cell, heading) with an L, {which}; the filter alone, perfect reads, "
        "nominal odometry"
    )
    return [
        Figure("24x24, 16/L: right after three landmarks", 100 * float(np.mean(right)), "%",
               f"{how}: cell and heading of all three", 100.0, "higher",
               "paper: three landmarks", 100.0),
        Figure("24x24, 16/L: right and poses given after three",
               100 * float(np.mean(given)), "%",
               f"the same, at a probability of {MIN_CELL_PROBABILITY} or more; "
               f"least {least:.4f}, mean {mean:.4f}",
               100.0, "higher"),
    ]  # fmt: skip


def misread_figures(floor: FloorMap, which: str) -> list[Figure]:
    """Random walks over a floor of which one landmark in twenty is taken for another."""
    rows, columns = floor.shape
    starts = [(r, c, h) for r in range(rows) for c in range(columns) for h in range(4)]
    certain, likely, needed, failed, faults = 0, 0, [], [], 0
    walks = starts[::EVERY] * WALKS
    for number, (row, column, heading) in enumerate(walks):
        rng = np.random.default_rng([SEED + 41, number])
        walk = random_walk(floor, (row, column), heading, rng)
        laid = misread(floor, rng)
        faults += any(cell in laid for cell in walk.cells)
        so_far, places = told_places(floor, sightings(floor, walk, laid, rng))
        true = list(zip(walk.cells, walk.quarters, strict=True))
        every = [*zip(so_far, true, strict=True), *zip(places, true, strict=True)]
        wrong = max((p for (c, q, p), t in every if (c, q) != t), default=0.0)
        if wrong >= CERTAIN_PROBABILITY:
            certain += 1
            failed.append(number)
        likely += MIN_CELL_PROBABILITY <= wrong < CERTAIN_PROBABILITY
        first = (n for n, (_, _, p) in enumerate(so_far, 1) if p >= CERTAIN_PROBABILITY)
        needed.append(next(first, math.inf))
    done = [n for n in needed if math.isfinite(n)]
    how = (
        f"{len(walks)} random walks over {LONGEST} landmarks from every start, {which}, "
        f"{100 * MISREAD:.0f} % of the landmarks taken for any other code whenever they are "
        f"visited ({faults} walks met one); the filter alone"
    )
    seeds = f"; walks {', '.join(map(str, failed[:10]))}" if failed else ""
    return [
        Figure("5 % misread: wrong silently", float(certain), "walks",
               f"{how}: a wrong cell or heading at a probability of {CERTAIN_PROBABILITY} or "
               f"more, after any of the landmarks or in the end{seeds}", 0.0),
        Figure("5 % misread: wrong with a remark", 100 * likely / len(walks), "%",
               f"the same, at {MIN_CELL_PROBABILITY} to {CERTAIN_PROBABILITY}: poses are given, "
               "with the probability said"),
        Figure("5 % misread: landmarks needed", float(np.mean(done)) if done else math.nan,
               "landmarks", f"mean until {CERTAIN_PROBABILITY} is reached; 99 % within "
               f"{np.quantile(done, 0.99) if done else math.nan:.0f}", peer="paper, no fault",
               peer_value=3.0),
        Figure(f"5 % misread: certain within {LONGEST} landmarks",
               100 * len(done) / len(walks), "%", "the same walks", better="higher"),
    ]  # fmt: skip
