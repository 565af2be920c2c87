"""Lines of numbers that are all alike, read many at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.formats.devices.decoder import Batch, Counts
from locatk.formats.devices.lines.columns import Meaning
from locatk.formats.devices.lines.text import BLANK, cells, numbers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

Range = tuple[int, int]
"""Lines that follow each other: the first, and the one after the last."""

NEAR = 1000
"""Steps of a counter up to which it counts on."""

_OF_NUMBERS = b"0123456789+-.eEnNaA "
_WRONG = 1 << 20


class Shape(NamedTuple):
    """What lines look like: how cells are separated, how many there are, and whether one
    more separator ends them."""

    separator: str
    columns: int
    trailing: bool = False


class Rows(NamedTuple):
    """Lines of numbers: where they end, how many bytes they have, and the numbers."""

    end: Ints
    size: Ints
    values: Array


class Lines:
    """Lines of a block of bytes, none of them empty.

    Parameters
    ----------
    block : bytes
        It ends with the end of a line.
    base : int
        Bytes before it.
    """

    def __init__(self, block: bytes, base: int) -> None:
        self._block = block
        self._codes = np.frombuffer(block.replace(b"\r", b"\n"), np.uint8)
        stop = np.flatnonzero(self._codes == 10)
        start = np.concatenate([[0], stop[:-1] + 1])
        there = stop > start
        self.first_is_empty = not there[0]
        self.start, self.stop = start[there], stop[there]
        self._places = list(zip(self.start.tolist(), self.stop.tolist(), strict=True))
        self.base = base

    def __len__(self) -> int:
        return len(self.start)

    def line(self, number: int) -> bytes:
        """One of them, without its end."""
        start, stop = self._places[number]
        return self._block[start:stop]

    def end(self, number: int) -> int:
        """Bytes up to the end of one."""
        return self.base + self._places[number][1] + 1

    def odd(self, first: int, last: int, shape: Shape | None, longest: int) -> list[int]:
        """Those of ``first`` to ``last`` that do not look like ``shape``."""
        if shape is None:
            return list(range(first, last))
        start, stop = self.start[first:last], self.stop[first:last]
        codes = self._codes[start[0] : stop[-1]]
        weights = np.full(256, _WRONG, np.int32)
        weights[list(_OF_NUMBERS)] = 0
        weights[10] = 0
        cells = shape.columns - 1 + shape.trailing
        if shape.separator == BLANK:
            weights[9] = 0
            found = weights[codes]
            inside = (codes != 32) & (codes != 9) & (codes != 10)
            found[0] += inside[0]
            found[1:] += inside[1:] & ~inside[:-1]
            cells += 1
        else:
            weights[ord(shape.separator)] = 1
            found = weights[codes]
        fits = np.add.reduceat(found, start - start[0]) == cells
        fits &= stop - start <= longest
        if shape.trailing and shape.separator != BLANK:
            fits &= self._codes[stop - 1] == ord(shape.separator)
        return (first + np.flatnonzero(~fits)).tolist()

    def rows(self, ranges: Sequence[Range], shape: Shape) -> tuple[Rows, list[int]]:
        """Numbers of lines that are like ``shape``; and those whose cells are no numbers all
        the same."""
        picked = np.concatenate([np.arange(first, last) for first, last in ranges])
        wide = shape.columns + shape.trailing
        raw = b"\n".join(
            self._block[self.start[first] : self.stop[last - 1]] for first, last in ranges
        )
        if b"\r" in raw:
            raw = raw.replace(b"\r", b"\n")
        while b"\n\n" in raw:
            raw = raw.replace(b"\n\n", b"\n")
        try:
            separated = shape.separator.encode()
            parts = raw.split() if shape.separator == BLANK else raw.replace(b"\n", separated)
            found = parts if isinstance(parts, list) else parts.split(separated)
            values = np.array([float(cell or b"nan") for cell in found]).reshape(-1, wide)
            wrong: list[int] = []
        except ValueError:
            read = [numbers(cells(self.line(i).decode(), shape.separator)) for i in picked]
            wrong = [int(i) for i, row in zip(picked, read, strict=True) if row is None]
            picked = np.array([i for i, row in zip(picked, read, strict=True) if row], np.int64)
            values = np.array([row for row in read if row], float).reshape(-1, wide)
        stop = self.stop[picked]
        size = stop - self.start[picked] + 1
        return Rows(self.base + stop + 1, size, values[:, : shape.columns]), wrong


class Counter:
    """A device's counter of samples, which no checksum protects: a jump is believed when the
    count goes on from there."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._held: int | None = None

    def restart(self) -> None:
        """Nobody listened for a while."""
        self._last = self._held = None

    def lost(self, counts: Ints) -> int:
        """How many are missing before the next ones; what the last leaves open is told later.

        A counter that starts again is one of a device that did, unless it was about to
        overflow 8, 16 or 32 bits.
        """
        if not len(counts):
            return 0
        first = int(counts[0])
        steady = self._held is None and self._last is not None and first == self._last + 1
        if steady and np.all(counts[1:] - counts[:-1] == 1):
            self._last = int(counts[-1])
            return 0
        return sum(map(self._step, counts.tolist()))

    def _step(self, count: int) -> int:
        last, held = self._last, self._held
        if held is None:
            if last is not None and 0 <= count - last <= 1:
                self._last = count
            else:
                self._held = count
            return 0
        if 0 < count - held <= NEAR:
            self._last, self._held = count, None
            return count - held - 1 + (0 if last is None else _missing(last, held))
        if last is not None and 0 < count - last - 1 <= NEAR:
            self._last, self._held = count, None
            return count - last - 2
        self._held = count
        return 0


def _missing(last: int, count: int) -> int:
    """Between two counts, the later of which may have started again."""
    if count > last:
        return count - last - 1
    for bits in (8, 16, 32):
        if (1 << bits) - 16 <= last < 1 << bits and count < 16:
            return (count - last - 1) & ((1 << bits) - 1)
    return 0


class Table:
    """Lines of the same columns: their rows, until they become records.

    Attributes
    ----------
    named : bool
        Somebody has named the columns.
    shape : Shape
        What the last line that was looked at alone was like.
    counter : Counter
    """

    def __init__(self, meaning: Meaning, shape: Shape, *, named: bool) -> None:
        self.meaning = meaning
        self.named = named
        self.shape = shape
        self.counter = Counter()
        self._wide = False
        self._rows: list[Rows] = []
        self._single: list[tuple[int, int, list[float]]] = []

    def takes(self, count: int, separator: str, trailing: bool) -> bool:
        """Whether so many numbers are a row; its shape is then that of such lines."""
        columns = self.shape.columns
        if count != columns:
            if not trailing or count - 1 != columns:
                return False
            self.shape = Shape(separator, columns, True)
        elif columns > 1:
            self.shape = Shape(separator, columns)
        return True

    def add(self, rows: Rows) -> None:
        """Take many rows."""
        self._rows.append(rows)

    def add_one(self, end: int, size: int, values: list[float]) -> None:
        """Take one."""
        self._single.append((end, size, values))

    def records(self, counts: Counts) -> list[Batch]:
        """Records of all rows that were taken, which are counted in ``counts``."""
        if self._single:
            ends, sizes, single = zip(*self._single, strict=True)
            self._rows.append(Rows(np.array(ends), np.array(sizes), np.array(single, float)))
            self._single = []
        if not self._rows:
            return []
        rows = Rows(*(np.concatenate(part) for part in zip(*self._rows, strict=True)))
        self._rows = []
        order = np.argsort(rows.end, kind="stable")
        end, size, values = rows.end[order], rows.size[order], rows.values[order]
        wrong = self.meaning.wrong(values)
        if wrong.any():
            counts.bad += int(wrong.sum())
            counts.skipped += int(size[wrong].sum())
            end, values = end[~wrong], values[~wrong]
        counts.frames += len(end)
        if self.meaning.sequence is not None:
            column = values[:, self.meaning.sequence]
            counts.lost += self.counter.lost(np.rint(column).astype(np.int64))
        batches, self._wide = self.meaning.records(values, end, self._wide)
        return batches
