"""Options of a simulated robot on landmarks, and their valid ranges."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, fields, replace
from enum import IntEnum

from locatk.core.landmarks.halls import NAMES, HallSensors
from locatk.core.landmarks.landmark import PATTERNS
from locatk.core.landmarks.map.floor import Cell
from locatk.core.landmarks.simulation.robot import RobotLimits
from locatk.core.simulation import check_options


class RandomSource(IntEnum):
    """Sources of random errors, each with a stream of its own."""

    GAINS = 10
    NOISE = 11
    STRATEGY = 20
    ODOMETRY = 21
    STUDY_CODES = 30
    STUDY_PATHS = 31
    STUDY_BARS = 32
    STUDY_READINGS = 33
    STUDY_WHEELS = 34
    LANDMARK = 40


PASS_LENGTH_M = 0.23
"""Length of one of the paper's passes, twice :data:`START_RADIUS_M`."""

START_RADIUS_M = 0.115
"""Radius of the circle of starts of the paper's passes (section 3.5.1)."""

MAX_HEADING_OFFSET_RAD = math.pi / 4
"""Largest angle between the heading of a pass and the direction of the landmark's centre."""

STRATEGIES = ("paper", "published", "path", "pass")


MAX_LANDMARKS = 10_000
"""Most landmarks that a robot visits. At a few seconds each, the sensors take about a million
samples."""

MAX_WAYPOINT_M = 1000.0
"""Largest coordinate of a waypoint [m]. At 0.1 m/s and 200 Hz, a drive over this distance has two
million samples."""


@dataclass(frozen=True)
class Errors:
    """Errors of sensors, landmarks and odometry: standard deviations, unless stated otherwise.

    The defaults are assumptions for inexpensive parts: no recordings of such a floor are published.

    Attributes
    ----------
    noise_t : float
        Noise of a sample.
    offset_t, gain : float
        Offset of each sensor, and relative error of its gain.
    earth_t : float
        Vertical component of the Earth's field, positive upward: a value, the same everywhere.
    quantum_t : float
        Resolution of a reading; 0 for none.
    height_m : float
        Height of all sensors above their nominal height: a value.
    bar_strength : float
        Relative error of the strength of each bar.
    bar_place_m, bar_turn_rad, bar_lean_rad : float
        Errors of each bar: position along both axes of the floor, rotation about the vertical, and
        rotation about the two horizontal axes.
    landmark_place_m, landmark_turn_rad : float
        Errors of each landmark as a whole: position along both axes, rotation about the vertical.
    odometry_scale, odometry_turn : float
        Relative errors of distances and of rotations, constant for a session.
    odometry_drift_rad_per_m : float
        Drift of the heading, constant for a session.
    wheel_noise_m : float
        Error of the distance of each wheel after a metre, as a random walk.
    slips_per_m, slip_m : float
        Mean number of slips in a metre of the wheels, and excess distance of the wheel in a slip:
        values.
    """

    noise_t: float = 0.15e-3
    offset_t: float = 0.1e-3
    gain: float = 0.03
    earth_t: float = -45e-6
    quantum_t: float = 0.0
    height_m: float = 0.0
    bar_strength: float = 0.04
    bar_place_m: float = 0.5e-3
    bar_turn_rad: float = 0.0
    bar_lean_rad: float = 0.0
    landmark_place_m: float = 1e-3
    landmark_turn_rad: float = math.radians(0.5)
    odometry_scale: float = 0.01
    odometry_turn: float = 0.01
    odometry_drift_rad_per_m: float = math.radians(1) / PASS_LENGTH_M
    wheel_noise_m: float = 0.2e-3
    slips_per_m: float = 0.0
    slip_m: float = 0.005

    def __post_init__(self) -> None:
        signed = ("earth_t", "height_m")
        check_options(
            self,
            (
                (
                    item.name,
                    math.isfinite(value := getattr(self, item.name))
                    and (item.name in signed or value >= 0),
                    "a number" if item.name in signed else "0 or more",
                )
                for item in fields(self)
            ),
        )

    def scaled(self, factor: float) -> Errors:
        """Return the errors multiplied by ``factor``, except the Earth's field."""
        return replace(
            self,
            **{
                item.name: factor * getattr(self, item.name)
                for item in fields(self)
                if item.name != "earth_t"
            },
        )


NONE = Errors(**{item.name: 0.0 for item in fields(Errors)})
"""No errors, and no field of the Earth."""


@dataclass(frozen=True)
class Faults:
    """Faults of landmarks and sensors.

    Attributes
    ----------
    flipped, missing : tuple of (cell, bar)
        Bars with exchanged poles, and bars that are missing.
    displaced : tuple of (cell, (dx, dy))
        Landmarks with a displacement in metres of the map's frame.
    misread_rate : float
        Probability that a landmark is installed as another one of the alphabet.
    dead, stuck : tuple of str
        Sensors that give nothing, and that always give their offset.
    swapped : tuple of (name, name)
        Sensors with exchanged wires.
    """

    flipped: tuple[tuple[Cell, int], ...] = ()
    missing: tuple[tuple[Cell, int], ...] = ()
    displaced: tuple[tuple[Cell, tuple[float, float]], ...] = ()
    misread_rate: float = 0.0
    dead: tuple[str, ...] = ()
    stuck: tuple[str, ...] = ()
    swapped: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Aims:
    """Errors of the targets to which the robot drives; no solver is involved.

    Attributes
    ----------
    first_m, second_m, step_m : float
        Mean distance between a landmark's centre and the target: after the first pass, after a
        spin, and from landmark to landmark or on a path. The defaults are close to the results of
        the paper (sections 3.5.2 and 5.2.2).
    heading_rad : float
        Standard deviation of the heading after the alignment with a landmark (5.2.3).
    """

    first_m: float = 0.007
    second_m: float = 0.002
    step_m: float = 0.003
    heading_rad: float = math.radians(1.0)


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulated session.

    Attributes
    ----------
    strategy : str
        One of :data:`STRATEGIES`. ``"paper"``: search, spin, compensate, and on to the
        neighbours of the map's window (Fig. 12), steered by the truth and by ``aims``.
        ``"published"``: the same, by the sensors and the odometry alone. ``"path"``: straight
        from waypoint to waypoint. ``"pass"``: one straight pass over one landmark (section 3.5).
    start : (x, y, heading) or None
        Of the strategies ``paper`` and ``published``; None for anywhere between the landmarks.
    landmarks : int or None
        How many it visits (``published``: reads in a row); None for as many as the map's
        window has.
    spins : int or None
        At how many of these it spins, the others being passed with a stop; None for those
        of the window.
    waypoints : tuple of (x, y)
        Of the strategy ``path``, in metres of the map's frame.
    cells : tuple of cell
        Or the same as cells, which the robot hits as well as its aims allow.
    cell : (row, column) or None
        Of the strategy ``pass``; None for any (of that pattern).
    pattern : str
        Of the strategy ``pass``: one of the six patterns, ``""`` for any.
    lateral_m : float or None
        By how far it passes left of the centre; None for a heading within 45 degrees.
    approach_rad : float or None
        Where on the circle of starts it begins, in the map's frame; None for anywhere.
    limits : RobotLimits
    aims : Aims
    errors : Errors
    faults : Faults
    sensors : HallSensors or None
        None for four on the circle of the map's geometry.
    range_t : float
        Largest field that they measure if ``sensors`` is None.
    rate_hz, odometry_hz : float
        Rates of the samples and of the odometry.
    rest_s, stop_s : float
        Rests at the start and at the end, and on each landmark.
    device : str
    seed : int
    floor_seed : int or None
        Seed of the errors of the floor, for several drives over the same floor; None for ``seed``.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    strategy: str = "paper"
    start: tuple[float, float, float] | None = None
    landmarks: int | None = None
    spins: int | None = None
    waypoints: tuple[tuple[float, float], ...] = ()
    cells: tuple[Cell, ...] = ()
    cell: Cell | None = None
    pattern: str = ""
    lateral_m: float | None = None
    approach_rad: float | None = None
    limits: RobotLimits = field(default_factory=RobotLimits)
    aims: Aims = field(default_factory=Aims)
    errors: Errors = field(default_factory=Errors)
    faults: Faults = field(default_factory=Faults)
    sensors: HallSensors | None = None
    range_t: float = math.inf
    rate_hz: float = 200.0
    odometry_hz: float = 50.0
    rest_s: float = 0.5
    stop_s: float = 0.5
    device: str = "robot"
    seed: int = 0
    floor_seed: int | None = None

    def __post_init__(self) -> None:
        above_0, from_0 = "a number above 0", "0 or more"
        names = self.sensors.names if self.sensors else NAMES
        faults = self.faults
        told = {*faults.dead, *faults.stuck, *(name for pair in faults.swapped for name in pair)}
        path = self.strategy == "path"
        check_options(
            self,
            (
                ("strategy", self.strategy in STRATEGIES, f"one of {', '.join(STRATEGIES)}"),
                ("start", _finite(self.start), "three numbers"),
                (
                    "landmarks",
                    self.landmarks is None or 1 <= self.landmarks <= MAX_LANDMARKS,
                    f"1 to {MAX_LANDMARKS}",
                ),
                ("spins", self.spins is None or self.spins >= 0, from_0),
                ("waypoints", all(map(_finite, self.waypoints)), "numbers"),
                (
                    "waypoints",
                    all(
                        abs(value) <= MAX_WAYPOINT_M for point in self.waypoints for value in point
                    ),
                    f"at most {MAX_WAYPOINT_M:g} m from the origin of the map",
                ),
                ("waypoints", not (self.waypoints and self.cells), "waypoints or cells"),
                (
                    "waypoints",
                    not path or len(self.waypoints or self.cells) >= 2,
                    "two waypoints or cells, or more",
                ),
                (
                    "pattern",
                    self.pattern in ("", *PATTERNS),
                    f"one of {', '.join(PATTERNS)}",
                ),
                (
                    "lateral_m",
                    self.lateral_m is None or abs(self.lateral_m) <= START_RADIUS_M,
                    f"at most {START_RADIUS_M * 1e3:g} mm either way",
                ),
                (
                    "approach_rad",
                    self.approach_rad is None or math.isfinite(self.approach_rad),
                    "a number",
                ),
                ("limits", all(0 < value < math.inf for value in astuple(self.limits)), above_0),
                ("aims", all(0 <= value < math.inf for value in astuple(self.aims)), from_0),
                ("faults", 0 <= faults.misread_rate <= 1, "a misread_rate of 0 to 1"),
                ("faults", told <= set(names), f"sensors of {', '.join(names)}"),
                ("range_t", self.range_t > 0, above_0),
                ("rate_hz", 0 < self.rate_hz < math.inf, above_0),
                ("odometry_hz", 0 < self.odometry_hz < math.inf, above_0),
                ("rest_s", 0 <= self.rest_s < math.inf, from_0),
                ("stop_s", 0 <= self.stop_s < math.inf, from_0),
                (
                    "errors",
                    self.strategy != "published" or self.errors.slips_per_m == 0,
                    "without slips for the strategy published",
                ),
                ("seed", self.seed >= 0, from_0),
                ("floor_seed", self.floor_seed is None or self.floor_seed >= 0, from_0),
            ),
        )


def _finite(values: tuple[float, ...] | None) -> bool:
    return values is None or all(map(math.isfinite, values))
