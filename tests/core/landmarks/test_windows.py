"""What windows read, against a robot that walks step by step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.landmarks.floor import ALPHABETS, HOLE, STEPS, WINDOWS, Cell, FloorMap
from locatk.core.landmarks.landmark import PATTERNS, code_of, pattern, rotated
from locatk.core.landmarks.windows import ALPHABET_CODES, readings, ways

WALKS = {
    "L": "AL",
    "I2": "A",
    "I3": "AA",
    "2x2": "ALL",
    "3x3": "AALLARRA",
}
"""Each letter is a step: ahead, or after a turn to the left or right."""


def walked(floor: FloorMap) -> dict[tuple[Cell, int], tuple[list[Cell], tuple[int, ...]]]:
    """Cells and letters by first cell and heading, as a robot finds them."""
    found = {}
    for cell in floor.cells():
        for start in range(4):
            at, heading, visited = cell, start, [cell]
            for step in WALKS[floor.window]:
                heading += {"A": 0, "L": 1, "R": -1}[step]
                if not floor.open(at, heading):
                    break
                at = (at[0] + STEPS[heading % 4][0], at[1] + STEPS[heading % 4][1])
                visited.append(at)
            else:
                codes = [int(floor.codes[visit]) for visit in visited]
                if floor.alphabet == "6":
                    letters = tuple(PATTERNS.index(pattern(code)) + 1 for code in codes)
                else:
                    letters = tuple(int(rotated(code, -start)) for code in codes)
                found[cell, start] = (visited, letters)
    return found


def floors(
    windows: tuple[str, ...] = WINDOWS, alphabets: tuple[str, ...] = ALPHABETS
) -> st.SearchStrategy[FloorMap]:
    """Small floors with holes and walls, and letters drawn at random."""

    def build(window: str, alphabet: str, rows: int, columns: int, seed: int) -> FloorMap:
        random = np.random.default_rng(seed)
        codes = random.choice(ALPHABET_CODES[alphabet], (rows, columns))
        codes[random.random(codes.shape) < random.choice([0, 0.1])] = HOLE
        walls = set()
        for row in range(rows):
            for column in range(columns):
                for step in STEPS[:2]:
                    other = (row + step[0], column + step[1])
                    if random.random() < 0.1 and other[0] < rows and other[1] < columns:
                        walls.add(((row, column), other))
        return FloorMap(codes, window=window, alphabet=alphabet, walls=frozenset(walls))

    size = st.integers(1, 6)
    numbers = st.integers(0, 2**32 - 1)
    return st.builds(
        build, st.sampled_from(windows), st.sampled_from(alphabets), size, size, numbers
    )


@given(floors())
@settings(deadline=None, max_examples=150)
def test_as_a_robot_walks(floor: FloorMap) -> None:
    seen = readings(floor)
    found = {
        (tuple(cells[0].tolist()), int(heading)): (
            [tuple(cell) for cell in cells.tolist()],
            tuple(letters.tolist()),
        )
        for cells, heading, letters in zip(seen.cells, seen.heading, seen.letters, strict=True)
    }
    assert len(found) == len(seen)
    assert found == walked(floor)


@given(floors())
@settings(deadline=None, max_examples=50)
def test_ways_are_where_the_floor_is_open(floor: FloorMap) -> None:
    free = ways(floor)
    for cell in floor.cells():
        assert [floor.open(cell, heading) for heading in range(4)] == free[cell].tolist()
    assert not free[floor.codes == HOLE].any()


def test_a_left_turn_by_hand() -> None:
    """Facing up the rows, left is towards lower columns."""
    codes = np.array([[0, code_of("NSSS")], [code_of("SSNS"), code_of("NNSS")]])
    seen = readings(FloorMap(codes, window="L"))
    (up,) = np.flatnonzero((seen.heading == 1) & (seen.cells[:, 0] == [0, 1]).all(1))
    assert seen.cells[up].tolist() == [[0, 1], [1, 1], [1, 0]]
    # Bar 0 is on the map's right side, which is this robot's right too: its bar 3.
    assert seen.letters[up].tolist() == [code_of("SSSN"), code_of("NSSN"), code_of("SNSS")]


@pytest.mark.parametrize("window", WINDOWS)
def test_counts_are_those_of_the_facts(window: str) -> None:
    """Facts 4, counting bounds."""
    m, n = 5, 7
    counts = {"L": 4 * (m - 1) * (n - 1), "2x2": 4 * (m - 1) * (n - 1), "3x3": 4 * (m - 2) * (n - 2)}
    for k in (2, 3):
        counts[f"I{k}"] = 2 * (m * (n - k + 1) + n * (m - k + 1))
    assert len(readings(FloorMap(np.zeros((m, n), int), window=window))) == counts[window]
