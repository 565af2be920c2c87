"""Output of commands: results on stdout; messages and progress on stderr.

Characters that act upon a terminal or are invisible are printed as escapes such as ``\\x1b``,
because names and texts may come from the files of others. A message that cannot be written (a
closed or full stderr) is dropped and changes nothing. A result that cannot be written is dropped
too, so that the command still writes its files; it then fails (:func:`lost_results`).

Messages obey ``-q`` and ``-v``. Colour appears only on a terminal (click removes it otherwise), and
not if ``NO_COLOR`` is set. Results fit :data:`TEXT_COLUMNS`; messages are one line each, so that
programs can filter them.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import click

from locatk.core.printable import escape_controls

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

TEXT_COLUMNS = 80
"""Width of results in characters, as of a terminal."""

MIN_TEXT_COLUMNS = 16
"""Narrowest column of wrapped text in characters."""

PROGRESS_INTERVAL_S = 0.5
"""Interval at which the progress of a long call is shown [s]."""


@dataclass
class _State:
    """Verbosity of the command that runs, and the first failure to write its results."""

    verbosity: int = 0
    json: bool = False
    stdout_error: OSError | None = None


_state = _State()


def reset() -> None:
    """Reset the effect of ``-q``, ``-v`` and ``--json`` of an earlier run in this process."""
    _state.verbosity = 0
    _state.json = False
    _state.stdout_error = None


def set_verbosity(level: int) -> None:
    """Set the verbosity: -1 for ``-q``, 0, or 1 for ``-v``."""
    _state.verbosity = level


def set_json(on: bool) -> None:
    """Reserve stdout for JSON."""
    _state.json = on


def verbose() -> bool:
    """Return whether ``-v`` was given."""
    return _state.verbosity > 0


def talks() -> bool:
    """Return whether messages are printed: ``-q`` was not given."""
    return _state.verbosity >= 0


def colour(text: str, name: str) -> str:
    """Return ``text`` in a colour, unless ``NO_COLOR`` is set (https://no-color.org)."""
    return text if os.environ.get("NO_COLOR") else click.style(text, fg=name)


def message(text: str, *, title: str = "", title_colour: str = "") -> None:
    """Print lines on stderr, after a coloured ``title``; nothing happens if that is impossible."""
    start = colour(title, title_colour) + " " if title else ""
    control(start + escape_controls(text, keep="\n") + "\n")


def control(text: str) -> None:
    """Print text with control characters of the program itself, and no line end, on stderr."""
    with contextlib.suppress(OSError):
        click.echo(text, err=True, nl=False)


def say(text: str) -> None:
    """Print a message, unless ``-q`` was given."""
    if talks():
        message(text)


def open_page(path: Path) -> None:
    """Open a page in the user's browser; without one, say so."""
    import webbrowser

    try:
        is_open = webbrowser.open(path.resolve().as_uri())
    except webbrowser.Error:
        is_open = False
    if not is_open:
        warn(f"no browser was found: open {path} yourself")


def detail(text: str) -> None:
    """Print a message if ``-v`` was given."""
    if verbose():
        message(text)


def warn(text: str) -> None:
    """Print a warning about the result, unless ``-q`` was given."""
    if talks():
        message(on_one_line(text), title="Warning:", title_colour="yellow")


def on_one_line(text: str) -> str:
    """Return ``text`` with line ends and other invisible characters as escapes."""
    return escape_controls(text)


def result(text: str) -> None:
    """Print a result as text on stdout, unless ``--json`` was given."""
    if not _state.json:
        write_result(escape_controls(text, keep="\n") + "\n")


def emit_json(value: Any) -> None:
    """Print ``value`` as one line of JSON; numpy values become plain, nan becomes null.

    Characters outside of ASCII are escaped, as JSON permits.
    """
    write_result(json.dumps(plain(value), allow_nan=False) + "\n")


def emit_file(data: bytes) -> None:
    """Print the content of an output file, unchanged unless stdout is a terminal."""
    is_terminal = sys.stdout.isatty()
    write_result(
        escape_controls(data.decode("utf-8", "replace"), keep="\r\n\t") if is_terminal else data
    )


def write_result(text: str | bytes) -> None:
    """Write to stdout; after a failure, this and all further results are dropped."""
    try:
        click.echo(text, nl=False)
    except OSError as error:
        _drop_results(error)


def _drop_results(error: OSError) -> None:
    _state.stdout_error = _state.stdout_error or error
    with contextlib.suppress(OSError):  # no descriptor
        # Python also flushes the text that is still buffered, when it ends.
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def lost_results() -> OSError | None:
    """Return the reason why results are missing on stdout; None if they are complete."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _drop_results(error)
    return _state.stdout_error


def plain(value: Any) -> Any:
    """Return ``value`` in types of JSON: arrays as lists, numbers that are not finite as None."""
    if hasattr(value, "tolist"):  # An array or number of numpy, which is not imported here.
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


def table(
    header: Sequence[str], rows: Iterable[Sequence[object]], *, max_width: int = TEXT_COLUMNS
) -> str:
    """Format aligned columns: numbers to the right, text to the left, two spaces between.

    A table that is wider than ``max_width`` gets its titles wrapped, then the text of its last
    column. If it is still too wide, the columns continue in further tables that repeat the first
    column.
    """
    cells = [["" if cell is None else on_one_line(str(cell)) for cell in row] for row in rows]
    columns = [list(column) for column in zip(header, *cells, strict=True)]
    titles = _wrap_titles(columns, max_width)
    widths = [
        max(map(len, (*lines, *column[1:]))) for lines, column in zip(titles, columns, strict=True)
    ]
    blocks, block = [], [0]
    for index in range(1, len(columns)):
        total = sum(widths[i] + 2 for i in (*block, index)) - 2
        is_last_text = index == len(columns) - 1 and not _is_numeric(columns[index])
        room = max_width - (total - widths[index])
        if total > max_width and is_last_text and room >= _longest_word(columns[index]):
            widths[index] = room
        elif total > max_width and len(block) > 1:
            blocks.append(block)
            block = [0]
        block.append(index)
    blocks.append(block)
    return "\n\n".join(
        _format_block([titles[i] for i in block], [columns[i] for i in block],
                      [widths[i] for i in block])
        for block in blocks
    )  # fmt: skip


def _longest_word(texts: Iterable[str]) -> int:
    """Return the number of characters of the longest word."""
    return max((len(word) for text in texts for word in text.split()), default=0)


def _wrap_titles(columns: Sequence[Sequence[str]], max_width: int) -> list[list[str]]:
    """Return the lines of each title; the widest titles are wrapped until the table fits."""
    bodies = [max(map(len, column[1:]), default=0) for column in columns]
    shortest = [
        max(body, *map(len, column[0].split(" ")))
        for body, column in zip(bodies, columns, strict=True)
    ]
    widths = [max(body, len(column[0])) for body, column in zip(bodies, columns, strict=True)]
    while sum(widths) + 2 * (len(widths) - 1) > max_width:
        slack = [width - least for width, least in zip(widths, shortest, strict=True)]
        widest = max(range(len(slack)), key=slack.__getitem__)
        if slack[widest] <= 0:
            break
        widths[widest] -= 1
    return [
        textwrap.wrap(column[0], width) or [""] if width else [""]
        for column, width in zip(columns, widths, strict=True)
    ]


def _format_block(
    titles: Sequence[Sequence[str]], columns: Sequence[Sequence[str]], widths: Sequence[int]
) -> str:
    """Format columns whose titles are lines; a cell that is too long continues below."""
    right = [_is_numeric(column) for column in columns]
    height = max(map(len, titles))
    lines = [
        [title[row - height] if row >= height - len(title) else "" for title in titles]
        for row in range(height)
    ]
    for cells in zip(*(column[1:] for column in columns), strict=True):
        parts = [
            _wrap_words(cell, width) if len(cell) > width else [cell]
            for cell, width in zip(cells, widths, strict=True)
        ]
        lines += [list(row) for row in itertools.zip_longest(*parts, fillvalue="")]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )


def _wrap_words(text: str, width: int) -> list[str]:
    """Wrap text between words; a longer word, such as a path, stays whole."""
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) or [""]


def wrapped(text: str, *, indent: int = 2) -> str:
    """Wrap a line at :data:`TEXT_COLUMNS`; the following lines are indented."""
    lines = textwrap.wrap(
        text,
        TEXT_COLUMNS,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(lines)


def labelled(rows: Sequence[tuple[str, str]], *, indent: int = 0) -> str:
    """Format pairs of a label and a text as aligned lines; long texts are wrapped."""
    margin = indent + max((len(label) for label, _ in rows), default=0) + 2
    lines = []
    for label, text in rows:
        start = " " * indent + label
        shown = escape_controls(text, keep="\n")
        parts = _wrap_words(shown, max(MIN_TEXT_COLUMNS, TEXT_COLUMNS - margin))
        lines += [(start if n == 0 else "").ljust(margin) + part for n, part in enumerate(parts)]
    return "\n".join(line.rstrip() for line in lines)


def _is_numeric(column: Sequence[str]) -> bool:
    """Return whether all cells below the title of a column begin with a number."""
    return len(column) > 1 and all(
        cell in ("", "-") or cell.lstrip("<>=~+- ")[:1].isdigit() for cell in column[1:]
    )


class _SizedIterable(Sized, Iterable[T_co], Protocol[T_co]):
    """Iterable of known length."""


def _shows_progress() -> bool:
    return not _state.json and talks() and sys.stderr.isatty()


def progress(items: _SizedIterable[T], label: str) -> AbstractContextManager[Iterable[T]]:
    """Show a progress bar: ``with progress(items, "Solving") as bar: for item in bar``.

    The bar appears for several items on a terminal, without ``-q`` and ``--json``.
    """
    if len(items) < 2 or not _shows_progress():
        return contextlib.nullcontext(items)
    return click.progressbar(items, label=label, file=sys.stderr)


@contextlib.contextmanager
def steps(count: int, label: str) -> Iterator[Callable[[], None]]:
    """Show a progress bar that advances with each call of the function in the context."""
    with progress(range(count), label) as bar:
        remaining = iter(bar)
        next(remaining, None)

        def advance() -> None:
            next(remaining, None)

        yield advance


@contextlib.contextmanager
def working(label: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show a label and the elapsed time on a terminal while one long call runs.

    Yields a function that adds progress: the name of the items, the number of those that are done,
    and their total.
    """
    if not _shows_progress():
        yield lambda items, done, total: None
        return
    started, end, note = time.monotonic(), threading.Event(), ""

    def add(items: str, done: int, total: int) -> None:
        nonlocal note
        note = f", {100 * done // max(total, 1)} % of {total} {items}" if done < total else ""

    def show() -> None:
        while not end.wait(PROGRESS_INTERVAL_S):
            line = f"{label} ... {time.monotonic() - started:.0f} s{note}"
            control(f"\r\x1b[K{line[: shutil.get_terminal_size().columns - 1]}")

    control(f"{label} ...")
    ticker = threading.Thread(target=show, daemon=True)
    ticker.start()
    try:
        yield add
    finally:
        end.set()
        ticker.join()
        erase_line()


def erase_line() -> None:
    """Erase the last line of a terminal."""
    control("\r\x1b[K")
