"""``locatk site``: positions of magnetic tags on a floor: design, check, import, export and survey.

The group loads a command's module when the command is called (:mod:`locatk.cli.lazy`).
"""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "design": ("locatk.cli.site.design", "Place tags on a grid, at points or along a route."),
    "check": ("locatk.cli.site.check", "Check distances, bounds and meanings of the tags."),
    "import": (
        "locatk.cli.site.import_",
        "Read a site from a table, a LIF layout or a drawing.",
    ),
    "export": ("locatk.cli.site.export", "Write a site for other tools."),
    "survey": ("locatk.cli.site.survey", "Estimate the positions of tags from drives over them."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


@click.group(
    cls=LazyGroup,
    table=COMMANDS,
    short_help="Place magnetic tags on a floor, check and survey them.",
)
def command() -> None:
    """Place magnetic tags on a floor, check their positions, import, export and survey them.

    A site is a tag file with the positions of its tags (`[[site]]` in tag.toml).

    \b
    Examples:
      locatk site design tag.toml --grid 3x4 --spacing 1000 -o site.toml
      locatk site check site.toml
      locatk site import survey.csv --tag tag.toml -o site.toml
      locatk site export site.toml -o floor.dxf
      locatk site survey drive1.mcap drive2.mcap drive3.mcap -o site.toml
    """
