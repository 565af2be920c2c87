"""Localization of frames on the grid: detect dots, identify the window, estimate the pose.

Frames are independent, so that the first one is as reliable as the thousandth. (The peer
cellulo-localization, commit 894f0d0, needs several frames until its vote on the orientation has
settled.) Batches save time. A frame is decoded in a window as large as the largest of its batch
needs, which decides whether the searches for small windows are used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec
from locatk.core.dots.detection.blobs import DetectedDots, detect_dots_halved
from locatk.core.dots.detection.lattice import MIN_LATTICE_DOTS, DotLattices, fit_lattices
from locatk.core.dots.identification.decoding import (
    MIN_CODE_CONFIDENCE,
    MIN_CONFIDENCE,
    OTHER_CODEC_ODDS,
    DecodedWindows,
    identify_windows,
)
from locatk.core.dots.identification.soft_bits import soft_bits, window_half_width
from locatk.core.dots.localization.pose import GridPoses, assign_dots, localize_windows
from locatk.core.errors import InputError

Images = NDArray[np.uint8]

FRAMES_PER_BATCH = 32
"""Number of frames that are processed at once; their data fit into the cache."""

MIN_SIDE_PX = 48
"""Least side of a frame [px]; a smaller one cannot contain a window of the pattern."""

PREFERRED_SIDE_PX = 120
"""Short side of a frame [px] at which the pattern is searched first: the paper's frames at full
size, those of twice their size at half size, and so on."""

MIN_TRIED_LEVELS = 4
"""Number of sizes that are tried, each half of the previous one; more if the preferred one is
smaller still."""

SETTLED_FRACTION = 0.9
"""Fraction of the detected dots of a frame in its window beyond which another lattice of the same
dots does not decide between codecs."""

TOO_FEW_DOTS = "too_few_dots"
NO_GRID = "no_grid"
NO_CODE = "no_code"
LOW_CONFIDENCE = "low_confidence"
SECTION_BORDER = "section_border"


@dataclass(frozen=True)
class LocalizedFrames:
    """Poses of n frames on the grid, or the reasons of their rejection.

    Of a rejected frame, only dots, corrected and confidence are meaningful; grid and section too if
    it is off the sheets.

    Attributes
    ----------
    grid : (n, 2) float64 ndarray
        Grid coordinates of the camera's centre.
    section : (n, 2) int64 ndarray
    heading : (n,) float64 ndarray
        From the sheet's x axis to the image's right, counter-clockwise, in rad.
    covariance : (n, 3, 3) float64 ndarray
        Of x, y (pitches, y down) and heading (rad); nan if unknown.
    dots, corrected : (n,) int64 ndarray
        Dots on the grid, and wrong bits among theirs.
    confidence : (n,) float64 ndarray
        Probability that the position is right.
    rejected : (n,) object ndarray of str
        Reason of rejection; ``""`` if the frame is localized.
    ambiguous : (n,) bool ndarray
        Whether only another codec, which has nearly all of the frame's dots at another position,
        limits the confidence, so that another lattice of these dots is of no use.
    """

    grid: NDArray[np.float64]
    section: NDArray[np.int64]
    heading: NDArray[np.float64]
    covariance: NDArray[np.float64]
    dots: NDArray[np.int64]
    corrected: NDArray[np.int64]
    confidence: NDArray[np.float64]
    rejected: NDArray[np.object_]
    ambiguous: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.rejected)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Whether each frame (n,) is localized."""
        result: NDArray[np.bool_] = self.rejected == ""
        return result

    def update(self, indices: NDArray[np.int64], part: LocalizedFrames) -> None:
        """Store ``part`` for the ``indices`` that it localizes or has no less confidence in."""
        better = part.accepted | (part.confidence >= self.confidence[indices])
        for field in fields(LocalizedFrames):
            getattr(self, field.name)[indices[better]] = getattr(part, field.name)[better]

    def replace(self, index: int, part: LocalizedFrames) -> None:
        """Store the single frame of ``part`` at ``index``."""
        for field in fields(LocalizedFrames):
            getattr(self, field.name)[index] = getattr(part, field.name)[0]


def unlocalized_frames(n: int, reason: str) -> LocalizedFrames:
    """Return n frames that are all rejected for ``reason``."""
    return LocalizedFrames(
        grid=np.full((n, 2), np.nan),
        section=np.full((n, 2), -1, np.int64),
        heading=np.full(n, np.nan),
        covariance=np.full((n, 3, 3), np.nan),
        dots=np.zeros(n, np.int64),
        corrected=np.zeros(n, np.int64),
        confidence=np.zeros(n),
        rejected=np.full(n, reason, object),
        ambiguous=np.zeros(n, np.bool_),
    )


def localize_frames(
    images: Images,
    codec: Codec,
    camera: Camera | None = None,
    *,
    min_confidence: float = MIN_CONFIDENCE,
    other_codec_odds: float = OTHER_CODEC_ODDS,
) -> LocalizedFrames:
    """Estimate position and heading of grey frames (n, h, w) of one camera.

    Without a ``camera`` its centre is the middle of the frame, and the distortion of its lens is
    estimated in each frame. ``other_codec_odds`` are the prior odds that the sheet is one of
    another known codec, which may have the same dots at another position; 0 if the codec is
    certain.

    Raises
    ------
    InputError
        The frames do not have 8 bits per pixel.
    """
    if images.dtype != np.uint8:
        raise InputError(f"frames of {images.dtype}, not of 8 bits a pixel")
    n, height, width = images.shape
    result = unlocalized_frames(n, TOO_FEW_DOTS)
    if min(height, width) < MIN_SIDE_PX:
        return result
    for start in range(0, n, FRAMES_PER_BATCH):
        remaining = np.arange(start, min(start + FRAMES_PER_BATCH, n))
        for level in tried_levels(height, width):
            points, dots = _detect_points(images[remaining], camera, level)
            part, _, _ = _localize_dots(
                points, dots, codec, camera is None, min_confidence, other_codec_odds
            )
            if part.accepted.all():
                result.update(remaining, part)
                break
            # Strong tilt, strong distortion and covered frames take longer than all others.
            is_tried = part.accepted | part.ambiguous | (part.rejected == TOO_FEW_DOTS)
            again = np.flatnonzero(~is_tried)
            if len(again):
                thorough, _, _ = _localize_dots(
                    points[again],
                    DetectedDots(dots.xy[again], dots.valid[again]),
                    codec,
                    camera is None,
                    min_confidence,
                    other_codec_odds,
                    is_thorough=True,
                )
                part.update(again, thorough)
            result.update(remaining, part)
            remaining = remaining[~result.accepted[remaining]]
            if not len(remaining):
                break
    return result


def _detect_points(
    images: Images, camera: Camera | None, level: int
) -> tuple[NDArray[np.float32], DetectedDots]:
    """Detect the dots of frames at a size that is halved ``level`` times.

    Return also their positions (n, m, 2) without known distortion, in half diagonals from the
    centre of the camera.
    """
    _, height, width = images.shape
    dots = detect_dots_halved(images, level)
    pixels = dots.xy.astype(np.float64)
    centre, half_diagonal = _normalization(height, width, camera)
    if camera is not None and camera.radial:
        pixels = camera.undistort(pixels)
    return ((pixels - centre) / half_diagonal).astype(np.float32), dots


def _localize_dots(
    points: NDArray[np.float32],
    dots: DetectedDots,
    codec: Codec,
    lens: bool,
    min_confidence: float,
    other_codec_odds: float,
    *,
    is_thorough: bool = False,
) -> tuple[LocalizedFrames, DotLattices, DecodedWindows | None]:
    """Localize frames by their dots; return also the lattices and windows of those with a grid."""
    lattices = fit_lattices(points, dots.valid, lens=lens, is_thorough=is_thorough)
    if not lattices.fitted.all():
        frames = unlocalized_frames(len(points), NO_GRID)
        frames.rejected[dots.counts < MIN_LATTICE_DOTS] = TOO_FEW_DOTS
        fitted = np.flatnonzero(lattices.fitted)
        if not len(fitted):
            return frames, lattices, None
        part, lattices, windows = _localize_lattices(
            lattices.select(fitted),
            codec,
            min_confidence,
            other_codec_odds,
            is_thorough=is_thorough,
        )
        frames.update(fitted, part)
        return frames, lattices, windows
    return _localize_lattices(
        lattices, codec, min_confidence, other_codec_odds, is_thorough=is_thorough
    )


def _localize_lattices(
    lattices: DotLattices,
    codec: Codec,
    min_confidence: float,
    other_codec_odds: float,
    *,
    is_thorough: bool,
) -> tuple[LocalizedFrames, DotLattices, DecodedWindows]:
    """Localize frames that all have a lattice."""
    half = window_half_width(lattices)
    bits = soft_bits(lattices, half)
    windows = identify_windows(
        *bits, codec, is_thorough=is_thorough, other_codec_odds=other_codec_odds
    )
    rejected = np.full(len(windows.confidence), "", object)
    rejected[windows.confidence < min_confidence] = LOW_CONFIDENCE
    rejected[windows.confidence < MIN_CODE_CONFIDENCE] = NO_CODE
    rejected[(rejected != "") & windows.border] = SECTION_BORDER
    certain = windows.confidence >= min_confidence * (1 - windows.confidence * windows.rival_odds)
    is_covered = windows.dots > SETTLED_FRACTION * lattices.valid.sum(axis=1)
    is_covered &= windows.corrected == 0  # wrong bits may be those of a poor lattice
    poses = _localize_decoded(lattices, half, windows, codec)
    frames = LocalizedFrames(
        grid=poses.grid,
        section=windows.section,
        heading=poses.heading,
        covariance=poses.covariance,
        dots=windows.dots,
        corrected=windows.corrected,
        confidence=windows.confidence,
        rejected=rejected,
        ambiguous=certain & is_covered & (rejected != ""),
    )
    return frames, lattices, windows


def _localize_decoded(
    lattices: DotLattices, half: int, windows: DecodedWindows, codec: Codec
) -> GridPoses:
    """Estimate the poses of windows that contain the code; those of others are nan."""
    has_code = windows.confidence >= MIN_CODE_CONFIDENCE
    if has_code.all():
        return localize_windows(lattices, half, windows, codec)
    n = len(has_code)
    poses = GridPoses(np.full((n, 2), np.nan), np.full(n, np.nan), np.full((n, 3, 3), np.nan))
    decoded = np.flatnonzero(has_code)
    if len(decoded):
        part = localize_windows(lattices.select(decoded), half, windows.select(decoded), codec)
        for field in fields(GridPoses):
            getattr(poses, field.name)[decoded] = getattr(part, field.name)
    return poses


def tried_levels(height: int, width: int) -> list[int]:
    """Return the numbers of halvings of the frame to try, the most suitable first."""
    short = min(height, width)
    preferred = max(0, round(math.log2(short / PREFERRED_SIDE_PX)))
    levels = range(max(MIN_TRIED_LEVELS, preferred + 1))
    possible = [level for level in levels if short >> level >= MIN_SIDE_PX]
    return sorted(possible, key=lambda level: (abs(level - preferred), level))


def _normalization(
    height: int, width: int, camera: Camera | None
) -> tuple[NDArray[np.float64], float]:
    """Return the centre of the camera in px, and half the diagonal of a frame in px."""
    centre = ((width - 1) / 2, (height - 1) / 2) if camera is None else camera.centre_px
    return np.array(centre), math.hypot(width, height) / 2


# ---- correspondences for calibration


@dataclass(frozen=True)
class DotCorrespondences:
    """Dots of one localized frame, with their positions on the grid.

    Attributes
    ----------
    pixels : (m, 2) float64 ndarray
        In the frame, with distortion.
    grid : (m, 2) float64 ndarray
        Grid coordinates of the dot itself, with its offset, relative to :attr:`origin`.
    origin, section : (2,) int64 ndarray
    """

    pixels: NDArray[np.float64]
    grid: NDArray[np.float64]
    origin: NDArray[np.int64]
    section: NDArray[np.int64]


def dot_correspondences(
    images: Images,
    codec: Codec,
    camera: Camera | None = None,
    *,
    other_codec_odds: float = OTHER_CODEC_ODDS,
) -> Iterator[DotCorrespondences]:
    """Yield the dots of each frame of ``images`` (n, h, w) that can be localized.

    ``other_codec_odds`` are those of :func:`localize_frames`.
    """
    _, height, width = images.shape
    centre, half_diagonal = _normalization(height, width, camera)
    for image in images:
        for level, is_thorough in itertools.product(tried_levels(height, width), (False, True)):
            points, detected = _detect_points(image[None], camera, level)
            frame, lattices, windows = _localize_dots(
                points,
                detected,
                codec,
                camera is None,
                MIN_CONFIDENCE,
                other_codec_odds,
                is_thorough=is_thorough,
            )
            if windows is None or not frame.accepted[0]:
                continue
            dots = assign_dots(lattices, window_half_width(lattices), windows, codec)
            used = dots.used[0]
            pixels = lattices.points[0, used] * half_diagonal + centre
            if camera is not None:
                pixels = camera.distort(pixels)
            yield DotCorrespondences(
                pixels, dots.target[0, used], dots.origin[0], windows.section[0]
            )
            break
