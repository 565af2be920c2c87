"""Live sessions: what goes on when a part of them fails, time, status."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import LocatkError
from locatk.core.streaming.events import WarningEvent
from locatk.formats.capture.setup import CaptureRequest
from locatk.formats.live import session as live_session
from locatk.formats.live.session import LiveRequest, LiveSession
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.trajectories import read_live
from locatk.formats.sinks.interface import SinkStatus

LINES = [f"{k / 1000},0,0" for k in range(20)]
"""Odometry at walking pace. The decoder leaves out the first line, which may be a part."""


def positions(poses: Any) -> list[float]:
    return [float(pose.position[0]) for pose in poses]


def assert_all_lines(path: Path, raw_bytes: Any, count: int = 20) -> None:
    """Check that a recording is finished and has every byte."""
    assert Session.open(path).damage is None
    assert raw_bytes(path) == "".join(f"{line}\n" for line in LINES[:count]).encode()


# ---- sinks


@pytest.mark.slow
def test_a_sink_that_raises_stops_nothing(
    start: Any, port: Any, stream: Any, sink: Any, ListSink: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    class Raising(ListSink):  # type: ignore[misc]
        def offer(self, message: Any) -> None:
            super().offer(message)
            raise RuntimeError("out\nof order")

        def close(self, timeout_s: float) -> None:
            super().close(timeout_s)
            raise RuntimeError("and at the end")

    raising, last = Raising("raising:"), ListSink()
    path = tmp_path / "run.mcap"
    run = start(sinks=[raising, last], output=path)
    port.send(*LINES)
    run.until(lambda: stream.samples >= 19)
    assert not run.session.status()["ok"]
    port.end()
    result = run.result()
    assert positions(last.poses) == positions(sink.poses)
    assert len(raising.messages) == len(sink.messages)
    assert [text for text in run.told if "raising" in text] == [
        "raising: failed: RuntimeError: out of order"
    ]
    (status,) = (each for each in result.status["sinks"] if each["address"] == "raising:")
    assert status["error"] == "RuntimeError: out of order"
    assert raising.closed == last.closed == 1
    assert_all_lines(path, raw_bytes)


@pytest.mark.slow
def test_a_sink_whose_status_raises(start: Any, port: Any, ListSink: Any) -> None:
    class Silent(ListSink):  # type: ignore[misc]
        def status(self) -> SinkStatus:
            raise KeyError("clients")

    run = start(sinks=[Silent("silent:")])
    run.until(run.ready.is_set)
    status = run.session.status()
    assert status["sinks"][1]["address"] == "silent:"
    assert status["sinks"][1]["error"] == "KeyError: 'clients'"
    assert not status["ok"]
    run.end()


@pytest.mark.slow
def test_a_sink_that_hangs_at_the_end(
    start: Any, port: Any, ListSink: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_session, "CLOSE_TIMEOUT_S", 0.05)
    release = threading.Event()

    class Hanging(ListSink):  # type: ignore[misc]
        def close(self, timeout_s: float) -> None:
            release.wait(20)

    last = ListSink()
    run = start(sinks=[Hanging(), last])
    port.send(*LINES)
    port.end()
    assert run.result().ended == "end of the source"
    assert last.closed == 1
    release.set()


@pytest.mark.parametrize("error", [LocatkError("the port is in use"), RuntimeError("odd")])
def test_a_sink_that_does_not_open_closes_the_others(
    start: Any, port: Any, sink: Any, ListSink: Any, error: Exception, tmp_path: Path
) -> None:
    class Closed(ListSink):  # type: ignore[misc]
        def open(self, context: Any) -> None:
            raise error

    path = tmp_path / "run.mcap"
    run = start(sinks=[Closed("closed:"), ListSink()], output=path)
    with pytest.raises(LocatkError) as raised:
        run.result()
    assert str(error) in str(raised.value)
    assert sink.closed == 1
    assert port.closed == port.opened == 1
    assert not path.exists()


# ---- recording and solver


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_only(
    port: Any, stream: Any, sink: Any, small_disk: Path, start: Any
) -> None:
    """Poses go on; the health and the result name the error."""
    from locatk.formats.capture import setup

    path = small_disk / "run.mcap"
    checked = setup._check_disk
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setup, "_check_disk", lambda folder, reserve: None)
        run = start(output=path)
        run.until(run.ready.is_set)
    assert setup._check_disk is checked
    noise = np.random.default_rng(1).random((30, 3))
    for _ in range(200):
        port.send(*(f"{x},{y},{z}" for x, y, z in noise))
        if run.session.status()["inputs"][0]["recording"]["error"]:
            break
        time.sleep(0.01)
    run.until(lambda: run.session.status()["inputs"][0]["recording"]["error"])
    status = run.session.status()
    assert not status["ok"]
    assert not status["inputs"][0]["recording"]["running"]
    before = len(sink.poses)
    port.send(*LINES)
    run.until(lambda: len(sink.poses) >= before + 19)
    result = run.end()
    assert len(result.recording_errors) == 1
    assert "disk" in result.recording_errors[0] or "space" in result.recording_errors[0]


@pytest.mark.slow
def test_an_error_of_the_recorder_is_in_status_and_result(
    start: Any, port: Any, stream: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from locatk.formats.live.recorded_events import RecordedEvents

    def broken(self: Any) -> Any:
        raise ValueError("odd")

    monkeypatch.setattr(RecordedEvents, "take", broken)
    run = start(output=tmp_path / "run.mcap")
    run.until(run.ready.is_set)
    run.until(lambda: run.session.status()["inputs"][0]["recording"]["error"])
    assert not run.session.status()["ok"]
    port.send(*LINES)
    run.until(lambda: stream.samples >= 19)
    assert run.end().recording_errors == ["ValueError: odd"]


@pytest.mark.parametrize("place", ["push", "finish"])
@pytest.mark.slow
def test_an_error_of_the_solver_leaves_a_finished_recording(
    start: Any, port: Any, stream: Any, sink: Any, tmp_path: Path, raw_bytes: Any, place: str
) -> None:
    """It is raised, and the solver is not called again."""
    calls = []

    def fail() -> None:
        calls.append(1)
        if len(calls) >= 5:
            raise ZeroDivisionError("in the filter")

    def finish() -> list[Any]:
        calls.append(2)
        raise ZeroDivisionError("in the filter")

    stream.on_push = fail if place == "push" else stream.on_push
    stream.finish = finish if place == "finish" else stream.finish
    path = tmp_path / "run.mcap"
    run = start(output=path)
    port.send(*LINES)
    port.end()
    with pytest.raises(ZeroDivisionError):
        run.result()
    assert len(calls) == (5 if place == "push" else 1)
    assert sink.closed == 1
    assert port.closed == 1
    assert_all_lines(path, raw_bytes)


# ---- time


@pytest.mark.slow
def test_the_stream_learns_only_of_times_whose_data_are_decoded(
    start: Any, port: Any, stream: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A solver that is slow has data waiting when it is told how much time has passed."""
    monkeypatch.setattr(live_session, "ARRIVAL_DELAY_NS", 20_000_000)
    stream.on_push = lambda: time.sleep(0.07)
    run = start()
    for line in LINES[:12]:
        port.send(line)
        time.sleep(0.01)
    run.until(lambda: stream.samples >= 11)
    run.end()
    advanced = 0
    for name, time_ns in stream.calls:
        if name == "advance":
            assert time_ns >= advanced
            advanced = time_ns
        elif name == "push":
            assert time_ns >= advanced
    assert advanced


def replay(path: Path, stream: Any, speed: float, *more: CaptureRequest) -> list[tuple[str, int]]:
    """Return the calls of a stream during a replay, without those of single samples."""
    stream.calls.clear()
    stream.samples = 0
    request = CaptureRequest(f"replay:{path}", "locatk", None, speed=speed, keeps_time=True)
    LiveSession(LiveRequest((request, *more)), [], tell=lambda text: None).run(threading.Event())
    return [call for call in stream.calls if call[0] != "push"]


@pytest.mark.slow
def test_a_replay_has_the_time_of_its_recording(stream: Any, live_sessions: Any) -> None:
    """Time passes, and background tasks end, at the same observations whatever the speed."""
    path = live_sessions.raw("polaris")
    odometry = stream.push

    def push(observations: Any) -> Any:
        if hasattr(observations, "position"):
            return odometry(observations)
        stream.samples += len(observations.time_ns)
        return []

    stream.push = push
    results = []
    for speed in (0.0, 4.0):
        stream.task_after = 133
        results.append(replay(path, stream, speed))
    fast = results[0]
    assert results[1] == fast
    assert "complete" in dict(fast)
    assert stream.results == [3, 3]
    times = [time_ns for name, time_ns in fast if name == "advance"]
    span_s = (times[-1] - times[0]) * 1e-9
    assert 3.0 < span_s < 4.5
    assert len(times) > 10 * span_s


def test_events_of_two_replays_are_merged_by_time() -> None:
    from locatk.formats.capture.reader_thread import ReceivedData, SourceEnded
    from locatk.formats.live.inputs import Arrival, RecordedOrder

    def arrival(source: int, time_ns: int) -> Arrival:
        return Arrival(source, ReceivedData(time_ns, b"x", 1), 0.0)

    order = RecordedOrder(2)
    assert not list(order.merge([arrival(0, 1), arrival(0, 5), arrival(0, 9)]))
    merged = list(order.merge([arrival(1, 2), arrival(1, 6)]))
    assert [each.event.time_ns for each in merged] == [1, 2, 5, 6]
    # The end of an input has the time of the clock, which may be later than data of the other.
    merged = list(order.merge([Arrival(1, SourceEnded(99), 0.0), arrival(0, 12)]))
    assert [each.event.time_ns for each in merged] == [99, 9, 12]
    assert len(list(order.merge([Arrival(0, SourceEnded(99), 0.0)]))) == 1


# ---- status


@pytest.mark.slow
def test_the_status_follows_the_connection(start: Any, port: Any, stream: Any, sink: Any) -> None:
    run = start()
    port.send(*LINES[:10])
    run.until(lambda: stream.samples >= 9)
    assert run.session.status()["ok"]
    port.lose()
    run.until(lambda: not run.session.status()["inputs"][0]["connected"])
    assert not run.session.status()["ok"]
    port.is_absent = False
    run.until(lambda: run.session.status()["ok"])
    port.send(*LINES[10:])
    run.until(lambda: stream.samples >= 18)
    run.end()
    texts = [each.event.warning.message for each in sink.messages
             if isinstance(each.event, WarningEvent)]  # fmt: skip
    assert texts == ["connection lost: unplugged", "reconnected to /dev/again"]
    assert any("connection lost" in text for text in run.told)


@pytest.mark.slow
def test_the_status_has_rates_and_no_token(start: Any, port: Any, sink: Any) -> None:
    run = start(token="s3cret-token")
    end = time.monotonic() + 20
    rate = 0.0
    while not rate and time.monotonic() < end:
        port.send(LINES[0])
        time.sleep(0.02)
        devices = run.session.status()["devices"]
        rate = devices["robot"]["rate_hz"] if devices else 0.0
    assert 5 < rate < 120  # A pose by the fix, and one by odometry, for each line.
    status = run.session.status()
    assert status["devices"]["robot"]["state"] in ("tracking", "dead reckoning")
    assert status["devices"]["robot"]["poses"] == pytest.approx(len(sink.poses), abs=5)
    assert status["inputs"][0]["bytes"] > 0
    assert sink.context.token == "s3cret-token"
    assert "s3cret" not in json.dumps(status)
    assert "s3cret" not in json.dumps(run.end().status)


@pytest.mark.slow
def test_the_status_can_be_asked_by_other_threads(
    start: Any, port: Any, stream: Any, sink: Any
) -> None:
    """Servers ask while devices appear."""
    number = iter(range(10_000))
    push = stream.push

    def new_device(observations: Any) -> Any:
        (fix,) = push(observations)
        from dataclasses import replace

        return [replace(fix, device=f"robot-{next(number)}")]

    stream.push = new_device
    run = start()
    errors: list[BaseException] = []
    over = threading.Event()

    def ask() -> None:
        while not over.is_set():
            try:
                json.dumps(run.session.status())
            except BaseException as error:
                errors.append(error)

    asking = [threading.Thread(target=ask) for _ in range(2)]
    for thread in asking:
        thread.start()
    port.send(*LINES * 4)
    run.until(lambda: stream.samples >= 79)
    over.set()
    for thread in asking:
        thread.join()
    assert not errors
    assert len(run.end().status["devices"]) >= 79


@pytest.mark.slow
def test_the_recording_has_the_poses_and_the_events(
    start: Any, port: Any, sink: Any, tmp_path: Path
) -> None:
    from foxglove_schemas_protobuf.Log_pb2 import Log

    path = tmp_path / "run.mcap"
    run = start(output=path)
    port.send(*LINES)
    port.end()
    run.result()
    session = Session.open(path)
    (track,) = read_live(session)
    assert track.position[:, 0].tolist() == positions(sink.poses)
    logged = [json.loads(log.message) for _, log in session.decoded("/log", Log)
              if log.name == "locatk live"]  # fmt: skip
    assert "state" in {each["type"] for each in logged}


# ---- lateness


def test_a_late_solver_is_reported_once_until_it_has_caught_up() -> None:
    told: list[str] = []
    session = LiveSession(LiveRequest(()), [], tell=told.append)
    session._inputs = [SimpleNamespace(is_paced=True, is_recording=False)]  # type: ignore[list-item]
    now_s = time.monotonic()
    session._loaded_s = now_s
    session._check_lateness(now_s - 1)
    assert not told, "these bytes came while the solver was loaded"
    session._loaded_s = now_s - 10
    session._check_lateness(now_s - 1)
    session._check_lateness(now_s - 1)
    assert len(told) == 1
    assert "behind" in told[0]
    session._check_lateness(time.monotonic())
    session._check_lateness(now_s - 1)
    assert len(told) == 2
