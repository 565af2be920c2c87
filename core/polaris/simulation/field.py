"""Field of simulated tags: discs as finite cylinders, debris, and the Earth.

magpylib integrates the field of the cylinders; the dipoles of the solver are not used. Debris is
small compared with its distance to the sensors, so that a dipole describes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import magpylib
import numpy as np
from numpy.typing import NDArray

from locatk.core.magnetics import MU0_4PI, dipole_field
from locatk.core.polaris.tag import MU0, Magnet

Array = NDArray[np.float64]

MIN_FIELD_T = 1e-10
"""Field below which a source is ignored [T], a thousandth of a count of an MLX90393."""

IRON_SATURATION_A_PER_M = 1.7e6
"""Magnetisation of saturated iron [A/m], 2.15 T / mu0."""

MAX_REMANENCE_A_PER_M = 20e3
"""Largest magnetisation of a magnetised chip of hard steel [A/m]. Coercivities of steel are some
kA/m; a compact body keeps about three times that against its own demagnetising field."""

MIN_SIZE_RATIO = 0.3
"""Diameter of the smallest debris, relative to the largest."""


@dataclass(frozen=True)
class Discs:
    """Magnets as built, all of one kind, with their middles in the plane z = 0.

    Attributes
    ----------
    magnet : Magnet
    tag_id : tuple of int
        Tag of each magnet.
    position_m : (m, 2) ndarray
    angle_rad : (m,) ndarray
        Direction of the north pole, counter-clockwise from the frame's x.
    strength : (m,) ndarray
        Remanence relative to the nominal one of ``magnet``.
    """

    magnet: Magnet
    tag_id: tuple[int, ...]
    position_m: Array
    angle_rad: Array
    strength: Array

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def moment_am2(self) -> Array:
        """Magnetic moments (m,) in A m2."""
        return self.strength * self.magnet.moment


@dataclass(frozen=True)
class Debris:
    """Iron bits on the floor.

    Attributes
    ----------
    position_m, moment_am2 : (n, 3) ndarray
    """

    position_m: Array
    moment_am2: Array

    def __len__(self) -> int:
        return len(self.position_m)


def disc_field(discs: Discs, points_m: Array) -> Array:
    """Return the flux density (..., 3) in tesla of all discs at ``points_m`` (..., 3).

    A disc is ignored at points at which its field is below :data:`MIN_FIELD_T`.
    """
    magnet = discs.magnet
    # The field of a dipole is strongest along its moment.
    range_m = np.cbrt(2 * MU0_4PI * magnet.moment * np.max(discs.strength, initial=0) / MIN_FIELD_T)
    cylinder = magpylib.magnet.Cylinder(
        polarization=(magnet.remanence_t, 0, 0), dimension=(magnet.diameter_m, magnet.height_m)
    )
    points = np.reshape(points_m, (-1, 3))
    field = np.zeros_like(points)
    magnets = zip(discs.position_m, discs.angle_rad, discs.strength, strict=True)
    for position, angle, strength in magnets:
        offset = points - [*position, 0.0]
        in_range = np.einsum("ni,ni->n", offset, offset) < range_m**2
        if in_range.any():
            cos, sin = np.cos(angle), np.sin(angle)
            axes = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            magnet_field = cylinder.getB(offset[in_range] @ axes, squeeze=False).reshape(-1, 3)
            field[in_range] += strength * (magnet_field @ axes.T)
    return field.reshape(np.shape(points_m))


def debris_field(debris: Debris, points_m: Array) -> Array:
    """Return the flux density (..., 3) in tesla of all debris at ``points_m`` (..., 3)."""
    points = np.reshape(points_m, (-1, 3))
    field = np.zeros_like(points)
    ranges_m = np.cbrt(2 * MU0_4PI * np.linalg.norm(debris.moment_am2, axis=1) / MIN_FIELD_T)
    for position, moment, range_m in zip(
        debris.position_m, debris.moment_am2, ranges_m, strict=True
    ):
        offset = points - position
        in_range = np.einsum("ni,ni->n", offset, offset) < range_m**2
        field[in_range] += dipole_field(offset[in_range], moment)
    return field.reshape(np.shape(points_m))


def earth_field(strength_t: float, dip_rad: float, north_rad: float) -> Array:
    """Return the flux density (3,) of the Earth in the frame of the floor.

    It dips by ``dip_rad`` below the horizon; magnetic north is ``north_rad`` counter-clockwise
    from the frame's x.
    """
    horizontal_t = strength_t * np.cos(dip_rad)
    return np.array(
        [
            horizontal_t * np.cos(north_rad),
            horizontal_t * np.sin(north_rad),
            -strength_t * np.sin(dip_rad),
        ]
    )


def scatter_debris(
    discs: Discs,
    low_m: Array,
    high_m: Array,
    count: int,
    diameter_m: float,
    magnetised: float,
    earth_t: Array,
    rng: np.random.Generator,
) -> Debris:
    """Scatter iron bits on the floor, magnetised by the discs and the Earth.

    Parameters
    ----------
    discs : Discs
        Below the bits, without contact.
    low_m, high_m : (2,) ndarray
        Corners of the rectangle of the bits.
    count : int
    diameter_m : float
        Largest diameter; diameters are uniform from :data:`MIN_SIZE_RATIO` of it.
    magnetised : float
        Fraction of the bits that are hard steel with a remanence of up to
        :data:`MAX_REMANENCE_A_PER_M` in a random direction.
    earth_t : (3,) ndarray
    rng : Generator

    Notes
    -----
    A sphere of high permeability takes the moment ``3 V B / mu0`` in a field (Jackson,
    Classical Electrodynamics, 3rd ed., section 5.11), until it is saturated. The fields of the
    bits at each other are neglected.
    """
    diameter = diameter_m * rng.uniform(MIN_SIZE_RATIO, 1.0, count)
    position = np.column_stack(
        [rng.uniform(low_m, high_m, (count, 2)), (discs.magnet.height_m + diameter) / 2]
    )
    volume = np.pi / 6 * diameter**3
    field = disc_field(discs, position) + earth_t
    induced = 3 * volume[:, None] * field / MU0
    induced_norm = np.maximum(np.linalg.norm(induced, axis=1), 1e-30)
    induced *= np.minimum(1.0, IRON_SATURATION_A_PER_M * volume / induced_norm)[:, None]
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    is_hard = rng.random(count) < magnetised
    remanent = is_hard * rng.uniform(0, MAX_REMANENCE_A_PER_M, count) * volume
    return Debris(position, induced + remanent[:, None] * direction)
