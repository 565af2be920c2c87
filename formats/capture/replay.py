"""Raw bytes of a session as a port: what came once comes again, in the same pieces.

``replay:FILE.mcap``, or ``replay:FILE.mcap#/serial/NAME`` where a session has several ports.
Of a damaged session all that is whole is played; where it breaks off, the link is lost
instead of ended, so that nobody takes the rest for all.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Generator

from locatk.core.errors import InputError, LocatkError
from locatk.formats.capture.links import LinkEnded, LinkLost, Overruns, SourceError
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.reader import Session

SCHEMA = SerialChunk.DESCRIPTOR.full_name

PREFIX = "replay:"


class ReplayPort:
    """The raw bytes of a session.

    Parameters
    ----------
    name : str
        ``replay:FILE.mcap``, also with a topic as above, also ``replay://``.
    speed : float
        Times that of the recording; 0 is as fast as possible.

    Raises
    ------
    SourceError
        ``speed`` is negative or no number.
    """

    can_reconnect = False

    def __init__(self, name: str, *, speed: float = 1.0) -> None:
        if not (math.isfinite(speed) and speed >= 0):
            raise SourceError(f"{speed} is no speed", hint="Give 1, 10, or 0 for the fastest")
        self.name = name
        self._speed = speed
        place = name[len(PREFIX) :].removeprefix("//")
        self._file, self._topic = place, ""
        if "#" in place and not os.path.exists(place):
            self._file, _, self._topic = place.rpartition("#")
        self._damage: str | None = None

    def open(self) -> ReplayLink:
        """From its beginning; see :class:`.source.Port`."""
        if not self._file:
            raise SourceError(f"{self.name} names no file", hint="As in replay:run.mcap")
        try:
            session = Session.open(self._file, damaged_ok=True)
        except LocatkError as error:
            raise SourceError(
                error.message, file=error.file, where=error.where, hint=error.hint
            ) from None
        self._topic = self._chosen(session)
        self._damage = session.damage
        return ReplayLink(session, self._topic, self._speed)

    def describe(self) -> dict[str, str]:
        """``port``, ``resolved`` (the file), ``speed``; once it was open, ``topic``, and
        ``damage`` of a damaged file."""
        known = {
            "port": self.name,
            "resolved": os.path.realpath(self._file),
            "speed": f"{self._speed:g}",
            "topic": self._topic,
            "damage": self._damage,
        }
        return {key: value for key, value in known.items() if value}

    def _chosen(self, session: Session) -> str:
        topics = session.topics("", SCHEMA)
        if self._topic in topics:
            return self._topic
        if len(topics) == 1 and not self._topic:
            return topics[0]
        if topics:
            each = " or ".join(f"{PREFIX}{self._file}#{topic}" for topic in topics)
            what = f"no port {self._topic}" if self._topic else f"{len(topics)} ports"
            raise SourceError(what, file=self._file, hint=f"Give {each}")
        held = ", ".join(channel.topic for channel in session.channels) or "nothing"
        raise SourceError(
            "no raw bytes",
            file=self._file,
            hint=f"It holds {held}: `locatk emulate {self._file}` sends that",
        )


class ReplayLink:
    """The chunks of one topic, one a read, each when it is due."""

    def __init__(self, session: Session, topic: str, speed: float) -> None:
        self._chunks = _chunks(session, topic)
        self._speed = speed
        self._next: tuple[int, bytes] | None = None
        self._start: tuple[float, int] | None = None
        self._end: LinkEnded | LinkLost | None = None

    def read(self, wait_s: float) -> bytes:
        """See :class:`.source.Link`."""
        time_ns, data = self._following()
        if self._speed:
            now = time.monotonic()
            if self._start is None:
                self._start = (now, time_ns)
            begun, first_ns = self._start
            left = begun + (time_ns - first_ns) / 1e9 / self._speed - now
            if left > 0:
                time.sleep(max(0.0, min(left, wait_s)))
            if left > wait_s:
                return b""
        self._next = None
        return data

    def _following(self) -> tuple[int, bytes]:
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
        """What was lost then is in the session that is played."""
        return None

    def close(self) -> None:
        """See :class:`.source.Link`."""
        self._end = self._end or LinkEnded("closed")
        self._chunks.close()


def _chunks(session: Session, topic: str) -> Generator[tuple[int, bytes], None, None]:
    """(log time in ns, bytes) of each chunk; one of them in memory.

    Raises
    ------
    LinkLost
        After the last whole one, where the session is damaged.
    """
    try:
        for time_ns, chunk in session.decoded(topic, SerialChunk):
            if chunk.data:
                yield time_ns, chunk.data
    except InputError as error:
        raise LinkLost(f"{error}; `locatk recover` saves what comes after it") from error
    if session.damage is not None:
        raise LinkLost(f"{session.damage} in {session.path}")
