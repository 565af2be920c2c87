"""Polynomials and places: every clean window, weak ones, noise, and both twins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from locatk.core.kernels import kernels
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.demodulation.identification import (
    MAX_ERROR_FRACTION,
    MAX_UNKNOWN_SOFT_BIT,
    MIN_PREDICTED_BITS,
    MIN_STANDALONE_EVIDENCE_BITS,
    SequenceMatches,
    false_match_probability,
    identify_sequences,
    identify_sequences_numpy,
    match_expected,
    match_expected_numpy,
)
from locatk.core.lighthouse.demodulation.soft_bits import (
    MAX_SOFT_BIT,
    SoftBits,
    demodulate_bursts,
    split_bursts,
    split_windows,
)
from locatk.core.lighthouse.recording import Edges

CAPTURE = "benchmarks/demodulation_code/logic_analyser_capture.sal"


def soft(rows: Any) -> SoftBits:
    """Rows (n, k) of values as bursts."""
    rows = np.asarray(rows, np.int8)
    first = np.arange(len(rows) + 1) * rows.shape[1]
    return SoftBits(rows.ravel(), first, np.zeros(len(rows)), 20 / 3)


def sent(light: Any, polynomial: int, index: np.ndarray, length: int) -> np.ndarray:
    """Clean values (n, length) of what a station sends from ``index`` (n,) on."""
    bits = light.sequence(polynomial)[index[:, None] + np.arange(length)]
    return np.where(bits > 0, MAX_SOFT_BIT, -MAX_SOFT_BIT).astype(np.int8)


def same(a: SequenceMatches, b: SequenceMatches) -> None:
    for field in fields(SequenceMatches):
        assert np.array_equal(getattr(a, field.name), getattr(b, field.name)), field.name


@pytest.mark.slow
@pytest.mark.parametrize("polynomial", range(32))
def test_clean_windows_of_60_bits(light: Any, polynomial: int) -> None:
    # Every fourth place, another one by polynomial.
    index = np.arange(polynomial % 4, lfsr.SEQUENCE_LENGTH, 4 if kernels else 911)
    # The first and the last places, at which a window runs over the register's end.
    index = np.unique(
        np.concatenate([index, np.arange(70), lfsr.SEQUENCE_LENGTH - 1 - np.arange(70)])
    )
    found = identify_sequences(soft(sent(light, polynomial, index, 60)))
    assert np.array_equal(found.polynomial, np.full(len(index), polynomial))
    assert np.array_equal(found.index, index)
    assert found.is_certain().all()
    assert np.all(found.wrong_bits == 0)


@pytest.mark.slow
def test_shorter_windows(light: Any) -> None:
    # What 17 bits are needed for does not speak; what is left has to do so.
    index = np.arange(0, lfsr.SEQUENCE_LENGTH, 257)
    for length in (36, 42, 48, 59):
        right = wrong = 0
        for polynomial in range(0, 32, 3):
            found = identify_sequences(soft(sent(light, polynomial, index, length)))
            hit = (found.polynomial == polynomial) & (found.index == index)
            right += np.count_nonzero(hit)
            wrong += np.count_nonzero(~hit & found.is_certain())
        assert wrong == 0
        assert right >= 0.999 * 11 * len(index)


@pytest.mark.parametrize("polynomial", range(32))
def test_all_channels_and_slow_bits_through_errors(light: Any, polynomial: int) -> None:
    noise = np.random.default_rng(polynomial)
    index = noise.integers(0, 119_000, 300)
    value = sent(light, polynomial, index, 150)
    value = np.where(noise.random(value.shape) < 0.03, -value, value)
    value = np.where(noise.random(value.shape) < 0.03, 0, value)
    found = identify_sequences(soft(value))
    sure = found.is_certain()
    assert sure.mean() > 0.9
    assert np.array_equal(found.polynomial[sure], np.full(sure.sum(), polynomial))
    assert np.array_equal(found.index[sure], index[sure])


def test_noise_around_does_not_matter(light: Any) -> None:
    noise = np.random.default_rng(2)
    index = noise.integers(100, 119_000, 500)
    value = noise.choice([-MAX_SOFT_BIT, MAX_SOFT_BIT], (500, 200)).astype(np.int8)
    value[:, 60:140] = sent(light, 9, index, 80)
    found = identify_sequences(soft(value))
    assert np.mean((found.polynomial == 9) & (found.index == index - 60)) == 1
    # Noise goes on agreeing by accident: a bit in two.
    assert np.abs(found.begin - 60).max() < 25
    assert np.abs(found.begin - 60).mean() < 2
    assert np.abs(found.end - 140).mean() < 2


def test_unknown_bits_are_ignored(light: Any) -> None:
    index = np.arange(5, 119_000, 977)
    value = sent(light, 4, index, 120)
    clean = identify_sequences(soft(value))
    unknown = value.copy()
    unknown[:, 30:50] = np.resize([MAX_UNKNOWN_SOFT_BIT, -MAX_UNKNOWN_SOFT_BIT, 0], 20)
    found = identify_sequences(soft(unknown))
    assert np.array_equal(found.index, index)
    assert np.all(found.known_bits == 100)
    assert np.all(found.wrong_bits == 0)
    each = clean.evidence_bits[0] / 120
    # Up to MAX_UNKNOWN_SOFT_BIT they are worth next to nothing, and 20 bits are missing.
    assert np.all(np.abs(found.evidence_bits - 100 * each) < 20 * each * 0.15)


def test_contradictions_in_proportion_to_known_bits() -> None:
    n = 6
    known = np.array([100, 100, 50, 50, 0, 10], np.int32)
    wrong = np.array([20, 21, 10, 11, 0, 3], np.int32)
    rows = [np.zeros(n, np.int32), np.zeros(n, np.int64), np.full(n, MIN_STANDALONE_EVIDENCE_BITS)]
    found = SequenceMatches(*rows, np.zeros(n, np.int32), known, known, wrong)
    assert MAX_ERROR_FRACTION == 0.2
    assert found.is_certain().tolist() == [True, False, True, False, True, False]
    assert not found.is_certain(MIN_STANDALONE_EVIDENCE_BITS + 1).any()


def test_weak_bits_with_many_contradictions_are_not_certain(light: Any) -> None:
    # Much evidence of many unsure bits, a quarter of them wrong.
    noise = np.random.default_rng(4)
    index = noise.integers(0, 119_000, 200)
    value = np.sign(sent(light, 6, index, 300)) * 16
    value[:, 100:130] *= 4
    flip = noise.random(value.shape) < 0.26
    flip[:, 100:130] = False
    found = identify_sequences(soft(np.where(flip, -value, value)))
    share = found.wrong_bits / np.maximum(found.known_bits, 1)
    many = (found.evidence_bits >= MIN_STANDALONE_EVIDENCE_BITS) & (share > MAX_ERROR_FRACTION)
    assert many.any()
    assert not found.is_certain()[many].any()


def test_too_little_to_say(light: Any) -> None:
    nothing = identify_sequences(
        SoftBits(np.zeros(0, np.int8), np.zeros(1, np.int64), np.zeros(0), 5.0)
    )
    assert len(nothing) == 0
    for length in (0, 1, 17, lfsr.REGISTER_BITS + MIN_PREDICTED_BITS - 1):
        found = identify_sequences(soft(sent(light, 3, np.array([77]), length)))
        assert found.polynomial.tolist() == [-1]
        assert found.index.tolist() == [-1]
        assert not found.is_certain(0.0).any()
    # All zeros follow from themselves under any polynomial, and are none of a station's.
    assert not identify_sequences(soft(np.full((2, 90), -MAX_SOFT_BIT))).is_certain().any()
    assert not identify_sequences(soft(np.zeros((2, 90)))).is_certain(0.1).any()


def test_only_the_first_polynomials(light: Any) -> None:
    index = np.array([1000, 50_000])
    assert identify_sequences(soft(sent(light, 5, index, 80)), 4).is_certain().tolist() == [
        False,
        False,
    ]
    assert identify_sequences(soft(sent(light, 3, index, 80)), 4).polynomial.tolist() == [3, 3]


def test_bits_of_noise() -> None:
    n = 20_000 if kernels else 1000
    value = np.random.default_rng(8).choice([-MAX_SOFT_BIT, MAX_SOFT_BIT], (n, 150))
    found = identify_sequences(soft(value))
    for evidence in (32.0, 34.0, 36.0, MIN_STANDALONE_EVIDENCE_BITS):
        expected = false_match_probability(evidence) * n
        assert np.count_nonzero(found.is_certain(evidence)) <= expected + 3 * np.sqrt(expected) + 1
    # The promise is no empty one.
    assert np.count_nonzero(found.is_certain(32.0)) > 0.2 * false_match_probability(32.0) * n


@pytest.mark.parametrize("runs", [(1, 2), (1, 2, 3), (0.4, 0.9, 1.3, 1.9, 2.4, 4)])
def test_edges_of_noise(light: Any, runs: tuple[float, ...]) -> None:
    noise = np.random.default_rng(3)
    run = noise.choice(runs, 400_000) / 12e6
    run[noise.random(len(run)) < 0.01] = 1e-4
    bursts = split_bursts(light.edges(np.cumsum(run), 1.0))
    found = identify_sequences(demodulate_bursts(bursts.take(bursts.duration_s > 5e-6)))
    assert np.count_nonzero(found.is_certain()) <= 1 + 3 * false_match_probability(
        MIN_STANDALONE_EVIDENCE_BITS
    ) * len(found)


@pytest.mark.slow
def test_twins(light: Any) -> None:
    noise = np.random.default_rng(11)
    for length in (24, 25, 26, 63, 64, 65, 127, 128, 129, 200, 300, 1000, 1000, 1000):
        index = noise.integers(0, lfsr.SEQUENCE_LENGTH - 1000, 64)
        value = sent(light, int(noise.integers(32)), index, length).astype(float)
        value *= noise.uniform(-0.2, 1, value.shape) * noise.choice([-0.3, 1, 1], (64, 1))
        value[:20] = noise.normal(0, 30, (20, length))
        bits = soft(np.clip(np.rint(value), -MAX_SOFT_BIT, MAX_SOFT_BIT))
        same(identify_sequences(bits), identify_sequences_numpy(bits))
        polynomial = noise.integers(0, 32, (64, 3)).astype(np.int32)
        place = noise.integers(-9, 2 * lfsr.SEQUENCE_LENGTH, (64, 3))
        same(
            match_expected(bits, polynomial, place, 2),
            match_expected_numpy(bits, polynomial, place, 2),
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", [CAPTURE, "fpga/take1.csv", "fpga/about_4m.csv"])
def test_twins_on_published_light(published: Callable[[str], Edges], name: str) -> None:
    bits = demodulate_bursts(split_bursts(published(name)))
    found = identify_sequences(bits)
    same(found, identify_sequences_numpy(bits))
    some = np.flatnonzero(np.diff(bits.first) > 20)[:500]
    few = bits.take(some)
    polynomial = np.maximum(found.polynomial[some], 0)[:, None]
    place = found.index[some][:, None] + 3
    same(match_expected(few, polynomial, place, 4), match_expected_numpy(few, polynomial, place, 4))


def test_a_place_that_is_expected(light: Any) -> None:
    index = np.array([5, 130_000, lfsr.SEQUENCE_LENGTH - 3, 700])
    bits = soft(sent(light, 8, index, 40))
    near = np.mod(index + np.array([-3, 4, 2, 9]), lfsr.SEQUENCE_LENGTH)[:, None]
    found = match_expected(bits, np.full((4, 1), 8, np.int32), near, 4)
    assert found.index.tolist()[:3] == index.tolist()[:3]
    assert found.is_certain(20.0).tolist() == [True, True, True, False]
    assert (
        len(match_expected(soft(np.zeros((0, 3))), np.zeros((0, 2), np.int32), np.zeros((0, 2)), 1))
        == 0
    )
    empty = match_expected(soft(np.zeros((2, 0))), np.zeros((2, 1), np.int32), np.zeros((2, 1)), 1)
    assert not empty.is_certain(0.1).any()


def test_windows_of_a_microcontroller(light: Any) -> None:
    # 64 bytes at 32 MHz are 96 bits.
    noise = np.random.default_rng(1)
    level = np.empty((200, 512), np.uint8)
    truth = noise.integers(0, 119_000, 200)
    for row, index in zip(level, truth, strict=True):
        change = light.biphase(light.sequence(11)[index : index + 110]) - noise.uniform(0, 1)
        row[:] = (np.searchsorted(change, np.arange(512) / (32 / 6)) + index) % 2
    found = identify_sequences(demodulate_bursts(split_windows(np.packbits(level, axis=1))))
    assert found.is_certain().all()
    assert np.all(found.polynomial == 11)
    assert np.all(np.abs(found.index - truth) <= 2)


def test_eight_bits_must_follow_from_the_17_before_them(light: Any) -> None:
    for identify in (identify_sequences, identify_sequences_numpy):
        for length, polynomial in ((24, -1), (25, 3)):
            found = identify(soft(sent(light, 3, np.array([77]), length)), 4)
            assert found.polynomial.tolist() == [polynomial]


def test_certain_from_40_bits_of_evidence() -> None:
    one = np.ones(3, np.int32)
    evidence = np.array([39.9, 40.0, 27.0])
    found = SequenceMatches(one, one.astype(np.int64), evidence, one, one, 50 * one, 0 * one)
    assert found.is_certain().tolist() == [False, True, False]
    assert false_match_probability(40.0) == 2.0**-13
    assert false_match_probability(20.0) == 1.0
