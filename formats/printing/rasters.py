"""Dots as pixels (PNG) and as letters (text), for other printers and programs."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from typing import IO

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import DOT_DIRECTIONS, SYMBOL_LETTERS, codec
from locatk.core.dots.drawing.layout import Raster, SheetLayout, pixels
from locatk.core.dots.sheet import MM_PER_INCH, Manifest

BAND_ROWS = 256
"""Rows of dots that are computed at once."""

MAX_BAND_PIXELS = 16_000_000
"""Pixels that are computed at once, one byte each."""


def _nothing() -> None:
    pass


def count_bands(manifest: Manifest) -> int:
    """Return the number of bands of all sheets of a manifest."""
    return sum(-(-sheet.size[1] // BAND_ROWS) for sheet in manifest.sheets)


def symbols(
    manifest: Manifest, number: int, done: Callable[[], object] = _nothing
) -> Iterator[NDArray[np.uint8]]:
    """Yield the symbols of sheet ``number``, at most :data:`BAND_ROWS` rows at a time.

    ``done`` is called when the caller has processed a band.
    """
    sheet, table = manifest.sheets[number], codec(manifest.codec)
    (x, y), (columns, rows) = sheet.origin, sheet.size
    for row in range(0, rows, BAND_ROWS):
        count = min(BAND_ROWS, rows - row)
        yield table.symbols((x, y + row), (columns, count), sheet.section)
        done()


def write_text(
    stream: IO[bytes], manifest: Manifest, number: int, done: Callable[[], object] = _nothing
) -> None:
    """Write sheet ``number`` as letters u, d, l and r, a line a row of dots."""
    codes = np.frombuffer(SYMBOL_LETTERS.encode(), np.uint8)
    for band in symbols(manifest, number, done):
        lines = np.full((band.shape[0], band.shape[1] + 1), ord("\n"), np.uint8)
        lines[:, :-1] = codes[band]
        stream.write(lines.tobytes())


def write_png(
    stream: IO[bytes], manifest: Manifest, number: int, done: Callable[[], object] = _nothing
) -> None:
    """Write the page of sheet ``number`` as a PNG of 1 bit a pixel, at the sheet's dpi.

    It contains only dots, and its resolution, so that programs can import it at true size.

    Raises
    ------
    InputError
        The manifest's dots are not on pixels.
    """
    layout = pixels(manifest, number)
    width, height = layout.page
    stream.write(b"\x89PNG\r\n\x1a\n")
    _chunk(stream, b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    per_metre = round(1000 * layout.raster.dpi / MM_PER_INCH)
    _chunk(stream, b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1))
    packer = zlib.compressobj(6)
    for rows in _rows(layout, symbols(manifest, number, done)):
        packed = packer.compress(rows)
        if packed:
            _chunk(stream, b"IDAT", packed)
    _chunk(stream, b"IDAT", packer.flush())
    _chunk(stream, b"IEND", b"")


def _chunk(stream: IO[bytes], kind: bytes, data: bytes) -> None:
    check = zlib.crc32(data, zlib.crc32(kind))
    stream.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check))


def _rows(layout: SheetLayout, rows: Iterator[NDArray[np.uint8]]) -> Iterator[bytes]:
    """Yield the lines of a page from the top down, packed, each after its filter byte of 0."""
    raster, (width, height) = layout.raster, layout.page
    left, top = (start - raster.offset for start in layout.first)
    cells = _cells(raster)
    line = 0
    step = max(1, MAX_BAND_PIXELS // (width * raster.pitch))
    yield from _packed(np.ones((top, width), np.uint8), step * raster.pitch)
    line = top
    for band in rows:
        for start in range(0, len(band), step):
            part = band[start : start + step]
            ink = cells[part].transpose(0, 2, 1, 3).reshape(len(part) * raster.pitch, -1)
            lines = np.ones((len(ink), width), np.uint8)
            lines[:, left : left + ink.shape[1]] -= ink[:, : width - left]
            # The last cell may be higher than the rest of the page.
            yield from _packed(lines[: height - line], len(lines))
            line = min(height, line + len(lines))
    yield from _packed(np.ones((height - line, width), np.uint8), step * raster.pitch)


def _packed(lines: NDArray[np.uint8], step: int) -> Iterator[bytes]:
    for start in range(0, len(lines), step):
        bits = np.packbits(lines[start : start + step], axis=1)
        yield np.pad(bits, ((0, 0), (1, 0))).tobytes()


def _cells(raster: Raster) -> NDArray[np.uint8]:
    """Return the ink (4, pitch, pitch) of each symbol; its grid point is at ``offset``."""
    cells = np.zeros((4, raster.pitch, raster.pitch), np.uint8)
    for cell, (x, y) in zip(cells, DOT_DIRECTIONS.tolist(), strict=True):
        column, row = raster.offset * (1 + x), raster.offset * (1 + y)
        cell[row : row + raster.dot, column : column + raster.dot] = 1
    return cells
