"""Layout of the photodiodes of a rigid device."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.geometry import matrix_from_quaternion, quaternion_from_heading

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Receiver:
    """Positions and normals of the photodiodes of a device.

    Attributes
    ----------
    position_m : (k, 3) ndarray
        Position of each photodiode in the device frame, in metres; row i is sensor i of
        :class:`~locatk.core.lighthouse.recording.Sweeps`.
    normal : (k, 3) ndarray, optional
        Unit vector along the optical axis of each photodiode. Light from behind is not received.
    name : str
        Type of the device, as in ``"lighthouse-deck"``; "" if unknown.
    """

    position_m: Array
    normal: Array | None = None
    name: str = ""

    def __len__(self) -> int:
        return len(self.position_m)

    def mounted(self, position_m: ArrayLike, yaw_rad: float) -> Receiver:
        """Return this receiver at a position (3,) on another device, turned about its z axis."""
        rotation = matrix_from_quaternion(quaternion_from_heading(np.array([yaw_rad])))[0]
        normal = None if self.normal is None else self.normal @ rotation.T
        return replace(self, position_m=self.position_m @ rotation.T + position_m, normal=normal)


DECK = Receiver(
    np.array(
        [[-0.015, 0.0075, 0.0], [-0.015, -0.0075, 0.0], [0.015, 0.0075, 0.0], [0.015, -0.0075, 0.0]]
    ),
    np.tile([0.0, 0.0, 1.0], (4, 1)),
    "lighthouse-deck",
)
"""Bitcraze's Lighthouse deck: four photodiodes that face upwards (positions: crazyflie-firmware
``lighthouse_position_est.c``)."""

BOLT = replace(DECK, name="crazyflie-bolt")
"""A Lighthouse deck on a Crazyflie Bolt. The firmware has the same positions for it; the real ones
depend on the frame (:meth:`Receiver.mounted`)."""

RECEIVERS = {"deck": DECK, "bolt": BOLT}
"""Receivers known by name."""
