"""The published algorithm on whole recordings: sightings, an L on the map, odometry between.

The paper asks for three neighbouring landmarks in a row (section 4.2); any three that were
read one after the other do here. It knows no uncertainty: covariances are ``nan``.
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
from locatk.core.landmarks.localization.consistency import NO_MAP_WARNING
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.published import search as paper
from locatk.core.landmarks.published.route import locate, sequence
from locatk.core.landmarks.results import (
    LandmarkDetection,
    LandmarkFacts,
    RobotFacts,
    describe_visit,
)
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

IN_A_ROW = 3

ASTRAY = 0.25
"""Of the pitch: how far a landmark may be off its cell by odometry."""


def solve(
    samples: Sequence[HallSamples],
    floor: FloorMap | None,
    *,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """As :func:`.solver.solve`, by the paper's sections 3 and 4.

    Raises
    ------
    InputError
        A recording has no odometry, or no sensor of it can be used.
    """
    geometry = floor.geometry if floor is not None else Geometry()
    trajectories: list[Trajectory] = []
    detections: list[LandmarkDetection] = []
    warnings: list[SolverWarning] = []
    robots: dict[str, RobotFacts] = {}
    for recording in samples:
        device = recording.device
        driven = next((t for t in odometry if t.device == device), None)
        if driven is None:
            raise InputError(
                f"no odometry of {device}",
                hint="Record it beside the hall sensors: a trace without a way says too little",
            )
        found = paper.sightings(recording, driven, geometry)
        located = _located(found, floor) if floor is not None else {}
        robots[device] = RobotFacts(localised=bool(located), landmarks_seen=len(found))
        if located and floor is not None:
            trajectories.append(_driven(device, found, located, driven, floor))
        elif floor is not None:
            message = (
                f"not localised; no {IN_A_ROW} landmarks in a row were read that the map has only "
                "once"
            )
            warnings.append(SolverWarning("not_localised", message).about(device))
        else:
            warnings.append(NO_MAP_WARNING.about(device))
        for n, one in enumerate(found):
            detections.append(describe_visit(one, located.get(n), floor))
            if one.refused:
                warnings += [each.about(device) for each in one.warnings]
    refused = Counter(seen.refused for seen in detections if seen.refused)
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


def _located(found: Sequence[VisitHypotheses], floor: FloorMap) -> dict[int, CellEstimate]:
    """Cells of the sightings, by their number, from the first three in a row that the map
    has only once; empty where there are none."""
    for first in range(len(found) - IN_A_ROW + 1):
        group = found[first : first + IN_A_ROW]
        if any(one.refused or not one.hypotheses for one in group):
            continue
        told = sequence(group, floor.pitch_m)
        if told is None:
            continue
        places = locate(floor, *told)
        if places.status == "found":
            cell, arrival = places.places[0]
            return _spread(found, first + IN_A_ROW - 1, cell, arrival, floor)
    return {}


def _spread(
    found: Sequence[VisitHypotheses],
    known: int,
    cell: tuple[int, int],
    arrival: int,
    floor: FloorMap,
) -> dict[int, CellEstimate]:
    """Cells of all sightings, from one whose cell and heading on arrival are known."""
    own = found[known].landmark_position() - found[known - 1].landmark_position()
    turn = arrival * HALF_PI_RAD - math.atan2(own[1], own[0])
    out = {known: CellEstimate(cell, _quarters(found[known], turn), 0, 1.0, 1.0)}
    for numbers in (range(known + 1, len(found)), range(known - 1, -1, -1)):
        at, swing = known, turn
        for n in numbers:
            one = found[n]
            if one.refused or not one.hypotheses:
                continue
            # The last landmark tells how odometry now lies on the map.
            swing = out[at].quarters * HALF_PI_RAD + found[at].best.pose[2] - found[at].odometry[2]
            way = one.landmark_position() - found[at].landmark_position()
            step = (
                np.array(
                    [
                        math.cos(swing) * way[1] + math.sin(swing) * way[0],
                        math.cos(swing) * way[0] - math.sin(swing) * way[1],
                    ]
                )
                / floor.pitch_m
            )
            whole = np.round(step)
            if np.abs(step - whole).max() > ASTRAY:
                continue
            there = (out[at].cell[0] + int(whole[0]), out[at].cell[1] + int(whole[1]))
            out[n] = CellEstimate(there, _quarters(one, swing), 0, 1.0, 1.0)
            at = n
    return out


def _quarters(seen: VisitHypotheses, swing: float) -> int:
    """Turn of its frame on the map, where odometry is turned by ``swing``."""
    return round((float(seen.odometry[2]) + swing - seen.best.pose[2]) / HALF_PI_RAD) % 4


def _driven(
    device: str,
    found: Sequence[VisitHypotheses],
    located: dict[int, CellEstimate],
    odometry: Trajectory,
    floor: FloorMap,
) -> Trajectory:
    """Poses at the times of odometry, each from the last landmark before it."""
    own = np.column_stack([odometry.position[:, :2], heading_from_quaternion(odometry.quaternion)])
    pose = np.empty_like(own)
    numbers = sorted(located)
    starts = np.searchsorted(odometry.time_ns, [found[n].time_ns for n in numbers])
    starts[0] = 0
    for k, n in enumerate(numbers):
        part = slice(starts[k], starts[k + 1] if k + 1 < len(numbers) else len(own))
        frame = np.array([*floor.place(located[n].cell), located[n].quarters * HALF_PI_RAD])
        here = compose(frame, found[n].best.pose)
        pose[part] = compose(here, relative(own[part], found[n].odometry))
    return Trajectory(
        device,
        "map",
        odometry.time_ns,
        np.column_stack([pose[:, :2], np.zeros(len(pose))]),
        quaternion_from_heading(pose[:, 2]),
        np.full((len(pose), 6, 6), np.nan),
    )
