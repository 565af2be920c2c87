"""``locatk camera design``: optics, read rate and accuracy of a camera over printed dots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.options import number
from locatk.core.errors import InputError
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.dots.design.camera_measurement import CameraMeasurement
    from locatk.core.dots.design.camera_setup import CameraSetup, Sensor

RENDERING_S_PER_PX = 0.8e-6
"""Time to render a pixel of a frame and to decode it, on a slow PC."""

FREE_MOTION_PX = 2.0
"""Motion blur that hardly takes time. Each further pixel takes as long as a frame without, as
measured at 13 and 87 px."""

RENDERING_BUDGET_S = 2.5
"""Time for the frames that are rendered by default."""

FRAME_LIMITS = (2, 40)
"""Least and largest number of frames that are rendered by default."""


def _print_cameras(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
    if not value or ctx.resilient_parsing:
        return
    from locatk.formats.artifacts.cameras import cameras_template

    console.result(cameras_template().rstrip())
    ctx.exit()


@click.command(cls=Command)
@section(
    "Camera",
    click.option(
        "--sensor",
        metavar="NAME",
        help="Sensor of the table, as in ov9281.  [default: the first that fits]",
    ),
    options.input_option(
        "--cameras",
        metavar="TOML",
        help="Table of sensors (.toml).  [default: sensors known to locatk]",
    ),
    click.option(
        "--print-cameras",
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=_print_cameras,
        help="Print a file for --cameras with the known sensors, and do nothing else.",
    ),
    click.option(
        "--focal-length",
        type=options.POSITIVE,
        metavar="MM",
        help="Focal length.  [default: of an M12 lens, for the distance and --dots]",
    ),
    click.option(
        "--distance",
        type=options.POSITIVE,
        metavar="MM",
        help="From the lens to the paper.  [default: for --dots, about 20 mm]",
    ),
    number("--f-number", default=2.4, type=options.POSITIVE, metavar="N", help="Of the lens."),
    number(
        "--distortion",
        default=2.0,
        type=click.FloatRange(-35, 35),
        metavar="PERCENT",
        help="Displacement of the corners of the frame towards the centre.",
    ),
    click.option(
        "--exposure",
        type=options.POSITIVE,
        metavar="US",
        help="Exposure time.  [default: a motion of 1/11 pitch at --speed]",
    ),
)
@section(
    "Task",
    number(
        "--speed", default=0.3, type=click.FloatRange(min=0), metavar="M/S", help="Largest speed."
    ),
    number(
        "--turn-rate",
        default=0.0,
        type=click.FloatRange(min=0),
        metavar="DEG/S",
        help="Largest rate of rotation.",
    ),
    number("--rate", default=30.0, type=options.POSITIVE, metavar="HZ", help="Poses per second."),
    number(
        "--dots",
        default=12,
        type=click.IntRange(1, 100),
        metavar="N",
        help="Columns and rows of dots in view in any direction, for the choice of the lens.",
    ),
    number(
        "--focus-error",
        default=0.2,
        type=click.FloatRange(min=0),
        metavar="MM",
        help="Error of the distance: tolerances of the holder, waves of the paper.",
    ),
    number(
        "--tilt",
        default=0.0,
        type=click.FloatRange(0, 45),
        metavar="DEG",
        help="Angle between the optical axis and the vertical.",
    ),
)
@section(
    "Print and light",
    number(
        "--pitch", default=0.508, type=options.POSITIVE, metavar="MM", help="Pitch of the dots."
    ),
    number(
        "--dot",
        default=0.30,
        type=options.POSITIVE,
        metavar="PITCHES",
        help="Diameter of a dot on the paper; the nominal 1/6 grows in print.",
    ),
    number(
        "--jitter",
        default=10.0,
        type=click.FloatRange(min=0),
        metavar="UM",
        help="Standard deviation of the position of a printed dot.",
    ),
    click.option(
        "--illuminance",
        type=options.POSITIVE,
        metavar="LX",
        help="Light on the paper, as of green light.  [default: as much as the exposure needs]",
    ),
    click.option(
        "--noise",
        type=click.FloatRange(0, 255),
        metavar="LEVELS",
        help="Noise of a pixel in grey values.  [default: by the light]",
    ),
)
@section(
    "Output",
    click.option(
        "--frames",
        type=click.IntRange(0, 10_000),
        metavar="N",
        help="Frames to render and decode; 0 for none.  [default: as many as take about 3 s]",
    ),
    number(
        "--seed",
        default=0,
        type=click.IntRange(min=0),
        metavar="N",
        help="Seed of all random numbers.",
    ),
    options.output_option(
        "--holder",
        help="Drawing of camera and paper at true size (.pdf).",
        endings=(".pdf",),
    ),
    number("--size", default="A4", metavar="PAPER", help="Paper of the drawing."),
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    sensor: str | None,
    cameras: Path | None,
    focal_length: float | None,
    distance: float | None,
    f_number: float,
    distortion: float,
    exposure: float | None,
    speed: float,
    turn_rate: float,
    rate: float,
    dots: int,
    focus_error: float,
    tilt: float,
    pitch: float,
    dot: float,
    jitter: float,
    illuminance: float | None,
    noise: float | None,
    frames: int | None,
    seed: int,
    holder: Path | None,
    size: str,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Predict field, focus, exposure, read rate and accuracy of a camera over printed dots.

    Focal length, distance and exposure that are not given are chosen for --dots columns and rows in
    view. Frames with these optics are rendered and decoded to confirm the prediction. The table of
    sensors lists for each, with a lens chosen for the task, whether it fits and why not. If a
    requirement is not met, a warning says what would have to change, and the exit status is 3.

    \b
    Examples:
      locatk camera design --speed 0.3
      locatk camera design --sensor ov9281 --focal-length 3.6 --distance 20
      locatk camera design --sensor mt9v034-binned --exposure 130 --frames 100
      locatk camera design --print-cameras > cameras.toml
      locatk camera design --cameras cameras.toml --speed 1 --holder holder.pdf
    """
    from locatk.cli.camera.design_text import print_design
    from locatk.core.dots.design.camera import compare_sensors, design_camera, suggest_camera
    from locatk.formats.artifacts.cameras import read_cameras

    context = click.get_current_context()
    if holder is not None:
        inputs = [] if cameras is None else [cameras]
        options.guard_output(holder, overwrite=overwrite, inputs=inputs)
    elif context.get_parameter_source("size") is ParameterSource.COMMANDLINE:
        raise click.UsageError("--size is the paper of the drawing: give --holder as well.")
    sensors = read_cameras(cameras)
    chosen = None if sensor is None else _sensor_of(sensor, sensors)
    task: dict[str, Any] = {
        "window_dots": dots,
        "f_number": f_number,
        "distortion": distortion / 100,
        "pitch_m": metres(pitch),
        "dot_pitches": dot,
        "jitter_m": jitter * 1e-6,
        "illuminance_lx": illuminance,
        "noise_levels": noise,
        "focus_error_m": metres(focus_error),
        "tilt_rad": math.radians(tilt),
        "speed_mps": speed,
        "yaw_rate_rps": math.radians(turn_rate),
        "wanted_rate_hz": rate,
        "distance_m": None if distance is None else metres(distance),
    }
    exposure_s = None if exposure is None else exposure * 1e-6
    with console.working("Comparing sensors"):
        fits = compare_sensors(sensors, **task, exposure_s=exposure_s)
        chosen = fits[0].sensor if chosen is None else chosen
        focal_m = None if focal_length is None else metres(focal_length)
        report = design_camera(
            suggest_camera(chosen, **task, focal_m=focal_m, exposure_s=exposure_s)
        )
    measured, reason = _measure(report.setup, frames, seed)
    if holder is not None:
        _draw_holder(report, holder, size, overwrite=overwrite)
    print_design(report, measured, reason, fits, holder, as_json)


def _sensor_of(name: str, sensors: Sequence[Sensor]) -> Sensor:
    from locatk.core.dots.design.camera_sensors import sensor_named
    from locatk.formats.artifacts.kinds import nearest_key_hint

    found = sensor_named(name, tuple(sensors))
    if found is None:
        hint = nearest_key_hint(name.lower(), (sensor.name for sensor in sensors))
        hint = hint.replace("Known keys", "Known sensors; --cameras adds others")
        raise click.UsageError(f"no sensor {name!r} in the table. {hint}.")
    return found


def _measure(
    setup: CameraSetup, frames: int | None, seed: int
) -> tuple[CameraMeasurement | None, str]:
    """Return the measurement of rendered frames, or None and the reason."""
    from locatk.core.dots.design.camera_measurement import measure_camera

    if frames is None:
        least, most = FRAME_LIMITS
        motion_px = setup.motion_m / setup.metres_per_px
        frame_s = RENDERING_S_PER_PX * math.prod(setup.size_px)
        frame_s *= max(1.0, motion_px - FREE_MOTION_PX)
        affordable = RENDERING_BUDGET_S / frame_s
        frames = min(max(int(affordable), least), most)
    if frames == 0:
        return None, "--frames 0"
    try:
        with console.working("Rendering"):
            return measure_camera(setup, frames, seed), ""
    except InputError as error:
        return None, error.message


def _draw_holder(report: Any, path: Path, size: str, *, overwrite: bool) -> None:
    from locatk.core.dots.drawing.holder import HOLDER_TITLE, draw_holder
    from locatk.core.paper_sizes import paper_size
    from locatk.formats.output import atomic_write
    from locatk.formats.printing.drawings import render_pages

    _, paper_mm = paper_size(size)
    data = render_pages(draw_holder(report, paper_mm), HOLDER_TITLE)
    with atomic_write(path, overwrite=overwrite) as file:
        file.write(data)
