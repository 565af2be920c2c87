"""Options of a simulated pass over tags, and their valid ranges."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise

import numpy as np

from locatk.core.errors import InputError
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.mlx90393 import Settings, published_bar, settings_for_rate
from locatk.core.polaris.tag import Magnet, Tags
from locatk.core.simulation import (
    check_options,
    require_finite,
    require_fraction,
    require_fraction_below_1,
    require_not_negative,
    require_positive,
)


class RandomSource(IntEnum):
    """Sources of random errors, each with a stream of its own."""

    OFFSETS = 10
    DRIFT = 11
    NOISE = 12
    LOSSES = 13
    MOTORS = 14
    TAG = 20
    DEBRIS = 21
    PATH = 22
    ODOMETRY = 23


def usual_bar(
    count: int = 9,
    spacing_m: float = 0.020,
    rate_hz: float = 100.0,
    noise_t: float | None = 0.5e-6,
    gain: int = 7,
    resolution: int = 0,
) -> SensorArray:
    """Return a bar of MLX90393 with the longest conversion of the rate (default: the paper's).

    ``noise_t`` is the standard deviation of each axis; None for that of the published recordings.

    Raises
    ------
    InputError
        The MLX90393 has no such gain or resolution, or is not that fast.
    """
    part = settings_for_rate(rate_hz, Settings(gain=gain, resolution=resolution))
    if part is None:
        raise InputError(
            f"no setting of the MLX90393 gives {rate_hz:g} Hz", hint="Give a lower rate"
        )
    noise = part.assumed_noise_t if noise_t is None else np.full(3, noise_t)
    return published_bar(count, spacing_m, part, noise)


@dataclass(frozen=True)
class Car:
    """Robot and tag of the paper.

    Attributes
    ----------
    tags : Tags
        Design of the tag, without ids.
    sensors : int
    spacing_m : float
        Distance between neighbouring sensors.
    rate_hz, speed_mps : float
    """

    tags: Tags
    sensors: int
    spacing_m: float
    rate_hz: float
    speed_mps: float


CARS = {
    "robot": Car(Tags(), 9, 0.020, 100.0, 0.1),
    "mini": Car(
        Tags(
            order=2, magnets=3, spacing_m=0.016, magnet=Magnet(diameter_m=1e-3), clearance_m=0.005
        ),
        3,
        0.008,
        17.0,
        0.005,
    ),
}
"""Robot car and miniature car of the paper (Polaris sections 7, 8.2 and 8.4)."""


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulated pass. The defaults are the paper's setup (sections 7 and 8.2).

    Attributes
    ----------
    array : SensorArray
        Its noise, delays, quantization and range are simulated, and recorded in the session.
    rate_hz : float
    route : tuple of int
        Tags in the order in which they are crossed, none twice in a row. If empty: all of the
        site, or the first of the family.
    heading_rad : float or None
        Direction of travel over each tag, in the tag's frame; None for straight ahead (0)
        over a single tag, and along the route over several.
    lateral_m : float
        Distance at which the array's middle passes left of the middles of the tags.
    run_up_m : float or None
        Distance from the start to the edge of the first tag, and from the edge of the last one to
        the end; None for ten clearances.
    speed_mps, rest_s, acceleration_mps2, speed_wobble
        See :class:`~locatk.core.polaris.simulation.paths.SpeedProfile`.
    crab_rad, yaw_wobble_rad : float
        Angle from the direction of travel to the array's x: constant part, and amplitude of its
        variation.
    clearance_m : float or None
        Height of the sensors above the middles of the magnets; None for that of the tags.
    height_wobble_m : float
        Amplitude of the variation of that height.
    build_angle_rad, build_place_m, build_strength : float
        Standard deviations of the errors of the magnets: direction, position along each axis, and
        relative remanence.
    build_seed : int
        Tags of the same seed are the same in every session.
    earth_t, dip_rad, north_rad : float
        Earth's field, its dip below the horizon, and direction of magnetic north in the frame.
    offset_t, drift_t, dead, stuck, clipped
        See :class:`~locatk.core.polaris.simulation.sensors.SensorFaults`.
    lost : float
        Fraction of the frames that never arrive.
    debris : int
        Number of iron bits on and around each tag of the route.
    debris_size_m : float
        Diameter of the largest bit.
    debris_magnetised : float
        Fraction of the bits with a remanent magnetisation.
    motor_t : float
        Field of the motors at the array's middle, at the speed driven.
    motor_gradient : float
        Relative growth of that field in a metre along the array.
    odometry : bool
        True if the robot records odometry.
    odometry_scale : float
        Relative error of its distances.
    odometry_turn_rad : float
        Standard deviation of its heading after a metre, as a random walk.
    device : str
    seed : int
        At least 0.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    array: SensorArray = field(default_factory=usual_bar)
    rate_hz: float = 100.0
    route: tuple[int, ...] = ()
    heading_rad: float | None = None
    lateral_m: float = 0.0
    run_up_m: float | None = None
    speed_mps: float = 0.1
    rest_s: float = 0.0
    acceleration_mps2: float | None = None
    speed_wobble: float = 0.0
    crab_rad: float = 0.0
    yaw_wobble_rad: float = 0.0
    clearance_m: float | None = None
    height_wobble_m: float = 0.0
    build_angle_rad: float = 0.0
    build_place_m: float = 0.0
    build_strength: float = 0.0
    build_seed: int = 0
    earth_t: float = 50e-6
    dip_rad: float = float(np.radians(65))
    north_rad: float = 0.0
    offset_t: float = 15e-6
    drift_t: float = 0.0
    dead: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    clipped: bool = False
    lost: float = 0.0
    debris: int = 0
    debris_size_m: float = 2e-3
    debris_magnetised: float = 0.3
    motor_t: float = 0.0
    motor_gradient: float = 1.0
    odometry: bool = False
    odometry_scale: float = 0.01
    odometry_turn_rad: float = float(np.radians(1))
    device: str = "bar"
    seed: int = 0

    def __post_init__(self) -> None:
        sensors = range(len(self.array))
        check_options(
            self,
            (
                ("array", len(self.array) >= 1, "one sensor or more"),
                ("array", bool(np.all(self.array.noise_t >= 0)), "one with a known noise"),
                *require_positive(
                    self,
                    "rate_hz",
                    "run_up_m",
                    "speed_mps",
                    "acceleration_mps2",
                    "clearance_m",
                    "debris_size_m",
                ),
                *require_not_negative(
                    self,
                    "rest_s",
                    "height_wobble_m",
                    "build_angle_rad",
                    "build_place_m",
                    "build_seed",
                    "earth_t",
                    "offset_t",
                    "drift_t",
                    "motor_t",
                    "odometry_turn_rad",
                    "seed",
                ),
                *require_finite(
                    self,
                    "heading_rad",
                    "lateral_m",
                    "crab_rad",
                    "yaw_wobble_rad",
                    "dip_rad",
                    "north_rad",
                    "motor_gradient",
                ),
                *require_fraction(self, "debris_magnetised"),
                *require_fraction_below_1(self, "lost"),
                (
                    "rate_hz",
                    float(np.ptp(self.array.delay_s)) * self.rate_hz < 1,
                    "a rate at which the axes are converted within a frame",
                ),
                (
                    "route",
                    all(one != next for one, next in pairwise(self.route)),
                    "another tag in between, or a session for each pass",
                ),
                ("speed_wobble", 0 <= self.speed_wobble <= 0.9, "0 to 0.9"),
                ("build_strength", 0 <= self.build_strength <= 0.2, "0 to 0.2"),
                ("dead", set(self.dead) <= set(sensors), f"sensors of {sensors}"),
                ("stuck", set(self.stuck) <= set(sensors), f"sensors of {sensors}"),
                ("debris", 0 <= self.debris <= 10_000, "0 to 10000"),
                ("odometry_scale", -0.5 < self.odometry_scale < 1, "-0.5 to 1"),
            ),
        )
