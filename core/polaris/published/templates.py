"""Templates: the field that one sensor measures as it passes a magnet, for a grid of lateral
offsets and orientations (Polaris section 6.2.2, Fig. 13)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_tensor
from locatk.core.polaris.tag import Magnet, Tags

Array = NDArray[np.float64]

MAX_ORIENTATIONS = 3600
"""Steps of a tenth of a degree, far below the error of a magnet that was placed by hand."""

MAX_OFFSETS = 101
"""Steps of 0.2 mm over the +-10 mm of the paper's array, whose sensors are 20 mm apart."""

MIN_POINTS = 5
"""The alignment compares first derivatives; a shorter window holds fewer than three of them."""

MAX_POINTS = 1000

MAX_SET_SAMPLES = 5_000_000
"""Samples of a whole set, which then needs 120 MB."""


@dataclass(frozen=True)
class TemplateGrid:
    """Resolution of a template set; the defaults are the paper's (section 8.3.1).

    Attributes
    ----------
    orientations : int
        Directions of the moment over the full circle: 360 degrees / ``res_theta`` of Eq. 2,
        which counts 360 degrees beside 0. 36 are enough for eight symbols (6.2.2).
    offsets : int
        Lateral offsets: ``d / res_d + 1`` of Eq. 2. A single one is the sensor's path over
        the magnet's middle.
    points : int
        Samples of a template, and of the window that is aligned with it.

    Raises
    ------
    InputError
        A number is outside its range, or the set is too large.
    """

    orientations: int = 36
    offsets: int = 5
    points: int = 80

    def __post_init__(self) -> None:
        for name, value, lowest, highest in (
            ("orientations", self.orientations, 2, MAX_ORIENTATIONS),
            ("offsets", self.offsets, 1, MAX_OFFSETS),
            ("points", self.points, MIN_POINTS, MAX_POINTS),
        ):
            if not lowest <= value <= highest:
                raise InputError(
                    f"templates with {value} {name}", hint=f"Give {lowest} to {highest} {name}"
                )
        samples = self.orientations * self.offsets * self.points
        if samples > MAX_SET_SAMPLES:
            raise InputError(
                f"a template set of {samples:,} samples is too large",
                hint=f"Keep orientations x offsets x points below {MAX_SET_SAMPLES:,}",
            )


@dataclass(frozen=True)
class Templates:
    """A template set of N passes of T samples.

    Attributes
    ----------
    lateral_m : (N,) ndarray
        Distance at which the sensor passes to the left of the magnet.
    angle_rad : (N,) ndarray
        Direction of the moment, counter-clockwise from the direction of travel.
    field_t : (N, T, 3) ndarray
        Flux density in the array's axes, sample by sample.
    """

    lateral_m: Array
    angle_rad: Array
    field_t: Array


def dipole_fields(magnet: Magnet, sensor_m: Array) -> Array:
    """Fields (2, ..., 3) at positions (..., 3) of point dipoles along x and along y."""
    return np.moveaxis(dipole_tensor(sensor_m)[..., :2], -1, 0) * magnet.moment


def template_set(
    tags: Tags,
    max_offset_m: float,
    grid: TemplateGrid | None = None,
    fields: Callable[[Magnet, Array], Array] = dipole_fields,
) -> Templates:
    """Return the template set for a tag, ``grid.offsets * grid.orientations`` templates.

    Parameters
    ----------
    tags : Tags
        Spacing, clearance and magnet are used.
    max_offset_m : float
        Largest lateral offset, to either side.
    grid : TemplateGrid, optional
    fields : callable, optional
        Field model, see :func:`templates`.

    Returns
    -------
    Templates
        Each extends one spacing before and behind the magnet, as the 80 points of section
        8.3.1 do at 1 mm per sample and a spacing of 40 mm.
    """
    grid = grid or TemplateGrid()
    side = np.linspace(-1, 1, grid.offsets) if grid.offsets > 1 else np.zeros(1)
    return templates(
        tags.magnet,
        tags.clearance_m,
        along_m=np.linspace(-1, 1, grid.points) * tags.spacing_m,
        lateral_m=side * max_offset_m,
        angle_rad=np.linspace(0.0, math.tau, grid.orientations, endpoint=False),
        fields=fields,
    )


def templates(
    magnet: Magnet,
    clearance_m: float,
    along_m: Array,
    lateral_m: Array,
    angle_rad: Array,
    fields: Callable[[Magnet, Array], Array] = dipole_fields,
) -> Templates:
    """Compute the field of a magnet along straight passes over it.

    Parameters
    ----------
    magnet : Magnet
    clearance_m : float
        From the magnet's middle up to the sensor.
    along_m : (T,) ndarray
        Positions of the sensor along its path, relative to the magnet.
    lateral_m : (L,) ndarray
        Offsets of the path to the left of the magnet.
    angle_rad : (A,) ndarray
        Directions of the moment, counter-clockwise from the path.
    fields : callable, optional
        Field model: :func:`dipole_fields`, or
        :func:`~locatk.core.polaris.published.cylinders.cylinder_fields`. They differ by 1.4 %
        of the peak for a 2 x 0.5 mm disc at 10 mm, and by more at a smaller clearance.

    Returns
    -------
    Templates
        ``A * L`` of them; the lateral offset changes faster.

    Notes
    -----
    The disc is round, so the field of any direction is a linear combination of two: those of
    a moment along and of one across the path.
    """
    lateral, along = np.meshgrid(lateral_m, along_m, indexing="ij")
    basis = fields(magnet, np.stack([along, lateral, np.full_like(along, clearance_m)], axis=-1))
    direction = np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    return Templates(
        lateral_m=np.tile(lateral_m, len(angle_rad)),
        angle_rad=np.repeat(angle_rad, len(lateral_m)),
        field_t=(direction @ basis.reshape(2, -1)).reshape(-1, len(along_m), 3),
    )
