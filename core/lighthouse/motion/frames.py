"""Frame in which the covariances of estimated paths hold.

Stations and paths of an estimated scene can be moved together without a change of any sweep. What
moves with them is no error of the poses: covariances are given in the frame in which all poses, or
those on markers, do not move on average (S-transformation, Baarda 1973).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS
from locatk.core.lighthouse.motion.solver import PathEstimate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def fix_frame(estimate: PathEstimate, is_fixed: Mask, *, with_scale: bool) -> PathEstimate:
    """Return an estimate with covariances in the frame of chosen poses.

    Parameters
    ----------
    estimate : PathEstimate
    is_fixed : (k,) bool ndarray
        Knots whose positions define the frame.
    with_scale : bool
        True if they define the scale, too.
    """
    centre = estimate.path.position[is_fixed].mean(axis=0)
    by_motion = common_motions(estimate.path.position - centre, with_scale)
    fixed = by_motion[is_fixed].reshape(-1, by_motion.shape[2])
    response = estimate.response[is_fixed, :3].reshape(len(fixed), -1)
    motion = np.linalg.lstsq(fixed, response, rcond=None)[0]
    position = estimate.response[:, :3] - by_motion @ motion
    parts = [position]
    if estimate.path.rotation is not None:
        parts.append(estimate.response[:, 3:] - estimate.path.rotation.mT @ motion[3:6])
    common = np.eye(len(estimate.common.value))
    stations = common_motions(estimate.common.stations[0] - centre, with_scale)
    for i, by_station in enumerate(stations):
        row = i * STATION_PARAMETERS
        common[row : row + 3] -= by_station @ motion
        common[row + 3 : row + 6] -= motion[3:6]
    return replace(
        estimate,
        response=np.concatenate(parts, axis=1),
        station_covariance=common @ estimate.common_covariance @ common.T,
    )


def common_motions(offset: Array, with_scale: bool = True) -> Array:
    """Return the change (n, 3, 7) of points by a translation, a rotation and a change of scale.

    ``offset`` (n, 3) is from the centre of the motion. Without scale, the result is (n, 3, 6).
    """
    motions = np.zeros((len(offset), 3, 7 if with_scale else 6))
    motions[:, range(3), range(3)] = 1.0
    motions[:, :, 3:6] = np.cross(np.eye(3)[None], offset[:, None, :]).swapaxes(1, 2)
    if with_scale:
        motions[:, :, 6] = offset
    return motions
