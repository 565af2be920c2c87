"""Sweeps of a rigid device: plane assignment and windows of time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.lighthouse.devices.device_sweeps import (
    DeviceSweeps,
    has_enough_sweeps,
    make_windows,
    select_device_sweeps,
)
from locatk.core.lighthouse.plane_labels import assign_planes
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps

PERIOD_NS = 959_000 / 48e6 * 1e9
COUNTS = 959_000 / 8


def rotation(turns: list[float], number: int) -> tuple[list[float], list[float]]:
    """Return times (ns) and counts of sweeps in one rotation on channel 1."""
    return [(number + t) * PERIOD_NS for t in turns], [t * COUNTS for t in turns]


def planes_of(*rotations: list[float]) -> list[list[int]]:
    times, counts = [], []
    for number, turns in enumerate(rotations):
        time, count = rotation(turns, number)
        times += time
        counts += count
    channel = np.ones(len(times), np.int32)
    planes = assign_planes(np.rint(times).astype(np.int64), channel, np.array(counts)).tolist()
    return [[planes.pop(0) for _ in turns] for turns in rotations]


def test_the_widest_gap_of_a_rotation_separates_the_planes() -> None:
    assert planes_of([0.30, 0.31, 0.62, 0.64], [0.32, 0.33, 0.65]) == [[0, 0, 1, 1], [0, 0, 1]]


def test_the_rotor_angle_decides_on_a_lone_plane_unless_it_is_in_the_middle() -> None:
    assert planes_of([0.2, 0.21], [0.8], [0.49, 0.5]) == [[0, 0], [1], [-1, -1]]


def test_rotations_of_different_stations_are_separate() -> None:
    time = np.array([0.30, 0.30, 0.62]) * PERIOD_NS
    channel = np.array([1, 2, 1], np.int32)
    count = np.array([0.30, 0.45, 0.62]) * COUNTS
    assert assign_planes(time.astype(np.int64), channel, count).tolist() == [0, -1, 1]


def sweeps_at(time_ns: list[int]) -> DeviceSweeps:
    time = np.sort(np.array(time_ns, np.int64))
    zero = np.zeros(len(time), np.int64)
    return DeviceSweeps(time, zero, zero, zero, zero.astype(float))


@given(
    st.lists(st.integers(-(2**60), 2**60), min_size=1, max_size=60),
    st.integers(1, 10**12),
    st.integers(1, 10**12),
)
def test_windows_contain_consecutive_sweeps_in_range(
    times: list[int], interval_ns: int, half_width_ns: int
) -> None:
    sweeps = sweeps_at(times)
    windows = make_windows(sweeps, interval_ns, half_width_ns)
    assert 1 <= len(windows) <= len(times)
    assert np.all(np.diff(windows.time_ns) > 0)
    for sweep in windows.sweep:
        rows = sweep[sweep >= 0]
        assert len(rows) > 0
        assert np.all(np.diff(rows) == 1)
        assert sweeps.time_ns[rows[-1]] - sweeps.time_ns[rows[0]] <= 2 * half_width_ns


def test_a_window_with_very_many_sweeps_is_thinned() -> None:
    windows = make_windows(sweeps_at(list(range(5000))), 10**9, 10**9)
    assert windows.sweep.shape == (1, 500)
    assert np.all(np.diff(windows.sweep[0]) == 10)


def test_without_sweeps_there_are_no_windows() -> None:
    assert len(make_windows(sweeps_at([]), 10, 10)) == 0


@pytest.mark.parametrize(
    ("sensors", "is_enough"),
    [
        ([0, 0, 0, 1, 1, 1, 2, 2], True),
        ([0, 0, 0, 1, 1, 1, 2], False),
        ([0, 0, 0, 0, 1, 1, 1, 1], False),
        ([0, 1, 2, 3, 4, 5, 6], False),
    ],
)
def test_a_pose_needs_eight_sweeps_of_three_photodiodes(
    sensors: list[int], is_enough: bool
) -> None:
    sweeps = sweeps_at(list(range(len(sensors))))
    sweeps = DeviceSweeps(
        sweeps.time_ns, np.array(sensors), sweeps.station, sweeps.plane, sweeps.angle
    )
    padded = np.r_[np.arange(len(sensors)), [-1, -1, -1]]
    assert has_enough_sweeps(sweeps, padded[None]).tolist() == [is_enough]


def test_unusable_sweeps_are_rejected_with_reasons() -> None:
    receiver = Receiver(np.array([[0.0, 0, 0], [np.nan, 0, 0], [0.01, 0, 0]]))
    rows = [  # sensor, channel, plane, count
        (0, 1, 0, 40_000.0),
        (2, 2, 1, 80_000.0),
        (0, 17, 0, 40_000.0),
        (1, 1, 0, 40_000.0),
        (3, 1, 0, 40_000.0),
        (-1, 1, 0, 40_000.0),
        (0, 3, 0, 40_000.0),
        (0, 1, 0, -1.0),
        (0, 1, 0, COUNTS),
        (0, 1, 0, np.nan),
        (0, 1, 2, 40_000.0),
    ]
    sensor, channel, plane, count = np.array(rows).T
    n = len(rows)
    sweeps = Sweeps(
        ("device",),
        np.arange(n)[::-1] * 10**9,
        np.zeros(n, np.int32),
        sensor.astype(np.int32),
        channel.astype(np.int32),
        np.full(n, -1, np.int32),
        plane.astype(np.int32),
        count,
    )
    selected, rejected = select_device_sweeps(sweeps, 0, receiver, [1, 2])
    assert rejected == {
        "unknown_channel": 1,
        "sensor_unknown": 3,
        "station_not_in_scene": 1,
        "count_above_period": 3,
        "plane_unknown": 1,
    }
    # In ascending time, which is the reverse of the table.
    assert selected.station.tolist() == [1, 0]
    assert selected.sensor.tolist() == [2, 0]
    assert selected.plane.tolist() == [1, 0]
