"""Fraction of the frames that the decoder reads, from the dots in view and their errors.

The decoder works or fails within a narrow range of each condition. The limits were measured with
40 rendered frames each of 48 to 188 px, 4 to 30 px per pitch, random poses, and one condition at a
time (blur, motion, noise, jitter of the print, size of the frame).
"""

from __future__ import annotations

import math

from locatk.core.dots.design.dot_noise import PAPER_LEVEL, DotError
from locatk.core.dots.localization.frames import tried_levels

MIN_DOTS, DOTS_SPREAD = 48.0, 3.0
"""Dots of a frame with which half of the frames are read, and the width of the transition.
Measured: 56 dots 95 %, 50 dots 70 %, 40 dots none."""

MAX_SIGMA_PITCHES, SIGMA_SPREAD_PITCHES = 0.092, 0.006
"""Error of a dot per axis with which half of the frames are read. Measured with Gaussian errors of
the print: 0.08 pitches 90 %, 0.10 pitches 25 %."""

MIN_USED_FRACTION, USED_FRACTION_SPREAD = 0.58, 0.03
"""Fraction of the dots within the gates of the solver with which half of the frames are read; the
others are displaced by their neighbours. Measured with blur and motion: 0.70 100 %, 0.65 57 %,
0.54 33 %, 0.42 10 %."""

MIN_SIGNAL_TO_NOISE, SIGNAL_TO_NOISE_SPREAD = 3.1, 0.2
"""Depth of a smoothed dot over the noise with which half of the frames are read; below, minima of
the noise are taken for dots. Measured: 4.1 100 %, 3.3 68 %, 2.6 5 %."""

MIN_PEAK_LEVELS, PEAK_SPREAD_LEVELS = 2.3, 0.25
"""Depth of a smoothed dot in grey values with which half of the frames are read; the detector
ignores minima of less than 1.5. Measured: 3.8 100 %, 1.8 5 %."""

HALF_READ_PX_PER_PITCH, PX_PER_PITCH_SPREAD = 4.0, 0.1
"""Pixels per pitch with which half of the frames are read: the minima of neighbours are then as
near as those that the detector compares. Measured: 4.25 px 100 %, 4 px 57 %, 3.5 px none."""

MAX_BLUR_PITCHES = 0.28
"""Standard deviation of the blur of the lens with which sharp sensors are read. Measured: 0.30 of
the pitch 100 %, 0.35 at most 28 %; 0.27 at a noise of 8 grey values."""

MAX_MOTION_PITCHES = 0.75
"""Motion during the exposure with which frames are read. Measured: 0.8 of the pitch 100 %, 1.0 at
most 50 %."""

MAX_SHEAR = 0.7
"""Shear of a frame by a rolling shutter, the motion from the first to the last row over the height
of the field, with which frames are read. Measured on sheared frames: 0.7 100 %, 1.0 at least 50 %.
The fitted homography contains the shear; the pose is that of the time of the middle row."""

MIN_PX_PER_PITCH = 5.0
"""Pixels per pitch, in the image that is searched, with which frames are read. Measured: 4.5 px
100 %, 4 px 60 %."""


def read_rate(error: DotError, dots: float, pitch_px: float) -> float:
    """Return the expected fraction of frames that are decoded.

    Parameters
    ----------
    error : DotError
    dots : float
        Number of dots in view that are used.
    pitch_px : float
    """
    return math.prod(_logistic(margin) for margin, _ in _conditions(error, dots, pitch_px))


def reading_limit(error: DotError, dots: float, pitch_px: float) -> str:
    """Return the condition that lets fewest frames be read, and its remedy."""
    return min(_conditions(error, dots, pitch_px))[1]


def _conditions(error: DotError, dots: float, pitch_px: float) -> tuple[tuple[float, str], ...]:
    """Return the margin of each condition, in widths of its transition, and its text."""
    sigma_pitches = error.total_px / pitch_px
    signal_to_noise = error.peak / max(error.smoothed_noise, 1e-9)
    peak_levels = PAPER_LEVEL * error.peak
    return (
        (
            (dots - MIN_DOTS) / DOTS_SPREAD,
            f"{dots:.0f} usable dots are in view: raise the lens, or choose a shorter focal length",
        ),
        (
            (MAX_SIGMA_PITCHES - sigma_pitches) / SIGMA_SPREAD_PITCHES,
            f"the error of a dot is {sigma_pitches:.2f} pitches: light the paper more, or use a "
            "better printer",
        ),
        (
            (error.used_fraction - MIN_USED_FRACTION) / USED_FRACTION_SPREAD,
            "neighbouring dots run into each other: blur less, by the f-number, focus and exposure",
        ),
        (
            (signal_to_noise - MIN_SIGNAL_TO_NOISE) / SIGNAL_TO_NOISE_SPREAD,
            f"a dot is {signal_to_noise:.1f} times as deep as the noise: light the paper more",
        ),
        (
            (peak_levels - MIN_PEAK_LEVELS) / PEAK_SPREAD_LEVELS,
            f"a dot is {peak_levels:.1f} grey values deep: blur less, or print darker dots",
        ),
        (
            (pitch_px - HALF_READ_PX_PER_PITCH) / PX_PER_PITCH_SPREAD,
            f"a pitch has {pitch_px:.1f} px: move the lens nearer, or choose a longer focal length",
        ),
    )


def searched_levels(size_px: tuple[int, int]) -> tuple[int, ...]:
    """Return the numbers of halvings of a frame that the decoder tries, in its order.

    It is 0 for frames that are too small for the decoder.
    """
    return tuple(tried_levels(*size_px)) or (0,)


def _logistic(x: float) -> float:
    return 1 / (1 + math.exp(-min(max(x, -500.0), 500.0)))
