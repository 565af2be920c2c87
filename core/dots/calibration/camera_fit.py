"""Fit of a camera to dots whose places on the sheet are known.

Where frames are any homographies, what bends their straight lines can only be the lens:
its centre and k are found without a word on the focal length, tilted or not. Where frames
are poses over a flat sheet, perspective tells the tilt over the focal length and the
shortening along the tilt tells the tilt, so that frames that are tilted enough tell the
focal length.

Both are solved by Gauss-Newton (damped as Levenberg and Marquardt do) on distances in the
frame, with the frames' own parameters eliminated. A frame counts by the scatter of its
dots; dots that lie far off are given up (Tukey's biweight).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.camera_models import (
    ASPECT,
    CENTRE,
    LOG_FOCAL,
    RADIAL,
    Homographies,
    Model,
    Poses,
    focal_of,
    poses_of,
    seeds,
    seen,
    tilts,
)
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]

CENTRE_SIGMA = 0.1
"""Lenses are that well centred, one standard deviation, in half diagonals."""

RADIAL_SIGMA = 1.0
"""Of k in half diagonals: corners drawn in by half or so."""

FOCAL_SIGMA = 1.5
"""Of the logarithm: focal lengths lie within 4.5 times of what is usual."""

ASPECT_SIGMA = 0.02
"""Of a sheet's x scale over its y scale (printers off by 1.2 %: facts/dots.md 4)."""

USUAL_SCATTER_PX = 0.05
"""Of a dot, until the frames have told."""

BIWEIGHT = 4.685
"""Standard deviations from which a dot counts for nothing (Tukey)."""

LEAST_SPREAD = 0.3
"""A frame's scatter is believed down to this share of the others'."""

ROUNDS = 4
"""Fits, each with the weights that the one before has left."""

STEPS = 30
"""Steps of a fit at most."""


@dataclass(frozen=True)
class Views:
    """Dots of n frames of one camera, m of them at most in each.

    Attributes
    ----------
    size : (width, height)
        Of a frame in px.
    pixels : (n, m, 2) float64 ndarray
        As seen, in px.
    plane : (n, m, 2) float64 ndarray
        Where they are on the sheet, x right and y *down*, in any unit, from any origin.
    valid : (n, m) bool ndarray
        Whether there is such a dot.
    """

    size: tuple[int, int]
    pixels: Array
    plane: Array
    valid: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.valid)

    @property
    def middle(self) -> Array:
        """(2,) middle of the frame in px."""
        return (np.array(self.size) - 1) / 2

    @property
    def half_diagonal(self) -> float:
        """In px."""
        return math.hypot(*self.size) / 2


@dataclass(frozen=True)
class Fit:
    """What a fit says, in px; nan of what it knows nothing of.

    Attributes
    ----------
    centre : (2,) ndarray
    radial : float
        k in px^-2.
    focal : float
    aspect : float
        The sheet's scale along x over that along y, minus 1.
    sigma : (5,) ndarray
        Standard deviations of centre (two), k, focal length and aspect.
    tilt : (n,) ndarray
        Of each frame, in rad.
    own : (n, q) ndarray
        Homographies or poses.
    distance : (n, m) ndarray
        How far each dot is from where it should be.
    used : (n, m) bool ndarray
        Which dots were not given up.
    """

    centre: Array
    radial: float
    focal: float
    aspect: float
    sigma: Array
    tilt: Array
    own: Array
    distance: Array
    used: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """Root mean square distance of the dots that are used, in px."""
        return float(np.sqrt(np.mean(self.distance[self.used] ** 2)))


def fit_flat(views: Views) -> Fit:
    """Homographies without any lens, for comparison."""
    return _fit(views, Homographies(), np.zeros(5), homographies(views), [])


def fit_homographies(views: Views, *, hold_centre: bool = False) -> Fit:
    """Centre and k of the lens, whatever the focal length.

    Parameters
    ----------
    views : Views
        At least four dots in each frame, not all in a row.
    hold_centre : bool
        Leave the centre in the middle of the frame.
    """
    free = [RADIAL] if hold_centre else [0, 1, RADIAL]
    return _fit(views, Homographies(), np.zeros(5), homographies(views), free)


def fit_poses(views: Views, start: Fit, usual_focal: float, *, hold_centre: bool = False) -> Fit:
    """The same with the focal length: its standard deviation tells whether it is known.

    Parameters
    ----------
    views : Views
    start : Fit
        Of :func:`fit_homographies`.
    usual_focal : float
        In px; where nothing else is known.
    hold_centre : bool
        Leave the centre in the middle of the frame.
    """
    half = views.half_diagonal
    usual = math.log(usual_focal / half)
    shared = np.zeros(5)
    if not hold_centre:
        shared[CENTRE] = (start.centre - views.middle) / half
    shared[RADIAL] = start.radial * half**2
    focal = focal_of(start.own)
    near = focal > 0 and abs(math.log(focal) - usual) < FOCAL_SIGMA
    shared[LOG_FOCAL] = math.log(focal) if near else usual
    own = poses_of(start.own, math.exp(shared[LOG_FOCAL]))
    free = [RADIAL, LOG_FOCAL, ASPECT] if hold_centre else [0, 1, RADIAL, LOG_FOCAL, ASPECT]
    return _fit(views, Poses(), shared, own, free, usual)


def homographies(views: Views) -> Array:
    """(n, 8) of frames by linear least squares, in half diagonals of the frame; no lens."""
    frame, plane = _scaled(views)
    return seeds(frame, plane, views.valid)


def _scaled(views: Views) -> tuple[Array, Array]:
    """Pixels in half diagonals from the middle; the plane from the middle of each frame's
    dots in units about as large as a frame; 0 where there is no dot."""
    there = views.valid[..., None]
    frame = np.where(there, (views.pixels - views.middle) / views.half_diagonal, 0)
    plane, count = np.where(there, views.plane, 0), there.sum(axis=1, keepdims=True)
    plane = (plane - plane.sum(axis=1, keepdims=True) / count) * there
    return frame, plane / math.sqrt((plane * plane).sum() / count.sum())


@dataclass(frozen=True)
class _Problem:
    """Everything that stays while parameters move."""

    model: Model
    frame: Array
    plane: Array
    valid: NDArray[np.bool_]
    free: list[int]
    prior: Array
    known: Array

    def residual(self, shared: Array, own: Array) -> tuple[Array, Array, Array]:
        """(n, m, 2) misses, 0 where there is no dot, and derivatives of what is predicted."""
        predicted, by_own, by_shared = seen(self.model, shared, own, self.plane)
        miss = np.where(self.valid[..., None], self.frame - predicted, 0)
        return miss, by_own, by_shared[..., self.free]


class _Normal:
    """Normal equations of a problem at a point.

    ``gram`` is (n, p + s + 1, p + s + 1): products of the columns of p own and s shared
    parameters and of the misses, of each frame.
    """

    def __init__(self, problem: _Problem, shared: Array, own: Array, weights: Array) -> None:
        self.shared, self.own, self._problem = shared, own, problem
        self.miss, by_own, by_shared = problem.residual(shared, own)
        self._p = by_own.shape[3]
        table = np.concatenate([by_own, by_shared, self.miss[..., None]], axis=3)
        table *= np.sqrt(weights)[..., None, None]
        table = table.reshape(len(weights), -1, table.shape[3])
        self._gram = table.transpose(0, 2, 1) @ table
        away = (problem.prior - shared)[problem.free]
        self._pull = problem.known[problem.free] * away
        self.cost = float(self._gram[:, -1, -1].sum() + (self._pull * away).sum())

    def _reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """(n, p, s + 1) what own parameters answer to shared ones and to the misses, and
        (n, s, s + 1) what is left for the shared ones."""
        p, gram = self._p, self._gram.copy()
        np.einsum("nii->ni", gram)[:, :-1] *= 1 + damping
        answer = np.linalg.solve(gram[:, :p, :p], gram[:, :p, p:])
        left = gram[:, p:-1, p:] - gram[:, p:-1, :p] @ answer
        return answer, left, self._problem.known[self._problem.free] * (1 + damping)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Shared (5,) and own (n, p) steps."""
        answer, left, known = self._reduced(damping)
        total = left.sum(axis=0)
        shared = np.linalg.solve(total[:, :-1] + np.diag(known), total[:, -1] + self._pull)
        whole = np.zeros(5)
        whole[self._problem.free] = shared
        return whole, answer[..., -1] - answer[..., :-1] @ shared

    def sigma(self) -> Array:
        """(s,) standard deviations of the free shared parameters.

        The larger one of what the scatter of dots explains, and of what is told by how
        much frames contradict each other (the sandwich of White and Huber, clustered by
        frame): dots of a frame err together where the paper is not flat.
        """
        _, left, known = self._reduced(0.0)
        n, s = len(left), len(known)
        covariance = np.linalg.inv(left[..., :-1].sum(axis=0) + np.diag(known))
        scores = left[..., -1] @ covariance
        clustered = (scores * scores).sum(axis=0) * n / max(n - s, 1)
        result: Array = np.sqrt(np.maximum(np.diag(covariance), clustered))
        return result


def _fit(
    views: Views, model: Model, shared: Array, own: Array, free: list[int], usual: float = 0.0
) -> Fit:
    half = views.half_diagonal
    frame, plane = _scaled(views)
    prior = np.array([0.0, 0.0, 0.0, usual, 0.0])
    spread = np.array([CENTRE_SIGMA, CENTRE_SIGMA, RADIAL_SIGMA, FOCAL_SIGMA, ASPECT_SIGMA])
    problem = _Problem(model, frame, plane, views.valid, free, prior, spread**-2.0)
    weights = views.valid * (USUAL_SCATTER_PX / half) ** -2.0
    for _ in range(ROUNDS):
        at = _descend(problem, shared, own, weights)
        shared, own = at.shared, at.own
        weights = _weights(at.miss, views.valid)
    sigma = np.full(5, np.nan)
    sigma[free] = _Normal(problem, shared, own, weights).sigma()
    focal = half * math.exp(shared[LOG_FOCAL]) if LOG_FOCAL in free else math.nan
    return Fit(
        centre=views.middle + half * shared[CENTRE],
        radial=float(shared[RADIAL]) / half**2,
        focal=focal,
        aspect=float(shared[ASPECT]) if ASPECT in free else math.nan,
        sigma=sigma * np.array([half, half, half**-2.0, focal, 1.0]),
        tilt=tilts(own) if isinstance(model, Poses) else np.full(len(views), np.nan),
        own=own,
        distance=half * np.linalg.norm(at.miss, axis=2),
        used=weights > 0,
    )


def _descend(problem: _Problem, shared: Array, own: Array, weights: Array) -> _Normal:
    """Where the sum of weighted squares is least."""
    at, damping = _Normal(problem, shared, own, weights), 1e-6
    for _ in range(STEPS):
        by_shared, by_own = at.step(damping)
        after = _Normal(
            problem, at.shared + by_shared, problem.model.moved(at.own, by_own), weights
        )
        if after.cost <= at.cost:  # not so where it is nan
            done = at.cost - after.cost < 1e-9 * at.cost
            at, damping = after, max(damping / 10, 1e-12)
        else:
            done, damping = damping > 1e6, max(damping, 1e-9) * 10
        if done:
            break
    return at


def _weights(miss: Array, valid: NDArray[np.bool_]) -> Array:
    """(n, m) inverse variances: of the frame, lower the farther off a dot is."""
    each = zip(miss, valid, strict=True)
    spread = np.array([robust_sigma(one[there]) for one, there in each])
    freedom = 2 * valid.sum(axis=1)
    spread *= np.sqrt(freedom / np.maximum(freedom - 8, 1))
    least = max(LEAST_SPREAD * float(np.median(spread)), 1e-9)
    spread = np.maximum(spread, least)[:, None]
    far = np.linalg.norm(miss, axis=2) / (math.sqrt(2) * BIWEIGHT * spread)
    result: Array = np.square(np.clip(1 - far * far, 0, None)) * valid / spread**2
    return result
