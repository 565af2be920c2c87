"""Samples of magnetometer arrays in sessions: written in batches, read as arrays."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.tag import Tags
from locatk.core.trajectory import Trajectory
from locatk.formats import tags as artifacts
from locatk.formats import viewers
from locatk.formats.messages import BatchError, batch_edges, magnetometers
from locatk.formats.proto.magnetics_pb2 import MagnetometerArray
from locatk.formats.session import Session, SessionWriter
from locatk.formats.tracks import (
    LARGEST_BATCH,
    Timed,
    check_devices,
    odometry_messages,
    truth_messages,
    write_streams,
)

TOPIC = "/magnetometers/"

SCHEMA = MagnetometerArray.DESCRIPTOR.full_name

BATCH_NS = 500_000_000
"""Longest time that one message covers."""


def write_session(
    path: str | os.PathLike[str],
    samples: Sequence[Samples],
    *,
    tags: Tags | None = None,
    truth: Sequence[Trajectory] = (),
    odometry: Sequence[Trajectory] = (),
    facts: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write samples, the tags over which they were taken and what is known beside them.

    Parameters
    ----------
    path : path
        The output.
    samples : sequence of Samples
        One an array, on ``/magnetometers/<device>``; the geometry is attached as
        ``array.toml``, or where the arrays differ as ``array-<device>.toml`` each. Fields
        are kept as float32, which is finer than any sensor.
    tags : Tags, optional
        Attached as ``tag.toml``.
    truth, odometry : sequence of Trajectory
        As in :func:`locatk.formats.observations.write_session`.
    facts : mapping, optional
        Written as texts to the metadata record ``facts``.
    warnings : sequence of str
        Written to ``/log``.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    InputError
        There is no sample, times do not ascend or are before 1970, a field is infinite, or
        two arrays or trajectories have the same name.
    """
    devices = [each.device for each in samples]
    for each in samples:
        if devices.count(each.device) > 1:
            raise InputError(f"two arrays have the name {each.device!r}")
        _check(each.device, each.time_ns, each.field_t)
    if not any(map(len, samples)):
        raise InputError("no sample at all")
    for kind, trajectories in (("truth", truth), ("odometry", odometry)):
        check_devices(trajectories, kind)
    streams = [*map(_messages, samples), *truth_messages(truth)]
    for trajectory in odometry:
        streams.append(odometry_messages(f"/odometry/{trajectory.device}", trajectory))
    with SessionWriter(path, system="polaris", overwrite=overwrite) as writer:
        if facts:
            writer.metadata("facts", {key: str(value) for key, value in facts.items()})
        if tags is not None:
            _attach(writer, artifacts.TAG_FILE, artifacts.dumps_tags(tags))
        arrays = {each.device: artifacts.dumps_array(each.array) for each in samples}
        if len(set(arrays.values())) == 1:
            _attach(writer, artifacts.ARRAY_FILE, arrays[devices[0]])
        else:
            for device, text in arrays.items():
                _attach(writer, artifacts.array_file(device), text)
        end_ns = write_streams(writer, streams)
        for line in warnings:
            writer.write("/log", viewers.log(line, end_ns, warning=True), end_ns)


def _attach(writer: SessionWriter, name: str, text: str) -> None:
    writer.attach(name, text.encode(), "application/toml")


def _messages(samples: Samples) -> Iterator[Timed]:
    """Batches of one array."""
    sensors = len(samples.array)
    layout = magnetometers(sensors)
    once: dict[str, str | int] = {
        "device": samples.device,
        "frame_id": samples.device,
        "sensors": sensors,
    }
    columns: dict[str, NDArray[Any]] = {
        "time_ns": samples.time_ns,
        "b_tesla": samples.field_t.reshape(len(samples), -1).astype(np.float32),
    }
    one = np.zeros(len(samples), np.int64)
    edges = batch_edges(samples.time_ns, one, BATCH_NS, LARGEST_BATCH).tolist()
    for start, stop in pairwise(edges):
        message = layout.pack(once, {key: column[start:stop] for key, column in columns.items()})
        yield int(samples.time_ns[start]), f"{TOPIC}{samples.device}", message


def read_samples(session: Session) -> list[Samples]:
    """Samples of all arrays of a session, one ``Samples`` an array, sorted by device.

    Raises
    ------
    FormatError
        There are none, a message is damaged, times do not ascend, or the array's geometry
        is missing or of another number of sensors.
    ArtifactError
        The geometry is no valid one.
    """
    topics = session.topics(TOPIC, SCHEMA)
    if not topics:
        raise FormatError(
            f"no samples of magnetometers (topic {TOPIC}<device>)"
            if session.facts
            else f"not a session of locatk: no topic {TOPIC}<device>",
            file=session.path,
            hint="Make one with `locatk import polaris-csv` or `locatk simulate polaris`",
        )
    return [_samples(session, topic) for topic in topics]


def _samples(session: Session, topic: str) -> Samples:
    device = topic.removeprefix(TOPIC)
    payloads = [payload for _, _, payload in session.messages([topic])]
    try:
        sensors = MagnetometerArray.FromString(payloads[0]).sensors
        if not sensors:
            raise BatchError("a message of no sensor")
        batches = magnetometers(sensors).unpack(payloads)
    except DecodeError:
        raise FormatError("a message is damaged", file=session.path, where=topic) from None
    except BatchError as error:
        raise FormatError(str(error), file=session.path, where=topic) from None
    time_ns = batches.columns["time_ns"]
    if not len(time_ns):
        raise FormatError("messages without any sample", file=session.path, where=topic)
    field = batches.columns["b_tesla"].astype(float).reshape(len(time_ns), sensors, 3)
    try:
        _check(device, time_ns, field)
    except InputError as error:
        raise FormatError(error.message, file=session.path, where=topic) from None
    return Samples(device, _array(session, topic, device, sensors), time_ns, field)


def _array(session: Session, topic: str, device: str, sensors: int) -> SensorArray:
    array = artifacts.attached_array(session, device)
    if array is None:
        raise FormatError(
            f"no geometry of the array {device!r}",
            file=session.path,
            where=artifacts.ARRAY_FILE,
            hint="Record or import it again: where the sensors sit is not known",
        )
    if len(array) != sensors:
        raise FormatError(
            f"samples of {sensors} sensors, where the array has {len(array)}",
            file=session.path,
            where=topic,
        )
    return array


def _check(device: str, time_ns: NDArray[np.int64], field_t: NDArray[np.float64]) -> None:
    """Refuse times that cannot be, and fields that no sensor gives."""
    if len(time_ns) and time_ns[0] < 0:
        raise InputError(f"sample 0 of {device} is older than 1970")
    late = np.flatnonzero(np.diff(time_ns) <= 0)
    if len(late):
        number = int(late[0]) + 1
        same = time_ns[number] == time_ns[number - 1]
        what = "has the time of" if same else "is older than"
        raise InputError(f"sample {number} of {device} {what} the one before it")
    infinite = np.isinf(field_t)
    if infinite.any():
        number, sensor, _ = (int(n) for n in np.argwhere(infinite)[0])
        raise InputError(f"sample {number} of {device} is infinite at sensor {sensor}")
