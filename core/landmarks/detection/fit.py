"""The full field fitted to one visit: from many starts, each with all that can be wrong."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks import field as bars
from locatk.core.landmarks.detection.trace import Drift, Trace
from locatk.core.landmarks.landmark import Geometry

Array = NDArray[np.float64]

POSE = 3
"""Leading parameters: the landmark's x, y and heading in the frame of the trace."""

STEPS = 30

CONVERGED = 1e-3
"""Change of the cost at which a descent ends."""


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what is not known of sensors, bars and odometry.

    Attributes
    ----------
    gain : float
        Of each sensor.
    offset_t : float
        Of each sensor, the Earth's field included.
    strength : float
        Of each bar, in units of the nominal one.
    place_m : float
        Of each bar in x and in y.
    height_m : float
        Of the sensors over the bars, common to all.
    noise_t : float
        Of a sample.
    faulty : float
        Probability that a given bar is weak or missing.
    floor_t, model : float
        What the model itself leaves, and the same in units of the field.
    drift : Drift
    """

    gain: float = 0.03
    offset_t: float = 1e-4
    strength: float = 0.04
    place_m: float = 0.5e-3
    height_m: float = 0.5e-3
    noise_t: float = 1.5e-4
    faulty: float = 0.01
    floor_t: float = 1.5e-4
    model: float = 0.005
    drift: Drift = field(default_factory=Drift)


@dataclass(frozen=True)
class Problem:
    """A trace, and the landmark under it.

    Parameters of a hypothesis, in this order: x, y, heading of the landmark; then in
    standard deviations of their priors the gains and offsets (N each), the strengths (4),
    the places of the bars (8: x of all, y of all), the height, and the trace's corrections.

    Attributes
    ----------
    strength : (K, 4) ndarray
        Expected signed strengths of the bars, hypothesis by hypothesis.
    strength_sigma : (K, 4) ndarray
    """

    trace: Trace
    geometry: Geometry
    priors: Priors
    strength: Array
    strength_sigma: Array

    @property
    def size(self) -> int:
        """Number of parameters."""
        return POSE + 2 * len(self.trace.lever_m) + 13 + self.trace.correction.shape[2]

    def start(self, pose: Array) -> Array:
        """(K, size) parameters at landmark poses (K, 3), all else as expected."""
        start = np.zeros((len(pose), self.size))
        start[:, :POSE] = pose
        return start

    def chosen(self, which: NDArray[np.intp]) -> Problem:
        """The same of some of the hypotheses."""
        return replace(
            self, strength=self.strength[which], strength_sigma=self.strength_sigma[which]
        )

    def residuals(self, parameters: Array, *, jacobian: bool) -> tuple[Array, Array]:
        """Whitened residuals (K, rows), and their derivatives (K, rows, size).

        Rows are the samples of all sensors; where there is none, residual and derivatives
        are 0. The priors' own rows, which are the parameters from the fourth on, are not
        among them.
        """
        trace, priors = self.trace, self.priors
        count, sensors = trace.value_t.shape
        hypotheses = len(parameters)
        gain, offset, strength, place, height, wrong = self._parts(parameters)
        pose = trace.pose + np.einsum("nim,km->kni", trace.correction, wrong)
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        lever = trace.lever_m
        arm_x = cos[..., None] * lever[:, 0] - sin[..., None] * lever[:, 1]
        arm_y = sin[..., None] * lever[:, 0] + cos[..., None] * lever[:, 1]
        x = pose[..., 0, None] + arm_x - parameters[:, 0, None, None]
        y = pose[..., 1, None] + arm_y - parameters[:, 1, None, None]
        turn = parameters[:, 2, None, None]
        c, s = np.cos(turn), np.sin(turn)
        own = np.stack([c * x + s * y, c * y - s * x], -1)
        at = self.geometry.sensor_height_m + priors.height_m * height
        # A bar that lies off its place is met as if the sensor were off: to first order.
        unit, slope = bars.basis_gradient(self.geometry, own, at[:, None, None])
        push = priors.place_m * place
        moved = (
            unit - slope[..., 0] * push[:, None, None, 0] - slope[..., 1] * push[:, None, None, 1]
        )
        total = np.einsum("knsb,kb->kns", moved, strength)
        seen = ~np.isnan(trace.value_t)
        value = np.where(seen, trace.value_t, 0.0)
        variance = priors.noise_t**2 / trace.weight[:, None] + priors.floor_t**2
        variance = variance + (priors.model * value) ** 2
        root = np.where(seen, np.sqrt(trace.share / variance), 0.0)
        g = 1 + priors.gain * gain[:, None]
        model = g * total + priors.offset_t * offset[:, None]
        residual = (root * (model - value)).reshape(hypotheses, -1)
        if not jacobian:
            return residual, np.empty(0)
        out = np.zeros((hypotheses, count, sensors, self.size))
        # Derivatives by the sensor's place in the landmark's frame, then in the trace's.
        dx, dy, dz = np.moveaxis(np.einsum("knsbi,kb->iknsb", slope, strength).sum(-1), 0, 0)
        fx, fy = c * dx - s * dy, s * dx + c * dy
        out[..., 0] = -g * fx
        out[..., 1] = -g * fy
        out[..., 2] = g * (dx * own[..., 1] - dy * own[..., 0])
        one = np.eye(sensors)
        k = POSE
        out[..., k : k + sensors] = priors.gain * total[..., None] * one
        k += sensors
        out[..., k : k + sensors] = priors.offset_t * one
        k += sensors
        out[..., k : k + 4] = g[..., None] * moved * self.strength_sigma[:, None, None]
        k += 4
        pushed = -priors.place_m * strength[:, None, None]
        out[..., k : k + 4] = g[..., None] * pushed * slope[..., 0]
        k += 4
        out[..., k : k + 4] = g[..., None] * pushed * slope[..., 1]
        k += 4
        out[..., k] = g * priors.height_m * dz
        k += 1
        by_pose = g[..., None] * np.stack([fx, fy, fy * arm_x - fx * arm_y], -1)
        out[..., k:] = np.einsum("knsi,nim->knsm", by_pose, trace.correction)
        out *= root[..., None]
        return residual, out.reshape(hypotheses, -1, self.size)

    def _parts(self, parameters: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Gains, offsets, strengths (signed), places (K, 2, 4), height, corrections."""
        sensors = len(self.trace.lever_m)
        edges = np.cumsum([POSE, sensors, sensors, 4, 8, 1])
        gain, offset, strength, place, height, wrong = (
            parameters[:, a:b] for a, b in zip(edges, [*edges[1:], self.size], strict=True)
        )
        signed = self.strength + self.strength_sigma * strength
        return gain, offset, signed, place.reshape(-1, 2, 4), height[:, 0], wrong


@dataclass(frozen=True)
class Fitted:
    """Ends of the descents, hypothesis by hypothesis.

    Attributes
    ----------
    parameters : (K, size) ndarray
    cost : (K,) ndarray
        Half the sum of squares, priors included.
    information : (K, size, size) ndarray
    """

    parameters: Array
    cost: Array
    information: Array

    def evidence(self) -> Array:
        """(K,) logarithm of each hypothesis' probability by Laplace's approximation, but
        for a constant that is common to all."""
        return -self.cost - np.linalg.slogdet(self.information)[1] / 2

    def chosen(self, which: NDArray[np.intp]) -> Fitted:
        """The same of some of the hypotheses."""
        return Fitted(self.parameters[which], self.cost[which], self.information[which])


def descend(problem: Problem, start: Array, steps: int = STEPS) -> Fitted:
    """Levenberg-Marquardt from each start (K, size), all at once."""
    prior = np.ones(problem.size)  # of a metre and a radian for the pose: as good as none
    pull = np.where(np.arange(problem.size) < POSE, 0.0, 1.0)
    now = start.copy()
    residual, slope = problem.residuals(now, jacobian=True)
    cost = _cost(residual, now)
    matrix = slope.swapaxes(1, 2) @ slope + np.diag(prior)
    gradient = np.einsum("krp,kr->kp", slope, residual) + pull * now
    damping = np.full(len(now), 1e-3)
    running = np.ones(len(now), bool)
    diagonal = np.arange(problem.size)
    for _ in range(steps):
        which = np.flatnonzero(running)
        if not len(which):
            break
        part = problem.chosen(which)
        damped = matrix[which]
        damped[:, diagonal, diagonal] *= 1 + damping[which, None]
        step = np.linalg.solve(damped, gradient[which][..., None])[..., 0]
        trial = now[which] - step
        trial_residual, trial_slope = part.residuals(trial, jacobian=True)
        trial_cost = _cost(trial_residual, trial)
        better = trial_cost < cost[which]
        gained = np.where(better, cost[which] - trial_cost, np.inf)
        damping[which] = np.where(better, damping[which] / 5, damping[which] * 8)
        taken = which[better]
        now[taken], cost[taken] = trial[better], trial_cost[better]
        fresh = trial_slope[better]
        matrix[taken] = fresh.swapaxes(1, 2) @ fresh + np.diag(prior)
        gradient[taken] = (
            np.einsum("krp,kr->kp", fresh, trial_residual[better]) + pull * trial[better]
        )
        running[which] = (gained > CONVERGED) & (damping[which] < 1e6)
    return Fitted(now, cost, matrix)


def _cost(residual: Array, parameters: Array) -> Array:
    nuisance = parameters[:, POSE:]
    return (
        np.einsum("kr,kr->k", residual, residual) + np.einsum("kp,kp->k", nuisance, nuisance)
    ) / 2
