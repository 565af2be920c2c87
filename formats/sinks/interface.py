"""Contract of sinks: addresses, messages and status."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from locatk.core.streaming.events import LiveEvent


@dataclass(frozen=True, slots=True)
class LiveMessage:
    """Event for sinks, with the time from which its latency counts.

    Attributes
    ----------
    event : LiveEvent
    received_s : float
        ``time.monotonic()`` when the last byte was received that the event needed.
    """

    event: LiveEvent
    received_s: float

    def latency_s(self) -> float:
        """Return the time since the last byte was received [s]."""
        return time.monotonic() - self.received_s


@dataclass(frozen=True)
class SinkContext:
    """Facts about a live session that sinks show or send.

    Attributes
    ----------
    system : str
    artifacts : mapping of str to object
        Artifacts by their names in a session (``"scene.toml"``, ``"map.toml"``): the objects of
        :mod:`locatk.formats.artifacts`.
    devices : tuple of str
        Names of the devices that are known at the start.
    token : str or None
        Secret that clients of a server must present; None if none is needed.
    status : callable
        Returns the health of the session as a dict for JSON; key ``"ok"`` is a bool.
    """

    system: str
    artifacts: Mapping[str, Any] = field(default_factory=dict)
    devices: tuple[str, ...] = ()
    token: str | None = None
    status: Any = dict


@dataclass(frozen=True)
class SinkStatus:
    """Counts of a sink.

    Attributes
    ----------
    sent, dropped : int
        Messages sent (to each client), and messages that no client or not every client received.
    clients : int or None
        Connected clients; None if the transport has no connections.
    error : str
        Last error; ``""`` if the sink works.
    address : str
        Where clients find it, or where it sends to, without secrets.
    """

    sent: int = 0
    dropped: int = 0
    clients: int | None = None
    error: str = ""
    address: str = ""


class Sink(Protocol):
    """Sends messages to receivers of one kind.

    Attributes
    ----------
    address : str
        As given by the user, without a password.
    """

    address: str

    def open(self, context: SinkContext) -> None:
        """Start.

        Raises
        ------
        LocatkError
            It cannot start: a port is in use, a package is missing. An unreachable receiver is no
            error if it may be started later; see :attr:`SinkStatus.error`.
        """

    def offer(self, message: LiveMessage) -> None:
        """Take a message. Never blocks and never raises.

        If messages cannot be sent as fast as they come, the newest pose of each device takes the
        place of older ones, which count as dropped; all other events are kept up to a limit.
        """

    def status(self) -> SinkStatus:
        """Return the present counts."""

    def close(self, timeout_s: float) -> None:
        """Send what is waiting for at most ``timeout_s``, and stop. Never raises."""
