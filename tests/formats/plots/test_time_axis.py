"""Where time axes begin, and how moments are said."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.time_axis import of_one_time, origin_ns, span, when

S = 1_000_000_000


def solution(*times_s: float) -> Solution:
    time_ns = np.array([round(t * S) for t in times_s], np.int64)
    poses = Trajectory.from_positions("red", "floor", time_ns, np.zeros((len(time_ns), 3)))
    return Solution("lighthouse", "bundle", (poses,))


def recording(start_s: float | None, end_s: float | None) -> Any:
    ends = [None if t is None else round(t * S) for t in (start_s, end_s)]
    return SimpleNamespace(start_ns=ends[0], end_ns=ends[1])


@pytest.mark.parametrize(
    ("session", "poses", "begins_s"),
    [
        (recording(100, 200), (130, 150), 100),
        (None, (130, 150), 130),
        (recording(None, None), (130, 150), 130),  # damaged
        (recording(1000, 1100), (130, 150), 130),  # of another time
        (recording(132, 150), (130, 150), 132),  # poses may be stamped a little before
        (recording(100, 200), (), 100),
        (None, (), 0),
    ],
)
def test_axes_begin_with_the_recording_else_with_the_first_pose(
    session: Any, poses: tuple[float, ...], begins_s: float
) -> None:
    assert origin_ns(session, solution(*poses)) == begins_s * S


def test_of_one_time() -> None:
    poses = solution(130, 150)
    assert of_one_time(recording(151, 200), poses)
    assert not of_one_time(recording(156, 200), poses)
    assert not of_one_time(recording(50, 124), poses)
    assert span(solution()) is None


@pytest.mark.parametrize(
    ("time_ns", "said"),
    [
        (1_767_225_600 * S, "2026-01-01 00:00:00 UTC"),
        (1_767_225_600 * S + 27_999_999, "2026-01-01 00:00:00.027 UTC"),
        (-S, "1969-12-31 23:59:59 UTC"),
        (2**63 - 1, "2262-04-11 23:47:16.854 UTC"),
        (-(10**22), "-10000000000000000000000 ns"),
    ],
)
def test_moments(time_ns: int, said: str) -> None:
    assert when(time_ns) == said
