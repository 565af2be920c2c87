"""What is simulated, and within which bounds."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from locatk.core.errors import InputError
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.mlx90393 import Settings, published_bar, settings_for_rate
from locatk.core.polaris.tag import Magnet, Tags
from locatk.core.simulation import check_options


def usual_bar(
    count: int = 9,
    spacing_m: float = 0.020,
    rate_hz: float = 100.0,
    noise_t: float | None = 0.5e-6,
    gain: int = 7,
    resolution: int = 0,
) -> SensorArray:
    """A bar of MLX90393 that convert for as long as the rate allows (default: the paper's).

    ``noise_t`` is of each axis; None for the measured one of the published recordings.

    Raises
    ------
    InputError
        The part has no such gain or resolution, or is not that quick.
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
    """A set-up of the paper.

    Attributes
    ----------
    tags : Tags
        A tag as it drove over, without ids.
    sensors : int
    spacing_m : float
        Between its sensors.
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
"""The robot car and the miniature car (Polaris sections 7, 8.2 and 8.4)."""


@dataclass(frozen=True)
class SimulationOptions:
    """What to simulate. The defaults are the paper's set-up (sections 7 and 8.2).

    Attributes
    ----------
    array : SensorArray
        Its noise, delays, counts and range are simulated, and told in the session.
    rate_hz : float
    route : tuple of int
        Tags in the order in which they are crossed, none twice in a row; where it is
        empty, all of the site, or the first of the family.
    heading_rad : float or None
        Direction of travel over each tag, in the tag's frame; None for straight ahead (0)
        over a single tag, and along the route over several.
    lateral_m : float
        How far to the left of the tags' middles the array's middle passes.
    run_up_m : float or None
        From the start to the first tag's rim, and from the last one's to the end; None
        for ten clearances.
    speed_mps, rest_s, acceleration_mps2, speed_wobble
        See :class:`~locatk.core.polaris.simulation.paths.Drive`.
    crab_rad, yaw_wobble_rad : float
        From the way the array goes to the way it points: for ever, and up and down.
    clearance_m : float or None
        From the magnets' middles to the sensors; None for the tags' own.
    height_wobble_m : float
        By how much it goes up and down.
    build_angle_rad, build_place_m, build_strength : float
        Standard deviations of how the magnets were built: direction, place along each
        axis, and remanence as a share.
    build_seed : int
        Tags of the same seed are the same in every session.
    earth_t, dip_rad, north_rad : float
        The Earth's field, how much it dips, and where magnetic north is in the frame.
    offset_t, drift_t, dead, stuck, clipped
        See :class:`~locatk.core.polaris.simulation.sensors.Faults`.
    lost : float
        Share of the frames that never arrive.
    debris : int
        Iron bits on and around each tag of the route.
    debris_size_m : float
        Diameter of the largest.
    debris_magnetised : float
        Share of them that keeps a magnetisation of its own.
    motor_t : float
        Field of the motors at the bar's middle, at the speed driven.
    motor_gradient : float
        By which share that grows in a metre along the bar.
    odometry : bool
        Whether the robot has one.
    odometry_scale : float
        By which share it tells too much.
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
        above_0, from_0, share = "a number above 0", "0 or more", "0 to below 1"
        check_options(
            self,
            (
                ("array", len(self.array) >= 1, "one sensor or more"),
                ("array", bool(np.all(self.array.noise_t >= 0)), "one whose noise is known"),
                ("rate_hz", 0 < self.rate_hz < np.inf, above_0),
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
                *(
                    (name, bool(np.isfinite(getattr(self, name) or 0.0)), "a number")
                    for name in (
                        "heading_rad",
                        "lateral_m",
                        "crab_rad",
                        "yaw_wobble_rad",
                        "dip_rad",
                        "north_rad",
                        "motor_gradient",
                    )
                ),
                ("run_up_m", self.run_up_m is None or 0 < self.run_up_m < np.inf, above_0),
                ("speed_mps", 0 < self.speed_mps < np.inf, above_0),
                ("rest_s", 0 <= self.rest_s < np.inf, from_0),
                (
                    "acceleration_mps2",
                    self.acceleration_mps2 is None or 0 < self.acceleration_mps2 < np.inf,
                    above_0,
                ),
                ("speed_wobble", 0 <= self.speed_wobble <= 0.9, "0 to 0.9"),
                (
                    "clearance_m",
                    self.clearance_m is None or 0 < self.clearance_m < np.inf,
                    above_0,
                ),
                ("height_wobble_m", 0 <= self.height_wobble_m < np.inf, from_0),
                ("build_angle_rad", 0 <= self.build_angle_rad < np.inf, from_0),
                ("build_place_m", 0 <= self.build_place_m < np.inf, from_0),
                ("build_strength", 0 <= self.build_strength <= 0.2, "0 to 0.2"),
                ("build_seed", self.build_seed >= 0, from_0),
                ("earth_t", 0 <= self.earth_t < np.inf, from_0),
                ("offset_t", 0 <= self.offset_t < np.inf, from_0),
                ("drift_t", 0 <= self.drift_t < np.inf, from_0),
                ("dead", set(self.dead) <= set(sensors), f"sensors of {sensors}"),
                ("stuck", set(self.stuck) <= set(sensors), f"sensors of {sensors}"),
                ("lost", 0 <= self.lost < 1, share),
                ("debris", 0 <= self.debris <= 10_000, "0 to 10000"),
                ("debris_size_m", 0 < self.debris_size_m < np.inf, above_0),
                ("debris_magnetised", 0 <= self.debris_magnetised <= 1, "0 to 1"),
                ("motor_t", 0 <= self.motor_t < np.inf, from_0),
                ("odometry_scale", -0.5 < self.odometry_scale < 1, "-0.5 to 1"),
                ("odometry_turn_rad", 0 <= self.odometry_turn_rad < np.inf, from_0),
                ("seed", self.seed >= 0, from_0),
            ),
        )
