"""Predicted and simulated drives over landmarks, by the bench."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import numpy as np
import pytest

from locatk.formats.benchmarks.plan.landmarks import KINDS, make_task, measure_task


@pytest.mark.slow
def test_prediction_is_near_the_errors_of_simulated_drives() -> None:
    result = measure_task(make_task(9), seed=7, drives=2)
    ratio = result.predicted / result.reached
    assert ratio.shape == (len(KINDS),)
    assert np.all((ratio > 0.4) & (ratio < 2.5))
    predicted_m, reached_m = result.longest_m
    assert reached_m == pytest.approx(predicted_m, abs=0.1)
    first_m, found_m = result.first_m
    assert found_m < first_m + 0.35


def test_tasks_differ_and_are_repeatable() -> None:
    first, again, other = make_task(3), make_task(3), make_task(4)
    np.testing.assert_array_equal(first.route.waypoint_m, again.route.waypoint_m)
    assert first.noise == again.noise != other.noise
    assert first.floor.geometry != other.floor.geometry


@pytest.mark.parametrize("module", ["visit_accuracy", "routes", "bar_search"])
def test_predictor_does_not_import_the_simulator(module: str) -> None:
    path = importlib.import_module(f"locatk.core.landmarks.design.{module}").__file__
    assert path is not None
    names = [
        node.module or ""
        for node in ast.walk(ast.parse(Path(path).read_text()))
        if isinstance(node, ast.ImportFrom)
    ]
    assert names
    assert not [name for name in names if "simulation" in name]
