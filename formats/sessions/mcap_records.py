"""The records of an MCAP file, checked: where they are, and what the chunks hold.

The stock reader needs 5 us a message, believes a damaged chunk unless told otherwise,
and says nothing useful about a file that is cut short (facts of mcap 1.6). Here the
records of the summary are still parsed by ``mcap.records``; framing, checksums and the
walk through the chunks are own. Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, TypeVar

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
FOOTER_SIZE = 9 + 20
LOOSE_SEGMENT = 4 << 20
"""Bytes after which a run of messages outside chunks is split, to bound memory."""

_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_FOOTER = struct.Struct("<BQQQI")

_Record = TypeVar("_Record")


class DamageError(Exception):
    """The file breaks the format; ``offset`` is the byte at which it was noticed."""

    def __init__(self, message: str, offset: int | None = None) -> None:
        super().__init__(message)
        self.offset = offset


class NotMcapError(DamageError):
    """The file is empty, or something else."""


@dataclass(frozen=True)
class Segment:
    """A part of the file that holds messages: one chunk, or a run of records outside.

    ``channels`` are the ids of the channels inside, None where not known; ``indexes``
    says at which byte of the file the index of a channel's messages is, where there is one.
    """

    offset: int
    length: int
    is_chunk: bool
    channels: frozenset[int] | None = None
    indexes: tuple[tuple[int, int], ...] = ()


@dataclass
class Index:
    """What is where in a file. ``damage`` says why it is not complete, if it is not."""

    header: records.Header = field(default_factory=lambda: records.Header("", ""))
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int | None = None
    segments: list[Segment] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damage: str | None = None

    def add_message(self, channel: int, time_ns: int) -> None:
        """Count a message found by walking."""
        self.counts[channel] += 1
        self.start_ns = time_ns if self.start_ns is None else min(self.start_ns, time_ns)
        self.end_ns = time_ns if self.end_ns is None else max(self.end_ns, time_ns)


def read_index(stream: IO[bytes]) -> Index:
    """Index of a file from its summary; of a whole file without one, by walking it.

    Raises
    ------
    DamageError
        The file is cut short or its summary is damaged.
    """
    size = stream.seek(0, os.SEEK_END)
    header = _header(stream, size)
    tail_offset = size - FOOTER_SIZE - len(MAGIC)
    if tail_offset < len(MAGIC):
        raise DamageError("the file is cut short", size)
    tail = _read(stream, tail_offset, FOOTER_SIZE + len(MAGIC))
    opcode, length, summary_start, _, crc = _FOOTER.unpack(tail[:FOOTER_SIZE])
    if not tail.endswith(MAGIC) or opcode != Opcode.FOOTER or length != 20:
        raise DamageError("the file is cut short: the index at its end is missing", size)
    if summary_start == 0:
        return walk_index(stream)
    if not len(MAGIC) <= summary_start <= tail_offset:
        raise DamageError("the footer is damaged", tail_offset)
    summary = _read(stream, summary_start, tail_offset - summary_start)
    if crc and zlib.crc32(tail[: FOOTER_SIZE - 4], zlib.crc32(summary)) != crc:
        raise DamageError("the summary is damaged (wrong checksum)", summary_start)
    index = _index_of_summary(stream, summary, summary_start)
    if index is None:
        return walk_index(stream)
    index.header = header
    return index


def _index_of_summary(stream: IO[bytes], summary: bytes, offset: int) -> Index | None:
    """Index from the records of a summary; None where it leaves something out."""
    index = Index()
    statistics: records.Statistics | None = None
    metadata: list[records.MetadataIndex] = []
    content: bytes | memoryview
    for opcode, start, content in frames(summary, offset):
        if opcode == Opcode.SCHEMA:
            schema = parse(records.Schema.read, content, start)
            index.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(records.Channel.read, content, start)
            index.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = parse(records.Statistics.read, content, start)
        elif opcode == Opcode.CHUNK_INDEX:
            index.segments.append(_indexed_chunk(content, start))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            index.attachments.append(parse(records.AttachmentIndex.read, content, start))
        elif opcode == Opcode.METADATA_INDEX:
            metadata.append(parse(records.MetadataIndex.read, content, start))
    if (
        statistics is None
        or statistics.chunk_count != len(index.segments)
        or (statistics.message_count and not index.segments)
        or statistics.attachment_count != len(index.attachments)
        or statistics.metadata_count != len(metadata)
        or not statistics.channel_message_counts.keys() <= index.channels.keys()
    ):
        return None
    index.counts.update(statistics.channel_message_counts)
    if statistics.message_count:
        index.start_ns = statistics.message_start_time
        index.end_ns = statistics.message_end_time
    index.segments.sort(key=lambda segment: segment.offset)
    for entry in metadata:
        content = record_at(stream, entry.offset, Opcode.METADATA)
        found = parse(records.Metadata.read, content, entry.offset)
        index.metadata.setdefault(found.name, {}).update(found.metadata)
    return index


def _indexed_chunk(content: memoryview, offset: int) -> Segment:
    """The chunk of a chunk index; an hour's recording has 18000, slow by ``mcap.records``."""
    try:
        _, _, start, length, size = _CHUNK_INDEX.unpack_from(content)
        entries = content[_CHUNK_INDEX.size :][:size]
        at = dict(struct.iter_unpack("<HQ", entries))
        if len(entries) != size:
            raise struct.error
    except struct.error:
        raise DamageError("a record is damaged", offset) from None
    return Segment(start, length, True, frozenset(at) or None, tuple(at.items()))


def walk_index(stream: IO[bytes]) -> Index:
    """Index of a file by walking all its records, as far as they go.

    Does not fail on a damaged file: ``damage`` of the result says where and why the
    walk ended early, or which chunk could not be read.

    Raises
    ------
    NotMcapError
        The file is empty or does not start as MCAP.
    """
    size = stream.seek(0, os.SEEK_END)
    index = Index()
    try:
        index.header = _header(stream, size)
    except NotMcapError:
        raise
    except DamageError as damage:
        index.damage = str(damage)
    position = len(MAGIC)
    while True:
        frame = stream.read(_FRAME.size) if stream.seek(position) == position else b""
        if len(frame) < _FRAME.size:
            index.damage = index.damage or f"the file is cut short at byte {size}"
            return index
        opcode, length = _FRAME.unpack(frame)
        end = position + _FRAME.size + length
        if opcode == 0 or end > size:
            index.damage = index.damage or f"the file ends inside a record at byte {position}"
            return index
        if opcode == Opcode.FOOTER:
            if _read(stream, end, size - end) != MAGIC:
                index.damage = index.damage or "the end of the file is damaged"
            return index
        try:
            _walk_record(stream, index, opcode, position, _FRAME.size + length)
        except DamageError as damage:
            index.damage = index.damage or f"{damage} at byte {damage.offset or position}"
        position = end


def _walk_record(stream: IO[bytes], index: Index, opcode: int, offset: int, length: int) -> None:
    if opcode == Opcode.CHUNK:
        data = decompress(record_at(stream, offset, Opcode.CHUNK), offset)
        before = index.counts.copy()
        for inner, start, inside in frames(data, 0):
            _walk_content(index, inner, inside, start)
        channels = frozenset((index.counts - before).keys())
        index.segments.append(Segment(offset, length, True, channels))
    elif opcode == Opcode.MESSAGE:
        _walk_content(index, opcode, _read(stream, offset + _FRAME.size, _MESSAGE.size), offset)
        last = index.segments[-1] if index.segments else None
        if last and not last.is_chunk and offset + length - last.offset <= LOOSE_SEGMENT:
            index.segments[-1] = Segment(last.offset, offset + length - last.offset, False)
        else:
            index.segments.append(Segment(offset, length, False))
    elif opcode == Opcode.ATTACHMENT:
        content = record_at(stream, offset, Opcode.ATTACHMENT)
        a = parse(records.Attachment.read, content, offset)
        times = (a.log_time, a.create_time)
        entry = records.AttachmentIndex(offset, length, *times, len(a.data), a.name, a.media_type)
        index.attachments.append(entry)
    elif opcode == Opcode.METADATA:
        content = record_at(stream, offset, Opcode.METADATA)
        found = parse(records.Metadata.read, content, offset)
        index.metadata.setdefault(found.name, {}).update(found.metadata)
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        _walk_content(index, opcode, record_at(stream, offset, Opcode(opcode)), offset)


def _walk_content(index: Index, opcode: int, content: bytes | memoryview, offset: int) -> None:
    if opcode == Opcode.SCHEMA:
        schema = parse(records.Schema.read, content, offset)
        index.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = parse(records.Channel.read, content, offset)
        index.channels[channel.id] = channel
    elif opcode == Opcode.MESSAGE:
        if len(content) < _MESSAGE.size:
            raise DamageError("a message is damaged", offset)
        channel_id, _, time_ns, _ = _MESSAGE.unpack_from(content)
        index.add_message(channel_id, time_ns)


def read_messages(
    stream: IO[bytes], segment: Segment, wanted: Collection[int]
) -> Iterator[tuple[int, int, bytes]]:
    """Messages (channel id, log time in ns, payload) of one segment, in file order.

    ``wanted`` are the ids of the channels to give.

    Raises
    ------
    DamageError
        The segment is not what the index says, or its checksum is wrong.
    """
    data = unpacked(stream, segment)
    # One chunk may hold tens of thousands of messages: no call a record in this loop.
    position, end = 0, len(data)
    unpack_frame, unpack_message = _FRAME.unpack_from, _MESSAGE.unpack_from
    while position < end:
        try:
            opcode, length = unpack_frame(data, position)
            start = position + 9
            position = start + length
            if position > end:
                raise DamageError("a record runs over the end of its chunk", segment.offset)
            if opcode == 5:  # MESSAGE
                if length < 22:
                    raise DamageError("a message is damaged", segment.offset)
                channel, _, time_ns, _ = unpack_message(data, start)
                if channel in wanted:
                    yield channel, time_ns, bytes(data[start + 22 : position])
        except struct.error:
            raise DamageError("a record is damaged", segment.offset) from None


def unpacked(stream: IO[bytes], segment: Segment) -> bytes | memoryview:
    """Records of one segment, one after the other.

    Raises
    ------
    DamageError
        The segment is not what the index says, or its checksum is wrong.
    """
    if not segment.is_chunk:
        return _read(stream, segment.offset, segment.length)
    content = record_at(stream, segment.offset, Opcode.CHUNK)
    if len(content) + _FRAME.size != segment.length:
        raise DamageError("a chunk is damaged", segment.offset)
    return decompress(content, segment.offset)


def decompress(content: bytes, offset: int) -> bytes | memoryview:
    """Records inside the chunk whose content is given, after its checksum was verified."""
    try:
        _, _, size, crc = _CHUNK.unpack_from(content)
        position = _CHUNK.size
        (name_length,) = struct.unpack_from("<I", content, position)
        compression = bytes(content[position + 4 : position + 4 + name_length])
        position += 4 + name_length
        (length,) = struct.unpack_from("<Q", content, position)
    except struct.error:
        raise DamageError("a chunk is damaged", offset) from None
    packed = memoryview(content)[position + 8 :]
    if length != len(packed):
        raise DamageError("a chunk is damaged", offset)
    if compression == b"":
        data: bytes | memoryview = packed
    elif compression in (b"zstd", b"lz4"):
        data = _unpack(compression, packed, size, offset)
    else:
        raise DamageError(f"a chunk is packed with unknown {compression[:20]!r}", offset)
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise DamageError("a chunk is damaged (wrong checksum)", offset)
    return data


def _unpack(compression: bytes, packed: memoryview, size: int, offset: int) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]
    import zstandard

    try:
        if compression == b"lz4":
            # Bounded; one byte more than there should be shows that it is longer.
            return lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1)
        # A damaged frame may claim any size: believe it only where the chunk agrees.
        claimed = zstandard.get_frame_parameters(packed).content_size
        if claimed not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise DamageError("a chunk is damaged", offset)
        return zstandard.decompress(packed, size)
    except (zstandard.ZstdError, RuntimeError, MemoryError, OverflowError):
        raise DamageError("a chunk is damaged (it cannot be unpacked)", offset) from None


def frames(data: bytes | memoryview, offset: int) -> Iterator[tuple[int, int, memoryview]]:
    """Records (opcode, offset, content) one after the other in ``data``."""
    view = memoryview(data)
    position = 0
    while position < len(view):
        if position + _FRAME.size > len(view):
            raise DamageError("a record is cut short", offset + position)
        opcode, length = _FRAME.unpack_from(view, position)
        start = position + _FRAME.size
        if start + length > len(view):
            raise DamageError("a record is cut short", offset + position)
        yield opcode, offset + position, view[start : start + length]
        position = start + length


def record_at(stream: IO[bytes], offset: int, opcode: Opcode) -> bytes:
    """Content of the record at ``offset``, which must be of kind ``opcode``."""
    found, length = _FRAME.unpack(_read(stream, offset, _FRAME.size))
    if found != opcode:
        raise DamageError(f"no {opcode.name.lower()} record where the index says", offset)
    return _read(stream, offset + _FRAME.size, length)


def parse(
    reader: Callable[[ReadDataStream], _Record], content: bytes | memoryview, offset: int
) -> _Record:
    """``content`` through a reader of ``mcap.records``, its many exceptions made one."""
    try:
        return reader(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, ValueError, MemoryError, OverflowError):
        raise DamageError("a record is damaged", offset) from None


def _header(stream: IO[bytes], size: int) -> records.Header:
    stream.seek(0)
    if size == 0:
        raise NotMcapError("the file is empty")
    if stream.read(len(MAGIC)) != MAGIC:
        raise NotMcapError("not an MCAP file")
    content = record_at(stream, len(MAGIC), Opcode.HEADER)
    return parse(records.Header.read, content, len(MAGIC))


def _read(stream: IO[bytes], offset: int, length: int) -> bytes:
    # Compare with the size of the file first: a damaged length may be any number.
    if offset + length > stream.seek(0, os.SEEK_END):
        raise DamageError("the file is cut short", offset)
    stream.seek(offset)
    data = stream.read(length)
    if len(data) != length:
        raise DamageError("the file is cut short", offset)
    return data
