"""Analysis of a landmark's geometry: valleys, territory, pitch, sensors, tolerances, warnings.

Everything follows from the closed-form field of the bars; nothing is measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.design.territory import (
    gulf_widths,
    is_equal_corner,
    max_field,
    max_neighbour_field,
    min_pitch_for_field,
    territory_radii,
    threshold_contour,
)
from locatk.core.landmarks.design.valleys import (
    PATTERN_STRENGTHS,
    SAMPLE_PHASE_STEPS,
    VALLEY_COUNTS,
    centre_from_valleys,
    find_valleys,
    fit_lines_over_bars,
    valid_sensor_heights,
)
from locatk.core.landmarks.landmark import PATTERNS, Geometry

Array = NDArray[np.float64]

MAX_NEIGHBOUR_FIELD_T = 15e-6
"""Default limit of the field of a neighbouring landmark at the circle of the sensors: half a
percent of the default threshold, and a third of the Earth's field."""

SENSOR_RANGE_FACTOR = 1.25
"""Required range of the sensors over the largest field, for lower sensors and stronger bars."""

HALL_SENSOR_CLASSES = ((100.0, 0.021), (50.0, 0.042), (25.0, 0.085), (12.5, 0.169))
"""Sensitivity (mV/mT) and range (T) of linear hall sensors at 5 V: Texas Instruments DRV5055 A1 to
A4 (data sheet SBAS640B, section 1)."""

MAX_REMANENCE_T = 2.0
"""Larger values are in another unit; N52 has 1.45 T."""

MAX_VALLEY_OFFSET_RAD = math.radians(15)
"""Distance of a valley from a multiple of 45 degrees up to which the paper's rule recognises it."""

MAX_EARTH_FIELD_T = 65e-6
"""Strongest field of the Earth on its surface."""

WORST_PATTERN = 2
"""Index of landmark 3, NNNS, whose valleys are the most displaced. The radii and tolerances of a
geometry are those of this pattern."""


@dataclass(frozen=True)
class PatternAnalysis:
    """Field of one pattern at the sensors.

    Attributes
    ----------
    number : int
        Number in the paper, 1 to 6.
    letters : str
    expected : int
        Number of valleys by which the pattern is recognised.
    valleys_rad : (n,) ndarray
        Neutral valleys on the circle of the sensors, ascending from x counter-clockwise.
    is_rising : (n,) bool ndarray
        True if the field increases there, counter-clockwise.
    peaks_t : (n,) ndarray
        Largest field, signed, between each valley and the next.
    gulfs_rad : (n,) ndarray
        Angular width of the gulf of the threshold contour at each valley
        (:data:`.territory.GULF_DEPTH_M`).
    r1_m, r2_m : float
        Radii of the quarter discs in which the field exceeds the threshold: r1 between two bars of
        equal sign, r2 of unequal sign; ``nan`` if the pattern has none.
    bias_m : (2,) ndarray
        Centre as estimated by the paper's intersection of valleys (section 3.3); ``nan`` if the
        number of valleys is not the expected one.
    slope_t_per_m : (4,) ndarray
        Slope of the field along each bar, counter-clockwise: that of the line fitted within a
        quarter of the bar's length of its zero.
    zero_m : (4,) ndarray
        Distance from the middle of each bar to that zero, counter-clockwise; ``nan`` without one.
    departure_m : (4,) ndarray
        Largest error of the line within that interval, as a length.
    """

    number: int
    letters: str
    expected: int
    valleys_rad: Array
    is_rising: NDArray[np.bool_]
    peaks_t: Array
    gulfs_rad: Array
    r1_m: float
    r2_m: float
    bias_m: Array
    slope_t_per_m: Array
    zero_m: Array
    departure_m: Array

    @property
    def is_collapsed(self) -> bool:
        """True if valleys have merged, so that the pattern is taken for another one."""
        return len(self.valleys_rad) != self.expected

    @property
    def skew_rad(self) -> float:
        """Largest distance of a valley from the paper's multiples of 45 degrees."""
        offset = self.valleys_rad % (math.pi / 4)
        return float(np.minimum(offset, math.pi / 4 - offset).max(initial=0.0))


@dataclass(frozen=True)
class ToleranceEffect:
    """Effect of one deviation on landmark 3 (NNNS).

    Its radii r1 and r2 and the length of its bias (:class:`PatternAnalysis`), and the largest field
    of any pattern (:class:`LandmarkAnalysis`).
    """

    deviation: str
    r1_m: float
    r2_m: float
    bias_m: float
    largest_t: float


@dataclass(frozen=True)
class LandmarkAnalysis:
    """Properties of a geometry.

    Attributes
    ----------
    geometry : Geometry
    patterns : tuple of PatternAnalysis
        One for each of the six patterns.
    heights_m : (float, float)
        Sensor heights between which all patterns have the valleys by which they are recognised;
        ``nan`` if there are none.
    contour_pitch_m : float
        Pitch at which all sensors of a robot leave one territory before the first enters the next:
        twice the sum of r2 and the circle.
    field_pitch_m : float
        Pitch at which the field of a neighbour at the circle is :attr:`neighbour_t`.
    neighbour_t : float
    largest_t : float
        Largest field of any pattern in the plane of the sensors.
    range_t : float
        Required range of the sensors, by :data:`SENSOR_RANGE_FACTOR`.
    tolerances : tuple of ToleranceEffect
        The first is the design itself.
    """

    geometry: Geometry
    patterns: tuple[PatternAnalysis, ...]
    heights_m: tuple[float, float]
    contour_pitch_m: float
    field_pitch_m: float
    neighbour_t: float
    largest_t: float
    range_t: float
    tolerances: tuple[ToleranceEffect, ...]

    @property
    def r1_m(self) -> float:
        """Radius r1 of landmark 3."""
        return self.patterns[WORST_PATTERN].r1_m

    @property
    def r2_m(self) -> float:
        """Radius r2 of landmark 3."""
        return self.patterns[WORST_PATTERN].r2_m

    @property
    def min_pitch_m(self) -> float:
        """The larger of the two pitches; ``nan`` if the threshold is not reached."""
        return float(np.maximum(self.contour_pitch_m, self.field_pitch_m))

    @property
    def hall_class(self) -> tuple[float, float] | None:
        """Sensitivity in mV/mT and range in T of the most sensitive suitable sensor, or None."""
        return next((item for item in HALL_SENSOR_CLASSES if item[1] >= self.range_t), None)


def check_geometry(geometry: Geometry) -> None:
    """Raise an error for an impossible geometry.

    Raises
    ------
    InputError
        A size is not a positive number, the remanence is in another unit, or bars overlap.
    """
    g = geometry
    for value, quantity in (
        (g.bar_length_m, "length of the bars"),
        (g.bar_width_m, "width of the bars"),
        (g.bar_height_m, "height of the bars"),
        (g.remanence_t, "remanence"),
        (g.radius_m, "radius of the centres of the bars"),
        (g.sensor_height_m, "height of the sensors"),
        (g.circle_m, "circle of the sensors"),
        (g.threshold_t, "threshold"),
    ):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"the {quantity} must be above 0, not {value:g}")
    if g.remanence_t > MAX_REMANENCE_T:
        raise InputError(
            f"no magnet has a remanence of {g.remanence_t:g} T",
            hint="10,000 gauss are 1 tesla; N52 has 1.45",
        )
    min_radius = (g.bar_length_m + g.bar_width_m) / 2
    if g.radius_m < min_radius - 1e-9:
        raise InputError(
            f"the bars overlap at their corners with a radius of {1e3 * g.radius_m:g} mm",
            hint=f"take a radius of at least {1e3 * min_radius:g} mm, or shorter bars",
        )


def analyse_landmark(
    geometry: Geometry, neighbour_t: float = MAX_NEIGHBOUR_FIELD_T
) -> LandmarkAnalysis:
    """Analyse a geometry by the closed-form field of its bars.

    Parameters
    ----------
    geometry : Geometry
    neighbour_t : float
        Accepted field of one neighbouring landmark at the circle of the sensors.

    Raises
    ------
    InputError
        See :func:`check_geometry`.
    """
    check_geometry(geometry)
    patterns = _analyse_patterns(geometry)
    largest = max_field(geometry)
    return LandmarkAnalysis(
        geometry=geometry,
        patterns=patterns,
        heights_m=valid_sensor_heights(geometry),
        contour_pitch_m=2 * (patterns[WORST_PATTERN].r2_m + geometry.circle_m),
        field_pitch_m=min_pitch_for_field(geometry, neighbour_t),
        neighbour_t=neighbour_t,
        largest_t=largest,
        range_t=SENSOR_RANGE_FACTOR * largest,
        tolerances=_tolerance_effects(geometry),
    )


def _analyse_patterns(geometry: Geometry) -> tuple[PatternAnalysis, ...]:
    phi = np.radians(np.arange(360) + SAMPLE_PHASE_STEPS)
    contours = threshold_contour(geometry, PATTERN_STRENGTHS, phi)
    slopes, zeros, departures = fit_lines_over_bars(geometry)
    patterns = []
    for k, letters in enumerate(PATTERNS):
        strengths = PATTERN_STRENGTHS[:, k]
        valleys, is_rising, peaks = find_valleys(geometry, strengths)
        r1, r2 = territory_radii(phi, contours[:, k], strengths)
        nominal = np.where(is_equal_corner(np.degrees(phi), strengths), r1, r2)
        is_complete = len(valleys) == VALLEY_COUNTS[k]
        patterns.append(
            PatternAnalysis(
                number=k + 1,
                letters=letters,
                expected=VALLEY_COUNTS[k],
                valleys_rad=valleys,
                is_rising=is_rising,
                peaks_t=peaks,
                gulfs_rad=gulf_widths(contours[:, k], nominal, valleys),
                r1_m=r1,
                r2_m=r2,
                bias_m=centre_from_valleys(geometry, valleys)
                if is_complete
                else np.full(2, np.nan),
                slope_t_per_m=slopes[k],
                zero_m=zeros[k],
                departure_m=departures[k],
            )
        )
    return tuple(patterns)


_DEVIATIONS: tuple[tuple[str, dict[str, float]], ...] = (
    ("as designed", {}),
    ("sensors 1 mm higher", {"sensor_height_m": 1e-3}),
    ("sensors 1 mm lower", {"sensor_height_m": -1e-3}),
    ("bars 10 % stronger", {"remanence_t": 0.1}),
    ("bars 10 % weaker", {"remanence_t": -0.1}),
    ("bars 1 mm farther out", {"radius_m": 1e-3}),
    ("bars 1 mm longer", {"bar_length_m": 1e-3}),
    ("circle 1 mm wider", {"circle_m": 1e-3}),
)
"""Changes of attributes: lengths absolute, the remanence relative."""


def _tolerance_effects(geometry: Geometry) -> tuple[ToleranceEffect, ...]:
    """Evaluate deviations of one quantity of landmark 3, all others as designed."""
    phi = np.radians(3 * (np.arange(120) + SAMPLE_PHASE_STEPS))
    strengths = PATTERN_STRENGTHS[:, WORST_PATTERN]
    effects = []
    for deviation, changes in _DEVIATIONS:
        values = {
            name: getattr(geometry, name) * (1 + change)
            if name == "remanence_t"
            else max(getattr(geometry, name) + change, 0.0)
            for name, change in changes.items()
        }
        changed = replace(geometry, **values)
        contour = threshold_contour(changed, strengths[:, None], phi)[:, 0]
        r1, r2 = territory_radii(phi, contour, strengths)
        valleys = find_valleys(changed, strengths)[0]
        is_complete = len(valleys) == VALLEY_COUNTS[WORST_PATTERN]
        bias = centre_from_valleys(changed, valleys) if is_complete else np.full(2, np.nan)
        effects.append(
            ToleranceEffect(deviation, r1, r2, float(np.hypot(*bias)), max_field(changed))
        )
    return tuple(effects)


def landmark_warnings(analysis: LandmarkAnalysis) -> Iterator[str]:
    """Yield the problems of a geometry with their figures and remedies."""
    geometry = analysis.geometry
    low, high = analysis.heights_m
    remedy = (
        "no height of the sensors is valid for this circle; take shorter bars"
        if math.isnan(high)
        else f"keep the sensors {_height_range_text(low, high)} above the bars, "
        "or take shorter bars"
    )
    groups: dict[tuple[int, int], list[str]] = {}
    for pattern in analysis.patterns:
        if pattern.is_collapsed:
            key = (len(pattern.valleys_rad), pattern.expected)
            groups.setdefault(key, []).append(pattern.letters)
    for (count, expected), letters in groups.items():
        yield (
            f"the valleys of {_join_words(letters)} collapse to {count} instead of {expected}, so "
            f"that the method `paper` takes them for another pattern; {remedy}"
        )
    skew = max(pattern.skew_rad for pattern in analysis.patterns)
    if not groups and skew > MAX_VALLEY_OFFSET_RAD:
        yield (
            f"valleys are up to {math.degrees(skew):.0f} degrees from the paper's angles, and its "
            f"rule accepts {math.degrees(MAX_VALLEY_OFFSET_RAD):.0f}; {remedy}"
        )
    if math.isnan(analysis.r1_m) or math.isnan(analysis.r2_m):
        yield (
            f"the field does not reach the threshold of {1e3 * geometry.threshold_t:.3g} mT on all "
            "sides of a landmark, or exceeds it beyond ten times its radius; take another threshold"
        )
    elif analysis.r1_m < geometry.circle_m:
        yield (
            f"the territory is smaller than the circle of the sensors: {_mm(analysis.r1_m)} "
            f"against {_mm(geometry.circle_m)}; take a lower threshold or a smaller circle"
        )
    if geometry.threshold_t < 2 * MAX_EARTH_FIELD_T:
        yield (
            f"the threshold of {1e6 * geometry.threshold_t:.3g} uT is less than twice the Earth's "
            f"field, {1e6 * MAX_EARTH_FIELD_T:.0f} uT; take a higher one"
        )
    if analysis.hall_class is None:
        yield (
            f"no common hall sensor has a range of {1e3 * analysis.range_t:.0f} mT; "
            "take sensors farther from the bars, or weaker bars"
        )


def pitch_warnings(analysis: LandmarkAnalysis, pitch_m: float) -> Iterator[str]:
    """Yield the problems of landmarks at a pitch with their figures and remedies."""
    geometry = analysis.geometry
    if pitch_m < analysis.contour_pitch_m:
        yield (
            f"territories overlap at a pitch of {_mm(pitch_m)}: a sensor of the robot enters the "
            "next one before the last has left this one; take at least "
            f"{_mm(_round_up_mm(analysis.contour_pitch_m))}, or a higher threshold"
        )
    nearest, all_eight = (float(field) for field in max_neighbour_field(geometry, pitch_m))
    if nearest > analysis.neighbour_t * (1 + 1e-9):
        remedy = (
            "take weaker bars"
            if math.isnan(analysis.field_pitch_m)
            else f"take at least {_mm(_round_up_mm(analysis.field_pitch_m))}"
        )
        yield (
            f"a neighbour at a pitch of {_mm(pitch_m)} adds up to {1e6 * nearest:.0f} uT at the "
            f"sensors, all eight up to {1e6 * all_eight:.0f} uT; the limit for one is "
            f"{1e6 * analysis.neighbour_t:.0f} uT; {remedy}"
        )


def _round_up_mm(metres: float) -> float:
    """Round a length in metres up to the next whole mm."""
    return math.ceil(1e3 * metres - 1e-6) / 1e3


def _height_range_text(low: float, high: float) -> str:
    high_mm = math.floor(1e4 * high) / 10
    return f"at most {high_mm:g} mm" if low == 0 else f"{1e3 * low:.1f} to {high_mm:g} mm"


def _join_words(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.4g} mm"
