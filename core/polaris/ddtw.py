"""Derivative dynamic time warping of a window of samples against all templates.

Polaris section 6.2.2, after Keogh and Pazzani, Derivative Dynamic Time Warping, SDM 2001:
the estimate of the derivative, the square of its difference as the cost of a cell, and the
cost of the cheapest path as the distance; of three axes the squares are added up. Axes are
z-normalised first, as in the released code.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels

Array = NDArray[np.float64]
Slopes = NDArray[np.float32]

LANES = 32
"""Templates that the kernel takes at a time: `DDTW_LANES` in core/_kernels.c."""


def normalise(series: Array) -> Array:
    """Series (..., n, 3) with every axis of mean 0 and standard deviation 1.

    An axis that does not change is all zeros then; the released code divides by zero there
    and can never choose such a template.
    """
    centred = series - series.mean(axis=-2, keepdims=True)
    spread = np.sqrt(np.mean(centred**2, axis=-2, keepdims=True))
    # What is left of a constant axis is rounding, and that must not become a signal.
    constant = spread <= 1e-9 * spread.max(axis=-1, keepdims=True)
    return np.where(constant, 0.0, centred / np.where(constant, 1.0, spread))


def derivative(series: Array) -> Array:
    """Keogh and Pazzani's estimate (..., n - 2, 3): the mean of the slope to the sample
    before and of that between the samples before and after."""
    before, here, after = series[..., :-2, :], series[..., 1:-1, :], series[..., 2:, :]
    return ((here - before) + (after - before) / 2) / 2


def prepare(templates: Array) -> Slopes:
    """Templates (N, T, 3), ready to be compared: their slopes (T - 2, 3, N)."""
    slopes = derivative(normalise(templates))
    return np.ascontiguousarray(slopes.transpose(1, 2, 0), dtype=np.float32)


def distances(window: Array, slopes: Slopes) -> NDArray[np.float32]:
    """Distance of a window to each template.

    Parameters
    ----------
    window : (n, 3) ndarray
        At least three samples.
    slopes : (T - 2, 3, N) float32 ndarray
        From :func:`prepare`.

    Returns
    -------
    (N,) float32 ndarray
        Cost of the cheapest path from the first samples to the last.
    """
    query = derivative(normalise(window)).astype(np.float32)
    if kernels is None:
        return distances_numpy(query, slopes)
    length, _, count = slopes.shape
    cost = np.empty(count, np.float32)
    kernels.ddtw(query, np.ascontiguousarray(slopes), len(query), length, count, cost)
    return cost


def distances_numpy(query: Slopes, slopes: Slopes) -> NDArray[np.float32]:
    """:func:`distances` of a window's slopes (n - 2, 3) without the compiled kernel.

    Cells of an anti-diagonal need those of the two before it only, so each is done for all
    templates at once. Rows are numbered from 1: row 0 is the rim outside the matrix.
    """
    n, length, count = len(query), len(slopes), slopes.shape[2]
    rim = np.full((n + 1, count), np.inf, np.float32)
    one_before, two_before = rim.copy(), rim.copy()
    two_before[0] = 0  # the corner from which every path starts
    for diagonal in range(n + length - 1):
        first, stop = max(0, diagonal - length + 1), min(n, diagonal + 1)
        rows = np.arange(first, stop)
        cost = np.sqrt(np.square(query[rows, :, None] - slopes[diagonal - rows]).sum(axis=1))
        cheapest = np.minimum(one_before[rows], one_before[rows + 1])
        here = rim.copy()
        here[rows + 1] = cost + np.minimum(cheapest, two_before[rows])
        one_before, two_before = here, one_before
        
    return one_before[n]
