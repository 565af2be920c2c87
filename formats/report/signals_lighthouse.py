"""Lighthouse sweeps: the angles of each station over time, and moments that gave no pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.epochs import Epochs, group_epochs
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.solution import Solution
from locatk.formats.plots.ground import COLORS
from locatk.formats.plots.time_axis import origin_ns
from locatk.formats.report import signals_drawing as drawing
from locatk.formats.report.panel import Panel
from locatk.formats.report.signals_drawing import one_a_pixel
from locatk.formats.report.signals_reading import MOST_DEVICES, excerpt
from locatk.formats.sessions.messages import SWEEPS, BatchError
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]

TOPIC, SCHEMA = "/lighthouse/", "locatk.LighthouseSweep"

LEFT_OUT = COLORS[5]

STATIONS = tuple(color for color in COLORS if color not in (drawing.REFUSED, LEFT_OUT))

ROUNDING_NS = 2

MEANING = (
    "Angle of the rotor at each sweep, and how many sweeps and poses there were in a second. "
    "Crosses are sweeps that were left out by themselves (spikes, repeated or unpaired ones), "
    "and those of moments that gave no pose."
)
"""Told once, of the first device."""

FEWEST_BINS, MOST_BINS = 20, 300
"""In how many parts of the time sweeps are counted; of a second and more each."""


def panels(session: Session, solution: Solution) -> list[Panel]:
    """Sweeps of each device with the moments that gave no pose."""
    topics = session.topics(TOPIC, SCHEMA)
    read = excerpt(session, topics[:MOST_DEVICES])
    devices = [topic.removeprefix(TOPIC) for topic in topics]
    notes = [MEANING, *read.notes, *drawing.strangers(solution, devices)]
    if len(devices) > MOST_DEVICES:
        notes.append(f"Not drawn: {drawing.listed(devices[MOST_DEVICES:])}.")
    found: list[Panel] = []  # the first of them tells the notes
    for topic, payloads in read.payloads.items():
        device = topic.removeprefix(TOPIC)
        name = f"Sweeps of {device}"
        try:
            sweeps = _sweeps(session, topic, device, payloads)
        except FormatError as error:
            found.append(Panel(name, " ".join([f"Not drawn: {error.message}.", *notes])))
            notes = []
            continue
        found.append(_panel(name, session, solution, sweeps, notes))
        notes = ["Drawn as above."]
    return found


def _sweeps(session: Session, topic: str, device: str, payloads: list[bytes]) -> Sweeps:
    """Of one device, in order of time."""
    try:
        columns = SWEEPS.unpack(payloads).columns
    except BatchError as error:
        raise FormatError(str(error), file=session.path, where=topic) from None
    order = np.argsort(columns["time_ns"], kind="stable")
    named = ("time_ns", "sensor", "channel", "polynomial", "sweep", "count")
    sorted_columns = {name: columns[name][order] for name in named}
    known = np.isin(sorted_columns["channel"], CHANNELS)
    kept = {name: column[known] for name, column in sorted_columns.items()}
    if not len(kept["time_ns"]):
        raise FormatError("no sweeps of known channels", file=session.path, where=topic)
    return Sweeps((device,), device=np.zeros(np.count_nonzero(known), np.int32), **kept)


def _used(sweeps: Sweeps, solution: Solution) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which sweeps the solver's moments hold, and which belong to a moment that has a pose."""
    epochs = group_epochs(sweeps)
    held, posed = np.zeros(len(sweeps), bool), np.zeros(len(sweeps), bool)
    poses = {each.device: each.time_ns for each in solution.trajectories}
    column = np.searchsorted(epochs.channels, sweeps.channel)
    known = np.isin(sweeps.channel, epochs.channels)
    for k, name in enumerate(epochs.devices):
        moments = np.flatnonzero(epochs.device == k)
        if not len(moments):
            continue
        moments = moments[np.argsort(epochs.time_ns[moments])]
        times = epochs.time_ns[moments]
        sensor = name.removeprefix(f"{sweeps.devices[0]}/")
        mine = known if name == sweeps.devices[0] else known & (sweeps.sensor == int(sensor))
        # The nearest moment is the one that it is part of.
        at = np.searchsorted(times[:-1] + np.diff(times) // 2, sweeps.time_ns[mine])
        held[mine] = _held(epochs, moments[at], column[mine], sweeps.count[mine])
        posed[mine] = _among(times[at], poses.get(name, times[:0]))
    return held, posed


def _among(time_ns: NDArray[np.int64], poses_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which moments are those of poses. Means of several times may be rounded another way."""
    if not len(poses_ns):
        return np.zeros(len(time_ns), bool)
    middles = poses_ns[:-1] + np.diff(poses_ns) // 2
    nearest = poses_ns[np.searchsorted(middles, time_ns)]
    return np.abs(nearest - time_ns) <= ROUNDING_NS


def _held(
    epochs: Epochs, moment: NDArray[np.int64], column: NDArray[np.int64], count: Array
) -> NDArray[np.bool_]:
    """Which sweeps of these moments and stations are in them: to each count that a moment holds
    belongs the nearest sweep. (It need not be the same: it was moved to the middle.)"""
    held = np.zeros(len(count), bool)
    place = moment * len(epochs.channels) + column
    for plane in range(2):
        away = np.abs(epochs.counts[moment, column, plane] - count)
        order = np.lexsort((away, place))  # nan is sorted to the end
        first = order[np.diff(place[order], prepend=-1) != 0]
        held[first[np.isfinite(away[first])]] = True
    return held


def _panel(
    name: str, session: Session, solution: Solution, sweeps: Sweeps, notes: list[str]
) -> Panel:
    from plotly.subplots import make_subplots

    start = origin_ns(session, solution)
    time_s = drawing.seconds(sweeps.time_ns, start)
    degrees = np.asarray(sweeps.count / period_counts(sweeps.channel) * 360, np.float64)
    inside = np.isfinite(degrees) & (degrees >= 0) & (degrees < 360)
    held, posed = _used(sweeps, solution)
    figure = make_subplots(2, 1, shared_xaxes=True, row_heights=[0.68, 0.32], vertical_spacing=0.04)
    thinned = False
    edges = _edges(time_s)
    channels = np.unique(sweeps.channel).tolist()
    for k, channel in enumerate(channels):
        color = STATIONS[k % len(STATIONS)]
        here = sweeps.channel == channel
        for plane, symbol, words in _PLANES:
            mine = np.flatnonzero(here & inside & held & posed & (sweeps.sweep == plane))
            if len(mine):
                thinned |= _marks(
                    figure, time_s[mine], degrees[mine], f"channel {channel}{words}",
                    {"color": color, "size": 4, "symbol": symbol},
                )  # fmt: skip
        count = np.histogram(time_s[here], edges)[0] / np.diff(edges)
        rate = drawing.scatter(
            edges, np.append(count, count[-1]), 2, mode="lines",
            line={"color": color, "width": 1.5, "shape": "hv"},
            name=f"channel {channel}", showlegend=False,
            hovertemplate="%{x:.1f} s: %{y:.1f} sweeps a second",
        )  # fmt: skip
        figure.add_traces([rate])
    for left, words, color in (
        (held & ~posed, "no pose", drawing.REFUSED),
        (~held, "left out", LEFT_OUT),
    ):
        mine = np.flatnonzero(inside & left)
        if len(mine):
            thinned |= _marks(
                figure, time_s[mine], degrees[mine], f"{words} ({len(mine)})",
                {"color": color, "size": 6, "symbol": "x"},
            )  # fmt: skip
    _poses(figure, solution, sweeps.devices[0], start, edges)
    figure.update_yaxes(title="rotor angle [deg]", row=1, col=1)
    figure.update_yaxes(title="a second", rangemode="tozero", row=2, col=1)
    figure.update_xaxes(title="time [s]", row=2, col=1)
    drawing.style(figure, 560)
    said = []
    if outside := int(np.count_nonzero(~inside)):
        said.append(f"Not drawn: {outside} sweeps with counts longer than a rotation.")
    if thinned:
        said.append("Thinned: where marks would hide each other one is drawn.")
    return Panel(name, " ".join([*notes, *said]), figure)


_PLANES = ((0, "circle", ", plane 1"), (1, "circle-open", ", plane 2"), (-1, "circle", ""))


def _marks(figure: Any, time_s: Array, degrees: Array, name: str, marker: dict[str, Any]) -> bool:
    """Draw sweeps; whether some of them were left out."""
    kept = one_a_pixel(time_s, degrees)
    marks = drawing.scatter(
        time_s[kept], degrees[kept], 1, mode="markers", marker=marker,
        name=name, hovertemplate="%{x:.3f} s: %{y:.2f} deg",
    )  # fmt: skip
    figure.add_traces([marks])
    return len(kept) < len(time_s)


def _edges(time_s: Array) -> Array:
    """Parts of the time in which sweeps are counted."""
    first, last = float(time_s[0]), float(time_s[-1])
    bins = int(np.clip((last - first) / 1.0, FEWEST_BINS, MOST_BINS))
    return np.linspace(first, max(last, first + 1e-3), bins + 1)


def _poses(figure: Any, solution: Solution, device: str, start_ns: int, edges: Array) -> None:
    times = [
        drawing.seconds(each.time_ns, start_ns)
        for each in solution.trajectories
        if each.device == device or each.device.startswith(f"{device}/")
    ]
    if not times:
        return
    count = np.histogram(np.concatenate(times), edges)[0] / np.diff(edges)
    rate = drawing.scatter(
        edges, np.append(count, count[-1]), 2, mode="lines", name="poses",
        line={"color": "#222", "width": 2, "shape": "hv", "dash": "dot"},
        hovertemplate="%{x:.1f} s: %{y:.1f} poses a second",
    )  # fmt: skip
    figure.add_traces([rate])
