"""Derivative dynamic time warping of a window of samples against all templates.

Polaris section 6.2.2, after Keogh and Pazzani, Derivative Dynamic Time Warping, SDM 2001:
their estimate of the derivative, and the cost of the cheapest path as the distance. A cell
costs the Euclidean distance between two derivatives of three axes, as in the released
``ddtw.c``. The text does not say how series of different strength are made comparable.
Here the derivatives of a series are divided by their rms, one scale for the three axes.
:mod:`~locatk.core.polaris.published.pipeline` lists what the alternatives do:

- The released code brings each axis to a standard deviation of 1. Where a sensor passes over
  the middle of a magnet, all moments between 0 and 90 degrees then have the same template,
  and an axis without field divides by zero. It also takes the mean of the accumulated costs
  along the path instead of the last one.
- The standard deviation of the samples does not depend on how densely a window is sampled, but
  the derivative per sample does: divided by it, distances depend on the density.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.kernels import kernels

Array = NDArray[np.float64]
Slopes = NDArray[np.float32]


def derivative(series: Array) -> Array:
    """Estimate the derivative (..., n - 2, 3) of series (..., n, 3) after Keogh and Pazzani.

    It is the mean of the slope from the previous sample and of the slope between the
    previous and the next one.
    """
    previous, current, following = series[..., :-2, :], series[..., 1:-1, :], series[..., 2:, :]
    return ((current - previous) + (following - previous) / 2) / 2


def normalised_slopes(series: Array) -> Array:
    """Return derivatives (..., n - 2, 3) of series (..., n, 3), scaled to an rms of 1.

    The rms is that of the vector, so that the three axes keep their proportions. A constant
    series has slopes of zero.

    Raises
    ------
    InputError
        A series has fewer than three samples and therefore no derivative.
    """
    if series.shape[-2] < 3:
        raise InputError(f"a derivative needs three samples, not {series.shape[-2]}")
    slopes = derivative(series)
    rms = np.sqrt(np.square(slopes).sum(axis=-1).mean(axis=-1))[..., None, None]
    return np.divide(slopes, rms, out=np.zeros_like(slopes), where=rms > 0)


def prepare(templates: Array) -> Slopes:
    """Return the slopes (T - 2, 3, N) of templates (N, T, 3), as :func:`distances` reads them."""
    return np.ascontiguousarray(normalised_slopes(templates).transpose(1, 2, 0), np.float32)


def distances(window: Array, slopes: Slopes) -> NDArray[np.float32]:
    """Compute the distance of a window to each template.

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
    """Compute :func:`distances` of a window's slopes (n - 2, 3) without the compiled kernel.

    A cell needs its neighbours on the two preceding anti-diagonals only, so that one
    anti-diagonal is computed at a time for all templates. Cell (i, j) is stored at i + 1;
    index 0 is the rim outside the matrix.
    """
    n, length, count = len(query), len(slopes), slopes.shape[2]
    rim = np.full((n + 1, count), np.inf, np.float32)
    previous, second = rim, rim.copy()
    second[0] = 0  # the start of every path
    for diagonal in range(n + length - 1):
        rows = np.arange(max(0, diagonal - length + 1), min(n, diagonal + 1))
        difference = query[rows, :, None] - slopes[diagonal - rows]
        cheapest = np.minimum(np.minimum(previous[rows], previous[rows + 1]), second[rows])
        current = rim.copy()
        current[rows + 1] = cheapest + np.sqrt(np.square(difference).sum(axis=1))
        previous, second = current, previous
    return previous[n]
