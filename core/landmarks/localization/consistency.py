"""What a user must be told of a solution: where the map, the floor or the robot are not as said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locatk.core.landmarks.localization import cell_filter as globalize
from locatk.core.landmarks.localization import smoothing as smooth
from locatk.core.landmarks.localization.recording import Recording, Seen
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.results import describe_visit
from locatk.core.solution import SolverWarning

CERTAIN = 0.99999
"""Probability from which on a place on the map needs no remark."""

SURE = 0.999
"""Probability from which on the remark asks for nothing more."""

FEWEST_MARKS = 3
"""Landmarks from which on one of them can be known to be off its place."""

FAR_OFF = 2.5
"""Standard deviations that a landmark is found off its place to be called so."""

FEWEST_WRONG = 2

MOST_WRONG = 1 / 3
"""Share of misread and unexplained landmarks from which on a map is not believed."""

NO_MAP = SolverWarning("no_map", "no map, so that its landmarks have no cells")


def doubt(sure: float, first: int | None) -> SolverWarning | None:
    """Warn of a place that has the probability ``sure``; None if it is certain.

    ``first`` is the number of the landmark at which it was certain, None where at none.
    """
    if sure >= CERTAIN:
        return None
    if sure >= SURE:
        message = f"its place on the map is all but certain ({sure:.5f})"
    else:
        end = "; one more landmark would settle it" if first is None else " at one landmark"
        message = f"its place on the map has a probability of {sure:.5f}{end}"
    return SolverWarning("localization_uncertain", message)


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


def contradicted(found: Recording, usable: list[Seen], floor: FloorMap) -> bool:
    """Whether map and recording differ as often as those of one floor cannot."""
    misread = sum(
        describe_visit(one.sighting, one.located, floor).refused == "misread" for one in usable
    )
    unexplained = sum(one.sighting.refused == "not_explained" for one in found.seen)
    wrong = misread + unexplained
    return wrong >= FEWEST_WRONG and wrong > MOST_WRONG * (len(usable) + unexplained)


def why_not(found: Recording, sure: float) -> SolverWarning:
    """Explain why a robot is not localised."""
    device = found.run.samples.device
    explained = [one for one in found.seen if not one.sighting.refused]
    if explained:
        message = f"not localised; the likeliest place has a probability of {sure:.2g}"
        return SolverWarning("not_localised", message).about(device)
    if found.seen:
        message = (
            f"{len(found.seen)} visits, but no landmark explains one of them; check the "
            "landmarks' geometry, the sensors and the odometry"
        )
        return SolverWarning("visits_unexplained", message).about(device)
    largest = 1e3 * float(np.nanmax(np.abs(found.run.samples.field_t)))
    message = f"no landmark was met; the strongest field is {largest:.2g} mT"
    return SolverWarning("no_landmark", message).about(device)


def exchanged(found: Recording, floor: FloorMap, misread: float) -> list[SolverWarning]:
    """Warn if the map would fit what was seen with all fields of the other sign."""
    turned = [
        replace(
            one.sighting,
            hypotheses=tuple(replace(h, code=15 - h.code) for h in one.sighting.hypotheses),
        )
        for one in found.seen
        if not one.sighting.refused
    ]
    if not turned:
        return []
    told = globalize.locate(turned, floor, misread=misread, drift=found.priors.drift)
    if max(one.probability for one in told) < CERTAIN:
        return []
    message = (
        "with N and S exchanged it would be localised; are the sensors or all bars the other way "
        "up?"
    )
    return [SolverWarning("polarity_exchanged", message).about(found.run.samples.device)]
