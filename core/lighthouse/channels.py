"""The sixteen channels of Lighthouse V2: rotor periods and polynomials.

Figures: Bitcraze crazyflie-firmware ``pulse_processor_v2.c`` and lighthouse-fpga;
confirmed by libsurvive recordings (facts/lighthouse.md 2.1 and 2.2). Two peers have a
wrong period each, for channels 4 and 14.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

CHANNELS = range(1, 17)
"""Channels as the user sees and sets them, from 1; also called modes."""

POLYNOMIALS = 32
TICK_HZ = 48_000_000
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
    """Ticks of 48 MHz in one rotation of each ``channel`` (1 to 16, any shape)."""
    return PERIOD_TICKS[np.asarray(channel) - 1]


def period_counts(channel: ArrayLike) -> NDArray[np.float64]:
    """LFSR steps in one rotation of each ``channel`` (1 to 16, any shape)."""
    return period_ticks(channel) / TICKS_PER_COUNT


def channel_of(polynomial: ArrayLike) -> NDArray[np.int64]:
    """Channel (1 to 16) that sends LFSR ``polynomial`` (0 to 31, any shape)."""
    return (np.asarray(polynomial) >> 1) + 1


def slow_bit_of(polynomial: ArrayLike) -> NDArray[np.int64]:
    """OOTX bit (0 or 1) that a sweep with ``polynomial`` carries."""
    return np.asarray(polynomial) & 1
