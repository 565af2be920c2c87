"""What can go wrong, and with which hint.

::

    LocatkError
    +-- InputError          (ValueError)       data that cannot be used
    |   +-- FormatError                        not the kind of file that was expected
    |   +-- ArtifactError                      a TOML artifact with a wrong key or value
    +-- DegenerateError     (ValueError)       the geometry does not determine the answer
    +-- OutputExistsError   (FileExistsError)  the output is there and --overwrite is not
    +-- MissingDataError    (FileNotFoundError)  a file or folder that is not there

Each error is one line and, where one helps, a hint. The command line prints both
and ends with :attr:`LocatkError.exit_status`; a library user catches the class, or
the builtin beside it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


class LocatkError(Exception):
    """Root of all errors that locatk raises on purpose.

    Parameters
    ----------
    message : str
        What is wrong, in one line, without a full stop.
    file : path, optional
        The file in which it was found.
    where : str or int, optional
        The line, key, topic or offset inside ``file``.
    hint : str, optional
        What the user can do about it, as an imperative.
    """

    exit_status = 1

    def __init__(
        self,
        message: str,
        *,
        file: str | os.PathLike[str] | None = None,
        where: str | int | None = None,
        hint: str | None = None,
    ) -> None:
        self.message = message
        self.file = None if file is None else os.fspath(file)
        self.where = where
        self.hint = hint
        super().__init__(message)

    def __str__(self) -> str:
        text = self.message
        if self.file is not None:
            text += f" in {self.file}"
            if self.where is not None:
                text += f":{self.where}"
        return text


class InputError(LocatkError, ValueError):
    """Data that cannot be used: a bad number, a missing column, a repeated stamp."""


class FormatError(InputError):
    """A file that is not of the kind that was expected, or is damaged."""


class ArtifactError(InputError):
    """A TOML artifact with a missing, unknown or wrong key."""


class DegenerateError(LocatkError, ValueError):
    """The observations do not determine the answer; the message names what is missing."""


class OutputExistsError(LocatkError, FileExistsError):
    """The output exists and overwriting was not asked for."""


class MissingDataError(LocatkError, FileNotFoundError):
    """A file or folder that is not there."""


@contextmanager
def about(file: str | os.PathLike[str]) -> Iterator[None]:
    """Let an InputError name the file whose contents led to it."""
    try:
        yield
    except InputError as error:
        raise InputError(error.message, file=file, hint=error.hint) from None
