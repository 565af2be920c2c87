"""Exclusion of unusable readings of field sensors from imported recordings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MIN_CONSTANT_ROWS = 10
"""Rows from which on a sensor with constant readings is dead: any other has noise."""

UnusableReadings = tuple[NDArray[np.bool_], str]
"""Mask (n, N, axes) of readings, and the reason as a phrase that follows "has"."""


def find_absent_readings(field_t: NDArray[np.float64]) -> list[UnusableReadings]:
    """Find the readings (n, N, axes) that are not a number or come from a dead sensor."""
    is_dead = np.zeros(field_t.shape, bool)
    if len(field_t) >= MIN_CONSTANT_ROWS:
        is_dead[:] = (field_t == field_t[0]).all(axis=(0, 2))[:, None]
    return [
        (np.isnan(field_t), "no number"),
        (is_dead, "a constant value (dead sensor)"),
    ]


def exclude_readings(
    field_t: NDArray[np.float64],
    unusable: Iterable[UnusableReadings],
    file: Path,
    names: Sequence[str],
    lines: Sequence[int],
) -> tuple[int, list[str]]:
    """Replace unusable readings by ``nan``.

    Parameters
    ----------
    field_t : (n, N, axes) ndarray
        Changed in place.
    unusable : iterable of UnusableReadings
    file : path
        For the warnings, like ``names`` of the N sensors and ``lines`` of the n rows in it.

    Returns
    -------
    (int, list of str)
        The number of excluded readings, and a warning a sensor and reason.
    """
    warnings = []
    excluded = np.zeros(field_t.shape, bool)
    for mask, reason in unusable:
        excluded |= mask
        for sensor in np.flatnonzero(mask.any(axis=(0, 2))).tolist():
            rows = np.flatnonzero(mask[:, sensor].any(axis=1))
            warnings.append(
                f"{file}:{lines[rows[0]]}: {names[sensor]} has {reason} in {len(rows)} "
                f"row{'s' * (len(rows) > 1)}; excluded"
            )
    field_t[excluded] = np.nan
    return int(np.count_nonzero(excluded)), warnings
