"""Maps of rooms: values of the places, in plan and in section."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from locatk.core.errors import InputError
from locatk.core.lighthouse.design import check_room
from locatk.core.lighthouse.design.mounts import view_rotation
from locatk.core.lighthouse.design.report import station_of
from locatk.core.lighthouse.room import Obstacle, Room
from locatk.core.lighthouse.scene import Scene
from locatk.core.polygons import rectangle
from locatk.formats.plots.rooms import draw_room_maps, write_room_maps

ROOM = Room(
    rectangle(5.0, 3.0, (1.0, -1.0)),
    2.6,
    (0.0, 1.2),
    obstacles=(Obstacle(rectangle(0.5, 0.5, (3, 0)), 0.0, 1.0),),
)
SCENE = Scene(
    tuple(
        station_of(channel, np.array([x, y, 2.5]), view_rotation(0.0, -np.pi / 2))
        for channel, (x, y) in enumerate([(2.0, 0.5), (4.0, 0.5)], 1)
    ),
    scale="design",
    frame_source="design",
    room=ROOM,
)


def test_maps_show_the_worst_value_behind_each_cell() -> None:
    report = check_room(SCENE)
    figure = draw_room_maps(SCENE, report)
    panels = [axes for axes in figure.axes if axes.get_xlabel() == "x [m]"]
    assert [axes.get_ylabel() for axes in panels] == ["y [m]", "z [m]"] * 3
    assert [axes.get_title() for axes in panels[::2]] == [
        "standard deviation [mm]",
        "stations seen",
        "dilution",
    ]
    for axes, values, worst, axis in (
        (panels[0], np.where(report.is_covered, 1e3 * report.sigma_m, np.inf), np.max, 1),
        (panels[2], report.stations_seen, np.min, 1),
        (panels[3], report.stations_seen, np.min, 2),
    ):
        mesh = next(each for each in axes.collections if isinstance(each, QuadMesh))
        shown = mesh.get_array()
        columns, rows = (np.unique(np.round(report.points_m[:, k], 6)) for k in (0, axis))
        assert shown.shape == (len(rows), len(columns))
        for row, column in ((0, 0), (len(rows) // 2, len(columns) // 2), (-1, -1)):
            behind = np.isclose(report.points_m[:, 0], columns[column]) & np.isclose(
                report.points_m[:, axis], rows[row]
            )
            expected = worst(values[behind])
            if np.isfinite(expected):
                assert shown[row, column] == pytest.approx(expected)
            else:
                assert np.ma.is_masked(shown[row, column])


def test_pictures_need_a_room_and_an_ending(tmp_path: Path) -> None:
    report = check_room(SCENE)
    with pytest.raises(InputError, match="no room"):
        draw_room_maps(Scene(SCENE.stations), report)
    with pytest.raises(InputError, match="not the name of a picture"):
        write_room_maps(tmp_path / "room.gif", SCENE, report)
