"""``locatk map``: design floors of landmarks, check them, and exchange them with other tools.

The group loads a command's module when the command is called, as :mod:`.app` does.
"""

from __future__ import annotations

import importlib

import click

COMMANDS = {
    "design": ("locatk.cli.map_design", "Find a map in which every window is unique."),
    "check": ("locatk.cli.map_check", "Prove that a map is unique, or show where not."),
    "export": ("locatk.cli.map_export", "Write a map for other tools."),
    "import": ("locatk.cli.map_import", "Read a map from a table or a LIF layout."),
}
"""Name of a command to its module and short help. The module holds it as ``command``."""


class LazyMapGroup(click.Group):
    """Group of :data:`COMMANDS`, each imported when it is first needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        found: click.Command = importlib.import_module(COMMANDS[name][0]).command
        return found

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, short) for name, (_, short) in COMMANDS.items()])

    def shell_complete(
        self, ctx: click.Context, incomplete: str
    ) -> list[click.shell_completion.CompletionItem]:
        # click's own would import every command for its short help.
        from click.shell_completion import CompletionItem

        names = [
            CompletionItem(name, help=short)
            for name, (_, short) in COMMANDS.items()
            if name.startswith(incomplete)
        ]
        return [*names, *click.Command.shell_complete(self, ctx, incomplete)]


@click.group(cls=LazyMapGroup, short_help="Design floors of landmarks, check and exchange them.")
def command() -> None:
    """Design floors of four-bar landmarks, check them, and exchange them with other tools.

    \b
    Examples:
      locatk map design 24x24 --window L --alphabet 16 --pitch 200 -o map.toml
      locatk map check map.toml
      locatk map export map.toml --format csv -o map.csv
      locatk map import map.csv --format csv -o map.toml
    """
