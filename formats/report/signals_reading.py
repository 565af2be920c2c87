"""Raw signals of a recording for the eye: as much as is quickly read, whatever is whole."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from locatk.formats.sessions import capture_record as captured
from locatk.formats.sessions.mcap_file import DamageError, Segment, read_messages
from locatk.formats.sessions.reader import Session, open_mcap

MOST_READ = 8 << 20
"""Bytes of a recording that are read to be drawn; of a larger one, parts spread over it."""

MOST_DEVICES = 4
"""So many devices are drawn; the others are named."""


@dataclass(frozen=True)
class Excerpt:
    """Messages of some topics, and what a reader must know of them.

    Attributes
    ----------
    payloads : dict of str to list of bytes
        By topic, in the order of the file.
    notes : tuple of str
        That parts were left out, or are damaged.
    """

    payloads: dict[str, list[bytes]]
    notes: tuple[str, ...]


def excerpt(session: Session, topics: Collection[str], *, most: int | None = None) -> Excerpt:
    """Messages of ``topics`` from at most ``most`` bytes of the file (:data:`MOST_READ`).

    A part that is damaged is left out and told.
    """
    most = MOST_READ if most is None else most
    names = {
        entry.id: entry.topic for entry in session.index.channels.values() if entry.topic in topics
    }
    segments = [
        each
        for each in session.index.segments
        if each.channels is None or not each.channels.isdisjoint(names)
    ]
    chosen = _spread(segments, most)
    found: dict[str, list[bytes]] = {topic: [] for topic in sorted(topics)}
    damaged = 0
    with open_mcap(session.path) as stream:
        for segment in chosen:
            try:
                for channel, _, payload in read_messages(stream, segment, names):
                    found[names[channel]].append(payload)
            except DamageError:
                damaged += 1
    notes = []
    if len(chosen) < len(segments):
        held = captured.held_bytes(session, topics)
        notes.append(
            f"The recording is large ({held / 1e6:.0f} MB): drawn are {len(chosen)} parts spread "
            f"over it, of {len(segments)}."
        )
    if damaged:
        notes.append(
            f"{damaged} of {len(chosen)} parts of the recording are damaged and are missing here."
        )
    return Excerpt(found, tuple(notes))


def _spread(segments: list[Segment], most: int) -> list[Segment]:
    """As many as ``most`` bytes hold, one at least, evenly over the file."""
    total = sum(segment.length for segment in segments)
    if total <= most:
        return segments
    count = max(1, len(segments) * most // total)
    at = np.linspace(0, len(segments) - 1, count).round().astype(int)
    return [segments[k] for k in np.unique(at)]
