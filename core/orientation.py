"""Orientations of two trajectories: between stamps, turned, and compared.

Quaternions are (x, y, z, w) of unit length, as in :mod:`locatk.core.geometry`. Columns
are computed one by one, which for long arrays is several times as fast as whole rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


def multiply(first: Array, second: Array) -> Array:
    """Hamilton product (n, 4) of quaternions (n, 4) or (4,): ``second``, then ``first``."""
    ax, ay, az, aw = first.T
    bx, by, bz, bw = second.T
    out = np.empty((4, max(first.size, second.size) // 4))
    out[0] = aw * bx + ax * bw + ay * bz - az * by
    out[1] = aw * by - ax * bz + ay * bw + az * bx
    out[2] = aw * bz + ax * by - ay * bx + az * bw
    out[3] = aw * bw - ax * bx - ay * by - az * bz
    return out.T


def inverse(quaternion: Array) -> Array:
    """The opposite rotations (n, 4)."""
    return quaternion * np.array([-1.0, -1.0, -1.0, 1.0])


def rotate(quaternion: Array, vectors: Array) -> Array:
    """Vectors (n, 3), each turned by its quaternion (n, 4)."""
    qx, qy, qz, qw = quaternion.T
    x, y, z = vectors.T
    # v + 2 w (q x v) + 2 q x (q x v)
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    out = np.empty((3, len(qx)))
    out[0] = x + qw * tx + qy * tz - qz * ty
    out[1] = y + qw * ty + qz * tx - qx * tz
    out[2] = z + qw * tz + qx * ty - qy * tx
    return out.T


def angle(quaternion: Array) -> Array:
    """Angles (n,) of rotations (n, 4), from 0 to pi; exact to rounding at both ends."""
    x, y, z, w = quaternion.T
    return np.asarray(2 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w)))


def rotation_vector(quaternion: Array) -> Array:
    """Rotation vectors (n, 3), at most pi long, of rotations (n, 4)."""
    x, y, z, w = quaternion.T
    length = np.sqrt(x * x + y * y + z * z)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(length > 1e-12, 2 * np.arctan2(length, np.abs(w)) / length, 2.0)
    return np.where(w < 0, -factor, factor)[:, None] * quaternion[:, :3]


def slerp(first: Array, second: Array, share: Array) -> Array:
    """Between ``first`` (share 0) and ``second`` (share 1), the short way round; (n, 4).

    Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    cosine = np.einsum("ij,ij->i", first, second)
    sign = np.where(cosine < 0, -1.0, 1.0)
    # From the chord: the cosine of a small angle has lost its digits.
    chord = np.linalg.norm(second * sign[:, None] - first, axis=1)
    half = np.arcsin(np.minimum(chord / 2, 1.0))
    sine = np.sin(2 * half)
    near = sine < 1e-9
    safe = np.where(near, 1.0, sine)
    a = np.where(near, 1 - share, np.sin((1 - share) * 2 * half) / safe)
    b = np.where(near, share, np.sin(share * 2 * half) / safe)
    out = a[:, None] * first + (b * sign)[:, None] * second
    return np.asarray(out / np.linalg.norm(out, axis=1)[:, None])


def told(trajectory: Trajectory, *, at_its_word: bool = False) -> NDArray[np.bool_]:
    """Which poses (n,) tell an orientation.

    None is told by a pose whose position has a covariance and whose rotation has none (a
    single photodiode), nor by a trajectory of unknown covariance that holds nothing but the
    identity (a point). ``at_its_word`` believes the latter.
    """
    turn = np.stack([trajectory.covariance[:, k, k] for k in (3, 4, 5)])
    known = np.any(np.isfinite(turn), axis=0)
    if not at_its_word and not known.any() and _identity(trajectory.quaternion):
        return known
    return known | np.isnan(trajectory.covariance[:, 0, 0])


def _identity(quaternion: Array) -> bool:
    return bool(np.all(quaternion[:, :3] == 0.0))
