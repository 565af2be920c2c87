"""Where the dots of a sheet lie on its paper, in whole pixels of the printer.

A dot that straddles two pixels of the printer comes out grey or too big, so everything is
snapped (facts/dots.md 5.3): the pitch, the offset and the dot to pixels of the printer, the
page and the first place to 1/300 in. A page of a whole number of pixels looks the same to
rasterisers that count from its upper left corner and to those that count from its lower
left one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from locatk.core.dots.codec import check_window
from locatk.core.dots.sheet import MM_PER_INCH, OFFSET, Manifest, Sheet
from locatk.core.errors import InputError
from locatk.core.paper import MAX_PAPER_MM

DPIS = (300, 600, 1200)

BASE_DPI = 300
"""The page and the first place lie on this grid, whatever the printer's is."""

SMALLEST = 8
"""Rows and columns of the smallest window that tells its position and its heading."""


@dataclass(frozen=True)
class Raster:
    """The pattern in pixels of the printer.

    Attributes
    ----------
    dpi : int
    pitch, offset, dot : int
        Between two places, from a place to its dot, and width of a dot, in px.
    """

    dpi: int
    pitch: int
    offset: int
    dot: int

    @property
    def step(self) -> int:
        """Pixels in 1/300 in."""
        return self.dpi // BASE_DPI

    def mm(self, pixels: float) -> float:
        """Length in mm of so many pixels."""
        # Twelve digits: what is written down is short where the length is.
        return round(pixels * MM_PER_INCH / self.dpi, 12)


@dataclass(frozen=True)
class Layout:
    """The places of a sheet on its page, in pixels.

    Attributes
    ----------
    raster : Raster
    page : (width, height)
    first : (x, y)
        From the page's upper left corner right and down to the upper left pixel that a
        dot at the place of the upper left dot would cover.
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
        """Left, top, right, bottom edge of all that a dot can cover, in px."""
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
        """The one sheet that holds the area at ``origin``.

        Raises
        ------
        InputError
            No section holds that area whole; see
            :func:`locatk.core.dots.codec.check_window`.
        """
        check_window(origin, self.size, section)
        r = self.raster
        x, y = (r.mm(start + r.dot / 2) for start in self.first)
        return (Sheet(name, origin, self.size, section, self.page_mm, (x, y)),)


def snap(pitch_mm: float, dot_mm: float | None, dpi: int) -> Raster:
    """The pattern that a printer of ``dpi`` can print and that is nearest to what is asked.

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
        Dots so small or so dense cannot be told apart.
    """
    if dpi not in DPIS:
        raise InputError(f"{dpi} dpi", hint=f"Use one of {', '.join(map(str, DPIS))}")
    for name, length in (("pitch", pitch_mm), ("dot", dot_mm)):
        if length is not None and not 0 < length <= MM_PER_INCH:
            raise InputError(f"a {name} of {length:g} mm", hint="Give it in mm, as in 0.508")
    pixel = MM_PER_INCH / dpi
    pitch = round(pitch_mm / pixel)
    offset = max(1, round(pitch * OFFSET))
    dot = max(1, round(pitch * OFFSET if dot_mm is None else dot_mm / pixel))
    # Two dots that lean towards each other must leave a pixel between them.
    if pitch - 2 * offset - dot < 1:
        wanted = "" if dot_mm is None else f" of {dot_mm:g} mm"
        raise InputError(
            f"dots{wanted} would touch at a pitch of {pitch_mm:g} mm and {dpi} dpi",
            hint="Use a larger pitch, a smaller dot or more dpi",
        )
    return Raster(dpi, pitch, offset, dot)


def snapped(raster: Raster, pitch_mm: float, dot_mm: float | None) -> list[str]:
    """What :func:`snap` has changed, in words; empty where nothing."""
    return [
        f"{name} {asked:g} mm becomes {raster.mm(pixels):.4g} mm, {pixels} px at {raster.dpi} dpi"
        for name, asked, pixels in (
            ("pitch", pitch_mm, raster.pitch),
            ("dot", dot_mm, raster.dot),
        )
        if asked is not None and abs(raster.mm(pixels) - asked) > 5e-4
    ]


def lay_out(page_mm: tuple[float, float], margin_mm: float, raster: Raster) -> Layout:
    """As many places as fit on a page inside its margin, in its middle.

    Raises
    ------
    InputError
        Fewer than :data:`SMALLEST` rows or columns fit.
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
        start = _up(margin + raster.offset, raster.step)
        room = pixels - margin - start - raster.dot - raster.offset
        count = room // raster.pitch + 1
        if count < SMALLEST:
            raise InputError(
                f"a page of {page_mm[0]:g} x {page_mm[1]:g} mm with a margin of {margin_mm:g} mm "
                f"has no room for {SMALLEST} x {SMALLEST} dots",
                hint="Use a smaller margin or a larger paper",
            )
        rest = room - (count - 1) * raster.pitch
        page.append(pixels)
        first.append(start + rest // 2 // raster.step * raster.step)
        size.append(count)
    return Layout(raster, (page[0], page[1]), (first[0], first[1]), (size[0], size[1]))


def _up(pixels: int, step: int) -> int:
    return -(-pixels // step) * step


def manifest(raster: Raster, sheets: Iterable[Sheet], codec: str) -> Manifest:
    """The manifest of sheets that are printed on this raster."""
    r = raster
    return Manifest(
        tuple(sheets),
        codec=codec,
        pitch_mm=r.mm(r.pitch),
        dot_mm=r.mm(r.dot),
        offset_mm=r.mm(r.offset),
        dpi=r.dpi,
    )


def pixels(manifest: Manifest, number: int) -> Layout:
    """The layout of sheet ``number``, of which only the manifest is known.

    Raises
    ------
    InputError
        Its dots do not lie on the printer's pixels.
    """
    dpi, item = manifest.dpi, manifest.sheets[number]
    if dpi % BASE_DPI:
        raise InputError(f"sheets of {dpi} dpi", hint=f"Use one of {', '.join(map(str, DPIS))}")

    def whole(length_mm: float, what: str, unit: int = 1) -> int:
        exact = length_mm * dpi / MM_PER_INCH
        near = round(exact / unit) * unit
        if abs(exact - near) > 1e-3:
            raise InputError(
                f"{what} of sheet {item.id!r} is not a whole number of pixels at {dpi} dpi",
                hint="Print it as a new sheet",
            )
        return near

    raster = Raster(
        dpi,
        whole(manifest.pitch_mm, "pitch_mm"),
        whole(manifest.offset_mm, "offset_mm"),
        whole(manifest.dot_mm, "dot_mm"),
    )
    width, height = (whole(side, "page_mm", raster.step) for side in item.page_mm)
    x, y = (whole(at - raster.mm(raster.dot / 2), "first_mm") for at in item.first_mm)
    return Layout(raster, (width, height), (x, y), item.size)
