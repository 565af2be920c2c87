"""Derivative dynamic time warping of a window of samples against all templates.

Polaris section 6.2.2, after Keogh and Pazzani, Derivative Dynamic Time Warping, SDM 2001:
their estimate of the derivative, and the cost of the cheapest path as the distance. As in
the released code a cell costs the Euclidean distance between two derivatives of three axes.
Two things of that code are not followed, neither of which the paper's text has:

- It brings every axis to a standard deviation of 1 by itself. Under the middle of a sensor
  that makes all moments between 0 and 90 degrees the same template, and divides by zero
  where an axis has no field. Here one scale serves the three axes.
- It takes the mean of the accumulated costs along the path instead of the last of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.kernels import kernels

Array = NDArray[np.float64]
Slopes = NDArray[np.float32]


def derivative(series: Array) -> Array:
    """Keogh and Pazzani's estimate (..., n - 2, 3) for series (..., n, 3): the mean of the
    slope from the sample before and of that between the samples before and after."""
    before, here, after = series[..., :-2, :], series[..., 1:-1, :], series[..., 2:, :]
    return ((here - before) + (after - before) / 2) / 2


def normalised_slopes(series: Array) -> Array:
    """Derivatives (..., n - 2, 3) of series (..., n, 3) brought to a variance of 1, that of
    the three axes added up. A series that does not change has slopes of zero.

    Raises
    ------
    InputError
        Series of fewer than three samples have no derivative.
    """
    if series.shape[-2] < 3:
        raise InputError(f"a derivative needs three samples, not {series.shape[-2]}")
    spread = np.sqrt(series.var(axis=-2, keepdims=True).sum(axis=-1, keepdims=True))
    slopes = derivative(series)
    return np.divide(slopes, spread, out=np.zeros_like(slopes), where=spread > 0)


def prepare(templates: Array) -> Slopes:
    """Templates (N, T, 3) made ready to be compared: their slopes (T - 2, 3, N)."""
    return np.ascontiguousarray(normalised_slopes(templates).transpose(1, 2, 0), np.float32)


def distances(window: Array, slopes: Slopes) -> NDArray[np.float32]:
    """Distance of a window to each template.

    Parameters
    ----------
    window : (n, 3) ndarray
        At least three samples, in any unit.
    slopes : (T - 2, 3, N) float32 ndarray
        From :func:`prepare`.

    Returns
    -------
    (N,) float32 ndarray
        Cost of the cheapest path from the first samples of both to the last.
    """
    query = normalised_slopes(window).astype(np.float32)
    if kernels is None:
        return distances_numpy(query, slopes)
    length, _, count = slopes.shape
    cost = np.empty(count, np.float32)
    kernels.ddtw(query, np.ascontiguousarray(slopes), len(query), length, count, cost)
    return cost


def distances_numpy(query: Slopes, slopes: Slopes) -> NDArray[np.float32]:
    """:func:`distances` of a window's slopes (n - 2, 3) without the compiled kernel.

    A cell needs its neighbours on the two anti-diagonals before its own only, so each
    anti-diagonal is done at once for all templates. Cell (i, j) is kept at i + 1; place 0
    is the rim outside the matrix.
    """
    n, length, count = len(query), len(slopes), slopes.shape[2]
    rim = np.full((n + 1, count), np.inf, np.float32)
    before, second = rim, rim.copy()
    second[0] = 0  # where every path starts
    for diagonal in range(n + length - 1):
        rows = np.arange(max(0, diagonal - length + 1), min(n, diagonal + 1))
        apart = query[rows, :, None] - slopes[diagonal - rows]
        cheapest = np.minimum(np.minimum(before[rows], before[rows + 1]), second[rows])
        here = rim.copy()
        here[rows + 1] = cheapest + np.sqrt(np.square(apart).sum(axis=1))
        before, second = here, before
    return before[n]
