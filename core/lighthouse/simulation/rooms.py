"""Simulated rooms: stations that were mounted beside their designed poses, robots that drive around
obstacles, and light that walls, obstacles and other robots stop.

Nothing here is shared with the predictions of a design: light is followed from the station to the
photodiode at the time of each sweep, among robots where they are at that time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import rotation_exp, wrap_angle
from locatk.core.lighthouse.room import (
    MOUNTING_POSITION_SIGMA_M,
    MOUNTING_ROTATION_SIGMA_RAD,
    Room,
)
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.simulation.paths import (
    REST_DURATION_S,
    MarkerTour,
    RobotPath,
    StopAndGo,
    UprightPath,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RECEPTION_RANGE_M = 7.0
"""Distance up to which a station is received [m], as its manufacturer states (HTC, SteamVR Base
Station 2.0)."""

WALL_CLEARANCE_M = 0.1
"""Distance that robots of unknown size keep from walls and obstacles [m]."""

AT_STATION_M = 0.15
"""Distance from a station within which a wall does not stop its light [m]: the station is mounted
on it, and a mounting error may put it behind the plane of the wall."""

MIN_LEG_S = 1.0
"""Shortest duration of a leg between two rests [s]."""

MAX_TRIES = 400
"""Random points among which a free one is looked for."""


def mounted_stations(rng: np.random.Generator, scene: Scene) -> list[Station]:
    """Return the true stations of a scene: those of a design are beside their designed poses."""
    stations = []
    for designed in sorted(scene.stations, key=lambda s: s.channel):
        # The same number of random numbers for each station, so that others stay as they are.
        error = rng.normal(size=6)
        if scene.frame_source != "design":
            stations.append(designed)
            continue
        if designed.covariance is None:
            error *= np.repeat([MOUNTING_POSITION_SIGMA_M, MOUNTING_ROTATION_SIGMA_RAD], 3)
        else:
            values, vectors = np.linalg.eigh(designed.covariance)
            error = vectors @ (np.sqrt(np.maximum(values, 0.0)) * error)
        stations.append(
            Station(
                designed.channel,
                designed.position + error[:3],
                rotation_exp(error[3:]) @ designed.rotation,
                designed.calibration,
                designed.id,
            )
        )
    return stations


# ---- robots


class RoomPath(UprightPath):
    """Path of a robot in straight legs between random points of a room, with rests in between.

    See :class:`~locatk.core.lighthouse.simulation.paths.RobotPath`. It begins with a tour of the
    markers.

    Parameters
    ----------
    rng : Generator
    room : Room
    duration_s, top_speed_mps : float
    markers : (k, 3) ndarray
        Positions of the markers in metres; k may be 0.

    Raises
    ------
    InputError
        There is no free place for a robot.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        room: Room,
        duration_s: float,
        top_speed_mps: float,
        markers: Array,
    ) -> None:
        floor = _FreeFloor(room)
        points = [floor.draw(rng)]
        self.tour = MarkerTour(duration_s, markers, points[0])
        leg_s: list[float] = []
        rest_s: list[float] = []
        while self.tour.end_s + sum(leg_s) + sum(rest_s) < duration_s:
            points.append(floor.draw(rng, points[-1]))
            length_m = float(np.linalg.norm(points[-1] - points[-2]))
            leg_s.append(max(MIN_LEG_S, StopAndGo.PEAK_SPEED_RATIO * length_m / top_speed_mps))
            rest_s.append(float(rng.uniform(*REST_DURATION_S)))
        self.points = np.stack(points)
        ends_s = self.tour.end_s + np.cumsum(np.array(leg_s) + np.array(rest_s))
        legs, rests = np.array(leg_s), np.array(rest_s)
        self._drive = StopAndGo(ends_s - legs - rests, legs, np.ones(len(legs)))
        along = np.diff(self.points, axis=0)
        heading = np.arctan2(along[:, 1], along[:, 0])
        turns = np.append(wrap_angle(np.diff(heading)), 0.0)
        self._first_heading = float(heading[0])
        self._turn = StopAndGo(ends_s - rests, rests, turns)

    def position(self, time_s: Array) -> Array:
        """Return positions (..., 3) in metres at times (...)."""
        leg = self._drive(np.asarray(time_s))
        number = np.arange(len(self.points))
        position = np.stack([np.interp(leg, number, self.points[:, i]) for i in range(3)], axis=-1)
        self.tour.place(position, np.asarray(time_s))
        return position

    def heading(self, time_s: Array) -> Array:
        """Return headings (...) in radians."""
        return np.asarray(self._first_heading + self._turn(np.asarray(time_s)))


class _FreeFloor:
    """Places of a room that a robot can reach without touching a wall or an obstacle."""

    def __init__(self, room: Room) -> None:
        self._low, self._high = room.photodiode_z_m
        self._area = room.working_outline_m
        self._clearance_m = WALL_CLEARANCE_M if room.robots is None else room.robots.radius_m
        top = self._high if room.robots is None else max(self._high, room.robots.height_m)
        # Robots pass under obstacles that are above them.
        self._solids = [o.outline_m for o in room.obstacles if o.low_m < top + 1e-9]
        walls = [room.outline_m, *self._solids]
        self._starts = np.concatenate(walls)
        self._ends = np.concatenate([np.roll(wall, -1, axis=0) for wall in walls])

    def draw(self, rng: np.random.Generator, start: Array | None = None) -> Array:
        """Draw a free point (3,), to which a straight way leads from ``start``."""
        low, high = self._area.min(axis=0), self._area.max(axis=0)
        for _ in range(MAX_TRIES):
            point = np.append(rng.uniform(low, high), rng.uniform(self._low, self._high))
            if self._is_free(point[:2], point[:2] if start is None else start[:2]):
                return point
        if start is not None:
            return start  # Enclosed on all sides: it stays.
        raise InputError(
            "no free place for a robot in the working area",
            hint="Check the sizes of the robots and the obstacles, and their unit",
        )

    def _is_free(self, end: Array, start: Array) -> bool:
        if not is_inside_polygon(end[None], self._area)[0]:
            return False
        if any(is_inside_polygon(end[None], solid)[0] for solid in self._solids):
            return False
        edges = np.roll(self._area, -1, axis=0)
        if np.any(_distance_of_segments(start, end, self._area, edges) == 0.0):
            return False  # The way leaves a working area that is not convex.
        distance = _distance_of_segments(start, end, self._starts, self._ends)
        return bool(distance.min() > self._clearance_m)


def _distance_of_segments(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return the distances (n,) of one segment from others, from (n, 2) to (n, 2)."""
    distance = np.minimum.reduce(
        [
            _distance_to_segment(a[None], c, d),
            _distance_to_segment(b[None], c, d),
            _distance_to_segment(c, a[None], b[None]),
            _distance_to_segment(d, a[None], b[None]),
        ]
    )
    is_split = _side(a, b, c) * _side(a, b, d) < 0
    is_split &= _side(c, d, a) * _side(c, d, b) < 0
    return np.where(is_split, 0.0, distance)


def _side(a: Array, b: Array, point: Array) -> Array:
    """Return twice the signed area (n,) of triangles."""
    u, v = b - a, point - a
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _distance_to_segment(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    length2 = np.maximum(np.sum(along**2, axis=-1), 1e-30)
    fraction = np.clip(np.sum((points - start) * along, axis=-1) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - fraction[..., None] * along, axis=-1))


def is_inside_polygon(points: Array, corners: Array) -> Mask:
    """Return whether points (n, 2) are inside a polygon (k, 2), by the angle that it subtends."""
    towards = corners[None] - points[:, None]
    following = np.roll(towards, -1, axis=1)
    cross = towards[..., 0] * following[..., 1] - towards[..., 1] * following[..., 0]
    dot = np.sum(towards * following, axis=-1)
    return np.asarray(np.abs(np.sum(np.arctan2(cross, dot), axis=1)) > np.pi)


# ---- light


class RoomLight:
    """Light of stations that walls, obstacles and robots stop, or that is too far away.

    Parameters
    ----------
    room : Room
    paths : sequence of RobotPath
        Of all robots. They hide each other if the room states their size. Paths cross: a robot that
        would touch the one in question is ignored.
    """

    def __init__(self, room: Room, paths: Sequence[RobotPath]) -> None:
        self._room, self._paths = room, paths

    def blocked(self, robot: int, station: Array) -> Callable[[Array, Array], Mask]:
        """Return a function of photodiodes (..., 3) of a robot and times (...).

        It is True if they receive no light of a station at (3,) then.
        """

        def is_blocked(photodiodes: Array, time_s: Array) -> Mask:
            shape, points = photodiodes.shape[:-1], photodiodes.reshape(-1, 3)
            result = np.linalg.norm(points - station, axis=1) > RECEPTION_RANGE_M
            room = self._room
            result |= _crosses_wall(station, points, room.outline_m)
            for obstacle in room.obstacles:
                result |= _crosses_prism(
                    station, points, obstacle.outline_m, obstacle.low_m, obstacle.high_m
                )
            if room.robots is not None:
                size, time_s = room.robots, time_s.ravel()
                own = self._paths[robot].position(time_s)[:, :2]
                for other, path in enumerate(self._paths):
                    if other != robot:
                        axis = path.position(time_s)[:, :2]
                        is_apart = np.linalg.norm(axis - own, axis=1) > 2 * size.radius_m
                        result |= is_apart & _crosses_cylinder(
                            station, points, axis, size.radius_m, size.height_m
                        )
            return np.asarray(result.reshape(shape))

        return is_blocked


def _crossings(station: Array, points: Array, corners: Array) -> Array:
    """Return where the rays to points (n, 3) cross the edges (k) of an outline in plan.

    As fractions (n, k) of the way from the station; nan without a crossing.
    """
    along = points[:, None, :2] - station[:2]
    start = corners[None]
    edge = np.roll(corners, -1, axis=0)[None] - start
    offset = start - station[:2]
    denominator = along[..., 0] * edge[..., 1] - along[..., 1] * edge[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = (offset[..., 0] * edge[..., 1] - offset[..., 1] * edge[..., 0]) / denominator
        on_edge = (offset[..., 0] * along[..., 1] - offset[..., 1] * along[..., 0]) / denominator
    is_crossed = (on_edge >= 0) & (on_edge <= 1) & (fraction > 0) & (fraction < 1)
    return np.where(is_crossed, fraction, np.nan)


def _crosses_wall(station: Array, points: Array, outline: Array) -> Mask:
    """Return whether a wall is between a station and points, apart from that of the station."""
    length = np.linalg.norm(points[:, :2] - station[:2], axis=1)
    distance = _crossings(station, points, outline) * length[:, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.any(distance > AT_STATION_M, axis=1))


def _crosses_prism(
    station: Array, points: Array, corners: Array, low_m: float, high_m: float
) -> Mask:
    """Return whether rays enter a vertical prism, through a side or through a horizontal face."""
    along = points - station
    height = station[2] + _crossings(station, points, corners) * along[:, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        result = np.any((height > low_m) & (height < high_m), axis=1)
        for level in (low_m, high_m):
            fraction = (level - station[2]) / along[:, 2]
            hit = station[:2] + fraction[:, None] * along[:, :2]
            is_between = (fraction > 0) & (fraction < 1)
            result |= is_between & is_inside_polygon(np.nan_to_num(hit), corners)
    return np.asarray(result)


def _crosses_cylinder(
    station: Array, points: Array, axis: Array, radius_m: float, height_m: float
) -> Mask:
    """Return whether rays pass through cylinders on the floor, one at (n, 2) for each ray."""
    along = points - station
    offset = station[:2] - axis
    a = np.sum(along[:, :2] ** 2, axis=1)
    b = np.sum(offset * along[:, :2], axis=1)
    c = np.sum(offset**2, axis=1) - radius_m**2
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(b**2 - a * c)
        enter, leave = np.maximum((-b - root) / a, 0.0), np.minimum((-b + root) / a, 1.0)
        lowest = np.minimum(station[2] + enter * along[:, 2], station[2] + leave * along[:, 2])
        return np.asarray((enter < leave) & (lowest < height_m))
