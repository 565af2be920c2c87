"""Pictures of solutions (matplotlib): trajectories from above, and errors over time."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from locatk.core.evaluation import Evaluation
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.figure_files import write_figure
from locatk.formats.plots.ground import (
    Ground,
    build_ground,
    evaluate_unaligned,
    fit_view,
    is_shown_unscaled,
    is_unscaled,
)
from locatk.formats.plots.series import (
    MAX_EXPECTED_DEVICES,
    Series,
    axis_limit,
    expected_errors,
    interrupt_at_gaps,
    origin_ns,
    peaks_beyond,
    position_sigmas,
    split_by_device,
)
from locatk.formats.plots.shapes import (
    MAX_LEGEND_DEVICES,
    TRUTH,
    Label,
    Shape,
    Style,
    device_colors,
    is_in_legend,
)
from locatk.formats.plots.units import (
    abbreviate,
    format_count,
    format_length,
    last_bin_note,
    select_unit,
)

Array = NDArray[np.float64]

SIZE_INCHES = (12.0, 6.0)
"""Size of a picture: 1200 x 600 pixels as PNG."""

POINTS_PER_PX = 0.64
"""Size in points of one pixel of a :class:`Style`: the map of a picture is about half as wide as
that of a report."""

SYMBOLS = {"circle": "o", "square": "s", "cross": "x"}

MAX_TITLE_CHARACTERS = 160
"""Characters in a line of the title at its font size."""


def write_picture(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    truth: Sequence[Trajectory] = (),
    evaluation: Evaluation | None = None,
    start_ns: int | None = None,
    overwrite: bool = False,
) -> None:
    """Draw trajectories from above and their errors, without truth the solver's sigmas.

    Parameters
    ----------
    path : path
        The output; its suffix is one of :data:`~.figure_files.SUFFIXES`. The same arguments result
        in the same bytes.
    solution : Solution
    truth : sequence of Trajectory
        Drawn under the trajectories.
    evaluation : Evaluation, optional
        Errors, and the alignment by which the solution is drawn. By default a solution in metres is
        compared with ``truth`` without alignment.
    start_ns : int, optional
        Origin of the time axis; by default the first pose.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError, OutputExistsError, MissingDataError
        See :func:`~.figure_files.write_figure`.
    """
    write_figure(
        path, lambda: draw_picture(solution, truth, evaluation, start_ns), overwrite=overwrite
    )


def draw_picture(
    solution: Solution,
    truth: Sequence[Trajectory] = (),
    evaluation: Evaluation | None = None,
    start_ns: int | None = None,
) -> Figure:
    """Return the figure of :func:`write_picture`."""
    if evaluation is None and not is_unscaled(solution):
        evaluation = evaluate_unaligned(solution, truth)
    figure = Figure(figsize=SIZE_INCHES, layout="constrained")
    grid = figure.add_gridspec(1, 2)
    left, right = figure.add_subfigure(grid[0, 0]), figure.add_subfigure(grid[0, 1])
    _draw_map(left, build_ground(solution, truth, evaluation))
    start = origin_ns(None, solution) if start_ns is None else start_ns
    _draw_values(right, solution, evaluation, start)
    figure.suptitle(_title(solution, evaluation), x=0.01, ha="left", fontsize=10)
    return figure


# ---- the map


def _draw_map(figure: SubFigure, ground: Ground) -> None:
    """Draw the artifact, trajectories, markers and stations in a square view, with a legend."""
    axes = figure.subplots()
    ground, view, stations = fit_view(ground)
    colors = device_colors(list(ground.paths))
    for shape in ground.artifact.shapes:
        _draw_shape(axes, shape)
    for t in ground.truth:
        line = interrupt_at_gaps(t.position[:, :2], t.time_ns).T
        axes.plot(*line, color=TRUTH.color, lw=POINTS_PER_PX * TRUTH.width_px)
    for name, position in ground.paths.items():
        line = interrupt_at_gaps(position[:, :2], ground.times[name]).T
        axes.plot(*line, color=colors[name], lw=0.8, marker=".", ms=2.5)
    above = (*ground.markers.shapes, *stations.shapes)
    for shape in above:
        _draw_shape(axes, shape)
    for label in (*view.select_labels(ground.artifact.labels), *stations.labels):
        _draw_label(axes, label)
    axes.set_xlim(*view.limits[0])
    axes.set_ylim(*view.limits[1])
    axes.set_aspect("equal")
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.set_xlabel(f"x [{ground.unit}]")
    axes.set_ylabel(f"y [{ground.unit}]")
    outside = sum(view.count_outside(path) for path in ground.paths.values())
    if outside:
        text = f"{format_count(outside, 'poses')} outside this view"
        axes.set_title(text, loc="left", fontsize=9)

    handles = _device_handles(colors)
    if ground.truth:
        handles.append(_shape_handle(Shape("line", np.zeros((0, 0, 3)), TRUTH, "truth")))
    named = {shape.name: shape for shape in (*ground.artifact.shapes, *above) if shape.name}
    handles += [_shape_handle(shape) for shape in named.values()]
    longest = max((len(str(handle.get_label())) for handle in handles), default=0)
    # Half the picture is 600 pixels wide, a symbol with its spacing 62, a letter 7.
    columns = min(5, 600 // (62 + 7 * longest))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False)


def _draw_shape(axes: Axes, shape: Shape) -> None:
    style, points = shape.style, shape.points[:, :, :2]
    width = POINTS_PER_PX * style.width_px
    if shape.kind == "line":
        axes.add_collection(LineCollection(list(points), colors=style.color, linewidths=width))
    elif shape.kind == "polygon":
        polygons = PolyCollection(
            list(points),
            facecolor=_fill(style),
            edgecolor=style.color,
            linestyle=_line_style(style),
            linewidth=width,
        )
        axes.add_collection(polygons)
    elif shape.kind == "marker":
        axes.plot(*points[:, 0].T, ls="", **_marker(style))
    else:
        vectors = points[:, 1] - points[:, 0]
        axes.quiver(
            *points[:, 0].T,
            *vectors.T,
            color=style.color,
            angles="xy",
            scale_units="xy",
            scale=1,
            units="inches",
            width=width / 72,
            zorder=2,
        )


def _fill(style: Style) -> Any:
    return to_rgba(style.fill, style.fill_opacity) if style.fill else "none"


def _line_style(style: Style) -> str:
    return ":" if style.dotted else "-"


def _marker(style: Style) -> dict[str, Any]:
    return {
        "marker": SYMBOLS[style.symbol],
        "color": style.color,
        "mfc": _fill(style),
        "ms": POINTS_PER_PX * style.size_px,
        "mew": POINTS_PER_PX * style.width_px,
    }


def _draw_label(axes: Axes, label: Label) -> None:
    x, y = label.position[:2] + label.clearance
    is_centred = label.clearance == 0
    axes.annotate(
        label.text,
        (x, y),
        xytext=(0, POINTS_PER_PX * label.shift_px),
        textcoords="offset points",
        ha="center" if is_centred else "left",
        va="center" if is_centred else "bottom",
        fontsize=8 if is_centred else 7,
        color="black" if is_centred else "0.35",
    )


def _device_handles(colors: dict[str, str]) -> list[Line2D]:
    named = [name for k, name in enumerate(colors) if is_in_legend(k, len(colors))]
    # A leading underscore would hide the device from the legend.
    labels = [_literal(abbreviate(name).lstrip("_") or "_ ") for name in named]
    handles = [
        Line2D([], [], color=colors[name], marker=".", label=label)
        for name, label in zip(named, labels, strict=True)
    ]
    if len(colors) > MAX_LEGEND_DEVICES:
        handles.append(Line2D([], [], ls="", label=f"and {len(colors) - len(named)} more"))
    return handles


def _shape_handle(shape: Shape) -> Line2D:
    """Return the entry of a shape in the legend."""
    style = shape.style
    if shape.kind == "marker":
        look = {"ls": "", **_marker(style)}
    elif shape.kind == "polygon" and style.fill == style.color:
        look = {"ls": "", "marker": "s", "ms": 6}
    else:
        look = {"ls": _line_style(style), "lw": POINTS_PER_PX * style.width_px}
    return Line2D([], [], **{"color": style.color, "label": shape.name, **look})


def _literal(text: str) -> str:
    """Return text in which a dollar sign does not start a formula."""
    return text.replace("$", r"\$")


# ---- values over time


def _draw_values(
    figure: SubFigure, solution: Solution, evaluation: Evaluation | None, start_ns: int
) -> None:
    """Draw errors (else sigmas) over time and their histogram; outliers at the upper limit."""
    colors = device_colors([t.device for t in solution.trajectories])
    expected: dict[str, Series] = {}
    if evaluation is None:
        series, quantity = position_sigmas(solution), "solver's sigma"
    else:
        series, quantity = split_by_device(evaluation, evaluation.errors), "error"
        expected = expected_errors(solution, evaluation)
    unscaled = is_shown_unscaled(solution, evaluation)
    finite = [s.value[np.isfinite(s.value)] for s in series.values()]
    size = float(np.percentile(np.concatenate(finite), 95)) if any(map(len, finite)) else 0.0
    unit = select_unit(size, unscaled=unscaled)
    series = {name: s.scaled(unit.per_si) for name, s in series.items() if len(s.value)}
    expected = {
        name: s.scaled(unit.per_si) for name, s in expected.items() if np.isfinite(s.value).any()
    }

    over_time, histogram = figure.subplots(2, 1, height_ratios=(3, 2))
    for axes, x, y in (
        (over_time, "time [s]", f"{quantity} [{unit.name}]"),
        (histogram, f"{quantity} [{unit.name}]", "poses"),
    ):
        axes.set_xlabel(x)
        axes.set_ylabel(y)
        if not series:
            axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center")
            axes.set_xticks([])
            axes.set_yticks([])
    notes: list[str] = []
    if series:
        shown = expected if len(expected) <= MAX_EXPECTED_DEVICES else {}
        _draw_over_time(over_time, series, shown, colors, start_ns)
        notes = [_draw_histogram(histogram, series, colors)]
    if evaluation is not None:
        lengths = (
            f"{name} {format_length(getattr(evaluation, name), unscaled=unscaled)}"
            for name in ("median", "p95", "max")
        )
        notes.insert(0, f"APE {', '.join(lengths)}")
    histogram.set_title("\n".join(filter(None, notes)), loc="left", fontsize=9)


def _draw_over_time(
    axes: Axes,
    series: dict[str, Series],
    expected: dict[str, Series],
    colors: dict[str, str],
    start_ns: int,
) -> None:
    every = _concatenate(series.values())
    limit = axis_limit(every, _concatenate(expected.values()))
    for name, s in series.items():
        seconds = (s.time_ns - start_ns) * 1e-9
        beyond = s.value > limit
        axes.plot(seconds[~beyond], s.value[~beyond], ".", color=colors[name], ms=3)
        at_limit = np.full(np.count_nonzero(beyond), 0.98 * limit)
        axes.plot(seconds[beyond], at_limit, "^", color=colors[name], ms=5)
    for name, s in expected.items():
        rows = np.column_stack([1e-9 * (s.time_ns - start_ns).astype(float), s.value])
        seconds, value = interrupt_at_gaps(rows, s.time_ns).T
        axes.plot(seconds, value, color=colors[name], lw=0.9, alpha=0.6)
        if len(expected) == 1:  # Several shaded areas would cover each other.
            axes.fill_between(seconds, value, color=colors[name], alpha=0.12, lw=0)
        at = peaks_beyond(s, limit)
        seconds, at_limit = (s.time_ns[at] - start_ns) * 1e-9, np.full(len(at), 0.97 * limit)
        axes.plot(seconds, at_limit, "^", color=colors[name], ms=5, mfc="none")
    axes.set_ylim(0, limit)
    axes.grid(color="0.92")
    notes = ["line: 95 % of errors expected below it, by the covariance"] if expected else []
    if any((s.value > limit).any() for s in expected.values()):
        notes.append("open triangles: the line is beyond this scale")
    outliers = int(np.count_nonzero(every > limit))
    if outliers:
        count = f"{format_count(outliers)} of {format_count(len(every))}"
        notes.append(f"{count} beyond this scale (triangles)")
    axes.set_title("\n".join(notes), loc="left", fontsize=9)


def _draw_histogram(axes: Axes, series: dict[str, Series], colors: dict[str, str]) -> str:
    """Draw how often values occur; return a note on outliers in the last bin."""
    every = _concatenate(series.values())
    limit = axis_limit(every)
    if len(series) <= MAX_LEGEND_DEVICES:
        values, color = [s.value for s in series.values()], [colors[name] for name in series]
    else:
        values, color = [every], ["0.5"]
    clipped = [np.minimum(value, limit) for value in values]
    axes.hist(clipped, bins=np.linspace(0, limit, 41).tolist(), stacked=True, color=color)
    axes.set_xlim(0, limit)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return last_bin_note(every, limit)


def _concatenate(series: Iterable[Series]) -> Array:
    values = [s.value for s in series]
    return np.concatenate(values) if values else np.zeros(0)


# ---- the title


def _title(solution: Solution, evaluation: Evaluation | None) -> str:
    """Return system, number of poses and errors; below them the first lines of warnings."""
    text = (
        f"{solution.system}, {solution.method}: {format_count(solution.poses, 'poses')} of "
        f"{format_count(len(solution.trajectories), 'devices')}"
    )
    if evaluation is not None:
        unscaled = is_shown_unscaled(solution, evaluation)
        rmse, mean = (
            format_length(value, unscaled=unscaled) for value in (evaluation.rmse, evaluation.mae)
        )
        text += f", APE rmse {rmse}, mean {mean}"
        fraction = evaluation.coverage.fraction
        text += "" if fraction is None else f", {100 * fraction:.1f} % of the time solved"
        offset = evaluation.time_offset.describe()
        text += f" (alignment: {evaluation.align}, time offset: {offset})"
    warnings_text = textwrap.wrap(
        "; ".join(warning.message for warning in solution.warnings),
        MAX_TITLE_CHARACTERS,
        max_lines=2,
        placeholder=" ...",
    )
    return _literal("\n".join(textwrap.wrap(text, MAX_TITLE_CHARACTERS) + warnings_text))
