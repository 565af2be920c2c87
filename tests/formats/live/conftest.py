"""A live session with a port, a stream and sinks of the test's own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.streaming.events import BackgroundTask, Fix, PoseEstimate, Stream
from locatk.formats.capture import ports, reader_thread
from locatk.formats.capture.links import LinkEnded, LinkLost, Overruns, SourceError
from locatk.formats.capture.setup import CaptureRequest
from locatk.formats.live import session as live_session
from locatk.formats.live.session import LiveRequest, LiveResult, LiveSession
from locatk.formats.sinks.interface import LiveMessage, SinkContext, SinkStatus

TIMEOUT_S = 8.0
"""Longer than anything here takes."""


class ScriptedPort:
    """Port that sends what a test says."""

    name = "scripted"

    def __init__(self) -> None:
        self.can_reconnect = True
        self.is_absent = False
        self.opened = self.closed = 0
        self._coming: queue.Queue[Any] = queue.Queue()

    def open(self) -> ScriptedPort:
        if self.is_absent:
            raise SourceError("no such port", file=self.name)
        self.opened += 1
        return self

    def send(self, *lines: str) -> None:
        """Let each of the next reads return a line."""
        for line in lines:
            self._coming.put(line.encode() + b"\n")

    def lose(self) -> None:
        """Break the connection, and keep it away."""
        self.is_absent = True
        self._coming.put(LinkLost("unplugged"))

    def end(self) -> None:
        """End after what was sent."""
        self._coming.put(LinkEnded("the end"))

    def read(self, wait_s: float) -> bytes:
        try:
            item = self._coming.get(timeout=wait_s) if wait_s else self._coming.get_nowait()
        except queue.Empty:
            return b""
        if isinstance(item, Exception):
            raise item
        return bytes(item)

    def overruns(self) -> Overruns | None:
        return None

    def describe(self) -> dict[str, str]:
        return {"port": self.name, "resolved": "/dev/again"}

    def close(self) -> None:
        self.closed += 1


class ListStream(Stream):
    """Stream that returns a fix for each sample of odometry, and keeps its calls."""

    system = "landmarks"

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []
        self.samples = 0
        self.on_push: Callable[[], None] = lambda: None
        self.task_after: int | None = None
        self.results: list[Any] = []

    def push(self, observations: Any) -> list[Fix]:
        self.on_push()
        self.samples += 1
        time_ns = int(observations.time_ns[0])
        self.calls.append(("push", time_ns))
        position = observations.position[0]
        covariance = 1e-4 * np.eye(6)
        return [Fix(observations.device, "f", time_ns, position, np.eye(4)[3], covariance)]

    def advance(self, time_ns: int) -> list[Fix]:
        self.calls.append(("advance", time_ns))
        return []

    def finish(self) -> list[Fix]:
        self.calls.append(("finish", 0))
        return []

    def background_task(self) -> BackgroundTask | None:
        if self.task_after is None or self.samples < self.task_after:
            return None
        self.task_after = None
        return BackgroundTask("sum", sum, ([1, 2],))

    def complete(self, task: BackgroundTask, result: Any) -> list[Fix]:
        self.calls.append(("complete", self.samples))
        self.results.append(result)
        return []


class ListSink:
    """Sink that keeps its messages."""

    def __init__(self, address: str = "list:") -> None:
        self.address = address
        self.messages: list[LiveMessage] = []
        self.context: SinkContext | None = None
        self.closed = 0

    def open(self, context: SinkContext) -> None:
        self.context = context

    def offer(self, message: LiveMessage) -> None:
        self.messages.append(message)

    def status(self) -> SinkStatus:
        return SinkStatus(len(self.messages), address=self.address)

    def close(self, timeout_s: float) -> None:
        self.closed += 1

    @property
    def poses(self) -> list[PoseEstimate]:
        return [each.event for each in self.messages if isinstance(each.event, PoseEstimate)]


class Running:
    """A live session in a thread of its own."""

    def __init__(self, request: LiveRequest, sinks: list[Any]) -> None:
        self.told: list[str] = []
        self.session = LiveSession(request, sinks, tell=self.told.append)
        self.stop = threading.Event()
        self.ready = threading.Event()
        self._result: LiveResult | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="test-session")
        self._thread.start()

    def _run(self) -> None:
        try:
            self._result = self.session.run(self.stop, ready=self.ready.set)
        except BaseException as error:
            self._error = error

    def until(self, condition: Callable[[], Any]) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < end, self.told
            assert self._thread.is_alive() or condition(), repr(self._error)
            time.sleep(0.005)

    def result(self) -> LiveResult:
        """Wait for the end; return the result, or raise the error of the session."""
        self._thread.join(TIMEOUT_S)
        assert not self._thread.is_alive(), "the session does not end"
        if self._error is not None:
            raise self._error
        assert self._result is not None
        return self._result

    def end(self) -> LiveResult:
        """Stop it; return the result."""
        self.stop.set()
        return self.result()


@pytest.fixture
def port() -> ScriptedPort:
    return ScriptedPort()


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> ListStream:
    """The stream of all sessions."""
    stream = ListStream()
    monkeypatch.setattr(live_session, "create_stream", lambda *given: (stream, {}))
    monkeypatch.setattr(live_session, "system_of_artifacts", lambda texts: stream.system)
    return stream


@pytest.fixture
def sink() -> ListSink:
    return ListSink()


@pytest.fixture(name="ListSink")
def list_sink() -> type[ListSink]:
    return ListSink


@pytest.fixture
def start(
    port: ScriptedPort, stream: ListStream, sink: ListSink, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Running]]:
    """``start(output=path, sinks=[...])`` localizes the device at the port; no thread is left."""
    monkeypatch.setattr(ports, "port_of", lambda *args, **more: port)
    monkeypatch.setattr(reader_thread, "BACKOFF_S", (0.01, 0.02))
    running: list[Running] = []

    def begin(*, sinks: Any = (), output: Path | None = None, token: str | None = None) -> Running:
        request = CaptureRequest("scripted", "lines", output, columns=("x_m", "y_m", "heading_rad"))
        running.append(Running(LiveRequest((request,), token=token), [sink, *sinks]))
        return running[-1]

    yield begin
    for each in running:
        each.stop.set()
        each._thread.join(TIMEOUT_S)
    left = [each.name for each in threading.enumerate() if each.name.startswith("locatk-re")]
    assert not left
