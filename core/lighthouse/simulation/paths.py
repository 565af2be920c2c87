"""Trajectories of simulated robots: smooth closed curves, driven in legs with rests between them,
and flights of quadrotors.

All positions are in closed form, so that a simulator can evaluate any time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading, quaternion_from_matrix
from locatk.core.inertial import STANDARD_GRAVITY_M_S2

Array = NDArray[np.float64]

FLOOR_WIDTH_M = 1.8
"""Width of the square in which robots drive [m]: a floor of 2 m less a margin."""

MEAN_HEIGHT_M = 0.25
"""Mean height of robots that are moved through space [m]."""

HEIGHT_AMPLITUDE_M = (0.15, 0.25)
"""Range from which the amplitude of the height is drawn [m]."""

TOP_SPEED_MPS = (0.2, 0.3)
"""Range from which the top speed of a leg is drawn [m/s]."""

LEG_DURATION_S, REST_DURATION_S = (5.0, 12.0), (0.5, 2.0)
"""Ranges from which the durations of legs and of the rests between them are drawn [s]."""

MARKER_VISIT_S, CARRY_S = 2.0, 1.0
"""Time for which a robot rests on each marker, and for which it is carried to the next one [s]."""

MIN_MARKER_VISIT_S, MIN_CARRY_S = 0.25, 0.5
"""Shortest of these in a short session: two reports of a robot that reports ten times a second, and
a speed that a hand reaches [s]."""

FLIGHT_CENTRE_M, FLIGHT_HALF_RANGE_M = np.array([0.0, 0.0, 0.75]), np.array([0.8, 0.8, 0.4])
"""Centre of the volume in which robots fly, and half of its size [m]."""

FLOOR_REST_S, CLIMB_S = 1.0, 2.0
"""Rest before the take-off and after the landing, and duration of each of these [s]."""

STEP_S = 1e-3
"""Step of the numerical derivatives of a flight [s]. Errors of the accelerations are below 1e-5 of
their size, and rounding adds 1e-9 m/s^2."""


class ClosedCurve:
    """Random closed curve without cusps, parametrised by its length.

    In the complex plane it is a circle and a few harmonics. The speeds of the harmonics sum to
    less than that of the circle, so that the speed along the curve never vanishes.

    Attributes
    ----------
    length_m : float
        Length of the curve.
    """

    ORDERS = np.array([1, -1, 2, -2, 3])
    """Order of the circle and of the harmonics."""

    HARMONIC_SPEED_RATIO = 0.6
    """Sum of the speeds of the harmonics, relative to the speed of the circle."""

    NODES = 4096
    """Nodes of the table from length to parameter."""

    def __init__(self, rng: np.random.Generator, planar: bool) -> None:
        speed_ratio = rng.dirichlet(np.ones(len(self.ORDERS) - 1)) * self.HARMONIC_SPEED_RATIO
        phase = np.exp(2j * np.pi * rng.random(len(self.ORDERS)))
        self._weights = np.r_[1.0, speed_ratio / np.abs(self.ORDERS[1:])] * phase
        self._centre = 0j
        self._mean_height, self._height_amplitude = (
            (0.0, 0.0) if planar else (MEAN_HEIGHT_M, rng.uniform(*HEIGHT_AMPLITUDE_M))
        )
        self._height_periods = int(rng.integers(1, 4))
        self._height_phase = rng.uniform(0, 2 * np.pi)
        self._direction = rng.choice([-1, 1])
        nodes = self._direction * np.linspace(0.0, 2 * np.pi, self.NODES + 1)
        width = FLOOR_WIDTH_M * rng.uniform(0.7, 1.0)
        self._fit_to_floor(self._evaluate(nodes), width, rng.uniform(-1, 1, 2))
        step_m = np.linalg.norm(np.diff(self._evaluate(nodes), axis=0), axis=1)
        self._nodes, self._node_distance_m = nodes, np.r_[0.0, np.cumsum(step_m)]
        self.length_m = float(self._node_distance_m[-1])

    def _fit_to_floor(self, positions: Array, width: float, shift: Array) -> None:
        """Scale the curve to ``width`` and shift it on the floor, by -1 to 1 from edge to edge."""
        low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
        scale = width / np.max(high - low)
        margin = (FLOOR_WIDTH_M - scale * (high - low)) / 2
        self._weights = self._weights * scale
        self._centre = complex(*(margin * shift - scale * (low + high) / 2))

    def _evaluate(self, u: Array) -> Array:
        """Return the points (..., 3) of parameters ``u`` (...) in radians."""
        plane = np.exp(1j * u[..., None] * self.ORDERS) @ self._weights + self._centre
        z = self._mean_height + self._height_amplitude * np.sin(
            self._height_periods * u + self._height_phase
        )
        return np.stack([plane.real, plane.imag, z], axis=-1)

    def _parameter(self, distance_m: Array) -> Array:
        wrapped_m = np.mod(distance_m, self.length_m)
        parameter: Array = np.interp(wrapped_m, self._node_distance_m, self._nodes)
        return parameter

    def position(self, distance_m: Array) -> Array:
        """Return points (..., 3) in metres at distances (...) along the curve."""
        return self._evaluate(self._parameter(distance_m))

    def heading(self, distance_m: Array) -> Array:
        """Return the directions (...) of the curve in the xy plane, in radians."""
        phasors = np.exp(1j * self._parameter(distance_m)[..., None] * self.ORDERS)
        tangent = phasors @ (1j * self.ORDERS * self._weights)
        return np.angle(self._direction * tangent)


class StopAndGo:
    """Progress over time in legs that begin and end at rest.

    Parameters
    ----------
    start_s, duration_s : (n,) ndarray
        Start and duration of each leg, ascending and not overlapping.
    advance : (n,) ndarray
        Progress made in each leg, in any unit.
    """

    PEAK_SPEED_RATIO = 15 / 8
    """Top speed of a leg relative to its mean speed, of the polynomial used here."""

    def __init__(self, start_s: Array, duration_s: Array, advance: Array) -> None:
        self._start_s, self._duration_s, self._advance = start_s, duration_s, advance
        self._progress_at_start = np.r_[0.0, np.cumsum(advance)[:-1]]

    def __call__(self, time_s: Array) -> Array:
        """Return the progress (...) at times (...)."""
        leg = np.maximum(np.searchsorted(self._start_s, time_s, side="right") - 1, 0)
        x = np.clip((time_s - self._start_s[leg]) / self._duration_s[leg], 0.0, 1.0)
        # Speed and acceleration of 10 x^3 - 15 x^4 + 6 x^5 are zero at both ends.
        return self._progress_at_start[leg] + self._advance[leg] * x**3 * (
            10.0 + x * (6.0 * x - 15.0)
        )


class MarkerTour:
    """Rests on markers, before a robot moves by itself.

    It ends in the first half of the session. If this is short, rests and carries are shorter, down
    to limits; then it takes up to three quarters of the session, and leaves out the last markers.

    Parameters
    ----------
    duration_s : float
        Duration of the session.
    markers : (k, 3) ndarray
        Positions of the markers in metres; k may be 0.
    destination : (3,) ndarray
        Position to which the robot is carried in the end.

    Attributes
    ----------
    visits_s : (k, 2) ndarray
        Start and end of the rest on each marker.
    carry_edges_s : (2 k,) ndarray
        Ascending starts and ends of the times in which it is carried.
    end_s : float
        Time from which on the robot moves by itself.
    """

    def __init__(self, duration_s: float, markers: Array, destination: Array) -> None:
        longest_s, shortest_s = MARKER_VISIT_S + CARRY_S, MIN_MARKER_VISIT_S + MIN_CARRY_S
        k = min(len(markers), int(0.75 * duration_s / shortest_s))
        marker_s = min(max(0.5 * duration_s / max(k, 1), shortest_s), longest_s)
        carry_s = max(MIN_CARRY_S, marker_s * CARRY_S / longest_s)
        arrival_s = marker_s * np.arange(k, dtype=float)
        departure_s = arrival_s + marker_s - carry_s
        self.visits_s = np.stack([arrival_s, departure_s], axis=1)
        self.end_s = marker_s * k
        carry_end_s = np.r_[arrival_s[1:], [self.end_s][:k]]
        self.carry_edges_s = np.stack([departure_s, carry_end_s], axis=1).ravel()
        if k:
            self._progress = StopAndGo(departure_s, np.full(k, carry_s), np.ones(k))
            self._stops = np.vstack([markers[:k], destination])

    def place(self, position: Array, time_s: Array) -> None:
        """Replace the positions (..., 3) at times (...) of the tour, in place."""
        on_tour = time_s < self.end_s
        if len(self.carry_edges_s) and np.any(on_tour):
            stop = self._progress(time_s[on_tour])
            stops = np.arange(len(self._stops))
            position[on_tour] = np.stack(
                [np.interp(stop, stops, self._stops[:, i]) for i in range(3)], axis=-1
            )


class RobotPath(Protocol):
    """Pose of one robot as a function of time: first on markers, then on its own."""

    tour: MarkerTour

    def position(self, time_s: Array) -> Array:
        """Return positions (..., 3) in metres at times (...)."""
        ...

    def quaternion(self, time_s: Array) -> Array:
        """Return orientations (..., 4) as (x, y, z, w) at times (...)."""
        ...

    def rotate(self, vector: Array, time_s: Array) -> Array:
        """Rotate a vector (3,) of the robot's axes at times (...) to (..., 3)."""
        ...


class UprightPath(ABC):
    """Orientation of a robot that turns about the vertical only; see :class:`RobotPath`."""

    @abstractmethod
    def heading(self, time_s: Array) -> Array:
        """Return headings (...) in radians at times (...)."""

    def quaternion(self, time_s: Array) -> Array:
        """Return orientations (..., 4) as (x, y, z, w) at times (...)."""
        return quaternion_from_heading(self.heading(time_s))

    def rotate(self, vector: Array, time_s: Array) -> Array:
        """Rotate a vector (3,) of the robot's axes at times (...) to (..., 3)."""
        heading = self.heading(time_s)
        cos, sin = np.cos(heading), np.sin(heading)
        x, y, z = vector
        return np.stack([cos * x - sin * y, sin * x + cos * y, np.full_like(cos, z)], axis=-1)


class DrivenPath(UprightPath):
    """Path of a robot that drives along a :class:`ClosedCurve`; see :class:`RobotPath`.

    Parameters
    ----------
    rng : Generator
    planar : bool
        True for a robot on the floor z = 0.
    duration_s : float
        Duration of the session.
    markers : (k, 3) ndarray
        Positions of the markers in metres; k may be 0.
    """

    def __init__(
        self, rng: np.random.Generator, planar: bool, duration_s: float, markers: Array
    ) -> None:
        self._curve = ClosedCurve(rng, planar)
        self._start_distance_m = rng.uniform(0.0, self._curve.length_m)
        start = self._curve.position(np.array(self._start_distance_m))
        self.tour = MarkerTour(duration_s, markers, start)
        legs = int(duration_s / LEG_DURATION_S[0]) + 1
        leg_s, rest_s = rng.uniform(*LEG_DURATION_S, legs), rng.uniform(*REST_DURATION_S, legs)
        start_s = self.tour.end_s + np.r_[0.0, np.cumsum(leg_s + rest_s)[:-1]]
        advance_m = rng.uniform(*TOP_SPEED_MPS, legs) * leg_s / StopAndGo.PEAK_SPEED_RATIO
        self._drive = StopAndGo(start_s, leg_s, advance_m)

    def position(self, time_s: Array) -> Array:
        """Return positions (..., 3) in metres at times (...)."""
        position = self._curve.position(self._start_distance_m + self._drive(time_s))
        self.tour.place(position, time_s)
        return position

    def heading(self, time_s: Array) -> Array:
        """Return headings (...) in radians; on markers, that with which it will start to drive."""
        return self._curve.heading(self._start_distance_m + self._drive(time_s))


class FlownPath:
    """Path of a quadrotor that takes off, flies and lands; see :class:`RobotPath`.

    Each coordinate is a sum of waves. The aircraft tilts so that its rotors push along its
    acceleration plus gravity, and turns slowly about its vertical axis.

    Parameters
    ----------
    rng : Generator
    duration_s : float
        Duration of the session. It ends with a rest after the landing.
    markers : (k, 3) ndarray
        Positions of the markers in metres; k may be 0.
    top_speed_mps : float
        Bound of the speed between take-off and landing.

    Attributes
    ----------
    flying_s : (float, float)
        Start of the take-off and end of the landing.
    """

    WAVES = 3
    """Waves for each coordinate, and for the heading."""

    def __init__(
        self, rng: np.random.Generator, duration_s: float, markers: Array, top_speed_mps: float
    ) -> None:
        start = np.append(rng.uniform(-0.5, 0.5, 2), 0.0)
        self.tour = MarkerTour(duration_s, markers, start)
        rest_s = min(FLOOR_REST_S, (duration_s - self.tour.end_s) / 6)
        self.flying_s = (self.tour.end_s + rest_s, duration_s - rest_s)
        self._climb_s = min(CLIMB_S, (self.flying_s[1] - self.flying_s[0]) / 3)
        self._floor = start
        amplitude = rng.dirichlet(np.ones(self.WAVES), 3) * FLIGHT_HALF_RANGE_M[:, None]
        frequency = rng.uniform(1.0, 3.0, (3, self.WAVES))
        # The speed of a coordinate is at most the sum of the speeds of its waves.
        bound = np.linalg.norm(np.sum(amplitude * frequency, axis=1))
        self._amplitude = amplitude
        self._frequency = frequency * (top_speed_mps / bound)
        self._phase = rng.uniform(0, 2 * np.pi, (3, self.WAVES))
        self._heading = rng.uniform(-np.pi, np.pi)
        self._heading_waves = rng.uniform(0.1, 0.4, self.WAVES), rng.uniform(0, 6, self.WAVES)

    def position(self, time_s: Array) -> Array:
        """Return positions (..., 3) in metres at times (...)."""
        time_s = np.asarray(time_s)
        waves = np.sin(self._frequency * time_s[..., None, None] + self._phase)
        flown = FLIGHT_CENTRE_M + np.sum(self._amplitude * waves, axis=-1)
        height = _smooth_step((time_s - self.flying_s[0]) / self._climb_s) * _smooth_step(
            (self.flying_s[1] - time_s) / self._climb_s
        )
        position = self._floor + height[..., None] * (flown - self._floor)
        self.tour.place(position, time_s)
        return position

    def acceleration(self, time_s: Array) -> Array:
        """Return accelerations (..., 3) in the room at times (...) [m/s^2]."""
        before, after = self.position(time_s - STEP_S), self.position(time_s + STEP_S)
        return (before - 2 * self.position(time_s) + after) / STEP_S**2

    def axes(self, time_s: Array) -> Array:
        """Return rotations (..., 3, 3) from the aircraft to the room at times (...)."""
        is_flying = (time_s > self.flying_s[0]) & (time_s < self.flying_s[1])
        thrust = np.where(is_flying[..., None], self.acceleration(time_s), 0.0)
        thrust[..., 2] += STANDARD_GRAVITY_M_S2
        up = thrust / np.linalg.norm(thrust, axis=-1, keepdims=True)
        rate, phase = self._heading_waves
        flown_s = np.clip(time_s, *self.flying_s)
        heading = self._heading + 0.5 * np.sum(np.sin(rate * flown_s[..., None] + phase), axis=-1)
        ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
        left = np.cross(up, ahead)
        left /= np.linalg.norm(left, axis=-1, keepdims=True)
        return np.stack([np.cross(left, up), left, up], axis=-1)

    def quaternion(self, time_s: Array) -> Array:
        """Return orientations (..., 4) as (x, y, z, w) at times (...)."""
        return quaternion_from_matrix(self.axes(time_s))

    def rotate(self, vector: Array, time_s: Array) -> Array:
        """Rotate a vector (3,) of the robot's axes at times (...) to (..., 3)."""
        return self.axes(time_s) @ vector


def _smooth_step(x: Array) -> Array:
    """Return the transition from 0 to 1 without speed, acceleration and jerk at both ends.

    The angular rate of an aircraft follows the jerk and must not jump.
    """
    x = np.clip(x, 0.0, 1.0)
    return x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)))
