"""The thread that reads the port, and nothing else: bytes and what happens to the line, in
the order in which they came."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.links import Link, LinkEnded, LinkLost, Overruns, Port

READ_TIMEOUT_S = 0.1
"""Longest wait for a byte: so long it takes to notice that the recording is over."""

MIN_READ_INTERVAL_S = 0.001
"""Shortest time between reads. A stamp is late by no more, and a fast line is read in pieces
of some kilobytes instead of byte by byte; the smallest buffers of a kernel (4096 bytes) take
20 ms to overflow at 2 Mbaud."""

BACKOFF_S = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Between attempts to open a port again; the last one is repeated."""

MAX_STOP_WAIT_S = 3.0
"""Longest wait for the thread at the end."""

COUNTER_INTERVAL_S = 0.5
"""Between looks at the kernel's counters."""


@dataclass(frozen=True)
class ReceivedData:
    """What one read gave: bytes of a serial line, or frames of a camera."""

    time_ns: int
    data: Any
    size: int


@dataclass(frozen=True)
class ConnectionLost:
    """The connection broke."""

    time_ns: int
    why: str


@dataclass(frozen=True)
class Reconnected:
    """It is there again, perhaps elsewhere."""

    time_ns: int
    where: str


@dataclass(frozen=True)
class SourceEnded:
    """Nothing more will come; ``error`` where that is not as it should be."""

    time_ns: int
    error: str | None = None


Event = ReceivedData | ConnectionLost | Reconnected | SourceEnded


class PortReader:
    """Reads a port in a thread of its own and opens it again when it was lost.

    Parameters
    ----------
    port : Port
    link : Link
        The port, opened.
    clock : HostClock
    max_waiting_bytes : int
        When so many wait to be written, reading stops until there is room: the system's own
        buffers then fill, and count what they lose.
    """

    def __init__(
        self, port: Port, link: Link, clock: HostClock, *, max_waiting_bytes: int = 64 << 20
    ) -> None:
        self._port, self._clock = port, clock
        self._link: Link | None = link
        self._most = max_waiting_bytes
        self._events: deque[Event] = deque()
        self._stop = threading.Event()
        self._attempts = 0
        self.received = 0
        """Bytes so far."""
        self.heard_ns = 0
        """When the last of them were read."""
        self._taken = 0
        self._before = Overruns()  # of links that are closed
        self._now = Overruns()
        self._dropped_before = self._dropped = 0
        self.high_water = 0
        self.held_up = 0
        """How often reading stopped because too much was waiting."""
        self._thread = threading.Thread(target=self._run, name="locatk-receiver", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> bool:
        """Read what has arrived by now, close the port and end the thread; returns whether it
        ended: one that hangs in a driver is left behind."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join(MAX_STOP_WAIT_S)
        return not self._thread.is_alive()

    def take(self) -> Sequence[Event]:
        """All that has happened since the last call."""
        events = [self._events.popleft() for _ in range(len(self._events))]
        self._taken += sum(event.size for event in events if isinstance(event, ReceivedData))
        return events

    @property
    def overruns(self) -> Overruns:
        """What the kernel counted, of all links."""
        before, now = self._before, self._now
        return Overruns(
            before.overrun + now.overrun,
            before.buffer + now.buffer,
            before.frame + now.frame,
            before.parity + now.parity,
        )

    @property
    def dropped(self) -> int:
        """Frames of a camera that came faster than they were taken."""
        return self._dropped_before + self._dropped

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:  # whatever a driver raises must not end in silence
            self._events.append(SourceEnded(self._clock.now(), f"{type(error).__name__}: {error}"))
        finally:
            self._close()

    def _receive(self) -> None:
        counted = 0.0
        while not self._stop.is_set():
            begun = time.monotonic()
            try:
                self._read(READ_TIMEOUT_S)
            except LinkEnded:
                self._events.append(SourceEnded(self._clock.now()))
                return
            except LinkLost as lost:
                self._close()
                if not self._port.can_reconnect:
                    self._events.append(SourceEnded(self._clock.now(), str(lost)))
                    return
                self._events.append(ConnectionLost(self._clock.now(), str(lost)))
                if not self._reopen():
                    return
                where = self._port.describe().get("resolved", self._port.name)
                self._events.append(Reconnected(self._clock.now(), where))
                continue
            while self.received - self._taken > self._most and not self._stop.is_set():
                self.held_up += 1
                self._stop.wait(0.05)
            if begun - counted > COUNTER_INTERVAL_S:
                counted = begun
                self._count()
            left = begun + MIN_READ_INTERVAL_S - time.monotonic()
            if left > 0 and self._port.can_reconnect:  # what is played has its own pace
                time.sleep(left)
        self._read_rest()

    def _read(self, wait_s: float) -> int:
        assert self._link is not None
        data = self._link.read(wait_s)
        if not data:
            return 0
        self._attempts = 0
        size = len(data) if isinstance(data, bytes) else sum(len(frame[1]) for frame in data)
        self.heard_ns = self._clock.now()
        self._events.append(ReceivedData(self.heard_ns, data, size))
        self.received += size
        self.high_water = max(self.high_water, self.received - self._taken)
        return size

    def _read_rest(self) -> None:
        """What the system still holds; from a device that never stops, not for long."""
        until = time.monotonic() + READ_TIMEOUT_S
        try:
            while time.monotonic() < until and self._read(0.0):
                pass
        except (LinkEnded, LinkLost):
            return

    def _reopen(self) -> bool:
        # Counted on over links that break before they gave anything.
        while not self._stop.wait(BACKOFF_S[min(self._attempts, len(BACKOFF_S) - 1)]):
            self._attempts += 1
            try:
                self._link = self._port.open()
                return True
            except Exception:  # not there yet, or a driver that is not ready
                continue
        return False

    def _count(self) -> None:
        if self._link is not None:
            self._now = self._link.overruns() or self._now
            self._dropped = getattr(self._link, "dropped", 0)

    def _close(self) -> None:
        if self._link is not None:
            self._count()
            self._before, self._now = self.overruns, Overruns()
            self._dropped_before, self._dropped = self.dropped, 0
            self._link.close()
            self._link = None
