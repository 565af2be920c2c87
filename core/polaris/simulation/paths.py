"""Where a simulated array is at any time: straight over each tag, at a speed that varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.tag import PlanarPose

Array = NDArray[np.float64]

NODES = 2000
"""Of the table of times, for a way of one wobble."""

MOST_NODES = 1_000_000
"""Of that table; a very slow start gets coarser ones."""

BENT_NODES = 500
"""Of a bend between two tags."""


class Wobble:
    """A smooth function of any number that stays within -1 and 1, and comes near both.

    A wave 1 to 3 long, with two shorter and weaker ones on it.
    """

    SHARES = np.array([0.6, 0.3, 0.1])

    def __init__(self, rng: np.random.Generator) -> None:
        self._wave = np.array([1.0, 2.3, 5.1]) / rng.uniform(1, 3)
        self._phase = rng.uniform(0, 2 * np.pi, 3)

    def __call__(self, x: Array) -> Array:
        """Values (...) at ``x`` (...)."""
        turns = np.asarray(x, float)[..., None] * self._wave
        return np.asarray(np.sin(2 * np.pi * turns + self._phase) @ self.SHARES)


@dataclass(frozen=True)
class Line:
    """A line on the floor, by its length.

    Attributes
    ----------
    way_m : (k,) ndarray
        Ascending, from 0.
    place_m : (k, 2) ndarray
    heading_rad : (k,) ndarray
        Of the line, without jumps of a turn.
    """

    way_m: Array
    place_m: Array
    heading_rad: Array

    @property
    def length_m(self) -> float:
        return float(self.way_m[-1])

    def at(self, way_m: Array) -> tuple[Array, Array]:
        """Places (..., 2) and headings (...) after ``way_m`` (...).

        Before its start and after its end the line goes straight on.
        """
        inside = np.clip(way_m, 0.0, self.length_m)
        heading = np.interp(inside, self.way_m, self.heading_rad)
        place = np.stack([np.interp(inside, self.way_m, c) for c in self.place_m.T], axis=-1)
        beyond = (np.asarray(way_m) - inside)[..., None]
        return place + beyond * np.stack([np.cos(heading), np.sin(heading)], axis=-1), heading


def line(stops: Sequence[PlanarPose], run_up_m: float, straight_m: float) -> Line:
    """A line straight through each stop at its heading, bent in between.

    Parameters
    ----------
    stops : sequence of PlanarPose
        At least one; no two neighbours in one place.
    run_up_m : float
        How far it starts before the first stop and ends after the last.
    straight_m : float
        How far it is straight before and after each stop, where stops leave room for that.
    """
    centre = np.array([[stop.x_m, stop.y_m] for stop in stops])
    heading = np.array([stop.heading_rad for stop in stops])
    way = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    places = [centre[0] - run_up_m * way[0]]
    tangents = [way[0]]
    for k in range(len(stops) - 1):
        apart = float(np.linalg.norm(centre[k + 1] - centre[k]))
        straight = min(straight_m, 0.3 * apart)
        start, end = centre[k] + straight * way[k], centre[k + 1] - straight * way[k + 1]
        bend, along = _hermite(start, end, way[k], way[k + 1])
        places.extend(bend)
        tangents.extend(along)
    places.append(centre[-1] + run_up_m * way[-1])
    tangents.append(way[-1])
    place, tangent = np.array(places), np.array(tangents)
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    turned = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return Line(np.r_[0.0, np.cumsum(step)], place, turned)


def _hermite(start: Array, end: Array, out: Array, into: Array) -> tuple[Array, Array]:
    """Cubic from one point and direction to another: points and tangents (k, 2)."""
    u = np.linspace(0.0, 1.0, BENT_NODES)[:, None]
    pull = np.linalg.norm(end - start)
    place = (
        (1 + u * u * (2 * u - 3)) * start
        + u * u * (3 - 2 * u) * end
        + pull * (u * (1 - u) ** 2 * out - u * u * (1 - u) * into)
    )
    tangent = 6 * u * (1 - u) * (end - start) + pull * (
        (1 - u) * (1 - 3 * u) * out - u * (2 - 3 * u) * into
    )
    return place, tangent


@dataclass(frozen=True)
class Drive:
    """How fast the line is driven.

    Attributes
    ----------
    speed_mps : float
        Above 0.
    rest_s : float
        Standing at the start.
    acceleration_mps2 : float or None
        From rest to the speed; None where it has the speed from the first moment on.
    wobble : float
        By which share of it the speed goes up and down, at most 0.9.
    """

    speed_mps: float
    rest_s: float = 0.0
    acceleration_mps2: float | None = None
    wobble: float = 0.0

    def speed(self, time_s: Array, wave: Wobble, scale_m: float) -> Array:
        """Speeds (...) in m/s at ``time_s`` (...)."""
        wobble = 1 + self.wobble * wave(time_s * self.speed_mps / scale_m)
        return self.speed_mps * self._started(time_s) * wobble

    def _started(self, time_s: Array) -> Array:
        driven_s = np.asarray(time_s) - self.rest_s
        if self.acceleration_mps2 is None:
            return np.where(driven_s >= 0, 1.0, 0.0)
        return np.clip(driven_s * self.acceleration_mps2 / self.speed_mps, 0.0, 1.0)

    def longest_s(self, way_m: float) -> float:
        """A time in which ``way_m`` is driven, however it wobbles."""
        least_m = way_m / (1 - self.wobble)
        ramp_s = np.sqrt(2 * least_m / self.acceleration_mps2) if self.acceleration_mps2 else 0.0
        return float(self.rest_s + ramp_s + least_m / self.speed_mps)


class Course:
    """A line that is driven: where the array is at any time.

    Attributes
    ----------
    duration_s : float
        From its start to the end of the line.
    """

    def __init__(
        self,
        line: Line,
        drive: Drive,
        scale_m: float,
        height_m: float,
        crab_rad: float,
        yaw_wobble_rad: float,
        height_wobble_m: float,
        rng: np.random.Generator,
    ) -> None:
        """
        Parameters
        ----------
        line : Line
        drive : Drive
        scale_m : float
            The length over which things wobble.
        height_m : float
        crab_rad : float
            From the way it goes to the way it points.
        yaw_wobble_rad, height_wobble_m : float
            By how much it turns and rises about that, along the way.
        rng : Generator
        """
        self._line, self._drive, self._scale_m = line, drive, scale_m
        self._height_m, self._height_wobble_m = height_m, height_wobble_m
        self._crab_rad, self._yaw_wobble_rad = crab_rad, yaw_wobble_rad
        self._speed_wave, self._yaw_wave, self._height_wave = (Wobble(rng) for _ in range(3))
        # Beyond the end as well, where the last sample's conversion ends.
        total_s = drive.longest_s(line.length_m + scale_m)
        step_s = max(scale_m / drive.speed_mps / NODES, (total_s - drive.rest_s) / MOST_NODES)
        self._time_s = np.r_[
            np.arange(0.0, drive.rest_s, step_s)[:1],
            np.arange(drive.rest_s, total_s + step_s, step_s),
        ]
        speed = self.speed(self._time_s)
        step = np.diff(self._time_s) * (speed[1:] + speed[:-1]) / 2
        if drive.rest_s > 0:
            step[0] = 0.0
        self._way_m = np.r_[0.0, np.cumsum(step)]
        self.duration_s = float(np.interp(line.length_m, self._way_m, self._time_s))

    def speed(self, time_s: Array) -> Array:
        """Speeds (...) in m/s at ``time_s`` (...)."""
        return self._drive.speed(time_s, self._speed_wave, self._scale_m)

    def pose(self, time_s: Array) -> tuple[Array, Array]:
        """Places (..., 3) of the array's middle and headings (...) at ``time_s`` (...)."""
        way = np.interp(time_s, self._time_s, self._way_m)
        flat, heading = self._line.at(way)
        u = way / self._scale_m
        height = self._height_m + self._height_wobble_m * self._height_wave(u)
        turned = heading + self._crab_rad + self._yaw_wobble_rad * self._yaw_wave(u)
        return np.concatenate([flat, height[..., None]], axis=-1), turned

    def crossings(self, x_m: float, y_m: float) -> Array:
        """Times (k,) in seconds at which a point of the floor passes under the array's y
        axis, from its front to its back."""
        time_s = self._time_s[self._time_s <= self.duration_s]
        place, heading = self.pose(time_s)
        ahead = (x_m - place[:, 0]) * np.cos(heading) + (y_m - place[:, 1]) * np.sin(heading)
        k = np.flatnonzero((ahead[:-1] > 0) & (ahead[1:] <= 0))
        share = ahead[k] / (ahead[k] - ahead[k + 1])
        return time_s[k] + share * (time_s[k + 1] - time_s[k])
