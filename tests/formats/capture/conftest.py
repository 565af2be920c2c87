"""A port of the test's own, and recordings of it that leave nothing behind."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from locatk.formats.capture import ports, reader_thread, recorder
from locatk.formats.capture import setup as session
from locatk.formats.capture.links import LinkEnded, LinkLost, Overruns
from locatk.formats.capture.recorder import Limits
from locatk.formats.capture.status import CaptureStatus, RecordingResult
from locatk.formats.sessions.reader import Session

READ_TIMEOUT_S = 20.0
"""Longer than anything here takes; a test that waits for it has failed."""


class ScriptedPort:
    """Gives what it was sent, in the same pieces, and breaks when it is told to."""

    name = "scripted"

    def __init__(self) -> None:
        self.can_reconnect = True
        self.refusals: list[Exception] = []
        """What the next attempts to open it raise."""
        self.asked = 0
        self.links: list[ScriptedLink] = []
        self.known: dict[str, str] = {}
        self._coming: queue.Queue[Any] = queue.Queue()

    def open(self) -> ScriptedLink:
        self.asked += 1
        if self.refusals:
            raise self.refusals.pop(0)
        self.links.append(ScriptedLink(self._coming))
        return self.links[-1]

    def describe(self) -> dict[str, str]:
        return self.known

    def send(self, *pieces: bytes) -> None:
        """Let reads give these, one each."""
        for piece in pieces:
            self._coming.put(piece)

    def lose(self, why: str = "unplugged") -> None:
        """Break the connection after what was sent."""
        self._coming.put(LinkLost(why))

    def end(self) -> None:
        """Come to the end after what was sent."""
        self._coming.put(LinkEnded("the end"))

    def then(self, act: Callable[[], bytes]) -> None:
        """Let a read do this."""
        self._coming.put(act)

    def settle(self) -> None:
        """Wait until all that was sent has been read."""
        with self._coming.all_tasks_done:
            done = self._coming.all_tasks_done.wait_for(
                lambda: not self._coming.unfinished_tasks, READ_TIMEOUT_S
            )
        assert done, "what was sent was not read"


class ScriptedLink:
    """One opening of a :class:`ScriptedPort`."""

    def __init__(self, coming: queue.Queue[Any]) -> None:
        self._coming = coming
        self.counted: Overruns | None = None
        self.closed = 0

    def read(self, wait_s: float) -> bytes:
        assert not self.closed, "a link that is closed was read"
        try:
            item = self._coming.get(timeout=wait_s) if wait_s else self._coming.get_nowait()
        except queue.Empty:
            return b""
        try:
            if isinstance(item, Exception):
                raise item
            return item() if callable(item) else item
        finally:
            self._coming.task_done()

    def overruns(self) -> Overruns | None:
        return self.counted  # of a closed one too, as a serial port's

    def close(self) -> None:
        self.closed += 1


class Running:
    """A recording in a thread of its own.

    Attributes
    ----------
    said : list of str
        What was told.
    shown : list of CaptureStatus
    """

    def __init__(self, wanted: session.CaptureRequest) -> None:
        self.wanted = wanted
        self.stop = threading.Event()
        self.opened = threading.Event()
        self.said: list[str] = []
        self.shown: list[CaptureStatus] = []
        self.when_shown: Callable[[], None] = lambda: None
        self._news = threading.Condition()
        self._recorded: RecordingResult | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="test-recording")
        self._thread.start()

    def _run(self) -> None:
        try:
            self._recorded = session.record(
                self.wanted,
                self.stop,
                tell=lambda text: self._note(self.said, text),
                show=lambda status: self._note(self.shown, status),
                ready=lambda port: self.opened.set(),
            )
        except BaseException as error:
            self._error = error
        finally:
            self.opened.set()
            with self._news:
                self._news.notify_all()

    def _note(self, where: list[Any], what: object) -> None:
        with self._news:
            where.append(what)
            self._news.notify_all()
        if where is self.shown:
            self.when_shown()

    def until(self, condition: Callable[[], object]) -> None:
        """Wait until it holds; looked at whenever something is told or shown."""
        with self._news:
            held = self._news.wait_for(
                lambda: condition() or not self._thread.is_alive() or self._error, READ_TIMEOUT_S
            )
        assert held, f"did not come about; told: {self.said}"
        assert condition(), f"did not come about; told: {self.said}, {self._error!r}"

    def wait_for_message(self, words: str) -> None:
        """Wait until somebody is told this."""
        self.until(lambda: any(words in text for text in self.said))

    def result(self) -> RecordingResult:
        """Wait for the end and give what came of it, or raise what it raised."""
        self._thread.join(READ_TIMEOUT_S)
        assert not self._thread.is_alive(), "the recording does not end"
        if self._error is not None:
            raise self._error
        assert self._recorded is not None
        return self._recorded

    def end(self) -> RecordingResult:
        """Stop it, then :meth:`result`."""
        self.stop.set()
        return self.result()


@pytest.fixture
def port() -> ScriptedPort:
    """A port that does what the test says."""
    return ScriptedPort()


@pytest.fixture
def start(
    port: ScriptedPort, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Running]]:
    """``start("raw", duration_s=1, name="red")`` records the port to ``run.mcap``; the names of
    limits are theirs, all others those of what is wanted. Nothing may be left afterwards."""
    monkeypatch.setattr(ports, "port_of", lambda *args, **more: port)
    monkeypatch.setattr(recorder, "STATUS_INTERVAL_S", 0.02)  # instead of a second
    monkeypatch.setattr(reader_thread, "BACKOFF_S", (0.01, 0.02))
    before = _left()
    running: list[Running] = []

    def begin(device: str = "raw", **given: Any) -> Running:
        limits = {key: given.pop(key) for key in list(given) if key in Limits.__annotations__}
        given.setdefault("output", tmp_path / "run.mcap")
        wanted = session.CaptureRequest("scripted", device, limits=Limits(**limits), **given)
        running.append(Running(wanted))
        assert running[-1].opened.wait(READ_TIMEOUT_S)
        return running[-1]

    yield begin
    for each in running:
        each.stop.set()
        with contextlib.suppress(BaseException):
            each.result()
    left = _left_after(before)
    assert not left, f"left behind: {left}"


def _left() -> set[str]:
    """Threads of locatk and open files."""
    threads = {thread.name for thread in threading.enumerate() if "locatk" in thread.name}
    files = set()
    with contextlib.suppress(OSError):
        for number in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                files.add(f"{number}: {os.readlink(f'/proc/self/fd/{number}')}")
    return threads | {file for file in files if ".mcap" in file or "pts" in file}


def _left_after(before: set[str]) -> set[str]:
    """What is there that was not; a daemon thread that was told to end has a moment."""
    until = time.monotonic() + 5.0
    while (left := _left() - before) and time.monotonic() < until:
        time.sleep(0.02)
    return left


@pytest.fixture
def log_lines() -> Callable[..., list[str]]:
    """``log_lines(path)``: texts of ``/log``."""
    from foxglove_schemas_protobuf.Log_pb2 import Log

    def lines(*paths: Path) -> list[str]:
        return [
            line.message for path in paths for _, line in Session.open(path).decoded("/log", Log)
        ]

    return lines
