"""From hall sensors and odometry to landmarks that were seen and poses on the map."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection import neighbours
from locatk.core.landmarks.detection.explanations import FAULTY, GONE
from locatk.core.landmarks.detection.fit import Priors
from locatk.core.landmarks.detection.trace import compose
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import rotated, signs
from locatk.core.landmarks.localization import smoothing as smooth
from locatk.core.landmarks.localization import trajectory as route
from locatk.core.landmarks.localization.cell_filter import HALF_PI
from locatk.core.landmarks.localization.consistency import (
    CERTAIN,
    NO_MAP,
    contradicted,
    displaced,
    doubt,
    exchanged,
    why_not,
)
from locatk.core.landmarks.localization.recording import METHODS as METHODS
from locatk.core.landmarks.localization.recording import Recording, Seen, on_map, read
from locatk.core.landmarks.localization.recording import SolveOptions as SolveOptions
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.results import (
    LandmarkDetection,
    LandmarkFacts,
    RobotFacts,
    describe_visit,
)
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

ALONE_T = 3e-5
"""What the model leaves where the neighbours' fields are taken off."""

MISFIT = 2.0
"""Rms of what is left of all fields, in standard deviations, from which on it is told..."""

IMPOSSIBLE = 12.0
"""... and from which on the poses are not."""

LAID_M, LAID_RAD = 1.5e-3, 0.012
"""Standard deviations with which landmarks are taken to be laid."""

ASTRAY_M, ASTRAY_RAD = 0.02, 0.1
"""The same of one that was found far off its place."""


def solve(
    samples: Sequence[HallSamples],
    floor: FloorMap | None = None,
    options: SolveOptions | None = None,
    *,
    odometry: Sequence[Trajectory] = (),
) -> Solution:
    """Find the landmarks that robots have met, and by them their places on the map.

    Parameters
    ----------
    samples : sequence of HallSamples
        One a robot.
    floor : FloorMap or None
        Without it landmarks are found, but no places on a map.
    options : SolveOptions, optional
    odometry : sequence of Trajectory
        By device.

    Returns
    -------
    Solution
        Its detections are what was seen at each landmark (docs/formats.md).

    Raises
    ------
    InputError
        A recording has no odometry, no sensor of it can be used, or its sensors are in the
        wrong order.
    """
    options = options or SolveOptions()
    if options.method == "paper":
        from locatk.core.landmarks.published import solver as paper_solver

        return paper_solver.solve(samples, floor, odometry=odometry)
    trajectories: list[Trajectory] = []
    detections: list[LandmarkDetection] = []
    warnings: list[SolverWarning] = []
    rejected: Counter[str] = Counter()
    robots: dict[str, RobotFacts] = {}
    for recording in samples:
        driven_by = next((t for t in odometry if t.device == recording.device), None)
        found = read(recording, driven_by, floor, options)
        warnings += found.run.warnings
        if floor is None:
            warnings.append(NO_MAP.about(recording.device))
        solved, remarks, robots[recording.device] = placed(found, floor, options.misread)
        trajectories += solved
        warnings += remarks
        for item in found.seen:
            detections.append(describe_visit(item.sighting, item.located, floor))
            why = detections[-1].refused
            if why and why != "misread":  # that one is used, as it was read
                rejected[why] += 1
    return Solution(
        system="landmarks",
        method=options.method,
        trajectories=tuple(trajectories),
        rejected=dict(rejected),
        detections=tuple(detections),
        artifact=floor,
        warnings=tuple(warnings),
        facts=LandmarkFacts(robots),
    )


def placed(
    found: Recording, floor: FloorMap | None, misread: float
) -> tuple[list[Trajectory], list[SolverWarning], RobotFacts]:
    """Return the poses of one robot on the map, warnings, and facts of its localization."""
    device = found.run.samples.device
    usable = on_map(found, floor) if floor is not None else []
    located = [one.located for one in found.seen if one.located is not None]
    # The least sure of the places that are told; where none is, the surest of all.
    sure = min((one.located.probability for one in usable if one.located), default=math.nan)
    if not usable:
        sure = max((one.probability for one in located), default=0.0)
    first = next((n for n, one in enumerate(located, 1) if one.so_far >= CERTAIN), None)
    facts = RobotFacts(
        localised=bool(usable),
        probability=sure,
        landmarks_seen=len(located),
        landmarks_to_localise=first,
    )
    if floor is not None and contradicted(found, usable, floor):
        message = (
            "not localised; too many of its landmarks are not those of the map: is it the map of "
            "this floor, and the odometry the right way round?"
        )
        warnings = [SolverWarning("map_contradicted", message).about(device)]
        return [], warnings, replace(facts, localised=False)
    if floor is None:
        return [], [], facts
    if not usable:
        return [], [why_not(found, sure), *exchanged(found, floor, misread)], facts
    uncertain = doubt(sure, first)
    warnings = [] if uncertain is None else [uncertain.about(device)]
    marks = expected(usable, floor, found.priors)
    alone = replace(found.priors, floor_t=ALONE_T)
    run = as_run(usable, found, floor)
    smoothed = smooth.smooth([run], marks, floor.geometry, alone)
    if off := displaced(marks, smoothed):
        for cell, shift in off.items():
            marks[cell] = replace(marks[cell], sigma=np.array([ASTRAY_M, ASTRAY_M, ASTRAY_RAD]))
            message = (
                f"the landmark at {cell[0]},{cell[1]} lies {1e3 * shift:.2g} mm or more off its "
                "place; `locatk calibrate map` would tell how far"
            )
            warnings.append(SolverWarning("landmark_displaced", message).about(device))
        smoothed = smooth.smooth([run], marks, floor.geometry, alone)
    facts = replace(facts, misfit_sigma=smoothed.misfit)
    if smoothed.misfit > MISFIT:
        message = (
            f"fields miss the model by {smoothed.misfit:.2g} standard deviations; check clocks and "
            "scale of the odometry, the sensors and the landmarks' geometry"
        )
        warnings.append(SolverWarning("field_misfit", message).about(device))
    if smoothed.misfit > IMPOSSIBLE:
        return [], warnings, replace(facts, localised=False)
    path = route.poses(
        device, [one.visit for one in usable], smoothed.stays[0], found.odometry, found.priors
    )
    return [path], warnings, facts


def expected(usable: Sequence[Seen], floor: FloorMap, priors: Priors) -> dict[Cell, smooth.Mark]:
    """The landmarks of visits, as the map has them and as they were read."""
    marks: dict[Cell, smooth.Mark] = {}
    for one in usable:
        assert one.located is not None
        cell, quarters = one.located.cell, one.located.quarters
        best = one.explanations[one.located.hypothesis]
        strength = signs(rotated(best.code, quarters))
        sigma = np.full(4, priors.strength)
        pose = np.array([*floor.place(cell), 0.0])
        spread = np.array([LAID_M, LAID_M, LAID_RAD])
        built = floor.built.get(cell)
        if built is not None:
            pose = pose + [built.x_m, built.y_m, built.heading_rad]
            spread = np.fmax(np.where(np.isnan(built.sigma[:3]), spread, built.sigma[:3]), 1e-5)
            gone = np.abs(built.strength) < GONE
            same = (np.sign(built.strength) == strength) | gone
            known = np.where(np.isnan(built.sigma[3:]), sigma, np.fmax(built.sigma[3:], 1e-3))
            strength = np.where(same, built.strength, strength)
            sigma = np.where(same, known, sigma)
        bar = (best.free + quarters) % 4
        if best.free >= 0 and not (built is not None and gone[bar]):
            strength[bar], sigma[bar] = 0.0, FAULTY
        if cell not in marks or best.free < 0:
            marks[cell] = smooth.Mark(pose, spread, strength, sigma)
    return marks


def as_run(usable: Sequence[Seen], found: Recording, floor: FloorMap) -> smooth.Run:
    """One robot's visits as a run for :func:`.smooth.smooth`."""
    stays = []
    for one in usable:
        assert one.located is not None
        best = one.sighting.hypotheses[one.located.hypothesis]
        turn = one.located.quarters * HALF_PI
        mark = np.array([*floor.place(one.located.cell), turn])
        pose, trace = compose(mark, best.pose), one.visit.trace
        wrong = one.explanations[one.located.hypothesis].parameters[-trace.correction.shape[2] :]
        trace = neighbours.without(trace, pose, wrong, one.located.cell, floor)
        stays.append(smooth.Stay(trace, one.located.cell, pose))
    visits = [one.visit for one in usable]
    return smooth.Run(stays, route.links(visits, found.odometry, found.priors))
