"""Numbers against time: errors, what the covariance expects of them, and sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Bar, Figure, Scatter
from plotly.subplots import make_subplots

from locatk.formats.plots.ground import IN_LEGEND, broken, short
from locatk.formats.plots.series import MOST_BANDS, Series, usual_top
from locatk.formats.plots.units import Unit, thousands
from locatk.formats.report.figures import (
    FIRST,
    MOST_POINTS,
    Array,
    axis,
    drawn,
    faint,
    label,
    sentences,
    share_of_points,
    thin,
)
from locatk.formats.report.style import INK

FEW = 800
"""Up to so many values of a diagram are marked by points on their line."""

BINS = 50

ROW_PX = 165
"""Height of one of several diagrams above each other."""


@dataclass(frozen=True)
class Row:
    """One of several diagrams that share the time: values of each device, and half the width of
    a band around zero in which they should lie; all in the unit of the title."""

    title: str
    values: dict[str, Series]
    bands: dict[str, Series]


def errors_figure(
    series: dict[str, Series],
    expected: dict[str, Series],
    colors: dict[str, str],
    unit: Unit,
    what: str,
    start_ns: int,
    edges: str = "",
    *,
    reference: float | None = None,
) -> tuple[Figure, str]:
    """Values that are never negative against time since ``start_ns``, wild ones at the upper
    edge; and what must be said of it. ``expected`` are the values below which 95 % should lie;
    ``edges`` says where they are; ``reference`` is a value to be marked, and in view."""
    filled = {name: s for name, s in series.items() if len(s.value)}
    figure = Figure()
    every = np.concatenate([s.value for s in filled.values()]) * unit.per_metre
    counts = share_of_points([len(s.value) for s in filled.values()])
    bands = {name: s for name, s in expected.items() if np.isfinite(s.value).any()}
    edge = _edges(bands)
    top = usual_top(every, None if edge is None else edge * unit.per_metre)
    shaded = len(filled) == 1
    if reference is not None:
        top = max(top, 1.15 * reference)
        figure.add_hline(y=reference, line={"color": INK, "width": 1.2, "dash": "dash"})
    wild = 0
    shown = 0
    for k, ((name, s), most) in enumerate(zip(filled.items(), counts, strict=True)):
        keep = thin(len(s.value), most, s.value)
        shown += len(keep)
        seconds, value = (s.time_ns[keep] - start_ns) * 1e-9, s.value[keep] * unit.per_metre
        look = _look(name, colors[name], k, len(filled))
        if name in bands and len(bands) <= MOST_BANDS:
            figure.add_trace(
                _below(bands[name], start_ns, unit, colors[name], shaded=shaded, first=k == 0)
            )
        figure.add_trace(
            Scatter(
                x=seconds,
                y=value,
                mode="markers",
                marker={"color": colors[name], "size": 4, "opacity": 0.8},
                hovertemplate=f"%{{x:.3f}} s<br>%{{y:.4g}} {label(unit.name)}",
                **look,
            )
        )
        out = value > top
        wild += int(np.count_nonzero(s.value * unit.per_metre > top))
        if out.any():
            figure.add_trace(_beyond(seconds[out], value[out], unit, colors[name], look))
    figure.update_layout(
        height=360,
        xaxis=axis("time [s]"),
        yaxis=axis(f"{what} [{unit.name}]", range=[0, top]),
        # Of the triangles, which stay at the edge whatever is looked at.
        yaxis2={"overlaying": "y", "range": [0, 1], "fixedrange": True, "visible": False},
    )
    note = sentences(
        ("The shade ends" if shaded else "The lines are") + f" {edges}."
        if 0 < len(bands) <= MOST_BANDS
        else "",
        f"{thousands(wild)} of {thousands(len(every))} lie beyond this scale (triangles): "
        "double-click to see them."
        if wild
        else "",
        drawn(shown, len(every)),
    )
    return figure, note


def _edges(bands: dict[str, Series]) -> Array | None:
    """Where all bands end, in their unit; None where there are none, or too many to draw."""
    if not 0 < len(bands) <= MOST_BANDS:
        return None
    return np.concatenate([s.value for s in bands.values()])


def _look(name: str, color: str, k: int, devices: int) -> dict[str, Any]:
    """What all traces of a device share."""
    return {
        "name": label(short(name)),
        "legendgroup": name,
        "legendrank": FIRST,
        "showlegend": devices > 1 and (devices <= IN_LEGEND or k < IN_LEGEND - 1),
    }


def _below(s: Series, start: int, unit: Unit, color: str, *, shaded: bool, first: bool) -> Scatter:
    """The area from zero to a band, or of several devices just its edge."""
    keep = thin(len(s.value), 600)
    x, y = _rows(s, keep, start).T
    return Scatter(
        x=x,
        y=y * unit.per_metre,
        mode="lines",
        name="95 % expected",
        legendgroup="expected",
        showlegend=first,
        line={"color": faint(color, 0.55), "width": 1.2},
        hoverinfo="skip",
        **({"fill": "tozeroy", "fillcolor": faint(color, 0.13)} if shaded else {}),
    )


def _beyond(
    seconds: NDArray[Any], value: Array, unit: Unit, color: str, look: dict[str, Any]
) -> Scatter:
    return Scatter(
        x=seconds,
        y=np.full(len(seconds), 0.975),
        customdata=value,
        yaxis="y2",
        mode="markers",
        marker={"symbol": "triangle-up", "color": color, "size": 9},
        hovertemplate=f"%{{x:.3f}} s<br>%{{customdata:.4g}} {label(unit.name)}",
        **{**look, "showlegend": False},
    )


def histogram_figure(
    series: dict[str, Series],
    colors: dict[str, str],
    unit: Unit,
    what: str,
    lines: dict[str, float],
) -> Figure:
    """How often values occur, those beyond the scale in the last bin; ``lines`` are marked."""
    filled = {name: s.value * unit.per_metre for name, s in series.items() if len(s.value)}
    every = np.concatenate(list(filled.values()))
    top = usual_top(every)
    edges = np.linspace(0, top, BINS + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    figure = Figure()
    parts = filled if len(filled) <= IN_LEGEND else {"all": every}
    most, _ = np.histogram(np.minimum(every, edges[-1]), edges)
    for name, values in parts.items():
        count, _ = np.histogram(np.minimum(values, edges[-1]), edges)
        figure.add_trace(
            Bar(
                x=middles,
                y=count,
                width=float(edges[1]),
                name=label(short(name)),
                showlegend=len(parts) > 1,
                marker={
                    "color": colors.get(name, "#8896a3"),
                    "line": {"width": 0.7, "color": "#ffffff"},
                },
                hovertemplate=f"%{{y}} poses around %{{x:.3g}} {label(unit.name)}",
            )
        )
    for k, (words, value) in enumerate(lines.items()):
        if value * unit.per_metre <= top:
            figure.add_vline(
                x=value * unit.per_metre,
                line={"color": INK, "width": 1.4, "dash": "dash"},
                annotation={
                    "text": words,
                    "yref": "paper",
                    "y": 1.0,
                    "yanchor": "top",
                    "xanchor": "right" if k == 0 else "left",
                    "xshift": -4 if k == 0 else 4,
                    "bgcolor": "rgba(255,255,255,0.8)",
                    "showarrow": False,
                },
            )
    figure.update_layout(
        height=280,
        barmode="stack",
        bargap=0,
        legend={"traceorder": "normal"},
        xaxis=axis(f"{what} [{unit.name}]", range=[0, top]),
        # Room for the names of the lines.
        yaxis=axis("poses", range=[0, 1.3 * float(most.max())]),
    )
    return figure


def rows_figure(
    rows: Sequence[Row], colors: dict[str, str], start_ns: int, *, signed: bool
) -> tuple[Figure, str]:
    """Diagrams above each other that share the time since ``start_ns``; and what must be said of
    them."""
    figure = make_subplots(len(rows), 1, shared_xaxes=True, vertical_spacing=0.05)
    wild = total = shown = 0
    for number, row in enumerate(rows, start=1):
        finite = {n: np.abs(s.value[np.isfinite(s.value)]) for n, s in row.values.items()}
        every = np.concatenate(list(finite.values()))
        bands = row.bands if len(row.bands) <= MOST_BANDS else {}
        top = usual_top(every, _edges(bands))
        wild += int(np.count_nonzero(every > top))
        total += len(every)
        counts = share_of_points(
            [len(s.value) for s in row.values.values()], MOST_POINTS // len(rows)
        )
        mode = "lines+markers" if sum(counts) <= FEW else "lines"
        if len(row.values) > MOST_BANDS:
            mode = "markers"  # many lines are a thicket
        for k, ((name, s), most) in enumerate(zip(row.values.items(), counts, strict=True)):
            keep = thin(len(s.value), most, np.abs(s.value))
            shown += len(keep)
            if name in bands:
                for trace in _band(bands[name], start_ns, colors[name], len(bands) == 1):
                    figure.add_trace(trace, row=number, col=1)
            trace = _line(s, keep, start_ns, colors[name], mode)
            look = _look(name, colors[name], k, len(row.values))
            trace.update(**{**look, "showlegend": look["showlegend"] and number == 1})
            figure.add_trace(trace, row=number, col=1)
        figure.update_yaxes(axis(row.title, range=[-top if signed else 0, top]), row=number, col=1)
    figure.update_xaxes(axis("time [s]"), row=len(rows), col=1)
    figure.update_layout(height=ROW_PX * len(rows) + 60)
    note = sentences(
        f"{thousands(wild)} of {thousands(total)} values lie beyond these scales: double-click "
        "to see them."
        if wild
        else "",
        drawn(shown, total).replace("poses", "values"),
    )
    return figure, note


def _rows(s: Series, keep: NDArray[np.int64], start: int) -> Array:
    """Times and values, broken where there are none."""
    both = np.column_stack([(s.time_ns[keep] - start) * 1e-9, s.value[keep]])
    return broken(both, s.time_ns, keep)


def _line(s: Series, keep: NDArray[np.int64], start: int, color: str, mode: str) -> Scatter:
    x, y = _rows(s, keep, start).T
    return Scatter(
        x=x,
        y=y,
        mode=mode,
        line={"color": color, "width": 1.1},
        marker={"color": color, "size": 3.5},
        hovertemplate="%{x:.3f} s<br>%{y:.4g}",
    )


def _band(s: Series, start: int, color: str, shaded: bool) -> list[Scatter]:
    """The area between minus and plus ``s``, or just its edges."""
    keep = thin(len(s.value), 600)
    keep = keep[np.isfinite(s.value[keep])]
    seconds, value = _rows(s, keep, start).T
    look: dict[str, Any] = {
        "mode": "lines",
        "line": {"color": faint(color, 0.5), "width": 1},
        "showlegend": False,
        "hoverinfo": "skip",
    }
    upper = Scatter(x=seconds, y=value, **look)
    filled = {"fill": "tonexty", "fillcolor": faint(color, 0.13)} if shaded else {}
    lower = Scatter(x=seconds, y=-value, **filled, **look)
    return [upper, lower]
