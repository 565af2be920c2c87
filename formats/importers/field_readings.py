"""Readings of field sensors in recordings of others: what of them cannot be used."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SILENT_ROWS = 10
"""A sensor that says the same in all rows, and at least so many, is dead: others have noise,
or see something."""

DEAD = "the same in all rows, as of a sensor that is dead"

Bad = tuple[NDArray[np.bool_], str]
"""Which readings cannot be used, and why, in words that follow "has"."""


def no_reading(field_t: NDArray[np.float64]) -> list[Bad]:
    """What is no reading of a field (n, N, axes): no number, or of a sensor that is dead."""
    dead = np.zeros(field_t.shape, bool)
    if len(field_t) >= SILENT_ROWS:
        dead[:] = (field_t == field_t[0]).all(axis=(0, 2))[:, None]
    return [(np.isnan(field_t), "no number"), (dead, DEAD)]


def leave_out(
    field_t: NDArray[np.float64],
    reasons: Iterable[Bad],
    file: Path,
    names: Sequence[str],
    lines: Sequence[int],
) -> tuple[int, list[str]]:
    """Make ``nan`` of what cannot be used; how much it is, and a warning a sensor.

    Parameters
    ----------
    field_t : (n, N, axes) ndarray
        Changed.
    reasons : iterable of (bad, words)
    file : path
    names : sequence of str
        Of the sensors.
    lines : sequence of int
        Of the rows in the file.
    """
    warnings = []
    every = np.zeros(field_t.shape, bool)
    for bad, words in reasons:
        every |= bad
        for sensor in np.flatnonzero(bad.any(axis=(0, 2))).tolist():
            mine = bad[:, sensor].any(axis=1)
            rows, line = int(np.count_nonzero(mine)), lines[int(np.argmax(mine))]
            warnings.append(f"{file}:{line}: {names[sensor]} has {words} in {rows} rows: left out")
    field_t[every] = np.nan
    return int(np.count_nonzero(every)), warnings
