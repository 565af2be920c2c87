"""Motion of the bar: poses of simple motions, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.polaris.detection.motion import MOTION_GROUPS, Motion

Array = NDArray[np.float64]

PATH_M = np.linspace(-0.1, 0.1, 41)


def motion_of(**coefficients: Array) -> Motion:
    motion = Motion.straight(PATH_M, 0.0, 0.01)
    change = np.zeros(len(motion.coefficients))
    for name, values in coefficients.items():
        change[motion.groups[name]] = values
    return motion.with_added(change)


def test_the_first_coefficient_of_the_curve_is_a_circle() -> None:
    radius = 0.2
    poses = motion_of(curve=np.array([0.1 / radius, 0, 0])).poses(PATH_M)
    distance = np.hypot(poses.position_m[:, 0], poses.position_m[:, 1] - radius)
    np.testing.assert_allclose(distance, radius, atol=2e-7)
    np.testing.assert_allclose(poses.yaw_rate, 1 / radius)
    yaw = np.arctan2(poses.rotation[:, 1, 0], poses.rotation[:, 0, 0])
    np.testing.assert_allclose(yaw, PATH_M / radius, atol=1e-12)


@pytest.mark.parametrize("group", ["curve", "yaw"])
def test_the_heading_is_zero_in_the_middle(group: str) -> None:
    size = len(Motion.straight(PATH_M, 0.0, 0.01).group_sigmas[group])
    poses = motion_of(**{group: np.linspace(0.02, 0.05, size)}).poses(np.array([0.0]))
    np.testing.assert_allclose(poses.rotation[0], np.eye(3), atol=1e-12)


def test_every_group_moves_the_bar() -> None:
    straight = Motion.straight(PATH_M, 0.0, 0.01)
    assert straight.is_straight
    assert tuple(straight.groups) == MOTION_GROUPS
    for name, sigmas in straight.group_sigmas.items():
        poses = motion_of(**{name: sigmas}).poses(PATH_M)
        moved = np.abs(poses.position_m - straight.poses(PATH_M).position_m).max()
        rotated = np.abs(poses.rotation - np.eye(3)).max()
        assert max(moved / 1e-4, rotated / 1e-3) > 1


def test_planar_derivatives_are_those_of_the_poses() -> None:
    rng = np.random.default_rng(3)
    motion = Motion.straight(PATH_M, 0.0, 0.01)
    motion = motion.with_added(motion.sigmas * rng.normal(size=len(motion.sigmas)))
    # Roll and pitch change the heading of the axis to second order only.
    level = motion.coefficients.copy()
    level[motion.groups["attitude"]] = level[motion.groups["rocking"]] = 0.0
    motion = motion.with_added(level - motion.coefficients)
    derivatives = motion.planar_derivatives(PATH_M, 0.02)

    def planar(moved: Motion, crab_rad: float) -> Array:
        poses = moved.poses(PATH_M, crab_rad)
        yaw = np.arctan2(poses.rotation[:, 1, 0], poses.rotation[:, 0, 0])
        return np.column_stack([poses.position_m[:, :2], yaw])

    step = 1e-6
    for k, change in enumerate(step * np.eye(len(level))):
        slope = planar(motion.with_added(change), 0.02) - planar(motion.with_added(-change), 0.02)
        np.testing.assert_allclose(derivatives[..., 1 + k], slope / (2 * step), atol=1e-7)
    slope = planar(motion, 0.02 + step) - planar(motion, 0.02 - step)
    np.testing.assert_allclose(derivatives[..., 0], slope / (2 * step), atol=1e-7)
