"""Recordings of hall sensors and odometry in one table (CSV), as robots log them.

One row a sample: the time, where the robot's odometry has it (x, y, heading), and a reading
of each hall sensor. No such recording is published: columns and units are what the user or
the header says (:mod:`.columns`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.field_readings import leave_out, no_reading
from locatk.formats.tables.columns import UNITS, Column, by_quantity, find
from locatk.formats.tables.csv_table import Table, read_table

Array = NDArray[np.float64]

DEVICE = "robot"
FRAME = "odometry"

START_NS = 1_000_000_000
"""Time of the first row where no clock is known."""

EPOCH_NS = 946_684_800_000_000_000
"""Times from here on (the year 2000) are of a clock that counts from 1970."""

LATEST_NS = 2**62

POSE = ("x", "y", "heading")
"""What the columns of odometry are called."""

VOLTS = ("v", "mv")

FEWEST_UPDATES = 10
"""With fewer poses that differ nothing is said of how often odometry is new."""

_STRIDE_M = 0.02
_ALONG = 0.5
_FASTEST_MPS = 10.0


@dataclass(frozen=True)
class Volts:
    """How a voltage becomes a field: one value for all sensors, or one each, in their order.

    Attributes
    ----------
    per_tesla : tuple of float
        Negative where a field that points up lowers the voltage.
    zero : tuple of float or None
        Volts without a field; None for the median of each sensor, which is right where a
        robot is off the landmarks most of the time.
    """

    per_tesla: tuple[float, ...]
    zero: tuple[float, ...] | None


@dataclass
class ImportedHalls:
    """A recording of others.

    Attributes
    ----------
    samples : HallSamples
    odometry : Trajectory
    facts : dict of str to str
        What was read and assumed, for people.
    warnings : list of str
        What was lost or is doubtful, one line each.
    left_out : int
        Readings that are not there or could not be used.
    """

    samples: HallSamples
    odometry: Trajectory
    facts: dict[str, str]
    warnings: list[str] = field(default_factory=list)
    left_out: int = 0

    @property
    def lost(self) -> str | None:
        """What was lost, None where nothing was."""
        if not self.left_out:
            return None
        return f"{self.left_out} of {self.samples.field_t.size} readings are left out"


def read_landmarks(
    path: Path,
    *,
    sensors: HallSensors,
    columns: Mapping[str, str] | None = None,
    units: Sequence[str] = (),
    volts: Volts | None = None,
    downward: bool = False,
    start_ns: int | None = None,
) -> ImportedHalls:
    """Read one recording.

    Parameters
    ----------
    path : path
    sensors : HallSensors
        Where the hall sensors sit; their names are those of their columns.
    columns : mapping, optional
        Of ``t``, ``x``, ``y``, ``heading`` and the names of sensors to headers; those that
        are left out have a column of their own name, with or without a unit behind it.
    units : sequence of str
        At most one of each quantity in :data:`.columns.UNITS`, for columns whose names tell none.
    volts : Volts, optional
        Where readings are voltages.
    downward : bool
        Readings are positive where the field points down.
    start_ns : int, optional
        Time of the first row since the epoch. Where it is left out, times from the year
        2000 on are taken as they are, others begin at :data:`START_NS`.

    Raises
    ------
    MissingDataError, FormatError
        See :func:`locatk.formats.tables.csv_table.read_table`; also where a column is
        missing, or two could be meant.
    InputError
        A unit is not known, a cell is no number, times do not ascend, or nothing is left.
    """
    given = by_quantity(units)
    twice = [name for name in sensors.names if name in POSE or name == "t"]
    if twice:
        raise InputError(f"a sensor called {twice[0]!r}", hint="That is another column's name")
    table = read_table(path)
    quantities = {"t": "time", "x": "length", "y": "length", "heading": "angle"}
    quantities |= dict.fromkeys(sensors.names, "field")
    found = find(table, quantities, columns or {}, given)
    time_ns, clock = _times(found["t"], start_ns)
    odometry = _odometry(table, found, time_ns)
    readings = [found[name] for name in sensors.names]
    field_t = _fields(readings, volts)
    # Rows that have a pose alone are no samples.
    there = ~np.isnan(field_t).all(axis=1)
    if not there.any():
        raise InputError("no reading of any sensor", file=path, hint="Check the columns")
    field_t = -field_t[there] if downward else field_t[there]
    imported = ImportedHalls(
        HallSamples(DEVICE, sensors, time_ns[there], field_t),
        odometry,
        {
            "format": "landmark-csv",
            "file": Path(path).name,
            "rows": str(len(table)),
            "columns": ", ".join(
                f"{key}={column.name}" + (f" [{column.unit}]" if column.unit else "")
                for key, column in found.items()
            ),
            "clock": clock,
        },
    )
    if volts is not None:
        imported.facts["volts_per_tesla"] = ", ".join(f"{v:g}" for v in volts.per_tesla)
        zero = volts.zero
        imported.facts["zero_volts"] = ", ".join(f"{v:g}" for v in zero) if zero else "median"
    if downward:
        imported.facts["positive"] = "downward in the file, upward here"
    poses = np.count_nonzero(~np.isnan(found["x"].numbers()))
    if len(odometry) < poses:
        imported.facts["odometry"] = f"{poses - len(odometry)} repeated poses are passed over"
    lines = [table.lines[row] for row in np.flatnonzero(there)]
    by_axis = imported.samples.field_t[:, :, None]
    names = [column.name for column in readings]
    imported.left_out, imported.warnings = leave_out(
        by_axis, no_reading(by_axis), table.file, names, lines
    )
    imported.warnings += _doubts(odometry)
    if imported.left_out == field_t.size:
        raise InputError(
            "no reading that can be used", file=path, hint=imported.warnings[0].split(": ", 1)[1]
        )
    return imported


def _times(column: Column, start_ns: int | None) -> tuple[NDArray[np.int64], str]:
    """Times of the rows in ns since the epoch, and which clock they are of."""
    table, unit = column.table, column.unit
    if not unit:
        at, clock = table.times_ns(column.name), "dates and times of the file"
    else:
        ns = UNITS["time"][unit]
        table.floats(column.name, -LATEST_NS / ns, LATEST_NS / ns)
        # Nanoseconds since 1970 have more digits than a float.
        cells = map(Decimal, map(str.strip, table.columns[column.name]))
        at = np.array([int((cell * int(ns)).to_integral_value()) for cell in cells], np.int64)
        if at[0] >= EPOCH_NS:
            clock = f"{unit} since 1970"
        else:
            at, clock = at - at[0] + START_NS, "the first row is at 1 s: no clock is known"
    if start_ns is not None:
        at, clock = at - at[0] + start_ns, "the first row is at the time that was given"
    steps = np.diff(at)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        table.fail(
            row,
            "the time goes backwards" if steps[row - 1] < 0 else "the time of the row before",
            "Put the rows into their order, and write times with all of their digits",
        )
    return at, clock


def _fields(columns: Sequence[Column], volts: Volts | None) -> Array:
    """Readings (n, N) in tesla."""
    table = columns[0].table
    in_volts = [column.unit in VOLTS for column in columns]
    if any(in_volts) != all(in_volts):
        one, other = columns[in_volts.index(True)], columns[in_volts.index(False)]
        raise FormatError(
            f"column {one.name!r} is in {one.unit}, {other.name!r} in {other.unit}",
            file=table.file,
            where=1,
            hint="Write all sensors as voltages, or none",
        )
    if all(in_volts) and volts is None:
        raise InputError(
            "voltages, and nothing tells the field from them",
            file=table.file,
            where=columns[0].name,
            hint="Give --volts-per-tesla and --zero-volts, from the sensor's data sheet",
        )
    if volts is not None and not all(in_volts):
        raise InputError(
            f"volts per tesla, where the readings are in {columns[0].unit}",
            file=table.file,
            where=columns[0].name,
            hint="Say --units v, or leave out --volts-per-tesla and --zero-volts",
        )
    values = np.column_stack([column.numbers() for column in columns])
    if volts is None:
        return values
    sensors = len(columns)
    gains = _each("volts per tesla", volts.per_tesla, sensors)
    if not gains.all():
        raise InputError("0 volts per tesla", hint="Give it from the sensor's data sheet")
    if volts.zero is not None:
        zero = _each("zero volts", volts.zero, sensors)
    else:
        there = ~np.isnan(values).all(axis=0)
        zero = np.zeros(sensors)
        zero[there] = np.nanmedian(values[:, there], axis=0)
    return (values - zero) / gains


def _each(what: str, values: tuple[float, ...], sensors: int) -> Array:
    if len(values) not in (1, sensors) or not all(map(math.isfinite, values)):
        raise InputError(
            f"{len(values)} numbers of {what} for {sensors} sensors",
            hint="Give one for all, or one each in the order of the sensors",
        )
    return np.broadcast_to(np.array(values, float), (sensors,)).copy()


def _odometry(table: Table, found: Mapping[str, Column], time_ns: NDArray[np.int64]) -> Trajectory:
    """Poses of the rows that have one: odometry may be slower than the sensors."""
    values = np.column_stack([found[key].numbers() for key in POSE])
    gone = np.isnan(values)
    some = gone.any(axis=1) & ~gone.all(axis=1)
    if some.any():
        row = int(np.argmax(some))
        key = POSE[int(np.argmax(gone[row]))]
        table.fail(
            row,
            f"no {key} ({found[key].name!r}) where the rest of the pose is there",
            "Write all of x, y and heading, or leave all three empty",
        )
    there = ~gone.all(axis=1)
    if np.count_nonzero(there) < 2:
        raise InputError(
            "no odometry: the columns x, y and heading are empty",
            file=table.file,
            hint="Record the wheels too: four sensors alone do not tell the way",
        )
    fresh = np.flatnonzero(there)[_updates(values[there])]
    x, y, heading = values[fresh].T
    n = len(x)
    return Trajectory(
        DEVICE,
        FRAME,
        time_ns[fresh],
        np.column_stack([x, y, np.zeros(n)]),
        quaternion_from_heading(heading),
        np.full((n, 6, 6), np.nan),
    )


def _updates(poses: Array) -> NDArray[np.int64]:
    """Rows in which odometry is new, where most rows repeat the pose of the one before.

    A logger that is faster than the odometry writes a staircase, which no robot drives.
    Where the robot stands for long, the last of the equal rows counts as well.
    """
    n = len(poses)
    first = np.concatenate([[0], np.flatnonzero((np.diff(poses, axis=0) != 0).any(axis=1)) + 1])
    last = np.concatenate([first[1:] - 1, [n - 1]])
    held = float(np.median(last - first + 1))
    if len(first) < FEWEST_UPDATES or held < 2:
        return np.arange(n)
    stands = last[last - first + 1 > 2 * held]
    return np.unique(np.concatenate([first, stands, [n - 1]]))


def _doubts(odometry: Trajectory) -> list[str]:
    """What a robot on wheels cannot have driven: units or axes are other ones then."""
    place, heading = odometry.position[:, :2], heading_from_quaternion(odometry.quaternion)
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    doubts = []
    seconds = float(odometry.time_ns[-1] - odometry.time_ns[0]) * 1e-9
    if way[-1] > _FASTEST_MPS * seconds:
        doubts.append(
            f"odometry says {way[-1] / seconds:.3g} m/s on average: check the units of x and y"
        )
    strides = np.arange(0.0, way[-1], max(_STRIDE_M, way[-1] / 5000))
    stops = np.unique(np.searchsorted(way, strides))
    if len(stops) >= 5:
        step = np.diff(place[stops], axis=0)
        middle = heading[(stops[:-1] + stops[1:]) // 2]
        # Twice the angle: wheels roll backwards as well.
        turned = 2 * (np.arctan2(step[:, 1], step[:, 0]) - middle)
        if float(np.mean(np.cos(turned))) < _ALONG:
            doubts.append(
                "the robot does not drive where its heading points: check the unit of heading, "
                "that it grows counter-clockwise, and which column is x and which y"
            )
    return doubts
