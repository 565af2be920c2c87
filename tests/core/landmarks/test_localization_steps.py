"""Landmarks until the place is known, against robots that keep lists of hypotheses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.landmarks.design.localization_steps import (
    NEVER_LOCALIZED,
    count_localization_steps,
    window_turns,
)
from locatk.core.landmarks.landmark import PATTERN_OF, rotated
from locatk.core.landmarks.map.floor import STEPS, WINDOWS, Cell, FloorMap

TURNS = {
    "L": (0, 1, 0, -1),
    "I2": (0, 0),
    "I3": (0, 0, 0, 0),
    "2x2": (0, 1, 1, 0, -1, -1),
    "3x3": (0, 0, 1, 1, 0, -1, -1, 0, 0, 0, -1, -1, 0, 1, 1, 0),
}


class Robot:
    """Drives as :mod:`~locatk.core.landmarks.design.localization_steps` says, and learns."""

    def __init__(self, floor: FloorMap, cell: Cell, heading: int) -> None:
        self.floor, self.cell, self.heading, self.phase = floor, cell, heading, 0
        self.log: list[tuple[int, ...]] = [(self.letter(),)]

    def letter(self) -> int:
        code = self.floor.codes[self.cell]
        if self.floor.alphabet == "6":
            return int(PATTERN_OF[code])
        return int(rotated(code, -self.heading))

    def step(self) -> None:
        rotations = TURNS[self.floor.window]
        for tried, rotation in enumerate((rotations[self.phase], 0, 1, -1, 2)):
            if self.floor.is_passable(self.cell, self.heading + rotation):
                self.heading = (self.heading + rotation) % 4
                step = STEPS[self.heading]
                self.cell = (self.cell[0] + step[0], self.cell[1] + step[1])
                self.phase = 0 if tried else (self.phase + 1) % len(rotations)
                self.log.append((rotation % 4, self.letter()))
                return
        self.phase = 0
        self.log.append((9, self.letter()))


@given(seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=40)
def test_as_robots_with_lists(seed: int, random_floor: Callable[[int], FloorMap]) -> None:
    floor = random_floor(seed)
    result = count_localization_steps(floor)
    robots = {(c, h): Robot(floor, c, h) for c in floor.cells() for h in range(4)}
    starts = dict.fromkeys(robots, 0)
    for steps in range(1, 60):
        logs = [tuple(robot.log) for robot in robots.values()]
        for position, robot in robots.items():
            if not starts[position] and logs.count(tuple(robot.log)) == 1:
                starts[position] = steps
        if all(starts.values()):
            break
        for robot in robots.values():
            robot.step()
    for position, expected in starts.items():
        got = int(result.landmarks[*position[0], position[1]])
        if expected:
            assert got == expected
        else:
            assert got == NEVER_LOCALIZED or got >= 60
    assert (result.landmarks[floor.codes == -1] == 0).all()
    reported = [n for n in starts.values() if n]
    assert result.never + len(reported) == len(starts) or not all(starts.values())
    if reported and result.never + len(reported) == len(starts):
        assert result.worst == max(reported)
        assert result.mean == pytest.approx(np.mean(reported))
        assert all(starts[position] == max(reported) for position in result.worst_starts)


@pytest.mark.parametrize("window", WINDOWS)
def test_rotations_of_windows(window: str) -> None:
    assert window_turns(window) == TURNS[window]


def test_starts_that_stay_ambiguous() -> None:
    """On a square of equal landmarks all corners and headings are four kinds of start."""
    result = count_localization_steps(FloorMap(np.zeros((3, 3), int), alphabet="6"))
    assert result.never == 36
    assert result.worst is None
    assert result.mean is None
    assert len(result.never_starts) == 10


def test_starts_that_are_distinguished_late() -> None:
    """A corridor that differs at its far end only."""
    codes = np.zeros((1, 60), int)
    codes[0, -1] = 15
    result = count_localization_steps(FloorMap(codes, alphabet="6", window="I2"))
    assert result.landmarks[0, 59].min() == 2
    assert (result.landmarks[0, 0, 0], result.never) == (60, 0)
