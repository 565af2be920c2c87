"""Alignment with the bars, pose compensation and the landing curve (sections 3.4 and 4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.field import basis_gradient
from locatk.core.landmarks.landmark import Geometry, signs

Array = NDArray[np.float64]

STRAIGHT_RADIUS_RATIO = 1e7
"""Ratio of radius and distance above which two arcs equal a straight line to rounding."""


# ---- third step


def rotation_to_bars(heading_rad: float, bar_rad: ArrayLike) -> float:
    """Return the smallest rotation that aligns the robot's heading with a bar (section 3.4).

    ``bar_rad`` are the directions of the valleys above bars. Radians, counter-clockwise.
    """
    rotations = np.asarray(bar_rad, float) - heading_rad
    rotations = np.arctan2(np.sin(rotations), np.cos(rotations))
    return float(rotations[np.abs(rotations).argmin()])


# ---- pose by four voltages


def compensate_pose(
    geometry: Geometry,
    code: int,
    position_m: Array,
    field_t: Array,
    initial_guess: ArrayLike = (0.0, 0.0, 0.0),
    steps: int = 1,
) -> Array:
    """Estimate the pose of a robot whose sensors are above the bars of a known landmark.

    Parameters
    ----------
    geometry : Geometry
    code : int
        Of the landmark, in the frame of the result.
    position_m : (N, 2) ndarray
        Sensors in the robot's frame.
    field_t : (N,) ndarray
        ``nan`` where a sensor has no value; three values are needed.
    initial_guess : (3,) array_like
        Pose at which the field is linearized.
    steps : int
        1 is the paper's linear conversion; more invert the field by Newton's method.

    Returns
    -------
    (3,) ndarray
        x, y, heading in the landmark's frame.

    Raises
    ------
    DegenerateError
        Fewer than three values, or the fields do not determine the pose.

    Notes
    -----
    Section 4.1: the voltage above a bar is linear in the distance along it; four voltages give
    x, y and heading. The paper has one factor for all bars. Here each sensor has the value and
    the slope of the bars' field at the initial guess, because the slope is 1.1 to 1.9 mT/mm
    depending on the pattern, and the zero of NNNS is 2.6 mm from the middle of its bars.
    """
    valid = np.isfinite(field_t)
    if valid.sum() < 3:
        raise DegenerateError(f"{valid.sum()} sensors with a value do not determine a pose")
    lever_arm, measured = position_m[valid], field_t[valid]
    pose = np.array(initial_guess, float)
    for _ in range(steps):
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        rotated = lever_arm @ np.array([[cos, sin], [-sin, cos]])
        field, slope = basis_gradient(geometry, pose[:2] + rotated)
        by_xy = np.einsum("nkd,k->nd", slope[..., :2], signs(code))
        by_heading = by_xy[:, 1] * rotated[:, 0] - by_xy[:, 0] * rotated[:, 1]
        # The heading is scaled to metres so that all columns of the Jacobian have one unit.
        jacobian = np.column_stack([by_xy, by_heading / geometry.circle_m])
        residual = measured - field @ signs(code)
        change, _, rank, _ = np.linalg.lstsq(jacobian, residual, rcond=1e-6)
        if rank < 3:
            raise DegenerateError("the fields under the sensors do not determine a pose")
        pose += change / [1.0, 1.0, geometry.circle_m]
    return pose


# ---- path to the next landmark


@dataclass(frozen=True)
class LandingCurve:
    """Two arcs of one radius that bend to opposite sides.

    Attributes
    ----------
    radius_m : float
        ``inf`` if the path is straight.
    arc_rad : (float, float)
        Rotation on each arc, positive to the left; 0 if the path is straight.
    length_m : float
    """

    radius_m: float
    arc_rad: tuple[float, float]
    length_m: float

    def arcs(self) -> tuple[tuple[float, float], ...]:
        """Return path length [m] and rotation [rad] of each arc."""
        if math.isinf(self.radius_m):
            return ((self.length_m, 0.0),)
        return tuple((abs(angle) * self.radius_m, angle) for angle in self.arc_rad)

    def poses(self, start: ArrayLike, path_m: ArrayLike) -> Array:
        """Return the poses (n, 3) after ``path_m`` (n,) along the curve from ``start`` (3,)."""
        path = np.clip(np.atleast_1d(np.asarray(path_m, float)), 0, self.length_m)
        x, y, heading = np.asarray(start, float)
        if math.isinf(self.radius_m):
            ahead = path[:, None] * [math.cos(heading), math.sin(heading), 0.0]
            return np.asarray([x, y, heading] + ahead)
        first = abs(self.arc_rad[0]) * self.radius_m
        pose = _follow_arc(np.array([[x, y, heading]]), np.minimum(path, first), self._curvature(0))
        return _follow_arc(pose, np.maximum(path - first, 0), self._curvature(1))

    def _curvature(self, arc: int) -> float:
        return math.copysign(1 / self.radius_m, self.arc_rad[arc])


def landing_curve(start: ArrayLike, goal: ArrayLike) -> LandingCurve:
    """Connect two poses by two arcs of equal radius (section 4.1).

    Parameters
    ----------
    start, goal : (3,) array_like
        x, y, heading. With the pose error of section 4.1 as the start in the frame of the
        present landmark, the goal is ``(pitch, 0, 0)``.

    Returns
    -------
    LandingCurve
        The shorter of the curves that bend left or right first.

    Raises
    ------
    DegenerateError
        Start and goal have the same position, or the goal is straight behind.

    Notes
    -----
    The paper names the curve (section 4.1, after its [32]) without equations. The centres of the
    arcs are one radius R to opposite sides of start and goal, and 2 R from each other:
    ``(|u|^2 - 4) R^2 + 2 d.u R + |d|^2 = 0`` with d from goal to start and u the sum of both
    normals. It has one positive solution for either side of the first arc.
    """
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    d = start[:2] - goal[:2]
    d_squared = float(d @ d)
    if d_squared == 0:
        raise DegenerateError("a landing curve needs two positions")
    normals = [np.array([-math.sin(a), math.cos(a)]) for a in (start[2], goal[2])]
    curves = []
    for side in (1.0, -1.0):
        u = side * (normals[0] + normals[1])
        a, b = float(u @ u) - 4.0, 2.0 * float(d @ u)
        root = math.sqrt(max(b * b - 4 * a * d_squared, 0.0))
        # Of the two forms of the positive solution, the one without cancellation.
        denominator = root - b if b <= 0 else -4 * a * d_squared / (root + b)
        if denominator * STRAIGHT_RADIUS_RATIO <= 2 * math.sqrt(d_squared):
            continue
        radius = 2 * d_squared / denominator
        first_centre = start[:2] + side * radius * normals[0]
        second_centre = goal[:2] - side * radius * normals[1]
        middle = (first_centre + second_centre) / 2
        arcs = (
            side * _arc_angle(start[:2] - first_centre, middle - first_centre, side),
            -side * _arc_angle(middle - second_centre, goal[:2] - second_centre, -side),
        )
        length = radius * (abs(arcs[0]) + abs(arcs[1]))
        curves.append(LandingCurve(radius, arcs, length))
    if not curves:
        if d @ [math.cos(start[2]), math.sin(start[2])] > 0:
            raise DegenerateError("the goal is straight behind: no landing curve leads there")
        return LandingCurve(math.inf, (0.0, 0.0), math.sqrt(d_squared))
    return min(curves, key=lambda curve: curve.length_m)


def _follow_arc(pose: Array, path_m: Array, curvature: float) -> Array:
    """Return poses (n, 3) after paths (n,) on a circle of one curvature from poses (n or 1, 3)."""
    rotation = path_m * curvature
    middle = pose[:, 2] + rotation / 2
    chord = path_m * np.sinc(rotation / 2 / np.pi)
    return np.column_stack(
        [
            pose[:, 0] + chord * np.cos(middle),
            pose[:, 1] + chord * np.sin(middle),
            pose[:, 2] + rotation,
        ]
    )


def _arc_angle(first: Array, last: Array, side: float) -> float:
    """Return the angle within 0 .. 2 pi between two directions, to the left for side 1."""
    angle = math.atan2(first[0] * last[1] - first[1] * last[0], float(first @ last)) * side
    # An angle of zero may come out negative by rounding.
    return angle % math.tau if angle < -1e-9 else max(angle, 0.0)
