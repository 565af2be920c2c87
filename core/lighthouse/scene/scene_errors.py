"""Effect of the uncertain stations of a scene on positions and poses.

Errors of stations shift all fixes at one position alike; no averaging reduces them. They are
propagated to first order. If the angles of planes k change by ``h_k d`` with the parameters d of
the stations, and by ``g_k`` with the position, the estimated position changes by
``-(sum g g^T)^-1 sum g_k h_k d``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import skew
from locatk.core.lighthouse.calibration import predict_sweeps
from locatk.core.lighthouse.motion.parameters import (
    GIVEN_POSITION_SIGMA_M,
    GIVEN_ROTATION_SIGMA_RAD,
)
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.model import JOINT_PARAMETERS

if TYPE_CHECKING:
    # Reports import this module, and the designed frame needs scipy.
    from locatk.core.lighthouse.scene.designed_frame import DesignedFrame

Array = NDArray[np.float64]

CELL_M = 0.25
"""Edge of the cells in whose centre the effect is computed [m]. It changes over metres."""

MAX_CELLS = 4096
"""Largest number of cells that are kept."""

POSE_PARAMETERS = 6
"""Position and rotation vector of a station."""


class SceneErrors:
    """Covariances of positions and poses by the stations of a scene.

    Parameters
    ----------
    scene : Scene
    stations : sequence of Station
        Those of the scene, in the order of their indices here.
    floor_z : float, optional
        Height of all photodiodes, if they move on a plane.
    frame : DesignedFrame, optional
        Frame of a designed room, whose uncertainty is added.

    Attributes
    ----------
    has_calibration : bool
        True if the covariance of the scene contains the errors of the calibrations.

    Notes
    -----
    Stations without a covariance have that of the offline solver
    (:mod:`locatk.core.lighthouse.motion.parameters`). A floor homography has no pose, and no
    errors here.
    """

    def __init__(
        self,
        scene: Scene,
        stations: Sequence[Station],
        floor_z: float | None,
        frame: DesignedFrame | None = None,
    ) -> None:
        self._frame = frame
        self._stations = tuple(stations)
        self._dims = 3 if floor_z is None else 2
        self._floor_z = floor_z
        self._cells: dict[tuple[int, ...], Array] = {}
        self.has_calibration = scene.covariance is not None
        n = len(stations)
        self._covariance = np.zeros((n * JOINT_PARAMETERS, n * JOINT_PARAMETERS))
        order = [scene.stations.index(station) for station in stations]
        rows = np.concatenate([k * JOINT_PARAMETERS + np.arange(JOINT_PARAMETERS) for k in order])
        if scene.covariance is not None:
            self._covariance = scene.covariance[np.ix_(rows, rows)]
            return
        sigma = np.repeat([GIVEN_POSITION_SIGMA_M, GIVEN_ROTATION_SIGMA_RAD], 3)
        for k, station in enumerate(stations):
            pose = slice(k * JOINT_PARAMETERS, k * JOINT_PARAMETERS + POSE_PARAMETERS)
            given = station.covariance
            if station.floor_map is not None:
                given = np.zeros((POSE_PARAMETERS, POSE_PARAMETERS))
            self._covariance[pose, pose] = np.diag(sigma**2) if given is None else given

    def position_covariance(self, position: Sequence[float], members: Sequence[int]) -> Array:
        """Return the covariance (3, 3) of a position that both planes of some stations determine.

        It is zero if they do not determine one.
        """
        cell = tuple(round(x / CELL_M) for x in position)
        key = (*cell, -1, *members)
        if key not in self._cells:
            if len(self._cells) >= MAX_CELLS:
                self._cells.clear()
            centre = np.array(cell) * CELL_M
            if self._floor_z is not None:
                centre[2] = self._floor_z
            self._cells[key] = self._propagate(centre, members)
            if self._frame is not None:
                self._cells[key] += self._frame.pose_covariance(centre[None])[0, :3, :3]
        return self._cells[key]

    def _propagate(self, position: Array, members: Sequence[int]) -> Array:
        gradient = np.zeros((2 * len(members), 3))
        by_scene = np.zeros((2 * len(members), len(self._covariance)))
        for k, member in enumerate(members):
            station = self._stations[member]
            offset = position - station.position
            local = np.repeat((offset @ station.rotation)[None], 2, axis=0)
            with np.errstate(invalid="ignore", divide="ignore"):
                _, by_point, by_calibration = predict_sweeps(
                    local, np.arange(2), station.calibration
                )
            rows = slice(2 * k, 2 * k + 2)
            g = gradient[rows] = by_point @ station.rotation.T
            column = member * JOINT_PARAMETERS
            by_scene[rows, column : column + 3] = -g
            by_scene[rows, column + 3 : column + 6] = -np.cross(offset, g)
            for plane in (0, 1):
                first = column + POSE_PARAMETERS + 7 * plane
                by_scene[2 * k + plane, first : first + 7] = by_calibration[plane]
        result = np.zeros((3, 3))
        g = gradient[:, : self._dims]
        information = g.T @ g
        if np.all(np.isfinite(by_scene)) and np.linalg.cond(information) < 1e12:
            shift = np.linalg.solve(information, g.T @ by_scene)
            result[: self._dims, : self._dims] = shift @ self._covariance @ shift.T
        return result

    def pose_covariance(self, position: Array, members: Sequence[int]) -> Array:
        """Return the covariance (6, 6) of the pose of a rigid device under some stations.

        Its position is that of a photodiode if there are two stations or more, and its rotation
        the mean of those of the stations. A single station moves the device like a part of itself.
        """
        cell = tuple(round(x / CELL_M) for x in position.tolist())
        key = (*cell, -2, *members)
        if key not in self._cells:
            moved = np.zeros((6, len(self._covariance)))
            for member in members:
                column = member * JOINT_PARAMETERS
                offset = np.array(cell) * CELL_M - self._stations[member].position
                moved[:3, column : column + 3] = np.eye(3)
                moved[:3, column + 3 : column + 6] = -skew(offset)
                moved[3:, column + 3 : column + 6] = np.eye(3)
            moved /= len(members)
            covariance = moved @ self._covariance @ moved.T
            if len(members) > 1:
                covariance[:3, 3:] = covariance[3:, :3] = 0.0
                covariance[:3, :3] = self.position_covariance(position.tolist(), members)
            if self._frame is not None:
                of_frame = self._frame.pose_covariance(np.array(cell)[None] * CELL_M)[0]
                if len(members) > 1:
                    of_frame[:3, :3] = 0.0  # It is in that of the position.
                covariance += of_frame
            if len(self._cells) >= MAX_CELLS:
                self._cells.clear()
            self._cells[key] = covariance
        return self._cells[key]
