"""What a session holds, for a solver: sweeps, samples, frames, truth, odometry, artifacts.

Solutions and trajectories have modules of their own; what a caller needs of them is
offered here too.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from locatk.core.errors import FormatError
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import receiver as receiver_files
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.artifacts.maps import attached_map as read_map
from locatk.formats.artifacts.receiver import read_receivers
from locatk.formats.artifacts.scene import attached_scene as read_scene
from locatk.formats.artifacts.sheets import attached_camera as read_camera
from locatk.formats.artifacts.sheets import attached_manifest as read_manifest
from locatk.formats.artifacts.tags import attached_tags as read_tags
from locatk.formats.sessions import station_reports as heard_stations
from locatk.formats.sessions.frames import read_frames
from locatk.formats.sessions.halls import read_samples as read_halls
from locatk.formats.sessions.magnetometers import read_samples
from locatk.formats.sessions.messages import SWEEPS, batch_edges
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution, read_trajectories, write_solution
from locatk.formats.sessions.station_reports import read_heard
from locatk.formats.sessions.trajectories import (
    LARGEST_BATCH,
    Timed,
    known_streams,
    read_batches,
    read_odometry,
    read_truth,
    write_streams,
)
from locatk.formats.sessions.writer import SessionWriter

__all__ = [
    "read_camera",
    "read_frames",
    "read_halls",
    "read_heard",
    "read_manifest",
    "read_map",
    "read_odometry",
    "read_receivers",
    "read_samples",
    "read_scene",
    "read_solution",
    "read_sweeps",
    "read_tags",
    "read_trajectories",
    "read_truth",
    "sweep_messages",
    "write_session",
    "write_solution",
    "write_sweeps",
]

BATCH_NS = 500_000_000
"""Longest time that one message of an imported or simulated session covers."""


def read_sweeps(session: Session) -> Sweeps:
    """All lighthouse sweeps of a session, in the order of the file.

    Raises
    ------
    FormatError
        There are none, a message is damaged, or a value is outside its range.
    """
    topics = session.topics("/lighthouse/", "locatk.LighthouseSweep")
    if not topics:
        raise FormatError(
            "no lighthouse sweeps (topic /lighthouse/<device>)"
            if session.facts
            else "not a session of locatk: no topic /lighthouse/<device>",
            file=session.path,
            hint=_contents(session),
        )
    batches = read_batches(session, topics, SWEEPS)
    names = batches.texts["device"]
    devices = tuple(dict.fromkeys(names))
    numbers = {name: number for number, name in enumerate(devices)}
    device = np.array([numbers[name] for name in names], np.int32).repeat(batches.counts)
    columns = batches.columns
    sweeps = Sweeps(
        devices=devices,
        time_ns=columns["time_ns"],
        device=device,
        sensor=columns["sensor"],
        channel=columns["channel"],
        polynomial=columns["polynomial"],
        sweep=columns["sweep"],
        count=columns["count"],
    )
    _check_ranges(sweeps, session.path)
    return sweeps


def _check_ranges(sweeps: Sweeps, path: str | None) -> None:
    allowed = {
        "time_ns": (0, np.iinfo(np.int64).max),
        "sensor": (0, np.iinfo(np.int32).max),
        "channel": (1, 16),
        "polynomial": (-1, 31),
        "sweep": (-1, 1),
    }
    for name, (low, high) in allowed.items():
        values = getattr(sweeps, name)
        if len(values) and (values.min() < low or values.max() > high):
            bad = values[(values < low) | (values > high)][0]
            raise FormatError(
                f"{name} {bad} of a sweep is not in {low}..{high}", file=path, where="/lighthouse"
            )


def sweep_messages(sweeps: Sweeps, *, batch_ns: int = BATCH_NS) -> Iterator[Timed]:
    """Batches of ``sweeps`` by device and time, ascending in the time of their first."""
    _check_ranges(sweeps, None)
    order = np.lexsort((sweeps.time_ns, sweeps.device))
    columns = {
        column.name: getattr(sweeps, column.name)[order]
        for column in SWEEPS.columns
        if not column.optional
    }
    device = sweeps.device[order]
    edges = batch_edges(columns["time_ns"], device, batch_ns, LARGEST_BATCH)
    starts, stops = edges[:-1], edges[1:]
    for number in np.argsort(columns["time_ns"][starts], kind="stable"):
        part = slice(starts[number], stops[number])
        name = sweeps.devices[device[starts[number]]]
        message = SWEEPS.pack({"device": name}, {key: c[part] for key, c in columns.items()})
        yield int(columns["time_ns"][part.start]), f"/lighthouse/{name}", message


def write_sweeps(writer: SessionWriter, sweeps: Sweeps, *, batch_ns: int = BATCH_NS) -> None:
    """Write ``sweeps`` on ``/lighthouse/<device>``, batched by device and time.

    ``batch_ns`` is the time that one message covers, in nanoseconds.
    """
    for time_ns, topic, message in sweep_messages(sweeps, batch_ns=batch_ns):
        writer.write(topic, message, time_ns)


def write_session(
    path: str | os.PathLike[str],
    *,
    system: str,
    sweeps: Sweeps,
    truth: Sequence[Trajectory] = (),
    odometry: Sequence[Trajectory] = (),
    scene: Scene | None = None,
    facts: Mapping[str, object] | None = None,
    stations: Sequence[StationReport] = (),
    receivers: Mapping[str, Receiver] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a session of sweeps with what is known beside them.

    Parameters
    ----------
    path : path
        The output.
    system : str
        ``"lighthouse"``.
    sweeps : Sweeps
        The observations, on ``/lighthouse/<device>``.
    truth : sequence of Trajectory
        Reference poses: exact on ``/truth_track/<device>``, one message a pose for
        viewers on ``/truth/<device>``.
    odometry : sequence of Trajectory
        Its plane part (x, y, heading) is written, on ``/odometry/<device>``.
    scene : Scene, optional
        Attached as ``scene.toml``.
    facts : mapping, optional
        Where the data comes from; written as texts to the metadata record ``facts``.
    stations : sequence of StationReport
        What was measured of each station, in a metadata record ``station-<channel>`` each.
        Calibrations and serial numbers that they sent go into the scene, where it has none of
        its own for their channels.
    receivers : mapping of str to Receiver, optional
        By device; attached as ``receiver.toml``, or where the devices differ as
        ``receiver-<device>.toml`` each.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    InputError
        A time is before 1970, two trajectories have the same device or two stations the same
        channel, or a receiver cannot be.
    """
    records = heard_stations.records_of(stations)
    scene = heard_stations.with_heard(scene, stations)
    devices = {sweeps.devices[number] for number in np.unique(sweeps.device).tolist()}
    places = receiver_files.receiver_attachments(receivers or {}, devices)
    streams = [sweep_messages(sweeps), *known_streams(truth, odometry)]
    with SessionWriter(path, system=system, overwrite=overwrite) as writer:
        writer.facts(facts)
        if scene is not None:
            writer.attach_toml(artifacts.SCENE_FILE, artifacts.dumps_scene(scene))
        for name, text in places.items():
            writer.attach_toml(name, text)
        for name, record in records.items():
            writer.metadata(name, record)
        write_streams(writer, streams)


def _contents(session: Session) -> str:
    topics = [channel.topic for channel in session.channels]
    if not topics:
        return "the file holds no messages at all"
    more = "" if len(topics) <= 5 else f" and {len(topics) - 5} more"
    return f"it holds {', '.join(topics[:5])}{more}"
