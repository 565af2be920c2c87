"""Sessions: MCAP files of protobuf messages.

Their contents are listed in docs/formats.md. :mod:`locatk.formats.sessions.writer` writes them,
:mod:`locatk.formats.sessions.messages` converts messages to arrays and back.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, TypeVar

from google.protobuf.message import DecodeError, Message

from locatk.core.errors import FormatError
from locatk.formats.files import open_binary
from locatk.formats.sessions import mcap_file
from locatk.formats.sessions.mcap_file import (
    MAX_TIME_NS,
    SESSION_RECORD,
    DamageError,
    Index,
    MessagePosition,
    NotMcapError,
    Segment,
)
from locatk.formats.sessions.recovery.salvage import describe_damage, salvage

MAX_INDEXED_FRACTION = 0.25
"""Fraction of the messages of a file up to which they are read by the message indexes. A message
takes about four times as long by an index as in a scan of all messages (measured)."""

_MessageT = TypeVar("_MessageT", bound=Message)


@dataclass(frozen=True)
class Channel:
    """One topic of a session, the name of its schema and the number of its messages."""

    topic: str
    schema: str
    encoding: str
    count: int


@dataclass(frozen=True)
class AttachmentInfo:
    """One attachment of a session; ``time_ns`` is the time at which it was written."""

    name: str
    media_type: str
    size: int
    time_ns: int


class Session:
    """A session on disk, opened by :meth:`open`. It keeps no file open.

    Attributes
    ----------
    path : str
    profile, library : str
        Entries of the header about the program that wrote the file; ``profile`` is
        ``"locatk"`` for files of locatk.
    channels : tuple of Channel
        In the order in which they were registered.
    start_ns, end_ns : int or None
        Log times of the first and the last message; None without messages.
    damage : str or None
        Description of the damage, if the file was opened in spite of it.
    index : Index
        Positions of all records.
    """

    def __init__(self, path: str | os.PathLike[str], index: Index) -> None:
        self.path = os.fspath(path)
        self.index = index
        self.profile = index.header.profile
        self.library = index.header.library
        self.start_ns = index.start_ns
        self.end_ns = index.end_ns
        self.damage = index.damage
        self.channels = tuple(
            Channel(
                entry.topic,
                index.schemas[entry.schema_id].name if entry.schema_id in index.schemas else "",
                entry.message_encoding,
                index.counts[entry.id],
            )
            for entry in index.channels.values()
        )

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, damaged_ok: bool = False) -> Session:
        """Open a session and read its index; messages are read later.

        Parameters
        ----------
        path : path
            An MCAP file of any tool.
        damaged_ok : bool
            Open a file that is cut short or damaged with the contents that can be salvaged;
            :attr:`damage` then describes the damage.

        Raises
        ------
        MissingDataError
            There is no such file.
        FormatError
            It is empty, not MCAP, cut short or damaged; with ``damaged_ok``, nothing can be
            salvaged.
        """
        with open_mcap(path) as stream:
            try:
                index = read_index(stream)
            except DamageError as damage:
                if not damaged_ok:
                    raise
                found = salvage(stream)
                if found.is_empty:
                    raise
                index = found.index
                index.damage = _describe(damage)
                if found.unconfirmed:
                    names = sorted(index.channels[number].topic for number in found.unconfirmed)
                    index.damage += f"; only it contains the names of {', '.join(names)}"
            if index.damage is not None and not damaged_ok:  # Its writer made no summary.
                raise DamageError(index.damage)
            return cls(path, index)

    def topics(self, prefix: str, schema: str | None = None) -> tuple[str, ...]:
        """Return the topics that start with ``prefix`` and, if given, have this schema; sorted."""
        topics = {
            channel.topic
            for channel in self.channels
            if channel.topic.startswith(prefix) and schema in (None, channel.schema)
        }
        return tuple(sorted(topics))

    def channel_ids(self, topics: Collection[str]) -> set[int]:
        """Return the ids of the channels of ``topics``."""
        return {entry.id for entry in self.index.channels.values() if entry.topic in topics}

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, log time in ns, payload) of each message, in file order.

        Parameters
        ----------
        topics : iterable of str, optional
            Topics to read; all by default.

        Raises
        ------
        FormatError
            A chunk is damaged, or the number of messages differs from that of the index.
        """
        names = None if topics is None else frozenset(topics)
        topic_of = {
            entry.id: entry.topic
            for entry in self.index.channels.values()
            if names is None or entry.topic in names
        }
        count = 0
        number = sum(self.index.counts[channel] for channel in topic_of)
        is_minority = number < MAX_INDEXED_FRACTION * self.index.counts.total()
        with open_mcap(self.path) as stream:
            for segment in self.index.segments_with(topic_of):
                messages = mcap_file.read_messages(stream, segment, topic_of, use_index=is_minority)
                for channel, time_ns, data in messages:
                    count += 1
                    if time_ns > MAX_TIME_NS:
                        raise _log_time_error(self.path, topic_of[channel], time_ns)
                    yield topic_of[channel], time_ns, data
            _check_count(self.index, count, topic_of)

    def decoded(
        self, topic: str, message_class: type[_MessageT]
    ) -> Iterator[tuple[int, _MessageT]]:
        """Yield (log time in ns, message) of one topic.

        Raises
        ------
        FormatError
            The topic has another schema, or a message cannot be decoded.
        """
        name = message_class.DESCRIPTOR.full_name
        for channel in self.channels:
            if channel.topic == topic and (channel.schema, channel.encoding) != (name, "protobuf"):
                raise FormatError(
                    f"topic holds {channel.schema or channel.encoding}, not {name}",
                    file=self.path,
                    where=topic,
                )
        for _, time_ns, data in self.messages([topic]):
            try:
                yield time_ns, message_class.FromString(data)
            except DecodeError:
                raise FormatError(
                    f"a message is no valid {name}", file=self.path, where=topic
                ) from None

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the metadata records by name; of equal names the later one wins, key by key."""
        return {name: dict(record) for name, record in self.index.metadata.items()}

    @property
    def facts(self) -> dict[str, str]:
        """Metadata record ``locatk``: kind, system, versions; empty for files of other tools."""
        return dict(self.index.metadata.get(SESSION_RECORD, {}))

    def attachments(self) -> tuple[AttachmentInfo, ...]:
        """List the attachments without reading them."""
        return tuple(
            AttachmentInfo(entry.name, entry.media_type, entry.data_size, entry.log_time)
            for entry in self.index.attachments
        )

    def attachment(self, name: str) -> bytes | None:
        """Return the content of the last attachment of this name, or None.

        Raises
        ------
        FormatError
            It is damaged.
        """
        offsets = [entry.offset for entry in self.index.attachments if entry.name == name]
        if not offsets:
            return None
        with open_mcap(self.path) as stream:
            try:
                return mcap_file.read_attachment(stream, offsets[-1]).data
            except DamageError as damage:
                raise DamageError(f"attachment {name} is damaged ({damage})", offsets[-1]) from None


class RandomAccess:
    """Single messages of a session in any order; holds one decompressed chunk.

    Parameters
    ----------
    session : Session
        Its file must not change in the meantime.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._segment: Segment | None = None
        self._data: bytes | memoryview = b""

    def positions(self, topic: str) -> list[MessagePosition]:
        """Return the positions of the messages of a topic, in file order.

        Raises
        ------
        FormatError
            The index is damaged, or lists another number of messages than it counts.
        """
        channels = self._session.channel_ids([topic])
        with open_mcap(self._session.path) as stream:
            found = [
                position
                for segment in self._session.index.segments_with(channels)
                for position in mcap_file.find_messages(stream, segment, channels)
            ]
            _check_count(self._session.index, len(found), channels)
        last_ns = max((position.time_ns for position in found), default=0)
        if last_ns > MAX_TIME_NS:
            raise _log_time_error(self._session.path, topic, last_ns)
        return found

    def payload(self, position: MessagePosition) -> bytes:
        """Return the payload of one message; fast if the previous one was in the same chunk.

        Raises
        ------
        FormatError
            The chunk is damaged, or another record is at this position.
        """
        if self._segment is not position.segment:
            with open_mcap(self._session.path) as stream:
                self._data = mcap_file.read_segment(stream, position.segment)
                self._segment = position.segment
        with damage_as_format_error(self._session.path):
            return mcap_file.message_payload(self._data, position)


def read_index(stream: IO[bytes]) -> Index:
    """Read the index of a file; if its writer made none, all records are read.

    In the latter case damage does not raise an error: the index lists the intact contents, and
    ``damage`` of the index describes the damage.

    Raises
    ------
    DamageError
        The file is not MCAP, cut short, or its summary is damaged.
    """
    index = mcap_file.read_summary(stream)
    if index is None:
        found = salvage(stream)
        index = found.index
        index.damage = describe_damage(found)
    return index


def find_damage(path: str | os.PathLike[str]) -> str | None:
    """Read all of a file and describe its first damage; return None if it is whole."""
    with open_mcap(path) as stream:
        return describe_damage(salvage(stream))


def time_error(
    path: str | os.PathLike[str], topic: str, time_ns: int, hint: str | None = None
) -> FormatError:
    """Return the error for a time that int64 nanoseconds do not hold.

    ``hint`` is the remedy if the time is that of the message, and not one in its payload.
    """
    return FormatError(
        f"a message has the time {time_ns} ns, after the year 2262",
        file=path,
        where=topic,
        hint=hint or "Set the clock of the recorder, and record again",
    )


def _log_time_error(path: str, topic: str, time_ns: int) -> FormatError:
    hint = f"`{_recover_command(path)}` leaves such messages out"
    return time_error(path, topic, time_ns, hint)


def _recover_command(path: str | os.PathLike[str]) -> str:
    return f"locatk recover {shlex.quote(os.fspath(path))} -o whole.mcap"


def _check_count(index: Index, count: int, channels: Iterable[int]) -> None:
    expected = sum(index.counts[channel] for channel in channels)
    if count != expected:
        raise DamageError(f"{count} messages instead of the {expected} that the index counts")


def _describe(damage: DamageError) -> str:
    if isinstance(damage, NotMcapError):
        return "it does not begin as an MCAP file"
    return str(damage) if damage.offset is None else f"{damage} (byte {damage.offset})"


@contextmanager
def open_mcap(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open an MCAP file; system errors and :class:`DamageError` become errors of locatk.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It cannot be read.
    FormatError
        It is not a regular file, or its content is damaged.
    """
    with open_binary(path) as stream, damage_as_format_error(path):
        yield stream


@contextmanager
def damage_as_format_error(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert :class:`DamageError` to a FormatError with file, byte and remedy."""
    try:
        yield
    except NotMcapError as damage:
        raise FormatError(
            str(damage),
            file=path,
            hint="Give a session made by `locatk capture`, `import` or `simulate`",
        ) from None
    except DamageError as damage:
        raise FormatError(
            str(damage),
            file=path,
            where=None if damage.offset is None else f"byte {damage.offset}",
            hint=f"`{_recover_command(path)}` saves the undamaged rest",
        ) from None
