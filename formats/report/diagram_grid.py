"""Grids of diagrams that share axes and become one figure: lines, marks and histograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure
from plotly.subplots import make_subplots

from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.theme import CARD
from locatk.formats.report.thinning import thin_marks

Array = NDArray[np.float64]

USED, REFUSED = COLORS[0], COLORS[1]
"""Colors of used and refused detections."""

LINES_THINNED = "Thinned: each column of the picture shows its largest and smallest value."
MARKS_THINNED = "Thinned: of marks that would cover each other one is drawn."


def single_precision(value: Any) -> NDArray[np.float32]:
    """Return numbers as a page stores them, in half the size."""
    return np.asarray(value, np.float32)


class DiagramGrid:
    """Grid of diagrams.

    Rows and columns count from 1 as in plotly. Traces are collected and added to the figure
    together, which takes half the time of adding them one by one.

    Attributes
    ----------
    figure : plotly Figure
    thinning_note : str
        Sentence on lines or marks that are not drawn completely; empty if all are.
    """

    def __init__(self, rows: int, columns: int = 1, **layout: Any) -> None:
        self.figure: Figure = make_subplots(rows, columns, **layout)
        self.rows, self.columns = rows, columns
        self.thinning_note = ""
        self._traces: list[dict[str, Any]] = []

    def add(self, row: int, x: Any, y: Any, *, column: int = 1, **trace: Any) -> None:
        """Add a trace of plotly, by default a scatter; arrays are stored in single precision."""
        number = (row - 1) * self.columns + column
        axis = "" if number == 1 else str(number)
        x, y = (single_precision(v) if isinstance(v, np.ndarray) else v for v in (x, y))
        axes = {"xaxis": f"x{axis}", "yaxis": f"y{axis}"}
        self._traces.append({"type": "scatter", "x": x, "y": y, **axes, **trace})

    def add_marks(self, row: int, x: Array, y: Array, marker: dict[str, Any], **trace: Any) -> None:
        """Add marks (n,), without those that would be covered by others; none if n is 0."""
        if not len(x):
            return
        kept = thin_marks(x, y)
        if len(kept) < len(x):
            self.thinning_note = self.thinning_note or MARKS_THINNED
        self.add(row, x[kept], y[kept], mode="markers", marker=marker, **trace)

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
                    marker={"color": color, "line": {"width": 0.7, "color": CARD}},
                    hovertemplate=hover,
                )

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
        legend = {"orientation": "v", "x": 1.01, "y": 1, "xanchor": "left", "yanchor": "top"}
        self.figure.update_layout(
            height=height_px,
            margin={"l": 64, "r": 12, "t": 24, "b": 44},
            legend={**legend, "font": {"size": 12}},
        )
        self.figure.update_layout(**layout)
        self.figure.update_xaxes(exponentformat="none")
        self.figure.update_yaxes(exponentformat="none")
        return self.figure
