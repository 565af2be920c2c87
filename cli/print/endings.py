"""Formats of printed files, by the endings of their names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

ENDINGS = {
    ".pdf": "pdf",
    ".png": "png",
    ".tif": "tiff",
    ".tiff": "tiff",
    ".pbm": "pbm",
    ".svg": "svg",
    ".txt": "txt",
}
"""Endings of printed files and their formats; no command writes all of them."""


def format_of(
    output: Path, formats: tuple[str, ...], given: str | None = None, hints: Mapping[str, str] = {}
) -> str:
    """Return the format in which ``output`` is written: that of its ending.

    Parameters
    ----------
    output : path
    formats : tuple of str
        Formats of the command.
    given : str, optional
        Value of ``--format``: it has to agree with the ending, and replaces a missing one.
    hints : mapping
        Remedies by endings that are refused; otherwise the endings of the formats are listed.

    Raises
    ------
    UsageError
        The ending belongs to another format, or to none.
    """
    ending = output.suffix.lower()
    name = ENDINGS.get(ending) if ending else given
    if name not in formats:
        known = [each for each, of_format in ENDINGS.items() if of_format in formats]
        listed = " or ".join(filter(None, (", ".join(known[:-1]), known[-1])))
        problem = f"ends in {ending}, which is not written here" if ending else "has no ending"
        remedy = hints.get(ending, f"Use {listed}.")
        raise click.UsageError(f"{output.name!r} {problem}. {remedy}")
    if given not in (None, name):
        raise click.UsageError(
            f"{output.name!r} ends in {ending}, but --format is {given}; change one of them."
        )
    return name
