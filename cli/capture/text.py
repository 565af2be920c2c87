"""Text output of ``locatk capture``: status line, summary, and list of ports."""

from __future__ import annotations

import contextlib
import math
import shutil
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from locatk.cli import console

ENDS = {
    "duration": "ended after --duration",
    "max-size": "ended at --max-size",
    "stopped": "stopped",
}
"""Reasons for the end of a recording, as text."""


MIN_BACKLOG_BYTES = 1_000_000
"""Smallest backlog that the status line shows: 0.3 s of 3 MB/s."""


class Live:
    """Messages during a recording.

    On a terminal, one status line changes each second, with the events above it; otherwise
    a line is written each second.
    """

    def __init__(self) -> None:
        self._shown = console.talks()
        self._terminal = sys.stderr.isatty()
        self._width = 0

    def ready(self, port: str) -> None:
        """Report that the port is open."""
        console.say(f"Recording {port}; Ctrl-C ends it.")

    def waiting(self, why: str) -> None:
        """Report a port that is not available yet."""
        console.say(f"Waiting: {why}; Ctrl-C ends it.")

    def tell(self, text: str) -> None:
        """Report an event."""
        self.wipe()
        console.warn(text)

    def show(self, status: Any) -> None:
        """Show the status."""
        self.line(status_line(status))

    def line(self, text: str) -> None:
        """Show a text in the place of the status line."""
        if not self._shown:
            return
        if self._terminal:
            text = text[: shutil.get_terminal_size().columns - 1]
            console.control("\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            console.message(text)

    def wipe(self) -> None:
        """Remove the status line."""
        if self._width:
            console.control("\r" + " " * self._width + "\r")
            self._width = 0


@contextlib.contextmanager
def live() -> Iterator[Live]:
    """Yield the messages of a recording, and remove the status line at the end."""
    messages = Live()
    try:
        yield messages
    finally:
        messages.wipe()


def status_line(status: Any) -> str:
    """Return the status in one line: rates, losses, sizes; counts of zero are left out."""
    totals = status.totals
    away = status.away_s
    words = [
        clock(status.elapsed_s),
        f"{size(status.bytes_per_s)}/s" if away is None else f"away for {away:.0f} s",
        f"{status.frames_per_s:.0f} frames/s",
        f"{totals.bad} bad",
        f"{totals.lost} missing",
        *([f"{totals.overruns} overrun"] if totals.overruns else []),
        *([f"{totals.gaps} gap{'' if totals.gaps == 1 else 's'}"] if totals.gaps else []),
        *([f"backlog {size(totals.high_water_bytes)}"] if _has_backlog(totals) else []),
        f"file {size(status.file_bytes)}",
        *([f"disk {size(status.free_bytes)}"] if status.free_bytes is not None else []),
    ]
    return "  ".join(words)


def _has_backlog(totals: Any) -> bool:
    return bool(totals.high_water_bytes >= MIN_BACKLOG_BYTES)


def clock(seconds: float) -> str:
    """Return a duration as ``m:ss`` or ``h:mm:ss``."""
    minutes, remainder = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{remainder:02d}" if hours else f"{minutes}:{remainder:02d}"


def size(count: float) -> str:
    """Return a number of bytes with three digits and a unit."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{number(count / factor)} {unit}"
    return f"{count:.0f} B"


def number(value: float) -> str:
    """Return a number with three digits, or as an integer."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def summary(recorded: Any) -> str:
    """Return the summary of a finished recording."""
    totals = recorded.totals
    seconds = (recorded.ended_ns - recorded.started_ns) * 1e-9
    files = ", ".join(map(str, recorded.paths[:3]))
    if len(recorded.paths) > 3:
        files += f" and {len(recorded.paths) - 3} more"
    source = f" from {recorded.device}" if recorded.device else ""
    ended = ENDS.get(recorded.ended, recorded.ended)
    lines = [
        f"{files}: {clock(seconds)}, {size(totals.bytes)} received{source}",
        f"{totals.frames} frames, {totals.bad} bad, {totals.lost} missing; {ended}",
    ]
    if totals.samples:
        rows = [
            (topic, count, number(recorded.rates[topic]) if topic in recorded.rates else "-")
            for topic, count in sorted(totals.samples.items())
        ]
        lines += [console.table(("stream", "records", "Hz"), rows)]
    lines += [_clock(recorded.clocks, device) for device in _devices_with_clock(recorded.clocks)]
    if recorded.artifacts:
        lines.append(f"artifacts: {', '.join(recorded.artifacts)}")
    return "\n".join(lines)


def _devices_with_clock(clocks: dict[str, str]) -> list[str]:
    """Return the devices with a clock model."""
    drift = "tick_drift_ppm:"
    return [key.removeprefix(drift) for key in clocks if key.startswith(drift)]


def _clock(clocks: dict[str, str], device: str) -> str:
    drift = float(clocks[f"tick_drift_ppm:{device}"])
    text = f"clock of {device}: {drift:+.1f} ppm relative to the host"
    delay = clocks.get(f"tick_jitter_s:{device}")
    return text if delay is None else f"{text}; 95 % within {1e3 * float(delay):.1f} ms"


def as_json(recorded: Any) -> dict[str, Any]:
    """Return the summary for ``--json``; see docs/commands.md."""
    return {
        "version": 1,
        "outputs": recorded.paths,
        "device": recorded.device or None,
        "system": recorded.system or None,
        "started_ns": recorded.started_ns,
        "ended_ns": recorded.ended_ns,
        "ended": recorded.ended,
        "file_bytes": recorded.file_bytes,
        **vars(recorded.totals),
        "rates_hz": recorded.rates,
        "clocks": {key: float(text) for key, text in recorded.clocks.items()},
        "artifacts": recorded.artifacts,
    }


def sensor_test(test: Any) -> str:
    """Return the result of a check of sensors: a table, the faults, and what was not tested."""
    check = test.check
    header, rows = _SENSOR_TABLES[test.system](check)
    rows = [(name, *row) for name, row in zip(test.names, rows, strict=True)]
    lines = [f"Test of {test.device}:"]
    if rows:
        lines.append(console.table(("sensor", *header), rows))
    for fault in check.faults:
        name = "all sensors" if fault.sensor is None else test.names[fault.sensor]
        lines.append(console.wrapped(f"FAULT  {name}: {fault.message}", indent=7))
    if rows and not check.faults:
        lines.append("No fault was found.")
    lines += [console.wrapped(f"not tested: {text}", indent=12) for text in check.untested]
    return "\n".join(lines)


def _array_table(check: Any) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    rows: list[tuple[str, ...]] = [
        (
            _figure(each.gain, 1, "{:.2f}"),
            _figure(each.offset_t, 1e6, "{:.0f}"),
            _figure(each.noise_t, 1e6, "{:.2f}"),
            " ".join(("-" if axis < 0 else "") + "?xyz"[abs(axis)] for axis in each.axes) or "-",
        )
        for each in check.sensors
    ]
    return ("gain", "offset uT", "noise uT", "axes"), rows


def _halls_table(check: Any) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    rows: list[tuple[str, ...]] = [
        (
            _figure(each.zero_t, 1e3, "{:.2f}"),
            _figure(each.noise_t, 1e3, "{:.3f}"),
            _figure(each.response_t, 1e3, "{:.1f}"),
            _figure(each.response_s, 1, "{:.1f}"),
        )
        for each in check.sensors
    ]
    return ("zero mT", "noise mT", "response mT", "at s"), rows


def _receiver_table(check: Any) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    rows: list[tuple[str, ...]] = [
        (str(each.sweeps), " ".join(map(str, each.channels)) or "-") for each in check.sensors
    ]
    return ("sweeps", "channels"), rows


_SENSOR_TABLES = {"polaris": _array_table, "landmarks": _halls_table, "lighthouse": _receiver_table}


def _figure(value: float, factor: float, form: str) -> str:
    return "-" if math.isnan(value) else form.format(factor * value)


def test_as_json(test: Any) -> dict[str, Any]:
    """Return the result of a check of sensors for ``--json``; unknown figures are null."""
    sensors = [
        {
            "name": name,
            **{
                key: None if isinstance(value, float) and math.isnan(value) else value
                for key, value in vars(figures).items()
            },
        }
        for name, figures in zip(test.names, test.check.sensors, strict=True)
    ]
    return {
        "device": test.device,
        "system": test.system,
        "sensors": sensors,
        "faults": [vars(fault) for fault in test.check.faults],
        "untested": test.check.untested,
    }


def ports(infos: Sequence[Any]) -> str:
    """Return a table of serial ports."""
    rows = [
        (
            port.device,
            "-" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            port.serial_number or "-",
            port.description or "-",
            port.holder or "-",
        )
        for port in infos
    ]
    return console.table(("port", "VID:PID", "serial number", "description", "held by"), rows)
