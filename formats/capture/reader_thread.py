"""Thread that only reads the port: received data and events of the line, in their order."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from locatk.formats.capture.clocks import HostClock, ReplayClock
from locatk.formats.capture.links import Link, LinkEnded, LinkLost, Overruns, Port

READ_TIMEOUT_S = 0.1
"""Longest wait for a byte, and so the delay until the end of the recording is noticed."""

MIN_READ_INTERVAL_S = 0.001
"""Shortest time between reads. Timestamps are late by at most this, and a fast line is read in
pieces of some kilobytes instead of single bytes; the smallest buffers of a kernel (4096 bytes)
take 20 ms to overflow at 2 Mbaud."""

BACKOFF_S = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Delays between attempts to reconnect; the last one is repeated."""

MAX_STOP_WAIT_S = 3.0
"""Longest wait for the thread at the end."""

COUNTER_INTERVAL_S = 0.5
"""Interval between reads of the kernel's error counters."""


@dataclass(frozen=True)
class ReceivedData:
    """Result of one read: bytes of a serial line, or frames of a camera."""

    time_ns: int
    data: Any
    size: int


@dataclass(frozen=True)
class ConnectionLost:
    """The connection was lost."""

    time_ns: int
    why: str


@dataclass(frozen=True)
class Reconnected:
    """The port was opened again, perhaps at another path."""

    time_ns: int
    path: str


@dataclass(frozen=True)
class SourceEnded:
    """No more data will come; ``error`` is set if that is unexpected."""

    time_ns: int
    error: str | None = None


Event = ReceivedData | ConnectionLost | Reconnected | SourceEnded


class PortReader:
    """Reads a port in a thread of its own, and reconnects when the connection is lost.

    Parameters
    ----------
    port : Port
    link : Link
        The open port.
    clock : HostClock
    max_waiting_bytes : int
        When so many bytes wait to be written, reading stops until there is space: then the buffers
        of the system fill up, and count their losses.
    deliver : callable, optional
        Takes each event in the thread of the reader, as soon as it is there and before
        :meth:`take` returns it. It must not raise; reading waits for it.
    """

    def __init__(
        self,
        port: Port,
        link: Link,
        clock: HostClock,
        *,
        max_waiting_bytes: int = 64 << 20,
        deliver: Callable[[Event], None] | None = None,
    ) -> None:
        self._port, self._clock = port, clock
        self._link: Link | None = link
        self._max_waiting = max_waiting_bytes
        self._deliver = deliver
        self._is_kept = True
        self._events: deque[Event] = deque()
        self._stop = threading.Event()
        self._attempts = 0
        self.received = 0
        """Bytes so far."""
        self.last_data_ns = 0
        """When the last of them were read."""
        self._taken = 0
        self._overruns_before = Overruns()  # Of links closed before.
        self._overruns_now = Overruns()
        self._dropped_before = self._dropped = 0
        self.high_water = 0
        self.pauses = 0
        """How often reading stopped because too much was waiting."""
        self._thread = threading.Thread(target=self._run, name="locatk-reader", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> bool:
        """Read the bytes that have arrived, close the port and end the thread.

        Return False if the thread hangs in a driver; the thread is then left running.
        """
        if not self._stop.is_set():
            self._stop.set()
            cancel = getattr(self._port, "cancel", None)
            if cancel is not None:  # Opening it may take longer than the wait below.
                cancel()
            if self._thread.ident is None:
                self._thread.start()  # Only the thread reads and closes the port.
            self._thread.join(MAX_STOP_WAIT_S)
        return not self._thread.is_alive()

    def take(self) -> Sequence[Event]:
        """Return all events since the last call."""
        events = [self._events.popleft() for _ in range(len(self._events))]
        self._taken += sum(event.size for event in events if isinstance(event, ReceivedData))
        return events

    def discard(self) -> None:
        """Keep no more events for :meth:`take`, because they are only delivered."""
        self._is_kept = False
        self.take()

    def _add(self, event: Event) -> None:
        if self._deliver is not None:
            self._deliver(event)
        if self._is_kept:
            self._events.append(event)
        elif isinstance(event, ReceivedData):
            self._taken += event.size

    @property
    def overruns(self) -> Overruns:
        """Error counters of the kernel, summed over all links."""
        before, now = self._overruns_before, self._overruns_now
        return Overruns(
            before.overrun + now.overrun,
            before.buffer + now.buffer,
            before.frame + now.frame,
            before.parity + now.parity,
        )

    @property
    def dropped(self) -> int:
        """Frames of a camera that arrived faster than they were taken."""
        return self._dropped_before + self._dropped

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:  # Any error of a driver must be reported.
            self._add(SourceEnded(self._clock.now(), f"{type(error).__name__}: {error}"))
        finally:
            self._close()

    def _receive(self) -> None:
        counted = 0.0
        while not self._stop.is_set():
            start = time.monotonic()
            try:
                self._read(READ_TIMEOUT_S)
            except LinkEnded:
                self._add(SourceEnded(self._clock.now()))
                return
            except LinkLost as lost:
                self._close()
                if not self._port.can_reconnect:
                    self._add(SourceEnded(self._clock.now(), str(lost)))
                    return
                self._add(ConnectionLost(self._clock.now(), str(lost)))
                if not self._reopen():
                    return
                path = self._port.describe().get("resolved", self._port.name)
                self._add(Reconnected(self._clock.now(), path))
                continue
            while self.received - self._taken > self._max_waiting and not self._stop.is_set():
                self.pauses += 1
                self._stop.wait(0.05)
            if start - counted > COUNTER_INTERVAL_S:
                counted = start
                self._count()
            remaining = start + MIN_READ_INTERVAL_S - time.monotonic()
            if remaining > 0 and self._port.can_reconnect:  # A replayed source has its own pace.
                time.sleep(remaining)
        self._read_remaining()

    def _read(self, wait_s: float) -> int:
        assert self._link is not None
        data = self._link.read(wait_s)
        if not data:
            return 0
        self._attempts = 0
        size = len(data) if isinstance(data, bytes) else sum(item.size for item in data)
        recorded_ns: int | None = getattr(self._link, "time_ns", None)
        if recorded_ns is not None and isinstance(self._clock, ReplayClock):
            self._clock.set(recorded_ns)
        self.last_data_ns = self._clock.now() if recorded_ns is None else recorded_ns
        self.received += size
        self._add(ReceivedData(self.last_data_ns, data, size))
        self.high_water = max(self.high_water, self.received - self._taken)
        return size

    def _read_remaining(self) -> None:
        """Read the bytes that the system still holds, for a limited time."""
        until = time.monotonic() + READ_TIMEOUT_S
        try:
            while time.monotonic() < until and self._read(0.0):
                pass
        except (LinkEnded, LinkLost):
            return

    def _reopen(self) -> bool:
        # The count continues over links that break before any data arrive.
        while not self._stop.wait(BACKOFF_S[min(self._attempts, len(BACKOFF_S) - 1)]):
            self._attempts += 1
            try:
                self._link = self._port.open()
                return True
            except Exception:  # Not available yet, or its driver is not ready.
                continue
        return False

    def _count(self) -> None:
        if self._link is not None:
            self._overruns_now = self._link.overruns() or self._overruns_now
            self._dropped = getattr(self._link, "dropped", 0)

    def _close(self) -> None:
        if self._link is not None:
            self._count()
            self._overruns_before, self._overruns_now = self.overruns, Overruns()
            self._dropped_before, self._dropped = self.dropped, 0
            self._link.close()
            self._link = None
