"""Change of the frame of a solution: its scene and its trajectories together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import (
    Similarity,
    quaternion_from_matrix,
    quaternion_multiply,
    rotation_exp,
    transform_covariance,
)
from locatk.core.lighthouse.scene.model import MarkerVisit, Scene
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory, has_orientation

Array = NDArray[np.float64]


def transform_solution(solution: Solution, to: Similarity, scene: Scene) -> Solution:
    """Transform a solution to the frame and scale of ``scene``, its transformed artifact."""
    trajectories = tuple(
        transform_trajectory(trajectory, to, scene.frame) for trajectory in solution.trajectories
    )
    return replace(solution, artifact=scene, trajectories=trajectories)


def transform_trajectory(trajectory: Trajectory, to: Similarity, frame: str) -> Trajectory:
    """Transform a trajectory into another frame.

    Points without orientation keep the identity. The distances of the photodiodes on a device do
    not change: the scale differs from 1 by less than 1 %, or a warning reports that the markers do
    not fit.
    """
    position = to.apply(trajectory.position)
    if np.any(has_orientation(trajectory)):
        return replace(
            trajectory,
            frame=frame,
            position=position,
            quaternion=quaternion_multiply(
                quaternion_from_matrix(to.rotation), trajectory.quaternion
            ),
            covariance=transform_covariance(trajectory.covariance, to.scale, to.rotation),
        )
    # The unknown covariance of the orientation must not spread to that of the position.
    covariance = np.full_like(trajectory.covariance, np.nan)
    own = trajectory.covariance[:, :3, :3]
    covariance[:, :3, :3] = to.scale**2 * to.rotation @ own @ to.rotation.T
    return replace(trajectory, frame=frame, position=position, covariance=covariance)


def median_position(trajectories: Sequence[Trajectory], visit: MarkerVisit) -> Array | None:
    """Return the median position (3,) of a device during a visit; None without a pose."""
    for trajectory in trajectories:
        if trajectory.device == visit.device:
            start_ns, end_ns = visit.start_ns or 0, visit.end_ns or 0
            is_inside = (trajectory.time_ns >= start_ns) & (trajectory.time_ns <= end_ns)
            if np.any(is_inside):
                return np.asarray(np.median(trajectory.position[is_inside], axis=0))
    return None


def rotation_between(source: Array, target: Array) -> Array:
    """Return the smallest rotation (3, 3) that maps a unit vector (3,) to another."""
    axis = np.cross(source, target)
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        if source @ target > 0:
            return np.eye(3)
        # Opposite vectors: half a turn about any axis across them.
        axis = np.cross(source, np.eye(3)[int(np.argmin(np.abs(source)))])
        return rotation_exp(np.pi * axis / np.linalg.norm(axis))
    return rotation_exp(axis / length * float(np.arctan2(length, source @ target)))
