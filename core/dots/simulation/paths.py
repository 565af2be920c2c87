"""Paths of a simulated camera: along a curve over the sheets, random poses, or at rest."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from locatk.core.simulation import random_stream

Array = NDArray[np.float64]


class RandomSource(IntEnum):
    """Sources of random errors of a camera over sheets, each with a stream of its own."""

    PATH = 1
    PIXELS = 2
    TILT = 3
    BLUR_DIRECTION = 4
    LIGHT = 5


PATHS = ("curve", "random", "still")

NODES_PER_CURVE = 20_001
"""Nodes of the table from length to parameter of the curve."""


@dataclass(frozen=True)
class CameraPath:
    """Poses of a camera's centre in the frame of the sheets, one for each frame.

    Attributes
    ----------
    position_m : (n, 2) ndarray
    heading_rad : (n,) ndarray
        Direction of the image's right.
    velocity_mps : (n, 2) ndarray
    yaw_rate_rps : (n,) ndarray
        Rate of the heading.
    """

    position_m: Array
    heading_rad: Array
    velocity_mps: Array
    yaw_rate_rps: Array


def camera_path(
    kind: str, time_s: Array, low_m: Array, high_m: Array, speed_mps: float, seed: int
) -> CameraPath:
    """Return a path within a rectangle.

    Parameters
    ----------
    kind : str
        ``"curve"``: a smooth closed curve at constant speed, with the image's right ahead.
        ``"random"``: random positions and headings, independent for each frame and at rest.
        ``"still"``: one such pose.
    time_s : (n,) ndarray
        Times of the frames.
    low_m, high_m : (2,) ndarray
        Corners of the rectangle.
    speed_mps : float
        Speed along the curve.
    seed : int
    """
    rng = random_stream(seed, RandomSource.PATH)
    n = len(time_s)
    if kind == "curve":
        return _lissajous_path(time_s, low_m, high_m, speed_mps, rng)
    count = n if kind == "random" else 1
    position = rng.uniform(low_m, high_m, (count, 2))
    heading = rng.uniform(-np.pi, np.pi, count)
    return CameraPath(
        np.resize(position, (n, 2)), np.resize(heading, n), np.zeros((n, 2)), np.zeros(n)
    )


def _lissajous_path(
    time_s: Array, low_m: Array, high_m: Array, speed_mps: float, rng: np.random.Generator
) -> CameraPath:
    """Return a Lissajous curve with the frequencies 3 and 2 at constant speed.

    The phase stays below pi/6: there both coordinates reverse at once, and the curve runs back on
    itself.
    """
    frequencies = np.array([3.0, 2.0])
    phase = np.array([0.0, rng.uniform(-1, 1) * np.pi / 12])
    middle, amplitude = (low_m + high_m) / 2, (high_m - low_m) / 2
    u = np.linspace(0, 2 * np.pi, NODES_PER_CURVE)

    def evaluate(u: Array) -> tuple[Array, Array, Array]:
        """Return the points (..., 2) and their first and second derivatives."""
        angle = u[:, None] * frequencies + phase
        return (
            middle + amplitude * np.sin(angle),
            amplitude * frequencies * np.cos(angle),
            -amplitude * frequencies**2 * np.sin(angle),
        )

    slope = np.linalg.norm(evaluate(u)[1], axis=1)
    distance_m = np.r_[0.0, np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(u))]
    length_m = distance_m[-1]
    if length_m == 0:  # A sheet as small as a frame has no room for a curve.
        n = len(time_s)
        return CameraPath(np.tile(middle, (n, 1)), np.zeros(n), np.zeros((n, 2)), np.zeros(n))
    driven_m = rng.uniform(0, length_m) + speed_mps * time_s
    position, first, second = evaluate(np.interp(np.mod(driven_m, length_m), distance_m, u))
    speed = np.linalg.norm(first, axis=1)
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    return CameraPath(
        position,
        np.arctan2(first[:, 1], first[:, 0]),
        speed_mps * first / speed[:, None],
        speed_mps * curvature,
    )
