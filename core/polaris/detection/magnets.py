"""One pass over unknown magnets, from samples to a sighting, by maximum likelihood.

Magnets are looked for by the scan, fitted together with the way of the array, looked for
again in what is left, and those that turn out to be too weak (iron debris, a magnet of
another kind) are kept in the fit but not taken for a tag's. Where the residual is not
white the search begins again from another speed or height.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from locatk.core.errors import DegenerateError
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.fit import Fitted, fit
from locatk.core.polaris.detection.scan import BESIDE, FEW_SENSORS, Atom, Scanner
from locatk.core.polaris.detection.task import Task, clocks
from locatk.core.polaris.detection.window import Priors, State, Window, trends
from locatk.core.polaris.magnets import DetectedMagnets

Array = NDArray[np.float64]

STEPS_M = np.geomspace(0.02e-3, 10e-3, 14)
"""Steps of a sample period that are tried."""

COMMON_T = 3e-6
"""Shared field that is allowed for while magnets are looked for."""

ENOUGH = 0.95
"""Share of its residual above which one more round of sources was not worth it."""

BAD = 3.0
"""Rms of a residual that has nothing to do with the samples."""

MOST_STARTS = 4

LONGEST_M = 2.0
"""A pass is never longer than this."""

WHITE = 1.6
"""Rms of a residual, in standard deviations of the noise, that needs no other start."""

DEBRIS = 1.3
"""Rms of a residual above which weak sources are looked for as well."""

TRENDS = 5
"""Terms of a background that drifts more than a slope."""

UNEVEN = 6.0
"""Mean square of a residual's slow part, in units of the noise, that is not left to it."""

SHARED = 2.0
"""The same of the part that all sensors share."""

WEAK = 0.4
"""A magnet has at least this share of the median moment."""

SAME_M = 0.6
"""Sources nearer to each other than this share of the height are one."""

LEAST_ENERGY = 80.0
"""Squares of the samples, in units of their noise, that a magnet must explain; noise alone
reaches 45 among the some thousand places of a pass."""


@dataclass(frozen=True)
class _Start:
    priors: Priors
    state: State
    left: float
    scanner: Scanner


def starts(task: Task, sign: float = 1.0) -> list[_Start]:
    """Speeds and heights to begin with.

    ``sign`` is 1 for an array that drives forward, -1 for one that drives backward.
    """
    found = []
    window = task.window
    for priors in task.priors:
        height = priors.height_m[0]
        scanner = Scanner(window.sensors_m, window.noise_t, height)
        if window.path_m is not None:
            paths = [(window.path_m, _mean_step(window))]
        else:
            span = window.frames[-1] - window.frames[0]
            paths = [
                (sign * speed * (window.frames - window.frames.mean()), sign * speed)
                for speed in STEPS_M
                if 2 * height < speed * span < LONGEST_M
            ]
        for path, speed in paths:
            atoms, left = scanner.atoms(path, task.scaled, 3, LEAST_ENERGY)
            if atoms:
                found.append(_Start(priors, _state(atoms, path, speed, priors), left, scanner))
    return found


def _mean_step(window: Window) -> float:
    assert window.path_m is not None
    return float(np.ptp(window.path_m) / max(np.ptp(window.frames), 1e-9))


def _state(atoms: list[Atom], path: Array, speed: float, priors: Priors) -> State:
    moments = np.array([[*atom.moment_am2, 0.0] for atom in atoms])
    return State(
        place_m=np.array([atom.place_m for atom in atoms]),
        moment_am2=moments,
        path_m=path - path[int(np.argmin(np.abs(path - np.median(path))))],
        speed_m=speed,
        height_m=priors.height_m[0],
        skew=priors.skew[0] if priors.skew[0] < 0.5 else 0.2,
    )


def fits(task: Task) -> Iterator[Fitted]:
    """Fits of a pass, from one start after the other; nothing where it holds no magnet.

    Of all speeds, heights and clocks those come first that explain the samples best. An
    array that drives backward is thought of last, and only where nothing else will do.
    """
    best = np.inf
    for sign in (1.0, -1.0):
        tried = [(clocked, start) for clocked in clocks(task) for start in starts(clocked, sign)]
        tried.sort(key=lambda pair: pair[1].left)
        for clocked, start in tried[:MOST_STARTS]:
            try:
                fitted = _grow(clocked, start)
            except DegenerateError:
                continue
            yield fitted
            if WHITE < best < BAD and fitted.sigma > ENOUGH * best:
                return  # what is left is not for want of a better start
            best = min(best, fitted.sigma)
        if task.window.path_m is not None or best < BAD:
            return


def _grow(task: Task, start: _Start) -> Fitted:
    """Fit from one start, with magnets added from the residual until it holds none."""
    window, priors = task.window, start.priors
    coarse = replace(window, common_t=COMMON_T if len(window.sensors_m) >= FEW_SENSORS else 0.0)
    path = start.state.path_m
    atoms, _ = start.scanner.atoms(path, task.scaled, task.most, LEAST_ENERGY)
    state = _state(_distinct(atoms, start.state.height_m), path, start.state.speed_m, priors)
    fitted = fit(coarse, state, priors, iterations=12, tolerance=1e-3, final=False)
    for _ in range(4):
        state = _with(fitted.state, _missed(task, fitted))
        if len(state.place_m) == len(fitted.state.place_m):
            break
        before = fitted
        fitted = fit(coarse, state, priors, iterations=12, tolerance=1e-3, final=False)
        if fitted.sigma > ENOUGH * before.sigma:
            break
    if window.path_m is not None and fitted.sigma > BAD:
        raise DegenerateError("the samples contradict the way that was given")
    # Whether the bar sees a field that all sensors share is told by the fit that allows it.
    if coarse.common_t and fitted.shared > max(SHARED, 2 * fitted.sigma**2):
        information = np.mean(1 / window.noise_t**2) * len(window.sensors_m)
        size = np.sqrt((fitted.shared - 1) / information)
        window = replace(window, common_t=float(size))
    while True:
        state = _without_ghosts(fitted.state, task)
        fitted = fit(window, state, priors)
        if _drifts(window, fitted):
            window = replace(window, trends=TRENDS)
            fitted = fit(window, fitted.state, priors)
        if len(_without_ghosts(fitted.state, task).place_m) == len(state.place_m):
            return fitted


def seeded(task: Task, fitted: Fitted, places_m: Array) -> Fitted:
    """Fit again with a source at each of ``places_m`` (M, 2), in the frame of the fit: those
    that are no magnets drop out by themselves.

    Raises
    ------
    DegenerateError
        The samples do not determine it.
    """
    window, priors = task.window, task.priors[0]
    moments = np.full((len(places_m), 3), 0.0)
    state = replace(fitted.state, place_m=places_m, moment_am2=moments)
    coarse = fit(window, state, priors, iterations=12, tolerance=1e-3, final=False)
    size = _sizes(coarse.state)
    strong = size > WEAK * np.median(np.sort(size)[-3:])
    state = replace(
        coarse.state,
        place_m=coarse.state.place_m[strong],
        moment_am2=coarse.state.moment_am2[strong],
    )
    return fit(window, _without_ghosts(state, task), priors)


def _missed(task: Task, fitted: Fitted) -> list[Atom]:
    """Sources that the residual still holds."""
    window, state = task.window, fitted.state
    scanner = Scanner(window.sensors_m, window.noise_t, state.height_m)
    residual = np.nan_to_num(fitted.residual / np.sqrt(window.counts)[:, None, None])
    residual = residual.reshape(len(window.frames), -1)
    room = min(4, task.most - len(state.place_m))
    new, _ = scanner.atoms(state.path_m, residual, room, max(LEAST_ENERGY, 12 * fitted.sigma**2))
    # What is weak is looked at where it is needed only.
    least = 0.0 if fitted.sigma > DEBRIS else 0.5 * WEAK * np.median(_sizes(state))
    return [
        atom
        for atom in new
        if np.hypot(*atom.moment_am2) > least and _far(atom.place_m, state, SAME_M * state.height_m)
    ]


def _drifts(window: Window, fitted: Fitted) -> bool:
    """Whether the residual holds slow courses that a level and a slope do not take out.

    In units of the noise, a white residual has squares of 1 along each course in time.
    """
    if window.trends >= TRENDS:
        return False
    residual = np.nan_to_num(fitted.residual).reshape(len(window.frames), -1)
    course = np.linalg.qr(trends(window.frames, TRENDS))[0][:, window.trends :]
    return bool(((course.T @ residual) ** 2).mean() > UNEVEN)


def _distinct(atoms: list[Atom], height: float) -> list[Atom]:
    """Atoms, the strongest first, without those that only mend a stronger one nearby."""
    kept: list[Atom] = []
    strongest = np.hypot(*atoms[0].moment_am2)
    for atom in atoms:
        near = [np.linalg.norm(atom.place_m - other.place_m) < 1.2 * height for other in kept]
        if not any(near) and np.hypot(*atom.moment_am2) > 0.25 * strongest:
            kept.append(atom)
    return kept


def _sizes(state: State) -> Array:
    return np.hypot(state.moment_am2[:, 0], state.moment_am2[:, 1])


def _far(place: Array, state: State, limit: float) -> bool:
    return bool(np.all(np.linalg.norm(state.place_m - place, axis=1) > limit))


def _with(state: State, atoms: list[Atom]) -> State:
    if not atoms:
        return state
    places = np.vstack([state.place_m, [atom.place_m for atom in atoms]])
    moments = np.vstack([state.moment_am2, [[*atom.moment_am2, 0.0] for atom in atoms]])
    return replace(state, place_m=places, moment_am2=moments)


def _without_ghosts(state: State, task: Task) -> State:
    """Without sources that are none: beside what the bar has passed over, no hundredth of
    a magnet, or sharing a magnet with another.

    Two magnets of a tag are never nearer than ``task.apart_m``; a weak source may be, but
    not at a magnet's own place.
    """
    sensors = task.window.sensors_m
    reach = (BESIDE + 0.5) * state.height_m
    inside = state.place_m[:, 0] > state.path_m.min() + sensors[:, 0].min() - reach
    inside &= state.place_m[:, 0] < state.path_m.max() + sensors[:, 0].max() + reach
    inside &= state.place_m[:, 1] > sensors[:, 1].min() - reach
    inside &= state.place_m[:, 1] < sensors[:, 1].max() + reach
    size = np.where(inside, _sizes(state), 0.0)
    kept: list[int] = []
    order = np.argsort(-size)
    for k in order:
        apart = np.linalg.norm(state.place_m[kept] - state.place_m[k], axis=1)
        weak = size[k] < WEAK * size[order[0]]
        least = SAME_M * state.height_m if weak else task.apart_m
        if size[k] > 0.03 * size[order[0]] and np.all(apart > least):
            kept.append(int(k))
    if not kept:
        raise DegenerateError("no magnet is left under the bar")
    return replace(state, place_m=state.place_m[kept], moment_am2=state.moment_am2[kept])


def magnets(fitted: Fitted, task: Task) -> NDArray[np.intp]:
    """Which of the sources are magnets of a tag: under the bar, and not weaker by far."""
    state, sensors = fitted.state, task.window.sensors_m
    reach = BESIDE * state.height_m
    under = state.place_m[:, 1] > sensors[:, 1].min() - reach
    under &= state.place_m[:, 1] < sensors[:, 1].max() + reach
    size = np.where(under, _sizes(state), 0.0)
    expected = task.priors[0].moment_am2
    usual = size[(size > WEAK / 2 * expected) & (size < 3 * expected)]
    if len(usual) == 0:
        usual = size[size > WEAK * size.max()]
    if len(usual) == 0:
        raise DegenerateError("no magnet is left under the bar")
    return np.flatnonzero(size > WEAK * np.median(usual))


def sighting(samples: Samples, task: Task, fitted: Fitted) -> DetectedMagnets:
    """What a fit says, in the array's frame at a sample near the magnets' middle."""
    state = fitted.state
    chosen = magnets(fitted, task)
    place = state.place_m[chosen]
    middle = place.mean(axis=0)
    number = np.arange(task.samples)
    path = np.interp(number, task.times, state.path_m)
    if task.path_m is not None and task.window.path_m is not None:
        path = task.path_m + (state.path_m[0] - task.window.path_m[0])
    spread = np.interp(number, task.times, fitted.path_sigma_m) * max(1.0, fitted.usual_sigma)
    # Of samples at the magnets' middle one that is sure: where nothing is felt, or a sample
    # was misread, the path may be anywhere.
    at = int(np.argmin(np.abs(median_filter(path, 5) - middle[0]) + 3 * spread))
    index = 3 * chosen[:, None] + np.arange(3)
    covariance = fitted.covariance[np.ix_(index.ravel(), index.ravel())]
    # What the model does not know shows in the residual.
    covariance = covariance * max(1.0, fitted.usual_sigma) ** 2
    here = path[at] * np.array([1.0, np.tan(state.crab_rad)])
    moment = state.moment_am2[chosen]
    return DetectedMagnets(
        time_ns=int(samples.time_ns[task.first + at]),
        first=task.first,
        stop=task.first + task.samples,
        path_m=path - path[at],
        place_m=place - here,
        angle_rad=np.arctan2(moment[:, 1], moment[:, 0]),
        moment_am2=np.hypot(moment[:, 0], moment[:, 1]),
        covariance=covariance,
        path_sigma_m=spread,
        crab_rad=state.crab_rad,
        free_path=task.window.path_m is None,
        height_m=state.height_m,
        height_sigma_m=fitted.height_sigma_m * max(1.0, fitted.usual_sigma),
        residual_sigma=fitted.sigma,
        usual_sigma=fitted.usual_sigma,
        origin_m=here,
        others=len(state.place_m) - len(chosen),
    )
