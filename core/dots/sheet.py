"""Printed sheets: the area of the pattern on each paper, and the papers on a floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

MM_PER_INCH = 25.4

DOT_OFFSET_PITCHES = 1 / 6
"""Distance of a dot from its grid position [pitches] (Hostettler et al. 2016, III-A.1)."""


@dataclass(frozen=True)
class Sheet:
    """Printed area of the pattern.

    Attributes
    ----------
    id : str
        Printed in the margin; unique within a manifest.
    origin : (x, y)
        Grid coordinates of the upper left dot.
    size : (columns, rows)
    section : (u, v)
    page_mm : (width, height)
        Of the paper.
    first_mm : (x, y)
        From the paper's upper left corner right and down to the grid position of the upper left
        dot, as sent to the printer.
    position_mm : (x, y) or None
        Tiles: position of the paper's lower left corner on the floor.
    heading_deg : float
        Tiles: rotation of the paper on the floor, counter-clockwise.
    """

    id: str
    origin: tuple[int, int]
    size: tuple[int, int]
    section: tuple[int, int]
    page_mm: tuple[float, float]
    first_mm: tuple[float, float]
    position_mm: tuple[float, float] | None = None
    heading_deg: float = 0.0


@dataclass(frozen=True)
class Manifest:
    """Sheets of one print job, with the parameters of the print.

    Attributes
    ----------
    sheets : tuple of Sheet
    codec : str
    pitch_mm : float
        Distance of two grid positions, as sent to the printer.
    dot_mm : float
        Width of a dot.
    offset_mm : float
        From a grid position to its dot.
    dpi : int
    scale : (x, y)
        Measured over nominal length on the paper, along its width and height: 1.002 if 100 mm are
        printed as 100.2 mm.
    notes : tuple of str
    """

    sheets: tuple[Sheet, ...]
    codec: str = "anoto"
    pitch_mm: float = 0.508
    dot_mm: float = 0.508 / 6
    offset_mm: float = 0.508 / 6
    dpi: int = 300
    scale: tuple[float, float] = (1.0, 1.0)
    notes: tuple[str, ...] = ()

    def frame(self, number: int) -> str:
        """Return the name of the coordinate frame of poses on sheet ``number``.

        It is ``"floor"`` for tiles, whose positions on it are known, and else the sheet's id.
        """
        sheet = self.sheets[number]
        return sheet.id if sheet.position_mm is None else "floor"

    def find(self, grid: ArrayLike, section: ArrayLike, *, slack: float = 0.0) -> NDArray[np.intp]:
        """Return the number of the sheet that contains each position, or of the nearest one.

        Parameters
        ----------
        grid : (n, 2) array_like
            Grid coordinates, with fractions.
        section : (n, 2) array_like
            Each 0..62; -1 if unknown, which then matches any.
        slack : float
            Pitches by which a position may be outside the sheet: the middle of a frame at its
            border is.

        Returns
        -------
        (n,) intp ndarray
            -1 if no sheet is within ``slack``.
        """
        position, sections = np.asarray(grid, float), np.asarray(section)
        number_of = np.full(len(position), -1, np.intp)
        least_outside = np.full(len(position), np.inf)
        for number, sheet in enumerate(self.sheets):
            low = np.array(sheet.origin)
            high = low + np.array(sheet.size) - 1
            beyond = np.maximum(np.maximum(low - position, position - high), 0)
            outside = beyond.max(axis=1, initial=0)
            matches = ((sections == np.array(sheet.section)) | (sections == -1)).all(axis=1)
            better = matches & (outside <= slack) & (outside < least_outside)
            number_of[better], least_outside[better] = number, outside[better]
        return number_of

    def to_metres(self, number: int, grid: ArrayLike) -> NDArray[np.float64]:
        """Return positions on sheet ``number`` in metres in its frame, x right, y up.

        The origin is the paper's lower left corner, or that of the floor if the sheet is a tile.
        ``grid`` (..., 2) are grid coordinates. The result (..., 2) is corrected by :attr:`scale`.
        """
        sheet = self.sheets[number]
        on_paper = (np.asarray(grid, float) - sheet.origin) * self.pitch_mm + sheet.first_mm
        on_paper[..., 1] = sheet.page_mm[1] - on_paper[..., 1]
        on_paper *= self.scale
        if sheet.position_mm is not None:
            c, s = (f(math.radians(sheet.heading_deg)) for f in (math.cos, math.sin))
            on_paper = on_paper @ np.array([[c, s], [-s, c]]) + sheet.position_mm
        result: NDArray[np.float64] = on_paper * 1e-3
        return result

    def jacobian(self, number: int) -> NDArray[np.float64]:
        """Return the derivative (2, 2) of :meth:`to_metres`, in metres per pitch."""
        axes = self.to_metres(number, np.array([[0, 0], [1, 0], [0, 1]]))
        result: NDArray[np.float64] = (axes[1:] - axes[0]).T
        return result
