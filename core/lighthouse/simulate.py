"""Sweeps of robots that drive under stations, with all that is true of them.

What is simulated is time: each station turns its own rotor, and each sweep is the moment
at which a light plane meets a robot that moves meanwhile. Reports, epochs, corrections of
angles, and whatever else a solver takes for granted are not used here. Not simulated are
sweeps that two stations send at once, of which a receiver loses one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.lighthouse.angles import ROTOR_ZERO
from locatk.core.lighthouse.calibration import (
    CURVE,
    GIBMAG,
    GIBPHASE,
    IDEAL,
    OGEEMAG,
    OGEEPHASE,
    PHASE,
    TILT,
    Calibration,
    predict_angles,
)
from locatk.core.lighthouse.channels import TICK_HZ, period_counts, period_ticks
from locatk.core.lighthouse.generic import GENERIC, UNITS
from locatk.core.lighthouse.scene import Marker, Scene, Sighting, Station
from locatk.core.lighthouse.sweeps import UNKNOWN, Sweeps
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Places = Callable[[Array], Array]
"""From times (...) in seconds to points (..., 3) in metres."""

EPOCH_NS = 1_767_225_600_000_000_000
"""Start of every simulated session: 2026-01-01T00:00:00Z."""

CALIBRATIONS = ("units", "generic", "ideal")
TRUTH_HZ = 100.0
FLOOR_M = 1.8
"""Width of the square in which robots drive, in metres: a floor of 2 m less a margin."""

WALL_M = 2.5
"""Distance of the walls that reflect, from the middle of the floor, in metres."""

CONE_RAD = np.radians([75.0, 50.0])
"""Azimuth and elevation to which a station's light reaches. The maker says 150 by 110
degrees; at the very edge the beam is too weak."""

STAND_S, CARRY_S = 2.0, 1.0
"""Time on each marker, and from one to the next: carried by a hand that hides the robot."""

FLAT_MARKERS = np.array([[0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0], [-0.5, -0.5, 0.0]])
RAISED_MARKERS = np.array(
    [[0.5, -0.5, 0.0], [0.5, 0.5, 0.5], [-0.5, 0.5, 0.0], [-0.5, -0.5, 0.5], [0.0, 0.0, 0.25]]
)
"""Markers in metres: a square of 1 m on the floor; five points of which no four share a
plane but the middle one with each diagonal."""

JUMP_RAD = np.radians([2.0, 60.0])
"""Size of demodulation errors (paper IV.A: more than 2 degrees for a single step)."""


@dataclass(frozen=True)
class SimulationOptions:
    """What to simulate; the same options give the same arrays.

    Attributes
    ----------
    robots : int
        At least 1. The first stands on the markers before it drives.
    stations : int
        1 to 16, on channels 1, 2, ...
    planar : bool
        Robots on the floor z = 0, or moved through the half metre above it.
    duration_s : float
        Length of the session. The markers take 12 s (15 s where not planar), or half of
        a shorter session.
    report_hz : float
        How often a robot reports the last pair of sweeps of each station.
    noise_rad : float
        Standard deviation of a rotor angle. The default are the 300 microdegrees of the
        paper's IV.A, far below an LFSR step (52 microrad); published standing receivers
        scatter by 115 microrad.
    occlusion : float
        Share of the time in which a station is hidden from a robot, 0 to below 1.
    outliers : float
        Share of the sweeps that are wrong, 0 to below 1.
    calibration : str
        ``"units"``: each station has the factory calibration of another real unit.
        ``"generic"``: all have their mean. ``"ideal"``: plain planes at 30 degrees.
    labelled : bool
        Whether polynomials are known.
    seed : int
        At least 0.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    robots: int = 1
    stations: int = 2
    planar: bool = True
    duration_s: float = 30.0
    report_hz: float = 10.0
    noise_rad: float = float(np.radians(300e-6))
    occlusion: float = 0.0
    outliers: float = 0.0
    calibration: str = "units"
    labelled: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        ranges = (
            ("robots", self.robots >= 1, "at least 1"),
            ("stations", 1 <= self.stations <= 16, "1 to 16"),
            ("duration_s", 0 < self.duration_s < np.inf, "above 0"),
            ("report_hz", 0 < self.report_hz < np.inf, "above 0"),
            ("noise_rad", 0 <= self.noise_rad < np.inf, "0 or more"),
            ("occlusion", 0 <= self.occlusion < 1, "0 to below 1"),
            ("outliers", 0 <= self.outliers < 1, "0 to below 1"),
            ("calibration", self.calibration in CALIBRATIONS, "one of " + ", ".join(CALIBRATIONS)),
            ("seed", self.seed >= 0, "0 or more"),
        )
        for name, fits, wanted in ranges:
            if not fits:
                raise InputError(
                    f"{name} of a simulation is {getattr(self, name)!r}", hint=f"give {wanted}"
                )


@dataclass(frozen=True)
class Simulated:
    """A session that never was.

    Attributes
    ----------
    sweeps : Sweeps
        Ascending in time. Which plane a sweep was is not told, as in a DotBot's reports.
    scene : Scene
        What a user would know before solving: markers and when robot 1 stood on them.
    truth : tuple of Trajectory
        True poses at 100 Hz, one a robot; x points along the path.
    stations : Scene
        The same scene with the true stations.
    wrong : (n,) bool ndarray
        Which of the sweeps were made outliers.
    """

    sweeps: Sweeps
    scene: Scene
    truth: tuple[Trajectory, ...]
    stations: Scene
    wrong: NDArray[np.bool_]


def simulate(options: SimulationOptions | None = None) -> Simulated:
    """Simulate a session.

    Notes
    -----
    A plane with rotor angle a(t) = 2 pi (t - t0) / T meets a robot at p(t) when a(t) is the
    angle at which the plane passes p, which the station's calibration bends. The count is
    the time since the rotor's zero in steps of the station's own 6 MHz clock, so that the
    error of that clock shows in times only.
    """
    options = options or SimulationOptions()
    # A stream of random numbers for each matter: more noise leaves the paths as they are.
    layout, driving, timing, noise, hiding, faults = (
        np.random.default_rng(s) for s in np.random.SeedSequence(options.seed).spawn(6)
    )
    width = len(str(options.robots))
    devices = tuple(f"robot-{k + 1:0{width}d}" for k in range(options.robots))
    markers = FLAT_MARKERS if options.planar else RAISED_MARKERS
    courses = [
        _Course(driving, options, markers if k == 0 else markers[:0]) for k in range(options.robots)
    ]
    rotors = [_Rotor(channel, layout, options) for channel in range(1, options.stations + 1)]
    layout_units = layout.permutation(len(UNITS))
    stations = tuple(
        _station(
            k, layout, _calibration(options.calibration, layout_units[k % len(UNITS)]), options
        )
        for k in range(options.stations)
    )
    pairs = [
        _pairs_of(course, station, rotor, options, (timing_of, noise, hiding), (k, i))
        for k, (course, timing_of) in enumerate(
            zip(courses, timing.spawn(len(courses)), strict=True)
        )
        for i, (station, rotor) in enumerate(zip(stations, rotors, strict=True))
    ]
    ...
