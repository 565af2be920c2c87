"""Dots in grey images: where, to a fraction of a pixel, and how dark.

The image is smoothed once by about the width of a dot; a dot is a local minimum that is
darker than its surroundings. No threshold is global: how dark a dot must be follows from
the minima of the same frame relative to the paper around each, so that vignettes, uneven
light and exposure do not matter.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels

SMOOTHING_PX = 1.1
"""Sigma of the smoothing; fits dots of 1.5 to 5 px at a pitch of 8 to 16 px."""

REACH = 2
"""Pixels to each side that smoothing, and the search for minima, look."""

PAPER = 4
"""The paper's brightness is taken from an image this much smaller, blurred over
:data:`PAPER_REACH` of its pixels: about two pitches."""
PAPER_REACH = 7

FAINTEST = 1.5
"""Least contrast of a dot, in grey levels after smoothing."""

FEWEST_DOTS = 40
"""Minima that are dirt if they stand out and are fewer than these."""

SPLITS = 3
"""How often dirt is set aside."""

SHARE = 0.45
"""Least contrast of a dot as share of that of the frame's median dot."""


@dataclass(frozen=True)
class Dots:
    """Dots of n frames, padded to the m of the fullest.

    Attributes
    ----------
    xy : (n, m, 2) float32 ndarray
        Pixels; 0 where there is no dot.
    valid : (n, m) bool ndarray
    """

    xy: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def counts(self) -> NDArray[np.int64]:
        """(n,) dots a frame."""
        result: NDArray[np.int64] = self.valid.sum(axis=1)
        return result


def find_dots(images: NDArray[np.uint8], most: int = 4096) -> Dots:
    """Dots of each of (n, h, w) grey images; of more than ``most`` those in the middle.

    The position is the top of a Gaussian through the minimum and its neighbours.
    """
    n, h, w = images.shape
    if min(h, w) <= 2 * REACH:
        return Dots(np.zeros((n, 1, 2), np.float32), np.zeros((n, 1), bool))
    if kernels is None:
        return find_dots_numpy(images, most)
    xy = np.empty((n, most, 2), np.float32)
    counts = np.empty(n, np.int64)
    kernels.find_dots(
        np.ascontiguousarray(images, np.uint8),
        *(n, h, w),
        _taps(),
        *(PAPER, PAPER_REACH, FAINTEST, SHARE, FEWEST_DOTS, SPLITS, most),
        xy,
        counts,
    )
    xy = xy[:, : max(int(counts.max(initial=0)), 1)]
    valid = np.arange(xy.shape[1]) < counts[:, None]
    return Dots(np.where(valid[..., None], xy, np.float32(0)), valid)


@functools.cache
def _taps() -> NDArray[np.float32]:
    taps: NDArray[np.float32] = cv2.getGaussianKernel(2 * REACH + 1, SMOOTHING_PX)[: REACH + 1, 0]
    return taps.astype(np.float32)


def find_dots_numpy(images: NDArray[np.uint8], most: int = 4096) -> Dots:
    """:func:`find_dots` without the compiled kernel."""
    n, h, w = images.shape
    smooth = np.empty((n, h, w), np.float32)
    minima = np.zeros((n, h, w), bool)
    rows, columns = h // PAPER, w // PAPER
    paper = np.empty((n, rows, columns), np.float32)
    # Of equal minima the first counts: pixels before it have to be brighter.
    before = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    before.ravel()[before.size // 2 :] = 0
    after = np.ascontiguousarray(before[::-1, ::-1])
    core = np.s_[REACH : h - REACH, REACH : w - REACH]
    size = (2 * REACH + 1, 2 * REACH + 1)
    for k, image in enumerate(images):
        cv2.GaussianBlur(image.astype(np.float32), size, SMOOTHING_PX, dst=smooth[k])
        least = smooth[k] < cv2.erode(smooth[k], before)
        least &= smooth[k] <= cv2.erode(smooth[k], after)
        minima[k][core] = least[core]
        whole = image[: rows * PAPER, : columns * PAPER]  # other ratios cost ten times as much
        small = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
        cv2.blur(small.astype(np.float32), (PAPER_REACH, PAPER_REACH), dst=paper[k])

    at = np.flatnonzero(minima)
    line, column = np.divmod(at, w)
    frame, row = np.divmod(line, h)
    light = paper[
        frame, np.minimum(row // PAPER, rows - 1), np.minimum(column // PAPER, columns - 1)
    ]
    flat = smooth.reshape(-1)
    contrast = light - flat[at]
    keep = contrast > FAINTEST
    at, frame, row, column = at[keep], frame[keep], row[keep], column[keep]
    light, contrast = light[keep], contrast[keep]

    relative = contrast / light
    keep = relative > (SHARE * _typical(relative, frame, n))[frame]
    at, frame, light, contrast = at[keep], frame[keep], light[keep], contrast[keep]
    slope_y, slope_x = _slopes(paper)
    x = column[keep] + _peak(flat, at, 1, light, contrast, slope_x[frame])
    y = row[keep] + _peak(flat, at, w, light, contrast, slope_y[frame])
    return _padded(frame, x, y, (w - 1) / 2, (h - 1) / 2, n, most)


def _slopes(paper: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n,) grey levels a pixel by which the paper brightens downwards and to the right.

    Of a plane through the whole frame: light from a side would move the tops of all dots.
    """
    slopes = []
    for axis in (1, 2):
        steps = np.arange(paper.shape[axis]) - (paper.shape[axis] - 1) / 2
        profile = paper.mean(axis=3 - axis) @ steps
        slopes.append((profile / max(float(steps @ steps), 1.0) / PAPER).astype(np.float32))
    return slopes[0], slopes[1]


def _typical(contrast: NDArray[np.float32], frame: NDArray[np.intp], n: int) -> NDArray[np.float32]:
    """(n,) contrast of the median dot of each frame."""
    order = np.lexsort((-contrast, frame))
    edges = np.searchsorted(frame[order], np.arange(n + 1))
    parts = [contrast[order[a:b]] for a, b in itertools.pairwise(edges)]
    return np.array([_median_dot(part) for part in parts], np.float32)


def _median_dot(contrast: NDArray[np.float32]) -> float:
    """Contrast of the median dot among minima, given darkest first.

    Which are dots and which are noise is decided by Otsu's criterion: the split that most
    reduces the variance within both parts. A first part of few is dirt on the paper, darker
    than any dot; then the rest is split again.
    """
    for _ in range(SPLITS):
        if len(contrast) < 2:
            break
        sums = np.cumsum(contrast)
        above = np.arange(1, len(contrast))
        rest = sums[-1] - sums[:-1]
        between = sums[:-1] ** 2 / above + rest**2 / (len(contrast) - above)
        dots = int(between.argmax()) + 1
        if dots >= FEWEST_DOTS:
            return float(contrast[(dots - 1) // 2])
        contrast = contrast[dots:]
    return float(contrast[(len(contrast) - 1) // 2]) if len(contrast) else 0.0


def _peak(
    flat: NDArray[np.float32],
    at: NDArray[np.intp],
    step: int,
    light: NDArray[np.float32],
    contrast: NDArray[np.float32],
    slope: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Offset of the top of a Gaussian through three samples, within half a pixel."""
    floor = 0.05 * contrast
    before = np.log(np.maximum(light - slope - flat[at - step], floor))
    after = np.log(np.maximum(light + slope - flat[at + step], floor))
    bend = 2 * np.log(contrast) - before - after
    offset = 0.5 * (after - before) / np.maximum(bend, 1e-6)
    result: NDArray[np.float32] = np.clip(offset, -0.5, 0.5)
    return result


def _padded(
    frame: NDArray[np.intp],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    middle_x: float,
    middle_y: float,
    n: int,
    most: int,
) -> Dots:
    counts = np.bincount(frame, minlength=n)
    if counts.max(initial=0) > most:
        order = np.lexsort(((x - middle_x) ** 2 + (y - middle_y) ** 2, frame))
        rank = np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame[order]]
        kept = np.sort(order[rank < most])
        return _padded(frame[kept], x[kept], y[kept], middle_x, middle_y, n, most)
    m = max(int(counts.max(initial=0)), 1)
    slot = np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame]
    xy = np.zeros((n, m, 2), np.float32)
    xy[frame, slot, 0], xy[frame, slot, 1] = x, y
    valid = np.arange(m) < counts[:, None]
    return Dots(xy, valid)
