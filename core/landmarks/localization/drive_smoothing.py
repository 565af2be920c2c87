"""Smoothing of a whole drive of one robot, in parts if it is long; warnings of contradictions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.localization.cell_filter import IdentifiedVisit
from locatk.core.landmarks.localization.consistency import (
    warn_of_carrying,
    warn_of_cause,
    warn_of_scale,
)
from locatk.core.landmarks.localization.robust_smoothing import (
    Cause,
    DisplacedLandmark,
    RobustSmoothing,
    WheelSlip,
    smooth_robustly,
)
from locatk.core.landmarks.localization.smoothing import (
    LAG_COLUMN,
    POSE_SIZE,
    SMOOTHED_MODEL_ERROR_T,
    landmark_priors,
    measure_visits,
)
from locatk.core.landmarks.localization.trajectory import estimate_trajectory
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

MAX_PART_VISITS, PART_VISITS, NEIGHBOURING_VISITS = 96, 64, 8
"""Number of visits from which on a drive is smoothed in parts, of these parts, and of the visits on
either side that are smoothed with them."""

MIN_LAG_SIGMAS = 4.0
"""Significance of a lag."""

MIN_LAG_S = 2e-3
"""Lag of the odometry that is removed: the linearization takes smaller ones."""

MAX_RESIDUAL_SIGMAS = 2.0
"""Rms residual of all fields after smoothing from which on a warning is given ..."""

MAX_CREDIBLE_RESIDUAL_SIGMAS = 12.0
"""... and from which on the poses are not reported."""


@dataclass(frozen=True)
class SmoothedPart:
    """Part of a drive that was smoothed at once.

    Attributes
    ----------
    smoothed : RobustSmoothing
    visits : list of IdentifiedVisit
        Visits from which poses were estimated, those next to this part included.
    cells : frozenset of (row, column)
        Cells of the visits of this part.
    first_ns, stop_ns : int
        Times of this part; the smoothing extends into its neighbours.
    """

    smoothed: RobustSmoothing
    visits: list[IdentifiedVisit]
    cells: frozenset[Cell]
    first_ns: int
    stop_ns: int

    @property
    def residual_sigma(self) -> float:
        """Rms residual of the fields, in standard deviations."""
        return self.smoothed.result.residual_sigma

    @property
    def is_credible(self) -> bool:
        """True if the fields agree well enough for poses to be reported."""
        return self.residual_sigma <= MAX_CREDIBLE_RESIDUAL_SIGMAS

    def trajectory(self, odometry: Trajectory) -> Trajectory:
        """Return the poses during this part."""
        first_ns, last_ns = self.first_ns, self.stop_ns
        visits = self.smoothed.measurements.visits
        if first_ns > odometry.time_ns[0]:
            first_ns = min(first_ns, int(visits[0].segment.time_ns[0]))
        if last_ns <= odometry.time_ns[-1]:
            last_ns = max(last_ns, int(visits[-1].segment.time_ns[-1]))
        is_near = (odometry.time_ns >= first_ns) & (odometry.time_ns <= last_ns)
        poses = estimate_trajectory(
            odometry.device,
            self.smoothed.measurements,
            self.smoothed.result.visits[0],
            odometry.select(is_near),
            self.smoothed.slipped_links,
        )
        return poses.select((poses.time_ns >= self.first_ns) & (poses.time_ns < self.stop_ns))

    def significant_lag(self, drift: OdometryDrift) -> float:
        """Return the lag of the odometry in seconds, or 0 if it is not significant."""
        visit, column = self.smoothed.result.visits[0][0], POSE_SIZE + LAG_COLUMN
        variance = visit.covariance[column, column]
        return significant_lag(visit.corrections[LAG_COLUMN], variance, drift)

    def causes(self) -> list[tuple[Cause, ...]]:
        """Return the inconsistencies of this part."""
        return [
            cause
            for cause in self.smoothed.causes
            if (
                self.first_ns <= cause[0].first_ns < self.stop_ns
                if isinstance(cause[0], WheelSlip)
                else cause[0].cell in self.cells
            )
        ]


@dataclass(frozen=True)
class LostPart:
    """Part of a drive without poses, because fields and odometry contradict each other.

    Attributes
    ----------
    visits : list of IdentifiedVisit
        Visits of this part.
    first_ns, stop_ns : int
        Times without poses.
    """

    visits: list[IdentifiedVisit]
    first_ns: int
    stop_ns: int


@dataclass(frozen=True)
class SmoothedDrive:
    """All parts of the drive of one robot.

    Attributes
    ----------
    parts : list of SmoothedPart
        Those that have a solution, credible or not.
    lost_parts : list of LostPart
        Those that have no solution, or none that is credible.
    drift : OdometryDrift
        Before anything was estimated.
    """

    parts: list[SmoothedPart]
    lost_parts: list[LostPart]
    drift: OdometryDrift

    @property
    def visits(self) -> list[IdentifiedVisit]:
        """Visits from which poses were estimated, in order of time."""
        return list({id(visit): visit for part in self.parts for visit in part.visits}.values())

    @property
    def lost_visits(self) -> list[IdentifiedVisit]:
        """Visits of the parts without poses, in order of time."""
        return [visit for part in self.lost_parts for visit in part.visits]

    @property
    def displaced_cells(self) -> set[Cell]:
        """Cells whose landmarks are named as displaced."""
        causes = [one for part in self.parts for cause in part.causes() for one in cause]
        return {one.cell for one in causes if isinstance(one, DisplacedLandmark)}

    @property
    def residual_sigma(self) -> float:
        """Rms residual of all fields, in standard deviations."""
        return math.sqrt(float(np.mean([part.residual_sigma**2 for part in self.parts])))

    def significant_lag(self) -> float:
        """Return the lag of the odometry in seconds, or 0 if it is not significant."""
        return float(np.median([part.significant_lag(self.drift) for part in self.parts]))

    def trajectory(self, odometry: Trajectory) -> Trajectory | None:
        """Return the poses of all parts whose residual is credible; None if there are none."""
        poses = [part.trajectory(odometry) for part in self.parts if part.is_credible]
        if len(poses) < 2:
            return poses[0] if poses else None
        return replace(
            poses[0],
            time_ns=np.concatenate([each.time_ns for each in poses]),
            position=np.concatenate([each.position for each in poses]),
            quaternion=np.concatenate([each.quaternion for each in poses]),
            covariance=np.concatenate([each.covariance for each in poses]),
        )

    def warnings(self) -> list[SolverWarning]:
        """Return warnings of what contradicts the model."""
        causes = [cause for part in self.parts for cause in part.causes()]
        warnings = [warn_of_cause(*cause) for cause in causes]
        for part in self.parts:
            warnings += warn_of_carrying(part.smoothed.measurements)
        warnings += warn_of_scale(self.parts[0].smoothed.result, self.drift)
        misfits = []
        if self.residual_sigma > MAX_RESIDUAL_SIGMAS:
            misfits.append(f"fields deviate from the model by {self.residual_sigma:.2g} sigma")
        misfits += [
            f"no poses from {1e-9 * part.first_ns:.3f} to {1e-9 * part.stop_ns:.3f} s, where the "
            "fields and the odometry contradict each other"
            for part in self.lost_parts
        ]
        if misfits:
            message = (
                f"{'; '.join(misfits)}: check clocks and scale of the odometry, the sensors and "
                "the landmarks' geometry"
            )
            warnings.append(SolverWarning("field_misfit", message))
        # Neighbouring parts have visits in common.
        return list(dict.fromkeys(warnings))


def smooth_drive(
    visits: Sequence[IdentifiedVisit],
    odometry: Trajectory,
    floor: FloorMap,
    priors: ModelPriors,
    *,
    estimate_walk: bool = True,
) -> SmoothedDrive:
    """Smooth the visits of one robot.

    The time of a smoothing grows with the square of its visits. A long drive is therefore smoothed
    in parts, each with the visits next to it: visits farther away are of no use to each other,
    because the landmarks between them are known.

    A visit during which a wheel slipped is not used: its path is not known.

    Parameters
    ----------
    visits : sequence of IdentifiedVisit
        Visits with a cell, in order of time; at least one.
    odometry : Trajectory
    floor : FloorMap
    priors : ModelPriors
        With the noise of the recording.
    estimate_walk : bool
        See :func:`.robust_smoothing.smooth_robustly`.

    Raises
    ------
    DegenerateError
        No part has a solution, because fields and odometry contradict each other.
    """
    count = round(len(visits) / PART_VISITS) if len(visits) > MAX_PART_VISITS else 1
    edges = np.linspace(0, len(visits), count + 1).astype(int).tolist()
    starts_ns = [int(visits[edge].segment.time_ns[0]) for edge in edges[1:-1]]
    limits = np.iinfo(np.int64)
    bounds_ns = [int(limits.min), *starts_ns, int(limits.max)]
    ranges = zip(pairwise(edges), pairwise(bounds_ns), strict=True)
    parts, lost_parts = [], []
    for (start, stop), (first_ns, stop_ns) in ranges:
        own = list(visits[start:stop])
        lost = LostPart(
            own,
            max(first_ns, int(odometry.time_ns[0])),
            min(stop_ns, int(odometry.time_ns[-1])),
        )
        near = visits[max(0, start - NEIGHBOURING_VISITS) : stop + NEIGHBOURING_VISITS]
        try:
            smoothed, used = _smooth_part(
                near, odometry, floor, priors, estimate_walk=estimate_walk
            )
        except DegenerateError:
            lost_parts.append(lost)
            continue
        cells = frozenset(visit.cell for visit in own)
        part = SmoothedPart(smoothed, used, cells, first_ns, stop_ns)
        parts.append(part)
        if not part.is_credible:
            lost_parts.append(lost)
    if not parts:
        raise DegenerateError("the fields and the odometry contradict each other")
    return SmoothedDrive(parts, lost_parts, priors.drift)


def _smooth_part(
    visits: Sequence[IdentifiedVisit],
    odometry: Trajectory,
    floor: FloorMap,
    priors: ModelPriors,
    *,
    estimate_walk: bool,
) -> tuple[RobustSmoothing, list[IdentifiedVisit]]:
    """Smooth successive visits, without those during which a wheel slipped, if two are left.

    Returns the visits that were used as well.
    """
    landmarks = landmark_priors(visits, floor, priors)
    of_model = replace(priors, model_error_t=SMOOTHED_MODEL_ERROR_T)
    while True:
        smoothed = smooth_robustly(
            measure_visits(visits, odometry, priors, floor),
            landmarks,
            floor.geometry,
            of_model,
            estimate_walk=estimate_walk,
        )
        usable = [visit for n, visit in enumerate(visits) if n not in smoothed.slipped_visits]
        if len(usable) in (len(visits), 0, 1):
            return smoothed, list(visits)
        visits = usable


def significant_lag(error: float, variance: float, drift: OdometryDrift) -> float:
    """Return the lag of the odometry in seconds, or 0 if it is not significant.

    ``error`` and its variance are in standard deviations of the drift.
    """
    min_error = max(MIN_LAG_SIGMAS * math.sqrt(variance), MIN_LAG_S / max(drift.lag_s, 1e-9))
    return float(error) * drift.lag_s if abs(error) > min_error else 0.0
