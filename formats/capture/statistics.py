"""What a recording got, and what it lost: the numbers of the live line, of the metadata and
of ``--json``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

RECORD = "capture"
"""Name of the metadata record."""


@dataclass
class CaptureStatistics:
    """Counted since the start.

    Attributes
    ----------
    bytes, frames, bad, lost, skipped, unknown : int
        Of the decoder: :class:`locatk.formats.devices.decoder.Counts`; of a camera, ``frames``.
    gaps : int
        How often the connection was lost.
    gap_s : float
        For how long in all.
    silences : int
        How often nothing came for longer than was allowed.
    overruns : int
        Bytes that the kernel says a UART lost.
    dropped : int
        Frames of a camera that came faster than they could be packed.
    line_errors : int
        Bytes without a stop bit or of wrong parity, by the kernel.
    high_water_bytes : int
        Most that waited between the port and the file.
    clock_step_s : float
        By how much the wall clock was set meanwhile; the times here did not follow.
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
        """What was counted since ``before``; the high water and the clock's step are not
        counts and stay."""
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
        """What was lost, one phrase each; empty where nothing was."""
        counted = (
            (self.overruns, "byte overrun in the UART", "bytes overrun in the UART"),
            (self.dropped, "frame of the camera dropped", "frames of the camera dropped"),
            (self.line_errors, "byte with a line error", "bytes with line errors"),
            (self.bad, "bad frame", "bad frames"),
            (self.lost, "frame missing by its number", "frames missing by their numbers"),
        )
        lost = [f"{count} {one if count == 1 else more}" for count, one, more in counted if count]
        if self.gaps:
            lost.insert(0, f"connection lost {_times(self.gaps)}, {self.gap_s:.1f} s in all")
        return lost

    def doubts(self, device: str) -> list[str]:
        """Why nothing, or little, could be made of what came from a device of this kind; ``""``
        for a camera."""
        if not self.bytes:
            return ["nothing was received"]
        if device == "raw":
            return []
        if not self.frames:
            return [f"no frame of {device or 'a device that is known'} in {self.bytes} bytes"]
        if 2 * self.skipped > self.bytes:
            return [f"{self.skipped} of {self.bytes} bytes are in no frame of {device}"]
        return []

    def texts(self) -> dict[str, str]:
        """As entries of a metadata record."""
        plain = asdict(self)
        samples = plain.pop("samples")
        return {
            **{key: _text(value) for key, value in plain.items()},
            **{f"samples:{topic}": str(count) for topic, count in samples.items()},
        }


@dataclass(frozen=True)
class CaptureStatus:
    """How it goes, once a second."""

    elapsed_s: float
    away_s: float | None
    """For how long the connection has been lost; None while it is there."""
    bytes_per_s: float
    frames_per_s: float
    totals: CaptureStatistics
    file_bytes: int
    free_bytes: int | None


@dataclass
class RecordingResult:
    """What came of a recording.

    Attributes
    ----------
    paths : list of path
        The files, in their order.
    ended : str
        Why: ``"stopped"``, ``"duration"``, ``"max-size"``, ``"end of the source"``, or what
        went wrong.
    rates : dict of str to float
        Records a second by topic, from the first to the last.
    failed : bool
        Whether it ended for something that went wrong.
    """

    totals: CaptureStatistics
    paths: list[Path]
    device: str
    started_ns: int
    ended_ns: int
    ended: str
    failed: bool
    system: str
    artifacts: list[str]
    clocks: dict[str, str]
    rates: dict[str, float]
    file_bytes: int = 0


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _text(value: Any) -> str:
    return f"{value:.6f}" if isinstance(value, float) else str(value)
