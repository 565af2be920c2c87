"""Trajectories in files that other programs read: CSV with uncertainty, TUM and KITTI.

Stamps are written from and read into integer nanoseconds, digit by digit: as float64,
epoch seconds resolve 240 ns only. What is written can be read back, but for a file without
poses; reading is strict, and every error names file and line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import matrix_from_quaternion, quaternion_from_matrix
from locatk.core.trajectory import Trajectory
from locatk.formats.output import atomic_write
from locatk.formats.tables.csv_table import Table, read_table
from locatk.formats.tables.number_rows import format_time, parse_time, parse_times, read_rows

__all__ = [
    "COLUMNS",
    "format_time",
    "parse_time",
    "read_csv",
    "read_kitti",
    "read_tum",
    "write_csv",
    "write_kitti",
    "write_tum",
]

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
)
"""Header of the CSV form; it stays as it is (docs/architecture.md)."""

KITTI_COLUMNS = tuple(f"number {k}" for k in range(1, 13))

SIGMA_AXES = (0, 1, 2, 5)
"""Where the four sigmas stand in a pose's covariance."""

NORM_TOLERANCE = 1e-2
"""Quaternions further from unit length are an error; nearer ones were rounded by their
writer and are normalised."""


def write_csv(path: Path, trajectories: Sequence[Trajectory], *, overwrite: bool = False) -> None:
    """Write poses as CSV (:data:`COLUMNS`), one row a pose, device after device.

    Unknown sigmas are empty cells. Numbers have the fewest digits that read back equal.

    Raises
    ------
    InputError
        Stamps of a device do not ascend, a position or orientation is no number, or a
        device comes twice.
    OutputExistsError
        ``path`` exists and ``overwrite`` is false.
    """
    names = [trajectory.device for trajectory in trajectories]
    if len(set(names)) != len(names):
        raise InputError("a device has two trajectories", hint="give each its own name")
    for trajectory in trajectories:
        _check(trajectory)
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        stream.write(",".join(COLUMNS) + "\n")
        for trajectory in trajectories:
            stream.writelines(_csv_lines(trajectory))


def _csv_lines(trajectory: Trajectory) -> Iterator[str]:
    device = trajectory.device
    # The csv module of Python 3.11 leaves a carriage return unquoted and reads it as a line end.
    if any(character in device for character in ',"\r\n'):
        device = '"' + device.replace('"', '""') + '"'
    poses = np.hstack([trajectory.position, trajectory.quaternion]).tolist()
    sigmas = trajectory.sigma[:, SIGMA_AXES].tolist()
    for time_ns, pose, sigma in zip(trajectory.time_ns.tolist(), poses, sigmas, strict=True):
        known = ("" if value != value else repr(value) for value in sigma)
        yield ",".join([format_time(time_ns), device, *map(repr, pose), *known]) + "\n"


def read_csv(path: Path, *, frame: str = "floor") -> list[Trajectory]:
    """Read poses from CSV, one trajectory a device.

    Parameters
    ----------
    path : path
        As :func:`write_csv` writes it. Columns ``qx`` to ``qw`` and the sigmas may be
        missing (all four of a kind); further columns are ignored.
    frame : str
        Name of the frame, which the file does not tell.

    Returns
    -------
    list of Trajectory
        In the order in which the devices appear. Covariances are diagonal: the file does
        not hold correlations.

    Raises
    ------
    MissingDataError, FormatError
        No such file; no CSV, or without the columns.
    InputError
        A cell that is no number, a negative sigma, a quaternion that is far from unit
        length, stamps of a device that do not ascend.
    """
    table = read_table(path)
    table.require(*COLUMNS[:5])
    position = np.stack([table.floats(name) for name in COLUMNS[2:5]], axis=1)
    quaternion = np.zeros((len(table), 4))
    quaternion[:, 3] = 1.0
    if any(name in table.columns for name in COLUMNS[5:9]):
        table.require(*COLUMNS[5:9])
        quaternion = np.stack([table.floats(name) for name in COLUMNS[5:9]], axis=1)
        quaternion = _unit(quaternion, path, table.lines)
    sigma = np.full((len(table), 4), np.nan)
    if any(name in table.columns for name in COLUMNS[9:]):
        table.require(*COLUMNS[9:])
        sigma = np.stack([_sigma(table, name) for name in COLUMNS[9:]], axis=1)
    time = _times(table.columns["time_s"], path, table.lines)

    trajectories = []
    devices = np.array(table.columns["device"], object)
    for device in dict.fromkeys(table.columns["device"]):
        mine = np.flatnonzero(devices == device)
        _ascending(time[mine], path, [table.lines[i] for i in mine])
        trajectories.append(
            Trajectory(
                device, frame, time[mine], position[mine], quaternion[mine], _diagonal(sigma[mine])
            )
        )
    return trajectories


def _sigma(table: Table, name: str) -> Array:
    """A sigma's column, in which cells may be empty."""
    cells = table.columns[name]
    known = [i for i, cell in enumerate(cells) if cell.strip()]
    part = Table(table.file, {name: [cells[i] for i in known]}, [table.lines[i] for i in known])
    values = np.full(len(cells), np.nan)
    values[known] = part.floats(name, low=0.0)
    return values


def _diagonal(sigma: Array) -> Array:
    """Covariances (n, 6, 6) without correlation from four sigmas (n, 4)."""
    full = np.full((len(sigma), 6), np.nan)
    full[:, SIGMA_AXES] = sigma
    known = np.isfinite(full)
    covariance = np.where(known[:, :, None] & known[:, None, :], 0.0, np.nan)
    rows = np.arange(6)
    covariance[:, rows, rows] = full**2
    return covariance


def write_tum(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write one trajectory as TUM: ``time x y z qx qy qz qw``, one space between.

    Read by evo, ROS tools and most SLAM benchmarks. Raises as :func:`write_csv`.
    """
    _check(trajectory)
    poses = np.hstack([trajectory.position, trajectory.quaternion]).tolist()
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        stream.writelines(
            f"{format_time(time_ns)} {' '.join(map(repr, pose))}\n"
            for time_ns, pose in zip(trajectory.time_ns.tolist(), poses, strict=True)
        )


def read_tum(path: Path, *, device: str | None = None, frame: str = "floor") -> Trajectory:
    """Read a TUM file; lines that start with ``#`` and blank lines are passed over.

    Parameters
    ----------
    path : path
    device : str, optional
        Name of the device; the file's name without ending where None.
    frame : str
        Name of the frame, which the file does not tell.

    Raises
    ------
    MissingDataError, FormatError
        No such file; no text, no poses, lines without eight numbers.
    InputError
        A quaternion far from unit length, stamps that do not ascend.
    """
    rows = read_rows(path, ("time_s", *COLUMNS[2:9]), "TUM lines are: time x y z qx qy qz qw")
    time = _times(rows.words, path, rows.lines)
    _ascending(time, path, rows.lines)
    pose = rows.values[:, 1:]
    name = Path(path).stem if device is None else device
    return Trajectory(
        name,
        frame,
        time,
        np.ascontiguousarray(pose[:, :3]),
        _unit(pose[:, 3:], path, rows.lines),
        _unknown(len(rows)),
    )


def write_kitti(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write one trajectory as KITTI: the upper three rows of each 4 x 4 pose, row by row.

    KITTI knows no time: the rows are all that tells which pose is meant. Raises as
    :func:`write_csv`.
    """
    _check(trajectory)
    matrix = np.empty((len(trajectory), 3, 4))
    matrix[:, :, :3] = matrix_from_quaternion(trajectory.quaternion)
    matrix[:, :, 3] = trajectory.position
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        stream.writelines(
            " ".join(map(repr, row)) + "\n" for row in matrix.reshape(-1, 12).tolist()
        )


def read_kitti(path: Path, *, device: str | None = None, frame: str = "floor") -> Trajectory:
    """Read a KITTI file; its rows are stamped 0, 1, 2 ... seconds.

    Lines that start with ``#`` and blank lines are passed over.

    Parameters
    ----------
    path : path
    device : str, optional
        Name of the device; the file's name without ending where None.
    frame : str
        Name of the frame, which the file does not tell.

    Raises
    ------
    MissingDataError, FormatError
        No such file; no text, no poses, lines without twelve numbers.
    InputError
        A matrix that is far from a rotation.
    """
    rows = read_rows(path, KITTI_COLUMNS, "KITTI lines are the rows of a 3 x 4 matrix")
    matrix = rows.values.reshape(-1, 3, 4)
    rotation = matrix[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        gram = rotation @ rotation.transpose(0, 2, 1)
        far = ~(np.abs(gram - np.eye(3)).max(axis=(1, 2)) <= 2 * NORM_TOLERANCE)
        far |= ~(np.linalg.det(rotation) > 0)
    if far.any():
        raise InputError(
            "a matrix that is no rotation",
            file=path,
            where=rows.lines[int(np.argmax(far))],
            hint="KITTI lines are the rows of a 3 x 4 matrix: rotation, then position",
        )
    return Trajectory(
        Path(path).stem if device is None else device,
        frame,
        1_000_000_000 * np.arange(len(rows), dtype=np.int64),
        np.ascontiguousarray(matrix[:, :, 3]),
        quaternion_from_matrix(_nearest_rotation(rotation)),
        _unknown(len(rows)),
    )


def _nearest_rotation(matrix: Array) -> Array:
    """Rotations nearest to matrices (n, 3, 3) that are rotations but for rounding.

    Newton's iteration for the polar decomposition (Higham, Functions of Matrices, 2008, section
    8.3): the error squares each time, from :data:`NORM_TOLERANCE` to nothing in three. Files of
    KITTI have seven digits, and a rotation taken from some of the nine cells only would be off
    by as much as these are rounded.
    """
    for _ in range(3):
        matrix = 1.5 * matrix - 0.5 * matrix @ matrix.transpose(0, 2, 1) @ matrix
    return matrix


def _unknown(n: int) -> Array:
    """Covariances of n poses that tell none; one number in memory, which nobody writes to."""
    return np.broadcast_to(np.nan, (n, 6, 6))


def _check(trajectory: Trajectory) -> None:
    """Refuse to write what could not be read back."""
    name = f"trajectory of device {trajectory.device!r}"
    if np.any(trajectory.time_ns[1:] <= trajectory.time_ns[:-1]):
        raise InputError(f"stamps do not ascend in the {name}", hint="sort, drop repeated poses")
    if not (
        np.all(np.isfinite(trajectory.position)) and np.all(np.isfinite(trajectory.quaternion))
    ):
        raise InputError(f"poses that are not numbers in the {name}", hint="leave them out")


def _times(cells: Sequence[str], path: Path, lines: Sequence[int]) -> NDArray[np.int64]:
    def fail(row: int) -> InputError:
        return InputError(
            f"{cells[row][:40]!r} is no time in epoch seconds",
            file=path,
            where=lines[row],
            hint="write it as 1690218696.074800000",
        )

    return parse_times(cells, fail)


def _ascending(time: NDArray[np.int64], path: Path, lines: Sequence[int]) -> None:
    late = time[1:] <= time[:-1]
    if late.any():
        raise InputError(
            "a time stamp that does not ascend",
            file=path,
            where=lines[int(np.argmax(late)) + 1],
            hint="sort the rows of each device by time and drop repeated ones",
        )


def _unit(quaternion: Array, path: Path, lines: Sequence[int]) -> Array:
    length = np.linalg.norm(quaternion, axis=1)
    far = np.abs(length - 1) > NORM_TOLERANCE
    if far.any():
        row = int(np.argmax(far))
        raise InputError(
            f"a quaternion of length {length[row]:.3g} instead of 1",
            file=path,
            where=lines[row],
            hint="the order is qx qy qz qw",
        )
    # Those that are of unit length to rounding stay as they are, digit by digit.
    rounded = np.abs(length - 1) > 1e-12
    return np.where(rounded[:, None], quaternion / length[:, None], quaternion)
