"""Sink ``mavlink:``: the pose of one vehicle for PX4 or ArduPilot, over UDP or a serial port."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from locatk.core.errors import InputError
from locatk.core.streaming.events import PoseEstimate
from locatk.formats.sinks.addresses import SinkAddress
from locatk.formats.sinks.interface import LiveMessage
from locatk.formats.sinks.mavlink_messages import Encoder, timesync_requests
from locatk.formats.sinks.queued import QueuedSink
from locatk.formats.sinks.udp import open_socket

MIN_PERIOD_S = 0.02
"""Least time between two poses. ArduPilot drops those that come sooner (50 Hz)."""

HEARTBEAT_PERIOD_S = 1.0

READ_TIMEOUT_S = 0.2
"""Longest wait for received bytes, after which the reader looks whether it must end."""

DEFAULT_BAUD = 921_600
"""Rate of the TELEM2 port of PX4 for companion computers."""

EXAMPLE = "Example: mavlink:udpout:192.168.1.10:14550 or mavlink:serial:/dev/ttyUSB0:921600"


def create(address: SinkAddress) -> MavlinkSink:
    """Return the sink of ``mavlink:udpout:host:port``, ``udpin:...`` or ``serial:port:baud``."""
    return MavlinkSink(address)


class MavlinkSink(QueuedSink):
    """Sends ODOMETRY with at most 50 Hz, HEARTBEAT with 1 Hz, and answers TIMESYNC.

    It serves one vehicle: that of the option ``device``, else the first one with a pose. Poses
    between two that are sent are left out, and do not count as dropped.
    """

    def __init__(self, address: SinkAddress) -> None:
        address = address.with_path_options()
        address.reject_unknown_options("device", "sysid", "frame", "message")
        super().__init__(address, address.path)
        self._link = _link(address)
        self._encoder = Encoder(address.integer("sysid", 1, 1, 255))
        self._is_ned = address.choice("frame", "frd", "ned") == "ned"
        self._is_odometry = address.choice("message", "odometry", "vision") == "odometry"
        self._device = address.options.get("device", "")
        self._is_chosen = bool(self._device)
        self._newest: PoseEstimate | None = None
        self._last_pose_s = self._last_heartbeat_s = float("-inf")
        self._sending = threading.Lock()
        self._is_ended = threading.Event()
        self._is_failing = False

    def prepare(self) -> None:
        """Refuse several devices without a choice."""
        devices = self.context.devices
        if len(devices) > 1 and not self._is_chosen:
            raise InputError(
                f"{len(devices)} devices for one vehicle of {self.address}",
                hint=f"Add device=NAME: {', '.join(devices)}",
            )

    def start(self) -> None:
        """Open the link, and begin to read."""
        self._link.open()
        threading.Thread(target=self._read, name="sink mavlink reader", daemon=True).start()

    def send(self, message: LiveMessage) -> int:
        """Keep a pose of the vehicle until it is due."""
        pose = message.event
        if not isinstance(pose, PoseEstimate):
            return 0
        self._device = self._device or pose.device
        if pose.device != self._device:
            if not self._is_chosen:
                self.report_error(f"poses of {pose.device!r}, too: choose with device=NAME")
            return 0
        if not pose.has_orientation:
            raise ValueError(f"{pose.device!r} has no orientation, which autopilots need")
        self._newest = pose
        self.tick()
        return 0  # Counted when it is sent.

    def tick(self) -> float | None:
        """Send a heartbeat and the newest pose, if they are due."""
        now_s = time.monotonic()
        if now_s - self._last_heartbeat_s >= HEARTBEAT_PERIOD_S:
            self._write(self._encoder.heartbeat)
            self._last_heartbeat_s = now_s
        due_s = self._last_heartbeat_s + HEARTBEAT_PERIOD_S
        if self._newest is not None:
            if now_s - self._last_pose_s >= MIN_PERIOD_S:
                self._last_pose_s = now_s
                self._send_newest()
            else:
                due_s = min(due_s, self._last_pose_s + MIN_PERIOD_S)
        return max(due_s - now_s, 0.0)

    def stop(self) -> None:
        """Send the last pose, and close the link."""
        self._is_ended.set()
        try:
            if self._newest is not None:
                self._send_newest()
        finally:
            self._link.close()

    def _send_newest(self) -> None:
        pose = self._newest
        assert pose is not None
        encode = self._encoder.odometry if self._is_odometry else self._encoder.vision_position
        self._write(lambda: encode(pose, self._is_ned))
        self._newest = None
        self.count(sent=1)

    def _write(self, encode: Callable[[], bytes]) -> None:
        try:
            with self._sending:  # The reader answers between: sequence numbers must follow on.
                self._link.write(encode())
        except OSError as error:
            self._is_failing = True
            self.report_error(error)
            raise
        if self._is_failing:
            self._is_failing = False
            self.report_error("")

    def _read(self) -> None:
        """Answer TIMESYNC until the sink ends."""
        buffer = bytearray()
        while not self._is_ended.is_set():
            try:
                buffer += self._link.read()
                for request_ns in timesync_requests(buffer):
                    self._write(partial(self._encoder.timesync, time.time_ns(), request_ns))
            except Exception:  # The sender reports it; pyserial raises any if closed while reading.
                self._is_ended.wait(READ_TIMEOUT_S)


class _Link(Protocol):
    """Bytes to and from an autopilot."""

    def open(self) -> None:
        """Open it."""

    def write(self, data: bytes) -> None:
        """Send a frame."""

    def read(self) -> bytes:
        """Return what has come, after at most :data:`READ_TIMEOUT_S`."""

    def close(self) -> None:
        """Close it."""


class _UdpOut:
    """Datagrams to a host."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None
        self._receiver: Any = None

    def open(self) -> None:
        self._socket, address = open_socket(self._host, self._port)
        self._socket.settimeout(READ_TIMEOUT_S)
        self._begin(address)

    def _begin(self, address: Any) -> None:
        self._receiver = address

    def write(self, data: bytes) -> None:
        assert self._socket is not None
        if self._receiver is None:
            raise ConnectionError(f"no autopilot has sent to port {self._port} yet")
        self._socket.sendto(data, self._receiver)

    def read(self) -> bytes:
        assert self._socket is not None
        try:
            data, _ = self._socket.recvfrom(4096)
        except TimeoutError:
            return b""
        return data

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()


class _UdpIn(_UdpOut):
    """Datagrams on a port of this computer, answered to the one who sent the last."""

    def _begin(self, address: Any) -> None:
        assert self._socket is not None
        self._socket.bind(address)

    def read(self) -> bytes:
        assert self._socket is not None
        try:
            data, self._receiver = self._socket.recvfrom(4096)
        except TimeoutError:
            return b""
        return data


class _Serial:
    """Serial port. After it was unplugged, it is opened again."""

    def __init__(self, port: str, baud: int) -> None:
        self._port, self._baud = port, baud
        self._serial: Any = None

    def open(self) -> None:
        import serial

        self._serial = serial.Serial(
            self._port, self._baud, timeout=READ_TIMEOUT_S, write_timeout=READ_TIMEOUT_S
        )

    def write(self, data: bytes) -> None:
        if not self._serial.is_open:
            self._serial.open()
        try:
            self._serial.write(data)
        except OSError:
            self._serial.close()
            raise

    def read(self) -> bytes:
        first: bytes = self._serial.read(1)
        return first + bytes(self._serial.read(self._serial.in_waiting)) if first else b""

    def close(self) -> None:
        if self._serial is not None:
            self._serial.close()


def _link(address: SinkAddress) -> _Link:
    """Return the link of ``udpout:host:port``, ``udpin:host:port`` or ``serial:port:baud``."""
    kind, _, rest = address.path.partition(":")
    name, _, number = rest.rpartition(":")
    if kind == "serial":
        # "serial:COM7" and "serial:/dev/ttyACM0" have no rate.
        if not name or not number.isdigit():
            name, number = rest, str(DEFAULT_BAUD)
        if name:
            return _Serial(name, int(number))
    if kind in ("udpout", "udpin") and name and number.isdigit() and 0 < int(number) < 65536:
        host = name.strip("[]")
        return _UdpOut(host, int(number)) if kind == "udpout" else _UdpIn(host, int(number))
    raise InputError(f"no link in {address.public_text}", hint=EXAMPLE)
