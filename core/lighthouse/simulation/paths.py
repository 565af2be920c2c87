"""Where simulated robots are: smooth closed curves, driven in legs with rests.

All is in closed form, so that a simulator may ask for any time it likes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FLOOR_M = 1.8
"""Width of the square in which robots drive, in metres: a floor of 2 m less a margin."""

RAISED_M = (0.15, 0.25)
"""How far a robot that is moved through space goes up and down from 0.25 m, in metres."""

SPEED_MPS = (0.2, 0.3)
"""Top speed of a leg, in metres a second."""

LEG_S, REST_S = (5.0, 12.0), (0.5, 2.0)
STAND_S, CARRY_S = 2.0, 1.0
"""Time on each marker, and from there to the next one, in seconds."""


class Curve:
    """A closed curve without cusps, by its length.

    A circle in the complex plane with a few harmonics: as long as the speeds of the
    harmonics sum to less than that of the circle, the curve never stops.
    """

    ORDERS = np.array([1, -1, 2, -2, 3])
    HARMONICS = 0.6
    NODES = 4096

    def __init__(self, rng: np.random.Generator, planar: bool) -> None:
        share = rng.dirichlet(np.ones(len(self.ORDERS) - 1)) * self.HARMONICS
        phase = np.exp(2j * np.pi * rng.random(len(self.ORDERS)))
        self.weights = np.r_[1.0, share / np.abs(self.ORDERS[1:])] * phase
        self.middle = 0j
        self.up, self.swing = (0.0, 0.0) if planar else (0.25, rng.uniform(*RAISED_M))
        self.waves, self.lead = int(rng.integers(1, 4)), rng.uniform(0, 2 * np.pi)
        self.turn = rng.choice([-1, 1])
        node = self.turn * np.linspace(0.0, 2 * np.pi, self.NODES + 1)
        self._fit(self._places(node), FLOOR_M * rng.uniform(0.7, 1.0), rng.uniform(-1, 1, 2))
        step = np.linalg.norm(np.diff(self._places(node), axis=0), axis=1)
        self.node, self.way = node, np.r_[0.0, np.cumsum(step)]
        self.length = float(self.way[-1])

    def _fit(self, places: Array, width: float, shift: Array) -> None:
        """Give the curve its width, and a place on the floor: -1 to 1 from edge to edge."""
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        scale = width / np.max(high - low)
        free = (FLOOR_M - scale * (high - low)) / 2
        self.weights = self.weights * scale
        self.middle = complex(*(free * shift - scale * (low + high) / 2))

    def _places(self, u: Array) -> Array:
        flat = np.exp(1j * u[..., None] * self.ORDERS) @ self.weights + self.middle
        z = self.up + self.swing * np.sin(self.waves * u + self.lead)
        return np.stack([flat.real, flat.imag, z], axis=-1)

    def position(self, way: Array) -> Array:
        """Points (..., 3) in metres after ``way`` (...) metres along the curve."""
        return self._places(np.interp(np.mod(way, self.length), self.way, self.node))

    def heading(self, way: Array) -> Array:
        """Directions (...) of the curve in the xy plane, in radians."""
        u = np.interp(np.mod(way, self.length), self.way, self.node)
        along = np.exp(1j * u[..., None] * self.ORDERS) @ (1j * self.ORDERS * self.weights)
        return np.angle(self.turn * along)


class Legs:
    """A way in legs that start and end at rest: how far one is at a time."""

    TOP_SPEED = 15 / 8
    """Fastest speed of a leg, in units of its mean."""

    def __init__(self, start_s: Array, length_s: Array, advance: Array) -> None:
        self.start_s, self.length_s, self.advance = start_s, length_s, advance
        self.before = np.r_[0.0, np.cumsum(advance)[:-1]]

    def __call__(self, time_s: Array) -> Array:
        """What was advanced (...) until ``time_s`` (...)."""
        leg = np.maximum(np.searchsorted(self.start_s, time_s, side="right") - 1, 0)
        x = np.clip((time_s - self.start_s[leg]) / self.length_s[leg], 0.0, 1.0)
        # Speed and acceleration are zero at both ends.
        return self.before[leg] + self.advance[leg] * x**3 * (10.0 + x * (6.0 * x - 15.0))


class Course:
    """Where one robot is at any time.

    It is put on each marker in turn, then driven along a curve. In a session too short for
    that the markers are hurried through in its first half.

    Attributes
    ----------
    stands_s : (k, 2) ndarray
        From when to when it stands on each marker, in seconds.
    carried_s : (2 k,) ndarray
        Ascending starts and ends of the times in which it is carried on.
    """

    def __init__(
        self, rng: np.random.Generator, planar: bool, duration_s: float, markers: Array
    ) -> None:
        self.curve = Curve(rng, planar)
        self.first = rng.uniform(0.0, self.curve.length)
        k = len(markers)
        hurry = min(1.0, duration_s / 2 / (k * (STAND_S + CARRY_S))) if k else 1.0
        put_s = hurry * (STAND_S + CARRY_S) * np.arange(k, dtype=float)
        taken_s = put_s + hurry * STAND_S
        self.stands_s = np.stack([put_s, taken_s], axis=1)
        self.begin_s = hurry * (STAND_S + CARRY_S) * k
        self.carried_s = np.stack([taken_s, np.r_[put_s[1:], [self.begin_s][:k]]], axis=1).ravel()
        if k:
            self._tour = Legs(taken_s, np.full(k, hurry * CARRY_S), np.ones(k))
            self._stops = np.vstack([markers, self.curve.position(np.array(self.first))])

        count = int(duration_s / LEG_S[0]) + 1
        length_s, rest_s = rng.uniform(*LEG_S, count), rng.uniform(*REST_S, count)
        start_s = self.begin_s + np.r_[0.0, np.cumsum(length_s + rest_s)[:-1]]
        advance = rng.uniform(*SPEED_MPS, count) * length_s / Legs.TOP_SPEED
        self._drive = Legs(start_s, length_s, advance)

    def position(self, time_s: Array) -> Array:
        """Points (..., 3) in metres at ``time_s`` (...)."""
        place = self.curve.position(self.first + self._drive(time_s))
        early = time_s < self.begin_s
        if len(self.carried_s) and np.any(early):
            stop = self._tour(time_s[early])
            number = np.arange(len(self._stops))
            place[early] = np.stack(
                [np.interp(stop, number, self._stops[:, i]) for i in range(3)], axis=-1
            )
        return place

    def heading(self, time_s: Array) -> Array:
        """Headings (...) in radians; it is put on the markers as it will start to drive."""
        return self.curve.heading(self.first + self._drive(time_s))
