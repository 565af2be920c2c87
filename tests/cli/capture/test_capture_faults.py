"""`locatk capture` of serial lines, with all that happens in a lab: it is killed, interrupted,
unplugged, the disk fills, somebody else wants the port."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from locatk.core.errors import FormatError
from locatk.core.solution import Solution
from locatk.formats.artifacts.scene import dumps_scene
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import field_samples, observations
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals of Linux")

LOST_S = 0.5
"""What may be lost when it is killed: the promise."""

STAMP = struct.Struct("<2sIq10s")
"""A block that says when it was sent: a mark, its number, the time in ns, and noise."""

MARK = b"\xa5\x5a"


@contextlib.contextmanager
def sending(line: Any, bytes_per_s: float) -> Iterator[bytearray]:
    """Blocks with the times of their sending, until the end of the block; what was sent."""
    sent = bytearray()
    over = threading.Event()

    def send() -> None:
        begun = time.monotonic()
        number = 0
        while not over.is_set():
            due = int((time.monotonic() - begun) * bytes_per_s) // STAMP.size
            noise = os.urandom(10 * max(0, due - number))
            blocks = b"".join(
                STAMP.pack(MARK, number + k, time.monotonic_ns(), noise[10 * k : 10 * k + 10])
                for k in range(due - number)
            )
            number = max(number, due)
            sent.extend(blocks[: line.send(blocks, over)])
            over.wait(0.002)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield sent
    finally:
        over.set()
        thread.join()


def last_stamp_ns(content: bytes) -> int:
    """When the last whole block was sent."""
    whole = len(content) // STAMP.size * STAMP.size
    mark, number, time_ns, _ = STAMP.unpack(content[whole - STAMP.size : whole])
    assert (mark, number) == (MARK, whole // STAMP.size - 1)
    return int(time_ns)


def log(path: Path) -> list[str]:
    return [text.message for _, text in Session.open(path).decoded("/log", Log)]


def facts(path: Path) -> dict[str, str]:
    return Session.open(path).metadata()["capture"]


# ---- every byte


@pytest.mark.slow
def test_megabytes_a_second(line: Any, process: Any, tmp_path: Path, raw_bytes: Any) -> None:
    port, path = line(), tmp_path / "run.mcap"
    capture = process("capture", port.path, "--device", "raw", "-o", path, "--json")
    capture.until("Recording")
    with sending(port, 3e6) as sent:
        capture.until("\n0:01  ")
    assert capture.stop() == 0
    kept = raw_bytes(path)
    assert len(kept) > 1_500_000
    assert kept == bytes(sent)
    report = json.loads(capture.stdout)
    assert report["bytes"] == len(sent)
    assert report["gaps"] == report["overruns"] == 0
    assert report["outputs"] == [str(path)]
    assert report["file_bytes"] == path.stat().st_size


# ---- killed


@pytest.mark.slow
def test_killed_it_loses_half_a_second(
    line: Any, process: Any, tmp_path: Path, raw_bytes: Any, locatk: Any
) -> None:
    """At random instants; the first at once, when nothing was flushed yet."""
    delays = [0.0, *np.random.default_rng().uniform([0.05, 0.5], [0.5, 0.9])]
    ports = [line(f"port{number}") for number in range(len(delays))]
    paths = [tmp_path / f"run{number}.mcap" for number in range(len(delays))]
    captures = [
        process("capture", port.path, "--device", "raw", "-o", path)
        for port, path in zip(ports, paths, strict=True)
    ]
    for number, delay in enumerate(delays):
        port, path, capture = ports[number], paths[number], captures[number]
        capture.until("Recording")
        with sending(port, 200e3):
            begun_ns = time.monotonic_ns()
            time.sleep(delay)
            capture.signal(signal.SIGKILL)
            killed_ns = time.monotonic_ns()
            capture.end()
        promised = killed_ns - begun_ns > LOST_S * 1e9
        if not promised and not (path.exists() and path.stat().st_size):
            continue
        try:
            kept = raw_bytes(path)
        except FormatError:  # Killed while the beginning of the file was written.
            assert not promised
            kept = None
        if promised or kept:
            assert killed_ns - last_stamp_ns(kept) <= LOST_S * 1e9, f"killed after {delay} s"
        saved = tmp_path / f"saved{number}.mcap"
        recovered = locatk("recover", path, "-o", saved)
        if kept:
            assert recovered.exit_code == 3, recovered.stderr  # the end of the file is missing
            assert raw_bytes(saved) == kept
            assert Session.open(saved).damage is None
        else:
            assert recovered.exit_code in (0, 1, 3)
            assert "Traceback" not in recovered.stderr


# ---- asked to end


@pytest.mark.slow
def test_termination_finishes_the_file(
    line: Any, process: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    port, path = line(), tmp_path / "run.mcap"
    capture = process("capture", port.path, "--device", "raw", "-o", path)
    capture.until("Recording")
    with sending(port, 50e3) as sent:
        time.sleep(0.3)
        capture.signal(signal.SIGTERM)
        assert capture.end() == 0
    assert Session.open(path).damage is None
    kept = raw_bytes(path)
    assert bytes(sent).startswith(kept)
    assert len(kept) > 5_000
    assert facts(path)["ended"] == "stopped"
    assert "stopped" in capture.stdout
    assert "Traceback" not in capture.stderr


SLOW_END = """
import time
from locatk.formats.capture import recording_files as live_file
real = live_file.LiveFile.write
def write(self, data):
    time.sleep(0.02)
    return real(self, data)
live_file.LiveFile.write = write
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_doubled_signals(
    line: Any, process: Any, tmp_path: Path, raw_bytes: Any, number: signal.Signals
) -> None:
    """A terminal that is closed hangs up twice, and some wrappers pass on a Ctrl-C that all had
    got already. They come while the file is finished."""
    port, path = line(), tmp_path / "run.mcap"
    given = ("--device", "raw", "-o", path)
    capture = process("capture", port.path, *given, first=SLOW_END)
    capture.until("Recording")
    with sending(port, 100e3) as sent:
        time.sleep(0.3)
        for _ in range(4):
            capture.signal(number)
            time.sleep(0.02)
        assert capture.end() == 0
    assert Session.open(path).damage is None
    assert bytes(sent).startswith(raw_bytes(path))
    assert facts(path)["ended"] == "stopped"
    assert "stopped" in capture.stdout
    assert "Traceback" not in capture.stderr


HANG = """
import sys, time
from locatk.formats.capture import links, reader_thread
reader_thread.MAX_STOP_WAIT_S = 15.0
real = links.DescriptorLink.read
def read(self, wait_s):
    data = real(self, wait_s)
    if b"hang" in data:
        print("it hangs", file=sys.stderr, flush=True)
        time.sleep(60)
    return data
links.DescriptorLink.read = read
"""


@pytest.mark.slow
def test_a_second_interrupt_does_not_wait_for_a_driver_that_hangs(
    line: Any, process: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    """The first one waits for it for a while, see test_recorder.py."""
    port, path = line(), tmp_path / "run.mcap"
    capture = process(
        "capture",
        port.path,
        "--device",
        "raw",
        "-o",
        path,
        first=HANG,
    )
    capture.until("Recording")
    port.send(b"kept")
    time.sleep(0.1)
    port.send(b"hang")
    capture.until("it hangs")
    capture.signal(signal.SIGINT)
    time.sleep(1.1)  # one that comes sooner is taken for the same
    capture.signal(signal.SIGINT)
    assert capture.end(20) == 130
    assert Session.open(path).damage is None
    assert raw_bytes(path) == b"kept"
    assert "Traceback" not in capture.stderr


@pytest.mark.slow
def test_whoever_listens_to_the_talk_may_go(line: Any, tmp_path: Path, raw_bytes: Any) -> None:
    """`locatk capture ... 2>&1 | head -1` records on."""
    port, path = line(), tmp_path / "run.mcap"
    command = [sys.executable, "-m", "locatk.cli", "capture", str(port.path), "-o", str(path)]
    with subprocess.Popen([*command, "--device", "raw"], stderr=subprocess.PIPE) as child:
        assert child.stderr is not None
        assert b"Recording" in child.stderr.readline()
        child.stderr.close()
        with sending(port, 50e3) as sent:
            time.sleep(1.3)  # longer than from line to line
        child.send_signal(signal.SIGINT)
        child.wait(30)
    assert raw_bytes(path) == bytes(sent)
    assert Session.open(path).damage is None


# ---- unplugged


@pytest.mark.slow
def test_unplugged_and_plugged_in_again(
    line: Any, process: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    port, path = line(), tmp_path / "run.mcap"
    capture = process("capture", port.path, "--device", "lines", "-o", path, "--json")
    capture.until("Recording")
    port.send(b"a,b\n1,2\n3,4\n5,")
    time.sleep(0.2)
    port.unplug()
    capture.until("connection lost")
    other, _ = os.openpty()  # so that it comes back as another terminal
    port.plug()
    capture.until("reconnected")
    port.send(b"6\na,b\n7,8\n9,10\n")
    time.sleep(0.2)
    assert capture.stop() == 3
    os.close(other)
    assert "Incomplete: connection lost once" in capture.stderr
    assert raw_bytes(path) == b"a,b\n1,2\n3,4\n5,6\na,b\n7,8\n9,10\n"
    chunks = [chunk for _, chunk in Session.open(path).decoded("/serial/robot", SerialChunk)]
    assert sum(chunk.opened for chunk in chunks) == 2
    assert chunks[0].opened
    report = json.loads(capture.stdout)
    assert report["gaps"] == 1
    assert 0 < report["gap_s"] < 20
    assert report["samples"]["/readings/robot"] == 4  # none of "5," and "6"
    lines = log(path)
    assert lines[0].startswith("connection lost: ")
    assert lines[1].startswith("reconnected to ")
    assert facts(path)["gaps"] == "1"
    assert f"Warning: {lines[0]}" in capture.stderr


@pytest.mark.slow
def test_it_does_not_come_back(line: Any, process: Any, tmp_path: Path, raw_bytes: Any) -> None:
    port, path = line(), tmp_path / "run.mcap"
    capture = process("capture", port.path, "--device", "raw", "-o", path, "--silence", "100ms")
    capture.until("Recording")
    port.send(b"all there is")
    time.sleep(0.2)
    port.unplug()
    capture.until("connection lost")
    assert capture.stop() == 3
    assert raw_bytes(path) == b"all there is"
    assert "connection lost once" in capture.stderr
    assert "Traceback" not in capture.stderr


TELL_TRIES = """
import sys
from locatk.formats.capture import ports
real = ports.SerialPort.open
def open(self):
    try:
        return real(self)
    except Exception:
        print("tried", file=sys.stderr, flush=True)
        raise
ports.SerialPort.open = open
"""


@pytest.mark.slow
def test_a_port_that_is_not_there_yet_can_be_waited_for(
    line: Any, process: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    port, path = line(), tmp_path / "run.mcap"
    port.unplug()
    given = ("--device", "raw", "-o", path, "--wait", "1min")
    capture = process("capture", port.path, *given, first=TELL_TRIES)
    capture.until("tried")
    port.plug()
    capture.until("Recording")
    port.send(b"at last")
    time.sleep(0.2)
    assert capture.stop() == 0
    assert raw_bytes(path) == b"at last"


# ---- one port, one owner


@pytest.mark.slow
def test_the_user_of_the_port_is_named(line: Any, process: Any, tmp_path: Path) -> None:
    port = line()
    capture = process("capture", port.path, "--device", "raw", "-o", tmp_path / "run.mcap")
    capture.until("Recording")
    port.send(b"x")
    second = process("capture", port.path, "--device", "raw", "-o", tmp_path / "no.mcap")
    assert second.end() == 1
    assert str(capture.child.pid) in second.stderr
    assert len(second.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "no.mcap").exists()
    assert capture.stop() == 0


# ---- the disk


@pytest.mark.slow
def test_a_disk_that_fills(line: Any, process: Any, small_disk: Path, raw_bytes: Any) -> None:
    port, path = line(), small_disk / "run.mcap"
    given = ("--device", "raw", "-o", path, "--reserve", "2MB", "--json")
    capture = process("capture", port.path, *given)
    capture.until("Recording")
    with sending(port, 2.4e6) as sent:
        assert capture.end() == 3
    assert "the disk will be full in" in capture.stderr
    assert "Incomplete: the disk is full up to --reserve" in capture.stderr
    assert Session.open(path).damage is None
    kept = raw_bytes(path)
    assert bytes(sent).startswith(kept)
    assert json.loads(capture.stdout)["bytes"] == len(kept)


# ---- the way of a real recording


SYSTEMS = {
    "polaris": ("polaris-array", ("--id", "262143", "--speed", "0.3")),
    "landmarks": ("locatk", ("--strategy", "pass", "--cell", "2,2")),
    "lighthouse": ("lighthouse-deck", ("--duration", "5")),
}
"""Device, and what makes a simulated session of some seconds."""


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory, processes: Callable[..., Any]) -> Path:
    """A folder of ``SYSTEM.mcap``, simulated, and ``SYSTEM-captured.mcap``, what was recorded
    of a device that sent it at its own pace; all at once, as they take their time."""
    from click.testing import CliRunner

    from locatk.cli.app import app

    folder = tmp_path_factory.mktemp("way")

    def run(*arguments: object) -> None:
        done = CliRunner().invoke(app, [str(each) for each in arguments])
        assert done.exit_code == 0, done.stderr

    run("map", "design", "5x5", "--alphabet", 6, "-o", folder / "map.toml")
    recorded: list[tuple[Any, Any]] = []
    for system, (device, given) in SYSTEMS.items():
        path, link = folder / f"{system}.mcap", folder / f"{system}.port"
        floor = [folder / "map.toml"] if system == "landmarks" else []
        run("simulate", system, *floor, "-o", path, *given)
        output = folder / f"{system}-captured.mcap"
        known = ("--artifact", path, "--name", "robot-1", "-o", output, "--wait", "30s")
        capture = processes("capture", link, "--device", device, *known)
        recorded.append((processes("emulate", path, "--device", device, "--link", link), capture))
    for emulator, capture in recorded:
        assert emulator.end() == 0, emulator.stderr
        capture.until("connection lost")  # the device is gone
        assert capture.stop() == 3
    return folder


def solved(locatk: Any, path: Path, *given: object) -> tuple[dict[str, Any], Solution]:
    """What `locatk solve --json` says of a session, and the solution."""
    output = path.with_name(f"solved-{path.name}")
    result = locatk("solve", path, "-o", output, "--overwrite", "--json", *given)
    assert result.exit_code in (0, 3), result.stderr
    return json.loads(result.stdout)["sessions"][0], read_solution(output)


@pytest.mark.slow
def test_captured_tags_are_detected(captured: Path, locatk: Any) -> None:
    want, _ = solved(locatk, captured / "polaris.mcap")
    got, _ = solved(locatk, captured / "polaris-captured.mcap")
    assert (got["system"], got["poses"]) == ("polaris", want["poses"])
    assert want["poses"] > 20
    ((expected,), (found,)) = (want["detections"], got["detections"])
    assert found["tag_id"] == expected["tag_id"] == 262143
    assert found["device"] == "robot-1"
    # Arrival is late by as much as the machine is busy; the car does 0.3 m/s.
    assert found["x_m"] == pytest.approx(expected["x_m"], abs=2e-3)
    assert found["y_m"] == pytest.approx(expected["y_m"], abs=1e-3)
    assert found["heading_rad"] == pytest.approx(expected["heading_rad"], abs=0.02)


@pytest.mark.slow
def test_captured_landmarks_are_detected(captured: Path, locatk: Any) -> None:
    want, _ = solved(locatk, captured / "landmarks.mcap")
    got, _ = solved(locatk, captured / "landmarks-captured.mcap")
    ((expected,), (found,)) = (want["detections"], got["detections"])
    for key in ("pattern", "code"):
        assert found[key] == expected[key]
    for key in ("x_m", "y_m"):
        assert found[key] == pytest.approx(expected[key], abs=5e-4)
    assert found["heading_rad"] == pytest.approx(expected["heading_rad"], abs=5e-3)
    first = field_samples.read_halls(Session.open(captured / "landmarks.mcap"))[0]
    second = field_samples.read_halls(Session.open(captured / "landmarks-captured.mcap"))[0]
    np.testing.assert_allclose(second.field_t, first.field_t, atol=1e-6)
    # Times go on as the device's do, but for what a busy machine is late.
    offset = (second.time_ns - first.time_ns) - (second.time_ns - first.time_ns)[0]
    assert np.ptp(offset[len(offset) // 4 :]) < 0.1e9


@pytest.mark.slow
def test_a_captured_lighthouse_session_is_solved(captured: Path, locatk: Any) -> None:
    _, reference = solved(locatk, captured / "lighthouse.mcap")
    scene = captured / "scene.toml"
    scene.write_text(dumps_scene(reference.artifact))
    want, expected = solved(locatk, captured / "lighthouse.mcap", "--artifact", scene)
    got, found = solved(locatk, captured / "lighthouse-captured.mcap", "--artifact", scene)
    assert got["poses"] == pytest.approx(want["poses"], abs=3)
    assert want["poses"] > 20
    ((one,), (other,)) = (expected.trajectories, found.trajectories)
    assert other.device == "robot-1"
    first, second = one.time_ns - one.time_ns[0], other.time_ns - one.time_ns[0]
    sweeps = [
        observations.read_sweeps(Session.open(captured / name)).time_ns[0]
        for name in ("lighthouse.mcap", "lighthouse-captured.mcap")
    ]
    second = second - (sweeps[1] - sweeps[0])
    places = np.column_stack([np.interp(second, first, one.position[:, axis]) for axis in range(2)])
    within = (second >= first[0]) & (second <= first[-1])
    assert within.sum() > 15
    # Their clocks differ by some ms, in which the robot goes on.
    assert np.abs(other.position[within, :2] - places[within]).max() < 0.02


@pytest.mark.slow
def test_a_captured_session_can_be_emulated(
    captured: Path, process: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    """The bytes of a recording through another port give the same bytes and records."""
    first = captured / "lighthouse-captured.mcap"
    link, path = tmp_path / "again.port", tmp_path / "again.mcap"
    emulator = process("emulate", first, "--link", link, "--speed", 0)
    capture = process(
        "capture", link, "--device", "lighthouse-deck", "-o", path, "--wait", "30s", "--json"
    )
    assert emulator.end() == 0
    capture.until("connection lost")
    capture.stop()
    assert raw_bytes(path) == raw_bytes(first, topic="/serial/robot-1")
    counts = json.loads(capture.stdout)["samples"]
    (channel,) = (c for c in Session.open(first).channels if c.topic.startswith("/lighthouse/"))
    sweeps = observations.read_sweeps(Session.open(first))
    assert channel.count
    assert counts == {"/lighthouse/robot": len(sweeps.time_ns)}
