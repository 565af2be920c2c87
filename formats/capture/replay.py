"""Port that replays the raw bytes of a session, in the pieces in which they were read.

``replay:FILE.mcap``, or ``replay:FILE.mcap#/serial/NAME`` if a session has several ports. The
intact part of a damaged session is replayed; at its end the link is lost, not ended, so that
the result is not mistaken for a complete recording.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Generator
from typing import Any

from locatk.core.errors import InputError, LocatkError
from locatk.formats.capture.links import LinkEnded, LinkLost, Overruns, SourceError
from locatk.formats.emulation.sources import replayed_source
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.reader import Session

SCHEMA = SerialChunk.DESCRIPTOR.full_name

PREFIX = "replay:"


class ReplayPort:
    """Raw bytes of a session.

    Parameters
    ----------
    name : str
        ``replay:FILE.mcap``, also with a topic as above, also ``replay://``.
    speed : float
        Factor on the speed of the recording; 0 is as fast as possible.
    keeps_time : bool
        Its bytes have the times at which they were recorded, instead of those of the replay. A
        session without raw bytes is encoded as a device would send it.

    Raises
    ------
    SourceError
        ``speed`` is negative or not a number.
    """

    can_reconnect = False

    def __init__(self, name: str, *, speed: float = 1.0, keeps_time: bool = False) -> None:
        if not (math.isfinite(speed) and speed >= 0):
            raise SourceError(
                f"{speed} is not a valid speed", hint="Give 1, 10, or 0 for the fastest"
            )
        self.name = name
        self._speed, self.keeps_time = speed, keeps_time
        source = name[len(PREFIX) :].removeprefix("//")
        self._file, self._topic = source, ""
        if "#" in source and not os.path.exists(source):
            self._file, _, self._topic = source.rpartition("#")
        self._damage: str | None = None

    def open(self) -> ReplayLink:
        """Open the session at its beginning; see :class:`.links.Port`."""
        if not self._file:
            raise SourceError("no file name", file=self.name, hint="Example: replay:run.mcap")
        try:
            session = Session.open(self._file, damaged_ok=True)
        except LocatkError as error:
            raise SourceError(
                error.message, file=error.file, where=error.where, hint=error.hint
            ) from None
        self._topic = self._choose_topic(session)
        self._damage = session.damage
        chunks = _chunks(session, self._topic) if self._topic else _encoded(session)
        return ReplayLink(chunks, self._speed, keeps_time=self.keeps_time)

    def describe(self) -> dict[str, str]:
        """Return ``port``, ``resolved`` (the file), ``speed``; once it was open, ``topic``, and
        ``damage`` of a damaged file.
        """
        facts = {
            "port": self.name,
            "resolved": os.path.realpath(self._file),
            "speed": f"{self._speed:g}",
            "topic": self._topic,
            "damage": self._damage,
        }
        return {key: value for key, value in facts.items() if value}

    def _choose_topic(self, session: Session) -> str:
        topics = session.topics("", SCHEMA)
        if self._topic in topics:
            return self._topic
        if not topics and self.keeps_time and not self._topic:
            return ""
        if len(topics) == 1 and not self._topic:
            return topics[0]
        if topics:
            each = " or ".join(f"{PREFIX}{self._file}#{topic}" for topic in topics)
            problem = f"no port {self._topic}" if self._topic else f"{len(topics)} ports"
            raise SourceError(problem, file=self._file, hint=f"Give {each}")
        contents = ", ".join(channel.topic for channel in session.channels) or "nothing"
        raise SourceError(
            "no raw bytes",
            file=self._file,
            hint=f"It contains {contents}: `locatk emulate {self._file}` sends that",
        )


class ReplayLink:
    """Chunks of a recording, one per read, each when it is due.

    Parameters
    ----------
    chunks : generator
        Yields (time in ns, result of a read).
    speed : float
    keeps_time : bool
        See :class:`ReplayPort`.

    Attributes
    ----------
    time_ns : int or None
        When the bytes of the last read were recorded; None unless ``keeps_time``.
    """

    def __init__(
        self,
        chunks: Generator[tuple[int, Any], None, None],
        speed: float,
        *,
        keeps_time: bool = False,
    ) -> None:
        self.time_ns: int | None = None
        self._keeps_time = keeps_time
        self._chunks = chunks
        self._speed = speed
        self._next: tuple[int, Any] | None = None
        self._start: tuple[float, int] | None = None
        self._end: LinkEnded | LinkLost | None = None

    def read(self, wait_s: float) -> Any:
        """Return the next chunk when it is due; see :class:`.links.Link`."""
        time_ns, data = self._next_chunk()
        if self._speed:
            now = time.monotonic()
            if self._start is None:
                self._start = (now, time_ns)
            start_s, first_ns = self._start
            remaining = start_s + (time_ns - first_ns) / 1e9 / self._speed - now
            if remaining > 0:
                time.sleep(max(0.0, min(remaining, wait_s)))
            if remaining > wait_s:
                return b""
        self._next = None
        if self._keeps_time:
            self.time_ns = time_ns
        return data

    def _next_chunk(self) -> tuple[int, Any]:
        if self._end is not None:
            raise self._end
        if self._next is None:
            try:
                self._next = next(self._chunks, None)
            except LinkLost as lost:
                self._end = lost
                raise
        if self._next is None:
            self._end = LinkEnded("the end of the recording")
            raise self._end
        return self._next

    def overruns(self) -> Overruns | None:
        """Return None: the losses of the recording are in the session that is replayed."""
        return None

    def close(self) -> None:
        """End the replay."""
        self._end = self._end or LinkEnded("closed")
        self._chunks.close()


def _chunks(session: Session, topic: str) -> Generator[tuple[int, bytes], None, None]:
    """Yield (log time in ns, bytes) of each chunk, with one of them in memory.

    Raises
    ------
    LinkLost
        After the last intact chunk of a damaged session.
    """
    try:
        for time_ns, chunk in session.decoded(topic, SerialChunk):
            if chunk.data:
                yield time_ns, chunk.data
    except InputError as error:
        raise LinkLost(f"{error}; `locatk recover` saves the rest") from error
    if session.damage is not None:
        raise LinkLost(f"{session.path}: {session.damage}")


def _encoded(session: Session) -> Generator[tuple[int, bytes], None, None]:
    """Yield the bytes of observations as a device would send them."""
    try:
        yield from replayed_source(session).packets()
    except InputError as error:
        raise LinkLost(str(error)) from error
