"""What a recording says of itself, without reading its samples."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection
from dataclasses import fields
from typing import Any

from locatk.formats.capture.statistics import RECORD, CaptureStatistics
from locatk.formats.sessions.mcap_records import Segment
from locatk.formats.sessions.reader import Session

MOST_READ = 16 << 20
"""Bytes of a file that are read to describe what is in them."""

MOST_CHUNKS = 1000
"""Chunks whose indexes are read to find the messages of a topic."""

_NUMBERS = {"started_ns", "ended_ns", "part", "parts", "baud", "unplugged"} | {
    each.name for each in fields(CaptureStatistics)
}
_PREFIXES = ("samples:", "tick_")
_LARGEST = 1 << 64
"""Of the entries of the record ``capture``: which are numbers, and how large they may be."""


def held_bytes(session: Session, topics: Collection[str]) -> int:
    """Bytes of the chunks that hold messages of ``topics``, by the index."""
    return sum(segment.length for segment in _segments(session, topics))


def is_small(session: Session, topics: Collection[str]) -> bool:
    """Whether ``topics`` can be read at once to be described."""
    return held_bytes(session, topics) <= MOST_READ


def is_few(session: Session, topics: Collection[str]) -> bool:
    """Whether the indexes of the chunks of ``topics`` can be read at once."""
    return len(_segments(session, topics)) <= MOST_CHUNKS


def _segments(session: Session, topics: Collection[str]) -> list[Segment]:
    wanted = {each.id for each in session.index.channels.values() if each.topic in topics}
    return [
        segment
        for segment in session.index.segments
        if segment.channels is None or not segment.channels.isdisjoint(wanted)
    ]


def capture(session: Session) -> dict[str, Any] | None:
    """The record ``capture`` of a live recording, its numbers as numbers; None without one."""
    record = session.index.metadata.get(RECORD)
    return None if record is None else {key: _value(key, text) for key, text in record.items()}


def messages(session: Session, topic: str) -> int:
    """How many messages a topic has, by the index."""
    return sum(channel.count for channel in session.channels if channel.topic == topic)


def samples(session: Session, topic: str) -> int | None:
    """How many samples the messages of a topic hold, as a live recording counted them."""
    count = (capture(session) or {}).get(f"samples:{topic}")
    return count if isinstance(count, int) else None


def _value(key: str, text: str) -> int | float | str:
    """A number where ``text`` should be one and is; serial numbers and the like are texts."""
    if key not in _NUMBERS and not key.startswith(_PREFIXES):
        return text
    with contextlib.suppress(ValueError):
        number = float(text)
        if math.isfinite(number) and abs(number) < _LARGEST:
            return int(text) if text.lstrip("-").isdecimal() else number
    return text


def duration_s(session: Session) -> float | None:
    """Time between the first and the last message; None without messages."""
    if session.start_ns is None or session.end_ns is None:
        return None
    return (session.end_ns - session.start_ns) / 1e9


def rate_hz(session: Session, count: int | None) -> float | None:
    """Rate of so many messages or samples, evenly over the session; None where unknown."""
    duration = duration_s(session)
    # n of them span n - 1 intervals
    return (count - 1) / duration if count and count > 1 and duration else None
