"""Where a rotor stood at each moment, from the syncs that a tracker decoded.

A sync (``Y``) is when a rotor was at its zero, as the tracker's hardware computed it from
the bits of a sweep: to some ticks, sometimes late, missing or wrong. libsurvive subtracts the
last one from a sweep's timecode and divides by the last interval (``survive_process_gen2.c``).
Here a line through all of them decides which belong to the rotor. But rotors do not turn
evenly: their control loop lets them run ahead and fall behind by 10 to 20 ticks (0.1 mrad)
within a few rotations. So the zeros are not put on the line but left where they were seen,
smoothed over five rotations, and a sweep's turn is told by the zeros before and after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.demodulation.ootx import UNKNOWN

Array = NDArray[np.float64]

PPM_LIMIT = 300.0
"""By how much a rotation may differ from nominal: resonators of station and tracker."""

LAGS = 3
STEPS = 5
"""A sync and the next three, where they are up to five rotations apart, tell the length of
one."""

WINDOW = 500
"""Rotations in which the phase is sought at once."""

BINS = 64

OFF_TICKS = 400.0
"""A sync further than this from its window's phase is not of the rotor."""

LEAST = 4

JUMP_TICKS = 100.0
"""A sync further than this from the median of its neighbours is wrong."""

SMOOTH = np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0
"""Weights of a parabola through five rotations, at its middle (Savitzky and Golay 1964)."""

HOLD = 50
"""Rotations after the last sync, or before the next, for which a rotor is known."""

GAP = 600
"""Longer gaps than a frame of factory data are of this many unknown bits."""


@dataclass(frozen=True)
class TrackerRotor:
    """One station's rotor, by one tracker's counter.

    Attributes
    ----------
    period : float
        Mean length of a rotation in ticks.
    zero : (n,) float64 ndarray
        Ticks at which it was at its zero, ascending.
    number : (n,) int64 ndarray
        Rotation of each.
    bit : (n,) int8 ndarray
        Slow bit of each; -1 where two syncs differ.
    rejected : int
        Syncs that were not of this rotor.
    """

    period: float
    zero: Array
    number: NDArray[np.int64]
    bit: NDArray[np.int8]
    rejected: int

    def turns(self, tick: Array) -> tuple[Array, NDArray[np.int64]]:
        """Turn since the rotor's zero, 0 to 1, and slow bit, at each of ``tick`` (n,).

        The turn is ``nan`` where no sync was near, the bit then and of rotations without
        sync -1.
        """
        here = np.searchsorted(self.zero, tick, "right") - 1
        before = np.clip(here, 0, len(self.zero) - 2)
        zero, number = self.zero, self.number
        length = (zero[before + 1] - zero[before]) / (number[before + 1] - number[before])
        outside = (here < 0) | (here >= len(zero) - 1)
        near = np.clip(here, 0, len(zero) - 1)
        turn = (tick - zero[near]) / np.where(outside, self.period, length)
        gap = np.minimum(
            np.abs(tick - zero[near]), np.abs(zero[np.minimum(near + 1, len(zero) - 1)] - tick)
        )
        known = gap < HOLD * self.period
        whole = np.floor(turn)
        bit = np.where(known & (whole == 0), self.bit[near], UNKNOWN)
        return np.where(known, turn - whole, np.nan), bit.astype(np.int64)

    def bits(self) -> NDArray[np.int8]:
        """Slow bits, one a rotation, -1 where it was missed."""
        step = np.minimum(np.diff(self.number, prepend=self.number[:1]), GAP)
        place = np.cumsum(step)
        bits = np.full(int(place[-1]) + 1, UNKNOWN, np.int8)
        bits[place] = self.bit
        return bits


def fit_rotor(tick: Array, bit: NDArray[np.int32], nominal: float) -> TrackerRotor | None:
    """Find the rotor that most syncs of one channel agree on.

    Parameters
    ----------
    tick : (n,) float64 ndarray
        Unwrapped ticks of the syncs, in any order.
    bit : (n,) int ndarray
        Slow bit of each, 0 or 1.
    nominal : float
        Length of a rotation in ticks, of the channel.

    Returns
    -------
    TrackerRotor or None
        None where fewer than four syncs agree.
    """
    order = np.argsort(tick, kind="stable")
    base = float(tick[order[0]]) if len(tick) else 0.0
    x, bit = tick[order] - base, bit[order]
    length = _rotation(x, nominal)
    if length is None:
        return None
    number, off = _number(x, length)
    good = np.abs(off) * length < OFF_TICKS
    if np.count_nonzero(good) < LEAST:
        return None
    good &= _steady(x - number * length, good)
    kept = np.flatnonzero(good)
    kept, bit = _once(kept, number, bit)
    later = np.diff(np.maximum.accumulate(x[kept]), prepend=-1.0) > 0
    kept = kept[later]
    if len(kept) < LEAST:
        return None
    number = number[kept]
    line = np.polyfit(number, x[kept], 1)
    wander = _smoothed(x[kept] - np.polyval(line, number), number)
    zero = base + np.polyval(line, number) + wander
    rejected = len(tick) - int(np.count_nonzero(good))
    return TrackerRotor(float(line[0]), zero, number, bit[kept].astype(np.int8), rejected)


def _rotation(x: Array, nominal: float) -> float | None:
    """Length of a rotation from syncs that follow each other."""
    # Beyond the next one too: those of a second rotor, or wrong ones, may lie between.
    step = np.concatenate([x[lag:] - x[:-lag] for lag in range(1, LAGS + 1)])
    count = np.rint(step / nominal)
    near = (count >= 1) & (count <= STEPS)
    length = step[near] / count[near]
    length = length[np.abs(length / nominal - 1) < PPM_LIMIT * 1e-6]
    if len(length) < LEAST - 1:
        return None
    middle = np.median(length)
    return float(np.mean(length[np.abs(length - middle) < JUMP_TICKS]))


def _number(x: Array, length: float) -> tuple[NDArray[np.int64], Array]:
    """Rotation of each sync, and by how much of a turn it is off its window's phase."""
    turn = x / length
    window = (turn // WINDOW).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    phases = np.array([_phase(part % 1.0) for part in np.split(turn, starts[1:])])
    size = np.diff(np.append(starts, len(x)))
    # A window with a few wrong syncs must not turn the others: only well-filled ones lead.
    full = size >= min(max(LEAST, int(np.median(size)) // 4), size.max())
    middle = window[starts].astype(float)
    smooth = np.interp(middle, middle[full], np.unwrap(phases[full], period=1.0))
    phase = np.repeat(smooth, size)
    number = np.rint(turn - phase)
    return number.astype(np.int64), turn - phase - number


def _phase(part: Array) -> float:
    """Where in the turn most syncs are."""
    counted = np.bincount((part * BINS).astype(np.int64) % BINS, minlength=BINS)
    centre = (np.argmax(counted + np.roll(counted, -1)) + 1) / BINS
    off = (part - centre + 0.5) % 1.0 - 0.5
    return float(centre + np.median(off[np.abs(off) <= 1.01 / BINS]))


def _steady(residual: Array, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which syncs are near the median of the five about them."""
    kept = np.flatnonzero(good)
    padded = np.pad(residual[kept], 2, mode="edge")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    steady = np.zeros(len(residual), bool)
    steady[kept] = np.abs(residual[kept] - middle) < JUMP_TICKS
    return steady


def _once(
    kept: NDArray[np.int64], number: NDArray[np.int64], bit: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """One sync a rotation; where two are of one, the bit is unknown if they differ."""
    first, inverse = np.unique(number[kept], return_index=True, return_inverse=True)[1:]
    differ = np.unique(kept[first][inverse[bit[kept] != bit[kept[first]][inverse]]])
    bit = bit.copy()
    bit[differ] = UNKNOWN
    return kept[first], bit


def _smoothed(wander: Array, number: NDArray[np.int64]) -> Array:
    """Wander smoothed where the two rotations before and after are there too."""
    if len(wander) < len(SMOOTH):
        return wander
    smooth = wander.copy()
    whole = number[4:] - number[:-4] == 4
    smooth[2:-2][whole] = np.convolve(wander, SMOOTH, "valid")[whole]
    return smooth
