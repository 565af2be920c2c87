"""From one trace to the landmarks that may explain it, each with its probability."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection import fit, scan
from locatk.core.landmarks.detection.trace import Trace
from locatk.core.landmarks.landmark import Geometry, signs

Array = NDArray[np.float64]

COARSE = 36
"""Samples for the scan and the first descents."""

FINE = 150
"""Samples for the last descents."""

STARTS = 10

RACE = (3, 4)
"""Steps of the first descents, after which those far behind drop out."""

HOPELESS = 60.0
"""Logarithm of odds behind the best at which they do."""

MARGIN = 12.0
"""Logarithm of odds at which a hypothesis is dropped before the last descents."""

MOST = 8
"""Hypotheses that are kept."""

SAME = 3e-3
"""Difference of place (m) and heading (rad) up to which two ends are one."""

HALF_PI = math.pi / 2

FAULTY = 0.5
"""Standard deviation of a bar's strength that may be weak or missing."""

SUSPICIOUS = 2.5
"""Strength of a bar, in standard deviations off, at which it may be faulty."""

WHITE = 1.6
"""Residual, in standard deviations, up to which nothing need be faulty."""

GONE = 0.25
"""Strength under which nobody can tell how a bar lay."""

LEAST = 1e-9
"""Probability under which a hypothesis is not told."""


@dataclass(frozen=True)
class Explanation:
    """One landmark that may explain a trace.

    Attributes
    ----------
    code : int
    log_odds : float
        Logarithm of the evidence, but for a constant that is common to the trace.
    parameters : (size,) ndarray
        See :class:`.fit.Problem`.
    covariance : (size, size) ndarray
    strength : (4,) ndarray
        Signed, in units of the nominal one.
    strength_sigma : (4,) ndarray
    residual_sigma : float
        Rms of what is left over, in standard deviations of a sample.
    free : int
        The bar that was taken to be of any strength; -1 for none.
    probability : float
    """

    code: int
    log_odds: float
    parameters: Array
    covariance: Array
    strength: Array
    strength_sigma: Array
    residual_sigma: float
    free: int = -1
    probability: float = math.nan


def explain(
    trace: Trace, geometry: Geometry, priors: fit.Priors, *, thorough: bool = True
) -> list[Explanation]:
    """All landmarks that may explain a trace, the most probable first.

    Parameters
    ----------
    trace : Trace
    geometry : Geometry
    priors : Priors
    thorough : bool
        Search more finely, and for faulty bars, where nothing explains the trace.

    Returns
    -------
    list of Explanation
        Their probabilities sum to 1; empty where no field is strong.
    """
    found = _explained(trace, geometry, priors, scan.WHOLE)
    if not found:
        return []
    if not thorough:
        return _shares(found)
    if _best(found).residual_sigma > WHITE:
        found = _explained(trace, geometry, priors, scan.WHOLE, scan.FINE)
    best = _best(found)
    off = np.abs(best.strength - signs(best.code)) / priors.strength
    if off.max() > SUSPICIOUS or best.residual_sigma > WHITE:
        found += _faulty(trace, geometry, priors, float(best.parameters[2]))
    return _shares(found)


def _best(found: list[Explanation]) -> Explanation:
    return max(found, key=lambda one: one.log_odds)


def _explained(
    trace: Trace,
    geometry: Geometry,
    priors: fit.Priors,
    laid: Array,
    grid: scan.Grid = scan.COARSE,
    toward: float | None = None,
) -> list[Explanation]:
    """Explanations by ``laid`` (L, 4), the bars that may be there.

    Their frames are those nearest to the heading ``toward``; of None, to that of the best.
    """
    coarse = trace.thinned(COARSE)
    starts = STARTS if grid == scan.COARSE else 3 * STARTS
    pose, which = scan.candidates(coarse, geometry, laid, starts, grid)
    if not len(pose):
        return []
    problem = _problem(coarse, geometry, priors, laid[which])
    problem, first = _race(problem, problem.start(pose))
    # Bars at the far side are weakly seen: the other ways to lay them, at the best place.
    best = int(np.argmax(first.evidence()))
    others = laid[(laid != problem.strength[best]).any(axis=1)]
    again = _problem(coarse, geometry, priors, others)
    start = problem.start(np.repeat(first.parameters[[best], : fit.POSE], len(others), axis=0))
    again, second = _race(again, start, first.evidence().max())
    odds = np.concatenate([first.evidence(), second.evidence()])
    strength = np.concatenate([problem.strength, again.strength])
    parameters = np.concatenate([first.parameters, second.parameters])
    keep = np.flatnonzero(odds > odds.max() - MARGIN)
    if toward is None:
        toward = math.remainder(float(parameters[np.argmax(odds), 2]), HALF_PI)
    strength, start = _in_one_frame(strength[keep], parameters[keep], toward)
    strength, start = _unlike(strength, start, odds[keep])
    problem = _problem(trace.thinned(FINE), geometry, priors, strength)
    return _explanations(problem, fit.descend(problem, start))


def _race(
    problem: fit.Problem, start: Array, ahead: float = -math.inf
) -> tuple[fit.Problem, fit.Fitted]:
    """Descents from all starts, of which the hopeless drop out on the way.

    ``ahead`` is the evidence that others have reached already.
    """
    for steps in RACE:
        fitted = fit.descend(problem, start, steps)
        odds = fitted.evidence()
        keep = np.flatnonzero(odds > max(odds.max(), ahead) - HOPELESS)
        problem, fitted = problem.chosen(keep), fitted.chosen(keep)
        start = fitted.parameters
        if not len(keep):
            break
    return problem, fitted


def _problem(trace: Trace, geometry: Geometry, priors: fit.Priors, strength: Array) -> fit.Problem:
    sigma = np.where(strength == 0, FAULTY, priors.strength)
    return fit.Problem(trace, geometry, priors, strength, sigma)


def _faulty(
    trace: Trace, geometry: Geometry, priors: fit.Priors, toward: float
) -> list[Explanation]:
    """Explanations by landmarks of which one bar is of any strength."""
    found = []
    for one in _explained(trace, geometry, priors, scan.ONE_MISSING, toward=toward):
        bar = one.free
        odds = one.log_odds + math.log(priors.faulty)
        if abs(one.strength[bar]) > GONE:
            found.append(replace(one, log_odds=odds))
        else:  # of a bar that is gone nobody can tell how it lay
            odds -= math.log(2)
            found += [replace(one, code=c, log_odds=odds) for c in (one.code, one.code ^ 1 << bar)]
    return found


def _in_one_frame(strength: Array, parameters: Array, toward: float) -> tuple[Array, Array]:
    """The same landmarks in frames that are no quarter turn off the heading ``toward``."""
    turns = np.round((toward - parameters[:, 2]) / HALF_PI).astype(np.int64)
    turned = parameters.copy()
    turned[:, 2] += HALF_PI * turns
    bars = (np.arange(4) + turns[:, None]) % 4
    return np.take_along_axis(strength, bars, axis=1), turned


def _unlike(strength: Array, parameters: Array, odds: Array) -> tuple[Array, Array]:
    """The best of each group that is the same, and of no more than :data:`MOST` groups."""
    kept: list[int] = []
    for i in np.argsort(-odds):
        gap = np.abs(parameters[kept, :3] - parameters[i, :3]).max(axis=1)
        alike = (strength[kept] == strength[i]).all(axis=1)
        if not np.any(alike & (gap < SAME)) and len(kept) < MOST:
            kept.append(int(i))
    return strength[kept], parameters[kept]


def _shares(found: list[Explanation]) -> list[Explanation]:
    """Probabilities from the odds; the most probable first."""
    odds = np.array([one.log_odds for one in found])
    weight = np.exp(odds - odds.max())
    weight /= weight.sum()
    return [
        replace(found[i], probability=float(weight[i]))
        for i in np.argsort(-weight, kind="stable")
        if weight[i] > LEAST
    ]


def _explanations(problem: fit.Problem, fitted: fit.Fitted) -> list[Explanation]:
    odds = fitted.evidence()
    covariance = np.linalg.inv(fitted.information)
    k = fit.POSE + 2 * len(problem.trace.lever_m)
    span = slice(k, k + 4)
    strength = problem.strength + problem.strength_sigma * fitted.parameters[:, span]
    sigma = problem.strength_sigma * np.sqrt(np.einsum("kii->ki", covariance)[:, span])
    gone = problem.strength == 0
    free = np.where(gone.any(axis=1), gone.argmax(axis=1), -1)
    code = (strength > 0) @ (1 << np.arange(4))
    residual = problem.residuals(fitted.parameters, jacobian=False)[0]
    seen = max(int((~np.isnan(problem.trace.value_t)).sum()), 1)
    rms = np.sqrt(np.einsum("kr,kr->k", residual, residual) / (seen * problem.trace.share))
    return [
        Explanation(
            int(code[i]),
            float(odds[i]),
            fitted.parameters[i],
            covariance[i],
            strength[i],
            sigma[i],
            float(rms[i]),
            int(free[i]),
        )
        for i in range(len(code))
    ]


def robot(trace: Trace, explanation: Explanation, at: int) -> tuple[Array, Array]:
    """Robot in the landmark's frame at sample ``at`` of the trace.

    Returns
    -------
    (3,) ndarray, (3, 3) ndarray
        x, y, heading and their covariance, in m and rad.
    """
    count = trace.correction.shape[2]
    rows = np.r_[: fit.POSE, len(explanation.parameters) - count : len(explanation.parameters)]
    mark = explanation.parameters[: fit.POSE]
    wrong = explanation.parameters[len(explanation.parameters) - count :]
    pose = trace.pose[at] + trace.correction[at] @ wrong
    cos, sin = np.cos(mark[2]), np.sin(mark[2])
    back = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])
    seen = back @ (pose - mark)
    slope = np.hstack([-back, back @ trace.correction[at]])
    slope[:2, 2] = [seen[1], -seen[0]]
    return seen, slope @ explanation.covariance[np.ix_(rows, rows)] @ slope.T


def stand(
    trace: Trace, geometry: Geometry, priors: fit.Priors, strength: Array, start: Array
) -> tuple[Array, Array]:
    """Robot at a landmark that is known, from what is known of its place already.

    Parameters
    ----------
    trace : Trace
        One sample or more: the four fields of a robot that stands still are enough.
    geometry : Geometry
    priors : Priors
    strength : (4,) ndarray
        Expected signed strengths of the bars in the landmark's frame.
    start : (3,) ndarray
        Robot in the landmark's frame, within a centimetre and some ten degrees.

    Returns
    -------
    (3,) ndarray, (3, 3) ndarray
        Robot in the landmark's frame at the trace's reference, and the covariance.
    """
    problem = _problem(trace, geometry, priors, np.asarray(strength, float)[None])
    cos, sin = math.cos(start[2]), math.sin(start[2])
    mark = [-cos * start[0] - sin * start[1], sin * start[0] - cos * start[1], -start[2]]
    fitted = fit.descend(problem, problem.start(np.array([mark])))
    return robot(trace, _explanations(problem, fitted)[0], trace.reference)
