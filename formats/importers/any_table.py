"""Tables of any layout: magnetometers, hall sensors and odometry by the names of their columns.

Names are compared with usual ones, as in ``mag0_x [uT]``, ``Bx1 (mT)`` or ``odom.pose.x_mm``; the
user names those that are not recognised. Units are never guessed, except those of times since 1970,
which differ by factors of a thousand.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.landmarks.halls import NAMES as HALL_NAMES
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.field_readings import exclude_readings, find_absent_readings
from locatk.formats.importers.landmark_csv import POSE_KEYS, TIME_KEY, read_odometry
from locatk.formats.importers.polaris_csv import ImportedSamples
from locatk.formats.tables.clocks import read_times
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import (
    TIME_NAMES,
    find_columns,
    split_unit,
    units_by_quantity,
)
from locatk.formats.tables.timestamps import is_iso_time

Array = NDArray[np.float64]

DEVICE = "bar"

EPOCH_RANGES = {"s": (1e8, 1e11), "ms": (1e11, 1e14), "us": (1e14, 1e17), "ns": (1e17, 1e19)}
"""Times since 1970 in each unit: from 1973 to the year 5138."""

EARTH_FIELD_T = (5e-6, 5e-3)
"""Range of the median field of a magnetometer near the ground, with magnets around it, in tesla;
the field of the Earth is 25 to 65 uT. Beyond it, the unit is probably wrong."""

_NOT_IN_NAMES = re.compile(r"[^a-z0-9]+")
_MAGNETOMETERS = (
    re.compile(
        r"(?:magnetometer|magnetic_field|mag|field|sensor|b|m)_?(\d{0,3})_?(?:b|m)?_?([xyz])"
    ),
    re.compile(r"(?:magnetometer|mag|b|m)_?([xyz])_?(\d{1,3})"),
)
_PREFIX = r"(?:(?:odom|odometry|pose|position|pos|robot|base|wheel|orientation)_)*"
_ODOMETRY = re.compile(rf"{_PREFIX}(x|y|heading|yaw|theta|phi|psi)")
_HALLS = re.compile(rf"(?:hall_?|h_)?({'|'.join(HALL_NAMES)})(?:_hall)?")
_TIMES = re.compile(r"t|time|time_?stamp|stamp|seconds|secs|elapsed|elapsed_time|clock")


# ---- columns


@dataclass(frozen=True)
class ColumnGuess:
    """Columns that were recognised by their names.

    Attributes
    ----------
    headers : dict of str to str
        Header of each key: ``t``; ``b0x`` to ``b8z`` of magnetometers; ``front``, ``left``,
        ``rear`` and ``right`` of hall sensors; ``x``, ``y`` and ``heading`` of odometry.
    units : dict of str to str
        Units of times that follow from the numbers.
    ignored : tuple of str
        Headers that are not used.
    """

    headers: dict[str, str]
    units: dict[str, str]
    ignored: tuple[str, ...]

    @property
    def magnetometers(self) -> list[int]:
        """Numbers of the magnetometers, ascending."""
        return sorted({int(key[1:-1]) for key in self.headers if re.fullmatch(r"b\d+[xyz]", key)})

    @property
    def has_halls(self) -> bool:
        return any(name in self.headers for name in HALL_NAMES)

    @property
    def has_odometry(self) -> bool:
        return all(key in self.headers for key in POSE_KEYS)

    def options(self) -> str:
        """Return the options that state what was recognised."""
        columns = ",".join(f"{key}={header}" for key, header in self.headers.items())
        return f"--columns {columns}" + "".join(f" --units {unit}" for unit in self.units.values())


def guess_columns(table: Table, given: Mapping[str, str], units: Sequence[str]) -> ColumnGuess:
    """Recognise columns by their names.

    Parameters
    ----------
    table : Table
    given : mapping of str to str
        Headers of keys as the user named them.
    units : sequence of str
        Units that the user stated.

    Raises
    ------
    FormatError
        Two columns may be the same quantity, or a header of ``given`` does not exist.
    """
    headers = {key: name.strip().lower() for key, name in given.items()}
    table.require(*headers.values())
    candidates: dict[str, list[str]] = {}
    for name in table.columns:
        key = _key_of(name)
        if key is not None and name not in headers.values() and key not in headers:
            candidates.setdefault(key, []).append(name)
    for key, names in candidates.items():
        if len(names) > 1:
            raise FormatError(
                f"{len(names)} columns may be {key}: {', '.join(names)}",
                file=table.file,
                where=1,
                hint=f"Name one: --columns {key}={names[0]}",
            )
        headers[key] = names[0]
    ignored = tuple(name for name in table.columns if name not in headers.values())
    return ColumnGuess(headers, _time_unit(table, headers.get(TIME_KEY), units), ignored)


def _key_of(name: str) -> str | None:
    """Return the key of a header; None if it has no usual name."""
    bare = _NOT_IN_NAMES.sub("_", split_unit(name)[0]).strip("_")
    if bare in TIME_NAMES or _TIMES.fullmatch(bare) or bare in ("millis", "micros"):
        return TIME_KEY
    if match := _HALLS.fullmatch(bare):
        return match[1]
    if match := _MAGNETOMETERS[0].fullmatch(bare):
        return f"b{int(match[1] or 0)}{match[2]}"
    if match := _MAGNETOMETERS[1].fullmatch(bare):
        return f"b{int(match[2])}{match[1]}"
    if match := _ODOMETRY.fullmatch(bare):
        return match[1] if match[1] in ("x", "y") else "heading"
    return None


def _time_unit(table: Table, name: str | None, units: Sequence[str]) -> dict[str, str]:
    """Return the unit of times that have none in their name, if there is only one possibility."""
    if name is None or split_unit(name)[1] or is_iso_time(table.columns[name][0]):
        return {}
    if "time" in units_by_quantity(units):
        return {}
    if name in ("millis", "micros"):
        return {"time": {"millis": "ms", "micros": "us"}[name]}
    try:
        first = float(table.columns[name][0])
    except ValueError:
        return {}
    fitting = [unit for unit, (low, high) in EPOCH_RANGES.items() if low <= first < high]
    return {"time": fitting[0]} if fitting else {}


# ---- magnetometers


def read_magnetometers(
    table: Table,
    guess: ColumnGuess,
    *,
    array: SensorArray | None = None,
    spacing_m: float | None = None,
    units: Sequence[str] = (),
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
        TIME_KEY: ("time",),
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
    known_units = {**guess.units, **units_by_quantity(units)}
    by_key = find_columns(table, quantities, headers, known_units)
    time_ns, clock = read_times(by_key[TIME_KEY], start_ns)
    field_t = np.stack([by_key[key].in_si() for key in keys], axis=1).reshape(len(table), -1, 3)
    samples = Samples(DEVICE, array, time_ns, field_t)
    excluded, warnings = exclude_readings(
        samples.field_t,
        find_absent_readings(field_t),
        table.file,
        [f"magnetometer {number}" for number in numbers],
        table.lines,
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
        "columns": ", ".join(
            f"{key}={column.name}" + (f" [{column.unit}]" if column.unit else "")
            for key, column in by_key.items()
        ),
        "clock": clock,
    }
    return ImportedSamples(samples, facts, warnings, excluded), odometry
