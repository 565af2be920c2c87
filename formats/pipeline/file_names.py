"""Names of files: local paths, and URLs of object stores and of the web."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path, PurePosixPath

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)


def is_url(location: str) -> bool:
    """Return whether a location is a URL, as ``s3://bucket/run.mcap``, and not a path."""
    return _URL.match(location) is not None


def is_web(location: str) -> bool:
    """Return whether a location is a URL of the web, which has neither folders nor patterns."""
    return location.lower().startswith(("http://", "https://"))


def is_utf8(location: str) -> bool:
    """Return whether a file name can be stored and printed; Linux permits any bytes."""
    try:
        location.encode()
    except UnicodeEncodeError:
        return False
    return True


def absolute(location: str) -> str:
    """Return the location for processes that have another working folder."""
    return location if is_url(location) else os.path.abspath(location)


def file_name(location: str) -> str:
    """Return the last part of a location, without the query of a web address."""
    if is_url(location):
        return PurePosixPath(location.partition("?")[0] if is_web(location) else location).name
    return Path(location).name


def stem(location: str) -> str:
    """Return the file name without its suffix."""
    return Path(file_name(location)).stem


def sibling(location: str, name: str) -> str:
    """Return the location of the file ``name`` in the folder of ``location``."""
    if is_url(location):
        return f"{location.rpartition('/')[0]}/{name}"
    return str(Path(location).with_name(name))


def within(folder: str, name: str) -> str:
    """Return the location of the file ``name`` in ``folder``."""
    return f"{folder.rstrip('/')}/{name}" if is_url(folder) else str(Path(folder) / name)


def file_key(location: str) -> tuple[int, int] | str:
    """Return a value that is equal for all names of one file."""
    if not is_url(location):
        with contextlib.suppress(OSError):
            status = Path(location).stat()
            return status.st_dev, status.st_ino
    return absolute(location)
