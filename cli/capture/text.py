"""What ``locatk capture`` says: the live line, its end, and the list of ports."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.formats.capture.statistics import CaptureStatus, RecordingResult


ENDS = {
    "duration": "ended after --duration",
    "max-size": "ended at --max-size",
    "stopped": "stopped",
}
"""Why a recording has ended, for people."""


class Live:
    """Talk while recording: on a terminal one line that changes each second, with what
    happened above it; elsewhere a line a second."""

    def __init__(self) -> None:
        self._shown = console.talks()
        self._terminal = sys.stderr.isatty()
        self._width = 0

    def ready(self, port: str) -> None:
        """The port is open."""
        console.say(f"Recording {port}; Ctrl-C ends it.")

    def waiting(self, why: str) -> None:
        """The port is not there yet, as the user expected, or cannot be opened."""
        missing = "no such port "
        told = f" for {why.removeprefix(missing)}" if why.startswith(missing) else f": {why}"
        console.say(f"Waiting{told}; Ctrl-C ends it.")

    def tell(self, text: str) -> None:
        """Something happened."""
        with self._unheard():
            self.wipe()
            console.warn(text)

    def show(self, status: CaptureStatus) -> None:
        """How it goes."""
        if not self._shown:
            return
        text = status_line(status)
        with self._unheard():
            if self._terminal:
                text = text[: shutil.get_terminal_size().columns - 1]
                click.echo("\r" + text.ljust(self._width), err=True, nl=False)
                self._width = len(text)
            else:
                click.echo(text, err=True)

    @contextlib.contextmanager
    def _unheard(self) -> Iterator[None]:
        """Whoever listened is gone: that must not end a recording."""
        try:
            yield
        except OSError:
            console.set_verbosity(-1)
            self._shown, self._width = False, 0

    def wipe(self) -> None:
        """Take the line away."""
        if self._width:
            click.echo("\r" + " " * self._width + "\r", err=True, nl=False)
            self._width = 0


@contextlib.contextmanager
def live() -> Iterator[Live]:
    """Talk while recording, and no half line left of it."""
    made = Live()
    try:
        yield made
    finally:
        made.wipe()


def status_line(status: CaptureStatus) -> str:
    """One line: what comes, what is lost, how full things are."""
    totals = status.totals
    away = status.away_s
    words = [
        clock(status.elapsed_s),
        f"{size(status.bytes_per_s)}/s" if away is None else f"away for {away:.0f} s",
        f"{status.frames_per_s:.0f} frames/s",
        f"{totals.bad} bad",
        f"{totals.lost} missing",
        f"{totals.overruns} overrun",
        *([f"{totals.gaps} gap{'' if totals.gaps == 1 else 's'}"] if totals.gaps else []),
        f"buffer {size(totals.high_water_bytes)}",
        f"file {size(status.file_bytes)}",
        *([f"disk {size(status.free_bytes)} left"] if status.free_bytes is not None else []),
    ]
    return "  ".join(words)


def clock(seconds: float) -> str:
    """Time since the start, ``m:ss`` or ``h:mm:ss``."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def size(count: float) -> str:
    """Bytes with three digits and a unit."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{number(count / factor)} {unit}"
    return f"{count:.0f} B"


def number(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def summary(recorded: RecordingResult) -> str:
    """What came of a recording, for people."""
    totals = recorded.totals
    seconds = (recorded.ended_ns - recorded.started_ns) * 1e-9
    files = ", ".join(map(str, recorded.paths[:3]))
    if len(recorded.paths) > 3:
        files += f" and {len(recorded.paths) - 3} more"
    lines = [
        f"{files}: {clock(seconds)}, {size(totals.bytes)} received"
        + (f" from {recorded.device}" if recorded.device else "")
        + f", {totals.frames} frames, {totals.bad} bad, {totals.lost} missing; "
        + ENDS.get(recorded.ended, recorded.ended),
    ]
    if totals.samples:
        rows = [
            (topic, count, number(recorded.rates[topic]) if topic in recorded.rates else "-")
            for topic, count in sorted(totals.samples.items())
        ]
        lines += [console.table(("stream", "records", "Hz"), rows)]
    lines += [_clock(recorded.clocks, device) for device in _ticking(recorded.clocks)]
    if recorded.artifacts:
        lines.append(f"artifacts: {', '.join(recorded.artifacts)}")
    return "\n".join(lines)


def _ticking(clocks: dict[str, str]) -> list[str]:
    """Devices whose clock is known."""
    drift = "tick_drift_ppm:"
    return [key.removeprefix(drift) for key in clocks if key.startswith(drift)]


def _clock(clocks: dict[str, str], device: str) -> str:
    drift = float(clocks[f"tick_drift_ppm:{device}"])
    words = f"clock of {device}: {drift:+.1f} ppm to the host's"
    late = clocks.get(f"tick_jitter_s:{device}")
    return words if late is None else f"{words}; 95 % arrive within {1e3 * float(late):.1f} ms"


def as_json(recorded: RecordingResult) -> dict[str, Any]:
    """The same for programs; docs/commands.md."""
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


def ports(found: Sequence[Any]) -> str:
    """The ports of this machine, one a line."""
    rows = [
        (
            port.device,
            "-" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            port.serial_number or "-",
            port.description or "-",
            port.holder or "-",
        )
        for port in found
    ]
    return console.table(("port", "VID:PID", "serial number", "description", "held by"), rows)
