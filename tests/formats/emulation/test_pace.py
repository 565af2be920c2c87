"""When which bytes are due."""

from __future__ import annotations

import math
from itertools import islice

import pytest

from locatk.formats.emulation.byte_stream import (
    MAX_PIECE_BYTES,
    SINGLE_TIME_DURATION_NS,
    ConstantRate,
    RecordedPace,
    repeat_packets,
)

MS = 1_000_000
PACKETS = [(5 * MS, b"a"), (5 * MS, b"b"), (10 * MS, b"cc"), (30 * MS, b"d")]


def test_times_start_at_zero_and_bytes_of_one_time_come_together() -> None:
    pace = RecordedPace(repeat_packets(lambda: PACKETS))
    assert pace.next_s == 0
    assert pace.due(0) == b"ab"
    assert pace.next_s == pytest.approx(0.005)
    assert pace.due(0.0049) == b""
    assert pace.due(0.006) == b"cc"
    assert pace.next_s == pytest.approx(0.025)
    assert pace.due(1) == b"d"
    assert pace.next_s is None
    assert pace.due(2) == b""


def test_speed() -> None:
    pace = RecordedPace(repeat_packets(lambda: PACKETS), 10)
    pace.due(0)
    assert pace.next_s == pytest.approx(0.0005)
    assert RecordedPace(repeat_packets(lambda: PACKETS), math.inf).due(0) == b"abccd"


def test_times_run_on_from_turn_to_turn() -> None:
    """25 ms between the first and the last of four: 8.3 ms a step."""
    times = [time_ns for time_ns, _ in repeat_packets(lambda: PACKETS, 2)]
    step = 25 * MS // 3
    assert times[:4] == [0, 0, 5 * MS, 25 * MS]
    assert times[4:] == [25 * MS + step + time_ns for time_ns in times[:4]]


def test_for_ever() -> None:
    endless = repeat_packets(lambda: PACKETS, 0)
    assert b"".join(data for _, data in islice(endless, 4000)) == b"abccd" * 1000


def test_one_moment_for_ever_takes_its_time() -> None:
    times = [time_ns for time_ns, _ in islice(repeat_packets(lambda: [(7, b"x"), (7, b"y")], 0), 6)]
    assert times == [
        0,
        0,
        SINGLE_TIME_DURATION_NS,
        SINGLE_TIME_DURATION_NS,
        2 * SINGLE_TIME_DURATION_NS,
        2 * SINGLE_TIME_DURATION_NS,
    ]


def test_nothing_to_send_is_at_its_end() -> None:
    assert list(repeat_packets(lambda: [(0, b"")], 0)) == []
    assert RecordedPace([]).next_s is None
    assert ConstantRate([], 100).next_s is None


def test_times_never_fall_back() -> None:
    packets = [(10, b"a"), (30, b"b"), (20, b"c"), (40, b"d")]
    assert list(repeat_packets(lambda: packets)) == [(0, b"a"), (20, b"b"), (20, b"c"), (30, b"d")]


def test_very_much_at_once_comes_in_pieces() -> None:
    pace = RecordedPace([(0, bytes(MAX_PIECE_BYTES - 1))] * 4)
    sizes = []
    while pace.next_s is not None:
        sizes.append(len(pace.due(1)))
    assert sizes == [2 * (MAX_PIECE_BYTES - 1)] * 2


def test_a_constant_rate_is_kept_to_the_byte() -> None:
    data = bytes(range(250))
    pace = ConstantRate([(MS * k, data[k : k + 7]) for k in range(0, 250, 7)], 100)
    assert pace.next_s == pytest.approx(0.01)
    assert pace.due(0.0099) == b""
    given = b""
    for k in range(1, 40):
        given += pace.due(0.05 * k)
        assert given == data[: 5 * k]
    assert given + pace.due(9) == data
    assert pace.next_s is None


def test_a_constant_rate_makes_progress_at_the_very_time_it_told() -> None:
    pace = ConstantRate([(0, bytes(1000))], 3e6 / 7)
    for _ in range(1000):
        assert pace.next_s is not None
        assert pace.due(pace.next_s) == b"\0"
    assert pace.next_s is None
