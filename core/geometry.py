"""Algebra of rotations, rigid motions, planes, homographies and similarities on whole arrays.

Conventions: a rotation matrix or quaternion maps device axes to frame axes; quaternions are
(x, y, z, w) with unit length; a homogeneous transform multiplies column vectors from the left;
angles are in radians. Unless stated otherwise, functions broadcast over leading dimensions.

Quaternions are processed component by component and results are stored component-major, which
is several times as fast for long arrays as operating on rows of four.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import DegenerateError

Array = NDArray[np.float64]

MIN_SINE = 1e-9
"""Sine of the angle between two quaternions below which :func:`slerp` interpolates linearly: the
results differ by less than 1e-18, and the division by the sine would amplify rounding."""

MIN_QUATERNION_VECTOR_NORM = 1e-12
"""Length of a quaternion's vector part below which the rotation vector is twice that part; the
relative error is of the order of its square."""

MAX_COLLINEAR_RATIO = 1e-9
"""Ratio of the second to the first singular value of centred points up to which they count as
collinear: about the rounding of coordinates that are 1e7 times as large as the extent."""

MAX_DEGENERATE_RATIO = 1e-12
"""Ratio of singular values of a system in squares or products of coordinates up to which it counts
as rank deficient; a few thousand times the rounding of float64."""


# ---- rotations


def skew(vectors: ArrayLike) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3).

    ``skew(a) @ b`` is the cross product of a and b.
    """
    v = np.asarray(vectors, float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def quaternion_multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the Hamilton product (..., 4): rotate by ``second``, then by ``first``."""
    a, b = np.asarray(first, float), np.asarray(second, float)
    ax, ay, az, aw = _components(a)
    bx, by, bz, bw = _components(b)
    product = np.empty((4, *_broadcast(a.shape[:-1], b.shape[:-1])))
    product[0] = aw * bx + ax * bw + ay * bz - az * by
    product[1] = aw * by - ax * bz + ay * bw + az * bx
    product[2] = aw * bz + ax * by - ay * bx + az * bw
    product[3] = aw * bw - ax * bx - ay * by - az * bz
    return _rows(product)


def quaternion_inverse(quaternion: ArrayLike) -> Array:
    """Return the inverse rotations (..., 4) of unit quaternions (..., 4)."""
    return np.asarray(quaternion, float) * np.array([-1.0, -1.0, -1.0, 1.0])


def quaternion_rotate(quaternion: ArrayLike, vectors: ArrayLike) -> Array:
    """Rotate vectors (..., 3) by quaternions (..., 4)."""
    q, v = np.asarray(quaternion, float), np.asarray(vectors, float)
    qx, qy, qz, qw = _components(q)
    x, y, z = _components(v)
    # v + 2 w (q x v) + 2 q x (q x v), with t = 2 (q x v)
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    rotated = np.empty((3, *_broadcast(q.shape[:-1], v.shape[:-1])))
    rotated[0] = x + qw * tx + qy * tz - qz * ty
    rotated[1] = y + qw * ty + qz * tx - qx * tz
    rotated[2] = z + qw * tz + qx * ty - qy * tx
    return _rows(rotated)


def quaternion_angle(quaternion: ArrayLike) -> Array:
    """Return the angles (...) of rotations (..., 4), from 0 to pi.

    They are exact to rounding at both ends of the range.
    """
    x, y, z, w = _components(np.asarray(quaternion, float))
    return np.asarray(2 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w)))


def rotation_vector_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3), at most pi long, of quaternions (..., 4)."""
    q = np.asarray(quaternion, float)
    x, y, z, w = _components(q)
    norm = np.sqrt(x * x + y * y + z * z)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(
            norm > MIN_QUATERNION_VECTOR_NORM, 2 * np.arctan2(norm, np.abs(w)) / norm, 2.0
        )
    return np.where(w < 0, -factor, factor)[..., None] * q[..., :3]


def slerp(first: ArrayLike, second: ArrayLike, fraction: ArrayLike) -> Array:
    """Interpolate rotations (..., 4) along the shorter great circle.

    ``fraction`` (...) is 0 at ``first`` and 1 at ``second``. Shoemake, Animating rotation with
    quaternion curves, SIGGRAPH 1985.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    fraction = np.asarray(fraction, float)
    cosine = np.einsum("...i,...i->...", first, second)
    sign = np.where(cosine < 0, -1.0, 1.0)
    # The angle is taken from the chord, because the cosine of a small angle has lost its digits.
    chord = np.linalg.norm(second * sign[..., None] - first, axis=-1)
    half_angle = np.arcsin(np.minimum(chord / 2, 1.0))
    sine = np.sin(2 * half_angle)
    is_small = sine < MIN_SINE
    divisor = np.where(is_small, 1.0, sine)
    a = np.where(is_small, 1 - fraction, np.sin((1 - fraction) * 2 * half_angle) / divisor)
    b = np.where(is_small, fraction, np.sin(fraction * 2 * half_angle) / divisor)
    mixed = a[..., None] * first + (b * sign)[..., None] * second
    return np.asarray(mixed / np.linalg.norm(mixed, axis=-1)[..., None])


def _components(array: Array) -> list[Array]:
    """Split an array into its components along the last axis."""
    return [array[..., k] for k in range(array.shape[-1])]


def _broadcast(first: tuple[int, ...], second: tuple[int, ...]) -> tuple[int, ...]:
    """Broadcast two shapes; equal ones at no cost."""
    return first if first == second else np.broadcast_shapes(first, second)


def _rows(components: Array) -> Array:
    """Move the components from the first axis to the last, without a copy."""
    return components.transpose(*range(1, components.ndim), 0)


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    q = np.asarray(quaternion, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    cross = skew(q[..., :3])
    w = q[..., 3, None, None]
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Return the quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3).

    Notes
    -----
    Among the four possible divisors the largest one is used (Shepperd, J. Guidance and Control 1
    (1978) 223), so that no angle loses digits.
    """
    r = np.asarray(rotation, float)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    transpose = np.swapaxes(r, -1, -2)
    antisymmetric, symmetric = r - transpose, r + transpose
    x, y, z = antisymmetric[..., 2, 1], antisymmetric[..., 0, 2], antisymmetric[..., 1, 0]
    xy, xz, yz = symmetric[..., 1, 0], symmetric[..., 0, 2], symmetric[..., 2, 1]
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
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def quaternion_from_heading(heading_rad: ArrayLike) -> Array:
    """Return the quaternions (..., 4) of rotations about z."""
    half = np.asarray(heading_rad, float) / 2
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def heading_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return the headings (...) in (-pi, pi]: directions of the device's x axis in the xy plane."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Return the equivalent angles (...) in [-pi, pi)."""
    return np.asarray(np.remainder(np.asarray(angle_rad, float) + np.pi, 2 * np.pi) - np.pi)


def rotation_matrix_2d(angle_rad: float) -> Array:
    """Return the counter-clockwise rotation (2, 2) by an angle."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def rotation_exp(vectors: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) (axis times angle).

    Rodrigues' formula; exact to rounding at zero and at any angle.
    """
    v = np.asarray(vectors, float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    cross = skew(v)
    # sinc keeps sin(a)/a and (1 - cos a)/a^2 = sinc(a/2)^2 / 2 regular at zero.
    sine = np.sinc(angle / np.pi)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def rotation_angle(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the angles (...), from 0 to pi, between rotations (..., 3, 3).

    An angle below about 1e-8 is lost in the rounding of the cosine.
    """
    trace = np.einsum("...ij,...ij->...", np.asarray(first, float), np.asarray(second, float))
    return np.asarray(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


# ---- rigid motions


def se3(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transform = np.zeros((*shape, 4, 4))
    transform[..., :3, :3], transform[..., :3, 3] = rotation, translation
    transform[..., 3, 3] = 1.0
    return transform


def rigid_inverse(transform: ArrayLike) -> Array:
    """Invert rigid transforms, (..., 3, 3) in the plane or (..., 4, 4) in space."""
    t = np.asarray(transform, float)
    n = t.shape[-1] - 1
    inverse = np.zeros_like(t)
    inverse[..., :n, :n] = np.swapaxes(t[..., :n, :n], -1, -2)
    inverse[..., :n, n:] = -inverse[..., :n, :n] @ t[..., :n, n:]
    inverse[..., n, n] = 1.0
    return inverse


def transform_points(transform: ArrayLike, points: ArrayLike) -> Array:
    """Apply one affine transform (d+1, d+1) to points (..., d)."""
    t = np.asarray(transform, float)
    return np.asarray(points, float) @ t[:-1, :-1].T + t[:-1, -1]


def transform_covariance(covariance: ArrayLike, scale: float, rotation: ArrayLike) -> Array:
    """Transform covariances of poses by a similarity of their frame.

    Parameters
    ----------
    covariance : (..., k, k) ndarray
        k >= 6; the first six unknowns are position and rotation vector, both along the axes of
        the frame. Further unknowns do not depend on the frame.
    scale : float
    rotation : (3, 3) ndarray
        From the old frame to the new one.

    Returns
    -------
    (..., k, k) ndarray
    """
    covariance, rotation = np.asarray(covariance, float), np.asarray(rotation, float)
    jacobian = np.eye(covariance.shape[-1])
    jacobian[0:3, 0:3] = scale * rotation
    jacobian[3:6, 3:6] = rotation
    return np.asarray(jacobian @ covariance @ jacobian.T)


# ---- planes and homographies


def fit_plane(points: ArrayLike, weights: ArrayLike | None = None) -> tuple[Array, Array]:
    """Fit a plane to points (n, 3) by least (weighted) squared distances.

    Returns
    -------
    centre, normal : (3,) ndarray
        The centroid and the unit normal, of which the largest component is positive.

    Raises
    ------
    DegenerateError
        There are fewer than three points, or they are collinear.
    """
    points = np.asarray(points, float)
    w = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    if np.count_nonzero(w) < 3:
        raise DegenerateError("a plane needs at least three points")
    centre = np.average(points, axis=0, weights=w)
    _, extents, axes = np.linalg.svd((points - centre) * np.sqrt(w)[:, None], full_matrices=False)
    if extents[1] <= MAX_COLLINEAR_RATIO * extents[0]:
        raise DegenerateError("the points are collinear and do not determine a plane")
    normal = axes[2] * np.sign(axes[2][np.argmax(np.abs(axes[2]))])
    return centre, normal


def fit_homography(source: ArrayLike, target: ArrayLike) -> Array:
    """Fit a homography (3, 3) that maps planar points ``source`` (n, 2) to ``target`` (n, 2).

    Direct linear transform with normalised coordinates (Hartley and Zisserman, Multiple
    View Geometry, 2nd ed., algorithm 4.2): exact for four points, least algebraic squares
    for more.

    Raises
    ------
    DegenerateError
        There are fewer than four points, or three of four are collinear.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    if len(source) < 4:
        raise DegenerateError(f"a homography needs at least four points, not {len(source)}")
    to_source, to_target = _normaliser(source), _normaliser(target)
    p = apply_homography(to_source, source)
    u, v = apply_homography(to_target, target).T
    homogeneous, zeros = np.hstack([p, np.ones((len(p), 1))]), np.zeros((len(p), 3))
    system = np.vstack(
        [
            np.hstack([homogeneous, zeros, -u[:, None] * homogeneous]),
            np.hstack([zeros, homogeneous, -v[:, None] * homogeneous]),
        ]
    )
    # The triangular factor has the same right singular vectors and at most nine rows.
    _, values, vectors = np.linalg.svd(np.linalg.qr(system, mode="r"))
    if len(values) < 8 or values[7] <= MAX_DEGENERATE_RATIO * values[0]:
        raise DegenerateError("the points do not determine a homography: too many are collinear")
    homography = np.linalg.solve(to_target, vectors[-1].reshape(3, 3) @ to_source)
    return homography / np.linalg.norm(homography)


def _normaliser(points: Array) -> Array:
    """Return the similarity (3, 3) that centres points at a mean distance of sqrt(2)."""
    centre = points.mean(axis=0)
    mean_distance = np.linalg.norm(points - centre, axis=1).mean()
    if not mean_distance > 0:
        raise DegenerateError("all points coincide")
    scale = np.sqrt(2) / mean_distance
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])


def apply_homography(homography: ArrayLike, points: ArrayLike) -> Array:
    """Apply a homography (3, 3) to planar points (..., 2)."""
    h = np.asarray(homography, float)
    homogeneous = np.asarray(points, float) @ h[:, :2].T + h[:, 2]
    return homogeneous[..., :2] / homogeneous[..., 2:]


# ---- similarities


@dataclass(frozen=True)
class Similarity:
    """Transform ``scale * rotation @ point + translation``; rigid if ``scale`` is 1.

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
        """Return the identity transform."""
        return cls(1.0, np.eye(dimension), np.zeros(dimension))

    def apply(self, points: ArrayLike) -> Array:
        """Transform points (..., d)."""
        return self.scale * (np.asarray(points, float) @ self.rotation.T) + self.translation

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix (d+1, d+1)."""
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
    """Estimate the similarity or rigid motion that maps ``source`` closest to ``target``.

    Parameters
    ----------
    source, target : (n, d) ndarray
        Matched points, d = 2 or 3.
    weights : (n,) ndarray, optional
        Non-negative weights of the squared distances.
    with_scale : bool
        Estimate the scale; otherwise it is 1.

    Raises
    ------
    DegenerateError
        The points do not determine the rotation: they coincide, or for d = 3 are collinear.

    Notes
    -----
    Umeyama, IEEE PAMI 13 (1991) 376, eq. 34 to 43. The result is never a reflection. Coplanar
    points suffice in space, but a mirrored plane then matches as well, rotated by half a turn.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    if len(source) == 0 or not w.sum() > 0:
        raise DegenerateError("there are no points to align")
    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    a, b = source - source_mean, target - target_mean
    u, values, vt = np.linalg.svd((b * w[:, None]).T @ a)
    d = source.shape[1]
    # With rank d - 1 the sign rule below still decides; with less, a rotation is undetermined.
    if values[0] <= 0 or values[d - 2] <= MAX_DEGENERATE_RATIO * values[0]:
        shape = "coincide" if d == 2 or values[0] <= 0 else "are collinear"
        raise DegenerateError(f"the points {shape} and do not determine a rotation")
    sign = np.ones(d)
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign) @ vt
    scale = float(values @ sign / (w @ np.sum(a * a, axis=1))) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * (rotation @ source_mean))
