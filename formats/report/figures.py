"""What all figures of a report share: thinning, safe words, axes."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.plots.ground import COLORS
from locatk.formats.plots.units import thousands

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

FIRST = 100
"""Rank of devices in a legend: before all that they stand on (plotly's is 1000)."""

MOST_POINTS = 3000
"""So many poses a figure draws, at most, of all devices together."""


def label(words: object) -> str:
    """Text that plotly shows as it is: names of devices may look like HTML."""
    return html.escape(str(words), quote=False)


def colours(devices: list[str]) -> dict[str, str]:
    """The colour of each device, the same in all figures."""
    return {name: COLORS[k % len(COLORS)] for k, name in enumerate(devices)}


def faint(colour: str, share: float) -> str:
    """``"#rrggbb"`` that lets through what is beneath."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{share:g})"


def thin(n: int, most: int, peaks: Array | None = None) -> Rows:
    """Which of ``n`` points are drawn, at most ``most``, ascending.

    Evenly, and where ``peaks`` (n,) are given, half of them those with the greatest value
    around, so that nothing that stands out is lost.
    """
    if n <= most:
        return np.arange(n)
    if peaks is None:
        return np.unique(np.linspace(0, n - 1, most).round().astype(np.int64))
    buckets = max(1, (most - 1) // 2)
    edges = np.linspace(0, n, buckets + 1).astype(np.int64)
    bucket = np.searchsorted(edges, np.arange(n), side="right")
    order = np.lexsort((np.nan_to_num(peaks, nan=-np.inf), bucket))
    greatest = order[np.flatnonzero(np.diff(bucket[order], append=bucket.max() + 1))]
    return np.unique(np.concatenate([edges[:-1], greatest, [n - 1]]))


def share_of_points(counts: list[int], most: int = MOST_POINTS) -> list[int]:
    """How many points each device may draw: all, or in proportion, and at least 20."""
    total = sum(counts)
    if total <= most:
        return counts
    return [max(20, most * count // total) for count in counts]


def drawn(shown: int, total: int) -> str:
    """A sentence that says that not all is drawn, where that is so."""
    if shown >= total:
        return ""
    return f"Drawn are {thousands(shown)} of {thousands(total)} poses, the outliers among them."


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis with a title."""
    return {"title": {"text": title}, **more}


def sentences(*parts: str) -> str:
    """Those that say something, one after the other."""
    return " ".join(part for part in parts if part)
