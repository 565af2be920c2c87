"""Candidate poses of a device under one station, and their refinement."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    IDEAL_CALIBRATION,
    Calibration,
    predict_angles,
)
from locatk.core.lighthouse.devices.pnp import candidate_poses, is_lit_from_behind
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    PoseFit,
    SweepObservations,
    fit_poses,
)
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


def observe(
    receiver: Receiver, position: Array, rotation: Array, calibration: Calibration
) -> Array:
    """Return the angles (k, 2); ``nan`` for photodiodes that face away from the station."""
    sensor_position = position + receiver.position_m @ rotation.T
    angles = predict_angles(sensor_position, calibration)
    angles[faces_away(receiver, position, rotation)] = np.nan
    return angles


def faces_away(receiver: Receiver, position: Array, rotation: Array) -> NDArray[np.bool_]:
    assert receiver.normal is not None
    sensor_position = position + receiver.position_m @ rotation.T
    return is_lit_from_behind(sensor_position, receiver.normal @ rotation.T)


def refine(angles: Array, receiver: Receiver, calibration: Calibration) -> PoseFit:
    """Refine all candidates on all angles; the best one comes first."""
    candidates = candidate_poses(angles, receiver, calibration)
    sensor, plane = np.nonzero(np.isfinite(angles))
    shape = (len(candidates), len(sensor))
    observations = SweepObservations(
        np.broadcast_to(receiver.position_m[sensor], (*shape, 3)),
        np.zeros(shape, np.int64),
        np.broadcast_to(plane, shape),
        np.broadcast_to(angles[sensor, plane], shape),
        np.zeros(shape),
        np.ones(shape, bool),
    )
    fit = fit_poses(
        observations,
        (np.zeros((1, 3)), np.eye(3)[None], (calibration,)),
        DeviceStates.at_rest(
            np.stack([position for position, _ in candidates]),
            np.stack([rotation for _, rotation in candidates]),
        ),
        sigma_rad=SIGMA,
        loss_scale_rad=3 * SIGMA,
    )
    order = np.argsort(fit.cost)
    return PoseFit(
        fit.poses.take(order), fit.residual[order], fit.information[order], fit.cost[order]
    )


def pose_errors(fit: PoseFit, position: Array, rotation: Array) -> Array:
    """Return the errors (m, 6) of the refined poses in m and rad."""
    return np.c_[
        fit.poses.position - position,
        Rotation.from_matrix(fit.poses.rotation @ rotation.T).as_rotvec(),
    ]


def squared_distances(fit: PoseFit, position: Array, rotation: Array) -> Array:
    """Return the squared errors (m,) normalized by the covariance of the fit."""
    error = pose_errors(fit, position, rotation)
    return np.asarray(np.einsum("mi,mij,mj->m", error, fit.information[:, :6, :6], error))


def camera_rays(receiver: Receiver, position: Array, rotation: Array) -> Array:
    """Project the photodiodes into a camera at the station, by OpenCV; (k, 2)."""
    to_camera = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    turn = cv2.Rodrigues(to_camera @ rotation)[0]
    points, _ = cv2.projectPoints(
        receiver.position_m, turn, to_camera @ position, np.eye(3), np.zeros(5)
    )
    return points[:, 0]


def ideal_angles_of(points: Array) -> Array:
    """Return the rotor angles of ideal planes at +-30 degrees from image points.

    By the formula of kalman_measurement_model.md in bitcraze/crazyflie-firmware.
    """
    direction = np.c_[np.ones(len(points)), -points[:, 0], -points[:, 1]]
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    lift = direction[:, 2] / np.hypot(direction[:, 0], direction[:, 1]) * np.tan(np.pi / 6)
    return np.stack([azimuth - np.arcsin(lift), azimuth + np.arcsin(lift)], axis=1)


@pytest.mark.parametrize("rotation_vector", [[0.1, 0.2, -0.3], [2.0, -1.0, 0.5], [0.0, 3.0, 0.4]])
def test_the_pose_is_that_of_opencvs_camera(rotation_vector: list[float]) -> None:
    position, rotation = np.array([2.2, 0.5, -0.7]), rotation_exp(rotation_vector)
    angles = ideal_angles_of(camera_rays(TRACKER, position, rotation))
    angles[faces_away(TRACKER, position, rotation)] = np.nan
    candidates = candidate_poses(angles, TRACKER, IDEAL_CALIBRATION)
    # Without noise the candidate from all rays needs no refinement.
    assert min(np.linalg.norm(p - position) for p, _ in candidates) < 1e-3
    fit = refine(angles, TRACKER, IDEAL_CALIBRATION)
    assert fit.poses.position[0] == pytest.approx(position, abs=1e-6)
    assert np.linalg.norm(pose_errors(fit, position, rotation)[0, 3:]) < 1e-6


def test_the_fit_uses_photodiodes_with_one_plane() -> None:
    rng = np.random.default_rng(3)
    calibration = factory(1)
    position, rotation = np.array([2.0, -0.4, 0.3]), rotation_exp([0.5, 1.0, 0.2])
    angles = observe(TRACKER, position, rotation, calibration)
    full = np.flatnonzero(np.isfinite(angles[:, 0]))
    angles[full[4:], rng.integers(0, 2, len(full) - 4)] = np.nan
    angles += rng.normal(0, SIGMA, angles.shape)
    fit = refine(angles, TRACKER, calibration)
    reduced = np.full_like(angles, np.nan)
    reduced[full[:4]] = angles[full[:4]]
    reduced_fit = refine(reduced, TRACKER, calibration)
    variance, reduced_variance = (
        np.trace(np.linalg.inv(f.information[0, :6, :6])[:3, :3]) for f in (fit, reduced_fit)
    )
    assert variance < 0.5 * reduced_variance
    # The 99.9 % quantile of the chi-square distribution with 6 degrees of freedom.
    assert squared_distances(fit, position, rotation)[0] < 22.5


@pytest.mark.slow
def test_the_covariance_is_that_of_repeated_trials() -> None:
    rng = np.random.default_rng(5)
    calibration = factory(2)
    position, rotation = np.array([1.8, 0.3, 0.2]), rotation_exp([0.2, -0.4, 1.0])
    exact = observe(TRACKER, position, rotation, calibration)
    distances = [
        squared_distances(
            refine(exact + rng.normal(0, SIGMA, exact.shape), TRACKER, calibration),
            position,
            rotation,
        )[0]
        for _ in range(20)
    ]
    # The mean of a chi-square of 6 over 20 trials has a standard deviation of 0.77.
    assert 4.0 < np.mean(distances) < 8.0


def test_a_coplanar_device_has_two_candidates_of_which_one_is_right() -> None:
    rng = np.random.default_rng(7)
    calibration = factory(0)
    for _ in range(10):
        position = np.array([2.0, rng.uniform(-0.5, 0.5), rng.uniform(-1.2, -0.8)])
        rotation = rotation_exp(rng.normal(0, 0.3, 3))
        exact = observe(DECK, position, rotation, calibration)
        assert np.all(np.isfinite(exact))
        angles = exact + rng.normal(0, SIGMA, exact.shape)
        first, second, *_ = (r for _, r in candidate_poses(angles, DECK, calibration))
        assert np.linalg.norm(Rotation.from_matrix(first @ second.T).as_rotvec()) > 0.1
        fit = refine(angles, DECK, calibration)
        assert np.min(squared_distances(fit, position, rotation)) < 25


def test_the_refinement_tolerates_outliers() -> None:
    rng = np.random.default_rng(11)
    calibration = factory(4)
    position, rotation = np.array([2.5, 0.2, 0.1]), rotation_exp([1.0, 0.3, -0.5])
    angles = observe(TRACKER, position, rotation, calibration)
    angles += rng.normal(0, SIGMA, angles.shape)
    full = np.flatnonzero(np.isfinite(angles[:, 0]))
    angles[full[1], 0] += 0.05
    angles[full[3], 1] -= 0.2
    fit = refine(angles, TRACKER, calibration)
    assert squared_distances(fit, position, rotation)[0] < 30
    assert np.max(np.abs(fit.residual[0])) > 0.1


def test_minimal_sets_yield_a_candidate_without_outliers() -> None:
    position, rotation = np.array([2.5, 0.2, 0.1]), rotation_exp([1.0, 0.3, -0.5])
    angles = observe(TRACKER, position, rotation, IDEAL_CALIBRATION)
    full = np.flatnonzero(np.isfinite(angles[:, 0]))
    angles[full[1], 0] += 0.05
    angles[full[3], 1] -= 0.2
    candidates = candidate_poses(angles, TRACKER, IDEAL_CALIBRATION, minimal_sets=True)
    assert min(np.linalg.norm(p - position) for p, _ in candidates) < 0.01


def test_a_mirrored_receiver_is_lit_from_behind() -> None:
    """A deck whose photodiodes are numbered in the other sense is received from below."""
    position, rotation = np.array([2.0, 0.1, -1.0]), rotation_exp([0.1, 0.1, 0.4])
    mirrored = Receiver(DECK.position_m * [-1.0, 1.0, 1.0], DECK.normal)
    angles = observe(DECK, position, rotation, GENERIC_CALIBRATION)
    poses = refine(angles, mirrored, GENERIC_CALIBRATION).poses
    assert len(poses)
    for k in range(len(poses)):
        assert np.all(faces_away(mirrored, poses.position[k], poses.rotation[k]))


@pytest.mark.parametrize(("cosine", "is_behind"), [(-0.12, True), (-0.08, False), (0.5, False)])
def test_light_slightly_from_behind_is_received(cosine: float, is_behind: bool) -> None:
    direction = np.array([2.0, 0.0, 0.0])
    normal = np.array([-cosine, np.sqrt(1 - cosine**2), 0.0])
    assert bool(is_lit_from_behind(direction, normal)) == is_behind


def test_degenerate_observations_have_no_candidates() -> None:
    angles = observe(DECK, np.array([2.0, 0.0, -0.5]), np.eye(3), IDEAL_CALIBRATION)
    assert candidate_poses(angles, DECK, IDEAL_CALIBRATION)
    angles[2:, 0] = np.nan
    assert candidate_poses(angles, DECK, IDEAL_CALIBRATION) == []
    nothing = np.full((4, 2), np.nan)
    assert candidate_poses(nothing, DECK, IDEAL_CALIBRATION) == []
    line = Receiver(np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0]]))
    on_line = predict_angles(line.position_m + [2.0, 0.0, 0.0], IDEAL_CALIBRATION)
    assert candidate_poses(on_line, line, IDEAL_CALIBRATION) == []


def test_rays_far_off_the_forward_axis_are_ignored() -> None:
    angles = observe(DECK, np.array([2.0, 0.0, -0.5]), np.eye(3), IDEAL_CALIBRATION)
    angles[0] = [1.55, 1.56]  # an image coordinate of 63
    # Of three rays two are left, which determine no pose; of four the other three do.
    three = Receiver(DECK.position_m[:3])
    assert candidate_poses(angles[:3], three, IDEAL_CALIBRATION) == []
    positions = [p for p, _ in candidate_poses(angles, DECK, IDEAL_CALIBRATION)]
    assert min(np.linalg.norm(p - [2.0, 0.0, -0.5]) for p in positions) < 1e-3
    ball = observe(TRACKER, np.array([2.0, 0.0, 0.0]), np.eye(3), IDEAL_CALIBRATION)
    ball[np.flatnonzero(np.isfinite(ball[:, 0]))[0]] = [1.55, 1.56]
    (position, _), *_ = candidate_poses(ball, TRACKER, IDEAL_CALIBRATION)
    assert position == pytest.approx([2.0, 0.0, 0.0], abs=1e-3)
