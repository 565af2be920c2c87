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
from locatk.core.landmarks.floor import Cell, FloorMap
from locatk.core.landmarks.landmark import CODES, PATTERN_OF, PATTERNS, Geometry, code_of, signs
from locatk.core.landmarks.simulate_options import Errors, Faults

Array = NDArray[np.float64]

REACH_M = 0.3
"""How far a landmark is felt: a strong one makes 1 uT there, a hundredth of the noise."""


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
    return {cell: _lay_one(floor, cell, errors, faults, seed) for cell in floor.cells()}


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


def _lay_one(floor: FloorMap, cell: Cell, errors: Errors, faults: Faults, seed: int) -> Laid:
    rng = np.random.default_rng([seed, 40, *cell])
    designed = int(floor.codes[cell])
    x, y = floor.place(cell)
    off_x, off_y = rng.normal(0.0, errors.landmark_place_m, 2)
    turned = rng.normal(0.0, errors.landmark_turn_rad)
    strength, middle, axes = scatter_bars(floor.geometry, 1, errors, rng)
    wrong = rng.random() < faults.misread_rate
    code, told = designed, []
    if wrong:
        code = int(rng.choice(_others(floor.alphabet, designed)))
        told.append("misread")
    signed = signs(code) * strength[0]
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
    turn = rotation_exp(np.array([0.0, 0.0, turned]))
    place = np.array([x + off_x, y + off_y, 0.0])
    return Laid(
        cell,
        designed,
        code,
        float(place[0]),
        float(place[1]),
        float(turned),
        signed,
        tuple(told),
        middle[0] @ turn.T + place,
        turn @ axes[0],
    )


def _others(alphabet: str, code: int) -> list[int]:
    """Codes that an installer may lay where he should lay ``code``."""
    if alphabet == "6":
        known = [code_of(letters) for letters in PATTERNS]
        return [other for other in known if PATTERN_OF[other] != PATTERN_OF[code]]
    compass = [code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")]
    return [c for c in (compass if alphabet == "compass" else range(CODES)) if c != code]


def scatter_bars(
    geometry: Geometry, count: int, errors: Errors, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Bars of ``count`` landmarks with the errors of each, in the landmarks' frames.

    Returns strengths (count, 4), middles (count, 4, 3) and rotations (count, 4, 3, 3).
    """
    strength = 1 + rng.normal(0.0, errors.bar_strength, (count, 4))
    angle = np.arange(4) * math.pi / 2
    middle = np.zeros((count, 4, 3))
    middle[..., 0] = geometry.radius_m * np.cos(angle)
    middle[..., 1] = geometry.radius_m * np.sin(angle)
    middle[..., 2] = -geometry.bar_height_m / 2
    middle[..., :2] += rng.normal(0.0, errors.bar_place_m, (count, 4, 2))
    vector = np.zeros((count, 4, 3))
    # Counter-clockwise along the circle: a quarter turn on from where the bar is.
    vector[..., 2] = angle + math.pi / 2 + rng.normal(0.0, errors.bar_turn_rad, (count, 4))
    lean = np.zeros((count, 4, 3))
    lean[..., :2] = rng.normal(0.0, errors.bar_lean_rad, (count, 4, 2))
    return strength, middle, rotation_exp(vector) @ rotation_exp(lean)


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
    for mark, near in zip(laid, tree.query_ball_point(places, REACH_M), strict=True):
        if near:
            each = bar_fields(geometry, mark.middle_m, mark.axes, flat[near][:, None])
            field[near] += each @ mark.strength
    return field.reshape(points.shape[:-1])
