"""Light that was sampled at a fixed rate, window by window, as a microcontroller's SPI does.

Nothing joins the windows: each is read by its own evidence. Where they were recorded with
their times, :mod:`~locatk.core.lighthouse.demodulation.rotor` finds what they agree on.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import POLYNOMIALS
from locatk.core.lighthouse.demodulation.bursts import bursts_of_windows
from locatk.core.lighthouse.demodulation.identification import SequenceMatches, identify_sequences
from locatk.core.lighthouse.demodulation.soft_bits import soft_bits

BLOCK = 2048
"""Windows at a time: what they need stays in the processor's cache, and in memory that is used
again."""


@dataclass(frozen=True)
class WindowMatches:
    """What windows say.

    Attributes
    ----------
    matches : SequenceMatches
        Polynomial, and index of the first bit, of each.
    start : (n,) float64 ndarray
        When that bit began, in samples from the start of its window; may be below 0,
        and is ``nan`` where a window has no bits.
    """

    matches: SequenceMatches
    start: NDArray[np.float64]


def read_windows(
    windows: NDArray[np.uint8], rate_hz: float = 32e6, polynomials: int = POLYNOMIALS
) -> WindowMatches:
    """Polynomial and index of each window.

    Parameters
    ----------
    windows : (n, w) uint8 ndarray
        A row a window, the first sample in the highest bit of the first byte: with 64 bytes at
        32 MS/s those of the paper (section III).
    rate_hz : float
        Samples a second, 24 million or more.
    polynomials : int
        Only the first so many are tried.

    Raises
    ------
    InputError
        Too low a rate, or not a table of bytes.
    """
    parts, starts = [], []
    for at in range(0, max(len(windows), 1), BLOCK):
        bursts = bursts_of_windows(windows[at : at + BLOCK], rate_hz)
        bits = soft_bits(bursts)
        parts.append(identify_sequences(bits, polynomials))
        begin = bits.tick - 8 * windows.shape[1] * np.arange(len(bits))
        starts.append(np.where(np.diff(bits.first) > 0, begin, np.nan))
    columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(SequenceMatches))
    return WindowMatches(SequenceMatches(*columns), np.concatenate(starts))
