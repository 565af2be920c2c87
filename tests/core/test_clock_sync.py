"""Ticks to host time, against a truth that the clock does not see."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.clock_sync import JUMP_S, SLEW_LIMIT, TickClock

EPOCH_NS = 1_760_000_000_000_000_000
Times = NDArray[np.int64]
Array = NDArray[np.float64]


def host_ns(seconds: Array) -> Times:
    return EPOCH_NS + np.rint(seconds * 1e9).astype(np.int64)


def usb(seconds: Array, seed: int = 0, least: float = 2e-4) -> Array:
    """Arrivals: up to a millisecond more than the least delay, and polled each millisecond."""
    delays = np.random.default_rng(seed).uniform(0, 1e-3, len(seconds))
    return np.maximum.accumulate(np.ceil((seconds + least + delays) * 1e3) * 1e-3)


def counter(device_s: Array, hz: float, bits: int = 64) -> Times:
    ticks = np.floor(device_s * hz).astype(np.int64)
    return ticks & ((1 << bits) - 1) if bits < 63 else ticks


def feed(clock: TickClock, ticks: Times, arrivals: Array, most: int = 1000) -> Times:
    """As it comes: one call a read, or as many calls as ``most`` asks for."""
    edges = np.flatnonzero(np.diff(arrivals) > 0) + 1
    out = []
    for one, at in zip(np.split(ticks, edges), np.split(host_ns(arrivals), edges), strict=True):
        for start in range(0, len(one), most):
            out.append(clock.times(one[start : start + most], at[start : start + most]))
    return np.concatenate(out)


def error_ms(times: Times, seconds: Array) -> Array:
    return (times - host_ns(seconds)) * 1e-6


def least_ms(arrivals: Array, seconds: Array) -> float:
    return float((arrivals - seconds).min()) * 1e3


def sampled(rate: float, start: float, stop: float, seed: int = 5) -> Array:
    n = int((stop - start) * rate)
    return start + (np.arange(n) + np.random.default_rng(seed).uniform(0, 0.2, n)) / rate


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_late_by_the_least_delay_after_ten_seconds_and_within_a_ppm_after_a_minute(
    seed: int,
) -> None:
    seconds = sampled(100, 0, 60, seed)
    arrivals = usb(seconds, seed)
    clock = TickClock(1e6)
    error = error_ms(feed(clock, counter(1.00005 * seconds + 77, 1e6), arrivals), seconds)
    late = error[seconds > 10] - least_ms(arrivals, seconds)
    assert np.abs(late).max() < 0.2
    assert clock.drift_ppm == pytest.approx(50, abs=1)
    assert clock.offset_ns == pytest.approx(EPOCH_NS - 77e9, abs=1e6)
    assert clock.tick_count == len(seconds)
    assert (clock.restarts, clock.outliers) == (0, 0)
    median, most = clock.jitter_ns or (0, 0)
    assert 0.5e6 < median < most < 2e6


@pytest.mark.slow
def test_bursts_and_a_clock_that_warms_up() -> None:
    seconds = sampled(100, 0, 80)
    device = seconds * (1 + 50e-6) + 5e-6 * 20 * (1 - np.exp(-seconds / 20))
    arrivals = usb(seconds)
    burst = (seconds % 0.5 < 0.03) & (np.floor(seconds * 2) % 3 != 0)
    arrivals = np.maximum.accumulate(np.where(burst, np.floor(seconds * 2) / 2 + 0.03, arrivals))
    clock = TickClock(24e6, 32)
    error = error_ms(feed(clock, counter(device, 24e6, 32), arrivals), seconds)
    late = error[seconds > 10] - least_ms(arrivals, seconds)
    assert np.abs(late).max() < 0.2
    assert clock.drift_ppm == pytest.approx(50, abs=1)


@pytest.mark.slow
@pytest.mark.parametrize("off", [-0.03, 0.03])
def test_a_resonator_that_is_off_is_learnt(off: float) -> None:
    seconds = sampled(100, 0, 60)
    arrivals = usb(seconds)
    clock = TickClock(1e6, 32)
    error = error_ms(feed(clock, counter((1 + off) * seconds, 1e6, 32), arrivals), seconds)
    late = error[seconds > 20] - least_ms(arrivals, seconds)
    assert np.abs(late).max() < 0.2
    assert clock.drift_ppm == pytest.approx(off * 1e6, abs=1.5)
    assert clock.restarts == 0


@pytest.mark.slow
@pytest.mark.parametrize("silence", [0.0, 0.4, 2.0, 30.0, 600.0])
def test_wraps_of_short_counters_are_counted_by_host_time(silence: float) -> None:
    seconds = np.concatenate([sampled(100, 0, 20), sampled(100, 20 + silence, 30 + silence)])
    arrivals = usb(seconds)
    clock = TickClock(24e6, 24)
    error = error_ms(feed(clock, counter(1.00005 * seconds, 24e6, 24), arrivals), seconds)
    # What is not known of the rate, a few ppm, counts until there are new arrivals.
    doubt = 0.2 + 3e-3 * silence
    assert np.abs(error[seconds > 10] - least_ms(arrivals, seconds)).max() < doubt
    assert clock.restarts == 0


@pytest.mark.slow
@pytest.mark.parametrize("bits", [32, 24])
def test_samples_that_arrive_late_together_are_no_restart(bits: int) -> None:
    seconds = sampled(100, 0, 20)
    stalled = (seconds > 12) & (seconds < 14)
    arrivals = np.maximum.accumulate(np.where(stalled, 14.0, usb(seconds)))
    clock = TickClock(24e6, bits)
    error = error_ms(feed(clock, counter(seconds, 24e6, bits), arrivals), seconds)
    assert np.abs(error[seconds > 10]).max() < 2
    assert clock.restarts == 0


def test_a_backlog_in_many_reads_is_late_and_not_new() -> None:
    seconds = sampled(100, 0, 20)
    stalled = (seconds > 12) & (seconds < 14)
    backlog = 14 + np.floor((seconds - 12) / 0.3) * 0.002
    arrivals = np.maximum.accumulate(np.where(stalled, backlog, usb(seconds)))
    clock = TickClock(1e6, 32)
    error = error_ms(feed(clock, counter(seconds, 1e6, 32), arrivals), seconds)
    assert np.abs(error[seconds > 10]).max() < 2
    assert clock.restarts == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hz", "bits", "boot"),
    [(1e6, 64, 0.33), (1e6, 32, 0.1), (24e6, 24, 0.1), (24e6, 24, 0.33), (24e6, 24, 0.5)],
)
def test_a_device_that_restarts_is_noticed(hz: float, bits: int, boot: float) -> None:
    seconds = np.concatenate([sampled(100, 0, 20), sampled(100, 22, 40)])
    device = np.where(seconds < 21, seconds + 3 * boot, seconds - 22 + boot)
    arrivals = usb(seconds)
    clock = TickClock(hz, bits)
    error = error_ms(feed(clock, counter(device, hz, bits), arrivals), seconds)
    assert clock.restarts == 1
    assert clock.outliers == 0
    assert np.abs(error[seconds > 34] - least_ms(arrivals, seconds)).max() < 0.2
    # A short counter that comes back late looks late, until that lasts for too long.
    soon = seconds > (22 if bits > 24 else 24.2)
    assert np.abs(error[soon]).max() < 3


@pytest.mark.slow
def test_a_clock_that_was_set_ahead_or_stood_still_is_noticed() -> None:
    for step in (-5.0, 3600.0):
        seconds = np.concatenate([sampled(100, 0, 20), sampled(100, 30, 50)])
        device = seconds + np.where(seconds < 25, 10, 10 + step)
        clock = TickClock(1e6)
        error = error_ms(feed(clock, counter(device, 1e6), usb(seconds)), seconds)
        assert clock.restarts == 1
        assert np.abs(error[seconds > 32.1]).max() < 3


def test_wrong_ticks_are_left_aside() -> None:
    seconds = sampled(100, 0, 20)
    ticks, arrivals = counter(seconds, 1e6), usb(seconds)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(seconds)) < 0.05
    wrong[-1] = False
    ticks[wrong] = rng.integers(-(2**62), 2**62, np.count_nonzero(wrong))
    clock = TickClock(1e6)
    times = feed(clock, ticks, arrivals)
    assert np.abs(error_ms(times, seconds)[~wrong & (seconds > 5)]).max() < 1.5
    # The first ticks are believed, whatever they are: two starts at most.
    assert clock.restarts == 0
    assert clock.outliers == np.count_nonzero(wrong)
    np.testing.assert_array_equal(times[wrong], host_ns(arrivals[wrong]))


def test_many_wrong_ticks_in_one_call() -> None:
    ticks = np.arange(4001) + 5
    ticks[1::2] = np.random.default_rng(0).integers(10**9, 10**15, 2000)
    clock = TickClock(1e6)
    times = clock.times(ticks, np.full(4001, EPOCH_NS))
    assert clock.outliers == 2000
    steps = np.diff(times[::2])
    assert np.all((steps >= (1 - SLEW_LIMIT) * 2000) & (steps <= 2000))


@pytest.mark.slow
@pytest.mark.parametrize("bits", [64, 32])
def test_a_first_tick_that_is_wrong_does_not_last(bits: int) -> None:
    seconds = sampled(100, 0, 20)
    ticks = counter(seconds, 1e6, bits)
    ticks[0] = 3_000_000_000
    clock = TickClock(1e6, bits)
    error = error_ms(feed(clock, ticks, usb(seconds)), seconds)
    assert np.abs(error[4:]).max() < 3
    assert clock.restarts == 1


def test_streams_that_share_the_clock_agree() -> None:
    """Of two streams one is 30 ms late; ticks that are equal have equal times."""
    seconds = np.repeat(np.arange(0, 20, 0.01), 2)
    late = np.tile([0.0, 0.03], len(seconds) // 2)
    order = np.argsort(seconds + late, kind="stable")
    seconds = seconds[order]
    arrivals = usb(np.sort(seconds + late[order]))
    ticks = counter(1.0001 * seconds, 1e6, 32)
    clock = TickClock(1e6, 32)
    times = feed(clock, ticks, arrivals)
    one, other = times[np.argsort(ticks, kind="stable")].reshape(-1, 2).T
    assert np.abs(one - other)[20:].max() <= 1
    assert np.all(np.diff(one) > 0)
    assert clock.restarts == 0


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate=st.sampled_from([3.0, 50.0, 1000.0]),
    off=st.floats(-0.05, 0.05),
    lateness=st.floats(0, 0.5),
    most=st.integers(1, 100),
)
def test_times_ascend_with_the_ticks(
    seed: int, rate: float, off: float, lateness: float, most: int
) -> None:
    """Whatever the delays, times never step back, and are slewed at the stated limit."""
    rng = np.random.default_rng(seed)
    seconds = sampled(rate, 0, min(1000 / rate, 60), seed)
    delays = rng.exponential(0.001 + lateness * rng.random(len(seconds)))
    arrivals = np.maximum.accumulate(seconds + np.minimum(delays, 0.9 * JUMP_S))
    ticks = counter((1 + off) * seconds, 1e6)
    clock = TickClock(1e6)
    times = feed(clock, ticks, arrivals, most)
    assert clock.restarts == 0
    passed = np.diff(ticks) * 1e3
    assert np.all(np.diff(times) >= (1 - SLEW_LIMIT) * 0.9 * passed - 2)
    assert np.all(np.diff(times) <= (1 + SLEW_LIMIT) * 1.15 * passed + 2)


def test_a_recording_in_one_call_is_as_good() -> None:
    seconds = sampled(100, 0, 100)
    arrivals = usb(seconds)
    ticks = counter(1.004 * seconds, 1e6, 32)
    clock = TickClock(1e6, 32)
    error = error_ms(clock.times(ticks, host_ns(arrivals)), seconds)
    assert np.abs(error[seconds > 10] - least_ms(arrivals, seconds)).max() < 0.3
    assert np.abs(error).max() < 12


@pytest.mark.slow
def test_memory_is_bounded() -> None:
    clock = TickClock(1000, 16)
    for minute in range(5):
        ticks = np.arange(minute * 120, (minute + 1) * 120, dtype=np.int64) * 500
        clock.times(ticks & 0xFFFF, EPOCH_NS + ticks * 1_000_000)
    era = clock._era
    assert era is not None
    assert len(era.earliest) < 300
    assert len(era.knots) < 300
    assert clock.drift_ppm == pytest.approx(0, abs=1e-3)


def test_before_and_after() -> None:
    clock = TickClock(1e6)
    assert clock.offset_ns is clock.drift_ppm is clock.jitter_ns is None
    assert not len(clock.times(np.zeros(0, np.int64), np.zeros(0, np.int64)))
    at = np.array([EPOCH_NS])
    assert clock.times(np.array([5_000_000]), at)[0] == EPOCH_NS
    assert clock.offset_ns == EPOCH_NS - 5_000_000_000
    clock.restart()
    assert clock.times(np.array([7]), at + 10**9)[0] == EPOCH_NS + 10**9
    assert clock.restarts == 0


@pytest.mark.parametrize(("hz", "bits"), [(0, 32), (-1, 32), (float("nan"), 32), (1e6, 0)])
def test_no_counter(hz: float, bits: int) -> None:
    with pytest.raises(ValueError, match="impossible"):
        TickClock(hz, bits)


@pytest.mark.slow
@settings(deadline=None, max_examples=10)
@given(
    st.integers(0, 10_000),
    st.sampled_from([(1e6, 64), (24e6, 24), (48e6, 32)]),
    st.floats(-100, 100),
    st.lists(
        st.tuples(st.integers(0, 999), st.sampled_from(["late", "wrong", "restart"])), max_size=3
    ),
)
def test_single_ticks_are_mapped_as_in_arrays(
    seed: int, counter_of: tuple[float, int], ppm: float, faults: list[tuple[int, str]]
) -> None:
    hz, bits = counter_of
    seconds = sampled(100.0, 0.0, 10.0, seed)
    ticks = counter(seconds * (1 + ppm * 1e-6) + 5.0, hz, bits)
    arrivals = usb(seconds, seed)
    for index, fault in faults:
        if fault == "late":
            arrivals[index:] = np.maximum(arrivals[index:], arrivals[index] + 0.3)
        elif fault == "wrong":
            ticks[index] ^= 1 << 22
        else:
            ticks[index:] = counter(seconds[index:] - seconds[index] + 0.01, hz, bits)
    single, general = TickClock(hz, bits), TickClock(hz, bits)
    general._map_single = lambda tick, arrival_ns: None  # type: ignore[method-assign]
    arrival_ns = host_ns(arrivals)
    for k in range(len(ticks)):
        part = slice(k, k + 1)
        assert single.times(ticks[part], arrival_ns[part]) == general.times(
            ticks[part], arrival_ns[part]
        )
    for name in ("offset_ns", "drift_ppm", "jitter_ns", "restarts", "outliers", "tick_count"):
        assert getattr(single, name) == getattr(general, name)


@pytest.mark.slow
def test_most_single_ticks_take_the_fast_path(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = sampled(200.0, 0.0, 20.0)
    ticks, arrival_ns = counter(seconds, 1e6), host_ns(usb(seconds))
    clock, calls = TickClock(1e6), []
    general = clock._map_consistent
    monkeypatch.setattr(clock, "_map_consistent", lambda *a: calls.append(1) or general(*a))
    for k in range(len(ticks)):
        clock.times(ticks[k : k + 1], arrival_ns[k : k + 1])
    assert len(calls) < len(ticks) / 10
