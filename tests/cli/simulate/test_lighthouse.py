"""`locatk simulate lighthouse --artifact`: robots in a designed room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION
from locatk.core.lighthouse.room import Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.polygons import rectangle
from locatk.formats.artifacts.scene import loads_scene, read_scene, write_scene
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session
from tests.core.lighthouse.rooms import looking_at

ROOM = Room(
    rectangle(4, 3),
    2.6,
    (0.1, 0.1),
    obstacles=(Obstacle(rectangle(0.5, 0.5, (1, 1)), 0.0, 0.8, "table"),),
    robots=RobotSize(2, 0.1, 0.15),
)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    stations = []
    for channel, corner in ((2, (0.05, 0.05)), (5, (3.95, 2.95)), (9, (0.05, 2.95))):
        position = np.array([*corner, 2.4])
        rotation = looking_at(position, np.array([2, 1.5, 0.1]))
        stations.append(Station(channel, position, rotation, GENERIC_CALIBRATION))
    scene = Scene(
        tuple(stations),
        planar=True,
        floor_z=0.1,
        scale="design",
        frame="room",
        frame_source="design",
        room=ROOM,
    )
    path = tmp_path / "room.toml"
    write_scene(path, scene)
    return path


def test_a_room_is_simulated_and_solved_in_its_frame(locatk, room: Path, tmp_path: Path) -> None:
    session, solution = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    options = ("--robots", 2, "--duration", 20, "--seed", 4)
    result = locatk("simulate", "lighthouse", "--artifact", room, "-o", session, *options)
    assert result.exit_code == 0, result.stderr
    stored = Session.open(session)
    given = observations.read_scene(stored)
    assert given is not None
    assert given.frame_source == "design"
    assert given.room is not None
    assert np.unique(observations.read_sweeps(stored).channel).tolist() == [2, 5, 9]
    text = stored.attachment("true-scene.toml")
    assert text is not None
    true = loads_scene(text.decode())
    assert np.linalg.norm(true.stations[0].position - given.stations[0].position) > 1e-3
    # Without an option, the session's own room is the prior; with one, the file.
    for artifact in ((), ("--artifact", room)):
        solved = locatk("solve", session, "-o", solution, "--json", "--overwrite", *artifact)
        assert solved.exit_code == 0, solved.stderr
        evaluated = locatk("eval", solution, "--truth", session, "--align", "none", "--json")
        assert evaluated.exit_code == 0, evaluated.stderr
        assert json.loads(evaluated.stdout)["rmse_m"] < 0.08
    scene = observations.read_scene(Session.open(solution))
    assert scene is not None
    assert (scene.frame, scene.frame_source, scene.scale) == ("room", "floor", "design")


def test_a_room_replaces_the_settings_of_stations(locatk, room: Path, tmp_path: Path) -> None:
    output = tmp_path / "run.mcap"
    both = locatk("simulate", "lighthouse", "--artifact", room, "--stations", 2, "-o", output)
    assert both.exit_code == 2
    assert "--stations" in both.stderr
    over = locatk("simulate", "lighthouse", "--artifact", room, "-o", room, "--overwrite")
    assert over.exit_code == 2
    assert read_scene(room).room is not None
    plain = tmp_path / "plain.toml"
    write_scene(plain, replace(read_scene(room), room=None))
    without = locatk("simulate", "lighthouse", "--artifact", plain, "-o", output)
    assert without.exit_code == 1
    assert "no room" in without.stderr
    assert not output.exists()
