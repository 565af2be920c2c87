"""Fragments at the rim of a beam: what continues a sequence, and what only lies beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.demodulation import burst_validation
from locatk.core.lighthouse.demodulation.burst_validation import (
    MAX_DECOY_FRACTION,
    MAX_SWEEP_S,
    WEAK_LIGHT_DELAY_BITS,
    decoy_fraction,
    match_fragments,
)
from locatk.core.lighthouse.demodulation.identification import identify_sequences
from locatk.core.lighthouse.demodulation.soft_bits import Bursts, demodulate_bursts, split_bursts


def fragment(light: Any, index: int, start_s: float, length: int) -> np.ndarray:
    """Edges of weak light: late, and only where a level lasts a bit."""
    bits = light.sequence(6)[index : index + length]
    change = light.biphase(bits)
    long = np.diff(change, append=change[-1] + 1) > 0.75
    level = np.arange(len(change)) % 2
    kept = np.flatnonzero(long)
    kept = kept[np.r_[True, np.diff(level[kept]) != 0]]
    return start_s + (change[kept] + WEAK_LIGHT_DELAY_BITS) / 6e6


def scene(light: Any, shift: int, gap_bits: int = 20, seed: int = 0) -> Bursts:
    """Sweeps with a fragment after each, of bits ``shift`` later than those that would follow."""
    noise = np.random.default_rng(seed)
    lines = []
    while len(lines) < 80:
        index = int(noise.integers(1000, 100_000))
        start = 5e-4 * (len(lines) + 2) + noise.uniform(0, 1e-7)
        whole = start + light.biphase(light.sequence(6)[index : index + 100]) / 6e6
        after = 100 + gap_bits
        weak = fragment(light, index + after + shift, start + after / 6e6, 60)
        if np.diff(weak).max() > 1.4e-6:
            continue  # would be two bursts
        lines += [whole[: len(whole) // 2 * 2], weak[: len(weak) // 2 * 2]]
    return split_bursts(light.edges(np.concatenate(lines), 1.0))


def judged(bursts: Bursts) -> tuple[np.ndarray, np.ndarray]:
    bits = demodulate_bursts(bursts)
    found = identify_sequences(bits)
    read = np.arange(len(bursts)) % 2 == 0
    assert found.is_certain()[read].all()
    return match_fragments(bursts, bits, found, read), read


def test_fragments_continue_their_sequence(light: Any) -> None:
    bursts = scene(light, 0)
    assert len(bursts) == 80
    of, read = judged(bursts)
    assert np.all(of[read] == -1)
    hit = of[~read] == np.flatnonzero(read)
    assert hit.mean() > 0.9
    assert np.all(hit | (of[~read] == -1))


@pytest.mark.slow
def test_other_places_do_not(light: Any) -> None:
    for shift in (-30, 17, 400):
        of, read = judged(scene(light, shift))
        assert np.mean(of[~read] >= 0) <= 0.05 + MAX_DECOY_FRACTION


@pytest.mark.slow
def test_noise_does_not(light: Any) -> None:
    noise = np.random.default_rng(7)
    lines = []
    for k in range(200):
        start = 1e-3 * (k + 1)
        bits = light.sequence(2)[500 * k : 500 * k + 80]
        lines.append(start + light.biphase(bits)[:100] / 6e6)
        lines.append(start + 25e-6 + np.cumsum(noise.uniform(8e-8, 6e-7, 40)))
    of, read = judged(split_bursts(light.edges(np.concatenate(lines), 1.0)))
    assert np.mean(of[~read] >= 0) <= 4 * MAX_DECOY_FRACTION


def test_far_ones_do_not(light: Any) -> None:
    far = round(1.3 * MAX_SWEEP_S * 6e6)
    of, _ = judged(scene(light, 0, gap_bits=far))
    assert np.all(of == -1)


def test_nothing_read_or_nothing_left(light: Any) -> None:
    bursts = scene(light, 0)
    bits = demodulate_bursts(bursts)
    found = identify_sequences(bits)
    for read in (np.zeros(len(bursts), bool), np.ones(len(bursts), bool)):
        assert np.all(match_fragments(bursts, bits, found, read) == -1)


@pytest.mark.parametrize(("fraction", "continues"), [(0.005, True), (0.006, False)])
def test_decoys_that_may_look_as_similar(
    light: Any, monkeypatch: pytest.MonkeyPatch, fraction: float, continues: bool
) -> None:
    monkeypatch.setattr(burst_validation, "decoy_fraction", lambda *_: fraction)
    of, read = judged(scene(light, 0))
    assert np.all((of[~read] >= 0) == continues)


@pytest.mark.parametrize(("late_s", "continues"), [(95e-6, True), (105e-6, False)])
def test_a_sweep_lasts_100_us_at_most(
    light: Any, monkeypatch: pytest.MonkeyPatch, late_s: float, continues: bool
) -> None:
    monkeypatch.setattr(burst_validation, "decoy_fraction", lambda *_: 0.0)
    whole = 1e-3 + light.biphase(light.sequence(6)[1000:1100])[:150] / 6e6
    weak = whole[0] + late_s + np.arange(8) * 2e-7
    bursts = split_bursts(light.edges(np.concatenate([whole, weak]), 0.01))
    bits = demodulate_bursts(bursts)
    of = match_fragments(bursts, bits, identify_sequences(bits), np.array([True, False]))
    assert of.tolist() == [-1, 0 if continues else -1]


def test_a_fragment_resembles_its_own_part_and_not_its_neighbours(light: Any) -> None:
    index, start_s = 5000, 1e-3
    bursts = split_bursts(light.edges(fragment(light, index, start_s, 100)[:60], 0.01))
    late = (bursts.start_tick[0] / 40e6 - start_s) * 6e6  # the first pulses may be missing
    fractions = [decoy_fraction(bursts, 0, 6, index + late + shift) for shift in (0, -4, 3, 250)]
    assert fractions[0] <= MAX_DECOY_FRACTION
    assert min(fractions[1:]) > 5 * MAX_DECOY_FRACTION


def test_a_fragment_shorter_than_a_bit_resembles_everything() -> None:
    bursts = Bursts(np.array([100, 104]), np.array([0, 2]), np.array([True]), 40e6)
    assert decoy_fraction(bursts, 0, 6, 5000.0) == 1.0


def test_weak_light_is_expected_a_quarter_of_a_bit_late(
    light: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    bursts = split_bursts(light.edges(fragment(light, 5000, 1e-3, 100)[:60], 0.01))
    shift = (bursts.start_tick[0] / 40e6 - 1e-3) * 6e6
    fraction = decoy_fraction(bursts, 0, 6, 5000 + shift)
    monkeypatch.setattr(burst_validation, "WEAK_LIGHT_DELAY_BITS", 0.0)
    assert WEAK_LIGHT_DELAY_BITS == 0.25
    # The first edge is already late by that delay.
    assert decoy_fraction(bursts, 0, 6, 5000 + shift - 0.25) == fraction
