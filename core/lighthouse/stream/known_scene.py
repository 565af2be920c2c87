"""Stations of a scene, prepared for sweeps that come one at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.epochs import MAX_PLANE_DELAY_TURNS, MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.localization.photodiodes import MAX_MOUNTING_SIGMAS, mounting_sigma
from locatk.core.lighthouse.noise import CALIBRATION_SIGMA_RAD, INLIER_GATE_RAD
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.designed_frame import DesignedFrame, is_design
from locatk.core.lighthouse.scene.model import StationArrays, stack_stations
from locatk.core.lighthouse.scene.scene_errors import SceneErrors

Array = NDArray[np.float64]

GRID_STEP_RAD = 0.03
"""Step of the table of corrections [rad]. Between its points they are interpolated to 1.5e-6 rad,
a hundredth of the noise of an angle (largest error for two units of
:data:`~locatk.core.lighthouse.calibration.FACTORY_UNITS` within 60 by 40 degrees)."""

MAX_MEAN_ANGLE_RAD = math.radians(80.0)
"""Largest mean of the angles of both planes in the table [rad]: the beam is 75 degrees wide to each
side."""

NAN_PAIR = (math.nan, math.nan)


class AngleCorrection:
    """Table of the correction of a station's angles to those of ideal planes.

    The correction of :func:`~locatk.core.lighthouse.calibration.ideal_angles` is a smooth function
    of both angles of a pair. A table of it takes a hundredth of the time, for one pair.
    """

    def __init__(self, calibration: Calibration) -> None:
        middle = (MIN_PLANE_DELAY_TURNS + MAX_PLANE_DELAY_TURNS) / 2 - 1 / 3
        half_range = 2 * math.pi * (MAX_PLANE_DELAY_TURNS - MIN_PLANE_DELAY_TURNS) / 2
        self._mean_start = -MAX_MEAN_ANGLE_RAD
        self._difference_start = 2 * math.pi * middle - half_range
        mean = np.arange(self._mean_start, MAX_MEAN_ANGLE_RAD + GRID_STEP_RAD, GRID_STEP_RAD)
        difference = self._difference_start + np.arange(
            0.0, 2 * half_range + GRID_STEP_RAD, GRID_STEP_RAD
        )
        angles = np.stack([mean[:, None] - difference / 2, mean[:, None] + difference / 2], axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            correction = ideal_angles(angles, calibration) - angles
        self._rows, self._columns = len(mean) - 1, len(difference) - 1
        self._table: list[list[list[float]]] = correction.tolist()

    def ideal(self, first: float, second: float) -> tuple[float, float]:
        """Return the angles of ideal planes of a pair in radians; ``nan`` outside of the beam."""
        u = ((first + second) / 2 - self._mean_start) / GRID_STEP_RAD
        v = (second - first - self._difference_start) / GRID_STEP_RAD
        if not (0.0 <= u < self._rows and 0.0 <= v < self._columns):
            return NAN_PAIR
        i, j = int(u), int(v)
        u, v = u - i, v - j
        a, b = self._table[i][j], self._table[i + 1][j]
        c, d = self._table[i][j + 1], self._table[i + 1][j + 1]
        wa, wb, wc, wd = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
        return (
            first + wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0],
            second + wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1],
        )


@dataclass
class KnownScene:
    """Scene with stations, and the stations that are not used at present.

    Attributes
    ----------
    scene : Scene
    stations : tuple of Station
        By ascending channel.
    column : dict of int to int
        Index of a station by its channel.
    arrays : StationArrays
    corrections : tuple of AngleCorrection
    floor_z : float or None
        Height of all photodiodes, if they move on a plane.
    floor_map : (3, 3) ndarray or None
        Of a single station over a floor with markers.
    errors : SceneErrors
    min_stations : int
        Fewest stations that determine the position of a photodiode.
    max_gate_rad : float
        Largest residual of a consistent fix: wider for designed stations, which are beside their
        poses.
    calibration_sigma_rad : float
        Standard deviation of the angles that generic calibrations add; 0 if there are none. A floor
        homography absorbs their errors, and the covariance of a scene may contain them.
    excluded : set of int
        Indices of stations that contradict the others.
    """

    scene: Scene
    stations: tuple[Station, ...]
    column: dict[int, int]
    arrays: StationArrays
    corrections: tuple[AngleCorrection, ...]
    floor_z: float | None
    floor_map: Array | None
    errors: SceneErrors
    min_stations: int
    max_gate_rad: float
    calibration_sigma_rad: float
    excluded: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, scene: Scene, frame: DesignedFrame | None = None) -> KnownScene:
        """Prepare a scene with one station or more; ``frame`` is that of a designed room."""
        stations = tuple(sorted(scene.stations, key=lambda s: s.channel))
        floor_map = stations[0].floor_map if len(stations) == 1 else None
        floor_z = scene.floor_z if scene.planar else None
        errors = SceneErrors(scene, stations, floor_z, frame)
        is_generic = any(s.calibration.is_generic for s in stations)
        has_generic_error = is_generic and floor_map is None and not errors.has_calibration
        max_gate_rad = INLIER_GATE_RAD
        if is_design(scene):
            working_m = np.array([np.median([s.position for s in stations], axis=0)])
            working_m[:, 2] = scene.floor_z
            max_gate_rad = max(
                max_gate_rad, MAX_MOUNTING_SIGMAS * mounting_sigma(stations, working_m)
            )
        return cls(
            scene,
            stations,
            {s.channel: k for k, s in enumerate(stations)},
            stack_stations(stations),
            tuple(AngleCorrection(s.calibration) for s in stations),
            floor_z,
            floor_map,
            errors,
            1 if scene.planar or floor_map is not None else 2,
            max_gate_rad,
            CALIBRATION_SIGMA_RAD if has_generic_error else 0.0,
        )
