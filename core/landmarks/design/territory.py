"""Extent of the field of a landmark: its territory, its largest value, the field at neighbours.

The territory is the area in which a sensor measures more than the threshold. In the paper (section
3.1) it consists of quarter discs: of radius r1 between two equal bars, and r2 between unequal ones.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.landmarks.design.valleys import points_on_circle
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.landmark import Geometry

Array = NDArray[np.float64]

GULF_DEPTH_M = 0.005
"""The paper's tG: a contour that is deeper inside its quarter disc is in a gulf."""

SECTOR_DEG = (15.0, 75.0)
"""Part of a quarter over which r1 and r2 are averaged; outside are the valleys of the bars."""

CONTOUR_RADII = (0.4, 10.0)
"""Radii between which the contour is searched, relative to that of the bars."""

CONTOUR_SAMPLES = 110

MAX_PITCH_FACTOR = 20.0
"""Pitches are searched up to this many times the smallest possible one."""


def threshold_contour(geometry: Geometry, strengths: ArrayLike, angles_rad: Array) -> Array:
    """Return the outermost radius at which the field has the threshold, by angle.

    Parameters
    ----------
    geometry : Geometry
    strengths : (4, m) ndarray
        Signed strengths of the bars of m landmarks.
    angles_rad : (n,) ndarray

    Returns
    -------
    (n, m) ndarray
        In metres; ``nan`` where the field stays below the threshold or does not fall below it.
    """
    radius = geometry.radius_m * np.geomspace(*CONTOUR_RADII, CONTOUR_SAMPLES)
    points = points_on_circle(radius[:, None], angles_rad)
    field = np.abs(basis(geometry, points) @ np.asarray(strengths, float))
    excess = np.log(field / geometry.threshold_t + 1e-12)
    is_above = excess > 0
    last = len(radius) - 1 - np.argmax(is_above[::-1], axis=0)
    inner = np.minimum(last, len(radius) - 2)
    a = np.take_along_axis(excess, inner[None], 0)[0]
    b = np.take_along_axis(excess, inner[None] + 1, 0)[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        # The field is nearly a power of the distance, a line in logarithms.
        contour = radius[inner] * (radius[inner + 1] / radius[inner]) ** (a / (a - b))
    is_missing = ~is_above.any(axis=0) | (last > len(radius) - 2)
    return np.where(is_missing, np.nan, contour)


def territory_radii(angles_rad: Array, contour_m: Array, strengths: Array) -> tuple[float, float]:
    """Return r1 and r2: mean radii of a contour in quarters between equal and unequal bars.

    The paper (section 3.1) takes the circle of least standard deviation, which is this mean. Only
    the middle of each quarter (:data:`SECTOR_DEG`) counts, without the gulf between equal bars.
    ``nan`` if there is no such quarter.
    """
    degrees = np.degrees(angles_rad) % 360
    in_sector = (degrees % 90 >= SECTOR_DEG[0]) & (degrees % 90 <= SECTOR_DEG[1])
    in_sector &= np.isfinite(contour_m)
    is_equal = is_equal_corner(degrees, strengths)
    equal, unequal = contour_m[in_sector & is_equal], contour_m[in_sector & ~is_equal]
    if len(equal):
        equal = equal[equal > np.median(equal) - GULF_DEPTH_M]
    return (
        float(equal.mean()) if len(equal) else math.nan,
        float(unequal.mean()) if len(unequal) else math.nan,
    )


def is_equal_corner(degrees: Array, strengths: Array) -> NDArray[np.bool_]:
    """Return whether the two bars of the quarter that contains an angle have the same sign."""
    is_equal = np.sign(strengths) == np.sign(np.roll(strengths, -1))
    return np.asarray(is_equal[(degrees // 90).astype(int) % 4])


def gulf_widths(contour_m: Array, nominal_m: Array, valleys_rad: Array) -> Array:
    """Return the angular widths (n,) of the gulfs of a contour at each valley, in rad.

    The contour is sampled evenly over the circle. ``nan`` without a quarter disc ``nominal_m``.
    """
    count = len(contour_m)
    is_gulf = ~(contour_m >= nominal_m - GULF_DEPTH_M)
    max_run = count // 8  # Halfway to the next valley of a bar.
    widths = []
    for angle in valleys_rad:
        index = int(angle / (2 * math.pi) * count) % count
        if math.isnan(nominal_m[index]) or math.isnan(nominal_m[index - 1]):
            widths.append(math.nan)
            continue
        ahead = np.roll(is_gulf, -index)
        run = [
            int(np.argmin(side[:max_run])) if not side[:max_run].all() else max_run
            for side in (ahead, ahead[::-1])
        ]
        widths.append(sum(run) * 2 * math.pi / count)
    return np.array(widths)


def max_field(geometry: Geometry) -> float:
    """Return the largest field in tesla of any landmark in the plane of the sensors."""
    # The set of all patterns is symmetric, so that one quarter is enough; at each point there is a
    # pattern whose bars add up.
    side = np.linspace(0, geometry.radius_m + geometry.bar_length_m / 2, 81)
    points = np.stack(np.meshgrid(side, side, indexing="ij"), -1)
    return float(np.abs(basis(geometry, points)).sum(axis=-1).max())


def max_neighbour_field(geometry: Geometry, pitch_m: ArrayLike) -> tuple[Array, Array]:
    """Return the field of neighbouring landmarks at the sensors of a robot over a landmark.

    Parameters
    ----------
    geometry : Geometry
    pitch_m : (...) ndarray

    Returns
    -------
    nearest_t, all_eight_t : (...) ndarray
        Largest field of the nearest neighbour alone, and of all eight neighbours, for the worst
        patterns.
    """
    pitch = np.asarray(pitch_m, float)[..., None]
    circle = points_on_circle(geometry.circle_m, np.radians(3.0 * np.arange(120)))
    worst = []
    for direction in ((1.0, 0.0), (1.0, 1.0)):
        points = circle - pitch[..., None] * np.array(direction)
        worst.append(np.abs(basis(geometry, points)).sum(axis=-1))
    # The circle is rotated by quarter turns for the neighbours on the other sides.
    total = sum(np.roll(field, 30 * k, axis=-1) for field in worst for k in range(4))
    return worst[0].max(axis=-1), np.asarray(total).max(axis=-1)


def min_pitch_for_field(geometry: Geometry, limit_t: float) -> float:
    """Return the smallest pitch from which the nearest neighbour adds no more than ``limit_t``.

    At least the smallest possible pitch; ``nan`` if there is none up to :data:`MAX_PITCH_FACTOR`.
    """
    smallest = geometry.radius_m + geometry.circle_m + geometry.bar_length_m / 2
    pitch = np.geomspace(smallest, MAX_PITCH_FACTOR * smallest, 60)
    field = max_neighbour_field(geometry, pitch)[0]
    above = np.flatnonzero(field > limit_t)
    if not len(above):
        return float(smallest)
    if above[-1] + 1 == len(pitch):
        return math.nan
    i = above[-1]
    a, b = np.log(field[i : i + 2] / limit_t)
    return float(pitch[i] * (pitch[i + 1] / pitch[i]) ** (a / (a - b)))
