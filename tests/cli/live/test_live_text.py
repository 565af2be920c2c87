"""What `locatk live` prints: lines of a terminal, and JSON for programs."""

from __future__ import annotations

import io
import os
import re
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from locatk.cli import console
from locatk.cli.live import text as live_text
from locatk.cli.live.text import LiveText, device_lines
from locatk.core.streaming.events import PoseEstimate, StateChange, TrackingState
from locatk.formats.live.session import DeviceStatus
from locatk.formats.sinks.interface import LiveMessage, SinkContext


class Terminal(io.StringIO):
    """Stream that is a terminal."""

    def isatty(self) -> bool:
        return True


def pose(**changes: Any) -> PoseEstimate:
    values: dict[str, Any] = {
        "device": "red",
        "frame": "floor",
        "time_ns": 10**18,
        "position": np.array([1.2041, 0.801, 0.0]),
        "quaternion": np.array([0.0, 0.0, np.sin(np.radians(45)), np.cos(np.radians(45))]),
        "covariance": np.diag([9e-6, 16e-6, 1e-6, 1e-4, 1e-4, 1e-4]),
        "state": TrackingState.TRACKING,
        "reason": "",
        "reset_counter": 0,
    }
    return PoseEstimate(**{**values, **changes})


def devices() -> dict[str, DeviceStatus]:
    return {
        "red": DeviceStatus(TrackingState.TRACKING, "", pose(), 7, 50.04, 0.0009),
        "blue": DeviceStatus(TrackingState.LOST, "no light for 2.0 s"),
    }


def until(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture
def on_terminal(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Terminal]:
    """Return a function that makes both streams one terminal; pytest sets them after fixtures."""
    console.reset()
    monkeypatch.setattr(live_text, "REFRESH_S", 0.01)
    monkeypatch.delenv("NO_COLOR", raising=False)

    def use() -> Terminal:
        stream = Terminal()
        monkeypatch.setattr("sys.stdout", stream)
        monkeypatch.setattr("sys.stderr", stream)
        return stream

    return use


def test_a_line_per_device_with_state_and_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    blue, red = device_lines(devices(), 200)
    assert blue == "blue       lost: no light for 2.0 s"
    assert red.split() == [
        "red", "1.204", "0.801", "0.000", "m", "90.0", "deg", "+-5.0", "mm", "50.0/s", "0.9", "ms",
        "tracking",
    ]  # fmt: skip


def test_lines_fit_the_terminal_and_have_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    assert max(map(len, device_lines(devices(), 30))) == 29
    monkeypatch.delenv("NO_COLOR")
    blue, red = device_lines(devices(), 30)
    assert blue.startswith("\x1b[31m")
    assert red.startswith("\x1b[32m")


def test_a_position_without_orientation_has_no_heading(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    covariance = np.full((6, 6), np.nan)
    covariance[:3, :3] = 1e-6 * np.eye(3)
    flat = pose(quaternion=np.full(4, np.nan), covariance=covariance)
    (line,) = device_lines({"red": DeviceStatus(TrackingState.PROVISIONAL, "", flat)}, 200)
    assert "deg" not in line
    assert "nan" not in line


def test_names_and_reasons_cannot_act_on_the_terminal() -> None:
    status = DeviceStatus(TrackingState.LOST, "\x1b[2Jgone\n")
    (line,) = device_lines({"\x1b]0;x\x07": status}, 200)
    assert "\x1b[2J" not in line
    assert "\x1b]" not in line
    assert "\n" not in line


def test_lines_change_in_place_and_are_wiped(on_terminal: Callable[[], Terminal]) -> None:
    terminal = on_terminal()
    text = LiveText(as_json=False)
    session = SimpleNamespace(devices=devices())
    with text.shown(session):
        text.open(SinkContext(""))
        until(lambda: terminal.getvalue().count("\x1b[2A\x1b[J") >= 2)
        text.tell("robot: connection lost")
        text.offer(LiveMessage(pose(), time.monotonic()))
        text.close(2.0)
    shown = terminal.getvalue()
    assert "{" not in shown
    assert "Warning:\x1b[0m robot: connection lost\n" in shown
    assert screen(shown) == ["Warning: robot: connection lost", ""]


def screen(text: str) -> list[str]:
    """Return the lines that a terminal shows."""
    lines = [""]
    for part in re.split("(\x1b\\[\\d+A|\x1b\\[J|\x1b\\[\\d*m|\n)", text):
        if part == "\n":
            lines.append("")
        elif part.endswith("A") and part.startswith("\x1b"):
            lines = [*lines[: len(lines) - 1 - int(part[2:-1])], ""]
        elif not part.startswith("\x1b"):
            lines[-1] += part
    return lines


def test_the_state_is_seen_on_a_terminal_of_80_characters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    status = DeviceStatus(TrackingState.DEAD_RECKONING, "", pose(), 7, 100.0, 0.0123)
    (line,) = device_lines({"robot": status}, 80)
    assert len(line) < 80
    assert line.endswith("dead reckoning")


def test_quiet_shows_no_lines(on_terminal: Callable[[], Terminal]) -> None:
    terminal = on_terminal()
    console.set_verbosity(-1)
    try:
        text = LiveText(as_json=False)
        with text.shown(SimpleNamespace(devices=devices())):
            text.open(SinkContext(""))
            text.ready(["COM3"], [])
            text.tell("a warning")
            time.sleep(0.05)
            text.close(2.0)
    finally:
        console.reset()
    assert terminal.getvalue() == ""


def test_json_drops_the_oldest_lines_of_a_slow_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_text, "MAX_WAITING", 10)
    release, begun = threading.Event(), threading.Event()
    printed: list[str] = []

    def slow(text: str) -> None:
        begun.set()
        release.wait(10)
        printed.append(text)

    monkeypatch.setattr(console, "write_result", slow)
    monkeypatch.setattr("sys.stdout", io.StringIO())
    text = LiveText(as_json=False)
    text.open(SinkContext(""))

    def offer(number: int) -> None:
        change = StateChange("red", number * 10**9, TrackingState.LOST, "")
        text.offer(LiveMessage(change, time.monotonic()))

    offer(0)
    assert begun.wait(10)
    for number in range(1, 31):
        offer(number)
    assert text.status().dropped == 20
    release.set()
    text.close(5.0)
    lines = "".join(printed).splitlines()
    assert [f'"time_s": {n}.0,' in line for n, line in zip([0, *range(21, 31)], lines, strict=True)]
    assert text.status().sent == 11


def test_nothing_is_printed_to_the_null_device(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull, "w") as null:
        monkeypatch.setattr("sys.stdout", null)
        text = LiveText(as_json=False)
        text.open(SinkContext(""))
        text.offer(LiveMessage(pose(), 0.0))
        text.close(2.0)
        assert text.status().sent == 0
        # Unless JSON is asked for.
        asked = LiveText(as_json=True)
        asked.open(SinkContext(""))
        asked.offer(LiveMessage(pose(), 0.0))
        asked.close(2.0)
        assert asked.status().sent == 1


def test_a_reader_that_ended_is_an_error_of_the_status(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "lost_results", lambda: BrokenPipeError(32, "Broken pipe"))
    monkeypatch.setattr("sys.stdout", io.StringIO())
    stopped: list[bool] = []
    text = LiveText(as_json=True, stop=lambda: stopped.append(True))
    text.open(SinkContext(""))
    text.offer(LiveMessage(pose(), 0.0))
    text.close(5.0)
    assert stopped
    assert text.status().error == "stdout cannot be written (Broken pipe)"
    assert (text.status().sent, text.status().dropped) == (0, 1)
