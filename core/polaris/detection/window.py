"""What a fit is given, and what it varies: the samples of a pass, the priors, a state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Window:
    """The samples of one pass.

    Attributes
    ----------
    field_t : (n, N, 3) ndarray
        Tesla; ``nan`` where missing.
    sensors_m : (N, 3) ndarray
        In the array's frame.
    noise_t : (N, 3) ndarray
        Of one sample.
    frames : (n,) ndarray
        Times in sample periods, ascending; their gaps are lost samples.
    counts : (n,) ndarray
        How many samples each is the mean of.
    order : (3,) ndarray
        When each axis is converted: -1, 0 and 1 for first to last, or zeros.
    path_m : (n,) ndarray or None
        How far the array has moved, where that is known.
    thickness_m2 : float
        Of the magnets (:func:`locatk.core.polaris.detection.field_model.thickness`).
    common_t : float
        Standard deviation, in one sample, of a field that all sensors share.
    trends : int
        Terms of each background: 2 are a level and a slope.
    """

    field_t: Array
    sensors_m: Array
    noise_t: Array
    frames: Array
    counts: NDArray[np.intp]
    order: Array
    path_m: Array | None = None
    thickness_m2: float = 0.0
    common_t: float = 0.0
    trends: int = 2


@dataclass(frozen=True)
class Priors:
    """What is known before the samples are looked at; pairs are (mean, standard deviation).

    Attributes
    ----------
    height_m, skew : (float, float)
        Of the sensors over the magnets; between two axes' conversions, in sample periods.
    moment_am2 : float
        Size that is expected of a magnet.
    tilt : float
        By how much of its moment a magnet may point up.
    crab_rad : float
        Between the array's x and its way.
    jitter : float
        Half width of a step's deviation, as a share of the mean step.
    """

    height_m: tuple[float, float] = (0.01, 0.003)
    skew: tuple[float, float] = (0.0, 0.5)
    moment_am2: float = 1.5e-3
    tilt: float = 0.05
    crab_rad: float = 0.009
    jitter: float = 0.3


@dataclass(frozen=True)
class State:
    """One hypothesis of a pass.

    Attributes
    ----------
    place_m : (M, 2) ndarray
    moment_am2 : (M, 3) ndarray
    path_m : (n,) ndarray
    speed_m : float
        Mean step of a sample period.
    height_m, skew, crab_rad : float
        See :class:`Priors`.
    """

    place_m: Array
    moment_am2: Array
    path_m: Array
    speed_m: float
    height_m: float
    skew: float = 0.0
    crab_rad: float = 0.0


def trends(frames: Array, count: int) -> Array:
    """Slow courses (n, count) that a background is made of: Legendre polynomials."""
    time = 2 * (frames - frames[0]) / max(frames[-1] - frames[0], 1.0) - 1
    return np.polynomial.legendre.legvander(time, count - 1)
