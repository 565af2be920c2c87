"""Pseudo-terminals as serial ports of emulated devices.

Behaviour of pseudo-terminals on Linux (tested with 6.18), and consequences:

* The master is notified when the slave is closed by all (POLLHUP), and learns nothing else about
  readers. Unread bytes can only be determined at the slave, and a reader may prevent others from
  opening it (TIOCEXCL). So one slave is kept open here, except while it is checked whether there
  is another one.
* The slave keeps its settings, including TIOCEXCL, and unread bytes from one opening to the next.
  A serial port does not: they are reset when the reader has closed it.
* Unread bytes are discarded when the master is closed; the reader gets end-of-file at once.
* FIONREAD and TIOCOUTQ miss bytes on their way to the reader; polling the slave moves these on
  first, and is exact.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import tempfile
from pathlib import Path

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError

READ_BYTES = 1 << 16
"""Bytes per read."""

MAX_READS = 1000
"""Reads to empty a buffer of 20 kB, with 4 kB per read."""

_TIOCGEXCL = 0x8004_5440
"""Queries TIOCEXCL (Linux, include/uapi/asm-generic/ioctls.h)."""


class PseudoTerminal:
    """Pseudo-terminal in raw mode.

    Attributes
    ----------
    name : str
        Path of the slave, which a reader opens.

    Raises
    ------
    LocatkError
        No pseudo-terminal is available; Windows has none.
    """

    def __init__(self) -> None:
        try:
            import tty
        except ImportError:
            raise LocatkError(
                "no pseudo-terminals on this system",
                hint="Emulate on Linux, macOS or WSL; `locatk capture replay:FILE` works here",
            ) from None
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise LocatkError(f"no pseudo-terminal: {error.strerror}") from error
        self._slave: int | None = slave
        self.name = os.ttyname(slave)
        tty.setraw(slave)
        for each in (self._master, slave):
            os.set_blocking(each, False)

    def has_reader(self) -> bool:
        """Return whether a reader has it open; discard the bytes that it wrote."""
        exclusive = self._release()
        events = _poll(self._master, select.POLLIN)
        alone = bool(events & select.POLLHUP)
        # Opening fails if a reader has opened and locked it since the check.
        with contextlib.suppress(OSError):
            self._slave = os.open(self.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        if not alone:
            if exclusive:
                self._lock(True)
            if events & select.POLLIN:
                with contextlib.suppress(OSError):
                    os.read(self._master, READ_BYTES)
        return not alone

    def _release(self) -> bool:
        """Close the slave and remove its lock; return whether it was locked."""
        if self._slave is None:
            return False
        import fcntl

        try:
            exclusive = any(fcntl.ioctl(self._slave, _TIOCGEXCL, bytes(4)))
        except OSError:
            exclusive = False
        if exclusive:
            self._lock(False)
        os.close(self._slave)
        self._slave = None
        return exclusive

    def _lock(self, exclusive: bool) -> None:
        import fcntl
        import termios

        if self._slave is not None:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._slave, termios.TIOCEXCL if exclusive else termios.TIOCNXCL)

    def write(self, data: bytes | bytearray) -> int:
        """Write as many bytes as the buffer accepts; return their number."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def wait_room(self, wait_s: float) -> None:
        """Wait until the buffer accepts bytes, at most ``wait_s``."""
        _poll(self._master, select.POLLOUT, wait_s)

    def has_unread(self) -> bool:
        """Return whether bytes are left to read; True if that is unknown."""
        return self._slave is None or bool(_poll(self._slave, select.POLLIN) & select.POLLIN)

    def reset(self) -> int:
        """Reset settings and buffer; return the number of unread bytes."""
        import termios
        import tty

        if self._slave is None:
            return 0
        tty.setraw(self._slave, termios.TCSANOW)
        taken = 0
        for _ in range(MAX_READS):
            if not self.has_unread():
                break
            # Reading fails if a reader takes the bytes at the same time.
            with contextlib.suppress(BlockingIOError):
                taken += len(os.read(self._slave, READ_BYTES))
        return taken

    def close(self) -> int:
        """Hang up; return the number of unread bytes."""
        unread = self.reset()
        self._release()
        os.close(self._master)
        return unread


def _poll(descriptor: int, events: int, wait_s: float = 0.0) -> int:
    poll = select.poll()
    poll.register(descriptor, events)
    return sum(event for _, event in poll.poll(1e3 * wait_s))


class PseudoPort:
    """Symbolic link to a pseudo-terminal, which is a new one after each unplugging.

    Parameters
    ----------
    link : path, optional
        Path of the link; in a new private folder by default. A link left behind by a killed
        emulator is replaced; any other file is kept.

    Attributes
    ----------
    path : str
        Path of the link.

    Raises
    ------
    OutputExistsError
        The path exists.
    MissingDataError
        Its folder does not exist.
    LocatkError
        The system has no pseudo-terminals, or none is available.
    """

    def __init__(self, link: str | os.PathLike[str] | None = None) -> None:
        if sys.platform == "win32":
            raise LocatkError("Windows has no pseudo-terminals", hint="Use WSL or another computer")
        self._terminal: PseudoTerminal | None = None
        self._folder: str | None = None
        if link is None:
            self._folder = tempfile.mkdtemp(prefix="locatk-")
            link = Path(self._folder, "port")
        self.path = os.path.abspath(link)
        try:
            _remove_stale(self.path)
            self.plug()
        except BaseException:
            self.close()
            raise

    @property
    def terminal(self) -> PseudoTerminal | None:
        """Terminal that is plugged in; None while unplugged."""
        return self._terminal

    def plug(self) -> None:
        """Create a terminal and its link.

        Raises
        ------
        OutputExistsError, MissingDataError, LocatkError
            As for the constructor.
        """
        terminal = PseudoTerminal()
        try:
            os.symlink(terminal.name, self.path)
        except OSError as error:
            terminal.close()
            raise _refused(error, self.path) from error
        self._terminal = terminal

    def unplug(self) -> int:
        """Remove link and terminal; return the number of unread bytes."""
        if self._terminal is None:
            return 0
        terminal, self._terminal = self._terminal, None
        # The link is removed first, because a new terminal may get the number of this one.
        with contextlib.suppress(OSError):
            if os.readlink(self.path) == terminal.name:
                os.unlink(self.path)
        return terminal.close()

    def close(self) -> int:
        """Remove everything that was created; return the number of unread bytes."""
        unread = self.unplug()
        if self._folder is not None:
            with contextlib.suppress(OSError):
                os.rmdir(self._folder)
        return unread


def _remove_stale(path: str) -> None:
    """Remove a link to a terminal that no longer exists, as a killed emulator leaves it behind."""
    dangling = os.path.islink(path) and not os.path.exists(path)
    if dangling and os.readlink(path).startswith("/dev/pts/"):
        os.unlink(path)


def _refused(error: OSError, path: str) -> LocatkError:
    if isinstance(error, FileExistsError):
        return OutputExistsError(
            "the path of the port is taken",
            file=path,
            hint="Choose another --link, or remove it if no emulator runs there",
        )
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return MissingDataError("no folder for the port", file=path, hint="Create it first")
    return LocatkError(f"no link to the port: {error.strerror}", file=path)
