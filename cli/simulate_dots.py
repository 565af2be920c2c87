"""``locatk simulate dots``: what a camera over a printed sheet would see."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.simulate_options import ABOVE_0, FROM_0, SHARE

if TYPE_CHECKING:
    from collections.abc import Iterable

    from locatk.core.dots.sheet import Manifest
    from locatk.core.dots.simulation.session import SimulationOptions


class Pair(click.ParamType):
    """Two numbers with a comma between them."""

    name = "X,Y"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = map(float, str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not two numbers, as in 1.002,0.999", param, ctx)
        return x, y


@click.command(short_help="Frames of a camera over a printed sheet.")
@options.output("Session to write (.mcap), with the truth in it.")
@options.input_option(
    "--sheet", metavar="MANIFEST", help="Sheet to drive on (.toml).  [default: an A4 sheet]"
)
@click.option("--id", "sheet_id", metavar="ID", help="Which of its sheets.  [default: the first]")
@click.option(
    "--codec",
    type=click.Choice(("anoto", "libdots", "microdots")),
    default="anoto",
    show_default=True,
    help="Of the A4 sheet; a --sheet has its own.",
)
@click.option("--frames", type=click.IntRange(1), help="How many.  [default: 100]")
@click.option(
    "--duration", "duration_s", type=ABOVE_0, metavar="SECONDS", help="Instead of --frames."
)
@click.option("--rate", "rate_hz", type=ABOVE_0, default=50.0, show_default=True, metavar="HZ")
@click.option(
    "--path",
    type=click.Choice(("curve", "random", "still")),
    default="curve",
    show_default=True,
    help="Drive along a curve, stand anywhere turned anyhow in each frame, or stand still.",
)
@click.option(
    "--speed", "speed_mps", type=FROM_0, default=0.1, show_default=True, metavar="M/S",
    help="Along the curve; with the paper's exposure of 0.13 ms, 0.35 m/s blur by 1 px.",
)  # fmt: skip
@click.option(
    "--motion", "motion_px", type=click.FloatRange(0, 100), metavar="PX",
    help="Motion blur, whatever the speed.",
)  # fmt: skip
@click.option(
    "--dot", type=ABOVE_0, default=0.3, show_default=True, metavar="SHARE",
    help="Diameter of a printed dot in pitches: 1/6 as sent to the printer, more with dot gain.",
)  # fmt: skip
@click.option("--missing", type=SHARE, default=0.0, help="Share of dots that are not there.")
@click.option("--dust", type=SHARE, default=0.0, help="Dark specks, as a share of the dots.")
@click.option(
    "--jitter", "jitter_um", type=FROM_0, default=0.0, metavar="UM",
    help="Standard deviation of a dot's place.",
)  # fmt: skip
@click.option(
    "--printer-scale", type=Pair(),
    help="True over nominal length on the paper.  [default: the manifest's]",
)  # fmt: skip
@click.option(
    "--scale-known", is_flag=True, help="Write that scale to the session's manifest, as measured."
)
@click.option("--blur", "blur_px", type=FROM_0, default=0.6, show_default=True, metavar="PX",
              help="Standard deviation of the defocus.")  # fmt: skip
@click.option("--noise", type=FROM_0, default=2.0, show_default=True, metavar="GREY",
              help="Standard deviation, of 255.")  # fmt: skip
@click.option(
    "--contrast", type=SHARE, default=0.75, show_default=True, help="1 is black on white."
)
@click.option("--vignette", type=SHARE, default=0.0, help="By how much corners are darker.")
@click.option("--gradient", type=SHARE, default=0.0, help="By how much one side is darker.")
@click.option(
    "--tilt", "tilt_deg", type=click.FloatRange(0, 45), default=0.0, metavar="DEG",
    help="Each frame is tilted by up to this, in any direction.",
)  # fmt: skip
@click.option(
    "--askew", "askew_deg", type=Pair(), default="0,0", metavar="PITCH,ROLL",
    help="How the camera is mounted, in degrees.",
)  # fmt: skip
@click.option(
    "--distortion", type=click.FloatRange(-20, 20), default=4.5, show_default=True,
    metavar="PERCENT", help="By how much the lens draws in the corners.",
)  # fmt: skip
@options.input_option("--camera", metavar="FILE", help="Another camera (.toml) than the paper's.")
@click.option(
    "--calibrated/--uncalibrated", default=True, help="Whether the session holds the camera."
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    output: Path,
    sheet: Path | None,
    sheet_id: str | None,
    codec: str,
    frames: int | None,
    duration_s: float | None,
    rate_hz: float,
    printer_scale: tuple[float, float] | None,
    scale_known: bool,
    jitter_um: float,
    tilt_deg: float,
    askew_deg: tuple[float, float],
    distortion: float,
    camera: Path | None,
    calibrated: bool,
    overwrite: bool,
    as_json: bool,
    **more: Any,
) -> None:
    """Simulate the paper's camera, 188 x 120 px of 0.046 mm, over a printed sheet.

    The session holds the frames, the sheet's manifest, the camera, and as truth where the
    middle of each frame was and how it was turned. The same options and seed give the
    same frames.

    \b
    Examples:
      locatk simulate dots -o run.mcap
      locatk simulate dots -o run.mcap --sheet SHEET.toml --duration 20 --speed 0.3
      locatk simulate dots -o hard.mcap --path random --missing 0.05 --dust 0.02 --tilt 10
      locatk simulate dots -o printed.mcap --printer-scale 1.002,0.998 --jitter 10
    """
    from dataclasses import replace

    from locatk.core.dots.simulation import session as simulate
    from locatk.formats import sheets

    if frames is not None and duration_s is not None:
        raise click.UsageError("Give --frames or --duration, not both.")
    if scale_known and printer_scale is None:
        raise click.UsageError("--scale-known needs --printer-scale.")
    options.guard_output(output, overwrite=overwrite, inputs=[p for p in (sheet, camera) if p])
    manifest = sheets.read_manifest(sheet) if sheet else simulate.sheet(codec)
    seen = sheets.read_camera(camera) if camera else simulate.camera(distortion / 100)
    if duration_s is not None:
        frames = max(1, round(duration_s * rate_hz))
    wanted = simulate.SimulationOptions(
        frames=frames or 100,
        rate_hz=rate_hz,
        printer_scale=printer_scale,
        jitter_m=jitter_um * 1e-6,
        tilt_rad=math.radians(tilt_deg),
        pitch_rad=math.radians(askew_deg[0]),
        roll_rad=math.radians(askew_deg[1]),
        camera=seen,
        sheet=_number(manifest, sheet_id),
        **more,
    )
    if scale_known and printer_scale is not None:
        manifest = replace(manifest, scale=printer_scale)
    written = _write(output, manifest, wanted, calibrated=calibrated, overwrite=overwrite)
    console.result(
        f"Wrote {output}: {written['frames']} frames of {written['device']} over "
        f"{written['frame']}, {written['truth_poses']} truth poses"
    )
    if as_json:
        console.emit_json({"version": 1, "output": output, **written})


def _number(manifest: Manifest, sheet_id: str | None) -> int:
    """Number of the sheet called so."""
    names = [sheet.id for sheet in manifest.sheets]
    if sheet_id is None:
        return 0
    if sheet_id not in names:
        raise click.BadParameter(
            f"there is no sheet {sheet_id!r}; the manifest has {', '.join(names)}.",
            param_hint="--id",
        )
    return names.index(sheet_id)


def _write(
    output: Path,
    manifest: Manifest,
    wanted: SimulationOptions,
    *,
    calibrated: bool,
    overwrite: bool,
) -> dict[str, Any]:
    """Render into the session, a frame at a time; what was written."""
    from dataclasses import asdict

    from locatk.core.dots.simulation import session as simulate
    from locatk.formats.frames import Shot, write_shots

    simulated = simulate.simulate(manifest, wanted)
    frames = simulated.frames
    said = {f"simulated_{name}": str(value) for name, value in asdict(wanted).items()}

    def shots(numbers: Iterable[int]) -> Iterable[Shot]:
        for k in numbers:
            yield Shot(int(frames.time_ns[k]), frames.names[k], frames.images[k])

    with console.progress(range(len(frames)), "Rendering") as bar:
        counts = write_shots(
            output,
            {frames.device: shots(bar)},
            manifest=simulated.manifest,
            camera=simulated.camera if calibrated else None,
            truth=(simulated.truth,),
            facts=said,
            overwrite=overwrite,
        )
    return {
        "frames": counts[frames.device],
        "device": frames.device,
        "frame": simulated.truth.frame,
        "codec": manifest.codec,
        "calibrated": calibrated,
        "truth_poses": len(simulated.truth),
    }
