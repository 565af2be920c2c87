"""Motion of the bar during a pass: heading, attitude and height along the path.

A straight and level pass needs none of this. The functions of the path are

- heading: Legendre polynomials from the first degree, which is a circle. The bar moves along its x
  axis, so that its lateral position follows from the heading;
- roll and pitch: constants, and cosines if the bar rocks;
- height: cosines.

The frame of the floor is that of the bar at :attr:`Motion.middle_m`, except for roll and pitch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOTION_GROUPS = ("curve", "attitude", "height", "rocking")
"""Groups of coefficients, each of which is estimated as a whole."""

YAW_SIGMAS_RAD = (0.5, 0.1, 0.04)
"""Standard deviations of the heading's polynomials over half a pass [rad]: a half pass of 0.1 m on
a radius of 0.2 m is 0.5 rad. That of a change of curvature is a third of it, and of the change of
this change a sixth."""

ATTITUDE_SIGMA_RAD = 0.035
"""Standard deviation of roll and pitch: two degrees, a robot on one edge of a mat."""

HEIGHT_WAVE_SIGMA_M = 0.4e-3
"""Standard deviation of each wave of the height: 1 mm rms of a dozen of them, a rough floor."""

ROCKING_SIGMA_RAD = 0.006
"""Standard deviation of each wave of roll and pitch: a height wave of 0.5 mm over a wheelbase of
80 mm."""

SHORTEST_WAVE_HEIGHTS = 4.0
"""Shortest wavelength of height and attitude, in heights over the magnets: the field of a magnet
is two heights wide."""

MAX_WAVES = 16
"""Maximum number of waves; it bounds the time of a fit of a long pass."""

GRID_POINTS = 257
"""Points at which the heading is integrated; the steps between are arcs of circles."""


@dataclass(frozen=True)
class BarPoses:
    """Poses of the bar at n points of its path.

    Attributes
    ----------
    position_m : (n, 3) ndarray
        The third component is the deviation from the mean height.
    rotation : (n, 3, 3) ndarray
        From the axes of the bar to those of the floor.
    yaw_rate : (n,) ndarray
        Curvature of the path [rad/m].
    """

    position_m: Array
    rotation: Array
    yaw_rate: Array


@dataclass(frozen=True)
class Motion:
    """Deviation of a pass from a straight and level one.

    Attributes
    ----------
    middle_m, half_length_m : float
        Middle of the path, and half its length.
    waves : int
        Number of cosines.
    coefficients : (K,) ndarray
        In the order of :data:`MOTION_GROUPS`.
    """

    middle_m: float
    half_length_m: float
    waves: int
    coefficients: Array

    @classmethod
    def straight(cls, path_m: Array, middle_m: float, height_m: float) -> Motion:
        """Return a straight and level motion over a path (n,)."""
        half = float(np.abs(path_m - middle_m).max())
        waves = int(np.clip(np.ceil(4 * half / (SHORTEST_WAVE_HEIGHTS * height_m)), 2, MAX_WAVES))
        return cls(middle_m, half, waves, np.zeros(len(YAW_SIGMAS_RAD) + 2 + 3 * waves))

    @property
    def groups(self) -> Mapping[str, slice]:
        """Range of the coefficients of each group."""
        sizes = (len(YAW_SIGMAS_RAD), 2, self.waves, 2 * self.waves)
        stops = np.cumsum(sizes)
        return {
            name: slice(int(stop - size), int(stop))
            for name, size, stop in zip(MOTION_GROUPS, sizes, stops, strict=True)
        }

    @property
    def sigmas(self) -> Array:
        """Prior standard deviations (K,) of the coefficients."""
        return np.concatenate(
            [
                YAW_SIGMAS_RAD,
                np.full(2, ATTITUDE_SIGMA_RAD),
                np.full(self.waves, HEIGHT_WAVE_SIGMA_M),
                np.full(2 * self.waves, ROCKING_SIGMA_RAD),
            ]
        )

    @property
    def is_straight(self) -> bool:
        """True if all coefficients are zero."""
        return not self.coefficients.any()

    def with_added(self, change: Array) -> Motion:
        """Return the motion with changed coefficients (K,)."""
        return replace(self, coefficients=self.coefficients + change)

    def poses(self, path_m: Array, crab_rad: float = 0.0) -> BarPoses:
        """Return the poses of the bar at points (n,) of its path."""
        return self._evaluate(path_m, crab_rad, [])[0]

    def derivatives(
        self, path_m: Array, crab_rad: float, columns: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Return velocity (n, 3, 2 + k) and rotation rate (n, 3, 2 + k) in the axes of the bar.

        They are derivatives of the pose by the path, the crab angle, and the coefficients
        ``columns`` (k,).
        """
        _, velocity, rate = self._evaluate(path_m, crab_rad, list(columns))
        return velocity, rate

    def _evaluate(
        self, path_m: Array, crab_rad: float, columns: list[int]
    ) -> tuple[BarPoses, Array, Array]:
        groups, values = self.groups, self.coefficients
        n, yaw_terms, waves = len(path_m), len(YAW_SIGMAS_RAD), self.waves
        unit = (path_m - self.middle_m) / self.half_length_m
        yaw_basis, yaw_slope = self._yaw_basis(unit)
        bend = values[groups["curve"]]
        yaw, yaw_rate = yaw_basis @ bend, yaw_slope @ bend / self.half_length_m
        phase = np.pi / 2 * np.outer(unit + 1, np.arange(1, waves + 1))
        wave = np.cos(phase)
        wave_slope = -np.sin(phase) * (np.pi / 2 / self.half_length_m) * np.arange(1, waves + 1)
        height = values[groups["height"]]
        rocking = values[groups["rocking"]].reshape(2, waves)
        roll, pitch = values[groups["attitude"]][:, None] + rocking @ wave.T
        roll_rate, pitch_rate = rocking @ wave_slope.T
        # Integrals of the heading: on a grid, and along arcs between its points.
        reach = max(1.0, float(np.abs(unit).max()))
        grid = np.linspace(-reach, reach, GRID_POINTS)
        grid_basis, _ = self._yaw_basis(grid)
        grid_yaw = grid_basis @ bend
        step = (grid[1] - grid[0]) * self.half_length_m
        index = np.clip(np.round((unit - grid[0]) / (grid[1] - grid[0])).astype(int), 0, 256)
        rest = path_m - self.middle_m - grid[index] * self.half_length_m

        def integrate(on_grid: Array, at_path: Array) -> Array:
            """Integrate a function of the path from the middle to each point."""
            cumulated = np.zeros_like(on_grid)
            np.cumsum((on_grid[1:] + on_grid[:-1]) * (step / 2), axis=0, out=cumulated[1:])
            cumulated -= cumulated[GRID_POINTS // 2]
            rests = rest[:, None] if on_grid.ndim == 2 else rest
            return np.asarray(cumulated[index] + rests * (at_path + on_grid[index]) / 2)

        forward = self.middle_m + integrate(np.cos(grid_yaw), np.cos(yaw))
        sideways = integrate(np.sin(grid_yaw), np.sin(yaw))
        tangent = np.tan(crab_rad)
        position = np.column_stack(
            [forward - tangent * sideways, sideways + tangent * forward, wave @ height]
        )
        (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
        rotation = np.array([
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]).transpose(2, 0, 1)  # fmt: skip
        # Axes of the three angles in those of the bar.
        zero = np.zeros(n)
        yaw_axis = rotation[:, 2]
        pitch_axis = np.column_stack([zero, cr, -sr])
        roll_axis = np.array([1.0, 0.0, 0.0])
        poses = BarPoses(position, rotation, yaw_rate)
        velocity = np.zeros((n, 3, 2 + len(columns)))
        rate = np.zeros((n, 3, 2 + len(columns)))
        velocity[:, 0, 0] = cy - tangent * sy
        velocity[:, 1, 0] = sy + tangent * cy
        velocity[:, 2, 0] = wave_slope @ height
        rate[:, :, 0] = yaw_rate[:, None] * yaw_axis + pitch_rate[:, None] * pitch_axis
        rate[:, :, 0] += roll_rate[:, None] * roll_axis
        velocity[:, 0, 1] = -(1 + tangent**2) * sideways
        velocity[:, 1, 1] = (1 + tangent**2) * forward
        if columns:
            full_velocity = np.zeros((n, 3, len(values)))
            full_rate = np.zeros((n, 3, len(values)))
            cosines, sines = np.cos(grid_yaw)[:, None], np.sin(grid_yaw)[:, None]
            by_forward = -integrate(sines * grid_basis, sy[:, None] * yaw_basis)
            by_sideways = integrate(cosines * grid_basis, cy[:, None] * yaw_basis)
            full_velocity[:, 0, :yaw_terms] = by_forward - tangent * by_sideways
            full_velocity[:, 1, :yaw_terms] = by_sideways + tangent * by_forward
            full_rate[:, :, :yaw_terms] = yaw_axis[:, :, None] * yaw_basis[:, None]
            full_rate[:, 0, groups["attitude"].start] = 1.0
            full_rate[:, :, groups["attitude"].start + 1] = pitch_axis
            full_velocity[:, 2, groups["height"]] = wave
            start = groups["rocking"].start
            full_rate[:, 0, start : start + waves] = wave
            full_rate[:, :, start + waves :] = pitch_axis[:, :, None] * wave[:, None]
            velocity[:, :, 2:], rate[:, :, 2:] = (
                full_velocity[..., columns],
                full_rate[..., columns],
            )
        return poses, np.einsum("nji,njk->nik", rotation, velocity), rate

    @staticmethod
    def _yaw_basis(unit: Array) -> tuple[Array, Array]:
        """Return the polynomials (n, k) of the heading, zero in the middle, and their slopes."""
        terms = np.eye(len(YAW_SIGMAS_RAD) + 1)[1:].T
        legendre = np.polynomial.legendre
        middle = legendre.legval(np.zeros(1), terms)
        basis = legendre.legval(unit, terms) - middle
        slope = legendre.legval(unit, legendre.legder(terms))
        return np.asarray(basis.T, float), np.asarray(slope.T, float)
