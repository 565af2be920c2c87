"""Corrections of odometry against simulated errors, and transforms of planar poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.landmarks.detection.trace import (
    OdometryDrift,
    Trace,
    compose,
    correct_constant_errors,
    known_drift,
    odometry_corrections,
    planar_rotation,
    relative,
    sensor_positions,
)

Array = NDArray[np.float64]

SINGLE_DRIFTS = {
    "scale": OdometryDrift(1, 0, 0, 0, 0),
    "rotation_scale": OdometryDrift(0, 1, 0, 0, 0),
    "curvature": OdometryDrift(0, 0, 1, 0, 0),
}


def driven(
    steps: Array, *, scale: float = 0, rotation_scale: float = 0, curvature: float = 0
) -> Array:
    """Return poses (n + 1, 3) after distances and rotations (n, 2) under constant errors."""
    poses = [np.zeros(3)]
    for path, rotation in steps:
        x, y, heading = poses[-1]
        rotated = rotation * (1 + rotation_scale) + curvature * abs(path)
        middle = heading + rotated / 2
        moved = path * (1 + scale)
        poses.append(
            np.array(
                [x + moved * math.cos(middle), y + moved * math.sin(middle), heading + rotated]
            )
        )
    return np.array(poses)


def winding(seed: int = 0) -> Array:
    """Return distances and rotations of straight lines, spins and arcs."""
    random = np.random.default_rng(seed)
    parts = []
    for _ in range(4):
        parts.append(np.tile([0.002, 0.0], (50, 1)))
        parts.append(np.tile([0.0, 0.02 * random.choice([-1, 1])], (40, 1)))
        parts.append(np.tile([0.002, 0.01], (40, 1)))
    return np.concatenate(parts)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("reference", [0, 200, -1])
def test_corrections_are_the_first_order_of_constant_errors(number: int, reference: int) -> None:
    """Half the error leaves a quarter of the residual."""
    measured = driven(winding())
    reference %= len(measured)
    name = list(SINGLE_DRIFTS)[number]
    residual = []
    for size in (0.02, 0.01):
        true = driven(winding(), **{name: size})
        # Both in the frame of the robot at the reference.
        true, observed = relative(true, true[reference]), relative(measured, measured[reference])
        errors = np.zeros(odometry_corrections(observed, reference, OdometryDrift()).shape[2])
        errors[number] = size
        drift = SINGLE_DRIFTS[name]
        residual.append(
            np.abs(
                observed + odometry_corrections(observed, reference, drift) @ errors - true
            ).max()
        )
        assert np.abs(observed - true).max() > 5 * residual[-1]
    assert residual[1] < 0.3 * residual[0] + 1e-12


@pytest.mark.parametrize("number", range(3))
def test_correct_constant_errors_removes_large_errors(number: int) -> None:
    measured = driven(winding(1))
    true = driven(winding(1), **{list(SINGLE_DRIFTS)[number]: 0.3})
    steady = np.zeros(3)
    steady[number] = 0.3
    result = correct_constant_errors(measured, steady, OdometryDrift(1, 1, 1))
    # Arcs are corrected by middle headings: the steps are small, not nothing.
    np.testing.assert_allclose(result, true, atol=2e-4)
    assert np.abs(measured - true).max() > 0.02


@pytest.mark.parametrize("reference", [0, 130, 479])
def test_corrections_are_zero_at_the_reference(reference: int) -> None:
    pose = driven(winding(2))
    assert not odometry_corrections(pose, reference, OdometryDrift())[reference].any()


def test_variance_of_the_random_walk_is_in_proportion_to_the_path() -> None:
    """For any sampling of the path."""
    path = np.zeros((601, 3))
    path[:, 0] = np.linspace(0, 1.5, 601)
    drift = OdometryDrift(0, 0, 0, 1e-3, 0.0)
    spread = np.einsum("nim,njm->nij", *[odometry_corrections(path, 0, drift)] * 2)
    # Once every 150 mm: the walk is linear in between.
    at = np.arange(60, 601, 60)
    np.testing.assert_allclose(spread[at, 0, 0], 1e-6 * np.arange(1, 11), rtol=1e-9)
    np.testing.assert_allclose(spread[at, 1, 1], spread[at, 0, 0], rtol=1e-9)
    sparse = odometry_corrections(path[::50], 0, drift)
    np.testing.assert_allclose(sparse[-1] @ sparse[-1].T, spread[-1], rtol=1e-9)


@pytest.mark.parametrize("length", [0.04, 0.2, 0.77])
def test_random_walk_of_a_fraction_of_a_unit(length: float) -> None:
    """A path that is no whole number of units has a variance in proportion to its length."""
    path = np.zeros((101, 3))
    path[:, 0] = np.linspace(0, length, 101)
    last = odometry_corrections(path, 0, OdometryDrift(0, 0, 0, 1e-3, 0.0))[-1]
    assert (last @ last.T)[0, 0] == pytest.approx(1e-6 * length / 0.15)


def test_random_walk_of_heading_moves_the_position() -> None:
    path = np.zeros((601, 3))
    path[:, 0] = np.linspace(0, 1.5, 601)
    last = odometry_corrections(path, 0, OdometryDrift(0, 0, 0, 0.0, 1e-2))[-1]
    spread = last @ last.T
    assert spread[2, 2] == pytest.approx(1e-4 * 10)
    # Brownian heading integrated over a path s of n units: variance sigma^2 n s^2 / 3.
    assert spread[1, 1] == pytest.approx(1e-4 * 10 * 1.5**2 / 3, rel=0.02)


poses = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@settings(deadline=None, max_examples=40)
@given(poses, poses)
def test_relative_is_the_inverse_of_compose(frame: Array, pose: Array) -> None:
    local = relative(pose[None], frame)
    np.testing.assert_allclose(compose(frame, local)[0], pose, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(poses)
def test_sensor_positions(pose: Array) -> None:
    position_m = np.array([[0.03, 0.01], [-0.02, 0.005]])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    want = pose[:2] + position_m @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(sensor_positions(pose[None], position_m)[0], want, atol=1e-12)


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(st.integers(1, 300), st.integers(1, 80), st.data())
def test_thinned_keeps_the_reference_and_the_number_of_samples(
    count: int, most: int, data: st.DataObject
) -> None:
    reference = data.draw(st.integers(0, count - 1))
    pose = np.zeros((count, 3))
    pose[:, 0] = np.arange(count) - reference
    trace = Trace(
        pose,
        odometry_corrections(pose, reference, OdometryDrift()),
        np.zeros((count, 4)),
        np.zeros((4, 2)),
        np.ones(count),
        reference,
    )
    thin = trace.thinned(most)
    assert len(thin) <= most
    assert thin.pose[thin.reference, 0] == 0
    assert thin.thinning * len(thin) == pytest.approx(count, abs=thin.thinning)


def test_lag_shifts_the_path_in_time() -> None:
    """On an arc with increasing speed, which a circle of another radius would not explain."""
    time = np.linspace(0, 2, 401)
    angle = 0.3 * time + 0.4 * time**2

    def path(at: Array) -> Array:
        own = 0.3 * at + 0.4 * at**2
        return np.column_stack([0.2 * np.sin(own), 0.2 - 0.2 * np.cos(own), own])

    lag, reference = 0.01, 150
    rate = (0.3 + 0.8 * time)[:, None]
    velocity = rate * np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), np.ones(401)])
    observed = path(time - lag)
    origin = observed[reference]
    local = relative(observed, origin)
    drift = OdometryDrift(0, 0, 0, 0, 0, lag_s=1.0)
    turned = velocity @ planar_rotation(origin[2])
    column = odometry_corrections(local, reference, drift, turned)[:, :, 3]
    true = relative(path(time), path(time)[reference])
    assert np.abs(local - true).max() > 3e-3
    np.testing.assert_allclose(local + lag * column, true, atol=2e-4)
    assert not odometry_corrections(local, reference, drift)[:, :, 3].any()


def test_known_noise_and_lag_replace_the_drift() -> None:
    drift = OdometryDrift()
    known = known_drift(drift, math.radians(1), 0.02)
    heading_sigma = known.walk_rad / math.sqrt(0.15)
    assert math.degrees(heading_sigma) == pytest.approx(1)
    assert known.walk_m / known.walk_rad == pytest.approx(drift.walk_m / drift.walk_rad)
    assert known.lag_s == 0
    assert known_drift(drift, None, None) == drift
