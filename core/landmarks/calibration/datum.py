"""Datum of a calibrated floor: alignment with its design, and covariances without the gauge.

Hall sensors and odometry determine the poses of landmarks relative to one another. A motion of the
whole floor, together with all robots on it, changes no measurement (gauge freedom). The floor is
therefore aligned with its design.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from locatk.core.least_squares import cauchy_loss

Array = NDArray[np.float64]
Member = TypeVar("Member", bound=Hashable)

REWEIGHTING_ITERATIONS = 30
"""Iterations of the robust alignment; it converges linearly."""

LOSS_SCALE_SIGMAS = 3.0
"""Deviation of a landmark from its design at which its weight in the alignment is one half."""


def connected_components(groups: Iterable[Sequence[Member]]) -> list[list[Member]]:
    """Merge groups that share a member; members and components are sorted."""
    components: list[set[Member]] = []
    for group in groups:
        merged = set(group)
        separate = []
        for component in components:
            if merged & component:
                merged |= component
            else:
                separate.append(component)
        components = [*separate, merged]
    return sorted(sorted(component) for component in components)  # type: ignore[type-var]


def gauge_motions(position: Array) -> Array:
    """Return the effect of motions of the whole floor on the poses of its landmarks.

    Parameters
    ----------
    position : (n, 2) ndarray

    Returns
    -------
    (n, 3, 3) ndarray
        Rows are x, y and heading of a landmark; columns are translation in x and y, and rotation
        about the centroid.
    """
    offset = position - position.mean(axis=0)
    motions = np.tile(np.eye(3), (len(position), 1, 1))
    motions[:, 0, 2], motions[:, 1, 2] = -offset[:, 1], offset[:, 0]
    return motions


def deviations_from_design(pose: Array, design: Array, sigma: Array) -> Array:
    """Align landmarks with their design, and return the remaining deviations (n, 3).

    Parameters
    ----------
    pose, design : (n, 3) ndarray
        x, y, heading: estimated in a frame near to the design's, and as designed.
    sigma : (3,) ndarray
        Standard deviations of installation.

    Notes
    -----
    Least squares under a Cauchy loss, so that a few displaced landmarks do not bias the alignment.
    """
    difference = pose - design
    motions = gauge_motions(design[:, :2])
    weight = np.ones(len(pose))
    residual = difference
    for _ in range(REWEIGHTING_ITERATIONS):
        root = np.sqrt(weight)[:, None] / sigma
        rows = (root[..., None] * motions).reshape(-1, 3)
        motion = np.linalg.lstsq(rows, (root * difference).ravel(), rcond=None)[0]
        residual = difference - motions @ motion
        _, weight = cauchy_loss(np.linalg.norm(residual / sigma, axis=1), LOSS_SCALE_SIGMAS)
    return residual


def relative_covariances(
    covariance: Array, position: Array, sigma: Array, scale: float = 1.0
) -> Array:
    """Return the covariances (n, 3, 3) of landmarks relative to one another.

    Parameters
    ----------
    covariance : (n, 3, 3) ndarray
        Of x, y, heading, from least squares with priors.
    position : (n, 2) ndarray
    sigma : (n, 3) ndarray
        Standard deviations of these priors.
    scale : float
        Factor by which the covariances were multiplied after the inversion.

    Notes
    -----
    In units of the priors the information matrix is A + 1, where A is the information of the
    measurements. A times a motion of the whole floor is 0. The motions G are therefore eigenvectors
    of the covariance with the eigenvalue 1, and their part of it is G (G'G)^-1 G'.
    """
    motions = gauge_motions(position) / sigma[..., None]
    common = np.linalg.inv(np.einsum("nij,nik->jk", motions, motions))
    part = sigma[:, :, None] * (motions @ common @ motions.swapaxes(1, 2)) * sigma[:, None]
    return np.asarray(covariance - scale * part)
