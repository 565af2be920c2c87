"""Recordings of Lighthouse V2: decoded sweeps, edges of light, and reports on base stations."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final

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
        Time of each change, strictly ascending, in ticks of the recorder's clock since
        its start. The level changes with each.
    rate_hz : float
        Ticks per second: the sampling rate of a logic analyser, or 1e9 if times are given in
        nanoseconds.
    resolution_hz : float
        Resolution of the times, at most ``rate_hz``. An analyser that samples at 24 MHz and
        exports nanoseconds resolves 24 MHz.
    rises : bool
        True if the first change is from low to high.
    end_tick : int
        End of the recording: a tick after the last edge, or later.
    start_ns : int
        Time of tick 0, in nanoseconds since the Unix epoch; 0 if the recording has no date.
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
        """Duration of the recording in seconds, from tick 0 or from the first edge before it."""
        first = min(0, int(self.tick[0])) if len(self.tick) else 0
        return (self.end_tick - first) / self.rate_hz


UNKNOWN: Final = -1
"""Value of a polynomial, plane or slow bit that the source of a recording does not report."""


@dataclass(frozen=True)
class Sweeps:
    """Times at which sweeping light planes crossed photodiodes, in any order.

    Attributes
    ----------
    devices : tuple of str
        Names that ``device`` indexes.
    time_ns : (n,) int64 ndarray
        Time of reception, nanoseconds since the Unix epoch.
    device : (n,) int ndarray
        Index into ``devices``.
    sensor : (n,) int ndarray
        Number of the photodiode on its device, from 0.
    channel : (n,) int ndarray
        Channel of the base station, 1 to 16 (also called mode).
    polynomial : (n,) int ndarray
        LFSR polynomial 0 to 31, or -1 if the source does not report it.
    sweep : (n,) int ndarray
        0 for the first plane of a rotation, 1 for the second, -1 if the source does not
        report it. The planes are then distinguished by their counts.
    count : (n,) float64 ndarray
        LFSR index: steps of the 6 MHz bit clock since the rotor's zero. Fractional
        if it was refined by timing.
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

    def __repr__(self) -> str:
        return f"<Sweeps: {len(self)} of {len(self.devices)} devices>"

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Sweeps:
        """Select sweeps by a mask or by indices; ``devices`` stays the same."""
        columns = (f.name for f in fields(self) if f.name != "devices")
        return replace(self, **{name: getattr(self, name)[chosen] for name in columns})


@dataclass(frozen=True)
class StationReport:
    """Base station as observed in one recording.

    Attributes
    ----------
    channel : int
        1 to 16.
    id : int, optional
        Serial number, from its factory data (OOTX).
    period_ticks : float, optional
        Measured duration of a rotation, in ticks of 48 MHz of the recorder's clock.
    sweeps : int
        Number of decoded sweeps.
    missed : int, optional
        Number of sweeps that were received and not decoded; None if the source does not
        report it.
    calibration : Calibration, optional
        Calibration from the station's own factory data, if a complete frame was received.
    frames : int
        Number of frames of factory data with a valid checksum.
    damaged : int
        Number of frames with a wrong checksum. They are never used.
    acceleration : tuple of 3 int, optional
        Direction of its accelerometer as it transmits it (x right, y up, z back), from its
        factory data.
    """

    channel: int
    id: int | None = None
    period_ticks: float | None = None
    sweeps: int = 0
    missed: int | None = None
    calibration: Calibration | None = None
    frames: int = 0
    damaged: int = 0
    acceleration: tuple[int, int, int] | None = None

    @property
    def decode_rate(self) -> float | None:
        """Fraction of the received sweeps that were decoded, 0 to 1; None if unknown."""
        if self.missed is None or self.sweeps + self.missed == 0:
            return None
        return self.sweeps / (self.sweeps + self.missed)
