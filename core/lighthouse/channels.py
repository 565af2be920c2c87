"""The sixteen channels of Lighthouse V2: rotor periods and LFSR polynomials.

Periods and polynomial numbering: Bitcraze crazyflie-firmware ``pulse_processor_v2.c`` and
lighthouse-fpga ``utils.scala``. Median sync intervals in recordings of libsurvive-extras-data
confirm the periods. Two other implementations have one wrong period each: DotBot-libs for
channel 4 (951000) and dotbot-lh2-calibration for channel 14 (901900).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

CHANNELS = range(1, 17)
"""Channels as the user sees and sets them, from 1. Also called modes."""

POLYNOMIAL_COUNT = 32
"""Number of LFSR polynomials: two per channel, one per value of the slow bit."""

TICK_HZ = 48_000_000
"""Clock of a base station, in which :data:`PERIOD_TICKS` is given."""

TICKS_PER_COUNT = 8
"""One LFSR step (6 MHz) lasts eight ticks of 48 MHz."""

PERIOD_TICKS: NDArray[np.int64] = np.array(
    [
        959000, 957000, 953000, 949000, 947000, 943000, 941000, 939000,
        937000, 929000, 919000, 911000, 907000, 901000, 893000, 887000,
    ]
)  # fmt: skip
"""Ticks of 48 MHz in one rotation, for channels 1 to 16."""


def period_ticks(channel: ArrayLike) -> NDArray[np.int64]:
    """Return the ticks of 48 MHz in one rotation of each ``channel`` (1 to 16, any shape)."""
    return PERIOD_TICKS[np.asarray(channel) - 1]


def period_counts(channel: ArrayLike) -> NDArray[np.float64]:
    """Return the LFSR steps in one rotation of each ``channel`` (1 to 16, any shape)."""
    return period_ticks(channel) / TICKS_PER_COUNT


def channel_of(polynomial: ArrayLike) -> NDArray[np.int64]:
    """Return the channel (1 to 16) that sends LFSR ``polynomial`` (0 to 31, any shape)."""
    return (np.asarray(polynomial) >> 1) + 1


def slow_bit_of(polynomial: ArrayLike) -> NDArray[np.int64]:
    """Return the slow (OOTX) bit, 0 or 1, that a sweep with ``polynomial`` carries."""
    return np.asarray(polynomial) & 1
