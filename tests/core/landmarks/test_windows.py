"""What windows read, against a robot that walks step by step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.landmarks.landmark import code_of
from locatk.core.landmarks.map.floor import HOLE_CODE, WINDOWS, FloorMap
from locatk.core.landmarks.map.windows import passable_steps, window_readings

SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS)
@settings(deadline=None, max_examples=150)
def test_as_a_robot_walks(
    seed: int, random_floor: Callable[[int], FloorMap], walked: Callable[[FloorMap], Any]
) -> None:
    floor = random_floor(seed)
    observed = window_readings(floor)
    result = {
        (tuple(cells[0].tolist()), int(heading)): (
            [tuple(cell) for cell in cells.tolist()],
            tuple(letters.tolist()),
        )
        for cells, heading, letters in zip(
            observed.cells, observed.heading, observed.letters, strict=True
        )
    }
    assert len(result) == len(observed)
    assert result == walked(floor)


@given(seed=SEEDS)
@settings(deadline=None, max_examples=50)
def test_paths_avoid_walls_and_holes(seed: int, random_floor: Callable[[int], FloorMap]) -> None:
    floor = random_floor(seed)
    free = passable_steps(floor)
    for cell in floor.cells():
        assert [floor.is_passable(cell, heading) for heading in range(4)] == free[cell].tolist()
    assert not free[floor.codes == HOLE_CODE].any()


def test_a_left_turn_computed_by_hand() -> None:
    """Facing up the rows, left is towards lower columns."""
    codes = np.array([[0, code_of("NSSS")], [code_of("SSNS"), code_of("NNSS")]])
    observed = window_readings(FloorMap(codes, window="L"))
    (up,) = np.flatnonzero((observed.heading == 1) & (observed.cells[:, 0] == [0, 1]).all(1))
    assert observed.cells[up].tolist() == [[0, 1], [1, 1], [1, 0]]
    # Bar 0 is on the map's right side, which is this robot's right too: its bar 3.
    assert observed.letters[up].tolist() == [code_of("SSSN"), code_of("NSSN"), code_of("SNSS")]


@pytest.mark.parametrize("window", WINDOWS)
def test_counts_are_those_of_the_facts(window: str) -> None:
    """Facts 4, counting bounds."""
    m, n = 5, 7
    counts = {
        "L": 4 * (m - 1) * (n - 1),
        "2x2": 4 * (m - 1) * (n - 1),
        "3x3": 4 * (m - 2) * (n - 2),
    }
    for k in (2, 3):
        counts[f"I{k}"] = 2 * (m * (n - k + 1) + n * (m - k + 1))
    assert len(window_readings(FloorMap(np.zeros((m, n), int), window=window))) == counts[window]
