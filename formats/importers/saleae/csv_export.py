"""CSV exports of Saleae's Logic 1 and 2: a row wherever any of the lines changes.

::

    Time[s], Channel 0, Channel 1            Logic 1
    0.002552830000000, 1, 1
    Time [s],Channel 0,Channel 1             Logic 2
    0.002552830,1,1
    2024-03-11T17:25:20.664552830Z,1,1       Logic 2, with ISO 8601 timestamps

Seconds are since the trigger or the start of the capture, and may be negative. ``X`` is no
data (support.saleae.com, "Binary and CSV export formats"): where the level is another one
after that, the edge is taken to be where the data begin again. Before the first row nothing
is known; the last row is the end.

A regular file of seconds is read in C; any other row by row, which finds the line of an
error. Both give the same numbers.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.formats.importers.saleae.data_lines import Line, Piece, Ticks, clean_name, readable

Levels = NDArray[np.int8]

OF_NUMBERS = b"0123456789+-.eE,\n"
"""What a regular block consists of."""

SECONDS = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)

STAMP = re.compile(
    r"((?:19[7-9]\d|2[01]\d\d)-\d\d-\d\d)[T ](\d\d:\d\d:\d\d(?:\.\d{1,9})?)\d*"
    r"(?:Z|([+-])(\d\d):?(\d\d))?",
    re.ASCII,
)
"""ISO 8601, in UTC where no zone is told; the years that int64 nanoseconds hold well."""

CHANNEL = re.compile(r"Channel (\d{1,4})", re.ASCII | re.IGNORECASE)

LEVELS = {"0": 0, "1": 1, "X": -1, "x": -1}

BLOCK = 4 << 20
LONGEST_LINE = 1 << 16
MOST_COLUMNS = 1024

MOST_SECONDS = 1e6
"""There, times in float64 are exact to a nanosecond by far."""

REPAIR = "correct or delete the row, or export the capture again"


@dataclass
class _Column:
    """Edges of one line so far."""

    level: int = -1  # in the last row; unknown
    rises: bool = True  # the first edge
    ticks: list[Ticks] = field(default_factory=list)

    def add(self, tick: Ticks, level: Levels) -> None:
        if level.min() < 0:
            known = level >= 0
            tick, level = tick[known], level[known]
        if not len(level):
            return
        before = np.concatenate([[level[0] if self.level < 0 else self.level], level[:-1]])
        change = np.flatnonzero(level != before)
        if len(change):
            if not self.ticks:
                self.rises = bool(level[change[0]])
            self.ticks.append(tick[change])
        self.level = int(level[-1])


def read_lines(path: Path) -> list[Line]:
    """Data lines of a CSV export, in order of its columns.

    Raises
    ------
    MissingDataError
        There is no such file.
    FormatError
        It is no such export, or cut short.
    InputError
        A cell that is no time or no level, times that do not ascend.
    """
    path = Path(path)
    with readable(path), path.open("rb") as stream:
        return _lines(path, stream)


def _lines(path: Path, stream: IO[bytes]) -> list[Line]:
    names = _header(path, stream.readline(LONGEST_LINE))
    columns = [_Column() for _ in names]
    rows = _Rows(path, len(names) + 1)
    first, last = None, 0
    for block in _blocks(path, stream):
        tick, level = rows.parse(block)
        if not len(tick):
            continue
        back = np.diff(tick, prepend=tick[0] - 1 if first is None else last) <= 0
        if back.any():
            rows.fail_block(block, int(np.argmax(back)), "a time that is not after the one before")
        if first is None:
            first = int(tick[0])
        last = int(tick[-1])
        for k, column in enumerate(columns):
            column.add(tick, level[:, k])
        rows.done(block)
    if first is None:
        raise FormatError(
            "a header and no rows", file=path, where=1, hint="the capture has no data"
        )
    # A time of day is counted from the first row.
    start = first if rows.stamped else 0
    found = []
    for name, column in zip(names, columns, strict=True):
        tick = np.concatenate(column.ticks) if column.ticks else np.zeros(0, np.int64)
        piece = Piece(tick - start, column.rises, last - start + 1)
        match = CHANNEL.fullmatch(name)
        number = int(match[1]) if match else None
        pieces: Callable[[], Iterator[Piece]] = partial(_once, piece)
        found.append(Line(name, number, float(NANOSECONDS_PER_S), None, start, pieces))
    return found


def _once(piece: Piece) -> Iterator[Piece]:
    yield piece


def _header(path: Path, line: bytes) -> list[str]:
    """Names of the data columns."""
    if not line:
        raise FormatError("empty file", file=path, hint="the capture has no data")
    try:
        cells = next(csv.reader([line.decode("utf-8-sig")], strict=True), [])
    except (UnicodeDecodeError, csv.Error):
        cells = []
    if not cells or not re.fullmatch(r"time ?(\[s\])?", cells[0].strip(), re.IGNORECASE):
        raise FormatError(
            "neither a capture of Logic 2 (.sal) nor an export of its raw data",
            file=path,
            where=1,
            hint="a CSV export begins with 'Time [s],Channel 0'",
        )
    if not 2 <= len(cells) <= MOST_COLUMNS:
        raise FormatError(
            f"a table of {len(cells)} columns",
            file=path,
            where=1,
            hint="export the digital channels beside the time",
        )
    return [clean_name(name) or f"column {k}" for k, name in enumerate(cells[1:], start=2)]


def _blocks(path: Path, stream: IO[bytes]) -> Iterator[bytes]:
    """Whole lines, some megabytes at a time."""
    while block := stream.read(BLOCK):
        rest = stream.readline(LONGEST_LINE)
        if len(rest) == LONGEST_LINE and not rest.endswith(b"\n"):
            raise FormatError(
                f"a line of more than {LONGEST_LINE} bytes", file=path, hint="this is no export"
            )
        yield (block + rest).replace(b"\r\n", b"\n")


@dataclass
class _Rows:
    """Rows of blocks as numbers.

    Attributes
    ----------
    line : int
        Of the file, at which the block begins.
    stamped : bool or None
        Whether times are times of day; None before the first row.
    """

    path: Path
    columns: int
    line: int = 2
    stamped: bool | None = None

    def done(self, block: bytes) -> None:
        """Count the lines of a block that is read."""
        self.line += block.count(b"\n")

    def fail(self, line: int, message: str, hint: str = REPAIR) -> NoReturn:
        raise InputError(message, file=self.path, where=line, hint=hint)

    def fail_block(self, block: bytes, row: int, message: str) -> NoReturn:
        """Fail about one row of a block, blank lines not counted."""
        texts = block.split(b"\n")
        lines = [self.line + k for k, text in enumerate(texts) if text.strip()]
        self.fail(lines[row], message)

    def parse(self, block: bytes) -> tuple[Ticks, Levels]:
        """Times (n,) in nanoseconds and levels (n, c) of a block; -1 is no data."""
        if not self.stamped:
            found = self._regular(block)
            if found is not None:
                self.stamped = False
                return found
        return self._any(block)

    def _regular(self, block: bytes) -> tuple[Ticks, Levels] | None:
        """Of a block without surprises; None where there is one."""
        block = block.replace(b", ", b",")
        block = block if block.endswith(b"\n") else block + b"\n"
        if block.translate(None, OF_NUMBERS):
            return None
        characters = np.frombuffer(block, np.uint8)
        ends = np.flatnonzero((characters == ord(",")) | (characters == ord("\n")))
        if ends.size % self.columns:
            return None
        sizes = np.diff(ends, prepend=-1).reshape(-1, self.columns) - 1
        if np.any(sizes[:, 0] < 1) or np.any(sizes[:, 1:] != 1):
            return None
        breaks = (characters[ends] == ord("\n")).reshape(-1, self.columns)
        if breaks[:, :-1].any() or not breaks[:, -1].all():
            return None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # it warns where it stops at what is no number
                values = np.fromstring(block.replace(b",", b" ").decode("ascii"), sep=" ")
        except (ValueError, DeprecationWarning):
            return None
        if values.size != ends.size:  # 1-2 or 1.2.3 count as several numbers there
            return None
        values = values.reshape(-1, self.columns)
        level = values[:, 1:]
        if not np.all((level == 0) | (level == 1)):
            return None
        if not np.all(np.abs(values[:, 0]) <= MOST_SECONDS):
            return None
        return np.rint(values[:, 0] * NANOSECONDS_PER_S).astype(np.int64), level.astype(np.int8)

    def _any(self, block: bytes) -> tuple[Ticks, Levels]:
        try:
            texts = block.decode("utf-8").split("\n")
        except UnicodeDecodeError as error:
            line = self.line + block.count(b"\n", 0, error.start)
            self.fail(line, "bytes that are not text", "the file is damaged: export it again")
        rows, lines = [], []
        for line, text in enumerate(texts, start=self.line):
            if not text.strip():
                continue
            cells = [cell.strip() for cell in text.split(",")]
            if len(cells) != self.columns:
                self.fail(
                    line,
                    f"{len(cells)} cell{'s' * (len(cells) > 1)} in a row of {self.columns}",
                    "the file may be cut short: delete or complete the row",
                )
            rows.append(cells)
            lines.append(line)
        levels = np.zeros((len(rows), self.columns - 1), np.int8)
        if not rows:
            return np.zeros(0, np.int64), levels
        times, *columns = zip(*rows, strict=True)
        for k, column in enumerate(columns):
            try:
                levels[:, k] = [LEVELS[cell] for cell in column]
            except KeyError as error:
                self.fail(
                    lines[column.index(error.args[0])],
                    f"{clean_name(error.args[0])!r} where a level, 0 or 1, should be",
                    "export digital channels, not analog ones",
                )
        if self.stamped is None:
            self.stamped = STAMP.fullmatch(times[0]) is not None
        return (self._stamps if self.stamped else self._seconds)(times, lines), levels

    def _seconds(self, times: tuple[str, ...], lines: list[int]) -> Ticks:
        tick = np.zeros(len(times), np.int64)
        for k, text in enumerate(times):
            value = float(text) if SECONDS.fullmatch(text) else np.inf
            if not abs(value) <= MOST_SECONDS:
                self.fail(lines[k], f"{clean_name(text)!r} is no number of seconds")
            tick[k] = round(value * NANOSECONDS_PER_S)
        return tick

    def _stamps(self, times: tuple[str, ...], lines: list[int]) -> Ticks:
        matches = list(map(STAMP.fullmatch, times))
        for k, match in enumerate(matches):
            if match is None:
                self.fail(lines[k], f"{clean_name(times[k])!r} is no time in ISO 8601")
        found = [match for match in matches if match]
        try:
            tick = np.array([f"{m[1]}T{m[2]}" for m in found], "datetime64[ns]").astype(np.int64)
        except ValueError:
            self.fail(lines[0], "a day or hour that does not exist, in this row or after it")
        minutes = {m.group(3, 4, 5): 0 for m in found}
        for zone in minutes:
            if zone[0]:
                minutes[zone] = int(f"{zone[0]}1") * (60 * int(zone[1]) + int(zone[2]))
        ahead = np.array([minutes[m.group(3, 4, 5)] for m in found], np.int64)
        return tick - ahead * 60 * NANOSECONDS_PER_S
