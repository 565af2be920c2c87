"""``locatk solve``: sessions in, poses out."""

from __future__ import annotations

import contextlib
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options, seen
from locatk.core.errors import LocatkError

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


@click.command(short_help="Solve recorded sessions into poses.")
@options.sessions
@options.output("Solution to write (.mcap); with several sessions, the folder for them.")
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
@options.overwrite
@options.as_json
@options.verbosity
def command(
    sessions: tuple[Path, ...],
    output: Path,
    method: str | None,
    scene: str | None,
    artifact: Path | None,
    camera: Path | None,
    speed: float | None,
    save_scene: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve SESSIONS and write the poses to OUTPUT.

    The exit status is 3 where a session could not be solved, a device in it has no pose, a
    tag was not read, or a robot does not know where on the map it is; the rest is written
    all the same.

    \b
    Examples:
      locatk solve run.mcap -o solved.mcap
      locatk solve run.mcap -o solved.mcap --method paper --json
      locatk solve first.mcap -o solved.mcap --save-scene scene.toml
      locatk solve day/*.mcap -o solved/ --artifact scene.toml
      locatk solve frames.mcap -o solved.mcap --camera camera.toml
      locatk solve pass.mcap -o solved.mcap --artifact tag.toml --speed 0.105
      locatk solve drive.mcap -o solved.mcap --artifact map.toml --method field
    """
    from locatk.cli.systems import Request, solve_session, system_of
    from locatk.formats import artifacts, solutions

    outputs = plan_outputs(sessions, output)
    if save_scene is not None and len(sessions) > 1:
        raise click.UsageError("--save-scene needs exactly one session.")
    if save_scene is not None and (system := system_of(sessions[0])) in (
        "dots",
        "landmarks",
        "polaris",
    ):
        raise click.UsageError(f"--save-scene is for lighthouse: {system} solves no scene.")
    aside = [path for path in (artifact, camera) if path is not None]
    for path in outputs:
        options.guard_output(path, overwrite=overwrite, inputs=[*sessions, *aside])
    if save_scene is not None:
        options.guard_output(save_scene, overwrite=overwrite, inputs=sessions)

    request = Request(method, scene, artifact, camera, speed)
    entries: list[dict[str, Any]] = []
    losses: list[str] = []
    said: list[tuple[str, list[str]]] = []
    wait = console.working("Solving") if len(sessions) == 1 else contextlib.nullcontext()
    with wait, console.progress(sessions, "Solving") as bar:
        for session, target in zip(bar, outputs, strict=True):
            try:
                solved = solve_session(session, request)
                solutions.write_solution(
                    target, solved.solution, source=session, overwrite=overwrite
                )
                if save_scene is not None:
                    artifacts.write_scene(save_scene, solved.solution.artifact, overwrite=overwrite)
            except LocatkError as error:
                if len(sessions) == 1:
                    raise
                losses.append(failures.describe(error))
                entries.append({"session": session, "error": error.message, "hint": error.hint})
                continue
            entries.append(entry(session, target, solved))
            losses += [f"{session}: {loss}" for loss in seen.lost(solved.solution)]
            said.append((text(session, target, solved), notes(session, solved)))

    for results, remarks in said:  # not inside the loop: a progress bar is there
        console.result(results)
        for remark in remarks:
            console.say(remark)
    if as_json:
        console.emit_json({"version": 1, "sessions": entries})
    if losses:
        for loss in losses[1:]:
            console.warn(loss)
        if all("error" in item for item in entries):
            raise click.ClickException(losses[0])
        raise failures.Incomplete(losses[0])


def plan_outputs(sessions: tuple[Path, ...], output: Path) -> list[Path]:
    """Where each session's solution goes: ``output``, or a file of the session's name in it.

    A folder for several sessions is made.
    """
    if len(sessions) == 1 and not output.is_dir():
        return [output]
    twins = [name for name, count in Counter(p.stem for p in sessions).items() if count > 1]
    if twins:
        raise click.UsageError(f"Several sessions have the name {twins[0]!r}.")
    options.make_folder(output)
    return [output / f"{session.stem}.mcap" for session in sessions]


def entry(session: Path, output: Path, solved: Solved) -> dict[str, Any]:
    """One session of ``--json`` (ARCHITECTURE 4; docs/commands.md)."""
    solution = solved.solution
    return {
        "session": session,
        "system": solution.system,
        "method": solution.method,
        "output": output,
        "poses": solution.poses,
        "rejected": solution.rejected,
        "solve_s": solved.solve_s,
        "detections": solution.detections,
        **({"facts": solution.facts} if solution.system == "landmarks" else {}),
    }


def text(session: Path, output: Path, solved: Solved) -> str:
    """The same for people: a line, a table of devices, and what was rejected."""
    solution = solved.solution
    # A scene that nothing measured has no metres.
    unit = "1e-3" if getattr(solution.artifact, "scale", None) == "unit" else "mm"
    header = ("device", "poses", "sigma x", "sigma y", f"sigma z [{unit}]", "heading [deg]")
    rows = [(t.device, len(t), *_spread(t.sigma)) for t in solution.trajectories]
    rejected = ", ".join(
        f"{count} {reason.replace('_', ' ')}" for reason, count in solution.rejected.items()
    )
    saw = seen.seen(solution)
    return "\n".join(
        [
            f"{session} -> {output}: {solution.poses} poses, {solution.system} by "
            f"{solution.method}, {solved.solve_s:.3g} s",
            *([saw] if saw else []),
            *([console.table(header, rows)] if rows else []),
            f"rejected: {rejected or 'nothing'}",
        ]
    )


def notes(session: Path, solved: Solved) -> list[str]:
    """What must be known to use the poses; said with ``--json`` too, on stderr."""
    return [f"{session.name}: {note}" for note in solved.solution.notes]


def _spread(sigma: Any) -> list[str]:
    """Median standard deviations: x, y, z in mm and heading in degrees, `-` where unknown."""
    import numpy as np

    in_units = sigma[:, [0, 1, 2, 5]] * [1e3, 1e3, 1e3, 180 / np.pi]
    known = [column[np.isfinite(column)] for column in in_units.T]
    # Of lighthouse these are millimetres, of dots a thousandth of that.
    return [f"{np.median(column):#.3g}" if len(column) else "-" for column in known]
