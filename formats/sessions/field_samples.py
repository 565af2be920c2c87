"""Samples of magnetic field sensors in sessions: magnetometer arrays and hall sensors.

Samples are written in batches and read as arrays. The two kinds of sensors differ in their
messages and in the artifact that holds their geometry (:class:`SensorKind`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypedDict, TypeVar, Unpack

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.inertial import InertialSamples
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.tag import Tags
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts import maps as map_files
from locatk.formats.artifacts import tags as tag_files
from locatk.formats.sessions import messages
from locatk.formats.sessions.inertial import imu_streams
from locatk.formats.sessions.messages import BatchError, Layout, MessageBatch, batch_edges
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import (
    reference_streams,
    write_streams,
    write_warnings,
)
from locatk.formats.sessions.writer import SessionWriter

Geometry = TypeVar("Geometry")
"""Geometry of the sensors of one device."""


class MissingGeometryError(FormatError):
    """The positions of the sensors are unknown; the session is not damaged."""


@dataclass(frozen=True)
class SensorKind(Generic[Geometry]):
    """Kind of sensors, and its representation in a session.

    Attributes
    ----------
    system : str
    topic : str
        Prefix of the topics, in front of the device's name.
    layout : callable
        Layout of the messages for a number of sensors.
    file : str
        Name of the attachment with the geometry that all devices share.
    device_file : callable
        Name of the attachment with the geometry of one device.
    dumps : callable
        Convert a geometry to TOML.
    attached : callable
        Read the geometry of a device that is attached to a session, or None.
    sensors, geometry : str
        Names for messages, as in "magnetometers" and "array".
    makers : str
        Commands that make such a session, for messages.
    """

    system: str
    topic: str
    layout: Callable[[int], Layout]
    file: str
    device_file: Callable[[str], str]
    dumps: Callable[[Geometry], str]
    attached: Callable[[Session, str], Geometry | None]
    sensors: str
    geometry: str
    makers: str

    @property
    def schema(self) -> str:
        """Full name of the messages."""
        return str(self.layout(1).message.DESCRIPTOR.full_name)

    def topics(self, session: Session) -> tuple[str, ...]:
        """Return the topics of this kind in a session."""
        return session.topics(self.topic, self.schema)


MAGNETOMETERS: SensorKind[SensorArray] = SensorKind(
    system="polaris",
    topic="/magnetometers/",
    layout=messages.magnetometers,
    file=tag_files.ARRAY_FILE,
    device_file=tag_files.array_file,
    dumps=tag_files.dumps_array,
    attached=tag_files.attached_array,
    sensors="magnetometers",
    geometry="array",
    makers="`locatk import polaris-csv` or `locatk simulate polaris`",
)

HALLS: SensorKind[HallSensors] = SensorKind(
    system="landmarks",
    topic="/halls/",
    layout=messages.halls,
    file=map_files.HALLS_FILE,
    device_file=map_files.halls_file,
    dumps=map_files.dumps_halls,
    attached=map_files.attached_halls,
    sensors="hall sensors",
    geometry="robot",
    makers="`locatk import landmark-csv` or `locatk simulate landmarks`",
)


@dataclass(frozen=True)
class DeviceSamples(Generic[Geometry]):
    """Samples of one device.

    Attributes
    ----------
    device : str
    geometry : Geometry
    time_ns : (n,) int64 ndarray
    field_t : (n, N) or (n, N, axes) ndarray
        Fields of N sensors in tesla.
    """

    device: str
    geometry: Geometry
    time_ns: NDArray[np.int64]
    field_t: NDArray[np.float64]


class SessionExtras(TypedDict, total=False):
    """Keyword arguments of the writers below that do not depend on the kind of sensors.

    Attributes
    ----------
    truth, odometry : sequence of Trajectory
        As in :func:`locatk.formats.sessions.observations.write_session`.
    imu : sequence of InertialSamples
        On ``/imu/<device>``, for viewers and programs: the solvers of fields do not use them.
    facts : mapping, optional
        Written as texts to the metadata record ``facts``.
    warnings : sequence of str
        Written to ``/log``.
    overwrite : bool
        Replace an existing file.
    """

    truth: Sequence[Trajectory]
    odometry: Sequence[Trajectory]
    imu: Sequence[InertialSamples]
    facts: Mapping[str, object] | None
    warnings: Sequence[str]
    overwrite: bool


def write_magnetometers(
    path: str | os.PathLike[str],
    samples: Sequence[Samples],
    *,
    tags: Tags | None = None,
    **extras: Unpack[SessionExtras],
) -> None:
    """Write a session of samples of magnetometer arrays.

    Parameters
    ----------
    path : path
        The output.
    samples : sequence of Samples
        One per array, on ``/magnetometers/<device>``. The geometry is attached as
        ``array.toml``; if the arrays differ, as one ``array-<device>.toml`` each. Fields are
        stored as float32, which is finer than any sensor.
    tags : Tags, optional
        Tags on the floor, attached as ``tag.toml``.
    **extras
        See :class:`SessionExtras`.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    InputError
        There is no sample, times do not ascend or are before 1970, a field is infinite, or
        two devices or trajectories have the same name.
    """
    artifact = None if tags is None else (tag_files.TAG_FILE, tag_files.dumps_tags(tags))
    recordings = [DeviceSamples(s.device, s.array, s.time_ns, s.field_t) for s in samples]
    _write(path, MAGNETOMETERS, recordings, artifact, **extras)


def write_halls(
    path: str | os.PathLike[str],
    samples: Sequence[HallSamples],
    *,
    floor: FloorMap | None = None,
    **extras: Unpack[SessionExtras],
) -> None:
    """Write a session of samples of hall sensors.

    Parameters
    ----------
    path : path
        The output.
    samples : sequence of HallSamples
        One per robot, on ``/halls/<device>``. Its sensors are attached as ``halls.toml``; if
        those of the robots differ, as one ``halls-<device>.toml`` each. Fields are stored as
        float32, which is finer than any sensor.
    floor : FloorMap, optional
        Map of the floor, attached as ``map.toml``.
    **extras
        See :class:`SessionExtras`.

    Raises
    ------
    OutputExistsError, MissingDataError, InputError
        As :func:`write_magnetometers`.
    """
    artifact = None if floor is None else (map_files.MAP_FILE, map_files.dumps_map(floor))
    recordings = [DeviceSamples(s.device, s.sensors, s.time_ns, s.field_t) for s in samples]
    _write(path, HALLS, recordings, artifact, **extras)


def read_magnetometers(
    session: Session, *, fallback: Callable[[int], SensorArray] | None = None
) -> list[Samples]:
    """Read the samples of all magnetometer arrays of a session, sorted by device.

    Parameters
    ----------
    session : Session
    fallback : callable, optional
        Takes a number of sensors and returns the array of a device without geometry; by default,
        such a device is an error.

    Raises
    ------
    FormatError
        There are none, a message is damaged, times do not ascend, or the geometry is missing
        (:class:`MissingGeometryError`) or of another number of sensors.
    ArtifactError
        The geometry is invalid.
    """
    return [
        Samples(each.device, each.geometry, each.time_ns, each.field_t)
        for each in _read(session, MAGNETOMETERS, fallback)
    ]


def read_halls(
    session: Session, *, fallback: Callable[[int], HallSensors] | None = None
) -> list[HallSamples]:
    """Read the samples of the hall sensors of all robots of a session, sorted by device.

    Parameters
    ----------
    session, fallback
        As for :func:`read_magnetometers`.

    Raises
    ------
    FormatError, ArtifactError
        As :func:`read_magnetometers`.
    """
    return [
        HallSamples(
            each.device,
            each.geometry,
            each.time_ns,
            restore_saturation(each.field_t[:, :, 0], each.geometry.range_t),
        )
        for each in _read(session, HALLS, fallback)
    ]


def restore_saturation(field_t: NDArray[np.float64], range_t: float) -> NDArray[np.float64]:
    """Raise fields to the range that were at the range before they were rounded to float32."""
    is_saturated = np.abs(field_t) >= np.float32(range_t)
    saturated = np.copysign(np.maximum(np.abs(field_t), range_t), field_t)
    return np.where(is_saturated, saturated, field_t)


def _write(
    path: str | os.PathLike[str],
    kind: SensorKind[Geometry],
    samples: Sequence[DeviceSamples[Geometry]],
    artifact: tuple[str, str] | None,
    *,
    truth: Sequence[Trajectory] = (),
    odometry: Sequence[Trajectory] = (),
    imu: Sequence[InertialSamples] = (),
    facts: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a session of samples; ``artifact`` is the name and text of an attachment."""
    devices = [each.device for each in samples]
    for each in samples:
        if devices.count(each.device) > 1:
            raise InputError(f"two {kind.geometry}s have the name {each.device!r}")
        _check(each.device, each.time_ns, each.field_t)
    if not any(len(each.time_ns) for each in samples):
        raise InputError("no sample at all")
    streams = [
        *(_messages(kind, each) for each in samples),
        *reference_streams(truth, odometry),
        *imu_streams(imu),
    ]
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


def _messages(
    kind: SensorKind[Geometry], samples: DeviceSamples[Geometry]
) -> Iterator[MessageBatch]:
    n, sensors = samples.field_t.shape[:2]
    layout = kind.layout(sensors)
    fields = {"device": samples.device, "frame_id": samples.device, "sensors": sensors}
    columns: dict[str, NDArray[Any]] = {
        "time_ns": samples.time_ns,
        "b_tesla": samples.field_t.reshape(n, -1).astype(np.float32),
    }
    edges = batch_edges(samples.time_ns, np.zeros(n, np.int64))
    return layout.batches(f"{kind.topic}{samples.device}", fields, columns, edges)


def _read(
    session: Session, kind: SensorKind[Geometry], fallback: Callable[[int], Geometry] | None
) -> list[DeviceSamples[Geometry]]:
    """Read the samples of all devices, sorted by device; fields are (n, N, axes)."""
    topics = kind.topics(session)
    if not topics:
        raise FormatError(
            f"no samples of {kind.sensors} (topic {kind.topic}<device>)"
            if session.facts
            else f"not a session of locatk: no topic {kind.topic}<device>",
            file=session.path,
            hint=f"Make one with {kind.makers}",
        )
    return [_read_device(session, kind, topic, fallback) for topic in topics]


def _read_device(
    session: Session,
    kind: SensorKind[Geometry],
    topic: str,
    fallback: Callable[[int], Geometry] | None,
) -> DeviceSamples[Geometry]:
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
    field_t = batches.columns["b_tesla"].astype(float).reshape(len(time_ns), sensors, -1)
    try:
        _check(device, time_ns, field_t)
    except InputError as error:
        raise FormatError(error.message, file=session.path, where=topic) from None
    try:
        geometry = _read_geometry(session, kind, topic, sensors)
    except MissingGeometryError:
        if fallback is None:
            raise
        geometry = fallback(sensors)
    return DeviceSamples(device, geometry, time_ns, field_t)


def _read_geometry(
    session: Session, kind: SensorKind[Geometry], topic: str, sensors: int
) -> Geometry:
    device = topic.removeprefix(kind.topic)
    geometry: Any = kind.attached(session, device)
    if geometry is None:
        raise MissingGeometryError(
            f"no geometry of the {kind.geometry} {device!r}",
            file=session.path,
            where=kind.file,
            hint="The positions of the sensors are unknown: "
            f"`locatk decode {session.path} --artifact {kind.file} -o whole.mcap` adds them to a "
            "recording; import other sessions again",
        )
    if len(geometry) != sensors:
        raise FormatError(
            f"samples of {sensors} sensors, but the {kind.geometry} has {len(geometry)}",
            file=session.path,
            where=topic,
        )
    checked: Geometry = geometry
    return checked


def _check(device: str, time_ns: NDArray[np.int64], field_t: NDArray[np.float64]) -> None:
    """Raise InputError for times that do not ascend or precede 1970, and for infinite fields."""
    if len(time_ns) and time_ns[0] < 0:
        raise InputError(f"sample 0 of {device} is older than 1970")
    unordered = np.flatnonzero(np.diff(time_ns) <= 0)
    if len(unordered):
        number = int(unordered[0]) + 1
        is_equal = time_ns[number] == time_ns[number - 1]
        relation = "has the time of" if is_equal else "is older than"
        raise InputError(f"sample {number} of {device} {relation} the one before it")
    infinite = np.abs(field_t) > np.finfo(np.float32).max  # in which they are stored
    if infinite.any():
        number, sensor = (int(n) for n in np.argwhere(infinite)[0][:2])
        raise InputError(f"sample {number} of {device} is infinite at sensor {sensor}")
