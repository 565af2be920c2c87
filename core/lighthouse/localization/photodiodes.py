"""Poses of all moments in a scene, and why some have none.

Contradictions are resolved where the data allow it (swapped sweeps, a station that lies) and
rejected where they do not; each is counted under its reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.epochs import Epochs, angles_of
from locatk.core.lighthouse.localization.floor_map import estimate_floor_positions
from locatk.core.lighthouse.localization.positions import PositionEstimates, estimate_positions
from locatk.core.lighthouse.noise import (
    ANGLE_SIGMA_RAD,
    CALIBRATION_SIGMA_RAD,
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.selection import spread_evenly
from locatk.core.lighthouse.scene.verification import MOST, StationCheck, verify, wrong_station
from locatk.core.robust import robust_sigma
from locatk.core.solution import Solution, SolverWarning, from_json
from locatk.core.trajectory import Trajectory

if TYPE_CHECKING:
    from locatk.core.lighthouse.job import Job

Array = NDArray[np.float64]
Stations = tuple[Array, Array, tuple[Calibration, ...]]
"""Positions (s, 3), rotations (s, 3, 3) and calibrations of the stations of a recording."""

REACH_M = 20.0
"""Base stations are not received farther away, in metres."""

FEW = 20_000
"""Moments among which those to verify a known scene with are looked for, at most."""

CONTRADICTED = 0.2
"""Share of moments that contradict the scene from which on it needs a word: occlusions,
reflections and fast robots cost a few in a hundred."""


def answer(job: Job, scene: Scene) -> Solution:
    """Locate every moment in the scene, and say what was left out."""
    stations = [s for c in job.epochs.channels if (s := scene.station(int(c))) is not None]
    rig = (
        np.stack([s.position for s in stations]),
        np.stack([s.rotation for s in stations]),
        tuple(s.calibration for s in stations),
    )
    floor = scene.floor_z if scene.planar else None
    floor_map = stations[0].floor_map if len(stations) == 1 else None
    if floor_map is not None:
        fixes = estimate_floor_positions(job.angles, rig[2][0], floor_map, scene.floor_z)
    else:
        fixes = estimate_positions(job.angles, *rig, floor_z=floor)
        fixes = _swap_back(job, fixes, rig, floor)
    gate = _gate(fixes)
    if floor_map is None:
        fixes = _without_worst_station(job, fixes, rig, floor, gate)

    unsolved = ~np.isfinite(fixes.position[:, 0])
    inconsistent = ~unsolved & (fixes.worst > gate)
    distance = np.min(
        np.linalg.norm(fixes.position[:, None] - rig[0], axis=2), axis=1, initial=np.inf
    )
    far = ~unsolved & ~inconsistent & (distance > REACH_M) & (scene.scale != "unit")
    job.reject("moment_with_too_few_sweeps", np.count_nonzero(unsolved))
    job.reject("moment_inconsistent", np.count_nonzero(inconsistent))
    job.reject("moment_out_of_reach", np.count_nonzero(far))
    share = np.count_nonzero(inconsistent) / max(1, int(np.count_nonzero(~unsolved)))
    if share > CONTRADICTED:
        job.notes.append(
            f"{share:.0%} of the moments contradict the scene: a station was moved since, the "
            "scene is of another place, or robots were faster than the sweeps"
        )
    good = ~(unsolved | inconsistent | far)
    jumps = _jumps(job.epochs, fixes, good)
    job.reject("moment_jumps", np.count_nonzero(jumps))
    good &= ~jumps

    sigma = _noise(fixes, good)
    job.facts["angle_sigma_rad"] = sigma
    guessed = any(c.source in ("generic", "estimated") for c in rig[2])
    if guessed and floor_map is None:
        job.facts["calibration_sigma_rad"] = CALIBRATION_SIGMA_RAD
        sigma = float(np.hypot(sigma, CALIBRATION_SIGMA_RAD))
    checks = _verified(job, rig, floor) if floor_map is None else ()
    covariance = fixes.covariance(sigma, floor is not None)
    trajectories = []
    for k, name in enumerate(job.epochs.devices):
        mine = np.flatnonzero(good & (job.epochs.device == k))
        trajectories.append(
            Trajectory.from_positions(
                name,
                scene.frame,
                job.epochs.time_ns[mine],
                fixes.position[mine],
                covariance[mine],
            )
        )
    return Solution(
        "lighthouse",
        job.options.method,
        tuple(trajectories),
        job.rejected,
        tuple(
            from_json(StationDetection, row)
            for row in detections(
                job.epochs, {s.channel: s for s in stations}, fixes.residual, good, checks
            )
        ),
        scene,
        tuple(SolverWarning("unspecified", text) for text in dict.fromkeys(job.notes)),
        from_json(LighthouseFacts, job.facts),
    )


def _verified(job: Job, rig: Stations, floor: float | None) -> tuple[StationCheck, ...]:
    """Check each station on what took no part in solving the scene, and name a wrong one."""
    angles, held_out = job.verified, job.held_out
    if angles is None:
        # What is rejected may be what tells of a wrong station: any moment is a witness.
        seen = _sights(job.angles)
        rows = np.flatnonzero(np.count_nonzero(seen, axis=1) > 1)
        rows = rows[:: 1 + len(rows) // FEW]
        angles, held_out = job.angles[spread_evenly(seen, rows, MOST)], True
    if angles.shape[1] < 2 or len(angles) == 0:
        return ()
    angles = angles[spread_evenly(_sights(angles), np.arange(len(angles)), MOST)]
    checks = verify(angles, job.epochs.channels.tolist(), *rig, floor_z=floor)
    job.facts["verification"] = {
        "held_out": held_out,
        "moments": len(angles),
        "stations": [check.as_facts() for check in checks],
    }
    wrong = wrong_station(checks)
    if wrong is not None and wrong.residual_rad is not None:
        job.notes.append(
            f"station on channel {wrong.channel} is {1e3 * wrong.residual_rad:.1f} mrad from where "
            "the others see the photodiodes, and they agree without it: it was moved since, or is "
            "seen by reflection"
        )
    return checks


def _sights(angles: Array) -> NDArray[np.bool_]:
    """(m, s) whether each station was seen."""
    return np.asarray(np.isfinite(angles).any(axis=2))


def _gate(fixes: PositionEstimates) -> float:
    """Angle by which a plane may miss its position, in radians: far out in what the
    recording itself shows, and never more than :data:`INLIER_GATE_RAD`."""
    noise = _noise(fixes, fixes.worst < INLIER_GATE_RAD)
    return float(np.clip(INLIER_GATE_SIGMAS * noise, MIN_INLIER_GATE_RAD, INLIER_GATE_RAD))


def _jumps(epochs: Epochs, fixes: PositionEstimates, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Moments that nothing checks and that leave the path of their device.

    Compared is each position with the median of the five around it, which a steady motion
    does not leave (Hampel's filter).
    """
    jumps = np.zeros(len(epochs), bool)
    if np.all(fixes.freedom[good] > 0):
        return jumps
    for device in range(len(epochs.devices)):
        mine = np.flatnonzero(good & (epochs.device == device))
        if len(mine) < 5:
            continue
        path = fixes.position[mine]
        first = np.clip(np.arange(len(mine)) - 2, 0, len(mine) - 5)
        window = first[:, None] + np.arange(5)
        away = np.linalg.norm(path - np.median(path[window], axis=1), axis=1)
        step = np.linalg.norm(np.diff(path, axis=0), axis=1)
        usual = max(float(np.percentile(away, 75)), float(np.percentile(step, 75)))
        # Over a pause in the recording a device may be anywhere.
        span = epochs.time_ns[mine[first + 4]] - epochs.time_ns[mine[first]]
        left = (away > 5 * usual) & (span < 2_000_000_000)
        jumps[mine] = left & (fixes.freedom[mine] <= 0)
    return jumps


def _swap_back(
    job: Job, fixes: PositionEstimates, rig: Stations, floor: float | None
) -> PositionEstimates:
    """Give sweeps back to their stations where a report without polynomials mixed them up.

    Reports that sort all counts of two stations exchange a plane of theirs, or both,
    whenever the stations' counts cross. Such a moment contradicts itself as it is, and fits
    exactly with the exchange undone.
    """
    if job.epochs.labelled or len(job.epochs.channels) != 2:
        return fixes
    wrong = np.flatnonzero((fixes.worst > INLIER_GATE_RAD) & (fixes.freedom > 0))
    restored = 0
    for planes in ((0,), (1,), (0, 1)):
        counts = job.epochs.counts[wrong].copy()
        counts[:, :, planes] = counts[:, ::-1, planes]
        trial = angles_of(replace(job.epochs, counts=counts))
        fresh = estimate_positions(trial, *rig, floor_z=floor)
        right = np.isfinite(fresh.position[:, 0]) & (fresh.worst < INLIER_GATE_RAD / 2)
        rows = wrong[right]
        job.correct(rows, counts[right])
        fixes = _with(fixes, rows, fresh, right)
        restored += len(rows)
        wrong = wrong[~right]
    if restored:
        job.facts["moments_with_swapped_sweeps_restored"] = restored
        job.notes.append(
            f"{restored} moments had sweeps of the two stations swapped; they were given back"
        )
    return fixes


def _without_worst_station(
    job: Job,
    fixes: PositionEstimates,
    rig: Stations,
    floor: float | None,
    gate: float,
) -> PositionEstimates:
    """Where one of three or more stations contradicts the others, go on without it."""
    if len(job.epochs.channels) < 3:
        return fixes
    wrong = np.flatnonzero((fixes.worst > gate) & (fixes.freedom > 2))
    best = fixes.worst[wrong].copy()
    repaired = np.zeros(len(wrong), bool)
    for column in range(len(job.epochs.channels)):
        trial = job.angles[wrong].copy()
        trial[:, column] = np.nan
        fresh = estimate_positions(trial, *rig, floor_z=floor)
        better = (
            np.isfinite(fresh.position[:, 0])
            & (fresh.worst < np.minimum(best, gate))
            & (fresh.freedom > 0)
        )
        best[better] = fresh.worst[better]
        repaired |= better
        fixes = _with(fixes, wrong[better], fresh, better)
    job.reject("station_contradicts_others", np.count_nonzero(repaired))
    return fixes


def _with(
    fixes: PositionEstimates,
    rows: NDArray[np.int64],
    fresh: PositionEstimates,
    chosen: NDArray[np.bool_],
) -> PositionEstimates:
    """``fixes`` with the chosen ones of ``fresh`` at ``rows``."""
    changed = {}
    for name in ("position", "information", "residual", "freedom"):
        changed[name] = getattr(fixes, name).copy()
        changed[name][rows] = getattr(fresh, name)[chosen]
    return PositionEstimates(**changed)


def _noise(fixes: PositionEstimates, good: NDArray[np.bool_]) -> float:
    """Standard deviation of an angle in radians, from what redundancy shows of it.

    The sum of squares of a moment's residuals has a chi-square distribution; its median
    (Wilson and Hilferty 1931) is compared, so that outliers do not count. Never below the
    published noise of a standing receiver.
    """
    checked = good & (fixes.freedom > 0)
    if not np.any(checked):
        return ANGLE_SIGMA_RAD
    freedom = fixes.freedom[checked]
    squares = np.nansum(fixes.residual[checked] ** 2, axis=(1, 2))
    median = freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3
    return max(ANGLE_SIGMA_RAD, float(np.sqrt(np.median(squares / median))))


def detections(
    epochs: Epochs,
    stations: dict[int, Station],
    residual: Array | None = None,
    good: NDArray[np.bool_] | None = None,
    checks: Sequence[StationCheck] = (),
) -> list[dict[str, object]]:
    """What was seen of each station, for ``--json`` (docs/formats.md)."""
    seen = np.isfinite(epochs.counts)
    rows = []
    for i, channel in enumerate(epochs.channels):
        station = stations.get(int(channel))
        used = seen[:, i] if good is None else seen[:, i] & good[:, None]
        row: dict[str, object] = {
            "station": i,
            "channel": int(channel),
            "id": None if station is None or station.id is None else f"{station.id:08x}",
            "period_ticks": int(period_ticks(int(channel))),
            "calibration": "none" if station is None else station.calibration.source,
            "sweeps": int(np.count_nonzero(used)),
            "rejected": int(np.count_nonzero(seen[:, i]) - np.count_nonzero(used)),
        }
        if residual is not None and good is not None:
            row["residual_rad"] = robust_sigma(residual[good][:, i])
        if checks:
            row["verification_rad"] = checks[i].residual_rad
            row["verification_m"] = checks[i].residual_m
        rows.append(row)
    return rows
