"""Two stations that saw the same photodiodes: where they stand, up to scale.

A station sees a photodiode along a ray (1, y, z), as a camera does. Two relations are
fitted: a homography, right where all photodiodes lie on one plane, and an essential matrix,
right where they do not (Hartley and Zisserman, Multiple View Geometry, 2nd ed., chapters 9
and 13). Each gives candidate rigs in the first station's axes; nothing is chosen here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.robust import consensus

Array = NDArray[np.float64]

GATE = 0.01
"""Residual of a correspondence that can still be right, as a tangent: calibration error
plus the motion of a robot between the sweeps of two stations."""


def fit_homography(a: Array, b: Array) -> Array:
    """Homographies with b ~ H a, by direct linear transform.

    ``a`` and ``b`` are (..., n, 3) rays or homogeneous points, n >= 4; returns (..., 3, 3).
    By normal equations, for samples by the hundred and degenerate ones among them;
    :func:`locatk.core.geometry.fit_homography` fits one set to rounding, or refuses it.
    The points are conditioned by the centroid and size of each set (Hartley 1997).
    """
    a, from_a = _conditioned(a)
    b, from_b = _conditioned(b)
    zero = np.zeros_like(a)
    rows = np.concatenate(
        [
            np.concatenate([-b[..., 1:2] * a, b[..., 0:1] * a, zero], axis=-1),
            np.concatenate([-b[..., 2:3] * a, zero, b[..., 0:1] * a], axis=-1),
        ],
        axis=-2,
    )
    return np.linalg.inv(from_b) @ _null_vector(rows) @ from_a


def homography_residuals(h: Array, a: Array, b: Array) -> Array:
    """(..., n) distances of H a from b in the image plane at x = 1, as tangents."""
    moved = a @ np.swapaxes(h, -1, -2)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = moved[..., 1:] / moved[..., :1]
        return np.linalg.norm(moved - (b / b[..., :1])[..., 1:], axis=-1)


def fit_epipolar(a: Array, b: Array) -> Array:
    """Matrices with b E a = 0, by the normalised eight-point method.

    ``a`` and ``b`` are (..., n, 3) rays, n >= 8; returns (..., 3, 3). They are not forced
    to be essential: in a narrow field that would spoil the fit (:func:`split_essential`
    takes the nearest essential matrix).
    """
    a, from_a = _conditioned(a)
    b, from_b = _conditioned(b)
    rows = (b[..., :, None] * a[..., None, :]).reshape(*a.shape[:-1], 9)
    return np.swapaxes(from_b, -1, -2) @ _null_vector(rows) @ from_a


def epipolar_residuals(e: Array, a: Array, b: Array) -> Array:
    """(..., n) Sampson distances, as tangents (Hartley and Zisserman eq. 11.9)."""
    line_b = a @ np.swapaxes(e, -1, -2)
    line_a = b @ e
    algebraic = np.sum(b * line_b, axis=-1)
    slope = np.sum(line_b[..., 1:] ** 2, axis=-1) + np.sum(line_a[..., 1:] ** 2, axis=-1)
    return algebraic / np.sqrt(slope + 1e-300)


def _conditioned(points: Array) -> tuple[Array, Array]:
    """Points (..., n, 3) moved and scaled to unit spread, and the (..., 3, 3) that does it."""
    points = points / points[..., :1]
    mean = points[..., 1:].mean(axis=-2)
    size = np.sqrt(np.mean((points[..., 1:] - mean[..., None, :]) ** 2, axis=(-1, -2)))
    scale = 1.0 / np.maximum(size, 1e-12)
    transform = np.zeros((*points.shape[:-2], 3, 3))
    transform[..., 0, 0] = 1.0
    transform[..., 1:, 0] = -mean * scale[..., None]
    transform[..., 1, 1] = transform[..., 2, 2] = scale
    return points @ np.swapaxes(transform, -1, -2), transform


def _null_vector(rows: Array) -> Array:
    normal = np.swapaxes(rows, -1, -2) @ rows
    return np.linalg.eigh(normal)[1][..., 0].reshape(*rows.shape[:-2], 3, 3)


def agree_on_plane(a: Array, b: Array, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
    """Homography and the (n,) correspondences that agree with it."""
    return consensus(fit_homography, homography_residuals, a, b, sample=4, gate=GATE, seed=seed)


def agree_in_space(a: Array, b: Array, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
    """Epipolar matrix and the (n,) correspondences that agree with it."""
    return consensus(
        fit_epipolar, epipolar_residuals, a, b, sample=8, gate=GATE, trials=150, seed=seed
    )


def split_homography(h: Array) -> list[tuple[Array, Array, Array]]:
    """Motions behind a homography between two calibrated views.

    Returns
    -------
    list of (rotation, translation, normal)
        b = R a + t for points with normal . a = 1; the four of Ma, Soatto, Kosecka and
        Sastry, An Invitation to 3-D Vision, 5.3.3 (the paper's Eq. 5 to 10 give two of
        them). Empty where the stations stand at one place.
    """
    h = h / np.linalg.svd(h)[1][1]
    if np.linalg.det(h) < 0:
        h = -h
    values, vectors = np.linalg.eigh(h.T @ h)
    s3, _, s1 = values
    if s1 - s3 < 1e-9:
        return []
    v3, v2, v1 = vectors.T
    near, far = np.sqrt(max(1 - s3, 0.0)) * v1, np.sqrt(max(s1 - 1, 0.0)) * v3
    motions = []
    for u in (near + far, near - far):
        u = u / np.sqrt(s1 - s3)
        normal = np.cross(v2, u)
        before = np.stack([v2, u, normal], axis=1)
        after = np.stack([h @ v2, h @ u, np.cross(h @ v2, h @ u)], axis=1)
        rotation = after @ before.T
        translation = (h - rotation) @ normal
        motions += [(rotation, translation, normal), (rotation, -translation, -normal)]
    return motions


def split_essential(e: Array) -> list[tuple[Array, Array]]:
    """The four (rotation, translation) behind the essential matrix nearest to ``e``,
    b = R a + t (Hartley and Zisserman, result 9.19); translations have unit length."""
    u, _, vt = np.linalg.svd(e)
    u *= np.sign(np.linalg.det(u))
    vt *= np.sign(np.linalg.det(vt))
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [(u @ turn @ vt, sign * u[:, 2]) for turn in (w, w.T) for sign in (1.0, -1.0)]


def upright_motions(
    a: Array, b: Array, turns: int = 36, best: int = 3
) -> list[tuple[Array, Array]]:
    """The likeliest motions between two stations that both stand upright and level.

    For each turn about the vertical the translation follows linearly, as the direction
    most nearly normal to all b x R a. Only a start for an adjustment: stations lean.
    """
    heading = np.linspace(0, 2 * np.pi, turns, endpoint=False)
    cos, sin = np.cos(heading), np.sin(heading)
    rotation = np.zeros((turns, 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = cos
    rotation[:, 0, 1], rotation[:, 1, 0] = -sin, sin
    rotation[:, 2, 2] = 1.0
    across = np.cross(b, a @ np.swapaxes(rotation, -1, -2))
    values, vectors = np.linalg.eigh(np.swapaxes(across, -1, -2) @ across)
    chosen = np.argsort(values[:, 0] / values[:, 1])[:best]
    return [(rotation[k], sign * vectors[k, :, 0]) for k in chosen for sign in (1.0, -1.0)]


def triangulate(a: Array, b: Array, rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Depths along rays ``a`` and ``b`` (n, 3) where they come closest, b = R a + t.

    Midpoint method; depths are ``inf`` or huge where the rays are parallel.
    """
    turned = a @ rotation.T
    aa, bb, ab = (np.sum(p * q, axis=-1) for p, q in ((turned, turned), (b, b), (turned, b)))
    at, bt = -turned @ translation, -b @ translation
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = aa * bb - ab**2
        return (at * bb - ab * bt) / determinant, (ab * at - aa * bt) / determinant
