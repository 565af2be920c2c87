"""Many similar lines of numbers, read at once.

Cells are converted with ``float``: numpy.loadtxt reads neither empty cells nor ``nan`` beside them,
and is no faster for the short pieces of a serial line (3.4 against 4.1 s for 8e6 numbers).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.formats.devices.interface import Batch, Counts
from locatk.formats.devices.lines.columns import ColumnLayout
from locatk.formats.devices.lines.text import BLANK, parse_number_row, split_cells

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LineRange = tuple[int, int]
"""Consecutive lines: the first, and the one after the last."""

MAX_COUNTER_GAP = 1000
"""Largest step of a counter that is a loss; a larger one is damage or a restart."""

MAX_RESTART_STEPS = 16
"""Distance from the end of 8, 16 or 32 bits, and from zero, within which a counter wraps."""

_NUMBER_CHARACTERS = b"0123456789+-.eEnNaA "
_OTHER_WEIGHT = 1 << 20
"""Weight of a character that a row of numbers does not contain: more than cells of any line."""


class LineShape(NamedTuple):
    """Form of a row of numbers.

    Attributes
    ----------
    separator : str
    columns : int
    has_trailing_separator : bool
        One more separator ends each line.
    """

    separator: str
    columns: int
    has_trailing_separator: bool = False


class NumberLines(NamedTuple):
    """Lines of numbers.

    Attributes
    ----------
    end : (n,) int64 ndarray
        Bytes up to the end of each line.
    size : (n,) int64 ndarray
        Bytes of each line.
    values : (n, columns) ndarray
    """

    end: Ints
    size: Ints
    values: Array


class LineBlock:
    """Lines of a block of bytes without the empty ones.

    Parameters
    ----------
    block : bytes
        Ends with the end of a line.
    base : int
        Bytes before the block.
    """

    def __init__(self, block: bytes, base: int) -> None:
        self._block = block
        self._codes = np.frombuffer(block.replace(b"\r", b"\n"), np.uint8)
        stop = np.flatnonzero(self._codes == ord("\n"))
        start = np.concatenate([[0], stop[:-1] + 1])
        has_text = stop > start
        self.first_is_empty = not has_text[0]
        self.start, self.stop = start[has_text], stop[has_text]
        self._ranges = list(zip(self.start.tolist(), self.stop.tolist(), strict=True))
        self.base = base

    def __len__(self) -> int:
        return len(self.start)

    def line(self, number: int) -> bytes:
        """Return a line without its end."""
        start, stop = self._ranges[number]
        return self._block[start:stop]

    def end(self, number: int) -> int:
        """Return the number of bytes up to the end of a line."""
        return self.base + self._ranges[number][1] + 1

    def find_other_lines(
        self, first: int, last: int, shape: LineShape | None, max_bytes: int
    ) -> list[int]:
        """Return the lines from ``first`` to before ``last`` that do not look like ``shape``."""
        if shape is None:
            return list(range(first, last))
        start, stop = self.start[first:last], self.stop[first:last]
        codes = self._codes[start[0] : stop[-1]]
        weights = np.full(256, _OTHER_WEIGHT, np.int32)
        weights[list(_NUMBER_CHARACTERS)] = 0
        weights[ord("\n")] = 0
        expected = shape.columns - 1 + shape.has_trailing_separator
        if shape.separator == BLANK:
            # Instead of separators, the beginnings of cells are counted.
            weights[ord("\t")] = 0
            weight = weights[codes]
            in_cell = (codes != ord(" ")) & (codes != ord("\t")) & (codes != ord("\n"))
            weight[0] += in_cell[0]
            weight[1:] += in_cell[1:] & ~in_cell[:-1]
            expected += 1
        else:
            weights[ord(shape.separator)] = 1
            weight = weights[codes]
        fits = np.add.reduceat(weight, start - start[0]) == expected
        fits &= stop - start <= max_bytes
        if shape.has_trailing_separator and shape.separator != BLANK:
            fits &= self._codes[stop - 1] == ord(shape.separator)
        return (first + np.flatnonzero(~fits)).tolist()

    def parse(self, ranges: Sequence[LineRange], shape: LineShape) -> tuple[NumberLines, list[int]]:
        """Parse lines that look like ``shape``.

        Returns
        -------
        (NumberLines, list of int)
            The numbers, and the lines with cells that are not numbers after all.
        """
        lines = np.concatenate([np.arange(first, last) for first, last in ranges])
        width = shape.columns + shape.has_trailing_separator
        raw = b"\n".join(
            self._block[self.start[first] : self.stop[last - 1]] for first, last in ranges
        )
        if b"\r" in raw:
            raw = raw.replace(b"\r", b"\n")
        while b"\n\n" in raw:
            raw = raw.replace(b"\n\n", b"\n")
        separator = shape.separator.encode()
        is_blank = shape.separator == BLANK
        cells = raw.split() if is_blank else raw.replace(b"\n", separator).split(separator)
        damaged: list[int] = []
        try:
            values = np.array([float(cell or b"nan") for cell in cells]).reshape(-1, width)
        except ValueError:
            rows = [
                parse_number_row(split_cells(self.line(k).decode(), shape.separator)) for k in lines
            ]
            damaged = [int(k) for k, row in zip(lines, rows, strict=True) if row is None]
            lines = np.array([k for k, row in zip(lines, rows, strict=True) if row], np.int64)
            values = np.array([row for row in rows if row], float).reshape(-1, width)
        stop = self.stop[lines]
        size = stop - self.start[lines] + 1
        return NumberLines(self.base + stop + 1, size, values[:, : shape.columns]), damaged


class SequenceCounter:
    """Losses by a device's counter of samples, which no checksum protects.

    A jump counts only if the next value continues from there.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._unconfirmed: int | None = None

    def restart(self) -> None:
        """Forget the count after an interruption of the connection."""
        self._last = self._unconfirmed = None

    def count_lost(self, counts: Ints) -> int:
        """Return how many samples are missing before and between the next counts.

        A jump at the end is reported with later counts. A counter that starts again belongs to a
        device that restarted, unless it was about to overflow 8, 16 or 32 bits.
        """
        if not len(counts):
            return 0
        first = int(counts[0])
        continues = self._unconfirmed is None and self._last is not None and first == self._last + 1
        if continues and np.all(counts[1:] - counts[:-1] == 1):
            self._last = int(counts[-1])
            return 0
        return sum(map(self._step, counts.tolist()))

    def _step(self, count: int) -> int:
        last, unconfirmed = self._last, self._unconfirmed
        if unconfirmed is None:
            if last is not None and 0 <= count - last <= 1:
                self._last = count
            else:
                self._unconfirmed = count
            return 0
        if 0 < count - unconfirmed <= MAX_COUNTER_GAP:
            self._last, self._unconfirmed = count, None
            return count - unconfirmed - 1 + (0 if last is None else _missing(last, unconfirmed))
        if last is not None and 0 < count - last - 1 <= MAX_COUNTER_GAP:
            self._last, self._unconfirmed = count, None
            return count - last - 2
        self._unconfirmed = count
        return 0


def _missing(last: int, count: int) -> int:
    """Return the number of samples between two counts; none if the counter restarted."""
    if count > last:
        return count - last - 1
    for bits in (8, 16, 32):
        if (1 << bits) - MAX_RESTART_STEPS <= last < 1 << bits and count < MAX_RESTART_STEPS:
            return (count - last - 1) & ((1 << bits) - 1)
    return 0


class LineTable:
    """Collector of lines with the same columns, until they become records.

    Attributes
    ----------
    layout : ColumnLayout
    is_named : bool
        The columns have names, from a header, from pairs, or from the user.
    shape : LineShape
        Form of the last line that was read alone.
    counter : SequenceCounter
    """

    def __init__(self, layout: ColumnLayout, shape: LineShape, *, is_named: bool) -> None:
        self.layout = layout
        self.is_named = is_named
        self.shape = shape
        self.counter = SequenceCounter()
        self._has_wide_clock = False
        self._blocks: list[NumberLines] = []
        self._single: list[tuple[int, int, list[float]]] = []

    def accepts(self, count: int, separator: str, has_trailing_separator: bool) -> bool:
        """Return whether a line of ``count`` numbers is a row, and expect its form if it is."""
        columns = self.shape.columns
        if count != columns:
            if not has_trailing_separator or count - 1 != columns:
                return False
            self.shape = LineShape(separator, columns, True)
        elif columns > 1:
            self.shape = LineShape(separator, columns)
        return True

    def add_block(self, lines: NumberLines) -> None:
        """Add many lines."""
        self._blocks.append(lines)

    def add_line(self, end: int, size: int, values: list[float]) -> None:
        """Add one line."""
        self._single.append((end, size, values))

    def take_records(self, counts: Counts) -> list[Batch]:
        """Return the records of all added lines, and count the lines in ``counts``."""
        if self._single:
            ends, sizes, rows = zip(*self._single, strict=True)
            self._blocks.append(NumberLines(np.array(ends), np.array(sizes), np.array(rows, float)))
            self._single = []
        if not self._blocks:
            return []
        lines = NumberLines(*(np.concatenate(part) for part in zip(*self._blocks, strict=True)))
        self._blocks = []
        order = np.argsort(lines.end, kind="stable")
        end, size, values = lines.end[order], lines.size[order], lines.values[order]
        is_damaged = self.layout.is_damaged(values)
        if is_damaged.any():
            counts.bad += int(is_damaged.sum())
            counts.skipped += int(size[is_damaged].sum())
            end, values = end[~is_damaged], values[~is_damaged]
        counts.frames += len(end)
        sequence = self.layout.sequences(values)
        if sequence is not None:
            counts.lost += self.counter.count_lost(np.rint(sequence).astype(np.int64))
        batches, self._has_wide_clock = self.layout.batches(values, end, self._has_wide_clock)
        return batches
