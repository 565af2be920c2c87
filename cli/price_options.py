"""Options of commands that print a bill of materials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from locatk.cli import console, options


def price_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--prices`` and ``--print-prices``."""
    function = click.option(
        "--print-prices",
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=_print_template,
        help="Print a file for --prices with all parts, and do nothing else.",
    )(function)
    return options.input_option(
        "--prices",
        metavar="TOML",
        help="Prices of the parts (.toml).  [default: those of the published papers]",
    )(function)


def _print_template(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
    if not value or ctx.resilient_parsing:
        return
    from locatk.formats.artifacts.prices import prices_template

    console.result(prices_template().rstrip())
    ctx.exit()
