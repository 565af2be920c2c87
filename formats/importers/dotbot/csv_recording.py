"""The DotBot group's Lighthouse V2 recordings (CSV), read into sweeps.

Published with "Lighthouse Localization of Miniature Wireless Robots" and the papers after
it: github.com/DotBots/alvarado23lighthouse (BSD-3), alvarado24lh-distortion,
alvarado24automatic. A layout is recognised by its header:

===================  =====================================================  ===========
layout               columns of counts                                      station
===================  =====================================================  ===========
one-station          ``c0, c1``                                             channel 1
two-station          ``LHA_count_1, LHA_count_2, LHB_count_1, LHB_count_2`` 1 and 2
two-station-labels   ``lha_poly_0, lha_count_0, ... lhb_poly_1, ...``       polynomials
station-per-row      ``poly_0, lfsr_index_0, poly_1, lfsr_index_1``         polynomials
===================  =====================================================  ===========

The first two name no polynomial: their channels are those that the authors' own code
assumes. Where they have columns ``poly_0, poly_1`` or ``LHA_poly_1, ...`` those tell the
channel. ``timestamp`` is required, in UTC, said or not. ``source`` names the device; without
it there is one, called ``robot``. ``real_x_mm, real_y_mm, real_z_mm`` are truth. The two
counts of a pair come in any order, so that no sweep is labelled first or second.

All counts of a row share its time stamp. Counts above the period of a channel are kept:
the solver rejects and counts them. What fixes the floor's frame (``calibration.json``,
pixel tracks) is read by :mod:`locatk.formats.importers.dotbot.reference`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT, channel_of
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.dotbot import reference as floor
from locatk.formats.importers.lighthouse import ImportedSession
from locatk.formats.tables.csv_table import Table, read_table

DEVICE = "robot"
"""Name of the device in files without a column ``source``."""

TRUTH_COLUMNS = ("real_x_mm", "real_y_mm", "real_z_mm")


@dataclass(frozen=True)
class _Slot:
    """One sweep of a row: its column, and what tells its station."""

    count: str
    polynomial: str
    channel: int | None  # None: the polynomial column is required


_LAYOUTS = {
    "one-station": (_Slot("c0", "poly_0", 1), _Slot("c1", "poly_1", 1)),
    "two-station": (
        _Slot("lha_count_1", "lha_poly_1", 1),
        _Slot("lha_count_2", "lha_poly_2", 1),
        _Slot("lhb_count_1", "lhb_poly_1", 2),
        _Slot("lhb_count_2", "lhb_poly_2", 2),
    ),
    "two-station-labels": (
        _Slot("lha_count_0", "lha_poly_0", None),
        _Slot("lha_count_1", "lha_poly_1", None),
        _Slot("lhb_count_0", "lhb_poly_0", None),
        _Slot("lhb_count_1", "lhb_poly_1", None),
    ),
    "station-per-row": (
        _Slot("lfsr_index_0", "poly_0", None),
        _Slot("lfsr_index_1", "poly_1", None),
    ),
}


def read_dotbot(
    paths: Sequence[Path], truth: Sequence[Path] = (), *, calibration: Path | None = None
) -> ImportedSession:
    """Read recordings of one layout as one session.

    Parameters
    ----------
    paths : sequence of path
        CSV files of one layout (see the module); rows are merged in order of time.
    truth : sequence of path
        Pixel tracks of a camera (``*_blender.csv``).
    calibration : path, optional
        ``calibration.json``: the floor square. Without it the one beside the truth files,
        beside the recordings or in ``../ground_truth`` is used, if there is one.

    Raises
    ------
    MissingDataError
        A file is not there; pixel tracks without calibration.
    FormatError
        A file is empty, no UTF-8, or of no known layout.
    InputError
        A cell that is no number or time, a negative count, an unknown polynomial, files of
        different layouts. The message names file and line.
    """
    if not paths:
        raise MissingDataError("no recording to import")
    warnings: list[str] = []
    tables = [read_table(Path(path)) for path in paths]
    layouts = [_layout(table) for table in tables]
    for table, layout in zip(tables, layouts, strict=True):
        if layout != layouts[0]:
            raise InputError(
                f"layout {layout!r}, where {tables[0].file} has {layouts[0]!r}",
                file=table.file,
                where=1,
                hint="import files of different layouts into sessions of their own",
            )
    read = [_rows(table, _LAYOUTS[layouts[0]]) for table in tables]
    names = tuple(dict.fromkeys(name for rows in read for name in rows.devices))
    rows = _clean(_merge(read, names), warnings)
    sweeps = _sweeps(rows)

    facts = {
        "format": "dotbot-lh2",
        "layout": layouts[0],
        "files": ", ".join(table.file.name for table in tables),
        "rows": str(len(rows)),
        "sweeps": str(len(sweeps)),
        "devices": ", ".join(
            f"{name} ({n} rows)"
            for name, n in zip(names, np.bincount(rows.device, minlength=len(names)), strict=True)
        ),
        "channels": ", ".join(str(c) for c in np.unique(rows.channel))
        + (" (assumed)" if np.all(rows.polynomial == UNKNOWN) else " (from polynomials)"),
        "clock": "time stamps are taken as UTC; all counts of a row share one",
    }
    truths = _truth_of_columns(rows)
    if truths:
        facts["truth"] = f"{sum(map(len, truths))} poses from the columns real_*_mm"
        if truth:
            raise InputError(
                "the recording has truth in its own columns",
                file=tables[0].file,
                hint="import it without --truth",
            )

    scene = None
    found = floor.find_calibration(calibration, truth, paths)
    if truth and found is None:
        raise MissingDataError(
            "no calibration.json for the pixel tracks",
            hint=f"give --calibration, or put it into {Path(truth[0]).parent}",
        )
    if found is not None:
        square = floor.read_calibration(found)
        facts["calibration"] = f"{found} ({square.axes})"
        scene = floor.scene_of(square, rows, facts, warnings)
        if truth:
            truths = floor.read_tracks([Path(t) for t in truth], square, names, facts, warnings)
    return ImportedSession(sweeps, scene, truths, facts, warnings)


def _layout(table: Table) -> str:
    """Name of the layout that the header shows."""
    have = set(table.columns)
    found, missing = "", list(have)
    for name, slots in _LAYOUTS.items():
        needed = {"timestamp", *(slot.count for slot in slots)}
        needed |= {slot.polynomial for slot in slots if slot.channel is None}
        absent = sorted(needed - have)
        if not absent:
            return name
        if len(absent) < len(needed) - ("timestamp" in have) and (
            not found or len(absent) < len(missing)
        ):
            found, missing = name, absent
    if found:
        raise FormatError(
            f"missing column {', '.join(map(repr, missing))} (layout {found!r})",
            file=table.file,
            where=1,
            hint="export the table with all of its columns",
        )
    raise FormatError(
        "no table of a known DotBot layout",
        file=table.file,
        where=1,
        hint="its header should have timestamp and c0, c1; or LHA_count_1, LHA_count_2, "
        "LHB_count_1, LHB_count_2; or poly_0, lfsr_index_0, poly_1, lfsr_index_1",
    )


def _rows(table: Table, slots: tuple[_Slot, ...]) -> floor.Rows:
    """Columns of one file as arrays."""
    n = len(table)
    sources = [name.strip() for name in table.columns.get("source", [DEVICE] * n)]
    if "" in sources:
        table.fail(sources.index(""), "empty cell in column 'source'", "name the device")
    devices = tuple(dict.fromkeys(sources))
    number = {name: i for i, name in enumerate(devices)}
    count, channel, polynomial = [], [], []
    for slot in slots:
        count.append(table.floats(slot.count, low=0))
        if slot.polynomial in table.columns:
            polynomial.append(table.integers(slot.polynomial, 0, POLYNOMIAL_COUNT - 1))
            channel.append(channel_of(polynomial[-1]))
        else:
            polynomial.append(np.full(n, UNKNOWN))
            channel.append(np.full(n, slot.channel))
    truth = None
    if any(name in table.columns for name in TRUTH_COLUMNS):
        table.require(*TRUTH_COLUMNS)
        truth = np.stack([table.floats(name) for name in TRUTH_COLUMNS], axis=1) / 1000
    plane = None
    if "x" in table.columns and "y" in table.columns:
        plane = np.stack([table.floats("x"), table.floats("y")], axis=1)
    return floor.Rows(
        devices,
        table.times_ns(),
        np.array([number[name] for name in sources], np.int32),
        np.stack(count, axis=1),
        np.stack(channel, axis=1).astype(np.int32),
        np.stack(polynomial, axis=1).astype(np.int32),
        truth,
        plane,
    )


def _merge(read: list[floor.Rows], names: tuple[str, ...]) -> floor.Rows:
    """Rows of all files, one after the other, with common device numbers."""
    if len(read) == 1:
        return read[0]

    def joined(parts: list[NDArray[np.float64] | None]) -> NDArray[np.float64] | None:
        known = [part for part in parts if part is not None]
        return np.concatenate(known) if len(known) == len(parts) else None

    return floor.Rows(
        names,
        np.concatenate([r.time_ns for r in read]),
        np.concatenate(
            [np.array([names.index(d) for d in r.devices], np.int32)[r.device] for r in read]
        ),
        np.concatenate([r.count for r in read]),
        np.concatenate([r.channel for r in read]),
        np.concatenate([r.polynomial for r in read]),
        joined([r.truth for r in read]),
        joined([r.plane for r in read]),
    )


def _clean(rows: floor.Rows, warnings: list[str]) -> floor.Rows:
    """Rows in order of time, one a device, time and set of channels."""
    by_device = np.argsort(rows.device, kind="stable")
    steps = np.diff(rows.time_ns[by_device])
    same_device = np.diff(rows.device[by_device]) == 0
    backwards = int(np.count_nonzero((steps < 0) & same_device))
    if backwards:
        warnings.append(f"time stamps went backwards {backwards} times: rows were sorted")

    order = np.lexsort((*rows.channel.T, rows.time_ns, rows.device))
    key = np.column_stack([rows.device, rows.time_ns, rows.channel])[order]
    first = np.r_[True, np.any(key[1:] != key[:-1], axis=1)]
    leader = order[np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))]
    repeats = ~first
    same = np.all(rows.count[order] == rows.count[leader], axis=1)
    copies, clashes = int((repeats & same).sum()), int((repeats & ~same).sum())
    if copies:
        warnings.append(f"{copies} rows repeat another row exactly: dropped")
    if clashes:
        warnings.append(
            f"{clashes} rows repeat the time stamp of another row of their device with other "
            "counts: the first was kept"
        )
    kept = order[first]
    return rows.take(kept[np.argsort(rows.time_ns[kept], kind="stable")])


def _sweeps(rows: floor.Rows) -> Sweeps:
    """Each count of each row as a sweep."""
    n, k = rows.count.shape
    return Sweeps(
        devices=rows.devices,
        time_ns=np.repeat(rows.time_ns, k),
        device=np.repeat(rows.device, k),
        sensor=np.zeros(n * k, np.int32),
        channel=rows.channel.ravel(),
        polynomial=rows.polynomial.ravel(),
        sweep=np.full(n * k, UNKNOWN, np.int32),
        count=rows.count.ravel(),
    )


def _truth_of_columns(rows: floor.Rows) -> list[Trajectory]:
    """Truth that stands in the recording itself, in the grid's own frame."""
    if rows.truth is None:
        return []
    truths = []
    for i, name in enumerate(rows.devices):
        mine = rows.take(np.flatnonzero(rows.device == i))
        # Rows of several stations may share a time stamp.
        time, at = np.unique(mine.time_ns, return_index=True)
        position = mine.truth
        assert position is not None
        truths.append(Trajectory.from_positions(name, "grid", time, position[at]))
    return truths
