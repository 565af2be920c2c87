"""Dots as pixels of the printer (for PDF, PNG, TIFF and PBM) and as letters (text).

:func:`ink_bands` is the only source of pixels, so that all formats show the same ones. The images
are written band by band, since A0 at 1200 dpi has 2.2 thousand million pixels: Pillow would hold a
byte for each, and OpenCV cannot write 1 bit a pixel.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
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

TIFF_STRIP_BYTES = 1 << 18
"""Size of a strip of a TIFF before compression; readers decompress whole strips."""


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


def ink_bands(
    layout: SheetLayout, rows: Iterable[NDArray[np.uint8]]
) -> Iterator[NDArray[np.uint8]]:
    """Yield the pixels (height, width) of the box of a pattern from the top down, 1 for ink.

    Parameters
    ----------
    layout : SheetLayout
        Its ``box`` is the area of all bands together; each of them has its width, and ends between
        two rows of dots.
    rows : iterable of (rows, columns) uint8 ndarray
        Symbols from the top down, together of the layout's size.
    """
    raster, (left, top, right, bottom) = layout.raster, layout.box
    cells = _cells(raster)
    step = max(1, MAX_BAND_PIXELS // ((right - left) * raster.pitch))
    for symbols_of_rows in rows:
        for start in range(0, len(symbols_of_rows), step):
            part = symbols_of_rows[start : start + step]
            ink = cells[part].transpose(0, 2, 1, 3).reshape(len(part) * raster.pitch, -1)
            # Cells are a pitch wide and high, so that the last ones extend beyond the box.
            yield ink[: bottom - top, : right - left]
            top += len(ink)


def _cells(raster: Raster) -> NDArray[np.uint8]:
    """Return the ink (4, pitch, pitch) of each symbol; its grid point is at ``offset``."""
    cells = np.zeros((4, raster.pitch, raster.pitch), np.uint8)
    for cell, (x, y) in zip(cells, DOT_DIRECTIONS.tolist(), strict=True):
        column, row = raster.offset * (1 + x), raster.offset * (1 + y)
        cell[row : row + raster.dot, column : column + raster.dot] = 1
    return cells


def _page_lines(
    manifest: Manifest, number: int, done: Callable[[], object]
) -> Iterator[NDArray[np.uint8]]:
    """Yield the lines (n, bytes) of the page of a sheet from the top down, a bit of 1 for ink."""
    layout = pixels(manifest, number)
    (width, height), (left, top, right, bottom) = layout.page, layout.box
    step = max(1, MAX_BAND_PIXELS // width)

    def blank_lines(count: int) -> Iterator[NDArray[np.uint8]]:
        for start in range(0, count, step):
            yield np.zeros((min(step, count - start), -(-width // 8)), np.uint8)

    yield from blank_lines(top)
    for ink in ink_bands(layout, symbols(manifest, number, done)):
        yield np.packbits(np.pad(ink, ((0, 0), (left, width - right))), axis=1)
    yield from blank_lines(height - bottom)


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
    stream.write(b"\x89PNG\r\n\x1a\n")
    _chunk(stream, b"IHDR", struct.pack(">IIBBBBB", *layout.page, 1, 0, 0, 0, 0))
    per_metre = round(1000 * layout.raster.dpi / MM_PER_INCH)
    _chunk(stream, b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1))
    packer = zlib.compressobj(6)
    for lines in _page_lines(manifest, number, done):
        # A bit of 1 is white, and each line begins with the number of its filter, 0.
        packed = packer.compress(np.pad(~lines, ((0, 0), (1, 0))).tobytes())
        if packed:
            _chunk(stream, b"IDAT", packed)
    _chunk(stream, b"IDAT", packer.flush())
    _chunk(stream, b"IEND", b"")


def _chunk(stream: IO[bytes], kind: bytes, data: bytes) -> None:
    check = zlib.crc32(data, zlib.crc32(kind))
    stream.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check))


def write_tiff(
    stream: IO[bytes], manifest: Manifest, number: int, done: Callable[[], object] = _nothing
) -> None:
    """Write the page of sheet ``number`` as a TIFF of 1 bit a pixel, at the sheet's dpi.

    Contents are those of :func:`write_png`. The strips are compressed by Deflate, which gives a
    third of the size of CCITT group 4 for single dots. ``stream`` must be seekable.

    Raises
    ------
    InputError
        The manifest's dots are not on pixels.
    """
    layout = pixels(manifest, number)
    width, height = layout.page
    line_bytes = -(-width // 8)
    strip_lines = max(1, TIFF_STRIP_BYTES // line_bytes)
    stream.write(struct.pack("<2sHI", b"II", 42, 0))  # the address of the directory follows below
    addresses, sizes = [], []

    def write_strip(data: bytes | bytearray) -> None:
        packed = zlib.compress(data, 6)
        addresses.append(stream.tell())
        sizes.append(stream.write(packed))

    pending = bytearray()
    for lines in _page_lines(manifest, number, done):
        pending += lines.tobytes()
        while len(pending) >= strip_lines * line_bytes:
            write_strip(pending[: strip_lines * line_bytes])
            del pending[: strip_lines * line_bytes]
    if pending:
        write_strip(pending)

    def write_numbers(values: list[int]) -> int:
        """Write 32-bit numbers; return the value of their entry: their address, or the only one."""
        if len(values) == 1:
            return values[0]
        stream.write(b"\0" * (stream.tell() % 2))  # addresses are even
        start = stream.tell()
        stream.write(struct.pack(f"<{len(values)}I", *values))
        return start

    resolution = write_numbers([layout.raster.dpi, 1])
    # Tag, type (3: 16 bit, 4: 32 bit, 5: fraction), count and value of each entry (TIFF 6.0).
    entries = (
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 1),  # a bit per sample
        (259, 3, 1, 8),  # Deflate
        (262, 3, 1, 0),  # 0 is white
        (273, 4, len(addresses), write_numbers(addresses)),
        (277, 3, 1, 1),  # a sample per pixel
        (278, 4, 1, strip_lines),
        (279, 4, len(sizes), write_numbers(sizes)),
        (282, 5, 1, resolution),
        (283, 5, 1, resolution),
        (296, 3, 1, 2),  # resolution in pixels per inch
    )
    stream.write(b"\0" * (stream.tell() % 2))
    directory = stream.tell()
    stream.write(struct.pack("<H", len(entries)))
    for entry in entries:
        stream.write(struct.pack("<HHII", *entry))
    stream.write(struct.pack("<I", 0))
    stream.seek(4)
    stream.write(struct.pack("<I", directory))
    stream.seek(0, io.SEEK_END)


def write_pbm(
    stream: IO[bytes], manifest: Manifest, number: int, done: Callable[[], object] = _nothing
) -> None:
    """Write the page of sheet ``number`` as a PBM (P4): the pixels of :func:`write_png` alone.

    Raises
    ------
    InputError
        The manifest's dots are not on pixels.
    """
    stream.write("P4\n{} {}\n".format(*pixels(manifest, number).page).encode())
    for lines in _page_lines(manifest, number, done):
        stream.write(lines.tobytes())


WRITERS = {"png": write_png, "tiff": write_tiff, "pbm": write_pbm, "txt": write_text}
"""Writers of one sheet, by the name of their format."""
