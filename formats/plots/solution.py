"""Pictures of solutions: paths seen from above, and how far they are from the truth."""

from __future__ import annotations

import os
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.evaluation import Evaluation
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.output import atomic_write, check_output
from locatk.formats.plots import series as plot_series
from locatk.formats.plots.ground import COLORS, IN_LEGEND, broken, compare, ground_of, has_no_scale
from locatk.formats.plots.map import draw_map, legend, plain
from locatk.formats.plots.series import Series
from locatk.formats.plots.time_axis import origin_ns
from locatk.formats.plots.units import Unit, length, thousands, unit_for

__all__ = ["COLORS", "SUFFIXES", "draw", "plot_solution"]

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg", ".pdf")

SIZE_IN, DPI = (12.0, 6.0), 100
"""1200 x 600 pixels as PNG."""


def plot_solution(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    truth: Sequence[Trajectory] = (),
    evaluation: Evaluation | None = None,
    start_ns: int | None = None,
    overwrite: bool = False,
) -> None:
    """Draw a solution: paths from above, and errors (else what the solver expects of them).

    Parameters
    ----------
    path : path
        The output; its suffix is one of :data:`SUFFIXES`. The same arguments give the same
        bytes.
    solution : Solution
    truth : sequence of Trajectory
        Drawn beneath the paths.
    evaluation : Evaluation, optional
        The errors, and the alignment with which the solution is laid over the truth. Without
        one a solution in metres is compared with ``truth`` as it is, without alignment.
    start_ns : int, optional
        Where the time axis begins; by default with the first pose.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError
        The suffix is another one.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"no picture can be written as {Path(path).name!r}",
            hint=f"End its name with one of {', '.join(SUFFIXES)}",
        )
    check_output(path, overwrite=overwrite)
    undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
    # Neither the user's matplotlibrc nor a random salt may change the picture.
    salted = mpl.rc_context({"svg.hashsalt": "locatk", "font.size": 9})
    with style.context("default"), salted, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # drawn as a box
        figure = draw(solution, truth, evaluation, start_ns)
        with atomic_write(path, overwrite=overwrite) as stream:
            figure.savefig(stream, format=suffix[1:], dpi=DPI, metadata=undated)


def draw(
    solution: Solution,
    truth: Sequence[Trajectory] = (),
    evaluation: Evaluation | None = None,
    start_ns: int | None = None,
) -> Figure:
    """The figure of :func:`plot_solution`, not yet written."""
    if evaluation is None and not has_no_scale(solution):
        evaluation = compare(solution, truth)
    ground = ground_of(solution, truth, evaluation)
    colors = {name: COLORS[k % len(COLORS)] for k, name in enumerate(ground.paths)}

    figure = Figure(figsize=SIZE_IN, layout="constrained")
    grid = figure.add_gridspec(1, 2)
    left, right = figure.add_subfigure(grid[0, 0]), figure.add_subfigure(grid[0, 1])
    draw_map(left.subplots(), ground, colors)
    signs = legend(ground, colors)
    widest = max((len(str(sign.get_label())) for sign in signs), default=0)
    left.legend(
        handles=signs,
        loc="outside lower center",
        ncols=min(5, 600 // (62 + 7 * widest)),  # in pixels: half the picture, a sign, a letter
        frameon=False,
    )
    over_time, spread = right.subplots(2, 1, height_ratios=(3, 2))
    series = plot_series.errors(evaluation) if evaluation else plot_series.sigmas(solution)
    what = "error" if evaluation else "solver's sigma"
    values = [s.value[np.isfinite(s.value)] for s in series.values()]
    every = np.concatenate(values) if values else np.zeros(0)
    size = float(np.percentile(every, 95)) if len(every) else 0.0
    unscaled = ground.unit == "unit"
    unit = unit_for(size, unscaled=unscaled)
    label = f"{what} [{unit.name}]"
    expected = plot_series.expected(solution, evaluation) if evaluation is not None else {}
    start = origin_ns(None, solution) if start_ns is None else start_ns
    _draw_series(
        over_time, spread, _scaled(series, unit), _scaled(expected, unit), colors, label, start
    )
    if evaluation is not None:
        spread.set_title(
            "APE "
            + ", ".join(
                f"{name} {length(getattr(evaluation, name), unscaled=unscaled)}"
                for name in ("median", "p95", "max")
            ),
            loc="left",
            fontsize=9,
        )
    figure.suptitle(_title(solution, evaluation), x=0.01, ha="left", fontsize=10)
    return figure


# ---- numbers over time


def _draw_series(
    over_time: Axes,
    spread: Axes,
    series: dict[str, Series],
    expected: dict[str, Series],
    colors: dict[str, str],
    label: str,
    start: int,
) -> None:
    """Values over time, and how often they occur; wild ones are drawn at the upper edge.

    All in the unit of the label; ``expected`` is drawn as a line, for each device that has one.
    """
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel(label)
    spread.set_xlabel(label)
    spread.set_ylabel("poses")
    filled = {name: s for name, s in series.items() if len(s.value)}
    if not filled:
        for axes in (over_time, spread):
            axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center")
            axes.set_xticks([])
            axes.set_yticks([])
        return
    every = np.concatenate([s.value for s in filled.values()])
    bands = {name: s for name, s in expected.items() if np.isfinite(s.value).any()}
    if len(bands) > plot_series.MOST_BANDS:
        bands = {}
    edges = [s.value for s in bands.values()]
    top = plot_series.usual_top(every, np.concatenate(edges) if edges else None)
    for name, s in filled.items():
        seconds = (s.time_ns - start) * 1e-9
        wild = s.value > top
        over_time.plot(seconds[~wild], s.value[~wild], ".", color=colors[name], ms=3)
        edge = np.full(np.count_nonzero(wild), 0.98 * top)
        over_time.plot(seconds[wild], edge, "^", color=colors[name], ms=5)
    for name, s in bands.items():
        edge = broken(s.value[:, None], s.time_ns)[:, 0]
        seconds = broken(1e-9 * (s.time_ns[:, None] - start).astype(float), s.time_ns)[:, 0]
        over_time.plot(seconds, edge, color=colors[name], lw=0.9, alpha=0.6)
        if len(bands) == 1:  # several shades cover each other
            over_time.fill_between(seconds, edge, color=colors[name], alpha=0.12, lw=0)
    over_time.set_ylim(0, top)
    over_time.grid(color="0.92")
    said = ["line: 95 % expected by the covariance"] if bands else []
    out = int(np.count_nonzero(every > top))
    if out:
        count = f"{thousands(out)} of {thousands(len(every))}"
        said.append(f"{count} beyond this scale (triangles)")
    over_time.set_title("\n".join(said), loc="left", fontsize=9)
    usual = plot_series.usual_top(every)
    # Many colours on top of each other tell nothing.
    parts = [s.value for s in filled.values()], [colors[name] for name in filled]
    if len(filled) > IN_LEGEND:
        parts = [every], ["0.5"]
    values = [np.minimum(value, usual) for value in parts[0]]
    spread.hist(values, bins=np.linspace(0, usual, 41).tolist(), stacked=True, color=parts[1])
    spread.set_xlim(0, usual)
    spread.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def _scaled(series: dict[str, Series], unit: Unit) -> dict[str, Series]:
    return {name: Series(s.time_ns, unit.per_metre * s.value) for name, s in series.items()}


# ---- words


def _title(solution: Solution, evaluation: Evaluation | None) -> str:
    """What this is, how good it is, and what it stands on."""
    devices = len(solution.trajectories)
    text = (
        f"{solution.system}, {solution.method}: {thousands(solution.poses)} poses of {devices} "
        f"{'device' if devices == 1 else 'devices'}"
    )
    if evaluation is not None:
        unit = has_no_scale(solution) and not evaluation.align.startswith("sim")
        rmse, mean = (length(value, unscaled=unit) for value in (evaluation.rmse, evaluation.mae))
        text += f", APE rmse {rmse}, mean {mean}"
        fraction = evaluation.coverage.fraction
        text += "" if fraction is None else f", {100 * fraction:.1f} % of the time solved"
        offset = evaluation.time_offset.describe()
        text += f" (alignment: {evaluation.align}, time offset: {offset})"
    notes = textwrap.wrap(
        "; ".join(warning.message for warning in solution.warnings),
        160,
        max_lines=2,
        placeholder=" ...",
    )
    return plain("\n".join(textwrap.wrap(text, 160) + notes))
