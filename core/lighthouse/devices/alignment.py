"""Alignment of a scene and of trajectories of rigid devices with markers on which they rested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.motion.frames import common_motions
from locatk.core.lighthouse.scene import Marker
from locatk.core.lighthouse.scene.frame import MAX_MARKER_MISFIT_M
from locatk.core.lighthouse.scene.reframing import median_position
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MARKER_SIGMA_M = 3e-3
"""Standard deviation of each coordinate of a marker measured with a tape, and of a device on it."""

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
    position : (visits, 3) ndarray
        The markers of these visits.
    """

    transform: Similarity
    misfit_m: float
    visits: int
    position: Array

    def add_uncertainty(self, trajectory: Trajectory) -> Trajectory:
        """Add the uncertainty of the frame to the covariance of aligned poses.

        It is that of the similarity by the errors of the markers: :data:`MARKER_SIGMA_M` before
        the alignment, pooled with its misfit.
        """
        centre = self.position.mean(axis=0)
        visits = common_motions(self.position - centre).reshape(-1, 7)
        squares = 3 * MARKER_SIGMA_M**2 + self.visits * self.misfit_m**2
        variance = squares / (3 + max(3 * self.visits - 7, 0))
        covariance = variance * np.linalg.pinv(visits.T @ visits)
        motions = np.zeros((len(trajectory), 6, 7))
        motions[:, :3] = common_motions(trajectory.position - centre)
        motions[:, range(3, 6), range(3, 6)] = 1.0
        return replace(
            trajectory, covariance=trajectory.covariance + motions @ covariance @ motions.mT
        )


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
    return align_points(
        np.reshape(np.array(device_positions), (-1, 3)),
        np.reshape(np.array(marker_positions), (-1, 3)),
    )


def align_points(source: Array, markers: Array) -> MarkerAlignment | None:
    """Align points (k, 3) with the markers at which they are, as :func:`align_to_markers`.

    Points that are ``nan`` are left out.
    """
    is_known = np.isfinite(source).all(axis=1)
    source, markers = source[is_known], markers[is_known]
    if len(markers) < MIN_MARKERS:
        return None
    try:
        transform = umeyama(source, markers)
    except DegenerateError:
        return None
    offset = transform.apply(source) - markers
    misfit_m = float(np.sqrt(np.mean(np.sum(offset**2, axis=1))))
    return MarkerAlignment(transform, misfit_m, len(markers), markers)


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
