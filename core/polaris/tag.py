"""Tags: grids of disc magnets, with all that is known of a user's set of tags.

Frame of a tag: the origin is the middle of the grid, x points from v1 to v2 (the direction of
orientation 0), y from v4 to v1, z up. Cells are counted (column, row) from v1: columns to the
right (-y), rows forward (x), so that v1 = (0, 0), v2 = (0, K - 1), v3 = (K - 1, K - 1) and the
corner that stays empty, v4 = (K - 1, 0): the paper's clockwise order (Polaris, section 5.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cell = tuple[int, int]

MU0 = 4e-7 * math.pi
"""Vacuum permeability in T m/A (the value before 2019; it differs in the tenth digit)."""

MAX_MEANING_CHARACTERS = 40
"""Longest meaning of an id: it is shown in tables of 80 columns and on printed tags."""

CODECS = ("mosk", "redundant", "polaris-released")


@dataclass(frozen=True)
class PlanarPose:
    """Position and heading on the floor.

    Attributes
    ----------
    x_m, y_m : float
    heading_rad : float
        Counter-clockwise from x.
    """

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class Magnet:
    """Disc that is magnetised diametrically.

    Attributes
    ----------
    diameter_m, height_m : float
    remanence_t : float
        Br of the material in tesla.
    grade : str
        Grade under which it is sold, as in ``"N52"``; "" if only the remanence is known.
    """

    diameter_m: float = 2e-3
    height_m: float = 0.5e-3
    remanence_t: float = 1.45
    grade: str = "N52"

    @property
    def moment(self) -> float:
        """Magnetic moment in A m^2: ``Br V / mu0``."""
        return self.remanence_t * math.pi / 4 * self.diameter_m**2 * self.height_m / MU0


@dataclass(frozen=True)
class TagLayout:
    """Magnets that represent one id: the cell and the orientation of each.

    Attributes
    ----------
    cells : tuple of (column, row)
        Row by row from v1, columns ascending in a row.
    symbols : tuple of int
        Orientation 0 .. P - 1 of each, clockwise in steps of 360/P degrees from x.
    """

    cells: tuple[Cell, ...]
    symbols: tuple[int, ...]


@dataclass(frozen=True)
class AsBuiltTag:
    """Deviations of the magnets of one tag from its design, from ``locatk calibrate tag``.

    Attributes
    ----------
    offset_m : (M, 2) ndarray
        From the nominal position to the magnet, in the tag's frame and in the order of the
        layout's cells.
    angle_rad : (M,) ndarray
        From the nominal orientation to the magnet's, counter-clockwise.
    passes : int
        Number of passes that it was estimated from.
    """

    offset_m: Array
    angle_rad: Array
    passes: int = 0


@dataclass(frozen=True)
class Tags:
    """Set of tags of one design: the artifact ``tag.toml``.

    Attributes
    ----------
    order, magnets, orientations : int
        K, M and P of the paper.
    spacing_m : float
        Distance d of neighbouring cells.
    codec : str
        One of :data:`CODECS`.
    magnet : Magnet
    clearance_m : float
        Height of the sensors over the middle of the magnets.
    ids : tuple of int or None
        Members of the family; None if every id of the codec may occur.
    min_distance : int
        Least distance of two members of the family (``families.distance``); 1 if every id may
        occur.
    built : mapping of int to AsBuiltTag
        By id.
    site : mapping of int to PlanarPose
        Poses of the tags on the floor, by id, in the site's frame.
    notes : tuple of str
    meanings : mapping of int to str
        Text that an id stands for, as in ``"stop"``, by id: one line of at most
        :data:`MAX_MEANING_CHARACTERS` printable characters.
    site_sigma : mapping of int to (float, float, float)
        Standard deviations of x and y [m] and of the heading [rad] of the poses in ``site``, by
        id; poses without an entry are exact.
    """

    order: int = 3
    magnets: int = 5
    orientations: int = 8
    spacing_m: float = 0.04
    codec: str = "mosk"
    magnet: Magnet = field(default_factory=Magnet)
    clearance_m: float = 0.01
    ids: tuple[int, ...] | None = None
    min_distance: int = 1
    built: Mapping[int, AsBuiltTag] = field(default_factory=dict)
    site: Mapping[int, PlanarPose] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    meanings: Mapping[int, str] = field(default_factory=dict)
    site_sigma: Mapping[int, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def step_rad(self) -> float:
        """Angle between neighbouring orientations."""
        return math.tau / self.orientations


def vertices(order: int) -> tuple[Cell, Cell, Cell, Cell]:
    """Return the cells of v1, v2, v3 and of v4, which stays empty."""
    last = order - 1
    return (0, 0), (0, last), (last, last), (last, 0)


def free_cells(order: int) -> tuple[Cell, ...]:
    """Return the K^2 - 4 cells that are no corner, row by row from v1."""
    corners = vertices(order)
    cells = [(column, row) for row in range(order) for column in range(order)]
    return tuple(cell for cell in cells if cell not in corners)


def cell_positions(tags: Tags, cells: tuple[Cell, ...]) -> Array:
    """Return the nominal positions (M, 2) of cells in the tag's frame [m]."""
    grid = np.asarray(cells, float).reshape(-1, 2)
    middle = (tags.order - 1) / 2
    return np.column_stack([grid[:, 1] - middle, middle - grid[:, 0]]) * tags.spacing_m


def symbol_angles(tags: Tags, symbols: tuple[int, ...]) -> Array:
    """Return the nominal angles (M,) of symbols in the tag's frame [rad], counter-clockwise."""
    return -tags.step_rad * np.asarray(symbols, float)


def as_built_magnets(tags: Tags, tag_id: int, layout: TagLayout) -> tuple[Array, Array]:
    """Return positions (M, 2) and angles (M,) of the magnets of a tag, in its frame.

    They are those as built if the tag was measured, else those of its design.
    """
    position, angle = cell_positions(tags, layout.cells), symbol_angles(tags, layout.symbols)
    built = tags.built.get(tag_id)
    if built is not None:
        position, angle = position + built.offset_m, angle + built.angle_rad
    return position, angle
