"""``locatk calibrate``: recordings in, a better artifact out."""

from __future__ import annotations

from pathlib import Path

import click

from locatk.cli import console, options
from locatk.cli.calibrate.camera import camera
from locatk.cli.calibrate.map import map_
from locatk.cli.calibrate.printer import printer
from locatk.cli.calibrate.tag import tag
from locatk.cli.solve.command import scene_option


@click.group(short_help="Make a better artifact from recordings.")
def command() -> None:
    """Make a better artifact from recordings.

    \b
    Examples:
      locatk calibrate scene run.mcap -o scene.toml
      locatk calibrate camera run.mcap -o camera.toml
      locatk calibrate printer scan.png -o printer.toml
      locatk calibrate tag pass*.mcap -o tag.toml
      locatk calibrate map day/*.mcap -o built.toml
    """


command.add_command(camera)
command.add_command(map_)
command.add_command(printer)
command.add_command(tag)


@command.command(short_help="Solve where the Lighthouse stations are.")
@options.input_argument("session")
@options.output("Scene to write (.toml).")
@options.method
@scene_option
@options.overwrite
@options.as_json
@options.verbosity
def scene(
    session: Path,
    output: Path,
    method: str | None,
    scene: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve the Lighthouse stations of SESSION and write them as a scene.

    Later sessions in the same place use it with `locatk solve --artifact`.

    \b
    Examples:
      locatk calibrate scene run.mcap -o scene.toml
      locatk calibrate scene run.mcap -o scene.toml --scene two-3d
      locatk solve later.mcap -o solved.mcap --artifact scene.toml
    """
    from locatk.cli.solve.text import entry, notes, text
    from locatk.cli.systems import Request, solve_session
    from locatk.formats.artifacts import scene as artifacts

    options.guard_output(output, overwrite=overwrite, inputs=[session])
    with console.working("Solving"):
        solved = solve_session(session, Request(method=method, scene=scene))
    artifacts.write_scene(output, solved.solution.artifact, overwrite=overwrite)
    console.result(text(session, output, solved))
    for note in notes(session, solved):
        console.say(note)
    if as_json:
        console.emit_json({"version": 1, "sessions": [entry(session, output, solved)]})
