"""How many landmarks a robot must visit until it knows where it is, from each start.

The drive is deterministic. The robot follows the path of the map's window; after that the
same path mirrored, and so on, so that it does not go in circles. Where the way is not free,
it goes ahead instead if it can, else left, else right, else back, and begins a new window.
It knows its turns, and notices where it cannot go. All starts are hypotheses at first;
those are dropped that would have read, or had to do, something else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.map.floor import HOLE, STEPS, Cell, FloorMap
from locatk.core.landmarks.map.windows import PATHS, Integers, as_read, ways

Place = tuple[Cell, int]
"""A cell, and the heading at it in quarter turns."""

LISTED = 10
"""Starts that are named."""

PATIENCE = 40
"""Landmarks after which it is asked which starts can be told apart at all."""

STAY = 4


@dataclass(frozen=True, eq=False)
class Localisation:
    """Landmarks to visit until one hypothesis is left, the first one included.

    Attributes
    ----------
    landmarks : (rows, columns, 4) int64 ndarray
        By start; 0 where there is no landmark, :data:`NEVER` where the start can never be
        told from another.
    mean, p99 : float or None
        Over the starts that can be told apart; None where there is none.
    worst : int or None
    worst_starts : tuple of (cell, heading)
        The first ones that need the most.
    never : int
        Starts that this drive can never tell apart.
    never_starts : tuple of (cell, heading)
        The first of them.
    """

    landmarks: Integers
    mean: float | None
    p99: float | None
    worst: int | None
    worst_starts: tuple[Place, ...]
    never: int
    never_starts: tuple[Place, ...]


NEVER = -1


def localise(floor: FloorMap) -> Localisation:
    """Landmarks to visit from each start on a floor without faults."""
    drive = Drive.of(floor)
    landmarks = np.zeros(4 * floor.codes.size, np.int64)
    start = np.flatnonzero(np.repeat(floor.codes.reshape(-1) != HOLE, 4))
    landmarks[start] = NEVER
    state, group = start * drive.phases, drive.letter[start]
    apart: NDArray[np.bool_] | None = None
    visited = 1
    while len(start):
        _, group, count = np.unique(group, return_inverse=True, return_counts=True)
        alone = count[group] == 1
        landmarks[start[alone]] = visited
        keep = ~alone
        if visited == PATIENCE and keep.any():
            apart = drive.told_apart(np.flatnonzero(landmarks != 0))
        if apart is not None:
            # A group goes on while one of it can still be told from the others.
            keep &= np.bincount(group, apart[start])[group] > 0
        start, state, group = start[keep], state[keep], group[keep]
        group = group * ((STAY + 1) * 32) + drive.seen[state]
        state = drive.follow[state]
        visited += 1
    return _summary(landmarks.reshape(*floor.shape, 4))


def _summary(landmarks: Integers) -> Localisation:
    told = landmarks[landmarks > 0]
    worst = int(told.max()) if len(told) else None
    return Localisation(
        landmarks,
        float(told.mean()) if len(told) else None,
        float(np.percentile(told, 99)) if len(told) else None,
        worst,
        () if worst is None else _places(landmarks == worst),
        int((landmarks == NEVER).sum()),
        _places(landmarks == NEVER),
    )


def _places(which: NDArray[np.bool_]) -> tuple[Place, ...]:
    return tuple(((int(r), int(c)), int(h)) for r, c, h in np.argwhere(which)[:LISTED])


@dataclass(frozen=True, eq=False)
class Drive:
    """The drive as an automaton over states ``(4 cell + heading) * phases + phase``.

    Attributes
    ----------
    phases : int
    letter : (4 cells,) int64 ndarray
        Read at a cell under a heading.
    follow : (states,) int64 ndarray
    seen : (states,) int64 ndarray
        What the robot learns of the step to the next state: its turn, and the letter there.
    """

    phases: int
    letter: Integers
    follow: Integers
    seen: Integers

    @classmethod
    def of(cls, floor: FloorMap) -> Drive:
        """The drive of a floor's window on this floor."""
        turns = wanted_turns(floor.window)
        free = ways(floor).reshape(-1, 4)
        count, phases = len(free), len(turns)
        codes = floor.codes.reshape(-1, 1)
        heading = np.arange(4)
        letter = as_read(np.where(codes == HOLE, 0, codes), heading, floor.alphabet).reshape(-1)
        ahead = np.array([row * floor.shape[1] + column for row, column in STEPS])
        cell = np.arange(count)[:, None, None]
        turn = np.full((count, 4, phases), STAY)
        for other in (2, 3, 1, 0):
            turn[np.broadcast_to(free[:, (heading + other) % 4, None], turn.shape)] = other
        wanted = np.asarray(turns)
        goes = free[cell, (heading[:, None] + wanted) % 4]
        turn = np.where(goes, wanted % 4, turn)
        to = (heading[:, None] + turn) % 4
        there = np.where(turn == STAY, cell, cell + ahead[to])
        phase = np.where(goes, (np.arange(phases) + 1) % phases, 0)
        place = np.where(turn == STAY, 0, there) * 4 + to
        place = np.where(turn == STAY, cell * 4 + heading[:, None], place)
        seen = turn * 32 + letter[place]
        return cls(phases, letter, (place * phases + phase).reshape(-1), seen.reshape(-1))

    def told_apart(self, start: Integers) -> NDArray[np.bool_]:
        """(4 cells,) whether a start can be told from all others of ``start``, however long.

        What is seen over twice as many steps is what is seen over the first half and, from
        where that leads, over the second; when twice as many tell no more, none ever will
        (E. F. Moore, Gedanken-experiments on sequential machines, 1956).
        """
        _, group = np.unique(self.seen, return_inverse=True)
        jump, known = self.follow, 0
        while (groups := int(group.max()) + 1) > known:
            known = groups
            _, group = np.unique(group * groups + group[jump], return_inverse=True)
            jump = jump[jump]
        kind = self.letter[start] * known + group[start * self.phases]
        _, kind, count = np.unique(kind, return_inverse=True, return_counts=True)
        apart = np.zeros(len(self.letter), bool)
        apart[start] = count[kind] == 1
        return apart


def wanted_turns(window: str) -> tuple[int, ...]:
    """Quarter turns before each step of a window's path, and of its mirror image."""
    steps = np.diff(np.array(PATHS[window]), axis=0)
    directions = [STEPS.index((int(left), int(ahead))) for ahead, left in steps]
    turns = [after - before for before, after in zip([0, *directions], directions, strict=False)]
    folded = [(turn + 1) % 4 - 1 for turn in turns]
    return (*folded, *(-turn for turn in folded))
