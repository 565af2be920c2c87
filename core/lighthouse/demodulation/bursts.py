"""Light that passes a photodiode comes in bursts: edges that lie close together.

Between bursts nothing is sent that reaches the receiver. Edges come from a recording
(:func:`split_bursts`) or from bits that were sampled at a fixed rate (:func:`bursts_of_windows`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.kernels import kernels
from locatk.core.lighthouse.recording import Edges

GAP_S = 1.5e-6
"""Silence that ends a burst: nine bits, of which the light of a sweep leaves none dark."""

LOWEST_RATE_HZ = 24e6
"""Coarser times do not tell a run of 83 ns from one of 167 ns."""

MOCAP_PERIOD_S = 1e-6
"""Motion capture cameras flash at 1 MHz (Qualisys; paper, section IV.A)."""

MOCAP_TOLERANCE = 0.06
MOCAP_SHARE = 0.8
"""A burst is a flash if so many of its periods are 1 us, within the tolerance. A sequence of a
station has no such run: its pulses return every 167 to 333 ns."""

LEAST_PERIODS = 8


@dataclass(frozen=True)
class Bursts:
    """Edges of many bursts, one after the other.

    Attributes
    ----------
    tick : (m,) int64 ndarray
        Ascending, of all bursts.
    first : (n + 1,) int64 ndarray
        Burst i has the edges ``first[i]`` to ``first[i + 1]``.
    rises : (n,) bool ndarray
        Whether its first edge goes from low to high.
    rate_hz : float
        Ticks a second.
    """

    tick: NDArray[np.int64]
    first: NDArray[np.int64]
    rises: NDArray[np.bool_]
    rate_hz: float

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def start(self) -> NDArray[np.int64]:
        """(n,) tick of the first edge of each."""
        return self.tick[self.first[:-1]]

    @property
    def duration_s(self) -> NDArray[np.float64]:
        """(n,) from the first to the last edge of each, in seconds."""
        return (self.tick[self.first[1:] - 1] - self.start) / self.rate_hz

    def take(self, chosen: NDArray[np.bool_]) -> Bursts:
        """The chosen bursts only."""
        sizes = np.diff(self.first)
        return Bursts(
            self.tick[np.repeat(chosen, sizes)],
            np.concatenate([[0], np.cumsum(sizes[chosen])]).astype(np.int64),
            self.rises[chosen],
            self.rate_hz,
        )


def split_bursts(edges: Edges, gap_s: float = GAP_S) -> Bursts:
    """Bursts of a recording: a longer silence than ``gap_s`` divides them.

    Raises
    ------
    InputError
        The recording resolves less than 24 MHz, or goes back in time.
    """
    require_rate(edges.resolution_hz)
    run = np.diff(edges.tick)
    if len(run) and run.min() < 0:
        raise InputError("edges of light that go back in time")
    gaps = np.flatnonzero(run > gap_s * edges.rate_hz) + 1
    ends = [len(edges)] if len(edges) else []
    first = np.concatenate([[0], gaps, ends]).astype(np.int64)
    return Bursts(edges.tick, first, (first[:-1] % 2 == 0) == edges.rises, edges.rate_hz)


def bursts_of_windows(windows: NDArray[np.uint8], rate_hz: float = 32e6) -> Bursts:
    """Bursts of windows of bits that were sampled at a fixed rate.

    Parameters
    ----------
    windows : (n, w) uint8 ndarray
        A row a window, the first sample in the highest bit of the first byte: the 64 bytes
        that a DotBot reads by SPI at 32 MHz (paper, section III).
    rate_hz : float
        Samples a second.

    Returns
    -------
    Bursts
        One a window; sample k of window i is tick ``8 i w + k``. A window without two edges
        is a burst without edges.

    Raises
    ------
    InputError
        Fewer than 24 million samples a second, or not a table of bytes.
    """
    require_rate(rate_hz)
    windows = np.asarray(windows)
    if windows.ndim != 2 or windows.dtype != np.uint8:
        raise InputError("windows of light are rows of bytes")
    tick, first, rises = _window_edges(np.ascontiguousarray(windows))
    return Bursts(tick, first, rises, rate_hz)


def _window_edges(
    windows: NDArray[np.uint8],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    n, width = windows.shape
    if width == 0:
        return np.zeros(0, np.int64), np.zeros(n + 1, np.int64), np.zeros(n, bool)
    if kernels is None:
        return window_edges_numpy(windows)
    tick = np.empty(n * 8 * width, np.int64)
    first, rises = np.empty(n + 1, np.int64), np.empty(n, np.uint8)
    kernels.window_edges(windows, width, tick, first, rises)
    return tick[: first[-1]], first, rises.astype(bool)


def window_edges_numpy(
    windows: NDArray[np.uint8],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Ticks, first edges and first directions of :func:`bursts_of_windows`, in numpy."""
    level = np.unpackbits(windows, axis=1)
    row, column = np.nonzero(level[:, 1:] != level[:, :-1])
    size = np.bincount(row, minlength=len(windows))
    first = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    rises = np.zeros(len(windows), bool)
    some = size > 0
    rises[some] = level[some, 0] == 0
    return row * level.shape[1] + column + 1, first, rises


def require_rate(rate_hz: float) -> None:
    """Refuse a recording that is too coarse for light of 6 Mbit/s.

    Raises
    ------
    InputError
    """
    if rate_hz < LOWEST_RATE_HZ * 0.999:
        raise InputError(
            f"{rate_hz / 1e6:.3g} million samples a second are too few for light of 6 Mbit/s",
            hint="Record the data line with 24 MS/s or more, best 50",
        )


def is_mocap_flash(bursts: Bursts) -> NDArray[np.bool_]:
    """Which bursts (n,) are the 1 MHz flashes of motion capture cameras.

    Judged by the time between edges of the same direction.
    """
    tick, size = bursts.tick, np.diff(bursts.first)
    off = np.abs((tick[2:] - tick[:-2]) / (MOCAP_PERIOD_S * bursts.rate_hz) - 1)
    regular = np.concatenate([[False] * min(2, len(tick)), off < MOCAP_TOLERANCE])
    # Edges up to each one; a period that began in the burst before is longer than that.
    total = np.concatenate([[0], np.cumsum(regular)])
    hits = total[bursts.first[1:]] - total[bursts.first[:-1]]
    periods = size - 2
    flashes: NDArray[np.bool_] = (periods >= LEAST_PERIODS) & (hits >= MOCAP_SHARE * periods)
    return flashes
