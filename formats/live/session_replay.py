"""Port that plays the decoded observations of a session without raw bytes: ``replay:FILE.mcap``.

Imported and simulated sessions are such. Their observations have the times of the session, and pass
by in pieces of :data:`PIECE_NS`, as if a device sent them.
"""

from __future__ import annotations

import heapq
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from google.protobuf.message import Message

from locatk.core.errors import InputError
from locatk.formats.capture.ingestion import SYSTEMS, TOPIC_PREFIXES, StampedMessage, TimedBatch
from locatk.formats.capture.links import LinkLost, SourceError
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.capture.replay import ReplayLink
from locatk.formats.devices.interface import Stream
from locatk.formats.sessions import messages
from locatk.formats.sessions.capture_statistics import CaptureStatistics
from locatk.formats.sessions.messages import BatchError, Layout
from locatk.formats.sessions.reader import Session

PIECE_NS = 10_000_000
"""Time span of the observations that arrive at once."""

LAYOUTS: Mapping[str, Callable[[int], Layout]] = {
    "lighthouse": lambda sensors: messages.SWEEPS,
    "magnetometers": messages.magnetometers,
    "halls": messages.halls,
    "odometry": lambda sensors: messages.ODOMETRY,
    "imu": lambda sensors: messages.IMU,
}
"""Layout of the messages of each kind of observations, by the number of sensors."""


@dataclass(frozen=True)
class PlayedRecords:
    """Records of one topic that arrive at once, as an item of a read.

    Attributes
    ----------
    batch : TimedBatch
    """

    batch: TimedBatch

    @property
    def size(self) -> int:
        """Bytes of its numbers."""
        return sum(column.nbytes for column in self.batch.columns.values())


class ObservationsPort:
    """Decoded observations of a session.

    Parameters
    ----------
    name : str
        As given by the user.
    session : Session
    speed : float
        Factor on the speed of the recording; 0 is as fast as possible.
    """

    can_reconnect = False
    keeps_time = True

    def __init__(self, name: str, session: Session, speed: float) -> None:
        self.name = name
        self._session, self._speed = session, speed

    @property
    def devices(self) -> tuple[str, ...]:
        """Names of the devices in the session."""
        topics = observation_topics(self._session).items()
        return tuple(
            dict.fromkeys(topic.removeprefix(TOPIC_PREFIXES[kind]) for topic, kind in topics)
        )

    def open(self) -> ReplayLink:
        """Start at the first observation; see :class:`.links.Port`."""
        topics = observation_topics(self._session)
        if not topics:
            raise SourceError(
                "no observations", file=self._session.path, hint="`locatk info` shows its contents"
            )
        return ReplayLink(_pieces(self._session, topics), self._speed, keeps_time=True)

    def describe(self) -> dict[str, str]:
        """Return ``port``, ``resolved`` (the file) and ``speed``."""
        resolved = os.path.realpath(self._session.path)
        return {"port": self.name, "resolved": resolved, "speed": f"{self._speed:g}"}


def observation_topics(session: Session) -> dict[str, str]:
    """Return the topics of observations with their kinds."""
    return {
        topic: kind
        for kind, layout in LAYOUTS.items()
        for topic in session.topics(TOPIC_PREFIXES[kind], layout(1).message.DESCRIPTOR.full_name)
    }


def _pieces(
    session: Session, topics: Mapping[str, str]
) -> Generator[tuple[int, list[PlayedRecords]], None, None]:
    """Yield the time of the last observation of each piece, and the piece.

    Raises
    ------
    LinkLost
        The session is damaged.
    """
    streams = [_topic_pieces(session, topic, kind) for topic, kind in topics.items()]
    merged = heapq.merge(*streams, key=lambda batch: int(batch.time_ns[-1]))
    try:
        for _, group in groupby(merged, key=lambda batch: int(batch.time_ns[-1]) // PIECE_NS):
            batches = list(group)
            yield int(batches[-1].time_ns[-1]), [PlayedRecords(batch) for batch in batches]
    except (InputError, BatchError) as error:
        raise LinkLost(f"{session.path}: {error}") from error


def _topic_pieces(session: Session, topic: str, kind: str) -> Iterator[TimedBatch]:
    """Yield the records of one topic in pieces, in the order of time."""
    device = topic.removeprefix(TOPIC_PREFIXES[kind])
    layout: Layout | None = None
    sensors = 0
    for _, _, payload in session.messages([topic]):
        if layout is None:
            if kind in ("magnetometers", "halls"):
                first: Any = LAYOUTS[kind](1).message.FromString(payload)
                sensors = int(first.sensors)
            layout = LAYOUTS[kind](sensors)
        columns = layout.unpack([payload]).columns
        time_ns = columns.pop("time_ns")
        slot = time_ns // PIECE_NS
        edges = [0, *(np.flatnonzero(np.diff(slot)) + 1).tolist(), len(time_ns)]
        for start, stop in pairwise(edges):
            if stop == start:
                continue
            yield TimedBatch(
                Stream(kind, sensors=sensors),
                device,
                topic,
                time_ns[start:stop],
                int(time_ns[stop - 1]),
                {name: column[start:stop] for name, column in columns.items()},
            )


class ObservationsIntake:
    """Decoder and intake of :class:`ObservationsPort`: the observations are decoded already.

    See :class:`.ingestion.SerialIntake` for its methods.
    """

    declared: Sequence[tuple[str, type[Message]]] = ()
    device = None

    def __init__(self) -> None:
        self.system = ""
        self._counts: dict[str, int] = {}
        self._bytes = 0

    def decode(self, arrived: Sequence[ReceivedData]) -> list[TimedBatch]:
        """Return the records of received data."""
        batches = [item.batch for each in arrived for item in each.data]
        self._bytes += sum(each.size for each in arrived)
        for batch in batches:
            count = self._counts.get(batch.topic, 0) + len(batch.time_ns)
            self._counts[batch.topic] = count
            self.system = self.system or SYSTEMS.get(batch.stream.kind, "")
        return batches

    def decode_identified(self, now_ns: int) -> list[TimedBatch]:
        """Return nothing: there is no device to identify."""
        return []

    def decode_restart(self) -> list[TimedBatch]:
        """Return nothing: a session is not opened again."""
        return []

    def decode_finish(self) -> list[TimedBatch]:
        """Return nothing: nothing is held back."""
        return []

    def chunks(self, arrived: Sequence[ReceivedData]) -> Iterator[StampedMessage]:
        """Return nothing: there are no raw bytes."""
        return iter(())

    def mark_opened(self) -> None:
        """Do nothing: there are no raw bytes."""

    def count(self, totals: CaptureStatistics) -> None:
        """Write the numbers of samples into ``totals``."""
        totals.bytes = self._bytes
        totals.samples = dict(self._counts)

    def remarks(self) -> list[str]:
        """Return nothing."""
        return []

    def clocks(self) -> dict[str, str]:
        """Return nothing: the times are those of the session."""
        return {}

    def rates(self) -> dict[str, float]:
        """Return nothing."""
        return {}

    def artifacts(self) -> dict[str, str]:
        """Return nothing: those of the session are attached."""
        return {}
