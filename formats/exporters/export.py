"""Poses for other tools: which formats there are, and which files poses become."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from locatk.core.errors import InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.kitti import write_kitti
from locatk.formats.exporters.trajectory_csv import write_csv
from locatk.formats.exporters.tum import write_tum
from locatk.formats.output import atomic_write
from locatk.formats.sessions.reader import Session
from locatk.formats.tables.timestamps import format_epoch_seconds

FORMATS = ("tum", "kitti", "csv", "parquet", "ros2")

ENDINGS = {"tum": ".tum", "kitti": ".txt"}
"""Of the formats that hold one device a file."""

TEXTS = ("csv", "tum")
"""Formats that are text, and one file: they can go through a pipe."""

OF_THE_FILE = ("kind", "format_version")
"""Facts of a solution that say nothing of its poses."""


@dataclass(frozen=True)
class Part:
    """One file to write.

    Attributes
    ----------
    path : Path
    trajectories : tuple of Trajectory
        What goes into it.
    times : Path or None
        The file beside it for the times, which KITTI's format does not hold.
    """

    path: Path
    trajectories: tuple[Trajectory, ...]
    times: Path | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that are written."""
        return (self.path,) if self.times is None else (self.path, self.times)


def parts(found: Sequence[Trajectory], format_name: str, output: Path) -> list[Part]:
    """The files that poses become: ``output``, or in that folder one a device.

    A folder where the format holds one device a file, and there are several or ``output``
    is a folder already.

    Raises
    ------
    InputError
        The files of two devices have the same name.
    """
    ending = ENDINGS.get(format_name)
    if ending is None:
        return [Part(output, tuple(found))]
    single = len(found) == 1 and not output.is_dir()
    planned = []
    for each in found:
        path = output if single else output / f"{each.device.replace('/', '_')}{ending}"
        times = path.with_name(f"{path.stem}.times.txt") if format_name == "kitti" else None
        planned.append(Part(path, (each,), times))
    files = [path for part in planned for path in part.files]
    for path in files:
        if files.count(path) > 1:
            raise InputError(
                f"two devices would be written to {path.name}",
                hint="Export them one at a time with --device, or all as csv",
            )
    return planned


def write(
    part: Part,
    format_name: str,
    *,
    facts: Mapping[str, str] | None = None,
    covariance: bool = False,
    overwrite: bool = False,
) -> None:
    """Write one file, and its times where it has such.

    Parameters
    ----------
    part : Part
        As planned by :func:`parts` for this format.
    format_name : str
        One of :data:`FORMATS`.
    facts : mapping of str to str, optional
        Where the poses come from; kept by the formats that have a place for it.
    covariance : bool
        In ``ros2``, poses with covariance too.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    LocatkError
        See the writer of the format.
    """
    match format_name:
        case "csv":
            write_csv(part.path, part.trajectories, overwrite=overwrite)
        case "tum":
            write_tum(part.path, part.trajectories[0], overwrite=overwrite)
        case "kitti":
            write_kitti(part.path, part.trajectories[0], overwrite=overwrite)
            assert part.times is not None
            write_times(part.times, part.trajectories[0], overwrite=overwrite)
        case "parquet":
            from locatk.formats.exporters.parquet import write_parquet

            write_parquet(part.path, part.trajectories, facts=facts, overwrite=overwrite)
        case "ros2":
            from locatk.formats.exporters.ros2 import write_ros2

            write_ros2(
                part.path,
                part.trajectories,
                facts=facts,
                covariance=covariance,
                overwrite=overwrite,
            )
        case _:
            raise ValueError(f"format is {format_name!r}")


def write_times(path: Path, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Write the time of each pose, a line each, in epoch seconds with nine decimals.

    What KITTI's ``times.txt`` is to its poses, but that it counts from the first one.
    """
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        times = map(format_epoch_seconds, trajectory.time_ns.tolist())
        stream.writelines(f"{time}\n" for time in times)


def numbers(trajectory: Trajectory) -> Trajectory:
    """The poses that are numbers; the others can be written in no format but Parquet."""
    pose = np.hstack([trajectory.position, trajectory.quaternion])
    whole = np.isfinite(pose).all(axis=1)
    if whole.all():
        return trajectory
    return replace(
        trajectory,
        time_ns=trajectory.time_ns[whole],
        position=trajectory.position[whole],
        quaternion=trajectory.quaternion[whole],
        covariance=trajectory.covariance[whole],
    )


def facts_of(path: Path) -> dict[str, str]:
    """What the file of the poses says of them: system, method, source, version of the tool."""
    facts = Session.open(path).facts
    return {key: value for key, value in facts.items() if key not in OF_THE_FILE}
