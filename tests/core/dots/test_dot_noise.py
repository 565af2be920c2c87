"""Closed forms of the error of a dot and of a pose, against Monte Carlo with code of its own."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter1d
from scipy.spatial import cKDTree

from locatk.core.dots.design.dot_noise import PAPER_LEVEL, DotImage, dot_error
from locatk.core.dots.design.pose_accuracy import dots_in_frame, pose_accuracy
from locatk.core.dots.detection.blobs import detect_dots

OVERSAMPLING = 8


def image_of_discs(
    image: DotImage, count: int, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Render discs at random fractions of pixels by counting samples; motion is along x."""
    rng = np.random.default_rng(seed)
    spacing = math.ceil(image.pitch_px)
    side = spacing * (count + 1)
    nodes = spacing * np.stack(np.meshgrid(*[np.arange(1, count + 1)] * 2), axis=-1).reshape(-1, 2)
    centres = nodes + rng.uniform(-0.5, 0.5, nodes.shape)
    fine = (np.arange(side * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    ink = np.zeros((len(fine), len(fine)), np.float32)
    for x, y in centres:
        low = [int((c - image.diameter_px) * OVERSAMPLING) for c in (x, y)]
        high = [int((c + image.diameter_px + 2) * OVERSAMPLING) for c in (x, y)]
        dx = fine[low[0] : high[0]] - x
        dy = fine[low[1] : high[1], None] - y
        ink[low[1] : high[1], low[0] : high[0]] += dx**2 + dy**2 < image.diameter_px**2 / 4
    if image.motion_px:
        ink = uniform_filter1d(ink, round(image.motion_px * OVERSAMPLING), axis=1)
    ink = gaussian_filter(ink, image.blur_px * OVERSAMPLING)
    ink = ink.reshape(side, OVERSAMPLING, side, OVERSAMPLING).mean(axis=(1, 3))
    grey = PAPER_LEVEL * (1 - image.contrast * ink)
    grey += PAPER_LEVEL * image.noise * rng.standard_normal(grey.shape)
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8), centres


@pytest.mark.parametrize(
    "image",
    [
        DotImage(16, 3.3, 0.6, noise=0.03),
        DotImage(16, 2.0, 1.0, noise=0.01),
        DotImage(16, 4.0, 1.6, noise=0.02),
    ],
)
def test_noise_of_a_dot_agrees_with_detections(image: DotImage) -> None:
    frame, centres = image_of_discs(image, 18, 1)
    found = detect_dots(frame[None])
    positions = found.xy[0][found.valid[0]].astype(float)
    distance, index = cKDTree(centres).query(positions)
    is_inner = (np.abs(centres[index] - frame.shape[0] / 2) < frame.shape[0] / 2 - 20).all(axis=1)
    error = (positions - centres[index])[is_inner & (distance < 1)]
    assert len(error) > 200
    assert dot_error(image).total_px == pytest.approx(math.sqrt(np.mean(error**2)), rel=0.12)


def test_noise_grows_with_the_noise_and_with_the_blur() -> None:
    base = dot_error(DotImage(11, 3.3, 0.6, noise=0.01))
    assert dot_error(DotImage(11, 3.3, 0.6, noise=0.02)).noise_px == pytest.approx(
        2 * base.noise_px, rel=1e-6
    )
    assert dot_error(DotImage(11, 3.3, 1.5, noise=0.01)).noise_px > 1.5 * base.noise_px


def test_motion_and_neighbours_scatter_the_dots() -> None:
    still = dot_error(DotImage(11, 3.3, 0.6))
    assert dot_error(DotImage(11, 3.3, 0.6, motion_px=4)).sampling_px > 10 * still.sampling_px
    assert dot_error(DotImage(5, 1.5, 1.2)).sampling_px > 10 * still.sampling_px


@pytest.mark.parametrize("size", [(188, 120), (96, 96)])
def test_pose_accuracy_agrees_with_homographies_of_noisy_dots(size: tuple[int, int]) -> None:
    pitch, sigma, direction = 11.0, 0.1, 0.45
    grid = dots_in_frame(size, pitch, direction)
    c, s = math.cos(direction), math.sin(direction)
    pixels = pitch * grid @ np.array([[c, -s], [s, c]])
    rng = np.random.default_rng(2)
    origins, headings = [], []
    for _ in range(300):
        noisy = pixels + sigma * rng.standard_normal(pixels.shape)
        homography, _ = cv2.findHomography(noisy, grid, 0)
        ends = cv2.perspectiveTransform(np.array([[[0.0, 0.0], [1e-3, 0.0]]]), homography)[0]
        origins.append(ends[0])
        right = ends[1] - ends[0]
        headings.append(math.atan2(right[1], right[0]) - direction)
    expected = pose_accuracy(size, pitch, sigma)
    assert expected.position_pitches == pytest.approx(np.sqrt(np.mean(np.square(origins))), rel=0.1)
    assert expected.heading_rad == pytest.approx(np.sqrt(np.mean(np.square(headings))), rel=0.1)


def test_pose_is_never_better_than_the_bounds_of_a_translation_and_a_rotation() -> None:
    accuracy = pose_accuracy((188, 120), 11.0, 0.1)
    grid = dots_in_frame((188, 120), 11.0, 0.45)
    assert accuracy.position_pitches > 0.1 / 11 / math.sqrt(len(grid))
    assert accuracy.heading_rad > 0.1 / 11 / math.sqrt((grid**2).sum())


def test_an_unknown_lens_costs_the_position_and_the_heading_nothing() -> None:
    known = pose_accuracy((188, 120), 11.0, 0.1)
    unknown = pose_accuracy((188, 120), 11.0, 0.1, is_lens_known=False)
    assert unknown.position_pitches == pytest.approx(known.position_pitches, rel=0.01)
    assert unknown.heading_rad == pytest.approx(known.heading_rad, rel=0.01)
    assert unknown.heading_rad >= known.heading_rad
