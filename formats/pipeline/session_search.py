"""Search for sessions: paths, folders, patterns and URLs are expanded to files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO

from locatk.core.errors import LocatkError, MissingDataError
from locatk.formats.pipeline.file_access import MAX_REQUESTS, remote
from locatk.formats.pipeline.file_names import absolute, is_url
from locatk.formats.pipeline.file_search import expand_name
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

    See :func:`.file_search.expand_name`. Solutions in folders and patterns are skipped.

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
        expanded = expand_name(name)
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
