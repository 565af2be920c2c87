"""Pictures of some frames of a camera, with the decoded dots."""

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
from locatk.formats.report.panels import Panel, Picture, format_value, reason_text
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


def picture_panel(
    session: Session,
    solution: Solution,
    frames: Frames,
    outcomes: Sequence[FrameOutcome | None],
    cameras: int,
) -> Panel:
    """Return some frames of one of several cameras, with the outcome of each frame (n,)."""
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
        decoded = next(
            dot_correspondences(image[None], sheet_codec, camera, other_codec_odds=0), None
        )
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
