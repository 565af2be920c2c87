"""Signals of cameras: some frames, and how all of them were decoded."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from locatk.core.dots.frames import Frames
from locatk.core.dots.results import FrameOutcome
from locatk.core.errors import LocatkError
from locatk.core.solution import Solution
from locatk.formats.plots.series import origin_ns
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.diagram_grid import USED, DiagramGrid
from locatk.formats.report.frame_pictures import picture_panel
from locatk.formats.report.panels import Panel, escape, join_sentences, reason_text
from locatk.formats.report.signals import missing_devices_note
from locatk.formats.sessions import capture_record
from locatk.formats.sessions import frames as camera_frames
from locatk.formats.sessions.reader import Session

TIME_ROWS = (
    ("confidence [%]", "confidence", 100.0),
    ("bits corrected", "corrected_bits", 1.0),
    ("dots on the grid", "dots", 1.0),
)
"""Title, field of a :class:`FrameOutcome` and scale of each diagram."""


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return some frames of each camera, and the quality of decoding of all frames."""
    topics = sorted(
        topic
        for schema in camera_frames.SCHEMAS
        for topic in session.topics(camera_frames.TOPIC, schema)
    )
    if not topics:
        return []
    outcomes: tuple[FrameOutcome, ...] = () if solution.facts is None else solution.facts.frames
    devices = [topic.removeprefix(camera_frames.TOPIC) for topic in topics]
    notes = [missing_devices_note(solution, devices)]
    cameras: list[Frames] = []
    if not capture_record.is_few(session, topics):
        notes.append("The recording is too large to search for single frames.")
    else:
        try:
            cameras = camera_frames.read_frames(session)
        except LocatkError as error:
            notes.append(f"No frame can be shown: {error.message}.")
    panels = [
        picture_panel(session, solution, frames, frame_outcomes, len(cameras))
        for frames, frame_outcomes in zip(cameras, _match_outcomes(cameras, outcomes), strict=True)
    ]
    return [*panels, _decoding_panel(outcomes, origin_ns(session, solution), notes)]


def _match_outcomes(
    cameras: Sequence[Frames], outcomes: Sequence[FrameOutcome]
) -> list[list[FrameOutcome | None]]:
    """Return the outcome of each frame of each camera, by name and time."""
    by_key: dict[tuple[str, int | None], list[FrameOutcome]] = {}
    for outcome in reversed(outcomes):
        by_key.setdefault((outcome.frame, _milliseconds(outcome.time_s)), []).append(outcome)
    matched: list[list[FrameOutcome | None]] = []
    for frames in cameras:
        keys = (
            (name, _milliseconds(time_ns * 1e-9))
            for name, time_ns in zip(frames.names, frames.time_ns.tolist(), strict=True)
        )
        matched.append([by_key[key].pop() if by_key.get(key) else None for key in keys])
    return matched


def _milliseconds(time_s: float) -> int | None:
    """Return a time in milliseconds, None if a file of another program contains none."""
    return round(1e3 * time_s) if math.isfinite(time_s) else None


def _decoding_panel(outcomes: Sequence[FrameOutcome], start_ns: int, notes: Sequence[str]) -> Panel:
    """Draw confidence, corrected bits and dots of all frames, by reason of rejection."""
    title = "Decoding over time"
    if not outcomes:
        return Panel(title, join_sentences("The solution has no data of single frames.", *notes))
    time_s = np.array([outcome.time_s for outcome in outcomes]) - start_ns * 1e-9
    reason = np.array([outcome.rejected or "" for outcome in outcomes], object)
    grid = DiagramGrid(len(TIME_ROWS), shared_xaxes=True, vertical_spacing=0.05)
    for row, (_, field, scale) in enumerate(TIME_ROWS, 1):
        value = scale * np.array([getattr(outcome, field) for outcome in outcomes], float)
        for k, code in enumerate(sorted(set(reason))):  # Decoded frames ("") are first.
            is_drawn = (reason == code) & np.isfinite(value)
            name = escape(reason_text(code)) or "decoded"
            grid.add_marks(
                row,
                time_s[is_drawn],
                value[is_drawn],
                {
                    "color": COLORS[k % len(COLORS)] if code else USED,
                    "size": 4,
                    "symbol": "x" if code else "circle",
                },
                name=f"{name} ({np.count_nonzero(reason == code)})",
                legendgroup=code,
                showlegend=row == 1,
                hovertemplate=f"%{{x:.2f}} s: %{{y:.6g}}<extra>{name}</extra>",
            )
    grid.figure.update_yaxes(rangemode="tozero")
    note = join_sentences("Each mark is a frame.", grid.thinning_note, *notes)
    return Panel(title, note, grid.finish(520, [row_title for row_title, _, _ in TIME_ROWS]))
