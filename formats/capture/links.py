"""Where bytes come from: the contract between ports and the recorder."""

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
    """A port that cannot be opened, with a hint what to do."""


class LinkLost(Exception):
    """The connection broke: unplugged, or closed by the other side. It may come again."""


class LinkEnded(Exception):
    """Nothing more will come: the end of what is replayed."""


@dataclass(frozen=True)
class Overruns:
    """What the kernel counted of a UART since it was opened."""

    overrun: int = 0
    """Bytes that the UART itself lost."""
    buffer: int = 0
    """Bytes that the kernel's buffer had no room for."""
    frame: int = 0
    """Bytes without a stop bit."""
    parity: int = 0
    """Bytes of wrong parity."""

    @property
    def lost(self) -> int:
        """Bytes that did not arrive."""
        return self.overrun + self.buffer


class Link(Protocol):
    """An open connection."""

    def read(self, wait_s: float) -> Any:
        """What has arrived, all of it: bytes of a line, or a list of a camera's frames; waits
        for the first, at most ``wait_s``, and is empty then.

        Raises
        ------
        LinkLost
            The connection broke.
        LinkEnded
            It is at its end.
        """

    def overruns(self) -> Overruns | None:
        """Of this link, since it was opened; None where nobody counts."""

    def close(self) -> None:
        """Give it back; never raises."""


class Port(Protocol):
    """Something that can be opened, again and again.

    Attributes
    ----------
    name : str
        As the user named it.
    can_reconnect : bool
        Whether it is worth trying to open it again when it was lost.
    """

    name: str
    can_reconnect: bool

    def open(self) -> Link:
        """Open it, or the same device where it is now.

        Raises
        ------
        SourceError
            It cannot be opened.
        """

    def describe(self) -> dict[str, str]:
        """What is known of it, for the session's metadata: VID:PID, serial number, baud."""


READ_BYTES = 65_536
"""Bytes that are asked for at once."""

TERMINAL_READ_BYTES = 4_095
"""The most that a Linux terminal gives at once; after a smaller piece nothing is left."""

MAX_READ_BYTES = 1 << 20
"""Bytes after which a read returns though there are more."""

POLL_INTERVAL_S = 0.002
"""Between two looks at a port that nobody can wait for."""

UNPLUGGED = "unplugged, or closed by the other side"

_COUNTERS = struct.Struct("20i")
"""``struct serial_icounter_struct``: cts, dsr, rng, dcd, rx, tx, frame, overrun, parity, brk,
buf_overrun, and nine reserved (Linux, include/uapi/linux/serial.h)."""


class DescriptorLink:
    """A link with a file descriptor, for which the system can wait.

    Parameters
    ----------
    number : int
        The descriptor, which does not block.
    receive : callable
        Takes the most bytes to give; gives those that are there.
    close : callable
    """

    def __init__(
        self, number: int, receive: Callable[[int], bytes], close: Callable[[], object]
    ) -> None:
        self._number = number
        self._receive = receive
        self._close = close

    def read(self, wait_s: float) -> bytes:
        """See :class:`.source.Link`."""
        try:
            ready, _, _ = select.select([self._number], [], [], max(0.0, wait_s))
            if not ready:
                return b""
            first = self._receive(READ_BYTES)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:  # ValueError: closed meanwhile
            raise LinkLost(_why(error)) from error
        if not first:
            raise LinkLost(self._why_empty())
        return first if len(first) < TERMINAL_READ_BYTES else self._more(first)

    def _more(self, first: bytes) -> bytes:
        pieces = [first]
        size = last = len(first)
        while last >= TERMINAL_READ_BYTES and size < MAX_READ_BYTES:
            try:
                piece = self._receive(READ_BYTES)
            except OSError:
                break  # nothing left, or broken: the next read finds it so
            # Not ready, a terminal gives b"" as well: here that tells nothing.
            pieces.append(piece)
            last = len(piece)
            size += last
        return b"".join(pieces)

    def _why_empty(self) -> str:
        return "closed by the other side"

    def overruns(self) -> Overruns | None:
        """Nobody counts."""
        return None

    def close(self) -> None:
        """See :class:`.source.Link`."""
        self._number = -1
        with contextlib.suppress(Exception):
            self._close()


class SerialLink(DescriptorLink):
    """A serial port of a POSIX system.

    Parameters
    ----------
    port : serial.Serial
        Opened.
    exclusive : bool
        Let no other program open it, not even one that takes no lock (``TIOCEXCL``).
    """

    def __init__(self, port: Any, *, exclusive: bool) -> None:
        number = port.fileno()
        super().__init__(number, partial(os.read, number), port.close)
        self._exclusive = exclusive
        if exclusive:
            _set_exclusive(number, True)
        self._at_opening = _counters(number)
        self._counted = None if self._at_opening is None else Overruns()

    def overruns(self) -> Overruns | None:
        """What the kernel counted since the port was opened, or, once it is gone, up to the
        last time it was asked; None where the driver does not count."""
        now = _counters(self._number)
        if now is not None and self._at_opening is not None:
            # 32 bits each, which start again.
            since = [(a - b) & 0xFFFFFFFF for a, b in zip(now, self._at_opening, strict=True)]
            self._counted = Overruns(
                overrun=since[7], buffer=since[10], frame=since[6], parity=since[8]
            )
        return self._counted

    def _why_empty(self) -> str:
        poll = select.poll()
        poll.register(self._number)
        hung_up = select.POLLHUP | select.POLLERR | select.POLLNVAL
        if any(events & hung_up for _, events in poll.poll(0)):
            return UNPLUGGED
        return "ready, but empty: another program reads from it, or it was unplugged"

    def close(self) -> None:
        """See :class:`.source.Link`."""
        if self._exclusive:
            _set_exclusive(self._number, False)
        super().close()


class PolledLink:
    """A port of pyserial that must be asked again and again: on Windows, ``loop://``,
    ``spy://``.

    Parameters
    ----------
    port : serial.SerialBase
        Opened, with a timeout of 0.
    """

    def __init__(self, port: Any) -> None:
        self._port = port

    def read(self, wait_s: float) -> bytes:
        """See :class:`.source.Link`."""
        end = time.monotonic() + wait_s
        try:
            while True:
                there = self._port.in_waiting
                if there:
                    break
                left = end - time.monotonic()
                if left <= 0:
                    return b""
                time.sleep(min(left, POLL_INTERVAL_S))
            data = bytes(self._port.read(there))
        except (OSError, TypeError) as error:  # TypeError: closed meanwhile
            raise LinkLost(_why(error)) from error
        if not data:
            raise LinkLost(UNPLUGGED)
        return data

    def overruns(self) -> Overruns | None:
        """Nobody counts."""
        return None

    def close(self) -> None:
        """See :class:`.source.Link`."""
        with contextlib.suppress(Exception):
            self._port.close()


class RemoteLink:
    """A port behind ``rfc2217://``.

    A thread of pyserial fills a queue, a byte an entry, None at the end. Its ``read`` takes
    no byte any more once that thread has ended, and whoever asks how much is there learns
    nothing of the end; so the bytes are taken from the queue itself.

    Parameters
    ----------
    port : serial.rfc2217.Serial
        Opened.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._queue: queue.Queue[bytes | None] = port._read_buffer
        self._thread = port._thread
        self._ended = False

    def read(self, wait_s: float) -> bytes:
        """See :class:`.source.Link`."""
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
            # It may have died without a word; in this order, or its last bytes are missed.
            self._ended = not self._thread.is_alive() and self._queue.empty()
        if self._ended and not pieces:
            raise LinkLost("closed by the other side")
        return b"".join(pieces)

    def overruns(self) -> Overruns | None:
        """RFC 2217 has messages for it, which pyserial does not keep."""
        return None

    def close(self) -> None:
        """See :class:`.source.Link`."""
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
    """The kernel's counters of a UART; None where it has none."""
    try:
        import fcntl
        from termios import TIOCGICOUNT

        counters = fcntl.ioctl(number, TIOCGICOUNT, bytes(_COUNTERS.size))
        return _COUNTERS.unpack(counters)
    except (ImportError, OSError, ValueError):
        return None


def _why(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EIO, errno.ENXIO, errno.ENODEV):
        return UNPLUGGED
    return os.strerror(number) if number else str(error)
