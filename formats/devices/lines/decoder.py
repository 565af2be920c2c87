"""Decoder of lines of text, as sketches print them.

``\\n``, ``\\r\\n`` or ``\\r`` ends a line. It is one of

* numbers, separated by commas, semicolons, tabs or blanks, all lines alike. Names come from
  a header, which may be repeated, or from the user; without either they are ``c0``, ``c1``,
  ... An empty cell or ``nan`` is no value;
* ``name:value``, several separated in the same ways (Arduino's serial plotter);
* ``>name:value`` and ``>name:milliseconds:value;...``, with ``§unit`` and ``|flags``
  (Teleplot, github.com/nesnes/teleplot; on serial lines, text without ``>`` is a log);
* other text, which is logged: boot messages. Text with control characters, or that consists
  of numbers for the most part, is damaged.

:mod:`.columns` lists the meaning of names. Values of Teleplot are readings, ``name[unit]``.

A connection rarely begins at the start of a line: numbers in the first one are ignored. Numbers
without names define the number of columns when two consecutive lines agree.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.formats.devices.interface import Batch, Counts, Options, Stream, Ticks
from locatk.formats.devices.lines.blocks import LineBlock, LineRange, LineShape, LineTable
from locatk.formats.devices.lines.columns import TICK_HZ, interpret_columns
from locatk.formats.devices.lines.text import (
    BLANK,
    MAX_TIME_MS,
    PairLineCache,
    count_columns,
    detect_separator,
    is_damaged_row,
    is_garbage,
    parse_header,
    parse_number_row,
    parse_pairs,
    parse_telemetry,
    split_cells,
)

MAX_LINE_BYTES = 1 << 16
"""Longer lines are damaged."""

PIECE_BYTES = 1 << 16
"""Bytes that are decoded together."""

MAX_TABLES = 256
"""Sets of names of ``name:value``, and different remarks, that are remembered."""

FIRST_SPAN_LINES = 256
"""Lines whose form is compared at first after a change of the columns."""

INFO_LEVEL = 2
"""Level of printed text in the log (``foxglove.Log``)."""

_ANSI_COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


class TextLine(NamedTuple):
    """Line that waits for its successor: text, bytes up to its end, and its size in bytes."""

    text: str
    end: int
    size: int


class PendingHeader(NamedTuple):
    """Names that become a header if numbers follow, otherwise words."""

    names: tuple[str, ...]
    line: TextLine
    has_mismatch: bool
    """One line of another number of cells followed, which may be damaged."""


Point = tuple[int, int, list[float]]
"""Readings that came alone: bytes up to their end, tick and values."""


class LineDecoder:
    """Decoder of lines of text; a :class:`.decoder.Decoder`.

    Parameters
    ----------
    options : Options
        ``columns`` names the numbers of a line; headers are then ignored.

    Attributes
    ----------
    counts : Counts
        ``frames`` are lines that were understood, including headers and text.
    remarks : list of str

    Raises
    ------
    InputError
        Two of the columns have the same name.
    """

    def __init__(self, options: Options | None = None) -> None:
        names = () if options is None else options.columns
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:
            raise InputError(f"two columns are called {repeated!r}")
        self.counts = Counts()
        self.remarks: list[str] = []
        self._made_remarks: set[str] = set()
        # Tables of the lines: the current one, and those of names with values.
        self._has_fixed_names = bool(names)
        self._table: LineTable | None = None
        self._pair_tables: dict[tuple[str, ...], LineTable] = {}
        self._pair_lines: PairLineCache[LineTable | Stream] = PairLineCache()
        # Lines whose meaning depends on the next one.
        self._header: PendingHeader | None = None
        self._row: TextLine | None = None
        # Bytes of an incomplete line, and the number of those dropped from an overlong one.
        self._tail = bytearray()
        self._dropped_bytes = 0
        # The next line is whole; the current line is half; any line was understood.
        self._next_is_whole = self._is_half = self._has_understood = False
        # Records since the last batches.
        self._touched: dict[int, LineTable] = {}
        self._log: list[tuple[int, str]] = []
        self._points: dict[Stream, list[Point]] = {}
        if names:
            self._table = self._new_table(names, is_named=True)

    # ---- interface of Decoder

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """See :meth:`.decoder.Decoder.feed`; a pause has no meaning in text."""
        for start in range(0, len(data), PIECE_BYTES):
            self._feed(data[start : start + PIECE_BYTES])
        return self._take_batches()

    def restart(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.restart`; the columns stay known."""
        batches = self.finish()
        self._next_is_whole = False
        for table in (self._table, *self._pair_tables.values()):
            if table is not None:
                table.counter.restart()
        return batches

    def finish(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.finish`. A line without an end is incomplete."""
        self._tail.clear()
        self._dropped_bytes = 0
        self._settle_header()
        if self._row is not None and self._table is None:
            self._begin_table([self._row])
        self._reject_row()
        return self._take_batches()

    # ---- bytes to lines

    def _feed(self, data: bytes) -> None:
        base = self.counts.bytes - len(self._tail)
        self.counts.bytes += len(data)
        cut = max(data.rfind(b"\n"), data.rfind(b"\r")) + 1
        if cut:
            block = bytes(self._tail) + data[:cut]
            self._tail[:] = data[cut:]
            if self._dropped_bytes:
                base, block = self._skip_overlong_line(base, block)
            if block:
                self._decode_block(block, base)
        else:
            self._tail += data
        if len(self._tail) > MAX_LINE_BYTES:
            self._dropped_bytes += len(self._tail)
            self._tail.clear()

    def _skip_overlong_line(self, base: int, block: bytes) -> tuple[int, bytes]:
        """Return a block without the end of a line that was too long."""
        end = len(block.replace(b"\r", b"\n").partition(b"\n")[0]) + 1
        self._begin_line()
        self._count_bad(self._dropped_bytes + end)
        self._dropped_bytes = 0
        return base + end, block[end:]

    def _decode_block(self, block: bytes, base: int) -> None:
        """Decode whole lines: rows of the current table many at a time, others one by one."""
        lines = LineBlock(block, base)
        self._next_is_whole |= lines.first_is_empty
        ranges: list[LineRange] = []
        others: list[int] = []
        table = self._current_table()
        line = compared = next_other = 0
        span = FIRST_SPAN_LINES
        while line < len(lines):
            if line == compared:
                compared, span = min(len(lines), line + span), 4 * span
                others = lines.find_other_lines(line, compared, table[1], MAX_LINE_BYTES)
                next_other = 0
            while next_other < len(others) and others[next_other] < line:
                next_other += 1
            fitting_until = others[next_other] if next_other < len(others) else compared
            has_pending_line = self._header is not None or self._row is not None
            if line < fitting_until and self._next_is_whole and not has_pending_line:
                ranges.append((line, fitting_until))
                self._has_understood, self._is_half = True, False
                line = fitting_until
                continue
            self._decode_line(lines.line(line), lines.end(line))
            line += 1
            if table != self._current_table():
                self._add_rows(lines, ranges, *table)
                table = self._current_table()
                ranges, compared, span = [], line, FIRST_SPAN_LINES
        self._add_rows(lines, ranges, *table)

    def _current_table(self) -> tuple[LineTable | None, LineShape | None]:
        return self._table, None if self._table is None else self._table.shape

    def _add_rows(
        self,
        lines: LineBlock,
        ranges: Sequence[LineRange],
        table: LineTable | None,
        shape: LineShape | None,
    ) -> None:
        """Add many rows to a table."""
        if ranges and table is not None and shape is not None:
            rows, damaged = lines.parse(ranges, shape)
            self._touch(table).add_block(rows)
            for number in damaged:
                self._count_bad(len(lines.line(number)) + 1)

    # ---- one line

    def _begin_line(self) -> None:
        self._is_half, self._next_is_whole = not self._next_is_whole, True

    def _decode_line(self, raw: bytes, end: int) -> None:
        self._begin_line()
        size = len(raw) + 1
        if size - 1 > MAX_LINE_BYTES:
            self._count_bad(size)
            return
        if not self._is_half and self._header is None and self._decode_known_pairs(raw, end, size):
            return
        text = _ANSI_COLOUR.sub("", raw.decode("utf-8", "replace")).strip("\ufeff \t")
        if not text:
            return
        if is_garbage(text):
            self._count_bad(size)
        elif text[0] == ">":
            self._settle_header()
            self._decode_telemetry(TextLine(text, end, size), raw)
        else:
            self._decode_cells(TextLine(text, end, size), raw)

    def _decode_cells(self, line: TextLine, raw: bytes) -> None:
        """Decode a line of numbers, of names with values, of names, or of words."""
        text = line.text
        pairs = parse_pairs(text) if ":" in text else None
        row = None if pairs else split_cells(text, detect_separator(text))
        values = None if row is None else parse_number_row(row)
        if (values or pairs) and self._is_half:
            return
        if values:
            self._decode_numbers(line, values)
            return
        names = None if self._has_fixed_names or pairs else parse_header(text, self._known_names)
        expected = self._known_names if self._header is None else self._header.names
        if not (pairs or names) and is_damaged_row(row or [], len(expected)):
            self._count_bad(line.size)
            self._remark("lines with cells that are not numbers are skipped")
            return
        self._settle_header()
        if pairs:
            table = self._table_of_pairs(pairs[0])
            self._has_understood = True
            self._touch(table).add_line(line.end, line.size, pairs[1])
            self._pair_lines.learn(raw, pairs[1], table)
        elif names:
            self._has_understood = True
            self._header = PendingHeader(names, line, False)
        elif row and self._has_fixed_names and tuple(row) == self._known_names:
            self._has_understood = True
            self.counts.frames += 1
        else:
            self._add_to_log(line)

    def _decode_known_pairs(self, raw: bytes, end: int, size: int) -> bool:
        """Decode a line that differs from an earlier one in its numbers only."""
        known = self._pair_lines.read(raw)
        if known is None:
            return False
        target, values = known
        if isinstance(target, LineTable):
            self._touch(target).add_line(end, size, values)
            return True
        *time_ms, value = values
        if time_ms and not 0 <= time_ms[0] < MAX_TIME_MS:
            return False
        self.counts.frames += 1
        self._add_point(target, end, time_ms[0] if time_ms else None, [value])
        return True

    def _add_point(
        self, stream: Stream, end: int, time_ms: float | None, values: list[float]
    ) -> None:
        tick = round(1e3 * (time_ms or 0.0))
        self._points.setdefault(stream, []).append((end, tick, values))

    @property
    def _known_names(self) -> tuple[str, ...]:
        """Names of the current columns; empty if they are numbered."""
        return self._table.layout.names if self._table is not None and self._table.is_named else ()

    def _decode_numbers(self, line: TextLine, values: list[float]) -> None:
        """Add a row to the current table, or begin another one."""
        separator = detect_separator(line.text)
        has_trailing = separator != BLANK and line.text.endswith(separator)
        table = self._table
        if self._header is not None:
            names = self._header.names
            if len(values) - has_trailing <= len(names) <= len(values):
                self._header = None
                self.counts.frames += 1
                if table is None or names != table.layout.names:
                    table = self._table = self._new_table(names, is_named=True)
            elif self._header.has_mismatch:
                self._settle_header()
            else:
                self._header = self._header._replace(has_mismatch=True)
        if table is not None and table.accepts(len(values), separator, has_trailing):
            self._has_understood = True
            self._touch(table).add_line(line.end, line.size, values[: table.shape.columns])
            self._reject_row()
        elif table is not None and table.is_named:
            self._count_bad(line.size)
            columns = table.shape.columns
            self._remark(f"lines of another length are skipped: {columns} columns have names")
        elif self._row is not None and count_columns(self._row.text, line.text):
            self._begin_table([self._row, line])
        else:
            self._reject_row()
            self._row = line

    def _begin_table(self, lines: Sequence[TextLine]) -> None:
        """Begin a table of columns without names from its first lines."""
        count = count_columns(lines[0].text, lines[-1].text) or 0
        self._table = self._new_table([f"c{i}" for i in range(count)], is_named=False)
        self._row = None
        for line in lines:
            cells = split_cells(line.text, detect_separator(line.text))
            self._decode_numbers(line, parse_number_row(cells) or [])

    def _table_of_pairs(self, names: tuple[str, ...]) -> LineTable:
        table = self._pair_tables.get(names)
        if table is None:
            if len(self._pair_tables) >= MAX_TABLES:
                self._pair_tables.clear()
                self._pair_lines.clear()
            table = self._pair_tables[names] = self._new_table(names, is_named=True)
        return table

    def _decode_telemetry(self, line: TextLine, raw: bytes) -> None:
        """Decode a line of Teleplot."""
        telemetry = parse_telemetry(line.text[1:])
        if telemetry is None:
            self._count_bad(line.size)
            return
        self._has_understood = True
        if telemetry.text:
            self._add_to_log(TextLine(telemetry.text, line.end, line.size))
            return
        self.counts.frames += 1
        self.counts.unknown += telemetry.is_drawing
        for time_ms, values in telemetry.points:
            ticks = None if time_ms is None else Ticks(TICK_HZ)
            stream = Stream("readings", names=telemetry.names, ticks=ticks)
            self._add_point(stream, line.end, time_ms, values)
            if len(telemetry.points) == len(telemetry.names) == 1:
                time = [] if time_ms is None else [time_ms]
                self._pair_lines.learn(raw, [*time, *values], stream)

    # ---- results of lines

    def _settle_header(self) -> None:
        """Log names that no numbers follow: they are words."""
        if self._header is not None:
            line, self._header = self._header.line, None
            self._add_to_log(line)

    def _reject_row(self) -> None:
        """Count a row of numbers as damaged if no row of the same length follows."""
        if self._row is not None:
            self._count_bad(self._row.size)
            self._row = None

    def _add_to_log(self, line: TextLine) -> None:
        self._has_understood = True
        self.counts.frames += 1
        self._log.append((line.end, line.text))

    def _count_bad(self, size: int) -> None:
        if self._has_understood and not self._is_half:
            self.counts.bad += 1
            self.counts.skipped += size

    def _new_table(self, names: Sequence[str], *, is_named: bool) -> LineTable:
        layout = interpret_columns(names)
        for remark in layout.remarks:
            self._remark(remark)
        shape = LineShape("," if len(names) > 1 else BLANK, len(names))
        return LineTable(layout, shape, is_named=is_named)

    def _remark(self, text: str) -> None:
        if text not in self._made_remarks and len(self._made_remarks) < MAX_TABLES:
            self._made_remarks.add(text)
            self.remarks.append(text)

    def _touch(self, table: LineTable) -> LineTable:
        self._touched[id(table)] = table
        return table

    def _take_batches(self) -> list[Batch]:
        """Return the records since the last call, a batch a stream, in the order of their lines."""
        batches = [b for table in self._touched.values() for b in table.take_records(self.counts)]
        self._touched.clear()
        batches += [_point_batch(stream, points) for stream, points in self._points.items()]
        batches += [_log_batch(self._log)] if self._log else []
        self._points, self._log = {}, []
        return _merge_streams(batches)


# ---- batches


def _point_batch(stream: Stream, points: Sequence[Point]) -> Batch:
    end, tick, values = (np.array(part) for part in zip(*points, strict=True))
    return Batch(stream, end, {"value": values}, None if stream.ticks is None else tick)


def _log_batch(lines: Sequence[tuple[int, str]]) -> Batch:
    text = np.empty(len(lines), object)
    text[:] = [line for _, line in lines]
    columns: dict[str, NDArray[Any]] = {"level": np.full(len(lines), INFO_LEVEL), "text": text}
    return Batch(Stream("log"), np.array([end for end, _ in lines], np.int64), columns)


def _merge_streams(batches: Sequence[Batch]) -> list[Batch]:
    """Merge the batches of each stream, in the order of their lines.

    A stream has several batches if only some have a temperature or a count.
    """
    streams: dict[Stream, list[Batch]] = {}
    for batch in batches:
        streams.setdefault(batch.stream, []).append(batch)
    return [batch for parts in streams.values() for batch in _merge(parts)]


def _merge(parts: list[Batch]) -> list[Batch]:
    if len(parts) == 1:
        return parts
    fields = [_fields(batch) for batch in parts]
    forms = [tuple(part) for part in fields]
    form = np.repeat([forms.index(each) for each in forms], [len(batch) for batch in parts])
    merged = {
        name: np.concatenate([f.get(name, np.zeros(len(f["end"]), np.int64)) for f in fields])
        for name in {name for names in forms for name in names}
    }
    order = np.argsort(merged["end"], kind="stable")
    batches = []
    for run in np.split(order, np.flatnonzero(np.diff(form[order])) + 1):
        columns = {name: merged[name][run] for name in forms[form[run[0]]]}
        optional = {name: columns.pop(name, None) for name in ("tick", "sequence")}
        batches.append(Batch(parts[0].stream, columns.pop("end"), columns, **optional))
    return batches


def _fields(batch: Batch) -> dict[str, NDArray[Any]]:
    fields = {"end": batch.end, "tick": batch.tick, "sequence": batch.sequence, **batch.columns}
    return {name: array for name, array in fields.items() if array is not None}
