"""One robot's recording on its way through the solver: visits, sightings, cells."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from locatk.core.errors import InputError
from locatk.core.landmarks.detection.explanations import Explanation
from locatk.core.landmarks.detection.fit import Priors
from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.detection.sightings import check_gains, check_sensors, sighting
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.localization import cell_filter as globalize
from locatk.core.landmarks.localization.cell_filter import Located
from locatk.core.landmarks.map.floor import HOLE, FloorMap, as_built_code
from locatk.core.landmarks.results import MIN_CELL_PROBABILITY
from locatk.core.landmarks.visits import Driven, Visit, check_way, driven, find, joined
from locatk.core.trajectory import Trajectory

METHODS = ("field", "paper")

SAME = 0.2
"""Of the pitch: two visits' landmarks that are nearer to each other are one."""


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
    misread: float = 0.02
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
    sighting: VisitHypotheses
    explanations: list[Explanation]
    located: Located | None = None


@dataclass(frozen=True)
class Recording:
    """One robot's recording on its way through the solver."""

    run: Driven
    odometry: Trajectory
    priors: Priors
    seen: list[Seen]


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
    gains = check_gains([one.explanations[0] for one in seen if one.explanations], run, priors)
    run = replace(run, warnings=(*run.warnings, *gains))
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
    """What each visit of a recording has shown.

    Visits in a row that turn out to be to one landmark, from its two sides, are one.
    """
    seen: list[Seen] = []
    for visit in find(run, geometry, priors.drift, pitch_m):
        one = Seen(visit, *sighting(visit, run, geometry, priors))
        if seen and not (seen[-1].sighting.refused or one.sighting.refused):
            place = one.sighting.landmark_place()
            if np.hypot(*(place - seen[-1].sighting.landmark_place())) < SAME * pitch_m:
                both = joined(run, seen[-1].visit, visit, place, priors.drift)
                whole = Seen(both, *sighting(both, run, geometry, priors))
                if not whole.sighting.refused:
                    seen[-1] = whole
                    continue
        seen.append(one)
    return seen


def on_map(found: Recording, floor: FloorMap) -> list[Seen]:
    """Visits whose landmark on the map is known."""
    return [
        one
        for one in found.seen
        if one.located is not None
        and one.located.probability >= MIN_CELL_PROBABILITY
        and as_built_code(floor, one.located.cell) != HOLE
    ]
