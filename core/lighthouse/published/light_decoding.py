"""The paper's own way from light to an index, for comparison.

Alvarado-Marin et al., Lighthouse Localization of Miniature Wireless Robots, RA-L 2024,
section II.B, with the rules and numbers of the authors' firmware (DotBot-firmware
``bsp/nrf/lh2.c``, BSD-3, commit 0beee03): a window of 64 bytes, sampled at 32 MHz, is cut
into runs of equal samples. A long run is a 0, a pair of short runs a 1, and a run between
the two is fuzzy until its neighbours tell. Of the 64 bits that come of it, 17 are run
forward through each polynomial and compared with those after them; what does not match is
tried again with fewer bits.

What the firmware does in defined ways is done here, its slips too:

- Mismatches are counted in the lower 32 bits alone (``__builtin_popcount`` of a 64-bit
  word). Of the 39, 38, 29, 28 and 19 bits that an attempt claims to compare it compares 32,
  32, 22, 22 and 12: most of its false polynomials come of that.
- A fuzzy chip between ones and a 0 takes that 0 along, and an odd run of ones after it makes
  that 0 a 1.
- A first chip that is 1, or left fuzzy, is thrown away, whether or not it was the second half
  of a bit: the index may be one too high.

Where C leaves open what happens, what was meant is done: runs beyond the 128 that it has
room for are left out, there are no chips after the window's end (bits there are 0; the
firmware reads 64 bytes that were never received), a run's length does not wrap at 256, the
count of ones starts anew for the second pass (it may reach before the first chip), bits
that end early stay at the top, and 17 zeros, for which its search never ends, are no
polynomial's. Indices come of the tables of :mod:`~locatk.core.lighthouse.lfsr` in place of steps
to the next of 64 checkpoints, with the same results but for the first and the last 1,024
of the sequence: there the firmware is one too low, or counts from the wrong end. No light
is received there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.recording import Edges

BYTES = 64
"""Of a window: 16 us at 32 MHz."""

POLYNOMIALS = 8
"""The firmware's: those of channels 1 to 4."""

CHIPS = 128
"""Runs of a window that are looked at."""

ATTEMPTS = ((8, 39, 4), (9, 38, 4), (8, 29, 3), (9, 28, 3), (8, 19, 2))
"""Bits that are passed over, bits that are compared after the 17 and mismatches allowed, in
the order in which they are tried."""

_FUZZY = 2
_SHORT = 3  # samples: at most this a half of a 1
_LONG = 5  # samples: at least this a 0
_COUNTED = np.uint64(0xFFFFFFFF)
_SAMPLES = 8 * BYTES
_BLOCK = 4096  # windows at a time, to keep the working memory small

Chips = NDArray[np.uint8]
Bits = NDArray[np.uint64]


@dataclass(frozen=True)
class PaperDecodes:
    """What the paper's algorithm finds in windows.

    Attributes
    ----------
    polynomial : (n,) int32 ndarray
        -1 where none was found.
    index : (n,) int64 ndarray
        Of the first bit of ``bits`` in the polynomial's sequence;
        :data:`~locatk.core.lighthouse.lfsr.NOWHERE` where no polynomial was found, or where
        that bit would be before the rotor's zero.
    bit_offset : (n,) int32 ndarray
        Bits that were passed over before the 17 that were looked up; 0 where none was found.
    bits : (n,) uint64 ndarray
        As ``locatk.LighthouseCapture`` has them: the first in the highest place.
    """

    polynomial: NDArray[np.int32]
    index: NDArray[np.int64]
    bit_offset: NDArray[np.int32]
    bits: Bits

    def __len__(self) -> int:
        return len(self.polynomial)


def windows_of(edges: Edges, start_tick: ArrayLike, rate_hz: float = 32e6) -> NDArray[np.uint8]:
    """What a receiver would have sampled of a recording.

    Parameters
    ----------
    edges : Edges
    start_tick : (n,) array_like of int
        When each window's first sample is taken, in ticks of ``edges``.
    rate_hz : float
        Of the receiver.

    Returns
    -------
    (n, 64) ndarray
        First sample in the highest bit of the first byte. A sample at an edge's very tick
        has the new level; before the first and after the last edge the level stays.
    """
    start = np.atleast_1d(np.asarray(start_tick, np.int64))
    since = np.floor(np.arange(_SAMPLES) * edges.rate_hz / rate_hz).astype(np.int64)
    windows = np.empty((len(start), BYTES), np.uint8)
    for at in range(0, len(start), _BLOCK):
        tick = start[at : at + _BLOCK, None] + since
        # High after an odd number of edges where the first rises, after an even one where not.
        edge = np.searchsorted(edges.tick, tick, side="right") + (not edges.rises)
        windows[at : at + _BLOCK] = np.packbits((edge & 1).astype(np.uint8), axis=1)
    return windows


def demodulate(windows: NDArray[np.uint8]) -> Bits:
    """The 64 bits of each window (n, 64), first in the highest place.

    Bits are right only as far as the light goes: nothing tells where that is.
    """
    bits = np.empty(len(windows), np.uint64)
    for at in range(0, len(windows), _BLOCK):
        chips = _chips(windows[at : at + _BLOCK])
        _settle(chips)
        _make_even(chips)
        bits[at : at + _BLOCK] = _bits(chips)
    return bits


def identify(
    bits: Bits, polynomials: int = POLYNOMIALS
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Polynomial (n,) of 64 bits each, -1 where none fits, and the bits passed over (n,).

    ``polynomials`` is how many are tried, 1 to 32, from number 0 on; of those that fit
    equally well the first is taken.
    """
    if not 1 <= polynomials <= len(lfsr.TAPS):
        raise ValueError(f"{polynomials} polynomials, not 1 to {len(lfsr.TAPS)}")
    found = np.full(len(bits), -1, np.int32)
    offset = np.zeros(len(bits), np.int32)
    left = np.arange(len(bits))
    for passed, compared, allowed in ATTEMPTS:
        tried = bits[left]
        mismatches = _mismatches(tried, passed, compared, polynomials)
        best = np.argmin(mismatches, axis=0)
        fits = mismatches[best, np.arange(len(left))] <= allowed
        found[left[fits]], offset[left[fits]] = best[fits], passed
        left = left[~fits]
    # The firmware drops such a capture later, before it would search for 17 zeros.
    dark = _seventeen(bits, offset) == 0
    found[dark], offset[dark] = -1, 0
    return found, offset


def decode(windows: NDArray[np.uint8], polynomials: int = POLYNOMIALS) -> PaperDecodes:
    """Bits, polynomial and index of windows (n, 64).

    ``polynomials`` is how many are tried, 1 to 32, from number 0 on; the firmware tries 8.
    """
    bits = demodulate(windows)
    polynomial, offset = identify(bits, polynomials)
    index = lfsr.indices(_seventeen(bits, offset), np.maximum(polynomial, 0)) - offset
    index[(polynomial < 0) | (index < 0)] = lfsr.NOWHERE
    return PaperDecodes(polynomial, index, offset, bits)


def _chips(windows: NDArray[np.uint8]) -> Chips:
    """Zeros, halves of ones and fuzzy chips of windows, (CHIPS + 2, n): the lengths of the
    runs, with no chip (0) where there are no more, and after the last for a look ahead."""
    samples = np.unpackbits(windows, axis=1)
    starts = np.ones(samples.shape, bool)
    starts[:, 1:] = samples[:, 1:] != samples[:, :-1]
    at = np.flatnonzero(starts)
    length = np.diff(at, append=starts.size)
    row = at // _SAMPLES
    runs = np.bincount(row, minlength=len(windows))
    number = np.arange(len(at)) - np.repeat(np.cumsum(runs) - runs, runs)
    kept = number < CHIPS
    row, number, length = row[kept], number[kept], length[kept]
    chips = np.zeros((CHIPS + 2, len(windows)), np.uint8)
    chips[number, row] = np.where(length <= _SHORT, 1, np.where(length >= _LONG, 0, _FUZZY))
    return chips


def _settle(chips: Chips) -> None:
    """Tells fuzzy chips by their neighbours, where those tell: ones come in pairs."""
    # Whether an odd number of ones starts at each chip. No rule changes a chip ahead of it
    # that it does not also pass over, so that these stay true.
    odd = np.zeros(chips.shape, bool)
    for j in range(CHIPS - 1, -1, -1):
        odd[j] = (chips[j] == 1) & ~odd[j + 1]
    ones = np.zeros(chips.shape[1], np.uint8)  # since the last chip that is no 1
    passed = np.zeros(chips.shape[1], bool)
    for j in range(CHIPS - 1):
        chip, ahead = chips[j], chips[j + 1]
        fuzzy = (chip == _FUZZY) & ~passed
        one = (chip == 1) & ~passed
        ones[(chip == 0) & ~passed] = 0
        if j:  # the first is half a bit that began before the window
            ones += one
        passed = np.zeros_like(passed)
        where = np.flatnonzero(fuzzy)
        if not len(where):
            continue
        before, after = ones[where], ahead[where]
        none, uneven = before == 0, before % 2 == 1
        even = ~none & ~uneven
        single, double = odd[j + 1, where], odd[j + 2, where]
        # Before a 0: a 0, unless ones would be left single, which the next pass repairs.
        zero = ~uneven & (after == 0)
        # Before a run of ones: a 1 where that makes all of them even, else open.
        one_ahead = (after == 1) & (single | uneven)
        # Two fuzzy ones in a row: after a single 1 they are its other half and a 0.
        pair = uneven & (after == _FUZZY)
        # The slip of the firmware: after ones it goes on with the 0 as if it were fuzzy.
        slip = even & zero
        raised = slip & double

        chip[where[zero]] = 0
        chip[where[one_ahead | pair]] = 1
        ahead[where[pair]] = 0
        ahead[where[raised]] = 1
        passed[where] = slip | pair | (none & (after == _FUZZY))
        now = before.copy()
        now[zero | pair] = 0
        now[one_ahead & ~uneven] = 1
        now[one_ahead & uneven] += 1
        now[raised] = 1
        ones[where] = now
    last = chips[CHIPS - 1]
    last[(last == _FUZZY) & ~passed] = 0


def _make_even(chips: Chips) -> None:
    """Tells what fuzzy chips after ones are, and makes the chip before an odd run of ones
    a 1."""
    ones = np.zeros(chips.shape[1], np.uint8)
    for j in range(CHIPS):
        chip = chips[j]
        after = (chip == _FUZZY) & (ones > 0)
        chip[after] = ones[after] & 1
        wrong = np.flatnonzero((chip == 0) & (ones & 1 == 1))
        chips[j - 1 - ones[wrong].astype(np.int64), wrong] = 1
        one = chip == 1
        ones = np.where(one, ones + (j > 0), 0).astype(np.uint8)


def _bits(chips: Chips) -> Bits:
    """64 bits of chips: two for a 1, a fuzzy one that is left for a 0."""
    bits = np.zeros(chips.shape[1], np.uint64)
    place = np.full(chips.shape[1], 63, np.int64)
    # The first is thrown away unless it is a 0.
    passed = chips[0] != 0
    for j in range(CHIPS):
        taken = ~passed & (place >= 0)
        one = taken & (chips[j] == 1)
        bits[one] |= np.uint64(1) << place[one].astype(np.uint64)
        place -= taken
        passed = one
    return bits


def _mismatches(bits: Bits, passed: int, compared: int, polynomials: int) -> NDArray[np.uint8]:
    """(polynomials, n) bits in which ``bits`` differ from what follows their 17 at
    ``passed``, of the ``compared`` after those; only in the lower half, as in the firmware."""
    state = _seventeen(bits, passed)
    number = np.arange(polynomials)[:, None]
    index = lfsr.indices(state, number)
    length = lfsr.BITS + compared
    # The register stays at 0 from 0 on, which has no place in the sequence.
    expected = np.where(state == 0, np.uint64(0), lfsr.bits_at(index, number, length))
    rest = np.uint64(64 - passed - length)
    mask = np.uint64((1 << length) - 1)
    differing = (bits >> rest & mask ^ expected) << rest & _COUNTED
    return np.bitwise_count(differing)


def _seventeen(bits: Bits, passed: ArrayLike) -> NDArray[np.int64]:
    """State of the register after the first ``passed`` bits."""
    shift = np.asarray(64 - lfsr.BITS - np.asarray(passed), np.uint64)
    return (bits >> shift).astype(np.int64) & lfsr.LENGTH
