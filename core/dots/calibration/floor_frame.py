"""Frame of a floor as built, and its sheets in it.

A fit leaves open what of a displacement is the pose of a sheet and what is an error of its print.
Here, the rigid part of the displacements of a sheet (least squares over its nodes) becomes part of
its pose. The frame of the floor is that in which the datum sheet, defined in this way, has the pose
that it has in the manifest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.floor_fit import (
    FloorFit,
    cell_quarters,
    field_weights,
    node_positions,
    unresolved_variance,
)
from locatk.core.dots.sheet import Distortion
from locatk.core.geometry import rotation_matrix_2d, wrap_angle

Array = NDArray[np.float64]

MIN_MAPPED_FRAMES = 10
"""Least number of poses with truth on a sheet whose errors of the print are mapped."""


@dataclass(frozen=True)
class BuiltSheet:
    """Sheet as built.

    Attributes
    ----------
    number : int
        In the manifest.
    id : str
    pose : (3,) ndarray
        Position of the paper's lower left corner [mm] and heading [rad] on the floor.
    covariance : (3, 3) ndarray
        Of the pose, relative to the datum.
    shift : (3,) ndarray
        Difference from the pose in the manifest; nan if that has none.
    seam_frames, truth_frames : int
        Number of frames that were used.
    distortion : Distortion or None
    distortion_sigma_mm : (x, y)
        Standard deviation of the errors of the print that are not in the map.
    distortion_sigma_rad : float
        Standard deviation of the local rotation by these errors.
    """

    number: int
    id: str
    pose: Array
    covariance: Array
    shift: Array
    seam_frames: int
    truth_frames: int
    distortion: Distortion | None
    distortion_sigma_mm: tuple[float, float]
    distortion_sigma_rad: float

    @property
    def sigma(self) -> Array:
        """Standard deviations (3,) of the pose."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))


def build_sheets(fit: FloorFit) -> tuple[BuiltSheet, ...]:
    """Return the sheets of a floor in its frame."""
    layout, manifest = fit.problem.layout, fit.problem.manifest
    poses, maps = [], []
    for number in layout.sheets:
        pose, by_unknowns = _rigid_pose(fit, number)
        poses.append(pose)
        maps.append(by_unknowns)
    datum = fit.problem.pose(layout.sheets[0], fit.state)
    built = []
    for number, pose, by_unknowns in zip(layout.sheets, poses, maps, strict=True):
        in_frame, derivative = _in_datum(pose, by_unknowns, poses[0], maps[0], datum)
        sheet = manifest.sheets[number]
        truth_frames = sum(
            len(truth.time_ns) for truth in fit.problem.truths if truth.number == number
        )
        is_mapped = truth_frames >= MIN_MAPPED_FRAMES
        nominal = np.full(3, np.nan)
        if sheet.position_mm is not None:
            nominal = np.array([*sheet.position_mm, math.radians(sheet.heading_deg)])
        shift = in_frame - nominal
        shift[2] = wrap_angle(shift[2])
        built.append(
            BuiltSheet(
                number,
                sheet.id,
                in_frame,
                derivative @ fit.covariance @ derivative.T,
                shift,
                sum(number in seam.numbers for seam in fit.problem.seams),
                truth_frames,
                *_distortion(fit, number, is_mapped),
            )
        )
    return tuple(built)


def _rigid_part(fit: FloorFit, number: int) -> tuple[Array, Array]:
    """Return the operators from a field (2 nodes) to its rigid part (3), and back.

    The rigid part is a shift and a rotation about the corner of the paper; the field is x, then y.
    """
    points = node_positions(fit.problem.manifest, number, fit.problem.layout.nodes[number])
    basis = np.zeros((2, len(points), 3))
    basis[0, :, 0] = basis[1, :, 1] = 1
    basis[0, :, 2], basis[1, :, 2] = -points[:, 1], points[:, 0]
    flat = basis.reshape(-1, 3)
    return np.asarray(np.linalg.pinv(flat)), flat


def _rigid_pose(fit: FloorFit, number: int) -> tuple[Array, Array]:
    """Return the pose of a sheet with the rigid part of its field, and derivatives (3, size)."""
    problem = fit.problem
    pose = problem.pose(number, fit.state).copy()
    derivative = np.zeros((3, problem.layout.size))
    index = problem.layout.pose(number)
    if index is not None:
        derivative[:, index] = np.eye(3)
    if number in problem.layout.nodes:
        to_floor = np.eye(3)
        to_floor[:2, :2] = rotation_matrix_2d(pose[2])
        operator, _ = _rigid_part(fit, number)
        unknowns = problem.layout.field(number).ravel()
        derivative[:, unknowns] = to_floor @ operator
        pose += to_floor @ operator @ fit.state[unknowns]
    return pose, derivative


def _in_datum(
    pose: Array, by_unknowns: Array, datum_pose: Array, datum_by_unknowns: Array, datum: Array
) -> tuple[Array, Array]:
    """Return a pose in the frame in which the datum sheet has the pose ``datum``."""
    angle = datum[2] - datum_pose[2]
    rotation = rotation_matrix_2d(angle)
    offset = rotation @ (pose[:2] - datum_pose[:2])
    by_angle = np.array([-offset[1], offset[0]])
    derivative = np.empty_like(by_unknowns)
    derivative[:2] = rotation @ (by_unknowns[:2] - datum_by_unknowns[:2])
    derivative[:2] -= by_angle[:, None] * datum_by_unknowns[2]
    derivative[2] = by_unknowns[2] - datum_by_unknowns[2]
    return np.append(datum[:2] + offset, wrap_angle(pose[2] + angle)), derivative


def _distortion(
    fit: FloorFit, number: int, is_mapped: bool
) -> tuple[Distortion | None, tuple[float, float], float]:
    """Return the map of a sheet's errors, and the standard deviations of those that are left.

    These are of displacements along both axes [mm], and of the local rotation [rad].
    """
    layout = fit.problem.layout
    if number not in layout.nodes:
        return None, (0.0, 0.0), 0.0
    unknowns = layout.field(number).ravel()
    operator, basis = _rigid_part(fit, number)
    other = np.eye(len(unknowns)) - basis @ operator
    mean = other @ fit.state[unknowns]
    covariance = other @ fit.covariance[np.ix_(unknowns, unknowns)] @ other.T
    if not is_mapped:
        covariance = covariance + np.outer(mean, mean)
    x, y, rotation = np.sqrt(_mean_variance(fit, number, covariance)).tolist()
    if not is_mapped:
        return None, (x, y), rotation
    columns, rows = layout.nodes[number]
    along_x, along_y = mean.reshape(2, rows, columns)
    return Distortion(_as_rows(along_x), _as_rows(along_y)), (x, y), rotation


def _mean_variance(fit: FloorFit, number: int, covariance: Array) -> Array:
    """Return the variance (3,) of displacements along both axes and of the local rotation.

    It is the mean over the sheet, at the quarters of the cells between the nodes. ``covariance``
    (2 nodes, 2 nodes) is that of the nodes. What the nodes do not resolve has its variance a
    priori.
    """
    manifest, nodes = fit.problem.manifest, fit.problem.layout.nodes[number]
    points = cell_quarters(manifest, number, nodes)
    weights = field_weights(manifest, number, nodes, points)
    none = np.zeros_like(weights.value)
    rows = [
        np.hstack([weights.value, none]),
        np.hstack([none, weights.value]),
        np.hstack([-weights.by_y, weights.by_x]) / 2,
    ]
    resolved = [np.einsum("ni,ij,nj->n", row, covariance, row).mean() for row in rows]
    value, by_x, by_y = unresolved_variance(
        node_positions(manifest, number, nodes),
        points,
        weights,
        fit.hyperparameters.correlation_length_mm,
    )
    x, y = np.square(fit.hyperparameters.field_sigma_mm)
    return np.array(resolved) + [value * x, value * y, (by_x * y + by_y * x) / 4]


def _as_rows(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())
