"""All visits, the odometry between them and the landmarks themselves, in one least squares.

Unknowns: for each robot its sensors' gains and offsets, their height, and what is constantly
wrong with its odometry; for each landmark its place, the strengths of its bars and their
places; for each visit the robot's pose, and the random walk of its odometry. Rows: the field
of every visit, the odometry between visits, and priors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.fit import POSE, Priors, Problem
from locatk.core.landmarks.detection.trace import Drift, Trace, bent, compose, corrections, relative
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import Cell

Array = NDArray[np.float64]
Solve = Callable[[Array], Array]

SYSTEMATIC = 3
"""Leading columns of a trace's correction, which are the same all through a recording."""

STEPS = 6

CONVERGED_M = 1e-6

FINEST = np.array([1e-5, 1e-5, 1e-5])
"""Standard deviations (m, m, rad) that odometry between two visits has at least."""


@dataclass(frozen=True)
class Stay:
    """A visit of which the landmark is known.

    Attributes
    ----------
    trace : Trace
    cell : (row, column)
    pose : (3,) ndarray
        Robot at the trace's reference, in the map's frame: the start of the descent.
    """

    trace: Trace
    cell: Cell
    pose: Array


@dataclass(frozen=True)
class Link:
    """Odometry from the last bin of a stay to the first bin of the next one.

    Attributes
    ----------
    pose : (n, 3) ndarray
        Along the way, as seen from its begin.
    correction : (n, 3, m) ndarray
        As of :class:`.trace.Trace`.
    drift : Drift
        In whose standard deviations it is.
    """

    pose: Array
    correction: Array
    drift: Drift


@dataclass(frozen=True)
class Run:
    """One robot's recording: its stays in order of time, and the links between them."""

    stays: Sequence[Stay]
    links: Sequence[Link]


@dataclass(frozen=True)
class Mark:
    """A landmark before the recordings are seen.

    Attributes
    ----------
    pose : (3,) ndarray
        In the map's frame: x, y, heading.
    sigma : (3,) ndarray
        How well that is known.
    strength, strength_sigma : (4,) ndarray
        Of the bars, in units of the nominal one, signed.
    """

    pose: Array
    sigma: Array
    strength: Array
    strength_sigma: Array


@dataclass(frozen=True)
class StayPose:
    """What was found for one stay.

    Attributes
    ----------
    pose : (3,) ndarray
        Robot at the trace's reference, in the map's frame.
    wrong : (m,) ndarray
        Of the trace's corrections.
    covariance : (3 + m, 3 + m) ndarray
        Of the pose and of ``wrong``.
    """

    pose: Array
    wrong: Array
    covariance: Array


@dataclass(frozen=True)
class MarkFound:
    """A landmark as it lies.

    Attributes
    ----------
    pose : (3,) ndarray
    strength : (4,) ndarray
    covariance : (7, 7) ndarray
        Of both.
    """

    pose: Array
    strength: Array
    covariance: Array


@dataclass(frozen=True)
class Smoothed:
    """The answer of :func:`smooth`.

    Attributes
    ----------
    stays : list of list of StayPose
        By run.
    marks : dict of cell to MarkFound
    misfit : float
        Rms of the rows of the fields, in standard deviations. Where it is above 1 the
        covariances are larger by its square.
    """

    stays: list[list[StayPose]]
    marks: dict[Cell, MarkFound]
    misfit: float


def link(pose: Array, priors: Priors) -> Link:
    """The link along odometry's poses (n, 3), both ends included."""
    local = relative(pose, pose[0])
    return Link(local, corrections(local, 0, priors.drift), priors.drift)


def smooth(
    runs: Sequence[Run], marks: Mapping[Cell, Mark], geometry: Geometry, priors: Priors
) -> Smoothed:
    """Poses of all stays and landmarks from all that was measured.

    Parameters
    ----------
    runs : sequence of Run
    marks : mapping of cell to Mark
        Every cell of the runs.
    geometry : Geometry
    priors : Priors

    Returns
    -------
    Smoothed
    """
    system = _System(runs, marks, geometry, priors)
    state = system.start()
    for _ in range(STEPS):
        matrix, gradient, misfit = system.normal(state)
        solved = _factored(matrix)
        step = solved.solve(gradient)
        state = state - step
        if np.abs(step[system.metres]).max() < CONVERGED_M:
            break
    matrix, _, misfit = system.normal(state)
    solved = _factored(matrix)
    return system.told(state, solved.solve, misfit)


def _factored(matrix: Any) -> Any:
    """Factors of a symmetric positive matrix: much of it stays sparse in this order."""
    from scipy.sparse.linalg import splu

    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


class _System:
    """Where each unknown stands in one long vector, and the normal equations of it."""

    def __init__(
        self,
        runs: Sequence[Run],
        marks: Mapping[Cell, Mark],
        geometry: Geometry,
        priors: Priors,
    ) -> None:
        self.runs, self.geometry, self.priors = runs, geometry, priors
        visited = {stay.cell for run in runs for stay in run.stays}
        self.marks = {cell: marks[cell] for cell in sorted(visited)}
        self.size = 0
        self.robots: list[NDArray[np.intp]] = []
        self.stays: list[list[NDArray[np.intp]]] = []
        self.landmarks: dict[Cell, NDArray[np.intp]] = {}
        for run in runs:
            sensors = len(run.stays[0].trace.lever_m)
            self.robots.append(self._take(2 * sensors + 1 + SYSTEMATIC))
            self.stays.append(
                [
                    self._take(POSE + stay.trace.correction.shape[2] - SYSTEMATIC)
                    for stay in run.stays
                ]
            )
        for cell in self.marks:
            self.landmarks[cell] = self._take(POSE + 4 + 8)
        poses = [place[:POSE] for run in self.stays for place in run]
        self.metres = np.concatenate([place[:2] for place in poses])
        # Poses have no prior; all else is in standard deviations of its own.
        self.prior = np.ones(self.size)
        self.prior[np.concatenate(poses)] = 0.0

    def _take(self, count: int) -> NDArray[np.intp]:
        self.size += count
        return np.arange(self.size - count, self.size)

    def start(self) -> Array:
        state = np.zeros(self.size)
        for run, places in zip(self.runs, self.stays, strict=True):
            for stay, place in zip(run.stays, places, strict=True):
                state[place[:POSE]] = stay.pose
        return state

    def normal(self, state: Array) -> tuple[Any, Array, float]:
        """Normal matrix (sparse), gradient, and the rms of the fields' rows."""
        from scipy.sparse import coo_array

        rows, columns, values = [], [], []
        gradient = self.prior * state
        squares, count = 0.0, 0

        def add(place: NDArray[np.intp], slope: Array, residual: Array) -> None:
            gradient[place] += slope.T @ residual
            rows.append(np.repeat(place, len(place)))
            columns.append(np.tile(place, len(place)))
            values.append((slope.T @ slope).ravel())

        for number, run in enumerate(self.runs):
            for k, stay in enumerate(run.stays):
                place, slope, residual = self._field(state, number, k)
                add(place, slope, residual)
                squares += float(residual @ residual)
                count += int((~np.isnan(stay.trace.value_t)).sum())
            for k, joint in enumerate(run.links):
                add(*self._link(state, number, k, joint))
        every = np.arange(self.size)
        matrix = coo_array(
            (
                np.concatenate([*values, self.prior]),
                (np.concatenate([*rows, every]), np.concatenate([*columns, every])),
            ),
            shape=(self.size, self.size),
        )
        return matrix, gradient, math.sqrt(squares / max(count, 1))

    def _mark(self, state: Array, cell: Cell) -> Array:
        mark = self.marks[cell]
        return mark.pose + mark.sigma * state[self.landmarks[cell][:POSE]]

    def _field(self, state: Array, number: int, k: int) -> tuple[NDArray[np.intp], Array, Array]:
        """Rows of one visit: which unknowns they have, derivatives and residuals."""
        stay = self.runs[number].stays[k]
        robot, own, laid = self.robots[number], self.stays[number][k], self.landmarks[stay.cell]
        mark = self.marks[stay.cell]
        problem = Problem(
            stay.trace, self.geometry, self.priors, mark.strength[None], mark.strength_sigma[None]
        )
        pose, at = state[own[:POSE]], self._mark(state, stay.cell)
        seen, by_pose, by_mark = _seen_from(pose, at)
        sensors = 2 * len(stay.trace.lever_m)
        parameters = np.concatenate(
            [
                seen,
                state[robot[:sensors]],
                state[laid[POSE:]],
                state[robot[sensors:]],
                state[own[POSE:]],
            ]
        )
        residual, slope = problem.residuals(parameters[None], jacobian=True)
        slope = slope[0]
        edges = np.cumsum([POSE, sensors, 12, 1 + SYSTEMATIC])
        marked, tuned, bars, driven, walked = np.split(slope, edges, axis=1)
        place = np.concatenate(
            [own[:POSE], laid[:POSE], robot[:sensors], laid[POSE:], robot[sensors:], own[POSE:]]
        )
        whole = np.hstack(
            [marked @ by_pose, marked @ (by_mark * mark.sigma), tuned, bars, driven, walked]
        )
        return place, whole, residual[0]

    def _link(
        self, state: Array, number: int, k: int, joint: Link
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Rows of the odometry between two visits."""
        run, robot = self.runs[number], self.robots[number][-SYSTEMATIC:]
        ends = []
        for stay, own, at in (
            (run.stays[k], self.stays[number][k], -1),
            (run.stays[k + 1], self.stays[number][k + 1], 0),
        ):
            ends.append((own, *_bin_pose(stay.trace, at, state[own], state[robot])))
        (own, left, left_slope), (other, reached, reached_slope) = ends
        seen, by_left, by_reached = _seen_from(left, reached)
        steady, walk = np.split(joint.correction[-1], [SYSTEMATIC], axis=1)
        # A long way bends too much for first order.
        residual = seen - bent(joint.pose, state[robot], joint.drift)[-1]
        residual[2] = math.remainder(residual[2], math.tau)
        count = len(own) + SYSTEMATIC
        slope = np.hstack([by_left @ left_slope, by_reached @ reached_slope])
        # Both ends hang on the same constant errors: their columns come together.
        common = slope[:, len(own) : count] + slope[:, count + len(other) :] - steady
        slope = np.hstack([slope[:, : len(own)], slope[:, count : count + len(other)], common])
        white = np.linalg.inv(np.linalg.cholesky(walk @ walk.T + np.diag(FINEST**2)))
        return np.concatenate([own, other, robot]), white @ slope, white @ residual

    def told(self, state: Array, solve: Solve, misfit: float) -> Smoothed:
        """The answer: values of the unknowns, with the covariances that are asked for."""
        found = []
        for number in range(len(self.runs)):
            steady = self.robots[number][-SYSTEMATIC:]
            here = []
            for own in self.stays[number]:
                place = np.concatenate([own[:POSE], steady, own[POSE:]])
                here.append(
                    StayPose(
                        state[own[:POSE]],
                        state[place[POSE:]],
                        self._covariance(place, solve, misfit),
                    )
                )
            found.append(here)
        marks = {}
        for cell, mark in self.marks.items():
            place = self.landmarks[cell][: POSE + 4]
            unit = np.concatenate([mark.sigma, mark.strength_sigma])
            marks[cell] = MarkFound(
                self._mark(state, cell),
                mark.strength + mark.strength_sigma * state[place[POSE:]],
                unit[:, None] * self._covariance(place, solve, misfit) * unit,
            )
        return Smoothed(found, marks, misfit)

    def _covariance(self, place: NDArray[np.intp], solve: Solve, misfit: float) -> Array:
        right = np.zeros((self.size, len(place)))
        right[place, np.arange(len(place))] = 1
        return np.asarray(solve(right)[place]) * max(1.0, misfit) ** 2


def _seen_from(pose: Array, mark: Array) -> tuple[Array, Array, Array]:
    """What is at ``mark`` as seen from ``pose``, with derivatives (3, 3) by pose and mark."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    back = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    seen = back @ (mark - pose)
    by_pose = -back
    by_pose[:2, 2] = seen[1], -seen[0]
    return seen, by_pose, back


def _bin_pose(trace: Trace, at: int, own: Array, steady: Array) -> tuple[Array, Array]:
    """Robot in the map's frame at one bin, and its derivatives (3, own + SYSTEMATIC) by the
    stay's own unknowns and by the constant errors of odometry."""
    pose, wrong = own[:POSE], np.concatenate([steady, own[POSE:]])
    correction = trace.correction[at]
    local = trace.pose[at] + correction @ wrong
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    by_pose = np.eye(3)
    by_pose[:2, 2] = -sin * local[0] - cos * local[1], cos * local[0] - sin * local[1]
    by_wrong = turn @ correction
    slope = np.hstack([by_pose, by_wrong[:, SYSTEMATIC:], by_wrong[:, :SYSTEMATIC]])
    return compose(pose, local), slope
