"""Reading and writing of files by path, or by URL of an object store through fsspec.

A URL is fetched to a temporary file of the same name and written back as a whole, so that readers
and writers only handle files. fsspec (extra ``locatk[s3]``) is imported when a URL is used.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError, LocatkError, MissingDataError
from locatk.formats.extras import requires_extra
from locatk.formats.output import PART_SUFFIX, check_output, output_exists_error, remove_stale_parts
from locatk.formats.pipeline.file_names import file_name, is_url, is_web
from locatk.formats.sessions.mcap_file import DamageError

S3_PROTOCOLS = ("s3", "s3a")

OBJECT_STORES = (*S3_PROTOCOLS, "gs", "gcs", "az", "abfs", "abfss", "oss")
"""Protocols of object stores, in which an object appears completely or not at all."""

MAX_REQUESTS = 16
"""Files inspected at a time; the time passes in waiting for disks and object stores."""

MAX_REASON_CHARACTERS = 200
"""Length of the part of a message that comes from another library."""


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
        partial = f"{folder}/.{name[:50]}.{secrets.token_hex(4)}{PART_SUFFIX}"
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
        fsspec, or s3fs for S3, is not installed.
    MissingDataError
        There is no such object.
    InputError
        The server does not respond, access is refused, the protocol is unknown, or another package
        that it needs is not installed.
    """
    protocol = url.partition("://")[0]
    hint = "Check the URL, and that its server runs"
    if protocol.lower() in OBJECT_STORES:
        hint = "Check the credentials, and AWS_ENDPOINT_URL of a store that is not Amazon's"
    with requires_extra("s3", "a URL", file=url):
        import fsspec  # slow to import

        if protocol.lower() in S3_PROTOCOLS:
            import s3fs  # noqa: F401
    try:
        store, key = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise InputError(
            f"{protocol}:// needs another package ({short_reason(error)})",
            file=url,
            hint="Install that package with pip",
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
    remove_stale_parts(Path(os.path.realpath(location)))
