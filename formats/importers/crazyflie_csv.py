"""Log variables of a Crazyflie in CSV files, imported as a session.

cfclient writes one file for each log block: ``Timestamp,acc.x,acc.y,...`` with integer milliseconds
since the Crazyflie was switched on, a number of 24 bits. Programs with cflib write what their
authors chose: names in any spelling (``stateEstimate_x``), seconds or milliseconds, a column for
each variable, or rows of time, name and value. Files of one flight are joined by their times.

Angles of Lighthouse stations (``lighthouse.rawAngle0xlh2`` and others) are those of photodiode 0
under the stations of channels 1 and 2. They are sampled: some are logged twice and others never,
and their times are those of the samples, up to 30 ms after the light.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.crazyflie_usd.recording import (
    DECK_NAME,
    DEVICE,
    read_mounted_receiver,
    read_scene,
)
from locatk.formats.importers.crazyflie_usd.variables import (
    USED_VARIABLES,
    LogBlock,
    list_names,
    read_device_data,
)
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.tables.delimited import Table, read_table
from locatk.formats.tables.quantities import UNITS, split_unit
from locatk.formats.tables.timestamps import UNDATED_START_NS, is_iso_time

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ANGLES = {
    f"lighthouse.rawangle{station}{axis}lh2": (station, plane)
    for station in (0, 1)
    for plane, axis in enumerate("xy")
}
"""Variables with rotor angles of photodiode 0: station from 0, and light plane."""

TIME_NAMES = ("t", "time", "times", "timestamp", "timestamps", "tick", "ticks", "ms", "hosttime")
VARIABLE_NAMES = ("name", "variable", "var", "key", "signal")
VALUE_NAMES = ("value", "val", "data")
"""Names of columns, in lower case without separators."""

TICK_BITS = 24
"""Width of the time stamp of a log packet, which counts milliseconds (crazyflie-firmware
``log.c``). It wraps after 4 h 39 min 37 s."""

MAX_STEP_NS = 2_550_000_000
"""Longest period of a log block (crazyflie-firmware ``log.c``); the shortest is 10 ms."""

LARGE_STEP_QUANTILE = 0.95
"""Quantile of the steps of time by which the unit of times is found. If one file has several
blocks, sampled at different times, most steps are shorter than the period of a block."""

MAX_VALUE = 1e10
"""Largest value of a variable; a packed quaternion is less than 2^32."""

MAX_BACK_STEP_NS = 1_000_000_000
"""Largest step back of the times of packets; a larger one is a restart of the Crazyflie."""

FIRST_DATE_NS, LAST_DATE_NS = 1_000_000_000_000_000_000, 4_000_000_000_000_000_000
"""Times that are taken for dates, from 2001 to 2096. Others count from an unknown start."""


@dataclass(frozen=True)
class _LogFile:
    """Samples of a file: times, and values by name of the variable; ``nan`` if missing."""

    path: Path
    time_ns: IntArray
    series: dict[str, Array]
    unused: tuple[str, ...]
    omitted: int


def read_crazyflie_csv(
    paths: Sequence[Path],
    *,
    config: Path | None = None,
    stations: bool = False,
    receiver: str = DECK_NAME,
    mounting: Sequence[float] = (),
    device: str = DEVICE,
) -> ImportedSession:
    """Import the files of one flight as a session.

    Parameters
    ----------
    paths : sequence of path
        Files of log blocks.
    config, stations, receiver, mounting, device
        As in :func:`.crazyflie_usd.recording.read_crazyflie_usd`.

    Raises
    ------
    MissingDataError, FormatError
        A file is missing, or not a table with times.
    InputError
        A cell is no number, no file has a variable that can be used, or the files are of different
        times.
    ArtifactError
        The configuration or the receiver is invalid.
    """
    files = [_read_file(Path(path)) for path in paths]
    names = {name for each in files for name in each.series}
    if not names:
        unused = {name for each in files for name in each.unused}
        raise InputError(
            "no log variable that can be used",
            file=paths[0],
            hint="Log acc.x/y/z, gyro.x/y/z, stateEstimate.x/y/z with its quaternion or angles, or "
            f"lighthouse.rawAngle0xlh2; the files have {list_names(unused)}",
        )
    _align_wraps(files)
    _check_overlap(files)
    start_ns = min(int(each.time_ns.min()) for each in files)
    is_dated = start_ns >= FIRST_DATE_NS
    shift_ns = 0 if is_dated else UNDATED_START_NS - start_ns
    data = read_device_data([(each.time_ns + shift_ns, each.series) for each in files], device)
    sweeps, dropped = _sweeps(data.blocks, device)
    scene, warnings = read_scene(config, stations)
    if not len(sweeps):
        warnings.append("no angles of Lighthouse stations: the session cannot be solved")
    warnings += data.warnings
    omitted = sum(each.omitted for each in files)
    facts = {
        "format": "crazyflie-csv",
        "files": ", ".join(each.path.name for each in files),
        "clock": "dates of the files" if is_dated else "since the first sample",
        "variables": list_names(names, len(names)),
    }
    if unused := {name for each in files for name in each.unused}:
        facts["not_used"] = list_names(unused, len(unused))
    if len(sweeps):
        facts["sweeps"] = f"{len(sweeps)}, with the times of samples; {dropped} samples repeat one"
    return ImportedSession(
        sweeps,
        scene,
        [],
        facts,
        warnings,
        receivers={device: read_mounted_receiver(receiver, mounting)} if len(sweeps) else {},
        lost=f"{omitted} rows are left out: the Crazyflie was restarted, and the longer part is "
        "imported"
        if omitted
        else None,
        imu=data.imu,
        onboard=data.onboard,
    )


def read_estimate(path: Path) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Return the poses that a Crazyflie estimated itself; there are no notes.

    Raises
    ------
    LocatkError
        As :func:`read_crazyflie_csv`.
    """
    return list(read_crazyflie_csv([path]).onboard), ()


def _canonical(name: str) -> str:
    """Return a name in lower case without separators."""
    return re.sub("[^a-z0-9]", "", name.lower())


_KNOWN = {_canonical(name): name for name in (*USED_VARIABLES, *ANGLES)}


def _read_file(path: Path) -> _LogFile:
    table = read_table(path)
    time_name = _find_column(table, TIME_NAMES)
    if time_name is None:
        raise FormatError(
            "a column of times is missing",
            file=path,
            where=1,
            hint="Name one Timestamp; the header has " + list_names(table.columns),
        )
    time_ns = _times_ns(table, time_name)
    time_ns, kept = _longest_run(time_ns)
    variable_name, value_name = (_find_column(table, n) for n in (VARIABLE_NAMES, VALUE_NAMES))
    if variable_name is not None and value_name is not None:
        series, unused = _long_series(table, variable_name, value_name)
    else:
        series, unused = _wide_series(table, time_name)
    return _LogFile(
        path,
        time_ns,
        {name: values[kept] for name, values in series.items()},
        unused,
        len(table) - len(time_ns),
    )


def _find_column(table: Table, names: Sequence[str]) -> str | None:
    """Return the first column with one of the names, with or without a unit."""
    for header in table.columns:
        if _canonical(header) in names or _canonical(split_unit(header)[0]) in names:
            return header
    return None


def _wide_series(table: Table, time_name: str) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Return the variables of a table with a column for each, and the names of other columns."""
    series: dict[str, Array] = {}
    unused = []
    for header in table.columns:
        name = _KNOWN.get(_canonical(header))
        if name is None or name in series:
            unused += [header] if header and header != time_name else []
            continue
        series[name] = table.floats(header, -MAX_VALUE, MAX_VALUE, allow_missing=True)
    return series, tuple(unused)


def _long_series(
    table: Table, variable_name: str, value_name: str
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Return the variables of a table with a row for each value."""
    cells = np.array([_canonical(cell) for cell in table.columns[variable_name]])
    is_known = np.isin(cells, list(_KNOWN))
    # Values of other variables may be texts.
    wanted = Table(
        table.file,
        {
            value_name: [
                cell if known else "nan"
                for cell, known in zip(table.columns[value_name], is_known, strict=True)
            ]
        },
        table.lines,
    )
    values = wanted.floats(value_name, -MAX_VALUE, MAX_VALUE, allow_missing=True)
    names, number = np.unique(cells, return_inverse=True)
    series = {
        _KNOWN[name]: np.where(number == k, values, np.nan)
        for k, name in enumerate(names.tolist())
        if name in _KNOWN
    }
    others = [str(cell) for cell in table.columns[variable_name]]
    unused = {name for name, known in zip(others, is_known, strict=True) if not known}
    return series, tuple(sorted(unused))


def _times_ns(table: Table, name: str) -> IntArray:
    """Return the times of the rows; those of a counter of 24 bits continue over its wraps."""
    if is_iso_time(table.columns[name][0]):
        return table.iso_times_ns(name)
    numbers = table.floats(name, -1e18, 1e19)
    bare, unit = split_unit(name)
    if unit not in UNITS["time"]:
        unit = "ms" if _canonical(bare) in ("ms", "tick", "ticks") else _infer_unit(numbers)
    if unit == "ms":
        size = 1 << TICK_BITS
        is_wrap = np.diff(numbers, prepend=numbers[:1]) < -size / 2
        if np.max(numbers) < size:
            numbers = numbers + size * np.cumsum(is_wrap)
    time_ns = np.rint(numbers * UNITS["time"][unit])
    if np.any(np.abs(time_ns) >= 2**62):
        raise FormatError(f"times in column {name!r} are impossible", file=table.file, where=1)
    return time_ns.astype(np.int64)


def _infer_unit(numbers: Array) -> str:
    """Return the unit in which times are dates, or else the largest one with possible steps."""
    steps = np.diff(np.unique(numbers))
    step = float(np.quantile(steps, LARGE_STEP_QUANTILE, method="lower")) if len(steps) else 0.0
    possible = [unit for unit, size_ns in UNITS["time"].items() if step * size_ns <= MAX_STEP_NS]
    first = float(numbers.min())
    dates = [
        unit for unit in possible if FIRST_DATE_NS <= first * UNITS["time"][unit] < LAST_DATE_NS
    ]
    return (dates or possible or ["ns"])[0]


def _longest_run(time_ns: IntArray) -> tuple[IntArray, slice]:
    """Return the longest part of the times without a restart, and its rows."""
    restarts = np.flatnonzero(np.diff(time_ns) < -MAX_BACK_STEP_NS) + 1
    edges = [0, *restarts.tolist(), len(time_ns)]
    start, stop = max(pairwise(edges), key=lambda part: part[1] - part[0])
    return time_ns[start:stop], slice(start, stop)


def _align_wraps(files: Sequence[_LogFile]) -> None:
    """Shift the files that begin after a wrap of the counter, at which another one is already."""
    wrap_ns = (1 << TICK_BITS) * 1_000_000
    last = max(int(each.time_ns[0]) for each in files)
    if last >= wrap_ns:
        return
    for each in files:
        if last - int(each.time_ns[0]) > wrap_ns // 2:
            each.time_ns[:] += wrap_ns


def _check_overlap(files: Sequence[_LogFile]) -> None:
    """Refuse files that have no time in common with the others."""
    for each in files:
        others = [other for other in files if other is not each]
        if others and not any(
            other.time_ns.min() <= each.time_ns.max() and each.time_ns.min() <= other.time_ns.max()
            for other in others
        ):
            raise InputError(
                "it has no time in common with the other files",
                file=each.path,
                hint="Import the files of each flight into a session of its own",
            )


def _sweeps(blocks: Sequence[LogBlock], device: str) -> tuple[Sweeps, int]:
    """Return the logged rotor angles, and the number of samples that repeat one.

    Of an angle in several blocks, the one with the most samples is used.
    """
    parts: list[tuple[IntArray, IntArray, IntArray, Array]] = []
    repeated = 0
    for name, (station, plane) in ANGLES.items():
        owners = [block for block in blocks if name in block.columns]
        if not owners:
            continue
        block = max(owners, key=lambda block: len(block.time_ns))
        is_logged = np.isfinite(block.columns[name])
        angle = block.columns[name][is_logged]
        turns = (angle - ROTOR_ZERO_RAD[plane]) / (2 * np.pi)
        is_new = np.diff(angle, prepend=np.nan) != 0
        # The firmware's angles are 0 until the first light.
        is_angle = (turns >= 0) & (turns < 1) & (angle != 0)
        repeated += int(np.count_nonzero(is_angle & ~is_new))
        rows = np.flatnonzero(is_angle & is_new)
        counts = turns[rows] * period_counts(station + 1)
        labels = (np.full(len(rows), station + 1), np.full(len(rows), plane))
        parts.append((block.time_ns[is_logged][rows], *labels, counts))
    if not parts:
        parts = [(np.zeros(0, np.int64), np.zeros(0, int), np.zeros(0, int), np.zeros(0))]
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    time_ns, channel, plane_of, count = columns
    order = np.argsort(time_ns, kind="stable")
    zeros = np.zeros(len(order), np.int32)
    return (
        Sweeps(
            (device,),
            time_ns[order],
            zeros,
            zeros.copy(),
            channel[order].astype(np.int32),
            np.full(len(order), UNKNOWN, np.int32),
            plane_of[order].astype(np.int32),
            count[order],
        ),
        repeated,
    )
