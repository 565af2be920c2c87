"""Covariances of tracked poses fit their errors on data that the filters' models did not make."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.simulation.options import Errors
from locatk.core.polaris.simulation.options import SimulationOptions
from locatk.core.polaris.simulation.session import simulate
from locatk.core.streaming.events import Correction, Fix, PoseEstimate
from locatk.core.streaming.tracker import DeviceTracker, TrackerSettings

PLANE = (0, 1, 5)
SETTINGS = TrackerSettings(fix_timeout_s=100.0, lost_timeout_s=100.0, max_sigma_m=10.0)


def mean_nees(cases: list[Any], track: Any, components: Any = PLANE, **options: Any) -> float:
    """Mean over drives, without their first tenth; of poses that were carried."""
    means = []
    for each in cases:
        nees = each.nees(track(DeviceTracker("robot", SETTINGS), each, **options), components)
        means.append(nees[len(nees) // 10 :].mean())
    return float(np.mean(means))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="fixes-at-2-hz"),
        pytest.param({"fix_interval_s": 0.05}, id="fixes-at-20-hz"),
        pytest.param({"fix_interval_s": 4.0, "sigma_m": 1e-3, "duration_s": 60.0}, id="rare-fixes"),
        pytest.param({"rate_hz": 10.0}, id="odometry-at-10-hz"),
        pytest.param({"tick_m": 0.25e-3}, id="encoders"),
        pytest.param({"has_heading": False, "fix_interval_s": 0.1}, id="positions"),
        pytest.param(
            {
                "duration_s": 60.0,
                "errors": replace(
                    Errors(), odometry_scale=0.03, odometry_turn=0.03, wheel_noise_m=1e-3
                ),
            },
            id="poor-wheels",
        ),
    ],
)
def test_nees_of_drives(drive: Any, track: Any, options: dict[str, Any]) -> None:
    """A factor of 2 of the NEES is one of 1.4 of the sigmas."""
    assert 0.5 < mean_nees([drive(seed, **options) for seed in range(6)], track) < 1.6


@pytest.mark.slow
def test_nees_with_common_errors(drive: Any, track: Any) -> None:
    """Averaging does not reduce errors that fixes share."""
    cases = [drive(seed, common_m=5e-3, fix_interval_s=0.1, duration_s=10.0) for seed in range(12)]
    assert 0.4 < mean_nees(cases, track, (0, 1)) < 1.9
    independent = [
        replace(case, fixes=tuple(replace(fix, common_covariance=None) for fix in case.fixes))
        for case in cases
    ]
    assert mean_nees(independent, track, (0, 1)) > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.2, 2.0])
def test_nees_with_late_fixes(drive: Any, track: Any, delay_s: float) -> None:
    cases = [drive(seed) for seed in range(6)]
    assert 0.5 < mean_nees(cases, track, delay_s=delay_s) < 1.6


@pytest.mark.slow
def test_nees_of_odometry_that_reports_its_noise() -> None:
    """The odometry of Polaris reports the growth of the variance of its heading."""
    rng = np.random.default_rng(1)
    sigma, plane = np.array([5e-4, 5e-4, 2e-3]), np.ix_(PLANE, PLANE)
    nees = []
    for seed in range(60):
        session = simulate(None, SimulationOptions(odometry=True, rate_hz=50.0, seed=seed))
        truth, odometry = session.truth, session.odometry
        assert odometry is not None
        noise = sigma * rng.normal(size=3)
        covariance = np.full((6, 6), np.nan)
        covariance[plane] = np.diag(sigma**2)
        heading = heading_from_quaternion(truth.quaternion)
        fix = Fix(
            odometry.device,
            truth.frame,
            int(truth.time_ns[0]),
            truth.position[0] + np.append(noise[:2], 0.0),
            quaternion_from_heading(heading[0] + noise[2]),
            covariance,
        )
        tracker = DeviceTracker(odometry.device, SETTINGS)
        tracker.fix(fix)
        pose = tracker.odometry(odometry)[-1]
        assert isinstance(pose, PoseEstimate)
        at = np.searchsorted(truth.time_ns, pose.time_ns)
        found = float(heading_from_quaternion(pose.quaternion))
        turn = math.remainder(found - float(heading[at]), 2 * math.pi)
        error = np.append((pose.position - truth.position[at])[:2], turn)
        nees.append(error @ np.linalg.solve(pose.covariance[plane], error) / 3)
    assert 0.5 < np.mean(nees) < 1.5


@pytest.mark.slow
def test_nees_of_flights(flight: Any, track: Any) -> None:
    cases = [flight(seed) for seed in range(6)]
    assert 0.5 < mean_nees(cases, track, range(6)) < 1.6


@pytest.mark.slow
def test_recovers_from_slips(drive: Any, track: Any) -> None:
    """A slip of 5 mm rotates the robot by 3 degrees; most of the later poses are right."""
    cases = [drive(seed, errors=Errors(slips_per_m=0.5), fix_interval_s=0.1) for seed in range(6)]
    nees = np.concatenate(
        [case.nees(track(DeviceTracker("robot", SETTINGS), case), PLANE) for case in cases]
    )
    assert np.mean(nees < 16.27 / 3) > 0.9


@pytest.mark.slow
def test_kidnapped_robot_starts_anew(drive: Any, track: Any) -> None:
    """The third fix in a row at another position is right, and a correction says so."""
    case = drive(1)
    half = len(case.fixes) // 2
    shift = np.array([1.0, 0.0, 0.0])
    moved = [replace(fix, position=fix.position + shift) for fix in case.fixes[half:]]
    events = track(
        DeviceTracker("robot", SETTINGS), replace(case, fixes=(*case.fixes[:half], *moved))
    )
    (correction,) = [event for event in events if isinstance(event, Correction)]
    assert correction.time_ns == moved[2].time_ns
    np.testing.assert_allclose(correction.displacement_m, shift, atol=0.05)
    poses = [event for event in events if isinstance(event, PoseEstimate)]
    assert {pose.reset_counter for pose in poses} == {0, 1}
    assert all((pose.reset_counter == 1) == (pose.time_ns >= correction.time_ns) for pose in poses)
