"""When which bytes are due: the pace of the recording, or a constant rate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import count
from typing import Protocol

LARGEST = 1 << 18
"""Bytes after which a piece is given, though more are due."""

ONE_PIECE_NS = 10_000_000
"""How long a stream lasts that holds one moment only, when it is repeated."""

Packets = Iterable[tuple[int, bytes]]
"""(time in ns, bytes), in the order in which they are sent."""


class Pace(Protocol):
    """A stream of bytes of which each has its time, in seconds since the start.

    Attributes
    ----------
    next_s : float or None
        When the next bytes are due; None at the end.
    """

    next_s: float | None

    def due(self, until_s: float) -> bytes:
        """Bytes that are due by then and were not given yet; of very many only the first."""


def repeated(packets: Callable[[], Packets], times: int = 1) -> Iterator[tuple[int, bytes]]:
    """The same packets ``times`` times in a row (0 for ever), their times running on from 0.

    From the end of one turn to the start of the next it is as long as between two packets
    on average. Times that fall back are taken as those before them.
    """
    start = 0
    for turn in count():
        if times and turn == times:
            return
        first: int | None = None
        last, number = start, 0
        for time_ns, data in packets():
            if not data:
                continue
            if first is None:
                first = time_ns
            last = max(last, start + time_ns - first)
            number += 1
            yield last, data
        if first is None:
            return
        step = (last - start) // (number - 1) if number > 1 else 0
        start = last + (step or ONE_PIECE_NS)


class Recorded:
    """The pace of the recording.

    Parameters
    ----------
    packets : iterable of (int, bytes)
        Times in ns that never descend, from 0.
    speed : float
        How many times as fast; infinite for all at once.
    """

    def __init__(self, packets: Packets, speed: float = 1.0) -> None:
        self._packets = iter(packets)
        self._scale = 1e-9 / speed
        self._data = b""
        self.next_s: float | None = None
        self._step()

    def _step(self) -> None:
        time_ns, self._data = next(self._packets, (None, b""))
        self.next_s = None if time_ns is None else time_ns * self._scale

    def due(self, until_s: float) -> bytes:
        """As :class:`Pace` says."""
        pieces, size = [], 0
        while self.next_s is not None and self.next_s <= until_s and size < LARGEST:
            pieces.append(self._data)
            size += len(self._data)
            self._step()
        return b"".join(pieces)


class Constant:
    """A constant rate, whatever the times of the packets.

    Parameters
    ----------
    packets : iterable of (int, bytes)
    rate : float
        Bytes a second.
    """

    def __init__(self, packets: Packets, rate: float) -> None:
        self._packets = iter(packets)
        self._rate = rate
        self._given = 0
        self._ahead = bytearray()
        self.next_s: float | None = None
        self._fill(1)

    def _fill(self, size: int) -> None:
        while len(self._ahead) < size:
            _, data = next(self._packets, (0, b""))
            if not data:
                break
            self._ahead += data
        self.next_s = (self._given + 1) / self._rate if self._ahead else None

    def due(self, until_s: float) -> bytes:
        """As :class:`Pace` says."""
        # The smallest part of a byte, as next_s times the rate may miss a whole one by it.
        size = min(int(until_s * self._rate + 1e-6) - self._given, LARGEST)
        if size <= 0:
            return b""
        self._fill(size)
        data = bytes(self._ahead[:size])
        del self._ahead[:size]
        self._given += len(data)
        self._fill(1)
        return data
