"""Pictures of solutions: paths seen from above, and how far they are from the truth."""

from __future__ import annotations

import os
import textwrap
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from locatk.core import metrics
from locatk.core.errors import InputError
from locatk.core.geometry import Similarity
from locatk.core.lighthouse.scene import Scene
from locatk.core.metrics import Evaluation
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.output import atomic_write, check_output
from locatk.formats.plot_floor import floor_of
from locatk.formats.plot_map import IN_LEGEND, draw_map, legend, plain, tags_of

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg", ".pdf")

SIZE_IN, DPI = (12.0, 6.0), 100
"""1200 x 600 pixels as PNG."""

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F3C8D")
"""Okabe and Ito's, which the colour-blind can tell apart, without yellow."""


def plot_solution(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    truth: Sequence[Trajectory] = (),
    evaluation: Evaluation | None = None,
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
        figure = draw(solution, truth, evaluation)
        with atomic_write(path, overwrite=overwrite) as stream:
            figure.savefig(stream, format=suffix[1:], dpi=DPI, metadata=undated)


def draw(
    solution: Solution, truth: Sequence[Trajectory] = (), evaluation: Evaluation | None = None
) -> Figure:
    """The figure of :func:`plot_solution`, not yet written."""
    scene = solution.artifact if isinstance(solution.artifact, Scene) else Scene()
    unscaled = solution.system == "lighthouse" and scene.scale == "unit"
    if evaluation is None and not unscaled:
        evaluation = _compare(solution, truth)
    tags, floor = tags_of(solution), floor_of(solution)
    if evaluation is not None:
        paths, scene = _aligned(solution.trajectories, scene, evaluation.alignment)
        tags = tuple(tag.moved(evaluation.alignment) for tag in tags)
        floor = None if floor is None else floor.moved(evaluation.alignment)
        unscaled = unscaled and evaluation.align != "sim3"
    else:
        paths = {t.device: t.position for t in solution.trajectories}
    times = {t.device: t.time_ns for t in solution.trajectories}
    colors = {name: COLORS[k % len(COLORS)] for k, name in enumerate(paths)}

    figure = Figure(figsize=SIZE_IN, layout="constrained")
    grid = figure.add_gridspec(1, 2)
    left, right = figure.add_subfigure(grid[0, 0]), figure.add_subfigure(grid[0, 1])
    ground = left.subplots()
    unit = "unit" if unscaled else "m"
    draw_map(ground, paths, times, () if unscaled else truth, scene, tags, floor, colors, unit)
    signs = legend(colors, scene, tags, floor, bool(truth) and not unscaled)
    widest = max((len(str(sign.get_label())) for sign in signs), default=0)
    left.legend(
        handles=signs,
        loc="outside lower center",
        ncols=min(5, 600 // (62 + 7 * widest)),  # in pixels: half the picture, a sign, a letter
        frameon=False,
    )
    over_time, spread = right.subplots(2, 1, height_ratios=(3, 2))
    series = _errors(evaluation) if evaluation else _sigmas(solution)
    what = "error" if evaluation else "solver's sigma"
    label = f"{what} [{'1/1000 unit' if unscaled else 'mm'}]"
    _draw_series(over_time, spread, series, colors, label)
    if evaluation is not None:
        spread.set_title(
            f"half below {_mm(evaluation.median)}, 95 % below {_mm(evaluation.p95)}, "
            f"largest {_mm(evaluation.max)}",
            loc="left",
            fontsize=9,
        )
    figure.suptitle(_title(solution, evaluation), x=0.01, ha="left", fontsize=10)
    return figure


# ---- what is drawn


@dataclass(frozen=True)
class Series:
    """One number a pose: times (n,) in ns and values (n,), in thousandths of the unit."""

    time_ns: NDArray[np.int64]
    value: Array


def _compare(solution: Solution, truth: Sequence[Trajectory]) -> Evaluation | None:
    """The solution against the truth as it is; None where no pose has truth."""
    true = {t.device: t for t in truth}
    pairs = [(t, true[t.device]) for t in solution.trajectories if t.device in true and len(t)]
    try:
        return metrics.evaluate_all(pairs) if pairs else None
    except InputError:
        return None


def _aligned(
    trajectories: Sequence[Trajectory], scene: Scene, to: Similarity
) -> tuple[dict[str, Array], Scene]:
    """Paths and scene in the frame of the truth."""
    stations = tuple(
        replace(s, position=to.apply(s.position), rotation=to.rotation @ s.rotation)
        for s in scene.stations
    )
    markers = tuple(replace(m, position=to.apply(m.position)) for m in scene.markers)
    moved = replace(scene, stations=stations, markers=markers)
    return {t.device: to.apply(t.position) for t in trajectories}, moved


def _errors(evaluation: Evaluation) -> dict[str, Series]:
    """Errors of each device."""
    series = {}
    for k, name in enumerate(evaluation.devices):
        mine = evaluation.device == k
        series[name] = Series(evaluation.time_ns[mine], 1e3 * evaluation.errors[mine])
    return series


def _sigmas(solution: Solution) -> dict[str, Series]:
    """Standard deviations of positions, over the axes that are known; else left out."""
    series = {}
    for t in solution.trajectories:
        variances = np.einsum("nii->ni", t.covariance[:, :3, :3])
        known, variance = np.isfinite(variances).any(axis=1), np.nansum(variances, axis=1)
        if np.any(known):
            series[t.device] = Series(t.time_ns[known], 1e3 * np.sqrt(variance[known]))
    return series


# ---- numbers over time


def _draw_series(
    over_time: Axes,
    spread: Axes,
    series: dict[str, Series],
    colors: dict[str, str],
    label: str,
) -> None:
    """Values over time, and how often they occur; wild ones are drawn at the upper edge."""
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
    usual = 1.5 * float(np.percentile(every, 98))
    top = 1.05 * min(float(every.max()), usual) or 1.0
    start = min(int(s.time_ns.min()) for s in filled.values())
    for name, s in filled.items():
        seconds = (s.time_ns - start) * 1e-9
        wild = s.value > top
        over_time.plot(seconds[~wild], s.value[~wild], ".", color=colors[name], ms=3)
        edge = np.full(np.count_nonzero(wild), 0.98 * top)
        over_time.plot(seconds[wild], edge, "^", color=colors[name], ms=5)
    over_time.set_ylim(0, top)
    over_time.grid(color="0.92")
    out = int(np.count_nonzero(every > top))
    if out:
        beyond = f"{out} of {len(every)} beyond this scale (triangles)"
        over_time.set_title(beyond, loc="left", fontsize=9)
    # Many colours on top of each other tell nothing.
    parts = [s.value for s in filled.values()], [colors[name] for name in filled]
    if len(filled) > IN_LEGEND:
        parts = [every], ["0.5"]
    values = [np.minimum(value, top) for value in parts[0]]
    spread.hist(values, bins=np.linspace(0, top, 41).tolist(), stacked=True, color=parts[1])
    spread.set_xlim(0, top)
    spread.yaxis.set_major_locator(MaxNLocator(5, integer=True))


# ---- words


def _title(solution: Solution, evaluation: Evaluation | None) -> str:
    """What this is, how good it is, and what it stands on."""
    devices = len(solution.trajectories)
    text = (
        f"{solution.system}, {solution.method}: {solution.poses} poses of {devices} "
        f"{'device' if devices == 1 else 'devices'}"
    )
    if evaluation is not None:
        text += f", MAE {_mm(evaluation.mae)}, RMSE {_mm(evaluation.rmse)}"
        text += f" (alignment: {evaluation.align}, time offset: {evaluation.offset_source})"
    notes = textwrap.wrap("; ".join(solution.notes), 160, max_lines=2, placeholder=" ...")
    return plain("\n".join(textwrap.wrap(text, 160) + notes))


def _mm(metres: float) -> str:
    """A length in mm, to three digits."""
    digits = np.clip(2 - np.floor(np.log10(max(1e3 * metres, 1e-5))), 0, 5)
    return f"{1e3 * metres:.{int(digits)}f} mm"
