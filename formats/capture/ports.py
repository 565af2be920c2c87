"""Ports, as the user names them: serial devices, and URLs of what behaves like one.

============================  ==============================================================
``/dev/ttyACM0``, ``COM3``    a serial port, or a link to one (``/dev/serial/by-id/...``)
``socket://HOST:PORT``        raw bytes over TCP
``rfc2217://HOST:PORT``       a serial port of another computer
``replay:FILE.mcap``          the raw bytes of a session, see :mod:`.replay`
``loop://``                   a port without a device: silence
``spy://``, ``alt://``,       of pyserial, see its documentation
``hwgrep://``, ``cp2110://``
============================  ==============================================================

A serial port is locked (``flock``) and, on Linux, closed to programs that take no lock too
(``TIOCEXCL``). DTR and RTS are set as pyserial does: many boards start anew when their port
is opened. What came before the port was set up is thrown away by pyserial, as it may have
been read at another speed; after that, nothing is.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import os
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

from locatk.formats.capture.links import (
    DescriptorLink,
    Link,
    PolledLink,
    Port,
    RemoteLink,
    SerialLink,
    SourceError,
)
from locatk.formats.capture.port_listing import (
    PortInfo,
    busy_error,
    find_ports,
    is_pty,
    permission_error,
)
from locatk.formats.capture.replay import ReplayPort

URLS = ("socket", "rfc2217", "replay", "loop", "spy", "alt", "hwgrep", "cp2110")

CONNECT_TIMEOUT_S = 5.0

MAX_BAUD_ERROR_FRACTION = 0.05
"""Beyond it a UART takes the last bit of a byte for its neighbour."""

LIST = "See `locatk capture --list`"

_TERMIOS2 = struct.Struct("4I20B2I")
_TCGETS2 = 0x802C542A
"""Asks for the speed that the driver set (Linux, include/uapi/asm-generic/ioctls.h)."""

_KEEPALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}
"""After 25 s of silence a peer that is gone without a word is noticed."""


def port_of(name: str, *, baud: int, speed: float = 1.0) -> Port:
    """The port of this name, not yet opened.

    Parameters
    ----------
    name : str
        As in the table above.
    baud : int
        Of a serial port, here or behind ``rfc2217://``.
    speed : float
        Of ``replay:``, times that of the recording; 0 is as fast as possible.

    Raises
    ------
    SourceError
        It is none, or the speed is.
    """
    if baud <= 0:
        raise SourceError(f"{baud} is no baud rate")
    kind, colon, rest = name.partition(":")
    kind = kind.lower()
    if kind == "replay" and colon:
        return ReplayPort(name, speed=speed)
    if kind == "camera" and colon:
        raise SourceError(f"{name} is a camera, which sends no bytes")
    if not rest.startswith("//"):
        if not name:
            raise SourceError("a port without a name", hint=LIST)
        return SerialPort(name, baud=baud)
    if kind not in URLS:
        known = ", ".join(f"{url}://" for url in URLS)
        raise SourceError(f"no such kind of port: {kind}://", hint=f"Known are {known}")
    if kind in ("socket", "rfc2217"):
        host, number = _address(name)
        if kind == "socket":
            return SocketPort(name, host, number)
    return SerialPort(name, baud=baud)


class SerialPort:
    """A serial device, or a URL that pyserial opens.

    A USB device is known again by vendor, product and serial number when it comes back
    under another name. A symbolic link is taken at its word: whatever it points to.
    """

    def __init__(self, name: str, *, baud: int) -> None:
        self.name = name
        self.can_reconnect = not name.lower().startswith("loop:")
        self._baud = baud
        self._resolved: str | None = None
        self._info: PortInfo | None = None
        self._twins: set[str | None] = set()

    def open(self) -> Link:
        """See :class:`.source.Port`."""
        link, path = open_serial(self._place(), self._baud)
        self._resolved = path if "://" in path else os.path.realpath(path)
        now = find_ports()
        self._info = _info_of(self._resolved, now) or self._info
        self._twins = {info.location for info in self._like(now)}
        return link

    def describe(self) -> dict[str, str]:
        """``port``, ``baud``; once it was open, ``resolved``; of USB ``vid`` and ``pid``
        (hexadecimal), ``serial_number``, ``product``, ``manufacturer``, ``location``."""
        known: dict[str, str | None] = {
            "port": self.name,
            "resolved": self._resolved,
            "baud": str(self._baud),
        }
        info = self._info
        if info is not None:
            known |= {
                "vid": None if info.vid is None else f"{info.vid:04x}",
                "pid": None if info.pid is None else f"{info.pid:04x}",
                "serial_number": info.serial_number,
                "product": info.product,
                "manufacturer": info.manufacturer,
                "location": info.location,
            }
        return {key: value for key, value in known.items() if value is not None}

    def _place(self) -> str:
        """Where it is now: its name, or another one under which it came back."""
        before = self._info
        if before is None or before.identity is None or "://" in self.name:
            return self.name
        if os.path.islink(self.name) and os.path.exists(self.name):
            return self.name
        now = find_ports()
        # Cheap adapters have no serial number, or all the same; then the socket tells.
        like = self._like(now)
        same = [info for info in like if info.location == before.location]
        same = same or [info for info in like if info.location not in self._twins]
        if len(same) == 1:
            return same[0].device
        if like:
            raise SourceError(
                f"{self.name} is gone; like it there is {', '.join(each.device for each in like)}",
                hint=f"Plug it in where it was: USB {before.location}",
            )
        other = _info_of(os.path.realpath(self.name), now)
        if other is not None and other.identity is not None:
            raise SourceError(
                f"another device is at {self.name} now ({other.description or other.device})",
                hint=f"Plug in {before.description or 'the first one'} again",
            )
        return self.name

    def _like(self, infos: list[PortInfo]) -> list[PortInfo]:
        known = self._info and self._info.identity
        return [info for info in infos if known and info.identity == known]


class SocketPort:
    """Raw bytes over TCP, as from ``ser2net`` or ``socat``.

    Not pyserial's, which throws away what the other side says first.
    """

    can_reconnect = True

    def __init__(self, name: str, host: str, number: int) -> None:
        self.name = name
        self._host = host
        self._number = number
        self._peer: str | None = None

    def open(self) -> Link:
        """See :class:`.source.Port`."""
        try:
            connection = socket.create_connection((self._host, self._number), CONNECT_TIMEOUT_S)
        except (OSError, UnicodeError) as error:
            raise _unreachable(error, self.name) from error
        connection.setblocking(False)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in _KEEPALIVE.items():
                if hasattr(socket, option):
                    connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        with contextlib.suppress(OSError):
            self._peer = "{}:{}".format(*connection.getpeername()[:2])
        return DescriptorLink(connection.fileno(), connection.recv, connection.close)

    def describe(self) -> dict[str, str]:
        """``port``; once it was open, ``resolved``: address and port of the other side."""
        return {"port": self.name} | ({"resolved": self._peer} if self._peer else {})


def open_serial(url: str, baud: int) -> tuple[Link, str]:
    """A link to a device or a URL of pyserial, and the path that was opened in the end.

    Raises
    ------
    SourceError
        It cannot be opened.
    """
    import serial

    outside = sys.exception()
    port: Any = None
    try:
        port = serial.serial_for_url(
            url, baudrate=baud, timeout=0, exclusive=True, do_not_open=True
        )
        port.open()
    # Its handlers let all kinds through: termios.error, re.error, OverflowError, KeyError.
    except Exception as error:
        path = url if port is None or port.port is None else str(port.port)
        raise _explained(list(_causes(error, outside)), url, path, baud) from error
    path = str(port.port)
    if url.lower().startswith("rfc2217:"):
        return RemoteLink(port), path
    # One that overrides `read`, as spy:// does, must see the bytes.
    if os.name != "posix" or type(port).read is not serial.Serial.read:
        return PolledLink(port), path
    with contextlib.suppress(ValueError, NotImplementedError):  # drivers without such a mode
        port.set_low_latency_mode(True)
    actual = _actual_baud(port.fileno())
    if actual and abs(actual - baud) > MAX_BAUD_ERROR_FRACTION * baud:
        port.close()
        raise _wrong_baud(url, baud, actual)
    # A pseudo-terminal would stay closed to others even after its holder was killed.
    return SerialLink(port, exclusive=sys.platform == "linux" and not is_pty(path)), path


def _explained(errors: list[BaseException], name: str, path: str, baud: int) -> SourceError:
    """What went wrong when ``path`` was opened, from the error and those that led to it."""
    if name.lower().startswith("rfc2217:"):
        if len(errors) > 1:
            return _unreachable(errors[-1], name)
        place = "{0.hostname}:{0.port}".format(urlsplit(name))
        hint = f"Does it speak RFC 2217? If it sends the bytes alone: socket://{place}"
        return _not_opened(errors, name, hint)
    is_baud = isinstance(errors[0], ValueError) and "baud" in str(errors[0])
    if is_baud or isinstance(errors[0], OverflowError):
        return _wrong_baud(name, baud)
    number = next((number for number in map(_number, errors) if number), None)
    if number in (errno.ENOENT, errno.ENOTDIR):
        known = {os.path.basename(info.device): info.device for info in find_ports()}
        near = difflib.get_close_matches(os.path.basename(path), known, 3, 0.7)
        meant = " or ".join(known[each] for each in near)
        hint = f"{LIST}; did you mean {meant}?" if meant else LIST
        return SourceError(f"no such port {path}", hint=hint)
    if number in (errno.EBUSY, errno.EAGAIN):
        return busy_error(name, path)
    if number in (errno.EACCES, errno.EPERM):
        return permission_error(name, path)
    if number in (errno.ENOTTY, errno.EISDIR):
        kind = "a folder" if os.path.isdir(path) else "no serial port"
        return SourceError(f"{name} is {kind}", hint=f"{LIST}; replay:FILE.mcap plays a session")
    if number in (errno.ENXIO, errno.ENODEV, errno.EIO):
        return SourceError(f"no device behind {name}", hint=f"Is it plugged in? {LIST}")
    if number == errno.EINVAL:
        return _wrong_baud(name, baud)
    return _not_opened(errors, name)


def _not_opened(errors: list[BaseException], name: str, hint: str = LIST) -> SourceError:
    # Of the first line, without the insides that pyserial lists.
    text = str(errors[0]).partition("\n")[0].partition(" [")[0].rstrip(": ")
    return SourceError(f"{name} cannot be opened ({text or type(errors[0]).__name__})", hint=hint)


def _wrong_baud(name: str, baud: int, actual: int | None = None) -> SourceError:
    instead = f", only {actual}" if actual else ""
    return SourceError(f"{name} cannot do {baud} baud{instead}", hint="Give another --baud")


def _unreachable(error: BaseException, name: str) -> SourceError:
    parts = urlsplit(name)
    place = f"{parts.hostname}:{parts.port}"
    if isinstance(error, socket.gaierror | UnicodeError):
        return SourceError(f"unknown host {parts.hostname} of {name}", hint="Is it spelt right?")
    if isinstance(error, ConnectionRefusedError):
        hint = "Is its server running, and the number of the port right?"
        return SourceError(f"nobody listens at {place}", hint=hint)
    if isinstance(error, TimeoutError):
        hint = "Is it switched on, and in this network?"
        return SourceError(f"{place} does not answer", hint=hint)
    return SourceError(
        f"{place} cannot be reached ({getattr(error, 'strerror', None) or error})",
        hint="Is the network there?",
    )


def _address(name: str) -> tuple[str, int]:
    try:
        parts = urlsplit(name)
        host, number = parts.hostname, parts.port
    except ValueError:
        host = number = None
    if not host or not number:
        kind = name.partition(":")[0]
        raise SourceError(f"{name} names no host and port", hint=f"As in {kind}://192.168.1.7:4000")
    return host, number


def _causes(error: BaseException, outside: BaseException | None) -> Iterator[BaseException]:
    """An error and those that led to it, not those that were handled before."""
    each: BaseException | None = error
    while each is not None and each is not outside:
        yield each
        each = each.__cause__ or each.__context__


def _number(error: BaseException) -> int | None:
    """``errno`` of an error, also of ``termios.error``, which is no OSError, and of Windows,
    where pyserial tells it in words."""
    if error.args and isinstance(error.args[0], int):
        return error.args[0]
    if "FileNotFoundError" in str(error):
        return errno.ENOENT
    return errno.EBUSY if "PermissionError" in str(error) else None


def _actual_baud(number: int) -> int | None:
    """The speed that the driver set; None where nobody tells."""
    if sys.platform != "linux":
        return None
    import fcntl

    try:
        return int(_TERMIOS2.unpack(fcntl.ioctl(number, _TCGETS2, bytes(_TERMIOS2.size)))[-1])
    except OSError:
        return None


def _info_of(path: str, infos: list[PortInfo]) -> PortInfo | None:
    return next((info for info in infos if os.path.realpath(info.device) == path), None)
