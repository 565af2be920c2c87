"""Printed sheets: the area of the pattern on each paper, and the papers on a floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.geometry import rotation_matrix_2d

MM_PER_INCH = 25.4

DOT_OFFSET_PITCHES = 1 / 6
"""Distance of a dot from its grid position [pitches] (Hostettler et al. 2016, III-A.1)."""

INVERSION_STEPS = 4
"""Steps of the inversion of a distortion; each reduces the error by its slope, 0.01 or less."""


@dataclass(frozen=True)
class Distortion:
    """Smooth map of the errors of a print: how far the dots of a sheet are from where they belong.

    Between the nodes of a regular grid over the printed area displacements are interpolated by
    cubic convolution (Keys, IEEE Trans. ASSP 29 (1981) 1153), so that directions are continuous,
    and extrapolated linearly beyond it.

    Attributes
    ----------
    x_mm, y_mm : (rows, columns) tuple
        Displacements at the nodes, to the right and up on the paper, from the lower left node; at
        least two rows and columns.
    """

    x_mm: tuple[tuple[float, ...], ...]
    y_mm: tuple[tuple[float, ...], ...]

    @cached_property
    def displacement_mm(self) -> NDArray[np.float64]:
        """Displacements (rows, columns, 2) at the nodes."""
        return np.stack([np.array(self.x_mm, float), np.array(self.y_mm, float)], axis=2)

    def evaluate(
        self, fraction: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return displacements and their derivatives.

        Parameters
        ----------
        fraction : (n, 2) ndarray
            0 to 1 from the left to the right and from the lower to the upper end of the area.

        Returns
        -------
        displacement_mm : (n, 2) ndarray
        slope_mm : (n, 2, 2) ndarray
            Their derivatives by ``fraction``.
        """
        rows, columns, _ = self.displacement_mm.shape
        x, x_slope = interpolation_weights(fraction[:, 0], columns)
        y, y_slope = interpolation_weights(fraction[:, 1], rows)
        along_x = np.einsum("nc,rcd->nrd", x, self.displacement_mm)
        by_x = np.einsum("nc,rcd->nrd", x_slope, self.displacement_mm)
        slope = [np.einsum("nr,nrd->nd", y, by_x), np.einsum("nr,nrd->nd", y_slope, along_x)]
        return np.einsum("nr,nrd->nd", y, along_x), np.stack(slope, axis=2)


def interpolation_weights(
    fraction: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weights (n, count) of nodes at fractions from 0 to 1, and their derivatives."""
    step = count - 1
    position = fraction * step
    left = np.clip(np.floor(position), 0, max(step - 1, 0))
    t = np.clip(position - left, 0, 1)
    one, squared = np.ones_like(t), t * t
    # Of the nodes from one before the left one to two after it.
    cubic = 0.5 * np.stack(
        [
            -t + 2 * squared - t * squared,
            2 * one - 5 * squared + 3 * t * squared,
            t + 4 * squared - 3 * t * squared,
            -squared + t * squared,
        ]
    )
    slopes = 0.5 * np.stack(
        [
            -one + 4 * t - 3 * squared,
            -10 * t + 9 * squared,
            one + 8 * t - 9 * squared,
            -2 * t + 3 * squared,
        ]
    )
    # Beyond the area, linear.
    cubic += (position - left - t) * slopes
    weights, derivatives = np.zeros((2, len(fraction), count + 2))
    index = left.astype(np.int64) + np.arange(4)[:, None]
    np.put_along_axis(weights, index.T, cubic.T, axis=1)
    np.put_along_axis(derivatives, index.T, slopes.T * step, axis=1)
    for table in (weights, derivatives):
        # Nodes beyond the ends continue the last two.
        table[:, 1:3] += table[:, :1] * [2, -1]
        table[:, -3:-1] += table[:, -1:] * [-1, 2]
    return weights[:, 1:-1], derivatives[:, 1:-1]


@dataclass(frozen=True)
class Sheet:
    """Printed area of the pattern.

    Attributes
    ----------
    id : str
        Printed in the margin; unique within a manifest.
    origin : (x, y)
        Grid coordinates of the upper left dot.
    size : (columns, rows)
    section : (u, v)
    page_mm : (width, height)
        Of the paper.
    first_mm : (x, y)
        From the paper's upper left corner right and down to the grid position of the upper left
        dot, as sent to the printer.
    position_mm : (x, y) or None
        Tiles: position of the paper's lower left corner on the floor.
    heading_deg : float
        Tiles: rotation of the paper on the floor, counter-clockwise.
    covariance_mm_deg : (3, 3) tuple, optional
        Tiles: covariance of :attr:`position_mm` and :attr:`heading_deg`, as measured from frames
        (:mod:`~locatk.core.dots.calibration.floor`); None if they are as designed.
    distortion : Distortion, optional
        Measured errors of the print, in addition to :attr:`Manifest.scale`.
    distortion_sigma_mm : (x, y)
        Standard deviation of the errors of the print that :attr:`distortion` does not contain,
        along the paper's axes.
    distortion_sigma_deg : float
        Standard deviation of the local rotation of the print by these errors.
    """

    id: str
    origin: tuple[int, int]
    size: tuple[int, int]
    section: tuple[int, int]
    page_mm: tuple[float, float]
    first_mm: tuple[float, float]
    position_mm: tuple[float, float] | None = None
    heading_deg: float = 0.0
    covariance_mm_deg: tuple[tuple[float, float, float], ...] | None = None
    distortion: Distortion | None = None
    distortion_sigma_mm: tuple[float, float] = (0.0, 0.0)
    distortion_sigma_deg: float = 0.0


@dataclass(frozen=True)
class Manifest:
    """Sheets of one print job, with the parameters of the print.

    Attributes
    ----------
    sheets : tuple of Sheet
    codec : str
    pitch_mm : float
        Distance of two grid positions, as sent to the printer.
    dot_mm : float
        Width of a dot.
    offset_mm : float
        From a grid position to its dot.
    dpi : int
    scale : (x, y)
        Measured over nominal length on the paper, along its width and height: 1.002 if 100 mm are
        printed as 100.2 mm.
    notes : tuple of str
    """

    sheets: tuple[Sheet, ...]
    codec: str = "anoto"
    pitch_mm: float = 0.508
    dot_mm: float = 0.508 / 6
    offset_mm: float = 0.508 / 6
    dpi: int = 300
    scale: tuple[float, float] = (1.0, 1.0)
    notes: tuple[str, ...] = ()

    def frame(self, number: int) -> str:
        """Return the name of the coordinate frame of poses on sheet ``number``.

        It is ``"floor"`` for tiles, whose positions on it are known, and else the sheet's id.
        """
        sheet = self.sheets[number]
        return sheet.id if sheet.position_mm is None else "floor"

    @property
    def has_seams(self) -> bool:
        """Whether several sheets are parts of one floor."""
        return sum(sheet.position_mm is not None for sheet in self.sheets) > 1

    def find(self, grid: ArrayLike, section: ArrayLike, *, slack: float = 0.0) -> NDArray[np.intp]:
        """Return the number of the sheet that contains each position, or of the nearest one.

        In the overlap of tiles, it is the one in which the position is farther from the end.

        Parameters
        ----------
        grid : (n, 2) array_like
            Grid coordinates, with fractions.
        section : (n, 2) array_like
            Each 0..62; -1 if unknown, which then matches any.
        slack : float
            Pitches by which a position may be outside the sheet: the middle of a frame at its
            border is.

        Returns
        -------
        (n,) intp ndarray
            -1 if no sheet is within ``slack``.
        """
        position, sections = np.asarray(grid, float), np.asarray(section)
        number_of = np.full(len(position), -1, np.intp)
        least_outside = np.full(len(position), np.inf)
        for number, sheet in enumerate(self.sheets):
            low = np.array(sheet.origin)
            high = low + np.array(sheet.size) - 1
            # Below 0 inside: in the overlap of two tiles the cut is in the middle.
            outside = np.maximum(low - position, position - high).max(axis=1)
            matches = ((sections == np.array(sheet.section)) | (sections == -1)).all(axis=1)
            better = matches & (outside <= slack) & (outside < least_outside)
            number_of[better], least_outside[better] = number, outside[better]
        return number_of

    def contains(self, grid: ArrayLike, section: ArrayLike) -> NDArray[np.bool_]:
        """Return the sheets on which positions are printed.

        ``grid`` (n, 2) are grid coordinates of dots, ``section`` (2,) is their section. The result
        is (sheets, n).
        """
        node = np.rint(np.asarray(grid, float))
        low = np.array([sheet.origin for sheet in self.sheets])[:, None]
        size = np.array([sheet.size for sheet in self.sheets])[:, None]
        matches = [sheet.section == tuple(np.asarray(section).tolist()) for sheet in self.sheets]
        result: NDArray[np.bool_] = ((node >= low) & (node < low + size)).all(axis=2)
        return result & np.array(matches)[:, None]

    def to_metres(self, number: int, grid: ArrayLike) -> NDArray[np.float64]:
        """Return positions on sheet ``number`` in metres in its frame, x right, y up.

        The origin is the paper's lower left corner, or that of the floor if the sheet is a tile.
        ``grid`` (..., 2) are grid coordinates. The result (..., 2) is corrected by :attr:`scale`
        and by the sheet's distortion.
        """
        on_paper = self.to_paper(number, grid)
        sheet = self.sheets[number]
        if sheet.distortion is not None:
            fraction = self._area_fraction(number, grid)
            displacement, _ = sheet.distortion.evaluate(fraction.reshape(-1, 2))
            on_paper += displacement.reshape(fraction.shape)
        if sheet.position_mm is not None:
            on_paper = on_paper @ self._rotation(number).T + sheet.position_mm
        return on_paper * 1e-3

    def to_paper(self, number: int, grid: ArrayLike) -> NDArray[np.float64]:
        """Return positions (..., 2) in mm from the paper's lower left corner, without distortion.

        ``grid`` (..., 2) are grid coordinates.
        """
        sheet = self.sheets[number]
        on_paper = (np.asarray(grid, float) - sheet.origin) * self.pitch_mm + sheet.first_mm
        on_paper[..., 1] = sheet.page_mm[1] - on_paper[..., 1]
        on_paper *= self.scale
        result: NDArray[np.float64] = on_paper
        return result

    def _area_fraction(self, number: int, grid: ArrayLike) -> NDArray[np.float64]:
        """Return positions (..., 2) as fractions of the printed area, x right, y up."""
        sheet = self.sheets[number]
        extent = np.maximum(np.array(sheet.size) - 1, 1)
        fraction = (np.asarray(grid, float) - sheet.origin) / extent
        fraction[..., 1] = 1 - fraction[..., 1]
        return np.asarray(fraction)

    def _rotation(self, number: int) -> NDArray[np.float64]:
        """Return the rotation (2, 2) from the paper to the frame of poses."""
        return rotation_matrix_2d(math.radians(self.sheets[number].heading_deg))

    def to_grid(self, number: int, position_m: ArrayLike) -> NDArray[np.float64]:
        """Return the grid coordinates (..., 2) of positions; inverts :meth:`to_metres`."""
        position = np.asarray(position_m, float)
        to_grid = np.linalg.inv(self.jacobian(number)).T
        grid = np.broadcast_to(np.array(self.sheets[number].origin, float), position.shape)
        # One step is exact but for the distortion, whose slope is far below 1.
        for _ in range(1 if self.sheets[number].distortion is None else INVERSION_STEPS):
            grid = grid + (position - self.to_metres(number, grid)) @ to_grid
        return np.asarray(grid)

    def jacobian(self, number: int, grid: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return the derivative of :meth:`to_metres`, in metres per pitch.

        It is that at grid coordinates (..., 2), as (..., 2, 2), or without them that of a print
        without distortion, (2, 2).
        """
        sheet = self.sheets[number]
        slope = np.diag([self.pitch_mm * self.scale[0], -self.pitch_mm * self.scale[1]])
        if grid is not None:
            fraction = self._area_fraction(number, grid)
            slope = np.broadcast_to(slope, (*fraction.shape, 2))
            if sheet.distortion is not None:
                _, by_fraction = sheet.distortion.evaluate(fraction.reshape(-1, 2))
                extent = np.maximum(np.array(sheet.size) - 1, 1) * [1, -1]
                slope = slope + by_fraction.reshape(*fraction.shape, 2) / extent
        if sheet.position_mm is not None:
            slope = self._rotation(number) @ slope
        return np.asarray(slope * 1e-3)

    def covariance(self, number: int, position_m: ArrayLike) -> NDArray[np.float64]:
        """Return the covariance of the floor itself at positions on it.

        It is that of the sheet's pose in the frame of the floor and of the print's errors that are
        left, but not that of a pose on the sheet. It is zero for sheets as designed.

        Parameters
        ----------
        number : int
            Of the sheet.
        position_m : (..., 2) array_like
            In metres, as from :meth:`to_metres`.

        Returns
        -------
        (..., 3, 3) ndarray
            Of x and y [m] and heading [rad].
        """
        sheet, position = self.sheets[number], np.asarray(position_m, float)
        result = np.zeros((*position.shape[:-1], 3, 3))
        rotation = np.eye(2)
        if sheet.position_mm is not None:
            rotation = self._rotation(number)
        result[..., :2, :2] = rotation @ np.diag(np.square(sheet.distortion_sigma_mm)) @ rotation.T
        result[..., :2, :2] *= 1e-6
        result[..., 2, 2] = math.radians(sheet.distortion_sigma_deg) ** 2
        if sheet.position_mm is not None and sheet.covariance_mm_deg is not None:
            lever_arm = position - np.array(sheet.position_mm) * 1e-3
            effect = np.zeros((*position.shape[:-1], 3, 3))
            effect[..., :, :] = np.diag([1e-3, 1e-3, math.radians(1)])
            effect[..., 0, 2] = -lever_arm[..., 1] * math.radians(1)
            effect[..., 1, 2] = lever_arm[..., 0] * math.radians(1)
            result += effect @ np.array(sheet.covariance_mm_deg) @ np.swapaxes(effect, -1, -2)
        return result

    def poses_in_metres(
        self, number: int, grid: ArrayLike, heading: ArrayLike, covariance: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Convert n poses on the grid to poses in the frame of their sheet.

        Parameters
        ----------
        number : int
            Of the sheet.
        grid : (n, 2) array_like
            Grid coordinates.
        heading : (n,) array_like
            From the grid's x axis, counter-clockwise, in rad.
        covariance : (n, 3, 3) array_like
            Of both, in pitches (y down) and rad.

        Returns
        -------
        position : (n, 2) ndarray
            In metres.
        heading : (n,) ndarray
        covariance : (n, 3, 3) ndarray
            Of both, with that of the floor (:meth:`covariance`).
        """
        position, jacobian = self.to_metres(number, grid), self.jacobian(number, grid)
        angle = np.asarray(heading, float)
        right = np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
        x, y = np.einsum("nij,nj->in", jacobian, right)
        full = np.zeros((len(position), 3, 3))
        full[:, :2, :2] = jacobian
        full[:, 2, 2] = 1
        spread = full @ np.asarray(covariance, float) @ full.transpose(0, 2, 1)
        return position, np.arctan2(y, x), spread + self.covariance(number, position)
