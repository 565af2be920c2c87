"""What was salvaged of an MCAP file, written anew in the order of the file."""

from __future__ import annotations

import importlib
import os
import pkgutil
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import IO, Any

from google.protobuf.message import DecodeError, Message
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from locatk.formats import schemas as proto
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import mcap_records
from locatk.formats.sessions.mcap_records import DamageError, Index, Segment
from locatk.formats.sessions.reader import reading
from locatk.formats.sessions.recovery.salvage import Salvage
from locatk.formats.sessions.recovery.validation import FRAME, MESSAGE, inside
from locatk.formats.sessions.writer import CHANNELS

_SERIAL = SerialChunk.DESCRIPTOR.full_name


def name_channels(index: Index) -> None:
    """Add the channels and schemas of which only the metadata record ``channels`` of a live
    recording is left.

    Schemas are those of this version of locatk and of its foxglove package.
    """
    for key, text in index.metadata.get(CHANNELS, {}).items():
        topic, _, name = text.rpartition(" ")
        if not (key.isascii() and key.isdigit() and len(key) <= 5 and int(key) < 1 << 16):
            continue
        known = index.channels.get(int(key))
        if known is not None and (known.schema_id in index.schemas or known.schema_id == 0):
            continue
        message_class = _message_class(name)
        if not topic or message_class is None:
            continue
        if known is None:
            numbers = [each.id for each in index.schemas.values() if each.name == name]
            free = max([0, *index.schemas, *(c.schema_id for c in index.channels.values())]) + 1
            schema_id = numbers[0] if numbers else free
            known = Channel(int(key), topic, "protobuf", {}, schema_id)
            index.channels[known.id] = known
        if known.schema_id not in index.schemas:
            files = build_file_descriptor_set(message_class).SerializeToString()
            index.schemas[known.schema_id] = Schema(known.schema_id, files, "protobuf", name)


def _message_class(name: str) -> type[Message] | None:
    """Generated class of a message of locatk or foxglove, None where there is none."""
    package, _, short = name.partition(".")
    if not short.isidentifier():
        return None
    if package == "foxglove":
        modules = [f"foxglove_schemas_protobuf.{short}_pb2"]
    elif package == "locatk":
        names = [module.name for module in pkgutil.iter_modules(proto.__path__)]
        modules = [f"{proto.__name__}.{each}" for each in names if each.endswith("_pb2")]
    else:
        return None
    for module in modules:
        try:
            found = getattr(importlib.import_module(module), short, None)
        except ImportError:
            continue
        if isinstance(found, type) and issubclass(found, Message):
            return found
    return None


def pieces(
    path: str | os.PathLike[str], found: Salvage
) -> Iterator[bytes | memoryview | Attachment | Metadata]:
    """What is left of a file, in its order; messages as the records of a chunk.

    Raises
    ------
    FormatError
        It is not as it was when it was searched.
    """
    index = found.index
    places: list[tuple[int, Any]] = [
        *((segment.offset, segment) for segment in index.segments),
        *((entry.offset, entry) for entry in index.attachments),
        *found.metadata,
    ]
    with reading(path) as stream:
        for offset, piece in sorted(places, key=lambda place: place[0]):
            if isinstance(piece, Metadata):
                yield piece
            elif isinstance(piece, Segment):
                data = mcap_records.unpacked(stream, piece)
                if inside(data) is None:
                    raise DamageError("the file changes while it is read", offset)
                yield data
            else:
                yield _attachment(stream, offset)


def _attachment(stream: IO[bytes], offset: int) -> Attachment:
    content = mcap_records.record_at(stream, offset, Opcode.ATTACHMENT)
    crc = int.from_bytes(content[-4:], "little")
    if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
        raise DamageError("an attachment is damaged", offset)
    return mcap_records.parse(Attachment.read, content, offset)


class Copy:
    """Takes the pieces of a file and writes them with ``writer``.

    Attributes
    ----------
    topics : dict of int to (str, str)
        Topic and name of the schema of each channel, by its new id.
    new_ids : dict of int to int
        Of the channels, by their old ids.
    counts : Counter of int
        Messages written, by new id.
    missing : dict of int to int
        Of channels with raw bytes: how many their offsets leave out, by new id.
    orphans : int
        Messages left out, as nothing says what they are.
    nameless : list of str
        Topics whose schema is lost; they are written without.
    attachments, metadata : int
        Written.
    """

    def __init__(self, writer: Writer, found: Salvage, *, first_byte: int | None) -> None:
        self._writer = writer
        self._first_byte = first_byte
        self._schemas: dict[int, Schema] = {}
        self.new_ids: dict[int, int] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {}
        self._new_channels: dict[tuple[Any, ...], int] = {}
        self._next_byte: dict[int, int | None] = {}
        self.topics: dict[int, tuple[str, str]] = {}
        self.counts: Counter[int] = Counter()
        self.missing: dict[int, int] = {}
        self.orphans = 0
        self.nameless: list[str] = []
        self.attachments = 0
        self.metadata = 0
        index = found.index
        for schema in index.schemas.values():
            if (Opcode.SCHEMA, schema.id) not in found.conflicts:
                self._schemas[schema.id] = schema
        for _, channel in sorted(index.channels.items()):
            # What is defined in several ways is known only behind its definitions.
            if (Opcode.CHANNEL, channel.id) not in found.conflicts and (
                (Opcode.SCHEMA, channel.schema_id) not in found.conflicts
            ):
                self._register(channel)

    def take(self, piece: bytes | memoryview | Attachment | Metadata) -> None:
        """Write one of :func:`pieces`."""
        if isinstance(piece, Attachment):
            self._writer.flush()  # or it would stand before messages that came earlier
            self._writer.add_attachment(
                piece.create_time, piece.log_time, piece.name, piece.media_type, piece.data
            )
            self.attachments += 1
        elif isinstance(piece, Metadata):
            self._writer.flush()
            told = piece.metadata
            if piece.name == CHANNELS:
                new = {str(old): str(new) for old, new in self.new_ids.items()}
                told = {new[key]: text for key, text in told.items() if key in new}
            self._writer.add_metadata(piece.name, told)
            self.metadata += 1
        else:
            self._take_records(piece)

    def _take_records(self, data: bytes | memoryview) -> None:
        position, end = 0, len(data)
        unpack_frame, unpack_message = FRAME.unpack_from, MESSAGE.unpack_from
        while position < end:
            opcode, length = unpack_frame(data, position)
            start = position + FRAME.size
            position = start + length
            if opcode == Opcode.MESSAGE:
                old, sequence, log_ns, publish_ns = unpack_message(data, start)
                new = self.new_ids.get(old)
                if new is None:
                    self.orphans += 1
                    continue
                payload = bytes(data[start + MESSAGE.size : position])
                self._writer.add_message(new, log_ns, payload, publish_ns, sequence)
                self.counts[new] += 1
                if new in self.missing:
                    self._count_bytes(new, payload)
            elif opcode == Opcode.SCHEMA:
                schema = mcap_records.parse(Schema.read, data[start:position], start)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = mcap_records.parse(Channel.read, data[start:position], start)
                self._register(channel)

    def _register(self, channel: Channel) -> None:
        """From here on, messages of this channel's id are this channel's."""
        schema = self._schemas.get(channel.schema_id)
        what = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        facts = tuple(sorted(channel.metadata.items()))
        key = (channel.topic, channel.message_encoding, what, facts)
        if key not in self._new_channels:
            if schema is not None and what not in self._new_schemas:
                self._new_schemas[what] = self._writer.register_schema(*what)
            new = self._writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._new_schemas[what] if schema else 0,
                channel.metadata,
            )
            self._new_channels[key] = new
            self.topics[new] = (channel.topic, what[0])
            if schema is None and channel.schema_id:
                self.nameless.append(channel.topic)
            if (what[0], channel.message_encoding) == (_SERIAL, "protobuf"):
                self.missing[new] = 0
                self._next_byte[new] = self._first_byte
        self.new_ids[channel.id] = self._new_channels[key]

    def _count_bytes(self, new: int, payload: bytes) -> None:
        try:
            chunk = SerialChunk.FromString(payload)
        except DecodeError:
            return
        expected = self._next_byte[new]
        if expected is not None:
            self.missing[new] += max(0, chunk.byte_offset - expected)
        self._next_byte[new] = chunk.byte_offset + len(chunk.data)


def check(path: str, copy: Copy) -> None:
    """Read back what was written, all of it.

    Raises
    ------
    DamageError
        It cannot be read, or is not what was written.
    """
    counts: Counter[int] = Counter()
    with open(path, "rb") as stream:
        index = mcap_records.read_index(stream)
        for segment in index.segments:
            messages = mcap_records.read_messages(stream, segment, index.channels)
            counts.update(channel for channel, _, _ in messages)
        for entry in index.attachments:
            _attachment(stream, entry.offset)
    if counts != copy.counts or index.counts != copy.counts:
        raise DamageError("other messages than were written")
    if len(index.attachments) != copy.attachments:
        raise DamageError("other attachments than were written")
