"""Binary files of Logic 2, alone or in a capture (``.sal``), as data lines.

A capture is a zip archive: ``digital-N.bin`` for each digital channel (see
:mod:`locatk.formats.importers.saleae.binary`) and ``meta.json`` with names and settings, of
which a whole capture needs nothing else. Analog channels are passed over.
"""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from locatk.core.errors import FormatError, LocatkError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.formats.importers.saleae import binary
from locatk.formats.importers.saleae.data_lines import Line, Piece, clean_name, readable

DIGITAL = re.compile(r"digital-(\d{1,4})\.bin", re.ASCII)
EXPORTED = re.compile(r"digital_(\d{1,4})\.bin", re.ASCII)

MOST_BYTES = 4 << 30
"""Of all channels of a capture, decoded."""

MOST_META = 16 << 20

COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    KeyError,
    OSError,
    OverflowError,
    RuntimeError,  # encrypted; a version or depth of nesting that is not supported
    ValueError,
)
"""What reading a damaged archive raises."""

AGAIN = "copy the capture again from where it was recorded"


# ---- binary files


@contextmanager
def _opened(path: Path, member: str) -> Iterator[binary.Source]:
    """A binary file, or one in an archive; what can be wrong with either as LocatkError."""
    if not member:
        with readable(path), path.open("rb") as stream:
            yield binary.Source(stream, path)
        return
    with _archive(path, member) as archive, archive.open(member) as stream:
        yield binary.Source(stream, path, member)


def _pieces(path: Path, member: str) -> Iterator[Piece]:
    """Edges of a binary file, read anew."""
    with _opened(path, member) as source:
        head = binary.read_head(source)
        read = binary.captured_pieces if head.captured else binary.export_pieces
        yield from read(source, head)


def file_line(path: Path) -> Line:
    """The one channel of a binary file."""
    with _opened(path, "") as source:
        head = binary.read_head(source)
        rate = head.rate_hz or binary.export_rate(source, head)
    match = DIGITAL.fullmatch(path.name) or EXPORTED.fullmatch(path.name)
    number = int(match[1]) if match else None
    name = clean_name(path.stem) if number is None else f"Channel {number}"
    ticks = head.rate_hz or float(NANOSECONDS_PER_S)
    rate = rate and min(rate, ticks)
    return Line(name, number, ticks, rate, head.start_ns, partial(_pieces, path, ""))


# ---- archives


@contextmanager
def _archive(path: Path, where: str | None = None) -> Iterator[zipfile.ZipFile]:
    """The archive, with all that can be wrong with one as FormatError."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except LocatkError:
        raise
    except BROKEN as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FormatError(
            f"damaged archive ({reason})", file=path, where=where, hint=AGAIN
        ) from error


def archive_lines(path: Path) -> list[Line]:
    """Digital channels of a capture, ascending."""
    with _archive(path) as archive:
        meta = _meta(archive)
        members: dict[int, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            match = DIGITAL.fullmatch(info.filename)
            if match is None:
                continue
            if int(match[1]) in members or info.compress_type not in COMPRESSION:
                raise FormatError(
                    "a channel that is there twice, or compressed in a way that Logic does not",
                    file=path,
                    where=info.filename,
                    hint=AGAIN,
                )
            members[int(match[1])] = info
        missing = sorted(recorded(meta) - set(members))
        if missing:
            raise FormatError(
                f"no digital-{missing[0]}.bin, which meta.json tells of", file=path, hint=AGAIN
            )
        if not members:
            raise FormatError(
                "no digital channel", file=path, hint="record photodiodes as digital channels"
            )
        size = sum(info.file_size for info in members.values())
        if size > MOST_BYTES:
            raise FormatError(
                f"channels of {size:,} bytes, more than {MOST_BYTES:,}",
                file=path,
                hint="save a shorter part of the capture",
            )
        names = names_of(meta)
        start = start_of(meta)
        return [
            _captured(path, info.filename, number, names.get(number, f"Channel {number}"), start)
            for number, info in sorted(members.items())
        ]


def _captured(path: Path, member: str, number: int, name: str, start_ns: int) -> Line:
    with _opened(path, member) as source:
        head = binary.read_head(source)
        if not head.captured or head.rate_hz is None:
            source.fail("an export inside a capture")
    start = head.start_ns or start_ns
    return Line(name, number, head.rate_hz, head.rate_hz, start, partial(_pieces, path, member))


# ---- meta.json, of which a capture that is whole needs nothing but names


def _meta(archive: zipfile.ZipFile) -> Mapping[str, Any]:
    """What ``meta.json`` tells; nothing where it is missing or damaged."""
    try:
        if archive.getinfo("meta.json").compress_type not in COMPRESSION:
            return {}
        with archive.open("meta.json") as stream:
            text = stream.read(MOST_META + 1)
        meta = json.loads(text) if len(text) <= MOST_META else None
    except BROKEN:
        return {}
    return meta if isinstance(meta, dict) else {}


def _get(value: object, *keys: str) -> Any:
    """What stands below ``keys``; None where it does not."""
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _digital(value: object) -> int | None:
    """Number of a digital channel as ``meta.json`` names one; None where it is another."""
    number = _get(value, "deviceChannel")
    return number if _get(value, "type") == "Digital" and isinstance(number, int) else None


def recorded(meta: Mapping[str, Any]) -> set[int]:
    """Digital channels that should be in the archive."""
    entries = _get(meta, "binData")
    found = map(_digital, entries if isinstance(entries, list) else ())
    return {number for number in found if number is not None}


def names_of(meta: Mapping[str, Any]) -> dict[int, str]:
    """Names of the digital channels by number."""
    rows = _get(meta, "data", "rowsSettings")
    names: dict[int, str] = {}
    for row in rows if isinstance(rows, list) else ():
        number, name = _digital(_get(row, "channel")), _get(row, "name")
        if number is not None and isinstance(name, str) and clean_name(name):
            names[number] = clean_name(name)
    return names


def start_of(meta: Mapping[str, Any]) -> int:
    """Start of the capture in nanoseconds since the epoch; 0 where it is not told."""
    start = _get(meta, "data", "captureStartTime")
    ms, fraction = _get(start, "unixTimeMilliseconds"), _get(start, "fractionalMilliseconds")
    if not isinstance(ms, int | float) or not isinstance(fraction, int | float):
        return 0
    return binary.start_of(ms, fraction)
