"""Smoothing of a robot with slipping wheels and displaced landmarks: which priors do not hold.

The random walk of the odometry and the pose of each landmark have Gaussian priors
(:mod:`.smoothing`). After each minimization every prior is compared with what all other
measurements say of the same unknowns (data snooping; Baarda, A testing procedure for use in
geodetic networks, 1968). For unknowns z with a prior N(0, I) and a posterior N(m, P), the others
alone have the information L = P^-1 - I with L z = P^-1 m. Their probability with a prior of any
covariance follows in closed form: with I if the prior holds, with a far wider one if a wheel
slipped or a landmark is displaced. If the second is more probable, the prior is widened, and
everything is estimated again. The same comparison takes a wide prior back.

The variances of the random walk and of the poses of landmarks are estimated from the same numbers,
as variance components (Foerstner, Zeitschrift fuer Vermessungswesen 104 (1979) 446): the sum of
squares of their unknowns over their redundancy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.trace import (
    CONSTANT_ERROR_COUNT,
    OdometryDrift,
    relative,
    walk_units,
)
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.localization.cell_steps import (
    SLIP_PROBABILITY,
    SLIP_SCALE_M,
    SLIP_SCALE_RAD,
)
from locatk.core.landmarks.localization.smoothing import (
    LANDMARK_SIGMA,
    POSE_SIZE,
    Indices,
    LandmarkPrior,
    RobotMeasurements,
    SmoothingResult,
    SmoothingSystem,
    SystemSolution,
    VisitPose,
    bin_pose_with_gradient,
)
from locatk.core.landmarks.map.floor import Cell

Array = NDArray[np.float64]

DISPLACEMENT_PROBABILITY = 0.01
"""Probability that a landmark is displaced."""

SLIP_SCALES = (0.3, 1.0, 3.0, 9.0)
"""Standard deviations of the slips that are considered, in units of
:data:`.cell_steps.SLIP_SCALE_M` and :data:`.cell_steps.SLIP_SCALE_RAD`: slips have long tails."""

DISPLACED_LANDMARK_SIGMA = np.array([0.02, 0.02, 0.1])
"""Standard deviations (m, m, rad) of a displaced landmark about its pose on the map."""

MIN_RELEASE_ODDS = 10.0
"""Odds of a slip or displacement from which on it is assumed."""

MIN_ALTERNATIVE_ODDS = 0.05
"""Odds of another explanation, relative to the best, from which on it is reported as well."""

FREE_WEIGHT = 1e-8
"""Weight of the prior of a released random walk: tens of metres."""

MIN_REDUNDANCY = 0.05
"""Fraction of an unknown that other measurements determine, from which on its prior is tested."""

MAX_LINEAR_M, MAX_LINEAR_RAD = 0.03, math.radians(10)
"""Differences between odometry and landmarks beyond which the linearization fails; a slip is then
assumed from the start."""

VARIANCE_PRIOR_FREEDOM = 4.0
"""Degrees of freedom of the prior of each variance: its root is known to a factor of about two."""

WALK_COMPONENTS, LANDMARK_COMPONENTS = slice(0, 2), slice(2, 4)
"""Variance components: of heading and position of the random walk, and of the poses of
landmarks."""

COMPONENT_COUNT = 4
FIXED = COMPONENT_COUNT
"""Component of landmarks as built, whose standard deviations are known from their calibration."""

MAX_LINEARIZATIONS, MAX_PRIOR_ROUNDS = 4, 12
"""Largest numbers of minimizations, and of changes of priors after each."""

MIN_SIGMA_CHANGE = 0.05
"""Relative change of a standard deviation below which it has converged."""


@dataclass(frozen=True)
class WheelSlip:
    """Slip of a wheel.

    Attributes
    ----------
    first_ns, last_ns : int
        Times between which it occurred.
    distance_m, rotation_rad : float
        Difference between the motion by odometry and the true one.
    """

    first_ns: int
    last_ns: int
    distance_m: float
    rotation_rad: float


@dataclass(frozen=True)
class DisplacedLandmark:
    """Landmark that is not at its pose on the map, and by how much."""

    cell: Cell
    distance_m: float
    rotation_rad: float


Cause = WheelSlip | DisplacedLandmark


@dataclass(frozen=True)
class RobustSmoothing:
    """Result of :func:`smooth_robustly`.

    Attributes
    ----------
    measurements : RobotMeasurements
        With corrections in units of the estimated random walk.
    result : SmoothingResult
    causes : list of tuple of Cause
        Priors that do not hold; alternatives of one inconsistency are in one tuple.
    slipped_links, slipped_visits : frozenset of int
        Links between visits, and visits, with a slip.
    drift : OdometryDrift
        With the estimated random walk.
    """

    measurements: RobotMeasurements
    result: SmoothingResult
    causes: list[tuple[Cause, ...]]
    slipped_links: frozenset[int]
    slipped_visits: frozenset[int]
    drift: OdometryDrift


def smooth_robustly(
    robot: RobotMeasurements,
    landmarks: Mapping[Cell, LandmarkPrior],
    geometry: Geometry,
    priors: ModelPriors,
    *,
    estimate_walk: bool = True,
) -> RobustSmoothing:
    """Smooth the visits of one robot; release the priors that do not hold.

    Parameters
    ----------
    robot, landmarks, geometry, priors
        See :func:`.smoothing.smooth`.
    estimate_walk : bool
        Estimate the variance of the random walk of the odometry; else it is that of ``priors``.
    """
    snooping = _Snooping(SmoothingSystem([robot], landmarks, geometry, priors), priors.drift)
    snooping.release_nonlinear_links()
    snooping.minimize()
    for _ in range(MAX_LINEARIZATIONS):
        if not snooping.update_priors(estimate_walk):
            break
        snooping.minimize()
    return snooping.result()


@dataclass
class _Candidate:
    """Unknowns whose common prior may not hold.

    Attributes
    ----------
    columns : (k,) ndarray
    component : (k,) ndarray
        Variance component of each.
    sigma : (k,) ndarray
        Standard deviations of the prior if it holds.
    scales : (s, k) ndarray
        Standard deviations if it does not: alternatives.
    log_odds : float
        That it does not, before any measurement.
    free_weight : (k,) ndarray
        Weights of the prior after its release.
    visit : int
        Visit during or after which a wheel may slip; -1 for a landmark.
    unit : int
        Unit of the random walk of the visit, or -1 for the link after it.
    cell : (row, column) or None
        Landmark that may be displaced.
    alternatives : list of _Candidate
        Other explanations of the same inconsistency.
    """

    columns: Indices
    component: Indices
    sigma: Array
    scales: Array
    log_odds: float
    free_weight: Array
    visit: int = -1
    unit: int = -1
    cell: Cell | None = None
    is_released: bool = False
    alternatives: list[_Candidate] = field(default_factory=list)
    information: Array = field(default_factory=lambda: np.empty(0))
    mean_information: Array = field(default_factory=lambda: np.empty(0))

    def prior_weight(self) -> Array:
        """Return the present weights of the prior."""
        return self.free_weight if self.is_released else self.sigma**-2

    def update(self, solution: SystemSolution) -> None:
        """Compute the information of all other measurements from the posterior."""
        inverse = np.asarray(np.linalg.inv(solution.covariance(self.columns)), float)
        self.information = inverse - np.diag(self.prior_weight())
        self.mean_information = inverse @ solution.state[self.columns]

    def log_posterior_odds(self) -> float:
        """Return the log odds that the prior does not hold."""
        # A landmark is not displaced if it is within the tolerance of any floor.
        sigma = self.sigma if self.cell is None else np.maximum(self.sigma, 1.0)
        scales = np.maximum(self.scales, sigma)
        wide = np.logaddexp.reduce([self._log_evidence(scale) for scale in scales])
        return float(self.log_odds + wide - math.log(len(scales)) - self._log_evidence(sigma))

    def _log_evidence(self, scale: Array) -> float:
        """Return the log evidence of all other measurements with a prior, up to a constant."""
        matrix = np.eye(len(scale)) + scale[:, None] * self.information * scale
        vector = scale * self.mean_information
        _, log_determinant = np.linalg.slogdet(matrix)
        return float(vector @ np.linalg.solve(matrix, vector) - log_determinant) / 2

    def chi_square(self) -> tuple[float, int]:
        """Return the statistic of the test that the prior holds, and its degrees of freedom."""
        value, vector = np.linalg.eigh(self.sigma[:, None] * self.information * self.sigma)
        is_tested = value > MIN_REDUNDANCY / (1 - MIN_REDUNDANCY)
        value = value[is_tested]
        along = vector.T[is_tested] @ (self.sigma * self.mean_information)
        return float(np.sum(along**2 / (value * (1 + value)))), int(is_tested.sum())


class _Snooping:
    """State of the smoothing of one robot, and the candidates whose priors are tested."""

    def __init__(self, system: SmoothingSystem, drift: OdometryDrift) -> None:
        self.system, self.drift = system, drift
        # Standard deviations by variance component, in those of the priors.
        self.sigma = np.ones(COMPONENT_COUNT + 1)
        self.state = system.initial_state()
        self.candidates = [*self._walk_candidates(), *self._landmark_candidates()]

    @property
    def robot(self) -> RobotMeasurements:
        return self.system.robots[0]

    def minimize(self) -> None:
        """Minimize with the present priors, and update all candidates."""
        self._use(self.system.minimize(self.state))

    def update_priors(self, estimate_walk: bool) -> bool:
        """Change the priors of the linearized measurements until they agree; return if any did."""
        has_changed = False
        for _ in range(MAX_PRIOR_ROUNDS):
            if not (
                (estimate_walk and self._raise_sigma(WALK_COMPONENTS))
                or self._raise_sigma(LANDMARK_COMPONENTS)
                or self._update_released()
                or self._update_sigma(estimate_walk)
            ):
                break
            has_changed = True
            self._use(self.system.solve(self.solution.equations))
        return has_changed

    def _use(self, solution: SystemSolution) -> None:
        self.solution, self.state = solution, solution.state
        for one in self.candidates:
            one.update(solution)

    # ---- candidates

    def _walk_candidates(self) -> list[_Candidate]:
        candidates = []
        for k, visit in enumerate(self.robot.visits):
            columns = self.system.visit_columns[0][k][POSE_SIZE:]
            units = walk_units(visit.trace.correction.shape[2])
            for number, unit in enumerate(units):
                span = np.ptp(visit.trace.correction[:, :, unit], axis=0)
                own = columns[unit - CONSTANT_ERROR_COUNT]
                candidates.append(_slip_candidate(own, span[[2, 0, 1], [0, 1, 2]], 1, k, number))
        for k, link in enumerate(self.robot.links):
            if link is None:
                continue
            units = walk_units(link.correction.shape[2])
            span = np.abs(link.correction[-1][np.repeat([2, 0, 1], len(units)), units.T.ravel()])
            own = self.system.link_columns[0][k]
            candidates.append(_slip_candidate(own, span, len(units), k, -1))
        return [one for one in candidates if np.isfinite(one.scales).all()]

    def _landmark_candidates(self) -> list[_Candidate]:
        candidates = []
        for cell, prior in self.system.landmarks.items():
            scale = np.maximum(DISPLACED_LANDMARK_SIGMA / prior.sigma, 1.0)
            columns = self.system.landmark_columns[cell][:POSE_SIZE]
            odds = math.log(DISPLACEMENT_PROBABILITY / (1 - DISPLACEMENT_PROBABILITY))
            is_designed = np.array_equal(prior.sigma, LANDMARK_SIGMA)
            component = np.array([3, 3, 2]) if is_designed else np.full(POSE_SIZE, FIXED)
            sigma = np.ones(POSE_SIZE)
            candidates.append(
                _Candidate(columns, component, sigma, scale[None], odds, scale**-2, cell=cell)
            )
        return candidates

    # ---- releases

    def release_nonlinear_links(self) -> None:
        """Release the links that contradict the landmarks by more than the linearization takes."""
        visits, unknowns = self.robot.visits, self.system.visit_columns[0]
        for one in self.candidates:
            link = self.robot.links[one.visit] if one.cell is None and one.unit < 0 else None
            if link is None:
                continue
            start, end = (
                bin_pose_with_gradient(
                    visits[k].trace, index, self.state[unknowns[k]], self.robot.errors
                )[0]
                for k, index in ((one.visit, -1), (one.visit + 1, 0))
            )
            path = link.without_constant_errors(self.robot.errors)
            difference = relative(end[None], start)[0] - path[-1]
            distance = float(np.hypot(*difference[:2]))
            rotation = abs(math.remainder(difference[2], math.tau))
            if distance > MAX_LINEAR_M or rotation > MAX_LINEAR_RAD:
                self._set_released(one, True)

    def _update_released(self) -> bool:
        """Release the priors that do not hold, and take others back; return if any changed.

        Of neighbouring candidates the best is released, because it may explain the others.
        Alternatives stay released together: each explains alone what the others would.
        """
        odds = np.array([one.log_posterior_odds() for one in self.candidates])
        limit = math.log(MIN_RELEASE_ODDS)
        has_changed = False
        groups = [[one, *one.alternatives] for one in self.candidates if one.alternatives]
        grouped = {id(one) for group in groups for one in group}
        for one, own in zip(self.candidates, odds, strict=True):
            if one.is_released and id(one) not in grouped and own < limit:
                self._set_released(one, False)
                has_changed = True
        if has_changed:
            return True
        held = [n for n, one in enumerate(self.candidates) if not one.is_released]
        if not held:
            return False
        best = max(held, key=lambda n: odds[n])
        if odds[best] < limit:
            return False
        chosen = self.candidates[best]
        alternatives = [
            n
            for n in held
            if n != best
            and odds[n] > odds[best] + math.log(MIN_ALTERNATIVE_ODDS)
            and self._explains(best, n)
        ]
        chosen.alternatives = [self.candidates[n] for n in alternatives]
        for n in [best, *alternatives]:
            self._set_released(self.candidates[n], True)
        return True

    def _explains(self, first: int, second: int) -> bool:
        """Return if two candidates explain the same inconsistency: they are correlated."""
        one, other = self.candidates[first], self.candidates[second]
        columns = np.concatenate([one.columns, other.columns])
        covariance = self.solution.covariance(columns)
        size = len(one.columns)
        cross = covariance[:size, size:] / np.outer(one.sigma, other.sigma)
        return bool(np.abs(cross).max() > MIN_REDUNDANCY)

    def _set_released(self, one: _Candidate, is_released: bool) -> None:
        one.is_released = is_released
        if not is_released:
            one.alternatives = []
        self.system.prior_weight[one.columns] = one.prior_weight()

    # ---- variances

    def _raise_sigma(self, components: slice) -> bool:
        """Raise the standard deviations of the random walk, or of the landmarks.

        They are raised until half of the unknowns agree with them.

        Returns
        -------
        bool
            If they changed.
        """
        numbers = np.arange(COMPONENT_COUNT)[components]
        tests = [one.chi_square() for one in self.candidates if one.component[0] in numbers]
        statistic, freedom = np.array([test for test in tests if test[1]]).reshape(-1, 2).T
        prior = np.ones(round(VARIANCE_PRIOR_FREEDOM / POSE_SIZE))
        ratio = np.concatenate([statistic / chi2.ppf(0.5, freedom), prior])
        factor = math.sqrt(float(np.median(ratio)))
        if factor < 1 + MIN_SIGMA_CHANGE:
            return False
        sigma = self.sigma.copy()
        sigma[numbers] *= factor
        self._set_sigma(sigma)
        return True

    def _update_sigma(self, estimate_walk: bool) -> bool:
        """Estimate the standard deviations by variance component; return if they changed."""
        squares, redundancy = np.zeros((2, len(self.sigma)))
        for one in self.candidates:
            if one.is_released:
                continue
            weight = one.prior_weight()
            posterior = np.linalg.inv(one.information + np.diag(weight))
            mean = posterior @ one.mean_information
            np.add.at(squares, one.component, mean**2)
            np.add.at(redundancy, one.component, 1 - weight * np.diag(posterior))
        freedom = VARIANCE_PRIOR_FREEDOM
        sigma = np.sqrt((freedom + squares) / (freedom + redundancy))
        sigma[FIXED] = 1.0
        if not estimate_walk:
            sigma[WALK_COMPONENTS] = 1.0
        change = float(np.abs(np.log(sigma / self.sigma)).max())
        self._set_sigma(sigma)
        return change > MIN_SIGMA_CHANGE

    def _set_sigma(self, sigma: Array) -> None:
        self.sigma = sigma
        for one in self.candidates:
            one.sigma = sigma[one.component]
            self.system.prior_weight[one.columns] = one.prior_weight()

    # ---- result

    def result(self) -> RobustSmoothing:
        """Return the estimates."""
        result = self.system.result(self.solution)
        heading, position = self.sigma[WALK_COMPONENTS].tolist()
        drift = replace(
            self.drift,
            walk_rad=heading * self.drift.walk_rad,
            walk_m=position * self.drift.walk_m,
        )
        visits = [_with_walk_unit(pose, self.sigma[WALK_COMPONENTS]) for pose in result.visits[0]]
        causes, reported = [], set()
        for one in self.candidates:
            if one.is_released and one.alternatives:
                causes.append((self._cause(one), *map(self._cause, one.alternatives)))
                reported |= {id(one), *map(id, one.alternatives)}
        for one in self.candidates:
            if one.is_released and id(one) not in reported:
                causes.append((self._cause(one),))
        slips = [one for one in self.candidates if one.is_released and one.cell is None]
        return RobustSmoothing(
            self.robot.with_drift(drift),
            replace(result, visits=[visits]),
            causes,
            slipped_links=frozenset(one.visit for one in slips if one.unit < 0),
            slipped_visits=frozenset(one.visit for one in slips if one.unit >= 0),
            drift=drift,
        )

    def _cause(self, one: _Candidate) -> Cause:
        state = self.state[one.columns]
        if one.cell is not None:
            shift = self.system.landmarks[one.cell].sigma * state
            return DisplacedLandmark(one.cell, float(np.hypot(*shift[:2])), float(shift[2]))
        visits = self.robot.visits
        times = visits[one.visit].segment.time_ns
        heading, x, y = state.reshape(3, -1)
        link = self.robot.links[one.visit] if one.unit < 0 else None
        if link is not None:
            units, correction = walk_units(link.correction.shape[2]).T, link.correction[-1]
            first_ns, last_ns = times[-1], visits[one.visit + 1].segment.time_ns[0]
        else:
            trace = visits[one.visit].trace
            units = walk_units(trace.correction.shape[2])[[one.unit]].T
            correction = trace.correction[-1] - trace.correction[0]
            changes = np.flatnonzero(np.diff(trace.correction[:, 0, units[1, 0]]))
            first_ns, last_ns = times[changes[0]], times[changes[-1] + 1]
        distance = math.hypot(correction[0, units[1]] @ x, correction[1, units[2]] @ y)
        rotation = float(correction[2, units[0]] @ heading)
        return WheelSlip(int(first_ns), int(last_ns), distance, rotation)


def _slip_candidate(columns: Indices, span: Array, units: int, visit: int, unit: int) -> _Candidate:
    """Return the candidate of a slip; ``span`` is the effect of one unit of each column."""
    slip = np.repeat([SLIP_SCALE_RAD, SLIP_SCALE_M, SLIP_SCALE_M], units) / math.sqrt(units)
    with np.errstate(divide="ignore"):
        scales = np.array(SLIP_SCALES)[:, None] * (slip / span)
    odds = math.log(SLIP_PROBABILITY / (1 - SLIP_PROBABILITY))
    free = np.full(len(columns), FREE_WEIGHT)
    component, sigma = np.repeat([0, 1, 1], units), np.ones(len(columns))
    return _Candidate(columns, component, sigma, scales, odds, free, visit, unit)


def _with_walk_unit(estimate: VisitPose, sigma: Array) -> VisitPose:
    """Return an estimate with the standard deviations (2,) of the walk as units of its errors."""
    count = (len(estimate.corrections) - CONSTANT_ERROR_COUNT) // 3
    walk = np.repeat(sigma, [count, 2 * count])
    unit = np.concatenate([np.ones(POSE_SIZE + CONSTANT_ERROR_COUNT), walk])
    covariance = estimate.covariance / np.outer(unit, unit)
    return VisitPose(estimate.pose, estimate.corrections / unit[POSE_SIZE:], covariance)
