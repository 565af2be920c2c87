"""Events for tests of sinks, and functions that wait."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    Correction,
    PoseEstimate,
    StateChange,
    TrackingState,
    WarningEvent,
)
from locatk.formats.sinks.interface import LiveMessage, Sink
from locatk.formats.sinks.queued import Busy, QueuedSink

EPOCH_NS = 1_764_000_000_123_456_789
"""A time in November 2025."""


def pose(index: int = 0, device: str = "robot", **changes: Any) -> PoseEstimate:
    """Return a pose whose x is its index; equal sigmas of 10 mm and 20 mrad."""
    facts: dict[str, Any] = {
        "device": device,
        "frame": "floor",
        "time_ns": EPOCH_NS + index * 10_000_000,
        "position": np.array([float(index), 0.5, 0.25]),
        "quaternion": np.array([0.0, 0.0, math.sin(0.2), math.cos(0.2)]),
        "covariance": np.diag([1e-4, 1e-4, 1e-4, 4e-4, 4e-4, 4e-4]),
    }
    return PoseEstimate(**(facts | changes))


def position_only(index: int = 0, device: str = "diode") -> PoseEstimate:
    """Return the pose of a single photodiode: no orientation."""
    covariance = np.diag([1e-4, 1e-4, 1e-4, math.nan, math.nan, math.nan])
    covariance[3:, :] = covariance[:, 3:] = math.nan
    return pose(index, device, covariance=covariance, quaternion=np.array([0, 0, 0, 1.0]))


def lost(device: str = "robot", reason: str = "no light") -> StateChange:
    """Return the change to the state ``lost``."""
    return StateChange(device, EPOCH_NS, TrackingState.LOST, reason)


def correction(index: int = 0, device: str = "robot") -> Correction:
    """Return a correction whose displacement in x is its index."""
    displacement = np.array([float(index), 0.0, 0.0])
    return Correction(device, EPOCH_NS, displacement, 0.01, "tag 77")


def warning(device: str = "") -> WarningEvent:
    """Return a warning, of no one device unless one is given."""
    return WarningEvent(device, EPOCH_NS, SolverWarning("clock", "the clock jumped"))


def message(event: Any) -> LiveMessage:
    """Return the message of an event that was received now."""
    return LiveMessage(event, time.monotonic())


def offer(sink: Sink, *events: Any) -> None:
    """Offer events to a sink."""
    for event in events:
        sink.offer(message(event))


def wait_for(condition: Callable[[], Any], timeout_s: float = 10.0) -> Any:
    """Return the first true value of ``condition()``; fail after a time."""
    until = time.monotonic() + timeout_s
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.002)


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a port of the loopback interface on which nobody listens."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class GatedSink(QueuedSink):
    """Sink whose receiver is a list, which can be closed, fail and be slow."""

    def __init__(self, address: Any) -> None:
        super().__init__(address)
        self.received: list[Any] = []
        self.gate = threading.Event()
        self.gate.set()
        self.entered = threading.Event()
        self.failure: Exception | None = None
        self.start_failure: Exception | None = None
        self.attempts = 0

    def start(self) -> None:
        if self.start_failure is not None:
            raise self.start_failure

    def send(self, each: LiveMessage) -> int:
        self.attempts += 1
        self.entered.set()
        self.gate.wait()
        if self.failure is not None:
            raise self.failure
        self.received.append(each.event)
        return 1


__all__ = ["Busy"]
