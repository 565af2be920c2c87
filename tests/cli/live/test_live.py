"""`locatk live`: its options, and errors before anything is localized."""

from __future__ import annotations

import json
import re
import shlex
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from locatk.cli.app import app
from locatk.formats.capture import ports
from locatk.formats.capture.links import LinkEnded, Overruns
from locatk.formats.sinks.registry import SINKS
from locatk.formats.sinks.udp import UdpSink

HALLS = b"hall_front_mt,hall_left_mt,hall_rear_mt,hall_right_mt\n1,0,0,0\n1,0,0,0\n"


class ListedPort:
    """Port that sends given bytes once; counts how often its link is closed."""

    name = "listed"
    can_reconnect = False

    def __init__(self, data: bytes) -> None:
        self._pieces = [data]
        self.closed = self.opened = 0

    def open(self) -> ListedPort:
        self.opened += 1
        return self

    def read(self, wait_s: float) -> bytes:
        if not self._pieces:
            raise LinkEnded("the end")
        return self._pieces.pop()

    def overruns(self) -> Overruns | None:
        return None

    def describe(self) -> dict[str, str]:
        return {"port": self.name}

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch) -> ListedPort:
    """A port that sends samples of hall sensors; every serial port is this one."""
    port = ListedPort(HALLS)
    monkeypatch.setattr(ports, "port_of", lambda *args, **more: port)
    return port


def one_line(result: Any, status: int, *words: str) -> None:
    """Check that the last line on stderr is the error, without a traceback."""
    assert result.exit_code == status, result.output
    error = result.stderr.splitlines()[-1]
    assert error.startswith("Error:")
    for word in words:
        assert word in error
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "Missing PORT"),
        ("--record run.mcap", "Missing PORT"),
        ("--device lines", "--device applies to PORT"),
        ("--speed 0 --input COM3", "--speed applies to PORT"),
        ("--columns a,b --input COM3", "--columns applies to PORT"),
        ("--name red --input COM3", "--name applies to PORT"),
        ("COM3 --rotate 1h", "--rotate needs --record"),
        ("COM3 --overwrite", "--overwrite needs --record"),
        ("COM3 --record run.csv", ".mcap"),
        ("COM3 --speed -1", "--speed"),
        ("COM3 --duration soon", "--duration"),
        ("COM3 --baud 0", "--baud"),
    ],
)
def test_usage(locatk: Any, arguments: str, words: str) -> None:
    one_line(locatk("live", *arguments.split()), 2, words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("COM3 --device lamp", "lamp"),
        ("COM3 --to lamp:red", "no sink 'lamp'"),
        ("COM3 --to udp://", "no host"),
        ("COM3 --to 8080", "no address of a sink"),
        ("camera:0 --device locatk", "a camera is not a locatk"),
        ("--input 'COM3 colour=red'", "colour"),
        ("replay:absent.mcap", "absent.mcap"),
        ("./absent", "no such port"),
        ("COM3 --name a/b", "a/b"),
        ("COM3 --artifact absent.toml", "absent.toml"),
        ("--config absent.toml", "absent.toml"),
    ],
)
def test_values_that_are_wrong(locatk: Any, arguments: str, words: str) -> None:
    result = locatk("live", *shlex.split(arguments))
    one_line(result, 1, words, "Hint:")


def test_an_existing_recording_is_kept(locatk: Any, tmp_path: Path, listed: ListedPort) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"mine")
    result = locatk("live", "COM3", "--device", "lines", "--record", path)
    one_line(result, 1, "run.mcap", "--overwrite")
    assert path.read_bytes() == b"mine"
    assert not listed.opened


def test_a_replay_is_not_overwritten_by_its_recording(locatk: Any, live_sessions: Any) -> None:
    path = live_sessions.decoded("landmarks")
    before = path.read_bytes()
    result = locatk("live", f"replay:{path}", "--record", path, "--overwrite")
    one_line(result, 1, path.name)
    assert path.read_bytes() == before


@pytest.mark.parametrize("text", ["short", "two words or more", ""])
def test_a_bad_token(locatk: Any, tmp_path: Path, text: str, listed: ListedPort) -> None:
    path = tmp_path / "token"
    path.write_text(text)
    one_line(locatk("live", "COM3", "--token-file", path), 1, "not a token", "at least 8")
    assert not listed.opened


def test_the_missing_geometry_of_sensors(locatk: Any, listed: ListedPort, tmp_path: Path) -> None:
    """It is known when samples arrive: the recording is complete, and the port is closed."""
    path = tmp_path / "run.mcap"
    result = locatk("live", "COM3", "--device", "lines", "--record", path)
    one_line(result, 1, "no geometry", "--artifact halls.toml")
    assert listed.closed == listed.opened == 1
    assert locatk("info", path).exit_code == 0


def test_artifacts_of_two_systems(locatk: Any, listed: ListedPort, live_sessions: Any) -> None:
    given = [live_sessions.decoded("polaris"), live_sessions.decoded("landmarks")]
    options = [word for path in given for word in ("--artifact", path)]
    result = locatk("live", "COM3", "--device", "lines", *options)
    one_line(result, 1, "landmarks", "polaris", "one system")
    assert not listed.opened


def test_a_server_whose_port_is_in_use(
    locatk: Any, listed: ListedPort, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("websockets")
    closed: list[UdpSink] = []
    stop = UdpSink.stop

    def noted(sink: UdpSink) -> None:
        closed.append(sink)
        stop(sink)

    monkeypatch.setattr(UdpSink, "stop", noted)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"web://:{server.getsockname()[1]}"
        path = tmp_path / "run.mcap"
        arguments = ("--to", "udp://127.0.0.1:9", "--to", address, "--record", path)
        result = locatk("live", "COM3", "--device", "lines", *arguments)
    one_line(result, 1, "in use", "Hint:")
    assert listed.closed == listed.opened == 1
    assert len(closed) == 1
    assert not path.exists()


# ---- lists, help, configuration


def test_the_list_of_sinks(locatk: Any) -> None:
    text = locatk("live", "--list-sinks")
    assert text.exit_code == 0
    assert all(scheme in text.stdout for scheme in SINKS)
    listed = json.loads(locatk("live", "--list-sinks", "--json").stdout)
    assert listed["version"] == 1
    assert set(SINKS) <= set(listed["sinks"])


def examples() -> Iterator[str]:
    command = app.get_command(click.Context(app), "live")
    assert command is not None
    for line in (command.help or "").splitlines():
        if line.strip().startswith("locatk live"):
            yield line.strip()


def test_the_examples_of_the_help_are_valid() -> None:
    """Their options exist and their sinks and inputs are understood."""
    from locatk.formats.live.config import parse_input
    from locatk.formats.sinks.addresses import parse_address

    command = app.get_command(click.Context(app), "live")
    assert command is not None
    lines = list(examples())
    assert len(lines) >= 5
    for line in lines:
        words = shlex.split(line)[2:]
        # Files of the examples do not exist: only their options are removed.
        words = [word for word in words if not word.endswith(".toml") and word != "--artifact"]
        words = [word for word in words if word != "--config"]
        context = command.make_context("live", words, resilient_parsing=False)
        for address in context.params["sinks"]:
            assert parse_address(address).scheme in SINKS
        for text in context.params["inputs"]:
            assert parse_input(text).port


def test_each_sink_is_in_the_help(locatk: Any) -> None:
    text = locatk("live", "--help").stdout
    for scheme in set(SINKS) - {"mqtts"}:
        assert re.search(rf"^ +{scheme}:", text, re.MULTILINE), scheme


@pytest.mark.slow
def test_a_configuration_has_paths_of_its_own_folder(
    locatk: Any, live_sessions: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Options are added to it."""
    folder = tmp_path / "robot"
    folder.mkdir()
    raw = live_sessions.raw("landmarks")
    (folder / "site.mcap").write_bytes(live_sessions.decoded("landmarks").read_bytes())
    (folder / "live.toml").write_text(
        'format = "locatk-live"\nformat_version = 1\nartifacts = ["site.mcap"]\n'
        f'record = "run-%Y.mcap"\n[[inputs]]\nport = "replay:{raw}"\nspeed = 0\nname = "red"\n'
    )
    monkeypatch.chdir(tmp_path)
    result = locatk("live", "--config", "robot/live.toml", "--to", "jsonl:added.jsonl")
    assert result.exit_code == 0, result.stderr
    (recording,) = folder.glob("run-2*.mcap")
    added = Path("added.jsonl").read_text().splitlines()
    assert len(added) == len(result.stdout.splitlines()) > 100
    assert {json.loads(line).get("device", "red") for line in added} == {"red"}
    assert locatk("info", recording).exit_code == 0


def test_a_configuration_names_its_missing_artifact(locatk: Any, tmp_path: Path) -> None:
    path = tmp_path / "live.toml"
    path.write_text(
        'format = "locatk-live"\nformat_version = 1\nartifacts = ["absent.toml"]\n'
        '[[inputs]]\nport = "COM3"\n'
    )
    one_line(locatk("live", "--config", path), 1, str(tmp_path / "absent.toml"))
