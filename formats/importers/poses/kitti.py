"""Trajectories from KITTI files; the writer is :mod:`locatk.formats.exporters.kitti`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_matrix
from locatk.core.trajectory import MAX_ODOMETRY, Trajectory
from locatk.formats.importers.poses.trajectory_csv import MAX_NORM_ERROR, unknown_covariance
from locatk.formats.tables.delimited import read_number_rows

Array = NDArray[np.float64]

KITTI_COLUMNS = tuple(f"number {k}" for k in range(1, 13))

KITTI_HINT = "KITTI lines are the rows of a 3 x 4 matrix: rotation, then position"


def read_kitti(path: Path, *, device: str | None = None, frame: str = "floor") -> Trajectory:
    """Read a KITTI file; its rows get the times 0, 1, 2 ... seconds.

    Lines that start with ``#`` and blank lines are ignored.

    Parameters
    ----------
    path : path
    device : str, optional
        Name of the device. [default: the file's name without its ending]
    frame : str
        Name of the frame, which is not part of the file.

    Raises
    ------
    MissingDataError, FormatError
        The file is missing, is not text, has no poses, or has lines without twelve numbers.
    InputError
        A matrix is far from a rotation.
    """
    table = read_number_rows(path, KITTI_COLUMNS, hint=KITTI_HINT)
    numbers = np.stack(
        [table.floats(name, -MAX_ODOMETRY, MAX_ODOMETRY) for name in KITTI_COLUMNS], axis=1
    )
    matrix = numbers.reshape(-1, 3, 4)
    rotation = matrix[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        gram = rotation @ rotation.transpose(0, 2, 1)
        # Columns whose length is off by MAX_NORM_ERROR change the Gram matrix by twice as much.
        is_wrong = ~(np.abs(gram - np.eye(3)).max(axis=(1, 2)) <= 2 * MAX_NORM_ERROR)
        is_wrong |= ~(np.linalg.det(rotation) > 0)
    if is_wrong.any():
        table.fail(int(np.argmax(is_wrong)), "a matrix that is not a rotation", KITTI_HINT)
    return Trajectory(
        Path(path).stem if device is None else device,
        frame,
        1_000_000_000 * np.arange(len(table), dtype=np.int64),
        np.ascontiguousarray(matrix[:, :, 3]),
        quaternion_from_matrix(_nearest_rotation(rotation)),
        unknown_covariance(len(table)),
    )


def _nearest_rotation(matrix: Array) -> Array:
    """Return the rotations nearest to matrices (n, 3, 3) that are rotations except for rounding.

    Newton's iteration for the polar decomposition (Higham, Functions of Matrices, 2008, section
    8.3) squares the error each time: three suffice from :data:`MAX_NORM_ERROR`. KITTI files have
    seven digits. A quaternion of some of the nine cells only would be off by their rounding.
    """
    for _ in range(3):
        matrix = 1.5 * matrix - 0.5 * matrix @ matrix.transpose(0, 2, 1) @ matrix
    return matrix
