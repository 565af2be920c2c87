"""Where sensors entered and left a landmark's territory: the paper's MEPs (section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAME_M = 0.005
"""Entries of two sensors that are this near are one place: front and rear run on one line."""

SILENT_STEP_M = 0.002
"""Between the points that are kept of the way of a sensor that saw nothing."""


@dataclass(frozen=True)
class Entries:
    """What one pass over a landmark gives to the first step.

    Attributes
    ----------
    point : (m, 2) ndarray
        Where a sensor's field first rose to the threshold and where it last fell below it,
        in the frame of the places; each place once.
    silent : (s, q, 2) ndarray
        The way of each sensor that saw nothing, filled up with ``nan``.
    robot : (2,) ndarray
        Mean place of all sensors while any of them was inside; the paper's rule for two
        entries needs it.
    """

    point: Array
    silent: Array
    robot: Array


def crossings(place: Array, value: Array, threshold: float) -> tuple[Array, NDArray[np.bool_]]:
    """Where the size of a field passes a threshold along a sensor's way.

    Parameters
    ----------
    place : (n, 2) ndarray
    value : (n,) ndarray
        Signed; samples that are ``nan`` are passed over.
    threshold : float

    Returns
    -------
    point : (k, 2) ndarray
        Interpolated between the samples before and after, in their order.
    rising : (k,) bool ndarray
        Whether the field grew there; the directions alternate.
    """
    good = np.isfinite(value)
    place, size = place[good], np.abs(value[good]) - threshold
    inside = size >= 0
    at = np.flatnonzero(inside[1:] != inside[:-1])
    share = size[at] / (size[at] - size[at + 1])
    return place[at] + share[:, None] * (place[at + 1] - place[at]), inside[at + 1]


def entries(place: Array, field_t: Array, threshold_t: float) -> Entries:
    """Entries of a pass by the traces of all sensors.

    Parameters
    ----------
    place : (n, N, 2) ndarray
        Sensors in the odometry's frame, sample by sample.
    field_t : (n, N) ndarray
        ``nan`` where a sensor gave nothing; one that never did is neither inside nor silent.
    threshold_t : float

    Notes
    -----
    Section 3.1. Of the several crossings that a sensor can have (valleys within the
    territory, the step between the two half-discs) the outermost are taken: the first
    rise and the last fall. Half-discs entered at their corner and left at its flat side
    would otherwise give circles that are up to 54 mm off. A pass that begins or ends
    inside has no entry there.
    """
    found: list[Array] = []
    silent: list[Array] = []
    inside = np.abs(field_t) >= threshold_t
    for k in range(field_t.shape[1]):
        if not np.isfinite(field_t[:, k]).any():
            continue
        if not inside[:, k].any():
            silent.append(_thinned(place[:, k]))
            continue
        point, rising = crossings(place[:, k], field_t[:, k], threshold_t)
        own = []
        if len(rising) and rising[0]:
            own.append(point[0])
        if len(rising) and not rising[-1]:
            own.append(point[-1])
        # One sensor's own two may be near each other: a line that grazes the territory.
        found += [p for p in own if all(np.hypot(*(p - q)) > SAME_M for q in found)]
    longest = max((len(way) for way in silent), default=0)
    ways = np.full((len(silent), longest, 2), np.nan)
    for way, row in zip(silent, ways, strict=True):
        row[: len(way)] = way
    any_inside = inside.any(axis=1)
    robot = place[any_inside].mean(axis=(0, 1)) if any_inside.any() else np.full(2, np.nan)
    return Entries(np.reshape(found, (-1, 2)), ways, robot)


def _thinned(way: Array) -> Array:
    """Points of a way that are at least a step apart along it."""
    length = np.cumsum(np.hypot(*np.diff(way, axis=0, prepend=way[:1]).T))
    number = np.floor(length / SILENT_STEP_M)
    return np.asarray(way[np.diff(number, prepend=-1.0) > 0])
