"""Comparison of predicted and reached accuracy in rooms."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.geometry import apply_homography, fit_homography
from locatk.core.lighthouse.devices.alignment import MARKER_SIGMA_M
from locatk.formats.benchmarks.plan import lighthouse
from locatk.formats.published_data import data_folder


@pytest.mark.parametrize("number", range(lighthouse.TASKS))
def test_random_rooms_have_stations_inside_that_look_down(number: int) -> None:
    scene = lighthouse.draw_room(number)
    assert scene.room is not None
    assert 2 <= len(scene.stations) <= 6
    size = scene.room.outline_m.max(axis=0)
    for station in scene.stations:
        assert np.all((station.position[:2] > 0) & (station.position[:2] < size))
        assert station.position[2] < scene.room.height_m
        assert station.rotation[2, 0] < 0
        assert np.linalg.det(station.rotation) == pytest.approx(1.0)


@pytest.mark.slow
def test_a_room_is_predicted_and_reached() -> None:
    compared = lighthouse.compare_sessions(lighthouse.draw_room(2), range(2), 5)
    assert compared.sessions == 2
    assert compared.refused == ()
    assert 0.4 < compared.ratio < 2.5


def test_marks_of_a_camera_displace_points_as_drawn() -> None:
    rng = np.random.default_rng(0)
    corners = np.array([[0, 0], [0.4, 0], [0.4, 0.4], [0, 0.4]])
    points = rng.uniform(-0.3, 0.7, (200, 2))
    drawn = [
        apply_homography(
            fit_homography(corners, corners + rng.normal(0, MARKER_SIGMA_M, (4, 2))), points
        )
        for _ in range(300)
    ]
    reached = np.mean(np.sum((np.array(drawn) - points) ** 2, axis=2))
    variance = lighthouse.homography_variance(corners, points, is_aligned=False)
    assert variance == pytest.approx(reached, rel=0.2)
    assert lighthouse.homography_variance(corners, points, is_aligned=True) < variance


@pytest.mark.slow
def test_the_published_grid_is_predicted() -> None:
    folder = data_folder()
    if folder is None:
        pytest.skip("no published recordings")
    rows = lighthouse.grid_figures(folder / "lighthouse")
    assert [row.met for row in rows] == [True, True]
