"""Maps that ship with locatk, found by long searches, of which floors are cut.

Any part of a unique map is unique, with holes and walls too: they only take readings away.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.design.generation import DesignOptions, empty_floor, with_codes
from locatk.core.landmarks.design.generation import design_map as search
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, PATTERNS, code_of, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.landmarks.map.windows import ALPHABET_CODES

Codes = NDArray[np.int64]

NAME = re.compile(
    r"(?P<alphabet>\w+)_(?P<window>\w+)_(?P<detect>\d+)_(?P<rows>\d+)x(?P<columns>\d+)"
)


@dataclass(frozen=True)
class Entry:
    """One map of the library: a text file, a line a row of hexadecimal codes."""

    file: str
    alphabet: str
    window: str
    detect: int
    rows: int
    columns: int

    def codes(self) -> Codes:
        """(rows, columns) codes; the first line of the file is row 0."""
        return _codes(self.file).copy()


@functools.cache
def entries() -> tuple[Entry, ...]:
    """All maps of the library, the smallest first."""
    found = []
    for item in (resources.files("locatk.formats.artifacts") / "floors").iterdir():
        if match := NAME.fullmatch(item.name.removesuffix(".txt")):
            numbers = (int(match[key]) for key in ("detect", "rows", "columns"))
            found.append(Entry(item.name, match["alphabet"], match["window"], *numbers))
    return tuple(sorted(found, key=lambda e: (e.rows * e.columns, e.file)))


@functools.cache
def _codes(file: str) -> Codes:
    text = (resources.files("locatk.formats.artifacts") / "floors" / file).read_text(
        encoding="ascii"
    )
    return np.array([[int(digit, 16) for digit in line] for line in text.split()], np.int64)


def crop(options: DesignOptions) -> FloorMap | None:
    """A floor cut of a map of the library, or None where none is large enough.

    The seed chooses where it is cut, how the map is turned, and which letters change places:
    no two readings become the same by that (:func:`relabelling`). It is proved again.

    Raises
    ------
    InputError
        The options are none.
    """
    blank = empty_floor(options)
    random = np.random.RandomState(options.seed % 2**32)  # its numbers never change
    size = (options.rows, options.columns)
    for entry in entries():
        if (entry.alphabet, entry.window) != (options.alphabet, options.window):
            continue
        fitting = [turn for turn in range(4) if _fits(size, entry, turn)]
        if entry.detect < options.detect or not fitting:
            continue
        codes = turned(entry.codes(), fitting[random.randint(len(fitting))], options.alphabet)
        row, column = (
            random.randint(have - want + 1) for have, want in zip(codes.shape, size, strict=True)
        )
        codes = codes[row : row + options.rows, column : column + options.columns]
        codes = relabelling(options.alphabet, random)[codes]
        note = f"cut of the map {entry.file.removesuffix('.txt')} of the library"
        there = blank.codes != HOLE_CODE
        floor = with_codes(blank, np.where(there, codes, HOLE_CODE), options.seed, (note,))
        if prove_map(floor, steps=False).holds:
            return floor
    return None


def design(
    options: DesignOptions, progress: Callable[[float, int], None] | None = None
) -> FloorMap:
    """A floor as wanted: cut of the library where it has a map, else searched for.

    Raises
    ------
    InputError, DegenerateError
        See :func:`locatk.core.landmarks.design.generation.design_map`.
    """
    floor = crop(options)
    return search(options, progress) if floor is None else floor


def _fits(size: tuple[int, int], entry: Entry, turn: int) -> bool:
    rows, columns = (entry.rows, entry.columns) if turn % 2 == 0 else (entry.columns, entry.rows)
    return size[0] <= rows and size[1] <= columns


def turned(codes: Codes, quarters: int, alphabet: str) -> Codes:
    """A map turned counter-clockwise as a whole, seen with y up.

    Where the orientation of the landmarks is not free, each keeps its own.
    """
    grid = np.rot90(codes, -quarters)  # rows go up here, not down
    return rotated(grid, quarters) if alphabet == "16" else np.ascontiguousarray(grid)


def relabelling(alphabet: str, random: np.random.RandomState) -> Codes:
    """(16,) codes that take the place of the others, drawn at random.

    Letters may change places if the map as read changes them alike under each heading:
    patterns with as many orientations for each other, and each by a turn of its own.
    """
    table = np.arange(CODE_COUNT)
    if alphabet != "16":
        codes = np.array(ALPHABET_CODES[alphabet])
        table[codes] = random.permutation(codes)
        return table
    orientations = np.bincount(PATTERN_OF)[1:]
    for count in (1, 2, 4):
        same = np.flatnonzero(orientations == count)
        for one, other in zip(same, random.permutation(same), strict=True):
            quarter = random.randint(4)
            for turn in range(4):
                old = rotated(code_of(PATTERNS[one]), turn)
                table[old] = rotated(code_of(PATTERNS[other]), turn + quarter)
    return table
