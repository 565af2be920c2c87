"""Motion of the bar during a pass: heading, attitude and height along the path.

A straight and level pass needs none of this. The functions of the path are

- curve: the direction of the path, and of the bar with it, as Legendre polynomials. The first one
  is a circle;
- yaw: a rotation of the bar that its path does not follow, as cosines;
- attitude: constant roll and pitch;
- height, rocking: height, and roll and pitch, as cosines.

The frame of the floor is that of the bar at :attr:`Motion.middle_m`, except for roll and pitch.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CURVE_SIGMAS_RAD = (0.5, 0.1, 0.04)
"""Standard deviations of the polynomials of the path's direction over half a pass [rad]: a half
pass of 0.1 m on a radius of 0.2 m is 0.5 rad. That of a change of curvature is a fifth of it, and
of the change of this change less than a tenth."""

MOTION_GROUPS = ("curve", "yaw", "attitude", "height", "rocking")
"""Groups of coefficients, each of which is estimated as a whole."""

YAW_SIGMA_RAD = 0.02
"""Standard deviation of each wave of the yaw: 3 degrees rms of several of them."""

ATTITUDE_SIGMA_RAD = 0.035
"""Standard deviation of roll and pitch: two degrees, a robot on one edge of a mat."""

HEIGHT_WAVE_SIGMA_M = 0.4e-3
"""Standard deviation of each wave of the height: 1 mm rms of a dozen of them, a rough floor."""

ROCKING_SIGMA_RAD = 0.006
"""Standard deviation of each wave of roll and pitch: a height wave of 0.5 mm over a wheelbase of
80 mm."""

SHORTEST_WAVE_HEIGHTS = 4.0
"""Shortest wavelength, in heights over the magnets: the field of a magnet is two heights wide."""

MAX_WAVES = 16
"""Maximum number of waves; it bounds the time of a fit of a long pass."""

GRID_POINTS = 513
"""Points at which the direction of the path is integrated: between two of them, a path of 0.2 m
with a radius of 0.15 m deviates from the line by less than a micrometre."""


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
        Rotation of the bar per length of path [rad/m].
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
        In the order of :attr:`groups`.
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
        motion = cls(middle_m, half, waves, np.zeros(0))
        return replace(motion, coefficients=np.zeros(len(motion.sigmas)))

    @property
    def group_sigmas(self) -> Mapping[str, Array]:
        """Prior standard deviations of the coefficients of each group."""
        return {
            "curve": np.array(CURVE_SIGMAS_RAD),
            "yaw": np.full(self.waves, YAW_SIGMA_RAD),
            "attitude": np.full(2, ATTITUDE_SIGMA_RAD),
            "height": np.full(self.waves, HEIGHT_WAVE_SIGMA_M),
            "rocking": np.full(2 * self.waves, ROCKING_SIGMA_RAD),
        }

    @property
    def groups(self) -> Mapping[str, slice]:
        """Range of the coefficients of each group."""
        ranges, start = {}, 0
        for name, sigmas in self.group_sigmas.items():
            ranges[name] = slice(start, start + len(sigmas))
            start += len(sigmas)
        return ranges

    @property
    def sigmas(self) -> Array:
        """Prior standard deviations (K,) of the coefficients."""
        return np.concatenate(list(self.group_sigmas.values()))

    @property
    def is_straight(self) -> bool:
        """True if all coefficients are zero."""
        return not self.coefficients.any()

    def with_added(self, change: Array) -> Motion:
        """Return the motion with changed coefficients (K,)."""
        return replace(self, coefficients=self.coefficients + change)

    def poses(self, path_m: Array, crab_rad: float = 0.0) -> BarPoses:
        """Return the poses of the bar at points (n,) of its path."""
        path, angles = self._path(path_m, crab_rad), self._angles(path_m)
        return BarPoses(path.position_m, _rotations(angles.roll_pitch_yaw), angles.rates[:, 2])

    def curvature(self, path_m: Array) -> Array:
        """Return the curvature (n,) of the path [1/m]."""
        _, slope = _direction_basis((path_m - self.middle_m) / self.half_length_m)
        return np.asarray(slope @ self.coefficients[self.groups["curve"]] / self.half_length_m)

    def derivatives(
        self, path_m: Array, crab_rad: float, columns: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Return velocity (n, 3, 2 + k) and rotation rate (n, 3, 2 + k) in the axes of the bar.

        They are derivatives of the pose by the path, the crab angle, and the coefficients
        ``columns`` (k,).
        """
        n, groups, total = len(path_m), self.groups, len(self.coefficients)
        path, angles = self._path(path_m, crab_rad), self._angles(path_m)
        velocity, rate = np.zeros((n, 3, 2 + total)), np.zeros((n, 3, 2 + total))
        velocity[..., 0], velocity[..., 1] = path.by_path, path.by_crab
        by_coefficient, rotated = velocity[..., 2:], rate[..., 2:]
        by_coefficient[:, :2, groups["curve"]] = path.by_curve
        by_coefficient[:, 2, groups["height"]] = angles.wave
        # Axes of roll, pitch and yaw in those of the bar.
        rotation = _rotations(angles.roll_pitch_yaw)
        cos, sin = np.cos(angles.roll_pitch_yaw[:, 0]), np.sin(angles.roll_pitch_yaw[:, 0])
        zero = np.zeros(n)
        roll_axis = np.tile([1.0, 0.0, 0.0], (n, 1))
        pitch_axis, yaw_axis = np.column_stack([zero, cos, -sin]), rotation[:, 2]
        axes = np.stack([roll_axis, pitch_axis, yaw_axis], axis=2)
        rate[..., 0] = np.einsum("nik,nk->ni", axes, angles.rates)
        rotated[..., groups["curve"]] = yaw_axis[:, :, None] * path.basis[:, None]
        rotated[..., groups["yaw"]] = yaw_axis[:, :, None] * angles.yaw_wave[:, None]
        rotated[..., groups["attitude"]] = axes[..., :2]
        rocking = np.concatenate(
            [axis[:, :, None] * angles.wave[:, None] for axis in (roll_axis, pitch_axis)], axis=2
        )
        rotated[..., groups["rocking"]] = rocking
        chosen = np.concatenate([[0, 1], 2 + columns])
        return np.einsum("nji,njk->nik", rotation, velocity[..., chosen]), rate[..., chosen]

    def planar_derivatives(self, path_m: Array, crab_rad: float) -> Array:
        """Return the derivatives (n, 3, 1 + K) of x, y and heading on the floor.

        They are derivatives by the crab angle and by the coefficients.
        """
        path, angles, groups = self._path(path_m, crab_rad), self._angles(path_m), self.groups
        derivatives = np.zeros((len(path_m), 3, 1 + len(self.coefficients)))
        derivatives[:, :2, 0] = path.by_crab[:, :2]
        by_coefficient = derivatives[..., 1:]
        by_coefficient[:, :2, groups["curve"]] = path.by_curve
        by_coefficient[:, 2, groups["curve"]] = path.basis
        by_coefficient[:, 2, groups["yaw"]] = angles.yaw_wave
        return derivatives

    def _path(self, path_m: Array, crab_rad: float) -> _Path:
        bend, tangent = self.coefficients[self.groups["curve"]], np.tan(crab_rad)
        unit = (path_m - self.middle_m) / self.half_length_m
        basis, _ = _direction_basis(unit)
        limit = max(1.0, float(np.abs(unit).max()))
        grid_basis = _grid_basis(limit)
        direction, grid_direction = basis @ bend, grid_basis @ bend
        cos, sin = np.cos(grid_direction), np.sin(grid_direction)
        slopes = np.column_stack([cos, sin, -sin[:, None] * grid_basis, cos[:, None] * grid_basis])
        integral = np.zeros_like(slopes)
        np.cumsum((slopes[1:] + slopes[:-1]) / 2, axis=0, out=integral[1:])
        integral -= integral[GRID_POINTS // 2]
        step = 2 * limit / (GRID_POINTS - 1)
        index = np.clip(((unit + limit) / step).astype(int), 0, GRID_POINTS - 2)
        fraction = ((unit + limit) / step - index)[:, None]
        values = (1 - fraction) * integral[index] + fraction * integral[index + 1]
        values *= step * self.half_length_m
        forward, sideways = self.middle_m + values[:, 0], values[:, 1]
        by_forward, by_sideways = values[:, 2:].reshape(len(path_m), 2, -1).swapaxes(0, 1)
        cos, sin = np.cos(direction), np.sin(direction)
        height = self._waves(path_m) @ self.coefficients[self.groups["height"]]
        slope = self._wave_slopes(path_m) @ self.coefficients[self.groups["height"]]
        zero = np.zeros(len(path_m))
        secant_square = 1 + tangent**2
        return _Path(
            position_m=np.column_stack(
                [forward - tangent * sideways, sideways + tangent * forward, height]
            ),
            by_path=np.column_stack([cos - tangent * sin, sin + tangent * cos, slope]),
            by_crab=np.column_stack([-secant_square * sideways, secant_square * forward, zero]),
            by_curve=np.stack(
                [by_forward - tangent * by_sideways, by_sideways + tangent * by_forward], axis=1
            ),
            basis=basis,
        )

    def _angles(self, path_m: Array) -> _Angles:
        values, groups = self.coefficients, self.groups
        wave, slope = self._waves(path_m), self._wave_slopes(path_m)
        of_waves = np.concatenate([values[groups["rocking"]], values[groups["yaw"]]])
        of_waves = of_waves.reshape(3, self.waves)
        unit = (path_m - self.middle_m) / self.half_length_m
        basis, basis_slope = _direction_basis(unit)
        bend = values[groups["curve"]]
        angles, rates = wave @ of_waves.T, slope @ of_waves.T
        angles[:, :2] += values[groups["attitude"]]
        yaw_wave = wave - self._waves(np.array([self.middle_m]))
        angles[:, 2] = basis @ bend + yaw_wave @ values[groups["yaw"]]
        rates[:, 2] += basis_slope @ bend / self.half_length_m
        return _Angles(angles, rates, wave, yaw_wave)

    def _waves(self, path_m: Array) -> Array:
        return np.cos(self._phases(path_m))

    def _wave_slopes(self, path_m: Array) -> Array:
        number = np.arange(1, self.waves + 1)
        return -np.sin(self._phases(path_m)) * (np.pi / 2 / self.half_length_m * number)

    def _phases(self, path_m: Array) -> Array:
        unit = (path_m - self.middle_m) / self.half_length_m
        return np.asarray(np.pi / 2 * np.outer(unit + 1, np.arange(1, self.waves + 1)))


@dataclass(frozen=True)
class _Path:
    """Positions (n, 3) of the bar, their derivatives, and the polynomials (n, k) of the direction.

    ``by_curve`` is (n, 2, k); the other derivatives are (n, 3).
    """

    position_m: Array
    by_path: Array
    by_crab: Array
    by_curve: Array
    basis: Array


@dataclass(frozen=True)
class _Angles:
    """Roll, pitch and yaw (n, 3) of the bar, their derivatives by the path, and waves (n, k).

    Those of the yaw are zero in the middle.
    """

    roll_pitch_yaw: Array
    rates: Array
    wave: Array
    yaw_wave: Array


def _rotations(roll_pitch_yaw: Array) -> Array:
    """Return the matrices (n, 3, 3) from the axes of the bar to those of the floor."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(roll_pitch_yaw.T), np.sin(roll_pitch_yaw.T)
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]).transpose(2, 0, 1)  # fmt: skip


@functools.lru_cache(maxsize=16)
def _grid_basis(limit: float) -> Array:
    """Return the polynomials (points, k) on a grid from ``-limit`` to ``limit``."""
    basis, _ = _direction_basis(np.linspace(-limit, limit, GRID_POINTS))
    basis.flags.writeable = False
    return basis


def _direction_basis(unit: Array) -> tuple[Array, Array]:
    """Return the polynomials (n, k) of the path's direction, zero in the middle, and slopes."""
    terms = np.eye(len(CURVE_SIGMAS_RAD) + 1)[1:].T
    legendre = np.polynomial.legendre
    middle = legendre.legval(np.zeros(1), terms)
    basis = legendre.legval(unit, terms) - middle
    slope = legendre.legval(unit, legendre.legder(terms))
    return np.asarray(basis.T, float), np.asarray(slope.T, float)
