"""Magnetometer arrays: the field along the bar over time, and the tags that were read in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.polaris.results import TagDetection
from locatk.core.solution import Solution
from locatk.formats.plots.time_axis import origin_ns
from locatk.formats.report import detection_tables as seen_text
from locatk.formats.report import signals_drawing as drawing
from locatk.formats.report.detection_tables import words
from locatk.formats.report.figures import label
from locatk.formats.report.panel import Panel
from locatk.formats.report.signals_drawing import Event, envelope, number, short
from locatk.formats.report.signals_fields import Fields, each_device
from locatk.formats.sessions.field_samples import MAGNETOMETERS
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]

MOST_PASSES = 3
"""Passes that are drawn sample by sample."""

BESIDE = 0.5
"""Of the length of a pass: how much is drawn before and after it."""

AXES = ("x, forward", "y, left", "z, up")

MANY = 300
"""Magnets from which on their marks are small."""

REACH_M = 0.02
"""How far around a magnet its field is felt: about two clearances."""


def panels(session: Session, solution: Solution) -> list[Panel]:
    """The field of each array with the tags that were read, and some passes from near."""

    def drawn(device: str, name: str, samples: Fields, notes: Sequence[str]) -> list[Panel]:
        bar = _Bar(session, device, samples, origin_ns(session, solution))
        detections: tuple[TagDetection, ...] = solution.detections
        seen = [each for each in detections if each.device == device]
        return [_whole(name, bar, seen, notes), *_near(device, bar, seen)]

    return each_device(session, solution, MAGNETOMETERS, "Magnetic field along", drawn)


class _Bar:
    """Samples of one array as they are drawn: seconds, and uT less each sensor's median."""

    def __init__(self, session: Session, device: str, samples: Fields, start_ns: int) -> None:
        self.start_ns = start_ns
        self.time_s = drawing.seconds(samples.time_ns, self.start_ns)
        field = samples.field_t.reshape(len(samples.time_ns), -1, 3)
        usual = np.zeros(field.shape[1:], np.float32)
        alive = np.isfinite(field).any(axis=0)
        usual[alive] = np.nanmedian(field[:, alive], axis=0)
        self.field_ut = 1e6 * (field - usual)
        count = field.shape[1]
        self.across_mm = _across_mm(session, device, count)
        self.placed = self.across_mm is not None
        if self.across_mm is None:
            self.across_mm = np.arange(1.0, count + 1)
        self.order = np.argsort(self.across_mm, kind="stable")

    def label(self, sensor: int) -> str:
        """Of one sensor; from 1, as in the notes of the solver."""
        if not self.placed:
            return f"sensor {sensor + 1}"
        assert self.across_mm is not None
        return f"{sensor + 1} ({_signed(self.across_mm[sensor])} mm)"

    def colors(self) -> list[str]:
        """From the rightmost to the leftmost sensor; without the yellow that is not seen on
        white."""
        from plotly.colors import sample_colorscale

        shades = sample_colorscale("Viridis", np.linspace(0, 0.88, max(len(self.order), 2)))
        by_sensor = dict(zip(self.order.tolist(), shades, strict=False))
        return [by_sensor[k] for k in range(len(self.order))]


def _signed(value: float) -> str:
    return f"{value:+.0f}" if round(value) else "0"


def _across_mm(session: Session, device: str, count: int) -> Array | None:
    """Where the sensors sit across the bar, positive to the left; None where not known."""
    try:
        array = MAGNETOMETERS.attached(session, device)
    except LocatkError:
        return None
    return None if array is None or len(array) != count else 1e3 * array.position_m[:, 1]


def _event(found: TagDetection, start_ns: int) -> Event:
    """When a tag was passed, as the mean speed of the pass tells."""
    at = found.time_s - start_ns * 1e-9
    times = [at, *(_passed_s(found, at))]
    speed = number(found.speed_mps)
    reach = REACH_M / speed if speed > 0 else 0.0
    refused = label(words(found.refused))
    tag = f"tag {found.tag_id}" if found.tag_id is not None else f"not read: {refused}"
    margin = seen_text.number(found.margin, 1, ".2f")
    hover = "<br>".join(
        [
            tag,
            f"margin {margin} steps",
            f"{len(found.magnets)} magnets",
            f"residual {seen_text.number(found.residual_sigma, 1, '.2g')} sigma",
            f"speed {seen_text.number(found.speed_mps, 1e3, '.0f')} mm/s",
        ]
    )
    name = refused
    if found.tag_id is not None:
        name = f"{found.tag_id} ({margin})"
    return Event(min(times) - reach, max(times) + reach, name, hover, refused)


def _passed_s(found: TagDetection, at: float) -> list[float]:
    """When each magnet was passed."""
    speed = number(found.speed_mps)
    if not speed > 0:
        return []
    return [at + each.x_m / speed for each in found.magnets]


def _whole(name: str, bar: _Bar, seen: list[TagDetection], notes: Sequence[str]) -> Panel:
    """The whole recording of one array: what was read, sensors over time, lines."""
    from plotly.subplots import make_subplots

    events = [_event(each, bar.start_ns) for each in seen]
    figure = make_subplots(
        3, 1, shared_xaxes=True, row_heights=[0.1, 0.45, 0.45], vertical_spacing=0.03
    )
    strength = np.sqrt(np.sum(bar.field_ut**2, axis=2))
    thinned = _add_map(figure, bar, strength, seen)
    lines = [envelope(bar.time_s, strength[:, k]) for k in range(strength.shape[1])]
    traces = [
        drawing.scatter(
            *lines[k], 3, mode="lines", line={"color": color, "width": 1}, name=bar.label(k),
            hovertemplate="%{x:.2f} s, %{y:.1f} µT",
        )
        for k, color in enumerate(bar.colors())
    ]  # fmt: skip
    figure.add_traces(traces)
    drawing.strip(figure, events, ("read", "not read"), row=1, rows=(3,))
    figure.update_yaxes(title="across the bar [mm]" if bar.placed else "sensor", row=2, col=1)
    figure.update_yaxes(title="field [µT]", rangemode="tozero", row=3, col=1)
    figure.update_xaxes(title="time [s]", row=3, col=1)
    figure.update_xaxes(range=[float(bar.time_s[0]), float(bar.time_s[-1])])
    drawing.style(figure, 620, legend_traceorder="reversed", legend_y=0.44)
    said = [
        "Size of the field at each sensor, less the sensor's median. Above: tags that were read, "
        "with their margin in steps of orientation, and passes that were not, with the reason. "
        "Circles are magnets as they were found, drawn where the mean speed of the pass puts "
        "them."
    ]
    if not seen:
        said.append("Nothing was found in it.")
    if not bar.placed:
        said.append("Where the sensors sit is not known: they are numbered.")
    if thinned:
        said.append("Thinned: each column of the picture shows its largest and smallest value.")
    return Panel(name, " ".join([*said, *notes]), figure)


def _add_map(figure: Any, bar: _Bar, strength: NDArray[Any], seen: list[TagDetection]) -> bool:
    """Sensors over time; whether columns had to be taken together."""
    assert bar.across_mm is not None
    n = len(bar.time_s)
    run = math.ceil(n / drawing.COLUMNS)
    starts = np.arange(0, n, run)
    largest = np.fmax.reduceat(strength, starts, axis=0)[:, bar.order]
    time_s, largest = _with_gaps(bar.time_s[starts], largest)
    figure.add_heatmap(
        x=short(time_s),
        y=short(bar.across_mm[bar.order]),
        z=short(largest.T),
        zmin=0,
        zmax=float(np.nanpercentile(largest, 99.5)) if np.isfinite(largest).any() else 1.0,
        colorscale="Greys",
        colorbar={"title": {"text": "µT"}, "len": 0.4, "y": 0.69, "x": 1.01, "thickness": 12},
        hovertemplate="%{x:.2f} s, %{y:.0f} mm: %{z:.1f} µT<extra></extra>",
        row=2,
        col=1,
    )
    for refused, color in ((False, drawing.USED), (True, drawing.REFUSED)):
        mine = [each for each in seen if (each.tag_id is None) == refused]
        marks = [
            (at, 1e3 * magnet.y_m)
            for each in mine
            for at, magnet in zip(
                _passed_s(each, each.time_s - bar.start_ns * 1e-9), each.magnets, strict=False
            )
        ]
        x, y = np.array(marks or np.zeros((0, 2))).T
        finite = np.isfinite(x + y)
        x, y = x[finite], y[finite]
        if len(x) and bar.placed:
            kept = drawing.one_a_pixel(x, y)
            circles = drawing.scatter(
                x[kept], y[kept], 2, mode="markers", hoverinfo="skip",
                marker={
                    "symbol": "circle-open", "color": color, "size": 9 if len(x) < MANY else 4,
                    "line": {"width": 2 if len(x) < MANY else 1},
                },
                name="magnets, tag not read" if refused else "magnets of tags",
            )  # fmt: skip
            figure.add_traces([circles])
    return run > 1


def _is_in(bar: _Bar, event: Event) -> bool:
    """Whether samples of a pass were read."""
    first, stop = np.searchsorted(bar.time_s, (event.start_s, event.stop_s))
    return bool(stop - first > 1)


def _with_gaps(time_s: Array, columns: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """Columns of a map with empty ones where samples are missing: it would fill the gap."""
    if len(time_s) < 3:
        return time_s, columns
    step = float(np.median(np.diff(time_s)))
    gaps = np.flatnonzero(np.diff(time_s) > drawing.GAP * step) + 1
    at = np.repeat(gaps, 2)
    edges = np.column_stack([time_s[gaps - 1] + step, time_s[gaps] - step]).ravel()
    return np.insert(time_s, at, edges), np.insert(columns, at, np.nan, axis=0)


def _near(device: str, bar: _Bar, seen: list[TagDetection]) -> list[Panel]:
    """Some passes, each axis by itself, sample by sample."""
    from plotly.subplots import make_subplots

    seen = [each for each in seen if _is_in(bar, _event(each, bar.start_ns))]
    chosen = drawing.telling(
        [each.refused or "" for each in seen],
        [number(each.margin) for each in seen],
        MOST_PASSES,
    )
    if not chosen:
        return []
    events = [_event(seen[k], bar.start_ns) for k in chosen]
    figure = make_subplots(
        3, len(events), shared_xaxes="columns", shared_yaxes="rows",
        horizontal_spacing=0.03, vertical_spacing=0.04,
        subplot_titles=[each.hover.replace("<br>", ", ").split(", residual")[0] for each in events],
    )  # fmt: skip
    traces = []
    for column, event in enumerate(events, 1):
        beside = BESIDE * max(event.stop_s - event.start_s, 0.1)
        inside = (bar.time_s >= event.start_s - beside) & (bar.time_s <= event.stop_s + beside)
        time_s, field = bar.time_s[inside], bar.field_ut[inside]
        for k, color in enumerate(bar.colors()):
            for axis in range(3):
                x, y = envelope(time_s, field[:, k, axis])
                trace = drawing.scatter(
                    x, y, axis + 1, column, len(events), mode="lines",
                    line={"color": color, "width": 1}, name=bar.label(k), legendgroup=str(k),
                    showlegend=column == 1 and axis == 0,
                    hovertemplate="%{x:.2f} s, %{y:.1f} µT",
                )  # fmt: skip
                traces.append(trace)
        figure.update_xaxes(title="time [s]", row=3, col=column)
    figure.add_traces(traces)
    for axis, what in enumerate(AXES):
        figure.update_yaxes(title=f"{what} [µT]", row=axis + 1, col=1)
    width = drawing.COLUMN_PX * len(events) if len(events) > 1 else None
    drawing.style(figure, 560, legend_traceorder="reversed", margin_t=44, width=width)
    figure.update_annotations(font_size=11)
    return [
        Panel(
            f"Passes of {device} from near",
            "The field's axes, less their medians, while a tag was passed. "
            + drawing.choice(
                len(events),
                len(seen),
                "passes",
                "one of each reason why tags were not read, the least sure one that was, and the "
                "surest",
            )
            + " Sensors are named by where they sit across the bar, left is positive.",
            figure,
        )
    ]
