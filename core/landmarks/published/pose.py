"""The paper's third step and its pose compensation (sections 3.4 and 4.1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.field import basis_gradient
from locatk.core.landmarks.landmark import Geometry, signs

Array = NDArray[np.float64]


def turn_to_bars(heading_rad: float, bar_rad: ArrayLike) -> float:
    """Least turn that brings the robot's heading to one of the valleys over bars.

    Section 3.4: of the valleys along the centre of landmark and magnet the one nearest to
    the heading. Radians, counter-clockwise.
    """
    turns = np.asarray(bar_rad, float) - heading_rad
    turns = np.arctan2(np.sin(turns), np.cos(turns))
    return float(turns[np.abs(turns).argmin()])


def compensate(
    geometry: Geometry,
    code: int,
    position_m: Array,
    field_t: Array,
    guess: ArrayLike = (0.0, 0.0, 0.0),
    steps: int = 1,
) -> Array:
    """Pose of a robot that stands with its sensors over the bars of a known landmark.

    Parameters
    ----------
    geometry : Geometry
    code : int
        Of the landmark, in the frame in which the pose is asked for.
    position_m : (N, 2) ndarray
        Sensors in the robot's frame.
    field_t : (N,) ndarray
        ``nan`` where a sensor gave nothing; three are needed.
    guess : (3,) array_like
        Pose at which the field is made linear.
    steps : int
        1 is the paper's linear way; more invert the field by Newton's method.

    Returns
    -------
    (3,) ndarray
        x, y, heading in the landmark's frame.

    Raises
    ------
    DegenerateError
        Fewer than three values, or the sensors' fields do not tell the pose.

    Notes
    -----
    Section 4.1: the voltage over a bar is linear in the way along it; four of them give
    x, y and heading. The paper has one factor for all; here each sensor has the value and
    slope that the bars' field has at the guess, as the slope is 1.1 to 1.9 mT/mm by pattern
    and the zero of NNNS lies 2.6 mm beside its bars (facts/landmarks.md 2.3).
    """
    good = np.isfinite(field_t)
    if good.sum() < 3:
        raise DegenerateError(f"{good.sum()} sensors with a value do not tell a pose")
    lever, wanted = position_m[good], field_t[good]
    pose = np.array(guess, float)
    for _ in range(steps):
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        swung = lever @ np.array([[cos, sin], [-sin, cos]])
        field, slope = basis_gradient(geometry, pose[:2] + swung)
        by_xy = np.einsum("nkd,k->nd", slope[..., :2], signs(code))
        by_turn = by_xy[:, 1] * swung[:, 0] - by_xy[:, 0] * swung[:, 1]
        # The turn is scaled to metres, so that the rank is judged in one unit.
        jacobian = np.column_stack([by_xy, by_turn / geometry.circle_m])
        change, _, rank, _ = np.linalg.lstsq(jacobian, wanted - field @ signs(code), rcond=1e-6)
        if rank < 3:
            raise DegenerateError("the fields under the sensors do not tell a pose")
        pose += change / [1.0, 1.0, geometry.circle_m]
    return pose
