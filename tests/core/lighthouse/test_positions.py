"""Positions in a known scene: against meeting points, noise draws and a slow solver."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from locatk.core.kernels import kernels
from locatk.core.lighthouse.calibration import FACTORY_UNITS, Calibration
from locatk.core.lighthouse.localization import positions as positions_module
from locatk.core.lighthouse.localization.positions import (
    EPOCHS_PER_BLOCK,
    PositionEstimates,
    estimate_positions,
)

Array = NDArray[np.float64]
Rig = tuple[Array, Array, tuple[Calibration, ...]]


def factory(lamps: Any) -> Rig:
    """The scene as its stations know it themselves."""
    sweeps = [
        [[p.phase, p.tilt, p.curve, p.gibmag, p.gibpha, p.ogeemag, p.ogeephase] for p in s.planes]
        for s in lamps
    ]
    return (
        np.stack([s.position for s in lamps]),
        np.stack([s.rotation for s in lamps]),
        tuple(Calibration(np.array(rows), "factory") for rows in sweeps),
    )


def angles_of(lamps: Any, points: Array) -> Array:
    return np.stack([s.angles(points) for s in lamps], axis=1)


@pytest.mark.parametrize("channels", [(1, 2), (1, 2, 5), (1, 2, 5, 16)])
def test_exact_angles_give_exact_places(world: Any, channels: tuple[int, ...]) -> None:
    lamps = world.lamps(*channels)
    points = world.curve(80, flat=False)
    estimates = estimate_positions(angles_of(lamps, points), *factory(lamps))
    np.testing.assert_allclose(estimates.position, points, atol=3e-6)
    assert np.max(np.abs(estimates.residual)) < 1e-6
    np.testing.assert_array_equal(estimates.redundancy, 2 * len(channels) - 3)


@pytest.mark.parametrize("channels", [(1,), (1, 5)])
def test_on_a_floor_one_station_is_enough(world: Any, channels: tuple[int, ...]) -> None:
    lamps = world.lamps(*channels)
    points = world.curve(80, flat=True) + [0, 0, 0.07]
    estimates = estimate_positions(angles_of(lamps, points), *factory(lamps), floor_z=0.07)
    np.testing.assert_allclose(estimates.position, points, atol=1e-5)
    np.testing.assert_array_equal(estimates.redundancy, 2 * len(channels) - 2)
    assert np.all(estimates.position[:, 2] == 0.07)


def test_a_single_plane_helps_other_stations(world: Any) -> None:
    # Planes that only lean: a bent plane alone cannot be corrected, see below.
    plain = (world.Plane(tilt=-0.049), world.Plane(tilt=0.046))
    lamps = [replace(lamp, planes=plain) for lamp in world.lamps(1, 2)]
    points = world.curve(10, flat=False)
    angles = angles_of(lamps, points)
    angles[:, 1, 0] = np.nan
    estimates = estimate_positions(angles, *factory(lamps))
    np.testing.assert_allclose(estimates.position, points, atol=1e-6)
    np.testing.assert_array_equal(estimates.redundancy, 0)
    assert np.isnan(estimates.residual[:, 1, 0]).all()


def test_a_bent_plane_alone_is_left_out_and_not_counted(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(10, flat=False)
    angles = angles_of(lamps, points)
    angles[:, 1, 0] = np.nan
    estimates = estimate_positions(angles, *factory(lamps))
    np.testing.assert_allclose(estimates.position, points, atol=1e-3)
    counted = np.count_nonzero(np.isfinite(estimates.residual), axis=(1, 2))
    np.testing.assert_array_equal(estimates.redundancy, counted - 3)


@pytest.mark.skipif(kernels is None, reason="the compiled kernels were not built")
@pytest.mark.parametrize("channels", [(1,), (1, 2), (1, 2, 5, 16)])
@pytest.mark.parametrize("floor_z", [None, 0.07])
def test_the_kernel_equals_its_twin(
    world: Any, channels: tuple[int, ...], floor_z: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise, missing sweeps, points behind a station, and planes that do not intersect."""
    lamps = world.lamps(*channels)
    rng = np.random.default_rng(3)
    points = world.curve(EPOCHS_PER_BLOCK + 50, flat=floor_z is not None) + [0, 0, 0.07]
    angles = angles_of(lamps, points) + rng.normal(0, 1e-3, (len(points), len(channels), 2))
    angles[rng.random(angles.shape) < 0.1] = np.nan
    angles[:50] = rng.uniform(-2, 2, (50, *angles.shape[1:]))
    angles[50:60] = np.nan
    angles[60:70] = angles[60:70, :, :1]
    compiled = estimate_positions(angles, *factory(lamps), floor_z=floor_z)
    monkeypatch.setattr(positions_module, "kernels", None)
    twin = estimate_positions(angles, *factory(lamps), floor_z=floor_z)
    np.testing.assert_array_equal(compiled.redundancy, twin.redundancy)
    is_solved = np.isfinite(twin.position[:, 0])
    np.testing.assert_array_equal(is_solved, np.isfinite(compiled.position[:, 0]))
    assert np.any(is_solved) == (len(channels) > 1 or floor_z is not None)
    for name in ("position", "information", "residual"):
        expected, actual = getattr(twin, name), getattr(compiled, name)
        np.testing.assert_array_equal(np.isnan(actual), np.isnan(expected))
        # The first planes are random and almost parallel, so that rounding errors grow.
        for rows, tolerance in ((slice(0, 70), 1e-3), (slice(70, None), 1e-8)):
            np.testing.assert_allclose(
                actual[rows][is_solved[rows]],
                expected[rows][is_solved[rows]],
                rtol=tolerance,
                atol=tolerance,
            )


def test_the_unit_does_not_matter(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(30, flat=False)
    angles = angles_of(lamps, points) + np.random.default_rng(0).normal(0, 1e-3, (30, 2, 2))
    position, rotation, calibration = factory(lamps)
    metres = estimate_positions(angles, position, rotation, calibration)
    for unit in (1e-3, 1e3):
        other = estimate_positions(angles, position * unit, rotation, calibration)
        np.testing.assert_allclose(other.position, metres.position * unit, rtol=1e-8)
        np.testing.assert_allclose(other.residual, metres.residual, atol=1e-10)
        np.testing.assert_allclose(
            other.covariance(1e-4, False), metres.covariance(1e-4, False) * unit**2, rtol=1e-6
        )


@pytest.mark.parametrize("flat", [True, False])
def test_places_are_least_squares_of_the_angles(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(12, flat=flat)
    rng = np.random.default_rng(2)
    angles = angles_of(lamps, points) + rng.normal(0, 1e-3, (12, 3, 2))
    estimates = estimate_positions(angles, *factory(lamps), floor_z=0.0 if flat else None)
    dims = 2 if flat else 3
    for k in range(12):

        def miss(free: Array, k: int = k) -> Array:
            point = np.r_[free, np.zeros(3 - dims)][None]
            return (angles_of(lamps, point)[0] - angles[k]).ravel()

        best = least_squares(miss, points[k, :dims], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        np.testing.assert_allclose(estimates.position[k, :dims], best.x, atol=1e-4)
        np.testing.assert_allclose(estimates.residual[k].ravel(), best.fun, atol=3e-5)
        stated = np.linalg.inv(best.jac.T @ best.jac)
        np.testing.assert_allclose(
            np.linalg.inv(estimates.information[k, :dims, :dims]), stated, rtol=0.03, atol=0.01
        )


@pytest.mark.parametrize("flat", [True, False])
def test_covariance_is_that_of_noise_draws(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(8, flat=flat)
    rng = np.random.default_rng(0)
    sigma, draws = 3e-4, 2000
    angles = angles_of(lamps, points)[:, None] + rng.normal(0, sigma, (8, draws, 2, 2))
    estimates = estimate_positions(
        angles.reshape(-1, 2, 2), *factory(lamps), floor_z=0.0 if flat else None
    )
    dims = 2 if flat else 3
    error = (estimates.position.reshape(8, draws, 3) - points[:, None])[..., :dims]
    stated = estimates.covariance(sigma, flat).reshape(8, draws, 3, 3)[:, 0, :dims, :dims]
    for k in range(8):
        found = np.cov(error[k].T)
        np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(stated[k])), rtol=0.06)
    nees = np.einsum("kni,kij,knj->kn", error, np.linalg.inv(stated), error)
    assert nees.mean() == pytest.approx(dims, rel=0.05)
    # Chi square with `dims` degrees: 95 % below 5.99 and 7.81.
    assert np.mean(nees < (5.99 if flat else 7.81)) == pytest.approx(0.95, abs=0.01)


def test_residuals_measure_the_noise(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(3000, flat=False)
    rng = np.random.default_rng(0)
    angles = angles_of(lamps, points) + rng.normal(0, 5e-4, (3000, 3, 2))
    estimates = estimate_positions(angles, *factory(lamps))
    squares = np.sum(estimates.residual**2, axis=(1, 2)) / estimates.redundancy
    assert np.sqrt(squares.mean()) == pytest.approx(5e-4, rel=0.03)


def test_no_position_if_planes_do_not_intersect_in_a_point(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(6, flat=False)
    angles = angles_of(lamps, points)
    angles[0] = np.nan
    angles[1, 1] = np.nan  # one station: a ray
    angles[2, 1] = angles[2, 0, 0] = np.nan  # one plane
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimates = estimate_positions(angles, *factory(lamps))
        covariance = estimates.covariance(1e-4, False)
    np.testing.assert_array_equal(np.isnan(estimates.position).all(axis=1), [1, 1, 1, 0, 0, 0])
    np.testing.assert_array_equal(estimates.redundancy, [-3, -1, estimates.redundancy[2], 1, 1, 1])
    assert estimates.redundancy[2] < 0
    assert np.isnan(covariance[:3]).all()
    assert np.isfinite(covariance[3:]).all()
    assert np.all(estimates.max_residual[:3] == 0)


def test_no_place_behind_a_station(world: Any) -> None:
    (lamp,) = world.lamps(1)
    # The ray of a plane pair goes on behind the station, where it meets a raised floor.
    up = lamp.position + lamp.rotation @ [-2.0, 0.3, 0.1]
    ahead = lamp.position + lamp.rotation @ [2.0, -0.3, -0.1]
    rig = factory((lamp,))
    estimates = estimate_positions(lamp.angles(ahead[None])[None], *rig, floor_z=float(up[2]))
    assert np.isnan(estimates.position).all()


def test_a_ray_parallel_to_the_floor_gives_no_position(world: Any) -> None:
    level = world.Lamp(1, np.array([0.0, 0.0, 0.5]), np.eye(3), world.planes_of(FACTORY_UNITS[0]))
    angles = level.angles(np.array([[2.0, 0.0, 0.5]]))[None]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimates = estimate_positions(angles, *factory((level,)), floor_z=0.0)
    assert np.isnan(estimates.position[0]).all() or abs(estimates.position[0, 0]) > 100


def test_blocks_do_not_show(world: Any) -> None:
    lamps = world.lamps(1, 2)
    points = np.tile(world.curve(9, flat=False), (EPOCHS_PER_BLOCK // 9 + 3, 1))
    angles = angles_of(lamps, points)
    estimates = estimate_positions(angles, *factory(lamps))
    alone = estimate_positions(angles[-5:], *factory(lamps))
    for name in ("position", "information", "residual", "redundancy"):
        assert len(getattr(estimates, name)) == len(points)
        np.testing.assert_allclose(getattr(estimates, name)[-5:], getattr(alone, name), atol=1e-9)


def test_no_observations_give_no_result(world: Any) -> None:
    lamps = world.lamps(1, 2)
    estimates = estimate_positions(np.zeros((0, 2, 2)), *factory(lamps))
    assert isinstance(estimates, PositionEstimates)
    assert estimates.position.shape == (0, 3)
    assert estimates.max_residual.shape == (0,)
    assert estimates.covariance(1e-4, False).shape == (0, 3, 3)
