"""Layout of the dots of a sheet on its paper, in whole pixels of the printer.

A dot that covers two pixels of the printer in part is printed grey or too large. (Rendered by
pdfium at 300 dpi, a dot of one pixel has 3.5 grey pixels and less than 0.5 % full black if it is
not aligned, and exactly one black pixel if it is.) Everything is therefore snapped: the pitch, the
offset and the dot to pixels of the printer, the page and the first position to 1/300 in. A page of
a whole number of pixels is the same for rasterisers that count from its upper left corner and for
those that count from its lower left one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from locatk.core.dots.codec import check_window
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, MM_PER_INCH, Manifest, Sheet
from locatk.core.errors import InputError
from locatk.core.paper_sizes import MAX_PAPER_MM

DPIS = (300, 600, 1200)
"""Supported resolutions of printers."""

BASE_DPI = 300
"""Resolution to which the page and the first position are snapped, for every printer."""

MIN_SHEET_DOTS = 8
"""Rows and columns of the smallest window with a unique position and heading."""

MAX_ROUNDING_PX = 1e-3
"""Largest difference from a whole number of pixels of a length in a manifest [px]."""

MIN_NOTED_CHANGE_MM = 5e-4
"""Least change of a length by snapping that is reported [mm]."""


@dataclass(frozen=True)
class Raster:
    """Pattern in pixels of the printer.

    Attributes
    ----------
    dpi : int
    pitch, offset, dot : int
        Distance of two positions, of a dot from its position, and width of a dot, in px.
    """

    dpi: int
    pitch: int
    offset: int
    dot: int

    @property
    def step(self) -> int:
        """Number of pixels in 1/300 in."""
        return self.dpi // BASE_DPI

    def mm(self, pixels: float) -> float:
        """Return the length in mm of a number of pixels."""
        # Twelve digits, so that lengths in a manifest are as short as possible.
        return round(pixels * MM_PER_INCH / self.dpi, 12)


@dataclass(frozen=True)
class SheetLayout:
    """Positions of a sheet on its page, in pixels.

    Attributes
    ----------
    raster : Raster
    page : (width, height)
    first : (x, y)
        From the page's upper left corner right and down to the upper left pixel of an undisplaced
        dot at the upper left position.
    size : (columns, rows)
    """

    raster: Raster
    page: tuple[int, int]
    first: tuple[int, int]
    size: tuple[int, int]

    @property
    def page_mm(self) -> tuple[float, float]:
        """Width and height of the page."""
        return self.raster.mm(self.page[0]), self.raster.mm(self.page[1])

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, right and bottom edge of the area that dots can cover, in px."""
        r = self.raster
        left, top = (start - r.offset for start in self.first)
        right, bottom = (
            start + (count - 1) * r.pitch + r.dot + r.offset
            for start, count in zip(self.first, self.size, strict=True)
        )
        return left, top, right, bottom

    def sheets(
        self, name: str, origin: tuple[int, int], section: tuple[int, int] = (0, 0)
    ) -> tuple[Sheet, ...]:
        """Return the one sheet with the area at ``origin``.

        Raises
        ------
        InputError
            No section contains the whole area; see :func:`~locatk.core.dots.codec.check_window`.
        """
        check_window(origin, self.size, section)
        r = self.raster
        x, y = (r.mm(start + r.dot / 2) for start in self.first)
        return (Sheet(name, origin, self.size, section, self.page_mm, (x, y)),)


def snap(pitch_mm: float, dot_mm: float | None, dpi: int) -> Raster:
    """Return the nearest pattern that a printer of ``dpi`` can print.

    Parameters
    ----------
    pitch_mm : float
    dot_mm : float or None
        Width of a dot; None for 1/6 of the pitch.
    dpi : int
        One of :data:`DPIS`.

    Raises
    ------
    InputError
        Dots of this size would touch at this pitch, or a value is out of range.
    """
    if dpi not in DPIS:
        raise InputError(f"{dpi} dpi", hint=f"Use one of {', '.join(map(str, DPIS))}")
    for name, length in (("pitch", pitch_mm), ("dot", dot_mm)):
        if length is not None and not 0 < length <= MM_PER_INCH:
            raise InputError(f"a {name} of {length:g} mm", hint="Give it in mm, as in 0.508")
    pixel = MM_PER_INCH / dpi
    pitch = round(pitch_mm / pixel)
    offset = max(1, round(pitch * DOT_OFFSET_PITCHES))
    dot = max(1, round(pitch * DOT_OFFSET_PITCHES if dot_mm is None else dot_mm / pixel))
    # Two dots displaced towards each other must leave a pixel between them.
    if pitch - 2 * offset - dot < 1:
        wanted = "" if dot_mm is None else f" of {dot_mm:g} mm"
        raise InputError(
            f"dots{wanted} would touch at a pitch of {pitch_mm:g} mm and {dpi} dpi",
            hint="Use a larger pitch, a smaller dot or more dpi",
        )
    return Raster(dpi, pitch, offset, dot)


def snapped(raster: Raster, pitch_mm: float, dot_mm: float | None) -> list[str]:
    """Return a message for each length that :func:`snap` has changed."""
    return [
        f"{name} {asked:g} mm becomes {raster.mm(pixels):.4g} mm, {pixels} px at {raster.dpi} dpi"
        for name, asked, pixels in (
            ("pitch", pitch_mm, raster.pitch),
            ("dot", dot_mm, raster.dot),
        )
        if asked is not None and abs(raster.mm(pixels) - asked) > MIN_NOTED_CHANGE_MM
    ]


def lay_out(page_mm: tuple[float, float], margin_mm: float, raster: Raster) -> SheetLayout:
    """Return the layout with as many positions as fit inside the margin of a page, centred.

    Raises
    ------
    InputError
        Fewer than :data:`MIN_SHEET_DOTS` rows or columns fit.
    """
    if not 0 <= margin_mm <= MAX_PAPER_MM:
        raise InputError(f"a margin of {margin_mm:g} mm")
    if not all(0 < side <= MAX_PAPER_MM for side in page_mm):
        raise InputError(f"a page of {page_mm[0]:g} x {page_mm[1]:g} mm")
    base = MM_PER_INCH / BASE_DPI
    margin = math.ceil(margin_mm / base - 1e-6) * raster.step
    page, first, size = [], [], []
    for side in page_mm:
        pixels = round(side / base) * raster.step
        start = _round_up(margin + raster.offset, raster.step)
        available = pixels - margin - start - raster.dot - raster.offset
        count = available // raster.pitch + 1
        if count < MIN_SHEET_DOTS:
            raise InputError(
                f"a page of {page_mm[0]:g} x {page_mm[1]:g} mm with a margin of {margin_mm:g} mm "
                f"has no room for {MIN_SHEET_DOTS} x {MIN_SHEET_DOTS} dots",
                hint="Use a smaller margin or a larger paper",
            )
        rest = available - (count - 1) * raster.pitch
        page.append(pixels)
        first.append(start + rest // 2 // raster.step * raster.step)
        size.append(count)
    return SheetLayout(raster, (page[0], page[1]), (first[0], first[1]), (size[0], size[1]))


def _round_up(pixels: int, step: int) -> int:
    """Round up to a multiple of ``step``."""
    return -(-pixels // step) * step


def manifest(raster: Raster, sheets: Iterable[Sheet], codec: str) -> Manifest:
    """Return the manifest of sheets printed on this raster."""
    r = raster
    return Manifest(
        tuple(sheets),
        codec=codec,
        pitch_mm=r.mm(r.pitch),
        dot_mm=r.mm(r.dot),
        offset_mm=r.mm(r.offset),
        dpi=r.dpi,
    )


def pixels(manifest: Manifest, number: int) -> SheetLayout:
    """Return the layout of sheet ``number`` of a manifest.

    Raises
    ------
    InputError
        Its dots are not aligned with the printer's pixels.
    """
    dpi, item = manifest.dpi, manifest.sheets[number]
    if dpi % BASE_DPI:
        raise InputError(f"sheets of {dpi} dpi", hint=f"Use one of {', '.join(map(str, DPIS))}")

    def to_pixels(length_mm: float, key: str, unit: int = 1) -> int:
        exact = length_mm * dpi / MM_PER_INCH
        rounded = round(exact / unit) * unit
        if abs(exact - rounded) > MAX_ROUNDING_PX:
            raise InputError(
                f"{key} of sheet {item.id!r} is not a whole number of pixels at {dpi} dpi",
                hint="Print it as a new sheet",
            )
        return rounded

    raster = Raster(
        dpi,
        to_pixels(manifest.pitch_mm, "pitch_mm"),
        to_pixels(manifest.offset_mm, "offset_mm"),
        to_pixels(manifest.dot_mm, "dot_mm"),
    )
    width, height = (to_pixels(side, "page_mm", raster.step) for side in item.page_mm)
    x, y = (to_pixels(at - raster.mm(raster.dot / 2), "first_mm") for at in item.first_mm)
    return SheetLayout(raster, (width, height), (x, y), item.size)
