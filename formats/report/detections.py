"""What a system saw, and what it rejected and why: of a solution alone, without its session."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.results import FrameOutcome
from locatk.core.lighthouse.results import StationDetection
from locatk.core.solution import Solution
from locatk.formats.plots.ground import COLORS
from locatk.formats.plots.units import thousands
from locatk.formats.report import detection_tables as seen_text
from locatk.formats.report import signals_drawing as drawing
from locatk.formats.report.detection_tables import Seen, words
from locatk.formats.report.figures import label
from locatk.formats.report.panel import Panel, Table
from locatk.formats.report.rejection_reasons import Reason, meaning
from locatk.formats.report.signals_drawing import number, short

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MOST_ROWS = 20
"""Detections that a table lists; ``locatk solve --json`` tells them all."""

SEEN, REJECTED = "What was seen", "What was rejected, and why"

BINS = 40

BAR_PX = 46
"""Height of the bar of a reason with its name."""


def panels(solution: Solution) -> list[Panel]:
    """What was seen, and what was rejected and why; two panels for every system."""
    return [_seen(solution), _rejected(solution)]


# ---- what was seen


def _seen(solution: Solution) -> Panel:
    makers: dict[str, Callable[[Solution], Panel]] = {
        "lighthouse": _stations,
        "dots": _frames,
        "polaris": _tags,
        "landmarks": _landmarks,
    }
    make = makers.get(solution.system)
    if make is None:
        return Panel(SEEN, f"{len(solution.detections)} detections of {solution.system}.")
    if not solution.detections and solution.system != "dots":
        return Panel(SEEN, "Nothing.")
    return make(solution)


def _stations(solution: Solution) -> Panel:
    detections: tuple[StationDetection, ...] = solution.detections
    rows = [
        (
            str(found.channel),
            found.id or "-",
            str(found.period_ticks),
            found.calibration,
            str(found.sweeps),
            str(found.rejected),
            seen_text.number(found.residual_rad, 1e3, ".3f"),
        )
        for found in detections
    ]
    header = ("channel", "id", "period [ticks]", "calibration", "sweeps", "rejected")
    return Panel(
        SEEN,
        "The base stations of the recording, with the sweeps that are part of a pose and those of "
        "moments that were rejected. The residual is what planes miss their meeting point by, "
        "where redundancy shows it.",
        table=Table((*header, "residual [mrad]"), rows),
    )


def _tags(solution: Solution) -> Panel:
    table = seen_text.tags(solution.detections, MOST_ROWS, compact=True)
    margins = [number(each.margin) for each in solution.detections if not each.refused]
    note = (
        f"{len(margins)} of {counted(len(solution.detections), 'passes')} over magnets "
        f"{'was' if len(margins) == 1 else 'were'} read as a tag. Tags are told in the frame of "
        "the bar, with the standard deviation; the margin is how much nearer the id is than the "
        "next one, in steps of orientation."
    )
    figure = None
    if len(margins) > MOST_ROWS:
        figure = _histogram([("margin [steps]", [("read", margins)])], "passes")
    return _listed(note, table, figure)


def _landmarks(solution: Solution) -> Panel:
    table = seen_text.landmarks(solution.detections, MOST_ROWS, compact=True)
    refused = sum(bool(each.refused) for each in solution.detections)
    note = (
        f"{counted(len(solution.detections), 'visits')} to landmarks, {refused} refused. The robot "
        "is told in the frame of the landmark, with the standard deviation."
    )
    figure = None
    if len(solution.detections) > MOST_ROWS:
        left = [each.residual_sigma for each in solution.detections]
        figure = _histogram([("residual [sigma]", [("visits", left)])], "visits")
    return _listed(note, table, figure)


def _listed(note: str, table: Seen, figure: Figure | None) -> Panel:
    if table.more:
        note += f" The first {len(table.rows)} are listed; `locatk solve --json` tells all."
    return Panel(SEEN, note, figure, Table(table.header, table.rows))


def _frames(solution: Solution) -> Panel:
    frames: tuple[FrameOutcome, ...] = () if solution.facts is None else solution.facts.frames
    if not frames:
        return Panel(SEEN, f"{len(solution.detections)} frames with a place.")
    decoded = [each for each in frames if not each.rejected]
    others = [each for each in frames if each.rejected]
    groups = (("decoded", decoded), ("rejected", others))
    rows = [
        (
            name,
            str(len(group)),
            f"{100 * len(group) / len(frames):.1f}",
            _median(group, "dots", 1, ".0f"),
            _median(group, "corrected_bits", 1, ".0f"),
            _median(group, "confidence", 100, ".2f"),
        )
        for name, group in groups
        if group
    ]
    header = ("frames", "count", "share [%]", "dots", "bits corrected", "confidence [%]")
    series = [
        (
            what,
            [(name, [scale * getattr(each, key) for each in group]) for name, group in groups],
        )
        for what, key, scale in (
            ("confidence [%]", "confidence", 100.0),
            ("bits corrected", "corrected_bits", 1.0),
        )
    ]
    return Panel(
        SEEN,
        f"{counted(len(frames), 'frames')} of the camera. Dots, corrected bits and confidence are "
        "medians.",
        _histogram(series, "frames"),
        Table(header, rows),
    )


def _median(group: list[FrameOutcome], key: str, scale: float, form: str) -> str:
    values = np.array([getattr(each, key) for each in group], float)
    known = values[np.isfinite(values)]
    return seen_text.number(float(np.median(known)), scale, form) if len(known) else "-"


Series = tuple[str, list[tuple[str, list[float]]]]
"""What is counted, and its values in named groups."""


def _histogram(series: list[Series], unit: str) -> Figure:
    """How often values occur, side by side; counted here, as a page need not hold them all."""
    from plotly.subplots import make_subplots

    figure = make_subplots(1, len(series), shared_yaxes=True, horizontal_spacing=0.06)
    several = any(len(groups) > 1 for _, groups in series)
    for column, (what, groups) in enumerate(series, 1):
        every = np.array([value for _, values in groups for value in values])
        every = every[np.isfinite(every)]
        low, high = _ends(every, percent=what.endswith("[%]"))
        edges = np.linspace(low, high, BINS + 1)
        for (name, values), color in zip(groups, (drawing.USED, drawing.REFUSED), strict=False):
            count = np.histogram([value for value in values if math.isfinite(value)], edges)[0]
            if not count.any():
                continue
            figure.add_bar(
                x=short((edges[1:] + edges[:-1]) / 2), y=count, width=float(edges[1] - edges[0]),
                name=f"{name} ({len(values)})", legendgroup=name, showlegend=column == 1,
                marker_color=color, hovertemplate="%{x:.4g}: %{y}", row=1, col=column,
            )  # fmt: skip
        figure.update_xaxes(title=what, row=1, col=column)
    figure.update_yaxes(title=unit, row=1, col=1)
    drawing.style(figure, 300, barmode="stack", showlegend=several)
    return figure


def _ends(value: NDArray[np.float64], *, percent: bool) -> tuple[float, float]:
    """Between which values are counted."""
    if percent or not len(value):
        return 0.0, 100.0
    low, high = float(value.min()), float(value.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


# ---- what was rejected


def _rejected(solution: Solution) -> Panel:
    counts = {why: n for why, n in solution.rejected.items() if n}
    if not counts:
        return Panel(REJECTED, "Nothing was rejected.")
    known = {why: meaning(solution.system, why) for why in counts}
    totals = _totals(solution, known)
    order = sorted(counts, key=lambda why: (_unit(known[why]), -counts[why]))
    rows = []
    for why in order:
        reason = known[why]
        total = totals.get(_unit(reason), 0)
        share = f"{100 * counts[why] / total:.3g} %" if total else "-"
        rows.append(
            (
                words(why),
                str(counts[why]),
                f"{share} of {counted(total, _unit(reason))}" if total else share,
                "" if reason is None else reason.sentence,
            )
        )
    header = ("reason", "count", "share", "what it means")
    figure = _bars(counts, order, {why: _unit(known[why]) for why in order})
    said = []
    for unit in dict.fromkeys(_unit(known[why]) for why in order):
        count = sum(n for why, n in counts.items() if _unit(known[why]) == unit)
        said.append(
            f"{thousands(count)} of {counted(totals[unit], unit)}"
            if unit in totals
            else counted(count, unit)
        )
    return Panel(REJECTED, f"Rejected: {', '.join(said)}.", figure, Table(header, rows))


def counted(count: int, unit: str) -> str:
    """``"1 pass"``, ``"2 passes"``."""
    return f"{thousands(count)} {unit if count != 1 else {'passes': 'pass'}.get(unit, unit[:-1])}"


def _unit(reason: Reason | None) -> str:
    return "observations" if reason is None else reason.unit


def _totals(solution: Solution, known: Mapping[str, Reason | None]) -> dict[str, int]:
    """How many there were of what reasons are counted in, by unit."""
    left = Counter[str]()
    for why, count in solution.rejected.items():
        left[_unit(known.get(why))] += count
    seen = solution.detections
    if solution.system == "lighthouse":
        used = solution.rejected.get("station_contradicts_others", 0)  # has a pose all the same
        return {
            "sweeps": left["sweeps"] + sum(each.sweeps + each.rejected for each in seen),
            "moments": left["moments"] - used + solution.poses,
        }
    if solution.system == "polaris":
        return {"passes": len(seen) + solution.rejected.get("no_magnets", 0)}
    if solution.system == "landmarks":
        return {"visits": len(seen)}
    if solution.system == "dots":
        return {"frames": left["frames"] + len(seen)}
    return {}


def _bars(counts: Mapping[str, int], order: list[str], units: Mapping[str, str]) -> Figure | None:
    """Reasons by how often they were given, each with its name above its bar, where a narrow
    window has room for it; of a single reason nothing that its table does not say."""
    from plotly.graph_objects import Figure

    if len(order) < 2:
        return None
    figure = Figure()
    row = {why: k for k, why in enumerate(order)}
    for k, unit in enumerate(dict.fromkeys(units.values())):
        mine = [why for why in order if units[why] == unit]
        figure.add_bar(
            x=[counts[why] for why in mine], y=[row[why] for why in mine], orientation="h",
            name=unit, marker_color=COLORS[(1, 5, 3)[k % 3]], width=0.4,
            text=[thousands(counts[why]) for why in mine], textposition="outside",
            cliponaxis=False, customdata=[label(words(why)) for why in mine],
            hovertemplate=f"%{{customdata}}: %{{x}} {unit}<extra></extra>",
        )  # fmt: skip
    names = [
        {
            "x": 0, "y": row[why], "text": label(words(why)), "showarrow": False,
            "xanchor": "left", "yanchor": "bottom", "yshift": 0.2 * BAR_PX, "xshift": -3,
        }
        for why in order
    ]  # fmt: skip
    # Room for the number beside the longest bar.
    figure.update_xaxes(visible=False, range=[0, 1.12 * max(counts[why] for why in order)])
    figure.update_yaxes(visible=False, range=[len(order) - 0.5, -0.9])
    several = len(set(units.values())) > 1
    figure.update_layout(annotations=names, showlegend=several)
    figure.update_layout(
        height=BAR_PX * len(order) + (44 if several else 20),
        margin={"l": 6, "r": 12, "t": 12, "b": 8},
    )
    return figure
