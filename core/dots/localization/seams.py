"""Poses of frames that show several sheets.

A frame across a seam is rejected, or the dots of the smaller part displace the pose by up to 0.1
mm. Here, the sheets are separated (:mod:`.separation`), and the pose is estimated from the dots of
one of them, by the same estimator as that of other frames (:mod:`.pose`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.identification.decoding import DecodedWindows, identify_windows
from locatk.core.dots.identification.soft_bits import soft_bits, window_half_width
from locatk.core.dots.localization.frames import (
    LOW_CONFIDENCE,
    NO_CODE,
    NO_GRID,
    LocalizedFrames,
    unlocalized_frames,
)
from locatk.core.dots.localization.pose import localize_windows
from locatk.core.dots.localization.separation import (
    MIN_SHEET_DOTS,
    NO_SYMBOL,
    SheetView,
    lattice_of,
    padded_symbols,
    separate_sheets,
)
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import DegenerateError
from locatk.core.geometry import fit_homography


def relocalize_at_seams(
    frames: Frames,
    localized: LocalizedFrames,
    numbers: NDArray[np.intp],
    manifest: Manifest,
    code: Codec,
    camera: Camera | None = None,
) -> None:
    """Localize frames that show several sheets by the dots of one of them, in place.

    Parameters
    ----------
    frames : Frames
    localized : LocalizedFrames
        Of these frames.
    numbers : (n,) intp ndarray
        Sheet of each frame, -1 if it has none. A frame may be about as far from the middle of one
        sheet as from that of the next; the sheet is the one to which most of its dots belong.
    manifest, code, camera
    """
    for index in np.flatnonzero(may_show_seam(localized, numbers, manifest)).tolist():
        image = frames.images[index]
        views = separate_sheets(image, manifest, code, camera)
        if len(views) > 1 or (views and views[0].number != numbers[index]):
            pose = localize_view(views[0], image.shape, manifest, code, camera)
            localized.replace(index, pose)
            numbers[index] = views[0].number if pose.accepted[0] else -1


def localize_view(
    view: SheetView,
    shape: tuple[int, ...],
    manifest: Manifest,
    code: Codec,
    camera: Camera | None = None,
) -> LocalizedFrames:
    """Return the pose of a frame (h, w) on the grid of one of its sheets.

    The frame is rejected if the dots determine no homography, or if they are decoded to another
    position with more confidence.
    """
    height, width = shape[:2]
    pixels = np.concatenate([view.pixels, view.misread_pixels])
    if camera is None:
        points = pixels - [(width - 1) / 2, (height - 1) / 2]
    else:
        points = camera.undistort(pixels) - camera.centre_px
    points = points / (math.hypot(width, height) / 2)
    origin = np.rint(view.grid.mean(axis=0)).astype(np.int64)
    try:
        homography = fit_homography(points[: len(view.grid)], view.grid - origin)
    except DegenerateError:
        return unlocalized_frames(1, NO_GRID)
    lattice = lattice_of(homography, points, lens=camera is None)
    half = window_half_width(lattice)
    bits = soft_bits(lattice, half)
    decoded = identify_windows(*bits, code, other_codec_odds=0)
    x, y = (origin - half)[:, None]
    sheet = manifest.sheets[view.number]
    section = np.array([sheet.section])
    is_same = (decoded.x == x) & (decoded.y == y) & (decoded.rotation == 0)
    is_same &= (decoded.section == section).all(axis=1)
    confidence = np.where(is_same, np.maximum(decoded.confidence, view.confidence), view.confidence)
    is_refuted = ~is_same & (decoded.confidence > view.confidence)
    symbols = padded_symbols(code, sheet, origin - half, 2 * half)
    observed, printed = np.stack(bits)[:, 0], np.stack([symbols & 1, symbols >> 1]) == 1
    is_wrong = (observed != 0) & (symbols < NO_SYMBOL) & ((observed > 0) != printed)
    windows = DecodedWindows(
        x,
        y,
        section,
        np.zeros(1, np.int64),
        decoded.dots,
        np.array([is_wrong.sum()]),
        np.where(is_refuted, 0.0, confidence),
        border=np.zeros(1, np.bool_),
        rival_odds=np.zeros(1),
    )
    pose = localize_windows(lattice, half, windows, code)
    return LocalizedFrames(
        pose.grid,
        section,
        pose.heading,
        pose.covariance,
        windows.dots,
        windows.corrected,
        windows.confidence,
        np.where(is_refuted, LOW_CONFIDENCE, "").astype(object),
        ambiguous=np.zeros(1, np.bool_),
    )


def may_show_seam(
    localized: LocalizedFrames, numbers: NDArray[np.intp], manifest: Manifest
) -> NDArray[np.bool_]:
    """Return the frames (n,) that may show several sheets.

    ``numbers`` (n,) is the sheet of each frame, -1 if it has none. A frame may show a seam if the
    end of its sheet is no farther from the middle than the corners of the frame are, or if it was
    rejected with many dots or without a lattice.
    """
    low = np.array([sheet.origin for sheet in manifest.sheets])[numbers]
    high = low + np.array([sheet.size for sheet in manifest.sheets])[numbers] - 1
    to_end = np.minimum(localized.grid - low, high - localized.grid).min(axis=1)
    # The corners are 0.74 times the root of the area away at 188 x 120 px, 0.77 at 16:9.
    is_near = to_end < np.sqrt(localized.dots)
    is_rejected = np.isin(localized.rejected, [NO_CODE, LOW_CONFIDENCE])
    is_rejected &= localized.dots >= 2 * MIN_SHEET_DOTS
    # Two lattices that differ by half a pitch may leave none, and no dots on it to count.
    is_rejected |= localized.rejected == NO_GRID
    return np.asarray(np.where(localized.accepted & (numbers >= 0), is_near, is_rejected))
