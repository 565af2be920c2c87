"""Recovery of a damaged recording: its intact contents as a new file.

The contents (:mod:`.salvage`) are rewritten in the order of the file: messages, attachments and
metadata as they were. The output is read back before it appears under its name.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from locatk.core.errors import FormatError, LocatkError, OutputExistsError
from locatk.core.printable import escape_controls
from locatk.formats.output import atomic_write, check_output, tool_version
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.mcap_file import (
    CAPTURE_RECORD,
    CHANNELS_RECORD,
    MAX_TIME_NS,
    MESSAGE_HEAD,
    SESSION_RECORD,
    DamageError,
    Segment,
    iter_records,
    parse,
    read_attachment,
    read_messages,
    read_segment,
)
from locatk.formats.sessions.reader import open_mcap, read_index
from locatk.formats.sessions.recovery.salvage import Loss, Salvage, salvage
from locatk.formats.sessions.recovery.validation import check_records
from locatk.formats.sessions.writer import PROFILE

RECOVERED_RECORD = "recovered"
"""Name of the metadata record that lists what was saved and what was lost."""

MAX_LISTED_RANGES = 100
"""Number of lost ranges that this record lists."""


@dataclass(frozen=True)
class RecoveredTopic:
    """Saved and lost messages of one topic.

    Attributes
    ----------
    topic, schema : str
    saved : int
        Messages.
    lost : int or None
        Messages; None if the file does not state how many there were.
    missing_bytes : int or None
        For ``locatk.SerialChunk``: received bytes that are missing between the saved ones, by
        their offsets; None for other schemas. Bytes missing at the end are unknown.
    """

    topic: str
    schema: str
    saved: int
    lost: int | None
    missing_bytes: int | None = None


@dataclass(frozen=True)
class Recovered:
    """Result of a recovery.

    Attributes
    ----------
    source, output : str
    topics : tuple of RecoveredTopic
    chunks, attachments, metadata : int
        Saved.
    damaged_chunks : int
        Not saved; chunks without a readable head are not counted.
    lost_attachments, lost_metadata : int or None
        None if the file does not state how many there were.
    orphans : int
        Messages in intact chunks whose channel is defined nowhere; not saved.
    late : int
        Messages in intact chunks with a time that no reader accepts (:data:`MAX_TIME_NS`); not
        saved, and lost messages of their topics.
    nameless : tuple of str
        Topics whose schema is lost; saved without it.
    unconfirmed : tuple of str
        Topics whose names are only in a damaged index, so that they may be wrong.
    losses : tuple of Loss
        Unusable bytes of the source.
    tail : int
        Number of them at the end of a source that was not finished.
    ended : bool
        The source was finished by its writer. If not, the contents of its end are unknown.
    damaged : bool
        The source is damaged, possibly only its index.
    complete : bool
        Nothing was lost.
    """

    source: str
    output: str
    topics: tuple[RecoveredTopic, ...]
    chunks: int
    attachments: int
    metadata: int
    damaged_chunks: int
    lost_attachments: int | None
    lost_metadata: int | None
    orphans: int
    late: int
    nameless: tuple[str, ...]
    unconfirmed: tuple[str, ...]
    losses: tuple[Loss, ...]
    tail: int
    ended: bool
    damaged: bool
    complete: bool

    @property
    def messages(self) -> int:
        """Saved messages of all topics."""
        return sum(topic.saved for topic in self.topics)

    @property
    def lost_messages(self) -> int | None:
        """Lost messages of all topics; None if the file does not state how many there were."""
        lost = [topic.lost for topic in self.topics]
        return None if None in lost else sum(each or 0 for each in lost)

    @property
    def lost_bytes(self) -> int:
        """Number of unusable bytes of the source."""
        return sum(map(len, self.losses))


def recover(
    path: str | os.PathLike[str], output: str | os.PathLike[str], *, overwrite: bool = False
) -> Recovered:
    """Write the intact contents of ``path`` to a new file; ``path`` is not changed.

    Messages keep their times, sequence numbers and order, metadata and attachments their
    position among them. Channels may get other ids. A metadata record ``recovered`` lists the
    losses.

    Parameters
    ----------
    path : path
        An MCAP file of any tool, whole or damaged.
    output : path
        See :func:`locatk.formats.output.atomic_write`.
    overwrite : bool
        Replace an existing output.

    Raises
    ------
    OutputExistsError, MissingDataError
        There is no input, or the output cannot be written.
    FormatError
        Nothing is left, or the file changes while it is read.
    LocatkError
        The output cannot be read back: the disk is damaged.
    """
    if os.path.exists(output) and os.path.exists(path) and os.path.samefile(path, output):
        raise OutputExistsError("the output is the input", file=output, hint="Choose another -o")
    check_output(output, overwrite=overwrite)
    with open_mcap(path) as stream:
        found = salvage(stream)
    if found.is_empty:
        raise FormatError(
            "nothing of a recording (MCAP) is left in it",
            file=path,
            hint="Give a file that `locatk capture` or another recorder made",
        )
    index, version = found.index, tool_version()
    # Only the first part of a recording begins with the first byte that was received.
    capture = index.metadata.get(CAPTURE_RECORD)
    is_first_part = capture is not None and capture.get("part", "1") == "1"
    with atomic_write(output, overwrite=overwrite) as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(
            profile=index.header.profile or (PROFILE if SESSION_RECORD in index.metadata else ""),
            library=f"{index.header.library} (recovered by locatk {version})".strip(),
        )
        rewriter = Rewriter(writer, found, first_byte=0 if is_first_part else None)
        for item in iter_contents(path, found):
            rewriter.add(item)
        recovered = _summarize(os.fspath(path), os.fspath(output), found, rewriter)
        if not recovered.messages and not recovered.complete:
            raise _no_message_error(path, recovered)
        writer.add_metadata(
            RECOVERED_RECORD, {"tool_version": version, **_metadata_record(recovered)}
        )
        writer.finish()
        stream.flush()
        try:
            with open(stream.name, "rb") as written:
                verify(written, rewriter)
        except DamageError as damage:
            raise LocatkError(
                f"the output cannot be read back ({damage})",
                file=output,
                hint="Check the disk, or write to another one",
            ) from None
    return recovered


def iter_contents(
    path: str | os.PathLike[str], found: Salvage
) -> Iterator[bytes | memoryview | Attachment | Metadata]:
    """Yield the intact contents of a file in its order; messages as the records of a chunk.

    Raises
    ------
    FormatError
        The file has changed since it was searched.
    """
    index = found.index
    items: list[tuple[int, Any]] = [
        *((segment.offset, segment) for segment in index.segments),
        *((entry.offset, entry) for entry in index.attachments),
        *found.metadata,
    ]
    with open_mcap(path) as stream:
        for offset, item in sorted(items, key=lambda entry: entry[0]):
            try:
                content = _read_item(stream, offset, item)
            except DamageError:
                raise FormatError(
                    "the file changes while it is read",
                    file=path,
                    where=f"byte {offset}",
                    hint="Wait until its recording has ended",
                ) from None
            yield content


def _read_item(stream: IO[bytes], offset: int, item: Any) -> Any:
    """Read an item of :func:`iter_contents`; raise DamageError if it is no longer intact."""
    if isinstance(item, Metadata):
        return item
    if isinstance(item, Segment):
        data = read_segment(stream, item)
        check_records(data)
        return data
    return read_attachment(stream, offset)


class Rewriter:
    """Writes the intact contents of a file with ``writer``.

    Attributes
    ----------
    topics : dict of int to (str, str)
        Topic and schema name of each channel, by its new id.
    new_ids : dict of int to int
        New ids of the channels, by their old ids.
    counts : Counter of int
        Messages written, by new id.
    missing : dict of int to int
        Bytes that the offsets of raw bytes skip, by new id of their channels.
    orphans : int
        Messages left out, because their channel is unknown.
    late : Counter of int
        Messages left out, because their time is later than :data:`MAX_TIME_NS`, by new id.
    nameless : list of str
        Topics whose schema is lost; they are written without it.
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
        self.late: Counter[int] = Counter()
        self.nameless: list[str] = []
        self.attachments = 0
        self.metadata = 0
        index = found.index
        for schema in index.schemas.values():
            if (Opcode.SCHEMA, schema.id) not in found.conflicts:
                self._schemas[schema.id] = schema
        for _, channel in sorted(index.channels.items()):
            # Ids with several definitions are valid only behind each definition.
            if (Opcode.CHANNEL, channel.id) not in found.conflicts and (
                (Opcode.SCHEMA, channel.schema_id) not in found.conflicts
            ):
                self._register(channel)

    def add(self, item: bytes | memoryview | Attachment | Metadata) -> None:
        """Write one item of :func:`iter_contents`."""
        if isinstance(item, Attachment):
            self._writer.flush()  # else it would precede messages that came earlier
            self._writer.add_attachment(
                item.create_time, item.log_time, item.name, item.media_type, item.data
            )
            self.attachments += 1
        elif isinstance(item, Metadata):
            self._writer.flush()
            record = item.metadata
            if item.name == CHANNELS_RECORD:
                new_keys = {str(old): str(new) for old, new in self.new_ids.items()}
                record = {new_keys[key]: text for key, text in record.items() if key in new_keys}
            self._writer.add_metadata(item.name, record)
            self.metadata += 1
        else:
            self._add_records(item)

    def _add_records(self, data: bytes | memoryview) -> None:
        for opcode, start, end in iter_records(data, 0):
            if opcode == Opcode.MESSAGE:
                old_id, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(data, start)
                new_id = self.new_ids.get(old_id)
                if new_id is None:
                    self.orphans += 1
                    continue
                if log_ns > MAX_TIME_NS:
                    self.late[new_id] += 1
                    continue
                payload = bytes(data[start + MESSAGE_HEAD.size : end])
                self._writer.add_message(new_id, log_ns, payload, publish_ns, sequence)
                self.counts[new_id] += 1
                if new_id in self.missing:
                    self._count_missing_bytes(new_id, payload)
            elif opcode == Opcode.SCHEMA:
                schema = parse(Schema.read, data[start:end], start)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._register(parse(Channel.read, data[start:end], start))

    def _register(self, channel: Channel) -> None:
        """Assign this channel to the messages of its id that follow."""
        schema = self._schemas.get(channel.schema_id)
        definition = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        metadata = tuple(sorted(channel.metadata.items()))
        key = (channel.topic, channel.message_encoding, definition, metadata)
        if key not in self._new_channels:
            if schema is not None and definition not in self._new_schemas:
                self._new_schemas[definition] = self._writer.register_schema(*definition)
            new_id = self._writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._new_schemas[definition] if schema else 0,
                channel.metadata,
            )
            self._new_channels[key] = new_id
            self.topics[new_id] = (channel.topic, definition[0])
            if schema is None and channel.schema_id:
                self.nameless.append(channel.topic)
            serial = (SerialChunk.DESCRIPTOR.full_name, "protobuf")
            if (definition[0], channel.message_encoding) == serial:
                self.missing[new_id] = 0
                self._next_byte[new_id] = self._first_byte
        self.new_ids[channel.id] = self._new_channels[key]

    def _count_missing_bytes(self, new_id: int, payload: bytes) -> None:
        try:
            chunk = SerialChunk.FromString(payload)
        except DecodeError:
            return
        expected = self._next_byte[new_id]
        if expected is not None:
            self.missing[new_id] += max(0, chunk.byte_offset - expected)
        self._next_byte[new_id] = chunk.byte_offset + len(chunk.data)


def verify(stream: IO[bytes], rewriter: Rewriter) -> None:
    """Read back everything that was written.

    Raises
    ------
    DamageError
        It is damaged, or differs in number from what was written.
    """
    index = read_index(stream)
    counts: Counter[int] = Counter()
    for segment in index.segments:
        counts.update(channel for channel, _, _ in read_messages(stream, segment, index.channels))
    for entry in index.attachments:
        read_attachment(stream, entry.offset)
    if index.damage is not None:
        raise DamageError(index.damage)
    if counts != rewriter.counts or index.counts != rewriter.counts:
        raise DamageError("other messages than were written")
    if len(index.attachments) != rewriter.attachments:
        raise DamageError("other attachments than were written")
    if index.metadata_count != rewriter.metadata + 1:  # with the record RECOVERED_RECORD
        raise DamageError("other metadata than were written")


def _no_message_error(path: str | os.PathLike[str], recovered: Recovered) -> FormatError:
    if recovered.orphans:
        return FormatError(
            f"the channels of all its {recovered.orphans} messages are lost, nothing identifies "
            "them",
            file=path,
        )
    if recovered.late:
        return FormatError("all its messages have times after the year 2262", file=path)
    return FormatError("no chunk is intact, there is no message to save", file=path)


def _summarize(source: str, output: str, found: Salvage, rewriter: Rewriter) -> Recovered:
    statistics = found.statistics
    unknown: int | None = None if found.losses or not found.ended else 0
    missing: Counter[int] = Counter()
    lost_attachments = lost_metadata = unknown
    if statistics is not None:
        missing = Counter(statistics.channel_message_counts) - found.index.counts
        lost_attachments = max(0, statistics.attachment_count - rewriter.attachments)
        lost_metadata = max(0, statistics.metadata_count - rewriter.metadata)
    is_intact = (
        not (missing or lost_attachments or lost_metadata) if statistics else not found.losses
    )
    lost: Counter[int | str] = Counter()
    for channel, count in missing.items():
        lost[rewriter.new_ids.get(channel, f"channel {channel}")] += count
    lost.update(rewriter.late)
    topics = [
        RecoveredTopic(
            topic,
            schema,
            rewriter.counts[new_id],
            lost[new_id] if statistics or unknown is not None else None,
            rewriter.missing.get(new_id),
        )
        for new_id, (topic, schema) in rewriter.topics.items()
    ]
    topics += [
        RecoveredTopic(name, "", 0, count) for name, count in lost.items() if isinstance(name, str)
    ]
    new_ids = {rewriter.new_ids[old] for old in found.unconfirmed if old in rewriter.new_ids}
    unconfirmed = tuple(rewriter.topics[new_id][0] for new_id in sorted(new_ids))
    return Recovered(
        source=source,
        output=output,
        topics=tuple(topics),
        chunks=sum(segment.is_chunk for segment in found.index.segments),
        attachments=rewriter.attachments,
        metadata=rewriter.metadata,
        damaged_chunks=sum(loss.what == "chunk" for loss in found.losses),
        lost_attachments=lost_attachments,
        lost_metadata=lost_metadata,
        orphans=rewriter.orphans,
        late=rewriter.late.total(),
        nameless=tuple(rewriter.nameless),
        unconfirmed=unconfirmed,
        losses=tuple(found.losses),
        tail=found.tail,
        ended=found.ended,
        damaged=not found.is_whole,
        complete=(
            found.ended
            and is_intact
            and not (rewriter.orphans or rewriter.late.total() or unconfirmed)
        ),
    )


def _metadata_record(recovered: Recovered) -> dict[str, str]:
    """Return the result as texts, for the metadata of the output."""
    ranges = [
        f"{loss.start}-{loss.end} {loss.what} {loss.name}".rstrip()
        for loss in recovered.losses[:MAX_LISTED_RANGES]
    ]
    if len(recovered.losses) > MAX_LISTED_RANGES:
        ranges.append("...")
    values = {
        "source": escape_controls(Path(recovered.source).name),
        "complete": str(recovered.complete).lower(),
        "ended": str(recovered.ended).lower(),
        "messages": recovered.messages,
        "chunks": recovered.chunks,
        "damaged_chunks": recovered.damaged_chunks,
        "lost_bytes": recovered.lost_bytes,
        "lost_ranges": "; ".join(ranges),
        "lost_messages": recovered.lost_messages,
        "lost_attachments": recovered.lost_attachments,
        "lost_metadata": recovered.lost_metadata,
        "orphans": recovered.orphans,
        "late": recovered.late,
        "unconfirmed": ", ".join(recovered.unconfirmed) or None,
        "tail_bytes": recovered.tail,
        **{f"saved:{topic.topic}": topic.saved for topic in recovered.topics},
        **{f"missing_bytes:{topic.topic}": topic.missing_bytes for topic in recovered.topics},
    }
    return {key: str(value) for key, value in values.items() if value is not None}
