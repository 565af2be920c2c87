"""Diagrams of values over time, as lines or marks of each device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure
from plotly.subplots import make_subplots

from locatk.formats.plots.series import (
    MAX_EXPECTED_DEVICES,
    Series,
    axis_limit,
    interrupt_at_gaps,
    peaks_beyond,
)
from locatk.formats.plots.shapes import is_in_legend
from locatk.formats.plots.units import abbreviate, format_count
from locatk.formats.report.panels import Panel, escape, join_sentences
from locatk.formats.report.style import DEVICE_LEGEND_RANK, faded
from locatk.formats.report.theme import INK, TRANSPARENT
from locatk.formats.report.thinning import MAX_POSES, Indices, allot_points, thin, thinning_note

Array = NDArray[np.float64]

MAX_BAND_POINTS = 600
"""Number of points of the outline of an expected error."""

MAX_MARKED_VALUES = 800
"""Number of values up to which each is marked by a point on its line."""

TRIANGLE_INSET = 0.04
"""Distance of triangles from the limit of a scale, as a fraction of the height of a diagram."""

ROW_HEIGHT_PX = 165
"""Height of one of several diagrams above each other."""


@dataclass(frozen=True)
class ValueRow:
    """One of several diagrams that share the time axis, in the unit of its title.

    Attributes
    ----------
    title : str
    values : dict of str to Series
        By device.
    expected : dict of str to Series
        Bounds of 95 % of the values, by device; they are symmetric if the values are signed.
    """

    title: str
    values: dict[str, Series]
    expected: dict[str, Series]

    def __post_init__(self) -> None:
        """Remove devices without values, and expected values that are unknown or too many."""
        values = {name: s for name, s in self.values.items() if len(s.value)}
        known = {name: s for name, s in self.expected.items() if np.isfinite(s.value).any()}
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "expected", known if len(known) <= MAX_EXPECTED_DEVICES else {})

    def magnitudes(self) -> Array:
        """Return the finite absolute values of all devices."""
        values = np.concatenate([np.zeros(0), *(s.value for s in self.values.values())])
        return np.abs(values[np.isfinite(values)])

    def limit(self, reference: float | None) -> float:
        """Return the upper limit of the value axis, which includes a reference value."""
        bounds = [s.value for s in self.expected.values()]
        limit = axis_limit(self.magnitudes(), np.concatenate(bounds) if bounds else None)
        return limit if reference is None else max(limit, 1.15 * reference)


def value_panel(
    title: str,
    explanation: str,
    rows: Sequence[ValueRow],
    colors: Mapping[str, str],
    start_ns: int,
    *,
    signed: bool = False,
    as_marks: bool = False,
    reference: float | None = None,
) -> Panel:
    """Draw values against time, with notes on expected values, outliers and thinning.

    Values beyond the scale are marked by triangles at its limit, expected values by open ones.

    Parameters
    ----------
    title, explanation : str
        The explanation is the beginning of the note.
    rows : sequence of ValueRow
    colors : mapping of str to str
        By device.
    start_ns : int
        Origin of the time axis.
    signed : bool
        Values may be negative.
    as_marks : bool
        Draw marks instead of lines, and the diagram higher; one row only.
    reference : float, optional
        Value to be included and marked by a line.
    """
    figure: Figure = make_subplots(len(rows), 1, shared_xaxes=True, vertical_spacing=0.05)
    beyond = total = shown = beyond_expected = total_expected = 0
    for number, row in enumerate(rows, start=1):
        limit, magnitude = row.limit(reference), row.magnitudes()
        beyond += int(np.count_nonzero(magnitude > limit))
        total += len(magnitude)
        for s in row.expected.values():
            beyond_expected += int(np.count_nonzero(s.value > limit))
            total_expected += int(np.count_nonzero(np.isfinite(s.value)))
        counts = allot_points([len(s.value) for s in row.values.values()], MAX_POSES // len(rows))
        kept = {
            name: thin(len(s.value), count, np.abs(s.value))
            for (name, s), count in zip(row.values.items(), counts, strict=True)
        }
        shown += sum(map(len, kept.values()))
        mode = "markers" if as_marks else _line_mode(len(kept), sum(counts))
        for k, (name, s) in enumerate(row.values.items()):
            traces, color = [], colors[name]
            if name in row.expected:
                is_first, is_only = k == 0 and number == 1, len(row.expected) == 1
                bound = row.expected[name]
                traces = _expected_traces(bound, start_ns, color, signed, is_only, is_first)
            look = {
                "name": escape(abbreviate(name)),
                "legendgroup": name,
                "legendrank": DEVICE_LEGEND_RANK,
                "showlegend": number == 1 and len(kept) > 1 and is_in_legend(k, len(kept)),
            }
            traces.append({**look, **_value_trace(s, kept[name], start_ns, color, mode)})
            figure.add_traces([{"type": "scatter", **t} for t in traces], number, 1)
        triangles = _excess_traces(row, kept, limit, start_ns, colors, signed)
        _add_overlay(figure, number, len(rows), triangles)
        limits = [-limit if signed else 0, limit]
        figure.update_yaxes(title={"text": row.title}, range=limits, row=number, col=1)
    if reference is not None:
        figure.add_hline(y=reference, line={"color": INK, "width": 1.2, "dash": "dash"})
    figure.update_xaxes(title={"text": "time [s]"}, row=len(rows), col=1)
    height = 360 if as_marks else ROW_HEIGHT_PX * len(rows) + 60
    figure.update_layout(height=height)
    scale = "this scale" if len(rows) == 1 else "these scales"
    note = join_sentences(
        explanation,
        _expected_note(max(len(row.expected) for row in rows), signed),
        f"{format_count(beyond)} of {format_count(total, 'values')} lie beyond {scale} "
        "(triangles): double-click to see them."
        if beyond
        else "",
        f"{format_count(beyond_expected)} of {format_count(total_expected, 'bounds')} lie beyond "
        f"{scale} (open triangles): double-click to see them."
        if beyond_expected
        else "",
        thinning_note(shown, total, "values"),
    )
    return Panel(title, note, figure)


def _line_mode(devices: int, points: int) -> str:
    if devices > MAX_EXPECTED_DEVICES:
        return "markers"  # Many lines would cover each other.
    return "lines+markers" if points <= MAX_MARKED_VALUES else "lines"


def _expected_note(devices: int, signed: bool) -> str:
    if not devices:
        return ""
    lines = "between the thin lines" if signed else "below the thin lines"
    region = "in the shaded area" if devices == 1 else lines
    return f"By the solver's covariance, 95 % of the errors should be {region}."


def _value_trace(s: Series, kept: Indices, start_ns: int, color: str, mode: str) -> dict[str, Any]:
    """Return the line or the marks of a device."""
    rows = np.column_stack([(s.time_ns[kept] - start_ns) * 1e-9, s.value[kept]])
    if "lines" in mode:
        rows = interrupt_at_gaps(rows, s.time_ns, kept)
    x, y = rows.T
    return {
        "x": x,
        "y": y,
        "mode": mode,
        "line": {"color": color, "width": 1.1},
        "marker": {"color": color, "size": 4 if mode == "markers" else 3.5},
        "hovertemplate": "%{x:.3f} s<br>%{y:.4g}",
    }


def _excess_traces(
    row: ValueRow,
    kept: Mapping[str, Indices],
    limit: float,
    start_ns: int,
    colors: Mapping[str, str],
    signed: bool,
) -> list[dict[str, Any]]:
    """Return triangles for the values and the bounds beyond the limit of a row."""
    traces = []
    for name, s in row.values.items():
        at = kept[name][np.abs(s.value[kept[name]]) > limit]
        look = {"name": escape(abbreviate(name)), "legendgroup": name}
        filled = {"color": colors[name], "size": 9}
        traces.append({**look, **_triangles(Series(s.time_ns[at], s.value[at]), start_ns, filled)})
    for name, bound in row.expected.items():
        at = peaks_beyond(bound, limit)
        upper = Series(bound.time_ns[at], bound.value[at])
        look = {"name": "95 % expected", "legendgroup": "expected"}
        hollow = {"color": TRANSPARENT, "size": 8, "line": {"color": colors[name], "width": 1.2}}
        for sided in (upper, upper.scaled(-1)) if signed else (upper,):
            traces.append({**look, **_triangles(sided, start_ns, hollow)})
    return [trace for trace in traces if len(trace["x"])]


def _triangles(s: Series, start_ns: int, marker: dict[str, Any]) -> dict[str, Any]:
    """Return triangles at the edges of a diagram that point to values beyond it.

    Their ordinates are fractions of its height.
    """
    is_upper = s.value > 0
    symbols = np.where(is_upper, "triangle-up", "triangle-down").tolist()
    return {
        "x": (s.time_ns - start_ns) * 1e-9,
        "y": np.where(is_upper, 1 - TRIANGLE_INSET, TRIANGLE_INSET),
        "customdata": s.value,
        "mode": "markers",
        "marker": {**marker, "symbol": symbols},
        "hovertemplate": "%{x:.3f} s<br>%{customdata:.4g}",
        "showlegend": False,
    }


def _add_overlay(figure: Figure, number: int, rows: int, traces: Sequence[dict[str, Any]]) -> None:
    """Add traces to a row on an axis from 0 to 1 that lies over its value axis."""
    if not traces:
        return
    axis, row = f"{rows + number}", "" if number == 1 else f"{number}"
    overlay = {"overlaying": f"y{row}", "anchor": f"x{row}", "range": [0, 1]}
    figure.update_layout({f"yaxis{axis}": {**overlay, "fixedrange": True, "visible": False}})
    axes = {"xaxis": f"x{row}", "yaxis": f"y{axis}"}
    figure.add_traces([{"type": "scatter", **axes, **trace} for trace in traces])


def _expected_traces(
    s: Series, start_ns: int, color: str, signed: bool, is_shaded: bool, is_first: bool
) -> list[dict[str, Any]]:
    """Return the outline of expected values, shaded for a single device."""
    kept = thin(len(s.value), MAX_BAND_POINTS, s.value)
    rows = np.column_stack([(s.time_ns[kept] - start_ns) * 1e-9, s.value[kept]])
    x, y = interrupt_at_gaps(rows, s.time_ns, kept).T
    look: dict[str, Any] = {
        "x": x,
        "mode": "lines",
        "name": "95 % expected",
        "legendgroup": "expected",
        "line": {"color": color, "width": 0.8},
        "hoverinfo": "skip",
    }
    fill = {"fill": "tonexty" if signed else "tozeroy", "fillcolor": faded(color, 0.13)}
    outline = {**look, "y": y, "showlegend": is_first, **(fill if is_shaded else {})}
    if not signed:
        return [outline]
    lower = {**look, "y": -y, "showlegend": False}
    return [lower, outline]
