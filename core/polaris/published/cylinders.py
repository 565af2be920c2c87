"""Field of a disc magnet by magpylib, as the paper's templates were made (Polaris 6.2.2)."""

from __future__ import annotations

import magpylib
import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.tag import Magnet

Array = NDArray[np.float64]


def cylinder_fields(magnet: Magnet, sensor_m: Array) -> Array:
    """Fields (2, ..., 3) at positions (..., 3) of the disc magnetised along x and along y.

    A field model of :func:`~locatk.core.polaris.published.templates.templates`.
    """
    size = (magnet.diameter_m, magnet.height_m)
    sources = [
        magpylib.magnet.Cylinder(dimension=size, polarization=polarization)
        for polarization in ((magnet.remanence_t, 0, 0), (0, magnet.remanence_t, 0))
    ]
    return np.asarray(magpylib.getB(sources, sensor_m), float)
