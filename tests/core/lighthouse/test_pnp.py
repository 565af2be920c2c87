"""Pose of a device under one station: against OpenCV's camera, and against itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp, rotation_log
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    IDEAL_CALIBRATION,
    Calibration,
    predict_angles,
)
from locatk.core.lighthouse.devices.pnp import lit_from_behind, locate_device
from locatk.core.lighthouse.receiver import DECK, Receiver

Array = NDArray[np.float64]

SIGMA = 1.15e-4

BALL = np.array(
    [[np.cos(2.4 * k) * s, np.sin(2.4 * k) * s, c] for k in range(20)
     for c in [1 - (2 * k + 1) / 20] for s in [np.sqrt(1 - c * c)]]
)  # fmt: skip
"""Twenty directions spread over the sphere (a golden spiral)."""

TRACKER = Receiver(0.045 * BALL + [0.01, 0.0, 0.02], BALL)


def factory(unit: int) -> Calibration:
    row = FACTORY_UNITS[unit]
    sweeps = np.zeros((2, 7))
    sweeps[1, 0] = row[0]
    for column in range(6):
        sweeps[:, column + 1] = row[1 + 2 * column : 3 + 2 * column]
    return Calibration(sweeps, "factory")


def seen(receiver: Receiver, position: Array, rotation: Array, calibration: Calibration) -> Array:
    """(k, 2) angles; ``nan`` where the photodiode looks away."""
    place = position + receiver.position_m @ rotation.T
    angles = predict_angles(place, calibration)
    if receiver.normal is not None:
        angles[lit_from_behind(place, receiver.normal @ rotation.T)] = np.nan
    return angles


def camera_rays(receiver: Receiver, position: Array, rotation: Array) -> Array:
    """Image points (k, 2) by OpenCV, as a camera at the station sees the photodiodes."""
    to_camera = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    turn = cv2.Rodrigues(to_camera @ rotation)[0]
    points, _ = cv2.projectPoints(
        receiver.position_m, turn, to_camera @ position, np.eye(3), np.zeros(5)
    )
    return points[:, 0]


def ideal_angles_of(points: Array) -> Array:
    """Rotor angles of plain planes at +-30 degrees from image points, by the formula of
    crazyflie-firmware's kalman_measurement_model.md (facts 2.4)."""
    direction = np.c_[np.ones(len(points)), -points[:, 0], -points[:, 1]]
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    lift = direction[:, 2] / np.hypot(direction[:, 0], direction[:, 1]) * np.tan(np.pi / 6)
    return np.stack([azimuth - np.arcsin(lift), azimuth + np.arcsin(lift)], axis=1)


@pytest.mark.parametrize("turn", [[0.1, 0.2, -0.3], [2.0, -1.0, 0.5], [0.0, 3.0, 0.4]])
def test_the_pose_is_that_of_opencvs_camera(turn: list[float]) -> None:
    position, rotation = np.array([2.2, 0.5, -0.7]), rotation_exp(turn)
    angles = ideal_angles_of(camera_rays(TRACKER, position, rotation))
    place = position + TRACKER.position_m @ rotation.T
    angles[lit_from_behind(place, TRACKER.normal @ rotation.T)] = np.nan
    best = locate_device(angles, TRACKER, IDEAL_CALIBRATION)[0]
    assert best.position == pytest.approx(position, abs=1e-6)
    assert np.linalg.norm(rotation_log(best.rotation @ rotation.T)) < 1e-6
    assert best.from_behind == 0.0


def test_single_planes_count_and_half_seen_photodiodes_do_not_harm() -> None:
    rng = np.random.default_rng(3)
    calibration = factory(1)
    position, rotation = np.array([2.0, -0.4, 0.3]), rotation_exp([0.5, 1.0, 0.2])
    angles = seen(TRACKER, position, rotation, calibration)
    full = np.flatnonzero(np.isfinite(angles[:, 0]))
    angles[full[4:], rng.integers(0, 2, len(full) - 4)] = np.nan
    noisy = angles + rng.normal(0, SIGMA, angles.shape)
    best = locate_device(noisy, TRACKER, calibration)[0]
    few = np.full_like(noisy, np.nan)
    few[full[:4]] = noisy[full[:4]]
    worse = locate_device(few, TRACKER, calibration)[0]
    assert np.trace(best.covariance[:3, :3]) < 0.5 * np.trace(worse.covariance[:3, :3])
    off = np.r_[best.position - position, rotation_log(best.rotation @ rotation.T)]
    assert off @ np.linalg.solve(best.covariance, off) < 22.5  # chi-square of 6, 99.9 %


def test_the_covariance_is_that_of_many_trials() -> None:
    rng = np.random.default_rng(5)
    calibration = factory(2)
    position, rotation = np.array([1.8, 0.3, 0.2]), rotation_exp([0.2, -0.4, 1.0])
    clean = seen(TRACKER, position, rotation, calibration)
    distances = []
    for _ in range(60):
        best = locate_device(clean + rng.normal(0, SIGMA, clean.shape), TRACKER, calibration)[0]
        off = np.r_[best.position - position, rotation_log(best.rotation @ rotation.T)]
        distances.append(off @ np.linalg.solve(best.covariance, off))
    # The mean of a chi-square of 6 over 60 trials is within 1.5 of 6.
    assert 4.0 < np.mean(distances) < 8.0


def test_a_flat_device_far_away_has_two_readings_and_one_of_them_is_right() -> None:
    rng = np.random.default_rng(7)
    calibration = factory(0)
    for _ in range(10):
        position = np.array([2.0, rng.uniform(-0.5, 0.5), rng.uniform(-1.2, -0.8)])
        rotation = rotation_exp(rng.normal(0, 0.3, 3))
        clean = seen(DECK, position, rotation, calibration)
        assert np.all(np.isfinite(clean))
        readings = locate_device(clean + rng.normal(0, SIGMA, clean.shape), DECK, calibration)
        misses = [
            np.r_[r.position - position, rotation_log(r.rotation @ rotation.T)] for r in readings
        ]
        distances = [
            m @ np.linalg.solve(r.covariance, m) for m, r in zip(misses, readings, strict=True)
        ]
        assert min(distances) < 25
        assert 1 <= len(readings) <= 3
        costs = [r.cost for r in readings if r.from_behind < 0.3]
        assert costs == sorted(costs)


def test_reflections_are_outvoted() -> None:
    rng = np.random.default_rng(11)
    calibration = factory(4)
    position, rotation = np.array([2.5, 0.2, 0.1]), rotation_exp([1.0, 0.3, -0.5])
    angles = seen(TRACKER, position, rotation, calibration)
    angles += rng.normal(0, SIGMA, angles.shape)
    full = np.flatnonzero(np.isfinite(angles[:, 0]))
    angles[full[1], 0] += 0.05
    angles[full[3], 1] -= 0.2
    best = locate_device(angles, TRACKER, calibration)[0]
    off = np.r_[best.position - position, rotation_log(best.rotation @ rotation.T)]
    assert off @ np.linalg.solve(best.covariance, off) < 30
    assert abs(best.residual[full[3], 1]) > 0.1


def test_light_from_behind_comes_last() -> None:
    """A deck with its photodiodes numbered the other way round is seen from below."""
    position, rotation = np.array([2.0, 0.1, -1.0]), rotation_exp([0.1, 0.1, 0.4])
    mirrored = Receiver(DECK.position_m * [-1.0, 1.0, 1.0], DECK.normal)
    angles = seen(DECK, position, rotation, GENERIC_CALIBRATION)
    readings = locate_device(angles, mirrored, GENERIC_CALIBRATION)
    assert readings
    assert all(r.from_behind > 0.9 for r in readings)


def test_too_little_has_no_pose() -> None:
    angles = seen(DECK, np.array([2.0, 0.0, 0.0]), np.eye(3), IDEAL_CALIBRATION)
    angles[2:, 0] = np.nan
    assert locate_device(angles, DECK, IDEAL_CALIBRATION) == []
    assert locate_device(np.full((4, 2), np.nan), DECK, IDEAL_CALIBRATION) == []
    line = Receiver(np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0]]))
    assert (
        locate_device(
            seen(line, np.array([2.0, 0, 0]), np.eye(3), IDEAL_CALIBRATION), line, IDEAL_CALIBRATION
        )
        == []
    )
