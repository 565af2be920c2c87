"""Locations of sessions and solutions: local paths, and URLs of object stores through fsspec.

A URL is fetched to a temporary file of the same name and written back as a whole, so that readers
and writers only handle files. fsspec (extra ``locatk[s3]``) is imported when a URL is used.
"""

from __future__ import annotations

import contextlib
import glob
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from locatk.core.errors import (
    InputError,
    LocatkError,
    MissingDataError,
)
from locatk.formats.output import check_output, output_exists_error
from locatk.formats.sessions.mcap_file import SESSION_RECORD, DamageError
from locatk.formats.sessions.reader import Session, read_index

OBJECT_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss")
"""Protocols of object stores, in which an object appears completely or not at all."""

MAX_REQUESTS = 16
"""Files inspected at a time; the time passes in waiting for disks and object stores."""

INDEX_BLOCK_BYTES = 1 << 16
"""Bytes fetched at a time when only the index of a remote session is read."""

MAX_REASON_CHARACTERS = 200
"""Length of the part of a message that comes from another library."""

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)

_PARTIAL_SUFFIX = ".part"


# ---- names


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


# ---- sessions that paths, folders, patterns and URLs name


@dataclass(frozen=True)
class FoundSessions:
    """Sessions, each once, in the order in which they were named.

    Attributes
    ----------
    sessions : tuple of str
        Locations.
    skipped_solutions : tuple of str
        Solutions in the same folders.
    has_folder : bool
        A folder or a pattern was among the names, even if it has a single session.
    """

    sessions: tuple[str, ...]
    skipped_solutions: tuple[str, ...]
    has_folder: bool


def find_sessions(
    names: Sequence[str], output_of: Callable[[str], str] | None = None
) -> FoundSessions:
    """Expand paths, folders, patterns and URLs to sessions.

    A folder stands for its `*.mcap` files, sorted, without subfolders; a pattern for its matches,
    with `**` for any depth. Solutions among these files are skipped.

    Parameters
    ----------
    names : sequence of str
        Paths, patterns of the shell, URLs.
    output_of : callable, optional
        Location of the solution of a session. A solution at such a location is skipped even if it
        was named itself, because shells expand patterns.

    Raises
    ------
    MissingDataError
        A name has no file, or a folder has no session.
    InputError
        An object store does not respond.
    """
    named: dict[str, str] = {}
    possible_solutions: dict[str, str] = {}
    has_folder = False
    for name in names:
        expanded = _expand(name)
        has_folder = has_folder or expanded is not None
        for location in [name] if expanded is None else expanded:
            key = _link_key(location)
            if key not in named:
                named[key] = location
                if expanded is not None:
                    possible_solutions[key] = location
    if output_of is not None:
        outputs = {_link_key(output_of(location)) for location in named.values()}
        possible_solutions |= {key: named[key] for key in named if key in outputs}
    with ThreadPoolExecutor(MAX_REQUESTS) as threads:
        records = zip(
            possible_solutions, threads.map(read_facts, possible_solutions.values()), strict=True
        )
        skipped = {key for key, facts in records if facts.get("kind") == "solution"}
    sessions = tuple(location for key, location in named.items() if key not in skipped)
    if not sessions:
        raise MissingDataError(
            "only solutions were found", file=names[0], hint="Name the sessions they came from"
        )
    return FoundSessions(sessions, tuple(named[key] for key in named if key in skipped), has_folder)


def _link_key(location: str) -> str:
    """Return a value that is equal for one file in a folder with several paths.

    In contrast to :func:`file_key`, a link with another file name is another file.
    """
    if is_url(location):
        return location
    folder, name = os.path.split(absolute(location))
    return os.path.join(os.path.realpath(folder), name)


def _expand(name: str) -> list[str] | None:
    """Return the files of a folder or a pattern; None if the name is that of one file."""
    if is_url(name):
        return _expand_url(name)
    if os.path.isdir(name):
        files = _matching_files(os.path.join(glob.escape(name), "*.mcap"))
        return _require_files(sorted(files), name, "no *.mcap in the folder")
    if os.path.exists(name):
        return None
    if glob.has_magic(name):
        return _require_files(sorted(_matching_files(name)), name, "no file matches the pattern")
    if not name:
        raise InputError("a file name is empty", hint="Check the variables of the shell")
    raise MissingDataError(
        "No such file or folder", file=name, hint="Check the spelling of the path"
    )


def _matching_files(pattern: str) -> list[str]:
    """Return the matches of a pattern, without folders: one may be called `old.mcap`.

    As in shells, `**` does not follow links to folders, which may form a circle.
    """
    parts = pattern.replace(os.sep, "/").split("/")
    if "**" not in parts:
        return [path for path in glob.glob(pattern) if not os.path.isdir(path)]
    depth = parts.index("**")
    below = "/".join(parts[depth + 1 :]) or "*"
    files: list[str] = []
    for top in glob.glob("/".join([*parts[:depth], ""])) if depth else [""]:
        for folder, subfolders, _ in os.walk(top or os.curdir):
            subfolders[:] = [name for name in subfolders if not name.startswith(".")]
            start = os.path.relpath(folder) if not top else folder
            prefix = "" if start == "." else glob.escape(start)
            files += _matching_files(os.path.join(prefix, below))
    return files


def _expand_url(url: str) -> list[str] | None:
    if is_web(url):
        return None
    with remote(url) as (store, key):
        store.invalidate_cache()
        is_pattern = glob.has_magic(url)
        if not url.endswith("/") and not is_pattern:
            if store.isfile(key):
                return None
            if not store.isdir(key):
                raise FileNotFoundError(url)
        pattern = key if is_pattern else f"{key.rstrip('/')}/*.mcap"
        files = [str(store.unstrip_protocol(path)) for path in store.glob(pattern)]
    problem = "no file matches the pattern" if is_pattern else "no *.mcap in the folder"
    return _require_files(sorted(files), url, problem)


def _require_files(files: list[str], name: str, problem: str) -> list[str]:
    if not files:
        hint = "Check the spelling, and that there are sessions"
        raise MissingDataError(problem, file=name, hint=hint)
    return files


def read_facts(location: str) -> dict[str, str]:
    """Read the metadata record ``locatk`` of an MCAP file; empty if it cannot be read.

    Only both ends of a remote file are fetched.
    """
    try:
        if not is_url(location):
            return Session.open(location).facts
        with remote(location) as (store, key):
            stream: IO[bytes]
            with store.open(
                key, "rb", cache_type="readahead", block_size=INDEX_BLOCK_BYTES
            ) as stream:
                return dict(read_index(stream).metadata.get(SESSION_RECORD, {}))
    except (LocatkError, DamageError):
        return {}


# ---- reading and writing


@contextlib.contextmanager
def local(location: str, scratch: str | None = None) -> Iterator[Path]:
    """Provide a local file: the file itself, or a copy of the URL while the block runs.

    Parameters
    ----------
    location : str
        Path or URL.
    scratch : str, optional
        Folder for the copy; the temporary folder of the system by default.

    Raises
    ------
    MissingDataError, InputError
        See :func:`remote`.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory(prefix="locatk-", dir=scratch) as folder:
        path = Path(folder) / file_name(location)
        with remote(location) as (store, key):
            store.get_file(key, str(path))
        yield path


@contextlib.contextmanager
def writing(
    location: str, scratch: str | None = None, *, overwrite: bool = False
) -> Iterator[Path]:
    """Provide a local file to write: the file itself, or one that is uploaded after the block.

    Raises
    ------
    OutputExistsError, InputError
        See :func:`upload`.
    """
    if not is_url(location):
        yield Path(location)
        return
    with tempfile.TemporaryDirectory(prefix="locatk-", dir=scratch) as folder:
        path = Path(folder) / file_name(location)
        yield path
        upload(path, location, overwrite=overwrite)


def upload(path: Path, url: str, *, overwrite: bool = False) -> None:
    """Write a file to a URL, where it appears completely or not at all.

    Raises
    ------
    OutputExistsError
        There is an object already and ``overwrite`` is false.
    InputError
        The store refuses it.
    """
    with remote(url) as (store, key):
        check_writable(url, overwrite=overwrite)
        if url.partition("://")[0].lower() in OBJECT_STORES:
            store.put_file(str(path), key)
            return
        folder, _, name = key.rpartition("/")
        store.makedirs(folder, exist_ok=True)
        partial = f"{folder}/.{name[:50]}.{secrets.token_hex(4)}{_PARTIAL_SUFFIX}"
        try:
            store.put_file(str(path), partial)
            store.mv(partial, key)
        except BaseException:
            with contextlib.suppress(Exception):
                store.rm_file(partial)
            raise


def exists(location: str) -> bool:
    """Return whether there is a file or an object at a location."""
    if not is_url(location):
        return os.path.lexists(location)
    with remote(location) as (store, key):
        store.invalidate_cache()
        return bool(store.exists(key))


def check_writable(location: str, *, overwrite: bool) -> None:
    """Refuse an output that must not be written.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.check_output`.
    InputError
        The output is on the web.
    """
    if not is_url(location):
        check_output(location, overwrite=overwrite)
    elif is_web(location):
        raise InputError(
            "a web address cannot be written", file=location, hint="Name a file or folder with -o"
        )
    elif not overwrite and exists(location):
        raise output_exists_error(location)


def check_bucket(location: str) -> None:
    """Refuse an output in a missing S3 bucket, before the sessions are solved.

    Raises
    ------
    MissingDataError
        The server has no such bucket.
    """
    if not location.lower().startswith(("s3://", "s3a://")):
        return
    with remote(location) as (store, key):
        bucket = key.partition("/")[0]
        try:
            store.call_s3("head_bucket", Bucket=bucket)
        except PermissionError:
            pass  # The user may write into a bucket without permission to inspect it.
        except FileNotFoundError:
            raise MissingDataError(
                f"no such bucket {bucket!r}",
                file=location,
                hint="Create it, or check the spelling",
            ) from None


@contextlib.contextmanager
def remote(url: str) -> Iterator[tuple[Any, str]]:
    """Provide the file system and the key of a URL; its failures become errors of one line.

    Raises
    ------
    LocatkError
        fsspec, or the package that it needs for this protocol, is not installed.
    MissingDataError
        There is no such object.
    InputError
        The server does not respond, access is refused, or the protocol is unknown.
    """
    protocol = url.partition("://")[0]
    hint = "Check the URL, and that its server runs"
    if protocol.lower() in OBJECT_STORES:
        hint = "Check the credentials, and AWS_ENDPOINT_URL of a store that is not Amazon's"
    try:
        import fsspec  # Optional, and slow to import.

        store, key = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise LocatkError(
            f"cannot be read or written ({short_reason(error)})",
            file=url,
            hint='Install it: pip install "locatk[s3]"',
        ) from None
    except ValueError as error:
        raise InputError(short_reason(error), file=url, hint=hint) from None
    except Exception as error:  # Some stores connect at once.
        raise _access_error(error, url, hint) from error
    try:
        yield store, key
    except (LocatkError, DamageError):
        raise
    except FileNotFoundError:
        raise MissingDataError(
            "No such object", file=url, hint="Check the spelling of the URL"
        ) from None
    except PermissionError as error:
        raise InputError(
            f"access refused ({short_reason(error)})", file=url, hint="Check your credentials"
        ) from None
    except Exception as error:  # Each store has its own exceptions.
        raise _access_error(error, url, hint) from error


def _access_error(error: Exception, url: str, hint: str) -> InputError:
    message = f"cannot be read or written ({short_reason(error)})"
    return InputError(message, file=url, hint=hint)


def short_reason(error: BaseException) -> str:
    """Return the message of another library on one line of limited length."""
    return " ".join(str(error).split())[:MAX_REASON_CHARACTERS] or type(error).__name__


def remove_partial_files(location: str) -> None:
    """Remove the unfinished output that a killed process left for ``location``."""
    if is_url(location):
        return
    target = Path(os.path.realpath(location))
    prefix = f".{target.name[:50]}."  # As locatk.formats.output names temporary files.
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            if entry.name.startswith(prefix) and entry.name.endswith(_PARTIAL_SUFFIX):
                os.unlink(entry.path)
