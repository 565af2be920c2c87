"""Options of commands that read a drawing (DXF): its layers and its unit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from locatk.cli import console

UNITS = ("mm", "cm", "dm", "m", "in", "ft")
"""Units of drawings; a test holds them equal to those of the reader."""


def layer(default: str, content: str) -> Callable[[Any], Any]:
    """Return the option ``--layer``, which is passed on as ``layers``."""
    return click.option(
        "--layer",
        "layers",
        multiple=True,
        metavar="NAME",
        help=f"--format dxf: layer of the {content} and of their texts. Repeatable.  "
        f"[default: {default}]",
    )


def check_layers(layers: tuple[str, ...], format_name: str) -> None:
    """Refuse ``--layer`` for other formats."""
    if layers and format_name != "dxf":
        raise click.UsageError(f"--layer is of --format dxf, not of {format_name}.")


def report(path: Path, unit: str, ignored: Mapping[str, int]) -> None:
    """Print the unit of a drawing, and which entities of its layers were not used."""
    console.say(f"Lengths in {path} are in {unit}.")
    if ignored:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(ignored.items()))
        console.say(f"Not used on these layers: {kinds}.")
