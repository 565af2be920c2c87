"""Cell filter with wheel slips, outliers, carried robots and other floors; exact probabilities."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT, rotated
from locatk.core.landmarks.localization import cell_filter, cell_steps
from locatk.core.landmarks.localization.cell_filter import (
    CellIdentification,
    CellModel,
    identify_cells,
)
from locatk.core.landmarks.localization.cell_steps import steps_between
from locatk.core.landmarks.map.floor import STEPS, Cell, FloorMap

Array = NDArray[np.float64]
State = tuple[Cell, int]

MISREAD = 0.02
HALF_PI = math.pi / 2


def random_floor(seed: int, size: int = 24) -> FloorMap:
    return FloorMap(np.random.default_rng(seed).integers(0, CODE_COUNT, (size, size)))


def random_path(floor: FloorMap, random: np.random.Generator, count: int) -> list[State]:
    """Drive ahead, left or right from cell to cell of a floor."""
    rows, columns = floor.shape
    cell = (int(random.integers(rows)), int(random.integers(columns)))
    heading = int(random.integers(4))
    path = [(cell, heading)]
    while len(path) < count:
        turned = (heading + int(random.choice([0, 0, 0, 1, -1]))) % 4
        row, column = cell[0] + STEPS[turned][0], cell[1] + STEPS[turned][1]
        if 0 <= row < rows and 0 <= column < columns:
            cell, heading = (row, column), turned
            path.append((cell, heading))
        else:
            heading = (heading + 1) % 4
    return path


def visit(
    floor: FloorMap,
    state: State,
    random: np.random.Generator,
    frame: Array,
    code: int | None = None,
) -> VisitHypotheses:
    """Visit a cell, millimetres and degrees off, with odometry in any frame."""
    (cell, quarters) = state
    pose = np.array([*random.normal(0, 5e-3, 2), random.normal(0, 0.2)])
    cos, sin = math.cos(quarters * HALF_PI), math.sin(quarters * HALF_PI)
    on_map = np.array(
        [
            floor.position(cell)[0] + cos * pose[0] - sin * pose[1],
            floor.position(cell)[1] + sin * pose[0] + cos * pose[1],
            quarters * HALF_PI + pose[2],
        ]
    )
    designed = int(floor.codes[cell]) if code is None else code
    own = Hypothesis(
        int(rotated(designed, -quarters)), 1.0, pose, np.eye(3) * 1e-7, np.ones(4), np.ones(4)
    )
    return VisitHypotheses("robot", 0, 0, 1, moved(frame, on_map), (own,))


def moved(frame: Array, pose: Array) -> Array:
    cos, sin = math.cos(frame[2]), math.sin(frame[2])
    x, y = frame[0] + cos * pose[0] - sin * pose[1], frame[1] + sin * pose[0] + cos * pose[1]
    return np.array([x, y, frame[2] + pose[2]])


def visits_along(
    floor: FloorMap, path: Sequence[State], random: np.random.Generator
) -> list[VisitHypotheses]:
    frame = random.uniform(-3, 3, 3)
    return [visit(floor, state, random, frame) for state in path]


def with_slip(
    visits: Sequence[VisitHypotheses], at: int, shift_m: tuple[float, float], rotation_rad: float
) -> list[VisitHypotheses]:
    """Let odometry jump, in the frame of the robot, after the visit before ``at``."""
    origin = visits[at - 1].odometry
    after = moved(origin, np.array([*shift_m, rotation_rad]))
    result = list(visits[:at])
    for each in visits[at:]:
        offset = each.odometry - origin
        cos, sin = math.cos(-origin[2]), math.sin(-origin[2])
        local = np.array(
            [cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1], offset[2]]
        )
        result.append(replace(each, odometry=moved(after, local)))
    return result


def identify(visits: Sequence[VisitHypotheses], floor: FloorMap) -> CellIdentification:
    return identify_cells(visits, floor, misread=MISREAD, drift=OdometryDrift())


def wrong_cells(result: CellIdentification, path: Sequence[State]) -> list[int]:
    return [
        number
        for number, (one, state) in enumerate(zip(result.estimates, path, strict=True))
        if one.probability < 0.8 or (one.cell, one.quarters) != state
    ]


# ---- faults


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shift_m", "rotation_deg"),
    [((0.02, 0.0), 0), ((0.1, -0.03), 0), ((0.19, 0.0), 0), ((0.0, 0.0), 10), ((0.03, 0.0), 45)],
)
def test_wheel_slips_lose_no_visit(shift_m: tuple[float, float], rotation_deg: float) -> None:
    lost = 0
    for seed in range(8):
        random, floor = np.random.default_rng(seed), random_floor(seed + 50)
        path = random_path(floor, random, 12)
        visits = visits_along(floor, path, random)
        slipped = with_slip(visits, 6, shift_m, math.radians(rotation_deg))
        lost += len(wrong_cells(identify(slipped, floor), path))
    # A reading that fits both before and after a slip is left open: one of 16.
    assert lost <= 2


def test_carried_robots_are_localized_again() -> None:
    """The odometry of a lifted robot hardly moves, whatever its path on the floor."""
    for seed in range(8):
        random, floor = np.random.default_rng(seed), random_floor(seed + 50)
        paths = [random_path(floor, random, count) for count in (7, 5, 5)]
        visits = visits_along(floor, paths[0], random)
        for path in paths[1:]:
            start = moved(visits[-1].odometry, random.normal(0, [0.05, 0.05, 0.5]))
            on_map = visit(floor, path[0], np.random.default_rng(seed), np.zeros(3)).odometry
            rotation = start[2] - on_map[2]
            offset = start - moved(np.array([0.0, 0.0, rotation]), on_map)
            frame = np.array([offset[0], offset[1], rotation])
            own = np.random.default_rng(seed)
            visits += [visit(floor, state, own, frame) for state in path]
        result = identify(visits, floor)
        assert wrong_cells(result, [state for path in paths for state in path]) == []


def test_a_robot_that_is_carried_back_to_old_odometry_is_localized_again() -> None:
    """By odometry it visits the same landmarks again; their codes tell that it does not."""
    for seed in range(4):
        random, floor = np.random.default_rng(seed), random_floor(seed + 50)
        first = [((3, 3 + k), 0) for k in range(6)]
        second = [((15, 12 + k), 0) for k in range(6)]
        frame = np.zeros(3)
        visits = [visit(floor, state, random, frame) for state in first]
        back = np.array([-9 * floor.pitch_m, -12 * floor.pitch_m, 0.0])
        visits += [visit(floor, state, random, back) for state in second]
        result = identify(visits, floor)
        assert wrong_cells(result, first + second) == []


def test_a_visit_with_wrong_pose_and_code_costs_no_other() -> None:
    flagged = 0
    for seed in range(10):
        random, floor = np.random.default_rng(seed), random_floor(seed + 50)
        path = random_path(floor, random, 10)
        visits = visits_along(floor, path, random)
        at = int(random.integers(1, 9))
        best = visits[at].best
        far = replace(best, code=int(random.integers(16)), pose=best.pose + [3.1, -1.3, 0.4])
        visits[at] = replace(visits[at], hypotheses=(far,))
        result = identify(visits, floor)
        assert [n for n in wrong_cells(result, path) if n != at] == []
        flagged += result.estimates[at].outlier_probability > 0.9
    assert flagged >= 8


def test_landmarks_that_differ_from_the_map_are_misread() -> None:
    random, floor = np.random.default_rng(5), random_floor(5)
    path = random_path(floor, random, 10)
    frame = np.zeros(3)
    wrong = (int(floor.codes[path[4][0]]) + 5) % CODE_COUNT
    visits = [
        visit(floor, state, random, frame, wrong if state[0] == path[4][0] else None)
        for state in path
    ]
    result = identify(visits, floor)
    assert wrong_cells(result, path) == []
    misread = [one.misread_probability > 0.99 for one in result.estimates]
    assert misread == [state[0] == path[4][0] for state in path]


# ---- other floors


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 4, 5, 6, 9])
def test_readings_of_another_floor_are_never_believed(count: int) -> None:
    floor = random_floor(1)
    for seed in range(12):
        random = np.random.default_rng(seed)
        other = FloorMap(random.permutation(floor.codes.ravel()).reshape(floor.shape))
        path = random_path(other, random, count)
        assert identify(visits_along(other, path, random), floor).map_probability < 0.999


def test_the_right_floor_is_believed_after_enough_landmarks() -> None:
    """Of 24 x 24 cells: 16^5 readings are too few for 999 to 1 among 2,304 starts, 16^6 suffice."""
    floor = random_floor(1)
    for seed in range(8):
        random = np.random.default_rng(seed)
        path = [((seed + 2, 3 + k), 0) for k in range(6)]
        visits = visits_along(floor, path, random)
        probability = [identify(visits[:count], floor).map_probability for count in (5, 6)]
        assert probability[0] < 0.999 < probability[1]


def test_a_heading_is_no_evidence_of_a_compass_floor() -> None:
    """On maps of three patterns in one orientation each, any floor gives the heading."""
    codes = np.array([1, 3, 7])
    floor = FloorMap(codes[np.random.default_rng(0).integers(0, 3, (8, 8))], alphabet="compass")
    for seed in range(12):
        random = np.random.default_rng(seed)
        other = FloorMap(codes[random.integers(0, 3, (8, 8))], alphabet="compass")
        visits = visits_along(other, random_path(other, random, 6), random)
        assert identify(visits, floor).map_probability < 0.99


@pytest.mark.slow
def test_long_steps_are_no_evidence_of_this_floor() -> None:
    """Odometry over many pitches leaves many cells open, here and on any other floor."""
    hops = [((2 + 7 * (k % 2), 3 + 7 * k), 0) for k in range(5)]
    mixed = [((2, 1 + k), 0) for k in range(4)] + [((9 + k, 13), 1) for k in range(4)]
    for seed in range(4):
        random, floor = np.random.default_rng(seed), random_floor(9, 40)
        other = random_floor(seed, 40)
        assert identify(visits_along(other, hops, random), floor).map_probability < 0.3
        assert identify(visits_along(other, mixed, random), floor).map_probability < 0.3
        assert identify(visits_along(floor, mixed, random), floor).map_probability > 0.999


def test_missed_landmarks_are_no_evidence_of_another_floor() -> None:
    """On a straight path with a landmark unread between every two."""
    random, floor = np.random.default_rng(5), random_floor(5)
    path = [((4, 3 + 2 * k), 0) for k in range(7)]
    assert identify(visits_along(floor, path, random), floor).map_probability > 0.999


def test_a_slip_is_no_evidence_of_another_floor() -> None:
    random, floor = np.random.default_rng(2), random_floor(2)
    path = [((4, 3 + k), 0) for k in range(8)]
    visits = visits_along(floor, path, random)
    slipped = with_slip(visits, 4, (0.1, 0.04), 0.1)
    assert identify(slipped, floor).map_probability > 0.999


# ---- exactness


class ClampedModel(CellModel):
    """Model in which one visit is in one given state."""

    clamped: tuple[int, int] | None = None

    def likelihood(self, visit: int, number: int) -> Array:
        return self._clamp(visit, super().likelihood(visit, number))

    def map_likelihood(self, visit: int, number: int) -> Array:
        return self._clamp(visit, super().map_likelihood(visit, number))

    def any_code_likelihood(self, visit: int) -> float:
        if self.clamped is not None and visit == self.clamped[0]:
            return 0.0
        clamped, self.clamped = self.clamped, None
        value = super().any_code_likelihood(visit)
        self.clamped = clamped
        return value

    def _clamp(self, visit: int, values: Array) -> Array:
        if self.clamped is None or visit != self.clamped[0]:
            return values
        result = np.zeros(self.state_count)
        result[self.clamped[1]] = np.broadcast_to(values, self.state_count)[self.clamped[1]]
        return result


def log_evidence(model: CellModel) -> float:
    belief, evidence = model.initial_belief()
    total = math.log(evidence)
    for number in range(1, len(model.visits)):
        belief, evidence = model.advance(belief, number)
        total += math.log(evidence)
    return total


def test_probabilities_are_ratios_of_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """That of a state is the evidence with the state given, relative to that of all states."""
    monkeypatch.setattr(cell_filter, "MIN_STATE_TO_CARRIED_RATIO", 0.0)
    monkeypatch.setattr(cell_filter, "MIN_SLIP_BELIEF", 0.0)
    monkeypatch.setattr(cell_filter, "CARRIED_WEIGHT", 1e-2)
    monkeypatch.setattr(cell_filter, "OUTLIER_WEIGHT", 0.1)
    random, floor = np.random.default_rng(8), random_floor(8, 5)
    path = [((2, 1), 0), ((2, 2), 0), ((2, 3), 0), ((3, 3), 1), ((2, 3), 3)]
    visits = with_slip(visits_along(floor, path, random), 2, (0.05, 0.02), 0.2)
    second = replace(visits[1].best, code=(visits[1].best.code + 3) % 16, probability=0.3)
    first = replace(visits[1].best, probability=0.7)
    visits[1] = replace(visits[1], hypotheses=(first, second))
    model = ClampedModel(visits, floor, misread=MISREAD, drift=OdometryDrift())
    assert model.confirming  # The last visit repeats the third one.
    total = log_evidence(model)
    estimates = identify_cells(visits, floor, misread=MISREAD, drift=OdometryDrift()).estimates
    for number, one in enumerate(estimates):
        row, column = (index + cell_filter.PAD_CELLS for index in one.cell)
        state = (one.quarters * model.shape[0] + row) * model.shape[1] + column
        model.clamped = number, state
        assert one.probability == pytest.approx(math.exp(log_evidence(model) - total), rel=1e-9)
        model.clamped = None


def test_blocks_give_the_same_as_all_visits_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    random, floor = np.random.default_rng(3), random_floor(3, 12)
    path = random_path(floor, random, 40)
    visits = with_slip(visits_along(floor, path, random), 20, (0.1, 0.0), 0.0)
    at_once = identify(visits, floor)
    monkeypatch.setattr(cell_filter, "BLOCK_VISITS", 5)
    in_blocks = identify(visits, floor)
    assert in_blocks.map_probability == at_once.map_probability
    for one, other in zip(in_blocks.estimates, at_once.estimates, strict=True):
        assert (one.cell, one.quarters) == (other.cell, other.quarters)
        assert one.probability == pytest.approx(other.probability, abs=1e-6)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recording() -> None:
    floor, random = random_floor(0, 100), np.random.default_rng(0)
    visits = visits_along(floor, random_path(floor, random, 120), random)
    peaks = []
    for count in (40, 120):
        tracemalloc.start()
        identify(visits[:count], floor)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]
    assert peaks[1] < 60e6


# ---- steps


def test_steps_that_odometry_confirms_come_first() -> None:
    random, floor = np.random.default_rng(4), random_floor(4)
    first, second = visits_along(floor, [((3, 3), 1), ((4, 3), 1)], random)
    steps = steps_between(
        first, second, first.best, second.best, pitch_m=floor.pitch_m, drift=OdometryDrift()
    )
    assert (steps.cells[0].tolist(), int(steps.quarters[0]) % 4) == ([1, 0], 0)
    assert steps.likelihood[0] > 0.1
    assert np.all(np.diff(steps.likelihood) <= 0)
    assert len(steps.that_odometry_confirms()) == 1
    assert steps.odometry_likelihood[0] > 0.1
    # All cells nearby under all headings are within the reach of a slip.
    assert {int(q) % 4 for q in steps.quarters} == {0, 1, 2, 3}
    assert steps.likelihood[-1] < cell_steps.SLIP_PROBABILITY


def test_odometry_over_a_long_distance_leaves_many_cells_open() -> None:
    random, floor = np.random.default_rng(4), random_floor(4, 40)
    first, second = visits_along(floor, [((3, 3), 0), ((3, 33), 0)], random)
    steps = steps_between(
        first, second, first.best, second.best, pitch_m=floor.pitch_m, drift=OdometryDrift()
    )
    assert len(steps) > 50
    assert steps.likelihood.sum() < 1.1
    agreeing = steps.that_odometry_confirms()
    assert 20 < len(agreeing) < len(steps)
    assert agreeing.odometry_likelihood.min() >= cell_steps.MIN_ODOMETRY_LIKELIHOOD
