"""Time offsets between clocks that differ by seconds or months."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.evaluation import Evaluation, EvaluationOptions, estimate_coarse_offset, evaluate
from locatk.core.evaluation.coarse_offset import clocks_agree
from locatk.core.geometry import rotation_exp
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

EPOCH = 1_690_218_696_000_000_000
MONTHS_NS = 123 * 86_400 * 10**9 + 456_789_012_345


def evaluate_pair(estimate: Trajectory, truth: Trajectory, **options: Any) -> Evaluation:
    return evaluate([(estimate, truth)], EvaluationOptions(**options))


def winding_path(t: Array) -> Array:
    """Path at constant speed, as robots drive it: speeds alone do not determine the time."""
    heading = np.cumsum(0.5 * np.sin(0.7 * t) + 0.3 * np.sin(0.31 * t)) * (t[1] - t[0])
    step = 0.3 * (t[1] - t[0])
    return np.stack(
        [np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), 0 * t], -1
    )


TIME = np.arange(0, 40, 0.01)
PATH = winding_path(TIME)


def trajectory(time_s: Array, position: Array, shift_ns: int = 0) -> Trajectory:
    stamps = EPOCH + shift_ns + np.round(np.asarray(time_s) * 1e9).astype(np.int64)
    return Trajectory.from_positions("robot", "floor", stamps, position)


TRUTH = trajectory(TIME, PATH)


def later(cut_s: float = 0.0, loops: int = 1, noise_m: float = 2e-3) -> Trajectory:
    """Recording with a clock that is months late, without its beginning, of a repeated drive."""
    time = np.concatenate([TIME[::7] + 40.0 * k for k in range(loops)])
    position = np.tile(PATH[::7], (loops, 1))
    position = position + np.random.default_rng(3).normal(0, noise_m, position.shape)
    return trajectory(time[time >= cut_s], position[time >= cut_s], MONTHS_NS)


@pytest.mark.parametrize("align", ["none", "se2", "sim2", "se3", "sim3", "yaw", "origin"])
@pytest.mark.parametrize("loops", [1, 3])
def test_clocks_that_are_months_apart(align: str, loops: int) -> None:
    estimate = later(cut_s=1.3, loops=loops)
    if align != "none":
        rotation = rotation_exp(np.array([0, 0, 2.0]))
        scale = 0.3 if align.startswith("sim") else 1.0
        estimate = trajectory(
            (estimate.time_ns - EPOCH - MONTHS_NS) / 1e9,
            scale * estimate.position @ rotation.T + [3, -1, 0],
            MONTHS_NS,
        )
    found = evaluate_pair(estimate, TRUTH, align=align, offset_s="auto")
    # Any loop will do.
    off = (found.offset_s + MONTHS_NS / 1e9 + 20.0) % 40.0 - 20.0
    assert off == pytest.approx(0, abs=5e-3)
    assert found.time_offset.coarse_method == "motion"
    if align != "origin":  # which rests on one pose and its noise
        assert found.mae < 5e-3
    assert found.n + sum(found.unscored.values()) == len(estimate)
    if loops == 3:
        assert found.unscored["no truth"] > len(estimate) / 2


def test_clocks_that_agree_need_no_coarse_search() -> None:
    part = trajectory(TIME[300:900], PATH[300:900])
    assert clocks_agree([(part, TRUTH)])
    assert not clocks_agree([(later(), TRUTH)])
    found = evaluate_pair(part, TRUTH, offset_s="auto")
    assert found.time_offset.coarse_method is None
    assert found.offset_s == pytest.approx(0, abs=1e-3)


def test_a_straight_path_is_matched_by_position_without_alignment() -> None:
    """Its shape does not determine the time, but its position does."""
    line = np.outer(TIME, [0.2, 0.1, 0.0])
    estimate = trajectory(TIME[500:2500], line[500:2500], MONTHS_NS)
    found = evaluate_pair(estimate, trajectory(TIME, line), offset_s="auto")
    assert found.offset_s == pytest.approx(-MONTHS_NS / 1e9, abs=1e-3)


def test_different_motions_fall_back_to_the_first_stamps() -> None:
    rng = np.random.default_rng(0)
    noise = np.cumsum(rng.normal(0, 0.01, PATH.shape), axis=0)
    coarse = estimate_coarse_offset([(trajectory(TIME, noise, MONTHS_NS), TRUTH)], align="none")
    assert coarse.method == "first stamps"
    assert coarse.offset_s == pytest.approx(-MONTHS_NS / 1e9)
    with pytest.raises(InputError, match="too unlike"):  # the first stamps do not help either
        evaluate_pair(trajectory(TIME, 1e-9 * noise, MONTHS_NS), TRUTH, offset_s="auto")
    with pytest.raises(InputError, match="no poses"):
        estimate_coarse_offset([(trajectory(TIME[:0], PATH[:0]), TRUTH)])


def test_the_offset_is_not_estimated_from_a_quarter_at_rest() -> None:
    """The robot is at rest for the first third."""
    position = np.concatenate([np.repeat(PATH[:1], 2000, axis=0), PATH])
    time = np.arange(len(position)) * 0.01
    truth = trajectory(time, position)
    shifted = trajectory(time[100:-100:5], position[100:-100:5], 70_000_000)
    found = evaluate_pair(shifted, truth, offset_s="auto")
    assert found.offset_s == pytest.approx(-0.07, abs=2e-3)
    assert found.time_offset.held_out == (0.25, 0.5)
    with pytest.raises(Exception, match="hardly moved"):
        evaluate_pair(shifted, truth, offset_s="auto", held_out=(0.0, 0.25))


@pytest.mark.slow
def test_long_recordings_are_sampled_at_longer_intervals() -> None:
    time = np.arange(0, 9000, 0.5)
    position = winding_path(time)
    truth = trajectory(time, position)
    late = trajectory(time[5000:15000], position[5000:15000], MONTHS_NS)
    coarse = estimate_coarse_offset([(late, truth)], align="se2")
    assert coarse.offset_s == pytest.approx(-MONTHS_NS / 1e9, abs=coarse.span_s)


def laps(time_s: Array) -> Array:
    """Closed laps of 20 s."""
    angle = 2 * np.pi * time_s / 20
    return np.stack(
        [2 * np.cos(angle) + 0.3 * np.cos(3 * angle), np.sin(angle), 0 * angle], axis=-1
    )


@pytest.mark.parametrize(("deviation_m", "alternatives"), [(0.0, 4), (0.3, 0)])
def test_a_drive_that_repeats_itself_has_alternatives(
    deviation_m: float, alternatives: int
) -> None:
    time = np.arange(0, 100, 0.02)
    rng = np.random.default_rng(0)
    away = np.stack(
        [np.interp(time, np.arange(0, 101, 4), rng.normal(0, deviation_m, 26)) for _ in "xyz"], -1
    )
    truth = laps(time) + away
    mine = (time >= 23) & (time < 71)
    noise = rng.normal(0, 0.002, (int(mine.sum()), 3))
    pairs = [
        (
            trajectory(time[mine][::5], (truth[mine] + noise)[::5], MONTHS_NS),
            trajectory(time, truth),
        )
    ]
    coarse = estimate_coarse_offset(pairs)
    assert (coarse.method, coarse.alternatives) == ("motion", alternatives)
    found = evaluate_pair(*pairs[0], offset_s="auto")
    assert found.time_offset.alternatives == alternatives
    described = "fits other offsets as well (4)" in found.time_offset.describe()
    assert described == (alternatives > 0)
    off = found.offset_s + MONTHS_NS / 1e9
    assert (off + 10) % 20 - 10 == pytest.approx(0, abs=5e-3)
    if not alternatives:
        assert off == pytest.approx(0, abs=5e-3)


def test_the_offset_is_estimated_from_moving_devices() -> None:
    """A robot rests at several positions, unobserved while it is carried, and then drives.

    While it rests, any offset fits that does not extend into the times of carrying.
    """
    positions = np.repeat(np.outer(np.arange(8), [0.5, 0, 0]), 500, axis=0)
    position = np.concatenate([positions, PATH])
    time = np.arange(len(position)) * 0.01
    carried = np.abs((time - 2.5) % 5 - 2.5) < 0.9
    observed = np.flatnonzero(~carried | (time > 41))[::10]
    rng = np.random.default_rng(0)
    rough = position[observed] + rng.normal(0, 2e-3, (len(observed), 3))
    found = evaluate_pair(
        trajectory(time[observed], rough, 50_000_000), trajectory(time, position), offset_s="auto"
    )
    assert found.time_offset.held_out == (0.5, 0.75)
    assert found.offset_s == pytest.approx(-0.05, abs=2e-3)
    at_rest = evaluate_pair(
        trajectory(time[observed], rough, 50_000_000),
        trajectory(time, position),
        offset_s="auto",
        held_out=(0.0, 0.25),
    )
    assert abs(at_rest.offset_s + 0.05) > 0.01  # the first quarter determines it badly


def test_an_undetermined_offset_mentions_different_frames() -> None:
    estimate = trajectory(TIME[::7], 0.01 * PATH[::7] + 1e3)
    with pytest.raises(DegenerateError, match="frames differ"):
        evaluate_pair(estimate, TRUTH, offset_s="auto")
