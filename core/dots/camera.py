"""Model of the camera over the dots: focal length, centre and radial distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with the division model of one radial coefficient.

    An undistorted point is ``centre + r / (1 + k |r|^2)``, where ``r`` is the distorted point's
    offset from the centre in focal lengths (Hostettler et al. 2016, Eq. 2, with k in px^-2:
    multiply that by the focal length squared). Barrel distortion, which moves the corners
    inwards, has k below 0.

    Attributes
    ----------
    size : (width, height)
        Of a frame, in px.
    focal_px : float
        Focal length in px.
    centre_px : (x, y)
        Intersection of the optical axis with the frame; the upper left pixel has its centre at
        (0, 0).
    radial : float
        k; dimensionless.
    """

    size: tuple[int, int]
    focal_px: float
    centre_px: tuple[float, float]
    radial: float = 0.0

    @property
    def radial_px(self) -> float:
        """Coefficient k in px^-2."""
        return self.radial / self.focal_px**2

    def undistort(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points (..., 2) in px of a frame without distortion."""
        offset = points - np.array(self.centre_px)
        square = (offset * offset).sum(axis=-1, keepdims=True)
        result: NDArray[np.float64] = self.centre_px + offset / (1 + self.radial_px * square)
        return result

    def distort(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points (..., 2) in px of a frame with distortion; inverts :meth:`undistort`.

        ``k u r^2 - r + u = 0`` has the root ``r = 2 u / (1 + sqrt(1 - 4 k u^2))``. Points that are
        the image of no distorted point become nan.
        """
        offset = points - np.array(self.centre_px)
        square = (offset * offset).sum(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1 - 4 * self.radial_px * square)
        result: NDArray[np.float64] = self.centre_px + offset * (2 / (1 + root))
        return result
