"""Facts about a recording that are known without reading its samples."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection
from dataclasses import fields
from typing import Any

from locatk.core.errors import LocatkError
from locatk.formats.sessions.capture_statistics import CaptureStatistics
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD, DamageError, Segment
from locatk.formats.sessions.reader import Session

MAX_DESCRIBED_BYTES = 16 << 20
"""Number of bytes of a file that are read in order to describe its contents."""

MAX_DESCRIBED_CHUNKS = 1000
"""Number of chunks whose indexes are read in order to find the messages of a topic."""

_NUMBERS = {"started_ns", "ended_ns", "part", "parts", "baud", "unplugged"} | {
    each.name for each in fields(CaptureStatistics)
}
_NUMBER_PREFIXES = ("samples:", "tick_")
"""Entries of the record ``capture`` that are numbers."""

MAX_NUMBER = 1 << 64
"""Entries from this size on are kept as texts."""


def held_bytes(session: Session, topics: Collection[str]) -> int:
    """Return the number of bytes of the chunks with messages of ``topics``, by the index."""
    return sum(segment.length for segment in _segments(session, topics))


def is_small(session: Session, topics: Collection[str]) -> bool:
    """Return whether ``topics`` are small enough to be read in order to describe them."""
    return held_bytes(session, topics) <= MAX_DESCRIBED_BYTES


def is_few(session: Session, topics: Collection[str]) -> bool:
    """Return whether ``topics`` are in few enough chunks that their indexes can be read."""
    return len(_segments(session, topics)) <= MAX_DESCRIBED_CHUNKS


def _segments(session: Session, topics: Collection[str]) -> list[Segment]:
    return session.index.segments_with(session.channel_ids(topics))


def capture(session: Session) -> dict[str, Any] | None:
    """Return the record ``capture`` of a live recording with numbers parsed; None without one."""
    record = session.index.metadata.get(CAPTURE_RECORD)
    return None if record is None else {key: _value(key, text) for key, text in record.items()}


def messages(session: Session, topic: str) -> int:
    """Return the number of messages of a topic, by the index."""
    return sum(channel.count for channel in session.channels if channel.topic == topic)


def samples(session: Session, topic: str) -> int | None:
    """Return the number of samples of a topic that a live recording counted; None if unknown."""
    count = (capture(session) or {}).get(f"samples:{topic}")
    return count if isinstance(count, int) else None


def _value(key: str, text: str) -> int | float | str:
    """Parse an entry that should be a number; serial numbers and the like stay texts."""
    if key not in _NUMBERS and not key.startswith(_NUMBER_PREFIXES):
        return text
    with contextlib.suppress(ValueError):
        number = float(text)
        if math.isfinite(number) and abs(number) < MAX_NUMBER:
            return int(text) if text.lstrip("-").isdecimal() else number
    return text


def duration_s(session: Session) -> float | None:
    """Return the time between the first and the last message; None without messages."""
    if session.start_ns is None or session.end_ns is None:
        return None
    return (session.end_ns - session.start_ns) / 1e9


def rate_hz(session: Session, count: int | None) -> float | None:
    """Return the mean rate of ``count`` messages or samples of the session; None if unknown."""
    duration = duration_s(session)
    # n samples span n - 1 intervals.
    return (count - 1) / duration if count and count > 1 and duration else None


def describe_damage(session: Session, error: LocatkError) -> dict[str, Any]:
    """Describe the damage of a session that could not be read completely.

    It is recoverable if the MCAP file is damaged, of which `locatk recover` saves the rest.
    """
    is_file_damaged = session.damage is not None or isinstance(error.__context__, DamageError)
    return {"damage": session.damage or error.message, "recoverable": is_file_damaged}
