"""``locatk map``: design floors of landmarks, check them, and exchange them with other tools.

The group loads a command's module when the command is called (:mod:`locatk.cli.lazy`).
"""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "design": ("locatk.cli.map.design", "Design a map on which every window is unique."),
    "check": ("locatk.cli.map.check", "Prove that a map is unique, or list duplicates."),
    "export": ("locatk.cli.map.export", "Write a map for other tools."),
    "import": ("locatk.cli.map.import_", "Read a map from a table, a LIF layout or a drawing."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


@click.group(
    cls=LazyGroup,
    table=COMMANDS,
    short_help="Design floors of landmarks, check and exchange them.",
)
def command() -> None:
    """Design floors of four-bar landmarks, check them, and exchange them with other tools.

    \b
    Examples:
      locatk map design 24x24 --window L --alphabet 16 --pitch 200 -o map.toml
      locatk map check map.toml
      locatk map export map.toml --format csv -o map.csv
      locatk map import map.csv --format csv -o map.toml
    """
