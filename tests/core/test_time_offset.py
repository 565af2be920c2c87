"""Time offsets between clocks that are seconds or months apart."""

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


def way(t: Array) -> Array:
    """At a constant speed, as robots drive: speeds alone would not tell the time."""
    heading = np.cumsum(0.5 * np.sin(0.7 * t) + 0.3 * np.sin(0.31 * t)) * (t[1] - t[0])
    step = 0.3 * (t[1] - t[0])
    return np.stack(
        [np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), 0 * t], -1
    )


TIME = np.arange(0, 40, 0.01)
WAY = way(TIME)


def trajectory(time_s: Array, position: Array, shift_ns: int = 0) -> Trajectory:
    stamps = EPOCH + shift_ns + np.round(np.asarray(time_s) * 1e9).astype(np.int64)
    return Trajectory.from_positions("robot", "floor", stamps, position)


TRUTH = trajectory(TIME, WAY)


def later(cut_s: float = 0.0, loops: int = 1, noise_m: float = 2e-3) -> Trajectory:
    """What was captured months later: the beginning lost, and the drive repeated."""
    time = np.concatenate([TIME[::7] + 40.0 * k for k in range(loops)])
    position = np.tile(WAY[::7], (loops, 1))
    position = position + np.random.default_rng(3).normal(0, noise_m, position.shape)
    return trajectory(time[time >= cut_s], position[time >= cut_s], MONTHS_NS)


@pytest.mark.parametrize("align", ["none", "se2", "sim2", "se3", "sim3", "yaw", "origin"])
@pytest.mark.parametrize("loops", [1, 3])
def test_clocks_that_are_months_apart(align: str, loops: int) -> None:
    estimate = later(cut_s=1.3, loops=loops)
    if align != "none":
        turn = rotation_exp(np.array([0, 0, 2.0]))
        scale = 0.3 if align.startswith("sim") else 1.0
        estimate = trajectory(
            (estimate.time_ns - EPOCH - MONTHS_NS) / 1e9,
            scale * estimate.position @ turn.T + [3, -1, 0],
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


def test_clocks_that_agree_are_searched_as_ever() -> None:
    part = trajectory(TIME[300:900], WAY[300:900])
    assert clocks_agree([(part, TRUTH)])
    assert not clocks_agree([(later(), TRUTH)])
    found = evaluate_pair(part, TRUTH, offset_s="auto")
    assert found.time_offset.coarse_method is None
    assert found.offset_s == pytest.approx(0, abs=1e-3)


def test_a_straight_way_is_placed_where_nothing_is_fitted() -> None:
    """Its shape tells no time; where it is does."""
    line = np.outer(TIME, [0.2, 0.1, 0.0])
    estimate = trajectory(TIME[500:2500], line[500:2500], MONTHS_NS)
    found = evaluate_pair(estimate, trajectory(TIME, line), offset_s="auto")
    assert found.offset_s == pytest.approx(-MONTHS_NS / 1e9, abs=1e-3)


def test_motions_that_are_unlike_fall_back_to_the_first_stamps() -> None:
    rng = np.random.default_rng(0)
    noise = np.cumsum(rng.normal(0, 0.01, WAY.shape), axis=0)
    coarse = estimate_coarse_offset([(trajectory(TIME, noise, MONTHS_NS), TRUTH)], align="none")
    assert coarse.method == "first stamps"
    assert coarse.offset_s == pytest.approx(-MONTHS_NS / 1e9)
    with pytest.raises(InputError, match="too unlike"):  # nor do these tell an offset
        evaluate_pair(trajectory(TIME, 1e-9 * noise, MONTHS_NS), TRUTH, offset_s="auto")
    with pytest.raises(InputError, match="no poses"):
        estimate_coarse_offset([(trajectory(TIME[:0], WAY[:0]), TRUTH)])


def test_a_quarter_without_motion_is_not_what_the_offset_is_taken_from() -> None:
    """The robot stands still for the first third."""
    position = np.concatenate([np.repeat(WAY[:1], 2000, axis=0), WAY])
    time = np.arange(len(position)) * 0.01
    truth = trajectory(time, position)
    shifted = trajectory(time[100:-100:5], position[100:-100:5], 70_000_000)
    found = evaluate_pair(shifted, truth, offset_s="auto")
    assert found.offset_s == pytest.approx(-0.07, abs=2e-3)
    assert found.time_offset.held_out == (0.25, 0.5)
    with pytest.raises(Exception, match="hardly moved"):
        evaluate_pair(shifted, truth, offset_s="auto", held_out=(0.0, 0.25))


def test_long_recordings_are_searched_in_longer_steps() -> None:
    time = np.arange(0, 9000, 0.5)
    position = way(time)
    truth = trajectory(time, position)
    late = trajectory(time[5000:15000], position[5000:15000], MONTHS_NS)
    coarse = estimate_coarse_offset([(late, truth)], align="se2")
    assert coarse.offset_s == pytest.approx(-MONTHS_NS / 1e9, abs=coarse.span_s)


def laps(time_s: Array) -> Array:
    """Round and round, 20 s a lap."""
    angle = 2 * np.pi * time_s / 20
    return np.stack(
        [2 * np.cos(angle) + 0.3 * np.cos(3 * angle), np.sin(angle), 0 * angle], axis=-1
    )


@pytest.mark.parametrize(("apart_m", "alike"), [(0.0, 4), (0.3, 0)])
def test_a_drive_that_repeats_itself_is_told(apart_m: float, alike: int) -> None:
    time = np.arange(0, 100, 0.02)
    rng = np.random.default_rng(0)
    away = np.stack(
        [np.interp(time, np.arange(0, 101, 4), rng.normal(0, apart_m, 26)) for _ in "xyz"], -1
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
    assert (coarse.method, coarse.alternatives) == ("motion", alike)
    found = evaluate_pair(*pairs[0], offset_s="auto")
    assert found.time_offset.alternatives == alike
    described = "fits other offsets as well (4)" in found.time_offset.describe()
    assert described == (alike > 0)
    off = found.offset_s + MONTHS_NS / 1e9
    assert (off + 10) % 20 - 10 == pytest.approx(0, abs=5e-3)
    if not alike:
        assert off == pytest.approx(0, abs=5e-3)


def test_the_offset_is_taken_from_where_devices_move() -> None:
    """A robot stands at places, unseen while it is carried between them, and then drives.

    While it stands, any offset fits that does not reach into the carrying.
    """
    places = np.repeat(np.outer(np.arange(8), [0.5, 0, 0]), 500, axis=0)
    position = np.concatenate([places, WAY])
    time = np.arange(len(position)) * 0.01
    carried = np.abs((time - 2.5) % 5 - 2.5) < 0.9
    seen = np.flatnonzero(~carried | (time > 41))[::10]
    rng = np.random.default_rng(0)
    rough = position[seen] + rng.normal(0, 2e-3, (len(seen), 3))
    found = evaluate_pair(
        trajectory(time[seen], rough, 50_000_000), trajectory(time, position), offset_s="auto"
    )
    assert found.time_offset.held_out == (0.5, 0.75)
    assert found.offset_s == pytest.approx(-0.05, abs=2e-3)
    standing = evaluate_pair(
        trajectory(time[seen], rough, 50_000_000),
        trajectory(time, position),
        offset_s="auto",
        held_out=(0.0, 0.25),
    )
    assert abs(standing.offset_s + 0.05) > 0.01  # what the first quarter would have said


def test_frames_that_differ_are_named_where_nothing_tells_the_offset() -> None:
    estimate = trajectory(TIME[::7], 0.01 * WAY[::7] + 1e3)
    with pytest.raises(DegenerateError, match="frames differ"):
        evaluate_pair(estimate, TRUTH, offset_s="auto")
