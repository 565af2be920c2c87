"""First step of the search: the landmark's centre from one pass (sections 3.1 and 3.2).

While the robot passes over a landmark, each sensor enters and leaves the landmark's territory,
the area in which the field reaches a threshold. These magnetic field entry points (MEPs) are
taken to be on two half-circles with the radii r1 and r2 around the centre. Every pair of
entries with either radius gives two candidate centres; a rule removes the impossible ones, and
the mean of the others is the estimate.

Rules:

- ``literal``: with more than two entries, candidates outside the convex hull of the entries
  are removed; with two, the candidates on the robot's side of them.
- ``corrected``, the default: the convex hull only if every sensor entered the territory. If two
  neighbouring lines of sensors entered it, the true centre is outside the hull, and the literal
  rule has a mean error of 27.8 mm in the paper's own study. A candidate must then be at least
  r1 - tG = 40 mm from the path of each silent sensor, one that did not enter the territory. With
  one line this is the literal rule.

Both rules leave out the exclusion of gulfs by the distance d1 or d2 of two extrema: over random
passes the two classes overlap (medians 35.5 and 33.5 mm), and the estimate becomes worse even if
the gulfs are known.

The functions that estimate a centre work on batches of passes: leading axes are free.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.design import territory
from locatk.core.landmarks.landmark import Geometry, code_of, signs

Array = NDArray[np.float64]

Rule = Literal["literal", "corrected"]

PAPER_RADII_M = (0.045, 0.054)
"""The paper's r1 and r2 (section 3.1)."""

GULF_DEPTH_M = 0.005
"""The paper's tG (section 3.2): depth to which a path can enter the territory inside a gulf
without reaching the threshold."""

GRAZING_CHORD_M = 0.020
"""A pass whose entries are closer together than this may only have cut a corner of the territory.
In the study of section 3.5 all errors above 20 mm come from such passes."""

MERGE_DISTANCE_M = 0.005
"""Entries of two sensors closer than this are one: the front and the rear sensor run on the same
line. A tenth of the chord of a pass beside the centre."""

SILENT_SPACING_M = 0.002
"""Distance between the points that are kept of the path of a silent sensor."""

VOTE_TOLERANCE_M = 0.003
"""Candidates that agree with the entries as well as the best one up to this rms are averaged."""


# ---- entries


@dataclass(frozen=True)
class PassEntries:
    """Measurements of one pass over a landmark that the first step uses.

    Attributes
    ----------
    point_m : (m, 2) ndarray
        Entries: positions at which the field of a sensor first rose to the threshold and at
        which it last fell below it, in the frame of the sensor positions; without duplicates.
    silent_m : (s, q, 2) ndarray
        Path of each sensor that did not enter the territory, padded with ``nan``.
    robot_m : (2,) ndarray
        Mean position of all sensors while any of them was in the territory; used by the literal
        rule for two entries.
    """

    point_m: Array
    silent_m: Array
    robot_m: Array

    @property
    def longest_chord_m(self) -> float:
        """Largest distance between two entries; 0 with fewer than two."""
        chords = self.point_m[:, None] - self.point_m
        return float(np.hypot(chords[..., 0], chords[..., 1]).max(initial=0.0))


def find_entries(position_m: Array, field_t: Array, threshold_t: float) -> PassEntries:
    """Find the entries of one pass in the traces of all sensors (section 3.1).

    Parameters
    ----------
    position_m : (n, N, 2) ndarray
        Sensors in the frame of the odometry, sample by sample.
    field_t : (n, N) ndarray
        ``nan`` where a sensor has no value. A sensor without any value is neither inside nor
        silent.
    threshold_t : float

    Notes
    -----
    A sensor can cross the threshold several times: at valleys inside the territory, and at the
    step between the two half-discs. The outermost crossings count, the first rise and the last
    fall. Half-discs entered at the corner and left at the flat side would otherwise give circles
    with errors of up to 54 mm. A pass that starts or ends inside has no entry there. The paper
    does not state which crossings count.
    """
    points: list[Array] = []
    silent: list[Array] = []
    inside = np.abs(field_t) >= threshold_t
    for k in range(field_t.shape[1]):
        if not np.isfinite(field_t[:, k]).any():
            continue
        if not inside[:, k].any():
            silent.append(_subsample_path(position_m[:, k]))
            continue
        crossing, rising = threshold_crossings(position_m[:, k], field_t[:, k], threshold_t)
        sensor_points = []
        if len(rising) and rising[0]:
            sensor_points.append(crossing[0])
        if len(rising) and not rising[-1]:
            sensor_points.append(crossing[-1])
        # Compared with other sensors only: the two entries of one sensor can be close together
        # if its line grazes the territory.
        points += [
            p for p in sensor_points if all(np.hypot(*(p - q)) > MERGE_DISTANCE_M for q in points)
        ]
    longest = max((len(path) for path in silent), default=0)
    padded = np.full((len(silent), longest, 2), np.nan)
    for path, row in zip(silent, padded, strict=True):
        row[: len(path)] = path
    any_inside = inside.any(axis=1)
    robot = position_m[any_inside].mean(axis=(0, 1)) if any_inside.any() else np.full(2, np.nan)
    return PassEntries(np.reshape(points, (-1, 2)), padded, robot)


def threshold_crossings(
    position_m: Array, field_t: Array, threshold_t: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Find where the magnitude of a field crosses a threshold along the path of a sensor.

    Parameters
    ----------
    position_m : (n, 2) ndarray
    field_t : (n,) ndarray
        Signed; samples that are ``nan`` are skipped.
    threshold_t : float

    Returns
    -------
    point_m : (k, 2) ndarray
        Interpolated between the samples before and after, in their order.
    rising : (k,) bool ndarray
        True where the magnitude increases; the directions alternate.
    """
    valid = np.isfinite(field_t)
    position_m, excess = position_m[valid], np.abs(field_t[valid]) - threshold_t
    inside = excess >= 0
    before = np.flatnonzero(inside[1:] != inside[:-1])
    fraction = excess[before] / (excess[before] - excess[before + 1])
    step = position_m[before + 1] - position_m[before]
    return position_m[before] + fraction[:, None] * step, inside[before + 1]


def _subsample_path(path_m: Array) -> Array:
    """Keep points (k, 2) of a path (n, 2) that are at least one spacing apart along it."""
    length = np.cumsum(np.hypot(*np.diff(path_m, axis=0, prepend=path_m[:1]).T))
    number = np.floor(length / SILENT_SPACING_M)
    return np.asarray(path_m[np.diff(number, prepend=-1.0) > 0])


# ---- centre


def bar_radii(geometry: Geometry) -> tuple[float, float]:
    """Return r1 and r2 of landmark 3 (NNNS), which has both, for the bars of ``geometry``.

    Raises
    ------
    DegenerateError
        The field of these bars does not reach the threshold.
    """
    angles = np.radians(np.arange(0, 360, 1.5) + 0.75)
    strengths = signs(code_of("NNNS"))
    contour = territory.threshold_contour(geometry, strengths[:, None], angles)[:, 0]
    radii_m = territory.territory_radii(angles, contour, strengths)
    if not np.isfinite(radii_m).all():
        raise DegenerateError(
            f"no field of {geometry.threshold_t * 1e3:g} mT around the landmark",
            hint="Lower the threshold, or the sensors",
        )
    return radii_m


def estimate_centre(
    points: Array,
    silent: Array,
    robot: Array,
    radii_m: tuple[float, float] = PAPER_RADII_M,
    rule: Rule = "corrected",
) -> Array:
    """Estimate the landmark's centre from entries (section 3.2).

    Parameters
    ----------
    points : (..., m, 2) ndarray
        Entries (:class:`PassEntries`), padded with ``nan``.
    silent : (..., s, q, 2) ndarray
        Paths of the silent sensors; ``nan`` for the other sensors.
    robot : (..., 2) ndarray
        Robot position of the literal rule for two entries.
    radii_m : (float, float)
        r1 and r2.
    rule : {"corrected", "literal"}
        See the module.

    Returns
    -------
    (..., 2) ndarray
        Mean of the remaining candidates; ``nan`` if there is none.
    """
    centres = circle_centres(points, radii_m)
    kept = np.isfinite(centres[..., 0])
    if not kept.any():
        return _masked_mean(centres, kept)
    in_hull = is_in_hull(points, centres)
    if rule == "literal":
        has_two_entries = (np.isfinite(points[..., 0]).sum(axis=-1) == 2)[..., None]
        kept &= np.where(has_two_entries, _is_beyond_entries(points, centres, robot), in_hull)
    else:
        distance = distance_to_paths(silent, centres)
        has_silent = np.asarray(np.isfinite(silent[..., 0]).any(axis=(-1, -2)))[..., None]
        kept &= np.where(has_silent, distance >= radii_m[0] - GULF_DEPTH_M, in_hull)
    return _masked_mean(centres, kept)


def vote_centre(
    points: Array, silent: Array, radii_m: tuple[float, float] = PAPER_RADII_M
) -> Array:
    """Estimate the landmark's centre by voting, a baseline that is not in the paper.

    The candidates are those of :func:`estimate_centre`. The cost of a candidate is the rms over
    the entries of the distance to the nearer of its two circles, plus the distance by which a
    silent sensor came closer than ``r1 - tG``. Candidates within :data:`VOTE_TOLERANCE_M` of the
    lowest cost are averaged. Shapes as in :func:`estimate_centre`.

    Returns
    -------
    (..., 2) ndarray
        ``nan`` if no circle passes through two entries.
    """
    centres = circle_centres(points, radii_m)
    if centres.shape[-2] == 0:
        return np.full((*points.shape[:-2], 2), np.nan)
    offset = points[..., None, :, :] - centres[..., :, None, :]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    residual = np.minimum(np.abs(distance - radii_m[0]), np.abs(distance - radii_m[1]))
    count = np.maximum(np.isfinite(residual).sum(axis=-1), 1)
    cost = np.sqrt(np.nansum(residual * residual, axis=-1) / count)
    cost += np.maximum(radii_m[0] - GULF_DEPTH_M - distance_to_paths(silent, centres), 0.0)
    cost = np.where(np.isfinite(centres[..., 0]), cost, np.inf)
    lowest = cost.min(axis=-1, keepdims=True)
    return _masked_mean(centres, np.isfinite(cost) & (cost <= lowest + VOTE_TOLERANCE_M))


def circle_centres(points: Array, radii_m: tuple[float, float] = PAPER_RADII_M) -> Array:
    """Return the centres of all circles with one of two radii through two of the points.

    Parameters
    ----------
    points : (..., m, 2) ndarray
        Padded with ``nan``.
    radii_m : (float, float)

    Returns
    -------
    (..., 2 m (m - 1), 2) ndarray
        ``nan`` for points that coincide or are farther apart than the diameter.
    """
    pairs = list(itertools.combinations(range(points.shape[-2]), 2))
    first = points[..., [i for i, _ in pairs], :]
    second = points[..., [j for _, j in pairs], :]
    chord, middle = second - first, (first + second) / 2
    length = np.hypot(chord[..., 0], chord[..., 1])[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.stack([-chord[..., 1], chord[..., 0]], -1) / np.where(
            length > 1e-6, length, np.nan
        )
        offsets = [np.sqrt(r * r - length * length / 4) * normal for r in radii_m]
    centres = [middle + sign * offset for offset in offsets for sign in (1, -1)]
    return np.concatenate(centres, axis=-2) if pairs else np.empty((*points.shape[:-2], 0, 2))


def is_in_hull(points: Array, candidates: Array) -> NDArray[np.bool_]:
    """Return which candidates (..., k, 2) are in the convex hull of points (..., m, 2).

    A candidate is inside if the directions to the points leave no gap of 180 degrees.
    """
    offset = points[..., None, :, :] - candidates[..., :, None, :]
    angle = np.sort(np.arctan2(offset[..., 1], offset[..., 0]), axis=-1)  # nan last
    count = np.isfinite(angle).sum(axis=-1)
    last = np.take_along_axis(angle, np.maximum(count - 1, 0)[..., None], -1)[..., 0]
    gap = np.fmax.reduce(np.diff(angle, axis=-1), axis=-1, initial=-1.0)
    gap = np.fmax(gap, angle[..., 0] + math.tau - last)
    return np.asarray((gap < math.pi) & (count > 2))


def distance_to_paths(paths: Array, candidates: Array) -> Array:
    """Return the least distance (..., k) of candidates (..., k, 2) from paths (..., s, q, 2).

    The points of a path, padded with ``nan``, are joined by straight lines. ``inf`` if there is
    no path.
    """
    nearest = np.full(candidates.shape[:-1], np.inf)
    for path in np.moveaxis(paths, -3, 0):
        if path.shape[-2] == 1:
            path = np.concatenate([path, path], axis=-2)
        for i in range(path.shape[-2] - 1):
            start = path[..., i, None, :]
            step = path[..., i + 1, None, :] - start
            offset = candidates - start
            length_squared = np.maximum(np.sum(step * step, -1), 1e-30)
            fraction = np.clip(np.sum(offset * step, -1) / length_squared, 0, 1)
            residual = offset - fraction[..., None] * step
            nearest = np.fmin(nearest, np.hypot(residual[..., 0], residual[..., 1]))
    return nearest


def _masked_mean(centres: Array, kept: NDArray[np.bool_]) -> Array:
    """Return the mean (..., 2) of the centres (..., k, 2) that are kept; ``nan`` for none."""
    total = np.where(kept[..., None], centres, 0.0).sum(axis=-2)
    count = kept.sum(axis=-1)[..., None]
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _is_beyond_entries(points: Array, centres: Array, robot: Array) -> NDArray[np.bool_]:
    """Return which centres are beyond the only two entries, as seen from the robot.

    If the robot is on the line through both (only its front and rear sensors entered the
    territory), neither side is excluded.
    """
    valid = np.isfinite(points)
    total = np.where(valid, points, 0.0).sum(axis=-2, keepdims=True)
    middle = total / np.maximum(valid.sum(axis=-2, keepdims=True), 1)
    # The centres are on the normal through the middle, so the sign of a product decides.
    side = np.sum((centres - middle) * (robot[..., None, :] - middle), axis=-1)
    return np.asarray(side <= 1e-9)
