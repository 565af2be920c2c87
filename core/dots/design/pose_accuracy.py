"""Covariance of the pose of a frame, from the dots in view and the error of one dot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.detection.blobs import SMOOTHING_RADIUS_PX
from locatk.core.dots.detection.lattice import PARAMETER_SIGMAS
from locatk.core.dots.identification.soft_bits import MAX_WINDOW_DOTS
from locatk.core.geometry import rotation_matrix_2d

Array = NDArray[np.float64]

GRID_DIRECTIONS_RAD = (0.1, 0.45, 0.8)
"""Directions of the grid over which is averaged."""

PERSPECTIVE_SIGMA, LENS_SIGMA = (float(PARAMETER_SIGMAS[k]) for k in (6, 8))
"""Prior standard deviations of perspective and lens at the corner of the frame, of the solver."""


@dataclass(frozen=True)
class PoseAccuracy:
    """Standard deviations of the pose of a frame, and the dots that determine it.

    Attributes
    ----------
    position_pitches : float
        Per axis.
    heading_rad : float
    dots : float
        Number of dots in view, on average.
    """

    position_pitches: float
    heading_rad: float
    dots: float

    def with_fraction(self, fraction: float) -> PoseAccuracy:
        """Return the accuracy if only a fraction of the dots, evenly distributed, is used."""
        if not fraction > 0:
            return PoseAccuracy(math.inf, math.inf, 0.0)
        factor = fraction**-0.5
        return PoseAccuracy(
            factor * self.position_pitches, factor * self.heading_rad, fraction * self.dots
        )


def pose_accuracy(
    size_px: tuple[int, int], pitch_px: float, sigma_px: float, *, is_lens_known: bool = True
) -> PoseAccuracy:
    """Return the accuracy of a pose from a frame of dots with independent errors.

    The fit is that of the solver: a homography of eight parameters, and one of the lens if that is
    unknown. The position is where the optical axis meets the paper; perspective and position are
    correlated, so that it is less certain than the mean of the dots.

    Parameters
    ----------
    size_px : (width, height)
    pitch_px : float
        Distance of two dots on the grid.
    sigma_px : float
        Standard deviation of a dot per axis.
    is_lens_known : bool
    """
    parts = [
        _accuracy_of_direction(size_px, pitch_px, sigma_px, direction, is_lens_known)
        for direction in GRID_DIRECTIONS_RAD
    ]
    position, heading, dots = np.array(parts).T
    return PoseAccuracy(
        math.sqrt(np.mean(position**2)), math.sqrt(np.mean(heading**2)), float(dots.mean())
    )


def _accuracy_of_direction(
    size_px: tuple[int, int],
    pitch_px: float,
    sigma_px: float,
    direction_rad: float,
    is_lens_known: bool,
) -> tuple[float, float, float]:
    """Return standard deviations of position (pitches) and heading (rad), and the dots."""
    half_diagonal = math.hypot(*size_px) / 2
    scale = half_diagonal / pitch_px
    u = dots_in_frame(size_px, pitch_px, direction_rad)
    count = len(u)
    if count < 5:
        return math.inf, math.inf, float(count)
    # Point in half diagonals, and the derivatives of u and v, in pitches, by the parameters.
    p = u @ rotation_matrix_2d(direction_rad) / scale
    affine = np.column_stack([p, np.ones(count)])
    zeros = np.zeros_like(affine)
    shared = [-u[:, :, None] * p[:, None, :]]
    if not is_lens_known:
        shared.append((-(p**2).sum(axis=1)[:, None] * u)[:, :, None])
    common = np.concatenate(shared, axis=2)
    columns = np.concatenate(
        [
            np.column_stack([affine, zeros, common[:, 0]]),
            np.column_stack([zeros, affine, common[:, 1]]),
        ]
    )
    sigma = sigma_px / pitch_px
    prior = [PERSPECTIVE_SIGMA, PERSPECTIVE_SIGMA, *([] if is_lens_known else [LENS_SIGMA])]
    normal = columns.T @ columns
    index = np.arange(6, len(normal))
    normal[index, index] += (sigma / np.array(prior)) ** 2
    covariance = sigma**2 * np.linalg.inv(normal)
    position = math.sqrt((covariance[2, 2] + covariance[5, 5]) / 2)
    # The direction of the image's right: derivative (u, v) by p_x, of length `scale`.
    across = np.zeros(len(normal))
    across[0], across[3] = -math.sin(direction_rad) / scale, math.cos(direction_rad) / scale
    heading = math.sqrt(across @ covariance @ across)
    return position, heading, float(count)


def dots_in_frame(size_px: tuple[int, int], pitch_px: float, direction_rad: float) -> Array:
    """Return the grid positions (n, 2), in pitches from the centre, of the dots that are found.

    Dots whose smoothed image leaves the frame are not found, and only the middle
    :data:`~.soft_bits.MAX_WINDOW_DOTS` columns and rows are decoded.
    """
    half = np.array(size_px) / 2 - SMOOTHING_RADIUS_PX
    half_count = min(math.ceil(float(np.linalg.norm(half)) / pitch_px), MAX_WINDOW_DOTS // 2)
    line = np.arange(-half_count, half_count) + 0.5
    nodes = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    in_frame = pitch_px * nodes @ rotation_matrix_2d(direction_rad)
    result: Array = nodes[(np.abs(in_frame) < half).all(axis=1)]
    return result
