"""Upright field of the four bars of a landmark, in closed form with its gradient."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks.landmark import Geometry, signs

Array = NDArray[np.float64]

NEAREST_M = 1e-9
"""Distance that is kept from the lines of a bar's edges, where the field has no bound."""


def basis(geometry: Geometry, points: ArrayLike, height_m: ArrayLike | None = None) -> Array:
    """Upright field of each bar of a landmark, were it laid ``N``.

    The field of a landmark is linear in its bars: ``basis @ (signs * strengths)``.

    Parameters
    ----------
    geometry : Geometry
    points : (..., 2) ndarray
        In the landmark's frame, in metres.
    height_m : float or (...) ndarray, optional
        Above the bars' top faces; the geometry's sensor height unless given. Negative
        values lie beside, in or under the bars.

    Returns
    -------
    (..., 4) ndarray
        Tesla, upward positive; outside of the bars' material, and within it the same less
        nothing, as their magnetisation lies flat. Bounded on the bars' edges, where the
        true field is not.

    Notes
    -----
    A cuboid magnetised along its length is two charged faces, each the difference of
    logarithms at its corners (Yang, Johansen and Bratsberg, Supercond. Sci. Technol. 3,
    591, 1990; facts/landmarks.md 2.5). Corners are joined to one logarithm of a product
    here, which is faster and keeps the digits of far fields.
    """
    return evaluate(geometry, points, height_m, gradient=False)[0]


def basis_gradient(
    geometry: Geometry, points: ArrayLike, height_m: ArrayLike | None = None
) -> tuple[Array, Array]:
    """:func:`basis`, and its derivatives (..., 4, 3) by x, y and height in T/m."""
    return evaluate(geometry, points, height_m, gradient=True)


def landmark_field(
    geometry: Geometry, code: int, points: ArrayLike, height_m: ArrayLike | None = None
) -> Array:
    """Upright field (...) in tesla of a faultless landmark laid as ``code``."""
    return np.asarray(basis(geometry, points, height_m) @ signs(code))


def evaluate(
    geometry: Geometry, points: ArrayLike, height_m: ArrayLike | None, *, gradient: bool
) -> tuple[Array, Array]:
    """Fields, and their gradients (an empty array where they are not asked for)."""
    plane = np.asarray(points, float)
    height = geometry.sensor_height_m if height_m is None else height_m
    at = np.empty((*np.broadcast_shapes(plane.shape[:-1], np.shape(height)), 3))
    at[..., :2] = plane
    at[..., 2] = height
    if kernels is None:
        return evaluate_numpy(geometry, at, gradient=gradient)
    count = at[..., 0].size
    field = np.empty((*at.shape[:-1], 4))
    slope = np.empty((*at.shape[:-1], 4, 3) if gradient else 0)
    g = geometry
    shape = (g.bar_length_m / 2, g.bar_width_m / 2, g.bar_height_m, g.radius_m)
    kernels.bar_fields(at, count, *shape, g.remanence_t, NEAREST_M, gradient, field, slope)
    return field, slope


def evaluate_numpy(geometry: Geometry, at: Array, *, gradient: bool) -> tuple[Array, Array]:
    """Twin of the compiled loop: fields at points (..., 3) of the landmark's frame."""
    scale = geometry.remanence_t / (4 * math.pi)
    x, y, z = np.moveaxis(at, -1, 0)
    # Bar k is bar 0 turned by 90 k degrees: in its own frame the point turns back.
    across = np.stack([x, y, -x, -y], -1) - geometry.radius_m
    along = np.stack([y, -x, -y, x], -1)
    upper = np.ones_like(across)
    lower = np.ones_like(across)
    slope = np.zeros((3, *across.shape)) if gradient else np.empty((3, 0))
    for end in (-1, 1):
        v = along + end * geometry.bar_length_m / 2
        for depth in (0, 1):
            s = (z + depth * geometry.bar_height_m)[..., None]
            square = np.maximum(v * v + s * s, NEAREST_M**2)
            for side in (-1, 1):
                u = across - side * geometry.bar_width_m / 2
                rho = np.sqrt(u * u + square)
                # rho - u without the loss of digits where u is positive
                rest = np.where(u > 0, square / (rho + np.abs(u)), rho - u)
                sign = -end * side * (1 - 2 * depth)
                if sign > 0:
                    upper *= rest
                else:
                    lower *= rest
                if gradient:
                    slope[0] -= sign / rho
                    slope[1] += sign * v / (rho * rest)
                    slope[2] += sign * s / (rho * rest)
    field = scale * np.log(upper / lower)
    if not gradient:
        return field, np.empty(0)
    du, dv, dz = scale * slope
    # Turned back: x along +u, +-v of the four bars.
    dx = np.stack([du[..., 0], -dv[..., 1], -du[..., 2], dv[..., 3]], -1)
    dy = np.stack([dv[..., 0], du[..., 1], -dv[..., 2], -du[..., 3]], -1)
    return field, np.stack([dx, dy, dz], -1)
