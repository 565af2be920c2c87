"""Repeated decoding of the raw bytes of a recording, with another device or a newer decoder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import DecodeError, Message

from locatk.core.errors import FormatError
from locatk.formats.capture.ingestion import AUTO, SerialIntake, StampedMessage
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.devices.interface import Options
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.capture_statistics import CaptureStatistics
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD, CHANNELS_RECORD, SESSION_RECORD
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

M = TypeVar("M", bound=Message)

TOPIC = "/serial/"

BATCH_NS = 20_000_000
"""Time span of reads that are decoded together."""


@dataclass(frozen=True)
class RedecodingResult:
    """Result of the repeated decoding.

    Attributes
    ----------
    devices : dict of str to str
        Device that the decoder assumed, by name of the device in the session.
    totals : dict of str to CaptureStatistics
        Statistics by name.
    remarks : list of str
    system : str
    """

    devices: dict[str, str]
    totals: dict[str, CaptureStatistics]
    remarks: list[str]
    system: str


def decode(
    path: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    device: str | None = None,
    options: Options | None = None,
    artifacts: Mapping[str, str] | None = None,
    overwrite: bool = False,
) -> RedecodingResult:
    """Write a session with the raw bytes of ``path`` and new records of a decoder.

    Times, attachments and metadata are kept; records that were decoded before are left out.

    Parameters
    ----------
    path, output : path
    device : str, optional
        Device that sent the bytes; by default that in the metadata, or else identified from them.
    options : Options, optional
        Options of the decoder.
    artifacts : mapping of str to str, optional
        Attachments (name to text) to add, or to replace existing ones.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    MissingDataError, FormatError
        The input is no session, is damaged, or contains no raw bytes.
    InputError
        There is no such device.
    OutputExistsError
        ``output`` exists.
    """
    session = Session.open(path)
    topics = session.topics(TOPIC, SerialChunk.DESCRIPTOR.full_name)
    if not topics:
        raise FormatError(
            f"no raw bytes (topic {TOPIC}<device>)",
            file=session.path,
            hint="Give a recording of `locatk capture`; `locatk emulate` encodes other sessions",
        )
    recorded = session.metadata().get(CAPTURE_RECORD, {})
    name = device or recorded.get("device") or AUTO
    attached = {**_attached(session), **(artifacts or {})}
    intakes = {
        topic: SerialIntake(
            topic.removeprefix(TOPIC),
            recorded.get("port", ""),
            name,
            options,
            baud=int(recorded["baud"]) if recorded.get("baud", "").isdigit() else None,
            artifacts=attached,
        )
        for topic in topics
    }
    with SessionWriter(output, system="", overwrite=overwrite) as writer:
        for stamped in _messages(session, intakes):
            writer.write(stamped.topic, stamped.message, stamped.time_ns, stamped.publish_ns)
        for intake in intakes.values():
            attached = {**intake.artifacts(), **attached}
        for key, text in attached.items():
            writer.attach_toml(key, text)
        for info in session.attachments():
            data = session.attachment(info.name)
            if data is not None and info.name not in attached:
                writer.attach(info.name, data, info.media_type, info.time_ns)
        for key, record in session.metadata().items():
            if key not in (SESSION_RECORD, CAPTURE_RECORD, CHANNELS_RECORD):
                writer.metadata(key, record)
        decoded = _decoded(intakes)
        writer.metadata(SESSION_RECORD, {"system": decoded.system})
        writer.metadata(CAPTURE_RECORD, _facts(recorded, intakes, decoded, Path(session.path).name))
    return decoded


def _facts(
    recorded: Mapping[str, str],
    intakes: Mapping[str, SerialIntake],
    decoded: RedecodingResult,
    source: str,
) -> dict[str, str]:
    """Return the entries of the record ``capture``: those of the port unchanged, the others new."""
    new: dict[str, str] = {}
    for totals in decoded.totals.values():
        new |= {key: text for key, text in totals.texts().items() if key not in LINE_STATISTICS}
    for intake in intakes.values():
        new |= intake.clocks()
    kept = {
        key: text for key, text in recorded.items() if not key.startswith(("samples:", "tick_"))
    }
    return {**kept, **new, "device": ", ".join(decoded.devices.values()), "decoded_from": source}


LINE_STATISTICS = (
    "gaps",
    "gap_s",
    "silences",
    "overruns",
    "dropped",
    "line_errors",
    "high_water_bytes",
    "clock_step_s",
)
"""Entries of the metadata that are counted by the port, not by the decoder."""


def _attached(session: Session) -> dict[str, str]:
    texts = {}
    for info in session.attachments():
        data = session.attachment(info.name)
        if data is not None and info.name.endswith(".toml"):
            texts[info.name] = data.decode("utf-8", "replace")
    return texts


def _messages(session: Session, intakes: Mapping[str, SerialIntake]) -> Iterator[StampedMessage]:
    """Yield raw bytes, records and log messages of the recorder, in the order of the file."""
    waiting: dict[str, list[ReceivedData]] = {topic: [] for topic in intakes}
    start_ns = 0
    expected = dict.fromkeys(intakes, 0)
    for topic, time_ns, payload in session.messages([*intakes, "/log"]):
        if topic == "/log":
            line = _parsed(Log, payload, session, topic)
            # Log messages of a device are decoded again; only those of the recorder are copied.
            if line.name.startswith("locatk"):
                yield from _decode_waiting(intakes, waiting)
                yield StampedMessage("/log", line, time_ns, time_ns)
            continue
        chunk = _parsed(SerialChunk, payload, session, topic)
        hole = chunk.byte_offset != expected[topic]
        is_reconnect = chunk.byte_offset != 0 and (chunk.opened or hole)
        if is_reconnect or time_ns - start_ns >= BATCH_NS:
            yield from _decode_waiting(intakes, waiting)
            start_ns = time_ns
        if hole:
            intakes[topic].skip_to(chunk.byte_offset)
        if is_reconnect:
            yield from intakes[topic].restart(opened=chunk.opened)
        expected[topic] = chunk.byte_offset + len(chunk.data)
        waiting[topic].append(ReceivedData(time_ns, chunk.data, len(chunk.data)))
    yield from _decode_waiting(intakes, waiting)
    for intake in intakes.values():
        yield from intake.finish()


def _parsed(message_class: type[M], payload: bytes, session: Session, topic: str) -> M:
    """Parse a message of a topic."""
    try:
        return message_class.FromString(payload)
    except DecodeError:
        raise FormatError("a message is damaged", file=session.path, where=topic) from None


def _decode_waiting(
    intakes: Mapping[str, SerialIntake], waiting: dict[str, list[ReceivedData]]
) -> Iterator[StampedMessage]:
    for topic, received in waiting.items():
        if received:
            yield from intakes[topic].take(received)
            yield from intakes[topic].turn(received[-1].time_ns)
            waiting[topic] = []


def _decoded(intakes: Mapping[str, SerialIntake]) -> RedecodingResult:
    system = next((intake.system for intake in intakes.values() if intake.system), "")
    devices: dict[str, str] = {}
    totals: dict[str, CaptureStatistics] = {}
    remarks: list[str] = []
    for topic, intake in intakes.items():
        name = topic.removeprefix(TOPIC)
        devices[name] = intake.device.name if intake.device else ""
        totals[name] = CaptureStatistics()
        intake.count(totals[name])
        remarks += intake.remarks()
    return RedecodingResult(devices, totals, remarks, system)


def losses(decoded: RedecodingResult) -> list[str]:
    """Return one phrase for each kind of data that the decoder could not use."""
    return [
        phrase
        for name, totals in decoded.totals.items()
        for phrase in [*totals.losses(), *totals.doubts(decoded.devices[name])]
    ]
