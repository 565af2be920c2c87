"""Figures of the ratio of predicted to reached standard deviations, and their goals."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from locatk.formats.benchmarks.figures import Figure

MEDIAN_RATIO, TAIL_RATIO = 1.25, 2.0
"""Goals: largest ratio, or its inverse, in the median and for nine of ten tasks."""


def ratio_figures(name: str, ratio: ArrayLike, how: str) -> list[Figure]:
    """Return the median and the tails of ratios (n,); those that are not finite are left out.

    A target for the median is one of the larger of the ratio and its inverse.
    """
    ratios = np.asarray(ratio, float)
    low, median, high = np.percentile(ratios[np.isfinite(ratios)], [5, 50, 95]).tolist()
    larger = max(median, 1 / median)
    return [
        Figure(f"{name}: median", median, "", f"{how}; goal 0.8 to 1.25"),
        Figure(f"{name}: median, larger of ratio and inverse", larger, "", how, MEDIAN_RATIO),
        Figure(f"{name}: 5th percentile", low, "", how, 1 / TAIL_RATIO, "higher"),
        Figure(f"{name}: 95th percentile", high, "", how, TAIL_RATIO),
    ]
