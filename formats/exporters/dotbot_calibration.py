"""Calibrations of DotBots (``calibration.out``), with which the robots locate themselves.

A DotBot computes an image point from the two counts of a station and maps it to millimetres on the
floor by a homography. The file holds one homography for each station, in the order of the channels
from channel 1::

    u8 number of homographies, then for each nine int32 (little endian), row by row

``dotbot-calibration`` writes it, swarmit and PyDotBot send it to the robots. Sources:
github.com/DotBots/dotbot-lh2-calibration ``lighthouse2.py``, DotBot-libs ``bsp/nrf/lh2_default.c``
(``db_lh2_calculate_position``, ``db_lh2_store_homography``), both of 2026.

**Image point.** The firmware takes ideal planes, and its second coordinate lacks the factor
1/cos(azimuth) of a pinhole camera. No homography corrects that, nor the shape of real planes. The
homography is therefore fitted to the whole floor, for the counts that the calibrated station sends
there, and the remaining error is reported. (The direct linear transform is within 6 % of the least
squares of the error in millimetres.)

**Scale of the matrix.** A homography is defined up to a factor, which cancels in the firmware's
division. It is chosen so that the largest entry fills the int32. With the usual factor, for which
the last entry is 1, rounding to 0.001 costs up to 0.1 % of a coordinate.

**Floor.** x to the right and y downwards in a view from above, in millimetres: the reference points
of ``dotbot-calibration`` are top left, top right, bottom left and bottom right, with y increasing
downwards, and the robots steer in these axes (DotBot-libs ``drv/control_loop/control_loop.c``:
clockwise is positive). In the frame of a scene (z up), y is negated. Robots discard negative
coordinates, so that the origin is a corner of the floor.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import apply_homography, fit_homography
from locatk.core.lighthouse.calibration import predict_angles
from locatk.core.lighthouse.channels import TICKS_PER_COUNT, period_ticks
from locatk.core.lighthouse.light_planes import angles_to_counts
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.trajectory import Trajectory
from locatk.formats.exporters.crazyflie import LEVEL_FRAME_HINT, describe_frame_fault
from locatk.formats.output import atomic_write

Array = NDArray[np.float64]

MILLIMETRES_PER_METRE = 1000

INTEGER_SCALE = 1000
"""Integer of 1 in homographies whose last entry is 1."""

MAX_INTEGER = 2**31 - 1

FIRMWARE_PERIOD_TICKS = {14: 901_900}
"""Rotor periods in which the firmware differs from the stations."""

UNCERTAIN_CHANNELS = (4, 14)
"""Channels whose period is wrong in some versions of the firmware: 951,000 instead of 949,000 ticks
in 2025 (channel 4), and 901,900 instead of 901,000 (channel 14)."""

MARGIN_M = 0.05
"""Margin of the floor around poses and markers, the radius of a robot."""

CELL_M = 0.1
MIN_CELL_POSES = 3
"""Size of the cells of the floor, and number of poses in a cell on which robots drive. Fewer are
outliers, or of a robot that is carried: a driving one has about three (0.3 m/s, 10 Hz)."""

MIN_HOMOGRAPHY_POINTS = 4
"""Fewest points that determine a homography."""

MAX_FLOOR_RELIEF_M = 0.05
"""Largest difference of height of poses that are on one floor."""

ORIGIN_STEP_MM = 100
"""Coordinates of the origin are multiples of this."""

GRID_POINTS_PER_AXIS = 25
"""Points of the floor, along each axis, for which a homography is fitted."""

MIN_VISIBLE_FRACTION = 0.1
"""Smallest fraction of the floor that a station has to see."""

MAX_USEFUL_ERROR_MM = 50.0
"""Largest error (rms) with which a robot can drive: its radius."""

MAX_AZIMUTH_RAD = np.deg2rad(75.0)
MAX_ELEVATION_RAD = np.deg2rad(55.0)
"""Field of view of a station, 150 by 110 degrees (Valve, SteamVR Base Station 2.0)."""

UNKNOWN_STATION = np.array([[0, 0, -1], [0, 0, -1], [0, 0, 1]]) * INTEGER_SCALE
"""Homography of channels without a station. It maps to (-1, -1), which robots discard. They would
divide zero by zero with a matrix of zeros, and report a position at the origin."""


@dataclass(frozen=True)
class FloorHomography:
    """Homography of one station, and its error.

    Attributes
    ----------
    channel : int
    matrix : (3, 3) int64 ndarray
        From the firmware's image points to millimetres in the robots' frame, as in the file.
    visible_fraction : float
        Part of the floor that the station sees.
    rms_mm, max_mm : float
        Error of the positions on that part that the firmware computes with the matrix.
    """

    channel: int
    matrix: NDArray[np.int64]
    visible_fraction: float
    rms_mm: float
    max_mm: float


@dataclass(frozen=True)
class DotBotCalibration:
    """Homographies of all stations that see the floor.

    Attributes
    ----------
    stations : tuple of FloorHomography
        Ascending in channel.
    area_mm : (4,) ndarray
        Smallest x and y and largest x and y of the floor, in the frame of the scene.
    origin_mm : (2,) ndarray
        Origin of the robots in the frame of the scene. A robot at (x, y) there reports
        (x - origin x, origin y - y).
    hidden_channels : tuple of int
        Stations that see too little of the floor.
    """

    stations: tuple[FloorHomography, ...]
    area_mm: Array
    origin_mm: Array
    hidden_channels: tuple[int, ...]


def build_calibration(
    scene: Scene,
    trajectories: Sequence[Trajectory] = (),
    *,
    area_mm: Sequence[float] | None = None,
) -> DotBotCalibration:
    """Fit the homographies of all stations of a scene.

    Parameters
    ----------
    scene : Scene
    trajectories : sequence of Trajectory
        Those in the frame of the scene extend the floor.
    area_mm : sequence of float, optional
        Floor in the frame of the scene, as :attr:`DotBotCalibration.area_mm`; its corner (smallest
        x, largest y) is the origin. [default: around poses and markers]

    Raises
    ------
    InputError
        The scene has no stations or no scale, is not level, its floor is unknown, or no station
        sees the floor.
    """
    if not scene.stations:
        raise InputError(
            "the scene has no stations to export", hint="Solve a session first (locatk solve)"
        )
    if scene.scale == "unit":
        raise InputError(
            "the scene has no scale: DotBots need millimetres",
            hint="Give markers or a distance to locatk solve",
        )
    if fault := describe_frame_fault(scene):
        raise InputError(fault, hint=LEVEL_FRAME_HINT)
    positions = [t.position for t in trajectories if t.frame == scene.frame]
    points = _collect_floor_points(positions, [marker.position for marker in scene.markers])
    floor_z = scene.floor_z if scene.planar else _estimate_floor_height(points)
    if area_mm is not None:
        area = np.array(area_mm, float)
        origin = area[[0, 3]]
    else:
        area = _bound_area(points)
        origin = _choose_origin(area)
    x, y = (
        np.linspace(area[k], area[k + 2], GRID_POINTS_PER_AXIS) / MILLIMETRES_PER_METRE
        for k in (0, 1)
    )
    floor = np.stack([*map(np.ravel, np.meshgrid(x, y)), np.full(x.size * y.size, floor_z)], axis=1)
    if area_mm is None:
        floor = floor[_is_near_hull(floor[:, :2], points[:, :2])]
    fitted = {s.channel: _fit_station(s, floor, origin) for s in scene.stations}
    stations = tuple(fit for _, fit in sorted(fitted.items()) if fit is not None)
    if not stations:
        raise InputError(
            "no station sees the floor on which the robots drive",
            hint="Check the frame of the scene, or give the floor by --area",
        )
    hidden = tuple(channel for channel, fit in sorted(fitted.items()) if fit is None)
    return DotBotCalibration(stations, area, origin, hidden)


def dumps_calibration(calibration: DotBotCalibration) -> bytes:
    """Return the content of ``calibration.out``."""
    by_channel = {station.channel: station.matrix for station in calibration.stations}
    number = max(by_channel)
    matrices = [by_channel.get(channel, UNKNOWN_STATION) for channel in range(1, number + 1)]
    return struct.pack("<B", number) + np.stack(matrices).astype("<i4").tobytes()


def write_calibration(
    path: str | os.PathLike[str], calibration: DotBotCalibration, *, overwrite: bool = False
) -> None:
    """Write ``calibration.out``.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(dumps_calibration(calibration))


# ---- the floor


def _collect_floor_points(trajectories: Sequence[Array], markers: Sequence[Array]) -> Array:
    """Return the markers and the poses (n, 3) on which robots drive, in metres."""
    poses = np.concatenate([np.zeros((0, 3)), *trajectories])
    poses = poses[np.isfinite(poses).all(axis=1)]
    if len(poses):
        _, cell, number = np.unique(
            np.floor(poses[:, :2] / CELL_M), axis=0, return_inverse=True, return_counts=True
        )
        is_driven = number[cell.ravel()] >= MIN_CELL_POSES
        if is_driven.mean() > 0.5:
            poses = poses[is_driven]
    return np.concatenate([poses, np.reshape(np.array(markers, float), (-1, 3))])


def _estimate_floor_height(points: Array) -> float:
    """Return the common height of the points in a scene that is not planar."""
    if not len(points):
        raise InputError(
            "the height of the floor is unknown: the scene is not planar",
            hint="Set planar = true and floor_z_mm in the scene, or give a solution with poses",
        )
    relief = float(np.ptp(points[:, 2]))
    if relief > MAX_FLOOR_RELIEF_M:
        raise InputError(
            f"the poses and markers are not on one floor: they differ in height by "
            f"{MILLIMETRES_PER_METRE * relief:.0f} mm",
            hint="DotBots locate themselves on a floor only",
        )
    return float(np.mean(points[:, 2]))


def _bound_area(points: Array) -> Array:
    """Return the area (4,) in millimetres of points (n, 3) with a margin."""
    if not len(points):
        raise InputError(
            "the floor on which the robots drive is unknown: no poses and no markers",
            hint="Give a solution of `locatk solve`, or the floor by --area",
        )
    low, high = points[:, :2].min(axis=0) - MARGIN_M, points[:, :2].max(axis=0) + MARGIN_M
    return np.concatenate([low, high]) * MILLIMETRES_PER_METRE


def _is_near_hull(floor: Array, points: Array) -> NDArray[np.bool_]:
    """Return whether floor points (n, 2) are in the convex hull of points, or near it."""
    import cv2

    hull = cv2.convexHull(points.astype(np.float32))
    distance = [cv2.pointPolygonTest(hull, point, True) for point in floor.tolist()]
    return np.array(distance) > -MARGIN_M


def _choose_origin(area_mm: Array) -> Array:
    """Return an origin (2,) from which the area has positive coordinates.

    Along each axis it is that of the scene if possible, and otherwise the border of the area,
    rounded outwards.
    """
    return np.array(
        [
            min(0.0, np.floor(area_mm[0] / ORIGIN_STEP_MM) * ORIGIN_STEP_MM),
            max(0.0, np.ceil(area_mm[3] / ORIGIN_STEP_MM) * ORIGIN_STEP_MM),
        ]
    )


# ---- homographies


def firmware_image_points(counts: Array, channel: int) -> Array:
    """Return the image points that a DotBot computes from counts.

    Parameters
    ----------
    counts : (n, 2) ndarray
        LFSR indices of the first and second sweep.
    channel : int

    Returns
    -------
    (n, 2) ndarray
    """
    ticks = FIRMWARE_PERIOD_TICKS.get(channel, int(period_ticks(channel)))
    first, second = (2 * np.pi * TICKS_PER_COUNT / ticks * counts).T
    return np.stack(
        [
            -np.tan((first + second) / 2),
            -np.sin((second - first) / 2 - np.pi / 3) / np.tan(np.pi / 6),
        ],
        axis=1,
    )


def _fit_station(station: Station, floor_m: Array, origin_mm: Array) -> FloorHomography | None:
    """Fit the homography of a station on points (n, 3) of the floor; None if it sees too few."""
    local = (floor_m - station.position) @ station.rotation
    is_visible = np.abs(np.arctan2(local[:, 1], local[:, 0])) < MAX_AZIMUTH_RAD
    is_visible &= np.abs(np.arctan2(local[:, 2], np.hypot(*local[:, :2].T))) < MAX_ELEVATION_RAD
    fraction = float(np.mean(is_visible))
    if fraction < MIN_VISIBLE_FRACTION or np.count_nonzero(is_visible) < MIN_HOMOGRAPHY_POINTS:
        return None
    floor_m, local = floor_m[is_visible], local[is_visible]
    if station.floor_map is not None:
        # The rays of a single station are those that its own homography gives.
        local = np.c_[np.ones(len(floor_m)), floor_m[:, :2]] @ np.linalg.inv(station.floor_map).T
        local /= local[:, :1]
    counts = angles_to_counts(predict_angles(local, station.calibration), station.channel)
    image = firmware_image_points(counts, station.channel)
    target_mm = (MILLIMETRES_PER_METRE * floor_m[:, :2] - origin_mm) * np.array([1.0, -1.0])
    homography = fit_homography(image, target_mm)
    matrix = np.rint(homography * (MAX_INTEGER / np.abs(homography).max())).astype(np.int64)
    error_mm = np.linalg.norm(apply_homography(matrix, image) - target_mm, axis=1)
    rms_mm = float(np.sqrt(np.mean(error_mm**2)))
    return FloorHomography(station.channel, matrix, fraction, rms_mm, float(error_mm.max()))
