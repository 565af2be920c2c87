"""``locatk capture``: from a port or camera to a session."""

from __future__ import annotations

import contextlib
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.capture import text as capture_text
from locatk.cli.capture.options import DURATION, ROTATION, SIZE, SIZE_OR_ZERO, columns_option
from locatk.cli.command import Command, section
from locatk.cli.signals import asked_to_stop

DEVICES_WITHOUT_COLUMNS = (
    "locatk",
    "polaris-array",
    "magx-array",
    "lighthouse-deck",
    "dotbot-gateway",
    "raw",
)
"""Devices to which ``--columns`` does not apply."""


def _pairs(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> dict[str, str]:
    pairs = {}
    for text in value:
        key, equals, content = text.partition("=")
        if not (key.strip() and equals):
            raise click.BadParameter(f"{text!r} is not of the form KEY=VALUE.")
        pairs[key.strip()] = content.strip()
    return pairs


@click.command(cls=Command, short_help="Record a serial device or a camera into a session.")
@click.argument("port", required=False)
@section(
    "Basic",
    click.option(
        "--list", "listing", is_flag=True, help="List the serial ports of this computer and exit."
    ),
    click.option(
        "--device",
        metavar="NAME",
        default="auto",
        show_default=True,
        help="Device at the port: locatk, polaris-array, magx-array, lighthouse-deck, "
        "dotbot-gateway, lines, raw; auto identifies it from the first seconds.",
    ),
    options.output("Session to write (.mcap).", required=False, endings=(".mcap",)),
    options.overwrite,
    click.option("--baud", type=click.IntRange(min=1), help="[default: that of the device]"),
    columns_option,
    click.option(
        "--name",
        metavar="NAME",
        help="Name of the device in the session.  [default: robot; camera for cameras]",
    ),
    click.option(
        "--test",
        "is_test",
        is_flag=True,
        help="Check the sensors instead: dead ones, exchanged or inverted axes, wrong gains, "
        "order. It takes 30 s, or --duration; -o keeps the recording.",
    ),
)
@section(
    "Content of the session",
    options.input_option(
        "--artifact",
        many=True,
        help="Artifact to attach: tag, array, map, hall sensors, scene, manifest, camera "
        "(.toml), or a session that contains artifacts (.mcap). Repeatable.",
    ),
    click.option("--note", help="Description of the recording."),
    click.option(
        "--meta",
        multiple=True,
        metavar="KEY=VALUE",
        callback=_pairs,
        help="Entry of the metadata, as in robot=7. Repeatable.",
    ),
)
@section(
    "Start, end and size",
    click.option(
        "--wait",
        "wait_s",
        type=DURATION,
        default=0.0,
        metavar="TIME",
        help="Maximum time to wait for the port to become available.  [default: 0s]",
    ),
    click.option(
        "--duration", type=DURATION, metavar="TIME", help="Stop after this time: 90s, 5min, 2h."
    ),
    click.option(
        "--max-size",
        type=SIZE,
        metavar="SIZE",
        help="Stop at this total size (up to 0.5 MB more): 500MB, 2GB.",
    ),
    click.option(
        "--rotate",
        type=ROTATION,
        metavar="TIME|SIZE",
        help="Start a new file after this time or size: OUTPUT-001.mcap, OUTPUT-002.mcap, "
        "each a complete session.",
    ),
    options.number(
        "--silence",
        default="5s",
        type=DURATION,
        metavar="TIME",
        help="Warn after this time without data.",
    ),
    options.number(
        "--reserve",
        default="64MiB",
        type=SIZE_OR_ZERO,
        metavar="SIZE",
        help="Stop when less than this much disk space is free; 0 uses all of it.",
    ),
)
@section(
    "Replay and camera",
    click.option(
        "--speed",
        type=click.FloatRange(min=0),
        metavar="N",
        help="Speed factor of replay: and camera:FILE; 0 for as fast as possible.  [default: 1]",
    ),
    click.option(
        "--image",
        type=click.Choice(("jpeg", "png")),
        help="Format of camera frames; png is lossless.  [default: jpeg]",
    ),
)
@options.as_json
@options.verbosity
def command(
    port: str | None,
    listing: bool,
    is_test: bool,
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
    """Record PORT into OUTPUT until Ctrl-C.

    \b
    PORT is one of
      /dev/ttyACM0, COM3      a serial port (--list shows them)
      socket://HOST:PORT      raw bytes over TCP
      rfc2217://HOST:PORT     a serial port of another computer
      ble:NAME, ble:ADDRESS   a Bluetooth device with Nordic's UART service
      replay:FILE.mcap        the raw bytes of a session, with their timing
      camera:0, camera:URL, camera:FILE
                              a camera by number, a stream, a video file

    Every byte is stored as received, together with the decoded records; `locatk solve` reads the
    session directly. If a port is unplugged, it is opened again when it is back. If the program is
    killed, at most half a second is lost: `locatk recover` completes the file.

    The exit status is 3 if data were lost; the file is complete nevertheless. With --test it is 3
    if a sensor has a fault, too.

    \b
    Examples:
      locatk capture --list
      locatk capture /dev/ttyACM0 --device locatk -o run.mcap
      locatk capture /dev/ttyACM0 --device polaris-array --test
      locatk capture COM3 --device polaris-array --artifact tag.toml -o run.mcap
      locatk capture /dev/ttyACM0 -o run.mcap --duration 5min --note "floor 2"
      locatk capture /dev/ttyACM0 -o day.mcap --rotate 10min --meta robot=7
      locatk capture ble:robot7 -o run.mcap --duration 5min
      locatk capture camera:0 --artifact sheet.toml -o run.mcap
      locatk capture replay:run.mcap --device lines -o again.mcap
    """
    if listing:
        _list(as_json)
        return
    if port is None or (output is None and not is_test):
        raise click.UsageError("Missing PORT." if port is None else "Missing option '-o'.")
    from locatk.formats.capture import sensor_test, setup
    from locatk.formats.capture.recorder import Limits
    from locatk.formats.devices import find_device

    if device != "auto":
        find_device(device)
    _refuse_unused_options(port, device, rest)
    if is_test:
        if rotate is not None or port.startswith("camera:"):
            what = "cameras" if rotate is None else "--rotate"
            raise click.UsageError(f"--test does not apply to {what}.")
        duration = sensor_test.DURATION_S if duration is None else duration
    kind, amount = rotate or ("", 0.0)
    limits = Limits(
        duration_s=duration,
        max_bytes=None if max_size is None else int(max_size),
        rotate_s=amount if kind == "time" else None,
        rotate_bytes=int(amount) if kind == "size" else None,
        silence_s=silence,
        reserve_bytes=int(reserve),
    )
    stop = threading.Event()
    with contextlib.ExitStack() as stack:
        is_temporary = output is None
        if output is None:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-"))
            output = Path(folder, "test.mcap")
        request = setup.CaptureRequest(
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
        live = stack.enter_context(capture_text.live())
        stack.enter_context(asked_to_stop(stop.set))

        def ready(name: str) -> None:
            live.ready(name)
            for text in sensor_test.instructions(device) if is_test else ():
                console.say(text)

        recorded = setup.record(
            request, stop, tell=live.tell, show=live.show, ready=ready, waiting=live.waiting
        )
        tests = sensor_test.check_recording(recorded.paths[0]) if is_test else None
        if is_temporary:
            recorded.paths.clear()
    _report(recorded, port, device, tests, as_json)


def _refuse_unused_options(port: str, device: str, given: dict[str, Any]) -> None:
    """Refuse options that do not apply to the port or device."""
    camera, replay = port.startswith("camera:"), port.startswith("replay:")
    network = port.lower().startswith(("socket:", "loop:", "ble:"))
    for name, is_unused, what in (
        ("columns", camera, f"the port {port}"),
        ("columns", device in DEVICES_WITHOUT_COLUMNS, f"the device {device}"),
        ("baud", camera or replay or network, f"the port {port}"),
        ("speed", not (camera or replay), f"the port {port}"),
        ("image", not camera, f"the port {port}"),
    ):
        if given[name] not in (None, ()) and is_unused:
            raise click.UsageError(f"--{name} does not apply to {what}.")


def _list(as_json: bool) -> None:
    from locatk.formats.capture.port_listing import find_ports_with_users

    ports = find_ports_with_users()
    if as_json:
        console.emit_json({"version": 1, "ports": [vars(port) for port in ports]})
    elif ports:
        console.result(capture_text.ports(ports))
    else:
        console.say("No serial port found. `locatk emulate polaris` creates one for tests.")


def _report(
    recorded: Any, port: str, device: str, tests: Sequence[Any] | None, as_json: bool
) -> None:
    """Print the result of a recording; ``tests`` are those of its sensors, with --test."""
    if tests is None:
        console.result(capture_text.summary(recorded))
    for test in tests or ():
        console.result(capture_text.sensor_test(test))
    if as_json:
        fields = {} if tests is None else {"tests": [*map(capture_text.test_as_json, tests)]}
        console.emit_json({**capture_text.as_json(recorded), **fields})
    known_device = "" if device == "auto" and recorded.device == "raw" else recorded.device
    doubts = recorded.totals.doubts(known_device)
    if doubts and recorded.totals.bytes:
        remedy = "check --device (or use auto)"
        doubts.append(remedy if port.lower().startswith("ble:") else f"{remedy} and --baud")
    losses = recorded.totals.losses() + doubts
    if recorded.failed:
        losses.insert(0, recorded.ended)
    faults = sum(len(test.check.faults) for test in tests or ())
    if faults:
        losses.append(f"{faults} fault{'s' * (faults > 1)} of the sensors")
    if losses:
        raise failures.Incomplete("; ".join(losses))
