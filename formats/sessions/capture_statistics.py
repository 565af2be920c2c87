"""Metadata record of a recording: counts of the decoder and of losses."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any


@dataclass
class CaptureStatistics:
    """Counts since the start.

    Attributes
    ----------
    bytes, frames, bad, lost, skipped, unknown : int
        Counts of the decoder (:class:`locatk.formats.devices.interface.Counts`); of a camera, only
        ``bytes`` and ``frames``.
    gaps : int
        Number of times the connection was lost.
    gap_s : float
        Total time without connection.
    silences : int
        Number of times no data came for longer than allowed.
    overruns : int
        Bytes that the UART or the kernel's buffer lost, as counted by the kernel.
    dropped : int
        Frames of a camera that came faster than they could be encoded.
    line_errors : int
        Bytes without a stop bit or with wrong parity, as counted by the kernel.
    high_water_bytes : int
        Largest backlog between the port and the file.
    clock_step_s : float
        Time by which the wall clock was set meanwhile; the times of the recording did not change.
    samples : dict of str to int
        Records by topic.
    """

    bytes: int = 0
    frames: int = 0
    bad: int = 0
    lost: int = 0
    skipped: int = 0
    unknown: int = 0
    gaps: int = 0
    gap_s: float = 0.0
    silences: int = 0
    overruns: int = 0
    dropped: int = 0
    line_errors: int = 0
    high_water_bytes: int = 0
    clock_step_s: float = 0.0
    samples: dict[str, int] = field(default_factory=dict)

    def since(self, before: CaptureStatistics) -> CaptureStatistics:
        """Return the counts since ``before``; the largest backlog and the clock step are kept."""
        kept = ("high_water_bytes", "clock_step_s", "samples")
        counted = {
            each.name: getattr(self, each.name) - getattr(before, each.name)
            for each in fields(self)
            if each.name not in kept
        }
        samples = {
            topic: count - before.samples.get(topic, 0) for topic, count in self.samples.items()
        }
        return CaptureStatistics(
            **counted,
            high_water_bytes=self.high_water_bytes,
            clock_step_s=self.clock_step_s,
            samples=samples,
        )

    def losses(self) -> list[str]:
        """Return one phrase for each kind of loss."""
        counted = (
            (self.overruns, "byte overrun in the UART", "bytes overrun in the UART"),
            (self.dropped, "frame of the camera dropped", "frames of the camera dropped"),
            (self.line_errors, "byte with a line error", "bytes with line errors"),
            (self.bad, "bad frame", "bad frames"),
            (
                self.lost,
                "frame missing by its sequence number",
                "frames missing by their sequence numbers",
            ),
        )
        lost = [f"{count} {one if count == 1 else more}" for count, one, more in counted if count]
        if self.gaps:
            lost.insert(0, f"connection lost {_times(self.gaps)}, {self.gap_s:.1f} s in all")
        return lost

    def doubts(self, device: str) -> list[str]:
        """Return why no or few frames of the device were found in the data.

        ``device`` is ``""`` for a camera.
        """
        if not self.bytes:
            return ["no data were received"]
        if device == "raw":
            return []
        if not self.frames:
            return [f"no frame of {device or 'a known device'} in {self.bytes} bytes"]
        if 2 * self.skipped > self.bytes:
            return [f"{self.skipped} of {self.bytes} bytes are in no valid frame of {device}"]
        return []

    def texts(self) -> dict[str, str]:
        """Return the entries of a metadata record."""
        plain = asdict(self)
        samples = plain.pop("samples")
        return {
            **{key: _text(value) for key, value in plain.items()},
            **{f"samples:{topic}": str(count) for topic, count in samples.items()},
        }


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _text(value: Any) -> str:
    return f"{value:.6f}" if isinstance(value, float) else str(value)
