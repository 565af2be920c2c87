"""Neutral valleys of a landmark on the circle of the sensors, and linear fits over its bars.

A neutral valley is a zero of the vertical component of the field on the circle on which the
robot's sensors turn (Neutral Magnetic Valley, section 3.3 of the paper).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.landmarks.field import basis
from locatk.core.landmarks.landmark import PATTERNS, Geometry, code_of, signs

Array = NDArray[np.float64]

VALLEY_COUNTS = (4, 6, 6, 6, 8, 8)
"""Number of valleys of each of :data:`PATTERNS` (section 3.3 of the paper)."""

SAMPLE_PHASE_STEPS = 0.37
"""Offset of the sampled angles, in steps, so that no sample is at an angle of symmetry, where the
field is zero up to rounding and its sign random."""

VALLEY_SAMPLES = 1440
"""Samples of the circle between which valleys are located: a quarter of a degree each."""

VALLEY_BISECTIONS = 24
"""Halvings of the interval of a valley: 0.25 degrees become 3e-10 rad."""

MAX_SENSOR_HEIGHT_RADII = 2.0
"""Heights are searched up to this many radii of the landmark."""

HEIGHT_RESOLUTION_M = 1e-6

PATTERN_STRENGTHS = signs([code_of(letters) for letters in PATTERNS]).T
"""(4, 6) signed strengths of the bars of each pattern."""

_BAR_ANGLES_RAD = np.radians([0.0, 90.0, 180.0, 270.0])


def points_on_circle(radius_m: ArrayLike, angles_rad: ArrayLike) -> Array:
    """Return points (..., 2) at polar coordinates, which broadcast."""
    r, phi = np.broadcast_arrays(np.asarray(radius_m, float), np.asarray(angles_rad, float))
    return np.stack([r * np.cos(phi), r * np.sin(phi)], -1)


def find_valleys(
    geometry: Geometry, strengths: ArrayLike
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Locate the valleys on the circle of the sensors, and the peaks between them.

    Parameters
    ----------
    geometry : Geometry
    strengths : (4,) ndarray
        Signed strengths of the bars.

    Returns
    -------
    valleys_rad : (n,) ndarray
        Ascending, within 1e-9 rad.
    is_rising : (n,) bool ndarray
        True if the field increases there, counter-clockwise.
    peaks_t : (n,) ndarray
        Largest field, signed, between each valley and the next.
    """
    s = np.asarray(strengths, float)
    step = 2 * math.pi / VALLEY_SAMPLES
    phi = step * (np.arange(VALLEY_SAMPLES) + SAMPLE_PHASE_STEPS)
    field = basis(geometry, points_on_circle(geometry.circle_m, phi)) @ s
    before = np.flatnonzero(field * np.roll(field, -1) < 0)
    low, high = phi[before], phi[before] + step
    is_rising = field[before] < 0
    for _ in range(VALLEY_BISECTIONS):
        middle = (low + high) / 2
        points = points_on_circle(geometry.circle_m, middle)
        is_before = (basis(geometry, points) @ s < 0) == is_rising
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    angle = (low + high) / 2
    angle = np.where(angle > 2 * math.pi - 1e-8, 0.0, angle % (2 * math.pi))
    order = np.argsort(angle)
    arcs = _split_circle(field, (before + 1)[order].tolist())
    peaks = [arc[np.argmax(np.abs(arc))] for arc in arcs]
    return angle[order], is_rising[order], np.array(peaks)


def _split_circle(field: Array, starts: list[int]) -> list[Array]:
    """Split samples of the circle at ``starts``; a start may be the end of the circle."""
    ends = starts[1:] + starts[:1]
    n = len(field)
    return [
        np.take(field, np.arange(a, b if b > a else b + n), mode="wrap")
        for a, b in zip(starts, ends, strict=True)
    ]


def centre_from_valleys(geometry: Geometry, valleys_rad: Array) -> Array:
    """Estimate the centre (2,) as the intersection of two lines through opposite valleys.

    The four valleys are those next to the bars: labels 1', 2', 4', 6' of landmarks 2 and 3; 1',
    3', 4', 6' of landmark 4; four that are not adjacent of landmarks 5 and 6 (section 3.3 and
    Fig. 6 of the paper).
    """
    offset = np.angle(np.exp(1j * (valleys_rad[:, None] - _BAR_ANGLES_RAD)))
    nearest = valleys_rad[np.argmin(np.abs(offset), axis=0)]
    a, b, c, d = points_on_circle(geometry.circle_m, nearest)
    sides = np.column_stack([c - a, b - d])
    along: Array = np.linalg.solve(sides, b - a)
    return np.asarray(a + along[0] * (c - a))


def valid_sensor_heights(geometry: Geometry) -> tuple[float, float]:
    """Return the lowest interval of sensor heights at which each pattern has its valleys.

    Heights are measured from the top faces of the bars; the limits are within
    :data:`HEIGHT_RESOLUTION_M`, ``nan`` if there is no such height.
    """
    grid = np.linspace(0, MAX_SENSOR_HEIGHT_RADII * geometry.radius_m, 51)
    is_valid = _has_all_valleys(geometry, grid)
    if not is_valid.any():
        return math.nan, math.nan
    first = int(np.argmax(is_valid))
    after = (
        int(np.argmin(is_valid[first:])) + first if not is_valid[first:].all() else len(grid) - 1
    )

    def bisect(valid: float, invalid: float) -> float:
        while abs(valid - invalid) > HEIGHT_RESOLUTION_M:
            middle = (valid + invalid) / 2
            if _has_all_valleys(geometry, middle).all():
                valid = middle
            else:
                invalid = middle
        return valid

    low = 0.0 if first == 0 else bisect(grid[first], grid[first - 1])
    return float(low), float(bisect(grid[after - 1], grid[after]))


def _has_all_valleys(geometry: Geometry, heights_m: ArrayLike) -> NDArray[np.bool_]:
    """Return for each height (n,) whether all six patterns have their valleys."""
    phi = np.radians(0.5 * (np.arange(720) + SAMPLE_PHASE_STEPS))
    heights = np.atleast_1d(np.asarray(heights_m, float))
    points = points_on_circle(geometry.circle_m, phi)
    field = basis(geometry, points, heights[:, None]) @ PATTERN_STRENGTHS
    counts = (field * np.roll(field, -1, axis=1) < 0).sum(axis=1)
    return np.asarray((counts == VALLEY_COUNTS).all(axis=-1))


def fit_lines_over_bars(geometry: Geometry) -> tuple[Array, Array, Array]:
    """Fit lines to the field over each bar, as in :class:`.analysis.PatternAnalysis`.

    Returns
    -------
    slope_t_per_m, zero_m, departure_m : (6, 4) ndarray
        By pattern and bar.
    """
    half, quarter = geometry.bar_length_m / 2, geometry.bar_length_m / 4
    along = np.linspace(-2 * half, 2 * half, 401)
    outward = points_on_circle(1.0, _BAR_ANGLES_RAD)
    forward = points_on_circle(1.0, _BAR_ANGLES_RAD + math.pi / 2)
    points = geometry.circle_m * outward + along[:, None, None] * forward
    field = basis(geometry, points) @ PATTERN_STRENGTHS
    result = np.full((3, len(PATTERNS), 4), np.nan)
    interval = np.linspace(-quarter, quarter, 61)
    for bar in range(4):
        for k, profile in enumerate(field[:, bar].T):
            signed = profile * np.sign(PATTERN_STRENGTHS[bar, k])
            # Counter-clockwise the field rises over an N bar; far from it, towards its poles, it
            # falls.
            zeros = np.flatnonzero(
                (signed[:-1] < 0) & (signed[1:] >= 0) & (np.abs(along[1:]) < half)
            )
            if not len(zeros):
                continue
            i = zeros[np.argmin(np.abs(along[zeros]))]
            fraction = profile[i] / (profile[i] - profile[i + 1])
            zero = along[i] + fraction * (along[i + 1] - along[i])
            value = np.interp(zero + interval, along, profile)
            slope = (value @ interval) / (interval @ interval)
            result[:, k, bar] = slope, zero, np.abs(value / slope - interval).max()
    return result[0], result[1], result[2]
