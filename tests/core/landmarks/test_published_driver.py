"""Driver of the published strategy: its outcomes, and that it knows measurements only."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.landmarks.detection.trace import compose, sensor_positions
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.landmark import Geometry, code_of, rotated
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.published import driver as driver_module
from locatk.core.landmarks.published.driver import PublishedDriver, published_driver
from locatk.core.landmarks.published.second_step import SpinReading
from locatk.core.landmarks.simulation.closed_loop import Motion, execute_motion
from locatk.core.landmarks.simulation.instruments import Measurements
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.passes import trajectory
from locatk.core.landmarks.simulation.robot import Robot
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import SolveOptions, solve

FLOOR = FloorMap(np.random.default_rng(7).integers(0, 16, (12, 12)))
GEOMETRY = Geometry()


class Bench:
    """Robot over hand-placed landmarks, whose measurements are computed without the simulator.

    ``landmarks`` are the codes by centre in the frame of the odometry, in which the robot starts
    at the origin. ``pitch`` of the samples is 2 mm or 1 degree.
    """

    def __init__(self, landmarks: dict[tuple[float, float], int]) -> None:
        self.landmarks = landmarks
        self.sensors = HallSensors(noise_t=1e-5)
        self.robot = Robot(np.zeros(3))
        self.robot.wait(1.0)
        self.pose = np.zeros((0, 3))
        self.field = np.zeros((0, 4))

    def measure(self) -> Measurements:
        time_s = np.arange(int(self.robot.time_s * 50) + 1) / 50
        # Samples of earlier calls stay as they are; only later ones are computed.
        new = self.robot.poses_at(time_s[len(self.pose) :])
        points = sensor_positions(new, self.sensors.position_m)
        field = np.zeros(points.shape[:2])
        for centre, code in self.landmarks.items():
            field += landmark_field(GEOMETRY, code, points - centre)
        self.pose = np.concatenate([self.pose, new])
        self.field = np.concatenate([self.field, field])
        time_ns = np.rint(time_s * 1e9).astype(np.int64)
        samples = HallSamples("robot", self.sensors, time_ns, self.field)
        return Measurements(samples, trajectory("robot", "odometry", time_ns, self.pose))

    def run(self, driver: PublishedDriver) -> list[Motion]:
        ordered = []
        for motion in driver.motions(self.measure):
            execute_motion(self.robot, motion, np.zeros(3))
            ordered.append(motion)
        return ordered


# ---- one landmark after the other


@pytest.mark.parametrize("letters", ["NSNS", "SSSN", "NNSS", "NNNN"])
def test_it_finds_the_centre_and_aligns_with_the_bars(letters: str) -> None:
    code = code_of(letters)
    bench = Bench({(0.2, 0.01): code})
    driver = PublishedDriver(GEOMETRY, 0.2, landmarks=1)
    bench.run(driver)
    (report,) = driver.reports
    assert report.searched
    assert not report.lost
    assert 1 <= report.spins <= 4
    x, y, heading = bench.robot.pose
    assert math.hypot(x - 0.2, y - 0.01) < 0.001
    quarters = round(heading / (math.pi / 2))
    # By construction, valleys of unequal bars are up to 6 degrees from the middles of the bars.
    symmetric = letters in ("NSNS", "NNNN")
    assert abs(heading - quarters * math.pi / 2) < math.radians(1.5 if symmetric else 7)
    assert report.code == rotated(code, -quarters)
    assert report.pose is not None
    frame = np.array([0.2, 0.01, quarters * math.pi / 2])
    assert compose(frame, report.pose)[:2] == pytest.approx([x, y], abs=3e-4)
    assert report.pose[2] == pytest.approx(heading - frame[2], abs=math.radians(0.3))
    assert report.time_ns == pytest.approx(bench.robot.time_s * 1e9, abs=3e7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_it_drives_the_window_from_landmark_to_landmark(seed: int) -> None:
    """Landmarks are displaced by some millimetres, so that the robot aligns with any bar."""
    shift = np.random.default_rng(seed).uniform(-0.007, 0.007, (6, 7, 2))
    cells = {
        (0.2 * i + float(dx), 0.2 * j + 0.01 + float(dy)): (i, j)
        for (i, j), (dx, dy) in (((i - 1, j - 3), shift[i, j]) for i in range(6) for j in range(7))
        if (i, j) != (0, 0)
    }
    bench = Bench(dict.fromkeys(cells, 5))
    driver = PublishedDriver(GEOMETRY, 0.2, rotations=(0, 1), landmarks=4)
    bench.run(driver)
    assert [(report.searched, report.lost) for report in driver.reports] == [
        (True, False), (False, False), (False, False), (False, False),
    ]  # fmt: skip
    visited, aligned = [], []
    for report in driver.reports:
        assert report.pose is not None
        pose = bench.robot.poses_at(np.array([report.time_ns * 1e-9]))[0]
        frame_heading = pose[2] - report.pose[2]
        centre = pose[:2] - compose(np.array([0, 0, frame_heading]), report.pose)[:2]
        nearest = min(cells, key=lambda known: math.dist(known, centre))
        assert math.dist(nearest, centre) < 1e-3
        visited.append(np.array(cells[nearest]))
        aligned.append(round(frame_heading / (math.pi / 2)))
    first, second, third = np.diff(visited, axis=0)
    assert np.abs(first).sum() == 1
    # Ahead, to the left, ahead again; whatever bar the robot aligned with in between.
    assert second.tolist() == [-first[1], first[0]]
    assert third.tolist() == second.tolist()


def test_rotations_of_all_windows() -> None:
    for window, rotations in (
        ("L", [0, 1]), ("I2", [0]), ("I3", [0, 0]), ("2x2", [0, 1, 1]),
        ("3x3", [0, 0, 1, 1, 0, -1, -1, 0]),
    ):  # fmt: skip
        floor = replace(FLOOR, window=window)
        driver = published_driver(floor, SimulationOptions("published", stop_s=0.7))
        assert driver.rotations == rotations
        assert driver.landmarks == len(rotations) + 1
        assert (driver.pitch_m, driver.stop_s) == (0.2, 0.7)
    options = SimulationOptions("published", landmarks=7)
    assert published_driver(FLOOR, options).landmarks == 7


# ---- failures


@pytest.mark.slow
def test_a_robot_that_meets_nothing_gives_up() -> None:
    bench = Bench({})
    driver = PublishedDriver(GEOMETRY, 0.2)
    ordered = bench.run(driver)
    assert driver.reports == []
    path = sum(arc[0] for motion in ordered for arc in motion.arcs)
    assert 1.0 <= path <= 1.03
    assert bench.robot.time_s < 120


@pytest.mark.slow
def test_a_missing_neighbour_is_lost_and_the_robot_turns_back() -> None:
    bench = Bench({(0.2, 0.01): 5})
    driver = PublishedDriver(GEOMETRY, 0.2, landmarks=2, max_approaches=2)
    bench.run(driver)
    assert [(r.searched, r.lost) for r in driver.reports[:2]] == [(True, False), (False, True)]
    assert driver.reports[1].spins == 1
    # It met the first landmark again on its way back, and lost the neighbour again.
    assert [(r.searched, r.lost) for r in driver.reports[2:]] == [(True, False), (False, True)]


@pytest.mark.slow
def test_a_stuck_sensor_does_not_hold_the_robot_for_ever() -> None:
    class Stuck(Bench):
        def measure(self) -> Measurements:
            measured = super().measure()
            field = measured.samples.field_t.copy()
            field[:, 1] = np.where(np.arange(len(field)) > 100, 0.02, 0.0)
            return replace(measured, samples=replace(measured.samples, field_t=field))

    bench = Stuck({})
    driver = PublishedDriver(GEOMETRY, 0.2)
    bench.run(driver)
    assert all(report.code is None for report in driver.reports)
    assert bench.robot.time_s < 600


@pytest.mark.slow
def test_spins_without_a_centre_repeat_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver_module, "recognise_spin", lambda *_: None)
    bench = Bench({(0.2, 0.02): 7})
    driver = PublishedDriver(GEOMETRY, 0.2, landmarks=1, max_approaches=1)
    ordered = bench.run(driver)
    (report,) = driver.reports
    assert (report.code, report.spins, report.lost) == (None, 4, False)
    half_turns = [m for m in ordered if m.arcs == ((0.0, math.pi),)]
    assert len(half_turns) == 3
    assert np.hypot(*(bench.robot.pose[:2] - [0.2, 0.02])) < 0.06


@pytest.mark.slow
def test_a_false_centre_is_refused_by_the_check_of_the_field() -> None:
    """The spins converge on a corner of the landmark, 29 mm from its centre, and read NSNS."""
    reports = []
    for fraction in (0.4, math.inf):
        bench = Bench({(0.2, 0.02): code_of("NNSS")})
        driver = PublishedDriver(
            GEOMETRY, 0.2, landmarks=1, max_approaches=1, max_unexplained_fraction=fraction
        )
        bench.run(driver)
        assert np.hypot(*(bench.robot.pose[:2] - [0.2, 0.02])) == pytest.approx(0.029, abs=1e-3)
        reports += driver.reports
    checked, unchecked = reports
    assert (checked.code, checked.spins, checked.lost) == (None, 4, False)
    assert unchecked.code in (0b0101, 0b1010)


def test_a_centre_far_from_the_spin_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings whose centre is more than 10 mm away count as a direction only."""
    read = []

    def far_away(valleys: object, centre_m: np.ndarray, *_: object) -> SpinReading:
        read.append(centre_m)
        angles = np.arange(4) * math.pi / 2
        return SpinReading(centre_m + [0.011, 0.0], angles, np.ones(4, bool))

    monkeypatch.setattr(driver_module, "recognise_spin", far_away)
    bench = Bench({(0.2, 0.01): 15})
    driver = PublishedDriver(
        GEOMETRY, 0.2, landmarks=1, max_approaches=1, max_unexplained_fraction=math.inf
    )
    bench.run(driver)
    (report,) = driver.reports
    assert (report.code, report.spins) == (None, 4)
    # It moved there for the next spin nevertheless.
    assert np.diff(np.array(read), axis=0) == pytest.approx(np.tile([0.011, 0], (3, 1)), abs=1e-3)


# ---- in the simulator


def first_approach(seed: int) -> SimulatedSession:
    options = SimulationOptions("published", landmarks=1, rate_hz=100.0, seed=seed)
    driver = published_driver(FLOOR, options)
    driver.max_approaches = 1
    return simulate(FLOOR, options, driver)


@pytest.fixture(scope="module")
def sessions() -> list[SimulatedSession]:
    """First approaches of some robots."""
    return [first_approach(seed) for seed in range(8)]


@pytest.mark.slow
def test_most_robots_end_at_a_centre(sessions: list[SimulatedSession]) -> None:
    approaches = [one for session in sessions for one in session.approaches]
    counts = Counter(one.outcome for one in approaches)
    # The bench measures 72 % of more approaches.
    assert counts["centre"] >= 0.5 * len(approaches) >= 4
    assert counts["wrong_pattern"] <= 1
    for one in approaches:
        assert one.searched
        assert 0 <= one.spins <= 4
        if one.outcome == "centre":
            assert one.distance_m < 0.002
        if one.outcome == "no_pattern":
            assert one.spins == 4


@pytest.mark.slow
def test_approaches_agree_with_the_visits(sessions: list[SimulatedSession]) -> None:
    for session in sessions:
        for one in session.approaches:
            if one.outcome != "centre":
                continue
            visits = [v for v in session.events if v.cell == one.cell]
            assert any(v.first_ns <= one.time_ns <= v.last_ns for v in visits)


@pytest.mark.slow
def test_its_sessions_can_be_solved(sessions: list[SimulatedSession]) -> None:
    right = 0
    for session in sessions[:5]:
        solution = solve(session.samples, None, SolveOptions("paper"), odometry=session.odometry)
        read = [each for each in solution.detections if not each.refused]
        right += bool(read)
    assert right >= 2


@pytest.mark.slow
def test_commands_depend_on_measurements_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver orders the same motions for recorded measurements, without any simulator."""
    options = SimulationOptions("published", landmarks=2, rate_hz=100.0, seed=2)
    recorded: list[Measurements] = []
    ordered: list[Motion] = []

    class Recorder(PublishedDriver):
        def motions(self, measure):  # type: ignore[no-untyped-def]
            def record() -> Measurements:
                recorded.append(measure())
                return recorded[-1]

            for motion in super().motions(record):
                ordered.append(motion)
                yield motion

    original = published_driver(FLOOR, options)
    recorder = Recorder(original.geometry, original.pitch_m, original.rotations, original.landmarks)
    simulate(FLOOR, options, recorder)
    assert len(ordered) > 20
    replayed = published_driver(FLOOR, options)
    replay = iter(recorded)
    assert list(replayed.motions(lambda: next(replay))) == ordered
    # Another map with the same pitch and window changes nothing.
    other = published_driver(replace(FLOOR, codes=FLOOR.codes ^ 15, origin_m=(5.0, 5.0)), options)
    replay = iter(recorded)
    assert list(other.motions(lambda: next(replay))) == ordered


@pytest.mark.slow
def test_the_same_seed_gives_the_same_session(sessions: list[SimulatedSession]) -> None:
    first, second = sessions[0], first_approach(0)
    np.testing.assert_array_equal(first.samples[0].field_t, second.samples[0].field_t)
    np.testing.assert_array_equal(first.odometry[0].position, second.odometry[0].position)
    assert first.approaches == second.approaches
