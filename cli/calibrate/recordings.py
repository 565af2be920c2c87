"""Several recordings that one artifact is calibrated from: those of no use are left out."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from locatk.cli import console, failures
from locatk.core.errors import LocatkError


@contextlib.contextmanager
def walk(sessions: Sequence[Path], label: str) -> Iterator[Iterable[Path]]:
    """Show how far the sessions are read, also where there is only one."""
    wait = console.working(label) if len(sessions) == 1 else contextlib.nullcontext()
    with wait, console.progress(sessions, label) as bar:
        yield bar


@contextlib.contextmanager
def sparing(path: Path, left_out: dict[str, str], *, alone: bool) -> Iterator[None]:
    """Leave a session out that cannot be used, and say why; raise where it is the only one."""
    try:
        yield
    except LocatkError as error:
        if alone:
            error.file = error.file or str(path)  # a solver knows arrays, not files
            raise
        left_out[str(path)] = error.message


def tell(text: str, notes: Iterable[str], left_out: Mapping[str, str]) -> None:
    """A calibration for people, and what it did not use."""
    console.result(text)
    for note in notes:
        console.say(note)
    for name, why in left_out.items():
        console.warn(f"{name}: {why}")


def check_all_used(left_out: Mapping[str, str], one: str, several: str) -> None:
    """End with the status of something lost where anything is left out."""
    if left_out:
        count = len(left_out)
        raise failures.Incomplete(f"{count} {one if count == 1 else several} not used")
