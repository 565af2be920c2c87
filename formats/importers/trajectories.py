"""Trajectories from any file that holds some: a session, a solution, TUM, KITTI or CSV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters import trajectory_text as trajectories
from locatk.formats.files import read_bytes

Kind = Literal["solution", "session", "tum", "kitti", "csv"]
Role = Literal["estimate", "truth"]

EVO_KINDS = ("tum", "kitti")
"""What evo reads too; with two of these, poses are matched as evo does."""

MCAP_MAGIC = b"\x89MCAP"

GZIP_MAGIC = b"\x1f\x8b"

HEAD = 1 << 16
"""Bytes in which the first row of a text must be."""

HINT = "Give a session or solution (.mcap), or a TUM, KITTI or CSV file"


@dataclass(frozen=True)
class TrajectoryFile:
    """What a file holds.

    Attributes
    ----------
    path : Path
    kind : str
        ``"solution"``, ``"session"``, ``"tum"``, ``"kitti"`` or ``"csv"``.
    trajectories : list of Trajectory
        One a device.
    solved : bool
        Whether they are poses that somebody found; False for the truth of a session.
    """

    path: Path
    kind: Kind
    trajectories: list[Trajectory]
    solved: bool


def read(path: Path, *, role: Role = "estimate") -> list[Trajectory]:
    """Trajectories of a file, one a device; see :func:`open_file`."""
    return open_file(path, role=role).trajectories


def open_file(path: Path, *, role: Role = "estimate") -> TrajectoryFile:
    """Trajectories of a file, found by what it holds.

    Parameters
    ----------
    path : path
        A session (its truth), a solution (its poses), or text: CSV with a header as
        :func:`locatk.formats.exporters.trajectory_text.write_csv` writes it, TUM (eight numbers
        a line) or KITTI (twelve).
    role : str
        An ``"estimate"`` is the solved poses of a file that holds solved poses and truth, a
        ``"truth"`` its truth.

    Raises
    ------
    MissingDataError
        There is no such file.
    FormatError, InputError
        It is none of these, holds no poses, or is damaged.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError("a folder where a file is expected", file=path, hint=HINT)
    head = read_bytes(path, HEAD)
    if head.startswith(MCAP_MAGIC):
        return _mcap(path, role)
    kind = _kind_of_text(path, head)
    if kind == "csv":
        return TrajectoryFile(path, kind, trajectories.read_csv(path), True)
    one = trajectories.read_tum if kind == "tum" else trajectories.read_kitti
    return TrajectoryFile(path, kind, [one(path)], True)


def _kind_of_text(path: Path, head: bytes) -> Literal["tum", "kitti", "csv"]:
    """By the first row that is no comment."""
    if not head.strip():
        raise FormatError("an empty file", file=path, hint=HINT)
    if head.startswith(GZIP_MAGIC):
        raise FormatError("a compressed file", file=path, hint="Unpack it: `gunzip`")
    lines = head.decode("utf-8-sig", "replace").splitlines()
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if "," in line:
            if "time_s" in line.lower():
                return "csv"
            raise FormatError(
                "a table without the column 'time_s'",
                file=path,
                where=number,
                hint=f"The header is {','.join(trajectories.COLUMNS[:9])},...",
            )
        if len(words) == 8:
            return "tum"
        if len(words) == 12:
            return "kitti"
        break
    else:
        raise FormatError("no poses", file=path, hint=HINT)
    raise FormatError(
        "neither a session nor poses: the first row has "
        + (f"{len(words)} words" if len(words) > 1 else "one word"),
        file=path,
        where=number,
        hint="TUM has 8 numbers a row, KITTI 12, and CSV a header with time_s",
    )


def _mcap(path: Path, role: Role) -> TrajectoryFile:
    from locatk.formats.sessions.reader import Session
    from locatk.formats.sessions.solutions import read_trajectories

    kind: Kind = "solution" if Session.open(path).facts.get("kind") == "solution" else "session"
    solved = kind == "solution" or (role == "estimate" and _holds_poses(path))
    found = read_trajectories(path, "solution" if solved else "truth")
    return TrajectoryFile(path, kind, found, solved)


def _holds_poses(path: Path) -> bool:
    """Whether a file that no solver of locatk wrote holds solved poses."""
    from locatk.formats.sessions.reader import Session

    session = Session.open(path)
    return bool(
        session.topics("/solution/", "locatk.PoseTrack")
        or session.topics("/pose/", "foxglove.PoseInFrame")
    )


def check_kinds(estimate: TrajectoryFile, truth: TrajectoryFile) -> None:
    """Refuse to compare a file without times (KITTI) with one that has times.

    Raises
    ------
    InputError
        Only one is KITTI, or they have not as many rows.
    """
    if (estimate.kind == "kitti") != (truth.kind == "kitti"):
        timeless, other = (estimate, truth) if estimate.kind == "kitti" else (truth, estimate)
        raise InputError(
            f"KITTI tells no times, and {other.path.name} is no KITTI file",
            file=timeless.path,
            hint="Give two KITTI files of the same rows, or write this one as TUM",
        )
    if estimate.kind == "kitti":
        mine, true = (_rows(each.trajectories) for each in (estimate, truth))
        if mine != true:
            raise InputError(
                f"{mine} rows, where {truth.path.name} has {true}",
                file=estimate.path,
                hint="Rows of KITTI files belong to each other one by one: give as many of both",
            )


def _rows(found: Sequence[Trajectory]) -> int:
    return sum(len(each) for each in found)
