"""Solutions on disk: poses for programs and viewers, and the complete result of the solver."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import Message

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
from locatk.formats.artifacts.maps import MAP
from locatk.formats.artifacts.scene import SCENE
from locatk.formats.artifacts.schema import Artifact
from locatk.formats.artifacts.sheets import MANIFEST
from locatk.formats.artifacts.tags import TAGS
from locatk.formats.sessions import foxglove
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import (
    check_devices,
    read_live,
    read_onboard,
    read_poses,
    read_tracks,
    read_truth,
    track_messages,
    write_streams,
)
from locatk.formats.sessions.writer import SessionWriter

SOLUTION_FILE = "solution.json"
SOLUTION_VERSION = 1

ARTIFACTS: tuple[tuple[type, Artifact[Any]], ...] = (
    (Scene, SCENE),
    (Manifest, MANIFEST),
    (Tags, TAGS),
    (FloorMap, MAP),
)
"""Types of the artifacts that a solution can refer to, and their TOML files."""

RESULT_TYPES: dict[str, tuple[type, type]] = {
    "lighthouse": (StationDetection, LighthouseFacts),
    "dots": (DotDetection, DotFacts),
    "polaris": (TagDetection, PolarisFacts),
    "landmarks": (LandmarkDetection, LandmarkFacts),
}
"""Types of the detections and of the facts of each system."""

UNSPECIFIED = "unspecified"
"""Code of warnings in files of earlier versions, which contain the messages only."""

# Tuples, because isinstance is twice as slow with unions, and there can be a million values.
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
    """Write a solution as MCAP, with the topics of docs/formats.md.

    Parameters
    ----------
    path : path
        The output.
    solution : Solution
        Result of a solver; it may have no poses.
    source : path
        The session that was solved; its name is stored.
    facts : mapping of str to str, optional
        Origin of the solution, for the metadata record ``locatk``: ``command``,
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
    start_ns = min(starts, default=0)
    name = Path(source).name
    record = {**(facts or {}), "method": solution.method, "source": name}
    provisional = [t.device for t in solution.trajectories if t.is_provisional]
    if provisional:
        record["provisional"] = ", ".join(provisional)
    with SessionWriter(
        path, kind="solution", system=solution.system, facts=record, overwrite=overwrite
    ) as writer:
        for kind, toml_file in ARTIFACTS:
            if isinstance(artifact, kind):
                writer.attach_toml(toml_file.file, toml_file.dumps(artifact))
        text = _encode(plain(_solution_record(solution, name)))
        writer.attach(SOLUTION_FILE, text.encode(), "application/json")
        for topic, message in _static_messages(solution, start_ns):
            writer.write(topic, message, start_ns)
        streams = []
        for t in solution.trajectories:
            streams.append(track_messages(f"/solution/{t.device}", t))
            streams.append(foxglove.poses(f"/pose/{t.device}", t))
            streams.append(foxglove.transforms("/tf", t))
        write_streams(writer, streams)


def _solution_record(solution: Solution, source: str) -> dict[str, Any]:
    """Return the content of ``solution.json``."""
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


def _encode(value: Any, depth: int = 0) -> str:
    """Return JSON with a line for each key of the upper levels and each object of a list.

    There can be 100,000 objects; with ``indent`` the standard encoder is three times slower.
    """
    end, separator = "\n" + " " * depth, "\n" + " " * (depth + 1)
    if isinstance(value, dict) and value and depth < 2:
        pairs = (f"{json.dumps(key)}: {_encode(item, depth + 1)}" for key, item in value.items())
        return "{" + separator + ("," + separator).join(pairs) + end + "}"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        items = (_ENCODER.encode(item) for item in value)
        return "[" + separator + ("," + separator).join(items) + end + "]"
    return _ENCODER.encode(value)


def _static_messages(solution: Solution, start_ns: int) -> list[tuple[str, Message]]:
    """Return topics and messages at the start: the artifact, whole paths, the log."""
    scene = foxglove.scene_update(solution.artifact, solution.trajectories, start_ns)
    messages: list[tuple[str, Message]] = [("/scene", scene)]
    for frame, cloud in foxglove.artifact_points(scene, start_ns).items():
        messages.append((f"/artifact_points/{frame}", cloud))
    for number, t in enumerate(solution.trajectories):
        if len(t) > 0:
            messages.append((f"/path/{t.device}", foxglove.path(t, start_ns)))
            points = foxglove.path_points(t, number, start_ns)
            messages.append((f"/path_points/{t.device}", points))
    for warning in solution.warnings:
        messages.append(("/log", foxglove.log(warning.message, start_ns)))
    for reason, count in solution.rejected.items():
        if count:
            line = foxglove.log(f"rejected {count}: {reason}", start_ns, warning=True)
            messages.append(("/log", line))
    return messages


def read_solution(path: str | os.PathLike[str]) -> Solution:
    """Read a solution that :func:`write_solution` wrote.

    Raises
    ------
    MissingDataError, FormatError
        See :meth:`Session.open`; FormatError also if the file contains no solution.
    """
    session = Session.open(path)
    data = session.attachment(SOLUTION_FILE)
    if data is None:
        raise FormatError("no solution", file=path, hint="Give a file written by `locatk solve`")
    try:
        record = json.loads(data)
        if record["version"] > SOLUTION_VERSION:
            raise FormatError(
                f"solution of format {record['version']}, newer than this locatk",
                file=path,
                where=SOLUTION_FILE,
                hint="Update locatk",
            )
        system = str(record["system"])
        detection_type, facts_type = RESULT_TYPES.get(system, (GenericRecord, GenericRecord))
        attached = (toml_file.attached(session) for _, toml_file in ARTIFACTS)
        return Solution(
            system=system,
            method=str(record["method"]),
            trajectories=_trajectories(session, record["devices"]),
            rejected={str(key): int(count) for key, count in record["rejected"].items()},
            detections=tuple(from_json(detection_type, each) for each in record["detections"]),
            artifact=next((item for item in attached if item is not None), None),
            warnings=_warnings(record),
            facts=from_json(facts_type, record["facts"]) if record["facts"] else None,
        )
    except LocatkError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise FormatError("damaged solution", file=path, where=SOLUTION_FILE) from None


def _warnings(record: Mapping[str, Any]) -> tuple[SolverWarning, ...]:
    """Return the warnings of ``solution.json``; earlier versions have their messages only."""
    if "warnings" not in record:
        return tuple(SolverWarning(UNSPECIFIED, str(note)) for note in record["notes"])
    return tuple(from_json(SolverWarning, each) for each in record["warnings"])


def _trajectories(session: Session, devices: list[dict[str, Any]]) -> tuple[Trajectory, ...]:
    """Return the trajectories in the solver's order; those without a pose have no messages."""
    tracks = {track.device: track for track in read_tracks(session, "/solution/")}
    trajectories = []
    for entry in devices:
        device, frame = str(entry["device"]), str(entry["frame"])
        track = tracks.get(device)
        if track is None:
            no_time_ns = np.zeros(0, np.int64)
            track = Trajectory.from_positions(device, frame, no_time_ns, np.zeros((0, 3)))
        if len(track) != entry["poses"]:
            raise FormatError(
                f"{len(track)} poses of {device} instead of {entry['poses']}",
                file=session.path,
                where=f"/solution/{device}",
            )
        trajectories.append(track)
    return tuple(trajectories)


def read_trajectories(path: str | os.PathLike[str], kind: str = "auto") -> list[Trajectory]:
    """Read the trajectories of a solution or a session, one per device, sorted by device.

    Parameters
    ----------
    path : path
        An MCAP file.
    kind : {"auto", "solution", "truth", "onboard", "live"}
        Solved poses (``/solution/``, else ``PoseInFrame`` on ``/pose/``), reference
        poses (``/truth``), or the first of them that exists; or the poses that the devices
        estimated themselves (``/onboard_track/``), or those of ``locatk live``
        (``/live_track/``).

    Raises
    ------
    FormatError
        There are none of this kind.
    """
    if kind not in ("auto", "solution", "truth", "onboard", "live"):
        raise ValueError(f"kind is {kind!r}")
    session = Session.open(path)
    found: list[Trajectory] = []
    if kind == "onboard":
        found = read_onboard(session)
    elif kind == "live":
        found = read_live(session)
    elif kind != "truth":
        found = read_tracks(session, "/solution/") or read_poses(session, "/pose/")
    if not found and kind in ("auto", "truth"):
        found = read_truth(session)
    if not found:
        hints = {
            "auto": "Solve it first: `locatk solve`",
            "solution": "Solve it first: `locatk solve`",
            "truth": "Import it with its reference: `locatk import ... --truth`",
            "onboard": "Log stateEstimate on the device, and import the log",
            "live": "Record it with `locatk live --record`",
        }
        what = {
            "auto": "poses",
            "solution": "solved poses",
            "truth": "reference poses",
            "onboard": "on-board poses",
            "live": "live poses",
        }[kind]
        raise FormatError(f"no {what}", file=path, hint=hints[kind])
    return sorted(found, key=lambda trajectory: trajectory.device)


def plain(value: Any) -> Any:
    """Convert ``value`` to types of JSON: numpy numbers and arrays to Python's, nan to null.

    Raises
    ------
    InputError
        It contains another type.
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
