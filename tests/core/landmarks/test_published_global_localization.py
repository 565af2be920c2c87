"""Landing curves, and an L of three looked up in a map."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.landmark import PATTERNS, code_of, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.landmarks.published.global_localization import landmark_sequence, match_map
from locatk.core.landmarks.published.search import detect_landmarks
from locatk.core.landmarks.simulation.session import SimulationOptions, simulate


def published(folder: Path, file: str) -> np.ndarray:
    lines = (folder / "landmarks" / file).read_text().splitlines()[1:]
    rows = [line.strip() for line in lines if line.strip()]
    return np.array([[int(letter, 16) for letter in row] for row in rows])


def drive(codes: np.ndarray, row: int, column: int, q: int, turn: int) -> list[tuple] | None:
    """What a robot reads on an L, by complex steps: (row, column, heading, code)."""
    at, ahead, observed = complex(column, row), 1j**q, []
    for k in range(3):
        r, c = round(at.imag), round(at.real)
        if not (0 <= r < codes.shape[0] and 0 <= c < codes.shape[1]):
            return None
        observed.append(
            (r, c, q + (k == 2) * turn, int(rotated(codes[r, c], -q - (k == 2) * turn)))
        )
        if k == 1:
            ahead *= 1j**turn
        at += ahead
    return observed


@pytest.mark.slow
@pytest.mark.parametrize("turn", [1, -1])
def test_each_l_of_the_published_map_is_found(data: Path, turn: int) -> None:
    codes = published(data, "or16_L_24x24.txt")
    floor = FloorMap(codes)
    rng = np.random.default_rng(turn + 5)
    count = 0
    while count < 15:
        row, column, q = (int(k) for k in rng.integers([24, 24, 4]))
        observed = drive(codes, row, column, q, turn)
        if observed is None:
            continue
        result = match_map(floor, [code for *_, code in observed], (0, turn))
        assert result.status == "found"
        r, c, heading, _ = observed[-1]
        assert result.positions == (((r, c), heading % 4),)
        count += 1


def test_each_l_of_the_published_map_of_six_is_found(data: Path) -> None:
    letters = published(data, "id6_L_7x7.txt")
    codes = np.array([code_of(p) for p in PATTERNS])[letters]
    floor = FloorMap(codes, alphabet="6")
    for row in range(7):
        for column in range(7):
            for q in range(4):
                observed = drive(codes, row, column, q, 1)
                if observed is not None:
                    r, c, heading, _ = observed[-1]
                    result = match_map(floor, [code for *_, code in observed])
                    assert result.positions == (((r, c), heading % 4),)


def test_nothing_ambiguous_walls_and_holes() -> None:
    floor = FloorMap(np.array([[1, 2, 5], [4, 8, 3]]))
    # Under heading 0 from cell (0, 0): 1, then 2, then to the left (1, 1), read from below.
    codes = [1, 2, int(rotated(8, -1))]
    assert match_map(floor, codes).positions == (((1, 1), 1),)
    assert match_map(floor, [15, 15, 15]).status == "none"
    wall = replace(floor, walls=frozenset({((0, 0), (0, 1))}))
    assert match_map(wall, codes).status == "none"
    hole = replace(floor, codes=np.array([[1, HOLE_CODE, 5], [4, 8, 3]]))
    assert match_map(hole, codes).status == "none"
    alike = match_map(FloorMap(np.full((2, 2), 15)), [15, 15, 15])
    assert alike.status == "ambiguous"
    assert len(alike.positions) == 4
    with pytest.raises(ValueError, match="3 codes need 2 rotations"):
        match_map(floor, codes, (0,))


def sighted(x: float, y: float, heading: float, pose: tuple, code: int) -> VisitHypotheses:
    """A landmark seen from (x, y, heading) of the odometry, the robot at ``pose`` in its frame."""
    unknown = np.full(4, np.nan)
    best = Hypothesis(code, 1.0, np.array(pose), np.full((3, 3), np.nan), unknown, unknown)
    return VisitHypotheses("robot", 0, 0, 1, np.array([x, y, heading]), (best,))


def test_a_sequence_turns_codes_to_the_frames_of_arrival() -> None:
    # All by hand: a map of three landmarks whose frame is the odometry's. The robot looks
    # along +y, +x and -x when it reads; it has come from (0, 0) by (0.2, 0) to (0.2, 0.2).
    installed = (0b0001, 0b0110, 0b1011)
    observed = [
        sighted(0.001, 0.0, math.pi / 2, (0.0, -0.001, 0.0), int(rotated(installed[0], -1))),
        sighted(0.2, 0.0, 0.1, (0.0, 0.0, 0.1), installed[1]),
        sighted(0.2, 0.202, -math.pi, (0.0, -0.002, 0.0), int(rotated(installed[2], -2))),
    ]
    codes, rotations = landmark_sequence(observed, 0.2) or ((), ())
    assert rotations == (0, 1)
    assert codes == (installed[0], installed[1], int(rotated(installed[2], -1)))
    floor = FloorMap(np.array([[installed[0], installed[1]], [7, installed[2]]]))
    assert match_map(floor, codes, rotations).positions == (((1, 1), 1),)
    # one left out, and one askew
    assert landmark_sequence([observed[0], observed[2]], 0.2) is None
    assert landmark_sequence([observed[0], sighted(0.16, 0.12, 0, (0, 0, 0), 3)], 0.2) is None
    assert landmark_sequence(observed[:1], 0.2) == ((int(rotated(installed[0], -1)),), ())


@pytest.mark.slow
def test_a_robot_finds_itself_on_the_published_map(data: Path) -> None:
    floor = FloorMap(published(data, "or16_L_24x24.txt"))
    localized_count = 0
    for seed in (0, 3, 5, 8):
        generated = simulate(floor, SimulationOptions(seed=seed, rate_hz=100))
        observed = detect_landmarks(generated.samples[0], generated.odometry[0], floor.geometry)
        read = [one for one in observed if not one.refused]
        drawn = landmark_sequence(read, floor.pitch_m) if len(read) == 3 else None
        if drawn is None:
            continue
        match = match_map(floor, *drawn)
        assert match.status == "found"
        assert match.positions[0][0] == generated.events[-1].cell
        localized_count += 1
    assert localized_count >= 2
