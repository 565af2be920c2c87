"""Simulated visits to single landmarks, and the results of each method on them.

The field is that of each bar as a cuboid (magpylib) with errors of strength and position; sensors
have noise, gains, offsets and the Earth's field; odometry has errors of scale, heading and
rotation (:class:`locatk.core.landmarks.simulation.options.Errors`). Visits during which no sensor
enters the territory are left out, as in the paper's study.

Position errors are those of the landmark's centre in the robot's frame at the end of the visit,
as a robot needs it to drive there; they include the errors of odometry during the visit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import (
    detect_landmark,
    estimate_pose_at_known_landmark,
    robot_pose,
)
from locatk.core.landmarks.detection.trace import (
    OdometryDrift,
    Trace,
    compose,
    relative,
    sensor_positions,
)
from locatk.core.landmarks.halls import circle
from locatk.core.landmarks.landmark import Geometry, rotated, signs
from locatk.core.landmarks.preprocessing import (
    HallRecording,
    VisitSegment,
    preprocess,
    segment_visits,
)
from locatk.core.landmarks.published import search as published_search
from locatk.core.landmarks.published.pose_compensation import compensate_pose
from locatk.core.landmarks.published.second_step import find_spins
from locatk.core.landmarks.simulation.floor import BAR_DRAWS, bar_fields, scatter_bars
from locatk.core.landmarks.simulation.options import Errors
from locatk.core.landmarks.simulation.passes import SinglePass, simulate_passes
from locatk.core.landmarks.solver import SolveOptions

Array = NDArray[np.float64]

GEOMETRY = Geometry()

HALF_PI = math.pi / 2

CONFIDENT_PROBABILITY = 0.99
"""Probability of a code above which at most 1 % may be wrong."""

CALIBRATION_BIN_EDGES = (0.0, 0.5, 0.7, 0.9, 0.97, 0.99, 1.0)
"""Edges of the bins of probability for the expected calibration error."""

MIN_PROBABILITY = 1e-9
"""Smallest probability of a true code in the log loss; also that of missing results."""

STOP_SIGMA_M, STOP_SIGMA_RAD = 0.003, math.radians(3)
"""Standard deviations of the pose at which a robot stops at a landmark, along each axis."""

MAX_STOP_DISTANCE_M, MAX_STOP_HEADING_RAD = 0.010, math.radians(5)
"""Largest distance from the centre; largest heading of robots that stop anywhere within it."""

STATIC_ERRORS = Errors(
    noise_t=0.15e-3 / 10, offset_t=0.1e-3, gain=0.02, earth_t=0.0, bar_strength=0.04,
    bar_place_m=0.3e-3,
)  # fmt: skip
"""Errors of the static fit: nominal parts, and the mean of a hundred samples."""


@dataclass(frozen=True)
class VisitResult:
    """Errors of a method in one visit.

    Attributes
    ----------
    number : int
        Number of the visit among all that were simulated.
    lines : int
        Number of sensors that entered the territory.
    visits : int
        Visits into which the recording was divided (the truth is one). The last one counts.
    error_m : float
        Error of the landmark's centre in the robot's last frame; ``nan`` without a result.
    heading_rad : float
        Error of the robot's heading.
    is_correct : bool
        True if pattern and orientation (the code) are those of the landmark.
    probability : float
        Reported probability of the reported code.
    true_probability : float
        Reported probability of the true code.
    entropy : float
        Entropy of the probabilities of all codes, in nats.
    nees : float
        Squared error of the pose in units of its covariance; 3 is expected.
    """

    number: int
    lines: int
    visits: int = 1
    error_m: float = math.nan
    heading_rad: float = math.nan
    is_correct: bool = False
    probability: float = math.nan
    true_probability: float = 0.0
    entropy: float = math.nan
    nees: float = math.nan


def simulate_visits(count: int, then: str, seed: int) -> list[tuple[int, SinglePass]]:
    """Simulate ``count`` visits that enter the territory, and return them with their numbers."""
    visits: list[tuple[int, SinglePass]] = []
    while len(visits) < count:
        # A tenth of the passes misses the territory.
        batch = simulate_passes(math.ceil(1.15 * (count - len(visits))) + 2, then=then, seed=seed)
        first = visits[-1][0] + 1 if visits else 0
        visits += [(first + k, visit) for k, visit in enumerate(batch) if visit.lines > 0]
        seed += 1
    return visits[:count]


def last_segment(visit: SinglePass) -> tuple[HallRecording, VisitSegment | None, int]:
    """Preprocess a recording; return it, the last visit detected in it, and their number."""
    recording = preprocess(visit.samples, visit.odometry)
    segments = segment_visits(recording, GEOMETRY, OdometryDrift())
    return recording, segments[-1] if segments else None, len(segments)


def solve_by_field(number: int, visit: SinglePass) -> VisitResult:
    """Solve one visit by the default method."""
    recording, segment, segments = last_segment(visit)
    missing = VisitResult(number, visit.lines, segments)
    if segment is None:
        return missing
    priors = replace(SolveOptions().priors, noise_t=recording.noise_t)
    detection = detect_landmark(segment, recording, GEOMETRY, priors)
    if detection.refused:
        return missing
    fits = [hypothesis.fit for hypothesis in detection.hypotheses if hypothesis.fit is not None]
    best, index = fits[0], len(segment.trace) - 1
    pose, covariance = robot_pose(segment.trace, best, index)
    time_ns = int(segment.time_ns[index])
    error = pose_error(pose, true_pose(visit, time_ns))
    # The pose is propagated to the end of the recording by odometry.
    odometry = compose(segment.origin, segment.trace.pose[index])
    last = compose(pose, relative(recording.pose[-1:], odometry)[0])
    codes: dict[int, float] = {}
    true_probability = 0.0
    for fit in fits:
        codes[fit.code] = codes.get(fit.code, 0.0) + fit.probability
        true_code = code_in_frame(visit, robot_pose(segment.trace, fit, index)[0], time_ns)
        true_probability += fit.probability * (fit.code == true_code)
    probabilities = np.array(list(codes.values()))
    return VisitResult(
        number,
        visit.lines,
        segments,
        centre_error(last, visit.end),
        float(error[2]),
        best.code == code_in_frame(visit, pose, time_ns),
        codes[best.code],
        true_probability,
        max(0.0, float(-(probabilities * np.log(probabilities)).sum())),
        float(error @ np.linalg.solve(covariance, error)),
    )


def solve_first_steps(number: int, visit: SinglePass) -> tuple[VisitResult, VisitResult]:
    """Estimate the centre of the same visit by the paper's rules and by voting."""
    steps = published_search.first_steps(visit.samples, visit.odometry, GEOMETRY)
    if not steps:
        return (VisitResult(number, visit.lines, 0),) * 2
    step = max(steps, key=lambda step: step.stop - step.first)
    return (
        VisitResult(number, visit.lines, len(steps), _odometry_centre_error(step.centre_m, visit)),
        VisitResult(number, visit.lines, len(steps), _odometry_centre_error(step.voted_m, visit)),
    )


def solve_by_valleys(number: int, visit: SinglePass) -> VisitResult:
    """Solve one visit by the paper's second step: the valleys of the spin, without voltages."""
    recording, segment, segments = last_segment(visit)
    spins = find_spins(recording.pose)
    if segment is None or not spins:
        return VisitResult(number, visit.lines, segments)
    spin = slice(*spins[-1])
    lever_arm = recording.samples.sensors.position_m
    field = recording.samples.field_t[spin] - recording.offset_t
    valleys, middle = published_search.spin_valleys(
        recording.pose[spin], field, lever_arm, GEOMETRY
    )
    reading = None
    if valleys is not None:
        reading = published_search.recognise_spin(valleys, middle, lever_arm)
    if reading is None:
        return VisitResult(number, visit.lines, segments)
    code, pose = published_search.pose_by_valleys(reading, recording.pose[-1])
    time_ns = int(visit.samples.time_ns[-1])
    return VisitResult(
        number,
        visit.lines,
        segments,
        centre_error(pose, visit.end),
        float(pose_error(pose, true_pose(visit, time_ns))[2]),
        code == code_in_frame(visit, pose, time_ns),
        1.0,
    )


# ---- truth


def true_pose(visit: SinglePass, time_ns: int) -> Array:
    """Return the robot's pose (3,) in the landmark's frame, with an unwrapped heading."""
    truth = visit.truth
    start_ns = truth.time_ns[0]
    times_s, time_s = (truth.time_ns - start_ns) * 1e-9, (time_ns - start_ns) * 1e-9
    heading = np.unwrap(heading_from_quaternion(truth.quaternion))
    columns = (truth.position[:, 0], truth.position[:, 1], heading)
    return np.array([np.interp(time_s, times_s, column) for column in columns])


def pose_error(estimate: Array, truth: Array) -> Array:
    """Return the error (3,) of a pose in a landmark's frame, whatever its quarter rotation."""
    quarters = HALF_PI * round((truth[2] - estimate[2]) / HALF_PI)
    cos, sin = math.cos(quarters), math.sin(quarters)
    x, y, heading = truth
    error = estimate - np.array([cos * x + sin * y, cos * y - sin * x, heading - quarters])
    error[2] = math.remainder(error[2], math.tau)
    return np.asarray(error)


def code_in_frame(visit: SinglePass, pose: Array, time_ns: int) -> int:
    """Return the true code in the frame of a hypothesis in which the robot is at ``pose``."""
    quarters = round((true_pose(visit, time_ns)[2] - pose[2]) / HALF_PI)
    return int(rotated(visit.code, -quarters))


def landmark_centre(pose: Array) -> Array:
    """Return the landmark's centre (2,) in the frame of a robot at ``pose`` (landmark's frame)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return -np.array([cos * pose[0] + sin * pose[1], cos * pose[1] - sin * pose[0]])


def centre_error(estimate: Array, truth: Array) -> float:
    """Return the error [m] of the landmark's centre in the robot's frame, from two poses."""
    return float(np.hypot(*(landmark_centre(estimate) - landmark_centre(truth))))


def _odometry_centre_error(centre_m: Array, visit: SinglePass) -> float:
    """Return the error [m] of a centre in the frame of the odometry, from the robot's last pose."""
    odometry = visit.odometry
    heading = heading_from_quaternion(odometry.quaternion[-1:])
    last = np.array([*odometry.position[-1, :2], heading[0]])
    centre = relative(np.array([[*centre_m, 0.0]]), last)[0, :2]
    return float(np.hypot(*(centre - landmark_centre(visit.end))))


# ---- statistics of many visits


def errors_mm(results: Sequence[VisitResult]) -> Array:
    """Return the known position errors [mm]; one ``nan`` if there are none."""
    errors = np.array([result.error_m for result in results]) * 1e3
    known = errors[np.isfinite(errors)]
    return known if len(known) else np.array([math.nan])


def rms_deg(angles: Sequence[float]) -> float:
    """Return the rms [deg] of the known angles [rad]; ``nan`` if there are none."""
    known = np.array(angles)[np.isfinite(angles)]
    return math.degrees(math.sqrt(np.mean(known**2))) if len(known) else math.nan


def calibration_error(results: Sequence[VisitResult]) -> tuple[float, str]:
    """Return the expected calibration error of the codes' probabilities, and the bins as text.

    It is the mean over all visits of the difference between the fraction of correct codes and the
    mean reported probability, in bins (Naeini et al., AAAI 2015).
    """
    known = [result for result in results if math.isfinite(result.probability)]
    total, texts = 0.0, []
    for low, high in itertools.pairwise(CALIBRATION_BIN_EDGES):
        inside = [r for r in known if low < r.probability <= high + 1e-9 * (high == 1)]
        if not inside:
            continue
        correct = float(np.mean([result.is_correct for result in inside]))
        mean = float(np.mean([result.probability for result in inside]))
        total += len(inside) * abs(correct - mean)
        texts.append(f"{len(inside)} with {100 * mean:.1f} % are {100 * correct:.1f} % correct")
    return (total / len(known) if known else math.nan), "; ".join(texts)


def log_loss(results: Sequence[VisitResult]) -> float:
    """Return the mean of ``-ln p`` of the true codes."""
    probabilities = np.clip([r.true_probability for r in results], MIN_PROBABILITY, 1.0)
    return float(np.mean([-math.log(probability) for probability in probabilities]))


# ---- static fits


@dataclass(frozen=True)
class StaticErrors:
    """Errors (n, 3) of the poses of robots at rest at landmarks: x, y [m], heading [rad].

    Attributes
    ----------
    field, linear, newton : (n, 3) ndarray
        By the static fit, by the paper's linear equations, and by the same with Newton's method;
        ``nan`` without a pose.
    nees : (n,) ndarray
        Squared errors of the fit in units of its covariance.
    """

    field: Array
    linear: Array
    newton: Array
    nees: Array


def random_stops(count: int, anywhere: bool, rng: np.random.Generator) -> Array:
    """Return poses (count, 3) of robots that stop at the centre, or anywhere close to it."""
    if anywhere:
        distance = MAX_STOP_DISTANCE_M * np.sqrt(rng.random(count))
        direction = rng.uniform(0, math.tau, count)
        position = distance[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        heading = rng.uniform(-MAX_STOP_HEADING_RAD, MAX_STOP_HEADING_RAD, count)
        return np.column_stack([position, heading])
    position = rng.normal(0, STOP_SIGMA_M, (count, 2))
    while (is_outside := np.hypot(*position.T) > MAX_STOP_DISTANCE_M).any():
        position[is_outside] = rng.normal(0, STOP_SIGMA_M, (int(is_outside.sum()), 2))
    return np.column_stack([position, rng.normal(0, STOP_SIGMA_RAD, count)])


def solve_stops(count: int, seed: int, anywhere: bool = False) -> StaticErrors:
    """Fit poses to four values each, with a known code of the landmark."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 16, count)
    true = random_stops(count, anywhere, rng)
    draws = rng.standard_normal((count, BAR_DRAWS))
    strength, middle, axes = scatter_bars(GEOMETRY, draws, STATIC_ERRORS)
    lever_arm = circle(GEOMETRY.circle_m)
    points = np.empty((count, 4, 3))
    points[..., :2], points[..., 2] = sensor_positions(true, lever_arm), GEOMETRY.sensor_height_m
    by_bar = bar_fields(GEOMETRY, middle[:, None], axes[:, None], points[:, :, None])
    field = np.einsum("nsk,nk->ns", by_bar, signs(codes) * strength)
    field = field * (1 + rng.normal(0, STATIC_ERRORS.gain, field.shape))
    field += rng.normal(0, STATIC_ERRORS.offset_t, field.shape)
    field += rng.normal(0, STATIC_ERRORS.noise_t, field.shape)
    priors = ModelPriors(
        gain=STATIC_ERRORS.gain, offset_t=STATIC_ERRORS.offset_t,
        strength=STATIC_ERRORS.bar_strength, bar_position_m=STATIC_ERRORS.bar_place_m,
        noise_t=STATIC_ERRORS.noise_t, model_error_t=STATIC_ERRORS.noise_t,
    )  # fmt: skip
    by_field, linear, newton = np.full((3, count, 3), np.nan)
    errors = StaticErrors(by_field, linear, newton, np.full(count, np.nan))
    for k, code in enumerate(codes.tolist()):
        trace = Trace(
            np.zeros((1, 3)), np.zeros((1, 3, 0)), field[k][None], lever_arm, np.ones(1), 0
        )
        pose, covariance = estimate_pose_at_known_landmark(
            trace, GEOMETRY, priors, signs(code), np.zeros(3)
        )
        error = pose - true[k]
        errors.field[k] = error
        errors.nees[k] = error @ np.linalg.solve(covariance, error)
        for steps, by_paper in ((1, errors.linear), (10, errors.newton)):
            try:
                pose = compensate_pose(GEOMETRY, code, lever_arm, field[k], steps=steps)
            except DegenerateError:
                continue
            by_paper[k] = pose - true[k]
    return errors
