"""`locatk import` as a user runs it: good tables, bad tables, published ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from locatk.cli.app import app
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import StationReport, Sweeps
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session

HEADER = "timestamp,source,LHA_count_1,LHA_count_2,LHB_count_1,LHB_count_2"
ROW = "2023-07-27T15:34:{:02d}.700963Z,R,48333,88779,48979,94628"
ROWS = [ROW.format(second) for second in range(20)]


def table(path: Path, *rows: str, header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_a_table_becomes_a_session(locatk, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    source = table(tmp_path / "data.csv", *ROWS)
    result = locatk("import", "dotbot-lh2", source, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    assert (answer["sweeps"], answer["devices"], answer["truth_poses"]) == (80, ["R"], 0)
    sweeps = observations.read_sweeps(Session.open(out))
    assert sorted(set(sweeps.count)) == [48333, 48979, 88779, 94628]
    again = locatk("import", "dotbot-lh2", source, "-o", out)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    assert locatk("import", "dotbot-lh2", source, "-o", out, "--overwrite").exit_code == 0


@pytest.mark.parametrize(
    "rows",
    [
        [*ROWS, "2023-07-27T15:35:00Z,R,many,88779,48979,94628"],
        [*ROWS, "yesterday,R,48333,88779,48979,94628"],
        [*ROWS, "2023-07-27T15:35:00Z,R,48333"],
        [],
    ],
    ids=["text", "time", "short", "empty"],
)
def test_a_bad_table_is_one_line(locatk, tmp_path: Path, rows: list[str]) -> None:
    source = table(tmp_path / "data.csv", *rows)
    out = tmp_path / "run.mcap"
    result = locatk("import", "dotbot-lh2", source, "-o", out)
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")
    assert str(source) in result.stderr
    assert result.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == [source]


def test_a_missing_column_is_named(locatk, tmp_path: Path) -> None:
    source = table(tmp_path / "data.csv", *ROWS, header=HEADER.replace("LHB_count_2", "other"))
    result = locatk("import", "dotbot-lh2", source, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert "lhb_count_2" in result.stderr.lower()


def test_the_input_is_never_the_output(locatk, tmp_path: Path) -> None:
    source = table(tmp_path / "data.csv", *ROWS)
    result = locatk("import", "dotbot-lh2", source, "-o", source, "--overwrite")
    assert result.exit_code == 1
    assert source.read_text().startswith(HEADER)


def test_published_grid(locatk, data: Path, tmp_path: Path) -> None:
    grid = data / "lighthouse" / "twoLH-3D_scene" / "dataset" / "data_all.csv"
    out = tmp_path / "grid.mcap"
    # Naming the grid columns' file as truth is welcome; they are read anyway.
    for more in ((), ("--truth", grid)):
        result = locatk("import", "dotbot-lh2", grid, *more, "-o", out, "--overwrite", "--json")
        assert result.exit_code == 0, result.stderr
        answer = json.loads(result.stdout)
        assert answer["sweeps"] == 4 * 4759
        assert answer["truth_poses"] == 4759


def test_published_tracks(locatk, data: Path, tmp_path: Path) -> None:
    scene = data / "lighthouse" / "twoLH-2D_scene" / "dataset"
    truth = scene / "ground_truth" / "1_blender.csv"
    out = tmp_path / "run.mcap"
    source = scene / "lighthouse" / "data.csv"
    result = locatk("import", "dotbot-lh2", source, "--truth", truth, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["truth_poses"] == 1691


# ---- Lighthouse from others, with a reader that needs no file


def received_stations() -> tuple[StationReport, ...]:
    calibration = Calibration(np.full((2, 7), 0.01), "factory")
    return (
        StationReport(1, 0x4CC60647, 958985.25, 40, 2, calibration, 11, 1),
        StationReport(5, sweeps=3),
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> list[Any]:
    """Put a reader in place of all; gives what it was asked. It loses what the test says."""
    calls: list[Any] = []
    count = 40
    sweeps = Sweeps(
        devices=("wand",),
        time_ns=1_700_000_000_000_000_000 + 10_000_000 * np.arange(count),
        device=np.zeros(count, np.int32),
        sensor=np.arange(count, dtype=np.int32) % 4,
        channel=np.ones(count, np.int32),
        polynomial=np.full(count, -1, np.int32),
        sweep=np.full(count, -1, np.int32),
        count=40_000.0 + np.arange(count),
    )

    def read(paths: list[Path], **named: Any) -> ImportedSession:
        calls.append((paths, named))
        return ImportedSession(
            sweeps,
            scene=None,
            truth=[],
            facts={"format": "test"},
            warnings=["the end is cut off"],
            stations=received_stations(),
            receivers={"wand": DECK},
            lost=getattr(request, "param", None),
        )

    monkeypatch.setattr("locatk.cli.options.load", lambda target: read)
    return calls


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["saleae"], {}),
        (
            ["saleae", "--channel", "3", "--channel", "0", "--method", "paper", "--device", "w"],
            {"channels": (3, 0), "method": "paper", "device": "w"},
        ),
        (["libsurvive"], {}),
        (["libsurvive", "--stations"], {"stations": True}),
        (["dotbot-log"], {}),
    ],
)
def test_a_reader_gets_the_given_options(
    locatk, tmp_path: Path, asked: list[Any], arguments: list[str], named: dict[str, Any]
) -> None:
    source = table(tmp_path / "source", "x")
    result = locatk("import", arguments[0], source, *arguments[1:], "-o", tmp_path / "run.mcap")
    assert result.exit_code == 0, result.stderr
    assert asked == [([source], named)]


def test_station_reports_are_imported(locatk, tmp_path: Path, asked: list[Any]) -> None:
    source, out = table(tmp_path / "take.sal", "x"), tmp_path / "run.mcap"
    result = locatk("import", "saleae", source, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"Wrote {out}\n"
    said = [" ".join(line.split()) for line in result.stderr.splitlines()]
    assert said == [
        "40 sweeps of 1 device (wand)",
        "OOTX",
        "channel id period ppm sweeps decoded calibration frames damaged",
        "1 4cc60647 958985 -15.38 40 95.2 % factory 11 1",
        "5 - 947000 - 3 - - 0 0",
        "Warning: the end is cut off",
    ]
    session = Session.open(out)
    assert [(s.id, s.period_ticks) for s in observations.read_station_reports(session)] == [
        (0x4CC60647, 958985.25),
        (None, None),
    ]
    assert observations.read_receivers(session).keys() == {"wand"}
    scene = observations.read_scene(session)
    assert scene is not None
    assert scene.calibrations[1].source == "factory"
    assert scene.ids == {1: 0x4CC60647}


def test_stations_in_json(locatk, tmp_path: Path, asked: list[Any]) -> None:
    source = table(tmp_path / "take.sal", "x")
    result = locatk("import", "saleae", source, "-o", tmp_path / "run.mcap", "--json")
    answer = json.loads(result.stdout)
    assert answer["warnings"] == ["the end is cut off"]
    first, second = answer["stations"]
    assert first.pop("ppm") == pytest.approx(-15.38, abs=0.01)
    assert first == {
        "channel": 1,
        "id": "4cc60647",
        "period_ticks": 958985.25,
        "sweeps": 40,
        "missed": 2,
        "decode_rate": 40 / 42,
        "calibration": "factory",
        "frames": 11,
        "damaged": 1,
    }
    assert (second["id"], second["period_ticks"], second["ppm"]) == (None, 947000, None)
    assert (second["missed"], second["decode_rate"]) == (None, None)


@pytest.mark.parametrize("asked", ["2 s at the end"], indirect=True)
def test_losses_give_exit_status_3(locatk, tmp_path: Path, asked: list[Any]) -> None:
    source, out = table(tmp_path / "take.sal", "x"), tmp_path / "run.mcap"
    result = locatk("import", "libsurvive", source, "-o", out)
    assert result.exit_code == 3
    assert "2 s at the end" in result.stderr
    assert len(observations.read_sweeps(Session.open(out))) == 40


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["saleae", "again"], "saleae takes one PATH"),
        (["crazyflie-config", "again"], "crazyflie-config takes one PATH"),
        (["saleae", "--stations"], "--stations means nothing to the format saleae"),
        (["libsurvive", "--channel", "1"], "--channel means nothing to the format libsurvive"),
        (["dotbot-log", "--device", "x"], "--device means nothing"),
        (["libsurvive", "--method", "soft"], "--method means nothing"),
        (["saleae", "--truth", "again"], "--truth means nothing"),
        (["saleae", "--channel", "-1"], "-1"),
        (["saleae", "--method", "bundle"], "bundle"),
        (["crazyflie-config"], "end it in .toml"),
    ],
)
def test_usage(locatk, tmp_path: Path, asked: list[Any], arguments: list[str], words: str) -> None:
    more = [table(tmp_path / each, "x") if each == "again" else each for each in arguments[1:]]
    source, out = table(tmp_path / "source", "x"), tmp_path / "run.mcap"
    result = locatk("import", arguments[0], source, *more, "-o", out)
    assert result.exit_code == 2
    assert words in result.stderr
    assert not asked
    assert not out.exists()


CONFIG = """
type: lighthouse_system_configuration
version: '1'
systemType: 2
geos:
  0:
    origin: [1.0, 2.0, 3.0]
    rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
calibs: {}
"""


def test_a_crazyflie_config_becomes_a_scene(locatk, tmp_path: Path) -> None:
    source, out = tmp_path / "lighthouse.yaml", tmp_path / "scene.toml"
    source.write_text(CONFIG)
    result = locatk("import", "crazyflie-config", source, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    [station] = answer["stations"]
    assert (station["channel"], station["id"], station["position_m"]) == (1, None, [1, 2, 3])
    assert station["calibration"] == "generic"
    assert answer["warnings"]
    assert artifacts.read_scene(out).station(1) is not None
    assert locatk("import", "crazyflie-config", source, "-o", out).exit_code == 1
    empty = tmp_path / "empty.yaml"
    empty.write_text(CONFIG[: CONFIG.index("geos")])
    result = locatk("import", "crazyflie-config", empty, "-o", tmp_path / "empty.toml")
    assert result.exit_code == 0
    assert "has no station" in result.stderr
    damaged = tmp_path / "damaged.yaml"
    damaged.write_text(CONFIG[:120])
    result = locatk("import", "crazyflie-config", damaged, "-o", out, "--overwrite")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")
    assert artifacts.read_scene(out).station(1) is not None


def test_each_format_has_its_own_options_and_help() -> None:
    """`import FORMAT --help` lists the options of the format, and no other's."""
    help = CliRunner().invoke(app, ["import", "saleae", "--help"]).stdout
    assert "--channel" in help
    assert "--volts-per-tesla" not in help
    assert "locatk import saleae capture.sal" in help


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["salea", "x.sal"], "Did you mean 'saleae'?"),
        (["images.csv"], "is a file or folder, not a format"),
        (["saleae", "x.sal", "--sheet", "s.toml"], "--sheet means nothing to the format saleae"),
        (["saleae", "x.sal", "--chanel", "1"], "--channel"),
    ],
)
def test_wrong_format_or_option(
    arguments: list[str], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A misspelled format gets a suggestion, a file in its place does not."""
    monkeypatch.chdir(tmp_path)
    Path("images.csv").touch()
    result = CliRunner().invoke(app, ["import", *arguments, "-o", "o.mcap"])
    assert result.exit_code == 2
    assert problem in result.stderr


@pytest.mark.parametrize(
    "order",
    [
        "-o {out} dotbot-lh2 {csv}",
        "dotbot-lh2 {csv} -o {out}",
        "dotbot-lh2 -o {out} {csv}",
        "--overwrite -o {out} --truth {csv} dotbot-lh2 {csv}",
        "--json --output={out} dotbot-lh2 {csv}",
    ],
)
def test_one_command_for_all_formats_is_still_accepted(
    locatk, order: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before each format had a command, options and format could have any order."""
    monkeypatch.chdir(tmp_path)
    table(Path("data.csv"), *ROWS)
    # The name of the output is that of a format.
    arguments = order.format(out="table", csv="data.csv").split()
    result = locatk("import", *arguments)
    assert result.exit_code == 0, result.stderr
    assert len(observations.read_sweeps(Session.open(tmp_path / "table"))) == 80


def test_options_may_precede_the_format(tmp_path: Path) -> None:
    """The order of options and format does not matter."""
    result = CliRunner().invoke(app, ["import", "-o", "o.mcap", "saleae", str(tmp_path / "no.sal")])
    assert result.exit_code == 1
    assert "No such file" in result.stderr
