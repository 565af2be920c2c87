"""Landing curves, and an L of three looked up in a map."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.landmark import PATTERNS, code_of, rotated
from locatk.core.landmarks.map.floor import HOLE, FloorMap
from locatk.core.landmarks.published import search as paper
from locatk.core.landmarks.published.route import Landing, landing, locate, sequence
from locatk.core.landmarks.simulation.session import SimulationOptions, simulate


@given(
    st.floats(-0.02, 0.02),
    st.floats(-0.02, 0.02),
    st.floats(-0.5, 0.5),
    st.floats(0.15, 0.3),
    st.floats(-math.pi, math.pi),
)
def test_two_equal_arcs_lead_to_the_goal(
    x: float, y: float, heading: float, pitch: float, frame: float
) -> None:
    assume(math.hypot(y, heading) > 1e-3)
    cos, sin = math.cos(frame), math.sin(frame)
    start = np.array([cos * x - sin * y, sin * x + cos * y, heading + frame])
    goal = np.array([cos * pitch, sin * pitch, frame])
    curve = landing(start, goal)
    # Driven by Euler's small steps, not by the curve's own formula.
    steps = 2000
    bend = np.repeat([math.copysign(1 / curve.radius_m, arc) for arc in curve.arc_rad], steps)
    size = np.repeat([abs(arc) * curve.radius_m / steps for arc in curve.arc_rad], steps)
    turned = start[2] + np.concatenate([[0], np.cumsum(bend * size)])
    middle = (turned[1:] + turned[:-1]) / 2
    end = start[:2] + [np.sum(size * np.cos(middle)), np.sum(size * np.sin(middle))]
    assert np.allclose(end, goal[:2], atol=1e-6)
    assert abs(math.remainder(turned[-1] - goal[2], math.tau)) < 1e-6
    assert curve.arc_rad[0] * curve.arc_rad[1] <= 0
    poses = curve.poses(start, [0.0, curve.length_m / 2, curve.length_m])
    assert np.allclose(poses[0], start)
    assert np.allclose(poses[2, :2], goal[:2], atol=1e-9)
    # no detour: an error this small needs hardly more than the straight way
    assert curve.length_m < 1.3 * np.hypot(*(goal - start)[:2])


def test_without_an_error_the_way_is_straight() -> None:
    curve = landing((0, 0, 0), (0.2, 0, 0))
    assert curve == Landing(math.inf, (0.0, 0.0), 0.2)
    assert np.allclose(curve.poses((0, 0, 0), [0.1]), [[0.1, 0, 0]])
    small = landing((0, 1e-4, 0), (0.2, 0, 0))
    # R = D^2 / (4 e) to first order
    assert math.isclose(small.radius_m, 0.04 / 4e-4, rel_tol=1e-4)
    assert small.arc_rad[0] < 0 < small.arc_rad[1]


def test_no_curve() -> None:
    with pytest.raises(DegenerateError, match="two places"):
        landing((0, 0, 0), (0, 0, 1))
    with pytest.raises(DegenerateError, match="behind"):
        landing((0, 0, 0), (-0.2, 0, 0))


def published(folder: Path, file: str) -> np.ndarray:
    lines = (folder / "landmarks" / file).read_text().splitlines()[1:]
    rows = [line.strip() for line in lines if line.strip()]
    return np.array([[int(letter, 16) for letter in row] for row in rows])


def drive(codes: np.ndarray, row: int, column: int, q: int, turn: int) -> list[tuple] | None:
    """What a robot reads on an L, by complex steps: (row, column, heading, code)."""
    at, ahead, seen = complex(column, row), 1j**q, []
    for k in range(3):
        r, c = round(at.imag), round(at.real)
        if not (0 <= r < codes.shape[0] and 0 <= c < codes.shape[1]):
            return None
        seen.append((r, c, q + (k == 2) * turn, int(rotated(codes[r, c], -q - (k == 2) * turn))))
        if k == 1:
            ahead *= 1j**turn
        at += ahead
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("turn", [1, -1])
def test_each_l_of_the_published_map_is_found(data: Path, turn: int) -> None:
    codes = published(data, "or16_L_24x24.txt")
    floor = FloorMap(codes)
    rng = np.random.default_rng(turn + 5)
    count = 0
    while count < 40:
        row, column, q = (int(k) for k in rng.integers([24, 24, 4]))
        seen = drive(codes, row, column, q, turn)
        if seen is None:
            continue
        found = locate(floor, [code for *_, code in seen], (0, turn))
        assert found.status == "found"
        r, c, heading, _ = seen[-1]
        assert found.places == (((r, c), heading % 4),)
        count += 1


def test_each_l_of_the_published_map_of_six_is_found(data: Path) -> None:
    letters = published(data, "id6_L_7x7.txt")
    codes = np.array([code_of(p) for p in PATTERNS])[letters]
    floor = FloorMap(codes, alphabet="6")
    for row in range(7):
        for column in range(7):
            for q in range(4):
                seen = drive(codes, row, column, q, 1)
                if seen is not None:
                    r, c, heading, _ = seen[-1]
                    found = locate(floor, [code for *_, code in seen])
                    assert found.places == (((r, c), heading % 4),)


def test_nothing_ambiguous_walls_and_holes() -> None:
    floor = FloorMap(np.array([[1, 2, 5], [4, 8, 3]]))
    # Under heading 0 from cell (0, 0): 1, then 2, then to the left (1, 1), read from below.
    codes = [1, 2, int(rotated(8, -1))]
    assert locate(floor, codes).places == (((1, 1), 1),)
    assert locate(floor, [15, 15, 15]).status == "none"
    wall = replace(floor, walls=frozenset({((0, 0), (0, 1))}))
    assert locate(wall, codes).status == "none"
    hole = replace(floor, codes=np.array([[1, HOLE, 5], [4, 8, 3]]))
    assert locate(hole, codes).status == "none"
    alike = locate(FloorMap(np.full((2, 2), 15)), [15, 15, 15])
    assert alike.status == "ambiguous"
    assert len(alike.places) == 4
    with pytest.raises(ValueError, match="3 codes need 2 turns"):
        locate(floor, codes, (0,))


def sighted(x: float, y: float, heading: float, pose: tuple, code: int) -> VisitHypotheses:
    """A landmark seen from (x, y, heading) of the odometry, the robot at ``pose`` in its frame."""
    unknown = np.full(4, np.nan)
    best = Hypothesis(code, 1.0, np.array(pose), np.full((3, 3), np.nan), unknown, unknown)
    return VisitHypotheses("robot", 0, 0, 1, np.array([x, y, heading]), (best,))


def test_a_sequence_turns_codes_to_the_frames_of_arrival() -> None:
    # All by hand: a map of three landmarks whose frame is the odometry's. The robot looks
    # along +y, +x and -x when it reads; it has come from (0, 0) by (0.2, 0) to (0.2, 0.2).
    laid = (0b0001, 0b0110, 0b1011)
    seen = [
        sighted(0.001, 0.0, math.pi / 2, (0.0, -0.001, 0.0), int(rotated(laid[0], -1))),
        sighted(0.2, 0.0, 0.1, (0.0, 0.0, 0.1), laid[1]),
        sighted(0.2, 0.202, -math.pi, (0.0, -0.002, 0.0), int(rotated(laid[2], -2))),
    ]
    codes, turns = sequence(seen, 0.2) or ((), ())
    assert turns == (0, 1)
    assert codes == (laid[0], laid[1], int(rotated(laid[2], -1)))
    floor = FloorMap(np.array([[laid[0], laid[1]], [7, laid[2]]]))
    assert locate(floor, codes, turns).places == (((1, 1), 1),)
    # one left out, and one askew
    assert sequence([seen[0], seen[2]], 0.2) is None
    assert sequence([seen[0], sighted(0.16, 0.12, 0, (0, 0, 0), 3)], 0.2) is None
    assert sequence(seen[:1], 0.2) == ((int(rotated(laid[0], -1)),), ())


@pytest.mark.slow
def test_a_robot_finds_itself_on_the_published_map(data: Path) -> None:
    floor = FloorMap(published(data, "or16_L_24x24.txt"))
    found = 0
    for seed in (0, 3, 5, 8):
        made = simulate(floor, SimulationOptions(seed=seed))
        seen = paper.sightings(made.samples[0], made.odometry[0], floor.geometry)
        read = [one for one in seen if not one.refused]
        drawn = sequence(read, floor.pitch_m) if len(read) == 3 else None
        if drawn is None:
            continue
        place = locate(floor, *drawn)
        assert place.status == "found"
        assert place.places[0][0] == made.events[-1].cell
        found += 1
    assert found >= 2
