"""Rotations, relative errors, drift, coverage and consistency: against what they must not change
with, and against draws whose answer is known."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import signal, stats
from scipy.spatial.transform import Rotation, Slerp

from locatk.core.errors import DegenerateError, InputError
from locatk.core.evaluation import (
    ALIGNMENTS,
    Delta,
    Evaluation,
    EvaluationOptions,
    associate,
    consistency,
    evaluate,
    pair_devices,
)
from locatk.core.geometry import (
    Similarity,
    matrix_from_quaternion,
    quaternion_angle,
    quaternion_from_matrix,
    quaternion_inverse,
    quaternion_multiply,
    rotation_exp,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

EPOCH = 1_690_218_696_000_000_000
TIME = np.arange(0, 20, 0.05)


def evaluate_pair(estimate: Trajectory, truth: Trajectory, **options: Any) -> Evaluation:
    return evaluate([(estimate, truth)], EvaluationOptions(**options))


def places(t: Array) -> Array:
    return np.stack([np.sin(0.9 * t), np.cos(0.61 * t) + 0.1 * t, 0.2 * np.sin(0.37 * t)], -1)


def turns(t: Array) -> Array:
    return rotation_exp(np.stack([0.3 * np.sin(t), 0.2 * np.cos(0.7 * t), 0.25 * t], -1))


def poses(
    time_s: Array = TIME,
    position: Array | None = None,
    rotation: Array | None = None,
    covariance: Array | None = None,
    device: str = "robot",
) -> Trajectory:
    """Poses on one way, or these."""
    t = np.asarray(time_s, float)
    return Trajectory(
        device,
        "floor",
        EPOCH + np.round(t * 1e9).astype(np.int64),
        places(t) if position is None else np.asarray(position, float),
        quaternion_from_matrix(turns(t) if rotation is None else rotation),
        np.full((len(t), 6, 6), np.nan) if covariance is None else covariance,
    )


def moved(of: Trajectory, motion: Similarity, covariance: Array | None = None) -> Trajectory:
    rotation = motion.rotation @ matrix_from_quaternion(of.quaternion)
    return Trajectory(
        of.device,
        of.frame,
        of.time_ns,
        motion.apply(of.position),
        quaternion_from_matrix(rotation),
        of.covariance if covariance is None else covariance,
    )


def noisy(seed: int = 0, sigma_m: float = 0.01, sigma_rad: float = 0.02) -> Trajectory:
    rng = np.random.default_rng(seed)
    position = places(TIME) + rng.normal(0, sigma_m, (len(TIME), 3))
    return poses(
        position=position,
        rotation=rotation_exp(rng.normal(0, sigma_rad, (len(TIME), 3))) @ turns(TIME),
    )


TRUTH = poses()
VECTORS = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@st.composite
def motions(draw: st.DrawFn, scales: bool = False) -> Similarity:
    scale = draw(st.floats(0.2, 5)) if scales else 1.0
    return Similarity(scale, rotation_exp(draw(VECTORS)), draw(VECTORS))


# ---- what errors must not change with


@settings(max_examples=12, deadline=None)
@given(motions(scales=True), st.sampled_from(["se3", "sim3"]))
def test_aligned_errors_do_not_change_with_the_frame(motion: Similarity, align: str) -> None:
    motion = motion if align == "sim3" else Similarity(1.0, motion.rotation, motion.translation)
    here = evaluate_pair(noisy(), TRUTH, align=align)
    there = evaluate_pair(moved(noisy(), motion), TRUTH, align=align)
    np.testing.assert_allclose(there.errors, here.errors, atol=1e-9)
    np.testing.assert_allclose(there.rotation_errors_deg, here.rotation_errors_deg, atol=1e-5)
    np.testing.assert_allclose(there.relative.translation, here.relative.translation, atol=1e-9)


@settings(max_examples=12, deadline=None)
@given(motions(), st.sampled_from(["1f", "7f", "0.3m", "20deg", "0.5s"]))
def test_relative_errors_do_not_change_with_a_rigid_motion(motion: Similarity, delta: str) -> None:
    here = evaluate_pair(noisy(), TRUTH, delta=Delta.parse(delta))
    there = evaluate_pair(moved(noisy(), motion), TRUTH, delta=Delta.parse(delta))
    assert here.rpe_delta == delta
    np.testing.assert_array_equal(there.relative.first, here.relative.first)
    np.testing.assert_allclose(there.relative.translation, here.relative.translation, atol=1e-9)
    assert here.drift_percent == pytest.approx(there.drift_percent)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(ALIGNMENTS))
def test_equal_stamps_match_symmetrically(seed: int, align: str) -> None:
    one = evaluate_pair(noisy(seed), TRUTH, align=align)
    other = evaluate_pair(noisy(seed), TRUTH, align=align, match="nearest")
    np.testing.assert_array_equal(one.errors, other.errors)
    np.testing.assert_array_equal(one.rotation_errors_deg, other.rotation_errors_deg)
    assert (one.n, other.n) == (len(TIME), len(TIME))


@pytest.mark.parametrize("align", ["yaw", "origin"])
def test_alignments_that_leave_something(align: str) -> None:
    yaw = Similarity(1.0, rotation_exp(np.array([0, 0, 0.7])), np.array([1.0, -2.0, 0.5]))
    tilted = Similarity(1.0, rotation_exp(np.array([0.3, 0, 0.7])), np.array([1.0, -2.0, 0.5]))
    assert evaluate_pair(moved(TRUTH, yaw), TRUTH, align=align).max < 1e-9
    found = evaluate_pair(moved(TRUTH, tilted), TRUTH, align=align)
    assert (found.max < 1e-9) == (align == "origin")
    assert (found.ape_rotation.max < 1e-5) == (align == "origin")
    first = evaluate_pair(noisy(), TRUTH, align="origin")
    assert first.errors[0] == pytest.approx(0, abs=1e-12)
    assert first.rotation_errors_deg[0] == pytest.approx(0, abs=1e-5)
    assert first.as_dict()["align_fitted_on"] == "the first scored pose"


# ---- rotations


def test_rotation_error_is_the_angle_between() -> None:
    angle = np.linspace(0, np.pi, len(TIME))
    axis = np.array([0.6, 0.0, 0.8])
    turned = poses(rotation=turns(TIME) @ rotation_exp(angle[:, None] * axis))
    found = evaluate_pair(turned, TRUTH)
    np.testing.assert_allclose(found.rotation_errors_deg, np.rad2deg(angle), atol=1e-6)
    assert found.ape_rotation.max == pytest.approx(180)


def test_orientations_between_stamps_are_on_the_great_circle() -> None:
    sparse = poses(np.arange(0, 20, 0.4))
    found = associate(poses(np.arange(0.1, 19, 0.13)), sparse)
    at = (found.time_ns - EPOCH) / 1e9
    rotations = Rotation.from_quat(sparse.quaternion)
    expected = Slerp((sparse.time_ns - EPOCH) / 1e9, rotations)(at)
    off = (Rotation.from_quat(found.truth_quaternion) * expected.inv()).magnitude()
    assert off.max() < 1e-7
    # The other sign is the same orientation.
    sign = np.where(np.arange(len(sparse)) % 2 == 0, 1.0, -1.0)[:, None]
    flipped = Trajectory(
        "r", "f", sparse.time_ns, sparse.position, sign * sparse.quaternion, sparse.covariance
    )
    again = associate(poses(np.arange(0.1, 19, 0.13)), flipped).truth_quaternion
    difference = quaternion_multiply(quaternion_inverse(again), found.truth_quaternion)
    assert quaternion_angle(difference).max() < 1e-7


def test_rotation_errors_are_given_only_if_observed() -> None:
    known = np.tile(np.eye(6) * 1e-4, (len(TIME), 1, 1))
    point = known.copy()
    point[:, 3:, :], point[:, :, 3:] = np.nan, np.nan
    photodiode = evaluate_pair(poses(covariance=point), TRUTH)
    assert photodiode.ape_rotation is None
    assert photodiode.rpe_rotation is None
    assert photodiode.rpe_translation is not None
    assert photodiode.nees_dof.tolist() == [3] * len(TIME)
    assert evaluate_pair(poses(covariance=known), TRUTH).ape_rotation is not None
    points = Trajectory.from_positions("r", "f", TRUTH.time_ns, TRUTH.position)
    assert evaluate_pair(TRUTH, points).ape_rotation is None
    assert evaluate_pair(TRUTH, points, match="nearest").ape_rotation is not None
    said = photodiode.as_dict()
    assert said["ape"]["rotation_deg"] is None
    assert said["drift"]["rotation_deg_per_m"] is None
    json.dumps(said, allow_nan=False)


def test_points_have_relative_errors_in_the_frame_of_the_truth() -> None:
    turn = Similarity(1.0, rotation_exp(np.array([0, 0, 1.0])), np.zeros(3))
    points = Trajectory.from_positions("r", "f", TRUTH.time_ns, turn.apply(TRUTH.position))
    truth = Trajectory.from_positions("r", "f", TRUTH.time_ns, TRUTH.position)
    assert evaluate_pair(points, truth, align="se2").rpe_translation.max < 1e-9


# ---- pairs, drift, coverage


@pytest.mark.parametrize(
    ("text", "value", "unit"),
    [("1f", 1, "f"), ("0.5m", 0.5, "m"), ("10 deg", 10, "deg"), (" 1e-1s", 0.1, "s")],
)
def test_deltas(text: str, value: float, unit: str) -> None:
    assert Delta.parse(text) == Delta(value, unit)


@pytest.mark.parametrize(
    "text", ["", "1", "f", "0f", "-1m", "1.5f", "nanm", "1e400m", "1km", "181deg", "1e-m", "infs"]
)
def test_no_deltas(text: str) -> None:
    with pytest.raises(InputError, match="no distance"):
        Delta.parse(text)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 60), st.floats(0.1, 3), st.booleans())
def test_pairs_have_the_minimum_distance(frames: int, metres: float, all_pairs: bool) -> None:
    found = evaluate_pair(
        noisy(), TRUTH, delta=Delta.parse(f"{frames}f"), all_pairs=all_pairs
    ).relative
    assert np.all(found.last - found.first == frames)
    if not all_pairs:
        np.testing.assert_array_equal(found.first[1:], found.last[:-1])
    way = np.concatenate(
        [[0], np.cumsum(np.linalg.norm(np.diff(noisy().position, axis=0), axis=1))]
    )
    far = evaluate_pair(
        noisy(), TRUTH, delta=Delta.parse(f"{metres}m"), all_pairs=all_pairs
    ).relative
    gone = way[far.last] - way[far.first]
    if all_pairs:
        assert np.all(np.abs(gone - metres) <= 0.1 * metres + 1e-9)
    else:
        assert np.all(gone >= metres - 1e-9)
        assert np.all(way[far.last - 1] - way[far.first] < metres + 1e-9)


def test_pairs_that_are_not_there() -> None:
    assert evaluate_pair(noisy(), TRUTH, delta=Delta.parse("1000m")).rpe_translation is None
    assert evaluate_pair(noisy(), TRUTH, delta=Delta.parse("1000f")).rpe_translation is None
    one = evaluate_pair(poses(TIME[:1]), TRUTH)
    assert (one.n, one.rpe_translation, one.drift_percent) == (1, None, None)
    assert one.path_m == 0
    with pytest.raises(InputError, match="all pairs"):
        evaluate_pair(noisy(), TRUTH, delta=Delta.parse("5deg"), all_pairs=True)


def test_pairs_are_of_one_device() -> None:
    far = poses(position=places(TIME) + 100.0, device="other")
    found = evaluate([(TRUTH, TRUTH), (far, far)])
    assert len(found.relative.first) == 2 * (len(TIME) - 1)
    assert found.rpe_translation.max == 0
    assert found.path_m == pytest.approx(2 * evaluate_pair(TRUTH, TRUTH).path_m)


def test_drift_of_an_estimate_that_is_two_percent_too_long() -> None:
    line = np.outer(TIME, [0.3, 0.4, 0.0])
    level = np.broadcast_to(np.eye(3), (len(TIME), 3, 3)) @ rotation_exp(np.array([0, 0, 0.1]))
    truth = poses(position=line, rotation=level)
    found = evaluate_pair(poses(position=1.02 * line, rotation=level), truth)
    assert found.drift_percent == pytest.approx(2.0, rel=0.02)
    assert found.path_m == pytest.approx(0.5 * TIME[-1])
    assert found.path_estimate_m == pytest.approx(0.51 * TIME[-1])
    assert evaluate_pair(truth, poses(position=0 * line)).drift_percent is None


def test_coverage_counts_no_gaps() -> None:
    keep = (TIME < 5) | (TIME > 14.99)
    found = evaluate_pair(poses(TIME[keep]), TRUTH).coverage
    assert found.truth_s == pytest.approx(19.95)
    assert found.solved_s == pytest.approx(4.95 + 4.95)
    gap = (TIME < 2) | (TIME > 3.99)
    less = evaluate_pair(TRUTH, poses(TIME[gap])).coverage
    assert (less.fraction, less.truth_s) == (1.0, pytest.approx(1.95 + 15.95))
    late = evaluate_pair(TRUTH, TRUTH, offset_s=10.0).coverage
    assert late.fraction == pytest.approx(9.95 / 19.95)
    single = evaluate_pair(poses(np.arange(0, 20.0)), poses(np.arange(0, 20.0))).coverage
    assert single.fraction is None


# ---- consistency


def drawn(factor: float, seed: int = 1, n: int = 4000) -> tuple[Trajectory, Trajectory]:
    """An estimate with errors from its covariance, which it reports ``factor`` times as large."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * 0.01
    root = rng.normal(0, 1, (n, 6, 6)) * np.array([10, 10, 10, 3, 3, 3])[:, None] * 1e-3
    covariance = root @ root.transpose(0, 2, 1)
    error = np.einsum("nij,nj->ni", root, rng.normal(0, 1, (n, 6)))
    estimate = poses(
        time,
        places(time) + error[:, :3],
        rotation_exp(error[:, 3:]) @ turns(time),
        factor * covariance,
    )
    return estimate, poses(time)


@pytest.mark.parametrize("factor", [1.0, 0.25, 9.0])
def test_nees_of_draws_is_chi_squared(factor: float) -> None:
    found = evaluate_pair(*drawn(factor))
    assert np.all(found.nees_dof == 6)
    said = found.consistency
    assert said.mean == pytest.approx(1 / factor, rel=0.03)
    assert said.median == pytest.approx(1 / factor, rel=0.05)
    assert (said.low <= said.mean <= said.high) == (factor == 1.0)
    assert said.sigma_ratio == pytest.approx(factor**-0.5, rel=0.02)
    words = {
        1.0: "covariances fit: NEES",
        0.25: "sigmas are 2 times too small: NEES",
        9.0: "sigmas are 3 times too large: NEES",
    }
    assert words[factor] in said.describe()
    if factor == 1.0:
        assert said.inside == pytest.approx(0.95, abs=0.015)
        assert stats.kstest(found.nees, stats.chi2(6).cdf).pvalue > 1e-3


@settings(max_examples=15, deadline=None)
@given(motions(scales=True))
def test_nees_is_that_of_the_frame_in_which_it_was_reported(motion: Similarity) -> None:
    estimate, truth = drawn(1.0, n=200)
    here = evaluate_pair(estimate, truth)
    # The estimate elsewhere and in another unit, its covariance as well.
    carry = np.zeros((6, 6))
    carry[:3, :3], carry[3:, 3:] = motion.scale * motion.rotation, motion.rotation
    there = moved(estimate, motion, carry @ estimate.covariance @ carry.T)
    aligned = evaluate_pair(there, truth, align="sim3")
    fitted = evaluate_pair(estimate, truth, align="sim3")
    np.testing.assert_allclose(aligned.nees, fitted.nees, rtol=1e-5, atol=1e-6)
    assert len(here.nees) == 200


def test_nees_adds_the_covariance_of_the_truth() -> None:
    estimate, truth = drawn(0.5)
    unsure = Trajectory(
        truth.device, truth.frame, truth.time_ns, truth.position, truth.quaternion,
        estimate.covariance,
    )  # fmt: skip
    assert evaluate_pair(estimate, unsure).consistency.mean == pytest.approx(1.0, rel=0.03)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sets(st.integers(0, 5), min_size=1))
def test_nees_of_what_is_known_against_a_plain_inverse(seed: int, known: set[int]) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 1, (5, 6, 6)) + 2 * np.eye(6)
    full = root @ root.transpose(0, 2, 1)
    unknown = [k for k in range(6) if k not in known]
    reported = full.copy()
    reported[:, unknown, :], reported[:, :, unknown] = np.nan, np.nan
    error = rng.normal(0, 1, (5, 6))
    turned = quaternion_from_matrix(rotation_exp(error[:, 3:]))
    values, dof = consistency.nees_of(
        consistency.normalize_errors(error[:, :3], turned, reported, Similarity.identity())
    )
    part = np.ix_(sorted(known), sorted(known))
    error[:, 3:] = Rotation.from_quat(turned).as_rotvec()
    expected = [
        e[sorted(known)] @ np.linalg.inv(c[part]) @ e[sorted(known)]
        for e, c in zip(error, full, strict=True)
    ]
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    assert dof.tolist() == [len(known)] * 5


def test_nees_omits_fixed_and_dependent_axes() -> None:
    covariance = np.full((3, 6, 6), np.nan)
    covariance[:, :3, :3] = np.diag([1e-4, 4e-4, 0.0])
    covariance[1, :2, :2] = [[1e-4, 2e-4], [2e-4, 4e-4]]  # y is twice x
    covariance[2] = np.nan
    offsets = np.array([[0.01, 0.02, 0.5], [0.01, 0.02, 0.5], [1.0, 1.0, 1.0]])
    normalized = consistency.normalize_errors(offsets, None, covariance, Similarity.identity())
    values, dof = consistency.nees_of(normalized)
    np.testing.assert_allclose(values, [2.0, 1.0, np.nan])
    assert dof.tolist() == [2, 1, 0]
    assert consistency.summarize_consistency([normalized[2:]]) is None


def test_quantiles_that_are_written_down() -> None:
    kinds = np.arange(1, 7)
    np.testing.assert_allclose(
        consistency.CHI2_95_QUANTILES[1:], stats.chi2.ppf(0.95, kinds), atol=1e-6
    )
    np.testing.assert_allclose(consistency.CHI2_MEDIANS[1:], stats.chi2.median(kinds), atol=1e-6)
    for dof, close in ((10, 1e-2), (100, 1e-3), (10_000, 1e-4)):
        for sign, tail in ((-1, 0.025), (1, 0.975)):
            found = consistency.reduced_chi2_quantile(dof, sign * consistency.NORMAL_95_QUANTILE)
            assert found == pytest.approx(stats.chi2.ppf(tail, dof) / dof, rel=close)


def test_a_few_outlying_poses_are_distinguished() -> None:
    estimate, truth = drawn(1.0)
    position = estimate.position.copy()
    position[::500] += 5.0
    spoiled = Trajectory("r", "f", estimate.time_ns, position, estimate.quaternion,
                         estimate.covariance)  # fmt: skip
    assert "because of a few poses" in evaluate_pair(spoiled, truth).consistency.describe()


# Generators of normalized errors (n, k) of variance 1. Only the passes are as the estimate of the
# number of independent errors assumes. Nothing was tuned on them or on the seeds of these tests.


def independent_errors(rng: np.random.Generator, k: int) -> Array:
    return rng.normal(size=(600, k))


def decaying_errors(rng: np.random.Generator, k: int, poses: float = 40.0) -> Array:
    """An Ornstein-Uhlenbeck process, as of odometry that is corrected now and then."""
    decay = np.exp(-1 / poses)
    steps = np.sqrt(1 - decay**2) * rng.normal(size=(1200, k))
    steps[0] = rng.normal(size=k)
    return np.asarray(signal.lfilter([1.0], [1.0, -decay], steps, axis=0))


def errors_of_passes(rng: np.random.Generator, k: int) -> Array:
    """Poses over tags: all of one pass share an error, and passes differ in length."""
    lengths = rng.integers(20, 120, 16)
    return np.repeat(rng.normal(size=(16, k)), lengths, axis=0)


def smooth_errors(rng: np.random.Generator, k: int) -> Array:
    """Sums of waves of random length, as of a path over a distorted floor."""
    time, frequency = np.arange(500) / 500, rng.normal(0, 50, (30, k))
    amplitude, phase = rng.rayleigh(1.0, (30, k)), rng.uniform(0, 2 * np.pi, (30, k))
    waves = np.cos(time[:, None, None] * frequency + phase)
    return np.einsum("nwk,wk->nk", waves, amplitude) / np.sqrt(30)


def constant_errors(rng: np.random.Generator, k: int) -> Array:
    return np.tile(rng.normal(size=k), (300, 1))


def mixed_errors(rng: np.random.Generator, k: int) -> Array:
    """Errors of which one component decays slowly, and the others are independent."""
    errors = rng.normal(size=(1200, k))
    errors[:, 0] = decaying_errors(rng, 1, 100.0)[:, 0]
    return errors


GENERATORS = (
    independent_errors, decaying_errors, errors_of_passes, smooth_errors, constant_errors,
    mixed_errors,
)  # fmt: skip


def summary_of(errors: Array, factor: float = 1.0) -> consistency.Consistency:
    normalized = np.full((len(errors), 6), np.nan)
    normalized[:, : errors.shape[1]] = factor * errors
    summary = consistency.summarize_consistency([normalized])
    assert summary is not None
    return summary


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 3, 6])
@pytest.mark.parametrize("generator", GENERATORS)
def test_right_covariances_fit_however_errors_are_shared(
    generator: Callable[[np.random.Generator, int], Array], k: int
) -> None:
    """At most 5 % of the drives are accused, of 300 in expectation; 9 % is three sigmas off."""
    rng = np.random.default_rng([2026, k])
    summaries = [summary_of(generator(rng, k)) for _ in range(300)]
    verdicts = Counter(each.verdict for each in summaries)
    assert verdicts["too_small"] + verdicts["too_large"] <= 0.09 * 300
    # The spread of the mean NEES over all drives gives the number that each has to estimate.
    spread = 2 / (k * np.var([each.mean for each in summaries]))
    assert 0.35 < np.median([each.independent for each in summaries]) / spread < 1.3


@pytest.mark.parametrize("generator", GENERATORS)
def test_wrong_covariances_are_named(
    generator: Callable[[np.random.Generator, int], Array],
) -> None:
    """Sigmas of a third or three times the right ones never fit without reservation."""
    rng = np.random.default_rng(11)
    for factor, verdict in ((3.0, "too_small"), (1 / 3, "too_large")):
        summary = summary_of(generator(rng, 3), factor)
        if generator is not constant_errors:
            assert summary.verdict == verdict
            assert f"times {verdict.replace('_', ' ')}: NEES" in summary.describe()
            low, high = summary.sigma_ratio_interval
            assert low < factor < high
        assert not summary.describe().startswith("covariances fit:")


def test_a_single_error_is_no_proof_of_fit() -> None:
    summary = summary_of(np.tile([0.9, -1.1, 1.0], (300, 1)))
    assert summary.verdict == "fit"
    assert "covariances fit as far as 1 independent error can show" in summary.describe()


def test_nees_of_1_93_does_not_fit() -> None:
    """It was once reported as fitting."""
    errors = np.random.default_rng(5).normal(size=(400, 3))
    summary = summary_of(errors, np.sqrt(1.93 / np.mean(errors**2)))
    assert summary.describe().startswith("sigmas are 1.4 times too small: NEES 1.93")
    table = summary.as_dict()
    assert (table["verdict"], table["sigma_ratio"]) == ("too_small", pytest.approx(1.93**0.5))
    assert 1.3 < table["sigma_ratio_low"] < 1.93**0.5 < table["sigma_ratio_high"] < 1.5


def test_verdicts_in_words() -> None:
    base = summary_of(np.random.default_rng(5).normal(size=(400, 3)))
    for mean, words in (
        (1.1, "sigmas are 5 % too small"),
        (0.9, "sigmas are 5 % too large"),
        (1.2, "sigmas are 10 % too small"),
        (0.0, "sigmas are more than 100 times too large"),
        (225.0, "sigmas are 15 times too small"),
    ):
        assert replace(base, mean=mean, low=0.95, high=1.05).describe().startswith(words)
    one = replace(base, mean=1.9, low=0.0, high=5.0, independent=1.0)
    assert "0.62 to any number of times the reported ones" in one.describe()
    assert one.as_dict()["sigma_ratio_high"] is None


def test_errors_of_devices_are_independent() -> None:
    errors = np.ones((50, 6))
    summary = consistency.summarize_consistency([errors, -errors, np.full((5, 6), np.nan)])
    assert summary is not None
    assert summary.independent == pytest.approx(2.0, rel=1e-2)


# ---- association, and what cannot be evaluated


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 200), min_size=1, max_size=30, unique=True),
    st.lists(st.integers(0, 200), min_size=1, max_size=30, unique=True),
    st.integers(1, 20),
)
def test_nearest_against_a_search_of_all(mine: list[int], true: list[int], limit: int) -> None:
    estimate, truth = (poses(np.array(sorted(each)) * 1e-3) for each in (mine, true))
    found = associate(estimate, truth, match="nearest", max_diff_s=limit * 1e-3 + 1e-5)
    short, long = sorted(mine), sorted(true)
    if len(mine) > len(true):
        short, long = long, short
    expected = []
    for stamp in short:
        best = min(long, key=lambda other: (abs(other - stamp), other))
        if abs(best - stamp) <= limit:
            expected.append((stamp, best))
    pairs = list(
        zip(
            np.round((estimate.time_ns[found.index] - EPOCH) / 1e6).astype(int).tolist(),
            np.round((truth.time_ns[found.before] - EPOCH) / 1e6).astype(int).tolist(),
            strict=True,
        )
    )
    if len(mine) > len(true):
        pairs = [(b, a) for a, b in pairs]
    # Of two just as near, float64 seconds of the epoch tell which.
    assert [a for a, _ in pairs] == [a for a, _ in expected]
    assert [abs(a - b) for a, b in pairs] == [abs(a - b) for a, b in expected]


def test_poses_left_out_are_counted_once() -> None:
    dense, sparse = poses(np.arange(0, 10, 0.01)), poses(np.arange(0, 10, 0.5))
    found = evaluate_pair(dense, sparse, match="nearest")
    assert (found.n, found.unscored["no truth"]) == (20, 980)


def test_devices_are_paired_by_name() -> None:
    a, b, c = (poses(device=name) for name in "abc")
    assert pair_devices([a], [c]) == ([(a, c)], [])
    assert pair_devices([a, b], [b, c]) == ([(b, b)], ["a"])


def test_bad_input_is_named_in_one_line() -> None:
    with pytest.raises(InputError, match="unknown match"):
        evaluate_pair(TRUTH, TRUTH, match="best")
    with pytest.raises(InputError, match="truth at its time") as caught:
        evaluate_pair(TRUTH, poses(TIME + 1e6))
    assert "--offset" in caught.value.hint
    line = poses(position=np.outer(TIME, [1.0, 0, 0]))
    for align in ("se3", "sim3"):
        with pytest.raises(DegenerateError, match=f"{align}.*line"):
            evaluate_pair(line, line, align=align)
    still = poses(position=np.zeros((len(TIME), 3)))
    with pytest.raises(DegenerateError, match="coincide"):
        evaluate_pair(still, still, align="yaw")
    assert evaluate_pair(still, still, align="origin").max == 0
    with pytest.raises(InputError, match="ascend"):
        evaluate_pair(poses(np.zeros(3)), TRUTH, match="nearest")
