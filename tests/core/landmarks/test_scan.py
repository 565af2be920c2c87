"""Initial guesses: the compiled loop against its twin, and the grid against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.kernels import kernels
from locatk.core.landmarks.detection import scan
from locatk.core.landmarks.detection.trace import (
    OdometryDrift,
    Trace,
    odometry_corrections,
    relative,
)
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.simulation.options import NONE
from locatk.core.landmarks.simulation.passes import SinglePass, simulate_passes

GEOMETRY = Geometry()

INTACT = scan.INTACT_STRENGTHS


def trace_of(one: SinglePass) -> Trace:
    """Return the true path, every third sample, in the frame of the middle one."""
    pose = np.column_stack(
        [one.truth.position[:, :2], heading_from_quaternion(one.truth.quaternion)]
    )[::3]
    middle = len(pose) // 2
    local = relative(pose, pose[middle])
    return Trace(
        local,
        odometry_corrections(local, middle, OdometryDrift()),
        one.samples.field_t[::3],
        one.samples.sensors.position_m,
        np.ones(len(pose)),
        middle,
    )


@pytest.mark.skipif(kernels is None, reason="no compiled kernels here")
def test_the_compiled_loop_is_its_twin() -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-0.12, 0.12, (50, 2))
    values = random.normal(0, 5e-3, 50)
    sigma = random.uniform(1e-4, 1e-3, 50)
    centres = random.uniform(-0.05, 0.05, (6, 2))
    headings = scan.FINE_GRID.headings()
    fast = scan.scan_costs(points, values, sigma, centres, headings, GEOMETRY, INTACT)
    table = scan._field_table(GEOMETRY)
    slow = scan.scan_costs_numpy(points, values, 1 / sigma**2, centres, headings, table, INTACT)
    np.testing.assert_allclose(fast, slow, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("code", range(16))
def test_the_truth_is_among_the_first(code: int) -> None:
    for one in simulate_passes(2, code, errors=NONE, seed=code, start=(0.3 * code, 0.2)):
        trace = trace_of(one)
        pose, which = scan.find_candidates(trace, GEOMETRY, INTACT, 10, scan.COARSE_GRID)
        # The landmark in the frame of the robot, which may be any of its four frames.
        middle = one.truth.position[::3][trace.reference, :2]
        heading = heading_from_quaternion(one.truth.quaternion)[::3][trace.reference]
        c, s = np.cos(heading), np.sin(heading)
        true = np.array([-(c * middle[0] + s * middle[1]), s * middle[0] - c * middle[1]])
        near = np.hypot(*(pose[:, :2] - true).T) < 1.5 * scan.COARSE_GRID.step_m
        rotation = np.remainder(pose[:, 2] + heading + np.pi / 4, np.pi / 2) - np.pi / 4
        near &= np.abs(rotation) < np.radians(15)
        assert signs(code).sum() in (INTACT[which] @ np.ones(4))[near]


def test_candidates_of_one_code_are_not_neighbours() -> None:
    trace = trace_of(simulate_passes(1, 7, errors=NONE, seed=1)[0])
    pose, which = scan.find_candidates(trace, GEOMETRY, INTACT, 10, scan.COARSE_GRID)
    for k in range(len(pose)):
        same = np.hypot(*(pose[:k, :2] - pose[k, :2]).T) < scan.MIN_CANDIDATE_DISTANCE_M
        same &= np.abs(pose[:k, 2] - pose[k, 2]) < scan.MIN_CANDIDATE_ROTATION_RAD
        assert not (same & (which[:k] == which[k])).any()


def test_weak_fields_cannot_locate_a_landmark() -> None:
    trace = trace_of(simulate_passes(1, 7, errors=NONE, seed=1)[0])
    assert scan.has_strong_field(trace, GEOMETRY)
    assert not scan.has_strong_field(replace(trace, field_t=trace.field_t * 1e-2), GEOMETRY)


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_a_landmark_is_only_searched_where_its_field_can_come_from(scale: float) -> None:
    """Also for bars and circles of other sizes; the truth is always within the region."""
    nominal = Geometry()
    lengths = ("bar_length_m", "bar_width_m", "bar_height_m", "radius_m", "sensor_height_m")
    geometry = replace(nominal, **{key: scale * getattr(nominal, key) for key in lengths})
    random = np.random.default_rng(3)
    for code in range(16):
        lateral = scale * random.uniform(0.0, 0.065)
        points = np.column_stack([scale * np.linspace(-0.1, 0.1, 61), np.full(61, lateral)])
        field = landmark_field(geometry, code, points)
        # One sensor on the robot's origin.
        pose = np.column_stack([points, np.zeros(61)])
        trace = Trace(pose, np.zeros((61, 3, 0)), field[:, None], np.zeros((1, 2)), np.ones(61), 0)
        middle, radius_m = scan.source_region(trace, geometry)
        assert np.hypot(*middle) <= radius_m
        assert radius_m < 4.4 * geometry.radius_m
        # The field of a landmark outside of the region is weaker than the one measured.
        beyond = middle + 1.1 * radius_m * np.stack(
            [np.cos(np.arange(60)), np.sin(np.arange(60))], 1
        )
        outside = [np.abs(landmark_field(geometry, c, middle - beyond)).max() for c in range(16)]
        assert max(outside) < np.abs(field).max()


def test_fields_over_a_large_extent_give_no_candidate() -> None:
    """Odometry in millimetres: a grid over it would exceed the memory."""
    trace = trace_of(simulate_passes(1, 7, errors=NONE, seed=1)[0])
    large = Trace(
        trace.pose * [1e3, 1e3, 1],
        trace.correction,
        trace.field_t,
        trace.sensor_position_m,
        trace.weight,
        trace.reference,
    )
    assert not len(scan.find_candidates(large, GEOMETRY, INTACT, 10, scan.COARSE_GRID)[0])
