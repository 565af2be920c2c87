"""Keys of the columns of a table, and the usual names by which they are recognised.

Names are compared without separators and units, as in ``mag0_x [uT]``, ``Bx1 (mT)``,
``odom.pose.x_mm`` or ``accel_x (g)``; the user names those that are not recognised. A unit that is
neither in the name nor stated by the user is an error, except that of times since 1970 if both the
first time and the spacing of the rows agree with it (:data:`EPOCH_RANGE_NS`,
:data:`ROW_SPACING_RANGE_NS`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.landmarks.halls import NAMES as HALL_NAMES
from locatk.formats.artifacts.kinds import MIN_KEY_SIMILARITY
from locatk.formats.importers.landmark_csv import POSE_KEYS, TIME_KEY
from locatk.formats.tables.clocks import Clock, check_unit, is_time_of_day, read_times
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.numbers import parse_number
from locatk.formats.tables.quantities import (
    TIME_NAMES,
    Column,
    find_columns,
    split_unit,
    units_by_quantity,
)
from locatk.formats.tables.timestamps import NANOSECONDS, is_iso_time

DATE_KEY, DEVICE_KEY = "date", "device"
"""Keys of the date of a time of the day, and of the name of a device."""

STATION_KEYS = ("channel", "station", "polynomial")
"""Keys of the base station: channel from 1, number from 0, or LFSR polynomial."""

SWEEP_KEYS = (*STATION_KEYS, "sensor", "sweep")
"""Keys that describe a sweep, besides its measurement."""

MEASUREMENTS = ("count", "offset", "angle", "alpha")
"""Keys of the measurement of a sweep: LFSR count, ticks, or angle from ahead or since the zero."""

IMU_KEYS = {"acceleration": ("ax", "ay", "az"), "angular_rate": ("gx", "gy", "gz")}

MAX_SWEEP_DELAY_NS = 20_000_000
"""Largest step back of the times of sweeps [ns], a rotation rounded up: devices report the
photodiodes of a passage, and stations that are received at the same time, in any order."""

EPOCH_RANGE_NS = (1_262_304_000 * 10**9, 4_102_444_800 * 10**9)
"""First times since 1970 that are recognised without a unit [ns]: from 2010-01-01 to before
2100-01-01. A number is within this range in one unit at most, since units differ by factors of a
thousand."""

ROW_SPACING_RANGE_NS = (1_000, 10_000_000_000)
"""Plausible median step between different times since 1970 without a unit [ns]: sensors are
sampled at 0.1 Hz to 1 MHz. Most counters since power-on whose first count is like a date are too
coarse in that unit, as steps of 20000 us that would be 20000 s. Not detected are those of 14.6 to
47.5 days that step by 10 ms or less (5 ms would be 5 s)."""

_MEASUREMENT_KEY = re.compile(
    rf"({'|'.join(MEASUREMENTS)})_?([01])?(?:_?ch(?:annel)?_?(\d{{1,2}}))?(?:_?s(?:ensor)?_?(\d{{1,3}}))?"
)
MAX_NAME_CHARACTERS = 64
"""Longest name of a device."""

_MAGNETOMETER_KEY = re.compile(r"b\d{1,3}[xyz]")
_NOT_IN_NAMES = re.compile(r"[^a-z0-9]+")
_MAGNETOMETERS = (
    re.compile(
        r"(?:magnetometer|magnetic_field|mag|field|sensor|b|m)_?(\d{0,3})_?(?:b|m)?_?([xyz])"
    ),
    re.compile(r"(?:magnetometer|mag|b|m)_?([xyz])_?(\d{1,3})"),
)
_PREFIX = r"(?:(?:odom|odometry|pose|position|pos|robot|base|wheel)_)*"
# The x and y of an orientation are components of a quaternion.
_ODOMETRY = re.compile(rf"{_PREFIX}(?:([xy])|(?:orientation_)?(?:heading|yaw|theta|phi|psi))")
_HALL_PREFIX = re.compile(r"^(?:hall_?|h_)")
_TIMES = re.compile(r"t|time|time_?stamp|stamp|seconds|secs|elapsed|elapsed_time|clock")
_ACCELERATION = re.compile(
    r"(?:imu_)?(?:a|acc|accel|acceleration|accelerometer|linear_acceleration)_?([xyz])"
)
_ANGULAR_RATE = re.compile(
    r"(?:imu_)?(?:g|gyr|gyro|gyroscope|omega|angular_rate|angular_velocity)_?([xyz])"
)
_MEASUREMENT_NAMES = re.compile(r"lfsr(?:_count|_index)?(?=_?[01]?(?:_|$))|rotor_angle|raw_angle")
_SWEEP_NAMES = {
    "channel": ("channel", "mode"),
    "polynomial": ("polynomial", "poly", "lfsr_polynomial"),
    "sensor": ("sensor", "sensor_id", "photodiode", "diode"),
    "sweep": ("sweep", "sweep_id", "plane", "light_plane"),
}
_STATION_NAMES = ("station", "base_station", "basestation", "lighthouse", "bs", "lh")
"""Names of a number of a base station that may count from 0 or from 1."""
_DEVICE_NAMES = ("device", "device_id", "robot_id", "receiver")
_COUNTER_UNITS = {"millis": "ms", "micros": "us"}
"""Units of times that are named like the functions of an Arduino."""


# ---- columns


@dataclass(frozen=True)
class Measurement:
    """Key of the measurement of a sweep, as in ``count``, ``angle1`` or ``count0_ch4_s2``.

    Attributes
    ----------
    quantity : str
        One of :data:`MEASUREMENTS`.
    plane, channel, sensor : int or None
        None if a column of its own contains it.
    """

    quantity: str
    plane: int | None
    channel: int | None
    sensor: int | None

    def __str__(self) -> str:
        plane = "" if self.plane is None else str(self.plane)
        channel = "" if self.channel is None else f"_ch{self.channel}"
        return f"{self.quantity}{plane}{channel}" + (
            "" if self.sensor is None else f"_s{self.sensor}"
        )


def parse_measurement(key: str) -> Measurement | None:
    """Return the measurement of a key; None if it is another key."""
    match = _MEASUREMENT_KEY.fullmatch(key)
    if match is None:
        return None
    plane, channel, sensor = (None if text is None else int(text) for text in match.groups()[1:])
    return Measurement(match[1], plane, channel, sensor)


@dataclass(frozen=True)
class ColumnGuess:
    """Columns that were recognised by their names.

    Attributes
    ----------
    headers : dict of str to str
        Header of each key: ``t`` and ``date``; ``device``; ``b0x``, ``b0y``, ``b0z``, ``b1x``, ...
        of magnetometers 0 to 999; names of hall sensors; ``x``, ``y`` and ``heading`` of odometry;
        :data:`SWEEP_KEYS` and keys of measurements (:func:`parse_measurement`) of sweeps;
        :data:`IMU_KEYS`.
    units : dict of str to str
        Unit of the times, by the quantity ``time``, if it follows from a name such as ``millis``
        or from times since 1970; otherwise empty.
    ignored : tuple of str
        Headers that are not used.
    halls : tuple of str
        Names of the hall sensors.
    """

    headers: dict[str, str]
    units: dict[str, str]
    ignored: tuple[str, ...]
    halls: tuple[str, ...] = HALL_NAMES

    @property
    def magnetometers(self) -> list[int]:
        """Numbers of the magnetometers, ascending."""
        return sorted({int(key[1:-1]) for key in self.headers if _MAGNETOMETER_KEY.fullmatch(key)})

    @property
    def has_halls(self) -> bool:
        return any(name in self.headers for name in self.halls)

    @property
    def has_odometry(self) -> bool:
        return all(key in self.headers for key in POSE_KEYS)

    @property
    def measurements(self) -> dict[str, Measurement]:
        """Measurements of sweeps by their keys."""
        parsed = {key: parse_measurement(key) for key in self.headers}
        return {key: measurement for key, measurement in parsed.items() if measurement}

    @property
    def max_delay_ns(self) -> int | None:
        """Time by which rows may be late; None if times must strictly ascend."""
        return MAX_SWEEP_DELAY_NS if self.measurements else None

    @property
    def has_imu(self) -> bool:
        return any(key in self.headers for keys in IMU_KEYS.values() for key in keys)


def guess_columns(
    table: Table,
    given: Mapping[str, str],
    units: Sequence[str],
    *,
    halls: tuple[str, ...] = HALL_NAMES,
    clock: Clock | None = None,
) -> ColumnGuess:
    """Recognise columns by their names.

    Parameters
    ----------
    table : Table
    given : mapping of str to str
        Headers of keys as the user named them.
    units : sequence of str
        Units that the user stated.
    halls : tuple of str
        Names of the hall sensors.
    clock : Clock, optional
        Declared clock of the times.

    Raises
    ------
    FormatError
        Two columns may be the same quantity, or a header of ``given`` does not exist.
    InputError
        A key of ``given`` is unknown, or a time is not a number.
    """
    for key in given:
        check_key(key, halls)
    headers = {key: name.strip().lower() for key, name in given.items()}
    table.require(*headers.values())
    candidates: dict[str, list[str]] = {}
    hall_names = {_NOT_IN_NAMES.sub("_", hall.lower()).strip("_"): hall for hall in halls}
    hall_names |= {hall.strip().lower(): hall for hall in halls}
    for name in table.columns:
        usual = _key_of(table, name, hall_names)
        if usual is not None and name not in headers.values() and usual not in headers:
            candidates.setdefault(usual, []).append(name)
    named = {_kind_of(key, halls) for key in headers} - {None}
    if len(named) == 1:
        # The user decided which observations of the table to import.
        candidates = {
            key: names
            for key, names in candidates.items()
            if _kind_of(key, halls) in (None, *named)
        }
    _check_stations(table, {*candidates, *headers}, halls)
    for key in _unneeded_keys({*candidates, *headers}, halls):
        candidates.pop(key, None)
    if TIME_KEY in headers or TIME_KEY in candidates:
        times = headers.get(TIME_KEY) or candidates[TIME_KEY][0]
        if not is_time_of_day(table.columns[times][0]):
            candidates.pop(DATE_KEY, None)
    for key, names in candidates.items():
        if len(names) > 1:
            raise FormatError(
                f"{len(names)} columns may be {key}: {', '.join(names)}",
                file=table.file,
                where=1,
                hint=f"Name one: --columns {key}={names[0]}",
            )
        headers[key] = names[0]
    ignored = tuple(name for name in table.columns if name and name not in headers.values())
    time_unit = {} if clock else _time_unit(table, headers.get(TIME_KEY), units)
    return ColumnGuess(headers, time_unit, ignored, halls)


def check_key(key: str, halls: Iterable[str] = HALL_NAMES) -> None:
    """Raise InputError if a key of a column is unknown."""
    known = [TIME_KEY, DATE_KEY, DEVICE_KEY, *POSE_KEYS, *halls, *SWEEP_KEYS]
    known += [axis for axes in IMU_KEYS.values() for axis in axes]
    if key in known or parse_measurement(key) or _MAGNETOMETER_KEY.fullmatch(key):
        return
    near = difflib.get_close_matches(key, [*known, *MEASUREMENTS], 1, MIN_KEY_SIMILARITY)
    keys = ", ".join([*known, *MEASUREMENTS, "b0x, b0y, b0z, b1x, ..."])
    raise InputError(
        f"unknown column key {key!r}", hint=f"Did you mean {near[0]}?" if near else f"Keys: {keys}"
    )


def _bare_name(header: str) -> str:
    """Return a header in lower case, without its unit, with ``_`` as the only separator."""
    return _NOT_IN_NAMES.sub("_", split_unit(header)[0]).strip("_")


def _key_of(table: Table, name: str, halls: Mapping[str, str]) -> str | None:
    """Return the key of a header; None if it has no usual name.

    ``halls`` are the names of the hall sensors by their forms in headers.
    """
    bare = _bare_name(name)
    if bare in TIME_NAMES or _TIMES.fullmatch(bare) or bare in _COUNTER_UNITS:
        return TIME_KEY
    if bare == DATE_KEY:
        return DATE_KEY
    if bare in _DEVICE_NAMES:
        return DEVICE_KEY
    if hall := _hall_of(name, bare, halls):
        return hall
    if match := _MAGNETOMETERS[0].fullmatch(bare):
        return f"b{int(match[1] or 0)}{match[2]}"
    if match := _MAGNETOMETERS[1].fullmatch(bare):
        return f"b{int(match[2])}{match[1]}"
    if match := _ODOMETRY.fullmatch(bare):
        return match[1] or "heading"
    if match := _ACCELERATION.fullmatch(bare):
        return f"a{match[1]}"
    if match := _ANGULAR_RATE.fullmatch(bare):
        return f"g{match[1]}"
    return _sweep_key(table, name, bare)


def _hall_of(name: str, bare: str, halls: Mapping[str, str]) -> str | None:
    """Return the hall sensor of a header, which may have ``hall`` before or behind its name."""
    short = _HALL_PREFIX.sub("", bare)
    for text in (name, bare, short, bare.removesuffix("_hall"), short.removesuffix("_hall")):
        if text and text in halls:
            return halls[text]
    return None


def _sweep_key(table: Table, name: str, bare: str) -> str | None:
    """Return the key of a header of sweeps; a station whose first number is unknown has none."""
    for key, names in _SWEEP_NAMES.items():
        if bare in names:
            return key
    if bare in _STATION_NAMES:
        counts_from_zero = any(cell.strip() in ("0", "0.0") for cell in table.columns[name])
        return "station" if counts_from_zero else None
    measurement = parse_measurement(_MEASUREMENT_NAMES.sub(_quantity_of, bare))
    return str(measurement) if measurement else None


def _quantity_of(match: re.Match[str]) -> str:
    return "angle" if match[0].endswith("angle") else "count"


def _unneeded_keys(keys: set[str], halls: Iterable[str]) -> set[str]:
    """Return the keys that mean nothing without others.

    A column ``angle``, ``mode`` or ``sensor`` is only part of a sweep if the station is known.
    ``count_1`` without ``count_0`` counts from 1 and is not used. A single column ``ax`` is no
    accelerometer.
    """
    measurements = {key: each for key in keys if (each := parse_measurement(key))}
    has_station = any(key in keys for key in STATION_KEYS)
    usable = {
        key
        for key, each in measurements.items()
        if (has_station or each.channel is not None)
        and (each.plane != 1 or str(replace(each, plane=0)) in measurements)
    }
    unneeded = set(measurements) - usable
    if not usable:
        unneeded |= set(SWEEP_KEYS)
    has_imu = False
    for axes in IMU_KEYS.values():
        if all(axis in keys for axis in axes):
            has_imu = True
        else:
            unneeded |= set(axes)
    has_fields = any(_MAGNETOMETER_KEY.fullmatch(key) for key in keys)
    has_fields |= any(name in keys for name in halls)
    if not has_fields:
        unneeded |= set(POSE_KEYS)
    if has_fields or not (usable or has_imu):
        unneeded.add(DEVICE_KEY)
    return unneeded


def _kind_of(key: str, halls: Iterable[str]) -> str | None:
    """Return the kind of observations of which a key is; None if it may be part of several."""
    if _MAGNETOMETER_KEY.fullmatch(key):
        return "magnetometers"
    if key in halls:
        return "halls"
    return "sweeps" if parse_measurement(key) else None


def _check_stations(table: Table, keys: set[str], halls: Iterable[str]) -> None:
    """Refuse numbers of stations of which it is not known whether they count from 0 or from 1."""
    kinds = {_kind_of(key, halls) for key in keys}
    if any(key in keys for key in STATION_KEYS) or kinds & {"magnetometers", "halls"}:
        return
    measurements = [each for key in keys if (each := parse_measurement(key))]
    for name in table.columns:
        bare = _NOT_IN_NAMES.sub("_", name).strip("_")
        if bare in _STATION_NAMES and any(each.channel is None for each in measurements):
            raise FormatError(
                f"column {name!r} may count base stations from 0 or from 1",
                file=table.file,
                where=1,
                hint=f"Name it: --columns station={name} from 0, --columns channel={name} from 1",
            )


def _time_unit(table: Table, name: str | None, units: Sequence[str]) -> dict[str, str]:
    """Return the unit of times that is neither in their name nor stated; empty if unknown."""
    if name is None or split_unit(name)[1] or is_iso_time(table.columns[name][0]):
        return {}
    if "time" in units_by_quantity(units):
        return {}
    unit = _COUNTER_UNITS.get(_bare_name(name)) or _epoch_unit(table, name)
    return {"time": unit} if unit else {}


def _epoch_unit(table: Table, name: str) -> str | None:
    """Return the unit of times since 1970; None if they are not certain to be such times.

    Raises
    ------
    InputError
        The first time may be since 1970, but another cell is not a number.
    """
    try:
        first = parse_number(table.columns[name][0])
    except ValueError:
        return None
    low, high = EPOCH_RANGE_NS
    fitting = [unit for unit, size in NANOSECONDS.items() if low <= first * size < high]
    if len(fitting) != 1:
        return None
    # Sweeps that were received together have equal times, and devices may be interleaved.
    steps = np.diff(np.unique(table.floats(name)))
    if not len(steps):
        return None
    low, high = ROW_SPACING_RANGE_NS
    return fitting[0] if low <= np.median(steps) * NANOSECONDS[fitting[0]] <= high else None


def device_groups(
    table: Table, guess: ColumnGuess, device: str
) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Return the names of the devices in the order of their first rows, and that of each row.

    Without a column of names, all rows are of ``device``.

    Raises
    ------
    InputError
        A name is empty or not printable.
    """
    if DEVICE_KEY not in guess.headers:
        return (device,), np.zeros(len(table), np.int64)
    names = [cell.strip() for cell in table.columns[guess.headers[DEVICE_KEY]]]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    for name in numbers:
        if not (name and name.isprintable() and len(name) <= MAX_NAME_CHARACTERS):
            table.fail(
                names.index(name),
                f"{name[:MAX_NAME_CHARACTERS]!r} is not the name of a device",
                f"Write 1 to {MAX_NAME_CHARACTERS} printable characters",
            )
    return tuple(numbers), np.array([numbers[name] for name in names], np.int64)


def describe_columns(guess: ColumnGuess, columns: Mapping[str, Column]) -> str:
    """Return the keys, headers and units of the columns that were read, and of the times."""
    texts = [f"{key}={guess.headers[key]}" for key in (DATE_KEY, TIME_KEY) if key in guess.headers]
    for key, column in columns.items():
        texts.append(f"{key}={column.name}" + (f" [{column.unit}]" if column.unit else ""))
    return ", ".join(texts)


# ---- times


def read_row_times(
    table: Table,
    guess: ColumnGuess,
    units: Sequence[str],
    clock: Clock | None,
    *,
    start_ns: int | None = None,
    groups: NDArray[np.int64] | None = None,
    max_delay_ns: int | None = None,
) -> tuple[NDArray[np.int64], str]:
    """Return the times of the rows in nanoseconds since the epoch, and a text on their clock.

    Parameters
    ----------
    table : Table
    guess : ColumnGuess
    units : sequence of str
        Units that the user stated.
    clock : Clock or None
        Declared clock of the times.
    start_ns, groups, max_delay_ns
        As in :func:`~locatk.formats.tables.clocks.read_times`.

    Raises
    ------
    FormatError
        There is no column of times, or its unit is unknown or contradicts its clock.
    InputError
        As :func:`~locatk.formats.tables.clocks.read_times`.
    """
    stated = units_by_quantity(units)
    name = guess.headers.get(TIME_KEY)
    dates = guess.headers.get(DATE_KEY)
    if name is not None and clock is not None:
        check_unit(table, name, clock, stated)
        column = Column(table, name, clock.unit)
    elif name is not None and is_time_of_day(table.columns[name][0]):
        if dates is None:
            raise FormatError(
                f"column {name!r} has times of the day without dates",
                file=table.file,
                where=1,
                hint="Name the column of the dates: --columns date=NAME",
            )
        column = Column(table, name, "")
    else:
        headers = {} if name is None else {TIME_KEY: name}
        by_key = find_columns(table, {TIME_KEY: ("time",)}, headers, {**guess.units, **stated})
        column = by_key[TIME_KEY]
    return read_times(
        column,
        start_ns,
        clock=clock,
        dates=dates,
        groups=groups,
        max_delay_ns=max_delay_ns,
    )
