"""Stamped poses with covariance: the one shape in which every system answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Trajectory:
    """Poses of one device over time.

    Attributes
    ----------
    device : str
        Name of the device; one trajectory a device.
    frame : str
        Name of the frame in which the poses are given, as in ``"floor"``.
    time_ns : (n,) int64 ndarray
        Nanoseconds since the epoch, ascending.
    position : (n, 3) ndarray
        Metres.
    quaternion : (n, 4) ndarray
        Orientation device to frame as (x, y, z, w), unit length.
    covariance : (n, 6, 6) ndarray
        Of (x, y, z, rotation about x, y, z) in m and rad; ``nan`` in the rows and
        columns of what was not observed (a single photodiode has no heading).
    """

    device: str
    frame: str
    time_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        shapes = {
            "position": (n, 3),
            "quaternion": (n, 4),
            "covariance": (n, 6, 6),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, not {shape}")

    def __len__(self) -> int:
        return len(self.time_ns)

    @classmethod
    def from_positions(
        cls,
        device: str,
        frame: str,
        time_ns: NDArray[np.int64],
        position: NDArray[np.float64],
        covariance: NDArray[np.float64] | None = None,
    ) -> Trajectory:
        """Trajectory of a point: identity orientation, its covariance unknown.

        ``position`` is (n, 3) in metres; ``covariance`` (n, 3, 3) in m^2 or None
        where that is unknown too.
        """
        n = len(time_ns)
        quaternion = np.zeros((n, 4))
        quaternion[:, 3] = 1.0
        full = np.full((n, 6, 6), np.nan)
        if covariance is not None:
            full[:, :3, :3] = covariance
        return cls(device, frame, np.asarray(time_ns, np.int64), position, quaternion, full)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(n, 6) standard deviations in m and rad; ``nan`` where unobserved."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))
