"""``locatk room``: Lighthouse stations in a room, designed and checked.

The group loads a command's module when the command is called (:mod:`locatk.cli.lazy`).
"""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "design": ("locatk.cli.room.design", "Place base stations in a room."),
    "check": ("locatk.cli.room.check", "Predict accuracy and coverage of a scene."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


@click.group(
    cls=LazyGroup,
    table=COMMANDS,
    short_help="Place Lighthouse stations in a room, and check a room.",
)
def command() -> None:
    """Place Lighthouse base stations in a room before they are bought, and check a room.

    A room is written as a scene (scene.toml) with the designed stations: `locatk simulate`,
    `locatk solve` and `locatk live` take it as --artifact.

    \b
    Examples:
      locatk room design 10x10x3 --stations 4 --volume 0-1500 -o room.toml
      locatk room design 6x5x2.8 --floor 80 --accuracy 2 -o room.toml --maps room.png
      locatk room check scene.toml
    """
