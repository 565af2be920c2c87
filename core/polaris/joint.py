"""One pass over unknown magnets, from samples to a sighting, by maximum likelihood.

Magnets are looked for by the scan, fitted together with the way of the array, looked for
again in what is left, and those that turn out to be too weak (iron debris, a magnet of
another kind) are kept in the fit but not taken for a tag's. Where the residual is not
white the search begins again from another speed or height.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.polaris.array import Samples
from locatk.core.polaris.dipoles import thickness
from locatk.core.polaris.fit import Fitted, fit
from locatk.core.polaris.passes import Pass
from locatk.core.polaris.problem import Priors, State, Window
from locatk.core.polaris.scan import Atom, Scanner
from locatk.core.polaris.sighting import Sighting
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

SPEEDS_M = np.geomspace(0.1e-3, 10e-3, 12)
"""Steps of a sample period that are tried."""

HEIGHTS_M = (0.005, 0.0075, 0.011, 0.016)
"""Tried where no tag tells the clearance."""

MOST_MAGNETS = 30
MOST_SAMPLES = 420
"""A longer pass is averaged down: its samples are closer than the field needs."""

WHITE = 1.6
"""Rms of a residual, in standard deviations of the noise, that needs no other start."""

DEBRIS = 1.3
"""Rms of a residual above which weak sources are looked for as well."""

WEAK = 0.4
"""A magnet has at least this share of the median moment."""

SAME_M = 0.6
"""Sources nearer to each other than this share of the height are one."""

LEAST_ENERGY = 80.0
"""Squares of the samples, in units of their noise, that a magnet must explain; noise alone
reaches 45 among the some thousand places of a pass."""


@dataclass(frozen=True)
class Task:
    """A pass, ready to be fitted.

    Attributes
    ----------
    window : Window
    scaled : (n, 3 N) ndarray
        Samples in units of their noise, on a straight background through the ends.
    priors : tuple of Priors
        One for each height to try.
    first : int
        Number in the recording of the window's first sample.
    group : int
        Samples that one of the window is the mean of.
    apart_m : float
        Least distance of two magnets.
    """

    window: Window
    scaled: Array
    priors: tuple[Priors, ...]
    first: int
    group: int
    apart_m: float


def prepare(
    samples: Samples,
    part: Pass,
    noise_t: Array,
    tags: Tags | None,
    path_m: Array | None = None,
) -> Task:
    """The samples of a pass as the fit takes them.

    ``path_m`` (n,) is how far the array had moved at each sample of the recording, where
    that is known.
    """
    at = slice(part.first, part.stop)
    group = max(1, -(-(part.stop - part.first) // MOST_SAMPLES))
    period_ns = float(np.median(np.diff(samples.time_ns)))
    frames = (samples.time_ns[at] - samples.time_ns[part.first]) / period_ns
    field = _averaged(samples.field_t[at], group)
    frames = _averaged(frames, group) / group
    noise_t = noise_t / np.sqrt(group)
    path = None if path_m is None else _averaged(path_m[at], group)

    delay = samples.array.delay_s
    middle, half = (delay.max() + delay.min()) / 2, np.ptp(delay) / 2
    order = (delay - middle) / half if half > 0 else np.zeros(3)
    skew = half * 1e9 / period_ns / group
    magnet = None if tags is None else tags.magnet
    window = Window(
        field_t=field,
        sensors_m=samples.array.position_m,
        noise_t=noise_t,
        frames=frames,
        order=order,
        path_m=path,
        thickness_m2=thickness(magnet),
    )
    heights = HEIGHTS_M if tags is None else (tags.clearance_m,)
    priors = tuple(
        Priors(
            height_m=(height, 0.3 * height),
            skew=(skew, 0.3),
            moment_am2=1.5e-3 if magnet is None else magnet.moment,
        )
        for height in heights
    )
    apart = SAME_M * heights[0] if tags is None else 0.5 * tags.spacing_m
    return Task(window, _level(field / noise_t), priors, part.first, group, apart)


def _averaged(values: Array, group: int) -> Array:
    if group == 1:
        return values
    count = len(values) // group
    shape = (count, group, *values.shape[1:])
    with np.errstate(all="ignore"):
        return np.asarray(np.nanmean(values[: count * group].reshape(shape), axis=1))


def _level(scaled: Array) -> Array:
    """Samples (n, 3 N) without the straight line through the means of both ends; 0 where
    there is none."""
    n = len(scaled)
    flat = scaled.reshape(n, -1)
    ends = max(3, min(10, n // 8))
    with np.errstate(all="ignore"):
        left, right = np.nanmedian(flat[:ends], axis=0), np.nanmedian(flat[-ends:], axis=0)
    share = np.linspace(0, 1, n)[:, None]
    return np.nan_to_num(flat - (1 - share) * np.nan_to_num(left) - share * np.nan_to_num(right))


@dataclass(frozen=True)
class _Start:
    priors: Priors
    state: State
    left: float


def starts(task: Task) -> list[_Start]:
    """Speeds and heights to begin with, the one that explains the samples best first."""
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
                (speed * (window.frames - window.frames.mean()), speed)
                for speed in SPEEDS_M
                if 2 * height < speed * span
            ]
        for path, speed in paths:
            atoms, left = scanner.atoms(path, task.scaled, 3, LEAST_ENERGY)
            if atoms:
                found.append(_Start(priors, _state(atoms, path, speed, priors), left))
    found.sort(key=lambda start: start.left)
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


def solve_pass(task: Task) -> Fitted | None:
    """The best fit of a pass; None where there is no magnet in it."""
    best: Fitted | None = None
    for start in starts(task)[:3]:
        try:
            fitted = _grow(task, start)
        except DegenerateError:
            continue
        if best is None or fitted.sigma < best.sigma:
            best = fitted
        if best.sigma < WHITE:
            break
    return best


def _grow(task: Task, start: _Start) -> Fitted:
    """Fit from one start, with magnets added from the residual until it holds none."""
    window, priors = task.window, start.priors
    scanner = Scanner(window.sensors_m, window.noise_t, start.state.height_m)
    path = start.state.path_m
    atoms, _ = scanner.atoms(path, task.scaled, MOST_MAGNETS, LEAST_ENERGY)
    state = _state(_distinct(atoms, start.state.height_m), path, start.state.speed_m, priors)
    fitted = fit(window, state, priors, iterations=12, tolerance=1e-3, final=False)
    for _ in range(4):
        state = fitted.state
        scanner = Scanner(window.sensors_m, window.noise_t, state.height_m)
        residual = np.nan_to_num(fitted.residual).reshape(len(window.frames), -1)
        new, _ = scanner.atoms(state.path_m, residual, 4, max(LEAST_ENERGY, 12 * fitted.sigma**2))
        # What is weak is looked at where it is needed only.
        least = 0.0 if fitted.sigma > DEBRIS else 0.5 * WEAK * np.median(_sizes(state))
        new = [
            atom
            for atom in new
            if np.hypot(*atom.moment_am2) > least
            and _far(atom.place_m, state, SAME_M * state.height_m)
        ]
        if not new:
            break
        state = _with(state, new)
        fitted = fit(window, state, priors, iterations=12, tolerance=1e-3, final=False)
    while True:
        state = _without_ghosts(fitted.state, task.apart_m)
        fitted = fit(window, state, priors)
        if len(_without_ghosts(fitted.state, task.apart_m).place_m) == len(state.place_m):
            return fitted


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
    places = np.vstack([state.place_m, [atom.place_m for atom in atoms]])
    moments = np.vstack([state.moment_am2, [[*atom.moment_am2, 0.0] for atom in atoms]])
    return replace(state, place_m=places, moment_am2=moments)


def _without_ghosts(state: State, apart_m: float) -> State:
    """Without sources that are no hundredth of a magnet, or that share one with another.

    Two magnets of a tag are never nearer than ``apart_m``; a weak source may be, but not at
    a magnet's own place.
    """
    size = _sizes(state)
    order = np.argsort(-size)
    kept: list[int] = []
    for k in order:
        apart = np.linalg.norm(state.place_m[kept] - state.place_m[k], axis=1)
        weak = size[k] < WEAK * size[order[0]]
        least = SAME_M * state.height_m if weak else apart_m
        if size[k] > 0.03 * size[order[0]] and np.all(apart > least):
            kept.append(int(k))
    return replace(state, place_m=state.place_m[kept], moment_am2=state.moment_am2[kept])


def magnets(fitted: Fitted) -> NDArray[np.intp]:
    """Which of the sources are magnets of a tag: the others are weaker by far."""
    size = _sizes(fitted.state)
    strong = size[size > WEAK * size.max()]
    return np.flatnonzero(size > WEAK * np.median(strong))


def sighting(samples: Samples, task: Task, fitted: Fitted) -> Sighting:
    """What a fit says, in the array's frame at a sample near the magnets' middle."""
    state = fitted.state
    chosen = magnets(fitted)
    place = state.place_m[chosen]
    middle = place.mean(axis=0)
    at = int(np.argmin(np.abs(state.path_m - middle[0])))
    index = 3 * chosen[:, None] + np.arange(3)
    covariance = fitted.covariance[np.ix_(index.ravel(), index.ravel())]
    # What the model does not know shows in the residual.
    covariance = covariance * max(1.0, fitted.sigma) ** 2
    here = state.path_m[at] * np.array([1.0, np.tan(state.crab_rad)])
    moved = state.path_m - state.path_m[at]
    moment = state.moment_am2[chosen]
    return Sighting(
        time_ns=int(samples.time_ns[task.first + at * task.group + task.group // 2]),
        first=task.first,
        stop=task.first + len(moved) * task.group,
        path_m=np.repeat(moved, task.group),
        place_m=place - here,
        angle_rad=np.arctan2(moment[:, 1], moment[:, 0]),
        moment_am2=np.hypot(moment[:, 0], moment[:, 1]),
        covariance=covariance,
        path_sigma_m=np.repeat(fitted.path_sigma_m * max(1.0, fitted.sigma), task.group),
        crab_rad=state.crab_rad,
        free_path=task.window.path_m is None,
        height_m=state.height_m,
        height_sigma_m=fitted.height_sigma_m * max(1.0, fitted.sigma),
        residual_sigma=fitted.sigma,
        others=len(state.place_m) - len(chosen),
    )
