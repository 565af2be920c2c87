"""Writer of sessions: complete files, which appear at the end, and live recordings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import IO, Any

import numpy as np
from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from locatk.core.errors import InputError
from locatk.formats.output import atomic_write, tool_version
from locatk.formats.sessions.mcap_file import CHANNELS_RECORD, SESSION_RECORD
from locatk.formats.sessions.mcap_writer import McapWriter
from locatk.formats.sessions.messages import MessageBatch

PROFILE = "locatk"
FORMAT_VERSION = "1"


class SessionWriter:
    """Writer of a session; a context manager. The file appears when the block ends normally.

    Messages should be written in the order of their times: readers then need little memory.
    Equal calls give equal bytes. A live recording is written to an open stream instead, and is
    finished even if the block ends with an exception.

    Parameters
    ----------
    path : path
        The output; see :func:`locatk.formats.output.atomic_write`.
    kind : str
        ``"session"`` or ``"solution"``.
    system : str
        ``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``.
    facts : mapping of str to str, optional
        Additional entries of the metadata record ``locatk``.
    overwrite : bool
        Replace an existing file.
    live : stream, optional
        Write to this open binary file instead of to ``path``, and do not close it. The channels
        are also listed in the metadata record :data:`CHANNELS_RECORD`.

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
        live: IO[Any] | None = None,
    ) -> None:
        self._live = live is not None
        self._output: AbstractContextManager[IO[Any]] = (
            atomic_write(path, overwrite=overwrite) if live is None else nullcontext(live)
        )
        self._record = {
            "format_version": FORMAT_VERSION,
            "tool_version": tool_version(),
            "kind": kind,
            "system": system,
            **(facts or {}),
        }
        self._writer: McapWriter | None = None
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, type[Message]]] = {}

    def __enter__(self) -> SessionWriter:
        stream = self._output.__enter__()
        library = f"locatk {tool_version()}"
        self._writer = McapWriter(stream, profile=PROFILE, library=library)
        self.metadata(SESSION_RECORD, self._record)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None or self._live:
            try:
                self._open_writer.finish()
            except BaseException as failure:
                # The incomplete output must be removed, as after a failure inside the block.
                self._output.__exit__(type(failure), failure, failure.__traceback__)
                raise
        self._output.__exit__(kind, error, trace)

    @property
    def _open_writer(self) -> McapWriter:
        if self._writer is None:
            raise RuntimeError("SessionWriter is used outside its `with` block")
        return self._writer

    def declare(self, topic: str, message_class: type[Message]) -> int:
        """Register a topic before its first message; return the id of its channel.

        In a live recording, flush after the first messages of new topics.
        """
        if topic not in self._channels:
            self._channels[topic] = (self._register(topic, message_class), message_class)
        channel, registered_class = self._channels[topic]
        if message_class is not registered_class:
            raise TypeError(f"topic {topic} holds {registered_class.__name__}")
        return channel

    def flush(self) -> None:
        """Write the buffered messages as a chunk, so that readers of the file find them."""
        self._open_writer.flush()

    def write(
        self, topic: str, message: Message, time_ns: int, publish_ns: int | None = None
    ) -> None:
        """Write one message.

        Parameters
        ----------
        topic : str
        message : Message
        time_ns : int
            Log time in ns since the epoch.
        publish_ns : int, optional
            Time of the first sample, if it is known better.

        Raises
        ------
        InputError
            The time is before 1970, which MCAP cannot represent.
        """
        channel = self.declare(topic, type(message))
        _check_time(topic, time_ns)
        published = time_ns if publish_ns is None else publish_ns
        self._open_writer.add_message(channel, time_ns, message.SerializeToString(), published)

    def write_batches(self, batches: Sequence[MessageBatch]) -> None:
        """Write the messages of several batches in the order of their times.

        Messages of equal time are in the order of their batches.

        Raises
        ------
        InputError
            As :meth:`write`.
        """
        for batch in batches:
            _check_time(batch.topic, int(batch.time_ns.min()))
        channels = [self.declare(batch.topic, batch.message) for batch in batches]
        time_ns = np.concatenate([batch.time_ns for batch in batches])
        payloads = [payload for batch in batches for payload in batch.payloads]
        order = np.argsort(time_ns, kind="stable")
        self._open_writer.add_messages(
            np.repeat(channels, [len(batch.payloads) for batch in batches])[order],
            time_ns[order],
            [payloads[k] for k in order.tolist()],
        )

    def _register(self, topic: str, message_class: type[Message]) -> int:
        name = message_class.DESCRIPTOR.full_name
        if name not in self._schemas:
            files = build_file_descriptor_set(message_class)
            self._schemas[name] = self._open_writer.register_schema(
                name, "protobuf", files.SerializeToString()
            )
        channel: int = self._open_writer.register_channel(topic, "protobuf", self._schemas[name])
        if self._live:
            self.metadata(CHANNELS_RECORD, {str(channel): f"{topic} {name}"})
        return channel

    def attach(self, name: str, data: bytes, media_type: str, time_ns: int = 0) -> None:
        """Attach a file of a media type; for artifacts see :meth:`attach_toml`."""
        self._open_writer.add_attachment(time_ns, name, media_type, data)

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._open_writer.add_metadata(name, record)

    def attach_toml(self, name: str, text: str) -> None:
        """Attach an artifact: ``attach_toml("scene.toml", text)``."""
        self.attach(name, text.encode(), "application/toml")

    def facts(self, facts: Mapping[str, object] | None) -> None:
        """Write facts about a recording, as texts, to the metadata record ``facts``."""
        if facts:
            self.metadata("facts", {key: str(value) for key, value in facts.items()})


def _check_time(topic: str, time_ns: int) -> None:
    """Raise InputError for a time that MCAP cannot represent."""
    if not 0 <= time_ns < 1 << 64:
        raise InputError(
            f"time {time_ns} ns of {topic} is not in the range of MCAP",
            hint="Give times as nanoseconds since 1970",
        )
