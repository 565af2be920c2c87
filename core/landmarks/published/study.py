"""The paper's study of its first step (section 3.5), also on the field of the bars.

360 starts on a circle of 115 mm and 91 headings from -45 to 45 degrees off the landmark's centre;
from each the robot drives straight over landmark 3 (``NNNS``) with sensors front, left, rear and
right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import Geometry, code_of
from locatk.core.landmarks.published.first_step import (
    GRAZING_CHORD_M,
    PAPER_RADII_M,
    bar_radii,
    estimate_centre,
    vote_centre,
)

Array = NDArray[np.float64]

Territory = Literal["half-discs", "field"]
Method = Literal["literal", "corrected", "voting"]

START_RADIUS_M = 0.115
"""Radius of the circle of starts (section 3.5.1)."""

LANDMARK = "NNNS"
"""Landmark 3, which the paper calls the most difficult one (section 3.5)."""

PATH_LENGTH_M = 0.23
"""Length of the path, which ends on the other side of the circle."""

FIELD_STEP_M = 1e-3
"""Distance between the samples in the field of the bars."""

BATCH_RUNS = 2048
"""Runs computed at once; more would need too much memory."""


@dataclass(frozen=True)
class FirstStepStudy:
    """Errors of the first step.

    Attributes
    ----------
    start_m : (n, 2) ndarray
        Start positions in the landmark's frame.
    heading_rad : (n,) ndarray
    lines : (n,) int64 ndarray
        Number of the three lines of sensors that entered the territory; 0 for a miss.
    chord_m : (n,) ndarray
        Longest path of a sensor between entry and exit; ``nan`` for a miss.
    error_m : (n,) ndarray
        Distance of the estimate from the landmark's centre; ``nan`` if there is none.
    """

    start_m: Array
    heading_rad: Array
    lines: NDArray[np.int64]
    chord_m: Array
    error_m: Array

    def figures(self, grazed: bool = True) -> dict[str, float]:
        """Return the figures of section 3.5.2 in millimetres, optionally without grazing passes.

        Keys: ``runs``, ``missed`` (no sensor entered the territory), ``unsolved`` (entered, but
        no candidate was left), ``mean_mm``, ``sd_mm``, ``max_mm``, and ``over_20_share``: the
        fraction with an error above 20 mm of those that entered; unsolved runs are included.
        """
        entered = (self.lines > 0) & (grazed | (self.chord_m >= GRAZING_CHORD_M))
        error = self.error_m[entered & np.isfinite(self.error_m)] * 1e3
        return {
            "runs": float(len(self.lines)),
            "missed": float(np.sum(self.lines == 0)),
            "unsolved": float(np.sum(entered & np.isnan(self.error_m))),
            "mean_mm": float(error.mean()),
            "sd_mm": float(error.std()),
            "max_mm": float(error.max()),
            "over_20_share": float(np.mean(~(self.error_m[entered] <= 0.020))),
        }


def study(
    step: int = 1,
    territory: Territory = "half-discs",
    method: Method = "corrected",
    geometry: Geometry | None = None,
) -> FirstStepStudy:
    """Compute the errors of the first step over all starts and headings.

    Parameters
    ----------
    step : int
        Degrees between the starts: 1 gives the paper's 32,760 runs.
    territory : {"half-discs", "field"}
        ``half-discs``: half a disc of 45 mm where neighbouring bars are equal and half a disc of
        54 mm where they differ, which agrees best with the paper's figures. ``field``: the field
        of the bars, without noise.
    method : {"corrected", "literal", "voting"}
        Rule of :func:`~locatk.core.landmarks.published.first_step.estimate_centre`, or
        :func:`~locatk.core.landmarks.published.first_step.vote_centre`.
    geometry : Geometry, optional
        Of the bars and of the sensors' circle.
    """
    geometry = Geometry() if geometry is None else geometry
    radii_m = PAPER_RADII_M if territory == "half-discs" else bar_radii(geometry)
    start_angles = np.radians(np.arange(0, 360, step))
    heading_offsets = np.radians(np.arange(-45, 46))
    angle, offset = (a.ravel() for a in np.meshgrid(start_angles, heading_offsets, indexing="ij"))
    start = START_RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], -1)
    heading = angle + math.pi + offset
    batches = [slice(i, i + BATCH_RUNS) for i in range(0, len(start), BATCH_RUNS)]
    columns = [
        _run_batch(start[batch], heading[batch], territory, method, geometry, radii_m)
        for batch in batches
    ]
    lines, chord, error = (np.concatenate(column) for column in zip(*columns, strict=True))
    return FirstStepStudy(start, heading, lines.astype(np.int64), chord, error)


def _run_batch(
    start: Array,
    heading: Array,
    territory: Territory,
    method: Method,
    geometry: Geometry,
    radii_m: tuple[float, float],
) -> tuple[Array, Array, Array]:
    """Return entered lines (n,), longest chord (n,) and error (n,) of straight passes."""
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], -1)
    # Front and rear run on one line and give the same entries, so that it counts once.
    lateral = np.array([-1, 0, 1]) * geometry.circle_m
    origin = start[:, None] + lateral[:, None] * left[:, None]
    if territory == "half-discs":
        interval = half_disc_interval(origin, ahead[:, None], radii_m)
    else:
        interval = _field_interval(origin, ahead[:, None], geometry)
    entered = np.isfinite(interval[..., 0])
    points = (origin[:, :, None] + interval[..., None] * ahead[:, None, None]).reshape(-1, 6, 2)
    ends = np.array([-geometry.circle_m, PATH_LENGTH_M + geometry.circle_m])
    silent = origin[:, :, None] + ends[:, None] * ahead[:, None, None]
    silent = np.where(entered[..., None, None], np.nan, silent)
    if method == "voting":
        centre = vote_centre(points, silent, radii_m)
    else:
        # The literal rule needs only the side of a lateral line on which the robot drives.
        robot = start + (PATH_LENGTH_M / 2) * ahead
        centre = estimate_centre(points, silent, robot, radii_m, method)
    chord = np.fmax.reduce(interval[..., 1] - interval[..., 0], axis=-1)
    return entered.sum(axis=-1).astype(float), chord, np.hypot(centre[:, 0], centre[:, 1])


def half_disc_interval(
    origin: Array, ahead: Array, radii_m: tuple[float, float] = PAPER_RADII_M
) -> Array:
    """Return first entry and last exit (..., 2) of lines into the two half-discs of ``NNNS``.

    In metres along ``ahead`` (..., 2), unit vectors, from ``origin`` (..., 2); ``nan`` for a line
    that misses. The smaller half-disc is above the x axis, where all bars are N. A line that
    leaves by the flat step and enters the other half again counts as one passage.
    """
    x, y = origin[..., 0], origin[..., 1]
    ux, uy = np.broadcast_arrays(ahead[..., 0], ahead[..., 1], x)[:2]
    along = x * ux + y * uy
    intervals = []
    with np.errstate(invalid="ignore", divide="ignore"):
        axis_crossing = -y / uy
        for radius, upper in ((radii_m[0], True), (radii_m[1], False)):
            half = np.sqrt(along**2 - (x * x + y * y - radius**2))
            low, high = -along - half, -along + half
            enters = (uy > 0) == upper
            level = uy == 0
            low = np.where(enters & ~level, np.fmax(low, axis_crossing), low)
            high = np.where(~enters & ~level, np.fmin(high, axis_crossing), high)
            valid = (high > low) & (~level | ((y >= 0) == upper)) & np.isfinite(half)
            intervals.append(np.where(valid[..., None], np.stack([low, high], -1), np.nan))
    first = np.fmin(intervals[0][..., 0], intervals[1][..., 0])
    return np.stack([first, np.fmax(intervals[0][..., 1], intervals[1][..., 1])], -1)


def _field_interval(origin: Array, ahead: Array, geometry: Geometry) -> Array:
    """Return first entry and last exit (..., 2) of lines into the territory of the bars' field.

    Parameters as in :func:`half_disc_interval`; interpolated between samples.
    """
    path = np.arange(-geometry.circle_m, PATH_LENGTH_M + geometry.circle_m, FIELD_STEP_M)
    points = origin[..., None, :] + path[:, None] * ahead[..., None, :]
    excess = np.abs(landmark_field(geometry, code_of(LANDMARK), points)) - geometry.threshold_t
    inside = excess >= 0
    any_inside = inside.any(axis=-1)
    first = np.maximum(inside.argmax(axis=-1), 1)
    last = np.minimum(len(path) - 1 - inside[..., ::-1].argmax(axis=-1), len(path) - 2)
    ends = []
    for before in (first - 1, last):
        lower = np.take_along_axis(excess, before[..., None], -1)[..., 0]
        upper = np.take_along_axis(excess, before[..., None] + 1, -1)[..., 0]
        # The fraction has no meaning for lines that are never inside; they become nan below.
        fraction = lower / np.where(lower == upper, 1.0, lower - upper)
        ends.append(np.where(any_inside, path[before] + FIELD_STEP_M * fraction, np.nan))
    return np.stack(ends, -1)
