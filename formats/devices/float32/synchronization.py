"""Where a sample starts in a stream of float32 that nothing marks: found from the data.

A frame is the x, y, z of each sensor in microtesla, little-endian, one frame after the other.
What tells where they are:

* floats of a field have few exponents: bytes that are off by one are no fields;
* sensors have offsets of tens of microtesla: a value is close to the one a frame before;
* a field is a whole number of counts, and a count of the MLX90393's Z is larger than one of
  its X and Y, so that each float is checked, and Z is known from X and Y;
* which sensor is first no value tells: the line is silent before a frame. Else the first
  byte of the connection is taken for the start of one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from locatk.formats.devices.float32.frame_matching import (
    LAST_COUNT,
    OTHER_COUNT,
    STAY,
    WRONG,
    Array,
    Floats,
    Layout,
    Lock,
    plausible,
    rounding,
)

SMALLEST_COUNT_UT, CANDIDATES = 0.05, 6
"""Counts are larger (the MLX90393's smallest is 0.15), and so many of the smallest steps are
tried to be one."""

NEAR_UT = 20.0
"""How far the same value of two frames is apart, mostly, while nothing is known yet."""

LEAST, HOLD = 6, 32
"""Frames in a row from which a stream is known, and after which the start of a frame is
settled by the first byte where no pauses tell."""

PAUSES, SHARE = 3, 0.4
"""Pauses that must agree, how many times as many as name any other place, and of all."""


@dataclass(frozen=True)
class Found:
    """A lock, a byte of the window at which a frame starts, and what was assumed."""

    lock: Lock
    start: int
    assumed: str = ""


@np.errstate(all="ignore")  # Any bytes are floats; many are no numbers.
def acquire(
    window: bytes,
    pauses: Sequence[int],
    layouts: Sequence[Layout],
    *,
    first: int | None,
    hint: Lock | None,
    least: int,
    decide: bool,
) -> Found | None:
    """Find where frames start in the first bytes of a stream.

    Parameters
    ----------
    window : bytes
    pauses : sequence of int
        Bytes of the window before which the line was silent.
    layouts : sequence of Layout
        That the device may have, the longest first, of which the others are parts.
    first : int or None
        Byte at which the device began to send, where that is known.
    hint : Lock or None
        What was known before the connection broke.
    least : int
        Frames in a row that must be there.
    decide : bool
        Settle it with what there is.

    Returns
    -------
    Found or None
        None: there are no frames, or it is too early to tell.
    """
    run = find_run(window, layouts[0].floats, least)
    if run is None:
        return None
    begin, values = run
    if len(values) >= (least + 2) * layouts[0].floats:
        # Its ends may be damaged.
        begin += layouts[0].size
        values = values[layouts[0].floats : -layouts[0].floats]
    inside = [p - begin for p in pauses if begin <= p < begin + 4 * len(values)]
    layout, alike = _length(values, layouts, inside)
    width = layout.floats
    frames = values[: len(values) // width * width].reshape(-1, width)
    if (frames.view(np.uint32) == frames.view(np.uint32)[0, 0]).all():
        return None
    quanta = _starts(frames, layout)
    starts = list(quanta)
    lock = _learn(frames, layout)
    settled, assumed = None, ""
    if len(starts) == 1:
        settled = starts[0]
    else:
        places = [-1 if p % 4 else p // 4 % width for p in inside]
        settled = majority([place if place in quanta else -1 for place in places])
        if settled is None and hint is not None and hint.layout == layout:
            settled = _as_before(lock, hint, starts)
    known = settled is not None and quanta[settled][:3].all()
    if not (known or decide or len(frames) >= HOLD):
        return None
    if settled is None:
        settled, assumed = _from_first(lock, window, begin, first, starts)
        if alike:
            assumed = "alike"
    lock = replace(lock.turned(settled), quantum=quanta[settled], sure=len(starts) == 1)
    blind = lock.wild(np.roll(frames, -settled, axis=1)).mean(axis=0) > 0.5
    blind[3 * layout.sensors :] = True
    return Found(replace(lock, blind=blind), begin + 4 * settled, assumed)


def majority(places: Sequence[int]) -> int | None:
    """The place that clearly most pauses name; a negative one is none, but counts."""
    ranked = Counter(place for place in places if place >= 0).most_common(2)
    if not ranked or ranked[0][1] < max(PAUSES, SHARE * len(places)):
        return None
    if len(ranked) > 1 and ranked[0][1] < PAUSES * ranked[1][1]:
        return None
    return ranked[0][0]


@np.errstate(all="ignore")
def find_run(window: bytes, period: int, least: int) -> tuple[int, Floats] | None:
    """The longest stretch of bytes, of at least ``least`` periods, in which floats are fields
    and close to those a period before: the byte at which it begins, and the floats."""
    best: tuple[int, Floats] | None = None
    for shift in range(4):
        if len(window) - shift < 4 * least * period:
            continue
        values = np.frombuffer(window, "<f4", (len(window) - shift) // 4, shift)
        fine = plausible(values)
        near = np.abs(values[period:] - values[:-period]) <= NEAR_UT
        near |= np.isnan(values[period:]) & np.isnan(values[:-period])
        near &= fine[period:] & fine[:-period]
        total = np.concatenate([[0], np.cumsum(near)])
        good = 3 * (total[period:] - total[:-period]) >= 2 * period
        edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
        if not len(edges):
            continue
        begins, ends = edges[::2], edges[1::2]
        longest = int(np.argmax(ends - begins))
        count = int(ends[longest] - begins[longest]) + 2 * period - 1
        if count >= least * period and (best is None or count > len(best[1])):
            begin = int(begins[longest])
            best = shift + 4 * begin, values[begin : begin + count]
    return best


def _length(
    values: Floats, layouts: Sequence[Layout], pauses: Sequence[int]
) -> tuple[Layout, bool]:
    """The layout whose frames these are, and whether that is in doubt: frames of the longest
    may be several of a shorter one."""
    found = layouts[0]
    frames = values[: len(values) // found.floats * found.floats].reshape(-1, found.floats)
    middle = np.median(frames, axis=0)
    unlike = 1.5 * _spread(frames)

    def repeats(lag: int) -> bool:
        return bool(np.mean(np.abs(np.nan_to_num(middle - np.roll(middle, lag)))) <= unlike)

    for layout in layouts[1:]:
        if repeats(layout.floats):
            # Where sensors measure alike, any number of them looks like one.
            if not repeats(3):
                return layout, False
            if len(pauses) < PAUSES or majority([p % found.size for p in pauses]) is not None:
                return found, True
            return layout, majority([p % layout.size for p in pauses]) is None
    return found, False


def _starts(frames: Floats, layout: Layout) -> dict[int, Array]:
    """Floats of the rows at which a frame may start, and what a count then is of each of its
    floats."""
    size, used = layout.floats, 3 * layout.sensors
    if not layout.spare:
        by_axis = np.array([_quantum(frames[:, axis::3]) for axis in range(3)])
        z = _axis_of_z(by_axis)
        return {
            start: np.resize(np.roll(by_axis, -start), size)
            for start in range(size)
            if z is None or start % 3 == (z + 1) % 3
        }
    # The spare float is never set. The axes show where it is, too: they go on after it.
    bits = frames.view(np.uint32)
    constant = np.flatnonzero((bits == bits[0]).all(axis=0))
    after = ((constant if len(constant) else np.arange(size)) + 1) % size
    fitting = {}
    for start in after.tolist():
        turned = np.roll(frames, -start, axis=1)[:, :used]
        by_axis = np.array([_quantum(turned[:, axis::3]) for axis in range(3)])
        if _axis_of_z(by_axis) == 2:
            fitting[start] = np.append(np.resize(by_axis, used), np.zeros(layout.spare))
    return fitting or {start: np.zeros(size) for start in after.tolist()}


def _axis_of_z(quantum: Array) -> int | None:
    """Which of three axes has another count than the two others, which have the same."""
    if not quantum.all():
        return None
    for z in range(3):
        x, y = np.delete(quantum, z)
        if abs(x / y - 1) < 0.02 and abs(quantum[z] / x - 1) > OTHER_COUNT:
            return z
    return None


def _quantum(values: Floats) -> float:
    """Of which (n, m) values are whole multiples; 0 where of none."""
    known = values[:, plausible(values).all(axis=0)].astype(float)
    known = known[:, ~np.isnan(known).any(axis=0)]
    steps = np.abs(np.diff(known, axis=0))
    steps = steps[steps > SMALLEST_COUNT_UT]
    # The smallest step is a count, or a few; damaged values make others.
    for step in np.unique(np.round(steps, 4))[:CANDIDATES].tolist():
        for part in (1, 2, 3):
            quantum = step / part
            # Rounding spoils one step: many steps, then values, tell the quantum better.
            for numbers, limit in ((steps, 300), (known, LAST_COUNT)):
                counts = np.rint(numbers / quantum)
                used = (counts != 0) & (np.abs(counts) <= limit)
                used &= np.abs(numbers / quantum - counts) < 0.1
                if used.any():
                    quantum = float(np.median(numbers[used] / counts[used]))
            counts = known / quantum
            whole = np.abs(counts - np.rint(counts)) <= rounding(counts)
            if quantum > SMALLEST_COUNT_UT and whole.mean() > 0.9:
                twice = (np.rint(counts[whole]) % 2 == 0).mean() > 0.9
                return 2 * quantum if twice else quantum
    return 0.0


def _spread(frames: Floats) -> float:
    """How far values of two frames are apart: about 1 sigma."""
    steps = np.abs(np.diff(frames.astype(float), axis=0))
    steps = steps[np.isfinite(steps)]
    return max(0.5, 1.5 * float(np.median(steps))) if len(steps) else 0.5


def _learn(frames: Floats, layout: Layout) -> Lock:
    """A lock on rows as they are cut."""
    spread = _spread(frames)
    width = np.full(layout.floats, spread)
    head = frames[:3] if len(frames) > 2 else frames[-1:]
    if len(frames) > 8:
        steps = np.median(np.abs(np.diff(frames.astype(float), axis=0)), axis=0)
        width = np.clip(np.nan_to_num(1.5 * steps), spread, 5 * spread)
    last = np.median(head.astype(float), axis=0)
    none = np.zeros(layout.floats)
    return Lock(layout, last, width, none, none > 0)


def _as_before(lock: Lock, hint: Lock, starts: Sequence[int]) -> int | None:
    """The start at which sensors differ from one another as they did before: the field of
    the earth, which all of them see, may have turned meanwhile."""
    n = 3 * lock.layout.sensors
    costs = []
    for start in starts:
        apart = np.nan_to_num(lock.turned(start).last - hint.last)[:n].reshape(-1, 3)
        apart -= np.median(apart, axis=0)
        costs.append(float(hint.cost(apart.ravel() / hint.width[:n], np.zeros(n, bool)).sum()))
    order = np.argsort(costs)
    if costs[order[0]] > WRONG * n or costs[order[1]] - costs[order[0]] < 15:
        return None
    return starts[int(order[0])]


def _from_first(
    lock: Lock, window: bytes, begin: int, first: int | None, starts: Sequence[int]
) -> tuple[int, str]:
    """The start that the first byte tells, or the one that is nearest to what it tells."""
    size = lock.layout.size
    if first is None or len(window) < first + size:
        return starts[0], "guess"
    # By the values of the first frame, as bytes may have been lost since.
    frame = np.frombuffer(window, "<f4", lock.layout.floats, first)
    turned = [lock.turned(start) for start in starts]
    costs = np.array([one.cost(one.apart(frame), one.hurt(frame)).sum() for one in turned])
    best = int(np.argmin(costs))
    fits = bool(costs[best] <= WRONG * lock.layout.floats)
    if fits and (np.delete(costs, best) >= costs[best] + STAY).all():
        return starts[best], "first"
    place = (first - begin) % size
    nearest = min(starts, key=lambda s: min((4 * s - place) % size, (place - 4 * s) % size))
    return nearest, "first" if fits and 4 * nearest == place else "guess"
