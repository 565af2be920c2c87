"""Proof of a map: all readings are different; effects of single faults on them."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.design.bounds import max_distinct_readings
from locatk.core.landmarks.design.localization_steps import (
    LocalizationSteps,
    Start,
    count_localization_steps,
)
from locatk.core.landmarks.landmark import CODE_COUNT
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap
from locatk.core.landmarks.map.windows import (
    WINDOW_PATHS,
    Integers,
    WindowReadings,
    encode_readings,
    letters_as_read,
    window_readings,
)

MAX_LISTED_DUPLICATES = 1000
"""Duplicates that are listed; all are counted."""

MAX_LISTED_CELLS = 5
"""Cells that are listed as the worst for a fault."""

MAX_TABLE_WORDS = 1 << 22
"""Words up to which membership is looked up in a table; beyond, in a sorted array."""


class DuplicateReading(NamedTuple):
    """Two starts at which a robot reads the same."""

    first: Start
    second: Start
    letters: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class FaultEffects:
    """Effects of a single fault, tried at each landmark of each reading.

    Attributes
    ----------
    cases : int
        Number of tried combinations of reading and fault.
    harmful : int
        Cases in which the reading is, or may be, that of another position.
    by_cell : (rows, columns) int64 ndarray
        Harmful cases by the cell of the fault.
    worst : tuple of cell
        Cells with the most harmful cases, if there are any.
    """

    cases: int
    harmful: int
    by_cell: Integers
    worst: tuple[Cell, ...]

    @property
    def harmful_fraction(self) -> float:
        """Fraction of the cases that are harmful."""
        return self.harmful / self.cases if self.cases else 0.0


@dataclass(frozen=True, eq=False)
class MapProof:
    """Properties of a map, by exhaustive enumeration.

    Attributes
    ----------
    readings : int
        Number of windows of the floor, over all headings.
    words : int
        Number of readings that can be different (:func:`.max_distinct_readings`).
    duplicate_count : int
        Number of readings that equal an earlier one.
    duplicates : tuple of DuplicateReading
        The first :data:`MAX_LISTED_DUPLICATES` of them.
    min_distance : int or None
        Smallest number of letters in which two readings differ; None for fewer than two readings.
    detects : int
        Number of misread landmarks of a window that are always detected.
    promised : int
        The same number as stated by the map.
    flipped_bar : FaultEffects
        One bar is flipped: harmful if the window then reads like another one, which is not
        noticed; otherwise it reads like none, which is.
    missing_bar : FaultEffects
        One bar is missing and known to be missing: the landmark is one of two. Harmful if the
        window is no longer unique.
    missing_landmark : FaultEffects
        The same for a landmark that cannot be read at all.
    localization : LocalizationSteps or None
        None if it was not requested.
    fingerprint : str
        SHA-256 of :func:`canonical_text`.
    """

    readings: int
    words: int
    duplicate_count: int
    duplicates: tuple[DuplicateReading, ...]
    min_distance: int | None
    detects: int
    promised: int
    flipped_bar: FaultEffects
    missing_bar: FaultEffects
    missing_landmark: FaultEffects
    localization: LocalizationSteps | None
    fingerprint: str

    @property
    def is_unique(self) -> bool:
        """True if no two windows read the same."""
        return self.duplicate_count == 0

    @property
    def holds(self) -> bool:
        """True if the map is unique and detects as many misread landmarks as it states."""
        return self.is_unique and self.detects >= self.promised


def prove_map(floor: FloorMap, *, steps: bool = True) -> MapProof:
    """Prove or refute the uniqueness of a map, and evaluate single faults.

    Parameters
    ----------
    floor : FloorMap
        Map as designed: as-built records are ignored. Its ``detect`` is checked, not assumed.
    steps : bool
        Count the landmarks until localization from each start too.
    """
    readings = window_readings(floor)
    words = encode_readings(readings.letters)
    duplicates, count = _find_duplicates(readings, words)
    distance = min_hamming_distance(readings.letters)
    flipped, missing = _bar_faults(floor, readings, words)
    return MapProof(
        readings=len(readings),
        words=max_distinct_readings(floor.alphabet, floor.window),
        duplicate_count=count,
        duplicates=duplicates,
        min_distance=distance,
        detects=len(WINDOW_PATHS[floor.window]) if distance is None else max(0, distance - 1),
        promised=floor.detect,
        flipped_bar=flipped,
        missing_bar=missing,
        missing_landmark=_missing_landmarks(floor, readings),
        localization=count_localization_steps(floor) if steps else None,
        fingerprint=hashlib.sha256(canonical_text(floor).encode()).hexdigest(),
    )


def canonical_text(floor: FloorMap) -> str:
    """Return the proven map as text: codes as hexadecimal digits, a dot for a hole, and walls."""
    rows, columns = floor.shape
    lines = [f"locatk floor {rows}x{columns} {floor.window} {floor.alphabet} {floor.detect}"]
    lines += [
        "".join("." if c == HOLE_CODE else f"{c:x}" for c in row) for row in floor.codes.tolist()
    ]
    lines += [f"wall {a[0]},{a[1]} {b[0]},{b[1]}" for a, b in sorted(floor.walls)]
    return "\n".join(lines) + "\n"


def min_hamming_distance(letters: Integers) -> int | None:
    """Return the smallest Hamming distance of two rows (n, k); None for fewer than two rows.

    Two rows differ in at most j letters if they agree in some k - j.
    """
    size = letters.shape[1]
    if len(letters) < 2:
        return None
    for dropped in range(size):
        for kept in itertools.combinations(range(size), size - dropped):
            if is_repeated(encode_readings(letters[:, kept])).any():
                return dropped
    return size


def is_repeated(words: Integers) -> NDArray[np.bool_]:
    """Return for each word (n,) whether another one equals it."""
    if len(words) and words.max() < MAX_TABLE_WORDS:
        return np.asarray(np.bincount(words)[words] > 1)
    _, group, count = np.unique(words, return_inverse=True, return_counts=True)
    return np.asarray(count[group] > 1)


def _find_duplicates(
    readings: WindowReadings, words: Integers
) -> tuple[tuple[DuplicateReading, ...], int]:
    _, first, group = np.unique(words, return_index=True, return_inverse=True)
    repeats = np.flatnonzero(first[group] != np.arange(len(words)))

    def start(k: int) -> Start:
        row, column = readings.cells[k, 0].tolist()
        return (row, column), int(readings.heading[k])

    listed = tuple(
        DuplicateReading(start(first[group[k]]), start(k), tuple(readings.letters[k].tolist()))
        for k in repeats[:MAX_LISTED_DUPLICATES].tolist()
    )
    return listed, len(repeats)


def _bar_faults(
    floor: FloorMap, readings: WindowReadings, words: Integers
) -> tuple[FaultEffects, FaultEffects]:
    """Evaluate a flipped bar, and a missing one, which leaves the true word and the flipped one."""
    codes = floor.codes[readings.cells[..., 0], readings.cells[..., 1]]
    value = CODE_COUNT ** np.arange(codes.shape[1])
    valid, is_ambiguous = _WordSet(words), is_repeated(words)[:, None]
    flipped, missing = np.zeros(codes.shape, np.int64), np.zeros(codes.shape, np.int64)
    for bar in range(4):
        misread = letters_as_read(codes ^ (1 << bar), readings.heading[:, None], floor.alphabet)
        is_other_word = valid.contains(words[:, None] + (misread - readings.letters) * value)
        flipped += is_other_word
        missing += is_other_word | is_ambiguous
    cases = 4 * codes.size
    return (
        _fault_effects(floor, readings, flipped, cases),
        _fault_effects(floor, readings, missing, cases),
    )


def _missing_landmarks(floor: FloorMap, readings: WindowReadings) -> FaultEffects:
    size = readings.letters.shape[1]
    harmful = np.zeros(readings.letters.shape, np.int64)
    for missing in range(size):
        kept = [k for k in range(size) if k != missing]
        harmful[:, missing] = is_repeated(encode_readings(readings.letters[:, kept]))
    return _fault_effects(floor, readings, harmful, harmful.size)


def _fault_effects(
    floor: FloorMap, readings: WindowReadings, harmful: Integers, cases: int
) -> FaultEffects:
    """Sum the harmful cases (n, k) by reading and landmark over the cells."""
    columns = floor.shape[1]
    cell_index = (readings.cells[..., 0] * columns + readings.cells[..., 1]).reshape(-1)
    total = np.bincount(cell_index, harmful.reshape(-1), minlength=floor.codes.size)
    total = total.astype(np.int64)
    worst = np.argsort(-total, kind="stable")[:MAX_LISTED_CELLS]
    cells = tuple((int(k) // columns, int(k) % columns) for k in worst if total[k])
    return FaultEffects(cases, int(total.sum()), total.reshape(floor.shape), cells)


class _WordSet:
    """Set of the words of a floor with a vectorised membership test."""

    def __init__(self, words: Integers) -> None:
        self.words = np.unique(words)
        self.table: NDArray[np.bool_] | None = None
        if len(words) and words.max() < MAX_TABLE_WORDS:
            self.table = np.zeros(MAX_TABLE_WORDS, bool)
            self.table[words] = True

    def contains(self, words: Integers) -> NDArray[np.bool_]:
        if self.table is not None:
            in_table = self.table[np.minimum(words, MAX_TABLE_WORDS - 1)]
            return np.asarray((words < MAX_TABLE_WORDS) & in_table)
        if not len(self.words):
            return np.zeros(words.shape, bool)
        index = np.minimum(np.searchsorted(self.words, words), len(self.words) - 1)
        return np.asarray(self.words[index] == words)
