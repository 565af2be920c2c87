"""Hall sensors: the field under the robot over time, and the landmarks that were read in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.solution import Solution
from locatk.formats.plots.time_axis import origin_ns
from locatk.formats.report import detection_tables as seen_text
from locatk.formats.report import signals_drawing as drawing
from locatk.formats.report.figures import label
from locatk.formats.report.panel import Panel
from locatk.formats.report.signals_drawing import Event, envelope
from locatk.formats.report.signals_fields import Fields, each_device
from locatk.formats.sessions.field_samples import HALLS
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]

MOST_VISITS = 6
ROW = 3
"""Visits that are drawn sample by sample, and how many in a row."""

BEFORE_S, AFTER_S = 3.0, 1.5
"""How much is drawn around the time of a sighting, which is near the end of a visit."""

MARK_S = 0.25
"""Half the width of the mark of a sighting, of which only one time is known."""


def panels(session: Session, solution: Solution) -> list[Panel]:
    """The channels of each robot with the landmarks that were read, and some from near."""
    start_ns = origin_ns(session, solution)

    def drawn(device: str, name: str, samples: Fields, notes: Sequence[str]) -> list[Panel]:
        time_s = drawing.seconds(samples.time_ns, start_ns)
        field_mt = 1e3 * samples.field_t
        names = _names(session, device, field_mt.shape[1])
        detections: tuple[LandmarkDetection, ...] = solution.detections
        seen = [each for each in detections if each.device == device]
        events = [_event(each, start_ns) for each in seen]
        whole = _whole(name, time_s, field_mt, names, events, start_ns, notes)
        return [whole, *_near(device, time_s, field_mt, names, seen, events)]

    return each_device(session, solution, HALLS, "Hall sensors of", drawn)


def _names(session: Session, device: str, count: int) -> list[str]:
    """Of the sensors; numbers where they are not told."""
    try:
        sensors = HALLS.attached(session, device)
    except LocatkError:
        sensors = None
    if sensors is None or len(sensors) != count:
        return [f"sensor {k + 1}" for k in range(count)]
    return [label(name) for name in sensors.names]


def _event(found: LandmarkDetection, start_ns: int) -> Event:
    """The time at which a sighting stands, with what was read."""
    at = found.time_s - start_ns * 1e-9
    refused = label(seen_text.words(found.refused))
    cell = seen_text.cell(found.cell)
    what = " ".join(filter(None, (cell, label(found.pattern or ""))))
    hover = "<br>".join(
        [
            f"landmark {what}" if what else "nothing read",
            f"{seen_text.sure(found.probability)} % sure",
            f"residual {seen_text.number(found.residual_sigma, 1, '.2g')} sigma",
            *([f"refused: {refused}"] if refused else []),
        ]
    )
    name = "<br>".join(filter(None, (refused, cell, label(found.pattern or ""))))
    return Event(at - MARK_S, at + MARK_S, name, hover, refused)


def _whole(
    name: str,
    time_s: Array,
    field_mt: NDArray[Any],
    names: list[str],
    events: list[Event],
    start_ns: int,
    notes: Sequence[str],
) -> Panel:
    """The whole recording of one robot."""
    from plotly.subplots import make_subplots

    figure = make_subplots(2, 1, shared_xaxes=True, row_heights=[0.22, 0.78], vertical_spacing=0.02)
    traces = []
    for k, sensor in enumerate(names):
        x, y = envelope(time_s, field_mt[:, k])
        trace = drawing.scatter(
            x, y, 2, mode="lines", name=sensor,
            line={"color": drawing.OTHERS[k % len(drawing.OTHERS)], "width": 1},
            hovertemplate="%{x:.2f} s, %{y:.2f} mT",
        )  # fmt: skip
        traces.append(trace)
    figure.add_traces(traces)
    drawing.strip(figure, events, ("used", "refused"), row=1, rows=(2,))
    figure.update_yaxes(title="upright field [mT]", row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    figure.update_xaxes(range=[float(time_s[0]), float(time_s[-1])])
    drawing.style(figure, 420)
    said = [
        "Above: the landmarks that were seen, row and column on the map and pattern; those that "
        "were refused with the reason."
    ]
    if not events:
        said.append("No landmark was found in it.")
    if len(events) > drawing.MOST_LABELS:
        said.append("Hovering over a mark tells which landmark it was.")
    if len(time_s) > 2 * drawing.COLUMNS:
        said.append("Thinned: each column of the picture shows its largest and smallest value.")
    return Panel(name, " ".join([*said, *notes]), figure)


def _near(
    device: str,
    time_s: Array,
    field_mt: NDArray[Any],
    names: list[str],
    seen: list[LandmarkDetection],
    events: list[Event],
) -> list[Panel]:
    """Some visits, sample by sample."""
    from plotly.subplots import make_subplots

    middle = [(each.start_s + each.stop_s) / 2 for each in events]
    edges = np.searchsorted(time_s, np.add.outer([-BEFORE_S, AFTER_S], middle))
    there = np.flatnonzero(edges[1] - edges[0] > 1).tolist()  # samples of it were read
    seen, events = [seen[k] for k in there], [events[k] for k in there]
    chosen = drawing.telling(
        [each.refused for each in events],
        [each.probability for each in seen],
        MOST_VISITS,
    )
    if not chosen:
        return []
    lines = [events[k].hover.split("<br>") for k in chosen]
    titles = [", ".join(each[:2]) + "<br>" + ", ".join(each[2:]) for each in lines]
    rows = math.ceil(len(chosen) / ROW)
    figure = make_subplots(
        rows, ROW, shared_yaxes=True, horizontal_spacing=0.03, vertical_spacing=0.3 / rows,
        subplot_titles=titles,
    )  # fmt: skip
    traces = []
    for place, number_of in enumerate(chosen):
        event, where = events[number_of], {"row": place // ROW + 1, "col": place % ROW + 1}
        at = (event.start_s + event.stop_s) / 2
        inside = (time_s >= at - BEFORE_S) & (time_s <= at + AFTER_S)
        for k, sensor in enumerate(names):
            x, y = envelope(time_s[inside], field_mt[inside, k])
            trace = drawing.scatter(
                x, y, place // ROW + 1, place % ROW + 1, ROW, mode="lines", name=sensor,
                line={"color": drawing.OTHERS[k % len(drawing.OTHERS)], "width": 1.2},
                legendgroup=sensor, showlegend=place == 0,
                hovertemplate="%{x:.2f} s, %{y:.2f} mT",
            )  # fmt: skip
            traces.append(trace)
        color = drawing.REFUSED if event.refused else drawing.USED
        figure.add_vline(x=at, line={"color": color, "width": 1.5, "dash": "dot"}, **where)
        figure.update_xaxes(title="time [s]" if place >= len(chosen) - ROW else None, **where)
    figure.add_traces(traces)
    for row in range(rows):
        figure.update_yaxes(title="field [mT]", row=row + 1, col=1)
    drawing.style(figure, 90 + 230 * rows, margin_t=60, width=drawing.COLUMN_PX * ROW)
    figure.update_annotations(font_size=11)
    return [
        Panel(
            f"Landmarks of {device} from near",
            drawing.choice(
                len(chosen),
                len(seen),
                "visits",
                "one of each reason of refusal, the least sure one of the others, and the surest",
            )
            + " The dotted line is the time of the sighting.",
            figure,
        )
    ]
