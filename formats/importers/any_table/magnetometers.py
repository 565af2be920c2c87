"""Samples of magnetometers, and odometry, in tables of any layout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.any_table.columns import (
    ColumnGuess,
    describe_columns,
    read_row_times,
)
from locatk.formats.importers.field_readings import exclude_readings, find_absent_readings
from locatk.formats.importers.landmark_csv import POSE_KEYS, read_odometry
from locatk.formats.importers.polaris_csv import ImportedSamples
from locatk.formats.tables.clocks import Clock
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import find_columns, units_by_quantity

Array = NDArray[np.float64]

DEVICE = "bar"

EARTH_FIELD_T = (5e-6, 5e-3)
"""Range of the median field of a magnetometer near the ground, with magnets around it, in tesla;
the field of the Earth is 25 to 65 uT. Beyond it, the unit is probably wrong."""


def read_magnetometers(
    table: Table,
    guess: ColumnGuess,
    *,
    array: SensorArray | None = None,
    spacing_m: float | None = None,
    units: Sequence[str] = (),
    clock: Clock | None = None,
    start_ns: int | None = None,
) -> tuple[ImportedSamples, Trajectory | None]:
    """Read the samples of an array of magnetometers, and odometry.

    Parameters
    ----------
    table : Table
    guess : ColumnGuess
    array : SensorArray, optional
        Positions of the sensors, in the order of their numbers.
    spacing_m : float, optional
        Distance between neighbouring sensors of a straight bar, the first of which is the
        rightmost; if there is no ``array``.
    units : sequence of str
        At most one unit of each quantity, for columns without a unit in their names.
    clock : Clock, optional
        Declared clock of the times.
    start_ns : int, optional
        Time of the first row since the epoch.

    Returns
    -------
    (ImportedSamples, Trajectory or None)
        Fields are along the axes of the array. The second is odometry.

    Raises
    ------
    FormatError
        An axis of a sensor is missing, or a unit is unknown.
    InputError
        A cell is not a number, times do not ascend, the array has another number of sensors, or
        no value is usable.
    """
    numbers = guess.magnetometers
    if not numbers:
        raise FormatError(
            "no columns of magnetometers",
            file=table.file,
            where=1,
            hint="Name them: --columns b0x=NAME,b0y=NAME,b0z=NAME",
        )
    if array is None:
        if spacing_m is None and len(numbers) > 1:
            raise InputError(
                f"{len(numbers)} magnetometers at unknown positions",
                file=table.file,
                hint="Give --spacing MM, or --array array.toml",
            )
        array = SensorArray(bar(len(numbers), spacing_m or 0.0))
    if len(array) != len(numbers):
        raise InputError(
            f"{len(numbers)} magnetometers, but {len(array)} in the array", file=table.file
        )
    keys = [f"b{number}{axis}" for number in numbers for axis in "xyz"]
    pose_keys = POSE_KEYS if guess.has_odometry else ()
    quantities = {
        **dict.fromkeys(keys, ("field",)),
        **{key: ("angle",) if key == "heading" else ("length",) for key in pose_keys},
    }
    headers = {key: header for key, header in guess.headers.items() if key in quantities}
    missing = [key for key in keys if key not in headers]
    if missing:
        raise FormatError(
            f"no column for {missing[0]}: a magnetometer has x, y and z",
            file=table.file,
            where=1,
            hint=f"Name it: --columns {missing[0]}=NAME",
        )
    time_ns, clock_text = read_row_times(table, guess, units, clock, start_ns=start_ns)
    by_key = find_columns(table, quantities, headers, units_by_quantity(units))
    field_t = np.stack([by_key[key].in_si() for key in keys], axis=1).reshape(len(table), -1, 3)
    # Rows with a sample of an IMU alone are not samples of magnetometers.
    is_sample = ~np.isnan(field_t).all(axis=(1, 2)) | (not guess.has_imu)
    rows = np.flatnonzero(is_sample)
    field_t = field_t[rows]
    samples = Samples(DEVICE, array, time_ns[rows], field_t)
    excluded, warnings = exclude_readings(
        samples.field_t,
        find_absent_readings(field_t),
        table.file,
        [f"magnetometer {number}" for number in numbers],
        [table.lines[row] for row in rows.tolist()],
    )
    if excluded == field_t.size:
        raise InputError("no usable value", file=table.file, hint=warnings[-1])
    median_t = float(np.nanmedian(np.linalg.norm(field_t, axis=2)))
    if not EARTH_FIELD_T[0] <= median_t <= EARTH_FIELD_T[1]:
        warnings.append(
            f"the median field is {1e6 * median_t:.3g} uT, but that of the Earth is 25 to 65 uT: "
            "the unit may be wrong, or the background was subtracted"
        )
    odometry = read_odometry(table, by_key, time_ns)[0] if pose_keys else None
    facts = {
        "format": "table",
        "file": table.file.name,
        "rows": str(len(table)),
        "columns": describe_columns(guess, by_key),
        "clock": clock_text,
    }
    return ImportedSamples(samples, facts, warnings, excluded), odometry
