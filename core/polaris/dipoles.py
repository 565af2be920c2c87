"""The field of a tag's magnets along a pass, and how it changes with where they are.

Each axis of a sensor is converted at its own moment, so that the array stands a little
elsewhere for each: offsets have a leading dimension of three, one for each axis of the
field.
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
    """From each magnet to each sensor, sample by sample, for each axis of the field.

    Attributes
    ----------
    r : (3, 3, n, N, M) ndarray
        First the axis of the field, then the component: metres.
    """

    r: Array

    @classmethod
    def of(cls, along: Array, across: Array, height: float) -> Offsets:
        """``along`` (3, n, 1 or N, M), ``across`` (1 or n, N, M), both in metres."""
        shape = np.broadcast_shapes(along.shape, (1, *across.shape))
        r = np.empty((3, 3, *shape[1:]))
        r[:, 0], r[:, 1], r[:, 2] = along, across, height
        return cls(r)

    def unit_fields(self, thickness: float = 0.0) -> Array:
        """Fields (3, 3, n, N, M) of unit moments: axis of the field, axis of the moment."""
        r = self.r
        square = (r * r).sum(axis=1)
        inverse = 1.0 / square
        scale = MU0_4PI * inverse * inverse / np.sqrt(square)
        own = r[_AXES, _AXES]  # the component along the field's own axis
        fields = 3.0 * own[:, None] * r
        fields[_AXES, _AXES] -= square
        if thickness:
            fields += thickness * self._second(own, inverse, square)
        return fields * scale[:, None]

    def _second(self, own: Array, inverse: Array, square: Array) -> Array:
        """Second derivative along z of the unit fields, times r^5 / (mu0 / 4 pi)."""
        r = self.r
        z = r[:, 2]
        flat = z * z * inverse
        factor = 105.0 * flat - 15.0
        second = (factor * inverse * own)[:, None] * r
        # The Kronecker deltas of the fourth derivative of 1/r.
        second[_AXES, _AXES] += 3.0 - 15.0 * flat
        second[:, 2] -= 30.0 * z * inverse * own
        second[2] -= (30.0 * z[2] * inverse[2]) * r[2]
        second[2, 2] += 6.0
        return second

    def gradients(self, moments: Array) -> Array:
        """Derivatives (3, 3, n, N, M) of each magnet's field by the offset's components.

        ``moments`` is (M, 3) in A m^2; first the axis of the field, then the component.
        """
        r = self.r
        square = (r * r).sum(axis=1)
        scale = 3.0 * MU0_4PI / (square * square * np.sqrt(square))
        dot = np.einsum("ajnkm,mj->ankm", r, moments)
        own = r[_AXES, _AXES]
        along = np.moveaxis(moments, 0, -1)  # (3, M)
        gradients = r * (along[:, None, None, None] - (5.0 * own * dot / square)[:, None])
        gradients += own[:, None] * along[None, :, None, None]
        gradients[_AXES, _AXES] += dot
        return gradients * scale[:, None]


_AXES = np.arange(3)
