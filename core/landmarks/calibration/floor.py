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
from locatk.core.landmarks import solver
from locatk.core.landmarks.calibration import datum as gauge
from locatk.core.landmarks.calibration.marks import (
    SURE,
    Landmark,
    cell_of,
    common_strength,
    held,
    landmarks,
    unknown,
)
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.detection.fit import Priors
from locatk.core.landmarks.detection.trace import compose
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.localization import recording
from locatk.core.landmarks.localization import smoothing as smooth
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_codes
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

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
    found: recording.Recording


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
    options: recording.SolveOptions | None = None,
) -> Drive | str:
    """One robot's recording, localised on the map; or why it cannot be used.

    Raises
    ------
    InputError
        See :func:`.solver.solve`.
    """
    found = recording.read(samples, odometry, floor, options or recording.SolveOptions())
    if not found.seen:
        return "no landmark was seen"
    if not recording.on_map(found, floor):
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
    used = [(drive, recording.on_map(drive.found, floor)) for drive in drives]
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
    first = _solved(used, unknown(_every(used), design), design, priors)
    for _ in range(ROUNDS):
        strays = _strays(used, first)
        if not strays:
            break
        used = _without(used, strays, out)
        if not used:
            raise InputError(
                "no visit agrees with the odometry and the other visits",
                hint="Check the odometry and the sensors with `locatk solve` first",
            )
        first = _solved(used, unknown(_every(used), design), design, priors)
    every = _every(used)
    parts = gauge.joined([[cell_of(one) for one in visits] for _, visits in used])
    common, common_sigma = common_strength(first)
    rough = landmarks(first, unknown(every, design), design, parts, every)
    marks = held(first, rough, design, common)
    nearly = replace(design, built={cell: one.built for cell, one in rough.items() if not one.why})
    last = _solved(used, marks, nearly, priors)
    fine = landmarks(last, marks, design, parts, every)
    found = tuple(replace(fine[cell], why=rough[cell].why) for cell in sorted(fine))
    built = {one.cell: one.built for one in found if not one.why}
    report = CalibrationReport(
        replace(floor, built={**floor.built, **built}),
        found,
        tuple(cell for cell in floor.cells() if cell not in fine),
        common,
        common_sigma,
        last.misfit,
        out,
        (),
    )
    return replace(report, notes=tuple(_notes(report, parts, floor)))


def _every(used: _Used) -> list[recording.Seen]:
    return [one for _, visits in used for one in visits]


_Used = list[tuple[Drive, list[recording.Seen]]]


def _solved(
    used: _Used, marks: Mapping[Cell, smooth.Mark], floor: FloorMap, priors: Priors
) -> smooth.Smoothed:
    runs = [solver.as_run(visits, drive.found, floor) for drive, visits in used]
    return smooth.smooth(runs, marks, floor.geometry, priors)


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
                row, column = cell_of(one)
                out[f"{drive.name} at {when:.3f} s"] = (
                    f"the visit to {row},{column} does not agree with the others"
                )
        rest = [one for k, one in enumerate(visits) if (number, k) not in strays]
        if rest:
            kept.append((drive, rest))
    return kept


def _notes(
    report: CalibrationReport, parts: Sequence[Sequence[Cell]], given: FloorMap
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
        notes.append(
            f"the place of {cells} cannot be told, only the bars: no recording goes from there "
            "to another landmark"
        )
    off = abs(report.strength - 1)
    if math.isfinite(report.strength_sigma) and off > SURE * report.strength_sigma:
        notes.append(
            f"the typical bar seems to have {report.strength:.2f} of the strength that the map "
            "says: remanence_t or sensor_height_mm may be wrong; strengths are told against the "
            "typical bar"
        )
    if report.misfit > MISFIT:
        notes.append(
            f"the fields leave {report.misfit:.1f} times what noise would: check the bars and "
            "the sensor height of the map"
        )
    kept = set(given.built) - {one.cell for one in report.found if not one.why}
    if kept:
        notes.append(f"kept of an earlier calibration: {len(kept)} landmarks")
    return [*notes, *_uniqueness(report.floor)]


def _uniqueness(floor: FloorMap) -> list[str]:
    """What flipped bars do to the proof of the map."""
    codes = as_built_codes(floor)
    changed = int(np.count_nonzero(codes != floor.codes))
    if not changed:
        return []
    count = prove_map(replace(floor, codes=codes, built={}), steps=False).duplicate_count
    is_not = "1 landmark is" if changed == 1 else f"{changed} landmarks are"
    if not count:
        return [f"{is_not} not laid as designed; the map is unique all the same, as laid"]
    repeats = "1 reading repeats" if count == 1 else f"{count} readings repeat"
    return [f"{is_not} not laid as designed, and so {repeats} another: mend the flagged bars"]
