"""``locatk emulate``: emulate a serial device on a pseudo-terminal."""

from __future__ import annotations

import shlex
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.signals import asked_to_stop
from locatk.core.errors import InputError, LocatkError, MissingDataError

SYSTEMS = ("polaris", "landmarks", "lighthouse", "dots")

FRACTION = click.FloatRange(0, 1)


@click.command(cls=Command, short_help="Emulate a serial device on a pseudo-terminal.")
@click.argument("source", metavar="SESSION|SYSTEM")
@section(
    "Basic",
    click.option(
        "--device",
        metavar="NAME",
        help="Device to emulate, as in `locatk capture`.  [default: the one that recorded the "
        "session, otherwise by its content: polaris-array, locatk or dotbot-gateway]",
    ),
    click.option(
        "--link", type=options.PATH, metavar="PATH", help="Path of the port.  [default: a new path]"
    ),
    options.output_option(
        "--save",
        endings=(".mcap",),
        metavar="FILE",
        help="Also write the simulated session of SYSTEM (.mcap), with artifacts and truth.",
    ),
    options.overwrite,
    options.number(
        "--seed", default=0, type=click.IntRange(0), metavar="N", help="Seed of all random numbers."
    ),
)
@section(
    "Pace",
    options.number(
        "--speed",
        default=1.0,
        type=click.FloatRange(0),
        metavar="N",
        help="Speed factor of the recorded timing; 0 waits for the reader and loses nothing.",
    ),
    click.option(
        "--rate",
        type=options.POSITIVE,
        metavar="BYTES/S",
        help="Constant rate instead of the recorded timing.",
    ),
    options.number(
        "--loop",
        default=1,
        type=click.IntRange(0),
        metavar="N",
        help="Number of repetitions; 0 repeats endlessly. Times continue; counters and ticks "
        "in the bytes restart.",
    ),
    click.option("--no-wait", is_flag=True, help="Start before the port is opened."),
)
@section(
    "Faults",
    options.number(
        "--drop", default=0.0, type=FRACTION, metavar="P", help="Probability that a byte is lost."
    ),
    options.number(
        "--flip", default=0.0, type=FRACTION, metavar="P", help="Probability that a bit flips."
    ),
    click.option(
        "--unplug-every",
        "unplug_every_s",
        type=options.POSITIVE,
        metavar="SECONDS",
        help="Unplug the device at this interval.",
    ),
    click.option(
        "--away",
        "away_s",
        type=options.POSITIVE,
        metavar="SECONDS",
        help="Duration for which the device is unplugged.  [default: 1]",
    ),
)
@options.json_flag("two lines of JSON")
@options.verbosity
def command(
    source: str,
    device: str | None,
    link: Path | None,
    save: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Emulate a serial device: send its bytes on a new pseudo-terminal.

    The bytes are those of SESSION, or of a simulated session of SYSTEM: polaris,
    landmarks or lighthouse. The path of the port is printed; sending starts when a
    program opens it. A real device does not wait: bytes that are due while the port is
    closed are lost, and so are bytes that a reader does not take for a second. A summary
    of bytes sent and lost follows at the end.

    \b
    --json prints two lines:
      {"version": 1, "port", "device", "source", "recorded"}
      {"version": 1, "port", "device", "made", "sent", "dropped", "unheard",
       "overrun", "flipped", "unplugs"}

    recorded: the bytes are those of the session. made: bytes that the device had to send,
    the sum of sent, dropped (by --drop), unheard (port closed) and overrun (not read in
    time). flipped counts bits.

    \b
    Examples:
      locatk emulate polaris --save truth.mcap
      locatk emulate run.mcap --device locatk --link /tmp/robot
      locatk emulate run.mcap --drop 0.001 --flip 1e-5 --unplug-every 10 --seed 7
      locatk emulate run.mcap --rate 3e6 --loop 0 --json
    """
    from locatk.formats.emulation.emulator import Emulator
    from locatk.formats.emulation.pseudo_terminal import PseudoPort

    _refuse_contradictions(source, save, settings)
    with ExitStack() as stack:
        byte_source, session = _source(source, device, save, overwrite, settings["seed"], stack)
        pace, faults, plan = _parts(byte_source, settings)
        if pace.next_s is None:
            raise InputError("no bytes to send", file=source)
        port = PseudoPort(link)
        stack.callback(port.close)
        facts = {"version": 1, "port": port.path, "device": byte_source.device}
        if as_json:
            origin = {"source": source, "recorded": byte_source.recorded}
            console.emit_json({**facts, **origin})
        console.result(port.path)
        content = _describe(source, byte_source) + _describe_duration(session, settings)
        console.say(f"{content}; press Ctrl-C to stop")
        if not settings["no_wait"]:
            saved = None if source in SYSTEMS and save is None else session
            example = _capture_command(port.path, byte_source, saved)
            console.say(f"Waiting for a reader, for example: {example}")
        emulator = Emulator(port, pace, faults, plan)
        try:
            with asked_to_stop(emulator.stop):
                emulator.run()
        finally:
            if as_json:
                console.emit_json({**facts, **emulator.totals.as_dict()})
            console.say(_summary(emulator.totals))


def _refuse_contradictions(source: str, save: Path | None, settings: dict[str, Any]) -> None:
    if save is not None and source not in SYSTEMS:
        raise click.UsageError(f"--save applies to a SYSTEM: {', '.join(SYSTEMS[:-1])}.")
    if settings["rate"] is not None and settings["speed"] != 1:
        raise click.UsageError("Give --speed or --rate, not both.")
    if settings["no_wait"] and settings["speed"] == 0:
        raise click.UsageError("--speed 0 waits for the reader, --no-wait does not.")
    if settings["away_s"] is not None and settings["unplug_every_s"] is None:
        raise click.UsageError("--away needs --unplug-every.")


def _source(
    source: str,
    device: str | None,
    save: Path | None,
    overwrite: bool,
    seed: int,
    stack: ExitStack,
) -> tuple[Any, Any]:
    """Return the bytes to send, and their session.

    A simulated session that is not saved is removed with ``stack``.
    """
    import tempfile

    from locatk.formats.emulation.sources import select_source, write_simulated_session
    from locatk.formats.sessions.reader import Session

    path = Path(source)
    if source in SYSTEMS:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-"))
        path = save or Path(folder, f"{source}.mcap")
        options.guard_output(path, overwrite=overwrite)
        with console.working("Simulating"):
            write_simulated_session(source, path, seed=seed, overwrite=overwrite)
    elif not path.exists():
        raise MissingDataError(
            "no such session",
            file=path,
            hint=f"Give a file, or a system: {', '.join(SYSTEMS[:-1])}",
        )
    session = Session.open(path)
    return select_source(session, device), session


def _parts(byte_source: Any, settings: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Return pace, faults and plan, from the options."""
    from math import inf

    from locatk.formats.emulation.byte_stream import (
        ConstantRate,
        LineFaults,
        Pace,
        RecordedPace,
        repeat_packets,
    )
    from locatk.formats.emulation.emulator import EmulationPlan

    packets = repeat_packets(byte_source.packets, settings["loop"])
    pace: Pace
    if settings["rate"] is not None:
        pace = ConstantRate(packets, settings["rate"])
    else:
        pace = RecordedPace(packets, settings["speed"] or inf)
    plan = EmulationPlan(
        wait=not settings["no_wait"],
        lossless=settings["speed"] == 0,
        unplug_every_s=settings["unplug_every_s"],
        away_s=1.0 if settings["away_s"] is None else settings["away_s"],
    )
    return pace, LineFaults(settings["drop"], settings["flip"], settings["seed"]), plan


def _describe(source: str, byte_source: Any) -> str:
    origin = "recorded bytes" if byte_source.recorded else "encoded data"
    return f"{byte_source.device}, {origin} of {source}"


def _describe_duration(session: Any, settings: dict[str, Any]) -> str:
    """Return the duration of the bytes, if it is known."""
    if settings["loop"] == 0:
        return ", endlessly"
    if settings["rate"] is not None or settings["speed"] == 0:
        return ""
    if session.start_ns is None or session.end_ns is None:
        return ""
    seconds = settings["loop"] * (session.end_ns - session.start_ns) * 1e-9 / settings["speed"]
    return f", {seconds:.1f} s, then it is unplugged"


def _capture_command(port: str, byte_source: Any, session: Any) -> str:
    """Return the command that records the port, with the artifacts of the session."""
    from locatk.formats.capture.attachments import attachments

    words = ["locatk", "capture", port, "--device", byte_source.device]
    if session is not None:
        with suppress(LocatkError):  # A session without artifacts.
            if attachments([Path(session.path)]):
                words += ["--artifact", session.path]
    return shlex.join([*words, "-o", "capture.mcap"])


def _summary(totals: Any) -> str:
    parts = [f"sent {totals.sent} of {totals.made} bytes"]
    for count, text in (
        (totals.dropped, "dropped"),
        (totals.unheard, "lost while the port was closed"),
        (totals.overrun, "lost because they were not read in time"),
        (totals.flipped, "bits flipped"),
    ):
        if count:
            parts.append(f"{count} {text}")
    if totals.unplugs:
        parts.append(f"unplugged {totals.unplugs} time{'s' * (totals.unplugs > 1)}")
    return ", ".join(parts).capitalize()
