"""Frames to places: dots, grid and decoding joined, each frame by itself.

No frame knows of another, so that the first one counts as much as the thousandth
(the paper's peer needs a few frames until its vote on the orientation has settled:
facts/dots.md 3.2). Batches are only for speed: a frame's answer does not depend on them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import Codec
from locatk.core.dots.detection import lattice as grid
from locatk.core.dots.detection.blobs import find_dots
from locatk.core.dots.detection.lattice import Lattices
from locatk.core.dots.identification.decoding import THRESHOLD, Decoded, decode
from locatk.core.dots.identification.soft_bits import half_width, soft_bits
from locatk.core.dots.localization.located import Located, nothing
from locatk.core.dots.localization.pose import match, poses
from locatk.core.errors import InputError

BATCH = 32
"""Frames that are worked on at once; their data fits the cache."""

SMALLEST = 48
"""Pixels of a side below which a frame cannot show a window of the pattern."""

NATURAL = 120
"""Pixels of the short side at which the pattern is looked for first: at full size in the
paper's frames, at half size in those of twice their size, and so on."""

LEVELS = 4
"""Sizes that are tried at most, each half of the one before."""

FEW_DOTS = "too_few_dots"
NO_GRID = "no_grid"
NO_CODE = "no_code"
DOUBTFUL = "low_confidence"
BORDER = "section_border"


@dataclass(frozen=True)
class Sighting:
    """Dots of one located frame with where on the grid each stands, for calibration.

    Attributes
    ----------
    pixels : (m, 2) float64 ndarray
        As seen, distortion and all.
    grid : (m, 2) float64 ndarray
        Of the dot itself, its displacement included, relative to :attr:`origin`.
    origin : (2,) int64 ndarray
    """

    pixels: NDArray[np.float64]
    grid: NDArray[np.float64]
    origin: NDArray[np.int64]


def locate(
    images: NDArray[np.uint8],
    codec: Codec,
    camera: Camera | None = None,
    *,
    threshold: float = THRESHOLD,
) -> Located:
    """Place and heading of (n, h, w) grey frames of one camera.

    Without a ``camera`` the centre of the frame is the camera's, and the bend of its lens
    is estimated in each frame.

    Raises
    ------
    InputError
        The frames are not of 8 bits a pixel.
    """
    if images.dtype != np.uint8:
        raise InputError(f"frames of {images.dtype}, not of 8 bits a pixel")
    n, height, width = images.shape
    result = nothing(n, FEW_DOTS)
    if min(height, width) < SMALLEST:
        return result
    for start in range(0, n, BATCH):
        left = np.arange(start, min(start + BATCH, n))
        for level in _levels(height, width):
            part, _, _ = _locate(images[left], codec, camera, level, threshold)
            result.keep(left, part)
            left = left[~result.accepted[left]]
            if not len(left):
                break
    return result


def sightings(
    images: NDArray[np.uint8], codec: Codec, camera: Camera | None = None
) -> Iterator[Sighting]:
    """What each located frame of ``images`` shows; frames that have no place are left out."""
    _, height, width = images.shape
    centre, scale = _normal_frame(height, width, camera)
    for image in images:
        for level in _levels(height, width):
            part, lattices, decoded = _locate(image[None], codec, camera, level, THRESHOLD)
            if not part.accepted[0]:
                continue
            dots = match(lattices, half_width(lattices), decoded, codec)
            seen = lattices.points[0, dots.use[0]] * scale + centre
            if camera is not None:
                seen = camera.distort(seen)
            yield Sighting(seen, dots.target[0, dots.use[0]], dots.origin[0])
            break


def _levels(height: int, width: int) -> list[int]:
    """Halvings of the frame to try, likeliest first."""
    short = min(height, width)
    first = max(0, round(math.log2(short / NATURAL)))
    possible = [k for k in range(max(LEVELS, first + 1)) if short >> k >= SMALLEST]
    return sorted(possible, key=lambda k: (abs(k - first), k))


def _normal_frame(
    height: int, width: int, camera: Camera | None
) -> tuple[NDArray[np.float64], float]:
    """Centre of the camera in px, and half the diagonal of a frame."""
    centre = ((width - 1) / 2, (height - 1) / 2) if camera is None else camera.centre_px
    return np.array(centre), math.hypot(width, height) / 2


def _locate(
    images: NDArray[np.uint8],
    codec: Codec,
    camera: Camera | None,
    level: int,
    threshold: float,
) -> tuple[Located, Lattices, Decoded]:
    n, height, width = images.shape
    shrink = 1 << level
    if level:
        size = (width >> level, height >> level)
        whole = images[:, : size[1] << level, : size[0] << level]
        images = np.stack([cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in whole])
    dots = find_dots(images)
    pixels = (dots.xy + np.float32(0.5)) * np.float32(shrink) - np.float32(0.5)
    centre, scale = _normal_frame(height, width, camera)
    if camera is not None and camera.radial:
        pixels = camera.undistort(pixels.astype(np.float64))
    points = ((pixels - centre) / scale).astype(np.float32)
    lattices = grid.fit_lattices(points, dots.valid, lens=camera is None)

    half = half_width(lattices)
    decoded = decode(*soft_bits(lattices, half), codec)
    pose = poses(lattices, half, decoded, codec)
    rejected = np.full(n, "", object)
    rejected[decoded.confidence < threshold] = DOUBTFUL
    rejected[decoded.confidence < 0.5] = NO_CODE
    rejected[(rejected != "") & decoded.border] = BORDER
    rejected[~lattices.found] = NO_GRID
    rejected[dots.counts < grid.FEWEST] = FEW_DOTS
    located = Located(
        grid=pose.grid,
        section=decoded.section,
        heading=pose.heading,
        covariance=pose.covariance,
        dots=decoded.dots,
        corrected=decoded.corrected,
        confidence=np.where(lattices.found, decoded.confidence, 0.0),
        rejected=rejected,
    )
    return located, lattices, decoded
