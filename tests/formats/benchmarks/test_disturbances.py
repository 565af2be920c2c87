"""Passes over tags that are not straight, level and clean, on fields of magpylib's cylinders."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion
from locatk.core.polaris.detection.magnets import detect_magnets
from locatk.core.polaris.detection.window import Effort, PreparedPass, prepare_pass
from locatk.core.polaris.preprocessing import find_passes, preprocess
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.formats.benchmarks.polaris.disturbances import (
    DISTURBANCES,
    Disturbance,
    DisturbedPass,
    nees,
    simulate_disturbed,
    solve_disturbed,
)

Array = NDArray[np.float64]

FIRST_SEED = 730_000
"""Seed of the first pass; no threshold was chosen with these."""


def spent_effort(disturbed: DisturbedPass, monkeypatch: pytest.MonkeyPatch) -> tuple[float, float]:
    """Return the work of all hypotheses of the first pass, and its limit."""
    efforts: list[Effort] = []

    def prepare(*arguments: Any) -> PreparedPass:
        prepared = prepare_pass(*arguments)
        efforts.append(prepared.window.effort)
        return prepared

    monkeypatch.setattr("locatk.core.polaris.detection.magnets.prepare_pass", prepare)
    preprocessed = preprocess(disturbed.samples)
    part = find_passes(preprocessed.samples, preprocessed.noise_t)[0]
    for _ in detect_magnets(preprocessed, part, disturbed.tags):
        pass
    return efforts[0].spent, efforts[0].limit


@pytest.mark.slow
@pytest.mark.parametrize("name", DISTURBANCES)
def test_disturbed_passes_are_read_with_an_honest_covariance(name: str) -> None:
    number = list(DISTURBANCES).index(name)
    outcomes = [
        solve_disturbed(simulate_disturbed(DISTURBANCES[name], FIRST_SEED + 100 * number + k))
        for k in range(6)
    ]
    assert sum(outcome.is_right for outcome in outcomes) >= 5
    assert not any(outcome.is_wrong for outcome in outcomes)
    # Thirty magnets that share the errors of six passes.
    assert max(nees(outcomes)) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tightening curve", "yaw of 1 to 4 deg"])
def test_headings_of_poses_follow_the_bar(name: str) -> None:
    largest = []
    for seed in range(FIRST_SEED, FIRST_SEED + 5):
        disturbed = simulate_disturbed(DISTURBANCES[name], seed)
        solution = solve([disturbed.samples], disturbed.tags, SolveOptions())
        (trajectory,) = solution.trajectories
        at = np.searchsorted(disturbed.samples.time_ns, trajectory.time_ns)
        error = heading_from_quaternion(trajectory.quaternion) - disturbed.bar_heading_rad[at]
        # The frame of the tag is turned against that of the floor.
        error = np.angle(np.exp(1j * (error - np.angle(np.exp(1j * error).mean()))))
        largest.append(np.abs(error / np.sqrt(trajectory.covariance[:, 5, 5])).max())
    assert np.mean(largest) < 3


@pytest.mark.slow
def test_hopeless_passes_end_within_the_effort(monkeypatch: pytest.MonkeyPatch) -> None:
    clutter = Disturbance(debris=100, debris_moment=(0.05, 0.8))
    for seed in range(FIRST_SEED, FIRST_SEED + 2):
        spent, limit = spent_effort(simulate_disturbed(clutter, seed), monkeypatch)
        # A fit that has begun is finished with one iteration of each of its stages.
        assert limit < spent < 1.4 * limit
        assert limit < 6e7


def test_backward_travel_needs_no_forward_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    disturbed = simulate_disturbed(Disturbance(), FIRST_SEED)
    samples = disturbed.samples
    reverse = replace(samples, field_t=samples.field_t[::-1].copy())
    solution = solve([reverse], disturbed.tags, SolveOptions())
    assert [each.tag_id for each in solution.detections] == [disturbed.tag_id]
    spent, limit = spent_effort(replace(disturbed, samples=reverse), monkeypatch)
    assert spent < 0.5 * limit


def test_a_sample_of_another_time_has_no_pose() -> None:
    disturbed = simulate_disturbed(Disturbance(), FIRST_SEED + 1)
    samples = disturbed.samples
    middle = int(np.argmin(np.abs(disturbed.bar_position_m[:, 0])))
    field = samples.field_t.copy()
    field[middle] = samples.field_t[middle + 12]
    field[middle, :, 2] *= -1
    solution = solve([replace(samples, field_t=field)], disturbed.tags, SolveOptions())
    (trajectory,) = solution.trajectories
    assert samples.time_ns[middle] not in trajectory.time_ns
    assert samples.time_ns[middle + 1] in trajectory.time_ns


@pytest.mark.slow
def test_a_narrow_curve_is_named() -> None:
    # Whether a single pass is fitted at all depends on the rounding of the machine's BLAS.
    named = 0
    for seed in range(504, 510):
        disturbed = simulate_disturbed(Disturbance(radius_m=(0.05, 0.07)), seed)
        solution = solve([disturbed.samples], disturbed.tags, SolveOptions())
        is_named = "curved_path" in [each.code for each in solution.warnings]
        named += is_named
        assert is_named or [each.refused for each in solution.detections] != [None]
    assert named >= 4
    wide = simulate_disturbed(Disturbance(radius_m=(0.1, 0.13)), 503)
    solution = solve([wide.samples], wide.tags, SolveOptions())
    assert [each.tag_id for each in solution.detections] == [wide.tag_id]
    assert "curved_path" not in [each.code for each in solution.warnings]


@pytest.mark.slow
def test_a_path_that_turns_back_is_not_read_across_the_turn() -> None:
    """Over half of the tag, back by 0.1 m, and over all of it, within one pass."""
    for seed in range(FIRST_SEED, FIRST_SEED + 3):
        disturbed = simulate_disturbed(Disturbance(), seed)
        samples = disturbed.samples
        middle = int(np.argmin(np.abs(disturbed.bar_position_m[:, 0])))
        order = np.concatenate(
            [
                np.arange(middle),
                np.arange(middle, middle - 70, -1),
                np.arange(middle - 70, len(samples)),
            ]
        )
        step_ns = int(samples.time_ns[1] - samples.time_ns[0])
        time_ns = samples.time_ns[0] + step_ns * np.arange(len(order))
        turned = replace(samples, time_ns=time_ns, field_t=samples.field_t[order])
        for each in solve([turned], disturbed.tags, SolveOptions()).detections:
            if each.tag_id is not None:
                at = order[np.searchsorted(time_ns, round(each.time_s * 1e9))]
                centre = disturbed.magnet_m.mean(axis=0) - disturbed.bar_position_m[at]
                found = np.mean([[magnet.x_m, magnet.y_m] for magnet in each.magnets], axis=0)
                assert each.tag_id == disturbed.tag_id
                assert np.hypot(*(found - centre)) < 0.01
