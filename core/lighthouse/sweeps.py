"""Decoded sweeps: what a photodiode reports, as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

UNKNOWN = -1


@dataclass(frozen=True)
class Sweeps:
    """Times at which sweeping light planes crossed photodiodes, in no special order.

    Attributes
    ----------
    devices : tuple of str
        Names to which ``device`` points.
    time_ns : (n,) int64 ndarray
        When each sweep was received, nanoseconds since the epoch.
    device : (n,) int ndarray
        Index into ``devices``.
    sensor : (n,) int ndarray
        Number of the photodiode on its device, from 0.
    channel : (n,) int ndarray
        Channel of the base station, 1 to 16 (also called mode).
    polynomial : (n,) int ndarray
        LFSR polynomial 0 to 31, or -1 where the source does not tell.
    sweep : (n,) int ndarray
        0 for the first plane of a rotation, 1 for the second, -1 where the source
        does not tell: the two are then told apart by their counts.
    count : (n,) float64 ndarray
        LFSR index: steps of the 6 MHz bit clock since the rotor's zero. Fractional
        where timing refines it.
    """

    devices: tuple[str, ...]
    time_ns: NDArray[np.int64]
    device: NDArray[np.int32]
    sensor: NDArray[np.int32]
    channel: NDArray[np.int32]
    polynomial: NDArray[np.int32]
    sweep: NDArray[np.int32]
    count: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Sweeps:
        """The chosen sweeps, of the same devices."""
        columns = (f.name for f in fields(self) if f.name != "devices")
        return replace(self, **{name: getattr(self, name)[chosen] for name in columns})
