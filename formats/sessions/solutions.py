"""Solutions on disk: poses for programs and viewers, with all that the solver said."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.dots.results import DotDetection, DotFacts
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.results import LandmarkDetection, LandmarkFacts
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import Scene
from locatk.core.polaris.results import PolarisFacts, TagDetection
from locatk.core.polaris.tag import Tags
from locatk.core.solution import GenericRecord, Solution, SolverWarning, from_json, to_json
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import maps, sheets, tags
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.sessions import foxglove as viewers
from locatk.formats.sessions import point_clouds as viewer_points
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import (
    Timed,
    check_devices,
    read_poses,
    read_tracks,
    read_truth,
    track_messages,
    write_streams,
)
from locatk.formats.sessions.writer import SessionWriter

SOLUTION_FILE = "solution.json"
SOLUTION_VERSION = 1

ARTIFACTS: tuple[tuple[type, str, Callable[[Any], str]], ...] = (
    (Scene, artifacts.SCENE_FILE, artifacts.dumps_scene),
    (Manifest, sheets.SHEET_FILE, sheets.dumps_manifest),
    (Tags, tags.TAG_FILE, tags.dumps_tags),
    (FloorMap, maps.MAP_FILE, maps.dumps_map),
)
"""What a solution may stand on, and as what it is attached."""

RESULT_TYPES: dict[str, tuple[type, type]] = {
    "lighthouse": (StationDetection, LighthouseFacts),
    "dots": (DotDetection, DotFacts),
    "polaris": (TagDetection, PolarisFacts),
    "landmarks": (LandmarkDetection, LandmarkFacts),
}
"""Types of the detections and of the facts of each system."""

UNSPECIFIED = "unspecified"
"""Code of a warning of which the file has the message only (before ``warnings`` was written)."""

# Tuples, not unions, which isinstance takes twice as long for: there are a million values.
_PLAIN, _LISTS, _ARRAYS = (str, int), (list, tuple), (np.ndarray, np.generic)

_ENCODER = json.JSONEncoder(allow_nan=False)


def write_solution(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    source: str | os.PathLike[str],
    facts: Mapping[str, str] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a solution as MCAP; the topics are those of docs/formats.md.

    Parameters
    ----------
    path : path
        The output.
    solution : Solution
        What a solver answered; it may hold no poses at all.
    source : path
        The session that was solved; its name is kept.
    facts : mapping of str to str, optional
        What it was made from, for the metadata record ``locatk``: ``command``,
        ``source_bytes`` and more (:mod:`locatk.formats.pipeline.provenance`).
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    check_devices(solution.trajectories, "solved")
    artifact = solution.artifact
    starts = [int(t.time_ns[0]) for t in solution.trajectories if len(t) > 0]
    start = min(starts, default=0)
    name = Path(source).name
    record = {**(facts or {}), "method": solution.method, "source": name}
    with SessionWriter(
        path, kind="solution", system=solution.system, facts=record, overwrite=overwrite
    ) as writer:
        for kind, file, dumps in ARTIFACTS:
            if isinstance(artifact, kind):
                writer.attach_toml(file, dumps(artifact))
        text = _json(plain(_statement(solution, name)))
        writer.attach(SOLUTION_FILE, text.encode(), "application/json")
        streams = [iter(_once(solution, start))]
        for t in solution.trajectories:
            streams.append(track_messages(f"/solution/{t.device}", t))
            streams.append(viewers.poses(f"/pose/{t.device}", t))
            streams.append(viewers.transforms("/tf", t))
        write_streams(writer, streams)


def _statement(solution: Solution, source: str) -> dict[str, Any]:
    return {
        "version": SOLUTION_VERSION,
        "system": solution.system,
        "method": solution.method,
        "source": source,
        "devices": [
            {"device": t.device, "frame": t.frame, "poses": len(t)} for t in solution.trajectories
        ],
        "rejected": solution.rejected,
        "notes": [warning.message for warning in solution.warnings],
        "warnings": to_json(solution.warnings),
        "facts": {} if solution.facts is None else to_json(solution.facts),
        "detections": to_json(solution.detections),
    }


def _json(value: Any, depth: int = 0) -> str:
    """JSON text with a line for each key of the upper levels and for each entry of a list of
    objects: there may be 100,000 of them, which an indented text makes three times slower."""
    space, below = "\n" + " " * depth, "\n" + " " * (depth + 1)
    if isinstance(value, dict) and value and depth < 2:
        pairs = (f"{json.dumps(key)}: {_json(item, depth + 1)}" for key, item in value.items())
        return "{" + below + ("," + below).join(pairs) + space + "}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        items = (_ENCODER.encode(item) for item in value)
        return "[" + below + ("," + below).join(items) + space + "]"
    return _ENCODER.encode(value)


def _once(solution: Solution, start: int) -> list[Timed]:
    """What is said once, at the start: the artifact, whole paths, the log."""
    scene = viewers.scene_update(solution.artifact, solution.trajectories, start)
    said: list[Timed] = [(start, "/scene", scene)]
    for frame, cloud in viewer_points.artifact_points(scene, start).items():
        said.append((start, f"/artifact_points/{frame}", cloud))
    for number, t in enumerate(solution.trajectories):
        if len(t) > 0:
            said.append((start, f"/path/{t.device}", viewers.path(t, start)))
            points = viewer_points.path_points(t, number, start)
            said.append((start, f"/path_points/{t.device}", points))
    for warning in solution.warnings:
        said.append((start, "/log", viewers.log(warning.message, start)))
    for reason, count in solution.rejected.items():
        if count:
            line = viewers.log(f"rejected {count}: {reason}", start, warning=True)
            said.append((start, "/log", line))
    return said


def read_solution(path: str | os.PathLike[str]) -> Solution:
    """The solution that :func:`write_solution` wrote.

    Raises
    ------
    MissingDataError, FormatError
        See :meth:`Session.open`; also where the file holds no solution.
    """
    session = Session.open(path)
    data = session.attachment(SOLUTION_FILE)
    if data is None:
        raise FormatError(
            "no solution", file=path, hint="Give a file that `locatk solve` has written"
        )
    try:
        said = json.loads(data)
        if said["version"] > SOLUTION_VERSION:
            raise FormatError(
                f"solution of format {said['version']}, newer than this locatk",
                file=path,
                where=SOLUTION_FILE,
                hint="Update locatk",
            )
        system = str(said["system"])
        detection_type, facts_type = RESULT_TYPES.get(system, (GenericRecord, GenericRecord))
        return Solution(
            system=system,
            method=str(said["method"]),
            trajectories=_trajectories(session, said["devices"]),
            rejected={str(key): int(count) for key, count in said["rejected"].items()},
            detections=tuple(from_json(detection_type, each) for each in said["detections"]),
            artifact=artifacts.attached_scene(session)
            or sheets.attached_manifest(session)
            or tags.attached_tags(session)
            or maps.attached_map(session),
            warnings=_warnings(said),
            facts=from_json(facts_type, said["facts"]) if said["facts"] else None,
        )
    except LocatkError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError):
        raise FormatError("damaged solution", file=path, where=SOLUTION_FILE) from None


def _warnings(statement: Mapping[str, Any]) -> tuple[SolverWarning, ...]:
    """Return the warnings of ``solution.json``; earlier versions have their messages only."""
    if "warnings" not in statement:
        return tuple(SolverWarning(UNSPECIFIED, str(note)) for note in statement["notes"])
    return tuple(from_json(SolverWarning, each) for each in statement["warnings"])


def _trajectories(session: Session, devices: list[dict[str, Any]]) -> tuple[Trajectory, ...]:
    """Trajectories in the solver's order; those without a pose have no messages."""
    tracks = {track.device: track for track in read_tracks(session, "/solution/")}
    found = []
    for entry in devices:
        device, frame = str(entry["device"]), str(entry["frame"])
        nothing = np.zeros(0, np.int64)
        track = tracks.get(device)
        if track is None:
            track = Trajectory.from_positions(device, frame, nothing, np.zeros((0, 3)))
        if len(track) != entry["poses"]:
            raise FormatError(
                f"{len(track)} poses of {device} where there were {entry['poses']}",
                file=session.path,
                where=f"/solution/{device}",
            )
        found.append(track)
    return tuple(found)


def read_trajectories(path: str | os.PathLike[str], kind: str = "auto") -> list[Trajectory]:
    """Trajectories of a solution or a session, one a device, sorted by device.

    Parameters
    ----------
    path : path
        An MCAP file.
    kind : {"auto", "solution", "truth"}
        Solved poses (``/solution/``, else ``PoseInFrame`` on ``/pose/``), reference
        poses (``/truth``), or what there is, in this order.

    Raises
    ------
    FormatError
        There are none of this kind.
    """
    if kind not in ("auto", "solution", "truth"):
        raise ValueError(f"kind is {kind!r}")
    session = Session.open(path)
    found: list[Trajectory] = []
    if kind != "truth":
        found = read_tracks(session, "/solution/") or read_poses(session, "/pose/")
    if not found and kind != "solution":
        found = read_truth(session)
    if not found:
        hints = {
            "auto": "solve it first: `locatk solve`",
            "solution": "solve it first: `locatk solve`",
            "truth": "import it with its reference: `locatk import ... --truth`",
        }
        what = {"auto": "poses", "solution": "solved poses", "truth": "reference poses"}[kind]
        raise FormatError(f"no {what}", file=path, hint=hints[kind])
    return sorted(found, key=lambda trajectory: trajectory.device)


def plain(value: Any) -> Any:
    """``value`` in types that JSON knows: numpy numbers and arrays resolved, nan as null.

    Raises
    ------
    InputError
        It holds something that JSON cannot say.
    """
    if value is None or isinstance(value, _PLAIN):
        return value
    if isinstance(value, float):  # numpy's float64 too
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, _LISTS):
        return [plain(item) for item in value]
    if isinstance(value, _ARRAYS):
        return plain(value.tolist())
    raise InputError(f"a {type(value).__name__} cannot be written as JSON")
