"""Frame of a scene from points on the floor: an origin, a point on the x axis, and further points.

The plane z = 0 is fitted to the heights of the points and to the vertical that the accelerometers
of the stations report; each counts by its standard deviation. Points a metre apart level a floor
to 0.2 degrees, accelerometers to 1 or 2 degrees, so that gravity matters if the points are on one
line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.scene.gravity import UpEstimate
from locatk.core.lighthouse.scene.reframing import rotation_between

Array = NDArray[np.float64]

FLOOR_SIGMA_M = 0.003
"""Standard deviation of the height of a device on a floor [m]. DIN 18202 (table 3, line 3) allows
finished floors 4 mm over 1 m and 10 mm over 4 m."""

PLACEMENT_SIGMA_M = 0.005
"""Standard deviation of the position of a device that a person sets on a mark [m]."""

MAX_LEVEL_SIGMA_RAD = float(np.deg2rad(5.0))
"""Largest standard deviation of the inclination of a floor that is accepted: points that are almost
on one line do not determine it."""

MIN_AXIS_LENGTH_M = 0.1
"""Smallest distance of the point on the x axis from the origin [m]: with a placement by hand, the
axis is then known to 4 degrees."""

MAX_FLOOR_MISFIT_M = 0.05
"""Rms distance of the points from the plane from which they contradict the scene [m], and it is
refused: five times the tolerance of DIN 18202 over 4 m."""

ASSUMED_BASELINE_M = 2.0
"""Distance of the first two stations that is assumed if the scale is unknown [m]. Stations of a
room are 2 to 6 m apart; the smallest distance gives the largest standard deviations."""

MAX_ITERATIONS = 20


@dataclass(frozen=True)
class FloorFrame:
    """Transform to the frame of a floor, and its standard deviations.

    Attributes
    ----------
    to_floor : Similarity
    level_sigma_rad : float or None
        Of the inclination, about the least certain horizontal axis; None if the normal was given.
    heading_sigma_rad : float
        Of the direction of the x axis.
    origin_sigma_m : float
        Of the origin, along each axis, in metres.
    scale_sigma : float or None
        Of the scale, relative; None if a known length of the x axis did not determine it.
    heights_m : (n,) ndarray
        Residual height of each point above the plane, in the unit of the new frame.
    misfit_m : float or None
        Rms height of the points, with the degrees of freedom that the fit leaves; in metres, if
        ``metres_per_unit`` is right. None if every plane fits: three or fewer points, or one if the
        normal was given.
    """

    to_floor: Similarity
    level_sigma_rad: float | None
    heading_sigma_rad: float
    origin_sigma_m: float
    scale_sigma: float | None
    heights_m: Array
    misfit_m: float | None


def fit_floor_frame(
    points: Array,
    station_positions: Array,
    up: UpEstimate | None = None,
    *,
    x_distance_m: float | None = None,
    height_m: float = 0.0,
    metres_per_unit: float = 1.0,
    normal: Array | None = None,
) -> FloorFrame:
    """Fit the frame of a floor to the positions of a device that rested on it.

    Parameters
    ----------
    points : (n, 3) ndarray
        Origin, point on the x axis, further points; n >= 2.
    station_positions : (s, 3) ndarray
        They are above the floor.
    up : UpEstimate, optional
        Vertical in the frame of the points.
    x_distance_m : float, optional
        Known distance of the first two points. It determines the scale.
    height_m : float
        Height of the device's photodiodes above the floor.
    metres_per_unit : float
        Approximate unit of the points, in metres, for the standard deviations.
    normal : (3,) ndarray, optional
        Known normal of the floor, as in a planar scene. It is not fitted then.

    Raises
    ------
    DegenerateError
        The points are on one line and there is no vertical, they are more than
        :data:`MAX_FLOOR_MISFIT_M` from one plane, or the first two coincide.
    """
    points = np.asarray(points, float)
    axis = points[1] - points[0]
    length = float(np.linalg.norm(axis))
    scale = 1.0 if x_distance_m is None else x_distance_m / length if length > 0 else np.inf
    unit_m = metres_per_unit if x_distance_m is None else scale
    if not length * unit_m > MIN_AXIS_LENGTH_M:
        raise DegenerateError(
            "the standstill on the x axis is that of the origin",
            hint=f"rest at least {MIN_AXIS_LENGTH_M:g} m from the origin, better 1 m or more",
        )
    centre, sigma = points.mean(axis=0), FLOOR_SIGMA_M / unit_m
    level_rad = None
    if normal is None:
        normal, level_rad = _fit_normal(points - centre, station_positions - centre, sigma, up)
    forward = axis - normal * (normal @ axis)
    forward /= np.linalg.norm(forward)
    rotation = np.stack([forward, np.cross(normal, forward), normal])
    # The origin is where the first point projects to the plane of all.
    origin = points[0] - normal * (normal @ (points[0] - centre))
    to_floor = Similarity(
        scale, rotation, -scale * rotation @ origin + np.array([0.0, 0.0, height_m])
    )
    heights = to_floor.apply(points)[:, 2] - height_m
    # A plane has three parameters, or only its height if the normal is given.
    freedom = len(points) - (3 if level_rad is not None else 1)
    misfit_m = None
    if freedom > 0:
        misfit_m = unit_m / scale * float(np.sqrt(np.sum(heights**2) / freedom))
    if misfit_m is not None and level_rad is not None:
        # A floor that is less flat than assumed levels the frame less well.
        level_rad *= max(1.0, misfit_m / FLOOR_SIGMA_M)
    if (misfit_m or 0.0) > MAX_FLOOR_MISFIT_M or (level_rad or 0.0) > MAX_LEVEL_SIGMA_RAD:
        raise DegenerateError(
            f"the points are {1e3 * (misfit_m or 0.0):.0f} mm (rms) from one plane, which is no "
            "floor",
            hint="leave out standstills that were not on the floor (--ignore), or the scene is "
            "wrong: use --method bundle",
        )
    placed_m = PLACEMENT_SIGMA_M * np.sqrt(2.0)
    return FloorFrame(
        to_floor,
        level_rad,
        placed_m / (length * unit_m),
        PLACEMENT_SIGMA_M,
        None if x_distance_m is None else placed_m / x_distance_m,
        heights,
        misfit_m,
    )


def _fit_normal(
    points: Array, stations: Array, sigma: float, up: UpEstimate | None
) -> tuple[Array, float]:
    """Fit the unit normal of the plane through the origin, and its standard deviation in radians.

    Gauss-Newton in the two rotations about axes across the normal; points (n, 3) are centred.
    """
    vertical = None if up is None else up.direction
    normal = vertical
    if normal is None:
        normal = np.linalg.svd(points)[2][2]
        normal = normal * (np.sign(normal @ stations.mean(axis=0)) or 1.0)
    for _ in range(MAX_ITERATIONS):
        # A rotation by (a, b, 0) in a frame with z along the normal turns it to (b, -a, 1).
        frame = rotation_between(normal, np.array([0.0, 0.0, 1.0]))
        local = points @ frame.T
        rows = np.c_[-local[:, 1], local[:, 0]] / sigma
        residuals = local[:, 2] / sigma
        if vertical is not None and up is not None:
            rows = np.r_[rows, np.array([[0.0, 1.0], [-1.0, 0.0]]) / up.sigma_rad]
            residuals = np.r_[residuals, -(frame @ vertical)[:2] / up.sigma_rad]
        information = rows.T @ rows
        least = float(np.linalg.eigvalsh(information)[0])
        if not least > MAX_LEVEL_SIGMA_RAD**-2:
            raise DegenerateError(
                "the points on the floor are on one line, and no station reported the vertical",
                hint="rest on a point off that line, or record for 20 s, so that the factory data "
                "of the stations are received",
            )
        step = np.linalg.solve(information, -rows.T @ residuals)
        normal = np.asarray(frame.T @ rotation_exp([step[0], step[1], 0.0])[:, 2])
        if np.max(np.abs(step)) < 1e-10:
            break
    return normal / np.linalg.norm(normal), least**-0.5
