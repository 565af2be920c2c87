"""Ports: serial devices, and URLs of sources that behave like one.

=============================  ==============================================================
``/dev/ttyACM0``, ``COM3``     a serial port, or a link to one (``/dev/serial/by-id/...``)
``socket://HOST:PORT``         raw bytes over TCP
``rfc2217://HOST:PORT``        a serial port of another computer
``ble:NAME``, ``ble:ADDRESS``  a Bluetooth device, see :mod:`.bluetooth`
``replay:FILE.mcap``           the raw bytes of a session, see :mod:`.replay`
``loop://``                    a port without a device, which is silent
``spy://``, ``alt://``,        of pyserial, see its documentation
``hwgrep://``, ``cp2110://``
=============================  ==============================================================

A serial port is locked (``flock``) and, on Linux, closed to programs that take no lock
(``TIOCEXCL``). DTR and RTS are set as pyserial does: many boards restart when their port is
opened. pyserial discards bytes that arrived before the port was set up, because they may have
been read at another baud rate; no bytes are discarded after that.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import os
import socket
import struct
import sys
import threading
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

from locatk.formats.capture import bluetooth
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
"""Relative error of the baud rate with which a UART still samples the last bit of a byte."""

LIST_HINT = "See `locatk capture --list`"

_TERMIOS2 = struct.Struct("4I20B2I")
_TCGETS2 = 0x802C542A
"""Queries the baud rate set by the driver (Linux, include/uapi/asm-generic/ioctls.h)."""

_KEEPALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}
"""Options by which a peer that has vanished is noticed after 25 s of silence."""


def port_of(
    name: str,
    *,
    baud: int,
    speed: float = 1.0,
    keeps_time: bool = False,
    stop: threading.Event | None = None,
) -> Port:
    """Return the port of this name, not yet opened.

    Parameters
    ----------
    name : str
        Name as in the table above.
    baud : int
        Baud rate of a serial port, local or behind ``rfc2217://``.
    speed : float
        Factor on the speed of ``replay:``; 0 is as fast as possible.
    keeps_time : bool
        See :class:`.replay.ReplayPort`.
    stop : threading.Event, optional
        Ends the search for a Bluetooth device.

    Raises
    ------
    SourceError
        The name or the speed is invalid.
    """
    if baud <= 0:
        raise SourceError(f"{baud} is not a baud rate")
    kind, colon, rest = name.partition(":")
    kind = kind.lower()
    if kind == "replay" and colon:
        return ReplayPort(name, speed=speed, keeps_time=keeps_time)
    if kind == "ble" and colon:
        return bluetooth.BluetoothPort(name, stop=stop)
    if kind == "camera" and colon:
        raise SourceError("a camera, not a serial port", file=name)
    if not rest.startswith("//"):
        if not name:
            raise SourceError("the name of the port is empty", hint=LIST_HINT)
        return SerialPort(name, baud=baud)
    if kind not in URLS:
        known = ", ".join(f"{url}://" for url in URLS)
        raise SourceError("unknown kind of port", file=name, hint=f"Known kinds: {known}")
    if kind in ("socket", "rfc2217"):
        host, number = _address(name)
        if kind == "socket":
            return SocketPort(name, host, number)
    return SerialPort(name, baud=baud)


class SerialPort:
    """Serial device, or URL that pyserial opens.

    A USB device that comes back under another name is recognized by vendor, product and serial
    number. A symbolic link is always followed.
    """

    def __init__(self, name: str, *, baud: int) -> None:
        self.name = name
        self.can_reconnect = not name.lower().startswith("loop:")
        self._baud = baud
        self._resolved: str | None = None
        self._info: PortInfo | None = None
        self._other_locations: set[str | None] = set()

    def open(self) -> Link:
        """Open the port; see :class:`.links.Port`."""
        link, path = open_serial(self._present_path(), self._baud)
        self._resolved = path if "://" in path else os.path.realpath(path)
        now = find_ports()
        self._info = _find_info(self._resolved, now) or self._info
        self._other_locations = {info.location for info in self._similar_ports(now)}
        return link

    def describe(self) -> dict[str, str]:
        """Return ``port``, ``baud``; once it was open, ``resolved``; of USB ``vid`` and ``pid``
        (hexadecimal), ``serial_number``, ``product``, ``manufacturer``, ``location``.
        """
        facts: dict[str, str | None] = {
            "port": self.name,
            "resolved": self._resolved,
            "baud": str(self._baud),
        }
        info = self._info
        if info is not None:
            facts |= {
                "vid": None if info.vid is None else f"{info.vid:04x}",
                "pid": None if info.pid is None else f"{info.pid:04x}",
                "serial_number": info.serial_number,
                "product": info.product,
                "manufacturer": info.manufacturer,
                "location": info.location,
            }
        return {key: value for key, value in facts.items() if value is not None}

    def _present_path(self) -> str:
        """Return its present path: its name, or another one under which the device came back."""
        before = self._info
        if before is None or before.identity is None or "://" in self.name:
            return self.name
        if os.path.islink(self.name) and os.path.exists(self.name):
            return self.name
        now = find_ports()
        # Cheap adapters have no serial number, or all the same one; the socket identifies them.
        similar = self._similar_ports(now)
        same = [info for info in similar if info.location == before.location]
        same = same or [info for info in similar if info.location not in self._other_locations]
        if len(same) == 1:
            return same[0].device
        if similar:
            raise SourceError(
                f"disconnected; similar ports: {', '.join(each.device for each in similar)}",
                file=self.name,
                hint=f"Plug it into its former socket: USB {before.location}",
            )
        other = _find_info(os.path.realpath(self.name), now)
        if other is not None and other.identity is not None:
            raise SourceError(
                f"another device now ({other.description or other.device})",
                file=self.name,
                hint=f"Plug in {before.description or 'the first one'} again",
            )
        return self.name

    def _similar_ports(self, infos: list[PortInfo]) -> list[PortInfo]:
        known = self._info and self._info.identity
        return [info for info in infos if known and info.identity == known]


class SocketPort:
    """Raw bytes over TCP, as from ``ser2net`` or ``socat``.

    pyserial's own ``socket://`` discards the first bytes of the other side.
    """

    can_reconnect = True

    def __init__(self, name: str, host: str, number: int) -> None:
        self.name = name
        self._host = host
        self._number = number
        self._peer: str | None = None

    def open(self) -> Link:
        """Open the connection; see :class:`.links.Port`."""
        try:
            connection = socket.create_connection((self._host, self._number), CONNECT_TIMEOUT_S)
        except (OSError, UnicodeError) as error:
            raise _network_error(error, self.name) from error
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
        """Return ``port``; once it was open, ``resolved``: address and port of the other side."""
        return {"port": self.name} | ({"resolved": self._peer} if self._peer else {})


def open_serial(url: str, baud: int) -> tuple[Link, str]:
    """Return a link to a device or a URL of pyserial, and the path that was opened.

    Raises
    ------
    SourceError
        It cannot be opened.
    """
    import serial

    earlier = sys.exception()
    port: Any = None
    try:
        port = serial.serial_for_url(
            url, baudrate=baud, timeout=0, exclusive=True, do_not_open=True
        )
        port.open()
    # pyserial passes on many kinds of errors: termios.error, re.error, OverflowError, KeyError.
    except Exception as error:
        path = url if port is None or port.port is None else str(port.port)
        raise _explain_error(list(_causes(error, earlier)), url, path, baud) from error
    path = str(port.port)
    if url.lower().startswith("rfc2217:"):
        return RemoteLink(port), path
    # A class that overrides `read`, such as spy://, must receive the bytes.
    if os.name != "posix" or type(port).read is not serial.Serial.read:
        return PolledLink(port), path
    with contextlib.suppress(ValueError, NotImplementedError):  # Some drivers have no such mode.
        port.set_low_latency_mode(True)
    actual = _actual_baud(port.fileno())
    if actual and abs(actual - baud) > MAX_BAUD_ERROR_FRACTION * baud:
        port.close()
        raise _baud_error(url, baud, actual)
    # The lock of a pseudo-terminal would outlive a killed program.
    return SerialLink(port, exclusive=sys.platform == "linux" and not is_pty(path)), path


def _explain_error(errors: list[BaseException], name: str, path: str, baud: int) -> SourceError:
    """Return the error for the exceptions that were raised when ``path`` was opened."""
    if name.lower().startswith("rfc2217:"):
        if len(errors) > 1:
            return _network_error(errors[-1], name)
        address = "{0.hostname}:{0.port}".format(urlsplit(name))
        hint = f"If it does not support RFC 2217 and only sends bytes, use socket://{address}"
        return _not_opened(errors, name, hint)
    is_baud = isinstance(errors[0], ValueError) and "baud" in str(errors[0])
    if is_baud or isinstance(errors[0], OverflowError):
        return _baud_error(name, baud)
    number = next((number for number in map(_number, errors) if number), None)
    if number in (errno.ENOENT, errno.ENOTDIR):
        known = {os.path.basename(info.device): info.device for info in find_ports()}
        matches = difflib.get_close_matches(os.path.basename(path), known, 3, 0.7)
        suggestion = " or ".join(known[each] for each in matches)
        hint = f"{LIST_HINT}; did you mean {suggestion}?" if suggestion else LIST_HINT
        return SourceError("no such port", file=path, hint=hint)
    if number in (errno.EBUSY, errno.EAGAIN):
        return busy_error(name, path)
    if number in (errno.EACCES, errno.EPERM):
        return permission_error(name, path)
    if number in (errno.ENOTTY, errno.EISDIR):
        problem = "a folder, not a serial port" if os.path.isdir(path) else "not a serial port"
        hint = f"{LIST_HINT}; replay:FILE.mcap replays a session"
        return SourceError(problem, file=name, hint=hint)
    if number in (errno.ENXIO, errno.ENODEV, errno.EIO):
        hint = f"Check that it is plugged in. {LIST_HINT}"
        return SourceError("no device behind this port", file=name, hint=hint)
    if number == errno.EINVAL:
        return _baud_error(name, baud)
    return _not_opened(errors, name)


def _not_opened(errors: list[BaseException], name: str, hint: str = LIST_HINT) -> SourceError:
    # Keep the first line, without the internals that pyserial appends.
    text = str(errors[0]).partition("\n")[0].partition(" [")[0].rstrip(": ")
    problem = f"cannot be opened ({text or type(errors[0]).__name__})"
    return SourceError(problem, file=name, hint=hint)


def _baud_error(name: str, baud: int, actual: int | None = None) -> SourceError:
    instead = f"; the port uses {actual}" if actual else ""
    problem = f"{baud} baud are not supported{instead}"
    return SourceError(problem, file=name, hint="Give another --baud")


def _network_error(error: BaseException, name: str) -> SourceError:
    if isinstance(error, socket.gaierror | UnicodeError):
        problem = f"unknown host {urlsplit(name).hostname}"
        hint = "Check its spelling"
    elif isinstance(error, ConnectionRefusedError):
        problem = "no server at this address"
        hint = "Check that its server is running, and the port number"
    elif isinstance(error, TimeoutError):
        problem = "no answer"
        hint = "Check that it is switched on and in this network"
    else:
        problem = f"cannot be reached ({getattr(error, 'strerror', None) or error})"
        hint = "Check the network connection"
    return SourceError(problem, file=name, hint=hint)


def _address(name: str) -> tuple[str, int]:
    try:
        parts = urlsplit(name)
        host, number = parts.hostname, parts.port
    except ValueError:
        host = number = None
    if not host or not number:
        kind = name.partition(":")[0]
        hint = f"Example: {kind}://192.168.1.7:4000"
        raise SourceError("no host and port", file=name, hint=hint)
    return host, number


def _causes(error: BaseException, earlier: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and its causes, without those that were handled before."""
    each: BaseException | None = error
    while each is not None and each is not earlier:
        yield each
        each = each.__cause__ or each.__context__


def _number(error: BaseException) -> int | None:
    """Return the ``errno`` of an error.

    It is also found in ``termios.error``, which is no OSError, and in the text of pyserial's errors
    on Windows.
    """
    if error.args and isinstance(error.args[0], int):
        return error.args[0]
    if "FileNotFoundError" in str(error):
        return errno.ENOENT
    return errno.EBUSY if "PermissionError" in str(error) else None


def _actual_baud(number: int) -> int | None:
    """Return the baud rate set by the driver; None if it is unknown."""
    if sys.platform != "linux":
        return None
    import fcntl

    try:
        return int(_TERMIOS2.unpack(fcntl.ioctl(number, _TCGETS2, bytes(_TERMIOS2.size)))[-1])
    except OSError:
        return None


def _find_info(path: str, infos: list[PortInfo]) -> PortInfo | None:
    return next((info for info in infos if os.path.realpath(info.device) == path), None)
