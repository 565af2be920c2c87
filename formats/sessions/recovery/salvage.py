"""What is left of a damaged MCAP file: cut short, zeroed, overwritten or with flipped bits.

The records are walked as they follow each other. Where one is not what it should be, the next
one that proves itself (:mod:`.mcap_proof`) is searched for, and what lies between is lost.

Messages outside chunks have no checksum. They are taken as they are where a file has no
chunks; beside chunks only where the statistics at the end confirm them, as one flipped bit
makes a message of an index.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import IO, Any

from mcap import records
from mcap.opcode import Opcode

from locatk.formats.sessions.mcap_records import (
    LOOSE_SEGMENT,
    MAGIC,
    DamageError,
    Index,
    Segment,
    frames,
)
from locatk.formats.sessions.recovery.validation import (
    LARGEST_RECORD,
    MESSAGE,
    READERS,
    Evidence,
    exact,
)

_FOOTER = struct.Struct("<QQI")

_CHECKSUM = (Opcode.CHUNK, Opcode.ATTACHMENT)
_GUARDED = (*_CHECKSUM, Opcode.METADATA, Opcode.DATA_END, Opcode.FOOTER)
_LOOSE = (*_GUARDED, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Kinds of records at which a search may end, in files with chunks and without."""


@dataclass(frozen=True)
class Loss:
    """Bytes of the file that are no good.

    Attributes
    ----------
    start, end : int
        The first byte, and the one after the last.
    what : str
        ``"chunk"``, ``"attachment"``, ... where such a record begins; ``"zeros"`` where all
        are zero; else ``"bytes"``.
    name : str
        Of an attachment, where it can be read.
    start_ns, end_ns : int or None
        Log times of the messages in a chunk, where its head can be read.
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
    """What is left of a file, and what is not.

    Attributes
    ----------
    size : int
        Of the file.
    index : Index
        What is left; of its chunks each checksum was right.
    metadata : list of (int, Metadata)
        Offset and content of each record, in the order of the file.
    losses : list of Loss
        Where messages, attachments or metadata were, or may have been.
    beside : list of Loss
        Where none were: in the index at the end, and behind the end.
    copies : int
        Chunks that are there a second time, and left out.
    ended : bool
        The file has its footer: whoever wrote it came to the end.
    statistics : Statistics or None
        What the file should hold, where its index is whole.
    conflicts : set of (Opcode, int)
        Kinds and ids of schemas and channels that chunks define in several ways.
    """

    size: int
    index: Index = field(default_factory=Index)
    metadata: list[tuple[int, records.Metadata]] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    beside: list[Loss] = field(default_factory=list)
    copies: int = 0
    ended: bool = False
    statistics: records.Statistics | None = None
    conflicts: set[tuple[Opcode, int]] = field(default_factory=set)

    @property
    def tail(self) -> int:
        """Bytes at the end that are no good, of a file that lacks its end."""
        last = self.losses[-1] if self.losses and not self.ended else None
        return len(last) if last is not None and last.end == self.size else 0


def salvage(stream: IO[bytes]) -> Salvage:
    """Find what is left of an MCAP file; reads all of it, and holds one record at a time.

    Where a file has no chunks, messages outside chunks are searched for as well.
    """
    walk = _Walk(stream, _GUARDED)
    found = walk.run()
    if found.losses and walk.is_mcap and not walk.chunked:
        found = _Walk(stream, _LOOSE).run()
    return found


class _Walk:
    """One walk through a file; a search may end at records of the ``anchors``."""

    def __init__(self, stream: IO[bytes], anchors: Collection[Opcode]) -> None:
        self._file = Evidence(stream)
        self._anchors = anchors
        self.found = Salvage(self._file.size)
        ends = (self._file.at(0, 8), self._file.at(max(0, self.found.size - 8), 8))
        self.is_mcap = MAGIC in ends
        self.chunked = False
        """Messages are in chunks, even if all of them are damaged."""
        self._guarded = False
        """The record just taken has a checksum."""
        self._doubtful: int | None = None
        """Where the last record began, if it has none."""
        self._in_data = True
        self._summary_start = 0
        self._recordings = 0
        self._keys: set[tuple[int, int]] = set()
        self._proven: dict[tuple[Opcode, int], bytes] = {}
        self._runs: list[Segment] = []
        self._in_run = False
        self._run_counts: Counter[int] = Counter()
        self._run_span: tuple[int, int] | None = None

    def run(self) -> Salvage:
        """Walk from the first byte to the last."""
        found, file = self.found, self._file
        first, position = file.record(len(MAGIC)), 0
        if file.at(0, len(MAGIC)) != MAGIC and first is not None and first[0] == Opcode.HEADER:
            position = len(MAGIC)
            found.beside.append(Loss(0, position))
        while position < file.size:
            self._guarded = False
            end = self._take(position)
            if end is None:
                position = self._lose(position)
            else:
                self._doubtful = None if self._guarded else position
                position = end
        found.ended = found.ended or file.at(max(8, file.size - 8), 8) == MAGIC
        if self._recordings > 1:
            found.statistics = None  # of one of several recordings, one behind the other
        self._settle_runs()
        found.index.segments.sort(key=lambda segment: segment.offset)
        return found

    # ---- what is good

    def _take(self, position: int) -> int | None:
        """Book the record at ``position`` and give its end; None where it is no good."""
        file = self._file
        if file.at(position, len(MAGIC)) == MAGIC:
            return position + len(MAGIC)
        found = file.record(position)
        if found is None:
            return None
        opcode, end = found
        if opcode == Opcode.CHUNK:
            return self._take_chunk(position, end)
        if opcode == Opcode.ATTACHMENT:
            return self._take_attachment(position, end)
        if opcode == Opcode.MESSAGE:
            return self._take_message(position, end)
        if opcode == Opcode.FOOTER:
            self._take_footer(position, end)
        elif opcode == Opcode.DATA_END:
            self._in_data, self._summary_start = False, end
        elif opcode in (Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX):
            self.chunked = True
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, file.content(position, end), proven=False)
        elif opcode in (Opcode.METADATA, Opcode.HEADER):
            record = exact(READERS[opcode], file.content(position, end))
            take = self._take_header if opcode == Opcode.HEADER else self._take_metadata
            take(position, record)
        return end

    def _take_header(self, position: int, header: records.Header) -> None:
        if not self._recordings:
            self.found.index.header = header
        self._recordings += 1
        self._in_data, self.found.ended = True, False

    def _take_chunk(self, position: int, end: int) -> int | None:
        inside = self._file.chunk(position, end)
        if inside is None:
            return None
        self._guarded, self.chunked, self._in_run = True, True, False
        found, index = self.found, self.found.index
        # A walk without a stumble comes to each chunk once, so that two may well be the same.
        stumbled = found.losses or found.beside or not self._in_data or self._recordings > 1
        if inside.key in self._keys and stumbled:
            found.copies += 1
            return end
        self._keys.add(inside.key)
        for opcode, content in inside.definitions:
            self._define(opcode, content, proven=True)
        index.counts.update(inside.counts)
        self._span(inside.span)
        channels = frozenset(inside.counts)
        index.segments.append(Segment(position, end - position, True, channels))
        return end

    def _take_attachment(self, position: int, end: int) -> int | None:
        head = self._file.attachment_head(position)
        if head is None or not self._file.attachment_is_right(position, end):
            return None
        self._guarded = True
        entry = records.AttachmentIndex(
            offset=position,
            length=end - position,
            log_time=head.log_ns,
            create_time=head.create_ns,
            data_size=head.size,
            name=head.name,
            media_type=head.media_type,
        )
        known = self.found.index.attachments
        if self._in_data or entry not in [replace(each, offset=position) for each in known]:
            known.append(entry)
        return end

    def _take_metadata(self, position: int, record: records.Metadata) -> None:
        found = self.found
        if self._in_data or all(record != known for _, known in found.metadata):
            found.metadata.append((position, record))
            found.index.metadata.setdefault(record.name, {}).update(record.metadata)

    def _take_message(self, position: int, end: int) -> int | None:
        if not self._in_data:
            return end
        if (
            not self._file.goes_on(end)
            and self._file.search(position + 1, end, self._anchors) < end
        ):
            return None  # its length is wrong: it would swallow others
        channel, _, time_ns, _ = MESSAGE.unpack(self._file.at(position + 9, MESSAGE.size))
        self._run_counts[channel] += 1
        first, last = self._run_span or (time_ns, time_ns)
        self._run_span = min(first, time_ns), max(last, time_ns)
        start = self._runs[-1].offset if self._in_run else position
        if self._in_run and end - start <= LOOSE_SEGMENT:
            self._runs[-1] = Segment(start, end - start, False)
        else:
            self._runs.append(Segment(position, end - position, False))
        self._in_run = True
        return end

    def _settle_runs(self) -> None:
        """Keep messages outside chunks, or give them up; see the head of this module."""
        found, index = self.found, self.found.index
        together, told = index.counts + self._run_counts, found.statistics
        if self.chunked and (told is None or dict(together) != told.channel_message_counts):
            found.losses += [Loss(r.offset, r.offset + r.length, "message") for r in self._runs]
            found.losses.sort(key=lambda loss: loss.start)
            return
        index.counts = together
        index.segments += self._runs
        self._span(self._run_span)

    def _take_footer(self, position: int, end: int) -> None:
        """Take the summary in front of the footer, if its checksum is right."""
        found = self.found
        found.ended, self._in_data = True, False
        summary = self._summary(position, end)
        if summary is None:
            found.beside.append(Loss(self._summary_start or position, end, "index"))
            return
        start, told, proven = summary
        for opcode, inside in told:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(Opcode(opcode), inside, proven=proven)
            elif opcode == Opcode.STATISTICS:
                found.statistics = exact(READERS[opcode], inside)
        # What was lost in front of the footer may have been this summary, which is whole.
        if found.losses and found.losses[-1].end == position:
            loss = found.losses.pop()
            if loss.start < start:
                found.losses.append(replace(loss, end=start))

    def _summary(self, position: int, end: int) -> tuple[int, list[tuple[int, bytes]], bool] | None:
        """Where the summary is that belongs to the footer at ``position``, its records, and
        whether it has a checksum; None where that or a record is wrong."""
        file = self._file
        told_start, _, crc = _FOOTER.unpack(file.content(position, end))
        footer = file.at(position, end - position - 4)
        # Bytes that are missing before it, or too many, have moved it away from its place.
        for start in (told_start, self._summary_start):
            if not len(MAGIC) <= start <= position or position - start > LARGEST_RECORD:
                continue
            data = file.at(start, position - start)
            if crc and zlib.crc32(footer, zlib.crc32(data)) != crc:
                continue
            try:
                told = [(opcode, bytes(inside)) for opcode, _, inside in frames(data, start)]
            except DamageError:
                continue
            return start, told, bool(crc)
        return None

    def _define(self, opcode: Opcode, content: bytes, *, proven: bool) -> None:
        """Note a schema or a channel; one under a checksum is better than one without."""
        record: Any = exact(READERS[opcode], content)
        if record is None:
            return
        index, key = self.found.index, (opcode, record.id)
        known: dict[int, Any] = index.schemas if opcode == Opcode.SCHEMA else index.channels
        if not proven:
            known.setdefault(record.id, record)
            return
        if self._proven.setdefault(key, content) == content:
            known[record.id] = record
        else:
            self.found.conflicts.add(key)

    def _span(self, span: tuple[int, int] | None) -> None:
        index = self.found.index
        if span is not None:
            index.start_ns = span[0] if index.start_ns is None else min(index.start_ns, span[0])
            index.end_ns = span[1] if index.end_ns is None else max(index.end_ns, span[1])

    # ---- what is not

    def _lose(self, position: int) -> int:
        """Book what begins at ``position`` as lost, up to where the walk can go on."""
        file, found = self._file, self.found
        if self._doubtful is not None:
            # Its length was believed as it was no longer than the file; it may have hidden one.
            start, self._doubtful = self._doubtful, None
            hidden = file.search(start + 1, position, _CHECKSUM)
            if hidden < position:
                found.losses.append(Loss(start, hidden))
                return hidden
        loss = self._damaged(position)
        end = loss.end
        if end == position:
            end = file.search(position + 1, file.size, self._anchors)
        elif not loss.name:
            # Its length may be wrong, and lead to a record by chance: look inside. Not into an
            # attachment whose name can be read, which may be a recording.
            end = file.search(position + 1, end, _CHECKSUM)
        if loss.what == "bytes" and file.only_zeros(position, end):
            loss = replace(loss, what="zeros")
        self._in_run = False
        self.chunked = self.chunked or loss.what in ("chunk", "message index", "chunk index")
        (found.losses if self._in_data else found.beside).append(replace(loss, end=end))
        return end

    def _damaged(self, position: int) -> Loss:
        """What seems to begin at ``position``; ``end`` is ``position`` where that is unknown."""
        file, end, what = self._file, position, "bytes"
        frame = file.frame(position)
        if frame is not None and frame[0] and self._file.goes_on(frame[1]):
            opcode, end = frame
            known = opcode <= Opcode.DATA_END
            what = Opcode(opcode).name.lower().replace("_", " ") if known else "unknown record"
        chunk, attachment = file.chunk_head(position), file.attachment_head(position)
        if chunk is not None:
            span = (chunk.start_ns, chunk.end_ns)
            return Loss(position, end, "chunk", "", *(span if span[0] <= span[1] else ()))
        name = "" if attachment is None else attachment.name
        return Loss(position, end, what if attachment is None else "attachment", name)
