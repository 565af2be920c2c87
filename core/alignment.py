"""What may be fitted between an estimate and its truth before their distance is told."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, matrix_from_quaternion, umeyama

Array = NDArray[np.float64]

ALIGNMENTS = ("none", "se2", "se3", "sim2", "sim3", "yaw", "origin")
"""What may be fitted between estimate and truth. ``se2`` turns about z and shifts in x
and y, ``yaw`` turns about z and shifts in all three, ``se3`` is any rigid motion; ``sim2``
and ``sim3`` also scale. Least squares over the scored points, all equal (Umeyama), never a
reflection. ``se2`` and ``sim2`` do not shift along z. ``se3`` and ``sim3`` can turn a planar
estimate over, and so hide that it is mirrored. ``origin`` lays the first scored pose on its
truth, orientation and all, and fits nothing to the others."""


def fit_alignment(
    estimate: Array,
    truth: Array,
    align: str,
    *,
    first: int = 0,
    turns: tuple[Array, Array] | None = None,
) -> Similarity:
    """Transform named ``align`` that brings ``estimate`` (n, 3) closest to ``truth`` (n, 3).

    Parameters
    ----------
    estimate, truth : (n, 3) ndarray
        Matched positions in metres.
    align : str
        One of :data:`ALIGNMENTS`.
    first : int
        Row of the pose that ``origin`` lays on its truth.
    turns : (4,) and (4,) ndarray, optional
        Its orientations in estimate and truth; without them ``origin`` only shifts.

    Raises
    ------
    InputError
        ``align`` is not one of :data:`ALIGNMENTS`.
    DegenerateError
        The points do not determine it (all in one place, on a line).
    """
    if align not in ALIGNMENTS:
        raise InputError(f"unknown alignment {align!r}", hint=f"use one of {', '.join(ALIGNMENTS)}")
    if align == "none":
        return Similarity.identity()
    if align == "origin":
        return _origin(estimate[first], truth[first], turns)
    if len(estimate) < 2:
        raise DegenerateError(
            f"alignment {align!r} needs two poses or more, not {len(estimate)}",
            hint="use `none` or `origin`",
        )
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            fitted = _fitted(estimate, truth, align)
        if not 0 < fitted.scale < np.inf:  # of points so near each other that squares vanish
            raise DegenerateError("the points are all in one place and do not determine a scale")
    except DegenerateError as error:
        raise DegenerateError(
            f"alignment {align!r}: {error.message}", hint="use `none` or `origin`"
        ) from None
    return fitted


def _fitted(estimate: Array, truth: Array, align: str) -> Similarity:
    with_scale = align.startswith("sim")
    if align.endswith("3"):
        return umeyama(estimate, truth, with_scale=with_scale)
    flat = umeyama(estimate[:, :2], truth[:, :2], with_scale=with_scale)
    rotation, translation = np.eye(3), np.zeros(3)
    rotation[:2, :2], translation[:2] = flat.rotation, flat.translation
    if align == "yaw":
        translation[2] = np.mean(truth[:, 2] - estimate[:, 2])
    return Similarity(flat.scale, rotation, translation)


def _origin(estimate: Array, truth: Array, turns: tuple[Array, Array] | None) -> Similarity:
    rotation = np.eye(3)
    if turns is not None:
        turned, truly_turned = matrix_from_quaternion(np.stack(turns))
        rotation = truly_turned @ turned.T
    return Similarity(1.0, rotation, truth - rotation @ estimate)
