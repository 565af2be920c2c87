"""Simulation of robots with four hall sensors on a floor of landmarks, with ground truth.

The field of every bar as a cuboid (magpylib) with errors is evaluated at each sensor, and the
odometry of a differential drive has errors. The assumptions of the solver are not used. Not
simulated are a tilted robot, the fields of its motors, tilted sensors, and delays of readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.closed_loop import Approach as Approach
from locatk.core.landmarks.simulation.closed_loop import Driver as Driver
from locatk.core.landmarks.simulation.closed_loop import drive_closed_loop
from locatk.core.landmarks.simulation.floor import InstalledLandmark, install_landmarks
from locatk.core.landmarks.simulation.instruments import Instruments
from locatk.core.landmarks.simulation.options import NONE as NONE
from locatk.core.landmarks.simulation.options import STRATEGIES as STRATEGIES
from locatk.core.landmarks.simulation.options import Aims as Aims
from locatk.core.landmarks.simulation.options import Errors as Errors
from locatk.core.landmarks.simulation.options import Faults as Faults
from locatk.core.landmarks.simulation.options import SimulationOptions as SimulationOptions
from locatk.core.landmarks.simulation.passes import trajectory
from locatk.core.landmarks.simulation.robot import RobotLimits as RobotLimits
from locatk.core.landmarks.simulation.strategy import VISIT_RADIUS_M, steer
from locatk.core.simulation import check_session_size
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_VISIT_GAP_NS = 1_000_000_000
"""Longest time without a sensor near the landmark within one visit [ns]: sensors on both sides of
the centre may be outside the radius while the robot is over the landmark."""


class SimulatedVisit(NamedTuple):
    """A time in which the robot's sensors are over one landmark.

    Attributes
    ----------
    cell : (row, column)
    first_ns, last_ns : int
        First and last time at which a sensor is within :data:`VISIT_RADIUS_M` of the landmark's
        centre.
    nearest_ns : int
        Time of the smallest distance of the robot's origin from that centre.
    nearest_m : float
        That distance.
    """

    cell: Cell
    first_ns: int
    last_ns: int
    nearest_ns: int
    nearest_m: float


@dataclass(frozen=True)
class SimulatedSession:
    """Simulated recording and its ground truth.

    Attributes
    ----------
    samples : tuple of HallSamples
        One for each robot.
    truth : tuple of Trajectory
        In the frame ``"map"``; one pose for each sample.
    odometry : tuple of Trajectory
        In the frame ``"odometry"``, which is the robot's at the start.
    floor : FloorMap
        Map as designed, which is all that a user knows.
    installed_landmarks : tuple of InstalledLandmark
        The landmarks as installed, row by row.
    events : tuple of SimulatedVisit
        Visits in the order of time.
    saturated : int
        Readings at the end of the sensors' range.
    slips : tuple of int
        Times of wheel slips.
    notes : tuple of str
        Properties of the simulation that a user may not expect.
    approaches : tuple of Approach
        Approaches of the strategy ``published``, in the order of time.
    """

    samples: tuple[HallSamples, ...]
    truth: tuple[Trajectory, ...]
    odometry: tuple[Trajectory, ...]
    floor: FloorMap
    installed_landmarks: tuple[InstalledLandmark, ...]
    events: tuple[SimulatedVisit, ...]
    saturated: int
    slips: tuple[int, ...]
    notes: tuple[str, ...]
    approaches: tuple[Approach, ...] = ()


def simulate(
    floor: FloorMap, options: SimulationOptions | None = None, driver: Driver | None = None
) -> SimulatedSession:
    """Drive a robot over a floor.

    ``driver`` is needed by the strategy ``published``, and only used by it.

    The same floor and options give the same session.

    Raises
    ------
    InputError
        The map has no landmark, the path or a fault does not fit it, the sensors are within
        the bars, the session would be endless, or the driver is missing.
    """
    options = options or SimulationOptions()
    errors, geometry = options.errors, floor.geometry
    height = geometry.sensor_height_m + errors.height_m
    if not height > 0:
        raise InputError(
            f"sensors {height * 1e3:.3g} mm over the bars' top faces", hint="Give a height above 0"
        )
    seed = options.seed if options.floor_seed is None else options.floor_seed
    installed = install_landmarks(floor, errors, options.faults, seed)
    sensors = options.sensors or HallSensors(
        position_m=circle(geometry.circle_m),
        noise_t=errors.noise_t if errors.noise_t > 0 else float("nan"),
        range_t=options.range_t,
    )
    instruments = Instruments(floor, installed, sensors, height, options)
    approaches: tuple[Approach, ...] = ()
    if options.strategy == "published":
        if driver is None:
            raise InputError("the strategy published needs a driver")
        robot, notes, approaches = drive_closed_loop(floor, installed, options, instruments, driver)
    else:
        robot, notes = steer(floor, installed, options)
    check_session_size(robot.time_s * max(options.rate_hz, options.odometry_hz), robot.time_s)
    readout = instruments.read(robot)
    time_ns = readout.measurements.samples.time_ns
    return SimulatedSession(
        samples=(readout.measurements.samples,),
        truth=(trajectory(options.device, "map", time_ns, readout.poses),),
        odometry=(readout.measurements.odometry,),
        floor=floor,
        installed_landmarks=tuple(installed.values()),
        events=_visits(installed, time_ns, readout.poses, readout.points_m),
        saturated=readout.saturated,
        slips=readout.slips_ns,
        notes=tuple(notes),
        approaches=approaches,
    )


def _visits(
    installed: dict[Cell, InstalledLandmark],
    time_ns: NDArray[np.int64],
    poses: Array,
    sensor_positions: Array,
) -> tuple[SimulatedVisit, ...]:
    """Return the visits of a drive, in the order of time.

    Parameters
    ----------
    installed : dict of cell to InstalledLandmark
    time_ns : (n,) int64 ndarray
    poses : (n, 3) ndarray
        Poses of the robot in the map frame: x, y and heading.
    sensor_positions : (n, N, 3) ndarray
        Positions of the sensors in the map frame.
    """
    visits = []
    sensor_count = sensor_positions.shape[1]
    tree = cKDTree(sensor_positions[..., :2].reshape(-1, 2))
    centres = [(mark.x_m, mark.y_m) for mark in installed.values()]
    in_range = tree.query_ball_point(centres, VISIT_RADIUS_M, return_sorted=True)
    for mark, centre, readings in zip(installed.values(), centres, in_range, strict=True):
        samples = np.unique(np.asarray(readings, np.int64) // sensor_count)
        if not len(samples):
            continue
        distance_m = np.hypot(*(poses[:, :2] - centre).T)
        gaps = np.flatnonzero(np.diff(time_ns[samples]) > MAX_VISIT_GAP_NS) + 1
        for visit_samples in np.split(samples, gaps):
            nearest = visit_samples[np.argmin(distance_m[visit_samples])]
            visits.append(
                SimulatedVisit(
                    mark.cell,
                    int(time_ns[visit_samples[0]]),
                    int(time_ns[visit_samples[-1]]),
                    int(time_ns[nearest]),
                    float(distance_m[nearest]),
                )
            )
    return tuple(sorted(visits, key=lambda visit: visit.first_ns))
