"""Bursts of edges and of sampled bits, and the flashes of motion capture among them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from locatk.core.errors import InputError
from locatk.core.lighthouse.demodulation.soft_bits import (
    BURST_GAP_S,
    Bursts,
    is_mocap_flash,
    split_bursts,
    split_windows,
    window_edges_numpy,
)
from locatk.core.lighthouse.recording import Edges

CAPTURE = "benchmarks/demodulation_code/logic_analyser_capture.sal"


def edges(*ticks: int, rate_hz: float = 40e6, rises: bool = True) -> Edges:
    return Edges(np.array(ticks, np.int64), rate_hz, rate_hz, rises, 10**9)


def test_a_silence_divides() -> None:
    gap = round(BURST_GAP_S * 40e6)
    bursts = split_bursts(edges(5, 9, 9 + gap, 10 + 2 * gap, 20 + 2 * gap))
    assert bursts.first.tolist() == [0, 3, 5]
    # Three edges before it: the second burst begins downwards.
    assert bursts.rises.tolist() == [True, False]
    assert bursts.start_tick.tolist() == [5, 10 + 2 * gap]
    assert bursts.duration_s.tolist() == [(4 + gap) / 40e6, 10 / 40e6]
    assert split_bursts(edges(1, 2, rises=False)).rises.tolist() == [False]


def test_some_bursts_of_all() -> None:
    bursts = split_bursts(edges(0, 5, 1000, 1007, 1009, 2000, 2002))
    some = bursts.take(np.array([True, False, True]))
    assert some.tick.tolist() == [0, 5, 2000, 2002]
    assert some.first.tolist() == [0, 2, 4]
    assert some.rises.tolist() == [True, False]
    assert len(bursts.take(np.zeros(3, bool))) == 0


def test_little_or_nothing() -> None:
    assert len(split_bursts(edges())) == 0
    assert not len(is_mocap_flash(split_bursts(edges())))
    one = split_bursts(edges(7))
    assert len(one) == 1
    assert one.duration_s.tolist() == [0.0]
    assert is_mocap_flash(one).tolist() == [False]


@pytest.mark.parametrize("rate_hz", [1e6, 20e6, 23.9e6])
def test_a_coarse_recording_is_refused(rate_hz: float) -> None:
    with pytest.raises(InputError, match="too few"):
        split_bursts(edges(1, 2, rate_hz=rate_hz))
    with pytest.raises(InputError, match="too few"):
        split_windows(np.zeros((1, 64), np.uint8), rate_hz)
    # What counts is what the times resolve.
    with pytest.raises(InputError, match="too few"):
        split_bursts(Edges(np.arange(9), 1e9, rate_hz, True, 10))


@pytest.mark.parametrize("rate_hz", [24e6, 23.999e6, 500e6])
def test_a_fine_one_is_not(rate_hz: float) -> None:
    assert len(split_bursts(edges(1, 2, rate_hz=rate_hz))) == 1


def test_edges_that_go_back_are_refused() -> None:
    with pytest.raises(InputError, match="back in time"):
        split_bursts(edges(5, 9, 8))
    assert len(split_bursts(edges(5, 9, 9, 12))) == 1


@given(
    arrays(
        np.uint8,
        st.tuples(st.integers(0, 6), st.integers(0, 21)),
        elements=st.sampled_from([0, 0xFF, 0x80, 1, 0xA5, 0x7F]),
    )
)
def test_edges_of_windows(windows: np.ndarray) -> None:
    bursts = split_windows(windows)
    assert len(bursts) == len(windows)
    width = 8 * windows.shape[1]
    for k, row in enumerate(np.unpackbits(windows, axis=1)):
        ticks = [k * width + j for j in range(1, width) if row[j] != row[j - 1]]
        assert bursts.tick[bursts.first[k] : bursts.first[k + 1]].tolist() == ticks
        assert bursts.rises[k] == (len(ticks) > 0 and row[0] == 0)
    if width == 0:
        return
    for mine, twin in zip(
        (bursts.tick, bursts.first, bursts.rises), window_edges_numpy(windows), strict=True
    ):
        assert np.array_equal(mine, twin)


@pytest.mark.parametrize("windows", [np.zeros(64, np.uint8), np.zeros((2, 64))])
def test_windows_of_another_kind(windows: Any) -> None:
    with pytest.raises(InputError, match="rows of bytes"):
        split_windows(windows)


@pytest.mark.parametrize("rate_hz", [24e6, 40e6, 100e6])
@pytest.mark.parametrize("jitter_s", [0.0, 1.5e-8])
@pytest.mark.parametrize("duty", [0.2, 0.5, 0.7])
def test_flashes_of_motion_capture(
    light: Any, rate_hz: float, jitter_s: float, duty: float
) -> None:
    noise = np.random.default_rng(1)
    flashes = []
    for start, length in ((0.001, 20), (0.002, 100), (0.004, 1000)):
        rise = start + np.arange(length) * 1e-6
        flashes += [rise, rise + duty * 1e-6]
    edge = np.sort(np.concatenate(flashes))
    edge += noise.normal(0, jitter_s, len(edge)) if jitter_s else 0
    bursts = split_bursts(light.edges(edge, 0.01, light.Receiving(rate_hz=rate_hz)))
    assert len(bursts) == 3
    assert is_mocap_flash(bursts).all()


@pytest.mark.parametrize("rate_hz", [24e6, 40e6])
def test_sweeps_are_no_flashes(light: Any, rate_hz: float) -> None:
    path = light.Receiving(
        rate_hz=rate_hz, jitter_s=1e-8, delay_s=3e-8, rim_s=3e-6, lost=0.2, width_s=1.2e-5
    )
    (line,), _ = light.of([light.Sender(channel) for channel in (1, 8, 16)], 2.0, path)
    assert not is_mocap_flash(split_bursts(line)).any()


@pytest.mark.slow
def test_no_published_sweep_is_a_flash(published: Callable[[str], Edges]) -> None:
    for name in (CAPTURE, "fpga/take1.csv", "fpga/about_4m.csv"):
        assert not is_mocap_flash(split_bursts(published(name))).any()


def regular(periods: int, irregular: int = 0, steps: tuple[int, int] = (50, 50)) -> Bursts:
    """A burst at 100 MHz of ``periods`` periods, the last ``irregular`` of which are short."""
    step = np.resize(steps, periods + 1)
    step[len(step) - irregular :] = 20
    tick = np.concatenate([[1000], 1000 + np.cumsum(step)])
    return Bursts(tick, np.array([0, len(tick)]), np.array([True]), 100e6)


def test_a_flash_has_eight_periods_of_which_four_fifths_are_1_us() -> None:
    assert is_mocap_flash(regular(8)).tolist() == [True]
    assert is_mocap_flash(regular(7)).tolist() == [False]
    assert is_mocap_flash(regular(20, irregular=4)).tolist() == [True]
    assert is_mocap_flash(regular(20, irregular=5)).tolist() == [False]


def test_periods_of_a_flash_deviate_by_six_per_cent_at_most() -> None:
    for steps, is_flash in (
        ((52, 53), True),
        ((53, 54), False),
        ((47, 48), True),
        ((46, 47), False),
    ):
        assert is_mocap_flash(regular(20, steps=steps)).tolist() == [is_flash]


@pytest.mark.parametrize(("silence_s", "number"), [(1.45e-6, 1), (1.55e-6, 2)])
def test_a_silence_of_nine_bits_ends_a_burst(silence_s: float, number: int) -> None:
    assert len(split_bursts(edges(0, 10, 10 + round(silence_s * 40e6), 80 + 10))) == number
