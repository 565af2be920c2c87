"""Accuracy along a route: fixes at known positions, and dead reckoning between them.

Only covariances are computed, no estimates: the Kalman filter and the Rauch-Tung-Striebel smoother
(AIAA Journal 3 (1965) 1445) of an error in the axes of the vehicle (forward, left, heading) and of
three constant errors of its odometry. Errors of odometry are those of
:class:`~locatk.core.streaming.planar_filter.OdometryNoise`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.error_quantiles import pose_error_quantiles
from locatk.core.errors import InputError
from locatk.core.streaming.planar_filter import OdometryNoise

Array = NDArray[np.float64]

DEFAULT_STEP_M = 0.05
"""Distance between two points of a route whose accuracy is computed [m]."""

MAX_STEPS = 20_000
"""Largest number of points of a route; on longer routes, they are farther apart."""

TURNING_SPEED_RAD_S = 1.0
"""Angular speed of a vehicle that turns at a waypoint [rad/s]."""


@dataclass(frozen=True, eq=False)
class Route:
    """Path of a vehicle: straight segments; the vehicle turns on the spot at waypoints.

    Attributes
    ----------
    waypoint_m : (n, 2) ndarray
        At least two, none at the position of the one before.
    name : str

    Raises
    ------
    InputError
        There are fewer than two waypoints, one is not finite, or two in a row are equal.
    """

    waypoint_m: Array
    name: str = "route"

    def __post_init__(self) -> None:
        waypoints = np.asarray(self.waypoint_m, float).reshape(-1, 2)
        object.__setattr__(self, "waypoint_m", waypoints)
        if len(waypoints) < 2:
            raise InputError(f"{self.name} has one waypoint", hint="Give two waypoints or more")
        if not np.isfinite(waypoints).all():
            raise InputError(f"{self.name}: a waypoint is not finite")
        repeated = np.flatnonzero(self.segment_m == 0)
        if len(repeated):
            raise InputError(
                f"{self.name}: waypoints {repeated[0] + 1} and {repeated[0] + 2} equal"
            )

    @property
    def segment_m(self) -> Array:
        """(n - 1,) lengths of the segments."""
        return np.asarray(np.hypot(*np.diff(self.waypoint_m, axis=0).T))

    @property
    def heading_rad(self) -> Array:
        """(n - 1,) headings of the segments, counter-clockwise from x."""
        dx, dy = np.diff(self.waypoint_m, axis=0).T
        return np.asarray(np.arctan2(dy, dx))

    @property
    def length_m(self) -> float:
        """Length of the route."""
        return float(self.segment_m.sum())

    def at(self, distance_m: Array) -> tuple[Array, Array]:
        """Return positions (m, 2) and headings (m,) after distances (m,) along the route.

        At a waypoint, the heading is that of the segment that begins there.
        """
        start_m = np.concatenate([[0.0], np.cumsum(self.segment_m)])
        last = len(self.segment_m) - 1
        segment = np.clip(np.searchsorted(start_m, distance_m, side="right") - 1, 0, last)
        heading = self.heading_rad[segment]
        along = np.asarray(distance_m) - start_m[segment]
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return self.waypoint_m[segment] + along[..., None] * direction, heading


@dataclass(frozen=True, eq=False)
class RouteFix:
    """Measurement of the pose at one point of a route.

    Attributes
    ----------
    distance_m : float
        From the start of the route.
    covariance : (3, 3) ndarray
        Of x (forward), y (left) and heading, in the axes of the vehicle, in m and rad. A component
        that is not measured has an infinite variance (and no covariances).
    """

    distance_m: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class RouteAccuracy:
    """Expected errors along a route.

    Attributes
    ----------
    distance_m : (m,) ndarray
        Points along the route, ascending; a point at which the vehicle turns or has a fix occurs
        before and after it.
    position_m, heading_rad : (m, 2), (m,) ndarray
    covariance : (m, 3, 3) ndarray
        Of x (forward), y (left) and heading, in the axes of the vehicle; ``nan`` where the
        pose is not yet known.
    since_fix_m : (m,) ndarray
        Distance since the last fix; ``inf`` before the first.
    weight_m : (m,) ndarray
        Distance from the point before: the weight of a point in a mean over the length.
    """

    distance_m: Array
    position_m: Array
    heading_rad: Array
    covariance: Array
    since_fix_m: Array
    weight_m: Array

    @property
    def position_rms_m(self) -> Array:
        """(m,) root of the mean square of the position error (both axes together)."""
        return np.asarray(np.sqrt(self.covariance[:, 0, 0] + self.covariance[:, 1, 1]))

    @property
    def heading_sigma_rad(self) -> Array:
        """(m,) standard deviation of the heading."""
        return np.asarray(np.sqrt(self.covariance[:, 2, 2]))

    @property
    def longest_without_fix_m(self) -> float:
        """Longest distance without a fix, the start and the end of the route included."""
        is_known = np.isfinite(self.since_fix_m)
        before = self.distance_m[-1] if not is_known.any() else self.distance_m[is_known][0]
        return float(max(before, self.since_fix_m[is_known].max(initial=0.0)))

    def quantiles(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the errors of position [m] and heading [rad] that are not exceeded.

        Over the length of the route, with a probability. They are ``inf`` if the pose is unknown on
        a larger part of it than that.
        """
        return pose_error_quantiles(self.covariance, probability, self.weight_m)


def predict_accuracy(
    route: Route,
    fixes: Sequence[RouteFix],
    noise: OdometryNoise | None = None,
    speed_mps: float = 0.3,
    *,
    is_smoothed: bool = False,
    start_covariance: Array | None = None,
    step_m: float = DEFAULT_STEP_M,
) -> RouteAccuracy:
    """Predict the accuracy along a route.

    Parameters
    ----------
    route : Route
    fixes : sequence of RouteFix
        In any order.
    noise : OdometryNoise, optional
    speed_mps : float
        Slip counts by time.
    is_smoothed : bool
        False: the errors of a filter, as of ``locatk live``. True: those of an estimate from the
        whole recording, as of ``locatk solve``; the part before the first fix is then known, too.
    start_covariance : (3, 3) ndarray, optional
        Of the pose at the start, if it is known.
    step_m : float
        Distance between points. It does not change the covariances.

    Raises
    ------
    InputError
        Speed or step are not positive, or a fix is not on the route.
    """
    if not (speed_mps > 0 and step_m > 0):
        raise InputError("speed and step must be above 0")
    length_m = route.length_m
    for fix in fixes:
        if not 0 <= fix.distance_m <= length_m * (1 + 1e-9):
            raise InputError(f"a fix at {fix.distance_m:g} m of a route of {length_m:g} m")
    noise = noise or OdometryNoise()
    steps = _steps_of(route, sorted(fixes, key=lambda fix: fix.distance_m), step_m)
    transitions = [_transition(step, noise, speed_mps) for step in steps]
    unknown = np.zeros((6, 6))
    unknown[range(3), range(3)] = np.inf
    constant = (noise.scale, noise.drift_rad_per_m, noise.rotation_scale)
    unknown[range(3, 6), range(3, 6)] = np.square(constant)
    start = unknown.copy()
    if start_covariance is not None:
        start[:3, :3] = start_covariance
    filtered, predicted = _filter(steps, transitions, start)
    covariances = _smooth(transitions, filtered, predicted) if is_smoothed else filtered
    distance_m = np.array([step.end_m for step in steps])
    position_m, heading_rad = route.at(distance_m)
    pose = np.array([covariance[:3, :3] for covariance in covariances])
    pose[~np.isfinite(pose).all(axis=(1, 2))] = np.nan
    is_fix = np.array([step.fix is not None for step in steps])
    last_fix = np.maximum.accumulate(np.where(is_fix, distance_m, -np.inf))
    return RouteAccuracy(
        distance_m,
        position_m,
        heading_rad,
        pose,
        distance_m - last_fix,
        np.diff(distance_m, prepend=0.0),
    )


@dataclass(frozen=True, eq=False)
class _Step:
    """Motion to a point of the route, and the fix there: straight, or a rotation on the spot."""

    length_m: float
    rotation_rad: float
    end_m: float
    fix: RouteFix | None = None


def _steps_of(route: Route, fixes: Sequence[RouteFix], step_m: float) -> list[_Step]:
    """Divide a route into steps that end at fixes, waypoints, and at most every ``step_m``."""
    step_m = max(step_m, route.length_m / MAX_STEPS)
    steps = [_Step(0.0, 0.0, 0.0)]
    pending = list(fixes)
    start_m, count = 0.0, len(route.segment_m)
    for number, (length_m, heading) in enumerate(
        zip(route.segment_m.tolist(), route.heading_rad.tolist(), strict=True)
    ):
        end_m = start_m + length_m
        if number:
            rotation = math.remainder(heading - route.heading_rad[number - 1], 2 * math.pi)
            steps.append(_Step(0.0, rotation, start_m))
        is_last = number == count - 1
        is_here = [fix for fix in pending if fix.distance_m < end_m or is_last]
        pending = pending[len(is_here) :]
        grid = np.linspace(start_m, end_m, math.ceil(length_m / step_m) + 1)[1:]
        stops: list[tuple[float, RouteFix | None]] = [(stop_m, None) for stop_m in grid.tolist()]
        stops += [(min(fix.distance_m, end_m), fix) for fix in is_here]
        position = start_m
        for stop_m, fix in sorted(stops, key=lambda stop: stop[0]):
            if stop_m > position or fix is None:
                steps.append(_Step(stop_m - position, 0.0, stop_m))
            if fix is not None:
                steps.append(_Step(0.0, 0.0, stop_m, fix))
            position = stop_m
        start_m = end_m
    return steps


def _transition(step: _Step, noise: OdometryNoise, speed_mps: float) -> tuple[Array, Array]:
    """Return transition (6, 6) and added covariance (6, 6) of a step.

    The state is the error of x, y and heading in the axes of the vehicle, and of the scale of
    distances, the drift of the heading and the scale of rotations. A random walk of the heading
    within a step of length L displaces its end: L^2/3 of its variance across, L/2 correlated.
    """
    length, rotation = step.length_m, step.rotation_rad
    cos, sin = math.cos(rotation), math.sin(rotation)
    transition = np.eye(6)
    transition[:2, :2] = [[cos, sin], [-sin, cos]]
    transition[0, 3] = length
    transition[1, 2], transition[1, 4] = length, length**2 / 2
    transition[2, 4], transition[2, 5] = length, rotation
    added = np.zeros((6, 6))
    duration_s = length / speed_mps + abs(rotation) / TURNING_SPEED_RAD_S
    position = noise.distance_m**2 * length + noise.slip_m**2 * duration_s
    heading = (
        noise.heading_rad**2 * length
        + noise.rotation_rad**2 * abs(rotation)
        + noise.slip_rad**2 * duration_s
    )
    added[0, 0] = position
    added[1:3, 1:3] = [
        [position + heading * length**2 / 3, heading * length / 2],
        [heading * length / 2, heading],
    ]
    return transition, added


def _filter(
    steps: Sequence[_Step], transitions: Sequence[tuple[Array, Array]], start: Array
) -> tuple[list[Array], list[Array]]:
    """Return the covariances after and before the fix of each step.

    A pose that is unknown (infinite) starts at the first fix. Until then, nothing is learnt about
    the odometry, so that the constant errors keep their prior.
    """
    covariance, filtered, predicted = start, [], []
    for step, (transition, added) in zip(steps, transitions, strict=True):
        if np.isfinite(covariance).all():
            covariance = transition @ covariance @ transition.T + added
        predicted.append(covariance)
        if step.fix is not None:
            covariance = _with_fix(covariance, np.asarray(step.fix.covariance, float))
        filtered.append(covariance)
    return filtered, predicted


def _with_fix(covariance: Array, fix: Array) -> Array:
    """Return a covariance (6, 6) after a fix, whose unknown components have infinite variances."""
    if not np.isfinite(covariance).all():
        started = covariance.copy()
        started[:3, :3] = fix  # still unknown if the fix is not complete
        return started
    rows = np.flatnonzero(np.isfinite(np.diag(fix)))
    if not len(rows):
        return covariance
    cross = covariance[:, rows]
    gain = np.linalg.solve(cross[rows] + fix[np.ix_(rows, rows)], cross.T).T
    updated = covariance - gain @ cross.T
    return np.asarray((updated + updated.T) / 2)


def _smooth(
    transitions: Sequence[tuple[Array, Array]], filtered: list[Array], predicted: list[Array]
) -> list[Array]:
    """Return the covariances given all fixes, from the last step to the first.

    Before the first fix, the pose follows from it by driving backwards.
    """
    smoothed = [filtered[-1]]
    for number in range(len(filtered) - 2, -1, -1):
        transition, added = transitions[number + 1]
        after = smoothed[-1]
        if np.isfinite(filtered[number]).all():
            cross = filtered[number] @ transition.T
            gain = np.linalg.lstsq(predicted[number + 1], cross.T, rcond=None)[0].T
            covariance = filtered[number] + gain @ (after - predicted[number + 1]) @ gain.T
        elif np.isfinite(after).all():
            inverse = np.linalg.inv(transition)
            covariance = inverse @ (after + added) @ inverse.T
        else:
            covariance = after
        smoothed.append((covariance + covariance.T) / 2)
    return smoothed[::-1]
