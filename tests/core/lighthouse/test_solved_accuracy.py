"""Predicted accuracy in solved scenes, against the solver's own adjustment of drawn units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.geometry import umeyama
from locatk.core.lighthouse.calibration import (
    FACTORY_LINEAR_PARAMETERS,
    GENERIC_CALIBRATION,
    MODEL_SIGMA_RAD,
    predict_angles,
)
from locatk.core.lighthouse.design.accuracy import AngleErrors
from locatk.core.lighthouse.design.solved_accuracy import predict_solved_positions
from locatk.core.lighthouse.localization.positions import estimate_positions
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState, adjust_bundle
from tests.core.lighthouse.rooms import looking_at

Array = np.ndarray


def stations(count: int) -> tuple[Array, Array]:
    azimuth = 2 * np.pi * np.arange(count) / max(count, 3) + 0.4
    position = np.stack([2.6 * np.cos(azimuth), 2.2 * np.sin(azimuth), 2.2 + 0 * azimuth], axis=1)
    return position, np.stack([looking_at(p, np.array([0.2, -0.1, 0.0])) for p in position])


def places(rng: np.random.Generator, planar: bool, count: int = 150) -> Array:
    high = 0.1 if planar else 1.0
    return rng.uniform([-1.6, -1.4, 0.1], [1.6, 1.4, high], (count, 3))


def reached_sigma(
    rng: np.random.Generator, position: Array, rotation: Array, points: Array, planar: bool
) -> float:
    """Solve the scene of drawn units with the solver's adjustment; return the rms error."""
    spread = FACTORY_LINEAR_PARAMETERS
    calibrations = []
    for _ in position:
        # A unit between two others, with the covariance of all: weights of unit length.
        weight = rng.normal(size=len(spread))
        deviation = weight @ (spread - spread.mean(axis=0)).reshape(len(spread), -1)
        mean = GENERIC_CALIBRATION.linear_parameters()
        unit = mean + deviation.reshape(2, 7) / np.sqrt(len(spread) - 1)
        calibrations.append(replace(GENERIC_CALIBRATION.with_linear_parameters(unit)))
    angles = np.stack(
        [
            predict_angles((points - p) @ r, c)
            for p, r, c in zip(position, rotation, calibrations, strict=True)
        ],
        axis=1,
    )
    floor = points - [0, 0, 0.1] if planar else points
    at = position - [0, 0, 0.1] if planar else position
    state = BundleState(at, rotation, (GENERIC_CALIBRATION,) * len(position), floor)
    solved = adjust_bundle(angles, state, sigma_rad=MODEL_SIGMA_RAD, planar=planar).state
    estimate = estimate_positions(
        angles,
        solved.positions,
        solved.rotations,
        solved.calibrations,
        floor_z=0.0 if planar else None,
    ).position
    dims = 2 if planar else 3
    to = umeyama(estimate[:, :dims], points[:, :dims])
    error = to.apply(estimate[:, :dims]) - points[:, :dims]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


@pytest.mark.slow
@pytest.mark.parametrize(("count", "planar"), [(2, True), (4, True), (2, False), (4, False)])
def test_predictions_agree_with_solved_scenes_of_drawn_units(count: int, planar: bool) -> None:
    rng = np.random.default_rng(count)
    position, rotation = stations(count)
    points = places(rng, planar)
    is_seen = np.ones((count, len(points)), bool)
    accuracy = predict_solved_positions(
        position, rotation, points, is_seen, is_planar=planar, errors=AngleErrors(0.0, 0.0)
    )
    predicted = np.sqrt(np.mean(accuracy.sigma_m**2))
    reached = [reached_sigma(rng, position, rotation, points, planar) for _ in range(40)]
    assert predicted == pytest.approx(np.sqrt(np.mean(np.square(reached))), rel=0.2)


def test_noise_adds_to_the_errors_of_the_scene() -> None:
    rng = np.random.default_rng(0)
    position, rotation = stations(3)
    points = places(rng, True)
    is_seen = np.ones((3, len(points)), bool)
    variance = {}
    for noise in (0.0, 3e-4):
        result = predict_solved_positions(
            position, rotation, points, is_seen, is_planar=True, errors=AngleErrors(noise, 0.0)
        )
        variance[noise] = result.sigma_m**2
        assert np.all(result.noise_sigma_m <= result.sigma_m)
    np.testing.assert_allclose(variance[3e-4] - variance[0.0], result.noise_sigma_m**2, rtol=1e-6)


def test_factory_data_make_positions_more_accurate() -> None:
    rng = np.random.default_rng(1)
    position, rotation = stations(3)
    points = places(rng, True)
    is_seen = np.ones((3, len(points)), bool)

    def rms(known: list[bool]) -> float:
        sigma = predict_solved_positions(
            position, rotation, points, is_seen, is_planar=True, has_factory_data=known
        ).sigma_m
        return float(np.sqrt(np.mean(sigma**2)))

    assert rms([True] * 3) < rms([True, True, False]) < rms([False] * 3)


def test_the_frame_has_no_errors_and_size_does_not_matter_but_for_scale() -> None:
    rng = np.random.default_rng(2)
    position, rotation = stations(2)
    points = places(rng, False)
    is_seen = np.ones((2, len(points)), bool)
    small = predict_solved_positions(position, rotation, points, is_seen, is_planar=False)
    large = predict_solved_positions(2 * position, rotation, 2 * points, is_seen, is_planar=False)
    turn = looking_at(np.zeros(3), np.array([0.3, 0.8, 0.5]))
    turned = predict_solved_positions(
        position @ turn.T + 3, turn @ rotation, points @ turn.T + 3, is_seen, is_planar=False
    )
    np.testing.assert_allclose(large.sigma_m, 2 * small.sigma_m, rtol=1e-3)
    np.testing.assert_allclose(turned.sigma_m, small.sigma_m, rtol=1e-6)


def test_places_that_no_stations_determine_are_infinite() -> None:
    rng = np.random.default_rng(3)
    position, rotation = stations(2)
    points = places(rng, False, 60)
    is_seen = np.ones((2, 60), bool)
    is_seen[1, :10] = False
    result = predict_solved_positions(position, rotation, points, is_seen, is_planar=False)
    assert np.all(np.isinf(result.sigma_m[:10]))
    assert np.all(np.isfinite(result.sigma_m[10:]))
    nothing = predict_solved_positions(
        position, rotation, points, np.zeros((2, 60), bool), is_planar=True
    )
    assert np.all(np.isinf(nothing.sigma_m))
