"""Decode light to sequence indices with the paper's algorithm, for comparison.

Alvarado-Marin et al., Lighthouse Localization of Miniature Wireless Robots, IEEE RA-L 2024,
section II.B, with the rules and numbers of the authors' firmware (DotBot-firmware
``bsp/nrf/lh2.c``, BSD-3, commit 0beee03). A window of 64 bytes, sampled at 32 MHz, is split into
runs of equal samples. A long run is a 0, a pair of short runs is a 1, and a run of intermediate
length is fuzzy until its neighbours determine it. Of the 64 resulting bits, 17 are run forward
through each polynomial and compared with the bits after them. If no polynomial matches, fewer bits
are compared.

Behaviour of the firmware that C defines is reproduced, including its defects:

- Mismatches are counted in the lower 32 bits only (``__builtin_popcount`` of a 64-bit word). Of
  the 39, 38, 29, 28 and 19 bits that the attempts should compare, they compare 32, 32, 22, 22 and
  12. Most of the false polynomials are due to this.
- A fuzzy chip between ones and a 0 consumes that 0, and an odd run of ones after it changes that
  0 to a 1.
- A first chip that is 1, or still fuzzy, is discarded even if it was not the second half of a bit.
  The index may then be too high by one.

Behaviour that C leaves undefined is replaced by the evident intention:

- Runs beyond the capacity of 128 are ignored.
- There are no chips after the end of the window, and bits there are 0. The firmware reads 64 bytes
  that were never received.
- The length of a run does not wrap at 256.
- The count of ones starts at zero in the second pass. In the firmware it may reach before the first
  chip.
- Bits that end early stay at the top.
- 17 zeros, for which the firmware's search never ends, match no polynomial.

Indices come from the tables of :mod:`~locatk.core.lighthouse.lfsr` instead of steps to the next of
64 checkpoints. The results are the same except for the first and the last 1,024 indices of the
sequence, where the firmware is too low by one, or counts from the wrong end. No light is received
at these angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import channel_of
from locatk.core.lighthouse.demodulation.pipeline import MIN_BURST_S, DecodedSweeps
from locatk.core.lighthouse.demodulation.soft_bits import split_bursts
from locatk.core.lighthouse.recording import UNKNOWN, Edges

WINDOW_BYTES = 64
"""Length of a window: 16 us at 32 MHz."""

WINDOW_START_S = 9e-6
"""Start of the window after the first edge of a burst. With it the authors' firmware, compiled
natively, decodes most of the bursts in their recording demodulation_code: 79.6 %, instead of 43.6 %
at 0 us and 74 % at 12 us. Their receiver starts at an edge of the envelope, which a recording of
the data line does not contain."""

FIRMWARE_POLYNOMIALS = 8
"""Number of polynomials that the firmware tries: those of channels 1 to 4."""

MAX_CHIPS = 128
"""Number of runs of a window that are used."""

MATCH_ATTEMPTS_BITS = ((8, 39, 4), (9, 38, 4), (8, 29, 3), (9, 28, 3), (8, 19, 2))
"""Number of skipped bits, of bits compared after the 17, and of tolerated mismatches, in the order
of the attempts."""

_FUZZY_CHIP = 2
"""Value of a chip whose length fits neither a 0 nor half a 1."""

_MAX_SHORT_SAMPLES = 3
"""Longest run that is half a 1."""

_MIN_LONG_SAMPLES = 5
"""Shortest run that is a 0."""

_COUNTED_BITS_MASK = np.uint64(0xFFFFFFFF)
"""Bits in which the firmware counts mismatches."""

_WINDOW_SAMPLES = 8 * WINDOW_BYTES

_WINDOWS_PER_BLOCK = 4096
"""Number of windows that are processed together, which bounds the working memory."""

Chips = NDArray[np.uint8]
Bits = NDArray[np.uint64]


@dataclass(frozen=True)
class PaperDecodes:
    """Windows decoded with the paper's algorithm.

    Attributes
    ----------
    polynomial : (n,) int32 ndarray
        -1 if none matches.
    index : (n,) int64 ndarray
        Index of the first bit of ``bits`` in the sequence;
        :data:`~locatk.core.lighthouse.lfsr.NO_INDEX` without a polynomial, or if that bit would
        precede the rotor's zero.
    bit_offset : (n,) int32 ndarray
        Number of bits skipped before the 17 that were looked up; 0 without a polynomial.
    bits : (n,) uint64 ndarray
        As in ``locatk.LighthouseCapture``: the first bit in the highest position.
    """

    polynomial: NDArray[np.int32]
    index: NDArray[np.int64]
    bit_offset: NDArray[np.int32]
    bits: Bits

    def __len__(self) -> int:
        return len(self.polynomial)


# ---- recordings


def decode_recording(lines: Sequence[Edges]) -> tuple[DecodedSweeps, int]:
    """Decode a recording with the paper's algorithm: one window of 16 us per burst.

    Parameters
    ----------
    lines : sequence of Edges
        One per photodiode.

    Returns
    -------
    sweeps : DecodedSweeps
        Their time is the start of their window and their count the index as decoded. Nothing is
        rejected, and planes are unknown.
    bursts : int
        Number of bursts.

    Raises
    ------
    InputError
        Nothing was decoded, or the sampling rate is below 24 MHz.
    """
    parts, burst_count = [], 0
    for sensor, edges in enumerate(lines):
        bursts = split_bursts(edges)
        bursts = bursts.take(bursts.duration_s > MIN_BURST_S)
        burst_count += len(bursts)
        start = bursts.start_tick + round(WINDOW_START_S * edges.rate_hz)
        decodes = decode_windows(sample_windows(edges, start))
        ok = (decodes.polynomial >= 0) & (decodes.index >= 0)
        sensors = np.full(int(np.count_nonzero(ok)), sensor)
        parts.append((start[ok], sensors, decodes.polynomial[ok], decodes.index[ok]))
    tick, sensors, polynomial, index = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    if not len(tick):
        raise InputError(
            f"the paper's algorithm decodes none of {burst_count} bursts",
            hint="Use --method soft",
        )
    order = np.argsort(tick, kind="stable")
    sweeps = DecodedSweeps(
        tick[order].astype(float),
        sensors[order].astype(np.int32),
        channel_of(polynomial[order]).astype(np.int32),
        polynomial[order].astype(np.int32),
        np.full(len(tick), UNKNOWN, np.int32),
        index[order].astype(float),
    )
    return sweeps, burst_count


def sample_windows(edges: Edges, start_tick: ArrayLike, rate_hz: float = 32e6) -> NDArray[np.uint8]:
    """Sample windows of a recording as the SPI of a receiver does.

    Parameters
    ----------
    edges : Edges
    start_tick : (n,) array_like of int
        Time of the first sample of each window, in ticks of ``edges``.
    rate_hz : float
        Sampling rate of the receiver.

    Returns
    -------
    (n, 64) uint8 ndarray
        First sample in the highest bit of the first byte. A sample at the exact tick of an edge
        has the new level. The level is constant before the first and after the last edge.
    """
    start = np.atleast_1d(np.asarray(start_tick, np.int64))
    sample_tick = np.floor(np.arange(_WINDOW_SAMPLES) * edges.rate_hz / rate_hz).astype(np.int64)
    windows = np.empty((len(start), WINDOW_BYTES), np.uint8)
    for k in range(0, len(start), _WINDOWS_PER_BLOCK):
        tick = start[k : k + _WINDOWS_PER_BLOCK, None] + sample_tick
        # The level is high after an odd number of edges if the first rises, else after an even one.
        edge = np.searchsorted(edges.tick, tick, side="right") + (not edges.rises)
        windows[k : k + _WINDOWS_PER_BLOCK] = np.packbits((edge & 1).astype(np.uint8), axis=1)
    return windows


# ---- windows


def decode_windows(
    windows: NDArray[np.uint8], polynomials: int = FIRMWARE_POLYNOMIALS
) -> PaperDecodes:
    """Decode windows (n, 64) to bits, polynomial and index.

    The first ``polynomials`` (1 to 32) are tried; the firmware tries 8.

    Raises
    ------
    ValueError
        ``polynomials`` is not 1 to 32.
    """
    bits = demodulate_windows(windows)
    polynomial, offset = identify_polynomials(bits, polynomials)
    index = lfsr.indices(_register_state(bits, offset), np.maximum(polynomial, 0)) - offset
    index[(polynomial < 0) | (index < 0)] = lfsr.NO_INDEX
    return PaperDecodes(polynomial, index, offset, bits)


def demodulate_windows(windows: NDArray[np.uint8]) -> Bits:
    """Return the 64 bits of each window (n, 64), the first in the highest position.

    Bits after the end of the light are arbitrary, and that end is not detected.
    """
    bits = np.empty(len(windows), np.uint64)
    for k in range(0, len(windows), _WINDOWS_PER_BLOCK):
        chips = _split_chips(windows[k : k + _WINDOWS_PER_BLOCK])
        _resolve_fuzzy_chips(chips)
        _pair_ones(chips)
        bits[k : k + _WINDOWS_PER_BLOCK] = _chips_to_bits(chips)
    return bits


def identify_polynomials(
    bits: Bits, polynomials: int = FIRMWARE_POLYNOMIALS
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return polynomial (n,) and number of skipped bits (n,) of 64 bits each.

    The first ``polynomials`` (1 to 32) are tried, and the first of the best ones is returned; -1 if
    none matches.

    Raises
    ------
    ValueError
        ``polynomials`` is not 1 to 32.
    """
    if not 1 <= polynomials <= len(lfsr.TAPS):
        raise ValueError(f"{polynomials} polynomials instead of 1 to {len(lfsr.TAPS)}")
    polynomial = np.full(len(bits), -1, np.int32)
    offset = np.zeros(len(bits), np.int32)
    rows = np.arange(len(bits))
    for skipped, compared, max_mismatches in MATCH_ATTEMPTS_BITS:
        mismatches = _count_mismatches(bits[rows], skipped, compared, polynomials)
        best = np.argmin(mismatches, axis=0)
        is_match = mismatches[best, np.arange(len(rows))] <= max_mismatches
        polynomial[rows[is_match]], offset[rows[is_match]] = best[is_match], skipped
        rows = rows[~is_match]
    # The firmware discards such a capture later, before it would search for 17 zeros.
    is_dark = _register_state(bits, offset) == 0
    polynomial[is_dark], offset[is_dark] = -1, 0
    return polynomial, offset


def _split_chips(windows: NDArray[np.uint8]) -> Chips:
    """Return the chips (MAX_CHIPS + 2, n) of windows: 0, 1 (half a one) or fuzzy, from run lengths.

    A 0 stands for missing chips. Two rows of zeros after the last chip allow to look ahead.
    """
    samples = np.unpackbits(windows, axis=1)
    starts = np.ones(samples.shape, bool)
    starts[:, 1:] = samples[:, 1:] != samples[:, :-1]
    first = np.flatnonzero(starts)
    length = np.diff(first, append=starts.size)
    row = first // _WINDOW_SAMPLES
    runs = np.bincount(row, minlength=len(windows))
    number = np.arange(len(first)) - np.repeat(np.cumsum(runs) - runs, runs)
    kept = number < MAX_CHIPS
    row, number, length = row[kept], number[kept], length[kept]
    chips = np.zeros((MAX_CHIPS + 2, len(windows)), np.uint8)
    is_short, is_long = length <= _MAX_SHORT_SAMPLES, length >= _MIN_LONG_SAMPLES
    chips[number, row] = np.where(is_short, 1, np.where(is_long, 0, _FUZZY_CHIP))
    return chips


def _resolve_fuzzy_chips(chips: Chips) -> None:
    """Determine fuzzy chips from their neighbours if possible: ones come in pairs."""
    # True if an odd number of ones starts at a chip. No rule changes a chip ahead that it does not
    # also skip, so that these stay valid.
    odd_run = np.zeros(chips.shape, bool)
    for j in range(MAX_CHIPS - 1, -1, -1):
        odd_run[j] = (chips[j] == 1) & ~odd_run[j + 1]
    ones = np.zeros(chips.shape[1], np.uint8)  # since the last chip that is not 1
    skipped = np.zeros(chips.shape[1], bool)
    for j in range(MAX_CHIPS - 1):
        chip, ahead = chips[j], chips[j + 1]
        is_fuzzy = (chip == _FUZZY_CHIP) & ~skipped
        is_one = (chip == 1) & ~skipped
        ones[(chip == 0) & ~skipped] = 0
        if j:  # the first is half a bit that began before the window
            ones += is_one
        skipped = np.zeros_like(skipped)
        rows = np.flatnonzero(is_fuzzy)
        if not len(rows):
            continue
        before, after = ones[rows], ahead[rows]
        none, uneven = before == 0, before % 2 == 1
        even = ~none & ~uneven
        single, double = odd_run[j + 1, rows], odd_run[j + 2, rows]
        # Before a 0: a 0, unless that leaves an odd number of ones, which the next pass repairs.
        zero = ~uneven & (after == 0)
        # Before a run of ones: a 1 if that makes their number even, else still fuzzy.
        one_ahead = (after == 1) & (single | uneven)
        # Two fuzzy chips in a row: after a single 1 they are its other half and a 0.
        pair = uneven & (after == _FUZZY_CHIP)
        # The firmware's defect: after ones it handles the 0 ahead as if that were fuzzy.
        defect = even & zero
        raised = defect & double

        chip[rows[zero]] = 0
        chip[rows[one_ahead | pair]] = 1
        ahead[rows[pair]] = 0
        ahead[rows[raised]] = 1
        skipped[rows] = defect | pair | (none & (after == _FUZZY_CHIP))
        updated = before.copy()
        updated[zero | pair] = 0
        updated[one_ahead & ~uneven] = 1
        updated[one_ahead & uneven] += 1
        updated[raised] = 1
        ones[rows] = updated
    last = chips[MAX_CHIPS - 1]
    last[(last == _FUZZY_CHIP) & ~skipped] = 0


def _pair_ones(chips: Chips) -> None:
    """Determine fuzzy chips after ones, and prepend a 1 to odd runs of ones."""
    ones = np.zeros(chips.shape[1], np.uint8)
    for j in range(MAX_CHIPS):
        chip = chips[j]
        follows_ones = (chip == _FUZZY_CHIP) & (ones > 0)
        chip[follows_ones] = ones[follows_ones] & 1
        is_odd = np.flatnonzero((chip == 0) & (ones & 1 == 1))
        chips[j - 1 - ones[is_odd].astype(np.int64), is_odd] = 1
        ones = np.where(chip == 1, ones + (j > 0), 0).astype(np.uint8)


def _chips_to_bits(chips: Chips) -> Bits:
    """Return the 64 bits of chips: two chips for a 1, one for a 0 or a chip that is still fuzzy."""
    bits = np.zeros(chips.shape[1], np.uint64)
    position = np.full(chips.shape[1], 63, np.int64)
    # The first chip is discarded unless it is a 0.
    skipped = chips[0] != 0
    for j in range(MAX_CHIPS):
        is_used = ~skipped & (position >= 0)
        is_one = is_used & (chips[j] == 1)
        bits[is_one] |= np.uint64(1) << position[is_one].astype(np.uint64)
        position -= is_used
        skipped = is_one
    return bits


def _count_mismatches(
    bits: Bits, skipped: int, compared: int, polynomials: int
) -> NDArray[np.uint8]:
    """Count the mismatches (polynomials, n) in the ``compared`` bits after the state.

    The state is the 17 bits after the first ``skipped``. Only the lower 32 of the 64 bits are
    counted, as in the firmware.
    """
    state = _register_state(bits, skipped)
    polynomial = np.arange(polynomials)[:, None]
    index = lfsr.indices(state, polynomial)
    length = lfsr.REGISTER_BITS + compared
    # From state 0, which has no index, the register stays at 0.
    expected = np.where(state == 0, np.uint64(0), lfsr.bits_at(index, polynomial, length))
    rest = np.uint64(64 - skipped - length)
    mask = np.uint64((1 << length) - 1)
    differing = (bits >> rest & mask ^ expected) << rest & _COUNTED_BITS_MASK
    return np.bitwise_count(differing)


def _register_state(bits: Bits, skipped: ArrayLike) -> NDArray[np.int64]:
    """Return the state of the register (17 bits) after the first ``skipped`` bits."""
    shift = np.asarray(64 - lfsr.REGISTER_BITS - np.asarray(skipped), np.uint64)
    return (bits >> shift).astype(np.int64) & lfsr.SEQUENCE_LENGTH
