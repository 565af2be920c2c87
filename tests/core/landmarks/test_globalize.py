"""Cells from hand-made sightings, against dictionaries of the map and exhaustive counting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import Drift
from locatk.core.landmarks.landmark import CODES, rotated
from locatk.core.landmarks.localization.cell_filter import BEYOND, PAD, Located, locate
from locatk.core.landmarks.map.floor import HOLE, STEPS, Cell, FloorMap

Array = NDArray[np.float64]
State = tuple[Cell, int]

MISREAD = 0.01

HALF_PI = math.pi / 2

L = (0, 1)
"""Turns to the left before the steps of a window."""

SURE = 0.9999


@pytest.fixture(scope="module")
def published(data: Path) -> FloorMap:
    lines = (data / "landmarks" / "or16_L_24x24.txt").read_text().splitlines()[1:]
    return FloorMap(np.array([[int(letter, 16) for letter in line] for line in lines if line]))


def walk(start: State, turns: Sequence[int]) -> list[State]:
    """Cells and headings, each heading the one of arrival."""
    way = [start]
    cell, heading = start
    for turn in turns:
        heading = (heading + turn) % 4
        cell = (cell[0] + STEPS[heading][0], cell[1] + STEPS[heading][1])
        way.append((cell, heading))
    return way


def inside(floor: FloorMap, way: Sequence[State]) -> bool:
    rows, columns = floor.shape
    return all(0 <= r < rows and 0 <= c < columns for (r, c), _ in way)


def sightings(
    floor: FloorMap, way: Sequence[State], codes: Sequence[int], seed: int = 0
) -> list[VisitHypotheses]:
    """What a robot shows that goes that way and reads ``codes`` (as on the map's frame).

    It is some millimetres and degrees off the cells, and its odometry begins anywhere.
    """
    random = np.random.default_rng(seed)
    swing = random.uniform(-math.pi, math.pi)
    out = []
    for number, ((cell, quarters), code) in enumerate(zip(way, codes, strict=True)):
        off = np.array([*random.normal(0, 5e-3, 2), random.normal(0, 0.2)])
        c, s = math.cos(quarters * HALF_PI), math.sin(quarters * HALF_PI)
        x, y = floor.place(cell) + off[0] * np.array([c, s]) + off[1] * np.array([-s, c])
        a, b = math.cos(swing), math.sin(swing)
        told = np.array([1 + a * x - b * y, 2 + b * x + a * y, quarters * HALF_PI + off[2] + swing])
        own = Hypothesis(
            int(rotated(code, -quarters)), 1.0, off, np.eye(3) * 1e-7, np.ones(4), np.ones(4)
        )
        out.append(VisitHypotheses("robot", number, 0, 1, told, (own,)))
    return out


def found(floor: FloorMap, seen: Sequence[VisitHypotheses]) -> list[Located]:
    return locate(seen, floor, misread=MISREAD, drift=Drift())


def on_map(floor: FloorMap, way: Sequence[State]) -> list[int]:
    return [int(floor.codes[cell]) for cell, _ in way]


def starts(floor: FloorMap, every: int) -> list[State]:
    rows, columns = floor.shape
    all_of = [((r, c), q) for r in range(rows) for c in range(columns) for q in range(4)]
    return [start for start in all_of if inside(floor, walk(start, L))][::every]


def test_every_l_is_right(published: FloorMap) -> None:
    for number, start in enumerate(starts(published, 11)):
        way = walk(start, L)
        told = found(published, sightings(published, way, on_map(published, way), number))
        assert [(one.cell, one.quarters) for one in told] == way
        assert min(one.probability for one in told) > 0.9


def test_one_misread_of_three_is_never_sure(published: FloorMap) -> None:
    random = np.random.default_rng(1)
    wrong = 0
    for number, start in enumerate(starts(published, 17)):
        way, bad = walk(start, L), random.integers(3)
        codes = on_map(published, way)
        codes[bad] = int((codes[bad] + random.integers(1, CODES)) % CODES)
        told = found(published, sightings(published, way, codes, number))
        right = [(one.cell, one.quarters) for one in told] == way
        wrong += not right
        assert right or max(one.probability for one in told) < SURE
    assert wrong > 10  # that the map has other places for many of them is why it matters


def test_a_landmark_laid_wrongly_counts_once(published: FloorMap) -> None:
    """However often a robot comes back to it."""
    random = np.random.default_rng(2)
    for number, start in enumerate(starts(published, 41)):
        there = walk(start, L)
        lap = [*there, *there[-2::-1], *there[1:]]
        codes = dict(zip([cell for cell, _ in there], on_map(published, there), strict=True))
        bad = there[2][0]
        codes[bad] = int((codes[bad] + random.integers(1, CODES)) % CODES)
        told = found(published, sightings(published, lap, [codes[c] for c, _ in lap], number))
        right = [(one.cell, one.quarters) for one in told] == lap
        assert right or max(one.probability for one in told) < SURE


@pytest.mark.parametrize("seed", range(4))
def test_probabilities_are_those_of_counting(seed: int) -> None:
    """Every place that a robot may have come from, weighed by what it would have read."""
    random = np.random.default_rng(seed)
    floor = FloorMap(random.integers(0, CODES, (12, 12)))
    way = walk(((4, 4), 1), (0, 1, 0))
    codes = on_map(floor, way)
    codes[1] = (codes[1] + 3) % CODES
    read = [int(rotated(code, -q)) for code, (_, q) in zip(codes, way, strict=True)]
    codes_of = np.pad(floor.codes, PAD, constant_values=HOLE)
    weight = {}
    for row in range(-PAD, 12 + PAD):
        for column in range(-PAD, 12 + PAD):
            for quarters in range(4):
                other = walk(((row, column), quarters), (0, 1, 0))
                if all(min(cell) >= -PAD and max(cell) < 12 + PAD for cell, _ in other):
                    weight[other[0]] = 1.0
                    for (cell, q), code in zip(other, read, strict=True):
                        laid = codes_of[cell[0] + PAD, cell[1] + PAD]
                        hit = int(rotated(max(laid, 0), -q)) == code
                        same = 1 - MISREAD if hit else MISREAD / (CODES - 1)
                        weight[other[0]] *= BEYOND / CODES if laid == HOLE else same
    want = weight[way[0]] / sum(weight.values())
    told = found(floor, sightings(floor, way, codes, seed))
    # To have left the map for good is possible too, which counting does not know.
    assert 0.9 * want < told[0].probability < want
    assert max(weight.values()) < 1.01 * weight[way[0]]


def test_another_floor_is_not_believed(published: FloorMap) -> None:
    for seed in range(25):
        other = FloorMap(np.random.default_rng(seed).integers(0, CODES, published.shape))
        way = walk(((5, 5), 0), (0, 1, 0, -1, 0, 1, 0, 0, 1))
        told = found(published, sightings(other, way, on_map(other, way), seed))
        assert max(one.probability for one in told) < 0.9


def test_a_robot_that_leaves_the_mapped_part_is_followed_no_more(published: FloorMap) -> None:
    part = FloorMap(published.codes[:10, :10])
    way = walk(((5, 4), 0), [0] * 15)
    told = found(part, sightings(published, way, on_map(published, way)))
    for one, (cell, quarters) in zip(told, way, strict=True):
        if one.probability > 0.9:
            assert (one.cell, one.quarters) == (cell, quarters)
    assert [one.probability > 0.9 for one in told[:4]] == [True] * 4


def test_a_robot_that_was_carried_away_is_never_told_elsewhere(published: FloorMap) -> None:
    for seed in range(10):
        random = np.random.default_rng(seed)
        first = walk(((int(random.integers(3, 8)), 3), 0), (0, 0, 0, 1))
        then = walk(((int(random.integers(15, 20)), 12), 0), (0, 0, 0, 1))
        codes = on_map(published, first) + on_map(published, then)
        # Odometry knows of one more step only.
        gone = walk(first[0], (0, 0, 0, 1, -1, 0, 0, 0, 1))
        told = found(published, sightings(published, gone, codes, seed))
        for one, want in zip(told, [*first, *then], strict=True):
            assert one.probability < 0.99 or one.cell == want[0]


def test_a_hole_does_not_stop_the_filter(published: FloorMap) -> None:
    codes = published.codes.copy()
    way = walk(((7, 7), 0), (0, 0, 0, 0, 1))
    codes[way[2][0]] = HOLE
    told = found(FloorMap(codes), sightings(published, way, on_map(published, way)))
    assert [(one.cell, one.quarters) for one in told] == way


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_landmarks_tell_no_place(published: FloorMap, count: int) -> None:
    way = walk(((7, 7), 0), L)[:count]
    told = found(published, sightings(published, way, on_map(published, way)))
    assert max(one.probability for one in told) < 0.5


def test_nothing_seen_is_nowhere(published: FloorMap) -> None:
    assert found(published, []) == []


def test_turned_frames_are_the_same_landmarks(published: FloorMap) -> None:
    """Which quarter turn a hypothesis' frame has says nothing."""
    way = walk(((9, 12), 3), (0, 1, 0))
    seen = sightings(published, way, on_map(published, way))
    turned = []
    for number, one in enumerate(seen):
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
        turned.append(VisitHypotheses("robot", number, 0, 1, one.odometry, (own,)))
    for one, other, number in zip(
        found(published, seen), found(published, turned), range(4), strict=True
    ):
        assert one.cell == other.cell
        assert other.quarters == (one.quarters - number) % 4
        assert other.probability == pytest.approx(one.probability)
