"""Sink ``udp://host:port``: one datagram an event, JSON or the packed format of :data:`PACKED`."""

from __future__ import annotations

import errno
import math
import socket
import struct
from typing import Any

from locatk.core.streaming.events import LiveEvent, PoseEstimate, StateChange, TrackingState
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage
from locatk.formats.sinks.json_messages import dump, event_to_json
from locatk.formats.sinks.queued import QueuedSink

PACKED = struct.Struct("<2sBBBxHq16s3f4f6f")
"""Layout of a packed datagram, little-endian, 84 bytes: magic ``LK``, version, state
(:data:`STATE_CODES`), reset counter, a byte that is 0, sequence number, time [ns since the epoch],
name of the device (UTF-8, ended by NUL), position [m], quaternion (x, y, z, w), standard deviations
of x, y, z [m] and of the rotations about x, y, z [rad]. Unknown numbers are NaN."""

MAGIC = b"LK"

PACKED_VERSION = 1

MAX_NAME_BYTES = 15
"""Longer names of devices are cut, between characters."""

STATE_CODES = {
    TrackingState.LOST: 0,
    TrackingState.PROVISIONAL: 1,
    TrackingState.DEAD_RECKONING: 2,
    TrackingState.TRACKING: 3,
}
"""The larger, the better."""


def create(address: SinkAddress) -> UdpSink:
    """Return the sink of ``udp://host:port?format=json|packed``."""
    return UdpSink(address)


class UdpSink(QueuedSink):
    """Sends datagrams to a host, a multicast group or a broadcast address (IPv4 or IPv6).

    Packed datagrams carry poses, and a pose of NaN when a device is lost.
    """

    def __init__(self, address: SinkAddress) -> None:
        address.reject_unknown_options("format")
        self._host, self._port = address.require_host(), address.require_port()
        self._is_packed = address.choice("format", "json", "packed") == "packed"
        super().__init__(address, f"udp://{address.host_and_port}")
        self._socket: socket.socket | None = None
        self._receiver: Any = None
        self._sequence = 0

    def start(self) -> None:
        """Resolve the name of the host."""
        self._socket, self._receiver = open_socket(self._host, self._port)

    def send(self, message: LiveMessage) -> int:
        """Send one datagram; a packed one only for poses and lost devices."""
        assert self._socket is not None
        if self._is_packed:
            packed = pack(message.event, self._sequence)
            if packed is None:
                return 0
            datagram = packed
        else:
            datagram = dump(event_to_json(message.event, message.latency_s()))
        try:
            self._socket.sendto(datagram, self._receiver)
        except OSError as error:
            if error.errno == errno.EMSGSIZE:  # It would be too long again.
                raise ValueError(f"a message of {len(datagram)} bytes is no datagram") from error
            raise
        self._sequence = (self._sequence + 1) & 0xFFFF
        return 1

    def stop(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


def open_socket(host: str, port: int) -> tuple[socket.socket, Any]:
    """Return a socket for datagrams to a host, also a broadcast address, and its address.

    Raises
    ------
    OSError
        The name of the host cannot be resolved.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    # IPv4 first: most receivers on localhost listen there, and few on ::1.
    found.sort(key=lambda each: each[0] != socket.AF_INET)
    family, kind, protocol, _, address = found[0]
    opened = socket.socket(family, kind, protocol)
    if family == socket.AF_INET:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    return opened, address


def pack(event: LiveEvent, sequence: int) -> bytes | None:
    """Return the packed datagram of an event, None if it has none."""
    if isinstance(event, PoseEstimate):
        quaternion = event.quaternion.tolist() if event.has_orientation else [math.nan] * 4
        numbers = event.position.tolist() + quaternion + event.sigma.tolist()
        state, counter = event.state, event.reset_counter
    elif isinstance(event, StateChange) and event.state == TrackingState.LOST:
        numbers = [math.nan] * 13
        state, counter = event.state, 0
    else:
        return None
    name = event.device.encode()[:MAX_NAME_BYTES].decode(errors="ignore").encode()
    return PACKED.pack(
        MAGIC,
        PACKED_VERSION,
        STATE_CODES[state],
        counter,
        sequence,
        event.time_ns,
        name,
        *numbers,
    )
