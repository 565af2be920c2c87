"""From visits to sightings: what each has shown, and whether its sensors are what they seem."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.estimate import Explanation, explain, robot
from locatk.core.landmarks.fit import Priors
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.sighting import Hypothesis, Sighting
from locatk.core.landmarks.visits import Driven, Visit

Array = NDArray[np.float64]

FEWEST_BINS = 4

UNEXPLAINED = 6.0
"""Residual, in standard deviations, from which on no landmark explains a visit."""

ORDERS_TRIED = 3
"""Unexplained visits for which the sensors' order is questioned."""

CLEARLY = 3.0
"""By how much another order must leave less."""


def sighting(
    visit: Visit, run: Driven, geometry: Geometry, priors: Priors
) -> tuple[Sighting, list[Explanation]]:
    """What one visit has shown, and the explanations behind the hypotheses, in their order."""
    device = run.samples.device
    found = [] if len(visit.trace) < FEWEST_BINS else explain(visit.trace, geometry, priors)
    base = Sighting(
        device,
        int(visit.time_ns[visit.trace.reference]),
        visit.first,
        visit.stop,
        visit.origin,
        (),
    )
    if not found:
        why = "too_short" if len(visit.trace) < FEWEST_BINS else "too_weak"
        return replace(base, refused=why), []
    hypotheses = []
    for one in found:
        pose, covariance = robot(visit.trace, one, visit.trace.reference)
        pose[2] = math.remainder(pose[2], math.tau)
        hypotheses.append(
            Hypothesis(
                one.code, one.probability, pose, covariance, one.strength, one.strength_sigma
            )
        )
    refused = "not_explained" if found[0].residual_sigma > UNEXPLAINED else ""
    done = replace(
        base,
        hypotheses=tuple(hypotheses),
        residual_sigma=found[0].residual_sigma,
        refused=refused,
    )
    return done, found


def check_order(
    visits: list[Visit], residual: list[float], run: Driven, geometry: Geometry, priors: Priors
) -> None:
    """Raise if another order of the sensors explains what the order given does not.

    Parameters
    ----------
    visits : list of Visit
    residual : list of float
        What the best explanation of each leaves, in standard deviations.
    run : Driven
    geometry : Geometry
    priors : Priors

    Raises
    ------
    InputError
        The sensors are in the wrong order; the error names the right one.
    """
    bad = [n for n, value in enumerate(residual) if value > UNEXPLAINED]
    names = run.samples.sensors.names
    if 2 * len(bad) <= len(visits) or len(names) > 4:
        return
    bad = sorted(bad, key=lambda n: -len(visits[n].trace))[:ORDERS_TRIED]
    same = tuple(range(len(names)))

    def left(order: tuple[int, ...], which: list[int]) -> float:
        """What the best explanations leave if the sensors are in another order."""
        residuals = []
        for n in which:
            trace = replace(visits[n].trace, value_t=visits[n].trace.value_t[:, list(order)])
            found = explain(trace, geometry, priors, thorough=False)
            residuals.append(found[0].residual_sigma if found else math.inf)
        return float(np.median(residuals))

    tried = {order: left(order, bad[:1]) for order in itertools.permutations(same)}
    likely = sorted(tried, key=lambda order: tried[order])[:3]
    best = min(likely, key=lambda order: left(order, bad))
    if best != same and left(best, bad) < min(UNEXPLAINED, left(same, bad) / CLEARLY):
        given = ", ".join(names)
        right = ", ".join(names[best.index(k)] for k in same)
        raise InputError(
            f"the hall sensors of {run.samples.device} are in the wrong order: what is called "
            f"{given} are {right}",
            hint="Name the columns in that order, or mend halls.toml",
        )
