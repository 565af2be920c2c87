"""Trajectories of rigid bodies as exported by motion capture systems.

========  ==========================================================================================
Motive    OptiTrack's CSV: columns of type ``Rigid Body``, rotation as quaternion; y is up
Vicon     CSV of Tracker and Nexus: RX, RY, RZ as a rotation vector, or with RW as a quaternion
Qualisys  QTM's TSV of 6DOF data: rotation matrix, column by column, in mm
========  ==========================================================================================

Sources: OptiTrack documentation, "Data Export: CSV"; Vicon Tracker and Nexus documentation, "ASCII
file format"; Qualisys Track Manager manual, "TSV export, 6DOF data". Rows in which a body was not
tracked are left out. Times begin at 0 s: the clocks of the exports have no time zone.
"""

from __future__ import annotations

import csv
import io
import re
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.errors import FormatError
from locatk.core.trajectory import MAX_ODOMETRY, Trajectory
from locatk.formats.files import MAX_FILE_BYTES, read_text
from locatk.formats.importers.poses.trajectory_csv import unknown_covariance

Array = NDArray[np.float64]

FRAME = "mocap"

MIN_QUATERNION_NORM, MAX_QUATERNION_NORM = 0.9, 1.1
"""Norms of a quaternion that was tracked; others are of rows without the body."""

Z_UP = Rotation.from_euler("x", 90, degrees=True)
"""Rotation from axes with y up to axes with z up: (x, y, z) becomes (x, -z, y)."""

LENGTHS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "millimeters": 1e-3, "centimeters": 1e-2}
LENGTHS_M["meters"] = 1.0

Rows = list[list[str]]

CLOCK_NOTE = "times of {} begin at 0 s: use --offset auto"


def read_motive(path: Path) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read the rigid bodies of a CSV of Motive; returns notes on assumptions as well.

    Raises
    ------
    FormatError
        The header is incomplete, rotations are Euler angles, or no body was tracked.
    """
    rows = _rows(path, ",")
    facts = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    if facts.get("Rotation Type", "Quaternion") != "Quaternion":
        raise FormatError(
            f"rotations as {facts['Rotation Type']} angles",
            file=path,
            where=1,
            hint="Export with the rotation type Quaternion",
        )
    scale = LENGTHS_M.get(facts.get("Length Units", "Meters").lower())
    header = next((k for k, row in enumerate(rows[:12]) if row[0] == "Frame"), None)
    labels = {row[1]: row for row in rows[1:header] if len(row) > 1 and row[1]}
    if scale is None or header is None or not {"Type", "Name"} <= labels.keys():
        raise FormatError(
            "an incomplete header", file=path, hint="Export with its header, in meters"
        )
    axes = rows[header]
    columns: dict[str, dict[str, int]] = {}
    # Rows of the header may end before the last column, which has no name.
    for index, (body, name, kind, axis) in enumerate(
        zip_longest(labels["Type"], labels["Name"], rows[header - 1], axes, fillvalue="")
    ):
        if body == "Rigid Body" and kind in ("Rotation", "Position") and index < len(axes):
            columns.setdefault(name, {})[kind[0] + axis] = index
    data = _numbers(path, rows[header + 1 :], len(axes), header + 2)
    trajectories = []
    for name, own in columns.items():
        if not {"PX", "PY", "PZ", "RX", "RY", "RZ", "RW"} <= own.keys():
            continue
        position = data[:, [own["PX"], own["PY"], own["PZ"]]] * scale
        quaternion = data[:, [own["RX"], own["RY"], own["RZ"], own["RW"]]]
        is_tracked = _is_rotation(quaternion)
        rotation = Z_UP * Rotation.from_quat(quaternion[is_tracked]) * Z_UP.inv()
        trajectories.append(
            _trajectory(name, data[is_tracked, 1], Z_UP.apply(position[is_tracked]), rotation)
        )
    notes = (CLOCK_NOTE.format("Motive"), "Motive's y axis is up: it was made the z axis")
    return _require_tracks(path, trajectories), notes


def read_vicon(path: Path) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read the objects or segments of a CSV of Vicon; returns notes on assumptions as well.

    Raises
    ------
    FormatError
        The header is incomplete, a unit is unknown, or no body was tracked.
    """
    rows = _rows(path, ",")
    header = next((k for k, row in enumerate(rows) if row[:2] == ["Frame", "Sub Frame"]), 0)
    axes = rows[header]
    try:
        rate_hz = float(rows[header - 2][0])
    except (ValueError, IndexError):
        rate_hz = 0.0
    if header < 2 or not rate_hz > 0.0 or len(rows) < header + 3:
        raise FormatError("an incomplete header", file=path, hint="Export it with its header")
    names, units = rows[header - 1], rows[header + 1]
    end = next((k for k in range(header + 2, len(rows)) if not rows[k][0].isdigit()), len(rows))
    data = _numbers(path, rows[header + 2 : end], len(axes), header + 3)
    time_s = (data[:, 0] - data[0, 0]) / rate_hz
    trajectories = []
    for start in (k for k, axis in enumerate(axes) if axis == "RX"):
        has_quaternion = axes[start : start + 4] == ["RX", "RY", "RZ", "RW"]
        at = start + (4 if has_quaternion else 3)
        unit = units[at] if len(units) > at else ""
        if axes[at : at + 3] != ["TX", "TY", "TZ"] or unit not in LENGTHS_M:
            raise FormatError(
                f"no position in a known unit after column {start + 1}", file=path, where=header + 1
            )
        position, turn = data[:, at : at + 3] * LENGTHS_M[unit], data[:, start:at]
        is_tracked = np.isfinite(position).all(axis=1) & np.isfinite(turn).all(axis=1)
        is_tracked &= (position != 0.0).any(axis=1)
        if has_quaternion:
            is_tracked &= _is_rotation(turn)
            rotation = Rotation.from_quat(turn[is_tracked])
        else:
            scale = np.pi / 180 if units[start] == "deg" else 1.0
            rotation = Rotation.from_rotvec(scale * turn[is_tracked])
        name = names[start] if len(names) > start and names[start] else f"body-{start}"
        trajectories.append(_trajectory(name, time_s[is_tracked], position[is_tracked], rotation))
    notes = (CLOCK_NOTE.format("Vicon"),)
    return _require_tracks(path, trajectories), notes


def read_qualisys(path: Path) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read the bodies of a TSV of Qualisys Track Manager; returns notes on assumptions as well.

    Raises
    ------
    FormatError
        It has no 6DOF data, its header is incomplete, or no body was tracked.
    """
    rows = _rows(path, "\t")
    header = next((k for k, row in enumerate(rows[:40]) if "Rot[0]" in row), None)
    facts = {row[0]: row[1:] for row in rows[:header] if len(row) > 1}
    try:
        rate_hz = float(facts["FREQUENCY"][0])
    except (KeyError, ValueError):
        rate_hz = 0.0
    if header is None or not rate_hz > 0.0:
        raise FormatError(
            "no 6DOF data with its header",
            file=path,
            hint="Export 6D data as TSV, with the TSV header and the column header",
        )
    columns = rows[header]
    starts = [k - 7 for k, name in enumerate(columns) if name == "Rot[0]"]
    names = [name for name in facts.get("BODY_NAMES", []) if name]
    data = _numbers(path, rows[header + 1 :], len(columns), header + 2)
    time_s = np.arange(len(data)) / rate_hz
    trajectories = []
    for number, start in enumerate(starts):
        position, matrix = data[:, start : start + 3] * 1e-3, data[:, start + 7 : start + 16]
        matrix = matrix.reshape(-1, 3, 3).transpose(0, 2, 1)
        with np.errstate(invalid="ignore"):
            is_tracked = np.abs(np.linalg.det(np.nan_to_num(matrix)) - 1.0) < 0.1
            is_tracked &= (data[:, start + 6] >= 0.0) & np.isfinite(position).all(axis=1)
        name = names[number] if number < len(names) else f"body-{number + 1}"
        rotation = Rotation.from_matrix(matrix[is_tracked])
        trajectories.append(_trajectory(name, time_s[is_tracked], position[is_tracked], rotation))
    notes = (CLOCK_NOTE.format("Qualisys"),)
    return _require_tracks(path, trajectories), notes


def _rows(path: Path, separator: str) -> Rows:
    """Return the cells of all lines, without surrounding blanks; empty lines have one cell."""
    text = read_text(path, MAX_FILE_BYTES).removeprefix("\ufeff")
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        return [[cell.strip() for cell in row] or [""] for row in rows]
    except csv.Error as error:
        raise FormatError(f"broken text ({error})", file=path) from None


def _numbers(path: Path, rows: Rows, columns: int, first_line: int) -> Array:
    """Return the cells (n, columns) as numbers; ``nan`` for empty and absent cells."""
    data = np.full((len(rows), columns), np.nan)
    kept = 0
    for line, row in enumerate(rows, first_line):
        if not any(row):
            continue
        for column, cell in enumerate(row[:columns]):
            if cell:
                try:
                    data[kept, column] = float(cell)
                except ValueError:
                    raise FormatError(
                        f"{cell[:40]!r} instead of a number", file=path, where=line
                    ) from None
        kept += 1
    data = data[:kept]
    if not kept:
        raise FormatError("a header and no rows", file=path, hint="The take has no frames")
    return data


def _is_rotation(quaternion: Array) -> NDArray[np.bool_]:
    """Return which quaternions (n, 4) are complete and of about unit length."""
    norm = np.linalg.norm(quaternion, axis=1)  # nan if a component is absent
    return (norm > MIN_QUATERNION_NORM) & (norm < MAX_QUATERNION_NORM)


def _trajectory(name: str, time_s: Array, position_m: Array, rotation: Rotation) -> Trajectory:
    """Return the trajectory of a body."""
    return Trajectory(
        re.sub(r"\s+", " ", name),
        FRAME,
        np.rint(1e9 * time_s).astype(np.int64),
        np.ascontiguousarray(position_m),
        rotation.as_quat(),
        unknown_covariance(len(time_s)),
    )


def _require_tracks(path: Path, trajectories: list[Trajectory]) -> list[Trajectory]:
    """Return the trajectories with poses.

    Raises
    ------
    FormatError
        There is none, times do not ascend, or a position is damaged.
    """
    tracked = [each for each in trajectories if len(each)]
    if not tracked:
        raise FormatError("no tracked rigid body", file=path, hint="Export rigid bodies (6DOF)")
    for each in tracked:
        if not (np.diff(each.time_ns) > 0).all():
            raise FormatError(f"the times of {each.device} do not ascend", file=path)
        if not (np.abs(each.position) <= MAX_ODOMETRY).all():
            raise FormatError(f"an impossible position of {each.device}", file=path)
    return tracked
