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
from scipy.linalg import solveh_banded
from scipy.linalg.lapack import dposv
from scipy.ndimage import median_filter

from locatk.core.polaris.detection.field_model import Offsets
from locatk.core.polaris.detection.window import Priors, State, Window, trends

Array = NDArray[np.float64]

FIXED = 1e18
"""Weight of what is not free."""

NUISANCES = ("crab", "tilt")
"""What is taken for zero until the samples show it: a way askew to the bar, magnets that do
not lie flat."""

LONGEST_STEP = 0.7
"""How far a magnet may move in one step of the fit, in heights."""

CLOSED = 1e-6
"""Share of its standard deviation that a nuisance is left while it is taken for zero."""


def solve_scaled(gram: Array, side: Array) -> Array:
    """``gram^-1 side`` of a positive matrix whose unknowns have very different units.

    Raises
    ------
    LinAlgError
        It is not positive.
    """
    diagonal = np.diag(gram)
    if not (np.all(np.isfinite(gram)) and np.all(diagonal > 0)):
        raise np.linalg.LinAlgError("not a positive matrix")
    scale = 1 / np.sqrt(diagonal)
    scaled = gram * scale[:, None] * scale
    scaled[np.diag_indices(len(gram))] += 1e-13
    # LAPACK itself: for a hundred unknowns scipy's wrappers take longer than the solution.
    _, solved, failed = dposv(scaled, (side.T * scale).T)
    if failed:
        raise np.linalg.LinAlgError("not a positive matrix")
    return np.asarray((solved.T * scale).T)


@dataclass(frozen=True)
class Trial:
    """A state with the best moments for it, and what it leaves.

    Attributes
    ----------
    moments : (3 N, n, 3 M) ndarray
        Fields of unit moments in units of the noise.
    cross : (3 N, D, 3 M) ndarray
        Their products with the backgrounds.
    residual : (3 N, n) ndarray
        In units of the noise.
    """

    state: State
    offsets: Offsets
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
    """A window and its priors, with what stays the same from step to step.

    Rows are ordered by channel (sensor and axis), then by sample, so that each channel's
    background is a block of its own.

    Parameters
    ----------
    weight : (n, N, 3) ndarray
        One over the variance of each sample, 0 where there is none.
    start : State
        Tells how large a step's jitter may be.
    """

    def __init__(self, window: Window, priors: Priors, weight: Array, start: State) -> None:
        self.window, self.priors = window, priors
        self.jitter = priors.jitter * abs(start.speed_m) + 1e-6
        self.free: frozenset[str] = frozenset()
        self.spans = np.diff(window.frames)
        n, sensors, _ = window.field_t.shape
        self.shape = (3 * sensors, n)
        self.root = np.ascontiguousarray(np.sqrt(weight).reshape(n, -1).T)
        # A shared field has covariance tau^2 u u^T beside the unit noise of each axis; a mean
        # of several samples has less of both.
        square = (self.root.reshape(-1, 3, n) ** 2).sum(axis=0)
        self.excess_square = window.common_t**2 / window.counts * square
        self.shared = (1 - 1 / np.sqrt(1 + self.excess_square)) / np.maximum(square, 1e-300)
        # Near zero, where weights that change from sample to sample mix no levels.
        field = np.nan_to_num(window.field_t).reshape(n, -1).T
        level = (field * self.root).sum(axis=1) / np.maximum(self.root.sum(axis=1), 1e-300)
        self.target = self.whiten(field - level[:, None])
        # Places are counted from where most is felt; the path's variance is zero there.
        self.ref = int(np.argmax(median_filter((self.target**2).sum(axis=0), 5)))
        # (C, n, D); a channel that gave nothing has no background to find.
        self.background = self.root[:, :, None] * trends(window.frames, window.trends)
        gram = self.background.transpose(0, 2, 1) @ self.background
        gram += 1e-9 * max(float(gram.max(initial=0.0)), 1e-300) * np.eye(window.trends)
        self.background_inverse = np.linalg.inv(gram)
        self.background_gram = np.zeros((gram[..., 0].size, gram[..., 0].size))
        for channel, block in enumerate(gram):
            at = slice(channel * window.trends, (channel + 1) * window.trends)
            self.background_gram[at, at] = block

    def whiten(self, rows: Array) -> Array:
        """Rows (C, n) or (C, n, k) in units of the noise, and without most of what all
        sensors share.

        That leaves the backgrounds what they are: courses of their own for each channel.
        """
        wide = rows.ndim == 3
        root = self.root[..., None] if wide else self.root
        scaled = rows * root
        if not self.window.common_t:
            return scaled
        shape = (-1, 3, *rows.shape[1:])
        scaled, root = scaled.reshape(shape), root.reshape((-1, 3, *root.shape[1:]))
        shared = self.shared[..., None] if wide else self.shared
        return np.asarray(
            (scaled - root * (shared * (root * scaled).sum(axis=0))).reshape(rows.shape)
        )

    def shared_square(self, trial: Trial) -> float:
        """Mean square of the part of a residual that all sensors share, in units of the noise
        and before :meth:`whiten` has made it smaller."""
        n = self.shape[1]
        root = self.root.reshape(-1, 3, n)
        square = (root**2).sum(axis=0)
        part = (root * trial.residual.reshape(-1, 3, n)).sum(axis=0) ** 2
        part *= 1 + self.excess_square
        return float((part[square > 0] / square[square > 0]).mean())

    # ---- the model

    def offsets(self, state: State) -> Offsets:
        """From the magnets to the sensors at each sample."""
        sensors = self.window.sensors_m
        along = state.path_m + np.outer(self.window.order * state.skew, self.pace(state))
        across = np.tan(state.crab_rad) * (state.path_m if state.crab_rad else np.zeros(1))
        return Offsets.of(
            along[:, :, None] + (sensors[:, 0, None] - state.place_m[:, 0])[:, None, None],
            across[:, None] + (sensors[:, 1, None] - state.place_m[:, 1])[:, None, None],
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
        rows = units.reshape(*self.shape, 3 * m)
        moments = self.whiten(rows)
        transposed = self.background.transpose(0, 2, 1)
        cross, level = transposed @ moments, transposed @ self.target[:, :, None]
        solved = self.background_inverse @ np.concatenate([cross, level], axis=2)
        flat, flat_cross = moments.reshape(-1, 3 * m), cross.reshape(-1, 3 * m)
        gram = flat.T @ flat - flat_cross.T @ solved[..., :-1].reshape(-1, 3 * m)
        gram[np.diag_indices(3 * m)] += self.moment_weights(m)
        side = flat.T @ self.target.ravel() - flat_cross.T @ solved[..., -1].ravel()
        best = np.linalg.solve(gram, side)
        levels = solved[..., -1:] - solved[..., :-1] @ best[:, None]
        residual = self.target - moments @ best - (self.background @ levels)[..., 0]
        state = replace(state, moment_am2=best.reshape(m, 3))
        cost = (residual**2).sum() + self.moment_weights(m) @ best**2 + self.prior_cost(state)
        return Trial(state, offsets, moments, cross, residual, float(cost))

    def moment_weights(self, m: int) -> Array:
        """Inverse variances (3 M,) of the moments."""
        size = self.priors.moment_am2
        tilt = self.priors.tilt * (1.0 if "tilt" in self.free else CLOSED)
        return np.tile(1 / np.array([3 * size, 3 * size, tilt * size]) ** 2, m)

    def spread(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation that the priors give a global parameter."""
        priors = self.priors
        if name == "height_m":
            return priors.height_m
        if name == "skew":
            return priors.skew if np.any(self.window.order) else (0.0, 1e-9)
        return 0.0, priors.crab_rad * (1.0 if "crab" in self.free else CLOSED)

    def prior_cost(self, state: State) -> float:
        """What the priors add to the squares of the residual, the moments' aside."""
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
        channels, n = self.shape
        state = trial.state
        m = len(state.place_m)
        by_x, by_y, by_z = trial.offsets.gradients(state.moment_am2)
        # Sums over few magnets: a product takes a quarter of the time of a sum.
        total_x, total_y, total_z = (by @ np.ones(m) for by in (by_x, by_y, by_z))
        tangent = np.tan(state.crab_rad)
        p = 2 * m + len(GLOBALS)
        columns = np.empty((*total_x.shape, p))
        np.negative(by_x, out=columns[..., :m])
        np.negative(by_y, out=columns[..., m : 2 * m])
        columns[..., 2 * m] = total_z
        columns[..., 2 * m + 1] = total_x * np.outer(self.window.order, self.pace(state))
        columns[..., 2 * m + 2] = total_y * (state.path_m * (1 + tangent**2))
        inner = np.concatenate(
            [self.whiten(columns.reshape(channels, n, p)), trial.moments], axis=2
        )
        along = self.whiten((total_x + tangent * total_y).reshape(channels, n))
        # Order: places and globals, moments, the mean step, backgrounds.
        q = inner.shape[2]
        size = q + 1 + len(self.background_gram)
        gram, side = np.zeros((size, size)), np.zeros(size)
        flat = inner.reshape(-1, q)
        gram[:q, :q] = flat.T @ flat
        transposed = self.background.transpose(0, 2, 1)
        cross = np.concatenate([transposed @ inner[..., :p], trial.cross], axis=2).reshape(-1, q)
        gram[:q, q + 1 :], gram[q + 1 :, :q] = cross.T, cross
        gram[q + 1 :, q + 1 :] = self.background_gram
        side[:q] = flat.T @ trial.residual.ravel()
        side[q + 1 :] = (transposed @ trial.residual[:, :, None]).ravel()
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
        coupling = np.zeros((size, n))
        coupling[:q] = np.einsum("cn,cnq->qn", along, inner)
        coupling[q + 1 :] = (along[:, :, None] * self.background).transpose(0, 2, 1).reshape(-1, n)
        excess, scale = self.excess(state)
        weight = 2 / (scale**2 + excess**2)
        band = np.zeros((2, n))
        band[1] = (along**2).sum(axis=0)
        band[1, :-1] += weight
        band[1, 1:] += weight
        band[0, 1:] = -weight
        band[1, self.ref] += FIXED
        steps = (along * trial.residual).sum(axis=0)
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
        moved = solve_scaled(gram, normal.side)
        # A magnet that moves by more than this has left what the derivatives know.
        furthest = np.abs(moved[: 2 * m]).max(initial=0.0)
        moved *= min(1.0, LONGEST_STEP * state.height_m / max(furthest, 1e-12))
        values = {
            name: getattr(state, name) + moved[2 * m + place] for place, name in enumerate(GLOBALS)
        }
        low, high = 0.7 * state.height_m, 1.4 * state.height_m
        values["height_m"] = float(np.clip(values["height_m"], low, high))
        path, speed = state.path_m, state.speed_m
        if normal.path is not None and normal.coupling is not None:
            path = path + normal.path - normal.coupling @ moved
            speed = speed + moved[normal.moments + 3 * m]
        place = state.place_m + moved[: 2 * m].reshape(2, m).T
        return replace(state, place_m=place, path_m=path, speed_m=speed, **values)
