"""Samples of one pass, prepared for the fit.

Samples between which the field has not changed are averaged: a robot that drives slowly or rests
gives more samples than the field needs. The time axis counts sample periods; if the robot may have
rested, a second time axis without the rests is an alternative hypothesis.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.field_model import disc_correction
from locatk.core.polaris.preprocessing import PassRange
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

DEFAULT_HEIGHTS_M = (0.005, 0.0075, 0.011, 0.016)
"""Heights over the magnets that are tried if no tag states its clearance [m]. The matched filter
tolerates a height that is wrong by a quarter."""

DEFAULT_MOMENT_AM2 = 1.5e-3
"""Moment expected of a magnet if no tag states one: a disc of 2 x 0.5 mm with a
remanence of 1.2 T [A m^2]."""

HEIGHT_SIGMA_FRACTION = 0.3
"""Standard deviation of the height over the magnets, relative to the expected one."""

SKEW_SIGMA_PERIODS = 0.3
"""Standard deviation of the time between the conversions of two axes, in sample periods."""

MAX_UNGROUPED_SAMPLES = 120
"""A pass of at most as many samples is not averaged."""

MAX_GROUPS = 320
"""Maximum number of averaged samples of a pass; it bounds the time of a fit."""

MIN_CHANGE_SIGMAS = 3.5
"""Change of the field that begins a new group, in standard deviations of the sum of squares over
the bar that noise alone gives."""

CHANGE_LIMIT_FACTOR = 1.5
"""Factor by which that limit is raised until there are few enough groups."""

MIN_REST_SAMPLES = 12
"""Number of samples in a group, or missing in a row, from which the array may have rested."""

MIN_SEPARATION_FRACTION = 0.5
"""Least distance of two magnets of a tag relative to the spacing of its cells; relative to the
height if no tag is given."""

MAX_SOURCES_WITHOUT_TAG = 12
"""Maximum number of magnets and other sources in a pass if no tag is given."""

LEVEL_SAMPLES = 8
"""Maximum number of samples at an end of a pass of which the median is the level there."""

EFFORT_PER_SOURCE_SQUARE = 2.5e5
"""Work that a pass may take, in samples times unknowns of all iterations, by the square of the
number of sources that it may hold: an iteration takes longer with each source, and each is searched
for. It is less than a second of a processor for a tag of five magnets, and three for thirteen. A
hundred sources under a bar in a cluttered hall would take minutes."""


@dataclass
class Effort:
    """Work spent on one pass; it limits the time by a count, so that results do not depend on it.

    Attributes
    ----------
    spent, limit : float
        In samples times unknowns.
    """

    spent: float = 0.0
    limit: float = EFFORT_PER_SOURCE_SQUARE * MAX_SOURCES_WITHOUT_TAG**2

    @property
    def is_exhausted(self) -> bool:
        """True if no fit should begin."""
        return self.spent >= self.limit

    def affordable_iterations(self, work: float) -> int:
        """Return the number of iterations of the given work that are left; at least one."""
        return max(1, int((self.limit - self.spent) / max(work, 1.0)))


@dataclass(frozen=True)
class PassWindow:
    """Averaged samples of one pass.

    Attributes
    ----------
    field_t : (n, N, 3) ndarray
        Field [T]; ``nan`` if missing.
    sensors_m : (N, 3) ndarray
        Positions of the sensors in the array's frame.
    noise_t : (N, 3) ndarray
        Standard deviation of one sample [T].
    time_periods : (n,) ndarray
        Times in sample periods, ascending; gaps are missing samples.
    counts : (n,) ndarray
        Number of samples in each average.
    axis_order : (3,) ndarray
        Conversion order of the axes: -1, 0 and 1 from first to last, or zeros.
    path_m : (n,) ndarray or None
        Distance that the array has moved; None if unknown.
    disc_correction_m2 : float
        Of the magnets (:func:`~locatk.core.polaris.detection.field_model.disc_correction`).
    common_t : float
        Standard deviation, in one sample, of a field that all sensors share [T].
    trend_terms : int
        Terms of each sensor's background: 2 are a level and a slope.
    effort : Effort
        Shared by all fits of the pass.
    """

    field_t: Array
    sensors_m: Array
    noise_t: Array
    time_periods: Array
    counts: NDArray[np.intp]
    axis_order: Array
    path_m: Array | None = None
    disc_correction_m2: float = 0.0
    common_t: float = 0.0
    trend_terms: int = 2
    effort: Effort = field(default_factory=Effort)


@dataclass(frozen=True)
class PassPriors:
    """Knowledge before the samples of a pass are used; pairs are (mean, standard deviation).

    Attributes
    ----------
    height_m : (float, float)
        Height of the sensors over the magnets.
    skew_periods : (float, float)
        Time between the conversions of two axes, in sample periods.
    moment_am2 : float
        Expected magnitude of a magnet's moment.
    tilt_sigma : float
        Vertical part of a magnet's moment, relative to its magnitude (standard deviation).
    crab_sigma_rad : float
        Standard deviation of the angle between the array's x axis and its path.
    jitter_fraction : float
        Half width of the distribution of a step's length, relative to the mean step.
    """

    height_m: tuple[float, float] = (0.01, 0.003)
    skew_periods: tuple[float, float] = (0.0, 0.5)
    moment_am2: float = 1.5e-3
    tilt_sigma: float = 0.05
    crab_sigma_rad: float = 0.009
    jitter_fraction: float = 0.3


@dataclass(frozen=True)
class PreparedPass:
    """Pass that is ready to be fitted.

    Attributes
    ----------
    window : PassWindow
        One entry per group of samples.
    scaled : (G, 3 N) ndarray
        Fields in units of a sample's noise, minus the straight line through both ends.
    priors : tuple of PassPriors
        One for each height to try.
    first : int
        Index in the recording of the pass's first sample.
    group_index : (G,) ndarray
        Mean index of the samples of each group, counted from ``first``.
    sample_count : int
        Number of samples of the pass.
    path_m : (sample_count,) ndarray or None
        Distance that the array has moved at each sample; None if unknown.
    min_separation_m : float
        Least distance of two magnets.
    max_sources : int
        Maximum number of magnets and other sources.
    """

    window: PassWindow
    scaled: Array
    priors: tuple[PassPriors, ...]
    first: int
    group_index: Array
    sample_count: int
    path_m: Array | None
    min_separation_m: float
    max_sources: int


def prepare_pass(
    samples: Samples,
    part: PassRange,
    noise_t: Array,
    tags: Tags | None,
    path_m: Array | None = None,
) -> PreparedPass:
    """Average the samples of a pass, and derive the priors of its fit.

    Parameters
    ----------
    samples : Samples
    part : PassRange
    noise_t : (N, 3) ndarray
        Standard deviation of one sample [T].
    tags : Tags or None
        Their clearance, magnet and spacing become priors; defaults are used without.
    path_m : (n,) ndarray, optional
        Distance that the array had moved at each sample of the recording.
    """
    rows = slice(part.first, part.stop)
    field = samples.field_t[rows]
    period_ns = sample_period_ns(samples)
    time = (samples.time_ns[rows] - samples.time_ns[part.first]) / period_ns
    starts = _group_starts(np.nan_to_num(field / noise_t).reshape(len(field), -1))
    counts = np.diff(np.append(starts, len(field)))
    # A group lacks a sensor only if all its samples do.
    is_finite = np.isfinite(field)
    finite_counts = np.add.reduceat(is_finite, starts, axis=0, dtype=float)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(is_finite, field, 0.0), starts, axis=0) / finite_counts

    def group_means(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts) / counts)

    delay = samples.array.delay_s
    middle, half = (delay.max() + delay.min()) / 2, np.ptp(delay) / 2
    magnet = None if tags is None else tags.magnet
    # Twice the magnets of a tag (two tags in one pass), and some iron.
    max_sources = MAX_SOURCES_WITHOUT_TAG if tags is None else 2 * tags.magnets + 4
    window = PassWindow(
        field_t=means,
        sensors_m=samples.array.position_m,
        noise_t=noise_t,
        time_periods=group_means(time),
        counts=counts,
        axis_order=(delay - middle) / half if half > 0 else np.zeros(3),
        path_m=None if path_m is None else group_means(path_m[rows]),
        disc_correction_m2=disc_correction(magnet),
        effort=Effort(limit=EFFORT_PER_SOURCE_SQUARE * max_sources**2),
    )
    heights = DEFAULT_HEIGHTS_M if tags is None else (tags.clearance_m,)
    priors = tuple(
        PassPriors(
            height_m=(height, HEIGHT_SIGMA_FRACTION * height),
            skew_periods=(half * 1e9 / period_ns, SKEW_SIGMA_PERIODS),
            moment_am2=DEFAULT_MOMENT_AM2 if magnet is None else magnet.moment,
        )
        for height in heights
    )
    length = heights[0] if tags is None else tags.spacing_m
    return PreparedPass(
        window=window,
        scaled=_subtract_line(means / noise_t),
        priors=priors,
        first=part.first,
        group_index=group_means(np.arange(len(field), dtype=float)),
        sample_count=len(field),
        path_m=None if path_m is None else path_m[rows],
        min_separation_m=MIN_SEPARATION_FRACTION * length,
        max_sources=max_sources,
    )


def sample_period_ns(samples: Samples) -> float:
    """Return the usual time between samples [ns]; the mean if a host stamped many at once."""
    median = float(np.median(np.diff(samples.time_ns)))
    mean = float(samples.time_ns[-1] - samples.time_ns[0]) / (len(samples) - 1)
    return median if median > 0.2 * mean else mean


def _group_starts(scaled: Array) -> NDArray[np.intp]:
    """Return the first samples of groups in which the field does not change.

    ``scaled`` (n, C) is in units of the noise.
    """
    n, channels = scaled.shape
    if n <= MAX_UNGROUPED_SAMPLES:
        return np.arange(n)
    limit = channels + MIN_CHANGE_SIGMAS * np.sqrt(2 * channels)
    while True:
        starts = [0]
        for k in range(1, n):
            change = scaled[k] - scaled[starts[-1]]
            if change @ change / 2 > limit:
                starts.append(k)
        if len(starts) <= MAX_GROUPS:
            return np.array(starts)
        limit *= CHANGE_LIMIT_FACTOR


def _subtract_line(scaled: Array) -> Array:
    """Return samples (n, 3 N) minus the straight line through both ends; 0 if missing."""
    n = len(scaled)
    flat = np.nan_to_num(scaled.reshape(n, -1))
    ends = max(1, min(LEVEL_SAMPLES, n // 10))
    left, right = np.median(flat[:ends], axis=0), np.median(flat[-ends:], axis=0)
    fraction = np.linspace(0, 1, n)[:, None]
    level = flat - (1 - fraction) * left - fraction * right
    return np.where(np.isfinite(scaled.reshape(n, -1)), level, 0)


def begin_at_level(prepared: PreparedPass) -> PreparedPass:
    """Return a pass whose scaled fields are relative to its first samples alone.

    It is meant for a pass that has not ended: its last samples hold the field of magnets.
    """
    window = prepared.window
    ends = max(1, int(np.searchsorted(np.cumsum(window.counts), LEVEL_SAMPLES, "right")))
    flat = (window.field_t / window.noise_t).reshape(len(window.field_t), -1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # A sensor without a sample there.
        level = np.nan_to_num(np.nanmedian(flat[:ends], axis=0))
    return replace(prepared, scaled=np.nan_to_num(flat - level))


def time_hypotheses(prepared: PreparedPass) -> Iterator[PreparedPass]:
    """Yield the pass as it is; then, if the array may have rested, with the rests cut out.

    A rest shows as a large group of equal samples, or as a long gap in the recording.
    """
    yield prepared
    window = prepared.window
    if window.path_m is not None:
        return
    is_rest = window.counts >= MIN_REST_SAMPLES
    is_rest[[0, -1]] = False
    rest = np.where(is_rest, window.counts - 1.0, 0.0)
    gap = np.diff(window.time_periods) - (window.counts[1:] + window.counts[:-1]) / 2
    gap = np.where(gap > MIN_REST_SAMPLES, gap, 0.0)
    if is_rest.any() or gap.any():
        rested = np.cumsum(rest) - rest / 2 + np.append(0.0, np.cumsum(gap))
        yield replace(prepared, window=replace(window, time_periods=window.time_periods - rested))


def trend_basis(time_periods: Array, terms: int) -> Array:
    """Return the slow functions of time (n, terms) that a background consists of.

    They are Legendre polynomials over the duration of the pass.
    """
    duration = max(time_periods[-1] - time_periods[0], 1.0)
    time = 2 * (time_periods - time_periods[0]) / duration - 1
    return np.polynomial.legendre.legvander(time, terms - 1)
