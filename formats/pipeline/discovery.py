"""The sessions that files, folders, patterns and URLs name."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from locatk.core.errors import InputError, MissingDataError
from locatk.formats.pipeline import locations as places

AT_ONCE = 16
"""Files that are looked into at a time: the time goes into waiting for disks and stores."""


@dataclass(frozen=True)
class Found:
    """Sessions, each once, in the order in which they were named.

    ``many`` says that a folder or a pattern was among the names, however few it held;
    ``passed_over`` holds the solutions that were found beside sessions.
    """

    sessions: tuple[str, ...]
    passed_over: tuple[str, ...]
    many: bool


def find_sessions(names: Sequence[str], solved: Callable[[str], str] | None = None) -> Found:
    """Expand what a user named.

    A folder stands for the `*.mcap` in it, sorted, not of its folders; a pattern for what
    it matches, with `**` for any depth. Solutions among what was found so are passed over.

    Parameters
    ----------
    names : sequence of str
        Paths, patterns of the shell, URLs.
    solved : callable, optional
        Place of the solution of a session. A solution at such a place is passed over
        where a name brings it in, too: shells expand patterns themselves.

    Raises
    ------
    MissingDataError
        There is nothing of a name, or a folder holds no session.
    InputError
        A store does not answer.
    """
    named: dict[str, str] = {}
    doubtful: dict[str, str] = {}
    many = False
    for name in names:
        several = _expanded(name)
        many = many or several is not None
        for place in [name] if several is None else several:
            key = _identity(place)
            if key not in named:
                named[key] = place
                if several is not None:
                    doubtful[key] = place
    if solved is not None:
        outputs = {_identity(solved(place)) for place in named.values()}
        doubtful |= {key: place for key, place in named.items() if key in outputs}
    with ThreadPoolExecutor(AT_ONCE) as threads:
        facts = dict(zip(doubtful, threads.map(places.facts_of, doubtful.values()), strict=True))
    passed = {key for key, told in facts.items() if told.get("kind") == "solution"}
    sessions = tuple(place for key, place in named.items() if key not in passed)
    if not sessions:
        raise MissingDataError(
            "nothing but solutions", file=names[0], hint="Name the sessions they came from"
        )
    return Found(sessions, tuple(named[key] for key in named if key in passed), many)


def _identity(place: str) -> str:
    """Equal for one file behind two paths; a link that gives it another name is another."""
    if places.is_url(place):
        return place
    folder, name = os.path.split(places.absolute(place))
    return os.path.join(os.path.realpath(folder), name)


def _expanded(name: str) -> list[str] | None:
    """What a folder or a pattern stands for; None where it names one file."""
    if places.is_url(name):
        return _expanded_url(name)
    if os.path.isdir(name):
        found = _files(os.path.join(glob.escape(name), "*.mcap"))
        return _something(sorted(found), name, f"no *.mcap in the folder {name}")
    if os.path.exists(name):
        return None
    if glob.has_magic(name):
        found = _files(name)
        return _something(sorted(found), name, f"nothing matches {name}")
    if not name:
        raise InputError("a name is empty", hint="A variable of the shell may hold nothing")
    raise MissingDataError(
        "No such file or folder", file=name, hint="Check the spelling of the path"
    )


def _files(pattern: str) -> list[str]:
    """What a pattern matches, but for folders: one may be called `old.mcap`.

    As in shells `**` follows no links to folders, of which two in a circle have no end.
    """
    parts = pattern.replace(os.sep, "/").split("/")
    if "**" not in parts:
        return [path for path in glob.glob(pattern) if not os.path.isdir(path)]
    deep = parts.index("**")
    below = "/".join(part for part in parts[deep + 1 :]) or "*"
    found: list[str] = []
    for top in glob.glob("/".join([*parts[:deep], ""])) if deep else [""]:
        for folder, inner, _ in os.walk(top or os.curdir):
            inner[:] = [name for name in inner if not name.startswith(".")]
            start = os.path.relpath(folder) if not top else folder
            found += _files(os.path.join("" if start == "." else glob.escape(start), below))
    return found


def _expanded_url(url: str) -> list[str] | None:
    if places.is_web(url):
        return None
    with places.remote(url) as (store, key):
        store.invalidate_cache()
        if not url.endswith("/") and not glob.has_magic(url):
            if store.isfile(key):
                return None
            if not store.isdir(key):
                raise FileNotFoundError(url)
        folder = not glob.has_magic(url)
        pattern = f"{key.rstrip('/')}/*.mcap" if folder else key
        told = f"no *.mcap in {url}" if folder else f"nothing matches {url}"
        found = [str(store.unstrip_protocol(path)) for path in store.glob(pattern)]
    return _something(sorted(found), url, told)


def _something(found: list[str], name: str, told: str) -> list[str]:
    if not found:
        raise MissingDataError(told, hint="Check the spelling, and that there are sessions")
    return found
