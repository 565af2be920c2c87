"""Figures of the planning of Polaris: predictions against simulations and published recordings.

Each of twenty tasks (fixed seeds) has a design of tags, a clearance, a speed, a route with tags at
some spacing, and standard deviations of the odometry, of the magnets in the tags and of the tags
on the floor. The prediction (:mod:`locatk.core.polaris.design.routes`) knows these standard
deviations, the design and the route. Several drives are simulated, each over tags that were built
and laid anew. Discs are cylinders (magpylib), the axes of a sensor are converted one after the
other, and odometry has errors of scale and drift and a random walk of its heading. The drives are
solved as by ``locatk solve`` (poses at the tags) and as by ``locatk live`` (poses between the tags:
that filter knows the tags behind it only, as the forecast does), with the designed positions of the
tags.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import (
    heading_from_quaternion,
    quaternion_from_heading,
    umeyama,
    wrap_angle,
)
from locatk.core.polaris.array import Samples
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.design.accuracy_bound import magnet_covariance, pose_covariance
from locatk.core.polaris.design.planning import ReadingConditions, sensor_array
from locatk.core.polaris.design.routes import (
    SiteForecast,
    forecast_routes,
    path_covariance,
    tag_fix_covariance,
)
from locatk.core.polaris.design.site import SitePoint, place_tags
from locatk.core.polaris.mlx90393 import Settings
from locatk.core.polaris.simulation.options import SimulationOptions, usual_bar
from locatk.core.polaris.simulation.session import SimulatedSession, simulate
from locatk.core.polaris.solver import solve
from locatk.core.polaris.stream import PolarisStream
from locatk.core.polaris.tag import Magnet, PlanarPose, Tags, cell_positions
from locatk.core.routes import Route
from locatk.core.streaming.events import PoseEstimate
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.core.streaming.planar_filter import OdometryNoise
from locatk.core.streaming.tracker import DEFAULT_SETTINGS
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.figures import Figure, measure_or_explain
from locatk.formats.benchmarks.plan.ratios import TAIL_RATIO, ratio_figures
from locatk.formats.benchmarks.plan.truth import at_times, planar_poses
from locatk.formats.benchmarks.polaris.suite import (
    SAMPLE_RATE_HZ,
    SET_IDS,
    SPEED_MPS,
    read_runs,
    solve_run,
    summarize_run,
)
from locatk.formats.importers.polaris_csv import PUBLISHED_TAGS

Array = NDArray[np.float64]

SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
"""Signs of the errors of scale and drift of the odometry in the drives of a task."""

TASKS, DRIVES, TAGS = 20, len(SIGNS), 4
"""Tasks, simulated drives of each, and tags along each route."""

FIRST_SEED = 25_100

RATE_HZ = 60.0
"""Sampling rate: the highest of the MLX90393 with the settings of the published arrays, whose noise
is known."""

MAX_DISCS_M = ((2e-3, 0.5e-3, 1.45), (2e-3, 1e-3, 1.3), (3e-3, 1e-3, 1.3))
"""Diameter, height and remanence [T] of the magnets."""

RUN_UP_M = 0.2
"""Distance before the first tag and after the last one."""

CHUNK_SAMPLES = 6
"""Samples of field and odometry that are given to the filter at once, a tenth of a second."""

BUILD_SIGMA_M = 4e-4
"""Standard deviation of the magnets in a tag along each axis: drawn with a ruler of 1 mm (uniform
error, 0.29 mm), and set with tweezers on a mark that the disc hides (0.3 mm; Polaris paper, section
7.2). It is the value of the solver."""

KINDS = (
    "position at tags",
    "heading at tags",
    "position along the route",
    "heading along the route",
)


@dataclass(frozen=True)
class PlanningTask:
    """One task: what is planned, and what is simulated.

    Attributes
    ----------
    tags : Tags
        With the designed site and the standard deviations of its tags.
    route : Route
        Through the middles of the tags.
    use : ReadingConditions
    noise : OdometryNoise
    build_angle_rad : float
        Standard deviation of the orientations of the magnets.
    """

    tags: Tags
    route: Route
    use: ReadingConditions
    noise: OdometryNoise
    build_angle_rad: float

    def predict(self) -> SiteForecast:
        """Return the forecast."""
        return forecast_routes(self.tags, [self.route], self.use, self.noise)


def make_task(number: int) -> PlanningTask:
    """Draw a task."""
    rng = np.random.default_rng(FIRST_SEED + number)
    order = int(rng.integers(3, 5))
    diameter_m, height_m, remanence_t = MAX_DISCS_M[rng.integers(len(MAX_DISCS_M))]
    tags = Tags(
        order=order,
        magnets=int(rng.integers(5, 8)),
        spacing_m=float(rng.uniform(0.03, 0.045)),
        magnet=Magnet(diameter_m, height_m, remanence_t, ""),
        clearance_m=float(rng.uniform(0.008, 0.012)),
    )
    spacing_m = float(rng.uniform(0.6, 1.5))
    turns = rng.uniform(-math.radians(15), math.radians(15), TAGS - 1)
    headings = np.cumsum(turns)
    steps = spacing_m * np.column_stack([np.cos(headings), np.sin(headings)])
    middle_m = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
    # A robot passes a tag in the direction between its neighbours.
    along = middle_m[np.minimum(np.arange(TAGS) + 1, TAGS - 1)]
    along = along - middle_m[np.maximum(np.arange(TAGS) - 1, 0)]
    direction = np.arctan2(along[:, 1], along[:, 0])
    tag_heading = direction + rng.choice(4, TAGS) * math.pi / 2
    ends = RUN_UP_M * np.column_stack([np.cos(direction), np.sin(direction)])
    before_m, after_m = middle_m[:1] - ends[:1], middle_m[-1:] + ends[-1:]
    points = [
        SitePoint(x, y, heading)
        for (x, y), heading in zip(middle_m.tolist(), tag_heading.tolist(), strict=True)
    ]
    site = place_tags(tags, points, min_distance=2)
    laid = float(rng.uniform(0.5e-3, 2e-3)), math.radians(rng.uniform(0.2, 0.8))
    sigma = dict.fromkeys(site.site, (laid[0], laid[0], laid[1]))
    noise = OdometryNoise(
        scale=float(rng.uniform(0.003, 0.015)),
        rotation_scale=0.0,
        drift_rad_per_m=float(rng.uniform(0.005, 0.05)),
        distance_m=0.0,
        heading_rad=float(rng.uniform(0.002, 0.01)),
        rotation_rad=0.0,
        slip_m=0.0,
        slip_rad=0.0,
    )
    return PlanningTask(
        replace(site, site_sigma=sigma),
        Route(np.concatenate([before_m, middle_m, after_m])),
        ReadingConditions(
            rate_hz=RATE_HZ, settings=Settings(), speed_mps=float(rng.uniform(0.05, 0.2))
        ),
        noise,
        math.radians(rng.uniform(1, 5)),
    )


def figures(data: Path) -> list[Figure]:
    """Return all figures; ``data`` is the folder of published recordings."""
    missing = Figure("polaris recordings: predicted and reached errors", None, "", "", TAIL_RATIO)
    return [
        *simulated_figures(),
        *measure_or_explain(lambda: recording_figures(data / "polaris"), missing),
        rate_figure(),
    ]


# ---- a simulated drive


def drive(
    task: PlanningTask, seed: int, signs: tuple[float, float]
) -> tuple[SimulatedSession, Trajectory]:
    """Simulate a drive over tags that were laid anew; return it with its odometry.

    The constant errors of the odometry, scale and drift, are plus or minus their standard
    deviations: four drives with all ``signs`` have exactly these standard deviations, and no
    correlation, which four random numbers would not.
    """
    rng = np.random.default_rng([FIRST_SEED, seed])
    laid = {
        tag_id: PlanarPose(*(np.array([p.x_m, p.y_m, p.heading_rad]) + s * rng.normal(size=3)))
        for (tag_id, p), s in zip(task.tags.site.items(), _sigmas(task.tags), strict=True)
    }
    session = simulate(
        replace(task.tags, site=laid, site_sigma={}),
        SimulationOptions(
            array=usual_bar(rate_hz=RATE_HZ, noise_t=None),
            rate_hz=RATE_HZ,
            route=_order_along(task),
            speed_mps=task.use.speed_mps,
            build_angle_rad=task.build_angle_rad,
            build_place_m=BUILD_SIGMA_M,
            build_seed=seed,
            odometry=True,
            odometry_scale=signs[0] * task.noise.scale,
            odometry_turn_rad=task.noise.heading_rad,
            seed=seed,
        ),
    )
    if session.odometry is None:
        raise AssertionError("odometry was asked for")
    return session, with_drift(session.odometry, signs[1] * task.noise.drift_rad_per_m)


def with_drift(odometry: Trajectory, drift_rad_per_m: float) -> Trajectory:
    """Return odometry whose heading drifts by an angle per metre, besides its other errors."""
    position = odometry.position[:, 0] + 1j * odometry.position[:, 1]
    steps = np.diff(position)
    rotation = np.r_[0.0, drift_rad_per_m * np.cumsum(np.abs(steps))]
    drifted = np.r_[0.0, np.cumsum(steps * np.exp(1j * (rotation[1:] + rotation[:-1]) / 2))]
    heading = heading_from_quaternion(odometry.quaternion) + rotation
    return replace(
        odometry,
        position=np.column_stack([drifted.real, drifted.imag, odometry.position[:, 2]]),
        quaternion=quaternion_from_heading(heading),
    )


def _sigmas(tags: Tags) -> list[Array]:
    return [np.array(tags.site_sigma[tag_id]) for tag_id in tags.site]


def _order_along(task: PlanningTask) -> tuple[int, ...]:
    """Return the ids of the tags in the order of the route."""
    position = np.array([[p.x_m, p.y_m] for p in task.tags.site.values()])
    ids = np.array(list(task.tags.site))
    middle_m = task.route.waypoint_m[1:-1]
    distance = np.hypot(*(position[None] - middle_m[:, None]).transpose(2, 0, 1))
    return tuple(ids[distance.argmin(axis=1)].tolist())


# ---- reached errors


def errors_at_tags(task: PlanningTask, session: SimulatedSession, odometry: Trajectory) -> Array:
    """Return the errors (k, 3) of x, y [m] and heading [rad] of solved poses over the tags."""
    solution = solve([session.samples], task.tags, odometry=(odometry,))
    read = {detection.tag_id for detection in solution.detections}
    times = [each.time_ns for each in session.crossings if each.tag_id in read]
    if not solution.trajectories or not times:
        return np.empty((0, 3))
    return _errors(solution.trajectories[0], session.truth, np.array(times))


def errors_along(task: PlanningTask, session: SimulatedSession, odometry: Trajectory) -> Array:
    """Return the errors (n, 3) of live poses from the first tag to the last one."""
    settings = replace(DEFAULT_SETTINGS["polaris"], odometry=task.noise)
    localizer = LiveLocalizer(PolarisStream(task.tags), settings)
    samples, events = session.samples, []
    for first in range(0, len(samples.time_ns), CHUNK_SAMPLES):
        rows = np.arange(first, min(first + CHUNK_SAMPLES, len(samples.time_ns)))
        events += localizer.push(
            replace(samples, time_ns=samples.time_ns[rows], field_t=samples.field_t[rows])
        )
        events += localizer.push(odometry.select(rows))
    poses = {each.time_ns: each for each in events if isinstance(each, PoseEstimate)}
    first_ns, last_ns = session.crossings[0].time_ns, session.crossings[-1].time_ns
    times = np.array(sorted(time for time in poses if first_ns <= time <= last_ns), np.int64)
    if not len(times):
        return np.empty((0, 3))
    live = Trajectory(
        samples.device,
        "site",
        times,
        np.array([poses[time].position for time in times.tolist()]),
        np.array([poses[time].quaternion for time in times.tolist()]),
        np.array([poses[time].covariance for time in times.tolist()]),
    )
    return _errors(live, session.truth, times)


def _errors(estimate: Trajectory, truth: Trajectory, time_ns: NDArray[np.int64]) -> Array:
    first, second = (
        at_times(time_ns, each.time_ns, planar_poses(each)) for each in (estimate, truth)
    )
    difference = first - second
    difference[:, 2] = wrap_angle(difference[:, 2])
    return difference


@dataclass(frozen=True)
class TaskErrors:
    """Predicted and reached rms errors of a task, in the order of :data:`KINDS`.

    Attributes
    ----------
    predicted, reached : (4,) ndarray
        In m and rad.
    read, passed : int
        Tags that were read, and that were passed, in all drives.
    """

    predicted: Array
    reached: Array
    read: int
    passed: int

    @property
    def ratio(self) -> Array:
        """(4,) predicted over reached."""
        return self.predicted / self.reached


def measure_task(task: PlanningTask, seed: int, drives: int = DRIVES) -> TaskErrors:
    """Predict a task, and simulate and solve its drives."""
    (route,) = task.predict().routes
    accuracy = route.accuracy
    fixes = np.array(
        [
            tag_fix_covariance(
                task.tags,
                task.use,
                tag_id=each.tag_id,
                heading_rad=each.heading_rad,
                offset_m=each.offset_m,
                noise=task.noise,
            )
            for each in route.passes
        ]
    )
    first_m, last_m = route.passes[0].distance_m, route.passes[-1].distance_m
    weight = accuracy.weight_m
    weight[(accuracy.distance_m <= first_m) | (accuracy.distance_m > last_m)] = 0.0
    predicted2 = [
        np.trace(fixes[:, :2, :2], axis1=1, axis2=2).mean(),
        fixes[:, 2, 2].mean(),
        _weighted_mean(accuracy.position_rms_m**2, weight),
        _weighted_mean(accuracy.heading_sigma_rad**2, weight),
    ]
    at_tags, along, passed = [], [], 0
    for number in range(drives):
        session, odometry = drive(task, seed + number, SIGNS[number % len(SIGNS)])
        at_tags.append(errors_at_tags(task, session, odometry))
        along.append(errors_along(task, session, odometry))
        passed += len(session.crossings)
    reached2 = []
    for part in (at_tags, along):
        x, y, heading = np.mean(np.concatenate(part) ** 2, axis=0)
        reached2 += [x + y, heading]
    read = sum(len(part) for part in at_tags)
    return TaskErrors(np.sqrt(predicted2), np.sqrt(reached2), read, passed)


def _weighted_mean(values: Array, weight: Array) -> float:
    return float((values[weight > 0] * weight[weight > 0]).sum() / weight.sum())


def simulated_figures(tasks: int = TASKS, drives: int = DRIVES) -> list[Figure]:
    """Compare the predictions of random tasks with simulated drives."""
    results = [
        measure_task(make_task(number), FIRST_SEED + DRIVES * number, drives)
        for number in range(tasks)
    ]
    ratios = np.array([result.ratio for result in results])
    read, passed = sum(r.read for r in results), sum(r.passed for r in results)
    how = (
        f"{tasks} random tasks, {drives} simulated drives over {TAGS} tags each, "
        f"{read} of {passed} tags read"
    )
    figures = []
    for kind, ratio in zip(KINDS, ratios.T, strict=True):
        solver = "`locatk solve`" if kind.endswith("tags") else "`locatk live`"
        figures += ratio_figures(
            f"polaris: predicted over reached, {kind}", ratio, f"{how}; {solver}"
        )
    return figures


# ---- the published recordings


@dataclass(frozen=True)
class RecordingErrors:
    """Predicted and reached errors of the magnets of one published tag.

    Attributes
    ----------
    position_m : (predicted, reached)
        Mean distance of the magnets from the grid, after rigid alignment.
    scatter_m : (predicted, reached)
        Rms by axis of their positions about the mean of each over the runs, after alignment.
    angle_rad : (predicted, reached)
        The same of their angles in the frame of the tag.
    heading_rad : (predicted, reached)
        Mean absolute heading of the tag; the true one is nominally 0.
    """

    position_m: tuple[float, float]
    scatter_m: tuple[float, float]
    angle_rad: tuple[float, float]
    heading_rad: tuple[float, float]


def measure_recordings(samples: Sequence[Samples], tag_id: int) -> RecordingErrors:
    """Predict the errors of the recordings of one tag, and solve them.

    The prediction knows the design of the tag and of the bar, the speed of the authors and the
    noise of the sensors, that magnets were placed by hand and that the robot had no odometry: each
    step is unknown, the path is assumed to be straight, and the spacing of the tag gives the scale.
    """
    tags, layout = PUBLISHED_TAGS, layout_of(PUBLISHED_TAGS, tag_id)
    cells_m = cell_positions(tags, layout.cells)
    array, _ = sensor_array(ReadingConditions())
    measured = magnet_covariance(tags, layout, array, step_m=SPEED_MPS / SAMPLE_RATE_HZ)
    measured = measured + path_covariance(cells_m[:, 0], OdometryNoise(), has_scale=False)
    is_position = np.arange(len(measured)) % 3 < 2
    residual = _without_alignment(cells_m)
    scatter = residual @ measured[np.ix_(is_position, is_position)] @ residual.T
    placed = scatter + BUILD_SIGMA_M**2 * residual @ residual.T
    angle2 = np.diag(measured)[2::3].mean()
    pose = pose_covariance(tags, layout, measured + BUILD_SIGMA_M**2 * np.eye(len(measured)), 0.0)

    runs = [summarize_run(solve_run(each, "joint"), tag_id) for each in samples]
    runs = [run for run in runs if np.isfinite(run.position_m).all()]
    aligned = np.array(
        [umeyama(run.position_m, cells_m, with_scale=False).apply(run.position_m) for run in runs]
    )
    angles = np.array([run.angle_rad - run.heading_rad for run in runs])
    deviation = wrap_angle(angles - np.angle(np.exp(1j * angles).mean(axis=0)))
    unbiased = len(runs) / (len(runs) - 1)
    return RecordingErrors(
        (_mean_length(placed), float(np.linalg.norm(aligned - cells_m, axis=2).mean())),
        (
            math.sqrt(np.trace(scatter) / len(scatter)),
            math.sqrt(unbiased * float(np.mean((aligned - aligned.mean(axis=0)) ** 2))),
        ),
        (math.sqrt(angle2), math.sqrt(unbiased * float(np.mean(deviation**2)))),
        (
            math.sqrt(2 / math.pi * pose[2, 2]),
            float(np.mean([abs(run.heading_rad) for run in runs])),
        ),
    )


def _without_alignment(cells_m: Array) -> Array:
    """Return the projection (2 M, 2 M) that removes translation, rotation and the scale of x."""
    x, y = (cells_m - cells_m.mean(axis=0)).T
    design = np.zeros((2 * len(x), 4))
    design[0::2, 0] = design[1::2, 1] = 1.0
    design[0::2, 2], design[1::2, 2], design[0::2, 3] = -y, x, x
    basis = np.linalg.qr(design)[0]
    return np.asarray(np.eye(len(design)) - basis @ basis.T)


def _mean_length(covariance: Array) -> float:
    """Return the mean length of the errors of points whose covariance is (2 M, 2 M)."""
    angle = (np.arange(256) + 0.5) * math.pi / 256
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    blocks = [covariance[k : k + 2, k : k + 2] for k in range(0, len(covariance), 2)]
    # A Gaussian error is r L u: the mean of r is sqrt(pi / 2), u is a unit vector.
    sigma = np.sqrt([np.einsum("ki,ij,kj->k", direction, block, direction) for block in blocks])
    return math.sqrt(math.pi / 2) * float(sigma.mean())


def recording_figures(folder: Path) -> Iterator[Figure]:
    """Compare predictions with the published recordings."""
    recordings = read_runs(folder)
    for name, samples in recordings.items():
        errors = measure_recordings(samples, SET_IDS[name])
        how = f"{len(samples)} published runs over one tag; the prediction knows its design"
        placed = f"{how}, and that magnets are set by hand to 0.4 mm"
        bound = f"{how}; noise and a path that bends as wheels drift: no forecast, but a bound"
        yield _recording_figure(name, "magnets, rigid-aligned", errors.position_m, placed, True)
        yield _recording_figure(name, "heading of the tag", errors.heading_rad, placed, True)
        yield _recording_figure(name, "scatter of positions", errors.scatter_m, bound, False)
        yield _recording_figure(name, "scatter of angles", errors.angle_rad, bound, False)


def _recording_figure(
    name: str, kind: str, errors: tuple[float, float], how: str, has_target: bool
) -> Figure:
    predicted, reached = errors
    ratio = predicted / reached
    return Figure(
        f"polaris recordings, {name}: predicted and reached {kind}, larger ratio",
        max(ratio, 1 / ratio), "", f"predicted / reached {ratio:.2f}; {how}",
        TAIL_RATIO if has_target else None,
    )  # fmt: skip


def rate_figure() -> Figure:
    """Return the sampling rate that the published firmware can have."""
    return Figure(
        "polaris paper, 7.1: sampling rate of the published firmware", Settings().max_rate_hz, "Hz",
        "OSR 3, DIG_FILT 3: 16.05 ms for three axes, and the readout; refutes 100 Hz",
        peer="Polaris paper", peer_value=100.0,
    )  # fmt: skip
