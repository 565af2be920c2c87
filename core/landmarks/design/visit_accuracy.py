"""Accuracy of one visit to a landmark, predicted from the field of its bars (Fisher information).

A visit is a path over a landmark. The readings of the hall sensors depend on the pose of the robot
at one point of the path, the *reference*, and on everything that is not as nominal: gains and
offsets of the sensors, their height, strengths and positions of the bars, and the errors of the
odometry along the path. All of these are unknowns with Gaussian priors. The covariance of the pose
is its part of the inverse of

    J' W J + diag(1 / prior^2),

with the derivatives J of the closed-form field (:mod:`locatk.core.landmarks.field`) and the
weights W of the readings (the bound of Cramer and Rao with nuisance parameters; S. M. Kay,
Fundamentals of Statistical Signal Processing, vol. 1, 1993, chapters 3 and 12). Iron distorts the
field by a Gaussian process along the floor with the covariance K. The solver does not know it, so
that its error is added: A K A' for the estimate A = (J' W J + ...)^-1 J' W.

Another code c' is read instead of the true one if it is the more probable of two Gaussian
hypotheses (H. L. Van Trees, Detection, Estimation, and Modulation Theory, part I, 1968, section
2.6): with the probability Q(d / 2), where d is the distance of its field from that of all poses and
errors near the true ones. Poses far from the true one are not compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from locatk.core.errors import InputError
from locatk.core.landmarks.field import basis_gradient
from locatk.core.landmarks.halls import circle
from locatk.core.landmarks.landmark import CODE_COUNT, Geometry, signs
from locatk.core.landmarks.map.floor import MISSING_BAR_STRENGTH
from locatk.core.landmarks.preprocessing import MARGIN_M
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.streaming.planar_filter import OdometryNoise

Array = NDArray[np.float64]

STEP_M = 4e-3
"""Distance between the points of a path at which the field is evaluated [m]. With 1 mm, standard
deviations change by less than 1 % at heights of 6 mm and more."""

STEP_RAD = math.radians(3)
"""Rotation on the spot between two points: the sensors then move by 1.3 mm."""

VISIT_MARGIN_M = MARGIN_M
"""Path before and after the field of a landmark that counts as part of a visit [m]."""

MAX_POSITION_SIGMA_M = 6e-3
MAX_HEADING_SIGMA_RAD = math.radians(8)
"""Standard deviations of a pose up to which the solver uses a visit (``too_weak`` otherwise)."""

MAX_MISREAD_PROBABILITY = SolveOptions.misread
"""Probability of another code up to which a visit counts as read: that of landmarks which differ
from the map, which the solver assumes anyway."""

WALK_UNITS = 6
"""Pieces of a visit in which the random walk of odometry is constant."""

DIFFUSE_SIGMA = 1.0
"""Prior of the pose [m, rad]: so wide that it adds no information."""


@dataclass(frozen=True)
class VisitErrors:
    """Errors of sensors, bars and floor: standard deviations.

    The defaults are those that the solver assumes (docs/landmarks.md, table of priors), with the
    noise of an inexpensive hall sensor.

    Attributes
    ----------
    noise_t : float
        Noise of one reading.
    rate_hz : float
        Readings of each sensor in a second.
    gain : float
        Relative, of each sensor.
    offset_t : float
        Constant field at each sensor that is not known: its offset, and the vehicle's iron and
        magnets.
    height_m : float
        Common height of the sensors.
    bar_strength : float
        Relative, of each bar.
    bar_position_m : float
        Of each bar in x and in y.
    landmark_position_m, landmark_heading_rad : float
        Installation of a landmark about its pose on the map.
    disturbance_t, disturbance_length_m : float
        Field of iron in the floor, a Gaussian process over the floor with this standard deviation,
        and the distance over which it changes (its correlation is exp(-d^2 / 2 length^2)).
    """

    noise_t: float = 1.5e-4
    rate_hz: float = 200.0
    gain: float = 0.03
    offset_t: float = 1e-4
    height_m: float = 0.5e-3
    bar_strength: float = 0.04
    bar_position_m: float = 0.5e-3
    landmark_position_m: float = 1.5e-3
    landmark_heading_rad: float = 0.012
    disturbance_t: float = 0.0
    disturbance_length_m: float = 0.15

    def __post_init__(self) -> None:
        positive = ("noise_t", "rate_hz", "disturbance_length_m")
        for item in fields(self):
            value = getattr(self, item.name)
            if not (0 <= value < math.inf) or (value == 0 and item.name in positive):
                wanted = "a number above 0" if item.name in positive else "0 or more"
                raise InputError(f"{item.name} of {value!r}", hint=f"Give {wanted}")


@dataclass(frozen=True)
class VisitAccuracy:
    """Predicted result of one visit.

    Attributes
    ----------
    covariance : (3, 3) ndarray
        Of x, y [m] and heading [rad] of the robot at the reference, in the axes of the landmark
        and relative to it.
    misread_probability : float
        Probability that another code is read (union bound).
    peak_t : float
        Largest field at any sensor.
    """

    covariance: Array
    misread_probability: float
    peak_t: float

    @property
    def is_usable(self) -> bool:
        """True if the solver uses a visit of this accuracy."""
        x, y, heading = np.sqrt(np.diag(self.covariance))
        return bool(max(x, y) <= MAX_POSITION_SIGMA_M and heading <= MAX_HEADING_SIGMA_RAD)

    @property
    def is_read(self) -> bool:
        """True if the visit gives a pose, and the code beyond reasonable doubt."""
        return self.is_usable and self.misread_probability <= MAX_MISREAD_PROBABILITY


def straight_path(geometry: Geometry, offset_m: float, heading_rad: float) -> Array:
    """Return a straight path (n, 3) over a landmark, which the middle point is next to."""
    half_length_m = visit_range(geometry) + VISIT_MARGIN_M
    count = math.ceil(half_length_m / STEP_M)
    along = STEP_M * np.arange(-count, count + 1)
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    x, y = c * along - s * offset_m, s * along + c * offset_m
    return np.column_stack([x, y, np.full(len(along), heading_rad)])


def sensor_arms(poses: Array, sensors_m: Array) -> Array:
    """Return the vectors (n, N, 2) from a robot at poses (n, 3) to its sensors (N, 2)."""
    cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = sensors_m.T
    return np.stack([cos * x - sin * y, sin * x + cos * y], -1)


def visit_range(geometry: Geometry) -> float:
    """Return a distance [m] from the centre beyond which a robot does not notice a landmark.

    At twice the length of the bars beyond them, the field of the default landmark is 0.4 mT.
    """
    return geometry.radius_m + 2 * geometry.bar_length_m + geometry.circle_m


def installation_covariance(pose: Array, errors: VisitErrors) -> Array:
    """Return the covariance (3, 3) of a pose (3,) by the installation of the landmark."""
    lever_arm = np.array([-pose[1], pose[0], 1.0])
    covariance = errors.landmark_heading_rad**2 * np.outer(lever_arm, lever_arm)
    covariance[[0, 1], [0, 1]] += errors.landmark_position_m**2
    return np.asarray(covariance)


def predict_visit(
    geometry: Geometry,
    path: Array,
    strength: Array,
    *,
    reference: int | None = None,
    sensors_m: Array | None = None,
    speed_mps: float = 0.1,
    turn_rps: float = math.radians(90),
    noise: OdometryNoise | None = None,
    errors: VisitErrors | None = None,
) -> VisitAccuracy:
    """Predict the accuracy of a visit along any path.

    Parameters
    ----------
    geometry : Geometry
    path : (n, 3) ndarray
        Poses of the robot in the frame of the landmark: x, y in metres, heading in radians without
        jumps; about :data:`STEP_M` or :data:`STEP_RAD` apart.
    strength : (4,) ndarray
        Signed strengths of the bars: 1 for N, -1 for S, 0 for a missing bar.
    reference : int, optional
        Point of the path at which the pose is predicted; by default the middle one.
    sensors_m : (N, 2) ndarray, optional
        In the robot's frame; by default four on the circle of the geometry.
    speed_mps, turn_rps : float
        They determine the number of readings at each point.
    noise : OdometryNoise, optional
    errors : VisitErrors, optional
    """
    noise, errors = noise or OdometryNoise(), errors or VisitErrors()
    if reference is None:
        reference = len(path) // 2
    sensors = circle(geometry.circle_m) if sensors_m is None else sensors_m
    arm = sensor_arms(path, sensors)
    position = path[:, None, :2] + arm
    field, by_position = basis_gradient(geometry, position)
    total = field @ strength
    gradient = np.einsum("nsbi,b->nsi", by_position, strength)

    columns = [
        *_pose_columns(gradient, position - path[reference, :2]),
        *_odometry_columns(gradient, arm, path, reference, noise),
        *_sensor_columns(total, gradient, errors),
        *_bar_columns(field, by_position, strength, errors),
    ]
    readings = np.repeat(_readings(path, speed_mps, turn_rps, errors), len(sensors))
    root = np.sqrt(readings) / errors.noise_t
    jacobian = np.stack([column.reshape(-1) for column in columns], -1) * root[:, None]
    information = jacobian.T @ jacobian + np.eye(jacobian.shape[1])
    information[range(3), range(3)] += DIFFUSE_SIGMA**-2 - 1.0
    covariance = np.linalg.inv(information)

    others = _other_strengths(strength)
    difference = root[:, None] * (field.reshape(-1, 4) @ (others - strength).T)
    test = difference - jacobian @ (covariance @ (jacobian.T @ difference))
    square = np.maximum(np.einsum("rk,rk->k", difference, test), 0.0)
    variance = square
    pose_covariance = np.asarray(covariance[:3, :3], np.float64)
    if errors.disturbance_t:
        iron = root[:, None] * _iron_covariance(position.reshape(-1, 2), errors) * root
        estimate = covariance[:3] @ jacobian.T
        pose_covariance = pose_covariance + estimate @ iron @ estimate.T
        variance = square + np.einsum("rk,rk->k", test, iron @ test)
    margin = square / 2 / np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    misread = min(1.0, float(ndtr(-margin).sum()))
    return VisitAccuracy(pose_covariance, misread, float(np.abs(total).max()))


def _other_strengths(strength: Array) -> Array:
    """Return the strengths (k, 4) of all other codes; a missing bar has no direction."""
    is_present = np.abs(strength) >= MISSING_BAR_STRENGTH
    codes = signs(np.arange(CODE_COUNT))
    is_other = ((codes == np.where(strength < 0, -1.0, 1.0)) | is_present).all(axis=1)
    others = np.where(is_present, codes * np.abs(strength), strength)[is_other]
    return np.asarray(others[(others != strength).any(axis=1)])


def _pose_columns(gradient: Array, lever_arm: Array) -> list[Array]:
    """Return the derivatives (n, N) of the readings by x, y and heading at the reference."""
    by_heading = gradient[..., 1] * lever_arm[..., 0] - gradient[..., 0] * lever_arm[..., 1]
    return [gradient[..., 0], gradient[..., 1], by_heading]


def _odometry_columns(
    gradient: Array, arm: Array, path: Array, reference: int, noise: OdometryNoise
) -> list[Array]:
    """Return the derivatives of the readings by the errors of the odometry, in their sigmas.

    Scale, rotation scale and drift are constant; the random walk of heading and position is
    constant in each of :data:`WALK_UNITS` pieces.
    """
    step = np.diff(path, axis=0, prepend=path[:1])
    distance = np.hypot(step[:, 0], step[:, 1])
    rotation = step[:, 2]
    direction = step[:, :2].copy()  # of each step, times its length
    zero = np.zeros_like(distance)
    stretch = [noise.scale * np.ones_like(distance), zero, zero]
    bend = [zero, noise.rotation_scale * rotation, noise.drift_rad_per_m * distance]
    effort = np.cumsum(distance + np.abs(rotation) * noise.rotation_rad)
    edges = np.linspace(0.0, effort[-1], WALK_UNITS + 1)
    for first, last in pairwise(edges.tolist()):
        inside = (effort > first) & (effort <= last)
        length, angle = float(distance[inside].sum()), float(np.abs(rotation[inside]).sum())
        walk = math.sqrt(noise.heading_rad**2 * length + noise.rotation_rad**2 * angle)
        count = max(int(inside.sum()), 1)
        bend.append(np.where(inside, walk / count, 0.0))
        stretch.append(zero)
        # The position walks along the path; across it, the heading dominates.
        bend.append(zero)
        stretch.append(
            np.where(inside, noise.distance_m / math.sqrt(length), 0.0) if length > 0 else zero
        )
    heading = np.cumsum(np.stack(bend, -1), axis=0)
    mean_heading = heading - np.stack(bend, -1) / 2
    stretches = np.stack(stretch, -1)
    x = np.cumsum(direction[:, :1] * stretches - direction[:, 1:] * mean_heading, axis=0)
    y = np.cumsum(direction[:, 1:] * stretches + direction[:, :1] * mean_heading, axis=0)
    # Relative to the reference, whose pose is an unknown of its own.
    heading, x, y = (each - each[reference] for each in (heading, x, y))
    reference_heading = np.cumsum(np.stack(bend, -1), axis=0)[reference]
    offset = path[:, :2] - path[reference, :2]
    x = x + offset[:, 1:] * reference_heading
    y = y - offset[:, :1] * reference_heading
    sensor_x = x[:, None] - arm[..., 1, None] * heading[:, None]
    sensor_y = y[:, None] + arm[..., 0, None] * heading[:, None]
    by_error = gradient[..., 0, None] * sensor_x + gradient[..., 1, None] * sensor_y
    return list(np.moveaxis(by_error, -1, 0))


def _sensor_columns(total: Array, gradient: Array, errors: VisitErrors) -> list[Array]:
    """Return the derivatives by gains and offsets of the sensors, and by their height."""
    own = np.eye(total.shape[1])
    gains = [errors.gain * total * one for one in own]
    offsets = [errors.offset_t * np.broadcast_to(one, total.shape) for one in own]
    return [*gains, *offsets, errors.height_m * gradient[..., 2]]


def _bar_columns(
    field: Array, by_position: Array, strength: Array, errors: VisitErrors
) -> list[Array]:
    """Return the derivatives by the strength and the position of each bar."""
    columns = []
    for bar in range(4):
        columns.append(errors.bar_strength * strength[bar] * field[..., bar])
        for axis in range(2):
            columns.append(-errors.bar_position_m * strength[bar] * by_position[..., bar, axis])
    return columns


def _readings(path: Array, speed_mps: float, turn_rps: float, errors: VisitErrors) -> Array:
    """Return the number (n,) of readings of a sensor at each point of a path."""
    step = np.diff(path, axis=0)
    duration = np.maximum(
        np.hypot(step[:, 0], step[:, 1]) / speed_mps, np.abs(step[:, 2]) / turn_rps
    )
    near = np.r_[duration[:1], (duration[1:] + duration[:-1]) / 2, duration[-1:]]
    return np.asarray(errors.rate_hz * near)


def _iron_covariance(position: Array, errors: VisitErrors) -> Array:
    """Return the covariance (r, r) of the field of iron at positions (r, 2) in the plane."""
    square = np.sum((position[:, None] - position) ** 2, axis=-1)
    return np.asarray(
        errors.disturbance_t**2 * np.exp(-square / (2 * errors.disturbance_length_m**2))
    )
