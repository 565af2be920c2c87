"""Systems: the input of the Lighthouse solver, options, sessions of unknown systems."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from locatk.core import lighthouse
from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.core.lighthouse.scene import Marker, Scene
from locatk.core.solution import Solution, SolverWarning
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.pipeline import SYSTEMS, SolveRequest, solve_session
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session

OF_SOLVER = SolverWarning("test", "of the solver")


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session of the device `red` with one marker."""
    path, n = tmp_path / "run.mcap", 40
    sweeps = Sweeps(
        devices=("red",),
        time_ns=1_700_000_000_000_000_000 + 50_000_000 * np.arange(n),
        device=np.zeros(n, np.int32),
        sensor=np.zeros(n, np.int32),
        channel=np.ones(n, np.int32),
        polynomial=np.full(n, -1, np.int32),
        sweep=np.full(n, -1, np.int32),
        count=40_000.0 + np.arange(n),
    )
    scene = Scene(markers=(Marker("corner", np.zeros(3)),))
    observations.write_session(path, system="lighthouse", sweeps=sweeps, scene=scene)
    return path


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the last call of the solver was given."""
    last: dict[str, Any] = {}

    def solve(sweeps: Any, scene: Scene, options: Any, **more: Any) -> Solution:
        last.update(more, scene=scene)
        return Solution("lighthouse", "bundle", (), artifact=Scene(), warnings=(OF_SOLVER,))

    monkeypatch.setattr(lighthouse, "solve", solve, raising=False)
    return last


def sweeps_of(session: Path, sensors: int) -> Sweeps:
    """As in the session, but of so many photodiodes."""
    sweeps = observations.read_sweeps(Session.open(session))
    return replace(sweeps, sensor=np.arange(len(sweeps), dtype=np.int32) % sensors)


def test_a_plain_session(session: Path, given: dict[str, Any]) -> None:
    solution = solve_session(session, SolveRequest()).solution
    assert [marker.name for marker in given["scene"].markers] == ["corner"]
    assert "receivers" not in given
    assert solution.warnings == (OF_SOLVER,)


@pytest.mark.parametrize(("sensors", "rigid"), [(1, False), (2, True), (4, True)])
def test_one_photodiode_is_no_rigid_device(
    session: Path, tmp_path: Path, given: dict[str, Any], sensors: int, rigid: bool
) -> None:
    path, sweeps = tmp_path / "light.mcap", sweeps_of(session, sensors)
    observations.write_session(path, system="lighthouse", sweeps=sweeps, receivers={"red": DECK})
    solve_session(path, SolveRequest())
    assert ("receivers" in given) == rigid


def test_receivers_and_what_stations_sent(
    session: Path, tmp_path: Path, given: dict[str, Any]
) -> None:
    """An artifact completes the session's scene; of themselves the stations know best."""
    sent = Calibration(np.full((2, 7), 0.01), "factory")
    path, room = tmp_path / "light.mcap", tmp_path / "scene.toml"
    observations.write_session(
        path,
        system="lighthouse",
        sweeps=sweeps_of(session, sensors=4),
        scene=Scene(markers=(Marker("old", np.zeros(3)),)),
        stations=(StationReport(1, 0xA, calibration=sent), StationReport(2, 0xB, calibration=sent)),
        receivers={"red": DECK},
    )
    artifacts.write_scene(
        room,
        Scene(
            markers=(Marker("new", np.zeros(3)),),
            calibrations={2: Calibration(np.zeros((2, 7)), "estimated")},
            ids={2: 0xC},
        ),
    )
    solution = solve_session(path, SolveRequest(artifact=room)).solution
    scene = given["scene"]
    assert [marker.name for marker in scene.markers] == ["new", "old"]
    assert {c: each.source for c, each in scene.calibrations.items()} == {
        1: "factory",
        2: "estimated",
    }
    assert scene.ids == {1: 0xA, 2: 0xC}
    assert given["receivers"].keys() == {"red"}
    first, second = solution.warnings
    assert first.code == "other_station_id"
    assert first.message.startswith("channel 2: the scene contains station 0000000c")
    assert second == OF_SOLVER


@pytest.mark.parametrize("system", ["lighthouse", "dots", "landmarks"])
def test_templates_are_for_polaris(system: str) -> None:
    with pytest.raises(InputError, match=f"--templates is not an option of {system}"):
        SYSTEMS[system](None, SolveRequest(templates="36,5,80"))  # type: ignore[arg-type]


def test_every_option_is_checked() -> None:
    @dataclass(frozen=True)
    class Request(SolveRequest):
        grid_size: int | None = None

    with pytest.raises(InputError, match="--grid-size is not an option of dots"):
        SYSTEMS["dots"](None, Request(grid_size=3))  # type: ignore[arg-type]


def test_a_damaged_session_without_index_is_refused(tmp_path: Path) -> None:
    """Its intact contents could be solved, but the losses would remain unnoticed."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, index_types=IndexType.NONE, compression=CompressionType.NONE)
        writer.start("locatk")
        writer.add_metadata("locatk", {"kind": "session", "system": "lighthouse"})
        channel = writer.register_channel("/log", "json", 0)
        writer.add_message(channel, 1, b"payload", 1)
        writer.finish()
    path.write_bytes(path.read_bytes().replace(b"payload", b"damaged"))
    with pytest.raises(FormatError, match="a damaged chunk at byte") as caught:
        solve_session(path, SolveRequest())
    assert "locatk recover" in (caught.value.hint or "")
