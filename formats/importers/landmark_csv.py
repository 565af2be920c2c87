"""Recordings of hall sensors and odometry in one table (CSV), as robots log them.

One row a sample: the time, the pose of the robot's odometry (x, y, heading), which may be empty,
and a reading of each hall sensor. No such recording is published: columns and units are stated by
the user or by the header (:mod:`locatk.formats.tables.quantities`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.trajectory import MAX_ODOMETRY, Trajectory
from locatk.formats.importers.field_readings import exclude_readings, find_absent_readings
from locatk.formats.tables.clocks import read_times
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.dialects import read_any_table
from locatk.formats.tables.quantities import (
    UNITS,
    Column,
    find_columns,
    units_by_quantity,
)

Array = NDArray[np.float64]

DEVICE = "robot"
FRAME = "odometry"

TIME_KEY = "t"

POSE_KEYS = ("x", "y", "heading")
"""Keys of the columns of odometry."""

MIN_DISTINCT_POSES = 10
"""Fewer distinct poses do not show how often odometry is updated."""

MIN_ROWS_PER_UPDATE = 2
"""Median number of rows with the same pose from which on odometry is slower than the log."""

STRIDE_M = 0.02
"""Path length over which the direction of motion is compared with the heading."""

MAX_STRIDES = 5000

MIN_STRIDES = 4
"""Fewer strides do not show whether the robot moves along its heading."""

MIN_MEAN_ALIGNMENT = 0.5
"""Smallest plausible mean of cos(2 angle) between the direction of motion and the heading."""

MAX_SPEED_M_S = 10.0
"""Largest plausible mean speed of a robot."""

MAX_FIELD_T = 10.0
"""Larger fields are in another unit: permanent magnets reach their remanence, at most 1.5 T."""

MAX_GAP_S = 60.0
"""Largest time between two rows without a warning.

A robot logs several times a second. After a minute without a row, the clock has jumped, or the
robot may have been carried elsewhere.
"""


@dataclass(frozen=True)
class Volts:
    """Conversion of voltages to fields: one value for all sensors, or one each in their order.

    Attributes
    ----------
    per_tesla : tuple of float
        Negative if a field that points up lowers the voltage.
    zero : tuple of float or None
        Voltage without a field; None for the median of each sensor, which suits a robot that is
        off the landmarks most of the time.
    """

    per_tesla: tuple[float, ...]
    zero: tuple[float, ...] | None


@dataclass
class ImportedHalls:
    """Imported recording of hall sensors and odometry.

    Attributes
    ----------
    samples : HallSamples
    odometry : Trajectory
    facts : dict of str to str
        Source and assumptions, as text.
    warnings : list of str
        Losses and doubts, one line each.
    left_out : int
        Readings that are missing or unusable.
    left_out_poses : int
        Poses of odometry that are incomplete.
    """

    samples: HallSamples
    odometry: Trajectory
    facts: dict[str, str]
    warnings: list[str] = field(default_factory=list)
    left_out: int = 0
    left_out_poses: int = 0

    @property
    def lost(self) -> str | None:
        """Summary of the losses; None without any."""
        losses = []
        if self.left_out:
            losses.append(f"{self.left_out} of {self.samples.field_t.size} readings are excluded")
        if self.left_out_poses:
            losses.append(f"{self.left_out_poses} poses of odometry are excluded")
        return ", ".join(losses) or None


def read_landmarks(
    path: Path | Table,
    *,
    sensors: HallSensors,
    columns: Mapping[str, str] | None = None,
    units: Sequence[str] = (),
    volts: Volts | None = None,
    downward: bool = False,
    start_ns: int | None = None,
    times: tuple[NDArray[np.int64], str] | None = None,
) -> ImportedHalls:
    """Read one recording.

    Parameters
    ----------
    path : path or Table
    sensors : HallSensors
        Positions and names of the hall sensors; the names are the keys of their columns.
    columns : mapping of str to str, optional
        Headers of the keys ``t``, ``x``, ``y``, ``heading`` and of the sensors. Any other key has
        a column of its own name, with or without a unit.
    units : sequence of str
        At most one unit of each quantity, for columns without a unit in their names.
    volts : Volts, optional
        Required if readings are voltages.
    downward : bool
        Readings are positive if the field points down.
    start_ns : int, optional
        Time of the first row since the epoch. [default: times are kept; if the first one is
        negative, it becomes 0]
    times : tuple of (n,) int64 ndarray and str, optional
        Times of the rows since the epoch, and a text on their clock. [default: of the column
        ``t``]

    Raises
    ------
    MissingDataError, FormatError
        See :func:`~locatk.formats.tables.dialects.read_any_table` and
        :func:`~locatk.formats.tables.quantities.find_columns`.
    InputError
        A unit is unknown, a cell is not a number, times do not ascend, or nothing is usable.
    """
    given_units = units_by_quantity(units)
    reserved = [name for name in sensors.names if name in (TIME_KEY, *POSE_KEYS)]
    if reserved:
        raise InputError(
            f"a sensor is called {reserved[0]!r}", hint="Rename it: another column has this key"
        )
    table = path if isinstance(path, Table) else read_any_table(path)
    quantities = {
        **({TIME_KEY: ("time",)} if times is None else {}),
        "x": ("length",),
        "y": ("length",),
        "heading": ("angle",),
        **dict.fromkeys(sensors.names, ("field", "voltage")),
    }
    by_key = find_columns(table, quantities, columns or {}, given_units)
    time_ns, clock = times or read_times(by_key[TIME_KEY], start_ns)
    odometry, repeated_poses, partial_poses = read_odometry(table, by_key, time_ns)
    readings = [by_key[name] for name in sensors.names]
    field_t = _fields(readings, volts)
    # Rows with a pose and no reading are not samples.
    rows = np.flatnonzero(~np.isnan(field_t).all(axis=1))
    if not len(rows):
        raise InputError("no reading of any sensor", file=table.file, hint="Check the columns")
    field_t = -field_t[rows] if downward else field_t[rows]
    facts = {
        "format": "landmark-csv",
        "file": table.file.name,
        "rows": str(len(table)),
        "columns": ", ".join(
            f"{key}={column.name}" + (f" [{column.unit}]" if column.unit else "")
            for key, column in by_key.items()
        ),
        "clock": clock,
    }
    if volts is not None:
        facts["volts_per_tesla"] = ", ".join(f"{v:g}" for v in volts.per_tesla)
        facts["zero_volts"] = ", ".join(f"{v:g}" for v in volts.zero) if volts.zero else "median"
    if downward:
        facts["positive"] = "downward in the file, upward in the session"
    if repeated_poses:
        facts["odometry"] = f"{repeated_poses} repeated poses are skipped"
    samples = HallSamples(DEVICE, sensors, time_ns[rows], field_t)
    by_axis = samples.field_t[:, :, None]
    excluded, warnings = exclude_readings(
        by_axis,
        find_absent_readings(by_axis),
        table.file,
        [column.name for column in readings],
        [table.lines[row] for row in rows.tolist()],
    )
    if excluded == field_t.size:
        raise InputError("no usable reading", file=table.file, hint=warnings[0].split(": ", 1)[1])
    if partial_poses:
        warnings.append(
            f"{table.file}:{table.lines[partial_poses[0]]}: odometry is incomplete in "
            f"{len(partial_poses)} row{'s' * (len(partial_poses) > 1)}; excluded"
        )
    warnings += _time_warnings(table, time_ns) + _odometry_warnings(odometry)
    return ImportedHalls(samples, odometry, facts, warnings, excluded, len(partial_poses))


def _fields(columns: Sequence[Column], volts: Volts | None) -> Array:
    """Return the readings (n, N) in tesla."""
    table, first = columns[0].table, columns[0]
    is_voltage = [column.unit in UNITS["voltage"] for column in columns]
    other = next((c for c, v in zip(columns, is_voltage, strict=True) if v != is_voltage[0]), None)
    if other is not None:
        raise FormatError(
            f"column {first.name!r} is in {first.unit}, but {other.name!r} in {other.unit}",
            file=table.file,
            where=1,
            hint="Write all sensors as voltages, or none",
        )
    if is_voltage[0] and volts is None:
        raise InputError(
            "voltages without a conversion to fields",
            file=table.file,
            where=first.name,
            hint="Give --volts-per-tesla and --zero-volts, from the sensor's data sheet",
        )
    if volts is not None and not is_voltage[0]:
        raise InputError(
            f"volts per tesla for readings in {first.unit}",
            file=table.file,
            where=first.name,
            hint="Give --units v, or remove --volts-per-tesla and --zero-volts",
        )
    values = np.column_stack([column.in_si() for column in columns])
    if volts is not None:
        values = _fields_of_volts(values, volts)
    is_absurd = (np.abs(values) > MAX_FIELD_T).any(axis=1)
    if is_absurd.any():
        problem = f"a field beyond {MAX_FIELD_T:g} T"
        table.fail(int(np.argmax(is_absurd)), problem, "Check the number and the unit")
    return values


def _fields_of_volts(values: Array, volts: Volts) -> Array:
    """Convert voltages (n, N) to fields."""
    sensors = values.shape[1]
    gains = _per_sensor("volts per tesla", volts.per_tesla, sensors)
    if not gains.all():
        raise InputError("0 volts per tesla", hint="Give it from the sensor's data sheet")
    if volts.zero is not None:
        zero = _per_sensor("zero volts", volts.zero, sensors)
    else:
        has_readings = ~np.isnan(values).all(axis=0)
        zero = np.zeros(sensors)
        zero[has_readings] = np.nanmedian(values[:, has_readings], axis=0)
    return (values - zero) / gains


def _per_sensor(name: str, values: tuple[float, ...], sensors: int) -> Array:
    """Return one finite value for each sensor."""
    if len(values) not in (1, sensors) or not all(map(math.isfinite, values)):
        raise InputError(
            f"{len(values)} numbers of {name} for {sensors} sensors",
            hint="Give one for all, or one each in the order of the sensors",
        )
    return np.broadcast_to(np.array(values, float), (sensors,)).copy()


def read_odometry(
    table: Table, columns: Mapping[str, Column], time_ns: NDArray[np.int64]
) -> tuple[Trajectory, int, list[int]]:
    """Return the poses of odometry, which may be slower than the sensors.

    Returns
    -------
    (Trajectory, int, list of int)
        The poses, the number of rows that repeat the pose of an earlier row, and the rows whose
        pose is incomplete.
    """
    values = np.column_stack([columns[key].in_si() for key in POSE_KEYS])
    is_empty = np.isnan(values)
    partial = np.flatnonzero(is_empty.any(axis=1) & ~is_empty.all(axis=1)).tolist()
    rows = np.flatnonzero(~is_empty.any(axis=1))
    if len(rows) < 2:
        raise InputError(
            f"no odometry: {len(rows)} of {len(table)} rows have x, y and heading, not two",
            file=table.file,
            hint="Record the wheels too: four sensors alone do not determine the path",
        )
    is_absurd = (np.abs(values[rows]) > MAX_ODOMETRY).any(axis=1)
    if is_absurd.any():
        problem = f"a pose of odometry beyond {MAX_ODOMETRY:g} m or rad"
        table.fail(int(rows[np.argmax(is_absurd)]), problem, "Check the units of x, y and heading")
    updates = rows[_find_updates(values[rows])]
    x, y, heading = values[updates].T
    odometry = Trajectory(
        DEVICE,
        FRAME,
        time_ns[updates],
        np.column_stack([x, y, np.zeros(len(x))]),
        quaternion_from_heading(heading),
        np.full((len(x), 6, 6), np.nan),
    )
    return odometry, len(rows) - len(updates), partial


def _find_updates(poses: Array) -> NDArray[np.int64]:
    """Find the rows with a new pose if most rows repeat the previous one, otherwise all rows.

    A logger that is faster than odometry writes a staircase, which no robot drives. If the robot
    stands still for long, the last of the equal rows is also taken.
    """
    n = len(poses)
    first = np.concatenate([[0], np.flatnonzero((np.diff(poses, axis=0) != 0).any(axis=1)) + 1])
    last = np.concatenate([first[1:] - 1, [n - 1]])
    rows_per_update = float(np.median(last - first + 1))
    if len(first) < MIN_DISTINCT_POSES or rows_per_update < MIN_ROWS_PER_UPDATE:
        return np.arange(n)
    standstill_ends = last[last - first + 1 > 2 * rows_per_update]
    return np.unique(np.concatenate([first, standstill_ends, [n - 1]]))


def _time_warnings(table: Table, time_ns: NDArray[np.int64]) -> list[str]:
    """Warn of gaps in which the clock jumped, or the robot was switched off."""
    steps_s = np.diff(time_ns) * 1e-9
    gaps = np.flatnonzero(steps_s > MAX_GAP_S)
    if not len(gaps):
        return []
    first = int(gaps[0])
    more = f", and {len(gaps) - 1} more such gaps" if len(gaps) > 1 else ""
    return [
        f"{table.file}:{table.lines[first + 1]}: {steps_s[first]:.6g} s after the previous row"
        f"{more}: check the clock; the path in between is unknown"
    ]


def _odometry_warnings(odometry: Trajectory) -> list[str]:
    """Warn of motion that a robot on wheels cannot perform: units or axes are mistaken."""
    position = odometry.position[:, :2]
    heading = heading_from_quaternion(odometry.quaternion)
    steps_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    distance_m = np.concatenate([[0], np.cumsum(steps_m)])
    length_m = float(distance_m[-1])
    warnings = []
    duration_s = float(odometry.time_ns[-1] - odometry.time_ns[0]) * 1e-9
    if length_m > MAX_SPEED_M_S * duration_s:
        warnings.append(
            f"the mean speed of odometry is {length_m / duration_s:.3g} m/s: check the units of x "
            "and y"
        )
    strides_m = np.arange(0.0, length_m, max(STRIDE_M, length_m / MAX_STRIDES))
    stops = np.unique(np.searchsorted(distance_m, strides_m))
    if len(stops) > MIN_STRIDES:
        step = np.diff(position[stops], axis=0)
        middle_heading = heading[(stops[:-1] + stops[1:]) // 2]
        # Twice the angle, because wheels roll backwards as well.
        angle = 2 * (np.arctan2(step[:, 1], step[:, 0]) - middle_heading)
        if float(np.mean(np.cos(angle))) < MIN_MEAN_ALIGNMENT:
            warnings.append(
                "the robot does not move along its heading: check the unit of heading, that it "
                "grows counter-clockwise, and which column is x and which y"
            )
    return warnings
