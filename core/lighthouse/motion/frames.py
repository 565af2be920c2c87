"""Frame in which the covariances of estimated paths hold.

Stations and paths of an estimated scene can be moved together without a change of any sweep. What
moves with them is no error of the poses: covariances are given in the frame in which all poses, or
those on markers, do not move on average (S-transformation, Baarda 1973).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS
from locatk.core.lighthouse.motion.solver import PathEstimate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class PathFrame:
    """Frame of chosen poses.

    Attributes
    ----------
    centre : (3,) ndarray
        Mean position of these poses.
    motion : (g, m) ndarray
        Translation, rotation about the centre and, if they define the scale, change of scale of
        these poses per change of the common parameters.
    """

    centre: Array
    motion: Array

    @classmethod
    def of(cls, estimate: PathEstimate, is_fixed: Mask, *, with_scale: bool) -> PathFrame:
        """Return the frame of the positions at chosen knots (k,)."""
        position = estimate.path.position[is_fixed]
        centre = position.mean(axis=0)
        by_motion = common_motions(position - centre, with_scale)
        response = estimate.response[is_fixed, :3].reshape(3 * len(position), -1)
        motion = np.linalg.lstsq(by_motion.reshape(len(response), -1), response, rcond=None)[0]
        return cls(centre, np.asarray(motion, np.float64))

    def apply(self, estimate: PathEstimate) -> PathEstimate:
        """Return an estimate with the responses of its poses in this frame."""
        path = estimate.path
        by_motion = common_motions(path.position - self.centre, len(self.motion) > 6)
        response = estimate.response.copy()
        # Common parameters of other devices follow those of the frame.
        own = slice(0, self.motion.shape[1])
        response[:, :3, own] -= by_motion @ self.motion
        if path.rotation is not None:
            response[:, 3:, own] -= path.rotation.mT @ self.motion[3:6]
        return replace(estimate, response=response)

    def station_covariance(self, estimate: PathEstimate) -> Array:
        """Return the covariance (m, m) of the common parameters in this frame."""
        change = np.eye(len(estimate.common.value))
        offset = estimate.common.stations[0] - self.centre
        for i, by_station in enumerate(common_motions(offset, len(self.motion) > 6)):
            row = i * STATION_PARAMETERS
            change[row : row + 3] -= by_station @ self.motion
            change[row + 3 : row + 6] -= self.motion[3:6]
        return np.asarray(change @ estimate.common_covariance @ change.T)


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
