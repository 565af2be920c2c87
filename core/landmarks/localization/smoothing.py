"""Smoothing: poses of all visits, landmarks and sensors from all measurements in one least squares.

Unknowns, with Gaussian priors unless stated otherwise:

- of each robot: gains and offsets of its sensors, their height, and the constant errors of its
  odometry;
- of each landmark: pose, strengths of its bars, and their positions;
- of each visit: pose of the robot (no prior), and the random walk of its odometry;
- of each link between two visits: the random walk of its odometry.

Rows: the fields of every visit (the model of :mod:`locatk.core.landmarks.detection.fit`), and the
odometry between successive visits. The normal matrix is sparse, because a visit involves one robot
and one landmark, and a link two visits. Whether priors hold is tested in :mod:`.robust_smoothing`.

Notes
-----
The iteration is Gauss-Newton without damping. :func:`locatk.core.least_squares.minimize` does not
suit it. The visits are coupled by the odometry, so that the blocks of
:class:`~locatk.core.least_squares.SchurEquations` do not apply. Its test that every step lowers
the cost fails near the minimum, because the Jacobian of the fields takes the displacement of bars
to first order only. With sparse equations in the shared loop, smoothing took 25 to 40 % longer on
26 simulated sessions and stopped up to 2 um and 9e-6 rad away, with or without exact derivatives of
the odometry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.detection.fit import ModelPriors, ParameterLayout, VisitFitProblem
from locatk.core.landmarks.detection.hypotheses import FAULTY_STRENGTH_SIGMA, LandmarkFit
from locatk.core.landmarks.detection.trace import (
    CONSTANT_ERROR_COUNT,
    OdometryDrift,
    Trace,
    compose,
    correct_constant_errors,
    odometry_corrections,
    planar_rotation,
    relative,
    sensor_positions,
)
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.landmark import (
    HALF_PI_RAD,
    Geometry,
    rotated,
    signs,
)
from locatk.core.landmarks.localization.cell_filter import IdentifiedVisit
from locatk.core.landmarks.localization.odometry_path import OdometryPath
from locatk.core.landmarks.map.floor import (
    HOLE_CODE,
    MISSING_BAR_STRENGTH,
    Cell,
    FloorMap,
    as_built_landmark,
)
from locatk.core.landmarks.preprocessing import VisitSegment
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MAX_ITERATIONS = 6

MIN_STEP_M = 1e-6
"""Largest change of a position in one step below which the iteration has converged."""

MIN_ODOMETRY_SIGMA = np.array([1e-5, 1e-5, 1e-5])
"""Standard deviations (m, m, rad) of the odometry between two visits, besides its errors."""

MIN_VISIT_BINS = 4
"""Bins of a visit that are always used."""

LANDMARK_SIGMA = np.array([1.5e-3, 1.5e-3, 0.012])
"""Standard deviations (m, m, rad) of landmarks about their poses on the map: installed by hand on
a marked floor."""

MIN_POSE_SIGMA = 1e-5
MIN_STRENGTH_SIGMA = 1e-3
"""Lower limits of the standard deviations of landmarks as built."""

SMOOTHED_MODEL_ERROR_T = 3e-5
"""Residual of the field model after the fields of neighbouring landmarks were subtracted."""

NEIGHBOUR_RANGE_M = 0.3
"""Distance from which on a landmark's field is neglected: it is at most 2.3 uT there (default
geometry), and the noise of a sample is about 150 uT."""

LAG_COLUMN = CONSTANT_ERROR_COUNT - 1

MAX_LINEAR_ERROR = 0.02
"""Change of a constant error of the odometry, in standard deviations, up to which the paths of the
visits stay linearized: after two full rotations, 0.15 degrees and less than 1 um of a sensor."""

POSE_SIZE = 3
BAR_SIZE = 12
"""Unknowns of a pose, and of the bars of a landmark (4 strengths and 4 positions)."""


# ---- measurements and priors


@dataclass(frozen=True)
class VisitMeasurement:
    """Fields of a visit whose landmark is known.

    Attributes
    ----------
    segment : VisitSegment
        The part of the visit within the territory of the landmark.
    cell : (row, column)
    pose : (3,) ndarray
        Initial guess of the robot at the trace's reference, in the frame of the map.
    drift : OdometryDrift
        Standard deviations that are the unit of the trace's corrections.
    velocity : (n, 3) ndarray, optional
        Derivative of the path of the trace by time.
    linearized : Trace, optional
        Trace of the segment whose path is linearized about other constant errors than 0.
    """

    segment: VisitSegment
    cell: Cell
    pose: Array
    drift: OdometryDrift
    velocity: Array | None = None
    linearized: Trace | None = None

    @property
    def trace(self) -> Trace:
        """Fields, and the path as a linear function of the errors of the odometry."""
        return self.segment.trace if self.linearized is None else self.linearized

    def with_drift(self, drift: OdometryDrift, errors: Array) -> VisitMeasurement:
        """Return the measurement with corrections in other standard deviations.

        The path is linearized about constant errors (4,) of the odometry: over the rotations of a
        spin they add up to ten degrees, for which a linearization about 0 is 1 mm off.
        """
        trace = self.segment.trace
        path = correct_constant_errors(trace.pose, errors, drift)
        path = relative(path, path[trace.reference])
        correction = odometry_corrections(
            trace.pose, trace.reference, drift, self.velocity, corrected=path
        )
        start = path - correction[:, :, :LAG_COLUMN] @ errors[:LAG_COLUMN]
        linearized = replace(trace, pose=start, correction=correction)
        return replace(self, drift=drift, linearized=linearized)


@dataclass(frozen=True)
class OdometryLink:
    """Odometry from the last bin of a visit to the first bin of the next one.

    Attributes
    ----------
    time_ns : (n - 2,) int64 ndarray
        Times of the odometry, which has two more poses, those of both bins.
    pose : (n, 3) ndarray
        Path in the frame of its first pose.
    correction : (n, 3, m) ndarray
        See :class:`.trace.Trace`.
    drift : OdometryDrift
        Standard deviations that are the unit of the corrections.
    velocity : (n, 3) ndarray, optional
        Derivative of the path by time.
    """

    time_ns: NDArray[np.int64]
    pose: Array
    correction: Array
    drift: OdometryDrift
    velocity: Array | None = None

    def with_drift(self, drift: OdometryDrift) -> OdometryLink:
        """Return the link with corrections in other standard deviations."""
        return odometry_link(self.time_ns, self.pose, drift, self.velocity)

    def without_constant_errors(self, errors: Array) -> Array:
        """Return the path (n, 3) after removing the constant errors.

        They bend a long path too much for the linearization.
        """
        path = correct_constant_errors(self.pose, errors, self.drift)
        return path + self.correction[:, :, LAG_COLUMN] * errors[LAG_COLUMN]


@dataclass(frozen=True)
class RobotMeasurements:
    """Visits of one robot in order of time, and the odometry between them.

    Attributes
    ----------
    visits : sequence of VisitMeasurement
    links : sequence of OdometryLink or None
        One less than visits; None if the robot was carried.
    errors : (4,) ndarray
        Constant errors of the odometry about which the paths of the visits are linearized.
    """

    visits: Sequence[VisitMeasurement]
    links: Sequence[OdometryLink | None]
    errors: Array = field(default_factory=lambda: np.zeros(CONSTANT_ERROR_COUNT))

    def with_drift(self, drift: OdometryDrift) -> RobotMeasurements:
        """Return the measurements with corrections in other standard deviations."""
        return RobotMeasurements(
            [visit.with_drift(drift, self.errors) for visit in self.visits],
            [None if link is None else link.with_drift(drift) for link in self.links],
            self.errors,
        )

    def linearize(self, errors: Array) -> RobotMeasurements:
        """Return the measurements with paths linearized about other constant errors (4,)."""
        visits = [visit.with_drift(visit.drift, errors) for visit in self.visits]
        return RobotMeasurements(visits, self.links, errors)


@dataclass(frozen=True)
class LandmarkPrior:
    """Landmark as known before the recordings.

    Attributes
    ----------
    pose : (3,) ndarray
        In the frame of the map: x, y, heading.
    sigma : (3,) ndarray
        Standard deviations of the pose.
    strength, strength_sigma : (4,) ndarray
        Of the bars, signed and relative to the nominal one.
    """

    pose: Array
    sigma: Array
    strength: Array
    strength_sigma: Array


def measure_visits(
    visits: Sequence[IdentifiedVisit], odometry: Trajectory, priors: ModelPriors, floor: FloorMap
) -> RobotMeasurements:
    """Return the measurements of one robot for :func:`smooth`.

    The initial poses are those of the hypotheses in the cells of the map. The fields of all other
    landmarks of the map are subtracted. Visits are limited to the territories of the landmarks:
    the path between them, on which a wheel may slip, then belongs to the links.
    """
    path = OdometryPath.of(odometry)
    fits = [visit.hypothesis.fit for visit in visits]
    known_fits = [fit for fit in fits if fit is not None]
    if len(known_fits) < len(fits):
        raise ValueError("smoothing needs hypotheses with a fit of the field model")
    traces = [visit.segment.trace for visit in visits]
    information, vector = constant_error_information(list(zip(known_fits, traces, strict=True)))
    prior = np.eye(CONSTANT_ERROR_COUNT)
    errors = np.linalg.solve(prior + information.sum(axis=0), vector.sum(axis=0))
    measurements = []
    for visit, fit in zip(visits, known_fits, strict=True):
        landmark = np.array([*floor.position(visit.cell), visit.quarters * HALF_PI_RAD])
        pose, trace = compose(landmark, visit.hypothesis.pose), visit.segment.trace
        corrections = fit.corrections(trace)
        trace = subtract_neighbours(trace, pose, corrections, visit.cell, floor)
        segment = limit_to_territory(
            replace(visit.segment, trace=trace), floor.geometry.threshold_t
        )
        velocity = path.velocity(segment.time_ns) @ planar_rotation(segment.origin[2])
        measurement = VisitMeasurement(segment, visit.cell, pose, priors.drift, velocity)
        measurements.append(measurement.with_drift(priors.drift, errors))
    links = [
        None
        if is_carried(first, second, path, floor.pitch_m)
        else link_visits(first, second, path, priors.drift)
        for first, second in pairwise(measurements)
    ]
    return RobotMeasurements(measurements, links, errors)


def constant_error_information(
    fits: Sequence[tuple[LandmarkFit, Trace]],
) -> tuple[Array, Array]:
    """Return what the fits of single visits say of the constant errors of the odometry.

    The posterior of each fit without its prior N(0, I) is independent evidence. There is none where
    the posterior is wider than the prior, because the fit is poor.

    Returns
    -------
    information : (n, 4, 4) ndarray
    vector : (n, 4) ndarray
        Information times errors.
    """
    information = np.zeros((len(fits), CONSTANT_ERROR_COUNT, CONSTANT_ERROR_COUNT))
    vector = np.zeros((len(fits), CONSTANT_ERROR_COUNT))
    for k, (fit, trace) in enumerate(fits):
        first = ParameterLayout.of_trace(trace).correction.start
        own = slice(first, first + CONSTANT_ERROR_COUNT)
        inverse = np.linalg.inv(fit.covariance[own, own])
        value, basis = np.linalg.eigh(inverse - np.eye(CONSTANT_ERROR_COUNT))
        basis = basis[:, value > 0]
        information[k] = basis * value[value > 0] @ basis.T
        vector[k] = basis @ (basis.T @ (inverse @ fit.parameters[own]))
    return information, vector


def limit_to_territory(segment: VisitSegment, threshold_t: float) -> VisitSegment:
    """Return the part of a visit in which any field is above the threshold, and its reference.

    If no field is, half of the largest one is the threshold.
    """
    trace = segment.trace
    strongest = np.nan_to_num(np.abs(trace.field_t)).max(axis=1)
    is_inside = strongest >= min(threshold_t, strongest.max() / 2)
    is_inside[trace.reference] = True
    inside = np.flatnonzero(is_inside)
    first, stop = int(inside[0]), int(inside[-1]) + 1
    if stop - first < MIN_VISIT_BINS:
        return segment
    kept = slice(first, stop)
    trace = replace(
        trace,
        pose=trace.pose[kept],
        correction=trace.correction[kept],
        field_t=trace.field_t[kept],
        weight=trace.weight[kept],
        reference=trace.reference - first,
    )
    return replace(segment, time_ns=segment.time_ns[kept], trace=trace)


def subtract_neighbours(
    trace: Trace, pose: Array, corrections: Array, cell: Cell, floor: FloorMap
) -> Trace:
    """Subtract the fields of all landmarks of the map but one from a trace.

    Parameters
    ----------
    trace : Trace
    pose : (3,) ndarray
        Robot at the trace's reference, in the frame of the map.
    corrections : (m,) ndarray
        Errors of the odometry.
    cell : (row, column)
        Landmark whose field remains.
    floor : FloorMap
        Other landmarks are taken as they were built, as far as that is known.
    """
    path = compose(pose, trace.pose + trace.correction @ corrections)
    position = sensor_positions(path, trace.sensor_position_m)
    field = trace.field_t.copy()
    span = int(np.ceil(NEIGHBOUR_RANGE_M / floor.pitch_m))
    rows, columns = floor.shape
    for row in range(max(0, cell[0] - span), min(rows, cell[0] + span + 1)):
        for column in range(max(0, cell[1] - span), min(columns, cell[1] + span + 1)):
            if (row, column) == cell or floor.codes[row, column] == HOLE_CODE:
                continue
            landmark, strength = as_built_landmark(floor, (row, column))
            offset = position - landmark[:2]
            is_near = np.hypot(offset[..., 0], offset[..., 1]) < NEIGHBOUR_RANGE_M
            if is_near.any():
                local = offset[is_near] @ planar_rotation(landmark[2])[:2, :2]
                field[is_near] -= basis(floor.geometry, local) @ strength
    return replace(trace, field_t=field)


def link_visits(
    first: VisitMeasurement, second: VisitMeasurement, path: OdometryPath, drift: OdometryDrift
) -> OdometryLink:
    """Return the odometry between two visits."""
    ends = first.segment, second.segment
    between = path.between(ends[0].time_ns[-1], ends[1].time_ns[0])
    start, end = ends[0].odometry_pose(-1), ends[1].odometry_pose(0)
    pose = np.vstack([start, path.pose[between], end])
    time_ns = path.time_ns[between]
    end_times = ends[0].time_ns[-1:], ends[1].time_ns[:1]
    velocity = path.velocity(np.concatenate([end_times[0], time_ns, end_times[1]]))
    velocity = velocity @ planar_rotation(start[2])
    return odometry_link(time_ns, relative(pose, start), drift, velocity)


def is_carried(
    first: VisitMeasurement, second: VisitMeasurement, path: OdometryPath, pitch_m: float
) -> bool:
    """Return whether a robot was carried between two visits.

    A slip is at most as long as the path of the wheels, or as that of the robot, which is a pitch
    at least. Differences beyond both are no slips.
    """
    start, end = first.segment.origin, second.segment.origin
    expected = compose(first.pose, relative(end[None], start)[0])
    difference_m = float(np.hypot(*(second.pose - expected)[:2]))
    between = path.between(
        first.segment.time_ns[first.trace.reference], second.segment.time_ns[second.trace.reference]
    )
    step = np.diff(np.vstack([start, path.pose[between], end]), axis=0)
    return difference_m > max(pitch_m, float(np.hypot(step[:, 0], step[:, 1]).sum()))


def odometry_link(
    time_ns: NDArray[np.int64], pose: Array, drift: OdometryDrift, velocity: Array | None = None
) -> OdometryLink:
    """Return the link along poses (n, 3) in the frame of the first one."""
    correction = odometry_corrections(pose, 0, drift, velocity)
    return OdometryLink(time_ns, pose, correction, drift, velocity)


def landmark_priors(
    visits: Sequence[IdentifiedVisit], floor: FloorMap, priors: ModelPriors
) -> dict[Cell, LandmarkPrior]:
    """Return the landmarks of visits as the map states them.

    The directions of the bars are those that were read if they differ from the map.
    """
    landmarks: dict[Cell, LandmarkPrior] = {}
    for visit in visits:
        cell, quarters, hypothesis = visit.cell, visit.quarters, visit.hypothesis
        pose, sigma = np.array([*floor.position(cell), 0.0]), LANDMARK_SIGMA
        strength = signs(rotated(hypothesis.code, quarters))
        strength_sigma = np.full(4, priors.strength)
        is_missing = np.zeros(4, bool)
        built = floor.built.get(cell)
        if built is not None:
            pose = pose + [built.x_m, built.y_m, built.heading_rad]
            is_known = ~np.isnan(built.sigma)
            sigma = np.where(is_known[:3], np.fmax(built.sigma[:3], MIN_POSE_SIGMA), sigma)
            is_missing = np.abs(built.strength) < MISSING_BAR_STRENGTH
            agrees = (np.sign(built.strength) == strength) | is_missing
            built_strength_sigma = np.fmax(built.sigma[3:], MIN_STRENGTH_SIGMA)
            is_used = agrees & is_known[3:]
            strength_sigma = np.where(is_used, built_strength_sigma, strength_sigma)
            strength = np.where(agrees, built.strength, strength)
        faulty_bar = -1 if hypothesis.fit is None else hypothesis.fit.faulty_bar
        bar = (faulty_bar + quarters) % 4
        if faulty_bar >= 0 and not is_missing[bar]:
            strength[bar], strength_sigma[bar] = 0.0, FAULTY_STRENGTH_SIGMA
        if cell not in landmarks or faulty_bar < 0:
            landmarks[cell] = LandmarkPrior(pose, sigma, strength, strength_sigma)
    return landmarks


# ---- results


@dataclass(frozen=True)
class VisitPose:
    """Estimated pose of the robot at one visit.

    Attributes
    ----------
    pose : (3,) ndarray
        Robot at the trace's reference, in the frame of the map.
    corrections : (m,) ndarray
        Errors of the odometry, see :class:`.trace.Trace`.
    covariance : (3 + m, 3 + m) ndarray
        Of the pose and of the corrections.
    """

    pose: Array
    corrections: Array
    covariance: Array


@dataclass(frozen=True)
class LandmarkEstimate:
    """Estimated landmark.

    Attributes
    ----------
    pose : (3,) ndarray
    strength : (4,) ndarray
    covariance : (7, 7) ndarray
        Of pose and strengths.
    """

    pose: Array
    strength: Array
    covariance: Array


@dataclass(frozen=True)
class SmoothingResult:
    """Result of :func:`smooth`.

    Attributes
    ----------
    visits : list of list of VisitPose
        By robot.
    landmarks : dict of cell to LandmarkEstimate
    residual_sigma : float
        Rms residual of the fields, in standard deviations. If it is above 1, the covariances are
        scaled by its square.
    """

    visits: list[list[VisitPose]]
    landmarks: dict[Cell, LandmarkEstimate]
    residual_sigma: float


# ---- least squares


def smooth(
    robots: Sequence[RobotMeasurements],
    landmarks: Mapping[Cell, LandmarkPrior],
    geometry: Geometry,
    priors: ModelPriors,
) -> SmoothingResult:
    """Estimate the poses of all visits and landmarks from all measurements.

    Parameters
    ----------
    robots : sequence of RobotMeasurements
    landmarks : mapping of cell to LandmarkPrior
        At least of every visited cell.
    geometry : Geometry
    priors : ModelPriors
    """
    system = SmoothingSystem(robots, landmarks, geometry, priors)
    return system.result(system.minimize(system.initial_state()))


@dataclass(frozen=True)
class NormalEquations:
    """Measurements, linearized at a state, without priors.

    Attributes
    ----------
    state : (size,) ndarray
    matrix : (size, size) sparse array
    gradient : (size,) ndarray
    residual_sigma : float
        Rms residual of the fields.
    """

    state: Array
    matrix: Any
    gradient: Array
    residual_sigma: float


@dataclass(frozen=True)
class SystemSolution:
    """Solution of linearized equations with the priors.

    Attributes
    ----------
    state : (size,) ndarray
    inverse : callable
        Applies the inverse normal matrix.
    equations : NormalEquations
    """

    state: Array
    inverse: Callable[[Array], Array]
    equations: NormalEquations

    def covariance(self, columns: Indices) -> Array:
        """Return the covariance of some unknowns, if the residuals are those of the priors."""
        right = np.zeros((len(self.state), len(columns)))
        right[columns, np.arange(len(columns))] = 1
        return np.asarray(self.inverse(right)[columns])


class SmoothingSystem:
    """Columns of the unknowns in the state vector, and the normal equations at a state.

    Poses of visits are in metres and radians in the frame of the map, all other unknowns in
    standard deviations of their priors.

    Attributes
    ----------
    prior_weight : (size,) ndarray
        Weights of the priors, 1 unless a prior is released.
    """

    def __init__(
        self,
        robots: Sequence[RobotMeasurements],
        landmarks: Mapping[Cell, LandmarkPrior],
        geometry: Geometry,
        priors: ModelPriors,
    ) -> None:
        self.robots, self.geometry, self.priors = list(robots), geometry, priors
        visited = {visit.cell for robot in robots for visit in robot.visits}
        self.landmarks = {cell: landmarks[cell] for cell in sorted(visited)}
        self.size = 0
        # Gains, offsets, height, constant errors of odometry.
        self.robot_columns: list[Indices] = []
        # Pose, random walk of odometry.
        self.visit_columns: list[list[Indices]] = []
        for robot in robots:
            sensors = len(robot.visits[0].trace.sensor_position_m)
            self.robot_columns.append(self._allocate(2 * sensors + 1 + CONSTANT_ERROR_COUNT))
            self.visit_columns.append(
                [
                    self._allocate(
                        POSE_SIZE + visit.trace.correction.shape[2] - CONSTANT_ERROR_COUNT
                    )
                    for visit in robot.visits
                ]
            )
        # Random walk of odometry.
        self.link_columns = [
            [self._allocate(0 if link is None else _walk_size(link)) for link in robot.links]
            for robot in robots
        ]
        # Pose, bars.
        self.landmark_columns = {
            cell: self._allocate(POSE_SIZE + BAR_SIZE) for cell in self.landmarks
        }
        poses = [columns[:POSE_SIZE] for robot in self.visit_columns for columns in robot]
        self.position_columns = np.concatenate([columns[:2] for columns in poses])
        self.prior_weight = np.ones(self.size)
        self.prior_weight[np.concatenate(poses)] = 0.0

    def _allocate(self, count: int) -> Indices:
        self.size += count
        return np.arange(self.size - count, self.size)

    def minimize(self, state: Array) -> SystemSolution:
        """Minimize the cost from a state."""
        for _ in range(MAX_ITERATIONS):
            self._linearize_paths(state)
            equations = self.normal_equations(state)
            solution = self.solve(equations)
            step = np.abs(solution.state - state)[self.position_columns].max()
            state = solution.state
            if step < MIN_STEP_M:
                break
        return solution

    def solve(self, equations: NormalEquations) -> SystemSolution:
        """Solve linearized equations with the present weights of the priors.

        Raises
        ------
        DegenerateError
            The iteration has diverged: fields and odometry contradict each other.
        """
        gradient = equations.gradient + self.prior_weight * equations.state
        try:
            factorized = splu(
                (equations.matrix + diags_array(self.prior_weight)).tocsc(),
                # This order of columns keeps the factors of a symmetric matrix sparse.
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            state = equations.state - factorized.solve(gradient)
        except RuntimeError:  # A factor is singular.
            state = np.full(self.size, np.nan)
        if not np.isfinite(state).all():
            raise DegenerateError("the fields and the odometry contradict each other")
        return SystemSolution(state, factorized.solve, equations)

    def _linearize_paths(self, state: Array) -> None:
        """Linearize the paths of all visits about the constant errors of a state."""
        for number, robot in enumerate(self.robots):
            errors = state[self.robot_columns[number][-CONSTANT_ERROR_COUNT:]]
            if np.abs(errors - robot.errors).max() > MAX_LINEAR_ERROR:
                self.robots[number] = robot.linearize(errors)

    def initial_state(self) -> Array:
        """Return the state at the initial poses of the visits, and errors of the odometry."""
        state = np.zeros(self.size)
        for number, robot in enumerate(self.robots):
            state[self.robot_columns[number][-CONSTANT_ERROR_COUNT:]] = robot.errors
            for visit, columns in zip(robot.visits, self.visit_columns[number], strict=True):
                state[columns[:POSE_SIZE]] = visit.pose
        return state

    def normal_equations(self, state: Array) -> NormalEquations:
        """Linearize all measurements at a state."""
        rows, columns, values = [], [], []
        gradient = np.zeros(self.size)
        squares, count = 0.0, 0

        def add(unknowns: Indices, jacobian: Array, residual: Array) -> None:
            gradient[unknowns] += jacobian.T @ residual
            rows.append(np.repeat(unknowns, len(unknowns)))
            columns.append(np.tile(unknowns, len(unknowns)))
            values.append((jacobian.T @ jacobian).ravel())

        for number, robot in enumerate(self.robots):
            for k, visit in enumerate(robot.visits):
                unknowns, jacobian, residual = self.field_rows(state, number, k)
                add(unknowns, jacobian, residual)
                squares += float(residual @ residual)
                count += int((~np.isnan(visit.trace.field_t)).sum())
            for k, link in enumerate(robot.links):
                if link is not None:
                    add(*self.link_rows(state, number, k))
        matrix = coo_array(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            shape=(self.size, self.size),
        )
        return NormalEquations(state, matrix.tocsc(), gradient, math.sqrt(squares / max(count, 1)))

    def field_rows(self, state: Array, number: int, k: int) -> tuple[Indices, Array, Array]:
        """Linearize the fields of visit ``k`` of a robot.

        Returns
        -------
        unknowns : (p,) ndarray
            Columns of the unknowns.
        jacobian : (rows, p) ndarray
        residual : (rows,) ndarray
        """
        visit = self.robots[number].visits[k]
        robot, own = self.robot_columns[number], self.visit_columns[number][k]
        landmark, prior = self.landmark_columns[visit.cell], self.landmarks[visit.cell]
        problem = VisitFitProblem(
            visit.trace,
            self.geometry,
            self.priors,
            prior.strength[None],
            prior.strength_sigma[None],
            np.zeros((1, *visit.trace.field_t.shape, 0)),
        )
        layout = problem.layout
        local, by_robot, by_landmark = relative_pose_with_gradient(
            state[own[:POSE_SIZE]], self._landmark_pose(state, visit.cell)
        )
        sensors = layout.offset.stop - layout.gain.start
        # The order of the parameters of a fit, see ParameterLayout.
        nuisance = np.concatenate(
            [robot[:sensors], landmark[POSE_SIZE:], robot[sensors:], own[POSE_SIZE:]]
        )
        parameters = np.concatenate([local, state[nuisance]])
        residual, by_parameters = problem.residuals(parameters[None], jacobian=True)
        by_local = by_parameters[0][:, layout.pose]
        jacobian = np.hstack(
            [
                by_local @ by_robot,
                by_local @ (by_landmark * prior.sigma),
                by_parameters[0][:, layout.pose.stop :],
            ]
        )
        unknowns = np.concatenate([own[:POSE_SIZE], landmark[:POSE_SIZE], nuisance])
        return unknowns, jacobian, residual[0]

    def link_rows(self, state: Array, number: int, k: int) -> tuple[Indices, Array, Array]:
        """Linearize the odometry between visits ``k`` and ``k + 1``; see :meth:`field_rows`."""
        robot, link = self.robots[number], self.robots[number].links[k]
        assert link is not None
        constant = self.robot_columns[number][-CONSTANT_ERROR_COUNT:]
        first, second = self.visit_columns[number][k : k + 2]
        own = self.link_columns[number][k]
        start, start_by_unknowns = bin_pose_with_gradient(
            robot.visits[k].trace, -1, state[first], state[constant]
        )
        end, end_by_unknowns = bin_pose_with_gradient(
            robot.visits[k + 1].trace, 0, state[second], state[constant]
        )
        local, by_start, by_end = relative_pose_with_gradient(start, end)
        by_constant, walk = np.split(link.correction[-1], [CONSTANT_ERROR_COUNT], axis=1)
        path = link.without_constant_errors(state[constant])
        residual = local - path[-1] - walk @ state[own]
        residual[2] = math.remainder(residual[2], math.tau)
        first_part = by_start @ start_by_unknowns
        second_part = by_end @ end_by_unknowns
        jacobian = np.hstack(
            [
                first_part[:, : len(first)],
                second_part[:, : len(second)],
                -walk,
                # Both ends depend on the constant errors, and so does the path between them.
                first_part[:, len(first) :] + second_part[:, len(second) :] - by_constant,
            ]
        )
        unknowns = np.concatenate([first, second, own, constant])
        return unknowns, jacobian / MIN_ODOMETRY_SIGMA[:, None], residual / MIN_ODOMETRY_SIGMA

    def result(self, solution: SystemSolution) -> SmoothingResult:
        """Return the estimates of a solution."""
        state, residual_sigma = solution.state, solution.equations.residual_sigma
        inflation = max(1.0, residual_sigma) ** 2
        visits = []
        for number, columns_of in enumerate(self.visit_columns):
            constant = self.robot_columns[number][-CONSTANT_ERROR_COUNT:]
            poses = []
            for own in columns_of:
                columns = np.concatenate([own[:POSE_SIZE], constant, own[POSE_SIZE:]])
                covariance = solution.covariance(columns) * inflation
                pose, corrections = state[own[:POSE_SIZE]], state[columns[POSE_SIZE:]]
                poses.append(VisitPose(pose, corrections, covariance))
            visits.append(poses)
        landmarks = {}
        for cell, prior in self.landmarks.items():
            columns = self.landmark_columns[cell][: POSE_SIZE + 4]
            unit = np.concatenate([prior.sigma, prior.strength_sigma])
            covariance = solution.covariance(columns) * inflation
            landmarks[cell] = LandmarkEstimate(
                self._landmark_pose(state, cell),
                prior.strength + prior.strength_sigma * state[columns[POSE_SIZE:]],
                unit[:, None] * covariance * unit,
            )
        return SmoothingResult(visits, landmarks, residual_sigma)

    def _landmark_pose(self, state: Array, cell: Cell) -> Array:
        prior = self.landmarks[cell]
        return prior.pose + prior.sigma * state[self.landmark_columns[cell][:POSE_SIZE]]


def _walk_size(link: OdometryLink) -> int:
    return link.correction.shape[2] - CONSTANT_ERROR_COUNT


def relative_pose_with_gradient(origin: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Transform a pose to the frame of ``origin``.

    Returns
    -------
    local : (3,) ndarray
    by_origin, by_pose : (3, 3) ndarray
    """
    by_pose = planar_rotation(origin[2]).T
    local = by_pose @ (pose - origin)
    by_origin = -by_pose
    by_origin[:2, 2] = local[1], -local[0]
    return local, by_origin, by_pose


def bin_pose_with_gradient(
    trace: Trace, index: int, unknowns: Array, constant_errors: Array
) -> tuple[Array, Array]:
    """Return the robot's pose at one bin in the frame of the map.

    Parameters
    ----------
    trace : Trace
    index : int
    unknowns : (p,) ndarray
        Pose at the reference, and random walk of the odometry.
    constant_errors : (3,) ndarray
        Of the odometry.

    Returns
    -------
    pose : (3,) ndarray
    by_unknowns : (3, p + 3) ndarray
        Derivatives by the unknowns, then by the constant errors.
    """
    pose = unknowns[:POSE_SIZE]
    correction = trace.correction[index]
    errors = np.concatenate([constant_errors, unknowns[POSE_SIZE:]])
    local = trace.pose[index] + correction @ errors
    rotation = planar_rotation(pose[2])
    by_pose = np.eye(POSE_SIZE)
    by_pose[:2, 2] = -(rotation @ local)[1], (rotation @ local)[0]
    by_errors = rotation @ correction
    by_unknowns = np.hstack(
        [by_pose, by_errors[:, CONSTANT_ERROR_COUNT:], by_errors[:, :CONSTANT_ERROR_COUNT]]
    )
    return compose(pose, local), by_unknowns
