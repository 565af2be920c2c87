"""Samples of accelerometers and gyroscopes in tables of any layout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.inertial import InertialSamples
from locatk.formats.importers.any_table.columns import (
    IMU_KEYS,
    ColumnGuess,
    device_groups,
    read_row_times,
)
from locatk.formats.tables.clocks import Clock
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import find_columns, units_by_quantity

Array = NDArray[np.float64]

USUAL_ACCELERATION_M_S2 = (4.0, 25.0)
"""Range of the median specific force of a device that does not fall: half to 2.5 times the standard
gravity. Beyond it, the unit is probably wrong, or gravity was subtracted."""

MAX_USUAL_RATE_RAD_S = 35.0
"""Largest usual median rate: the range of usual gyroscopes is 2000 deg/s."""

QUANTITIES = {"acceleration": "acceleration", "angular_rate": "angular rate"}
"""Quantity of each pair of :data:`IMU_KEYS`."""


def read_imu(
    table: Table,
    guess: ColumnGuess,
    *,
    device: str,
    units: Sequence[str] = (),
    clock: Clock | None = None,
    start_ns: int | None = None,
) -> tuple[list[InertialSamples], list[str]]:
    """Read the samples of an IMU; rows without a number of it are skipped.

    Parameters
    ----------
    table : Table
    guess : ColumnGuess
    device : str
        Name of the device, if there is no column of names.
    units : sequence of str
        At most one unit of each quantity, for columns without a unit in their names.
    clock : Clock, optional
        Declared clock of the times.
    start_ns : int, optional
        Time of the first row since the epoch.

    Returns
    -------
    (list of InertialSamples, list of str)
        One a device, in the order of their first rows, and warnings. Values are along the axes of
        the device.

    Raises
    ------
    FormatError
        An axis is missing, or a unit is unknown.
    InputError
        A cell is not a number, an axis is empty in a row with the others, or times do not ascend.
    """
    values: dict[str, Array] = {}
    for name, keys in IMU_KEYS.items():
        headers = {key: guess.headers[key] for key in keys if key in guess.headers}
        values[name] = np.full((len(table), 3), np.nan)
        if not headers:
            continue
        by_key = find_columns(
            table,
            dict.fromkeys(keys, (QUANTITIES[name],)),
            headers,
            units_by_quantity(units),
        )
        values[name] = np.column_stack([by_key[key].in_si() for key in keys])
        is_empty = np.isnan(values[name])
        is_partial = is_empty.any(axis=1) & ~is_empty.all(axis=1)
        if is_partial.any():
            row = int(np.argmax(is_partial))
            axis = by_key[keys[int(np.argmax(is_empty[row]))]].name
            table.fail(row, f"empty cell in column {axis!r}", "Complete or delete the row")
    both = np.hstack(list(values.values()))
    devices, groups = device_groups(table, guess, device)
    # Rows of sweeps may have equal times, and be late.
    max_delay_ns = guess.max_delay_ns
    time_ns, _ = read_row_times(
        table, guess, units, clock, start_ns=start_ns, groups=groups, max_delay_ns=max_delay_ns
    )
    samples = []
    for number, name in enumerate(devices):
        rows = np.flatnonzero((groups == number) & ~np.isnan(both).all(axis=1))
        rows = rows[np.argsort(time_ns[rows], kind="stable")]
        is_repeated = np.zeros(len(rows), bool)
        is_equal = (both[rows[1:]] == both[rows[:-1]]) | (
            np.isnan(both[rows[1:]]) & np.isnan(both[rows[:-1]])
        )
        is_repeated[1:] = (np.diff(time_ns[rows]) == 0) & is_equal.all(axis=1)
        rows = rows[~is_repeated]
        steps_ns = np.diff(time_ns[rows])
        if (steps_ns <= 0).any():
            table.fail(
                int(rows[int(np.argmax(steps_ns <= 0)) + 1]),
                "another sample of the IMU has the same time",
                "Write times with all of their digits",
            )
        if len(rows):
            samples.append(
                InertialSamples(
                    name,
                    time_ns[rows],
                    values["acceleration"][rows],
                    values["angular_rate"][rows],
                )
            )
    return samples, _unit_warnings(values)


def _unit_warnings(values: dict[str, Array]) -> list[str]:
    """Warn of magnitudes that show a wrong unit."""
    warnings = []
    force = np.linalg.norm(values["acceleration"], axis=1)
    rate = np.linalg.norm(values["angular_rate"], axis=1)
    if not np.isnan(force).all():
        median = float(np.nanmedian(force))
        if not USUAL_ACCELERATION_M_S2[0] <= median <= USUAL_ACCELERATION_M_S2[1]:
            warnings.append(
                f"the median acceleration is {median:.3g} m/s2, but 9.8 at rest: the unit may be "
                "wrong, or gravity was subtracted"
            )
    if not np.isnan(rate).all():
        median = float(np.nanmedian(rate))
        if median > MAX_USUAL_RATE_RAD_S:
            warnings.append(
                f"the median angular rate is {median:.3g} rad/s, beyond the range of usual "
                "gyroscopes: the unit may be wrong"
            )
    return warnings
