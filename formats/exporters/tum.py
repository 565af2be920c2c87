"""Trajectories as TUM, which evo, ROS tools and most SLAM benchmarks read.

A line is ``time x y z qx qy qz qw``: epoch seconds, metres, a unit quaternion. The format has no
empty values: an unknown orientation is the identity, 0 0 0 1.
The reader is :mod:`locatk.formats.importers.poses.tum`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.trajectory_csv import check_exportable
from locatk.formats.output import atomic_write
from locatk.formats.tables.timestamps import format_epoch_seconds


def write_tum(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write one trajectory as TUM, one blank between the numbers.

    Raises
    ------
    InputError
        See :func:`~locatk.formats.exporters.trajectory_csv.check_exportable`.
    OutputExistsError
        ``path`` exists and ``overwrite`` is false.
    """
    check_exportable(trajectory)
    poses = np.hstack([trajectory.position, trajectory.quaternion]).tolist()
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        stream.writelines(
            f"{format_epoch_seconds(time_ns)} {' '.join(map(repr, pose))}\n"
            for time_ns, pose in zip(trajectory.time_ns.tolist(), poses, strict=True)
        )
