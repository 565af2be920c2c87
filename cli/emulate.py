"""``locatk emulate``: a device that is not there, on a pseudo-terminal."""

from __future__ import annotations

import shlex
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.signals import asked_to_stop
from locatk.core.errors import InputError, LocatkError, MissingDataError

if TYPE_CHECKING:
    from locatk.formats.emulation.emulator import EmulationCounts
    from locatk.formats.emulation.sources import ByteSource
    from locatk.formats.sessions.reader import Session

SYSTEMS = ("polaris", "landmarks", "lighthouse", "dots")

SHARE = click.FloatRange(0, 1)
ABOVE_0 = click.FloatRange(0, min_open=True)


@click.command(short_help="Be a device on a pseudo-terminal, without hardware.")
@click.argument("source", metavar="SESSION|SYSTEM")
@click.option(
    "--device",
    metavar="NAME",
    help="Which device it is, as of `locatk capture`.  [default: the one that recorded the "
    "session, or polaris-array, locatk, dotbot-gateway by what it holds]",
)
@click.option(
    "--link",
    type=options.PATH,
    metavar="PATH",
    help="Where the port shall be.  [default: a new path]",
)
@click.option(
    "--save",
    type=options.PATH,
    metavar="FILE",
    help="Of a SYSTEM: write the simulated session here (.mcap), with artifacts and truth.",
)
@options.overwrite
@options.number(
    "--speed",
    default=1.0,
    type=click.FloatRange(0),
    metavar="N",
    help="So many times as fast as recorded; 0 for as fast as the reader takes it, which "
    "waits for it and loses nothing.",
)
@click.option(
    "--rate",
    type=ABOVE_0,
    metavar="BYTES/S",
    help="A constant rate instead of the recorded pace.",
)
@options.number(
    "--loop",
    default=1,
    type=click.IntRange(0),
    metavar="N",
    help="Send it so many times; 0 for ever. Times run on, counters and ticks in the bytes "
    "start again.",
)
@click.option("--no-wait", is_flag=True, help="Start before the port is opened.")
@options.number(
    "--drop", default=0.0, type=SHARE, metavar="P", help="Probability of a byte to be lost."
)
@options.number(
    "--flip", default=0.0, type=SHARE, metavar="P", help="Probability of a bit to turn over."
)
@click.option(
    "--unplug-every",
    "unplug_every_s",
    type=ABOVE_0,
    metavar="SECONDS",
    help="Unplug it after so long, again and again.",
)
@click.option(
    "--away",
    "away_s",
    type=ABOVE_0,
    metavar="SECONDS",
    help="For how long it is gone then.  [default: 1]",
)
@options.number("--seed", default=0, type=click.IntRange(0), help="Of faults and simulation.")
@options.json_flag("Two lines of JSON")
@options.verbosity
def command(
    source: str,
    device: str | None,
    link: Path | None,
    save: Path | None,
    overwrite: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Send on a new port what a device would send of SESSION, or of a simulated session of
    SYSTEM: polaris, landmarks or lighthouse.

    Prints the path of the port, and starts when something opens it. Like a real device it
    does not wait: what is due while nobody listens is lost, and so is what a reader does not
    take for a second. What was sent and lost is said at the end.

    \b
    --json prints two lines:
      {"version": 1, "port", "device", "source", "recorded"}
      {"version": 1, "port", "device", "made", "sent", "dropped", "unheard", "overrun",
       "flipped", "unplugs"}

    recorded: whether the bytes are those of the session. made: bytes that the device had to
    send, the sum of sent, dropped (by --drop), unheard (nobody listened) and overrun (not
    read in time). flipped counts bits.

    \b
    Examples:
      locatk emulate polaris --save truth.mcap
      locatk emulate run.mcap --device locatk --link /tmp/robot
      locatk emulate run.mcap --drop 0.001 --flip 1e-5 --unplug-every 10 --seed 7
      locatk emulate run.mcap --rate 3e6 --loop 0 --json
    """
    from locatk.formats.emulation.emulator import Emulator
    from locatk.formats.emulation.pseudo_terminal import PseudoPort

    _refuse_contradictions(source, save, given)
    with ExitStack() as stack:
        found, session = _source(source, device, save, overwrite, given["seed"], stack)
        parts = _parts(found, given)
        if parts[0].next_s is None:
            raise InputError("nothing to send", file=source)
        port = PseudoPort(link)
        stack.callback(port.close)
        known = {"version": 1, "port": port.path, "device": found.device}
        if as_json:
            console.emit_json({**known, "source": source, "recorded": found.recorded})
        console.result(port.path)
        console.say(f"{_what(source, found)}{_how_long(session, given)}; Ctrl-C ends it")
        if not given["no_wait"]:
            kept = None if source in SYSTEMS and save is None else session
            console.say(f"Waiting for a reader, as: {_reader(port.path, found, kept)}")
        emulator = Emulator(port, *parts)
        try:
            with asked_to_stop(emulator.stop):
                emulator.run()
        finally:
            if as_json:
                console.emit_json({**known, **emulator.totals.as_dict()})
            console.say(_summary(emulator.totals))


def _refuse_contradictions(source: str, save: Path | None, given: dict[str, Any]) -> None:
    if save is not None and source not in SYSTEMS:
        raise click.UsageError(f"--save is of a SYSTEM: {', '.join(SYSTEMS[:-1])}.")
    if given["rate"] is not None and given["speed"] != 1:
        raise click.UsageError("Give --speed or --rate, not both.")
    if given["no_wait"] and given["speed"] == 0:
        raise click.UsageError("--speed 0 waits for the reader, --no-wait does not.")
    if given["away_s"] is not None and given["unplug_every_s"] is None:
        raise click.UsageError("--away is of --unplug-every.")


def _source(
    source: str,
    device: str | None,
    save: Path | None,
    overwrite: bool,
    seed: int,
    stack: ExitStack,
) -> tuple[ByteSource, Session]:
    """What is to be sent, and of which session; one that is not saved lives as long as
    ``stack``."""
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


def _parts(found: ByteSource, given: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Pace, faults and plan, of what was said on the command line."""
    from math import inf

    from locatk.formats.emulation.byte_stream import (
        ConstantRate,
        LineFaults,
        Pace,
        RecordedPace,
        repeat_packets,
    )
    from locatk.formats.emulation.emulator import EmulationPlan

    packets = repeat_packets(found.packets, given["loop"])
    pace: Pace
    if given["rate"] is not None:
        pace = ConstantRate(packets, given["rate"])
    else:
        pace = RecordedPace(packets, given["speed"] or inf)
    plan = EmulationPlan(
        wait=not given["no_wait"],
        lossless=given["speed"] == 0,
        unplug_every_s=given["unplug_every_s"],
        away_s=1.0 if given["away_s"] is None else given["away_s"],
    )
    return pace, LineFaults(given["drop"], given["flip"], given["seed"]), plan


def _what(source: str, found: ByteSource) -> str:
    how = "bytes as recorded" if found.recorded else "bytes made"
    return f"{found.device}, {how} of {source}"


def _how_long(session: Session, given: dict[str, Any]) -> str:
    """For how long it sends, where that is known before."""
    if given["loop"] == 0:
        return ", for ever"
    if given["rate"] is not None or given["speed"] == 0:
        return ""
    if session.start_ns is None or session.end_ns is None:
        return ""
    seconds = given["loop"] * (session.end_ns - session.start_ns) * 1e-9 / given["speed"]
    return f", {seconds:.1f} s, then it is unplugged"


def _reader(port: str, found: ByteSource, session: Session | None) -> str:
    """What to type in another terminal; with what the session knows beside the bytes."""
    from locatk.formats.capture import attachments as artifacts

    words = ["locatk", "capture", port, "--device", found.device]
    if session is not None:
        with suppress(LocatkError):  # it holds none
            if artifacts.attachments([Path(session.path)]):
                words += ["--artifact", session.path]
    return shlex.join([*words, "-o", "capture.mcap"])


def _summary(totals: EmulationCounts) -> str:
    parts = [f"sent {totals.sent} of {totals.made} bytes"]
    for count, text in (
        (totals.dropped, "dropped"),
        (totals.unheard, "lost while nobody listened"),
        (totals.overrun, "lost as they were not read in time"),
        (totals.flipped, "bits flipped"),
    ):
        if count:
            parts.append(f"{count} {text}")
    if totals.unplugs:
        parts.append(f"unplugged {totals.unplugs} time{'s' * (totals.unplugs > 1)}")
    return ", ".join(parts).capitalize()
