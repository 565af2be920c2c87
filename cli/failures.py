"""The one place where an exception becomes a line on stderr and an exit status.

== =============================================================
0  done
1  failed
2  wrong usage
3  finished, but something was lost or left unsolved
== =============================================================

130 is an interrupt, as shells have it.
"""

from __future__ import annotations

import errno
import os
import traceback
from collections.abc import Sequence

import click

from locatk.cli import console
from locatk.core.errors import LocatkError

INTERRUPTED = 130

_OS_HINTS = {
    errno.EACCES: "Check the permissions of the file and of its folder",
    errno.EPERM: "Check the permissions of the file and of its folder",
    errno.EROFS: "Choose another -o: that file system is read-only",
    errno.EISDIR: "Name a file, not a folder",
    errno.ENOTDIR: "One part of the path is a file, not a folder",
    errno.ENOENT: "Check the spelling of the path",
    errno.ENOSPC: "Free some space or write to another disk",
    errno.EDQUOT: "Free some space or write to another disk",
    errno.ENAMETOOLONG: "Choose a shorter name",
}


class Incomplete(click.ClickException):
    """The command finished, but something was lost or left unsolved; says what."""

    exit_code = 3


def finish_with_warnings(warnings: Sequence[str]) -> None:
    """Print the warnings of a report, and end the command as incomplete if there are any.

    The first warning is the reason in the last line of the output.

    Raises
    ------
    Incomplete
        There is a warning.
    """
    for text in warnings[1:]:
        console.warn(f"{text[0].upper()}{text[1:]}.")
    if warnings:
        raise Incomplete(warnings[0])


def report(error: BaseException) -> int:
    """Print ``error`` as one line on stderr and return the exit status it means."""
    if isinstance(error, click.Abort):
        click.echo("Aborted", err=True)
        return INTERRUPTED
    if isinstance(error, Incomplete):
        click.echo(_line("Incomplete", "yellow", error.format_message(), None), err=True)
        return error.exit_code
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return error.exit_code
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "locatk"
        _error(error.format_message(), f"`{path} --help` shows how to use it")
        return error.exit_code
    if isinstance(error, click.ClickException):
        _error(error.format_message(), None)
        return error.exit_code

    if console.verbose():
        click.echo("".join(traceback.format_exception(error)), err=True, nl=False)
    if isinstance(error, LocatkError):
        _error(str(error), error.hint)
        return error.exit_status
    if isinstance(error, OSError) and error.errno is not None:
        what = os.strerror(error.errno)
        _error(f"{what}{_place(error)}", _OS_HINTS.get(error.errno))
        return 1
    if isinstance(error, MemoryError):
        _error("not enough memory", "Solve fewer or shorter sessions at once")
        return 1
    _error(
        f"internal error, {type(error).__name__}: {error}",
        "Please report it, with the traceback that -v shows",
    )
    return 1


def describe(error: LocatkError) -> str:
    """``error`` with its hint, as one line without the leading ``Error:``."""
    return _sentences(str(error), error.hint)


def _error(what: str, hint: str | None) -> None:
    click.echo(_line("Error", "red", what, hint), err=True)


def _line(word: str, colour: str, what: str, hint: str | None) -> str:
    return console.colour(f"{word}:", colour) + " " + _sentences(what, hint)


def _sentences(what: str, hint: str | None) -> str:
    text = _sentence(what)
    if hint:
        text += " Hint: " + _sentence(hint[0].upper() + hint[1:])
    return text


def _sentence(text: str) -> str:
    """``text`` on one line with a full stop."""
    text = " ".join(text.split())
    return text if text.endswith((".", "!", "?")) else text + "."


def _place(error: OSError) -> str:
    return f" in {os.fsdecode(error.filename)}" if error.filename else ""
