#!/usr/bin/env python3
"""Stream raw Lighthouse sweeps, IMU and pose estimates of a Crazyflie to ``locatk capture``.

    pip install cflib
    python crazyflie_stream.py radio://0/80/2M/E7E7E7E7E7

and in another terminal, on the same computer::

    locatk capture socket://127.0.0.1:19860 -o flight.mcap

End the capture first, then this script, both with Ctrl-C. The Crazyflie needs a Lighthouse deck,
and firmware of after July 2021 (crazyflie-firmware, pull request 807); this script needs Python
3.10 or later.

A Crazyradio serves one program at a time. To record while your own program flies the Crazyflie, put
this file beside it and stream from there::

    with SyncCrazyflie(uri) as scf, CrazyflieStream(scf.cf):
        ...  # fly

This file is part of locatk and under its licence (BSD-3-Clause), and needs nothing else of it. It
uses cflib of Bitcraze AB, which is under the GPL: copies that you pass on together with cflib are
subject to the GPL. locatk itself does not contain, import or install cflib.

What is sent: frames of the locatk protocol (docs/firmware/README.md), in a TCP connection.

===================  ==========================================================================
LIGHTHOUSE_DECK 10   packets of port 6, channel 3 as received (``lighthouse.enLhRawStream``)
IMU 8                ``acc`` and ``gyro``, converted to m/s^2 and rad/s
POSE 9               ``stateEstimate``, with the attitude as a quaternion
TEXT 2               messages for the log of the session
===================  ==========================================================================

Packets of the log that the radio lost are found by their times. Each uses up a sequence number, so
that ``locatk capture`` counts it as missing. Packets of sweeps carry no number: their loss cannot
be told from light that was blocked.
"""

from __future__ import annotations

import argparse
import binascii
import logging
import math
import queue
import signal
import socket
import struct
import sys
import threading
import time

try:
    import cflib.crtp
    from cflib.crazyflie.log import LogConfig
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
    from cflib.crtp.crtpstack import CRTPPort
except ImportError as missing:
    sys.exit(f"Error: cflib cannot be imported ({missing}). Hint: pip install cflib")

URI = "radio://0/80/2M/E7E7E7E7E7"
"""Address of a Crazyflie as delivered."""

HOST, PORT = "127.0.0.1", 19860

RAW_STREAM = "lighthouse.enLhRawStream"
"""Parameter that switches the stream of raw sweeps on."""

DECK = "deck.bcLighthouse4"
"""Parameter that is 1 if a Lighthouse deck was found."""

RAW_CHANNEL = 3
"""Channel of raw sweeps on the port of localization."""

LOCALIZATION_CHANNEL = 1
"""Channel of the other packets of localization that a Crazyflie sends."""

PASSAGE_BYTES = 14
"""Size of a passage of a light plane in a packet of raw sweeps, which has one or two."""

IMU_PERIOD_MS, POSE_PERIOD_MS = 10, 20
IMU_VARIABLES = ("acc.x", "acc.y", "acc.z", "gyro.x", "gyro.y", "gyro.z")
POSE_VARIABLES = tuple(f"stateEstimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw"))
"""Six floats each: a packet of the log holds no more."""

STANDARD_GRAVITY_M_S2 = 9.80665

TICK_HZ = 1000
"""Rate of the clock of the log, in which the frames have their ticks."""

LOG_CLOCK_TICKS = 1 << 24
"""Number of ticks after which the clock of the log wraps: 4.7 hours."""

HINT = (
    "Hint: plug in the Crazyradio, switch the Crazyflie on, check its address and its distance, "
    "and end other programs that use the radio (cfclient)"
)

HELLO, TEXT, IMU, POSE, LIGHTHOUSE_DECK = 1, 2, 8, 9, 10
INFO, WARNING = 2, 3

HELLO_INTERVAL_S = 1.0
STATUS_INTERVAL_S = 5.0
SWITCH_OFF_TIMEOUT_S = 1.0

MAX_WAITING_FRAMES = 5000
"""Frames that wait for a slow receiver, some ten seconds; more are dropped."""


class StreamError(Exception):
    """The stream cannot start; the message has a hint."""


def print_message(text: str) -> None:
    """Print a message for the user."""
    print(text, file=sys.stderr, flush=True)


def encode_frame(kind: int, sequence: int, tick: int, payload: bytes) -> bytes:
    """Return a frame of the locatk protocol: content and CRC in COBS, and a zero byte."""
    content = struct.pack("<BBHI", kind, 0, sequence & 0xFFFF, tick & 0xFFFFFFFF) + payload
    content += struct.pack("<H", binascii.crc_hqx(content, 0xFFFF))
    pieces = []
    for piece in content.split(b"\0"):
        for start in range(0, len(piece) - 253, 254):
            pieces.append(b"\xff" + piece[start : start + 254])
        rest = piece[len(piece) - len(piece) % 254 :]
        pieces.append(bytes([len(rest) + 1]) + rest)
    return b"".join(pieces) + b"\0"


def encode_series(values: tuple[float, ...]) -> bytes:
    """Return the payload of one sample."""
    return struct.pack("<BBBBI", 1, 1, 0, 0, 0) + struct.pack(f"<{len(values)}f", *values)


def quaternion_xyzw(roll_deg: float, pitch_deg: float, yaw_deg: float) -> tuple[float, ...]:
    """Return the attitude of ``stateEstimate``, of which the pitch has the opposite sign."""
    roll, pitch, yaw = (math.radians(angle) / 2 for angle in (roll_deg, -pitch_deg, yaw_deg))
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


class CaptureServer:
    """TCP server that passes frames to one ``locatk capture`` at a time.

    Frames are discarded while none is connected.
    """

    def __init__(self, name: str, host: str, port: int) -> None:
        self._name = name
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            raise StreamError(
                f"cannot listen at {host}:{port} ({error}). Hint: give another --port"
            ) from error
        self._listener.settimeout(0.2)
        self._frames: queue.Queue[tuple[int, int, bytes, int]] = queue.Queue(MAX_WAITING_FRAMES)
        self._sequence = self._tick = self._dropped = 0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.is_connected = False
        self._thread = threading.Thread(target=self._run, name="capture-server", daemon=True)
        self._thread.start()

    def send(self, kind: int, tick: int, payload: bytes, lost: int = 0) -> None:
        """Send a frame, after ``lost`` ones that were lost before."""
        with self._lock:
            self._tick = tick
            if not self.is_connected:
                return
            try:
                self._frames.put_nowait((kind, tick, payload, lost + self._dropped))
                self._dropped = 0
            except queue.Full:
                self._dropped += lost + 1

    def send_text(self, level: int, text: str) -> None:
        """Send a message for the log of the session."""
        self.send(TEXT, self._tick, bytes([level]) + text.encode()[:200])

    def close(self) -> None:
        """Send the frames that wait, and close the connection."""
        self._stop.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(5.0)
                # A frame must not wait for the next one: the clocks are synchronized by arrivals.
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                print_message("locatk capture is connected")
                try:
                    self._serve(connection)
                except OSError:
                    print_message("locatk capture has ended")
                with self._lock:
                    self.is_connected = False
                    self._frames.queue.clear()

    def _serve(self, connection: socket.socket) -> None:
        """Send frames until there are no more; raises OSError if the connection is closed."""
        hello = struct.pack("<B3xI", 1, TICK_HZ) + self._name.encode()
        hello_due = 0.0
        while True:
            now = time.monotonic()
            frames = []
            if now >= hello_due:
                hello_due = now + HELLO_INTERVAL_S
                frames.append((HELLO, self._tick, hello, 0))
            self.is_connected = True
            try:
                frames.append(self._frames.get(timeout=0.1))
                while len(frames) < MAX_WAITING_FRAMES:
                    frames.append(self._frames.get_nowait())
            except queue.Empty:
                if self._stop.is_set() and not frames:
                    return
            connection.sendall(b"".join(self._encode(*frame) for frame in frames))

    def _encode(self, kind: int, tick: int, payload: bytes, lost: int) -> bytes:
        frame = encode_frame(kind, self._sequence + lost, tick, payload)
        self._sequence += lost + 1
        return frame


class LogBlock:
    """Times of the packets of one block of the log, from which lost ones are counted."""

    def __init__(self, name: str, period_ms: int, variables: tuple[str, ...]) -> None:
        self.name = name
        self.period_ms = period_ms
        self.variables = variables
        self.received = self.lost = 0
        self._first = 0

    def count_lost(self, tick: int) -> int:
        """Count a packet; return the number of packets that were lost since the last one."""
        if not self.received:
            self._first = tick
        self.received += 1
        # From the first packet on, so that the jitter of the times does not add up.
        sent = round((tick - self._first) / self.period_ms) + 1
        lost = max(0, sent - self.received - self.lost)
        self.lost += lost
        return lost


class CrazyflieStream:
    """Sends the data of a connected Crazyflie, from ``start`` to ``stop``.

    Parameters
    ----------
    crazyflie : cflib.crazyflie.Crazyflie
        With an open link; not in one of its callbacks.
    host, port
        Address at which ``locatk capture`` connects.

    Raises
    ------
    StreamError
        The address is in use, or the firmware has no stream of raw sweeps.
    """

    def __init__(self, crazyflie, host: str = HOST, port: int = PORT) -> None:
        self._crazyflie = crazyflie
        self._address = host, port
        self._log_configs: list[LogConfig] = []
        self._tick: int | None = None
        self.imu = LogBlock("imu", IMU_PERIOD_MS, IMU_VARIABLES)
        self.poses = LogBlock("poses", POSE_PERIOD_MS, POSE_VARIABLES)
        self.passages = self.invalid_packets = 0
        self.channels: set[int] = set()

    def __enter__(self) -> CrazyflieStream:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Open the server, and let the Crazyflie send."""
        crazyflie = self._crazyflie
        if crazyflie.param.toc.get_element_by_complete_name(RAW_STREAM) is None:
            raise StreamError(
                f"the firmware has no parameter {RAW_STREAM}. Hint: update the firmware"
            )
        self.server = CaptureServer(f"Crazyflie {crazyflie.link_uri}", *self._address)
        try:
            # cflib takes packets of all channels of this port for those of one of them, and would
            # decode raw sweeps as angles.
            if misreading := getattr(crazyflie.loc, "_incoming", None):
                port = CRTPPort.LOCALIZATION
                crazyflie.remove_port_callback(port, misreading)
                crazyflie.remove_header_callback(misreading, port, LOCALIZATION_CHANNEL)
                crazyflie.add_header_callback(misreading, port, LOCALIZATION_CHANNEL)
            crazyflie.add_header_callback(self._take_passages, CRTPPort.LOCALIZATION, RAW_CHANNEL)
            for block, take in ((self.imu, self._take_imu), (self.poses, self._take_pose)):
                config = LogConfig(block.name, block.period_ms)
                for name in block.variables:
                    config.add_variable(name, "float")
                crazyflie.log.add_config(config)
                config.data_received_cb.add_callback(take)
                config.start()
                self._log_configs.append(config)
            crazyflie.param.set_value(RAW_STREAM, 1)
            has_parameter = crazyflie.param.toc.get_element_by_complete_name(DECK) is not None
            if has_parameter and crazyflie.param.get_value(DECK) == "0":
                print_message("Warning: the Crazyflie has not found a Lighthouse deck")
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Switch the stream off, and close the server after its last frame."""
        crazyflie = self._crazyflie
        crazyflie.remove_header_callback(self._take_passages, CRTPPort.LOCALIZATION, RAW_CHANNEL)
        if crazyflie.is_connected():
            for config in self._log_configs:
                config.stop()
            is_off = threading.Event()
            group, name = RAW_STREAM.split(".")
            crazyflie.param.add_update_callback(group, name, lambda *_: is_off.set())
            crazyflie.param.set_value(RAW_STREAM, 0)
            # The value is sent by a thread, which ends with the link.
            if not is_off.wait(SWITCH_OFF_TIMEOUT_S):
                print_message("Warning: the Crazyflie did not confirm that its stream is off")
        for block in (self.imu, self.poses):
            if block.lost:
                self.server.send_text(WARNING, self._losses(block))
        self.server.close()

    def status(self) -> str:
        """Return what was received so far, in a line."""
        channels = ", ".join(map(str, sorted(self.channels))) or "none"
        counts = (
            f"{self.passages} passages of light (channels: {channels}), {self.imu.received} imu, "
            f"{self.poses.received} poses"
        )
        faults = [self._losses(block) for block in (self.imu, self.poses) if block.lost]
        if self.invalid_packets:
            faults.append(f"{self.invalid_packets} packets of sweeps of another length")
        return "; ".join([counts, *faults])

    def _losses(self, block: LogBlock) -> str:
        sent = block.lost + block.received
        return f"{block.lost} of {sent} packets of {block.name} lost by radio"

    def _take_passages(self, packet) -> None:
        data = bytes(packet.data)
        if not data or len(data) % PASSAGE_BYTES:
            self.invalid_packets += 1
            return
        self.passages += len(data) // PASSAGE_BYTES
        self.channels |= {(data[k + 2] >> 4) + 1 for k in range(0, len(data), PASSAGE_BYTES)}
        self.server.send(LIGHTHOUSE_DECK, self._tick or 0, data)

    def _take_imu(self, stamp: int, values: dict[str, float], _: object) -> None:
        acceleration = (values[name] * STANDARD_GRAVITY_M_S2 for name in IMU_VARIABLES[:3])
        angular_rate = (math.radians(values[name]) for name in IMU_VARIABLES[3:])
        self._send(IMU, self.imu, stamp, (*acceleration, *angular_rate))

    def _take_pose(self, stamp: int, values: dict[str, float], _: object) -> None:
        x, y, z, *angles = (values[name] for name in POSE_VARIABLES)
        self._send(POSE, self.poses, stamp, (x, y, z, *quaternion_xyzw(*angles)))

    def _send(self, kind: int, block: LogBlock, stamp: int, values: tuple[float, ...]) -> None:
        if self._tick is None:
            self._tick = stamp
        half = LOG_CLOCK_TICKS // 2
        tick = self._tick + (stamp - self._tick + half) % LOG_CLOCK_TICKS - half
        self._tick = max(self._tick, tick)
        self.server.send(kind, tick, encode_series(values), block.count_lost(tick))


def run(uri: str, host: str, port: int) -> int:
    """Stream until Ctrl-C, or until the connection is lost; return the exit status."""
    cflib.crtp.init_drivers()
    print_message(f"Connecting to {uri}")
    lost: list[str] = []
    with SyncCrazyflie(uri) as connected:
        connected.cf.connection_lost.add_callback(lambda _, reason: lost.append(str(reason)))
        with CrazyflieStream(connected.cf, host, port) as stream:
            print_message(f"Streaming. Record with: locatk capture socket://{host}:{port} -o ...")
            try:
                due = time.monotonic() + STATUS_INTERVAL_S
                while not lost:
                    time.sleep(0.1)
                    if time.monotonic() >= due:
                        due += STATUS_INTERVAL_S
                        print_message(stream.status())
            except KeyboardInterrupt:
                pass
    print_message(stream.status())
    if lost:
        print_message(f"Error: {uri}: connection lost ({_first_line(lost[0])}). {HINT}")
    return int(bool(lost))


def _first_line(text: object) -> str:
    return str(text).strip().partition("\n")[0]


def main() -> int:
    """Parse the arguments, and stream."""
    parser = argparse.ArgumentParser(
        description="Stream raw Lighthouse sweeps, IMU and pose estimates of a Crazyflie to "
        "`locatk capture`.",
    )
    parser.add_argument(
        "uri", nargs="?", default=URI, help="of the Crazyflie (default: %(default)s)"
    )
    parser.add_argument(
        "--host",
        default=HOST,
        help="address to listen at; 0.0.0.0 for other computers (default: %(default)s)",
    )
    parser.add_argument("--port", type=int, default=PORT, help="(default: %(default)s)")
    arguments = parser.parse_args()
    # Its errors, with tracebacks, are raised as exceptions as well.
    logging.getLogger("cflib").setLevel(logging.CRITICAL)
    # End in the same way if the terminal is closed, or a program ends this one.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return run(arguments.uri, arguments.host, arguments.port)
    except KeyboardInterrupt:
        return 1
    except StreamError as error:
        print_message(f"Error: {arguments.uri}: {error}")
    except Exception as error:  # cflib raises plain Exceptions.
        print_message(f"Error: {arguments.uri}: {_first_line(error)}. {HINT}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
