"""Simulation of a Lighthouse session: sweeps of moving robots, with ground truth.

Every sweep is simulated at its own time: each station rotates its rotor on its own clock, and a
sweep is the time at which a light plane crosses a photodiode that moves meanwhile. The
assumptions of the solver are not used: sweeps of a report are not simultaneous, and the planes
are those of real units. Not simulated are simultaneous sweeps of two stations, of which a real
receiver loses one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import rotation_exp
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    IDEAL_CALIBRATION,
    PHASE,
    TILT,
    Calibration,
)
from locatk.core.lighthouse.channels import TICK_HZ, period_ticks
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene, Station
from locatk.core.lighthouse.simulation.faults import (
    draw_intervals,
    inject_faults,
    reflect_in_runs,
)
from locatk.core.lighthouse.simulation.inertia import measure_inertia
from locatk.core.lighthouse.simulation.optics import (
    OpticalLink,
    SimulatedStation,
    SweepPairs,
    observe_reports,
)
from locatk.core.lighthouse.simulation.paths import DrivenPath, FlownPath, RobotPath
from locatk.core.lighthouse.simulation.rooms import RoomLight, RoomPath, mounted_stations
from locatk.core.simulation import (
    MAX_SAMPLES,
    check_options,
    check_session_size,
    require_finite,
    require_fraction_below_1,
    require_not_negative,
    require_positive,
    stamps_ns,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CALIBRATIONS = ("units", "generic", "ideal")
"""Choices of :attr:`SimulationOptions.calibration`."""

TRUTH_RATE_HZ = 100.0
"""Sampling rate of the ground truth [Hz]."""

MAX_CLOCK_ERROR_PPM = 25.0
"""Largest error of a station's clock, drawn uniformly [ppm]. Two stations of the published captures
are off by 15 and 19 ppm (rotation periods of DotBots/alvarado23lighthouse, benchmarks)."""

MEAN_OCCLUSION_S, MEAN_REFLECTION_S = 1.0, 0.5
"""Mean durations for which an obstacle is between a station and a robot, and for which a robot
receives the reflection of a station [s]."""

FLOOR_MARKERS_M = np.array([[0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0], [-0.5, -0.5, 0.0]])
"""(4, 3) markers of planar sessions: a square of 1 m on the floor."""

RAISED_MARKERS_M = np.vstack([FLOOR_MARKERS_M + [[0, 0, 0], [0, 0, 0.5]] * 2, [[0.0, 0.0, 0.1]]])
"""(5, 3) markers of sessions in space: the same square with two corners raised by 0.5 m, and a
point above its centre."""


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulated session.

    Attributes
    ----------
    robots : int
        Number of robots, at least 1. The first rests on the markers before it drives.
    stations : int
        Number of stations, 1 to 16, on channels 1, 2, ...
    planar : bool
        True for robots on the floor z = 0; otherwise they move up to half a metre above it.
    duration_s : float
        Duration of the session. The visit of the markers takes 12 s of it (15 s in space), or
        half of a session that is shorter than twice that.
    report_hz : float
        Rate at which a robot reports the last pair of sweeps of each station.
    noise_rad : float
        Standard deviation of a rotor angle. The default is the paper's 300 microdegrees (IV.A),
        far below an LFSR step (52 microradians). The published receivers at rest scatter by
        115 microradians (:data:`~locatk.core.lighthouse.noise.ANGLE_SIGMA_RAD`).
    occlusion : float
        Fraction of the time in which a station is hidden from a robot, 0 to below 1.
    outliers : float
        Fraction of the sweeps that are outliers, 0 to below 1: demodulation errors,
        reflections, and exchanged stations.
    calibration : str
        ``"units"``: each station has the factory calibration of another real unit.
        ``"generic"``: all have the mean of these. ``"ideal"``: undistorted planes at 30 degrees.
    labelled : bool
        True if the receiver reports polynomials.
    receiver : Receiver, optional
        Photodiodes that each robot carries. Default: one at its origin.
    flying : bool
        True for quadrotors, which tilt as they accelerate; not if ``planar``.
    speed_mps : float
        Bound of the speed of a flight, without take-off and landing, or of a robot in a room.
    imu_hz : float
        Rate of the inertial measurement units of quadrotors; 0 for none.
    reflections : float
        Fraction of the time in which a robot receives a station by reflection only, 0 to below 1.
    station_turn_rad : float
        Angle by which the last station is turned in the middle of the session.
    calibration_error_rad : float
        Standard deviation of the tilts and phases of the stations from their factory data.
    factory_data : bool
        True if the scene contains the factory data of the stations.
    room : Scene, optional
        Scene with stations and their room. If it is a design, the true stations are beside the
        designed poses, by their covariances. Robots drive within its working area and heights at
        ``speed_mps``; walls, obstacles and robots stop light. ``stations`` and ``planar`` are not
        used, robot 1 visits its markers, and the scene of the session is this one.
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
    flying: bool = False
    speed_mps: float = 0.5
    imu_hz: float = 100.0
    reflections: float = 0.0
    station_turn_rad: float = 0.0
    calibration_error_rad: float = 0.0
    factory_data: bool = False
    room: Scene | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.room is not None:
            _check_room(self.room, self.flying)
        check_options(
            self,
            (
                ("robots", 1 <= self.robots <= MAX_SAMPLES, f"1 to {MAX_SAMPLES}"),
                ("stations", 1 <= self.stations <= 16, "1 to 16"),
                *require_positive(self, "duration_s", "report_hz", "speed_mps"),
                *require_not_negative(self, "noise_rad", "imu_hz", "calibration_error_rad", "seed"),
                *require_finite(self, "station_turn_rad"),
                *require_fraction_below_1(self, "occlusion", "outliers", "reflections"),
                ("flying", not (self.flying and self.planar), "planar=False: robots fly in space"),
                (
                    "calibration",
                    self.calibration in CALIBRATIONS,
                    "one of " + ", ".join(CALIBRATIONS),
                ),
            ),
        )


def _check_room(scene: Scene, flying: bool) -> None:
    """Raise InputError if nothing can be simulated in a scene."""
    if scene.room is None:
        raise InputError(
            "the scene has no room",
            hint="Give a scene of `locatk room design`, or add the table [room]",
        )
    if not scene.stations:
        raise InputError("the room has no stations", hint="Run `locatk room design` first")
    if flying:
        raise InputError(
            "flights are not simulated in a room",
            hint="Without them, robots move through the heights of the room",
        )


@dataclass(frozen=True)
class SimulatedSession:
    """Simulated recording and its ground truth.

    Attributes
    ----------
    sweeps : Sweeps
        Ascending in time. As in a DotBot's reports, the plane of a sweep is unknown.
    scene : Scene
        Knowledge of a user before solving: the markers, and when robot 1 was on them, or the
        design of the room.
    truth : tuple of Trajectory
        True poses of each robot at 100 Hz; x points along its path, or ahead of a quadrotor.
        Robot 1 has neither truth nor sweeps while it is carried from marker to marker.
    true_scene : Scene
        ``scene`` with the true stations, without covariances.
    is_outlier : (n,) bool ndarray
        True for the sweeps that were replaced by outliers.
    imu : tuple of InertialSamples
        One of each quadrotor.
    """

    sweeps: Sweeps
    scene: Scene
    truth: tuple[Trajectory, ...]
    true_scene: Scene
    is_outlier: Mask
    imu: tuple[InertialSamples, ...] = ()


def simulate(options: SimulationOptions | None = None) -> SimulatedSession:
    """Simulate a session.

    The same options give the same arrays.

    Notes
    -----
    A plane with the rotor angle a(t) = 2 pi (t - t0) / T crosses a robot at p(t) when a(t) equals
    the angle that the station's calibration predicts for p(t). Its count is the time since the
    rotor's zero in steps of the station's own clock: an error of that clock affects times only.
    """
    options = options or SimulationOptions()
    photodiodes = 1 if options.receiver is None else len(options.receiver)
    room = None if options.room is None else options.room.room
    count = options.stations if options.room is None else len(options.room.stations)
    rate_hz = TRUTH_RATE_HZ + options.report_hz * count * photodiodes
    rate_hz += options.imu_hz * options.flying
    check_session_size(options.robots * options.duration_s * rate_hz, options.duration_s)
    # One random stream for each aspect: more noise, for example, leaves the paths as they are.
    streams = (np.random.default_rng(s) for s in np.random.SeedSequence(options.seed).spawn(10))
    station_rng, path_rng, report_rng, noise_rng, occlusion_rng, fault_rng = islice(streams, 6)
    reflection_rng, deviation_rng, imu_rng, mounting_rng = streams
    mounted = [] if options.room is None else mounted_stations(mounting_rng, options.room)
    stations = _simulate_stations(station_rng, options, mounted)
    factory_data = {s.station.channel: s.station.calibration for s in stations}
    stations = [_deviate(station, deviation_rng, options) for station in stations]
    if options.station_turn_rad:
        stations[-1] = _turn(stations[-1], options)
    markers = _markers(options)
    markers_m = np.array([marker.position for marker in markers]).reshape(-1, 3)
    paths = [_make_path(path_rng, robot, markers_m, options) for robot in range(options.robots)]
    light = None if room is None else RoomLight(room, paths)
    links: list[OpticalLink] = []
    parts: list[SweepPairs] = []
    reflections_s: list[Array] = []
    for robot, path in enumerate(paths):
        reports_s = _report_times(report_rng, options)
        for station in stations:
            occlusion_s = draw_intervals(
                occlusion_rng, options.occlusion, MEAN_OCCLUSION_S, options.duration_s
            )
            hidden_s = (path.tour.carry_edges_s, occlusion_s)
            reflection_s = draw_intervals(
                reflection_rng, options.reflections, MEAN_REFLECTION_S, options.duration_s
            )
            for link in _optical_links(robot, path, station, options.receiver):
                if light is not None:
                    is_blocked = light.blocked(robot, station.station.position)
                    link = replace(link, is_blocked=is_blocked)
                noise = noise_rng.normal(0.0, options.noise_rad, (len(reports_s), 2))
                links.append(link)
                parts.append(observe_reports(link, len(parts), reports_s, hidden_s, noise))
                reflections_s.append(reflection_s)
    pairs = SweepPairs.concatenate(parts)
    inject_faults(pairs, links, options.outliers, options.noise_rad, fault_rng)
    if options.reflections:
        reflect_in_runs(pairs, links, reflections_s, options.noise_rad, reflection_rng)

    digits = len(str(options.robots))
    names = tuple(f"robot-{k + 1:0{digits}d}" for k in range(options.robots))
    sweeps, is_outlier = _to_sweeps(pairs, links, names, options.labelled)
    visited = _with_visits(markers, names[0], paths[0].tour.visits_s)
    if options.room is None:
        scene = Scene(markers=visited, planar=options.planar, scale="markers")
    else:
        scene = replace(options.room, markers=visited)
    if options.factory_data:
        scene = replace(scene, calibrations=factory_data)
    return SimulatedSession(
        sweeps,
        scene,
        tuple(
            _truth(n, scene.frame, p, options.duration_s) for n, p in zip(names, paths, strict=True)
        ),
        replace(scene, stations=tuple(station.station for station in stations), covariance=None),
        is_outlier,
        tuple(
            measure_inertia(imu_rng, name, path, options.duration_s, options.imu_hz)
            for name, path in zip(names, paths, strict=True)
            if isinstance(path, FlownPath) and options.imu_hz
        ),
    )


# ---- stations


def _simulate_stations(
    rng: np.random.Generator, options: SimulationOptions, mounted: Sequence[Station]
) -> list[SimulatedStation]:
    """Distribute stations around the floor, 2 m from its centre, looking down at it.

    Stations that are ``mounted`` in a room replace these.
    """
    count = len(mounted) or options.stations
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / max(count, 3)
    azimuth = azimuth + np.radians(rng.uniform(-10, 10, count))
    units = np.resize(rng.permutation(len(FACTORY_UNITS)), count)
    stations = []
    for k in range(count):
        distance_m = rng.uniform(1.9, 2.1)
        horizontal = distance_m * np.array([np.cos(azimuth[k]), np.sin(azimuth[k])])
        position = np.append(horizontal, rng.uniform(1.5, 2.0))
        target = np.append(rng.uniform(-0.15, 0.15, 2), 0.0)
        roll = rotation_exp([np.radians(rng.uniform(-4, 4)), 0.0, 0.0])
        calibration = {
            "units": _unit_calibration(FACTORY_UNITS[units[k]]),
            "generic": GENERIC_CALIBRATION,
            "ideal": IDEAL_CALIBRATION,
        }[options.calibration]
        station = Station(k + 1, position, _look_at(position, target) @ roll, calibration)
        if mounted:
            known = mounted[k].calibration
            station = replace(mounted[k], calibration=calibration if known.is_generic else known)
        clock_error_ppm = rng.uniform(-MAX_CLOCK_ERROR_PPM, MAX_CLOCK_ERROR_PPM)
        period_s = float(period_ticks(station.channel)) / TICK_HZ * (1 + clock_error_ppm * 1e-6)
        bits = rng.integers(0, 2, int(options.duration_s / period_s) + 2)
        stations.append(SimulatedStation(station, -period_s * rng.random(), period_s, bits))
    return stations


def _deviate(
    source: SimulatedStation, rng: np.random.Generator, options: SimulationOptions
) -> SimulatedStation:
    """Return a station whose planes differ from its factory data in tilt and phase."""
    if options.calibration_error_rad == 0:
        return source
    parameters = source.station.calibration.sweeps.copy()
    parameters[:, [PHASE, TILT]] += rng.normal(0.0, options.calibration_error_rad, (2, 2))
    calibration = replace(source.station.calibration, sweeps=parameters)
    return replace(source, station=replace(source.station, calibration=calibration))


def _turn(source: SimulatedStation, options: SimulationOptions) -> SimulatedStation:
    """Return a station that is turned about the vertical in the middle of the session."""
    turn = rotation_exp([0.0, 0.0, options.station_turn_rad])
    rotation = turn @ source.station.rotation
    return replace(source, turned_rotation=rotation, turned_s=options.duration_s / 2)


def _look_at(position: Array, target: Array) -> Array:
    """Return the rotation (3, 3) of a station at ``position`` that faces ``target``, unrolled."""
    forward = (target - position) / np.linalg.norm(target - position)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left = left / np.linalg.norm(left)
    return np.stack([forward, left, np.cross(forward, left)], axis=1)


def _unit_calibration(unit: Array) -> Calibration:
    """Convert a row of :data:`~locatk.core.lighthouse.calibration.FACTORY_UNITS`."""
    tilt, curve, gibmag, gibphase, ogeemag, ogeephase = unit[1:].reshape(6, 2)
    phase = np.array([0.0, unit[0]])
    sweeps = np.stack([phase, tilt, curve, gibmag, gibphase, ogeemag, ogeephase], axis=1)
    return Calibration(sweeps, "factory")


# ---- robots


def _markers(options: SimulationOptions) -> tuple[Marker, ...]:
    """Return the markers of the room, or around the origin without a room."""
    if options.room is not None:
        return options.room.markers
    positions = FLOOR_MARKERS_M if options.planar else RAISED_MARKERS_M
    return tuple(Marker(f"marker-{k + 1}", position) for k, position in enumerate(positions))


def _make_path(
    rng: np.random.Generator, robot: int, markers_m: Array, options: SimulationOptions
) -> RobotPath:
    """Return the path of a robot; the first one visits the markers."""
    visited_m = markers_m[: 0 if robot else None]
    if options.room is not None and options.room.room is not None:
        return RoomPath(rng, options.room.room, options.duration_s, options.speed_mps, visited_m)
    if options.flying:
        return FlownPath(rng, options.duration_s, visited_m, options.speed_mps)
    return DrivenPath(rng, options.planar, options.duration_s, visited_m)


def _optical_links(
    robot: int, path: RobotPath, source: SimulatedStation, receiver: Receiver | None
) -> list[OpticalLink]:
    """Return a link for each photodiode of a robot."""
    if receiver is None:
        return [OpticalLink(robot, path, source)]
    normals = [None] * len(receiver) if receiver.normal is None else list(receiver.normal)
    return [
        OpticalLink(robot, path, source, sensor, offset_m, normal)
        for sensor, (offset_m, normal) in enumerate(zip(receiver.position_m, normals, strict=True))
    ]


def _report_times(rng: np.random.Generator, options: SimulationOptions) -> Array:
    """Return the ascending times (n,) of a robot's reports in seconds, with some jitter."""
    interval_s = 1.0 / options.report_hz
    nominal_s = np.arange(rng.uniform(0, interval_s), options.duration_s, interval_s)
    return nominal_s - rng.uniform(0, 0.02 * interval_s, len(nominal_s))


# ---- results


def _to_sweeps(
    pairs: SweepPairs, links: Sequence[OpticalLink], names: tuple[str, ...], labelled: bool
) -> tuple[Sweeps, Mask]:
    """Return the received sweeps in order of time, and a mask of the outliers among them."""
    is_received = np.isfinite(pairs.count)
    time_ns = stamps_ns(pairs.time_s[is_received])
    order = np.argsort(time_ns, kind="stable")
    robot = np.array([link.robot for link in links], np.int32)[pairs.link]
    device = np.broadcast_to(robot[:, None], is_received.shape)[is_received][order]
    photodiode = np.array([link.sensor for link in links], np.int32)[pairs.link]
    sensor = np.broadcast_to(photodiode[:, None], is_received.shape)[is_received][order]
    unknown = np.full(len(order), UNKNOWN, np.int32)
    sweeps = Sweeps(
        devices=names,
        time_ns=time_ns[order],
        device=device,
        sensor=sensor,
        channel=pairs.channel[is_received][order].astype(np.int32),
        polynomial=pairs.polynomial[is_received][order].astype(np.int32) if labelled else unknown,
        sweep=unknown,
        count=pairs.count[is_received][order],
    )
    return sweeps, pairs.is_outlier[is_received][order]


def _with_visits(markers: Sequence[Marker], device: str, visits_s: Array) -> tuple[Marker, ...]:
    """Return the first k markers; ``visits_s`` (k, 2) are starts and ends of their visits."""
    return tuple(
        replace(marker, visits=(MarkerVisit(device, int(start), int(end)),))
        for marker, (start, end) in zip(markers, stamps_ns(visits_s), strict=False)
    )


def _truth(device: str, frame: str, path: RobotPath, duration_s: float) -> Trajectory:
    """Return the true poses of one robot, except while it is carried."""
    time_s = np.arange(int(np.ceil(duration_s * TRUTH_RATE_HZ)) + 1) / TRUTH_RATE_HZ
    time_s = time_s[np.searchsorted(path.tour.carry_edges_s, time_s) % 2 == 0]
    no_covariance = np.zeros((len(time_s), 6, 6))
    position, quaternion = path.position(time_s), path.quaternion(time_s)
    return Trajectory(device, frame, stamps_ns(time_s), position, quaternion, no_covariance)
