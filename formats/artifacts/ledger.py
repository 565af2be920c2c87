"""Ledger of the areas of the dot pattern that are in use, ``locatk-ledger.toml``.

It keeps sheets from sharing an area. It is in the folder of the sheets unless another file is
named. An area is entered before its sheet is written, and is never released.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from locatk.core.dots.design.ledger import Area
from locatk.core.errors import InputError
from locatk.formats.artifacts.kinds import Integer, Row, Text
from locatk.formats.artifacts.schema import Artifact, Key, Table, Tables, Values, refuse_repeated
from locatk.formats.artifacts.sheets import check_area
from locatk.formats.files import MAX_TEXT_BYTES, read_bytes
from locatk.formats.output import atomic_write, check_output

LEDGER_FILE = "locatk-ledger.toml"

LEDGER_FORMAT = "locatk-dot-ledger"


def _area_of(values: Values) -> Area:
    check_area(values)
    return Area(**values)


def _areas_of(values: Values) -> tuple[Area, ...]:
    areas: tuple[Area, ...] = values["areas"]
    refuse_repeated((area.id for area in areas), "areas", "id")
    return areas


_ANY_PAIR = Row(Integer(), 2)

LEDGER: Artifact[tuple[Area, ...]] = Artifact(
    LEDGER_FILE,
    LEDGER_FORMAT,
    Table(
        (
            Key(
                "areas",
                Tables(
                    Table(
                        (
                            Key("id", Text(), "id of the sheet, or name of the tiled floor"),
                            Key(
                                "codec",
                                Text(),
                                "as in `sheet.toml`; areas of different codecs "
                                "may not overlap either, since their sequences are nearly equal",
                            ),
                            Key("section", _ANY_PAIR, "as in `sheet.toml`"),
                            Key("origin", _ANY_PAIR, "as in `sheet.toml`"),
                            Key("size", _ANY_PAIR, "as in `sheet.toml`"),
                        ),
                        _area_of,
                        vars,
                    )
                ),
                default=(),
            ),
        ),
        _areas_of,
        lambda areas: {"areas": areas},
    ),
    comment="Areas of the dot pattern that are in use: keep this file, one for all sheets.",
)
"""The areas of a ledger as a file."""


class Ledger:
    """Ledger that was read, and to which areas can be added; see :func:`open_ledger`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._content = read_bytes(path, MAX_TEXT_BYTES) if path.exists() else None
        self.areas: tuple[Area, ...] = (
            () if self._content is None else LEDGER.loads(self._content, file=path)
        )

    def add(self, areas: Sequence[Area]) -> None:
        """Write the ledger with these areas; known ones are not repeated.

        Raises
        ------
        InputError
            Another program has changed it since it was read.
        """
        content = read_bytes(self.path, MAX_TEXT_BYTES) if self.path.exists() else None
        if content != self._content:
            raise InputError(
                "changed while sheets were drawn", file=self.path, hint="Run the command again"
            )
        merged = (*self.areas, *(area for area in areas if area not in self.areas))
        data = LEDGER.dumps(merged).encode()
        if data != self._content:
            with atomic_write(self.path, overwrite=True) as stream:
                stream.write(data)
        self.areas, self._content = merged, data


@contextlib.contextmanager
def open_ledger(path: str | os.PathLike[str]) -> Iterator[Ledger]:
    """Open the ledger at ``path``; a missing file is an empty ledger.

    While it is open, other processes wait that open a ledger in the same folder, so that two
    simultaneous runs allocate different areas.

    Raises
    ------
    ArtifactError
        It is damaged or not a ledger; the file is not changed.
    MissingDataError
        There is no such folder.
    """
    check_output(path, overwrite=True)
    with _locked(Path(path).parent):
        yield Ledger(Path(path))


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder. A lock on a file of its own would leave that file behind."""
    try:
        import fcntl
    except ImportError:  # Windows: Ledger.add still detects a simultaneous change
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
