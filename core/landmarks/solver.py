"""Pipeline of the landmarks solver, from hall sensors and odometry to poses on the map."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import detect_landmarks
from locatk.core.landmarks.detection.trace import (
    CONSTANT_ERROR_COUNT,
    OdometryDrift,
    known_drift,
)
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.localization.cell_filter import (
    IdentifiedVisit,
    identify_visits,
    select_visits_on_map,
)
from locatk.core.landmarks.localization.consistency import (
    MAP_CONTRADICTED_WARNING,
    NO_MAP_WARNING,
    contradicts_odometry,
    describe_visit,
    find_displaced_landmarks,
    is_map_contradicted,
    warn_of_cause,
    warn_of_lag,
    warn_of_missing_pose,
    warn_of_opposite_polarity,
    without_contradicted_ends,
)
from locatk.core.landmarks.localization.drive_smoothing import significant_lag, smooth_drive
from locatk.core.landmarks.localization.odometry_path import without_lag
from locatk.core.landmarks.localization.smoothing import LAG_COLUMN, constant_error_information
from locatk.core.landmarks.localization.trajectory import pose_probability
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import (
    DEFAULT_PITCH_M,
    HallRecording,
    check_odometry,
    preprocess,
)
from locatk.core.landmarks.published.solver import solve as solve_published
from locatk.core.landmarks.results import LandmarkFacts, RobotFacts
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory

Array = NDArray[np.float64]

METHODS = ("field", "paper")

MAX_LAG_ROUNDS = 3
"""Rounds of a solution, each without the lag of the odometry that the previous one found."""

MIN_REPORTED_LAG_S = 0.01
"""Lag of the odometry from which on a warning is given."""


@dataclass(frozen=True)
class SolveOptions:
    """Options of the solver.

    Attributes
    ----------
    method : str
        ``"field"``, the default, or ``"paper"`` (the published method).
    misread : float
        Probability that a landmark differs from the map or is misread.
    priors : ModelPriors
        Uncertainties of sensors, bars and odometry; the noise is taken from the recording.
    odometry_noise : float, optional
        Random walk of the heading by odometry [rad/sqrt(m)]; that of the position grows with it.
        It is estimated from the recording if it is not given.
    odometry_lag_s : float, optional
        Time by which the odometry is later than the fields; it is estimated if it is not given.
    """

    method: str = "field"
    misread: float = 0.02
    priors: ModelPriors = field(default_factory=ModelPriors)
    odometry_noise: float | None = None
    odometry_lag_s: float | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(
                f"unknown method {self.method!r}", hint=f"choose one of {', '.join(METHODS)}"
            )
        given = (self.odometry_noise, self.odometry_lag_s)
        if self.method == "paper" and given != (None, None):
            raise InputError(
                "noise and lag of the odometry do not apply to method 'paper'",
                hint="Leave them out, or use method 'field'",
            )
        noise, lag_s = given
        if noise is not None and not 0 < noise < math.inf:
            raise InputError(f"odometry with a noise of {noise} rad", hint="Give a positive number")
        if lag_s is not None and not math.isfinite(lag_s):
            raise InputError(f"odometry with a lag of {lag_s} s", hint="Give a number")
        if not 0 < self.misread < 0.5:
            raise InputError(
                f"a rate of misread landmarks of {self.misread!r}", hint="Give 0.001 to 0.2"
            )


def solve(
    samples: Sequence[HallSamples],
    floor: FloorMap | None = None,
    options: SolveOptions | None = None,
    *,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """Detect the landmarks that robots visited, and estimate the robots' poses on the map.

    Parameters
    ----------
    samples : sequence of HallSamples
        One per robot.
    floor : FloorMap or None
        Without a map landmarks are detected, but there are no poses.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        By device.

    Returns
    -------
    Solution
        Its detections are the visits to landmarks (docs/formats.md).

    Raises
    ------
    InputError
        A recording has no odometry, no sensor of it can be used, or its sensors are in the
        wrong order.
    """
    options = options or SolveOptions()
    if options.method == "paper":
        return solve_published(samples, floor, odometry=odometry)
    odometry_of = {trajectory.device: trajectory for trajectory in reversed(odometry)}
    robots = [
        solve_recording(each, odometry_of.get(each.device), floor, options) for each in samples
    ]
    detections = [
        describe_visit(
            visit.hypotheses,
            visit.estimate if robot.trajectories else None,
            floor,
            robot.identified.map_probability,
            is_lost=any(visit is lost for lost in robot.lost_visits),
        )
        for robot in robots
        for visit in robot.identified.visits
    ]
    # A misread landmark is used as it was read.
    rejected = Counter(one.refused for one in detections if one.refused not in ("", "misread"))
    return Solution(
        system="landmarks",
        method=options.method,
        trajectories=tuple(path for robot in robots for path in robot.trajectories),
        rejected=dict(rejected),
        detections=tuple(detections),
        artifact=floor,
        warnings=tuple(warning for robot in robots for warning in robot.warnings),
        facts=LandmarkFacts({robot.identified.device: robot.facts for robot in robots}),
    )


@dataclass(frozen=True)
class IdentifiedRecording:
    """Recording of one robot whose visits were identified on the map.

    Attributes
    ----------
    recording : HallRecording
    odometry : Trajectory
    priors : ModelPriors
        With the noise of the recording.
    visits : list of IdentifiedVisit
        In order of time, refused ones included.
    map_probability : float
        Probability that the robot is on this floor and not on any other.
    """

    recording: HallRecording
    odometry: Trajectory
    priors: ModelPriors
    visits: list[IdentifiedVisit]
    map_probability: float

    @property
    def device(self) -> str:
        """Name of the robot."""
        return self.recording.samples.device


def identify_recording(
    samples: HallSamples,
    odometry: Trajectory | None,
    floor: FloorMap | None,
    options: SolveOptions,
) -> IdentifiedRecording:
    """Preprocess the recording of one robot, detect landmarks, and identify their cells.

    Raises
    ------
    InputError
        See :func:`solve`.
    """
    geometry = floor.geometry if floor is not None else Geometry()
    pitch_m = floor.pitch_m if floor is not None else DEFAULT_PITCH_M
    recording = preprocess(samples, odometry)
    check_odometry(recording, geometry)
    drift = known_drift(options.priors.drift, options.odometry_noise, options.odometry_lag_s)
    priors = replace(options.priors, noise_t=recording.noise_t, drift=drift)
    recording, detected = detect_landmarks(recording, geometry, priors, pitch_m)
    priors = replace(priors, noise_t=recording.noise_t)
    visits, map_probability = identify_visits(
        detected, floor, misread=options.misread, drift=priors.drift
    )
    assert recording.odometry is not None  # preprocess() sets it
    return IdentifiedRecording(recording, recording.odometry, priors, visits, map_probability)


@dataclass(frozen=True)
class LocalizedRobot:
    """Result for one robot.

    Attributes
    ----------
    identified : IdentifiedRecording
    facts : RobotFacts
    warnings : tuple of SolverWarning
    trajectories : tuple of Trajectory
        One on the map, or none if the robot is not localized.
    lag_s : float
        Time lag of the odometry; 0 if it is not significant.
    lost_visits : tuple of IdentifiedVisit
        Visits on the map during which the robot has no poses, although it has others.
    """

    identified: IdentifiedRecording
    facts: RobotFacts
    warnings: tuple[SolverWarning, ...]
    trajectories: tuple[Trajectory, ...] = ()
    lag_s: float = 0.0
    lost_visits: tuple[IdentifiedVisit, ...] = ()


def solve_recording(
    samples: HallSamples,
    odometry: Trajectory | None,
    floor: FloorMap | None,
    options: SolveOptions,
) -> LocalizedRobot:
    """Localize one robot; remove the time lag of its odometry if there is any.

    Raises
    ------
    InputError
        See :func:`solve`.
    """
    is_known = options.odometry_lag_s is not None
    lag_s = options.odometry_lag_s or 0.0
    for further_rounds in reversed(range(MAX_LAG_ROUNDS)):
        shifted = odometry if odometry is None or not lag_s else without_lag(odometry, lag_s)
        identified = identify_recording(samples, shifted, floor, options)
        # A lag that is evident in single visits need not be smoothed before it is removed.
        found_s = 0.0 if is_known else lag_of_visits(identified)
        if not (found_s and further_rounds):
            robot = localize_robot(identified, floor, options)
            found_s = robot.lag_s
        if is_known or not found_s or not further_rounds:
            break
        lag_s += found_s
    if options.odometry_lag_s is None and abs(lag_s) > MIN_REPORTED_LAG_S:
        warning = warn_of_lag(lag_s, remaining_s=robot.lag_s)
        robot = _with_warnings(robot, warning.about(identified.device))
    return robot


def localize_robot(
    identified: IdentifiedRecording, floor: FloorMap | None, options: SolveOptions
) -> LocalizedRobot:
    """Estimate the poses of one robot on the map, or explain why there are none."""
    recording, visits = identified.recording, identified.visits
    on_map = select_visits_on_map(visits, floor) if floor is not None else []
    facts = _cell_facts(identified, on_map)
    unlocalized = LocalizedRobot(identified, facts, recording.warnings)
    if floor is None:
        return _with_warnings(unlocalized, NO_MAP_WARNING.about(identified.device))
    if is_map_contradicted(visits, on_map, identified.map_probability):
        obstacle = MAP_CONTRADICTED_WARNING.about(identified.device)
    elif not on_map:
        obstacle = warn_of_missing_pose(recording, visits)
    else:
        obstacle = None
    if obstacle is not None:
        polarity = warn_of_opposite_polarity(
            identified.device,
            visits,
            floor,
            misread=options.misread,
            drift=identified.priors.drift,
        )
        not_localised = replace(facts, localised=False, provisional=False)
        return _with_warnings(replace(unlocalized, facts=not_localised), obstacle, *polarity)
    try:
        smoothed = smooth_drive(
            on_map,
            identified.odometry,
            floor,
            identified.priors,
            estimate_walk=options.odometry_noise is None,
        )
    except DegenerateError as error:
        message = f"no poses: {error}; check the clocks and the scale of the odometry"
        return _with_warnings(
            replace(unlocalized, facts=replace(facts, localised=False, provisional=False)),
            SolverWarning("field_misfit", message).about(identified.device),
        )
    facts = replace(facts, misfit_sigma=smoothed.residual_sigma)
    robot = _with_warnings(
        replace(unlocalized, facts=facts, lag_s=smoothed.significant_lag()),
        *(warning.about(identified.device) for warning in smoothed.warnings()),
    )
    trajectory = smoothed.trajectory(identified.odometry)
    if trajectory is None:
        return replace(robot, facts=replace(facts, localised=False, provisional=False))
    lost = tuple(smoothed.lost_visits)
    on_map_ids, used_ids = (
        {id(one) for one in some} for some in (on_map, [*smoothed.visits, *lost])
    )
    unused = [visit for visit in visits if id(visit) not in on_map_ids]
    slipped = [visit for visit in on_map if id(visit) not in used_ids]
    trajectory, contradictions = without_contradicted_ends(
        trajectory, smoothed.visits, [*filter(contradicts_odometry, unused), *slipped]
    )
    named = smoothed.displaced_cells
    displaced = [
        one for one in find_displaced_landmarks(unused, trajectory, floor) if one.cell not in named
    ]
    probability = pose_probability(
        trajectory.time_ns,
        [visit.segment for visit in on_map],
        [visit.estimate.probability for visit in on_map if visit.estimate is not None],
        identified.map_probability,
    )
    return _with_warnings(
        replace(
            robot,
            trajectories=(replace(trajectory, probability=probability),),
            lost_visits=lost,
        ),
        *(warn_of_cause(each).about(identified.device) for each in displaced),
        *(warning.about(identified.device) for warning in contradictions),
    )


def lag_of_visits(identified: IdentifiedRecording) -> float:
    """Return the lag in seconds by the fits of single visits, or 0 if it is not significant."""
    fits = [
        (visit.hypotheses.best.fit, visit.segment.trace)
        for visit in identified.visits
        if not visit.hypotheses.refused
    ]
    information, vector = constant_error_information(
        [(fit, trace) for fit, trace in fits if fit is not None]
    )
    return common_lag(information, vector, identified.priors.drift)


def common_lag(information: Array, vector: Array, drift: OdometryDrift) -> float:
    """Return the lag in seconds by the information of single visits, or 0 if it is not significant.

    It must be significant without any one visit as well, in which a wheel may have slipped.

    Parameters are those that :func:`.smoothing.constant_error_information` returns.
    """
    # The sums over all visits, and over all but each one.
    information = information.sum(axis=0) - np.concatenate([np.zeros((1, 4, 4)), information])
    vector = vector.sum(axis=0) - np.concatenate([np.zeros((1, 4)), vector])
    covariance = np.linalg.inv(np.eye(CONSTANT_ERROR_COUNT) + information)
    lags = [
        significant_lag(errors[LAG_COLUMN], own[LAG_COLUMN, LAG_COLUMN], drift)
        for errors, own in zip(np.einsum("kij,kj->ki", covariance, vector), covariance, strict=True)
    ]
    return lags[0] if all(lag * lags[0] > 0 for lag in lags) else 0.0


def _cell_facts(identified: IdentifiedRecording, on_map: Sequence[IdentifiedVisit]) -> RobotFacts:
    """Return the facts of a robot that follow from its cells."""
    estimates = [visit.estimate for visit in identified.visits if visit.estimate is not None]
    reported = [visit.estimate.probability for visit in on_map if visit.estimate is not None]
    if reported:
        of_cell = min(reported)
    else:
        of_cell = max((one.probability for one in estimates), default=0.0)
    probability = identified.map_probability * of_cell
    is_certain = [one.filtered_probability >= PROVISIONAL_PROBABILITY for one in estimates]
    return RobotFacts(
        localised=bool(on_map),
        provisional=bool(on_map) and probability < PROVISIONAL_PROBABILITY,
        probability=probability,
        map_probability=identified.map_probability,
        landmarks_seen=len(estimates),
        landmarks_to_localise=is_certain.index(True) + 1 if any(is_certain) else None,
    )


def _with_warnings(robot: LocalizedRobot, *warnings: SolverWarning) -> LocalizedRobot:
    return replace(robot, warnings=(*robot.warnings, *warnings))
