"""Demodulate edges of infrared light to soft bits, burst by burst.

**Bursts.** While a light plane crosses a photodiode, the photodiode sees a burst of modulated
light of 10 to 60 us. Between bursts the receiver sees nothing. Edges come from a recording
(:func:`split_bursts`) or from bits that were sampled at a fixed rate (:func:`split_windows`).

**Line code.** A base station sends biphase mark at 6 Mbit/s (also called differential Manchester
or FM1): its light changes at the border of every bit, and once more in the middle of a one. A zero
is one run of 167 ns, a one is two runs of 83 ns, so that a bit has two chips, at 12 MHz (Bitcraze
lighthouse-fpga; Alvarado-Marin et al., IEEE RA-L 2024, section II.B).

**Chip grid.** The crystal of a base station is accurate to some parts per million. Within a burst
the chips form a rigid grid of which only the phase is unknown. The receiver delays rising and
falling edges differently. The phase is estimated for each direction, and the difference of both
(the skew) is removed, even if it is as long as a chip.

**Soft bits.** The value of a chip is the mean level over it. A late or missing edge attenuates
that value and does not invert it. The level changes at each border of two bits, between two chips.
If it changes in the same direction at both borders of a bit, it changed back between them: a one.
The product of both changes yields the bit and its reliability, and an unreliable bit has a small
weight in the next stage (:mod:`~locatk.core.lighthouse.demodulation.identification`). A run-length
decoder, as in the paper and in other implementations, must decide at each run, and a run that it
misreads shifts the rest of the burst.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.kernels import kernels
from locatk.core.lighthouse.recording import Edges

Array = NDArray[np.float64]

BIT_HZ = 6e6
"""Bit rate of a base station."""

CHIP_HZ = 2 * BIT_HZ
"""Chip rate: two chips per bit."""

BURST_GAP_S = 1.5e-6
"""Silence that ends a burst: nine bits. Within a sweep no bit is without an edge."""

MIN_SAMPLE_RATE_HZ = 24e6
"""Lowest rate at which a run of 83 ns can be distinguished from one of 167 ns."""

SAMPLE_RATE_TOLERANCE = 1e-3
"""Relative amount by which a rate may be below :data:`MIN_SAMPLE_RATE_HZ`, for rounded rates."""

MOCAP_FLASH_PERIOD_S = 1e-6
"""Period of the flashes of motion capture cameras (Qualisys; paper, section IV.A)."""

MOCAP_PERIOD_TOLERANCE = 0.06
"""Relative deviation of a period from :data:`MOCAP_FLASH_PERIOD_S` that still counts as equal."""

MIN_MOCAP_PERIOD_FRACTION = 0.8
"""A burst is a flash if at least this fraction of its periods are 1 us. A sequence of a base
station has no such run, because its pulses return every 167 to 333 ns."""

MIN_MOCAP_PERIODS = 8
"""A burst with fewer periods is never taken for a flash."""

MAX_BURST_S = 500e-6
"""A longer burst is no sweep, which takes 10 to 60 us, and yields no bits."""

MAX_SOFT_BIT = 64
"""Absolute value of a soft bit that was received without distortion."""

PHASE_STEPS_PER_CHIP = 4096
"""Resolution of the phase of an edge. Integers make the sums of both implementations equal."""

MAX_RUN_CHIPS = 3.0
"""Longer runs count as this long when the mean runs of both directions are compared."""

MIN_ODD_GRID_MARGIN = 1e-3
"""Bits start at the second chip only if the evidence for it is larger by this, in sums of level
changes. It breaks ties that differ by rounding only."""

ROUNDING_TIE = 1e-6
"""Values this close below a half are rounded up, in chips."""


@dataclass(frozen=True)
class Bursts:
    """Edges of many bursts, concatenated.

    Attributes
    ----------
    tick : (m,) int64 ndarray
        Times of the edges of all bursts, ascending.
    first : (n + 1,) int64 ndarray
        Burst i has the edges ``first[i]`` to ``first[i + 1]``.
    rises : (n,) bool ndarray
        True if the first edge of the burst goes from low to high.
    rate_hz : float
        Ticks per second.
    """

    tick: NDArray[np.int64]
    first: NDArray[np.int64]
    rises: NDArray[np.bool_]
    rate_hz: float

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def start_tick(self) -> NDArray[np.int64]:
        """Tick (n,) of the first edge of each burst."""
        return self.tick[self.first[:-1]]

    @property
    def duration_s(self) -> NDArray[np.float64]:
        """Seconds (n,) from the first to the last edge of each burst."""
        return (self.tick[self.first[1:] - 1] - self.start_tick) / self.rate_hz

    def take(self, mask: NDArray[np.bool_]) -> Bursts:
        """Select bursts by a mask (n,)."""
        sizes = np.diff(self.first)
        return Bursts(
            self.tick[np.repeat(mask, sizes)],
            np.concatenate([[0], np.cumsum(sizes[mask])]).astype(np.int64),
            self.rises[mask],
            self.rate_hz,
        )


@dataclass(frozen=True)
class SoftBits:
    """Soft bits of many bursts, concatenated.

    Attributes
    ----------
    value : (m,) int8 ndarray
        -64 (certainly 0) to 64 (certainly 1); 0 is unknown.
    first : (n + 1,) int64 ndarray
        Burst i has the values ``first[i]`` to ``first[i + 1]``.
    start_tick : (n,) float64 ndarray
        Start of the first bit of each burst, in ticks of the recorder.
    ticks_per_bit : float
        Nominal duration of a bit, in ticks of the recorder.
    """

    value: NDArray[np.int8]
    first: NDArray[np.int64]
    start_tick: Array
    ticks_per_bit: float

    def __len__(self) -> int:
        return len(self.start_tick)

    def take(self, rows: NDArray[np.int64]) -> SoftBits:
        """Select bursts by ascending indices."""
        size = np.diff(self.first)
        is_selected = np.zeros(len(self), bool)
        is_selected[rows] = True
        return SoftBits(
            self.value[np.repeat(is_selected, size)],
            np.concatenate([[0], np.cumsum(size[rows])]),
            self.start_tick[rows],
            self.ticks_per_bit,
        )


# ---- edges to bursts


def split_bursts(edges: Edges, gap_s: float = BURST_GAP_S) -> Bursts:
    """Split a recording into bursts at each silence longer than ``gap_s``.

    Raises
    ------
    InputError
        The recording resolves less than 24 MHz, or its times descend.
    """
    _require_sample_rate(edges.resolution_hz)
    run_ticks = np.diff(edges.tick)
    if len(run_ticks) and run_ticks.min() < 0:
        raise InputError("the times of the light's edges go back in time")
    gaps = np.flatnonzero(run_ticks > gap_s * edges.rate_hz) + 1
    ends = [len(edges)] if len(edges) else []
    first = np.concatenate([[0], gaps, ends]).astype(np.int64)
    return Bursts(edges.tick, first, (first[:-1] % 2 == 0) == edges.rises, edges.rate_hz)


def split_windows(windows: NDArray[np.uint8], rate_hz: float = 32e6) -> Bursts:
    """Find the edges in windows of light that was sampled at a fixed rate.

    Parameters
    ----------
    windows : (n, w) uint8 ndarray
        One row per window, the first sample in the highest bit of the first byte. A DotBot reads
        64 bytes by SPI at 32 MHz (paper, section III).
    rate_hz : float
        Samples per second.

    Returns
    -------
    Bursts
        One per window; sample k of window i is tick ``8 i w + k``. A window with fewer than two
        different samples becomes a burst without edges.

    Raises
    ------
    InputError
        The rate is below 24 MHz, or ``windows`` is not a 2D array of bytes.
    """
    _require_sample_rate(rate_hz)
    windows = np.asarray(windows)
    if windows.ndim != 2 or windows.dtype != np.uint8:
        raise InputError("windows of light must be rows of bytes")
    tick, first, rises = _window_edges(np.ascontiguousarray(windows))
    return Bursts(tick, first, rises, rate_hz)


def _window_edges(
    windows: NDArray[np.uint8],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return ticks, first edges and directions of :func:`split_windows`, compiled if possible."""
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
    """Return ticks, first edges and directions of :func:`split_windows`; numpy implementation."""
    level = np.unpackbits(windows, axis=1)
    row, column = np.nonzero(level[:, 1:] != level[:, :-1])
    size = np.bincount(row, minlength=len(windows))
    first = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    rises = np.zeros(len(windows), bool)
    has_edges = size > 0
    rises[has_edges] = level[has_edges, 0] == 0
    return row * level.shape[1] + column + 1, first, rises


def _require_sample_rate(rate_hz: float) -> None:
    """Raise InputError if a recording is too coarse for light of 6 Mbit/s."""
    if rate_hz < MIN_SAMPLE_RATE_HZ * (1 - SAMPLE_RATE_TOLERANCE):
        raise InputError(
            f"{rate_hz / 1e6:.3g} million samples per second are too few for light of 6 Mbit/s",
            hint="Record the data line with 24 MS/s or more, best 50",
        )


def is_mocap_flash(bursts: Bursts) -> NDArray[np.bool_]:
    """Return a mask (n,) of the bursts that are 1 MHz flashes of motion capture cameras.

    The test uses the time between edges of the same direction.
    """
    tick, size = bursts.tick, np.diff(bursts.first)
    deviation = np.abs((tick[2:] - tick[:-2]) / (MOCAP_FLASH_PERIOD_S * bursts.rate_hz) - 1)
    is_flash_period = np.concatenate(
        [[False] * min(2, len(tick)), deviation < MOCAP_PERIOD_TOLERANCE]
    )
    # A period ends at its edge. One that began in the burst before is longer than 1 us.
    total = np.concatenate([[0], np.cumsum(is_flash_period)])
    flash_periods = total[bursts.first[1:]] - total[bursts.first[:-1]]
    periods = size - 2
    is_flash: NDArray[np.bool_] = (periods >= MIN_MOCAP_PERIODS) & (
        flash_periods >= MIN_MOCAP_PERIOD_FRACTION * periods
    )
    return is_flash


# ---- bursts to soft bits


def demodulate_bursts(bursts: Bursts) -> SoftBits:
    """Demodulate bursts to soft bits.

    Parameters
    ----------
    bursts : Bursts

    Returns
    -------
    SoftBits
        One row per burst. A burst with fewer than two edges, or one that is longer than
        :data:`MAX_BURST_S`, has no bits.
    """
    if kernels is None:
        return demodulate_bursts_numpy(bursts)
    return _demodulate_compiled(bursts)


def _demodulate_compiled(bursts: Bursts) -> SoftBits:
    """Demodulate bursts with the C kernel."""
    assert kernels is not None
    n = len(bursts)
    ticks_per_chip = bursts.rate_hz / CHIP_HZ
    has_bits = _has_bits(bursts)
    max_chips = int(MAX_BURST_S * CHIP_HZ) + 4
    # A burst has as many bits as fit into its duration, and one or two more at its ends.
    begin, end = bursts.first[:-1][has_bits], bursts.first[1:][has_bits] - 1
    total_s = np.sum(bursts.tick[end] - bursts.tick[begin]) / bursts.rate_hz
    first = np.zeros(n + 1, np.int64)
    value = np.empty(int(total_s * BIT_HZ) + 4 * len(begin), np.int8)
    start_tick = np.zeros(n)
    kernels.light_bits(
        np.ascontiguousarray(bursts.tick, np.int64),
        np.ascontiguousarray(bursts.first, np.int64),
        np.ascontiguousarray(bursts.rises, np.uint8),
        has_bits.astype(np.uint8),
        ticks_per_chip,
        max_chips,
        value,
        first,
        start_tick,
    )
    return SoftBits(value[: first[-1]], first, start_tick, 2 * ticks_per_chip)


def _has_bits(bursts: Bursts) -> NDArray[np.bool_]:
    """Return a mask (n,) of the bursts with two or more edges that are not too long."""
    mask = np.diff(bursts.first) > 1
    last = bursts.tick[np.maximum(bursts.first[1:] - 1, 0)[mask]]
    mask[mask] = last - bursts.tick[bursts.first[:-1][mask]] <= MAX_BURST_S * bursts.rate_hz
    return mask


def demodulate_bursts_numpy(bursts: Bursts) -> SoftBits:
    """Demodulate bursts to soft bits; numpy implementation of :func:`demodulate_bursts`."""
    n = len(bursts)
    ticks_per_chip = bursts.rate_hz / CHIP_HZ
    rows = np.flatnonzero(_has_bits(bursts))
    if not len(rows):
        return SoftBits(
            np.zeros(0, np.int8), np.zeros(n + 1, np.int64), np.zeros(n), 2 * ticks_per_chip
        )
    kept = bursts.take(_has_bits(bursts))
    burst = np.repeat(np.arange(len(rows)), np.diff(kept.first))
    time = (kept.tick - kept.start_tick[burst]).astype(float) * (1 / ticks_per_chip)
    is_first_direction = (np.arange(len(time)) - kept.first[burst]) % 2 == 0
    begin, skew = _fit_chip_grid(time, burst, is_first_direction)
    time = time + np.where(is_first_direction, -0.5, 0.5) * skew[burst]
    time = _sort_within_bursts(time, burst)
    chips = _round_half_up(time[kept.first[1:] - 1] - begin).astype(np.int64) + 1
    rising = np.where(kept.rises[burst], is_first_direction, ~is_first_direction)
    mean, first_chip = _mean_chip_levels(time - begin[burst], rising, burst, kept.rises, chips)
    skipped_chips = _starts_at_second_chip(mean, first_chip, chips).astype(np.int64)
    bits = (chips - skipped_chips) // 2
    first = np.concatenate([[0], np.cumsum(bits)])
    bit = np.arange(first[-1]) - np.repeat(first[:-1], bits)
    left = np.repeat(first_chip + skipped_chips, bits) + 2 * bit
    # Level changes at both borders of a bit. At an end of the burst, where the neighbour is
    # missing, the change is twice the level of the bit's own chip.
    a, b = mean[left], mean[left + 1]
    change_before = np.where(bit == 0, 2 * a, a - np.roll(b, 1))
    change_after = np.where(bit == np.repeat(bits, bits) - 1, -2 * b, np.roll(a, -1) - b)
    product = np.clip(change_before * change_after / 4, -1.0, 1.0)
    value = np.rint(product * MAX_SOFT_BIT).astype(np.int8)
    all_bits, start_tick = np.zeros(n, np.int64), np.zeros(n)
    all_bits[rows] = bits
    start_tick[rows] = kept.start_tick + (begin + skipped_chips) * ticks_per_chip
    all_first = np.concatenate([[0], np.cumsum(all_bits)])
    return SoftBits(value, all_first, start_tick, 2 * ticks_per_chip)


def _fit_chip_grid(
    time: Array, burst: NDArray[np.int64], is_first_direction: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return the start of the chip grid and the skew (n,) of each burst, in chips.

    The grid starts one chip before the first edge. The skew is the delay of edges in the first
    edge's direction relative to the others. Phases determine it up to whole chips. The mean runs
    resolve that ambiguity: a delay of one direction shortens the runs that it begins and
    lengthens the others.
    """
    n = int(burst[-1]) + 1
    steps = PHASE_STEPS_PER_CHIP
    phase_step = np.floor((time - np.floor(time)) * steps + 0.5).astype(np.int64) % steps
    wave = np.rint(np.sin(2 * np.pi / steps * np.arange(steps + steps // 4)) * 2**14)
    phase = [
        np.arctan2(
            np.bincount(burst[m], wave[phase_step[m]], n),
            np.bincount(burst[m], wave[phase_step[m] + steps // 4], n),
        )
        / (2 * np.pi)
        for m in (is_first_direction, ~is_first_direction)
    ]
    run = np.minimum(np.diff(time), MAX_RUN_CHIPS)
    is_within_burst = burst[1:] == burst[:-1]
    mean_run = []
    for m in (
        is_within_burst & is_first_direction[:-1],
        is_within_burst & ~is_first_direction[:-1],
    ):
        number = np.bincount(burst[:-1][m], minlength=n)
        mean_run.append(np.bincount(burst[:-1][m], run[m], n) / np.maximum(number, 1))
    coarse_skew = np.where(
        mean_run[1] > 0, np.clip((mean_run[1] - mean_run[0]) / 2, -0.5, 0.5), 0.0
    )
    skew = phase[0] - phase[1]
    skew -= _round_half_up(skew - coarse_skew)
    return phase[0] - 0.5 * skew - 1, skew


def _round_half_up(value: Array) -> Array:
    """Round to integers. Halves, which are frequent in sampled times, are always rounded up."""
    whole: Array = np.floor(value + (0.5 + ROUNDING_TIE))
    return whole


def _sort_within_bursts(time: Array, burst: NDArray[np.int64]) -> Array:
    """Make times (m,) ascend within each burst.

    A pulse shorter than the skew gets length 0; edges do not swap.
    """
    offset = 1.0 + np.ptp(time)
    ordered: Array = np.maximum.accumulate(time + burst * offset) - burst * offset
    return ordered


def _mean_chip_levels(
    time: Array,
    rising: NDArray[np.bool_],
    burst: NDArray[np.int64],
    rises: NDArray[np.bool_],
    chips: NDArray[np.int64],
) -> tuple[Array, NDArray[np.int64]]:
    """Return the mean level over each chip of all bursts, and the first chip (n,) of each burst.

    Levels are -1 to 1. An edge changes the mean of its own chip in proportion to the remainder
    of the chip, and that of all later chips fully.

    Parameters
    ----------
    time, rising, burst : (m,) ndarray
        Of each edge: chips since the start of its grid, direction and burst.
    rises : (n,) bool ndarray
        Direction of the first edge of each burst.
    chips : (n,) int64 ndarray
        Number of chips of each burst.
    """
    first_chip = np.concatenate([[0], np.cumsum(chips)])[:-1]
    chip = time.astype(np.int64)
    fraction = time - chip
    # Each burst has one more chip here, which receives the remainder of its last edge.
    index = (first_chip + np.arange(len(chips)))[burst] + chip
    jump = np.where(rising, 2.0, -2.0)
    total = len(chips) + int(chips.sum())
    change = np.bincount(index, jump * (1 - fraction), total)
    change = change + np.bincount(index + 1, jump * fraction, total)
    spare = np.cumsum(chips + 1) - 1
    level = np.cumsum(change)
    previous_end = np.concatenate([[0.0], level[spare[:-1]]])
    base = np.where(rises, -1.0, 1.0) - previous_end
    mean: Array = np.delete(level, spare) + np.repeat(base, chips)
    return mean, first_chip


def _starts_at_second_chip(
    mean: Array, first_chip: NDArray[np.int64], chips: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return a mask (n,) of the bursts that have their first bit at the second chip.

    The level always changes at borders of bits, and only half of the time in their middles.
    """
    change = np.abs(np.diff(mean))
    burst = np.repeat(np.arange(len(chips)), chips)
    chip = np.arange(len(change)) - first_chip[burst[:-1]]
    is_within_burst = burst[1:] == burst[:-1]
    after_even, after_odd = (
        np.bincount(burst[:-1][m], change[m], len(chips))
        for m in (is_within_burst & (chip % 2 == 0), is_within_burst & (chip % 2 == 1))
    )
    return np.asarray(after_even > after_odd + MIN_ODD_GRID_MARGIN)
