"""Trajectories in the ground truth format of EuRoC MAV, and of tools that imitate it.

One row a pose: ``timestamp [ns], x, y, z, qw, qx, qy, qz``, and further columns that are ignored.
Source: Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from locatk.core.errors import FormatError
from locatk.core.trajectory import Trajectory
from locatk.formats.files import MAX_FILE_BYTES, read_text
from locatk.formats.importers.poses.trajectory_csv import MAX_NORM_ERROR, unknown_covariance

COLUMNS = 8


def read_euroc(path: Path) -> tuple[list[Trajectory], tuple[str, ...]]:
    """Read a file of EuRoC ground truth; there are no notes.

    Raises
    ------
    FormatError
        A cell is not a number, a quaternion is far from unit length, or times do not ascend.
    """
    times, values = [], []
    for number, line in enumerate(read_text(path, MAX_FILE_BYTES).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        cells = line.split(",")
        try:
            times.append(int(cells[0]))
            values.append([float(cell) for cell in cells[1:COLUMNS]])
        except ValueError:
            raise FormatError("a cell is not a number", file=path, where=number) from None
        if len(values[-1]) < COLUMNS - 1 or not np.isfinite(values[-1]).all():
            raise FormatError("fewer than eight numbers", file=path, where=number)
        if abs(np.linalg.norm(values[-1][3:]) - 1.0) > MAX_NORM_ERROR:
            raise FormatError("a quaternion that is not of unit length", file=path, where=number)
        if len(times) > 1 and times[-1] <= times[-2]:
            raise FormatError("times do not ascend", file=path, where=number)
    if not times:
        raise FormatError("no poses", file=path, hint="The file has a header only")
    data = np.array(values)
    quaternion = data[:, [4, 5, 6, 3]]
    trajectory = Trajectory(
        path.stem,
        "world",
        np.array(times, np.int64),
        np.ascontiguousarray(data[:, :3]),
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        unknown_covariance(len(times)),
    )
    return [trajectory], ()
