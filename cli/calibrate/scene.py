"""``locatk calibrate scene``: poses of Lighthouse stations from a session."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.capture import text as capture_text
from locatk.cli.command import Command, section
from locatk.cli.signals import asked_to_stop
from locatk.cli.solve.command import scene_option
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.lighthouse.results import FrameFacts
    from locatk.core.lighthouse.scene.setup import SceneSetup
    from locatk.formats.capture.status import CaptureStatus
    from locatk.formats.pipeline import SolveReport, SolveRequest

MAX_COORDINATE_MM = 1e6
"""Largest coordinate of a marker [mm]: a kilometre."""

NUMBER = click.IntRange(1, 10_000)


class MarkerType(click.ParamType):
    """Name and position of a marker, as in ``door=1200,0`` (mm)."""

    name = "NAME=X,Y[,Z]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, tuple[float, float, float]]:
        """Return the name and the position in metres."""
        if isinstance(value, tuple):
            return value
        name, separator, text = str(value).rpartition("=")
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        is_valid = len(numbers) in (2, 3) and all(
            abs(number) <= MAX_COORDINATE_MM for number in numbers
        )
        if not (separator and name.strip() and is_valid):
            self.fail(f"{value!r} is not NAME=X,Y or NAME=X,Y,Z in mm.", param, ctx)
        x, y, z = (1e-3 * number for number in (*numbers, 0.0)[:3])
        return name, (x, y, z)


setup_options = section(
    "Frame",
    click.option(
        "--marker",
        "markers",
        type=MarkerType(),
        multiple=True,
        help="Point measured by hand, in mm, on which a device rested for two seconds or more. "
        "Give one option a point, three or more, in the order of the standstills; they fix frame "
        "and scale.",
    ),
    click.option(
        "--floor",
        is_flag=True,
        help="The device rested on the floor: first at the origin, then on the x axis, then at any "
        "further points. They fix the frame.",
    ),
    click.option(
        "--origin",
        type=NUMBER,
        metavar="N",
        help="With --floor: number of the standstill at the origin.  [default: the first]",
    ),
    click.option(
        "--x-axis",
        type=NUMBER,
        metavar="N",
        help="With --floor: number of the standstill on the x axis.  [default: the second]",
    ),
    click.option(
        "--x-distance",
        type=options.POSITIVE,
        metavar="MM",
        help="With --floor: distance of this point from the origin in mm; it fixes the scale.",
    ),
    click.option(
        "--ignore",
        type=NUMBER,
        multiple=True,
        metavar="N",
        help="Standstill at another point; repeat it for several.",
    ),
    click.option("--device", metavar="NAME", help="Device that rested, if several did."),
    click.option(
        "--height",
        type=click.FloatRange(0, MAX_COORDINATE_MM),
        default=0.0,
        metavar="MM",
        help="Height of the photodiode above markers and floor in mm, or of the origin of a device "
        "with several photodiodes.  [default: 0]",
    ),
)


wizard_options = section(
    "Wizard",
    click.option(
        "--wizard",
        "port",
        metavar="PORT",
        help="Record SESSION from this port, as `locatk capture` does, and guide through it: the "
        "origin, a point on the x axis, points on the floor, and a motion through the room. "
        "SESSION is OUTPUT with the ending .mcap by default.",
    ),
    click.option(
        "--port-device",
        metavar="NAME",
        help="Device at the port, as --device of `locatk capture`.  [default: auto]",
    ),
    click.option("--baud", type=click.IntRange(min=1), help="[default: that of the device]"),
    click.option(
        "--floor-points",
        type=click.IntRange(0, 20),
        help="Number of points on the floor besides the origin and the x axis.  [default: 2]",
    ),
)


@click.command("scene", cls=Command, short_help="Estimate the poses of Lighthouse stations.")
@click.argument("session", type=options.PATH, required=False)
@options.output("Scene to write (.toml).", endings=(".toml",))
@setup_options
@wizard_options
@click.option(
    "--method",
    type=click.Choice(("bundle", "paper")),
    help="Algorithm: `paper` is the published one, `bundle` is more accurate.  [default: bundle]",
)
@scene_option
@options.input_option(
    "--artifact",
    help="Scene (.toml) whose factory calibrations, ids and markers are used, in addition to those "
    "of SESSION. Its stations are estimated anew.",
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    session: Path | None,
    output: Path,
    method: str | None,
    scene: str | None,
    artifact: Path | None,
    overwrite: bool,
    as_json: bool,
    port: str | None,
    port_device: str | None,
    baud: int | None,
    floor_points: int | None,
    **points: Any,
) -> None:
    """Estimate the Lighthouse stations of SESSION and write them as a scene.

    Later sessions with the same stations use it with `locatk solve --artifact`. The standstills of
    the devices are listed with their numbers, times, positions and use. Without markers and floor,
    the accelerometers of the stations level the scene.

    \b
    Examples:
      locatk calibrate scene run.mcap -o scene.toml
      locatk calibrate scene run.mcap -o scene.toml --scene two-3d
      locatk calibrate scene run.mcap -o scene.toml --floor --x-distance 1000
      locatk calibrate scene run.mcap -o scene.toml \\
          --marker a=0,0 --marker b=2000,0 --marker c=2000,1500
      locatk calibrate scene -o scene.toml --wizard /dev/ttyACM0 --x-distance 1000
      locatk solve later.mcap -o solved.mcap --artifact scene.toml
    """
    from locatk.formats.pipeline import SolveRequest

    if port is not None:
        if points["markers"]:
            raise click.UsageError("--wizard guides to points of the floor. Leave out --marker.")
        points["floor"] = True
    setup = scene_setup(**points)
    artifacts = [] if artifact is None else [artifact]
    if port is not None:
        session = session or output.with_suffix(".mcap")
        options.guard_output(output, overwrite=overwrite, inputs=artifacts)
        setup = record_with_guide(
            session,
            setup,
            port=port,
            device=port_device or "auto",
            baud=baud,
            floor_points=2 if floor_points is None else floor_points,
            overwrite=overwrite,
        )
    else:
        for option, value in (
            ("--port-device", port_device),
            ("--baud", baud),
            ("--floor-points", floor_points),
        ):
            if value is not None:
                raise click.UsageError(f"{option} needs --wizard.")
        if session is None:
            raise click.UsageError("Missing argument 'SESSION'.")
        options.must_exist([session])
        options.guard_output(output, overwrite=overwrite, inputs=[session, *artifacts])
    request = SolveRequest(method=method, scene=scene, artifact=artifact, setup=setup)
    solve_scene(session, output, request, overwrite=overwrite, as_json=as_json)


def record_with_guide(
    session: Path,
    setup: SceneSetup,
    *,
    port: str,
    device: str,
    baud: int | None,
    floor_points: int,
    overwrite: bool,
) -> SceneSetup:
    """Record a session while guiding through it, and return the setup of its scene.

    Raises
    ------
    failures.Incomplete
        The recording ended before all points were visited. It is kept.
    """
    from locatk.formats.capture.scene_guide import SceneGuide
    from locatk.formats.capture.setup import CaptureRequest, record
    from locatk.formats.sessions.observations import read_sweeps
    from locatk.formats.sessions.reader import Session

    if setup.origin or setup.x_axis or setup.ignored or setup.device:
        raise click.UsageError("--wizard finds the points itself: leave out their numbers.")
    options.check_ending(session, (".mcap",))
    guide = SceneGuide(floor_points, setup.x_distance_m)
    stop = threading.Event()
    with capture_text.live() as live, asked_to_stop(stop.set):

        def show(status: CaptureStatus) -> None:
            for line in guide.update(status.elapsed_s):
                live.wipe()
                console.say(line)
            live.line(f"{capture_text.clock(status.elapsed_s)}  {guide.status}")
            if guide.is_done:
                stop.set()

        request = CaptureRequest(port, device, session, baud=baud, overwrite=overwrite)
        recorded = record(
            request,
            stop,
            tell=live.tell,
            show=show,
            ready=live.ready,
            waiting=live.waiting,
            observe=guide.observe,
        )
    if not guide.can_finish:
        raise failures.Incomplete(
            f"{len(guide.accepted)} of {floor_points + 2} points were recorded ({recorded.ended}); "
            f"the recording is kept in {session}, and no scene was written"
        )
    sweeps = read_sweeps(Session.open(session))
    return guide.setup(sweeps, setup.x_distance_m, setup.height_m)


def scene_setup(
    *,
    markers: tuple[tuple[str, tuple[float, float, float]], ...],
    floor: bool,
    origin: int | None,
    x_axis: int | None,
    x_distance: float | None,
    ignore: tuple[int, ...],
    device: str | None,
    height: float,
) -> SceneSetup:
    """Return the setup that the options describe; fail if they contradict each other."""
    from locatk.core.lighthouse.scene.setup import SceneSetup

    has_floor = floor or any(value is not None for value in (origin, x_axis, x_distance))
    if markers and has_floor:
        raise click.UsageError("--marker and --floor both fix the frame. Give one of them.")
    if not (markers or has_floor) and (ignore or height):
        option = "--ignore" if ignore else "--height"
        raise click.UsageError(f"{option} needs --marker or --floor.")
    for number in (origin, x_axis):
        if number is not None and number in ignore:
            raise click.UsageError(f"Standstill {number} is a point of the floor and ignored.")
    names = [name for name, _ in markers]
    if len(set(names)) < len(names):
        raise click.UsageError("Two markers have the same name.")
    if 0 < len(markers) < 3:
        raise click.UsageError("A frame needs three markers or more, not on one line.")
    return SceneSetup(
        markers=markers,
        has_floor=has_floor,
        origin=origin,
        x_axis=x_axis,
        x_distance_m=None if x_distance is None else 1e-3 * x_distance,
        ignored=ignore,
        device=device,
        height_m=1e-3 * height,
    )


def solve_scene(
    session: Path,
    output: Path,
    request: SolveRequest,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve a session, write its scene, and print the report."""
    from locatk.cli.solve.text import json_entry, notes, text
    from locatk.core.solution import to_json
    from locatk.formats.artifacts.scene import write_scene
    from locatk.formats.pipeline import solve_session, summarize
    from locatk.formats.sessions.reader import Session

    system = Session.open(session).facts.get("system")
    if system not in (None, "", "lighthouse"):
        raise InputError(
            f"a session of {system}, not of lighthouse",
            file=session,
            hint="Give a session with sweeps of Lighthouse stations",
        )
    with console.working("Solving"):
        solved = solve_session(session, request)
    write_scene(output, solved.solution.artifact, overwrite=overwrite)
    report = summarize(str(session), str(output), solved.solution, solved.solve_s)
    facts = solved.solution.facts
    frame = None if facts is None else facts.frame
    console.result(text(report))
    if frame is not None:
        console.result(frame_text(frame, report))
    for note in notes(report):
        console.say(note)
    if as_json:
        entry = {**json_entry(report), "frame": to_json(frame)}
        console.emit_json({"version": 1, "sessions": [entry]})


def frame_text(frame: FrameFacts, report: SolveReport) -> str:
    """Format the standstills, and the source and the standard deviations of the frame."""
    unit = "mm" if report.is_metric else "1e-3"
    figures = [
        (name, None if value is None else f"{factor * value:.2g} {suffix}")
        for name, value, factor, suffix in (
            ("level", frame.level_sigma_rad, math.degrees(1), "deg"),
            ("x axis", frame.heading_sigma_rad, math.degrees(1), "deg"),
            ("origin", frame.origin_sigma_m, 1e3, "mm"),
            ("scale", frame.scale_sigma, 100, "%"),
        )
    ]
    known = ", ".join(f"{name} {value}" for name, value in figures if value is not None)
    parts = [console.wrapped(f"frame: from {frame.source}{f', sigma: {known}' if known else ''}")]
    deviation_rad, sigma_rad = frame.up_deviation_rad, frame.up_sigma_rad
    if deviation_rad is not None and sigma_rad is not None and frame.source != "gravity":
        parts.append(
            f"gravity: {math.degrees(deviation_rad):.1f} deg from z by the accelerometers of the "
            f"stations (sigma {math.degrees(sigma_rad):.1f} deg)"
        )
    rests = frame.standstills or ()
    if rests:
        first_ns = rests[0].start_ns
        parts.append(
            console.table(
                ("standstill", "device", "after [s]", "duration [s]",
                 *(f"{axis} [{unit}]" for axis in "xyz"), "use"),
                [
                    (
                        rest.number,
                        rest.device,
                        f"{1e-9 * (rest.start_ns - first_ns):.1f}",
                        f"{1e-9 * (rest.end_ns - rest.start_ns):.1f}",
                        *(
                            ("-",) * 3
                            if rest.position_m is None
                            else (round(1e3 * value) for value in rest.position_m)
                        ),
                        rest.role or "-",
                    )
                    for rest in rests
                ],
            )
        )  # fmt: skip
    return "\n".join(parts)
