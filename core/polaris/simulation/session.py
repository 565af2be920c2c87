"""Simulation of passes of a magnetometer array over tags, with ground truth.

The field of the discs as finite cylinders (magpylib), of debris and of the Earth is evaluated at
the position of each axis of each sensor at the time of its conversion. The assumptions of the
solver are not used: magnets are no dipoles, the speed is not constant, and a sample is not
simultaneous. Not simulated are tilted sensors, and the motion during the conversion of one axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.polaris.array import Samples
from locatk.core.polaris.simulation.field import Debris, Discs
from locatk.core.polaris.simulation.floor import TagFloor, build_floor, to_site_frame
from locatk.core.polaris.simulation.options import CARS as CARS
from locatk.core.polaris.simulation.options import RandomSource
from locatk.core.polaris.simulation.options import SimulationOptions as SimulationOptions
from locatk.core.polaris.simulation.options import usual_bar as usual_bar
from locatk.core.polaris.simulation.paths import ArrayTrajectory, SpeedProfile, path_through
from locatk.core.polaris.simulation.sensors import (
    SensorFaults,
    measure,
    motor_field,
    received_frames,
)
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, Tags
from locatk.core.simulation import (
    check_session_size,
    exact_trajectory,
    random_stream,
    stamps_ns,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

RUN_UP_CLEARANCES = 10
"""Length of the path before and after a tag in clearances: the field of a magnet is a thousandth
there."""

THROTTLE_LAG_S = 0.1
"""The throttle is proportional to the speed plus its increase within this time [s]."""


class Crossing(NamedTuple):
    """A tag that passes below the array.

    Attributes
    ----------
    tag_id : int
    time_ns : int
        Time at which its middle is below the array's y axis.
    y_m : float
        Position of the middle on that axis.
    heading_rad : float
        Heading of the tag in the frame of the array, -pi to pi.
    whole : bool
        True if all its cells pass between the ends of the array.
    """

    tag_id: int
    time_ns: int
    y_m: float
    heading_rad: float
    whole: bool


@dataclass(frozen=True)
class SimulatedSession:
    """Simulated recording and its ground truth.

    Attributes
    ----------
    samples : Samples
    tags : Tags
        Knowledge of a user: the tags as designed.
    truth : Trajectory
        True poses of the array at the times of all frames, lost ones included; z is the height
        above the middles of the magnets. The frame is ``"site"``, or ``"tag-<id>"`` of the only
        tag.
    odometry : Trajectory or None
        In the frame ``"odom"``, which is that of the array at the start.
    crossings : tuple of Crossing
        In the order of time.
    magnets : Discs
        The magnets as built, in the frame of the truth.
    built : mapping of int to AsBuiltTag
        Their deviations from the design by tag: ``replace(tags, built=simulated.built)`` knows
        all except their strength.
    debris : Debris
    saturated : int
        Number of readings beyond the range.
    lost : int
        Number of frames that never arrived.
    """

    samples: Samples
    tags: Tags
    truth: Trajectory
    odometry: Trajectory | None
    crossings: tuple[Crossing, ...]
    magnets: Discs
    built: Mapping[int, AsBuiltTag]
    debris: Debris
    saturated: int
    lost: int


def simulate(
    tags: Tags | None = None, options: SimulationOptions | None = None
) -> SimulatedSession:
    """Simulate an array that drives over tags (default: the paper's).

    The same tags and options give the same session.

    Raises
    ------
    InputError
        A tag of the route is not of the family or not on the site, the array would touch the
        magnets, or the session would be too long.
    """
    tags, options = tags or Tags(), options or SimulationOptions()
    floor = build_floor(tags, options)
    trajectory = _drive(tags, [floor.site[tag_id] for tag_id in floor.route], options)
    # A delay may be negative; the first sample is taken after the start of the drive.
    begin_s = max(0.0, -float(options.array.delay_s.min()))
    frames = (trajectory.duration_s - begin_s) * options.rate_hz + 1
    check_session_size(frames, trajectory.duration_s)
    if frames < 2:
        raise InputError(
            f"a simulation of {frames:.0f} frames", hint="Change the rate, the speed or the route"
        )
    time_s = begin_s + np.arange(int(frames)) / options.rate_hz
    time_ns = stamps_ns(time_s)
    readings, saturated = measure(
        _true_field(trajectory, time_s, floor, options),
        options.array,
        options.rate_hz,
        SensorFaults(
            options.offset_t, options.drift_t, options.dead, options.stuck, options.clipped
        ),
        options.seed,
    )
    is_received = received_frames(len(time_s), options.lost, options.seed)
    position, heading = trajectory.pose(time_s)
    return SimulatedSession(
        samples=Samples(options.device, options.array, time_ns[is_received], readings[is_received]),
        tags=tags,
        truth=exact_trajectory(options.device, floor.frame, time_ns, position, heading),
        odometry=_odometry(time_ns, position, heading, options) if options.odometry else None,
        crossings=_crossings(tags, floor.site, trajectory, options.array.position_m),
        magnets=floor.discs,
        built=floor.built,
        debris=floor.debris,
        saturated=saturated,
        lost=int(np.count_nonzero(~is_received)),
    )


# ---- the drive


def _drive(
    tags: Tags, tag_poses: Sequence[PlanarPose], options: SimulationOptions
) -> ArrayTrajectory:
    """Return the trajectory over tags."""
    clearance = tags.clearance_m if options.clearance_m is None else options.clearance_m
    lowest = clearance - options.height_wobble_m
    top = tags.magnet.height_m / 2 + (options.debris_size_m if options.debris else 0.0)
    if not lowest > top:
        raise InputError(
            f"sensors at a height of {lowest * 1e3:.3g} mm above the middles of the magnets, where "
            f"the top of {'debris' if options.debris else 'a magnet'} is at {top * 1e3:.3g} mm",
            hint="Give more clearance",
        )
    width = (tags.order - 1) * tags.spacing_m
    half_diagonal = width / np.sqrt(2)
    run_up = RUN_UP_CLEARANCES * clearance if options.run_up_m is None else options.run_up_m
    return ArrayTrajectory(
        path_through(
            _stops(tag_poses, options), half_diagonal + run_up, half_diagonal + 2 * clearance
        ),
        SpeedProfile(
            options.speed_mps, options.rest_s, options.acceleration_mps2, options.speed_wobble
        ),
        width,
        clearance,
        options.crab_rad,
        options.yaw_wobble_rad,
        options.height_wobble_m,
        random_stream(options.seed, RandomSource.PATH),
    )


def _stops(tag_poses: Sequence[PlanarPose], options: SimulationOptions) -> list[PlanarPose]:
    """Return the pose of the middle of the array on each tag; x is the direction of travel."""
    middle = np.array([[pose.x_m, pose.y_m] for pose in tag_poses])
    stops = []
    for k, pose in enumerate(tag_poses):
        if options.heading_rad is not None or len(tag_poses) == 1:
            heading = pose.heading_rad + (options.heading_rad or 0.0)
        else:
            along = middle[min(k + 1, len(tag_poses) - 1)] - middle[max(k - 1, 0)]
            heading = float(np.arctan2(along[1], along[0]))
        x = pose.x_m - options.lateral_m * np.sin(heading)
        y = pose.y_m + options.lateral_m * np.cos(heading)
        stops.append(PlanarPose(float(x), float(y), heading))
    return stops


def _crossings(
    tags: Tags, site: Mapping[int, PlanarPose], trajectory: ArrayTrajectory, sensors_m: Array
) -> tuple[Crossing, ...]:
    """Return the tags of which a cell may pass below the array, in the order of time."""
    half = (tags.order - 1) / 2 * tags.spacing_m
    middle_and_corners = half * np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]])
    right, left = sensors_m[:, 1].min(), sensors_m[:, 1].max()
    crossings = []
    for tag_id, pose in site.items():
        points = to_site_frame(pose, middle_and_corners)
        for time_s in trajectory.crossing_times_s(pose.x_m, pose.y_m):
            position, heading = trajectory.pose(np.array(time_s))
            y = (points - position[:2]) @ [-np.sin(heading), np.cos(heading)]
            if y.max() < right or left < y.min():
                continue
            rotation = pose.heading_rad - heading
            crossings.append(
                Crossing(
                    tag_id,
                    int(stamps_ns(time_s)),
                    float(y[0]),
                    float(np.arctan2(np.sin(rotation), np.cos(rotation))),
                    bool(right <= y.min() and y.max() <= left),
                )
            )
    return tuple(sorted(crossings, key=lambda crossing: crossing.time_ns))


# ---- measurements


def _true_field(
    trajectory: ArrayTrajectory, time_s: Array, floor: TagFloor, options: SimulationOptions
) -> Array:
    """Return the field (n, N, 3) in the axes of the array, each axis at its conversion time."""
    array = options.array
    field = np.empty((len(time_s), len(array), 3))
    for axis, delay_s in enumerate(array.delay_s):
        position, heading = trajectory.pose(time_s + delay_s)
        axes = _rotations(heading)
        sensors = position[:, None] + np.einsum("nij,sj->nsi", axes, array.position_m)
        field[..., axis] = np.einsum("nsi,ni->ns", floor.field(sensors), axes[..., axis])
        if options.motor_t > 0:
            throttle = _throttle(trajectory, time_s + delay_s) / options.speed_mps
            motors = motor_field(
                throttle, array.position_m, options.motor_t, options.motor_gradient, options.seed
            )
            field[..., axis] += motors[..., axis]
    return field


def _rotations(heading: Array) -> Array:
    """Return the rotations (n, 3, 3) from the frame of the array to that of the floor."""
    cos, sin = np.cos(heading), np.sin(heading)
    rotations = np.zeros((len(heading), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = cos
    rotations[:, 1, 0], rotations[:, 0, 1] = sin, -sin
    rotations[:, 2, 2] = 1.0
    return rotations


def _throttle(trajectory: ArrayTrajectory, time_s: Array) -> Array:
    """Return the throttle of the motors (n,) as the speed that needs it; 0 at rest."""
    speed = trajectory.speed(time_s)
    increase = speed - trajectory.speed(np.maximum(time_s - THROTTLE_LAG_S, 0.0))
    return np.where(speed > 0, np.maximum(speed + increase, 0.0), 0.0)


def _odometry(
    time_ns: NDArray[np.int64], position: Array, heading: Array, options: SimulationOptions
) -> Trajectory:
    """Return the poses of an odometry with a scale error and a random walk of its heading."""
    step = np.diff(position[:, :2], axis=0) @ [1, 1j]
    rng = random_stream(options.seed, RandomSource.ODOMETRY)
    heading_error = np.cumsum(
        options.odometry_turn_rad * np.sqrt(abs(step)) * rng.normal(size=step.size)
    )
    rotation = np.r_[0.0, heading_error] - heading[0]
    reported = np.r_[
        0.0, np.cumsum((1 + options.odometry_scale) * step * np.exp(1j * rotation[1:]))
    ]
    distance = np.r_[0.0, np.cumsum(abs(step))]
    heading_variance = options.odometry_turn_rad**2 * distance
    covariance = np.zeros((len(distance), 6, 6))
    # A random walk of the heading by s per square root of a metre gives the lateral variance
    # s^2 distance^3 / 3.
    covariance[:, 0, 0] = (options.odometry_scale * distance) ** 2
    covariance[:, 1, 1] = heading_variance * distance**2 / 3
    covariance[:, 5, 5] = heading_variance
    return Trajectory(
        options.device,
        "odom",
        time_ns,
        np.column_stack([reported.real, reported.imag, np.zeros(len(distance))]),
        quaternion_from_heading(heading + rotation),
        covariance,
    )
