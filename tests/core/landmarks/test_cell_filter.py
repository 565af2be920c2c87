"""Cell filter on constructed visits, against published maps and exhaustive enumeration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT, rotated
from locatk.core.landmarks.localization.cell_filter import (
    OUTSIDE_LANDMARK_PROBABILITY,
    PAD_CELLS,
    CellEstimate,
    IdentifiedVisit,
    identify_cells,
    select_visits_on_map,
)
from locatk.core.landmarks.map.floor import HOLE_CODE, STEPS, Cell, FloorMap
from locatk.core.landmarks.preprocessing import VisitSegment

Array = NDArray[np.float64]
State = tuple[Cell, int]

MISREAD = 0.01

HALF_PI = math.pi / 2

L = (0, 1)
"""Turns to the left before the steps of a window."""

CERTAIN_PROBABILITY = 0.9999


@pytest.fixture(scope="module")
def published(data: Path) -> FloorMap:
    lines = (data / "landmarks" / "or16_L_24x24.txt").read_text().splitlines()[1:]
    return FloorMap(np.array([[int(letter, 16) for letter in line] for line in lines if line]))


def walk(start: State, rotations: Sequence[int]) -> list[State]:
    """Cells and headings, each heading the one of arrival."""
    path = [start]
    cell, heading = start
    for turn in rotations:
        heading = (heading + turn) % 4
        cell = (cell[0] + STEPS[heading][0], cell[1] + STEPS[heading][1])
        path.append((cell, heading))
    return path


def inside(floor: FloorMap, path: Sequence[State]) -> bool:
    rows, columns = floor.shape
    return all(0 <= r < rows and 0 <= c < columns for (r, c), _ in path)


def visits_of(
    floor: FloorMap, path: Sequence[State], codes: Sequence[int], seed: int = 0
) -> list[VisitHypotheses]:
    """Return the visits of a robot on a path that reads ``codes`` (in the map's frame).

    Its poses deviate from the cells by millimetres and degrees; its odometry has any frame.
    """
    random = np.random.default_rng(seed)
    rotation = random.uniform(-math.pi, math.pi)
    out = []
    for number, ((cell, quarters), code) in enumerate(zip(path, codes, strict=True)):
        off = np.array([*random.normal(0, 5e-3, 2), random.normal(0, 0.2)])
        c, s = math.cos(quarters * HALF_PI), math.sin(quarters * HALF_PI)
        x, y = floor.position(cell) + off[0] * np.array([c, s]) + off[1] * np.array([-s, c])
        a, b = math.cos(rotation), math.sin(rotation)
        odometry = np.array(
            [1 + a * x - b * y, 2 + b * x + a * y, quarters * HALF_PI + off[2] + rotation]
        )
        own = Hypothesis(
            int(rotated(code, -quarters)), 1.0, off, np.eye(3) * 1e-7, np.ones(4), np.ones(4)
        )
        out.append(VisitHypotheses("robot", number, 0, 1, odometry, (own,)))
    return out


def identify(floor: FloorMap, observed: Sequence[VisitHypotheses]) -> list[CellEstimate]:
    return identify_cells(observed, floor, misread=MISREAD, drift=OdometryDrift()).estimates


def on_map(floor: FloorMap, path: Sequence[State]) -> list[int]:
    return [int(floor.codes[cell]) for cell, _ in path]


def starts(floor: FloorMap, every: int) -> list[State]:
    rows, columns = floor.shape
    all_of = [((r, c), q) for r in range(rows) for c in range(columns) for q in range(4)]
    return [start for start in all_of if inside(floor, walk(start, L))][::every]


@pytest.mark.slow
def test_every_l_is_identified(published: FloorMap) -> None:
    for number, start in enumerate(starts(published, 11)):
        path = walk(start, L)
        estimates = identify(published, visits_of(published, path, on_map(published, path), number))
        assert [(one.cell, one.quarters) for one in estimates] == path
        assert min(one.probability for one in estimates) > 0.9


@pytest.mark.slow
def test_one_misread_of_three_is_never_certain(published: FloorMap) -> None:
    random = np.random.default_rng(1)
    wrong = 0
    for number, start in enumerate(starts(published, 17)):
        path, bad = walk(start, L), random.integers(3)
        codes = on_map(published, path)
        codes[bad] = int((codes[bad] + random.integers(1, CODE_COUNT)) % CODE_COUNT)
        estimates = identify(published, visits_of(published, path, codes, number))
        right = [(one.cell, one.quarters) for one in estimates] == path
        wrong += not right
        assert right or max(one.probability for one in estimates) < CERTAIN_PROBABILITY
    assert wrong > 10  # the map contains many of these misread triples


@pytest.mark.slow
def test_wrong_landmark_counts_once(published: FloorMap) -> None:
    """For any number of visits to it."""
    random = np.random.default_rng(2)
    for number, start in enumerate(starts(published, 41)):
        there = walk(start, L)
        lap = [*there, *there[-2::-1], *there[1:]]
        codes = dict(zip([cell for cell, _ in there], on_map(published, there), strict=True))
        bad = there[2][0]
        codes[bad] = int((codes[bad] + random.integers(1, CODE_COUNT)) % CODE_COUNT)
        estimates = identify(
            published, visits_of(published, lap, [codes[c] for c, _ in lap], number)
        )
        right = [(one.cell, one.quarters) for one in estimates] == lap
        assert right or max(one.probability for one in estimates) < CERTAIN_PROBABILITY


@pytest.mark.parametrize("seed", range(4))
def test_probabilities_agree_with_enumeration(seed: int) -> None:
    """All starts, weighted with the likelihood of the codes."""
    random = np.random.default_rng(seed)
    floor = FloorMap(random.integers(0, CODE_COUNT, (12, 12)))
    path = walk(((4, 4), 1), (0, 1, 0))
    codes = on_map(floor, path)
    codes[1] = (codes[1] + 3) % CODE_COUNT
    read = [int(rotated(code, -q)) for code, (_, q) in zip(codes, path, strict=True)]
    codes_of = np.pad(floor.codes, PAD_CELLS, constant_values=HOLE_CODE)
    weight = {}
    for row in range(-PAD_CELLS, 12 + PAD_CELLS):
        for column in range(-PAD_CELLS, 12 + PAD_CELLS):
            for quarters in range(4):
                other = walk(((row, column), quarters), (0, 1, 0))
                if all(min(cell) >= -PAD_CELLS and max(cell) < 12 + PAD_CELLS for cell, _ in other):
                    weight[other[0]] = 1.0
                    for (cell, q), code in zip(other, read, strict=True):
                        installed = codes_of[cell[0] + PAD_CELLS, cell[1] + PAD_CELLS]
                        hit = int(rotated(max(installed, 0), -q)) == code
                        same = 1 - MISREAD if hit else MISREAD / (CODE_COUNT - 1)
                        weight[other[0]] *= (
                            OUTSIDE_LANDMARK_PROBABILITY / CODE_COUNT
                            if installed == HOLE_CODE
                            else same
                        )
    want = weight[path[0]] / sum(weight.values())
    estimates = identify(floor, visits_of(floor, path, codes, seed))
    # The filter also allows for slips and for leaving the map, the enumeration does not.
    assert estimates[0].probability == pytest.approx(want, rel=0.02)
    assert max(weight.values()) < 1.01 * weight[path[0]]


@pytest.mark.slow
def test_map_of_another_floor(published: FloorMap) -> None:
    for seed in range(25):
        other = FloorMap(np.random.default_rng(seed).integers(0, CODE_COUNT, published.shape))
        path = walk(((5, 5), 0), (0, 1, 0, -1, 0, 1, 0, 0, 1))
        visits = visits_of(other, path, on_map(other, path), seed)
        drift = OdometryDrift()
        result = identify_cells(visits, published, misread=MISREAD, drift=drift)
        largest = max(one.probability for one in result.estimates)
        assert largest * result.map_probability < 0.9


def test_robot_leaves_the_map(published: FloorMap) -> None:
    part = FloorMap(published.codes[:10, :10])
    path = walk(((5, 4), 0), [0] * 15)
    estimates = identify(part, visits_of(published, path, on_map(published, path)))
    for one, (cell, quarters) in zip(estimates, path, strict=True):
        if one.probability > 0.9:
            assert (one.cell, one.quarters) == (cell, quarters)
    assert [one.probability > 0.9 for one in estimates[:4]] == [True] * 4


def test_kidnapped_robot(published: FloorMap) -> None:
    for seed in range(10):
        random = np.random.default_rng(seed)
        first = walk(((int(random.integers(3, 8)), 3), 0), (0, 0, 0, 1))
        then = walk(((int(random.integers(15, 20)), 12), 0), (0, 0, 0, 1))
        codes = on_map(published, first) + on_map(published, then)
        # Odometry reports a single further step.
        gone = walk(first[0], (0, 0, 0, 1, -1, 0, 0, 0, 1))
        estimates = identify(published, visits_of(published, gone, codes, seed))
        for one, want in zip(estimates, [*first, *then], strict=True):
            assert one.probability < 0.99 or one.cell == want[0]


def test_hole_in_the_map(published: FloorMap) -> None:
    codes = published.codes.copy()
    path = walk(((7, 7), 0), (0, 0, 0, 0, 1))
    codes[path[2][0]] = HOLE_CODE
    estimates = identify(FloorMap(codes), visits_of(published, path, on_map(published, path)))
    assert [(one.cell, one.quarters) for one in estimates] == path


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_landmarks(published: FloorMap, count: int) -> None:
    path = walk(((7, 7), 0), L)[:count]
    estimates = identify(published, visits_of(published, path, on_map(published, path)))
    assert max(one.probability for one in estimates) < 0.5


def test_no_visits(published: FloorMap) -> None:
    assert identify(published, []) == []


def test_rotations_of_a_frame_by_90_degrees_are_equivalent(published: FloorMap) -> None:
    """The quarter turn of a hypothesis' frame is arbitrary."""
    path = walk(((9, 12), 3), (0, 1, 0))
    observed = visits_of(published, path, on_map(published, path))
    rotated_visits = []
    for number, one in enumerate(observed):
        quarter = number % 4
        c, s = math.cos(quarter * HALF_PI), math.sin(quarter * HALF_PI)
        x, y, heading = one.best.pose
        pose = np.array([c * x - s * y, s * x + c * y, heading + quarter * HALF_PI])
        own = Hypothesis(
            int(rotated(one.best.code, quarter)),
            1.0,
            pose,
            *[np.eye(3) * 1e-7] * 1,
            np.ones(4),
            np.ones(4),
        )
        rotated_visits.append(VisitHypotheses("robot", number, 0, 1, one.odometry, (own,)))
    for one, other, number in zip(
        identify(published, observed), identify(published, rotated_visits), range(4), strict=True
    ):
        assert one.cell == other.cell
        assert other.quarters == (one.quarters - number) % 4
        assert other.probability == pytest.approx(one.probability)


# ---- guards


@pytest.mark.parametrize(
    ("probability", "cell", "is_used"),
    [(0.79, (0, 0), False), (0.81, (0, 0), True), (0.81, (0, 1), False), (0.81, (-1, 0), False)],
)
def test_visits_on_the_map_need_a_probable_cell_with_a_landmark(
    probability: float, cell: Cell, is_used: bool
) -> None:
    floor = FloorMap(np.array([[5, HOLE_CODE]]))
    estimate = CellEstimate(cell, 0, 0, probability, probability)
    visit = VisitHypotheses("robot", 0, 0, 1, np.zeros(3), ())
    segment = VisitSegment(0, 1, np.arange(1), None, np.zeros(3))  # type: ignore[arg-type]
    visits = [IdentifiedVisit(segment, visit, estimate), IdentifiedVisit(segment, visit)]
    assert select_visits_on_map(visits, floor) == visits[:1] * is_used


def test_visit_without_a_cell_has_no_hypothesis_on_the_map() -> None:
    visit = VisitHypotheses("robot", 0, 0, 1, np.zeros(3), ())
    segment = VisitSegment(0, 1, np.arange(1), None, np.zeros(3))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no cell"):
        _ = IdentifiedVisit(segment, visit).cell


def test_missed_landmarks_cost_probability() -> None:
    """Of two pairs of equal codes, the one with a hole in between is more probable."""
    codes = np.full((1, 9), 0)
    codes[0, [0, 2]] = codes[0, [6, 8]] = 7, 11
    codes[0, 7] = HOLE_CODE
    floor = FloorMap(codes)
    path = [((0, 0), 0), ((0, 2), 0)]
    estimates = identify(floor, visits_of(floor, path, [7, 11]))
    assert [one.cell for one in estimates] == [(0, 6), (0, 8)]


def test_repeated_visits_are_no_evidence_of_the_cell() -> None:
    """The only landmark of its code on the map, or another one that is misread."""
    codes = np.zeros((12, 12), np.int64)
    codes[5, 5] = 7
    floor = FloorMap(codes)
    path = walk(((5, 5), 0), (0, 2, 2, 2, 2))
    largest = []
    for count in (2, 6):
        visits = visits_of(floor, path[:count], on_map(floor, path[:count]))
        largest.append(max(one.probability for one in identify(floor, visits)))
    assert largest[0] < 0.9
    assert largest[1] == pytest.approx(largest[0], rel=0.05)
