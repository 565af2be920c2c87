"""``locatk live``: from ports and cameras to poses, while they are recorded."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.capture.options import DURATION, columns_option
from locatk.cli.command import Command, section
from locatk.cli.live.text import LiveText
from locatk.cli.signals import asked_to_stop


@click.command(cls=Command, short_help="Localize devices while they move, and publish the poses.")
@click.argument("port", required=False)
@section(
    "Basic",
    click.option(
        "--device",
        metavar="NAME",
        help="Device at the port, as of `locatk capture`.  [default: auto]",
    ),
    options.input_option(
        "--artifact",
        many=True,
        help="Scene, tags, manifest or map, and those of the sensors (.toml), or a session that "
        "contains them (.mcap). Repeatable.",
    ),
    click.option(
        "--to",
        "sinks",
        multiple=True,
        metavar="SINK",
        help="Address to which the poses are sent (below). Repeatable.",
    ),
    options.output_option(
        "--record", help="Session to record meanwhile (.mcap).", endings=(".mcap",)
    ),
    options.overwrite,
    options.input_option("--config", help="Permanent set-up (live.toml); options are added to it."),
    click.option("--list-sinks", "listing", is_flag=True, help="List the kinds of sinks and exit."),
)
@section(
    "Inputs",
    click.option(
        "--input",
        "inputs",
        multiple=True,
        metavar="'PORT KEY=VALUE ...'",
        help="A further input, with device, name, baud, columns, speed or image as in "
        "'/dev/ttyUSB0 device=lines name=red'. Repeatable.",
    ),
    click.option("--name", metavar="NAME", help="Name of the device.  [default: robot, camera]"),
    click.option("--baud", type=click.IntRange(min=1), help="[default: that of the device]"),
    columns_option,
    click.option(
        "--speed",
        type=click.FloatRange(min=0),
        metavar="N",
        help="Speed factor of replay: and camera:FILE; 0 for as fast as possible.  [default: 1]",
    ),
    click.option(
        "--wait",
        "wait_s",
        type=DURATION,
        metavar="TIME",
        help="Maximum time to wait for a port to become available.  [default: 0s]",
    ),
    click.option("--duration", type=DURATION, metavar="TIME", help="Stop after this time."),
)
@section(
    "Advanced",
    click.option(
        "--rotate",
        type=DURATION,
        metavar="TIME",
        help="Continue the recording in a new file after this time.",
    ),
    options.input_option(
        "--token-file",
        help="File with the secret that clients of servers on other than the loopback address "
        "must present.  [default: a new one at each start]",
    ),
    click.option(
        "--scene",
        metavar="KIND",
        help="Lighthouse: assumed geometry while the scene is estimated, as of `locatk solve`.",
    ),
    click.option(
        "--odometry-noise",
        type=options.POSITIVE,
        metavar="DEG",
        help="Landmarks: random walk of the heading by odometry [deg/sqrt(m)].",
    ),
    click.option(
        "--odometry-lag",
        type=float,
        metavar="MS",
        help="Landmarks: time by which odometry is later than the hall sensors [ms].",
    ),
)
@options.json_flag("one JSON object per line")
@options.verbosity
def command(
    port: str | None,
    listing: bool,
    inputs: tuple[str, ...],
    artifact: tuple[Path, ...],
    sinks: tuple[str, ...],
    record: Path | None,
    overwrite: bool,
    config: Path | None,
    duration: float | None,
    rotate: float | None,
    token_file: Path | None,
    as_json: bool,
    scene: str | None,
    odometry_noise: float | None,
    odometry_lag: float | None,
    **given: Any,
) -> None:
    """Localize the devices at PORT until Ctrl-C, with the poses of `locatk solve` at once.

    PORT is one of those of `locatk capture`: a serial port, socket://HOST:PORT, ble:NAME,
    camera:0, or replay:FILE.mcap, whose observations keep their times. On a terminal, a line per
    device shows its pose, uncertainty, rate, latency and state (tracking, provisional, dead
    reckoning or lost). Otherwise, and with --json, stdout has one JSON object per line.

    \b
    SINK is one of
      web://:8080               a page for browsers (map, paths), and /health
      foxglove://:8765          Foxglove and Lichtblick
      jsonl:FILE                a file with one JSON object per line
      udp://HOST:PORT           datagrams, JSON or packed
      mqtt://HOST/PREFIX        JSON; VDA 5050 with ?vda5050=visualization
      zenoh://HOST:7447         ROS 2 with rmw_zenoh, without ROS on this computer
      ros2:                     ROS 2 through rclpy
      mavlink:udpout:HOST:PORT  PX4 and ArduPilot

    Servers listen on this computer only, unless an address is given: web://0.0.0.0:8080. Clients
    then need a token. A slow sink drops poses, but never delays the solver. The exit status is 3
    if a recording lost data.

    \b
    Examples:
      locatk live /dev/ttyACM0 --artifact map.toml --to web://:8080
      locatk live /dev/ttyACM0 --artifact scene.toml --record run.mcap
      locatk live camera:0 --artifact sheet.toml --to udp://192.168.1.20:9000
      locatk live replay:run.mcap --speed 5 --to foxglove://:8765
      locatk live COM3 --input 'COM4 device=lines name=robot' --artifact map.toml
      locatk live --config live.toml
    """
    if listing:
        _list_sinks(as_json)
        return
    from locatk.formats.live import config as live_config
    from locatk.formats.live.session import LiveRequest, LiveSession
    from locatk.formats.live.streams import StreamOptions
    from locatk.formats.sinks.registry import create_sink

    settings = live_config.LiveConfig() if config is None else live_config.read_config(config)
    requests = [live_config.parse_input(text) for text in inputs]
    wait_s = given.pop("wait_s")
    if port is not None:
        columns = given.pop("columns") or None
        requests.insert(0, live_config.single_input(port, columns=columns, **given))
    elif unused := [name for name, value in given.items() if value not in (None, ())]:
        raise click.UsageError(f"--{unused[0]} applies to PORT: give it, or write it in --input.")
    request = LiveRequest(
        _requests(
            (*settings.inputs, *requests),
            (*map(Path, settings.artifacts), *artifact),
            record or settings.record,
            wait_s=wait_s or 0.0,
            overwrite=overwrite,
            rotate_s=rotate or settings.rotate_s,
        ),
        StreamOptions(
            scene,
            None if odometry_noise is None else odometry_noise * DEGREE_RAD,
            None if odometry_lag is None else 1e-3 * odometry_lag,
        ),
        duration_s=duration,
        token=live_config.read_token(token_file or settings.token_file)
        if token_file or settings.token_file
        else None,
    )
    stop = threading.Event()
    is_only_output = not (sinks or settings.sinks or record or settings.record)
    text = LiveText(as_json=as_json, stop=stop.set if is_only_output else lambda: None)
    outputs = [create_sink(address) for address in (*settings.sinks, *sinks)]
    session = LiveSession(request, [text, *outputs], tell=text.tell)
    with contextlib.ExitStack() as stack:
        stack.enter_context(asked_to_stop(stop.set))
        stack.enter_context(text.shown(session))

        def ready() -> None:
            text.ready([each.port for each in request.inputs], outputs)

        result = session.run(stop, ready=ready, waiting=text.waiting)
    text.summary(result)
    losses = [loss for each in result.recordings for loss in each.totals.losses()]
    losses += result.recording_errors
    if losses:
        raise failures.Incomplete("; ".join(losses))


DEGREE_RAD = 0.017453292519943295


def _requests(
    requests: tuple[Any, ...],
    artifacts: tuple[Path, ...],
    record: Path | str,
    *,
    wait_s: float,
    overwrite: bool,
    rotate_s: float | None,
) -> tuple[Any, ...]:
    """Return the inputs with artifacts and outputs."""
    from dataclasses import replace
    from datetime import datetime

    from locatk.formats.capture.recorder import Limits
    from locatk.formats.live.config import recording_path, with_recording

    if not requests:
        raise click.UsageError("Missing PORT.")
    requests = tuple(replace(each, artifacts=artifacts, wait_s=wait_s) for each in requests)
    if not record:
        if rotate_s is not None or overwrite:
            option = "--overwrite" if rotate_s is None else "--rotate"
            raise click.UsageError(f"{option} needs --record.")
        return requests
    output = recording_path(str(record), datetime.now())
    return with_recording(requests, output, limits=Limits(rotate_s=rotate_s), overwrite=overwrite)


def _list_sinks(as_json: bool) -> None:
    from locatk.formats.sinks.registry import sink_summaries

    sinks = sink_summaries()
    if as_json:
        console.emit_json({"version": 1, "sinks": sinks})
    else:
        console.result(console.table(("sink", "receiver"), list(sinks.items())))
