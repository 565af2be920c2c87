"""Options of commands that read a table: headers of its columns, and their units."""

from __future__ import annotations

import click


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
