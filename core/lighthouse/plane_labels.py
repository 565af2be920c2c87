"""Light plane, channel and count of pulses of light from a receiver that does not report them.

A Lighthouse deck reports the time of each pulse of light, for about two thirds of the pulses the
channel of their station, and for one of them in each passage the *offset*: the time since the zero
of the station's rotor. It does not report the light plane. All three follow from the regularity of
the stations:

1. **Rotors.** Time minus offset is a zero of the rotor. The zeros of a station are a period apart;
   :func:`track_rotor` follows their phase, which wanders by microseconds within a minute. Any
   pulse of a known channel then has a rotor angle, also without an offset.
2. **Planes.** Both planes of one rotation cross a device about a third of a rotation apart, the
   first plane first (:func:`label_planes`). If only one passage was received, the passages of
   neighbouring rotations determine its plane. If there are none, a single passage may be of either
   plane: its angle decides only within 70 degrees of the station's forward axis.
3. **Unknown channels.** A pulse has the channel and the plane of the passage in which it was
   received. It is rejected if it contradicts the path of its photodiode in the neighbouring
   rotations, or agrees with another station and plane as well. A pulse outside of any passage is
   accepted if exactly one station and plane agree with that path. Pulses that remain ambiguous are
   counted, and not guessed.

The grouping of pulses follows crazyflie-firmware, ``pulse_processor_v2.c``, which needs all four
photodiodes and both planes of a rotation; rotor phases replace this requirement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import CHANNELS, TICK_HZ, period_counts, period_ticks
from locatk.core.lighthouse.epochs import MAX_PLANE_DELAY_TURNS, MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.recording import UNKNOWN

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

PULSE_HZ = 24_000_000
"""Frequency of the counter of a Lighthouse deck, half of that of a station's periods
(bitcraze/lighthouse-fpga, readme)."""

FRAME_S = 12 * 10 / 230_400
"""Duration of a frame of the deck on the serial port [s]: the shortest time from a pulse to its
arrival at the host (lighthouse-fpga, readme: 12 bytes at 230,400 baud)."""

MAX_PULSE_GAP_TICKS = 10_000
"""Longest time between two pulses of one passage, in ticks of 24 MHz
(crazyflie-firmware ``pulse_processor_v2.c``)."""

# ---- rotors

ROTOR_INTERVAL_S = 0.5
"""Interval over which the phase of a rotor is averaged [s]. Within it the phase wanders by less
than the 2 ticks to which an offset is rounded."""

MAX_PERIOD_ERROR = 2e-4
"""Largest relative deviation of a rotation from nominal by the receiver's clock. Stations are off
by up to 20 ppm, crystals of receivers by 100 ppm."""

MAX_ZERO_ERROR_TICKS = 48
"""Largest distance of a rotor zero from the phase [ticks of 24 MHz]: 2 us, six times the scatter of
single zeros in recordings of decks. A wrong offset is this near by chance in 2 of 10,000 cases."""

MIN_ZEROS = 3
"""Zeros that must agree in an interval. Three wrong ones do so by chance in 4e-8 of the cases."""

MIN_AGREEING_FRACTION = 0.8
"""Fraction of the zeros of an interval that must agree. Of two stations that are received about as
often on one channel, neither reaches it."""

MAX_EXTRAPOLATION_S = 1.0
"""Longest time from an averaged phase to a pulse [s]."""

# ---- planes

MAX_PASSAGE_GAP_TURNS = MIN_PLANE_DELAY_TURNS / 2
"""Longest gap between sweeps of one passage [rotations], for devices of any size: half of the
shortest delay between the planes."""

MAX_NEIGHBOUR_ROTATIONS = 12
"""Largest distance of neighbouring rotations that determine the plane of a single passage: 0.25 s.
A device at 1 m that flies 2 m/s moves by 0.08 rotations in this time."""

MAX_PATH_DEVIATION_TURNS = 0.06
"""Largest deviation of a passage from the median of its neighbours [rotations]: 22 degrees."""

NEIGHBOURING_PAIRS = 9
"""Number of rotations with both planes, of which the median is taken."""

MAX_LONE_FIRST_PLANE_TURNS = 0.40
MIN_LONE_SECOND_PLANE_TURNS = 0.60
"""Fractions of a rotation before and after which a passage without neighbours can only be of the
first or of the second plane, for devices within 70 degrees of the station's forward axis."""

# ---- paths of single photodiodes

MAX_PATH_GAP_ROTATIONS = 5
"""Largest distance of the neighbours that predict the angle of a photodiode: 0.1 s."""

PREDICTION_TOLERANCE_RAD = 1e-3
"""Deviation from a prediction by noise alone: several times the 0.05 to 0.2 mrad of sweeps."""

LIKELY_ACCELERATION_RAD_S2 = 10.0
MAX_ACCELERATION_RAD_S2 = 50.0
"""Angular acceleration seen from a station: likely (10 m/s^2 at 1 m), and at most (20 m/s^2 at
0.4 m). A pulse that only its angle assigns to a station must agree within the likely one."""

MAX_LONE_SPAN_ROTATIONS = 3
"""Largest distance between the neighbours of such a pulse. A stray pulse agrees by chance with a
plane in 1.0e-3 of the cases if they are 2 rotations apart, and in 1.6e-3 if they are 3. At 10, it
would be 1.6e-2."""


@dataclass(frozen=True)
class RotorTrack:
    """Phase of a station's rotor over time.

    Attributes
    ----------
    period : float
        Nominal period in ticks.
    rate : float
        Change of the phase in ticks per tick: relative deviation of the period.
    tick, phase : (m,) ndarray
        Middle of each interval, ascending, and the rotor's phase there, without the change by
        ``rate``: time of a zero modulo the period.
    """

    period: float
    rate: float
    tick: Array
    phase: Array

    def phase_at(self, tick: IntArray) -> Array:
        """Return the times of a rotor zero, up to whole periods, that hold at ``tick`` (n,).

        They are ``nan`` if the rotor was not observed at about this time, or if its phase changed
        faster than it wanders.
        """
        right = np.searchsorted(self.tick, tick)
        left, right = np.clip(right - 1, 0, None), np.clip(right, None, len(self.tick) - 1)
        distance = np.minimum(np.abs(tick - self.tick[left]), np.abs(tick - self.tick[right]))
        # In a pause the wander accumulates, and the error of the rate. Near its ends the
        # interpolation is still right if the phase changes slowly.
        pause_s = np.maximum((self.tick[right] - self.tick[left]) / PULSE_HZ, MAX_EXTRAPOLATION_S)
        max_change = MAX_ZERO_ERROR_TICKS * pause_s / MAX_EXTRAPOLATION_S
        jumps = np.abs(self.phase[right] - self.phase[left]) > max_change
        phase = np.interp(tick, self.tick, self.phase) + self.rate * tick
        is_known = (distance <= MAX_EXTRAPOLATION_S * PULSE_HZ) & ~jumps
        return np.where(is_known, phase, np.nan)


def track_rotor(tick: IntArray, offset: IntArray, period: float) -> RotorTrack | None:
    """Track the phase of one station's rotor.

    Parameters
    ----------
    tick : (n,) int64 ndarray
        Times of pulses of the station, in ticks of :data:`PULSE_HZ`, without wraps.
    offset : (n,) int64 ndarray
        Ticks since the rotor's zero. Some may be wrong.
    period : float
        Nominal period in ticks.

    Returns
    -------
    RotorTrack or None
        None if the offsets do not agree with a rotor of this period.
    """
    if not len(tick):
        return None
    order = np.argsort(tick, kind="stable")
    time = tick[order].astype(float)
    zero = time - offset[order]
    rate = 0.0
    # Over one rotation the rate is coarse but unambiguous; it resolves the finer one over 0.5 s.
    for lag, max_rate in ((0.9 * period, MAX_PERIOD_ERROR), (0.5 * PULSE_HZ, 1e-5)):
        later = np.searchsorted(time, time + lag)
        has_later = later < len(time)
        earlier, later = np.flatnonzero(has_later), later[has_later]
        elapsed = time[later] - time[earlier]
        step = _wrap(zero[later] - zero[earlier] - rate * elapsed, period) / elapsed
        is_possible = (np.abs(step) <= max_rate) & (elapsed <= 4 * lag)
        if is_possible.any():
            rate += float(np.median(step[is_possible]))
    # Offsets are in ticks of the station, whose clock determines the rotor: the true zero is
    # ``zero - rate * offset``, and the phase there without its change is the following.
    residual = zero - rate * time
    interval = np.floor(time / (ROTOR_INTERVAL_S * PULSE_HZ))
    starts = np.flatnonzero(np.diff(interval, prepend=-1.0))
    middles: list[float] = []
    phases: list[float] = []
    for start, stop in zip(starts, [*starts[1:], len(time)], strict=True):
        # More zeros than 100 do not improve the median of an interval.
        rows = slice(start, stop, 1 + (stop - start) // 100)
        distance = _wrap(residual[rows][:, None] - residual[rows], period)
        agrees = np.abs(distance) <= MAX_ZERO_ERROR_TICKS
        best = int(np.argmax(agrees.sum(axis=0)))
        agreeing = agrees[:, best]
        count = int(np.count_nonzero(agreeing))
        if count < max(MIN_ZEROS, MIN_AGREEING_FRACTION * len(agreeing)):
            continue
        phase = residual[rows][best] + float(np.median(distance[agreeing, best]))
        if phases:
            phase = phases[-1] + float(_wrap(np.array(phase - phases[-1]), period))
        middles.append(float(np.mean(time[rows][agreeing])))
        phases.append(phase)
    if not middles:
        return None
    return RotorTrack(period, rate, np.array(middles), np.array(phases))


def _wrap(difference: Array, period: float) -> Array:
    """Return differences of phases in the range of half a period before and after 0."""
    return np.asarray(difference - period * np.rint(difference / period))


def label_planes(rotation: IntArray, phase: Array) -> IntArray:
    """Assign the sweeps of one station over one device to its two light planes, by rotation.

    Parameters
    ----------
    rotation : (n,) int64 ndarray
        Number of the rotation of each sweep.
    phase : (n,) ndarray
        Its rotor angle as a fraction of a rotation, 0 to 1.

    Returns
    -------
    (n,) int64 ndarray
        0, 1, or -1 if the plane is ambiguous.

    Notes
    -----
    A passage is a group of sweeps of one rotation at about the same angle. A rotation with two
    passages at a plausible distance has the first plane first: the angle between the planes is
    never negative above -56 degrees of elevation. These rotations, without those that deviate from
    their neighbours (a passage may be a reflection), predict the others.
    """
    if not len(rotation):
        return np.zeros(0, np.int64)
    order = np.lexsort((phase, rotation))
    is_start = np.diff(rotation[order], prepend=rotation[order[0]] - 1) != 0
    is_start |= np.diff(phase[order], prepend=phase[order[0]]) > MAX_PASSAGE_GAP_TURNS
    number = np.cumsum(is_start) - 1
    passage_rotation = rotation[order][is_start]
    passage_phase = np.bincount(number, phase[order]) / np.bincount(number)
    plane = np.empty(len(rotation), np.int64)
    plane[order] = _label_passages(passage_rotation, passage_phase)[number]
    return plane


def assign_planes(time_ns: IntArray, channel: NDArray[np.int32], count: Array) -> IntArray:
    """Assign the sweeps of one device under any stations to light planes.

    Parameters
    ----------
    time_ns : (n,) int64 ndarray
        Times of the light, accurate to better than a quarter of a rotation.
    channel : (n,) int ndarray
        1 to 16.
    count : (n,) ndarray
        LFSR steps since the rotor's zero, less than a rotation.

    Returns
    -------
    (n,) int64 ndarray
        0, 1, or -1 if the plane is ambiguous.
    """
    plane = np.full(len(time_ns), UNKNOWN, np.int64)
    for value in np.unique(channel).tolist():
        rows = np.flatnonzero(channel == value)
        period_ns = float(period_ticks(value)) / TICK_HZ * 1e9
        phase = count[rows] / period_counts(value)
        zero = (time_ns[rows] - time_ns[rows[0]]) / period_ns - phase
        order = np.argsort(zero)
        # Only differences to the next rotation are rounded: the period is not exactly nominal.
        steps = np.rint(np.diff(zero[order], prepend=zero[order[:1]]))
        rotation = np.empty(len(rows), np.int64)
        rotation[order] = np.cumsum(steps)
        plane[rows] = label_planes(rotation, phase)
    return plane


def _label_passages(rotation: IntArray, phase: Array) -> IntArray:
    """Return the plane of each passage; they ascend in rotation and phase."""
    plane = np.full(len(rotation), UNKNOWN, np.int64)
    starts = np.flatnonzero(np.diff(rotation, prepend=rotation[0] - 1))
    size = np.diff(np.append(starts, len(rotation)))
    first = starts[size == 2]
    delay = phase[first + 1] - phase[first]
    first = first[(delay >= MIN_PLANE_DELAY_TURNS) & (delay <= MAX_PLANE_DELAY_TURNS)]
    pairs = np.column_stack([phase[first], phase[first + 1]])
    is_typical = _agree_with_neighbours(rotation[first], pairs)
    first, pairs = first[is_typical], pairs[is_typical]
    plane[first], plane[first + 1] = 0, 1

    rest = np.flatnonzero(plane == UNKNOWN)
    expected = _interpolate(rotation[first], pairs, rotation[rest], MAX_NEIGHBOUR_ROTATIONS)
    distance = np.abs(phase[rest, None] - expected)
    tolerance = (expected[:, 1] - expected[:, 0]) / 4
    nearest = np.argmin(np.where(np.isnan(distance), np.inf, distance), axis=1)
    distance = distance[np.arange(len(rest)), nearest]
    is_near = distance <= tolerance
    # Of several passages of a rotation at the same plane, the nearest one is taken.
    ranked = np.lexsort((distance, nearest, rotation[rest]))
    ranked = ranked[is_near[ranked]]
    keys = np.column_stack([rotation[rest], nearest])[ranked]
    is_first = np.ones(len(ranked), bool)
    is_first[1:] = np.any(keys[1:] != keys[:-1], axis=1)
    plane[rest[ranked[is_first]]] = nearest[ranked[is_first]]

    is_lone = np.zeros(len(rotation), bool)
    is_lone[starts[size == 1]] = True
    is_lone[rest[~np.isnan(tolerance)]] = False
    plane[is_lone & (plane == UNKNOWN) & (phase < MAX_LONE_FIRST_PLANE_TURNS)] = 0
    plane[is_lone & (plane == UNKNOWN) & (phase > MIN_LONE_SECOND_PLANE_TURNS)] = 1
    return plane


def _agree_with_neighbours(rotation: IntArray, values: Array) -> Mask:
    """Return the rows of ``values`` (n, k) that agree with the median of the rows around them."""
    n, half = len(rotation), NEIGHBOURING_PAIRS // 2
    rows = np.arange(n)[:, None] + np.arange(-half, half + 1)
    is_row = (rows >= 0) & (rows < n)
    rows = np.clip(rows, 0, max(n - 1, 0))
    if not n:
        return np.zeros(0, bool)
    is_row &= np.abs(rotation[rows] - rotation[:, None]) <= MAX_NEIGHBOUR_ROTATIONS
    ordered = np.sort(np.where(is_row[:, :, None], values[rows], np.inf), axis=1)
    # The median of the rows around each: the mean of the two in their middle.
    count, row = np.count_nonzero(is_row, axis=1), np.arange(n)
    median = (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2
    deviation = np.abs(values - median)
    return np.asarray(np.all(deviation <= MAX_PATH_DEVIATION_TURNS, axis=1))


def _interpolate(
    known: IntArray, values: Array, wanted: IntArray, max_distance: int, *, both: bool = False
) -> Array:
    """Interpolate ``values`` (n, k), known at ascending rotations, to other rotations.

    With a neighbour on one side only, its value is taken, or none with ``both``. A neighbour is
    less than ``max_distance`` rotations away; the wanted rotation itself is none. Results (m, k)
    are ``nan`` without a neighbour.
    """
    n, width = len(known), values.shape[1]
    padded = np.vstack([values, np.full((1, width), np.nan)])
    before = np.searchsorted(known, wanted, side="left") - 1
    after = np.searchsorted(known, wanted, side="right")
    rotations = np.append(known, 0)
    has_before = (before >= 0) & (wanted - rotations[before] <= max_distance)
    has_after = (after < n) & (rotations[np.minimum(after, n)] - wanted <= max_distance)
    before, after = np.where(has_before, before, n), np.where(has_after, after, n)
    elapsed = np.where(has_before, wanted - rotations[before], 1)
    remaining = np.where(has_after, rotations[after] - wanted, 1)
    weight = (elapsed / (elapsed + remaining))[:, None]
    between = (1 - weight) * padded[before] + weight * padded[after]
    if both:
        return between
    one_side = np.where(has_before[:, None], padded[before], padded[after])
    return np.where((has_before & has_after)[:, None], between, one_side)


# ---- pulses


@dataclass(frozen=True)
class LabelledPulses:
    """Pulses with channel, plane and count.

    Attributes
    ----------
    row : (m,) int64 ndarray
        Indices of the accepted pulses, ascending.
    channel, plane : (m,) int64 ndarray
        Channel 1 to 16 of the station, and light plane 0 or 1.
    count : (m,) ndarray
        LFSR steps since the rotor's zero, of nominal length.
    rejected : dict of str to int
        Number of the other pulses by reason.
    """

    row: IntArray
    channel: IntArray
    plane: IntArray
    count: Array
    rejected: dict[str, int]


CHANNEL_UNKNOWN = "channel_unknown"
PLANE_AMBIGUOUS = "plane_unknown"
ROTOR_UNKNOWN = "rotor_unknown"
OFFSET_CONTRADICTED = "offset_contradicts_rotor"
"""Reasons for the rejection of a pulse."""

_REASONS = (CHANNEL_UNKNOWN, ROTOR_UNKNOWN, OFFSET_CONTRADICTED, PLANE_AMBIGUOUS)


def label_pulses(
    tick: IntArray, sensor: IntArray, channel: IntArray, offset: IntArray
) -> LabelledPulses:
    """Determine channel, plane and count of the pulses of one device.

    Parameters
    ----------
    tick : (n,) int64 ndarray
        Time of each pulse in ticks of :data:`PULSE_HZ`, without wraps, in any order.
    sensor : (n,) int64 ndarray
        Number of its photodiode.
    channel : (n,) int64 ndarray
        1 to 16, or -1 if the receiver did not identify it.
    offset : (n,) int64 ndarray
        Ticks since the rotor's zero, 0 if the receiver did not find it.
    """
    order = np.argsort(tick, kind="stable")
    pulses = _Pulses(tick[order], sensor[order], channel[order], offset[order])
    pulses.label_known_channels()
    pulses.label_unknown_channels()
    row = np.flatnonzero(pulses.reason < 0)
    result = np.argsort(order[row])
    row = row[result]
    counts = pulses.phase[row] * period_counts(pulses.channel[row])
    reasons, numbers = np.unique(pulses.reason[pulses.reason >= 0], return_counts=True)
    return LabelledPulses(
        order[row],
        pulses.channel[row],
        pulses.plane[row],
        counts,
        {_REASONS[k]: int(n) for k, n in zip(reasons, numbers, strict=True)},
    )


class _Pulses:
    """Pulses in ascending time while they are labelled.

    ``reason`` is the index of the reason for which a pulse is rejected, -1 if it is accepted.
    """

    def __init__(
        self, tick: IntArray, sensor: IntArray, channel: IntArray, offset: IntArray
    ) -> None:
        n = len(tick)
        self.tick, self.sensor, self.offset = tick, sensor, offset
        self.channel = np.where(np.isin(channel, CHANNELS), channel, UNKNOWN).astype(np.int64)
        self.plane = np.full(n, UNKNOWN, np.int64)
        self.rotation = np.zeros(n, np.int64)
        self.phase = np.full(n, np.nan)
        self.reason = np.full(n, _REASONS.index(CHANNEL_UNKNOWN))
        self.rotors: dict[int, RotorTrack] = {}

    def label_known_channels(self) -> None:
        """Find the rotors, and the angle and plane of all pulses of a known channel."""
        for channel in np.unique(self.channel[self.channel != UNKNOWN]).tolist():
            rows = np.flatnonzero(self.channel == channel)
            period = float(period_ticks(channel)) * PULSE_HZ / TICK_HZ
            offset = self.offset[rows]
            has_offset = (offset > 0) & (offset < period)
            rotor = track_rotor(self.tick[rows][has_offset], offset[has_offset], period)
            if rotor is None:
                self.reason[rows] = _REASONS.index(ROTOR_UNKNOWN)
                continue
            self.rotors[channel] = rotor
            rotation, phase = self._compute_rotor_angles(rotor, rows)
            error = np.abs(_wrap(phase * period - offset, period))
            is_wrong = (offset > 0) & ((error > MAX_ZERO_ERROR_TICKS) | (offset >= period))
            is_tracked = ~np.isnan(phase)
            self.reason[rows[~is_tracked]] = _REASONS.index(ROTOR_UNKNOWN)
            self.reason[rows[is_tracked & is_wrong]] = _REASONS.index(OFFSET_CONTRADICTED)
            is_usable = is_tracked & ~is_wrong
            rows, rotation, phase = rows[is_usable], rotation[is_usable], phase[is_usable]
            self._set_labels(rows, channel, label_planes(rotation, phase), rotation, phase)

    def _compute_rotor_angles(self, rotor: RotorTrack, rows: IntArray) -> tuple[IntArray, Array]:
        """Return number and fraction of the rotation of pulses; the fraction may be ``nan``."""
        turns = (self.tick[rows] - rotor.phase_at(self.tick[rows])) / rotor.period
        rotation = np.floor(turns)
        return np.nan_to_num(rotation).astype(np.int64), turns - rotation

    def _set_labels(
        self, rows: IntArray, channel: int, plane: IntArray, rotation: IntArray, phase: Array
    ) -> None:
        """Set the labels of pulses; one without a plane is rejected."""
        self.channel[rows], self.plane[rows] = channel, plane
        self.rotation[rows], self.phase[rows] = rotation, phase
        self.reason[rows] = np.where(plane == UNKNOWN, _REASONS.index(PLANE_AMBIGUOUS), -1)

    def label_unknown_channels(self) -> None:
        """Assign pulses of unknown channel to the only station and plane that they agree with."""
        rest = np.flatnonzero(self.channel == UNKNOWN)
        passage_label = self._find_passage_labels()[rest]
        matches = np.zeros(len(rest), np.int64)
        found: list[tuple[IntArray, int, int, IntArray, Array]] = []
        for channel, rotor in self.rotors.items():
            rotation, phase = self._compute_rotor_angles(rotor, rest)
            for plane in (0, 1):
                is_in_passage = passage_label == 2 * channel + plane
                for sensor in np.unique(self.sensor[rest]).tolist():
                    is_candidate = (self.sensor[rest] == sensor) & ~np.isnan(phase)
                    path = self._find_path(channel, plane, sensor)
                    is_candidate &= ~np.isin(rotation, self.rotation[path])
                    # A photodiode that is always hit first is never identified: its path is that
                    # of pulses of unknown channel in known passages.
                    companions = np.flatnonzero(is_candidate & is_in_passage)
                    candidates = np.flatnonzero(is_candidate)
                    error, limit = _compute_path_errors(
                        np.concatenate([self.rotation[path], rotation[companions]]),
                        np.concatenate([self.phase[path], phase[companions]]),
                        rotation[candidates],
                        phase[candidates],
                        is_in_passage[candidates],
                        rotor.period,
                    )
                    # Of several pulses in one rotation, the nearest to the path is its sweep.
                    ranked = np.argsort(error, kind="stable")
                    ranked = ranked[(error <= limit)[ranked]]
                    _, nearest = np.unique(rotation[candidates[ranked]], return_index=True)
                    chosen = candidates[np.sort(ranked[nearest])]
                    matches[chosen] += 1
                    found.append((chosen, channel, plane, rotation[chosen], phase[chosen]))
        for chosen, channel, plane, rotation, phase in found:
            is_unique = matches[chosen] == 1
            rows = rest[chosen[is_unique]]
            planes = np.full(len(rows), plane)
            self._set_labels(rows, channel, planes, rotation[is_unique], phase[is_unique])

    def _find_passage_labels(self) -> IntArray:
        """Return twice the channel plus the plane of the passage of each pulse, -1 if unclear."""
        group = np.cumsum(np.diff(self.tick, prepend=self.tick[:1]) > MAX_PULSE_GAP_TICKS)
        known = np.flatnonzero(self.reason < 0)
        label = 2 * self.channel[known] + self.plane[known]
        lowest = np.full(len(group), np.iinfo(np.int64).max)
        highest = np.full(len(group), UNKNOWN)
        np.minimum.at(lowest, group[known], label)
        np.maximum.at(highest, group[known], label)
        return np.where(lowest == highest, lowest, UNKNOWN)[group]

    def _find_path(self, channel: int, plane: int, sensor: int) -> IntArray:
        """Return the accepted pulses of one photodiode and plane, ascending."""
        is_member = (self.channel == channel) & (self.plane == plane) & (self.sensor == sensor)
        return np.flatnonzero(is_member & (self.reason < 0))


def _compute_path_errors(
    known: IntArray,
    known_phase: Array,
    rotation: IntArray,
    phase: Array,
    is_in_passage: Mask,
    period: float,
) -> tuple[Array, Array]:
    """Return the deviation of pulses from the path of a photodiode, and its limit [rotations].

    The deviation is ``nan`` without near neighbours in the rotations on both sides.
    """
    if not len(known):
        return np.full(len(rotation), np.nan), np.zeros(len(rotation))
    order = np.argsort(known, kind="stable")
    known, known_phase = known[order], known_phase[order, None]
    expected = _interpolate(known, known_phase, rotation, MAX_PATH_GAP_ROTATIONS, both=True)
    before = known[np.clip(np.searchsorted(known, rotation, side="left") - 1, 0, None)]
    after = known[np.clip(np.searchsorted(known, rotation, side="right"), None, len(known) - 1)]
    turn_s = period / PULSE_HZ
    acceleration = np.where(is_in_passage, MAX_ACCELERATION_RAD_S2, LIKELY_ACCELERATION_RAD_S2)
    curvature = acceleration / 2 * (rotation - before) * (after - rotation) * turn_s**2
    limit = (PREDICTION_TOLERANCE_RAD + np.maximum(curvature, 0.0)) / (2 * np.pi)
    is_near = is_in_passage | (after - before <= MAX_LONE_SPAN_ROTATIONS)
    return np.where(is_near, np.abs(phase - expected[:, 0]), np.nan), limit
