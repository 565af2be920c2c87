"""How far the field of a landmark reaches: its territory, its neighbours, its largest value."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.landmarks.design.valleys import ring
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.landmark import Geometry

Array = NDArray[np.float64]

GULF_M = 0.005
"""The paper's tG: a contour that lies deeper inside of its half-disc is in a gulf."""

SECTOR = (15.0, 75.0)
"""Degrees of a quarter over which r1 and r2 are taken; beside it lie the valleys of the bars."""


def contour(geometry: Geometry, strengths: ArrayLike, angles_rad: Array) -> Array:
    """How far out the threshold is met, by angle.

    Parameters
    ----------
    geometry : Geometry
    strengths : (4, m) ndarray
        Signed, of the bars of m landmarks.
    angles_rad : (n,) ndarray

    Returns
    -------
    (n, m) ndarray
        Metres; ``nan`` where the field stays below the threshold.
    """
    radius = geometry.radius_m * np.geomspace(0.4, 10, 110)
    points = ring(radius[:, None], angles_rad)
    excess = np.log(
        np.abs(basis(geometry, points) @ np.asarray(strengths, float)) / geometry.threshold_t
        + 1e-12
    )
    over = excess > 0
    last = len(radius) - 1 - np.argmax(over[::-1], axis=0)
    inner = np.minimum(last, len(radius) - 2)
    a = np.take_along_axis(excess, inner[None], 0)[0]
    b = np.take_along_axis(excess, inner[None] + 1, 0)[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Fields are powers of the distance: straight in logarithms.
        found = radius[inner] * (radius[inner + 1] / radius[inner]) ** (a / (a - b))
    none = ~over.any(axis=0) | (last > len(radius) - 2)
    return np.where(none, np.nan, found)


def radii(angles_rad: Array, contour_m: Array, strengths: Array) -> tuple[float, float]:
    """r1 and r2 of one contour: the circles from which it departs least.

    Of the contour in :data:`SECTOR` of each quarter the mean is the circle of the least
    standard deviation, as the paper wants (section 3.1). The gulf of the valley between
    two equal bars is left out.
    """
    degrees = np.degrees(angles_rad) % 360
    inside = (degrees % 90 >= SECTOR[0]) & (degrees % 90 <= SECTOR[1]) & np.isfinite(contour_m)
    equal = equal_corner(degrees, strengths)
    near, far = contour_m[inside & equal], contour_m[inside & ~equal]
    if len(near):
        near = near[near > np.median(near) - GULF_M]
    return (
        float(near.mean()) if len(near) else math.nan,
        float(far.mean()) if len(far) else math.nan,
    )


def equal_corner(degrees: Array, strengths: Array) -> NDArray[np.bool_]:
    """Whether the two bars of the quarter in which an angle lies are laid alike."""
    alike = np.sign(strengths) == np.sign(np.roll(strengths, -1))
    return np.asarray(alike[(degrees // 90).astype(int) % 4])


def gulfs(contour_m: Array, nominal_m: Array, valleys_rad: Array) -> Array:
    """Widths (n,) of the dents of a contour, sampled evenly round, at each valley.

    ``nan`` where there is no half-disc ``nominal_m`` to be dented.
    """
    count = len(contour_m)
    dented = ~(contour_m >= nominal_m - GULF_M)
    widths = []
    for angle in valleys_rad:
        at = int(angle / (2 * math.pi) * count) % count
        if math.isnan(nominal_m[at]) or math.isnan(nominal_m[at - 1]):
            widths.append(math.nan)
            continue
        ahead = np.roll(dented, -at)
        behind = ahead[::-1]
        most = count // 8  # halfway to the next valley of a bar
        run = [
            int(np.argmin(side[:most])) if not side[:most].all() else most
            for side in (ahead, behind)
        ]
        widths.append(sum(run) * 2 * math.pi / count)
    return np.array(widths)


def largest_field(geometry: Geometry) -> float:
    """Largest field in tesla that any landmark has anywhere in the plane of the sensors."""
    # The patterns together are symmetric: one quarter has it all, and for each place some
    # code adds up the bars.
    side = np.linspace(0, geometry.radius_m + geometry.bar_length_m / 2, 81)
    points = np.stack(np.meshgrid(side, side, indexing="ij"), -1)
    return float(np.abs(basis(geometry, points)).sum(axis=-1).max())


def neighbour_field(geometry: Geometry, pitch_m: ArrayLike) -> tuple[Array, Array]:
    """What neighbours add at the circle of the sensors of a robot over a landmark.

    Parameters
    ----------
    geometry : Geometry
    pitch_m : (...) ndarray

    Returns
    -------
    one, all_eight : (...) ndarray
        Largest field in tesla of the nearest neighbour alone, and of all eight around, each
        laid as is worst.
    """
    pitch = np.asarray(pitch_m, float)[..., None]
    circle = ring(geometry.circle_m, np.radians(3.0 * np.arange(120)))
    worst = []
    for place in ((1.0, 0.0), (1.0, 1.0)):
        points = circle - pitch[..., None] * np.array(place)
        worst.append(np.abs(basis(geometry, points)).sum(axis=-1))
    # A neighbour at another side sees the circle turned by quarters.
    total = sum(np.roll(own, 30 * k, axis=-1) for own in worst for k in range(4))
    return worst[0].max(axis=-1), np.asarray(total).max(axis=-1)


def field_pitch(geometry: Geometry, limit_t: float) -> float:
    """Pitch at which the nearest neighbour adds ``limit_t`` at the circle; ``nan`` for none."""
    least = geometry.radius_m + geometry.circle_m + geometry.bar_length_m / 2
    pitch = np.geomspace(least, 20 * least, 60)
    field = neighbour_field(geometry, pitch)[0]
    over = np.flatnonzero(field > limit_t)
    if not len(over):
        return float(least)
    if over[-1] + 1 == len(pitch):
        return math.nan
    i = over[-1]
    a, b = np.log(field[i : i + 2] / limit_t)
    return float(pitch[i] * (pitch[i + 1] / pitch[i]) ** (a / (a - b)))
