"""``locatk print``: artifacts on paper, at true size."""

from __future__ import annotations

import click

from locatk.cli.command import Group
from locatk.cli.print.landmarks import landmarks
from locatk.cli.print.pattern import pattern
from locatk.cli.print.site import site
from locatk.cli.print.tag import tag
from locatk.cli.print.test_sheet import testsheet


@click.group(cls=Group, short_help="Draw dot sheets and templates at true size.")
def command() -> None:
    """Draw dot sheets, and templates for placing magnets, at true size.

    \b
    Examples:
      locatk print pattern -o sheet.pdf
      locatk print tag tag.toml --id 262143 -o tag.pdf
      locatk print site site.toml -o plan.pdf
      locatk print landmarks map.toml -o pack.pdf
      locatk print testsheet -o test.pdf
    """


command.add_command(pattern)
command.add_command(tag)
command.add_command(site)
command.add_command(landmarks)
command.add_command(testsheet)
