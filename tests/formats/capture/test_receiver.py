"""The thread that reads: every byte with its time, and what happens to the line."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from locatk.formats.capture import reader_thread as receiver_module
from locatk.formats.capture.camera import Frame
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.links import Overruns, SourceError
from locatk.formats.capture.reader_thread import (
    ConnectionLost,
    Event,
    PortReader,
    ReceivedData,
    Reconnected,
    SourceEnded,
)


@pytest.fixture
def receive(port: Any) -> Iterator[Callable[..., PortReader]]:
    """``receive()`` starts to read the port; it is stopped in the end."""
    made: list[PortReader] = []

    def begin(**more: Any) -> PortReader:
        made.append(PortReader(port, port.open(), HostClock(), **more))
        made[-1].start()
        return made[-1]

    yield begin
    for each in made:
        each.stop()
    assert not [each for each in threading.enumerate() if each.name == "locatk-reader"]


def all_events(receiver: PortReader) -> list[Event]:
    receiver.stop()
    return list(receiver.take())


def kinds(events: list[Event]) -> list[str]:
    return [type(event).__name__ for event in events]


def test_every_read_in_its_order(port: Any, receive: Callable[..., PortReader]) -> None:
    pieces = [bytes([k % 251]) * (k % 7 + 1) for k in range(200)]
    receiver = receive()
    port.send(*pieces)
    events = all_events(receiver)
    assert [event.data for event in events if isinstance(event, ReceivedData)] == pieces
    assert [event.size for event in events if isinstance(event, ReceivedData)] == list(
        map(len, pieces)
    )
    times = [event.time_ns for event in events]
    assert times == sorted(times)
    assert port.links[0].closed


def test_buffered_bytes_are_read_at_the_end(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive()
    waiting, go_on = threading.Event(), threading.Event()

    def hold() -> bytes:
        waiting.set()
        assert go_on.wait(10)
        return b"held"

    port.then(hold)
    assert waiting.wait(10)
    port.send(b"rest", b"and more")
    stopper = threading.Thread(target=receiver.stop)
    stopper.start()
    go_on.set()
    stopper.join()
    assert [event.data for event in receiver.take()] == [b"held", b"rest", b"and more"]


def test_a_device_that_never_stops_is_left(port: Any, receive: Callable[..., PortReader]) -> None:
    sending = True

    def again() -> bytes:
        if sending:
            port.then(again)
        return b"x"

    port.then(again)
    receiver = receive()
    receiver.stop()
    sending = False
    assert port.links[0].closed
    assert receiver.take()


def test_whoever_takes_may_be_there_at_once(port: Any) -> None:
    """Between the moment at which an event is there and the next step of the thread."""
    receiver = PortReader(port, port.open(), HostClock())
    taken: list[Event] = []

    class Eager(deque[Event]):
        def append(self, event: Event) -> None:
            super().append(event)
            taken.extend(receiver.take())

    receiver._events = Eager()
    receiver.start()
    port.send(b"one", b"two")
    port.lose()
    port.send(b"three")
    port.settle()
    receiver.stop()
    assert kinds(taken) == [
        "ReceivedData",
        "ReceivedData",
        "ConnectionLost",
        "Reconnected",
        "ReceivedData",
    ]


def test_lost_and_back(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive()
    port.send(b"before")
    port.lose("pulled out")
    port.settle()
    port.send(b"after")
    port.settle()
    events = all_events(receiver)
    assert kinds(events) == ["ReceivedData", "ConnectionLost", "Reconnected", "ReceivedData"]
    assert isinstance(events[1], ConnectionLost)
    assert events[1].why == "pulled out"
    assert isinstance(events[2], Reconnected)
    assert len(port.links) == 2
    assert [link.closed for link in port.links] == [1, 1]
    times = [event.time_ns for event in events]
    assert times == sorted(times)


def test_it_tries_again_until_the_device_is_there(
    port: Any, receive: Callable[..., PortReader], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receiver_module, "BACKOFF_S", (0.001, 0.002))
    receiver = receive()
    port.refusals = [SourceError("not there") for _ in range(7)]
    port.lose()
    port.settle()
    port.send(b"back")
    port.settle()
    assert kinds(all_events(receiver)) == ["ConnectionLost", "Reconnected", "ReceivedData"]
    assert port.asked == 9


def test_the_name_of_the_place_is_that_of_now(
    port: Any, receive: Callable[..., PortReader]
) -> None:
    """A device that comes back under another name is said to be there."""
    receiver = receive()
    port.known = {"resolved": "/dev/ttyACM7"}
    port.lose()
    port.settle()
    port.send(b"x")
    port.settle()
    back = all_events(receiver)[1]
    assert isinstance(back, Reconnected)
    assert "/dev/ttyACM7" in back.path


def test_the_end_while_the_device_is_away(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive()
    port.refusals = [SourceError("not there") for _ in range(10_000)]
    port.lose()
    port.settle()
    assert kinds(all_events(receiver)) == ["ConnectionLost"]
    assert port.links[0].closed


def test_a_link_that_breaks_whenever_it_is_opened_is_not_tried_for_ever_at_once(
    port: Any, receive: Callable[..., PortReader], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wait between attempts begins anew only after something was received."""
    waits: list[float] = []
    real = threading.Event.wait

    def wait(self: threading.Event, timeout: float | None = None) -> bool:
        if threading.current_thread().name == "locatk-reader" and timeout in (1, 2, 3, 4):
            waits.append(timeout)
            timeout = 0.001
        return real(self, timeout)

    monkeypatch.setattr(receiver_module, "BACKOFF_S", (1, 2, 3, 4))
    monkeypatch.setattr(threading.Event, "wait", wait)
    receiver = receive()
    for _ in range(6):
        port.lose()
    port.settle()
    port.send(b"x")
    port.lose()
    port.settle()
    receiver.stop()
    assert waits[:7] == [1, 2, 3, 4, 4, 4, 1]


def test_a_port_that_cannot_reconnect_has_ended(
    port: Any, receive: Callable[..., PortReader]
) -> None:
    port.can_reconnect = False
    receiver = receive()
    port.send(b"x")
    port.lose("cut short")
    port.settle()
    events = all_events(receiver)
    assert kinds(events) == ["ReceivedData", "SourceEnded"]
    assert isinstance(events[1], SourceEnded)
    assert events[1].error == "cut short"
    assert port.asked == 1


def test_the_end_of_the_source(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive()
    port.send(b"x")
    port.end()
    port.settle()
    events = all_events(receiver)
    assert kinds(events) == ["ReceivedData", "SourceEnded"]
    assert isinstance(events[1], SourceEnded)
    assert events[1].error is None
    assert port.links[0].closed


def test_any_exception_of_a_driver_is_reported(
    port: Any, receive: Callable[..., PortReader]
) -> None:
    def fail() -> bytes:
        raise RuntimeError("driver gone mad")

    receiver = receive()
    port.send(b"x")
    port.then(fail)
    port.settle()
    events = all_events(receiver)
    assert kinds(events) == ["ReceivedData", "SourceEnded"]
    assert isinstance(events[1], SourceEnded)
    assert events[1].error == "RuntimeError: driver gone mad"
    assert port.links[0].closed


def test_a_port_that_cannot_be_opened_again_for_an_unforeseen_reason(
    port: Any, receive: Callable[..., PortReader], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be another the next time: a recording does not end for it."""
    monkeypatch.setattr(receiver_module, "BACKOFF_S", (0.001,))
    receiver = receive()
    port.refusals = [OSError(5, "Input/output error"), ValueError("not a port")]
    port.lose()
    port.settle()
    port.send(b"x")
    port.settle()
    assert kinds(all_events(receiver)) == ["ConnectionLost", "Reconnected", "ReceivedData"]


# ---- too much


@pytest.mark.slow
def test_a_full_queue_pauses_reading(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive(max_waiting_bytes=1000)
    port.send(*[bytes(100)] * 50)
    held = threading.Event()
    while not receiver.pauses:
        held.wait(0.001)
    first = receiver.take()
    assert sum(event.size for event in first if isinstance(event, ReceivedData)) == 1100
    taken = 1100
    while taken < 5000:
        taken += sum(event.size for event in receiver.take() if isinstance(event, ReceivedData))
    assert taken == 5000
    assert receiver.high_water == 1100


def test_it_can_be_stopped_while_it_waits(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive(max_waiting_bytes=10)
    port.send(*[bytes(100)] * 5)
    while not receiver.pauses:
        threading.Event().wait(0.001)
    events = all_events(receiver)
    assert sum(event.size for event in events if isinstance(event, ReceivedData)) == 500


def test_frames_of_a_camera_count_by_their_pictures(
    port: Any, receive: Callable[..., PortReader]
) -> None:
    receiver = receive()
    port.then(lambda: [Frame(1, b"abc", 1, 1), Frame(2, b"defgh", 1, 1)])
    port.settle()
    (event,) = all_events(receiver)
    assert isinstance(event, ReceivedData)
    assert event.size == 8


# ---- what the kernel counts


def test_overruns_of_all_links(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive()
    port.links[0].counted = Overruns(overrun=2, buffer=3, frame=5, parity=7)
    port.lose()
    port.settle()
    port.send(b"x")
    port.settle()
    port.links[1].counted = Overruns(overrun=10, buffer=20, frame=30, parity=40)
    receiver.stop()
    assert receiver.overruns == Overruns(overrun=12, buffer=23, frame=35, parity=47)
    assert receiver.overruns.lost == 35


def test_overruns_are_counted_once_though_the_device_is_away(
    port: Any, receive: Callable[..., PortReader]
) -> None:
    receiver = receive()
    port.links[0].counted = Overruns(overrun=7)
    port.refusals = [SourceError("not there") for _ in range(10_000)]
    port.lose()
    port.settle()
    receiver.stop()
    assert receiver.overruns == Overruns(overrun=7)


def test_no_overrun_counters(port: Any, receive: Callable[..., PortReader]) -> None:
    receiver = receive()
    port.send(b"x")
    receiver.stop()
    assert receiver.overruns == Overruns()
