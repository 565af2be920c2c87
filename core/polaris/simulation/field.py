"""The field over a floor with tags: discs as finite cylinders, and debris around them.

magpylib integrates the cylinders exactly, so that nothing here shares the solver's
dipoles. Debris is small against its distance, and a dipole by right.
"""

from __future__ import annotations

from dataclasses import dataclass

import magpylib
import numpy as np
from numpy.typing import NDArray

from locatk.core.magnetics import MU0_4PI, dipole_field
from locatk.core.polaris.tag import MU0, Magnet

Array = NDArray[np.float64]

LEAST_T = 1e-10
"""Where a source is weaker than this it is left out: a thousandth of a sensor's count."""

IRON_SATURATION = 1.7e6
"""Magnetisation of saturated iron, A/m (2.15 T / mu0)."""

REMANENT_MAGNETISATION = 20e3
"""Of a chip of hard steel that was magnetised, A/m: coercivities of steel are some kA/m,
and a compact body keeps about three times that against its own demagnetising field."""

LEAST_SIZE = 0.3
"""Of the smallest debris, as a share of the largest."""


@dataclass(frozen=True)
class Discs:
    """Magnets as they truly lie, all of one kind, their middles in the plane z = 0.

    Attributes
    ----------
    magnet : Magnet
    tag_id : tuple of int
        To which tag each belongs.
    place_m : (m, 2) ndarray
    angle_rad : (m,) ndarray
        From the frame's x to north, counter-clockwise.
    strength : (m,) ndarray
        Remanence, as a share of the magnet's.
    """

    magnet: Magnet
    tag_id: tuple[int, ...]
    place_m: Array
    angle_rad: Array
    strength: Array

    def __len__(self) -> int:
        return len(self.place_m)

    @property
    def moment_am2(self) -> Array:
        """Magnetic moments (m,)."""
        return self.strength * self.magnet.moment


@dataclass(frozen=True)
class Debris:
    """Small iron on the floor.

    Attributes
    ----------
    place_m, moment_am2 : (n, 3) ndarray
    """

    place_m: Array
    moment_am2: Array

    def __len__(self) -> int:
        return len(self.place_m)


def disc_field(discs: Discs, points_m: Array) -> Array:
    """Flux density (..., 3) in tesla of all discs at ``points_m`` (..., 3).

    A disc counts where it makes at least :data:`LEAST_T`.
    """
    magnet = discs.magnet
    # Of the strongest axis: a dipole's field along its moment.
    reach = np.cbrt(2 * MU0_4PI * magnet.moment * np.max(discs.strength, initial=0) / LEAST_T)
    cylinder = magpylib.magnet.Cylinder(
        polarization=(magnet.remanence_t, 0, 0), dimension=(magnet.diameter_m, magnet.height_m)
    )
    points = np.reshape(points_m, (-1, 3))
    field = np.zeros_like(points)
    for place, angle, strength in zip(discs.place_m, discs.angle_rad, discs.strength, strict=True):
        offset = points - [*place, 0.0]
        near = np.einsum("ni,ni->n", offset, offset) < reach**2
        if near.any():
            cos, sin = np.cos(angle), np.sin(angle)
            axes = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            own = cylinder.getB(offset[near] @ axes, squeeze=False).reshape(-1, 3)
            field[near] += strength * (own @ axes.T)
    return field.reshape(np.shape(points_m))


def debris_field(debris: Debris, points_m: Array) -> Array:
    """Flux density (..., 3) in tesla of all debris at ``points_m`` (..., 3)."""
    points = np.reshape(points_m, (-1, 3))
    field = np.zeros_like(points)
    reach = np.cbrt(2 * MU0_4PI * np.linalg.norm(debris.moment_am2, axis=1) / LEAST_T)
    for place, moment, far in zip(debris.place_m, debris.moment_am2, reach, strict=True):
        offset = points - place
        near = np.einsum("ni,ni->n", offset, offset) < far**2
        field[near] += dipole_field(offset[near], moment)
    return field.reshape(np.shape(points_m))


def earth_field(strength_t: float, dip_rad: float, north_rad: float) -> Array:
    """Flux density (3,) of the Earth where it dips by ``dip_rad`` under the horizon, with
    magnetic north at ``north_rad`` counter-clockwise from the frame's x."""
    level = strength_t * np.cos(dip_rad)
    return np.array(
        [level * np.cos(north_rad), level * np.sin(north_rad), -strength_t * np.sin(dip_rad)]
    )


def scatter(
    discs: Discs,
    low_m: Array,
    high_m: Array,
    count: int,
    diameter_m: float,
    magnetised: float,
    earth_t: Array,
    rng: np.random.Generator,
) -> Debris:
    """Iron bits on the floor, magnetised by all that is around them.

    Parameters
    ----------
    discs : Discs
        They lie under the bits, which never touch them.
    low_m, high_m : (2,) ndarray
        Corners of the rectangle over which they are strewn.
    count : int
    diameter_m : float
        Of the largest; sizes are even from :data:`LEAST_SIZE` of it.
    magnetised : float
        Share of the bits that are hard steel and keep a magnetisation of up to
        :data:`REMANENT_MAGNETISATION`, any way.
    earth_t : (3,) ndarray
    rng : Generator

    Notes
    -----
    A sphere of high permeability takes the moment ``3 V B / mu0`` in a field (Jackson,
    Classical Electrodynamics, 3rd ed., section 5.11), until it is saturated. What bits do
    to each other is left out.
    """
    diameter = diameter_m * rng.uniform(LEAST_SIZE, 1.0, count)
    place = np.column_stack(
        [rng.uniform(low_m, high_m, (count, 2)), (discs.magnet.height_m + diameter) / 2]
    )
    volume = np.pi / 6 * diameter**3
    field = disc_field(discs, place) + earth_t
    induced = 3 * volume[:, None] * field / MU0
    size = np.linalg.norm(induced, axis=1)
    induced *= np.minimum(1.0, IRON_SATURATION * volume / np.maximum(size, 1e-30))[:, None]
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    hard = rng.random(count) < magnetised
    kept = hard * rng.uniform(0, REMANENT_MAGNETISATION, count) * volume
    return Debris(place, induced + kept[:, None] * way)
