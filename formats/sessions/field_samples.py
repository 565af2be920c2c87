"""Samples of field sensors in sessions, whichever they are: written in batches, read as arrays.

:mod:`.arrays` says what that means for magnetometers, :mod:`.halls` for hall sensors.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Generic, TypedDict, TypeVar

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions.messages import BatchError, Layout, batch_edges
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import (
    LARGEST_BATCH,
    Timed,
    known_streams,
    write_streams,
    write_warnings,
)
from locatk.formats.sessions.writer import SessionWriter

BATCH_NS = 500_000_000
"""Longest time that one message covers."""

G = TypeVar("G")
"""The geometry of the sensors of one device."""


class NoGeometryError(FormatError):
    """Samples of sensors of which nobody knows where they sit: nothing is damaged."""


@dataclass(frozen=True)
class Kind(Generic[G]):
    """A kind of sensors, and how a session holds them.

    Attributes
    ----------
    system : str
    topic : str
        Before the device's name.
    layout : callable
        Layout of the messages of so many sensors.
    file, device_file : str, callable
        Attachment of the geometry that all devices share, and that of one device alone.
    dumps, attached : callable
        The geometry as text, and as it is attached to a session for a device, or None.
    sensors, geometry : str
        Their names for people, as in "magnetometers" and "array".
    makers : str
        Commands that make such a session, for people.
    """

    system: str
    topic: str
    layout: Callable[[int], Layout]
    file: str
    device_file: Callable[[str], str]
    dumps: Callable[[G], str]
    attached: Callable[[Session, str], G | None]
    sensors: str
    geometry: str
    makers: str

    @property
    def schema(self) -> str:
        """Full name of the messages."""
        return str(self.layout(1).message.DESCRIPTOR.full_name)


@dataclass(frozen=True)
class Recorded(Generic[G]):
    """Samples of one device: times (n,) in ns and fields (n, N) or (n, N, axes) in tesla."""

    device: str
    geometry: G
    time_ns: NDArray[np.int64]
    field_t: NDArray[np.float64]


class Beside(TypedDict, total=False):
    """What :func:`write` takes beside samples, whatever the sensors are."""

    truth: Sequence[Trajectory]
    odometry: Sequence[Trajectory]
    facts: Mapping[str, object] | None
    warnings: Sequence[str]
    overwrite: bool


def write(
    path: str | os.PathLike[str],
    kind: Kind[G],
    samples: Sequence[Recorded[G]],
    *,
    artifact: tuple[str, str] | None = None,
    truth: Sequence[Trajectory] = (),
    odometry: Sequence[Trajectory] = (),
    facts: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a session of samples and what is known beside them.

    Parameters
    ----------
    path : path
        The output.
    kind : Kind
    samples : sequence of Recorded
        One a device, on its topic; the geometry is attached as one file, or where those of
        the devices differ as a file each. Fields are kept as float32, which is finer than
        any sensor.
    artifact : (name, text), optional
        An attachment: what is on the floor.
    truth, odometry : sequence of Trajectory
        As in :func:`locatk.formats.sessions.observations.write_session`.
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
        two devices or trajectories have the same name.
    """
    devices = [each.device for each in samples]
    for each in samples:
        if devices.count(each.device) > 1:
            raise InputError(f"two {kind.geometry}s have the name {each.device!r}")
        _check(each.device, each.time_ns, each.field_t)
    if not any(len(each.time_ns) for each in samples):
        raise InputError("no sample at all")
    streams = [*(_messages(kind, each) for each in samples), *known_streams(truth, odometry)]
    with SessionWriter(path, system=kind.system, overwrite=overwrite) as writer:
        writer.facts(facts)
        if artifact is not None:
            writer.attach_toml(*artifact)
        texts = {each.device: kind.dumps(each.geometry) for each in samples}
        if len(set(texts.values())) == 1:
            writer.attach_toml(kind.file, texts[devices[0]])
        else:
            for device, text in texts.items():
                writer.attach_toml(kind.device_file(device), text)
        end_ns = write_streams(writer, streams)
        write_warnings(writer, warnings, end_ns)


def _messages(kind: Kind[G], samples: Recorded[G]) -> Iterator[Timed]:
    """Batches of one device."""
    n, sensors = samples.field_t.shape[:2]
    layout = kind.layout(sensors)
    once: dict[str, str | int] = {
        "device": samples.device,
        "frame_id": samples.device,
        "sensors": sensors,
    }
    columns: dict[str, NDArray[Any]] = {
        "time_ns": samples.time_ns,
        "b_tesla": samples.field_t.reshape(n, -1).astype(np.float32),
    }
    edges = batch_edges(samples.time_ns, np.zeros(n, np.int64), BATCH_NS, LARGEST_BATCH).tolist()
    for start, stop in pairwise(edges):
        message = layout.pack(once, {key: column[start:stop] for key, column in columns.items()})
        yield int(samples.time_ns[start]), f"{kind.topic}{samples.device}", message


def read(session: Session, kind: Kind[G]) -> list[Recorded[G]]:
    """Samples of all devices of a session, sorted by device; fields are (n, N times axes).

    Raises
    ------
    FormatError
        There are none, a message is damaged, times do not ascend, or the geometry is missing
        or of another number of sensors.
    ArtifactError
        The geometry is no valid one.
    """
    topics = session.topics(kind.topic, kind.schema)
    if not topics:
        raise FormatError(
            f"no samples of {kind.sensors} (topic {kind.topic}<device>)"
            if session.facts
            else f"not a session of locatk: no topic {kind.topic}<device>",
            file=session.path,
            hint=f"Make one with {kind.makers}",
        )
    return [_recorded(session, kind, topic) for topic in topics]


def _recorded(session: Session, kind: Kind[G], topic: str) -> Recorded[G]:
    device = topic.removeprefix(kind.topic)
    payloads = [payload for _, _, payload in session.messages([topic])]
    if not payloads:
        raise FormatError("no message at all", file=session.path, where=topic)
    try:
        first: Any = kind.layout(1).message.FromString(payloads[0])
        sensors = int(first.sensors)
        if not sensors:
            raise BatchError("a message of no sensor")
        batches = kind.layout(sensors).unpack(payloads)
    except DecodeError:
        raise FormatError("a message is damaged", file=session.path, where=topic) from None
    except BatchError as error:
        raise FormatError(str(error), file=session.path, where=topic) from None
    time_ns = batches.columns["time_ns"]
    if not len(time_ns):
        raise FormatError("messages without any sample", file=session.path, where=topic)
    field = batches.columns["b_tesla"].astype(float).reshape(len(time_ns), sensors, -1)
    try:
        _check(device, time_ns, field)
    except InputError as error:
        raise FormatError(error.message, file=session.path, where=topic) from None
    return Recorded(device, _geometry(session, kind, topic, sensors), time_ns, field)


def _geometry(session: Session, kind: Kind[G], topic: str, sensors: int) -> G:
    device = topic.removeprefix(kind.topic)
    geometry: Any = kind.attached(session, device)
    if geometry is None:
        raise NoGeometryError(
            f"no geometry of the {kind.geometry} {device!r}",
            file=session.path,
            where=kind.file,
            hint=f"Where the sensors sit is not known: `locatk decode {session.path} --artifact "
            f"{kind.file} -o whole.mcap` adds it to a recording, else import it again",
        )
    if len(geometry) != sensors:
        raise FormatError(
            f"samples of {sensors} sensors, where the {kind.geometry} has {len(geometry)}",
            file=session.path,
            where=topic,
        )
    known: G = geometry
    return known


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
        number, sensor = (int(n) for n in np.argwhere(infinite)[0][:2])
        raise InputError(f"sample {number} of {device} is infinite at sensor {sensor}")
