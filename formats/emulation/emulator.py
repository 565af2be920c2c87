"""Sends what a device would send, when it would, to whoever has its port open.

As a real device it does not wait: what is due while nobody listens, or while the reader does
not read, is lost. All that is lost is counted.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass

from locatk.formats.emulation.byte_stream import LARGEST, Faults, Pace
from locatk.formats.emulation.pseudo_terminal import PseudoPort, Terminal

TICK_S = 0.004
"""Shortest time between two writes: 12 kB at 3 MB/s, where the kernel holds 20 kB."""

LOOK_S = 0.01
"""Longest time between two looks whether the reader is there."""

SETTLE_S = 0.2
"""A reader counts as listening from so long after it opened the port: until then it sets it
up, and throws away what has arrived (pyserial does)."""

PATIENCE_S = 1.0
"""For so long a reader may be busy before bytes are lost; then they are, until it has caught
up. The kernel holds 20 kB; what is more waits here."""

END_S = 10.0
"""For so long the last bytes wait for the reader."""

LAST_S = 0.1
"""For so long they do when it is unplugged or stopped."""


@dataclass(frozen=True)
class Plan:
    """How it behaves.

    Attributes
    ----------
    wait : bool
        Start when the port is first opened, instead of at once.
    lossless : bool
        Wait for the reader whenever it does not read, as no real device does.
    unplug_every_s : float or None
        For how long it is plugged in at a time; None for ever.
    away_s : float
        For how long it is not, each time.
    settle_s, patience_s, end_s : float
        :data:`SETTLE_S`, :data:`PATIENCE_S` and :data:`END_S`.
    """

    wait: bool = True
    lossless: bool = False
    unplug_every_s: float | None = None
    away_s: float = 1.0
    settle_s: float = SETTLE_S
    patience_s: float = PATIENCE_S
    end_s: float = END_S


@dataclass
class Totals:
    """What became of the bytes; those made are the sum of those sent, dropped and lost.

    Attributes
    ----------
    made : int
        The device had to send.
    sent : int
        The reader got.
    dropped : int
        Lost as a fault of the line.
    unheard : int
        Lost while it was unplugged or nobody listened, or not read when that came.
    overrun : int
        Lost because the reader did not read in time.
    flipped : int
        Bits that turned over, in bytes that were lost afterwards too.
    unplugs : int
        How often it was unplugged.
    """

    made: int = 0
    sent: int = 0
    dropped: int = 0
    unheard: int = 0
    overrun: int = 0
    flipped: int = 0
    unplugs: int = 0

    def as_dict(self) -> dict[str, int]:
        """For JSON."""
        return asdict(self)


class Emulator:
    """One device on one port.

    Parameters
    ----------
    port : PseudoPort
    pace : Pace
        What it sends, and when.
    faults : Faults, optional
        None by default.
    plan : Plan, optional
    """

    def __init__(
        self,
        port: PseudoPort,
        pace: Pace,
        faults: Faults | None = None,
        plan: Plan | None = None,
    ) -> None:
        self._port = port
        self._pace = pace
        self._faults = faults or Faults()
        self._plan = plan or Plan()
        self._totals = Totals()
        self._pending = bytearray()
        self._opened_s: float | None = None
        self._stuck_s: float | None = None
        self._change_s = self._plan.unplug_every_s or math.inf
        self._start_s = 0.0
        self._stopped = False

    def stop(self) -> None:
        """Let :meth:`run` end soon, also from a signal handler or another thread."""
        self._stopped = True

    @property
    def totals(self) -> Totals:
        """What became of the bytes so far."""
        faults, totals = self._faults, self._totals
        totals.dropped, totals.flipped = faults.dropped, faults.flipped
        return totals

    def run(self) -> None:
        """Send everything, wait until it is read, and close the port; however it ends."""
        try:
            self._start_s = time.monotonic()
            if self._plan.wait:
                self._await_reader()
            self._send_all()
            self._let_read(math.inf if self._plan.lossless else self._plan.end_s)
        finally:
            self._totals.unheard += len(self._pending)
            self._pending.clear()
            self._unplug()
            self._port.close()

    def _now(self) -> float:
        return time.monotonic() - self._start_s

    def _await_reader(self) -> None:
        while self._listener() is None and not self._stopped:
            time.sleep(LOOK_S)
        self._opened_s = -self._plan.settle_s  # of the clock that starts now
        self._start_s = time.monotonic()

    def _send_all(self) -> None:
        while not self._stopped and (self._pace.next_s is not None or self._pending):
            now = self._now()
            listener = self._listener()
            holds = self._plan.lossless and (listener is None or bool(self._pending))
            data = b"" if holds else self._pace.due(min(now, self._change_s))
            self._take_in(data, lost=listener is None)
            if self._pending and listener:
                self._write(listener, now)
            if self._change_s <= now and (holds or not self._late(self._change_s)):
                self._change_plug()
            elif self._pending and listener:
                listener.wait_room(TICK_S)
            elif len(data) < LARGEST:
                ahead_s = LOOK_S if holds else (self._pace.next_s or 0.0) - self._now()
                time.sleep(min(max(ahead_s, TICK_S if data else 0.0), LOOK_S))

    def _late(self, until_s: float) -> bool:
        """Whether there is still something that was due by then."""
        return self._pace.next_s is not None and self._pace.next_s <= until_s

    def _take_in(self, data: bytes, *, lost: bool) -> None:
        self._totals.made += len(data)
        data = self._faults.spoil(data)
        if lost:
            self._totals.unheard += len(data)
        else:
            self._pending += data

    def _write(self, terminal: Terminal, now: float) -> None:
        sent = terminal.write(self._pending)
        del self._pending[:sent]
        self._totals.sent += sent
        if not self._pending or self._plan.lossless:
            self._stuck_s = None
        elif self._stuck_s is None:
            self._stuck_s = now
        elif now - self._stuck_s > self._plan.patience_s:
            self._totals.overrun += len(self._pending)
            self._pending.clear()

    def _listener(self) -> Terminal | None:
        """The terminal, if somebody has had it open for long enough."""
        now = self._now()
        terminal = self._port.terminal
        if terminal is None:
            return None
        if not terminal.has_reader():
            if self._opened_s is not None:
                self._opened_s = None
                self._drop_pending()
                self._lost_unread(terminal.reset())
            return None
        if self._opened_s is None:
            self._opened_s = now
        return terminal if now - self._opened_s >= self._plan.settle_s else None

    def _drop_pending(self) -> None:
        """Nobody is there to whom it could be sent."""
        self._stuck_s = None
        if not self._plan.lossless:
            self._totals.unheard += len(self._pending)
            self._pending.clear()

    def _lost_unread(self, count: int) -> None:
        self._totals.sent -= count
        self._totals.unheard += count

    def _change_plug(self) -> None:
        if self._port.terminal is None:
            self._port.plug()
            self._change_s += self._plan.unplug_every_s or math.inf
        else:
            self._drop_pending()
            self._unplug()
            self._totals.unplugs += 1
            self._change_s += self._plan.away_s

    def _unplug(self) -> None:
        # What is unread is taken back to be counted. A reader at work meanwhile would see a
        # hole there and something after it, so it is let come to the end of what was sent.
        self._let_read(LAST_S, stoppable=False)
        self._lost_unread(self._port.unplug())
        self._opened_s = None

    def _let_read(self, wait_s: float, *, stoppable: bool = True) -> None:
        """Wait until the reader has read what was sent: it is gone when the port is."""
        until_s = self._now() + wait_s
        terminal = self._port.terminal
        while terminal and terminal.has_reader() and terminal.has_unread():
            if (stoppable and self._stopped) or self._now() > until_s:
                break
            time.sleep(0.5 * TICK_S)
