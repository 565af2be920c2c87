"""Salvaging a recording: what is left of a damaged file, as a new whole one.

What is found (:mod:`.mcap_salvage`) is written anew in the order of the file, messages,
attachments and metadata as they were, and is read back before the output appears.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, Writer

from locatk.core.errors import FormatError, LocatkError, OutputExistsError
from locatk.formats.capture.statistics import RECORD as CAPTURE
from locatk.formats.output import atomic_write, check_output, tool_version
from locatk.formats.sessions.mcap_records import DamageError
from locatk.formats.sessions.reader import RECORD, Session, reading
from locatk.formats.sessions.recovery import rewriting as mcap_rewrite
from locatk.formats.sessions.recovery.salvage import Loss, Salvage, salvage
from locatk.formats.sessions.writer import PROFILE

RECOVERED = "recovered"
"""Metadata record that says what was saved and what was lost."""

MOST_RANGES = 100
"""So many lost ranges are named in the metadata."""


@dataclass(frozen=True)
class Topic:
    """What became of one topic.

    Attributes
    ----------
    topic, schema : str
    saved : int
        Messages.
    lost : int or None
        Messages; None where the file does not tell how many there were.
    missing_bytes : int or None
        Of ``locatk.SerialChunk``: received bytes that are not in what was saved, by their
        offsets; None for other schemas. What may be missing at the end is not known.
    """

    topic: str
    schema: str
    saved: int
    lost: int | None
    missing_bytes: int | None = None


@dataclass(frozen=True)
class Recovered:
    """What was saved, and what was not.

    Attributes
    ----------
    source, output : str
    topics : tuple of Topic
    chunks, attachments, metadata : int
        Saved.
    damaged_chunks : int
        Not saved; those of which not even the head can be read are not counted.
    lost_attachments, lost_metadata : int or None
        None where the file does not tell how many there were.
    orphans : int
        Messages in whole chunks whose channel is defined nowhere; not saved.
    nameless : tuple of str
        Topics whose schema is lost; saved without.
    losses : tuple of Loss
        Bytes of the source that are no good.
    tail : int
        How many of them are at the end of a source that lacks its end.
    ended : bool
        The source was written to its end. If not, what followed is not known.
    damaged : bool
        Something is wrong with the source, be it only its index.
    complete : bool
        Nothing was lost.
    """

    source: str
    output: str
    topics: tuple[Topic, ...]
    chunks: int
    attachments: int
    metadata: int
    damaged_chunks: int
    lost_attachments: int | None
    lost_metadata: int | None
    orphans: int
    nameless: tuple[str, ...]
    losses: tuple[Loss, ...]
    tail: int
    ended: bool
    damaged: bool
    complete: bool

    @property
    def messages(self) -> int:
        """Saved, of all topics."""
        return sum(topic.saved for topic in self.topics)

    @property
    def lost_messages(self) -> int | None:
        """Of all topics; None where the file does not tell how many there were."""
        lost = [topic.lost for topic in self.topics]
        return None if None in lost else sum(each or 0 for each in lost)

    @property
    def lost_bytes(self) -> int:
        """Bytes of the source that are no good."""
        return sum(map(len, self.losses))


def left_in(path: str | os.PathLike[str], damage: str) -> Session:
    """What is left in a damaged file, as a session that can be read; its
    :attr:`~.session.Session.damage` is ``damage``.

    Raises
    ------
    MissingDataError, FormatError
        There is no such file, or nothing of MCAP is left in it.
    """
    index = _found(path).index
    index.damage = damage
    return Session(path, index)


def recover(
    path: str | os.PathLike[str], output: str | os.PathLike[str], *, overwrite: bool = False
) -> Recovered:
    """Write what is left of ``path`` to a new file; ``path`` is not touched.

    Messages keep their times, sequence numbers and order, metadata and attachments their place
    among them; channels may get other ids. A metadata record ``recovered`` says what was lost.

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
        What was written cannot be read back: the disk is no good.
    """
    if os.path.exists(output) and os.path.exists(path) and os.path.samefile(path, output):
        raise OutputExistsError("the output is the input", file=output, hint="Choose another -o")
    check_output(output, overwrite=overwrite)
    found = _found(path)
    index, version = found.index, tool_version()
    # Only the first part of a recording begins with the first byte that was received.
    begins = CAPTURE in index.metadata and index.metadata[CAPTURE].get("part", "1") == "1"
    with atomic_write(output, overwrite=overwrite) as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(
            profile=index.header.profile or (PROFILE if RECORD in index.metadata else ""),
            library=f"{index.header.library} (recovered by locatk {version})".strip(),
        )
        copy = mcap_rewrite.Copy(writer, found, first_byte=0 if begins else None)
        for piece in mcap_rewrite.pieces(path, found):
            copy.take(piece)
        recovered = _summed_up(os.fspath(path), os.fspath(output), found, copy)
        if not recovered.messages and not recovered.complete:
            raise _nothing_left(path, recovered)
        writer.add_metadata(RECOVERED, {"tool_version": version, **_record(recovered)})
        writer.finish()
        stream.flush()
        try:
            mcap_rewrite.check(stream.name, copy)
        except DamageError as damage:
            raise LocatkError(
                f"what was written cannot be read back ({damage})",
                file=output,
                hint="Check the disk, or write to another one",
            ) from None
    return recovered


def _found(path: str | os.PathLike[str]) -> Salvage:
    with reading(path) as stream:
        found = salvage(stream)
    index = found.index
    if not (index.segments or index.attachments or found.metadata or found.statistics):
        raise FormatError(
            "nothing of a recording (MCAP) is left in it",
            file=path,
            hint="Give a file that `locatk capture` or another recorder made",
        )
    mcap_rewrite.name_channels(index)
    return found


def _nothing_left(path: str | os.PathLike[str], recovered: Recovered) -> FormatError:
    if recovered.orphans:
        return FormatError(
            f"nothing is left that says what its {recovered.orphans} messages are", file=path
        )
    return FormatError("no whole chunk is left, there is no message to save", file=path)


def _summed_up(source: str, output: str, found: Salvage, copy: mcap_rewrite.Copy) -> Recovered:
    told = found.statistics
    unknown: int | None = None if found.losses or not found.ended else 0
    missing: Counter[int] = Counter()
    lost_attachments = lost_metadata = unknown
    if told is not None:
        missing = Counter(told.channel_message_counts) - found.index.counts
        lost_attachments = max(0, told.attachment_count - copy.attachments)
        lost_metadata = max(0, told.metadata_count - copy.metadata)
    intact = not (missing or lost_attachments or lost_metadata) if told else not found.losses
    lost: Counter[int | str] = Counter()
    for channel, count in missing.items():
        lost[copy.new_ids.get(channel, f"channel {channel}")] += count
    topics = [
        Topic(
            topic,
            schema,
            copy.counts[new],
            lost[new] if told else unknown,
            copy.missing.get(new),
        )
        for new, (topic, schema) in copy.topics.items()
    ]
    topics += [Topic(name, "", 0, count) for name, count in lost.items() if isinstance(name, str)]
    return Recovered(
        source=source,
        output=output,
        topics=tuple(topics),
        chunks=sum(segment.is_chunk for segment in found.index.segments),
        attachments=copy.attachments,
        metadata=copy.metadata,
        damaged_chunks=sum(loss.what == "chunk" for loss in found.losses),
        lost_attachments=lost_attachments,
        lost_metadata=lost_metadata,
        orphans=copy.orphans,
        nameless=tuple(copy.nameless),
        losses=tuple(found.losses),
        tail=found.tail,
        ended=found.ended,
        damaged=bool(found.losses or found.beside or found.copies or not found.ended),
        complete=found.ended and intact and not copy.orphans,
    )


def _record(recovered: Recovered) -> dict[str, str]:
    """What became of the source, as texts for the metadata."""
    ranges = [
        f"{loss.start}-{loss.end} {loss.what} {loss.name}".rstrip()
        for loss in recovered.losses[:MOST_RANGES]
    ]
    if len(recovered.losses) > MOST_RANGES:
        ranges.append("...")
    values = {
        "source": Path(recovered.source).name,
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
        "tail_bytes": recovered.tail,
        **{f"saved:{topic.topic}": topic.saved for topic in recovered.topics},
        **{f"missing_bytes:{topic.topic}": topic.missing_bytes for topic in recovered.topics},
    }
    return {key: str(value) for key, value in values.items() if value is not None}
