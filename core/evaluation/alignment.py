"""Alignment of an estimate with its truth by a named transform before they are compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, matrix_from_quaternion, umeyama

Array = NDArray[np.float64]

ALIGNMENTS = ("none", "se2", "se3", "sim2", "sim3", "yaw", "origin")
"""Transforms that may be fitted between estimate and truth. ``se2`` rotates about z and translates
in x and y, ``yaw`` rotates about z and translates along all axes, ``se3`` is any rigid motion;
``sim2`` and ``sim3`` also scale. They minimize the squared distances of the scored points with
equal weights (Umeyama) and never reflect. ``se2`` and ``sim2`` do not translate along z. ``se3``
and ``sim3`` can rotate a planar estimate by half a turn, and so hide that it is mirrored.
``origin`` maps the first scored pose, with its orientation, onto its truth and ignores the
others."""


def fit_alignment(
    estimate: Array,
    truth: Array,
    align: str,
    *,
    first: int = 0,
    first_quaternions: tuple[Array, Array] | None = None,
) -> Similarity:
    """Fit the transform named ``align`` that maps ``estimate`` closest to ``truth``.

    Parameters
    ----------
    estimate, truth : (n, 3) ndarray
        Matched positions in metres.
    align : str
        One of :data:`ALIGNMENTS`.
    first : int
        Row of the pose that ``origin`` maps onto its truth.
    first_quaternions : (4,) and (4,) ndarray, optional
        Orientations of that pose in estimate and truth; without them ``origin`` only translates.

    Raises
    ------
    InputError
        ``align`` is not one of :data:`ALIGNMENTS`.
    DegenerateError
        The points do not determine the transform because they coincide or are collinear.
    """
    if align not in ALIGNMENTS:
        raise InputError(f"unknown alignment {align!r}", hint=f"use one of {', '.join(ALIGNMENTS)}")
    if align == "none":
        return Similarity.identity()
    if align == "origin":
        return _align_pose(estimate[first], truth[first], first_quaternions)
    if len(estimate) < 2:
        raise DegenerateError(
            f"alignment {align!r} needs at least two poses, not {len(estimate)}",
            hint="use `none` or `origin`",
        )
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            alignment = _fit(estimate, truth, align)
        if not 0 < alignment.scale < np.inf:  # squares of tiny distances underflow
            raise DegenerateError("the points coincide and do not determine a scale")
    except DegenerateError as error:
        raise DegenerateError(
            f"alignment {align!r}: {error.message}", hint="use `none` or `origin`"
        ) from None
    return alignment


def _fit(estimate: Array, truth: Array, align: str) -> Similarity:
    with_scale = align.startswith("sim")
    if align.endswith("3"):
        return umeyama(estimate, truth, with_scale=with_scale)
    planar = umeyama(estimate[:, :2], truth[:, :2], with_scale=with_scale)
    rotation, translation = np.eye(3), np.zeros(3)
    rotation[:2, :2], translation[:2] = planar.rotation, planar.translation
    if align == "yaw":
        translation[2] = np.mean(truth[:, 2] - estimate[:, 2])
    return Similarity(planar.scale, rotation, translation)


def _align_pose(
    estimate: Array, truth: Array, quaternions: tuple[Array, Array] | None
) -> Similarity:
    rotation = np.eye(3)
    if quaternions is not None:
        estimated_rotation, true_rotation = matrix_from_quaternion(np.stack(quaternions))
        rotation = true_rotation @ estimated_rotation.T
    return Similarity(1.0, rotation, truth - rotation @ estimate)
