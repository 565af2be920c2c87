"""What one pass over a tag has shown, before and after it is read as a tag."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DetectedMagnets:
    """Magnets that were found in one pass of the array over them.

    All places are in the array's frame at ``time_ns``; over a pass the array is taken to
    move straight, without turning.

    Attributes
    ----------
    time_ns : int
        Of the sample to which the frame belongs, near the middle of the pass.
    first, stop : int
        The pass: samples ``first`` to ``stop - 1``.
    path_m : (stop - first,) ndarray
        How far the array has moved along its x since ``time_ns``, sample by sample.
    place_m : (M, 2) ndarray
        Of the magnets.
    angle_rad : (M,) ndarray
        Direction of the moments, counter-clockwise from x.
    moment_am2 : (M,) ndarray
        Their size.
    covariance : (3 M, 3 M) ndarray
        Of x, y, angle of the first magnet, of the second, ... in m and rad; ``nan`` where
        the method knows none.
    path_sigma_m : (stop - first,) ndarray
        Standard deviation of ``path_m``; ``nan`` where the method knows none.
    crab_rad : float
        Direction of the way, counter-clockwise from the array's x.
    free_path : bool
        Whether ``path_m`` was found from the field alone, without a known speed.
    height_m, height_sigma_m : float
        From the magnets to the sensors, as found; ``nan`` where it was not asked.
    residual_sigma : float
        Rms of what the model leaves, in standard deviations of the noise; ``nan`` where
        the method has no model of the samples.
    usual_sigma : float
        The same by the median, which no outlier moves.
    origin_m : (2,) ndarray
        Where the array was at ``time_ns``, in the coordinates of the fit.
    others : int
        Further sources that are no magnets of a tag (debris).
    warnings : tuple of SolverWarning
        Without the name of the device.
    """

    time_ns: int
    first: int
    stop: int
    path_m: Array
    place_m: Array
    angle_rad: Array
    moment_am2: Array
    covariance: Array
    path_sigma_m: Array
    crab_rad: float = 0.0
    free_path: bool = False
    height_m: float = np.nan
    height_sigma_m: float = np.nan
    residual_sigma: float = np.nan
    usual_sigma: float = np.nan
    origin_m: Array = field(default_factory=lambda: np.zeros(2))
    others: int = 0
    warnings: tuple[SolverWarning, ...] = ()

    def __len__(self) -> int:
        return len(self.place_m)
