"""When which byte arrived, held against a walk through all reads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.formats.capture import clocks
from locatk.formats.capture.clocks import ArrivalTimes

KEPT_READS = 1 << 10
"""Instead of MIN_KEPT_READS, so that the test is fast."""

reads = st.lists(
    st.tuples(st.integers(1, 50), st.integers(0, 10_000)), min_size=1, max_size=30
).map(lambda pairs: np.cumsum(np.array(pairs, np.int64), axis=0) + [0, 1_000_000])
"""(ends, times) of reads, times not always later."""


def filled(table: np.ndarray, byte_ns: float = 0.0) -> ArrivalTimes:
    arrivals = ArrivalTimes(byte_ns)
    for end, time_ns in table.tolist():
        arrivals.add(end, time_ns)
    return arrivals


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(table=reads, byte_ns=st.floats(0, 500))
def test_every_byte_has_the_time_of_its_read(table: np.ndarray, byte_ns: float) -> None:
    arrivals = filled(table, byte_ns)
    ends = np.arange(1, table[-1, 0] + 1)
    read, wire = arrivals.read_ns(ends), arrivals.wire_ns(ends)
    for end, read_ns, wire_ns in zip(ends.tolist(), read.tolist(), wire.tolist(), strict=True):
        number = next(k for k, (last, _) in enumerate(table.tolist()) if last >= end)
        last, time_ns = table[number]
        assert read_ns == time_ns
        early = time_ns - int(byte_ns * (last - end))
        if number:
            early = max(early, table[number - 1, 1])
        assert wire_ns == early
    assert (np.diff(read) >= 0).all()
    assert (wire <= read).all()


def test_frames_of_one_read_are_dated_by_the_baud_rate() -> None:
    arrivals = filled(np.array([(10, 1_000_000), (30, 3_000_000)]), byte_ns=86_805.0)
    ends = np.array([10, 20, 30])
    assert arrivals.read_ns(ends).tolist() == [1_000_000, 3_000_000, 3_000_000]
    assert arrivals.wire_ns(ends).tolist() == [1_000_000, 3_000_000 - 868_050, 3_000_000]


def test_nothing_is_dated_before_the_read_before_it() -> None:
    arrivals = filled(np.array([(10, 1_000_000), (1000, 1_500_000)]), byte_ns=86_805.0)
    assert arrivals.wire_ns(np.array([11, 999])).tolist() == [1_000_000, 1_413_195]


def test_bytes_after_the_last_read_get_its_time() -> None:
    assert filled(np.array([(10, 7), (20, 9)])).read_ns(np.array([21])).tolist() == [9]


@pytest.mark.parametrize(
    "n", [2 * KEPT_READS, 2 * KEPT_READS + 1, 3 * KEPT_READS + 17, 4 * KEPT_READS + 1]
)
def test_a_long_recording_takes_no_more_memory_and_forgets_only_old_reads(
    monkeypatch: pytest.MonkeyPatch, n: int
) -> None:
    monkeypatch.setattr(clocks, "MIN_KEPT_READS", KEPT_READS)
    arrivals = ArrivalTimes()
    room = sum(each.nbytes for each in vars(arrivals).values() if isinstance(each, np.ndarray))
    for k in range(n):
        arrivals.add(3 * (k + 1), 1_000 * (k + 1))
    ends = np.arange(3 * (n - KEPT_READS) + 1, 3 * n + 1)
    assert arrivals.read_ns(ends).tolist() == (1_000 * -(-ends // 3)).tolist()
    after = sum(each.nbytes for each in vars(arrivals).values() if isinstance(each, np.ndarray))
    assert after == room
