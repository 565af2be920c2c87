"""``locatk solve``: sessions in, poses out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options

SCENES = ("auto", "one-planar", "two-planar", "two-3d")

scene_option = click.option(
    "--scene",
    type=click.Choice(SCENES),
    default=None,
    help="Lighthouse: stations and geometry to assume. [default: auto, decided from the data]",
)


class TemplateResolution(click.ParamType):
    """Orientations, lateral offsets and points of templates, kept as ``36,5,80``."""

    name = "resolution"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        numbers = [number.strip() for number in str(value).split(",")]
        if len(numbers) != 3 or not all(number.isdecimal() for number in numbers):
            self.fail(f"{value!r} is not of the form 36,5,80", param, ctx)
        return ",".join(str(int(number)) for number in numbers)


speed_option = click.option(
    "--speed",
    type=click.FloatRange(min=0, min_open=True, max=100),
    metavar="M/S",
    help="Polaris: speed of the array over the tags, where it is known.",
)

templates_option = click.option(
    "--templates",
    type=TemplateResolution(),
    metavar="ORIENTATIONS,OFFSETS,POINTS",
    help="Polaris, --method paper: resolution of the templates, in numbers. Orientations per "
    "360 deg, lateral offsets within half a sensor spacing to either side, and points per "
    "template, which extends one tag spacing before and behind the magnet. [default: 36,5,80]",
)


def _jobs(ctx: click.Context, param: click.Parameter, value: str) -> int:
    """Callback: a number of processes; 0 for one a core."""
    if value != "auto" and not value.isdecimal():
        raise click.BadParameter("give a number, or auto for one a core")
    return 0 if value == "auto" else int(value)


@click.command(short_help="Solve recorded sessions into poses.")
@click.argument("sessions", nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    metavar="PATH",
    help="Solution to write (.mcap), or the folder for those of several sessions; a URL, too. "
    "[default: <session>-solved.mcap beside each session]",
)
@options.method
@scene_option
@options.artifact
@options.input_option(
    "--camera",
    metavar="FILE",
    help="Dots: the camera (.toml) to use instead of the session's.",
)
@speed_option
@templates_option
@click.option(
    "--save-scene",
    type=options.PATH,
    metavar="FILE",
    help="Lighthouse: write the solved scene as an artifact (.toml) too, for --artifact.",
)
@click.option(
    "--jobs",
    metavar="N",
    default="1",
    callback=_jobs,
    help="Sessions to solve at a time; 0 or auto for one a core.  [default: 1]",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Solve on the Dask cluster of this scheduler, tcp://host:8786 (extra locatk[dask]).",
)
@click.option(
    "--resume",
    is_flag=True,
    help="Leave out what is solved: from the same session with the same options and version. "
    "Outdated solutions are replaced.",
)
@options.overwrite
@options.json_flag("A JSON object a session, each on a line")
@options.verbosity
def command(
    sessions: tuple[str, ...],
    output: str | None,
    method: str | None,
    scene: str | None,
    artifact: Path | None,
    camera: Path | None,
    speed: float | None,
    templates: str | None,
    save_scene: Path | None,
    jobs: int,
    scheduler: str | None,
    resume: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve SESSIONS and write the poses to OUTPUT.

    SESSIONS are files, folders (each *.mcap in them that is no solution), patterns in quotes,
    and URLs such as s3://bucket/day/*.mcap (extra locatk[s3]). A session that fails does not
    stop the others. With --json there is one line a session, in the order of the sessions.

    The exit status is 3 where a session could not be solved, a device in it has no pose, a
    tag was not read, a robot does not know where on the map it is or met a landmark that is
    not the map's, or more frames or moments of sweeps gave no pose than gave one; the rest is
    written all the same.

    \b
    Examples:
      locatk solve run.mcap -o solved.mcap
      locatk solve run.mcap -o solved.mcap --method paper --json
      locatk solve first.mcap -o solved.mcap --save-scene scene.toml
      locatk solve day/*.mcap -o solved/ --artifact scene.toml
      locatk solve day/ -o solved/ --jobs auto --resume --json
      locatk solve "s3://bucket/day/*.mcap" -o s3://bucket/solved --scheduler tcp://host:8786
      locatk solve frames.mcap -o solved.mcap --camera camera.toml
      locatk solve pass.mcap -o solved.mcap --artifact tag.toml --speed 0.105
      locatk solve pass.mcap -o solved.mcap --speed 0.105 --method paper --templates 72,9,80
      locatk solve drive.mcap -o solved.mcap --artifact map.toml --method field
    """
    from locatk.cli.solve import jobs as solve_batch
    from locatk.cli.solve.batch import solve_all
    from locatk.cli.systems import Request, check_given
    from locatk.formats.pipeline.discovery import find_sessions

    if scheduler is not None and jobs != 1:
        raise click.UsageError("--jobs is for this machine: leave it out with --scheduler.")
    if save_scene is not None and resume:
        raise click.UsageError("--save-scene does not go with --resume.")
    found = find_sessions(sessions, solve_batch.beside if output is None else None)
    for place in found.passed_over:
        console.detail(f"Passed over {place}: a solution")
    names = found.sessions
    if save_scene is not None:
        check_scene(names)
    outputs = solve_batch.plan_outputs(names, output, many=found.many)
    aside = [path for path in (artifact, camera) if path is not None]
    solve_batch.guard_outputs(
        outputs, [*names, *map(str, aside)], overwrite=overwrite, resume=resume
    )
    if save_scene is not None:
        given = [Path(name) for name in names]
        options.guard_output(save_scene, overwrite=overwrite, inputs=[*given, *aside])

    request = Request(method, scene, artifact, camera, speed, templates)
    if len(names) > 1:
        check_given(request)
    work = solve_batch.plan(
        names,
        outputs,
        request,
        overwrite=overwrite,
        resume=resume,
        detections=as_json,
        save_scene=save_scene,
        travels=scheduler is not None,
    )
    solve_all(work, workers=jobs, scheduler=scheduler, as_json=as_json)


def check_scene(sessions: Sequence[str]) -> None:
    """Refuse --save-scene for what solves no scene."""
    from locatk.formats.pipeline import locations as places

    if len(sessions) > 1:
        raise click.UsageError("--save-scene needs exactly one session.")
    system = places.facts_of(sessions[0]).get("system")
    if system in ("dots", "landmarks", "polaris"):
        raise click.UsageError(f"--save-scene is for lighthouse: {system} solves no scene.")
