"""What a record of a damaged MCAP file must be like to be believed, and how to find such ones.

A chunk and an attachment prove themselves by their checksum (where the writer left it out: by
lengths that agree, and content that is records), the other kinds by lengths that agree to the
last byte and texts that are UTF-8. No length is believed before that, so that a flipped bit
asks neither for memory nor for time. Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from io import BytesIO
from typing import IO, Any, NamedTuple

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from locatk.formats.sessions import mcap_records
from locatk.formats.sessions.mcap_records import MAGIC, DamageError

LARGEST_RECORD = 1 << 30
"""Bytes of a record, and of a chunk when unpacked, that are believed; only attachments may be
larger, as they are not held here."""

LARGEST_HEAD = 1 << 16
"""Bytes of the names of an attachment that are believed."""

CHAIN = 4
"""So many records in a row make a message outside chunks believable."""

FIRST_BLOCK, BLOCK = 1 << 16, 1 << 20
"""Bytes that are searched at once."""

FRAME = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")

READERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: records.Header.read,
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.CHUNK_INDEX: records.ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.STATISTICS: records.Statistics.read,
    Opcode.METADATA: records.Metadata.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
}
_NOT_BEHIND_DATA = (Opcode.HEADER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_LENGTHS = {Opcode.FOOTER: 20, Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4}


class ChunkHead(NamedTuple):
    """What a chunk says of itself."""

    start_ns: int
    end_ns: int
    size: int
    crc: int


class Inside(NamedTuple):
    """What a chunk holds: messages by channel and their times, schemas and channels, and what
    only a copy of it has in common with it."""

    counts: Counter[int]
    span: tuple[int, int] | None
    definitions: list[tuple[Opcode, bytes]]
    key: tuple[int, int]


class AttachmentHead(NamedTuple):
    """What an attachment says of itself."""

    log_ns: int
    create_ns: int
    name: str
    media_type: str
    size: int


class Evidence:
    """The bytes of a file that may be damaged; holds no more than one record."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.size = stream.seek(0, os.SEEK_END)

    def at(self, offset: int, length: int) -> bytes:
        """Bytes of the file; fewer where it ends."""
        self._stream.seek(offset)
        return self._stream.read(max(0, min(length, self.size - offset)))

    def frame(self, position: int) -> tuple[int, int] | None:
        """Opcode and end of what may be a record; None where it does not fit."""
        head = self.at(position, FRAME.size)
        if len(head) < FRAME.size:
            return None
        opcode, length = FRAME.unpack(head)
        end = position + FRAME.size + length
        return (opcode, end) if end <= self.size else None

    def content(self, position: int, end: int) -> bytes:
        """What is in the record from ``position`` to ``end``."""
        return self.at(position + FRAME.size, end - position - FRAME.size)

    def record(self, position: int) -> tuple[Opcode, int] | None:
        """Kind and end of the record at ``position``, whose lengths all agree; else None."""
        frame = self.frame(position)
        if frame is None or not 0 < frame[0] <= Opcode.DATA_END:
            return None
        opcode, end = Opcode(frame[0]), frame[1]
        return (opcode, end) if self._agrees(opcode, position, end) else None

    def _agrees(self, opcode: Opcode, position: int, end: int) -> bool:
        length = end - position - FRAME.size
        if opcode == Opcode.ATTACHMENT:
            return self.attachment_head(position) is not None
        if length > LARGEST_RECORD:
            return False
        if opcode == Opcode.CHUNK:
            return self.chunk_head(position) is not None
        if opcode == Opcode.MESSAGE:
            return length >= MESSAGE.size
        if opcode == Opcode.MESSAGE_INDEX:
            inner = int.from_bytes(self.at(position + FRAME.size + 2, 4), "little")
            return length == 6 + inner and inner % 16 == 0
        if opcode in _LENGTHS:
            return length == _LENGTHS[opcode]
        self._stream.seek(position + FRAME.size)
        return _filling(READERS[opcode], self._stream, length) is not None

    def chunk_head(self, position: int) -> ChunkHead | None:
        """Head of a chunk whose lengths agree, even where the file ends inside it."""
        longest = 4
        head = self.at(position, FRAME.size + _CHUNK.size + longest + 8)
        if len(head) < FRAME.size + _CHUNK.size + 8:
            return None
        opcode, length = FRAME.unpack_from(head)
        start_ns, end_ns, size, crc, name = _CHUNK.unpack_from(head, FRAME.size)
        at = FRAME.size + _CHUNK.size + name
        if opcode != Opcode.CHUNK or len(head) < at + 8:
            return None
        packed = int.from_bytes(head[at : at + 8], "little")
        good = length == _CHUNK.size + name + 8 + packed
        return ChunkHead(start_ns, end_ns, size, crc) if good else None

    def chunk(self, position: int, end: int) -> Inside | None:
        """What a chunk holds whose head agrees; None where its content is damaged."""
        head = self.chunk_head(position)
        if head is None or head.size > LARGEST_RECORD:
            return None
        try:
            return inside(mcap_records.decompress(self.content(position, end), position))
        except DamageError:
            return None

    def attachment_head(self, position: int) -> AttachmentHead | None:
        """Head of an attachment whose lengths agree, even where the file ends inside it."""
        frame = self.at(position, FRAME.size)
        if len(frame) < FRAME.size or frame[0] != Opcode.ATTACHMENT:
            return None
        _, length = FRAME.unpack(frame)
        stream = _Strict(self._stream, LARGEST_HEAD)  # which goes on behind the frame
        try:
            log_ns, create_ns = stream.read8(), stream.read8()
            name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
            size = stream.read8()
        except (McapError, struct.error, ValueError):
            return None
        good = length == stream.count + size + 4
        return AttachmentHead(log_ns, create_ns, name, media_type, size) if good else None

    def attachment_is_right(self, position: int, end: int) -> bool:
        """Whether the checksum of the attachment is right, or the writer left it out.

        Zeros before a checksum of zero are rather the hole that a power cut leaves.
        """
        last = self.at(end - 5, 5)
        crc = int.from_bytes(last[1:], "little")
        if crc == 0:
            return last[:1] != b"\0" and self.goes_on(end)
        return self._crc(position + FRAME.size, end - 4) == crc

    def goes_on(self, position: int) -> bool:
        """Whether a record seems to begin at ``position``, or the file ends there."""
        return (
            position == self.size
            or self.at(position, len(MAGIC)) == MAGIC
            or self.record(position) is not None
        )

    def _crc(self, start: int, end: int) -> int:
        crc = 0
        for offset in range(start, end, BLOCK):
            crc = zlib.crc32(self.at(offset, min(BLOCK, end - offset)), crc)
        return crc

    def only_zeros(self, start: int, end: int) -> bool:
        """Whether all bytes from ``start`` to ``end`` are zero."""
        return not any(
            self.at(offset, min(BLOCK, end - offset)).strip(b"\0")
            for offset in range(start, end, BLOCK)
        )

    # ---- the next record after damage

    def search(self, start: int, limit: int, kinds: Collection[Opcode]) -> int:
        """First byte from ``start`` on at which a record of one of the ``kinds`` proves itself;
        ``limit`` where there is none before it."""
        offset, length = start, FIRST_BLOCK
        while offset < limit:
            length = min(length, limit - offset)
            block = self.at(offset, length + FRAME.size - 1)
            for place in self._candidates(block, offset, kinds):
                if self._proves(place, kinds):
                    return place
            offset, length = offset + length, BLOCK
        return limit

    def _candidates(self, block: bytes, offset: int, kinds: Collection[Opcode]) -> Iterator[int]:
        """Where in ``block``, which is at ``offset``, a record that fits may begin."""
        data = np.frombuffer(block, np.uint8)
        n = len(data) - FRAME.size + 1
        if n <= 0:
            return
        # No record has 2^40 bytes: almost everywhere these three bytes are not all zero.
        zero = data == 0
        begins = zero[6 : n + 6] & zero[7 : n + 7] & zero[8 : n + 8] & ~zero[:n]
        places = np.flatnonzero(begins)
        places = places[np.isin(data[places], [int(kind) for kind in kinds])]
        heads = np.lib.stride_tricks.sliding_window_view(data, FRAME.size)[places, 1:]
        lengths = np.ascontiguousarray(heads).view("<u8")[:, 0].astype(np.int64)
        for place in places[lengths <= self.size - offset - places - FRAME.size]:
            yield offset + int(place)

    def _proves(self, position: int, kinds: Collection[Opcode]) -> bool:
        found = self.record(position)
        if found is None or found[0] not in kinds:
            return False
        opcode, end = found
        if opcode == Opcode.CHUNK:
            return self.chunk(position, end) is not None
        if opcode == Opcode.ATTACHMENT:
            return self.attachment_is_right(position, end)
        if opcode == Opcode.FOOTER:
            return self.at(end, len(MAGIC)) == MAGIC
        if opcode == Opcode.DATA_END:
            follows = self.record(end)
            return follows is not None and follows[0] not in _NOT_BEHIND_DATA
        if opcode == Opcode.MESSAGE:
            return self._chain(position)
        # Zeros make a record without a name.
        record = exact(READERS[opcode], self.content(position, end))
        return bool(record.topic if opcode == Opcode.CHANNEL else record.name)

    def _chain(self, position: int) -> bool:
        for _ in range(CHAIN):
            found = self.record(position)
            if found is None:
                return False
            position = found[1]
            if position == self.size:
                break
        return True


class _Strict(ReadDataStream):
    """Gives as many bytes as asked for, as its parent may not, and no more than ``limit``."""

    def __init__(self, stream: IO[bytes], limit: int) -> None:
        super().__init__(stream)
        self._limit = limit

    def read(self, length: int) -> bytes:
        if length > self._limit - self.count:  # before memory is asked for
            raise EndOfFile
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data

    def read_prefixed_string(self) -> str:
        text = super().read_prefixed_string()
        if "\0" in text:  # zeros are UTF-8, and what a power cut leaves
            raise ValueError
        return text


def exact(reader: Callable[[ReadDataStream], Any], content: bytes) -> Any:
    """The record that fills ``content`` to its last byte, or None."""
    return _filling(reader, BytesIO(content), len(content))


def _filling(reader: Callable[[ReadDataStream], Any], source: IO[bytes], length: int) -> Any:
    """The record that fills the next ``length`` bytes, or None; read only as far as it is one."""
    stream = _Strict(source, length)
    try:
        record = reader(stream)
    except (McapError, struct.error, ValueError, MemoryError, OverflowError):
        return None
    return record if stream.count == length else None


def inside(data: bytes | memoryview) -> Inside | None:
    """What ``data`` holds; None where it is not records one after the other.

    Raises
    ------
    DamageError
        A schema or a channel cannot be read.
    """
    times: list[int] = []
    counts: Counter[int] = Counter()
    definitions: list[tuple[Opcode, bytes]] = []
    position, end = 0, len(data)
    unpack_frame, unpack_message = FRAME.unpack_from, MESSAGE.unpack_from
    while position < end:  # no call a record: a chunk may hold tens of thousands
        if position + 9 > end:
            return None
        opcode, length = unpack_frame(data, position)
        start = position + 9
        position = start + length
        if position > end:
            return None
        if opcode == 5:  # MESSAGE
            if length < 22:
                return None
            channel, _, time_ns, _ = unpack_message(data, start)
            counts[channel] += 1
            times.append(time_ns)
        elif opcode == 3 or opcode == 4:  # SCHEMA, CHANNEL
            content = bytes(data[start:position])
            mcap_records.parse(READERS[opcode], content, start)
            definitions.append((Opcode(opcode), content))
    return Inside(
        counts,
        (min(times), max(times)) if times else None,
        definitions,
        (len(data), zlib.crc32(data)),
    )
