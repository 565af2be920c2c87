"""Bundle adjustment: against scipy on the independent model, and against noise draws."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from locatk.core.geometry import rotation_exp, umeyama
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    PHASE,
    PHASE_TILT_SIGMA_RAD,
    TILT,
    Calibration,
)
from locatk.core.lighthouse.scene import bundle_adjustment
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState, adjust_bundle

Array = NDArray[np.float64]


def factory(lamp: Any) -> Calibration:
    rows = [
        [p.phase, p.tilt, p.curve, p.gibmag, p.gibpha, p.ogeemag, p.ogeephase] for p in lamp.planes
    ]
    return Calibration(np.array(rows), "factory")


def rig_of(lamps: Any, points: Array, calibrations: Any = None) -> BundleState:
    return BundleState(
        np.stack([s.position for s in lamps]),
        np.stack([s.rotation for s in lamps]),
        tuple(map(factory, lamps)) if calibrations is None else calibrations,
        points,
    )


def angles_of(lamps: Any, points: Array) -> Array:
    return np.stack([s.angles(points) for s in lamps], axis=1)


def shaken(rig: BundleState, size: float, seed: int = 0, planar: bool = False) -> BundleState:
    rng = np.random.default_rng(seed)
    move = rng.normal(0, size, rig.points.shape)
    if planar:
        move[:, 2] = 0
    return replace(
        rig,
        positions=rig.positions + rng.normal(0, size, rig.positions.shape),
        rotations=rotation_exp(rng.normal(0, size, rig.positions.shape)) @ rig.rotations,
        points=rig.points + move,
    )


def gap(rig: BundleState, truth: BundleState) -> float:
    """Largest distance of stations and points after the best similarity."""
    mine = np.concatenate([rig.positions, rig.points])
    true = np.concatenate([truth.positions, truth.points])
    return float(np.max(np.linalg.norm(umeyama(mine, true).apply(mine) - true, axis=1)))


@pytest.mark.parametrize("channels", [(1, 2), (1, 2, 5)])
@pytest.mark.parametrize("planar", [True, False])
def test_exact_angles_lead_back_to_the_truth(
    world: Any, channels: tuple[int, ...], planar: bool
) -> None:
    lamps = world.lamps(*channels)
    truth = rig_of(lamps, world.curve(40, flat=planar))
    angles = angles_of(lamps, truth.points)
    done = adjust_bundle(
        angles,
        shaken(truth, 0.05, planar=planar),
        sigma_rad=1e-4,
        planar=planar,
        loss_scale_rad=1.0,
    )
    assert gap(done.state, truth) < 1e-4
    assert np.max(np.abs(done.residuals)) < 2e-6
    assert done.cost < 1e-2
    if planar:
        np.testing.assert_array_equal(done.state.points[:, 2], 0)


def test_same_optimum_as_a_general_solver(world: Any) -> None:
    # scipy, numeric derivatives, the model of libsurvive in its own axes; first station held.
    lamps = world.lamps(1, 2)
    points = world.curve(12, flat=False)
    rng = np.random.default_rng(3)
    sigma = 1e-3
    angles = angles_of(lamps, points) + rng.normal(0, sigma, (12, 2, 2))
    truth = rig_of(lamps, points)
    ours = adjust_bundle(angles, truth, sigma_rad=sigma, loss_scale_rad=1e3, max_iterations=200)

    second = lamps[1]
    base = np.linalg.norm(second.position - lamps[0].position)
    direction = (second.position - lamps[0].position) / base
    side = np.linalg.svd(direction[None])[2][1:]

    def miss(x: Array) -> Array:
        # The base line keeps its length: two angles turn it, three turn the station.
        toward = direction + x[:2] @ side
        where = lamps[0].position + base * toward / np.linalg.norm(toward)
        moved = replace(second, position=where, rotation=rotation_exp(x[2:5]) @ second.rotation)
        places = points + x[5:].reshape(-1, 3)
        return np.asarray((angles_of((lamps[0], moved), places) - angles).ravel() / sigma)

    theirs = least_squares(miss, np.zeros(5 + points.size), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-5)
    x = theirs.x
    toward = direction + x[:2] @ side
    best = BundleState(
        np.stack([lamps[0].position, lamps[0].position + base * toward / np.linalg.norm(toward)]),
        np.stack([lamps[0].rotation, rotation_exp(x[2:5]) @ second.rotation]),
        truth.calibrations,
        points + x[5:].reshape(-1, 3),
    )
    assert gap(ours.state, best) < 2e-4
    np.testing.assert_allclose(ours.residuals.ravel() / sigma, theirs.fun, atol=5e-3)


@pytest.mark.parametrize("dims", [2, 3])
def test_gauge_directions_contain_motions_of_everything(world: Any, dims: int) -> None:
    positions = np.stack([lamp.position for lamp in world.lamps(1, 2, 5)])
    directions = bundle_adjustment._gauge_directions(positions, dims)
    assert directions.shape == (30, {2: 4, 3: 7}[dims])
    for axis in np.eye(3)[{2: [2], 3: [0, 1, 2]}[dims]]:
        rotation = np.zeros((3, 10))
        rotation[:, bundle_adjustment.POSITION] = np.cross(axis, positions)
        rotation[:, bundle_adjustment.ROTATION] = axis
        inside = directions @ (directions.T @ rotation.ravel())
        np.testing.assert_allclose(inside, rotation.ravel(), atol=1e-12)


@pytest.fixture(scope="module", params=[True, False], ids=["planar", "space"])
def draws(world: Any, request: pytest.FixtureRequest) -> list[tuple[Array, Array, Array]]:
    """For each of two stations: principal directions of its error over 100 draws of noise,
    the standard deviations found along them, and those stated."""
    lamps = world.lamps(1, 2)
    truth = rig_of(lamps, world.curve(20, flat=request.param))
    exact = angles_of(lamps, truth.points)
    rng = np.random.default_rng(0)
    sigma = 2e-4
    errors, stated = [], []
    for _ in range(100):
        noisy = exact + rng.normal(0, sigma, exact.shape)
        done = adjust_bundle(
            noisy, truth, sigma_rad=sigma, planar=request.param, loss_scale_rad=1e3
        )
        turn = Rotation.from_matrix(
            done.state.rotations @ np.swapaxes(truth.rotations, 1, 2)
        ).as_rotvec()
        errors.append(np.concatenate([done.state.positions - truth.positions, turn], axis=1))
        stated.append(done.station_covariance[:, :6, :6])
    result = []
    for i in range(2):
        values, vectors = np.linalg.eigh(np.cov(np.array(errors)[:, i].T))
        told = np.einsum("ik,ij,jk->k", vectors, np.mean(stated, axis=0)[i], vectors)
        result.append((vectors, np.sqrt(np.maximum(values, 0)), np.sqrt(told)))
    return result


@pytest.mark.slow
def test_covariance_of_stations_is_that_of_noise_draws(draws: Any) -> None:
    for _, found, told in draws:
        large = found > 0.1 * found[-1]
        np.testing.assert_allclose(told[large], found[large], rtol=0.3)


@pytest.mark.slow
def test_covariance_excludes_the_gauge(draws: Any) -> None:
    # Moving, turning and scaling the whole rig is held: nothing is known or unknown there.
    for _, found, told in draws:
        np.testing.assert_allclose(told, found, rtol=0.3, atol=0.02 * found[-1])


@pytest.mark.slow
def test_known_points_fix_a_station_without_gauge(world: Any) -> None:
    lamps = world.lamps(1)
    truth = rig_of(lamps, world.curve(15, flat=True))
    exact = angles_of(lamps, truth.points)
    rng = np.random.default_rng(0)
    sigma = 2e-4
    errors, told = [], []
    for _ in range(100):
        done = adjust_bundle(
            exact + rng.normal(0, sigma, exact.shape),
            truth,
            sigma_rad=sigma,
            planar=True,
            fixed_points=True,
            loss_scale_rad=1e3,
        )
        turn = Rotation.from_matrix(
            done.state.rotations @ np.swapaxes(truth.rotations, 1, 2)
        ).as_rotvec()
        errors.append(np.r_[(done.state.positions - truth.positions)[0], turn[0]])
        told.append(done.station_covariance[0, :6, :6])
        np.testing.assert_array_equal(done.state.points, truth.points)
    found = np.cov(np.array(errors).T)
    stated = np.mean(told, axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(stated)), np.sqrt(np.diag(found)), rtol=0.3)
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(stated), errors)
    assert nees.mean() == pytest.approx(6, rel=0.2)


def test_observable_tilt_and_phase_are_estimated(world: Any) -> None:
    # Four stations around: the shape of the room tells the tilt of the planes.
    lamps = world.lamps(1, 2, 5, 16)
    points = world.curve(100, flat=False)
    angles = angles_of(lamps, points)
    start = rig_of(lamps, points, (GENERIC_CALIBRATION,) * 4)
    done = adjust_bundle(angles, start, sigma_rad=1e-3)
    for lamp, calibration in zip(lamps, done.state.calibrations, strict=True):
        true = factory(lamp).sweeps[:, TILT]
        before = np.abs(GENERIC_CALIBRATION.sweeps[:, TILT] - true).max()
        after = np.abs(calibration.sweeps[:, TILT] - true).max()
        assert after < max(before, 1.5e-3)
        assert calibration.source == "estimated"
        # Only tilt and phase move, and the first phase is zero by definition.
        others = [c for c in range(7) if c not in (TILT, PHASE)]
        np.testing.assert_array_equal(
            calibration.sweeps[:, others], GENERIC_CALIBRATION.sweeps[:, others]
        )
        assert calibration.sweeps[0, PHASE] == pytest.approx(0, abs=1e-6)


def test_priors_constrain_unobservable_parameters(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(4, flat=True)
    done = adjust_bundle(
        angles_of(lamps, points),
        rig_of(lamps, points, (GENERIC_CALIBRATION,) * 2),
        sigma_rad=1e-3,
        planar=True,
    )
    for calibration in done.state.calibrations:
        change = calibration.sweeps - GENERIC_CALIBRATION.sweeps
        assert np.all(np.abs(change[:, TILT]) < 3 * PHASE_TILT_SIGMA_RAD[:, 1])
        assert np.abs(change[1, PHASE]) < 3 * PHASE_TILT_SIGMA_RAD[1, 0]


def test_factory_calibration_is_never_touched(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(30, flat=False)
    mixed = (factory(lamps[0]), GENERIC_CALIBRATION)
    done = adjust_bundle(angles_of(lamps, points), rig_of(lamps, points, mixed), sigma_rad=1e-3)
    assert done.state.calibrations[0] is mixed[0]
    assert done.state.calibrations[1].source == "estimated"
    held = adjust_bundle(
        angles_of(lamps, points), rig_of(lamps, points, mixed), sigma_rad=1e-3, calibrate=False
    )
    assert held.state.calibrations == mixed


def test_outliers_weigh_little(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    truth = rig_of(lamps, world.curve(100, flat=False))
    rng = np.random.default_rng(5)
    angles = angles_of(lamps, truth.points) + rng.normal(0, 1e-4, (100, 3, 2))
    wrong = rng.random(angles.shape) < 0.05
    angles[wrong] += rng.uniform(0.05, 0.17, np.count_nonzero(wrong))
    done = adjust_bundle(angles, truth, sigma_rad=1e-4)
    clean = ~wrong.any(axis=(1, 2))
    assert np.median(done.weights[wrong]) < 0.05
    assert np.median(done.weights[clean]) > 0.95
    some = replace(done.state, points=done.state.points[clean])
    assert gap(some, replace(truth, points=truth.points[clean])) < 5e-3


def test_unseen_angles_take_no_part(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    truth = rig_of(lamps, world.curve(60, flat=False))
    angles = angles_of(lamps, truth.points)
    rng = np.random.default_rng(1)
    hidden = rng.random((60, 3)) < 0.3
    hidden[hidden.sum(axis=1) > 1] = False
    angles[hidden] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = adjust_bundle(angles, shaken(truth, 0.02), sigma_rad=1e-4)
    np.testing.assert_array_equal(np.isnan(done.residuals), np.isnan(angles))
    np.testing.assert_array_equal(np.isnan(done.weights), np.isnan(angles))
    assert gap(done.state, truth) < 5e-4


def test_a_start_outside_the_cone_is_no_crash(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(30, flat=False)
    truth = rig_of(lamps, points)
    start = points.copy()
    start[3] = lamps[0].position + lamps[0].rotation @ [0.05, 0, 1.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = adjust_bundle(angles_of(lamps, points), replace(truth, points=start), sigma_rad=1e-4)
    others = np.delete(np.arange(30), 3)
    some = replace(done.state, points=done.state.points[others])
    assert gap(some, replace(truth, points=points[others])) < 1e-3


def test_the_frame_does_not_matter(world: Any) -> None:
    # Same data in another unit and frame: same residuals, covariance by the rule.
    lamps = world.lamps(1, 2)
    points = world.curve(25, flat=False)
    rng = np.random.default_rng(8)
    angles = angles_of(lamps, points) + rng.normal(0, 3e-4, (25, 2, 2))
    rig = rig_of(lamps, points)
    here = adjust_bundle(angles, rig, sigma_rad=3e-4, loss_scale_rad=1e3)
    turn = rotation_exp(np.array([0.3, -0.2, 1.1]))
    there_rig = BundleState(
        5 * rig.positions @ turn.T + [1, 2, 3], turn @ rig.rotations, rig.calibrations,
        5 * rig.points @ turn.T + [1, 2, 3],
    )  # fmt: skip
    there = adjust_bundle(angles, there_rig, sigma_rad=3e-4, loss_scale_rad=1e3)
    assert there.cost == pytest.approx(here.cost, rel=1e-5)
    np.testing.assert_allclose(there.residuals, here.residuals, atol=2e-6)


def test_many_moments_share_the_error_of_the_model(world: Any) -> None:
    # Twice the moments beyond the limit do not make a scene sharper.
    lamps = world.lamps(1, 2)
    few, many = (world.curve(n, flat=False) for n in (100, 400))
    a, b = (
        adjust_bundle(angles_of(lamps, p), rig_of(lamps, p), sigma_rad=1e-3).station_covariance
        for p in (few, many)
    )
    ratio = np.sqrt(np.trace(b[1, :3, :3]) / np.trace(a[1, :3, :3]))
    assert ratio == pytest.approx(1, abs=0.1)
    free = adjust_bundle(
        angles_of(lamps, many), rig_of(lamps, many), sigma_rad=1e-3, independent_points=10**6
    ).station_covariance
    assert np.sqrt(np.trace(free[1, :3, :3]) / np.trace(a[1, :3, :3])) == pytest.approx(
        0.5, abs=0.06
    )
