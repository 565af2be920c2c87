"""Contents of a session for a solver: sweeps, samples, frames, truth, odometry, artifacts.

Lighthouse sweeps and receivers are read and written here. The readers of the other contents are
re-exported from their modules.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from locatk.core.errors import FormatError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts.maps import attached_map as read_map
from locatk.formats.artifacts.receiver import (
    attached_receiver,
    receiver_attachments,
    receiver_file,
)
from locatk.formats.artifacts.scene import SCENE_FILE, dumps_scene
from locatk.formats.artifacts.scene import attached_scene as read_scene
from locatk.formats.artifacts.sheets import attached_camera as read_camera
from locatk.formats.artifacts.sheets import attached_manifest as read_manifest
from locatk.formats.artifacts.tags import attached_tags as read_tags
from locatk.formats.sessions import capture_record
from locatk.formats.sessions.field_samples import read_halls, read_magnetometers
from locatk.formats.sessions.frames import read_frames
from locatk.formats.sessions.inertial import imu_streams, read_imu
from locatk.formats.sessions.messages import (
    MAX_BATCH_NS,
    SWEEPS,
    Batches,
    MessageBatch,
    batch_edges,
)
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution, read_trajectories, write_solution
from locatk.formats.sessions.station_reports import (
    add_station_data,
    read_station_reports,
    station_records,
)
from locatk.formats.sessions.trajectories import (
    onboard_messages,
    read_batches,
    read_odometry,
    read_onboard,
    read_truth,
    reference_streams,
    write_streams,
)
from locatk.formats.sessions.writer import SessionWriter

__all__ = [
    "read_camera",
    "read_frames",
    "read_halls",
    "read_imu",
    "read_magnetometers",
    "read_manifest",
    "read_map",
    "read_odometry",
    "read_onboard",
    "read_receivers",
    "read_scene",
    "read_solution",
    "read_station_reports",
    "read_sweeps",
    "read_tags",
    "read_trajectories",
    "read_truth",
    "sweep_messages",
    "sweeps_of_batches",
    "write_session",
    "write_solution",
    "write_sweeps",
]

SWEEP_TOPIC_PREFIX = "/lighthouse/"
"""Topic of the sweeps of a device, without its name."""

_SWEEP_RANGES = {
    "time_ns": (0, np.iinfo(np.int64).max),
    "sensor": (0, np.iinfo(np.int32).max),
    "channel": (1, 16),
    "polynomial": (-1, 31),
    "sweep": (-1, 1),
}

TRUE_SCENE_FILE = "true-scene.toml"
"""Attachment with the true stations of a simulation."""

MAX_LISTED_TOPICS = 5
"""Number of topics that the message about a session without sweeps lists."""


def read_sweeps(session: Session) -> Sweeps:
    """Read all lighthouse sweeps of a session, in file order.

    Raises
    ------
    FormatError
        There are none, a message is damaged, or a value is outside its range.
    """
    topics = session.topics(SWEEP_TOPIC_PREFIX, "locatk.LighthouseSweep")
    if not topics:
        raise FormatError(
            "no lighthouse sweeps (topic /lighthouse/<device>)"
            if session.facts
            else "not a session of locatk: no topic /lighthouse/<device>",
            file=session.path,
            hint=_describe_topics(session),
        )
    sweeps = sweeps_of_batches(read_batches(session, topics, SWEEPS))
    _check_ranges(sweeps, session.path)
    return sweeps


def sweeps_of_batches(batches: Batches) -> Sweeps:
    """Return the sweeps of unpacked messages, in their order."""
    names = batches.texts["device"]
    devices = tuple(dict.fromkeys(names))
    numbers = {name: number for number, name in enumerate(devices)}
    device = np.array([numbers[name] for name in names], np.int32).repeat(batches.counts)
    columns = batches.columns
    return Sweeps(
        devices=devices,
        time_ns=columns["time_ns"],
        device=device,
        sensor=columns["sensor"],
        channel=columns["channel"],
        polynomial=columns["polynomial"],
        sweep=columns["sweep"],
        count=columns["count"],
    )


def _check_ranges(sweeps: Sweeps, path: str | None) -> None:
    for name, (low, high) in _SWEEP_RANGES.items():
        values = getattr(sweeps, name)
        invalid = values[(values < low) | (values > high)]
        if len(invalid):
            raise FormatError(
                f"{name} {invalid[0]} of a sweep is not in {low}..{high}",
                file=path,
                where="/lighthouse",
            )


def read_receivers(session: Session) -> dict[str, Receiver]:
    """Return the receiver of each device of a session; devices without one are omitted.

    Attachments take precedence. A recording of a Lighthouse deck without attachment, of an earlier
    version, has the geometry of the deck.

    Raises
    ------
    FormatError, ArtifactError
        An attachment is damaged, or not a valid receiver.
    """
    prefix = receiver_file("").removesuffix(".toml")
    topics = session.topics(SWEEP_TOPIC_PREFIX)
    devices = {topic.removeprefix(SWEEP_TOPIC_PREFIX) for topic in topics}
    for info in session.attachments():
        if info.name.startswith(prefix) and info.name.endswith(".toml"):
            devices.add(info.name.removeprefix(prefix).removesuffix(".toml"))
    is_deck = (capture_record.capture(session) or {}).get("device") == DECK.name
    receivers = {
        device: attached_receiver(session, device) or (DECK if is_deck else None)
        for device in sorted(devices)
    }
    return {device: receiver for device, receiver in receivers.items() if receiver is not None}


def sweep_messages(sweeps: Sweeps, *, batch_ns: int = MAX_BATCH_NS) -> list[Iterator[MessageBatch]]:
    """Return a stream of batches of ``sweeps`` for each device, batched by time."""
    _check_ranges(sweeps, None)
    streams = []
    for number, name in enumerate(sweeps.devices):
        own = np.flatnonzero(sweeps.device == number)
        own = own[np.argsort(sweeps.time_ns[own], kind="stable")]
        columns = {c.name: getattr(sweeps, c.name)[own] for c in SWEEPS.columns if not c.optional}
        edges = batch_edges(columns["time_ns"], sweeps.device[own], max_duration_ns=batch_ns)
        topic = SWEEP_TOPIC_PREFIX + name
        streams.append(SWEEPS.batches(topic, {"device": name}, columns, edges))
    return streams


def write_sweeps(writer: SessionWriter, sweeps: Sweeps, *, batch_ns: int = MAX_BATCH_NS) -> None:
    """Write ``sweeps`` on ``/lighthouse/<device>``, batched by device and time.

    One message covers at most ``batch_ns`` nanoseconds.
    """
    write_streams(writer, sweep_messages(sweeps, batch_ns=batch_ns))


def write_session(
    path: str | os.PathLike[str],
    *,
    system: str,
    sweeps: Sweeps,
    truth: Sequence[Trajectory] = (),
    odometry: Sequence[Trajectory] = (),
    imu: Sequence[InertialSamples] = (),
    onboard: Sequence[Trajectory] = (),
    scene: Scene | None = None,
    facts: Mapping[str, object] | None = None,
    stations: Sequence[StationReport] = (),
    receivers: Mapping[str, Receiver] | None = None,
    true_scene: Scene | None = None,
    overwrite: bool = False,
) -> None:
    """Write a session of sweeps, with reference data and artifacts.

    Parameters
    ----------
    path : path
        The output.
    system : str
        ``"lighthouse"``.
    sweeps : Sweeps
        The observations, on ``/lighthouse/<device>``.
    truth : sequence of Trajectory
        Reference poses: exact on ``/truth_track/<device>``, one message per pose for
        viewers on ``/truth/<device>``.
    odometry : sequence of Trajectory
        The planar part (x, y, heading) is written on ``/odometry/<device>``.
    imu : sequence of InertialSamples
        Accelerometer and gyroscope, on ``/imu/<device>``.
    onboard : sequence of Trajectory
        Poses that the devices estimated themselves, on ``/onboard_track/<device>`` and for viewers
        on ``/onboard/<device>``. They are for comparison: solvers do not use them.
    scene : Scene, optional
        Attached as ``scene.toml``.
    facts : mapping, optional
        Origin of the data; written as texts to the metadata record ``facts``.
    stations : sequence of StationReport
        Written as one metadata record ``station-<channel>`` each. Calibrations and serial
        numbers that the stations transmitted are added to the scene, if it has none for their
        channels.
    receivers : mapping of str to Receiver, optional
        By device; attached as ``receiver.toml``, or if the devices differ as one
        ``receiver-<device>.toml`` each.
    true_scene : Scene, optional
        Attached as ``true-scene.toml``, for comparison: solvers do not use it.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    InputError
        A time is before 1970, two trajectories or two IMUs have the same device or two stations
        the same channel, or a receiver or a sample of an IMU is impossible.
    """
    records = station_records(stations)
    scene = add_station_data(scene, stations)
    devices = {sweeps.devices[number] for number in np.unique(sweeps.device).tolist()}
    receiver_texts = receiver_attachments(receivers or {}, devices)
    streams = [
        *sweep_messages(sweeps),
        *reference_streams(truth, odometry),
        *imu_streams(imu),
        *onboard_messages(onboard),
    ]
    with SessionWriter(path, system=system, overwrite=overwrite) as writer:
        writer.facts(facts)
        if scene is not None:
            writer.attach_toml(SCENE_FILE, dumps_scene(scene))
        if true_scene is not None:
            writer.attach_toml(TRUE_SCENE_FILE, dumps_scene(true_scene))
        for name, text in receiver_texts.items():
            writer.attach_toml(name, text)
        for name, record in records.items():
            writer.metadata(name, record)
        write_streams(writer, streams)


def _describe_topics(session: Session) -> str:
    topics = [channel.topic for channel in session.channels]
    if not topics:
        return "The file contains no messages"
    hidden = len(topics) - MAX_LISTED_TOPICS
    more = f" and {hidden} more" if hidden > 0 else ""
    return f"It contains {', '.join(topics[:MAX_LISTED_TOPICS])}{more}"
