"""`--config` and `--print-config` of `locatk simulate`, and options of earlier versions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.landmarks.map.floor import FloorMap
from locatk.formats.artifacts import maps
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session
from locatk.formats.simulation import dots, landmarks, lighthouse, polaris

SYSTEMS = {"dots": dots, "landmarks": landmarks, "lighthouse": lighthouse, "polaris": polaris}

SHORT = {
    "dots": ("--frames", 2),
    "landmarks": ("--strategy", "pass"),
    "lighthouse": ("--duration", 2),
    "polaris": ("--speed", 0.4),
}
"""Options for a short simulation."""


def inputs(system: str, folder: Path) -> tuple[Path, ...]:
    """The arguments that a command needs."""
    if system != "landmarks":
        return ()
    path = folder / "map.toml"
    if not path.exists():
        maps.write_map(path, FloorMap(np.array([[1, 5], [9, 14]])))
    return (path,)


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_the_printed_file_changes_nothing(locatk, tmp_path: Path, system: str) -> None:
    printed = locatk("simulate", system, "--print-config")
    assert printed.exit_code == 0, printed.stderr
    assert printed.stdout == SYSTEMS[system].CONFIG.dumps()
    config = tmp_path / "sim.toml"
    config.write_text(printed.stdout)
    paths = [tmp_path / name for name in ("without.mcap", "with.mcap")]
    for path, options in zip(paths, ((), ("--config", config)), strict=True):
        result = locatk(
            "simulate", system, *inputs(system, tmp_path), "-o", path, *SHORT[system], *options
        )
        assert result.exit_code == 0, result.stderr
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("system", SYSTEMS)
def test_options_and_their_file_give_the_same_session(locatk, tmp_path: Path, system: str) -> None:
    printed = locatk("simulate", system, *SHORT[system], "--seed", 3, "--print-config")
    config = tmp_path / "sim.toml"
    config.write_text(printed.stdout)
    paths = [tmp_path / name for name in ("options.mcap", "file.mcap")]
    given = ((*SHORT[system], "--seed", 3), ("--config", config))
    for path, options in zip(paths, given, strict=True):
        result = locatk("simulate", system, *inputs(system, tmp_path), "-o", path, *options)
        assert result.exit_code == 0, result.stderr
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_the_printed_file_holds_the_merged_settings(locatk, tmp_path: Path) -> None:
    config = tmp_path / "sim.toml"
    config.write_text(polaris.CONFIG.dumps({"robot.speed_mps": 0.3, "build.seed": 5}))
    result = locatk("simulate", "polaris", "--config", config, "--speed", 0.2, "--print-config")
    assert polaris.CONFIG.loads(result.stdout) == {"robot.speed_mps": 0.2, "build.seed": 5}


def test_a_switch_of_the_file_is_turned_off(locatk, tmp_path: Path) -> None:
    config = tmp_path / "sim.toml"
    config.write_text(polaris.CONFIG.dumps({"odometry.recorded": True}))
    result = locatk("simulate", "polaris", "--config", config, "--no-odometry", "--print-config")
    assert polaris.CONFIG.loads(result.stdout) == {"odometry.recorded": False}


@pytest.mark.parametrize(
    ("system", "missing"), [("landmarks", "'MAP_FILE'"), ("polaris", "'-o' / '--output'")]
)
def test_required_arguments_are_named(locatk, system: str, missing: str) -> None:
    result = locatk("simulate", system)
    assert result.exit_code == 2
    assert missing in result.stderr


@pytest.mark.parametrize("system", SYSTEMS)
def test_former_options_name_their_key(locatk, system: str) -> None:
    config = SYSTEMS[system].CONFIG
    for setting in config.settings:
        for flag in setting.former_flag.split():
            result = locatk("simulate", system, flag, "1")
            assert result.exit_code == 2
            assert f"{setting.name} in [{setting.table}]" in result.stderr
    result = locatk("simulate", system, "--sped", 1)
    assert result.exit_code == 2
    assert "No such option" in result.stderr


def test_the_configuration_is_not_overwritten(locatk, tmp_path: Path) -> None:
    config = tmp_path / "sim.toml"
    config.write_text(polaris.CONFIG.dumps())
    result = locatk("simulate", "polaris", "--config", config, "-o", config, "--overwrite")
    assert result.exit_code == 2
    assert config.read_text() == polaris.CONFIG.dumps()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "missing key 'format'"),
        ('format = "locatk-simulation-polaris"\nformat_version = 1\n[robt]\n', "robt"),
        ("format = ", "not valid TOML"),
    ],
)
def test_a_wrong_file_is_one_line(locatk, tmp_path: Path, text: str, said: str) -> None:
    config = tmp_path / "sim.toml"
    config.write_text(text)
    result = locatk("simulate", "polaris", "--config", config, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert said in result.stderr
    assert str(config) in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("system", SYSTEMS)
def test_help_has_groups_units_and_defaults(locatk, system: str) -> None:
    text = locatk("simulate", system, "--help").stdout
    config = SYSTEMS[system].CONFIG
    flags = [setting for setting in config.settings if setting.flag]
    assert 9 <= len(flags) <= 15
    for setting in flags:
        assert f"{setting.table.capitalize()}:" in text
        assert setting.flag.split("/")[0] in text
    assert " ".join(text.split()).count("[default: ") == len(flags)
    assert "--print-config > sim.toml" in text


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        ("polaris --run-up 1e308", 2, "at most 1e+12"),
        ("lighthouse --duration 1e308", 2, "at most 1e+12"),
        ("lighthouse --duration 1e6", 1, "samples"),
        ("lighthouse --robots 9000", 1, "samples"),
        (f"lighthouse --robots {10**400}", 1, "robots"),
        ("dots --duration 1e308", 2, "at most 1e+12"),
        ("dots --duration 1e9", 1, "samples"),
        ("dots --rate 1e-308", 2, "exceeds 0 by 1e-12"),
        ("dots --rate 1e-12", 1, "1e+14 s"),
        ("dots --speed 1000", 1, "motion blur"),
        ("landmarks MAP --landmarks 1000000", 1, "1 to 10000"),
        ("landmarks MAP --rate 1e9", 1, "samples"),
    ],
)
def test_sizes_beyond_the_memory_are_refused(
    locatk, tmp_path: Path, words: str, status: int, reason: str
) -> None:
    system = words.split()[0]
    args = words.replace("MAP", " ".join(map(str, inputs(system, tmp_path)))).split()
    result = locatk("simulate", *args, "-o", tmp_path / "run.mcap")
    assert result.exit_code == status
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.slow
def test_flights_of_lighthouse(locatk, tmp_path: Path) -> None:
    config = tmp_path / "sim.toml"
    config.write_text(
        lighthouse.CONFIG.dumps(
            {
                "robots.imu_hz": 50.0,
                "stations.factory_data": True,
                "errors.reflection_fraction": 0.1,
                "errors.calibration_deg": 0.06,
                "errors.station_turn_deg": 1.0,
            }
        )
    )
    options = lighthouse.simulation_options(
        lighthouse.CONFIG.read(config) | {"robots.flying": True}
    )
    assert options.flying
    assert not options.planar
    assert options.calibration_error_rad == pytest.approx(np.radians(0.06))
    assert options.station_turn_rad == pytest.approx(np.radians(1.0))
    output = tmp_path / "flight.mcap"
    arguments = ("-o", output, "--receiver", "deck", "--duration", 6, "--config", config)
    result = locatk("simulate", "lighthouse", "--flight", *arguments)
    assert result.exit_code == 0, result.stderr
    session = Session.open(output)
    [imu] = observations.read_imu(session)
    assert (imu.device, len(imu)) == ("robot-1", 300)
    assert set(observations.read_scene(session).calibrations) == {1, 2}
    [truth] = observations.read_truth(session)
    assert np.abs(truth.quaternion[:, :2]).max() > 1e-3
    result = locatk("simulate", "lighthouse", "--flight", "--planar", *arguments)
    assert (result.exit_code, "--flight or --planar" in result.stderr) == (2, True)
