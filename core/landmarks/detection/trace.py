"""Trace of one visit: fields along the paths of the sensors, and errors of the odometry.

The path of the robot during a visit is known from odometry only. Its errors are linear in few
unknowns (:func:`odometry_corrections`), which the fit of the landmark estimates as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WALK_DISTANCE_M = 0.15
"""Distance that counts as one unit of effort of the random walk."""

WALK_ROTATION_RAD = math.pi / 2
"""Rotation that counts as one unit of effort of the random walk."""

CONSTANT_ERROR_COUNT = 4
"""Number of leading corrections that are the same during a whole recording: scale, rotation scale,
curvature and time lag."""


@dataclass(frozen=True)
class OdometryDrift:
    """Standard deviations of the errors of odometry.

    Attributes
    ----------
    scale : float
        Relative error of distances, constant.
    rotation_scale : float
        Relative error of rotations, constant.
    curvature_rad_per_m : float
        Rotation per metre that odometry does not observe, constant; the default is one degree on
        a pass of 230 mm.
    walk_m, walk_rad : float
        Random walk of position and heading over one unit of effort: a distance of
        :data:`WALK_DISTANCE_M` or a rotation of :data:`WALK_ROTATION_RAD`.
    lag_s : float
        Time by which odometry is later than the fields, constant. The default is the delay of a
        fieldbus or a serial line with buffers: tens of milliseconds.
    """

    scale: float = 0.01
    rotation_scale: float = 0.01
    curvature_rad_per_m: float = math.radians(1) / 0.23
    walk_m: float = 0.2e-3
    walk_rad: float = math.radians(0.1)
    lag_s: float = 0.03


def known_drift(
    drift: OdometryDrift, heading_noise: float | None, lag_s: float | None
) -> OdometryDrift:
    """Return the drift of odometry whose random walk or lag is known.

    Parameters
    ----------
    drift : OdometryDrift
    heading_noise : float or None
        Random walk of the heading [rad/sqrt(m)]; that of the position is in the same proportion.
    lag_s : float or None
        Not None if the lag is known, and removed.
    """
    if heading_noise is not None:
        walk_rad = heading_noise * math.sqrt(WALK_DISTANCE_M)
        walk_m = drift.walk_m * walk_rad / drift.walk_rad
        drift = replace(drift, walk_rad=walk_rad, walk_m=walk_m)
    return drift if lag_s is None else replace(drift, lag_s=0.0)


@dataclass(frozen=True)
class Trace:
    """Fields along the paths of the sensors during one visit, in a frame of the odometry.

    The frame is that of the robot at sample :attr:`reference`. The path is that of the odometry
    plus ``correction @ c`` with unknown ``c``, whose prior is ``N(0, 1)``.

    Attributes
    ----------
    pose : (n, 3) ndarray
        Robot at each sample by odometry: x, y, heading.
    correction : (n, 3, m) ndarray
        Change of x, y, heading by one standard deviation of each of m errors; 0 at the reference.
    field_t : (n, N) ndarray
        Tesla; ``nan`` if there is no usable value.
    sensor_position_m : (N, 2) ndarray
        In the robot's frame.
    weight : (n,) ndarray
        Number of readings of which each sample is the mean.
    reference : int
    thinning : float
        Number of original samples per sample that was kept.
    """

    pose: Array
    correction: Array
    field_t: Array
    sensor_position_m: Array
    weight: Array
    reference: int
    thinning: float = 1.0

    def __len__(self) -> int:
        return len(self.pose)

    def sensor_positions(self) -> Array:
        """Return the positions (n, N, 2) of the sensors by odometry."""
        return sensor_positions(self.pose, self.sensor_position_m)

    def thinned(self, max_samples: int) -> Trace:
        """Return at most ``max_samples`` samples, evenly chosen; the reference is among them."""
        step = math.ceil(len(self) / max_samples)
        if step == 1:
            return self
        keep = np.arange(self.reference % step, len(self), step)
        return replace(
            self,
            pose=self.pose[keep],
            correction=self.correction[keep],
            field_t=self.field_t[keep],
            weight=self.weight[keep],
            reference=self.reference // step,
            thinning=self.thinning * step,
        )


# ---- poses in the plane


def sensor_positions(pose: Array, position_m: Array) -> Array:
    """Return the positions (n, N, 2) of sensors at ``position_m`` (N, 2) of a robot at (n, 3)."""
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x = pose[:, 0, None] + cos * position_m[:, 0] - sin * position_m[:, 1]
    y = pose[:, 1, None] + sin * position_m[:, 0] + cos * position_m[:, 1]
    return np.stack([x, y], -1)


def planar_rotation(heading_rad: float) -> Array:
    """Return the matrix (3, 3) that rotates x and y and keeps the heading."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def compose(pose: Array, local: Array) -> Array:
    """Transform poses ``local`` (..., 3) from the frame of ``pose`` (..., 3) to the outer one."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = local[..., 0], local[..., 1]
    return np.stack(
        [
            pose[..., 0] + cos * x - sin * y,
            pose[..., 1] + sin * x + cos * y,
            pose[..., 2] + local[..., 2],
        ],
        -1,
    )


def relative(pose: Array, origin: Array) -> Array:
    """Transform poses (n, 3) to the frame of the pose ``origin`` (3,); inverse of compose."""
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    dx, dy = pose[:, 0] - origin[0], pose[:, 1] - origin[1]
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, pose[:, 2] - origin[2]])


# ---- errors of odometry


def odometry_corrections(
    pose: Array,
    reference: int,
    drift: OdometryDrift,
    velocity: Array | None = None,
    corrected: Array | None = None,
) -> Array:
    """Linearize the errors of odometry.

    Parameters
    ----------
    pose : (n, 3) ndarray
        Path by odometry.
    reference : int
        Sample at which all corrections are zero.
    drift : OdometryDrift
    velocity : (n, 3) ndarray, optional
        Derivative of the path by time. Without it, a lag is not considered.
    corrected : (n, 3) ndarray, optional
        Path about which the errors are linearized, if it is not ``pose``.

    Returns
    -------
    (n, 3, m) ndarray
        Change of x, y, heading by one standard deviation of each error. First the constant ones
        (:data:`CONSTANT_ERROR_COUNT`), then the random walk of heading, x and y, each a linear
        ramp over one unit of effort, see :func:`walk_units`.
    """
    step = np.diff(pose, axis=0, prepend=pose[:1])
    length = np.hypot(step[:, 0], step[:, 1])
    effort = np.cumsum(length / WALK_DISTANCE_M + np.abs(step[:, 2]) / WALK_ROTATION_RAD)
    distance, rotation = np.cumsum(length), np.cumsum(step[:, 2])
    # A path of a whole number of units must not get one more by rounding.
    parts = max(1, math.ceil(effort[-1] - 1e-9))
    unit = max(effort[-1] / parts, 1e-12)
    ramps = np.clip(effort[:, None] / unit - np.arange(parts), 0, 1) * math.sqrt(unit)
    ramps -= ramps[reference]
    zero = np.zeros_like(ramps)
    heading = np.column_stack(
        [
            drift.rotation_scale * (rotation - rotation[reference]),
            drift.curvature_rad_per_m * (distance - distance[reference]),
            drift.walk_rad * ramps,
        ]
    )
    if corrected is not None:
        step = np.diff(corrected, axis=0, prepend=corrected[:1])
    by_heading = np.moveaxis(_effect_of_heading_errors(heading, step, reference), 2, 1)
    stretch = np.cumsum(step, axis=0) * [1.0, 1.0, 0.0]
    stretch -= stretch[reference]
    shift = drift.walk_m * ramps
    lag = np.zeros_like(pose) if velocity is None else _effect_of_lag(pose, velocity, reference)
    constant_by_heading, walk_of_heading = np.split(by_heading, [2], axis=2)
    return np.concatenate(
        [
            drift.scale * stretch[:, :, None],
            constant_by_heading,
            drift.lag_s * lag[:, :, None],
            walk_of_heading,
            np.stack([shift, zero, zero], 1),
            np.stack([zero, shift, zero], 1),
        ],
        axis=2,
    )


def walk_units(correction_count: int) -> NDArray[np.intp]:
    """Return the columns (parts, 3) of corrections that belong to each unit of the random walk.

    The three of a unit are those of heading, x and y.
    """
    return np.arange(CONSTANT_ERROR_COUNT, correction_count).reshape(3, -1).T


def correct_constant_errors(pose: Array, errors: Array, drift: OdometryDrift) -> Array:
    """Remove the constant errors except the lag from a path (n, 3), from its first pose on.

    The first of ``errors`` are scale, rotation scale and curvature in standard deviations of
    ``drift``.
    The first columns of :func:`odometry_corrections` are the linearization of this function.
    """
    step = np.diff(pose, axis=0, prepend=pose[:1])
    distance = np.cumsum(np.hypot(step[:, 0], step[:, 1]))
    rotation = pose[:, 2] - pose[0, 2]
    change = (
        drift.rotation_scale * errors[1] * rotation
        + drift.curvature_rad_per_m * errors[2] * distance
    )
    mean_change = change.copy()
    mean_change[1:] = (change[1:] + change[:-1]) / 2
    cos, sin = np.cos(mean_change), np.sin(mean_change)
    stretch = 1 + drift.scale * errors[0]
    x = np.cumsum(stretch * (cos * step[:, 0] - sin * step[:, 1]))
    y = np.cumsum(stretch * (sin * step[:, 0] + cos * step[:, 1]))
    return np.column_stack([pose[0, 0] + x, pose[0, 1] + y, pose[:, 2] + change])


def _effect_of_lag(pose: Array, velocity: Array, reference: int) -> Array:
    """Return the derivative (n, 3) of the path by a lag, in the frame of the reference.

    Both the pose and the frame are those of a later odometry.
    """
    arm = pose - pose[reference]
    effect = velocity - velocity[reference]
    effect[:, 0] += velocity[reference, 2] * arm[:, 1]
    effect[:, 1] -= velocity[reference, 2] * arm[:, 0]
    return effect


def _effect_of_heading_errors(heading: Array, step: Array, reference: int) -> Array:
    """Return the changes (n, m, 3) of the poses by errors (n, m) of the heading on the path."""
    mean_heading = heading.copy()
    mean_heading[1:] = (heading[1:] + heading[:-1]) / 2
    x = np.cumsum(-mean_heading * step[:, 1, None], axis=0)
    y = np.cumsum(mean_heading * step[:, 0, None], axis=0)
    return np.stack([x - x[reference], y - y[reference], heading], -1)
