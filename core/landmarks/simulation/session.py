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

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.floor import Laid, floor_field, lay
from locatk.core.landmarks.simulation.options import NONE as NONE
from locatk.core.landmarks.simulation.options import STRATEGIES as STRATEGIES
from locatk.core.landmarks.simulation.options import Aims as Aims
from locatk.core.landmarks.simulation.options import Errors as Errors
from locatk.core.landmarks.simulation.options import Faults as Faults
from locatk.core.landmarks.simulation.options import SimulationOptions as SimulationOptions
from locatk.core.landmarks.simulation.passes import EPOCH_NS as EPOCH_NS
from locatk.core.landmarks.simulation.passes import Pass as Pass
from locatk.core.landmarks.simulation.passes import passes as passes
from locatk.core.landmarks.simulation.passes import sensor_points, trajectory
from locatk.core.landmarks.simulation.robot import Limits as Limits
from locatk.core.landmarks.simulation.robot import Robot
from locatk.core.landmarks.simulation.sensors import measure, odometry
from locatk.core.landmarks.simulation.strategy import VISIT_M, steer
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

LARGEST_SESSION = 1_000_000
"""Samples of a session, at most."""

FINER = 4
"""Steps of the wheels for each pose of the odometry."""


class Visit(NamedTuple):
    """A time in which the robot's sensors are over one landmark.

    Attributes
    ----------
    cell : (row, column)
    first_ns, last_ns : int
        From when until when a sensor is within :data:`VISIT_M` of the landmark's centre.
    nearest_ns : int
        When the robot itself is nearest to it.
    nearest_m : float
        How near.
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
        Knowledge of a user: the map as designed.
    floor_as_laid : tuple of Laid
        The landmarks as installed, row by row.
    events : tuple of Visit
        In the order of time.
    saturated : int
        Readings at the end of the sensors' range.
    slips : tuple of int
        When a wheel slipped, in nanoseconds.
    notes : tuple of str
        What a user may not expect.
    """

    samples: tuple[HallSamples, ...]
    truth: tuple[Trajectory, ...]
    odometry: tuple[Trajectory, ...]
    floor: FloorMap
    floor_as_laid: tuple[Laid, ...]
    events: tuple[Visit, ...]
    saturated: int
    slips: tuple[int, ...]
    notes: tuple[str, ...]


def simulate(floor: FloorMap, options: SimulationOptions | None = None) -> SimulatedSession:
    """Drive a robot over a floor.

    The same floor and options give the same session.

    Raises
    ------
    InputError
        The map has no landmark, the way or a fault does not fit it, the sensors are within
        the bars, or the session would be endless.
    """
    options = options or SimulationOptions()
    errors, geometry = options.errors, floor.geometry
    height = geometry.sensor_height_m + errors.height_m
    if not height > 0:
        raise InputError(
            f"sensors {height * 1e3:.3g} mm over the bars' top faces", hint="Give a height above 0"
        )
    seed = options.seed if options.floor_seed is None else options.floor_seed
    laid = lay(floor, errors, options.faults, seed)
    robot, notes = steer(floor, laid, options)
    if robot.time_s * options.rate_hz >= LARGEST_SESSION:
        raise InputError(
            f"a simulation of {robot.time_s * options.rate_hz:.0f} samples",
            hint="Change the rate, the speed or the way",
        )
    sensors = options.sensors or HallSensors(
        position_m=circle(geometry.circle_m),
        noise_t=errors.noise_t if errors.noise_t > 0 else float("nan"),
        range_t=options.range_t,
    )
    time_ns, poses = _sampled(robot, options.rate_hz)
    points = sensor_points(poses, sensors, height)
    field = _seen(poses, points, floor, laid)
    read, saturated = measure(field, sensors, errors, options.faults, options.seed)
    told, slips = _odometry(robot, options)
    return SimulatedSession(
        samples=(HallSamples(options.device, sensors, time_ns, read),),
        truth=(trajectory(options.device, "map", time_ns, poses),),
        odometry=(told,),
        floor=floor,
        floor_as_laid=tuple(laid.values()),
        events=_visits(laid, time_ns, poses, points),
        saturated=saturated,
        slips=slips,
        notes=tuple(notes),
    )


def _sampled(robot: Robot, rate_hz: float) -> tuple[NDArray[np.int64], Array]:
    """Times and poses (n, 3) of a robot from its start to its end."""
    time_s = np.arange(int(robot.time_s * rate_hz) + 1) / rate_hz
    return EPOCH_NS + np.rint(time_s * 1e9).astype(np.int64), robot.at(time_s)


def _seen(poses: Array, points: Array, floor: FloorMap, laid: dict[Cell, Laid]) -> Array:
    """True fields (n, N); where the robot stands they are found once."""
    moved = np.r_[True, np.any(np.diff(poses, axis=0) != 0, axis=1)]
    field = floor_field(floor.geometry, laid.values(), points[moved])
    return np.asarray(field[np.cumsum(moved) - 1])


def _odometry(robot: Robot, options: SimulationOptions) -> tuple[Trajectory, tuple[int, ...]]:
    """What the wheels tell, and when they slipped."""
    fine_ns, poses = _sampled(robot, options.odometry_hz * FINER)
    told, slips = odometry(poses, options.errors, np.random.default_rng([options.seed, 21]))
    which = slice(None, None, FINER)
    own = trajectory(options.device, "odometry", fine_ns[which], told[which])
    return own, tuple(int(fine_ns[k]) for k in slips)


def _visits(
    laid: dict[Cell, Laid], time_ns: NDArray[np.int64], poses: Array, points: Array
) -> tuple[Visit, ...]:
    from scipy.spatial import cKDTree

    found = []
    count = points.shape[1]
    tree = cKDTree(points[..., :2].reshape(-1, 2))
    places = [(mark.x_m, mark.y_m) for mark in laid.values()]
    near = tree.query_ball_point(places, VISIT_M, return_sorted=True)
    for mark, place, sensed in zip(laid.values(), places, near, strict=True):
        over = np.unique(np.asarray(sensed, np.int64) // count)
        if not len(over):
            continue
        away = np.hypot(*(poses[:, :2] - place).T)
        # Sensors to both sides of the centre may be out while the robot is over it.
        gap_ns = 1_000_000_000
        for part in np.split(over, np.flatnonzero(np.diff(time_ns[over]) > gap_ns) + 1):
            best = part[np.argmin(away[part])]
            found.append(
                Visit(
                    mark.cell,
                    int(time_ns[part[0]]),
                    int(time_ns[part[-1]]),
                    int(time_ns[best]),
                    float(away[best]),
                )
            )
    return tuple(sorted(found, key=lambda visit: visit.first_ns))
