"""The paper's second step (section 3.3): neutral valleys (NMV) of a spin, and the centre.

While the robot turns on the spot its sensors run on one circle. The field changes sign
where a valley crosses it: over the middle of each bar, and over the corner between two
equal bars. Turning counter-clockwise over a bar the field rises through zero where the bar
is N and falls where it is S; corners do the opposite.

=====================  =======  ==========================================
landmark               valleys  told by
=====================  =======  ==========================================
1 (NSNS)               4        the number
2, 3 (SSSN, NNNS)      6        the two large gaps are neighbours
4 (NNSS)               6        the two large gaps face each other
5, 6 (NNNN, SSSS)      8        the number
=====================  =======  ==========================================

Signs tell 2 from 3. For 5 and 6 they alternate alike, and what counts is which of the
valleys are bars: those with the lesser slope (the field peaks near the bars' ends, that is
near the corners). The paper leaves that to its earlier work [18].

The number of valleys holds to 8-10 mm off the centre only, not to the paper's 20 mm
(facts/landmarks.md 2.4). Farther out some are lost, and another pattern would be read
silently. So no centre beyond 10 mm is believed, the gaps have to be as told, and the lines
of facing points about perpendicular; else there is no reading, and the robot tries again.

By construction the lines of NNNS and SSSN cross 2.6 mm off the centre with the default
bars; the four voltages amend that (section 4.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BINS = 360

UNSEEN = 15
"""Degrees without a sample after which a circle cannot be read: a third of a mountain."""

SQUARE_RAD = math.radians(25)
"""How far from perpendicular the two lines may be."""

CLEAR_RAD = math.radians(8)
"""By how much the two large gaps of six exceed the others."""

FARTHEST = 0.4
"""Of the circle's radius, 10 mm: a centre farther from that of the spin is not believed."""


@dataclass(frozen=True)
class Valleys:
    """Zero crossings of the field around a circle, counter-clockwise.

    Attributes
    ----------
    angle_rad : (k,) ndarray
        Ascending within 0 .. 2 pi.
    rising : (k,) bool ndarray
        Whether the field rises there; they alternate.
    slope : (k,) ndarray
        Size of the field's slope, T/rad.
    """

    angle_rad: Array
    rising: NDArray[np.bool_]
    slope: Array


@dataclass(frozen=True)
class Recognised:
    """A landmark read from the valleys of one spin.

    Attributes
    ----------
    centre_m : (2,) ndarray
        Of the landmark, from the circle's centre.
    bar_rad : (4,) ndarray
        Directions of the four bars from :attr:`centre_m`, counter-clockwise.
    north : (4,) bool ndarray
        Which of them are N.
    """

    centre_m: Array
    bar_rad: Array
    north: NDArray[np.bool_]

    def seen_under(self, heading_rad: float) -> tuple[int, float]:
        """Code, and the heading of the landmark's frame, turned by quarter turns so that
        a robot under ``heading_rad`` looks along its x as nearly as can be."""
        quarters = np.arange(4) * math.pi / 2
        turn = np.angle(np.exp(1j * (self.bar_rad - quarters)).sum())
        q = round((heading_rad - turn) / (math.pi / 2))
        north = np.roll(self.north, -q)
        return int(north @ (1 << np.arange(4))), float(turn + q * math.pi / 2)


def profile(place: Array, field_t: Array, centre: Array) -> Array:
    """Mean field in each degree of a circle around ``centre``.

    Parameters
    ----------
    place : (n, N, 2) ndarray
        Sensors in the odometry's frame while the robot turns.
    field_t : (n, N) ndarray
        ``nan`` where there is none.
    centre : (2,) ndarray

    Returns
    -------
    (360,) ndarray
        Bin ``k`` is centred at ``k`` degrees; bins that no sensor passed are interpolated,
        and all are ``nan`` where that leaves out :data:`UNSEEN` of them in a row.
    """
    way = place - centre
    number = np.round(np.arctan2(way[..., 1], way[..., 0]) * BINS / math.tau).astype(int) % BINS
    good = np.isfinite(field_t)
    count = np.bincount(number[good], minlength=BINS)
    at = np.flatnonzero(count)
    if len(at) == 0 or np.max(np.diff(at, append=at[0] + BINS)) > UNSEEN:
        return np.full(BINS, np.nan)
    total = np.bincount(number[good], field_t[good], minlength=BINS)
    return np.interp(np.arange(BINS), at, total[at] / count[at], period=BINS)


def valleys(around_t: Array, hysteresis_t: float) -> Valleys:
    """Sign changes of a field (n,) given at equal steps around a circle.

    A change counts once the field has gone beyond the hysteresis on the other side; it lies
    in the middle of the zero crossings between the two sides.
    """
    count = len(around_t)
    none = Valleys(np.empty(0), np.empty(0, bool), np.empty(0))
    sure = np.flatnonzero(np.abs(around_t) > hysteresis_t)
    sign = np.sign(around_t[sure])
    if len(sure) == 0 or np.all(sign == sign[0]):
        return none
    # From each last sure value of one side to the first of the other, around the circle.
    change = np.flatnonzero(sign != np.roll(sign, -1))
    found = []
    for i in change:
        first, last = int(sure[i]), int(sure[(i + 1) % len(sure)])
        span = np.arange(first, last + 1 if last > first else last + count + 1)
        value = around_t[span % count]
        at = np.flatnonzero(np.sign(value[1:]) != np.sign(value[:-1]))
        zero = span[at] + value[at] / (value[at] - value[at + 1])
        slope = abs(value[-1] - value[0]) / (span[-1] - span[0]) * count / math.tau
        found.append((float(zero.mean()) % count, bool(value[-1] > 0), slope))
    found.sort()
    angle, rising, steep = zip(*found, strict=True)
    return Valleys(np.array(angle) * math.tau / count, np.array(rising), np.array(steep))


def bar_valleys(found: Valleys) -> NDArray[np.int64] | None:
    """Which four of the valleys lie over bars, counter-clockwise; None where it is unclear.

    These are 1', 2', 4', 6' of landmarks 2 and 3 and 1', 3', 4', 6' of landmark 4 (section
    3.3 and Fig. 6): all but those over a corner.
    """
    count = len(found.angle_rad)
    if count == 4:
        return np.arange(4)
    if count == 8:
        one, other = found.slope[::2].mean(), found.slope[1::2].mean()
        return np.arange(8)[::2] + (0 if one < other else 1)
    if count != 6:
        return None
    gap = np.mod(np.roll(found.angle_rad, -1) - found.angle_rad, math.tau)
    order = np.argsort(gap)
    if gap[order[-2]] - gap[order[-3]] < CLEAR_RAD:
        return None
    # gap k lies between valleys k and k + 1
    a, b = sorted(int(k) for k in order[-2:])
    if b - a in (1, 5):
        lone = b if b - a == 1 else 0
        return np.sort((lone + np.array([0, 1, 3, 5])) % 6)
    if b - a == 3:
        return np.sort(np.array([a, a + 1, b, b + 1]) % 6)
    return None


def recognise(found: Valleys, radius_m: float) -> Recognised | None:
    """Pattern and centre of a landmark by the valleys on a circle of ``radius_m``.

    None where number, gaps or angles fit no landmark: then the paper tries again.
    """
    bars = bar_valleys(found)
    if bars is None:
        return None
    angle = found.angle_rad[bars]
    point = radius_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    one, other = point[2] - point[0], point[3] - point[1]
    cross = one[0] * other[1] - one[1] * other[0]
    square = abs(cross) / (np.hypot(*one) * np.hypot(*other))
    if square < math.cos(SQUARE_RAD):
        return None
    to = point[1] - point[0]
    centre = point[0] + (to[0] * other[1] - to[1] * other[0]) / cross * one
    if np.hypot(*centre) > FARTHEST * radius_m:
        return None
    way = point - centre
    return Recognised(centre, np.arctan2(way[:, 1], way[:, 0]), found.rising[bars])
