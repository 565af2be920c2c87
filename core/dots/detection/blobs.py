"""Detection of dots in grey images, to a fraction of a pixel.

The image is smoothed once by about the width of a dot; a dot is a local minimum that is darker than
a ring of pixels about it. On a line, on a hand or at its edge at least three pixels of the ring are
as dark as the minimum. There is no global threshold: the least contrast of a dot follows from the
minima of the same frame relative to the paper around each, so that vignettes, uneven light and
exposure have no effect.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels

SMOOTHING_SIGMA_PX = 1.1
"""Sigma of the smoothing [px]; suitable for dots of 1.5 to 5 px at a pitch of 8 to 16 px."""

SMOOTHING_RADIUS_PX = 2
"""Radius of the smoothing kernel, and of the neighbourhood of a minimum [px]."""

RING_PX = np.array([[4, 0], [3, 3], [0, 4], [-3, 3], [-4, 0], [-3, -3], [0, -4], [3, -3]])
"""(8, 2) ring of pixels about a minimum that are beyond its dot."""

MAX_DARK_RING_PIXELS = 2
"""Pixels of the ring that may be on neighbouring dots; the next brighter one gives the contrast."""

PAPER_BLOCK_PX = 4
"""Side of the blocks over which the brightness of the paper is averaged first [px]."""

PAPER_WINDOW_BLOCKS = 7
"""Side of the window over which blocks are averaged then: about two pitches."""

SLOPE_REACH_BLOCKS = 3
"""Distance of the blocks before and after a dot whose difference is the slope of the light there;
their windows overlap by one block."""

MAX_PAPER_SLOPE_PER_PX = 0.1
"""Largest change of the light from pixel to pixel, relative to it; a steeper one is an edge."""

MIN_CONTRAST_LEVELS = 1.5
"""Least contrast of a dot after smoothing [grey levels]."""

MIN_PATTERN_DOTS = 40
"""Minima that stand out from the rest and are fewer than this are dirt."""

MAX_DIRT_SPLITS = 3
"""Maximum number of times that dirt is separated from the other minima."""

MIN_CONTRAST_FRACTION = 0.45
"""Least contrast of a dot, as a fraction of that of the frame's median dot."""


@dataclass(frozen=True)
class DetectedDots:
    """Dots of n frames, padded to the number m of the frame with most dots.

    Attributes
    ----------
    xy : (n, m, 2) float32 ndarray
        Position in px; 0 if there is no dot.
    valid : (n, m) bool ndarray
    """

    xy: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of dots (n,) in each frame."""
        result: NDArray[np.int64] = self.valid.sum(axis=1)
        return result


def detect_dots(images: NDArray[np.uint8], max_dots: int = 4096) -> DetectedDots:
    """Detect the dots in each of the grey images (n, h, w).

    The position of a dot is the top of a Gaussian through the minimum and its neighbours. Of more
    than ``max_dots`` dots in a frame those nearest to its middle are returned.
    """
    n, h, w = images.shape
    if min(h, w) <= 2 * SMOOTHING_RADIUS_PX:
        return DetectedDots(np.zeros((n, 1, 2), np.float32), np.zeros((n, 1), bool))
    if kernels is None:
        return detect_dots_numpy(images, max_dots)
    xy = np.empty((n, max_dots, 2), np.float32)
    counts = np.empty(n, np.int64)
    kernels.find_dots(
        np.ascontiguousarray(images, np.uint8),
        *(n, h, w),
        _smoothing_taps(),
        *(PAPER_BLOCK_PX, PAPER_WINDOW_BLOCKS, SLOPE_REACH_BLOCKS, MAX_PAPER_SLOPE_PER_PX),
        *(MIN_CONTRAST_LEVELS, MIN_CONTRAST_FRACTION),
        *(MIN_PATTERN_DOTS, MAX_DIRT_SPLITS, max_dots),
        xy,
        counts,
    )
    xy = xy[:, : max(int(counts.max(initial=0)), 1)]
    valid = np.arange(xy.shape[1]) < counts[:, None]
    return DetectedDots(np.where(valid[..., None], xy, np.float32(0)), valid)


def detect_dots_halved(images: NDArray[np.uint8], level: int) -> DetectedDots:
    """Detect the dots in images (n, h, w) that are halved ``level`` times.

    Positions are those in the images at full size; incomplete blocks at the edges are left out.
    """
    if not level:
        return detect_dots(images)
    _, height, width = images.shape
    size = (width >> level, height >> level)
    cropped = images[:, : size[1] << level, : size[0] << level]
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in cropped]
    dots = detect_dots(np.stack(small))
    xy = (dots.xy + np.float32(0.5)) * np.float32(1 << level) - np.float32(0.5)
    return DetectedDots(np.where(dots.valid[..., None], xy, np.float32(0)), dots.valid)


@functools.cache
def _smoothing_taps() -> NDArray[np.float32]:
    """Return one half of the symmetric smoothing kernel, the middle last."""
    size = 2 * SMOOTHING_RADIUS_PX + 1
    taps: NDArray[np.float32] = cv2.getGaussianKernel(size, SMOOTHING_SIGMA_PX)[
        : SMOOTHING_RADIUS_PX + 1, 0
    ]
    return taps.astype(np.float32)


@functools.cache
def _smoothing_variance() -> np.float32:
    """Return the variance of the smoothing kernel [px^2]."""
    distance = np.arange(SMOOTHING_RADIUS_PX, -1, -1)
    return np.float32(2 * (_smoothing_taps() * distance**2).sum())


def detect_dots_numpy(images: NDArray[np.uint8], max_dots: int = 4096) -> DetectedDots:
    """Detect dots as :func:`detect_dots`, without the compiled kernel."""
    n, h, w = images.shape
    radius, block = SMOOTHING_RADIUS_PX, PAPER_BLOCK_PX
    smooth = np.empty((n, h, w), np.float32)
    minima = np.zeros((n, h, w), bool)
    rows, columns = h // block, w // block
    paper = np.empty((n, rows, columns), np.float32)
    # The first of equal minima counts: the pixels before it have to be brighter.
    before = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    before.ravel()[before.size // 2 :] = 0
    after = np.ascontiguousarray(before[::-1, ::-1])
    inner = np.s_[radius : h - radius, radius : w - radius]
    for k, image in enumerate(images):
        cv2.GaussianBlur(image.astype(np.float32), before.shape, SMOOTHING_SIGMA_PX, dst=smooth[k])
        is_minimum = smooth[k] < cv2.erode(smooth[k], before)
        is_minimum &= smooth[k] <= cv2.erode(smooth[k], after)
        minima[k][inner] = is_minimum[inner]
        # Whole blocks only: other ratios of sizes cost ten times as much.
        cropped = image[: rows * block, : columns * block]
        means = cv2.resize(cropped, (columns, rows), interpolation=cv2.INTER_AREA)
        window = (PAPER_WINDOW_BLOCKS, PAPER_WINDOW_BLOCKS)
        cv2.blur(means.astype(np.float32), window, dst=paper[k])

    index = np.flatnonzero(minima)
    line, column = np.divmod(index, w)
    frame, row = np.divmod(line, h)
    flat = smooth.reshape(-1)
    ring_x = np.clip(column[:, None] + RING_PX[:, 0], 0, w - 1)
    ring_y = np.clip(row[:, None] + RING_PX[:, 1], 0, h - 1)
    ring = np.sort(smooth[frame[:, None], ring_y, ring_x], axis=1)
    contrast = ring[:, MAX_DARK_RING_PIXELS] - flat[index]
    keep = contrast > MIN_CONTRAST_LEVELS
    index, frame, row, column = index[keep], frame[keep], row[keep], column[keep]
    ring = ring[keep]
    relative = contrast[keep] / ring[:, MAX_DARK_RING_PIXELS]
    keep = relative > (MIN_CONTRAST_FRACTION * _median_dots(relative, frame, n))[frame]
    index, frame, row, column = index[keep], frame[keep], row[keep], column[keep]
    light = np.float32(0.5) * (ring[keep, 4] + ring[keep, 5])
    ink = np.float32(1) - flat[index] / light
    block_row = np.minimum(row // block, rows - 1)
    block_column = np.minimum(column // block, columns - 1)
    slope_x = _paper_slopes(paper[frame, block_row], block_column)
    slope_y = _paper_slopes(paper.swapaxes(1, 2)[frame, block_column], block_row)
    x = column + _subpixel_offset(flat, index, 1, light, ink, slope_x)
    y = row + _subpixel_offset(flat, index, w, light, ink, slope_y)
    return _pad(frame, x, y, ((w - 1) / 2, (h - 1) / 2), n, max_dots)


def _paper_slopes(lines: NDArray[np.float32], block: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the slopes (n,) of the paper's brightness about blocks, relative to it [1 / px].

    At an edge of the light they are limited to twice the slope of the flatter side (monotonized
    central differences, van Leer 1977). ``lines`` (n, blocks) are those with the blocks. The blocks
    whose difference is taken are moved inwards where the windows over which they are averaged would
    leave the image.
    """
    count = lines.shape[1]
    first = PAPER_WINDOW_BLOCKS // 2 + SLOPE_REACH_BLOCKS
    middle = np.minimum(np.maximum(block, first), count - 1 - first)
    before = np.maximum(middle - SLOPE_REACH_BLOCKS, 0)
    after = np.minimum(middle + SLOPE_REACH_BLOCKS, count - 1)
    is_known = (before < middle) & (middle < after)
    before, middle, after = (np.where(is_known, k, block) for k in (before, middle, after))
    order = np.arange(len(lines))
    here, brightness = lines[order, middle], lines[order, block]
    is_known &= brightness > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        low = (here - lines[order, before]) / ((middle - before) * PAPER_BLOCK_PX).astype(
            np.float32
        )
        high = (lines[order, after] - here) / ((after - middle) * PAPER_BLOCK_PX).astype(np.float32)
        least = 2 * np.minimum(np.abs(low), np.abs(high))
        mean = np.float32(0.5) * (low + high)
        slope = np.copysign(np.minimum(np.abs(mean), least), mean) / brightness
        slope = np.where(is_known & (low * high > 0), slope, 0)
    limit = np.float32(MAX_PAPER_SLOPE_PER_PX)
    result: NDArray[np.float32] = np.clip(slope, -limit, limit).astype(np.float32)
    return result


def _median_dots(
    contrast: NDArray[np.float32], frame: NDArray[np.intp], n: int
) -> NDArray[np.float32]:
    """Return the contrast (n,) of the median dot of each frame."""
    order = np.lexsort((-contrast, frame))
    edges = np.searchsorted(frame[order], np.arange(n + 1))
    parts = [contrast[order[a:b]] for a, b in itertools.pairwise(edges)]
    return np.array([_median_dot(part) for part in parts], np.float32)


def _median_dot(contrast: NDArray[np.float32]) -> float:
    """Return the contrast of the median dot among minima, given darkest first.

    Dots and noise are separated by Otsu's criterion: the split that reduces the variance within
    both parts most. A first part with few minima is dirt on the paper, darker than any dot; then
    the rest is split again.
    """
    for _ in range(MAX_DIRT_SPLITS):
        if len(contrast) < 2:
            break
        sums = np.cumsum(contrast)
        above = np.arange(1, len(contrast))
        rest = sums[-1] - sums[:-1]
        between = sums[:-1] ** 2 / above + rest**2 / (len(contrast) - above)
        dots = int(between.argmax()) + 1
        if dots >= MIN_PATTERN_DOTS:
            return float(contrast[(dots - 1) // 2])
        contrast = contrast[dots:]
    return float(contrast[(len(contrast) - 1) // 2]) if len(contrast) else 0.0


def _subpixel_offset(
    flat: NDArray[np.float32],
    index: NDArray[np.intp],
    stride: int,
    light: NDArray[np.float32],
    ink: NDArray[np.float32],
    slope: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the offset, within a pixel, of the top of a Gaussian through three samples of ink.

    Ink is the fraction of the light that the paper loses. Light that varies by ``slope`` per pixel,
    relative to its brightness, was multiplied with the ink before the smoothing. Therefore the
    smoothed ink is displaced by the slope times the variance of the smoothing kernel towards the
    dark. The darkest pixel is displaced further, so that the offset may exceed half a pixel.
    """
    floor = np.float32(0.05) * ink
    one = np.float32(1)
    before = np.log(np.maximum(one - flat[index - stride] / (light * (one - slope)), floor))
    after = np.log(np.maximum(one - flat[index + stride] / (light * (one + slope)), floor))
    curvature = 2 * np.log(ink) - before - after
    offset = 0.5 * (after - before) / np.maximum(curvature, 1e-6)
    result: NDArray[np.float32] = np.clip(offset + _smoothing_variance() * slope, -1, 1)
    return result


def _pad(
    frame: NDArray[np.intp],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    middle: tuple[float, float],
    n: int,
    max_dots: int,
) -> DetectedDots:
    """Return the dots of all frames as padded arrays, at most ``max_dots`` per frame."""
    counts = np.bincount(frame, minlength=n)
    if counts.max(initial=0) > max_dots:
        order = np.lexsort(((x - middle[0]) ** 2 + (y - middle[1]) ** 2, frame))
        rank = np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame[order]]
        kept = np.sort(order[rank < max_dots])
        return _pad(frame[kept], x[kept], y[kept], middle, n, max_dots)
    m = max(int(counts.max(initial=0)), 1)
    slot = np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame]
    xy = np.zeros((n, m, 2), np.float32)
    xy[frame, slot, 0], xy[frame, slot, 1] = x, y
    return DetectedDots(xy, np.arange(m) < counts[:, None])
