"""Solution for Python: poses with what they were estimated from, as tables, plots and reports."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from locatk.core.errors import InputError
from locatk.core.solution import Solution as SolverResult
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.api import tables
from locatk.formats.sessions.reader import Session as StoredSession
from locatk.formats.sessions.solutions import read_solution, write_solution

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from locatk.formats.report.subject import Subject


class Solution:
    """Poses of the devices of a session, from :func:`locatk.solve` or :func:`locatk.open`.

    Attributes
    ----------
    result : locatk.core.solution.Solution
        Everything that the solver returned.
    name : str
        For titles, as in ``"run.mcap"``.
    facts : mapping of str to str
        Origin: command, source and version.
    session : locatk.formats.sessions.reader.Session or None
        The recording, if it is available.
    """

    def __init__(
        self,
        result: SolverResult,
        name: str,
        facts: Mapping[str, str],
        session: StoredSession | None = None,
    ) -> None:
        self.result, self.name, self.facts, self.session = result, name, facts, session

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Solution:
        """Read a file of ``locatk solve``, and the session that it names from the same folder.

        Raises
        ------
        MissingDataError, FormatError
            There is no such file, or it is not a solution.
        """
        from locatk.formats.report.subject import find_session

        result, facts = read_solution(path), StoredSession.open(path).facts
        return cls(result, Path(path).name, facts, find_session(Path(path), facts, result))

    @property
    def system(self) -> str:
        """``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``."""
        return self.result.system

    @property
    def method(self) -> str:
        """Algorithm, as in ``"bundle"`` or ``"paper"``."""
        return self.result.method

    @cached_property
    def poses(self) -> dict[str, Trajectory]:
        """Trajectories by device, in natural order."""
        return tables.by_device(self.result.trajectories)

    @property
    def artifact(self) -> Any:
        """Scene, tag, sheet or map that the poses refer to."""
        return self.result.artifact

    @property
    def detections(self) -> tuple[Any, ...]:
        """Observations of the infrastructure."""
        return self.result.detections

    @property
    def warnings(self) -> tuple[SolverWarning, ...]:
        """Assumptions and doubts of the solver."""
        return self.result.warnings

    @property
    def rejected(self) -> dict[str, int]:
        """Number of observations that were not used, by reason."""
        return self.result.rejected

    def to_dataframe(self) -> pd.DataFrame:
        """Return all poses as a pandas data frame; needs ``locatk[pandas]``.

        The columns are those of ``locatk export --format csv``, with ``time`` in UTC.
        """
        return tables.poses_to_dataframe(self.poses)

    def plot(self, truth: str | os.PathLike[str] | None = None, align: str = "none") -> Figure:
        """Draw the trajectories from above, and errors or standard deviations over time.

        Parameters
        ----------
        truth : path, optional
            Reference poses in any format that ``locatk eval`` reads; by default, those of the
            session.
        align : str
            One of :data:`locatk.core.evaluation.ALIGNMENTS`.
        """
        from locatk.formats.plots.picture import draw_picture

        subject = self._subject(truth, align)
        return draw_picture(self.result, subject.truth, subject.evaluation)

    def report(
        self,
        path: str | os.PathLike[str],
        *,
        truth: str | os.PathLike[str] | None = None,
        align: str = "none",
        overwrite: bool = False,
    ) -> Path:
        """Write the report of ``locatk report``, one HTML file; return its path.

        Raises
        ------
        OutputExistsError
            ``path`` exists and ``overwrite`` is false.
        """
        from locatk.formats.report.report import write_report

        write_report(path, [self._subject(truth, align)], overwrite=overwrite)
        return Path(path)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the solution as MCAP like ``locatk solve -o``; return its path.

        Raises
        ------
        OutputExistsError
            ``path`` exists and ``overwrite`` is false.
        """
        facts = {key: value for key, value in self.facts.items() if key in SOURCE_FACTS}
        source = self.facts.get("source", self.name)
        write_solution(path, self.result, source=source, facts=facts, overwrite=overwrite)
        return Path(path)

    def _subject(
        self,
        truth: str | os.PathLike[str] | None,
        align: str,
        offset_s: float | Literal["auto"] = 0.0,
    ) -> Subject:
        from locatk.formats.report.subject import make_subject

        return make_subject(
            self.name,
            self.result,
            self.facts,
            self.session,
            truth=truth,
            align=align,
            offset_s=offset_s,
        )

    def __repr__(self) -> str:
        devices = ", ".join(self.poses)
        if len(self.poses) > MAX_NAMES:
            devices = f"{len(self.poses)} devices"
        return (
            f"<Solution of {self.name}: {self.system} by {self.method}, "
            f"{self.result.poses} poses of {devices or 'no device'}>"
        )

    def _repr_html_(self) -> str:
        header = ("device", "poses", "from", "to", *(f"sigma {a} [mm]" for a in "xyz"))
        rows = []
        for device, trajectory in self.poses.items():
            span: list[str] = ["", ""]
            sigma: list[str] = ["", "", ""]
            if len(trajectory):
                ends = trajectory.time_ns[[0, -1]].astype("datetime64[ns]")
                span = [str(np.datetime64(end, "ms")) for end in ends]
                with np.errstate(invalid="ignore"):
                    median = 1e3 * np.median(trajectory.sigma[:, :3], axis=0)
                sigma = [f"{value:.3g}" if np.isfinite(value) else "-" for value in median]
            rows.append((device, str(len(trajectory)), *span, *sigma))
        notes = [(w.message,) for w in self.warnings]
        return tables.to_html(repr(self), header, rows) + (
            tables.to_html("", ("warnings",), notes) if notes else ""
        )


MAX_NAMES = 4
"""Most devices whose names are in the representation of a solution."""

SOURCE_FACTS = ("source", "source_bytes", "source_sha256")
"""Facts about the session of a solution, which are kept when it is saved."""


def require_poses(solution: Solution) -> dict[str, Trajectory]:
    """Return the poses of a solution.

    Raises
    ------
    InputError
        There are none.
    """
    if not solution.result.poses:
        raise InputError(f"{solution.name} has no poses")
    return solution.poses
