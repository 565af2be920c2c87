"""Files of names on the command line: paths, folders, patterns and URLs."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence

from locatk.core.errors import InputError, MissingDataError
from locatk.core.natural_order import natural_key
from locatk.formats.pipeline.file_access import remote
from locatk.formats.pipeline.file_names import is_url, is_web


def expand_name(name: str, endings: Sequence[str] = (".mcap",)) -> list[str] | None:
    """Return the files of a folder or a pattern in natural order; None for the name of one file.

    A folder stands for its files with one of the endings, without subfolders; a pattern for its
    matches, with ``**`` for any depth.

    Raises
    ------
    MissingDataError
        There is no such file or folder, or none in it.
    InputError
        The name is empty or impossible, or an object store does not respond.
    """
    if not name:
        raise InputError("a file name is empty", hint="Check the variables of the shell")
    if "\0" in name:
        raise InputError("a file name with a zero byte", file=name)
    if is_url(name):
        return _expand_url(name, endings)
    if os.path.isdir(name):
        files = _matching_files(os.path.join(glob.escape(name), "*"))
        return _require_files(
            [file for file in files if file.lower().endswith(tuple(endings))],
            name,
            _problem_of_folder(endings),
        )
    if os.path.exists(name):
        return None
    if glob.has_magic(name):
        return _require_files(_matching_files(name), name, "no file matches the pattern")
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


def _expand_url(url: str, endings: Sequence[str]) -> list[str] | None:
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
        found = store.glob(key if is_pattern else f"{key.rstrip('/')}/*")
        files = [str(store.unstrip_protocol(path)) for path in found]
    if is_pattern:
        return _require_files(files, url, "no file matches the pattern")
    files = [file for file in files if file.lower().endswith(tuple(endings))]
    return _require_files(files, url, _problem_of_folder(endings))


def _problem_of_folder(endings: Sequence[str]) -> str:
    return f"no {' or '.join(f'*{ending}' for ending in endings)} in the folder"


def _require_files(files: list[str], name: str, problem: str) -> list[str]:
    if not files:
        hint = "Check the spelling, and that there are sessions"
        raise MissingDataError(problem, file=name, hint=hint)
    return sorted(files, key=natural_key)
