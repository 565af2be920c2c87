"""Exceptions of locatk, with hints for the user.

::

    LocatkError
    +-- InputError          (ValueError)         unusable data
    |   +-- FormatError                          damaged file, or of an unexpected kind
    |   +-- ArtifactError                        TOML artifact with a wrong key or value
    +-- DegenerateError     (ValueError)         the observations do not determine the result
    +-- OutputExistsError   (FileExistsError)    the output exists, without --overwrite
    +-- MissingDataError    (FileNotFoundError)  missing file or folder

Each error is one line and, if possible, a hint. The command line prints both and exits with
:attr:`LocatkError.exit_status`; users of the library catch the class, or the builtin exception
from which it also derives.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager


class LocatkError(Exception):
    """Base class of all errors that locatk raises deliberately.

    Parameters
    ----------
    message : str
        The problem in one line, without a full stop.
    file : path, optional
        The file with the problem.
    where : str or int, optional
        The line, key, topic or offset inside ``file``.
    hint : str, optional
        The remedy, as an imperative.
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
        """Return file, position and message, as in ``run.csv:17: column 'x' is missing``."""
        if self.file is None:
            return self.message
        position = "" if self.where is None else f":{self.where}"
        return f"{self.file}{position}: {self.message}"


class InputError(LocatkError, ValueError):
    """Unusable data: a bad number, a missing column, a repeated stamp."""


class FormatError(InputError):
    """File that is damaged or not of the expected kind."""


class ArtifactError(InputError):
    """TOML artifact with a missing, unknown or wrong key."""


class DegenerateError(LocatkError, ValueError):
    """Observations that do not determine the result; the message names the missing ones."""


class OutputExistsError(LocatkError, FileExistsError):
    """Output that exists although overwriting was not requested."""


class MissingDataError(LocatkError, FileNotFoundError):
    """Missing file or folder."""


_SYSTEM_HINTS = {
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


def system_hint(error: BaseException | None) -> str | None:
    """Return the remedy of the error of the system or of the decoding that ``error`` is or follows.

    It is None if there is no such error, or no remedy is known.
    """
    while error is not None:
        if isinstance(error, UnicodeDecodeError):
            return "Check that it is the right file: text is expected"
        if isinstance(error, OSError) and error.errno is not None:
            return _SYSTEM_HINTS.get(error.errno)
        error = error.__cause__ or error.__context__
    return None


@contextmanager
def error_context(file: str | os.PathLike[str]) -> Iterator[None]:
    """Add the file whose contents are processed to every InputError raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(error.message, file=file, hint=error.hint) from None
