"""The bench's table: what it prints where data is absent, and how it measures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.lighthouse import solve
from locatk.formats.benchmarks import Figure, lighthouse

PROMISED = {
    "one station, planar: MAE": 3.4,
    "two stations, planar: MAE": 2.9,
    "3D grid, paper's scale: MAE": 2.3,
    "3D grid, similarity: MAE": 0.95,
    "3D grid, static scatter x": 0.087,
    "3D grid, static scatter y": 0.262,
    "3D grid, static scatter z": 0.135,
    "3D grid from 8 places: MAE": 25.2,
    "3D grid from 10 places: MAE": 23.1,
    "3D grid from 15 places: MAE": 18.7,
    "3D grid from 20 places: MAE": 11.2,
    "3D grid from 30 places: MAE": 8.2,
    "3D grid from 50 places: MAE": 7.2,
    "3D grid from 100 places: MAE": 6.7,
    "3D grid, 4,759 points: scene and poses": 0.15,
    "1,000,000 sweeps in a known scene": 1.0,
    "session of 1,000,000 sweeps read": 2.0,
}
"""Section 3 of the issue: name and target of each figure."""

EQUAL_IN_TRUE_HEIGHT = "3D grid, static scatter z"
"""Its target was measured in heights that are 8 % short; see the bench's own note."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few trials and few sweeps: the road, not the figures."""
    monkeypatch.setattr(lighthouse, "TRIALS", 3)
    monkeypatch.setattr(lighthouse, "MILLION", 4000)


@pytest.mark.parametrize(
    ("value", "target", "better", "met"),
    [
        (1.0, 2.0, "lower", True),
        (2.0, 2.0, "lower", True),
        (2.1, 2.0, "lower", False),
        (2.1, 2.0, "higher", True),
        (1.9, 2.0, "higher", False),
        (None, 2.0, "lower", None),
        (1.0, None, "lower", None),
        (float("nan"), 2.0, "lower", False),
    ],
)
def test_a_target_is_met_or_not(
    value: float | None, target: float | None, better: str, met: bool | None
) -> None:
    figure = Figure("f", value, "mm", "how", target, better)  # type: ignore[arg-type]
    assert figure.met is met


@pytest.mark.usefixtures("quick")
def test_absent_data_is_said_and_costs_no_other_figure(tmp_path: Path) -> None:
    found = {figure.name: figure for figure in lighthouse.figures(tmp_path)}
    assert set(PROMISED) <= set(found)
    for name, target in PROMISED.items():
        figure = found[name]
        assert figure.target == target
        if "1,000,000" in name:
            assert figure.value is not None
            continue
        assert figure.value is None
        assert figure.met is None
        assert str(tmp_path) in figure.how


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_every_promise_is_measured_and_accuracy_is_kept(data: Path) -> None:
    rows = lighthouse.figures(data)
    found = {figure.name: figure for figure in rows}
    assert len(found) == len(rows)
    assert set(PROMISED) <= set(found)
    for name, target in PROMISED.items():
        figure = found[name]
        assert figure.target == target
        assert figure.value is not None, figure.how
        assert figure.how
        # Seconds are told, not asserted; of the rest one is equal but for its unit.
        if figure.unit == "mm" and name != EQUAL_IN_TRUE_HEIGHT:
            assert figure.met, f"{name}: {figure.value}"
    height = found[EQUAL_IN_TRUE_HEIGHT].value
    assert height is not None
    assert height < 0.135 * 1.085


@pytest.mark.usefixtures("quick")
def test_a_million_sweeps_are_solved_to_where_they_were_made() -> None:
    sweeps, scene = lighthouse._a_million()
    assert len(sweeps) == lighthouse.MILLION
    solution = solve(sweeps, scene)
    assert solution.poses == lighthouse.MILLION // 4
    (track,) = solution.trajectories
    phase = np.arange(solution.poses) * 1e-3
    road = np.stack([np.cos(phase), np.sin(1.3 * phase), 0.2 + 0.1 * np.sin(phase)], axis=1)
    # One count of noise is 52 microradians, at three metres.
    assert np.linalg.norm(track.position - road, axis=1).mean() < 5e-4
    assert solution.rejected == {}
