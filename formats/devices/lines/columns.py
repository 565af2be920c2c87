"""Quantities in the columns of a line of text, by their names.

A name is a quantity with its unit (:mod:`locatk.formats.tables.quantities`): ``x_mm``, ``x [mm]``,
``x(mm)``, in capitals or not.

=================================  =======================================================
``t``, ``time``, ``timestamp``     with s, ms, us or ns: the device's clock (a tick, in
                                   microseconds). Also ``millis`` and ``micros``
``seq``, ``sequence``              its counter of samples, which shows losses
``b<k>x``, ``b<k>y``, ``b<k>z``    with t, mt, ut, nt or gauss: magnetometer k, from 0 or 1
                                   on; all three axes of each. ``bx``, ``by``, ``bz`` if
                                   there is only one
``temperature``, ``temp``          with c: of the magnetometers
``hall_<name>``                    with t, mt, ut, nt or gauss: a hall sensor, positive
                                   upward. Front, left, rear and right are sorted, other
                                   names keep their order
``x``, ``y``, ``heading``          with m, cm, mm and rad, deg: odometry; all three
=================================  =======================================================

Every other column is a reading, with the number unchanged. So is a column without a unit, because
a unit is never guessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import NAMES
from locatk.formats.devices.interface import Batch, Stream, Ticks
from locatk.formats.tables.quantities import TIME_NAMES, UNITS, ColumnKind, match_column

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TICK_HZ = 1e6
"""Rate of the ticks of all records: the device's clock is converted to microseconds."""

NANOSECONDS_PER_TICK = 1e3

MAX_TICK = 2.0**62
"""Larger clocks are damaged."""

COLUMN_KINDS = (
    ColumnKind("sequence", re.compile("seq|sequence")),
    ColumnKind("clock", re.compile("millis"), factor=UNITS["time"]["ms"]),
    ColumnKind("clock", re.compile("micros"), factor=UNITS["time"]["us"]),
    ColumnKind("clock", re.compile("|".join(TIME_NAMES)), ("time",)),
    ColumnKind("magnetometers", re.compile(r"b(\d{0,3})_?([xyz])", re.ASCII), ("field",)),
    ColumnKind("halls", re.compile("hall_(.*)"), ("field",)),
    ColumnKind("odometry", re.compile("(x|y)"), ("length",)),
    ColumnKind("odometry", re.compile("(heading)"), ("angle",)),
    ColumnKind("temperature", re.compile("temperature|temp"), ("temperature",)),
)
"""Columns with a meaning, in the order in which they are tried."""

KINDS_THAT_NEED_UNITS = ("magnetometers", "halls")
"""Kinds whose names are so special that a missing unit is remarked."""

POSE_KEYS = ("x", "y", "heading")


class SiColumn(NamedTuple):
    """Number of a column in the line, from 0, and its factor to SI (clock: to nanoseconds)."""

    number: int
    factor: float


Columns = Mapping[tuple[str, ...], SiColumn]
"""Columns of one kind by key, in the order of the line."""


def without_overflow(values: Array) -> Array:
    """Replace values beyond float32, in which fields are recorded, by nan."""
    return np.where(np.abs(values) <= np.finfo(np.float32).max, values, np.nan)


@dataclass(frozen=True)
class Part:
    """Records of one stream: the columns of a line that they are taken from."""

    stream: Stream
    columns: tuple[SiColumn, ...]

    def values(self, lines: Array) -> Array:
        """Return the values (n, width) of lines (n, columns), in SI; ``nan`` if unknown."""
        index = [column.number for column in self.columns]
        values = lines[:, index] * np.array([column.factor for column in self.columns])
        if self.stream.kind != "readings":
            return without_overflow(values)
        return values

    def fields(self, values: Array) -> dict[str, NDArray[Any]]:
        """Return values (n, width) as columns of a :class:`Batch`."""
        if self.stream.kind == "odometry":
            return {"x_m": values[:, 0], "y_m": values[:, 1], "heading_rad": values[:, 2]}
        return {"value" if self.stream.kind == "readings" else "b_tesla": values}


@dataclass(frozen=True)
class ColumnLayout:
    """Interpretation of the columns of a line.

    Attributes
    ----------
    names : tuple of str
    parts : tuple of Part
    clock, sequence, temperature : SiColumn or None
        Columns of the device's clock, of its counter, and of the temperature of the
        magnetometers.
    remarks : tuple of str
        Columns whose names suggest more than the readings that they are kept as.
    """

    names: tuple[str, ...]
    parts: tuple[Part, ...]
    clock: SiColumn | None
    sequence: SiColumn | None
    temperature: SiColumn | None
    remarks: tuple[str, ...]

    @property
    def has_meaning(self) -> bool:
        """True if any column is more than a reading."""
        only_readings = all(part.stream.kind == "readings" for part in self.parts)
        return not only_readings or self.clock is not None or self.sequence is not None

    def ticks(self, lines: Array) -> Array | None:
        """Return the clock (n,) of lines (n, columns) in microseconds; None without a clock."""
        if self.clock is None:
            return None
        with np.errstate(over="ignore"):  # Infinite clocks are damaged, as all that are too large.
            return lines[:, self.clock.number] * (self.clock.factor / NANOSECONDS_PER_TICK)

    def sequences(self, lines: Array) -> Array | None:
        """Return the counter (n,) of lines (n, columns); None without a counter."""
        return None if self.sequence is None else lines[:, self.sequence.number]

    def is_damaged(self, lines: Array) -> NDArray[np.bool_]:
        """Return the lines (n,) with an impossible clock or counter."""
        damaged = np.zeros(len(lines), bool)
        tick, sequence = self.ticks(lines), self.sequences(lines)
        if tick is not None:
            damaged |= ~((tick >= 0) & (tick < MAX_TICK))
        if sequence is not None:
            is_counter = (sequence >= 0) & (sequence < 1 << 32) & (np.rint(sequence) == sequence)
            damaged |= ~is_counter
        return damaged

    def batches(self, lines: Array, end: Ints, is_wide: bool) -> tuple[list[Batch], bool]:
        """Return the records of lines.

        Parameters
        ----------
        lines : (n, columns) ndarray
        end : (n,) int64 ndarray
            Bytes up to the end of each line.
        is_wide : bool
            True once the clock has exceeded 32 bits. A clock in microseconds does so after 71
            minutes, and many devices restart at 0 then.

        Returns
        -------
        (list of Batch, bool)
            The second is ``is_wide`` after these lines.
        """
        n = len(end)
        tick, sequence = (
            None if values is None else np.rint(values).astype(np.int64)
            for values in (self.ticks(lines), self.sequences(lines))
        )
        narrow = n
        if tick is not None and self.clock is not None:
            is_beyond = tick >= 1 << 32
            if is_wide or self.clock.factor != NANOSECONDS_PER_TICK:
                narrow = 0
            elif is_beyond.any():
                narrow = int(np.argmax(is_beyond))
            is_wide |= narrow < n
        batches = []
        for rows, bits in ((np.arange(narrow), 32), (np.arange(narrow, n), 64)):
            clock = None if tick is None else Ticks(TICK_HZ, bits)
            for part in self.parts if len(rows) else ():
                batches += self._batch(part, clock, lines, end, tick, sequence, rows)
        return batches, is_wide

    def _batch(
        self,
        part: Part,
        clock: Ticks | None,
        lines: Array,
        end: Ints,
        tick: Ints | None,
        sequence: Ints | None,
        rows: Ints,
    ) -> list[Batch]:
        """Return the records of one part in some rows: of odometry complete ones only."""
        values = part.values(lines[rows])
        is_empty = np.isnan(values)
        is_odometry = part.stream.kind == "odometry"
        has_record = ~(is_empty.any(axis=1) if is_odometry else is_empty.all(axis=1))
        rows = rows[has_record]
        if not len(rows):
            return []
        fields = part.fields(values[has_record])
        if part.stream.kind == "magnetometers" and self.temperature is not None:
            temperature = lines[rows, self.temperature.number]
            fields["temperature_celsius"] = without_overflow(temperature)
        stream = Stream(part.stream.kind, "", part.stream.sensors, part.stream.names, clock)
        return [
            Batch(
                stream,
                end[rows],
                fields,
                None if tick is None else tick[rows],
                None if sequence is None else sequence[rows],
            )
        ]


def interpret_columns(names: Sequence[str]) -> ColumnLayout:
    """Interpret the names of columns; see the module. If a quantity repeats, its first is used."""
    by_kind: dict[str, dict[tuple[str, ...], SiColumn]] = {kind.field: {} for kind in COLUMN_KINDS}
    remarks: list[str] = []
    for index, name in enumerate(names):
        match = match_column(name, COLUMN_KINDS)
        if match is None:
            continue
        kind = match.kind.field
        if not math.isnan(match.factor):
            by_kind[kind].setdefault(match.key, SiColumn(index, match.factor))
        elif kind in KINDS_THAT_NEED_UNITS and not remarks:
            remarks.append(f"the unit of column {name!r} is missing: name it {name}_ut")
    parts = []
    for kind, interpret in (
        ("magnetometers", _magnetometers),
        ("halls", _halls),
        ("odometry", _odometry),
    ):
        part, remark = interpret(by_kind[kind])
        parts += [part] if part else []
        remarks += [remark] if remark else []
    has_magnetometers = any(part.stream.kind == "magnetometers" for part in parts)
    clock, sequence = (by_kind[kind].get(()) for kind in ("clock", "sequence"))
    temperature = by_kind["temperature"].get(()) if has_magnetometers else None
    used = {column.number for part in parts for column in part.columns}
    used |= {column.number for column in (clock, sequence, temperature) if column is not None}
    readings = [index for index in range(len(names)) if index not in used]
    if readings:
        stream = Stream("readings", names=tuple(names[index] for index in readings))
        parts.append(Part(stream, tuple(SiColumn(index, 1.0) for index in readings)))
    return ColumnLayout(tuple(names), tuple(parts), clock, sequence, temperature, tuple(remarks))


def _magnetometers(columns: Columns) -> tuple[Part | None, str]:
    """Return the magnetometers if all axes of each are there, and otherwise a remark."""
    by_axis: dict[tuple[int, str], SiColumn] = {}
    for (number, axis), column in columns.items():
        by_axis.setdefault((int(number or 0), axis), column)
    if not by_axis:
        return None, ""
    numbers = sorted({number for number, _ in by_axis})
    is_contiguous = numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    if numbers[0] > 1 or not is_contiguous or len(by_axis) != 3 * len(numbers):
        return None, (
            "columns of magnetometers are not x, y and z of each, numbered from 0 or 1 on"
        )
    ordered = tuple(by_axis[number, axis] for number in numbers for axis in "xyz")
    return Part(Stream("magnetometers", sensors=len(numbers)), ordered), ""


def _halls(columns: Columns) -> tuple[Part | None, str]:
    """Return the hall sensors, those of a robot in the order of :data:`NAMES`."""
    if not columns:
        return None, ""
    names = [name for (name,) in columns]
    if set(names) <= set(NAMES):
        names.sort(key=NAMES.index)
    stream = Stream("halls", sensors=len(names), names=tuple(names))
    return Part(stream, tuple(columns[name,] for name in names)), ""


def _odometry(columns: Columns) -> tuple[Part | None, str]:
    """Return odometry if x, y and heading are there, and otherwise a remark."""
    if not columns:
        return None, ""
    if len(columns) < len(POSE_KEYS):
        return None, "columns of odometry are not x, y and heading, each with its unit"
    return Part(Stream("odometry"), tuple(columns[key,] for key in POSE_KEYS)), ""
