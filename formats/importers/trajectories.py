"""Trajectories from any file that contains some.

Sessions and solutions, TUM, KITTI, CSV, and the formats of :data:`FORMATS`: motion capture systems,
EuRoC, and logs of a Crazyflie.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.files import read_head
from locatk.formats.importers.kitti import KITTI_COLUMNS, read_kitti
from locatk.formats.importers.trajectory_csv import COLUMNS, read_csv
from locatk.formats.importers.tum import TUM_COLUMNS, read_tum

ToolKind = Literal["motive", "vicon", "qualisys", "euroc", "crazyflie"]
Kind = Literal["solution", "session", "tum", "kitti", "csv"] | ToolKind
Role = Literal["estimate", "truth", "onboard"]

EVO_KINDS = ("tum", "kitti")
"""Formats that evo reads too; poses of two such files are associated as in evo."""

MCAP_MAGIC = b"\x89MCAP"

GZIP_MAGIC = b"\x1f\x8b"

HEAD_BYTES = 1 << 16
"""Beginning of a text file that has to contain the first row."""

KIND_HINT = (
    "Give a session or solution (.mcap), TUM, KITTI, CSV with time_s, EuRoC, a log of a Crazyflie, "
    "or an export of Motive, Vicon or Qualisys"
)

Content = tuple[list[Trajectory], tuple[str, ...]]
"""Trajectories, and notes on assumptions."""


class TextFormat(NamedTuple):
    """Text of another tool.

    Attributes
    ----------
    kind : str
    is_format : callable
        Whether the first lines are of this format.
    module, reader : str
        Module and name of the function that returns the :data:`Content` of a file. It is imported
        when it is used: it needs scipy, which takes long.
    """

    kind: ToolKind
    is_format: Callable[[Sequence[str]], bool]
    module: str
    reader: str

    def read(self, path: Path) -> Content:
        """Return trajectories and notes; see the reader for errors."""
        module = importlib.import_module(f"locatk.formats.importers.{self.module}")
        content: Content = getattr(module, self.reader)(path)
        return content


FORMATS = (
    TextFormat(
        "motive",
        lambda lines: lines[0].startswith("Format Version,"),
        "motion_capture",
        "read_motive",
    ),
    TextFormat(
        "vicon",
        lambda lines: any(line.startswith("Frame,Sub Frame") for line in lines[:8]),
        "motion_capture",
        "read_vicon",
    ),
    TextFormat(
        "qualisys",
        lambda lines: lines[0].startswith("NO_OF_FRAMES\t"),
        "motion_capture",
        "read_qualisys",
    ),
    TextFormat(
        "euroc",
        lambda lines: lines[0].startswith("#timestamp") and lines[0].count(",") >= 7,
        "euroc",
        "read_euroc",
    ),
    TextFormat(
        "crazyflie",
        lambda lines: "," in lines[0] and "stateestimate." in lines[0].lower(),
        "crazyflie_csv",
        "read_estimate",
    ),
)
"""Formats of other tools, in the order in which they are tried."""


@dataclass(frozen=True)
class TrajectoryFile:
    """Trajectories of a file.

    Attributes
    ----------
    path : Path
    kind : str
        ``"solution"``, ``"session"``, ``"tum"``, ``"kitti"``, ``"csv"``, or one of :data:`FORMATS`.
    trajectories : list of Trajectory
        One a device.
    solved : bool
        False if they are the truth of a session.
    notes : tuple of str
        Assumptions about axes and clocks.
    """

    path: Path
    kind: Kind
    trajectories: list[Trajectory]
    solved: bool
    notes: tuple[str, ...] = ()


def read(path: Path, *, role: Role = "estimate") -> list[Trajectory]:
    """Read the trajectories of a file, one a device; see :func:`open_file`."""
    return open_file(path, role=role).trajectories


def open_file(path: Path, *, role: Role = "estimate") -> TrajectoryFile:
    """Read the trajectories of a file, whose kind is detected from its content.

    Parameters
    ----------
    path : path
        A session (its truth), a solution (its poses), or text: CSV with a header
        (:func:`~locatk.formats.importers.trajectory_csv.read_csv`), TUM (eight numbers a line),
        KITTI (twelve), or one of :data:`FORMATS`.
    role : str
        For a file with solved poses and truth: ``"estimate"`` reads the poses, ``"truth"`` the
        truth. ``"onboard"`` reads the poses of a session that its devices estimated themselves.

    Raises
    ------
    MissingDataError
        The file is missing.
    FormatError, InputError
        The file is of another kind, has no poses, or is damaged.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError("a folder instead of a file", file=path, hint=KIND_HINT)
    head = read_head(path, HEAD_BYTES)
    if head.startswith(MCAP_MAGIC):
        return _read_mcap(path, role)
    if role == "onboard":
        raise InputError(
            "not a session: only sessions have on-board poses",
            file=path,
            hint="Give a session of `locatk import crazyflie-usd`, or omit --onboard",
        )
    lines = _lines_of(path, head)
    for each in FORMATS:
        if each.is_format(lines):
            trajectories, notes = each.read(path)
            if not trajectories:
                raise FormatError("no poses", file=path, hint=KIND_HINT)
            return TrajectoryFile(path, each.kind, trajectories, True, notes)
    kind = _kind_of_text(path, lines)
    if kind == "csv":
        return TrajectoryFile(path, kind, read_csv(path), True)
    trajectory = read_tum(path) if kind == "tum" else read_kitti(path)
    return TrajectoryFile(path, kind, [trajectory], True)


def _lines_of(path: Path, head: bytes) -> list[str]:
    """Return the first lines of a text.

    Raises
    ------
    FormatError
        The file is empty or compressed.
    """
    if not head.strip():
        raise FormatError("an empty file", file=path, hint=KIND_HINT)
    if head.startswith(GZIP_MAGIC):
        raise FormatError("a compressed file", file=path, hint="Unpack it: `gunzip`")
    return head.decode("utf-8-sig", "replace").lstrip("\r\n").splitlines() or [""]


def _kind_of_text(path: Path, lines: Sequence[str]) -> Literal["tum", "kitti", "csv"]:
    """Detect the kind from the first row that is not a comment."""
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if "," in line:
            if COLUMNS[0] in line.lower():
                return "csv"
            raise FormatError(
                f"column {COLUMNS[0]!r} is missing",
                file=path,
                where=number,
                hint=f"The header is {','.join(COLUMNS[:9])},...",
            )
        if len(words) == len(TUM_COLUMNS):
            return "tum"
        if len(words) == len(KITTI_COLUMNS):
            return "kitti"
        break
    else:
        raise FormatError("no poses", file=path, hint=KIND_HINT)
    raise FormatError(
        f"neither a session nor poses: the first row has {len(words)} word{'s' * (len(words) > 1)}",
        file=path,
        where=number,
        hint="TUM has 8 numbers a row, KITTI 12, and CSV a header with time_s",
    )


def _read_mcap(path: Path, role: Role) -> TrajectoryFile:
    # The MCAP reader is slow to import, and text files do not need it.
    from locatk.formats.sessions.reader import Session
    from locatk.formats.sessions.solutions import read_trajectories

    session = Session.open(path)
    kind: Kind = "solution" if session.facts.get("kind") == "solution" else "session"
    # Other solvers write poses into files that are not marked as solutions.
    has_poses = session.topics("/solution/", "locatk.PoseTrack") or session.topics(
        "/pose/", "foxglove.PoseInFrame"
    )
    if role == "onboard":
        return TrajectoryFile(path, kind, read_trajectories(path, "onboard"), True)
    solved = kind == "solution" or (role == "estimate" and bool(has_poses))
    trajectories = read_trajectories(path, "solution" if solved else "truth")
    return TrajectoryFile(path, kind, trajectories, solved)


def check_kinds(estimate: TrajectoryFile, truth: TrajectoryFile) -> None:
    """Refuse to compare a file without times (KITTI) with a file with times.

    Raises
    ------
    InputError
        Only one of them is KITTI, or both are and differ in their number of rows.
    """
    if (estimate.kind == "kitti") != (truth.kind == "kitti"):
        timeless, other = (estimate, truth) if estimate.kind == "kitti" else (truth, estimate)
        raise InputError(
            f"KITTI has no times, and {other.path.name} is not a KITTI file",
            file=timeless.path,
            hint="Give two KITTI files with the same rows, or write this one as TUM",
        )
    if estimate.kind == "kitti":
        rows, true_rows = (sum(map(len, each.trajectories)) for each in (estimate, truth))
        if rows != true_rows:
            raise InputError(
                f"{rows} rows, but {truth.path.name} has {true_rows}",
                file=estimate.path,
                hint="KITTI files are compared row by row: give as many rows in both",
            )
