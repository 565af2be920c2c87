"""Magnets that were detected in one pass of an array over them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DetectedMagnets:
    """Magnets of one pass, before and after they are identified as a tag.

    Positions are in the array's frame at ``time_ns``.

    Attributes
    ----------
    time_ns : int
        Time of the sample to which the frame belongs, near the middle of the pass.
    first, stop : int
        Range of the samples of the pass: ``first`` to ``stop - 1``.
    path_m : (stop - first,) ndarray
        Distance along x that the array has moved since ``time_ns``, for each sample.
    position_m : (M, 2) ndarray
    angle_rad : (M,) ndarray
        Direction of the moments, counter-clockwise from x.
    moment_am2 : (M,) ndarray
        Magnitude of the horizontal moments.
    covariance : (3 M, 3 M) ndarray
        Of x, y, angle of the first magnet, of the second, ... in m and rad; ``nan`` if the method
        does not estimate it.
    path_sigma_m : (stop - first,) ndarray
        Standard deviation of ``path_m``; ``nan`` likewise.
    lateral_m, heading_rad : (stop - first,) ndarray or None
        Distance along y, and rotation, since ``time_ns``; None if the path is straight.
    motion_covariance : (stop - first, 3, 3) ndarray or None
        Of the change of x, y and heading of the array since ``time_ns``, except for the errors of
        ``path_m``; None likewise.
    is_path_estimated : bool
        True if ``path_m`` was estimated from the field alone, without speed or odometry.
    height_m, height_sigma_m : float
        Height of the sensors over the magnets; ``nan`` if it was not estimated.
    residual_sigma : float
        Rms residual of the samples in standard deviations of the noise; ``nan`` if the method has
        no model of the samples.
    robust_residual_sigma : float
        The same from the median, which outliers do not change.
    origin_m, origin_heading_rad : (2,) ndarray, float
        Pose of the array at ``time_ns`` in the coordinates of the fit.
    other_sources : int
        Number of further sources that are no magnets of a tag (debris).
    warnings : tuple of SolverWarning
        Without the name of the device.
    """

    time_ns: int
    first: int
    stop: int
    path_m: Array
    position_m: Array
    angle_rad: Array
    moment_am2: Array
    covariance: Array
    path_sigma_m: Array
    lateral_m: Array | None = None
    heading_rad: Array | None = None
    motion_covariance: Array | None = None
    is_path_estimated: bool = False
    height_m: float = np.nan
    height_sigma_m: float = np.nan
    residual_sigma: float = np.nan
    robust_residual_sigma: float = np.nan
    origin_m: Array = field(default_factory=lambda: np.zeros(2))
    origin_heading_rad: float = 0.0
    other_sources: int = 0
    warnings: tuple[SolverWarning, ...] = ()

    def __len__(self) -> int:
        return len(self.position_m)
