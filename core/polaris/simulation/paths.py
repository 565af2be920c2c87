"""Path of a simulated array: straight over each tag, at a speed that varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.tag import PlanarPose
from locatk.core.simulation import check_session_size

Array = NDArray[np.float64]

NODES_PER_WOBBLE = 2000
"""Nodes of the table from time to distance, for a distance of one wobble."""

MAX_NODES = 1_000_000
"""Largest number of nodes of that table; a very slow start gets longer intervals."""

NODES_PER_BEND = 500
"""Nodes of the curve between two tags."""

MAX_STRAIGHT_FRACTION = 0.3
"""Largest straight part at each of two tags, as a fraction of their distance."""


class Wobble:
    """Smooth random function of one variable with values from -1 to 1.

    The sum of a sine with a period of 1 to 3 and of two shorter and weaker ones.
    """

    AMPLITUDES = np.array([0.6, 0.3, 0.1])

    def __init__(self, rng: np.random.Generator) -> None:
        self._frequency = np.array([1.0, 2.3, 5.1]) / rng.uniform(1, 3)
        self._phase = rng.uniform(0, 2 * np.pi, 3)

    def __call__(self, x: Array) -> Array:
        """Return the values (...) at ``x`` (...)."""
        periods = np.asarray(x, float)[..., None] * self._frequency
        return np.asarray(np.sin(2 * np.pi * periods + self._phase) @ self.AMPLITUDES)


@dataclass(frozen=True)
class PlanarPath:
    """Polyline on the floor, parametrised by its length.

    Attributes
    ----------
    distance_m : (k,) ndarray
        Distance of each node along the path, ascending from 0.
    position_m : (k, 2) ndarray
    heading_rad : (k,) ndarray
        Direction of the path, unwrapped.
    """

    distance_m: Array
    position_m: Array
    heading_rad: Array

    @property
    def length_m(self) -> float:
        return float(self.distance_m[-1])

    def at(self, distance_m: Array) -> tuple[Array, Array]:
        """Return positions (..., 2) and headings (...) after ``distance_m`` (...).

        The path continues straight before its start and after its end.
        """
        inside = np.clip(distance_m, 0.0, self.length_m)
        heading = np.interp(inside, self.distance_m, self.heading_rad)
        position = np.stack(
            [np.interp(inside, self.distance_m, c) for c in self.position_m.T], axis=-1
        )
        beyond = (np.asarray(distance_m) - inside)[..., None]
        return position + beyond * np.stack([np.cos(heading), np.sin(heading)], axis=-1), heading


def path_through(stops: Sequence[PlanarPose], run_up_m: float, straight_m: float) -> PlanarPath:
    """Return the path straight through each stop at its heading, curved in between.

    Parameters
    ----------
    stops : sequence of PlanarPose
        At least one; no two neighbours at the same position.
    run_up_m : float
        Length of the path before the first stop and after the last.
    straight_m : float
        Length of the straight part before and after each stop, or
        :data:`MAX_STRAIGHT_FRACTION` of the distance between two stops if that is shorter.
    """
    centre = np.array([[stop.x_m, stop.y_m] for stop in stops])
    heading = np.array([stop.heading_rad for stop in stops])
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    positions = [centre[0] - run_up_m * direction[0]]
    tangents = [direction[0]]
    for k in range(len(stops) - 1):
        separation_m = float(np.linalg.norm(centre[k + 1] - centre[k]))
        straight = min(straight_m, MAX_STRAIGHT_FRACTION * separation_m)
        start = centre[k] + straight * direction[k]
        end = centre[k + 1] - straight * direction[k + 1]
        bend, bend_tangents = _hermite_curve(start, end, direction[k], direction[k + 1])
        positions.extend(bend)
        tangents.extend(bend_tangents)
    positions.append(centre[-1] + run_up_m * direction[-1])
    tangents.append(direction[-1])
    position, tangent = np.array(positions), np.array(tangents)
    step_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    unwrapped = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return PlanarPath(np.r_[0.0, np.cumsum(step_m)], position, unwrapped)


def _hermite_curve(
    start: Array, end: Array, start_direction: Array, end_direction: Array
) -> tuple[Array, Array]:
    """Return points and tangents (k, 2) of the cubic Hermite curve between two points."""
    u = np.linspace(0.0, 1.0, NODES_PER_BEND)[:, None]
    tangent_norm = np.linalg.norm(end - start)
    position = (
        (1 + u * u * (2 * u - 3)) * start
        + u * u * (3 - 2 * u) * end
        + tangent_norm * (u * (1 - u) ** 2 * start_direction - u * u * (1 - u) * end_direction)
    )
    tangent = 6 * u * (1 - u) * (end - start) + tangent_norm * (
        (1 - u) * (1 - 3 * u) * start_direction - u * (2 - 3 * u) * end_direction
    )
    return position, tangent


@dataclass(frozen=True)
class SpeedProfile:
    """Speed along a path as a function of time.

    Attributes
    ----------
    speed_mps : float
        Above 0.
    rest_s : float
        Rest at the start.
    acceleration_mps2 : float or None
        Acceleration from rest to the speed; None if it drives at speed from the start.
    wobble : float
        Relative amplitude of the variation of the speed, at most 0.9.
    """

    speed_mps: float
    rest_s: float = 0.0
    acceleration_mps2: float | None = None
    wobble: float = 0.0

    def speed(self, time_s: Array, wobble: Wobble, wobble_length_m: float) -> Array:
        """Return the speeds (...) in m/s at ``time_s`` (...)."""
        variation = 1 + self.wobble * wobble(time_s * self.speed_mps / wobble_length_m)
        return self.speed_mps * self._ramp(time_s) * variation

    def _ramp(self, time_s: Array) -> Array:
        """Return the fraction of the speed that is reached."""
        driven_s = np.asarray(time_s) - self.rest_s
        if self.acceleration_mps2 is None:
            return np.where(driven_s >= 0, 1.0, 0.0)
        return np.clip(driven_s * self.acceleration_mps2 / self.speed_mps, 0.0, 1.0)

    def max_duration_s(self, distance_m: float) -> float:
        """Return an upper bound of the time for a distance, for any wobble."""
        slowest_m = distance_m / (1 - self.wobble)
        ramp_s = np.sqrt(2 * slowest_m / self.acceleration_mps2) if self.acceleration_mps2 else 0.0
        return float(self.rest_s + ramp_s + slowest_m / self.speed_mps)


class ArrayTrajectory:
    """Pose of the array as a function of time: a path that is driven with a speed profile.

    Attributes
    ----------
    duration_s : float
        Time from the start to the end of the path.
    """

    def __init__(
        self,
        path: PlanarPath,
        speed_profile: SpeedProfile,
        wobble_length_m: float,
        height_m: float,
        crab_rad: float,
        yaw_wobble_rad: float,
        height_wobble_m: float,
        rng: np.random.Generator,
    ) -> None:
        """
        Parameters
        ----------
        path : PlanarPath
        speed_profile : SpeedProfile
        wobble_length_m : float
            Distance over which speed, yaw and height vary.
        height_m : float
        crab_rad : float
            Angle from the direction of travel to the array's x.
        yaw_wobble_rad, height_wobble_m : float
            Amplitudes of the variations of that angle and of the height along the path.
        rng : Generator
        """
        self._path, self._speed_profile = path, speed_profile
        self._wobble_length_m = wobble_length_m
        self._height_m, self._height_wobble_m = height_m, height_wobble_m
        self._crab_rad, self._yaw_wobble_rad = crab_rad, yaw_wobble_rad
        self._speed_wobble, self._yaw_wobble, self._height_wobble = (Wobble(rng) for _ in range(3))
        # The table goes beyond the end of the path: the conversion of the last sample ends there.
        total_s = speed_profile.max_duration_s(path.length_m + wobble_length_m)
        check_session_size(0, total_s)
        rest_s = speed_profile.rest_s
        step_s = max(
            wobble_length_m / speed_profile.speed_mps / NODES_PER_WOBBLE,
            (total_s - rest_s) / MAX_NODES,
        )
        self._time_s = np.r_[
            np.arange(0.0, rest_s, step_s)[:1], np.arange(rest_s, total_s + step_s, step_s)
        ]
        speed = self.speed(self._time_s)
        step_m = np.diff(self._time_s) * (speed[1:] + speed[:-1]) / 2
        if rest_s > 0:
            step_m[0] = 0.0
        self._distance_m = np.r_[0.0, np.cumsum(step_m)]
        self.duration_s = float(np.interp(path.length_m, self._distance_m, self._time_s))

    def speed(self, time_s: Array) -> Array:
        """Return the speeds (...) in m/s at ``time_s`` (...)."""
        return self._speed_profile.speed(time_s, self._speed_wobble, self._wobble_length_m)

    def pose(self, time_s: Array) -> tuple[Array, Array]:
        """Return positions (..., 3) of the middle of the array and headings (...)."""
        distance_m = np.interp(time_s, self._time_s, self._distance_m)
        position, heading = self._path.at(distance_m)
        u = distance_m / self._wobble_length_m
        height = self._height_m + self._height_wobble_m * self._height_wobble(u)
        yaw = heading + self._crab_rad + self._yaw_wobble_rad * self._yaw_wobble(u)
        return np.concatenate([position, height[..., None]], axis=-1), yaw

    def crossing_times_s(self, x_m: float, y_m: float) -> Array:
        """Return the times (k,) at which a point of the floor passes the array's y axis.

        Only passes from front to back are returned.
        """
        time_s = self._time_s[self._time_s <= self.duration_s]
        position, heading = self.pose(time_s)
        ahead = (x_m - position[:, 0]) * np.cos(heading) + (y_m - position[:, 1]) * np.sin(heading)
        k = np.flatnonzero((ahead[:-1] > 0) & (ahead[1:] <= 0))
        fraction = ahead[k] / (ahead[k] - ahead[k + 1])
        return time_s[k] + fraction * (time_s[k + 1] - time_s[k])
