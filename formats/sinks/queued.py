"""Base of sinks that send in a thread of their own, with a bounded queue."""

from __future__ import annotations

import threading
import time
from collections import deque

from locatk.core.streaming.events import PoseEstimate
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage, SinkContext, SinkStatus

CAPACITY = 2000
"""Messages that wait before older poses are dropped: 2 s of ten devices at 100 Hz."""

MAX_EVENTS = 1000
"""Messages other than poses that wait before the oldest ones are dropped."""

POLL_S = 0.005
"""Pause before a message is offered again to a receiver that was busy."""

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0
"""Pauses after the first and after many failures; each is twice the one before."""


class Busy(Exception):
    """The receiver cannot take a message now: it is offered again after :data:`POLL_S`."""


class QueuedSink:
    """Sink whose messages are sent by a thread.

    A subclass overrides :meth:`send`, and if it needs them the other methods below. All of them
    except :meth:`prepare` run in the thread and may block.

    Parameters
    ----------
    address : SinkAddress
    target : str
        Where it sends to, for the status. Default: the address without its options.
    """

    def __init__(self, address: SinkAddress, target: str | None = None) -> None:
        self.address = address.public_text
        self.context = SinkContext("")
        self.clients: int | None = None
        self._target = self.address.partition("?")[0] if target is None else target
        self._pending: deque[LiveMessage] = deque()
        self._limit = CAPACITY
        self._wake = threading.Condition()
        self._is_waiting = False
        self._is_woken = False
        self._is_closing = False
        self._deadline_s = float("inf")
        self._thread: threading.Thread | None = None
        self._sent = self._dropped = 0
        self._error = ""

    # ---- for subclasses

    def prepare(self) -> None:
        """Check and import what is needed, in the thread of the caller.

        Raises
        ------
        LocatkError
            The sink cannot start.
        """

    def start(self) -> None:
        """Connect to the receiver. After an exception it is called again, with growing pauses."""

    def send(self, message: LiveMessage) -> int:
        """Send a message and return how many were sent: 0 if it is not for this receiver.

        Raises
        ------
        Busy
            The receiver cannot take it now.
        OSError
            It could not be sent. It is tried again, with growing pauses, unless it is a pose of
            which a newer one waits.
        Exception
            It cannot be sent at all, and is dropped.
        """
        raise NotImplementedError

    def tick(self) -> float | None:
        """Do what is due without a message; return the time until the next call [s]."""
        return None

    def stop(self) -> None:
        """Disconnect, at the end; also if :meth:`start` failed."""

    def count(self, *, sent: int = 0, dropped: int = 0) -> None:
        """Add to the counts of the status."""
        with self._wake:
            self._sent += sent
            self._dropped += dropped

    def wake(self) -> None:
        """Have :meth:`tick` called soon, from any thread."""
        with self._wake:
            self._is_woken = True
            self._wake.notify()

    def report_error(self, error: object) -> None:
        """Set the error of the status, in one line; ``""`` if the sink works again."""
        text = getattr(error, "strerror", None) or str(error)
        if isinstance(error, Exception):
            text = text or type(error).__name__
        self._error = " ".join(text.split())

    # ---- contract of sinks

    def open(self, context: SinkContext) -> None:
        """Start; see :class:`.interface.Sink`."""
        self.context = context
        self.prepare()
        name = f"sink {self.address.partition(':')[0]}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def offer(self, message: LiveMessage) -> None:
        """Take a message; see :class:`.interface.Sink`."""
        with self._wake:
            if self._is_closing:
                self._dropped += 1
                return
            self._pending.append(message)
            if len(self._pending) > self._limit:
                self._thin()
            if self._is_waiting:
                self._is_waiting = False
                self._wake.notify()

    def status(self) -> SinkStatus:
        """Return the present counts."""
        with self._wake:
            return SinkStatus(self._sent, self._dropped, self.clients, self._error, self._target)

    def close(self, timeout_s: float) -> None:
        """Send what is waiting, and stop; see :class:`.interface.Sink`."""
        with self._wake:
            self._is_closing = True
            self._deadline_s = time.monotonic() + timeout_s
            self._wake.notify()
        if self._thread is not None:
            self._thread.join(timeout_s)
        self._drop_pending()

    # ---- the thread

    def _run(self) -> None:
        try:
            if self._attempt_start():
                self._send_all()
        except BaseException as error:  # A panic of a package in Rust is no Exception.
            self.report_error(f"the sink has ended: {type(error).__name__}: {error}")
        finally:
            with self._wake:
                self._is_closing = True
            try:
                self.stop()
            except Exception as error:  # Of any package: the session ends anyway.
                self.report_error(error)
            self._drop_pending()

    def _drop_pending(self) -> None:
        with self._wake:
            self._dropped += len(self._pending)
            self._pending.clear()

    def _attempt_start(self) -> bool:
        """Call :meth:`start` until it succeeds; return False if the sink is closed before."""
        pause_s = FIRST_RETRY_S
        while True:
            try:
                self.start()
            except Exception as error:  # Of any package; the receiver may come later.
                self.report_error(error)
            else:
                if pause_s > FIRST_RETRY_S:
                    self.report_error("")
                return True
            with self._wake:
                self._thin()
                if self._is_closing or self._wake.wait_for(self._closing, pause_s):
                    return False
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    def _send_all(self) -> None:
        """Send messages until the sink is closed and nothing waits, or sending fails."""
        retry_s, is_failing = FIRST_RETRY_S, False
        while True:
            wait_s = self._guarded_tick()
            with self._wake:
                if not self._pending:
                    if self._is_closing:
                        return
                    if not self._is_woken:
                        self._is_waiting = True
                        self._wake.wait(wait_s)
                        self._is_waiting = False
                    self._is_woken = False
                batch, self._pending = self._pending, deque()
                self._limit = CAPACITY
            is_empty = not batch
            try:
                while batch:
                    self._send_one(batch[0])
                    batch.popleft()
            except Busy:
                self._put_back(batch)
                if time.monotonic() > self._deadline_s:
                    return
                time.sleep(POLL_S)
            except OSError as error:
                is_failing = True
                self.report_error(error)
                self._put_back(batch)
                with self._wake:
                    self._thin()
                    if self._is_closing or self._wake.wait_for(self._closing, retry_s):
                        return
                retry_s = min(2 * retry_s, LAST_RETRY_S)
            else:
                if is_failing and not is_empty:
                    retry_s, is_failing = FIRST_RETRY_S, False
                    self.report_error("")

    def _send_one(self, message: LiveMessage) -> None:
        try:
            count = self.send(message)
        except (Busy, OSError):
            raise
        except BaseException as error:  # Such a message would fail again. Panics: see _run().
            self.count(dropped=1)
            self.report_error(error)
        else:
            if count:
                self.count(sent=count)

    def _guarded_tick(self) -> float | None:
        try:
            return self.tick()
        except Exception as error:  # Of any package; the messages may still pass.
            self.report_error(error)
            return FIRST_RETRY_S

    def _closing(self) -> bool:
        return self._is_closing

    def _put_back(self, messages: deque[LiveMessage]) -> None:
        with self._wake:
            messages.extend(self._pending)
            self._pending = messages
            if len(self._pending) > self._limit:
                self._thin()

    def _thin(self) -> None:
        """Drop all poses but the newest of each device, and the oldest events beyond the limit."""
        kept: deque[LiveMessage] = deque()
        devices: set[str] = set()
        events = 0
        for message in reversed(self._pending):
            event = message.event
            if isinstance(event, PoseEstimate):
                if event.device in devices:
                    continue
                devices.add(event.device)
            else:
                if events == MAX_EVENTS:
                    continue
                events += 1
            kept.appendleft(message)
        self._dropped += len(self._pending) - len(kept)
        self._pending = kept
        # With very many devices, thin only after the queue has doubled, or each offer would.
        self._limit = max(CAPACITY, 2 * len(kept))
