"""Trajectories from any file that contains some.

Sessions and solutions, TUM, KITTI, CSV, the formats of :data:`FORMATS` (motion capture systems,
EuRoC, and logs of a Crazyflie), bags of ROS, and MCAP files with messages of ROS or Foxglove.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.files import read_head, split_selection
from locatk.formats.importers.poses.kitti import KITTI_COLUMNS, read_kitti
from locatk.formats.importers.poses.rosbag import ROS1_MAGIC, SQLITE_MAGIC, is_bag_folder, read_bag
from locatk.formats.importers.poses.trajectory_csv import COLUMNS, read_csv
from locatk.formats.importers.poses.tum import TUM_COLUMNS, read_tum

if TYPE_CHECKING:
    from locatk.formats.sessions.reader import Session

ToolKind = Literal["motive", "vicon", "qualisys", "euroc", "crazyflie"]
Kind = Literal["solution", "session", "tum", "kitti", "csv", "bag", "mcap"] | ToolKind
Role = Literal["estimate", "truth", "onboard", "live"]

EVO_KINDS = ("tum", "kitti")
"""Formats that evo reads too; poses of two such files are associated as in evo."""

MCAP_MAGIC = b"\x89MCAP"

COMPRESSED_MAGICS = {b"\x1f\x8b": "gunzip", b"\x28\xb5\x2f\xfd": "unzstd"}
"""Beginnings of compressed files (gzip, zstd), and the program that unpacks them."""

HEAD_BYTES = 1 << 16
"""Beginning of a text file that has to contain the first row."""

KIND_HINT = (
    "Give a session or solution (.mcap), TUM, KITTI, CSV with time_s, EuRoC, a bag of ROS, a log "
    "of a Crazyflie, or an export of Motive, Vicon or Qualisys"
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
        "poses.motion_capture",
        "read_motive",
    ),
    TextFormat(
        "vicon",
        lambda lines: any(line.startswith("Frame,Sub Frame") for line in lines[:8]),
        "poses.motion_capture",
        "read_vicon",
    ),
    TextFormat(
        "qualisys",
        lambda lines: lines[0].startswith("NO_OF_FRAMES\t"),
        "poses.motion_capture",
        "read_qualisys",
    ),
    TextFormat(
        "euroc",
        lambda lines: lines[0].startswith("#timestamp") and lines[0].count(",") >= 7,
        "poses.euroc",
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
        ``"solution"``, ``"session"``, ``"tum"``, ``"kitti"``, ``"csv"``, one of :data:`FORMATS`,
        ``"bag"`` (ROS), or ``"mcap"`` (of another program).
    trajectories : list of Trajectory
        One for each device or topic.
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
        (:mod:`.trajectory_csv`), TUM (eight numbers a line), KITTI (twelve), or one of
        :data:`FORMATS`; a bag of ROS (:mod:`.rosbag`), or an MCAP file with messages of ROS or
        Foxglove (:mod:`.mcap_topics`).
        ``FILE#NAME`` selects the trajectory of this name.
    role : str
        For a file with solved poses and truth: ``"estimate"`` reads the poses, ``"truth"`` the
        truth. ``"onboard"`` reads the poses of a session that its devices estimated themselves,
        ``"live"`` those of ``locatk live``.

    Raises
    ------
    MissingDataError
        The file is missing.
    FormatError, InputError
        The file is of another kind, has no poses or none of this name, or is damaged.
    LocatkError
        A bag needs rosbags, which is not installed.
    """
    path, name = split_selection(Path(path))
    if is_bag_folder(path):
        return _read_bag(path, role, name)
    if path.is_dir():
        raise InputError("a folder instead of a file", file=path, hint=KIND_HINT)
    head = read_head(path, HEAD_BYTES)
    if head.startswith((SQLITE_MAGIC, ROS1_MAGIC)):
        return _read_bag(path, role, name)
    if head.startswith(MCAP_MAGIC):
        return _read_mcap(path, role, name)
    return _select(_read_text(path, head, role), name)


def _select(file: TrajectoryFile, name: str) -> TrajectoryFile:
    """Return the file with the trajectory of one device only, with all for an empty name."""
    chosen = [each for each in file.trajectories if name in ("", each.device)]
    if not chosen:
        names = ", ".join(each.device for each in file.trajectories)
        raise InputError(f"no poses of {name!r}", file=file.path, hint=f"It has {names}")
    return replace(file, trajectories=chosen)


def _read_bag(path: Path, role: Role, name: str) -> TrajectoryFile:
    _refuse_parts_of_sessions(path, role)
    trajectories, notes = read_bag(path, name)
    return TrajectoryFile(path, "bag", trajectories, True, notes)


def _refuse_parts_of_sessions(path: Path, role: Role) -> None:
    """Raise InputError if on-board or live poses are required: the file is no session."""
    if role == "onboard":
        raise InputError(
            "not a session: only sessions have on-board poses",
            file=path,
            hint="Give a session of `locatk import crazyflie-usd`, or omit --onboard",
        )
    if role == "live":
        raise InputError(
            "not a session: only sessions have live poses",
            file=path,
            hint="Give a session of `locatk live --record`, or omit --live",
        )


def _read_text(path: Path, head: bytes, role: Role) -> TrajectoryFile:
    _refuse_parts_of_sessions(path, role)
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
    for magic, program in COMPRESSED_MAGICS.items():
        if head.startswith(magic):
            raise FormatError("a compressed file", file=path, hint=f"Unpack it: `{program}`")
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


def _read_mcap(path: Path, role: Role, name: str) -> TrajectoryFile:
    # The MCAP reader is slow to import, and text files do not need it.
    from locatk.formats.sessions.reader import Session
    from locatk.formats.sessions.solutions import read_trajectories

    session = Session.open(path)
    kind: Kind = "solution" if session.facts.get("kind") == "solution" else "session"
    # Other solvers write poses into files that are not marked as solutions.
    has_poses = session.topics("/solution/", "locatk.PoseTrack") or session.topics(
        "/pose/", "foxglove.PoseInFrame"
    )
    if role in ("onboard", "live"):
        return _select(TrajectoryFile(path, kind, read_trajectories(path, role), True), name)
    if _is_foreign(session) and (name or not _has_topics_as_locatk(session, role)):
        from locatk.formats.importers.poses.mcap_topics import read_mcap_topics

        trajectories, notes = read_mcap_topics(session, name)
        return TrajectoryFile(path, "mcap", trajectories, True, notes)
    solved = kind == "solution" or (role == "estimate" and bool(has_poses))
    trajectories = read_trajectories(path, "solution" if solved else "truth")
    return _select(TrajectoryFile(path, kind, trajectories, solved), name)


def _is_foreign(session: Session) -> bool:
    """Return whether another program wrote a file, without messages of locatk."""
    has_own_schema = any(channel.schema.startswith("locatk.") for channel in session.channels)
    return not session.facts and not has_own_schema


def _has_topics_as_locatk(session: Session, role: Role) -> bool:
    """Return whether a file of another program has poses in topics with the names of locatk."""
    prefixes = ("/truth/",) if role == "truth" else ("/pose/", "/truth/")
    return any(
        channel.topic.startswith(prefixes)
        and (channel.schema, channel.encoding) == ("foxglove.PoseInFrame", "protobuf")
        for channel in session.channels
    )


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
