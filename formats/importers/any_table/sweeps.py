"""Sweeps of Lighthouse base stations, version 2, in tables of any layout.

A row is a sweep, or several sweeps received at the same time: a column ``count0_ch4_s2`` has the
LFSR counts of the first plane of channel 4 at photodiode 2. If the name does not state them,
channel, sensor and sweep are columns of their own. Sessions hold LFSR counts, to which the other
measurements are converted exactly (:mod:`locatk.core.lighthouse.light_planes`):

==========  ====================================================================================
``count``   LFSR index: steps of 6 MHz since the rotor's zero
``offset``  ticks of 6, 24 or 48 MHz since the rotor's zero
``alpha``   angle of the rotor since its zero
``angle``   angle of the plane from straight ahead, which needs to know the plane
==========  ====================================================================================

Angles are those of the rotor. Angles that were corrected by the calibration of the station, and
azimuth and elevation of version 1, are other quantities.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.channels import (
    CHANNELS,
    POLYNOMIAL_COUNT,
    TICK_HZ,
    TICKS_PER_COUNT,
    channel_of,
    period_counts,
)
from locatk.core.lighthouse.lfsr import SEQUENCE_LENGTH
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.formats.importers.any_table.columns import (
    STATION_KEYS,
    ColumnGuess,
    Measurement,
    describe_columns,
    device_groups,
    read_row_times,
)
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.tables.clocks import Clock
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import (
    UNITS,
    Column,
    find_columns,
    split_unit,
    units_by_quantity,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

COUNT_HZ = TICK_HZ / TICKS_PER_COUNT

MAX_ROUNDING_COUNTS = 1e-3
"""Largest rounding error of an angle at the rotor's zero, in counts: 5e-8 rad."""

MAX_SENSOR = 255
"""Largest number of a photodiode; the largest known receivers have 32."""

MEASUREMENT_HINTS = {
    "count": "Counts are steps of 6 MHz; name a column of other ticks offset",
    "offset": "Check the unit of the offset",
    "alpha": "alpha is 0 at the rotor's zero; if it is 0 straight ahead, name the column angle",
    "angle": "angle is 0 straight ahead; if it is 0 at the rotor's zero, name the column alpha",
}
"""Remedy if a measurement is not within a rotation."""


def read_sweeps(
    table: Table,
    guess: ColumnGuess,
    *,
    device: str,
    units: Sequence[str] = (),
    clock: Clock | None = None,
    start_ns: int | None = None,
    receiver: Receiver | None = None,
    imu: Sequence[InertialSamples] = (),
    warnings: Sequence[str] = (),
) -> ImportedSession:
    """Read the sweeps of one or several devices; empty cells are no sweeps.

    A table without measurements of sweeps becomes a session of ``imu`` alone.

    Parameters
    ----------
    table : Table
    guess : ColumnGuess
    device : str
        Name of the device, if there is no column of names.
    units, clock, start_ns
        As in :func:`.inertial.read_imu`.
    receiver : Receiver, optional
        Layout of the photodiodes of each device.
    imu : sequence of InertialSamples
    warnings : sequence of str
        Doubts about ``imu``.

    Raises
    ------
    FormatError
        The channel is unknown or stated twice, the plane of an angle is unknown, or a unit is.
    InputError
        A cell is not a number or is out of range, times do not ascend, or there is no sweep.
    """
    measurements = guess.measurements
    _check_keys(table, guess)
    # The unit of the times says nothing about offsets.
    stated = {name: unit for name, unit in units_by_quantity(units).items() if name != "time"}
    headers = {key: guess.headers[key] for key in measurements}
    wanted = {
        key: (_quantity(measurement, headers[key]),)
        for key, measurement in measurements.items()
        if measurement.quantity != "count"
    }
    by_key = find_columns(table, wanted, {key: headers[key] for key in wanted}, stated)
    for key in measurements:
        if key not in by_key:
            by_key[key] = Column(table, headers[key], "")
    devices, groups = device_groups(table, guess, device)
    time_ns, clock_text = read_row_times(
        table,
        guess,
        units,
        clock,
        start_ns=start_ns,
        groups=groups,
        max_delay_ns=guess.max_delay_ns,
    )
    empty = np.zeros(0, np.int64)
    parts: list[tuple[NDArray[Any], ...]] = [(*[empty] * 6, np.zeros(0))]
    for key, measurement in measurements.items():
        column = by_key[key]
        values = table.floats(column.name, allow_missing=True)
        rows = np.flatnonzero(~np.isnan(values))
        labels = _labels(table, guess, measurement, rows)
        counts = _counts(table, column, measurement, rows, values[rows], labels)
        parts.append((rows, time_ns[rows], *labels, counts))
    rows, times, sensor, channel, polynomial, sweep, count = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    warnings = list(warnings)
    if not len(rows) and (measurements or not imu):
        names = ", ".join(headers.values())
        raise InputError(
            f"no sweep: {names + ' is empty' if names else 'no column has a measurement'}",
            file=table.file,
            hint="Name the column of measurements: --columns count=NAME",
        )
    if not measurements:
        warnings.append("no sweeps of base stations: the session cannot be solved")
    order = np.lexsort((rows, times))
    integers = [values[order].astype(np.int32) for values in (sensor, channel, polynomial, sweep)]
    sweeps = Sweeps(
        devices=devices,
        time_ns=times[order],
        device=groups[rows[order]].astype(np.int32),
        sensor=integers[0],
        channel=integers[1],
        polynomial=integers[2],
        sweep=integers[3],
        count=count[order],
    )
    described = {key: by_key[key] for key in measurements}
    facts = {
        "format": "table",
        "file": table.file.name,
        "rows": str(len(table)),
        "columns": describe_columns(guess, described),
        "clock": clock_text,
    }
    receivers = {} if receiver is None else dict.fromkeys(devices, receiver)
    return ImportedSession(sweeps, None, [], facts, warnings, receivers=receivers, imu=tuple(imu))


def _quantity(measurement: Measurement, header: str) -> str:
    """Return the quantity of a measurement with a unit; offsets are times if their name is one."""
    if measurement.quantity != "offset":
        return "angle"
    return "time" if split_unit(header)[1] in UNITS["time"] else "ticks"


def _check_keys(table: Table, guess: ColumnGuess) -> None:
    """Refuse columns that contradict each other, and measurements that cannot be converted."""
    stations = [key for key in STATION_KEYS if key in guess.headers]
    if {"channel", "station"} <= set(stations):
        names = " and ".join(repr(guess.headers[key]) for key in stations[:2])
        raise FormatError(
            f"columns {names} both number the base stations",
            file=table.file,
            where=1,
            hint="Name one of them only, and delete or rename the other",
        )
    for key, measurement in guess.measurements.items():
        problem, hint = "", ""
        if measurement.channel is None and not stations:
            problem = "its base station is unknown"
            hint = (
                f"Name the column of channels (--columns channel=NAME), or {key}_ch4 of channel 4"
            )
        elif measurement.channel is not None and stations:
            problem = f"its channel is in its key and in column {guess.headers[stations[0]]!r}"
            hint = "Remove one of them"
        elif measurement.channel is not None and measurement.channel not in CHANNELS:
            problem, hint = f"there is no channel {measurement.channel}", "Channels are 1 to 16"
        elif measurement.plane is not None and "sweep" in guess.headers:
            problem = f"its plane is in its key and in column {guess.headers['sweep']!r}"
            hint = "Remove one of them"
        elif measurement.sensor is not None and "sensor" in guess.headers:
            problem = f"its sensor is in its key and in column {guess.headers['sensor']!r}"
            hint = "Remove one of them"
        elif (
            measurement.quantity == "angle"
            and measurement.plane is None
            and ("sweep" not in guess.headers)
        ):
            problem = "an angle from straight ahead is a rotor angle only if its plane is known"
            hint = "Name the column of planes (--columns sweep=NAME), or angle0 and angle1"
        if problem:
            raise FormatError(
                f"column {guess.headers[key]!r} ({key}): {problem}",
                file=table.file,
                where=1,
                hint=hint,
            )


def _labels(
    table: Table,
    guess: ColumnGuess,
    measurement: Measurement,
    rows: IntArray,
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return sensor, channel, polynomial and plane of the sweeps in some rows."""
    polynomial = _integers(table, guess, "polynomial", rows, 0, POLYNOMIAL_COUNT - 1, UNKNOWN)
    if measurement.channel is not None:
        channel = np.full(len(rows), measurement.channel)
    elif "channel" in guess.headers:
        channel = _integers(table, guess, "channel", rows, CHANNELS[0], CHANNELS[-1])
    elif "station" in guess.headers:
        channel = _integers(table, guess, "station", rows, 0, len(CHANNELS) - 1) + CHANNELS[0]
    else:
        channel = _integers(table, guess, "polynomial", rows, 0, POLYNOMIAL_COUNT - 1)
        channel = channel_of(channel)
    is_other = (polynomial != UNKNOWN) & (channel_of(polynomial) != channel)
    if is_other.any():
        index = int(np.argmax(is_other))
        table.fail(
            int(rows[index]),
            f"polynomial {polynomial[index]} is not of channel {channel[index]}",
            "Check which column has the channel: it counts from 1, stations count from 0",
        )
    if measurement.sensor is not None:
        sensor = np.full(len(rows), measurement.sensor)
    else:
        sensor = _integers(table, guess, "sensor", rows, 0, MAX_SENSOR, 0)
    if measurement.plane is not None:
        sweep = np.full(len(rows), measurement.plane)
    else:
        needs_plane = measurement.quantity == "angle"
        sweep = _integers(table, guess, "sweep", rows, 0, 1, None if needs_plane else UNKNOWN)
    return sensor, channel, polynomial, sweep


_INTEGER_HINTS = {
    "channel": "Channels are 1 to 16; name a column that counts from 0 station",
    "station": "Stations are 0 to 15; name a column that counts from 1 channel",
    "sweep": "0 is the first light plane of a rotation, 1 the second; leave unknown ones empty",
}


def _integers(
    table: Table,
    guess: ColumnGuess,
    key: str,
    rows: IntArray,
    low: int,
    high: int,
    missing: int | None = None,
) -> IntArray:
    """Return whole numbers of a column in some rows; ``missing`` for empty cells and columns.

    An empty cell is an error if ``missing`` is None.
    """
    name = guess.headers.get(key)
    if name is None:
        return np.full(len(rows), UNKNOWN if missing is None else missing)
    values = table.floats(name, allow_missing=True)[rows]
    is_missing = np.isnan(values)
    if missing == UNKNOWN:
        is_missing |= values == UNKNOWN
    filled = np.where(is_missing, low, values)
    is_wrong = (filled < low) | (filled > high) | (filled != np.floor(filled))
    is_wrong |= is_missing & (missing is None)
    if is_wrong.any():
        row = int(rows[int(np.argmax(is_wrong))])
        cell = table.columns[name][row].strip()[:40]
        hint = _INTEGER_HINTS.get(key, "Correct or delete the row")
        problem = f"{cell} in column {name!r} should be" if cell else f"column {name!r} should have"
        table.fail(row, f"{problem} a whole number from {low} to {high}", hint)
    return np.where(is_missing, low if missing is None else missing, filled).astype(np.int64)


def _counts(
    table: Table,
    column: Column,
    measurement: Measurement,
    rows: IntArray,
    values: Array,
    labels: tuple[IntArray, IntArray, IntArray, IntArray],
) -> Array:
    """Convert measurements to LFSR counts."""
    _, channel, _, sweep = labels
    period = period_counts(channel)
    if measurement.quantity == "count":
        counts = values
    elif measurement.quantity == "offset" and column.unit in UNITS["ticks"]:
        counts = values / round(1 / (UNITS["ticks"][column.unit] * COUNT_HZ))
    elif measurement.quantity == "offset":
        counts = values * (UNITS["time"][column.unit] * 1e-9 * COUNT_HZ)
    else:
        angle = values * UNITS["angle"][column.unit]
        zero = ROTOR_ZERO_RAD[sweep] if measurement.quantity == "angle" else 0.0
        counts = (angle - zero) / (2 * np.pi) * period
    # Decoders that err report any index, also beyond the rotation. Solvers reject these sweeps.
    is_index = measurement.quantity in ("count", "offset")
    limit = np.full(len(rows), float(SEQUENCE_LENGTH)) if is_index else period
    is_wrong = ~((counts >= -MAX_ROUNDING_COUNTS) & (counts <= limit))
    if is_wrong.any():
        index = int(np.argmax(is_wrong))
        row = int(rows[index])
        cell = table.columns[column.name][row].strip()[:40]
        table.fail(
            row,
            f"{cell} in column {column.name!r} is not within a rotation of channel "
            f"{channel[index]} ({period[index]:.8g} counts)",
            MEASUREMENT_HINTS[measurement.quantity],
        )
    return np.maximum(counts, 0.0)
