"""Frames of dots under disturbances: tilt, lenses, small frames, hands, ink, glare and light.

The renderer shares only the codec with the simulator and the solver. It works backwards: a ray of
each subpixel is traced through the lens and the tilted pinhole to the paper, and the subpixel is
dark if it is within the disc of the nearest grid position. Lenses are those of Brown and the
equidistant fisheye, never the division model of the solver. Hands, reflections and light are
applied to the image, drawings and text to the paper.

A position is correct within half a pitch and five degrees. The NEES (normalised estimation error
squared) is the mean of error^2 / sigma^2 of the correct frames, per axis; 1 is expected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import codec
from locatk.core.dots.localization.frames import LocalizedFrames, localize_frames
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Random = np.random.Generator

FRAMES_PER_DISTURBANCE = 200

PITCH_PX = 0.508 / 0.046
"""Pitch in the middle of a frame of the paper's camera (188 x 120 px of 0.046 mm)."""

SUBPIXELS_PER_PX = 4
"""Rays along each axis of a pixel; half as many if the pitch is twice as large."""

DOT_OFFSET_PITCHES = 1 / 6
DOT_OFFSETS = DOT_OFFSET_PITCHES * np.array([[0, -1], [-1, 0], [1, 0], [0, 1]], np.float32)
"""(4, 2) displacement of the dots of the symbols up, left, right and down, with y down."""

DRAWING_PX_PER_PITCH = 12
"""Resolution of the raster of drawings on the paper."""

MARGIN_PITCHES = 3
"""Width of the paper that is printed beyond the frame, for blur."""

MAX_HALF_WIDTH_PITCHES = 120
"""Half width of the printed paper; a tilted camera sees the rest too coarsely."""

MAX_ERROR_PITCHES, MAX_ERROR_DEG = 0.5, 5.0
"""Largest errors of a correct position."""

LENSES = ("brown", "brown of two terms", "equidistant")


@dataclass(frozen=True)
class Disturbance:
    """Options of disturbed frames; ranges are (least, largest), drawn anew for each frame.

    Attributes
    ----------
    tilt_deg : (float, float)
        Angle between the optical axis and the normal of the paper, in any direction.
    view_deg : (float, float)
        Horizontal angle of view, which decides the strength of the perspective.
    bend : float
        Displacement of the corners by the lens, relative to their ideal radius: negative for a
        barrel, positive for a pincushion.
    lenses : tuple of str
        Kinds of lenses to choose from; see :data:`LENSES`.
    size : (width, height)
    pitch_px : (float, float)
        Pitch in the middle of the frame.
    hand : float
        Fraction of the frame that a hand covers from one side.
    lines, words : (int, int)
        Numbers of thick lines (1 to 3 pitches) and of words, in the ink of the dots.
    glare : (int, int)
        Number of saturated reflections, each with a halo.
    glare_px : (float, float)
        Radius of their saturated part.
    gradient : float
        Loss of light from one side of the frame to the other.
    overexposure : float
        Gain of light from one side of the frame to the other, beyond white.
    motion_px : float
        Length of the motion blur, in a random direction.
    defocus_px : float
        Standard deviation of the blur at one side of the frame.
    blur_px, noise : float
        Standard deviations of the blur everywhere [px] and of the noise [grey levels].
    is_mirrored, is_inverted : bool
        Frame as in a mirror; light dots on dark paper.
    target : float or None
        Correct frames in percent.
    """

    tilt_deg: tuple[float, float] = (0.0, 0.0)
    view_deg: tuple[float, float] = (30.0, 50.0)
    bend: float = 0.0
    lenses: tuple[str, ...] = LENSES
    size: tuple[int, int] = (188, 120)
    pitch_px: tuple[float, float] = (PITCH_PX, PITCH_PX)
    hand: float = 0.0
    lines: tuple[int, int] = (0, 0)
    words: tuple[int, int] = (0, 0)
    glare: tuple[int, int] = (0, 0)
    glare_px: tuple[float, float] = (15.0, 90.0)
    gradient: float = 0.0
    overexposure: float = 0.0
    motion_px: float = 0.0
    defocus_px: float = 0.0
    blur_px: float = 0.6
    noise: float = 2.0
    is_mirrored: bool = False
    is_inverted: bool = False
    target: float | None = None


DISTURBANCES: dict[str, Disturbance] = {
    "tilt of 0 to 10 deg": Disturbance(tilt_deg=(0.0, 10.0), target=99.0),
    "tilt of 10 to 20 deg": Disturbance(tilt_deg=(10.0, 20.0), target=99.0),
    "tilt of 20 to 30 deg": Disturbance(tilt_deg=(20.0, 30.0), target=99.0),
    "tilt of 30 to 40 deg": Disturbance(tilt_deg=(30.0, 40.0), target=98.0),
    "barrel of 10 %": Disturbance(bend=-0.1, target=99.0),
    "barrel of 20 %": Disturbance(bend=-0.2, target=98.0),
    # One term of Brown that displaces the corner by 30 % compresses it to a tenth: no such lens.
    "barrel of 30 %": Disturbance(bend=-0.3, lenses=LENSES[1:], target=95.0),
    "pincushion of 10 %": Disturbance(bend=0.1, lenses=LENSES[:2], target=99.0),
    "pincushion of 20 %": Disturbance(bend=0.2, lenses=LENSES[:2], target=98.0),
    "pincushion of 30 %": Disturbance(bend=0.3, lenses=LENSES[:2], target=95.0),
    "64 x 64 px, 8 x 8 dots": Disturbance(size=(64, 64), pitch_px=(8.0, 8.0), target=95.0),
    "hand over 35 %": Disturbance(hand=0.35, target=99.0),
    "hand over 50 %": Disturbance(hand=0.5, target=95.0),
    "hand over 65 %": Disturbance(hand=0.65, target=60.0),
    "thick lines": Disturbance(lines=(2, 4), target=95.0),
    "text": Disturbance(words=(2, 5), target=95.0),
    "glare under a microscope": Disturbance(
        size=(640, 480), pitch_px=(20.0, 40.0), blur_px=1.5, glare=(1, 4), target=99.0
    ),
    "light falls by 90 %": Disturbance(gradient=0.9, target=99.0),
    "motion of 4 px": Disturbance(motion_px=4.0, target=99.0),
    "defocus on one side": Disturbance(defocus_px=3.5, target=99.0),
    "overexposed side": Disturbance(overexposure=0.8, target=99.0),
    "mirrored": Disturbance(is_mirrored=True),
    "inverted": Disturbance(is_inverted=True),
}  # fmt: skip


@dataclass(frozen=True)
class DisturbedFrames:
    """Rendered frames with the truth.

    Attributes
    ----------
    images : (n, height, width) uint8 ndarray
    grid : (n, 2) float64 ndarray
        Grid coordinates under the centre of each frame.
    heading : (n,) float64 ndarray
        Direction of the image's right there, counter-clockwise from the sheet's x axis [rad].
    """

    images: NDArray[np.uint8]
    grid: Array
    heading: Array


def render(
    disturbance: Disturbance, n: int, seed: int, codec_name: str = "anoto"
) -> DisturbedFrames:
    """Render n frames at random positions of the pattern and random headings."""
    images, grid, heading = [], np.empty((n, 2)), np.empty(n)
    for k in range(n):
        rng = np.random.default_rng([seed, k])
        grid[k], heading[k] = rng.uniform(1e6, 4e8, 2), rng.uniform(-math.pi, math.pi)
        images.append(_render_frame(disturbance, grid[k], heading[k], codec_name, rng))
    return DisturbedFrames(np.array(images), grid, heading)


def _render_frame(
    disturbance: Disturbance, grid: Array, heading: float, codec_name: str, rng: Random
) -> NDArray[np.uint8]:
    """Render a frame (height, width) with ``grid`` under its centre."""
    width, height = disturbance.size
    pitch_px = rng.uniform(*disturbance.pitch_px)
    subpixels = SUBPIXELS_PER_PX if pitch_px < 2 * PITCH_PX else SUBPIXELS_PER_PX // 2
    corner = np.floor(grid).astype(np.int64)
    points = _trace_rays(disturbance, pitch_px, subpixels, heading, rng) + (grid - corner)
    ink = _ink(disturbance, points.astype(np.float32), corner, codec_name, rng)
    ink = cv2.resize(ink, (width, height), interpolation=cv2.INTER_AREA)
    ink = _blurred(disturbance, ink, rng)
    grey = rng.uniform(190, 230) * (1 - rng.uniform(0.65, 0.85) * ink)
    if disturbance.gradient:
        along = _direction_field(disturbance.size, rng)
        grey *= 1 - disturbance.gradient * along
    if disturbance.overexposure:
        grey *= 1 + disturbance.overexposure * _direction_field(disturbance.size, rng)
    if disturbance.hand:
        grey = _cover_by_hand(grey, disturbance.hand, rng)
    for _ in range(int(rng.integers(disturbance.glare[0], disturbance.glare[1] + 1))):
        grey = _add_reflection(grey, rng.uniform(*disturbance.glare_px), rng)
    grey += rng.normal(0, disturbance.noise, grey.shape)
    image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    if disturbance.is_inverted:
        image = 255 - image
    return np.ascontiguousarray(image[:, ::-1] if disturbance.is_mirrored else image)


# ---- geometry


def _trace_rays(
    disturbance: Disturbance, pitch_px: float, subpixels: int, heading: float, rng: Random
) -> Array:
    """Return the positions (rows, columns, 2) [pitches, y down] that subpixels see on the paper.

    They are relative to the position under the centre, where the image's right has ``heading``.
    """
    width, height = disturbance.size
    focal_px = width / 2 / math.tan(math.radians(rng.uniform(*disturbance.view_deg)) / 2)
    tilt, towards = math.radians(rng.uniform(*disturbance.tilt_deg)), rng.uniform(0, math.tau)
    lens = str(rng.choice(disturbance.lenses))
    x, y = ((np.arange(n * subpixels) + 0.5) / subpixels - n / 2 for n in disturbance.size)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    if disturbance.bend:
        radius = np.linalg.norm(pixels, axis=-1, keepdims=True)
        corner_px = math.hypot(width, height) / 2
        pixels *= _undistorted_radius(radius, corner_px, disturbance.bend, lens) / radius
    # The camera looks along its axis 2 at a paper whose normal is tilted in the image.
    axis = np.array([-math.sin(towards), math.cos(towards), 0.0])
    rotation, _ = cv2.Rodrigues(axis * tilt)
    distance = focal_px / pitch_px

    def intersect(pixels: Array) -> Array:
        rays = np.concatenate([pixels, np.full((*pixels.shape[:-1], 1), focal_px)], axis=-1)
        rays = rays @ rotation
        depth = distance * rotation[2, 2] / rays[..., 2:]
        return rays[..., :2] * depth - distance * rotation[2, :2]

    right = intersect(np.array([1e-3, 0.0])) - intersect(np.array([-1e-3, 0.0]))
    angle = -heading - math.atan2(right[1], right[0])
    c, s = math.cos(angle), math.sin(angle)
    return intersect(pixels) @ np.array([[c, s], [-s, c]])


def _undistorted_radius(radius: Array, corner_px: float, bend: float, lens: str) -> Array:
    """Return the ideal radii of pixels at ``radius``, if the lens moves the corner by ``bend``.

    The table of the lens begins at the ideal radius 0; an ideal radius of 1 is that of the corner.
    """
    ideal = np.linspace(0, 1.02, 4000)
    if lens == "equidistant":
        # tan(angle) / angle is 1 / (1 + bend) at the corner.
        angles = np.linspace(1e-6, 1.5, 100_000)
        corner = angles[np.searchsorted(np.tan(angles) / angles, 1 / (1 + bend))]
        table = np.arctan(ideal * math.tan(corner)) / math.tan(corner)
    else:
        second = -0.4 if lens == "brown of two terms" else 0.0
        first = bend / (1 + second)
        table = ideal * (1 + first * ideal**2 * (1 + second * ideal**2))
    table_px = table / (1 + bend) * corner_px
    return np.interp(radius, table_px, ideal * corner_px / (1 + bend))


# ---- paper


def _ink(
    disturbance: Disturbance, points: Image, corner: NDArray[np.int64], codec_name: str, rng: Random
) -> Image:
    """Return the coverage with ink of subpixels that see ``points`` relative to ``corner``."""
    limit = MAX_HALF_WIDTH_PITCHES
    nodes = np.rint(np.clip(points, -limit, limit)).astype(np.int64)
    low = nodes.min(axis=(0, 1)) - MARGIN_PITCHES
    columns, rows = nodes.max(axis=(0, 1)) + MARGIN_PITCHES + 1 - low
    section = tuple(int(value) for value in rng.integers(0, 63, 2))
    first = corner + low
    symbols = codec(codec_name).symbols(
        (int(first[0]), int(first[1])), (int(columns), int(rows)), (section[0], section[1])
    )
    offset = DOT_OFFSETS[symbols[nodes[..., 1] - low[1], nodes[..., 0] - low[0]]]
    distance = np.linalg.norm(points - nodes - offset, axis=-1)
    # Width of a subpixel on the paper, over which the edge of a disc is a ramp.
    step_x = np.linalg.norm(np.diff(points, axis=1, append=points[:, -1:]), axis=-1)
    step_y = np.linalg.norm(np.diff(points, axis=0, append=points[-1:]), axis=-1)
    width = np.sqrt(np.maximum(step_x * step_y, 1e-6))
    radius = rng.uniform(0.25, 0.35) / 2
    ink: Image = np.clip((radius - distance) / width + 0.5, 0, 1).astype(np.float32)
    if disturbance.lines[1] or disturbance.words[1]:
        raster = _drawing(disturbance, (int(columns), int(rows)), -low, rng)
        to_raster = (points - low.astype(np.float32) + 0.5) * DRAWING_PX_PER_PITCH - 0.5
        drawn = cv2.remap(raster, to_raster, None, cv2.INTER_LINEAR)
        ink = np.maximum(ink, drawn.astype(np.float32) / 255)
    return ink


def _drawing(
    disturbance: Disturbance, size: tuple[int, int], middle: NDArray[np.int64], rng: Random
) -> NDArray[np.uint8]:
    """Return the raster of lines and words on ``size`` pitches of paper about ``middle``."""
    scale = DRAWING_PX_PER_PITCH
    raster = np.zeros((size[1] * scale, size[0] * scale), np.uint8)
    extent = min(size) / 2 - MARGIN_PITCHES
    for _ in range(int(rng.integers(disturbance.lines[0], disturbance.lines[1] + 1))):
        # A curved stroke through a position within the frame.
        angle = rng.uniform(0, math.tau)
        steps = np.linspace(-1, 1, 40)[:, None] * 2 * extent
        along = np.array([math.cos(angle), math.sin(angle)])
        across = np.array([-along[1], along[0]])
        through = middle + rng.uniform(-0.8, 0.8, 2) * extent
        bow = rng.uniform(-0.15, 0.15) * steps**2 / max(extent, 1.0)
        stroke = (through + steps * along + bow * across) * scale
        thickness = round(rng.uniform(1, 3) * scale)
        cv2.polylines(raster, [np.rint(stroke).astype(np.int32)], False, (255,), thickness)
    for _ in range(int(rng.integers(disturbance.words[0], disturbance.words[1] + 1))):
        letters = rng.choice(list("abcdefghkmnoprstuvxyzABDEGHKMNRS0123456789"), 12)
        x, y = (middle + rng.uniform(-1, 0.8, 2) * extent) * scale
        font_scale = rng.uniform(1.5, 5) * scale / 22
        thickness = max(1, round(font_scale * rng.uniform(1.5, 4)))
        origin = (round(float(x)), round(float(y)))
        face = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(raster, "".join(letters), origin, face, font_scale, (255,), thickness)
    return raster


# ---- image


def _direction_field(size: tuple[int, int], rng: Random) -> Image:
    """Return the coordinate (height, width) along a random direction, from 0 to 1."""
    x, y = (np.arange(n, dtype=np.float32) - (n - 1) / 2 for n in size)
    angle = rng.uniform(0, math.tau)
    along = math.cos(angle) * x + math.sin(angle) * y[:, None]
    result: Image = (along - along.min()) / (along.max() - along.min())
    return result


def _blurred(disturbance: Disturbance, ink: Image, rng: Random) -> Image:
    """Return the ink as seen through defocus and motion."""
    result = cv2.GaussianBlur(ink, (0, 0), disturbance.blur_px)
    if disturbance.defocus_px:
        weight = _direction_field(disturbance.size, rng)
        # Each point of the paper is spread by its own blur, so that its light keeps its centre. A
        # blur chosen by the pixel that receives the light would move all dots to the sharp side.
        sigmas = np.linspace(disturbance.blur_px, disturbance.defocus_px, 6)
        level = weight * (len(sigmas) - 1)
        parts = [ink * np.clip(1 - np.abs(level - k), 0, 1) for k in range(len(sigmas))]
        spread = [cv2.GaussianBlur(parts[k], (0, 0), float(sigmas[k])) for k in range(len(parts))]
        result = np.sum(spread, axis=0)
    if disturbance.motion_px:
        angle = rng.uniform(0, math.tau)
        steps = np.linspace(-0.5, 0.5, 13) * disturbance.motion_px
        shifted = [
            cv2.warpAffine(
                result,
                np.array([[1, 0, math.cos(angle) * step], [0, 1, math.sin(angle) * step]]),
                disturbance.size,
                borderMode=cv2.BORDER_REFLECT,
            )
            for step in steps
        ]
        result = np.mean(shifted, axis=0)
    return np.asarray(result, np.float32)


def _smooth_noise(shape: tuple[int, int], sigma_px: float, rng: Random) -> Image:
    """Return noise of standard deviation 1 whose details are about ``sigma_px`` wide."""
    noise = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), sigma_px)
    return noise / max(float(noise.std()), 1e-9)


def _cover_by_hand(grey: Image, fraction: float, rng: Random) -> Image:
    """Cover a fraction of an image from one side by skin with a soft, wavy edge and a shadow."""
    height, width = grey.shape
    side = min(grey.shape)
    along = _direction_field((width, height), rng) * math.hypot(*grey.shape)
    along = along + _smooth_noise(grey.shape, side / 6, rng) * side * 0.05
    inside_px = np.quantile(along, fraction) - along
    skin = rng.choice([rng.uniform(40, 110), rng.uniform(140, 240)])
    texture = 6 * _smooth_noise(grey.shape, 6, rng) + 3 * _smooth_noise(grey.shape, 1.2, rng)
    shadow = 1 - rng.uniform(0.2, 0.6) * np.exp(np.minimum(inside_px, 0) / (0.1 * side))
    softness_px = rng.uniform(0.8, 3)
    cover = 1 / (1 + np.exp(-np.clip(inside_px / softness_px, -50, 50)))
    result: Image = (cover * (skin + texture) + (1 - cover) * shadow * grey).astype(np.float32)
    return result


def _add_reflection(grey: Image, radius_px: float, rng: Random) -> Image:
    """Add the reflection of a lamp: saturated within ``radius_px``, with a halo around it."""
    height, width = grey.shape
    middle_x, middle_y = rng.uniform(0, width), rng.uniform(0, height)
    x, y = np.arange(width) - middle_x, np.arange(height)[:, None] - middle_y
    stretch, angle = rng.uniform(1, 2), rng.uniform(0, math.pi)
    a = math.cos(angle) * x + math.sin(angle) * y
    b = (math.cos(angle) * y - math.sin(angle) * x) * stretch
    radius = np.hypot(a, b) / radius_px
    # The core is as bright as its edge is steep; the halo falls within a radius or two.
    core = 255 * rng.uniform(2, 6) / (1 + radius ** rng.uniform(6, 14))
    halo = rng.uniform(30, 120) * np.exp(-0.5 * (radius / rng.uniform(1.2, 2)) ** 2)
    result: Image = (grey + core + halo).astype(np.float32)
    return result


# ---- figures


@dataclass(frozen=True)
class DisturbedScore:
    """Results of disturbed frames.

    Attributes
    ----------
    correct, wrong : (n,) bool ndarray
        Accepted frames by the correctness of their position.
    nees : (3,) float64 ndarray
        Mean of error^2 / sigma^2 of the correct frames, of x, y and heading.
    """

    correct: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    nees: Array


def score(frames: DisturbedFrames, located: LocalizedFrames) -> DisturbedScore:
    """Compare localized frames with the truth."""
    errors = np.empty((len(located), 3))
    errors[:, :2] = located.grid - frames.grid
    errors[:, 2] = np.angle(np.exp(1j * (located.heading - frames.heading)))
    is_correct = np.abs(errors[:, :2]).max(axis=1) < MAX_ERROR_PITCHES
    is_correct &= np.abs(errors[:, 2]) < math.radians(MAX_ERROR_DEG)
    correct = located.accepted & is_correct
    variance = np.einsum("nii->ni", located.covariance)[correct]
    nees = np.mean(errors[correct] ** 2 / variance, axis=0) if correct.any() else np.full(3, np.nan)
    return DisturbedScore(correct, located.accepted & ~is_correct, nees)


def disturbance_figures() -> list[Figure]:
    """Return the figures of frames under each disturbance, without NEES if no frame is right."""
    return [
        figure
        for number, (name, disturbance) in enumerate(DISTURBANCES.items())
        for figure in _figures_of(name, disturbance, FIRST_SEED + 500 + number)
    ]


def _figures_of(name: str, disturbance: Disturbance, seed: int) -> Iterator[Figure]:
    frames = render(disturbance, FRAMES_PER_DISTURBANCE, seed)
    result = score(frames, localize_frames(frames.images, codec("anoto"), other_codec_odds=0))
    accepted = int(result.correct.sum() + result.wrong.sum())
    yield Figure(
        f"{name}: right", 100 * float(result.correct.mean()), "%",
        f"of {FRAMES_PER_DISTURBANCE} frames of another renderer, no camera model",
        disturbance.target, "higher",
    )  # fmt: skip
    yield Figure(
        f"{name}: wrong among accepted", 100 * int(result.wrong.sum()) / max(accepted, 1), "%",
        f"{result.wrong.sum()} of {accepted}", 0.0,
    )  # fmt: skip
    if not result.correct.any():
        return
    for axis, nees in zip(("x", "y", "heading"), result.nees, strict=True):
        yield Figure(
            f"{name}: NEES of {axis}", float(nees), "ratio",
            "mean of error^2 / sigma^2 of the correct frames; 1 is expected", 2.0,
        )  # fmt: skip
