r"""Survey of a site: poses of tags from several drives with odometry over them.

Each pass over a tag measures the pose of the tag in the frame of the array. Odometry measures the
motion between two passes of a drive, a *leg*. The poses of all tags, the poses of the array at all
passes, and two systematic errors of the odometry of each device (scale, and rotation per metre)
minimize the squares of the residuals (:mod:`locatk.core.least_squares`), a pose graph with loops
closed by ids (Grisetti et al., A tutorial on graph-based SLAM, 2010).

Random errors of odometry accumulate along the path: a random walk of the heading, whose effect on
the position is integrated over the path, and one of the position. Their usual variances are
multiplied by a factor that is estimated from the closed loops (variance components; Foerstner and
Wrobel, Photogrammetric Computer Vision, 2016, section 4.2.4).

A motion of the whole site changes no residual (gauge). One tag or more are fixed, or the pose of
the array at the start of the first drive; the covariances hold in the frame that these define. A
common scale error of the odometry of all drives is not observable without two fixed tags, so that
covariances contain its prior.

A drive contradicts the others if its residuals are improbable, given the site and the odometry of
all other drives (F test of the increase of the cost). The worst one is excluded, until none
contradicts.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion, wrap_angle
from locatk.core.least_squares import DenseEquations, Indices, minimize
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

HEADING_WALK_RAD = math.radians(1.0)
"""Usual standard deviation of the heading after a metre of odometry (random walk) [rad/sqrt(m)]."""

POSITION_WALK_M = 2e-3
"""Usual standard deviation of the position after a metre, besides the heading's [m/sqrt(m)]."""

ROTATION_ARM_M = 0.1
"""Path of the wheels for a rotation by one radian: half of a usual track width."""

SCALE_SIGMA, DRIFT_SIGMA_RAD_PER_M = 0.02, math.radians(1.0)
"""Standard deviations of the systematic errors of odometry: relative scale, as of a wheel's
diameter, and rotation per metre, as of unequal wheels (Borenstein and Feng, UMBmark, IEEE Trans.
Robot. Autom. 12 (1996) 869)."""

LEG_FLOOR_M, LEG_FLOOR_RAD = 2e-4, math.radians(0.02)
"""Standard deviations of a leg of any length: interpolation between two poses of odometry."""

PRIOR_REDUNDANCY = 6.0
"""Weight of the usual variances of odometry, in redundant measurements."""

VARIANCE_ROUNDS, VARIANCE_TOLERANCE = 8, 1e-3
"""Largest number of rounds of the estimation of the variance factor, which converges linearly, and
the relative change that ends it."""

MIN_GAIN = 1e-7
"""Relative gain of a step at which the least squares have converged."""

MAX_CONTRADICTION_PROBABILITY = 1e-4
"""Probability of the residuals of a drive, given the others, below which it is excluded."""

MIN_JUDGED_DRIVES = 3
"""Number of drives from which the one that contradicts the others is known."""

REPORTED_ODOMETRY_RATIO = 3.0
"""Ratio of the errors of odometry to the usual ones from which it is reported."""

MAX_ODOMETRY_RATIO = 20.0
"""Ratio from which the passes contradict each other, whatever the odometry."""

MAX_UNKNOWNS = 9000
"""Largest number of unknowns; the normal equations are dense."""


@dataclass(frozen=True)
class TagVisit:
    """Pass over a tag.

    Attributes
    ----------
    tag_id : int
    time_s : float
    pose : (3,) ndarray
        x, y and heading of the tag in the frame of the array.
    sigma : (3,) ndarray
        Standard deviations.
    """

    tag_id: int
    time_s: float
    pose: Array
    sigma: Array


@dataclass(frozen=True)
class OdometryLeg:
    """Motion of the array from one pass to the next one, by odometry.

    Attributes
    ----------
    motion : (3,) ndarray
        x, y and heading of the array at the end, in its frame at the start.
    by_scale, by_drift : (3,) ndarray
        Derivatives of the motion by the relative scale and by the rotation per metre.
    covariance : (3, 3) ndarray
        Of the usual random errors.
    """

    motion: Array
    by_scale: Array
    by_drift: Array
    covariance: Array


@dataclass(frozen=True)
class SurveyDrive:
    """Passes of one array over tags, and the odometry between them.

    Attributes
    ----------
    name : str
        Name of the drive in messages.
    device : str
        Drives of one device share the systematic errors of its odometry.
    visits : tuple of TagVisit
        In order of time; at least two.
    legs : tuple of OdometryLeg
        From each visit to the next one.
    start : OdometryLeg
        From the start of the odometry to the first visit.
    """

    name: str
    device: str
    visits: tuple[TagVisit, ...]
    legs: tuple[OdometryLeg, ...]
    start: OdometryLeg


@dataclass(frozen=True)
class SurveyedTag:
    """Pose of one tag.

    Attributes
    ----------
    tag_id : int
    pose : PlanarPose
    covariance : (3, 3) ndarray
        Of x, y and heading in the frame of the site; zero if the tag is fixed.
    passes, drives : int
        Number of passes over the tag, and of drives with such passes.
    is_fixed : bool
    """

    tag_id: int
    pose: PlanarPose
    covariance: Array
    passes: int
    drives: int
    is_fixed: bool


@dataclass(frozen=True)
class SurveyReport:
    """Result of a survey.

    Attributes
    ----------
    tags : Tags
        The given tags with the surveyed site.
    surveyed : tuple of SurveyedTag
        By id.
    gauge : str
        What fixes the frame, for people.
    drives : int
        Number of drives that were used.
    redundancy : float
        Number of measurements beyond the unknowns.
    odometry_ratio : float
        Estimated random errors of the odometry, relative to the usual ones.
    scale, scale_sigma : dict of str to float
        Relative error of the scale of the odometry by device, and its standard deviation.
    left_out : dict of str to str
        Names of drives and passes that were not used, with the reasons.
    notes : tuple of str
    """

    tags: Tags
    surveyed: tuple[SurveyedTag, ...]
    gauge: str
    drives: int
    redundancy: float
    odometry_ratio: float
    scale: dict[str, float]
    scale_sigma: dict[str, float]
    left_out: dict[str, str]
    notes: tuple[str, ...]


# ---- observations


def read_drive(
    name: str, detections: Sequence[TagDetection], odometry: Trajectory | None
) -> tuple[SurveyDrive | None, dict[str, str]]:
    """Return the passes of an array over tags with the odometry between them.

    Parameters
    ----------
    name : str
    detections : sequence of TagDetection
        Of one array.
    odometry : Trajectory or None
        Valid poses of the array in order of time.

    Returns
    -------
    drive : SurveyDrive or None
        None if the drive has less than two usable passes.
    left_out : dict of str to str
        Names of passes, or of the drive, that are not used, with the reasons.
    """
    if odometry is None or len(odometry) < 2:
        return None, {name: "no odometry"}
    left_out: dict[str, str] = {}
    visits = []
    time_s = 1e-9 * (odometry.time_ns - odometry.time_ns[0])
    for each in sorted(detections, key=lambda detection: detection.time_s):
        at_s = each.time_s - 1e-9 * float(odometry.time_ns[0])
        label = f"{name} at {at_s:.3f} s"
        if each.tag_id is None:
            left_out[label] = f"not read: {each.refused or 'no reason'}".replace("_", " ")
        elif each.x_m is None or each.y_m is None or each.heading_rad is None:
            left_out[label] = "no pose of the tag"
        elif not time_s[0] <= at_s <= time_s[-1]:
            left_out[label] = "no odometry at that time"
        else:
            sigma = np.array([each.sigma_x_m, each.sigma_y_m, each.sigma_heading_rad])
            pose = np.array([each.x_m, each.y_m, each.heading_rad])
            if np.isfinite(sigma).all():
                visits.append(TagVisit(each.tag_id, at_s, pose, sigma))
            else:
                left_out[label] = "the method estimates no standard deviations"
    if len(visits) < 2:
        left_out[name] = f"{len(visits)} passes over tags with odometry; a drive needs two"
        return None, left_out
    path = np.column_stack(
        [odometry.position[:, :2], np.unwrap(heading_from_quaternion(odometry.quaternion))]
    )
    times = [visit.time_s for visit in visits]
    legs = tuple(_leg(time_s, path, start, end) for start, end in itertools.pairwise(times))
    start_leg = _leg(time_s, path, float(time_s[0]), times[0])
    return SurveyDrive(name, odometry.device, tuple(visits), legs, start_leg), left_out


def _leg(time_s: Array, path: Array, start_s: float, end_s: float) -> OdometryLeg:
    """Return the motion between two times, by the poses (n, 3) of odometry."""
    inside = time_s[(time_s > start_s) & (time_s < end_s)]
    wanted_s = np.concatenate([[start_s], inside, [end_s]])
    poses = np.column_stack([np.interp(wanted_s, time_s, column) for column in path.T])
    cos, sin = math.cos(poses[0, 2]), math.sin(poses[0, 2])
    local = (poses[:, :2] - poses[0, :2]) @ np.array([[cos, -sin], [sin, cos]])
    heading = poses[:, 2] - poses[0, 2]
    step = np.diff(local, axis=0)
    step_m = np.hypot(*step.T)
    # A rotation within a step moves all that follows about the middle of the step.
    arm = local[-1] - (local[1:] + local[:-1]) / 2
    by_rotation = np.column_stack([-arm[:, 1], arm[:, 0], np.ones(len(arm))])
    path_m = step_m + ROTATION_ARM_M * np.abs(np.diff(heading))
    covariance = np.einsum("k,ki,kj->ij", HEADING_WALK_RAD**2 * path_m, by_rotation, by_rotation)
    covariance[:2, :2] += POSITION_WALK_M**2 * path_m.sum() * np.eye(2)
    covariance += np.diag([LEG_FLOOR_M**2, LEG_FLOOR_M**2, LEG_FLOOR_RAD**2])
    return OdometryLeg(
        motion=np.array([local[-1, 0], local[-1, 1], heading[-1]]),
        by_scale=np.array([local[-1, 0], local[-1, 1], 0.0]),
        by_drift=step_m @ by_rotation,
        covariance=covariance,
    )


# ---- least squares


@dataclass(frozen=True)
class _State:
    """Poses (n, 3) of tags, then of arrays, and the systematic errors (d, 2) of the devices."""

    pose: Array
    systematic: Array


class _Graph:
    """Least-squares problem of the drives, with the tags of ``anchors`` fixed.

    Unknowns are the poses of the tags in ascending order of their ids, those of the array at each
    pass, and scale and drift of each device.
    """

    def __init__(
        self, drives: Sequence[SurveyDrive], anchors: Mapping[int, PlanarPose], fix_start: bool
    ) -> None:
        self.drives, self.anchors, self.fix_start = drives, anchors, fix_start
        self.tag_ids = sorted({visit.tag_id for drive in drives for visit in drive.visits})
        self.devices = sorted({drive.device for drive in drives})
        tag_index = {tag_id: k for k, tag_id in enumerate(self.tag_ids)}
        tag_count = len(self.tag_ids)
        visits, visit_from, visit_to, legs, leg_from, leg_to, leg_device = ([] for _ in range(7))
        self.drive_of_leg: list[int] = []
        node = tag_count
        self.start_node: int | None = None
        for number, drive in enumerate(drives):
            steps = list(drive.legs)
            if fix_start and number == 0:
                self.start_node = node
                steps = [drive.start, *steps]
                node += 1
            for visit in drive.visits:
                visits.append(visit)
                visit_from.append(node)
                visit_to.append(tag_index[visit.tag_id])
                node += 1
            first = node - len(drive.visits) - (len(steps) - len(drive.legs))
            for k, leg in enumerate(steps):
                legs.append(leg)
                leg_from.append(first + k)
                leg_to.append(first + k + 1)
                leg_device.append(self.devices.index(drive.device))
                self.drive_of_leg.append(number)
        self.visits, self.legs = visits, legs
        self.count = node
        self.visit_from, self.visit_to = np.array(visit_from), np.array(visit_to)
        self.leg_from, self.leg_to = np.array(leg_from), np.array(leg_to)
        self.leg_device = np.array(leg_device)
        self.size = 3 * node + 2 * len(self.devices)
        fixed = {tag_index[tag_id] for tag_id in anchors if tag_id in tag_index}
        fixed |= {self.start_node} if self.start_node is not None else set()
        connected, floating = self._split(fixed)
        self.connected_tags = {tag_id for tag_id, k in tag_index.items() if k in connected}
        # Each part that nothing connects with the fixed poses has a frame of its own.
        is_free = np.ones((node, 3), bool)
        is_free[sorted(fixed | {min(part) for part in floating})] = False
        self.is_free = np.append(is_free, np.ones(2 * len(self.devices), bool))
        self.visit_pose = np.array([visit.pose for visit in visits])
        self.visit_sigma = np.array([visit.sigma for visit in visits])
        self.motion = np.array([leg.motion for leg in legs])
        self.by_scale = np.array([leg.by_scale for leg in legs])
        self.by_drift = np.array([leg.by_drift for leg in legs])
        self.whitening = np.linalg.inv(
            np.linalg.cholesky(np.array([leg.covariance for leg in legs]))
        )
        self.factor = 1.0
        if self.size > MAX_UNKNOWNS:
            raise InputError(
                f"{len(visits)} passes are too many for one survey",
                hint="Give fewer or shorter drives",
            )

    def _split(self, fixed: set[int]) -> tuple[set[int], list[set[int]]]:
        """Return the poses that are connected with fixed ones, and the other parts."""
        parent = list(range(self.count))

        def root(k: int) -> int:
            while parent[k] != k:
                parent[k] = parent[parent[k]]
                k = parent[k]
            return k

        for one, other in (
            *zip(self.visit_from.tolist(), self.visit_to.tolist(), strict=True),
            *zip(self.leg_from.tolist(), self.leg_to.tolist(), strict=True),
        ):
            parent[root(one)] = root(other)
        groups: dict[int, set[int]] = {}
        for k in range(self.count):
            groups.setdefault(root(k), set()).add(k)
        parts = list(groups.values())
        connected = set[int]().union(*(part for part in parts if part & fixed))
        return connected, [part for part in parts if not part & fixed]

    @property
    def degrees_of_freedom(self) -> int:
        """Number of measurements beyond the unknowns, besides the errors with priors."""
        unknown = int(self.is_free[: 3 * self.count].sum())
        return 3 * (len(self.visits) + len(self.legs)) - unknown

    def initial_state(self) -> _State:
        """Propagate poses from the fixed ones along legs and visits."""
        pose = np.full((self.count, 3), np.nan)
        for k, tag_id in enumerate(self.tag_ids):
            if tag_id in self.anchors:
                anchor = self.anchors[tag_id]
                pose[k] = anchor.x_m, anchor.y_m, anchor.heading_rad
        if self.start_node is not None:
            pose[self.start_node] = 0.0
        edges: list[tuple[int, int, Array]] = [
            *zip(self.visit_from.tolist(), self.visit_to.tolist(), self.visit_pose, strict=True),
            *zip(self.leg_from.tolist(), self.leg_to.tolist(), self.motion, strict=True),
        ]
        neighbours: dict[int, list[tuple[int, Array]]] = {}
        for start, end, motion in edges:
            neighbours.setdefault(start, []).append((end, motion))
            neighbours.setdefault(end, []).append((start, _inverse(motion)))
        queue = [k for k in range(self.count) if np.isfinite(pose[k, 0])]
        for seed in range(self.count + 1):
            while queue:
                k = queue.pop(0)
                for other, motion in neighbours.get(k, ()):
                    if np.isnan(pose[other, 0]):
                        pose[other] = _compose(pose[k], motion)
                        queue.append(other)
            if seed < self.count and np.isnan(pose[seed, 0]):
                pose[seed] = 0.0  # a part that nothing connects with the fixed poses
                queue.append(seed)
        return _State(pose, np.zeros((len(self.devices), 2)))

    def residuals(self, state: _State) -> tuple[Array, Array, Array, Array]:
        """Return whitened residuals (v, 3) and (l, 3) of visits and legs, and their derivatives.

        The derivatives (v, 3, 6) and (l, 3, 8) are by the first pose, the second pose, and the
        systematic errors.
        """
        difference, jacobian = _relative(state.pose[self.visit_from], state.pose[self.visit_to])
        error = difference - self.visit_pose
        error[:, 2] = wrap_angle(error[:, 2])
        visit_residual = error / self.visit_sigma
        visit_jacobian = jacobian / self.visit_sigma[:, :, None]
        difference, jacobian = _relative(state.pose[self.leg_from], state.pose[self.leg_to])
        systematic = state.systematic[self.leg_device]
        error = difference - self.motion
        error -= systematic[:, :1] * self.by_scale + systematic[:, 1:] * self.by_drift
        error[:, 2] = wrap_angle(error[:, 2])
        by_systematic = -np.stack([self.by_scale, self.by_drift], axis=2)
        whitening = self.whitening / math.sqrt(self.factor)
        leg_residual = np.einsum("lij,lj->li", whitening, error)
        leg_jacobian = whitening @ np.concatenate([jacobian, by_systematic], axis=2)
        return visit_residual, leg_residual, visit_jacobian, leg_jacobian

    def linearize(self, state: _State, problems: Indices) -> DenseEquations:
        """Return the normal equations of the free unknowns."""
        visit_residual, leg_residual, visit_jacobian, leg_jacobian = self.residuals(state)
        hessian, gradient = np.zeros((self.size, self.size)), np.zeros(self.size)
        for index, residual, jacobian in (
            (self.visit_columns, visit_residual, visit_jacobian),
            (self.leg_columns, leg_residual, leg_jacobian),
        ):
            blocks = np.einsum("nri,nrj->nij", jacobian, jacobian)
            np.add.at(hessian, (index[:, :, None], index[:, None, :]), blocks)
            np.add.at(gradient, index, np.einsum("nri,nr->ni", jacobian, residual))
        sigma = np.tile([SCALE_SIGMA, DRIFT_SIGMA_RAD_PER_M], len(self.devices))
        systematic = state.systematic.ravel()
        last = np.arange(3 * self.count, self.size)
        hessian[last, last] += sigma**-2.0
        gradient[last] += systematic / sigma**2
        squares = np.sum(visit_residual**2) + np.sum(leg_residual**2)
        cost = 0.5 * (squares + np.sum((systematic / sigma) ** 2))
        free = self.is_free
        residual = np.concatenate([visit_residual.ravel(), leg_residual.ravel()])
        return DenseEquations(
            np.array([cost]),
            gradient[free][None],
            hessian[np.ix_(free, free)][None],
            residual[None],
        )

    @property
    def visit_columns(self) -> NDArray[np.int64]:
        """Unknowns (v, 6) of each visit."""
        return _columns(self.visit_from, self.visit_to)

    @property
    def leg_columns(self) -> NDArray[np.int64]:
        """Unknowns (l, 8) of each leg."""
        systematic = 3 * self.count + 2 * self.leg_device[:, None] + np.arange(2)
        return np.concatenate([_columns(self.leg_from, self.leg_to), systematic], axis=1)

    def retract(self, state: _State, step: Array) -> _State:
        """Return the state after a step (1, p) of the free unknowns."""
        full = np.zeros(self.size)
        full[self.is_free] = step[0]
        return _State(
            state.pose + full[: 3 * self.count].reshape(-1, 3),
            state.systematic + full[3 * self.count :].reshape(-1, 2),
        )


def _columns(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    axes = np.arange(3)
    return np.concatenate([3 * first[:, None] + axes, 3 * second[:, None] + axes], axis=1)


def _compose(pose: Array, motion: Array) -> Array:
    """Return the pose after a motion in its frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array(
        [
            pose[0] + cos * motion[0] - sin * motion[1],
            pose[1] + sin * motion[0] + cos * motion[1],
            pose[2] + motion[2],
        ]
    )


def _inverse(motion: Array) -> Array:
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    x, y = motion[:2]
    return np.array([-cos * x - sin * y, sin * x - cos * y, -motion[2]])


def _relative(first: Array, second: Array) -> tuple[Array, Array]:
    """Return poses (n, 3) relative to others, and their derivatives (n, 3, 6) by both."""
    cos, sin = np.cos(first[:, 2]), np.sin(first[:, 2])
    dx, dy = (second[:, :2] - first[:, :2]).T
    relative = np.column_stack(
        [cos * dx + sin * dy, cos * dy - sin * dx, second[:, 2] - first[:, 2]]
    )
    jacobian = np.zeros((len(first), 3, 6))
    jacobian[:, 0, 3], jacobian[:, 0, 4] = cos, sin
    jacobian[:, 1, 3], jacobian[:, 1, 4] = -sin, cos
    jacobian[:, 2, 5] = 1.0
    jacobian[:, :, :3] = -jacobian[:, :, 3:]
    jacobian[:, 0, 2], jacobian[:, 1, 2] = relative[:, 1], -relative[:, 0]
    return relative, jacobian


@dataclass(frozen=True)
class _Fit:
    """Minimum of a graph.

    Attributes
    ----------
    graph : _Graph
        With the estimated variance factor.
    state : _State
    cost : float
        Half of the sum of squares.
    covariance : (p, p) ndarray
        Of the unknowns; zero for those that are fixed.
    leg_redundancy : float
        Redundancy of the legs.
    """

    graph: _Graph
    state: _State
    cost: float
    covariance: Array
    leg_redundancy: float


def _fit(graph: _Graph, start: _State) -> _Fit:
    """Minimize the cost, and estimate the variance factor of the odometry."""
    state = start
    for _ in range(VARIANCE_ROUNDS):
        minimum = minimize(graph, state, damping=1e-6, min_gain=MIN_GAIN)
        state = minimum.state
        covariance = np.zeros((graph.size, graph.size))
        free = np.ix_(graph.is_free, graph.is_free)
        covariance[free] = np.linalg.inv(minimum.equations.hessian[0])
        _, residual, _, jacobian = graph.residuals(state)
        columns = graph.leg_columns
        blocks = covariance[columns[:, :, None], columns[:, None, :]]
        fitted = float(np.einsum("lri,lij,lrj->", jacobian, blocks, jacobian))
        redundancy = max(residual.size - fitted, 0.0)
        squares = float(np.sum(residual**2)) * graph.factor
        factor = (squares + PRIOR_REDUNDANCY) / (redundancy + PRIOR_REDUNDANCY)
        if abs(factor / graph.factor - 1) < VARIANCE_TOLERANCE:
            break
        graph.factor = factor
    return _Fit(graph, state, float(minimum.equations.cost[0]), covariance, redundancy)


def _least_cost(graph: _Graph, start: _State, factor: float) -> float:
    """Return the least cost for a given variance factor of the odometry."""
    graph.factor = factor
    minimum = minimize(graph, start, damping=1e-6, min_gain=MIN_GAIN)
    return float(minimum.equations.cost[0])


# ---- contradictions


@dataclass(frozen=True)
class _Verdict:
    """Agreement of a drive with the others: logarithm of the probability, and its worst leg."""

    log_probability: float
    worst_leg: str


def _judge(
    drives: Sequence[SurveyDrive],
    number: int,
    anchors: Mapping[int, PlanarPose],
    fix_start: bool,
    fit: _Fit,
) -> _Verdict:
    """Compare one drive with the fit of all others."""
    others = [drive for k, drive in enumerate(drives) if k != number]
    keeps_start = fix_start and number != 0
    graph = _Graph(others, anchors, keeps_start)
    rest = _fit(graph, _restrict(fit, graph))
    rest_cost = _least_cost(graph, rest.state, rest.graph.factor)
    whole = _Graph(drives, anchors, fix_start)
    cost = _least_cost(whole, fit.state, rest.graph.factor)
    freedom = whole.degrees_of_freedom - graph.degrees_of_freedom
    if freedom <= 0:
        return _Verdict(0.0, "")
    increase = max(2 * (cost - rest_cost), 0.0) / freedom
    known = PRIOR_REDUNDANCY + rest.leg_redundancy
    return _Verdict(
        float(stats.f.logsf(increase, freedom, known)), _worst_leg(drives[number], rest)
    )


def _restrict(fit: _Fit, graph: _Graph) -> _State:
    """Return the poses of a fit for the part of its graph that ``graph`` contains."""
    start = graph.initial_state()
    pose = start.pose.copy()
    index = {tag_id: k for k, tag_id in enumerate(fit.graph.tag_ids)}
    names = [drive.name for drive in fit.graph.drives]
    for k, tag_id in enumerate(graph.tag_ids):
        pose[k] = fit.state.pose[index[tag_id]]
    first: dict[str, int] = {}
    node = len(fit.graph.tag_ids)
    for number, drive in enumerate(fit.graph.drives):
        node += fit.graph.start_node is not None and number == 0
        first[names[number]] = node
        node += len(drive.visits)
    node = len(graph.tag_ids)
    for number, drive in enumerate(graph.drives):
        if graph.start_node is not None and number == 0:
            pose[node] = 0.0
            node += 1
        source = first[drive.name]
        pose[node : node + len(drive.visits)] = fit.state.pose[source : source + len(drive.visits)]
        node += len(drive.visits)
    return _State(pose, start.systematic)


def _worst_leg(drive: SurveyDrive, rest: _Fit) -> str:
    """Describe the leg of a drive that disagrees most with the site of the others."""
    index = {tag_id: k for k, tag_id in enumerate(rest.graph.tag_ids)}
    worst, description = 0.0, ""
    for start, end, leg in zip(drive.visits, drive.visits[1:], drive.legs, strict=False):
        if start.tag_id not in index or end.tag_id not in index:
            continue
        from_tag = rest.state.pose[index[start.tag_id]]
        to_tag = rest.state.pose[index[end.tag_id]]
        at_start = _compose(from_tag, _inverse(start.pose))
        at_end = _compose(to_tag, _inverse(end.pose))
        error = _compose(_inverse(at_start), at_end) - leg.motion
        error[2] = wrap_angle(error[2])
        sigmas = float(np.sqrt(error @ np.linalg.solve(leg.covariance, error)))
        if sigmas > worst:
            worst = sigmas
            description = (
                f"most from tag {start.tag_id} at {start.time_s:.1f} s to tag {end.tag_id} at "
                f"{end.time_s:.1f} s, by {1e3 * math.hypot(*error[:2]):.0f} mm and "
                f"{abs(math.degrees(error[2])):.1f} deg"
            )
    return description


def _without_contradictions(
    drives: Sequence[SurveyDrive], anchors: Mapping[int, PlanarPose], fix_start: bool
) -> tuple[list[SurveyDrive], _Fit, dict[str, str]]:
    """Exclude drives that contradict the others, the worst one first."""
    kept, left_out = list(drives), dict[str, str]()
    while True:
        graph = _Graph(kept, anchors, fix_start)
        fit = _fit(graph, graph.initial_state())
        if len(kept) < 2:
            return kept, fit, left_out
        # The start of the first drive may be all that fixes the frame.
        judged = range(1 if fix_start else 0, len(kept))
        verdicts = {k: _judge(kept, k, anchors, fix_start, fit) for k in judged}
        limit = math.log(MAX_CONTRADICTION_PROBABILITY)
        guilty = [k for k in verdicts if verdicts[k].log_probability < limit]
        if not guilty:
            return kept, fit, left_out
        worst = min(guilty, key=lambda k: verdicts[k].log_probability)
        if len(kept) < MIN_JUDGED_DRIVES and len(guilty) != 1:
            raise InputError(
                f"{kept[0].name} and {kept[1].name} contradict each other "
                f"({verdicts[worst].worst_leg})",
                hint="Give a third drive over the same tags, so that the wrong one is known",
            )
        drive = kept.pop(worst)
        left_out[drive.name] = "contradicts the other drives" + (
            f", {verdicts[worst].worst_leg}" if verdicts[worst].worst_leg else ""
        )


# ---- survey


def survey(
    tags: Tags,
    drives: Sequence[SurveyDrive],
    left_out: Mapping[str, str] | None = None,
    *,
    fixed_ids: Sequence[int] = (),
    fix_start: bool = False,
) -> SurveyReport:
    """Estimate the poses of the tags that drives passed.

    Parameters
    ----------
    tags : Tags
        Design; the poses of fixed tags are those of its site.
    drives : sequence of SurveyDrive
    left_out : mapping of str to str, optional
        Drives and passes that could not be used, with the reasons; they are added to the report.
    fixed_ids : sequence of int
        Tags that keep their poses of the site. A single one without a pose is at the origin.
        Without fixed tags and start, the first tag of the first drive is fixed.
    fix_start : bool
        Let the array be at the origin at the start of the first drive, instead of fixing tags.

    Returns
    -------
    SurveyReport

    Raises
    ------
    InputError
        There are no drives, a fixed tag was not passed or has no pose, drives contradict each
        other and it is not known which one is wrong, or passes contradict each other whatever the
        odometry.
    """
    if not drives:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in (left_out or {}).items())
        raise InputError(
            f"no drive can be used ({reasons or 'there is none'})",
            hint="A drive passes two tags or more, with odometry",
        )
    anchors, gauge = _choose_anchors(tags, drives, fixed_ids, fix_start)
    kept, fit, contradictory = _without_contradictions(drives, anchors, fix_start)
    if contradictory:
        anchors, gauge = _choose_anchors(tags, kept, fixed_ids, fix_start)
        graph = _Graph(kept, anchors, fix_start)
        fit = _fit(graph, graph.initial_state())
    reasons_by_name = {**(left_out or {}), **contradictory}
    graph = fit.graph
    ratio = math.sqrt(graph.factor)
    if ratio > MAX_ODOMETRY_RATIO:
        raise InputError(
            "the passes contradict each other, whatever the odometry: "
            f"most those over tag {_worst_tag(fit)}",
            hint="Check that each id is on the floor once, and that the odometry is of this robot",
        )
    connected = graph.connected_tags
    for tag_id in graph.tag_ids:
        if tag_id not in connected:
            reasons_by_name[f"tag {tag_id}"] = "no drive leads from it to a fixed tag"
    surveyed = _surveyed_tags(fit, connected, anchors)
    site = {each.tag_id: each.pose for each in surveyed}
    notes = _notes(surveyed, ratio, kept)
    unvisited = [tag_id for tag_id in tags.site if tag_id not in site]
    site_sigma = {
        each.tag_id: (float(sigma[0]), float(sigma[1]), float(sigma[2]))
        for each in surveyed
        if not each.is_fixed
        for sigma in [np.sqrt(np.diag(each.covariance))]
    }
    if unvisited and _is_in_given_frame(tags, anchors):
        site |= {tag_id: tags.site[tag_id] for tag_id in unvisited}
        site_sigma |= {k: sigma for k, sigma in tags.site_sigma.items() if k in unvisited}
        notes.append(f"{len(unvisited)} tags of the site were not passed and keep their positions")
    elif unvisited:
        notes.append(
            f"{len(unvisited)} tags of the site were not passed and are left out: their positions "
            "are in another frame"
        )
    systematic = fit.state.systematic
    sigma = np.sqrt(np.diag(fit.covariance)[3 * graph.count :]).reshape(-1, 2)
    return SurveyReport(
        tags=replace(
            tags, site=dict(sorted(site.items())), site_sigma=dict(sorted(site_sigma.items()))
        ),
        surveyed=surveyed,
        gauge=gauge,
        drives=len(kept),
        redundancy=float(graph.degrees_of_freedom),
        odometry_ratio=ratio,
        scale=dict(zip(graph.devices, (-systematic[:, 0]).tolist(), strict=True)),
        scale_sigma=dict(zip(graph.devices, sigma[:, 0].tolist(), strict=True)),
        left_out=reasons_by_name,
        notes=tuple(notes),
    )


def _choose_anchors(
    tags: Tags, drives: Sequence[SurveyDrive], fixed_ids: Sequence[int], fix_start: bool
) -> tuple[dict[int, PlanarPose], str]:
    """Return the fixed tags with their poses, and a description of the gauge."""
    passed = {visit.tag_id for drive in drives for visit in drive.visits}
    if fix_start:
        return {}, f"the array is at the origin at the start of {drives[0].name}"
    ids = tuple(dict.fromkeys(fixed_ids)) or (drives[0].visits[0].tag_id,)
    anchors = {}
    for tag_id in ids:
        if tag_id not in passed:
            raise InputError(f"tag {tag_id} was not passed", hint="Fix a tag that was passed")
        pose = tags.site.get(tag_id)
        if pose is None and len(ids) > 1:
            raise InputError(
                f"tag {tag_id} has no pose on the site",
                hint="Add its position with [[site]] to the tags",
            )
        anchors[tag_id] = pose or PlanarPose(0.0, 0.0, 0.0)
    if len(ids) == 1 and ids[0] not in tags.site:
        return anchors, f"tag {ids[0]} is at the origin, with its x along the x of the site"
    shown = ", ".join(map(str, ids))
    return anchors, f"tag{'s' * (len(ids) > 1)} {shown} as on the given site"


def _is_in_given_frame(tags: Tags, anchors: Mapping[int, PlanarPose]) -> bool:
    """Return whether the frame is that of the given site."""
    return any(tag_id in tags.site for tag_id in anchors)


def _surveyed_tags(
    fit: _Fit, connected: set[int], anchors: Mapping[int, PlanarPose]
) -> tuple[SurveyedTag, ...]:
    graph = fit.graph
    passes = Counter(visit.tag_id for visit in graph.visits)
    drives = Counter(
        tag_id for drive in graph.drives for tag_id in {visit.tag_id for visit in drive.visits}
    )
    surveyed = []
    for k, tag_id in enumerate(graph.tag_ids):
        if tag_id not in connected:
            continue
        x, y, heading = fit.state.pose[k].tolist()
        pose = anchors.get(tag_id) or PlanarPose(x, y, float(wrap_angle(heading)))
        rows = slice(3 * k, 3 * k + 3)
        covariance = fit.covariance[rows, rows]
        counts = passes[tag_id], drives[tag_id]
        surveyed.append(SurveyedTag(tag_id, pose, covariance, *counts, tag_id in anchors))
    return tuple(surveyed)


def _worst_tag(fit: _Fit) -> int:
    """Return the tag whose neighbouring legs have the largest residuals."""
    _, residual, _, _ = fit.graph.residuals(fit.state)
    tag_of_node = dict(zip(fit.graph.visit_from.tolist(), fit.graph.visits, strict=True))
    squares: defaultdict[int, float] = defaultdict(float)
    for start, end, each in zip(
        fit.graph.leg_from.tolist(), fit.graph.leg_to.tolist(), residual, strict=True
    ):
        for node in (start, end):
            if node in tag_of_node:
                squares[tag_of_node[node].tag_id] += float(each @ each)
    return max(squares, key=lambda tag_id: squares[tag_id])


def _notes(surveyed: Sequence[SurveyedTag], ratio: float, kept: Sequence[SurveyDrive]) -> list[str]:
    notes = []
    single = [each.tag_id for each in surveyed if each.passes == 1 and not each.is_fixed]
    if single:
        shown = ", ".join(map(str, single[:5])) + (", ..." if len(single) > 5 else "")
        notes.append(f"passed only once, so that nothing checks their positions: {shown}")
    if ratio > REPORTED_ODOMETRY_RATIO:
        notes.append(
            f"the odometry deviates {ratio:.1f} times as much as usual "
            f"({math.degrees(HEADING_WALK_RAD):g} deg after a metre); covariances contain this"
        )
    if len(kept) < MIN_JUDGED_DRIVES:
        notes.append(
            f"{len(kept)} drive{'s' * (len(kept) > 1)}: with three or more, one that contradicts "
            "the others is excluded"
        )
    return notes
