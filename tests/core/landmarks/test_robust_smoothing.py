"""Slips, displaced landmarks, noise and lag of odometry, on drives of a generator of its own.

The odometry is integrated from the truth in the middle of this file, with white noise of each
increment. The model of the solver, ramps over units of effort, is not used.
"""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.detection.trace import compose, relative
from locatk.core.landmarks.localization import drive_smoothing
from locatk.core.landmarks.localization.odometry_path import OdometryPath, without_lag
from locatk.core.landmarks.localization.robust_smoothing import RobustSmoothing
from locatk.core.landmarks.map.floor import AsBuiltLandmark, FloorMap
from locatk.core.landmarks.preprocessing import planar_poses
from locatk.core.landmarks.simulation.options import Errors, SimulationOptions
from locatk.core.landmarks.simulation.robot import RobotLimits
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import (
    LocalizedRobot,
    SolveOptions,
    identify_recording,
    lag_of_visits,
    solve,
    solve_recording,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

FLOOR = FloorMap(np.random.default_rng(21).integers(0, 16, (9, 9)))

CORNERS = ((1, 1), (1, 5), (4, 5), (4, 1))


@functools.cache
def drive(
    displaced_m: float = 0.0, rotated_deg: float = 0.0, errors: Errors | None = None
) -> SimulatedSession:
    """Drive over twelve landmarks; the landmark at 4,4 may be displaced or rotated."""
    unknown = np.full(7, np.nan)
    built = AsBuiltLandmark(displaced_m, 0.0, math.radians(rotated_deg), unknown[:4], unknown)
    is_faulty = displaced_m or rotated_deg
    floor = replace(FLOOR, built={(4, 4): built} if is_faulty else {})
    limits = RobotLimits(speed_mps=0.2)
    options = SimulationOptions(
        "path", cells=CORNERS, rate_hz=50.0, limits=limits, errors=errors or Errors(), seed=4
    )
    return simulate(floor, options)


def true_poses(session: SimulatedSession, time_ns: NDArray[np.int64]) -> Array:
    return OdometryPath.of(session.truth[0]).pose_at(time_ns)


def odometry_of(
    session: SimulatedSession, seed: int, walk_deg: float = 0.26, lag_s: float = 0.0
) -> Trajectory:
    """Integrate the increments of the truth with a scale of 1.5 % and white noise."""
    rng = np.random.default_rng([seed, 77])
    given = session.odometry[0]
    pose = true_poses(session, given.time_ns - round(1e9 * lag_s))
    step = np.array([relative(b[None], a)[0] for a, b in pairwise(pose)])
    root = np.sqrt(np.hypot(*step[:, :2].T) + 0.05 * np.abs(step[:, 2]))[:, None]
    step = 1.015 * step + root * rng.normal(size=step.shape) * [5e-4, 2e-4, math.radians(walk_deg)]
    poses = [np.zeros(3)]
    for each in step:
        poses.append(compose(poses[-1], each))
    return with_poses(given, np.array(poses))


def with_poses(given: Trajectory, pose: Array) -> Trajectory:
    position = np.column_stack([pose[:, :2], np.zeros(len(pose))])
    return replace(given, position=position, quaternion=quaternion_from_heading(pose[:, 2]))


def slipped(odometry: Trajectory, time_fraction: float, slip: Array) -> Trajectory:
    pose = planar_poses(odometry)
    first = round(time_fraction * len(pose))
    pose[first:] = compose(compose(pose[first], slip), relative(pose[first:], pose[first]))
    return with_poses(odometry, pose)


def solved(session: SimulatedSession, odometry: Trajectory, **options: float) -> LocalizedRobot:
    return solve_recording(session.samples[0], odometry, FLOOR, SolveOptions(**options))  # type: ignore[arg-type]


def codes(robot: LocalizedRobot) -> list[str]:
    return [warning.code for warning in robot.warnings]


def errors_of(session: SimulatedSession, robot: LocalizedRobot) -> tuple[Array, Array]:
    """Return errors (n, 3) and their squares in units of their variances."""
    (path,) = robot.trajectories
    pose = np.column_stack([path.position[:, :2], heading_from_quaternion(path.quaternion)])
    error = pose - true_poses(session, path.time_ns)
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    return error, error**2 / path.sigma[:, [0, 1, 5]] ** 2


@pytest.mark.slow
@pytest.mark.parametrize("walk_deg", [0.26, 0.86])
def test_random_walk_is_estimated(walk_deg: float) -> None:
    one = drive()
    squares = []
    for seed in range(3):
        robot = solved(one, odometry_of(one, seed, walk_deg))
        assert codes(robot) == []
        squares.append(errors_of(one, robot)[1].mean(axis=0))
    heading, position = np.mean(squares, axis=0)[2], np.mean(squares, axis=0)[:2].mean()
    assert 0.3 < heading < 2.5
    assert 0.3 < position < 2.5


@pytest.mark.slow
def test_tolerance_of_installed_landmarks_is_estimated() -> None:
    """Landmarks at 0.2 mm and at 4 mm from their positions; 1.5 mm are assumed at first."""
    sigma, squares = {}, {}
    for tolerance_m in (0.2e-3, 4e-3):
        turn = tolerance_m * math.radians(0.5) / 1e-3
        one = drive(errors=Errors(landmark_place_m=tolerance_m, landmark_turn_rad=turn))
        robot = solved(one, odometry_of(one, 3))
        assert codes(robot) == []
        sigma[tolerance_m] = robot.trajectories[0].sigma[:, :2].mean()
        squares[tolerance_m] = errors_of(one, robot)[1][:, :2].mean()
    assert sigma[4e-3] > 3 * sigma[0.2e-3]
    assert max(squares.values()) < 3


@pytest.mark.slow
def test_known_noise_is_used() -> None:
    one = drive()
    odometry = odometry_of(one, 5)
    known, estimated = (
        np.degrees(np.quantile(solved(one, odometry, **options).trajectories[0].sigma[:, 5], 0.8))
        for options in ({"odometry_noise": math.radians(2)}, {})
    )
    assert known > 2 * estimated
    # Between the ends of a unit of 100 mm or more, a walk of 2 deg deviates by 0.3 deg. The fields
    # leave about 0.3 deg at the ends.
    assert known > 0.4


@pytest.mark.slow
def test_lag_is_estimated_and_removed() -> None:
    one = drive()
    odometry = odometry_of(one, 6, lag_s=0.06)
    late = identify_recording(one.samples[0], odometry, FLOOR, SolveOptions())
    assert lag_of_visits(late) == pytest.approx(0.06, abs=0.01)
    robot = solved(one, odometry)
    assert codes(robot) == ["odometry_lag"]
    assert "later than the fields" in robot.warnings[0].message
    error, squares = errors_of(one, robot)
    assert np.hypot(*error[:, :2].T).mean() < 1.2e-3
    assert squares.mean() < 2.5


@pytest.mark.slow
def test_known_lag_is_removed_without_a_warning() -> None:
    one = drive()
    robot = solved(one, odometry_of(one, 6, lag_s=-0.04), odometry_lag_s=-0.04)
    assert codes(robot) == []
    assert np.hypot(*errors_of(one, robot)[0][:, :2].T).mean() < 1.2e-3


def test_odometry_without_lag() -> None:
    time_ns = np.arange(100) * 20_000_000
    position = np.column_stack([np.sin(time_ns * 1e-9), np.zeros((100, 2))])
    late = replace(
        Trajectory.from_positions("robot", "odometry", time_ns, position),
        time_ns=time_ns + 40_000_000,
    )
    result = without_lag(late, 0.04)
    np.testing.assert_allclose(result.position[:, 0], np.sin(result.time_ns * 1e-9), atol=1e-9)
    assert len(result) == 98


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.96, 1.03])
def test_scale_of_distances_is_named(scale: float) -> None:
    one = drive()
    given = odometry_of(one, 3)
    robot = solved(one, replace(given, position=given.position * scale / 1.015))
    (warning,) = robot.warnings
    assert warning.code == "odometry_scale"
    assert float(warning.message.split(" are ")[1].split()[0]) == pytest.approx(scale, abs=3e-3)
    assert np.hypot(*errors_of(one, robot)[0][:, :2].T).mean() < 1.5e-3


def test_odometry_with_an_invalid_pose_without_lag() -> None:
    time_ns = np.arange(100) * 20_000_000
    position = np.column_stack([time_ns * 1e-9, np.zeros((100, 2))])
    position[40, 0] = np.nan
    path = Trajectory.from_positions("robot", "odometry", time_ns, position)
    result = without_lag(path, 0.02)
    is_invalid = np.isnan(result.position[:, 0])
    assert np.flatnonzero(is_invalid).tolist() == [40]
    np.testing.assert_allclose(
        result.position[~is_invalid, 0], 1e-9 * result.time_ns[~is_invalid] + 0.02, atol=1e-9
    )
    with pytest.raises(InputError, match="shorter than its lag of 5000 ms"):
        without_lag(path, 5.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slip", "fraction"),
    [
        ((0.02, 0.0, 0.0), 0.43),
        ((0.02, 0.0, 0.0), 0.52),
        ((0.0, 0.06, math.radians(-5)), 0.52),
        ((0.0, 0.0, math.radians(10)), 0.43),
    ],
)
def test_slip_is_named_and_released(slip: tuple[float, float, float], fraction: float) -> None:
    one = drive()
    odometry = slipped(odometry_of(one, 7), fraction, np.array(slip))
    robot = solved(one, odometry)
    assert set(codes(robot)) == {"wheel_slip"}
    assert lag_of_visits(robot.identified) == 0
    error, squares = errors_of(one, robot)
    slip_ns = odometry.time_ns[round(fraction * len(odometry))]
    is_far = np.abs(robot.trajectories[0].time_ns - slip_ns) > 4_000_000_000
    assert np.hypot(*error[is_far, :2].T).max() < 4e-3
    assert squares.mean() < 3
    # Near the slip, whose moment is not known, the covariance says so.
    assert squares[~is_far].mean() < 4


@pytest.mark.slow
def test_covariance_contains_both_explanations() -> None:
    """A slip after the first landmark: that landmark may as well be displaced."""
    one = drive()
    robot = solved(one, slipped(odometry_of(one, 7), 0.08, np.array([0.025, 0.0, 0.0])))
    (warning,) = robot.warnings
    assert "displaced, or a wheel slipped" in warning.message
    (path,) = robot.trajectories
    squares = errors_of(one, robot)[1]
    assert squares[0].max() < 9
    assert path.sigma[0, 0] > 0.015
    assert path.sigma[-1, 0] < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.05, 0.95])
def test_a_slip_in_the_first_or_last_visit_ends_the_poses(fraction: float) -> None:
    one = drive()
    robot = solved(one, slipped(odometry_of(one, 7), fraction, np.array([0.025, 0.0, 0.0])))
    assert "odometry_contradicted" in codes(robot)
    assert np.hypot(*errors_of(one, robot)[0][:, :2].T).max() < 4e-3


@pytest.mark.slow
@pytest.mark.parametrize(("displaced_m", "rotated_deg"), [(0.012, 0), (0.03, 0), (0, 5), (0, 8)])
def test_displaced_or_rotated_landmark_is_named(displaced_m: float, rotated_deg: float) -> None:
    one = drive(displaced_m, rotated_deg)
    robot = solved(one, odometry_of(one, 8))
    (warning,) = robot.warnings
    assert warning.code == "landmark_displaced"
    assert "the landmark at 4,4 is displaced by" in warning.message
    words = warning.message.split()
    distance_mm, angle_deg = (float(words[words.index(unit) - 1]) for unit in ("mm", "deg"))
    assert distance_mm == pytest.approx(1e3 * displaced_m, abs=4)
    assert angle_deg == pytest.approx(rotated_deg, abs=1.5)
    error, squares = errors_of(one, robot)
    assert np.hypot(*error[:, :2].T).max() < 3e-3
    assert squares.mean() < 2.5


@pytest.mark.slow
def test_a_drive_in_parts_has_the_same_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    one = drive()
    odometry = slipped(odometry_of(one, 4), 0.52, np.array([0.03, 0.0, 0.0]))
    whole = solved(one, odometry)
    for name, count in (("MAX_PART_VISITS", 8), ("PART_VISITS", 7), ("NEIGHBOURING_VISITS", 6)):
        monkeypatch.setattr(drive_smoothing, name, count)
    in_parts = solved(one, odometry)
    assert codes(in_parts) == codes(whole) == ["wheel_slip"]
    (first,), (second,) = whole.trajectories, in_parts.trajectories
    assert (first.time_ns == second.time_ns).all()
    sigma = first.sigma[:, :2]
    assert np.abs((second.position - first.position)[:, :2] / sigma).max() < 0.5
    np.testing.assert_allclose(second.sigma[:, :2], sigma, rtol=0.35)


@pytest.mark.slow
@pytest.mark.parametrize("failing", ["raises", "is_incredible"])
def test_a_part_without_poses_is_reported(failing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one = drive()
    odometry = odometry_of(one, 9)
    for name, count in (("MAX_PART_VISITS", 8), ("PART_VISITS", 7), ("NEIGHBOURING_VISITS", 6)):
        monkeypatch.setattr(drive_smoothing, name, count)
    smooth, calls = drive_smoothing.smooth_robustly, []

    def smooth_first_part_only(*given: Any, **options: Any) -> RobustSmoothing:
        calls.append(given)
        if len(calls) == 1:
            return smooth(*given, **options)
        if failing == "raises":
            raise DegenerateError("the fields and the odometry contradict each other")
        smoothed = smooth(*given, **options)
        return replace(smoothed, result=replace(smoothed.result, residual_sigma=99.0))

    monkeypatch.setattr(drive_smoothing, "smooth_robustly", smooth_first_part_only)
    solution = solve(one.samples, FLOOR, odometry=[odometry])
    assert len(calls) == 2
    (path,) = solution.trajectories
    missing_ns = np.setdiff1d(odometry.time_ns, path.time_ns)
    assert 0.3 < len(missing_ns) / len(odometry) < 0.7
    (warning,) = solution.warnings
    assert warning.code == "field_misfit"
    times = re.search(r"no poses from (\S+) to (\S+) s", warning.message)
    assert times is not None
    first_s, last_s = map(float, times.groups())
    assert 1e-9 * path.time_ns[-1] <= first_s <= 1e-9 * missing_ns[0] + 1e-3
    assert last_s == pytest.approx(1e-9 * missing_ns[-1], abs=1e-3)
    lost = [each for each in solution.detections if each.refused == "no_pose"]
    assert solution.rejected == {"no_pose": len(lost)}
    assert all(each.cell is not None for each in lost)
    assert {each.time_s > first_s for each in lost} == {True}
    assert {each.time_s > first_s for each in solution.detections if not each.refused} == {False}


@pytest.mark.slow
def test_carried_robot_has_no_poses_in_between() -> None:
    """The middle of the recording is left out, with the motion of the odometry in it."""
    one = drive()
    odometry = odometry_of(one, 9)
    pose, time_ns = planar_poses(odometry), odometry.time_ns
    start, stop = round(0.4 * len(pose)), round(0.65 * len(pose))
    kept = np.r_[:start, stop : len(pose)]
    pose[stop:] = compose(pose[start], relative(pose[stop:], pose[stop]))
    odometry = with_poses(odometry, pose).select(np.isin(np.arange(len(pose)), kept))
    samples = one.samples[0]
    is_kept = (samples.time_ns < time_ns[start]) | (samples.time_ns > time_ns[stop])
    samples = replace(samples, time_ns=samples.time_ns[is_kept], field_t=samples.field_t[is_kept])
    robot = solve_recording(samples, odometry, FLOOR, SolveOptions())
    assert codes(robot) == ["robot_carried"]
    error, squares = errors_of(one, robot)
    assert np.hypot(*error[:, :2].T).max() < 4e-3
    assert squares.mean() < 3
    between = (odometry.time_ns > time_ns[start] - 10**7) & (
        odometry.time_ns < time_ns[stop] + 10**7
    )
    assert not np.isin(odometry.time_ns[between], robot.trajectories[0].time_ns).any()
