"""Single messages of a session: where they are, and one of them without all the others.

Camera frames are too many to be held at once. The index of a chunk tells where its messages
are without unpacking it; a chunk without one is unpacked once, to look.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import IO, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from locatk.core.errors import FormatError
from locatk.formats.sessions import mcap_records
from locatk.formats.sessions.mcap_records import DamageError, Segment
from locatk.formats.sessions.reader import Session, reading

_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time and publish time of a message."""

_FRAME_SIZE = 9


class Place(NamedTuple):
    """Where a message is: in which segment, and at which byte of it when unpacked."""

    channel: int
    time_ns: int
    segment: Segment
    offset: int


class Places:
    """Messages of a session one by one, in any order; holds one unpacked chunk.

    Parameters
    ----------
    session : Session
        Its file must not change meanwhile.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._segment: Segment | None = None
        self._data: bytes | memoryview = b""

    def of(self, topic: str) -> list[Place]:
        """Where the messages of a topic are, in the order of the file.

        Raises
        ------
        FormatError
            The index is damaged, or does not name as many messages as it counts.
        """
        index = self._session.index
        wanted = {entry.id for entry in index.channels.values() if entry.topic == topic}
        found: list[Place] = []
        with reading(self._session.path) as stream:
            for segment in index.segments:
                if segment.channels is None or not segment.channels.isdisjoint(wanted):
                    found += _find(stream, segment, wanted)
            expected = sum(index.counts[channel] for channel in wanted)
            if len(found) != expected:
                raise DamageError(f"{len(found)} messages where the index says {expected}")
        return found

    def payload(self, place: Place) -> bytes:
        """Payload of one message; quick where the last one was in the same chunk.

        Raises
        ------
        FormatError
            The chunk is damaged, or something else is at this place.
        """
        if self._segment is not place.segment:
            with reading(self._session.path) as stream:
                self._data = mcap_records.unpacked(stream, place.segment)
                self._segment = place.segment
        found = _message(self._data, place)
        if found is None:
            raise FormatError(
                "no message where the index says",
                file=self._session.path,
                where=f"byte {place.segment.offset}",
            )
        return found


def _find(stream: IO[bytes], segment: Segment, wanted: Collection[int]) -> list[Place]:
    """Places of the messages of the channels ``wanted`` in one segment."""
    if segment.indexes:
        found = [
            Place(channel, time_ns, segment, offset)
            for channel, at in segment.indexes
            if channel in wanted
            for time_ns, offset in _entries(stream, at, channel)
        ]
        return sorted(found, key=lambda place: place.offset)
    data = mcap_records.unpacked(stream, segment)
    return [place for place in _scan(segment, data) if place.channel in wanted]


def _message(data: bytes | memoryview, place: Place) -> bytes | None:
    """Payload of the message at ``place`` in the unpacked segment, None where it is not there."""
    if place.offset + _HEAD.size > len(data):
        return None
    opcode, length, channel, _, time_ns, _ = _HEAD.unpack_from(data, place.offset)
    start, end = place.offset + _HEAD.size, place.offset + _FRAME_SIZE + length
    if (
        opcode != Opcode.MESSAGE
        or (channel, time_ns) != (place.channel, place.time_ns)
        or not start <= end <= len(data)
    ):
        return None
    return bytes(data[start:end])


def _entries(stream: IO[bytes], offset: int, channel: int) -> list[list[int]]:
    """(time in ns, offset) of each message that an index of messages names."""
    content = mcap_records.record_at(stream, offset, Opcode.MESSAGE_INDEX)
    if len(content) < 6 or (len(content) - 6) % 16:
        raise DamageError("an index of messages is damaged", offset)
    found, length = struct.unpack_from("<HI", content)
    if found != channel or length != len(content) - 6:
        raise DamageError("an index of messages is damaged", offset)
    entries: list[list[int]] = np.frombuffer(content, "<u8", offset=6).reshape(-1, 2).tolist()
    return entries


def _scan(segment: Segment, data: bytes | memoryview) -> Iterator[Place]:
    for opcode, offset, content in mcap_records.frames(data, 0):
        if opcode == Opcode.MESSAGE:
            if len(content) < _HEAD.size - _FRAME_SIZE:
                raise DamageError("a message is damaged", segment.offset)
            _, _, channel, _, time_ns, _ = _HEAD.unpack_from(data, offset)
            yield Place(channel, time_ns, segment, offset)
