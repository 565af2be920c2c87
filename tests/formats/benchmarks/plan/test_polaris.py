"""Figures of the planning of Polaris."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.simulation import exact_trajectory
from locatk.formats.benchmarks.plan import polaris


def test_tasks_differ_and_are_repeatable() -> None:
    tasks = [polaris.make_task(number) for number in range(polaris.TASKS)]
    again = polaris.make_task(3)
    assert again.tags == tasks[3].tags
    assert again.noise == tasks[3].noise
    assert len({task.tags.spacing_m for task in tasks}) == polaris.TASKS
    for task in tasks:
        (route,) = task.predict().routes
        assert len(route.passes) == polaris.TAGS


def test_drift_bends_a_straight_path_to_a_circle() -> None:
    x = np.linspace(0, 2, 2001)
    position = np.column_stack([x, 0 * x])
    straight = exact_trajectory("bar", "odom", np.arange(2001), position, 0 * x)
    bent = polaris.with_drift(straight, 0.5)
    radius = 1 / 0.5
    assert bent.position[:, 0] == pytest.approx(radius * np.sin(x / radius), abs=1e-6)
    assert bent.position[:, 1] == pytest.approx(radius * (1 - np.cos(x / radius)), abs=1e-6)
    assert heading_from_quaternion(bent.quaternion) == pytest.approx(x / radius)


@pytest.mark.slow
def test_a_task_is_predicted_within_its_goal() -> None:
    result = polaris.measure_task(polaris.make_task(8), 7, drives=4)
    assert result.read == result.passed == 4 * polaris.TAGS
    assert (np.maximum(result.ratio, 1 / result.ratio) < polaris.TAIL_RATIO).all()


@pytest.mark.slow
def test_the_published_recordings_are_predicted_within_their_goal(data: Path) -> None:
    rows = [row for row in polaris.recording_figures(data / "polaris") if row.target is not None]
    assert len(rows) == 4
    assert all(row.met for row in rows), rows


def test_the_sampling_rate_of_the_published_firmware() -> None:
    assert polaris.rate_figure().value == pytest.approx(1 / 16.35e-3, rel=0.01)


def test_mean_length_and_alignment() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4))
    draws = rng.normal(size=(200_000, 4)) @ root.T
    lengths = np.hypot(draws[:, 0::2], draws[:, 1::2]).mean()
    assert polaris._mean_length(root @ root.T) == pytest.approx(lengths, rel=0.01)
    cells = np.array([[0.0, 0], [1, 0], [0, 2], [3, 1]])
    moved = cells * [1.1, 1] + np.column_stack([-cells[:, 1], cells[:, 0]]) * 0.01 + 5
    change = (moved - cells).ravel()
    assert polaris._without_alignment(cells) @ change == pytest.approx(0, abs=1e-9)
