"""Figures of the planning of landmarks: predictions for routes against simulated drives.

Each task has bars, a height, a pitch, a noise of the sensors, errors of the odometry and a route of
its own (fixed seeds). The prediction (:mod:`locatk.core.landmarks.design.routes`) knows these
standard deviations, the map and the route. The drives are simulated with magnetic cuboids
(magpylib) and wheels, solved by ``locatk solve`` with its default assumptions, and compared with
the truth on the map. The solver estimates each pose from the whole drive: it is compared with the
smoothed prediction, at the landmarks and everywhere along the route. Poses of ``locatk live`` are
compared with the prediction of a filter, from where both are localized.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion, wrap_angle
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.routes import RouteCheck, check_routes, find_visits
from locatk.core.landmarks.design.visit_accuracy import VisitErrors
from locatk.core.landmarks.landmark import CODE_COUNT, Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.simulation.options import Aims, Errors, SimulationOptions
from locatk.core.landmarks.simulation.robot import RobotLimits
from locatk.core.landmarks.simulation.sensors import TRACK_M
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import solve
from locatk.core.landmarks.stream import LandmarksStream
from locatk.core.routes import Route
from locatk.core.streaming.events import LiveEvent, PoseEstimate
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.core.streaming.planar_filter import OdometryNoise
from locatk.core.streaming.tracker import DEFAULT_SETTINGS
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.plan.ratios import ratio_figures
from locatk.formats.benchmarks.plan.truth import at_times, planar_poses

Array = NDArray[np.float64]

TASKS, DRIVES = 20, 4
"""Tasks, and simulated drives of each, on floors with different errors."""

FIRST_SEED = 25_000

GRAZING_DRIVES, GRAZING_OFFSETS_M = 36, (0.06, 0.07, 0.08)
"""Drives past four landmarks each, and their distances from the centres [m]."""

GRAZING_NOISE_T, GRAZING_PITCH_M = 3e-4, 0.35
"""Noise of a reading, and distance between these landmarks."""

KINDS = (
    "position at landmarks, `locatk solve`",
    "position, `locatk solve`",
    "heading at landmarks, `locatk solve`",
    "heading, `locatk solve`",
    "position, `locatk live`",
    "heading, `locatk live`",
)
"""Errors that are compared."""

CHUNK_NS = 100_000_000
"""Time between two reads of the live localizer."""

RATE_HZ = 200.0
"""Readings of each sensor in a second."""

BARS_MM = ((30, 10, 5), (30, 5, 5), (25, 10, 5), (40, 10, 5))
"""Length, width and height of the bars."""


@dataclass(frozen=True)
class PlanningTask:
    """One task: what is planned, and what is simulated."""

    floor: FloorMap
    route: Route
    errors: Errors
    noise: OdometryNoise
    speed_mps: float

    def predict(self, is_smoothed: bool = True) -> RouteCheck:
        """Return the prediction."""
        errors = self.errors
        visit_errors = VisitErrors(
            noise_t=errors.noise_t,
            rate_hz=RATE_HZ,
            gain=errors.gain,
            offset_t=errors.offset_t,
            height_m=0.5e-3,
            bar_strength=errors.bar_strength,
            bar_position_m=errors.bar_place_m,
            landmark_position_m=errors.landmark_place_m,
            landmark_heading_rad=errors.landmark_turn_rad,
        )
        checks = check_routes(
            self.floor,
            [self.route],
            self.noise,
            errors=visit_errors,
            speed_mps=self.speed_mps,
            is_smoothed=is_smoothed,
        )
        return checks[0]

    def simulate(self, seed: int) -> SimulatedSession:
        """Simulate a drive along the route, on a floor with errors of its own."""
        options = SimulationOptions(
            strategy="path",
            waypoints=tuple((float(x), float(y)) for x, y in self.route.waypoint_m),
            aims=Aims(0.0, 0.0, 0.0, 0.0),
            errors=self.errors,
            limits=RobotLimits(speed_mps=self.speed_mps),
            rate_hz=RATE_HZ,
            seed=seed,
        )
        return simulate(self.floor, options)


def make_task(number: int) -> PlanningTask:
    """Draw a task."""
    rng = np.random.default_rng(FIRST_SEED + number)
    bar = BARS_MM[rng.integers(len(BARS_MM))]
    remanence_t = float(rng.choice([1.2, 1.3, 0.9]))
    geometry = Geometry(
        bar_length_m=bar[0] * 1e-3,
        bar_width_m=bar[1] * 1e-3,
        bar_height_m=bar[2] * 1e-3,
        remanence_t=remanence_t,
        sensor_height_m=rng.uniform(8, 16) * 1e-3,
        threshold_t=2.75e-3 * remanence_t * (0.5 if bar[1] == 5 else 1.0),
    )
    pitch_m = float(rng.uniform(0.18, 0.35))
    floor = design_map(DesignOptions(10, 10, pitch_m=pitch_m, seed=number, geometry=geometry))
    wheel_noise_m = float(rng.uniform(0.1e-3, 0.5e-3))
    errors = Errors(
        noise_t=float(rng.uniform(0.05e-3, 0.4e-3)),
        landmark_place_m=float(rng.uniform(0.5e-3, 2e-3)),
        landmark_turn_rad=math.radians(rng.uniform(0.3, 1.0)),
        odometry_scale=float(rng.uniform(0.003, 0.02)),
        odometry_turn=float(rng.uniform(0.003, 0.02)),
        odometry_drift_rad_per_m=float(rng.uniform(0.01, 0.08)),
        wheel_noise_m=wheel_noise_m,
    )
    # Two wheels with independent errors: their mean and their difference over the track.
    noise = OdometryNoise(
        scale=errors.odometry_scale,
        rotation_scale=errors.odometry_turn,
        drift_rad_per_m=errors.odometry_drift_rad_per_m,
        distance_m=wheel_noise_m / math.sqrt(2),
        heading_rad=math.sqrt(2) * wheel_noise_m / TRACK_M,
        rotation_rad=wheel_noise_m / math.sqrt(TRACK_M),
        slip_m=0.0,
        slip_rad=0.0,
        rest_m=0.0,
        rest_rad=0.0,
    )
    return PlanningTask(floor, _route(rng, floor), errors, noise, float(rng.uniform(0.1, 0.4)))


def _route(rng: np.random.Generator, floor: FloorMap) -> Route:
    """Draw a route: along rows and columns, about 15 mm off them, or straight anywhere."""
    last = (floor.shape[0] - 1) * floor.pitch_m
    if rng.random() < 0.5:
        cells = rng.integers(0, floor.shape[0], (5, 2)).astype(float)
        corners = [cells[0]]
        for number, cell in enumerate(cells[1:]):
            corner = corners[-1].copy()
            axis = number % 2
            corner[axis] = cell[axis] if cell[axis] != corner[axis] else (cell[axis] + 4) % 10
            corners.append(corner)
        points = floor.pitch_m * np.array(corners) + rng.normal(0, 0.015, 2)
    else:
        corners = [rng.uniform(0, last, 2)]
        while len(corners) < 4:
            corner = rng.uniform(0, last, 2)
            if np.hypot(*(corner - corners[-1])) > 0.4 * last:
                corners.append(corner)
        points = np.array(corners)
    return Route(points)


def figures(data: Path) -> list[Figure]:
    """Compare predictions and simulated drives of all tasks; no recordings are needed."""
    tasks = [make_task(number) for number in range(TASKS)]
    results = [
        measure_task(task, FIRST_SEED + DRIVES * number) for number, task in enumerate(tasks)
    ]
    ratios = np.array([result.predicted / result.reached for result in results])
    how = (
        f"{TASKS} random tasks (bars, height, pitch, noise, odometry, route), {DRIVES} simulated "
        "drives each"
    )
    measured = []
    for kind, ratio in zip(KINDS, ratios.T, strict=True):
        measured += ratio_figures(f"landmarks: predicted over reached, {kind}", ratio, how)
    return [*measured, *_coverage_figures(results, tasks), misread_figure()]


def _coverage_figures(results: list[TaskErrors], tasks: list[PlanningTask]) -> Iterator[Figure]:
    """Yield figures of the longest stretch without a landmark, and of the first fix."""
    gap = np.array([result.longest_m for result in results])
    yield Figure(
        "landmarks: longest stretch without a landmark, difference",
        float(np.median(np.abs(gap[:, 0] - gap[:, 1]))),
        "m",
        "predicted against the detections that `locatk solve` uses, median of the tasks",
    )
    first = np.array([result.first_m for result in results])
    pitch = np.array([task.floor.pitch_m for task in tasks])
    is_known = np.isfinite(first).all(axis=1)
    late = (first[:, 1] - first[:, 0])[is_known] / pitch[is_known]
    how = (
        f"`locatk live`, first fix against the prediction, {int(is_known.sum())} tasks in which "
        "both are localised"
    )
    yield Figure("landmarks: first fix within a pitch", 100 * _mean(abs(late) <= 1), "%", how)
    yield Figure("landmarks: first fix more than a pitch late", 100 * _mean(late > 1), "%", how)
    agree = _mean(np.isfinite(first[:, 0]) == np.isfinite(first[:, 1]))
    how = "tasks in which prediction and `locatk live` agree on whether the robot is localised"
    yield Figure("landmarks: localisable or not, right", 100 * agree, "%", how)


def misread_figure(drives: int = GRAZING_DRIVES) -> Figure:
    """Compare predicted and reached misreadings of landmarks that are only grazed."""
    rng = np.random.default_rng(FIRST_SEED)
    errors = Errors(noise_t=GRAZING_NOISE_T)
    predicted, is_wrong = [], []
    for number in range(drives):
        codes = rng.integers(0, CODE_COUNT, (1, 4))
        offset_m = GRAZING_OFFSETS_M[number % len(GRAZING_OFFSETS_M)]
        floor = FloorMap(codes, pitch_m=GRAZING_PITCH_M)
        ends = np.array([[-0.3, offset_m], [3 * GRAZING_PITCH_M + 0.3, offset_m]])
        task = PlanningTask(floor, Route(ends), errors, OdometryNoise(), 0.1)
        session = task.simulate(FIRST_SEED + number)
        found = find_visits(floor, task.route, errors=VisitErrors(noise_t=GRAZING_NOISE_T))
        probability = {
            visit.cell[1]: visit.accuracy.misread_probability
            for visit in found
            if visit.accuracy.is_usable
        }
        truth = session.truth[0]
        for one in solve(session.samples, None, odometry=session.odometry).detections:
            x_m = np.interp(one.time_s * 1e9, truth.time_ns, truth.position[:, 0])
            column = round(float(x_m) / GRAZING_PITCH_M)
            if one.code is not None and column in probability:
                predicted.append(probability[column])
                # Without a map, the frame of a code is that of the robot, which drives along x.
                is_wrong.append(one.code != codes[0, column])
    return Figure(
        "landmarks: misread codes of grazed landmarks",
        100 * float(np.mean(is_wrong)),
        "%",
        f"{len(is_wrong)} simulated passes at 60, 70 and 80 mm, noise 0.3 mT, solved without a map",
        peer="prediction",
        peer_value=100 * float(np.mean(predicted)),
    )


def _mean(values: NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


@dataclass(frozen=True)
class TaskErrors:
    """Predicted and reached errors of a task, root mean squares over the route and its drives.

    Attributes
    ----------
    predicted, reached : (6,) ndarray
        By :data:`KINDS`, in m and rad; ``nan`` if no drive was localized.
    longest_m : (predicted, reached)
        Longest stretch without a landmark that is used; the mean of the drives.
    first_m : (predicted, reached)
        Distance of the first fix of the live solver; ``nan`` if there is none.
    """

    predicted: Array
    reached: Array
    longest_m: tuple[float, float]
    first_m: tuple[float, float]


def measure_task(task: PlanningTask, seed: int, drives: int = DRIVES) -> TaskErrors:
    """Predict a task, and simulate and solve its drives."""
    offline, live = task.predict(is_smoothed=True), task.predict(is_smoothed=False)
    squares, longest, first = [], [], []
    for drive in range(drives):
        session = task.simulate(seed + drive)
        truth = _TruePath.of(session.truth[0], task.route.length_m)
        solved, longest_m = _offline_squares(task, session, truth, offline)
        driven, first_m = _live_squares(task, session, truth, live)
        squares.append(np.concatenate([solved, driven], axis=1))
        longest.append(longest_m)
        first.append(first_m)
    # Both sums are over the same poses: a drive without poses has none.
    predicted, reached = np.sqrt(np.nanmean(squares, axis=0))
    read = live.visits
    localized = [visit.distance_m for visit in read if visit.fix.distance_m == live.localized_m]
    return TaskErrors(
        predicted,
        reached,
        (offline.longest_without_fix_m, float(np.mean(longest))),
        (localized[0] if localized else math.nan, float(np.median(first))),
    )


@dataclass(frozen=True)
class _TruePath:
    """True poses of a drive, and the distances along its route."""

    time_ns: NDArray[np.int64]
    pose: Array
    distance_m: Array

    @classmethod
    def of(cls, truth: Trajectory, length_m: float) -> _TruePath:
        pose = planar_poses(truth)
        travelled = np.cumsum(np.r_[0.0, np.hypot(*np.diff(pose[:, :2], axis=0).T)])
        return cls(truth.time_ns, pose, travelled * length_m / travelled[-1])

    def errors(self, time_ns: NDArray[np.int64], pose: Array) -> tuple[Array, Array]:
        """Return the distances (n,) along the route and the squared errors (n, 2) of poses."""
        true = at_times(time_ns, self.time_ns, self.pose)
        heading_error = wrap_angle(pose[:, 2] - true[:, 2])
        position = ((pose[:, :2] - true[:, :2]) ** 2).sum(axis=1)
        distance_m = np.interp(time_ns, self.time_ns, self.distance_m)
        return distance_m, np.column_stack([position, heading_error**2])


def _sigmas(check: RouteCheck, distance_m: Array) -> Array:
    """Return the predicted variances (n, 2) of position and heading at distances."""
    accuracy = check.accuracy
    variances = accuracy.position_rms_m**2, accuracy.heading_sigma_rad**2
    return np.column_stack([np.interp(distance_m, accuracy.distance_m, each) for each in variances])


def _offline_squares(
    task: PlanningTask, session: SimulatedSession, truth: _TruePath, check: RouteCheck
) -> tuple[Array, float]:
    """Solve a drive; return predicted and reached mean squares (2, 4), and the longest stretch."""
    solution = solve(session.samples, task.floor, odometry=session.odometry)
    if not solution.trajectories:
        return np.full((2, 4), np.nan), task.route.length_m
    solved = solution.trajectories[0]
    distance_m, reached = truth.errors(solved.time_ns, planar_poses(solved))
    predicted = _sigmas(check, distance_m)
    weight = np.diff(distance_m, prepend=distance_m[:1])
    at = [visit.distance_m for visit in check.visits if visit.accuracy.is_usable]
    index = np.clip(np.searchsorted(distance_m, at), 0, len(distance_m) - 1)
    mean = [
        np.concatenate([[each[index, 0].mean(), np.average(each[:, 0], weights=weight)],
                        [each[index, 1].mean(), np.average(each[:, 1], weights=weight)]])
        for each in (predicted, reached)
    ]  # fmt: skip
    used_ns = [round(one.time_s * 1e9) for one in solution.detections if not one.refused]
    stops = np.sort(np.interp(used_ns, truth.time_ns, truth.distance_m))
    return np.array(mean), float(np.diff([0.0, *stops, task.route.length_m]).max())


def _live_squares(
    task: PlanningTask, session: SimulatedSession, truth: _TruePath, check: RouteCheck
) -> tuple[Array, float]:
    """Localize a drive live; return mean squares (2, 2) after both are localized, and first fix.

    The tracker knows the errors of the odometry.
    """
    settings = replace(
        DEFAULT_SETTINGS["landmarks"], odometry=task.noise, max_sigma_m=task.route.length_m
    )
    stream = LandmarksStream(task.floor)
    localizer = LiveLocalizer(stream, settings)
    samples, odometry = session.samples[0], session.odometry[0]
    events: list[LiveEvent] = []
    for start_ns in range(int(samples.time_ns[0]), int(samples.time_ns[-1]) + 1, CHUNK_NS):
        window = start_ns, start_ns + CHUNK_NS
        wheels = np.arange(*np.searchsorted(odometry.time_ns, window))
        halls = slice(*np.searchsorted(samples.time_ns, window))
        if len(wheels):
            events += localizer.push(odometry.select(wheels))
        part = replace(samples, time_ns=samples.time_ns[halls], field_t=samples.field_t[halls])
        if len(part):
            events += localizer.push(part)
    events += localizer.finish()
    poses = [event for event in events if isinstance(event, PoseEstimate)]
    if not poses:
        return np.full((2, 2), np.nan), math.nan
    heading = [float(heading_from_quaternion(one.quaternion)) for one in poses]
    position = np.array([one.position[:2] for one in poses])
    time_ns = np.array([one.time_ns for one in poses])
    distance_m, reached = truth.errors(time_ns, np.column_stack([position, heading]))
    predicted = _sigmas(check, distance_m)
    weight = np.diff(distance_m, prepend=distance_m[:1])
    weight[~np.isfinite(predicted).all(axis=1)] = 0.0
    if not weight.any():
        return np.full((2, 2), np.nan), float(distance_m[0])
    mean = [
        np.average(np.nan_to_num(each), axis=0, weights=weight) for each in (predicted, reached)
    ]
    return np.array(mean), float(distance_m[0])
