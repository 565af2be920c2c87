"""When which bytes are due: the pace of the recording, or a constant rate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import count
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

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


BLOCK = 1024
"""Faults that are drawn at once."""


class Strikes:
    """Which of many trials in a row fail, each with the same probability on its own.

    Drawn are the gaps between failures, which are geometric: the effort goes with the
    failures, not with the trials, and where the trials are cut into pieces does not matter.
    """

    def __init__(self, probability: float, random: np.random.Generator) -> None:
        self._probability = probability
        self._random = random
        self._done = 0
        self._ahead = np.zeros(0, np.int64)

    def among(self, count: int) -> NDArray[np.int64]:
        """Places of the failures among the next ``count`` trials, ascending from 0."""
        start, self._done = self._done, self._done + count
        if self._probability == 0:
            return np.zeros(0, np.int64)
        blocks = [self._ahead]
        last = int(self._ahead[-1]) if len(self._ahead) else start - 1
        while last < self._done:
            # A gap is cut where it has no end: sums of them must stay within 64 bits.
            gaps = np.minimum(self._random.geometric(self._probability, BLOCK), 1 << 48)
            blocks.append(last + np.cumsum(gaps))
            last = int(blocks[-1][-1])
        ahead = np.concatenate(blocks)
        now = int(np.searchsorted(ahead, self._done))
        self._ahead = ahead[now:]
        return ahead[:now] - start


class Faults:
    """A line that loses bytes, and turns bits over in those that are left.

    The same seed strikes the same bytes of a stream, however it is cut into pieces.

    Parameters
    ----------
    drop, flip : float
        Probability of each byte to be lost, and of each bit to turn over.
    seed : int

    Attributes
    ----------
    dropped, flipped : int
        Bytes and bits so far.

    Raises
    ------
    InputError
        A probability is not in 0 to 1.
    """

    def __init__(self, drop: float = 0.0, flip: float = 0.0, seed: int = 0) -> None:
        for name, value in (("drop", drop), ("flip", flip)):
            if not 0 <= value <= 1:
                raise InputError(f"a probability to {name} of {value}", hint="Give 0 to 1")
        for_drops, for_flips = np.random.default_rng(seed).spawn(2)
        self._drops = Strikes(drop, for_drops)
        self._flips = Strikes(flip, for_flips)
        self.dropped = 0
        self.flipped = 0

    def spoil(self, data: bytes) -> bytes:
        """What arrives of the next bytes."""
        lost = self._drops.among(len(data))
        turned_count = 8 * (len(data) - len(lost))
        turned = self._flips.among(turned_count)
        if not len(lost) and not len(turned):
            return data
        left = np.delete(np.frombuffer(data, np.uint8), lost)
        np.bitwise_xor.at(left, turned // 8, (1 << (turned % 8)).astype(np.uint8))
        self.dropped += len(lost)
        self.flipped += len(turned)
        return left.tobytes()
