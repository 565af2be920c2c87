"""``locatk calibrate``: recordings in, a better artifact out."""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "scene": ("locatk.cli.calibrate.scene", "Estimate the poses of Lighthouse stations."),
    "camera": (
        "locatk.cli.calibrate.camera",
        "Fit focal length, centre and distortion of a camera.",
    ),
    "map": ("locatk.cli.calibrate.map", "Fit the landmarks of a map as built."),
    "printer": ("locatk.cli.calibrate.printer", "Find the best dots and the scale of a printer."),
    "sheet": ("locatk.cli.calibrate.sheet", "Fit tiles and sheets of a floor as built."),
    "tag": ("locatk.cli.calibrate.tag", "Fit the magnets of tags as built."),
}
"""Module and short help of each command. The module holds it as ``command``."""


@click.group(cls=LazyGroup, table=COMMANDS, short_help="Calibrate an artifact from recordings.")
def command() -> None:
    """Calibrate an artifact from recordings.

    \b
    Examples:
      locatk calibrate scene run.mcap -o scene.toml
      locatk calibrate camera run.mcap -o camera.toml
      locatk calibrate printer scan.png -o printer.toml
      locatk calibrate sheet run.mcap -o floor-built.toml
      locatk calibrate tag pass*.mcap -o tag.toml
      locatk calibrate map day/*.mcap -o built.toml
    """
