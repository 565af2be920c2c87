"""What a device would send of a session: the bytes as they were recorded, or made again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from google.protobuf.message import DecodeError

from locatk.core.errors import FormatError, InputError, error_context
from locatk.formats.capture.statistics import RECORD
from locatk.formats.devices import Device, device
from locatk.formats.devices.recording import Recording
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import field_samples
from locatk.formats.sessions.observations import (
    read_halls,
    read_magnetometers,
    read_odometry,
    read_sweeps,
)
from locatk.formats.sessions.reader import Session

RAW = "raw"
"""The device whose bytes are kept as they are."""

SWEEPS = ("/lighthouse/", "locatk.LighthouseSweep")
"""Topic and schema."""


@dataclass(frozen=True)
class Source:
    """Something to send.

    Attributes
    ----------
    device : str
        Which device sends it.
    recorded : bool
        Whether the bytes are those that were recorded.
    packets : callable
        Gives (time in ns, bytes) from the start, each time it is called.
    """

    device: str
    recorded: bool
    packets: Callable[[], Iterator[tuple[int, bytes]]]


def source_of(session: Session, name: str | None = None) -> Source:
    """What the device ``name`` would send of a session.

    Recorded bytes of this device are taken as they are; else the decoded streams are
    encoded. Without a name it is the device that recorded the session, or one whose bytes
    such a session can come from.

    Raises
    ------
    InputError
        There is no such device, or it sends nothing that the session holds.
    FormatError
        A stream of the session is damaged.
    """
    by = session.metadata().get(RECORD, {}).get("device") or None
    wanted = name or by or _usual(session)
    sender = device(wanted)
    topics = session.topics("/", SerialChunk.DESCRIPTOR.full_name)
    if topics and wanted in (RAW, by or wanted):
        if len(topics) > 1:
            raise InputError(
                f"raw bytes of {len(topics)} ports",
                file=session.path,
                hint="Give a session of one port",
            )
        return Source(wanted, True, partial(_chunks, session, topics[0]))
    if not sender.encoder:
        raise InputError(
            f"nothing that the device {wanted!r} sends",
            file=session.path,
            hint="Name another --device",
        )
    return Source(wanted, False, partial(_encoded, session, sender, _recording(session)))


def _chunks(session: Session, topic: str) -> Iterator[tuple[int, bytes]]:
    """Bytes of a session, read by read, at the times of the reads."""
    for _, time_ns, payload in session.messages([topic]):
        try:
            yield time_ns, SerialChunk.FromString(payload).data
        except DecodeError:
            raise FormatError("a message is damaged", file=session.path, where=topic) from None


def _encoded(session: Session, sender: Device, recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Bytes that a device makes of observations."""
    with error_context(session.path):
        yield from sender.encode(recording)


def _usual(session: Session) -> str:
    """A device that sends what the session holds, by its name."""
    if session.topics("/", SerialChunk.DESCRIPTOR.full_name):
        return RAW
    if field_samples.MAGNETOMETERS.topics(session):
        return "polaris-array"
    if session.topics(*SWEEPS):
        return "dotbot-gateway"
    return "locatk"


def _recording(session: Session) -> Recording:
    """The observations of a session, of whichever kinds it holds."""
    found = Recording(
        samples=read_magnetometers(session) if field_samples.MAGNETOMETERS.topics(session) else (),
        halls=read_halls(session) if field_samples.HALLS.topics(session) else (),
        sweeps=read_sweeps(session) if session.topics(*SWEEPS) else None,
        odometry=read_odometry(session),
    )
    if not (found.samples or found.halls or found.sweeps or found.odometry):
        raise InputError(
            "nothing that comes over a serial port",
            file=session.path,
            hint="Of images make a video; `locatk capture camera:FILE` takes it"
            if session.topics("/", "foxglove.CompressedImage")
            else "Give a session of magnetometers, hall sensors, sweeps or odometry",
        )
    return found
