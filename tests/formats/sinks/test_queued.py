"""Queue of sinks: never blocks, keeps the newest, counts what it drops."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest

from locatk.core.streaming.events import PoseEstimate
from locatk.formats.sinks import queued
from locatk.formats.sinks.addresses import parse_address
from locatk.formats.sinks.interface import SinkContext


@pytest.fixture
def sink(live: ModuleType) -> Any:
    gated = live.GatedSink(parse_address("test://host:1?x=1"))
    yield gated
    gated.gate.set()
    gated.failure = None
    gated.close(5)


def test_all_messages_arrive_in_order(live: ModuleType, sink: Any) -> None:
    sink.open(SinkContext("dots"))
    events = [live.pose(k) if k % 3 else live.correction(k) for k in range(1000)]
    live.offer(sink, *events)
    sink.close(5)
    assert sink.received == events
    status = sink.status()
    assert (status.sent, status.dropped, status.error) == (1000, 0, "")
    assert status.address == "test://host:1"


@pytest.mark.slow
def test_slow_receiver_gets_newest_poses_and_all_events(live: ModuleType, sink: Any) -> None:
    sink.open(SinkContext("dots"))
    sink.gate.clear()
    live.offer(sink, live.pose(0, "first"))
    assert sink.entered.wait(5)
    count = 3 * queued.CAPACITY
    for k in range(count):
        live.offer(sink, live.pose(k, f"robot{k % 2}"))
        if k % 100 == 0:
            live.offer(sink, live.correction(k))
        assert len(sink._pending) <= queued.CAPACITY
    sink.gate.set()
    sink.close(5)
    poses = [each for each in sink.received if isinstance(each, PoseEstimate)]
    events = [each for each in sink.received if not isinstance(each, PoseEstimate)]
    assert len(events) == count // 100
    assert [each.displacement_m[0] for each in events] == list(range(0, count, 100))
    newest = {each.device: each.position[0] for each in poses}
    assert newest == {"first": 0, "robot0": count - 2, "robot1": count - 1}
    status = sink.status()
    assert status.dropped > count // 2
    assert status.sent + status.dropped == 1 + count + count // 100


def test_events_have_a_limit_of_their_own(live: ModuleType, sink: Any) -> None:
    sink.open(SinkContext("dots"))
    sink.gate.clear()
    live.offer(sink, live.pose(0, "first"))
    assert sink.entered.wait(5)
    live.offer(sink, live.pose(7), *(live.correction(k) for k in range(queued.CAPACITY)))
    sink.gate.set()
    sink.close(5)
    received = [each.displacement_m[0] for each in sink.received[2:]]
    assert received == list(range(queued.CAPACITY - queued.MAX_EVENTS, queued.CAPACITY))
    assert sink.received[1].position[0] == 7
    assert sink.status().dropped == queued.CAPACITY - queued.MAX_EVENTS


def test_many_devices_keep_a_pose_each(live: ModuleType, sink: Any) -> None:
    sink.open(SinkContext("dots"))
    sink.gate.clear()
    live.offer(sink, live.pose(0, "first"))
    assert sink.entered.wait(5)
    devices = queued.CAPACITY + 500
    thinned = []
    thin = sink._thin
    sink._thin = lambda: (thinned.append(1), thin())
    for k in range(2):
        live.offer(sink, *(live.pose(k, f"robot{n}") for n in range(devices)))
    assert len(thinned) < 5  # It takes time for so many.
    sink.gate.set()
    sink.close(5)
    assert {each.device for each in sink.received[1:] if each.position[0] == 1} == {
        f"robot{n}" for n in range(devices)
    }


def test_failed_sends_are_tried_again(
    live: ModuleType, sink: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queued, "FIRST_RETRY_S", 0.002)
    sink.failure = ConnectionRefusedError(111, "Connection refused")
    sink.open(SinkContext("dots"))
    live.offer(sink, live.pose(1), live.correction(2), live.pose(3), live.pose(4))
    live.wait_for(lambda: sink.attempts > 2)
    assert sink.status().error == "Connection refused"
    assert sink.status().sent == 0
    sink.failure = None
    live.wait_for(lambda: sink.status().sent >= 2)
    live.wait_for(lambda: sink.status().error == "")
    assert [type(each).__name__ for each in sink.received[-2:]] == ["Correction", "PoseEstimate"]
    assert sink.received[-1].position[0] == 4
    status = sink.status()
    assert status.sent + status.dropped == 4


def test_message_that_cannot_be_sent_is_dropped(live: ModuleType, sink: Any) -> None:
    sink.failure = ValueError("too long\nfor one line")
    sink.open(SinkContext("dots"))
    live.offer(sink, live.correction(1))
    live.wait_for(lambda: sink.status().dropped == 1)
    sink.failure = None
    live.offer(sink, live.correction(2))
    live.wait_for(lambda: sink.received)
    assert sink.status().error == "too long for one line"


def test_busy_receiver_gets_everything_in_order(live: ModuleType, sink: Any) -> None:
    sink.failure = queued.Busy()
    sink.open(SinkContext("dots"))
    events = [live.pose(k) for k in range(20)]
    live.offer(sink, *events)
    live.wait_for(lambda: sink.attempts > 2)
    sink.failure = None
    sink.close(5)
    assert sink.received == events
    assert sink.status().error == ""


def test_order_of_messages_that_come_while_others_are_refused(live: ModuleType, sink: Any) -> None:
    sink.failure = queued.Busy()
    sink.gate.clear()
    sink.open(SinkContext("dots"))
    events = [live.pose(k) for k in range(6)]
    live.offer(sink, *events[:3])
    assert sink.entered.wait(5)
    live.offer(sink, *events[3:])
    sink.gate.set()
    live.wait_for(lambda: sink.attempts > 2)
    sink.failure = None
    sink.close(5)
    assert sink.received == events


def test_no_wake_up_is_missed(live: ModuleType, sink: Any) -> None:
    calls: list[int] = []

    def tick() -> None:
        calls.append(1)
        if len(calls) < 5:
            sink.wake()  # as another thread does before the sink waits

    sink.tick = tick
    sink.open(SinkContext("dots"))
    live.wait_for(lambda: len(calls) == 5)


def test_receiver_that_comes_later(
    live: ModuleType, sink: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queued, "FIRST_RETRY_S", 0.002)
    sink.start_failure = RuntimeError("nobody there")
    sink.open(SinkContext("dots"))
    live.offer(sink, live.correction(1), live.pose(1), live.pose(2))
    live.wait_for(lambda: sink.status().error == "nobody there" and sink.status().dropped)
    sink.start_failure = None
    live.wait_for(lambda: len(sink.received) == 2)
    live.wait_for(lambda: sink.status().error == "")
    assert sink.received[1].position[0] == 2


def test_close_is_limited_in_time_and_counts_the_rest(live: ModuleType, sink: Any) -> None:
    sink.gate.clear()
    sink.open(SinkContext("dots"))
    live.offer(sink, live.pose(0))
    assert sink.entered.wait(5)
    live.offer(sink, *(live.pose(k) for k in range(5)))
    sink.close(0.05)
    assert sink._thread.is_alive()  # close() did not wait for it
    assert sink.status().dropped == 5
    live.offer(sink, live.pose(9))
    assert sink.status().dropped == 6


def test_close_of_a_sink_that_was_never_opened(sink: Any, live: ModuleType) -> None:
    live.offer(sink, live.pose(0))
    sink.close(1)
    assert sink.status().dropped == 1


@pytest.mark.parametrize("failure", [OSError("gone"), queued.Busy()])
def test_close_ends_the_thread_of_a_receiver_that_is_gone(
    live: ModuleType, sink: Any, failure: Exception
) -> None:
    sink.failure = failure
    sink.open(SinkContext("dots"))
    live.offer(sink, live.correction(0))
    sink.close(0.05)
    live.wait_for(lambda: not sink._thread.is_alive())
    assert sink.status().dropped == 1


class Panic(BaseException):
    """Error of a package in Rust."""


def test_a_panic_while_sending_costs_one_message(live: ModuleType, sink: Any) -> None:
    sink.open(SinkContext("dots"))
    sink.failure = Panic("index out of bounds")
    live.offer(sink, live.pose(0))
    live.wait_for(lambda: sink.status().dropped == 1)
    assert "index out of bounds" in sink.status().error
    sink.failure = None
    live.offer(sink, live.pose(1))
    live.wait_for(lambda: sink.status().sent == 1)


def test_a_sink_that_ended_says_so_and_keeps_nothing(live: ModuleType, sink: Any) -> None:
    sink.start_failure = Panic("no memory")
    sink.open(SinkContext("dots"))
    live.wait_for(lambda: "no memory" in sink.status().error)
    live.wait_for(lambda: not sink._thread.is_alive())
    live.offer(sink, live.pose(0), live.pose(1))
    assert sink.status().dropped == 2
    assert not sink._pending
