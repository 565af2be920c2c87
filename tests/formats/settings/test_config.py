"""Configuration files of the simulators: what is written is read, and nothing else is accepted."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from locatk.core.dots.simulation.session import sheet
from locatk.core.errors import ArtifactError, MissingDataError
from locatk.formats.artifacts.kinds import (
    Boolean,
    FilePath,
    Integer,
    Number,
    Record,
    Row,
)
from locatk.formats.settings.config import SettingsConfig, SettingsError, with_values
from locatk.formats.simulation import dots, landmarks, lighthouse, polaris

CONFIGS = [module.CONFIG for module in (dots, landmarks, lighthouse, polaris)]
IDS = [config.system for config in CONFIGS]
FLIPPED = "[faults]\nflipped_bars"


def text_of(config: SettingsConfig, body: str) -> str:
    """A configuration file with these tables."""
    return f'format = "locatk-simulation-{config.system}"\nformat_version = 1\n{body}\n'


def other_value(config: SettingsConfig, key: str) -> Any:
    """A valid value of a setting that is not its default."""
    setting = config.setting(key)
    default = config.default(setting)
    if default is None:
        return setting.example
    if isinstance(setting.kind, Boolean):
        return not default
    if isinstance(setting.kind, Number):
        return default + 0.125 if default + 0.125 < setting.kind.high else default / 2
    if isinstance(setting.kind, Integer):
        is_lowest = default == setting.kind.low
        return default + 1 if is_lowest else default - 1
    return setting.kind.choices[-1]  # type: ignore[attr-defined]


@pytest.mark.parametrize("config", CONFIGS, ids=IDS)
def test_the_file_sets_nothing_and_explains_every_key(config: SettingsConfig) -> None:
    text = config.dumps()
    assert config.loads(text) == {}
    for setting in config.settings:
        assert re.search(
            rf"(^# .*\n)+#{setting.name} = ", text[text.index(f"[{setting.table}]") :], re.M
        )
        assert re.match(r"[A-Za-z].*[^.]$", setting.help), setting.key
        assert setting.unit or not isinstance(setting.kind, Number) or setting.name == "factor"


@pytest.mark.parametrize("config", CONFIGS, ids=IDS)
def test_the_defaults_of_the_file_are_those_of_the_simulator(config: SettingsConfig) -> None:
    """To the last bit: uncommenting a default changes nothing."""
    with_default = {
        setting.key: config.default(setting)
        for setting in config.settings
        if config.default(setting) is not None
    }
    uncommented = config.merge(config.loads(config.dumps(with_default)), {})
    assert uncommented == with_default
    values = {
        name: value
        for name, value in config.in_si(uncommented).items()
        if config.setting(next(s.key for s in config.settings if name in (s.field, s.key))).field
    }
    changed = with_values(config.defaults, values)
    for field in dataclasses.fields(changed):
        value, default = getattr(changed, field.name), getattr(config.defaults, field.name)
        if dataclasses.is_dataclass(value):
            assert repr(value) == repr(default)
        else:
            assert value == default


@pytest.mark.parametrize("config", CONFIGS, ids=IDS)
def test_every_setting_comes_back_from_the_file(config: SettingsConfig) -> None:
    settings = {setting.key: other_value(config, setting.key) for setting in config.settings}
    for setting in config.settings:
        assert settings[setting.key] != config.default(setting)
    text = config.dumps(settings)
    assert config.loads(text) == settings
    assert config.dumps(config.loads(text)) == text
    parsed = tomllib.loads(text)
    assert sum(len(table) for table in parsed.values() if isinstance(table, dict)) == len(settings)


@pytest.mark.parametrize("config", CONFIGS, ids=IDS)
def test_keys_fields_and_options_are_unique(config: SettingsConfig) -> None:
    keys = [setting.key for setting in config.settings]
    fields = [setting.field for setting in config.settings if setting.field]
    flags = [name for setting in config.settings for name in setting.flag.split("/") if name]
    for names in (keys, fields, flags):
        assert len(set(names)) == len(names)
    for setting in config.settings:
        assert not set(setting.former_flag.split()) & set(flags)


@pytest.mark.parametrize(
    ("body", "where", "expected"),
    [
        ("[robot]\nspeed_mms = 1", "robot", "unknown key 'speed_mms'"),
        ("[robots]\nspeed_mps = 1", "None", "unknown key 'robots'"),
        ("[robot]\nspeed_mps = 0", "robot.speed_mps", "a number above 0"),
        ("[robot]\nspeed_mps = true", "robot.speed_mps", "a number above 0"),
        ('[robot]\nspeed_mps = "fast"', "robot.speed_mps", "a number above 0"),
        ("[robot]\nspeed_mps = inf", "robot.speed_mps", "a finite number above 0"),
        ("[robot]\nlandmarks = 2.0", "robot.landmarks", "a whole number of at least 1"),
        ("[robot]\nlandmarks = 0", "robot.landmarks", "a whole number of at least 1"),
        ("[errors]\nnoise_mt = -0.1", "errors.noise_mt", "a number of at least 0"),
        ("[errors]\nbar_strength_fraction = 0.3", "bar_strength_fraction", "from 0 to 0.2"),
        ("[errors]\nearth_ut = nan", "errors.earth_ut", "a finite number"),
        ('[robot]\nstrategy = "walk"', "robot.strategy", "'walk' is not one of paper"),
        ("[robot]\nstrategy = 1", "robot.strategy", "a string"),
        ("[robot]\npath_file = 1", "robot.path_file", "the name of a file"),
        ("[robot]\ncells = [1, 2]", "robot.cells[0]", "a list of 2"),
        ("[robot]\ncells = 1", "robot.cells", "a list"),
        (f"{FLIPPED} = [[1, 2]]", "flipped_bars[0]", "keys cell, bar"),
        (f"{FLIPPED} = [{{ cell = [1, 2], bars = 1 }}]", "flipped_bars[0]", "unknown key 'bars'"),
        (f"{FLIPPED} = [{{ cell = [1, 2] }}]", "flipped_bars[0]", "missing key 'bar'"),
        (f"{FLIPPED} = [{{ cell = [1, 2], bar = -1 }}]", "flipped_bars[0].bar", "of at least 0"),
        ("robot = 3", "robot", "expected a table"),
    ],
)
def test_a_wrong_key_or_value_is_named(body: str, where: str, expected: str) -> None:
    with pytest.raises(ArtifactError, match=re.escape(expected)) as caught:
        landmarks.CONFIG.loads(text_of(landmarks.CONFIG, body))
    assert str(caught.value.where).endswith(where)


def test_an_unknown_key_gets_the_nearest_one() -> None:
    with pytest.raises(ArtifactError) as caught:
        landmarks.CONFIG.loads(text_of(landmarks.CONFIG, "[robot]\nspeed_mms = 1"))
    assert caught.value.hint == "Did you mean speed_mps?"


def test_values_at_the_ends_of_a_range() -> None:
    below_1 = Number(0.0, 1.0, is_high_excluded=True)
    assert below_1.parse(0) == 0.0
    for number in (1, -1e-9, math.nan, math.inf):
        with pytest.raises(ValueError, match="from 0 to below 1"):
            below_1.parse(number)
    assert Number(0.0, 1.0).parse(1) == 1.0
    assert Integer(0, 7).parse(7) == 7
    with pytest.raises(ValueError, match="from 0 to 7"):
        Integer(0, 7).parse(8)
    with pytest.raises(ValueError, match="true or false"):
        Boolean().parse(1)


def test_text_of_the_command_line() -> None:
    bar = Record({"cell": Row(Integer(), 2), "bar": Integer()})
    assert bar.parse_text("2,3:1") == ((2, 3), 1)
    assert Row(Number(), 2).parse_text("1.002,0.999") == (1.002, 0.999)
    for text in ("2,3", "2:1", "2,3,4:1", "2,3:1:0", "a,3:1", ""):
        with pytest.raises(ValueError, match=r"expected|invalid literal"):
            bar.parse_text(text)


def test_a_file_of_another_simulator_or_version_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="locatk-simulation-dots"):
        dots.CONFIG.loads(polaris.CONFIG.dumps())
    newer = dots.CONFIG.dumps().replace("format_version = 1", "format_version = 2")
    with pytest.raises(ArtifactError, match="newer than 1"):
        dots.CONFIG.loads(newer)
    with pytest.raises(MissingDataError):
        dots.CONFIG.read(tmp_path / "nowhere.toml")


def test_files_are_relative_to_the_folder_of_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "sim.toml"
    path.write_text(text_of(dots.CONFIG, '[camera]\nfile = "lens/camera.toml"'))
    settings = dots.CONFIG.read(path)
    assert dots.CONFIG.files(settings) == [tmp_path / "lens" / "camera.toml"]
    path.write_text(text_of(lighthouse.CONFIG, '[robots]\nreceiver = "deck"'))
    settings = lighthouse.CONFIG.read(path)
    assert settings == {"robots.receiver": "deck"}
    assert lighthouse.CONFIG.files(settings) == []
    assert FilePath().resolve(str(tmp_path / "a.toml"), Path("b")) == str(tmp_path / "a.toml")


def test_the_command_line_overrides_the_file() -> None:
    file = {"robot.speed_mps": 0.3, "robot.landmarks": 5, "random.seed": 4}
    merged = landmarks.CONFIG.merge(file, {"robot.speed_mps": 0.2, "random.seed": 0})
    assert merged == {"robot.speed_mps": 0.2, "robot.landmarks": 5, "random.seed": 0}


def test_a_setting_of_the_file_gives_way_to_one_that_excludes_it() -> None:
    merge = landmarks.CONFIG.merge
    cells = {"robot.strategy": "path", "robot.cells": ((0, 0), (0, 1))}
    path = {"robot.path_file": "path.csv"}
    assert merge(cells, path) == {"robot.strategy": "path", **path}
    assert merge({"robot.strategy": "path", **path}, {"robot.cells": cells["robot.cells"]}) == cells
    # A tour of five landmarks, for once as a pass.
    assert merge({"robot.landmarks": 5}, {"robot.strategy": "pass"}) == {"robot.strategy": "pass"}


def test_a_switch_that_is_off_excludes_nothing() -> None:
    noise = {"errors.noise_ut": 1.0}
    off = {"errors.measured_noise": False}
    assert polaris.CONFIG.merge(noise | off, {}) == noise | off
    assert polaris.CONFIG.merge(noise, off) == noise | off
    assert polaris.CONFIG.merge(noise, {"errors.measured_noise": True}) == {
        "errors.measured_noise": True
    }
    assert dots.CONFIG.merge({dots.IS_SCALE_KNOWN: False}, {}) == {dots.IS_SCALE_KNOWN: False}


@pytest.mark.parametrize(
    ("config", "file", "flags", "expected"),
    [
        (dots.CONFIG, {}, {dots.FRAMES: 3, dots.DURATION: 2.0}, "--frames or --duration, not both"),
        (dots.CONFIG, {dots.FRAMES: 3, dots.DURATION: 2.0}, {}, "--frames or --duration, not both"),
        (dots.CONFIG, {dots.IS_SCALE_KNOWN: True}, {}, "--scale-known needs --printer-scale"),
        (landmarks.CONFIG, {}, {"robot.lateral_mm": 2.0}, "needs --strategy pass"),
        (landmarks.CONFIG, {"robot.strategy": "path"}, {"robot.landmarks": 2}, "--strategy paper"),
        (polaris.CONFIG, {}, {"sensors.array_file": "a", "sensors.gain": 3}, "--array or gain"),
    ],
)
def test_settings_that_contradict_each_other(
    config: SettingsConfig, file: dict[str, Any], flags: dict[str, Any], expected: str
) -> None:
    with pytest.raises(SettingsError, match=re.escape(expected)):
        config.merge(file, flags)


def test_units_are_converted() -> None:
    values = polaris.CONFIG.in_si(
        {
            "robot.lateral_mm": 5.0,
            "robot.heading_deg": 30.0,
            "robot.speed_mps": 0.3,
            "errors.drift_ut": 2.0,
        }
    )
    expected = {"lateral_m": 5e-3, "heading_rad": math.radians(30), "speed_mps": 0.3}
    assert values == pytest.approx({**expected, "drift_t": 2e-6})
    values = landmarks.CONFIG.in_si(
        {
            "sensors.range_mt": 20.0,
            "robot.turn_rate_dps": 120.0,
            "robot.turn_acceleration_dps2": 400.0,
            "odometry.drift_deg_per_m": 3.0,
            "random.seed": 3,
        }
    )
    rate, acceleration, drift = map(math.radians, (120, 400, 3))
    assert values == pytest.approx(
        {
            "range_t": 0.02,
            "limits.turn_rps": rate,
            "limits.turn_rps2": acceleration,
            "errors.odometry_drift_rad_per_m": drift,
            "seed": 3,
        }
    )
    assert dots.CONFIG.in_si({"print.jitter_um": 8.0}) == pytest.approx({"jitter_m": 8e-6})


def test_error_factor_multiplies_defaults_only() -> None:
    options = landmarks.simulation_options({"errors.factor": 0.0, "errors.noise_mt": 0.3})
    assert options.errors.noise_t == pytest.approx(3e-4)
    assert options.errors.offset_t == 0.0
    assert options.errors.earth_t == -45e-6


def test_the_car_gives_the_defaults_of_polaris() -> None:
    mini = polaris.simulation_options({"robot.car": "mini"})
    assert (len(mini.array), mini.rate_hz, mini.speed_mps) == (3, 17.0, 0.005)
    faster = polaris.simulation_options({"robot.car": "mini", "robot.speed_mps": 0.1})
    assert (faster.rate_hz, faster.speed_mps) == (17.0, 0.1)


def test_duration_and_rate_give_the_frames() -> None:
    settings = {dots.DURATION: 2.0, "path.rate_hz": 15.0}
    manifest = sheet()
    assert dots.simulation_options(settings, manifest).frames == 30
    assert dots.simulation_options({dots.DURATION: 2.0}, manifest).frames == 100
    assert dots.simulation_options({dots.DURATION: 1e-3}, manifest).frames == 1
