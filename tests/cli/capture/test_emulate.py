"""`locatk emulate` as a user runs it, its port read by a thread or from another process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from locatk.cli.emulate import SYSTEMS
from locatk.formats.emulation import sources as simulated
from locatk.formats.emulation.byte_stream import LineFaults
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals of Linux")

DATA = np.random.default_rng(0).bytes(5000)
START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A recording of 50 reads in a tenth of a second."""
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="polaris") as writer:
        writer.metadata("capture", {"device": "locatk"})
        for k in range(50):
            chunk = SerialChunk(port="p", byte_offset=100 * k, data=DATA[100 * k : 100 * k + 100])
            writer.write("/serial/bar", chunk, START_NS + 2_000_000 * k)
    return path


@contextmanager
def reader(path: Path) -> Iterator[list[bytes]]:
    """What arrives at the port at ``path``, as soon as it is there and until it goes."""
    pieces: list[bytes] = []
    over = threading.Event()

    def read() -> None:
        while not path.is_char_device():
            if over.wait(0.005):
                return
        port = os.open(path, os.O_RDONLY | os.O_NOCTTY)
        try:
            while piece := os.read(port, 65_536):
                pieces.append(piece)
        except OSError:
            pass
        os.close(port)

    thread = threading.Thread(target=read)
    thread.start()
    try:
        yield pieces
    finally:
        over.set()
        thread.join(10)
        assert not thread.is_alive()


@pytest.mark.slow
def test_the_path_is_all_that_is_printed(locatk: Callable, run: Path, tmp_path: Path) -> None:
    link = tmp_path / "port"
    with reader(link) as got:
        result = locatk("emulate", run, "--link", link)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"{link}\n"
    assert f"locatk, recorded bytes of {run}, " in result.stderr
    assert f"for example: locatk capture {link} --device locatk " in result.stderr
    assert result.stderr.endswith("Sent 5000 of 5000 bytes\n")
    assert b"".join(got) == DATA
    assert not os.path.lexists(link)


@pytest.mark.slow
def test_json_has_the_port_then_the_byte_counts(
    locatk: Callable, run: Path, tmp_path: Path
) -> None:
    link = tmp_path / "port"
    given = ("--drop", 0.05, "--flip", 0.01, "--seed", 3, "--loop", 2, "--rate", 2e5, "-q")
    with reader(link) as got:
        result = locatk("emulate", run, "--link", link, "--json", *given)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    first, last = map(json.loads, result.stdout.splitlines())
    known = {"version": 1, "port": str(link), "device": "locatk"}
    assert first == {**known, "source": str(run), "recorded": True}
    lost = {"unheard": 0, "overrun": 0, "unplugs": 0}
    counted = {name: last.pop(name) for name in ("sent", "dropped", "flipped")}
    assert last == {**known, "made": 10_000, **lost}
    assert counted["sent"] == len(b"".join(got)) == 10_000 - counted["dropped"]
    expected = LineFaults(0.05, 0.01, seed=3)
    assert b"".join(got) == expected.apply(2 * DATA)
    assert counted["dropped"] == expected.dropped > 0
    assert counted["flipped"] == expected.flipped > 0


@pytest.mark.slow
def test_unplugging_is_counted(locatk: Callable, run: Path, tmp_path: Path) -> None:
    link = tmp_path / "port"
    plugs = ("--unplug-every", 0.1, "--away", 0.05)
    with reader(link) as got:
        result = locatk("emulate", run, "--link", link, "--speed", 0.5, *plugs, "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout.splitlines()[-1])
    assert told["unplugs"] == 1
    assert told["sent"] == len(b"".join(got)) > 0
    assert told["unheard"] == 5000 - told["sent"] > 0
    assert "lost while the port was closed, unplugged 1 time\n" in result.stderr


@pytest.mark.slow
def test_as_fast_as_possible(locatk: Callable, run: Path, tmp_path: Path) -> None:
    link = tmp_path / "port"
    with reader(link) as got:
        result = locatk("emulate", run, "--link", link, "--speed", 0, "--loop", 40)
    assert result.exit_code == 0, result.stderr
    assert b"".join(got) == 40 * DATA


def test_without_waiting(locatk: Callable, run: Path) -> None:
    result = locatk("emulate", run, "--no-wait", "--json")
    assert result.exit_code == 0, result.stderr
    first, last = map(json.loads, result.stdout.splitlines())
    assert (last["sent"], last["unheard"]) == (0, 5000)
    assert not Path(first["port"]).parent.exists(), "nothing is left behind"


@pytest.mark.slow
def test_a_system_without_a_recording(
    locatk: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its session is kept on demand, and is the one that is sent."""
    link, save = tmp_path / "port", tmp_path / "truth.mcap"
    given = ("--device", "locatk", "--speed", 0, "--seed", 5)
    with reader(link) as got:
        result = locatk("emulate", "lighthouse", *given, "--link", link, "--save", save)
    assert result.exit_code == 0, result.stderr
    session = Session.open(save)
    assert session.facts["system"] == "lighthouse"
    assert session.attachment("scene.toml")

    refused = locatk("emulate", "lighthouse", *given, "--save", save)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr

    monkeypatch.setattr(simulated, "SYSTEMS", {})
    with reader(link) as again:
        assert locatk("emulate", save, *given, "--link", link).exit_code == 0
    assert b"".join(again) == b"".join(got) != b""


def test_all_systems_are_offered() -> None:
    assert set(SYSTEMS) == {*simulated.SYSTEMS, "dots"}


@pytest.mark.parametrize(
    ("args", "status", "says"),
    [
        (["absent.mcap"], 1, "Error: absent.mcap: no such session. Hint: Give a file, or a sys"),
        (["dots"], 1, "Hint: Record its camera with `locatk capture camera:VIDEO`"),
        (["RUN", "--device", "nonsense"], 1, "Error: no device 'nonsense'. Hint: Known devices"),
        (
            ["RUN", "--device", "lines"],
            1,
            "Error: RUN: no data that a serial device sends. Hint: ",
        ),
        (["RUN", "--link", "RUN"], 1, "Error: RUN: the path of the port is taken. Hint: Cho"),
        (["RUN", "--link", "absent/port"], 1, "absent/port: no folder for the port. Hint: Create"),
        (["EMPTY"], 1, "Error: EMPTY: no bytes to send."),
        (["TEXT"], 1, "Error: TEXT: not an MCAP file"),
        (["RUN", "--drop", "2"], 2, "--drop"),
        (["RUN", "--speed", "-1"], 2, "--speed"),
        (["RUN", "--speed", "2", "--rate", "9"], 2, "--speed or --rate, not both"),
        (["RUN", "--speed", "0", "--no-wait"], 2, "--no-wait"),
        (["RUN", "--away", "2"], 2, "--away needs --unplug-every"),
        (["RUN", "--save", "x.mcap"], 2, "--save applies to a SYSTEM"),
        ([], 2, "SESSION|SYSTEM"),
    ],
)
def test_errors_are_one_line(
    locatk: Callable, run: Path, tmp_path: Path, args: list[str], status: int, says: str
) -> None:
    text, empty = tmp_path / "notes.txt", tmp_path / "empty.mcap"
    text.write_text("no session")
    with SessionWriter(empty, system="polaris") as writer:
        writer.write("/serial/bar", SerialChunk(port="p"), START_NS)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for name, path in (("RUN", run), ("EMPTY", empty), ("TEXT", text)):
        args = [str(path) if arg == name else arg for arg in args]
        says = says.replace(name, str(path))
    result = locatk("emulate", *args)
    assert result.exit_code == status
    assert says in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert result.stdout == ""
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_signals_end_it_cleanly(run: Path, number: signal.Signals) -> None:
    """Also for a device that sends for ever; the totals are told nevertheless."""
    command = [sys.executable, "-m", "locatk.cli", "emulate", str(run), "--json", "--loop", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        port = Path(told["port"])
        descriptor = os.open(port, os.O_RDONLY | os.O_NOCTTY)
        got = os.read(descriptor, 65_536)
        process.send_signal(number)
        while True:
            try:
                piece = os.read(descriptor, 65_536)
            except OSError:
                break
            if not piece:
                break
            got += piece
        os.close(descriptor)
        assert process.wait(timeout=20) == 0
        totals = json.loads(process.stdout.read())
    assert totals["sent"] == len(got) > 0
    assert not port.parent.exists()
    assert got == (DATA * (1 + len(got) // len(DATA)))[: len(got)]


@pytest.mark.slow
def test_a_killed_one_can_be_followed_at_the_same_path(
    locatk: Callable, run: Path, tmp_path: Path
) -> None:
    link = tmp_path / "port"
    command = [sys.executable, "-m", "locatk.cli", "emulate", str(run), "--link", str(link)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert locatk("emulate", run, "--link", link).exit_code == 1, "it is in use"
        process.kill()
        process.wait(timeout=20)
    assert link.is_symlink()
    for _ in range(100):  # until the kernel has taken the terminal away
        if not link.exists():
            break
        time.sleep(0.05)
    with reader(link) as got:
        assert locatk("emulate", run, "--link", link).exit_code == 0
    assert b"".join(got) == DATA
