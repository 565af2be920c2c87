"""One pass as a problem of least squares: its model, its priors, its normal equations.

The samples of a pass are the fields of a few magnets, seen from an array that moves
along its x by a free step a sample, on a background of its own for each sensor and axis.
Moments and backgrounds enter linearly and are solved for whenever the rest is tried
(variable projection, Golub and Pereyra 1973); the steps are eliminated through their
tridiagonal block before the rest is solved for, so that an iteration costs little more
than one evaluation of the field.

What is known beforehand enters as priors: a step is about as long as the others unless
samples were lost (a Cauchy distribution: the published recordings step by 2.1 mm, and by
9 mm where the host was busy), and magnets lie flat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solveh_banded

from locatk.core.polaris.dipoles import Offsets

Array = NDArray[np.float64]

FIXED = 1e18
"""Weight of what is not free."""

NUISANCES = ("crab", "tilt")
"""What is taken for zero until the samples show it: a way askew to the bar, magnets that do
not lie flat."""

NONE = 1e-6
"""Share of its standard deviation that a nuisance is left while it is taken for zero."""


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
    crab_rad : float
        Between the array's x and its way.
    jitter : float
        Half width of a step's deviation, as a share of the mean step.
    """

    height_m: tuple[float, float] = (0.01, 0.003)
    skew: tuple[float, float] = (0.0, 0.5)
    moment_am2: float = 1.5e-3
    tilt: float = 0.05
    crab_rad: float = 0.009
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
    height_m, skew, crab_rad : float
        See :class:`Priors`.
    """

    place_m: Array
    moment_am2: Array
    path_m: Array
    speed_m: float
    height_m: float
    skew: float = 0.0
    crab_rad: float = 0.0


@dataclass(frozen=True)
class Trial:
    """A state with the best moments for it, and what it leaves.

    Attributes
    ----------
    rows : (n, N, 3, 3 M) ndarray
        Fields of unit moments.
    moments : (3 N n, 3 M) ndarray
        The same in units of the noise.
    cross : (3 M, 6 N) ndarray
        Their products with the backgrounds.
    residual : (3 N n,) ndarray
        In units of the noise.
    """

    state: State
    offsets: Offsets
    rows: Array
    moments: Array
    cross: Array
    residual: Array
    cost: float


@dataclass(frozen=True)
class Normal:
    """Normal equations around a trial, from which the path was eliminated.

    Attributes
    ----------
    gram, side : (q, q), (q,) ndarray
        Unknowns: x of the magnets, their y, :data:`GLOBALS`, moments, the mean step,
        backgrounds.
    moments : int
        Number of the first moment.
    whole : (q, q) ndarray
        ``gram`` before the path was eliminated.
    path, coupling : (n,), (n, q) ndarray or None
        The path's step is ``path - coupling @ x``; None where the path is known.
    band : (2, n) ndarray or None
        The path's own block.
    """

    gram: Array
    side: Array
    moments: int
    whole: Array
    path: Array | None = None
    coupling: Array | None = None
    band: Array | None = None


GLOBALS = ("height_m", "skew", "crab_rad")


class Problem:
    """A window and its priors, with what stays the same from step to step."""

    def __init__(self, window: Window, priors: Priors, weight: Array, start: State) -> None:
        """``weight`` (n, N, 3) is one over the variance of each sample, 0 where there is
        none; ``start`` tells where the path is zero, and how large a step's jitter may be."""
        self.window, self.priors = window, priors
        self.ref = int(np.argmin(np.abs(start.path_m)))
        self.jitter = priors.jitter * abs(start.speed_m) + 1e-6
        self.free: frozenset[str] = frozenset()
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
        self.background_target = self.background.T @ self.target

    def whiten(self, rows: Array) -> Array:
        """Rows (n, N, 3, k) in units of their noise, without what all sensors share."""
        scaled = rows * self.root[..., None]
        if self.shrink is not None:
            mean = (scaled * self.root[..., None]).sum(axis=1, keepdims=True)
            scaled -= (self.root * self.shrink)[..., None] * mean
        return scaled

    # ---- the model

    def offsets(self, state: State) -> Offsets:
        """From the magnets to the sensors, in the order of the samples."""
        sensors = self.window.sensors_m
        along = state.path_m[:, None] + self.window.order * state.skew * self.pace(state)[:, None]
        across = sensors[:, 1] + np.tan(state.crab_rad) * state.path_m[:, None]
        if not state.crab_rad:
            across = across[:1]
        return Offsets.of(
            along[:, None, :, None] + (sensors[:, 0, None] - state.place_m[:, 0])[:, None],
            across[:, :, None, None] - state.place_m[:, 1],
            state.height_m,
        )

    def pace(self, state: State) -> Array:
        """Step (n,) of a sample period around each sample, without its jitter."""
        if len(state.path_m) < 3:
            return np.full(len(state.path_m), state.speed_m)
        steps = np.diff(state.path_m) / self.spans
        padded = np.concatenate([steps[:1], steps[:1], steps, steps[-1:], steps[-1:]])
        return np.median(np.lib.stride_tricks.sliding_window_view(padded, 4), axis=1)

    def project(self, state: State) -> Trial:
        """The best moments and backgrounds for the rest of ``state``."""
        offsets = self.offsets(state)
        units = offsets.unit_fields(self.window.thickness_m2)
        m = units.shape[3]
        rows = units.reshape(*units.shape[:3], 3 * m)
        moments = self.whiten(rows).reshape(-1, 3 * m)
        cross = moments.T @ self.background
        solved = cho_solve(
            self.background_factor,
            np.column_stack([cross.T, self.background_target]),
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
        return Trial(state, offsets, rows, moments, cross, residual, float(cost))

    def moment_weights(self, m: int) -> Array:
        """Inverse variances (3 M,) of the moments."""
        size = self.priors.moment_am2
        tilt = self.priors.tilt * (1.0 if "tilt" in self.free else NONE)
        return np.tile(1 / np.array([3 * size, 3 * size, tilt * size]) ** 2, m)

    def spread(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation that the priors give a global parameter."""
        priors = self.priors
        if name == "height_m":
            return priors.height_m
        if name == "skew":
            return priors.skew if np.any(self.window.order) else (0.0, 1e-9)
        return 0.0, priors.crab_rad * (1.0 if "crab" in self.free else NONE)

    def prior_cost(self, state: State) -> float:
        cost = 0.0
        for name in GLOBALS:
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

    # ---- one step of Gauss and Newton

    def normal(self, trial: Trial) -> Normal:
        """Normal equations around a trial, the path eliminated."""
        n, channels = self.shape
        state = trial.state
        m = len(state.place_m)
        along_x, along_y, along_z = trial.offsets.gradients(state.moment_am2)
        total_x, total_y = along_x.sum(axis=-1), along_y.sum(axis=-1)
        tangent = np.tan(state.crab_rad)
        columns = np.empty((*total_x.shape, 2 * m + len(GLOBALS) + 1))
        np.negative(along_x, out=columns[..., :m])
        np.negative(along_y, out=columns[..., m : 2 * m])
        columns[..., 2 * m] = along_z.sum(axis=-1)
        columns[..., 2 * m + 1] = total_x * (self.pace(state)[:, None, None] * self.window.order)
        columns[..., 2 * m + 2] = total_y * (state.path_m * (1 + tangent**2))[:, None, None]
        columns[..., 2 * m + 3] = total_x + tangent * total_y
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
        for place, name in enumerate(GLOBALS, 2 * m):
            mean, sigma = self.spread(name)
            gram[place, place] += 1 / sigma**2
            side[place] -= (getattr(state, name) - mean) / sigma**2
        at = np.arange(p, q)
        gram[at, at] += self.moment_weights(m)
        side[p:q] -= self.moment_weights(m) * state.moment_am2.ravel()
        if self.window.path_m is not None:
            gram[q, q] += FIXED
            return Normal(gram, side, p, gram)
        # The path: a tridiagonal block, coupled to all else.
        by_sample = inner.reshape(n, channels, q)
        coupling = np.zeros((size, n))
        coupling[:q] = np.matmul(along[:, None], by_sample)[:, 0].T
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
        return Normal(reduced, side, p, gram, solved[:, -1], solved[:, :-1], band)

    def step(self, trial: Trial, normal: Normal, damping: float) -> State:
        """The state that the damped normal equations lead to."""
        state = trial.state
        m = len(state.place_m)
        gram = normal.gram.copy()
        diagonal = np.diag_indices(len(gram))
        gram[diagonal] += damping * np.diag(normal.whole)
        scale = 1 / np.sqrt(gram[diagonal])
        gram *= scale[:, None] * scale
        gram[diagonal] += 1e-13
        moved = scale * cho_solve(
            cho_factor(gram, check_finite=False), scale * normal.side, check_finite=False
        )
        values = {
            name: getattr(state, name) + moved[2 * m + place] for place, name in enumerate(GLOBALS)
        }
        values["height_m"] = max(values["height_m"], 0.3 * state.height_m)
        path, speed = state.path_m, state.speed_m
        if normal.path is not None and normal.coupling is not None:
            path = path + normal.path - normal.coupling @ moved
            speed = speed + moved[normal.moments + 3 * m]
        place = state.place_m + moved[: 2 * m].reshape(2, m).T
        return replace(state, place_m=place, path_m=path, speed_m=speed, **values)
