"""Input files that are read completely; system errors become errors of locatk."""

from __future__ import annotations

import os

from locatk.core.errors import FormatError, InputError, MissingDataError


def read_bytes(path: str | os.PathLike[str], max_bytes: int = -1) -> bytes:
    """Read the bytes of a file, or the first ``max_bytes`` of them.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It cannot be read.
    """
    try:
        with open(path, "rb") as stream:
            return stream.read(max_bytes)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from None


def read_text(path: str | os.PathLike[str]) -> str:
    """Read the text of a file.

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
