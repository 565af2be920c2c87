"""Signals of Lighthouse receivers: rotor angles of sweeps, and sweeps without a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.epochs import Epochs, group_epochs
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.solution import Solution
from locatk.formats.plots.series import origin_ns
from locatk.formats.plots.shapes import COLORS
from locatk.formats.report.diagrams import MARKS_THINNED, REFUSED, Diagrams
from locatk.formats.report.panels import Panel, join_sentences
from locatk.formats.report.signals import SignalSource, device_panels, seconds_since
from locatk.formats.sessions.messages import SWEEPS, BatchError
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNUSED = COLORS[5]
"""Color of sweeps that are not part of a moment."""

STATION_COLORS = tuple(color for color in COLORS if color not in (REFUSED, UNUSED))

PLANES = ((0, "circle", ", plane 1"), (1, "circle-open", ", plane 2"), (-1, "circle", ""))
"""Index of a light plane (-1 if unknown), the symbol of its sweeps, and its name."""

MAX_ROUNDING_NS = 2
"""Difference between the time of a moment and of its pose; both are means of several times."""

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

    def draw(device: str, title: str, sweeps: Sweeps, note: str) -> list[Panel]:
        return [_draw_sweeps(title, sweeps, solution, origin_ns(session, solution), note)]

    source = SignalSource(
        "Sweeps of", "/lighthouse/", "locatk.LighthouseSweep", _decode_sweeps, draw, NOTE
    )
    return device_panels(session, solution, source)


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


def _draw_sweeps(title: str, sweeps: Sweeps, solution: Solution, start_ns: int, note: str) -> Panel:
    time_s = seconds_since(sweeps.time_ns, start_ns)
    angle_deg = np.asarray(sweeps.count / period_counts(sweeps.channel) * 360, np.float64)
    is_valid = np.isfinite(angle_deg) & (angle_deg >= 0) & (angle_deg < 360)
    is_grouped, has_pose = _classify(sweeps, solution)
    diagrams = Diagrams(2, shared_xaxes=True, row_heights=[0.68, 0.32], vertical_spacing=0.04)

    def mark(selected: Mask, name: str, color: str, size: int, symbol: str) -> None:
        if selected.any():
            diagrams.add_marks(
                1,
                time_s[selected],
                angle_deg[selected],
                marker={"color": color, "size": size, "symbol": symbol},
                name=name,
                hovertemplate="%{x:.3f} s: %{y:.2f} deg",
            )

    edges = _bin_edges(time_s)
    for k, channel in enumerate(np.unique(sweeps.channel).tolist()):
        color = STATION_COLORS[k % len(STATION_COLORS)]
        of_channel = sweeps.channel == channel
        for plane, symbol, words in PLANES:
            used = of_channel & is_valid & is_grouped & has_pose & (sweeps.sweep == plane)
            mark(used, f"channel {channel}{words}", color, 4, symbol)
        diagrams.add_steps(
            2,
            edges,
            np.histogram(time_s[of_channel], edges)[0] / np.diff(edges),
            color,
            1.5,
            name=f"channel {channel}",
            showlegend=False,
            hovertemplate="%{x:.1f} s: %{y:.1f} sweeps/s",
        )
    for selected, name, color in (
        (is_valid & is_grouped & ~has_pose, "no pose", REFUSED),
        (is_valid & ~is_grouped, "rejected", UNUSED),
    ):
        mark(selected, f"{name} ({np.count_nonzero(selected)})", color, 6, "x")
    _add_pose_rate(diagrams, solution, sweeps.devices[0], start_ns, edges)
    diagrams.figure.update_yaxes(rangemode="tozero", row=2, col=1)
    invalid = int(np.count_nonzero(~is_valid))
    return Panel(
        title,
        join_sentences(
            note,
            f"Not drawn: {invalid} sweeps with counts above a rotation." if invalid else "",
            MARKS_THINNED if diagrams.has_thinned_marks else "",
        ),
        diagrams.finish(560, ["rotor angle [deg]", "per second"]),
    )


def _bin_edges(time_s: Array) -> Array:
    """Return the edges of the intervals in which sweeps and poses are counted."""
    first, last = float(time_s[0]), float(time_s[-1])
    bins = int(np.clip((last - first) / MIN_BIN_S, MIN_BINS, MAX_BINS))
    return np.linspace(first, max(last, first + 1e-3), bins + 1)


def _add_pose_rate(
    diagrams: Diagrams, solution: Solution, device: str, start_ns: int, edges: Array
) -> None:
    times = [
        seconds_since(t.time_ns, start_ns)
        for t in solution.trajectories
        if t.device == device or t.device.startswith(f"{device}/")
    ]
    if times:
        diagrams.add_steps(
            2,
            edges,
            np.histogram(np.concatenate(times), edges)[0] / np.diff(edges),
            "#222",
            2,
            dash="dot",
            name="poses",
            hovertemplate="%{x:.1f} s: %{y:.1f} poses/s",
        )


# ---- the moment of each sweep


def _classify(sweeps: Sweeps, solution: Solution) -> tuple[Mask, Mask]:
    """Return masks (n,) of the sweeps that are part of a moment, and whose moment has a pose."""
    epochs = group_epochs(sweeps)
    is_grouped, has_pose = np.zeros(len(sweeps), bool), np.zeros(len(sweeps), bool)
    poses_ns = {t.device: t.time_ns for t in solution.trajectories}
    column = np.searchsorted(epochs.channels, sweeps.channel)
    is_known = np.isin(sweeps.channel, epochs.channels)
    for index, name in enumerate(epochs.devices):
        moments = np.flatnonzero(epochs.device == index)
        if not len(moments):
            continue
        moments = moments[np.argsort(epochs.time_ns[moments])]
        times_ns = epochs.time_ns[moments]
        selected = is_known
        if name != sweeps.devices[0]:
            sensor = int(name.removeprefix(f"{sweeps.devices[0]}/"))
            selected = is_known & (sweeps.sensor == sensor)
        nearest = _nearest(times_ns, sweeps.time_ns[selected])
        is_grouped[selected] = _is_in_moment(
            epochs, moments[nearest], column[selected], sweeps.count[selected]
        )
        poses = poses_ns.get(name, times_ns[:0])
        if len(poses):
            moment_ns = times_ns[nearest]
            difference_ns = np.abs(poses[_nearest(poses, moment_ns)] - moment_ns)
            has_pose[selected] = difference_ns <= MAX_ROUNDING_NS
    return is_grouped, has_pose


def _nearest(ascending: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the element of ``ascending`` (m,) that is nearest to each value (n,)."""
    return np.searchsorted(ascending[:-1] + np.diff(ascending) // 2, values)


def _is_in_moment(
    epochs: Epochs, moment: NDArray[np.int64], column: NDArray[np.int64], count: Array
) -> Mask:
    """Return which sweeps are those of their moment and station.

    They are the sweeps nearest to its counts; the counts of a moment are interpolated to its time
    and therefore differ from those of its sweeps.
    """
    is_member = np.zeros(len(count), bool)
    cell = moment * len(epochs.channels) + column
    for plane in range(2):
        distance = np.abs(epochs.counts[moment, column, plane] - count)
        order = np.lexsort((distance, cell))  # nan is sorted to the end.
        nearest = order[np.diff(cell[order], prepend=-1) != 0]
        is_member[nearest[np.isfinite(distance[nearest])]] = True
    return is_member
