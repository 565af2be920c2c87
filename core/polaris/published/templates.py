"""Templates: what one sensor sees as it passes a magnet, for a grid of lateral offsets and
orientations (Polaris section 6.2.2, Fig. 13)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.magnetics import dipole_tensor
from locatk.core.polaris.tag import Magnet, Tags

Array = NDArray[np.float64]

OFFSETS = 5
"""Lateral offsets of the grid (8.3.1)."""

ORIENTATIONS = 36
"""Orientations of the grid: 10 degrees are enough for eight symbols (6.2.2)."""

POINTS = 80
"""Samples of a template (8.3.1)."""


@dataclass(frozen=True)
class Templates:
    """A template set of N passes of T samples.

    Attributes
    ----------
    lateral_m : (N,) ndarray
        How far the sensor passes to the left of the magnet.
    angle_rad : (N,) ndarray
        Direction of the moment, counter-clockwise from the direction of travel.
    field_t : (N, T, 3) ndarray
        Flux density in the array's axes, sample by sample.
    """

    lateral_m: Array
    angle_rad: Array
    field_t: Array


def template_set(
    tags: Tags, orientations: int = ORIENTATIONS, points: int = POINTS, offsets: int = OFFSETS
) -> Templates:
    """The paper's template set for a tag: ``offsets * orientations`` templates.

    They reach a spacing before and behind the magnet, as the 80 points of 8.3.1 do at 1 mm
    a sample. The offsets span a quarter of a spacing to either side, as those of the
    released set do: sensors are half a spacing apart (6.2.3), so that the nearest passes
    within a quarter. (The text of 6.2.2 has half a spacing, in the same number of steps:
    with it, a moment across the track is taken for its opposite.) Eq. 2 counts 360 degrees
    beside 0; here the circle has one of them.
    """
    return templates(
        tags.magnet,
        tags.clearance_m,
        along_m=np.linspace(-1, 1, points) * tags.spacing_m,
        lateral_m=np.linspace(-1, 1, offsets) * tags.spacing_m / 4,
        angle_rad=np.linspace(0.0, math.tau, orientations, endpoint=False),
    )


def templates(
    magnet: Magnet,
    clearance_m: float,
    along_m: Array,
    lateral_m: Array,
    angle_rad: Array,
    model: Literal["dipole", "cylinder"] = "dipole",
) -> Templates:
    """Field of a magnet along straight passes over it.

    Parameters
    ----------
    magnet : Magnet
    clearance_m : float
        From the magnet's middle up to the sensor.
    along_m : (T,) ndarray
        Places of the sensor along the track, from the magnet on.
    lateral_m : (L,) ndarray
        Places of the track to the left of the magnet.
    angle_rad : (A,) ndarray
        Directions of the moment, counter-clockwise from the track.
    model : {"dipole", "cylinder"}
        The point dipole, or magpylib's cylinder: they differ by 1.4 % of the peak for a
        2 x 0.5 mm disc at 10 mm, and by more the nearer the sensor is.

    Returns
    -------
    Templates
        A L of them, the lateral offset changing faster.

    Notes
    -----
    The disc is round, so turning its moment combines two fields linearly: those of a moment
    along and of one across the track.
    """
    lateral, along = np.meshgrid(lateral_m, along_m, indexing="ij")
    sensor = np.stack([along, lateral, np.full_like(along, clearance_m)], axis=-1)
    if model == "dipole":
        basis = np.moveaxis(dipole_tensor(sensor)[..., :2], -1, 0) * magnet.moment
    else:
        basis = _cylinder_fields(magnet, sensor)
    turn = np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    return Templates(
        lateral_m=np.tile(lateral_m, len(angle_rad)),
        angle_rad=np.repeat(angle_rad, len(lateral_m)),
        field_t=(turn @ basis.reshape(2, -1)).reshape(-1, len(along_m), 3),
    )


def _cylinder_fields(magnet: Magnet, sensor: Array) -> Array:
    """Fields (2, ..., 3) of the disc magnetised along x and along y."""
    import magpylib

    size = (magnet.diameter_m, magnet.height_m)
    sources = [
        magpylib.magnet.Cylinder(dimension=size, polarization=polarization)
        for polarization in ((magnet.remanence_t, 0, 0), (0, magnet.remanence_t, 0))
    ]
    return np.asarray(magpylib.getB(sources, sensor), float)
