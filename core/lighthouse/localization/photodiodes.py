"""Trajectories of single photodiodes in a scene, and the reasons for rejected epochs.

Contradictions are resolved if the data allow it: sweeps of two stations that a report exchanged
are restored, and a single station that contradicts all others is left out. Other epochs that
contradict themselves or the trajectory of their device are rejected and counted by reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.epochs import Epochs, rotor_angles
from locatk.core.lighthouse.localization.positions import (
    PositionEstimates,
    correct_angles,
    estimate_floor_positions,
    estimate_positions,
    intersect_planes,
)
from locatk.core.lighthouse.noise import (
    ANGLE_SIGMA_RAD,
    CALIBRATION_SIGMA_RAD,
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.results import SceneVerification, StationDetection
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.model import StationArrays, stack_stations
from locatk.core.lighthouse.scene.scene_errors import SceneErrors
from locatk.core.robust import robust_sigma
from locatk.core.solution import SolverWarning, add_counts
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_RANGE_M = 20.0
"""Largest plausible distance from the nearest base station, in metres. A position beyond is one
where light planes of wrong sweeps happen to intersect."""

MAX_INCONSISTENT_FRACTION = 0.2
"""Fraction of epochs that contradict the scene from which a warning is given. Occlusions,
reflections and fast robots cost a few per cent."""

SWAPPED_PLANES = ((0,), (1,), (0, 1))
"""Planes that a report may have exchanged between two stations: one of them, or both."""

JUMP_NEIGHBOURS = 3
"""Epochs before and after one that predict its position."""

MAX_JUMP_PASSES = 20
"""Most searches for jumps, each without those that were found."""

MAX_JUMP_RATIO = 5.0
"""Departure from the predicted position, relative to the usual one and to those of the neighbours,
from which a position is a jump."""

MAX_MOUNTING_SIGMAS = 4.0
"""Residual of an angle in a scene of designed stations, in standard deviations by their mounting,
from which it is an outlier."""

MIN_PREDICTIONS = 3
"""Fewest pairs of neighbours that predict a position: a median of fewer is not robust."""

MAX_EXTRAPOLATION = 4.0
"""Longest time from two neighbours to the position that they predict, in times between them."""

MAX_JUMP_WINDOW_S = 2.0
"""Longest window of the jump filter: after a pause of the recording a device may be anywhere."""

USUAL_MOTION_PERCENTILE = 75
"""Percentile of steps and deviations that counts as usual: above that of a device at a standstill
for part of the recording, below the jumps."""


@dataclass(frozen=True)
class PhotodiodeTracks:
    """Trajectories of all photodiodes of a recording, with their figures.

    Attributes
    ----------
    trajectories : tuple of Trajectory
        One per device of the epochs; accepted positions only.
    epochs : Epochs
        Epochs with restored sweeps.
    estimates : PositionEstimates
        Of all m epochs.
    is_accepted : (m,) bool ndarray
    angle_sigma_rad : float
        Standard deviation of a rotor angle, estimated from the redundancy.
    calibration_sigma_rad : float or None
        Additional standard deviation of generic calibrations; None if there is none.
    restored_epochs : int
        Number of epochs whose sweeps were restored.
    rejected : dict of str to int
        Number of epochs (or of contradicting stations) by reason.
    warnings : tuple of SolverWarning
    """

    trajectories: tuple[Trajectory, ...]
    epochs: Epochs
    estimates: PositionEstimates
    is_accepted: NDArray[np.bool_]
    angle_sigma_rad: float
    calibration_sigma_rad: float | None
    restored_epochs: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    warnings: tuple[SolverWarning, ...] = ()


def track_photodiodes(epochs: Epochs, scene: Scene) -> PhotodiodeTracks:
    """Estimate the position of every epoch in a scene, and reject outliers.

    Parameters
    ----------
    epochs : Epochs
        With sweeps of stations of the scene only, of at least one of them.
    scene : Scene
    """
    channels = [int(c) for c in epochs.channels]
    selected = [s for c in channels if (s := scene.station(c)) is not None]
    stations = stack_stations(selected)
    floor_z = scene.floor_z if scene.planar else None
    floor_map = selected[0].floor_map if len(selected) == 1 else None
    is_design = scene.frame_source == "design"

    rejected: Counter[str] = Counter()
    restored = 0
    if floor_map is not None:
        (calibration,) = stations[2]
        estimates = estimate_floor_positions(
            rotor_angles(epochs), calibration, floor_map, scene.floor_z
        )
        gate = inlier_gate(estimates)
    else:
        estimates = estimate_positions(rotor_angles(epochs), *stations, floor_z=floor_z)
        epochs, estimates, restored = restore_swapped_sweeps(epochs, estimates, stations, floor_z)
        gate = inlier_gate(estimates)
        if is_design:
            gate = max(gate, MAX_MOUNTING_SIGMAS * mounting_sigma(selected, estimates.position))
        if len(selected) > 2:
            ideal = correct_angles(rotor_angles(epochs), stations[2])
            estimates, repaired = leave_out_worst_station(ideal, estimates, stations, floor_z, gate)
            rejected["station_contradicts_others"] += repaired

    is_unsolved = ~np.isfinite(estimates.position[:, 0])
    is_inconsistent = ~is_unsolved & (estimates.max_residual > gate)
    distance = np.min(
        np.linalg.norm(estimates.position[:, None] - stations[0], axis=2), axis=1, initial=np.inf
    )
    is_out_of_range = ~is_unsolved & ~is_inconsistent & (distance > MAX_RANGE_M)
    # Without a known scale the distance is not in metres.
    is_out_of_range &= scene.scale != "unit"
    is_accepted = ~(is_unsolved | is_inconsistent | is_out_of_range)
    is_jump = find_jumps(epochs, estimates, is_accepted)
    is_accepted &= ~is_jump
    rejected["moment_with_too_few_sweeps"] += int(np.count_nonzero(is_unsolved))
    rejected["moment_inconsistent"] += int(np.count_nonzero(is_inconsistent))
    rejected["moment_out_of_reach"] += int(np.count_nonzero(is_out_of_range))
    rejected["moment_jumps"] += int(np.count_nonzero(is_jump))

    # Residuals in a design are those of its stations, which count as errors of the scene.
    sigma = ANGLE_SIGMA_RAD if is_design else angle_sigma(estimates, is_accepted)
    calibration_sigma = None
    is_generic = any(c.is_generic for c in stations[2])
    # A floor homography absorbs the errors of the calibration.
    if is_generic and floor_map is None:
        calibration_sigma = CALIBRATION_SIGMA_RAD
    covariance = estimates.covariance(
        float(np.hypot(sigma, calibration_sigma)) if calibration_sigma else sigma,
        floor_z is not None,
    )
    if is_design:
        errors = SceneErrors(scene, selected, floor_z)
        is_seen = np.asarray(np.isfinite(estimates.residual).all(axis=2))
        for row in np.flatnonzero(is_accepted).tolist():
            covariance[row] += errors.position_covariance(
                estimates.position[row].tolist(), np.flatnonzero(is_seen[row]).tolist()
            )
    return PhotodiodeTracks(
        split_by_device(epochs, is_accepted, estimates.position, scene.frame, covariance),
        epochs,
        estimates,
        is_accepted,
        sigma,
        calibration_sigma,
        restored,
        add_counts(rejected),
        (
            *_restored_warnings(restored),
            *_contradiction_warnings(
                int(np.count_nonzero(is_inconsistent)), int(np.count_nonzero(~is_unsolved))
            ),
        ),
    )


def split_by_device(
    epochs: Epochs,
    is_accepted: NDArray[np.bool_],
    position: Array,
    frame: str,
    covariance: Array | None = None,
) -> tuple[Trajectory, ...]:
    """Return a trajectory for each device of the epochs, of accepted positions (m, 3)."""
    trajectories = []
    for k, name in enumerate(epochs.devices):
        rows = np.flatnonzero(is_accepted & (epochs.device == k))
        trajectories.append(
            Trajectory.from_positions(
                name,
                frame,
                epochs.time_ns[rows],
                position[rows],
                None if covariance is None else covariance[rows],
            )
        )
    return tuple(trajectories)


def _restored_warnings(restored: int) -> list[SolverWarning]:
    """Return a warning if epochs had swapped sweeps."""
    if not restored:
        return []
    return [
        SolverWarning(
            "swapped_sweeps_restored",
            f"{restored} epochs had swapped sweeps of the two stations, which were restored",
        )
    ]


def _contradiction_warnings(inconsistent: int, solved: int) -> list[SolverWarning]:
    """Return a warning if many of the solved epochs contradict the scene."""
    fraction = inconsistent / max(1, solved)
    if fraction <= MAX_INCONSISTENT_FRACTION:
        return []
    return [
        SolverWarning(
            "scene_contradicted",
            f"{fraction:.0%} of the epochs contradict the scene: a station was moved since, the "
            "scene is of another site, or robots moved too fast between sweeps",
        )
    ]


# ---- noise and gates


def angle_sigma(estimates: PositionEstimates, is_accepted: NDArray[np.bool_]) -> float:
    """Estimate the standard deviation of an angle in radians from redundant epochs.

    The sum of squared residuals of an epoch has a chi-square distribution. Its median is compared
    (approximation of Wilson and Hilferty 1931), so that outliers do not count. The result is never
    below :data:`~locatk.core.lighthouse.noise.ANGLE_SIGMA_RAD`.
    """
    is_redundant = is_accepted & (estimates.redundancy > 0)
    if not np.any(is_redundant):
        return ANGLE_SIGMA_RAD
    redundancy = estimates.redundancy[is_redundant]
    squares = np.nansum(estimates.residual[is_redundant] ** 2, axis=(1, 2))
    median = redundancy * (1.0 - 2.0 / (9.0 * redundancy)) ** 3
    return max(ANGLE_SIGMA_RAD, float(np.sqrt(np.median(squares / median))))


def inlier_gate(estimates: PositionEstimates) -> float:
    """Return the largest residual of a consistent epoch, in radians.

    :data:`~locatk.core.lighthouse.noise.INLIER_GATE_SIGMAS` times the noise of the recording,
    between :data:`~locatk.core.lighthouse.noise.MIN_INLIER_GATE_RAD` and
    :data:`~locatk.core.lighthouse.noise.INLIER_GATE_RAD`.
    """
    noise = angle_sigma(estimates, estimates.max_residual < INLIER_GATE_RAD)
    return float(np.clip(INLIER_GATE_SIGMAS * noise, MIN_INLIER_GATE_RAD, INLIER_GATE_RAD))


def mounting_sigma(stations: Sequence[Station], positions: Array) -> float:
    """Return the standard deviation of angles by the poses of designed stations [rad].

    ``positions`` (m, 3) are those of photodiodes.
    """
    if not np.any(np.isfinite(positions)):
        return 0.0
    variances = []
    for station in stations:
        distance = np.nanmedian(np.linalg.norm(positions - station.position, axis=1))
        if station.covariance is None:
            continue
        own = np.diagonal(station.covariance)
        variances.append(np.mean(own[:3]) / distance**2 + np.mean(own[3:]))
    return float(np.sqrt(np.mean(variances))) if variances else 0.0


def find_jumps(
    epochs: Epochs, estimates: PositionEstimates, is_accepted: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find epochs that leave the trajectory of their device.

    Each position is compared with the one that its neighbours predict: the median of the
    interpolations between all pairs of a neighbour before and one after it, which is right as long
    as most of them are. A jump departs from it by much more than is usual in the recording, and
    than its neighbours depart from what is predicted for them without it. The latter tells a jump
    from a corner.

    Returns
    -------
    (m,) bool ndarray
    """
    is_jump = np.zeros(len(epochs), bool)
    for device in range(len(epochs.devices)):
        rows = np.flatnonzero(is_accepted & (epochs.device == device))
        # Jumps spoil the predictions of their neighbours: the largest ones are removed first.
        for _ in range(MAX_JUMP_PASSES):
            own = rows[~is_jump[rows]]
            if len(own) < 2 * JUMP_NEIGHBOURS + 1:
                break
            time_s = (epochs.time_ns[own] - epochs.time_ns[own[0]]) * 1e-9
            is_free = estimates.redundancy[own] <= 0
            found = _stand_out(time_s, estimates.position[own], is_free)
            if not np.any(found):
                break
            is_jump[own[found]] = True
    return is_jump


def _stand_out(time_s: Array, position: Array, is_free: Mask) -> Mask:
    """Return which positions (n, d) depart from their predictions, the largest around each.

    Those without redundancy, ``is_free`` (n,), contain wrong sweeps more often: several together
    make each other's predictions wrong, but exceed what the usual speed explains.
    """
    count = len(position)
    departure = _departures(time_s, position, np.arange(count))
    excess = np.zeros(count)
    if np.any(np.isfinite(departure)):
        usual = float(np.nanpercentile(departure, USUAL_MOTION_PERCENTILE))
        far = np.flatnonzero(departure > MAX_JUMP_RATIO * usual)
        sides = []
        for sign in (-1, 1):
            # The better one of two neighbours: the other one may be wrong as well.
            nearest = [
                _departures(time_s, position, far + sign * k, without=-sign * k) for k in (1, 2)
            ]
            sides.append(np.fmin(*nearest))
        spacing_s = np.diff(time_s)
        step = np.linalg.norm(np.diff(position, axis=0), axis=1)
        speed = np.percentile(step / np.maximum(spacing_s, 1e-9), USUAL_MOTION_PERCENTILE)
        around_s = np.concatenate([[np.inf], spacing_s, [np.inf]])
        reach = speed * np.maximum(around_s[far], around_s[far + 1])
        limit = np.fmin(np.fmax(*sides), np.where(is_free[far], reach, np.inf))
        largest = MAX_JUMP_RATIO * limit
        is_jump = ~(departure[far] <= largest)
        excess[far[is_jump]] = departure[far[is_jump]]
    windows = sliding_window_view(np.pad(excess, JUMP_NEIGHBOURS), 2 * JUMP_NEIGHBOURS + 1)
    return np.asarray((excess > 0.0) & (excess >= windows.max(axis=1)))


def _departures(time_s: Array, position: Array, rows: IntArray, without: int = 0) -> Array:
    """Return the distances (m,) of positions from what their neighbours predict; ``nan`` without.

    The neighbour at the offset ``without`` is not used. At the ends of a trajectory and of pauses,
    positions are extrapolated from one side. Rows beyond the ends have no distance.
    """
    reach = JUMP_NEIGHBOURS + 1
    before = [k for k in range(-reach, 0) if k != without][-JUMP_NEIGHBOURS:]
    after = [k for k in range(1, reach + 1) if k != without][:JUMP_NEIGHBOURS]
    beyond = [*combinations(before, 2), *combinations(after, 2)]
    departure = np.full(len(rows), np.nan)
    missing = np.flatnonzero((rows >= 0) & (rows < len(position)))
    for pairs in (product(before, after), beyond):
        own = rows[missing]
        predicted = np.stack([_predict(time_s, position, own, i, j) for i, j in pairs], axis=-1)
        # Sorted, with the missing ones last: faster than a median that looks for them.
        predicted.sort(axis=-1)
        count = np.isfinite(predicted[:, 0]).sum(axis=-1)
        is_known = count >= MIN_PREDICTIONS
        upper = (count // 2)[is_known, None, None]
        lower = ((count - 1) // 2)[is_known, None, None]
        known = predicted[is_known]
        middle = sum(np.take_along_axis(known, k, axis=-1)[..., 0] for k in (lower, upper)) / 2
        offset = position[own[is_known]] - middle
        departure[missing[is_known]] = np.linalg.norm(offset, axis=1)
        missing = missing[~is_known]
    return departure


def _predict(time_s: Array, position: Array, rows: IntArray, first: int, second: int) -> Array:
    """Return the positions (m, d) on lines through two neighbours of each row; ``nan`` without."""
    low, high = rows + first, rows + second
    is_inside = (np.minimum(low, high) >= 0) & (np.maximum(low, high) < len(position))
    low, high = (np.clip(index, 0, len(position) - 1) for index in (low, high))
    times_s = np.stack([time_s[low], time_s[rows], time_s[high]])
    span_s = time_s[high] - time_s[low]
    is_inside &= (np.ptp(times_s, axis=0) < MAX_JUMP_WINDOW_S) & (span_s != 0)
    fraction = (time_s[rows] - time_s[low]) / np.where(span_s != 0, span_s, 1.0)
    is_inside &= np.abs(fraction - 0.5) <= MAX_EXTRAPOLATION + 0.5
    on_line = position[low] + fraction[:, None] * (position[high] - position[low])
    return np.where(is_inside[:, None], on_line, np.nan)


# ---- contradictions


def restore_swapped_sweeps(
    epochs: Epochs,
    estimates: PositionEstimates,
    stations: StationArrays,
    floor_z: float | None,
) -> tuple[Epochs, PositionEstimates, int]:
    """Restore sweeps of two stations that a report without polynomials exchanged.

    Reports that sort the counts of two stations exchange one plane of theirs, or both, whenever the
    counts cross. Such an epoch contradicts itself, and fits exactly after the exchange is undone.

    Returns
    -------
    epochs, estimates, count
        With restored sweeps, and the number of restored epochs.
    """
    restored = 0
    if epochs.labelled or len(epochs.channels) != 2:
        return epochs, estimates, restored
    wrong = np.flatnonzero((estimates.max_residual > INLIER_GATE_RAD) & (estimates.redundancy > 0))
    for planes in SWAPPED_PLANES:
        counts = epochs.counts[wrong].copy()
        counts[:, :, planes] = counts[:, ::-1, planes]
        trial = estimate_positions(
            rotor_angles(replace(epochs, counts=counts)), *stations, floor_z=floor_z
        )
        # Half of the gate, because a wrong exchange can fit just within it by chance.
        is_right = np.isfinite(trial.position[:, 0])
        is_right &= trial.max_residual < INLIER_GATE_RAD / 2
        rows = wrong[is_right]
        corrected = epochs.counts.copy()
        corrected[rows] = counts[is_right]
        epochs = replace(epochs, counts=corrected)
        estimates = estimates.replaced(rows, trial, is_right)
        restored += len(rows)
        wrong = wrong[~is_right]
    return epochs, estimates, restored


def leave_out_worst_station(
    ideal: Array,
    estimates: PositionEstimates,
    stations: StationArrays,
    floor_z: float | None,
    gate: float,
) -> tuple[PositionEstimates, int]:
    """Solve inconsistent epochs of three stations or more without the worst station.

    Parameters
    ----------
    ideal : (m, s, 2) ndarray
        Angles of ideal planes (:func:`.positions.correct_angles`).
    estimates : PositionEstimates
    stations : StationArrays
    floor_z : float, optional
    gate : float
        Largest residual of a consistent epoch, in radians.

    Returns
    -------
    estimates, count
        Consistent estimates replace the others if leaving out one station yields any; their number.
    """
    if ideal.shape[1] < 3:
        return estimates, 0
    wrong = np.flatnonzero((estimates.max_residual > gate) & (estimates.redundancy > 2))
    best = estimates.max_residual[wrong].copy()
    is_repaired = np.zeros(len(wrong), bool)
    for column in range(ideal.shape[1]):
        without_station = ideal[wrong]
        without_station[:, column] = np.nan
        trial = intersect_planes(without_station, *stations, floor_z=floor_z)
        is_better = (
            np.isfinite(trial.position[:, 0])
            & (trial.max_residual < np.minimum(best, gate))
            & (trial.redundancy > 0)
        )
        best[is_better] = trial.max_residual[is_better]
        is_repaired |= is_better
        estimates = estimates.replaced(wrong[is_better], trial, is_better)
    return estimates, int(np.count_nonzero(is_repaired))


# ---- detections


def detect_stations(
    epochs: Epochs,
    stations: dict[int, Station],
    residual: Array | None = None,
    is_accepted: NDArray[np.bool_] | None = None,
    verification: SceneVerification | None = None,
) -> tuple[StationDetection, ...]:
    """Summarize the sweeps of each station of a recording.

    Parameters
    ----------
    epochs : Epochs
    stations : dict of int to Station
        By channel; stations without pose are missing.
    residual : (m, s, 2) ndarray, optional
        Residuals of the estimated positions, in radians.
    is_accepted : (m,) bool ndarray, optional
        Accepted epochs; all if omitted.
    verification : SceneVerification, optional
        Of the stations of the epochs, in the same order.
    """
    is_observed = np.isfinite(epochs.counts)
    detections = []
    for i, channel in enumerate(epochs.channels):
        station = stations.get(int(channel))
        is_used = is_observed[:, i]
        if is_accepted is not None:
            is_used = is_used & is_accepted[:, None]
        check = verification.stations[i] if verification else None
        detections.append(
            StationDetection(
                station=i,
                channel=int(channel),
                id=None if station is None or station.id is None else f"{station.id:08x}",
                period_ticks=int(period_ticks(int(channel))),
                calibration="none" if station is None else station.calibration.source,
                sweeps=int(np.count_nonzero(is_used)),
                rejected=int(np.count_nonzero(is_observed[:, i]) - np.count_nonzero(is_used)),
                residual_rad=None
                if residual is None or is_accepted is None
                else robust_sigma(residual[is_accepted][:, i]),
                verification_rad=check.residual_rad if check else None,
                verification_m=check.residual_m if check else None,
            )
        )
    return tuple(detections)
