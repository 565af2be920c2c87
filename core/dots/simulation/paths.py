"""Where a simulated camera is at any time: on a curve over the sheets, anywhere, or still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PATHS = ("curve", "random", "still")


@dataclass(frozen=True)
class Course:
    """Poses of a camera's centre in the frame of the sheets, one a frame.

    Attributes
    ----------
    position : (n, 2) ndarray
        Metres.
    heading : (n,) ndarray
        Of the image's right, radians.
    velocity : (n, 2) ndarray
        Metres a second.
    turn_rate : (n,) ndarray
        Radians a second.
    """

    position: Array
    heading: Array
    velocity: Array
    turn_rate: Array


def course(
    path: str, time_s: Array, low_m: Array, high_m: Array, speed_mps: float, seed: int
) -> Course:
    """A course within a rectangle.

    Parameters
    ----------
    path : str
        ``"curve"``: along a smooth closed curve at constant speed, image right ahead.
        ``"random"``: anywhere, turned anyhow, each frame for itself and at rest.
        ``"still"``: at one such pose.
    time_s : (n,) ndarray
    low_m, high_m : (2,) ndarray
        Corners of the rectangle.
    speed_mps : float
        Of the curve.
    seed : int
    """
    rng = np.random.default_rng([seed, 1])
    n = len(time_s)
    if path == "curve":
        return _curve(time_s, low_m, high_m, speed_mps, rng)
    count = n if path == "random" else 1
    position = rng.uniform(low_m, high_m, (count, 2))
    heading = rng.uniform(-np.pi, np.pi, count)
    return Course(np.resize(position, (n, 2)), np.resize(heading, n), np.zeros((n, 2)), np.zeros(n))


def _curve(
    time_s: Array, low_m: Array, high_m: Array, speed_mps: float, rng: np.random.Generator
) -> Course:
    """A Lissajous figure of 3 by 2 waves, by its length.

    At a phase of pi/6 both waves turn at once, and the curve runs back in itself.
    """
    waves = np.array([3.0, 2.0])
    phase = np.array([0.0, rng.uniform(-1, 1) * np.pi / 12])
    middle, swing = (low_m + high_m) / 2, (high_m - low_m) / 2
    u = np.linspace(0, 2 * np.pi, 20_001)

    def at(u: Array) -> tuple[Array, Array, Array]:
        angle = u[:, None] * waves + phase
        return (
            middle + swing * np.sin(angle),
            swing * waves * np.cos(angle),
            -swing * waves**2 * np.sin(angle),
        )

    slope = np.linalg.norm(at(u)[1], axis=1)
    way = np.r_[0.0, np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(u))]
    length = way[-1]
    if length == 0:  # a sheet as small as a frame leaves no way to go
        n = len(time_s)
        return Course(np.tile(middle, (n, 1)), np.zeros(n), np.zeros((n, 2)), np.zeros(n))
    driven = rng.uniform(0, length) + speed_mps * time_s
    position, first, second = at(np.interp(np.mod(driven, length), way, u))
    speed = np.linalg.norm(first, axis=1)
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    return Course(
        position,
        np.arctan2(first[:, 1], first[:, 0]),
        speed_mps * first / speed[:, None],
        speed_mps * curvature,
    )
