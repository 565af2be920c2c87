"""Search of a damaged MCAP file for everything that is intact.

The file may be cut short, zeroed, overwritten or have flipped bits. Its records are read one after
the other. If one is damaged, the next acceptable one (:mod:`.validation`) is searched, and the
bytes between are lost.

Messages outside chunks have no checksum. They are accepted if the file has no chunks. In a file
with chunks they are accepted only if the statistics at its end confirm their number, because a
single flipped bit turns a message index into a message.
"""

from __future__ import annotations

import contextlib
import importlib
import struct
import zlib
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import IO, Any

from google.protobuf import descriptor_pool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap import records
from mcap.opcode import Opcode

from locatk.formats.schemas import lighthouse_pb2, magnetics_pb2, poses_pb2, serial_pb2
from locatk.formats.sessions.mcap_file import (
    CHANNELS_RECORD,
    MAGIC,
    MAX_RECORD_BYTES,
    MAX_RUN_BYTES,
    MAX_TIME_NS,
    MESSAGE_HEAD,
    RECORD_HEAD,
    DamageError,
    Index,
    Segment,
    iter_records,
    parse,
)
from locatk.formats.sessions.recovery.validation import (
    READERS,
    DamagedFile,
    Definition,
)

_FOOTER = struct.Struct("<QQI")

_SUMMARY_KINDS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)

_WITH_CHECKSUM = (Opcode.CHUNK, Opcode.ATTACHMENT)
_ANCHORS = (*_WITH_CHECKSUM, Opcode.METADATA, Opcode.DATA_END, Opcode.FOOTER)
_ANCHORS_WITHOUT_CHUNKS = (*_ANCHORS, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Kinds of records at which a search may end, in files with chunks and without."""

REGISTERED_SCHEMAS = (lighthouse_pb2, magnetics_pb2, poses_pb2, serial_pb2)
"""Modules whose import registers the messages of locatk in the descriptor pool."""

_DAMAGE_NAMES = {
    "bytes": "damaged bytes",
    "zeros": "zeros",
    "metadata": "a damaged metadata record",
}
"""Descriptions of losses; the others are "a damaged" and their kind."""

MAX_CHANNEL_DIGITS = 5
"""Digits of the largest channel id, 65,535."""


@dataclass(frozen=True)
class Loss:
    """Unusable bytes of the file.

    Attributes
    ----------
    start, end : int
        The first byte, and the one after the last.
    what : str
        ``"chunk"``, ``"attachment"``, ... if such a record begins there; ``"zeros"`` if all bytes
        are zero; else ``"bytes"``.
    name : str
        Name of an attachment, if it is readable.
    start_ns, end_ns : int or None
        Log times of the messages in a chunk, if its head is readable.
    """

    start: int
    end: int
    what: str = "bytes"
    name: str = ""
    start_ns: int | None = None
    end_ns: int | None = None

    def __len__(self) -> int:
        return self.end - self.start


@dataclass
class Salvage:
    """Intact and lost contents of a file.

    Attributes
    ----------
    size : int
        Bytes of the file.
    index : Index
        Intact contents; the checksum of each of its chunks was right.
    metadata : list of (int, Metadata)
        Offset and content of each record, in file order.
    losses : list of Loss
        Bytes in the data section, which may have held messages, attachments or metadata.
    index_losses : list of Loss
        Bytes in the summary and behind the end, which held none.
    copies : int
        Chunks that are in the file a second time, and left out.
    ended : bool
        The file has its footer: its writer finished it.
    statistics : Statistics or None
        Number of messages, attachments and metadata records, if the summary is intact.
    conflicts : set of (Opcode, int)
        Kinds and ids of schemas and channels of which chunks contain different definitions.
    unconfirmed : set of int
        Ids of channels with messages in chunks whose definitions are only in a damaged index. A
        flipped bit may have changed their names.
    """

    size: int
    index: Index = field(default_factory=Index)
    metadata: list[tuple[int, records.Metadata]] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    index_losses: list[Loss] = field(default_factory=list)
    copies: int = 0
    ended: bool = False
    statistics: records.Statistics | None = None
    conflicts: set[tuple[Opcode, int]] = field(default_factory=set)
    unconfirmed: set[int] = field(default_factory=set)

    @property
    def tail(self) -> int:
        """Number of unusable bytes at the end of a file that was not finished."""
        last = self.losses[-1] if self.losses and not self.ended else None
        return len(last) if last is not None and last.end == self.size else 0

    @property
    def is_whole(self) -> bool:
        """Nothing is damaged, not even the index."""
        return self.ended and not (self.losses or self.index_losses or self.copies)

    @property
    def is_empty(self) -> bool:
        """Nothing of a recording is left."""
        found = (self.index.segments, self.index.attachments, self.metadata, self.statistics)
        return not any(found)


def salvage(stream: IO[bytes]) -> Salvage:
    """Find the intact contents of an MCAP file; reads all of it, and holds one record at a time.

    If the file has no chunks, messages outside chunks are searched as well. Channels whose
    definition is lost are restored from the metadata record :data:`CHANNELS_RECORD`.

    NUL in texts is a sign of damage, except in chunks and summaries with the right checksum, and
    in files in which nothing else is damaged.
    """
    search = _Search(stream, _ANCHORS)
    result = search.run()
    if search.has_refused_nul and result.ended:
        lenient = _Search(stream, _ANCHORS, accepts_nul=True).run()
        if lenient.is_whole:
            result = lenient
    if result.losses and search.is_mcap and not search.has_chunks:
        result = _Search(stream, _ANCHORS_WITHOUT_CHUNKS).run()
    restore_channels(result.index)
    return result


def describe_damage(result: Salvage) -> str | None:
    """Describe the first damage of a file; None if it is whole."""
    for loss in (*result.losses, *result.index_losses):
        name = _DAMAGE_NAMES.get(loss.what, f"a damaged {loss.what}")
        return f"{name} at byte {loss.start}"
    return None if result.ended else f"the file is cut short at byte {result.size}"


class _Search:
    """One pass through a file; a search after damage may end at records of the ``anchors``.

    Attributes
    ----------
    is_mcap : bool
        The file begins or ends as MCAP.
    has_chunks : bool
        Messages are in chunks, even if all of them are damaged.
    """

    def __init__(
        self, stream: IO[bytes], anchors: Collection[Opcode], *, accepts_nul: bool = False
    ) -> None:
        self._file = DamagedFile(stream, accepts_nul=accepts_nul)
        self._anchors = anchors
        self._result = Salvage(self._file.size)
        ends = (self._file.read(0, 8), self._file.read(max(0, self._file.size - 8), 8))
        self.is_mcap = MAGIC in ends
        self.has_chunks = False
        self._is_verified = False  # the last record has a checksum, which is right
        self._unverified_start: int | None = None  # of the last record, if it has no checksum
        self._in_data_section = True
        self._summary_start = 0
        self._recordings = 0
        self._has_intact_summary = False
        self._chunk_keys: set[tuple[int, int]] = set()
        self._verified_definitions: dict[tuple[Opcode, int], Definition] = {}
        # Runs of messages outside chunks
        self._runs: list[Segment] = []
        self._in_run = False
        self._run_counts: Counter[int] = Counter()
        self._run_span: tuple[int, int] | None = None

    @property
    def has_refused_nul(self) -> bool:
        """A record was refused only because of NUL in its texts."""
        return self._file.has_refused_nul

    def run(self) -> Salvage:
        """Search from the first byte to the last."""
        result, file = self._result, self._file
        first, position = file.read_record(len(MAGIC)), 0
        if file.read(0, len(MAGIC)) != MAGIC and first is not None and first[0] == Opcode.HEADER:
            position = len(MAGIC)
            result.index_losses.append(Loss(0, position))
        while position < file.size:
            self._is_verified = False
            end = self._accept(position)
            if end is None:
                position = self._lose(position)
            else:
                self._unverified_start = None if self._is_verified else position
                position = end
        result.ended = result.ended or file.read(max(8, file.size - 8), 8) == MAGIC
        if self._recordings > 1:
            result.statistics = None  # it describes one of several concatenated recordings
        self._settle_runs()
        if self.has_chunks and not self._has_intact_summary:
            result.unconfirmed = {
                entry.id for entry in result.index.channels.values() if self._is_unconfirmed(entry)
            }
        result.index.segments.sort(key=lambda segment: segment.offset)
        return result

    def _is_unconfirmed(self, channel: records.Channel) -> bool:
        """Return whether neither a checksum nor the list of a live recording confirms a channel."""
        index, verified = self._result.index, self._verified_definitions
        if not index.counts[channel.id] or (
            (Opcode.CHANNEL, channel.id) in verified
            and (channel.schema_id == 0 or (Opcode.SCHEMA, channel.schema_id) in verified)
        ):
            return False
        schema = index.schemas.get(channel.schema_id)
        listed = index.metadata.get(CHANNELS_RECORD, {}).get(str(channel.id))
        return listed is None or listed != f"{channel.topic} {schema.name if schema else ''}"

    # ---- intact records

    def _accept(self, position: int) -> int | None:
        """Register the record at ``position`` and return its end; None if it is damaged."""
        file = self._file
        if file.read(position, len(MAGIC)) == MAGIC:
            return position + len(MAGIC)
        found = file.read_record(position)
        if found is None:
            return None
        opcode, end = found
        if opcode == Opcode.CHUNK:
            return self._accept_chunk(position, end)
        if opcode == Opcode.ATTACHMENT:
            return self._accept_attachment(position, end)
        if opcode == Opcode.MESSAGE:
            return self._accept_message(position, end)
        if opcode == Opcode.FOOTER:
            self._accept_footer(position, end)
        elif opcode == Opcode.DATA_END:
            self._in_data_section, self._summary_start = False, end
        elif opcode in (Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX):
            self.has_chunks = True
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definition = file.parse_exactly(opcode, file.read_content(position, end))
            self._define(opcode, definition, is_verified=False)
        elif opcode == Opcode.METADATA:
            self._accept_metadata(
                position, file.parse_exactly(opcode, file.read_content(position, end))
            )
        elif opcode == Opcode.HEADER:
            if not self._recordings:
                header = file.parse_exactly(opcode, file.read_content(position, end))
                self._result.index.header = header
            self._recordings += 1
            self._in_data_section, self._result.ended = True, False
        return end

    def _accept_chunk(self, position: int, end: int) -> int | None:
        content = self._file.read_chunk(position, end)
        if content is None:
            return None
        self._is_verified, self.has_chunks, self._in_run = True, True, False
        result, index = self._result, self._result.index
        # In an undamaged file equal chunks are no copies: each is reached once.
        is_damaged = (
            result.losses
            or result.index_losses
            or not self._in_data_section
            or self._recordings > 1
        )
        if content.key in self._chunk_keys and is_damaged:
            result.copies += 1
            return end
        self._chunk_keys.add(content.key)
        for opcode, definition in content.definitions:
            self._define(opcode, definition, is_verified=True)
        index.counts.update(content.counts)
        if content.span is not None:
            index.include_times(*content.span)
        channels = frozenset(content.counts)
        index.segments.append(Segment(position, end - position, True, channels))
        return end

    def _accept_attachment(self, position: int, end: int) -> int | None:
        entry = self._file.attachment_head(position)
        if entry is None or not self._file.is_attachment_intact(position, end):
            return None
        self._is_verified = True
        known = self._result.index.attachments
        if self._in_data_section or entry not in [replace(e, offset=position) for e in known]:
            known.append(entry)
        return end

    def _accept_metadata(self, position: int, record: records.Metadata) -> None:
        result = self._result
        if self._in_data_section or all(record != known for _, known in result.metadata):
            result.metadata.append((position, record))
            result.index.add_metadata(record)

    def _accept_message(self, position: int, end: int) -> int | None:
        if not self._in_data_section:
            return end
        if (
            not self._file.is_record_or_end(end)
            and self._file.find_record(position + 1, end, self._anchors) < end
        ):
            return None  # its length is wrong: it would contain other records
        head = self._file.read(position + RECORD_HEAD.size, MESSAGE_HEAD.size)
        channel, _, time_ns, _ = MESSAGE_HEAD.unpack(head)
        if time_ns > MAX_TIME_NS:
            return None  # its time is damaged: no reader accepts it
        self._run_counts[channel] += 1
        first, last = self._run_span or (time_ns, time_ns)
        self._run_span = min(first, time_ns), max(last, time_ns)
        start = self._runs[-1].offset if self._in_run else position
        if self._in_run and end - start <= MAX_RUN_BYTES:
            self._runs[-1] = Segment(start, end - start, False)
        else:
            self._runs.append(Segment(position, end - position, False))
        self._in_run = True
        return end

    def _settle_runs(self) -> None:
        """Accept the messages outside chunks, or none of them (see the module's docstring)."""
        result, index = self._result, self._result.index
        counts, statistics = index.counts + self._run_counts, result.statistics
        if self.has_chunks and (
            statistics is None or dict(counts) != statistics.channel_message_counts
        ):
            result.losses += [Loss(r.offset, r.offset + r.length, "message") for r in self._runs]
            result.losses.sort(key=lambda loss: loss.start)
            return
        index.counts = counts
        index.segments += self._runs
        if self._run_span is not None:
            index.include_times(*self._run_span)

    def _accept_footer(self, position: int, end: int) -> None:
        """Accept the summary in front of the footer, if its checksum is right."""
        result = self._result
        result.ended, self._in_data_section = True, False
        summary = self._read_summary(position, end)
        if summary is None:
            result.index_losses.append(Loss(self._summary_start or position, end, "index"))
            return
        self._has_intact_summary = True
        start, summary_records, is_verified = summary
        for opcode, record in summary_records:
            if opcode == Opcode.STATISTICS:
                result.statistics = record
            elif record is not None:  # The pass through the file has registered it as a loss.
                self._define(opcode, record, is_verified=is_verified)
        if is_verified:  # Its checksum is right, although it may contain texts with NUL.
            result.index_losses = [
                loss
                for loss in result.index_losses
                if not (start <= loss.start and loss.end <= position)
            ]
        # The bytes lost in front of the footer may be this summary, which is intact.
        if result.losses and result.losses[-1].end == position:
            loss = result.losses.pop()
            if loss.start < start:
                result.losses.append(replace(loss, end=start))

    def _read_summary(
        self, position: int, end: int
    ) -> tuple[int, list[tuple[Opcode, Any]], bool] | None:
        """Read the summary that belongs to the footer at ``position``.

        Returns
        -------
        (int, list of (Opcode, record), bool) or None
            Start; schemas, channels and statistics; whether they have a checksum. A record is
            None if it is damaged. The result is None if the checksum or a length is wrong.
        """
        file = self._file
        stated_start, _, crc = _FOOTER.unpack(file.read_content(position, end))
        footer = file.read(position, end - position - 4)
        # Missing or additional bytes in front of the summary move it from its stated position.
        for start in (stated_start, self._summary_start):
            if not len(MAGIC) <= start <= position or position - start > MAX_RECORD_BYTES:
                continue
            data = file.read(start, position - start)
            if crc and zlib.crc32(footer, zlib.crc32(data)) != crc:
                continue
            try:
                found = [
                    (
                        Opcode(opcode),
                        self._parse_summary_record(opcode, data[a:b], start, bool(crc)),
                    )
                    for opcode, a, b in iter_records(data, start)
                    if opcode in _SUMMARY_KINDS
                ]
            except DamageError:
                continue
            return start, found, bool(crc)
        return None

    def _parse_summary_record(
        self, opcode: int, content: bytes, offset: int, is_verified: bool
    ) -> Any:
        """Return a record of the summary at ``offset``; None if it is damaged.

        Raises
        ------
        DamageError
            It is damaged although the checksum of the summary is right.
        """
        if is_verified:
            return parse(READERS[opcode], content, offset)
        return self._file.parse_exactly(Opcode(opcode), content)

    def _define(self, opcode: Opcode, record: Definition, *, is_verified: bool) -> None:
        """Register a schema or a channel; one with a checksum replaces one without."""
        index, key = self._result.index, (opcode, record.id)
        known: dict[int, Any] = index.schemas if opcode == Opcode.SCHEMA else index.channels
        if not is_verified:
            known.setdefault(record.id, record)
        elif self._verified_definitions.setdefault(key, record) == record:
            known[record.id] = record
        else:
            self._result.conflicts.add(key)

    # ---- damaged records

    def _lose(self, position: int) -> int:
        """Register a loss at ``position``; return the position of the next acceptable record."""
        file, result = self._file, self._result
        if self._unverified_start is not None:
            # The length of the last record has no checksum: the record may hide another one.
            start, self._unverified_start = self._unverified_start, None
            hidden = file.find_record(start + 1, position, _WITH_CHECKSUM)
            if hidden < position:
                result.losses.append(Loss(start, hidden))
                return hidden
        loss = self._classify(position)
        end = loss.end
        if end == position:
            end = file.find_record(position + 1, file.size, self._anchors)
        elif not loss.name:
            # The length may be wrong and end at another record by chance: search inside, except
            # inside an attachment with a readable name, which may itself be a recording.
            end = file.find_record(position + 1, end, _WITH_CHECKSUM)
        if loss.what == "bytes" and file.is_zero(position, end):
            loss = replace(loss, what="zeros")
        self._in_run = False
        self.has_chunks |= loss.what in ("chunk", "message index", "chunk index")
        losses = result.losses if self._in_data_section else result.index_losses
        losses.append(replace(loss, end=end))
        return end

    def _classify(self, position: int) -> Loss:
        """Classify the damaged record at ``position``, which is also its ``end`` if unknown."""
        file, end, what = self._file, position, "bytes"
        head = file.record_head(position)
        if head is not None and head[0] and file.is_record_or_end(head[1]):
            opcode, end = head
            is_known = opcode <= Opcode.DATA_END
            what = Opcode(opcode).name.lower().replace("_", " ") if is_known else "unknown record"
        chunk, attachment = file.chunk_head(position), file.attachment_head(position)
        if chunk is not None:
            start_ns, end_ns, _ = chunk
            span = (start_ns, end_ns) if start_ns <= end_ns else ()
            return Loss(position, end, "chunk", "", *span)
        name = "" if attachment is None else attachment.name
        return Loss(position, end, what if attachment is None else "attachment", name)


# ---- channels without definition


def restore_channels(index: Index) -> None:
    """Add channels and schemas whose definition is lost but that a live recording listed.

    Such channels are in the metadata record :data:`CHANNELS_RECORD`. Their schemas are those of
    this version of locatk and of its foxglove package.
    """
    listed = index.metadata.get(CHANNELS_RECORD)
    if not listed:
        return
    # This import takes 0.12 s, mostly for importlib.metadata, and every reader imports this module.
    from mcap_protobuf.schema import build_file_descriptor_set

    for key, text in listed.items():
        topic, _, name = text.rpartition(" ")
        if not (key.isascii() and key.isdigit() and len(key) <= MAX_CHANNEL_DIGITS):
            continue
        channel = index.channels.get(int(key))
        if int(key) >= 1 << 16 or (
            channel is not None and (channel.schema_id in index.schemas or channel.schema_id == 0)
        ):
            continue
        message_class = _find_message_class(name)
        if not topic or message_class is None:
            continue
        if channel is None:
            known_ids = [schema.id for schema in index.schemas.values() if schema.name == name]
            used_ids = [0, *index.schemas, *(c.schema_id for c in index.channels.values())]
            schema_id = known_ids[0] if known_ids else max(used_ids) + 1
            channel = records.Channel(int(key), topic, "protobuf", {}, schema_id)
            index.channels[channel.id] = channel
        if channel.schema_id not in index.schemas:
            files = build_file_descriptor_set(message_class).SerializeToString()
            schema = records.Schema(channel.schema_id, files, "protobuf", name)
            index.schemas[schema.id] = schema


def _find_message_class(name: str) -> type[Message] | None:
    """Return the generated class of a message of locatk or foxglove, None if there is none."""
    package, _, short_name = name.partition(".")
    if package == "foxglove" and short_name.isidentifier():
        with contextlib.suppress(ImportError):
            importlib.import_module(f"foxglove_schemas_protobuf.{short_name}_pb2")
    elif package != "locatk":
        return None
    try:
        return GetMessageClass(descriptor_pool.Default().FindMessageTypeByName(name))
    except KeyError:
        return None
