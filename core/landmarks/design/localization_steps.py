"""Number of landmarks that a robot must visit until it knows its position, from each start.

The drive is deterministic. The robot follows the path of the map's window, then the same path
mirrored, and so on, so that it does not drive in circles. If the next step is not passable, it
goes ahead if it can, otherwise left, right or back, and begins a new window. It knows its turns,
and notices steps that are not passable. All starts are hypotheses at first; those that would have
read something else, or turned differently, are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.map.floor import HOLE_CODE, STEPS, Cell, FloorMap
from locatk.core.landmarks.map.windows import (
    WINDOW_PATHS,
    Integers,
    letters_as_read,
    passable_steps,
)

Start = tuple[Cell, int]
"""Cell and heading, in quarter turns, at which a robot starts."""

MAX_LISTED_STARTS = 10
"""Starts that are listed by name."""

MAX_LANDMARKS_UNCHECKED = 40
"""Landmarks after which the starts that this drive never distinguishes are determined and
dropped."""

LETTER_RANGE = 32
"""Letters are smaller than this number: an observation is ``turn * LETTER_RANGE + letter``."""

NO_TURN = 4
"""Value of a turn if the robot cannot leave its cell."""

NEVER_LOCALIZED = -1
"""Number of landmarks of a start that cannot be distinguished from another one."""


@dataclass(frozen=True, eq=False)
class LocalizationSteps:
    """Number of landmarks to visit until one hypothesis is left, including the first landmark.

    Attributes
    ----------
    landmarks : (rows, columns, 4) int64 ndarray
        By start; 0 in holes, :data:`NEVER_LOCALIZED` for starts that cannot be distinguished.
    mean, p99 : float or None
        Over the starts that can be distinguished; None if there are none.
    worst : int or None
    worst_starts : tuple of (cell, heading)
        First starts that need the most landmarks.
    never : int
        Number of starts that this drive cannot distinguish.
    never_starts : tuple of (cell, heading)
        First of them.
    """

    landmarks: Integers
    mean: float | None
    p99: float | None
    worst: int | None
    worst_starts: tuple[Start, ...]
    never: int
    never_starts: tuple[Start, ...]


def count_localization_steps(floor: FloorMap) -> LocalizationSteps:
    """Return the number of landmarks to visit from each start on a floor without faults."""
    drive = LocalizationDrive.on(floor)
    landmarks = np.zeros(4 * floor.codes.size, np.int64)
    start = np.flatnonzero(np.repeat(floor.codes.reshape(-1) != HOLE_CODE, 4))
    landmarks[start] = NEVER_LOCALIZED
    # Starts that agree in everything read so far form a group of hypotheses.
    state, group = start * drive.phases, drive.letter[start]
    is_distinguishable: NDArray[np.bool_] | None = None
    visited = 1
    while len(start):
        _, group, count = np.unique(group, return_inverse=True, return_counts=True)
        is_localized = count[group] == 1
        landmarks[start[is_localized]] = visited
        remaining = ~is_localized
        if visited == MAX_LANDMARKS_UNCHECKED and remaining.any():
            is_distinguishable = drive.distinguishable(np.flatnonzero(landmarks != 0))
        if is_distinguishable is not None:
            # A group continues while one of its starts can be distinguished from the others.
            remaining &= np.bincount(group, is_distinguishable[start])[group] > 0
        start, state, group = start[remaining], state[remaining], group[remaining]
        group = group * ((NO_TURN + 1) * LETTER_RANGE) + drive.observation[state]
        state = drive.next_state[state]
        visited += 1
    return _summarize(landmarks.reshape(*floor.shape, 4))


def _summarize(landmarks: Integers) -> LocalizationSteps:
    localized = landmarks[landmarks > 0]
    worst = int(localized.max()) if len(localized) else None
    return LocalizationSteps(
        landmarks,
        float(localized.mean()) if len(localized) else None,
        float(np.percentile(localized, 99)) if len(localized) else None,
        worst,
        () if worst is None else _first_starts(landmarks == worst),
        int((landmarks == NEVER_LOCALIZED).sum()),
        _first_starts(landmarks == NEVER_LOCALIZED),
    )


def _first_starts(mask: NDArray[np.bool_]) -> tuple[Start, ...]:
    return tuple(((int(r), int(c)), int(h)) for r, c, h in np.argwhere(mask)[:MAX_LISTED_STARTS])


@dataclass(frozen=True, eq=False)
class LocalizationDrive:
    """The drive as an automaton over states ``(4 cell + heading) * phases + phase``.

    Attributes
    ----------
    phases : int
        Steps of the window's path and of its mirror image.
    letter : (4 cells,) int64 ndarray
        Letter that is read in a cell at a heading.
    next_state : (states,) int64 ndarray
    observation : (states,) int64 ndarray
        Observation of the step to the next state: the robot's turn, and the letter there.
    """

    phases: int
    letter: Integers
    next_state: Integers
    observation: Integers

    @classmethod
    def on(cls, floor: FloorMap) -> LocalizationDrive:
        """Build the automaton of a floor and its window."""
        wanted = np.asarray(window_turns(floor.window))
        passable = passable_steps(floor).reshape(-1, 4)
        count, phases = len(passable), len(wanted)
        codes = floor.codes.reshape(-1, 1)
        heading = np.arange(4)
        letter = letters_as_read(np.where(codes == HOLE_CODE, 0, codes), heading, floor.alphabet)
        letter = letter.reshape(-1)
        cell = np.arange(count)[:, None, None]
        turn = np.full((count, 4, phases), NO_TURN)
        # Each overwrites the one before: ahead is preferred, then left, right, back.
        for fallback in (2, 3, 1, 0):
            is_passable = passable[:, (heading + fallback) % 4, None]
            turn[np.broadcast_to(is_passable, turn.shape)] = fallback
        follows_window = passable[cell, (heading[:, None] + wanted) % 4]
        turn = np.where(follows_window, wanted % 4, turn)
        next_heading = (heading[:, None] + turn) % 4
        cell_step = np.array([row * floor.shape[1] + column for row, column in STEPS])
        next_cell = cell + cell_step[next_heading]
        next_pose = np.where(
            turn == NO_TURN, cell * 4 + heading[:, None], next_cell * 4 + next_heading
        )
        next_phase = np.where(follows_window, (np.arange(phases) + 1) % phases, 0)
        observation = turn * LETTER_RANGE + letter[next_pose]
        next_state = next_pose * phases + next_phase
        return cls(phases, letter, next_state.reshape(-1), observation.reshape(-1))

    def distinguishable(self, start: Integers) -> NDArray[np.bool_]:
        """Return (4 cells,) whether a start differs from all others of ``start`` at some time.

        The observations of 2 n steps are those of the first n and, from the state there, of n
        more. Once twice as many steps distinguish no more states, no number of steps will (E. F.
        Moore, Gedanken-experiments on sequential machines, 1956).
        """
        _, group = np.unique(self.observation, return_inverse=True)
        jump, group_count = self.next_state, 0
        while (count := int(group.max()) + 1) > group_count:
            group_count = count
            _, group = np.unique(group * count + group[jump], return_inverse=True)
            jump = jump[jump]
        behaviour = self.letter[start] * group_count + group[start * self.phases]
        _, behaviour, count_of = np.unique(behaviour, return_inverse=True, return_counts=True)
        result = np.zeros(len(self.letter), bool)
        result[start] = count_of[behaviour] == 1
        return result


def window_turns(window: str) -> tuple[int, ...]:
    """Return the quarter turns before each step of a window's path and of its mirror image."""
    steps = np.diff(np.array(WINDOW_PATHS[window]), axis=0)
    # At heading 0, ahead is along the columns and left along the rows.
    directions = [STEPS.index((int(left), int(ahead))) for ahead, left in steps]
    turns = [after - before for before, after in zip([0, *directions], directions, strict=False)]
    signed_turns = [(turn + 1) % 4 - 1 for turn in turns]
    return (*signed_turns, *(-turn for turn in signed_turns))
