"""Text output of ``locatk live``: a line per device on a terminal, or a JSON object per line."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import stat
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from locatk.cli import console
from locatk.cli.capture import text as capture_text

REFRESH_S = 0.25
"""Interval at which the lines of a terminal change."""

MAX_WAITING = 10_000
"""JSON lines that wait for a slow reader of stdout; older ones are dropped and counted."""

COLOURS = {
    "tracking": "green",
    "provisional": "yellow",
    "dead reckoning": "cyan",
    "lost": "red",
}
"""Colour of each state."""


class LiveText:
    """Sink that prints: lines that change on a terminal, or JSON.

    Parameters
    ----------
    as_json : bool
        Print JSON even on a terminal.
    stop : callable, optional
        Called when the reader of stdout has ended: nobody else gets the poses.
    """

    address = "stdout"

    def __init__(self, *, as_json: bool, stop: Callable[[], None] = lambda: None) -> None:
        self._stop = stop
        self._is_json = as_json or not sys.stdout.isatty()
        self._is_discarded = not as_json and _is_null_device(sys.stdout)
        self._lines = 0
        self._waiting: deque[Any] = deque(maxlen=MAX_WAITING)
        self._filled = threading.Event()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._sent = self._dropped = 0
        self._error = ""
        self._session: Any = None

    # ---- sink

    def open(self, context: Any) -> None:
        """Start the thread that prints."""
        target = self._print_json if self._is_json else self._refresh
        self._thread = threading.Thread(target=target, name="locatk-text", daemon=True)
        self._thread.start()

    def offer(self, message: Any) -> None:
        """Take a message; see :class:`locatk.formats.sinks.interface.Sink`."""
        if not self._is_json or self._is_discarded:
            return
        if len(self._waiting) == MAX_WAITING:
            self._dropped += 1
        self._waiting.append(message)
        self._filled.set()

    def status(self) -> Any:
        """Return the counts."""
        from locatk.formats.sinks.interface import SinkStatus

        return SinkStatus(self._sent, self._dropped, None, self._error, self.address)

    def close(self, timeout_s: float) -> None:
        """Print what is waiting, and stop."""
        self._stopping.set()
        self._filled.set()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _print_json(self) -> None:
        from locatk.formats.sinks.json_messages import event_to_json

        while not (self._stopping.is_set() and not self._waiting):
            self._filled.wait()
            self._filled.clear()
            lines = []
            for _ in range(len(self._waiting)):
                message = self._waiting.popleft()
                lines.append(json.dumps(event_to_json(message.event, message.latency_s())))
            if lines:
                console.write_result("\n".join(lines) + "\n")
                lost = console.lost_results()
                if lost is None:
                    self._sent += len(lines)
                else:
                    self._dropped += len(lines)
                    self._error = f"stdout cannot be written ({lost.strerror or lost})"
                    self._stop()

    # ---- terminal

    @contextlib.contextmanager
    def shown(self, session: Any) -> Iterator[None]:
        """Return a context manager during which the devices of a session are shown."""
        self._session = session
        try:
            yield
        finally:
            self._stopping.set()
            self._filled.set()
            with self._lock:
                self._wipe()

    def ready(self, ports: Sequence[str], sinks: Sequence[Any]) -> None:
        """Report that inputs and sinks are open."""
        self._say(f"Localizing {', '.join(ports)}; Ctrl-C ends it.")
        for sink in sinks:
            # The address of a server for its clients contains the token.
            address = getattr(sink, "url", "") or sink.status().address or sink.address
            self._say(f"Sending to {address}")

    def waiting(self, why: str) -> None:
        """Report a port that is not available yet."""
        self._say(f"Waiting: {why}; Ctrl-C ends it.")

    def tell(self, text: str) -> None:
        """Report an event."""
        with self._lock:
            self._wipe()
            console.warn(text)

    def _say(self, text: str) -> None:
        with self._lock:
            self._wipe()
            console.say(text)

    def _refresh(self) -> None:
        while console.talks() and not self._stopping.wait(REFRESH_S):
            lines = device_lines(self._session.devices, shutil.get_terminal_size().columns)
            with self._lock:
                self._wipe()
                if lines and not self._stopping.is_set():
                    console.control("\n".join(lines) + "\n")
                    self._lines = len(lines)

    def _wipe(self) -> None:
        """Remove the lines of the devices."""
        if self._lines:
            console.control(f"\x1b[{self._lines}A\x1b[J")
            self._lines = 0

    def summary(self, result: Any) -> None:
        """Print the result of a session."""
        if self._is_json:
            return
        for recording in result.recordings:
            console.result(capture_text.summary(recording))
        counts = ", ".join(f"{count} of {name}" for name, count in sorted(result.poses.items()))
        ended = capture_text.ENDS.get(result.ended, result.ended)
        console.result(f"Poses: {counts or 'none'}; {ended}")
        for sink in result.status["sinks"]:
            if sink["dropped"] or sink["error"]:
                error = f"; {sink['error']}" if sink["error"] else ""
                console.result(
                    f"{sink['address']}: {sink['sent']} sent, {sink['dropped']} dropped{error}"
                )


def _is_null_device(stream: Any) -> bool:
    """Return whether a stream discards everything, as that of a service."""
    try:
        status = os.fstat(stream.fileno())
        return stat.S_ISCHR(status.st_mode) and status.st_rdev == os.stat(os.devnull).st_rdev
    except (OSError, ValueError, AttributeError):
        return False


def device_lines(devices: dict[str, Any], columns: int) -> list[str]:
    """Return a line per device that fits into ``columns`` characters.

    On a narrow terminal, rate and latency are omitted before the state would be cut off.
    """
    lines = []
    for name, device in sorted(devices.items()):
        line = console.on_one_line(f"{name:<10} {_device_text(device)}")
        if len(line) >= columns:
            line = console.on_one_line(f"{name:<10} {_device_text(device, is_short=True)}")
        lines.append(console.colour(line[: columns - 1], COLOURS[str(device.state)]))
    return lines


def _device_text(device: Any, *, is_short: bool = False) -> str:
    pose = device.pose
    state = f"{device.state}" + (f": {device.reason}" if device.reason else "")
    if pose is None:
        return state
    x, y, z = (f"{value:8.3f}" for value in pose.position.tolist())
    sigma = pose.sigma
    spread = math.sqrt(max(sum(s * s for s in sigma[:2].tolist()), 0.0))
    heading = ""
    if pose.has_orientation:
        qx, qy, qz, qw = pose.quaternion.tolist()
        yaw = math.degrees(math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))
        heading = f" {yaw:7.1f} deg"
    rate = f"{device.rate_hz:5.1f}/s  {1e3 * device.latency_s:4.1f} ms  "
    return f"{x} {y} {z} m{heading}  +-{1e3 * spread:.1f} mm  {'' if is_short else rate}{state}"
