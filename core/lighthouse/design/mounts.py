"""Mounts of base stations in a room: positions on walls, the ceiling and tripods.

Candidates for stations are these positions, each with several directions of view. A station is then
moved in steps along its mount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.design.visibility import in_obstacle
from locatk.core.lighthouse.room import Room
from locatk.core.polygons import is_inside, signed_area

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

MOUNT_DEPTH_M = 0.1
"""Distance of a rotor from the wall or the ceiling [m]: half the housing and a short bracket."""

POSITION_DECIMALS = 2
"""Decimals to which positions are rounded, in metres; angles are rounded to degrees."""

WALL_POSITIONS = 44
"""Number of positions along the walls that are tried, at each height."""

CEILING_POSITIONS = 25
"""Number of positions under the ceiling that are tried."""

LOW_CLEARANCE_M = 0.5
"""Lowest mount above the highest photodiode [m], unless the room is lower: below it, robots and
people hide the stations."""

HEIGHT_FRACTIONS = (0.0, 0.5, 1.0)
"""Heights of stations on walls, between the lowest and the highest mount."""

MAX_TILT_RAD = float(np.radians(90.0))

CEILING, TRIPOD = -1, -2
"""Values of :attr:`StationPoses.wall` for stations that are not on a wall."""


@dataclass(frozen=True)
class StationPoses:
    """Poses of s stations, and how they are mounted.

    Attributes
    ----------
    position_m : (s, 3) ndarray
    yaw_rad, tilt_rad : (s,) ndarray
        Direction of view: its azimuth, and its angle above the horizon. There is no roll.
    wall : (s,) int ndarray
        Index of the edge of the outline, -1 for the ceiling and -2 for a tripod.
    """

    position_m: Array
    yaw_rad: Array
    tilt_rad: Array
    wall: IntArray

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.yaw_rad)

    @property
    def rotation(self) -> Array:
        """Rotations (s, 3, 3) from station to room."""
        return view_rotation(self.yaw_rad, self.tilt_rad)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the mounts of the stations, of :data:`~locatk.core.lighthouse.room.MOUNTS`."""
        names = {CEILING: "ceiling", TRIPOD: "tripod"}
        return tuple(names.get(wall, "wall") for wall in self.wall.tolist())

    def take(self, index: Sequence[int] | IntArray) -> StationPoses:
        """Return the stations with these indices."""
        rows = np.asarray(index, int)
        return StationPoses(
            self.position_m[rows], self.yaw_rad[rows], self.tilt_rad[rows], self.wall[rows]
        )

    def joined(self, other: StationPoses) -> StationPoses:
        """Return the stations of both."""
        return StationPoses(
            np.concatenate([self.position_m, other.position_m]),
            np.concatenate([self.yaw_rad, other.yaw_rad]),
            np.concatenate([self.tilt_rad, other.tilt_rad]),
            np.concatenate([self.wall, other.wall]),
        )

    def replaced(self, index: int, new: StationPoses) -> StationPoses:
        """Return the stations with the one of ``new`` in place of that with this index."""
        return self.joined(new).take([*range(index), len(self), *range(index + 1, len(self))])


def view_rotation(yaw_rad: Array, tilt_rad: Array) -> Array:
    """Return the rotations (..., 3, 3) of stations that look to azimuths and elevations (...)."""
    cy, sy, ct, st = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(tilt_rad), np.sin(tilt_rad)
    forward = np.stack([cy * ct, sy * ct, st], axis=-1)
    left = np.stack([-sy, cy, np.zeros_like(cy)], axis=-1)
    up = np.stack([-cy * st, -sy * st, ct], axis=-1)
    return np.stack([forward, left, up], axis=-1)


def candidates(room: Room, points_m: Array) -> StationPoses:
    """Return positions on the mounts of a room, each with several directions of view.

    Parameters
    ----------
    room : Room
    points_m : (p, 3) ndarray
        Points of the working volume: the stations look to their centre and to those of their parts.
    """
    position, wall = _mount_positions(room)
    targets = _targets(points_m)
    offset = targets[None] - position[:, None]
    across = np.hypot(offset[..., 0], offset[..., 1])
    # The azimuth of a view straight down is arbitrary.
    yaw = np.where(across > 1e-9, np.arctan2(offset[..., 1], offset[..., 0]), 0.0)
    tilt = np.clip(np.arctan2(offset[..., 2], across), -MAX_TILT_RAD, MAX_TILT_RAD)
    n = len(targets)
    poses = StationPoses(
        np.repeat(position, n, axis=0), yaw.ravel(), tilt.ravel(), np.repeat(wall, n)
    )
    down = np.flatnonzero(wall == CEILING)
    if not len(down):
        return poses
    turned = np.repeat(down, 2)
    extra = StationPoses(
        position[turned],
        np.tile([0.0, np.pi / 2], len(down)),
        np.full(len(turned), -MAX_TILT_RAD),
        wall[turned],
    )
    return poses.joined(extra)


def mount_heights(room: Room) -> tuple[float, float]:
    """Return the lowest and the highest height of a station on a wall."""
    high = room.height_m - min(MOUNT_DEPTH_M, 0.25 * room.height_m)
    low = max(room.photodiode_z_m[1] + LOW_CLEARANCE_M, 0.5 * room.height_m)
    return min(low, high), high


def _targets(points_m: Array) -> Array:
    """Return the centre of points, and the centres of their four quarters in plan."""
    centre = points_m.mean(axis=0)
    targets = [centre]
    for right in (False, True):
        for upper in (False, True):
            is_part = ((points_m[:, 0] > centre[0]) == right) & (
                (points_m[:, 1] > centre[1]) == upper
            )
            if np.any(is_part):
                targets.append(points_m[is_part].mean(axis=0))
    return np.array(targets)


def _mount_positions(room: Room) -> tuple[Array, IntArray]:
    """Return the positions (n, 3) of all mounts, and their kinds as in ``StationPoses.wall``."""
    mounts: list[tuple[int, Array]] = []
    if "wall" in room.mounts:
        mounts += enumerate(_wall_positions(room))
    if "ceiling" in room.mounts:
        mounts.append((CEILING, _ceiling_positions(room)))
    if "tripod" in room.mounts:
        mounts.append((TRIPOD, room.tripods_m))
    position = np.concatenate([each for _, each in mounts])
    wall = np.repeat([wall for wall, _ in mounts], [len(each) for _, each in mounts])
    is_free = _is_free(room, position)
    if not np.any(is_free):
        raise InputError(
            "no station can be mounted: all mounts are outside the room or in obstacles",
            hint="Check the outline, the obstacles and the positions of tripods",
        )
    return position[is_free], wall[is_free]


def _wall_positions(room: Room) -> list[Array]:
    """Return positions (n, 3) on each wall, at several heights."""
    low, high = mount_heights(room)
    heights = np.unique(np.round([low + f * (high - low) for f in HEIGHT_FRACTIONS], 6))
    walls = _walls(room)
    ends = np.cumsum([0.0, *(wall.length_m for wall in walls)])
    step = ends[-1] / WALL_POSITIONS
    positions = []
    for wall, is_multiple in zip(walls, np.diff(ends // step) > 0, strict=True):
        inset = wall.inset_m
        number = max(2, int(np.ceil((wall.length_m - 2 * inset) / step)) + 1)
        distance = np.linspace(inset, wall.length_m - inset, number)
        if wall.length_m < step:
            # Of the short walls of a rounded outline, those at multiples of the step.
            distance = np.full(int(is_multiple), 0.5 * wall.length_m)
        plan = np.repeat(wall.mounted(distance), len(heights), axis=0)
        positions.append(np.column_stack([plan, np.tile(heights, len(distance))]))
    return positions


def _ceiling_positions(room: Room) -> Array:
    """Return positions (n, 3) under the ceiling: the centres of equal cells."""
    low, high = room.outline_m.min(axis=0), room.outline_m.max(axis=0)
    step = np.sqrt(abs(signed_area(room.outline_m)) / CEILING_POSITIONS)
    cells = np.maximum(1, np.round((high - low) / step).astype(int))
    x, y = (low[k] + (np.arange(cells[k]) + 0.5) * (high[k] - low[k]) / cells[k] for k in (0, 1))
    z = mount_heights(room)[1]
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class _Wall:
    """Wall from ``start_m`` along a unit vector, with the room to its left, in plan.

    Stations are mounted at a distance ``depth_m`` from it.
    """

    start_m: Array
    along: Array
    length_m: float
    depth_m: float

    @property
    def inset_m(self) -> float:
        """Smallest distance of a station from the ends."""
        return min(MOUNT_DEPTH_M, 0.5 * self.length_m)

    def mounted(self, distance_m: Array) -> Array:
        """Return the positions (n, 2) of stations at distances (n,) from the start."""
        distance_m = np.clip(distance_m, self.inset_m, self.length_m - self.inset_m)
        inwards = np.array([-self.along[1], self.along[0]])
        return np.asarray(self.start_m + distance_m[:, None] * self.along + self.depth_m * inwards)


def _walls(room: Room) -> list[_Wall]:
    # Stations are nearer to the walls of very small rooms.
    depth_m = float(min(MOUNT_DEPTH_M, 0.05 * np.ptp(room.outline_m, axis=0).min()))
    edges = np.roll(room.outline_m, -1, axis=0) - room.outline_m
    lengths = np.hypot(*edges.T)
    return [
        _Wall(start, edge / length, float(length), depth_m)
        for start, edge, length in zip(room.outline_m, edges, lengths, strict=True)
    ]


def _is_free(room: Room, position_m: Array) -> BoolArray:
    """Return True (n,) for positions (n, 3) in the room and outside of obstacles."""
    return np.asarray(is_inside(room.outline_m, position_m[:, :2]) & ~in_obstacle(room, position_m))


def moves(room: Room, pose: StationPoses, length_m: float, angle_rad: float) -> StationPoses:
    """Return the poses one step from that of a station: along its mount, or turned.

    A station on a wall moves along it and in height, one under the ceiling in both horizontal
    directions; one on a tripod turns only.
    """
    return _shifted(room, pose, length_m).joined(_turned(pose, angle_rad))


def _shifted(room: Room, pose: StationPoses, length_m: float) -> StationPoses:
    kind = int(pose.wall[0])
    x, y, z = np.eye(3)
    if kind == TRIPOD:
        position = np.zeros((0, 3))
    elif kind == CEILING:
        position = pose.position_m + length_m * np.array([x, -x, y, -y])
    else:
        wall = _walls(room)[kind]
        along = np.append(wall.along, 0.0)
        position = pose.position_m + length_m * np.array([along, -along, z, -z])
        position[:, :2] = wall.mounted((position[:, :2] - wall.start_m) @ wall.along)
        position[:, 2] = np.clip(position[:, 2], *mount_heights(room))
    position = position[_is_free(room, position)]
    return replace(pose.take(np.zeros(len(position), int)), position_m=position)


def _turned(pose: StationPoses, angle_rad: float) -> StationPoses:
    yaw, tilt = angle_rad * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    return replace(
        pose.take(np.zeros(4, int)),
        yaw_rad=pose.yaw_rad + yaw,
        tilt_rad=np.clip(pose.tilt_rad + tilt, -MAX_TILT_RAD, MAX_TILT_RAD),
    )


def rounded(poses: StationPoses) -> StationPoses:
    """Return poses in centimetres and degrees, which can be measured by hand."""
    return replace(
        poses,
        position_m=np.round(poses.position_m, POSITION_DECIMALS),
        yaw_rad=np.radians(np.round(np.degrees(poses.yaw_rad))),
        tilt_rad=np.radians(np.round(np.degrees(poses.tilt_rad))),
    )


def ordered(room: Room, poses: StationPoses) -> StationPoses:
    """Return stations counter-clockwise around the room, so that channels are easy to find."""
    centre = 0.5 * (room.outline_m.min(axis=0) + room.outline_m.max(axis=0))
    offset = poses.position_m[:, :2] - centre
    # From the corner at the smallest x and y on, as the outline of a rectangle.
    angle = (np.arctan2(offset[:, 1], offset[:, 0]) + 0.75 * np.pi + 1e-3) % (2 * np.pi)
    return poses.take(np.argsort(angle, kind="stable"))
