"""A differential drive that makes one leg after the other: where it is at any time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What the drive can do.

    Attributes
    ----------
    speed_mps, acceleration_mps2 : float
        On straights and arcs.
    turn_rps, turn_rps2 : float
        Rate and acceleration of turns in radians; the rate bounds arcs as well.
    """

    speed_mps: float = 0.1
    acceleration_mps2: float = 0.3
    turn_rps: float = math.radians(90)
    turn_rps2: float = math.radians(360)


@dataclass(frozen=True)
class Leg:
    """Arcs of constant curvature that are driven in one go, from rest to rest.

    Attributes
    ----------
    start_s, duration_s : float
    poses : (k, 3) ndarray
        Where each arc starts.
    arcs : (k, 2) ndarray
        Way (negative backwards) and turn of each.
    measure : (k + 1,) ndarray
        Cumulated size of the arcs, in metres, or in radians for a turn on the spot.
    rate, gain : float
        Greatest speed and acceleration, in the same unit.
    """

    start_s: float
    duration_s: float
    poses: Array
    arcs: Array
    measure: Array
    rate: float
    gain: float

    def at(self, time_s: Array) -> Array:
        """Poses (n, 3) at times (n,) of this leg."""
        done = self._progress(time_s - self.start_s)
        if not self.measure[-1] > 0:
            return np.repeat(self.poses[:1], len(time_s), axis=0)
        which = np.clip(np.searchsorted(self.measure, done, "right") - 1, 0, len(self.arcs) - 1)
        size = np.diff(self.measure)[which]
        share = np.clip((done - self.measure[which]) / size, 0.0, 1.0)
        return along(self.poses[which], share[:, None] * self.arcs[which])

    def _progress(self, since_s: Array) -> Array:
        """How much of the measure is done: speed up, go, slow down."""
        total = self.measure[-1]
        ramp_s = min(self.rate / self.gain, math.sqrt(total / self.gain))
        top = self.gain * ramp_s
        up = np.clip(since_s, 0.0, ramp_s)
        left = np.clip(self.duration_s - since_s, 0.0, ramp_s)
        level = np.clip(since_s - ramp_s, 0.0, self.duration_s - 2 * ramp_s)
        slow = self.gain * (ramp_s**2 - left**2) / 2
        return np.asarray(self.gain * up**2 / 2 + top * level + slow)


def along(poses: ArrayLike, arcs: ArrayLike) -> Array:
    """Poses (..., 3) at the end of arcs (..., 2) of way and turn from others (..., 3)."""
    pose, arc = np.asarray(poses, float), np.asarray(arcs, float)
    way, turn = arc[..., 0], arc[..., 1]
    chord = way * np.sinc(turn / 2 / np.pi)
    middle = pose[..., 2] + turn / 2
    step = np.stack([chord * np.cos(middle), chord * np.sin(middle), turn], axis=-1)
    return np.asarray(pose + step)


@dataclass
class Robot:
    """Where a robot has gone; each method lets it go on from there.

    Attributes
    ----------
    pose : (3,) ndarray
        x, y and heading at the end; the heading grows over a whole turn.
    limits : Limits
    time_s : float
        At the end.
    legs : list of Leg
    """

    pose: Array
    limits: Limits = field(default_factory=Limits)
    time_s: float = 0.0
    legs: list[Leg] = field(default_factory=list)

    def drive(self, arcs: Sequence[tuple[float, float]]) -> None:
        """Go along arcs of way and turn, none of them a turn on the spot."""
        moves = np.array([arc for arc in arcs if abs(arc[0]) > 1e-9]).reshape(-1, 2)
        if not len(moves):
            return
        bends = np.abs(moves[:, 1]) / np.abs(moves[:, 0])
        rate = self.limits.speed_mps
        if bends.max() > 0:
            rate = min(rate, self.limits.turn_rps / float(bends.max()))
        self._go(moves, np.abs(moves[:, 0]), rate, self.limits.acceleration_mps2)

    def straight(self, way_m: float) -> None:
        """Go ahead, or back where ``way_m`` is negative."""
        self.drive([(way_m, 0.0)])

    def turn(self, turn_rad: float) -> None:
        """Turn on the spot, counter-clockwise positive."""
        if abs(turn_rad) > 1e-9:
            size = np.array([abs(turn_rad)])
            limits = self.limits
            self._go(np.array([[0.0, turn_rad]]), size, limits.turn_rps, limits.turn_rps2)

    def stand(self, seconds: float) -> None:
        """Stay."""
        if seconds > 0:
            still = Leg(self.time_s, seconds, self.pose[None], np.zeros((1, 2)), np.zeros(2), 1, 1)
            self.legs.append(still)
            self.time_s += seconds

    def face(self, heading_rad: float) -> None:
        """Turn to a heading on the shorter way."""
        self.turn(math.remainder(heading_rad - self.pose[2], 2 * math.pi))

    def go(self, place: Sequence[float] | Array, *, back_m: float = 0.0) -> None:
        """Turn to a place and go there straight; backwards where that is less of a turn
        and no farther than ``back_m``."""
        dx, dy = float(place[0] - self.pose[0]), float(place[1] - self.pose[1])
        away = math.hypot(dx, dy)
        if away < 1e-6:
            return
        heading = math.atan2(dy, dx)
        behind = math.cos(heading - self.pose[2]) < 0 and away <= back_m
        self.face(heading + math.pi if behind else heading)
        self.straight(-away if behind else away)

    def land(self, place: Sequence[float] | Array) -> None:
        """Go to a place ahead on a landing curve, and arrive with the heading of now.

        Two equal arcs, one to each side (section 4.1 of the paper): each has half of the
        chord, and the chord of an arc is off its tangent by half of its turn. Where the
        place is not well ahead, the robot turns to it instead.
        """
        dx, dy = float(place[0] - self.pose[0]), float(place[1] - self.pose[1])
        off = math.remainder(math.atan2(dy, dx) - self.pose[2], 2 * math.pi)
        if abs(off) > math.radians(30):
            self.go(place)
            return
        half = math.hypot(dx, dy) / 2 / float(np.sinc(off / math.pi))
        self.drive([(half, 2 * off), (half, -2 * off)])

    def _go(self, arcs: Array, size: Array, rate: float, gain: float) -> None:
        poses = [self.pose]
        for arc in arcs:
            poses.append(along(poses[-1], arc))
        measure = np.r_[0.0, np.cumsum(size)]
        total = float(measure[-1])
        ramp_s = min(rate / gain, math.sqrt(total / gain))
        duration = 2 * ramp_s + max(total - gain * ramp_s**2, 0.0) / (gain * ramp_s)
        self.legs.append(
            Leg(self.time_s, duration, np.array(poses[:-1]), arcs, measure, rate, gain)
        )
        self.pose = poses[-1]
        self.time_s += duration

    def at(self, time_s: Array) -> Array:
        """Poses (n, 3) at ascending times (n,); before and after all legs it stands."""
        if not self.legs:
            return np.repeat(self.pose[None], len(time_s), axis=0)
        edges = np.searchsorted(time_s, [leg.start_s for leg in self.legs[1:]])
        parts = np.split(time_s, edges)
        return np.concatenate([leg.at(part) for leg, part in zip(self.legs, parts, strict=True)])
