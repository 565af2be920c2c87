"""Bursts judged by the rotors: wrong decodes refused, weak bursts taken, doubled channels out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.channels import channel_of, period_ticks
from locatk.core.lighthouse.demodulation import burst_validation
from locatk.core.lighthouse.demodulation.burst_validation import (
    ValidatedBursts,
    _match_predicted,
    identify_bursts,
    validate_bursts,
)
from locatk.core.lighthouse.demodulation.identification import (
    MIN_STANDALONE_EVIDENCE_BITS,
    SequenceMatches,
    identify_sequences,
)
from locatk.core.lighthouse.demodulation.rotor import Rotor, RotorSet, find_rotors
from locatk.core.lighthouse.demodulation.soft_bits import (
    MAX_SOFT_BIT,
    SoftBits,
    split_bursts,
)
from locatk.core.lighthouse.recording import Edges


def reading(line: Edges, found: RotorSet | None = None) -> ValidatedBursts:
    """A photodiode's bursts, judged by what they say themselves or by ``found``."""
    bursts = split_bursts(line)
    bits, matches = identify_bursts(bursts)
    if found is None:
        found = find_rotors(
            bits.start_tick, matches.polynomial, matches.index, matches.evidence_bits, line.rate_hz
        )
    return validate_bursts(bursts, bits, matches, found)


def test_clean_light_is_read(light: Any) -> None:
    (line,), passed = light.of([light.Sender(1, ppm=9), light.Sender(12, zero_s=0.001)], 2.0)
    read = reading(line)
    assert read.is_accepted.sum() >= 0.98 * len(passed.time_s)
    assert np.abs(read.rotor_residual_s[read.is_accepted]).max() < 1e-7
    assert sum(read.rejected.values()) == np.count_nonzero(
        ~read.is_accepted & (read.continued_burst < 0)
    )


def test_spoiled_sweeps_are_not(light: Any) -> None:
    path = light.Receiving(spoiled=0.3)
    (line,), passed = light.of([light.Sender(5, ppm=-20)], 10.0, path)
    read = reading(line)
    right = np.count_nonzero(~passed.spoiled)
    assert right <= read.is_accepted.sum() <= right + 3
    assert read.rejected["burst_not_read"] >= passed.spoiled.sum() - 3


def test_bursts_off_the_rotor_are_refused(light: Any) -> None:
    (line,), _ = light.of([light.Sender(5)], 2.0)
    (other,), stray = light.of([light.Sender(5, zero_s=0.0111)], 0.09)
    tick = np.union1d(line.tick, other.tick + round(1.0 * line.rate_hz))
    both = Edges(tick, line.rate_hz, line.rate_hz, True, line.end_tick)
    read = reading(both)
    assert read.rejected["burst_off_rotor"] == len(stray.time_s)
    assert np.all(read.matches.is_certain()[~read.is_accepted])


def test_weak_bursts_are_accepted_if_a_rotor_predicts_them(light: Any) -> None:
    # Ten microseconds of noisy light do not stand on their own; with the rotor they do.
    strong = light.Receiving()
    weak = light.Receiving(width_s=6.5e-6, jitter_s=5e-9)
    sender = light.Sender(5)
    (line,), _ = light.of([sender], 2.0, strong)
    bursts = split_bursts(line)
    bits, matches = identify_bursts(bursts)
    found = find_rotors(
        bits.start_tick, matches.polynomial, matches.index, matches.evidence_bits, line.rate_hz
    )
    (thin,), passed = light.of([sender], 2.0, weak)
    read = reading(thin, found)
    assert np.mean(identify_bursts(split_bursts(thin))[1].is_certain()) < 0.2
    assert read.is_accepted.sum() > 0.9 * len(passed.time_s)
    right = read.matches.polynomial[read.is_accepted] == passed.polynomial[read.is_accepted]
    assert right.all()
    assert read.matches.evidence_bits[read.is_accepted].min() < MIN_STANDALONE_EVIDENCE_BITS


@pytest.mark.slow
def test_bursts_of_a_doubled_channel_are_rejected(light: Any) -> None:
    senders = [light.Sender(3), light.Sender(3, zero_s=0.011), light.Sender(9, zero_s=0.002)]
    (line,), _ = light.of(senders, 10.0, light.Receiving(rim_s=1e-6))
    read = reading(line)
    assert np.all(channel_of(read.matches.polynomial[read.is_accepted]) == 9)
    sure = read.matches.is_certain() & (channel_of(read.matches.polynomial) == 3)
    assert read.rejected["burst_of_doubled_channel"] == np.count_nonzero(
        sure & (read.continued_burst < 0)
    )
    assert sure.sum() > 1900


def test_without_a_rotor_certain_bursts_are_accepted(light: Any) -> None:
    (line,), passed = light.of([light.Sender(3, until_s=0.03)], 1.0, light.Receiving(missing=0.3))
    read = reading(line)
    assert 0 < len(passed.time_s) < 4
    assert read.is_accepted.sum() == len(passed.time_s)
    assert np.isnan(read.rotor_residual_s).all()
    assert not reading(line, RotorSet({}, (3,))).is_accepted.any()


def test_nothing() -> None:
    read = reading(Edges(np.zeros(0, np.int64), 40e6, 40e6, True, 1))
    assert len(read.is_accepted) == 0
    assert not any(read.rejected.values())


# ---- thresholds


def uniform_rotor(channel: int) -> Rotor:
    """A rotor at nominal speed, by a recorder of 48 MHz."""
    knots = np.array([0.0, 1e9])
    period = float(period_ticks(channel))
    return Rotor(channel, period, 0.0, knots, np.zeros(2), 100, 0, 1.0)


def weak_burst(light: Any, polynomial: int, index: int, length: int, off_bits: int) -> SoftBits:
    """Clean bits that are received ``off_bits`` after their rotor predicts them."""
    bits = light.sequence(polynomial)[index : index + length]
    value = np.where(bits > 0, MAX_SOFT_BIT, -MAX_SOFT_BIT).astype(np.int8)
    return SoftBits(value, np.array([0, length]), np.array([(index + off_bits) * 8.0]), 8.0)


def predicted(light: Any, length: int, off_bits: int) -> bool:
    """True if a burst of the second polynomial of channel 5 is matched by its rotor."""
    bits = weak_burst(light, 9, 40_000, length, off_bits)
    matches, is_replaced = _match_predicted(
        bits,
        identify_sequences(bits.take(np.zeros(1, int))),
        np.array([True]),
        RotorSet({5: uniform_rotor(5), 12: uniform_rotor(12)}, ()),
    )
    if is_replaced[0]:
        assert (matches.polynomial[0], matches.index[0]) == (9, 40_000)
    return bool(is_replaced[0])


@pytest.mark.parametrize(("length", "is_match"), [(20, False), (21, True)])
def test_a_predicted_burst_needs_20_bits_of_evidence(
    light: Any, length: int, is_match: bool
) -> None:
    # A clean bit is 0.97 bits of evidence.
    assert predicted(light, length, 0) == is_match


@pytest.mark.parametrize(("off_bits", "is_match"), [(14, True), (-14, True), (15, False)])
def test_a_predicted_burst_is_searched_within_14_bits(
    light: Any, off_bits: int, is_match: bool
) -> None:
    assert predicted(light, 50, off_bits) == is_match


@pytest.mark.parametrize(("shift_s", "accepted"), [(1.8e-6, True), (2.2e-6, False)])
def test_accepted_bursts_are_within_2_us_of_their_rotor(
    light: Any, shift_s: float, accepted: bool
) -> None:
    (line,), passed = light.of([light.Sender(5)], 1.0)
    bits, matches = identify_bursts(split_bursts(line))
    rotors = find_rotors(
        bits.start_tick, matches.polynomial, matches.index, matches.evidence_bits, line.rate_hz
    ).rotors
    shifted = replace(rotors[5], zero_tick=rotors[5].zero_tick + shift_s * line.rate_hz)
    result = reading(line, RotorSet({5: shifted}, ()))
    assert result.is_accepted.all() == result.is_accepted.any() == accepted
    if not accepted:
        assert result.rejected["burst_off_rotor"] == len(passed.time_s)


def test_a_standalone_match_is_never_replaced(light: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (line,), _ = light.of([light.Sender(5)], 1.0)
    weak_rows = []

    def record(
        bits: SoftBits, matches: SequenceMatches, is_weak: np.ndarray, rotor_set: RotorSet
    ) -> tuple[SequenceMatches, np.ndarray]:
        weak_rows.append(is_weak)
        return matches, np.zeros(len(bits), bool)

    monkeypatch.setattr(burst_validation, "_match_predicted", record)
    # A rotor of another channel agrees with none of the bursts.
    result = reading(line, RotorSet({12: uniform_rotor(12)}, ()))
    assert result.matches.is_certain().all()
    assert not weak_rows[0].any()
