"""Captures of Saleae's logic analysers, read as light: the edges of photodiodes' data lines.

=====================  ==============================================================
file                   recognised by
=====================  ==============================================================
capture (``.sal``)     a zip archive with ``digital-N.bin``, names in ``meta.json``
binary export          ``<SALEAE>``: :mod:`locatk.formats.importers.saleae.binary`
CSV export             a header ``Time [s], ...``, of Logic 1 and 2:
                       :mod:`locatk.formats.importers.saleae.csv_export`
=====================  ==============================================================

Which of the lines are light is told by what is on them, where the user does not tell it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from locatk.core.errors import FormatError, InputError
from locatk.core.lighthouse.recording import Edges
from locatk.formats.importers.saleae.archive import archive_lines, file_line
from locatk.formats.importers.saleae.binary import MAGIC
from locatk.formats.importers.saleae.csv_export import read_lines
from locatk.formats.importers.saleae.data_lines import (
    LEAST_RATE_HZ,
    Line,
    Tally,
    readable,
    resolution_of,
)

LEAST_EDGES = 100
"""Runs of less than a microsecond that show the rate of a file that does not tell it."""


@dataclass(frozen=True)
class LightCapture:
    """The light in a capture.

    Attributes
    ----------
    file : Path
    format : str
        ``saleae-capture``, ``saleae-binary`` or ``saleae-csv``.
    names : tuple of str
        The lines taken, one a photodiode.
    edges : tuple of Edges
        Of each of them.
    others : tuple of str
        The lines left out.
    """

    file: Path
    format: str
    names: tuple[str, ...]
    edges: tuple[Edges, ...]
    others: tuple[str, ...]

    def facts(self) -> dict[str, str]:
        """What was read, for people."""
        first = self.edges[0]
        facts = {
            "format": self.format,
            "file": self.file.name,
            "light": ", ".join(
                f"{name}: {len(edges):,} edges"
                for name, edges in zip(self.names, self.edges, strict=True)
            ),
            "resolution": f"{first.resolution_hz / 1e6:g} MHz",
            "duration": f"{max(edges.duration_s for edges in self.edges):.3f} s",
        }
        if first.start_ns:
            facts["start"] = f"{np.datetime64(first.start_ns, 'ns')}Z"
        if self.others:
            facts["left out"] = ", ".join(self.others)
        return facts


def read_light(path: Path, channels: Sequence[str | int] = ()) -> list[Edges]:
    """Edges of the lines that carry light, one a photodiode.

    Parameters and errors are those of :func:`read_capture`.
    """
    return list(read_capture(path, channels).edges)


def read_capture(path: Path, channels: Sequence[str | int] = ()) -> LightCapture:
    """Read a capture or an export of Logic 1 or 2.

    Parameters
    ----------
    path : Path
    channels : sequence of str or int, optional
        Numbers or names of the lines of photodiodes, in order of the sensors. Without them:
        all lines that carry light by what is on them, in the capture's order.

    Raises
    ------
    MissingDataError
        The file is not there or not readable.
    FormatError
        It is no capture, or damaged.
    InputError
        There is no such channel, no light, or too low a sampling rate for it.
    """
    path = Path(path)
    form, lines = _lines_of(path)
    try:
        taken = _named(lines, channels) if channels else _light(lines)
        edges = tuple(_read(line) for line in taken)
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.message, file=path, hint=error.hint) from None
    others = tuple(str(line) for line in lines if line not in taken)
    return LightCapture(path, form, tuple(map(str, taken)), edges, others)


def _lines_of(path: Path) -> tuple[str, list[Line]]:
    """Name of the format, and the data lines; recognised by what is in the file."""
    if path.is_dir():
        raise FormatError("a folder, not a capture", file=path, hint="give the file itself")
    with readable(path):
        if path.exists() and not path.is_file():
            raise FormatError("no regular file", file=path, hint="give a capture or its export")
        with path.open("rb") as stream:
            start = stream.read(8)
    if start.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return "saleae-capture", archive_lines(path)
    if start == MAGIC:
        return "saleae-binary", [file_line(path)]
    return "saleae-csv", read_lines(path)


# ---- which lines


def _named(lines: list[Line], channels: Sequence[str | int]) -> list[Line]:
    """Lines by number or name, in the order asked for."""
    taken: list[Line] = []
    for channel in channels:
        word = str(channel).strip()
        found = [line for line in lines if word == str(line.number)]
        found = found or [line for line in lines if word.lower() == line.name.lower()]
        if len(found) != 1:
            raise InputError(
                f"{'several lines' if found else 'no line'} {word!r}",
                hint=f"there are {_some(list(map(str, lines)))}",
            )
        if found[0] in taken:
            raise InputError(f"channel {word!r} asked for twice", hint="name each line once")
        taken += found
    return taken


def _light(lines: list[Line]) -> list[Line]:
    """Lines that carry light by what is on them."""
    for line in lines:
        if line.resolution_hz:
            _check_rate(line.resolution_hz)
    tallies = [Tally.of(line) for line in lines]
    taken = [line for line, tally in zip(lines, tallies, strict=True) if tally.is_light]
    if taken:
        return taken
    for line, tally in zip(lines, tallies, strict=True):
        if not line.resolution_hz and tally.quick > LEAST_EDGES:
            _check_rate(resolution_of(tally.first))
    what = [f"{line}: {tally}" for line, tally in zip(lines, tallies, strict=True)]
    raise InputError(
        "no light",
        hint=f"no line has bursts of runs of 83 and 167 ns ({_some(what)}): name the line of a "
        "photodiode with --channel if you know better",
    )


def _check_rate(rate_hz: float) -> None:
    if rate_hz < LEAST_RATE_HZ * 0.999:
        raise InputError(
            f"sampled at {rate_hz / 1e6:.3g} MHz, too low for light of 6 Mbit/s",
            hint="record with 24 MHz or more",
        )


def _read(line: Line) -> Edges:
    edges = line.read()
    _check_rate(edges.resolution_hz)
    return edges


def _some(words: list[str], most: int = 16) -> str:
    """Words in a row, of which a long one is cut."""
    more = [f"and {len(words) - most} more"] if len(words) > most else []
    return ", ".join(words[:most] + more)
