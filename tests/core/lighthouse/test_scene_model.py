"""Scenes in another frame: poses, covariances and the floor follow."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.geometry import (
    Similarity,
    quaternion_from_matrix,
    rotation_exp,
    rotation_vector_from_quaternion,
)
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.model import JOINT_PARAMETERS

TO = Similarity(2.5, rotation_exp([0.4, -1.1, 2.0]), np.array([1.0, -2.0, 0.5]))
NONE = Calibration(np.zeros((2, 7)), "none")


def test_covariances_are_those_of_transformed_samples() -> None:
    rng = np.random.default_rng(3)
    size = 2 * JOINT_PARAMETERS
    root = 1e-4 * rng.normal(size=(size, size))
    covariance = root @ root.T
    stations = tuple(
        Station(channel, rng.normal(size=3), rotation_exp(rng.normal(size=3)), NONE, covariance=own)
        for channel, own in ((1, covariance[:6, :6]), (2, covariance[20:26, 20:26]))
    )
    moved = Scene(stations=stations, covariance=covariance).transformed(TO)

    samples = rng.multivariate_normal(np.zeros(size), covariance, 4000)
    errors = samples.copy()
    for k, (before, after) in enumerate(zip(stations, moved.stations, strict=True)):
        column = k * JOINT_PARAMETERS
        moves, turns = samples[:, column : column + 3], samples[:, column + 3 : column + 6]
        errors[:, column : column + 3] = TO.apply(before.position + moves) - after.position
        rotation = TO.rotation @ rotation_exp(turns) @ before.rotation @ after.rotation.T
        turned = rotation_vector_from_quaternion(quaternion_from_matrix(rotation))
        errors[:, column + 3 : column + 6] = turned
    expected = errors.T @ errors / len(errors)
    assert moved.covariance is not None
    sigma = np.sqrt(np.diagonal(expected))
    difference = (moved.covariance - expected) / np.outer(sigma, sigma)
    assert np.max(np.abs(difference)) < 0.1  # the noise of a correlation of 4000 samples is 0.016
    for k, station in enumerate(moved.stations):
        column = k * JOINT_PARAMETERS
        own = moved.covariance[column : column + 6, column : column + 6]
        assert station.covariance == pytest.approx(own, rel=1e-9)


def test_a_floor_is_raised_and_its_homography_follows() -> None:
    floor_map = np.array([[1.0, 0.1, 0.2], [0.3, 2.0, 0.1], [0.2, 0.1, 1.5]])
    station = Station(1, np.array([0.0, 0.0, 2.0]), np.eye(3), NONE, floor_map=floor_map)
    scene = Scene(stations=(station,), planar=True, floor_z=0.1)
    turn = Similarity(2.0, rotation_exp([0.0, 0.0, 0.7]), np.array([1.0, 2.0, 3.0]))
    moved = scene.transformed(turn)
    assert moved.floor_z == pytest.approx(3.2)
    ray = np.array([1.0, 0.2, -0.3])
    before, after = floor_map @ ray, moved.stations[0].floor_map @ ray
    point = turn.apply([before[1] / before[0], before[2] / before[0], 0.0])
    assert after[1:] / after[0] == pytest.approx(point[:2])
    assert scene.transformed(TO).stations[0].floor_map is None


@pytest.mark.parametrize(
    ("source", "scale", "is_on_floor", "is_level"),
    [
        ("markers", "markers", True, True),
        ("floor", "device", True, True),
        ("gravity", "device", False, True),
        ("station", "distance", False, False),
        ("station", "markers", False, False),
        (None, "markers", True, True),
        (None, "device", False, False),
    ],
)
def test_frames_that_are_level_and_on_the_floor(
    source: str | None, scale: str, is_on_floor: bool, is_level: bool
) -> None:
    scene = Scene(frame_source=source, scale=scale)
    assert (scene.is_on_floor, scene.is_level) == (is_on_floor, is_level)
