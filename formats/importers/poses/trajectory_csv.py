"""Trajectories from CSV; the writer is :mod:`locatk.formats.exporters.trajectory_csv`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.printable import text_of_spreadsheet
from locatk.core.trajectory import MAX_ODOMETRY, Trajectory
from locatk.formats.tables.delimited import Table, read_table

Array = NDArray[np.float64]

COLUMNS = (
    "time_s",
    "device",
    "x_m",
    "y_m",
    "z_m",
    "qx",
    "qy",
    "qz",
    "qw",
    "sigma_x_m",
    "sigma_y_m",
    "sigma_z_m",
    "sigma_heading_rad",
    "probability",
)
"""Header of the file. It is part of the contract (docs/formats.md): new columns go to the end."""

SESSION_COLUMN = "session"
"""Last column of a table of several sessions."""

SIGMA_AXES = (0, 1, 2, 5)
"""Rows of a pose's covariance that belong to the four sigmas."""

POSITION_COLUMNS, QUATERNION_COLUMNS, SIGMA_COLUMNS = COLUMNS[2:5], COLUMNS[5:9], COLUMNS[9:13]

PROBABILITY_COLUMN = COLUMNS[13]

MAX_SIGMA = 1e100
"""Largest standard deviation [m or rad]; squares of larger ones overflow."""

MAX_NORM_ERROR = 1e-2
"""Largest deviation of a quaternion from unit length that passes for rounding by its writer."""

MIN_NORM_ERROR = 1e-12
"""Smallest deviation from unit length that is corrected; below, all digits are kept."""


def read_csv(path: Path, *, frame: str = "floor") -> list[Trajectory]:
    """Read poses from CSV, one trajectory a device.

    Parameters
    ----------
    path : path
        Columns ``qx`` to ``qw`` and the sigmas may be missing (all four of a kind), and so may
        the probability; further columns are ignored. A sigma, a probability or all four cells of a
        quaternion that are empty or ``nan`` are unknown.
    frame : str
        Name of the frame, which is not part of the file.

    Returns
    -------
    list of Trajectory
        In the order in which the devices appear. Covariances are diagonal: the file does
        not hold correlations.

    Raises
    ------
    MissingDataError, FormatError
        The file is missing, or is not CSV with these columns.
    InputError
        A cell is not a number, a sigma is negative, a probability is not between 0 and 1, a
        quaternion is far from unit length, the time stamps of a device do not ascend, or the poses
        are of several sessions.
    """
    table = read_table(path)
    table.require(*COLUMNS[:5])
    if len(set(table.columns.get(SESSION_COLUMN, ()))) > 1:
        raise InputError(
            "poses of several sessions", file=path, hint="Export each session to its own file"
        )
    n = len(table)
    position = read_positions(table)
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    if any(name in table.columns for name in QUATERNION_COLUMNS):
        table.require(*QUATERNION_COLUMNS)
        quaternion = unit_quaternions(table, QUATERNION_COLUMNS, allow_missing=True)
    sigma = np.full((n, 4), np.nan)
    if any(name in table.columns for name in SIGMA_COLUMNS):
        table.require(*SIGMA_COLUMNS)
        columns = [
            table.floats(name, low=0.0, high=MAX_SIGMA, allow_missing=True)
            for name in SIGMA_COLUMNS
        ]
        sigma = np.stack(columns, axis=1)
    probability = np.full(n, np.nan)
    if PROBABILITY_COLUMN in table.columns:
        probability = table.floats(PROBABILITY_COLUMN, low=0.0, high=1.0, allow_missing=True)
    is_unknown = np.isnan(quaternion[:, 0])
    quaternion[is_unknown], sigma[is_unknown, 3] = (0.0, 0.0, 0.0, 1.0), np.nan
    time_ns = table.epoch_times_ns("time_s")

    trajectories = []
    devices = [text_of_spreadsheet(cell) for cell in table.columns["device"]]
    device_of_row = np.array(devices, object)
    for device in dict.fromkeys(devices):
        rows = np.flatnonzero(device_of_row == device)
        check_ascending(table, time_ns, rows)
        covariance = _diagonal_covariance(sigma[rows])
        is_known = np.isfinite(probability[rows]).any()
        trajectories.append(
            Trajectory(
                device,
                frame,
                time_ns[rows],
                position[rows],
                quaternion[rows],
                covariance,
                probability[rows] if is_known else None,
            )
        )
    return trajectories


def read_positions(table: Table) -> Array:
    """Return the positions (n, 3) in the columns :data:`POSITION_COLUMNS`.

    Raises
    ------
    InputError
        A cell is not a number up to :data:`MAX_ODOMETRY`, which includes damaged exponents.
    """
    columns = [table.floats(name, -MAX_ODOMETRY, MAX_ODOMETRY) for name in POSITION_COLUMNS]
    return np.stack(columns, axis=1)


def unit_quaternions(table: Table, names: Sequence[str], *, allow_missing: bool = False) -> Array:
    """Return the quaternions (n, 4) in the columns ``names`` (x, y, z, w), normalised.

    Those of which all cells are missing are ``nan`` if that is allowed.

    Raises
    ------
    InputError
        A cell is not a number, or a quaternion is further than :data:`MAX_NORM_ERROR` from unit
        length.
    """
    columns = [table.floats(name, allow_missing=allow_missing) for name in names]
    quaternion = np.stack(columns, axis=1)
    is_partial = np.isnan(quaternion).any(axis=1) & ~np.isnan(quaternion).all(axis=1)
    if is_partial.any():
        table.fail(
            int(np.argmax(is_partial)),
            "an incomplete quaternion",
            "Leave all of qx qy qz qw empty if the orientation is unknown",
        )
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    is_wrong = np.abs(length - 1) > MAX_NORM_ERROR
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        table.fail(
            row,
            f"a quaternion of length {length[row]:.3g} instead of 1",
            "The order is qx qy qz qw",
        )
    is_rounded = np.abs(length - 1) > MIN_NORM_ERROR
    return np.where(is_rounded[:, None], quaternion / length[:, None], quaternion)


def check_ascending(table: Table, time_ns: NDArray[np.int64], rows: NDArray[np.int64]) -> None:
    """Refuse rows of a table whose times do not ascend strictly.

    Raises
    ------
    InputError
    """
    times_ns = time_ns[rows]
    # A difference of two times can exceed int64.
    is_late = times_ns[1:] <= times_ns[:-1]
    if is_late.any():
        table.fail(
            int(rows[np.argmax(is_late) + 1]),
            "a time stamp that does not ascend",
            "Sort the rows of each device by time and drop repeated ones",
        )


def unknown_covariance(n: int) -> Array:
    """Return read-only covariances (n, 6, 6) of poses without uncertainty, in constant memory."""
    return np.broadcast_to(np.nan, (n, 6, 6))


def _diagonal_covariance(sigma: Array) -> Array:
    """Return covariances (n, 6, 6) without correlations from four sigmas (n, 4)."""
    sigmas = np.full((len(sigma), 6), np.nan)
    sigmas[:, SIGMA_AXES] = sigma
    is_known = np.isfinite(sigmas)
    covariance = np.where(is_known[:, :, None] & is_known[:, None, :], 0.0, np.nan)
    rows = np.arange(6)
    covariance[:, rows, rows] = sigmas**2
    return covariance
