"""Soft bits, against light drawn here, and both of their twins against each other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.lighthouse.demodulation.soft_bits import (
    MAX_BURST_S,
    MAX_SOFT_BIT,
    Bursts,
    SoftBits,
    _starts_at_second_chip,
    demodulate_bursts,
    demodulate_bursts_numpy,
    split_bursts,
    split_windows,
)
from locatk.core.lighthouse.recording import Edges

CAPTURE = "benchmarks/demodulation_code/logic_analyser_capture.sal"
RATES = (24e6, 32e6, 40e6, 100e6, 500e6)


def agree(bursts: Bursts) -> None:
    """Both twins say the same; values may differ by the last digit of a float."""
    mine, twin = demodulate_bursts(bursts), demodulate_bursts_numpy(bursts)
    assert np.array_equal(mine.first, twin.first)
    assert np.allclose(mine.start_tick, twin.start_tick, rtol=0, atol=1e-6)
    assert np.abs(mine.value.astype(int) - twin.value).max(initial=0) <= 1
    assert len(mine.value) == mine.first[-1]
    assert np.abs(mine.value).max(initial=0) <= MAX_SOFT_BIT


def read_back(light: Any, bits: np.ndarray, path: Any, start_s: float, seed: int = 0) -> int:
    """Errors among bits that were sent, but for two at each end."""
    noise = np.random.default_rng(seed + 1000)
    change = start_s + light.biphase(bits) / 6e6
    line = light.edges(light.as_received(change, path, noise), 1.0, path)
    soft = demodulate_bursts(split_bursts(line))
    assert len(soft) == 1
    begin = round((start_s * path.rate_hz - soft.start_tick[0]) / soft.ticks_per_bit)
    # The first pulse may be among the lost ones.
    got = np.pad(soft.value, 2)[begin + 2 : begin + 2 + len(bits)] > 0
    return int(np.count_nonzero(got[2:-2] != (bits[2:-2] > 0)))


@pytest.mark.parametrize("rate_hz", RATES)
def test_clean_light(light: Any, rate_hz: float) -> None:
    path = light.Receiving(rate_hz=rate_hz)
    for seed in range(40):
        noise = np.random.default_rng(seed)
        bits = noise.integers(0, 2, 120).astype(np.int8)
        assert read_back(light, bits, path, 1e-3 + noise.uniform(0, 1e-7)) == 0


@pytest.mark.parametrize(
    ("rate_hz", "delay_s"),
    # At the lower rates shorter pulses fall between the samples.
    [
        (rate, sign * delay)
        for rate in RATES
        for delay in (2e-8, 4e-8, 5.5e-8)
        for sign in (-1, 1)
        if rate >= 40e6 or delay <= 4e-8
    ],
)
def test_directions_of_different_delay(light: Any, rate_hz: float, delay_s: float) -> None:
    # Up to two thirds of a short pulse; by phase alone more than half a chip is ambiguous.
    path = light.Receiving(rate_hz=rate_hz, delay_s=delay_s)
    wrong = 0
    for seed in range(40):
        noise = np.random.default_rng(seed)
        bits = noise.integers(0, 2, 120).astype(np.int8)
        wrong += read_back(light, bits, path, 1e-3 + noise.uniform(0, 1e-7))
    assert wrong <= 0.02 * 40 * 120


def test_errors_by_noise_stay_few(light: Any) -> None:
    path = light.Receiving(jitter_s=1.2e-8, delay_s=2e-8, lost=0.03)
    wrong = 0
    for seed in range(60):
        bits = np.random.default_rng(seed).integers(0, 2, 150).astype(np.int8)
        wrong += read_back(light, bits, path, 2e-3, seed)
    assert wrong <= 0.05 * 60 * 150


def test_a_lost_pulse_is_no_lost_burst(light: Any) -> None:
    bits = np.tile(np.array([1, 0, 1, 1, 0, 0, 1, 0], np.int8), 16)
    change = light.biphase(bits) / 6e6 + 1e-4
    for at in (20, 51, 100):
        (change_left,) = [np.delete(change, [at, at + 1])]
        soft = demodulate_bursts(split_bursts(light.edges(change_left, 1e-3)))
        begin = round((1e-4 * 40e6 - soft.start_tick[0]) / soft.ticks_per_bit)
        off = np.flatnonzero((soft.value[begin : begin + 128] > 0) != (bits > 0))
        # Only what is near the loss is wrong; a decoder of runs would slip from there on.
        assert len(off) <= 2


def test_dates_of_bits(light: Any) -> None:
    noise = np.random.default_rng(5)
    off = []
    for _ in range(50):
        start = noise.uniform(1e-3, 2e-3)
        bits = noise.integers(0, 2, 100).astype(np.int8)
        soft = demodulate_bursts(split_bursts(light.edges(start + light.biphase(bits) / 6e6, 1.0)))
        late = (soft.start_tick[0] + 0.5 - start * 40e6) / soft.ticks_per_bit
        off.append(late - np.rint(late))
    # A sample of 25 ns is 0.15 bits; the phase averages over a hundred edges.
    assert np.abs(off).max() < 0.05


def test_odd_bursts(light: Any) -> None:
    none = demodulate_bursts(split_bursts(Edges(np.zeros(0, np.int64), 40e6, 40e6, True, 1)))
    assert len(none) == 0
    assert none.first.tolist() == [0]
    long = np.arange(0, 600e-6, 1.67e-7)
    edge = np.concatenate([[1e-3], [2e-3, 2.0001e-3], 3e-3 + long, 5e-3 + long[:200]])
    bursts = split_bursts(light.edges(edge, 0.01))
    soft = demodulate_bursts(bursts)
    size = np.diff(soft.first)
    assert size[0] == 0  # a single edge
    assert 0 < size[1] < 5
    assert size[2] == 0  # longer than any sweep
    assert bursts.duration_s[2] > MAX_BURST_S
    assert size[3] > 190
    agree(bursts)


@pytest.mark.parametrize("rate_hz", RATES)
def test_twins_on_drawn_light(light: Any, rate_hz: float) -> None:
    path = light.Receiving(
        rate_hz=rate_hz, delay_s=3e-8, jitter_s=1e-8, lost=0.1, rim_s=2e-6, spoiled=0.1
    )
    (line,), _ = light.of([light.Sender(2), light.Sender(13, zero_s=0.0)], 1.0, path)
    agree(split_bursts(line))


@pytest.mark.slow
@given(
    st.lists(
        st.sampled_from([0, 1, 2, 3, 4, 5, 6, 7, 20, 59, 61, 500, 20_100]), min_size=0, max_size=300
    ),
    st.sampled_from(RATES),
    st.booleans(),
)
@settings(max_examples=150, deadline=None)
def test_twins_on_any_edges(runs: list[int], rate_hz: float, rises: bool) -> None:
    # Equal ticks, single edges, whole and half chips: ties of all kinds.
    tick = np.cumsum(np.array(runs, np.int64))
    agree(split_bursts(Edges(tick, rate_hz, rate_hz, rises, 10**9)))


@pytest.mark.parametrize("width", [1, 2, 7, 8, 9, 64, 100])
def test_twins_on_windows(width: int) -> None:
    noise = np.random.default_rng(width)
    agree(split_windows(noise.integers(0, 256, (400, width)).astype(np.uint8)))
    agree(split_windows(np.repeat(noise.integers(0, 2, (50, width)) * 255, 1, 1).astype(np.uint8)))
    agree(split_windows(np.zeros((0, width), np.uint8)))


@pytest.mark.slow
@pytest.mark.parametrize("name", [CAPTURE, "fpga/take1.csv", "fpga/about_4m.csv"])
def test_twins_on_published_light(published: Callable[[str], Edges], name: str) -> None:
    agree(split_bursts(published(name)))


@pytest.mark.parametrize(("excess", "is_second"), [(0.0, False), (5e-4, False), (2e-3, True)])
def test_bits_start_at_the_second_chip_only_with_a_margin(excess: float, is_second: bool) -> None:
    mean = np.array([1.0 + excess, -1.0, 1.0])
    assert _starts_at_second_chip(mean, np.zeros(1, int), np.array([3])).tolist() == [is_second]


@pytest.mark.parametrize(("duration_s", "has_bits"), [(499e-6, True), (501e-6, False)])
def test_bursts_of_more_than_half_a_millisecond_have_no_bits(
    duration_s: float, has_bits: bool
) -> None:
    tick = np.arange(0, round(duration_s * 40e6) + 1, 20)
    bursts = split_bursts(Edges(tick, 40e6, 40e6, True, 10**6))
    for demodulate in (demodulate_bursts, demodulate_bursts_numpy):
        assert (len(demodulate(bursts).value) > 0) == has_bits


def test_some_bursts_of_soft_bits() -> None:
    bits = SoftBits(np.arange(6, dtype=np.int8), np.array([0, 1, 3, 6]), np.arange(3.0), 5.0)
    some = bits.take(np.array([0, 2]))
    assert some.value.tolist() == [0, 3, 4, 5]
    assert some.first.tolist() == [0, 1, 4]
    assert some.start_tick.tolist() == [0.0, 2.0]
