"""Criteria by which a record of a damaged MCAP file is accepted, and the search for such records.

A chunk and an attachment are accepted by their checksum. If the writer left it out, their
lengths must agree and the content of a chunk must consist of records. Records of other kinds
must have lengths that agree to the last byte, and texts in UTF-8 without NUL, because a power cut
leaves zeros; :func:`.salvage.salvage` lists the exceptions. No length is used before it
was checked, so that a flipped bit costs neither memory nor time.
Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import errno
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
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from locatk.formats.sessions.mcap_file import (
    MAGIC,
    MAX_RECORD_BYTES,
    MESSAGE_HEAD,
    PARSE_ERRORS,
    RECORD_HEAD,
    DamageError,
    decompress,
    iter_records,
    parse,
)

MAX_HEAD_BYTES = 1 << 16
"""Largest name and media type of an attachment that are accepted."""

MIN_CHAIN_RECORDS = 4
"""Number of consecutive records after which a message outside chunks is accepted in a search."""

FIRST_BLOCK_BYTES, BLOCK_BYTES = 1 << 16, 1 << 20
"""Size of the blocks in which a file is searched: the next record is mostly near."""

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
_NEVER_AFTER_DATA_END = (Opcode.HEADER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_CONTENT_BYTES = {Opcode.FOOTER: 20, Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4}


Definition = records.Schema | records.Channel


class ChunkContent(NamedTuple):
    """Content of a chunk.

    Attributes
    ----------
    counts : Counter of int
        Messages by channel.
    span : (int, int) or None
        First and last log time in ns.
    definitions : list of (Opcode, Schema or Channel)
        In their order.
    key : (int, int)
        Length and checksum, by which copies of the chunk are recognized.
    """

    counts: Counter[int]
    span: tuple[int, int] | None
    definitions: list[tuple[Opcode, Definition]]
    key: tuple[int, int]


class DamagedFile:
    """Access to the bytes and records of a file that may be damaged; holds one record.

    Attributes
    ----------
    size : int
        Bytes of the file.
    has_refused_nul : bool
        A record was refused only because of NUL in its texts. Never true with ``accepts_nul``.
    """

    def __init__(self, stream: IO[bytes], *, accepts_nul: bool = False) -> None:
        self._stream = stream
        self._accepts_nul = accepts_nul
        self.has_refused_nul = False
        self.size = stream.seek(0, os.SEEK_END)

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes of the file; fewer at its end."""
        self._stream.seek(offset)
        return self._stream.read(max(0, min(length, self.size - offset)))

    def record_head(self, position: int) -> tuple[int, int] | None:
        """Return opcode and end of a possible record; None if it is longer than the file."""
        head = self.read(position, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack(head)
        end = position + RECORD_HEAD.size + length
        return (opcode, end) if end <= self.size else None

    def read_content(self, position: int, end: int) -> bytes:
        """Read the content of the record from ``position`` to ``end``."""
        return self.read(position + RECORD_HEAD.size, end - position - RECORD_HEAD.size)

    def read_record(self, position: int) -> tuple[Opcode, int] | None:
        """Read kind and end of the record at ``position``; None if its lengths disagree."""
        head = self.record_head(position)
        if head is None or not 0 < head[0] <= Opcode.DATA_END:
            return None
        opcode, end = Opcode(head[0]), head[1]
        return (opcode, end) if self._has_valid_lengths(opcode, position, end) else None

    def _has_valid_lengths(self, opcode: Opcode, position: int, end: int) -> bool:
        length = end - position - RECORD_HEAD.size
        if opcode == Opcode.ATTACHMENT:
            return self.attachment_head(position) is not None
        if length > MAX_RECORD_BYTES:
            return False
        if opcode == Opcode.CHUNK:
            return self.chunk_head(position) is not None
        if opcode == Opcode.MESSAGE:
            return length >= MESSAGE_HEAD.size
        if opcode == Opcode.MESSAGE_INDEX:
            inner = int.from_bytes(self.read(position + RECORD_HEAD.size + 2, 4), "little")
            return length == 6 + inner and inner % 16 == 0
        if opcode in _CONTENT_BYTES:
            return length == _CONTENT_BYTES[opcode]
        self._stream.seek(position + RECORD_HEAD.size)
        return self._parse_exactly(opcode, self._stream, length) is not None

    def parse_exactly(self, opcode: Opcode, content: bytes) -> Any:
        """Return the record that fills ``content`` to its last byte, or None."""
        return self._parse_exactly(opcode, BytesIO(content), len(content))

    def _parse_exactly(self, opcode: Opcode, source: IO[bytes], length: int) -> Any:
        """Return the record that fills the next ``length`` bytes of ``source``, or None."""
        stream = _BoundedStream(source, length)
        try:
            record = READERS[opcode](stream)
        except PARSE_ERRORS:
            return None
        return record if stream.count == length and self._accepts_texts(stream) else None

    def _accepts_texts(self, stream: _BoundedStream) -> bool:
        """Return whether the texts that were read from ``stream`` have no NUL, or may have it."""
        is_refused = stream.has_nul and not self._accepts_nul
        self.has_refused_nul |= is_refused
        return not is_refused

    def chunk_head(self, position: int) -> tuple[int, int, int] | None:
        """Return the head of a chunk if its lengths agree, even if the file ends inside it.

        Returns
        -------
        (int, int, int) or None
            First and last log time in ns, and decompressed size in bytes.
        """
        longest_name = 4
        head = self.read(position, RECORD_HEAD.size + _CHUNK.size + longest_name + 8)
        if len(head) < RECORD_HEAD.size + _CHUNK.size + 8:
            return None
        opcode, length = RECORD_HEAD.unpack_from(head)
        start_ns, end_ns, size, _, name_length = _CHUNK.unpack_from(head, RECORD_HEAD.size)
        data_length_at = RECORD_HEAD.size + _CHUNK.size + name_length
        if opcode != Opcode.CHUNK or len(head) < data_length_at + 8:
            return None
        data_length = int.from_bytes(head[data_length_at : data_length_at + 8], "little")
        is_valid = length == _CHUNK.size + name_length + 8 + data_length
        return (start_ns, end_ns, size) if is_valid else None

    def read_chunk(self, position: int, end: int) -> ChunkContent | None:
        """Read the content of a chunk whose head is valid; None if it is damaged."""
        head = self.chunk_head(position)
        if head is None or head[2] > MAX_RECORD_BYTES:
            return None
        try:
            return check_records(decompress(self.read_content(position, end), position))
        except DamageError:
            return None

    def attachment_head(self, position: int) -> records.AttachmentIndex | None:
        """Return the head of an attachment if its lengths agree, even of an incomplete one."""
        record_head = self.read(position, RECORD_HEAD.size)
        if len(record_head) < RECORD_HEAD.size or record_head[0] != Opcode.ATTACHMENT:
            return None
        _, length = RECORD_HEAD.unpack(record_head)
        stream = _BoundedStream(self._stream, MAX_HEAD_BYTES)  # continues behind the record head
        try:
            log_ns, create_ns = stream.read8(), stream.read8()
            name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
            size = stream.read8()
        except PARSE_ERRORS:
            return None
        if length != stream.count + size + 4 or not self._accepts_texts(stream):
            return None
        return records.AttachmentIndex(
            position, RECORD_HEAD.size + length, log_ns, create_ns, size, name, media_type
        )

    def is_attachment_intact(self, position: int, end: int) -> bool:
        """Return whether the checksum of an attachment is right, or was left out by the writer.

        Zeros in front of a checksum of zero are rather the hole that a power cut leaves.
        """
        last = self.read(end - 5, 5)
        crc = int.from_bytes(last[1:], "little")
        if crc == 0:
            return last[:1] != b"\0" and self.is_record_or_end(end)
        return self._crc(position + RECORD_HEAD.size, end - 4) == crc

    def is_record_or_end(self, position: int) -> bool:
        """Return whether a record seems to begin at ``position``, or the file ends there."""
        return (
            position == self.size
            or self.read(position, len(MAGIC)) == MAGIC
            or self.read_record(position) is not None
        )

    def _crc(self, start: int, end: int) -> int:
        crc = 0
        for offset in range(start, end, BLOCK_BYTES):
            crc = zlib.crc32(self.read(offset, min(BLOCK_BYTES, end - offset)), crc)
        return crc

    def is_zero(self, start: int, end: int) -> bool:
        """Return whether all bytes from ``start`` to ``end`` are zero."""
        offset = self._skip_hole(start)
        while offset < end:
            if self.read(offset, min(BLOCK_BYTES, end - offset)).strip(b"\0"):
                return False
            offset = self._skip_hole(offset + BLOCK_BYTES)
        return True

    def _skip_hole(self, offset: int) -> int:
        """Return the first position from ``offset`` on that is not in a hole of the file.

        A hole is a range that was never written, of zeros. It takes no space on the disk, so that
        it may be larger than what can be read (lseek(2), SEEK_DATA).
        """
        try:
            descriptor = self._stream.fileno()
            position = os.lseek(descriptor, 0, os.SEEK_CUR)
        except OSError:  # bytes in memory
            return offset
        try:
            return os.lseek(descriptor, offset, os.SEEK_DATA)
        except AttributeError:  # not on Windows
            return offset
        except OSError as error:
            return self.size if error.errno == errno.ENXIO else offset
        finally:
            # The buffer of the stream continues where it ended.
            os.lseek(descriptor, position, os.SEEK_SET)

    # ---- search for the next record after damage

    def find_record(self, start: int, limit: int, kinds: Collection[Opcode]) -> int:
        """Find the first position from ``start`` of an acceptable record of one of ``kinds``.

        Returns ``limit`` if there is none before it.
        """
        offset, length = self._skip_hole(start), FIRST_BLOCK_BYTES
        while offset < limit:
            length = min(length, limit - offset)
            block = self.read(offset, length + RECORD_HEAD.size - 1)
            for position in self._candidates(block, offset, kinds):
                if self._is_acceptable(position, kinds):
                    return position
            offset, length = self._skip_hole(offset + length), BLOCK_BYTES
        return limit

    def _candidates(self, block: bytes, offset: int, kinds: Collection[Opcode]) -> Iterator[int]:
        """Yield positions in ``block``, which is at ``offset``, that look like a record head."""
        data = np.frombuffer(block, np.uint8)
        n = len(data) - RECORD_HEAD.size + 1
        if n <= 0:
            return
        # No record has 2^40 bytes: the three highest bytes of its length are zero, which they
        # rarely are elsewhere.
        zero = data == 0
        begins = zero[6 : n + 6] & zero[7 : n + 7] & zero[8 : n + 8] & ~zero[:n]
        positions = np.flatnonzero(begins)
        positions = positions[np.isin(data[positions], [int(kind) for kind in kinds])]
        heads = np.lib.stride_tricks.sliding_window_view(data, RECORD_HEAD.size)[positions, 1:]
        lengths = np.ascontiguousarray(heads).view("<u8")[:, 0].astype(np.int64)
        fits = lengths <= self.size - offset - positions - RECORD_HEAD.size
        for position in positions[fits]:
            yield offset + int(position)

    def _is_acceptable(self, position: int, kinds: Collection[Opcode]) -> bool:
        found = self.read_record(position)
        if found is None or found[0] not in kinds:
            return False
        opcode, end = found
        if opcode == Opcode.CHUNK:
            return self.read_chunk(position, end) is not None
        if opcode == Opcode.ATTACHMENT:
            return self.is_attachment_intact(position, end)
        if opcode == Opcode.FOOTER:
            return self.read(end, len(MAGIC)) == MAGIC
        if opcode == Opcode.DATA_END:
            next_record = self.read_record(end)
            return next_record is not None and next_record[0] not in _NEVER_AFTER_DATA_END
        if opcode == Opcode.MESSAGE:
            return self._begins_chain(position)
        # Zeros parse as a record without a name.
        record = self.parse_exactly(opcode, self.read_content(position, end))
        return bool(record.topic if opcode == Opcode.CHANNEL else record.name)

    def _begins_chain(self, position: int) -> bool:
        for _ in range(MIN_CHAIN_RECORDS):
            found = self.read_record(position)
            if found is None:
                return False
            position = found[1]
            if position == self.size:
                break
        return True


class _BoundedStream(ReadDataStream):
    """Stream that fails if fewer bytes are left than asked for, or more than ``limit`` are read.

    ``has_nul`` is true if a text contained NUL: zeros are valid UTF-8, and a power cut leaves them.
    """

    def __init__(self, stream: IO[bytes], limit: int) -> None:
        super().__init__(stream)
        self._limit = limit
        self.has_nul = False

    def read(self, length: int) -> bytes:
        if length > self._limit - self.count:  # before memory is allocated
            raise EndOfFile
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data

    def read_prefixed_string(self) -> str:
        text = super().read_prefixed_string()
        self.has_nul |= "\0" in text
        return text


def check_records(data: bytes | memoryview) -> ChunkContent:
    """Check the records of a decompressed chunk, and list its content.

    Raises
    ------
    DamageError
        ``data`` do not consist of records, or a schema or a channel cannot be parsed.
    """
    times: list[int] = []
    counts: Counter[int] = Counter()
    definitions: list[tuple[Opcode, Definition]] = []
    for opcode, start, end in iter_records(data, 0):
        if opcode == 5:  # Opcode.MESSAGE; a chunk may hold tens of thousands
            channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, start)
            counts[channel] += 1
            times.append(time_ns)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append((Opcode(opcode), parse(READERS[opcode], data[start:end], start)))
    return ChunkContent(
        counts,
        (min(times), max(times)) if times else None,
        definitions,
        (len(data), zlib.crc32(data)),
    )
