"""``locatk calibrate scene --wizard`` at the pseudo-terminal of an emulated deck."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from locatk.core.lighthouse.simulation.session import SimulationOptions, simulate
from locatk.formats.artifacts.scene import read_scene
from locatk.formats.sessions.observations import read_sweeps, write_session
from locatk.formats.sessions.reader import Session

from ..conftest import Line, Process

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals of Linux"),
]

DEVICE = ("--port-device", "lighthouse-deck")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that is set on four corners of a square of a metre for 2 s each, and drives then."""
    path = tmp_path_factory.mktemp("wizard") / "deck.mcap"
    options = SimulationOptions(duration_s=40.0, report_hz=50.0, seed=21)
    write_session(path, system="lighthouse", sweeps=simulate(options).sweeps)
    return path


@pytest.fixture
def port(recorded: Path, tmp_path: Path, process: Callable[..., Process]) -> Path:
    """Port of a deck that sends this as soon as it is opened."""
    link = tmp_path / "tty"
    process("emulate", recorded, "--device", "lighthouse-deck", "--link", link)
    until_s = time.monotonic() + 20.0
    while not link.is_char_device() and time.monotonic() < until_s:
        time.sleep(0.05)
    return link


def test_a_scene_from_a_port(port: Path, tmp_path: Path, process: Callable[..., Process]) -> None:
    out = tmp_path / "room.toml"
    wizard = process(
        "calibrate", "scene", "-o", out, "--wizard", port, *DEVICE, "--x-distance", 1000,
        "--height", 10, "--json"
    )  # fmt: skip
    wizard.until("Recorded: origin. Put it on the x axis, 1 m from the origin")
    wizard.until("Recorded: x axis")
    wizard.until("Move the device through the whole room")
    time.sleep(4.0)
    assert wizard.stop() == 0, wizard.stderr
    assert wizard.stderr.count("Recorded: floor") == 2
    assert "stations 1, 2; at rest for 1 s" in wizard.stderr
    assert "s of motion left" in wizard.stderr
    (entry,) = json.loads(wizard.stdout)["sessions"]
    roles = [rest["role"] for rest in entry["frame"]["standstills"]]
    assert roles[:4] == ["origin", "x axis", "floor", "floor"]
    corners = [[0, 0, 0.01], [1, 0, 0.01], [1, 1, 0.01], [0, 1, 0.01]]
    for rest, corner in zip(entry["frame"]["standstills"], corners, strict=False):
        assert rest["position_m"] == pytest.approx(corner, abs=0.02)
    scene = read_scene(out)
    assert (scene.frame_source, scene.scale) == ("floor", "distance")
    assert all(station.position[2] > 1.0 for station in scene.stations)
    session = Session.open(tmp_path / "room.mcap")
    assert session.facts["system"] == "lighthouse"
    assert len(read_sweeps(session)) > 1000


def test_ctrl_c_keeps_the_recording(
    port: Path, tmp_path: Path, process: Callable[..., Process]
) -> None:
    session, out = tmp_path / "part.mcap", tmp_path / "room.toml"
    wizard = process("calibrate", "scene", session, "-o", out, "--wizard", port, *DEVICE)
    wizard.until("Recorded: origin")
    assert wizard.stop() == 3
    assert "1 of 4 points were recorded (stopped)" in wizard.stderr
    assert f"the recording is kept in {session}" in wizard.stderr
    assert len(read_sweeps(Session.open(session))) > 50
    assert not out.exists()


def test_a_port_without_light(
    line: Callable[..., Line], tmp_path: Path, process: Callable[..., Process]
) -> None:
    out = tmp_path / "room.toml"
    wizard = process("calibrate", "scene", "-o", out, "--wizard", line().path, *DEVICE)
    wizard.until("Waiting for the light of the stations")
    wizard.until("no light")
    assert wizard.stop() == 3
    assert "0 of 4 points were recorded" in wizard.stderr
    assert Session.open(tmp_path / "room.mcap").facts["kind"] == "session"
    assert not out.exists()


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--marker", "a=0,0", "--marker", "b=1,0", "--marker", "c=0,1"), "Leave out --marker"),
        (("--origin", 1), "leave out their numbers"),
        (("run.txt",), "ends in '.txt'"),
    ],
)
def test_wrong_usage(
    locatk: Callable[..., Any], tmp_path: Path, args: tuple[object, ...], words: str
) -> None:
    out = tmp_path / "room.toml"
    result = locatk("calibrate", "scene", "-o", out, "--wizard", "/dev/none", *args)
    assert result.exit_code == 2
    assert words in result.stderr


def test_options_of_the_wizard_need_it(locatk: Callable[..., Any], tmp_path: Path) -> None:
    out = tmp_path / "room.toml"
    result = locatk("calibrate", "scene", "-o", out)
    assert (result.exit_code, "Missing argument 'SESSION'" in result.stderr) == (2, True)
    result = locatk("calibrate", "scene", "run.mcap", "-o", out, "--baud", 9600)
    assert (result.exit_code, "--baud needs --wizard" in result.stderr) == (2, True)
    # A scene that exists is not lost, and nothing is recorded for it.
    out.write_text("mine")
    result = locatk("calibrate", "scene", "-o", out, "--wizard", tmp_path / "none")
    assert result.exit_code == 1
    assert out.read_text() == "mine"
    args = ("--wizard", tmp_path / "none", "--artifact", out, "--overwrite")
    result = locatk("calibrate", "scene", "-o", out, *args)
    assert "the output is one of the inputs" in result.stderr
    assert not out.with_suffix(".mcap").exists()
