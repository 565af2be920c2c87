"""Trajectories as KITTI odometry poses.

A line is the upper three rows of a 4 x 4 pose, row by row; an unknown orientation is the identity.
The format has no times: two files correspond row by row. The reader is
:mod:`locatk.formats.importers.poses.kitti`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from locatk.core.geometry import matrix_from_quaternion
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.trajectory_csv import check_exportable
from locatk.formats.output import atomic_write


def write_kitti(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write one trajectory as KITTI; raises as :func:`~locatk.formats.exporters.tum.write_tum`."""
    check_exportable(trajectory)
    matrix = np.empty((len(trajectory), 3, 4))
    matrix[:, :, :3] = matrix_from_quaternion(trajectory.quaternion)
    matrix[:, :, 3] = trajectory.position
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        stream.writelines(
            " ".join(map(repr, row)) + "\n" for row in matrix.reshape(-1, 12).tolist()
        )
