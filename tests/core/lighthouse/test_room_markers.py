"""Markers of designed rooms."""

from __future__ import annotations

import numpy as np

from locatk.core.lighthouse.design.markers import WALL_DISTANCE_M, propose_markers
from locatk.core.lighthouse.room import Obstacle, Room
from locatk.core.polygons import rectangle

L_SHAPE = np.array([[0, 0], [6, 0], [6, 2], [2, 2], [2, 5], [0, 5.0]])


def grid(z_m: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.05, 6, 0.1), np.arange(0.05, 5, 0.1))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])
    return points[(points[:, 0] < 2) | (points[:, 1] < 2)]


def nearest_edge_m(outline: np.ndarray, point: np.ndarray) -> float:
    """Distance from an outline, by sampling its edges."""
    ends = np.roll(outline, -1, axis=0)
    samples = outline[:, None] + np.linspace(0, 1, 2000)[:, None] * (ends - outline)[:, None]
    return float(np.linalg.norm(samples - point, axis=-1).min())


def test_markers_are_far_apart_and_away_from_walls_and_obstacles() -> None:
    table = Obstacle(rectangle(0.6, 0.6, (5.0, 0.2)), 0.0, 0.7)
    room = Room(L_SHAPE, 2.5, (0.08, 0.08), obstacles=(table,))
    markers = propose_markers(room, grid(0.08))
    assert [marker.name for marker in markers] == [f"marker-{k}" for k in (1, 2, 3, 4)]
    places = np.array([marker.position for marker in markers])
    assert np.all(places[:, 2] == 0.08)
    np.testing.assert_allclose(places[:, :2] / 0.05, np.round(places[:, :2] / 0.05), atol=1e-9)
    for place in places[:, :2]:
        assert nearest_edge_m(L_SHAPE, place) >= WALL_DISTANCE_M - 1e-3
        assert nearest_edge_m(table.outline_m, place) >= WALL_DISTANCE_M - 1e-3
    gaps = np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(4, 1)]
    assert gaps.min() > 1.0
    # Three of them are not on a line, so that they fix a frame.
    assert np.linalg.svd(places[:, :2] - places[:, :2].mean(axis=0))[1][1] > 0.5


def test_markers_are_only_where_photodiodes_are_located() -> None:
    room = Room(L_SHAPE, 2.5, (0.0, 1.5))
    covered = grid(0.0)
    covered = covered[covered[:, 0] < 1.5]
    high = covered + [0.0, 0.0, 1.0]
    markers = propose_markers(room, np.concatenate([covered, high]))
    assert max(marker.position[0] for marker in markers) <= 1.5
    assert {marker.position[2] for marker in markers} == {0.0}


def test_a_room_without_space_has_no_markers() -> None:
    room = Room(rectangle(0.5, 0.5), 2.5)
    assert propose_markers(room, np.array([[0.25, 0.25, 0.0]])) == ()
    assert propose_markers(room, np.zeros((0, 3))) == ()
