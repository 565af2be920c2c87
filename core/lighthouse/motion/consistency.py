"""Sweeps that contradict the path on which they were received.

Reflections and wrong sweeps are found by what the rest of the path predicts for them. A rejected
sweep is compared with the path that was estimated without it. An accepted one has pulled the path
towards itself; its residual is divided by the standard deviation that remains (data snooping,
Baarda 1968). Photodiodes that one plane crosses within a knot interval are tested together as well:
they share the error of a reflection, and their mean has less noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from locatk.core.block_tridiagonal import BlockTridiagonal
from locatk.core.lighthouse.motion.equations import PathSweeps, Residuals, interval_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

REJECTED_SIGMAS = 5.0
"""Normalized residual above which a sweep or the mean of a group is rejected."""

ACCEPTED_SIGMAS = 3.5
"""Normalized residual below which a rejected sweep is reinstated."""

NEIGHBOUR_KNOTS = 4
"""Knots on each side of a contradiction within which much smaller ones are not rejected with it:
they may be its consequence."""

MIN_REDUNDANCY = 0.02
"""Smallest variance of a residual relative to that of the angle: a sweep that alone determines a
coordinate has none, and cannot be tested."""


CONTESTED_KNOTS = (20, 6)
MAX_REJECTED_FRACTION = (0.35, 0.4)
"""Widths of the stretches around a contradiction in knots, and the largest fractions of their
sweeps that may be rejected. Reflections come in runs; wrong sweeps come singly, but a few at a time
may agree with each other and not with the right ones."""

MODEL_SIGMA_RAD = 1e-4
"""Standard deviation of what the common parameters may still explain of an angle: a sweep within a
few of these is no reflection, and harmless if it is one."""


@dataclass(frozen=True)
class Consistency:
    """Prediction of each sweep by the path.

    Attributes
    ----------
    variance : (n,) ndarray
        Variance of the predicted angle [rad^2].
    ratio : (n,) ndarray
        Normalized residual, of a sweep or of its group, whichever is larger.
    normalized_innovation : (n,) ndarray
        Residual over the standard deviation of angle and prediction, for sweeps that the path was
        estimated without.
    """

    variance: Array
    ratio: Array
    normalized_innovation: Array


def residual_statistics(
    sweeps: PathSweeps,
    residuals: Residuals,
    states: BlockTridiagonal,
    sigma: float,
    is_used: Mask,
) -> Consistency:
    """Compare the residuals of sweeps with the variance of their predictions."""
    diagonal, above = states.inverse_blocks
    k, d = diagonal.shape[:2]
    joint = np.zeros((k - 1, 2 * d, 2 * d))
    joint[:, :d, :d], joint[:, d:, d:] = diagonal[:-1], diagonal[1:]
    joint[:, :d, d:], joint[:, d:, :d] = above, above.mT
    is_finite = np.isfinite(residuals.residual)
    by_pose = np.where(is_finite[:, None], residuals.by_pose, 0.0)
    jacobian = (sweeps.weights[:, :, None] * by_pose[:, None, :]).reshape(-1, 2 * d)
    index = interval_rows(sweeps.knot, k - 1)
    blocks = np.concatenate([jacobian, np.zeros((1, 2 * d))])[index]
    covariance = blocks @ joint @ blocks.mT
    is_sweep = index >= 0
    variance = np.zeros(len(sweeps))
    variance[index[is_sweep]] = np.einsum("kii->ki", covariance)[is_sweep]
    residual = np.where(is_finite, residuals.residual, 0.0)
    remaining = np.maximum(sigma**2 - variance, MIN_REDUNDANCY * sigma**2) + MODEL_SIGMA_RAD**2
    ratio = np.abs(residual) / np.sqrt(remaining)
    padded_residual = np.append(residual, 0.0)[index]
    padded_used = np.append(is_used & is_finite, False)[index]
    source = np.append(2 * sweeps.station + sweeps.plane, -1)[index]
    for group in range(int(source.max()) + 1):
        member = (source == group) & padded_used
        size = np.count_nonzero(member, axis=1)
        rows = np.flatnonzero(size > 1)
        if not len(rows):
            continue
        member, size = member[rows], size[rows]
        total = np.abs(np.sum(padded_residual[rows] * member, axis=1))
        absorbed = np.einsum("ki,kij,kj->k", member, covariance[rows], member)
        own = size * sigma**2
        remaining = np.maximum(own - absorbed, MIN_REDUNDANCY * own) + (size * MODEL_SIGMA_RAD) ** 2
        group_ratio = total / np.sqrt(remaining)
        chosen = index[rows][member]
        ratio[chosen] = np.maximum(ratio[chosen], np.repeat(group_ratio, size))
    innovation = np.abs(residual) / np.sqrt(sigma**2 + variance + 2 * MODEL_SIGMA_RAD**2)
    innovation[~is_finite] = np.inf
    return Consistency(variance, ratio, innovation)


def find_contradictions(
    sweeps: PathSweeps, consistency: Consistency, is_used: Mask
) -> tuple[Mask, Mask]:
    """Return which accepted sweeps (n,) to reject, and which rejected ones to reinstate."""
    ratio = np.where(is_used, consistency.ratio, 0.0)
    largest = np.zeros(int(sweeps.knot.max(initial=0)) + 1)
    np.maximum.at(largest, sweeps.knot, ratio)
    nearby = maximum_filter1d(largest, 2 * NEIGHBOUR_KNOTS + 1, mode="nearest")
    leaving = is_used & (ratio > REJECTED_SIGMAS) & (ratio > 0.7 * nearby[sweeps.knot])
    returning = ~is_used & (consistency.normalized_innovation < ACCEPTED_SIGMAS)
    return leaving, returning


def find_contested(sweeps: PathSweeps, is_used: Mask) -> Mask:
    """Return the sweeps (n,) in stretches of which many sweeps are rejected."""
    result = np.zeros(len(sweeps), bool)
    for width, fraction in zip(CONTESTED_KNOTS, MAX_REJECTED_FRACTION, strict=True):
        is_contested = _used_share(sweeps.knot, is_used, width) < 1.0 - fraction
        wide = maximum_filter1d(is_contested.astype(np.int8), width) > 0
        result |= wide[sweeps.knot]
    return result


def agrees_with_most(sweeps: PathSweeps, agrees: Mask) -> Mask:
    """Return the sweeps (n,) whose station agrees with the path in most sweeps around them.

    Of a reflection, a few sweeps agree with any path by chance, and would hold it there.
    """
    result = np.zeros(len(sweeps), bool)
    for station in np.unique(sweeps.station):
        rows = np.flatnonzero(sweeps.station == station)
        share = _used_share(sweeps.knot[rows], agrees[rows], 2 * NEIGHBOUR_KNOTS + 1)
        result[rows] = share[sweeps.knot[rows]] >= 0.5
    return result


def _used_share(knot: IntArray, is_used: Mask, width: int) -> Array:
    """Return the fraction of sweeps that are used around each knot; 1 where there are none."""
    count = np.bincount(knot).astype(float)
    used = np.bincount(knot, is_used, len(count))
    total = uniform_filter1d(count, width, mode="constant")
    share = uniform_filter1d(used, width, mode="constant") / np.maximum(total, 1e-9)
    return np.where(total > 1e-9, share, 1.0)
