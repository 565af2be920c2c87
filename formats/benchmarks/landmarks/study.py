"""Simulated visits of which everything is known, and what a method makes of them.

The field is that of every bar as a cuboid (magpylib), each with an error of its strength
and place; sensors have noise, gains, offsets and the Earth's field; odometry errs in scale,
heading and turns (:class:`.simulation.options.Errors`). Visits whose
sensors never enter the territory are left out, as in the paper's study.

Errors of places are those of the landmark's centre in the robot's frame at the end of the
visit, as a robot needs it to drive there: what odometry has lost on the way counts.
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
from locatk.core.landmarks.detection import fit
from locatk.core.landmarks.detection import hypotheses as estimate
from locatk.core.landmarks.detection.hypotheses import detect_landmark
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
from locatk.core.landmarks.published import search as paper
from locatk.core.landmarks.published.pose_compensation import compensate_pose
from locatk.core.landmarks.published.second_step import find_spins
from locatk.core.landmarks.simulation.floor import BAR_DRAWS, bar_fields, scatter_bars
from locatk.core.landmarks.simulation.options import Errors
from locatk.core.landmarks.simulation.passes import SinglePass, simulate_passes
from locatk.core.landmarks.solver import SolveOptions

Array = NDArray[np.float64]

GEOMETRY = Geometry()

HALF_PI = math.pi / 2

SURE = 0.99
"""Probability of a code above which it should hardly ever be another."""

EDGES = (0.0, 0.5, 0.7, 0.9, 0.97, 0.99, 1.0)
"""Of the bins of probability in which calibration is judged."""

STAND_M, STAND_RAD = 0.003, math.radians(3)
"""Standard deviations of a robot that stands at a landmark, along each axis."""

FARTHEST_M, FARTHEST_RAD = 0.010, math.radians(5)
"""How far it is off the centre at most; its heading, where it stands anywhere within."""

STATIC = Errors(
    noise_t=0.15e-3 / 10, offset_t=0.1e-3, gain=0.02, earth_t=0.0, bar_strength=0.04,
    bar_place_m=0.3e-3,
)  # fmt: skip
"""Errors of the static fit: nominal parts, and the mean of a hundred samples."""


@dataclass(frozen=True)
class Found:
    """What a method has found in one visit.

    Attributes
    ----------
    number : int
        Of the visit, among all that were simulated.
    lines : int
        Of sensors that entered the territory.
    visits : int
        Into which the recording fell: one is right. The last of them counts.
    error_m : float
        Of the landmark's centre in the robot's last frame; ``nan`` where nothing was found.
    heading_rad : float
        Error of the robot's heading.
    right : bool
        Pattern and orientation: the code.
    probability : float
        That was told of the code.
    true_probability : float
        That was told of the true code.
    entropy : float
        Of the probabilities of all codes, in nats.
    nees : float
        Squared error of the pose in units of its covariance; 3 is expected.
    """

    number: int
    lines: int
    visits: int = 1
    error_m: float = math.nan
    heading_rad: float = math.nan
    right: bool = False
    probability: float = math.nan
    true_probability: float = 0.0
    entropy: float = math.nan
    nees: float = math.nan


def visited(count: int, then: str, seed: int) -> list[tuple[int, SinglePass]]:
    """At least ``count`` simulated visits that were not missed, with their numbers."""
    made: list[tuple[int, SinglePass]] = []
    while len(made) < count:
        # A tenth of the passes misses the territory.
        batch = simulate_passes(math.ceil(1.15 * (count - len(made))) + 2, then=then, seed=seed)
        first = made[-1][0] + 1 if made else 0
        made += [(first + k, one) for k, one in enumerate(batch) if one.lines > 0]
        seed += 1
    return made[:count]


def last_visit(one: SinglePass) -> tuple[HallRecording, VisitSegment | None, int]:
    """The recording, the last visit that is found in it, and how many were."""
    run = preprocess(one.samples, one.odometry)
    found = segment_visits(run, GEOMETRY, OdometryDrift())
    return run, found[-1] if found else None, len(found)


def by_field(number: int, one: SinglePass) -> Found:
    """What the default method says of one visit, on the solver's own road."""
    run, visit, visits = last_visit(one)
    nothing = Found(number, one.lines, visits)
    if visit is None:
        return nothing
    priors = replace(SolveOptions().priors, noise_t=run.noise_t)
    said = detect_landmark(visit, run, GEOMETRY, priors)
    explanations = [one.fit for one in said.hypotheses if one.fit is not None]
    if said.refused:
        return nothing
    best, at = explanations[0], len(visit.trace) - 1
    seen, covariance = estimate.robot_pose(visit.trace, best, at)
    at_ns = int(visit.time_ns[at])
    off = error(seen, true_pose(one, at_ns))
    # On to the end of the recording by odometry.
    here = compose(visit.origin, visit.trace.pose[at])
    last = compose(seen, relative(run.pose[-1:], here)[0])
    codes: dict[int, float] = {}
    true = 0.0
    for other in explanations:
        pose = estimate.robot_pose(visit.trace, other, at)[0]
        codes[other.code] = codes.get(other.code, 0.0) + other.probability
        true += other.probability * (other.code == code_in_frame(one, pose, at_ns))
    share = np.array(list(codes.values()))
    return Found(
        number,
        one.lines,
        visits,
        centre_error(last, one.end),
        float(off[2]),
        best.code == code_in_frame(one, seen, at_ns),
        codes[best.code],
        true,
        max(0.0, float(-(share * np.log(share)).sum())),
        float(off @ np.linalg.solve(covariance, off)),
    )


def by_voting(number: int, one: SinglePass) -> tuple[Found, Found]:
    """First estimates of the same visit by the paper's rules and by voting."""
    steps = paper.first_steps(one.samples, one.odometry, GEOMETRY)
    if not steps:
        return (Found(number, one.lines, 0),) * 2
    step = max(steps, key=lambda step: step.stop - step.first)
    end = last_odometry(one)
    return (
        Found(number, one.lines, len(steps), _off_centre(step.centre_m, end, one)),
        Found(number, one.lines, len(steps), _off_centre(step.voted_m, end, one)),
    )


def by_valleys(number: int, one: SinglePass) -> Found:
    """The paper's second step alone: the valleys of the spin, with no voltages after it."""
    run, visit, visits = last_visit(one)
    spins = find_spins(run.pose)
    if visit is None or not spins:
        return Found(number, one.lines, visits)
    spin = slice(*spins[-1])
    lever_arm = run.samples.sensors.position_m
    field = run.samples.field_t[spin] - run.offset_t
    valleys, middle = paper.spin_valleys(run.pose[spin], field, lever_arm, GEOMETRY)
    reading = None if valleys is None else paper.recognise_spin(valleys, middle, lever_arm)
    if reading is None:
        return Found(number, one.lines, visits)
    code, seen = paper.pose_by_valleys(reading, run.pose[-1])
    at_ns = int(one.samples.time_ns[-1])
    return Found(
        number,
        one.lines,
        visits,
        centre_error(seen, one.end),
        float(error(seen, true_pose(one, at_ns))[2]),
        code == code_in_frame(one, seen, at_ns),
        1.0,
    )


# ---- what is true


def true_pose(one: SinglePass, time_ns: int) -> Array:
    """(3,) robot in the landmark's frame, the heading unwrapped over the visit."""
    truth = one.truth
    start = truth.time_ns[0]
    time, at = (truth.time_ns - start) * 1e-9, (time_ns - start) * 1e-9
    heading = np.unwrap(heading_from_quaternion(truth.quaternion))
    columns = (truth.position[:, 0], truth.position[:, 1], heading)
    return np.array([np.interp(at, time, column) for column in columns])


def error(seen: Array, true: Array) -> Array:
    """(3,) of a pose in a landmark's frame that may be turned by quarter turns."""
    quarters = HALF_PI * round((true[2] - seen[2]) / HALF_PI)
    cos, sin = math.cos(quarters), math.sin(quarters)
    x, y, heading = true
    off = seen - np.array([cos * x + sin * y, cos * y - sin * x, heading - quarters])
    off[2] = math.remainder(off[2], math.tau)
    return np.asarray(off)


def code_in_frame(one: SinglePass, seen: Array, time_ns: int) -> int:
    """The true code in the frame of a hypothesis that has the robot at ``seen``."""
    quarters = round((true_pose(one, time_ns)[2] - seen[2]) / HALF_PI)
    return int(rotated(one.code, -quarters))


def centre(pose: Array) -> Array:
    """(2,) of the landmark in the frame of a robot at ``pose`` in the landmark's frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return -np.array([cos * pose[0] + sin * pose[1], cos * pose[1] - sin * pose[0]])


def centre_error(seen: Array, true: Array) -> float:
    """Distance between the landmark's centre as found and as it is, in the robot's frame."""
    return float(np.hypot(*(centre(seen) - centre(true))))


def last_odometry(one: SinglePass) -> Array:
    """(3,) the robot at the end of the visit, by its odometry."""
    heading = heading_from_quaternion(one.odometry.quaternion[-1:])
    return np.array([*one.odometry.position[-1, :2], heading[0]])


def _off_centre(place: Array, end: Array, one: SinglePass) -> float:
    """Of a centre in the odometry's frame, seen by a robot at ``end`` in the same frame."""
    own = relative(np.array([[*place, 0.0]]), end)[0, :2]
    return float(np.hypot(*(own - centre(one.end))))


# ---- figures of many


def errors_mm(found: Sequence[Found]) -> Array:
    """Errors of places in mm, where there is one; ``nan`` alone where there is none."""
    every = np.array([one.error_m for one in found]) * 1e3
    known = every[np.isfinite(every)]
    return known if len(known) else np.array([math.nan])


def rms_deg(angles: Sequence[float]) -> float:
    """Rms in degrees of angles, where they are known."""
    every = np.array(angles)
    known = every[np.isfinite(every)]
    return math.degrees(math.sqrt(np.mean(known**2))) if len(known) else math.nan


def calibration(found: Sequence[Found]) -> tuple[float, str]:
    """Expected calibration error of the codes' probabilities, and the bins in words.

    The mean over all visits of how far the share of right codes is from the mean
    probability that was told, bin by bin (Naeini et al., AAAI 2015).
    """
    told = [one for one in found if math.isfinite(one.probability)]
    total, words = 0.0, []
    for low, high in itertools.pairwise(EDGES):
        inside = [one for one in told if low < one.probability <= high + 1e-9 * (high == 1)]
        if not inside:
            continue
        right = float(np.mean([one.right for one in inside]))
        mean = float(np.mean([one.probability for one in inside]))
        total += len(inside) * abs(right - mean)
        words.append(f"{len(inside)} told {100 * mean:.1f} % are {100 * right:.1f} % right")
    return (total / len(told) if told else math.nan), "; ".join(words)


def log_loss(found: Sequence[Found]) -> float:
    """Mean of ``-ln p`` of the true codes; what was not found or not told counts as 1e-9."""
    return float(np.mean([-math.log(np.clip(one.true_probability, 1e-9, 1.0)) for one in found]))


# ---- standing at a landmark


@dataclass(frozen=True)
class Stand:
    """Errors (n, 3) of poses of robots that stand at landmarks: x, y in m, heading in rad.

    Attributes
    ----------
    field, linear, inverted : (n, 3) ndarray
        By the static fit, the paper's linear way, and the same by Newton's method; ``nan``
        where there is no pose.
    nees : (n,) ndarray
        Of the fit.
    """

    field: Array
    linear: Array
    inverted: Array
    nees: Array


def stops(count: int, anywhere: bool, rng: np.random.Generator) -> Array:
    """Poses (count, 3) of robots that stand at landmarks: where robots stop that aim for the
    centre, or anywhere within :data:`FARTHEST_M`."""
    if anywhere:
        away, way = FARTHEST_M * np.sqrt(rng.random(count)), rng.uniform(0, math.tau, count)
        place = away[:, None] * np.column_stack([np.cos(way), np.sin(way)])
        return np.column_stack([place, rng.uniform(-FARTHEST_RAD, FARTHEST_RAD, count)])
    place = rng.normal(0, STAND_M, (count, 2))
    while (far := np.hypot(*place.T) > FARTHEST_M).any():
        place[far] = rng.normal(0, STAND_M, (int(far.sum()), 2))
    return np.column_stack([place, rng.normal(0, STAND_RAD, count)])


def stands(count: int, seed: int, anywhere: bool = False) -> Stand:
    """Static fits from four values each, the landmark's code being known."""
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 16, count)
    true = stops(count, anywhere, rng)
    strength, middle, axes = scatter_bars(GEOMETRY, rng.standard_normal((count, BAR_DRAWS)), STATIC)
    lever = circle(GEOMETRY.circle_m)
    points = np.empty((count, 4, 3))
    points[..., :2], points[..., 2] = sensor_positions(true, lever), GEOMETRY.sensor_height_m
    each = bar_fields(GEOMETRY, middle[:, None], axes[:, None], points[:, :, None])
    field = np.einsum("nsk,nk->ns", each, signs(code) * strength)
    field = field * (1 + rng.normal(0, STATIC.gain, field.shape))
    field += rng.normal(0, STATIC.offset_t, field.shape)
    field += rng.normal(0, STATIC.noise_t, field.shape)
    priors = replace(
        fit.ModelPriors(), gain=STATIC.gain, offset_t=STATIC.offset_t, strength=STATIC.bar_strength,
        bar_position_m=STATIC.bar_place_m, noise_t=STATIC.noise_t, model_error_t=STATIC.noise_t,
    )  # fmt: skip
    field_off, linear, inverted = np.full((3, count, 3), np.nan)
    found = Stand(field_off, linear, inverted, np.full(count, np.nan))
    for k in range(count):
        still = Trace(np.zeros((1, 3)), np.zeros((1, 3, 0)), field[k][None], lever, np.ones(1), 0)
        seen, covariance = estimate.estimate_pose_at_known_landmark(
            still, GEOMETRY, priors, signs(int(code[k])), np.zeros(3)
        )
        off = seen - true[k]
        found.field[k] = off
        found.nees[k] = off @ np.linalg.solve(covariance, off)
        for steps, out in ((1, found.linear), (10, found.inverted)):
            try:
                pose = compensate_pose(GEOMETRY, int(code[k]), lever, field[k], steps=steps)
            except DegenerateError:
                continue
            out[k] = pose - true[k]
    return found
