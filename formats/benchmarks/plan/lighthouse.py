"""Figures of the planning of Lighthouse rooms: predicted against reached accuracy.

Predictions are those of ``locatk room check``
(:mod:`locatk.core.lighthouse.design.solved_accuracy`): standard deviations of positions relative to
each other, without the frame. They are compared with

- simulated sessions in rooms of random sizes, heights, obstacles and stations on random mounts,
- simulated sessions in rooms of ``locatk room design``,
- the published recordings of the grid and the floor.

In each simulated session, the stations are mounted beside their designed poses and have the light
planes of other real units. The session is solved with the room as a prior, and its positions are
compared with the truth after a similarity, which the prediction does not contain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.evaluation import EvaluationOptions, evaluate
from locatk.core.geometry import Similarity, apply_homography, fit_homography, umeyama
from locatk.core.lighthouse.design import RoomRequest, design_room
from locatk.core.lighthouse.design.accuracy import PositionAccuracy
from locatk.core.lighthouse.design.placement import seen_stations
from locatk.core.lighthouse.design.report import report_room, station_of
from locatk.core.lighthouse.design.solved_accuracy import predict_solved_positions
from locatk.core.lighthouse.devices.alignment import MARKER_SIGMA_M
from locatk.core.lighthouse.epochs import group_epochs
from locatk.core.lighthouse.localization.photodiodes import track_photodiodes
from locatk.core.lighthouse.motion.frames import common_motions
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.room import Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.lighthouse.scene.model import stack_stations
from locatk.core.lighthouse.scene.standstills import find_standstills
from locatk.core.lighthouse.simulation import SimulatedSession, SimulationOptions, simulate
from locatk.core.lighthouse.solver import SolveOptions, solve
from locatk.core.polygons import rectangle
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.figures import Figure, measure_or_explain
from locatk.formats.benchmarks.lighthouse import suite
from locatk.formats.benchmarks.plan.ratios import ratio_figures
from locatk.formats.benchmarks.plan.truth import at_times

Array = NDArray[np.float64]

TASKS, SESSIONS = 20, 6
"""Random rooms, and simulated sessions in each: with other units, mounting errors and paths."""

DESIGNED_SESSIONS = 40
"""Simulated sessions in each designed room. The deviations of the units differ so much that the rms
of 16 sessions varies by a tenth."""

FIRST_SEED = 25_100

MIN_REST_POSES, MIN_REST_NS, MIN_RESTS = 10, 2_000_000_000, 3
"""Fewest poses and shortest time of a rest that gives a scatter, and fewest rests: in shorter ones,
robots still creep."""

ROBOTS, DURATION_S, SPEED_MPS = 10, 40.0, 0.3
"""Robots with one photodiode that report ten times a second, and drive through the whole room."""

CROWDS = ((4.0, 4.0, 2, 15), (6.0, 5.0, 3, 30), (5.0, 5.0, 4, 10))
"""Length and width [m], stations and robots of rooms in which robots hide each other."""

REPORT_HZ = 10.0
"""Reports of a robot per second, as a DotBot."""

MOUNTED_S = 4.0
"""Duration of sessions in which nothing is solved [s]."""

MAX_PREDICTED_POINTS = 1000
"""Largest number of the driven points at which a prediction is computed."""

MEDIAN_GOAL, TAIL_GOAL, DESIGN_GOAL = 1.25, 2.0, 1.2
"""Goals for the ratio of predicted and reached standard deviation, or its inverse: median and 95 %
of the random rooms, and each designed room."""

RECORDING_GOAL = 2.0
"""The same for published recordings."""

NAME = "lighthouse: predicted/reached sigma"
"""Beginning of the names of the figures."""

REQUEST = RoomRequest(facing="all")
"""Photodiodes of the simulator receive light from everywhere."""


@dataclass(frozen=True)
class Comparison:
    """Predicted and reached standard deviations of positions, in m: rms of all sessions of a room.

    Attributes
    ----------
    predicted_m, reached_m : float
    sessions : int
        Sessions that were solved.
    refused : tuple of str
        Reasons of the others.
    """

    predicted_m: float
    reached_m: float
    sessions: int
    refused: tuple[str, ...] = ()

    @property
    def ratio(self) -> float:
        """Predicted over reached."""
        return self.predicted_m / self.reached_m


def figures(data: Path) -> list[Figure]:
    """Return the figures; ``data`` is the folder of published recordings."""
    folder = data / "lighthouse"
    rows: list[Figure] = []
    for name, measure in (
        ("20 random rooms", _random_rooms),
        ("rooms as mounted", _mounted_rooms),
        ("designed rooms", _designed_rooms),
        ("rooms with many robots", _crowded_rooms),
        ("published grid", partial(grid_figures, folder)),
        ("published floor, two stations", partial(_floor_of_two, folder)),
        ("published floor, one station", partial(_floor_of_one, folder)),
    ):
        rows += measure_or_explain(measure, Figure(f"{NAME}, {name}", None, "", ""))
    return rows


# ---- random rooms


def _random_rooms() -> list[Figure]:
    """Compare predictions for random rooms with simulated sessions."""
    compared = [
        compare_sessions(draw_room(number), range(SESSIONS), FIRST_SEED + 100 * number)
        for number in range(TASKS)
    ]
    ratio = np.array([each.ratio for each in compared if each.sessions])
    solved = sum(each.sessions for each in compared)
    how = (
        "rooms of 3 to 8 m, 2 to 6 stations on random places of the walls, on a plane or in space; "
        f"{solved} of {TASKS * SESSIONS} sessions solved, each with other stations, after a "
        "similarity"
    )
    return ratio_figures(f"{NAME}, {TASKS} random rooms", ratio, how)


def _mounted_rooms() -> list[Figure]:
    """Compare predictions for stations as they are mounted by hand, before anything is solved."""
    ratio = []
    for number in range(TASKS):
        scene = draw_room(number)
        assert scene.room is not None
        predicted, reached = [], []
        for seed in range(SESSIONS):
            session = _simulate(scene, FIRST_SEED + 5_000 + 100 * number + seed, MOUNTED_S)
            tracks = track_photodiodes(group_epochs(session.sweeps), scene)
            estimate, truth = _positions(tracks.trajectories, session)
            report = report_room(scene, scene.room, REQUEST, given_errors=True, points_m=truth)
            predicted.append(np.mean(report.sigma_m[np.isfinite(report.sigma_m)] ** 2))
            offset = (estimate - truth)[:, : 2 if scene.planar else 3]
            reached.append(np.mean(np.sum(offset**2, axis=1)))
        ratio.append(np.sqrt(np.mean(predicted) / np.mean(reached)))
    how = (
        "the same rooms with the designed poses, beside which the stations are mounted; rms of "
        f"{SESSIONS} mountings, in the frame of the room"
    )
    return ratio_figures(f"{NAME}, {TASKS} rooms as mounted", np.array(ratio), how)


def _deviation(ratio: float) -> float:
    """Return a ratio or its reciprocal, whichever is above 1."""
    return float(max(ratio, 1.0 / ratio))


def draw_room(number: int) -> Scene:
    """Draw a room with stations at random positions on its walls."""
    rng = np.random.default_rng(FIRST_SEED + number)
    length_m, width_m = rng.uniform(3.0, 8.0, 2)
    height_m = float(rng.uniform(2.4, 3.5))
    low_m = float(rng.uniform(0.05, 0.3))
    is_planar = bool(rng.random() < 0.5)
    high_m = low_m if is_planar else low_m + float(rng.uniform(0.6, 1.2))
    obstacles = []
    for _ in range(rng.integers(0, 3)):
        corner = rng.uniform(0.2, 0.7, 2) * (length_m, width_m)
        width, depth = rng.uniform(0.2, 0.6, 2).tolist()
        outline = rectangle(width, depth, (float(corner[0]), float(corner[1])))
        obstacles.append(Obstacle(outline, 0.0, float(rng.uniform(0.3, 1.0))))
    robots = RobotSize(ROBOTS, 0.06, min(low_m, 0.12)) if rng.random() < 0.5 else None
    room = Room(
        rectangle(length_m, width_m),
        height_m,
        (low_m, high_m),
        obstacles=tuple(obstacles),
        robots=robots,
    )
    stations = _random_stations(rng, room, int(rng.integers(2, 7)))
    return Scene(
        stations,
        planar=is_planar,
        floor_z=low_m if is_planar else 0.0,
        scale="design",
        frame="room",
        frame_source="design",
        room=room,
    )


def _random_stations(rng: np.random.Generator, room: Room, count: int) -> tuple[Station, ...]:
    """Return stations on walls, at least a quarter of the way around from each other for two."""
    size = room.outline_m.max(axis=0)
    start = rng.random()
    stations = []
    for k in range(count):
        # Along the walls, a fraction of the circumference from the corner at the origin.
        along = (start + (k + rng.uniform(-0.25, 0.25)) / max(count, 3)) % 1.0 * 2 * size.sum()
        x, y = _on_walls(along, *size)
        position = np.array([x, y, room.height_m - rng.uniform(0.1, 0.6)])
        target = np.append(size * rng.uniform(0.35, 0.65, 2), room.photodiode_z_m[0])
        stations.append(station_of(k + 1, position, _facing(position, target)))
    return tuple(stations)


def _on_walls(along_m: float, length_m: float, width_m: float) -> tuple[float, float]:
    """Return the point at a distance along the walls, 5 cm inside."""
    inset = 0.05
    if along_m < length_m:
        x, y = along_m, inset
    elif along_m < length_m + width_m:
        x, y = length_m - inset, along_m - length_m
    elif along_m < 2 * length_m + width_m:
        x, y = 2 * length_m + width_m - along_m, width_m - inset
    else:
        x, y = inset, 2 * (length_m + width_m) - along_m
    return (
        float(np.clip(x, inset, length_m - inset)),
        float(np.clip(y, inset, width_m - inset)),
    )


def _facing(position: Array, target: Array) -> Array:
    forward = (target - position) / np.linalg.norm(target - position)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    return np.stack([forward, left, np.cross(forward, left)], axis=1)


# ---- designed rooms


def _designed_rooms() -> list[Figure]:
    """Compare predictions for rooms of ``locatk room design`` with simulated sessions."""
    rooms = {
        "4 x 4 m floor, 2 stations": (Room(rectangle(4, 4), 2.6, (0.1, 0.1)), 2),
        "8 x 6 m floor, 4 stations": (Room(rectangle(8, 6), 3.0, (0.1, 0.1)), 4),
        "5 x 4 m to 1.2 m height, 4 stations": (Room(rectangle(5, 4), 2.6, (0.1, 1.2)), 4),
    }
    rows = []
    for number, (name, (room, count)) in enumerate(rooms.items()):
        scene = design_room(room, RoomRequest(stations=count)).scene
        seed = FIRST_SEED + 10_000 + 100 * number
        compared = compare_sessions(scene, range(DESIGNED_SESSIONS), seed)
        how = (
            f"larger of ratio and inverse; predicted {1e3 * compared.predicted_m:.2f} mm, reached "
            f"{1e3 * compared.reached_m:.2f} mm, rms of {compared.sessions} sessions with other "
            "stations, after a similarity"
        )
        rows.append(
            Figure(
                f"{NAME}, {name}",
                _deviation(compared.ratio), "", how, DESIGN_GOAL,
            )
        )  # fmt: skip
    return rows


def _crowded_rooms() -> list[Figure]:
    """Compare the predicted fractions of time in which enough stations are seen among robots."""
    differences, parts = [], []
    for length_m, width_m, stations, robots in CROWDS:
        room = Room(
            rectangle(length_m, width_m), 2.6, (0.1, 0.1), robots=RobotSize(robots, 0.12, 0.3)
        )
        rng = np.random.default_rng(FIRST_SEED + 20_000 + robots)
        scene = Scene(
            _random_stations(rng, room, stations),
            planar=True, floor_z=0.1, scale="design", frame_source="design", room=room,
        )  # fmt: skip
        session = simulate(
            SimulationOptions(robots=robots, duration_s=DURATION_S, room=scene, seed=FIRST_SEED)
        )
        received = np.isfinite(group_epochs(session.sweeps).counts).all(axis=2).sum(axis=1)
        reports = robots * DURATION_S * REPORT_HZ
        points = np.concatenate([track.position[::100] for track in session.truth])
        for seen in (1, 2):
            request = replace(REQUEST, min_seen=seen)
            report = report_room(scene, room, request, points_m=points)
            predicted = float(report.availability.mean())
            reached = np.count_nonzero(received >= seen) / reports
            differences.append(100 * abs(predicted - reached))
            parts.append(f"{100 * predicted:.1f} and {100 * reached:.1f} %")
    return [
        Figure(
            "lighthouse: time in view of stations among robots, largest difference",
            float(max(differences)), "%",
            f"predicted and simulated time with one station or more, and two or more, in "
            f"{len(CROWDS)} rooms: {', '.join(parts)}",
        )
    ]  # fmt: skip


# ---- published recordings


def grid_figures(data: Path) -> list[Figure]:
    """Compare predictions for the scene of the published grid with its errors and its scatter."""
    session, truth_mm = suite.grid_session(data)
    solution = solve(session.sweeps, Scene(), SolveOptions(scene="two-3d"))
    (track,) = solution.trajectories
    truth = 1e-3 * truth_mm
    to = umeyama(track.position, truth)
    position = to.apply(track.position)
    error_m = _rms_distance(position - truth)
    _, site = np.unique(truth, axis=0, return_inverse=True)
    scatter = [position[site == k] - position[site == k].mean(axis=0) for k in np.unique(site)]
    accuracy = _predict(solution.artifact.transformed(to), position)
    return [
        _recording_figure("published grid: error", accuracy.sigma_m, error_m,
                          "4,759 positions, after a similarity"),
        _recording_figure("published grid: repeatability", accuracy.noise_sigma_m,
                          _rms_distance(np.concatenate(scatter)), "at 140 points at rest"),
    ]  # fmt: skip


def _floor_of_two(data: Path) -> list[Figure]:
    """Compare predictions for the published floor under two stations."""
    pairs, session, solution = suite.two_stations_pairs(data)
    options = EvaluationOptions(align="sim3", offset_s=suite.TWO_STATIONS_OFFSET_S)
    evaluation = evaluate(pairs, options)
    to = evaluation.alignment
    assert session.scene is not None
    return _floor_figures(
        "published floor, two stations",
        solution.artifact.transformed(to),
        [(session.sweeps, solution, to)],
        evaluation.rmse,
        session.scene.markers,
        are_marks_of_scene=False,
    )


def _floor_of_one(data: Path) -> list[Figure]:
    """Compare predictions for the published floor under one station."""
    experiments = suite.one_station_experiments(data)
    error_m = suite.leave_one_out([pairs for pairs, _, _ in experiments], "none").rmse
    runs = [
        (session.sweeps, solution, Similarity.identity()) for _, session, solution in experiments
    ]
    scene: Scene = experiments[0][2].artifact
    return _floor_figures(
        "published floor, one station",
        scene,
        runs,
        error_m,
        scene.markers,
        are_marks_of_scene=True,
    )


def _floor_figures(
    name: str,
    scene: Scene,
    runs: Sequence[tuple[Sweeps, Solution, Similarity]],
    error_m: float,
    marks: Sequence[Marker],
    *,
    are_marks_of_scene: bool,
) -> list[Figure]:
    """Compare a prediction with the distance from a camera, and with the scatter at rest.

    Four marks on the floor fix the positions of the camera, and those of a single station, by one
    homography each. They have the errors of marks that are measured and visited by hand.
    """
    positions, scatter = [], []
    for sweeps, solution, to in runs:
        rests = find_standstills(sweeps)
        for track in solution.trajectories:
            position = to.apply(track.position)
            positions.append(position)
            for rest in rests:
                is_inside = (track.time_ns >= rest.start_ns) & (track.time_ns <= rest.end_ns)
                is_long = rest.end_ns - rest.start_ns >= MIN_REST_NS
                is_own = rest.device == track.device and is_long
                if is_own and np.count_nonzero(is_inside) >= MIN_REST_POSES:
                    own = position[is_inside, :2]
                    scatter.append(own - own.mean(axis=0))
    points = np.concatenate(positions)
    accuracy = _predict(scene, points)
    corners = np.stack([mark.position[:2] for mark in marks])
    of_marks = homography_variance(corners, points[:, :2], is_aligned=not are_marks_of_scene)
    variance = np.mean(accuracy.sigma_m**2) + (2 if are_marks_of_scene else 1) * of_marks
    own_mm = 1e3 * float(np.sqrt(np.mean(accuracy.sigma_m**2)))
    how = (
        f"against a camera; {own_mm:.2f} mm of the prediction are Lighthouse, the rest are the "
        f"marks of the camera{' and of the station' if are_marks_of_scene else ''}, "
        f"{1e3 * MARKER_SIGMA_M:.0f} mm each"
    )
    rows = [_recording_figure(f"{name}: error", np.sqrt(variance), error_m, how)]
    repeatability = f"{name}: repeatability"
    if len(scatter) < MIN_RESTS:
        missing = Figure(f"{NAME}, {repeatability}", None, "", "")
        return [*rows, missing.missing(f"robots rest {len(scatter)} times")]
    how = f"in {len(scatter)} rests of robots"
    scatter_m = _rms_distance(np.concatenate(scatter))
    return [*rows, _recording_figure(repeatability, accuracy.noise_sigma_m, scatter_m, how)]


def homography_variance(corners: Array, points: Array, *, is_aligned: bool) -> float:
    """Return the mean variance of points (n, 2) by a homography of four uncertain corners (4, 2).

    If the points are aligned with others, a similarity has no errors.
    """
    step_m = 1e-4
    jacobian = np.empty((*points.shape, 8))
    for k in range(8):
        moved = corners.copy()
        moved.flat[k] += step_m
        homography = fit_homography(corners, moved)
        jacobian[..., k] = (apply_homography(homography, points) - points) / step_m
    rows = jacobian.reshape(-1, 8)
    if is_aligned:
        centred = np.pad(points - points.mean(axis=0), ((0, 0), (0, 1)))
        frame = common_motions(centred)[:, :2][:, :, [0, 1, 5, 6]].reshape(len(rows), 4)
        rows = rows - frame @ np.linalg.lstsq(frame, rows, rcond=None)[0]
    return MARKER_SIGMA_M**2 * float(np.sum(rows**2) / len(points))


def _predict(scene: Scene, points_m: Array) -> PositionAccuracy:
    """Predict the accuracy at points at which all stations of a solved scene were received."""
    step = max(1, len(points_m) // MAX_PREDICTED_POINTS)
    position, rotation, _ = stack_stations(scene.stations)
    points = points_m[::step]
    is_seen = np.ones((len(position), len(points)), bool)
    return predict_solved_positions(
        position, rotation, points, is_seen, is_planar=bool(scene.planar)
    )


def _rms_distance(offset: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(offset**2, axis=1))))


def _recording_figure(name: str, sigma_m: Array | float, reached_m: float, how: str) -> Figure:
    predicted_m = float(np.sqrt(np.mean(np.square(sigma_m))))
    return Figure(
        f"{NAME}, {name}",
        _deviation(predicted_m / reached_m),
        "",
        f"larger of ratio and inverse; predicted {1e3 * predicted_m:.2f} mm, reached "
        f"{1e3 * reached_m:.2f} mm, {how}",
        RECORDING_GOAL,
    )


# ---- sessions


def compare_sessions(scene: Scene, sessions: Sequence[int], first_seed: int) -> Comparison:
    """Predict the accuracy in a room, and reach it in simulated sessions."""
    predicted, reached, refused = [], [], []
    for number in sessions:
        session = _simulate(scene, first_seed + number, DURATION_S)
        try:
            solution = solve(session.sweeps, session.scene)
        except LocatkError as error:
            refused.append(error.message)
            continue
        if solution.artifact.frame_source == "design":
            refused.append("the designed poses were used")
            continue
        estimate, truth = _positions(solution.trajectories, session)
        dims = 2 if scene.planar else 3
        to = umeyama(estimate[:, :dims], truth[:, :dims])
        offset = to.apply(estimate[:, :dims]) - truth[:, :dims]
        reached.append(np.mean(np.sum(offset**2, axis=1)))
        predicted.append(_predicted_variance(scene, truth))
    if not reached:
        return Comparison(math.nan, math.nan, 0, tuple(refused))
    return Comparison(
        float(np.sqrt(np.mean(predicted))),
        float(np.sqrt(np.mean(reached))),
        len(reached),
        tuple(refused),
    )


def _predicted_variance(scene: Scene, points_m: Array) -> float:
    """Return the mean predicted variance of positions at some of the driven points.

    ``room check`` predicts it for a recording that fills the working volume evenly. Robots that
    drive between random points are more often in its middle: the scene is solved from the points
    that are driven, and these are compared.
    """
    assert scene.room is not None
    points = points_m[:: max(1, len(points_m) // MAX_PREDICTED_POINTS)]
    position, rotation, _ = stack_stations(scene.stations)
    is_seen = seen_stations(scene.room, position, rotation, points, REQUEST)
    sigma = predict_solved_positions(
        position, rotation, points, is_seen, is_planar=scene.room.is_planar
    ).sigma_m
    return float(np.mean(sigma[np.isfinite(sigma)] ** 2))


def _simulate(scene: Scene, seed: int, duration_s: float) -> SimulatedSession:
    return simulate(
        SimulationOptions(
            robots=ROBOTS,
            duration_s=duration_s,
            speed_mps=SPEED_MPS,
            noise_rad=ANGLE_SIGMA_RAD,
            room=scene,
            seed=seed,
        )
    )


def _positions(tracks: Sequence[Trajectory], session: SimulatedSession) -> tuple[Array, Array]:
    """Return the estimated and the true positions (n, 3) at the times of all poses."""
    truth = {track.device: track for track in session.truth}
    estimates, trues = [], []
    for track in tracks:
        true = truth[track.device]
        estimates.append(track.position)
        trues.append(at_times(track.time_ns, true.time_ns, true.position))
    return np.concatenate(estimates), np.concatenate(trues)
