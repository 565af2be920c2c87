"""Where bytes come from: the contract between ports and the recorder."""

from __future__ import annotations

from dataclasses import dataclass
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
    comes_again : bool
        Whether it is worth trying to open it again when it was lost.
    """

    name: str
    comes_again: bool

    def open(self) -> Link:
        """Open it, or the same device where it is now.

        Raises
        ------
        SourceError
            It cannot be opened.
        """

    def describe(self) -> dict[str, str]:
        """What is known of it, for the session's metadata: VID:PID, serial number, baud."""
