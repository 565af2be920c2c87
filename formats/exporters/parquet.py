"""Export of poses as Parquet for pandas, Polars, DuckDB, Spark and R.

The columns are those of the CSV form up to the sigmas, followed by exact times, frames, full
covariances and probabilities. Unknown values are null. The columns are documented in
docs/formats.md; later versions only add columns at the end.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from locatk.core.trajectory import Trajectory, has_orientation
from locatk.formats.importers.poses.trajectory_csv import (
    COLUMNS,
    PROBABILITY_COLUMN,
    SESSION_COLUMN,
    SIGMA_AXES,
)
from locatk.formats.output import atomic_write, tool_version
from locatk.formats.sessions.messages import triangle
from locatk.formats.tables.arrow import import_pyarrow

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Axes of a pose's covariance: position, and rotation about the fixed axes x, y, z."""


def _covariance_columns() -> tuple[str, ...]:
    names = []
    for i, first in enumerate(AXES):
        for second in AXES[i:]:
            units = ["rad" if axis.startswith("r") else "m" for axis in (first, second)]
            unit = f"{units[0]}2" if units[0] == units[1] else "m_rad"
            names.append(f"cov_{first}_{second}_{unit}")
    return tuple(names)


COVARIANCE = _covariance_columns()
"""Columns of the upper triangle, row by row: ``cov_x_x_m2``, ``cov_x_rx_m_rad``, ..."""

PREFIX = "locatk."
"""Prefix of the keys of locatk in the file's metadata, to which other tools also write."""


def write_parquet(
    path: str | os.PathLike[str],
    trajectories: Sequence[Trajectory],
    *,
    facts: Mapping[str, str] | None = None,
    sessions: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write poses as one Parquet table, one row per pose, device after device.

    Parameters
    ----------
    path : path
        The output.
    trajectories : sequence of Trajectory
        One per device.
    facts : mapping of str to str, optional
        Origin of the poses (system, method, source ...), for the metadata of the schema.
    sessions : sequence of str
        Name of the session of each trajectory, for a last column; empty without such a column.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    LocatkError
        pyarrow is not installed.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    arrow, parquet = import_pyarrow()
    tables = [_table(arrow, trajectory) for trajectory in trajectories]
    if sessions:
        tables = [
            table.append_column(
                SESSION_COLUMN, arrow.repeat(arrow.scalar(name, arrow.string()), len(table))
            )
            for table, name in zip(tables, sessions, strict=True)
        ]
    origin = {**(facts or {}), "exported_by": f"locatk {tool_version()}"}
    metadata = {f"{PREFIX}{key}": value for key, value in origin.items()}
    table = arrow.concat_tables(tables or [_table(arrow, _empty_trajectory())])
    with atomic_write(path, overwrite=overwrite) as stream:
        parquet.write_table(table.replace_schema_metadata(metadata), stream)


def _table(arrow: Any, trajectory: Trajectory) -> Any:
    n = len(trajectory)

    def texts(value: str) -> Any:
        return arrow.repeat(arrow.scalar(value, arrow.string()), n)

    def numbers(values: Any) -> list[Any]:
        """Return one column for each column of ``values``; nan (unknown) becomes null."""
        return [
            arrow.array(np.ascontiguousarray(column), mask=np.isnan(column)) for column in values.T
        ]

    quaternion = np.where(has_orientation(trajectory)[:, None], trajectory.quaternion, np.nan)
    pose = np.hstack([trajectory.position, quaternion])
    probability = trajectory.probability
    if probability is None:
        probability = np.full(n, np.nan)
    # Whole seconds and the rest are added, because a float64 product rounds the last digits.
    seconds, rest = np.divmod(trajectory.time_ns, 1_000_000_000)
    columns = [
        arrow.array(seconds + rest / 1e9),
        texts(trajectory.device),
        *numbers(pose),
        *numbers(trajectory.sigma[:, SIGMA_AXES]),
        arrow.array(trajectory.time_ns),
        texts(trajectory.frame),
        *numbers(triangle(trajectory.covariance)),
        *numbers(probability[:, None]),
    ]
    names = [name for name in COLUMNS if name != PROBABILITY_COLUMN]
    names += ["time_ns", "frame", *COVARIANCE, PROBABILITY_COLUMN]
    return arrow.table(columns, names=names)


def _empty_trajectory() -> Trajectory:
    return Trajectory.from_positions("", "", np.zeros(0, np.int64), np.zeros((0, 3)))
