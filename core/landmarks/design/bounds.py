"""Upper bounds on the number of different readings, which spare searches that cannot succeed."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from locatk.core.errors import InputError
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap, Wall
from locatk.core.landmarks.map.windows import (
    ALPHABET_CODES,
    WINDOW_PATHS,
    Integers,
    passable_steps,
    place_windows,
)

HALF_TURN_SYMMETRIC_LETTERS = {"6": 6, "16": 4, "compass": 0}
"""Letters of each alphabet that do not change if their landmark is rotated by 180 degrees."""


def max_distinct_readings(alphabet: str, window: str, detect: int = 0) -> int:
    """Return the largest number of different readings of one floor, over all headings.

    The cells of a window (of all but ``L``) are also those of a window at the opposite heading. It
    reads the same landmarks rotated by half a turn: in reverse order, or for ``2x2`` as c, d, a, b.
    A word that equals its counterpart cannot occur in a unique map: palindromes of straight windows
    (of ``2x2`` abab) for ``"6"``, 16 of 256 words of ``I2`` and 256 of 65,536 words of ``2x2`` for
    ``"16"``. If ``detect`` misread landmarks are to be detected, no two
    readings may agree in all but that many letters (Singleton bound: R. C. Singleton, IEEE Trans.
    Inf. Theory 10, 116, 1964). With ``compass`` each heading has words of its own.
    """
    letters, size = len(ALPHABET_CODES[alphabet]), len(WINDOW_PATHS[window])
    headings = 4 if alphabet == "compass" else 1
    if detect:
        return int(headings * letters ** (size - detect))
    pairs, middle = divmod(size, 2)
    symmetric = letters**pairs * HALF_TURN_SYMMETRIC_LETTERS[alphabet] ** middle
    unusable = 0 if window == "L" or alphabet == "compass" else symmetric
    return int(headings * letters**size - unusable)


def max_square_side(alphabet: str, window: str, detect: int = 0) -> int:
    """Return the side of the largest square floor whose readings do not exceed the bound."""
    bound = max_distinct_readings(alphabet, window, detect)
    side = 1
    while _readings_of_square(side + 1, window) <= bound:
        side += 1
    return side


def _readings_of_square(side: int, window: str) -> int:
    if window in ("I2", "I3"):
        return 4 * side * max(0, side + 1 - len(WINDOW_PATHS[window]))
    return int(4 * max(0, side - (2 if window == "3x3" else 1)) ** 2)


def require_enough_words(
    rows: int,
    columns: int,
    *,
    alphabet: str = "16",
    window: str = "L",
    detect: int = 0,
    forbidden: Collection[Cell] = frozenset(),
    walls: Collection[Wall] = frozenset(),
) -> None:
    """Raise an error for a floor with more readings than can be different.

    The readings are counted on this floor; holes and walls reduce them.

    Raises
    ------
    InputError
        No map of this floor can be unique.
    """
    codes = np.zeros((rows, columns), np.int64)
    for cell in forbidden:
        codes[cell] = HOLE_CODE
    floor = FloorMap(codes, alphabet=alphabet, window=window, walls=frozenset(walls))
    cells, heading = place_windows(codes != HOLE_CODE, passable_steps(floor), window)
    require_enough_words_for_windows(
        cells, heading, alphabet=alphabet, window=window, detect=detect
    )


def require_enough_words_for_windows(
    cells: Integers, heading: Integers, *, alphabet: str, window: str, detect: int
) -> None:
    """Apply :func:`require_enough_words` to windows (n, k, 2) at headings (n,)."""
    count, bound = count_competing_readings(
        cells, heading, alphabet=alphabet, window=window, detect=detect
    )
    if count <= bound:
        return
    side = max_square_side(alphabet, window, detect)
    raise InputError(
        f"this floor has {count} readings {'at one heading ' * (alphabet == 'compass')}of window "
        f"{window}, but only {bound} of alphabet {alphabet} can be different"
        + (f" with {detect} misread landmarks detected" if detect else ""),
        hint=f"make the floor smaller: a square has at most {side} x {side} landmarks",
    )


def count_competing_readings(
    cells: Integers, heading: Integers, *, alphabet: str, window: str, detect: int
) -> tuple[int, int]:
    """Return the readings of windows (n, k, 2) at headings (n,), and how many can be different.

    With ``compass`` the headings share no words: the heading with the most readings counts.
    """
    count, bound = len(cells), max_distinct_readings(alphabet, window, detect)
    words = len(ALPHABET_CODES[alphabet]) ** (len(WINDOW_PATHS[window]) - detect)
    if alphabet == "compass":
        return int(np.bincount(heading, minlength=4).max()), words
    if count <= words and bound < words:
        # A window that is passable in one direction only may read a symmetric word.
        count = _count_reversible_readings(cells, heading)
    return count, bound


def _count_reversible_readings(cells: Integers, heading: Integers) -> int:
    """Return the number of readings whose landmarks are also read at the opposite heading."""
    if not len(cells):
        return 0
    columns = int(cells[..., 1].max()) + 1
    flat = np.sort(cells[..., 0] * columns + cells[..., 1], axis=1)
    # The first and the last cell identify a straight or square window.
    key = np.column_stack([flat[:, 0], flat[:, -1], heading % 2])
    _, count = np.unique(key, axis=0, return_counts=True)
    return int(count[count == 2].sum())
