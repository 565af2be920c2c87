"""Error of the position of one dot in an image, in closed form.

The image of a dot is a disc, convolved with the pixel, the blur of the lens, the motion, and the
smoothing of the detector. The position is the top of a Gaussian through three samples of it
(:mod:`locatk.core.dots.detection.blobs`). Two errors follow without any image:

- *noise*: the derivatives of this top by the three samples, times the noise of the pixels after
  smoothing (propagation of errors, to first order);
- *sampling*: the image is no Gaussian, and neighbours overlap it. The error depends on the position
  of the dot within a pixel and on the direction of the grid, so that it scatters from dot to dot.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from locatk.core.dots.codec import DOT_DIRECTIONS
from locatk.core.dots.detection.blobs import RING_PX, SMOOTHING_RADIUS_PX, SMOOTHING_SIGMA_PX
from locatk.core.dots.detection.lattice import SYMBOL_GATE_PITCHES
from locatk.core.dots.localization.pose import INLIER_GATE_SIGMAS
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES

Array = NDArray[np.float64]

PAPER_LEVEL = 210.0
"""Grey value of paper in a well exposed frame of 8 bits."""

PHASES_PER_PX = 8
"""Positions of a dot within a pixel along each axis; also the samples per pixel of its image."""

WINDOW_PX = 10
"""Half width of the pixels about a dot that are evaluated: the ring, and a dot displaced to it."""

MOTION_DIRECTIONS_RAD = (0.1, 0.5, 0.9, 1.3)
"""Directions of the motion in the image over which is averaged."""

MIN_MOTION_PX = 0.2
"""Motion that is shorter than this hardly depends on its direction."""

ROUNDING_VARIANCE = 1 / 12
"""Variance of a value that is rounded to whole grey values."""

MAX_NOISE_PX = 1.0
"""Largest error by noise on a flat top: the detector keeps the result within a pixel."""

MIN_INK_FRACTION = 0.05
"""Least ink of a neighbouring pixel relative to that of the darkest one, as in the detector."""


@dataclass(frozen=True)
class DotImage:
    """Conditions under which a dot is imaged; lengths in pixels of the image that is searched.

    Attributes
    ----------
    pitch_px : float
        Distance of two dots on the grid.
    diameter_px : float
        Of a dot.
    blur_px : float
        Standard deviation of the blur of the lens, per axis.
    motion_px : float
        Length of the motion during the exposure.
    noise : float
        Standard deviation of a pixel as a fraction of the grey value of paper.
    contrast : float
        Contrast of the ink; 1 is black.
    jitter_px : float
        Standard deviation of the printed position per axis.
    """

    pitch_px: float
    diameter_px: float
    blur_px: float
    motion_px: float = 0.0
    noise: float = 0.01
    contrast: float = 0.75
    jitter_px: float = 0.0


@dataclass(frozen=True)
class DotError:
    """Errors of the position of a dot, per axis, and its visibility.

    Attributes
    ----------
    noise_px, sampling_px, jitter_px : float
        Standard deviations by noise, by sampling and neighbours, and by the print, of the dots that
        are used.
    used_fraction : float
        Fraction of the dots within the gates of the solver.
    peak : float
        Depth of the smoothed dot as a fraction of the grey value of paper.
    smoothed_noise : float
        Standard deviation of a pixel after smoothing, in the same unit.
    """

    noise_px: float
    sampling_px: float
    jitter_px: float
    used_fraction: float
    peak: float
    smoothed_noise: float

    @property
    def total_px(self) -> float:
        """Standard deviation of all errors together."""
        return math.hypot(self.noise_px, self.sampling_px, self.jitter_px)


@functools.lru_cache(maxsize=64)
def dot_error(image: DotImage) -> DotError:
    """Return the error of a dot, averaged over its positions within a pixel and its neighbours."""
    directions = MOTION_DIRECTIONS_RAD if image.motion_px > MIN_MOTION_PX else (0.0,)
    spectrum, fx, fy = _ink_spectrum(image)
    parts = []
    for direction in directions:
        motion = np.sinc(image.motion_px * (fx * math.cos(direction) + fy * math.sin(direction)))
        profile = np.fft.irfft2(spectrum * motion, (len(fy), len(fy))) * PHASES_PER_PX**2
        parts.append(_error_of_profile(image, profile))
    return DotError(
        noise_px=math.sqrt(np.mean([part.noise_px**2 for part in parts])),
        sampling_px=math.sqrt(np.mean([part.sampling_px**2 for part in parts])),
        jitter_px=image.jitter_px,
        used_fraction=float(np.mean([part.used_fraction for part in parts])),
        peak=float(np.mean([part.peak for part in parts])),
        smoothed_noise=parts[0].smoothed_noise,
    )


def _error_of_profile(image: DotImage, profile: Array) -> DotError:
    """Return the error of a dot with the smoothed ink (n, n), :data:`PHASES_PER_PX` samples per px.

    The dot is at sample (0, 0) of a periodic image.
    """
    phase, ink = _sampled_ink(image, profile)
    flat = 1 - image.contrast * ink
    count = len(flat)
    order = np.arange(count)
    # The darkest pixel next to the dot, and the light from the ring about it.
    near = slice(WINDOW_PX - SMOOTHING_RADIUS_PX, WINDOW_PX + SMOOTHING_RADIUS_PX + 1)
    darkest = flat[:, near, near].reshape(count, -1).argmin(axis=1)
    row, column = np.divmod(darkest, 2 * SMOOTHING_RADIUS_PX + 1)
    row += WINDOW_PX - SMOOTHING_RADIUS_PX
    column += WINDOW_PX - SMOOTHING_RADIUS_PX
    ring = np.sort(
        flat[order[:, None], row[:, None] + RING_PX[:, 1], column[:, None] + RING_PX[:, 0]], axis=1
    )
    light = (ring[:, 4] + ring[:, 5]) / 2
    middle = flat[order, row, column]

    correlation = _tap_correlation()
    smoothed_noise = image.noise * correlation[0]
    # Correlation of the noise of the pixels before, at and after the darkest one.
    ratio = correlation / correlation[0]
    between = np.array([[1, ratio[1], ratio[2]], [ratio[1], 1, ratio[1]], [ratio[2], ratio[1], 1]])
    variances, errors = [], []
    for axis, (step_row, step_column) in enumerate(((0, 1), (1, 0))):
        samples = np.stack(
            [
                1 - flat[order, row + k * step_row, column + k * step_column] / light
                for k in (-1, 0, 1)
            ]
        )
        is_floored = samples < MIN_INK_FRACTION * samples[1]
        samples = np.maximum(samples, MIN_INK_FRACTION * np.maximum(samples[1], 1e-9))
        before, at, after = np.log(samples)
        curvature = np.maximum(2 * at - before - after, 1e-6)
        slope = after - before
        offset = np.clip(0.5 * slope / curvature, -1, 1)
        derivative = np.stack(
            [
                -0.5 / curvature + 0.5 * slope / curvature**2,
                -slope / curvature**2,
                0.5 / curvature + 0.5 * slope / curvature**2,
            ]
        )
        derivative *= ~is_floored / samples / light
        variance = np.einsum("in,ij,jn->n", derivative, between, derivative)
        variances.append(np.minimum(smoothed_noise**2 * variance, MAX_NOISE_PX**2))
        pixel = (column if axis == 0 else row) - WINDOW_PX
        errors.append(pixel + offset - phase[:, axis])
    error, variance = np.array(errors), np.array(variances)
    is_used = _is_within_gates(error, variance + image.jitter_px**2, image.pitch_px)
    return DotError(
        noise_px=math.sqrt(variance[:, is_used].mean()),
        sampling_px=math.sqrt((error[:, is_used] ** 2).mean()),
        jitter_px=image.jitter_px,
        used_fraction=float(is_used.mean()),
        peak=float(np.mean(ring[:, 2] - middle)),
        smoothed_noise=smoothed_noise,
    )


def _is_within_gates(error: Array, variance: Array, pitch_px: float) -> NDArray[np.bool_]:
    """Return which dots (k,) the solver uses: errors and variances (2, k) are per axis."""
    squared = (error**2 + variance).sum(axis=0)
    is_near = (np.abs(error) < SYMBOL_GATE_PITCHES * pitch_px).all(axis=0)
    if not is_near.any():
        return np.ones_like(is_near)
    per_axis = max(np.median(squared[is_near]) / (2 * math.log(2)), 1e-12)
    result: NDArray[np.bool_] = is_near & (squared <= INLIER_GATE_SIGMAS**2 * per_axis)
    return result


def _ink_spectrum(image: DotImage) -> tuple[Array, Array, Array]:
    """Return the spectrum (n, n / 2 + 1) of the smoothed ink of a dot at rest, and fx and fy.

    The frequencies, in 1/px, are those of a periodic image, so wide that the farthest neighbour
    does not reach the window from the other side.
    """
    tail = image.diameter_px + 4 * image.blur_px + image.motion_px + 2 * SMOOTHING_RADIUS_PX
    farthest = 2 * image.pitch_px if _has_neighbours_in_window(image) else 0.0
    width = 2 ** math.ceil(math.log2(WINDOW_PX + farthest + tail))
    n = width * PHASES_PER_PX
    frequency: Array = np.fft.fftfreq(n, 1 / PHASES_PER_PX).astype(np.float64)
    half: Array = np.fft.rfftfreq(n, 1 / PHASES_PER_PX).astype(np.float64)
    fx, fy = half[None, :], frequency[:, None]
    radius = image.diameter_px / 2
    argument = 2 * np.pi * radius * np.hypot(fx, fy)
    with np.errstate(invalid="ignore", divide="ignore"):
        disc = np.where(argument > 0, 2 * j1(argument) / argument, 1.0)
    spectrum = np.pi * radius**2 * disc
    separable = [
        np.sinc(f) * np.exp(-2 * (np.pi * image.blur_px * f) ** 2) * _tap_transfer(f)
        for f in (fy, fx)
    ]
    return spectrum * separable[0] * separable[1], fx, fy


def _has_neighbours_in_window(image: DotImage) -> bool:
    """Return whether neighbours, as near as their symbols allow, reach the pixels about a dot."""
    nearest = (1 - 2 * DOT_OFFSET_PITCHES) * image.pitch_px
    ink_radius = (
        image.diameter_px / 2 + 4 * image.blur_px + image.motion_px / 2 + SMOOTHING_RADIUS_PX
    )
    return nearest < math.sqrt(2) * WINDOW_PX + ink_radius


def _sampled_ink(image: DotImage, profile: Array) -> tuple[Array, Array]:
    """Return phases (k, 2) of dots, x and y, and the ink (k, w, w) of the pixels about them.

    Each of the phases has its own direction of the grid and symbols of the neighbours, from
    additive sequences, which fill their ranges evenly.
    """
    steps = (np.arange(PHASES_PER_PX) + 0.5) / PHASES_PER_PX - 0.5
    phase = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    count = len(phase)
    direction = np.pi / 2 * (((np.arange(count) + 0.5) * 0.6180339887) % 1)
    around = (-1, 0, 1) if _has_neighbours_in_window(image) else (0,)
    nodes = np.array([(x, y) for x in around for y in around])
    steps_of_symbols = np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23])
    symbol = np.floor(4 * np.arange(count)[:, None] * steps_of_symbols[: len(nodes)])
    offset = DOT_DIRECTIONS[symbol.astype(np.int64) % 4] * DOT_OFFSET_PITCHES
    is_self = (nodes == 0).all(axis=1)
    relative = nodes + offset - offset[:, is_self]
    c, s = np.cos(direction), np.sin(direction)
    rotation = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], axis=1)
    position = image.pitch_px * np.einsum("kij,kdj->kdi", rotation, relative)
    position += phase[:, None]
    # Samples are whole eighths of a pixel: exact for the dot, rounded for its neighbours.
    index = np.rint(position * PHASES_PER_PX - 0.5 * is_self[:, None]).astype(np.int64)
    pixels = PHASES_PER_PX * np.arange(-WINDOW_PX, WINDOW_PX + 1)
    n = len(profile)
    rows = (pixels - index[..., 1, None]) % n
    columns = (pixels - index[..., 0, None]) % n
    ink: Array = profile[rows[..., :, None], columns[..., None, :]].sum(axis=1)
    return index[:, is_self][:, 0] / PHASES_PER_PX, np.minimum(ink, 1.0)


@functools.cache
def _taps() -> Array:
    """Return the taps of the detector's smoothing, whose sum is 1."""
    distance = np.arange(-SMOOTHING_RADIUS_PX, SMOOTHING_RADIUS_PX + 1)
    taps = np.exp(-0.5 * (distance / SMOOTHING_SIGMA_PX) ** 2)
    result: Array = taps / taps.sum()
    return result


def _tap_transfer(frequency: Array) -> Array:
    """Return the transfer function of the smoothing along one axis; frequency in 1/px."""
    taps = _taps()[SMOOTHING_RADIUS_PX:]
    result = np.full_like(frequency, taps[0])
    for distance in range(1, SMOOTHING_RADIUS_PX + 1):
        result += 2 * taps[distance] * np.cos(2 * np.pi * distance * frequency)
    return result


@functools.cache
def _tap_correlation() -> Array:
    """Return the autocorrelation of the taps at lags of 0, 1 and 2 px."""
    taps = _taps()
    full = np.correlate(taps, taps, "full")[len(taps) - 1 :]
    result: Array = full[:3]
    return result
