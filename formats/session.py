"""Sessions: MCAP files with protobuf messages, written whole and read fast.

What is in them is said in docs/formats.md; how sweeps and poses become messages, in
:mod:`locatk.formats.messages`.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import IO, Any, TypeVar

from google.protobuf.message import DecodeError, Message
from mcap.opcode import Opcode
from mcap.records import Attachment
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.formats import mcap_records
from locatk.formats.mcap_records import DamageError, Index, NotMcapError
from locatk.formats.output import atomic_write, tool_version

PROFILE = "locatk"
FORMAT_VERSION = "1"
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
        Where the records are, for :mod:`locatk.formats.mcap_places`.
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
            str(damage), file=path, hint="Give a session made by `locatk import` or `simulate`"
        ) from None
    except DamageError as damage:
        raise FormatError(
            str(damage),
            file=path,
            where=None if damage.offset is None else f"byte {damage.offset}",
            hint="Record or import it again; `locatk info` tells what is left in it",
        ) from None


class SessionWriter:
    """Writes a session; a context manager, on whose clean exit the file appears.

    Messages should come in the order of their times: readers then need little memory.
    Same calls, same bytes.

    Parameters
    ----------
    path : path
        The output; see :func:`locatk.formats.output.atomic_write`.
    kind : str
        ``"session"`` or ``"solution"``.
    system : str
        ``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``.
    facts : mapping of str to str, optional
        More entries for the metadata record ``locatk``.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        On entering, before anything is written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        kind: str = "session",
        system: str,
        facts: Mapping[str, str] | None = None,
        overwrite: bool = False,
    ) -> None:
        self._output: AbstractContextManager[IO[Any]] = atomic_write(path, overwrite=overwrite)
        self._record = {
            "format_version": FORMAT_VERSION,
            "tool_version": tool_version(),
            "kind": kind,
            "system": system,
            **(facts or {}),
        }
        self._writer: Writer | None = None
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, type[Message]]] = {}
        self._sequence: dict[int, int] = {}

    def __enter__(self) -> SessionWriter:
        stream = self._output.__enter__()
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile=PROFILE, library=f"locatk {tool_version()}")
        self.metadata(RECORD, self._record)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            try:
                self._open_writer.finish()
            except BaseException as failure:
                # The output must be removed, as after any failure inside the block.
                self._output.__exit__(type(failure), failure, failure.__traceback__)
                raise
        self._output.__exit__(kind, error, trace)

    @property
    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise RuntimeError("SessionWriter is used outside its `with` block")
        return self._writer

    def write(self, topic: str, message: Message, time_ns: int) -> None:
        """Write one message at ``time_ns`` (log and publish time, ns since the epoch).

        Raises
        ------
        InputError
            The time is before 1970, which MCAP cannot say.
        """
        writer = self._open_writer
        known = self._channels.get(topic)
        if known is None:
            known = (self._register(topic, type(message)), type(message))
            self._channels[topic] = known
        channel, message_class = known
        if type(message) is not message_class:
            raise TypeError(f"topic {topic} holds {message_class.__name__}")
        if not 0 <= time_ns < 1 << 64:
            raise InputError(
                f"time {time_ns} ns of {topic} is not in the range of MCAP",
                hint="Give times as nanoseconds since 1970",
            )
        sequence = self._sequence.get(channel, 0)
        self._sequence[channel] = (sequence + 1) & 0xFFFFFFFF
        writer.add_message(channel, time_ns, message.SerializeToString(), time_ns, sequence)

    def _register(self, topic: str, message_class: type[Message]) -> int:
        name = message_class.DESCRIPTOR.full_name
        if name not in self._schemas:
            files = build_file_descriptor_set(message_class)
            self._schemas[name] = self._open_writer.register_schema(
                name, "protobuf", files.SerializeToString()
            )
        return self._open_writer.register_channel(topic, "protobuf", self._schemas[name])

    def attach(self, name: str, data: bytes, media_type: str, time_ns: int = 0) -> None:
        """Attach a file of a media type; artifacts with :meth:`attach_toml`."""
        self._open_writer.add_attachment(time_ns, time_ns, name, media_type, data)

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._open_writer.add_metadata(name, dict(record))

    def attach_toml(self, name: str, text: str) -> None:
        """Attach an artifact as ``name``, as in ``attach_toml("scene.toml", text)``."""
        self.attach(name, text.encode(), "application/toml")

    def facts(self, facts: Mapping[str, object] | None) -> None:
        """Write what is known of a recording as texts to the metadata record ``facts``."""
        if facts:
            self.metadata("facts", {key: str(value) for key, value in facts.items()})
