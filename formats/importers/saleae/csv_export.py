"""CSV exports of Saleae's Logic 1 and 2: a row for each change of any line.

::

    Time[s], Channel 0, Channel 1            Logic 1
    0.002552830000000, 1, 1
    Time [s],Channel 0,Channel 1             Logic 2
    0.002552830,1,1
    2024-03-11T17:25:20.664552830Z,1,1       Logic 2, with ISO 8601 timestamps

Seconds are since the trigger or the start of the capture, and may be negative. ``X`` is no
data (support.saleae.com, "Binary and CSV export formats"): if the level has changed after such a
gap, the edge is assumed at the end of the gap. Before the first row the levels are unknown; the
last row is the end.

Blocks of plain seconds are parsed at once (:func:`~locatk.formats.tables.delimited.parse_numbers`),
any other block row by row, which finds the line of an error. Both give the same numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.formats.files import open_binary
from locatk.formats.importers.saleae.digital_lines import (
    DigitalLine,
    EdgeSegment,
    Ticks,
    clean_name,
)
from locatk.formats.tables.delimited import parse_numbers
from locatk.formats.tables.timestamps import is_iso_time, parse_iso_times

Levels = NDArray[np.int8]

NO_DATA = -1
"""Level of a line without data."""

LEVEL_OF_CELL = {"0": 0, "1": 1, "X": NO_DATA, "x": NO_DATA}

BLOCK_BYTES = 4 << 20
MAX_LINE_BYTES = 1 << 16
MAX_COLUMNS = 1024

MAX_SECONDS = 1e6
"""Largest time of a capture, at which float64 still resolves 0.1 ns."""

REPAIR_HINT = "Correct or delete the row, or export the capture again"

_SECONDS = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)
_CHANNEL_NAME = re.compile(r"Channel (\d{1,4})", re.ASCII | re.IGNORECASE)
_TIME_HEADER = re.compile(r"time ?(\[s\])?", re.IGNORECASE)


@dataclass
class LineEdges:
    """Edges of one line that were read so far.

    Attributes
    ----------
    level : int
        In the last row; :data:`NO_DATA` before the first known one.
    rises : bool
        True if the first edge is from low to high.
    ticks : list of (n,) int64 ndarray
    """

    level: int = NO_DATA
    rises: bool = True
    ticks: list[Ticks] = field(default_factory=list)

    def add(self, tick: Ticks, level: Levels) -> None:
        """Add the rows of a block."""
        has_data = level != NO_DATA
        if not has_data.all():
            tick, level = tick[has_data], level[has_data]
        if not len(level):
            return
        previous = level[0] if self.level == NO_DATA else self.level
        change = np.flatnonzero(level != np.concatenate([[previous], level[:-1]]))
        if len(change):
            if not self.ticks:
                self.rises = bool(level[change[0]])
            self.ticks.append(tick[change])
        self.level = int(level[-1])


def read_csv_export(path: Path) -> list[DigitalLine]:
    """Read the lines of a CSV export, in order of its columns.

    Raises
    ------
    MissingDataError
        The file is missing or not readable.
    FormatError
        The file is not such an export, or is cut short.
    InputError
        A cell is not a time or level, or times do not ascend.
    """
    path = Path(path)
    with open_binary(path) as stream:
        return _read_lines(path, stream)


def _read_lines(path: Path, stream: IO[bytes]) -> list[DigitalLine]:
    names = _read_header(path, stream.readline(MAX_LINE_BYTES))
    lines = [LineEdges() for _ in names]
    parser = BlockParser(path, len(names) + 1)
    first, last = None, 0
    for block in _blocks(path, stream):
        tick, level = parser.parse(block)
        if not len(tick):
            continue
        is_late = np.diff(tick, prepend=tick[0] - 1 if first is None else last) <= 0
        if is_late.any():
            parser.fail_row(block, int(np.argmax(is_late)), "a time that does not ascend")
        if first is None:
            first = int(tick[0])
        last = int(tick[-1])
        for k, line in enumerate(lines):
            line.add(tick, level[:, k])
        parser.first_line += block.count(b"\n")
    if first is None:
        raise FormatError(
            "a header and no rows", file=path, where=1, hint="The capture has no data"
        )
    # Times of day are counted from the first row.
    start = first if parser.has_iso_times else 0
    found = []
    for name, line in zip(names, lines, strict=True):
        tick = np.concatenate(line.ticks) if line.ticks else np.zeros(0, np.int64)
        segments = [EdgeSegment(tick - start, line.rises, last - start + 1)]
        match = _CHANNEL_NAME.fullmatch(name)
        number = int(match[1]) if match else None
        ticks_hz = float(NANOSECONDS_PER_S)
        found.append(DigitalLine(name, number, ticks_hz, None, start, partial(iter, segments)))
    return found


def _read_header(path: Path, line: bytes) -> list[str]:
    """Return the names of the lines."""
    if not line:
        raise FormatError("empty file", file=path, hint="The capture has no data")
    try:
        cells = next(csv.reader([line.decode("utf-8-sig")], strict=True), [])
    except (UnicodeDecodeError, csv.Error):
        cells = []
    if not cells or not _TIME_HEADER.fullmatch(cells[0].strip()):
        raise FormatError(
            "neither a capture of Logic 2 (.sal) nor an export of its raw data",
            file=path,
            where=1,
            hint="A CSV export begins with 'Time [s],Channel 0'",
        )
    if not 2 <= len(cells) <= MAX_COLUMNS:
        raise FormatError(
            f"a table of {len(cells)} columns",
            file=path,
            where=1,
            hint="Export the digital channels with the time",
        )
    return [clean_name(name) or f"column {k}" for k, name in enumerate(cells[1:], start=2)]


def _blocks(path: Path, stream: IO[bytes]) -> Iterator[bytes]:
    """Yield whole lines, some megabytes at a time."""
    while block := stream.read(BLOCK_BYTES):
        rest = stream.readline(MAX_LINE_BYTES)
        if len(rest) == MAX_LINE_BYTES and not rest.endswith(b"\n"):
            raise FormatError(
                f"a line of more than {MAX_LINE_BYTES} bytes",
                file=path,
                hint="This is not an export",
            )
        yield (block + rest).replace(b"\r\n", b"\n")


@dataclass
class BlockParser:
    """Parser of the rows of consecutive blocks.

    Attributes
    ----------
    path : Path
    columns : int
        Of a row, including the time.
    first_line : int
        Line of the file at which the block begins.
    has_iso_times : bool or None
        True if times are times of day; None before the first row.
    """

    path: Path
    columns: int
    first_line: int = 2
    has_iso_times: bool | None = None

    def fail(self, line: int, problem: str, hint: str = REPAIR_HINT) -> NoReturn:
        """Raise :class:`InputError` about a line of the file."""
        raise InputError(problem, file=self.path, where=line, hint=hint)

    def fail_row(self, block: bytes, row: int, problem: str) -> NoReturn:
        """Raise :class:`InputError` about a row of a block, in which blank lines do not count."""
        texts = block.split(b"\n")
        lines = [self.first_line + k for k, text in enumerate(texts) if text.strip()]
        self.fail(lines[row], problem)

    def parse(self, block: bytes) -> tuple[Ticks, Levels]:
        """Return the times (n,) in nanoseconds and the levels (n, c) of a block.

        Raises
        ------
        InputError
            A row has another number of cells, or a cell is not a time or level.
        """
        if not self.has_iso_times:
            parsed = self._parse_plain(block)
            if parsed is not None:
                self.has_iso_times = False
                return parsed
        return self._parse_by_row(block)

    def _parse_plain(self, block: bytes) -> tuple[Ticks, Levels] | None:
        """Parse a block of plain numbers; None if anything in it is not plain."""
        parsed = parse_numbers(block.replace(b", ", b","), self.columns, ",")
        if parsed is None:
            return None
        seconds, level = parsed.values[:, 0], parsed.values[:, 1:]
        has_one_character = parsed.stop[:, 1:] - parsed.start[:, 1:] == 1
        if not np.all(has_one_character & ((level == 0) | (level == 1))):
            return None
        if not np.all(np.abs(seconds) <= MAX_SECONDS):
            return None
        return np.rint(seconds * NANOSECONDS_PER_S).astype(np.int64), level.astype(np.int8)

    def _parse_by_row(self, block: bytes) -> tuple[Ticks, Levels]:
        try:
            texts = block.decode("utf-8").split("\n")
        except UnicodeDecodeError as error:
            line = self.first_line + block.count(b"\n", 0, error.start)
            self.fail(line, "bytes that are not text", "The file is damaged: export it again")
        rows, lines = [], []
        for line, text in enumerate(texts, start=self.first_line):
            if not text.strip():
                continue
            cells = [cell.strip() for cell in text.split(",")]
            if len(cells) != self.columns:
                self.fail(
                    line,
                    f"{len(cells)} cell{'s' * (len(cells) > 1)} in a row of {self.columns}",
                    "The file may be cut short: delete or complete the row",
                )
            rows.append(cells)
            lines.append(line)
        levels = np.zeros((len(rows), self.columns - 1), np.int8)
        if not rows:
            return np.zeros(0, np.int64), levels
        times, *columns = zip(*rows, strict=True)
        for k, column in enumerate(columns):
            try:
                levels[:, k] = [LEVEL_OF_CELL[cell] for cell in column]
            except KeyError as error:
                self.fail(
                    lines[column.index(error.args[0])],
                    f"{clean_name(error.args[0])!r} instead of a level, 0 or 1",
                    "Export digital channels, not analog ones",
                )
        if self.has_iso_times is None:
            self.has_iso_times = is_iso_time(times[0])
        parse = self._parse_iso_times if self.has_iso_times else self._parse_seconds
        return parse(times, lines), levels

    def _parse_seconds(self, times: tuple[str, ...], lines: list[int]) -> Ticks:
        tick = np.zeros(len(times), np.int64)
        for k, text in enumerate(times):
            seconds = float(text) if _SECONDS.fullmatch(text) else np.inf
            if not abs(seconds) <= MAX_SECONDS:
                self.fail(lines[k], f"{clean_name(text)!r} is not a number of seconds")
            tick[k] = round(seconds * NANOSECONDS_PER_S)
        return tick

    def _parse_iso_times(self, times: tuple[str, ...], lines: list[int]) -> Ticks:
        try:
            return parse_iso_times(times, utc_only=False)
        except ValueError:
            for line, text in zip(lines, times, strict=True):
                if not is_iso_time(text):
                    self.fail(line, f"{clean_name(text)!r} is not a time in ISO 8601")
        self.fail(lines[0], "a day or hour that does not exist, in this row or a later one")
