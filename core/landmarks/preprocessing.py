"""Readings that are none: dead and saturated sensors, and jumps of single samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

FULL = 0.999
"""Share of a sensor's range from which on a reading is saturated."""

PLATEAU = 30
"""Readings at the very same extreme from which on that is taken for the end of the range."""

JUMP_T = 2e-3

JUMP = 0.4
"""What a reading between two others may be off their middle, beside :data:`JUMP_T` and the
difference of both, in units of the larger."""

DEAD = 1e-3
"""A sensor that varies less than this share of the others is dead."""


def cleaned(samples: HallSamples) -> tuple[Array, list[SolverWarning]]:
    """Fields (n, N) in which nothing but readings is left, ``nan`` elsewhere, and warnings.

    Raises
    ------
    InputError
        No sensor is left.
    """
    field = samples.field_t.copy()
    warnings = []
    jumps = _jumps(field)
    field[jumps] = np.nan
    if jumps.any():
        message = f"{int(jumps.sum())} single readings jump; left out"
        warnings.append(SolverWarning("spikes", message))
    limit = samples.sensors.range_t
    plateau = _plateau(field)
    if not np.isfinite(limit) and plateau is not None:
        limit = plateau
        message = f"readings end at {1e3 * limit:.3g} mT, which is taken for the sensors' range"
        warnings.append(SolverWarning("range_from_data", message))
    saturated = np.abs(field) >= FULL * limit
    field[saturated] = np.nan
    if saturated.any():
        message = f"{100 * saturated.mean():.2g} % of the readings saturated"
        warnings.append(SolverWarning("saturated", message))
    warnings += _silenced(samples, field)
    return field, [each.about(samples.device) for each in warnings]


def _jumps(field: Array) -> NDArray[np.bool_]:
    """(n, N) single readings that those before and after do not lead to."""
    found = np.zeros(field.shape, bool)
    if len(field) < 3:
        return found
    before, now, after = field[:-2], field[1:-1], field[2:]
    off = np.abs(now - (before + after) / 2)
    largest = np.maximum(np.abs(before), np.abs(after))
    with np.errstate(invalid="ignore"):
        found[1:-1] = off > JUMP_T + np.abs(after - before) + JUMP * largest
    return found


def _plateau(field: Array) -> float | None:
    """The end of a range that was not told: the largest reading, where many are as large."""
    size = np.abs(field[~np.isnan(field)])
    if not len(size) or size.max() < JUMP_T:
        return None
    largest = float(size.max())
    return largest if (size > (1 - 1e-9) * largest).sum() >= PLATEAU else None


def _silenced(samples: HallSamples, field: Array) -> list[SolverWarning]:
    """Takes dead sensors out of ``field``, and says which they are."""
    names = samples.sensors.names
    spread = np.array(
        [np.nan if np.isnan(column).all() else np.nanstd(column) for column in field.T]
    )
    if np.isnan(spread).all():
        raise InputError(
            f"no hall sensor of {samples.device} can be used",
            hint="All are dead or saturated: check wiring and range",
        )
    nothing = np.isnan(samples.field_t).all(axis=0)
    warnings = [
        SolverWarning("sensor_silent", f"the {names[k]} sensor gave nothing")
        for k in np.flatnonzero(nothing)
    ]
    for number in np.flatnonzero(spread < DEAD * np.nanmax(spread)).tolist():
        field[:, number] = np.nan
        message = f"the {names[number]} sensor never moved; left out"
        warnings.append(SolverWarning("sensor_constant", message))
    return warnings
