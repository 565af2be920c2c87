"""The tag: a grid of disc magnets, and all that is known of a user's set of tags.

Frame of a tag: its origin is the middle of the grid, x points from v1 to v2 (the
direction of orientation 0), y from v4 to v1, z up. Cells are counted (column, row) from
v1: columns to the right (-y), rows forward (x), so that v1 = (0, 0), v2 = (0, K - 1),
v3 = (K - 1, K - 1) and the corner that stays empty, v4 = (K - 1, 0): the paper's
clockwise order (Polaris section 5.1).
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
"""Vacuum permeability in T m/A, to the nine digits that matter nowhere here."""

CODECS = ("mosk", "redundant", "polaris-released")


@dataclass(frozen=True)
class Magnet:
    """A disc, magnetised across (diametrically).

    Attributes
    ----------
    diameter_m, height_m : float
    remanence_t : float
        Br of the material in tesla.
    grade : str
        As it is bought, ``"N52"``; "" where only the remanence is known.
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
    """What one tag's id means: a magnet's cell and its orientation, magnet by magnet.

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
    """How the magnets of one tag really lie, from ``locatk calibrate tag``.

    Attributes
    ----------
    offset_m : (M, 2) ndarray
        From the cell's place to the magnet, in the tag's frame; in the order of the
        layout's cells.
    angle_rad : (M,) ndarray
        From the nominal orientation to the magnet's, counter-clockwise.
    passes : int
        How many passes it was fitted to.
    """

    offset_m: Array
    angle_rad: Array
    passes: int = 0


@dataclass(frozen=True)
class Placed:
    """Where a tag lies on the floor: metres and radians in the site's frame."""

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class Tags:
    """A set of tags of one design: the artifact ``tag.toml``.

    Attributes
    ----------
    order, magnets, orientations : int
        K, M and P of the paper.
    spacing_m : float
        d: between neighbouring cells.
    codec : str
        One of :data:`CODECS`.
    magnet : Magnet
    clearance_m : float
        From the magnets' middle to the sensors.
    ids : tuple of int or None
        Members of the family; None where every id of the codec may occur.
    min_distance : int
        Between members of the family (``families.distance``); 1 where every id may occur.
    built : mapping of int to AsBuilt
        By id.
    site : mapping of int to Placed
        By id.
    notes : tuple of str
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
    site: Mapping[int, Placed] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def step_rad(self) -> float:
        """Between neighbouring orientations."""
        return math.tau / self.orientations


def vertices(order: int) -> tuple[Cell, Cell, Cell, Cell]:
    """Cells of v1, v2, v3 and of v4, which stays empty."""
    last = order - 1
    return (0, 0), (0, last), (last, last), (last, 0)


def free_cells(order: int) -> tuple[Cell, ...]:
    """The K^2 - 4 cells that are no corner, row by row from v1."""
    corners = vertices(order)
    cells = [(column, row) for row in range(order) for column in range(order)]
    return tuple(cell for cell in cells if cell not in corners)


def places(tags: Tags, cells: tuple[Cell, ...]) -> Array:
    """Nominal places (M, 2) of cells in the tag's frame, in metres."""
    grid = np.asarray(cells, float).reshape(-1, 2)
    middle = (tags.order - 1) / 2
    return np.column_stack([grid[:, 1] - middle, middle - grid[:, 0]]) * tags.spacing_m


def angles(tags: Tags, symbols: tuple[int, ...]) -> Array:
    """Nominal orientations (M,) in the tag's frame: radians, counter-clockwise from x."""
    return -tags.step_rad * np.asarray(symbols, float)


def built_magnets(tags: Tags, tag_id: int, layout: TagLayout) -> tuple[Array, Array]:
    """Places (M, 2) and angles (M,) of the magnets of ``tag_id`` as it was built, where
    that was measured, else as designed."""
    place, angle = places(tags, layout.cells), angles(tags, layout.symbols)
    built = tags.built.get(tag_id)
    if built is not None:
        place, angle = place + built.offset_m, angle + built.angle_rad
    return place, angle
