"""The paper's study of its first step (section 3.5), and the same on the real field.

360 starts on a circle of 115 mm, 91 headings from -45 to 45 degrees off the landmark's
centre, straight on over landmark 3 (``NNNS``) with sensors front, left, rear and right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import Geometry, code_of
from locatk.core.landmarks.published.first_step import GRAZED_M, RADII, first_centre, radii
from locatk.core.landmarks.published.voting import voted_centre

Array = NDArray[np.float64]

Territory = Literal["half-discs", "field"]
Method = Literal["literal", "corrected", "voting"]

START_M = 0.115

LANDMARK = "NNNS"

WAY_M = 0.23
"""Length of the way, which ends on the other side of the circle."""

STEP_M = 1e-3
"""Of the samples in the real field."""

BATCH = 2048
"""Passes at once, for the sake of memory."""


@dataclass(frozen=True)
class Study:
    """Errors of the first step.

    Attributes
    ----------
    start : (n, 2) ndarray
        Where the robot set out, in the landmark's frame; metres.
    heading_rad : (n,) ndarray
    lines : (n,) int64 ndarray
        How many of the three lines of sensors saw the landmark; 0 where it was missed.
    chord_m : (n,) ndarray
        Longest way of a sensor between entry and exit; ``nan`` where missed.
    error_m : (n,) ndarray
        From the landmark's centre to the estimate; ``nan`` where there is none.
    """

    start: Array
    heading_rad: Array
    lines: NDArray[np.int64]
    chord_m: Array
    error_m: Array

    def figures(self, grazed: bool = True) -> dict[str, float]:
        """What section 3.5.2 states, in millimetres; without ``grazed`` passes if asked.

        Keys: ``runs``, ``missed`` (no sensor saw anything), ``unsolved`` (seen, but no
        circle was kept), ``mean_mm``, ``sd_mm``, ``max_mm``, and ``over_20_share`` (of
        those seen; where no circle was kept counts as over).
        """
        seen = (self.lines > 0) & (grazed | (self.chord_m >= GRAZED_M))
        error = self.error_m[seen & np.isfinite(self.error_m)] * 1e3
        return {
            "runs": float(len(self.lines)),
            "missed": float(np.sum(self.lines == 0)),
            "unsolved": float(np.sum(seen & np.isnan(self.error_m))),
            "mean_mm": float(error.mean()),
            "sd_mm": float(error.std()),
            "max_mm": float(error.max()),
            "over_20_share": float(np.mean(~(self.error_m[seen] <= 0.020))),
        }


def study(
    step: int = 1,
    territory: Territory = "half-discs",
    method: Method = "corrected",
    geometry: Geometry | None = None,
) -> Study:
    """Errors of the first step over all starts and headings.

    Parameters
    ----------
    step : int
        Of the starts, in degrees: 1 gives the paper's 32,760 runs.
    territory : {"half-discs", "field"}
        ``half-discs``: a disc's half of 45 mm where neighbouring bars are equal and one of
        54 mm where they are not; that is what the paper's figures fit best. ``field``: the
        field of the bars, without noise.
    method : {"corrected", "literal", "voting"}
        Rules of :mod:`~locatk.core.landmarks.published.first_step`, or
        :mod:`~locatk.core.landmarks.published.voting`.
    geometry : Geometry, optional
        Of the bars and of the sensors' circle.
    """
    geometry = Geometry() if geometry is None else geometry
    both = RADII if territory == "half-discs" else radii(geometry)
    around = np.radians(np.arange(0, 360, step))
    off = np.radians(np.arange(-45, 46))
    place, turn = (a.ravel() for a in np.meshgrid(around, off, indexing="ij"))
    start = START_M * np.stack([np.cos(place), np.sin(place)], -1)
    heading = place + math.pi + turn
    parts = [
        _runs(start[i : i + BATCH], heading[i : i + BATCH], territory, method, geometry, both)
        for i in range(0, len(start), BATCH)
    ]
    lines, chord, error = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Study(start, heading, lines.astype(np.int64), chord, error)


def _runs(
    start: Array,
    heading: Array,
    territory: Territory,
    method: Method,
    geometry: Geometry,
    both: tuple[float, float],
) -> tuple[Array, Array, Array]:
    """Lines that hit (n,), longest chord (n,) and error (n,) of straight passes."""
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], -1)
    # Front and rear run on one line, and give the same entries: each is counted once.
    aside = np.array([-1, 0, 1]) * geometry.circle_m
    origin = start[:, None] + aside[:, None] * left[:, None]
    if territory == "half-discs":
        interval = half_disc_interval(origin, ahead[:, None], both)
    else:
        interval = _field_interval(origin, ahead[:, None], geometry)
    hit = np.isfinite(interval[..., 0])
    points = (origin[:, :, None] + interval[..., None] * ahead[:, None, None]).reshape(-1, 6, 2)
    way = np.array([-geometry.circle_m, WAY_M + geometry.circle_m])
    silent = origin[:, :, None] + way[:, None] * ahead[:, None, None]
    silent = np.where(hit[..., None, None], np.nan, silent)
    if method == "voting":
        centre = voted_centre(points, silent, both)
    else:
        # The literal rule asks only on which side of a lateral line the robot drives.
        robot = start + (WAY_M / 2) * ahead
        centre = first_centre(points, silent, robot, both, method)
    chord = np.fmax.reduce(interval[..., 1] - interval[..., 0], axis=-1)
    return hit.sum(axis=-1).astype(float), chord, np.hypot(centre[:, 0], centre[:, 1])


def half_disc_interval(origin: Array, ahead: Array, both: tuple[float, float] = RADII) -> Array:
    """First entry and last exit (..., 2) of lines into the two half-discs of ``NNNS``.

    In metres along ``ahead`` (..., 2), unit vectors, from ``origin`` (..., 2); ``nan`` where
    a line passes by. The smaller half-disc is the one above the x axis: there all bars
    are N. Lines that leave by the flat step and come back by the other half count as
    one passage.
    """
    x, y = origin[..., 0], origin[..., 1]
    ux, uy = np.broadcast_arrays(ahead[..., 0], ahead[..., 1], x)[:2]
    along = x * ux + y * uy
    found = []
    with np.errstate(invalid="ignore", divide="ignore"):
        level = -y / uy
        for radius, upper in ((both[0], True), (both[1], False)):
            half = np.sqrt(along**2 - (x * x + y * y - radius**2))
            low, high = -along - half, -along + half
            enters = (uy > 0) == upper
            flat = uy == 0
            low = np.where(enters & ~flat, np.fmax(low, level), low)
            high = np.where(~enters & ~flat, np.fmin(high, level), high)
            good = (high > low) & (~flat | ((y >= 0) == upper)) & np.isfinite(half)
            found.append(np.where(good[..., None], np.stack([low, high], -1), np.nan))
    first = np.fmin(found[0][..., 0], found[1][..., 0])
    return np.stack([first, np.fmax(found[0][..., 1], found[1][..., 1])], -1)


def _field_interval(origin: Array, ahead: Array, geometry: Geometry) -> Array:
    """The same in the field of the bars, between samples by interpolation."""
    way = np.arange(-geometry.circle_m, WAY_M + geometry.circle_m, STEP_M)
    points = origin[..., None, :] + way[:, None] * ahead[..., None, :]
    size = np.abs(landmark_field(geometry, code_of(LANDMARK), points)) - geometry.threshold_t
    inside = size >= 0
    any_inside = inside.any(axis=-1)
    first = np.maximum(inside.argmax(axis=-1), 1)
    last = np.minimum(len(way) - 1 - inside[..., ::-1].argmax(axis=-1), len(way) - 2)
    ends = []
    for before in (first - 1, last):
        one = np.take_along_axis(size, before[..., None], -1)[..., 0]
        two = np.take_along_axis(size, before[..., None] + 1, -1)[..., 0]
        # where nothing was inside, the share means nothing
        share = one / np.where(one == two, 1.0, one - two)
        ends.append(np.where(any_inside, way[before] + STEP_M * share, np.nan))
    return np.stack(ends, -1)
