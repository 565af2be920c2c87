"""The floor: which landmark lies in which cell, and how it was really laid.

Map frame: x right along the columns, y up along the rows, in metres; cell (row, column) is
at ``origin + pitch * (column, row)``. Landmarks lie with their axes along the map's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import Geometry, signs

Array = NDArray[np.float64]
Cell = tuple[int, int]
Wall = tuple[Cell, Cell]

HOLE = -1

ALPHABETS = ("6", "16", "compass")
"""What of a landmark is read: its pattern; its pattern and orientation; the same of the
three patterns that tell the heading alone, all laid in one orientation."""

WINDOWS = ("L", "I2", "I3", "2x2", "3x3")

STEPS: tuple[Cell, ...] = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""(row, column) of one step under the heading of 0, 1, 2, 3 quarter turns from x."""


def neighbour(cell: Cell, heading: int) -> Cell:
    """The next cell in a heading of so many quarter turns."""
    row, column = STEPS[heading % 4]
    return cell[0] + row, cell[1] + column


@dataclass(frozen=True)
class AsBuiltLandmark:
    """How one landmark really lies, from ``locatk calibrate map``.

    Attributes
    ----------
    x_m, y_m : float
        From the cell's place to the landmark's centre, in the map's frame.
    heading_rad : float
        From the map's x to the landmark's.
    strength : (4,) ndarray
        Of the bars in units of the nominal one, signed as the bar really lies: positive N,
        negative S, 0 missing.
    sigma : (7,) ndarray
        Standard deviations of x, y, heading and the strengths; ``nan`` where unknown.
    visits : int
        How many visits it was fitted to.
    flags : tuple of str
        ``"flipped:2"``, ``"weak:0"``, ``"missing:3"``, ``"displaced"``: what is wrong, of
        which bar.
    """

    x_m: float
    y_m: float
    heading_rad: float
    strength: Array
    sigma: Array
    visits: int = 0
    flags: tuple[str, ...] = ()


@dataclass(frozen=True)
class FloorMap:
    """A floor of landmarks: the artifact ``map.toml``.

    Attributes
    ----------
    codes : (rows, columns) int64 ndarray
        How the landmark of each cell is laid (:mod:`.landmark`); :data:`HOLE` where there
        is none. Row 0 is at the least y.
    pitch_m : float
        Between neighbouring cells.
    alphabet : str
        One of :data:`ALPHABETS`.
    window : str
        One of :data:`WINDOWS`: after which landmarks a robot knows where it is.
    detect : int
        How many misread landmarks of a window are always noticed.
    geometry : Geometry
    origin_m : (float, float)
        Place of cell (0, 0) in the map's frame.
    walls : frozenset of (cell, cell)
        Pairs of neighbouring cells between which no robot can go, each sorted.
    built : mapping of cell to AsBuilt
    name : str
    seed : int or None
        With which the map was found.
    notes : tuple of str
    """

    codes: NDArray[np.int64]
    pitch_m: float = 0.2
    alphabet: str = "16"
    window: str = "L"
    detect: int = 0
    geometry: Geometry = field(default_factory=Geometry)
    origin_m: tuple[float, float] = (0.0, 0.0)
    walls: frozenset[Wall] = frozenset()
    built: Mapping[Cell, AsBuiltLandmark] = field(default_factory=dict)
    name: str = ""
    seed: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.codes.shape[0]), int(self.codes.shape[1])

    def cells(self) -> list[Cell]:
        """Cells that bear a landmark, row by row."""
        return [(int(r), int(c)) for r, c in np.argwhere(self.codes != HOLE)]

    def place(self, cell: Cell) -> tuple[float, float]:
        """Nominal place of a cell in the map's frame, in metres."""
        x, y = self.origin_m
        return x + self.pitch_m * cell[1], y + self.pitch_m * cell[0]

    def open(self, cell: Cell, heading: int) -> bool:
        """Whether a robot at ``cell`` can go one cell on under ``heading`` quarter turns."""
        row, column = neighbour(cell, heading)
        rows, columns = self.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return False
        if self.codes[row, column] == HOLE:
            return False
        one, other = sorted([cell, (row, column)])
        return (one, other) not in self.walls


def laid_mark(floor: FloorMap, cell: Cell) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pose (3,) in the map's frame and signed strengths (4,) of a landmark, as built as far as
    that is known."""
    pose = np.array([*floor.place(cell), 0.0])
    strength = signs(floor.codes[cell])
    built = floor.built.get(cell)
    if built is not None:
        pose = pose + [built.x_m, built.y_m, built.heading_rad]
        strength = np.where(np.isfinite(built.strength), built.strength, strength)
    return pose, strength
