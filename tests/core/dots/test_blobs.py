"""Where dots are found, against discs that were drawn where it is known."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.detection.blobs import DetectedDots, detect_dots

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SIZE = (188, 120)
FINE = 16
"""Fine pixels a pixel; discs are drawn in fine pixels to 1/16 of one, then averaged."""


def positions(rng: np.random.Generator, step: float = 11.0, size: tuple[int, int] = SIZE) -> Array:
    """Centres on a loose grid, 8 px from the rim, anywhere between the pixels."""
    width, height = size
    x, y = np.meshgrid(np.arange(8, width - 8, step), np.arange(8, height - 8, step))
    at = np.stack([x, y], axis=-1).reshape(-1, 2)
    loose: Array = at + rng.uniform(-step / 6, step / 6, at.shape)
    return loose


def draw(
    at: Array,
    diameter: float,
    rng: np.random.Generator,
    *,
    blur: float = 0.6,
    paper: float = 210.0,
    ink: float = 50.0,
    light: Any = 1.0,
    noise: float = 2.0,
    size: tuple[int, int] = SIZE,
) -> Image:
    """Discs of ``ink`` on ``paper``."""
    width, height = size
    canvas = np.zeros((height * FINE, width * FINE), np.uint8)
    for x, y in (at + 0.5) * FINE - 0.5:
        radius = round(diameter / 2 * FINE * 16)
        cv2.circle(canvas, (round(x * 16), round(y * 16)), radius, 255, -1, cv2.LINE_8, 4)
    fraction = cv2.resize(canvas, size, interpolation=cv2.INTER_AREA) / 255.0
    if blur:
        fraction = cv2.GaussianBlur(fraction, (0, 0), blur)
    grey = light * (paper - (paper - ink) * fraction) + rng.normal(0, noise, fraction.shape)
    frame: Image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return frame


def of(dots: DetectedDots, frame: int = 0) -> Array:
    return dots.xy[frame][dots.valid[frame]].astype(float)


def errors(at: Array, image: Image) -> tuple[Array, int, int]:
    """Errors (n, 2) of the dots that were found, how many were not, and what else was found."""
    result = of(detect_dots(image[None]))
    away = np.linalg.norm(at[:, None] - result[None], axis=2)
    nearest, there = away.argmin(axis=1), away.min(axis=1) < 1.5
    error = (result[nearest] - at)[there]
    return error, int((~there).sum()), len(result) - len(set(nearest[there].tolist()))


@pytest.mark.parametrize(
    ("diameter", "step", "scatter"),
    [(1.5, 11, 0.05), (1.84, 11, 0.04), (2.5, 11, 0.025), (3.3, 11, 0.02), (4, 13, 0.02),
     (5, 14, 0.03), (6, 16, 0.03), (7, 20, 0.08)],
)  # fmt: skip
def test_dots_of_every_size(diameter: float, step: float, scatter: float) -> None:
    rng = np.random.default_rng(1)
    all_errors = []
    for _ in range(3):
        at = positions(rng, step)
        error, lost, extra = errors(at, draw(at, diameter, rng))
        assert (lost, extra) == (0, 0)
        all_errors.append(error)
    error = np.concatenate(all_errors)
    assert np.sqrt(np.mean(error**2)) < scatter
    assert np.abs(error.mean(axis=0)).max() < 4 * scatter / np.sqrt(len(error))


def across(low: float, high: float) -> Array:
    """Light that grows from left to right."""
    ramp: Array = np.linspace(low, high, SIZE[0])[None]
    return ramp


def vignette(fraction: float) -> Array:
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE[0]), np.linspace(-1, 1, SIZE[1]))
    fall: Array = 1 - fraction * (x * x + y * y) / 2
    return fall


@pytest.mark.parametrize(
    ("how", "scatter", "off"),
    [
        ({"noise": 16.0}, 0.12, 0),
        ({"light": vignette(0.4), "noise": 8.0}, 0.08, 0),
        ({"light": across(0.4, 1.0)}, 0.04, 0),
        ({"light": np.where(np.arange(SIZE[0]) < 94, 0.35, 1.0)[None]}, 0.06, 10),
        ({"paper": 40.0, "ink": 15.0, "noise": 1.0}, 0.05, 0),
        ({"paper": 200.0, "ink": 175.0, "noise": 1.0}, 0.05, 0),
        ({"paper": 400.0, "ink": 100.0}, 0.06, 0),
        ({"blur": 2.2}, 0.1, 0),
    ],
    ids=["noise", "vignette", "ramp", "shadow", "dark", "faint", "overexposed", "blurred"],
)
def test_dots_in_any_light(how: dict[str, Any], scatter: float, off: int) -> None:
    rng = np.random.default_rng(2)
    at = positions(rng)
    error, lost, extra = errors(at, draw(at, 3.3, rng, **how))
    assert lost <= off  # the edge of a shadow hides those on it, and looks like some
    assert extra <= off
    assert np.sqrt(np.mean(error**2)) < scatter


def test_light_from_a_side_moves_no_dots() -> None:
    rng = np.random.default_rng(3)
    means = []
    for low, high in ((0.6, 1.0), (1.0, 0.6)):
        at = positions(np.random.default_rng(4))
        error, *_ = errors(at, draw(at, 3.3, rng, light=across(low, high), noise=1.0))
        means.append(error.mean(axis=0))
    assert np.abs(np.array(means)).max() < 0.006


@pytest.mark.parametrize("diameter", [2.5, 4.0])
def test_light_that_falls_steeply_moves_no_dots(diameter: float) -> None:
    # In both directions, to a twentieth of the brightness; the light alone would move a Gaussian
    # dot by its variance times the relative slope, 0.03 px on average.
    rng = np.random.default_rng(3)
    for low, high in ((0.05, 1.0), (1.0, 0.05)):
        at = positions(np.random.default_rng(4))
        error, lost, _ = errors(at, draw(at, diameter, rng, light=across(low, high), noise=0.5))
        assert lost < len(at) / 20
        assert abs(error.mean(axis=0)).max() < 0.008


def test_dots_in_a_halo_stay() -> None:
    rng = np.random.default_rng(3)
    at = positions(rng)
    x, y = np.meshgrid(np.arange(SIZE[0]) - 94, np.arange(SIZE[1]) - 60)
    halo = 0.3 + 0.7 * np.exp(-0.5 * (x * x + y * y) / 35.0**2)
    error, lost, _ = errors(at, draw(at, 3.3, rng, light=halo, noise=0.5))
    assert lost == 0
    # Outwards, on average: 0.05 px without the light's slope at each dot.
    outwards = (at - [94, 60]) / np.linalg.norm(at - [94, 60], axis=1)[:, None]
    assert abs((error * outwards).sum(axis=1).mean()) < 0.012


def test_neighbours_that_lean_to_each_other_are_two() -> None:
    # Two thirds of a pitch apart at most: 7.4 px for dots of 3.9 px.
    rng = np.random.default_rng(5)
    middle = positions(rng, 26.0)[1:] + 3.0
    rotation = rng.uniform(0, 2 * np.pi, len(middle))
    arm = 7.4 / 2 * np.stack([np.cos(rotation), np.sin(rotation)], axis=1)
    at = np.concatenate([middle + arm, middle - arm])
    error, lost, extra = errors(at, draw(at, 3.9, rng))
    assert (lost, extra) == (0, 0)
    assert np.sqrt(np.mean(error**2)) < 0.06


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_each_dot_is_detected_once_without_noise(width: int) -> None:
    # Squares of whole pixels, as `print pattern --format png` makes them: equal minima.
    image = np.full((120, 192), 255, np.uint8)
    corners = [(x, y) for x in range(6, 180, 12) for y in range(6, 110, 12)]
    for x, y in corners:
        image[y : y + width, x : x + width] = 0
    error, lost, extra = errors(np.array(corners, float) + (width - 1) / 2, image)
    assert (lost, extra) == (0, 0)
    assert np.abs(error).max() < 0.02


def test_specks_that_are_fainter_than_dots_are_no_dots() -> None:
    rng = np.random.default_rng(6)
    at = positions(rng, 13.0)
    image = draw(at, 3.3, rng).astype(int)
    specks = draw(at + 6.0, 2.0, rng, ink=170.0, noise=0.0)
    image -= 210 - specks.astype(int)
    _, lost, extra = errors(at, np.clip(image, 0, 255).astype(np.uint8))
    assert (lost, extra) == (0, 0)


def test_a_few_things_much_darker_than_dots_hide_none() -> None:
    rng = np.random.default_rng(7)
    at = positions(rng)
    image = draw(at, 3.0, rng, ink=150.0)
    for x, y in rng.uniform(20, 100, (8, 2)):
        cv2.circle(image, (int(x), int(y)), 2, 0, -1)
    _, lost, extra = errors(at, image)
    assert lost <= 8  # those under the dirt
    assert extra <= 10  # the dirt


def test_no_dots_where_there_are_none() -> None:
    rng = np.random.default_rng(8)
    even = [np.full((3, 120, 188), grey, np.uint8) for grey in (0, 1, 128, 254, 255)]
    slope = np.broadcast_to(np.linspace(0, 255, 188).astype(np.uint8), (1, 120, 188))
    step = np.where(np.arange(188) < 90, 30, 220).astype(np.uint8) * np.ones((1, 120, 1), np.uint8)
    soft = np.clip(np.rint(150 + rng.normal(0, 0.4, (2, 120, 188))), 0, 255).astype(np.uint8)
    for images in (*even, slope, step, soft):
        assert detect_dots(np.ascontiguousarray(images)).counts.max() <= 3


def test_white_on_black_has_no_dots_at_its_spots() -> None:
    rng = np.random.default_rng(9)
    at = positions(rng)
    dots = of(detect_dots(255 - draw(at, 3.3, rng)[None]))
    if len(dots):
        assert np.linalg.norm(at[:, None] - dots[None], axis=2).min() > 1.5


@pytest.mark.parametrize(
    "size", [(1, 1), (2, 7), (4, 4), (5, 5), (6, 9), (17, 3), (48, 48), (333, 77)]
)
def test_any_image_will_do(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(10)
    images = np.stack(
        [
            np.zeros(size, np.uint8),
            np.full(size, 255, np.uint8),
            rng.integers(0, 256, size, np.uint8),
            ((np.indices(size).sum(axis=0) % 2) * 255).astype(np.uint8),
        ]
    )
    dots = detect_dots(images)
    assert dots.xy.shape == (4, dots.valid.shape[1], 2)
    assert np.isfinite(dots.xy).all()
    for k in range(4):
        inside = (of(dots, k) >= -0.5) & (of(dots, k) <= np.array(size[::-1]) - 0.5)
        assert inside.all()


def test_no_more_dots_than_asked_for() -> None:
    noise = np.random.default_rng(11).integers(0, 256, (2, 400, 400), np.uint8)
    assert detect_dots(noise).counts.min() > 1000
    for most in (1, 64, 900):
        dots = detect_dots(noise, most)
        assert dots.valid.shape == (2, most)
        np.testing.assert_array_equal(dots.counts, most)


def test_of_too_many_dots_those_about_the_middle_are_kept() -> None:
    rng = np.random.default_rng(12)
    at = positions(rng)
    kept = of(detect_dots(draw(at, 3.3, rng)[None], 40))
    reach = np.sort(np.linalg.norm(at - [93.5, 59.5], axis=1))
    assert len(kept) == 40
    assert np.linalg.norm(kept - [93.5, 59.5], axis=1).max() < reach[40] + 0.5


def test_frames_do_not_depend_on_their_company() -> None:
    rng = np.random.default_rng(13)
    frames = [draw(positions(rng, s), 3.3, rng, noise=n) for s, n in ((11, 2), (15, 9), (25, 1))]
    frames.append(rng.integers(0, 256, (120, 188), np.uint8))
    together = detect_dots(np.stack(frames))
    for k, frame in enumerate(frames):
        alone = detect_dots(frame[None])
        np.testing.assert_array_equal(of(together, k), of(alone))
        assert together.counts[k] == alone.counts[0]
    assert (together.xy[~together.valid] == 0).all()
