"""Closed loop of a simulated robot and a driver that has only its measurements.

The driver is passed in by the caller, so that the simulation does not import the algorithm that
drives. It asks for the measurements so far and orders the next motion. The robot executes a motion
by its own odometry, as a real one does: constant errors of the odometry make it drive a different
path than was ordered. The truth is used to judge the approaches afterwards, not to drive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import rotated
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.floor import InstalledLandmark
from locatk.core.landmarks.simulation.instruments import Instruments, Measurements
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.robot import Robot
from locatk.core.landmarks.simulation.sensors import odometry_biases
from locatk.core.landmarks.simulation.strategy import CHECK_STEP_M, is_free, start_of_search
from locatk.core.simulation import SESSION_START_NS

Array = NDArray[np.float64]

Outcome = Literal["centre", "no_pattern", "wrong_pattern", "lost"]

MAX_CENTRE_DISTANCE_M = 0.005
"""Largest distance from a landmark's centre of a robot that reached it: half the width of the
default bars, within which all sensors are above bars."""

MAX_SESSION_S = 1800.0
"""Time after which a session ends even if its driver orders more: a driver that follows the paper
needs about 30 s for a landmark."""


@dataclass(frozen=True)
class Motion:
    """Motion from rest to rest that a driver orders.

    Attributes
    ----------
    arcs : tuple of (float, float)
        Path length [m] and rotation [rad] of each arc by odometry; a path length of 0 is a
        rotation on the spot.
    wait_s : float
        Time at rest after the arcs.
    """

    arcs: tuple[tuple[float, float], ...] = ()
    wait_s: float = 0.0


@dataclass(frozen=True)
class ApproachReport:
    """Result of one approach to a landmark by the driver's own estimates.

    Attributes
    ----------
    time_ns : int
        Last sample of the approach.
    searched : bool
        True if the landmark was met in a search, False if it was reached from a neighbour.
    spins : int
    code : int or None
        As read in the frame of :attr:`pose`; None if no pattern was recognised.
    pose : (3,) ndarray or None
        Robot at that time in the landmark's frame, rotated by quarter turns so that its x axis is
        nearest to the robot's heading.
    lost : bool
        No field or no centre of a landmark was found.
    """

    time_ns: int
    searched: bool
    spins: int
    code: int | None = None
    pose: Array | None = None
    lost: bool = False


class Driver(Protocol):
    """Driver of a simulated robot; one object drives one session."""

    @property
    def reports(self) -> Sequence[ApproachReport]:
        """Approaches so far."""

    def motions(self, measure: Callable[[], Measurements]) -> Iterator[Motion]:
        """Yield one motion after the other.

        ``measure`` returns all measurements from the start of the session to the end of
        the last motion.
        """


@dataclass(frozen=True)
class Approach:
    """Outcome of one approach to a landmark, judged by the truth.

    Attributes
    ----------
    time_ns : int
        Last sample of the approach.
    cell : (row, column)
        Landmark nearest to the robot at that time.
    outcome : {"centre", "no_pattern", "wrong_pattern", "lost"}
        ``centre``: the right code was read, and the robot is within
        :data:`MAX_CENTRE_DISTANCE_M` of the centre. ``no_pattern``: the signals of the spin
        match no code. ``wrong_pattern``: another code was read. ``lost``: the robot found no
        landmark, or stopped at a position that is not the centre of one.
    searched : bool
        True if the landmark was met in a search, False if it was reached from a neighbour.
    spins : int
    distance_m : float
        Of the robot from the centre of the landmark.
    """

    time_ns: int
    cell: Cell
    outcome: Outcome
    searched: bool
    spins: int
    distance_m: float


def drive_closed_loop(
    floor: FloorMap,
    landmarks: Mapping[Cell, InstalledLandmark],
    options: SimulationOptions,
    instruments: Instruments,
    driver: Driver,
) -> tuple[Robot, list[str], tuple[Approach, ...]]:
    """Let a driver drive a robot from the start of a search.

    Returns
    -------
    robot : Robot
        At the end of its path.
    notes : list of str
        What a user may not expect.
    approaches : tuple of Approach

    Raises
    ------
    InputError
        There is no landmark, or no start from which one is met.
    """
    robot = start_of_search(floor, landmarks, options)
    # The first draws of the odometry's random numbers are its constant errors.
    biases = odometry_biases(options.errors, np.random.default_rng([options.seed, 21]))
    notes: list[str] = []
    for motion in driver.motions(lambda: instruments.read(robot).measurements):
        execute_motion(robot, motion, biases)
        if robot.time_s > MAX_SESSION_S:
            notes.append(f"the driver did not finish within {MAX_SESSION_S:.0f} s")
            break
    robot.wait(options.rest_s)
    if not is_free(floor, _path_points(robot)):
        notes.append("the path leaves the map, or goes over a hole or through a wall")
    approaches = tuple(judge_approach(report, robot, landmarks) for report in driver.reports)
    return robot, notes, approaches


def execute_motion(robot: Robot, motion: Motion, biases: Array) -> None:
    """Drive the arcs of a motion as the robot does if it follows its own odometry.

    Parameters
    ----------
    robot : Robot
    motion : Motion
    biases : (3,) ndarray
        Constant errors of the odometry: relative error of distances, rotation [rad/m] reported
        on a straight line, relative error of rotations
        (:func:`~locatk.core.landmarks.simulation.sensors.odometry_biases`).
    """
    scale, drift, rotation_scale = biases
    arcs: list[tuple[float, float]] = []
    for path_m, rotation_rad in motion.arcs:
        true_path = path_m / (1 + scale)
        true_rotation = (rotation_rad - drift * true_path) / (1 + rotation_scale)
        if path_m:
            arcs.append((true_path, true_rotation))
        else:
            robot.drive(arcs)
            robot.rotate(true_rotation)
            arcs = []
    robot.drive(arcs)
    robot.wait(motion.wait_s)


def judge_approach(
    report: ApproachReport, robot: Robot, landmarks: Mapping[Cell, InstalledLandmark]
) -> Approach:
    """Judge an approach by the reported code and heading, and its true distance from the centre."""
    time_s = np.array([(report.time_ns - SESSION_START_NS) * 1e-9])
    x, y, heading = robot.poses_at(time_s)[0]
    nearest = min(landmarks.values(), key=lambda mark: math.hypot(mark.x_m - x, mark.y_m - y))
    distance = math.hypot(nearest.x_m - x, nearest.y_m - y)
    outcome: Outcome
    if report.lost:
        outcome = "lost"
    elif report.code is None or report.pose is None:
        outcome = "no_pattern"
    elif report.code != _code_in_frame(nearest, heading - report.pose[2]):
        outcome = "wrong_pattern"
    else:
        outcome = "centre" if distance <= MAX_CENTRE_DISTANCE_M else "lost"
    return Approach(report.time_ns, nearest.cell, outcome, report.searched, report.spins, distance)


def _code_in_frame(mark: InstalledLandmark, frame_rad: float) -> int:
    """Return the code of a landmark in a frame rotated by about quarter turns from its own.

    Flipped bars count as they are; a missing bar counts as designed.
    """
    bits = [
        strength > 0 if strength else bool(mark.code >> bar & 1)
        for bar, strength in enumerate(mark.strength)
    ]
    code = sum(1 << bar for bar, north in enumerate(bits) if north)
    return int(rotated(code, -round((frame_rad - mark.heading_rad) / (math.pi / 2))))


def _path_points(robot: Robot) -> Array:
    """Return points (n, 2) of the path that are at most :data:`CHECK_STEP_M` apart."""
    step_s = CHECK_STEP_M / robot.limits.speed_mps
    return robot.poses_at(np.append(np.arange(0.0, robot.time_s, step_s), robot.time_s))[:, :2]
