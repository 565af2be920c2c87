"""The light of base stations as a photodiode's data line tells it: when its level changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NANOSECOND = 1_000_000_000


@dataclass(frozen=True)
class Edges:
    """Changes of one photodiode's data line.

    Attributes
    ----------
    tick : (n,) int64 ndarray
        When each change was, strictly ascending, in ticks of the recorder's clock since
        its start; the level changes with each.
    rate_hz : float
        Ticks a second: the sampling rate of a logic analyser, 1e9 where times are given in
        nanoseconds.
    resolution_hz : float
        What the times resolve, at most ``rate_hz``: an analyser that samples at 24 MHz and
        tells nanoseconds resolves 24 MHz.
    rises : bool
        Whether the first change is from low to high.
    end_tick : int
        End of the recording; a tick after the last edge, or later.
    start_ns : int
        Tick 0, in nanoseconds since the epoch; 0 where the recording does not tell.
    """

    tick: NDArray[np.int64]
    rate_hz: float
    resolution_hz: float
    rises: bool
    end_tick: int
    start_ns: int = 0

    def __len__(self) -> int:
        return len(self.tick)

    @property
    def duration_s(self) -> float:
        """Length of the recording in seconds, from tick 0 or the first edge before it."""
        first = min(0, int(self.tick[0])) if len(self.tick) else 0
        return (self.end_tick - first) / self.rate_hz
