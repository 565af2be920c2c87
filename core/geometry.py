"""Rotations, rigid motions, planes and alignments on whole arrays.

Conventions: a rotation matrix or quaternion takes device axes to frame axes; quaternions
are (x, y, z, w) with unit length; a homogeneous transform multiplies column vectors from
the left; angles are radians. All functions broadcast over leading dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import DegenerateError

Array = NDArray[np.float64]


# ---- rotations


def skew(vectors: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(a) @ b`` is a x b."""
    v = np.asarray(vectors, float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def quaternion_multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Hamilton product (..., 4): the rotation ``second``, then ``first``."""
    a, b = np.broadcast_arrays(np.asarray(first, float), np.asarray(second, float))
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    return np.concatenate([vector, aw * bw - np.sum(av * bv, axis=-1, keepdims=True)], axis=-1)


def quaternion_conjugate(quaternion: ArrayLike) -> Array:
    """The opposite rotation (..., 4)."""
    return np.asarray(quaternion, float) * [-1.0, -1.0, -1.0, 1.0]


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), which need not be of unit length."""
    q = np.asarray(quaternion, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    cross = skew(q[..., :3])
    w = q[..., 3, None, None]
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3).

    Notes
    -----
    Of the four ways to divide, the one with the largest divisor is taken (Shepperd,
    J. Guidance and Control 1 (1978) 223), so that no angle loses digits.
    """
    r = np.asarray(rotation, float)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    turned = np.swapaxes(r, -1, -2)
    odd, even = r - turned, r + turned
    x, y, z = odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]
    xy, xz, yz = even[..., 1, 0], even[..., 0, 2], even[..., 2, 1]
    # Row k is 4 q_k times the quaternion: the outer product of the quaternion with itself.
    outer = np.stack(
        [
            np.stack([1 + xx - yy - zz, xy, xz, x], axis=-1),
            np.stack([xy, 1 - xx + yy - zz, yz, y], axis=-1),
            np.stack([xz, yz, 1 - xx - yy + zz, z], axis=-1),
            np.stack([x, y, z, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def quaternion_from_heading(heading_rad: ArrayLike) -> Array:
    """Quaternions (..., 4) of rotations about z."""
    half = np.asarray(heading_rad, float) / 2
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def heading_of(quaternion: ArrayLike) -> Array:
    """Heading (...) in (-pi, pi]: the direction of the device's x axis in the xy plane."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def rotation_exp(vectors: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) (axis times angle).

    Rodrigues' formula; exact to rounding at zero and at any angle.
    """
    v = np.asarray(vectors, float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    cross = skew(v)
    # sinc keeps sin(a)/a and (1 - cos a)/a^2 = sinc(a/2)^2 / 2 regular at zero.
    sine = np.sinc(angle / np.pi)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def rotation_log(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3), at most pi long, of rotation matrices (..., 3, 3)."""
    q = quaternion_from_matrix(rotation)
    length = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2 * np.arctan2(length, q[..., 3])
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(length > 1e-12, angle / length, 2.0)
    return factor[..., None] * q[..., :3]


# ---- rigid motions


def se2(x: ArrayLike, y: ArrayLike, heading_rad: ArrayLike) -> Array:
    """Planar transforms (..., 3, 3): rotate by the heading, then shift by (x, y)."""
    x, y, heading = np.broadcast_arrays(x, y, heading_rad)
    transform = np.zeros((*x.shape, 3, 3))
    transform[..., 0, 0] = transform[..., 1, 1] = np.cos(heading)
    transform[..., 1, 0] = np.sin(heading)
    transform[..., 0, 1] = -transform[..., 1, 0]
    transform[..., 0, 2], transform[..., 1, 2], transform[..., 2, 2] = x, y, 1.0
    return transform


def se3(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Spatial transforms (..., 4, 4) of rotations (..., 3, 3) and shifts (..., 3)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transform = np.zeros((*shape, 4, 4))
    transform[..., :3, :3], transform[..., :3, 3] = rotation, translation
    transform[..., 3, 3] = 1.0
    return transform


def rigid_inverse(transform: ArrayLike) -> Array:
    """Inverse of rigid transforms, (..., 3, 3) in the plane or (..., 4, 4) in space."""
    t = np.asarray(transform, float)
    n = t.shape[-1] - 1
    inverse = np.zeros_like(t)
    inverse[..., :n, :n] = np.swapaxes(t[..., :n, :n], -1, -2)
    inverse[..., :n, n:] = -inverse[..., :n, :n] @ t[..., :n, n:]
    inverse[..., n, n] = 1.0
    return inverse


def transform_points(transform: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., d) moved by one affine transform (d+1, d+1)."""
    t = np.asarray(transform, float)
    return np.asarray(points, float) @ t[:-1, :-1].T + t[:-1, -1]


# ---- planes and homographies


def fit_plane(points: ArrayLike, weights: ArrayLike | None = None) -> tuple[Array, Array]:
    """Plane through points (n, 3) with the least (weighted) squared distances.

    Returns
    -------
    centre, normal : (3,) ndarray
        The centroid and the unit normal, of which the largest component is positive.

    Raises
    ------
    DegenerateError
        The points are fewer than three or lie on a line.
    """
    points = np.asarray(points, float)
    w = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    if np.count_nonzero(w) < 3:
        raise DegenerateError("a plane needs three points or more")
    centre = np.average(points, axis=0, weights=w)
    _, spread, axes = np.linalg.svd((points - centre) * np.sqrt(w)[:, None], full_matrices=False)
    if spread[1] <= 1e-9 * spread[0]:
        raise DegenerateError("the points lie on a line and do not determine a plane")
    normal = axes[2] * np.sign(axes[2][np.argmax(np.abs(axes[2]))])
    return centre, normal


def fit_homography(source: ArrayLike, target: ArrayLike) -> Array:
    """Homography (3, 3) that takes planar points ``source`` (n, 2) to ``target`` (n, 2).

    Direct linear transform with normalised coordinates (Hartley and Zisserman, Multiple
    View Geometry, 2nd ed., algorithm 4.2): exact for four points, least algebraic squares
    for more.

    Raises
    ------
    DegenerateError
        There are fewer than four points, or three of four lie on a line.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    if len(source) < 4:
        raise DegenerateError(f"a homography needs four points or more, not {len(source)}")
    to_source, to_target = _normaliser(source), _normaliser(target)
    p = apply_homography(to_source, source)
    u, v = apply_homography(to_target, target).T
    one, zero = np.ones((len(p), 1)), np.zeros((len(p), 3))
    row = np.hstack([p, one])
    system = np.vstack(
        [np.hstack([row, zero, -u[:, None] * row]), np.hstack([zero, row, -v[:, None] * row])]
    )
    # The triangular factor has the same right singular vectors and at most nine rows.
    _, size, vectors = np.linalg.svd(np.linalg.qr(system, mode="r"))
    if len(size) < 8 or size[7] <= 1e-12 * size[0]:
        raise DegenerateError("the points do not determine a homography: too many lie on a line")
    homography = np.linalg.solve(to_target, vectors[-1].reshape(3, 3) @ to_source)
    return homography / np.linalg.norm(homography)


def _normaliser(points: Array) -> Array:
    """Similarity that centres points and brings them to a mean distance of sqrt(2)."""
    centre = points.mean(axis=0)
    spread = np.linalg.norm(points - centre, axis=1).mean()
    if not spread > 0:
        raise DegenerateError("all points are the same place")
    scale = np.sqrt(2) / spread
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])


def apply_homography(homography: ArrayLike, points: ArrayLike) -> Array:
    """Planar points (..., 2) moved by a homography (3, 3)."""
    h = np.asarray(homography, float)
    moved = np.asarray(points, float) @ h[:, :2].T + h[:, 2]
    return moved[..., :2] / moved[..., 2:]


# ---- alignment


@dataclass(frozen=True)
class Similarity:
    """``scale * rotation @ point + translation``; rigid where ``scale`` is 1.

    Attributes
    ----------
    scale : float
    rotation : (d, d) ndarray
    translation : (d,) ndarray
    """

    scale: float
    rotation: Array
    translation: Array

    @classmethod
    def identity(cls, dimension: int = 3) -> Similarity:
        """The transform that changes nothing."""
        return cls(1.0, np.eye(dimension), np.zeros(dimension))

    def apply(self, points: ArrayLike) -> Array:
        """Points (..., d), moved."""
        return self.scale * (np.asarray(points, float) @ self.rotation.T) + self.translation

    @property
    def matrix(self) -> Array:
        """(d+1, d+1) homogeneous matrix."""
        d = len(self.translation)
        matrix = np.eye(d + 1)
        matrix[:d, :d], matrix[:d, d] = self.scale * self.rotation, self.translation
        return matrix


def umeyama(
    source: ArrayLike,
    target: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    with_scale: bool = True,
) -> Similarity:
    """Similarity or rigid motion that brings ``source`` closest to ``target``.

    Parameters
    ----------
    source, target : (n, d) ndarray
        Matched points, d = 2 or 3.
    weights : (n,) ndarray, optional
        Not negative; least weighted squares.
    with_scale : bool
        False keeps the scale at 1.

    Raises
    ------
    DegenerateError
        The points do not fix the rotation: all in one place, or for d = 3 on a line.

    Notes
    -----
    Umeyama, IEEE PAMI 13 (1991) 376, eq. 34 to 43. Never a reflection. Points of a plane
    are enough in space, but then a mirrored plane is matched too, by turning it over.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    if len(source) == 0 or not w.sum() > 0:
        raise DegenerateError("there are no points to align")
    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    a, b = source - source_mean, target - target_mean
    u, size, vt = np.linalg.svd((b * w[:, None]).T @ a)
    d = source.shape[1]
    # With rank d - 1 the sign rule below still decides; with less, a turn is free.
    if size[0] <= 0 or size[d - 2] <= 1e-12 * size[0]:
        shape = "are all in one place" if d == 2 or size[0] <= 0 else "lie on a line"
        raise DegenerateError(f"the points {shape} and do not determine a rotation")
    sign = np.ones(d)
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign) @ vt
    scale = float(size @ sign / (w @ np.sum(a * a, axis=1))) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * (rotation @ source_mean))
