"""``locatk capture``: from a port into a session."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.capture import text as capture_text
from locatk.cli.capture.options import DURATION, PACE, SIZE, names_option
from locatk.cli.signals import asked_to_stop

if TYPE_CHECKING:
    from locatk.formats.capture.statistics import RecordingResult


def _pairs(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> dict[str, str]:
    pairs = {}
    for text in value:
        key, equals, content = text.partition("=")
        if not (key.strip() and equals):
            raise click.BadParameter(f"{text!r} is not of the form KEY=VALUE.")
        pairs[key.strip()] = content.strip()
    return pairs


@click.command(short_help="Record a device from a port, or a camera, into a session.")
@click.argument("port", required=False)
@click.option(
    "--list", "listing", is_flag=True, help="Show the serial ports of this machine and exit."
)
@click.option(
    "--device",
    metavar="NAME",
    default="auto",
    show_default=True,
    help="What is at the port: locatk, polaris-array, magx-array, lighthouse-deck, "
    "dotbot-gateway, lines, raw; auto finds out from the first seconds.",
)
@options.output("Session to write (.mcap).", required=False)
@options.input_option(
    "--artifact",
    many=True,
    metavar="FILE",
    help="What the recording is of, to go into the session: tag, array, map, hall sensors, "
    "scene, manifest, camera (.toml), or a session that holds them (.mcap). Repeatable.",
)
@click.option("--note", help="What to know of this recording, for people.")
@click.option(
    "--meta", multiple=True, metavar="KEY=VALUE", callback=_pairs, help="A fact. Repeatable."
)
@click.option(
    "--name",
    metavar="NAME",
    help="Of the device in the session.  [default: robot; of a camera: camera]",
)
@click.option("--baud", type=click.IntRange(min=1), help="[default: the device's own]")
@names_option
@click.option(
    "--wait",
    "wait_s",
    type=DURATION,
    default=0.0,
    metavar="TIME",
    help="Wait so long for the port to be there.",
)
@click.option("--duration", type=DURATION, metavar="TIME", help="End after so long: 90s, 5min, 2h.")
@click.option(
    "--max-size",
    type=SIZE,
    metavar="SIZE",
    help="End when the files have so many bytes (half a MB more at most): 500MB, 2GB.",
)
@click.option(
    "--rotate",
    type=PACE,
    metavar="TIME|SIZE",
    help="Begin a new file so often: OUTPUT-001.mcap, OUTPUT-002.mcap, each whole in itself.",
)
@options.number(
    "--silence",
    default="5s",
    type=DURATION,
    metavar="TIME",
    help="Warn after so long without data.",
)
@options.number(
    "--reserve",
    default="64MiB",
    type=SIZE,
    metavar="SIZE",
    help="End before the disk has less room than this.",
)
@click.option(
    "--speed",
    type=click.FloatRange(min=0),
    help="replay:, camera:FILE: so many times as fast as recorded; 0 as fast as possible.",
)
@click.option(
    "--image",
    type=click.Choice(("jpeg", "png")),
    help="camera: how frames are packed; png loses nothing.  [default: jpeg]",
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    port: str | None,
    listing: bool,
    device: str,
    output: Path | None,
    artifact: tuple[Path, ...],
    note: str | None,
    meta: dict[str, str],
    rotate: tuple[str, float] | None,
    duration: float | None,
    max_size: float | None,
    silence: float,
    reserve: float,
    overwrite: bool,
    as_json: bool,
    **rest: Any,
) -> None:
    """Record what comes from PORT into OUTPUT, until Ctrl-C.

    \b
    PORT is one of
      /dev/ttyACM0, COM3      a serial port (--list shows them)
      socket://HOST:PORT, rfc2217://HOST:PORT
                              a serial port in the network
      replay:FILE.mcap        the raw bytes of a session, as they came
      camera:0, camera:URL, camera:FILE
                              a camera, by number or stream, or a video

    Every byte goes into the session as it came, and beside it what is decoded; `locatk
    solve` takes it as it is. A port that is unplugged is opened again when it is back.
    What is killed loses half a second at most: `locatk recover` makes the file whole.

    The exit status is 3 where something was lost on the way; the file is whole all the
    same.

    \b
    Examples:
      locatk capture --list
      locatk capture /dev/ttyACM0 --device locatk -o run.mcap
      locatk capture /dev/ttyUSB0 --device polaris-array --artifact tag.toml -o run.mcap
      locatk capture /dev/ttyACM0 -o run.mcap --duration 5min --note "second floor"
      locatk capture /dev/ttyACM0 -o day.mcap --rotate 10min --meta robot=7
      locatk capture camera:0 --artifact sheet.toml -o run.mcap
      locatk capture replay:run.mcap --device lines -o again.mcap
    """
    if listing:
        _list(as_json)
        return
    if port is None or output is None:
        raise click.UsageError("Missing PORT." if port is None else "Missing option '-o'.")
    from locatk.formats.capture import setup as session
    from locatk.formats.capture.recorder import Limits

    _refuse_idle(port, device, rest)
    kind, amount = rotate or ("", 0.0)
    limits = Limits(
        duration_s=duration,
        max_bytes=None if max_size is None else int(max_size),
        rotate_s=amount if kind == "time" else None,
        rotate_bytes=int(amount) if kind == "size" else None,
        silence_s=silence,
        reserve_bytes=int(reserve),
    )
    wanted = session.CaptureRequest(
        port=port,
        device=device,
        output=output,
        artifacts=artifact,
        note=note,
        meta=meta,
        limits=limits,
        overwrite=overwrite,
        **{name: value for name, value in rest.items() if value is not None},
    )
    stop = threading.Event()
    with capture_text.live() as live, asked_to_stop(stop.set):
        recorded = session.record(
            wanted,
            stop,
            tell=live.tell,
            show=live.show,
            ready=live.ready,
            waiting=live.waiting,
        )
    _report(recorded, device, as_json)


def _refuse_idle(port: str, device: str, given: dict[str, Any]) -> None:
    """Refuse options that would do nothing."""
    camera, played = port.startswith("camera:"), port.startswith("replay:")
    network = port.startswith(("socket:", "loop:"))
    for name, idle, what in (
        ("columns", camera, f"the port {port}"),
        ("columns", device in DEVICES_WITHOUT_COLUMNS, f"the device {device}"),
        ("baud", camera or played or network, f"the port {port}"),
        ("speed", not (camera or played), f"the port {port}"),
        ("image", not camera, f"the port {port}"),
    ):
        if given[name] not in (None, ()) and idle:
            raise click.UsageError(f"--{name} means nothing to {what}.")


DEVICES_WITHOUT_COLUMNS = (
    "locatk",
    "polaris-array",
    "magx-array",
    "lighthouse-deck",
    "dotbot-gateway",
    "raw",
)


def _list(as_json: bool) -> None:
    from locatk.formats.capture import port_listing as listing

    found = listing.find_ports_with_users()
    if as_json:
        console.emit_json({"version": 1, "ports": [vars(port) for port in found]})
    elif found:
        console.result(capture_text.ports(found))
    else:
        console.say("No serial port found. `locatk emulate polaris` makes one to try.")


def _report(recorded: RecordingResult, device: str, as_json: bool) -> None:
    console.result(capture_text.summary(recorded))
    if as_json:
        console.emit_json(capture_text.as_json(recorded))
    found = "" if device == "auto" and recorded.device == "raw" else recorded.device
    doubts = recorded.totals.doubts(found)
    if doubts and recorded.totals.bytes:
        doubts.append("is it this device (--device auto), is its baud right?")
    losses = recorded.totals.losses() + doubts
    if recorded.failed:
        losses.insert(0, recorded.ended)
    if losses:
        raise failures.Incomplete("; ".join(losses))
