"""Search for sessions: paths, folders, patterns and URLs are expanded to files."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO

from locatk.core.errors import InputError, LocatkError, MissingDataError
from locatk.formats.pipeline.file_access import MAX_REQUESTS, remote
from locatk.formats.pipeline.file_names import absolute, is_url, is_web
from locatk.formats.sessions.mcap_file import SESSION_RECORD, DamageError
from locatk.formats.sessions.reader import Session, read_index

INDEX_BLOCK_BYTES = 1 << 16
"""Bytes fetched at a time when only the index of a remote session is read."""


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

    In contrast to :func:`.file_names.file_key`, a link with another file name is another file.
    """
    if is_url(location):
        return location
    folder, name = os.path.split(absolute(location))
    return os.path.join(os.path.realpath(folder), name)


def _expand(name: str) -> list[str] | None:
    """Return the files of a folder or a pattern; None if the name is that of one file."""
    if not name:
        raise InputError("a file name is empty", hint="Check the variables of the shell")
    if "\0" in name:
        raise InputError("a file name with a zero byte", file=name)
    if is_url(name):
        return _expand_url(name)
    if os.path.isdir(name):
        files = _matching_files(os.path.join(glob.escape(name), "*.mcap"))
        return _require_files(sorted(files), name, "no *.mcap in the folder")
    if os.path.exists(name):
        return None
    if glob.has_magic(name):
        return _require_files(sorted(_matching_files(name)), name, "no file matches the pattern")
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
