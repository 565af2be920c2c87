"""Frames of one camera: the observations of the solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Frames:
    """Frames of one camera, in the order of time.

    Attributes
    ----------
    device : str
        Name of the camera or of the robot that carries it.
    time_ns : (n,) int64 ndarray
        Nanoseconds since the epoch, ascending.
    names : tuple of str
        Name of each frame: its file, or its number.
    images : sequence of (height, width) uint8 ndarray
        Grey values, dots dark. Any sequence: ``images[i]`` may load the frame on access, and
        raises InputError if that frame cannot be read.
    """

    device: str
    time_ns: NDArray[np.int64]
    names: tuple[str, ...]
    images: Sequence[NDArray[np.uint8]]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        return f"<Frames of {self.device!r}: {len(self)}>"
