"""Diagrams of a report: grids of lines, marks and histograms over shared time axes.

Long recordings are thinned so that the page stays small and extremes remain visible.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
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
)
from locatk.formats.plots.shapes import COLORS, is_in_legend
from locatk.formats.plots.units import abbreviate, format_count
from locatk.formats.report.panels import Panel, escape, join_sentences
from locatk.formats.report.style import INK

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

USED, REFUSED = COLORS[0], COLORS[1]
"""Colors of used and refused detections."""

NEUTRAL_COLORS = tuple(color for color in COLORS if color not in (USED, REFUSED))
"""Colors of sensors and other things that are neither used nor refused."""

DEVICE_LEGEND_RANK = 100
"""Rank of devices in a legend, before everything else (the default of plotly is 1000)."""

MAX_POSES = 3000
"""Number of poses of all devices together that one figure shows."""

MIN_POSES_PER_DEVICE = 20
"""Number of poses that each device shows, however many others there are."""

MAX_BAND_POINTS = 600
"""Number of points of the outline of an expected error."""

MAX_MARKED_VALUES = 800
"""Number of values up to which each is marked by a point on its line."""

SIGNAL_COLUMNS = 1000
"""A signal is drawn as its least and largest value in each of so many columns."""

MAX_MARKS = 2000
"""Number of marks of one kind in a figure; each is an element of the page."""

GAP_INTERVALS = 10.0
"""Factor of the usual interval of samples from which a line is interrupted."""

MAX_EVENT_LABELS = 30
"""Number of detections up to which the name of each is written; others appear on hovering."""

MIN_LABELLED_EVENTS, LABELLED_WIDTH_PX = 5, 640
"""Number of written names from which a figure has at least this width; narrow windows scroll."""

DETAIL_WIDTH_PX = 260
"""Least width of one of several diagrams next to each other; narrow windows scroll."""

ROW_HEIGHT_PX = 165
"""Height of one of several diagrams above each other."""

LINES_THINNED = "Thinned: each column of the picture shows its largest and smallest value."
MARKS_THINNED = "Thinned: of marks that would cover each other one is drawn."


# ---- thinning


def thin(n: int, limit: int, peaks: Array | None = None) -> Indices:
    """Return the ascending indices of at most ``limit`` of ``n`` points.

    They are evenly spaced. If ``peaks`` (n,) are given, half of the points are those with the
    greatest value in their neighbourhood, so that outliers remain.
    """
    if n <= limit:
        return np.arange(n)
    if peaks is None:
        return np.unique(np.linspace(0, n - 1, limit).round().astype(np.int64))
    buckets = max(1, (limit - 1) // 2)
    edges = np.linspace(0, n, buckets + 1).astype(np.int64)
    bucket = np.searchsorted(edges, np.arange(n), side="right")
    order = np.lexsort((np.nan_to_num(peaks, nan=-np.inf), bucket))
    greatest = order[np.flatnonzero(np.diff(bucket[order], append=bucket.max() + 1))]
    return np.unique(np.concatenate([edges[:-1], greatest, [n - 1]]))


def allot_points(counts: Sequence[int], limit: int = MAX_POSES) -> list[int]:
    """Return how many points each device may show: all, or in proportion to its poses."""
    total = sum(counts)
    if total <= limit:
        return list(counts)
    return [max(MIN_POSES_PER_DEVICE, limit * count // total) for count in counts]


def thinning_note(shown: int, total: int, noun: str = "poses") -> str:
    """Return a sentence on how many poses are drawn; empty if all are."""
    if shown >= total:
        return ""
    return f"Drawn are {format_count(shown)} of {format_count(total, noun)}, including outliers."


def envelope(time_s: Array, value: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """Return the extremes of a signal (n,) in each of :data:`SIGNAL_COLUMNS` equal parts.

    A short signal is returned unchanged. ``nan`` is inserted where samples are missing.
    """
    n = len(time_s)
    if n <= 2:
        return time_s, np.asarray(value)
    interval = float(np.median(np.diff(time_s)))
    if n > 2 * SIGNAL_COLUMNS:
        length = math.ceil(n / SIGNAL_COLUMNS)
        padded = np.full(math.ceil(n / length) * length, np.nan)
        padded[:n] = value
        parts = padded.reshape(-1, length)
        start = np.arange(len(parts)) * length
        low = np.where(np.isnan(parts), np.inf, parts).argmin(axis=1) + start
        high = np.where(np.isnan(parts), -np.inf, parts).argmax(axis=1) + start
        kept = np.sort(np.column_stack([low, high]), axis=1).ravel()
        interval = max(interval, (time_s[-1] - time_s[0]) / SIGNAL_COLUMNS / 5)
        time_s, value = time_s[kept], np.asarray(value)[kept]
    gaps = np.flatnonzero(np.diff(time_s) > GAP_INTERVALS * interval) + 1
    return np.insert(time_s, gaps, time_s[gaps]), np.insert(value, gaps, np.nan)


def thin_marks(x: Array, y: Array) -> Indices:
    """Return the indices of at most :data:`MAX_MARKS` marks that do not cover each other."""
    n = len(x)
    if n <= MAX_MARKS:
        return np.arange(n)
    columns, rows = SIGNAL_COLUMNS, 200
    while True:
        cell = _bin_index(x, columns) * rows + _bin_index(y, rows)
        _, kept = np.unique(cell, return_index=True)
        if len(kept) <= MAX_MARKS or columns * rows < MAX_MARKS:
            return np.sort(kept)[:MAX_MARKS]
        columns, rows = columns * 3 // 4, max(rows * 3 // 4, 20)


def _bin_index(value: Array, bins: int) -> Indices:
    low, high = float(np.min(value)), float(np.max(value))
    return np.minimum((value - low) / ((high - low) or 1.0) * bins, bins - 1).astype(np.int64)


def single_precision(value: Any) -> NDArray[np.float32]:
    """Return numbers as a page stores them, in half the size."""
    return np.asarray(value, np.float32)


def faded(color: str, opacity: float) -> str:
    """Return ``"#rrggbb"`` as a translucent color."""
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


# ---- the builder


@dataclass(frozen=True)
class Event:
    """Detection in a recording.

    Attributes
    ----------
    start_s, stop_s : float
        Time of the detection on the time axis.
    label : str
        Text above its mark; may contain HTML.
    description : tuple of str
        Lines that are shown on hovering.
    refused : str
        Reason of refusal; empty if the detection was used.
    """

    start_s: float
    stop_s: float
    label: str
    description: tuple[str, ...]
    refused: str = ""

    @property
    def centre_s(self) -> float:
        """Centre of the detection on the time axis."""
        return (self.start_s + self.stop_s) / 2


@dataclass(frozen=True)
class Signals:
    """Samples of several sensors, each with one or several components.

    Attributes
    ----------
    time_s : (n,) ndarray
        On the time axis, ascending.
    value : (n, sensors, components) ndarray
    names, colors : list of str
        Of the sensors.
    components : tuple of str
        Titles of the value axes.
    hover : str
        Template of plotly for a value.
    """

    time_s: Array
    value: NDArray[Any]
    names: list[str]
    colors: list[str]
    components: tuple[str, ...]
    hover: str

    def between(self, start_s: float, stop_s: float) -> Signals:
        """Return the samples in an interval of time."""
        inside = (self.time_s >= start_s) & (self.time_s <= stop_s)
        return replace(self, time_s=self.time_s[inside], value=self.value[inside])


class Diagrams:
    """Grid of diagrams of signals that becomes one figure.

    Rows and columns count from 1 as in plotly. Traces are collected and added to the figure
    together, which takes half the time of adding them one by one.

    Attributes
    ----------
    figure : plotly Figure
    has_thinned_marks : bool
    """

    def __init__(self, rows: int, columns: int = 1, **layout: Any) -> None:
        self.figure: Figure = make_subplots(rows, columns, **layout)
        self.rows, self.columns = rows, columns
        self.has_thinned_marks = False
        self._traces: list[dict[str, Any]] = []

    def add(self, row: int, x: Any, y: Any, *, column: int = 1, **trace: Any) -> None:
        """Add a trace of plotly, by default a scatter; arrays are stored in single precision."""
        number = (row - 1) * self.columns + column
        axis = "" if number == 1 else str(number)
        x, y = (single_precision(v) if isinstance(v, np.ndarray) else v for v in (x, y))
        axes = {"xaxis": f"x{axis}", "yaxis": f"y{axis}"}
        self._traces.append({"type": "scatter", "x": x, "y": y, **axes, **trace})

    def add_signals(
        self, row: int, signals: Signals, component: int = 0, column: int = 1, **trace: Any
    ) -> None:
        """Add one component of all sensors as lines through its extremes."""
        for sensor, (name, color) in enumerate(zip(signals.names, signals.colors, strict=True)):
            x, y = envelope(signals.time_s, signals.value[:, sensor, component])
            look = {"mode": "lines", "line": {"color": color, "width": 1}, "name": name}
            look["legendgroup"] = name
            self.add(row, x, y, column=column, hovertemplate=signals.hover, **look, **trace)

    def limit_time(self, time_s: Array) -> None:
        """Limit the time axes to the samples (n,) of a recording."""
        self.figure.update_xaxes(range=[float(time_s[0]), float(time_s[-1])])

    def add_steps(
        self, row: int, edges: Array, value: Array, color: str, width_px: float, **trace: Any
    ) -> None:
        """Add one value per interval between ``edges`` (n + 1,) as steps."""
        dash = trace.pop("dash", "solid")
        line = {"color": color, "width": width_px, "shape": "hv", "dash": dash}
        self.add(row, edges, np.append(value, value[-1]), mode="lines", line=line, **trace)

    def add_marks(self, row: int, x: Array, y: Array, **trace: Any) -> None:
        """Add marks (n,), without those that would be covered by others."""
        kept = thin_marks(x, y)
        self.has_thinned_marks |= len(kept) < len(x)
        self.add(row, x[kept], y[kept], mode="markers", **trace)

    def add_histogram(
        self, column: int, edges: Array, groups: Mapping[str, tuple[Array, str]], hover: str
    ) -> None:
        """Add stacked histograms of values (n,) with a color, by name; empty ones are left out.

        They are counted here so that the page need not contain all values.
        """
        for name, (values, color) in groups.items():
            count = np.histogram(values[np.isfinite(values)], edges)[0]
            if count.any():
                self.add(
                    1,
                    (edges[1:] + edges[:-1]) / 2,
                    count.tolist(),
                    column=column,
                    type="bar",
                    width=float(edges[1] - edges[0]),
                    name=name,
                    legendgroup=name,
                    showlegend=column == 1 and len(groups) > 1,
                    marker={"color": color, "line": {"width": 0.7, "color": "#ffffff"}},
                    hovertemplate=hover,
                )

    def add_strip(
        self, events: Sequence[Event], names: tuple[str, str], shaded_rows: Iterable[int]
    ) -> None:
        """Mark detections in row 1 and shade their time in the rows of the signals.

        ``names`` are those of used and of refused detections in the legend.
        """
        is_crowded = len(events) > 10 * MAX_EVENT_LABELS
        is_labelled = len(events) <= MAX_EVENT_LABELS
        for name, color, refused in zip(names, (USED, REFUSED), (False, True), strict=True):
            selected = [event for event in events if bool(event.refused) == refused]
            if not selected:
                continue
            drawn = [selected[k] for k in thin(len(selected), MAX_MARKS)]
            self.add(
                1,
                [time for event in drawn for time in (event.start_s, event.stop_s, None)],
                [0.5, 0.5, None] * len(drawn),
                mode="lines",
                line={"color": color, "width": 3 if is_crowded else 9},
                hoverinfo="skip",
                showlegend=False,
            )
            self.add(
                1,
                [event.centre_s for event in drawn],
                [0.5] * len(drawn),
                mode="markers+text" if is_labelled else "markers",
                text=[event.label for event in drawn],
                textposition="top center",
                textfont={"size": 10, "color": color},
                cliponaxis=False,
                customdata=["<br>".join(event.description) for event in drawn],
                hovertemplate="%{customdata}<extra></extra>",
                marker={
                    "color": color,
                    "size": 4 if is_crowded else 9,
                    "symbol": "x" if refused else "circle",
                },
                name=f"{name} ({len(selected)})",
                legendgroup=name,
            )
        self.figure.update_yaxes(range=[0, 1.6], visible=False, fixedrange=True, row=1, col=1)
        if is_labelled and len(events) >= MIN_LABELLED_EVENTS:
            self.figure.update_layout(width=LABELLED_WIDTH_PX)
        if is_labelled:
            shapes = [_shading(event, row) for event in events for row in shaded_rows]
            self.figure.update_layout(shapes=shapes)

    def add_vertical_line(
        self, x: float, row: int, column: int, color: str, dash: str, **more: Any
    ) -> None:
        """Add a line over the whole height of a diagram."""
        line = {"color": color, "width": 1.5, "dash": dash}
        # The traces are added later: plotly must not take the diagram for an empty one.
        self.figure.add_vline(
            x=x, line=line, row=row, col=column, exclude_empty_subplots=False, **more
        )

    def finish(
        self,
        height_px: int,
        row_titles: Sequence[str] = (),
        *,
        column_titles: Sequence[str] = ("time [s]",),
        **layout: Any,
    ) -> Figure:
        """Return the figure, with titles of its axes from the last row and column upwards."""
        self.figure.add_traces(self._traces)
        first = self.rows - len(row_titles) + 1
        for row, title in enumerate(row_titles, first):
            self.figure.update_yaxes(title=title, row=row, col=1)
        for column, title in enumerate(column_titles, 1):
            self.figure.update_xaxes(title=title, row=self.rows, col=column)
        self.figure.update_layout(
            height=height_px,
            margin={"l": 64, "r": 12, "t": 24, "b": 44},
            legend={
                **{"orientation": "v", "x": 1.01, "y": 1, "xanchor": "left", "yanchor": "top"},
                "font": {"size": 12},
            },
        )
        self.figure.update_layout(**layout)
        self.figure.update_xaxes(exponentformat="none")
        self.figure.update_yaxes(exponentformat="none")
        return self.figure


def _shading(event: Event, row: int) -> dict[str, Any]:
    """Return a shape over the signals in a row from 2 on (plotly calls the first axes x and y)."""
    return {
        "type": "rect",
        **{"xref": f"x{row}", "x0": event.start_s, "x1": event.stop_s},
        **{"yref": f"y{row} domain", "y0": 0, "y1": 1},
        "fillcolor": REFUSED if event.refused else USED,
        "opacity": 0.1,
        "line": {"width": 0},
        "layer": "below",
    }


# ---- details of detections


def select_details(refused: Sequence[str], certainty: Sequence[float], limit: int) -> list[int]:
    """Return the indices of detections to draw in detail, ascending.

    One of each reason of refusal, the least certain of the used ones, then the most certain.
    """
    chosen = [k for k, reason in enumerate(refused) if reason and reason not in refused[:k]]
    used = sorted(
        (k for k, reason in enumerate(refused) if not reason),
        key=lambda k: (math.isnan(certainty[k]), certainty[k]),
    )
    return sorted((chosen[: max(1, limit - 2)] + used[:1] + used[:0:-1])[:limit])


def selection_note(shown: int, total: int, noun: str) -> str:
    """Return a sentence on which detections :func:`select_details` chose."""
    if shown == total:
        return f"All {total} {noun} are drawn." if total > 1 else "There was one."
    return (
        f"Drawn are {shown} of {total} {noun}: one of each reason of refusal, the least certain of "
        "the others, and the most certain."
    )


def detail_panels(
    title: str,
    note: str,
    signals: Signals,
    events: Sequence[Event],
    certainty: Sequence[float],
    margins_s: Sequence[tuple[float, float]],
    *,
    noun: str,
    limit: int,
    row_height_px: int,
    mark_time: bool = False,
    **layout: Any,
) -> list[Panel]:
    """Return a panel of the signals around some events, none if no samples of events were read.

    Parameters
    ----------
    title, note : str
    signals : Signals
        Each component is drawn in a row of its own.
    events : sequence of Event
        Their descriptions become the titles of their diagrams.
    certainty : sequence of float
        Of each event, see :func:`select_details`.
    margins_s : sequence of (float, float)
        Drawn time before and after each event.
    noun : str
        Name of the events, in the plural.
    limit : int
        Number of events that are drawn, in up to three columns.
    row_height_px : int
    mark_time : bool
        Draw a dotted line at the centre of each event.
    **layout
        Of the figure.
    """
    spans = np.array([(event.start_s, event.stop_s) for event in events]).reshape(-1, 2)
    first, stop = np.searchsorted(signals.time_s, spans.T)
    read = np.flatnonzero(stop - first > 1).tolist()
    refused = [events[k].refused for k in read]
    selected = select_details(refused, [certainty[k] for k in read], limit)
    if not selected:
        return []
    chosen = [read[k] for k in selected]
    components = len(signals.components)
    columns = min(3, len(chosen)) if components > 1 else 3
    rows = math.ceil(len(chosen) / columns) * components
    cells = [(k // columns * components + 1, k % columns + 1) for k in range(len(chosen))]
    titles = [""] * (rows * columns)
    for (row, column), k in zip(cells, chosen, strict=True):
        lines = events[k].description
        titles[(row - 1) * columns + column - 1] = (
            ", ".join(lines[:2]) + "<br>" + ", ".join(lines[2:])
        )
    diagrams = Diagrams(
        rows,
        columns,
        shared_xaxes="columns" if components > 1 else False,
        shared_yaxes="rows",
        horizontal_spacing=0.03,
        vertical_spacing=0.04 if components > 1 else 0.3 / rows,
        subplot_titles=titles,
    )
    for (row, column), k in zip(cells, chosen, strict=True):
        event, (before_s, after_s) = events[k], margins_s[k]
        part = signals.between(event.start_s - before_s, event.stop_s + after_s)
        for component, component_title in enumerate(signals.components):
            in_legend = k == chosen[0] and component == 0
            at = row + component
            diagrams.add_signals(at, part, component, column, showlegend=in_legend)
            diagrams.figure.update_yaxes(title=component_title, row=at, col=1)
        if mark_time:
            color = REFUSED if event.refused else USED
            diagrams.add_vertical_line(event.centre_s, row, column, color, "dot")
    for row, column in cells[-columns:]:
        diagrams.figure.update_xaxes(title="time [s]", row=row + components - 1, col=column)
    diagrams.figure.update_annotations(font_size=11)
    figure = diagrams.finish(
        90 + row_height_px * rows,
        column_titles=(),
        margin_t=60,
        width=DETAIL_WIDTH_PX * columns if columns > 1 else None,
        **layout,
    )
    return [Panel(title, f"{selection_note(len(chosen), len(read), noun)} {note}", figure)]


# ---- values over time, by device


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
        values = [np.abs(s.value[np.isfinite(s.value)]) for s in self.values.values()]
        return np.concatenate(values) if values else np.empty(0)

    def limit(self, reference: float | None) -> float:
        """Return the upper limit of the value axis, which includes a reference value."""
        bounds = [s.value for s in self.expected.values()]
        limit = axis_limit(self.magnitudes(), np.concatenate(bounds) if bounds else None)
        return limit if reference is None else max(limit, 1.15 * reference)


def draw_values(
    rows: Sequence[ValueRow],
    colors: Mapping[str, str],
    start_ns: int,
    *,
    signed: bool = False,
    as_marks: bool = False,
    reference: float | None = None,
) -> tuple[Figure, str]:
    """Draw values against time, and describe what the scales omit.

    Parameters
    ----------
    rows : sequence of ValueRow
    colors : mapping of str to str
        By device.
    start_ns : int
        Origin of the time axis.
    signed : bool
        Values may be negative.
    as_marks : bool
        Draw marks instead of lines, and outliers as triangles at the upper limit; one row only.
    reference : float, optional
        Value to be included and marked by a line.

    Returns
    -------
    figure : plotly Figure
    note : str
        Sentences on expected values, outliers and thinning.
    """
    figure: Figure = make_subplots(len(rows), 1, shared_xaxes=True, vertical_spacing=0.05)
    beyond = total = shown = 0
    for number, row in enumerate(rows, start=1):
        limit, magnitude = row.limit(reference), row.magnitudes()
        beyond += int(np.count_nonzero(magnitude > limit))
        total += len(magnitude)
        counts = allot_points([len(s.value) for s in row.values.values()], MAX_POSES // len(rows))
        kept = {
            name: thin(len(s.value), count, np.abs(s.value))
            for (name, s), count in zip(row.values.items(), counts, strict=True)
        }
        shown += sum(map(len, kept.values()))
        mode = "markers" if as_marks else _line_mode(len(kept), sum(counts))
        for k, (name, s) in enumerate(row.values.items()):
            traces = []
            if name in row.expected:
                is_first, is_only = k == 0 and number == 1, len(row.expected) == 1
                bound = row.expected[name]
                traces = _expected_traces(bound, start_ns, colors[name], signed, is_only, is_first)
            look = {
                "name": escape(abbreviate(name)),
                "legendgroup": name,
                "legendrank": DEVICE_LEGEND_RANK,
                "showlegend": number == 1 and len(kept) > 1 and is_in_legend(k, len(kept)),
            }
            for trace in _value_traces(
                s, kept[name], start_ns, colors[name], mode, limit if as_marks else None
            ):
                traces.append({**look, **trace})
            for trace in traces:
                # Triangles are on an overlaid axis, which is not one of a row.
                cell = {} if "yaxis" in trace else {"row": number, "col": 1}
                figure.add_trace({"type": "scatter", **trace}, **cell)
        limits = [-limit if signed else 0, limit]
        figure.update_yaxes(title={"text": row.title}, range=limits, row=number, col=1)
    if reference is not None:
        figure.add_hline(y=reference, line={"color": INK, "width": 1.2, "dash": "dash"})
    figure.update_xaxes(title={"text": "time [s]"}, row=len(rows), col=1)
    height = 360 if as_marks else ROW_HEIGHT_PX * len(rows) + 60
    figure.update_layout(height=height)
    if as_marks:
        overlay = {"overlaying": "y", "range": [0, 1], "fixedrange": True, "visible": False}
        figure.update_layout(yaxis2=overlay)
    note = join_sentences(
        _expected_note(max(len(row.expected) for row in rows), signed),
        f"{format_count(beyond)} of {format_count(total, 'values')} lie beyond "
        + ("this scale (triangles)" if as_marks else "these scales")
        + ": double-click to see them."
        if beyond
        else "",
        thinning_note(shown, total, "values"),
    )
    return figure, note


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


def _value_traces(
    s: Series, kept: Indices, start_ns: int, color: str, mode: str, limit: float | None
) -> list[dict[str, Any]]:
    """Return the trace of a device and, with a ``limit``, triangles there for larger values."""
    rows = np.column_stack([(s.time_ns[kept] - start_ns) * 1e-9, s.value[kept]])
    if limit is None:
        rows = interrupt_at_gaps(rows, s.time_ns, kept)
    x, y = rows.T
    trace = {
        "x": x,
        "y": y,
        "mode": mode,
        "line": {"color": color, "width": 1.1},
        "marker": {"color": color, "size": 3.5 if limit is None else 4, "opacity": 0.8},
        "hovertemplate": "%{x:.3f} s<br>%{y:.4g}",
    }
    if limit is None or not (y > limit).any():
        return [trace]
    is_outlier = y > limit
    triangles = {
        "x": x[is_outlier],
        "y": np.full(np.count_nonzero(is_outlier), 0.975),
        "yaxis": "y2",
        "customdata": y[is_outlier],
        "mode": "markers",
        "marker": {"color": color, "size": 9, "symbol": "triangle-up"},
        "hovertemplate": "%{x:.3f} s<br>%{customdata:.4g}",
        "showlegend": False,
    }
    return [trace, triangles]


def _expected_traces(
    s: Series, start_ns: int, color: str, signed: bool, is_shaded: bool, is_first: bool
) -> list[dict[str, Any]]:
    """Return the outline of expected values, shaded for a single device."""
    kept = thin(len(s.value), MAX_BAND_POINTS)
    rows = np.column_stack([(s.time_ns[kept] - start_ns) * 1e-9, s.value[kept]])
    x, y = interrupt_at_gaps(rows, s.time_ns, kept).T
    look: dict[str, Any] = {
        "x": x,
        "mode": "lines",
        "name": "95 % expected",
        "legendgroup": "expected",
        "line": {"color": faded(color, 0.55), "width": 1.2},
        "hoverinfo": "skip",
    }
    fill = {"fill": "tonexty" if signed else "tozeroy", "fillcolor": faded(color, 0.13)}
    outline = {**look, "y": y, "showlegend": is_first, **(fill if is_shaded else {})}
    if not signed:
        return [outline]
    lower = {**look, "y": -y, "showlegend": False}
    return [lower, outline]
