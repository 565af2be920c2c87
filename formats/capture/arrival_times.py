"""When which byte arrived: the stamps of reads, looked up by the place in the stream."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

KEPT = 1 << 16
"""So many reads are remembered at least: decoders that look for the start of a frame hold
records back."""


class Arrivals:
    """Places in a stream of bytes, and when each was read.

    Parameters
    ----------
    byte_ns : float
        How long one byte takes on the wire. Frames that came in one read are told apart by
        the bytes between their ends.
    """

    def __init__(self, byte_ns: float = 0.0) -> None:
        self.byte_ns = byte_ns
        self._end = np.zeros(2 * KEPT, np.int64)
        self._time = np.zeros(2 * KEPT, np.int64)
        self._count = 0

    def add(self, end: int, time_ns: int) -> None:
        """The bytes up to ``end`` had arrived at ``time_ns``; both never descend."""
        if self._count == len(self._end):
            for array in (self._end, self._time):
                array[:KEPT] = array[-KEPT:]
            self._count = KEPT
        self._end[self._count] = end
        self._time[self._count] = time_ns
        self._count += 1

    def read_ns(self, end: Ints) -> Ints:
        """(n,) when the reads were that brought the bytes before ``end`` (n,)."""
        return self._time[self._place(end)]

    def wire_ns(self, end: Ints) -> Ints:
        """(n,) when the last byte before ``end`` (n,) was on the wire, as near as is known:
        earlier than its read by the bytes that came after it, never before the read before.
        """
        place = self._place(end)
        late = (self.byte_ns * (self._end[place] - end)).astype(np.int64)
        before = np.where(place > 0, self._time[place - 1], np.iinfo(np.int64).min)
        return np.maximum(self._time[place] - late, np.minimum(before, self._time[place]))

    def _place(self, end: Ints) -> Ints:
        found = np.searchsorted(self._end[: self._count], end, side="left")
        return np.minimum(found, self._count - 1)
