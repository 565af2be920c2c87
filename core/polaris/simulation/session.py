"""Passes of a magnetometer bar over tags, with all that is true of them.

What is simulated is the field of the discs as finite cylinders (magpylib), of debris and of
the Earth, where each axis of each sensor is when it converts. Nothing that a solver takes
for granted is used: no dipoles for magnets, no constant speed, no sample of one moment.
Not simulated are sensors that lean, and the smear within the conversion of one axis.
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
from locatk.core.polaris.simulation.floor import Floor, floor, on_floor
from locatk.core.polaris.simulation.options import CARS as CARS
from locatk.core.polaris.simulation.options import SimulationOptions as SimulationOptions
from locatk.core.polaris.simulation.options import usual_bar as usual_bar
from locatk.core.polaris.simulation.paths import Course, Drive, line
from locatk.core.polaris.simulation.sensors import Faults, measure, motor_field, received
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, Tags
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

EPOCH_NS = 1_767_225_600_000_000_000
"""Start of every simulated session: 2026-01-01T00:00:00Z."""

LARGEST_SESSION = 1_000_000
"""Frames of a session, at most."""

RUN_UP_CLEARANCES = 10
"""How far before and after a tag a pass goes: a magnet's field is a thousandth there."""

THROTTLE_S = 0.1
"""The throttle is what the speed takes, and what it gained within this time besides."""


class Crossing(NamedTuple):
    """A tag that passes under the array.

    Attributes
    ----------
    tag_id : int
    time_ns : int
        When its middle is under the array's y axis.
    y_m : float
        Where on that axis.
    heading_rad : float
        Of the tag in the array's frame, -pi to pi.
    whole : bool
        Whether all its cells pass under the bar, and none beside it.
    """

    tag_id: int
    time_ns: int
    y_m: float
    heading_rad: float
    whole: bool


@dataclass(frozen=True)
class SimulatedSession:
    """A session that never was.

    Attributes
    ----------
    samples : Samples
    tags : Tags
        As they were given: what a user knows of them.
    truth : Trajectory
        Poses of the array at the time of each frame, of those that were lost as well; z is
        its height over the magnets' middles. In the frame ``"site"``, or ``"tag-<id>"`` of
        the one tag.
    odometry : Trajectory or None
        In the frame ``"odom"``, which is the array's at the start.
    crossings : tuple of Crossing
        In the order of time.
    magnets : Discs
        As they truly lie, in the frame of the truth.
    built : mapping of int to AsBuilt
        The same by tag, against the design: ``replace(tags, built=simulated.built)`` knows
        all but their strength.
    debris : Debris
    saturated : int
        Readings beyond the range.
    lost : int
        Frames that never arrived.
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
    """Drive an array over tags (default: the paper's).

    The same tags and options give the same session.

    Raises
    ------
    InputError
        A tag of the route is not of the family or not on the site, the array would hit the
        magnets, or the session would be endless.
    """
    tags, options = tags or Tags(), options or SimulationOptions()
    ground = floor(tags, options)
    course = _course(tags, [ground.site[tag_id] for tag_id in ground.route], options)
    # A delay may be negative; the first sample is taken when the drive has begun.
    begin_s = max(0.0, -float(options.array.delay_s.min()))
    frames = (course.duration_s - begin_s) * options.rate_hz + 1
    if not 2 <= frames <= LARGEST_SESSION:
        raise InputError(
            f"a simulation of {frames:.0f} frames", hint="Change the rate, the speed or the route"
        )
    time_s = begin_s + np.arange(int(frames)) / options.rate_hz
    time_ns = _stamps(time_s)
    read, saturated = measure(
        _seen(course, time_s, ground, options),
        options.array,
        options.rate_hz,
        Faults(options.offset_t, options.drift_t, options.dead, options.stuck, options.clipped),
        options.seed,
    )
    kept = received(len(time_s), options.lost, options.seed)
    place, heading = course.pose(time_s)
    truth = Trajectory(
        options.device,
        ground.frame,
        time_ns,
        place,
        quaternion_from_heading(heading),
        np.zeros((len(time_s), 6, 6)),
    )
    return SimulatedSession(
        samples=Samples(options.device, options.array, time_ns[kept], read[kept]),
        tags=tags,
        truth=truth,
        odometry=_odometry(time_ns, place, heading, options) if options.odometry else None,
        crossings=_crossings(tags, ground.site, course, options.array.position_m),
        magnets=ground.discs,
        built=ground.built,
        debris=ground.debris,
        saturated=saturated,
        lost=int(np.count_nonzero(~kept)),
    )


def _stamps(time_s: Array) -> NDArray[np.int64]:
    return EPOCH_NS + np.rint(time_s * 1e9).astype(np.int64)


# ---- the drive


def _course(tags: Tags, at: Sequence[PlanarPose], options: SimulationOptions) -> Course:
    """The way over tags that lie there."""
    clearance = tags.clearance_m if options.clearance_m is None else options.clearance_m
    lowest = clearance - options.height_wobble_m
    top = tags.magnet.height_m / 2 + (options.debris_size_m if options.debris else 0.0)
    if not lowest > top:
        raise InputError(
            f"sensors down to {lowest * 1e3:.3g} mm over the magnets' middles, where "
            f"{'debris' if options.debris else 'a magnet'} reaches {top * 1e3:.3g} mm",
            hint="Give more clearance",
        )
    width = (tags.order - 1) * tags.spacing_m
    rim = width / np.sqrt(2)
    run_up = RUN_UP_CLEARANCES * clearance if options.run_up_m is None else options.run_up_m
    return Course(
        line(_stops(at, options), rim + run_up, rim + 2 * clearance),
        Drive(options.speed_mps, options.rest_s, options.acceleration_mps2, options.speed_wobble),
        width,
        clearance,
        options.crab_rad,
        options.yaw_wobble_rad,
        options.height_wobble_m,
        np.random.default_rng([options.seed, 22]),
    )


def _stops(at: Sequence[PlanarPose], options: SimulationOptions) -> list[PlanarPose]:
    """Where the array's middle crosses each tag, and which way it goes there."""
    middle = np.array([[tag.x_m, tag.y_m] for tag in at])
    stops = []
    for k, tag in enumerate(at):
        if options.heading_rad is not None or len(at) == 1:
            heading = tag.heading_rad + (options.heading_rad or 0.0)
        else:
            along = middle[min(k + 1, len(at) - 1)] - middle[max(k - 1, 0)]
            heading = float(np.arctan2(along[1], along[0]))
        x = tag.x_m - options.lateral_m * np.sin(heading)
        y = tag.y_m + options.lateral_m * np.cos(heading)
        stops.append(PlanarPose(float(x), float(y), heading))
    return stops


def _crossings(
    tags: Tags, site: Mapping[int, PlanarPose], course: Course, sensors: Array
) -> tuple[Crossing, ...]:
    """Tags of which a cell may pass under the bar, in the order of time."""
    half = (tags.order - 1) / 2 * tags.spacing_m
    square = half * np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]])
    right, left = sensors[:, 1].min(), sensors[:, 1].max()
    found = []
    for tag_id, at in site.items():
        for time_s in course.crossings(at.x_m, at.y_m):
            place, heading = course.pose(np.array(time_s))
            y = (on_floor(at, square) - place[:2]) @ [-np.sin(heading), np.cos(heading)]
            if y.max() < right or left < y.min():
                continue
            turned = at.heading_rad - heading
            found.append(
                Crossing(
                    tag_id,
                    int(_stamps(time_s)),
                    float(y[0]),
                    float(np.arctan2(np.sin(turned), np.cos(turned))),
                    bool(right <= y.min() and y.max() <= left),
                )
            )
    return tuple(sorted(found, key=lambda crossing: crossing.time_ns))


# ---- what is measured


def _seen(course: Course, time_s: Array, ground: Floor, options: SimulationOptions) -> Array:
    """True field (n, N, 3) in the array's axes, each axis at the time of its conversion."""
    array = options.array
    seen = np.empty((len(time_s), len(array), 3))
    for axis, delay_s in enumerate(array.delay_s):
        place, heading = course.pose(time_s + delay_s)
        axes = _axes(heading)
        sensors = place[:, None] + np.einsum("nij,sj->nsi", axes, array.position_m)
        seen[..., axis] = np.einsum("nsi,ni->ns", ground.field(sensors), axes[..., axis])
        if options.motor_t > 0:
            throttle = _throttle(course, time_s + delay_s) / options.speed_mps
            motors = motor_field(
                throttle, array.position_m, options.motor_t, options.motor_gradient, options.seed
            )
            seen[..., axis] += motors[..., axis]
    return seen


def _axes(heading: Array) -> Array:
    """Rotations (n, 3, 3) from the array's frame to the floor's."""
    cos, sin = np.cos(heading), np.sin(heading)
    axes = np.zeros((len(heading), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = cos
    axes[:, 1, 0], axes[:, 0, 1] = sin, -sin
    axes[:, 2, 2] = 1.0
    return axes


def _throttle(course: Course, time_s: Array) -> Array:
    """How hard the motors work (n,), as the speed that takes as much; 0 at rest."""
    speed = course.speed(time_s)
    gained = speed - course.speed(np.maximum(time_s - THROTTLE_S, 0.0))
    return np.where(speed > 0, np.maximum(speed + gained, 0.0), 0.0)


def _odometry(
    time_ns: NDArray[np.int64], place: Array, heading: Array, options: SimulationOptions
) -> Trajectory:
    """Poses as wheels tell them: too long, and turned away by and by."""
    step = np.diff(place[:, :2], axis=0) @ [1, 1j]
    rng = np.random.default_rng([options.seed, 23])
    wandered = np.cumsum(
        options.odometry_turn_rad * np.sqrt(abs(step)) * rng.normal(size=step.size)
    )
    error = np.r_[0.0, wandered] - heading[0]
    told = np.r_[0.0, np.cumsum((1 + options.odometry_scale) * step * np.exp(1j * error[1:]))]
    way = np.r_[0.0, np.cumsum(abs(step))]
    turned = options.odometry_turn_rad**2 * way
    covariance = np.zeros((len(way), 6, 6))
    # A heading that walks off by s a root metre leads s^2 way^3 / 3 aside.
    covariance[:, 0, 0] = (options.odometry_scale * way) ** 2
    covariance[:, 1, 1] = turned * way**2 / 3
    covariance[:, 5, 5] = turned
    return Trajectory(
        options.device,
        "odom",
        time_ns,
        np.column_stack([told.real, told.imag, np.zeros(len(way))]),
        quaternion_from_heading(heading + error),
        covariance,
    )
