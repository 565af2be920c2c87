"""Inertial factors between neighbouring knots of a path, from the samples of an IMU.

Gyroscope and accelerometer are integrated over each interval between linked knots (preintegration,
Lupton and Sukkarieh 2012; Forster et al. 2017). As the intervals last some milliseconds, the
rotation within one is that of the path. With the integrals ``theta`` of the angular rate, ``dv``
and ``dp`` of the specific force, all after calibration, the residuals are::

    log(R_i^-1 R_j) - theta,    v_j - v_i - R dv - g T,    p_j - p_i - v_i T - R dp - g T^2 / 2

with the time ``T`` from knot i to knot j and a rotation ``R`` between those of both: half way for
the velocity, a third of the way for the position.

The parameters are gravity (shared by all devices), then for each IMU :data:`IMU_PARAMETERS`. They
follow the other common parameters. The density of the noise is estimated from the residuals,
because the vibration of a flight exceeds the noise of any data sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import uniform_filter1d

from locatk.core.block_tridiagonal import BlockTridiagonal
from locatk.core.geometry import rotation_exp, skew
from locatk.core.inertial import STANDARD_GRAVITY_M_S2, InertialSamples
from locatk.core.lighthouse.motion.parameters import CommonParameters
from locatk.core.lighthouse.motion.path import Path
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

GYRO_BIAS, FORCE_BIAS, MOUNTING = slice(0, 3), slice(3, 6), slice(6, 9)
DELAY = 9
IMU_PARAMETERS = 10
"""Biases in rad/s and m/s^2, rotation of the IMU against the photodiodes, and the delay of the
samples in seconds. Scales are not estimated: noise of the samples biases them towards zero."""

IMU_COLUMNS = 3 + IMU_PARAMETERS
"""Common parameters that an IMU depends on: gravity and its own."""

PARAMETER_SIGMA = np.repeat([0.05, 0.5, 0.02, 0.004], [3, 3, 3, 1])
"""Standard deviations of these parameters. Biases of common sensors (BMI088, data sheet) are 0.017
rad/s and 0.2 m/s^2; low-pass filters of 30 to 100 Hz delay samples by 2 to 8 ms."""

GRAVITY_SIGMA_M_S2 = 0.03
"""Standard deviation of the strength of gravity: its range on the surface of the earth."""

MAX_SAMPLE_GAP_S = 0.04
"""Longest time between samples that is interpolated: a quarter of a period of 6 Hz."""

COVERAGE_MARGIN_S = 0.015
"""Time by which samples must extend beyond an interval, for delays."""

WINDOW_S = 0.2
"""Time over which the IMU is compared with the path."""

NOISE_WINDOW_S = 1.0
"""Time over which the density of the noise is averaged."""

SAMPLE_MARGIN_S = 2.0
"""Time before and after a path from which samples are used."""

MAX_MISFIT = np.array([0.8, 1.5])
"""Largest residual of gyroscope and accelerometer, relative to the motion of the path."""

MIN_MISFIT = np.array([0.04, 0.15])
"""Residual below which no IMU contradicts the light, in rad/s and m/s^2."""

MIN_COMPARED_S = 2.0
"""Shortest time for which a sensor must be compared with the path before it is used."""

MIN_DENSITY = np.array([1e-8, 1e-6])
"""Smallest power spectral density of the noise in rad^2/s and m^2/s^3, of the best sensors."""

LOOSENED_POWER = 1e3
"""Power of the motion where the acceleration is measured, relative to the density of its noise."""

GYRO_ROWS, POSITION_ROWS, VELOCITY_ROWS = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(frozen=True)
class SampleIntegral:
    """Integral of samples that are interpolated linearly.

    Attributes
    ----------
    time_s : (n,) ndarray
    value : (n, 3) ndarray
    once, twice : (n, 3) ndarray
        First and second integral from the first sample to each one.
    """

    time_s: Array
    value: Array
    once: Array
    twice: Array

    @classmethod
    def of(cls, time_s: Array, value: Array) -> SampleIntegral:
        """Integrate samples (n, 3) at ascending times (n,), at least two of them."""
        span_s = np.diff(time_s)[:, None]
        once = np.zeros_like(value)
        once[1:] = np.cumsum(span_s * (value[:-1] + value[1:]) / 2, axis=0)
        twice = np.zeros_like(value)
        steps = span_s * once[:-1] + span_s**2 * (2 * value[:-1] + value[1:]) / 6
        twice[1:] = np.cumsum(steps, axis=0)
        return cls(time_s, value, once, twice)

    def covers(self, start_s: Array, end_s: Array) -> Mask:
        """Return which intervals have samples throughout, with a margin."""
        first = np.searchsorted(self.time_s, start_s - COVERAGE_MARGIN_S, side="right") - 1
        last = np.searchsorted(self.time_s, end_s + COVERAGE_MARGIN_S)
        is_inside = (first >= 0) & (last < len(self.time_s))
        is_gap = np.diff(self.time_s) > MAX_SAMPLE_GAP_S
        gaps = np.concatenate([[0], np.cumsum(is_gap)])
        last = np.minimum(last, len(self.time_s) - 1)
        return np.asarray(is_inside & (gaps[last] == gaps[np.maximum(first, 0)]))

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Return value, first and second integral (n, 3) at times (n,)."""
        row = np.clip(np.searchsorted(self.time_s, time_s) - 1, 0, len(self.time_s) - 2)
        span_s = (self.time_s[row + 1] - self.time_s[row])[:, None]
        since_s = time_s[:, None] - self.time_s[row][:, None]
        start = self.value[row]
        slope = (self.value[row + 1] - start) / span_s
        once = self.once[row] + since_s * start + since_s**2 / 2 * slope
        twice = self.twice[row] + since_s * self.once[row] + since_s**2 / 2 * start
        return start + since_s * slope, once, twice + since_s**3 / 6 * slope

    def noise_density(self, time_s: Array) -> Array:
        """Return the power spectral density (n,) of the noise around times (n,).

        It is that of white noise with the third differences of the samples, in which slow motion
        cancels. A filter of the sensor makes it too small.
        """
        if len(self.time_s) < 4:
            return np.zeros(len(time_s))
        spacing_s = float(np.median(np.diff(self.time_s)))
        variance = np.mean(np.diff(self.value, 3, axis=0) ** 2, axis=1) / 20
        window = max(1, round(NOISE_WINDOW_S / spacing_s))
        smooth = uniform_filter1d(variance, window, mode="nearest")
        return np.interp(time_s, self.time_s[1:-2], smooth * spacing_s)

    def noise_reduction(self, start_s: Array, end_s: Array) -> float:
        """Return the variance of integrals over intervals relative to that of white noise.

        Interpolated samples are smoother than noise of the same spectral density.
        """
        count = len(self.time_s)
        noise = np.random.default_rng(0).normal(size=(count, 3))
        noise /= np.sqrt(np.median(np.diff(self.time_s)))
        unit = SampleIntegral.of(self.time_s, noise)
        change = unit.at(end_s)[1] - unit.at(start_s)[1]
        return float(np.mean(change**2 / (end_s - start_s)[:, None]))


@dataclass(frozen=True)
class ImuIntervals:
    """Samples of one IMU, and the intervals of a path that they cover.

    Attributes
    ----------
    device : str
    gyro, force : SampleIntegral or None
    interval : (n,) int ndarray
        Knots before the intervals, ascending.
    has_gyro, has_force : (n,) bool ndarray
    start_s, end_s : (n,) ndarray
    """

    device: str
    gyro: SampleIntegral | None
    force: SampleIntegral | None
    interval: IntArray
    has_gyro: Mask
    has_force: Mask
    start_s: Array
    end_s: Array


@dataclass(frozen=True)
class InertialResiduals:
    """Residuals of the intervals of one IMU.

    Attributes
    ----------
    residual : (n, 9) ndarray
        Of rotation, position and velocity; 0 if not measured.
    by_states : (n, 9, 24) ndarray
        Derivatives by the states at both knots.
    by_common : (n, 9, 13) ndarray
        Derivatives by gravity and the parameters of the IMU.
    """

    residual: Array
    by_states: Array
    by_common: Array


def select_intervals(
    samples: InertialSamples, path: Path, is_own: Mask, start_ns: int
) -> ImuIntervals | None:
    """Return the intervals of a device's path that samples cover; None without any.

    ``is_own`` (k,) are the knots of the device, and ``start_ns`` is the zero of the path's times.
    """
    time_s = np.asarray((samples.time_ns - start_ns) * 1e-9, np.float64)
    interval = np.flatnonzero(path.is_linked & is_own[:-1])
    if not len(interval):
        return None
    start_s, end_s = path.time_s[interval], path.time_s[interval + 1]
    is_near = (time_s > start_s[0] - SAMPLE_MARGIN_S) & (time_s < end_s[-1] + SAMPLE_MARGIN_S)
    integrals, covered = [], []
    for value in (samples.angular_rate, samples.acceleration):
        rows = np.flatnonzero(is_near & np.isfinite(value).all(axis=1))
        integral = SampleIntegral.of(time_s[rows], value[rows]) if len(rows) > 1 else None
        integrals.append(integral)
        is_covered = np.zeros(len(interval), bool)
        covered.append(is_covered if integral is None else integral.covers(start_s, end_s))
    kept = covered[0] | covered[1]
    if not np.any(kept):
        return None
    return ImuIntervals(
        samples.device,
        integrals[0],
        integrals[1],
        interval[kept],
        covered[0][kept],
        covered[1][kept],
        start_s[kept],
        end_s[kept],
    )


def linearize_imu(imu: ImuIntervals, path: Path, gravity: Array, value: Array) -> InertialResiduals:
    """Return the residuals of an IMU with parameters ``value`` (10,), and their derivatives."""
    assert path.rotation is not None
    n, k = len(imu.interval), imu.interval
    span_s = (imu.end_s - imu.start_s)[:, None]
    residual, by_states = np.zeros((n, 9)), np.zeros((n, 9, 24))
    by_common = np.zeros((n, 9, IMU_COLUMNS))
    of_imu = by_common[:, :, 3:]
    turn = path.turns()[k]
    correction = skew(value[MOUNTING]) + np.eye(3)
    start_s, end_s = imu.start_s + value[DELAY], imu.end_s + value[DELAY]
    identity = np.eye(3)
    if imu.gyro is not None:
        (rate, before, _), (next_rate, after, _) = imu.gyro.at(start_s), imu.gyro.at(end_s)
        theta = after - before
        residual[:, GYRO_ROWS] = turn - theta @ correction.T + span_s * value[GYRO_BIAS]
        half, square = skew(turn) / 2, skew(turn) @ skew(turn) / 12
        by_states[:, GYRO_ROWS, 3:6] = -(identity - half + square)
        by_states[:, GYRO_ROWS, 15:18] = identity + half + square
        of_imu[:, GYRO_ROWS, GYRO_BIAS] = span_s[:, :, None] * identity
        of_imu[:, GYRO_ROWS, MOUNTING] = skew(theta)
        of_imu[:, GYRO_ROWS, DELAY] = -(next_rate - rate) @ correction.T
        _clear(imu.has_gyro, GYRO_ROWS, residual, by_states, by_common)
    if imu.force is not None:
        first, last = imu.force.at(start_s), imu.force.at(end_s)
        velocity = path.velocity[k]
        step = path.position[k + 1] - path.position[k] - span_s * velocity
        correction = skew(value[MOUNTING]) + identity
        parts = (
            # Position: the force counts with the time that remains, so that its centre is early.
            (
                POSITION_ROWS,
                1 / 3,
                step,
                last[2] - first[2] - span_s * first[1],
                last[1] - first[1] - span_s * first[0],
                span_s**2 / 2,
            ),
            (
                VELOCITY_ROWS,
                1 / 2,
                path.velocity[k + 1] - velocity,
                last[1] - first[1],
                last[0] - first[0],
                span_s,
            ),
        )
        for rows, fraction, change, measured, by_delay, factor in parts:
            to_early, to_late = rotation_exp(fraction * turn), rotation_exp((1 - fraction) * turn)
            rotation = path.rotation[k] @ to_early
            own = measured @ correction.T - factor * value[FORCE_BIAS]
            residual[:, rows] = change - (rotation @ own[:, :, None])[..., 0] - factor * gravity
            by_rotation = rotation @ skew(own)
            by_states[:, rows, 3:6] = (1 - fraction) * by_rotation @ to_early.mT
            by_states[:, rows, 15:18] = fraction * by_rotation @ to_late
            by_common[:, rows, :3] = -factor[:, :, None] * identity
            of_imu[:, rows, FORCE_BIAS] = factor[:, :, None] * rotation
            of_imu[:, rows, MOUNTING] = rotation @ skew(measured)
            of_imu[:, rows, DELAY] = -(rotation @ (correction @ by_delay[:, :, None]))[..., 0]
        by_states[:, POSITION_ROWS, 0:3] = -identity
        by_states[:, POSITION_ROWS, 6:9] = -span_s[:, :, None] * identity
        by_states[:, POSITION_ROWS, 12:15] = identity
        by_states[:, VELOCITY_ROWS, 6:9] = -identity
        by_states[:, VELOCITY_ROWS, 18:21] = identity
        for rows in (POSITION_ROWS, VELOCITY_ROWS):
            _clear(imu.has_force, rows, residual, by_states, by_common)
    return InertialResiduals(residual, by_states, by_common)


def _clear(is_kept: Mask, rows: slice, *arrays: Array) -> None:
    """Set the rows of intervals without samples to zero."""
    for array in arrays:
        array[~is_kept, rows] = 0.0


@dataclass
class InertialFactors:
    """Factors of all IMUs of a recording.

    Attributes
    ----------
    imus : tuple of ImuIntervals
    first : int
        Index of gravity among the common parameters.
    density : list of (n, 2) ndarray
        Power spectral density of the noise of gyroscope and accelerometer in each interval of each
        IMU, in rad^2/s and m^2/s^3.
    reduction : list of (2,) ndarray
        Factor by which interpolation reduces the variance of integrals.
    min_density : list of (n, 2) ndarray
        Smallest density: that of the samples. The path follows a precise IMU, so that residuals
        alone would make it more precise from round to round.
    """

    imus: tuple[ImuIntervals, ...]
    first: int
    density: list[Array]
    reduction: list[Array] = field(init=False, default_factory=list)
    min_density: list[Array] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        for imu in self.imus:
            floor = np.tile(MIN_DENSITY, (len(imu.interval), 1))
            for part, integral in enumerate((imu.gyro, imu.force)):
                if integral is not None:
                    noise = integral.noise_density(imu.start_s)
                    floor[:, part] = np.maximum(floor[:, part], noise)
            self.min_density.append(floor)
        self.reduction = [
            np.array(
                [
                    1.0 if s is None else min(1.0, s.noise_reduction(imu.start_s, imu.end_s))
                    for s in (imu.gyro, imu.force)
                ]
            )
            for imu in self.imus
        ]

    @property
    def has_force(self) -> bool:
        """True if an accelerometer is used."""
        return any(bool(np.any(imu.has_force)) for imu in self.imus)

    def columns(self, number: int) -> IntArray:
        """Return the indices (13,) of gravity and the parameters of an IMU."""
        own = self.first + 3 + number * IMU_PARAMETERS + np.arange(IMU_PARAMETERS)
        return np.concatenate([self.first + np.arange(3), own])

    def for_samples(
        self, samples: InertialSamples, path: Path, start_ns: int, first: int
    ) -> InertialFactors | None:
        """Return factors of another part of the path of one of the devices.

        ``first`` is the index of gravity among the common parameters of that part. None if the
        samples do not cover it, or the IMU of the device is not used.
        """
        numbers = [k for k, imu in enumerate(self.imus) if imu.device == samples.device]
        made = select_intervals(samples, path, np.ones(len(path), bool), start_ns)
        if not numbers or made is None:
            return None
        imu, density = self.imus[numbers[0]], self.density[numbers[0]]
        made = replace(
            made,
            has_gyro=made.has_gyro & np.any(imu.has_gyro),
            has_force=made.has_force & np.any(imu.has_force),
        )
        usual = np.tile(np.median(density, axis=0), (len(made.interval), 1))
        return InertialFactors((made,), first, [usual])

    def residuals(self, number: int, path: Path, common: CommonParameters) -> InertialResiduals:
        """Return the residuals of an IMU."""
        value = common.value[self.columns(number)]
        return linearize_imu(self.imus[number], path, value[:3], value[3:])

    def add_to_states(
        self,
        path: Path,
        common: CommonParameters,
        diagonal: Array,
        above: Array,
        gradient: Array,
    ) -> None:
        """Add the factors to the equations of the states."""
        for number, imu in enumerate(self.imus):
            residual, by_states, _ = self._whitened(number, path, common)
            square = by_states.mT @ by_states
            push = (residual[:, None] @ by_states)[:, 0]
            k = imu.interval
            diagonal[k] += square[:, :12, :12]
            diagonal[k + 1] += square[:, 12:, 12:]
            above[k] += square[:, :12, 12:]
            gradient[k] += push[:, :12]
            gradient[k + 1] += push[:, 12:]

    def add_to_common(
        self,
        path: Path,
        common: CommonParameters,
        coupling: Array,
        information: Array,
        gradient: Array,
    ) -> None:
        """Add the factors to the equations of the common parameters."""
        for number, imu in enumerate(self.imus):
            residual, by_states, by_common = self._whitened(number, path, common)
            column, k = self.columns(number), imu.interval
            joint = by_states.mT @ by_common
            coupling[k[:, None], :, column] += joint[:, :12].swapaxes(1, 2)
            coupling[k[:, None] + 1, :, column] += joint[:, 12:].swapaxes(1, 2)
            flat = by_common.reshape(-1, by_common.shape[2])
            information[np.ix_(column, column)] += flat.T @ flat
            gradient[column] += flat.T @ residual.ravel()
        gravity = slice(self.first, self.first + 3)
        strength = max(float(np.linalg.norm(common.value[gravity])), 1e-3)
        direction = common.value[gravity] / strength
        weight = GRAVITY_SIGMA_M_S2**-2.0
        information[gravity, gravity] += weight * np.outer(direction, direction)
        gradient[gravity] += weight * (strength - STANDARD_GRAVITY_M_S2) * direction

    def _whitened(
        self, number: int, path: Path, common: CommonParameters
    ) -> tuple[Array, Array, Array]:
        """Return residuals and derivatives with unit variance."""
        raw, imu = self.residuals(number, path, common), self.imus[number]
        span_s = imu.end_s - imu.start_s
        of_gyro, of_force = self.density[number].T
        arrays = []
        for array in (raw.residual[:, :, None], raw.by_states, raw.by_common):
            rows = np.empty_like(array)
            rows[:, GYRO_ROWS] = array[:, GYRO_ROWS] / np.sqrt(of_gyro * span_s)[:, None, None]
            velocity = array[:, VELOCITY_ROWS]
            # White noise: position and velocity change with the correlation sqrt(3) / 2.
            rest = array[:, POSITION_ROWS] - span_s[:, None, None] / 2 * velocity
            rows[:, POSITION_ROWS] = rest / np.sqrt(of_force * span_s**3 / 12)[:, None, None]
            rows[:, VELOCITY_ROWS] = velocity / np.sqrt(of_force * span_s)[:, None, None]
            arrays.append(rows)
        return arrays[0][..., 0], arrays[1], arrays[2]

    def loosen_position_prior(self, power: Array) -> None:
        """Raise the power (k - 1, 2) of positions whose acceleration is measured.

        A prior of similar strength would pull accelerations, and thereby the scale, towards zero.
        """
        for imu, density in zip(self.imus, self.density, strict=True):
            rows = imu.interval[imu.has_force]
            power[rows, 0] = np.maximum(power[rows, 0], LOOSENED_POWER * density[imu.has_force, 1])

    def update_density(
        self, path: Path, common: CommonParameters, states: BlockTridiagonal
    ) -> None:
        """Estimate the density of the noise, in windows and in all (MacKay 1992)."""
        diagonal, above = states.inverse_blocks
        for number, imu in enumerate(self.imus):
            k, raw = imu.interval, self.residuals(number, path, common)
            covariance = np.zeros((len(k), 24, 24))
            covariance[:, :12, :12], covariance[:, 12:, 12:] = diagonal[k], diagonal[k + 1]
            covariance[:, :12, 12:], covariance[:, 12:, :12] = above[k], above[k].mT
            span_s = imu.end_s - imu.start_s
            window = max(1, round(NOISE_WINDOW_S / float(np.median(span_s))))
            for part, (rows, is_measured) in enumerate(
                ((GYRO_ROWS, imu.has_gyro), (VELOCITY_ROWS, imu.has_force))
            ):
                if not np.any(is_measured):
                    continue
                by_states = raw.by_states[:, rows]
                absorbed = np.einsum("nij,njk,nik->n", by_states, covariance, by_states) / span_s
                known = np.maximum(3.0 - absorbed / self.density[number][:, part], 1e-3)
                energy = np.sum(raw.residual[:, rows] ** 2, axis=1) / span_s
                smooth = uniform_filter1d(
                    np.stack([energy, known]) * is_measured, window, axis=1, mode="nearest"
                )
                ratio = smooth[0] / np.maximum(smooth[1], 1e-6)
                usual = max(float(np.median(ratio[is_measured])), MIN_DENSITY[part])
                # Some degrees of freedom of usual noise keep windows without light in range.
                extra = 10.0 / window
                local = (smooth[0] + extra * usual) / (smooth[1] + extra)
                local /= self.reduction[number][part]
                self.density[number][:, part] = np.maximum(local, self.min_density[number][:, part])


def make_factors(
    samples: Sequence[tuple[InertialSamples, Mask]],
    path: Path,
    common: CommonParameters,
    start_ns: int,
    *,
    with_force: bool,
) -> tuple[InertialFactors | None, CommonParameters, tuple[str, ...], tuple[str, ...]]:
    """Compare IMUs with the path, and make factors of those that agree with it.

    Parameters
    ----------
    samples : sequence of (InertialSamples, ndarray)
        With the knots (k,) of the device.
    path : Path
        Estimated from the light.
    common : CommonParameters
    start_ns : int
        Zero of the times of the path.
    with_force : bool
        False if the accelerometers are compared, but not used.

    Returns
    -------
    factors : InertialFactors or None
        None without an IMU that agrees.
    common : CommonParameters
        With the parameters of the IMUs.
    contradicting, uncovered : tuple of str
        Devices whose IMU contradicts the light, and those with too few samples of a gyroscope.
    """
    imus, starts, densities, gravities = [], [], [], []
    contradicting, uncovered = [], []
    for own, is_own in samples:
        imu = select_intervals(own, path, is_own, start_ns)
        if imu is None or _measured_s(imu, imu.has_gyro) < MIN_COMPARED_S:
            uncovered.append(own.device)
            continue
        if _measured_s(imu, imu.has_force) < MIN_COMPARED_S:
            imu = replace(imu, has_force=np.zeros_like(imu.has_force))
        gravity, value, density, is_consistent = compare(imu, path)
        if not is_consistent:
            contradicting.append(imu.device)
            continue
        imus.append(imu if with_force else replace(imu, has_force=np.zeros_like(imu.has_force)))
        starts.append(value)
        densities.append(np.tile(np.maximum(density, MIN_DENSITY), (len(imu.interval), 1)))
        if np.any(imu.has_force):
            gravities.append(gravity)
    if not imus:
        return None, common, tuple(contradicting), tuple(uncovered)
    first = len(common.value)
    size = 3 + IMU_PARAMETERS * len(imus)
    weak = np.full(3, 1e-6)
    information = np.concatenate([weak, np.tile(PARAMETER_SIGMA**-2.0, len(imus))])
    common = replace(
        common,
        information=block_diag(common.information, np.diag(information)),
        gauge=np.concatenate([common.gauge, np.zeros((size, common.gauge.shape[1]))]),
        value=np.concatenate([common.value, np.mean(gravities or [np.zeros(3)], axis=0), *starts]),
    )
    factors = InertialFactors(tuple(imus), first, densities)
    return factors, common, tuple(contradicting), tuple(uncovered)


def _measured_s(imu: ImuIntervals, is_measured: Mask) -> float:
    """Return the time that a sensor covers, in seconds."""
    return float(np.sum((imu.end_s - imu.start_s)[is_measured]))


def compare(imu: ImuIntervals, path: Path) -> tuple[Array, Array, Array, bool]:
    """Compare an IMU with a path in windows.

    Returns
    -------
    gravity : (3,) ndarray
    value : (10,) ndarray
        Start of the parameters.
    density : (2,) ndarray
        Of the noise of IMU and path together.
    is_consistent : bool
    """
    value, gravity = np.zeros(IMU_PARAMETERS), np.zeros(3)
    span_s = imu.end_s - imu.start_s
    window = max(1, round(WINDOW_S / float(np.median(span_s))))
    raw = linearize_imu(imu, path, gravity, value)
    turn = path.turns()[imu.interval]
    change = np.diff(path.velocity, axis=0)[imu.interval]
    density, is_consistent = np.ones(2), True
    for part, (rows, motion, is_measured) in enumerate(
        ((GYRO_ROWS, turn, imu.has_gyro), (VELOCITY_ROWS, change, imu.has_force))
    ):
        residual = _window_means(raw.residual[:, rows], span_s, is_measured, window)
        if not len(residual):
            continue
        of_path = _window_means(motion, span_s, is_measured, window)
        offset = np.median(residual, axis=0)
        if part == 0:
            value[GYRO_BIAS] = -offset
        else:
            gravity = offset
        misfit = robust_sigma(residual - offset)
        size = robust_sigma(of_path - np.median(of_path, axis=0))
        is_consistent &= misfit < max(MIN_MISFIT[part], MAX_MISFIT[part] * size)
        if part == 0:
            is_consistent &= bool(np.all(np.abs(offset) < 6 * PARAMETER_SIGMA[GYRO_BIAS]))
        else:
            strength_error = abs(np.linalg.norm(offset) - STANDARD_GRAVITY_M_S2)
            is_consistent &= bool(strength_error < 6 * PARAMETER_SIGMA[FORCE_BIAS][0])
        density[part] = misfit**2 * WINDOW_S
    return gravity, value, density, bool(is_consistent)


def _window_means(values: Array, span_s: Array, is_measured: Mask, window: int) -> Array:
    """Return the means per second (m, 3) of sums of neighbouring intervals, without overlap."""
    measured = np.flatnonzero(is_measured)
    rows = measured[: len(measured) // window * window].reshape(-1, window)
    return np.asarray(values[rows].sum(axis=1) / span_s[rows].sum(axis=1)[:, None])
