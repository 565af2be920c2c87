"""Places of sessions and solutions: local paths, and URLs of object stores through fsspec.

A URL is fetched to a temporary file of the same name and put back as a whole, so that
readers and writers only ever see files. fsspec (extra ``locatk[s3]``) is imported when a URL is
met.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any

from locatk.core.errors import (
    FormatError,
    InputError,
    LocatkError,
    MissingDataError,
    OutputExistsError,
)
from locatk.formats.output import check_output
from locatk.formats.sessions.mcap_file import SESSION_RECORD, DamageError
from locatk.formats.sessions.reader import Session, read_index

STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss")
"""Protocols of object stores, where an object appears whole or not at all."""

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)

_PART = ".part"


def is_url(place: str) -> bool:
    """Whether ``place`` is a URL, ``s3://bucket/run.mcap``, and not a path."""
    return _URL.match(place) is not None


def is_text(place: str) -> bool:
    """Whether solutions and terminals can tell ``place``: names of files may hold any bytes."""
    try:
        place.encode()
    except UnicodeEncodeError:
        return False
    return True


def absolute(place: str) -> str:
    """``place`` for processes that have another working folder."""
    return place if is_url(place) else os.path.abspath(place)


def name_of(place: str) -> str:
    """Its last part, without what a web server is asked beside."""
    if is_url(place):
        return PurePosixPath(place.partition("?")[0] if is_web(place) else place).name
    return Path(place).name


def is_web(place: str) -> bool:
    """Whether ``place`` is a URL of the web, which knows no folders and no patterns."""
    return place.lower().startswith(("http://", "https://"))


def beside(place: str, name: str) -> str:
    """The place called ``name`` in the folder of ``place``."""
    if is_url(place):
        return f"{place.rpartition('/')[0]}/{name}"
    return str(Path(place).with_name(name))


def within(folder: str, name: str) -> str:
    """The place called ``name`` in ``folder``."""
    return f"{folder.rstrip('/')}/{name}" if is_url(folder) else str(Path(folder) / name)


@contextlib.contextmanager
def local(place: str, scratch: str | None = None) -> Iterator[Path]:
    """``place`` as a local file: itself, or a copy of the URL while the block runs.

    Parameters
    ----------
    place : str
        Path or URL.
    scratch : str, optional
        Folder for the copy; the system's temporary folder by default.

    Raises
    ------
    MissingDataError, InputError
        There is nothing at the URL, or it cannot be fetched; they name the URL.
    """
    if not is_url(place):
        yield Path(place)
        return
    with tempfile.TemporaryDirectory(prefix="locatk-", dir=scratch) as folder:
        path = Path(folder) / name_of(place)
        with remote(place) as (store, key):
            store.get_file(key, str(path))
        yield path


@contextlib.contextmanager
def writing(place: str, scratch: str | None = None, *, overwrite: bool = False) -> Iterator[Path]:
    """``place`` as a local file to write: itself, or one that is brought to the URL afterwards.

    Raises
    ------
    OutputExistsError, InputError
        As :func:`put`.
    """
    if not is_url(place):
        yield Path(place)
        return
    with tempfile.TemporaryDirectory(prefix="locatk-", dir=scratch) as folder:
        path = Path(folder) / name_of(place)
        yield path
        put(path, place, overwrite=overwrite)


def put(path: Path, place: str, *, overwrite: bool = False) -> None:
    """Bring a file to a URL, where it appears as a whole.

    Raises
    ------
    OutputExistsError
        There is something already and ``overwrite`` is false.
    InputError
        The store refuses it.
    """
    with remote(place) as (store, key):
        check(place, overwrite=overwrite)
        if place.partition("://")[0].lower() in STORES:
            store.put_file(str(path), key)
            return
        folder, _, name = key.rpartition("/")
        store.makedirs(folder, exist_ok=True)
        part = f"{folder}/.{name[:50]}.{secrets.token_hex(4)}{_PART}"
        try:
            store.put_file(str(path), part)
            store.mv(part, key)
        except BaseException:
            with contextlib.suppress(Exception):
                store.rm_file(part)
            raise


def exists(place: str) -> bool:
    """Whether there is something at ``place``."""
    if not is_url(place):
        return os.path.lexists(place)
    with remote(place) as (store, key):
        store.invalidate_cache()
        return bool(store.exists(key))


def check(place: str, *, overwrite: bool) -> None:
    """Refuse an output that must not be written, as
    :func:`locatk.formats.output.check_output`."""
    if not is_url(place):
        check_output(place, overwrite=overwrite)
    elif is_web(place):
        raise InputError(
            "nothing is written to the web", file=place, hint="Name a file or a folder with -o"
        )
    elif not overwrite and exists(place):
        raise OutputExistsError(
            f"output {place!r} exists", hint="Add --overwrite or choose another name"
        )


def check_bucket(place: str) -> None:
    """Refuse an output in a bucket that is not there, before the work is done for nothing.

    Raises
    ------
    MissingDataError
        The server knows no such bucket.
    """
    if not place.lower().startswith(("s3://", "s3a://")):
        return
    with remote(place) as (store, key):
        bucket = key.partition("/")[0]
        try:
            store.call_s3("head_bucket", Bucket=bucket)
        except PermissionError:
            pass  # one may be let write into it all the same
        except FileNotFoundError:
            raise MissingDataError(
                f"no bucket {bucket!r} to write into", hint="Make it first, or check the spelling"
            ) from None


def facts_of(place: str) -> dict[str, str]:
    """The metadata record ``locatk`` of an MCAP file; empty where it cannot be read.

    Of a URL only the ends are fetched.
    """
    try:
        if not is_url(place):
            return Session.open(place).facts
        with remote(place) as (store, key):
            stream: IO[bytes]
            with store.open(key, "rb", cache_type="readahead", block_size=1 << 16) as stream:
                return dict(read_index(stream).metadata.get(SESSION_RECORD, {}))
    except (LocatkError, DamageError):
        return {}


@contextlib.contextmanager
def remote(place: str) -> Iterator[tuple[Any, str]]:
    """File system and key of a URL; what goes wrong with it is an error of one line.

    Raises
    ------
    LocatkError
        fsspec, or what it needs for this kind of URL, is not installed.
    MissingDataError
        There is no such object.
    InputError
        Nobody answers, access is refused, or the kind of URL is unknown.
    """
    kind = place.partition("://")[0]
    hint = "Check the URL, and that its server is there"
    if kind.lower() in STORES:
        hint = "Check the credentials, and AWS_ENDPOINT_URL where it is not Amazon's"
    try:
        import fsspec

        store, key = fsspec.core.url_to_fs(place)
    except ImportError as error:
        raise LocatkError(
            f"{kind}:// cannot be read: {_short(error)}",
            hint='Install it: pip install "locatk[s3]"',
        ) from None
    except ValueError as error:
        raise FormatError(_short(error), file=place) from None
    except Exception as error:  # some connect at once
        raise InputError(
            f"cannot be read or written ({_short(error)})", file=place, hint=hint
        ) from error
    try:
        yield store, key
    except (LocatkError, DamageError):
        raise
    except FileNotFoundError:
        raise MissingDataError(
            "No such object", file=place, hint="Check the spelling of the URL"
        ) from None
    except PermissionError as error:
        raise InputError(
            f"access refused ({_short(error)})", file=place, hint="Check your credentials"
        ) from None
    except Exception as error:  # each store has exceptions of its own
        raise InputError(
            f"cannot be read or written ({_short(error)})", file=place, hint=hint
        ) from error


def remove_parts(place: str) -> None:
    """Remove what a process that was killed left of its output at ``place``."""
    if is_url(place):
        return
    target = Path(os.path.realpath(place))
    start = f".{target.name[:50]}."  # as locatk.formats.output names them
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            if entry.name.startswith(start) and entry.name.endswith(_PART):
                os.unlink(entry.path)


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
