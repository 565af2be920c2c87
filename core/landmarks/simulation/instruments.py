"""Hall sensors and wheels of one simulated robot, read at any time of its path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.floor import FIELD_RANGE_M, InstalledLandmark, floor_field
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.passes import sensor_points, trajectory
from locatk.core.landmarks.simulation.robot import Robot
from locatk.core.landmarks.simulation.sensors import measure, odometry
from locatk.core.simulation import SESSION_START_NS
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

WHEEL_STEPS = 4
"""Steps of the wheels for each pose of the odometry."""


@dataclass(frozen=True)
class Measurements:
    """Measurements of a robot from its start on.

    Attributes
    ----------
    samples : HallSamples
    odometry : Trajectory
        In the frame ``"odometry"``, which is the robot's at the start.
    """

    samples: HallSamples
    odometry: Trajectory


@dataclass(frozen=True)
class Readout:
    """Measurements with the truth behind them.

    Attributes
    ----------
    measurements : Measurements
    poses : (n, 3) ndarray
        True poses on the map, one for each sample.
    points_m : (n, N, 3) ndarray
        True positions of the sensors.
    saturated : int
        Readings at the end of the sensors' range.
    slips_ns : tuple of int
        Times at which a wheel slipped.
    """

    measurements: Measurements
    poses: Array
    points_m: Array
    saturated: int
    slips_ns: tuple[int, ...]


class Instruments:
    """Sensors and wheels of one robot on one floor.

    Reading twice gives the same values: a later readout of a longer path starts with the samples
    of the earlier one, because all random numbers are drawn in the order of time. (Wheel slips
    are not: their number is drawn for the whole path.) True fields are computed once.
    """

    def __init__(
        self,
        floor: FloorMap,
        landmarks: Mapping[Cell, InstalledLandmark],
        sensors: HallSensors,
        height_m: float,
        options: SimulationOptions,
    ) -> None:
        self._floor, self._landmarks = floor, landmarks
        self._sensors, self._height_m, self._options = sensors, height_m, options
        self._field = np.empty((0, len(sensors)))
        self._sampled_path = _SampledPath(options.rate_hz)
        self._wheel_path = _SampledPath(options.odometry_hz * WHEEL_STEPS)

    def read(self, robot: Robot) -> Readout:
        """Return everything that is measured from the start of a path to its end.

        The path must continue that of the last call.
        """
        options = self._options
        time_ns, poses = self._sampled_path.extend(robot)
        points = sensor_points(poses, self._sensors, self._height_m)
        self._extend_field(poses, points)
        values, saturated = measure(
            self._field, self._sensors, options.errors, options.faults, options.seed
        )
        wheels_ns, wheel_poses = self._wheel_path.extend(robot)
        rng = np.random.default_rng([options.seed, 21])
        reported, slips = odometry(wheel_poses, options.errors, rng)
        kept = slice(None, None, WHEEL_STEPS)
        measurements = Measurements(
            HallSamples(options.device, self._sensors, time_ns, values),
            trajectory(options.device, "odometry", wheels_ns[kept], reported[kept]),
        )
        slips_ns = tuple(int(wheels_ns[k]) for k in slips)
        return Readout(measurements, poses, points, saturated, slips_ns)

    def _extend_field(self, poses: Array, points: Array) -> None:
        """Compute the true fields of the samples since the last readout.

        While the robot rests, the field is computed once.
        """
        known = len(self._field)
        moved = np.any(np.diff(poses[max(known - 1, 0) :], axis=0) != 0, axis=1)
        if not known:
            moved = np.concatenate([[True], moved])
        new_points = points[known:][moved]
        new = floor_field(self._floor.geometry, self._landmarks_near(new_points), new_points)
        # Row k is the field after k motions since the last readout.
        by_motion = np.concatenate([self._field[-1:], new])
        motions = np.cumsum(moved) - (0 if known else 1)
        self._field = np.concatenate([self._field, by_motion[motions]])

    def _landmarks_near(self, points: Array) -> list[InstalledLandmark]:
        """Return the landmarks that can contribute to the field at points (..., 3)."""
        if not points.size:
            return []
        x_min, y_min, _ = points.reshape(-1, 3).min(axis=0) - FIELD_RANGE_M
        x_max, y_max, _ = points.reshape(-1, 3).max(axis=0) + FIELD_RANGE_M
        return [
            mark
            for mark in self._landmarks.values()
            if x_min <= mark.x_m <= x_max and y_min <= mark.y_m <= y_max
        ]


class _SampledPath:
    """True poses of a robot at a constant rate, extended with its path."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._poses = np.empty((0, 3))

    def extend(self, robot: Robot) -> tuple[NDArray[np.int64], Array]:
        """Return times and poses (n, 3) of a robot from its start to its end."""
        time_s = np.arange(int(robot.time_s * self._rate_hz) + 1) / self._rate_hz
        new = robot.poses_at(time_s[len(self._poses) :])
        self._poses = np.concatenate([self._poses, new])
        return SESSION_START_NS + np.rint(time_s * 1e9).astype(np.int64), self._poses
