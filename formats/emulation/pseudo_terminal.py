"""A pseudo-terminal as a device sees it: is there a reader, is there room, what was not read.

What Linux does with pseudo-terminals, and what follows (tried with 6.18):

* The master is told that nobody has the slave open (POLLHUP); of readers it learns nothing
  else. But only at the slave is seen what was not read, and a reader may keep others from
  opening it (TIOCEXCL). So one slave is kept open here, but for the moment of a look whether
  there is another one.
* The slave keeps its settings, TIOCEXCL among them, and what was written to it and not read,
  from one opening to the next. A serial port does not: they are put back when the reader left.
* What was not read is gone when the master is closed; the reader sees its end at once.
* FIONREAD and TIOCOUTQ miss what is still on its way to the reader; polling the slave moves
  that on first, and is exact.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import tempfile
from pathlib import Path

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError

PIECE = 1 << 16

MOST_READS = 1000
"""To empty a buffer that holds 20 kB, 4 kB a read."""

_TIOCGEXCL = 0x8004_5440
"""Whether TIOCEXCL is in force (Linux, include/uapi/asm-generic/ioctls.h)."""


class Terminal:
    """A new pseudo-terminal that passes bytes on as they are.

    Attributes
    ----------
    name : str
        Path of the slave, which a reader opens.

    Raises
    ------
    LocatkError
        There is none left.
    """

    def __init__(self) -> None:
        import tty

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
        """Whether somebody has it open. What they wrote to it is passed over."""
        exclusive = self._release()
        events = _poll(self._master, select.POLLIN)
        alone = bool(events & select.POLLHUP)
        # It cannot be opened if a reader came and locked it in this very moment.
        with contextlib.suppress(OSError):
            self._slave = os.open(self.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        if not alone:
            if exclusive:
                self._lock(True)
            if events & select.POLLIN:
                with contextlib.suppress(OSError):
                    os.read(self._master, PIECE)
        return not alone

    def _release(self) -> bool:
        """Close the slave; whether it was locked, which it is no more."""
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
        """Pass on as much as there is room for; returns how much."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def wait_room(self, wait_s: float) -> None:
        """Wait until there is room for more, at most so long."""
        _poll(self._master, select.POLLOUT, wait_s)

    def has_unread(self) -> bool:
        """Whether something is left for the reader to read; yes where that is not known."""
        return self._slave is None or bool(_poll(self._slave, select.POLLIN) & select.POLLIN)

    def reset(self) -> int:
        """Settings and buffer as at the start; returns how many bytes were not read."""
        import termios
        import tty

        if self._slave is None:
            return 0
        tty.setraw(self._slave, termios.TCSANOW)
        taken = 0
        for _ in range(MOST_READS):
            if not self.has_unread():
                break
            # Another one may be reading at this very moment, and keeps it for as long.
            with contextlib.suppress(BlockingIOError):
                taken += len(os.read(self._slave, PIECE))
        return taken

    def close(self) -> int:
        """Hang up; returns how many bytes were not read."""
        unread = self.reset()
        self._release()
        os.close(self._master)
        return unread


def _poll(descriptor: int, events: int, wait_s: float = 0.0) -> int:
    poll = select.poll()
    poll.register(descriptor, events)
    return sum(event for _, event in poll.poll(1e3 * wait_s))


class PseudoPort:
    """A symbolic link to a pseudo-terminal, which is another one after each unplugging.

    Parameters
    ----------
    link : path, optional
        Where it is to be found; in a new private folder by default. A link that a killed
        emulator left behind is replaced, anything else is not touched.

    Attributes
    ----------
    path : str
        The link.

    Raises
    ------
    OutputExistsError
        There is something at this path.
    MissingDataError
        Its folder is not there.
    LocatkError
        The system has no pseudo-terminals, or none left.
    """

    def __init__(self, link: str | os.PathLike[str] | None = None) -> None:
        if sys.platform == "win32":
            raise LocatkError(
                "Windows has no pseudo-terminals", hint="Use WSL, or another computer"
            )
        self._terminal: Terminal | None = None
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
    def terminal(self) -> Terminal | None:
        """What is plugged in."""
        return self._terminal

    def plug(self) -> None:
        """Make it appear.

        Raises
        ------
        OutputExistsError, MissingDataError, LocatkError
            As on the start.
        """
        terminal = Terminal()
        try:
            os.symlink(terminal.name, self.path)
        except OSError as error:
            terminal.close()
            raise _refused(error, self.path) from error
        self._terminal = terminal

    def unplug(self) -> int:
        """Make it vanish; returns how many bytes the reader had not read."""
        if self._terminal is None:
            return 0
        terminal, self._terminal = self._terminal, None
        # The terminal's number may soon be another one's, so the link goes first.
        with contextlib.suppress(OSError):
            if os.readlink(self.path) == terminal.name:
                os.unlink(self.path)
        return terminal.close()

    def close(self) -> int:
        """Remove all that was made; returns how many bytes the reader had not read."""
        unread = self.unplug()
        if self._folder is not None:
            with contextlib.suppress(OSError):
                os.rmdir(self._folder)
        return unread


def _remove_stale(path: str) -> None:
    """Remove a link to a terminal that is no more: what a killed emulator leaves behind."""
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
        return MissingDataError("no folder for the port", file=path, hint="Make it first")
    return LocatkError(f"no link to the port: {error.strerror}", file=path)
