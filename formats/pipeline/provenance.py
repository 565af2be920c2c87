"""What a solution was made from, so that a batch knows what it need not make again.

A solution depends on the bytes of its session, on the options and artifacts that were given
aside, and on the version of locatk; nothing else goes into it, no time and no folder. These
facts are in its metadata record ``locatk``. Neither copying nor touching a session changes them.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from locatk.core.errors import LocatkError
from locatk.core.solution import Solution
from locatk.formats.files import read_bytes
from locatk.formats.output import tool_version
from locatk.formats.sessions.reader import Session, open_mcap
from locatk.formats.sessions.solutions import read_solution

_BLOCK = 1 << 20


def source_facts(path: str | os.PathLike[str]) -> dict[str, str]:
    """Name, size and SHA-256 of a session, which `sha256sum` gives as well.

    Raises
    ------
    LocatkError
        It cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    with open_mcap(path) as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
            size += len(block)
    return {
        "source": Path(path).name,
        "source_bytes": str(size),
        "source_sha256": digest.hexdigest(),
    }


def options_digest(options: Mapping[str, Any]) -> str:
    """SHA-256 of what was asked of a solver, of the content of files that were given.

    Parameters
    ----------
    options : mapping
        Values of JSON, and paths of files; options that are None do not count.

    Raises
    ------
    LocatkError
        A file cannot be read.
    """
    told = {
        name: hashlib.sha256(read_bytes(value)).hexdigest() if isinstance(value, Path) else value
        for name, value in options.items()
        if value is not None
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def same_solution(path: str | os.PathLike[str], facts: Mapping[str, str]) -> Solution | None:
    """The solution at ``path`` where it is whole and was made from the same; else None.

    Parameters
    ----------
    path : path
        What may be a solution.
    facts : mapping of str to str
        :func:`source_facts` and ``options_sha256``.
    """
    try:
        found = Session.open(path).facts
        wanted = {**facts, "kind": "solution", "tool_version": tool_version()}
        if any(found.get(name) != value for name, value in wanted.items()):
            return None
        return read_solution(path)
    except LocatkError:
        return None


def is_ours(path: str | os.PathLike[str], source: str) -> bool:
    """Whether ``path`` is a solution of a session named ``source``, outdated or cut as it may
    be, or an empty file: nothing is lost where it is made again."""
    try:
        if os.path.getsize(path) == 0:
            return True
        facts = Session.open(path, damaged_ok=True).facts
    except (LocatkError, OSError):
        return False
    return facts.get("kind") == "solution" and facts.get("source") == source
