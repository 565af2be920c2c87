"""Vertical field of the four bars of a landmark in closed form, with its gradient."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks.landmark import Geometry, signs

Array = NDArray[np.float64]

MIN_EDGE_DISTANCE_M = 1e-9
"""Minimum distance from the lines of a bar's edges, on which the field is unbounded."""


def basis(geometry: Geometry, points: ArrayLike, height_m: ArrayLike | None = None) -> Array:
    """Return the vertical field of each bar of a landmark, as if it were ``N``.

    The field of a landmark is linear in its bars: ``basis @ (signs * strengths)``.

    Parameters
    ----------
    geometry : Geometry
    points : (..., 2) ndarray
        In the landmark's frame, in metres.
    height_m : float or (...) ndarray, optional
        Above the top faces of the bars; the geometry's sensor height by default. Points at
        negative heights are level with the bars, inside or below them.

    Returns
    -------
    (..., 4) ndarray
        Tesla, upward positive. It also holds inside the material, because the magnetisation is
        horizontal. It is bounded on the edges of the bars, on which the true field is not.

    Notes
    -----
    A cuboid magnetised along its length is equivalent to two charged faces, each of which is the
    difference of logarithms at its corners (Yang, Johansen and Bratsberg, Supercond. Sci.
    Technol. 3 (1990) 591). The corners are combined to the logarithm of one product here, which
    is faster and keeps the digits of far fields.
    """
    return evaluate(geometry, points, height_m, gradient=False)[0]


def basis_gradient(
    geometry: Geometry, points: ArrayLike, height_m: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Return :func:`basis` and its derivatives (..., 4, 3) by x, y and height in T/m."""
    return evaluate(geometry, points, height_m, gradient=True)


def landmark_field(
    geometry: Geometry, code: int, points: ArrayLike, height_m: ArrayLike | None = None
) -> Array:
    """Return the vertical field (...) in tesla of a faultless landmark of the given code."""
    return np.asarray(basis(geometry, points, height_m) @ signs(code))


def evaluate(
    geometry: Geometry, points: ArrayLike, height_m: ArrayLike | None, *, gradient: bool
) -> tuple[Array, Array]:
    """Return the fields of the bars and their gradients (an empty array if not requested)."""
    plane = np.asarray(points, float)
    height = geometry.sensor_height_m if height_m is None else height_m
    position = np.empty((*np.broadcast_shapes(plane.shape[:-1], np.shape(height)), 3))
    position[..., :2] = plane
    position[..., 2] = height
    if kernels is None:
        return evaluate_numpy(geometry, position, gradient=gradient)
    field = np.empty((*position.shape[:-1], 4))
    by_position = np.empty((*position.shape[:-1], 4, 3) if gradient else 0)
    kernels.bar_fields(
        position,
        position[..., 0].size,
        geometry.bar_length_m / 2,
        geometry.bar_width_m / 2,
        geometry.bar_height_m,
        geometry.radius_m,
        geometry.remanence_t,
        MIN_EDGE_DISTANCE_M,
        gradient,
        field,
        by_position,
    )
    return field, by_position


def evaluate_numpy(geometry: Geometry, position: Array, *, gradient: bool) -> tuple[Array, Array]:
    """Evaluate at points (..., 3) of the landmark's frame; numpy twin of the compiled loop."""
    scale = geometry.remanence_t / (4 * math.pi)
    x, y, z = np.moveaxis(position, -1, 0)
    # Bar k is bar 0 rotated by 90 k degrees: in its own frame the point is rotated back.
    across = np.stack([x, y, -x, -y], -1) - geometry.radius_m
    along = np.stack([y, -x, -y, x], -1)
    upper = np.ones_like(across)
    lower = np.ones_like(across)
    by_position = np.zeros((3, *across.shape)) if gradient else np.empty((3, 0))
    for end in (-1, 1):
        v = along + end * geometry.bar_length_m / 2
        for depth in (0, 1):
            s = (z + depth * geometry.bar_height_m)[..., None]
            square = np.maximum(v * v + s * s, MIN_EDGE_DISTANCE_M**2)
            for side in (-1, 1):
                u = across - side * geometry.bar_width_m / 2
                rho = np.sqrt(u * u + square)
                # rho - u, without the loss of digits if u is positive.
                difference = np.where(u > 0, square / (rho + np.abs(u)), rho - u)
                sign = -end * side * (1 - 2 * depth)
                if sign > 0:
                    upper *= difference
                else:
                    lower *= difference
                if gradient:
                    by_position[0] -= sign / rho
                    by_position[1] += sign * v / (rho * difference)
                    by_position[2] += sign * s / (rho * difference)
    field = scale * np.log(upper / lower)
    if not gradient:
        return field, np.empty(0)
    du, dv, dz = scale * by_position
    # Rotated into the frame of the landmark: x is along +u, +-v of the four bars.
    dx = np.stack([du[..., 0], -dv[..., 1], -du[..., 2], dv[..., 3]], -1)
    dy = np.stack([dv[..., 0], du[..., 1], -dv[..., 2], -du[..., 3]], -1)
    return field, np.stack([dx, dy, dz], -1)
