"""The host's clock of a recording: set once, never back."""

from __future__ import annotations

import time

import pytest

from locatk.formats.capture.clocks import HostClock, steady_ns


class Clocks:
    """A steady clock and one that people set."""

    def __init__(self) -> None:
        self.steady = 5_000
        self.wall = 1_700_000_000_000_000_000

    def pass_ns(self, ns: int) -> None:
        self.steady += ns
        self.wall += ns


def test_it_starts_as_the_wall_clock_and_runs_as_the_steady_one() -> None:
    clocks = Clocks()
    clock = HostClock(lambda: clocks.steady, lambda: clocks.wall)
    assert clock.now() == 1_700_000_000_000_000_000
    clocks.pass_ns(7)
    assert clock.now() == 1_700_000_000_000_000_007
    assert clock.stepped_ns() == 0


@pytest.mark.parametrize("step_ns", [-3_600_000_000_000, -1, 1, 86_400_000_000_000])
def test_a_wall_clock_that_is_set_does_not_move_it(step_ns: int) -> None:
    clocks = Clocks()
    clock = HostClock(lambda: clocks.steady, lambda: clocks.wall)
    clocks.pass_ns(10)
    before = clock.now()
    clocks.wall += step_ns
    assert clock.now() == before
    clocks.pass_ns(1)
    assert clock.now() == before + 1
    assert clock.stepped_ns() == step_ns


def test_the_real_one_is_near_the_wall_clock_and_never_descends() -> None:
    clock = HostClock()
    earliest = time.time_ns()
    times = [clock.now() for _ in range(1000)]
    assert times == sorted(times)
    # Both clocks run on; the bound is of a machine that was stopped meanwhile.
    assert abs(times[0] - earliest) < 60_000_000_000


def test_without_a_clock_that_runs_through_sleep_there_is_the_monotonic_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(time, "CLOCK_BOOTTIME", raising=False)
    before = time.monotonic_ns()
    assert before <= steady_ns() <= time.monotonic_ns()


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="the system has no such clock")
def test_the_clock_runs_during_sleep() -> None:
    before = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    assert before <= steady_ns() <= time.clock_gettime_ns(time.CLOCK_BOOTTIME)
