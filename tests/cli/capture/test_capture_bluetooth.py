"""`locatk capture ble:NAME` as a user runs it, with devices in the place of those of bleak."""

from __future__ import annotations

import json
import os
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from locatk.formats.schemas.serial_pb2 import Readings
from locatk.formats.sessions.reader import Session

ADDRESS = "C0:11:22:33:44:55"
TEXT = b"t_ms,x_mm\n" + b"".join(b"%d,%d\n" % (10 * k, k * k) for k in range(60))


@pytest.fixture
def robot(air: Any) -> Any:
    return air.add("robot7", ADDRESS)


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """Descriptor of the device behind a pseudo-terminal, and the path of the port."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    yield master, path
    os.close(master)


def readings(path: Path) -> list[Any]:
    return [
        (list(message.names), list(message.value), list(message.device_ticks))
        for _, message in Session.open(path).decoded("/readings/robot", Readings)
    ]


def joined(path: Path) -> tuple[list[str], list[float]]:
    """Names and values, which do not depend on how many lines one message has."""
    messages = readings(path)
    return messages[0][0], [value for _, values, _ in messages for value in values]


@pytest.mark.slow
def test_same_session_as_from_a_serial_port(
    locatk: Callable, robot: Any, terminal: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    master, port = terminal
    options = ("--device", "lines", "--duration", "600ms", "--json")
    threading.Timer(0.25, os.write, (master, TEXT)).start()
    serial = locatk("capture", port, *options, "-o", tmp_path / "serial.mcap")
    robot.greeting = tuple(TEXT[start : start + 20] for start in range(0, len(TEXT), 20))
    radio = locatk("capture", "ble:robot7", *options, "-o", tmp_path / "radio.mcap")
    for result in (serial, radio):
        assert result.exit_code == 0, result.stderr
        assert json.loads(result.stdout)["bytes"] == len(TEXT)
    assert raw_bytes(tmp_path / "radio.mcap") == raw_bytes(tmp_path / "serial.mcap") == TEXT
    names, values = joined(tmp_path / "radio.mcap")
    assert (names, values) == joined(tmp_path / "serial.mcap")
    assert values[-1] == 59 * 59
    assert "Recording ble:robot7; Ctrl-C ends it." in radio.stderr
    known = Session.open(tmp_path / "radio.mcap").metadata()["capture"]
    assert known["resolved"] == ADDRESS
    assert "baud" not in known


@pytest.mark.parametrize("port", ["ble:robot7", "BLE:robot7"])
@pytest.mark.parametrize("option", ["--baud", "--speed"])
def test_options_of_other_ports_are_refused(
    locatk: Callable, air: Any, tmp_path: Path, port: str, option: str
) -> None:
    result = locatk("capture", port, option, 9600, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 2
    assert f"{option} does not apply to the port {port}." in result.stderr
    assert air.scans == 0


def test_unknown_name(locatk: Callable, robot: Any, tmp_path: Path) -> None:
    result = locatk("capture", "ble:robot8", "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ble:robot8: not found in 0.1 s; found: robot7. Hint: ")
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_bleak_is_missing(
    locatk: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "bleak", None)
    result = locatk("capture", "ble:robot7", "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    assert 'pip install "locatk[ble]"' in result.stderr
    assert result.stderr.count("\n") == 1


def test_the_list_does_not_scan(locatk: Callable, robot: Any, air: Any) -> None:
    assert locatk("capture", "--list").exit_code == 0
    assert air.scans == 0


@pytest.mark.slow
def test_bad_frames_do_not_suggest_a_baud_rate(
    locatk: Callable, robot: Any, tmp_path: Path
) -> None:
    robot.greeting = (bytes(range(1, 245)),) * 8
    options = ("--device", "locatk", "--duration", "400ms")
    result = locatk("capture", "ble:robot7", *options, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 3
    assert "check --device" in result.stderr
    assert "--baud" not in result.stderr
