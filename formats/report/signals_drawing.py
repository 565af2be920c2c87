"""How signals are drawn: thinned so that peaks survive, detections above them on one strip."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.plots.ground import COLORS

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

    from locatk.core.solution import Solution

Array = NDArray[np.float64]

USED, REFUSED = COLORS[0], COLORS[1]

OTHERS = tuple(color for color in COLORS if color not in (USED, REFUSED))
"""For what is no detection."""

COLUMNS = 1000
"""A signal is drawn as its least and largest value in each of so many columns."""

MOST_MARKS = 2000
"""Marks of one kind in a figure: each is an element of the page."""

COLUMN_PX = 260
"""Least width of one of several diagrams side by side: a narrow window scrolls them."""

MOST_LABELS = 30
"""Detections up to which each has its name written above it; hovering tells the others'."""

FEW_LABELS, LABELS_PX = 4, 640
"""From more on names need so many pixels: a narrow window scrolls them."""

GAP = 10.0
"""A line is broken where samples are missing for so many times their usual interval."""


def envelope(time_s: Array, value: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """A signal (n,) by the extremes of :data:`COLUMNS` equally long runs of samples, in their
    order; as it is where it is short. ``nan`` stands where nothing is known, and where samples
    are missing."""
    n = len(time_s)
    if n > 2 * COLUMNS:
        run = math.ceil(n / COLUMNS)
        padded = np.full(math.ceil(n / run) * run, np.nan)
        padded[:n] = value
        runs = padded.reshape(-1, run)
        start = np.arange(len(runs)) * run
        low = np.where(np.isnan(runs), np.inf, runs).argmin(axis=1) + start
        high = np.where(np.isnan(runs), -np.inf, runs).argmax(axis=1) + start
        kept = np.sort(np.column_stack([low, high]), axis=1).ravel()
        limit = GAP * max(float(np.median(np.diff(time_s))), (time_s[-1] - time_s[0]) / COLUMNS / 5)
        time_s, value = time_s[kept], np.asarray(value)[kept]
    elif n > 2:
        limit = GAP * float(np.median(np.diff(time_s)))
    else:
        return time_s, np.asarray(value)
    gaps = np.flatnonzero(np.diff(time_s) > limit) + 1
    return np.insert(time_s, gaps, time_s[gaps]), np.insert(value, gaps, np.nan)


def one_a_pixel(time_s: Array, value: Array) -> NDArray[np.intp]:
    """Indices of marks of which none hides another, :data:`MOST_MARKS` at most."""
    n = len(time_s)
    if n <= MOST_MARKS:
        return np.arange(n)
    columns, rows = COLUMNS, 200
    while True:
        cell = _bin(time_s, columns) * rows + _bin(value, rows)
        _, kept = np.unique(cell, return_index=True)
        if len(kept) <= MOST_MARKS or columns * rows < MOST_MARKS:
            return np.sort(kept)[:MOST_MARKS]
        columns, rows = columns * 3 // 4, max(rows * 3 // 4, 20)


def _bin(value: Array, bins: int) -> NDArray[np.int64]:
    low, high = float(np.min(value)), float(np.max(value))
    return np.minimum((value - low) / ((high - low) or 1.0) * bins, bins - 1).astype(np.int64)


def short(value: NDArray[Any]) -> NDArray[np.float32]:
    """As a page holds numbers: half as long as they are computed."""
    return np.asarray(value, np.float32)


def scatter(
    x: Any, y: Any, row: int, column: int = 1, columns: int = 1, **more: Any
) -> dict[str, Any]:
    """A trace for :meth:`Figure.add_traces`, which takes half the time of one at a time.

    Values of an array are halved as :func:`short` does; ``row`` and ``column`` are those of a
    figure of so many ``columns``.
    """
    number_of = (row - 1) * columns + column
    axis = "" if number_of == 1 else str(number_of)
    x, y = (short(each) if isinstance(each, np.ndarray) else each for each in (x, y))
    return {"type": "scatter", "x": x, "y": y, "xaxis": f"x{axis}", "yaxis": f"y{axis}", **more}


# ---- detections


@dataclass(frozen=True)
class Event:
    """Something that was seen from ``start_s`` to ``stop_s``; ``refused`` is "" or why."""

    start_s: float
    stop_s: float
    label: str
    hover: str
    refused: str = ""


def number(value: Any) -> float:
    """A number of a detection, ``nan`` where it is not known."""
    return math.nan if value is None else float(value)


def strip(
    figure: Figure,
    events: Sequence[Event],
    names: tuple[str, str],
    *,
    row: int,
    rows: Iterable[int],
) -> None:
    """Draw what was seen as bars on a strip, what was refused in another colour, and shade
    it over the signals in ``rows``; ``names`` are those of the two kinds."""
    many = len(events) > 10 * MOST_LABELS
    for name, color, refused in zip(names, (USED, REFUSED), (False, True), strict=True):
        mine = [each for each in events if bool(each.refused) == refused]
        if not mine:
            continue
        drawn = [mine[k] for k in np.unique(np.linspace(0, len(mine) - 1, MOST_MARKS).astype(int))]
        x = [at for each in drawn for at in (each.start_s, each.stop_s, None)]
        y = [at for _ in drawn for at in (0.5, 0.5, None)]
        bars = scatter(
            x, y, row, mode="lines", line={"color": color, "width": 3 if many else 9},
            hoverinfo="skip", showlegend=False,
        )  # fmt: skip
        marks = scatter(
            [(each.start_s + each.stop_s) / 2 for each in drawn],
            [0.5] * len(drawn),
            row,
            mode="markers+text" if len(events) <= MOST_LABELS else "markers",
            text=[each.label for each in drawn],
            textposition="top center",
            textfont={"size": 10, "color": color},
            cliponaxis=False,
            customdata=[each.hover for each in drawn],
            hovertemplate="%{customdata}<extra></extra>",
            marker={
                "color": color,
                "size": 4 if many else 9,
                "symbol": "x" if refused else "circle",
            },
            name=f"{name} ({len(mine)})",
            legendgroup=name,
        )
        figure.add_traces([bars, marks])
    figure.update_yaxes(range=[0, 1.6], visible=False, fixedrange=True, row=row, col=1)
    if FEW_LABELS < len(events) <= MOST_LABELS:
        figure.update_layout(width=LABELS_PX)
    if len(events) <= MOST_LABELS:
        spans = [
            {
                "type": "rect",
                **{"xref": f"x{below}", "x0": each.start_s, "x1": each.stop_s},
                **{"yref": f"y{below} domain", "y0": 0, "y1": 1},
                "fillcolor": REFUSED if each.refused else USED,
                "opacity": 0.1,
                "line": {"width": 0},
                "layer": "below",
            }
            for each in events
            for below in rows  # from 2 on: plotly calls the axes of row 1 x and y
        ]
        figure.update_layout(shapes=spans)


def telling(refused: Sequence[str], sure: Sequence[float], most: int) -> list[int]:
    """Which detections are worth a closer look, in their order: one of each reason of refusal,
    then the least sure of those that were used, then the surest."""
    chosen = [k for k, why in enumerate(refused) if why and why not in refused[:k]]
    used = sorted(
        (k for k, why in enumerate(refused) if not why),
        key=lambda k: (math.isnan(sure[k]), sure[k]),
    )
    rest = used[:1] + used[:0:-1]
    return sorted((chosen[: max(1, most - 2)] + rest)[:most])


# ---- pages


def style(figure: Figure, height: int, **more: Any) -> None:
    """The same look for every figure of signals; the page knows letters and colours."""
    figure.update_layout(
        height=height,
        margin={"l": 64, "r": 12, "t": 24, "b": 44},
        legend={
            "orientation": "v", "x": 1.01, "y": 1, "xanchor": "left", "yanchor": "top",
            "font": {"size": 12},
        },
    )  # fmt: skip
    figure.update_layout(**more)
    for axes in (figure.update_xaxes, figure.update_yaxes):
        axes(exponentformat="none")


def seconds(time_ns: NDArray[Any], start_ns: int) -> Array:
    """Times of samples on the axis, which begins where all of a report do."""
    return np.asarray((time_ns - start_ns) * 1e-9, np.float64)


def strangers(solution: Solution, devices: Iterable[str]) -> list[str]:
    """A sentence on devices that were solved and are not in the recording."""
    # A device has a trajectory for each photodiode, or for each sheet that it saw.
    known = tuple(devices)
    parts = tuple(f"{name}{mark}" for name in known for mark in "/-")
    missing = [
        each.device
        for each in solution.trajectories
        if each.device not in known and not each.device.startswith(parts)
    ]
    if not missing:
        return []
    return [f"The recording has no signals of {listed(missing)}, of which the solution has poses."]


def choice(shown: int, total: int, what: str, which: str) -> str:
    """A sentence that says which of all are drawn."""
    if shown == total:
        return f"All {total} {what} are drawn." if total > 1 else "There was one."
    return f"Drawn are {shown} of {total} {what}: {which}."


def listed(names: Sequence[str], most: int = 5) -> str:
    """Names in a sentence."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
