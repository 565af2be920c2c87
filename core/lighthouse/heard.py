"""What a recording tells of each base station beside its sweeps."""

from __future__ import annotations

from dataclasses import dataclass

from locatk.core.lighthouse.calibration import Calibration


@dataclass(frozen=True)
class HeardStation:
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
