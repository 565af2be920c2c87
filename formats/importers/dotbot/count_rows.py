"""Tables of LFSR counts as published by the DotBot group (CSV).

The header determines the layout:

===================  =====================================================  ===========
layout               columns of counts                                      station
===================  =====================================================  ===========
one-station          ``c0, c1``                                             channel 1
two-station          ``LHA_count_1, LHA_count_2, LHB_count_1, LHB_count_2`` 1 and 2
two-station-labels   ``lha_poly_0, lha_count_0, ... lhb_poly_1, ...``       polynomials
station-per-row      ``poly_0, lfsr_index_0, poly_1, lfsr_index_1``         polynomials
===================  =====================================================  ===========

The first two do not contain polynomials: their channels are those that the authors' own code
assumes. Optional columns ``poly_0, poly_1`` or ``LHA_poly_1, ...`` determine the channel instead.
``timestamp`` is required, in UTC. ``source`` names the device; without it there is one, called
``robot``. ``real_x_mm, real_y_mm, real_z_mm`` are truth. The two counts of a pair are in any
order, so that no sweep is labelled first or second.

All counts of a row share its time stamp. Counts beyond the period of a channel are kept: the
solver rejects and counts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT, channel_of
from locatk.core.lighthouse.lfsr import SEQUENCE_LENGTH
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.tables.delimited import Table

Array = NDArray[np.float64]

DEFAULT_DEVICE = "robot"
"""Name of the device in files without a column ``source``."""

TIME_COLUMN = "timestamp"
TRUTH_COLUMNS = ("real_x_mm", "real_y_mm", "real_z_mm")
PLANE_COLUMNS = ("x", "y")

MILLIMETRES_PER_METRE = 1000

MAX_TRUTH_MM = 1e6
"""Largest coordinate of the truth, 1 km: larger ones are damaged or in another unit."""


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
    """

    devices: tuple[str, ...]
    time_ns: NDArray[np.int64]
    device: NDArray[np.int32]
    count: Array
    channel: NDArray[np.int32]
    polynomial: NDArray[np.int32]
    truth_m: Array | None
    plane: Array | None

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
        )


def detect_layout(table: Table) -> str:
    """Return the name of the layout (:data:`LAYOUTS`) of a table by its header.

    Raises
    ------
    FormatError
        The header belongs to no layout; the message lists the columns that the nearest one lacks.
    """
    present = set(table.columns)
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
        "LHB_count_1, LHB_count_2; or poly_0, lfsr_index_0, poly_1, lfsr_index_1",
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
    return CountRows(
        devices,
        table.iso_times_ns(TIME_COLUMN),
        np.array([index[name] for name in sources], np.int32),
        np.stack(count, axis=1),
        np.stack(channel, axis=1).astype(np.int32),
        np.stack(polynomial, axis=1).astype(np.int32),
        truth_m,
        plane,
    )


def merge_rows(parts: Sequence[CountRows]) -> CountRows:
    """Concatenate rows of several files, with common device numbers."""
    devices = tuple(dict.fromkeys(name for part in parts for name in part.devices))
    if len(parts) == 1:
        return parts[0]

    def concatenated(arrays: list[Array | None]) -> Array | None:
        present = [array for array in arrays if array is not None]
        return np.concatenate(present) if len(present) == len(arrays) else None

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
    )


def sort_and_deduplicate(rows: CountRows, warnings: list[str]) -> CountRows:
    """Return the rows in order of time, one for each device, time and set of channels."""
    by_device = np.argsort(rows.device, kind="stable")
    steps_ns = np.diff(rows.time_ns[by_device])
    same_device = np.diff(rows.device[by_device]) == 0
    backwards = int(np.count_nonzero((steps_ns < 0) & same_device))
    if backwards:
        warnings.append(f"time stamps went backwards {backwards} times: rows were sorted")

    order = np.lexsort((*rows.channel.T, rows.time_ns, rows.device))
    key = np.column_stack([rows.device, rows.time_ns, rows.channel])[order]
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
