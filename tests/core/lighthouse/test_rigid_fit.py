"""Derivatives of the rigid model, numerically, and the fit from poor starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.geometry import rotation_exp
from locatk.core.least_squares import SchurEquations
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, predict_angles
from locatk.core.lighthouse.devices import bundle_adjustment as device_bundle
from locatk.core.lighthouse.devices import pose_fit
from locatk.core.lighthouse.devices.bundle_adjustment import adjust_devices
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    SweepObservations,
    fit_poses,
    linearize,
    photodiode_positions,
)
from locatk.core.lighthouse.scene import bundle_adjustment as bundle
from locatk.core.lighthouse.scene.model import StationArrays

Array = NDArray[np.float64]

STATIONS: StationArrays = (
    np.array([[-2.0, 0.0, 1.0], [0.3, -2.0, 1.2]]),
    rotation_exp(np.array([[0.0, 0.3, 0.1], [0.1, 0.2, 1.5]])),
    (GENERIC_CALIBRATION, GENERIC_CALIBRATION),
)


def world(
    moments: int, sweeps: int, *, seed: int = 0, noise: float = 0.0
) -> tuple[SweepObservations, DeviceStates]:
    """Sweeps of moving devices, and their true poses."""
    rng = np.random.default_rng(seed)
    poses = DeviceStates(
        rng.uniform(-0.3, 0.3, (moments, 3)) + [0.0, 0.0, 0.3],
        rotation_exp(rng.normal(0, 1, (moments, 3))),
        rng.normal(0, 1, (moments, 6)) * np.repeat([0.5, 2.0], 3),
    )
    shape = (moments, sweeps)
    looks = SweepObservations(
        rng.uniform(-0.05, 0.05, (*shape, 3)),
        rng.integers(0, 2, shape),
        rng.integers(0, 2, shape),
        np.zeros(shape),
        rng.uniform(-0.02, 0.02, shape),
        rng.random(shape) < 0.9,
    )
    angle = np.zeros(shape)
    for m, n in np.ndindex(shape):
        i, since = looks.station[m, n], looks.time_offset_s[m, n]
        rotation = rotation_exp(poses.rate[m, 3:] * since) @ poses.rotation[m]
        place = (
            poses.position[m] + poses.rate[m, :3] * since + rotation @ looks.sensor_position[m, n]
        )
        local = (place - STATIONS[0][i]) @ STATIONS[1][i]
        angle[m, n] = predict_angles(local, STATIONS[2][i])[looks.plane[m, n]]
    angle += rng.normal(0, noise, shape) if noise else 0.0
    angle[~looks.is_observed] = 99.0
    return SweepObservations(
        looks.sensor_position,
        looks.station,
        looks.plane,
        angle,
        looks.time_offset_s,
        looks.is_observed,
    ), poses


def test_the_model_meets_its_own_world() -> None:
    looks, poses = world(3, 20)
    missed, _ = linearize(looks, STATIONS, poses)
    assert np.abs(missed[looks.is_observed]).max() < 1e-12
    assert np.all(np.isnan(missed[~looks.is_observed]))
    lever, _ = photodiode_positions(looks, poses)
    assert np.linalg.norm(lever, axis=-1) == pytest.approx(
        np.linalg.norm(looks.sensor_position, axis=-1)
    )


def test_derivatives_are_those_of_small_steps() -> None:
    looks, poses = world(3, 20)
    # At rest, so that pose and sweep share their time; rates enter as steps times time.
    poses = DeviceStates.at_rest(poses.position, poses.rotation)
    _, gradient = linearize(looks, STATIONS, poses)
    for k in range(12):
        step = np.zeros((3, 12))
        step[:, k] = 1e-5
        ahead, _ = linearize(looks, STATIONS, poses.stepped(step))
        behind, _ = linearize(looks, STATIONS, poses.stepped(-step))
        numeric = ((ahead - behind) / 2e-5)[looks.is_observed]
        analytic = gradient[..., k % 6] * (looks.time_offset_s if k >= 6 else 1.0)
        assert numeric == pytest.approx(analytic[looks.is_observed], abs=1e-7)


def test_the_fit_comes_back_from_a_poor_start() -> None:
    looks, true = world(40, 40)
    rng = np.random.default_rng(1)
    start = DeviceStates.at_rest(
        true.position + rng.normal(0, 0.05, (40, 3)),
        rotation_exp(rng.normal(0, 0.2, (40, 3))) @ true.rotation,
    )
    found = fit_poses(looks, STATIONS, start, sigma_rad=1e-4, loss_scale_rad=3e-3)
    assert np.abs(found.poses.position - true.position).max() < 2e-5
    turn = Rotation.from_matrix(found.poses.rotation @ np.swapaxes(true.rotation, 1, 2)).as_rotvec()
    assert np.abs(turn).max() < 1e-3
    assert found.poses.rate == pytest.approx(true.rate, abs=0.1)
    assert np.all(np.isnan(found.residual) == ~looks.is_observed)


def test_lost_sweeps_pull_nothing() -> None:
    looks, true = world(5, 60)
    angle = looks.angle.copy()
    angle[:, ::3] += 0.05
    bent = SweepObservations(
        looks.sensor_position,
        looks.station,
        looks.plane,
        angle,
        looks.time_offset_s,
        looks.is_observed,
    )
    pulled = fit_poses(bent, STATIONS, true, sigma_rad=1e-4, loss_scale_rad=3e-3)
    exact = fit_poses(bent, STATIONS, true, sigma_rad=1e-4, loss_scale_rad=3e-3, cutoff_rad=0.02)
    assert np.abs(exact.poses.position - true.position).max() < 2e-5
    assert np.abs(pulled.poses.position - true.position).max() > 2e-5


def test_the_gradient_of_the_joint_adjustment_is_that_of_its_cost() -> None:
    looks, poses = world(4, 30, noise=1e-3)
    # Of a spinning device the turn at each sweep's time stands for that at the moment.
    poses = DeviceStates.at_rest(poses.position, poses.rotation)
    share, free = np.array([1.0, 0.5, 0.25, 1.0]), np.array([True, True])
    bent = tuple(bundle.with_parameters(c, np.array([1e-3, -2e-3, 0.0, 1e-3])) for c in STATIONS[2])
    stations = (STATIONS[0], STATIONS[1], bent)

    problem = device_bundle._DeviceBundle(looks, 1e-3, 3.0, share, bundle.free_parameters(free))

    def equations(change: Array, by_pose: Array) -> SchurEquations:
        state = bundle.BundleState(*stations, np.zeros((0, 3)))
        moved = bundle.retract_stations(state, change)
        shifted = device_bundle._BundledDevices(moved, poses.stepped(by_pose))
        return problem.linearize(shifted, np.arange(1))

    def cost(change: Array, by_pose: Array) -> float:
        return float(equations(change, by_pose).cost[0])

    none, still = np.zeros((2, 10)), np.zeros((4, 12))
    here = equations(none, still)
    for k in range(20):
        if k % 10 == 8:
            continue  # the first phase is the same in every unit and is not estimated
        step = none.copy()
        step.flat[k] = 1e-6
        numeric = (cost(step, still) - cost(-step, still)) / 2e-6
        assert numeric == pytest.approx(here.gradient[k], rel=1e-4, abs=1e-2)
    for k in range(12):
        step = still.copy()
        step[2, k] = 1e-6
        numeric = (cost(none, step) - cost(none, -step)) / 2e-6
        assert numeric == pytest.approx(here.block_gradient[2, k], rel=1e-4, abs=1e-2)


def test_the_adjustment_finds_a_station_that_was_put_wrong() -> None:
    looks, poses = world(30, 60, noise=1e-4)
    wrong = STATIONS[0].copy()
    wrong[1] += [0.05, -0.08, 0.03]
    turned = STATIONS[1].copy()
    turned[1] = rotation_exp([0.02, -0.03, 0.01]) @ turned[1]
    done = adjust_devices(
        looks,
        (wrong, turned, STATIONS[2]),
        poses,
        sigma_rad=1e-4,
        loss_scale_rad=3e-3,
        epoch_weight=np.ones(30),
        calibrate=np.array([False, False]),
    )
    off = np.r_[
        done.stations[0][1] - STATIONS[0][1],
        Rotation.from_matrix(done.stations[1][1] @ STATIONS[1][1].T).as_rotvec(),
    ]
    assert np.linalg.norm(off[:3]) < 5e-3
    assert off @ np.linalg.solve(done.covariance[1], off) < 25
    assert np.array_equal(done.stations[0][0], STATIONS[0][0])
    assert not np.any(done.covariance[0])


def test_no_step_flips_a_device() -> None:
    looks, poses = world(2, 30)
    problem = pose_fit._PoseProblem(looks, STATIONS, 1e-4, np.ones((2, 1)), np.inf)
    step = np.zeros((2, 12))
    step[0, :6] = [0.1, 0.0, 0.0, 0.0, 0.0, 2.8]
    step[1, :6] = [0.1, 0.0, 0.0, 0.0, 0.0, 0.3]
    after = problem.retract(poses, step)
    turn = Rotation.from_matrix(after.rotation @ np.swapaxes(poses.rotation, 1, 2)).as_rotvec()
    np.testing.assert_allclose(turn[:, 2], [pose_fit.MAX_ROTATION_STEP_RAD, 0.3], rtol=1e-9)
    # The whole step is shortened, so that its direction stays.
    shift = after.position - poses.position
    np.testing.assert_allclose(shift[:, 0], [0.1 * pose_fit.MAX_ROTATION_STEP_RAD / 2.8, 0.1])


def test_padding_does_not_count() -> None:
    looks, poses = world(4, 30, noise=1e-3)
    few = replace(looks, is_observed=looks.is_observed & (looks.station == 1))
    trimmed = few.trimmed()
    assert trimmed.angle.shape[1] == few.is_observed.sum(axis=1).max() < few.angle.shape[1]
    np.testing.assert_array_equal(trimmed.is_observed.sum(axis=1), few.is_observed.sum(axis=1))
    options = {"sigma_rad": 1e-3, "loss_scale_rad": 3e-3}
    whole, short = (fit_poses(each, STATIONS, poses, **options) for each in (few, trimmed))
    np.testing.assert_allclose(short.poses.position, whole.poses.position, atol=1e-12)
    np.testing.assert_allclose(short.cost, whole.cost, rtol=1e-9)
