"""Maps that ship with locatk, and floors that are cropped from them.

The maps were found by long searches. A part of a unique map is unique, also with holes and walls:
these only remove readings.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.landmarks.design.alternatives import DesignAdvisor
from locatk.core.landmarks.design.generation import (
    DesignOptions,
    design_map,
    empty_floor,
    with_codes,
)
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, PATTERNS, code_of, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.landmarks.map.windows import ALPHABET_CODES

Codes = NDArray[np.int64]

_FILE_NAME = re.compile(
    r"(?P<alphabet>\w+)_(?P<window>\w+)_(?P<detect>\d+)_(?P<rows>\d+)x(?P<columns>\d+)"
)


@dataclass(frozen=True)
class LibraryMap:
    """Map of the library: a text file with one line of hexadecimal codes a row."""

    file: str
    alphabet: str
    window: str
    detect: int
    rows: int
    columns: int

    def codes(self) -> Codes:
        """Return the codes (rows, columns); the first line of the file is row 0."""
        return _codes(self.file).copy()


@functools.cache
def library_maps() -> tuple[LibraryMap, ...]:
    """Return all maps of the library in the order of their sizes."""
    maps = []
    for item in (resources.files("locatk.formats.artifacts") / "library_maps").iterdir():
        if match := _FILE_NAME.fullmatch(item.name.removesuffix(".txt")):
            numbers = (int(match[key]) for key in ("detect", "rows", "columns"))
            maps.append(LibraryMap(item.name, match["alphabet"], match["window"], *numbers))
    return tuple(sorted(maps, key=lambda e: (e.rows * e.columns, e.file)))


@functools.cache
def _codes(file: str) -> Codes:
    text = (resources.files("locatk.formats.artifacts") / "library_maps" / file).read_text(
        encoding="ascii"
    )
    return np.array([[int(digit, 16) for digit in line] for line in text.split()], np.int64)


def crop_map(options: DesignOptions) -> FloorMap | None:
    """Crop a floor from a map of the library; return None if no map is large enough.

    The seed determines the part, the rotation of the map, and the exchange of letters, which keeps
    different readings different (:func:`random_relabelling`). The floor is proved again.

    Raises
    ------
    InputError
        The options are invalid.
    """
    blank = empty_floor(options)
    # The sequence of a RandomState is the same in all versions of numpy.
    random = np.random.RandomState(options.seed % 2**32)
    size = (options.rows, options.columns)
    for entry in library_maps():
        rotations = _fitting_rotations(options, entry)
        if not rotations:
            continue
        quarters = rotations[random.randint(len(rotations))]
        codes = rotated_map(entry.codes(), quarters, options.alphabet)
        row, column = (
            random.randint(available - required + 1)
            for available, required in zip(codes.shape, size, strict=True)
        )
        codes = codes[row : row + options.rows, column : column + options.columns]
        codes = random_relabelling(options.alphabet, random)[codes]
        note = f"cut of the map {entry.file.removesuffix('.txt')} of the library"
        has_landmark = blank.codes != HOLE_CODE
        floor = with_codes(blank, np.where(has_landmark, codes, HOLE_CODE), options.seed, (note,))
        if prove_map(floor, steps=False).holds:
            return floor
    return None


def design_or_crop(
    options: DesignOptions, progress: Callable[[float, int], None] | None = None
) -> FloorMap:
    """Crop a floor from the library, or search one if no map of the library is large enough.

    Raises
    ------
    InputError, DegenerateError
        See :func:`locatk.core.landmarks.design.generation.design_map`; the hint names changes of
        the options with which a map is found.
    """
    floor = crop_map(options)
    if floor is not None:
        return floor
    try:
        return design_map(options, progress)
    except (InputError, DegenerateError) as error:
        changes = list(DesignAdvisor(options, _is_in_library).iter_changes())
        error.hint = f"use {', or '.join(changes)}" if changes else error.hint
        raise


def _is_in_library(options: DesignOptions) -> bool:
    return any(_fitting_rotations(options, entry) for entry in library_maps())


def _fitting_rotations(options: DesignOptions, entry: LibraryMap) -> list[int]:
    """Return the rotations of a map of the library in which it contains the floor."""
    is_suitable = (entry.alphabet, entry.window) == (options.alphabet, options.window)
    if not is_suitable or entry.detect < options.detect:
        return []
    shapes = [(entry.rows, entry.columns), (entry.columns, entry.rows)]
    return [
        quarters
        for quarters in range(4)
        if options.rows <= shapes[quarters % 2][0] and options.columns <= shapes[quarters % 2][1]
    ]


def rotated_map(codes: Codes, quarters: int, alphabet: str) -> Codes:
    """Return a map that is rotated counter-clockwise by quarter turns.

    In alphabets without free orientations each landmark keeps its own.
    """
    grid = np.rot90(codes, -quarters)  # rows count upward, not downward
    return rotated(grid, quarters) if alphabet == "16" else np.ascontiguousarray(grid)


def random_relabelling(alphabet: str, random: np.random.RandomState) -> Codes:
    """Draw the codes (16,) that replace the codes 0 to 15, such that a unique map stays unique.

    Letters are exchanged in the same way under each heading: a pattern for another one with as many
    orientations, each rotated by an angle of its own.
    """
    table = np.arange(CODE_COUNT)
    if alphabet != "16":
        codes = np.array(ALPHABET_CODES[alphabet])
        table[codes] = random.permutation(codes)
        return table
    orientations = np.bincount(PATTERN_OF)[1:]
    for count in (1, 2, 4):
        patterns = np.flatnonzero(orientations == count)
        for first, second in zip(patterns, random.permutation(patterns), strict=True):
            offset = random.randint(4)
            for quarters in range(4):
                old = rotated(code_of(PATTERNS[first]), quarters)
                table[old] = rotated(code_of(PATTERNS[second]), quarters + offset)
    return table
