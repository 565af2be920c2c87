"""Maximum likelihood of one pass: magnets, height and the way of the array, all at once.

The samples of a pass are the fields of a few magnets, seen from an array that moves
along its x by a free step a sample, on a background of its own for each sensor and axis.
Moments and backgrounds enter linearly and are solved for whenever the rest is tried
(variable projection, Golub and Pereyra 1973); the steps are eliminated through their
tridiagonal block before the rest is solved for, so that an iteration costs little more
than one evaluation of the field.

What is known beforehand enters as priors: a step is about as long as the others unless
samples were lost (a Cauchy distribution: the published recordings step by 2.1 mm, and by
9 mm where the host was busy), magnets lie flat, the array is about level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solveh_banded

from locatk.core.errors import DegenerateError
from locatk.core.polaris.dipoles import Offsets

Array = NDArray[np.float64]

ROBUST_FREEDOM = 4.0
"""Degrees of freedom of Student's t by which samples are weighted once the fit stands."""

FREE, FIXED = 1e-18, 1e18


@dataclass(frozen=True)
class Window:
    """The samples of one pass.

    Attributes
    ----------
    field_t : (n, N, 3) ndarray
        Tesla; ``nan`` where missing.
    sensors_m : (N, 3) ndarray
        In the array's frame.
    noise_t : (N, 3) ndarray
    frames : (n,) ndarray
        Times in sample periods, ascending; their gaps are lost samples.
    order : (3,) ndarray
        When each axis is converted: -1, 0 and 1 for first to last, or zeros.
    common_t : float
        Standard deviation of a field that all sensors share in a sample (motors).
    path_m : (n,) ndarray or None
        How far the array has moved, where that is known.
    thickness_m2 : float
        Of the magnets (:func:`locatk.core.polaris.dipoles.thickness`).
    """

    field_t: Array
    sensors_m: Array
    noise_t: Array
    frames: Array
    order: Array
    common_t: float = 0.0
    path_m: Array | None = None
    thickness_m2: float = 0.0


@dataclass(frozen=True)
class Priors:
    """What is known before the samples are looked at; pairs are (mean, standard deviation).

    Attributes
    ----------
    height_m, skew : (float, float)
        Of the sensors over the magnets; between two axes' conversions, in sample periods.
    moment_am2 : float
        Size that is expected of a magnet.
    tilt : float
        By how much of its moment a magnet may point up.
    crab_rad, lean_rad : float
        Between the array's x and its way; of the array's pitch and roll.
    jitter : float
        Half width of a step's deviation, as a share of the mean step.
    """

    height_m: tuple[float, float] = (0.01, 0.003)
    skew: tuple[float, float] = (0.0, 0.5)
    moment_am2: float = 1.5e-3
    tilt: float = 0.05
    crab_rad: float = 0.009
    lean_rad: float = 0.05
    jitter: float = 0.3


@dataclass(frozen=True)
class State:
    """One hypothesis of a pass.

    Attributes
    ----------
    place_m : (M, 2) ndarray
    moment_am2 : (M, 3) ndarray
    path_m : (n,) ndarray
    speed_m : float
        Mean step of a sample period.
    height_m, skew, crab_rad, pitch_rad, roll_rad : float
        See :class:`Priors`.
    """

    place_m: Array
    moment_am2: Array
    path_m: Array
    speed_m: float
    height_m: float
    skew: float = 0.0
    crab_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0


@dataclass(frozen=True)
class Fitted:
    """The best of the hypotheses near a start.

    Attributes
    ----------
    state : State
    residual : (n, N, 3) ndarray
        In standard deviations of the noise; ``nan`` where there is no sample.
    cost : float
        Weighted squares and priors.
    sigma : float
        Rms of the residual over the degrees of freedom.
    covariance : (3 M, 3 M) ndarray
        Of x, y and angle of each magnet, in m and rad, with the noise as stated.
    path_sigma_m : (n,) ndarray
        Of the path against its middle, with the noise as stated; 0 where it was known.
    height_sigma_m : float
    converged : bool
    """

    state: State
    residual: Array
    cost: float
    sigma: float
    covariance: Array
    path_sigma_m: Array
    height_sigma_m: float
    converged: bool


_GLOBALS = ("height_m", "skew", "crab_rad", "pitch_rad", "roll_rad")


class _Problem:
    """A window and its priors, with what stays the same from step to step."""

    def __init__(self, window: Window, priors: Priors, weight: Array, ref: int) -> None:
        self.window, self.priors, self.ref = window, priors, ref
        n, sensors, _ = window.field_t.shape
        self.shape = (n, 3 * sensors)
        self.root = np.sqrt(weight)
        self.data = np.nan_to_num(window.field_t)
        # A field that all sensors share has covariance tau^2 u u^T beside the unit noise.
        square = (self.root**2).sum(axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            shrink = (1 - 1 / np.sqrt(1 + window.common_t**2 * square)) / square
        self.shrink = np.nan_to_num(shrink) if window.common_t else None
        time = window.frames - window.frames.mean()
        trend = np.stack([np.ones(n), time / max(np.ptp(time) / 2, 1.0)], axis=1)
        columns = np.zeros((n, sensors, 3, 3 * sensors * 2))
        channel = np.arange(3 * sensors).reshape(sensors, 3)
        for power in range(2):
            at = 2 * channel + power
            columns[:, np.arange(sensors)[:, None], np.arange(3), at] = trend[:, power, None, None]
        self.background = self.whiten(columns).reshape(-1, columns.shape[-1])
        gram = self.background.T @ self.background
        # Channels that gave nothing have no background to find.
        gram[np.diag_indices(len(gram))] += 1e-9 * np.max(np.diag(gram))
        self.background_gram = gram
        self.background_factor = cho_factor(gram, check_finite=False)
        self.spans = np.diff(window.frames)
        self.target = self.whiten(self.data[..., None]).reshape(-1)

    def whiten(self, rows: Array) -> Array:
        """Rows (n, N, 3, k) in units of their noise, without what all sensors share."""
        scaled = rows * self.root[..., None]
        if self.shrink is not None:
            mean = (scaled * self.root[..., None]).sum(axis=1, keepdims=True)
            scaled -= (self.root * self.shrink)[..., None] * mean
        return scaled

    # ---- the model

    def offsets(self, state: State) -> Offsets:
        window = self.window
        along = state.path_m + window.order[:, None] * state.skew * self.pace(state)
        sensors = window.sensors_m
        return Offsets.of(
            along[:, :, None, None] + sensors[:, None, 0] - state.place_m[:, 0],
            sensors[:, None, 1]
            + np.tan(state.crab_rad) * state.path_m[:, None, None]
            - state.place_m[:, 1],
            state.height_m,
        )

    def pace(self, state: State) -> Array:
        """Step (n,) of a sample period around each sample, without its jitter."""
        if len(state.path_m) < 3:
            return np.full(len(state.path_m), state.speed_m)
        steps = np.diff(state.path_m) / self.spans
        padded = np.concatenate([steps[:1], steps[:1], steps, steps[-1:], steps[-1:]])
        return np.median(np.lib.stride_tricks.sliding_window_view(padded, 4), axis=1)

    def lean(self, state: State, fields: Array) -> Array:
        """Fields (3, ...) as the axes of an array see them that is pitched and rolled."""
        x, y, z = fields
        pitch, roll = state.pitch_rad, state.roll_rad
        return np.stack([x + pitch * z, y - roll * z, z - pitch * x + roll * y])

    def project(self, state: State) -> _Trial:
        """The best moments and backgrounds for the rest of ``state``."""
        n, channels = self.shape
        offsets = self.offsets(state)
        units = self.lean(state, offsets.unit_fields(self.window.thickness_m2))
        m = units.shape[-1]
        # (axis of field, axis of moment, n, N, M) to (n, N, axis of field, M x axis of moment)
        rows = units.transpose(2, 3, 0, 4, 1).reshape(n, channels // 3, 3, 3 * m)
        moments = self.whiten(rows).reshape(-1, 3 * m)
        cross = moments.T @ self.background
        solved = cho_solve(
            self.background_factor,
            np.column_stack([cross.T, self.background.T @ self.target]),
            check_finite=False,
        )
        gram = moments.T @ moments - cross @ solved[:, :-1]
        gram[np.diag_indices(3 * m)] += self.moment_weights(m)
        side = moments.T @ self.target - cross @ solved[:, -1]
        best = np.linalg.solve(gram, side)
        level = solved[:, -1] - solved[:, :-1] @ best
        residual = self.target - moments @ best - self.background @ level
        state = replace(state, moment_am2=best.reshape(m, 3))
        cost = residual @ residual + self.moment_weights(m) @ best**2 + self.prior_cost(state)
        return _Trial(state, offsets, rows, moments, cross, residual, float(cost))

    def moment_weights(self, m: int) -> Array:
        size = self.priors.moment_am2
        return np.tile(1 / np.array([3 * size, 3 * size, self.priors.tilt * size]) ** 2, m)

    def spread(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation that the priors give a global parameter."""
        priors = self.priors
        if name == "height_m":
            return priors.height_m
        if name == "skew":
            return priors.skew if np.any(self.window.order) else (0.0, 1e-9)
        return (0.0, priors.crab_rad if name == "crab_rad" else priors.lean_rad)

    def prior_cost(self, state: State) -> float:
        cost = 0.0
        for name in _GLOBALS:
            mean, sigma = self.spread(name)
            cost += ((getattr(state, name) - mean) / sigma) ** 2
        if self.window.path_m is None:
            excess, scale = self.excess(state)
            cost += 2 * float(np.log1p(excess**2 / scale**2).sum())
        return cost

    def excess(self, state: State) -> tuple[Array, Array]:
        """By how much each step differs from the mean one, and the half width of that."""
        excess = np.diff(state.path_m) - state.speed_m * self.spans
        return excess, self.jitter * np.sqrt(self.spans)

    jitter: float = 1e-3

    # ---- one step of Gauss and Newton

    def normal(self, trial: _Trial) -> _Normal:
        """Normal equations around a trial, the path eliminated."""
        n, channels = self.shape
        state = trial.state
        m = len(state.place_m)
        gradients = self.lean(state, trial.offsets.gradients(state.moment_am2))
        gradients = gradients.transpose(2, 3, 0, 4, 1)  # n, N, axis, magnet, component
        total = gradients.sum(axis=3)
        fields = (trial.rows @ state.moment_am2.ravel()).transpose(2, 0, 1)
        pace = self.pace(state)[:, None, None]
        tangent = np.tan(state.crab_rad)
        zero = np.zeros_like(fields[0])
        columns = np.concatenate(
            [
                -gradients[..., 0],
                -gradients[..., 1],
                total[..., 2:],
                (total[..., 0] * self.window.order * pace)[..., None],
                (total[..., 1] * state.path_m[:, None, None] * (1 + tangent**2))[..., None],
                np.stack([fields[2], zero, -fields[0]], axis=-1)[..., None],
                np.stack([zero, -fields[2], fields[1]], axis=-1)[..., None],
                (total[..., 0] + tangent * total[..., 1])[..., None],
            ],
            axis=-1,
        )
        white = self.whiten(columns).reshape(n * channels, -1)
        rest, along = white[:, :-1], white[:, -1].reshape(n, channels)
        # Order: places and globals, moments, the mean step, backgrounds.
        p = rest.shape[1]
        inner = np.hstack([rest, trial.moments])
        q = inner.shape[1]
        size = q + 1 + self.background.shape[1]
        gram, side = np.zeros((size, size)), np.zeros(size)
        gram[:q, :q] = inner.T @ inner
        cross = np.vstack([rest.T @ self.background, trial.cross])
        gram[:q, q + 1 :], gram[q + 1 :, :q] = cross, cross.T
        gram[q + 1 :, q + 1 :] = self.background_gram
        side[:q] = inner.T @ trial.residual
        side[q + 1 :] = self.background.T @ trial.residual
        for place, name in enumerate(_GLOBALS, 2 * m):
            mean, sigma = self.spread(name)
            gram[place, place] += 1 / sigma**2
            side[place] -= (getattr(state, name) - mean) / sigma**2
        at = np.arange(p, q)
        gram[at, at] += self.moment_weights(m)
        side[p:q] -= self.moment_weights(m) * state.moment_am2.ravel()
        if self.window.path_m is not None:
            gram[q, q] += FIXED
            return _Normal(gram, side, p, None, None, None, None)
        # The path: a tridiagonal block, coupled to all else.
        by_sample = inner.reshape(n, channels, q)
        coupling = np.zeros((size, n))
        coupling[:q] = np.einsum("ncq,nc->qn", by_sample, along)
        background = self.background.reshape(n, channels, -1)
        coupling[q + 1 :] = np.matmul(along[:, None], background)[:, 0].T
        excess, scale = self.excess(state)
        weight = 2 / (scale**2 + excess**2)
        band = np.zeros((2, n))
        band[1] = np.einsum("nc,nc->n", along, along)
        band[1, :-1] += weight
        band[1, 1:] += weight
        band[0, 1:] = -weight
        band[1, self.ref] += FIXED
        steps = np.einsum("nc,nc->n", along, trial.residual.reshape(n, channels))
        steps[:-1] += weight * excess
        steps[1:] -= weight * excess
        gram[q, q] += weight @ self.spans**2
        side[q] += weight @ (self.spans * excess)
        coupling[q, :-1] += weight * self.spans
        coupling[q, 1:] -= weight * self.spans
        solved = solveh_banded(band, np.column_stack([coupling.T, steps]), check_finite=False)
        reduced = gram - coupling @ solved[:, :-1]
        side = side - coupling @ solved[:, -1]
        return _Normal(reduced, side, p, solved[:, -1], solved[:, :-1], gram, band)

    def step(self, trial: _Trial, normal: _Normal, damping: float) -> State:
        """The state that the damped normal equations lead to."""
        state = trial.state
        m = len(state.place_m)
        gram = normal.gram.copy()
        diagonal = np.diag_indices(len(gram))
        gram[diagonal] += damping * np.diag(normal.gram if normal.full is None else normal.full)
        scale = 1 / np.sqrt(gram[diagonal])
        gram *= scale[:, None] * scale
        gram[diagonal] += 1e-13
        moved = scale * cho_solve(
            cho_factor(gram, check_finite=False), scale * normal.side, check_finite=False
        )
        values = {
            name: getattr(state, name) + moved[2 * m + place] for place, name in enumerate(_GLOBALS)
        }
        values["height_m"] = max(values["height_m"], 0.3 * state.height_m)
        path, speed = state.path_m, state.speed_m
        if normal.path is not None and normal.coupling is not None:
            path = path + normal.path - normal.coupling @ moved
            speed = speed + moved[normal.p + 3 * m]
        place = state.place_m + moved[: 2 * m].reshape(2, m).T
        return replace(state, place_m=place, path_m=path, speed_m=speed, **values)


@dataclass(frozen=True)
class _Trial:
    state: State
    offsets: Offsets
    rows: Array
    moments: Array
    cross: Array
    residual: Array
    cost: float


@dataclass(frozen=True)
class _Normal:
    gram: Array
    side: Array
    p: int
    path: Array | None
    coupling: Array | None
    full: Array | None
    band: Array | None


def fit(
    window: Window,
    start: State,
    priors: Priors,
    *,
    iterations: int = 30,
    tolerance: float = 1e-5,
    robust: bool = True,
) -> Fitted:
    """The most likely state near ``start``.

    Raises
    ------
    DegenerateError
        The samples do not determine it.
    """
    weight = np.isfinite(window.field_t) / window.noise_t**2
    ref = int(np.argmin(np.abs(start.path_m)))
    try:
        problem = _Problem(window, priors, weight, ref)
        problem.jitter = priors.jitter * abs(start.speed_m) + 1e-6
        trial, converged = _descend(problem, problem.project(start), iterations, tolerance)
        residual = _residual(problem, trial)
        if robust and _outliers(residual):
            for _ in range(3):
                problem, trial = _reweighted(problem, trial, weight)
                trial, converged = _descend(problem, trial, 5, tolerance)
        return _fitted(problem, trial, converged)
    except np.linalg.LinAlgError:
        raise DegenerateError("the samples do not determine the magnets") from None


def _descend(
    problem: _Problem, trial: _Trial, iterations: int, tolerance: float
) -> tuple[_Trial, bool]:
    damping = 1e-3
    for _ in range(iterations):
        normal = problem.normal(trial)
        while True:
            fresh = problem.project(problem.step(trial, normal, damping))
            if fresh.cost <= trial.cost:
                break
            damping *= 8
            if damping > 1e6:
                return trial, True
        gain = trial.cost - fresh.cost
        trial, damping = fresh, max(damping / 10, 1e-9)
        if gain < tolerance * trial.cost:
            return trial, True
    return trial, False


def _residual(problem: _Problem, trial: _Trial) -> Array:
    """(n, N, 3) residual in standard deviations, ``nan`` where there is no sample."""
    residual = trial.residual.reshape(problem.root.shape)
    return np.where(problem.root > 0, residual, np.nan)


def _outliers(residual: Array) -> bool:
    """Whether samples stand out that a normal distribution does not have."""
    z = np.abs(residual[np.isfinite(residual)])
    return bool(np.mean(z > 3.5 * max(1.0, 1.4826 * float(np.median(z)))) > 0.002)


def _reweighted(problem: _Problem, trial: _Trial, weight: Array) -> tuple[_Problem, _Trial]:
    """The same with samples weighted by Student's t of their own residual."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = trial.residual.reshape(weight.shape) / problem.root * np.sqrt(weight)
    z = np.nan_to_num(z)
    scale = max(1.0, float(np.median(np.abs(z[weight > 0])) * 1.4826))
    share = (ROBUST_FREEDOM + 1) / (ROBUST_FREEDOM + (z / scale) ** 2)
    fresh = _Problem(problem.window, problem.priors, weight * share, problem.ref)
    fresh.jitter = problem.jitter
    return fresh, fresh.project(trial.state)


def _fitted(problem: _Problem, trial: _Trial, converged: bool) -> Fitted:
    window = problem.window
    state = trial.state
    m = len(state.place_m)
    residual = _residual(problem, trial)
    count = int(np.isfinite(residual).sum())
    unknowns = 5 * m + problem.background.shape[1]
    if window.path_m is None:
        unknowns += len(window.frames)
    sigma = np.sqrt(np.nansum(residual**2) / max(count - unknowns, 1))
    normal = problem.normal(trial)
    gram = normal.gram
    scale = 1 / np.sqrt(np.diag(gram))
    inverse = cho_solve(
        cho_factor(gram * scale[:, None] * scale + 1e-13 * np.eye(len(gram))), np.diag(scale)
    )
    full = scale[:, None] * inverse
    # From x, y and moment to x, y and angle.
    jacobian = np.zeros((3 * m, len(full)))
    size = np.hypot(*state.moment_am2[:, :2].T) ** 2
    for k in range(m):
        jacobian[3 * k, k] = jacobian[3 * k + 1, m + k] = 1.0
        at = normal.p + 3 * k
        jacobian[3 * k + 2, at] = -state.moment_am2[k, 1] / size[k]
        jacobian[3 * k + 2, at + 1] = state.moment_am2[k, 0] / size[k]
    path = np.zeros(len(window.frames))
    if normal.coupling is not None and normal.band is not None:
        own = solveh_banded(normal.band, np.eye(len(path)), check_finite=False)
        through = np.einsum("nq,qr,nr->n", normal.coupling, full, normal.coupling, optimize=True)
        path = np.sqrt(np.maximum(np.diag(own) + through, 0.0))
    return Fitted(
        state,
        residual,
        trial.cost,
        float(sigma),
        jacobian @ full @ jacobian.T,
        path,
        float(np.sqrt(full[2 * m, 2 * m])),
        converged,
    )
