"""Files that are read whole: what goes wrong is an error of one line."""

from __future__ import annotations

import os

from locatk.core.errors import FormatError, InputError, MissingDataError


def read_bytes(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """The bytes of a file, or the first ``most`` of them.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It cannot be read.
    """
    try:
        with open(path, "rb") as stream:
            return stream.read(most)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from None


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a file.

    Raises
    ------
    MissingDataError, InputError
        As :func:`read_bytes`.
    FormatError
        It is not UTF-8.
    """
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise FormatError("not UTF-8 text", file=path) from None
