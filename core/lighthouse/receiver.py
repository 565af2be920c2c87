"""Layout of the photodiodes of a rigid device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


DECK = Receiver(
    np.array(
        [[-0.015, 0.0075, 0.0], [-0.015, -0.0075, 0.0], [0.015, 0.0075, 0.0], [0.015, -0.0075, 0.0]]
    ),
    np.tile([0.0, 0.0, 1.0], (4, 1)),
    "lighthouse-deck",
)
"""Bitcraze's Lighthouse deck: four photodiodes that face upwards (positions: crazyflie-firmware
``lighthouse_position_est.c``)."""
