"""Origin of a solution, so that a batch can skip sessions that are already solved.

A solution depends only on the bytes of its session, on the options and artifacts of the request,
and on the version of locatk; it contains no time and no folder. These facts are in its metadata
record ``locatk``. Copying or touching a session does not change them.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from locatk.core.errors import LocatkError
from locatk.core.solution import Solution
from locatk.formats.files import read_bytes
from locatk.formats.output import tool_version
from locatk.formats.pipeline.systems import SolveRequest
from locatk.formats.sessions.reader import Session, open_mcap
from locatk.formats.sessions.solutions import read_solution

HASH_BLOCK_BYTES = 1 << 20
"""Bytes that are read and hashed at a time."""


def source_facts(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return name, size and SHA-256 of a session, the latter as by `sha256sum`.

    Raises
    ------
    LocatkError
        The file cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    with open_mcap(path) as stream:
        while block := stream.read(HASH_BLOCK_BYTES):
            digest.update(block)
            size += len(block)
    return {
        "source": Path(path).name,
        "source_bytes": str(size),
        "source_sha256": digest.hexdigest(),
    }


def options_digest(request: SolveRequest) -> str:
    """Return the SHA-256 of the options that are not None, and of the contents of their files.

    Raises
    ------
    LocatkError
        A file cannot be read.
    """

    def digest(value: Any) -> Any:
        if isinstance(value, Path):
            return hashlib.sha256(read_bytes(value)).hexdigest()
        # Results refer to one of several files by its name.
        if isinstance(value, tuple):
            return [(part.name, digest(part)) for part in value]
        return value

    values = {name: digest(value) for name, value in asdict(request).items() if value is not None}
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def command_line(session: str, request: SolveRequest) -> str:
    """Return the command that computes the same solution, with file names without folders.

    The same session and options then give the same bytes in every folder.
    """
    words = ["locatk", "solve", session]
    for name, value in asdict(request).items():
        if value is None:
            continue
        for part in value if isinstance(value, tuple) else (value,):
            words += [
                f"--{name.replace('_', '-')}",
                part.name if isinstance(part, Path) else str(part),
            ]
    return shlex.join(words)


def same_solution(path: str | os.PathLike[str], facts: Mapping[str, str]) -> Solution | None:
    """Read the solution at ``path`` if it is complete and has the same origin; otherwise None.

    Parameters
    ----------
    path : path
        A file that may be a solution.
    facts : mapping of str to str
        :func:`source_facts` and ``options_sha256``.
    """
    try:
        recorded = Session.open(path).facts
        expected = {**facts, "kind": "solution", "tool_version": tool_version()}
        if any(recorded.get(name) != value for name, value in expected.items()):
            return None
        return read_solution(path)
    except LocatkError:
        return None


def is_replaceable(path: str | os.PathLike[str], source: str) -> bool:
    """Return whether nothing is lost if ``path`` is computed again.

    That is an empty file, or a solution of a session named ``source``, outdated or truncated.
    """
    try:
        if os.path.getsize(path) == 0:
            return True
        facts = Session.open(path, damaged_ok=True).facts
    except (LocatkError, OSError):
        return False
    return facts.get("kind") == "solution" and facts.get("source") == source
