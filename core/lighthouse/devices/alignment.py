"""Alignment of a scene and of trajectories of rigid devices with markers on which they rested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.scene import Marker
from locatk.core.lighthouse.scene.frame import MAX_MARKER_MISFIT_M
from locatk.core.lighthouse.scene.reframing import median_position
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MIN_MARKERS = 3
"""Minimum number of visited markers that determine a frame."""


@dataclass(frozen=True)
class MarkerAlignment:
    """Similarity transform from the frame of an estimated scene to that of its markers.

    Attributes
    ----------
    transform : Similarity
    misfit_m : float
        Rms distance of the markers from the transformed positions of the devices, in metres.
    visits : int
        Number of visits during which a device has poses.
    """

    transform: Similarity
    misfit_m: float
    visits: int


def align_to_markers(
    markers: Sequence[Marker], trajectories: Sequence[Trajectory]
) -> MarkerAlignment | None:
    """Estimate the transform from devices that rested on markers to the frame of the markers.

    It includes the scale: markers are farther from each other than the photodiodes of a device.
    None if fewer than ``MIN_MARKERS`` visits have a pose, or if they are collinear.
    """
    marker_positions, device_positions = [], []
    for marker in markers:
        for visit in marker.visits:
            position = median_position(trajectories, visit)
            if position is not None:
                marker_positions.append(marker.position)
                device_positions.append(position)
    if len(marker_positions) < MIN_MARKERS:
        return None
    try:
        transform = umeyama(np.stack(device_positions), np.stack(marker_positions))
    except DegenerateError:
        return None
    offset = transform.apply(device_positions) - marker_positions
    misfit_m = float(np.sqrt(np.mean(np.sum(offset**2, axis=1))))
    return MarkerAlignment(transform, misfit_m, len(marker_positions))


def alignment_warnings(alignment: MarkerAlignment | None) -> list[SolverWarning]:
    """Return the doubts about an alignment; None stands for too few markers."""
    if alignment is None:
        return [
            SolverWarning(
                "too_few_markers",
                f"a device rested on fewer than {MIN_MARKERS} markers that are not on one line: "
                "the frame is not that of the markers",
            )
        ]
    if alignment.misfit_m > MAX_MARKER_MISFIT_M:
        return [
            SolverWarning(
                "marker_misfit",
                f"the markers are {1e3 * alignment.misfit_m:.0f} mm (rms) from the positions of "
                "the device on them: a marker was measured wrong, or the scene is wrong",
            )
        ]
    return []
