"""Export of poses for other tools: table of formats, plan of the files, and writing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from locatk.core.errors import InputError
from locatk.core.printable import file_name_part
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.kitti import write_kitti
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.exporters.tum import write_tum
from locatk.formats.output import atomic_write
from locatk.formats.sessions.reader import Session
from locatk.formats.tables.timestamps import format_epoch_seconds

FORMATS = ("tum", "kitti", "csv", "parquet", "ros2")

ENDINGS = {"tum": ".tum", "kitti": ".txt"}
"""File name endings of the formats that hold one device per file."""

TEXTS = ("csv", "tum")
"""Formats that are a single text file, and can be written to a pipe."""

FILE_FACTS = ("kind", "format_version")
"""Facts of a solution that describe its file and not its poses."""


@dataclass(frozen=True)
class OutputFile:
    """One file to write.

    Attributes
    ----------
    path : Path
    trajectories : tuple of Trajectory
        Its content.
    times : Path or None
        Additional file for the times, which the format of KITTI does not contain.
    """

    path: Path
    trajectories: tuple[Trajectory, ...]
    times: Path | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of all files that are written."""
        return (self.path,) if self.times is None else (self.path, self.times)


def plan_files(
    trajectories: Sequence[Trajectory], format_name: str, output: Path
) -> list[OutputFile]:
    """Plan the files of an export: ``output``, or one per device in this folder.

    ``output`` is a folder if the format holds one device per file, and there are several devices
    or the folder already exists.

    Raises
    ------
    InputError
        The files of two devices have the same name.
    """
    ending = ENDINGS.get(format_name)
    if ending is None:
        return [OutputFile(output, tuple(trajectories))]
    is_single = len(trajectories) == 1 and not output.is_dir()
    planned = []
    for each in trajectories:
        path = output if is_single else output / f"{file_name_part(each.device)}{ending}"
        times = path.with_name(f"{path.stem}.times.txt") if format_name == "kitti" else None
        planned.append(OutputFile(path, (each,), times))
    files = [path for file in planned for path in file.files]
    for path in files:
        if files.count(path) > 1:
            raise InputError(
                f"two devices would be written to {path.name}",
                hint="Export them one at a time with --device, or all as csv",
            )
    return planned


def write(
    file: OutputFile,
    format_name: str,
    *,
    facts: Mapping[str, str] | None = None,
    covariance: bool = False,
    overwrite: bool = False,
) -> None:
    """Write one planned file, and its file of times if it has one.

    Parameters
    ----------
    file : OutputFile
        As planned by :func:`plan_files` for this format.
    format_name : str
        One of :data:`FORMATS`.
    facts : mapping of str to str, optional
        Origin of the poses; stored by ``parquet`` and ``ros2``.
    covariance : bool
        In ``ros2``, also write poses with covariance.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    LocatkError
        See the writer of the format.
    """
    match format_name:
        case "csv":
            write_csv(file.path, file.trajectories, overwrite=overwrite)
        case "tum":
            write_tum(file.path, file.trajectories[0], overwrite=overwrite)
        case "kitti":
            write_kitti(file.path, file.trajectories[0], overwrite=overwrite)
            assert file.times is not None
            write_times(file.times, file.trajectories[0], overwrite=overwrite)
        case "parquet":
            from locatk.formats.exporters.parquet import write_parquet

            write_parquet(file.path, file.trajectories, facts=facts, overwrite=overwrite)
        case "ros2":
            from locatk.formats.exporters.ros2 import write_ros2

            write_ros2(
                file.path,
                file.trajectories,
                facts=facts,
                covariance=covariance,
                overwrite=overwrite,
            )
        case _:
            raise ValueError(f"format is {format_name!r}")


def write_times(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write the time of each pose, one per line, in epoch seconds with nine decimals.

    The ``times.txt`` of KITTI is similar, but counts from the first pose.
    """
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        times = map(format_epoch_seconds, trajectory.time_ns.tolist())
        stream.writelines(f"{time}\n" for time in times)


def with_finite_poses(trajectory: Trajectory) -> Trajectory:
    """Return the poses of which position and orientation are finite.

    Only Parquet can represent the others.
    """
    pose = np.hstack([trajectory.position, trajectory.quaternion])
    is_finite = np.asarray(np.isfinite(pose).all(axis=1))
    return trajectory if is_finite.all() else trajectory.select(is_finite)


def read_origin(path: Path) -> dict[str, str]:
    """Read the origin of the poses in a file: system, method, source, version of the tool."""
    facts = Session.open(path).facts
    return {key: value for key, value in facts.items() if key not in FILE_FACTS}
