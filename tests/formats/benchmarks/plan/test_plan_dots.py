"""Figures of the planning of dot cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.dots.design.pose_accuracy import dots_in_frame, pose_accuracy
from locatk.formats.benchmarks.plan import dots


def test_tasks_differ_and_are_repeatable() -> None:
    tasks = [dots.make_task(number) for number in range(dots.TASKS)]
    assert tasks == [dots.make_task(number) for number in range(dots.TASKS)]
    assert len({(task.distance_m, task.noise_levels) for task in tasks}) == dots.TASKS


def test_a_task_is_predicted_within_its_goal() -> None:
    result = dots.run_task(0, frames=24)
    assert 0.6 < result.position_ratio < 1.7
    assert 0.6 < result.heading_ratio < 1.7


def test_noise_of_an_image() -> None:
    rng = np.random.default_rng(1)
    image = np.rint(128 + 3 * rng.standard_normal((200, 200))).astype(np.uint8)
    assert dots.pixel_noise(image) == pytest.approx(3, rel=0.05)


def test_scatter_of_simulated_dots() -> None:
    size, pitch, sigma = (188, 120), 11.0, 0.3
    grid = dots_in_frame(size, pitch, 0.3)
    c, s = np.cos(0.3), np.sin(0.3)
    pixels = pitch * grid @ np.array([[c, -s], [s, c]])
    pixels += sigma * np.random.default_rng(1).standard_normal(pixels.shape)
    scatter = dots.measure_scatter(pixels, grid)
    expected = pose_accuracy(size, pitch, sigma)
    assert scatter.dot_pitches == pytest.approx(sigma / pitch, rel=0.15)
    assert scatter.position_pitches == pytest.approx(expected.position_pitches, rel=0.25)
    assert scatter.heading_rad == pytest.approx(expected.heading_rad, rel=0.25)


def test_the_published_frame(data: Path) -> None:
    path = data / "dots" / "frame.bmp"
    if not path.is_file():
        pytest.skip(f"no {path}")
    figures = list(dots.published_frame_figures(path))
    for figure in figures[:3]:
        assert figure.value is not None
        assert 0.5 < figure.value < 2


def test_a_missing_frame_is_explained(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        list(dots.published_frame_figures(tmp_path / "none.bmp"))
