"""How dots on a flat sheet come to a frame: as a homography, or from a pose.

Lengths in a frame are in half its diagonal, from its middle; lengths on the sheet in any
unit, from any origin, x right and y *down*.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp, skew

Array = NDArray[np.float64]

CENTRE, RADIAL, LOG_FOCAL, ASPECT = slice(0, 2), 2, 3, 4
"""What all frames share: centre (two), k, logarithm of the focal length, and the sheet's
scale along x over that along y, minus 1."""


class Model(Protocol):
    """What a frame has of its own (n, q), and what follows from it."""

    def flat(self, shared: Array, own: Array, plane: Array) -> tuple[Array, Array, Array]:
        """Places in the frame without distortion, from the centre.

        Parameters
        ----------
        shared : (5,) ndarray
        own : (n, q) ndarray
        plane : (n, m, 2) ndarray
            Places on the sheet.

        Returns
        -------
        at : (n, m, 2) ndarray
        by_own : (n, m, 2, p) ndarray
            Derivatives by the steps that :meth:`moved` takes.
        by_shared : (n, m, 2, 2) ndarray
            Derivatives by logarithm of the focal length, and aspect.
        """

    def moved(self, own: Array, step: Array) -> Array:
        """``own`` after steps (n, p)."""


class Homographies:
    """A frame is eight numbers: (a x + b y + c) / (1 + g x + h y), (d x + e y + f) / ..."""

    def flat(self, shared: Array, own: Array, plane: Array) -> tuple[Array, Array, Array]:
        depth = 1 + plane @ own[:, 6:, None]
        rays = np.concatenate([plane, np.ones_like(depth)], axis=2) / depth
        at = rays @ own[:, :6].reshape(-1, 2, 3).transpose(0, 2, 1)
        by_own = np.zeros((*at.shape, 8))
        by_own[..., 0, 0:3] = by_own[..., 1, 3:6] = rays
        by_own[..., 6:] = -at[..., :, None] * rays[..., None, :2]
        return at, by_own, np.zeros((*at.shape, 2))

    def moved(self, own: Array, step: Array) -> Array:
        return own + step


class Poses:
    """A frame is a rotation (nine numbers), a shift (two) and a scale, sheet over frame.

    Scale times focal length is the distance: the focal length is left with the perspective
    alone, and an untilted frame knows nothing of it.
    """

    def flat(self, shared: Array, own: Array, plane: Array) -> tuple[Array, Array, Array]:
        inverse_focal = math.exp(-shared[LOG_FOCAL])
        axes = own[:, :9].reshape(-1, 3, 3)[:, :, :2].transpose(0, 2, 1)
        stretch = np.array([0.5, -0.5])
        turned = (plane * (1 + shared[ASPECT] * stretch)) @ axes
        by_aspect = (plane * stretch) @ axes
        depth = own[:, None, 11:] + inverse_focal * turned[..., 2:]
        at = (turned[..., :2] + own[:, None, 9:11]) / depth

        def through(change: Array) -> Array:
            """Derivatives (..., 2, p) of ``at`` where ``turned`` changes by (..., 3, p)."""
            sunk = at[..., None] * (inverse_focal * change[..., 2:, :])
            result: Array = (change[..., :2, :] - sunk) / depth[..., None]
            return result

        by_own = np.zeros((*at.shape, 6))
        by_own[..., :3] = through(-skew(turned))
        by_own[..., 0, 3] = by_own[..., 1, 4] = 1 / depth[..., 0]
        by_own[..., 5] = -at / depth
        by_focal = at * (inverse_focal * turned[..., 2:]) / depth
        by_shared = np.stack([by_focal, through(by_aspect[..., None])[..., 0]], axis=3)
        return at, by_own, by_shared

    def moved(self, own: Array, step: Array) -> Array:
        rotation = rotation_exp(step[:, :3]) @ own[:, :9].reshape(-1, 3, 3)
        return np.concatenate([rotation.reshape(-1, 9), own[:, 9:] + step[:, 3:]], axis=1)


def tilts(poses: Array) -> Array:
    """(n,) angle in rad between the optical axis and the sheet's normal, of (n, 12) poses."""
    result: Array = np.arctan2(np.hypot(poses[:, 6], poses[:, 7]), np.abs(poses[:, 8]))
    return result


def seen(model: Model, shared: Array, own: Array, plane: Array) -> tuple[Array, Array, Array]:
    """Places (n, m, 2) where a frame shows them, lens and all, and their derivatives.

    (n, m, 2, p) by the frame's own parameters, (n, m, 2, 5) by the shared ones; nan where
    the lens shows no such place.
    """
    at, by_own, by_shape = model.flat(shared, own, plane)
    square = (at * at).sum(axis=2, keepdims=True)
    # r = u D(k u^2) with D(x) = 2 / (1 + sqrt(1 - 4 x)) undoes u = r / (1 + k r^2).
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1 - 4 * shared[RADIAL] * square)
    bend = 2 / (1 + root)
    slope = bend * bend / root
    lens = 2 * shared[RADIAL] * slope[..., None] * at[..., :, None] * at[..., None, :]
    lens += bend[..., None] * np.eye(2)
    by_shared = np.zeros((*at.shape, 5))
    by_shared[..., CENTRE] = np.eye(2)
    by_shared[..., RADIAL] = at * slope * square
    by_shared[..., LOG_FOCAL:] = lens @ by_shape
    return shared[CENTRE] + at * bend, lens @ by_own, by_shared


def seeds(frame: Array, plane: Array, valid: NDArray[np.bool_]) -> Array:
    """(n, 8) homographies from dots (n, m, 2) by linear least squares."""
    x, y = plane[..., :1], plane[..., 1:]
    rays = np.concatenate([x, y, np.ones_like(x)], axis=2)
    rows = []
    for axis in (0, 1):
        at = frame[..., axis : axis + 1]
        blocks = [np.zeros_like(rays), np.zeros_like(rays)]
        blocks[axis] = rays
        rows.append(np.concatenate([*blocks, -at * rays[..., :2], at], axis=2))
    table = np.concatenate(rows, axis=1) * np.tile(valid, (1, 2))[..., None]
    gram = table.transpose(0, 2, 1) @ table
    result: Array = np.linalg.solve(gram[:, :8, :8], gram[:, :8, 8:])[..., 0]
    return result


def focal_of(homographies: Array) -> float:
    """Focal length for which homographies are rotations best; nan where for none.

    Two constraints a frame, linear in the square of the focal length and in the aspect of
    the sheet (Zhang, PAMI 22 (2000) 1330, eqs. 3 and 4).
    """
    first, second = homographies[:, [0, 3]], homographies[:, [1, 4]]
    g, h = homographies[:, 6], homographies[:, 7]
    size = (first * first + second * second).sum(axis=1) / 2
    skewed = [(first * second).sum(axis=1), (first**2 - second**2).sum(axis=1)]
    bent = [g * h, g * g - h * h]
    stretched = [np.zeros_like(size), -2 * size]
    table = np.stack([np.concatenate(bent), np.concatenate(stretched)], axis=1)
    weight = np.tile(1 / size, 2)
    answer, *_ = np.linalg.lstsq(table * weight[:, None], -np.concatenate(skewed) * weight)
    return math.sqrt(answer[0]) if answer[0] > 0 else math.nan


def poses_of(homographies: Array, focal: float) -> Array:
    """(n, 12) poses that are nearest to homographies (n, 8)."""
    h = homographies
    first = np.stack([h[:, 0], h[:, 3], focal * h[:, 6]], axis=1)
    second = np.stack([h[:, 1], h[:, 4], focal * h[:, 7]], axis=1)
    columns = np.stack([first, second], axis=2)
    scale = math.sqrt(2) / np.linalg.norm(columns, axis=(1, 2))[:, None]
    columns *= scale[..., None]
    third = np.cross(columns[..., 0], columns[..., 1])
    left, _, right = np.linalg.svd(np.concatenate([columns, third[..., None]], axis=2))
    return np.concatenate([(left @ right).reshape(-1, 9), h[:, [2, 5]] * scale, scale], axis=1)
