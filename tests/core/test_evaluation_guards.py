"""Guards of the evaluation, one at a time: each test fails if its guard is removed or inverted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.evaluation import (
    Delta,
    Evaluation,
    EvaluationOptions,
    Statistics,
    TimeOffset,
    associate,
    coarse_offset,
    estimate_coarse_offset,
    estimate_held_out_offset,
    estimate_offset,
    evaluate,
    scoring,
)
from locatk.core.evaluation.association import require_ascending
from locatk.core.evaluation.coarse_offset import clocks_agree
from locatk.core.evaluation.consistency import nees_of, normalize_errors, summarize_consistency
from locatk.core.evaluation.coverage import compute_coverage
from locatk.core.evaluation.pose_errors import MatchedPoses, select_pairs
from locatk.core.geometry import Similarity, quaternion_from_heading
from locatk.core.trajectory import Trajectory, has_orientation

Array = NDArray[np.float64]

EPOCH_NS = 1_690_218_696_000_000_000
TIME_S = np.arange(0, 40, 0.05)


def path(time_s: Array) -> Array:
    t = np.asarray(time_s)
    return np.stack([np.sin(0.9 * t), np.cos(0.61 * t) + 0.1 * t, 0.2 * np.sin(0.37 * t)], -1)


def trajectory(
    time_s: Array,
    position: Array | None = None,
    device: str = "robot",
    covariance: Array | None = None,
    quaternion: Array | None = None,
) -> Trajectory:
    n = len(time_s)
    return Trajectory(
        device,
        "floor",
        EPOCH_NS + np.round(np.asarray(time_s) * 1e9).astype(np.int64),
        path(time_s) if position is None else np.asarray(position, float),
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)) if quaternion is None else quaternion,
        np.full((n, 6, 6), np.nan) if covariance is None else covariance,
    )


def known_covariance(n: int, *components: int) -> Array:
    """Covariances that are known for some components only."""
    covariance = np.full((n, 6, 6), np.nan)
    for k in components:
        covariance[:, k, k] = 1e-4
    return covariance


def evaluate_pair(estimate: Trajectory, truth: Trajectory, **options: Any) -> Evaluation:
    return evaluate([(estimate, truth)], EvaluationOptions(**options))


TRUTH = trajectory(TIME_S)


# ---- scoring


def test_one_device_without_matches_does_not_prevent_scoring_another() -> None:
    late = trajectory(TIME_S + 1000.0, device="late")
    evaluation = evaluate([(TRUTH, TRUTH), (late, replace(TRUTH, device="late"))])
    assert evaluation.n == len(TRUTH)
    with pytest.raises(InputError, match="truth at its time"):
        evaluate([(late, TRUTH), (late, TRUTH)])


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e101])
def test_a_single_coordinate_that_is_not_finite_is_refused(value: float) -> None:
    truth = np.zeros((5, 3))
    estimate = truth.copy()
    scoring._require_finite(estimate, truth)
    estimate[3, 1] = value
    with pytest.raises(InputError, match="not numbers"):
        scoring._require_finite(estimate, truth)
    with pytest.raises(InputError, match="not numbers"):
        scoring._require_finite(truth, estimate)


def test_motions_have_rotation_errors_only_if_all_poses_have_orientations() -> None:
    covariance = known_covariance(len(TRUTH), *range(6))
    truth = trajectory(TIME_S, covariance=covariance)
    partial = covariance.copy()
    partial[300, 3:, 3:] = np.nan
    evaluation = evaluate_pair(trajectory(TIME_S, covariance=partial), truth)
    assert evaluation.rpe_rotation is None
    assert evaluation.ape_rotation is not None
    assert evaluation.ape_rotation.n == len(TRUTH) - 1
    assert np.flatnonzero(np.isnan(evaluation.rotation_errors_deg)).tolist() == [300]
    complete = evaluate_pair(truth, truth)
    assert complete.rpe_rotation is not None


def test_an_orientation_is_needed_in_both_estimate_and_truth() -> None:
    oriented = trajectory(TIME_S, covariance=known_covariance(len(TRUTH), *range(6)))
    point = trajectory(TIME_S, covariance=known_covariance(len(TRUTH), 0, 1, 2))
    for estimate, truth in ((oriented, point), (point, oriented)):
        evaluation = evaluate_pair(estimate, truth)
        assert evaluation.ape_rotation is None


def test_origin_rotates_only_if_the_first_pose_has_an_orientation() -> None:
    half_turn = quaternion_from_heading(np.full(len(TRUTH), np.pi))
    known = known_covariance(len(TRUTH), *range(6))
    point = known_covariance(len(TRUTH), 0, 1, 2)
    truth = trajectory(TIME_S, covariance=known)
    for covariance, rotates in ((known, True), (point, False)):
        estimate = trajectory(TIME_S, covariance=covariance, quaternion=half_turn)
        rotation = evaluate_pair(estimate, truth, align="origin").alignment.rotation
        assert (rotation[0, 0] < 0) == rotates


def test_devices_with_and_without_orientations_are_concatenated() -> None:
    known = known_covariance(len(TRUTH), *range(6))
    point = known_covariance(len(TRUTH), 0, 1, 2)
    oriented, plain = trajectory(TIME_S, covariance=known), trajectory(TIME_S, covariance=point)
    evaluation = evaluate([(oriented, oriented), (plain, plain)])
    rotation_deg = evaluation.relative.rotation_deg
    assert rotation_deg is not None
    assert np.isnan(rotation_deg).sum() == len(TRUTH) - 1 == np.isfinite(rotation_deg).sum()
    assert evaluation.drift.rotation is not None
    assert evaluation.rpe_rotation is not None
    assert evaluation.rpe_rotation.n == len(TRUTH) - 1


@pytest.mark.parametrize("component", range(6))
def test_one_variance_of_one_pose_suffices_for_nees(component: int) -> None:
    covariance = np.full((len(TRUTH), 6, 6), np.nan)
    covariance[7, component, component] = 4e-4
    estimate = trajectory(TIME_S, covariance=covariance)
    assert scoring._has_variance(estimate)
    assert not scoring._has_variance(TRUTH)
    evaluation = evaluate_pair(estimate, trajectory(TIME_S, path(TIME_S) + 0.02))
    if component < 3:
        assert evaluation.consistency is not None
        assert (evaluation.consistency.n, evaluation.nees[7]) == (1, pytest.approx(1.0))


def test_held_out_poses_are_not_scored_and_counted_once() -> None:
    estimate = trajectory(TIME_S[20:-20:2] + 0.1, path(TIME_S[20:-20:2]))
    evaluation = evaluate_pair(estimate, TRUTH, offset_s="auto", held_out=(0.0, 0.5))
    held_out = evaluation.unscored["held out"]
    assert held_out == pytest.approx(len(estimate) / 2, abs=2)
    assert evaluation.time_ns.min() >= estimate.time_ns[held_out]
    assert evaluation.n + sum(evaluation.unscored.values()) == len(estimate)


def test_a_pose_that_is_matched_repeatedly_counts_once() -> None:
    estimate = trajectory(np.array([0.0, 10.0, 20.0, 30.0]))
    truth = trajectory(np.array([0.0, 0.001, 0.002]))
    evaluation = evaluate_pair(estimate, truth, match="nearest")
    assert (evaluation.n, evaluation.unscored["no truth"]) == (3, 3)


def test_hints_for_unmatched_poses() -> None:
    def hint(shift_s: float, offset_s: float = 0.0) -> str:
        with pytest.raises(InputError, match="truth at its time") as error:
            evaluate_pair(trajectory(TIME_S + shift_s), TRUTH, offset_s=offset_s)
        assert error.value.hint is not None
        return error.value.hint

    assert "100.000 s after" in hint(100.0)
    assert "100.000 s before" in hint(-100.0)
    assert "150.000 s after" in hint(100.0, 50.0)
    gaps = trajectory(np.array([0.0, 10.0]))
    with pytest.raises(InputError) as error:
        evaluate_pair(trajectory(np.array([5.0])), gaps)
    assert error.value.hint is not None
    assert "longest gap" in error.value.hint


# ---- orientations


def test_any_rotation_variance_is_an_orientation() -> None:
    planar = trajectory(TIME_S, covariance=known_covariance(len(TRUTH), 0, 1, 5))
    assert has_orientation(planar).all()
    photodiode = trajectory(TIME_S, covariance=known_covariance(len(TRUTH), 0, 1, 2))
    assert not has_orientation(photodiode).any()
    assert not has_orientation(photodiode, trust_identity=True).any()


def test_only_identity_orientations_without_covariance_are_those_of_a_point() -> None:
    assert not has_orientation(TRUTH).any()
    assert has_orientation(TRUTH, trust_identity=True).all()
    heading = quaternion_from_heading(np.linspace(0, 1, len(TRUTH)))
    # Rotations about z have two components of zero in each pose, and the first pose has three.
    assert has_orientation(trajectory(TIME_S, quaternion=heading)).all()
    # A single rotation covariance shows that the identity is meant.
    covariance = np.full((len(TRUTH), 6, 6), np.nan)
    covariance[5] = 1e-4 * np.eye(6)
    assert has_orientation(trajectory(TIME_S, covariance=covariance)).all()


# ---- association


def test_one_pose_between_stamps_is_interpolated_and_a_mask_selects() -> None:
    truth = trajectory(np.array([0.0, 0.1, 0.2]), [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    association = associate(trajectory(np.array([0.0, 0.1, 0.15])), truth)
    np.testing.assert_allclose(association.truth[:, 0], [0.0, 1.0, 1.5])
    assert association.fraction.tolist()[:2] == [0.0, 0.0]
    selected = association.select(np.array([True, False, True]))
    assert selected.index.tolist() == [0, 2]
    assert len(association.select(np.ones(3, bool))) == 3


def test_one_repeated_stamp_is_refused() -> None:
    require_ascending(trajectory(np.array([0.0, 1.0, 2.0])), "truth")
    for stamps in ([0.0, 1.0, 1.0, 2.0], [0.0, 2.0, 1.0]):
        with pytest.raises(InputError, match="do not ascend"):
            require_ascending(trajectory(np.array(stamps)), "truth")


def test_interpolation_reaches_neither_end_nor_across_gaps() -> None:
    truth = trajectory(np.array([0.0, 0.5, 2.0, 2.5]))
    estimate = trajectory(np.array([-0.01, 0.0, 0.2, 1.0, 2.5, 2.51]))
    assert associate(estimate, truth, max_gap_s=0.5).index.tolist() == [1, 2, 4]
    assert associate(estimate, truth, max_gap_s=0.499).index.tolist() == [1, 4]


# ---- statistics, consistency, coverage


def test_statistics_leave_out_what_is_not_finite() -> None:
    statistics = Statistics.from_finite(np.array([1.0, np.nan, 3.0]))
    assert statistics is not None
    assert (statistics.n, statistics.mean) == (2, 2.0)
    assert Statistics.from_finite(np.full(3, np.nan)) is None
    assert Statistics.from_finite(None) is None


def test_consistency_of_one_known_pose() -> None:
    errors = np.full((3, 6), np.nan)
    errors[1, :3] = 1.0
    consistency = summarize_consistency([errors])
    assert consistency is not None
    assert (consistency.n, consistency.mean, consistency.dof) == (1, 1.0, 3.0)
    assert consistency.independent == 1.0
    assert summarize_consistency([errors[:1]]) is None


@pytest.mark.parametrize(("excess", "dof"), [(1e-13, 1), (1e-10, 2)])
def test_a_component_that_the_others_determine_does_not_count(excess: float, dof: int) -> None:
    """y is twice x, but for a variance that is rounding."""
    covariance = np.full((1, 6, 6), np.nan)
    covariance[0, :2, :2] = 1e-4 * np.array([[1.0, 2.0], [2.0, 4.0 * (1 + excess)]])
    residuals = np.array([[0.01, 0.02 + 1e-6, 0.0]])
    nees, nees_dof = nees_of(normalize_errors(residuals, None, covariance, Similarity.identity()))
    assert nees_dof.tolist() == [dof]
    assert (nees[0] == pytest.approx(1.0)) == (dof == 1)


def test_gaps_of_estimate_and_truth_do_not_count_as_covered() -> None:
    truth = trajectory(np.array([0.0, 0.5, 2.0, 2.5, 3.0]))
    every = compute_coverage(truth, truth, offset_s=0.0, max_gap_s=0.5)
    assert (every.solved_s, every.truth_s) == (1.5, 1.5)
    part = compute_coverage(truth.select(truth.time_ns != truth.time_ns[3]), truth,
                            offset_s=0.0, max_gap_s=0.5)  # fmt: skip
    assert (part.solved_s, part.truth_s) == (0.5, 1.5)
    single = compute_coverage(truth, trajectory(np.array([1.0])), offset_s=0.0, max_gap_s=0.5)
    assert single.fraction is None


# ---- pairs of poses


def matched(n: int, oriented: bool) -> MatchedPoses:
    heading = quaternion_from_heading(0.1 * np.arange(n))
    line = np.outer(np.arange(n), [1.0, 0.0, 0.0])
    quaternion = heading if oriented else None
    return MatchedPoses(np.arange(n) * 10**9, line, line, quaternion, quaternion)


def test_degrees_need_orientations_and_no_all_pairs() -> None:
    first, last = select_pairs(matched(30, True), Delta(11.0, "deg"))
    assert (last - first).tolist() == [2] * 14
    with pytest.raises(InputError, match="no orientations"):
        select_pairs(matched(30, False), Delta(10.0, "deg"))
    with pytest.raises(InputError, match="all pairs"):
        select_pairs(matched(30, True), Delta(10.0, "deg"), all_pairs=True)


@pytest.mark.parametrize("unit", ["m", "s", "deg"])
@pytest.mark.parametrize("n", [0, 1])
def test_fewer_than_two_poses_have_no_pairs(unit: Any, n: int) -> None:
    first, last = select_pairs(matched(n, True), Delta(1.0, unit))
    assert len(first) == len(last) == 0


def test_all_pairs_deviate_by_a_tenth_at_most() -> None:
    first, last = select_pairs(matched(10, False), Delta(2.15, "m"), all_pairs=True)
    assert (last - first).tolist() == [2] * 8
    assert len(select_pairs(matched(10, False), Delta(2.3, "m"), all_pairs=True)[0]) == 0


# ---- time offsets


def shifted(shift_s: float, start: int = 40, stop: int = -40) -> Trajectory:
    """Estimate whose stamps are late by ``shift_s``."""
    return trajectory(TIME_S[start:stop] + shift_s, path(TIME_S[start:stop]))


@pytest.mark.parametrize("span_s", [0.0, -1.0, float("nan")])
def test_the_span_of_offsets_must_be_positive(span_s: float) -> None:
    with pytest.raises(InputError, match="must be positive"):
        estimate_offset([(TRUTH, TRUTH)], span_s=span_s)


def test_an_offset_needs_ten_poses_with_truth_at_all_offsets() -> None:
    assert estimate_offset([(shifted(0.3, 40, 50), TRUTH)]) == pytest.approx(-0.3, abs=2e-3)
    with pytest.raises(InputError, match="only 9 poses"):
        estimate_offset([(shifted(0.3, 40, 49), TRUTH)])
    # Poses less than the span from the end have no truth at some offsets and are left out.
    with pytest.raises(InputError, match="only 0 poses"):
        estimate_offset([(shifted(0.0, 0, 19), TRUTH)])


def test_an_offset_at_the_end_of_the_span_is_refused() -> None:
    assert estimate_offset([(shifted(0.45), TRUTH)], span_s=0.5) == pytest.approx(-0.45, abs=2e-3)
    for shift_s in (0.7, -0.7):
        with pytest.raises(InputError, match="end of the span"):
            estimate_offset([(shifted(shift_s), TRUTH)], span_s=0.5)


def test_an_error_that_does_not_depend_on_the_offset_is_refused() -> None:
    rest = trajectory(TIME_S, np.zeros((len(TIME_S), 3)))
    with pytest.raises(DegenerateError, match="does not depend"):
        estimate_offset([(rest.select(np.arange(len(rest)) % 3 == 0), rest)])
    line = trajectory(TIME_S, np.outer(TIME_S, [0.3, 0.0, 0.0]))
    with pytest.raises(DegenerateError, match="does not depend"):
        estimate_offset([(line.select(np.arange(len(line)) % 3 == 0), line)], align="yaw")


def test_an_offset_refuses_truth_that_does_not_ascend() -> None:
    truth = replace(TRUTH, time_ns=TRUTH.time_ns[::-1].copy())
    with pytest.raises(InputError, match="do not ascend"):
        estimate_offset([(shifted(0.0), truth)])


def test_origin_does_not_rest_on_the_error_of_one_pose() -> None:
    estimate = shifted(0.2)
    position = estimate.position + np.random.default_rng(0).normal(0, 0.02, estimate.position.shape)
    position[0] += 1.0
    noisy = replace(estimate, position=position)
    assert estimate_offset([(noisy, TRUTH)], align="origin") == pytest.approx(-0.2, abs=0.02)


def test_offsets_are_around_the_given_one_to_the_nanosecond() -> None:
    months_s = 1.0e7
    late = trajectory(TIME_S[40:-40], path(TIME_S[40:-40]))
    late = late.shifted(round(months_s * 1e9))
    offset_s = estimate_offset([(late, TRUTH)], around_s=-months_s)
    assert offset_s == pytest.approx(-months_s, abs=1e-3)
    with pytest.raises(InputError, match="only 0 poses"):
        estimate_offset([(late, TRUTH)])


@pytest.mark.parametrize("part", [(0, 1), (0.5, 0.5), (0.6, 0.4), (-0.1, 0.5), (0.5, 1.1)])
def test_a_held_out_part_must_leave_something_to_score(part: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="no proper part"):
        estimate_held_out_offset([(shifted(0.1), TRUTH)], held_out=part)


def test_a_held_out_part_is_an_interval_of_time_of_all_devices() -> None:
    pairs = [(shifted(0.1), TRUTH), (shifted(0.1, 400), TRUTH)]
    offset, masks = estimate_held_out_offset(pairs, held_out=(0.0, 0.5))
    end_ns = pairs[0][0].time_ns[masks[0]][-1]
    assert masks[0].any()
    assert not masks[0].all()
    np.testing.assert_array_equal(masks[1], pairs[1][0].time_ns <= end_ns)
    assert (offset.source, offset.held_out) == ("held-out", (0.0, 0.5))
    last = estimate_held_out_offset(pairs, held_out=(0.5, 1.0))[1]
    assert last[0][-1]
    np.testing.assert_array_equal(last[0], ~masks[0])


def test_without_truth_there_is_no_part_to_hold_out() -> None:
    truth = trajectory(np.array([0.0, 40.0]))
    with pytest.raises(InputError, match="truth at its time"):
        estimate_held_out_offset([(shifted(0.0), truth)])


def test_parts_at_rest_are_the_last_resort() -> None:
    """The first quarter is slow but usable: a faster one is preferred, in order of time."""
    speed = np.where(TIME_S < 10, 0.2, 1.0)
    phase = np.concatenate([[0.0], np.cumsum(speed[1:] * np.diff(TIME_S))])
    truth = trajectory(TIME_S, path(phase))
    estimate = trajectory(TIME_S[30:-30] + 0.05, path(phase[30:-30]))
    assert estimate_held_out_offset([(estimate, truth)])[0].held_out == (0.25, 0.5)
    steady = estimate_held_out_offset([(shifted(0.05), TRUTH)])[0]
    assert steady.held_out == (0.0, 0.25)


def test_the_error_is_that_of_the_first_part() -> None:
    """The first quarter moves with an offset beyond the span; the others are at rest."""
    phase = np.minimum(TIME_S, 10.0)
    truth = trajectory(TIME_S, path(phase))
    estimate = trajectory(TIME_S[40:-40] + 0.7, path(phase[40:-40]))
    with pytest.raises(InputError, match="end of the span"):
        estimate_held_out_offset([(estimate, truth)], span_s=0.5)
    rest = trajectory(TIME_S, np.zeros((len(TIME_S), 3)))
    with pytest.raises(DegenerateError, match="does not depend"):
        estimate_held_out_offset([(rest, rest)])


# ---- clocks that disagree


@pytest.mark.parametrize(("start_s", "agree"), [(0.0, True), (20.0, True), (20.1, False)])
def test_clocks_agree_from_half_overlap_on(start_s: float, agree: bool) -> None:
    estimate = trajectory(np.linspace(0, 40, 50) + start_s)
    truth = trajectory(np.linspace(0, 40, 60))
    assert clocks_agree([(estimate, truth)]) == agree
    assert clocks_agree([(truth, estimate)]) == agree


def test_clocks_agree_by_the_majority_of_pairs() -> None:
    late, empty = TRUTH.shifted(10**12), TRUTH.select(np.zeros(len(TRUTH), bool))
    good, bad = (TRUTH, TRUTH), (late, TRUTH)
    assert clocks_agree([good, bad])
    assert not clocks_agree([good, bad, bad])
    assert not clocks_agree([(empty, TRUTH), bad])
    assert clocks_agree([(empty, TRUTH)])


def test_a_coarse_offset_needs_poses_in_both() -> None:
    empty = TRUTH.select(np.zeros(len(TRUTH), bool))
    for pair in ((empty, TRUTH), (TRUTH, empty)):
        with pytest.raises(InputError, match="no poses"):
            estimate_coarse_offset([pair])
        coarse = estimate_coarse_offset([pair, (TRUTH.shifted(10**12), TRUTH)])
        assert (coarse.method, coarse.offset_s) == ("motion", pytest.approx(-1e3, abs=0.1))


@pytest.mark.parametrize(("common_fraction", "method"), [(0.9, "motion"), (0.1, "first stamps")])
def test_motions_must_agree_by_half(common_fraction: float, method: str) -> None:
    rng = np.random.default_rng(1)
    noise = np.cumsum(rng.normal(0, 1, (len(TIME_S), 3)), axis=0)
    noise *= np.std(TRUTH.position) / np.std(noise)
    position = common_fraction * TRUTH.position + (1 - common_fraction) * noise
    late = trajectory(TIME_S, position).shifted(10**12)
    coarse = estimate_coarse_offset([(late, TRUTH)], align="se2", span_s=2.0)
    assert coarse.method == method
    assert (coarse.span_s == 2.0) == (method == "first stamps")


@pytest.mark.parametrize(("dip", "peaks"), [(4.5e-4, 1), (1e-3, 2)])
def test_noise_does_not_split_a_peak(dip: float, peaks: int) -> None:
    common = np.array([0.2, 0.5, 1.0, 1.0 - dip, 1.0, 0.5, 0.2, 0.99, 0.2])
    assert coarse_offset._count_peaks(common) == peaks


def test_a_part_that_overlaps_by_less_than_half_is_not_considered() -> None:
    """The end of the truth, of less than half its length, fits the beginning of the estimate."""
    estimate = trajectory(TIME_S, path(TIME_S + 30.0)).shifted(10**12)
    coarse = estimate_coarse_offset([(estimate, TRUTH)])
    assert abs(coarse.offset_s + 1e3 - 30.0) > 1.0


def test_the_text_of_a_time_offset() -> None:
    assert TimeOffset().describe() == "none"
    assert TimeOffset.given(0.0) == TimeOffset()
    assert TimeOffset.given(0.5).describe() == "given"
    part = "held-out 0% to 25% of the recording, not scored"
    assert TimeOffset(1.0, "held-out", (0.0, 0.25)).describe() == part
    together = f"{part}; clocks brought together by motion"
    assert TimeOffset(1.0, "held-out", (0.0, 0.25), "motion").describe() == together
    several = TimeOffset(1.0, "held-out", (0.0, 0.25), "motion", 3).describe()
    assert several == f"{together}, which fits other offsets as well (3)"
