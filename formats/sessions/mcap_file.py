"""Index, chunks and messages of an MCAP file, with every checksum verified.

``mcap.records`` (mcap 1.6) parses records, except chunk indexes, of which a long recording has tens
of thousands. The loop over the messages of a chunk, their positions and the checksums are own code.
Compared with ``SeekingReader(stream, validate_crcs=True)`` of the library, measured on one core:

==================================================  =======  ===========
task                                                library  this module
==================================================  =======  ===========
180,000 messages of a capture of one hour (1.0 GB)    4.5 s        1.4 s
200,000 poses of one topic, of two                    2.0 s       0.20 s
index of 54,000 chunks                                0.44 s       0.31 s
==================================================  =======  ===========

The library ignores the checksums of the summary and of attachments, decompresses a chunk to any
size that its data claim, and offers no access to a single message, which camera frames need.
Damaged files are searched by :mod:`locatk.formats.sessions.recovery.salvage`.
Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, NamedTuple, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"

SESSION_RECORD = "locatk"
"""Name of the metadata record of every file of locatk: kind, system, versions."""

CAPTURE_RECORD = "capture"
"""Name of the metadata record of a recording: port, device, times and counts."""

CHANNELS_RECORD = "channels"
"""Name of the metadata record of a live recording that lists its channels: id to topic and schema.

If the chunk that defines a channel is damaged, its messages can still be identified.
"""

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the content of a record."""

MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, log time and publish time of a message."""

MAX_TIME_NS = (1 << 63) - 1
"""Latest time of a message that is read [ns since 1970]; MCAP permits twice of it."""

FOOTER_BYTES = RECORD_HEAD.size + 20

MAX_RUN_BYTES = 4 << 20
"""A run of messages outside chunks is split at this size, which bounds the memory of a reader."""

MAX_RECORD_BYTES = 1 << 30
"""Largest record that is read, and largest decompressed chunk.

Chunks have some megabytes (the specification recommends it), and compressed zeros of some
kilobytes can claim any size. Attachments may be larger if they are copied instead of read.
"""

_FOOTER = struct.Struct("<BQQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")

PARSE_ERRORS = (McapError, struct.error, ValueError, MemoryError, OverflowError)
"""Exceptions of ``mcap`` for damaged data."""

_Record = TypeVar("_Record")


class DamageError(Exception):
    """The file violates the format; ``offset`` is the byte where that was noticed."""

    def __init__(self, message: str, offset: int | None = None) -> None:
        super().__init__(message)
        self.offset = offset


class NotMcapError(DamageError):
    """The file is empty or of another format."""


@dataclass(frozen=True)
class Segment:
    """Part of a file that holds messages: a chunk, or a run of messages outside chunks.

    Attributes
    ----------
    offset, length : int
        Bytes of the file.
    is_chunk : bool
    channels : frozenset of int or None
        Ids of the channels that have messages in it; None if unknown.
    message_indexes : tuple of (int, int)
        Channel, and offset of the record that lists its messages; empty without such records.
    """

    offset: int
    length: int
    is_chunk: bool
    channels: frozenset[int] | None = None
    message_indexes: tuple[tuple[int, int], ...] = ()


class MessagePosition(NamedTuple):
    """Position of one message: its segment, and the byte in the decompressed segment."""

    channel: int
    time_ns: int
    segment: Segment
    offset: int


@dataclass
class Index:
    """Contents of a file.

    ``damage`` describes why the index is incomplete, if it is. ``metadata_count`` is the number of
    metadata records, of which several may have the same name.
    """

    header: records.Header = field(default_factory=lambda: records.Header("", ""))
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int | None = None
    segments: list[Segment] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    metadata_count: int = 0
    damage: str | None = None

    def segments_with(self, channels: Collection[int]) -> list[Segment]:
        """Return the segments that may hold messages of ``channels`` (ids)."""
        return [
            segment
            for segment in self.segments
            if segment.channels is None or not segment.channels.isdisjoint(channels)
        ]

    def include_times(self, first_ns: int, last_ns: int) -> None:
        """Extend the time span of the messages."""
        self.start_ns = first_ns if self.start_ns is None else min(self.start_ns, first_ns)
        self.end_ns = last_ns if self.end_ns is None else max(self.end_ns, last_ns)

    def add_metadata(self, record: records.Metadata) -> None:
        """Add a metadata record; of equal names the later one wins, key by key."""
        self.metadata.setdefault(record.name, {}).update(record.metadata)
        self.metadata_count += 1


# ---- the summary


def read_summary(stream: IO[bytes]) -> Index | None:
    """Read the index of a file from the summary at its end.

    Returns None if the file is whole and its writer left out the summary or parts of it.

    Raises
    ------
    NotMcapError
        The file is empty or does not begin as MCAP.
    DamageError
        The file is cut short, or its summary or a metadata record is damaged.
    """
    size = stream.seek(0, os.SEEK_END)
    header = _read_header(stream, size)
    tail_offset = size - FOOTER_BYTES - len(MAGIC)
    if tail_offset < len(MAGIC):
        raise DamageError("the file is cut short", size)
    tail = read_bytes_at(stream, tail_offset, FOOTER_BYTES + len(MAGIC))
    opcode, length, summary_start, _, crc = _FOOTER.unpack(tail[:FOOTER_BYTES])
    if not tail.endswith(MAGIC) or opcode != Opcode.FOOTER or length != 20:
        raise DamageError("the file is cut short: the index at its end is missing", size)
    if summary_start == 0:
        return None
    if not len(MAGIC) <= summary_start <= tail_offset:
        raise DamageError("the footer is damaged", tail_offset)
    data = read_bytes_at(stream, summary_start, tail_offset - summary_start)
    if crc and zlib.crc32(tail[: FOOTER_BYTES - 4], zlib.crc32(data)) != crc:
        raise DamageError("the summary is damaged (wrong checksum)", summary_start)
    index, statistics, metadata_offsets = _parse_summary(data, summary_start)
    if statistics is None or not _is_complete(index, statistics, metadata_offsets):
        return None
    index.header = header
    if statistics.message_count:
        index.counts.update(statistics.channel_message_counts)
        index.include_times(statistics.message_start_time, statistics.message_end_time)
    index.segments.sort(key=lambda segment: segment.offset)
    for offset in metadata_offsets:
        content = read_record(stream, offset, Opcode.METADATA)
        index.add_metadata(parse(records.Metadata.read, content, offset))
    return index


def _read_header(stream: IO[bytes], size: int) -> records.Header:
    stream.seek(0)
    if size == 0:
        raise NotMcapError("the file is empty")
    if stream.read(len(MAGIC)) != MAGIC:
        raise NotMcapError("not an MCAP file")
    content = read_record(stream, len(MAGIC), Opcode.HEADER)
    return parse(records.Header.read, content, len(MAGIC))


def _parse_summary(data: bytes, offset: int) -> tuple[Index, records.Statistics | None, list[int]]:
    """Parse the summary at byte ``offset``.

    Returns
    -------
    (Index, Statistics or None, list of int)
        Schemas, channels, chunks and attachments; the statistics; the offsets of the metadata
        records.
    """
    index, metadata_offsets = Index(), []
    statistics: records.Statistics | None = None
    for opcode, start, end in iter_records(data, offset):
        content, position = data[start:end], offset + start - RECORD_HEAD.size
        if opcode == Opcode.SCHEMA:
            schema = parse(records.Schema.read, content, position)
            index.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(records.Channel.read, content, position)
            index.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = parse(records.Statistics.read, content, position)
        elif opcode == Opcode.CHUNK_INDEX:
            index.segments.append(_parse_chunk_index(content, position))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            index.attachments.append(parse(records.AttachmentIndex.read, content, position))
        elif opcode == Opcode.METADATA_INDEX:
            entry = parse(records.MetadataIndex.read, content, position)
            metadata_offsets.append(entry.offset)
    return index, statistics, metadata_offsets


def _parse_chunk_index(content: bytes, offset: int) -> Segment:
    """Return the chunk that a chunk index describes."""
    try:
        _, _, start, length, size = _CHUNK_INDEX.unpack_from(content)
        entries = content[_CHUNK_INDEX.size :][:size]
        indexes = dict(struct.iter_unpack("<HQ", entries))
    except struct.error:
        raise DamageError("a record is damaged", offset) from None
    if len(entries) != size:
        raise DamageError("a record is damaged", offset)
    return Segment(start, length, True, frozenset(indexes) or None, tuple(indexes.items()))


def _is_complete(index: Index, statistics: records.Statistics, metadata_offsets: list[int]) -> bool:
    """Return whether a summary lists everything that its statistics count."""
    return (
        statistics.chunk_count == len(index.segments)
        and (statistics.message_count == 0 or statistics.chunk_count > 0)
        and statistics.attachment_count == len(index.attachments)
        and statistics.metadata_count == len(metadata_offsets)
        and statistics.channel_message_counts.keys() <= index.channels.keys()
    )


# ---- messages


def read_messages(
    stream: IO[bytes], segment: Segment, channels: Collection[int], *, use_index: bool = False
) -> Iterator[tuple[int, int, bytes]]:
    """Yield (channel id, log time in ns, payload) of the messages of a segment, in file order.

    Parameters
    ----------
    stream : binary file
    segment : Segment
    channels : collection of int
        Ids of the channels to read.
    use_index : bool
        Use the message indexes, if they agree with the segment: faster if most messages are of
        other channels. Messages that an index omits are not read.

    Raises
    ------
    DamageError
        The segment does not agree with the index, or its checksum is wrong.
    """
    data = read_segment(stream, segment)
    if use_index and segment.message_indexes:
        with contextlib.suppress(DamageError):
            positions = find_messages(stream, segment, channels)
            payloads = [message_payload(data, position) for position in positions]
            if len({position.offset for position in positions}) == len(positions):
                for position, payload in zip(positions, payloads, strict=True):
                    yield position.channel, position.time_ns, payload
                return
    for opcode, start, end in iter_records(data, segment.offset):
        if opcode == 5:  # Opcode.MESSAGE, whose comparison takes as long as the rest of the loop
            channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
            if channel in channels:
                yield channel, time_ns, bytes(data[start + 22 : end])


def find_messages(
    stream: IO[bytes], segment: Segment, channels: Collection[int]
) -> list[MessagePosition]:
    """Find the messages of ``channels`` in a segment, in file order.

    The segment is decompressed only if it has no message index.

    Raises
    ------
    DamageError
        The message index or the segment is damaged.
    """
    if segment.message_indexes:
        found = [
            MessagePosition(channel, time_ns, segment, offset)
            for channel, index_offset in segment.message_indexes
            if channel in channels
            for time_ns, offset in _read_message_index(stream, index_offset, channel)
        ]
        return sorted(found, key=lambda position: position.offset)
    data, found = read_segment(stream, segment), []
    for opcode, start, _ in iter_records(data, segment.offset):
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
            if channel in channels:
                offset = start - RECORD_HEAD.size
                found.append(MessagePosition(channel, time_ns, segment, offset))
    return found


def _read_message_index(stream: IO[bytes], offset: int, channel: int) -> list[list[int]]:
    """Return (time in ns, offset) of each message in the message index of a channel."""
    content = read_record(stream, offset, Opcode.MESSAGE_INDEX)
    if len(content) < 6 or (len(content) - 6) % 16:
        raise DamageError("a message index is damaged", offset)
    if struct.unpack_from("<HI", content) != (channel, len(content) - 6):
        raise DamageError("a message index is damaged", offset)
    entries: list[list[int]] = np.frombuffer(content, "<u8", offset=6).reshape(-1, 2).tolist()
    return entries


def message_payload(data: bytes | memoryview, position: MessagePosition) -> bytes:
    """Return the payload of a message in its decompressed segment.

    Raises
    ------
    DamageError
        There is another record at this position.
    """
    start = position.offset + RECORD_HEAD.size
    if start + MESSAGE_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, position.offset)
        channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
        payload = bytes(data[start + MESSAGE_HEAD.size : start + length])
        if (
            (opcode, channel, time_ns) == (Opcode.MESSAGE, position.channel, position.time_ns)
            and len(payload) == length - MESSAGE_HEAD.size
        ):  # fmt: skip
            return payload
    raise DamageError("the index names a message that is not there", position.segment.offset)


# ---- chunks and records


def read_segment(stream: IO[bytes], segment: Segment) -> bytes | memoryview:
    """Read the records of a segment, decompressed.

    Raises
    ------
    DamageError
        The segment does not agree with the index, or its checksum is wrong.
    """
    if not segment.is_chunk:
        return read_bytes_at(stream, segment.offset, segment.length)
    content = read_record(stream, segment.offset, Opcode.CHUNK)
    if len(content) + RECORD_HEAD.size != segment.length:
        raise DamageError("a chunk is damaged", segment.offset)
    return decompress(content, segment.offset)


def decompress(content: bytes, offset: int) -> bytes:
    """Return the records in the chunk at byte ``offset``, whose content is given.

    Raises
    ------
    DamageError
        The checksum is wrong, or the data are not of the length that the chunk states.
    """
    chunk = parse(records.Chunk.read, content, offset)
    size, data = chunk.uncompressed_size, chunk.data
    if size > MAX_RECORD_BYTES:
        raise DamageError(f"a chunk claims {size:,} bytes", offset)
    try:
        if chunk.compression == "lz4":
            # The decompressor stops one byte after the stated size, if the data are longer.
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
        elif chunk.compression == "zstd":
            # A damaged frame can claim any size, for which memory would be allocated.
            claimed = zstandard.get_frame_parameters(data).content_size
            if claimed not in (size, zstandard.CONTENTSIZE_UNKNOWN):
                raise DamageError("a chunk is damaged", offset)
            data = zstandard.decompress(data, size)
        elif chunk.compression:
            raise DamageError(f"a chunk has unknown compression {chunk.compression[:20]!r}", offset)
    except (zstandard.ZstdError, RuntimeError, MemoryError, OverflowError):
        raise DamageError("a chunk is damaged (it cannot be decompressed)", offset) from None
    crc = chunk.uncompressed_crc
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise DamageError("a chunk is damaged (wrong checksum)", offset)
    return data


def read_attachment(stream: IO[bytes], offset: int) -> records.Attachment:
    """Read the attachment at byte ``offset``.

    Raises
    ------
    DamageError
        It is damaged.
    """
    content = read_record(stream, offset, Opcode.ATTACHMENT)
    crc = int.from_bytes(content[-4:], "little")
    if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
        raise DamageError("wrong checksum", offset)
    return parse(records.Attachment.read, content, offset)


def iter_records(data: bytes | memoryview, offset: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the records in ``data``; the bounds are of their content.

    Messages are long enough for their head. ``offset`` is the byte of the file that errors name.

    Raises
    ------
    DamageError
        The lengths of the records do not agree with that of ``data``.
    """
    position, size = 0, len(data)
    unpack = RECORD_HEAD.unpack_from
    while position < size:
        if size - position < 9:
            raise DamageError("a record is cut short", offset)
        opcode, length = unpack(data, position)
        start = position + 9
        position = start + length
        if position > size or (opcode == 5 and length < 22):  # Opcode.MESSAGE
            raise DamageError("a record is damaged", offset)
        yield opcode, start, position


def read_record(stream: IO[bytes], offset: int, opcode: Opcode) -> bytes:
    """Read the content of the record at ``offset``, which must be of kind ``opcode``."""
    found, length = RECORD_HEAD.unpack(read_bytes_at(stream, offset, RECORD_HEAD.size))
    if found != opcode:
        raise DamageError(f"no {opcode.name.lower()} record where the index names one", offset)
    return read_bytes_at(stream, offset + RECORD_HEAD.size, length)


def parse(
    reader: Callable[[ReadDataStream], _Record], content: bytes | memoryview, offset: int
) -> _Record:
    """Parse ``content`` with a reader of ``mcap.records``; its exceptions become DamageError."""
    try:
        return reader(ReadDataStream(BytesIO(content)))
    except PARSE_ERRORS:
        raise DamageError("a record is damaged", offset) from None


def read_bytes_at(stream: IO[bytes], offset: int, length: int) -> bytes:
    """Read exactly ``length`` bytes; raise DamageError if the file is shorter."""
    # A damaged length may be any number: compare before memory is allocated.
    if offset + length > stream.seek(0, os.SEEK_END):
        raise DamageError("the file is cut short", offset)
    if length > MAX_RECORD_BYTES:
        raise DamageError(f"a record of {length:,} bytes", offset)
    stream.seek(offset)
    data = stream.read(length)
    if len(data) != length:
        raise DamageError("the file is cut short", offset)
    return data
