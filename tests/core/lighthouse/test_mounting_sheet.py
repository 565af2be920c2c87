"""Mounting sheets: positions at the stated scale, distances from walls, and the tilt gauge."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from locatk.core.drawing import Circle, Group, Line, Page, Polygon, Text
from locatk.core.errors import InputError
from locatk.core.lighthouse.design.mounts import view_rotation
from locatk.core.lighthouse.design.report import station_of
from locatk.core.lighthouse.drawing.mounting_sheet import (
    draw_mounting_sheet,
    view_angles,
    wall_distances,
)
from locatk.core.lighthouse.room import Obstacle, Room
from locatk.core.lighthouse.scene import Scene
from locatk.core.polygons import rectangle

ROOM = Room(
    np.array([[0, 0], [7, 0], [7, 3], [3, 3], [3, 6], [0, 6]]),
    2.8,
    area_m=rectangle(2, 2, (0.5, 0.5)),
    obstacles=(Obstacle(rectangle(0.8, 0.8, (1.0, 4.0)), 0.0, 1.5),),
)
POSES = ((0.1, 2.0, 2.4, 20.0, -30.0), (5.0, 2.9, 2.0, -90.0, -34.0), (1.5, 1.5, 2.7, 40.0, -90.0))
SCENE = Scene(
    tuple(
        station_of(
            channel, np.array([x, y, z]), view_rotation(math.radians(yaw), math.radians(tilt))
        )
        for channel, (x, y, z, yaw, tilt) in enumerate(POSES, 1)
    ),
    room=ROOM,
)
A4 = (210.0, 297.0)


@pytest.fixture(scope="module")
def pages() -> tuple[Page, ...]:
    return draw_mounting_sheet(SCENE, ("wall", "wall", "ceiling"), "lab", A4)


def group(page: Page, name: str) -> Group:
    return next(each for each in page.groups if each.name == name)


def texts(page: Page) -> list[str]:
    return [m.text for g in page.groups for m in g.marks if isinstance(m, Text)]


def test_everything_is_on_the_paper(pages: tuple[Page, ...]) -> None:
    assert len(pages) == 3
    for page in pages:
        width, height = page.size_mm
        for each in page.groups:
            for mark in each.marks:
                if isinstance(mark, Line):
                    points = [mark.start, mark.end]
                elif isinstance(mark, Circle):
                    points = [mark.centre]
                elif isinstance(mark, Polygon):
                    points = list(mark.corners)
                else:
                    points = [mark.position]
                for x, y in points:
                    assert 9.9 <= x <= width - 9.9
                    assert 9.9 <= y <= height - 9.9


def test_plan_is_at_its_scale(pages: tuple[Page, ...]) -> None:
    page = pages[0]
    scale = float(next(re.fullmatch(r"1 : ([\d.]+)", t)[1] for t in texts(page) if t[:3] == "1 :"))
    polygons = [m for m in group(page, "plan").marks if isinstance(m, Polygon)]
    outline = np.array(next(p.corners for p in polygons if p.width_mm == 0.5))
    origin = outline[0]
    assert (outline - origin) * scale / 1e3 == pytest.approx(ROOM.outline_m, abs=1e-6)
    dots = [np.mean(p.corners, axis=0) for p in polygons if p.filled and len(p.corners) > 3]
    found = (np.array(dots) - origin) * scale / 1e3
    assert found == pytest.approx(np.array([s.position[:2] for s in SCENE.stations]), abs=1e-6)
    assert {"W1: 7000", "W2: 3000", "W4: 3000", "W6: 6000"} <= set(texts(page))


def test_list_has_distances_from_two_walls_and_angles(pages: tuple[Page, ...]) -> None:
    row = texts(pages[1])
    for text in (
        "W6: 100", "W1: 2000", "30 down",  # station 1
        "W3: 100", "W2: 2000", "34 down", "-90",  # station 2
        "W1: 1500", "W6: 1500", "90 down", "40 (top)",  # station 3
    ):  # fmt: skip
        assert text in row, text


def test_walls_of_distances_are_opposite_and_not_parallel() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        x, y = rng.uniform([0, 0], [7, 6])
        if x > 3 and y > 3:
            continue
        (first, first_m), (second, second_m) = wall_distances(ROOM, np.array([x, y, 2.0]))
        for wall, distance in ((first, first_m), (second, second_m)):
            a, b = ROOM.outline_m[wall], ROOM.outline_m[(wall + 1) % 6]
            vertical = a[0] == b[0]
            expected = abs(x - a[0]) if vertical else abs(y - a[1])
            assert distance == pytest.approx(expected)
        assert (first % 2) != (second % 2)  # walls alternate between both directions


def test_yaw_of_a_vertical_view_is_that_of_the_top() -> None:
    assert view_angles(SCENE.stations[0]) == (pytest.approx(20), pytest.approx(-30), False)
    assert view_angles(SCENE.stations[2]) == (pytest.approx(40), pytest.approx(-90), True)
    top = SCENE.stations[2].rotation[:, 2]
    assert top == pytest.approx([math.cos(math.radians(40)), math.sin(math.radians(40)), 0])


def test_gauge_has_true_angles(pages: tuple[Page, ...]) -> None:
    """The thread hangs down: turn the gauge with a station, and read where it crosses the scale."""
    marks = group(pages[2], "gauge").marks
    hole = next(m.centre for m in marks if isinstance(m, Circle))
    front = min(m.corners[0][0] for m in marks if isinstance(m, Polygon) and len(m.corners) == 4)
    assert front < hole[0]
    tilts = [m for m in marks if isinstance(m, Line) and m.width_mm == 0.4]
    found = []
    for mark in tilts:
        x, y = mark.end[0] - hole[0], mark.end[1] - hole[1]
        # The edge FRONT is upright (0, 1) and the view is (1, 0) if the tilt is 0. A view that
        # turns down by t turns everything clockwise by t; the mark is then below the hole.
        for tilt in np.radians(np.arange(0.0, 90.1, 0.5)):
            turned_x = math.cos(tilt) * x + math.sin(tilt) * y
            turned_y = -math.sin(tilt) * x + math.cos(tilt) * y
            if abs(turned_x) < 0.3 and turned_y < 0:
                found.append(round(math.degrees(tilt)))
    assert sorted(set(found)) == [30, 34, 90]


def test_sheets_need_a_room_and_paper() -> None:
    with pytest.raises(InputError, match="room"):
        draw_mounting_sheet(Scene(SCENE.stations), ("wall",) * 3, "lab", A4)
    with pytest.raises(InputError, match="paper"):
        draw_mounting_sheet(SCENE, ("wall",) * 3, "lab", (105.0, 105.0))
