"""Planes told apart and windows of time."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps, assign_planes, make_windows

PERIOD_NS = 959_000 / 48e6 * 1e9
COUNTS = 959_000 / 8


def rotation(turns: list[float], number: int) -> tuple[list[float], list[float]]:
    """Times (ns) and counts of sweeps in one rotation on channel 1."""
    return [(number + t) * PERIOD_NS for t in turns], [t * COUNTS for t in turns]


def told(*rotations: list[float]) -> list[list[int]]:
    times, counts = [], []
    for number, turns in enumerate(rotations):
        time, count = rotation(turns, number)
        times += time
        counts += count
    channel = np.ones(len(times), np.int32)
    found = assign_planes(np.rint(times).astype(np.int64), channel, np.array(counts)).tolist()
    return [[found.pop(0) for _ in turns] for turns in rotations]


def test_the_widest_gap_of_a_rotation_parts_the_planes() -> None:
    assert told([0.30, 0.31, 0.62, 0.64], [0.45, 0.46, 0.61]) == [[0, 0, 1, 1], [0, 0, 1]]


def test_a_plane_alone_is_told_by_its_place_or_not_at_all() -> None:
    assert told([0.2, 0.21], [0.8], [0.49, 0.5]) == [[0, 0], [1], [-1, -1]]


def test_stations_do_not_mix() -> None:
    time = np.array([0.30, 0.30, 0.62]) * PERIOD_NS
    channel = np.array([1, 2, 1], np.int32)
    count = np.array([0.30, 0.45, 0.62]) * COUNTS
    assert assign_planes(time.astype(np.int64), channel, count).tolist() == [0, -1, 1]


def sweeps_at(time_ns: list[int]) -> DeviceSweeps:
    time = np.sort(np.array(time_ns, np.int64))
    zero = np.zeros(len(time), np.int64)
    return DeviceSweeps(np.arange(len(time)), time, zero, zero, zero, zero.astype(float))


@given(
    st.lists(st.integers(-(2**60), 2**60), min_size=1, max_size=60),
    st.integers(1, 10**12),
    st.integers(1, 10**12),
)
def test_windows_hold_what_is_near(times: list[int], every_ns: int, reach_ns: int) -> None:
    mine = sweeps_at(times)
    around = make_windows(mine, every_ns, reach_ns)
    assert 1 <= len(around) <= len(times)
    assert np.all(np.diff(around.time_ns) > 0)
    for row in around.sweep:
        held = row[row >= 0]
        assert len(held) > 0
        assert np.all(np.diff(held) == 1)
        assert mine.time_ns[held[-1]] - mine.time_ns[held[0]] <= 2 * reach_ns


def test_very_many_sweeps_at_once_are_thinned() -> None:
    around = make_windows(sweeps_at(list(range(5000))), 10**9, 10**9)
    assert around.sweep.shape == (1, 500)
    assert np.all(np.diff(around.sweep[0]) == 10)


def test_no_sweeps_have_no_windows() -> None:
    assert len(make_windows(sweeps_at([]), 10, 10)) == 0
