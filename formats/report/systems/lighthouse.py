"""Signals of Lighthouse receivers: rotor angles of sweeps, and sweeps without a pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.solution import Solution
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.diagram_grid import REFUSED, DiagramGrid
from locatk.formats.report.panels import Panel, join_sentences
from locatk.formats.report.signals import DeviceRecording, device_panels
from locatk.formats.report.sweep_outcomes import classify_sweeps
from locatk.formats.report.theme import INK
from locatk.formats.sessions.messages import SWEEPS, BatchError
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]

UNUSED = COLORS[5]
"""Color of sweeps that are not part of an epoch."""

STATION_COLORS = tuple(color for color in COLORS if color not in (REFUSED, UNUSED))

PLANES = ((0, "circle", ", plane 1"), (1, "circle-open", ", plane 2"), (-1, "circle", ""))
"""Index of a light plane (-1 if unknown), the symbol of its sweeps, and its name."""

MIN_BINS, MAX_BINS, MIN_BIN_S = 20, 300, 1.0
"""Number of intervals in which sweeps and poses are counted, and their least duration in a long
recording."""

NOTE = (
    "Rotor angle of each sweep, and numbers of sweeps and poses per second. Crosses are sweeps "
    "that were rejected individually (outliers, repeated or unpaired ones), and sweeps of moments "
    "without a pose."
)


def signal_panels(session: Session, solution: Solution) -> list[Panel]:
    """Return the sweeps of each device; those without a pose are marked."""
    return device_panels(
        session,
        solution,
        title="Sweeps of",
        note=NOTE,
        topic="/lighthouse/",
        schema="locatk.LighthouseSweep",
        decode=_decode_sweeps,
        draw=_draw,
    )


def _decode_sweeps(session: Session, topic: str, payloads: list[bytes]) -> Sweeps:
    """Decode the sweeps of one device on known channels, in order of time."""
    try:
        columns = SWEEPS.unpack(payloads).columns
    except BatchError as error:
        raise FormatError(str(error), file=session.path, where=topic) from None
    order = np.argsort(columns["time_ns"], kind="stable")
    order = order[np.isin(columns["channel"][order], CHANNELS)]
    if not len(order):
        raise FormatError("no sweeps of known channels", file=session.path, where=topic)
    names = ("time_ns", "sensor", "channel", "polynomial", "sweep", "count")
    kept = {name: columns[name][order] for name in names}
    device = topic.removeprefix("/lighthouse/")
    return Sweeps((device,), device=np.zeros(len(order), np.int32), **kept)


def _draw(recording: DeviceRecording[Sweeps]) -> list[Panel]:
    sweeps = recording.samples
    time_s = recording.seconds(sweeps.time_ns)
    angle_deg = np.asarray(sweeps.count / period_counts(sweeps.channel) * 360, np.float64)
    is_valid = np.isfinite(angle_deg) & (angle_deg >= 0) & (angle_deg < 360)
    is_grouped, has_pose = classify_sweeps(sweeps, recording.solution)
    grid = DiagramGrid(2, shared_xaxes=True, row_heights=[0.68, 0.32], vertical_spacing=0.04)
    edges = _bin_edges(time_s)

    def add_marks(kept: NDArray[np.bool_], marker: dict[str, Any], name: str) -> None:
        hover = "%{x:.3f} s: %{y:.2f} deg"
        grid.add_marks(1, time_s[kept], angle_deg[kept], marker, name=name, hovertemplate=hover)

    for k, channel in enumerate(np.unique(sweeps.channel).tolist()):
        color = STATION_COLORS[k % len(STATION_COLORS)]
        of_channel = sweeps.channel == channel
        is_used = of_channel & is_valid & is_grouped & has_pose
        name = f"channel {channel}"
        for plane, symbol, words in PLANES:
            kept = is_used & (sweeps.sweep == plane)
            marker = {"color": color, "size": 4, "symbol": symbol}
            add_marks(kept, marker, name=name + words)
        line = {"color": color, "width": 1.5, "dash": "solid"}
        _add_rate(grid, edges, time_s[of_channel], "sweeps", line, name=name, showlegend=False)
    for kept, name, color in (
        (is_valid & is_grouped & ~has_pose, "no pose", REFUSED),
        (is_valid & ~is_grouped, "rejected", UNUSED),
    ):
        marker = {"color": color, "size": 6, "symbol": "x"}
        add_marks(kept, marker, name=f"{name} ({np.count_nonzero(kept)})")
    device = recording.device
    pose_times_s = [
        recording.seconds(t.time_ns)
        for t in recording.solution.trajectories
        if t.device == device or t.device.startswith(f"{device}/")
    ]
    if pose_times_s:
        line = {"color": INK, "width": 2, "dash": "dot"}
        _add_rate(grid, edges, np.concatenate(pose_times_s), "poses", line, name="poses")
    grid.figure.update_yaxes(rangemode="tozero", row=2, col=1)
    invalid = int(np.count_nonzero(~is_valid))
    note = join_sentences(
        recording.note,
        f"Not drawn: {invalid} sweeps with counts above a rotation." if invalid else "",
        grid.thinning_note,
    )
    return [Panel(recording.title, note, grid.finish(560, ["rotor angle [deg]", "per second"]))]


def _bin_edges(time_s: Array) -> Array:
    """Return the edges of the intervals in which sweeps and poses are counted."""
    first, last = float(time_s[0]), float(time_s[-1])
    bins = int(np.clip((last - first) / MIN_BIN_S, MIN_BINS, MAX_BINS))
    return np.linspace(first, max(last, first + 1e-3), bins + 1)


def _add_rate(
    grid: DiagramGrid, edges: Array, time_s: Array, noun: str, line: dict[str, Any], **trace: Any
) -> None:
    """Add the number of times (n,) per second in each interval as steps."""
    rate = np.histogram(time_s, edges)[0] / np.diff(edges)
    trace["hovertemplate"] = f"%{{x:.1f}} s: %{{y:.1f}} {noun}/s"
    line = {**line, "shape": "hv"}
    grid.add(2, edges, np.append(rate, rate[-1]), mode="lines", line=line, **trace)
