"""Checks of values that several artifacts share (:class:`.toml.Table` checks types)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.formats.artifacts.toml import Table

LARGEST_REMANENCE_T = 2.0
"""No magnet has more: what is above is in another unit."""


def above(table: Table, key: str, default: float | None = None, *, shift: int = 0) -> float:
    """A number above 0, as of :meth:`.toml.Table.number`; required without ``default``."""
    value: float = (
        table.number(key, shift=shift)
        if default is None
        else table.number(key, default, shift=shift)
    )
    if value <= 0:
        raise table.error(key, "expected a number above 0")
    return value


def check_remanence(table: Table, remanence_t: float) -> None:
    """Refuse a ``remanence_t`` that no magnet has."""
    if remanence_t > LARGEST_REMANENCE_T:
        raise table.error(
            "remanence_t",
            f"expected tesla, at most {LARGEST_REMANENCE_T:g}",
            "10,000 gauss are 1 tesla; N52 has 1.45",
        )


def twin(position: NDArray[np.float64]) -> int | None:
    """The first of the rows (n, d) that stands there twice, None where there is none."""
    _, first, count = np.unique(position, axis=0, return_index=True, return_counts=True)
    return int(first[count > 1][0]) if (count > 1).any() else None
