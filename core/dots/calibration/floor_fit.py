"""Poses of the sheets of a floor, and smooth maps of the errors of their print.

Unknowns are, in this order,

::

    poses        (x, y, heading) of each sheet but the first one, which is the datum
    scale        of the print along both axes of the paper; only with truth
    alignments   of each truth: (x, y, heading) of the floor in the frame of the
                 truth, (x, y) of the camera on the tracked body, and its heading
    fields       displacements of dots at the nodes of a grid over each sheet

and observations are relative poses of two sheets at their seam
(:mod:`~locatk.core.dots.calibration.seam_measurements`), and poses on one sheet with the truth.

The displacements are a Gaussian process: a priori zero, with a standard deviation along each axis
of the paper and a correlation that falls with the distance (Matern, smoothness 3/2). These standard
deviations, the correlation length and the noise of the observations are those of the largest
marginal likelihood (MacKay, Information Theory, Inference, and Learning Algorithms, 2003, ch. 28;
Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, eq. 2.30 and 5.8), so that
the field has as much freedom as the data support: none if the likelihood without it is about as
large.

Seams alone reveal the difference of the displacements of two sheets along their edge, which here
only widens the covariance of the poses. The displacements inside of a sheet follow from truth: the
scale of a frame is known from the pitch alone, and would be a height as well as a stretched print.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve, cholesky
from scipy.optimize import minimize
from scipy.special import chdtri

from locatk.core.dots.calibration.seam_measurements import SeamMeasurement
from locatk.core.dots.sheet import Manifest, interpolation_weights
from locatk.core.geometry import rotation_matrix_2d, wrap_angle
from locatk.core.robust import SIGMA_PER_MEDIAN_ABSOLUTE

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CORRELATION_LENGTHS_MM = (50.0, 100.0, 200.0)
"""Correlation lengths of the print's errors that are compared. Figures 13 and 14 of Hostettler et
al. 2016 show regions of some centimetres with a common error on an A3 print."""

NODE_SPACINGS_MM = (40.0, 50.0, 60.0)
"""Largest distance of two nodes of a field: the first that needs no more than
:data:`MAX_UNKNOWNS`. Wider grids cannot represent fields of the shortest correlation length."""

MAX_UNKNOWNS = 2000
"""Maximum number of unknowns; with more, a fit takes minutes."""

RELATIVE_JITTER = 1e-6
"""Variance of a node, relative to that of the field, that is independent of other nodes."""

MIN_FIELD_EVIDENCE = 5.0
"""Least gain of the log evidence by a field: a Bayes factor of 150, "very strong" evidence (Kass
and Raftery, J. Am. Stat. Assoc. 90 (1995) 773)."""

OUTLIER_PROBABILITY = 1e-4
"""Probability with which an observation with normal errors is rejected."""

GROSS_OUTLIER_SIGMAS = 8.0
"""Distance from a robust fit without fields, in robust standard deviations, from which observations
are wrong; fields are much smaller."""

SCALE_PRIOR_SIGMA = 0.02
"""Prior standard deviation of a print's scale; more is an error of the user."""

LEVER_ARM_PRIOR_SIGMA_MM = 300.0
"""Prior standard deviation of the position of the camera on the tracked body."""

FLAT_SIGMA = 1e5
"""Prior standard deviation, in mm and rad, of parameters without prior."""

MAX_EXCESS_SIGMAS = 3.0
"""Excess of the mean square of normalised residuals, in its standard deviations, up to which they
have no other cause than the noise of the dots."""

MIN_FIELD_MM = 0.02
"""Standard deviation of a field from which the search for the most likely one starts."""

MAX_LAST_STEP_SIGMAS = 1e-3
"""Step in standard deviations at which the fit has converged."""

MAX_STEPS = 10
"""Maximum number of Gauss-Newton steps; rotations of a few degrees need three."""

MAX_GATING_ROUNDS = 5
"""Maximum number of fits between which outliers are rejected."""

FOLDS = 10
"""Number of parts of the recordings in the cross-validation."""

MAX_EVALUATIONS = 80
"""Maximum number of evaluations of the evidence for each correlation length."""


@dataclass(frozen=True)
class TruthObservations:
    """Poses on one sheet in one recording, with the truth.

    Attributes
    ----------
    number : int
        Of the sheet.
    alignment : int
        Number of the truth: recordings with one truth have its frame and its body in common.
    time_ns : (n,) int64 ndarray
        Stamps of the frames.
    points_mm : (n, 2) ndarray
        Positions on the paper.
    headings : (n,) ndarray
        On the paper in rad.
    variance : (n, 2) ndarray
        Of the position (mean of both axes, mm^2) and of the heading.
    truth_mm : (n, 2) ndarray
    truth_headings : (n,) ndarray
        In rad; nan if the truth has no orientation.
    """

    number: int
    alignment: int
    time_ns: Indices
    points_mm: Array
    headings: Array
    variance: Array
    truth_mm: Array
    truth_headings: Array

    @property
    def has_heading(self) -> bool:
        """Whether the truth has an orientation."""
        return bool(np.isfinite(self.truth_headings).all())

    def select(self, kept: NDArray[np.bool_]) -> TruthObservations:
        """Return only some poses."""
        return TruthObservations(
            self.number,
            self.alignment,
            self.time_ns[kept],
            self.points_mm[kept],
            self.headings[kept],
            self.variance[kept],
            self.truth_mm[kept],
            self.truth_headings[kept],
        )


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of the fit.

    Attributes
    ----------
    seam : float
        Factor of the standard deviations of seam measurements.
    position_mm, heading : float
        Standard deviations of the truth, mm and rad, besides that of the poses on the sheet.
    field_sigma_mm : (x, y)
        Standard deviation of the displacements along the axes of the paper.
    correlation_length_mm : float
        Their correlation length.
    """

    seam: float = 1.0
    position_mm: float = 0.1
    heading: float = 1e-3
    field_sigma_mm: tuple[float, float] = (0.0, 0.0)
    correlation_length_mm: float = CORRELATION_LENGTHS_MM[1]


@dataclass(frozen=True)
class UnknownIndices:
    """Indices of the unknowns.

    Attributes
    ----------
    sheets : tuple of int
        Numbers of the sheets of the floor; the first is the datum.
    alignments : int
        Number of truths.
    nodes : dict of int to (columns, rows)
        Of the field of each sheet.
    """

    sheets: tuple[int, ...]
    alignments: int
    nodes: dict[int, tuple[int, int]]

    @property
    def rigid_size(self) -> int:
        """Number of unknowns that are not those of fields."""
        return 3 * (len(self.sheets) - 1) + (2 + 6 * self.alignments if self.alignments else 0)

    @property
    def size(self) -> int:
        return self.rigid_size + 2 * sum(columns * rows for columns, rows in self.nodes.values())

    def pose(self, number: int) -> Indices | None:
        """Return the unknowns (3,) of a sheet's pose; None for the datum."""
        index = self.sheets.index(number)
        return 3 * (index - 1) + np.arange(3) if index else None

    @property
    def scale(self) -> Indices:
        return 3 * (len(self.sheets) - 1) + np.arange(2)

    def alignment(self, index: int) -> Indices:
        """Return the unknowns (6,) of a truth."""
        return 3 * (len(self.sheets) - 1) + 2 + 6 * index + np.arange(6)

    def field(self, number: int) -> Indices:
        """Return the unknowns (2, nodes) of a field: along x, then along y."""
        start = self.rigid_size
        for other, (columns, rows) in self.nodes.items():
            if other == number:
                return start + np.arange(2 * columns * rows).reshape(2, -1)
            start += 2 * columns * rows
        raise KeyError(number)


def lay_out_unknowns(
    manifest: Manifest, sheets: tuple[int, ...], alignments: int
) -> UnknownIndices:
    """Return the unknowns of a floor; without fields if it is too large for them."""
    for spacing_mm in NODE_SPACINGS_MM:
        nodes = {number: _nodes(manifest, number, spacing_mm) for number in sheets}
        layout = UnknownIndices(sheets, alignments, nodes)
        if layout.size <= MAX_UNKNOWNS:
            return layout
    return UnknownIndices(sheets, alignments, {})


def _nodes(manifest: Manifest, number: int, spacing_mm: float) -> tuple[int, int]:
    columns, rows = (
        max(2, math.ceil((count - 1) * manifest.pitch_mm / spacing_mm) + 1)
        for count in manifest.sheets[number].size
    )
    return columns, rows


def node_positions(manifest: Manifest, number: int, nodes: tuple[int, int]) -> Array:
    """Return the positions (columns * rows, 2) of nodes on the paper in mm, row by row upwards."""
    sheet = manifest.sheets[number]
    x, y = np.meshgrid(np.linspace(0, 1, nodes[0]), np.linspace(1, 0, nodes[1]))
    fraction = np.stack([x.ravel(), y.ravel()], axis=1)
    return manifest.to_paper(number, sheet.origin + fraction * (np.array(sheet.size) - 1))


@dataclass(frozen=True)
class FieldWeights:
    """Derivatives of the displacement at points by the displacements of the nodes.

    Attributes
    ----------
    value : (n, nodes) ndarray
        Of the displacement along either axis.
    by_x, by_y : (n, nodes) ndarray
        Of its derivatives, per mm.
    """

    value: Array
    by_x: Array
    by_y: Array


def field_weights(
    manifest: Manifest, number: int, nodes: tuple[int, int], points_mm: Array
) -> FieldWeights:
    """Return the weights of the nodes at points (n, 2) of a sheet's paper."""
    corners = node_positions(manifest, number, nodes)
    low, extent = corners[0], corners[-1] - corners[0]
    x, x_slope = interpolation_weights((points_mm[:, 0] - low[0]) / extent[0], nodes[0])
    y, y_slope = interpolation_weights((points_mm[:, 1] - low[1]) / extent[1], nodes[1])

    def product(along_y: Array, along_x: Array) -> Array:
        return np.asarray((along_y[:, :, None] * along_x[:, None]).reshape(len(points_mm), -1))

    return FieldWeights(
        product(y, x), product(y, x_slope) / extent[0], product(y_slope, x) / extent[1]
    )


def cell_quarters(manifest: Manifest, number: int, nodes: tuple[int, int]) -> Array:
    """Return four points (n, 2) in mm in each cell between the nodes of a sheet."""
    finer = (4 * (nodes[0] - 1) + 1, 4 * (nodes[1] - 1) + 1)
    grid = node_positions(manifest, number, finer).reshape(finer[1], finer[0], 2)
    return grid[1::2, 1::2].reshape(-1, 2)


def field_correlation(points: Array, others: Array, length_mm: float) -> tuple[Array, Array]:
    """Return the correlations of a field at two sets of points (n, 2), (m, 2) in mm.

    Returns
    -------
    correlation : (n, m) ndarray
        Matern, smoothness 3/2 (Rasmussen and Williams 2006, eq. 4.17).
    slope : (n, m, 2) ndarray
        Its derivatives by the first points, per mm.
    """
    rate = math.sqrt(3) / length_mm
    offset = points[:, None] - others
    ratio = rate * np.linalg.norm(offset, axis=2)
    decay: Array = np.exp(-ratio)
    return np.asarray((1 + ratio) * decay), -(rate**2) * offset * decay[..., None]


def unresolved_variance(
    nodes: Array, points: Array, weights: FieldWeights, length_mm: float
) -> tuple[float, float, float]:
    """Return the mean variance of a field about its interpolation between true nodes.

    It is relative to that of the field, of the displacement and of its derivatives by x and y.
    """
    among, _ = field_correlation(nodes, nodes, length_mm)
    to_nodes, slope = field_correlation(points, nodes, length_mm)
    squared_rate = 3 / length_mm**2
    value, by_x, by_y = (
        float(
            np.mean(
                variance
                - 2 * (each * cross).sum(axis=1)
                + np.einsum("ni,ij,nj->n", each, among, each)
            )
        )
        for variance, each, cross in (
            (1.0, weights.value, to_nodes),
            (squared_rate, weights.by_x, slope[..., 0]),
            (squared_rate, weights.by_y, slope[..., 1]),
        )
    )
    return value, by_x, by_y


# ---- observations as linear equations


@dataclass
class _SheetPoints:
    """Points of a sheet on the floor, with derivatives by all unknowns.

    Attributes
    ----------
    position : (n, 2) ndarray
        In mm.
    heading : (n,) ndarray
        Of the paper there, with the local rotation of its print.
    by_position : (n, 2, size) ndarray
        Derivatives of the position.
    by_heading : (n, size) ndarray
    """

    position: Array
    heading: Array
    by_position: Array
    by_heading: Array


@dataclass(frozen=True)
class Equations:
    """Linearised observations of one kind.

    Attributes
    ----------
    residual : (m,) ndarray
        Predicted minus observed, in standard deviations for seams, otherwise in mm or rad.
    jacobian : (m, size) ndarray
    observation : (m,) int ndarray
        Index of the observation (a frame) of each row.
    variance : float
        Of the poses on the sheet [mm^2 or rad^2]; 0 for seams.
    """

    residual: Array
    jacobian: Array
    observation: Indices
    variance: float


SEAM, POSITION, HEADING = "seam", "position", "heading"


@dataclass(frozen=True)
class FloorProblem:
    """Observations of a floor.

    Attributes
    ----------
    manifest : Manifest
    layout : UnknownIndices
    seams : tuple of SeamMeasurement
    truths : tuple of TruthObservations
    """

    manifest: Manifest
    layout: UnknownIndices
    seams: tuple[SeamMeasurement, ...]
    truths: tuple[TruthObservations, ...]

    @property
    def truth_frames(self) -> int:
        """Number of poses with truth."""
        return sum(len(truth.time_ns) for truth in self.truths)

    def pose(self, number: int, state: Array) -> Array:
        """Return x, y [mm] and heading [rad] of a sheet."""
        index = self.layout.pose(number)
        if index is not None:
            return np.asarray(state[index])
        sheet = self.manifest.sheets[number]
        x, y = sheet.position_mm or (0.0, 0.0)
        return np.array([x, y, math.radians(sheet.heading_deg)])

    def sheet_points(self, number: int, points: Array, state: Array) -> _SheetPoints:
        """Return points (n, 2) of a sheet's paper on the floor."""
        layout, n = self.layout, len(points)
        x, y, angle = self.pose(number, state)
        rotation = rotation_matrix_2d(angle)
        by_position, by_heading = np.zeros((n, 2, layout.size)), np.zeros((n, layout.size))
        on_paper, heading = points, np.full(n, angle)
        if layout.alignments:
            on_paper = points * (1 + state[layout.scale])
            by_position[:, :, layout.scale] = rotation * points[:, None]
        if number in layout.nodes:
            index = layout.field(number)
            weights = field_weights(self.manifest, number, layout.nodes[number], points)
            along_x, along_y = state[index]
            on_paper = on_paper + np.stack([weights.value @ along_x, weights.value @ along_y], 1)
            heading = heading + (weights.by_x @ along_y - weights.by_y @ along_x) / 2
            for axis in (0, 1):
                by_position[:, :, index[axis]] = rotation[:, axis, None] * weights.value[:, None]
            by_heading[:, index[0]] = -weights.by_y / 2
            by_heading[:, index[1]] = weights.by_x / 2
        rotated = on_paper @ rotation.T
        pose = layout.pose(number)
        if pose is not None:
            by_position[:, 0, pose[0]] = by_position[:, 1, pose[1]] = 1
            by_position[:, :, pose[2]] = _perpendicular(rotated)
            by_heading[:, pose[2]] = 1
        return _SheetPoints(rotated + [x, y], heading, by_position, by_heading)

    def linearize(self, state: Array) -> dict[str, Equations]:
        """Return the equations of all observations, by kind."""
        result = {}
        if self.seams:
            rows = [self._seam_rows(seam, state) for seam in self.seams]
            observation = np.repeat(np.arange(len(rows)), [len(residual) for residual, _ in rows])
            residual, jacobian = (np.concatenate(part) for part in zip(*rows, strict=True))
            result[SEAM] = Equations(residual, jacobian, observation, 0.0)
        start = 0
        parts: dict[str, list[Equations]] = {POSITION: [], HEADING: []}
        for truth in self.truths:
            for kind, equations in self._truth_rows(truth, state):
                observation = equations.observation + start
                parts[kind].append(replace(equations, observation=observation))
            start += len(truth.time_ns)
        for kind, each in parts.items():
            if each:
                result[kind] = Equations(
                    np.concatenate([one.residual for one in each]),
                    np.concatenate([one.jacobian for one in each]),
                    np.concatenate([one.observation for one in each]),
                    float(np.mean([one.variance for one in each])),
                )
        return result

    def _seam_rows(self, seam: SeamMeasurement, state: Array) -> tuple[Array, Array]:
        """Compare the relative poses of the sheets in a frame with those of a state."""
        residual, jacobian = self._compare_seam(seam, state)
        whiten = np.linalg.inv(np.linalg.cholesky(seam.covariance))
        return whiten @ residual, whiten @ jacobian

    def _compare_seam(self, seam: SeamMeasurement, state: Array) -> tuple[Array, Array]:
        """Return predicted minus measured poses (3 k,) in mm and rad, and derivatives."""
        first = self.sheet_points(seam.numbers[0], seam.poses[:, :2], state)
        to_first = np.eye(3)
        to_first[:2, :2] = rotation_matrix_2d(self.pose(seam.numbers[0], state)[2]).T
        residuals, jacobians = [], []
        for k, number in enumerate(seam.numbers[1:]):
            other = self.sheet_points(number, seam.points_mm[k : k + 1], state)
            angle = wrap_angle(other.heading[0] - first.heading[k] - seam.poses[k, 2])
            shift = other.position[0] - first.position[k]
            residuals.append(to_first @ np.append(shift, angle))
            by_pose = np.concatenate(
                [
                    other.by_position[0] - first.by_position[k],
                    other.by_heading - first.by_heading[k : k + 1],
                ]
            )
            jacobians.append(to_first @ by_pose)
        return np.concatenate(residuals), np.concatenate(jacobians)

    def seam_deviations(self, state: Array) -> Iterator[tuple[int, int, Array]]:
        """Yield first sheet, other sheet, and predicted minus measured pose of each measurement."""
        for seam in self.seams:
            residual, _ = self._compare_seam(seam, state)
            for number, deviation in zip(seam.numbers[1:], residual.reshape(-1, 3), strict=True):
                yield seam.numbers[0], number, deviation

    def _truth_rows(
        self, truth: TruthObservations, state: Array
    ) -> Iterator[tuple[str, Equations]]:
        """Compare poses on a sheet with the truth."""
        index = self.layout.alignment(truth.alignment)
        x, y, angle, arm_x, arm_y, mounting = state[index]
        on_floor = self.sheet_points(truth.number, truth.points_mm, state)
        rotation = rotation_matrix_2d(angle)
        rotated = on_floor.position @ rotation.T
        predicted = rotated + [x, y]
        jacobian = rotation @ on_floor.by_position
        jacobian[:, 0, index[0]] = jacobian[:, 1, index[1]] = 1
        jacobian[:, :, index[2]] = _perpendicular(rotated)
        rows = np.arange(len(predicted))
        if truth.has_heading:
            # The camera is at the lever arm on the tracked body, whose position is the truth.
            c, s = np.cos(truth.truth_headings), np.sin(truth.truth_headings)
            body = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], axis=1)
            predicted = predicted - body @ [arm_x, arm_y]
            jacobian[:, :, index[3:5]] = -body
            heading = on_floor.heading + truth.headings + angle + mounting
            by_heading = on_floor.by_heading.copy()
            by_heading[:, index[[2, 5]]] = 1
            residual = wrap_angle(heading - truth.truth_headings)
            yield HEADING, Equations(residual, by_heading, rows, truth.variance[:, 1].mean())
        residual = (predicted - truth.truth_mm).ravel()
        flat = jacobian.reshape(-1, self.layout.size)
        yield POSITION, Equations(residual, flat, rows.repeat(2), truth.variance[:, 0].mean())


def _perpendicular(vectors: Array) -> Array:
    """Return the derivative (..., 2) of vectors by a rotation."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


# ---- fit


@dataclass(frozen=True)
class FloorFit:
    """Posterior of the unknowns.

    Attributes
    ----------
    problem : FloorProblem
        Observations that were used.
    state : (size,) ndarray
    covariance : (size, size) ndarray
    hyperparameters : Hyperparameters
    log_evidence : float
        Logarithm of the marginal likelihood, up to a constant of the observations.
    """

    problem: FloorProblem
    state: Array
    covariance: Array
    hyperparameters: Hyperparameters
    log_evidence: float


@dataclass(frozen=True)
class _NormalEquations:
    """Products of the equations of each kind, of which the evidence is computed."""

    state: Array
    normal: dict[str, Array]
    right: dict[str, Array]
    cost: dict[str, float]
    count: dict[str, int]
    variance: dict[str, float]

    @classmethod
    def of(cls, equations: dict[str, Equations], state: Array) -> _NormalEquations:
        items = equations.items()
        return cls(
            state,
            {kind: each.jacobian.T @ each.jacobian for kind, each in items},
            {kind: each.jacobian.T @ each.residual for kind, each in items},
            {kind: float(each.residual @ each.residual) for kind, each in items},
            {kind: len(each.residual) for kind, each in items},
            {kind: each.variance for kind, each in items},
        )

    def weight(self, kind: str, hyperparameters: Hyperparameters) -> float:
        """Return the inverse variance of a residual."""
        if kind == SEAM:
            return float(hyperparameters.seam**-2)
        sigma = hyperparameters.position_mm if kind == POSITION else hyperparameters.heading
        return 1 / (self.variance[kind] + sigma**2)

    def posterior(
        self, prior: Prior, hyperparameters: Hyperparameters
    ) -> tuple[Array, Array, float]:
        """Return step, factor of the precision, and log evidence.

        Raises
        ------
        LinAlgError
            The precision is not positive.
        """
        precision, log_determinant = prior.precision(hyperparameters)
        prior_gradient = precision @ self.state
        normal, right = precision, prior_gradient.copy()
        energy = float(self.state @ prior_gradient)
        for kind, gram in self.normal.items():
            weight = self.weight(kind, hyperparameters)
            normal = normal + weight * gram
            right += weight * self.right[kind]
            energy += weight * self.cost[kind]
            log_determinant += self.count[kind] * math.log(weight)
        factor = cholesky(normal, lower=True)
        step = -cho_solve((factor, True), right)
        log_determinant -= 2 * float(np.log(np.diag(factor)).sum())
        return step, factor, 0.5 * (log_determinant - energy - float(step @ right))


class Prior:
    """Gaussian prior of the unknowns."""

    def __init__(self, manifest: Manifest, layout: UnknownIndices) -> None:
        self._layout = layout
        sigma = np.full(layout.size, FLAT_SIGMA)
        if layout.alignments:
            sigma[layout.scale] = SCALE_PRIOR_SIGMA
        for index in range(layout.alignments):
            sigma[layout.alignment(index)[3:5]] = LEVER_ARM_PRIOR_SIGMA_MM
        self._rigid = np.diag(sigma**-2.0)
        self._positions = {
            number: node_positions(manifest, number, nodes)
            for number, nodes in layout.nodes.items()
        }
        self._inverse: dict[tuple[int, float], tuple[Array, float]] = {}

    def precision(self, hyperparameters: Hyperparameters) -> tuple[Array, float]:
        """Return the inverse covariance (size, size), and its log determinant for the fields."""
        result, log_determinant = self._rigid.copy(), 0.0
        for number in self._layout.nodes:
            inverse, log_one = self._correlation(number, hyperparameters.correlation_length_mm)
            for axis, unknowns in enumerate(self._layout.field(number)):
                variance = hyperparameters.field_sigma_mm[axis] ** 2
                result[np.ix_(unknowns, unknowns)] = inverse / variance
                log_determinant += log_one - len(unknowns) * math.log(variance)
        return result, log_determinant

    def _correlation(self, number: int, length_mm: float) -> tuple[Array, float]:
        """Return the inverse of the correlation of a field's nodes, and its log determinant."""
        key = number, length_mm
        if key not in self._inverse:
            points = self._positions[number]
            correlation, _ = field_correlation(points, points, length_mm)
            matrix: Array = correlation + RELATIVE_JITTER * np.eye(len(points))
            _, log_determinant = np.linalg.slogdet(matrix)
            self._inverse[key] = np.asarray(np.linalg.inv(matrix)), -float(log_determinant)
        return self._inverse[key]


def fit_state(problem: FloorProblem, state: Array, hyperparameters: Hyperparameters) -> FloorFit:
    """Estimate the unknowns for known hyperparameters by Gauss-Newton steps.

    The equations are nearly linear, so that undamped steps converge.
    """
    prior = Prior(problem.manifest, problem.layout)
    for _ in range(MAX_STEPS):
        normal_equations = _NormalEquations.of(problem.linearize(state), state)
        step, factor, evidence = normal_equations.posterior(prior, hyperparameters)
        state = state + step
        if float(np.abs(factor.T @ step).max(initial=0)) < MAX_LAST_STEP_SIGMAS:
            break
    covariance = cho_solve((factor, True), np.eye(len(state)))
    return FloorFit(problem, state, covariance, hyperparameters, evidence)


def fit_hyperparameters(
    problem: FloorProblem,
    state: Array,
    hyperparameters: Hyperparameters,
    lengths_mm: Sequence[float] | None = None,
) -> Hyperparameters:
    """Return the hyperparameters of the largest evidence about a state, near a given one.

    Correlation lengths that are compared are ``lengths_mm``, by default the given one.
    """
    normal_equations = _NormalEquations.of(problem.linearize(state), state)
    prior = Prior(problem.manifest, problem.layout)
    names = _free_parameters(problem)
    if not names:
        return hyperparameters
    best: tuple[float, Hyperparameters] | None = None
    for length_mm in lengths_mm or (hyperparameters.correlation_length_mm,):
        start = replace(
            hyperparameters if best is None else best[1], correlation_length_mm=length_mm
        )

        def loss(
            logarithms: Array, names: list[str] = names, start: Hyperparameters = start
        ) -> float:
            try:
                _, _, evidence = normal_equations.posterior(prior, _with(start, names, logarithms))
            except LinAlgError:
                return math.inf
            return -evidence

        values = np.log([_get(start, name) for name in names])
        found = minimize(
            loss,
            values,
            method="Nelder-Mead",
            options={"maxfev": MAX_EVALUATIONS, "xatol": 0.02, "fatol": 0.05,
                     "initial_simplex": np.vstack([values, values + np.eye(len(values))])},
        )  # fmt: skip
        if best is None or -found.fun > best[0]:
            best = -float(found.fun), _with(start, names, found.x)
    assert best is not None
    return best[1]


def _free_parameters(problem: FloorProblem) -> list[str]:
    """Return the names of the hyperparameters that the observations may determine."""
    names = ["seam"] if problem.seams else []
    if problem.truths:
        names.append("position_mm")
    if any(truth.has_heading for truth in problem.truths):
        names.append("heading")
    if problem.layout.nodes:
        # Seams see too little of a print to distinguish its axes.
        names += ["field_x", "field_y"] if problem.truths else ["field"]
    return names


def _get(hyperparameters: Hyperparameters, name: str) -> float:
    if name.startswith("field"):
        return hyperparameters.field_sigma_mm[1 if name == "field_y" else 0]
    return float(getattr(hyperparameters, name))


def _with(hyperparameters: Hyperparameters, names: list[str], logarithms: Array) -> Hyperparameters:
    """Return the hyperparameters with some replaced by the exponentials of ``logarithms``."""
    values = dict(zip(names, np.exp(np.clip(logarithms, -30, 30)).tolist(), strict=True))
    x, y = (
        values.pop(name, hyperparameters.field_sigma_mm[k])
        for k, name in enumerate(("field_x", "field_y"))
    )
    both = values.pop("field", None)
    # Measurements are never better than their dots.
    if "seam" in values:
        values["seam"] = max(values["seam"], 1.0)
    return replace(
        hyperparameters, **values, field_sigma_mm=(x, y) if both is None else (both, both)
    )


def _mean_squares(problem: FloorProblem, state: Array) -> dict[str, Array]:
    """Return the mean square of the residuals of each observation, by kind."""
    result = {}
    for kind, equations in problem.linearize(state).items():
        count = np.bincount(equations.observation)
        result[kind] = np.bincount(equations.observation, equations.residual**2) / np.maximum(
            count, 1
        )
    return result


def fit_robustly(
    problem: FloorProblem, state: Array
) -> tuple[FloorProblem, Array, Hyperparameters]:
    """Fit without fields and reject gross outliers.

    Returns
    -------
    problem : FloorProblem
        Without outliers.
    state : (size,) ndarray
    hyperparameters : Hyperparameters
        Of the remaining residuals.
    """
    while True:
        hyperparameters = Hyperparameters()
        for _ in range(MAX_STEPS):
            squares = _mean_squares(problem, state)
            scales = {
                kind: max(SIGMA_PER_MEDIAN_ABSOLUTE * math.sqrt(float(np.median(each))), 1e-9)
                for kind, each in squares.items()
            }
            hyperparameters = Hyperparameters(
                seam=max(scales.get(SEAM, 1.0), 1.0),
                position_mm=scales.get(POSITION, hyperparameters.position_mm),
                heading=scales.get(HEADING, hyperparameters.heading),
            )
            weights = {kind: 1 / (1 + each / scales[kind] ** 2) for kind, each in squares.items()}
            equations = {
                kind: replace(
                    each,
                    residual=each.residual * np.sqrt(weights[kind])[each.observation],
                    jacobian=each.jacobian * np.sqrt(weights[kind])[each.observation, None],
                )
                for kind, each in problem.linearize(state).items()
            }
            normal_equations = _NormalEquations.of(equations, state)
            step, factor, _ = normal_equations.posterior(
                Prior(problem.manifest, problem.layout), hyperparameters
            )
            state = state + step
            if float(np.abs(factor.T @ step).max(initial=0)) < MAX_LAST_STEP_SIGMAS:
                break
        squares = _mean_squares(problem, state)
        limits = {
            SEAM: (GROSS_OUTLIER_SIGMAS * hyperparameters.seam) ** 2,
            POSITION: (GROSS_OUTLIER_SIGMAS * hyperparameters.position_mm) ** 2,
            HEADING: (GROSS_OUTLIER_SIGMAS * hyperparameters.heading) ** 2,
        }
        kept = _keep(problem, {kind: each <= limits[kind] for kind, each in squares.items()})
        if kept is problem:
            return problem, state, hyperparameters
        problem = kept


def _keep(problem: FloorProblem, masks: dict[str, NDArray[np.bool_]]) -> FloorProblem:
    """Return the problem without the observations whose mask is false in any kind."""
    if all(mask.all() for mask in masks.values()):
        return problem
    seams, truths = problem.seams, problem.truths
    if SEAM in masks:
        seams = tuple(np.array(seams, object)[masks[SEAM]])
    if truths:
        kept = masks[POSITION].copy()
        if HEADING in masks:
            kept[: len(masks[HEADING])] &= masks[HEADING]
        ends = np.cumsum([len(truth.time_ns) for truth in truths])[:-1]
        parts = zip(truths, np.split(kept, ends), strict=True)
        truths = tuple(truth.select(mask) for truth, mask in parts if mask.any())
    return replace(problem, seams=seams, truths=truths)


def fit_floor(problem: FloorProblem, state: Array) -> FloorFit:
    """Estimate hyperparameters and unknowns; reject observations that contradict the others.

    ``problem`` has fields, which are left out of the result unless there is strong evidence.
    """
    fields = problem.layout.nodes
    rigid = replace(problem, layout=replace(problem.layout, nodes={}))
    rigid, state, hyperparameters = fit_robustly(rigid, state[: rigid.layout.size])
    without = _fit_gated(rigid, state, hyperparameters)
    if not fields or _is_explained(without):
        return without
    deviation = (
        max(without.hyperparameters.position_mm, MIN_FIELD_MM) if problem.truths else MIN_FIELD_MM
    )
    hyperparameters = replace(without.hyperparameters, field_sigma_mm=(deviation, deviation))
    layout = replace(problem.layout, nodes=fields)
    start = np.concatenate([without.state, np.zeros(layout.size - len(without.state))])
    with_field = _fit_gated(replace(rigid, layout=layout), start, hyperparameters)
    same = replace(with_field.problem, layout=without.problem.layout)
    reference = fit_state(
        same, without.state, fit_hyperparameters(same, without.state, without.hyperparameters)
    )
    gain = with_field.log_evidence - reference.log_evidence
    return with_field if gain > MIN_FIELD_EVIDENCE else without


def _is_explained(fit: FloorFit) -> bool:
    """Return whether seams agree within the noise of their dots, without fields and truth."""
    if fit.problem.truths:
        return False
    if not fit.problem.seams:
        return True
    residual = fit.problem.linearize(fit.state)[SEAM].residual
    excess = float(residual @ residual) / len(residual) - 1
    return excess < MAX_EXCESS_SIGMAS * math.sqrt(2 / len(residual))


def _fit_gated(problem: FloorProblem, state: Array, hyperparameters: Hyperparameters) -> FloorFit:
    """Fit hyperparameters and unknowns in turn, and reject improbable observations."""
    lengths_mm = CORRELATION_LENGTHS_MM if problem.layout.nodes else None
    for _ in range(MAX_GATING_ROUNDS):
        hyperparameters = fit_hyperparameters(problem, state, hyperparameters, lengths_mm)
        lengths_mm = None
        fit = fit_state(problem, state, hyperparameters)
        state = fit.state
        masks = {}
        for kind, equations in problem.linearize(state).items():
            weight = _NormalEquations.of({kind: equations}, state).weight(kind, hyperparameters)
            squares = weight * np.bincount(equations.observation, equations.residual**2)
            freedom = np.bincount(equations.observation)
            masks[kind] = squares <= chdtri(np.maximum(freedom, 1), OUTLIER_PROBABILITY)
        kept = _keep(problem, masks)
        if kept is problem:
            return fit
        problem = kept
    return fit_state(problem, state, hyperparameters)


# ---- validation


def cross_validate(fit: FloorFit) -> tuple[float, float]:
    """Return the rms errors [mm] of held-out poses with truth, without fields and with them.

    Each of :data:`FOLDS` successive parts of the recordings is left out once. The fits without
    fields have hyperparameters of their own.
    """
    problem = fit.problem
    rigid = replace(problem, layout=replace(problem.layout, nodes={}))
    start = fit.state[: rigid.layout.size]
    rigid_hyperparameters = fit_hyperparameters(
        rigid, fit_state(rigid, start, fit.hyperparameters).state, fit.hyperparameters
    )
    squares = []
    for fold in range(FOLDS):
        masks = [_part_of(problem, truth, fold) for truth in problem.truths]
        held_out, training = (
            tuple(
                truth.select(mask == chosen)
                for truth, mask in zip(problem.truths, masks, strict=True)
                if (mask == chosen).any()
            )
            for chosen in (True, False)
        )
        if not held_out or not training:
            continue
        errors = []
        for each, state, hyperparameters in (
            (rigid, start, rigid_hyperparameters),
            (problem, fit.state, fit.hyperparameters),
        ):
            trained = fit_state(replace(each, truths=training), state, hyperparameters)
            tested = replace(each, seams=(), truths=held_out).linearize(trained.state)
            errors.append(tested[POSITION].residual.reshape(-1, 2))
        squares.append(np.square(errors).sum(axis=2))
    if not squares:
        return math.nan, math.nan
    without, with_fields = np.sqrt(np.concatenate(squares, axis=1).mean(axis=1)).tolist()
    return without, with_fields


def _part_of(problem: FloorProblem, truth: TruthObservations, fold: int) -> NDArray[np.bool_]:
    """Return the poses of a part of their recording, by time."""
    stamps = np.concatenate(
        [other.time_ns for other in problem.truths if other.alignment == truth.alignment]
    )
    rank = np.searchsorted(np.sort(stamps), truth.time_ns)
    return np.asarray(rank * FOLDS // len(stamps) == fold)
