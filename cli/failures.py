"""Conversion of exceptions to one line on stderr and an exit status; the only place of it.

== ==================================================
0  done
1  failed, or results could not be printed
2  usage error
3  finished with losses or unsolved parts
== ==================================================

An interrupt gives 130, as in shells.
"""

from __future__ import annotations

import errno
import os
import traceback
from collections.abc import Sequence

import click

from locatk.cli import console
from locatk.core.errors import LocatkError, system_hint

INTERRUPTED_STATUS = 130
"""Exit status of a command that Ctrl-C ended: 128 and the number of SIGINT (POSIX shells)."""

REPORT_HINT = "Please report it, with the traceback from -v"
"""Hint of errors of the program."""


class Incomplete(click.ClickException):
    """Command that finished with losses or unsolved parts; the message names them."""

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
    """Print ``error`` as one line on stderr and return its exit status."""
    if isinstance(error, click.Abort) and isinstance(error.__cause__, EOFError):
        error = error.__cause__  # click takes it for Ctrl-D; no command reads from the terminal
    if isinstance(error, click.Abort):
        console.message("Aborted")
        return INTERRUPTED_STATUS
    if isinstance(error, Incomplete):
        _print("Incomplete", "yellow", error.format_message(), None)
        return error.exit_code
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return error.exit_code
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "locatk"
        _print_error(error.format_message(), f"See `{path} --help`")
        return error.exit_code
    if isinstance(error, click.ClickException):
        _print_error(error.format_message(), None)
        return error.exit_code

    if console.verbose():
        console.message("".join(traceback.format_exception(error)).rstrip())
    if isinstance(error, LocatkError):
        _print_error(str(error), error.hint or system_hint(error))
        return error.exit_status
    if isinstance(error, OSError) and error.errno is not None:
        file = f"{os.fsdecode(error.filename)}: " if error.filename else ""
        _print_error(file + os.strerror(error.errno), system_hint(error))
        return 1
    if isinstance(error, MemoryError):
        _print_error("not enough memory", "Work on shorter sessions, or fewer at a time")
        return 1
    _print_error(
        f"internal error, {type(error).__name__}: {error}",
        REPORT_HINT,
    )
    return 1


def report_lost_results(error: OSError) -> int:
    """Report that stdout cannot be written, and return the exit status.

    A reader that ended, as in ``| head -1``, wants no more results and no message about them.
    """
    if error.errno == errno.EBADF:
        _print_error(
            "the standard output is closed", "Redirect it: >/dev/null if no results are needed"
        )
    elif not isinstance(error, BrokenPipeError):
        _print_error(
            f"the standard output cannot be written ({error.strerror or error})",
            "Free some space, or print into another file",
        )
    return 1


def describe(error: LocatkError, *, with_file: bool = True) -> str:
    """Return an error with its hint, as one line without the leading ``Error:``."""
    problem = str(error) if with_file else error.message
    return _sentences(problem, error.hint or system_hint(error))


def print_error(error: LocatkError) -> None:
    """Print an error with its hint on stderr."""
    _print_error(str(error), error.hint or system_hint(error))


def _print_error(problem: str, hint: str | None) -> None:
    _print("Error", "red", problem, hint)


def _print(word: str, colour: str, problem: str, hint: str | None) -> None:
    console.message(_sentences(problem, hint), title=f"{word}:", title_colour=colour)


def _sentences(problem: str, hint: str | None) -> str:
    text = _sentence(problem)
    if hint:
        text += " Hint: " + _sentence(hint[0].upper() + hint[1:])
    return text


def _sentence(text: str) -> str:
    """Return ``text`` on one line with a full stop."""
    text = " ".join(text.split())
    return text if text.endswith((".", "!", "?")) else text + "."
