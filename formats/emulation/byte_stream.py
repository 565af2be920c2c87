"""Byte stream of an emulated device: due times of its bytes, and faults of the serial line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import count
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

MAX_PIECE_BYTES = 1 << 18
"""Limit of the bytes returned at a time."""

SINGLE_TIME_DURATION_NS = 10_000_000
"""Duration of a repeated stream whose packets all have the same time."""

Packets = Iterable[tuple[int, bytes]]
"""(time in ns, bytes), in the order of sending."""


class Pace(Protocol):
    """Byte stream with a due time of each byte, in seconds since the start.

    Attributes
    ----------
    next_s : float or None
        Due time of the next bytes; None at the end.
    """

    next_s: float | None

    def due(self, until_s: float) -> bytes:
        """Return the bytes that are newly due by then, up to MAX_PIECE_BYTES."""


def repeat_packets(packets: Callable[[], Packets], times: int = 1) -> Iterator[tuple[int, bytes]]:
    """Yield the packets ``times`` times (0: endlessly), with times that increase from 0.

    The interval between the end of one repetition and the start of the next is the mean interval
    between packets. Times that decrease are replaced by the previous ones.
    """
    start = 0
    for repetition in count():
        if times and repetition == times:
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
        start = last + (step or SINGLE_TIME_DURATION_NS)


class RecordedPace:
    """Pace of the recording.

    Parameters
    ----------
    packets : iterable of (int, bytes)
        Times in ns that never decrease, from 0.
    speed : float
        Factor on the speed of the recording; infinite for all bytes at once.
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
        """Return the bytes that are due; see :meth:`Pace.due`."""
        pieces, size = [], 0
        while self.next_s is not None and self.next_s <= until_s and size < MAX_PIECE_BYTES:
            pieces.append(self._data)
            size += len(self._data)
            self._step()
        return b"".join(pieces)


class ConstantRate:
    """Constant rate, whatever the times of the packets.

    Parameters
    ----------
    packets : iterable of (int, bytes)
    rate : float
        Bytes per second.
    """

    def __init__(self, packets: Packets, rate: float) -> None:
        self._packets = iter(packets)
        self._rate = rate
        self._returned = 0
        self._upcoming = bytearray()
        self.next_s: float | None = None
        self._fill(1)

    def _fill(self, size: int) -> None:
        while len(self._upcoming) < size:
            _, data = next(self._packets, (0, b""))
            if not data:
                break
            self._upcoming += data
        self.next_s = (self._returned + 1) / self._rate if self._upcoming else None

    def due(self, until_s: float) -> bytes:
        """Return the bytes that are due; see :meth:`Pace.due`."""
        # The smallest part of a byte, as next_s times the rate may miss a whole one by it.
        size = min(int(until_s * self._rate + 1e-6) - self._returned, MAX_PIECE_BYTES)
        if size <= 0:
            return b""
        self._fill(size)
        data = bytes(self._upcoming[:size])
        del self._upcoming[:size]
        self._returned += len(data)
        self._fill(1)
        return data


DRAWN_GAPS = 1024
"""Random numbers drawn at a time."""


class RandomEvents:
    """Failures among independent trials of equal probability.

    The gaps between failures are drawn, which have a geometric distribution: the effort is
    proportional to the failures, and the result does not depend on how the trials are cut into
    pieces.
    """

    def __init__(self, probability: float, random: np.random.Generator) -> None:
        self._probability = probability
        self._random = random
        self._done = 0
        self._upcoming = np.zeros(0, np.int64)

    def failures(self, count: int) -> NDArray[np.int64]:
        """Return the indices of the failures among the next ``count`` trials, ascending from 0."""
        start, self._done = self._done, self._done + count
        if self._probability == 0:
            return np.zeros(0, np.int64)
        blocks = [self._upcoming]
        last = int(self._upcoming[-1]) if len(self._upcoming) else start - 1
        while last < self._done:
            # A tiny probability gives huge gaps; their sums must stay within 64 bits.
            gaps = np.minimum(self._random.geometric(self._probability, DRAWN_GAPS), 1 << 48)
            blocks.append(last + np.cumsum(gaps))
            last = int(blocks[-1][-1])
        ahead = np.concatenate(blocks)
        now = int(np.searchsorted(ahead, self._done))
        self._upcoming = ahead[now:]
        return ahead[:now] - start


class LineFaults:
    """Serial line that loses bytes, and flips bits of the others.

    The same seed affects the same bytes of a stream, however it is cut into pieces.

    Parameters
    ----------
    drop, flip : float
        Probability of the loss of a byte, and of the flip of a bit.
    seed : int

    Attributes
    ----------
    dropped, flipped : int
        Bytes and bits so far.

    Raises
    ------
    InputError
        A probability is not in the range of 0 to 1.
    """

    def __init__(self, drop: float = 0.0, flip: float = 0.0, seed: int = 0) -> None:
        for name, value in (("drop", drop), ("flip", flip)):
            if not 0 <= value <= 1:
                raise InputError(
                    f"--{name} {value} is not a probability", hint="Give a value from 0 to 1"
                )
        for_drops, for_flips = np.random.default_rng(seed).spawn(2)
        self._drops = RandomEvents(drop, for_drops)
        self._flips = RandomEvents(flip, for_flips)
        self.dropped = 0
        self.flipped = 0

    def apply(self, data: bytes) -> bytes:
        """Return the next bytes as they arrive."""
        lost = self._drops.failures(len(data))
        bit_count = 8 * (len(data) - len(lost))
        flipped = self._flips.failures(bit_count)
        if not len(lost) and not len(flipped):
            return data
        remaining = np.delete(np.frombuffer(data, np.uint8), lost)
        np.bitwise_xor.at(remaining, flipped // 8, (1 << (flipped % 8)).astype(np.uint8))
        self.dropped += len(lost)
        self.flipped += len(flipped)
        return remaining.tobytes()
