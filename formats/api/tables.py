"""Tables of sessions and solutions: pandas data frames and HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from locatk.core.natural_order import natural_key
from locatk.core.trajectory import Trajectory, has_orientation
from locatk.formats.extras import requires_extra
from locatk.formats.importers.poses.trajectory_csv import (
    POSITION_COLUMNS,
    PROBABILITY_COLUMN,
    QUATERNION_COLUMNS,
    SIGMA_AXES,
    SIGMA_COLUMNS,
)

if TYPE_CHECKING:
    import pandas as pd


def by_device(trajectories: Sequence[Trajectory]) -> dict[str, Trajectory]:
    """Return trajectories by device, in natural order."""
    return {t.device: t for t in sorted(trajectories, key=lambda t: natural_key(t.device))}


def poses_to_dataframe(trajectories: Mapping[str, Trajectory]) -> pd.DataFrame:
    """Return poses as a data frame with the columns of ``locatk export --format csv``.

    ``time`` is a time stamp in UTC; unknown orientations, sigmas and probabilities are ``nan``.

    Raises
    ------
    LocatkError
        pandas is not installed.
    """
    with requires_extra("pandas", "a data frame"):
        import pandas as pd
    parts = []
    for device, trajectory in trajectories.items():
        quaternion = np.where(has_orientation(trajectory)[:, None], trajectory.quaternion, np.nan)
        probability = trajectory.probability
        columns: dict[str, Any] = {
            "time": pd.to_datetime(trajectory.time_ns, unit="ns", utc=True),
            "device": device,
            **dict(zip(POSITION_COLUMNS, trajectory.position.T, strict=True)),
            **dict(zip(QUATERNION_COLUMNS, quaternion.T, strict=True)),
            **dict(zip(SIGMA_COLUMNS, trajectory.sigma[:, SIGMA_AXES].T, strict=True)),
            PROBABILITY_COLUMN: np.nan if probability is None else probability,
        }
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def to_html(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table for notebooks."""
    lines = [f"<p>{escape(title)}</p>", "<table>"]
    lines.append("<tr>" + "".join(f"<th>{escape(name)}</th>" for name in header) + "</tr>")
    for row in rows:
        lines.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return "\n".join([*lines, "</table>"])
