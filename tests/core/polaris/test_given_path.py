"""A wrong speed or wrong odometry is corrected and reported; a right one is believed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading
from locatk.core.polaris import codec
from locatk.core.polaris.given_path import PathContradiction, contradiction_warning
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import TagLayout, Tags
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.polaris import suite

Array = NDArray[np.float64]

TAGS = Tags()
CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = (0, 3, 5, 2, 6)
TAG_ID = codec.id_of(TAGS, TagLayout(CELLS, SYMBOLS))
SPEED_MPS = 0.1


def angle_errors_deg(world: Any, solution: Solution, tag: Any) -> Array:
    (result,) = solution.detections
    assert result.tag_id == TAG_ID
    angles = [magnet.angle_rad for magnet in result.magnets]
    return np.degrees(np.abs(world.turn(angles, tag.angles)))


def driven_odometry(course: Any, scale: float) -> Trajectory:
    """The true path of a course, with all lengths multiplied by ``scale``."""
    t = np.linspace(course.t[0], course.t[-1], 400)
    x, y, heading = course.at(t)
    position = np.column_stack([scale * x, scale * y, 0 * x])
    return Trajectory(
        "bar",
        "odom",
        1_700_000_000_000_000_000 + np.rint(t * 1e9).astype(np.int64),
        position,
        quaternion_from_heading(heading),
        np.full((400, 6, 6), np.nan),
    )


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.8, 0.93, 0.97, 1.04, 1.09, 1.5])
@pytest.mark.parametrize("seed", [501, 502])
def test_a_wrong_speed_is_corrected_and_reported(factor: float, seed: int, world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, heading=0.3 * seed)
    samples = world.record([tag], world.line(length=0.3, speed=SPEED_MPS), seed=seed, rate=60.0)
    solution = solve([samples], TAGS, SolveOptions(speed_mps=factor * SPEED_MPS))
    assert angle_errors_deg(world, solution, tag).max() < 0.35
    (warning,) = solution.warnings
    assert warning.code == "path_contradicted"
    fitting_mps = float(warning.message.split("(")[1].split(" ")[0])
    assert fitting_mps == pytest.approx(SPEED_MPS, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(511, 517))
def test_the_right_speed_is_believed(seed: int, world: Any) -> None:
    moved = np.random.default_rng(seed).normal(0, 4e-4, (5, 2))
    tag = world.Tag(CELLS, SYMBOLS, heading=0.3 * seed, moved=moved)
    samples = world.record([tag], world.line(length=0.3, speed=SPEED_MPS), seed=seed, rate=60.0)
    solution = solve([samples], TAGS, SolveOptions(speed_mps=SPEED_MPS))
    assert solution.warnings == ()
    assert solution.detections[0].scale == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "is_right"), [(1.0, True), (0.96, False), (1.3, False)])
def test_the_scale_of_odometry(scale: float, is_right: bool, world: Any) -> None:
    """The robot hesitates over the tag, which no constant speed describes."""
    tag = world.Tag(CELLS, SYMBOLS, heading=1.2)
    course = world.driven(world.line(length=0.3), [0.0, 1.2, 1.6, 3.0], [0.0, 0.4, 0.45, 1.0])
    samples = world.record([tag], course, seed=521)
    solution = solve([samples], TAGS, odometry=[driven_odometry(course, scale)])
    assert angle_errors_deg(world, solution, tag).max() < 0.35
    codes = [warning.code for warning in solution.warnings]
    assert codes == ([] if is_right else ["path_contradicted"])
    if not is_right:
        factor = float(solution.warnings[0].message.split("; ")[1].split(" ")[0])
        assert factor == pytest.approx(1 / scale, rel=0.015)
        assert "odometry" in solution.warnings[0].message


@pytest.mark.slow
def test_a_published_run_at_another_speed(recordings: Path) -> None:
    """With 0.108 m/s the residual is 1.58 times the noise, and angles change by 4.6 degrees."""
    samples = suite.read_runs(recordings)["varying"][1]
    free = solve([samples], suite.PUBLISHED_TAGS).detections
    for speed_mps in np.linspace(0.102, 0.114, 5):
        solution = solve([samples], suite.PUBLISHED_TAGS, SolveOptions(speed_mps=float(speed_mps)))
        assert [d.tag_id for d in solution.detections] == [d.tag_id for d in free]
        np.testing.assert_allclose(
            [m.angle_rad for m in solution.detections[0].magnets],
            [m.angle_rad for m in free[0].magnets],
            atol=np.radians(0.5),
        )
        assert [warning.code for warning in solution.warnings] == ["path_contradicted"]


@pytest.mark.parametrize(
    ("scales", "speed_mps", "expected"),
    [
        ((None, None), 0.1, None),
        (
            (0.5, None),
            0.1,
            "the given speed of 0.1 m/s contradicts the samples of 1 of 2 passes; "
            "0.5 times the given lengths fit (0.05 m/s)",
        ),
        (
            (1.1, 1.2),
            None,
            "the given odometry contradicts the samples of 2 of 2 passes; "
            "1.1 to 1.2 times the given lengths fit",
        ),
        (
            (99274.728, 0.00123456),
            None,
            "the given odometry contradicts the samples of 2 of 2 passes; "
            "0.00123 to 9.93e+04 times the given lengths fit",
        ),
        (
            (-1.0021, -0.9982, 1.3),
            0.2,
            "the given speed of 0.2 m/s contradicts the samples of 3 of 3 passes; "
            "0.998 to 1.3 times the given lengths fit (0.23 m/s); "
            "the array moved in the opposite direction in 2 of them",
        ),
        (
            (np.inf,),
            None,
            "the given odometry contradicts the samples of 1 of 1 passes; it rests in 1 of them",
        ),
    ],
)
def test_one_warning_for_all_passes(scales: Any, speed_mps: Any, expected: Any) -> None:
    passes = [None if scale is None else PathContradiction(scale) for scale in scales]
    warning = contradiction_warning(passes, speed_mps)
    assert (None if warning is None else warning.message) == expected


def with_nan_pose(odometry: Trajectory) -> Trajectory:
    position = odometry.position.copy()
    position[200] = np.nan
    return replace(odometry, position=position)


def with_nan_heading(odometry: Trajectory) -> Trajectory:
    quaternion = odometry.quaternion.copy()
    quaternion[150:153] = np.nan
    return replace(odometry, quaternion=quaternion)


def with_equal_stamps(odometry: Trajectory) -> Trajectory:
    return replace(odometry, time_ns=np.repeat(odometry.time_ns[::2], 2))


def with_stamps_out_of_order(odometry: Trajectory) -> Trajectory:
    order = np.arange(len(odometry))
    order[180:184] = order[180:184][::-1]
    return odometry.select(order)


def without_poses(odometry: Trajectory) -> Trajectory:
    return odometry.select(np.zeros(len(odometry), bool))


def of_another_clock(odometry: Trajectory) -> Trajectory:
    return odometry.shifted(10**12)


def from_the_middle_on(odometry: Trajectory) -> Trajectory:
    return odometry.select(np.arange(len(odometry)) > 200)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (with_nan_pose, ["odometry_invalid"]),
        (with_nan_heading, ["odometry_invalid"]),
        (with_equal_stamps, ["odometry_invalid"]),
        (with_stamps_out_of_order, []),
        (without_poses, ["odometry_invalid"]),
        (of_another_clock, ["samples_without_odometry"]),
        (from_the_middle_on, ["samples_without_odometry"]),
    ],
)
def test_damaged_odometry(
    damage: Callable[[Trajectory], Trajectory], expected: list[str], world: Any
) -> None:
    tag = world.Tag(CELLS, SYMBOLS, heading=0.7)
    course = world.line(length=0.3)
    samples = world.record([tag], course, seed=531)
    solution = solve([samples], TAGS, odometry=[damage(driven_odometry(course, 1.0))])
    assert angle_errors_deg(world, solution, tag).max() < 0.35
    assert [warning.code for warning in solution.warnings] == expected
    (poses,) = solution.trajectories
    assert np.isfinite(poses.position).all()
    assert np.all(np.diff(poses.time_ns) > 0)


@pytest.mark.slow
def test_only_passes_without_odometry_are_named(world: Any) -> None:
    places_m = (0.0, 0.6)
    tags = [world.Tag(CELLS, SYMBOLS, x=x, heading=0.7) for x in places_m]
    course = world.line(length=0.9, past=(0.3, 0.0))
    samples = world.record(tags, course, seed=532)
    driven = driven_odometry(course, 0.9)
    t = np.arange(len(driven)) / len(driven)
    solution = solve([samples], TAGS, odometry=[driven.select(t < 0.5)])
    assert [detection.tag_id for detection in solution.detections] == [TAG_ID, TAG_ID]
    messages = {warning.code: warning.message for warning in solution.warnings}
    assert "1 of 2 passes" in messages["samples_without_odometry"]
    assert "1 of 2 passes" in messages["path_contradicted"]


def backward_course(world: Any) -> Any:
    return world.driven(world.line(length=0.3), [0, 3], [1, 0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(541, 544))
def test_backward_motion_is_reported(seed: int, world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, heading=1.7 * seed)
    samples = world.record([tag], backward_course(world), seed=seed)
    solution = solve([samples], TAGS)
    assert [detection.tag_id for detection in solution.detections] == [TAG_ID]
    (warning,) = solution.warnings
    assert warning.code == "moved_backward"
    assert f"tag {TAG_ID}:" in warning.message


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(541, 544))
def test_inverted_axes_are_reported_as_backward_motion(seed: int, world: Any) -> None:
    """The id is that of the mirrored tag, which the field alone cannot tell."""
    tag = world.Tag(CELLS, SYMBOLS, heading=1.7 * seed)
    samples = world.record([tag], world.line(length=0.3), seed=seed)
    inverted = replace(samples, field_t=samples.field_t * [-1, 1, 1])
    solution = solve([inverted], TAGS)
    (detection,) = solution.detections
    assert detection.tag_id != TAG_ID
    if detection.tag_id is not None:
        assert [warning.code for warning in solution.warnings] == ["moved_backward"]


@pytest.mark.slow
def test_odometry_that_moves_backward_is_believed(world: Any) -> None:
    tag = world.Tag(CELLS, SYMBOLS, heading=0.7)
    course = backward_course(world)
    samples = world.record([tag], course, seed=545)
    solution = solve([samples], TAGS, odometry=[driven_odometry(course, 1.0)])
    assert [detection.tag_id for detection in solution.detections] == [TAG_ID]
    assert solution.warnings == ()
