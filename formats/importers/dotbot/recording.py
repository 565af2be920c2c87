"""Lighthouse V2 recordings as published by the DotBot group (CSV), imported as sweeps.

Published with Alvarado-Marin et al., "Lighthouse Localization of Miniature Wireless Robots" (RA-L
2024), and later papers: github.com/DotBots/alvarado23lighthouse (BSD-3), alvarado24lh-distortion,
alvarado24automatic. :mod:`.count_rows` lists the layouts of their tables, :mod:`.floor_square`
reads the files that define the frame of the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError, MissingDataError
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.dotbot.count_rows import (
    CountRows,
    detect_layout,
    find_new_counts,
    find_planes,
    merge_rows,
    read_rows,
    rename_columns,
    set_robot_times,
    sort_and_deduplicate,
)
from locatk.formats.importers.dotbot.floor_square import (
    estimate_markers,
    find_calibration,
    read_calibration,
    read_tracks,
)
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.tables.delimited import read_table

GRID_FRAME = "grid"
"""Frame of truth in the columns of a recording."""


def read_dotbot(
    paths: Sequence[Path], truth: Sequence[Path] = (), *, calibration: Path | None = None
) -> ImportedSession:
    """Read recordings of one layout as one session.

    Parameters
    ----------
    paths : sequence of path
        CSV files of one layout; their rows are merged in order of time.
    truth : sequence of path
        Pixel tracks of a camera (``*_blender.csv``).
    calibration : path, optional
        ``calibration.json`` with the floor square. [default: the one in the folder of the truth,
        of the recordings, or in ``../ground_truth``, if any]

    Raises
    ------
    MissingDataError
        A file is missing, or there are pixel tracks without a calibration.
    FormatError
        A file is empty, is not UTF-8, or has an unknown layout.
    InputError
        A cell is not a number or time, a count is negative, a polynomial is unknown, or layouts
        differ. The message names file and line.
    """
    if not paths:
        raise MissingDataError("no recording to import")
    warnings: list[str] = []
    tables = [rename_columns(read_table(Path(path))) for path in paths]
    layouts = [detect_layout(table) for table in tables]
    for table, layout in zip(tables, layouts, strict=True):
        if layout != layouts[0]:
            raise InputError(
                f"layout {layout!r}, but {tables[0].file} has {layouts[0]!r}",
                file=table.file,
                where=1,
                hint="Import files of different layouts into separate sessions",
            )
    parts = [read_rows(table, layouts[0]) for table in tables]
    rows = sort_and_deduplicate(merge_rows(parts), warnings)
    is_new, offset_us = find_new_counts(rows)
    rows = set_robot_times(rows, warnings)
    sweeps = _sweeps(rows, is_new, offset_us)
    rows_per_device = np.bincount(rows.device, minlength=len(rows.devices)).tolist()
    is_assumed = bool(np.all(rows.polynomial == UNKNOWN))
    facts = {
        "format": "dotbot-lh2",
        "layout": layouts[0],
        "files": ", ".join(table.file.name for table in tables),
        "rows": str(len(rows)),
        "sweeps": str(len(sweeps)),
        "devices": ", ".join(
            f"{name} ({n} rows)" for name, n in zip(rows.devices, rows_per_device, strict=True)
        ),
        "channels": ", ".join(str(channel) for channel in np.unique(rows.channel))
        + (" (assumed)" if is_assumed else " (from polynomials)"),
        "clock": "time stamps are in UTC; all counts of a row share one"
        if rows.tick is None
        else "clocks of the robots (db_time), fitted to the time stamps (UTC)",
    }
    if not np.all(is_new):
        facts["repeated"] = (
            f"{np.count_nonzero(~is_new)} counts are repeated from earlier rows and left out: "
            "db_time is the time of one sweep"
        )
    trajectories = _truth_columns(rows)
    if trajectories:
        facts["truth"] = f"{sum(map(len, trajectories))} poses from the columns real_*_mm"
        if truth:
            raise InputError(
                "the recording has truth in its own columns",
                file=tables[0].file,
                hint="Import it without --truth",
            )

    scene = None
    calibration_file = find_calibration(calibration, truth, paths)
    if truth and calibration_file is None:
        raise MissingDataError(
            "no calibration.json for the pixel tracks",
            hint=f"Give --calibration, or put it into {Path(truth[0]).parent}",
        )
    if calibration_file is not None:
        span_ns = (int(rows.time_ns.min()), int(rows.time_ns.max()))
        square = read_calibration(calibration_file, [Path(path) for path in paths], span_ns)
        unused = f"; not used: {square.unused}" if square.unused else ""
        facts["calibration"] = f"{calibration_file} ({square.axes}{unused})"
        scene = estimate_markers(square, rows, facts, warnings)
        if truth:
            files = [Path(path) for path in truth]
            trajectories = read_tracks(files, square, rows.devices, facts, warnings)
    return ImportedSession(sweeps, scene, trajectories, facts, warnings)


def _sweeps(rows: CountRows, is_new: NDArray[np.bool_], offset_us: NDArray[np.float64]) -> Sweeps:
    """Return each new count of each row as a sweep."""
    n, k = rows.count.shape
    sweeps = Sweeps(
        devices=rows.devices,
        time_ns=(rows.time_ns[:, None] + np.rint(1e3 * offset_us).astype(np.int64)).ravel(),
        device=np.repeat(rows.device, k),
        sensor=np.zeros(n * k, np.int32),
        channel=rows.channel.ravel(),
        polynomial=rows.polynomial.ravel(),
        sweep=np.full(n * k, UNKNOWN, np.int32),
        count=rows.count.ravel(),
    )
    # Columns that repeat sweeps are the slots of the robot; those of complete reports are not.
    slot = rows.slot if k == 1 else None if np.all(is_new) else np.tile(np.arange(k), n)
    order = np.flatnonzero(is_new.ravel())
    order = order[np.argsort(sweeps.time_ns[order], kind="stable")]
    sweeps = sweeps.take(order)
    return sweeps if slot is None else replace(sweeps, sweep=find_planes(sweeps, slot[order]))


def _truth_columns(rows: CountRows) -> list[Trajectory]:
    """Return the truth in the columns of the recording, in the frame of its grid."""
    if rows.truth_m is None:
        return []
    trajectories = []
    for index, name in enumerate(rows.devices):
        of_device = np.flatnonzero(rows.device == index)
        # Rows of several stations can share a time stamp.
        time_ns, first = np.unique(rows.time_ns[of_device], return_index=True)
        position_m = rows.truth_m[of_device[first]]
        trajectories.append(Trajectory.from_positions(name, GRID_FRAME, time_ns, position_m))
    return trajectories
