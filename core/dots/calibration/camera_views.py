"""Selection of the frames of a session that calibrate its camera, and of the dots in them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.camera_fit import CalibrationViews, homographies
from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.localization.frames import dot_correspondences, localize_frames
from locatk.core.dots.localization.recordings import OFF_SHEET, SHEET_SLACK_PITCHES, UNREADABLE
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, Manifest
from locatk.core.errors import DegenerateError, InputError

Array = NDArray[np.float64]

NO_PATTERN = "no_pattern"

MIN_CALIBRATION_FRAMES = 5
"""Least number of localized frames; fewer do not reveal a bad one."""

MAX_FITTED_FRAMES = 200
"""Maximum number of frames that are fitted; more add no information."""

MAX_LOCALIZED_FRAMES = 2 * MAX_FITTED_FRAMES
"""Number of localized frames from which the fitted ones are selected."""

MAX_EXAMINED_FRAMES = 1000
"""Maximum number of frames that are examined if many of them show no pattern."""

FRAMES_PER_BLOCK = 40
"""Number of frames that are in memory at once."""

MAX_DOTS_PER_FRAME = 250
"""Maximum number of dots of a frame that are fitted; a frame of the paper's camera has 180."""

MAX_SCALED_TILT = 3.0
"""Limit of the tilts, in standard deviations, when frames are compared."""

TIME_WEIGHT = 2.0
"""Weight of time, as a fraction of the session, when frames are compared."""


@dataclass(frozen=True)
class CalibrationFrame:
    """Dots of a localized frame.

    Attributes
    ----------
    index : int
        Of the frame.
    size : (width, height)
        In px.
    pixels : (m, 2) ndarray
        Observed positions in px.
    plane : (m, 2) ndarray
        Positions on the sheet as printed, in metres from any origin, x right, y down.
    """

    index: int
    size: tuple[int, int]
    pixels: Array
    plane: Array


Outcomes = dict[int, CalibrationFrame | str]
"""Dots of each examined frame, or the reason why it cannot be used, by index."""


def spread_order(count: int) -> list[int]:
    """Return 0 .. count - 1 in an order of which every first part is spread evenly over the range.

    The order is that of the fractional parts of multiples of the golden ratio.
    """
    return np.argsort(np.arange(count) * ((math.sqrt(5) - 1) / 2) % 1).tolist()


def examine_frames(
    frames: Frames,
    manifest: Manifest,
    code: Codec,
    order: Iterable[int],
    cameras: Sequence[Camera | None],
) -> Outcomes:
    """Localize frames in the given order, until there are :data:`MAX_LOCALIZED_FRAMES`.

    Parameters
    ----------
    frames, manifest, code
    order : iterable of int
        Indices of the frames to examine.
    cameras : sequence of Camera or None
        Cameras to try until one of them localizes a frame; None is an unknown lens.
    """
    outcomes: Outcomes = {}
    order = list(order)
    for start in range(0, len(order), FRAMES_PER_BLOCK):
        images: dict[int, NDArray[np.uint8]] = {}
        for index in order[start : start + FRAMES_PER_BLOCK]:
            outcomes[index] = NO_PATTERN
            try:
                images[index] = frames.images[index]
            except InputError:
                outcomes[index] = UNREADABLE
        for camera in dict.fromkeys(cameras):
            for index in _localizable(images, code, camera):
                image = images.pop(index)
                outcomes[index] = _measure_dots(index, image, manifest, code, camera)
        localized = sum(isinstance(outcome, CalibrationFrame) for outcome in outcomes.values())
        if localized >= MAX_LOCALIZED_FRAMES:
            break
    return outcomes


def _localizable(
    images: dict[int, NDArray[np.uint8]], code: Codec, camera: Camera | None
) -> list[int]:
    """Return the indices of images that can be localized, which is cheapest in batches."""
    indices: list[int] = []
    for shape in {image.shape for image in images.values()}:
        if camera is None or camera.size == shape[::-1]:
            batch = [index for index, image in images.items() if image.shape == shape]
            stack = np.stack([images[k] for k in batch])
            localized = localize_frames(stack, code, camera, other_codec_odds=0)
            indices += [batch[k] for k in np.flatnonzero(localized.accepted)]
    return sorted(indices)


def _measure_dots(
    index: int,
    image: NDArray[np.uint8],
    manifest: Manifest,
    code: Codec,
    camera: Camera | None,
) -> CalibrationFrame | str:
    """Return the dots of a frame with their positions on its sheet, or a reason."""
    height, width = image.shape
    for dots in dot_correspondences(image[None], code, camera, other_codec_odds=0):
        middle = dots.origin + dots.grid.mean(axis=0)
        number = int(manifest.find(middle[None], [[-1, -1]], slack=SHEET_SLACK_PITCHES)[0])
        if number < 0:
            return OFF_SHEET
        position = np.rint(dots.grid)
        printed_offset = manifest.offset_mm / manifest.pitch_mm
        offset = (dots.grid - position) * (printed_offset / DOT_OFFSET_PITCHES)
        # Lengths only: the rotation of a tile on its floor has no effect on a camera.
        pitch = np.linalg.norm(manifest.jacobian(number), axis=0)
        plane = (position + offset) * pitch
        selected = np.random.default_rng(index).permutation(len(plane))[:MAX_DOTS_PER_FRAME]
        return CalibrationFrame(index, (width, height), dots.pixels[selected], plane[selected])
    return NO_PATTERN


def frames_of_size(
    outcomes: Outcomes, indices: Iterable[int], size: tuple[int, int]
) -> list[CalibrationFrame]:
    """Return the localized frames of ``size`` among ``indices``."""
    candidates = (outcomes[index] for index in indices)
    return [
        frame for frame in candidates if isinstance(frame, CalibrationFrame) and frame.size == size
    ]


def common_size(outcomes: Outcomes, total: int) -> tuple[int, int]:
    """Return the most frequent size in px of the localized frames, of ``total`` frames.

    Raises
    ------
    DegenerateError
        Fewer than :data:`MIN_CALIBRATION_FRAMES` are localized.
    """
    sizes = Counter(
        frame.size for frame in outcomes.values() if isinstance(frame, CalibrationFrame)
    )
    size, count = sizes.most_common(1)[0] if sizes else ((0, 0), 0)
    if count >= MIN_CALIBRATION_FRAMES:
        return size
    reasons = Counter(outcome for outcome in outcomes.values() if isinstance(outcome, str))
    examined = f"of {len(outcomes)} frames"
    examined += f" (of {total})" if len(outcomes) < total else ""
    if reasons[OFF_SHEET] >= MIN_CALIBRATION_FRAMES:
        raise DegenerateError(
            f"{reasons[OFF_SHEET]} {examined} show the pattern off all sheets of the manifest",
            hint="Is it the manifest of another sheet?",
        )
    raise DegenerateError(
        f"{count or 'none'} {examined} show the pattern"
        + (f" at {size[0]} x {size[1]} px" if len(sizes) > 1 else "")
        + f", where {MIN_CALIBRATION_FRAMES} are needed",
        hint="Take sharp frames at several places of the sheet that the manifest describes",
    )


def select_diverse_frames(
    size: tuple[int, int], frames: list[CalibrationFrame], total: int
) -> list[CalibrationFrame]:
    """Return at most :data:`MAX_FITTED_FRAMES` that differ in heading, tilt and time.

    Each next frame is the one farthest from those already selected.
    """
    if len(frames) <= MAX_FITTED_FRAMES:
        return frames
    parameters = homographies(stack_views(size, frames))
    heading = np.arctan2(parameters[:, 3], parameters[:, 0])
    tilt = parameters[:, 6:] / np.maximum(np.std(parameters[:, 6:]), 1e-12)
    time = np.array([frame.index for frame in frames]) / total
    features = np.column_stack(
        [
            np.cos(heading),
            np.sin(heading),
            tilt.clip(-MAX_SCALED_TILT, MAX_SCALED_TILT),
            TIME_WEIGHT * time,
        ]
    )
    selected = [0]
    distance = np.full(len(frames), np.inf)
    while len(selected) < MAX_FITTED_FRAMES:
        to_last = np.linalg.norm(features - features[selected[-1]], axis=1)
        distance = np.minimum(distance, to_last)
        selected.append(int(np.argmax(distance)))
    return [frames[k] for k in sorted(selected)]


def stack_views(size: tuple[int, int], frames: Sequence[CalibrationFrame]) -> CalibrationViews:
    """Return the dots of frames as padded arrays."""
    most = max(len(frame.pixels) for frame in frames)
    pixels, plane = np.zeros((2, len(frames), most, 2))
    valid = np.zeros((len(frames), most), bool)
    for k, frame in enumerate(frames):
        count = len(frame.pixels)
        pixels[k, :count], plane[k, :count], valid[k, :count] = frame.pixels, frame.plane, True
    return CalibrationViews(size, pixels, plane, valid)
