"""Calibration from several recordings: progress, unusable recordings, text."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from locatk.cli import console, failures
from locatk.core.errors import InputError, LocatkError

if TYPE_CHECKING:
    import numpy as np


class Measurements:
    """Measurements read so far; those that are given twice would count as independent ones."""

    def __init__(self) -> None:
        self._names: dict[bytes, str] = {}

    def add(self, name: str, *arrays: np.ndarray) -> None:
        """Add the measurements of a recording.

        Raises
        ------
        InputError
            They were added before: from the same file, from a copy, or from the same bytes that
            were decoded again.
        """
        digest = hashlib.sha256(repr([array.shape for array in arrays]).encode())
        for array in arrays:
            digest.update(array.tobytes())
        key = digest.digest()
        if key in self._names:
            raise InputError(
                f"the same measurements as in {self._names[key]}", hint="Give each recording once"
            )
        self._names[key] = name


@contextlib.contextmanager
def iterate(sessions: Sequence[Path], label: str) -> Iterator[Iterable[Path]]:
    """Iterate over sessions with a progress bar, or with a label for a single one."""
    wait = console.working(label) if len(sessions) == 1 else contextlib.nullcontext()
    with wait, console.progress(sessions, label) as bar:
        yield bar


@contextlib.contextmanager
def skipping_unusable(path: Path, left_out: dict[str, str], *, alone: bool) -> Iterator[None]:
    """Enter an error into ``left_out``; raise it if the session is the only one."""
    try:
        yield
    except LocatkError as error:
        if alone:
            error.file = error.file or str(path)  # Solvers work on arrays.
            raise
        position = "" if error.where is None else f"{error.where}: "
        left_out[str(path)] = position + failures.describe(error, with_file=False)


def print_result(text: str, notes: Iterable[str], left_out: Mapping[str, str]) -> None:
    """Print a calibration, its notes, and the recordings that were not used."""
    console.result(text)
    for note in notes:
        console.say(note)
    for name, reason in left_out.items():
        console.warn(f"{name}: {reason}")


def check_all_used(left_out: Mapping[str, str], singular: str, plural: str) -> None:
    """Raise Incomplete if recordings were left out."""
    if left_out:
        count = len(left_out)
        raise failures.Incomplete(f"{count} {singular if count == 1 else plural} not used")
