"""Time axes, expected errors and limits of value axes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.series import (
    Series,
    axis_limit,
    error_quantile_95,
    origin_ns,
    overlap_in_time,
    peaks_beyond,
    pose_span_ns,
    scored_covariance,
)

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


def test_recordings_of_another_time_do_not_overlap() -> None:
    poses = solution(130, 150)
    assert overlap_in_time(recording(151, 200), poses)
    assert not overlap_in_time(recording(156, 200), poses)
    assert not overlap_in_time(recording(50, 124), poses)
    assert pose_span_ns(solution()) is None


@pytest.mark.parametrize(("axes", "within"), [(1, 0.02), (2, 0.01), (3, 0.01)])
def test_expected_errors_are_quantiles(axes: int, within: float) -> None:
    covariance = np.full((1, 3, 3), np.nan)
    covariance[0, :axes, :axes] = np.eye(axes) * 4.0
    expected = 2 * np.sqrt(chi2.ppf(0.95, axes))
    np.testing.assert_allclose(error_quantile_95(covariance), expected, rtol=within)


def test_expected_errors_of_uneven_axes() -> None:
    rng = np.random.default_rng(1)
    covariance = np.diag([1.0, 0.2, 0.01])[None]
    drawn = np.linalg.norm(rng.multivariate_normal(np.zeros(3), covariance[0], 200_000), axis=1)
    np.testing.assert_allclose(error_quantile_95(covariance), np.percentile(drawn, 95), rtol=0.02)


def test_unknown_axes_have_no_expected_error() -> None:
    covariance = np.full((2, 3, 3), np.nan)
    covariance[1] = 0.0
    assert np.isnan(error_quantile_95(covariance)[0])
    assert error_quantile_95(covariance)[1] == 0.0


def test_axes_leave_out_outliers() -> None:
    values = np.append(np.ones(200), 1e6)
    assert axis_limit(values) < 2
    assert axis_limit(np.zeros(3)) > 0
    assert axis_limit(np.full(3, np.nan)) > 0


@pytest.mark.parametrize(
    ("expected", "limit"),
    [
        ([2.0, 3.5], 3.675),  # All bounds fit.
        ([2.0, 50.0], 1.2 * 2.1),  # The large one does not, and marks at the limit need space.
        ([50.0, 60.0], 1.2 * 1.05),  # None fits: the values fill the axis.
        ([2.0] * 99 + [3.9], 1.2 * 3.15),  # A peak may take half of the bounds more.
        ([0.5, np.nan], 1.05),
        ([], 1.05),
    ],
)
def test_an_axis_holds_the_bounds_that_leave_the_values_readable(
    expected: list[float], limit: float
) -> None:
    assert axis_limit(np.ones(100), np.array(expected)) == pytest.approx(limit)


def test_an_axis_of_no_errors_holds_the_bounds() -> None:
    assert axis_limit(np.zeros(3), np.array([0.2])) == pytest.approx(0.21)


def test_the_largest_value_beyond_a_scale_is_marked_in_each_part_of_the_time() -> None:
    value = np.ones(4001)
    value[[150, 151, 152]] = 3.0, 5.0, 4.0  # One of 40 parts.
    value[3000] = 2.5
    series = Series(10**9 * np.arange(4001), value)
    assert peaks_beyond(series, 2.0).tolist() == [151, 3000]
    assert peaks_beyond(series, 5.0).tolist() == []
    assert len(peaks_beyond(series, 0.5)) == 40
    assert peaks_beyond(Series(np.array([7]), np.ones(1)), 0.5).tolist() == [0]


def test_a_rotation_mixes_unknown_axes_only_with_those_it_turns_them_into() -> None:
    solved = solution(130)
    solved.trajectories[0].covariance[:, :3, :3] = np.diag([np.nan, 1.0, 4.0])
    evaluation: Any = SimpleNamespace(
        n=1,
        devices=("red",),
        device=np.zeros(1, int),
        time_ns=np.array([130 * S]),
        align="sim3",
        alignment=Similarity(2.0, rotation_exp([0.0, 0.0, 0.5]), np.zeros(3)),
    )
    (covariance,) = scored_covariance(solved, evaluation)
    assert np.isnan(covariance[:2]).all()
    assert covariance[2, 2] == pytest.approx(16.0)
