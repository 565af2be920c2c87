"""Last positions of a photodiode or device, from which the next one does not jump."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.localization.photodiodes import MAX_JUMP_WINDOW_S
from locatk.core.lighthouse.plane_labels import LIKELY_ACCELERATION_RAD_S2

Position = tuple[int, NDArray[np.float64], float]
"""Time in nanoseconds, position (3,) and its standard deviation in metres."""

MAX_LATENESS_NS = 1_000_000_000
"""Time by which a sweep may be earlier than the newest one of its device [ns]. If it is more, the
clock was set back, and the device is found anew."""

SPEED_SIGMA_M_S = 0.5
"""Standard deviation of the speed of a device whose motion is unknown [m/s]."""

LIKELY_ACCELERATION_M_S2 = LIKELY_ACCELERATION_RAD_S2
"""Acceleration that does not make a jump [m/s^2], as of pulses at a metre from a station."""

JUMP_SIGMAS = 6.0
"""Departure from a prediction, in its standard deviations, that noise explains."""


@dataclass
class RecentPath:
    """Accepted positions, and those since then that departed from them.

    Attributes
    ----------
    accepted : deque of Position
        The last two.
    departed : list of Position
        The last two, in succession, that agree with each other.
    departures : int
        Number of successive departures that agree with each other.
    """

    accepted: deque[Position] = field(default_factory=lambda: deque(maxlen=2))
    departed: list[Position] = field(default_factory=list)
    departures: int = 0

    def accepts(self, now: Position, confirming: int) -> bool:
        """Return whether a position is no jump, and remember it.

        After ``confirming`` departures that agree with each other, the last one is accepted: the
        device was carried there.
        """
        if not _departs(tuple(self.accepted), now):
            self.departed, self.departures = [], 0
            self.accepted.append(now)
            return True
        if self.departed and not _departs(self.departed, now):
            self.departures += 1
            self.departed = [self.departed[-1], now]
        else:
            self.departures, self.departed = 1, [now]
        if self.departures < confirming:
            return False
        self.accepted.extend(self.departed)
        self.departed, self.departures = [], 0
        return True


def _departs(before: Sequence[Position], now: Position) -> bool:
    """Return whether a position departs from the line through those before, or from the last."""
    if not before or now[0] - before[-1][0] > MAX_JUMP_WINDOW_S * 1e9:
        return False
    time_ns, position, sigma_m = before[-1]
    elapsed_s = (now[0] - time_ns) * 1e-9
    if len(before) > 1 and time_ns - before[0][0] < MAX_JUMP_WINDOW_S * 1e9:
        interval_s = max((time_ns - before[0][0]) * 1e-9, 1e-3)
        fraction = elapsed_s / interval_s
        predicted = position + fraction * (position - before[0][1])
        noise_m = sigma_m * (1.0 + 2.0 * fraction) + now[2]
        motion_m = 0.5 * LIKELY_ACCELERATION_M_S2 * elapsed_s * (elapsed_s + interval_s)
    else:
        predicted, noise_m = position, sigma_m + now[2]
        motion_m = 3 * SPEED_SIGMA_M_S * elapsed_s
    departure_m = math.dist(now[1].tolist(), predicted.tolist())
    return departure_m > JUMP_SIGMAS * noise_m + motion_m
