"""From hall sensors and odometry to landmarks that were seen and poses on the map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks import globalize, neighbours, route, smooth
from locatk.core.landmarks.built import laid_code
from locatk.core.landmarks.detections import LIKELY, detection
from locatk.core.landmarks.estimate import FAULTY, GONE, Explanation
from locatk.core.landmarks.fit import Priors
from locatk.core.landmarks.floor import HOLE, Cell, FloorMap
from locatk.core.landmarks.globalize import HALF_PI, Located
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import Geometry, rotated, signs
from locatk.core.landmarks.sighting import Sighting
from locatk.core.landmarks.sightings import check_sensors, sighting
from locatk.core.landmarks.trace import compose
from locatk.core.landmarks.visits import Driven, Visit, check_way, driven, find
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

METHODS = ("field", "paper")

CERTAIN = 0.9999
"""Probability from which on a place on the map needs no remark."""

ALONE_T = 3e-5
"""What the model leaves where the neighbours' fields are taken off."""

FEWEST_WRONG = 2

MOST_WRONG = 1 / 3
"""Share of misread landmarks from which on a map is not believed."""

FEWEST_MARKS = 3
"""Landmarks from which on one of them can be known to be off its place."""

FAR_OFF = 2.5
"""Standard deviations that a landmark is found off its place to be called so."""

ASTRAY_M, ASTRAY_RAD = 0.02, 0.1
"""Standard deviations with which such a one is laid."""

MISFIT = 2.0
"""Rms of what is left of all fields, in standard deviations, from which on it is told."""

FEWEST_EXCHANGED = 3
"""Landmarks from which on a fit of exchanged poles says something."""

LAID_M, LAID_RAD = 1.5e-3, 0.012
"""Standard deviations with which landmarks are taken to be laid."""


@dataclass(frozen=True)
class SolveOptions:
    """How to solve.

    Attributes
    ----------
    method : str
        ``"field"``, the default, or ``"paper"``: the published algorithm.
    misread : float
        Probability that a landmark is laid otherwise than the map says, or is misread.
    priors : Priors
        What is not known of sensors, bars and odometry, and how large that may be; the
        noise is taken from the recording.
    """

    method: str = "field"
    misread: float = 0.01
    priors: Priors = field(default_factory=Priors)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"no method {self.method!r} for landmarks", hint="Use field or paper")
        if not 0 < self.misread < 0.5:
            raise InputError(
                f"a rate of misread landmarks of {self.misread!r}", hint="Give 0.001 to 0.2"
            )


@dataclass(frozen=True)
class Seen:
    """One visit, with what it has shown.

    Attributes
    ----------
    visit : Visit
    sighting : Sighting
    explanations : list of Explanation
        Behind the hypotheses of the sighting.
    located : Located or None
        Where that was on the map.
    """

    visit: Visit
    sighting: Sighting
    explanations: list[Explanation]
    located: Located | None = None


@dataclass(frozen=True)
class Recording:
    """One robot's recording on its way through the solver."""

    run: Driven
    odometry: Trajectory
    priors: Priors
    seen: list[Seen]


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
        from locatk.core.landmarks import paper_solver

        return paper_solver.solve(samples, floor, odometry=odometry)
    trajectories: list[Trajectory] = []
    detections: list[dict[str, Any]] = []
    notes: list[str] = []
    rejected: Counter[str] = Counter()
    facts: dict[str, Any] = {"robots": {}}
    for recording in samples:
        driven_by = next((t for t in odometry if t.device == recording.device), None)
        found = read(recording, driven_by, floor, options)
        notes += found.run.notes
        if floor is None:
            notes.append(f"{recording.device}: no map, so that its landmarks have no cells")
        solved, remarks, told = placed(found, floor, options.misread)
        trajectories += solved
        notes += remarks
        facts["robots"][recording.device] = told
        for item in found.seen:
            detections.append(detection(item.sighting, item.located, floor))
            if why := detections[-1]["refused"]:
                rejected[why] += 1
    return Solution(
        system="landmarks",
        method=options.method,
        trajectories=tuple(trajectories),
        rejected=dict(rejected),
        detections=detections,
        artifact=floor,
        notes=tuple(notes),
        facts=facts,
    )


def read(
    recording: HallSamples,
    odometry: Trajectory | None,
    floor: FloorMap | None,
    options: SolveOptions,
) -> Recording:
    """What one robot has seen, and where on the map that was."""
    geometry = floor.geometry if floor is not None else Geometry()
    run = driven(recording, odometry)
    assert odometry is not None  # `driven` refuses none
    priors = replace(options.priors, noise_t=run.noise_t)
    pitch = floor.pitch_m if floor is not None else 0.2
    check_way(run, geometry)
    seen = sightings_of(run, geometry, priors, pitch)
    faulty = check_sensors(
        [one.visit for one in seen],
        [one.sighting.residual_sigma for one in seen],
        run,
        geometry,
        priors,
    )
    if faulty is not None:
        run = run.lacking(faulty)
        seen = sightings_of(run, geometry, priors, pitch)
    if floor is not None:
        used = [n for n, one in enumerate(seen) if not one.sighting.refused]
        told = globalize.locate(
            [seen[n].sighting for n in used], floor, misread=options.misread, drift=priors.drift
        )
        for n, located in zip(used, told, strict=True):
            seen[n] = replace(seen[n], located=located)
    return Recording(run, odometry, priors, seen)


def sightings_of(run: Driven, geometry: Geometry, priors: Priors, pitch_m: float) -> list[Seen]:
    """What each visit of a recording has shown."""
    return [
        Seen(visit, *sighting(visit, run, geometry, priors))
        for visit in find(run, geometry, priors.drift, pitch_m)
    ]


def placed(
    found: Recording, floor: FloorMap | None, misread: float
) -> tuple[list[Trajectory], list[str], dict[str, Any]]:
    """Poses on the map, remarks, and what is told of one robot's localization."""
    device = found.run.samples.device
    usable = on_map(found, floor) if floor is not None else []
    located = [one.located for one in found.seen if one.located is not None]
    sure = max((one.probability for one in located), default=0.0)
    first = next((n for n, one in enumerate(located, 1) if one.so_far >= CERTAIN), None)
    told = {
        "localised": bool(usable),
        "probability": sure,
        "landmarks_seen": len(located),
        "landmarks_to_localise": first,
    }
    if floor is not None and contradicted(usable, floor):
        remarks = [
            f"{device}: not localised; too many of its landmarks are not those of the map: is "
            "it the map of this floor?"
        ]
        return [], remarks, told | {"localised": False}
    if floor is None:
        return [], [], told
    if not usable:
        return [], [*why_not(found, sure), *exchanged(found, floor, misread)], told
    remarks = []
    if sure < CERTAIN:
        remarks.append(
            f"{device}: its place on the map has a probability of {sure:.4f}; one more landmark "
            "would settle it"
        )
    marks = expected(usable, floor)
    alone = replace(found.priors, floor_t=ALONE_T)
    run = as_run(usable, found, floor)
    smoothed = smooth.smooth([run], marks, floor.geometry, alone)
    if off := displaced(marks, smoothed):
        for cell, shift in off.items():
            marks[cell] = replace(marks[cell], sigma=np.array([ASTRAY_M, ASTRAY_M, ASTRAY_RAD]))
            remarks.append(
                f"{device}: the landmark at {cell[0]},{cell[1]} lies {1e3 * shift:.2g} mm or more "
                "off its place; `locatk calibrate map` would tell how far"
            )
        smoothed = smooth.smooth([run], marks, floor.geometry, alone)
    told["misfit_sigma"] = smoothed.misfit
    if smoothed.misfit > MISFIT:
        remarks.append(
            f"{device}: fields miss the model by {smoothed.misfit:.2g} standard deviations; check "
            "clocks and scale of the odometry, the sensors and the landmarks' geometry"
        )
    path = route.poses(
        device, [one.visit for one in usable], smoothed.stays[0], found.odometry, found.priors
    )
    return [path], remarks, told


def displaced(marks: dict[Cell, smooth.Mark], smoothed: smooth.Smoothed) -> dict[Cell, float]:
    """Landmarks that were found far off where the map has them, and how far (m)."""
    if len(marks) < FEWEST_MARKS:
        return {}
    found = {}
    for cell, mark in marks.items():
        shift = smoothed.marks[cell].pose - mark.pose
        if np.abs(shift / mark.sigma).max() > FAR_OFF:
            found[cell] = float(np.hypot(*shift[:2]))
    return found


def contradicted(usable: list[Seen], floor: FloorMap) -> bool:
    """Whether the map is as often wrong about what was seen as no map of the floor can be."""
    wrong = sum(
        detection(one.sighting, one.located, floor)["refused"] == "misread" for one in usable
    )
    return wrong >= FEWEST_WRONG and wrong > MOST_WRONG * len(usable)


def why_not(found: Recording, sure: float) -> list[str]:
    """Why a robot is not localised."""
    device = found.run.samples.device
    explained = [one for one in found.seen if not one.sighting.refused]
    if explained:
        return [f"{device}: not localised; the likeliest place has a probability of {sure:.2g}"]
    if found.seen:
        return [
            f"{device}: {len(found.seen)} visits, but no landmark explains one of them; check "
            "the landmarks' geometry, the sensors and the odometry"
        ]
    largest = 1e3 * float(np.nanmax(np.abs(found.run.samples.field_t)))
    return [f"{device}: no landmark was met; the strongest field is {largest:.2g} mT"]


def exchanged(found: Recording, floor: FloorMap, misread: float) -> list[str]:
    """A remark where the map fits what was seen if all fields had the other sign."""
    turned = [
        replace(
            one.sighting,
            hypotheses=tuple(replace(h, code=15 - h.code) for h in one.sighting.hypotheses),
        )
        for one in found.seen
        if not one.sighting.refused
    ]
    if len(turned) < FEWEST_EXCHANGED:
        return []
    told = globalize.locate(turned, floor, misread=misread, drift=found.priors.drift)
    if max(one.probability for one in told) < LIKELY:
        return []
    return [
        f"{found.run.samples.device}: with N and S exchanged it would be localised; are the "
        "sensors or all bars the other way up?"
    ]


def on_map(found: Recording, floor: FloorMap) -> list[Seen]:
    """Visits whose landmark on the map is known."""
    return [
        one
        for one in found.seen
        if one.located is not None
        and one.located.probability >= LIKELY
        and laid_code(floor, one.located.cell) != HOLE
    ]


def expected(usable: Sequence[Seen], floor: FloorMap) -> dict[Cell, smooth.Mark]:
    """The landmarks of visits, as the map has them and as they were read."""
    marks: dict[Cell, smooth.Mark] = {}
    for one in usable:
        assert one.located is not None
        cell, quarters = one.located.cell, one.located.quarters
        best = one.explanations[one.located.hypothesis]
        strength = signs(rotated(best.code, quarters))
        sigma = np.full(4, Priors().strength)
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
