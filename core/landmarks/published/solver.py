"""Published algorithm on whole recordings: visits, three neighbours on the map, odometry between.

The paper needs three neighbouring landmarks in a row (section 4.2); here any three that were read
one after the other. The paper has no uncertainty: covariances are ``nan``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.detection.trace import compose, relative
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import HALF_PI_RAD, Geometry
from locatk.core.landmarks.localization.cell_filter import CellEstimate
from locatk.core.landmarks.localization.consistency import NO_MAP_WARNING, describe_visit
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import DEFAULT_PITCH_M
from locatk.core.landmarks.published.global_localization import landmark_sequence, match_map
from locatk.core.landmarks.published.search import detect_landmarks
from locatk.core.landmarks.results import (
    LandmarkDetection,
    LandmarkFacts,
    RobotFacts,
)
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

WINDOW_LANDMARKS = 3
"""Landmarks in a row that are compared with the map (section 4.2)."""

MAX_CELL_ERROR_FRACTION = 0.25
"""Largest distance of a landmark from its cell by odometry, in units of the pitch."""


def solve(
    samples: Sequence[HallSamples],
    floor: FloorMap | None,
    *,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """Detect landmarks and localize robots by the paper's sections 3 and 4.

    Parameters and result are those of :func:`locatk.core.landmarks.solver.solve`.

    Raises
    ------
    InputError
        A recording has no odometry, or none of its sensors can be used.
    """
    geometry = floor.geometry if floor is not None else Geometry()
    pitch_m = floor.pitch_m if floor is not None else DEFAULT_PITCH_M
    trajectories: list[Trajectory] = []
    detections: list[LandmarkDetection] = []
    warnings: list[SolverWarning] = []
    robots: dict[str, RobotFacts] = {}
    for recording in samples:
        device = recording.device
        own_odometry = next((t for t in odometry if t.device == device), None)
        if own_odometry is None:
            raise InputError(
                f"no odometry of {device}",
                hint="Record it with the hall sensors: four fields alone do not give a path",
            )
        visits = detect_landmarks(recording, own_odometry, geometry, pitch_m)
        located = _locate_visits(visits, floor) if floor is not None else {}
        robots[device] = RobotFacts(localised=bool(located), landmarks_seen=len(visits))
        if located and floor is not None:
            trajectories.append(_dead_reckoning(device, visits, located, own_odometry, floor))
        elif floor is not None:
            message = (
                f"not localised: no {WINDOW_LANDMARKS} landmarks in a row were read that occur "
                "once on the map"
            )
            warnings.append(SolverWarning("not_localised", message).about(device))
        else:
            warnings.append(NO_MAP_WARNING.about(device))
        for n, visit in enumerate(visits):
            detections.append(describe_visit(visit, located.get(n), floor))
            if visit.refused:
                warnings += [each.about(device) for each in visit.warnings]
    refused = Counter(each.refused for each in detections if each.refused)
    return Solution(
        system="landmarks",
        method="paper",
        trajectories=tuple(trajectories),
        rejected=dict(refused),
        detections=tuple(detections),
        artifact=floor,
        warnings=tuple(warnings),
        facts=LandmarkFacts(robots),
    )


def _locate_visits(visits: Sequence[VisitHypotheses], floor: FloorMap) -> dict[int, CellEstimate]:
    """Return the cells of the visits by their number.

    They start from the first three visits in a row that occur once on the map; empty if there are
    none.
    """
    for first in range(len(visits) - WINDOW_LANDMARKS + 1):
        group = visits[first : first + WINDOW_LANDMARKS]
        if any(visit.refused or not visit.hypotheses for visit in group):
            continue
        sequence = landmark_sequence(group, floor.pitch_m)
        if sequence is None:
            continue
        matches = match_map(floor, *sequence)
        if matches.status == "found":
            cell, arrival = matches.positions[0]
            return _propagate_cells(visits, first + WINDOW_LANDMARKS - 1, cell, arrival, floor)
    return {}


def _propagate_cells(
    visits: Sequence[VisitHypotheses],
    known: int,
    cell: tuple[int, int],
    arrival: int,
    floor: FloorMap,
) -> dict[int, CellEstimate]:
    """Return the cells of all visits, from one with known cell and heading on arrival."""
    step = visits[known].landmark_position() - visits[known - 1].landmark_position()
    odometry_rotation = arrival * HALF_PI_RAD - math.atan2(step[1], step[0])
    located = {known: CellEstimate(cell, _quarters(visits[known], odometry_rotation), 0, 1.0, 1.0)}
    for numbers in (range(known + 1, len(visits)), range(known - 1, -1, -1)):
        last = known
        for n in numbers:
            visit = visits[n]
            if visit.refused or not visit.hypotheses:
                continue
            # The last landmark gives the rotation of the odometry's frame on the map.
            rotation = (
                located[last].quarters * HALF_PI_RAD
                + visits[last].best.pose[2]
                - visits[last].odometry[2]
            )
            x, y = visit.landmark_position() - visits[last].landmark_position()
            cells = (
                np.array(
                    [
                        math.cos(rotation) * y + math.sin(rotation) * x,
                        math.cos(rotation) * x - math.sin(rotation) * y,
                    ]
                )
                / floor.pitch_m
            )
            whole = np.round(cells)
            if np.abs(cells - whole).max() > MAX_CELL_ERROR_FRACTION:
                continue
            row, column = located[last].cell
            next_cell = (row + int(whole[0]), column + int(whole[1]))
            located[n] = CellEstimate(next_cell, _quarters(visit, rotation), 0, 1.0, 1.0)
            last = n
    return located


def _quarters(visit: VisitHypotheses, odometry_rotation: float) -> int:
    """Return the rotation of a visit's frame on the map, in quarter turns."""
    heading = float(visit.odometry[2]) + odometry_rotation
    return round((heading - visit.best.pose[2]) / HALF_PI_RAD) % 4


def _dead_reckoning(
    device: str,
    visits: Sequence[VisitHypotheses],
    located: dict[int, CellEstimate],
    odometry: Trajectory,
    floor: FloorMap,
) -> Trajectory:
    """Return poses at the times of the odometry, each from the last landmark before it."""
    own = np.column_stack([odometry.position[:, :2], heading_from_quaternion(odometry.quaternion)])
    pose = np.empty_like(own)
    numbers = sorted(located)
    starts = np.searchsorted(odometry.time_ns, [visits[n].time_ns for n in numbers])
    starts[0] = 0
    for k, n in enumerate(numbers):
        part = slice(starts[k], starts[k + 1] if k + 1 < len(numbers) else len(own))
        frame = np.array([*floor.position(located[n].cell), located[n].quarters * HALF_PI_RAD])
        at_landmark = compose(frame, visits[n].best.pose)
        pose[part] = compose(at_landmark, relative(own[part], visits[n].odometry))
    return Trajectory(
        device,
        "map",
        odometry.time_ns,
        np.column_stack([pose[:, :2], np.zeros(len(pose))]),
        quaternion_from_heading(pose[:, 2]),
        np.full((len(pose), 6, 6), np.nan),
    )
