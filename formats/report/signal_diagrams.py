"""Diagrams of the signals of sensors with detections: a whole recording, and details of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.report.diagram_grid import LINES_THINNED, REFUSED, USED, DiagramGrid
from locatk.formats.report.panels import Panel
from locatk.formats.report.thinning import MAX_MARKS, SIGNAL_COLUMNS, envelope, thin

Array = NDArray[np.float64]

MAX_EVENT_LABELS = 30
"""Number of detections up to which the name of each is written; others appear on hovering."""

MIN_LABELLED_EVENTS, LABELLED_WIDTH_PX = 5, 640
"""Number of written names from which a figure has at least this width; narrow windows scroll."""

DETAIL_WIDTH_PX = 260
"""Least width of one of several diagrams next to each other; narrow windows scroll."""

DETAIL_HEIGHT_PX, COMPONENT_HEIGHT_PX = 230, 157
"""Height of a diagram of details: of signals with one component, and of one of several."""


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
    certainty : float
        Larger if the detection is more certain; ``nan`` if it is unknown.
    detail_s : (float, float)
        Interval of time that is drawn in detail.
    """

    start_s: float
    stop_s: float
    label: str
    description: tuple[str, ...]
    refused: str
    certainty: float
    detail_s: tuple[float, float]

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


def add_signals(
    grid: DiagramGrid, row: int, signals: Signals, component: int = 0, column: int = 1, **trace: Any
) -> None:
    """Add one component of all sensors as lines through its extremes."""
    if len(signals.time_s) > 2 * SIGNAL_COLUMNS:
        grid.thinning_note = LINES_THINNED
    for sensor, (name, color) in enumerate(zip(signals.names, signals.colors, strict=True)):
        x, y = envelope(signals.time_s, signals.value[:, sensor, component])
        look = {"mode": "lines", "line": {"color": color, "width": 1}, "name": name}
        look |= {"legendgroup": name, "hovertemplate": signals.hover}
        grid.add(row, x, y, column=column, **look, **trace)


# ---- a whole recording


def add_recording(
    grid: DiagramGrid, signals: Signals, events: Sequence[Event], names: tuple[str, str]
) -> None:
    """Add signals in the last row, their detections in the first, and limit the time axes.

    ``names`` are those of used and of refused detections in the legend.
    """
    add_signals(grid, grid.rows, signals)
    is_labelled = len(events) <= MAX_EVENT_LABELS
    for name, is_refused in zip(names, (False, True), strict=True):
        selected = [event for event in events if bool(event.refused) == is_refused]
        if selected:
            _add_events(grid, selected, name, is_labelled, len(events) > 10 * MAX_EVENT_LABELS)
    grid.figure.update_yaxes(range=[0, 1.6], visible=False, fixedrange=True, row=1, col=1)
    grid.figure.update_xaxes(showline=False, row=1, col=1)
    if is_labelled and len(events) >= MIN_LABELLED_EVENTS:
        grid.figure.update_layout(width=LABELLED_WIDTH_PX)
    if is_labelled:
        grid.figure.update_layout(shapes=[_shading(event, grid.rows) for event in events])
    grid.figure.update_xaxes(range=[float(signals.time_s[0]), float(signals.time_s[-1])])


def _add_events(
    grid: DiagramGrid, events: Sequence[Event], name: str, is_labelled: bool, is_crowded: bool
) -> None:
    """Mark used or refused detections in row 1 by their durations and centres."""
    drawn = [events[k] for k in thin(len(events), MAX_MARKS)]
    is_refused = bool(events[0].refused)
    color = REFUSED if is_refused else USED
    grid.add(
        1,
        [time for event in drawn for time in (event.start_s, event.stop_s, None)],
        [0.5, 0.5, None] * len(drawn),
        mode="lines",
        line={"color": color, "width": 3 if is_crowded else 9},
        hoverinfo="skip",
        showlegend=False,
    )
    symbol = "x" if is_refused else "circle"
    grid.add(
        1,
        [event.centre_s for event in drawn],
        [0.5] * len(drawn),
        mode="markers+text" if is_labelled else "markers",
        text=[event.label for event in drawn],
        textposition="top center",
        textfont={"size": 10},
        cliponaxis=False,
        customdata=["<br>".join(event.description) for event in drawn],
        hovertemplate="%{customdata}<extra></extra>",
        marker={"color": color, "size": 4 if is_crowded else 9, "symbol": symbol},
        name=f"{name} ({len(events)})",
        legendgroup=name,
    )


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
    device: str,
    noun: str,
    note: str,
    signals: Signals,
    events: Sequence[Event],
    *,
    limit: int,
    mark_time: bool = False,
    **layout: Any,
) -> list[Panel]:
    """Return a panel of the signals around some events, none if no samples of events were read.

    Parameters
    ----------
    device : str
    noun : str
        Name of the events, in the plural.
    note : str
    signals : Signals
        Each component is drawn in a row of its own.
    events : sequence of Event
        Their descriptions become the titles of their diagrams.
    limit : int
        Number of events that are drawn, in up to three columns.
    mark_time : bool
        Draw a dotted line at the centre of each event.
    **layout
        Of the figure.
    """
    spans = np.array([(event.start_s, event.stop_s) for event in events]).reshape(-1, 2)
    first, stop = np.searchsorted(signals.time_s, spans.T)
    read = [events[k] for k in np.flatnonzero(stop - first > 1).tolist()]
    refused, certainty = [event.refused for event in read], [event.certainty for event in read]
    chosen = [read[k] for k in select_details(refused, certainty, limit)]
    if not chosen:
        return []
    components = len(signals.components)
    is_stacked = components > 1
    columns = min(3, len(chosen)) if is_stacked else 3
    rows = math.ceil(len(chosen) / columns) * components
    cells = [(k // columns * components + 1, k % columns + 1) for k in range(len(chosen))]
    titles = [""] * (rows * columns)
    for (row, column), event in zip(cells, chosen, strict=True):
        lines = (", ".join(event.description[:2]), ", ".join(event.description[2:]))
        titles[(row - 1) * columns + column - 1] = "<br>".join(lines)
    grid = DiagramGrid(
        rows,
        columns,
        shared_xaxes="columns" if is_stacked else False,
        shared_yaxes="rows",
        horizontal_spacing=0.03,
        vertical_spacing=0.04 if is_stacked else 0.3 / rows,
        subplot_titles=titles,
    )
    for (row, column), event in zip(cells, chosen, strict=True):
        part = signals.between(*event.detail_s)
        for component, component_title in enumerate(signals.components):
            in_legend = event is chosen[0] and component == 0
            at_row = row + component
            add_signals(grid, at_row, part, component, column, showlegend=in_legend)
            grid.figure.update_yaxes(title=component_title, row=at_row, col=1)
        if mark_time:
            color = REFUSED if event.refused else USED
            grid.add_vertical_line(event.centre_s, row, column, color, "dot")
    for row, column in cells[-columns:]:
        grid.figure.update_xaxes(title="time [s]", row=row + components - 1, col=column)
    grid.figure.update_annotations(font_size=11)
    figure = grid.finish(
        90 + (COMPONENT_HEIGHT_PX if is_stacked else DETAIL_HEIGHT_PX) * rows,
        column_titles=(),
        margin_t=60,
        width=DETAIL_WIDTH_PX * columns if columns > 1 else None,
        **layout,
    )
    title = f"{noun.capitalize()} of {device} in detail"
    return [Panel(title, f"{selection_note(len(chosen), len(read), noun)} {note}", figure)]
