"""First places: the compiled loop against its twin, and the grid against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.kernels import kernels
from locatk.core.landmarks.detection import scan
from locatk.core.landmarks.detection.trace import Drift, Trace, corrections, relative
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.simulation.options import NONE
from locatk.core.landmarks.simulation.passes import Pass, passes

GEOMETRY = Geometry()


def trace_of(one: Pass) -> Trace:
    """By the truth, every third sample, as seen from the middle one."""
    pose = np.column_stack(
        [one.truth.position[:, :2], heading_from_quaternion(one.truth.quaternion)]
    )[::3]
    middle = len(pose) // 2
    local = relative(pose, pose[middle])
    return Trace(
        local,
        corrections(local, middle, Drift()),
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
    slack = random.uniform(1e-4, 1e-3, 50)
    centres = random.uniform(-0.05, 0.05, (6, 2))
    turns = scan.FINE.headings()
    fast = scan.scan(points, values, slack, centres, turns, GEOMETRY, scan.WHOLE)
    table = scan._table(GEOMETRY)
    slow = scan.scan_numpy(points, values, 1 / slack**2, centres, turns, table, scan.WHOLE)
    np.testing.assert_allclose(fast, slow, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("code", range(16))
def test_the_truth_is_among_the_first(code: int) -> None:
    for one in passes(2, code, errors=NONE, seed=code, start=(0.3 * code, 0.2)):
        trace = trace_of(one)
        pose, laid = scan.candidates(trace, GEOMETRY, scan.WHOLE, 10, scan.COARSE)
        # The landmark as the robot sees it, in any of its four frames.
        middle = one.truth.position[::3][trace.reference, :2]
        heading = heading_from_quaternion(one.truth.quaternion)[::3][trace.reference]
        c, s = np.cos(heading), np.sin(heading)
        true = np.array([-(c * middle[0] + s * middle[1]), s * middle[0] - c * middle[1]])
        near = np.hypot(*(pose[:, :2] - true).T) < 1.5 * scan.COARSE.step_m
        turn = np.remainder(pose[:, 2] + heading + np.pi / 4, np.pi / 2) - np.pi / 4
        near &= np.abs(turn) < np.radians(15)
        assert signs(code).sum() in (scan.WHOLE[laid] @ np.ones(4))[near]


def test_no_two_candidates_are_alike() -> None:
    trace = trace_of(passes(1, 7, errors=NONE, seed=1)[0])
    pose, laid = scan.candidates(trace, GEOMETRY, scan.WHOLE, 10, scan.COARSE)
    for k in range(len(pose)):
        same = np.hypot(*(pose[:k, :2] - pose[k, :2]).T) < scan.APART_M
        same &= np.abs(pose[:k, 2] - pose[k, 2]) < scan.APART_RAD
        assert not (same & (laid[:k] == laid[k])).any()


def test_quiet_traces_have_none() -> None:
    trace = trace_of(passes(1, 7, errors=NONE, seed=1)[0])
    quiet = Trace(
        trace.pose,
        trace.correction,
        trace.value_t * 1e-3,
        trace.lever_m,
        trace.weight,
        trace.reference,
    )
    assert not len(scan.candidates(quiet, GEOMETRY, scan.WHOLE, 10, scan.COARSE)[0])


def test_fields_all_over_a_hall_are_no_landmark() -> None:
    """Odometry in millimetres: a grid over it would need more memory than there is."""
    trace = trace_of(passes(1, 7, errors=NONE, seed=1)[0])
    large = Trace(
        trace.pose * [1e3, 1e3, 1],
        trace.correction,
        trace.value_t,
        trace.lever_m,
        trace.weight,
        trace.reference,
    )
    assert not len(scan.candidates(large, GEOMETRY, scan.WHOLE, 10, scan.COARSE)[0])
