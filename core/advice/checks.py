"""Checks that several systems share, and the surroundings that magnets and light suffer from."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.advice.answer import AccuracyMap, Certainty, Check
from locatk.core.advice.task import Task
from locatk.core.polaris.design.environment import MOTORS, REINFORCED
from locatk.core.polygons import is_inside

Array = NDArray[np.float64]

IRON_FIELDS_T = {"none": 0.0, "reinforced": REINFORCED.field_t, "plates": 30e-6}
"""Standard deviation [T] of the field of iron in the floor over a few centimetres. Plates:
magnetised steel a few centimetres below the sensors differs by tens of microtesla from place to
place; an assumption."""

MAP_POINTS = 42
"""Points of a map along each side of the area, both ends included."""

MIN_COVERAGE = 0.95
"""Fraction of area or routes on which a position must be known."""


def limit_check(
    name: str,
    unit: str,
    expected: float,
    wanted: float | None,
    certainty: Certainty,
    source: str,
    remedy: str = "",
    *,
    better: Literal["lower", "higher"] = "lower",
) -> Check:
    """Return the check of a number; it is met if nothing is wanted or it is on the better side."""
    is_met = None
    if wanted is not None:
        is_met = expected <= wanted if better == "lower" else expected >= wanted
    return Check(name, unit, expected, wanted, is_met, certainty, source, remedy)


def condition_check(
    name: str,
    is_met: bool,
    expected: str,
    source: str,
    remedy: str = "",
    certainty: Certainty = "published",
) -> Check:
    """Return the check of a condition that is no number."""
    return Check(name, "", expected, None, is_met, certainty, source, remedy)


def magnetic_checks(task: Task, what: str) -> list[Check]:
    """Return the checks of iron and of flight that both magnetic systems have."""
    checks = [
        condition_check(
            "iron",
            task.iron != "plates",
            f"steel plates hide and distort the fields of {what}"
            if task.iron == "plates"
            else "fields of iron are part of the forecast",
            "flux follows iron of high permeability (Jackson, Classical Electrodynamics, 5.12)",
            "A floor without steel plates or rails within 0.1 m of the magnets",
        )
    ]
    if task.is_flying:
        checks.append(driving_check(what))
    return checks


def driving_check(what: str) -> Check:
    """Return the check that fails for robots in space over infrastructure in the floor."""
    return condition_check(
        "robots in space",
        False,
        f"{what} are read from a few millimetres to centimetres only",
        "ranges of the sensors in the papers",
        "Robots that drive",
    )


def uniform_map(
    task: Task, error_m: float, infrastructure_m: Array, infrastructure: str
) -> AccuracyMap:
    """Return the map of an error that is the same in the whole area."""
    low, high = task.corners_m.min(axis=0), task.corners_m.max(axis=0)
    x, y = (
        np.linspace(first, last, MAP_POINTS)[1:-1] for first, last in zip(low, high, strict=True)
    )
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = points[is_inside(task.corners_m, points)]
    return AccuracyMap(points, np.full(len(points), error_m), infrastructure_m, infrastructure)


def disturbance_t(task: Task) -> float:
    """Return the standard deviation [T] of fields that vary during a pass."""
    return math.hypot(IRON_FIELDS_T[task.iron], MOTORS.field_t * task.has_motors)
