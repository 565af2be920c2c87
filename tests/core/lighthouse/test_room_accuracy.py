"""Predicted accuracy, compared with positions that a triangulation computes from noisy angles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.design.accuracy import (
    AngleErrors,
    angle_gradients,
    information,
    predict_poses,
    predict_positions,
    variance_of,
)
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.receiver import DECK

NOISE = AngleErrors(calibration_rad=0.0)

STATIONS = np.array([[0.1, 0.2, 2.4], [4.8, 0.3, 2.2], [2.0, 4.9, 2.6]])
ROTATIONS = np.array(
    [
        rotation_exp([0, 0, yaw]) @ rotation_exp([0, 0.5, 0])
        for yaw in np.radians([40.0, 130.0, -85.0])
    ]
)


def rotor_angles(station: np.ndarray, rotation: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Find the rotor angles (..., 2) at which two tilted planes contain points, by bisection.

    A plane contains the horizontal direction of its rotor angle, and is tilted about it.
    """
    local = (point - station) @ rotation
    tilt = np.array([math.pi / 6, -math.pi / 6])

    def distance(angle: np.ndarray) -> np.ndarray:
        sideways = -np.sin(angle) * local[..., None, 0] + np.cos(angle) * local[..., None, 1]
        return np.cos(tilt) * sideways - np.sin(tilt) * local[..., None, 2]

    azimuth = np.arctan2(local[..., 1], local[..., 0])[..., None]
    low, high = azimuth - 1.5 + 0 * tilt, azimuth + 1.5 + 0 * tilt
    for _ in range(52):
        middle = 0.5 * (low + high)
        is_before = distance(middle) > 0
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    return 0.5 * (low + high)


def all_angles(point: np.ndarray) -> np.ndarray:
    """Return the angles (..., 6) of points under all stations."""
    return np.concatenate(
        [rotor_angles(s, r, point) for s, r in zip(STATIONS, ROTATIONS, strict=True)], axis=-1
    )


def triangulate(angles: np.ndarray, guess: np.ndarray, dims: int) -> np.ndarray:
    """Fit positions (n, 3) to angles (n, 6); the height is known if ``dims`` is 2."""
    position = np.tile(guess, (len(angles), 1))
    for _ in range(4):
        residual = angles - all_angles(position)
        jacobian = np.stack(
            [
                (all_angles(position + step) - all_angles(position - step)) / 2e-5
                for step in 1e-5 * np.eye(3)[:dims]
            ],
            axis=-1,
        )
        for row in range(len(position)):
            position[row, :dims] += np.linalg.lstsq(jacobian[row], residual[row], rcond=None)[0]
    return position


@pytest.mark.parametrize("is_planar", [False, True])
def test_covariance_is_that_of_triangulated_noise(is_planar: bool) -> None:
    point = np.array([2.1, 1.7, 0.4])
    dims = 2 if is_planar else 3
    rng = np.random.default_rng(5)
    angles = all_angles(point) + rng.normal(0, ANGLE_SIGMA_RAD, (400, 6))
    error = (triangulate(angles, point + [0.05, -0.05, 0.0], dims) - point)[:, :dims]
    predicted = predict_positions(
        STATIONS, ROTATIONS, point[None], np.ones((3, 1), bool), is_planar=is_planar, errors=NOISE
    )
    # Normalized errors: their mean square has a standard deviation of sqrt(2 dims / n) = 0.1.
    whitened = np.einsum("ni,ij,nj->n", error, np.linalg.inv(predicted.covariance[0]), error)
    assert whitened.mean() == pytest.approx(dims, rel=0.15)
    assert np.sqrt((error**2).sum(axis=1).mean()) == pytest.approx(
        predicted.noise_sigma_m[0], rel=0.1
    )


def test_gradients_are_differences_of_angles() -> None:
    points = np.random.default_rng(3).uniform([0.5, 0.5, 0], [4.5, 4.5, 1.5], (6, 3))
    gradient = angle_gradients(STATIONS, ROTATIONS, points)
    for s in range(3):
        for p, point in enumerate(points):
            for axis in range(3):
                step = np.eye(3)[axis] * 1e-5
                ahead, behind = (
                    rotor_angles(STATIONS[s], ROTATIONS[s], point + sign * step) for sign in (1, -1)
                )
                assert gradient[s, p, :, axis] == pytest.approx((ahead - behind) / 2e-5, abs=1e-6)


def test_places_that_a_plane_does_not_meet_have_no_gradient() -> None:
    """Beyond 60 degrees above or below the horizon of a station."""
    points = np.array([[1.0, 0, 1.7], [1.0, 0, 1.75]])
    gradient = angle_gradients(np.zeros((1, 3)), np.eye(3)[None], points)
    assert np.isfinite(gradient[0, 0]).all()
    assert np.isnan(gradient[0, 1]).any()


def test_errors_of_stations_are_those_of_displaced_stations() -> None:
    """Displace stations, triangulate with the designed ones, and compare in first order."""
    point = np.array([2.1, 1.7, 0.4])
    scale = np.array([0.02] * 3 + [0.01] * 3)
    root = scale[:, None] * np.random.default_rng(6).normal(size=(6, 6))
    covariance = root @ root.T
    expected = np.zeros((3, 3))
    gradient = angle_gradients(STATIONS, ROTATIONS, point[None])[:, 0].reshape(6, 3)
    for s in range(3):
        for k in range(6):
            step = 1e-6 * root[:, k] / np.linalg.norm(root[:, k])
            moved = rotor_angles(
                STATIONS[s] + step[:3], rotation_exp(step[3:]) @ ROTATIONS[s], point
            )
            change = np.zeros(6)
            change[2 * s : 2 * s + 2] = moved - rotor_angles(STATIONS[s], ROTATIONS[s], point)
            shift = np.linalg.lstsq(gradient, change, rcond=None)[0] / 1e-6
            shift *= np.linalg.norm(root[:, k])
            expected += np.outer(shift, shift)
    seen = np.ones((3, 1), bool)
    predicted = predict_positions(
        STATIONS,
        ROTATIONS,
        point[None],
        seen,
        is_planar=False,
        errors=NOISE,
        station_covariances=[covariance] * 3,
    )
    added = predicted.covariance[0] - predicted.noise_covariance[0]
    assert added == pytest.approx(expected, rel=1e-3, abs=1e-8)


def test_a_station_determines_a_position_on_a_plane_only() -> None:
    point = np.array([[2.1, 1.7, 0.4]])
    seen = np.array([[True], [False], [False]])
    planar, spatial = (
        predict_positions(STATIONS, ROTATIONS, point, seen, is_planar=is_planar).sigma_m[0]
        for is_planar in (True, False)
    )
    assert planar < 0.01
    assert math.isinf(spatial)


def test_traces_of_inverses_are_those_of_numpy() -> None:
    rng = np.random.default_rng(8)
    for dims in (2, 3):
        root = rng.normal(size=(50, dims, dims + 1))
        matrix = root @ root.transpose(0, 2, 1)
        expected = np.trace(np.linalg.inv(matrix), axis1=1, axis2=2)
        assert variance_of(matrix) == pytest.approx(expected, rel=1e-9)
        row = rng.normal(size=(200, dims))
        assert np.isinf(variance_of(row[:, :, None] * row[:, None])).all()


def test_information_is_additive_and_weighted() -> None:
    points = np.array([[2.1, 1.7, 0.4]])
    gradient = angle_gradients(STATIONS, ROTATIONS, points)
    seen = np.array([[True], [True], [False]])
    info = information(gradient, seen, 3, np.full((3, 1, 2), 2e-4))
    rows = gradient[:2, 0].reshape(4, 3)
    assert info.sum(axis=0)[0] == pytest.approx(rows.T @ rows / 4e-8)


def test_pose_of_a_deck_is_that_of_a_linear_fit() -> None:
    """Fit position and rotation to noisy angles of four photodiodes by numeric derivatives."""
    point = np.array([2.1, 1.7, 0.4])

    def angles(state: np.ndarray) -> np.ndarray:
        places = point + state[:3] + DECK.position_m @ rotation_exp(state[3:]).T
        return np.concatenate(
            [
                rotor_angles(s, r, place)
                for place in places
                for s, r in zip(STATIONS, ROTATIONS, strict=True)
            ]
        )

    jacobian = np.stack(
        [(angles(step) - angles(-step)) / 2e-4 for step in 1e-4 * np.eye(6)], axis=1
    )
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    predicted = predict_poses(
        STATIONS, ROTATIONS, point[None], np.ones((3, 1), bool), DECK.position_m, errors=NOISE
    )
    assert predicted.covariance[0] == pytest.approx(ANGLE_SIGMA_RAD**2 * inverse, rel=1e-3)
    # A common error of each plane displaces the deck, but turns it little.
    common = predict_poses(
        STATIONS,
        ROTATIONS,
        point[None],
        np.ones((3, 1), bool),
        DECK.position_m,
        errors=AngleErrors(calibration_rad=4e-4),
    )
    assert common.sigma_m[0] > 2 * predicted.sigma_m[0]
    assert common.heading_sigma_rad[0] < 1.1 * predicted.heading_sigma_rad[0]
