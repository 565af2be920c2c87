"""Sweeps of robots that drive under stations, with all that is true of them.

What is simulated is time: each station turns its own rotor, and each sweep is the moment
at which a light plane meets a robot that moves meanwhile. Nothing that a solver takes for
granted is used: neither that sweeps of a report belong to one moment nor corrected angles.
Not simulated are sweeps of two stations at once, of which a receiver loses one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading, rotation_exp
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    IDEAL_CALIBRATION,
    Calibration,
)
from locatk.core.lighthouse.channels import TICK_HZ, period_ticks
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene, Station
from locatk.core.lighthouse.simulation.faults import inject_faults
from locatk.core.lighthouse.simulation.optics import (
    OpticalLink,
    SimulatedStation,
    SweepPairs,
    observe_reports,
)
from locatk.core.lighthouse.simulation.paths import Course
from locatk.core.simulation import check_options
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EPOCH_NS = 1_767_225_600_000_000_000
"""Start of every simulated session: 2026-01-01T00:00:00Z."""

CALIBRATIONS = ("units", "generic", "ideal")

TRUTH_HZ = 100.0

CLOCK_PPM = 25.0
"""Clocks of stations are off by at most this."""

BLOCK_S = 1.0
"""Mean time for which something stands between a station and a robot."""

FLAT_MARKERS = np.array([[0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0], [-0.5, -0.5, 0.0]])
"""A square of 1 m on the floor."""

RAISED_MARKERS = np.vstack([FLAT_MARKERS + [[0, 0, 0], [0, 0, 0.5]] * 2, [[0.0, 0.0, 0.1]]])
"""The corners of that square, two of them raised, and a point over its middle."""


@dataclass(frozen=True)
class SimulationOptions:
    """What to simulate.

    Attributes
    ----------
    robots : int
        At least 1. The first stands on the markers before it drives.
    stations : int
        1 to 16, on channels 1, 2, ...
    planar : bool
        Robots on the floor z = 0, or moved through the half metre above it.
    duration_s : float
        Length of the session. The markers take 12 s of it (15 s in space), or half of a
        session that is shorter than twice that.
    report_hz : float
        How often a robot reports the last pair of sweeps of each station.
    noise_rad : float
        Standard deviation of a rotor angle. The default are the 300 microdegrees of the
        paper's IV.A, far below an LFSR step (52 microrad); the published standing receivers
        scatter by 115 microrad.
    occlusion : float
        Share of the time in which a station is hidden from a robot, 0 to below 1.
    outliers : float
        Share of the sweeps that are wrong, 0 to below 1: jumps, reflections, and sweeps of
        two stations taken for each other.
    calibration : str
        ``"units"``: each station has the factory calibration of another real unit.
        ``"generic"``: all have their mean. ``"ideal"``: plain planes at 30 degrees.
    labelled : bool
        Whether polynomials are known.
    receiver : Receiver, optional
        Each robot carries these photodiodes; without it, one in its middle.
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
    receiver: Receiver | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_options(
            self,
            (
                ("robots", self.robots >= 1, "at least 1"),
                ("stations", 1 <= self.stations <= 16, "1 to 16"),
                ("duration_s", 0 < self.duration_s < np.inf, "a number above 0"),
                ("report_hz", 0 < self.report_hz < np.inf, "a number above 0"),
                ("noise_rad", 0 <= self.noise_rad < np.inf, "0 or more"),
                ("occlusion", 0 <= self.occlusion < 1, "0 to below 1"),
                ("outliers", 0 <= self.outliers < 1, "0 to below 1"),
                (
                    "calibration",
                    self.calibration in CALIBRATIONS,
                    "one of " + ", ".join(CALIBRATIONS),
                ),
                ("seed", self.seed >= 0, "0 or more"),
            ),
        )


@dataclass(frozen=True)
class SimulatedSession:
    """A session that never was.

    Attributes
    ----------
    sweeps : Sweeps
        Ascending in time. As in a DotBot's reports, which plane a sweep was is not told.
    scene : Scene
        What a user knows before solving: markers, and when robot 1 stood on them.
    truth : tuple of Trajectory
        True poses at 100 Hz, one a robot; its x points along the path. None while robot 1
        is carried from marker to marker: there it is not received either.
    stations : Scene
        The same scene with the true stations.
    wrong : (n,) bool ndarray
        Which of the sweeps were made outliers.
    """

    sweeps: Sweeps
    scene: Scene
    truth: tuple[Trajectory, ...]
    stations: Scene
    wrong: Mask


def simulate(options: SimulationOptions | None = None) -> SimulatedSession:
    """Simulate a session; the same options give the same arrays.

    Notes
    -----
    A plane with rotor angle a(t) = 2 pi (t - t0) / T meets a robot at p(t) when a(t) is the
    angle at which the plane passes p, which the station's calibration bends. The count is
    the time since the rotor's zero in steps of the station's own clock, so that an error of
    that clock shows in times only.
    """
    options = options or SimulationOptions()
    # A stream of random numbers for each matter: more noise leaves the paths as they are.
    layout, driving, timing, jitter, hiding, faults = (
        np.random.default_rng(s) for s in np.random.SeedSequence(options.seed).spawn(6)
    )
    lights = _lights(layout, options)
    known = FLAT_MARKERS if options.planar else RAISED_MARKERS
    links: list[OpticalLink] = []
    parts: list[SweepPairs] = []
    courses = []
    for robot in range(options.robots):
        course = Course(driving, options.planar, options.duration_s, known[: 0 if robot else None])
        courses.append(course)
        reports_s = _report_times(timing, options)
        for light in lights:
            hidden = (course.carried_s, _blocks(hiding, options))
            for link in _links(robot, course, light, options.receiver):
                noise = jitter.normal(0.0, options.noise_rad, (len(reports_s), 2))
                links.append(link)
                parts.append(observe_reports(link, len(parts), reports_s, hidden, noise))
    pairs = SweepPairs.joined(parts)
    inject_faults(pairs, links, options.outliers, options.noise_rad, faults)

    digits = len(str(options.robots))
    names = tuple(f"robot-{k + 1:0{digits}d}" for k in range(options.robots))
    sweeps, wrong = _as_sweeps(pairs, links, names, options.labelled)
    scene = Scene(
        markers=_markers(known, names[0], courses[0].stands_s),
        planar=options.planar,
        scale="markers",
    )
    return SimulatedSession(
        sweeps,
        scene,
        tuple(_truth(n, c, options.duration_s) for n, c in zip(names, courses, strict=True)),
        replace(scene, stations=tuple(light.station for light in lights)),
        wrong,
    )


# ---- stations


def _lights(rng: np.random.Generator, options: SimulationOptions) -> list[SimulatedStation]:
    """Stations around the floor, 2 m from its middle, that look down at it."""
    count = options.stations
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / max(count, 3)
    azimuth = azimuth + np.radians(rng.uniform(-10, 10, count))
    units = np.resize(rng.permutation(len(FACTORY_UNITS)), count)
    lights = []
    for k in range(count):
        away = rng.uniform(1.9, 2.1)
        flat = away * np.array([np.cos(azimuth[k]), np.sin(azimuth[k])])
        place = np.append(flat, rng.uniform(1.5, 2.0))
        aim = np.append(rng.uniform(-0.15, 0.15, 2), 0.0)
        roll = rotation_exp([np.radians(rng.uniform(-4, 4)), 0.0, 0.0])
        calibration = {
            "units": _calibration_of(FACTORY_UNITS[units[k]]),
            "generic": GENERIC_CALIBRATION,
            "ideal": IDEAL_CALIBRATION,
        }[options.calibration]
        station = Station(k + 1, place, _looking(place, aim) @ roll, calibration)
        ppm = rng.uniform(-CLOCK_PPM, CLOCK_PPM)
        period_s = float(period_ticks(k + 1)) / TICK_HZ * (1 + ppm * 1e-6)
        bits = rng.integers(0, 2, int(options.duration_s / period_s) + 2)
        lights.append(SimulatedStation(station, -period_s * rng.random(), period_s, bits))
    return lights


def _looking(place: Array, aim: Array) -> Array:
    """Rotation (3, 3) of a station at ``place`` that looks at ``aim`` without roll."""
    forward = (aim - place) / np.linalg.norm(aim - place)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left = left / np.linalg.norm(left)
    return np.stack([forward, left, np.cross(forward, left)], axis=1)


def _calibration_of(unit: Array) -> Calibration:
    """Calibration of a row of :data:`~locatk.core.lighthouse.calibration.FACTORY_UNITS`."""
    tilt, curve, gibmag, gibphase, ogeemag, ogeephase = unit[1:].reshape(6, 2)
    phase = np.array([0.0, unit[0]])
    sweeps = np.stack([phase, tilt, curve, gibmag, gibphase, ogeemag, ogeephase], axis=1)
    return Calibration(sweeps, "factory")


# ---- robots


def _links(
    robot: int, course: Course, light: SimulatedStation, receiver: Receiver | None
) -> list[OpticalLink]:
    """One a photodiode."""
    if receiver is None:
        return [OpticalLink(robot, course, light)]
    normals = [None] * len(receiver) if receiver.normal is None else list(receiver.normal)
    return [
        OpticalLink(robot, course, light, k, offset, normal)
        for k, (offset, normal) in enumerate(zip(receiver.position_m, normals, strict=True))
    ]


def _report_times(rng: np.random.Generator, options: SimulationOptions) -> Array:
    """Ascending times (n,) of a robot's reports in seconds, a little irregular."""
    step = 1.0 / options.report_hz
    nominal = np.arange(rng.uniform(0, step), options.duration_s, step)
    return nominal - rng.uniform(0, 0.02 * step, len(nominal))


def _blocks(rng: np.random.Generator, options: SimulationOptions) -> Array:
    """Ascending starts and ends of the times in which a station is hidden, in seconds.

    Together they are exactly the share that was asked for.
    """
    hidden_s = options.occlusion * options.duration_s
    count = int(np.ceil(hidden_s / BLOCK_S))
    if count == 0:
        return np.zeros(0)
    edges = np.zeros(2 * count)
    edges[0::2] = rng.dirichlet(np.ones(count + 1))[:-1] * (options.duration_s - hidden_s)
    edges[1::2] = rng.dirichlet(np.full(count, 2.0)) * hidden_s
    return np.cumsum(edges)


# ---- what comes out


def _as_sweeps(
    pairs: SweepPairs, links: Sequence[OpticalLink], names: tuple[str, ...], labelled: bool
) -> tuple[Sweeps, Mask]:
    """The sweeps that were received in the order of time, and which of them are wrong."""
    seen = np.isfinite(pairs.count)
    time_ns = EPOCH_NS + np.rint(pairs.time_s[seen] * 1e9).astype(np.int64)
    order = np.argsort(time_ns, kind="stable")
    robot = np.array([link.robot for link in links], np.int32)[pairs.link]
    device = np.broadcast_to(robot[:, None], seen.shape)[seen][order]
    number = np.array([link.sensor for link in links], np.int32)[pairs.link]
    sensor = np.broadcast_to(number[:, None], seen.shape)[seen][order]
    unknown = np.full(len(order), UNKNOWN, np.int32)
    sweeps = Sweeps(
        devices=names,
        time_ns=time_ns[order],
        device=device,
        sensor=sensor,
        channel=pairs.channel[seen][order].astype(np.int32),
        polynomial=pairs.polynomial[seen][order].astype(np.int32) if labelled else unknown,
        sweep=unknown,
        count=pairs.count[seen][order],
    )
    return sweeps, pairs.wrong[seen][order]


def _markers(known: Array, device: str, stands_s: Array) -> tuple[Marker, ...]:
    """Markers, each seen while the device stood on it."""
    stands_ns = EPOCH_NS + np.rint(stands_s * 1e9).astype(np.int64)
    return tuple(
        Marker(f"marker-{k + 1}", place, (MarkerVisit(device, int(start), int(end)),))
        for k, (place, (start, end)) in enumerate(zip(known, stands_ns, strict=True))
    )


def _truth(device: str, course: Course, duration_s: float) -> Trajectory:
    """True poses of one robot, but for the times in which it is carried."""
    time_s = np.arange(int(np.ceil(duration_s * TRUTH_HZ)) + 1) / TRUTH_HZ
    time_s = time_s[np.searchsorted(course.carried_s, time_s) % 2 == 0]
    return Trajectory(
        device,
        "floor",
        EPOCH_NS + np.rint(time_s * 1e9).astype(np.int64),
        course.position(time_s),
        quaternion_from_heading(course.heading(time_s)),
        np.zeros((len(time_s), 6, 6)),
    )
