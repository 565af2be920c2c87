"""Output files: written completely or not at all, and never over another file by accident.

All writers of locatk (sessions, artifacts, tables, pictures) use :func:`atomic_write`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Literal

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError
from locatk.formats.locks import lock_file


def tool_version() -> str:
    """Return the version of the installed locatk, ``"0+unknown"`` if it is not installed."""
    try:
        return metadata.version("locatk")
    except metadata.PackageNotFoundError:
        return "0+unknown"


def check_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Check that ``path`` can be written, before a long computation.

    Raises
    ------
    OutputExistsError
        ``path`` exists and ``overwrite`` is false, or it is not a regular file.
    MissingDataError
        Its folder does not exist.
    """
    target = Path(path)
    if not os.path.isdir(target.parent):
        raise MissingDataError("no such folder", file=target.parent, hint="Create the folder first")
    # A device or a folder cannot be replaced by a file, not even with --overwrite.
    if os.path.exists(target) and not os.path.isfile(target):
        raise OutputExistsError("not a regular file", file=target, hint="Name a file, not a folder")
    if os.path.lexists(target) and not overwrite:
        raise output_exists_error(target)


@contextlib.contextmanager
def atomic_write(
    path: str | os.PathLike[str], *, overwrite: bool = False, mode: Literal["wb", "w"] = "wb"
) -> Iterator[IO[Any]]:
    """Open ``path`` for writing; it appears when the block ends without an exception.

    The data go to a hidden file in the same folder, which is synced to the disk and renamed at
    the end; an exception of any kind removes it. If the process is killed, the hidden file stays
    until the same output is written again.

    Parameters
    ----------
    path : path
        The output.
    overwrite : bool
        Replace an existing file. Otherwise even a file that another process creates in the
        meantime is kept.
    mode : {"wb", "w"}
        Bytes, or UTF-8 text with line ends as given.

    Raises
    ------
    OutputExistsError, MissingDataError
        As :func:`check_output`.
    LocatkError
        The system cannot write: no permission, no space.
    """
    check_output(path, overwrite=overwrite)
    target = Path(path)
    if os.path.islink(target):
        target = Path(os.path.realpath(target))  # replace what it points to, not the link
    remove_stale_parts(target)
    part = target.with_name(f"{_part_prefix(target)}{secrets.token_hex(4)}{PART_SUFFIX}")
    text: dict[str, Any] = {"encoding": "utf-8", "newline": ""} if mode == "w" else {}
    move = os.replace if overwrite else _move_to_free_name
    try:
        with _errors_of_locatk(target, part):
            with _open_part(part, mode, text) as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
                if os.name != "nt":  # While the lock is held: unlocked, it looks stale.
                    move(part, target)
            if os.name == "nt":  # An open file cannot be moved.
                move(part, target)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


PART_SUFFIX = ".part"
"""End of the name of an unfinished output."""


MAX_PART_NAME_BYTES = 200
"""Longer names of outputs are abbreviated in the name of a part; file systems allow 255."""


def _part_prefix(target: Path) -> str:
    """Return the beginning of the names of unfinished outputs for ``target`` and no other."""
    name = target.name
    encoded = os.fsencode(name)
    if len(encoded) > MAX_PART_NAME_BYTES:
        name = f"{name[:40]}-{hashlib.sha256(encoded).hexdigest()[:16]}"
    return f".{name}."


def _open_part(part: Path, mode: str, text: dict[str, Any]) -> IO[Any]:
    """Create and lock an unfinished output.

    In the instant between both, another process may take it for a stale one, and remove it.
    """
    while True:
        stream = open(part, mode.replace("w", "x"), **text)  # noqa: SIM115 - the caller closes it
        lock_file(stream.fileno(), wait=True)
        if os.name == "nt" or os.fstat(stream.fileno()).st_nlink:
            return stream
        stream.close()


def remove_stale_parts(target: Path) -> None:
    """Remove unfinished outputs for ``target`` of processes that were killed.

    Those of running processes are locked. On a file system without locks, all of them stay; on
    Windows, open files cannot be removed anyway.
    """
    pattern = re.compile(re.escape(_part_prefix(target)) + r"[0-9a-f]{8}" + re.escape(PART_SUFFIX))
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            if not (pattern.fullmatch(entry.name) and entry.is_file(follow_symlinks=False)):
                continue
            with contextlib.suppress(OSError), open(entry.path, "rb") as stream:
                if lock_file(stream.fileno()) or os.name == "nt":
                    os.unlink(entry.path)


def _move_to_free_name(part: Path, target: Path) -> None:
    """Rename ``part`` to ``target``, which must not exist; a plain rename would replace it."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise output_exists_error(target) from None
    except OSError:
        # The file system has no hard links (FAT, some network shares): reserve the name with an
        # empty file first, which is as safe except for a crash in between.
        try:
            open(target, "xb").close()
        except FileExistsError:
            raise output_exists_error(target) from None
        try:
            os.replace(part, target)
        except BaseException:
            target.unlink()
            raise
    else:
        part.unlink()


def output_exists_error(target: str | os.PathLike[str]) -> OutputExistsError:
    """Return the error for an output that exists and must not be replaced."""
    return OutputExistsError(
        "output exists", file=target, hint="Add --overwrite or choose another name"
    )


@contextlib.contextmanager
def _errors_of_locatk(target: Path, part: Path) -> Iterator[None]:
    """Convert system errors of the output to LocatkError.

    Errors of other files pass: the block inside :func:`atomic_write` may read some.
    """
    try:
        yield
    except LocatkError:
        raise
    except OSError as error:
        if error.filename not in (None, str(target), str(part)):
            raise
        raise LocatkError(f"cannot write: {error.strerror or error}", file=target) from error
