"""Contract between ports and the recorder, and links: open connections.

A read takes all bytes that have arrived, in large pieces, and does not wait for more, so that
its time is that of its bytes. It raises :class:`LinkLost` when a port was unplugged, which
pyserial does not notice: such a port is always ready and always empty.
"""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import select
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from locatk.core.errors import LocatkError


class SourceError(LocatkError, OSError):
    """A port cannot be opened; the hint states a remedy."""


class LinkLost(Exception):
    """The connection was lost, because it was unplugged or closed by the other side."""


class LinkEnded(Exception):
    """The source is at its end, such as a replayed file."""


@dataclass(frozen=True)
class Overruns:
    """Error counters of a UART since it was opened, as counted by the kernel."""

    overrun: int = 0
    """Bytes lost by the UART."""
    buffer: int = 0
    """Bytes lost because the buffer of the kernel was full."""
    frame: int = 0
    """Bytes without a stop bit."""
    parity: int = 0
    """Bytes with wrong parity."""

    @property
    def lost(self) -> int:
        """Number of bytes that did not arrive."""
        return self.overrun + self.buffer


class Link(Protocol):
    """Open connection."""

    def read(self, wait_s: float) -> Any:
        """Return all bytes of a line, or frames of a camera, that have arrived.

        Wait for the first one, at most ``wait_s``; then return an empty result.

        Raises
        ------
        LinkLost
            The connection was lost.
        LinkEnded
            The source is at its end.
        """

    def overruns(self) -> Overruns | None:
        """Return the error counters of this link since it was opened; None if there are none."""

    def close(self) -> None:
        """Close the connection; never raises."""


class Port(Protocol):
    """Source of bytes or camera frames that can be opened repeatedly.

    Attributes
    ----------
    name : str
        Name given by the user.
    can_reconnect : bool
        It may be opened again after the connection was lost.
    """

    name: str
    can_reconnect: bool

    def open(self) -> Link:
        """Open it, or the same device at its present path.

        Raises
        ------
        SourceError
            It cannot be opened.
        """

    def describe(self) -> dict[str, str]:
        """Return facts for the session's metadata: VID:PID, serial number, baud rate."""


READ_BYTES = 65_536
"""Bytes requested per read."""

TERMINAL_READ_BYTES = 4_095
"""Most bytes that a Linux terminal returns per read; after fewer bytes it is empty."""

MAX_READ_BYTES = 1 << 20
"""Bytes after which a read returns although more have arrived."""

POLL_INTERVAL_S = 0.002
"""Interval between two checks of a port that does not support waiting."""

UNPLUGGED = "unplugged, or closed by the other side"

_COUNTERS = struct.Struct("20i")
"""``struct serial_icounter_struct``: cts, dsr, rng, dcd, rx, tx, frame, overrun, parity, brk,
buf_overrun, and nine reserved (Linux, include/uapi/linux/serial.h)."""


class DescriptorLink:
    """Link with a file descriptor, for which the system can wait.

    Parameters
    ----------
    number : int
        The descriptor, which is non-blocking.
    receive : callable
        Takes the largest number of bytes; returns those that have arrived.
    close : callable
    """

    def __init__(
        self, number: int, receive: Callable[[int], bytes], close: Callable[[], object]
    ) -> None:
        self._number = number
        self._receive = receive
        self._close = close

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have arrived; see :class:`Link`."""
        try:
            ready, _, _ = select.select([self._number], [], [], max(0.0, wait_s))
            if not ready:
                return b""
            first = self._receive(READ_BYTES)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:  # ValueError: closed meanwhile
            raise LinkLost(_reason(error)) from error
        if not first:
            raise LinkLost(self._reason_empty())
        return first if len(first) < TERMINAL_READ_BYTES else self._more(first)

    def _more(self, first: bytes) -> bytes:
        pieces = [first]
        size = last = len(first)
        while last >= TERMINAL_READ_BYTES and size < MAX_READ_BYTES:
            try:
                piece = self._receive(READ_BYTES)
            except OSError:
                break  # Empty or broken; the next read reports it.
            # A terminal that is not ready returns b"" as well, so that it is no error here.
            pieces.append(piece)
            last = len(piece)
            size += last
        return b"".join(pieces)

    def _reason_empty(self) -> str:
        return "closed by the other side"

    def overruns(self) -> Overruns | None:
        """Return None, because there are no counters."""
        return None

    def close(self) -> None:
        """Close the connection."""
        self._number = -1
        with contextlib.suppress(Exception):
            self._close()


class SerialLink(DescriptorLink):
    """Serial port of a POSIX system.

    Parameters
    ----------
    port : serial.Serial
        Open port.
    exclusive : bool
        Prevent other programs from opening it, even those that take no lock (``TIOCEXCL``).
    """

    def __init__(self, port: Any, *, exclusive: bool) -> None:
        number = port.fileno()
        super().__init__(number, partial(os.read, number), port.close)
        self._exclusive = exclusive
        if exclusive:
            _set_exclusive(number, True)
        self._initial_counters = _counters(number)
        self._overruns = None if self._initial_counters is None else Overruns()

    def overruns(self) -> Overruns | None:
        """Return the kernel's counters since the port was opened; None if the driver has none.

        Once the port is gone, the last known ones are returned.
        """
        now = _counters(self._number)
        if now is not None and self._initial_counters is not None:
            # The counters have 32 bits and wrap.
            since = [(a - b) & 0xFFFFFFFF for a, b in zip(now, self._initial_counters, strict=True)]
            self._overruns = Overruns(
                overrun=since[7], buffer=since[10], frame=since[6], parity=since[8]
            )
        return self._overruns

    def _reason_empty(self) -> str:
        poll = select.poll()
        poll.register(self._number)
        hung_up = select.POLLHUP | select.POLLERR | select.POLLNVAL
        if any(events & hung_up for _, events in poll.poll(0)):
            return UNPLUGGED
        return "ready but empty: another program reads from it, or it was unplugged"

    def close(self) -> None:
        """Close the port and allow other programs to open it."""
        if self._exclusive:
            _set_exclusive(self._number, False)
        super().close()


class PolledLink:
    """Port of pyserial that must be polled: on Windows, ``loop://``, ``spy://``.

    Parameters
    ----------
    port : serial.SerialBase
        Open port, with a timeout of 0.
    """

    def __init__(self, port: Any) -> None:
        self._port = port

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have arrived; see :class:`Link`."""
        end = time.monotonic() + wait_s
        try:
            while True:
                available = self._port.in_waiting
                if available:
                    break
                remaining = end - time.monotonic()
                if remaining <= 0:
                    return b""
                time.sleep(min(remaining, POLL_INTERVAL_S))
            data = bytes(self._port.read(available))
        except (OSError, TypeError) as error:  # TypeError: closed meanwhile
            raise LinkLost(_reason(error)) from error
        if not data:
            raise LinkLost(UNPLUGGED)
        return data

    def overruns(self) -> Overruns | None:
        """Return None, because there are no counters."""
        return None

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(Exception):
            self._port.close()


class RemoteLink:
    """Port behind ``rfc2217://``.

    A thread of pyserial fills a queue with single bytes, and None at the end. pyserial's ``read``
    returns no bytes once that thread has ended, and the number of waiting bytes does not show the
    end; so the bytes are taken from the queue itself.

    Parameters
    ----------
    port : serial.rfc2217.Serial
        Open port.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._queue: queue.Queue[bytes | None] = port._read_buffer
        self._thread = port._thread
        self._ended = False

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have arrived; see :class:`Link`."""
        pieces: list[bytes] = []
        try:
            piece = None if self._ended else self._queue.get(timeout=max(0.0, wait_s))
            while piece is not None:
                pieces.append(piece)
                if len(pieces) >= MAX_READ_BYTES:
                    break
                piece = self._queue.get_nowait()
            self._ended = piece is None
        except queue.Empty:
            # The thread may have died; checked in this order, or its last bytes are missed.
            self._ended = not self._thread.is_alive() and self._queue.empty()
        if self._ended and not pieces:
            raise LinkLost("closed by the other side")
        return b"".join(pieces)

    def overruns(self) -> Overruns | None:
        """Return None: pyserial does not store the messages of RFC 2217 about overruns."""
        return None

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(Exception):
            self._port.close()


def _set_exclusive(number: int, exclusive: bool) -> None:
    try:
        import fcntl
        import termios

        fcntl.ioctl(number, termios.TIOCEXCL if exclusive else termios.TIOCNXCL)
    except (ImportError, OSError, ValueError):
        pass


def _counters(number: int) -> tuple[int, ...] | None:
    """Return the kernel's counters of a UART; None if it has none."""
    try:
        import fcntl
        from termios import TIOCGICOUNT

        counters = fcntl.ioctl(number, TIOCGICOUNT, bytes(_COUNTERS.size))
        return _COUNTERS.unpack(counters)
    except (ImportError, OSError, ValueError):
        return None


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EIO, errno.ENXIO, errno.ENODEV):
        return UNPLUGGED
    return os.strerror(number) if number else str(error)
