"""Input files: only regular ones, read to a limit; system errors become errors of locatk.

All readers of locatk open files here, or call :func:`check_regular` before a library opens them.
A device such as ``/dev/zero`` never ends, opening a pipe blocks until another program writes to
it, and neither can be read twice, which most readers do. ``/dev/stdin`` is accepted if it is a
regular file (``< run.csv``), but not if it is a pipe or a process substitution.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from locatk.core.errors import FormatError, InputError, LocatkError, MissingDataError

MAX_FILE_BYTES = 512 << 20
"""Largest file that is read completely [bytes], unless its reader states another limit.

A scan of an A0 sheet has 100 MB, a table of a million poses 158 MB.
"""

MIN_READ_BYTES = 1 << 20
"""Memory that is allocated for the rest of a file of unknown size [bytes]."""

MAX_TEXT_BYTES = 32 << 20
"""Largest configuration, artifact or map that is read as text [bytes].

A map of 100,000 landmarks as built has 7 MB, for which ``tomllib`` takes 3 s.
"""


def check_regular(path: str | os.PathLike[str]) -> int:
    """Refuse a path that is not a regular file, or a link to one, and return its size in bytes.

    Raises
    ------
    MissingDataError
        There is no such file.
    FormatError
        It is a folder, a device, a pipe or a socket.
    InputError
        It cannot be inspected, or its name is not possible.
    """
    try:
        with _errors_of_locatk(path):
            status = os.stat(path)
    except ValueError as error:
        if isinstance(error, LocatkError):
            raise
        message = "a file name with a zero byte or an unpaired surrogate"
        raise InputError(message, file=repr(path)) from None
    if stat.S_ISDIR(status.st_mode):
        raise FormatError("a folder instead of a file", file=path, hint="Name a file in it")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(
            "not a regular file",
            file=path,
            hint=f"This is {_kind_of(status.st_mode)}: copy its data into a file first",
        )
    return status.st_size


def split_selection(path: Path) -> tuple[Path, str]:
    """Split ``FILE#NAME`` into a file and the name of a trajectory in it.

    The name is empty if ``path`` has none, exists itself, or no such file exists.
    """
    text = path.as_posix()
    if "#" in text and not os.path.exists(path):
        for k, letter in enumerate(text):
            if letter == "#" and text[:k] and os.path.exists(text[:k]):
                return Path(text[:k]), text[k + 1 :]
    return path, ""


def _kind_of(mode: int) -> str:
    if stat.S_ISFIFO(mode):
        return "a pipe"
    return "a socket" if stat.S_ISSOCK(mode) else "a device"


@contextmanager
def _errors_of_locatk(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert system errors to errors of locatk that name the file."""
    try:
        yield
    except LocatkError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise MissingDataError("no such file", file=path, hint="Check the path") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", file=path) from error


@contextmanager
def open_binary(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a regular file for reading; system errors in the block become errors of locatk.

    Raises
    ------
    MissingDataError, FormatError
        As :func:`check_regular`.
    InputError
        It cannot be read.
    """
    check_regular(path)
    with _errors_of_locatk(path), open(path, "rb") as stream:
        yield stream


def read_head(path: str | os.PathLike[str], count: int) -> bytes:
    """Read the first ``count`` bytes of a file, fewer if it is shorter; raises as `open_binary`."""
    with open_binary(path) as stream:
        return stream.read(count)


def read_bytes(path: str | os.PathLike[str], max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read the bytes of a file.

    Raises
    ------
    MissingDataError, InputError
        As :func:`open_binary`.
    FormatError
        It is not a regular file, or has more than ``max_bytes``.
    """
    with open_binary(path) as stream:
        # The size is compared before memory is allocated, and again because a file can grow.
        size = os.fstat(stream.fileno()).st_size
        data = stream.read(size + 1) if size <= max_bytes else b""
        while len(data) > size:  # It grows, or the system does not know its size.
            size = len(data)
            data += stream.read(min(max_bytes - size, max(size, MIN_READ_BYTES)) + 1)
    if max(size, len(data)) > max_bytes:
        raise FormatError(
            f"{max(size, len(data)):,} bytes, more than the limit of {max_bytes:,}",
            file=path,
            hint="Check that it is the right file, or split it",
        )
    return data


def read_text(path: str | os.PathLike[str], max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read the text of a file, without a byte order mark.

    Raises
    ------
    MissingDataError, InputError
        As :func:`read_bytes`.
    FormatError
        It is too large, or not UTF-8; ``where`` is the line.
    """
    data = read_bytes(path, max_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(
            "not UTF-8 text", file=path, where=line, hint="Save it as UTF-8"
        ) from error
