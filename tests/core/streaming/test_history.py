"""Order, limits and exactness of the history of a filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from locatk.core.streaming.history import CHI2_999, MAX_PENDING_FIXES, FilterHistory

MS = 1_000_000


class Recorder:
    """Model whose state is the motion so far and a number that tells the order of the fixes."""

    state_size = error_size = 2
    motion_size = fix_size = 1

    def unknown_state(self) -> tuple[Any, Any]:
        return np.zeros(2), np.zeros((2, 2))

    def part(self, motion: Any, fraction: float) -> Any:
        return motion * fraction

    def propagate(self, state: Any, covariance: Any, motion: Any, duration_s: float) -> Any:
        return state + [motion[0], 0.0], covariance + duration_s * np.eye(2)

    def update(self, state: Any, covariance: Any, fix: Any, interpolation_s2: float) -> Any:
        state = np.array([state[0], state[1] * 1.5 + fix[0] + state[0]])
        return state, covariance + interpolation_s2


def test_quantiles() -> None:
    np.testing.assert_allclose(CHI2_999[1:], chi2.ppf(0.999, np.arange(1, 7)), rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_order_of_arrival_gives_the_state_in_the_order_of_time(data: Any) -> None:
    """Fixes before, between, at and after motions of 10 ms; also if the arrays are moved."""
    times = data.draw(st.lists(st.integers(1, 200), max_size=8, unique=True))
    capacity = data.draw(st.sampled_from([30, 40, 500]))
    events = [(10 * MS * k, -1) for k in range(21)] + [(MS * at, at) for at in times]
    arrivals = []
    for at, fix in events:
        delay = data.draw(st.integers(-30, 30)) * MS if fix >= 0 else 0
        arrivals.append((max(at + delay, 1) if fix >= 0 else at, at, fix))

    def process(order: Any) -> FilterHistory:
        history = FilterHistory(Recorder(), capacity)
        for _, at, fix in order:
            if fix < 0:
                assert history.add_motion(at, np.array([0.5]))
            else:
                assert history.add_fix(at, np.array([float(fix)]))
        return history

    expected = process(sorted(arrivals, key=lambda each: (each[1], each[2])))
    found = process(sorted(arrivals, key=lambda each: (each[0], each[2])))
    np.testing.assert_allclose(found.state, expected.state, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-9)
    assert found.time_ns == 200 * MS
    np.testing.assert_allclose(found.state[0], 10.0)


def test_a_fix_between_samples_divides_the_motion() -> None:
    history = FilterHistory(Recorder(), 10)
    history.add_motion(0, np.zeros(1))
    history.add_motion(10 * MS, np.array([4.0]))
    history.add_fix(int(2.5 * MS), np.zeros(1))
    np.testing.assert_allclose(history.state, [4.0, 1.0])
    np.testing.assert_allclose(history.covariance[0, 1], 0.5 * 2.5e-3 * 7.5e-3)


def test_a_newer_fix_is_used_by_extrapolation() -> None:
    history = FilterHistory(Recorder(), 10)
    history.add_motion(0, np.zeros(1))
    history.add_motion(10 * MS, np.array([4.0]))
    history.add_fix(15 * MS, np.zeros(1))
    np.testing.assert_allclose(history.state, [6.0, 6.0])
    np.testing.assert_allclose(history.predict(20 * MS)[0], [8.0, 6.0])
    history.add_motion(20 * MS, np.array([2.0]))
    np.testing.assert_allclose(history.state, [6.0, 5.0])


def test_limits() -> None:
    history = FilterHistory(Recorder(), 20)
    assert not history.add_fix(0, np.zeros(1))
    for k in range(100):
        assert history.add_motion(k * MS, np.ones(1))
        assert len(history) == min(k + 1, 20)
    assert not history.add_motion(99 * MS, np.ones(1))
    assert not history.add_fix(79 * MS, np.zeros(1))
    assert history.add_fix(80 * MS, np.zeros(1))
    size = history.nbytes
    pending = FilterHistory(Recorder(), 500)
    pending.add_motion(0, np.zeros(1))
    accepted = sum(pending.add_fix(k * MS, np.zeros(1)) for k in range(1, 1000))
    assert accepted == MAX_PENDING_FIXES
    assert history.nbytes == size


@pytest.mark.parametrize("capacity", [5, 50])
def test_arrays_are_moved_without_loss(capacity: int) -> None:
    """As many rows as several times the arrays, with a fix after each motion and a late one."""
    history, whole = (FilterHistory(Recorder(), size) for size in (capacity, 1000))
    for each in (history, whole):
        for k in range(0, 300):
            each.add_motion(10 * k * MS, np.array([0.01]))
            each.add_fix((10 * k + 2) * MS, np.array([0.1]))
            if k > 2:
                each.add_fix((10 * k - 3) * MS, np.array([0.2]))
            # The state of this model would grow without bound.
            each._state[each._end - 1, 1] *= 1e-3
    np.testing.assert_array_equal(history.state, whole.state)
