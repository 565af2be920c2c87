"""Path of a robot by its odometry: planar poses and velocities at any time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.preprocessing import VELOCITY_SPAN_NS, planar_poses, valid_poses
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OdometryPath:
    """Path of a robot by its odometry.

    Attributes
    ----------
    time_ns : (n,) int64 ndarray
    pose : (n, 3) ndarray
        x, y, heading (unwrapped).
    """

    time_ns: NDArray[np.int64]
    pose: Array

    @classmethod
    def of(cls, odometry: Trajectory) -> OdometryPath:
        """Return the path of a trajectory."""
        return cls(odometry.time_ns, planar_poses(odometry))

    def between(self, first_ns: int, last_ns: int) -> slice:
        """Return the poses after one time and before another."""
        first = int(np.searchsorted(self.time_ns, first_ns, "right"))
        return slice(first, max(first, int(np.searchsorted(self.time_ns, last_ns, "left"))))

    def pose_at(self, time_ns: NDArray[np.int64]) -> Array:
        """Interpolate the poses (k, 3) at times; before and after the path the robot rests."""
        known_s, wanted_s = (1e-9 * (each - self.time_ns[0]) for each in (self.time_ns, time_ns))
        return np.column_stack([np.interp(wanted_s, known_s, column) for column in self.pose.T])

    def velocity(self, time_ns: NDArray[np.int64]) -> Array:
        """Return the derivatives (k, 3) of the pose by time, per second."""
        ahead, behind = (
            self.pose_at(time_ns + span) for span in (VELOCITY_SPAN_NS, -VELOCITY_SPAN_NS)
        )
        return (ahead - behind) / (2e-9 * VELOCITY_SPAN_NS)


def without_lag(odometry: Trajectory, lag_s: float) -> Trajectory:
    """Return the odometry as it would be without a lag, at the times for which it is known.

    Poses that are not finite stay so.

    Raises
    ------
    InputError
        The odometry is not longer than the lag.
    """
    is_valid = valid_poses(odometry)
    path = OdometryPath.of(odometry.select(is_valid))
    time_ns = odometry.time_ns + round(1e9 * lag_s)
    is_known = (time_ns >= odometry.time_ns[0]) & (time_ns <= odometry.time_ns[-1])
    if is_known.sum() < 2 or len(path.time_ns) < 2:
        raise InputError(
            f"the odometry of {odometry.device} is shorter than its lag of {1e3 * lag_s:.0f} ms",
            hint="The lag is in milliseconds; leave it out to have it estimated",
        )
    pose = path.pose_at(time_ns[is_known])
    pose[~is_valid[is_known]] = np.nan
    position = np.column_stack([pose[:, :2], np.zeros(len(pose))])
    quaternion = quaternion_from_heading(pose[:, 2])
    known = odometry.select(is_known)
    return replace(known, position=position, quaternion=quaternion)
