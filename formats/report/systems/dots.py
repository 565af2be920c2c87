"""Signals of cameras: some frames, and how all of them were decoded."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import dot_correspondences
from locatk.core.dots.results import DotDetection, FrameOutcome
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError, LocatkError
from locatk.core.solution import Solution
from locatk.formats.artifacts import sheets
from locatk.formats.plots.series import origin_ns
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.diagrams import MARKS_THINNED, USED, Diagrams
from locatk.formats.report.panels import (
    Panel,
    Picture,
    escape,
    format_value,
    join_sentences,
    reason_text,
)
from locatk.formats.report.signals import missing_devices_note
from locatk.formats.sessions import capture_record
from locatk.formats.sessions import frames as camera_frames
from locatk.formats.sessions.reader import Session

Image = NDArray[np.uint8]

MAX_PICTURES = 8
"""Number of frames that are shown, of all cameras together."""

MIN_PICTURES_PER_CAMERA = 2
"""Number of frames that are shown of each camera, however many cameras there are."""

MAX_REJECTED_PICTURES = 3
"""Number of reasons of rejection of which a frame is shown."""

PICTURE_WIDTH_PX = 376
"""Approximate width of a picture: twice that of the frames of the published camera (188 pixels)."""

CROSS_BGR, DOT_BGR = (0, 94, 213), (178, 114, 0)
"""Colors of the position and of decoded dots, as blue, green, red."""

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
        _picture_panel(session, solution, frames, frame_outcomes, len(cameras))
        for frames, frame_outcomes in zip(cameras, _match_outcomes(cameras, outcomes), strict=True)
    ]
    return [*panels, _draw_decoding(outcomes, origin_ns(session, solution), notes)]


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


# ---- pictures


def _picture_panel(
    session: Session,
    solution: Solution,
    frames: Frames,
    outcomes: Sequence[FrameOutcome | None],
    cameras: int,
) -> Panel:
    title = f"Frames of {frames.device}"
    if not len(frames):
        return Panel(title, "There are none.")
    sheet_codec, camera = _decoder(session, solution)
    pictures, problems = [], []
    limit = max(MIN_PICTURES_PER_CAMERA, MAX_PICTURES // cameras)
    for k in _select_frames(outcomes, limit):
        try:
            image = frames.images[k]
        except LocatkError as error:
            problems.append(error.message)
            continue
        outcome = outcomes[k]
        is_decoded = outcome is not None and not outcome.rejected
        png = _draw_frame(image, sheet_codec if is_decoded else None, camera)
        seconds = (int(frames.time_ns[k]) - origin_ns(session, solution)) * 1e-9
        caption = f"frame {frames.names[k]}, {seconds:.2f} s: {_describe(outcome, solution)}"
        pictures.append(Picture(png, caption))
    note = (
        f"{len(pictures)} of {len(frames)} frames, spread over the recording, including one for "
        "each reason of rejection. Circles are decoded dots; the cross is the position of the pose."
    )
    if problems:
        note += f" {len(problems)} more could not be read ({problems[0]})."
    return Panel(title, note, pictures=tuple(pictures))


def _decoder(session: Session, solution: Solution) -> tuple[Codec | None, Camera | None]:
    """Return the codec of the sheets and the camera, as far as they are known."""
    if not isinstance(solution.artifact, Manifest):
        return None, None
    try:
        return codec(solution.artifact.codec), sheets.attached_camera(session)
    except LocatkError:
        return None, None


def _select_frames(outcomes: Sequence[FrameOutcome | None], limit: int) -> list[int]:
    """Return the indices of one frame per reason of rejection, and of others spread evenly."""
    reasons = [None if outcome is None else outcome.rejected for outcome in outcomes]
    rejected = [k for k, reason in enumerate(reasons) if reason and reason not in reasons[:k]]
    if len(reasons) > 1:
        rejected = rejected[: min(MAX_REJECTED_PICTURES, limit - 1)]
    others = [k for k, reason in enumerate(reasons) if not reason]
    others = others or [k for k in range(len(reasons)) if k not in rejected]
    count = min(limit - len(rejected), len(others))
    spread = np.linspace(0, len(others) - 1, count).round().astype(int).tolist()
    return sorted([*rejected, *(others[k] for k in dict.fromkeys(spread))])


def _draw_frame(image: Image, sheet_codec: Codec | None, camera: Camera | None) -> bytes:
    """Return a frame as PNG, with its decoded dots if there is a codec."""
    height, width = image.shape
    scale = PICTURE_WIDTH_PX / width
    if scale > 1:
        scale = max(1, round(scale))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    method = cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA
    picture = cv2.cvtColor(cv2.resize(image, size, interpolation=method), cv2.COLOR_GRAY2BGR)
    if sheet_codec is not None and (camera is None or camera.size == (width, height)):
        for x, y in (_decoded_dots(image, sheet_codec, camera) + 0.5) * scale:
            cv2.circle(picture, (round(x), round(y)), 5, DOT_BGR, 1, cv2.LINE_AA)
        centre = ((width - 1) / 2, (height - 1) / 2) if camera is None else camera.centre_px
        position = (round((centre[0] + 0.5) * scale), round((centre[1] + 0.5) * scale))
        cv2.drawMarker(picture, position, CROSS_BGR, cv2.MARKER_CROSS, 17, 2, cv2.LINE_AA)
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1])


def _decoded_dots(image: Image, sheet_codec: Codec, camera: Camera | None) -> NDArray[np.float64]:
    """Return the pixels (n, 2) of the decoded dots of a frame."""
    try:
        decoded = next(dot_correspondences(image[None], sheet_codec, camera), None)
    except InputError:
        decoded = None
    return np.zeros((0, 2)) if decoded is None else decoded.pixels


def _describe(outcome: FrameOutcome | None, solution: Solution) -> str:
    if outcome is None:
        return "not in the solution"
    if outcome.rejected:
        return f"rejected, {reason_text(outcome.rejected)}; {outcome.dots} dots"
    key = outcome.frame, outcome.time_s
    detections: tuple[DotDetection, ...] = solution.detections
    detection = next((each for each in detections if (each.frame, each.time_s) == key), None)
    position = ""
    if detection is not None:
        x, y = (format_value(value, 1e3, ".2f") for value in (detection.x_m, detection.y_m))
        position = f"at {x}, {y} mm, {math.degrees(detection.heading_rad):.1f} deg; "
    return f"{position}{outcome.dots} dots, {outcome.corrected_bits} bits corrected"


# ---- quality of decoding


def _draw_decoding(outcomes: Sequence[FrameOutcome], start_ns: int, notes: Sequence[str]) -> Panel:
    """Draw confidence, corrected bits and dots of all frames, by reason of rejection."""
    title = "Decoding over time"
    if not outcomes:
        return Panel(title, join_sentences("The solution has no data of single frames.", *notes))
    time_s = np.array([outcome.time_s for outcome in outcomes]) - start_ns * 1e-9
    reason = np.array([outcome.rejected or "" for outcome in outcomes], object)
    diagrams = Diagrams(len(TIME_ROWS), shared_xaxes=True, vertical_spacing=0.05)
    for row, (_, field, scale) in enumerate(TIME_ROWS, 1):
        value = scale * np.array([getattr(outcome, field) for outcome in outcomes], float)
        for k, code in enumerate(sorted(set(reason))):  # Decoded frames ("") are first.
            selected = np.flatnonzero((reason == code) & np.isfinite(value))
            if not len(selected):
                continue
            name = escape(reason_text(code)) or "decoded"
            color = COLORS[k % len(COLORS)] if code else USED
            diagrams.add_marks(
                row,
                time_s[selected],
                value[selected],
                marker={"color": color, "size": 4, "symbol": "x" if code else "circle"},
                name=f"{name} ({np.count_nonzero(reason == code)})",
                legendgroup=code,
                showlegend=row == 1,
                hovertemplate=f"%{{x:.2f}} s: %{{y:.6g}}<extra>{name}</extra>",
            )
    diagrams.figure.update_yaxes(rangemode="tozero")
    thinned = MARKS_THINNED if diagrams.has_thinned_marks else ""
    return Panel(
        title,
        join_sentences("Each mark is a frame.", thinned, *notes),
        diagrams.finish(520, [row_title for row_title, _, _ in TIME_ROWS]),
    )
