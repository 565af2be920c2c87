"""Hypotheses of each visit: codes and poses of a landmark that explain its trace.

Detection of the landmark of one visit:

1. :mod:`.scan` finds initial guesses on a grid of positions, headings and codes.
2. :mod:`.fit` refines them on a thinned trace. Those with too little evidence are dropped after a
   few iterations; the best one is retried with all other codes, because bars on the far side of a
   pass are weakly observed.
3. The remaining ones are fitted to the full trace. Their evidences give the probabilities.
4. If no intact landmark explains the trace, or a bar seems weak, landmarks of which one bar has
   any strength are added.

:func:`detect_landmarks` also checks the sensors: their order, signs and gains.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.detection.fit import (
    ModelPriors,
    ParameterLayout,
    VisitFitProblem,
    VisitFits,
    fit_visit,
    neighbour_fields,
)
from locatk.core.landmarks.detection.scan import (
    COARSE_GRID,
    FINE_GRID,
    INTACT_STRENGTHS,
    ONE_MISSING_STRENGTHS,
    ScanGrid,
    find_candidates,
    has_strong_field,
    source_region,
)
from locatk.core.landmarks.detection.trace import Trace, planar_rotation
from locatk.core.landmarks.landmark import (
    HALF_PI_RAD,
    Geometry,
    signs,
)
from locatk.core.landmarks.map.floor import MISSING_BAR_STRENGTH
from locatk.core.landmarks.preprocessing import (
    HallRecording,
    VisitSegment,
    merge_segments,
    segment_visits,
)
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

MAX_SCAN_SAMPLES = 36
"""Samples for the scan and the first fits."""

MAX_FIT_SAMPLES = 150
"""Samples for the final fits."""

MAX_COARSE_CANDIDATES = 10
MAX_FINE_CANDIDATES = 30
"""Initial guesses from the coarse and from the fine grid."""

SELECTION_ITERATIONS = (3, 4)
"""Iterations of the first fits, after each of which hypotheses without chance are dropped."""

MAX_EARLY_LOG_ODDS = 60.0
"""Log evidence below that of the best hypothesis at which one is dropped during the first fits."""

MAX_LOG_ODDS = 12.0
"""Log evidence below that of the best hypothesis at which one is dropped before the final fits."""

MAX_HYPOTHESES = 8
"""Final fits of intact landmarks, and again of faulty ones; a missing bar gives two codes each."""

MERGE_DIFFERENCE = 3e-3
"""Difference of positions (m) and headings (rad) up to which minima of equal strengths are one."""

FAULTY_STRENGTH_SIGMA = 0.5
"""Standard deviation of the strength of a bar that may be weak or missing."""

MAX_STRENGTH_SIGMAS = 2.5
"""Deviation of a bar's strength from the nominal one at which faulty bars are considered."""

MAX_INTACT_RESIDUAL_SIGMAS = 1.2
"""Rms residual of the best intact landmark above which the fine grid and faulty bars are tried. It
is at most 1 if the model holds, plus three times the scatter of a hundred readings (0.07)."""

MIN_PROBABILITY = 1e-9
"""Probability below which a hypothesis is not reported."""

MIN_BINS = 4
"""Bins of the path below which a visit is too short."""

MAX_POSE_SIGMA_M = 6e-3
MAX_POSE_SIGMA_RAD = math.radians(8)
"""Standard deviations of the best pose above which a visit is too weak: half the distance at which
two initial guesses converge to different minima. Beyond, the field is not linear within the
covariance, and minima that were not tried may be as probable."""

MAX_RESIDUAL_SIGMAS = 6.0
"""Rms residual above which no landmark explains a visit."""

MAX_FITTING_RESIDUAL_SIGMAS = 1.5
"""Rms residual up to which a fit is evidence of the sensors. It includes the error of the model, so
that nominal fits have about 0.6."""

CLUSTERS_OF_SENSOR = 4
"""Parts of a pass in which a residual is taken to be correlated: the fields of three bars and what
is between them."""

SAME_LANDMARK_PITCH_FRACTION = 0.2
"""Distance of landmarks, relative to the pitch, below which two successive visits are one."""

MIN_UNEXPLAINED_FRACTION = 0.25
"""Fraction of unexplained visits above which single sensors are checked."""

MIN_DOUBTFUL_FRACTION = 0.1
"""Fraction of doubtful visits above which order, signs and scale of the sensors are checked."""

MAX_MEAN_SQUARED_DEVIATION = 3.1
"""Mean square of gains, strengths and height, in standard deviations of their priors, above which
a visit is doubtful: the 99.9 % quantile of chi-square with nine degrees of freedom, by each."""

SCALE_STEP = math.sqrt(2)
CHECKED_SCALES = tuple(SCALE_STEP**k for k in range(-6, 7) if k)
"""Common scales of the readings that are tried; the steps are smaller than :data:`.GAIN_RANGE`."""

SCALE_ROUNDS = 4
"""Number of corrections of such a scale by the gains and strengths that are left."""

MIN_CHANGE_LOG_ODDS = 20.0
"""Log evidence of all checked visits in favour of a change from which on it is believed: one in a
million for the prior probability of a fault, and the same again for errors of the model."""

MAX_CHANGE_LOG_LOSS = 7.0
"""Log evidence of a single visit against a change from which on it is not believed (1 : 1000)."""

MIN_SUPPORTING_VISITS = 2
"""Number of visits that must speak for a change by the same odds: a single one may be disturbed."""

MAX_LOG_EVIDENCE = 1e9
"""Log evidence against a change with which no landmark can be fitted."""

MAX_CHECKED_VISITS = 3
"""Doubtful visits, and others, that are used for these checks, which fit each of them many
times."""

MAX_PERMUTED_SENSORS = 4
"""Number of sensors up to which order, signs and faulty sensors are checked."""

RANKING_VISITS, MAX_REFINED_CHANGES = 2, 3
"""Number of visits by which changes of the sensors are ranked, and of the most likely ones by each
of them, which are tried on all visits: a fit to a single visit may miss the minimum."""

MAX_RIVAL_LOG_ODDS = 7.0
"""Log evidence below that of the most likely change down to which others are named as well
(1 : 1000). On a straight path, sensors that follow each other can be exchanged in their roles."""

MAX_GAIN_SIGMAS = 4.0
"""Deviation of a sensor's gain, in standard deviations of its prior, above which a warning is
given."""

MIN_RESIDUAL_RATIO = 3.0
"""Factor by which the residual must decrease without a sensor so that it is left out."""


@dataclass(frozen=True)
class LandmarkFit:
    """Result of fitting one landmark to a trace.

    Attributes
    ----------
    code : int
        In the frame of the fit.
    log_odds : float
        Log evidence plus log prior probability of a fault, up to a constant of the trace.
    parameters : (size,) ndarray
        See :class:`.fit.ParameterLayout`.
    covariance : (size, size) ndarray
    strength, strength_sigma : (4,) ndarray
        Signed, relative to the nominal strength.
    residual_sigma : float
        Rms residual in standard deviations of a sample.
    faulty_bar : int
        Bar that was allowed to have any strength; -1 for none.
    probability : float
        Among all fits to the trace.
    """

    code: int
    log_odds: float
    parameters: Array
    covariance: Array
    strength: Array
    strength_sigma: Array
    residual_sigma: float
    faulty_bar: int = -1
    probability: float = math.nan

    def corrections(self, trace: Trace) -> Array:
        """Return the errors (m,) of the odometry."""
        return self.parameters[ParameterLayout.of_trace(trace).correction]


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of a visit: a code, and the pose of the robot relative to the landmark.

    The frame is that of the landmark, rotated by a multiple of 90 degrees such that the heading
    of the robot in it is within 45 degrees of 0 at the time of the visit. The code is the one that
    this robot reads: a landmark of the code ``designed`` on the map that is visited under a map
    heading of ``q`` quarter turns (plus the heading of :attr:`pose`) has ``code =
    rotated(designed, -q)``.

    Attributes
    ----------
    code : int
        Directions of the bars in this frame.
    probability : float
        Among the hypotheses of the visit; they sum to 1.
    pose : (3,) ndarray
        Robot in this frame at the time of the visit: x, y in metres and heading in radians.
    covariance : (3, 3) ndarray
        Of the pose; ``nan`` if the method does not estimate it.
    strength : (4,) ndarray
        Signed strengths of the bars in this frame, relative to the nominal one; ``nan`` if the
        method does not estimate them.
    strength_sigma : (4,) ndarray
    fit : LandmarkFit or None
        Fit of the field model; None if the method has no such model.
    """

    code: int
    probability: float
    pose: Array
    covariance: Array
    strength: Array
    strength_sigma: Array
    fit: LandmarkFit | None = None


@dataclass(frozen=True)
class VisitHypotheses:
    """Hypotheses of one visit to one landmark.

    Attributes
    ----------
    device : str
    time_ns : int
        Time of a sample of the visit, to which the poses refer.
    first, stop : int
        Samples ``first`` to ``stop - 1``.
    odometry : (3,) ndarray
        Robot at ``time_ns`` by its own odometry: x, y, heading.
    hypotheses : tuple of Hypothesis
        The most probable first; empty if the visit is too short or too weak. They are kept if it is
        ``"not_explained"``, unless there is none within the range of its fields.
    residual_sigma : float
        Rms residual of the best hypothesis in standard deviations of the noise; ``nan`` if the
        method has no model of the samples.
    refused : str
        Machine-readable reason for not using the visit, ``""`` if it is used: ``"too_weak"``,
        ``"too_short"``, ...
    warnings : tuple of SolverWarning
        Without the name of the device.
    """

    device: str
    time_ns: int
    first: int
    stop: int
    odometry: Array
    hypotheses: tuple[Hypothesis, ...]
    residual_sigma: float = float("nan")
    refused: str = ""
    warnings: tuple[SolverWarning, ...] = ()

    @property
    def best(self) -> Hypothesis:
        """Most probable hypothesis; ``IndexError`` if there is none."""
        return self.hypotheses[0]

    def landmark_position(self) -> Array:
        """Return the landmark's centre (2,) of the best hypothesis in the frame of the odometry."""
        x, y, heading = self.best.pose
        rotation = float(self.odometry[2] - heading)
        cos, sin = math.cos(rotation), math.sin(rotation)
        return np.asarray(self.odometry[:2] - [cos * x - sin * y, sin * x + cos * y])


@dataclass(frozen=True)
class DetectedVisit:
    """Segment of a recording at one landmark, with its hypotheses."""

    segment: VisitSegment
    hypotheses: VisitHypotheses


# ---- visits of a recording


def detect_landmarks(
    recording: HallRecording, geometry: Geometry, priors: ModelPriors, pitch_m: float
) -> tuple[HallRecording, list[DetectedVisit]]:
    """Detect the landmarks of all visits, and check the sensors with them.

    Parameters
    ----------
    recording : HallRecording
    geometry : Geometry
    priors : ModelPriors
    pitch_m : float
        Distance of neighbouring landmarks.

    Returns
    -------
    recording : HallRecording
        With warnings of the sensors, and without a sensor that agrees with no landmark.
    visits : list of DetectedVisit
        In order of time, refused ones included.

    Raises
    ------
    InputError
        The sensors are in the wrong order, or one has the opposite sign.
    """
    priors = replace(priors, pitch_m=pitch_m)
    visits = detect_visits(recording, geometry, priors, pitch_m)
    scale = check_wiring(visits, recording, geometry, priors)
    if scale != 1:
        recording = recording.rescaled(scale)
        priors = replace(priors, noise_t=recording.noise_t)
        visits = detect_visits(recording, geometry, priors, pitch_m)
    faulty_sensor = find_faulty_sensor(visits, recording, geometry, priors)
    if faulty_sensor is not None:
        recording = recording.without_sensor(faulty_sensor)
        visits = detect_visits(recording, geometry, priors, pitch_m)
    best = [
        visit.hypotheses.best.fit
        for visit in visits
        if visit.hypotheses.hypotheses and visit.hypotheses.best.fit is not None
    ]
    gain_warnings = check_gains(best, recording, priors)
    recording = replace(recording, warnings=(*recording.warnings, *gain_warnings))
    return recording, visits


def detect_visits(
    recording: HallRecording, geometry: Geometry, priors: ModelPriors, pitch_m: float
) -> list[DetectedVisit]:
    """Detect the landmark of each visit.

    Successive visits are merged if they belong to one landmark, which the robot passed on one
    side and then on the other.
    """
    visits: list[DetectedVisit] = []
    for segment in segment_visits(recording, geometry, priors.drift, pitch_m):
        visit = DetectedVisit(segment, detect_landmark(segment, recording, geometry, priors))
        if visits and not (visits[-1].hypotheses.refused or visit.hypotheses.refused):
            centre = visit.hypotheses.landmark_position()
            distance = np.hypot(*(centre - visits[-1].hypotheses.landmark_position()))
            if distance < SAME_LANDMARK_PITCH_FRACTION * pitch_m:
                merged = merge_segments(
                    recording, visits[-1].segment, segment, centre, priors.drift
                )
                hypotheses = detect_landmark(merged, recording, geometry, priors)
                if not hypotheses.refused:
                    visits[-1] = DetectedVisit(merged, hypotheses)
                    continue
        visits.append(visit)
    return visits


def detect_landmark(
    segment: VisitSegment, recording: HallRecording, geometry: Geometry, priors: ModelPriors
) -> VisitHypotheses:
    """Return the hypotheses of one visit; ``refused`` tells why it must not be used."""
    trace = segment.trace
    is_too_short = len(trace) < MIN_BINS
    fits = [] if is_too_short else fit_landmarks(trace, geometry, priors)
    unread = VisitHypotheses(
        device=recording.samples.device,
        time_ns=int(segment.time_ns[trace.reference]),
        first=segment.first,
        stop=segment.stop,
        odometry=segment.origin,
        hypotheses=(),
    )
    if not fits:
        if is_too_short:
            return replace(unread, refused="too_short")
        is_strong = has_strong_field(trace, geometry)
        return replace(unread, refused="not_explained" if is_strong else "too_weak")
    hypotheses = []
    for fit in fits:
        pose, covariance = robot_pose(trace, fit, trace.reference)
        pose[2] = math.remainder(pose[2], math.tau)
        hypotheses.append(
            Hypothesis(
                fit.code,
                fit.probability,
                pose,
                covariance,
                fit.strength,
                fit.strength_sigma,
                fit,
            )
        )
    residual = fits[0].residual_sigma
    sigma = np.sqrt(np.diag(hypotheses[0].covariance))
    if residual <= MAX_RESIDUAL_SIGMAS and (
        sigma[:2].max() > MAX_POSE_SIGMA_M or sigma[2] > MAX_POSE_SIGMA_RAD
    ):
        return replace(unread, refused="too_weak")
    return replace(
        unread,
        hypotheses=tuple(hypotheses),
        residual_sigma=residual,
        refused="not_explained" if residual > MAX_RESIDUAL_SIGMAS else "",
    )


# ---- fits to one trace


def fit_landmarks(
    trace: Trace, geometry: Geometry, priors: ModelPriors, *, thorough: bool = True
) -> list[LandmarkFit]:
    """Fit all landmarks that may explain a trace.

    Parameters
    ----------
    trace : Trace
    geometry : Geometry
    priors : ModelPriors
    thorough : bool
        Search on a finer grid, and for faulty bars, if intact landmarks fit badly.

    Returns
    -------
    list of LandmarkFit
        The most probable first. Their probabilities sum to 1. Empty if no field is strong, or if
        no landmark within the range of the fields can be fitted.
    """
    if not has_strong_field(trace, geometry):
        return []
    fits = _fit_intact(trace, geometry, priors, COARSE_GRID)
    if not thorough:
        return _with_probabilities(fits)
    if not fits or _best(fits).residual_sigma > MAX_INTACT_RESIDUAL_SIGMAS:
        fits = _fit_intact(trace, geometry, priors, FINE_GRID) or fits
    if not fits:
        return []
    best = _best(fits)
    deviation = np.abs(best.strength - signs(best.code)) / priors.strength
    if deviation.max() > MAX_STRENGTH_SIGMAS or best.residual_sigma > MAX_INTACT_RESIDUAL_SIGMAS:
        fits += _fit_faulty(trace, geometry, priors, float(best.parameters[2]))
    return _with_probabilities(fits)


def robot_pose(trace: Trace, fit: LandmarkFit, index: int) -> tuple[Array, Array]:
    """Return the robot's pose in the landmark's frame at one sample of the trace.

    Returns
    -------
    pose : (3,) ndarray
        x, y, heading in m and rad.
    covariance : (3, 3) ndarray
    """
    layout = ParameterLayout.of_trace(trace)
    landmark = fit.parameters[layout.pose]
    pose = trace.pose[index] + trace.correction[index] @ fit.corrections(trace)
    to_landmark = planar_rotation(landmark[2]).T
    local = to_landmark @ (pose - landmark)
    by_parameters = np.hstack([-to_landmark, to_landmark @ trace.correction[index]])
    by_parameters[:2, 2] = [local[1], -local[0]]
    columns = np.r_[layout.pose, layout.correction]
    covariance = fit.covariance[np.ix_(columns, columns)]
    return local, by_parameters @ covariance @ by_parameters.T


def estimate_pose_at_known_landmark(
    trace: Trace, geometry: Geometry, priors: ModelPriors, strength: Array, start: Array
) -> tuple[Array, Array]:
    """Estimate the robot's pose at a landmark whose code is known.

    Parameters
    ----------
    trace : Trace
        One sample or more: the four fields of a robot at rest suffice.
    geometry : Geometry
    priors : ModelPriors
    strength : (4,) ndarray
        Expected signed strengths of the bars in the landmark's frame, relative to the nominal one;
        0 for a bar whose strength is unknown and fitted.
    start : (3,) ndarray
        Robot in the landmark's frame, accurate to a centimetre and about ten degrees.

    Returns
    -------
    pose : (3,) ndarray
        Robot in the landmark's frame at the reference of the trace.
    covariance : (3, 3) ndarray
    """
    cos, sin = math.cos(start[2]), math.sin(start[2])
    landmark = [-cos * start[0] - sin * start[1], sin * start[0] - cos * start[1], -start[2]]
    problem, initial = _fit_problem(
        trace, geometry, priors, np.asarray(strength, float)[None], np.array([landmark])
    )
    fits = fit_visit(problem, initial)
    return robot_pose(trace, _landmark_fits(problem, fits)[0], trace.reference)


def _best(fits: list[LandmarkFit]) -> LandmarkFit:
    return max(fits, key=lambda fit: fit.log_odds)


def _fit_intact(
    trace: Trace, geometry: Geometry, priors: ModelPriors, grid: ScanGrid
) -> list[LandmarkFit]:
    """Fit landmarks whose bars all have the nominal strength."""
    return _fit_strengths(trace, geometry, priors, INTACT_STRENGTHS, grid)


def _fit_faulty(
    trace: Trace, geometry: Geometry, priors: ModelPriors, heading_rad: float
) -> list[LandmarkFit]:
    """Fit landmarks of which one bar has any strength, in frames near a heading."""
    fits = []
    for fit in _fit_strengths(
        trace, geometry, priors, ONE_MISSING_STRENGTHS, COARSE_GRID, heading_rad
    ):
        bar = fit.faulty_bar
        log_odds = fit.log_odds + math.log(priors.fault_probability)
        if abs(fit.strength[bar]) > MISSING_BAR_STRENGTH:
            fits.append(replace(fit, log_odds=log_odds))
        else:
            # The direction of a missing bar is unknown: both codes are equally probable.
            log_odds -= math.log(2)
            for code in (fit.code, fit.code ^ 1 << bar):
                fits.append(replace(fit, code=code, log_odds=log_odds))
    return fits


def _fit_strengths(
    trace: Trace,
    geometry: Geometry,
    priors: ModelPriors,
    strengths: Array,
    grid: ScanGrid,
    heading_rad: float | None = None,
) -> list[LandmarkFit]:
    """Fit landmarks with the given strengths (L, 4).

    Their frames are those nearest to the given heading, or else to the heading of the best one.
    """
    coarse = trace.thinned(MAX_SCAN_SAMPLES)
    max_candidates = MAX_COARSE_CANDIDATES if grid == COARSE_GRID else MAX_FINE_CANDIDATES
    pose, which = find_candidates(coarse, geometry, strengths, max_candidates, grid)
    if not len(pose):
        return []
    problem, start = _fit_problem(coarse, geometry, priors, strengths[which], pose)
    problem, fits = _fit_and_select(problem, start)
    evidence = fits.log_evidence()
    # Bars at the far side are weakly observed: try all other strengths at the best pose.
    best = int(np.argmax(evidence))
    others = strengths[(strengths != problem.strength[best]).any(axis=1)]
    at_best = np.repeat(fits.parameters[[best], :3], len(others), axis=0)
    other_problem, start = _fit_problem(coarse, geometry, priors, others, at_best)
    other_problem, other_fits = _fit_and_select(other_problem, start, evidence.max())
    evidence = np.concatenate([evidence, other_fits.log_evidence()])
    strength = np.concatenate([problem.strength, other_problem.strength])
    own = slice(problem.layout.neighbour.start)  # Neighbours differ in number and order.
    parameters = np.concatenate([fits.parameters[:, own], other_fits.parameters[:, own]])
    if heading_rad is None:
        heading_rad = math.remainder(float(parameters[np.argmax(evidence), 2]), HALF_PI_RAD)
    kept = np.flatnonzero(evidence > evidence.max() - MAX_LOG_ODDS)
    strength, parameters = _rotate_frames(strength[kept], parameters[kept], heading_rad)
    distinct = _select_distinct(strength, parameters, evidence[kept])[:MAX_HYPOTHESES]
    problem, start = _fit_problem(
        trace.thinned(MAX_FIT_SAMPLES), geometry, priors, strength[distinct], parameters[distinct]
    )
    fits = fit_visit(problem, start)
    # Different initial guesses may have converged to one minimum, which counts once.
    distinct = _select_distinct(problem.strength, fits.parameters, fits.log_evidence())
    middle, radius_m = source_region(trace, geometry)
    distance_m = np.hypot(*(fits.parameters[distinct, :2] - middle).T)
    distinct = distinct[distance_m <= radius_m]
    return _landmark_fits(problem.take(distinct), fits.take(distinct))


def _fit_and_select(
    problem: VisitFitProblem, start: Array, best_evidence: float = -math.inf
) -> tuple[VisitFitProblem, VisitFits]:
    """Fit in a few iterations, and drop hypotheses without chance in between.

    ``best_evidence`` is that of hypotheses outside of the problem.
    """
    for iterations in SELECTION_ITERATIONS:
        fits = fit_visit(problem, start, iterations)
        evidence = fits.log_evidence()
        kept = np.flatnonzero(evidence > max(evidence.max(), best_evidence) - MAX_EARLY_LOG_ODDS)
        problem, fits = problem.take(kept), fits.take(kept)
        start = fits.parameters
        if not len(kept):
            break
    return problem, fits


def _fit_problem(
    trace: Trace, geometry: Geometry, priors: ModelPriors, strength: Array, start: Array
) -> tuple[VisitFitProblem, Array]:
    """Return the problem for strengths (K, 4), of which 0 stands for a faulty bar.

    Returns its initial parameters as well, of which the leading ones are those of ``start`` (K, m).
    """
    sigma = np.where(strength == 0, FAULTY_STRENGTH_SIGMA, priors.strength)
    neighbours = neighbour_fields(trace, geometry, priors, start[:, :3])
    problem = VisitFitProblem(trace, geometry, priors, strength, sigma, neighbours)
    parameters = problem.initial_parameters(start[:, :3])
    parameters[:, : start.shape[1]] = start
    return problem, parameters


def _rotate_frames(strength: Array, parameters: Array, heading_rad: float) -> tuple[Array, Array]:
    """Express landmarks in the frame, among their four, that is nearest to a heading."""
    quarters = np.round((heading_rad - parameters[:, 2]) / HALF_PI_RAD).astype(np.int64)
    rotated_parameters = parameters.copy()
    rotated_parameters[:, 2] += HALF_PI_RAD * quarters
    bars = (np.arange(4) + quarters[:, None]) % 4
    return np.take_along_axis(strength, bars, axis=1), rotated_parameters


def _select_distinct(strength: Array, parameters: Array, evidence: Array) -> NDArray[np.intp]:
    """Return the best of each group of equal hypotheses, the best group first."""
    kept: list[int] = []
    for i in np.argsort(-evidence):
        difference = np.abs(parameters[kept, :3] - parameters[i, :3]).max(axis=1)
        has_same_bars = (strength[kept] == strength[i]).all(axis=1)
        is_duplicate = np.any(has_same_bars & (difference < MERGE_DIFFERENCE))
        if not is_duplicate:
            kept.append(int(i))
    return np.array(kept, np.intp)


def _with_probabilities(fits: list[LandmarkFit]) -> list[LandmarkFit]:
    """Set the probabilities of all fits to a trace; the most probable first."""
    if not fits:
        return []
    log_odds = np.array([fit.log_odds for fit in fits])
    probability = np.exp(log_odds - log_odds.max())
    probability /= probability.sum()
    return [
        replace(fits[i], probability=float(probability[i]))
        for i in np.argsort(-probability, kind="stable")
        if probability[i] > MIN_PROBABILITY
    ]


def _landmark_fits(problem: VisitFitProblem, fits: VisitFits) -> list[LandmarkFit]:
    """Describe the minima of a problem."""
    evidence = fits.log_evidence()
    covariance = np.linalg.inv(fits.information)
    columns = problem.layout.strength
    strength = problem.strength + problem.strength_sigma * fits.parameters[:, columns]
    sigma = problem.strength_sigma * np.sqrt(np.einsum("kii->ki", covariance)[:, columns])
    may_be_faulty = problem.strength == 0
    faulty_bar = np.where(may_be_faulty.any(axis=1), may_be_faulty.argmax(axis=1), -1)
    code = (strength > 0) @ (1 << np.arange(4))
    residual, by_parameters = problem.residuals(fits.parameters, jacobian=True)
    measurements = max(int((~np.isnan(problem.trace.field_t)).sum()), 1)
    rms = np.sqrt(
        np.einsum("kr,kr->k", residual, residual) / (measurements * problem.trace.thinning)
    )
    for i in np.flatnonzero(rms > 1):
        scores = (by_parameters[i] * residual[i][:, None]).reshape(*problem.trace.field_t.shape, -1)
        covariance[i] = widened_covariance(covariance[i], scores, rms[i])
    return [
        LandmarkFit(
            code=int(code[i]),
            log_odds=float(evidence[i]),
            parameters=fits.parameters[i],
            covariance=covariance[i],
            strength=strength[i],
            strength_sigma=sigma[i],
            residual_sigma=float(rms[i]),
            faulty_bar=int(faulty_bar[i]),
        )
        for i in range(len(code))
    ]


def widened_covariance(covariance: Array, scores: Array, residual_sigma: float) -> Array:
    """Widen the covariance of a fit whose residual exceeds noise and error of the model.

    Such a residual is correlated over the whole pass, so that the covariance must grow by more than
    its square. The standard deviations are at least those of the sandwich estimator with clusters
    of one sensor in one part of the pass (Liang and Zeger, Biometrika 73 (1986) 13).

    Parameters
    ----------
    covariance : (p, p) ndarray
    scores : (n, N, p) ndarray
        Derivatives of each sample's share of the cost.
    residual_sigma : float
        Rms residual, above 1.
    """
    parts = np.array_split(scores, CLUSTERS_OF_SENSOR)
    clusters = np.concatenate([part.sum(axis=0) for part in parts])
    count = len(clusters)
    errors = clusters @ covariance
    variance = (errors**2).sum(axis=0) * count / (count - 1)
    nominal = np.diag(covariance)
    widened = np.maximum(variance, residual_sigma**2 * nominal)
    factor = np.sqrt(widened / nominal)
    return np.asarray(factor[:, None] * covariance * factor)


# ---- checks of the sensors


def check_gains(
    fits: Sequence[LandmarkFit], recording: HallRecording, priors: ModelPriors
) -> list[SolverWarning]:
    """Return warnings of sensors whose gain differs from the given one.

    There are none unless most visits fit: gains of other fits make up for other errors.

    Parameters
    ----------
    fits : sequence of LandmarkFit
        Best fit of each visit.
    recording : HallRecording
    priors : ModelPriors

    Raises
    ------
    InputError
        A sensor has the opposite sign.
    """
    fitting = [fit for fit in fits if fit.residual_sigma <= MAX_FITTING_RESIDUAL_SIGMAS]
    if not fits or len(fitting) <= len(fits) / 2:
        return []
    names, device = recording.samples.sensors.names, recording.samples.device
    columns = ParameterLayout.of(len(names), 0).gain
    gains = 1 + priors.gain * np.median([fit.parameters[columns] for fit in fitting], axis=0)
    warnings = []
    for name, gain in zip(names, gains.tolist(), strict=True):
        if gain < 0:
            raise _opposite_sign_error(name, device)
        if abs(gain - 1) > MAX_GAIN_SIGMAS * priors.gain:
            message = f"the gain of the {name} sensor is {gain:.2f} times that of the others"
            warnings.append(SolverWarning("sensor_gain", message).about(device))
    return warnings


@dataclass(frozen=True)
class SensorChange:
    """Hypothetical wiring of the sensors.

    Attributes
    ----------
    order : tuple of int
        Column of each sensor.
    sign : tuple of float
        Of each sensor: -1 if it is the opposite one.
    scale : float
        Readings relative to those expected, common to all sensors.
    """

    order: tuple[int, ...]
    sign: tuple[float, ...]
    scale: float = 1.0


def check_wiring(
    visits: Sequence[DetectedVisit],
    recording: HallRecording,
    geometry: Geometry,
    priors: ModelPriors,
) -> float:
    """Check order, signs and common scale of the sensors if visits fit badly.

    A change is believed if with it most of these visits fit, and if it makes them more probable and
    none of the others less.

    Returns
    -------
    float
        Readings relative to those expected, common to all sensors; 1 if they agree.

    Raises
    ------
    InputError
        The sensors are in the wrong order, or one has the opposite sign; the message names them.
    """
    names, device = recording.samples.sensors.names, recording.samples.device
    longest_first = sorted(visits, key=lambda visit: -len(visit.segment.trace))
    doubtful = [visit.segment.trace for visit in longest_first if is_doubtful(visit)]
    if len(doubtful) <= MIN_DOUBTFUL_FRACTION * len(visits) or len(names) > MAX_PERMUTED_SENSORS:
        return 1.0
    others = [
        visit.segment.trace
        for visit in longest_first
        if not (is_doubtful(visit) or visit.hypotheses.refused)
    ]
    traces = [*doubtful[:MAX_CHECKED_VISITS], *others[:MAX_CHECKED_VISITS]]

    @functools.cache
    def best_fit(change: SensorChange, index: int, grid: ScanGrid) -> LandmarkFit | None:
        trace = traces[index]
        if not has_strong_field(trace, geometry):
            return None
        field = trace.field_t[:, list(change.order)] * change.sign
        scaled = replace(geometry, remanence_t=change.scale * geometry.remanence_t)
        fits = _fit_intact(replace(trace, field_t=field), scaled, priors, grid)
        return _best(fits) if fits else None

    @functools.cache
    def refined_fit(change: SensorChange, index: int) -> LandmarkFit | None:
        """Return the best fit, from a finer grid if that of the coarse one does not fit."""
        fit = best_fit(change, index, COARSE_GRID)
        if fit is None or fit.residual_sigma > MAX_FITTING_RESIDUAL_SIGMAS:
            fits = [one for one in (fit, best_fit(change, index, FINE_GRID)) if one is not None]
            fit = max(fits, key=lambda one: one.log_odds, default=None)
        return fit

    def evidence(fit: LandmarkFit | None) -> float:
        return fit.log_odds if fit is not None else -MAX_LOG_EVIDENCE

    as_given, *changes = _sensor_changes(len(names))
    indices = range(len(traces))
    likely: dict[SensorChange, None] = {}
    for index in indices[:RANKING_VISITS]:
        ranking = [(evidence(best_fit(change, index, COARSE_GRID)), change) for change in changes]
        ranking.sort(key=operator.itemgetter(0), reverse=True)
        likely |= {change: None for _, change in ranking[:MAX_REFINED_CHANGES]}
    total = {
        change: sum(evidence(refined_fit(change, index)) for index in indices) for change in likely
    }
    best = max(likely, key=total.__getitem__)
    gains = [
        evidence(refined_fit(best, index)) - evidence(refined_fit(as_given, index))
        for index in indices
    ]
    if sum(gains) < MIN_CHANGE_LOG_ODDS or min(gains) < -MAX_CHANGE_LOG_LOSS:
        return 1.0
    supporting = sum(gain > MAX_CHANGE_LOG_LOSS for gain in gains)
    if supporting < min(MIN_SUPPORTING_VISITS, len(visits)):
        return 1.0
    fits = [fit for index in indices if (fit := refined_fit(best, index)) is not None]
    if np.median([fit.residual_sigma for fit in fits]) > MAX_FITTING_RESIDUAL_SIGMAS:
        return 1.0
    if best.scale == 1:
        rivals = [
            change
            for change in likely
            if change.scale == 1 and total[change] > total[best] - MAX_RIVAL_LOG_ODDS
        ]
        raise wiring_error(sorted(rivals, key=lambda one: -total[one]), names, device)
    gain = ParameterLayout.of(len(names), 0).gain
    scale = best.scale
    for _ in range(SCALE_ROUNDS):
        # The scales that were tried are far apart, and priors keep gains and strengths near 1.
        remaining = [
            np.mean(1 + priors.gain * fit.parameters[gain]) * np.mean(np.abs(fit.strength))
            for fit in fits
        ]
        scale *= float(np.median(remaining))
        changed = replace(best, scale=scale)
        fits = [
            fit for index in indices if (fit := best_fit(changed, index, COARSE_GRID)) is not None
        ]
    return scale


def is_doubtful(visit: DetectedVisit) -> bool:
    """Return whether a visit is not explained, or only by improbable bars, gains and heights."""
    if visit.hypotheses.refused:
        return visit.hypotheses.refused == "not_explained"
    fit = visit.hypotheses.best.fit
    if fit is None:
        return False
    layout = ParameterLayout.of_trace(visit.segment.trace)
    columns = np.r_[layout.gain, layout.strength, layout.height]
    return float((fit.parameters[columns] ** 2).mean()) > MAX_MEAN_SQUARED_DEVIATION


def find_faulty_sensor(
    visits: Sequence[DetectedVisit],
    recording: HallRecording,
    geometry: Geometry,
    priors: ModelPriors,
) -> int | None:
    """Find a sensor without which the visits are explained, if many of them are not."""
    unexplained = [
        visit.segment.trace for visit in visits if visit.hypotheses.refused == "not_explained"
    ]
    count = len(recording.samples.sensors)
    if (
        len(unexplained) <= MIN_UNEXPLAINED_FRACTION * len(visits)
        or not 1 < count <= MAX_PERMUTED_SENSORS
    ):
        return None
    unexplained = sorted(unexplained, key=len, reverse=True)[:MAX_CHECKED_VISITS]

    def median_residual(left_out: int | None) -> float:
        residuals = []
        for trace in unexplained:
            field = trace.field_t.copy()
            if left_out is not None:
                field[:, left_out] = np.nan
            fits = fit_landmarks(replace(trace, field_t=field), geometry, priors, thorough=False)
            residuals.append(fits[0].residual_sigma if fits else math.inf)
        return float(np.median(residuals))

    residual = [median_residual(sensor) for sensor in range(count)]
    best = int(np.argmin(residual))
    limit = min(MAX_RESIDUAL_SIGMAS, median_residual(None) / MIN_RESIDUAL_RATIO)
    return best if residual[best] <= limit else None


def _sensor_changes(count: int) -> list[SensorChange]:
    """Return all hypothetical wirings of the sensors, the given one first."""
    given, ones = tuple(range(count)), (1.0,) * count
    changes = [SensorChange(order, ones) for order in itertools.permutations(given)]
    for k in given:
        changes.append(SensorChange(given, (*ones[:k], -1.0, *ones[k + 1 :])))
    return changes + [SensorChange(given, ones, scale) for scale in CHECKED_SCALES]


def wiring_error(changes: Sequence[SensorChange], names: Sequence[str], device: str) -> InputError:
    """Return the error that names a wrong wiring, or those that are as likely."""
    given = tuple(range(len(names)))
    descriptions = []
    for change in changes:
        if change.order != given:
            actual = ", ".join(names[change.order.index(k)] for k in given)
            descriptions.append(
                f"the hall sensors of {device} are in the wrong order: {', '.join(names)} are "
                f"{actual}"
            )
        else:
            name = names[change.sign.index(-1)]
            if len(changes) == 1:
                return _opposite_sign_error(name, device)
            descriptions.append(f"the {name} sensor of {device} has the opposite sign")
    if len(changes) == 1:
        hint = "Name the columns in that order, or correct halls.toml"
    else:
        hint = "Drive over more landmarks, with turns: the recording does not show which"
    return InputError("; or ".join(descriptions), hint=hint)


def _opposite_sign_error(name: str, device: str) -> InputError:
    return InputError(
        f"the {name} sensor of {device} has the opposite sign of the others",
        hint="Turn it over, or change the sign of its column",
    )
