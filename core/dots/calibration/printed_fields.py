"""One field of a test sheet, as it was printed: which dots are there, and how well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.printed_lattice import Cut, Lattice
from locatk.core.dots.drawing.test_sheet import Field, PrinterSheet

Floats = NDArray[np.float64]

TOO_COARSE = 4.8
"""Pixels a pitch of the picture, below which it says nothing of the printer."""

SHIFTS = 6
"""Places by which the markers may mislead."""

AGREES = 0.6
"""Share of right symbols by which a field is known; any other area agrees in a quarter."""

FEWEST = 40
"""Dots by which a field is known."""

PRESENT = 0.3
"""Ink of a dot that is there, as a part of a usual one of its field."""

FAINTEST = 0.01
"""Darkness below which nothing is a dot."""

WORST = 0.01
"""Quantile of the places at which the margin is taken."""


@dataclass(frozen=True)
class FieldScore:
    """How well a field was printed.

    Attributes
    ----------
    name : str
    dot_px, pitch_px : int
        In pixels of the printer.
    dot_mm, pitch_mm : float
    dots : int
        How many there ought to be.
    scan_px : float
        Pixels of the picture a pitch.
    judged : bool
        Whether the picture is fine enough to say anything.
    read : bool
        Whether the field was recognised by what it says.
    found : float
        Share of the places that have a dot.
    right : float
        Share of the places whose dot says what it ought to.
    wrong_bits : int
        Bits that the dots say wrong, two a dot.
    margin : float
        How much darker the right spot is than the darkest of the other three, in parts of
        full black; at the worst hundredth of the places.
    scatter : float
        Rms distance of the dots from where they ought to be, along an axis, in pitches; nan
        where the field was not read.
    gain : float
        Ink of a dot over that of its nominal area; nan where the field was not read.
    centre_mm, centre_px : (x, y)
        A point of the sheet in the middle of the field, in mm from the page's upper left
        corner, and where the dots say that it is in the picture.
    """

    name: str
    dot_px: int
    pitch_px: int
    dot_mm: float
    pitch_mm: float
    dots: int
    scan_px: float
    judged: bool
    read: bool
    found: float
    right: float
    wrong_bits: int
    margin: float
    scatter: float
    gain: float
    centre_mm: tuple[float, float]
    centre_px: tuple[float, float]


def score_field(
    image: NDArray[np.uint8], to_image: Floats, sheet: PrinterSheet, field: Field, black: float
) -> FieldScore:
    """Score one field.

    Parameters
    ----------
    image : (height, width) uint8 ndarray
    to_image : (3, 3) ndarray
        From mm on the page (from its upper left corner to the right and down) to px.
    sheet : PrinterSheet
    field : Field
    black : float
        Grey value of full black in the image.
    """
    cut = Cut.of(image, to_image, sheet, field)
    expected = sheet.symbols(field)
    nothing = _score(field, cut, judged=cut.native >= TOO_COARSE)
    if not nothing.judged:
        return nothing
    ink = cut.ink(black)
    lattice = Lattice(cut, ink)
    spots, empty = lattice.ink()
    present = _present(spots, empty)
    symbols = spots.argmax(axis=2)
    shift = _shift(symbols, present, expected)
    if shift is None:
        return _score(field, cut, found=float(present.mean()))
    lattice.move(shift)
    # Twice, as the first lattice knows the dots by their mean only.
    for _ in range(2):
        spots, empty = lattice.ink()
        present = _present(spots, empty)
        symbols = spots.argmax(axis=2)
        right = present & (symbols == expected)
        if right.sum() < FEWEST:
            return _score(field, cut, found=float(present.mean()))
        off = lattice.refine(ink, symbols, right, float(np.median(empty)))
    of_right = np.take_along_axis(spots, expected[..., None].astype(int), axis=2)[..., 0]
    others = spots.copy()
    np.put_along_axis(others, expected[..., None].astype(int), -np.inf, axis=2)
    margin = of_right - others.max(axis=2)
    bits = np.bitwise_count((symbols.astype(np.uint8) ^ expected)[present]).sum()
    return _score(
        field,
        cut,
        read=float(right.sum()) >= AGREES * max(1, int(present.sum())),
        found=float(present.mean()),
        right=float(right.mean()),
        wrong_bits=int(bits),
        margin=float(np.quantile(margin, WORST)),
        scatter=float(np.sqrt((off**2).mean())),
        gain=lattice.gain(ink, symbols, right, field.dot_mm / field.pitch_mm),
        centre=lattice.centre(),
    )


def _score(
    field: Field,
    cut: Cut,
    *,
    judged: bool = True,
    read: bool = False,
    found: float = 0.0,
    right: float = 0.0,
    wrong_bits: int = 0,
    margin: float = 0.0,
    scatter: float = float("nan"),
    gain: float = float("nan"),
    centre: Floats | None = None,
) -> FieldScore:
    raster, (columns, rows) = field.layout.raster, field.layout.size
    at = cut.middle if centre is None else centre
    seen = cut.to_picture(at)
    middle = cut.to_page(cut.middle)
    return FieldScore(
        name=field.name,
        dot_px=raster.dot,
        pitch_px=raster.pitch,
        dot_mm=field.dot_mm,
        pitch_mm=field.pitch_mm,
        dots=columns * rows,
        scan_px=cut.native,
        judged=judged,
        read=read,
        found=found,
        right=right,
        wrong_bits=wrong_bits,
        margin=margin,
        scatter=scatter,
        gain=gain,
        centre_mm=(float(middle[0]), float(middle[1])),
        centre_px=(float(seen[0]), float(seen[1])),
    )


def _present(spots: Floats, empty: Floats) -> NDArray[np.bool_]:
    """Which places have a dot: one that is darker than bare paper ever is."""
    bare = float(np.median(empty))
    noise = 1.4826 * float(np.median(np.abs(empty - bare)))
    ink = spots.max(axis=2) - bare
    usual = float(np.quantile(ink, 0.9))
    return ink > max(5 * noise, PRESENT * usual, FAINTEST)


def _shift(
    symbols: NDArray[np.intp], present: NDArray[np.bool_], expected: NDArray[np.uint8]
) -> NDArray[np.intp] | None:
    """How many (columns, rows) further the first place really is; None for another area."""
    rows, columns = expected.shape
    best, found = 0, None
    for down in range(-SHIFTS, SHIFTS + 1):
        for right in range(-SHIFTS, SHIFTS + 1):
            seen = _span(down, rows), _span(right, columns)
            meant = _span(-down, rows), _span(-right, columns)
            there = present[seen]
            agreed = int((there & (symbols[seen] == expected[meant])).sum())
            if agreed > best and agreed >= max(FEWEST, AGREES * int(there.sum())):
                best, found = agreed, np.array([right, down], np.intp)
    return found


def _span(shift: int, count: int) -> slice:
    return slice(max(0, shift), count + min(0, shift))
