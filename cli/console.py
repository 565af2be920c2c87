"""What the command says: results on stdout, talk and progress on stderr.

Talk obeys ``-q`` and ``-v``. Colour appears on a terminal only (click strips it
elsewhere), and not where ``NO_COLOR`` is set.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import click

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@dataclass
class _State:
    """How much this run says; reset by :func:`reset` at its start."""

    verbosity: int = 0
    json: bool = False


_state = _State()


def reset() -> None:
    """Forget the ``-q``, ``-v`` and ``--json`` of an earlier run in this process."""
    _state.verbosity = 0
    _state.json = False


def set_verbosity(level: int) -> None:
    """-1 for quiet, 0 as usual, 1 for more."""
    _state.verbosity = level


def set_json(on: bool) -> None:
    """Say that stdout belongs to one JSON object."""
    _state.json = on


def verbose() -> bool:
    """Whether ``-v`` was given."""
    return _state.verbosity > 0


def talks() -> bool:
    """Whether talk is wanted: ``-q`` was not given."""
    return _state.verbosity >= 0


def colour(text: str, name: str) -> str:
    """``text`` in a colour, unless ``NO_COLOR`` is set (https://no-color.org)."""
    return text if os.environ.get("NO_COLOR") else click.style(text, fg=name)


def say(text: str) -> None:
    """Talk that ``-q`` silences."""
    if _state.verbosity >= 0:
        click.echo(text, err=True)


def detail(text: str) -> None:
    """Talk that only ``-v`` brings out."""
    if verbose():
        click.echo(text, err=True)


def warn(text: str) -> None:
    """Something the user should know of the result; ``-q`` silences it."""
    if _state.verbosity >= 0:
        click.echo(colour("Warning:", "yellow") + f" {text}", err=True)


def result(text: str) -> None:
    """A result for people, on stdout; nothing where ``--json`` owns stdout."""
    if not _state.json:
        click.echo(text)


def emit_json(value: Any) -> None:
    """Write ``value`` as one line of JSON; numpy values become plain, NaN becomes null."""
    click.echo(json.dumps(plain(value), allow_nan=False))


def plain(value: Any) -> Any:
    """``value`` with only what JSON knows: arrays and numpy scalars as lists and
    numbers, anything not finite as None."""
    if hasattr(value, "tolist"):  # numpy, without importing it
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, str | int):
        return value
    return str(value)


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Aligned columns: numbers to the right, text to the left, two spaces between."""
    cells = [["" if cell is None else str(cell) for cell in row] for row in rows]
    columns = list(zip(header, *cells, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [len(column) > 1 and all(map(_numeric, column[1:])) for column in columns]

    def line(row: Sequence[str]) -> str:
        aligned = (
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        )
        return "  ".join(aligned).rstrip()

    return "\n".join(line(row) for row in [list(header), *cells])


def labelled(rows: Sequence[tuple[str, str]]) -> str:
    """Format pairs of a label and a text as aligned lines, two spaces between them."""
    width = max(len(label) for label, _ in rows)
    return "\n".join(f"{label:<{width}}  {text}" for label, text in rows)


def _numeric(cell: str) -> bool:
    return cell in ("", "-") or cell.lstrip("<>=~+- ")[:1].isdigit()


class _Counted(Sized, Iterable[T_co], Protocol[T_co]):
    """What can be walked and says how long it is, like a list."""


def progress(items: _Counted[T], label: str) -> AbstractContextManager[Iterable[T]]:
    """``with progress(items, "Solving") as bar: for item in bar`` shows a bar.

    On stderr, only on a terminal, and neither with ``-q`` nor with ``--json``, nor for
    a single item.
    """
    if len(items) < 2 or _state.json or _state.verbosity < 0 or not sys.stderr.isatty():
        return contextlib.nullcontext(items)
    return click.progressbar(items, label=label, file=sys.stderr)


@contextlib.contextmanager
def steps(count: int, label: str) -> Iterator[Callable[[], None]]:
    """A progress bar whose steps are calls, for work that does not walk a list itself."""
    with progress(range(count), label) as bar:
        left = iter(bar)
        next(left, None)

        def done() -> None:
            next(left, None)

        yield done


@contextlib.contextmanager
def working(label: str) -> Iterator[None]:
    """Say on a terminal what is going on while one long call runs; wiped afterwards."""
    shown = not _state.json and _state.verbosity >= 0 and sys.stderr.isatty()
    if shown:
        click.echo(f"{label} ...", err=True, nl=False)
    try:
        yield
    finally:
        if shown:
            click.echo("\r" + " " * (len(label) + 4) + "\r", err=True, nl=False)
