"""Lines of text: what sketches print.

``\\n``, ``\\r\\n`` or ``\\r`` ends a line. It is one of

* numbers, separated by commas, semicolons, tabs or blanks, all lines alike. Names come from
  a header, which may come again, or from the user; without either they are ``c0``, ``c1``,
  ... An empty cell or ``nan`` is no value;
* ``name:value``, several separated in the same ways (Arduino's serial plotter);
* ``>name:value`` and ``>name:milliseconds:value;...``, with ``§unit`` and ``|flags``
  (Teleplot, github.com/nesnes/teleplot: on serial lines what has no ``>`` is a log);
* else text, which is logged: boot messages. Text with characters that nobody prints, or
  that is numbers for the most part, is wrong.

What a name means: :mod:`.line_columns`. Those of Teleplot are readings, ``name[unit]``.

Nobody starts to listen at the start of a line: numbers in the first are left out. Numbers
without names define how many there are when two lines in a row agree.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from locatk.core.errors import InputError
from locatk.formats.devices.decoder import Batch, Counts, Options, Stream, Ticks
from locatk.formats.devices.lines import text as line_text
from locatk.formats.devices.lines.blocks import Lines, Range, Shape, Table
from locatk.formats.devices.lines.columns import TICK_HZ, log, meaning, merged, points
from locatk.formats.devices.lines.columns import encode as encode
from locatk.formats.devices.lines.text import (
    BLANK,
    LATEST_MS,
    Alike,
    cells,
    columns,
    numbers,
    separator,
)

LONGEST = 1 << 16
"""Bytes of a line; longer ones are wrong."""

PIECE = 1 << 16
"""Bytes that are looked at together."""

KNOWN = 256
"""So many sets of names of ``name:value`` are remembered."""

SOON = 256
"""Lines that are looked at first, where the columns have changed."""

_ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


class _Line(NamedTuple):
    """Something that waits for the line after it: text, its end and its length in bytes."""

    text: str
    end: int
    size: int


class LineDecoder:
    """Decoder of lines of text; a :class:`.decoder.Decoder`.

    Parameters
    ----------
    options : Options
        ``columns`` names the numbers of a line; headers are then passed over.

    Attributes
    ----------
    counts : Counts
        ``frames`` are lines that were understood, headers and text among them.
    remarks : list of str

    Raises
    ------
    InputError
        Two of the columns have the same name.
    """

    def __init__(self, options: Options | None = None) -> None:
        names = () if options is None else options.columns
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"two columns are called {twice!r}")
        self.counts = Counts()
        self.remarks: list[str] = []
        self._fixed = bool(names)
        self._said: set[str] = set()
        self._table: Table | None = None
        self._pairs: dict[tuple[str, ...], Table] = {}
        self._alike: Alike[Table | Stream] = Alike()
        self._header: tuple[tuple[str, ...], _Line, bool] | None = None
        self._row: _Line | None = None
        self._tail = bytearray()
        self._dropped = 0
        self._whole = self._half = self._heard = False
        self._touched: dict[int, Table] = {}
        self._log: list[tuple[int, str]] = []
        self._points: dict[Stream, list[tuple[int, int, list[float]]]] = {}
        if names:
            self._table = self._new_table(names, named=True)

    # ---- the contract

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """See :meth:`.decoder.Decoder.feed`; a pause says nothing here."""
        for start in range(0, len(data), PIECE):
            self._feed(data[start : start + PIECE])
        return self._batches()

    def restart(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.restart`; the columns stay known."""
        batches = self.finish()
        self._whole = False
        for table in (self._table, *self._pairs.values()):
            if table is not None:
                table.counter.restart()
        return batches

    def finish(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.finish`. A line without an end is half received."""
        self._tail.clear()
        self._dropped = 0
        self._settle()
        if self._row is not None and self._table is None:
            self._begin(self._row)
        self._drop_row()
        return self._batches()

    # ---- bytes to lines

    def _feed(self, data: bytes) -> None:
        base = self.counts.bytes - len(self._tail)
        self.counts.bytes += len(data)
        cut = max(data.rfind(b"\n"), data.rfind(b"\r")) + 1
        if cut:
            block = bytes(self._tail) + data[:cut]
            self._tail[:] = data[cut:]
            if self._dropped:
                base, block = self._overlong(base, block)
            if block:
                self._block(block, base)
        else:
            self._tail += data
        if len(self._tail) > LONGEST:
            self._dropped += len(self._tail)
            self._tail.clear()

    def _overlong(self, base: int, block: bytes) -> tuple[int, bytes]:
        """Pass over the end of a line that was too long."""
        end = len(block.replace(b"\r", b"\n").partition(b"\n")[0]) + 1
        self._half, self._whole = not self._whole, True
        self._bad(self._dropped + end)
        self._dropped = 0
        return base + end, block[end:]

    def _block(self, block: bytes, base: int) -> None:
        """Take whole lines: those that are rows of the table at once, others one by one."""
        lines = Lines(block, base)
        self._whole |= lines.first_is_empty
        ranges: list[Range] = []
        odd: list[int] = []
        now = self._now()
        at = known = place = 0
        span = SOON
        while at < len(lines):
            if at == known:
                known, span = min(len(lines), at + span), 4 * span
                odd, place = lines.odd(at, known, now[1], LONGEST), 0
            while place < len(odd) and odd[place] < at:
                place += 1
            fitting = odd[place] if place < len(odd) else known
            if at < fitting and self._whole and self._header is None and self._row is None:
                ranges.append((at, fitting))
                self._heard, self._half = True, False
                at = fitting
                continue
            self._line(lines.line(at), lines.end(at))
            at += 1
            if now != self._now():
                self._take(lines, ranges, *now)
                now = self._now()
                ranges, known, span = [], at, SOON
        self._take(lines, ranges, *now)

    def _now(self) -> tuple[Table | None, Shape | None]:
        return self._table, None if self._table is None else self._table.shape

    def _take(
        self, lines: Lines, ranges: Sequence[Range], table: Table | None, shape: Shape | None
    ) -> None:
        """Rows of a table, many at a time."""
        if ranges and table is not None and shape is not None:
            rows, wrong = lines.rows(ranges, shape)
            self._add(table).add(rows)
            for number in wrong:
                self._bad(len(lines.line(number)) + 1)

    # ---- one line

    def _line(self, raw: bytes, end: int) -> None:
        self._half, self._whole = not self._whole, True
        size = len(raw) + 1
        if size - 1 > LONGEST:
            self._bad(size)
            return
        if not self._half and self._header is None and self._again(raw, end, size):
            return
        text = _ANSI.sub("", raw.decode("utf-8", "replace")).strip("\ufeff \t")
        if not text:
            return
        if line_text.garbage(text):
            self._bad(size)
        elif text[0] == ">":
            self._settle()
            self._telemetry(_Line(text, end, size), raw)
        else:
            self._cells(_Line(text, end, size), raw)

    def _cells(self, line: _Line, raw: bytes) -> None:
        """Numbers, names and values, names, or words."""
        text = line.text
        named = line_text.pairs(text) if ":" in text else None
        row = None if named else cells(text, separator(text))
        values = None if row is None else numbers(row)
        if (values or named) and self._half:
            return
        if values:
            self._numbers(line, values)
            return
        names = None if self._fixed or named else line_text.header(text, self._names)
        expected = self._names if self._header is None else self._header[0]
        if not (named or names) and line_text.damaged(row or [], len(expected)):
            self._bad(line.size)
            self._say("lines with cells that are no numbers are left out")
            return
        self._settle()
        if named:
            table = self._of_pairs(named[0])
            self._heard = True
            self._add(table).add_one(line.end, line.size, named[1])
            self._alike.learn(raw, named[1], table)
        elif names:
            self._heard = True
            self._header = names, line, False
        elif row and self._fixed and tuple(row) == self._names:
            self._heard = True
            self.counts.frames += 1
        else:
            self._tell(line)

    def _again(self, raw: bytes, end: int, size: int) -> bool:
        """Take a line that is like one before, but for its numbers."""
        found = self._alike.read(raw)
        if found is None:
            return False
        target, values = found
        if isinstance(target, Table):
            self._add(target).add_one(end, size, values)
            return True
        *time_ms, value = values
        if time_ms and not 0 <= time_ms[0] < LATEST_MS:
            return False
        self.counts.frames += 1
        self._point(target, end, time_ms[0] if time_ms else None, [value])
        return True

    def _point(self, stream: Stream, end: int, time_ms: float | None, values: list[float]) -> None:
        point = end, round(1e3 * (time_ms or 0.0)), values
        self._points.setdefault(stream, []).append(point)

    @property
    def _names(self) -> tuple[str, ...]:
        """Of the columns, where somebody has named them."""
        named = self._table is not None and self._table.named
        return self._table.meaning.names if named and self._table is not None else ()

    def _numbers(self, line: _Line, values: list[float]) -> None:
        """A row of the table, or of another table."""
        separated = separator(line.text)
        trailing = separated != BLANK and line.text.endswith(separated)
        table = self._table
        if self._header is not None:
            names, said, tried = self._header
            if len(values) - trailing <= len(names) <= len(values):
                self._header = None
                self.counts.frames += 1
                if table is None or names != table.meaning.names:
                    table = self._table = self._new_table(names, named=True)
            elif tried:
                self._settle()
            else:  # this line may be damaged
                self._header = names, said, True
        if table is not None and table.takes(len(values), separated, trailing):
            self._heard = True
            self._add(table).add_one(line.end, line.size, values[: table.shape.columns])
            self._drop_row()
        elif table is not None and table.named:
            self._bad(line.size)
            named = f"{table.shape.columns} columns are named"
            self._say(f"lines of more or less numbers are left out, where {named}")
        elif self._row is not None and columns(self._row.text, line.text):
            self._begin(self._row, line)
        else:
            self._drop_row()
            self._row = line

    def _begin(self, one: _Line, other: _Line | None = None) -> None:
        """A table of columns without names."""
        count = columns(one.text, other.text if other else one.text) or 0
        self._table = self._new_table([f"c{i}" for i in range(count)], named=False)
        self._row = None
        for line in (one, other) if other else (one,):
            self._numbers(line, numbers(cells(line.text, separator(line.text))) or [])

    def _of_pairs(self, names: tuple[str, ...]) -> Table:
        table = self._pairs.get(names)
        if table is None:
            if len(self._pairs) >= KNOWN:
                self._pairs.clear()
                self._alike.forget()
            table = self._pairs[names] = self._new_table(names, named=True)
        return table

    def _telemetry(self, line: _Line, raw: bytes) -> None:
        """A line of Teleplot."""
        said = line_text.telemetry(line.text[1:])
        if said is None:
            self._bad(line.size)
            return
        self._heard = True
        if said.text:
            self._tell(_Line(said.text, line.end, line.size))
            return
        self.counts.frames += 1
        self.counts.unknown += said.drawing
        for time_ms, values in said.points:
            ticks = None if time_ms is None else Ticks(TICK_HZ)
            stream = Stream("readings", names=said.names, ticks=ticks)
            self._point(stream, line.end, time_ms, values)
            if len(said.points) == len(said.names) == 1:
                self._alike.learn(raw, [*([] if time_ms is None else [time_ms]), *values], stream)

    # ---- what becomes of lines

    def _settle(self) -> None:
        """Names that no numbers follow are words."""
        if self._header is not None:
            said, self._header = self._header[1], None
            self._tell(said)

    def _drop_row(self) -> None:
        """Numbers that no others follow which agree are wrong."""
        if self._row is not None:
            self._bad(self._row.size)
            self._row = None

    def _tell(self, line: _Line) -> None:
        self._heard = True
        self.counts.frames += 1
        self._log.append((line.end, line.text))

    def _bad(self, size: int) -> None:
        if self._heard and not self._half:
            self.counts.bad += 1
            self.counts.skipped += size

    def _new_table(self, names: Sequence[str], *, named: bool) -> Table:
        said = meaning(names)
        for doubt in said.doubts:
            self._say(doubt)
        return Table(said, Shape("," if len(names) > 1 else BLANK, len(names)), named=named)

    def _say(self, remark: str) -> None:
        if remark not in self._said and len(self._said) < KNOWN:
            self._said.add(remark)
            self.remarks.append(remark)

    def _add(self, table: Table) -> Table:
        self._touched[id(table)] = table
        return table

    def _batches(self) -> list[Batch]:
        """Records of the lines since the last time, a batch a stream, in their order."""
        batches = [batch for each in self._touched.values() for batch in each.records(self.counts)]
        self._touched.clear()
        batches += [points(*each) for each in self._points.items()]
        batches += [log(self._log)] if self._log else []
        self._points, self._log = {}, []
        return merged(batches)
