"""The field of a tag's magnets along a pass, and how it changes with where they are.

Each axis of a sensor is converted at its own moment, so that the array stands a little
elsewhere for each: the offset along the track has an entry for each axis of the field,
those across it and upward do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.magnetics import MU0_4PI
from locatk.core.polaris.tag import Magnet

Array = NDArray[np.float64]


def thickness(magnet: Magnet | None) -> float:
    """How far a disc's field is from a point dipole's, in m^2.

    Averaged over a disc of radius a and height l, the dipole field f becomes
    ``f + (a^2/8) (f_xx + f_yy) + (l^2/24) f_zz`` to second order, and since f is harmonic
    ``f + (l^2/24 - a^2/8) f_zz``: the factor is what this returns. For a 2 x 0.5 mm disc
    it is worth 1.4 % at 10 mm, and leaves less than 0.05 %.
    """
    if magnet is None:
        return 0.0
    return magnet.height_m**2 / 24 - magnet.diameter_m**2 / 32


@dataclass(frozen=True)
class Offsets:
    """From M magnets to N sensors at n samples, in metres.

    Attributes
    ----------
    x : (N, 3, n, M) ndarray
        Along the track, for each axis of the field.
    y : (N, 1, n or 1, M) ndarray
        Across it.
    z : float
        Upward.
    inverse : (N, 3, n, M) ndarray
        One over the square of the distance.
    scale : (N, 3, n, M) ndarray
        ``mu0 / 4 pi`` over its fifth power.
    """

    x: Array
    y: Array
    z: float
    inverse: Array
    scale: Array

    @classmethod
    def of(cls, x: Array, y: Array, z: float) -> Offsets:
        """``x`` (N, 3, n, M), ``y`` (N, 1, n or 1, M) and ``z``."""
        inverse = 1.0 / (x * x + (y * y + z * z))
        return cls(x, y, z, inverse, MU0_4PI * inverse * inverse * np.sqrt(inverse))

    def own(self) -> Array:
        """The offset's component (N, 3, n, M) along each axis of the field."""
        own = np.empty_like(self.x)
        own[:, 0] = self.x[:, 0]
        own[:, 1] = self.y[:, 0]
        own[:, 2] = self.z
        return own

    def unit_fields(self, thickness: float = 0.0) -> Array:
        """Fields (N, 3, n, M, 3) of unit moments, whose axis comes last.

        Second derivatives of 1/r; with ``thickness`` (m^2) the fourth ones along z too.
        """
        own = self.own()
        leading = 3.0 * own * self.scale
        diagonal = -1.0 / self.inverse
        if thickness:
            flat = self.z * self.z * self.inverse
            leading *= 1.0 + thickness * self.inverse * (35.0 * flat - 5.0)
            diagonal += thickness * (3.0 - 15.0 * flat)
        fields = np.empty((*self.x.shape, 3))
        fields[..., 0] = leading * self.x
        fields[..., 1] = leading * self.y
        fields[..., 2] = leading * self.z
        diagonal = diagonal * self.scale
        if thickness:
            upward = 30.0 * thickness * self.z * self.inverse * self.scale
            fields[..., 2] -= upward * own
            fields[:, 2, ..., 0] -= upward[:, 2] * self.x[:, 2]
            fields[:, 2, ..., 1] -= upward[:, 2] * self.y[:, 0]
            fields[:, 2, ..., 2] -= upward[:, 2] * self.z
            fields[:, 2, ..., 2] += 6.0 * thickness * self.scale[:, 2]
        for axis in range(3):
            fields[:, axis, ..., axis] += diagonal[:, axis]
        return fields

    def gradients(self, moments: Array) -> tuple[Array, Array, Array]:
        """Derivatives, each (N, 3, n, M), of the magnets' fields along x, y and z.

        ``moments`` is (M, 3) in A m^2. Of point dipoles: the thickness changes a step of
        the fit by a hundredth, and nothing where it ends.
        """
        mx, my, mz = moments.T
        own = self.own()
        scale = 3.0 * self.scale
        dot = self.x * mx + (self.y * my + self.z * mz)
        parallel = moments.T[:, None] - 5.0 * own * dot * self.inverse
        found = []
        for axis, (component, moment) in enumerate(((self.x, mx), (self.y, my), (self.z, mz))):
            gradient = component * parallel + own * moment
            gradient[:, axis] += dot[:, axis]
            gradient *= scale
            found.append(gradient)
        return found[0], found[1], found[2]
