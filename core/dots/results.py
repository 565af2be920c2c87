"""Typed results of the dots solver: detections and outcomes per frame.

The names of JSON keys are stable (docs/formats.md).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DotDetection:
    """Frame with a pose: the position on a printed sheet that was decoded from it.

    Attributes
    ----------
    time_s : float
        Time of the frame, seconds since the epoch of the recording.
    frame : str
        Name of the frame.
    x_m, y_m : float
        Position of the camera's centre on the sheet, or on the floor if the manifest has the
        sheet's pose on it.
    heading_rad : float
        Direction of the image's right in the same frame, counter-clockwise from x.
    confidence : float
        Posterior probability of the position; with ``--method paper`` a quality.
    corrected_bits : int
        Bits of the dots that differ from the code at the decoded position.
    dots : int
        Dots on the grid.
    grid_x, grid_y : float
        Position of the camera's centre in pitches of the whole code, y down.
    sheet : str
        Identifier of the sheet in the manifest.
    """

    time_s: float
    frame: str
    x_m: float
    y_m: float
    heading_rad: float
    confidence: float
    corrected_bits: int
    dots: int
    grid_x: float
    grid_y: float
    sheet: str


@dataclass(frozen=True)
class FrameOutcome:
    """Result of decoding one frame, accepted or not.

    Attributes
    ----------
    time_s, frame, dots, corrected_bits, confidence
        As in :class:`DotDetection`.
    rejected : str or None
        Reason why the frame has no pose; None if it has one.
    """

    time_s: float
    frame: str
    dots: int
    corrected_bits: int
    confidence: float
    rejected: str | None


@dataclass(frozen=True)
class DotFacts:
    """Figures of a run of the dots solver.

    Attributes
    ----------
    frames : tuple of FrameOutcome
        All frames, camera by camera.
    """

    frames: tuple[FrameOutcome, ...] = ()
