"""Closed loop of the simulator: execution of motions, readouts on the way, judged approaches."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.landmark import rotated
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.simulation import closed_loop
from locatk.core.landmarks.simulation.closed_loop import (
    ApproachReport,
    Motion,
    execute_motion,
    judge_approach,
)
from locatk.core.landmarks.simulation.floor import install_landmarks
from locatk.core.landmarks.simulation.instruments import Instruments, Measurements
from locatk.core.landmarks.simulation.options import NONE, Errors, Faults, SimulationOptions
from locatk.core.landmarks.simulation.robot import Robot
from locatk.core.landmarks.simulation.sensors import odometry, odometry_biases
from locatk.core.landmarks.simulation.session import simulate
from locatk.core.simulation import SESSION_START_NS

FLOOR = FloorMap(np.array([[7, 4, 9], [2, 11, 13]]))
OPTIONS = SimulationOptions("published", rate_hz=100.0, seed=4)


class ScriptedDriver:
    """Driver with a fixed list of motions that keeps what it measured."""

    def __init__(self, motions: list[Motion], reports: list[ApproachReport] | None = None) -> None:
        self.script, self.reports = motions, reports or []
        self.measured: list[Measurements] = []

    def motions(self, measure: Callable[[], Measurements]) -> Iterator[Motion]:
        for motion in self.script:
            self.measured.append(measure())
            yield motion


SCRIPT = [
    Motion(((0.15, 0.0),)),
    Motion(((0.0, 1.0), (0.05, 0.3)), wait_s=0.2),
    Motion(wait_s=0.1),
    Motion(((0.0, -6.0),)),
]


@pytest.mark.parametrize("bias", range(3))
def test_a_motion_is_executed_by_the_biased_odometry(bias: int) -> None:
    names = ("odometry_scale", "odometry_drift_rad_per_m", "odometry_turn")
    errors = replace(NONE, **{names[bias]: 0.1})
    biases = odometry_biases(errors, np.random.default_rng(3))
    assert np.flatnonzero(biases).tolist() == [bias]
    robot = Robot(np.array([0.4, -0.2, 0.5]))
    execute_motion(robot, Motion(((0.2, 0.0), (0.1, -0.4), (0.0, 2.0), (-0.05, 0.0))), biases)
    time_s = np.linspace(0, robot.time_s, 20_000)
    reported, _ = odometry(robot.poses_at(time_s), errors, np.random.default_rng(3))
    # What the odometry reports is what was ordered, whatever the robot truly did.
    ordered = Robot(np.zeros(3))
    for arcs in ([(0.2, 0.0), (0.1, -0.4)], [(-0.05, 0.0)]):
        ordered.drive(arcs)
        if len(arcs) == 2:
            ordered.rotate(2.0)
    assert reported[-1] == pytest.approx(ordered.pose, abs=1e-6)
    true_pose = robot.pose - [0.4, -0.2, 0.5]
    assert abs(true_pose - ordered.pose).max() > 1e-3


def test_early_readouts_equal_the_start_of_the_session() -> None:
    driver = ScriptedDriver(SCRIPT)
    session = simulate(FLOOR, OPTIONS, driver)
    (samples,), (reported,) = session.samples, session.odometry
    lengths = [len(measured.samples) for measured in driver.measured]
    assert lengths == sorted(set(lengths))
    for measured in driver.measured:
        count = len(measured.samples)
        np.testing.assert_array_equal(measured.samples.time_ns, samples.time_ns[:count])
        np.testing.assert_array_equal(measured.samples.field_t, samples.field_t[:count])
        poses = len(measured.odometry)
        assert measured.odometry.position == pytest.approx(reported.position[:poses], abs=1e-12)
    # The last motion and the rest at the end are recorded, too.
    assert len(samples) > lengths[-1] + 100 * OPTIONS.rest_s


def test_readouts_in_parts_are_the_readout_of_the_whole() -> None:
    landmarks = install_landmarks(FLOOR, OPTIONS.errors, Faults(), 4)
    whole, parts = (Instruments(FLOOR, landmarks, HallSensors(), 0.012, OPTIONS) for _ in range(2))
    robot = Robot(np.array([-0.1, 0.0, 0.2]))
    for motion in SCRIPT:
        execute_motion(robot, motion, np.zeros(3))
        in_parts = parts.read(robot)
    at_once = whole.read(robot)
    field = at_once.measurements.samples.field_t
    assert in_parts.measurements.samples.field_t == pytest.approx(field, abs=1e-12)
    assert in_parts.poses == pytest.approx(at_once.poses, abs=1e-12)
    assert np.abs(field).max() > 5e-3


def test_the_same_seed_and_driver_give_the_same_session() -> None:
    first, second = (simulate(FLOOR, OPTIONS, ScriptedDriver(SCRIPT)) for _ in range(2))
    np.testing.assert_array_equal(first.samples[0].field_t, second.samples[0].field_t)
    np.testing.assert_array_equal(first.truth[0].position, second.truth[0].position)
    other = simulate(FLOOR, replace(OPTIONS, seed=5), ScriptedDriver(SCRIPT))
    assert other.samples[0].field_t.shape != first.samples[0].field_t.shape or not np.array_equal(
        other.samples[0].field_t, first.samples[0].field_t
    )


def test_a_driver_that_never_ends_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed_loop, "MAX_SESSION_S", 5.0)
    driver = ScriptedDriver([Motion(wait_s=1.0)] * 100)
    session = simulate(FLOOR, OPTIONS, driver)
    assert session.notes == ("the driver did not finish within 5 s",)
    assert len(session.samples[0]) < 100 * 8


def test_a_path_off_the_map_is_noted() -> None:
    session = simulate(FLOOR, OPTIONS, ScriptedDriver([Motion(((2.0, 0.0),))]))
    assert session.notes == ("the path leaves the map, or goes over a hole or through a wall",)
    assert not simulate(FLOOR, OPTIONS, ScriptedDriver([Motion(((0.01, 0.0),))])).notes


def test_the_strategy_needs_a_driver_and_no_slips() -> None:
    with pytest.raises(InputError, match="needs a driver"):
        simulate(FLOOR, OPTIONS)
    with pytest.raises(InputError, match="errors") as error:
        replace(OPTIONS, errors=Errors(slips_per_m=0.1))
    assert "without slips" in (error.value.hint or "")


@pytest.mark.parametrize("quarters", range(4))
def test_an_approach_is_judged_in_the_frame_of_the_report(quarters: int) -> None:
    landmarks = install_landmarks(FLOOR, NONE, Faults(), 0)
    true_pose = np.array([0.202, 0.001, quarters * math.pi / 2 + 0.1])
    robot = Robot(true_pose)
    code = int(rotated(FLOOR.codes[0, 1], -quarters))
    time_ns = SESSION_START_NS + 10**9
    report = ApproachReport(time_ns, True, 2, code, np.array([0.002, 0.001, 0.1]))
    approach = judge_approach(report, robot, landmarks)
    assert (approach.outcome, approach.cell, approach.spins) == ("centre", (0, 1), 2)
    assert approach.distance_m == pytest.approx(math.hypot(0.002, 0.001))
    assert (approach.time_ns, approach.searched) == (time_ns, True)
    wrong = judge_approach(replace(report, code=code ^ 1), robot, landmarks)
    assert wrong.outcome == "wrong_pattern"
    unread = judge_approach(replace(report, code=None, pose=None), robot, landmarks)
    assert unread.outcome == "no_pattern"
    assert judge_approach(replace(report, lost=True), robot, landmarks).outcome == "lost"
    # The right code read too far from the centre of the landmark.
    beside = Robot(true_pose + [0.004, 0.0, 0.0])
    assert judge_approach(report, beside, landmarks).outcome == "lost"


def test_flipped_bars_count_as_they_are_and_missing_ones_as_designed() -> None:
    faults = Faults(flipped=(((0, 1), 2),), missing=(((0, 1), 0),))
    landmarks = install_landmarks(FLOOR, NONE, faults, 0)
    report = ApproachReport(
        SESSION_START_NS, True, 1, int(FLOOR.codes[0, 1]) ^ 0b100, np.array([0.0, 0.0, 0.0])
    )
    approach = judge_approach(report, Robot(np.array([0.2, 0.0, 0.0])), landmarks)
    assert approach.outcome == "centre"
