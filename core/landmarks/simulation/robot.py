"""Kinematics of a differential drive: one leg after the other, and the pose at any time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MIN_PATH_M = 1e-9
"""A shorter arc is no motion."""

MIN_ROTATION_RAD = 1e-9
"""A smaller rotation on the spot is no motion."""

MIN_TARGET_DISTANCE_M = 1e-6
"""A target closer than this is reached already."""

MAX_LANDING_ANGLE_RAD = math.radians(30)
"""Largest angle between the heading and the direction of a target that is reached on a landing
curve; beyond it the robot rotates first."""


@dataclass(frozen=True)
class RobotLimits:
    """Speeds and accelerations of the drive.

    Attributes
    ----------
    speed_mps, acceleration_mps2 : float
        On straight lines and arcs.
    turn_rps, turn_rps2 : float
        Rate [rad/s] and acceleration [rad/s^2] of rotations; the rate limits arcs as well.
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
        Pose at the start of each arc.
    arcs : (k, 2) ndarray
        Path length (negative backwards) and rotation of each.
    progress : (k + 1,) ndarray
        Cumulated size of the arcs: metres, or radians for a rotation on the spot.
    speed, acceleration : float
        Limits in the same unit.
    """

    start_s: float
    duration_s: float
    poses: Array
    arcs: Array
    progress: Array
    speed: float
    acceleration: float

    def poses_at(self, time_s: Array) -> Array:
        """Return the poses (n, 3) at times (n,) of this leg."""
        done = self._progress_at(time_s - self.start_s)
        if not self.progress[-1] > 0:
            return np.repeat(self.poses[:1], len(time_s), axis=0)
        arc = np.clip(np.searchsorted(self.progress, done, "right") - 1, 0, len(self.arcs) - 1)
        size = np.diff(self.progress)[arc]
        fraction = np.clip((done - self.progress[arc]) / size, 0.0, 1.0)
        return follow_arcs(self.poses[arc], fraction[:, None] * self.arcs[arc])

    def _progress_at(self, elapsed_s: Array) -> Array:
        """Return the progress at times since the start: accelerate, cruise, brake."""
        total = self.progress[-1]
        ramp_s = min(self.speed / self.acceleration, math.sqrt(total / self.acceleration))
        top_speed = self.acceleration * ramp_s
        ramp_up = np.clip(elapsed_s, 0.0, ramp_s)
        remaining = np.clip(self.duration_s - elapsed_s, 0.0, ramp_s)
        cruise = np.clip(elapsed_s - ramp_s, 0.0, self.duration_s - 2 * ramp_s)
        braking = self.acceleration * (ramp_s**2 - remaining**2) / 2
        return np.asarray(self.acceleration * ramp_up**2 / 2 + top_speed * cruise + braking)


def follow_arcs(poses: ArrayLike, arcs: ArrayLike) -> Array:
    """Return the poses (..., 3) at the end of arcs (..., 2) that start at poses (..., 3).

    An arc is its path length and its rotation.
    """
    pose, arc = np.asarray(poses, float), np.asarray(arcs, float)
    path, rotation = arc[..., 0], arc[..., 1]
    chord = path * np.sinc(rotation / 2 / np.pi)
    middle = pose[..., 2] + rotation / 2
    step = np.stack([chord * np.cos(middle), chord * np.sin(middle), rotation], axis=-1)
    return np.asarray(pose + step)


@dataclass
class Robot:
    """Path of a robot; each method appends a leg.

    Attributes
    ----------
    pose : (3,) ndarray
        x, y and heading at the end; the heading has no jumps.
    limits : RobotLimits
    time_s : float
        At the end.
    legs : list of Leg
    """

    pose: Array
    limits: RobotLimits = field(default_factory=RobotLimits)
    time_s: float = 0.0
    legs: list[Leg] = field(default_factory=list)

    def drive(self, arcs: Sequence[tuple[float, float]]) -> None:
        """Drive arcs of path length and rotation; none is a rotation on the spot."""
        moves = np.array([arc for arc in arcs if abs(arc[0]) > MIN_PATH_M]).reshape(-1, 2)
        if not len(moves):
            return
        curvatures = np.abs(moves[:, 1]) / np.abs(moves[:, 0])
        speed = self.limits.speed_mps
        if curvatures.max() > 0:
            speed = min(speed, self.limits.turn_rps / float(curvatures.max()))
        self._append(moves, np.abs(moves[:, 0]), speed, self.limits.acceleration_mps2)

    def straight(self, path_m: float) -> None:
        """Drive straight ahead, or backwards if ``path_m`` is negative."""
        self.drive([(path_m, 0.0)])

    def rotate(self, rotation_rad: float) -> None:
        """Rotate on the spot, counter-clockwise positive."""
        if abs(rotation_rad) > MIN_ROTATION_RAD:
            size = np.array([abs(rotation_rad)])
            limits = self.limits
            self._append(np.array([[0.0, rotation_rad]]), size, limits.turn_rps, limits.turn_rps2)

    def wait(self, seconds: float) -> None:
        """Stay at rest."""
        if seconds > 0:
            rest = Leg(self.time_s, seconds, self.pose[None], np.zeros((1, 2)), np.zeros(2), 1, 1)
            self.legs.append(rest)
            self.time_s += seconds

    def face(self, heading_rad: float) -> None:
        """Rotate to a heading by the smaller angle."""
        self.rotate(math.remainder(heading_rad - self.pose[2], 2 * math.pi))

    def drive_to(self, position: Sequence[float] | Array, *, back_m: float = 0.0) -> None:
        """Rotate towards a position and drive there on a straight line.

        Drive backwards if that needs the smaller rotation and no more than ``back_m``.
        """
        dx, dy = float(position[0] - self.pose[0]), float(position[1] - self.pose[1])
        distance = math.hypot(dx, dy)
        if distance < MIN_TARGET_DISTANCE_M:
            return
        heading = math.atan2(dy, dx)
        behind = math.cos(heading - self.pose[2]) < 0 and distance <= back_m
        self.face(heading + math.pi if behind else heading)
        self.straight(-distance if behind else distance)

    def land_at(self, position: Sequence[float] | Array) -> None:
        """Drive to a position ahead on a landing curve, and arrive with the present heading.

        Two equal arcs, one to each side (section 4.1 of the paper): each has half of the chord,
        and the chord of an arc deviates from its tangent by half of its rotation. If the position
        is not ahead, rotate towards it instead.
        """
        dx, dy = float(position[0] - self.pose[0]), float(position[1] - self.pose[1])
        angle = math.remainder(math.atan2(dy, dx) - self.pose[2], 2 * math.pi)
        if abs(angle) > MAX_LANDING_ANGLE_RAD:
            self.drive_to(position)
            return
        half = math.hypot(dx, dy) / 2 / float(np.sinc(angle / math.pi))
        self.drive([(half, 2 * angle), (half, -2 * angle)])

    def poses_at(self, time_s: Array) -> Array:
        """Return the poses (n, 3) at ascending times (n,); before and after all legs it rests."""
        if not self.legs or not len(time_s):
            return np.repeat(self.pose[None], len(time_s), axis=0)
        starts = np.searchsorted(time_s, [leg.start_s for leg in self.legs[1:]])
        parts = np.split(time_s, starts)
        return np.concatenate(
            [leg.poses_at(part) for leg, part in zip(self.legs, parts, strict=True) if len(part)]
        )

    def _append(self, arcs: Array, size: Array, speed: float, acceleration: float) -> None:
        """Append a leg of arcs with sizes (k,) in metres or radians."""
        poses = [self.pose]
        for arc in arcs:
            poses.append(follow_arcs(poses[-1], arc))
        progress = np.r_[0.0, np.cumsum(size)]
        total = float(progress[-1])
        ramp_s = min(speed / acceleration, math.sqrt(total / acceleration))
        duration = 2 * ramp_s + max(total - acceleration * ramp_s**2, 0.0) / (acceleration * ramp_s)
        self.legs.append(
            Leg(self.time_s, duration, np.array(poses[:-1]), arcs, progress, speed, acceleration)
        )
        self.pose = poses[-1]
        self.time_s += duration
