"""First estimate by voting: a baseline beside the paper's rules (facts/landmarks.md 3).

The same circles through pairs of entries, but kept by how well a centre agrees with all
entries and with the sensors that saw nothing, instead of by a convex hull.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.published.first_step import (
    GULF_M,
    RADII,
    circle_centres,
    mean_of,
    silent_distance,
)

Array = NDArray[np.float64]

KEPT_M = 0.003
"""How much worse than the best a centre may agree and still counts."""


def voted_centre(points: Array, silent: Array, both: tuple[float, float] = RADII) -> Array:
    """Mean of the circles' centres that agree best with all that was seen.

    The cost of a centre is the rms over the entries of how far they are from the nearer
    of the two circles around it, and how much nearer than ``r1 - tG`` a sensor came that
    saw nothing. Shapes as in :func:`~locatk.core.landmarks.published.first_step.first_centre`.

    Returns
    -------
    (..., 2) ndarray
        ``nan`` where no circle goes through two entries.
    """
    centres = circle_centres(points, both)
    if centres.shape[-2] == 0:
        return np.full((*points.shape[:-2], 2), np.nan)
    way = points[..., None, :, :] - centres[..., :, None, :]
    distance = np.hypot(way[..., 0], way[..., 1])
    off = np.minimum(np.abs(distance - both[0]), np.abs(distance - both[1]))
    count = np.maximum(np.isfinite(off).sum(axis=-1), 1)
    cost = np.sqrt(np.nansum(off * off, axis=-1) / count)
    cost += np.maximum(both[0] - GULF_M - silent_distance(silent, centres), 0.0)
    cost = np.where(np.isfinite(centres[..., 0]), cost, np.inf)
    least = cost.min(axis=-1, keepdims=True)
    return mean_of(centres, np.isfinite(cost) & (cost <= least + KEPT_M))
