"""Predicted accuracy of visits, against magpylib's field and repeated estimates of its own."""

from __future__ import annotations

import math
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from locatk.core.errors import InputError
from locatk.core.landmarks.design.visit_accuracy import (
    VisitErrors,
    installation_covariance,
    predict_visit,
    straight_path,
)
from locatk.core.landmarks.landmark import Geometry, code_of, signs
from locatk.core.streaming.planar_filter import OdometryNoise

Array = NDArray[np.float64]

GEOMETRY = Geometry()
STEADY = OdometryNoise(heading_rad=0.0, distance_m=0.0, rotation_rad=0.0, slip_m=0.0, slip_rad=0.0)


def magpylib_readings(path: Array, code: int, errors: Array) -> Array:
    """Readings (n, 4) with errors of bars, sensors and odometry in SI units, by magpylib.

    ``errors``: x, y, heading of the path's middle; gain (4), offset (4), height; strength (4),
    x (4), y (4) of the bars; scale, rotation scale, drift of the odometry.
    """
    x, y, turn = errors[:3]
    gain, offset, height = errors[3:7], errors[7:11], errors[11]
    strength, bar_x, bar_y = errors[12:16], errors[16:20], errors[20:24]
    scale, rotation_scale, drift = errors[24:]
    middle = len(path) // 2
    poses = [path[middle] + [x, y, turn]]
    # Integrated from the middle in both directions: the true path of a robot with these wheels.
    for direction in (1, -1):
        pose, branch = poses[0], []
        for k in range(middle, len(path) - 1 if direction > 0 else 0, direction):
            step = path[k + direction] - path[k]
            length = float(np.hypot(*step[:2]))
            heading_change = (1 + rotation_scale) * step[2] + direction * drift * length
            course = math.atan2(step[1], step[0]) + (pose[2] - path[k, 2]) + (
                direction * drift * length + rotation_scale * step[2]
            ) / 2  # fmt: skip
            moved = (1 + scale) * length * np.array([math.cos(course), math.sin(course)])
            pose = pose + [*moved, heading_change]
            branch.append(pose)
        poses = [*poses, *branch] if direction > 0 else [*branch[::-1], *poses]
    magnets = []
    for k in range(4):
        angle = k * math.pi / 2
        polarization = GEOMETRY.remanence_t * signs(code)[k] * (1 + strength[k])
        place = [
            GEOMETRY.radius_m * math.cos(angle) + bar_x[k],
            GEOMETRY.radius_m * math.sin(angle) + bar_y[k],
            -GEOMETRY.bar_height_m / 2,
        ]
        bar = magpylib.magnet.Cuboid(
            polarization=(polarization, 0, 0),
            dimension=(GEOMETRY.bar_length_m, GEOMETRY.bar_width_m, GEOMETRY.bar_height_m),
            position=place,
        )
        bar.rotate_from_angax(math.degrees(angle) + 90, "z")
        magnets.append(bar)
    points = np.empty((len(path), 4, 3))
    for k, pose in enumerate(poses):
        for sensor in range(4):
            direction = pose[2] + sensor * math.pi / 2
            points[k, sensor] = [
                pose[0] + GEOMETRY.circle_m * math.cos(direction),
                pose[1] + GEOMETRY.circle_m * math.sin(direction),
                GEOMETRY.sensor_height_m + height,
            ]
    field = sum(bar.getB(points.reshape(-1, 3))[:, 2] for bar in magnets).reshape(-1, 4)
    return (1 + gain) * field + offset


def priors(errors: VisitErrors, noise: OdometryNoise) -> Array:
    return np.array(
        [1.0] * 3
        + [errors.gain] * 4
        + [errors.offset_t] * 4
        + [errors.height_m]
        + [errors.bar_strength] * 4
        + [errors.bar_position_m] * 8
        + [noise.scale, noise.rotation_scale, noise.drift_rad_per_m]
    )


def curved_path(offset_m: float, heading_rad: float, curvature_per_m: float) -> Array:
    """Path with points 4 mm apart, whose middle is next to the origin."""
    along = 0.004 * np.arange(-36, 37)
    heading = heading_rad + curvature_per_m * along
    step = 0.004 * np.column_stack([np.cos(heading), np.sin(heading)])
    mean = (step[1:] + step[:-1]) / 2
    position = np.vstack([[0.0, 0.0], np.cumsum(mean, axis=0)])
    position += offset_m * np.array([-math.sin(heading_rad), math.cos(heading_rad)]) - position[36]
    return np.column_stack([position, heading])


@pytest.mark.parametrize(
    ("code", "offset_m", "heading_rad", "curvature"),
    [("NNNS", 0.0, 0.3, 0.0), ("NSNS", 0.045, -2.0, 0.0), ("SSSS", 0.03, 1.0, 3.0)],
)
def test_covariance_is_that_of_magpylibs_derivatives(
    code: str, offset_m: float, heading_rad: float, curvature: float
) -> None:
    path = curved_path(offset_m, heading_rad, curvature)
    errors, noise = VisitErrors(), STEADY
    sigma = priors(errors, noise)
    step = np.where(np.arange(len(sigma)) < 3, 1e-5, 0.01 * sigma)
    jacobian = np.stack(
        [
            (
                magpylib_readings(path, code_of(code), step[k] * unit)
                - magpylib_readings(path, code_of(code), -step[k] * unit)
            ).ravel()
            / (2 * step[k])
            for k, unit in enumerate(np.eye(len(sigma)))
        ],
        axis=1,
    )
    readings = errors.rate_hz * 0.004 / 0.1
    information = jacobian.T @ jacobian * readings / errors.noise_t**2 + np.diag(sigma**-2.0)
    expected = np.linalg.inv(information)[:3, :3]
    predicted = predict_visit(GEOMETRY, path, signs(code_of(code)), noise=noise, errors=errors)
    np.testing.assert_allclose(
        np.sqrt(np.diag(predicted.covariance)), np.sqrt(np.diag(expected)), rtol=0.01
    )
    root = np.linalg.inv(np.linalg.cholesky(expected))
    np.testing.assert_allclose(
        np.linalg.eigvalsh(root @ predicted.covariance @ root.T), 1, rtol=0.03
    )


@pytest.mark.slow
def test_estimates_over_iron_scatter_as_predicted() -> None:
    # Only pose and offsets are unknown, so that a plain least squares is the solver's estimate.
    errors = VisitErrors(
        gain=0,
        height_m=0,
        bar_strength=0,
        bar_position_m=0,
        offset_t=0.05,
        disturbance_t=8e-5,
        disturbance_length_m=0.06,
    )
    noise = OdometryNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    path = curved_path(0.05, 0.7, 0.0)
    true = magpylib_readings(path, 7, np.zeros(27))
    sigma_t = errors.noise_t / math.sqrt(errors.rate_hz * 0.004 / 0.1)
    rng = np.random.default_rng(4)
    angle = path[:, 2, None] + np.arange(4) * math.pi / 2
    place = path[:, None, :2] + GEOMETRY.circle_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    flat = place.reshape(-1, 2)
    distance = np.linalg.norm(flat[:, None] - flat, axis=-1)
    iron = errors.disturbance_t**2 * np.exp(-0.5 * (distance / errors.disturbance_length_m) ** 2)
    drawn = rng.multivariate_normal(np.zeros(len(flat)), iron + np.eye(len(flat)) * sigma_t**2, 16)

    def residual(values: Array, measured: Array) -> Array:
        full = np.zeros(27)
        full[:3], full[7:11] = values[:3] * 1e-3, values[3:] * 1e-4
        return ((magpylib_readings(path, 7, full) - measured) / sigma_t).ravel()

    estimates = [
        least_squares(residual, np.zeros(7), args=(true + each.reshape(true.shape),)).x
        for each in drawn
    ]
    predicted = predict_visit(GEOMETRY, path, signs(7), noise=noise, errors=errors).covariance
    ratio = np.std(np.array(estimates)[:, :3] * 1e-3, axis=0) / np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(ratio, 1, atol=0.4)
    bound = predict_visit(
        GEOMETRY, path, signs(7), noise=noise, errors=replace(errors, disturbance_t=0.0)
    ).covariance
    assert np.all(np.diag(predicted) > 2 * np.diag(bound))


def test_field_that_is_the_same_everywhere_costs_nothing_if_offsets_are_unknown() -> None:
    free = VisitErrors(offset_t=0.1)
    iron = VisitErrors(offset_t=0.1, disturbance_t=1e-4, disturbance_length_m=100.0)
    path = straight_path(GEOMETRY, 0.02, 0.2)
    without, with_iron = (
        predict_visit(GEOMETRY, path, signs(7), errors=errors).covariance for errors in (free, iron)
    )
    np.testing.assert_allclose(with_iron, without, rtol=1e-3)


def test_iron_costs_accuracy_and_certainty() -> None:
    path = straight_path(GEOMETRY, 0.075, 0.2)
    clean, iron = (
        predict_visit(
            GEOMETRY,
            path,
            signs(7),
            errors=VisitErrors(disturbance_t=field_t, disturbance_length_m=0.05),
        )
        for field_t in (0.0, 3e-4)
    )
    assert np.all(np.diag(iron.covariance) > 1.2 * np.diag(clean.covariance))
    assert iron.misread_probability > 10 * clean.misread_probability


@settings(deadline=None, max_examples=15)
@given(
    st.floats(-0.07, 0.07),
    st.floats(-3.0, 3.0),
    st.sampled_from(["noise_t", "gain", "bar_strength", "bar_position_m", "offset_t", "height_m"]),
)
def test_no_error_makes_a_visit_better(offset_m: float, heading_rad: float, name: str) -> None:
    better, worse = (
        predict_visit(
            GEOMETRY,
            straight_path(GEOMETRY, offset_m, heading_rad),
            signs(code_of("NNNS")),
            errors=VisitErrors(**{name: factor * getattr(VisitErrors(), name)}),
        ).covariance
        for factor in (1.0, 2.0)
    )
    assert np.linalg.eigvalsh(worse - better).min() > -1e-12


def test_pass_turned_with_its_landmark_is_the_same() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    first, turned = (
        predict_visit(
            GEOMETRY, straight_path(GEOMETRY, 0.03, heading_rad), signs(code_of(letters))
        ).covariance
        for letters, heading_rad in (("NNSS", 0.4), ("SNNS", 0.4 + math.pi / 2))
    )
    np.testing.assert_allclose(turned, quarter @ first @ quarter.T, rtol=1e-6, atol=1e-14)


def test_distant_and_missing_landmarks_are_not_usable() -> None:
    far = predict_visit(GEOMETRY, straight_path(GEOMETRY, 0.12, 0.0), signs(7))
    none = predict_visit(GEOMETRY, straight_path(GEOMETRY, 0.0, 0.0), np.zeros(4))
    near = predict_visit(GEOMETRY, straight_path(GEOMETRY, 0.0, 0.0), signs(7))
    assert not far.is_usable
    assert not none.is_usable
    assert near.is_usable
    assert near.misread_probability < 1e-9 < far.misread_probability


def test_bar_that_is_missing_has_no_direction() -> None:
    path = straight_path(GEOMETRY, 0.0, 0.0)
    strength = signs(7) * [1, 1, 0, 1]
    accuracy = predict_visit(GEOMETRY, path, strength)
    assert accuracy.is_usable
    assert accuracy.misread_probability < 1e-9


def test_installation_acts_at_the_centre_and_by_its_lever() -> None:
    errors = VisitErrors(landmark_position_m=2e-3, landmark_heading_rad=0.01)
    covariance = installation_covariance(np.array([0.03, 0.0, 1.0]), errors)
    np.testing.assert_allclose(
        np.diag(covariance), [4e-6, 4e-6 + (0.03 * 0.01) ** 2, 1e-4], rtol=1e-12
    )
    assert covariance[1, 2] == pytest.approx(0.03 * 1e-4)


@pytest.mark.parametrize(
    "wrong",
    [{"noise_t": 0.0}, {"gain": -0.1}, {"rate_hz": math.nan}, {"disturbance_length_m": 0.0}],
)
def test_impossible_errors_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        VisitErrors(**wrong)
