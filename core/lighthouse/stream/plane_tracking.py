"""Causal assignment of the sweeps of a device to the two light planes of one station.

Offline, :mod:`locatk.core.lighthouse.plane_labels` sees all rotations. Here the first rotation with
two passages at a plausible distance decides, first plane first, and each passage predicts the next
one of its plane. Until then, a rotation with a single passage decides only if its angle is possible
for one plane alone. Limits are those of the offline module.
"""

from __future__ import annotations

from locatk.core.lighthouse.channels import TICK_HZ, period_counts, period_ticks
from locatk.core.lighthouse.epochs import MAX_PLANE_DELAY_TURNS, MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.plane_labels import (
    MAX_LONE_FIRST_PLANE_TURNS,
    MAX_NEIGHBOUR_ROTATIONS,
    MAX_PASSAGE_GAP_TURNS,
    MIN_LONE_SECOND_PLANE_TURNS,
)
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S

MAX_HELD_SWEEPS = 64
"""Largest number of sweeps of one rotation that are held until a second passage comes: those of
22 photodiodes, and reflections."""

Sweep = tuple[int, int, float]
"""Time in nanoseconds, number of the photodiode, and LFSR count."""


class PlaneTracker:
    """Light planes of the sweeps of one device under one station."""

    def __init__(self, channel: int) -> None:
        self._period_ns = float(period_ticks(channel)) / TICK_HZ * NANOSECONDS_PER_S
        self._counts = float(period_counts(channel))
        self._rotation, self._last_ns, self._last_turns = 0, 0, 0.0
        self._passage: list[tuple[int, float] | None] = [None, None]
        self._held: list[Sweep] = []

    def push(self, sweep: Sweep) -> tuple[list[tuple[Sweep, int]], int]:
        """Return the sweeps whose planes this one makes known, and the number of rejected ones."""
        time_ns, _, count = sweep
        turns = count / self._counts
        elapsed = (time_ns - self._last_ns) / self._period_ns - (turns - self._last_turns)
        # Only differences to the last rotation are rounded: the period is not exactly nominal.
        step = round(elapsed)
        rejected = 0
        if step > 0 and self._held:
            rejected = self._release_lone()
        self._rotation += step
        self._last_ns, self._last_turns = time_ns, turns
        known = [
            None if p is None or self._rotation - p[0] > MAX_NEIGHBOUR_ROTATIONS else p[1]
            for p in self._passage
        ]
        first, second = known
        if first is not None or second is not None:
            plane = _nearest_plane(turns, first, second)
            if plane < 0:
                return [], rejected + 1
            self._passage[plane] = (self._rotation, turns)
            return [(sweep, plane)], rejected
        return self._begin(sweep, turns), rejected

    def _begin(self, sweep: Sweep, turns: float) -> list[tuple[Sweep, int]]:
        """Hold a sweep until a rotation has two passages; return the sweeps of both."""
        start = self._held[0][2] / self._counts if self._held else turns
        delay = turns - start
        if MIN_PLANE_DELAY_TURNS <= delay <= MAX_PLANE_DELAY_TURNS:
            first = [s for s in self._held if s[2] / self._counts - start <= MAX_PASSAGE_GAP_TURNS]
            self._held = []
            self._passage = [(self._rotation, start), (self._rotation, turns)]
            return [*((s, 0) for s in first), (sweep, 1)]
        if len(self._held) < MAX_HELD_SWEEPS:
            self._held.append(sweep)
        return []

    def _release_lone(self) -> int:
        """Decide from the single passage of a finished rotation; return its number of sweeps."""
        turns = [s[2] / self._counts for s in self._held]
        number, self._held = len(turns), []
        if max(turns) - min(turns) <= MAX_PASSAGE_GAP_TURNS:
            if max(turns) < MAX_LONE_FIRST_PLANE_TURNS:
                self._passage[0] = (self._rotation, turns[-1])
            elif min(turns) > MIN_LONE_SECOND_PLANE_TURNS:
                self._passage[1] = (self._rotation, turns[-1])
        return number


def _nearest_plane(turns: float, first: float | None, second: float | None) -> int:
    """Return the plane whose last passage is near a sweep, or -1."""
    if first is not None and second is not None:
        tolerance = max((second - first) / 4, MIN_PLANE_DELAY_TURNS / 4)
        if abs(turns - first) <= tolerance:
            return 0
        return 1 if abs(turns - second) <= tolerance else -1
    middle = first if first is not None else second
    assert middle is not None
    own = 0 if first is not None else 1
    delay = turns - middle if own == 0 else middle - turns
    if abs(delay) <= MIN_PLANE_DELAY_TURNS / 2:
        return own
    return 1 - own if MIN_PLANE_DELAY_TURNS <= delay <= MAX_PLANE_DELAY_TURNS else -1
