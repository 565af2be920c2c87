"""Tables of LFSR counts as published by the DotBot group (CSV).

The header determines the layout; the order of the columns does not matter:

===================  =====================================================  ===========
layout               columns of counts                                      station
===================  =====================================================  ===========
one-station          ``c0, c1``                                             channel 1
two-station          ``LHA_count_1, LHA_count_2, LHB_count_1, LHB_count_2`` 1 and 2
two-station-labels   ``lha_poly_0, lha_count_0, ... lhb_poly_1, ...``       polynomials
station-per-row      ``poly_0, lfsr_index_0, poly_1, lfsr_index_1``         polynomials
sweep-per-row        ``poly, lfsr_index`` and optionally ``sweep``          polynomials
===================  =====================================================  ===========

The first two do not contain polynomials: their channels are those that the authors' own code
assumes. Optional columns ``poly_0, poly_1`` or ``LHA_poly_1, ...`` determine the channel instead.
``timestamp`` is required, in UTC. ``source`` names the device; without it there is one, called
``robot``. ``real_x_mm, real_y_mm, real_z_mm`` are truth. The two counts of a pair are in any
order, so that no sweep is labelled first or second.

``db_time`` is the clock of the robot in microseconds. Files that have it were made from a log in
which each record is one sweep (``LH_parse_logfile.py`` of alvarado24automatic, ``parse_logfile.py``
of alvarado24lh-distortion): every row repeats the last sweeps of the robot, of which one is new and
``db_time`` is its time. Repeated ones are up to seconds old and are left out
(:func:`find_new_counts`).

``sweep`` is the place of a sweep in the memory of the robot, which is not always its plane
(:func:`find_planes`).

All counts of a row share its time stamp. Counts beyond the period of a channel are kept: the
solver rejects and counts them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import TickClock
from locatk.core.errors import FormatError
from locatk.core.lighthouse.channels import (
    POLYNOMIAL_COUNT,
    TICK_HZ,
    TICKS_PER_COUNT,
    channel_of,
    period_ticks,
)
from locatk.core.lighthouse.lfsr import SEQUENCE_LENGTH
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import TIME_NAMES, split_unit

Array = NDArray[np.float64]

DEFAULT_DEVICE = "robot"
"""Name of the device in files without a column ``source``."""

TIME_COLUMN = "timestamp"
EPOCH_COLUMN = "timestamp_s"
TICK_COLUMN = "db_time"
INDEX_COLUMN = ""
SLOT_COLUMN = "sweep"
TRUTH_COLUMNS = ("real_x_mm", "real_y_mm", "real_z_mm")
PLANE_COLUMNS = ("x", "y")

MILLIMETRES_PER_METRE = 1000

MAX_SLOT = 255
"""Largest number of a slot; robots have two."""

MAX_INDEX = 10**9
"""Largest number of a row."""

MAX_TRUTH_MM = 1e6
"""Largest coordinate of the truth, 1 km: larger ones are damaged or in another unit."""

ROBOT_HZ, ROBOT_BITS = 1e6, 32
"""Clock of the robot, ``db_time``."""

MICROSECONDS_PER_TICK = 1e6 / TICK_HZ

MIN_UPDATES = 5
"""Fewest rows in motion that show whether rows repeat sweeps."""

MOTION_COUNTS = 20
"""Smallest change of a count from row to row that is motion: ten times the scatter at rest."""

REPEAT_PROBABILITY = 0.2
CHANCE_MARGIN = 2.5
MIN_SINGLE_FRACTION = 0.1
"""Rows repeat sweeps if in a larger fraction of the rows in motion a single count is new. In
complete reports all counts are; one that is measured again is equal with a probability of 0.2 (by a
scatter of 2 counts), of which a multiple is required."""

ROTOR_TOLERANCE_US = 300.0
"""Largest error of the time at which a rotor starts, as predicted from an earlier rotation: both
clocks agree to 100 ppm over :data:`MAX_ROTOR_INTERVAL_US`, with some margin."""

MAX_ROTOR_INTERVAL_US = 2_000_000

MAX_BACKWARD_FRACTION = 0.01
"""Largest fraction of rows that are earlier than the row before in a log in the order of time."""

MAX_NEIGHBOUR_NS = 1_000_000_000
"""Longest time to the sweep of the other slot with which a sweep is compared. The planes are a
third of a rotation apart, of which a robot moves a small part in a second."""

MIN_SLOT_FRACTION = 0.95
MIN_SLOT_SWEEPS = 10
"""Fraction and number of the compared sweeps of a slot that have to be of one plane, so that the
others of the slot are taken to be of that plane."""

ALIASES: Mapping[str, str] = {
    "polynomial": "poly",
    "lfsr_location": "lfsr_index",
    "lfsr_count": "lfsr_index",
    "lfsr_counts": "lfsr_index",
    "address": "source",
    "device": "source",
    "dbtime": TICK_COLUMN,
    **dict.fromkeys(TIME_NAMES, TIME_COLUMN),
}
"""Other names of columns, as in firmware and logs of DotBots."""


class CountColumn(NamedTuple):
    """Column of counts, and the column of the polynomial that determines its station.

    ``channel`` is assumed if that column is missing; if it is None, the column is required.
    """

    count_name: str
    polynomial_name: str
    channel: int | None


LAYOUTS = {
    "one-station": (CountColumn("c0", "poly_0", 1), CountColumn("c1", "poly_1", 1)),
    "two-station": (
        CountColumn("lha_count_1", "lha_poly_1", 1),
        CountColumn("lha_count_2", "lha_poly_2", 1),
        CountColumn("lhb_count_1", "lhb_poly_1", 2),
        CountColumn("lhb_count_2", "lhb_poly_2", 2),
    ),
    "two-station-labels": (
        CountColumn("lha_count_0", "lha_poly_0", None),
        CountColumn("lha_count_1", "lha_poly_1", None),
        CountColumn("lhb_count_0", "lhb_poly_0", None),
        CountColumn("lhb_count_1", "lhb_poly_1", None),
    ),
    "station-per-row": (
        CountColumn("lfsr_index_0", "poly_0", None),
        CountColumn("lfsr_index_1", "poly_1", None),
    ),
    "sweep-per-row": (CountColumn("lfsr_index", "poly", None),),
}


@dataclass(frozen=True)
class CountRows:
    """Rows of a recording: n rows with k counts each.

    Attributes
    ----------
    devices : tuple of str
    time_ns : (n,) int64 ndarray
    device : (n,) int32 ndarray
    count : (n, k) float64 ndarray
    channel, polynomial : (n, k) int32 ndarray
    truth_m : (n, 3) ndarray or None
    plane : (n, 2) ndarray or None
        Columns x and y: coordinates of PyDotBot's plane, without unit.
    tick : (n,) int64 ndarray or None
        Time of the newest count of each row by the clock of the robot, in microseconds.
    slot : (n,) int64 ndarray or None
        Place of the sweep in the memory of the robot.
    log_order : (n,) int64 ndarray
        Number of the row in the log, which may differ from the order of time.
    """

    devices: tuple[str, ...]
    time_ns: NDArray[np.int64]
    device: NDArray[np.int32]
    count: Array
    channel: NDArray[np.int32]
    polynomial: NDArray[np.int32]
    truth_m: Array | None
    plane: Array | None
    tick: NDArray[np.int64] | None
    slot: NDArray[np.int64] | None
    log_order: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, index: NDArray[np.int64]) -> CountRows:
        """Return the rows ``index``, in that order."""
        return replace(
            self,
            time_ns=self.time_ns[index],
            device=self.device[index],
            count=self.count[index],
            channel=self.channel[index],
            polynomial=self.polynomial[index],
            truth_m=None if self.truth_m is None else self.truth_m[index],
            plane=None if self.plane is None else self.plane[index],
            tick=None if self.tick is None else self.tick[index],
            slot=None if self.slot is None else self.slot[index],
            log_order=self.log_order[index],
        )


def rename_columns(table: Table) -> Table:
    """Return a table with the names of columns that this module knows.

    Case, blanks, hyphens and points do not matter, and names of :data:`ALIASES` are replaced.

    Raises
    ------
    FormatError
        Two columns have the same name.
    """
    columns: dict[str, Sequence[str]] = {}
    for header, cells in table.columns.items():
        name = _column_name(header)
        if name in columns:
            raise FormatError(
                f"column {name!r} occurs twice", file=table.file, where=1, hint="Rename one"
            )
        columns[name] = cells
    return replace(table, columns=columns)


def _column_name(header: str) -> str:
    bare, unit = split_unit(header)
    time = ALIASES.get(_simplify(bare), _simplify(bare))
    if unit and time in (TIME_COLUMN, TICK_COLUMN):
        return TICK_COLUMN if (time, unit) == (TICK_COLUMN, "us") else f"{time}_{unit}"
    name = _simplify(header)
    base, _, number = name.rpartition("_")
    if number in ("0", "1"):
        return f"{ALIASES.get(base, base)}_{number}"
    return ALIASES.get(name, name)


def _simplify(name: str) -> str:
    return re.sub(r"[\s.-]+", "_", name)


def detect_layout(table: Table) -> str:
    """Return the name of the layout (:data:`LAYOUTS`) of a table by its header.

    Raises
    ------
    FormatError
        The header belongs to no layout; the message lists the columns that the nearest one lacks.
    """
    present = set(table.columns)
    if EPOCH_COLUMN in present:
        present.add(TIME_COLUMN)
    nearest, missing = "", list(present)
    for name, columns in LAYOUTS.items():
        required = {TIME_COLUMN, *(column.count_name for column in columns)}
        required |= {column.polynomial_name for column in columns if column.channel is None}
        absent = sorted(required - present)
        if not absent:
            return name
        has_counts = len(absent) < len(required) - (TIME_COLUMN in present)
        if has_counts and (not nearest or len(absent) < len(missing)):
            nearest, missing = name, absent
    if nearest:
        raise FormatError(
            f"missing column {', '.join(map(repr, missing))} (layout {nearest!r})",
            file=table.file,
            where=1,
            hint="Export the table with all of its columns",
        )
    raise FormatError(
        "not a table of a known DotBot layout",
        file=table.file,
        where=1,
        hint="Its header should have timestamp and c0, c1; or LHA_count_1, LHA_count_2, "
        "LHB_count_1, LHB_count_2; or poly_0, lfsr_index_0, poly_1, lfsr_index_1; or poly, "
        "lfsr_index",
    )


def read_rows(table: Table, layout: str) -> CountRows:
    """Return the columns of a table of a layout as arrays.

    Raises
    ------
    InputError
        A cell is not a number or time, or a count or polynomial does not exist.
    """
    n = len(table)
    sources = [name.strip() for name in table.columns.get("source", [DEFAULT_DEVICE] * n)]
    if "" in sources:
        table.fail(sources.index(""), "empty cell in column 'source'", "Name the device")
    devices = tuple(dict.fromkeys(sources))
    index = {name: i for i, name in enumerate(devices)}
    count, channel, polynomial = [], [], []
    for column in LAYOUTS[layout]:
        # Positions in a bit sequence; fractions come from averages.
        count.append(table.floats(column.count_name, 0, SEQUENCE_LENGTH))
        if column.polynomial_name in table.columns:
            polynomial.append(table.integers(column.polynomial_name, 0, POLYNOMIAL_COUNT - 1))
            channel.append(channel_of(polynomial[-1]))
        else:
            polynomial.append(np.full(n, UNKNOWN))
            channel.append(np.full(n, column.channel))
    truth_m = None
    if any(name in table.columns for name in TRUTH_COLUMNS):
        table.require(*TRUTH_COLUMNS)
        truth_mm = np.stack(
            [table.floats(name, -MAX_TRUTH_MM, MAX_TRUTH_MM) for name in TRUTH_COLUMNS], axis=1
        )
        truth_m = truth_mm / MILLIMETRES_PER_METRE
    plane = None
    if all(name in table.columns for name in PLANE_COLUMNS):
        plane = np.stack([table.floats(name) for name in PLANE_COLUMNS], axis=1)
    has_dates = TIME_COLUMN in table.columns
    tick = slot = None
    if TICK_COLUMN in table.columns:
        tick = table.integers(TICK_COLUMN, 0, (1 << ROBOT_BITS) - 1)
    if SLOT_COLUMN in table.columns and len(LAYOUTS[layout]) == 1:
        slot = table.integers(SLOT_COLUMN, 0, MAX_SLOT)
    return CountRows(
        devices,
        table.iso_times_ns(TIME_COLUMN) if has_dates else table.epoch_times_ns(EPOCH_COLUMN),
        np.array([index[name] for name in sources], np.int32),
        np.stack(count, axis=1),
        np.stack(channel, axis=1).astype(np.int32),
        np.stack(polynomial, axis=1).astype(np.int32),
        truth_m,
        plane,
        tick,
        slot,
        table.integers(INDEX_COLUMN, 0, MAX_INDEX) if _has_index(table) else np.arange(n),
    )


def _has_index(table: Table) -> bool:
    """Return whether the first column numbers the rows (written by pandas, with rows removed)."""
    cells = table.columns.get(INDEX_COLUMN, ())
    return len(set(cells)) == len(table) and all(cell.isdecimal() for cell in cells)


def merge_rows(parts: Sequence[CountRows]) -> CountRows:
    """Concatenate rows of several files, with common device numbers."""
    devices = tuple(dict.fromkeys(name for part in parts for name in part.devices))
    if len(parts) == 1:
        return parts[0]

    def concatenated(arrays: list[Any]) -> Any:
        present = [array for array in arrays if array is not None]
        return np.concatenate(present) if len(present) == len(arrays) else None

    offsets = np.cumsum([0, *(int(part.log_order.max()) + 1 for part in parts[:-1])])
    numbers = [np.array([devices.index(name) for name in part.devices], np.int32) for part in parts]
    return CountRows(
        devices,
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([number[part.device] for number, part in zip(numbers, parts, strict=True)]),
        np.concatenate([part.count for part in parts]),
        np.concatenate([part.channel for part in parts]),
        np.concatenate([part.polynomial for part in parts]),
        concatenated([part.truth_m for part in parts]),
        concatenated([part.plane for part in parts]),
        concatenated([part.tick for part in parts]),
        concatenated([part.slot for part in parts]),
        np.concatenate(
            [part.log_order + first for part, first in zip(parts, offsets, strict=True)]
        ),
    )


def sort_and_deduplicate(rows: CountRows, warnings: list[str]) -> CountRows:
    """Return the rows in order of time, one for each device, time and set of channels."""
    by_device = np.argsort(rows.device, kind="stable")
    steps_ns = np.diff(rows.time_ns[by_device])
    same_device = np.diff(rows.device[by_device]) == 0
    backwards = int(np.count_nonzero((steps_ns < 0) & same_device))
    if backwards:
        warnings.append(f"time stamps went backwards {backwards} times: rows were sorted")

    # Rows of single sweeps may share a time stamp, since it is that of a line of a log.
    keys = rows.channel if rows.count.shape[1] > 1 else np.c_[rows.polynomial, rows.count]
    order = np.lexsort((*keys.T, rows.time_ns, rows.device))
    key = np.column_stack([rows.device, rows.time_ns, keys])[order]
    is_first = np.r_[True, np.any(key[1:] != key[:-1], axis=1)]
    first = order[np.maximum.accumulate(np.where(is_first, np.arange(len(order)), 0))]
    is_equal = np.all(rows.count[order] == rows.count[first], axis=1)
    copies = int(np.count_nonzero(~is_first & is_equal))
    conflicts = int(np.count_nonzero(~is_first & ~is_equal))
    if copies:
        warnings.append(f"{copies} rows repeat another row exactly: dropped")
    if conflicts:
        warnings.append(
            f"{conflicts} rows repeat the time stamp of another row of their device with other "
            "counts: the first was kept"
        )
    kept = order[is_first]
    return rows.take(kept[np.argsort(rows.time_ns[kept], kind="stable")])


# ---- clocks of the robots


def set_robot_times(rows: CountRows, warnings: list[str]) -> CountRows:
    """Return the rows with times by the clocks of the robots, fitted to the time stamps.

    Without ``tick`` they stay as they are.
    """
    if rows.tick is None:
        return rows
    time_ns = rows.time_ns.copy()
    for number, name in enumerate(rows.devices):
        of_device = np.flatnonzero(rows.device == number)
        clock = TickClock(ROBOT_HZ, ROBOT_BITS)
        time_ns[of_device] = clock.times(rows.tick[of_device], rows.time_ns[of_device])
        if clock.restarts:
            warnings.append(f"the clock of {name} restarted {clock.restarts} times")
    return replace(rows, time_ns=time_ns)


def find_new_counts(rows: CountRows) -> tuple[NDArray[np.bool_], Array]:
    """Find the counts that are not repeated from an earlier row, and their times.

    In a file with the clock of the robot, a row holds the last sweep of each plane. New are those
    that differ from the row before in the order of the log. The one that was logged last was
    received at ``tick``, others at the time at which the rotor of their station, whose phase is
    known from rows with one new sweep, gives their count (:func:`_choose_rotations`). If nothing
    differs, the sweep whose rotor agrees with ``tick`` is new.

    Returns
    -------
    is_new : (n, k) bool ndarray
        All counts without ``tick``, and in files of which every row is a complete report.
    offset_us : (n, k) ndarray
        Time of each new count relative to ``tick``; zero if it is unknown.
    """
    is_new, offset_us = np.ones(rows.count.shape, bool), np.zeros(rows.count.shape)
    if rows.tick is None or rows.count.shape[1] < 2:
        return is_new, offset_us
    for number in range(len(rows.devices)):
        index = np.flatnonzero(rows.device == number)
        index = index[np.argsort(rows.log_order[index], kind="stable")]
        count, polynomial = rows.count[index], rows.polynomial[index]
        steps = np.abs(np.diff(count, axis=0, prepend=np.inf))
        changed = (steps != 0) | (np.diff(polynomial, axis=0, prepend=UNKNOWN) != 0)
        is_single = changed.sum(axis=1) == 1
        is_moving = np.isfinite(steps[:, 0]) & (steps.max(axis=1) > MOTION_COUNTS)
        repeated_by_chance = REPEAT_PROBABILITY ** (count.shape[1] - 1)
        threshold = max(MIN_SINGLE_FRACTION, CHANCE_MARGIN * repeated_by_chance)
        is_held = is_single[is_moving]
        if len(is_held) < MIN_UPDATES or is_held.mean() < threshold:
            continue
        age_us = _ages_by_rotors(
            count, rows.channel[index], rows.tick[index], changed & is_single[:, None]
        )
        with np.errstate(invalid="ignore"):
            agrees = np.abs(age_us) < ROTOR_TOLERANCE_US
        agrees[agrees.sum(axis=1) != 1] = False
        is_unchanged = ~changed.any(axis=1)
        is_new[index] = np.where(is_unchanged[:, None], agrees, changed)
        is_dated = changed & ~is_single[:, None] & np.isfinite(age_us)
        tick = rows.tick[index]
        is_by_station = bool(np.mean(np.diff(tick) < 0) > MAX_BACKWARD_FRACTION)
        for column in range(count.shape[1]):
            new = np.flatnonzero(is_new[index, column])
            time_us = _choose_rotations(
                tick[new].tolist(),
                np.where(is_dated[new, column], age_us[new, column], np.nan).tolist(),
                (period_ticks(rows.channel[index[new], column]) * MICROSECONDS_PER_TICK).tolist(),
                is_by_station=is_by_station,
            )
            offset_us[index[new], column] = time_us - tick[new]
    return is_new, offset_us


def _choose_rotations(
    tick: list[int], age_us: list[float], period_us: list[float], *, is_by_station: bool
) -> Array:
    """Return the times (n,) of the sweeps of one plane, in the order of the log.

    Parameters
    ----------
    tick : list of int
        Times of the sweeps that were logged last.
    age_us : list of float
        Times since the last passage of the plane before ``tick``; ``nan`` for sweeps that were
        received at ``tick``.
    period_us : list of float
    is_by_station : bool
        The log is in the order of stations and not of time, so that a sweep may be later than
        ``tick``. The nearest passage is chosen, unless a neighbour is of the same rotation.
    """
    time_us = np.array(tick, float)
    for k, (last, age, period) in enumerate(zip(tick, age_us, period_us, strict=True)):
        if np.isnan(age):
            continue
        passages = [last - max(age, 0.0)]
        if is_by_station:
            passages.insert(int(age < period / 2), last - age + period)
        taken = [time_us[k - 1]] if k else []
        if k + 1 < len(tick) and np.isnan(age_us[k + 1]):
            taken.append(tick[k + 1])
        free = [p for p in passages if all(abs(p - other) > period / 2 for other in taken)]
        time_us[k] = free[0] if free else passages[0]
    return time_us


def _ages_by_rotors(
    count: Array,
    channel: NDArray[np.int32],
    tick: NDArray[np.int64],
    is_known: NDArray[np.bool_],
) -> Array:
    """Return the time by which each sweep precedes ``tick`` according to the rotor of its station.

    Parameters
    ----------
    count, channel : (m, k) ndarray
        In the order of the log.
    tick : (m,) int64 ndarray
    is_known : (m, k) bool ndarray
        Counts that were received at ``tick``. They determine the phases of the rotors.

    Returns
    -------
    (m, k) ndarray
        Microseconds, from ``-ROTOR_TOLERANCE_US`` to less than a rotation; ``nan`` without a known
        count of the station within :data:`MAX_ROTOR_INTERVAL_US`.
    """
    age_us = np.full(count.shape, np.nan)
    start_us = tick[:, None] - count * (TICKS_PER_COUNT * MICROSECONDS_PER_TICK)
    for station in np.unique(channel).tolist():
        known = is_known & (channel == station)
        rows = np.flatnonzero(known.any(axis=1))
        if not len(rows):
            continue
        last = np.searchsorted(rows, np.arange(len(count)), side="right") - 1
        reference = rows[np.maximum(last, 0)]
        known_start_us = start_us[reference, known[reference].argmax(axis=1)]
        elapsed_us = start_us - known_start_us[:, None]
        period_us = float(period_ticks(station)) * MICROSECONDS_PER_TICK
        age = (elapsed_us + ROTOR_TOLERANCE_US) % period_us - ROTOR_TOLERANCE_US
        is_recent = np.abs(elapsed_us) < MAX_ROTOR_INTERVAL_US
        age_us = np.where((channel == station) & is_recent, age, age_us)
    return age_us


# ---- planes of single sweeps


def find_planes(sweeps: Sweeps, slot: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the plane (n,) of each sweep: 0, 1 or ``UNKNOWN``.

    Robots keep the sweeps of a station in two slots by the time of their arrival. A slot holds one
    plane as long as the robot receives the station. Which one is found by comparing each sweep with
    the nearest ones of the other slot: the count of the first plane is smaller.

    Parameters
    ----------
    sweeps : Sweeps
        Ascending in time.
    slot : (n,) int64 ndarray
        ``UNKNOWN`` if the source does not report it.
    """
    plane = np.full(len(sweeps), UNKNOWN, np.int32)
    source = sweeps.device.astype(np.int64) * (POLYNOMIAL_COUNT + 1) + sweeps.channel
    for code in np.unique(source):
        index = np.flatnonzero(source == code)
        slots = np.unique(slot[index])
        if len(slots) != 2 or slots[0] == UNKNOWN:
            continue
        is_second_slot = slot[index] == slots[1]
        to_other = _differences_to_other_slot(
            sweeps.count[index], sweeps.time_ns[index], is_second_slot
        )
        is_compared = np.isfinite(to_other).any(axis=1)
        with np.errstate(invalid="ignore"):
            is_first = is_compared & ~np.any(to_other <= 0, axis=1)
            is_second = is_compared & ~np.any(to_other >= 0, axis=1)
        found = np.where(is_first, 0, np.where(is_second, 1, UNKNOWN))
        for of_slot in (is_second_slot, ~is_second_slot):
            compared = found[of_slot & (found != UNKNOWN)]
            fraction = float(np.mean(compared)) if len(compared) >= MIN_SLOT_SWEEPS else 0.5
            if max(fraction, 1 - fraction) >= MIN_SLOT_FRACTION:
                found[of_slot & (found == UNKNOWN)] = round(fraction)
        plane[index] = found
    return plane


def _differences_to_other_slot(
    count: Array, time_ns: NDArray[np.int64], slot: NDArray[np.bool_]
) -> Array:
    """Return the counts (m, 2) of the sweeps before and after in the other slot, minus ``count``.

    ``nan`` without such a sweep within :data:`MAX_NEIGHBOUR_NS`.
    """
    differences = np.full((len(count), 2), np.nan)
    for of_slot in (slot, ~slot):
        rows, others = np.flatnonzero(of_slot), np.flatnonzero(~of_slot)
        following = np.searchsorted(others, rows)
        for side, neighbour in enumerate((following - 1, following)):
            other = others[np.clip(neighbour, 0, len(others) - 1)]
            is_near = (neighbour >= 0) & (neighbour < len(others))
            is_near &= np.abs(time_ns[other] - time_ns[rows]) <= MAX_NEIGHBOUR_NS
            differences[rows[is_near], side] = (count[other] - count[rows])[is_near]
    return differences
