"""Recordings end to end, of a port that does what the test says: nothing lost, whatever happens."""

from __future__ import annotations

import errno
import os
import random
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from locatk.core.errors import LocatkError, OutputExistsError
from locatk.formats.capture import reader_thread as receiver
from locatk.formats.capture import recorder
from locatk.formats.capture import recording_files as live_file
from locatk.formats.capture import recording_files as parts
from locatk.formats.capture import setup as session
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.links import Overruns, SourceError
from locatk.formats.capture.reader_thread import PortReader
from locatk.formats.capture.recording_files import DiskFullError, LiveFile
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.reader import Session

RAW = "/serial/robot"


def pieces(count: int, size: int = 100) -> list[bytes]:
    return [os.urandom(size) for _ in range(count)]


def openings(*paths: Path) -> list[int]:
    """Numbers of the bytes that were the first of an opening."""
    return [
        chunk.byte_offset
        for path in paths
        for _, chunk in Session.open(path).decoded(RAW, SerialChunk)
        if chunk.opened
    ]


# ---- every byte


@pytest.mark.slow
def test_every_byte_is_in_the_file(port: Any, start: Any, raw_bytes: Any) -> None:
    sent = pieces(300)
    running = start(note="second floor", meta={"robot": "7"})
    port.send(*sent)
    port.settle()
    recorded = running.end()
    (path,) = recorded.paths
    assert raw_bytes(path) == b"".join(sent)
    assert openings(path) == [0]
    assert (recorded.ended, recorded.failed) == ("stopped", False)
    assert recorded.totals.bytes == 30_000
    assert recorded.totals.losses() == []
    assert recorded.file_bytes == path.stat().st_size
    assert recorded.started_ns < recorded.ended_ns
    facts = Session.open(path).metadata()["capture"]
    assert facts["bytes"] == "30000"
    assert facts["note"] == "second floor"
    assert facts["meta:robot"] == "7"
    assert facts["device"] == "raw"
    assert facts["ended"] == "stopped"
    assert int(facts["started_ns"]) <= recorded.started_ns
    assert int(facts["ended_ns"]) >= recorded.ended_ns
    assert port.links[0].closed


def test_bytes_of_the_last_moment_are_in_the_file(port: Any, start: Any, raw_bytes: Any) -> None:
    sent = pieces(50)
    running = start()
    running.stop.set()
    port.send(*sent)
    recorded = running.result()
    kept = raw_bytes(*recorded.paths)
    assert b"".join(sent).startswith(kept)  # what came after the port was closed is the next one's
    assert recorded.totals.bytes == len(kept)


def test_times_are_of_the_reads_and_ascend(port: Any, start: Any) -> None:
    running = start()
    before = time.time_ns()
    for piece in pieces(40):
        port.send(piece)
        port.settle()
    port.lose()
    port.send(b"x")
    port.settle()
    (path,) = running.end().paths
    after = time.time_ns()
    times = [time_ns for _, time_ns, _ in Session.open(path).messages()]
    assert times == sorted(times)
    slack = 1_000_000_000  # the wall clock of the machine may be corrected meanwhile
    assert before - slack <= times[0] <= times[-1] <= after + slack
    for time_ns, chunk in Session.open(path).decoded(RAW, SerialChunk):
        assert chunk.timestamp.ToNanoseconds() == time_ns


def test_late_messages_keep_stamps_ascending(
    port: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes that arrive while something is said are written after it."""
    wall_s = 0.0
    monkeypatch.setattr(
        session,
        "HostClock",
        lambda: HostClock(time.monotonic_ns, lambda: time.monotonic_ns() + int(wall_s * 1e9)),
    )
    running = start()

    def meanwhile() -> None:
        nonlocal wall_s
        wall_s += 10.0
        port.send(b"meanwhile")
        port.settle()
        time.sleep(0.005)  # the bytes are older than what is said of the clock

    running.when_shown = meanwhile
    running.wait_for_message("wall clock")
    (path,) = running.end().paths
    times = [time_ns for _, time_ns, _ in Session.open(path).messages()]
    assert times == sorted(times)


@pytest.mark.slow
def test_a_disk_that_is_slow_costs_no_byte(
    port: Any, start: Any, raw_bytes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = LiveFile.write

    def slow(self: LiveFile, data: bytes) -> int:
        time.sleep(0.015)
        return real(self, data)

    monkeypatch.setattr(LiveFile, "write", slow)
    monkeypatch.setattr(
        session, "PortReader", lambda *args: PortReader(*args, max_waiting_bytes=20_000)
    )
    sent = pieces(80, size=1000)
    running = start(flush_s=0.02)
    port.send(*sent)
    port.settle()
    running.wait_for_message("the disk is slower than the port")
    recorded = running.end()
    assert raw_bytes(*recorded.paths) == b"".join(sent)
    assert 0 < recorded.totals.high_water_bytes <= 21_000


def test_a_disk_that_hangs_does_not_stop_the_reading(
    port: Any, start: Any, raw_bytes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncing, go_on = threading.Event(), threading.Event()

    def hang(_: int) -> None:
        syncing.set()
        go_on.wait(20)

    monkeypatch.setattr(os, "fdatasync", hang, raising=False)
    running = start(sync_s=0.01)
    assert syncing.wait(10)
    sent = pieces(100)
    port.send(*sent)
    port.settle()
    recorded = running.end()  # does not wait for it either
    go_on.set()
    assert raw_bytes(*recorded.paths) == b"".join(sent)


def test_flushed_data_are_in_the_growing_file(port: Any, start: Any) -> None:
    running = start(flush_s=0.01)
    port.send(b"kept")
    port.settle()
    path = running.wanted.output
    until = time.monotonic() + 10
    content = b""
    while time.monotonic() < until and content != b"kept":
        read = Session.open(path, damaged_ok=True)
        content = b"".join(chunk.data for _, chunk in read.decoded(RAW, SerialChunk))
    assert content == b"kept"
    assert read.damage
    running.end()


def test_the_file_is_forced_to_the_disk_by_another_thread(
    port: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []
    monkeypatch.setattr(
        LiveFile, "sync", lambda self: names.append(threading.current_thread().name)
    )
    running = start(sync_s=0.01)
    running.until(lambda: len(names) > 5)
    running.end()
    assert set(names) == {"locatk-sync"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_together(
    port: Any, start: Any, raw_bytes: Any, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Pieces of all sizes, gaps, parts, a slow disk and little memory, at random."""
    chance = random.Random(seed)
    real = LiveFile.write

    def sometimes_slow(self: LiveFile, data: bytes) -> int:
        if chance.random() < 0.05:
            time.sleep(0.02)
        return real(self, data)

    monkeypatch.setattr(LiveFile, "write", sometimes_slow)
    most = chance.choice([2_000, 1 << 20])
    monkeypatch.setattr(
        session, "PortReader", lambda *args: PortReader(*args, max_waiting_bytes=most)
    )
    rotation = chance.choice([{}, {"rotate_s": 0.05}, {"rotate_bytes": 20_000}])
    running = start(flush_s=chance.choice([0.0, 0.02]), **rotation)
    sent = bytearray()
    gaps = 0
    opened = [0]
    for _ in range(40):
        act = chance.random()
        if act < 0.1:
            port.refusals = [SourceError("not there")] * chance.randint(0, 2)
            port.lose()
            port.settle()
            gaps += 1
            opened.append(len(sent))
        elif act < 0.3:
            time.sleep(chance.random() * 0.01)
        else:
            piece = os.urandom(chance.choice([1, 10, 1000, 5000]))
            port.send(piece)
            sent += piece
    port.settle()
    recorded = running.end()
    assert raw_bytes(*recorded.paths) == bytes(sent)
    assert recorded.totals.gaps == gaps
    assert recorded.totals.bytes == len(sent)
    chunks = [
        chunk
        for path in recorded.paths
        for _, chunk in Session.open(path).decoded(RAW, SerialChunk)
    ]
    flagged = openings(*recorded.paths)
    assert set(flagged) <= set(opened)
    assert set(opened) - {len(sent)} <= set(flagged)
    times = [chunk.timestamp.ToNanoseconds() for chunk in chunks]
    assert times == sorted(times)


# ---- gaps


def test_unplugged_and_plugged_in_again(
    port: Any, start: Any, raw_bytes: Any, log_lines: Any
) -> None:
    first, second = pieces(20), pieces(20)
    running = start()
    port.send(*first)
    port.lose("pulled out")
    port.settle()
    port.send(*second)
    port.settle()
    recorded = running.end()
    (path,) = recorded.paths
    assert raw_bytes(path) == b"".join(first + second)
    assert openings(path) == [0, 2000]
    assert recorded.totals.gaps == 1
    assert 0 < recorded.totals.gap_s < 10
    assert recorded.totals.losses()
    assert not recorded.failed
    lines = log_lines(path)
    assert lines[0] == "connection lost: pulled out"
    assert lines[1].startswith("reconnected to scripted after ")
    assert running.said == lines
    facts = Session.open(path).metadata()["capture"]
    assert facts["gaps"] == "1"
    assert float(facts["gap_s"]) == pytest.approx(recorded.totals.gap_s, abs=1e-5)


@pytest.mark.slow
def test_a_device_that_does_not_come_back(port: Any, start: Any, raw_bytes: Any) -> None:
    running = start()
    port.refusals = [SourceError("not there") for _ in range(10_000)]
    port.send(b"all there is")
    port.lose()
    running.wait_for_message("connection lost")
    time.sleep(0.05)
    recorded = running.end()
    assert raw_bytes(*recorded.paths) == b"all there is"
    assert recorded.totals.gaps == 1
    assert recorded.totals.gap_s >= 0.05
    assert recorded.ended == "stopped"


@pytest.mark.slow
def test_a_silence_while_it_is_away_is_no_second_warning(port: Any, start: Any) -> None:
    running = start(silence_s=0.5)  # longer than a busy machine takes to lose the port
    port.refusals = [SourceError("not there") for _ in range(10_000)]
    port.lose()
    running.wait_for_message("connection lost")
    running.until(lambda: any((status.away_s or 0) > 0.6 for status in running.shown))
    recorded = running.end()
    assert recorded.totals.silences == 0
    assert recorded.totals.gaps == 1


def test_it_breaks_for_good(port: Any, start: Any, raw_bytes: Any) -> None:
    port.can_reconnect = False
    running = start()
    port.send(b"half")
    port.lose("cut short")
    recorded = running.result()
    assert (recorded.ended, recorded.failed) == ("cut short", True)
    assert raw_bytes(*recorded.paths) == b"half"


def test_the_end_of_the_source_is_no_failure(port: Any, start: Any, raw_bytes: Any) -> None:
    running = start()
    port.send(b"whole")
    port.end()
    recorded = running.result()
    assert (recorded.ended, recorded.failed) == ("end of the source", False)
    assert raw_bytes(*recorded.paths) == b"whole"


def test_a_driver_that_fails(port: Any, start: Any, raw_bytes: Any) -> None:
    def fail() -> bytes:
        raise RuntimeError("driver gone mad")

    running = start()
    port.send(b"before")
    port.then(fail)
    recorded = running.result()
    assert recorded.failed
    assert "driver gone mad" in recorded.ended
    assert raw_bytes(*recorded.paths) == b"before"


def test_a_driver_that_hangs_does_not_hold_the_file(
    port: Any, start: Any, raw_bytes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receiver, "MAX_STOP_WAIT_S", 0.2)
    hanging, go_on = threading.Event(), threading.Event()

    def hang() -> bytes:
        hanging.set()
        go_on.wait(20)
        return b""

    running = start()
    port.send(b"before")
    port.then(hang)
    assert hanging.wait(10)
    recorded = running.end()
    go_on.set()
    assert raw_bytes(*recorded.paths) == b"before"
    assert recorded.ended == "stopped"


# ---- silence, clock, overruns


@pytest.mark.slow
def test_silence_is_reported_once(port: Any, start: Any, log_lines: Any) -> None:
    running = start(silence_s=0.1)
    running.wait_for_message("no data received for 0 s")
    shown = len(running.shown)
    running.until(lambda: len(running.shown) > shown + 8)
    assert len(running.said) == 1
    port.send(b"x")
    running.until(lambda: len(running.said) > 1)
    recorded = running.end()
    assert recorded.totals.silences == 2
    assert log_lines(*recorded.paths) == running.said
    assert recorded.totals.losses() == []


@pytest.mark.slow
def test_a_disk_that_was_slow_is_no_silence(
    port: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was received meanwhile only waits to be written."""
    real = LiveFile.write
    stalled, go_on = threading.Event(), threading.Event()

    def stall(self: LiveFile, data: bytes) -> int:
        if len(data) > 4000:
            stalled.set()
            go_on.wait(20)
        return real(self, data)

    running = start(silence_s=0.15, flush_s=0.01)
    monkeypatch.setattr(recorder, "STATUS_INTERVAL_S", 0.0)  # looked at in the very turn
    monkeypatch.setattr(LiveFile, "write", stall)
    port.send(os.urandom(5000))
    assert stalled.wait(10)
    for _ in range(20):  # longer than the silence that is allowed
        port.send(b"x" * 10)
        port.settle()
        time.sleep(0.01)
    shown = len(running.shown)
    go_on.set()
    running.until(lambda: len(running.shown) > shown)
    recorded = running.end()
    assert running.said == []
    assert recorded.totals.silences == 0
    assert recorded.totals.bytes == 5200


@pytest.mark.slow
def test_bytes_without_frames_are_reported_once(
    port: Any, start: Any, log_lines: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wrong device, or the wrong baud."""
    monkeypatch.setattr(recorder, "FRAME_CHECK_S", 0.1)
    running = start("locatk")
    port.send(b"\x80" * 500)
    running.wait_for_message("no frame of locatk in 500 bytes")
    shown = len(running.shown)
    running.until(lambda: len(running.shown) > shown + 3)
    recorded = running.end()
    assert len(running.said) == 1
    assert log_lines(*recorded.paths) == running.said
    assert not recorded.failed


@pytest.mark.slow
def test_a_set_wall_clock_is_reported_and_changes_nothing(
    port: Any, start: Any, log_lines: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall_s = 1_700_000_000.0
    monkeypatch.setattr(
        session,
        "HostClock",
        lambda: HostClock(time.monotonic_ns, lambda: time.monotonic_ns() + int(wall_s * 1e9)),
    )
    running = start()
    port.send(b"before")
    port.settle()
    wall_s -= 3600.0
    running.wait_for_message("the wall clock was set by -3600.0 s")
    shown = len(running.shown)
    running.until(lambda: len(running.shown) > shown + 2)
    port.send(b"after")
    port.settle()
    recorded = running.end()
    assert recorded.totals.clock_step_s == pytest.approx(-3600, abs=0.01)
    (path,) = recorded.paths
    times = [time_ns for time_ns, _ in Session.open(path).decoded(RAW, SerialChunk)]
    assert 0 < times[1] - times[0] < 60_000_000_000
    assert len(log_lines(path)) == 1
    assert float(Session.open(path).metadata()["capture"]["clock_step_s"]) < -3599


def test_overruns_are_in_the_totals(port: Any, start: Any) -> None:
    running = start()
    port.send(b"x")
    port.settle()
    port.links[0].counted = Overruns(overrun=3, buffer=4, frame=5, parity=6)
    recorded = running.end()
    assert (recorded.totals.overruns, recorded.totals.line_errors) == (7, 11)
    assert len(recorded.totals.losses()) == 2
    assert Session.open(recorded.paths[0]).metadata()["capture"]["overruns"] == "7"


@pytest.mark.slow
def test_how_it_goes_is_shown(port: Any, start: Any) -> None:
    running = start()
    running.until(lambda: running.shown)
    port.send(*pieces(10, size=1000))
    running.until(lambda: running.shown[-1].totals.bytes == 10_000)
    running.until(lambda: running.shown[-1].file_bytes > 10_000)
    recorded = running.end()
    shown = running.shown
    since = [b.elapsed_s - a.elapsed_s for a, b in pairwise(shown)]
    received = sum(b.bytes_per_s * s for b, s in zip(shown[1:], since, strict=True))
    assert received == pytest.approx(10_000, rel=0.5)  # the times are taken one after another
    assert shown[-1].free_bytes > 0
    assert recorded.totals.high_water_bytes > 0


# ---- limits


def test_it_ends_after_the_duration(port: Any, start: Any) -> None:
    recorded = start(duration_s=0.1).result()
    assert (recorded.ended, recorded.failed) == ("duration", False)
    assert recorded.ended_ns - recorded.started_ns >= 100_000_000


def test_it_ends_at_the_size(port: Any, start: Any, raw_bytes: Any) -> None:
    running = start(max_bytes=50_000, flush_s=0.01)
    sent = pieces(100, size=1000)
    port.send(*sent)
    recorded = running.result()
    assert (recorded.ended, recorded.failed) == ("max-size", False)
    assert recorded.file_bytes >= 50_000
    assert b"".join(sent).startswith(raw_bytes(*recorded.paths))


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{"max_bytes": 1_000_000}, {"rotate_bytes": 1_000_000}])
def test_sizes_hold_for_what_comes_at_once(
    port: Any,
    start: Any,
    raw_bytes: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    limits: Any,
) -> None:
    """3 MB a turn, and the line goes on: no hole, and not much more than was asked for."""
    monkeypatch.setattr(recorder, "WRITE_INTERVAL_S", 0.3)
    given = bytearray()

    def again() -> bytes:
        if not running.stop.is_set():
            port.then(again)
        piece = os.urandom(10_000)
        given.extend(piece)
        return piece

    running = start(**limits)
    port.then(again)
    if "max_bytes" in limits:
        recorded = running.result()
        running.stop.set()
        assert recorded.ended == "max-size"
    else:
        until = time.monotonic() + 10
        while time.monotonic() < until and len(list(tmp_path.iterdir())) < 3:
            time.sleep(0.01)
        recorded = running.end()
        assert len(recorded.paths) > 2
    kept = raw_bytes(*recorded.paths)
    assert bytes(given).startswith(kept)
    assert recorded.totals.bytes == len(kept)
    for path in recorded.paths:
        assert path.stat().st_size < 2_300_000  # two chunks more at the most


def check_parts(paths: list[Path]) -> None:
    """Each stands alone."""
    for number, path in enumerate(paths, 1):
        read = Session.open(path)
        assert read.damage is None
        assert read.metadata()["capture"]["part"] == str(number)
        assert read.metadata()["capture"]["note"] == "of all"
        assert {RAW, "/log"} <= {channel.topic for channel in read.channels}


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{"rotate_s": 0.03}, {"rotate_bytes": 8_000, "flush_s": 0.01}])
def test_parts_hold_every_byte_once(
    port: Any, start: Any, raw_bytes: Any, limits: dict[str, float]
) -> None:
    running = start(note="of all", **limits)
    sent = pieces(80, size=500)
    for piece in sent:
        port.send(piece)
        time.sleep(0.002)
    port.settle()
    recorded = running.end()
    assert len(recorded.paths) > 2
    assert raw_bytes(*recorded.paths) == b"".join(sent)
    check_parts(recorded.paths)
    counted = [Session.open(path).metadata()["capture"]["bytes"] for path in recorded.paths]
    assert sum(map(int, counted)) == recorded.totals.bytes == 40_000
    assert recorded.file_bytes == sum(path.stat().st_size for path in recorded.paths)
    ended = [Session.open(path).metadata()["capture"]["ended"] for path in recorded.paths]
    assert ended[-1] == "stopped"
    assert set(ended[:-1]) == {"continued in the next part"}


@pytest.mark.slow
def test_a_part_ends_in_a_gap(port: Any, start: Any, raw_bytes: Any) -> None:
    running = start(note="of all", rotate_s=0.05)
    first, second = pieces(5), pieces(5)
    port.send(*first)
    port.refusals = [SourceError("not there") for _ in range(3)]
    port.lose()
    port.settle()
    port.send(*second)
    port.settle()
    recorded = running.end()
    assert raw_bytes(*recorded.paths) == b"".join(first + second)
    check_parts(recorded.paths)
    assert openings(*recorded.paths) == [0, 500]
    gaps = [Session.open(path).metadata()["capture"]["gaps"] for path in recorded.paths]
    assert sum(map(int, gaps)) == recorded.totals.gaps == 1
    away = [Session.open(path).metadata()["capture"]["gap_s"] for path in recorded.paths]
    assert sum(map(float, away)) == pytest.approx(recorded.totals.gap_s, abs=1e-4)


@pytest.mark.slow
def test_the_next_part_cannot_be_begun(port: Any, start: Any, raw_bytes: Any) -> None:
    running = start(rotate_s=0.15)
    parts.part_path(running.wanted.output, 2).write_bytes(b"somebody else's")
    port.send(b"kept")
    time.sleep(0.25)  # longer than a part
    port.send(b"not")
    recorded = running.result()
    assert recorded.failed
    assert "run-002.mcap" in recorded.ended
    assert "3 received bytes are not in the file" in recorded.ended
    assert "removed" not in recorded.ended
    assert recorded.paths == [parts.part_path(running.wanted.output, 1)]
    assert raw_bytes(*recorded.paths) == b"kept"
    assert parts.part_path(running.wanted.output, 2).read_bytes() == b"somebody else's"


# ---- the disk


@pytest.mark.slow
def test_a_filling_disk_is_reported_then_ends_the_recording(
    port: Any, start: Any, raw_bytes: Any, log_lines: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = 10_000_000
    monkeypatch.setattr(LiveFile, "free", lambda self: free)
    running = start(reserve_bytes=5_000_000)
    sent = pieces(60, size=1000)
    port.send(*sent)
    running.wait_for_message("the disk will be full in")
    free = 4_000_000
    last = pieces(30, size=1000)
    running.when_shown = lambda: port.send(*last)
    recorded = running.result()
    assert recorded.failed
    assert "the disk is full" in recorded.ended
    kept = raw_bytes(*recorded.paths)
    assert b"".join(sent + last).startswith(kept)
    assert len(kept) >= 60_000
    assert recorded.totals.bytes == len(kept)
    assert any("the disk will be full in" in line for line in log_lines(*recorded.paths))


def test_a_disk_without_statistics_is_accepted(
    port: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LiveFile, "free", lambda self: None)
    running = start()
    running.until(lambda: running.shown)
    assert running.end().ended == "stopped"


@pytest.mark.slow
def test_a_disk_without_space_leaves_a_complete_file(
    port: Any, start: Any, raw_bytes: Any, small_disk: Path
) -> None:
    running = start(output=small_disk / "run.mcap", reserve_bytes=1)
    sent = pieces(450, size=30_000)
    port.send(*sent)
    recorded = running.result()
    assert recorded.failed
    assert "no space left" in recorded.ended
    kept = raw_bytes(*recorded.paths)
    assert b"".join(sent).startswith(kept)
    assert len(kept) > 2_000_000
    assert recorded.totals.bytes == len(kept)
    facts = Session.open(recorded.paths[0]).metadata()["capture"]
    assert "no space left" in facts["ended"]
    assert recorded.file_bytes == recorded.paths[0].stat().st_size


def test_a_disk_without_space_for_the_first_chunk(
    port: Any, start: Any, raw_bytes: Any, small_disk: Path
) -> None:
    (small_disk / "other").write_bytes(bytes(8 << 20))
    recorded = start(output=small_disk / "run.mcap", reserve_bytes=1).result()
    assert recorded.failed
    assert "no space left" in recorded.ended
    assert raw_bytes(*recorded.paths) == b""
    assert "no space left" in Session.open(recorded.paths[0]).metadata()["capture"]["ended"]


def test_parts_on_a_disk_without_space(
    port: Any, start: Any, raw_bytes: Any, small_disk: Path
) -> None:
    running = start(
        output=small_disk / "run.mcap", reserve_bytes=1, rotate_bytes=1_000_000, note="of all"
    )
    sent = pieces(400, size=30_000)
    port.send(*sent)
    recorded = running.result()
    assert recorded.failed
    assert len(recorded.paths) > 1
    check_parts(recorded.paths)
    kept = raw_bytes(*recorded.paths)
    assert b"".join(sent).startswith(kept)
    assert recorded.totals.bytes == len(kept)


def test_a_disk_that_fails_ends_it_in_words(
    port: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = start(flush_s=0.01)
    port.send(b"kept")
    port.settle()
    path = running.wanted.output
    until = time.monotonic() + 10
    while time.monotonic() < until and not list(
        Session.open(path, damaged_ok=True).messages([RAW])
    ):
        pass

    def fail(self: LiveFile, data: bytes) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(LiveFile, "write", fail)
    port.send(b"lost")
    recorded = running.result()
    assert recorded.failed
    assert os.strerror(errno.EIO) in recorded.ended
    assert "4 received bytes" in recorded.ended  # that were received are not in it
    left = Session.open(path, damaged_ok=True).decoded(RAW, SerialChunk)
    assert b"".join(chunk.data for _, chunk in left) == b"kept"


@pytest.mark.slow
def test_the_folder_is_renamed_meanwhile(port: Any, start: Any, tmp_path: Path) -> None:
    folder = tmp_path / "today"
    folder.mkdir()
    running = start(output=folder / "run.mcap")
    port.send(b"before")
    port.settle()
    folder.rename(tmp_path / "monday")
    shown = len(running.shown)
    running.until(lambda: len(running.shown) > shown + 2)
    port.send(b"after")
    port.settle()
    recorded = running.end()
    assert recorded.ended == "stopped"
    read = Session.open(tmp_path / "monday" / "run.mcap").decoded(RAW, SerialChunk)
    assert b"".join(chunk.data for _, chunk in read) == b"beforeafter"


def test_the_file_is_removed_meanwhile(port: Any, start: Any) -> None:
    running = start()
    port.send(b"lost")
    port.settle()
    running.wanted.output.unlink()
    recorded = running.end()
    assert recorded.failed
    assert "removed or replaced" in recorded.ended


# ---- refused before the port is opened


def refused(start: Any, kind: type[Exception], words: str, **given: Any) -> None:
    with pytest.raises(kind, match=words):
        start(**given).result()


def test_an_output_that_is_there(port: Any, start: Any, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"old")
    refused(start, OutputExistsError, "exists")
    assert port.asked == 0
    assert (tmp_path / "run.mcap").read_bytes() == b"old"


@pytest.mark.parametrize("number", [1, 2, 12])
def test_a_part_that_is_there(port: Any, start: Any, tmp_path: Path, number: int) -> None:
    parts.part_path(tmp_path / "run.mcap", number).write_bytes(b"old")
    refused(start, OutputExistsError, f"run-{number:03d}.mcap", rotate_s=60.0)
    assert port.asked == 0


def test_no_folder(port: Any, start: Any, tmp_path: Path) -> None:
    refused(start, LocatkError, "no such folder", output=tmp_path / "no" / "run.mcap")
    assert port.asked == 0


def test_a_folder_that_cannot_be_written(
    port: Any, start: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir(mode=0o555)
    if os.access(folder, os.W_OK):  # root

        def refuse(**_: object) -> None:
            raise PermissionError(errno.EACCES, "Permission denied")

        monkeypatch.setattr(session.tempfile, "TemporaryFile", refuse)
    refused(start, LocatkError, "cannot write: Permission denied", output=folder / "run.mcap")
    assert port.asked == 0


def test_a_read_only_disk(port: Any, start: Any, small_disk: Path) -> None:
    import subprocess

    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    refused(start, LocatkError, "Read-only", output=small_disk / "run.mcap", reserve_bytes=1)
    assert port.asked == 0


def test_a_disk_that_is_full_already(port: Any, start: Any, small_disk: Path) -> None:
    refused(start, DiskFullError, "only 9 MB of the disk are free", output=small_disk / "run.mcap")
    assert port.asked == 0
    assert not list(small_disk.iterdir())


@pytest.mark.parametrize("name", ["a/b", "a b", "a\nb"])
def test_names_that_are_no_topics(port: Any, start: Any, name: str) -> None:
    refused(start, LocatkError, "cannot be part of a topic", name=name)
    assert port.asked == 0


def test_devices_that_are_none(port: Any, start: Any, tmp_path: Path) -> None:
    refused(start, LocatkError, "no device 'nonsense'", device="nonsense")
    assert port.asked == 0
    assert not (tmp_path / "run.mcap").exists()


def test_a_port_that_cannot_be_opened_keeps_the_old_file(
    port: Any, start: Any, tmp_path: Path
) -> None:
    (tmp_path / "run.mcap").write_bytes(b"old")
    port.refusals = [SourceError("held by somebody")]
    refused(start, SourceError, "held by somebody", overwrite=True)
    assert (tmp_path / "run.mcap").read_bytes() == b"old"


def test_overwrite_replaces_the_old_file(
    port: Any, start: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    (tmp_path / "run.mcap").write_bytes(b"old" * 10_000)
    running = start(overwrite=True)
    port.send(b"new")
    port.settle()
    assert raw_bytes(*running.end().paths) == b"new"


def test_a_file_that_cannot_be_made_gives_the_port_back(
    port: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "check_outputs", lambda *args, **more: None)
    monkeypatch.setattr(live_file, "check_output", lambda *args, **more: None)
    refused(start, LocatkError, "cannot write", output=Path("/proc/locatk/run.mcap"))
    refused(start, LocatkError, "cannot write", output=Path("/proc/run.mcap"))
    assert all(link.closed for link in port.links)


def test_the_output_is_what_is_played(start: Any, tmp_path: Path, port: Any) -> None:
    running = start()
    port.send(b"precious")
    port.settle()
    (path,) = running.end().paths
    before = path.read_bytes()
    for name in (f"replay:{path}", f"replay:{path}#{RAW}", f"replay://{path}"):
        wanted = session.CaptureRequest(name, "raw", path, overwrite=True)
        with pytest.raises(OutputExistsError):
            session.record(wanted, threading.Event())
    assert path.read_bytes() == before


# ---- what is told must not end it


@pytest.fixture
def recorded_inline(port: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """``recorded_inline(tell=...)`` records in this thread until the source is at its end."""
    monkeypatch.setattr(session.ports, "port_of", lambda *args, **more: port)

    def run(**talk: Callable[[Any], None]) -> Any:
        wanted = session.CaptureRequest("scripted", "raw", tmp_path / "alone.mcap")
        return session.record(wanted, threading.Event(), **talk)

    return run


def test_an_interrupt_in_the_middle_finishes_the_file(
    port: Any, recorded_inline: Any, raw_bytes: Any, tmp_path: Path
) -> None:
    """The second Ctrl-C."""

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    port.send(b"kept")
    port.lose()
    port.send(b"too")
    with pytest.raises(KeyboardInterrupt):
        recorded_inline(tell=interrupt)
    assert raw_bytes(tmp_path / "alone.mcap").startswith(b"kept")
    assert all(link.closed for link in port.links)


@pytest.mark.slow
def test_lines_of_the_log_are_in_order(port: Any, start: Any) -> None:
    running = start()
    for number in range(5):
        port.send(b"x" * number)
        port.lose(f"number {number}")
    port.send(b"end")
    port.settle()
    (path,) = running.end().paths
    stamped = [(time_ns, topic) for topic, time_ns, _ in Session.open(path).messages()]
    assert all(a[0] <= b[0] for a, b in pairwise(stamped))
    assert [topic for _, topic in stamped].count("/log") == 10
