"""Inertial factors: derivatives, preintegration, and flights that share nothing with the solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.geometry import rotation_exp
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse import solve
from locatk.core.lighthouse.motion.inertial import (
    DELAY,
    IMU_PARAMETERS,
    ImuIntervals,
    linearize_imu,
    select_intervals,
)
from locatk.core.lighthouse.motion.path import Path
from locatk.formats.benchmarks.lighthouse.flights import make_flight

GRAVITY = np.array([0.1, 0.2, -9.8])


def random_path(knots: int = 6) -> Path:
    rng = np.random.default_rng(0)
    rotation = rotation_exp(np.cumsum(rng.normal(0, 0.05, (knots, 3)), axis=0))
    position, velocity, spin = rng.normal(size=(3, knots, 3))
    time_s = np.arange(knots) * 0.01
    return Path(time_s, np.ones(knots - 1, bool), position, velocity, rotation, spin)


def random_imu(path: Path) -> ImuIntervals:
    rng = np.random.default_rng(1)
    time_ns = np.arange(-50, 60) * 3_000_000
    force, rate = 5 * rng.normal(size=(2, 110, 3))
    imu = select_intervals(
        InertialSamples("cf", time_ns, force, rate), path, np.ones(len(path), bool), 0
    )
    assert imu is not None
    return imu


def test_derivatives_are_those_of_the_residuals() -> None:
    path = random_path()
    imu = random_imu(path)
    value = np.random.default_rng(2).normal(0, 0.01, IMU_PARAMETERS)
    value[DELAY] = 1.3e-3
    found = linearize_imu(imu, path, GRAVITY, value)
    step = 1e-6
    for column in range(24):
        for k in range(len(path) - 1):
            change = np.zeros((len(path), 12))
            change[k + column // 12, column % 12] = step
            after = linearize_imu(imu, path.stepped(change), GRAVITY, value).residual[k]
            before = linearize_imu(imu, path.stepped(-change), GRAVITY, value).residual[k]
            numeric = (after - before) / (2 * step)
            np.testing.assert_allclose(found.by_states[k, :, column], numeric, atol=1e-3)
    start = np.concatenate([GRAVITY, value])
    for column in range(3 + IMU_PARAMETERS):
        up, down = start.copy(), start.copy()
        up[column] += step
        down[column] -= step
        after = linearize_imu(imu, path, up[:3], up[3:]).residual
        before = linearize_imu(imu, path, down[:3], down[3:]).residual
        numeric = (after - before) / (2 * step)
        np.testing.assert_allclose(found.by_common[:, :, column], numeric, atol=1e-6)


def test_a_circle_with_constant_spin_has_no_residual() -> None:
    # Position on a circle of 0.5 m, nose along the velocity; the samples are delayed by 4 ms.
    rate, radius, delay = 3.0, 0.5, 0.004
    time_s = np.arange(20) * 0.01
    angle = rate * time_s
    radial = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    ahead = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], ahead.shape)
    path = Path(
        time_s,
        np.ones(19, bool),
        radius * radial,
        radius * rate * ahead,
        np.stack([ahead, -radial, up], axis=2),
        rate * up,
    )
    sample_s = np.arange(-50, 80) * 0.004
    bias = np.array([0.02, -0.01, 0.03])
    measured_rate = np.tile([0.0, 0.0, rate] + bias, (130, 1))
    force = np.tile([0.0, radius * rate**2, 9.8], (130, 1))
    imu = select_intervals(
        InertialSamples("cf", np.round(sample_s * 1e9).astype(np.int64), force, measured_rate),
        path,
        np.ones(20, bool),
        0,
    )
    assert imu is not None
    assert len(imu.interval) == 19
    value = np.zeros(IMU_PARAMETERS)
    value[:3], value[DELAY] = bias, delay
    residual = linearize_imu(imu, path, np.array([0.0, 0.0, -9.8]), value).residual
    assert np.abs(residual[:, :3]).max() < 1e-9
    assert np.abs(residual[:, 3:6]).max() < 1e-8
    assert np.abs(residual[:, 6:]).max() < 1e-5


def test_intervals_without_samples_have_no_factor() -> None:
    path = random_path()
    time_ns = np.arange(-50, 60) * 1_000_000
    rate = np.zeros((110, 3))
    imu = select_intervals(
        InertialSamples("cf", time_ns, np.full((110, 3), np.nan), rate), path, np.ones(6, bool), 0
    )
    assert imu is not None
    assert not imu.has_force.any()
    # Samples end at 59 ms; the last intervals lack the margin for delays.
    assert imu.interval.tolist() == [0, 1, 2, 3]


@pytest.mark.slow
def test_wrong_axes_are_left_out() -> None:
    flight = make_flight(21, motion="agile", geometry="given", duration_s=8.0)
    wrong = replace(
        flight.imu,
        acceleration=flight.imu.acceleration[:, [1, 2, 0]],
        angular_rate=flight.imu.angular_rate[:, [1, 2, 0]],
    )
    without_rate = replace(flight.imu, angular_rate=np.full_like(flight.imu.angular_rate, np.nan))
    solutions = [
        solve(flight.sweeps, flight.scene, receivers=flight.receivers, imu=imu)
        for imu in ((), (flight.imu,), (wrong,), (without_rate,))
    ]
    codes = [{warning.code for warning in s.warnings} for s in solutions]
    assert ["imu_contradicts_light" in c for c in codes] == [False, False, True, False]
    assert ["imu_not_used" in c for c in codes] == [False, False, False, True]
    (without,), (_,), (contradicting,), (_,) = (s.trajectories for s in solutions)
    shared = np.isin(contradicting.time_ns, without.time_ns)
    rows = np.searchsorted(without.time_ns, contradicting.time_ns[shared])
    difference = contradicting.position[shared] - without.position[rows]
    assert np.median(np.linalg.norm(difference, axis=1)) < 1e-3
