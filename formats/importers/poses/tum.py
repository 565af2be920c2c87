"""Trajectories from TUM files; the writer is :mod:`locatk.formats.exporters.tum`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from locatk.core.trajectory import Trajectory
from locatk.formats.importers.poses.trajectory_csv import (
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    check_ascending,
    read_positions,
    unit_quaternions,
    unknown_covariance,
)
from locatk.formats.tables.delimited import read_number_rows

TIME_COLUMN = "time_s"

TUM_COLUMNS = (TIME_COLUMN, *POSITION_COLUMNS, *QUATERNION_COLUMNS)

TUM_HINT = "TUM lines are: time x y z qx qy qz qw"


def read_tum(path: Path, *, device: str | None = None, frame: str = "floor") -> Trajectory:
    """Read a TUM file; lines that start with ``#`` and blank lines are ignored.

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
        The file is missing, is not text, has no poses, or has lines without eight numbers.
    InputError
        A quaternion is far from unit length, or time stamps do not ascend.
    """
    table = read_number_rows(path, TUM_COLUMNS, hint=TUM_HINT, time_column=TIME_COLUMN)
    position = read_positions(table)
    quaternion = unit_quaternions(table, QUATERNION_COLUMNS)
    time_ns = table.epoch_times_ns(TIME_COLUMN)
    check_ascending(table, time_ns, np.arange(len(table)))
    return Trajectory(
        Path(path).stem if device is None else device,
        frame,
        time_ns,
        position,
        quaternion,
        unknown_covariance(len(table)),
    )
