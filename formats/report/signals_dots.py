"""Camera frames: what the camera saw, and how surely it was decoded over time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.results import DotDetection, FrameOutcome
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError, LocatkError
from locatk.core.solution import Solution
from locatk.formats.artifacts import sheets
from locatk.formats.plots.ground import COLORS
from locatk.formats.plots.time_axis import origin_ns
from locatk.formats.report import detection_tables as seen_text
from locatk.formats.report import signals_drawing as drawing
from locatk.formats.report.detection_tables import words
from locatk.formats.report.figures import label
from locatk.formats.report.panel import Panel, Picture
from locatk.formats.report.signals_drawing import one_a_pixel
from locatk.formats.sessions import capture_record as captured
from locatk.formats.sessions import frames as camera_frames
from locatk.formats.sessions.reader import Session

PICTURES = 8
"""Frames that are shown, of all cameras together."""

REJECTED_SHOWN = 3
"""Reasons of rejection of which a frame is shown."""

WIDTH_PX = 376
"""About the width of a picture: the paper's frames twice as large as they are."""

RED, BLUE = (0, 94, 213), (178, 114, 0)
"""As OpenCV has them: blue, green, red."""


def panels(session: Session, solution: Solution) -> list[Panel]:
    """Some frames of each camera, and how all of them were decoded."""
    topics = sorted(
        topic
        for schema in camera_frames.SCHEMAS
        for topic in session.topics(camera_frames.TOPIC, schema)
    )
    if not topics:
        return []
    outcomes: tuple[FrameOutcome, ...] = () if solution.facts is None else solution.facts.frames
    notes = drawing.strangers(
        solution, [topic.removeprefix(camera_frames.TOPIC) for topic in topics]
    )
    found = []
    if not captured.is_few(session, topics):
        frames: list[Frames] = []
        notes.append("The recording is too large to look for single frames in it.")
    else:
        try:
            frames = camera_frames.read_frames(session)
        except LocatkError as error:
            frames = []
            notes.append(f"No frame can be shown: {error.message}.")
    for each, mine in zip(frames, _by_camera(frames, outcomes), strict=True):
        most = max(2, PICTURES // len(frames))
        found.append(_pictures(session, solution, each, mine, most))
    found.append(_over_time(session, solution, outcomes, notes))
    return found


def _by_camera(
    frames: Sequence[Frames], outcomes: Sequence[FrameOutcome]
) -> list[list[FrameOutcome | None]]:
    """What became of each frame of each camera, by its name and time."""
    known: dict[tuple[str, int | None], list[FrameOutcome]] = {}
    for each in reversed(outcomes):
        known.setdefault((each.frame, _ms(each.time_s)), []).append(each)
    found: list[list[FrameOutcome | None]] = []
    for camera in frames:
        mine: list[FrameOutcome | None] = []
        for name, time_ns in zip(camera.names, camera.time_ns.tolist(), strict=True):
            alike = known.get((name, _ms(time_ns * 1e-9)))
            mine.append(alike.pop() if alike else None)
        found.append(mine)
    return found


def _ms(time_s: float) -> int | None:
    """Time in milliseconds; None if a file of another tool has none."""
    return round(1e3 * time_s) if math.isfinite(time_s) else None


# ---- pictures


def _pictures(
    session: Session,
    solution: Solution,
    frames: Frames,
    outcomes: Sequence[FrameOutcome | None],
    most: int,
) -> Panel:
    name = f"Frames of {frames.device}"
    if not len(frames):
        return Panel(name, "There are none.")
    manifest = solution.artifact
    codec, camera = None, None
    if isinstance(manifest, Manifest):
        try:
            codec, camera = _codec(manifest), sheets.attached_camera(session)
        except LocatkError:
            codec = None
    shown, unreadable = [], []
    for k in _chosen(outcomes, most):
        try:
            image = frames.images[k]
        except LocatkError as error:
            unreadable.append(error.message)
            continue
        outcome = outcomes[k]
        decoded = outcome is not None and not outcome.rejected
        png = _png(image, codec if decoded else None, camera)
        seconds = (int(frames.time_ns[k]) - origin_ns(session, solution)) * 1e-9
        caption = f"frame {frames.names[k]}, {seconds:.2f} s: {_caption(outcome, solution)}"
        shown.append(Picture(png, caption))
    said = [
        f"{len(shown)} of {len(frames)} frames, spread over the recording, among them one of each "
        "reason of rejection. Circled are the dots that were decoded; the cross is the place that "
        "the pose tells."
    ]
    if unreadable:
        said.append(f"{len(unreadable)} more could not be read ({unreadable[0]}).")
    return Panel(name, " ".join(said), pictures=tuple(shown))


def _codec(manifest: Manifest) -> Codec:
    from locatk.core.dots.codec import codec

    return codec(manifest.codec)


def _chosen(outcomes: Sequence[FrameOutcome | None], most: int) -> list[int]:
    """Frames to show: one of each reason of rejection, then some that are spread over the rest."""
    reasons = [None if each is None else each.rejected for each in outcomes]
    rejected = [k for k, why in enumerate(reasons) if why and why not in reasons[:k]]
    if len(reasons) > 1 and len(rejected) > min(REJECTED_SHOWN, most - 1):
        rejected = rejected[: min(REJECTED_SHOWN, most - 1)]
    others = [k for k, why in enumerate(reasons) if not why]
    others = others or [k for k in range(len(reasons)) if k not in rejected]
    count = min(most - len(rejected), len(others))
    spread = np.linspace(0, len(others) - 1, count).round().astype(int).tolist()
    return sorted([*rejected, *(others[k] for k in dict.fromkeys(spread))])


def _png(image: NDArray[np.uint8], codec: Codec | None, camera: Camera | None) -> bytes:
    """A frame about :data:`WIDTH_PX` wide, with what was decoded in it where ``codec`` is given."""
    import cv2

    from locatk.core.dots.localization.frames import dot_correspondences

    height, width = image.shape
    scale = max(1, round(WIDTH_PX / width)) if width < WIDTH_PX else WIDTH_PX / width
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    way = cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA
    picture = cv2.cvtColor(cv2.resize(image, size, interpolation=way), cv2.COLOR_GRAY2BGR)
    fits = camera is None or camera.size == (width, height)
    if codec is not None and fits:
        try:
            seen = next(dot_correspondences(image[None], codec, camera), None)
        except InputError:
            seen = None
        for x, y in () if seen is None else (seen.pixels + 0.5) * scale:
            cv2.circle(picture, (round(x), round(y)), 5, BLUE, 1, cv2.LINE_AA)
        middle = ((width - 1) / 2, (height - 1) / 2) if camera is None else camera.centre_px
        at = (round((middle[0] + 0.5) * scale), round((middle[1] + 0.5) * scale))
        cv2.drawMarker(picture, at, RED, cv2.MARKER_CROSS, 17, 2, cv2.LINE_AA)
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1])


def _caption(outcome: FrameOutcome | None, solution: Solution) -> str:
    if outcome is None:
        return "not in the solution"
    if outcome.rejected:
        return f"rejected, {words(outcome.rejected)}; {outcome.dots} dots"
    key = outcome.frame, outcome.time_s
    detections: tuple[DotDetection, ...] = solution.detections
    found = next((each for each in detections if (each.frame, each.time_s) == key), None)
    place = (
        ""
        if found is None
        else f"at {seen_text.number(found.x_m, 1e3, '.2f')}, "
        f"{seen_text.number(found.y_m, 1e3, '.2f')} mm, {np.degrees(found.heading_rad):.1f} deg; "
    )
    return f"{place}{outcome.dots} dots, {outcome.corrected_bits} bits corrected"


# ---- numbers


def _over_time(
    session: Session, solution: Solution, outcomes: Sequence[FrameOutcome], notes: list[str]
) -> Panel:
    """Confidence, corrected bits and dots of all frames."""
    from plotly.subplots import make_subplots

    title = "Decoding over time"
    if not outcomes:
        return Panel(title, " ".join(["The solution does not tell of single frames.", *notes]))
    start = origin_ns(session, solution)
    time_s = np.array([each.time_s for each in outcomes]) - start * 1e-9
    reason = np.array([each.rejected or "" for each in outcomes], object)
    series = (
        ("confidence", "confidence [%]", 100.0),
        ("corrected_bits", "bits corrected", 1.0),
        ("dots", "dots on the grid", 1.0),
    )
    reasons = sorted(set(reason), key=lambda why: (why != "", why))
    figure = make_subplots(3, 1, shared_xaxes=True, vertical_spacing=0.05)
    thinned, traces = False, []
    for row, (key, what, scale) in enumerate(series, 1):
        value = scale * np.array([getattr(each, key) for each in outcomes], float)
        for k, why in enumerate(reasons):
            mine = np.flatnonzero((reason == why) & np.isfinite(value))
            if not len(mine):
                continue
            kept = mine[one_a_pixel(time_s[mine], value[mine])]
            thinned |= len(kept) < len(mine)
            name = label(words(why)) or "decoded"
            color = COLORS[k % len(COLORS)] if why else drawing.USED
            trace = drawing.scatter(
                time_s[kept], value[kept], row, mode="markers",
                marker={"color": color, "size": 4, "symbol": "x" if why else "circle"},
                name=f"{name} ({np.count_nonzero(reason == why)})",
                legendgroup=why, showlegend=row == 1,
                hovertemplate=f"%{{x:.2f}} s: %{{y:.6g}}<extra>{name}</extra>",
            )  # fmt: skip
            traces.append(trace)
        figure.update_yaxes(title=what, rangemode="tozero", row=row, col=1)
    figure.add_traces(traces)
    figure.update_xaxes(title="time [s]", row=3, col=1)
    drawing.style(figure, 520)
    said = ["Each mark is a frame."]
    if thinned:
        said.append("Thinned: where marks would hide each other one is drawn.")
    return Panel(title, " ".join([*said, *notes]), figure)
