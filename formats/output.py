"""Files that are written whole or not at all, and never over another unasked.

Every writer of locatk (sessions, artifacts, tables, pictures) goes through
:func:`atomic_write`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Literal

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError


def tool_version() -> str:
    """Version of the installed locatk, ``"0+unknown"`` in a bare source tree."""
    try:
        return metadata.version("locatk")
    except metadata.PackageNotFoundError:
        return "0+unknown"


def check_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise what :func:`atomic_write` would raise before it starts.

    For commands that compute for long before they write.

    Raises
    ------
    OutputExistsError
        ``path`` exists and ``overwrite`` is false, or is no regular file.
    MissingDataError
        Its folder does not exist.
    """
    target = Path(path)
    if not os.path.isdir(target.parent):
        raise MissingDataError(
            f"no folder {str(target.parent)!r} to write into", hint="Make the folder first"
        )
    # A device or a folder cannot be replaced by a file, not even when asked.
    if os.path.exists(target) and not os.path.isfile(target):
        raise OutputExistsError(f"output {str(target)!r} is not a regular file")
    if os.path.lexists(target) and not overwrite:
        raise _exists(target)


@contextlib.contextmanager
def atomic_write(
    path: str | os.PathLike[str], *, overwrite: bool = False, mode: Literal["wb", "w"] = "wb"
) -> Iterator[IO[Any]]:
    """Open ``path`` for writing; it appears when the block ends without an exception.

    What is written goes to a hidden file beside ``path``, is forced to the disk and
    moved into place at the end; an exception of any kind removes it.

    Parameters
    ----------
    path : path
        The output.
    overwrite : bool
        Replace what is there. Otherwise not even a file that another process puts
        there in the meantime is touched.
    mode : {"wb", "w"}
        Bytes, or UTF-8 text whose line ends are written as given.

    Raises
    ------
    OutputExistsError, MissingDataError
        As :func:`check_output`.
    LocatkError
        The system refuses to write: no permission, no space.
    """
    check_output(path, overwrite=overwrite)
    target = Path(path)
    if os.path.islink(target):
        target = Path(os.path.realpath(target))  # replace what it points to, not the link
    part = target.with_name(f".{target.name[:50]}.{secrets.token_hex(4)}.part")
    text: dict[str, Any] = {"encoding": "utf-8", "newline": ""} if mode == "w" else {}
    try:
        with _one_line_errors(target, part):
            with open(part, mode.replace("w", "x"), **text) as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            if overwrite:
                os.replace(part, target)
            else:
                _move_to_free_name(part, target)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def _move_to_free_name(part: Path, target: Path) -> None:
    """Rename ``part`` to ``target``, which must not exist: a plain rename would replace it."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise _exists(target) from None
    except OSError:
        # No hard links on this file system (FAT, some network shares): take the
        # name with an empty file first, which is as safe but for a crash in between.
        try:
            open(target, "xb").close()
        except FileExistsError:
            raise _exists(target) from None
        try:
            os.replace(part, target)
        except BaseException:
            target.unlink()
            raise
    else:
        part.unlink()


def _exists(target: Path) -> OutputExistsError:
    return OutputExistsError(
        f"output {str(target)!r} exists", hint="Add --overwrite or choose another name"
    )


@contextlib.contextmanager
def _one_line_errors(target: Path, part: Path) -> Iterator[None]:
    """Turn the system's refusal to write into an error of one line.

    Errors of locatk pass, and so do those that name another file: the block inside
    :func:`atomic_write` may read some.
    """
    try:
        yield
    except LocatkError:
        raise
    except OSError as error:
        if error.filename not in (None, str(target), str(part)):
            raise
        raise LocatkError(f"cannot write: {error.strerror or error}", file=target) from error
