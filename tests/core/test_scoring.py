"""Association, time offsets and errors: on motions whose answers are known."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import DegenerateError, InputError
from locatk.core.evaluation import Evaluation, EvaluationOptions, associate, association, evaluate
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.trajectory import Trajectory

EPOCH = 1_690_218_696_000_000_000


def evaluate_pair(estimate: Trajectory, truth: Trajectory, **options: Any) -> Evaluation:
    return evaluate([(estimate, truth)], EvaluationOptions(**options))


def path(time_s: np.ndarray) -> np.ndarray:
    """A robot's way that does not repeat itself, in metres."""
    t = np.asarray(time_s)
    return np.stack([np.sin(0.9 * t), np.cos(0.61 * t) + 0.1 * t, 0.2 * np.sin(0.37 * t)], -1)


def trajectory(time_s: np.ndarray, position: np.ndarray, device: str = "robot") -> Trajectory:
    stamps = EPOCH + np.round(np.asarray(time_s) * 1e9).astype(np.int64)
    return Trajectory.from_positions(device, "floor", stamps, np.asarray(position, float))


TRUE_TIME = np.arange(0, 40, 1 / 60)
TRUTH = trajectory(TRUE_TIME, path(TRUE_TIME))


def test_truth_is_interpolated_never_extrapolated_nor_over_gaps() -> None:
    truth = trajectory(np.array([0.0, 1.0, 5.0, 6.0]), [[0, 0, 0], [1, 2, 3], [5, 0, 0], [6, 0, 0]])
    estimate = trajectory(
        np.array([-0.1, 0.0, 0.25, 1.0, 3.0, 5.0, 5.5, 6.0, 6.1]), np.zeros((9, 3))
    )
    pair = associate(estimate, truth, max_gap_s=1.0)
    assert pair.index.tolist() == [1, 2, 3, 5, 6, 7]
    expected = [[0, 0, 0], [0.25, 0.5, 0.75], [1, 2, 3], [5, 0, 0], [5.5, 0, 0], [6, 0, 0]]
    np.testing.assert_allclose(pair.truth, expected, atol=1e-12)
    assert associate(estimate, truth, max_gap_s=0.5).index.tolist() == [1, 3, 5, 7]
    assert len(associate(estimate, truth, max_gap_s=4.0)) == 7


def test_offset_is_added_to_the_stamps_of_the_estimate() -> None:
    truth = trajectory(np.array([0.0, 1.0]), [[0, 0, 0], [1, 0, 0]])
    estimate = trajectory(np.array([0.25]), [[0, 0, 0]])
    pair = associate(estimate, truth, offset_s=0.5, max_gap_s=2)
    np.testing.assert_allclose(pair.truth, [[0.75, 0, 0]])
    assert pair.time_ns.tolist() == estimate.time_ns.tolist()


def test_stamps_keep_their_nanoseconds() -> None:
    truth = Trajectory.from_positions(
        "a", "floor", np.array([EPOCH, EPOCH + 10]), np.array([[0.0, 0, 0], [10, 0, 0]])
    )
    estimate = Trajectory.from_positions("a", "floor", np.array([EPOCH + 3]), np.zeros((1, 3)))
    np.testing.assert_allclose(associate(estimate, truth).truth, [[3, 0, 0]])


def test_truth_out_of_order_and_empty_ones() -> None:
    with pytest.raises(InputError, match="ascend"):
        associate(TRUTH, trajectory(np.array([1.0, 0.0]), np.zeros((2, 3))))
    empty = trajectory(np.zeros(0), np.zeros((0, 3)))
    assert len(associate(TRUTH, empty)) == 0
    assert len(associate(empty, TRUTH)) == 0
    with pytest.raises(InputError, match="no pose"):
        evaluate_pair(TRUTH, empty)
    with pytest.raises(InputError, match="no pose"):
        evaluate_pair(TRUTH, empty, offset_s="auto")


@pytest.mark.slow
@given(st.lists(st.floats(0, 10), min_size=1, max_size=50))
def test_figures_follow_the_papers_convention(lengths: list[float]) -> None:
    time = np.arange(len(lengths)) * 0.1
    truth = trajectory(time, np.zeros((len(lengths), 3)))
    direction = np.array([0.6, 0.0, -0.8])
    found = evaluate_pair(trajectory(time, np.outer(lengths, direction)), truth)
    assert found.mae == pytest.approx(np.mean(lengths), abs=1e-12)
    assert found.sd == pytest.approx(np.std(lengths), abs=1e-9)
    assert found.rmse**2 == pytest.approx(found.mae**2 + found.sd**2, abs=1e-9)
    assert found.median == pytest.approx(np.median(lengths), abs=1e-12)
    assert found.p95 == pytest.approx(np.percentile(lengths, 95), abs=1e-12)
    assert found.max == pytest.approx(max(lengths), abs=1e-12)
    assert (found.n, found.time_offset.source, found.align) == (len(lengths), "none", "none")
    np.testing.assert_array_equal(found.transform, np.eye(4))


TURN = rotation_exp(np.array([0, 0, 0.7]))
TILT = rotation_exp(np.array([0.3, -0.2, 0.7]))


@pytest.mark.parametrize(
    ("align", "motion"),
    [
        ("none", Similarity.identity()),
        ("se2", Similarity(1.0, TURN, np.array([1.0, -2.0, 0.0]))),
        ("sim2", Similarity(2.5, TURN, np.array([1.0, -2.0, 0.0]))),
        ("se3", Similarity(1.0, TILT, np.array([1.0, -2.0, 3.0]))),
        ("sim3", Similarity(2.5, TILT, np.array([1.0, -2.0, 3.0]))),
    ],
)
def test_each_alignment_removes_its_motion_and_no_more(align: str, motion: Similarity) -> None:
    truth = trajectory(TRUE_TIME, motion.apply(TRUTH.position))
    found = evaluate_pair(TRUTH, truth, align=align)
    assert found.max < 1e-9
    np.testing.assert_allclose(found.transform, motion.matrix, atol=1e-9)
    smaller = {"se2": ["none"], "sim2": ["se2", "se3"], "se3": ["sim2"], "sim3": ["se3", "sim2"]}
    for other in smaller.get(align, []):
        assert evaluate_pair(TRUTH, truth, align=other).mae > 0.05


def test_planar_alignments_do_not_shift_along_z_nor_unmirror() -> None:
    higher = trajectory(TRUE_TIME, TRUTH.position + np.array([0, 0, 0.5]))
    assert evaluate_pair(TRUTH, higher, align="se2").mae == pytest.approx(0.5)
    mirrored = trajectory(TRUE_TIME, TRUTH.position * [1, -1, 1])
    assert evaluate_pair(TRUTH, mirrored, align="sim2").mae > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("offset", [-0.3181, 0.0, 0.047, 0.9])
@pytest.mark.parametrize("align", ["none", "sim2", "se3"])
def test_offset_is_estimated_on_the_held_out_part(offset: float, align: str) -> None:
    rng = np.random.default_rng(3)
    time = np.arange(2, 38, 0.1)
    # An estimate stamped t shows where the robot was at t + offset.
    estimate = trajectory(time, path(time + offset) + rng.normal(0, 2e-3, (len(time), 3)))
    found = evaluate_pair(estimate, TRUTH, align=align, offset_s="auto", held_out=(0.25, 0.5))
    assert found.offset_s == pytest.approx(offset, abs=2e-3)
    assert found.mae < 4e-3
    assert (found.time_offset.source, found.time_offset.held_out) == ("held-out", (0.25, 0.5))
    assert found.time_offset.describe().startswith("held-out 25% to 50%")
    assert found.unscored["held out"] == pytest.approx(len(time) / 4, abs=20)
    assert found.n + sum(found.unscored.values()) == len(time)


def test_offset_does_not_see_the_poses_that_are_scored() -> None:
    """Spoiling every scored pose does not move the offset by a nanosecond."""
    time = np.arange(2, 38, 0.1)
    good = path(time + 0.2)
    spoiled = good.copy()
    options = {"offset_s": "auto", "held_out": (0.0, 0.3), "align": "se2"}
    clean = evaluate_pair(trajectory(time, good), TRUTH, **options)
    scored = np.isin(trajectory(time, good).time_ns, clean.time_ns)
    assert 0 < scored.sum() < len(time)
    spoiled[scored] += np.random.default_rng(0).normal(0, 0.5, (int(scored.sum()), 3))
    noisy = evaluate_pair(trajectory(time, spoiled), TRUTH, **options)
    assert noisy.offset_s == clean.offset_s
    assert noisy.mae > 0.3 > clean.mae


def test_offset_that_cannot_be_found_is_refused() -> None:
    time = np.arange(2, 38, 0.1)
    still = trajectory(time, np.random.default_rng(0).normal(0, 1e-3, (len(time), 3)))
    still_truth = trajectory(TRUE_TIME, np.zeros((len(TRUE_TIME), 3)))
    with pytest.raises(DegenerateError, match="hardly moved"):
        evaluate_pair(still, still_truth, offset_s="auto")
    late = trajectory(time, path(time + 0.5))
    with pytest.raises(InputError, match="end of the span"):
        evaluate_pair(late, TRUTH, offset_s="auto", span_s=0.2)
    with pytest.raises(InputError, match="only"):
        evaluate_pair(trajectory(time[:8], path(time[:8])), TRUTH, offset_s="auto")
    for part in [(0.0, 1.0), (0.5, 0.5), (-0.1, 0.5), (0.2, 1.1), (float("nan"), 0.5)]:
        with pytest.raises(InputError, match="part"):
            evaluate_pair(late, TRUTH, offset_s="auto", held_out=part)


def test_several_devices_share_one_alignment_and_offset() -> None:
    time = np.arange(2, 38, 0.1)
    motion = Similarity(0.5, TURN, np.array([3.0, 1.0, 0.0]))
    shift = np.array([0.1, 0.0, 0.0])
    pairs = [
        (
            trajectory(time, motion.apply(path(time + 0.25)), "a"),
            trajectory(TRUE_TIME, path(TRUE_TIME), "a"),
        ),
        (
            trajectory(time, motion.apply(path(time + 0.25) * [1, 0.5, 1]), "b"),
            trajectory(TRUE_TIME, path(TRUE_TIME) * [1, 0.5, 1], "b"),
        ),
    ]
    found = evaluate(pairs, EvaluationOptions(align="sim2", offset_s="auto"))
    assert found.offset_s == pytest.approx(0.25, abs=2e-3)
    assert found.mae < 1e-3
    assert found.devices == ("a", "b")
    assert np.bincount(found.device).sum() == found.n
    # A device that stands elsewhere cannot be aligned away on its own.
    moved = trajectory(TRUE_TIME, pairs[1][1].position + shift, "b")
    apart = evaluate(
        [pairs[0], (pairs[1][0], moved)], EvaluationOptions(align="sim2", offset_s=0.25)
    )
    assert apart.mae > 0.02
    assert evaluate_pair(pairs[1][0], moved, align="sim2", offset_s=0.25).mae < 1e-3


def test_the_result_is_json_with_units() -> None:
    found = evaluate_pair(TRUTH, TRUTH, align="se3", offset_s=0.001)
    said = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert said["offset_source"] == "given"
    assert said["align"] == "se3"
    assert said["align_fitted_on"] == "the scored poses"
    assert said["devices"]["robot"]["n"] == said["n"] == found.n
    assert set(said) >= {"mae_m", "rmse_m", "sd_m", "median_m", "p95_m", "max_m", "transform"}


def test_unusable_input_is_named() -> None:
    with pytest.raises(InputError, match="unknown alignment"):
        evaluate_pair(TRUTH, TRUTH, align="best")
    one = trajectory(TRUE_TIME[:1], TRUTH.position[:1])
    with pytest.raises(DegenerateError, match="two poses"):
        evaluate_pair(one, TRUTH, align="se3")
    bad = trajectory(TRUE_TIME, np.where(TRUE_TIME[:, None] > 30, np.nan, TRUTH.position))
    with pytest.raises(InputError, match="not numbers"):
        evaluate_pair(bad, TRUTH, align="se3")


def test_stamps_become_the_seconds_that_a_reader_of_text_gets() -> None:
    """Ties between two neighbours then fall as where stamps are read as float64."""
    rng = np.random.default_rng(0)
    for most in (10**9, 10**13, 2**53, 2**54, 9 * 10**18):
        stamps = rng.integers(-most, most, 2000) // 10**5 * 10**5
        words = [f"{'-' * (t < 0)}{abs(t) // 10**9}.{abs(t) % 10**9:09d}" for t in stamps.tolist()]
        np.testing.assert_array_equal(association._epoch_seconds(stamps), list(map(float, words)))


@pytest.mark.parametrize("factor", [1e200, 1e-200])
def test_positions_with_overflowing_squares(factor: float) -> None:
    strange = replace(TRUTH, position=factor * TRUTH.position)
    with pytest.raises((InputError, DegenerateError), match=r"not numbers|coincide"):
        evaluate_pair(strange, TRUTH, align="sim3")


def test_one_unknown_covariance_for_all_stays_one_in_memory() -> None:
    unknown = replace(TRUTH, covariance=np.broadcast_to(np.nan, (len(TRUTH), 6, 6)))
    part = unknown.select(np.arange(len(TRUTH)) % 2 == 0)
    assert part.covariance.shape == (len(part), 6, 6)
    assert part.covariance.strides[0] == 0
