"""Estimation of paths in continuous time, with stations and photodiodes as uncertain parameters.

Every sweep is a measurement at its own time. :func:`estimate_paths` refines rough trajectories:

1. The paths, and then the poses of the stations, are fitted with a robust loss.
2. Sweeps that contradict the path are rejected, and those that agree with it are reinstated, until
   nothing changes (:mod:`~locatk.core.lighthouse.motion.consistency`); the common parameters, the
   noise of the angles and the power of the motion are estimated meanwhile.
3. The covariance of each pose contains the noise and what remains of the common parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps
from locatk.core.lighthouse.motion.consistency import (
    Consistency,
    agrees_with_most,
    find_contested,
    find_contradictions,
    residual_statistics,
)
from locatk.core.lighthouse.motion.equations import (
    NormalEquations,
    PathSweeps,
    assemble,
    linearize,
)
from locatk.core.lighthouse.motion.inertial import (
    IMU_COLUMNS,
    InertialFactors,
    make_factors,
)
from locatk.core.lighthouse.motion.layout import PathLayout, lay_out
from locatk.core.lighthouse.motion.parameters import (
    STATION_PARAMETERS,
    CommonParameters,
    scene_size,
)
from locatk.core.lighthouse.motion.path import Path, prior_information
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD, INLIER_GATE_RAD
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

START_POWER = np.array([0.5, 30.0])
"""Power of the motion at the start: of the position, relative to the square of the distance of the
stations in metres, and of the rotation in rad^2/s^3. Those of an agile flight."""

MIN_POWER, MAX_POWER = np.array([1e-5, 1e-3]), np.array([5.0, 1e3])
"""Smallest and largest power of the motion, in the same units: at rest, and thrown or shaken. With
more, a path could follow wrong sweeps."""

POWER_WINDOW_S = 1.0
"""Time over which the power of the motion is averaged."""

USUAL_POWER_QUANTILE = 0.75
MAX_LOCAL_POWER = 10.0
"""Quantile of the power over windows that counts as usual, and the largest one of a window relative
to it: undetected outliers look like accelerations."""

ROBUST_ITERATIONS = 8
MIN_ROUNDS, MAX_ROUNDS = 5, 20
FINAL_ITERATIONS = 4
"""Iterations with the robust loss, smallest and largest number of rounds of each search for
outliers, and iterations after it."""

MIN_USED_FRACTION = 0.3
"""Smallest fraction of accepted sweeps of a path that is trusted."""

STRETCH_PASSES, STRETCH_ITERATIONS = 2, 4
"""Passes over stretches in which many sweeps are rejected, and iterations after each."""

MAX_PREDICTION_SIGMA_RAD = 5e-3
"""Largest standard deviation of a predicted angle with which a sweep is reinstated: with more,
reflections agree by chance."""

STATION_GATE_SIGMAS = 6.0
"""Median residual of a station that contradicts the others, in standard deviations of its pose."""

LOSS_SIGMAS = 3.0
"""Scale of the Cauchy loss in standard deviations."""

MIN_SIGMA_RAD, MAX_SIGMA_RAD = 2e-5, 1e-3
"""Smallest standard deviation of an angle, that of rounding to an LFSR step, and the largest."""

STEP_LENGTHS = (1.0, 0.5, 0.25, 0.125)
MAX_GROWTH = 2.0
"""Lengths of a step that are tried, and the largest growth of the median residual."""


@dataclass(frozen=True)
class PathEstimate:
    """Estimated paths of the devices of a recording.

    Attributes
    ----------
    path : Path
    device : (k,) int ndarray
        Device of each knot.
    time_ns : (k,) int64 ndarray
        Of the knots.
    common : CommonParameters
    common_covariance : (m, m) ndarray
        Of the common parameters, for the poses.
    pose_covariance : (k, n, n) ndarray
        Of the pose at each knot while the common parameters are known.
    response : (k, n, m) ndarray
        Change of each pose per change of the common parameters.
    sweep : (p,) int ndarray
        Rows of the given sweeps, all devices one after the other, that are on a path.
    residual : (p,) ndarray
        Of these, in radians.
    is_used : (p,) bool ndarray
    knot : (p,) int ndarray
        Knot before each of them.
    sigma_rad : float
        Standard deviation of an angle.
    is_left_out : (s,) bool ndarray
        Stations that contradict the others.
    inertial : InertialFactors, optional
    contradicting_imus, uncovered_imus : tuple of str
        Devices whose IMU contradicts the light and was left out, and those whose IMU has too few
        samples of a gyroscope.
    """

    path: Path
    device: IntArray
    time_ns: IntArray
    common: CommonParameters
    common_covariance: Array
    pose_covariance: Array
    response: Array
    sweep: IntArray
    residual: Array
    is_used: Mask
    knot: IntArray
    sigma_rad: float
    is_left_out: Mask
    inertial: InertialFactors | None = None
    contradicting_imus: tuple[str, ...] = ()
    uncovered_imus: tuple[str, ...] = ()


def estimate_paths(
    sweeps: Sequence[DeviceSweeps],
    first_photodiode: Sequence[int],
    start: Sequence[Trajectory],
    common: CommonParameters,
    knot_ns: int,
    imu: Sequence[InertialSamples | None] = (),
    *,
    floor_z: float | None = None,
) -> PathEstimate:
    """Estimate the paths of the devices of a recording.

    Parameters
    ----------
    sweeps : sequence of DeviceSweeps
        By device, ascending in time.
    first_photodiode : sequence of int
        Number of the first photodiode of each device in ``common``.
    start : sequence of Trajectory
        Rough poses by device.
    common : CommonParameters
        Without photodiodes if the devices have single ones.
    knot_ns : int
        Time from knot to knot.
    imu : sequence of InertialSamples or None
        By device; empty without any. Of single photodiodes, they are not used.
    floor_z : float, optional
        Height of single photodiodes on a floor.

    Raises
    ------
    DegenerateError
        No device has a sweep near a pose, or the sweeps do not determine the paths.
    """
    layout = _require_layout(sweeps, first_photodiode, start, knot_ns, common)
    problem = PathProblem(layout.sweeps, common, layout.path, floor_z)
    problem.fit_robustly()
    problem.reject_contradictions()
    problem.add_imus(imu, layout)
    problem.resolve_stretches()
    problem.finish()
    problem.require_agreement()
    return problem.estimate(layout)


def follow_path(
    sweeps: DeviceSweeps,
    start: Trajectory,
    common: CommonParameters,
    knot_ns: int,
    imu: InertialSamples | None,
    sample: PathEstimate,
    *,
    floor_z: float | None = None,
) -> PathEstimate:
    """Estimate the path of a device while the common parameters are held.

    Parameters
    ----------
    sweeps : DeviceSweeps
    start : Trajectory
    common : CommonParameters
        At their values. After those of the scene and the photodiodes, gravity and the parameters
        of the IMU if there is one.
    knot_ns : int
    imu : InertialSamples or None
    sample : PathEstimate
        Of other parts of the recording.
    floor_z : float, optional

    Returns
    -------
    PathEstimate
        Its ``common_covariance`` is empty.

    Raises
    ------
    DegenerateError
        See :func:`estimate_paths`.
    """
    layout = _require_layout([sweeps], [0], [start], knot_ns, common)
    problem = PathProblem(layout.sweeps, common, layout.path, floor_z, is_held=True)
    problem.is_left_out, problem.sigma = sample.is_left_out, sample.sigma_rad
    problem.fit_robustly()
    problem.reject_contradictions()
    if imu is not None and sample.inertial is not None:
        first = len(common.value) - IMU_COLUMNS
        start_ns = int(layout.time_ns.min())
        problem.inertial = sample.inertial.for_samples(imu, layout.path, start_ns, first)
        problem.reject_contradictions()
    problem.resolve_stretches()
    problem.finish()
    problem.require_agreement()
    return problem.estimate(layout)


def _require_layout(
    sweeps: Sequence[DeviceSweeps],
    first_photodiode: Sequence[int],
    start: Sequence[Trajectory],
    knot_ns: int,
    common: CommonParameters,
) -> PathLayout:
    is_rigid = len(common.photodiodes) > 0
    layout = lay_out(sweeps, first_photodiode, start, knot_ns, is_rigid=is_rigid)
    if layout is None:
        raise DegenerateError("no sweep is near a pose")
    return layout


class PathProblem:
    """Paths and common parameters while they are estimated, or held at known values."""

    def __init__(
        self,
        sweeps: PathSweeps,
        common: CommonParameters,
        path: Path,
        floor_z: float | None = None,
        *,
        is_held: bool = False,
    ) -> None:
        self.is_held = is_held
        self.sweeps, self.common, self.path, self.floor_z = sweeps, common, path, floor_z
        self.size_m = scene_size(common.positions, path.position)
        unit = np.array([self.size_m**2, 1.0])
        self.min_power, self.max_power = MIN_POWER * unit, MAX_POWER * unit
        self.power = np.tile(START_POWER * unit, (len(path) - 1, 1))
        self.sigma = ANGLE_SIGMA_RAD
        self.residuals = linearize(sweeps, path, common)
        self.is_used = np.isfinite(self.residuals.residual)
        self.is_left_out = np.zeros(len(common.positions), bool)
        self.inertial: InertialFactors | None = None
        self.contradicting_imus: tuple[str, ...] = ()
        self.uncovered_imus: tuple[str, ...] = ()

    @property
    def is_testable(self) -> Mask:
        """Sweeps (n,) of stations that are not left out."""
        return np.asarray(~self.is_left_out[self.sweeps.station])

    @property
    def weight(self) -> Array:
        """Inverse variances (n,) of the accepted sweeps."""
        return np.where(self.is_used, self.sigma**-2.0, 0.0)

    def equations(self, weight: Array, *, with_common: bool = False) -> NormalEquations:
        equations = assemble(
            self.sweeps,
            self.residuals,
            weight,
            self.path,
            self.power,
            self.common,
            with_common=with_common,
            floor_z=self.floor_z,
            inertial=self.inertial,
        )
        if with_common and (self.inertial is None or not self.inertial.has_force):
            self._hold_scale(equations)
        return equations

    def _hold_scale(self, equations: NormalEquations) -> None:
        """Remove the pull of the prior towards a smaller scene from the gradients.

        The power of the motion is proportional to the square of the size of the scene, the rms
        distance of the paths from the stations. With the derivative of its normalization, the prior
        does not depend on the size.
        """
        error = self.path.prior_errors()[:, :, :3]
        unit = prior_information(self.path.span_s)[:, 2:, 2:]
        energy = np.einsum("kia,kij,kja->k", error, unit, error) * self.path.is_linked
        pull = float(np.sum(energy / self.power[:, 0]))
        positions, stations = self.path.position, self.common.stations[0]
        to_path, to_station = positions - stations.mean(axis=0), stations - positions.mean(axis=0)
        squares = np.mean(np.sum(to_path**2, axis=1)) + np.sum(np.var(stations, axis=0))
        equations.gradient[:, :3] -= pull * to_path / (len(positions) * squares)
        of_stations = equations.common_gradient[: len(stations) * STATION_PARAMETERS]
        of_stations.reshape(-1, STATION_PARAMETERS)[:, :3] -= (
            pull * to_station / (len(stations) * squares)
        )

    def move(self, equations: NormalEquations, *, with_common: bool) -> float:
        """Take a step; return its largest change of a position, relative to the scene.

        The step is shortened, or not taken, if the residuals grow by more than their noise
        explains.
        """
        shared = np.zeros(len(self.common.value))
        if with_common:
            change, shared = equations.step()
        else:
            change = equations.states_step()
        path, common, residuals = self.path, self.common, self.residuals
        limit = max(MAX_GROWTH * self._usual_residual(), 5 * self.sigma)
        for length in STEP_LENGTHS:
            self.path = path.stepped(length * change)
            self.common = common.stepped(length * shared)
            self.residuals = linearize(self.sweeps, self.path, self.common)
            if self._usual_residual() <= limit:
                return length * float(np.max(np.abs(change[:, :3]))) / self.size_m
        self.path, self.common, self.residuals = path, common, residuals
        return 0.0

    def _usual_residual(self) -> float:
        """Return the median residual of the accepted sweeps; infinite if most have none."""
        residual = np.abs(self.residuals.residual[self.is_used])
        return float(np.median(np.nan_to_num(residual, nan=np.inf))) if len(residual) else 0.0

    def iterate(self, *, with_common: bool) -> tuple[NormalEquations, float]:
        """Take a step with the accepted sweeps; return the equations and the largest change."""
        with_common = with_common and not self.is_held
        equations = self.equations(self.weight, with_common=with_common)
        change = self.move(equations, with_common=with_common)
        self.is_used &= np.isfinite(self.residuals.residual)
        return equations, change

    def fit_robustly(self) -> None:
        """Fit the paths with a Cauchy loss that narrows from the gate to the noise.

        Light planes and photodiodes are held, so that wrong sweeps cannot bend them.
        """
        common = self.common
        if not self.is_held:
            self.common = common.only_poses()
        for iteration in range(ROBUST_ITERATIONS):
            if iteration == ROBUST_ITERATIONS // 2 and not self.is_held:
                self.leave_out_stations()
            residual = self.residuals.residual
            spread = float(np.clip(robust_sigma(residual), self.sigma, INLIER_GATE_RAD))
            scale = np.clip(LOSS_SIGMAS * spread, LOSS_SIGMAS * self.sigma, INLIER_GATE_RAD)
            with np.errstate(invalid="ignore"):
                weight = spread**-2.0 / (1.0 + (residual / scale) ** 2)
            weight = np.where(self.is_testable, np.nan_to_num(weight), 0.0)
            with_common = iteration > ROBUST_ITERATIONS // 2 and not self.is_held
            self.move(self.equations(weight, with_common=with_common), with_common=with_common)
        with np.errstate(invalid="ignore"):
            spread = robust_sigma(self.residuals.residual[self.is_testable])
            self.is_used = np.abs(self.residuals.residual) < max(6 * spread, 10 * self.sigma)
        self.is_used &= self.is_testable
        self.common = replace(common, value=self.common.value)
        self.update_sigma()

    def leave_out_stations(self) -> None:
        """Leave out stations whose sweeps contradict those of the others.

        Their residuals exceed what the uncertainty of the stations explains, and those of the other
        stations do not.
        """
        count = len(self.common.positions)
        usual = np.array(
            [
                np.nanmedian(np.abs(self.residuals.residual[self.sweeps.station == i]))
                if np.any(self.sweeps.station == i)
                else np.nan
                for i in range(count)
            ]
        )
        gate = np.maximum(
            INLIER_GATE_RAD, STATION_GATE_SIGMAS * self.common.pose_sigma(self.size_m)
        )
        if np.any(usual < gate / 2):
            self.is_left_out = usual > gate

    def reject_contradictions(self) -> None:
        """Reject sweeps and reinstate them until nothing changes."""
        return_count = np.zeros(len(self.sweeps), np.int64)
        for number in range(MAX_ROUNDS):
            with_common = number % 2 == 1
            equations, _ = self.iterate(with_common=with_common)
            consistency = self.update_noise(equations)
            leaving, returning = find_contradictions(self.sweeps, consistency, self.is_used)
            returning &= (return_count < 2) & self.is_testable
            agrees = agrees_with_most(self.sweeps, (self.is_used & ~leaving) | returning)
            leaving |= self.is_used & ~agrees
            returning &= agrees
            return_count += returning
            self.is_used = (self.is_used & ~leaving) | returning
            if number >= MIN_ROUNDS and with_common and not np.any(leaving | returning):
                break

    def resolve_stretches(self) -> None:
        """Estimate again where many sweeps contradict the path, from both ends inwards.

        Reflections of both stations at a time agree with each other and bend the path to them. All
        sweeps of such a stretch are left out, and those are reinstated that agree with the motion
        before and after it.
        """
        for _ in range(STRETCH_PASSES):
            is_contested = find_contested(self.sweeps, self.is_used | ~self.is_testable)
            if not np.any(is_contested):
                return
            self.is_used &= ~is_contested
            self.reinstate(is_contested)
            for _ in range(STRETCH_ITERATIONS):
                consistency = self.update_noise(self.iterate(with_common=True)[0])
                leaving, _ = find_contradictions(self.sweeps, consistency, self.is_used)
                self.is_used &= ~leaving

    def reinstate(self, candidates: Mask) -> None:
        """Reinstate sweeps that agree with the path, as far as it predicts them."""
        for _ in range(MAX_ROUNDS):
            self.iterate(with_common=False)
            consistency = self.check(self.iterate(with_common=False)[0])
            leaving, returning = find_contradictions(self.sweeps, consistency, self.is_used)
            returning &= candidates & self.is_testable
            returning &= consistency.variance < MAX_PREDICTION_SIGMA_RAD**2
            returning &= agrees_with_most(self.sweeps, returning | self.is_used)
            self.is_used = (self.is_used & ~leaving) | returning
            if not np.any(returning & ~leaving):
                return

    def add_imus(self, imu: Sequence[InertialSamples | None], layout: PathLayout) -> None:
        """Estimate the paths with the IMUs that agree with the light."""
        if self.path.rotation is None:
            return
        samples = [(s, layout.device == k) for k, s in enumerate(imu) if s is not None]
        start_ns = int(layout.time_ns.min())
        # With several stations, the accelerometer biases the scale of an estimated scene.
        made = make_factors(
            samples,
            self.path,
            self.common,
            start_ns,
            with_force=len(self.common.positions) == 1,
        )
        self.inertial, self.common, self.contradicting_imus, self.uncovered_imus = made
        if self.inertial is not None:
            self.inertial.loosen_position_prior(self.power)
            self.reject_contradictions()

    def finish(self) -> None:
        """Converge with the accepted sweeps."""
        for _ in range(FINAL_ITERATIONS):
            if self.iterate(with_common=True)[1] < 1e-6:
                break

    def require_agreement(self) -> None:
        """Raise an error if most sweeps contradict the paths.

        Raises
        ------
        DegenerateError
        """
        fraction = float(np.mean(self.is_used[self.is_testable]))
        if fraction < MIN_USED_FRACTION:
            raise DegenerateError(f"{1 - fraction:.0%} of the sweeps contradict every path")

    def update_noise(self, equations: NormalEquations) -> Consistency:
        """Estimate the noise of the sensors and the power of the motion; return the residuals."""
        consistency = self.check(equations)
        self.update_power(equations)
        self.update_sigma(consistency)
        if self.inertial is not None:
            self.inertial.update_density(self.path, self.common, equations.states)
            self.inertial.loosen_position_prior(self.power)
        return consistency

    def check(self, equations: NormalEquations) -> Consistency:
        """Return how far the path determines the angle of each sweep."""
        return residual_statistics(
            self.sweeps, self.residuals, equations.states, self.sigma, self.is_used
        )

    def update_sigma(self, consistency: Consistency | None = None) -> None:
        """Estimate the noise of an angle from the residuals of the accepted sweeps."""
        residual = self.residuals.residual[self.is_used]
        if consistency is not None:
            share = 1.0 - consistency.variance[self.is_used] / self.sigma**2
            residual = residual[share > 0.1] / np.sqrt(share[share > 0.1])
        if len(residual):
            self.sigma = float(np.clip(robust_sigma(residual), MIN_SIGMA_RAD, MAX_SIGMA_RAD))

    def update_power(self, equations: NormalEquations) -> None:
        """Estimate the power of the motion, locally and in all (MacKay 1992).

        It is the energy of the accelerations over the number of degrees of freedom that the sweeps
        determine.
        """
        if not np.any(self.path.is_linked):
            return
        diagonal, above = equations.states.inverse_blocks
        error = self.path.prior_errors()
        span_s = self.path.span_s
        unit = prior_information(span_s)
        k, n = len(self.path), self.path.pose_size
        own = diagonal.reshape(k, 2, n, 2, n)
        cross = above.reshape(k - 1, 2, n, 2, n)
        window = max(1, round(POWER_WINDOW_S / float(np.median(span_s[self.path.is_linked]))))
        for part in range(n // 3):
            energy, spread = np.zeros(k - 1), np.zeros(k - 1)
            for axis in range(3 * part, 3 * part + 3):
                e = error[:, :, axis]
                energy += np.einsum("ki,kij,kj->k", e, unit[:, 2:, 2:], e)
                before, after = own[:-1, :, axis, :, axis], own[1:, :, axis, :, axis]
                between = cross[:, :, axis, :, axis]
                spread += np.einsum("kij,kji->k", unit[:, :2, :2], before)
                spread += np.einsum("kij,kji->k", unit[:, 2:, 2:], after)
                spread += 2 * np.einsum("kij,kij->k", unit[:, :2, 2:], between)
            known = np.maximum(6.0 - spread / self.power[:, part], 1e-3) * self.path.is_linked
            energy *= self.path.is_linked
            energy, known = self.path.window_sums(np.stack([energy, known]), window)
            ratio = energy[known > 0.0] / known[known > 0.0]
            usual = max(float(np.quantile(ratio, USUAL_POWER_QUANTILE)), self.min_power[part])
            # One degree of freedom of usual motion keeps windows without sweeps in range.
            local = (energy + usual) / (known + 1.0)
            largest = min(MAX_LOCAL_POWER * usual, self.max_power[part])
            self.power[:, part] = np.clip(local, self.min_power[part], largest)

    def estimate(self, layout: PathLayout) -> PathEstimate:
        """Return the result with covariances."""
        equations = self.equations(self.weight, with_common=True)
        if self.is_held:
            covariance = np.zeros((0, 0))
            response = -equations.states.solve(equations.coupling)
        else:
            covariance, response = equations.covariances()
        diagonal, _ = equations.states.inverse_blocks
        n = self.path.pose_size
        return PathEstimate(
            self.path,
            layout.device,
            layout.time_ns,
            self.common,
            covariance,
            diagonal[:, :n, :n],
            response[:, :n],
            layout.sweep,
            self.residuals.residual,
            self.is_used,
            self.sweeps.knot,
            self.sigma,
            self.is_left_out,
            self.inertial,
            self.contradicting_imus,
            self.uncovered_imus,
        )
