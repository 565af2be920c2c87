"""The line between two clocks, of late readings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.clock_line import fit_clock_line, unwrap_counter


def readings(
    rate: float, seconds: float, seed: int = 0, n: int = 5000
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    reference = 1000.0 + np.sort(rng.uniform(0, seconds, n))
    return reference, 7.0 + rate * reference + 4e-4 + rng.exponential(1e-3, n)


@pytest.mark.parametrize("rate", [84 / 85, 0.98906, 1.0, 1.00003])
def test_rate_and_offset_are_those_of_the_fastest_readings(rate: float) -> None:
    reference, late = readings(rate, 60.0)
    line = fit_clock_line(reference, late)
    assert line is not None
    assert line.is_estimated
    assert line.rate == pytest.approx(rate, abs=1e-7)
    times = np.array([1000.0, 1030.0, 1060.0])
    np.testing.assert_allclose(line.to_reference(7.0004 + rate * times), times, atol=5e-6)


def test_wrong_readings_do_not_matter() -> None:
    reference, late = readings(84 / 85, 60.0)
    late[::100] += 3.0
    late[50::500] -= 0.5
    line = fit_clock_line(reference, late)
    assert line is not None
    assert line.rate == pytest.approx(84 / 85, abs=1e-6)


def test_whole_milliseconds_shift_nothing() -> None:
    reference, late = readings(1.0, 60.0)
    line = fit_clock_line(reference, (np.floor(1e3 * late) + 0.5) / 1e3, resolution_s=1e-3)
    assert line is not None
    assert line.offset_s + (line.rate - 1) * 1030 == pytest.approx(7.0004, abs=5e-5)


def test_a_short_recording_has_no_rate() -> None:
    line = fit_clock_line(*readings(84 / 85, 1.0, n=200))
    assert line is not None
    assert (line.rate, line.is_estimated) == (1.0, False)


def test_readings_without_a_line_have_none() -> None:
    rng = np.random.default_rng(1)
    assert fit_clock_line(np.arange(5.0), np.arange(5.0)) is None
    assert fit_clock_line(np.arange(100.0), rng.uniform(0, 100, 100)) is None
    assert fit_clock_line(np.arange(100.0), 1.1 * np.arange(100.0)) is None


@given(
    bits=st.sampled_from([24, 32]),
    rate=st.sampled_from([84 / 85, 1.0]),
    gaps=st.lists(st.floats(0.0, 20.0), min_size=1, max_size=30),
    start=st.integers(0, 2**40),
)
def test_a_counter_continues_over_its_wraps(
    bits: int, rate: float, gaps: list[float], start: int
) -> None:
    ticks = start + np.rint(np.cumsum(gaps) * 24e6).astype(np.int64)
    clock = rate * ticks / 24e6
    unwrapped = unwrap_counter(ticks % (1 << bits), clock, 24e6, bits)
    np.testing.assert_array_equal(np.diff(unwrapped), np.diff(ticks))
    assert unwrapped[0] == ticks[0] % (1 << bits)
