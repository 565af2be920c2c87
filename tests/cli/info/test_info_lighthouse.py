"""`locatk info` of Lighthouse: stations as they were heard, solved or only known; receivers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.recording import StationReport
from locatk.core.lighthouse.results import StationDetection
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.solution import Solution
from locatk.formats.artifacts import receiver as receivers
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.sessions import capture_record, observations
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import write_solution
from locatk.formats.sessions.writer import SessionWriter

FACTORY = Calibration(np.full((2, 7), 0.01), "factory")
HEARD = (
    StationReport(1, 0x4CC60647, 958985.25, 40, 1, FACTORY, 11, 0),
    StationReport(4, None, None, 7, 3, None, 0, 2),
)
KNOWN = Scene(
    stations=(Station(9, np.array([1.0, 2.0, 3.0]), np.eye(3), FACTORY, id=0xF),),
    scale="device",
    calibrations={2: FACTORY},
    ids={2: 0xAB, 3: 0xCD},
)


@pytest.fixture
def write(session: Path) -> Callable[..., Path]:
    """``write(path, ...)``: the sweeps of :func:`session` (40 of channel 1), and more."""
    sweeps = observations.read_sweeps(Session.open(session))

    def make(path: Path, **more: Any) -> Path:
        observations.write_session(path, system="lighthouse", sweeps=sweeps, **more)
        return path

    return make


def facts(locatk: Any, path: Path) -> dict[str, Any]:
    result = locatk("info", path, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def lines(locatk: Any, path: Path, header: str) -> list[str]:
    """Return the lines of the tables with this first title, without repeated spaces."""
    blocks = locatk("info", path).stdout.split("\n\n")
    tables = [block for block in blocks if f"\n{header}" in f"\n{block}"]
    return [" ".join(line.split()) for table in tables for line in table.splitlines()]


def test_stations_as_received(locatk, write, tmp_path: Path) -> None:
    path = write(tmp_path / "1.mcap", stations=HEARD, scene=KNOWN)
    answer = facts(locatk, path)
    assert answer["scale"] == "device"
    assert [station["channel"] for station in answer["stations"]] == [1, 2, 3, 4, 9]
    first, second, third, fourth, ninth = answer["stations"]
    assert first.pop("ppm") == pytest.approx(1e6 * (958985.25 / 959000 - 1))
    assert first == {
        "channel": 1,
        "id": 0x4CC60647,
        "period_ticks": 958985.25,
        "sweeps": 40,
        "missed": 1,
        "decode_rate": 40 / 41,
        "calibration": "factory",
        "frames": 11,
        "damaged": 0,
        "rejected": None,
        "verification_rad": None,
        "verification_m": None,
        "position_m": None,
    }
    assert (second["id"], second["calibration"], second["period_ticks"]) == (
        0xAB,
        "factory",
        957000,
    )
    assert (third["id"], third["calibration"], third["sweeps"]) == (0xCD, None, 0)
    assert (fourth["period_ticks"], fourth["ppm"], fourth["decode_rate"]) == (949000, None, 0.7)
    assert (ninth["id"], ninth["position_m"], ninth["missed"]) == (0xF, [1, 2, 3], None)
    assert lines(locatk, path, "channel") == [
        "OOTX",
        "channel id period ppm sweeps decoded calibration frames damaged",
        "1 4cc60647 958985 -15.38 40 97.5 % factory 11 0",
        "2 000000ab 957000 - 0 - factory - -",
        "3 000000cd 953000 - 0 - - - -",
        "4 - 949000 - 0 70.0 % - 0 2",
        "9 0000000f 937000 - 0 - factory - -",
        "channel position [m]",
        *("1 -", "2 -", "3 -", "4 -", "9 1.000, 2.000, 3.000"),
    ]
    assert "period_ticks" not in locatk("info", path).stdout  # it is in the table


def test_all_but_one_decoded_is_not_all(locatk, write, tmp_path: Path) -> None:
    path = write(tmp_path / "1.mcap", stations=(StationReport(1, sweeps=99_999, missed=1),))
    assert " 99.9 % " in locatk("info", path).stdout


def test_columns_without_data_are_left_out(locatk, session: Path) -> None:
    assert lines(locatk, session, "channel") == [
        "channel id period sweeps calibration",
        "1 - 959000 40 -",
    ]
    answer = facts(locatk, session)
    assert answer["receivers"] == []


def test_a_large_session_has_the_sweeps_that_were_counted(
    locatk, write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "1.mcap", stations=HEARD)
    monkeypatch.setattr(capture_record, "MAX_DESCRIBED_BYTES", 0)
    assert [station["sweeps"] for station in facts(locatk, path)["stations"]] == [40, 7]


def test_another_station_than_that_of_the_scene(locatk, write, tmp_path: Path) -> None:
    place = Station(1, np.zeros(3), np.eye(3), FACTORY, id=0xBAD)
    path = write(tmp_path / "1.mcap", stations=HEARD, scene=Scene(stations=(place,)))
    [note] = facts(locatk, path)["notes"]
    assert note.startswith("channel 1: the scene contains station 00000bad")
    assert note in " ".join(locatk("info", path).stdout.split())


@pytest.mark.parametrize("placed", [True, False])
def test_a_solution_lists_its_inputs(locatk, tmp_path: Path, placed: bool) -> None:
    """The paper's method has no stations in its scene."""
    path = tmp_path / "solved.mcap"
    used = StationDetection(0, 9, None, 959000, "factory", sweeps=np.int64(38), rejected=2)
    scene = KNOWN if placed else None
    solution = Solution("lighthouse", "bundle", (), detections=(used,), artifact=scene)
    write_solution(path, solution, source="run.mcap")
    station = facts(locatk, path)["stations"][-1]
    assert (station["channel"], station["sweeps"], station["rejected"]) == (9, 38, 2)
    assert station["calibration"] == ("factory" if placed else None)
    table = lines(locatk, path, "channel")
    header, *_, last = table
    assert header.startswith("channel id period sweeps rejected calibration")
    assert header.endswith("position [m]") == placed
    assert last == (
        "9 0000000f 937000 38 2 factory 1.000, 2.000, 3.000" if placed else "9 - 937000 38 2 -"
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"detections": 3}',
        '{"detections": [3]}',
        '{"detections": [{"channel": 99}]}',
        '{"detections": [{"channel": [1], "sweeps": 2}]}',
        '{"detections": [{"channel": 1, "sweeps": [2], "rejected": {}}]}',
        "[" * 100_000,
    ],
)
def test_a_strange_solution(locatk, tmp_path: Path, text: str) -> None:
    path = tmp_path / "solved.mcap"
    with SessionWriter(path, kind="solution", system="lighthouse") as writer:
        writer.attach("solution.json", text.encode(), "application/json")
    assert locatk("info", path).exit_code == 0
    facts(locatk, path)


def test_receivers(locatk, write, tmp_path: Path) -> None:
    plain = Receiver(np.array([[0.0, 0.0, 0.0], [0.0831514, 0.02, 0.0]]))
    path = write(tmp_path / "1.mcap", receivers={"red": DECK, "blue": plain})
    blue, red = facts(locatk, path)["receivers"]
    assert (blue["device"], blue["name"], blue["sensors"]) == ("blue", None, 2)
    assert (blue["normal"], blue["size_mm"]) == (None, pytest.approx([83.1514, 20, 0]))
    assert (red["device"], red["name"], red["size_mm"]) == ("red", "lighthouse-deck", [30, 15, 0])
    assert red["position_mm"][0] == [-15, 7.5, 0]
    assert lines(locatk, path, "receiver ")[1:] == [
        "blue - 2 83.15 x 20 x 0 -",
        "red lighthouse-deck 4 30 x 15 x 0 known",
    ]


def test_a_receiver_as_a_file(locatk, tmp_path: Path) -> None:
    path = tmp_path / "deck.toml"
    receivers.write_receiver(path, DECK)
    answer = facts(locatk, path)
    assert (answer["kind"], answer["system"]) == ("receiver", "lighthouse")
    [receiver] = answer["receivers"]
    assert (receiver["sensors"], "device" in receiver) == (4, False)
    assert lines(locatk, path, "receiver ")[1:] == ["- lighthouse-deck 4 30 x 15 x 0 known"]


def test_positions_without_scale_have_no_metres(locatk, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    artifacts.write_scene(path, replace(KNOWN, scale="unit"))
    assert lines(locatk, path, "channel")[0].endswith("position [units]")


def test_a_scene_with_calibrations_only(locatk, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    artifacts.write_scene(path, Scene(calibrations={2: FACTORY}, ids={2: 0xAB}))
    [station] = facts(locatk, path)["stations"]
    assert (station["id"], station["calibration"], station["sweeps"]) == (0xAB, "factory", None)


@pytest.mark.parametrize("what", ["station", "scene.toml", "receiver.toml"])
def test_damage_hides_no_other_contents(
    locatk, write, tmp_path: Path, session: Path, what: str
) -> None:
    from locatk.formats.schemas.lighthouse_pb2 import LighthouseSweep

    path = tmp_path / "damaged.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        writer.metadata("station-1", {"sweeps": "many" if what == "station" else "40"})
        for name, text in (
            ("scene.toml", artifacts.dumps_scene(KNOWN)),
            ("receiver.toml", receivers.dumps_receiver(DECK)),
        ):
            writer.attach_toml(name, "x = 1" if name == what else text)
        for time_ns, message in Session.open(session).decoded("/lighthouse/red", LighthouseSweep):
            writer.write("/lighthouse/red", message, time_ns)
    result = locatk("info", path, "--json")
    assert result.exit_code == 3
    answer = json.loads(result.stdout)
    assert answer["damage"]
    assert (answer["sweeps"], answer["devices"]) == (40, ["red"])
    assert len(answer["receivers"]) == (0 if what == "receiver.toml" else 1)
    assert [s["channel"] for s in answer["stations"]] == (
        [1] if what == "scene.toml" else [1, 2, 3, 9]
    )
    assert "many" in result.stderr or what != "station"
