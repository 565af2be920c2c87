"""The paper's first step (section 3.2): circles through entries, and which of them to keep.

All functions work on whole batches of passes: leading axes are free. Which rule holds:

- ``literal``: with more than two entries, centres outside the convex hull of the entries
  are dropped; with two, those on the robot's side of them.
- ``corrected``, the default: the hull only where every sensor has seen the landmark.
  Where two neighbouring lines of sensors hit, the true centre lies outside of the hull,
  and the literal rule is 27 mm off in the mean. Instead a centre has to lie 40 mm or more
  from the way of each sensor that saw nothing. With one line hit, that is the literal rule.

The exclusion of gulfs by the distance of extrema, d1 or d2, is left out under either rule:
over random passes the two classes overlap, and even with gulfs known the estimate gets
worse (facts/landmarks.md 2.3 and 3).
"""

from __future__ import annotations

import itertools
import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.design import territory
from locatk.core.landmarks.landmark import Geometry, code_of, signs

Array = NDArray[np.float64]

Rule = Literal["literal", "corrected"]

RADII = (0.045, 0.054)
"""The paper's r1 and r2 (section 3.1)."""

GULF_M = 0.005
"""The paper's tG: how far a way can reach into the territory within a gulf, unseen."""

GRAZED_M = 0.020
"""A chord shorter than this may cut a corner of the territory only, and says little of the
direction of the centre."""


def radii(geometry: Geometry) -> tuple[float, float]:
    """r1 and r2 of landmark 3 (NNNS), which has both, with the bars of ``geometry``.

    Raises
    ------
    DegenerateError
        The field does not reach the threshold.
    """
    angles = np.radians(np.arange(0, 360, 1.5) + 0.75)
    strengths = signs(code_of("NNNS"))
    found = territory.threshold_contour(geometry, strengths[:, None], angles)[:, 0]
    both = territory.territory_radii(angles, found, strengths)
    if not np.isfinite(both).all():
        raise DegenerateError(
            f"no field of {geometry.threshold_t * 1e3:g} mT around the landmark",
            hint="Lower the threshold, or the sensors",
        )
    return both


def circle_centres(points: Array, both: tuple[float, float] = RADII) -> Array:
    """Centres of all circles with one of two radii through two of the points.

    Parameters
    ----------
    points : (..., m, 2) ndarray
        ``nan`` where there is none.
    both : (float, float)

    Returns
    -------
    (..., 2 m (m - 1), 2) ndarray
        ``nan`` where two points are too far apart, or the same.
    """
    pairs = list(itertools.combinations(range(points.shape[-2]), 2))
    a = points[..., [i for i, _ in pairs], :]
    b = points[..., [j for _, j in pairs], :]
    chord, middle = b - a, (a + b) / 2
    length = np.hypot(chord[..., 0], chord[..., 1])[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.stack([-chord[..., 1], chord[..., 0]], -1) / np.where(
            length > 1e-6, length, np.nan
        )
        away = [np.sqrt(r * r - length * length / 4) * normal for r in both]
    found = [middle + sign * way for way in away for sign in (1, -1)]
    return np.concatenate(found, axis=-2) if pairs else np.empty((*points.shape[:-2], 0, 2))


def in_hull(points: Array, candidates: Array) -> NDArray[np.bool_]:
    """Whether candidates (..., k, 2) lie within the convex hull of points (..., m, 2).

    A place is inside where the directions to the points leave no gap of half a turn.
    """
    way = points[..., None, :, :] - candidates[..., :, None, :]
    angle = np.sort(np.arctan2(way[..., 1], way[..., 0]), axis=-1)  # nan last
    count = np.isfinite(angle).sum(axis=-1)
    last = np.take_along_axis(angle, np.maximum(count - 1, 0)[..., None], -1)[..., 0]
    gap = np.fmax.reduce(np.diff(angle, axis=-1), axis=-1, initial=-1.0)
    gap = np.fmax(gap, angle[..., 0] + math.tau - last)
    return np.asarray((gap < math.pi) & (count > 2))


def silent_distance(silent: Array, candidates: Array) -> Array:
    """Least distance (..., k) of candidates (..., k, 2) from ways (..., s, q, 2).

    The points of a way, filled up with ``nan``, are joined to a line; ``inf`` where there
    is no way.
    """
    nearest = np.full(candidates.shape[:-1], np.inf)
    for way in np.moveaxis(silent, -3, 0):
        if way.shape[-2] == 1:
            way = np.concatenate([way, way], axis=-2)
        for i in range(way.shape[-2] - 1):
            start = way[..., i, None, :]
            step = way[..., i + 1, None, :] - start
            to = candidates - start
            square = np.maximum(np.sum(step * step, -1), 1e-30)
            share = np.clip(np.sum(to * step, -1) / square, 0, 1)
            rest = to - share[..., None] * step
            nearest = np.fmin(nearest, np.hypot(rest[..., 0], rest[..., 1]))
    return nearest


def first_centre(
    points: Array,
    silent: Array,
    robot: Array,
    both: tuple[float, float] = RADII,
    rule: Rule = "corrected",
) -> Array:
    """The paper's first estimate of the landmark's centre.

    Parameters
    ----------
    points : (..., m, 2) ndarray
        Entries (:class:`~locatk.core.landmarks.published.entries.Entries`), ``nan`` where none.
    silent : (..., s, q, 2) ndarray
        Ways of the sensors that saw nothing; ``nan`` where they saw something.
    robot : (..., 2) ndarray
        Of the literal rule for two entries.
    both : (float, float)
        r1 and r2.
    rule : {"corrected", "literal"}
        See the module.

    Returns
    -------
    (..., 2) ndarray
        Mean of the centres that are kept; ``nan`` where there is none.
    """
    centres = circle_centres(points, both)
    good = np.isfinite(centres[..., 0])
    if not good.any():
        return mean_of(centres, good)
    hull = in_hull(points, centres)
    if rule == "literal":
        two = (np.isfinite(points[..., 0]).sum(axis=-1) == 2)[..., None]
        good &= np.where(two, _far_side(points, centres, robot), hull)
    else:
        apart = silent_distance(silent, centres)
        kept_away = np.asarray(np.isfinite(silent[..., 0]).any(axis=(-1, -2)))[..., None]
        good &= np.where(kept_away, apart >= both[0] - GULF_M, hull)
    return mean_of(centres, good)


def mean_of(centres: Array, good: NDArray[np.bool_]) -> Array:
    """Mean (..., 2) of the centres (..., k, 2) that are good; ``nan`` where none is."""
    total = np.where(good[..., None], centres, 0.0).sum(axis=-2)
    count = good.sum(axis=-1)[..., None]
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _far_side(points: Array, centres: Array, robot: Array) -> NDArray[np.bool_]:
    """Whether centres lie beyond the only two entries, as seen by the robot.

    A robot on the line itself (its front and rear sensors alone have seen the landmark)
    tells no side.
    """
    known = np.isfinite(points)
    total = np.where(known, points, 0.0).sum(axis=-2, keepdims=True)
    middle = total / np.maximum(known.sum(axis=-2, keepdims=True), 1)
    # The centres lie on the normal through the middle; so the sign of a product tells.
    side = np.sum((centres - middle) * (robot[..., None, :] - middle), axis=-1)
    return np.asarray(side <= 1e-9)
