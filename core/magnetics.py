"""Magnetic fields in closed form: point dipoles, and discs magnetised across."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MU0_4PI = 1e-7
"""mu0 / 4 pi in T m/A."""


def dipole_tensor(offsets: ArrayLike) -> Array:
    """Field of unit dipoles: the tensor that takes a moment to its flux density.

    Parameters
    ----------
    offsets : (..., 3) ndarray
        From dipole to sensor, in metres.

    Returns
    -------
    (..., 3, 3) ndarray
        Symmetric and traceless, T / (A m^2); ``nan`` or infinite at the dipole itself.

    Notes
    -----
    Jackson, Classical Electrodynamics, 3rd ed., eq. 5.56.
    """
    r = np.asarray(offsets, float)
    square = np.einsum("...i,...i->...", r, r)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = MU0_4PI / (square * square * np.sqrt(square))
        tensor = 3 * r[..., :, None] * r[..., None, :]
        for axis in range(3):
            tensor[..., axis, axis] -= square
        return np.asarray(tensor * scale[..., None, None])


def dipole_field(offsets: ArrayLike, moments: ArrayLike) -> Array:
    """Flux density (..., 3) in tesla of point dipoles.

    ``offsets`` (..., 3) lead from dipole to sensor in metres, ``moments`` (..., 3) are in
    A m^2 and broadcast against them.
    """
    return np.einsum("...ij,...j->...i", dipole_tensor(offsets), np.asarray(moments, float))
