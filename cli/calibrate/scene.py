"""``locatk calibrate scene``: poses of Lighthouse stations from a session."""

from __future__ import annotations

from pathlib import Path

import click

from locatk.cli import console, options
from locatk.cli.command import Command
from locatk.cli.solve.command import scene_option
from locatk.core.errors import InputError


@click.command("scene", cls=Command, short_help="Estimate the poses of Lighthouse stations.")
@options.input_argument("session")
@options.output("Scene to write (.toml).", endings=(".toml",))
@click.option(
    "--method",
    type=click.Choice(("bundle", "paper")),
    help="Algorithm: `paper` is the published one, `bundle` is more accurate.  [default: bundle]",
)
@scene_option
@options.overwrite
@options.as_json
@options.verbosity
def command(
    session: Path,
    output: Path,
    method: str | None,
    scene: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Estimate the Lighthouse stations of SESSION and write them as a scene.

    Later sessions with the same stations use it with `locatk solve --artifact`.

    \b
    Examples:
      locatk calibrate scene run.mcap -o scene.toml
      locatk calibrate scene run.mcap -o scene.toml --scene two-3d
      locatk solve later.mcap -o solved.mcap --artifact scene.toml
    """
    from locatk.cli.solve.text import json_entry, notes, text
    from locatk.formats.artifacts.scene import write_scene
    from locatk.formats.pipeline import SolveRequest, solve_session, summarize

    options.guard_output(output, overwrite=overwrite, inputs=[session])
    with console.working("Solving"):
        solved = solve_session(session, SolveRequest(method=method, scene=scene))
    if solved.solution.system != "lighthouse":
        raise InputError(
            f"a session of {solved.solution.system}, not of lighthouse",
            file=session,
            hint="Give a session with sweeps of Lighthouse stations",
        )
    write_scene(output, solved.solution.artifact, overwrite=overwrite)
    report = summarize(str(session), str(output), solved.solution, solved.solve_s)
    console.result(text(report))
    for note in notes(report):
        console.say(note)
    if as_json:
        console.emit_json({"version": 1, "sessions": [json_entry(report)]})
