"""Options of the commands of ``locatk simulate``, from the declared settings of each simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from locatk.cli import options
from locatk.cli.command import combine
from locatk.cli.settings_command import (
    CONFIG_FILE,
    PRINT_CONFIG,
    SettingsCommand,
    existing_file,
)


class _UnlessPrinting(click.Parameter):
    """Parameter that is required unless ``--print-config`` is given."""

    def value_is_missing(self, value: Any) -> bool:
        is_printed = click.get_current_context().params.get(PRINT_CONFIG)
        return not is_printed and super().value_is_missing(value)


class _Argument(_UnlessPrinting, click.Argument):
    pass


class _Option(_UnlessPrinting, click.Option):
    pass


def simulation_command(module: str) -> Callable[[Callable[..., None]], click.Command]:
    """Make a function the command whose settings are the ``CONFIG`` of a module."""
    return combine(
        click.command("", cls=SettingsCommand, module=module),
        options.output(
            "Session to write (.mcap), with the truth in it.", endings=(".mcap",), cls=_Option
        ),
        options.input_option(
            "--config",
            CONFIG_FILE,
            metavar="TOML",
            help="Settings of the simulation; the options below override them.",
        ),
        click.option(
            "--print-config",
            PRINT_CONFIG,
            is_flag=True,
            is_eager=True,
            help="Print all settings as a TOML file with comments, and simulate nothing.",
        ),
        options.overwrite,
        options.as_json,
        options.verbosity,
    )


def input_argument(name: str) -> Callable[[Any], Any]:
    """Argument that names an existing file, required unless the settings are printed."""
    return click.argument(
        name, cls=_Argument, type=options.PATH, required=True, callback=existing_file
    )
