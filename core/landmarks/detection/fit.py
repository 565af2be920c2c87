"""Fit of the field model to the trace of one visit, for many hypotheses in one batch.

The field at a sensor is that of four bars (:mod:`locatk.core.landmarks.field`), each with a
strength and a position of its own, and that of the unknown bars of the four nearest landmarks
(:func:`neighbour_fields`). The unknowns of a hypothesis are the pose of the landmark in the frame
of the trace and everything that deviates from its nominal value, each with a Gaussian prior
(:class:`ModelPriors`). :func:`locatk.core.least_squares.minimize` fits all hypotheses of a batch
together. The evidence of a hypothesis follows from cost and information by Laplace's approximation
(MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter 27).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.trace import OdometryDrift, Trace
from locatk.core.landmarks.field import basis, basis_gradient
from locatk.core.landmarks.landmark import Geometry
from locatk.core.least_squares import DenseEquations, Indices, minimize

Array = NDArray[np.float64]

MAX_ITERATIONS = 30

MIN_RELATIVE_GAIN = 1e-5
"""A fit has converged if a step lowers its cost by less than this fraction. The cost is some
hundreds: the log evidence of hypotheses is compared to about 1e-3."""

INITIAL_DAMPING = 1e-3

POSE_SIGMA = np.array([1.0, 1.0, 1.0])
"""Standard deviations (m, m, rad) that stand in the information of the landmark's pose for a
uniform prior. They keep the information regular if the trace does not determine the pose."""

BAR_COUNT = 4
"""Number of bars."""

MIN_NEIGHBOUR_POWER = 1.0
"""Sum of squares of the fields of a neighbour's bars, in standard deviations of the readings, from
which on they are unknowns. Below, all readings together determine them no better than the prior."""


@dataclass(frozen=True)
class ModelPriors:
    """Standard deviations of deviations from the nominal model of sensors, bars and odometry.

    Attributes
    ----------
    gain : float
        Relative, of each sensor.
    offset_t : float
        Of each sensor, including the Earth's field.
    strength : float
        Of each bar, relative to the nominal one.
    bar_position_m : float
        Of each bar in x and in y.
    height_m : float
        Of the sensors over the bars, common to all.
    noise_t : float
        Of a sample.
    fault_probability : float
        Probability that a given bar is weak or missing.
    model_error_t, relative_model_error : float
        Residual of the model itself, absolute and relative to the field.
    drift : OdometryDrift
    pitch_m : float
        Distance of neighbouring landmarks, whose bars may be of any strength; ``inf`` for a single
        landmark.
    """

    gain: float = 0.03
    offset_t: float = 1e-4
    strength: float = 0.04
    bar_position_m: float = 0.5e-3
    height_m: float = 0.5e-3
    noise_t: float = 1.5e-4
    fault_probability: float = 0.01
    model_error_t: float = 1.5e-4
    relative_model_error: float = 0.005
    drift: OdometryDrift = field(default_factory=OdometryDrift)
    pitch_m: float = math.inf


@dataclass(frozen=True)
class ParameterLayout:
    """Columns of the parameters of a hypothesis.

    Attributes
    ----------
    pose : slice
        x, y, heading of the landmark in the frame of the trace, in metres and radians. All other
        parameters are in standard deviations of their priors.
    gain, offset : slice
        One per sensor.
    strength : slice
        One per bar.
    bar_position : slice
        x of all bars, then y of all bars.
    height : slice
    correction : slice
        Errors of the odometry, see :class:`.Trace`.
    neighbour : slice
        Strengths of the bars of neighbouring landmarks.
    size : int
        Number of parameters.
    """

    pose: slice
    gain: slice
    offset: slice
    strength: slice
    bar_position: slice
    height: slice
    correction: slice
    neighbour: slice
    size: int

    @classmethod
    @functools.lru_cache(maxsize=256)
    def of(cls, sensors: int, corrections: int, neighbours: int = 0) -> ParameterLayout:
        """Return the layout for numbers of sensors, errors of the odometry and further bars."""
        counts = (3, sensors, sensors, BAR_COUNT, 2 * BAR_COUNT, 1, corrections, neighbours)
        edges = [0, *np.cumsum(counts).tolist()]
        pose, gain, offset, strength, bar_position, height, correction, neighbour = (
            slice(start, stop) for start, stop in pairwise(edges)
        )
        return cls(
            pose,
            gain,
            offset,
            strength,
            bar_position,
            height,
            correction,
            neighbour,
            size=edges[-1],
        )

    @classmethod
    def of_trace(cls, trace: Trace, neighbours: int = 0) -> ParameterLayout:
        """Return the layout for a trace and a number of bars of neighbouring landmarks."""
        return cls.of(len(trace.sensor_position_m), trace.correction.shape[2], neighbours)


@dataclass(frozen=True)
class ParameterSets:
    """Parameters (K, size) of hypotheses, as the state of a minimization."""

    values: Array

    def take(self, hypotheses: Indices | NDArray[np.bool_]) -> ParameterSets:
        """Return a copy of the chosen sets."""
        return ParameterSets(self.values[hypotheses])

    def put(self, hypotheses: Indices | NDArray[np.bool_], other: ParameterSets) -> None:
        """Overwrite the chosen sets."""
        self.values[hypotheses] = other.values


@dataclass(frozen=True)
class VisitFitProblem:
    """Hypotheses of the landmark below a trace, as a batch of least-squares problems.

    Attributes
    ----------
    trace : Trace
    geometry : Geometry
    priors : ModelPriors
    strength, strength_sigma : (K, 4) ndarray
        Signed strengths of the bars by hypothesis, expected values and standard deviations.
    neighbour_field_t : (K, n, N, b) ndarray
        Fields of bars of neighbouring landmarks at each reading.
    """

    trace: Trace
    geometry: Geometry
    priors: ModelPriors
    strength: Array
    strength_sigma: Array
    neighbour_field_t: Array

    @property
    def layout(self) -> ParameterLayout:
        """Columns of the parameters."""
        return ParameterLayout.of_trace(self.trace, self.neighbour_field_t.shape[-1])

    def initial_parameters(self, pose: Array) -> Array:
        """Return parameters (K, size) at landmark poses (K, 3), all others being nominal."""
        layout = self.layout
        parameters = np.zeros((len(pose), layout.size))
        parameters[:, layout.pose] = pose
        return parameters

    def take(self, hypotheses: Indices) -> VisitFitProblem:
        """Return the problem of the chosen hypotheses."""
        return replace(
            self,
            strength=self.strength[hypotheses],
            strength_sigma=self.strength_sigma[hypotheses],
            neighbour_field_t=self.neighbour_field_t[hypotheses],
        )

    def linearize(self, state: ParameterSets, hypotheses: Indices) -> DenseEquations:
        """Return the normal equations of the chosen hypotheses, priors included."""
        are_all_running = len(hypotheses) == len(self.strength)
        problem = self if are_all_running else self.take(hypotheses)
        residual, by_parameters = problem.residuals(state.values, jacobian=True)
        cost = np.einsum("kr,kr->k", residual, residual) / 2
        equations = DenseEquations.from_weighted(residual, residual, by_parameters, cost)
        pose = self.layout.pose
        nuisance = state.values[:, pose.stop :]
        equations.add_prior(pose, np.zeros((len(residual), pose.stop)), POSE_SIGMA)
        equations.add_prior(slice(pose.stop, None), nuisance, np.ones(nuisance.shape[1]))
        return equations

    def retract(self, state: ParameterSets, step: Array) -> ParameterSets:
        """Return the parameters after a step."""
        return ParameterSets(state.values + step)

    def residuals(self, parameters: Array, *, jacobian: bool) -> tuple[Array, Array]:
        """Evaluate the model.

        Parameters
        ----------
        parameters : (K, size) ndarray
        jacobian : bool
            Return the derivatives as well (an empty array otherwise).

        Returns
        -------
        residual : (K, rows) ndarray
            Predicted minus measured field of each sample and sensor, in standard deviations; 0 if
            there is no measurement. They are multiplied by the root of the thinning, so that the
            cost is that of all samples. Priors are not included.
        by_parameters : (K, rows, size) ndarray
        """
        trace, priors, layout = self.trace, self.priors, self.layout
        samples, sensors = trace.field_t.shape
        rows = samples * sensors
        landmark = parameters[:, layout.pose, None, None]
        gain = 1 + priors.gain * parameters[:, None, layout.gain]
        strength = self.strength + self.strength_sigma * parameters[:, layout.strength]
        strength = strength[:, None, None]
        displacement = priors.bar_position_m * parameters[:, None, None, layout.bar_position]
        height = priors.height_m * parameters[:, layout.height, None]

        # Sensors in the frame of the trace, then in that of the landmark.
        pose = trace.pose + np.einsum(
            "nim,km->kni", trace.correction, parameters[:, layout.correction]
        )
        cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
        sensor = trace.sensor_position_m
        arm_x = cos * sensor[:, 0] - sin * sensor[:, 1]
        arm_y = sin * sensor[:, 0] + cos * sensor[:, 1]
        x = pose[..., 0, None] + arm_x - landmark[:, 0]
        y = pose[..., 1, None] + arm_y - landmark[:, 1]
        c, s = np.cos(landmark[:, 2]), np.sin(landmark[:, 2])
        local = np.stack([c * x + s * y, c * y - s * x], -1)

        bar_field, by_position = basis_gradient(
            self.geometry, local, self.geometry.sensor_height_m + height
        )
        # The displacement of a bar is taken to first order: it acts as the opposite displacement
        # of the sensor. The derivatives below neglect the change of `by_position`.
        bar_field = (
            bar_field
            - by_position[..., 0] * displacement[..., :BAR_COUNT]
            - by_position[..., 1] * displacement[..., BAR_COUNT:]
        )
        total = np.einsum("knsb,kb->kns", bar_field, strength[:, 0, 0])
        is_measured = ~np.isnan(trace.field_t)
        measured = np.where(is_measured, trace.field_t, 0.0)
        variance = priors.noise_t**2 / trace.weight[:, None] + priors.model_error_t**2
        variance = variance + (priors.relative_model_error * measured) ** 2
        root = np.where(is_measured, np.sqrt(trace.thinning / variance), 0.0)
        offset = priors.offset_t * parameters[:, None, layout.offset]
        neighbours = np.einsum(
            "knsb,kb->kns", self.neighbour_field_t, parameters[:, layout.neighbour]
        )
        predicted = gain * total + neighbours + offset
        residual = (root * (predicted - measured)).reshape(len(parameters), rows)
        if not jacobian:
            return residual, np.empty(0)

        # Derivatives of the field by the sensor's position in the landmark's frame, then by the
        # position in the frame of the trace.
        dx, dy, dz = np.einsum("knsbi,kb->iknsb", by_position, strength[:, 0, 0]).sum(-1)
        fx, fy = c * dx - s * dy, s * dx + c * dy
        by_parameters = np.zeros((len(parameters), samples, sensors, layout.size))
        by_parameters[..., 0] = -gain * fx
        by_parameters[..., 1] = -gain * fy
        by_parameters[..., 2] = gain * (dx * local[..., 1] - dy * local[..., 0])
        own_sensor = np.eye(sensors)
        by_parameters[..., layout.gain] = priors.gain * total[..., None] * own_sensor
        by_parameters[..., layout.offset] = priors.offset_t * own_sensor
        gain = gain[..., None]
        by_parameters[..., layout.strength] = gain * bar_field * self.strength_sigma[:, None, None]
        by_displacement = -priors.bar_position_m * strength
        by_parameters[..., layout.bar_position] = gain * np.concatenate(
            [by_displacement * by_position[..., 0], by_displacement * by_position[..., 1]], -1
        )
        by_parameters[..., layout.height] = gain * priors.height_m * dz[..., None]
        by_pose = gain * np.stack([fx, fy, fy * arm_x - fx * arm_y], -1)
        by_parameters[..., layout.correction] = np.einsum(
            "knsi,nim->knsm", by_pose, trace.correction
        )
        by_parameters[..., layout.neighbour] = self.neighbour_field_t
        by_parameters *= root[..., None]
        return residual, by_parameters.reshape(len(parameters), rows, layout.size)


def neighbour_fields(
    trace: Trace, geometry: Geometry, priors: ModelPriors, landmark: Array
) -> Array:
    """Return the fields of the bars of the landmarks next to each hypothesis.

    Over a pass at the edge, such a field is as strong as that of the bars on the far side, and it
    changes so slowly that many readings are no evidence against it.

    Parameters
    ----------
    landmark : (K, 3) ndarray
        Poses of the landmark, near to those of the fits.

    Returns
    -------
    (K, n, N, b) ndarray
        The bars of as many neighbours as can be noticed for any hypothesis; the order differs.
    """
    count, (samples, sensors) = len(landmark), trace.field_t.shape
    if not math.isfinite(priors.pitch_m) or not count:
        return np.zeros((count, samples, sensors, 0))
    offset = trace.sensor_positions() - landmark[:, None, None, :2]
    c, s = np.cos(landmark[:, 2, None, None]), np.sin(landmark[:, 2, None, None])
    x, y = offset[..., 0], offset[..., 1]
    local = np.stack([c * x + s * y, c * y - s * x], -1)
    steps = priors.pitch_m * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    fields = np.stack([basis(geometry, local - step) for step in steps], axis=1)
    variance = priors.noise_t**2 / trace.weight[:, None] + priors.model_error_t**2
    weight = np.where(np.isnan(trace.field_t), 0.0, trace.thinning / variance)
    power = np.einsum("kansb,ns->ka", fields**2, weight)
    kept = int((power > MIN_NEIGHBOUR_POWER).sum(axis=1).max())
    strongest = np.argsort(-power, axis=1)[:, :kept]
    fields = np.take_along_axis(fields, strongest[:, :, None, None, None], axis=1)
    return np.moveaxis(fields, 1, 3).reshape(count, samples, sensors, kept * BAR_COUNT)


@dataclass(frozen=True)
class VisitFits:
    """Minima of :func:`fit_visit`, by hypothesis.

    Attributes
    ----------
    parameters : (K, size) ndarray
    cost : (K,) ndarray
        Half the sum of squares, priors included.
    information : (K, size, size) ndarray
        Inverse covariance of the parameters.
    """

    parameters: Array
    cost: Array
    information: Array

    def log_evidence(self) -> Array:
        """Return the log evidence (K,) by Laplace's approximation, up to a common constant."""
        return -self.cost - np.linalg.slogdet(self.information)[1] / 2

    def take(self, hypotheses: Indices) -> VisitFits:
        """Return the chosen hypotheses."""
        return VisitFits(
            self.parameters[hypotheses], self.cost[hypotheses], self.information[hypotheses]
        )


def fit_visit(
    problem: VisitFitProblem, start: Array, max_iterations: int = MAX_ITERATIONS
) -> VisitFits:
    """Fit all hypotheses of a problem from initial parameters (K, size)."""
    minimum = minimize(
        problem,
        ParameterSets(start),
        len(start),
        damping=INITIAL_DAMPING,
        max_iterations=max_iterations,
        min_gain=MIN_RELATIVE_GAIN,
    )
    equations: DenseEquations = minimum.equations
    return VisitFits(minimum.state.values, equations.cost, equations.hessian)
