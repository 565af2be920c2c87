"""What robots cannot see of a floor: where it lies as a whole. Laid over its design here.

Hall sensors and odometry say how landmarks lie to one another. Moving or turning the whole
floor, with all robots on it, changes nothing of what they measure.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Name = TypeVar("Name", bound=Hashable)

ROUNDS = 30

ODD = 3.0
"""Standard deviations of its place and heading from which on a landmark counts for less."""


def joined(groups: Iterable[Sequence[Name]]) -> list[list[Name]]:
    """Groups that share a member made one; members sorted, the first group first."""
    found: list[set[Name]] = []
    for group in groups:
        whole = set(group)
        apart = []
        for other in found:
            if whole & other:
                whole |= other
            else:
                apart.append(other)
        found = [*apart, whole]
    return sorted(sorted(group) for group in found)  # type: ignore[type-var]


def motions(place: Array) -> Array:
    """(n, 3, 3): what moving the floor by x and y and turning it about its middle does.

    Rows are x, y and heading of the landmarks at ``place`` (n, 2), columns the motions.
    """
    off = place - place.mean(axis=0)
    out = np.tile(np.eye(3), (len(place), 1, 1))
    out[:, 0, 2], out[:, 1, 2] = -off[:, 1], off[:, 0]
    return out


def unlike_design(pose: Array, design: Array, sigma: Array) -> Array:
    """What is left (n, 3) of landmarks' poses when most of them lie on their design.

    Parameters
    ----------
    pose, design : (n, 3) ndarray
        x, y, heading in any frame near to the design's, and as designed.
    sigma : (3,) ndarray
        With which landmarks are laid.

    Notes
    -----
    Least squares with the weights of a Cauchy distribution: the few that lie far off do not
    pull the others along, as they would in a mean.
    """
    off = pose - design
    shape = motions(design[:, :2])
    weight = np.ones(len(pose))
    left = off
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None] / sigma
        rows = (root[..., None] * shape).reshape(-1, 3)
        motion = np.linalg.lstsq(rows, (root * off).ravel(), rcond=None)[0]
        left = off - shape @ motion
        weight = 1 / (1 + np.sum((left / sigma) ** 2, axis=1) / ODD**2)
    return left


def own_covariances(covariance: Array, place: Array, sigma: Array, scale: float = 1.0) -> Array:
    """Covariances (n, 3, 3) of landmarks' poses to one another, of those on the floor.

    Parameters
    ----------
    covariance : (n, 3, 3) ndarray
        Of x, y, heading, as least squares with priors give them.
    place : (n, 2) ndarray
    sigma : (n, 3) ndarray
        Standard deviations of those priors.
    scale : float
        By which the covariances were made larger after the inversion.

    Notes
    -----
    In units of the priors the information is A + 1, where A is what was measured, and A
    times a motion of the whole floor is 0. So the motions G are eigenvectors of the
    covariance, to the eigenvalue 1, and G (G'G)^-1 G' is all that they add to it.
    """
    shape = motions(place) / sigma[..., None]
    common = np.linalg.inv(np.einsum("nij,nik->jk", shape, shape))
    part = sigma[:, :, None] * (shape @ common @ shape.swapaxes(1, 2)) * sigma[:, None]
    return np.asarray(covariance - scale * part)
