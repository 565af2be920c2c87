"""Composition of transforms that are each known at their own times, as in tf2 of ROS."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.evaluation.association import find_neighbours
from locatk.core.geometry import quaternion_multiply, quaternion_rotate, slerp
from locatk.core.trajectory import Trajectory

UNLIMITED_GAP_S = 1e9
"""Gap in seconds between samples of a transform that is interpolated. tf2 has no limit either."""


def compose(chain: Sequence[Trajectory], device: str) -> Trajectory:
    """Compose transforms from a frame to its child, from that to the next, and so on.

    The times are those of the transform with the most samples. The others are interpolated,
    positions linearly and orientations along the great circle, and never extrapolated. A
    transform with a single sample is constant.

    Parameters
    ----------
    chain : sequence of Trajectory
        At least one, from the outermost frame inwards, each with at least one pose and ascending
        stamps.
    device : str
        Name of the result.

    Returns
    -------
    Trajectory
        In the frame of the first transform, with unknown covariance. Times that a transform does
        not cover are left out, and it may be empty.
    """
    time_ns = max(chain, key=len).time_ns
    for each in chain:
        if len(each) > 1:
            time_ns = time_ns[find_neighbours(time_ns, each.time_ns, UNLIMITED_GAP_S)[0]]
    position, quaternion = _sample(chain[0], time_ns)
    for each in chain[1:]:
        inner_position, inner_quaternion = _sample(each, time_ns)
        position = position + quaternion_rotate(quaternion, inner_position)
        quaternion = quaternion_multiply(quaternion, inner_quaternion)
    covariance = np.broadcast_to(np.nan, (len(time_ns), 6, 6))
    return Trajectory(device, chain[0].frame, time_ns, position, quaternion, covariance)


def _sample(
    transform: Trajectory, time_ns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions (n, 3) and quaternions (n, 4) at stamps that a transform covers."""
    if len(transform) == 1:
        n = len(time_ns)
        return np.tile(transform.position, (n, 1)), np.tile(transform.quaternion, (n, 1))
    _, before, after, fraction = find_neighbours(time_ns, transform.time_ns, UNLIMITED_GAP_S)
    weight = fraction[:, None]
    position = (1 - weight) * transform.position[before] + weight * transform.position[after]
    return position, slerp(transform.quaternion[before], transform.quaternion[after], fraction)
