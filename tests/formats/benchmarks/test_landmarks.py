"""The benchmark of landmarks: every target has its row, and scores are correct."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.landmark import CODE_COUNT, rotated
from locatk.core.landmarks.map import windows
from locatk.core.landmarks.map.floor import FloorMap, neighbour
from locatk.core.landmarks.simulation.options import NONE, SimulationOptions
from locatk.core.landmarks.simulation.passes import SinglePass, simulate_passes
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import solve
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks import timing
from locatk.formats.benchmarks.figures import Duration, Figure
from locatk.formats.benchmarks.landmarks import doubts as landmarks_doubts
from locatk.formats.benchmarks.landmarks import endurance as landmarks_endurance
from locatk.formats.benchmarks.landmarks import faults as landmarks_faults
from locatk.formats.benchmarks.landmarks import global_localization as landmarks_global
from locatk.formats.benchmarks.landmarks import odometry as landmarks_odometry
from locatk.formats.benchmarks.landmarks import sessions as landmarks_sessions
from locatk.formats.benchmarks.landmarks import speed as landmarks_speed
from locatk.formats.benchmarks.landmarks import suite as landmarks
from locatk.formats.benchmarks.landmarks import visits as landmarks_visits
from locatk.formats.benchmarks.landmarks.visits import VisitResult

PROMISED = {
    "paper's first step, half-discs: mean, off the paper's": 0.5,
    "paper's first step, half-discs: over 20 mm": 0.5,
    "one pass: mean": 1.5,
    "one pass: p95": 3.0,
    "one pass: largest": 15.0,
    "one pass: over 15 mm": 0.0,
    "one pass: pattern right": 92.0,
    "one pass: calibration error": 0.03,
    "after a spin: mean": 0.5,
    "after a spin: pattern right": 99.9,
    "after a second pass: mean": 0.5,
    "after a second pass: pattern right": 99.9,
    "static at the landmark: mean": 0.4,
    "static at the landmark: heading": 0.5,
    "24x24, 16/L: right after three landmarks": 100.0,
    "5 % misread: wrong silently": 0.0,
    "sessions with 5 % misread landmarks: wrong silently": 0.0,
    "map 7x7, 6/L: search": 10.0,
    "map 100x100, 16/2x2: proof": 1.0,
    "time an estimate, one pass, p50": 0.05,
    "an hour on 200x200: memory": 300.0,
    "an hour on 200x200: time per visit": 0.05,
    "an hour on 200x200: wrong silently": 0.0,
    "floor with the same landmarks in another order: believed": 0.0,
    "field of four bars, times as fast as magpylib": 20.0,
    "field of a bar, difference to magpylib": 1e-12,
}
"""Targets, without the maps that these tests leave out."""

EXACT = (
    "one pass: over 15 mm",
    "24x24, 16/L: right after three landmarks",
    "5 % misread: wrong silently",
    "L sessions: right cells, and poses given",
    "field of a bar, difference to magpylib",
)
"""Figures whose targets are met by any number of cases."""


@pytest.fixture(scope="module")
def quick(
    run_in_process: Callable[[str], list[float]], time_once: Callable[..., Duration]
) -> Iterator[None]:
    """Use few cases: the code is tested, not the accuracy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(landmarks_faults, "FAULTY_SESSIONS", 1)
        patch.setattr(landmarks_faults, "SAMPLE_RATE_HZ", 20.0)
        first = dict(list(landmarks_faults.FAULTS.items())[:1])
        patch.setattr(landmarks_faults, "FAULTS", first)
        patch.setattr(landmarks_doubts, "DRIVES_PER_KIND", 1)
        for kinds in ("OTHER_FLOORS", "WIRINGS"):
            only = dict(list(getattr(landmarks_doubts, kinds).items())[:1])
            patch.setattr(landmarks_doubts, kinds, only)
        patch.setattr(landmarks_odometry, "LONG_DRIVES", 1)
        patch.setattr(landmarks_odometry, "LONG_DRIVE_CELLS", 9)
        first_kind = dict(list(landmarks_odometry.KINDS.items())[:1])
        patch.setattr(landmarks_odometry, "KINDS", first_kind)
        patch.setattr(landmarks, "SINGLE_PASSES", 6)
        patch.setattr(landmarks, "LONG_VISITS", 3)
        patch.setattr(landmarks, "STOPPED_ROBOTS", 4)
        patch.setattr(landmarks, "STUDY_STEP_DEG", 30)
        patch.setattr(landmarks_sessions, "SEARCHING_ROBOTS", 1)
        # This robot finds three landmarks without searching again, which takes the least time.
        patch.setattr(landmarks_sessions, "FIRST_SEED", landmarks_sessions.FIRST_SEED + 5)
        patch.setattr(landmarks_sessions, "CLOSED_LOOP_SESSIONS", 1)
        patch.setattr(landmarks_global, "START_STRIDE", 300)
        patch.setattr(landmarks_sessions, "SIMULATED_SESSIONS", 1)
        patch.setattr(landmarks_sessions, "MISREAD_SESSION_LANDMARKS", 3)
        patch.setattr(landmarks_speed, "TIMED_ESTIMATES", 1)
        patch.setattr(landmarks_speed, "MAP_SEEDS", 1)
        patch.setattr(landmarks_speed, "FIELD_POINTS", 2000)
        patch.setattr(landmarks_speed, "SEARCHED_MAPS", landmarks_speed.SEARCHED_MAPS[:1])
        patch.setattr(landmarks_speed, "time_call", time_once)
        patch.setattr(landmarks_speed, "run_single_threaded", run_in_process)
        patch.setattr(landmarks_endurance, "DRIVE_LANDMARKS", 12)
        patch.setattr(landmarks_endurance, "time_call", time_once)
        patch.setattr(landmarks_endurance, "run_single_threaded", run_in_process)
        patch.setattr(timing, "run_single_threaded", run_in_process)
        yield


@pytest.fixture(scope="module")
def rows(quick: None, by_name: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Figure]:
    """All figures, with an empty data folder."""
    return by_name(landmarks.figures(tmp_path_factory.mktemp("empty")))


@pytest.mark.slow
def test_every_promise_has_its_row(rows: dict[str, Figure]) -> None:
    for name, target in PROMISED.items():
        assert rows[name].target == pytest.approx(target), name
    assert (7, "L", "6") in {searched[:3] for searched in landmarks_speed.SEARCHED_MAPS}
    assert landmarks_visits.CONFIDENT_PROBABILITY == 0.99


@pytest.mark.slow
def test_rows_are_complete_and_missing_data_are_reported(rows: dict[str, Figure]) -> None:
    for name, figure in rows.items():
        assert figure.how
        assert isinstance(figure.unit, str)
        assert figure.better in ("lower", "higher")
        assert (figure.peer is None) == (figure.peer_value is None), name
        if name.startswith("published maps"):
            assert figure.value is None
            assert figure.met is None
            assert "id6_L_7x7.txt" in figure.how
        else:
            assert isinstance(figure.value, float), name
            # Of few, the paper's way may read none.
            assert math.isfinite(figure.value) or "valleys" in name, name
            assert figure.unit != "%" or 0 <= figure.value <= 100, name
    assert "which ships" in rows["24x24, 16/L: right after three landmarks"].how
    for name in EXACT:
        assert rows[name].met is not False, name
        assert rows[name].value is not None


@pytest.mark.slow
def test_a_figure_of_speed_is_taken_in_a_process_of_its_own() -> None:
    found, seconds, _ = timing.run_single_threaded("landmarks.speed.time_search(5, 'L', '16', 2)")
    assert found == 2
    assert 0 < seconds < math.inf


def test_failed_measurements_are_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(call: str) -> list[float]:
        raise OSError("no such thing")

    monkeypatch.setattr(landmarks_speed, "run_single_threaded", fails)
    monkeypatch.setattr(landmarks_endurance, "run_single_threaded", fails)
    for figure in [
        *landmarks_speed.field_figures()[:2],
        *landmarks_speed.estimate_figures(),
        *landmarks_endurance.endurance_figures(),
    ]:
        assert figure.value is None
        assert "no such thing" in figure.how


@pytest.mark.slow
def test_memory_does_not_grow_with_the_visits() -> None:
    """Beliefs of 40,000 cells and four headings are 1.3 MB a visit if they are dense."""
    before_mb, after_mb, correct_percent, wrong, seconds, _ = timing.run_single_threaded(
        "landmarks.endurance.measure_drive(150)"
    )
    assert after_mb - before_mb < 120
    assert (correct_percent, wrong) == (100, 0)
    assert 0 < seconds / 150 < 2


@pytest.mark.slow
def test_wrong_cells_of_a_drive_are_counted(
    monkeypatch: pytest.MonkeyPatch, time_once: Callable[..., Duration]
) -> None:
    """Two of six visits of a changed result are wrong, one of them with certainty."""

    def identify(*given: Any, **options: Any) -> Any:
        result = landmarks_endurance_identify(*given, **options)
        estimates = list(result.estimates)
        for number, probability in ((2, 0.9995), (4, 0.9)):
            other = (estimates[number].quarters + 1) % 4
            estimates[number] = replace(estimates[number], quarters=other, probability=probability)
        return replace(result, estimates=estimates)

    landmarks_endurance_identify = landmarks_endurance.identify_cells
    monkeypatch.setattr(landmarks_endurance, "identify_cells", identify)
    monkeypatch.setattr(landmarks_endurance, "time_call", time_once)
    _, _, correct_percent, wrong, _, _ = landmarks_endurance.measure_drive(6)
    assert correct_percent == pytest.approx(100 * 4 / 6)
    assert wrong == 1


def test_published_maps_are_unique(data: Path, tmp_path: Path) -> None:
    folder = data / "landmarks"
    if not folder.is_dir():
        pytest.skip("no published maps")
    assert landmarks_speed.published_maps(folder).value == 0
    floor, which = landmarks_global.standard_floor(folder)
    assert (floor.shape, which) == ((24, 24), "published map")
    # A map with two rows exchanged is not.
    floor.codes[[3, 9]] = floor.codes[[9, 3]]
    for name in landmarks_global.PUBLISHED_SIDES:
        (tmp_path / f"{name}.txt").write_text((folder / f"{name}.txt").read_text())
    lines = ["head", *("".join(f"{code:x}" for code in row) for row in floor.codes)]
    (tmp_path / "or16_L_24x24.txt").write_text("\n".join(lines))
    assert landmarks_speed.published_maps(tmp_path).met is False
    (tmp_path / "or16_L_24x24.txt").write_text("head\nff")
    assert landmarks_speed.published_maps(tmp_path).value is None


# ---- scores of a visit


@pytest.fixture(scope="module")
def spun() -> list[SinglePass]:
    return simulate_passes(4, code=[8, 3, 5, 15], then="spin", errors=NONE, aim_m=0.003, seed=3)


def test_a_visit_without_errors_has_none(spun: list[SinglePass]) -> None:
    for number, one in enumerate(spun):
        found = landmarks_visits.solve_by_field(number, one)
        assert found.error_m < 0.1e-3
        assert abs(found.heading_rad) < 1e-3
        assert found.is_correct
        assert found.visits == 1
        assert found.true_probability == pytest.approx(found.probability)
        by_valleys = landmarks_visits.solve_by_valleys(number, one)
        assert by_valleys.is_correct
        assert by_valleys.error_m < 3.5e-3  # 2.6 mm by construction
        assert abs(by_valleys.heading_rad) < math.radians(8)


def test_a_wrong_landmark_is_not_right(spun: list[SinglePass]) -> None:
    one = replace(spun[0], code=spun[0].code ^ 1)
    assert not landmarks_visits.solve_by_field(0, one).is_correct
    assert landmarks_visits.solve_by_field(0, one).true_probability < 1e-6
    assert not landmarks_visits.solve_by_valleys(0, one).is_correct


def test_a_visit_to_nothing_is_not_right() -> None:
    (one,) = simulate_passes(1, errors=NONE, start=(0.0, 0.0))
    quiet = replace(one, samples=replace(one.samples, field_t=0 * one.samples.field_t + 1e-6))
    found = landmarks_visits.solve_by_field(7, quiet)
    assert (found.number, found.is_correct) == (7, False)
    assert math.isnan(found.error_m)
    assert landmarks_visits.log_loss([found]) == pytest.approx(-math.log(1e-9))


@pytest.mark.slow
def test_baselines_are_about_as_good_as_the_facts_say() -> None:
    made = landmarks_visits.simulate_visits(40, "", 5)
    assert len(made) == 40
    assert all(one.lines for _, one in made)
    for found in zip(*(landmarks_visits.solve_first_steps(*one) for one in made), strict=True):
        assert 5 < landmarks_visits.errors_mm(found).mean() < 15


def test_errors_do_not_depend_on_rotations_by_90_degrees() -> None:
    true = np.array([0.01, -0.02, 0.3])
    for quarters in range(-3, 4):
        turn = quarters * math.pi / 2
        cos, sin = math.cos(turn), math.sin(turn)
        own = np.array([cos * 0.01 + sin * -0.02, cos * -0.02 - sin * 0.01, 0.3 - turn])
        assert landmarks_visits.pose_error(own, true) == pytest.approx(np.zeros(3), abs=1e-12)
        assert landmarks_visits.centre_error(own, true) == pytest.approx(0, abs=1e-12)
        off = landmarks_visits.pose_error(own + [0, 0, 0.1], true)
        assert off == pytest.approx([0, 0, 0.1], abs=1e-12)
    # In the frame of a rotated robot the centre is in another direction.
    assert landmarks_visits.landmark_centre(np.array([0.1, 0.0, math.pi / 2])) == pytest.approx(
        [0, 0.1]
    )
    assert landmarks_visits.centre_error(true + [3e-3, 4e-3, 0], true) == pytest.approx(5e-3)


def test_calibration_error_compares_fractions_with_probabilities() -> None:
    def told(probability: float, right: int, of: int) -> list[VisitResult]:
        return [VisitResult(k, 3, is_correct=k < right, probability=probability) for k in range(of)]

    even = [*told(0.95, 19, 20), *told(0.6, 12, 20), *told(1.0, 20, 20)]
    assert landmarks_visits.calibration_error(even)[0] == pytest.approx(0)
    vain = [*told(0.95, 10, 20), *told(1.0, 19, 20)]
    off, words = landmarks_visits.calibration_error(vain)
    assert off == pytest.approx((0.45 + 0.05) / 2)
    assert "20 with 95.0 % are 50.0 % correct" in words
    assert landmarks_visits.log_loss(
        [VisitResult(0, 1, true_probability=p) for p in (1.0, 0.5)]
    ) == pytest.approx(math.log(2) / 2)


def test_nothing_found_is_not_met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landmarks, "SINGLE_PASSES", 2)
    monkeypatch.setattr(
        landmarks, "solve_by_field", lambda number, one: VisitResult(number, one.lines)
    )
    found = {figure.name: figure for figure in landmarks.pass_figures()}
    assert found["one pass: mean"].met is False
    assert found["one pass: pattern right"].met is False
    assert "not detected or refused" in found["one pass: mean"].how


def test_robots_stop_at_the_distances_of_the_paper() -> None:
    rng = np.random.default_rng(1)
    for anywhere, mean_m in ((False, 3.76e-3), (True, 6.67e-3)):
        away = np.hypot(*landmarks_visits.random_stops(4000, anywhere, rng)[:, :2].T)
        assert away.max() <= landmarks_visits.MAX_STOP_DISTANCE_M
        assert away.mean() == pytest.approx(mean_m, rel=0.05)


# ---- scores of a floor


@pytest.fixture(scope="module")
def floor() -> FloorMap:
    return landmarks_global.standard_floor(Path("nowhere"))[0]


def test_windows_and_walks_go_from_cell_to_cell(floor: FloorMap) -> None:
    walks = landmarks_global.window_walks(floor)
    assert len(walks) == len(windows.window_readings(floor)) == 4 * 23 * 23
    rng = np.random.default_rng(0)
    walks = walks[::97] + [
        landmarks_global.random_walk(floor, (r, c), h, rng) for r in (0, 9, 23) for c in (0, 23)
        for h in range(4)
    ]  # fmt: skip
    for walk in walks:
        assert len(walk.cells) in (3, landmarks_global.WALK_LANDMARKS)
        for n, (here, there) in enumerate(zip(walk.cells, walk.cells[1:], strict=False)):
            # It looks along the way on which it came.
            assert neighbour(here, walk.quarters[n + 1]) == there
            assert 0 <= min(there) <= max(there) < 24
    left = landmarks_global.window_walks(floor)[0]
    assert [(q - left.quarters[0]) % 4 for q in left.quarters] == [0, 0, 1]


def test_sightings_are_what_the_robot_reads(floor: FloorMap) -> None:
    rng = np.random.default_rng(4)
    walk = landmarks_global.random_walk(floor, (5, 6), 2, rng)
    laid = {walk.cells[1]: int(floor.codes[walk.cells[1]]) ^ 3}
    seen = landmarks_global.simulate_observations(floor, walk, laid, rng)
    for n, (cell, quarters) in enumerate(zip(walk.cells, walk.quarters, strict=True)):
        code = rotated(seen[n].best.code, quarters)
        assert (code == floor.codes[cell]) == (n != 1)
        assert np.hypot(*seen[n].best.pose[:2]) < 0.015
        assert abs(seen[n].best.pose[2]) < 0.15
    steps = np.hypot(*np.diff([one.odometry[:2] for one in seen], axis=0).T)
    assert steps == pytest.approx(floor.pitch_m, abs=0.02)
    wrong = landmarks_global.random_misreadings(floor, rng)
    assert 5 < len(wrong) < 60
    assert all(0 <= code < CODE_COUNT and code != floor.codes[cell] for cell, code in wrong.items())


def test_a_filter_certain_of_a_wrong_cell_is_detected(
    floor: FloorMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(landmarks_global, "START_STRIDE", 500)

    def sure(floor: FloorMap, seen: list[Any]) -> Any:
        open_, certain = (
            landmarks_global.LocalizedStop((-1, -1), 0, probability, 1.0)
            for probability in (0.5, 0.99999)
        )
        return [open_, certain], [open_, open_]

    def truncated(*args: Any) -> Any:
        walk = walked(*args)
        return landmarks_global.Walk(walk.cells[:2], walk.quarters[:2])

    walked = landmarks_global.random_walk
    monkeypatch.setattr(landmarks_global, "random_walk", truncated)
    monkeypatch.setattr(landmarks_global, "localize_stops", sure)
    wrong, remarked, needed, _ = landmarks_global.misread_figures(floor, "map")
    assert wrong.value == 5
    assert "walks 0, 1, 2, 3, 4" in wrong.how
    assert (remarked.value, needed.value) == (0, 2)


@pytest.fixture(scope="module")
def solved(floor: FloorMap) -> tuple[SimulatedSession, Solution]:
    made = simulate(floor, SimulationOptions(seed=2))
    return made, solve(made.samples, floor, odometry=made.odometry)


@pytest.mark.slow
def test_a_solved_session_is_compared_with_the_truth(
    solved: tuple[SimulatedSession, Solution],
) -> None:
    made, solution = solved
    one = landmarks_sessions.score_session(made, solution)
    assert one.has_poses
    assert not one.is_wrong
    assert np.quantile(one.error_m, 0.9) < 0.01
    track = solution.trajectories[0]
    moved = replace(track, position=track.position + [0.2, 0, 0])
    one = landmarks_sessions.score_session(made, replace(solution, trajectories=(moved,)))
    assert one.is_wrong
    assert one.error_m.mean() == pytest.approx(0.2, abs=0.01)


@pytest.mark.slow
def test_a_wrong_cell_is_detected(solved: tuple[SimulatedSession, Solution]) -> None:
    made, solution = solved
    *others, last = solution.detections
    row, column = last.cell
    detections = (*others, replace(last, cell=(row, column + 1)))
    assert (
        landmarks_sessions.score_session(made, replace(solution, detections=detections)).wrong_cells
        == 1
    )
    detections = (*others, replace(last, cell=None))
    unlocalised = replace(solution, detections=detections, trajectories=())
    one = landmarks_sessions.score_session(made, unlocalised)
    assert (one.has_poses, one.is_wrong, one.wrong_cells) == (False, False, 0)


def test_odometry_of_long_drives_is_that_of_its_kind() -> None:
    time_ns = 10**18 + np.arange(200) * 20_000_000
    true = Trajectory.from_positions(
        "robot", "map", time_ns, np.column_stack([np.arange(200) * 4e-3, np.zeros((200, 2))])
    )
    floor = FloorMap(np.zeros((1, 1), np.int64))
    session = SimulatedSession((), (true,), (true,), floor, (), (), 0, (), ())
    late, noisy = (
        landmarks_odometry.with_odometry(session, errors, 3).odometry[0]
        for errors in (
            landmarks_odometry.OdometryErrors(0.0, 0.0, scale=0.0, lag_s=0.06),
            landmarks_odometry.OdometryErrors(0.01, 1e-3),
        )
    )
    np.testing.assert_allclose(late.position[10:, 0], true.position[7:-3, 0], atol=1e-9)
    heading = heading_from_quaternion(noisy.quaternion)
    assert np.std(np.diff(heading)) == pytest.approx(0.01 * math.sqrt(4e-3), rel=0.2)
