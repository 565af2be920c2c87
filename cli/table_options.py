"""Options of commands that read a table: headers of its columns, and their units."""

from __future__ import annotations

import click

from locatk.cli.command import section


def parse_columns(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> dict[str, str] | None:
    """Return ``t=time,x=odom_x`` as a dictionary; a click callback."""
    if value is None:
        return None
    headers: dict[str, str] = {}
    for pair in value.split(","):
        key, equals, name = (part.strip() for part in pair.partition("="))
        if not (key and equals and name):
            raise click.BadParameter(f"{pair!r} is not KEY=NAME.")
        if key in headers:
            raise click.BadParameter(f"{key} occurs twice.")
        headers[key] = name
    return headers


def parse_words(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[str, ...] | None:
    """Return ``s,mm,deg`` as a tuple; a click callback."""
    return value if value is None else tuple(word.strip().lower() for word in value.split(","))


site_table_options = section(
    "Tables",
    click.option(
        "--columns",
        metavar="KEY=NAME,...",
        callback=parse_columns,
        help="Headers of x, y, heading, id and meaning, if they differ from these names.",
    ),
    click.option(
        "--units",
        metavar="UNIT,...",
        callback=parse_words,
        help="Units of columns without a unit in their names: one of m, cm, mm; of rad, deg.",
    ),
)
"""Options of tables of positions, for :mod:`locatk.formats.importers.floors.site_csv`."""
