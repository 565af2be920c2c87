"""Landmarks as they truly lie, and the field of their bars.

magpylib gives the field of each bar as a cuboid in its own place, so that nothing here
shares the closed form of the solvers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import magpylib
import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import rotation_exp
from locatk.core.landmarks.landmark import (
    CODE_COUNT,
    PATTERN_OF,
    PATTERNS,
    Geometry,
    code_of,
    signs,
)
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.options import Errors, Faults
from locatk.core.magnetics import MU0_4PI, dipole_field

Array = NDArray[np.float64]

REACH_M = 0.3
"""How far a landmark is felt: a strong one makes 1 uT there, a hundredth of the noise."""

DIPOLE_LENGTHS = 6
"""Farther than so many of its lengths a bar is a dipole to 0.3 uT, which is quicker."""

BAR_DRAWS = 24
"""Random numbers for the bars of a landmark: of each a strength, a place, a turn, a lean."""


@dataclass(frozen=True)
class Laid:
    """One landmark as it truly lies.

    Attributes
    ----------
    cell : (row, column)
    designed, code : int
        What the map says, and what it was laid as. They differ by a wrong landmark alone;
        flipped and missing bars are in :attr:`strength`.
    x_m, y_m, heading_rad : float
        Place in the map's frame, and from the map's x to the landmark's.
    strength : (4,) ndarray
        Of the bars in units of the nominal one: positive N, negative S, 0 missing.
    faults : tuple of str
        ``"misread"``, ``"flipped:2"``, ``"missing:3"``, ``"displaced"``.
    middle_m : (4, 3) ndarray
        Of the bars, in the map's frame; z is up from the landmark's top faces.
    axes : (4, 3, 3) ndarray
        Rotations of the bars: columns are along (as magnetised, if N), across and up.
    """

    cell: Cell
    designed: int
    code: int
    x_m: float
    y_m: float
    heading_rad: float
    strength: Array
    faults: tuple[str, ...]
    middle_m: Array
    axes: Array


def lay(floor: FloorMap, errors: Errors, faults: Faults, seed: int) -> dict[Cell, Laid]:
    """Lay the landmarks of a map, with errors.

    Each landmark has random numbers of its own: a fault of one leaves the others alone.
    Where the map says how a landmark was built, it lies so, but for the places of its bars.

    Raises
    ------
    InputError
        A fault names a cell that bears no landmark, or a bar that it does not have.
    """
    _check(floor, faults)
    cells = floor.cells()
    rngs = [np.random.default_rng([seed, 40, *cell]) for cell in cells]
    draws = np.array([rng.standard_normal(3 + BAR_DRAWS) for rng in rngs]).reshape(len(rngs), -1)
    strength, middle, axes = scatter_bars(floor.geometry, draws[:, 3:], errors)
    each = zip(cells, rngs, draws[:, :3], strength, middle, axes, strict=True)
    return {cell: _lay_one(floor, cell, errors, faults, *one) for cell, *one in each}


def _check(floor: FloorMap, faults: Faults) -> None:
    cells = set(floor.cells())
    named = [*(cell for cell, _ in faults.flipped), *(cell for cell, _ in faults.missing)]
    for cell in [*named, *(cell for cell, _ in faults.displaced)]:
        if cell not in cells:
            raise InputError(
                f"a fault of cell {cell[0]},{cell[1]}, where the map has no landmark",
                hint=f"Name row,column of a map of {floor.shape[0]} x {floor.shape[1]} cells",
            )
    for cell, bar in (*faults.flipped, *faults.missing):
        if not 0 <= bar < 4:
            raise InputError(
                f"a fault of bar {bar} of cell {cell[0]},{cell[1]}", hint="Bars are 0 to 3"
            )


def _lay_one(
    floor: FloorMap,
    cell: Cell,
    errors: Errors,
    faults: Faults,
    rng: np.random.Generator,
    draws: Array,
    strength: Array,
    middle: Array,
    axes: Array,
) -> Laid:
    """The landmark of a cell, of bars in its own frame and draws for its place and turn."""
    designed = int(floor.codes[cell])
    x, y = floor.place(cell)
    off_x, off_y = draws[:2] * errors.landmark_place_m
    turned = float(draws[2] * errors.landmark_turn_rad)
    wrong = rng.random() < faults.misread_rate
    code, told = designed, []
    if wrong:
        code = int(rng.choice(_others(floor.alphabet, designed)))
        told.append("misread")
    signed = signs(code) * strength
    built = floor.built.get(cell)
    if built is not None and not wrong:
        off_x, off_y, turned = built.x_m, built.y_m, built.heading_rad
        signed = np.where(np.isfinite(built.strength), built.strength, signed)
    for bar in range(4):
        if (cell, bar) in faults.flipped:
            signed[bar] *= -1
            told.append(f"flipped:{bar}")
        if (cell, bar) in faults.missing:
            signed[bar] = 0.0
            told.append(f"missing:{bar}")
    for where, (dx, dy) in faults.displaced:
        if where == cell:
            off_x, off_y = off_x + dx, off_y + dy
            told.append("displaced")
    cos, sin = math.cos(turned), math.sin(turned)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    place = np.array([x + off_x, y + off_y, 0.0])
    return Laid(
        cell,
        designed,
        code,
        float(place[0]),
        float(place[1]),
        turned,
        signed,
        tuple(told),
        middle @ turn.T + place,
        turn @ axes,
    )


def _others(alphabet: str, code: int) -> list[int]:
    """Codes that an installer may lay where he should lay ``code``."""
    if alphabet == "6":
        known = [code_of(letters) for letters in PATTERNS]
        return [other for other in known if PATTERN_OF[other] != PATTERN_OF[code]]
    compass = [code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")]
    return [c for c in (compass if alphabet == "compass" else range(CODE_COUNT)) if c != code]


def scatter_bars(geometry: Geometry, draws: Array, errors: Errors) -> tuple[Array, Array, Array]:
    """Bars of landmarks with the errors of each, in the landmarks' frames.

    ``draws`` are :data:`BAR_DRAWS` standard normal numbers (count, 24) for each landmark.
    Returns strengths (count, 4), middles (count, 4, 3) and rotations (count, 4, 3, 3).
    """
    count = len(draws)
    spread = np.split(draws.reshape(count, 4, BAR_DRAWS // 4), [1, 3, 4], axis=-1)
    angle = np.arange(4) * math.pi / 2
    middle = np.zeros((count, 4, 3))
    middle[..., 0] = geometry.radius_m * np.cos(angle)
    middle[..., 1] = geometry.radius_m * np.sin(angle)
    middle[..., 2] = -geometry.bar_height_m / 2
    middle[..., :2] += errors.bar_place_m * spread[1]
    turn = np.zeros((count, 4, 3))
    # Counter-clockwise along the circle: a quarter turn on from where the bar is.
    turn[..., 2] = angle + math.pi / 2 + errors.bar_turn_rad * spread[2][..., 0]
    lean = np.zeros((count, 4, 3))
    lean[..., :2] = errors.bar_lean_rad * spread[3]
    strength = 1 + errors.bar_strength * spread[0][..., 0]
    return strength, middle, rotation_exp(turn) @ rotation_exp(lean)


def bar_fields(geometry: Geometry, middle: ArrayLike, axes: ArrayLike, points: ArrayLike) -> Array:
    """Upright field (...) in tesla of bars of nominal strength, each at its own points.

    Parameters
    ----------
    geometry : Geometry
    middle : (..., 3) ndarray
        Of the bars; broadcast with ``points``.
    axes : (..., 3, 3) ndarray
    points : (..., 3) ndarray
        In the same frame.
    """
    axes = np.asarray(axes, float)
    offset = np.asarray(points, float) - middle
    local = np.einsum("...ij,...i->...j", axes, offset)
    bar = magpylib.magnet.Cuboid(
        polarization=(geometry.remanence_t, 0, 0),
        dimension=(geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m),
    )
    own = np.asarray(bar.getB(local.reshape(-1, 3), squeeze=False)).reshape(local.shape)
    return np.asarray(np.einsum("...j,...j->...", axes[..., 2, :], own))


def dipole_fields(
    geometry: Geometry, middle: ArrayLike, axes: ArrayLike, points: ArrayLike
) -> Array:
    """The same as :func:`bar_fields` of dipoles in the bars' middles."""
    volume = geometry.bar_length_m * geometry.bar_width_m * geometry.bar_height_m
    size = geometry.remanence_t * volume / (4 * math.pi * MU0_4PI)
    moment = size * np.asarray(axes, float)[..., :, 0]
    return dipole_field(np.asarray(points, float) - middle, moment)[..., 2]


def floor_field(geometry: Geometry, landmarks: Iterable[Laid], points: Array) -> Array:
    """Upright field (...) in tesla of all landmarks at points (..., 3) of the map's frame.

    A landmark counts where it is nearer than :data:`REACH_M`.
    """
    from scipy.spatial import cKDTree

    flat = points.reshape(-1, 3)
    field = np.zeros(len(flat))
    laid = list(landmarks)
    if not laid or not len(flat):
        return field.reshape(points.shape[:-1])
    tree = cKDTree(flat[:, :2])
    places = [(mark.x_m, mark.y_m) for mark in laid]
    close_m = DIPOLE_LENGTHS * geometry.bar_length_m
    for mark, near in zip(laid, tree.query_ball_point(places, REACH_M), strict=True):
        where = np.asarray(near, np.int64)
        far = np.hypot(*(flat[where, :2] - [mark.x_m, mark.y_m]).T) > close_m
        for some, fields in ((where[far], dipole_fields), (where[~far], bar_fields)):
            if len(some):
                each = fields(geometry, mark.middle_m, mark.axes, flat[some][:, None])
                field[some] += each @ mark.strength
    return field.reshape(points.shape[:-1])
