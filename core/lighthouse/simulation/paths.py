"""Trajectories of simulated robots: smooth closed curves, driven in legs with rests between them.

All of it is in closed form, so that a simulator can evaluate any time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


class RobotPath:
    """Pose of one robot as a function of time.

    The robot is set on each marker in turn, then drives along a :class:`ClosedCurve`. In a
    session that is too short for this, the markers are visited faster, in its first half.

    Parameters
    ----------
    rng : Generator
    planar : bool
        True for a robot on the floor z = 0.
    duration_s : float
        Duration of the session.
    markers : (k, 3) ndarray
        Positions of the markers in metres; k may be 0.

    Attributes
    ----------
    visits_s : (k, 2) ndarray
        Start and end of the rest on each marker.
    carry_edges_s : (2 k,) ndarray
        Ascending starts and ends of the times in which it is carried.
    """

    def __init__(
        self, rng: np.random.Generator, planar: bool, duration_s: float, markers: Array
    ) -> None:
        self._curve = ClosedCurve(rng, planar)
        self._start_distance_m = rng.uniform(0.0, self._curve.length_m)
        k = len(markers)
        time_scale = min(1.0, duration_s / 2 / (k * (MARKER_VISIT_S + CARRY_S))) if k else 1.0
        arrival_s = time_scale * (MARKER_VISIT_S + CARRY_S) * np.arange(k, dtype=float)
        departure_s = arrival_s + time_scale * MARKER_VISIT_S
        self.visits_s = np.stack([arrival_s, departure_s], axis=1)
        self._drive_start_s = time_scale * (MARKER_VISIT_S + CARRY_S) * k
        carry_end_s = np.r_[arrival_s[1:], [self._drive_start_s][:k]]
        self.carry_edges_s = np.stack([departure_s, carry_end_s], axis=1).ravel()
        if k:
            self._tour = StopAndGo(departure_s, np.full(k, time_scale * CARRY_S), np.ones(k))
            self._stops = np.vstack(
                [markers, self._curve.position(np.array(self._start_distance_m))]
            )

        legs = int(duration_s / LEG_DURATION_S[0]) + 1
        leg_s, rest_s = rng.uniform(*LEG_DURATION_S, legs), rng.uniform(*REST_DURATION_S, legs)
        start_s = self._drive_start_s + np.r_[0.0, np.cumsum(leg_s + rest_s)[:-1]]
        advance_m = rng.uniform(*TOP_SPEED_MPS, legs) * leg_s / StopAndGo.PEAK_SPEED_RATIO
        self._drive = StopAndGo(start_s, leg_s, advance_m)

    def position(self, time_s: Array) -> Array:
        """Return positions (..., 3) in metres at times (...)."""
        position = self._curve.position(self._start_distance_m + self._drive(time_s))
        on_tour = time_s < self._drive_start_s
        if len(self.carry_edges_s) and np.any(on_tour):
            stop = self._tour(time_s[on_tour])
            stops = np.arange(len(self._stops))
            position[on_tour] = np.stack(
                [np.interp(stop, stops, self._stops[:, i]) for i in range(3)], axis=-1
            )
        return position

    def heading(self, time_s: Array) -> Array:
        """Return headings (...) in radians; on markers, that with which it will start to drive."""
        return self._curve.heading(self._start_distance_m + self._drive(time_s))
