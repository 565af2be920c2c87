"""Writer of MCAP files that takes many messages at a time.

The bytes are those of ``mcap.writer.Writer`` (mcap 1.6) with its default options. The records are
written by ``mcap.records``, except messages and message indexes: the library spends 5 microseconds
on a message, most of the time of writing a solution of 100,000 poses; :meth:`add_messages` takes
1 microsecond.
Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import IO, Any

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from locatk.formats.sessions.mcap_file import MAGIC, MESSAGE_HEAD, RECORD_HEAD

MAX_CHUNK_BYTES = 1 << 20
"""A chunk ends with the message that exceeds this size, the default of ``mcap.writer``."""

_FOOTER_HEAD = struct.Struct("<BQQQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("time_ns", "<u8"),
        ("published_ns", "<u8"),
    ]
)
"""Record head and head of a message."""


class McapWriter:
    """Writer of an MCAP file of chunks compressed by zstd, with all indexes and checksums.

    Parameters
    ----------
    stream : binary file
        The output. It is not closed.
    profile, library : str
        Entries of the header.
    """

    def __init__(self, stream: IO[Any], *, profile: str, library: str) -> None:
        self._stream = stream
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._start_chunk()
        stream.write(MAGIC)
        stream.write(_encode(records.Header(profile, library)))

    def _start_chunk(self) -> None:
        """Empty the buffer. It holds records, and the messages among them with their offsets."""
        self._parts: list[bytes] = []
        self._size = 0
        self._message_channels: list[int] = []
        self._message_times_ns: list[int] = []
        self._message_offsets: list[int] = []

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its id."""
        schema = records.Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._buffer([_encode(schema)])
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Add a channel; return its id."""
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            schema_id=schema_id,
            metadata={},
        )
        self._channels.append(channel)
        self._buffer([_encode(channel)])
        return channel.id

    def add_message(self, channel: int, time_ns: int, payload: bytes, published_ns: int) -> None:
        """Add a message; its sequence number is the number of earlier messages of its channel."""
        self._message_channels.append(channel)
        self._message_times_ns.append(time_ns)
        self._message_offsets.append(self._size)
        sequence = self._counts[channel] & 0xFFFFFFFF
        self._counts[channel] += 1
        head = RECORD_HEAD.pack(Opcode.MESSAGE, MESSAGE_HEAD.size + len(payload))
        message_head = MESSAGE_HEAD.pack(channel, sequence, time_ns, published_ns)
        self._buffer([head, message_head, payload])

    def add_messages(
        self,
        channel: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        payloads: Sequence[bytes],
    ) -> None:
        """Add messages in the given order, as :meth:`add_message` does.

        Parameters
        ----------
        channel : (n,) int ndarray
        time_ns : (n,) int64 ndarray
            Log times, which are also the publish times.
        payloads : sequence of n bytes
        """
        n = len(payloads)
        if n == 0:
            return
        heads = np.empty(n, _HEAD)
        sizes = np.fromiter(map(len, payloads), np.int64, n) + _HEAD.itemsize
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = sizes - RECORD_HEAD.size
        heads["channel"] = channel
        heads["sequence"] = self._take_sequence_numbers(channel)
        heads["time_ns"] = heads["published_ns"] = time_ns
        parts = list(itertools.chain.from_iterable(zip(_rows(heads), payloads, strict=True)))
        ends = np.cumsum(sizes)
        channels, times_ns = channel.tolist(), time_ns.tolist()
        start = 0
        while start < n:
            # Offset of the first message in its chunk minus that in all of these messages.
            shift = self._size - int(ends[start] - sizes[start])
            first_outside = int(np.searchsorted(ends, MAX_CHUNK_BYTES - shift, side="right"))
            stop = min(n, first_outside + 1)
            part = slice(start, stop)
            self._message_channels += channels[part]
            self._message_times_ns += times_ns[part]
            self._message_offsets += (ends[part] - sizes[part] + shift).tolist()
            self._buffer(parts[2 * start : 2 * stop], int(ends[stop - 1]) + shift - self._size)
            start = stop

    def _take_sequence_numbers(self, channel: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the sequence numbers (n,) of new messages of channels (n,), and count them."""
        sequence = np.empty(len(channel), np.int64)
        for number, rows in _group(channel):
            sequence[rows] = self._counts[number] + np.arange(len(rows))
            self._counts[number] += len(rows)
        return sequence & 0xFFFFFFFF

    def _buffer(self, parts: Sequence[bytes], size: int | None = None) -> None:
        """Append records to the chunk; finish the chunk if it has become large enough."""
        self._parts += parts
        self._size += sum(map(len, parts)) if size is None else size
        if self._size > MAX_CHUNK_BYTES:
            self._finish_chunk()

    def _finish_chunk(self) -> None:
        """Write the chunk and the indexes of its messages, if it has any.

        If the disk is full, its messages are lost, but the file can still be finished.
        """
        if not self._message_channels:
            return
        data, times_ns, offsets = (
            b"".join(self._parts),
            self._message_times_ns,
            self._message_offsets,
        )
        groups = list(_group(np.array(self._message_channels)))
        self._start_chunk()
        chunk = records.Chunk(
            compression="zstd",
            data=zstandard.compress(data),
            message_start_time=min(times_ns),
            message_end_time=max(times_ns),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        start = self._stream.tell()
        parts, index_offsets = [_encode(chunk)], {}
        end = index_start = start + len(parts[0])
        entries = np.column_stack([times_ns, offsets]).astype("<u8")
        for number, rows in groups:
            content = entries[rows].tobytes()
            head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(content), number, len(content))
            parts.append(head + content)
            index_offsets[number] = end
            end += len(parts[-1])
        try:
            self._write(b"".join(parts))
        except BaseException:
            for number, rows in groups:
                self._counts[number] -= len(rows)
            raise
        self._chunks.append(
            records.ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=start,
                chunk_length=index_start - start,
                message_index_offsets=index_offsets,
                message_index_length=end - index_start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file."""
        entry = records.Attachment(
            create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data
        )
        offset = self._stream.tell()
        self._attachments.append(
            records.AttachmentIndex(
                offset=offset,
                length=self._write(_encode(entry)),
                create_time=time_ns,
                log_time=time_ns,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def add_metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Add a metadata record."""
        offset = self._stream.tell()
        length = self._write(_encode(records.Metadata(name=name, metadata=dict(table))))
        self._metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def flush(self) -> None:
        """Write the messages so far as a chunk, so that readers of the file find them."""
        self._finish_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the rest of the messages and the summary; the file is then complete."""
        self._finish_chunk()
        self._write(_encode(records.DataEnd(0)))
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        summary_start = self._stream.tell()
        groups: list[tuple[Opcode, Sequence[records.McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = b"", b""
        for opcode, group in groups:
            content = b"".join(map(_encode, group))
            offsets += _encode(
                records.SummaryOffset(
                    group_opcode=opcode,
                    group_start=summary_start + len(summary),
                    group_length=len(content),
                )
            )
            summary += content
        offset_start = summary_start + len(summary)
        summary += offsets
        footer_head = _FOOTER_HEAD.pack(Opcode.FOOTER, 20, summary_start, offset_start)
        footer = records.Footer(
            summary_start=summary_start,
            summary_offset_start=offset_start,
            summary_crc=zlib.crc32(footer_head, zlib.crc32(summary)),
        )
        self._write(summary + _encode(footer) + MAGIC)

    def _write(self, data: bytes) -> int:
        """Write bytes; return their number."""
        self._stream.write(data)
        return len(data)


def _encode(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _group(values: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield each distinct value with its ascending indices, in the order of first occurrence."""
    order = np.argsort(values, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(values[order])) + 1)
    for rows in sorted(groups, key=lambda rows: int(rows[0])):
        yield int(values[rows[0]]), rows


def _rows(table: NDArray[np.void]) -> list[bytes]:
    """Return the bytes of each row."""
    data, size = table.tobytes(), table.itemsize
    return [data[k : k + size] for k in range(0, len(data), size)]
