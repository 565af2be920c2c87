"""A device for the benches of capture: frames over a real pseudo-terminal, from a process of
its own, with what was sent when."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from locatk.formats.benchmarks.timing import SEED
from locatk.formats.devices.locatk_frames.payloads import FrameWriter, Type, series

SEQUENCES = 1 << 16
"""A round of sequence numbers: a block of so many frames can be sent again and again."""

SENSORS = 11
"""Hall sensors a frame, for 64 bytes on the wire."""

EVERY_S = 0.002


def block(count: int = SEQUENCES) -> bytes:
    """Frames of 64 bytes of the locatk protocol, with random fields."""
    rng = np.random.default_rng(SEED)
    fields = rng.normal(0, 500, (count, 1, SENSORS)).astype("<f4")
    writer = FrameWriter()
    return b"".join(
        writer.frame(Type.HALLS, 20 * number, series(fields[number], 0)) for number in range(count)
    )


def send(descriptor: int, path: str, rate: float, seconds: float, log: str) -> None:
    """Write the file ``path`` again and again to an open pseudo-terminal, at ``rate`` bytes a
    second; ``log`` takes pairs of float64: a time, and how many bytes were written by then.

    The body of :func:`sender`'s process.
    """
    data = memoryview(Path(path).read_bytes())
    start = time.monotonic()
    sent = 0
    with open(log, "wb", buffering=0) as stream:
        while (elapsed := time.monotonic() - start) < seconds:
            due = int(rate * elapsed)
            while sent < due:
                place = sent % len(data)
                sent += os.write(descriptor, data[place : place + due - sent])
            stream.write(np.array([time.time(), sent]).tobytes())
            time.sleep(EVERY_S)


@dataclass(frozen=True)
class Line:
    """A pseudo-terminal on which a process sends."""

    port: str
    data: bytes
    log: Path
    process: subprocess.Popen[bytes]

    def sent(self) -> np.ndarray:
        """(n, 2): times since the epoch in s, and bytes written by then."""
        raw = self.log.read_bytes()
        return np.frombuffer(raw[: len(raw) // 16 * 16]).reshape(-1, 2)


@contextmanager
def sender(rate: float, seconds: float, data: bytes) -> Iterator[Line]:
    """A process that sends ``data``, again and again, once the port is read."""
    master, slave = os.openpty()
    tty.setraw(slave, termios.TCSANOW)
    port = os.ttyname(slave)
    with tempfile.TemporaryDirectory() as folder:
        path, log = Path(folder, "data"), Path(folder, "log")
        path.write_bytes(data)
        log.touch()
        code = (
            "from locatk.formats.benchmarks.capture.serial_line import send; "
            f"send({master}, {str(path)!r}, {rate}, {seconds}, {str(log)!r})"
        )
        process = subprocess.Popen([sys.executable, "-c", code], pass_fds=[master])
        try:
            yield Line(port, data, log, process)
        finally:
            process.kill()
            process.wait()
            os.close(master)
            os.close(slave)


def capture(port: str, output: Path, *more: str) -> subprocess.Popen[str]:
    """``locatk capture`` of the locatk protocol in a process of its own."""
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "locatk.cli", "capture", port),
            *("--device", "locatk", "-o", str(output), "--json", *more),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
