"""How many readings there can be: what no search needs to try."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from locatk.core.errors import InputError
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap, Wall
from locatk.core.landmarks.map.windows import ALPHABET_CODES, PATHS, Integers, placements, ways

UPRIGHT = {"6": 6, "16": 4, "compass": 0}
"""Letters that read the same when their landmark is turned by half a turn."""


def readings_bound(alphabet: str, window: str, detect: int = 0) -> int:
    """Most readings of one floor, over all headings, that can differ as wanted.

    A path that a robot can also go backwards (all but ``L``) reads a word and, half turned
    about, another one. Words for which these are the same can lie nowhere: the palindromes
    of straight paths among them (facts/landmarks.md 4 counts them for ``"6"``; read with
    orientation, 16 of 256 words of ``I2`` and 256 of 65536 of ``2x2`` fall out too). Where
    ``detect`` misread landmarks shall be noticed, no two readings agree in all but as many
    (R. C. Singleton, IEEE Trans. Inf. Theory 10, 116, 1964). Each heading of ``compass``
    has words of its own.
    """
    letters, size = len(ALPHABET_CODES[alphabet]), len(PATHS[window])
    blocks = 4 if alphabet == "compass" else 1
    if detect:
        return int(blocks * letters ** (size - detect))
    pairs, middle = divmod(size, 2)
    turned = letters**pairs * UPRIGHT[alphabet] ** middle
    useless = 0 if window == "L" or alphabet == "compass" else turned
    return int(blocks * letters**size - useless)


def square_bound(alphabet: str, window: str, detect: int = 0) -> int:
    """Side of the largest square floor whose readings are no more than the bound."""
    bound = readings_bound(alphabet, window, detect)
    side = 1
    while _square_readings(side + 1, window) <= bound:
        side += 1
    return side


def _square_readings(side: int, window: str) -> int:
    if window in ("I2", "I3"):
        return 4 * side * max(0, side + 1 - len(PATHS[window]))
    return int(4 * max(0, side - (2 if window == "3x3" else 1)) ** 2)


def refuse(
    rows: int,
    columns: int,
    *,
    alphabet: str = "16",
    window: str = "L",
    detect: int = 0,
    forbidden: Collection[Cell] = frozenset(),
    walls: Collection[Wall] = frozenset(),
) -> None:
    """Raise InputError where a floor has more readings than can differ.

    The readings are counted on this very floor: holes and walls make them fewer.
    """
    codes = np.zeros((rows, columns), np.int64)
    for cell in forbidden:
        codes[cell] = HOLE
    floor = FloorMap(codes, alphabet=alphabet, window=window, walls=frozenset(walls))
    cells, heading = placements(codes != HOLE, ways(floor), window)
    refuse_readings(cells, heading, alphabet=alphabet, window=window, detect=detect)


def refuse_readings(
    cells: Integers, heading: Integers, *, alphabet: str, window: str, detect: int
) -> None:
    """:func:`refuse`, of windows (n, k, 2) under headings (n,)."""
    asked, bound = len(cells), readings_bound(alphabet, window, detect)
    words = len(ALPHABET_CODES[alphabet]) ** (len(PATHS[window]) - detect)
    under = ""
    if alphabet == "compass":
        # Words of another heading are of no use: the fullest one decides.
        asked, bound, under = (
            int(np.bincount(heading, minlength=4).max()),
            words,
            "under a heading ",
        )
    elif asked <= words and bound < words:
        # Where a wall lets a robot pass in one direction only, no word falls out.
        asked = _turnable(cells, heading)
    if asked <= bound:
        return
    side = square_bound(alphabet, window, detect)
    raise InputError(
        f"this floor has {asked} readings {under}of window {window}, and there are only {bound} "
        f"of alphabet {alphabet}" + (f" with {detect} misread noticed" if detect else ""),
        hint=f"make the floor smaller (a square has at most {side} x {side} landmarks, before any"
        f" search), {'' if alphabet == '16' else 'the alphabet 16, '}or the window larger",
    )


def _turnable(cells: Integers, heading: Integers) -> int:
    """Readings whose landmarks are also read half turned about."""
    if not len(cells):
        return 0
    columns = int(cells[..., 1].max()) + 1
    flat = np.sort(cells[..., 0] * columns + cells[..., 1], axis=1)
    # A straight or square window is its least and its greatest cell.
    key = np.column_stack([flat[:, 0], flat[:, -1], heading % 2])
    _, count = np.unique(key, axis=0, return_counts=True)
    return int(count[count == 2].sum())
