"""True values at the times of estimates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def planar_poses(trajectory: Trajectory) -> Array:
    """Return x, y and unwrapped heading (n, 3)."""
    heading = np.unwrap(heading_from_quaternion(trajectory.quaternion))
    return np.column_stack([trajectory.position[:, :2], heading])


def at_times(time_ns: IntArray, known_ns: IntArray, values: Array) -> Array:
    """Interpolate values (m, k), known at times (m,), at times (n,), to (n, k)."""
    start_ns = known_ns[0]
    known_s, wanted_s = (1e-9 * (each - start_ns) for each in (known_ns, time_ns))
    return np.column_stack([np.interp(wanted_s, known_s, column) for column in values.T])
