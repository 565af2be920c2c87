"""A port that is a pseudo-terminal, at a path that stays when it is plugged in again."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from pathlib import Path

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError
from locatk.formats.emulation.pseudo_terminal import Terminal


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
