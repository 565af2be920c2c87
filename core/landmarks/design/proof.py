"""The proof of a map: that no two readings are the same, and what faults would do to it."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.design.bounds import readings_bound
from locatk.core.landmarks.design.localization_steps import Localisation, Place, localise
from locatk.core.landmarks.landmark import CODE_COUNT
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap
from locatk.core.landmarks.map.windows import PATHS, Integers, Readings, as_read, encoded, readings

LISTED_DUPLICATES = 1000

LISTED_CELLS = 5

TABLE = 1 << 22
"""Words that are marked in a table; more are sorted."""


class Duplicate(NamedTuple):
    """Two places that read the same."""

    one: Place
    other: Place
    letters: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Faults:
    """What one fault, at any place, would do.

    Attributes
    ----------
    cases : int
        Readings over which the fault was tried, at each of their landmarks.
    harmful : int
        Cases after which the reading is of another place, or may be.
    by_cell : (rows, columns) int64 ndarray
        Harmful cases by the cell of the fault.
    worst : tuple of cell
        Those with the most, where there are any.
    """

    cases: int
    harmful: int
    by_cell: Integers
    worst: tuple[Cell, ...]

    @property
    def share(self) -> float:
        """Of the cases, those that are harmful."""
        return self.harmful / self.cases if self.cases else 0.0


@dataclass(frozen=True, eq=False)
class Proof:
    """What holds for a map.

    Attributes
    ----------
    readings : int
        Windows of the floor, each under each heading.
    words : int
        Readings that are possible at all (:func:`.readings_bound`).
    duplicate_count : int
        Readings that an earlier place has too.
    duplicates : tuple of Duplicate
        The first :data:`LISTED_DUPLICATES` of them.
    least_distance : int or None
        Landmarks in which any two readings differ at least; None below two readings.
    detects : int
        How many misread landmarks of a window are always noticed.
    promised : int
        How many the map says.
    flipped_bar : Faults
        One bar lies the wrong way round: harmful where the window then reads as another
        place, silently; else it reads as none, which is noticed.
    missing_bar : Faults
        One bar is not there, and seen to be missing: the landmark is one of two. Harmful
        where the window does not tell its place any more.
    missing_landmark : Faults
        The same of a landmark that cannot be read at all.
    localisation : Localisation or None
        None where it was not asked for.
    fingerprint : str
        SHA-256 of :func:`canonical`.
    """

    readings: int
    words: int
    duplicate_count: int
    duplicates: tuple[Duplicate, ...]
    least_distance: int | None
    detects: int
    promised: int
    flipped_bar: Faults
    missing_bar: Faults
    missing_landmark: Faults
    localisation: Localisation | None
    fingerprint: str

    @property
    def unique(self) -> bool:
        """Whether each reading belongs to one place only."""
        return self.duplicate_count == 0

    @property
    def holds(self) -> bool:
        """Whether the map is what it says: unique, and misreadings noticed as promised."""
        return self.unique and self.detects >= self.promised

    @property
    def landmarks_mean(self) -> float | None:
        """Landmarks to visit until the place is known, over all starts."""
        return self.localisation.mean if self.localisation else None

    @property
    def landmarks_p99(self) -> float | None:
        """The same, for all but one start in a hundred."""
        return self.localisation.p99 if self.localisation else None

    @property
    def landmarks_worst(self) -> int | None:
        """The same, for the worst start that can be told from the others."""
        return self.localisation.worst if self.localisation else None


def prove(floor: FloorMap, *, steps: bool = True) -> Proof:
    """Everything that can be said of a map, exactly.

    Parameters
    ----------
    floor : FloorMap
        Any; what it promises is not believed.
    steps : bool
        Whether landmarks to localise are counted from each start too.
    """
    seen = readings(floor)
    words = encoded(seen.letters)
    duplicates, count = _duplicates(seen, words)
    distance = least_distance(seen.letters)
    flipped, missing = _bars(floor, seen, words)
    return Proof(
        readings=len(seen),
        words=readings_bound(floor.alphabet, floor.window),
        duplicate_count=count,
        duplicates=duplicates,
        least_distance=distance,
        detects=len(PATHS[floor.window]) if distance is None else max(0, distance - 1),
        promised=floor.detect,
        flipped_bar=flipped,
        missing_bar=missing,
        missing_landmark=_landmarks(floor, seen),
        localisation=localise(floor) if steps else None,
        fingerprint=hashlib.sha256(canonical(floor).encode()).hexdigest(),
    )


def canonical(floor: FloorMap) -> str:
    """What the proof is about, as text: codes as hexadecimal digits, a dot for a hole."""
    rows, columns = floor.shape
    lines = [f"locatk floor {rows}x{columns} {floor.window} {floor.alphabet} {floor.detect}"]
    lines += ["".join("." if c == HOLE else f"{c:x}" for c in row) for row in floor.codes.tolist()]
    lines += [f"wall {a[0]},{a[1]} {b[0]},{b[1]}" for a, b in sorted(floor.walls)]
    return "\n".join(lines) + "\n"


def least_distance(letters: Integers) -> int | None:
    """Places in which any two rows of letters (n, k) differ at least; None below two rows.

    Two rows differ in at most j places where they agree in some k - j.
    """
    size = letters.shape[1]
    if len(letters) < 2:
        return None
    for dropped in range(size):
        for kept in itertools.combinations(range(size), size - dropped):
            if repeated(encoded(letters[:, kept])).any():
                return dropped
    return size


def repeated(words: Integers) -> NDArray[np.bool_]:
    """(n,) whether another one is the same."""
    if len(words) and words.max() < TABLE:
        return np.asarray(np.bincount(words)[words] > 1)
    _, group, count = np.unique(words, return_inverse=True, return_counts=True)
    return np.asarray(count[group] > 1)


def _duplicates(seen: Readings, words: Integers) -> tuple[tuple[Duplicate, ...], int]:
    _, first, group = np.unique(words, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[group] != np.arange(len(words)))

    def place(k: int) -> Place:
        row, column = seen.cells[k, 0].tolist()
        return (row, column), int(seen.heading[k])

    listed = tuple(
        Duplicate(place(first[group[k]]), place(k), tuple(seen.letters[k].tolist()))
        for k in again[:LISTED_DUPLICATES].tolist()
    )
    return listed, len(again)


def _bars(floor: FloorMap, seen: Readings, words: Integers) -> tuple[Faults, Faults]:
    """One bar flipped; one bar missing, which leaves the true word and the flipped one."""
    codes = floor.codes[seen.cells[..., 0], seen.cells[..., 1]]
    value = CODE_COUNT ** np.arange(codes.shape[1])
    valid, doubtful = _Valid(words), repeated(words)[:, None]
    flipped, missing = np.zeros(codes.shape, np.int64), np.zeros(codes.shape, np.int64)
    for bar in range(4):
        wrong = as_read(codes ^ (1 << bar), seen.heading[:, None], floor.alphabet)
        elsewhere = valid.has(words[:, None] + (wrong - seen.letters) * value)
        flipped += elsewhere
        missing += elsewhere | doubtful
    cases = 4 * codes.size
    return _faults(floor, seen, flipped, cases), _faults(floor, seen, missing, cases)


def _landmarks(floor: FloorMap, seen: Readings) -> Faults:
    size = seen.letters.shape[1]
    harmful = np.zeros(seen.letters.shape, np.int64)
    for lost in range(size):
        kept = [place for place in range(size) if place != lost]
        harmful[:, lost] = repeated(encoded(seen.letters[:, kept]))
    return _faults(floor, seen, harmful, harmful.size)


def _faults(floor: FloorMap, seen: Readings, harmful: Integers, cases: int) -> Faults:
    """``harmful`` (n, k) counts the harmful cases by reading and landmark."""
    columns = floor.shape[1]
    at = (seen.cells[..., 0] * columns + seen.cells[..., 1]).reshape(-1)
    total = np.bincount(at, harmful.reshape(-1), minlength=floor.codes.size).astype(np.int64)
    worst = np.argsort(-total, kind="stable")[:LISTED_CELLS]
    cells = tuple((int(k) // columns, int(k) % columns) for k in worst if total[k])
    return Faults(cases, int(total.sum()), total.reshape(floor.shape), cells)


class _Valid:
    """The words of a floor, to be asked for."""

    def __init__(self, words: Integers) -> None:
        self.words = np.unique(words)
        self.table: NDArray[np.bool_] | None = None
        if len(words) and words.max() < TABLE:
            self.table = np.zeros(TABLE, bool)
            self.table[words] = True

    def has(self, words: Integers) -> NDArray[np.bool_]:
        if self.table is not None:
            return np.asarray((words < TABLE) & self.table[np.minimum(words, TABLE - 1)])
        at = np.minimum(np.searchsorted(self.words, words), len(self.words) - 1)
        return (
            np.asarray(self.words[at] == words) if len(self.words) else np.zeros(words.shape, bool)
        )
