"""Figures of ``locatk bench capture``: losses of a recording, recovery of damaged files, speed.

A process of its own writes frames to a real pseudo-terminal, and ``locatk capture`` reads them.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from locatk.core.errors import LocatkError
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import FIRST_SEED, machine_factor, time_call, time_command
from locatk.formats.devices import DEVICES
from locatk.formats.devices.interface import Options, Recording
from locatk.formats.devices.locatk_frames.payloads import FrameWriter, Type, series
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import mcap_file
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.recovery.recover import recover
from locatk.formats.sessions.writer import SessionWriter

SOAK_BYTES_PER_S = 3e6
SOAK_S = 60.0
KILLED_RECORDINGS = 50
KILLED_BYTES_PER_S = 200e3
DAMAGED_FILES = 400

SYNC_BYTES = 4096
"""First bytes of a recording, by which its start is located in the data that were sent."""

TOPIC = "/serial/robot"
PROTOTYPE = "prototype, one message a frame"

BLOCK_FRAMES = 1 << 16
"""Frames of all sequence numbers: a block that can be sent repeatedly."""

FRAME_SENSORS = 11
"""Hall sensors a frame, which give 64 bytes on the wire."""

SEND_INTERVAL_S = 0.002

FEED_BYTES = 65_536
"""Bytes decoded at once: 20 ms of 3 MB/s."""

MIN_DECODED_BYTES = 2_000_000
"""Smallest amount of data whose decoding is timed."""

LARGE_BYTES = 10**9
LARGE_CHUNK_BYTES = 60_000
LARGE_CHUNKS_PER_S = 5
"""Recording that ``locatk info`` opens: size, and size and rate of its chunks."""


def figures(data: Path) -> list[Figure]:
    """Return all figures; none needs published data. About four minutes, on a quiet machine."""
    live = [*soak_figures(), *kill_figures()] if hasattr(os, "openpty") else []
    return [*live, *damage_figures(), *speed_figures(), info_figure()]


# ---- a device that sends frames over a pseudo-terminal


def frame_block(count: int = BLOCK_FRAMES) -> bytes:
    """Return frames of 64 bytes of the locatk protocol, with random fields."""
    rng = np.random.default_rng(FIRST_SEED)
    fields = rng.normal(0, 500, (count, 1, FRAME_SENSORS)).astype("<f4")
    writer = FrameWriter()
    return b"".join(
        writer.frame(Type.HALLS, 20 * number, series(fields[number], 0)) for number in range(count)
    )


def send(descriptor: int, path: str, bytes_per_s: float, duration_s: float, log: str) -> None:
    """Write the file ``path`` repeatedly to an open pseudo-terminal.

    ``log`` receives pairs of float64: a time, and the number of bytes written until then. Runs in
    the process of :func:`sender`.
    """
    data = memoryview(Path(path).read_bytes())
    start = time.monotonic()
    sent = 0
    with open(log, "wb", buffering=0) as stream:
        while (elapsed := time.monotonic() - start) < duration_s:
            due = int(bytes_per_s * elapsed)
            while sent < due:
                offset = sent % len(data)
                sent += os.write(descriptor, data[offset : offset + due - sent])
            stream.write(np.array([time.time(), sent]).tobytes())
            time.sleep(SEND_INTERVAL_S)


@dataclass(frozen=True)
class SerialLine:
    """Pseudo-terminal on which a process sends."""

    port: str
    log: Path

    def sent_bytes(self) -> np.ndarray:
        """Return times since the epoch [s] and bytes written until then, (n, 2)."""
        raw = self.log.read_bytes()
        return np.frombuffer(raw[: len(raw) // 16 * 16]).reshape(-1, 2)


@contextmanager
def sender(bytes_per_s: float, duration_s: float, data: bytes) -> Iterator[SerialLine]:
    """Start a process that sends ``data`` repeatedly as soon as the port is read."""
    import termios  # not on Windows
    import tty

    master, slave = os.openpty()
    tty.setraw(slave, termios.TCSANOW)
    port = os.ttyname(slave)
    with tempfile.TemporaryDirectory() as folder:
        path, log = Path(folder, "data"), Path(folder, "log")
        path.write_bytes(data)
        log.touch()
        code = (
            "from locatk.formats.benchmarks.capture import send; "
            f"send({master}, {str(path)!r}, {bytes_per_s}, {duration_s}, {str(log)!r})"
        )
        process = subprocess.Popen([sys.executable, "-c", code], pass_fds=[master])
        try:
            yield SerialLine(port, log)
        finally:
            process.kill()
            process.wait()
            os.close(master)
            os.close(slave)


def start_capture(port: str, output: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start ``locatk capture`` of the locatk protocol."""
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "locatk.cli", "capture", port),
            *("--device", "locatk", "-o", str(output), "--json", *arguments),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


# ---- losses


def recorded_bytes(path: Path, *, damaged_ok: bool = False) -> bytes:
    """Return all raw bytes of a session.

    Raises
    ------
    LocatkError
        The bytes are not contiguous.
    """
    session = Session.open(path, damaged_ok=damaged_ok)
    pieces: list[bytes] = []
    offset = 0
    for _, chunk in session.decoded(TOPIC, SerialChunk):
        if chunk.byte_offset != offset:
            raise LocatkError(f"byte {chunk.byte_offset} after byte {offset}", file=path)
        pieces.append(chunk.data)
        offset += len(chunk.data)
    return b"".join(pieces)


def soak_figures(duration_s: float = SOAK_S) -> list[Figure]:
    """Record frames at 3 MB/s for a minute."""
    data = frame_block()
    how = f"{duration_s:.0f} s of 64-byte frames at 3 MB/s over a pseudo-terminal, decoded live"
    with (
        tempfile.TemporaryDirectory() as folder,
        sender(SOAK_BYTES_PER_S, duration_s, data) as line,
    ):
        output = Path(folder, "soak.mcap")
        recording = start_capture(line.port, output, "--duration", f"{duration_s + 3:g}")
        assert recording.stdout is not None
        report = json.loads(recording.stdout.read())
        _, status, used = os.wait4(recording.pid, 0)
        recording.returncode = os.waitstatus_to_exitcode(status)
        sent = int(line.sent_bytes()[-1, 1])
        repetitions = sent // len(data) + 1
        wrong = count_wrong_bytes(recorded_bytes(output), (data * repetitions)[:sent])
    return [
        Figure("soak: bytes lost or wrong", wrong, "", f"{how}; {sent / 1e6:.0f} MB", 0.0),
        Figure("soak: bad or missing frames", report["bad"] + report["lost"], "", how, 0.0),
        Figure("soak: one core", 100 * (used.ru_utime + used.ru_stime) / duration_s, "%",
               f"{how}; processor time of the process, start-up included", 60.0, peer=PROTOTYPE,
               peer_value=51.0, workload="Python", machine_factor=machine_factor("Python")),
        Figure("soak: rate kept", sent / duration_s / 1e6, "MB/s", how,
               0.99 * SOAK_BYTES_PER_S / 1e6, "higher"),
        Figure("soak: most bytes that waited", report["high_water_bytes"] / 1e3, "kB", how),
    ]  # fmt: skip


def count_wrong_bytes(recorded: bytes, sent: bytes) -> float:
    """Count the bytes of ``sent`` that are missing or wrong in ``recorded``.

    Bytes before the first recorded one were sent before the port was opened and do not count.
    """
    start = sent.find(recorded[:SYNC_BYTES])
    if start < 0:
        return float(len(sent))
    expected = np.frombuffer(sent, np.uint8)[start:]
    common = min(len(recorded), len(expected))
    wrong = np.count_nonzero(np.frombuffer(recorded, np.uint8, common) != expected[:common])
    return float(wrong + abs(len(expected) - len(recorded)))


def kill_figures(recordings: int = KILLED_RECORDINGS) -> list[Figure]:
    """Kill recordings (``kill -9``) at random times, and measure how much is missing at the end."""
    rng = np.random.default_rng(FIRST_SEED)
    data = frame_block(4096)
    losses_s, recovered = [], 0
    for _ in range(recordings):
        with (
            tempfile.TemporaryDirectory() as folder,
            sender(KILLED_BYTES_PER_S, 60.0, data) as line,
        ):
            output = Path(folder, "killed.mcap")
            recording = start_capture(line.port, output)
            while not output.exists() or output.stat().st_size < 3000:
                time.sleep(0.01)
            time.sleep(float(rng.uniform(0, 1.5)))
            os.kill(recording.pid, signal.SIGKILL)
            killed_s = time.time()
            recording.communicate()
            kept = len(recorded_bytes(output, damaged_ok=True))
            sent = line.sent_bytes()
            missing = sent[sent[:, 1] > kept]
            losses_s.append(max(0.0, killed_s - float(missing[0, 0])) if len(missing) else 0.0)
            whole = Path(folder, "whole.mcap")
            recover(output, whole)
            recovered += recorded_bytes(whole) == recorded_bytes(output, damaged_ok=True)
    how = f"{recordings} recordings of 200 kB/s, killed within 1.5 s of their first bytes on disk"
    return [
        Figure("kill -9: longest loss", max(losses_s), "s", how, 0.5),
        Figure("kill -9: median loss", float(np.median(losses_s)), "s", how),
        Figure("kill -9: made whole by recover", 100 * recovered / recordings, "%", how, 100,
               "higher"),
    ]  # fmt: skip


# ---- recovery


@dataclass(frozen=True)
class ChunkSpan:
    """Chunk of messages in the bytes ``start`` to ``end`` of a file."""

    start: int
    end: int
    messages: list[bytes]


def damage_figures(files: int = DAMAGED_FILES) -> list[Figure]:
    """Recover files with cuts, zeroed tails and flipped bits at random positions."""
    rng = np.random.default_rng(FIRST_SEED)
    intact_chunks = saved_chunks = altered = unreadable = 0
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder, "session.mcap")
        _write_live_session(session)
        intact = session.read_bytes()
        chunks = _read_chunks(session)
        original = {message for chunk in chunks for message in chunk.messages}
        path, output = Path(folder, "damaged.mcap"), Path(folder, "saved.mcap")
        for number in range(files):
            damaged = _damage(intact, number % 3, rng)
            path.write_bytes(damaged)
            undamaged = [
                chunk.messages
                for chunk in chunks
                if chunk.end <= len(damaged)
                and damaged[chunk.start : chunk.end] == intact[chunk.start : chunk.end]
            ]
            intact_chunks += len(undamaged)
            try:
                recover(path, output, overwrite=True)
            except LocatkError:
                unreadable += bool(undamaged)
                continue
            saved = {payload for _, _, payload in Session.open(output).messages([TOPIC])}
            saved_chunks += sum(saved.issuperset(messages) for messages in undamaged)
            altered += len(saved - original)
    how = f"{files} damages: a cut, a tail of zeros or a flipped bit, at random positions"
    saved_percent = 100 * saved_chunks / max(intact_chunks, 1)
    return [
        Figure("recover: whole chunks saved", saved_percent, "%", how, 100.0, "higher"),
        Figure("recover: altered messages returned", altered, "", how, 0.0),
        Figure("recover: outputs unreadable or refused", unreadable, "", how, 0.0),
    ]


def _write_live_session(path: Path) -> None:
    """Write a live recording of one second, with a chunk every 20 ms."""
    data = frame_block(4096)
    with open(path, "wb") as stream, SessionWriter(path, system="", live=stream) as writer:
        for number in range(50):
            for part in range(4):
                offset = 1024 * (4 * number + part)
                chunk = SerialChunk(byte_offset=offset, data=data[offset : offset + 1024])
                writer.write(TOPIC, chunk, 1_000_000_000 + offset)
            writer.flush()


def _read_chunks(path: Path) -> list[ChunkSpan]:
    session = Session.open(path)
    (channel,) = (each.id for each in session.index.channels.values() if each.topic == TOPIC)
    chunks = []
    with open(path, "rb") as stream:
        for segment in session.index.segments:
            messages = mcap_file.read_messages(stream, segment, {channel})
            end = segment.offset + segment.length
            chunks.append(ChunkSpan(segment.offset, end, [data for _, _, data in messages]))
    return chunks


def _damage(intact: bytes, kind: int, rng: np.random.Generator) -> bytes:
    """Return a copy that is cut (kind 0), has a tail of zeros (1), or a flipped bit (2)."""
    offset = int(rng.integers(100, len(intact)))
    if kind == 0:
        return intact[:offset]
    if kind == 1:
        return intact[:offset] + bytes(len(intact) - offset)
    damaged = bytearray(intact)
    damaged[offset] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


# ---- speed


def speed_figures() -> list[Figure]:
    """Time the decoder of each device, in pieces as they arrive from a port."""
    frames = frame_block()
    rows = [
        Figure("locatk frames of 64 bytes", None, "M/s",
               "decoded to arrays, CRC checked, pieces of 64 kB, processor time, one core", None,
               "higher", "prototype, cobs (C), zlib", 1.3, "Python"
               ).timed(time_call(partial(_decode, "locatk", frames), 3, "Python"),
                       BLOCK_FRAMES / 1e6)
    ]  # fmt: skip
    for name, recording in (
        ("polaris-array", Recording(samples=[_simulate_samples(9)])),
        ("magx-array", Recording(samples=[_simulate_samples(8)])),
        ("lighthouse-deck", Recording(sweeps=_simulate_sweeps())),
        ("dotbot-gateway", Recording(sweeps=_simulate_sweeps())),
        ("lines", Recording(samples=[_simulate_samples(9)])),
    ):
        data = b"".join(piece for _, piece in DEVICES[name].encode(recording))
        data *= MIN_DECODED_BYTES // len(data) + 1
        declared = Figure(
            f"{name} decoded", None, "MB/s",
            f"{len(data) / 1e6:.1f} MB in pieces of 64 kB, processor time, one core",
            better="higher", workload="Python",
        )  # fmt: skip
        duration = time_call(partial(_decode, name, data), 3, "Python")
        rows.append(declared.timed(duration, len(data) / 1e6))
    return rows


def _decode(name: str, data: bytes) -> None:
    decoder = DEVICES[name].create_decoder(Options())
    for start in range(0, len(data), FEED_BYTES):
        decoder.feed(data[start : start + FEED_BYTES])
    decoder.finish()


def _simulate_samples(sensors: int, count: int = 20_000) -> Samples:
    rng = np.random.default_rng(FIRST_SEED)
    level = rng.normal(0, 40e-6, (sensors, 3))
    field = level + rng.normal(0, 1e-6, (count, sensors, 3))
    times_ns = 10**18 + 16_000_000 * np.arange(count)
    return Samples("robot", SensorArray(bar(sensors, 0.02)), times_ns, field)


def _simulate_sweeps() -> Sweeps:
    options = SimulationOptions(robots=1, stations=2, duration_s=60.0, seed=FIRST_SEED)
    return simulate(options).sweeps


def info_figure(size: int = LARGE_BYTES) -> Figure:
    """Time ``locatk info`` of a large recording, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "large.mcap")
        _write_large_session(path, size)
        size = path.stat().st_size
        duration = time_command([sys.executable, "-m", "locatk.cli", "info", str(path)], 3)
    return Figure(
        "locatk info on 1 GB", None, "s",
        f"{size / 1e9:.2f} GB of raw bytes in {size // LARGE_CHUNK_BYTES} chunks, processor time "
        "of the command, start of Python included, best of 3", 1.0, workload="Python",
    ).timed(duration)  # fmt: skip


def _write_large_session(path: Path, size: int) -> None:
    noise = np.random.default_rng(FIRST_SEED).bytes(LARGE_CHUNK_BYTES + 4096)
    step_ns = 10**9 // LARGE_CHUNKS_PER_S
    with open(path, "wb") as stream, SessionWriter(path, system="", live=stream) as writer:
        for number in range(size // LARGE_CHUNK_BYTES):
            offset = number % 4096
            chunk = SerialChunk(
                port="bench",
                byte_offset=number * LARGE_CHUNK_BYTES,
                data=noise[offset : offset + LARGE_CHUNK_BYTES],
            )
            writer.write("/serial/robot", chunk, 10**18 + step_ns * number)
            writer.flush()
