"""Magnetic fields of point dipoles in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MU0_4PI = 1e-7
"""Vacuum permeability over 4 pi, in T m/A (1e-7 to within 2e-10 in the SI of 2019)."""


def dipole_tensor(offsets: ArrayLike) -> Array:
    """Return the tensors that map the moments of dipoles to their flux density.

    Parameters
    ----------
    offsets : (..., 3) ndarray
        Vectors from dipole to sensor, in metres.

    Returns
    -------
    (..., 3, 3) ndarray
        Symmetric and traceless, in T / (A m^2); ``nan`` or infinite at the dipole itself.

    Notes
    -----
    Jackson, Classical Electrodynamics, 3rd ed., eq. 5.56.
    """
    r = np.asarray(offsets, float)
    squared_distance = np.einsum("...i,...i->...", r, r)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = MU0_4PI / (squared_distance * squared_distance * np.sqrt(squared_distance))
        tensor = 3 * r[..., :, None] * r[..., None, :]
        for axis in range(3):
            tensor[..., axis, axis] -= squared_distance
        return np.asarray(tensor * scale[..., None, None])


def dipole_field(offsets: ArrayLike, moments: ArrayLike) -> Array:
    """Return the flux density (..., 3) of point dipoles, in tesla.

    ``offsets`` (..., 3) lead from dipole to sensor, in metres; ``moments`` (..., 3) are in A m^2.
    Both broadcast against each other.
    """
    return np.einsum("...ij,...j->...i", dipole_tensor(offsets), np.asarray(moments, float))
