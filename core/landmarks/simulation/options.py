"""What is simulated, and within which bounds."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, fields, replace

from locatk.core.landmarks.halls import NAMES, HallSensors
from locatk.core.landmarks.landmark import PATTERNS
from locatk.core.landmarks.map.floor import Cell
from locatk.core.landmarks.simulation.robot import RobotLimits
from locatk.core.simulation import check_options

PASS_M = 0.23
"""Way of one pass in facts/landmarks.md 3, on which the heading drifts by one degree."""

START_M = 0.115
"""Radius of the circle of starts of the paper's passes (section 3.5.1)."""

ASIDE_RAD = math.pi / 4
"""How far their heading is off the landmark's centre, at most."""

STRATEGIES = ("paper", "published", "path", "pass")


@dataclass(frozen=True)
class Errors:
    """How large errors are: standard deviations, unless said otherwise.

    The defaults are the nominal ones of facts/landmarks.md 3, which has none of the wheels'
    turn, noise and slip, nor of how landmarks are placed.

    Attributes
    ----------
    noise_t : float
        Of a sample.
    offset_t, gain : float
        Of each sensor; the gain as a share.
    earth_t : float
        Upright part of the Earth's field, positive upward; itself and the same everywhere.
    quantum_t : float
        Least step of a reading; 0 for none.
    height_m : float
        By how much all sensors are too high; no standard deviation.
    bar_strength : float
        Of each bar, as a share.
    bar_place_m, bar_turn_rad, bar_lean_rad : float
        Of each bar: along both axes of the floor, about the upright, and about the two
        level axes.
    landmark_place_m, landmark_turn_rad : float
        Of each landmark as a whole, along both axes and about the upright.
    odometry_scale, odometry_turn : float
        By which share it tells too long a way, and too much of a turn, for a whole session.
    odometry_drift_rad_per_m : float
        By how much its heading turns away on a metre, for a whole session.
    wheel_noise_m : float
        Of the way of each wheel on a metre, as a random walk.
    slips_per_m, slip_m : float
        How often a wheel slips on a metre that the wheels go, and how far it turns too
        much then; no standard deviations.
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
    odometry_drift_rad_per_m: float = math.radians(1) / PASS_M
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
        """All errors ``factor`` times as large, but for the Earth's field."""
        return replace(
            self,
            **{
                item.name: factor * getattr(self, item.name)
                for item in fields(self)
                if item.name != "earth_t"
            },
        )


NONE = Errors(**{item.name: 0.0 for item in fields(Errors)})
"""No errors at all, and no Earth."""


@dataclass(frozen=True)
class Faults:
    """What is broken or wrong, beyond errors.

    Attributes
    ----------
    flipped, missing : tuple of (cell, bar)
        Bars that lie the wrong way round, and that do not lie there.
    displaced : tuple of (cell, (dx, dy))
        Landmarks that lie elsewhere, in metres of the map's frame.
    misread_rate : float
        Chance of a landmark to be laid as another one of the alphabet.
    dead, stuck : tuple of str
        Sensors that give nothing, and that give their offset for ever.
    swapped : tuple of (name, name)
        Sensors whose wires were exchanged.
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
    """How well the robot hits what it aims for, which it finds without any solver.

    Attributes
    ----------
    first_m, second_m, step_m : float
        Mean distance between a landmark's centre and where the robot takes it to be: after
        the first pass, after a spin, and where it comes from the last landmark or follows a
        path. The defaults are about what the paper reports (sections 3.5.2 and 5.2.2).
    heading_rad : float
        Standard deviation of its heading when it has aligned with a landmark (5.2.3).
    """

    first_m: float = 0.007
    second_m: float = 0.002
    step_m: float = 0.003
    heading_rad: float = math.radians(1.0)


@dataclass(frozen=True)
class SimulationOptions:
    """What to simulate.

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
        Greatest field that they tell, where ``sensors`` is None.
    rate_hz, odometry_hz : float
    rest_s, stop_s : float
        Standing at the start and at the end, and on each landmark.
    device : str
    seed : int
    floor_seed : int or None
        Of how the bars lie, where it is another one: several drives over the same floor.

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
                ("landmarks", self.landmarks is None or self.landmarks >= 1, "1 or more"),
                ("spins", self.spins is None or self.spins >= 0, from_0),
                ("waypoints", all(map(_finite, self.waypoints)), "numbers"),
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
                    self.lateral_m is None or abs(self.lateral_m) <= START_M,
                    f"at most {START_M * 1e3:g} mm either way",
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
