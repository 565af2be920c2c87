"""``locatk solve``: sessions in, poses out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options, seen

if TYPE_CHECKING:
    from locatk.cli.systems import Solved

SCENES = ("auto", "one-planar", "two-planar", "two-3d")

scene_option = click.option(
    "--scene",
    type=click.Choice(SCENES),
    default=None,
    help="Lighthouse: stations and geometry to assume. [default: auto, decided from the data]",
)

speed_option = click.option(
    "--speed",
    type=click.FloatRange(min=0, min_open=True, max=100),
    metavar="M/S",
    help="Polaris: speed of the array over the tags, where it is known.",
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
      locatk solve drive.mcap -o solved.mcap --artifact map.toml --method field
    """
    from locatk.cli import solve_batch
    from locatk.cli.solve_all import solve_all
    from locatk.cli.systems import Request, check_given
    from locatk.formats.batch.find import find_sessions

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

    request = Request(method, scene, artifact, camera, speed)
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
    from locatk.formats.batch import places

    if len(sessions) > 1:
        raise click.UsageError("--save-scene needs exactly one session.")
    system = places.facts_of(sessions[0]).get("system")
    if system in ("dots", "landmarks", "polaris"):
        raise click.UsageError(f"--save-scene is for lighthouse: {system} solves no scene.")


def entry(session: str | Path, output: str | Path, solved: Solved) -> dict[str, Any]:
    """One session of ``--json`` (ARCHITECTURE 4; docs/commands.md)."""
    from locatk.core.solution import to_json

    solution = solved.solution
    return {
        "session": session,
        "system": solution.system,
        "method": solution.method,
        "output": output,
        "poses": solution.poses,
        "rejected": solution.rejected,
        "solve_s": solved.solve_s,
        "detections": to_json(solution.detections),
        **({"facts": to_json(solution.facts) or {}} if solution.system == "landmarks" else {}),
    }


def text(session: str | Path, output: str | Path, solved: Solved) -> str:
    """The same for people: a line, a table of devices, and what was rejected."""
    solution = solved.solution
    # A scene that nothing measured has no metres.
    unit = "1e-3" if getattr(solution.artifact, "scale", None) == "unit" else "mm"
    sigmas = [f"sigma {axis} [{unit}]" for axis in "xyz"]
    header = ("device", "poses", *sigmas, "sigma heading [deg]")
    rows = [(t.device, len(t), *_spread(t.sigma)) for t in solution.trajectories]
    rejected = ", ".join(
        f"{count} {reason.replace('_', ' ')}" for reason, count in solution.rejected.items()
    )
    saw = seen.seen(solution)
    took = "solved before" if math.isnan(solved.solve_s) else f"{solved.solve_s:.3g} s"
    return "\n".join(
        [
            f"{session} -> {output}: {solution.poses} poses, {solution.system} by "
            f"{solution.method}, {took}",
            *([saw] if saw else []),
            *([console.table(header, rows)] if rows else []),
            f"rejected: {rejected or 'nothing'}",
        ]
    )


def notes(session: str | Path, solved: Solved) -> list[str]:
    """What must be known to use the poses; said with ``--json`` too, on stderr."""
    return [f"{Path(session).name}: {each.message}" for each in solved.solution.warnings]


def _spread(sigma: Any) -> list[str]:
    """Median standard deviations: x, y, z in mm and heading in degrees, `-` where unknown."""
    import numpy as np

    in_units = sigma[:, [0, 1, 2, 5]] * [1e3, 1e3, 1e3, 180 / np.pi]
    known = [column[np.isfinite(column)] for column in in_units.T]
    # Of lighthouse these are millimetres, of dots a thousandth of that.
    return [f"{np.median(column):#.3g}" if len(column) else "-" for column in known]
