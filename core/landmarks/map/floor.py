"""Floor of landmarks: the map as designed, and its landmarks as built.

Map frame: x right along the columns, y up along the rows, in metres. Cell (row, column) is at
``origin + pitch * (column, row)``. The axes of designed landmarks are parallel to those of the map.
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

HOLE_CODE = -1
"""Code of a cell without a landmark."""

ALPHABETS = ("6", "16", "compass")
"""What a robot reads of a landmark. ``"6"``: which of the paper's six patterns, equal up to
rotation, it is. ``"16"``: the polarity of each bar. ``"compass"``: the same, but the map has only
three patterns, all in the same orientation, each of which gives the heading."""

WINDOWS = ("L", "I2", "I3", "2x2", "3x3")
"""Names of the windows; their cells are in :data:`.windows.WINDOW_PATHS`."""

STEPS: tuple[Cell, ...] = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""(row, column) of one step at a heading of 0, 1, 2, 3 quarter turns from x."""

MISSING_BAR_STRENGTH = 0.25
"""Relative strength below which the orientation of a bar is unknown: it counts as missing."""


def neighbour(cell: Cell, heading: int) -> Cell:
    """Return the next cell at a heading given in quarter turns."""
    row, column = STEPS[heading % 4]
    return cell[0] + row, cell[1] + column


@dataclass(frozen=True)
class AsBuiltLandmark:
    """Offset from the design, and bar strengths, of one landmark (``locatk calibrate map``).

    Attributes
    ----------
    x_m, y_m : float
        Offset of the landmark's centre from its cell, in the map frame.
    heading_rad : float
        Rotation of the landmark from the axes of the map.
    strength : (4,) ndarray
        Strengths of the bars relative to the nominal one: positive for N, negative for S, 0 for a
        missing bar.
    sigma : (7,) ndarray
        Standard deviations of x, y, heading and the strengths; ``nan`` if unknown.
    visits : int
        Number of visits in the fit.
    flags : tuple of str
        Defects and the bars concerned: ``"flipped:2"``, ``"weak:0"``, ``"missing:3"``,
        ``"displaced"``.
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
    """Floor of landmarks: the artifact ``map.toml``.

    Attributes
    ----------
    codes : (rows, columns) int64 ndarray
        Code of each cell's landmark (:mod:`.landmark`) or :data:`HOLE_CODE`. Row 0 has the
        smallest y.
    pitch_m : float
        Distance of neighbouring cells.
    alphabet : str
        One of :data:`ALPHABETS`.
    window : str
        One of :data:`WINDOWS`: the landmarks after which a robot knows its position.
    detect : int
        Number of misread landmarks of a window that are always detected.
    geometry : Geometry
    origin_m : (float, float)
        Position of cell (0, 0) in the map frame.
    walls : frozenset of (cell, cell)
        Pairs of neighbouring cells between which robots cannot drive, each pair sorted.
    built : mapping of cell to AsBuiltLandmark
    name : str
    seed : int or None
        Seed of the search that generated the map.
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
        """Return the cells that have a landmark, row by row."""
        return [(int(r), int(c)) for r, c in np.argwhere(self.codes != HOLE_CODE)]

    def position(self, cell: Cell) -> tuple[float, float]:
        """Return the nominal position of a cell in the map frame, in metres."""
        x, y = self.origin_m
        return x + self.pitch_m * cell[1], y + self.pitch_m * cell[0]

    def is_passable(self, cell: Cell, heading: int) -> bool:
        """Return whether a robot can drive from ``cell`` to the next one at a heading.

        The heading is in quarter turns. Holes, walls and the border are not passable; ``cell``
        itself may be a hole.
        """
        row, column = neighbour(cell, heading)
        rows, columns = self.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return False
        if self.codes[row, column] == HOLE_CODE:
            return False
        first, second = sorted([cell, (row, column)])
        return (first, second) not in self.walls


def as_built_landmark(floor: FloorMap, cell: Cell) -> tuple[Array, Array]:
    """Return the pose (3,) in the map frame and the signed bar strengths (4,) of a landmark.

    What was not measured is as designed.
    """
    pose = np.array([*floor.position(cell), 0.0])
    strength = signs(floor.codes[cell])
    built = floor.built.get(cell)
    if built is not None:
        pose = pose + [built.x_m, built.y_m, built.heading_rad]
        strength = np.where(np.isfinite(built.strength), built.strength, strength)
    return pose, strength


def as_built_poses(floor: FloorMap) -> Array:
    """Return x, y in metres and heading (n, 3) of the landmarks of :meth:`FloorMap.cells`.

    Landmarks that were not measured have their designed pose.
    """
    return np.array([as_built_landmark(floor, cell)[0] for cell in floor.cells()])


def as_built_codes(floor: FloorMap) -> NDArray[np.int64]:
    """Return the codes (rows, columns) that robots read.

    They differ from the designed codes where bars are flipped. The orientation of a missing bar
    is unknown; its bit is the designed one.
    """
    codes = floor.codes.copy()
    for cell in floor.built:
        codes[cell] = as_built_code(floor, cell)
    return codes


def as_built_code(floor: FloorMap, cell: Cell) -> int:
    """Return the code that robots read in one cell; :data:`HOLE_CODE` outside the map."""
    rows, columns = floor.shape
    if not (0 <= cell[0] < rows and 0 <= cell[1] < columns) or floor.codes[cell] == HOLE_CODE:
        return HOLE_CODE
    built = floor.built.get(cell)
    if built is None:
        return int(floor.codes[cell])
    is_present = np.abs(built.strength) >= MISSING_BAR_STRENGTH  # False if it is nan
    is_north = np.where(is_present, built.strength, signs(floor.codes[cell])) > 0
    return int(is_north @ (1 << np.arange(4)))
