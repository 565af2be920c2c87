"""State and result of a recording, for the status line, the summary and ``--json``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from locatk.formats.sessions.capture_statistics import CaptureStatistics


@dataclass(frozen=True)
class CaptureStatus:
    """State of a recording, reported once per second."""

    elapsed_s: float
    away_s: float | None
    """Time since the connection was lost; None while it is open."""
    bytes_per_s: float
    frames_per_s: float
    totals: CaptureStatistics
    file_bytes: int
    free_bytes: int | None


@dataclass
class RecordingResult:
    """Result of a recording.

    Attributes
    ----------
    paths : list of path
        The files, in their order.
    ended : str
        Reason: ``"stopped"``, ``"duration"``, ``"max-size"``, ``"end of the source"``, or an error.
    rates : dict of str to float
        Records per second by topic, between the first and the last.
    failed : bool
        It was ended by an error.
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
