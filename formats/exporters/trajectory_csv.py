"""Trajectories as CSV with uncertainties.

The reader is :mod:`locatk.formats.importers.poses.trajectory_csv`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from locatk.core.errors import InputError
from locatk.core.printable import spreadsheet_text
from locatk.core.trajectory import Trajectory, has_orientation
from locatk.formats.importers.poses.trajectory_csv import COLUMNS, SESSION_COLUMN, SIGMA_AXES
from locatk.formats.output import atomic_write
from locatk.formats.tables.timestamps import format_epoch_seconds


def write_csv(
    path: Path,
    trajectories: Sequence[Trajectory],
    *,
    sessions: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write poses as CSV (:data:`COLUMNS`), one row a pose, device after device.

    Unknown orientations, sigmas and probabilities are empty cells. Numbers have the fewest digits
    that read back equal. With ``sessions``, the name of the session of each trajectory is the last
    column.

    Raises
    ------
    InputError
        A device has two trajectories, or see :func:`check_exportable`.
    OutputExistsError
        ``path`` exists and ``overwrite`` is false.
    """
    owners = sessions or [""] * len(trajectories)
    names = [(owner, each.device) for owner, each in zip(owners, trajectories, strict=True)]
    if len(set(names)) != len(names):
        raise InputError("a device has two trajectories", hint="Give each its own name")
    for trajectory in trajectories:
        check_exportable(trajectory)
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        stream.write(",".join([*COLUMNS, *([SESSION_COLUMN] if sessions else [])]) + "\n")
        for trajectory, owner in zip(trajectories, owners, strict=True):
            last = [_text_cell(owner)] if sessions else []
            stream.writelines(_csv_lines(trajectory, last))


def _text_cell(text: str) -> str:
    text = spreadsheet_text(text)
    # The csv module of Python 3.11 leaves a carriage return unquoted and reads it as a line end.
    if any(character in text for character in ',"\r\n'):
        text = '"' + text.replace('"', '""') + '"'
    return text


def _csv_lines(trajectory: Trajectory, last: Sequence[str]) -> Iterator[str]:
    device = _text_cell(trajectory.device)
    quaternion = np.where(has_orientation(trajectory)[:, None], trajectory.quaternion, np.nan)
    probability = trajectory.probability
    if probability is None:
        probability = np.full(len(trajectory), np.nan)
    rows = np.column_stack(
        [trajectory.position, quaternion, trajectory.sigma[:, SIGMA_AXES], probability]
    ).tolist()
    for time_ns, values in zip(trajectory.time_ns.tolist(), rows, strict=True):
        cells = ("" if value != value else repr(value) for value in values)
        yield ",".join([format_epoch_seconds(time_ns), device, *cells, *last]) + "\n"


def check_exportable(trajectory: Trajectory) -> None:
    """Refuse a trajectory that could not be read back from a text file.

    Raises
    ------
    InputError
        Time stamps do not ascend, or a position or orientation is not finite.
    """
    name = f"trajectory of device {trajectory.device!r}"
    if np.any(trajectory.time_ns[1:] <= trajectory.time_ns[:-1]):
        raise InputError(
            f"time stamps do not ascend in the {name}", hint="Sort, drop repeated poses"
        )
    if not (
        np.all(np.isfinite(trajectory.position)) and np.all(np.isfinite(trajectory.quaternion))
    ):
        raise InputError(f"poses that are not finite in the {name}", hint="Leave them out")
