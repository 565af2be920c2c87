"""Rigid devices with several photodiodes of known place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Receiver:
    """Where the photodiodes of a device sit.

    Attributes
    ----------
    position_m : (k, 3) ndarray
        Of each photodiode in the device's axes, in metres; row i is sensor i of
        :class:`~locatk.core.lighthouse.recording.Sweeps`.
    normal : (k, 3) ndarray, optional
        Unit vectors in which the photodiodes look; light from behind does not reach them.
    name : str
        Of the kind of device, as in ``"lighthouse-deck"``; "" where nobody tells.
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
"""Bitcraze's Lighthouse deck: four photodiodes that look up (facts/lighthouse.md 2.7)."""
