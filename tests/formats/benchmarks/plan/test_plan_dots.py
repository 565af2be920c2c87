"""Figures of the planning of dot cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.formats.benchmarks.plan import dots


def test_tasks_differ_and_are_repeatable() -> None:
    tasks = [dots.make_task(number) for number in range(dots.TASKS)]
    assert tasks == [dots.make_task(number) for number in range(dots.TASKS)]
    assert len({(task.distance_m, task.noise_levels) for task in tasks}) == dots.TASKS


def test_the_sums_of_the_paper() -> None:
    for figure in dots.paper_figures():
        assert figure.value == pytest.approx(figure.peer_value, rel=0.002), figure.name


def test_a_task_is_predicted_within_its_goal() -> None:
    result = dots.run_task(0, frames=24)
    assert 0.6 < result.position_ratio < 1.7
    assert 0.6 < result.heading_ratio < 1.7


def test_noise_of_an_image() -> None:
    rng = np.random.default_rng(1)
    image = np.rint(128 + 3 * rng.standard_normal((200, 200))).astype(np.uint8)
    assert dots.pixel_noise(image) == pytest.approx(3, rel=0.05)


def test_the_published_frame(data: Path) -> None:
    path = data / "dots" / "frame.bmp"
    if not path.is_file():
        pytest.skip(f"no {path}")
    scatter, *_ = dots.published_frame_figures(path)
    assert scatter.value is not None
    assert 0.5 < scatter.value < 2


def test_a_missing_frame_is_explained(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        list(dots.published_frame_figures(tmp_path / "none.bmp"))
