"""Sheets: which area of the pattern was printed where on a paper, and paper on a floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

MM_PER_INCH = 25.4

OFFSET = 1 / 6
"""How far a dot lies from its place, in pitches (papers/dots.txt III-A.1)."""


@dataclass(frozen=True)
class Sheet:
    """One printed area of the pattern.

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
        From the paper's upper left corner right and down to the place of the upper left
        dot, as it was sent to the printer.
    position_mm : (x, y) or None
        Tiles: where the paper's lower left corner lies on the floor.
    heading_deg : float
        Tiles: how far the paper is turned on the floor, counter-clockwise.
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
    """All sheets of one print job, and how they were printed.

    Attributes
    ----------
    sheets : tuple of Sheet
    codec : str
    pitch_mm : float
        Between two places, as it was sent to the printer.
    dot_mm : float
        Width of a dot.
    offset_mm : float
        From a place to its dot.
    dpi : int
    scale : (x, y)
        Measured over nominal length on the paper, along its width and height: 1.002 where
        the printer makes 100.2 mm of 100 mm.
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
        """Name of the frame in which poses on sheet ``number`` are given.

        ``"floor"`` for tiles, whose places on it are known; else the sheet's id.
        """
        sheet = self.sheets[number]
        return sheet.id if sheet.position_mm is None else "floor"

    def find(self, grid: ArrayLike, section: ArrayLike, *, slack: float = 0.0) -> NDArray[np.intp]:
        """Number of the sheet that holds each place, else the nearest; -1 where none is near.

        Parameters
        ----------
        grid : (n, 2) array_like
            Grid coordinates, with fractions.
        section : (n, 2) array_like
            Each 0..62; -1 where it is not known, which then fits any.
        slack : float
            Pitches by which a place may lie outside: the middle of a frame on the rim.
        """
        at, sections = np.asarray(grid, float), np.asarray(section)
        found = np.full(len(at), -1, np.intp)
        nearest = np.full(len(at), np.inf)
        for number, sheet in enumerate(self.sheets):
            low = np.array(sheet.origin)
            high = low + np.array(sheet.size) - 1
            outside = np.maximum(np.maximum(low - at, at - high), 0).max(axis=1, initial=0)
            fits = ((sections == np.array(sheet.section)) | (sections == -1)).all(axis=1)
            better = fits & (outside <= slack) & (outside < nearest)
            found[better], nearest[better] = number, outside[better]
        return found

    def to_metres(self, number: int, grid: ArrayLike) -> NDArray[np.float64]:
        """Places on sheet ``number`` as metres in its frame, x right, y up.

        The origin is the paper's lower left corner, or the floor's where the sheet is a
        tile. ``grid`` is (..., 2) in grid coordinates; so is the answer, in metres,
        corrected by :attr:`scale`.
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
        """(2, 2) derivative of :meth:`to_metres`, in metres a pitch."""
        axes = self.to_metres(number, np.array([[0, 0], [1, 0], [0, 1]]))
        result: NDArray[np.float64] = (axes[1:] - axes[0]).T
        return result
