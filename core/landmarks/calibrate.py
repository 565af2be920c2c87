"""How the landmarks of a floor really lie, from recordings of robots that drove over it.

All visits of all recordings, the odometry between them and the landmarks are one least
squares (:mod:`.smooth`), solved twice: first with next to nothing known of the landmarks,
which shows what is displaced or faulty; then with all others held by the tolerances with
which landmarks are laid.

Not everything can be seen. *Where the floor lies as a whole*: moving or turning all of it
changes no measurement, so that most of the landmarks are taken to lie on the map as
designed (:mod:`.gauge`), and standard deviations are of landmarks to one another. The same
holds for recordings that have no landmark in common with the others. *How strong the bars
are as a whole*: stronger magnets, sensors with more gain and sensors nearer to the floor
are nearly one, so that the typical bar is taken to have the strength 1. *Which bar of a
landmark is off its place*: the centre is that of the four bars.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks import gauge, smooth, solver
from locatk.core.landmarks.estimate import FAULTY, GONE
from locatk.core.landmarks.fit import Priors
from locatk.core.landmarks.floor import AsBuilt, Cell, FloorMap
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.trace import compose
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

LOOSE = np.array([10e-3, 10e-3, math.radians(5)])
"""Standard deviations of a landmark's place and heading of which nothing is known."""

LAID = np.array([solver.LAID_M, solver.LAID_M, solver.LAID_RAD])

ODD = 3.0
"""Times :data:`LAID` from which on a landmark is not held by its design."""

DISPLACED_M, TURNED_RAD = 5e-3, math.radians(3)
"""From which on a landmark is flagged."""

WEAK = 0.8
"""Strength under which a bar is."""

SURE = 3.0
"""Standard deviations by which a flag must be."""

SOUND = 0.2
"""A bar is held to the common strength where it is within this share of it."""

GRAZED = np.array([1.5e-3, 1.5e-3, math.radians(1.5)])
"""Standard deviations of place and heading above which a landmark is not told."""

GRAZED_STRENGTH = 0.15

APART_M, APART_RAD = 4e-3, math.radians(4)
STRAYS = 5.0
"""A visit that is off by this, and so many standard deviations, was not read right."""

ROUNDS = 5
"""Strays are taken out so often."""

MISFIT = 2.0
"""Residual of all fields, in standard deviations, that asks for a word."""


@dataclass(frozen=True)
class Drive:
    """One robot's recording, read; ``name`` is for people."""

    name: str
    found: solver.Recording


@dataclass(frozen=True)
class Landmark:
    """What was found of one landmark.

    Attributes
    ----------
    cell : (row, column)
    built : AsBuilt
    why : str
        Why it is not told to the map; ``""`` where it is.
    """

    cell: Cell
    built: AsBuilt
    why: str = ""


@dataclass(frozen=True)
class CalibrationReport:
    """A map with what was learned of it.

    Attributes
    ----------
    floor : FloorMap
        As given, but for ``built`` of the landmarks that were found.
    found : tuple of Landmark
        All that were visited, by cell.
    unvisited : tuple of (row, column)
    strength, strength_sigma : float
        Of the typical bar, as far as the sensors' gains and their height tell it.
    misfit : float
        Rms of what is left of the fields, in standard deviations.
    left_out : dict of str to str
        A recording or a visit to why it was not used.
    notes : tuple of str
    """

    floor: FloorMap
    found: tuple[Landmark, ...]
    unvisited: tuple[Cell, ...]
    strength: float
    strength_sigma: float
    misfit: float
    left_out: dict[str, str]
    notes: tuple[str, ...]


def read(
    name: str,
    samples: HallSamples,
    odometry: Trajectory | None,
    floor: FloorMap,
    options: solver.SolveOptions | None = None,
) -> Drive | str:
    """One robot's recording, localised on the map; or why it cannot be used.

    Raises
    ------
    InputError
        See :func:`.solver.solve`.
    """
    found = solver.read(samples, odometry, floor, options or solver.SolveOptions())
    if not found.seen:
        return "no landmark was seen"
    if not solver.on_map(found, floor):
        return "not localised on the map"
    return Drive(name, found)


def calibrate(
    floor: FloorMap, drives: Sequence[Drive], left_out: Mapping[str, str] | None = None
) -> CalibrationReport:
    """Fit place, heading and bar strengths of each landmark that was visited.

    Parameters
    ----------
    floor : FloorMap
        What it says of landmarks as built is replaced where they were visited, and is no
        evidence.
    drives : sequence of Drive
        Of :func:`read`.
    left_out : mapping of str to str
        Recordings that are none already: name to why.

    Returns
    -------
    CalibrationReport

    Raises
    ------
    InputError
        No visit can be used.
    """
    out = dict(left_out or {})
    used = [(drive, solver.on_map(drive.found, floor)) for drive in drives]
    used = [(drive, visits) for drive, visits in used if visits]
    if not used:
        why = f" ({'; '.join(f'{name}: {text}' for name, text in out.items())})" if out else ""
        raise InputError(
            f"no landmark of the map was found in the recordings{why}",
            hint="Drive over three landmarks or more of the window's shape in one recording",
        )
    noise = math.sqrt(np.mean([drive.found.priors.noise_t**2 for drive, _ in used]))
    priors = replace(used[0][0].found.priors, noise_t=noise, floor_t=solver.ALONE_T)
    design = replace(floor, built={})
    for _ in range(ROUNDS):
        first = _solved(used, _unknown(used, design), design, priors)
        strays = _strays(used, first)
        if not strays:
            break
        used = _without(used, strays, out)
    parts = gauge.joined([[_cell(one) for one in visits] for _, visits in used])
    common, common_sigma = _common(first)
    rough = _landmarks(first, _unknown(used, design), design, parts, used)
    held = _held(first, rough, design, common)
    nearly = replace(design, built={cell: one.built for cell, one in rough.items() if not one.why})
    last = _solved(used, held, nearly, priors)
    fine = _landmarks(last, held, design, parts, used)
    found = tuple(replace(fine[cell], why=rough[cell].why) for cell in sorted(fine))
    built = {one.cell: one.built for one in found if not one.why}
    return CalibrationReport(
        replace(floor, built={**floor.built, **built}),
        found,
        tuple(cell for cell in floor.cells() if cell not in fine),
        common,
        common_sigma,
        last.misfit,
        out,
        tuple(_notes(floor, parts, common, common_sigma, last.misfit, set(fine))),
    )


_Used = list[tuple[Drive, list[solver.Seen]]]


def _cell(one: solver.Seen) -> Cell:
    assert one.located is not None
    return one.located.cell


def _solved(
    used: _Used, marks: Mapping[Cell, smooth.Mark], floor: FloorMap, priors: Priors
) -> smooth.Smoothed:
    runs = [solver.as_run(visits, drive.found, floor) for drive, visits in used]
    return smooth.smooth(runs, marks, floor.geometry, priors)


def _unknown(used: _Used, design: FloorMap) -> dict[Cell, smooth.Mark]:
    """Landmarks of which little is known but how their bars were read."""
    weight: dict[Cell, Array] = {}
    total: dict[Cell, Array] = {}
    for _, visits in used:
        for one in visits:
            assert one.located is not None
            cell, best = _cell(one), one.explanations[one.located.hypothesis]
            turned = np.roll([best.strength, best.strength_sigma], one.located.quarters, axis=1)
            now = np.maximum(turned[1], 1e-3) ** -2
            weight[cell] = weight.get(cell, np.zeros(4)) + now
            total[cell] = total.get(cell, np.zeros(4)) + now * turned[0]
    marks = {}
    for cell, read_as in total.items():
        strength = read_as / weight[cell]
        strength = np.where(np.abs(strength) < GONE, 0.0, np.sign(strength))
        pose = np.array([*design.place(cell), 0.0])
        marks[cell] = smooth.Mark(pose, LOOSE, strength, np.full(4, FAULTY))
    return marks


def _held(
    first: smooth.Smoothed, rough: Mapping[Cell, Landmark], design: FloorMap, common: float
) -> dict[Cell, smooth.Mark]:
    """Landmarks held by tolerances, but for what has been seen to be beyond them."""
    marks = {}
    usual = Priors().strength
    for cell, mark in first.marks.items():
        built = rough[cell].built
        left = np.array([built.x_m, built.y_m, built.heading_rad])
        odd = bool(np.any(np.abs(left) > ODD * LAID))
        strength = mark.strength / common
        sound = np.abs(np.abs(strength) - 1) < SOUND
        marks[cell] = smooth.Mark(
            np.array([*design.place(cell), 0.0]),
            LOOSE if odd else LAID,
            np.where(sound, np.sign(strength), strength),
            np.where(sound, usual, FAULTY),
        )
    return marks


def _common(first: smooth.Smoothed) -> tuple[float, float]:
    """Strength of the typical bar, and how well that is known."""
    every = np.concatenate([mark.strength for mark in first.marks.values()])
    there = np.abs(every) > 2 * GONE
    if not there.any():
        return 1.0, math.nan
    sigma = np.concatenate(
        [np.sqrt(np.diag(mark.covariance)[3:]) for mark in first.marks.values()]
    )
    return float(np.median(np.abs(every[there]))), float(np.min(sigma[there]))


def _landmarks(
    smoothed: smooth.Smoothed,
    marks: Mapping[Cell, smooth.Mark],
    design: FloorMap,
    parts: Sequence[Sequence[Cell]],
    used: _Used,
) -> dict[Cell, Landmark]:
    """All landmarks, each part of the floor laid over its design."""
    visits = [_cell(one) for _, here in used for one in here]
    scale = max(1.0, smoothed.misfit) ** 2  # as smooth has it
    found = {}
    for part in parts:
        pose = np.array([smoothed.marks[cell].pose for cell in part])
        designed = np.array([[*design.place(cell), 0.0] for cell in part])
        covariance = np.array([smoothed.marks[cell].covariance for cell in part])
        left = gauge.unlike_design(pose, designed, LAID)
        prior = np.array([marks[cell].sigma for cell in part])
        own = gauge.own_covariances(covariance[:, :3, :3], pose[:, :2], prior, scale)
        if len(part) == 1:
            left, own = np.zeros((1, 3)), np.full((1, 3, 3), np.nan)
        sigma = np.sqrt(np.maximum(np.einsum("nii->ni", own), 0.0))
        spread = np.sqrt(np.einsum("nii->ni", covariance[:, 3:, 3:]))
        for k, cell in enumerate(part):
            strength = smoothed.marks[cell].strength
            whole = np.concatenate([sigma[k], spread[k]])
            x, y, heading = (float(value) for value in left[k])
            flags = _flags(signs(design.codes[cell]), left[k], strength, whole)
            built = AsBuilt(x, y, heading, strength, whole, visits.count(cell), flags)
            found[cell] = Landmark(cell, built, _grazed(whole))
    return found


def _grazed(sigma: Array) -> str:
    if np.any(sigma[:3] > GRAZED):
        return "its place is not known well enough"
    if np.any(sigma[3:] > GRAZED_STRENGTH):
        bars = ", ".join(str(k) for k in np.flatnonzero(sigma[3:] > GRAZED_STRENGTH))
        return f"too little was seen of bar {bars}"
    return ""


def _flags(designed: Array, left: Array, strength: Array, sigma: Array) -> tuple[str, ...]:
    """What is wrong with one landmark."""
    flags = []
    for bar, (value, spread) in enumerate(zip(strength, sigma[3:], strict=True)):
        size = abs(value)
        if size < GONE:
            flags.append(f"missing:{bar}")
            continue
        if value * designed[bar] < 0 and size > SURE * spread:
            flags.append(f"flipped:{bar}")
        if size < WEAK and 1 - size > SURE * spread:
            flags.append(f"weak:{bar}")
    away = float(np.hypot(*left[:2]))
    if away > max(DISPLACED_M, SURE * float(np.hypot(*np.nan_to_num(sigma[:2])))):
        flags.append("displaced")
    if abs(left[2]) > max(TURNED_RAD, SURE * float(np.nan_to_num(sigma[2]))):
        flags.append("turned")
    return tuple(flags)


def _strays(used: _Used, smoothed: smooth.Smoothed) -> set[tuple[int, int]]:
    """The visit of each recording that agrees least with all others, where it does not."""
    found = set()
    for number, (_, visits) in enumerate(used):
        worst, at = 1.0, -1
        for k, (one, stay) in enumerate(zip(visits, smoothed.stays[number], strict=True)):
            assert one.located is not None
            told = one.sighting.hypotheses[one.located.hypothesis]
            mark = smoothed.marks[one.located.cell]
            turn = np.array([0.0, 0.0, one.located.quarters * math.pi / 2])
            alone = compose(mark.pose, compose(turn, told.pose))
            miss = stay.pose - alone
            miss[2] = math.remainder(miss[2], math.tau)
            spread = np.sqrt(np.diag(told.covariance))
            place = float(np.hypot(*miss[:2])) / max(APART_M, STRAYS * float(np.hypot(*spread[:2])))
            heading = abs(miss[2]) / max(APART_RAD, STRAYS * spread[2])
            if max(place, heading) > worst:
                worst, at = max(place, heading), k
        if at >= 0:
            found.add((number, at))
    return found


def _without(used: _Used, strays: set[tuple[int, int]], out: dict[str, str]) -> _Used:
    """Visits less those that stray, which are named."""
    kept = []
    for number, (drive, visits) in enumerate(used):
        for k, one in enumerate(visits):
            if (number, k) in strays:
                when = one.sighting.time_ns * 1e-9
                row, column = _cell(one)
                out[f"{drive.name} at {when:.3f} s"] = (
                    f"the visit to {row},{column} does not agree with the others"
                )
        rest = [one for k, one in enumerate(visits) if (number, k) not in strays]
        if rest:
            kept.append((drive, rest))
    return kept


def _notes(
    floor: FloorMap,
    parts: Sequence[Sequence[Cell]],
    common: float,
    sigma: float,
    misfit: float,
    visited: set[Cell],
) -> list[str]:
    notes = []
    if len(parts) > 1:
        notes.append(
            f"the recordings are of {len(parts)} parts of the floor with no landmark in common: "
            "each was laid over the map by itself"
        )
    alone = [part[0] for part in parts if len(part) == 1]
    if alone:
        cells = " ".join(f"{row},{column}" for row, column in alone)
        notes.append(f"of {cells} alone in its recording the place cannot be told, only the bars")
    if math.isfinite(sigma) and abs(common - 1) > SURE * sigma:
        notes.append(
            f"the typical bar seems to be {common:.2f} as strong as the map's: remanence_t or "
            "sensor_height_mm may not be what they are; strengths are against the typical bar"
        )
    if misfit > MISFIT:
        notes.append(
            f"the fields leave {misfit:.1f} times what noise would: check bars and sensor height "
            "of the map"
        )
    kept = sorted(set(floor.built) - visited)
    if kept:
        notes.append(f"{len(kept)} landmarks as built are of an earlier calibration")
    return notes
