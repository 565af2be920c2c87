"""``locatk tag``: design magnetic tags, check them, encode and decode ids.

The group loads a command's module when the command is called (:mod:`locatk.cli.lazy`).
"""

from __future__ import annotations

import click

from locatk.cli.lazy import LazyGroup

COMMANDS = {
    "design": ("locatk.cli.tag.design", "Design a tag or a family of tags."),
    "check": ("locatk.cli.tag.check", "Check the design of existing tags."),
    "encode": ("locatk.cli.tag.encode", "Encode an id as magnets."),
    "decode": ("locatk.cli.tag.decode", "Decode the id of a tag from its magnets."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


@click.group(
    cls=LazyGroup,
    table=COMMANDS,
    short_help="Design magnetic tags, check them, encode and decode ids.",
)
def command() -> None:
    """Design tags of disc magnets, check them, encode and decode their ids.

    \b
    Examples:
      locatk tag design -o tag.toml
      locatk tag check tag.toml
      locatk tag encode 1234 --tag tag.toml
      locatk tag decode 0,0:0 1,1:45 0,2:0 1,2:90 2,2:0
    """
