"""Search for the start of a frame in a stream of float32 without any markers.

A frame is x, y, z of each sensor in microtesla, little-endian, one frame after the other. Its
start follows from these facts:

* floats of a field have few exponents: bytes that are off by one are no plausible fields;
* sensors have offsets of tens of microtesla: a value is close to that of the previous frame;
* a field is an integer number of counts, and the count of the MLX90393's Z is larger than that
  of its X and Y, so that each float is checked, and Z is distinguished from X and Y;
* no value identifies the first sensor. The line is silent before a frame; without such pauses
  the first byte of the connection is assumed to be the start of a frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from locatk.formats.devices.float32.frame_matching import (
    MAX_ADC_COUNTS,
    MIN_QUANTUM_DIFFERENCE,
    UNSHIFTED_COST_BONUS,
    WRONG_VALUE_COST,
    Array,
    Floats,
    FrameLayout,
    FrameModel,
    is_plausible,
    rounding_tolerance,
)

MIN_QUANTUM_UT = 0.05
"""Lower limit of a count (smallest count of the MLX90393: 0.15)."""

MAX_QUANTUM_CANDIDATES = 6
"""Smallest steps between values that are tested to be a count."""

MAX_COUNT_STEPS = 300
"""Steps used to estimate a count; more counts than that could be off by one."""

MAX_STEP_UT = 20.0
"""Difference between the same value of two frames, in most cases, before noise is known."""

MIN_RUN_FRAMES = 6
"""Consecutive frames from which a stream is recognized."""

DECISION_FRAMES = 32
"""Frames after which the first byte decides on the start of a frame, if no pauses do."""

MIN_AGREEING_PAUSES, MIN_PAUSE_RATIO, MIN_PAUSE_FRACTION = 3, 3, 0.4
"""Pauses that must agree on a start: their number, their ratio to those of any other start, and
their fraction of all pauses."""


@dataclass(frozen=True)
class Acquisition:
    """Result of the search.

    Attributes
    ----------
    model : FrameModel
    start : int
        Byte of the window at which a frame starts.
    assumption : str
        Key of the remark on an assumption; ``""`` if there is none.
    """

    model: FrameModel
    start: int
    assumption: str = ""


@np.errstate(all="ignore")  # Any bytes are floats; many of them are NaN.
def acquire(
    window: bytes,
    pauses: Sequence[int],
    layouts: Sequence[FrameLayout],
    *,
    first: int | None,
    hint: FrameModel | None,
    least: int,
    decide: bool,
) -> Acquisition | None:
    """Find the start of frames in the first bytes of a stream.

    Parameters
    ----------
    window : bytes
    pauses : sequence of int
        Bytes of the window before which the line was silent.
    layouts : sequence of FrameLayout
        Possible layouts, the longest first; the others are parts of it.
    first : int or None
        Byte at which the device began to send, if it is known.
    hint : FrameModel or None
        Model before a reconnect.
    least : int
        Required number of consecutive frames.
    decide : bool
        Decide with the data available.

    Returns
    -------
    Acquisition or None
        None if there are no frames, or more data are needed.
    """
    run = find_run(window, layouts[0].floats, least)
    if run is None:
        return None
    begin, values = run
    if len(values) >= (least + 2) * layouts[0].floats:
        # The ends of the run may be damaged.
        begin += layouts[0].size
        values = values[layouts[0].floats : -layouts[0].floats]
    inside = [p - begin for p in pauses if begin <= p < begin + 4 * len(values)]
    layout, is_layout_doubtful = _choose_layout(values, layouts, inside)
    frames = values[: len(values) // layout.floats * layout.floats].reshape(-1, layout.floats)
    if (frames.view(np.uint32) == frames.view(np.uint32)[0, 0]).all():
        return None
    quanta = _possible_starts(frames, layout)
    starts = list(quanta)
    model = _learn_model(frames, layout)
    start, assumption = None, ""
    if len(starts) == 1:
        start = starts[0]
    else:
        positions = [-1 if p % 4 else p // 4 % layout.floats for p in inside]
        start = majority_position(
            [position if position in quanta else -1 for position in positions]
        )
        if start is None and hint is not None and hint.layout == layout:
            start = _start_by_hint(model, hint, starts)
    is_certain = start is not None and quanta[start][:3].all()
    if not (is_certain or decide or len(frames) >= DECISION_FRAMES):
        return None
    if start is None:
        start, assumption = _start_by_first_byte(model, window, begin, first, starts)
        if is_layout_doubtful:
            assumption = "alike"
    model = replace(model.shifted(start), quantum=quanta[start], is_unambiguous=len(starts) == 1)
    ignored = model.is_impossible(np.roll(frames, -start, axis=1)).mean(axis=0) > 0.5
    ignored[3 * layout.sensors :] = True
    return Acquisition(replace(model, ignored=ignored), begin + 4 * start, assumption)


def majority_position(positions: Sequence[int]) -> int | None:
    """Return the position on which clearly most pauses agree; None if there is none.

    Negative positions are impossible starts; they count as disagreement.
    """
    ranked = Counter(position for position in positions if position >= 0).most_common(2)
    if not ranked or ranked[0][1] < max(MIN_AGREEING_PAUSES, MIN_PAUSE_FRACTION * len(positions)):
        return None
    if len(ranked) > 1 and ranked[0][1] < MIN_PAUSE_RATIO * ranked[1][1]:
        return None
    return ranked[0][0]


@np.errstate(all="ignore")
def find_run(window: bytes, period: int, least: int) -> tuple[int, Floats] | None:
    """Return the longest run of plausible floats that are close to those a period before.

    Parameters
    ----------
    window : bytes
    period : int
        Floats per frame.
    least : int
        Required number of periods.

    Returns
    -------
    (int, ndarray) or None
        First byte of the run, and its floats.
    """
    best: tuple[int, Floats] | None = None
    for shift in range(4):
        if len(window) - shift < 4 * least * period:
            continue
        values = np.frombuffer(window, "<f4", (len(window) - shift) // 4, shift)
        plausible = is_plausible(values)
        is_near = np.abs(values[period:] - values[:-period]) <= MAX_STEP_UT
        is_near |= np.isnan(values[period:]) & np.isnan(values[:-period])
        is_near &= plausible[period:] & plausible[:-period]
        total = np.concatenate([[0], np.cumsum(is_near)])
        in_run = 3 * (total[period:] - total[:-period]) >= 2 * period
        padded = np.concatenate([[False], in_run, [False]]).astype(np.int8)
        edges = np.flatnonzero(np.diff(padded))
        if not len(edges):
            continue
        begins, ends = edges[::2], edges[1::2]
        longest = int(np.argmax(ends - begins))
        count = int(ends[longest] - begins[longest]) + 2 * period - 1
        if count >= least * period and (best is None or count > len(best[1])):
            begin = int(begins[longest])
            best = shift + 4 * begin, values[begin : begin + count]
    return best


def _choose_layout(
    values: Floats, layouts: Sequence[FrameLayout], pauses: Sequence[int]
) -> tuple[FrameLayout, bool]:
    """Return the layout of the frames, and whether it is doubtful.

    A frame of the longest layout may be several frames of a shorter one.
    """
    longest = layouts[0]
    frames = values[: len(values) // longest.floats * longest.floats].reshape(-1, longest.floats)
    median = np.median(frames, axis=0)
    tolerance = 1.5 * _spread(frames)

    def repeats(lag: int) -> bool:
        return bool(np.mean(np.abs(np.nan_to_num(median - np.roll(median, lag)))) <= tolerance)

    for layout in layouts[1:]:
        if repeats(layout.floats):
            # If all sensors measure the same field, values cannot tell their number.
            if not repeats(3):
                return layout, False
            agreed = majority_position([p % longest.size for p in pauses])
            if len(pauses) < MIN_AGREEING_PAUSES or agreed is not None:
                return longest, True
            return layout, majority_position([p % layout.size for p in pauses]) is None
    return longest, False


def _possible_starts(frames: Floats, layout: FrameLayout) -> dict[int, Array]:
    """Return the floats of rows at which a frame may start, with the counts of its floats."""
    size, used = layout.floats, 3 * layout.sensors
    if not layout.spare:
        by_axis = np.array([_estimate_quantum(frames[:, axis::3]) for axis in range(3)])
        z = _find_z_axis(by_axis)
        return {
            start: np.resize(np.roll(by_axis, -start), size)
            for start in range(size)
            if z is None or start % 3 == (z + 1) % 3
        }
    # The spare float never changes. The axes, which restart after it, show its position too.
    bits = frames.view(np.uint32)
    constant = np.flatnonzero((bits == bits[0]).all(axis=0))
    after = ((constant if len(constant) else np.arange(size)) + 1) % size
    fitting = {}
    for start in after.tolist():
        shifted = np.roll(frames, -start, axis=1)[:, :used]
        by_axis = np.array([_estimate_quantum(shifted[:, axis::3]) for axis in range(3)])
        if _find_z_axis(by_axis) == 2:
            fitting[start] = np.append(np.resize(by_axis, used), np.zeros(layout.spare))
    return fitting or {start: np.zeros(size) for start in after.tolist()}


def _find_z_axis(quantum: Array) -> int | None:
    """Return the axis whose count differs from that of the two others, which agree."""
    if not quantum.all():
        return None
    for z in range(3):
        x, y = np.delete(quantum, z)
        if abs(x / y - 1) < 0.02 and abs(quantum[z] / x - 1) > MIN_QUANTUM_DIFFERENCE:
            return z
    return None


def _estimate_quantum(values: Floats) -> float:
    """Return the count of which (n, m) values are multiples; 0 if there is none."""
    known = values[:, is_plausible(values).all(axis=0)].astype(float)
    known = known[:, ~np.isnan(known).any(axis=0)]
    steps = np.abs(np.diff(known, axis=0))
    steps = steps[steps > MIN_QUANTUM_UT]
    # The smallest step is a count, or a few of them; damaged values make other steps.
    for step in np.unique(np.round(steps, 4))[:MAX_QUANTUM_CANDIDATES].tolist():
        for divisor in (1, 2, 3):
            quantum = step / divisor
            # A single step is rounded; many steps, and then the values, refine the count.
            for numbers, limit in ((steps, MAX_COUNT_STEPS), (known, MAX_ADC_COUNTS)):
                counts = np.rint(numbers / quantum)
                used = (counts != 0) & (np.abs(counts) <= limit)
                used &= np.abs(numbers / quantum - counts) < 0.1
                if used.any():
                    quantum = float(np.median(numbers[used] / counts[used]))
            counts = known / quantum
            is_integer = np.abs(counts - np.rint(counts)) <= rounding_tolerance(counts)
            if quantum > MIN_QUANTUM_UT and is_integer.mean() > 0.9:
                all_even = (np.rint(counts[is_integer]) % 2 == 0).mean() > 0.9
                return 2 * quantum if all_even else quantum
    return 0.0


def _spread(frames: Floats) -> float:
    """Return the typical difference between two frames, about one sigma."""
    steps = np.abs(np.diff(frames.astype(float), axis=0))
    steps = steps[np.isfinite(steps)]
    return max(0.5, 1.5 * float(np.median(steps))) if len(steps) else 0.5


def _learn_model(frames: Floats, layout: FrameLayout) -> FrameModel:
    """Return the model of rows that may start within a frame."""
    spread = _spread(frames)
    sigma = np.full(layout.floats, spread)
    first_frames = frames[:3] if len(frames) > 2 else frames[-1:]
    if len(frames) > 8:
        steps = np.median(np.abs(np.diff(frames.astype(float), axis=0)), axis=0)
        sigma = np.clip(np.nan_to_num(1.5 * steps), spread, 5 * spread)
    last = np.median(first_frames.astype(float), axis=0)
    zeros = np.zeros(layout.floats)
    return FrameModel(layout, last, sigma, zeros, zeros > 0)


def _start_by_hint(model: FrameModel, hint: FrameModel, starts: Sequence[int]) -> int | None:
    """Return the start at which sensors differ from each other as they did before.

    The field of the earth, common to all sensors, may have rotated meanwhile.
    """
    n = 3 * model.layout.sensors
    costs = []
    for start in starts:
        change = np.nan_to_num(model.shifted(start).last - hint.last)[:n].reshape(-1, 3)
        change -= np.median(change, axis=0)
        deviations = change.ravel() / hint.sigma[:n]
        costs.append(float(hint.cost(deviations, np.zeros(n, bool)).sum()))
    order = np.argsort(costs)
    if costs[order[0]] > WRONG_VALUE_COST * n or costs[order[1]] - costs[order[0]] < 15:
        return None
    return starts[int(order[0])]


def _start_by_first_byte(
    model: FrameModel, window: bytes, begin: int, first: int | None, starts: Sequence[int]
) -> tuple[int, str]:
    """Return the start given by the first byte, or the nearest one, and the assumption."""
    size = model.layout.size
    if first is None or len(window) < first + size:
        return starts[0], "guess"
    # Compare the values of the first frame, because bytes may have been lost since.
    frame = np.frombuffer(window, "<f4", model.layout.floats, first)
    shifted = [model.shifted(start) for start in starts]
    costs = np.array(
        [each.cost(each.deviations(frame), each.is_damaged(frame)).sum() for each in shifted]
    )
    best = int(np.argmin(costs))
    fits = bool(costs[best] <= WRONG_VALUE_COST * model.layout.floats)
    if fits and (np.delete(costs, best) >= costs[best] + UNSHIFTED_COST_BONUS).all():
        return starts[best], "first"
    phase = (first - begin) % size
    nearest = min(starts, key=lambda s: min((4 * s - phase) % size, (phase - 4 * s) % size))
    return nearest, "first" if fits and 4 * nearest == phase else "guess"
