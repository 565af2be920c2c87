"""Recordings of Lighthouse V2: decoded sweeps, edges of light, and reports on base stations."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration

NANOSECONDS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class Edges:
    """Changes of one photodiode's data line.

    Attributes
    ----------
    tick : (n,) int64 ndarray
        When each change was, strictly ascending, in ticks of the recorder's clock since
        its start; the level changes with each.
    rate_hz : float
        Ticks a second: the sampling rate of a logic analyser, 1e9 where times are given in
        nanoseconds.
    resolution_hz : float
        What the times resolve, at most ``rate_hz``: an analyser that samples at 24 MHz and
        tells nanoseconds resolves 24 MHz.
    rises : bool
        Whether the first change is from low to high.
    end_tick : int
        End of the recording; a tick after the last edge, or later.
    start_ns : int
        Tick 0, in nanoseconds since the epoch; 0 where the recording does not tell.
    """

    tick: NDArray[np.int64]
    rate_hz: float
    resolution_hz: float
    rises: bool
    end_tick: int
    start_ns: int = 0

    def __len__(self) -> int:
        return len(self.tick)

    @property
    def duration_s(self) -> float:
        """Length of the recording in seconds, from tick 0 or the first edge before it."""
        first = min(0, int(self.tick[0])) if len(self.tick) else 0
        return (self.end_tick - first) / self.rate_hz


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


@dataclass(frozen=True)
class StationReport:
    """A base station as one recording heard it.

    Attributes
    ----------
    channel : int
        1 to 16.
    id : int, optional
        Serial number, from its factory data (OOTX).
    period_ticks : float, optional
        Measured length of a rotation, in ticks of 48 MHz of the recorder's clock.
    sweeps : int
        Sweeps that were decoded.
    missed : int, optional
        Sweeps of it that were received and not decoded; None where the source does not tell.
    calibration : Calibration, optional
        From its own factory data, where a frame arrived whole.
    frames : int
        Frames of factory data whose checksum was right.
    damaged : int
        Frames whose checksum was wrong; they are never used.
    """

    channel: int
    id: int | None = None
    period_ticks: float | None = None
    sweeps: int = 0
    missed: int | None = None
    calibration: Calibration | None = None
    frames: int = 0
    damaged: int = 0

    @property
    def decode_rate(self) -> float | None:
        """Share of the received sweeps that were decoded, 0 to 1."""
        if self.missed is None or self.sweeps + self.missed == 0:
            return None
        return self.sweeps / (self.sweeps + self.missed)
