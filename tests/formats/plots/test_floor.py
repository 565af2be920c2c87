"""Landmarks on the map of a picture and on a screen: bars as they lie, and what was seen."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import PolyCollection
from matplotlib.text import Text

from locatk.core.geometry import Similarity, quaternion_from_heading
from locatk.core.landmarks.drawing.floor_bars import (
    MAX_DRAWN_LANDMARKS,
    bars_on_floor,
    cells_near,
)
from locatk.core.landmarks.drawing.landmark import bar_outlines
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import AsBuiltLandmark, FloorMap
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.floor import MOST_NAMED, floor_of
from locatk.formats.plots.solution import draw

FLOOR = FloorMap(np.array([[7, -1], [12, 5]]), origin_m=(1.0, -2.0))
START_NS = 1_000_000_000


def seen(cell: tuple[int, int] | None, refused: str = "", time_s: float = 1.0) -> LandmarkDetection:
    return LandmarkDetection(
        time_s=time_s,
        device="robot",
        cell=cell,
        pattern="NNNS",
        code=7,
        probability=1.0,
        x_m=0.004,
        y_m=-0.003,
        heading_rad=0.0,
        sigma_x_m=1e-4,
        sigma_y_m=1e-4,
        sigma_heading_rad=1e-3,
        strength=None,
        residual_sigma=1.0,
        refused=refused,
    )


def solution(
    floor: FloorMap | None, detections: list[LandmarkDetection], n: int = 21, y: float = -2.0
) -> Solution:
    """A drive of 0.2 s along x, 1 m to 1.2 m, at ``y``; no pose at all where ``n`` is 0."""
    track = Trajectory(
        "robot",
        "map",
        START_NS + 10_000_000 * np.arange(n),
        np.column_stack([np.linspace(1.0, 1.2, n), np.full(n, y), np.zeros(n)]),
        quaternion_from_heading(np.zeros(n)),
        np.broadcast_to(np.eye(6) * 1e-6, (n, 6, 6)),
    )
    return Solution("landmarks", "field", (track,) if n else (), {}, tuple(detections), floor)


@settings(max_examples=30, deadline=None)
@given(
    code=st.integers(0, 15),
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.05, 0.05),
    turn=st.floats(-3, 3),
)
def test_bars_lie_as_in_the_installation_pack(code: int, x: float, y: float, turn: float) -> None:
    """The same poles at the same places as on the sheets by which people lay them."""
    from locatk.core.landmarks.landmark import signs

    floor = FloorMap(np.array([[code]]), origin_m=(0.3, 0.4))
    built = AsBuiltLandmark(x, y, turn, signs(code), np.full(7, np.nan))
    for laid, shift, heading in (
        (floor, np.zeros(2), 0.0),
        (replace(floor, built={(0, 0): built}), np.array([x, y]), turn),
    ):
        middle, way, strength = bars_on_floor(laid, (0, 0))
        c, s = math.cos(heading), math.sin(heading)
        rotation = np.array([[c, -s], [s, c]])
        for k, bar in enumerate(bar_outlines(Geometry(), code)):
            poles = np.array([bar.south, bar.north]) * 1e-3 @ rotation.T + [0.3, 0.4] + shift
            half = 0.015 * np.array([math.cos(way[k]), math.sin(way[k])])
            np.testing.assert_allclose([middle[k] - half, middle[k] + half], poles, atol=1e-12)
            assert (strength[k] > 0) == (bar.letter == "N")


def test_halves_of_bars_are_north_and_south() -> None:
    floor = floor_of(solution(FLOOR, [seen((0, 0))]))
    assert floor is not None
    assert floor.north.shape == floor.south.shape == (12, 4, 3)
    assert floor.names == ("0,0", "1,0", "1,1")
    assert floor.met.tolist() == [True, False, False]
    bar = bar_outlines(Geometry(), 7)[1]
    # The middle of each half is halfway between the bar's middle and its pole.
    middle = floor.north[1].mean(axis=0)[:2] - [1.0, -2.0]
    np.testing.assert_allclose(
        middle, 1e-3 * (np.array(bar.north) * 0.75 + np.array(bar.south) * 0.25), atol=1e-12
    )
    area = np.ptp(floor.north, axis=1)
    np.testing.assert_allclose(np.sort(area[:, :2], axis=1), [[0.01, 0.015]] * 12, atol=1e-12)


def test_missing_bars_and_walls_are_drawn() -> None:
    built = AsBuiltLandmark(0, 0, 0, np.array([1.0, 0.1, -1.0, 0.0]), np.full(7, np.nan))
    walls = frozenset({((1, 0), (1, 1))})
    floor = floor_of(solution(replace(FLOOR, built={(1, 1): built}, walls=walls), []))
    assert floor is not None
    assert (len(floor.north), len(floor.weak)) == (10, 2)
    # Halfway between the two cells, along y.
    np.testing.assert_allclose(np.sort(floor.walls[0, :, :2], axis=0), [[1.1, -1.9], [1.1, -1.7]])


def test_sightings_are_on_the_path() -> None:
    detections = [seen((0, 0), time_s=1.1), seen(None, "no_landmark", 1.2), seen((1, 0), "", 9.0)]
    floor = floor_of(solution(FLOOR, detections))
    assert floor is not None
    # The last one is long after the path, and stands where it was seen from.
    np.testing.assert_allclose(floor.seen, [[1.1, -2, 0], [1.004, -1.803, 0]], atol=1e-9)
    np.testing.assert_allclose(floor.refused, [[1.2, -2, 0]])
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = floor.moved(Similarity(1.0, turn, np.array([1.0, 2, 0])))
    for name in ("north", "south", "centres", "seen", "refused"):
        there = getattr(floor, name) @ turn.T + [1, 2, 0]
        np.testing.assert_allclose(getattr(moved, name), there, atol=1e-12)


@pytest.mark.parametrize("n", [21, 0])
def test_the_picture_shows_the_floor(n: int) -> None:
    """With a path, and without one where the robot is not localised."""
    figure = draw(solution(FLOOR, [seen((0, 0) if n else None, "" if n else "off_map")], n))
    ground = figure.axes[0]
    halves = [c for c in ground.collections if isinstance(c, PolyCollection)]
    assert [len(c.get_paths()) for c in halves] == [12, 12]
    labels = {text.get_text() for text in ground.findobj(Text)}
    assert "0,0" in labels
    (left, right), (low, high) = ground.get_xlim(), ground.get_ylim()
    points = np.concatenate([p.vertices for p in halves[0].get_paths()[:4]])
    assert left < points[:, 0].min() < points[:, 0].max() < right
    assert low < points[:, 1].min() < points[:, 1].max() < high
    named = [text.get_text() for legend in figure.findobj(Text) for text in [legend]]
    assert "north pole" in named
    assert ("landmark seen" in named) == bool(n)


def test_other_systems_have_no_floor() -> None:
    assert floor_of(solution(None, [])) is None


def test_of_a_large_floor_only_what_is_near_is_drawn() -> None:
    large = FloorMap(np.full((60, 60), 3), origin_m=(1.0, -2.0))
    assert len(large.cells()) > MAX_DRAWN_LANDMARKS
    path = solution(large, []).trajectories[0].position
    near = cells_near(large, [path, np.full((1, 3), np.nan)])
    assert set(near) == {(row, column) for row in range(4) for column in range(5)}
    assert cells_near(large, []) == []
    figure = draw(solution(large, [seen((0, 0))], y=4.0))
    assert len(figure.axes[0].texts) <= MOST_NAMED
    assert draw(solution(large, [], n=0)).axes
