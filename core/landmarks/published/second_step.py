"""Second step of the search: pattern and centre from the neutral valleys of a spin (section 3.3).

While the robot rotates on the spot, its sensors run on one circle. The field changes its sign at
each neutral magnetic valley (NMV): above the middle of each bar, and above the corner between two
equal bars. Counter-clockwise, the field rises through zero above an N bar and falls through zero
above an S bar; at corners it is the opposite.

=====================  =======  ==========================================
landmark               valleys  distinguished by
=====================  =======  ==========================================
1 (NSNS)               4        the number
2, 3 (SSSN, NNNS)      6        the two large gaps are neighbours
4 (NNSS)               6        the two large gaps face each other
5, 6 (NNNN, SSSS)      8        the number
=====================  =======  ==========================================

The signs distinguish 2 from 3. Those of 5 and 6 alternate alike, and the question is which of the
valleys are above bars: the ones with the smaller slope, because the field peaks near the ends of
the bars, which are near the corners. The paper refers to its earlier work [18] for this.

The number of valleys is right up to 8 to 10 mm from the centre, not up to the paper's 20 mm
(docs/landmarks.md). Farther out some are lost, and another pattern would be read without notice.
Therefore a centre beyond 10 mm is not accepted, the gaps must agree with the table, and the lines
through facing points must be about perpendicular. Otherwise there is no reading, and the robot
tries again.

By construction, the lines of NNNS and SSSN cross 2.6 mm from the centre with the default bars. The
pose compensation by four voltages (section 4.1) corrects this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_SPIN_RAD = math.radians(330)
"""Smallest rotation on the spot that is a spin: with four sensors the whole circle is measured
several times, also if the robot does not complete the revolution."""

MAX_SPIN_DRIFT_M = 0.005
"""Largest distance that the robot may move during a rotation on the spot; the paper's margin of
the sensors' circle (section 3.5.2)."""

PROFILE_BINS = 360
"""Bins of the field around a circle, one degree each."""

MAX_GAP_BINS = 15
"""Longest gap [bins] without a sample in a readable circle: a third of the 45 degrees between two
neighbouring valleys (section 3.1)."""

HYSTERESIS_FRACTION = 0.2
"""Field that must be exceeded on each side of a valley, in units of the territory's threshold:
four standard deviations of a sample with the default noise."""

MAX_SKEW_RAD = math.radians(25)
"""Largest deviation from perpendicular of the two lines through facing points; they deviate by up
to 15 degrees for a robot 10 mm from the centre."""

MIN_GAP_EXCESS_RAD = math.radians(8)
"""Least difference between the second and the third largest of six gaps; nominally it is 45
degrees (section 3.1)."""

MAX_OFFSET_FRACTION = 0.4
"""Largest distance of the landmark's centre from that of the spin, in units of the circle's
radius: 10 mm, up to which the number of valleys is right."""


# ---- field around the circle


@dataclass(frozen=True)
class Valleys:
    """Zero crossings of the field around a circle, counter-clockwise.

    Attributes
    ----------
    angle_rad : (k,) ndarray
        Ascending within 0 .. 2 pi.
    rising : (k,) bool ndarray
        True where the field rises through zero; the directions alternate.
    slope : (k,) ndarray
        Magnitude of the field's slope [T/rad].
    """

    angle_rad: Array
    rising: NDArray[np.bool_]
    slope: Array


def find_spins(pose: Array) -> list[tuple[int, int]]:
    """Find the stretches (first, stop) in which the robot rotates by a revolution on the spot.

    ``pose`` (n, 3) is the robot by odometry, the heading without jumps. A spin is a rotation of
    at least :data:`MIN_SPIN_RAD` within :data:`MAX_SPIN_DRIFT_M`, in either direction.
    """
    spins = []
    first = 0
    while first < len(pose):
        drifted = np.hypot(*(pose[first:, :2] - pose[first, :2]).T) > MAX_SPIN_DRIFT_M
        stop = first + int(drifted.argmax()) if drifted.any() else len(pose)
        heading = pose[first:stop, 2]
        low, high = sorted((int(heading.argmin()), int(heading.argmax())))
        if abs(heading[high] - heading[low]) >= MIN_SPIN_RAD:
            spins.append((first + low, first + high + 1))
            first = stop
        else:
            # Continue at the next sample from which the stretch differs.
            moved = np.hypot(*(pose[first:, :2] - pose[first, :2]).T) > MAX_SPIN_DRIFT_M / 10
            first = first + int(moved.argmax()) if moved.any() else len(pose)
    return spins


def circle_profile(position_m: Array, field_t: Array, centre_m: Array) -> Array:
    """Average the field in each degree of a circle.

    Parameters
    ----------
    position_m : (n, N, 2) ndarray
        Sensors in the frame of the odometry while the robot rotates.
    field_t : (n, N) ndarray
        ``nan`` where a sensor has no value.
    centre_m : (2,) ndarray
        Of the circle, in the same frame.

    Returns
    -------
    (360,) ndarray
        Bin ``k`` is centred at ``k`` degrees. Bins without a sample are interpolated; all are
        ``nan`` if :data:`MAX_GAP_BINS` or more in a row have none.
    """
    offset = position_m - centre_m
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    number = np.round(angle * PROFILE_BINS / math.tau).astype(int) % PROFILE_BINS
    valid = np.isfinite(field_t)
    count = np.bincount(number[valid], minlength=PROFILE_BINS)
    filled = np.flatnonzero(count)
    if len(filled) == 0:
        return np.full(PROFILE_BINS, np.nan)
    if np.max(np.diff(filled, append=filled[0] + PROFILE_BINS)) > MAX_GAP_BINS:
        return np.full(PROFILE_BINS, np.nan)
    total = np.bincount(number[valid], field_t[valid], minlength=PROFILE_BINS)
    mean = total[filled] / count[filled]
    return np.interp(np.arange(PROFILE_BINS), filled, mean, period=PROFILE_BINS)


def find_valleys(profile_t: Array, hysteresis_t: float) -> Valleys:
    """Find the sign changes of a field (n,) that is given at equal steps around a circle.

    A sign change counts if the field exceeds the hysteresis on both sides. The valley is in the
    middle of the zero crossings between the two sides.
    """
    count = len(profile_t)
    strong = np.flatnonzero(np.abs(profile_t) > hysteresis_t)
    sign = np.sign(profile_t[strong])
    if len(strong) == 0 or np.all(sign == sign[0]):
        return Valleys(np.empty(0), np.empty(0, bool), np.empty(0))
    # From the last strong value of one sign to the first one of the other, around the circle.
    valleys = []
    for i in np.flatnonzero(sign != np.roll(sign, -1)):
        first, last = int(strong[i]), int(strong[(i + 1) % len(strong)])
        span = np.arange(first, last + 1 if last > first else last + count + 1)
        value = profile_t[span % count]
        before = np.flatnonzero(np.sign(value[1:]) != np.sign(value[:-1]))
        zero = span[before] + value[before] / (value[before] - value[before + 1])
        slope = abs(value[-1] - value[0]) / (span[-1] - span[0]) * count / math.tau
        valleys.append((float(zero.mean()) % count, bool(value[-1] > 0), slope))
    valleys.sort()
    angle, rising, slopes = zip(*valleys, strict=True)
    return Valleys(np.array(angle) * math.tau / count, np.array(rising), np.array(slopes))


# ---- recognition


@dataclass(frozen=True)
class SpinReading:
    """A landmark that was recognised by the valleys of one spin.

    Attributes
    ----------
    centre_m : (2,) ndarray
        Of the landmark, in the frame in which the circle's centre was given.
    bar_rad : (4,) ndarray
        Directions of the four bars from :attr:`centre_m`, counter-clockwise.
    north : (4,) bool ndarray
        True for the bars that are N.
    """

    centre_m: Array
    bar_rad: Array
    north: NDArray[np.bool_]

    def in_frame_of(self, heading_rad: float) -> tuple[int, float]:
        """Return the code and the heading of the landmark's frame for a robot.

        Of the four frames that differ by quarter turns, the one is taken whose x axis is nearest
        to the robot's heading.
        """
        quarters = np.arange(4) * math.pi / 2
        rotation = np.angle(np.exp(1j * (self.bar_rad - quarters)).sum())
        q = round((heading_rad - rotation) / (math.pi / 2))
        north = np.roll(self.north, -q)
        return int(north @ (1 << np.arange(4))), float(rotation + q * math.pi / 2)


def recognise(
    valleys: Valleys, radius_m: float, max_offset_fraction: float = MAX_OFFSET_FRACTION
) -> SpinReading | None:
    """Recognise a landmark and estimate its centre by the valleys on a circle of ``radius_m``.

    The result is in the frame of the circle's centre. None if the number of valleys, their gaps
    or angles fit no landmark whose centre is within ``max_offset_fraction`` of the radius; then
    the paper tries again.
    """
    bars = bar_valleys(valleys)
    if bars is None:
        return None
    angle = valleys.angle_rad[bars]
    point = radius_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    first_line, second_line = point[2] - point[0], point[3] - point[1]
    cross = first_line[0] * second_line[1] - first_line[1] * second_line[0]
    sine = abs(cross) / (np.hypot(*first_line) * np.hypot(*second_line))
    if sine < math.cos(MAX_SKEW_RAD):
        return None
    offset = point[1] - point[0]
    fraction = (offset[0] * second_line[1] - offset[1] * second_line[0]) / cross
    centre = point[0] + fraction * first_line
    if np.hypot(*centre) > max_offset_fraction * radius_m:
        return None
    direction = point - centre
    return SpinReading(centre, np.arctan2(direction[:, 1], direction[:, 0]), valleys.rising[bars])


def bar_valleys(valleys: Valleys) -> NDArray[np.int64] | None:
    """Select the four valleys that are above bars, counter-clockwise; None if it is unclear.

    These are 1', 2', 4', 6' of landmarks 2 and 3 and 1', 3', 4', 6' of landmark 4 (Fig. 6): all
    but those above a corner.
    """
    count = len(valleys.angle_rad)
    if count == 4:
        return np.arange(4)
    if count == 8:
        even_slope, odd_slope = valleys.slope[::2].mean(), valleys.slope[1::2].mean()
        return np.arange(8)[::2] + (0 if even_slope < odd_slope else 1)
    if count != 6:
        return None
    gap = np.mod(np.roll(valleys.angle_rad, -1) - valleys.angle_rad, math.tau)
    order = np.argsort(gap)
    if gap[order[-2]] - gap[order[-3]] < MIN_GAP_EXCESS_RAD:
        return None
    # Gap k is between the valleys k and k + 1.
    a, b = sorted(int(k) for k in order[-2:])
    if b - a in (1, 5):
        between = b if b - a == 1 else 0
        return np.sort((between + np.array([0, 1, 3, 5])) % 6)
    if b - a == 3:
        return np.sort(np.array([a, a + 1, b, b + 1]) % 6)
    return None
