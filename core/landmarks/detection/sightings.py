"""From visits to sightings: what each has shown, and whether its sensors are what they seem."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.detection.explanations import Explanation, explain, robot
from locatk.core.landmarks.detection.fit import POSE, Priors
from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.visits import Driven, Visit
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

FEWEST_BINS = 4

UNEXPLAINED = 6.0
"""Residual, in standard deviations, from which on no landmark explains a visit."""

VISITS_TRIED = 3
"""Unexplained visits by which the sensors are questioned."""

MOST_BAD = 0.25
"""Share of unexplained visits at which the sensors are not yet questioned."""

MOST_SENSORS = 4
"""Sensors up to which every order is tried."""

GAIN_SIGMAS = 4.0
"""Standard deviations that a sensor's gain is off to be told."""

CLEARLY = 3.0
"""By how much less must be left if the sensors are otherwise."""


def sighting(
    visit: Visit, run: Driven, geometry: Geometry, priors: Priors
) -> tuple[VisitHypotheses, list[Explanation]]:
    """What one visit has shown, and the explanations behind the hypotheses, in their order."""
    device = run.samples.device
    found = [] if len(visit.trace) < FEWEST_BINS else explain(visit.trace, geometry, priors)
    base = VisitHypotheses(
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


def check_gains(found: list[Explanation], run: Driven, priors: Priors) -> list[SolverWarning]:
    """Warn of sensors whose gain differs from the one that was given.

    Parameters
    ----------
    found : list of Explanation
        The best of each visit.
    run : Driven
    priors : Priors

    Raises
    ------
    InputError
        A sensor has the other sign than the rest.
    """
    if not found:
        return []
    names, device = run.samples.sensors.names, run.samples.device
    span = slice(POSE, POSE + len(names))
    gain = 1 + priors.gain * np.median([one.parameters[span] for one in found], axis=0)
    warnings = []
    for name, value in zip(names, gain.tolist(), strict=True):
        if value < 0:
            raise InputError(
                f"the {name} sensor of {device} has the other sign than the rest",
                hint="Turn it round, or its column's sign",
            )
        if abs(value - 1) > GAIN_SIGMAS * priors.gain:
            message = f"the {name} sensor reads {value:.2f} of what the others do"
            warnings.append(SolverWarning("sensor_gain", message).about(device))
    return warnings


def check_sensors(
    visits: list[Visit], residual: list[float], run: Driven, geometry: Geometry, priors: Priors
) -> int | None:
    """What is wrong with the sensors, where visits are explained without one of them only.

    Parameters
    ----------
    visits : list of Visit
    residual : list of float
        What the best explanation of each leaves, in standard deviations.
    run : Driven
    geometry : Geometry
    priors : Priors

    Returns
    -------
    int or None
        The sensor that is better left out.

    Raises
    ------
    InputError
        The sensors are in the wrong order, or one has the other sign; the error names them.
    """
    bad = [n for n, value in enumerate(residual) if value > UNEXPLAINED]
    names = run.samples.sensors.names
    if len(bad) <= MOST_BAD * len(visits) or len(names) > MOST_SENSORS:
        return None
    bad = sorted(bad, key=lambda n: -len(visits[n].trace))[:VISITS_TRIED]

    def left(change: Change, which: list[int]) -> float:
        """What the best explanations leave if the sensors are otherwise."""
        residuals = []
        for n in which:
            value = visits[n].trace.value_t[:, list(change.order)] * change.factor
            found = explain(
                replace(visits[n].trace, value_t=value), geometry, priors, thorough=False
            )
            residuals.append(found[0].residual_sigma if found else math.inf)
        return float(np.median(residuals))

    as_given, *others = _changes(len(names))
    likely = sorted(others, key=lambda change: left(change, bad[:1]))[:3]
    best = min(likely, key=lambda change: left(change, bad))
    if left(best, bad) > min(UNEXPLAINED, left(as_given, bad) / CLEARLY):
        return None
    device = run.samples.device
    if best.order != as_given.order:
        right = ", ".join(names[best.order.index(k)] for k in as_given.order)
        raise InputError(
            f"the hall sensors of {device} are in the wrong order: what is called "
            f"{', '.join(names)} are {right}",
            hint="Name the columns in that order, or mend halls.toml",
        )
    changed = int(np.flatnonzero(np.asarray(best.factor) != 1)[0])
    if best.factor[changed] == -1:
        raise InputError(
            f"the {names[changed]} sensor of {device} has the other sign than the rest",
            hint="Turn it round, or its column's sign",
        )
    return changed


@dataclass(frozen=True)
class Change:
    """Another order of the sensors' columns, and a factor for each: -1 for the other sign,
    ``nan`` for one that is left out."""

    order: tuple[int, ...]
    factor: tuple[float, ...]


def _changes(count: int) -> list[Change]:
    """As given; then every other order, every one sign, every one left out."""
    same, ones = tuple(range(count)), (1.0,) * count
    found = [Change(order, ones) for order in itertools.permutations(same)]
    for value in (-1.0, math.nan):
        for k in same:
            found.append(Change(same, (*ones[:k], value, *ones[k + 1 :])))
    return found
