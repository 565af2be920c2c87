"""Emulation of a serial device on a pseudo-terminal, in real time.

A real device does not wait: bytes that are due while the port is closed, or while the reader
does not read, are lost. All losses are counted.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass

from locatk.formats.emulation.byte_stream import MAX_PIECE_BYTES, LineFaults, Pace
from locatk.formats.emulation.pseudo_terminal import PseudoPort, PseudoTerminal

MIN_WRITE_INTERVAL_S = 0.004
"""Shortest time between two writes: 12 kB at 3 MB/s; the kernel buffers 20 kB."""

MAX_POLL_INTERVAL_S = 0.01
"""Longest time between two checks whether the port is open."""

SETTLE_S = 0.2
"""Time between the opening of the port and the first byte sent; meanwhile the reader sets up the
port and discards its input (pyserial does)."""

MAX_BLOCKED_S = 1.0
"""Time for which a reader may be busy before bytes are lost, until it has caught up. The kernel
buffers 20 kB; the rest is queued here."""

END_WAIT_S = 10.0
"""Longest wait for the reader at the end."""

UNPLUG_WAIT_S = 0.1
"""Longest wait for the reader before the port is unplugged or stopped."""


@dataclass(frozen=True)
class EmulationPlan:
    """Behaviour of the emulated device.

    Attributes
    ----------
    wait : bool
        Start when the port is first opened, instead of at once.
    lossless : bool
        Wait for the reader whenever it does not read, as no real device does.
    unplug_every_s : float or None
        Time for which it is plugged in; None for no unplugging.
    away_s : float
        Time for which it is unplugged.
    settle_s, max_blocked_s, end_wait_s : float
        :data:`SETTLE_S`, :data:`MAX_BLOCKED_S` and :data:`END_WAIT_S`.
    """

    wait: bool = True
    lossless: bool = False
    unplug_every_s: float | None = None
    away_s: float = 1.0
    settle_s: float = SETTLE_S
    max_blocked_s: float = MAX_BLOCKED_S
    end_wait_s: float = END_WAIT_S


@dataclass
class EmulationCounts:
    """Counts of the bytes that an emulated device sent, and of those that were lost.

    Each byte is counted once: ``made`` = ``sent`` + ``dropped`` + ``unheard`` + ``overrun``.

    Attributes
    ----------
    made : int
        Bytes that the device had to send.
    sent : int
        Bytes received by the reader.
    dropped : int
        Bytes lost as a fault of the line.
    unheard : int
        Bytes lost while the device was unplugged or the port closed, or unread at that time.
    overrun : int
        Bytes lost because the reader did not read in time.
    flipped : int
        Flipped bits, including those of bytes that were lost afterwards.
    unplugs : int
        Number of times it was unplugged.
    """

    made: int = 0
    sent: int = 0
    dropped: int = 0
    unheard: int = 0
    overrun: int = 0
    flipped: int = 0
    unplugs: int = 0

    def as_dict(self) -> dict[str, int]:
        """Return the counts for JSON."""
        return asdict(self)


class Emulator:
    """One device on one port.

    Parameters
    ----------
    port : PseudoPort
    pace : Pace
        Bytes and their due times.
    faults : LineFaults, optional
        None by default.
    plan : EmulationPlan, optional
    """

    def __init__(
        self,
        port: PseudoPort,
        pace: Pace,
        faults: LineFaults | None = None,
        plan: EmulationPlan | None = None,
    ) -> None:
        self._port = port
        self._pace = pace
        self._faults = faults or LineFaults()
        self._plan = plan or EmulationPlan()
        self._totals = EmulationCounts()
        self._pending = bytearray()
        self._reader_since_s: float | None = None
        self._blocked_since_s: float | None = None
        self._plug_change_s = self._plan.unplug_every_s or math.inf
        self._start_s = 0.0
        self._stopped = False

    def stop(self) -> None:
        """End :meth:`run` soon; may be called from a signal handler or another thread."""
        self._stopped = True

    @property
    def totals(self) -> EmulationCounts:
        """Counts so far."""
        faults, totals = self._faults, self._totals
        totals.dropped, totals.flipped = faults.dropped, faults.flipped
        return totals

    def run(self) -> None:
        """Send all bytes, wait until they are read, and close the port in any case."""
        try:
            self._start_s = time.monotonic()
            if self._plan.wait:
                self._await_reader()
            self._send_all()
            self._wait_until_read(math.inf if self._plan.lossless else self._plan.end_wait_s)
        finally:
            self._totals.unheard += len(self._pending)
            self._pending.clear()
            self._unplug()
            self._port.close()

    def _now(self) -> float:
        return time.monotonic() - self._start_s

    def _await_reader(self) -> None:
        while self._ready_terminal() is None and not self._stopped:
            time.sleep(MAX_POLL_INTERVAL_S)
        self._reader_since_s = -self._plan.settle_s  # of the clock that starts now
        self._start_s = time.monotonic()

    def _send_all(self) -> None:
        while not self._stopped and (self._pace.next_s is not None or self._pending):
            now = self._now()
            terminal = self._ready_terminal()
            holds = self._plan.lossless and (terminal is None or bool(self._pending))
            data = b"" if holds else self._pace.due(min(now, self._plug_change_s))
            self._queue(data, lost=terminal is None)
            if self._pending and terminal:
                self._write(terminal, now)
            if self._plug_change_s <= now and (
                holds or not self._has_due_before(self._plug_change_s)
            ):
                self._toggle_plug()
            elif self._pending and terminal:
                terminal.wait_room(MIN_WRITE_INTERVAL_S)
            elif len(data) < MAX_PIECE_BYTES:
                ahead_s = MAX_POLL_INTERVAL_S if holds else (self._pace.next_s or 0.0) - self._now()
                time.sleep(
                    min(max(ahead_s, MIN_WRITE_INTERVAL_S if data else 0.0), MAX_POLL_INTERVAL_S)
                )

    def _has_due_before(self, until_s: float) -> bool:
        """Return whether bytes that were due by then are left."""
        return self._pace.next_s is not None and self._pace.next_s <= until_s

    def _queue(self, data: bytes, *, lost: bool) -> None:
        self._totals.made += len(data)
        data = self._faults.apply(data)
        if lost:
            self._totals.unheard += len(data)
        else:
            self._pending += data

    def _write(self, terminal: PseudoTerminal, now: float) -> None:
        sent = terminal.write(self._pending)
        del self._pending[:sent]
        self._totals.sent += sent
        if not self._pending or self._plan.lossless:
            self._blocked_since_s = None
        elif self._blocked_since_s is None:
            self._blocked_since_s = now
        elif now - self._blocked_since_s > self._plan.max_blocked_s:
            self._totals.overrun += len(self._pending)
            self._pending.clear()

    def _ready_terminal(self) -> PseudoTerminal | None:
        """Return the terminal if a reader has had it open for long enough."""
        now = self._now()
        terminal = self._port.terminal
        if terminal is None:
            return None
        if not terminal.has_reader():
            if self._reader_since_s is not None:
                self._reader_since_s = None
                self._drop_pending()
                self._count_unread(terminal.reset())
            return None
        if self._reader_since_s is None:
            self._reader_since_s = now
        return terminal if now - self._reader_since_s >= self._plan.settle_s else None

    def _drop_pending(self) -> None:
        """Discard queued bytes, because the port is closed or unplugged."""
        self._blocked_since_s = None
        if not self._plan.lossless:
            self._totals.unheard += len(self._pending)
            self._pending.clear()

    def _count_unread(self, count: int) -> None:
        self._totals.sent -= count
        self._totals.unheard += count

    def _toggle_plug(self) -> None:
        if self._port.terminal is None:
            self._port.plug()
            self._plug_change_s += self._plan.unplug_every_s or math.inf
        else:
            self._drop_pending()
            self._unplug()
            self._totals.unplugs += 1
            self._plug_change_s += self._plan.away_s

    def _unplug(self) -> None:
        # Unread bytes are removed and counted as lost. Removing them while a reader is active would
        # leave a hole in its data, so the reader may first read up to the last byte sent.
        self._wait_until_read(UNPLUG_WAIT_S, stoppable=False)
        self._count_unread(self._port.unplug())
        self._reader_since_s = None

    def _wait_until_read(self, wait_s: float, *, stoppable: bool = True) -> None:
        """Wait until the reader has read all bytes, because unread ones vanish with the port."""
        until_s = self._now() + wait_s
        terminal = self._port.terminal
        while terminal and terminal.has_reader() and terminal.has_unread():
            if (stoppable and self._stopped) or self._now() > until_s:
                break
            time.sleep(0.5 * MIN_WRITE_INTERVAL_S)
