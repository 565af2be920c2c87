"""Sessions: MCAP files with protobuf messages, read fast.

What is in them is said in docs/formats.md; how sweeps and poses become messages, in
:mod:`locatk.formats.sessions.messages`; :mod:`locatk.formats.sessions.writer` writes them.
"""

from __future__ import annotations

import os
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, TypeVar

from google.protobuf.message import DecodeError, Message
from mcap.opcode import Opcode
from mcap.records import Attachment

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.formats.sessions import mcap_records
from locatk.formats.sessions.mcap_records import DamageError, Index, NotMcapError

RECORD = "locatk"
"""Name of the metadata record that every file of locatk carries."""

_MessageT = TypeVar("_MessageT", bound=Message)


@dataclass(frozen=True)
class Channel:
    """One topic of a session, the name of its schema and how many messages it holds."""

    topic: str
    schema: str
    encoding: str
    count: int


@dataclass(frozen=True)
class AttachmentInfo:
    """One attachment of a session; ``time_ns`` is when it was written."""

    name: str
    media_type: str
    size: int
    time_ns: int


class Session:
    """A session on disk, opened by :meth:`open`. It keeps no file open.

    Attributes
    ----------
    path : str
        The file.
    profile, library : str
        What the header says of the program that wrote it; ``profile`` is
        ``"locatk"`` for files of locatk.
    channels : tuple of Channel
        In the order in which they were registered.
    start_ns, end_ns : int or None
        Log times of the first and the last message; None without messages.
    damage : str or None
        What is wrong with the file, where it was opened in spite of it.
    index : Index
        Where the records are, for :mod:`locatk.formats.sessions.message_index`.
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
        """Open a session and read what it holds, not yet the messages.

        Parameters
        ----------
        path : path
            An MCAP file of any tool.
        damaged_ok : bool
            Take a file that is cut short or damaged for what is left in it;
            :attr:`damage` then says what is wrong.

        Raises
        ------
        MissingDataError
            There is no such file.
        FormatError
            It is empty, not MCAP, cut short or damaged.
        """
        with reading(path) as stream:
            try:
                return cls(path, mcap_records.read_index(stream))
            except NotMcapError:
                raise
            except DamageError as damage:
                if not damaged_ok:
                    raise
                index = mcap_records.walk_index(stream)
                index.damage = index.damage or str(damage)
                return cls(path, index)

    def topics(self, prefix: str, schema: str | None = None) -> tuple[str, ...]:
        """Topics that start with ``prefix`` and, if given, have this schema; sorted."""
        found = {
            channel.topic
            for channel in self.channels
            if channel.topic.startswith(prefix) and schema in (None, channel.schema)
        }
        return tuple(sorted(found))

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, log time in ns, payload) of each message, in file order.

        Parameters
        ----------
        topics : iterable of str, optional
            Only these; all by default.

        Raises
        ------
        FormatError
            A chunk is damaged, or holds other messages than the index says.
        """
        names = None if topics is None else frozenset(topics)
        wanted = {
            entry.id: entry.topic
            for entry in self.index.channels.values()
            if names is None or entry.topic in names
        }
        expected = sum(self.index.counts[channel] for channel in wanted)
        seen = 0
        with reading(self.path) as stream:
            for segment in self.index.segments:
                if segment.channels is not None and segment.channels.isdisjoint(wanted):
                    continue
                for channel, time_ns, data in mcap_records.read_messages(stream, segment, wanted):
                    seen += 1
                    yield wanted[channel], time_ns, data
            if seen != expected:
                raise DamageError(f"{seen} messages where the index says {expected}")

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
        """Metadata records by name; of equal names the later one wins, key by key."""
        return {name: dict(record) for name, record in self.index.metadata.items()}

    @property
    def facts(self) -> dict[str, str]:
        """The record ``locatk``: kind, system, versions; empty for another tool's file."""
        return dict(self.index.metadata.get(RECORD, {}))

    def attachments(self) -> tuple[AttachmentInfo, ...]:
        """What is attached, without reading it."""
        return tuple(
            AttachmentInfo(entry.name, entry.media_type, entry.data_size, entry.log_time)
            for entry in self.index.attachments
        )

    def attachment(self, name: str) -> bytes | None:
        """Content of the last attachment of this name, or None.

        Raises
        ------
        FormatError
            It is damaged.
        """
        entries = [entry for entry in self.index.attachments if entry.name == name]
        if not entries:
            return None
        offset = entries[-1].offset
        with reading(self.path) as stream:
            content = mcap_records.record_at(stream, offset, Opcode.ATTACHMENT)
            crc = int.from_bytes(content[-4:], "little")
            if crc and zlib.crc32(content[:-4]) != crc:
                raise DamageError(f"attachment {name} is damaged (wrong checksum)", offset)
            return mcap_records.parse(Attachment.read, content, offset).data


@contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """The open MCAP file; whatever is wrong with it becomes an error of one line."""
    try:
        # A pipe would be waited for, for ever, and nothing of it can be read twice.
        if not stat.S_ISREG(kind := os.stat(path).st_mode) and not stat.S_ISDIR(kind):
            raise FormatError("not a regular file", file=path)
        with open(path, "rb") as stream:
            yield stream
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", file=path) from None
    except IsADirectoryError:
        raise FormatError("a folder, not an MCAP file", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from error
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
            hint=f"`locatk recover {os.fspath(path)} -o whole.mcap` saves what is left of it",
        ) from None
