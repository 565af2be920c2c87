"""Random floors, and a robot that walks on them step by step: what fast code is held against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from locatk.core.landmarks.landmark import PATTERNS, code_of, pattern, rotated
from locatk.core.landmarks.map.floor import ALPHABETS, HOLE_CODE, STEPS, WINDOWS, Cell, FloorMap

LETTERS = {
    "6": [code_of(letters) for letters in PATTERNS],
    "16": range(16),
    "compass": [code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")],
}

WALKS = {
    "L": "AL",
    "I2": "A",
    "I3": "AA",
    "2x2": "ALL",
    "3x3": "AALLARRA",
}
"""Each letter is a step: ahead, or after a turn to the left or right."""


Walked = dict[tuple[Cell, int], tuple[list[Cell], tuple[int, ...]]]


def walk(floor: FloorMap) -> Walked:
    """Cells and letters by first cell and heading, as a robot finds them."""
    found = {}
    for cell in floor.cells():
        for start in range(4):
            at, heading, visited = cell, start, [cell]
            for step in WALKS[floor.window]:
                heading += {"A": 0, "L": 1, "R": -1}[step]
                if not floor.is_passable(at, heading):
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


def draw(seed: int) -> FloorMap:
    """A small floor with holes and walls."""
    random = np.random.default_rng(seed)
    rows, columns = random.integers(1, 7, 2)
    alphabet = str(random.choice(ALPHABETS))
    codes = random.choice(LETTERS[alphabet], (rows, columns))
    codes[random.random(codes.shape) < random.choice([0, 0.1])] = HOLE_CODE
    walls = set()
    for row in range(rows):
        for column in range(columns):
            for step in STEPS[:2]:
                other = (row + step[0], column + step[1])
                if random.random() < 0.1 and other[0] < rows and other[1] < columns:
                    walls.add(((row, column), other))
    window = str(random.choice(WINDOWS))
    return FloorMap(codes, window=window, alphabet=alphabet, walls=frozenset(walls))


@pytest.fixture(scope="session")
def walked() -> Callable[[FloorMap], Walked]:
    """Cells and letters of all windows by first cell and heading, found by walking."""
    return walk


@pytest.fixture(scope="session")
def random_floor() -> Callable[[int], FloorMap]:
    """A small floor with holes and walls, of any window and alphabet, by seed."""
    return draw
