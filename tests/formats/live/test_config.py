"""The file ``live.toml``, and inputs on the command line."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import pytest

from locatk.core.errors import ArtifactError, InputError
from locatk.formats.live import config

FULL = """
format = "locatk-live"
format_version = 1
artifacts = ["maps/floor.toml"]
sinks = ["web://:8080", "udp://robot:9000"]
record = "runs/%Y%m%d-%H%M%S.mcap"
rotate_s = 3600
token_file = "token.txt"

[[inputs]]
port = "/dev/ttyACM0"
device = "locatk"
name = "red"

[[inputs]]
port = "replay:odometry.mcap"
device = "lines"
columns = ["x_m", "y_m", "heading_rad"]
speed = 0
"""


def read(folder: Path, text: str) -> config.LiveConfig:
    path = folder / "live.toml"
    path.write_text(text)
    return config.read_config(path)


def test_all_keys_are_read_and_files_are_relative_to_the_configuration(tmp_path: Path) -> None:
    read_config = read(tmp_path, FULL)
    first, second = read_config.inputs
    assert (first.port, first.device, first.name) == ("/dev/ttyACM0", "locatk", "red")
    assert second.columns == ("x_m", "y_m", "heading_rad")
    assert second.speed == 0
    assert second.keeps_time
    assert not first.keeps_time
    assert read_config.artifacts == (str(tmp_path / "maps/floor.toml"),)
    assert read_config.record == str(tmp_path / "runs/%Y%m%d-%H%M%S.mcap")
    assert read_config.token_file == str(tmp_path / "token.txt")
    assert read_config.sinks == ("web://:8080", "udp://robot:9000")
    assert read_config.rotate_s == 3600


def test_the_documented_file_is_written_and_read_back(tmp_path: Path) -> None:
    once = config.CONFIG.loads(FULL)
    assert config.CONFIG.loads(config.CONFIG.dumps(once)) == once


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("inputs = []", "inputs"),
        ('[[inputs]]\nprot = "COM3"', "port"),
        ('[[inputs]]\nport = "COM3"\nbaud = -1', "baud"),
        ('sinks = "web://"\n[[inputs]]\nport = "COM3"', "sinks"),
        ('rotate_s = 60\n[[inputs]]\nport = "COM3"', "rotate_s"),
        ('[[inputs]]\nport = "COM3"\nimage = "gif"', "image"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(ArtifactError) as error:
        read(tmp_path, f'format = "locatk-live"\nformat_version = 1\n{text}')
    assert problem in str(error.value)


def test_an_input_of_the_command_line() -> None:
    given = config.parse_input("/dev/ttyUSB0 device=lines name=red columns=a,b baud=9600 speed=2")
    assert given.port == "/dev/ttyUSB0"
    assert (given.device, given.name, given.columns) == ("lines", "red", ("a", "b"))
    assert (given.baud, given.speed) == (9600, 2.0)


def test_a_port_with_spaces_is_quoted() -> None:
    assert config.parse_input("'replay:my run.mcap' name=red").port == "replay:my run.mcap"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "no port"),
        ("'COM3", "no port"),
        ("COM3 colour=red", "colour"),
        ("COM3 name", "name"),
        ("COM3 baud=fast", "not a number"),
        ("COM3 baud=0", "baud"),
        ("COM3 image=gif", "image"),
    ],
)
def test_an_invalid_input_is_one_line(text: str, problem: str) -> None:
    with pytest.raises(InputError) as error:
        config.parse_input(text)
    assert problem in str(error.value)
    assert "\n" not in error.value.message


def test_several_recordings_have_the_number_of_their_input() -> None:
    requests = (config.parse_input("COM3"), config.parse_input("COM4"))
    output = Path("runs/run.mcap")
    assert config.with_recording(requests[:1], output)[0].output == output
    assert [each.output for each in config.with_recording(requests, output)] == [
        Path("runs/run-1.mcap"),
        Path("runs/run-2.mcap"),
    ]


def test_the_time_is_part_of_the_name_of_a_recording() -> None:
    now = datetime(2026, 11, 28, 12, 40, 5)
    assert config.recording_path("run-%Y%m%d-%H%M%S.mcap", now) == Path("run-20261128-124005.mcap")
    assert config.recording_path("run.mcap", now) == Path("run.mcap")


def test_a_token_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text("s3cret-token\n")
    assert config.read_token(path) == "s3cret-token"
    for text in ("", "short", "two words are none", "two\nlines-of-it"):
        path.write_text(text)
        with pytest.raises(InputError):
            config.read_token(path)
