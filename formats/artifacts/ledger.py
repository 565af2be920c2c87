"""The ledger: a small TOML file of the areas that sheets hold, so that no two share one.

It lies beside the sheets as ``locatk-ledger.toml`` unless another is named; its keys are
described in docs/formats.md. An area is written down before its sheet is, and is never
given back.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from locatk.core.dots.codec import check_window
from locatk.core.dots.design.ledger import Area
from locatk.core.errors import InputError
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.base import head
from locatk.formats.output import atomic_write, check_output

LEDGER_FILE = "locatk-ledger.toml"

LEDGER_FORMAT = "locatk-dot-ledger"
LEDGER_VERSION = 1


class Ledger:
    """A ledger that was read, and to which areas can be added; see :func:`open_ledger`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen = path.read_bytes() if path.exists() else None
        self.areas: tuple[Area, ...] = () if self._seen is None else _loads(self._seen, path)

    def add(self, areas: Sequence[Area]) -> None:
        """Write the ledger with these areas; those it has already are not repeated.

        Raises
        ------
        InputError
            Another program has written it since it was read.
        """
        now = self.path.read_bytes() if self.path.exists() else None
        if now != self._seen:
            raise InputError(
                "changed while sheets were drawn", file=self.path, hint="Run the command again"
            )
        every = (*self.areas, *(area for area in areas if area not in self.areas))
        data = _dumps(every).encode()
        if data != self._seen:
            with atomic_write(self.path, overwrite=True) as stream:
                stream.write(data)
        self.areas, self._seen = every, data


@contextlib.contextmanager
def open_ledger(path: str | os.PathLike[str]) -> Iterator[Ledger]:
    """The ledger at ``path``, empty where there is none yet.

    While it is open, whoever opens a ledger in the same folder waits, so that two runs
    at once take different areas.

    Raises
    ------
    ArtifactError
        It is damaged or no ledger; it is left as it is.
    MissingDataError
        There is no such folder.
    """
    check_output(path, overwrite=True)
    with _alone(Path(path).parent):
        yield Ledger(Path(path))


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    try:
        import fcntl
    except ImportError:  # Windows: Ledger.add still sees that another was faster
        yield
        return
    # The folder itself: a file to lock would stay behind.
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network file systems cannot
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _dumps(areas: Sequence[Area]) -> str:
    return toml.dumps(
        {
            "#": "Areas of the dot pattern that are in use: keep this file, one for all sheets.",
            **head(LEDGER_FORMAT, LEDGER_VERSION),
            "areas": [
                {
                    "id": area.id,
                    "codec": area.codec,
                    "section": list(area.section),
                    "origin": list(area.origin),
                    "size": list(area.size),
                }
                for area in areas
            ],
        }
    )


def _loads(data: bytes, path: Path) -> tuple[Area, ...]:
    table = toml.loads(data, path)
    toml.check_format(table, LEDGER_FORMAT, LEDGER_VERSION)
    areas = tuple(_area(item) for item in table.tables("areas"))
    table.end()
    names = [area.id for area in areas]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise table.error(f"areas[{number}].id", f"{name!r} is there twice")
    return areas


def _area(table: toml.Table) -> Area:
    name, codec = table.text("id"), table.text("codec")
    section, origin, size = (_pair(table, key) for key in ("section", "origin", "size"))
    table.end()
    try:
        check_window(origin, size, section)
    except InputError as error:
        raise table.error("origin", error.message) from None
    return Area(name, codec, section, origin, size)


def _pair(table: toml.Table, key: str) -> tuple[int, int]:
    value: Any = table.raw(key)
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(isinstance(n, int) and not isinstance(n, bool) for n in value)
    ):
        raise table.error(key, "expected a list of 2 whole numbers")
    return value[0], value[1]
