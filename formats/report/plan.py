"""Page of ``locatk advise --report``: the four systems for a task, in one HTML file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.graph_objects import Figure, Scatter

from locatk.core.advice.answer import AccuracyMap, Advice, SystemAdvice
from locatk.core.advice.task import Task
from locatk.core.materials import BillItem
from locatk.formats.advice.entries import check_text, cost_text, value_text
from locatk.formats.output import atomic_write, check_output, tool_version
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report import page
from locatk.formats.report.panels import Panel, Table
from locatk.formats.report.theme import INK, MUTED, SENSOR_SHADES

Array = NDArray[np.float64]

MAP_WIDTH_PX, MIN_MAP_HEIGHT_PX, MAX_MAP_HEIGHT_PX = 760, 320, 700
"""Width and limits of the height of a map in pixels."""

MAX_MAP_POINTS = 3000
"""Points of a map; of more, every second, third ... is drawn."""

CERTAINTIES = {
    "published": "stated in the paper or a data sheet",
    "measured": "measured by locatk",
    "computed": "predicted by a model that was compared with simulations and recordings",
    "assumed": "an assumption: replace it by your own figure",
}


def write_plan(
    path: str | os.PathLike[str],
    task: Task,
    advice: Advice,
    settings: str,
    *,
    overwrite: bool = False,
) -> None:
    """Write the page; the same answer results in the same bytes.

    Parameters
    ----------
    path : path
        The output, an HTML file.
    task : Task
    advice : Advice
    settings : str
        The task as TOML.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    check_output(path, overwrite=overwrite)
    content = render_plan(task, advice, settings).encode()
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(content)


def render_plan(task: Task, advice: Advice, settings: str) -> str:
    """Return the page as text."""
    title = "Which system?"
    body = [
        "<header>",
        page.paragraph("locatk advise", "brand"),
        f"<h1>{page.text(title)}</h1>",
        page.paragraph(_task_text(task), "sub"),
        page.paragraph(_verdict(advice), "verdict"),
        page.notes("Two systems together", [pair.reason for pair in advice.combinations]),
        page.panel(Panel("Side by side", _legend(), table=_comparison(advice)), "comparison"),
        "</header>",
        "<main>",
    ]
    for system in advice.systems:
        body.append(f'<article class="subject" id="{system.system}">')
        body.append(f"<h2>{page.text(system.system)}</h2>")
        body += _article(task, system)
        body.append("</article>")
    body.append('<article class="subject" id="task"><h2>Task</h2>')
    body.append(
        page.section(
            ["<h3>task.toml</h3>", page.command(settings.rstrip(), "task-settings")], "task-file"
        )
    )
    body.append("</article></main>")
    body.append(
        f"<footer>Made by locatk {page.text(tool_version())}. All accuracies are predictions. "
        "This file is complete.</footer>"
    )
    return page.document(f"{title} - locatk", body)


def _task_text(task: Task) -> str:
    x, y = np.ptp(task.corners_m, axis=0).tolist()
    robots = "1 robot" if task.robots == 1 else f"{task.robots} robots"
    heading = "" if task.heading_rad is None else f" and {value_text(task.heading_rad, 'rad')}"
    return (
        f"{robots} on {task.area_m2:.3g} m2 ({x:g} x {y:g} m), at {task.speed_mps:g} m/s; wanted "
        f"in 95 % of the time: {value_text(task.position_m, 'm')}{heading}"
    )


def _verdict(advice: Advice) -> str:
    feasible = [system.system for system in advice.systems if system.is_feasible]
    if not feasible:
        return "No system meets all requirements. Each section says what would have to change."
    if len(feasible) == 1:
        return f"{feasible[0].capitalize()} meets all requirements."
    return (
        f"{', '.join(feasible[:-1]).capitalize()} and {feasible[-1]} meet all requirements; "
        f"{feasible[0]} takes the least installation work."
    )


def _legend() -> str:
    return "Errors that 95 % of the poses do not exceed. An exclamation mark: not as wanted."


def _comparison(advice: Advice) -> Table:
    names = list(dict.fromkeys(check.name for s in advice.systems for check in s.checks))
    rows: list[tuple[str, ...]] = [
        ("meets the task", "", *("yes" if s.is_feasible else "no" for s in advice.systems))
    ]
    for name in names:
        checks = [system.check(name) for system in advice.systems]
        if not any(check is not None and check.unit for check in checks):
            continue
        wanted = next((c for c in checks if c is not None and c.wanted is not None), None)
        if name == "cost":
            cells = [cost_text(system) for system in advice.systems]
        else:
            cells = [check_text(check) for check in checks]
        rows.append(
            (name, "-" if wanted is None else value_text(wanted.wanted, wanted.unit), *cells)
        )
    return Table(("", "wanted", *(system.system for system in advice.systems)), rows)


def _article(task: Task, system: SystemAdvice) -> Iterator[str]:
    """Yield the parts of the page on one system."""
    name = system.system
    yield page.paragraph(system.design, "verdict")
    yield page.notes(
        "Not as wanted",
        [
            f"{check.name}: {value_text(check.expected, check.unit)}"
            + (f". {check.remedy}" if check.remedy else "")
            for check in system.failures
        ],
    )
    if system.accuracy_map is not None and len(system.accuracy_map.point_m):
        yield page.panel(_map_panel(task, system.accuracy_map), f"{name}-map")
    yield page.panel(
        Panel("Requirements", "How sure: " + _certainty_note(system), table=_checks_table(system)),
        f"{name}-checks",
    )
    yield page.panel(Panel("Parts", _total_note(system), table=_bill_table(system)), f"{name}-bill")
    yield page.panel(
        Panel(
            f"Installation: {system.hours:.1f} hours",
            "From the counts of the design.",
            table=Table(
                ("work", "count", "minutes each", "hours", "source"),
                [
                    (
                        step.name,
                        f"{step.count:g}",
                        f"{step.minutes_each:g}",
                        f"{step.hours:.1f}",
                        step.source,
                    )
                    for step in system.work
                ],
            ),
        ),
        f"{name}-work",
    )
    if system.power:
        yield page.panel(
            Panel(
                "Power of each robot",
                table=Table(
                    ("mode", "power", "battery life", "source"),
                    [
                        (
                            power.mode,
                            value_text(power.power_w, "W"),
                            "-"
                            if task.battery_wh is None
                            else f"{task.battery_wh / power.power_w:.1f} h",
                            power.source,
                        )
                        for power in system.power
                    ],
                ),
            ),
            f"{name}-power",
        )
    yield page.notes("Risks", system.risks)
    yield page.notes("Maintenance", system.maintenance)
    yield page.notes("What the paper says", system.paper)
    if system.commands:
        yield page.section(
            [
                "<h3>Go on</h3>",
                page.paragraph("The simulated session shows the errors to expect."),
                page.command("\n".join(system.commands), f"{name}-commands"),
            ],
            f"{name}-next",
        )


def _certainty_note(system: SystemAdvice) -> str:
    used = {check.certainty for check in system.checks}
    return "; ".join(f"{name}: {text}" for name, text in CERTAINTIES.items() if name in used) + "."


def _checks_table(system: SystemAdvice) -> Table:
    marks = {True: "yes", False: "no", None: "-"}
    return Table(
        ("requirement", "expected", "wanted", "met", "how sure", "source"),
        [
            (
                check.name,
                value_text(check.expected, check.unit),
                value_text(check.wanted, check.unit),
                marks[check.is_met],
                check.certainty,
                check.source,
            )
            for check in system.checks
        ],
    )


def _total_note(system: SystemAdvice) -> str:
    text = "; ".join(total.text for total in system.totals)
    return f"{text[0].upper()}{text[1:]}."


def _bill_table(system: SystemAdvice) -> Table:
    def row(item: BillItem, owner: str) -> tuple[str, ...]:
        if item.price is None:
            prices = ("-", "-", "")
        else:
            price = item.price
            prices = (
                f"{price.amount:g} {price.currency}",
                f"{item.amount:.2f} {price.currency}",
                f"{price.source}, {price.date}",
            )
        return owner, item.part, f"{item.count}", item.detail, *prices

    return Table(
        ("for", "part", "count", "detail", "each", "sum", "price from"),
        [
            *(row(item, "site") for item in system.infrastructure),
            *(row(item, "robots") for item in system.robot_parts),
        ],
    )


def _map_panel(task: Task, shown: AccuracyMap) -> Panel:
    """Return the map of the expected errors over the area."""
    every = max(1, -(-len(shown.point_m) // MAX_MAP_POINTS))
    points, error_mm = shown.point_m[::every], 1e3 * shown.error_m[::every]
    is_known = np.isfinite(error_mm)
    outline = np.concatenate([task.corners_m, task.corners_m[:1]])
    figure = Figure()
    figure.add_trace(
        Scatter(
            x=outline[:, 0],
            y=outline[:, 1],
            mode="lines",
            line={"color": MUTED, "width": 1.5},
            name="area",
            hoverinfo="skip",
        )
    )
    if is_known.any():
        figure.add_trace(
            Scatter(
                x=points[is_known, 0],
                y=points[is_known, 1],
                mode="markers",
                name="expected error",
                text=[f"{value:.3g} mm" for value in error_mm[is_known]],
                hovertemplate="%{text}<extra></extra>",
                marker={
                    "color": error_mm[is_known],
                    "colorscale": _colorscale(),
                    "size": 7,
                    "symbol": "square",
                    "colorbar": {"title": {"text": "error, 95 % [mm]", "side": "right"}},
                    **_color_range(error_mm[is_known]),
                },
                showlegend=False,
            )
        )
    if not is_known.all():
        figure.add_trace(
            Scatter(
                x=points[~is_known, 0],
                y=points[~is_known, 1],
                mode="markers",
                name="no position",
                marker={"color": COLORS[1], "size": 6, "symbol": "x"},
            )
        )
    figure.add_trace(
        Scatter(
            x=shown.infrastructure_m[:, 0],
            y=shown.infrastructure_m[:, 1],
            mode="markers",
            name=shown.infrastructure,
            marker={"color": INK, "size": 5 if len(shown.infrastructure_m) > 50 else 11},
        )
    )
    figure.update_layout(**_map_layout(np.concatenate([task.corners_m, shown.infrastructure_m])))
    return Panel(
        "Map of the expected errors",
        f"{shown.infrastructure.capitalize()}: {len(shown.infrastructure_m)}. Colors are position "
        "errors that 95 % of the poses do not exceed.",
        figure=figure,
    )


def _map_layout(points_m: Array) -> dict[str, Any]:
    """Return equal axes over points (n, 2)."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    margin = 0.05 * float((high - low).max())
    low, high = low - margin, high + margin
    height = MAP_WIDTH_PX * float((high[1] - low[1]) / (high[0] - low[0])) + 90
    return {
        "height": round(min(MAX_MAP_HEIGHT_PX, max(MIN_MAP_HEIGHT_PX, height))),
        "xaxis": {
            "title": {"text": "x [m]"},
            "range": [float(low[0]), float(high[0])],
            "constrain": "domain",
        },
        "yaxis": {
            "title": {"text": "y [m]"},
            "range": [float(low[1]), float(high[1])],
            "scaleanchor": "x",
            "scaleratio": 1,
            "constrain": "domain",
        },
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom"},
    }


def _colorscale() -> list[list[object]]:
    last = len(SENSOR_SHADES) - 1
    return [[k / last, shade] for k, shade in enumerate(SENSOR_SHADES)]


def _color_range(error_mm: np.ndarray) -> dict[str, float]:
    """Return the limits of the colors; equal errors get a range around them."""
    low, high = float(error_mm.min()), float(np.quantile(error_mm, 0.98))
    if high - low < 0.05 * high:
        low, high = 0.0, 1.5 * high
    return {"cmin": low, "cmax": high}
