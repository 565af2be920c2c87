"""`locatk live` as a process of its own, at pseudo-terminals that `locatk emulate` feeds."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_live

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals of Linux"),
]

TIMEOUT_S = 20.0


class Receiver:
    """UDP socket for the messages of a session."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.address = f"udp://127.0.0.1:{self.socket.getsockname()[1]}"
        self.messages: list[dict[str, Any]] = []

    def until(self, condition: Callable[[dict[str, Any]], bool]) -> None:
        """Receive until a message satisfies a condition."""
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            if select.select([self.socket], [], [], 0.5)[0]:
                self.messages.append(json.loads(self.socket.recv(65_536)))
                if condition(self.messages[-1]):
                    return
        raise AssertionError([each["type"] for each in self.messages])


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.socket.close()


@pytest.fixture
def robot(process: Any, live_sessions: Any, tmp_path: Path) -> Callable[..., Path]:
    """``robot("--unplug-every", 1)`` emulates an array of magnetometers; return its port."""

    def begin(*options: object) -> Path:
        link = tmp_path / "robot"
        run = live_sessions.raw("polaris")
        process("emulate", run, "--link", link, "--loop", 0, *options)
        end = time.monotonic() + TIMEOUT_S
        while not link.exists():
            assert time.monotonic() < end
            time.sleep(0.01)
        return link

    return begin


def is_pose(message: dict[str, Any]) -> bool:
    return bool(message["type"] == "pose")


def answer_of(url: str) -> str:
    """Return the body of an answer; its status says whether a busy machine keeps up."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(url, timeout=10) as answer:
            return str(answer.read().decode())
    except urllib.error.HTTPError as error:
        return error.read().decode()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_a_finished_recording(
    robot: Any, process: Any, receiver: Receiver, live_sessions: Any, tmp_path: Path, number: Any
) -> None:
    """Poses arrive at a socket before. A server for other computers prints its token once."""
    pytest.importorskip("websockets")
    path, token = tmp_path / "run.mcap", tmp_path / "token"
    token.write_text("s3cret-token\n")
    live = process(
        "live", robot(), "--device", "locatk", "--artifact", live_sessions.decoded("polaris"),
        "--to", receiver.address, "--record", path, "--to", "web://0.0.0.0:0",
        "--token-file", token,
    )  # fmt: skip
    receiver.until(is_pose)
    server = re.search(r"Sending to (http\S+:)(\d+)(/\S*s3cret-token)", live.stderr)
    assert server, live.stderr
    url = f"http://127.0.0.1:{server[2]}/health?token=s3cret-token"
    health = answer_of(url)
    assert json.loads(health)["inputs"][0]["recording"]["running"]
    assert json.loads(health)["devices"]["robot"]["poses"] > 0
    assert "s3cret" not in health
    live.signal(number)
    assert live.end() == 0, live.stderr
    session = Session.open(path)
    assert session.damage is None
    (track,) = read_live(session)
    printed = [json.loads(line) for line in live.stdout.splitlines()]
    assert len(track) == sum(map(is_pose, printed))


def test_it_survives_unplugging(
    robot: Any, process: Any, receiver: Receiver, live_sessions: Any
) -> None:
    live = process(
        "live", robot("--unplug-every", 4, "--away", 0.3), "--device", "locatk",
        "--artifact", live_sessions.decoded("polaris"), "--to", receiver.address,
    )  # fmt: skip
    receiver.until(is_pose)
    receiver.until(lambda each: "connection lost" in each.get("message", ""))
    receiver.until(lambda each: "reconnected" in each.get("message", ""))
    receiver.until(is_pose)
    assert live.stop() == 0, live.stderr
    assert "connection lost" in live.stderr


def test_a_signal_ends_waiting_for_a_port(process: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    live = process("live", tmp_path / "absent", "--wait", "1min", "--record", path)
    live.until("Waiting:")
    live.signal(signal.SIGTERM)
    assert live.end() == 1
    assert live.stderr.splitlines()[-1].startswith("Error:")
    assert "Traceback" not in live.stderr
    assert not path.exists()


def test_a_program_that_does_not_read_stdout_hinders_nothing(
    robot: Any, receiver: Receiver, live_sessions: Any, tmp_path: Path
) -> None:
    """Its pipe is full at once; poses arrive elsewhere, and SIGTERM ends the session."""
    path = tmp_path / "run.mcap"
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    while True:
        try:
            os.write(writing, b"\n" * 4096)
        except BlockingIOError:
            break
    os.set_blocking(writing, True)
    arguments = [
        "live", str(robot()), "--device", "locatk", "--artifact",
        str(live_sessions.decoded("polaris")), "--to", receiver.address, "--record", str(path),
    ]  # fmt: skip
    live = subprocess.Popen([sys.executable, "-m", "locatk.cli", *arguments], stdout=writing)
    os.close(writing)
    try:
        receiver.until(is_pose)
        live.terminate()
        assert live.wait(TIMEOUT_S) in (0, 1)
    finally:
        live.kill()
        live.wait()
        os.close(reading)
    session = Session.open(path)
    assert session.damage is None
    assert read_live(session)
