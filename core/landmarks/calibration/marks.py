"""One landmark of a calibration: what is known of it before and after, and what is wrong."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks import solver
from locatk.core.landmarks.calibration import datum as gauge
from locatk.core.landmarks.detection.explanations import FAULTY, GONE
from locatk.core.landmarks.detection.fit import Priors
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.localization import recording
from locatk.core.landmarks.localization import smoothing as smooth
from locatk.core.landmarks.map.floor import AsBuiltLandmark, Cell, FloorMap

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
    built: AsBuiltLandmark
    why: str = ""


def cell_of(one: recording.Seen) -> Cell:
    """Of a visit that is on the map."""
    assert one.located is not None
    return one.located.cell


def unknown(visits: Sequence[recording.Seen], design: FloorMap) -> dict[Cell, smooth.Mark]:
    """Landmarks of which little is known but how their bars were read."""
    weight: dict[Cell, Array] = {}
    total: dict[Cell, Array] = {}
    for one in visits:
        assert one.located is not None
        cell, best = cell_of(one), one.explanations[one.located.hypothesis]
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


def held(
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


def common_strength(first: smooth.Smoothed) -> tuple[float, float]:
    """Strength of the typical bar, and how well that is known."""
    every = np.concatenate([mark.strength for mark in first.marks.values()])
    there = np.abs(every) > 2 * GONE
    if not there.any():
        return 1.0, math.nan
    sigma = np.concatenate([np.sqrt(np.diag(mark.covariance)[3:]) for mark in first.marks.values()])
    return float(np.median(np.abs(every[there]))), float(np.min(sigma[there]))


def landmarks(
    smoothed: smooth.Smoothed,
    marks: Mapping[Cell, smooth.Mark],
    design: FloorMap,
    parts: Sequence[Sequence[Cell]],
    visits: Sequence[recording.Seen],
) -> dict[Cell, Landmark]:
    """All landmarks, each part of the floor laid over its design."""
    count = Counter(cell_of(one) for one in visits)
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
            built = AsBuiltLandmark(x, y, heading, strength, whole, count[cell], flags)
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
