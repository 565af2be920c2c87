"""What capture survives: a minute at full speed, being killed, damaged files."""

from __future__ import annotations

import json
import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np

from locatk.core.errors import LocatkError
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.capture.serial_line import block, capture, sender
from locatk.formats.benchmarks.timing import SEED
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import mcap_file
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.recovery.recover import recover
from locatk.formats.sessions.writer import SessionWriter

RATE = 3e6
SOAK_S = 60.0
KILLS = 50
DAMAGES = 400

FIRST = 4096
"""Bytes by which the start of a recording is found in what was sent."""

TOPIC = "/serial/robot"
NAIVE = "prototype, one message a frame"


def received(path: Path, *, damaged_ok: bool = False) -> bytes:
    """All raw bytes of a session, which must follow each other."""
    session = Session.open(path, damaged_ok=damaged_ok)
    pieces: list[bytes] = []
    place = 0
    for _, chunk in session.decoded(TOPIC, SerialChunk):
        if chunk.byte_offset != place:
            raise LocatkError(f"byte {chunk.byte_offset} after byte {place}", file=path)
        pieces.append(chunk.data)
        place += len(chunk.data)
    return b"".join(pieces)


def soak_figures(seconds: float = SOAK_S) -> list[Figure]:
    """A minute of frames at 3 MB/s over a pseudo-terminal."""
    data = block()
    how = f"{seconds:.0f} s of 64-byte frames at 3 MB/s over a pseudo-terminal, decoded live"
    with tempfile.TemporaryDirectory() as folder, sender(RATE, seconds, data) as line:
        output = Path(folder, "soak.mcap")
        recording = capture(line.port, output, "--duration", f"{seconds + 3:g}")
        assert recording.stdout is not None
        answer = json.loads(recording.stdout.read())
        _, status, used = os.wait4(recording.pid, 0)
        recording.returncode = os.waitstatus_to_exitcode(status)
        sent = int(line.sent()[-1, 1])
        rounds = sent // len(data) + 1
        wrong = wrong_bytes(received(output), (data * rounds)[:sent])
        return [
            Figure("soak: bytes lost or wrong", wrong, "", f"{how}; {sent / 1e6:.0f} MB", 0.0),
            Figure("soak: bad or missing frames", answer["bad"] + answer["lost"], "", how, 0.0),
            Figure(
                "soak: one core",
                100 * (used.ru_utime + used.ru_stime) / seconds,
                "%",
                f"{how}; processor time of the process, start-up included",
                60.0,
                peer=NAIVE,
                peer_value=51.0,
            ),
            Figure(
                "soak: rate kept", sent / seconds / 1e6, "MB/s", how, 0.99 * RATE / 1e6, "higher"
            ),
            Figure("soak: most bytes that waited", answer["high_water_bytes"] / 1e3, "kB", how),
        ]


def wrong_bytes(found: bytes, sent: bytes) -> float:
    """Bytes of ``sent`` that are not in ``found`` at their place, from the first one that came
    after the port was opened on."""
    start = sent.find(found[:FIRST])
    if start < 0:
        return float(len(sent))
    wanted = np.frombuffer(sent, np.uint8)[start:]
    shared = min(len(found), len(wanted))
    wrong = np.count_nonzero(np.frombuffer(found, np.uint8, shared) != wanted[:shared])
    return float(wrong + abs(len(wanted) - len(found)))


def kill_figures(tries: int = KILLS) -> list[Figure]:
    """``kill -9`` at random instants: how long before it the recording ends."""
    rng = np.random.default_rng(SEED)
    data = block(4096)
    losses, recovered = [], 0
    for _ in range(tries):
        with tempfile.TemporaryDirectory() as folder, sender(200e3, 60.0, data) as line:
            output = Path(folder, "killed.mcap")
            recording = capture(line.port, output)
            while not output.exists() or output.stat().st_size < 3000:
                time.sleep(0.01)
            time.sleep(float(rng.uniform(0, 1.5)))
            os.kill(recording.pid, signal.SIGKILL)
            killed = time.time()
            recording.communicate()
            kept = len(received(output, damaged_ok=True))
            sent = line.sent()
            unread = sent[sent[:, 1] > kept]
            losses.append(max(0.0, killed - float(unread[0, 0])) if len(unread) else 0.0)
            whole = Path(folder, "whole.mcap")
            recover(output, whole)
            recovered += received(whole) == received(output, damaged_ok=True)
    how = f"{tries} recordings of 200 kB/s, killed within 1.5 s of their first bytes on the disk"
    return [
        Figure("kill -9: longest loss", max(losses), "s", how, 0.5),
        Figure("kill -9: median loss", float(np.median(losses)), "s", how),
        Figure("kill -9: made whole by recover", 100 * recovered / tries, "%", how, 100, "higher"),
    ]


def damage_figures(tries: int = DAMAGES) -> list[Figure]:
    """Cuts, zeroed tails and flipped bits at random places: what is saved of whole chunks."""
    rng = np.random.default_rng(SEED)
    whole_chunks = saved_chunks = altered = unreadable = 0
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder, "session.mcap")
        _session(session)
        intact = session.read_bytes()
        chunks = _chunks(session)
        for number in range(tries):
            damaged = _damage(intact, number % 3, rng)
            path, output = Path(folder, "damaged.mcap"), Path(folder, "saved.mcap")
            path.write_bytes(damaged)
            left = [
                messages
                for start, end, messages in chunks
                if end <= len(damaged) and damaged[start:end] == intact[start:end]
            ]
            whole_chunks += len(left)
            try:
                recover(path, output, overwrite=True)
            except LocatkError:
                unreadable += bool(left)
                continue
            found = [payload for _, _, payload in Session.open(output).messages([TOPIC])]
            known = set(found)
            saved_chunks += sum(known.issuperset(messages) for messages in left)
            every = {message for _, _, messages in chunks for message in messages}
            altered += len(known - every)
    how = f"{tries} damages: a cut, a tail of zeros, a flipped bit, at random places"
    share = 100 * saved_chunks / max(whole_chunks, 1)
    return [
        Figure("recover: whole chunks saved", share, "%", how, 100.0, "higher"),
        Figure("recover: altered messages returned", altered, "", how, 0.0),
        Figure("recover: outputs unreadable or refused", unreadable, "", how, 0.0),
    ]


Chunk = tuple[int, int, list[bytes]]


def _session(path: Path) -> None:
    """A live recording of a second: a chunk each 20 ms."""
    data = block(4096)
    with open(path, "wb") as stream, SessionWriter(path, system="", live=stream) as writer:
        for number in range(50):
            for part in range(4):
                offset = 1024 * (4 * number + part)
                chunk = SerialChunk(byte_offset=offset, data=data[offset : offset + 1024])
                writer.write(TOPIC, chunk, 1_000_000_000 + offset)
            writer.flush()


def _chunks(path: Path) -> list[Chunk]:
    """First byte, byte after the last and messages of each chunk."""
    found = []
    session = Session.open(path)
    (wanted,) = (each.id for each in session.index.channels.values() if each.topic == TOPIC)
    with open(path, "rb") as stream:
        for segment in session.index.segments:
            messages = mcap_file.read_messages(stream, segment, {wanted})
            end = segment.offset + segment.length
            found.append((segment.offset, end, [data for _, _, data in messages]))
    return found


def _damage(intact: bytes, kind: int, rng: np.random.Generator) -> bytes:
    """A copy that is cut, has a tail of zeros, or a flipped bit."""
    place = int(rng.integers(100, len(intact)))
    if kind == 0:
        return intact[:place]
    if kind == 1:
        return intact[:place] + bytes(len(intact) - place)
    changed = bytearray(intact)
    changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)
