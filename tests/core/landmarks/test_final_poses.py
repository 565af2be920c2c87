"""Landmarks until poses are final, against the cell filter of the solver on the same drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from locatk.core.landmarks.design import final_poses
from locatk.core.landmarks.design.final_poses import MapEvidence, count_landmarks_until_final
from locatk.core.landmarks.design.localization_steps import LocalizationDrive
from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import PATTERNS, code_of, rotated
from locatk.core.landmarks.localization.cell_filter import identify_cells
from locatk.core.landmarks.map.floor import ALPHABETS, HOLE_CODE, Cell, FloorMap
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.trajectory import PROVISIONAL_PROBABILITY

CODES = {
    "6": [code_of(letters) for letters in PATTERNS],
    "16": range(16),
    "compass": [code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")],
}

State = tuple[Cell, int]


def draw(seed: int, alphabet: str) -> FloorMap:
    """A floor with some holes."""
    rng = np.random.default_rng(seed)
    codes = rng.choice(CODES[alphabet], tuple(rng.integers(5, 12, 2)))
    codes[rng.random(codes.shape) < 0.05] = HOLE_CODE
    return FloorMap(codes, alphabet=alphabet)


def drive_from(floor: FloorMap, start: int, steps: int) -> list[State]:
    drive = LocalizationDrive.on(floor)
    state, path = start * drive.phases, []
    for _ in range(steps):
        cell, heading = divmod(state // drive.phases, 4)
        path.append((divmod(cell, floor.shape[1]), heading))
        state = int(drive.next_state[state])
    return path


def visit(floor: FloorMap, number: int, state: State) -> VisitHypotheses:
    """A landmark that is read right and beyond doubt, with exact odometry."""
    cell, heading = state
    code = int(rotated(int(floor.codes[cell]), -heading))
    own = Hypothesis(code, 1.0, np.zeros(3), np.eye(3) * 1e-7, np.ones(4), np.ones(4))
    odometry = np.array([*floor.position(cell), heading * math.pi / 2])
    return VisitHypotheses("robot", number, 0, 1, odometry, (own,))


def until_final_by_the_filter(floor: FloorMap, path: list[State]) -> int | None:
    visits = [visit(floor, number, state) for number, state in enumerate(path)]
    for count in range(1, len(path) + 1):
        found = identify_cells(
            visits[:count], floor, misread=SolveOptions.misread, drift=OdometryDrift()
        )
        of_cell = min(one.probability for one in found.estimates)
        if found.map_probability * of_cell >= PROVISIONAL_PROBABILITY:
            return len({cell for cell, _ in path[:count]})
    return None


@pytest.mark.slow
@pytest.mark.parametrize("alphabet", ALPHABETS)
@pytest.mark.parametrize("seed", range(20, 23))
def test_the_count_is_that_of_the_filter(alphabet: str, seed: int) -> None:
    floor = draw(seed, alphabet)
    evidence, drive = MapEvidence(floor, SolveOptions.misread), LocalizationDrive.on(floor)
    starts = 4 * np.flatnonzero(floor.codes.reshape(-1) != HOLE_CODE)
    for start in np.random.default_rng(seed).choice(starts, 3) + np.arange(3):
        count = evidence.landmarks_until_final(drive, int(start))
        path = drive_from(floor, int(start), 24)
        assert count == until_final_by_the_filter(floor, path)


def test_counts_of_all_starts() -> None:
    floor = FloorMap(np.random.default_rng(3).integers(0, 16, (6, 7)))
    final = count_landmarks_until_final(floor)
    assert (final.starts, final.never) == (4 * 42, 0)
    # 16 codes per landmark against 4 x 12 x 13 states of the filter, and a thousandth.
    assert final.mean == pytest.approx(math.log(1000 * 4 * 12 * 13, 16), abs=1.0)
    assert 4 <= final.mean <= final.p99 <= final.worst
    (row, column), heading = final.worst_start
    evidence = MapEvidence(floor, SolveOptions.misread)
    start = 4 * (7 * row + column) + heading
    assert evidence.landmarks_until_final(LocalizationDrive.on(floor), start) == final.worst


@pytest.mark.slow
def test_large_floors_are_sampled_reproducibly(monkeypatch: pytest.MonkeyPatch) -> None:
    floor = FloorMap(np.random.default_rng(4).integers(0, 16, (20, 20)))
    everything = count_landmarks_until_final(floor)
    monkeypatch.setattr(final_poses, "MAX_COMPARISONS", 4 * 26 * 26 * 50)
    final = count_landmarks_until_final(floor)
    assert final == count_landmarks_until_final(floor)
    assert (final.starts, everything.starts) == (50, 1600)
    assert final.mean == pytest.approx(everything.mean, abs=0.3)


def test_floors_on_which_poses_stay_provisional() -> None:
    """Three landmarks are too few, and a floor of equal landmarks says nothing."""
    for codes in (np.array([[1, 2, 7]]), np.full((6, 6), 5), np.full((2, 2), HOLE_CODE)):
        final = count_landmarks_until_final(FloorMap(codes))
        assert final.never == final.starts == 4 * np.count_nonzero(codes != HOLE_CODE)
        assert (final.mean, final.p99, final.worst, final.worst_start) == (None,) * 4


@pytest.mark.slow
def test_fewer_misread_landmarks_need_fewer_landmarks() -> None:
    floor = FloorMap(np.random.default_rng(5).choice(CODES["compass"], (8, 8)), alphabet="compass")
    often, seldom = (count_landmarks_until_final(floor, misread=rate) for rate in (0.2, 0.001))
    assert often.mean > seldom.mean + 1


def test_two_rooms_of_which_one_is_the_other_rotated_are_never_distinguished() -> None:
    room = np.random.default_rng(6).integers(0, 16, (6, 6))
    # Rows ascend with y, so that np.rot90 turns clockwise as seen from above.
    other = rotated(np.rot90(room), -1)
    wall = np.full((6, 1), HOLE_CODE)
    assert count_landmarks_until_final(FloorMap(np.hstack([room, wall, other]))).never == 4 * 72
    # Without the rotation of the codes each landmark differs.
    unlike = FloorMap(np.hstack([room, wall, np.rot90(room)]))
    assert count_landmarks_until_final(unlike).never == 0
