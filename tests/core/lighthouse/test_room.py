"""Rooms: outlines of walls, obstacles, working volume, and what their numbers must fulfil."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.geometry import Similarity, rotation_exp
from locatk.core.lighthouse.room import Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Scene
from locatk.core.polygons import checked_outline, rectangle, signed_area

L_SHAPE = np.array([[0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3]], float)


@given(st.integers(0, 5), st.booleans(), st.booleans(), st.floats(-100, 100))
def test_outlines_are_counter_clockwise_whatever_their_order(
    first: int, is_clockwise: bool, is_closed: bool, shift: float
) -> None:
    corners = np.roll(L_SHAPE, first, axis=0) + shift
    corners = corners[::-1] if is_clockwise else corners
    checked = checked_outline(np.vstack([corners, corners[:1]]) if is_closed else corners)
    assert len(checked) == 6
    assert signed_area(checked) == pytest.approx(4 * 1 + 1 * 2)
    assert {tuple(c) for c in checked.tolist()} == {tuple(c) for c in corners.tolist()}


@given(st.integers(3, 9), st.integers(0, 10**6))
def test_star_shaped_outlines_are_accepted_and_crossed_ones_are_not(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n
    star = (rng.uniform(1, 3, n) * [np.cos(angle), np.sin(angle)]).T
    assert len(checked_outline(star)) == n
    if n > 3:
        # Four corners on a circle in the order 0, 2, 1, 3 cross for sure.
        crossed = star.copy()
        crossed[[1, 2]] = crossed[[2, 1]]
        a, b, c, d = (star[k] for k in range(4))
        if _segments_cross(a, c, b, d):
            with pytest.raises(InputError, match="crosses"):
                checked_outline(crossed)


def _segments_cross(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """Solve for both fractions along the segments."""
    matrix = np.stack([b - a, c - d], axis=1)
    if abs(np.linalg.det(matrix)) < 1e-9:
        return False
    s, t = np.linalg.solve(matrix, c - a)
    return bool(0.01 < s < 0.99 and 0.01 < t < 0.99)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([[0, 0], [1, 0]], "2 corners"),
        ([[0, 0], [1, 0], [2, 0]], "without area|touches"),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], "same position"),
        ([[0, 0], [2, 0], [2, 2], [1, 0], [0, 2]], "touches"),
        ([[0, 0], [4, 0], [2, 0], [2, 2]], "touches"),
        ([[0, 0], [5000, 0], [5000, 4000]], "unit|beyond"),
        ([[0, 0], [np.nan, 0], [1, 1]], "beyond"),
        ([0, 1, 2], "list of x and y"),
    ],
)
def test_outlines_that_are_no_rooms_are_refused(corners: list, message: str) -> None:
    with pytest.raises(InputError, match=message):
        checked_outline(corners)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Room(rectangle(4, 3), 0.0),
        lambda: Room(rectangle(4, 3), float("nan")),
        lambda: Room(rectangle(4, 3), 3.0, (1.0, 0.5)),
        lambda: Room(rectangle(4, 3), 3.0, (-0.1, 0.5)),
        lambda: Room(rectangle(4, 3), 3.0, (0.0, 3.0)),
        lambda: Room(rectangle(4, 3), 3.0, mounts=("roof",)),
        lambda: Room(rectangle(4, 3), 3.0, mounts=()),
        lambda: Room(rectangle(4, 3), 3.0, mounts=("tripod",)),
        lambda: Room(rectangle(4, 3), 3.0, tripods_m=np.array([[np.inf, 0, 0]])),
        lambda: Obstacle(rectangle(1, 1), 1.0, 1.0),
        lambda: RobotSize(0),
        lambda: RobotSize(2, -0.1),
    ],
)
def test_rooms_with_impossible_numbers_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(InputError):
        make()


def test_a_room_stays_where_its_frame_is() -> None:
    """As markers, the room is in the frame to which the stations are transformed."""
    room = Room(rectangle(4, 3), 3.0)
    moved = Scene(room=room).transformed(Similarity(2.0, rotation_exp([0, 0, 1.0]), np.ones(3)))
    assert moved.room is room
