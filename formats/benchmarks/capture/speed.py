"""How fast bytes become records, and a large recording tells what is in it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.capture.serial_line import SEQUENCES, block
from locatk.formats.benchmarks.timing import SEED, cpu_seconds
from locatk.formats.devices import DEVICES
from locatk.formats.devices.decoder import Options, Recording
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.writer import SessionWriter

PIECE = 65_536
"""Bytes a feed: 20 ms of 3 MB/s."""

COBS = "prototype, cobs (C), zlib"

LEAST = 2_000_000
"""Bytes of which the decoding is timed, at least."""

LARGE = 10**9
CHUNKS_S = 5
"""Chunks a second of a live recording."""


def speed_figures() -> list[Figure]:
    """Decoding of each device, in pieces as they come from a port."""
    frames = block()
    seconds = cpu_seconds(lambda: _decode("locatk", frames), 3)
    rows = [
        Figure(
            "locatk frames of 64 bytes",
            SEQUENCES / seconds / 1e6,
            "M/s",
            "decoded to arrays, CRC checked, pieces of 64 kB, one core",
            None,
            "higher",
            peer=COBS,
            peer_value=1.3,
        )
    ]
    for name, recording in (
        ("polaris-array", Recording(samples=[_samples(9)])),
        ("magx-array", Recording(samples=[_samples(8)])),
        ("lighthouse-deck", Recording(sweeps=_sweeps())),
        ("dotbot-gateway", Recording(sweeps=_sweeps())),
        ("lines", Recording(samples=[_samples(9)])),
    ):
        data = b"".join(piece for _, piece in DEVICES[name].encode(recording))
        data *= LEAST // len(data) + 1
        seconds = cpu_seconds(_decoding(name, data), 3)
        rows.append(
            Figure(
                f"{name} decoded",
                len(data) / seconds / 1e6,
                "MB/s",
                f"{len(data) / 1e6:.1f} MB in pieces of 64 kB, one core",
            )
        )
    return rows


def _decoding(name: str, data: bytes) -> Callable[[], None]:
    return lambda: _decode(name, data)


def _decode(name: str, data: bytes) -> None:
    decoder = DEVICES[name].create_decoder(Options())
    for start in range(0, len(data), PIECE):
        decoder.feed(data[start : start + PIECE])
    decoder.finish()


def _samples(sensors: int, count: int = 20_000) -> Samples:
    rng = np.random.default_rng(SEED)
    level = rng.normal(0, 40e-6, (sensors, 3))
    field = level + rng.normal(0, 1e-6, (count, sensors, 3))
    times = 10**18 + 16_000_000 * np.arange(count)
    return Samples("robot", SensorArray(bar(sensors, 0.02)), times, field)


def _sweeps() -> Sweeps:
    return simulate(SimulationOptions(robots=1, stations=2, duration_s=60.0, seed=SEED)).sweeps


def info_figure(size: int = LARGE) -> Figure:
    """``locatk info`` of a large recording, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "large.mcap")
        _large(path, size)
        size = path.stat().st_size
        best = min(_info(path) for _ in range(3))
    how = (
        f"{size / 1e9:.2f} GB of raw bytes in {size // _PER_CHUNK} chunks, start of Python included"
    )
    return Figure("locatk info on 1 GB", best, "s", how, 1.0)


_PER_CHUNK = 60_000


def _large(path: Path, size: int) -> None:
    noise = np.random.default_rng(SEED).bytes(_PER_CHUNK + 4096)
    step_ns = 10**9 // CHUNKS_S
    with open(path, "wb") as stream, SessionWriter(path, system="", live=stream) as writer:
        for number in range(size // _PER_CHUNK):
            place = number % 4096
            data = noise[place : place + _PER_CHUNK]
            chunk = SerialChunk(port="bench", byte_offset=number * _PER_CHUNK, data=data)
            writer.write("/serial/robot", chunk, 10**18 + step_ns * number)
            writer.flush()


def _info(path: Path) -> float:
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "locatk.cli", "info", str(path)], check=True, capture_output=True
    )
    return time.perf_counter() - start
