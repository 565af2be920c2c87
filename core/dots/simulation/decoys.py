"""Frames without the pattern, which a solver of dots must reject."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError

Image = NDArray[np.float32]

LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.,:;!?-"

PITCH_PX = 0.508 / 0.046
"""Pitch of the pattern in the paper's camera, for decoys that resemble it."""

DRAWING_SCALE = 4
"""Scale at which figures are drawn before they are averaged to pixels."""


def decoys(kind: str, n: int, seed: int, size: tuple[int, int] = (188, 120)) -> NDArray[np.uint8]:
    """Return frames of something else.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.

        ``"noise"``: independent grey values, soft or hard; ``"blank"``: paper, dark, or
        overexposed; ``"text"``: printed lines; ``"checkerboard"`` and ``"lines"``: with a
        random pitch; ``"halftone"``: a regular screen of dots; ``"texture"``: clouds with the
        spectrum of photographs; ``"random dots"``: dots of the pattern's size at random
        positions; ``"random symbols"``: the lattice of the pattern with random symbols, so that
        all except the code is correct.
    n : int
    seed : int
        The same arguments give the same frames.
    size : (width, height)

    Returns
    -------
    (n, height, width) uint8 ndarray

    Raises
    ------
    InputError
        There is no such kind.
    """
    if kind not in KINDS:
        raise InputError(f"no decoys {kind!r}", hint=f"Known kinds: {', '.join(KINDS)}")
    rng = np.random.default_rng([seed, sorted(KINDS).index(kind)])
    frames = [KINDS[kind](rng, size) for _ in range(n)]
    return np.array(frames).reshape(n, size[1], size[0])


def _photographed(ink: Image, rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Convert ink (0 paper, 1 black) to a frame with random contrast, blur, light and noise."""
    if ink.shape != size[::-1]:
        ink = cv2.resize(ink, size, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(ink, (0, 0), rng.uniform(0.4, 1.5))
    paper, contrast = rng.uniform(120, 250), rng.uniform(0.3, 1.0)
    x = np.linspace(-1, 1, size[0], dtype=np.float32)
    y = np.linspace(-1, 1, size[1], dtype=np.float32)[:, None]
    light = 1 - rng.uniform(0, 0.2) * (x * x + y * y)
    grey = paper * (1 - contrast * blurred) * light + rng.normal(0, rng.uniform(1, 8), ink.shape)
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


def _noise(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    shape = size[::-1]
    if rng.random() < 0.5:
        return rng.integers(0, 256, shape, np.uint8)
    grey = rng.normal(rng.uniform(60, 200), rng.uniform(5, 60), shape)
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


def _blank(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    shape = size[::-1]
    if rng.random() < 0.2:
        return np.full(shape, rng.choice([0, 128, 255]), np.uint8)
    grey = rng.choice([rng.uniform(0, 30), rng.uniform(30, 225), rng.uniform(225, 300)])
    slope = rng.uniform(-30, 30, 2)
    x, y = np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1])[:, None]
    level = grey + slope[0] * x + slope[1] * y + rng.normal(0, rng.uniform(0.3, 4), shape)
    return np.rint(np.clip(level, 0, 255)).astype(np.uint8)


def _text(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    width, height = 2 * size[0], 2 * size[0]
    page = np.zeros((height, width), np.uint8)
    scale = rng.uniform(0.3, 1.6)
    font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
    for y in np.arange(rng.uniform(0, 30), height, 34 * scale):
        line = "".join(rng.choice(list(LETTERS + " " * 8), 60))
        weight = int(rng.integers(1, 4))
        cv2.putText(page, line, (-10, int(y)), font, scale, (255,), weight, cv2.LINE_AA)
    return _photographed(_rotated(page, rng, size), rng, size)


def _rotated(page: NDArray[np.uint8], rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return the middle of a page, rotated by a random angle, at twice the scale of the frame."""
    middle = ((page.shape[1] - 1) / 2, (page.shape[0] - 1) / 2)
    transform = cv2.getRotationMatrix2D(middle, rng.uniform(0, 360), 1.0)
    transform[:, 2] += [size[0] - middle[0], size[1] - middle[1]]
    doubled = cv2.warpAffine(page, transform, (2 * size[0], 2 * size[1]))
    return np.divide(doubled, 255, dtype=np.float32)


def _axes(rng: np.random.Generator, size: tuple[int, int]) -> tuple[Image, Image]:
    """Return coordinates in px of the drawn frame along two axes at a random angle."""
    y, x = (
        np.mgrid[: DRAWING_SCALE * size[1], : DRAWING_SCALE * size[0]].astype(np.float32)
        / DRAWING_SCALE
    )
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return c * x + s * y, c * y - s * x


def _checkerboard(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    u, v = _axes(rng, size)
    field = rng.uniform(3, 40)
    dark = (np.floor(u / field) + np.floor(v / field)).astype(np.int32) & 1
    return _photographed(dark.astype(np.float32), rng, size)


def _lines(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    u, v = _axes(rng, size)
    pitch, width = rng.uniform(3, 25), rng.uniform(0.1, 0.5)
    dark = (u / pitch) % 1 < width
    if rng.random() < 0.5:
        dark |= (v / pitch) % 1 < width
    return _photographed(dark.astype(np.float32), rng, size)


def _halftone(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    u, v = _axes(rng, size)
    pitch, radius = float(rng.choice([PITCH_PX, rng.uniform(4, 25)])), rng.uniform(0.08, 0.4)
    u, v = (a / pitch - np.rint(a / pitch) for a in (u, v))
    return _photographed((u * u + v * v < radius**2).astype(np.float32), rng, size)


def _texture(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    width, height = size
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    frequency[0, 0] = 1 / max(size)
    # In photographs, amplitudes fall with about the first power of the frequency.
    amplitude = frequency ** -rng.uniform(0.5, 1.6)
    phases = np.exp(2j * np.pi * rng.random(frequency.shape))
    clouds = np.fft.irfft2(amplitude * phases, s=(height, width))
    clouds = (clouds - clouds.mean()) / clouds.std() * rng.uniform(10, 60) + rng.uniform(80, 180)
    return np.rint(np.clip(clouds, 0, 255)).astype(np.uint8)


def _discs(
    centres: NDArray[np.float64],
    diameter_px: float,
    rng: np.random.Generator,
    size: tuple[int, int],
) -> NDArray[np.uint8]:
    page = np.zeros((DRAWING_SCALE * size[1], DRAWING_SCALE * size[0]), np.uint8)
    for x, y in np.rint(((centres + 0.5) * DRAWING_SCALE - 0.5) * 16).astype(int):
        radius = round(diameter_px / 2 * DRAWING_SCALE * 16)
        cv2.circle(page, (int(x), int(y)), radius, (255,), -1, cv2.LINE_AA, 4)
    return _photographed(np.divide(page, 255, dtype=np.float32), rng, size)


def _random_dots(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    count = rng.poisson(size[0] * size[1] / PITCH_PX**2 * rng.uniform(0.3, 2))
    centres = rng.uniform(0, size, (count, 2))
    return _discs(centres, PITCH_PX * rng.uniform(0.15, 0.4), rng, size)


def _random_symbols(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    half = int(np.hypot(*size) / 2 / PITCH_PX) + 2
    x, y = (a.ravel() for a in np.mgrid[-half : half + 1, -half : half + 1].astype(float))
    symbol_rad = rng.integers(0, 4, len(x)) * np.pi / 2
    grid = np.stack([x + np.cos(symbol_rad) / 6, y + np.sin(symbol_rad) / 6], axis=1)
    angle = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centres = (grid + rng.uniform(-0.5, 0.5, 2)) @ rotation * PITCH_PX + np.array(size) / 2
    return _discs(centres, PITCH_PX * rng.uniform(0.2, 0.35), rng, size)


KINDS: dict[str, Callable[[np.random.Generator, tuple[int, int]], NDArray[np.uint8]]] = {
    "noise": _noise,
    "blank": _blank,
    "text": _text,
    "checkerboard": _checkerboard,
    "lines": _lines,
    "halftone": _halftone,
    "texture": _texture,
    "random dots": _random_dots,
    "random symbols": _random_symbols,
}
