"""Demodulate a recording of edges to sweeps, rotors and station reports.

::

    edges -> bursts -> soft bits -> sequences -> rotors -> validated bursts -> sweeps, stations
             (soft_bits)            (identification) (rotor) (burst_validation)

Each burst is demodulated and identified by itself. The rotors are estimated from the bursts of all
photodiodes, and each burst is validated against them. The bursts of a sweep are merged into one
sweep at the centre of its light. Each sweep is assigned to the first or the second light plane of
its station. The slow bits of a station are decoded to its factory data
(:mod:`~locatk.core.lighthouse.demodulation.ootx`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import channel_of, period_counts, slow_bit_of
from locatk.core.lighthouse.demodulation.burst_validation import (
    MAX_SWEEP_S,
    ValidatedBursts,
    identify_bursts,
    validate_bursts,
)
from locatk.core.lighthouse.demodulation.identification import SequenceMatches
from locatk.core.lighthouse.demodulation.ootx import (
    MISSING_BIT,
    FactoryData,
    OotxFrame,
    decode_factory_data,
    decode_frames,
)
from locatk.core.lighthouse.demodulation.rotor import Rotor, RotorSet, find_rotors
from locatk.core.lighthouse.demodulation.soft_bits import (
    MAX_SOFT_BIT,
    Bursts,
    SoftBits,
    is_mocap_flash,
    split_bursts,
)
from locatk.core.lighthouse.doubled_channels import (
    DOUBLED_CHANNEL_HINT,
    doubled_channel_message,
)
from locatk.core.lighthouse.epochs import MAX_PLANE_DELAY_TURNS, MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.recording import UNKNOWN, Edges, StationReport
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]
Int = NDArray[np.int32]

MIN_BURST_S = 5e-6
"""Shorter bursts are ignored. 30 bits fit into 5 us, and 17 are needed to look up a sequence."""

MAX_SLOW_BIT_GAP_ROTATIONS = 500
"""Longer gaps between sweeps count as this many rotations, which is more than a frame of factory
data has."""

TRACK_WINDOW_S = 0.25
"""Sweeps of a station within this time predict the phase at which its light is received."""

PLANE_TOLERANCE_TURNS = 0.03
"""Largest difference of phase between a single sweep and the nearest sweeps of its plane: 11
degrees in half a second."""

MAX_PLANE_TRACK_ROTATIONS = 25
"""Pairs of sweeps farther away in time do not determine the plane of a single sweep."""


@dataclass(frozen=True)
class DecodedSweeps:
    """Sweeps over photodiodes, (n,) each, ascending in time.

    Attributes
    ----------
    tick : float64 ndarray
        Time of the centre of the light, in ticks of the recorder.
    sensor, channel, polynomial, plane : int32 ndarray
        Photodiode from 0, channel from 1, LFSR polynomial, and light plane: 0, 1, or -1 if
        unknown.
    count : float64 ndarray
        Steps of 6 MHz since the rotor's zero by the clock of the station: sequence index at the
        centre of the light.
    """

    tick: Array
    sensor: Int
    channel: Int
    polynomial: Int
    plane: Int
    count: Array

    def __len__(self) -> int:
        return len(self.tick)


@dataclass(frozen=True)
class DemodulatedRecording:
    """Result of demodulating a recording of infrared light.

    Attributes
    ----------
    sweeps : DecodedSweeps
    photodiodes : tuple of ValidatedBursts
        Bursts of each photodiode.
    rotors : dict of int to Rotor
        By channel.
    stations : tuple of StationReport
        Ascending in channel.
    mocap_flashes : int
        Number of bursts that were removed as flashes of motion capture cameras.
    warnings : tuple of SolverWarning
        Codes: ``doubled_channel``, ``mocap_flashes``, ``station_restarted``,
        ``invalid_factory_data``, ``channel_mismatch``.
    """

    sweeps: DecodedSweeps
    photodiodes: tuple[ValidatedBursts, ...]
    rotors: dict[int, Rotor]
    stations: tuple[StationReport, ...]
    mocap_flashes: int
    warnings: tuple[SolverWarning, ...]


def demodulate_recording(lines: Sequence[Edges]) -> DemodulatedRecording:
    """Demodulate a recording to sweeps, rotors and factory data.

    Parameters
    ----------
    lines : sequence of Edges
        One per photodiode, all recorded with the same clock.

    Raises
    ------
    InputError
        There is no line, the sampling rate is below 24 MHz, the lines have different clocks, or
        no burst is accepted: no base station was in sight, or each channel is that of two stations.
    """
    if not lines:
        raise InputError("there is no data line to demodulate")
    rate_hz = lines[0].rate_hz
    if any(edges.rate_hz != rate_hz for edges in lines):
        raise InputError("the data lines were recorded with different clocks")
    mocap_flashes, identified = 0, []
    for edges in lines:
        bursts = split_bursts(edges)
        is_flash = is_mocap_flash(bursts)
        mocap_flashes += int(np.count_nonzero(is_flash))
        bursts = bursts.take(~is_flash & (bursts.duration_s > MIN_BURST_S))
        identified.append((bursts, *identify_bursts(bursts)))
    rotor_set = _find_rotors(identified, rate_hz)
    photodiodes = tuple(validate_bursts(*each, rotor_set) for each in identified)
    warnings = _light_warnings(rotor_set, mocap_flashes)
    if not any(np.any(each.is_accepted) for each in photodiodes):
        raise _no_station_error(photodiodes, rotor_set)
    sweeps = _merge_sweeps(photodiodes, rotor_set.rotors, rate_hz)
    stations = []
    for channel in np.unique(sweeps.channel).tolist():
        rotor = rotor_set.rotors.get(channel)
        report, station_warnings = _report_station(channel, sweeps, photodiodes, rotor, rate_hz)
        stations.append(report)
        warnings += station_warnings
    return DemodulatedRecording(
        sweeps, photodiodes, rotor_set.rotors, tuple(stations), mocap_flashes, tuple(warnings)
    )


def _find_rotors(
    identified: list[tuple[Bursts, SoftBits, SequenceMatches]], rate_hz: float
) -> RotorSet:
    """Find the rotors from the bursts of all photodiodes, which share one clock."""
    tick = np.concatenate([bits.start_tick for _, bits, _ in identified])
    polynomial = np.concatenate([m.polynomial for _, _, m in identified])
    index = np.concatenate([m.index for _, _, m in identified])
    evidence_bits = np.concatenate(
        [np.where(m.is_consistent, m.evidence_bits, 0.0) for _, _, m in identified]
    )
    order = np.argsort(tick, kind="stable")
    return find_rotors(tick[order], polynomial[order], index[order], evidence_bits[order], rate_hz)


def _light_warnings(rotor_set: RotorSet, mocap_flashes: int) -> list[SolverWarning]:
    """Return warnings about the light as a whole."""
    warnings = []
    if rotor_set.doubled_channels:
        message = doubled_channel_message(rotor_set.doubled_channels)
        warnings.append(SolverWarning("doubled_channel", message))
    if mocap_flashes:
        message = f"{mocap_flashes} flashes of motion capture cameras were removed"
        warnings.append(SolverWarning("mocap_flashes", message))
    return warnings


def _no_station_error(photodiodes: Sequence[ValidatedBursts], rotor_set: RotorSet) -> InputError:
    """Return the error for a recording without an accepted burst."""
    if rotor_set.doubled_channels:
        return InputError(
            doubled_channel_message(rotor_set.doubled_channels), hint=DOUBLED_CHANNEL_HINT
        )
    number = sum(len(each.bursts) for each in photodiodes)
    return InputError(
        f"no light of a base station among {number} bursts",
        hint="Record the photodiode's data line, with a station in sight",
    )


# ---- sweeps


def _merge_sweeps(
    photodiodes: Sequence[ValidatedBursts], rotors: dict[int, Rotor], rate_hz: float
) -> DecodedSweeps:
    """Merge the accepted bursts of all photodiodes to sweeps, ascending in time."""
    parts = [
        _merge_sensor_sweeps(sensor, validated, rotors, rate_hz)
        for sensor, validated in enumerate(photodiodes)
    ]
    columns = [
        np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(DecodedSweeps)
    ]
    order = np.argsort(columns[0], kind="stable")
    return DecodedSweeps(*(column[order] for column in columns))


def _merge_sensor_sweeps(
    sensor: int, validated: ValidatedBursts, rotors: dict[int, Rotor], rate_hz: float
) -> DecodedSweeps:
    """Merge the accepted bursts of one photodiode to sweeps, ordered by station and time."""
    rows = np.flatnonzero(validated.is_accepted)
    if not len(rows):
        empty = np.zeros(0, np.int32)
        return DecodedSweeps(np.zeros(0), empty, empty, empty, empty, np.zeros(0))
    weight, centre = _burst_centres(validated, rows)
    channel = channel_of(validated.matches.polynomial[rows])
    order = np.lexsort((centre, channel))
    rows, weight, centre, channel = rows[order], weight[order], centre[order], channel[order]
    starts_sweep = np.r_[True, (np.diff(channel) != 0) | (np.diff(centre) > MAX_SWEEP_S * rate_hz)]
    sweep = np.cumsum(starts_sweep) - 1
    tick = np.bincount(sweep, weight * centre) / np.bincount(sweep, weight)
    # The burst with the most evidence determines the polynomial of the sweep.
    evidence_bits = validated.matches.evidence_bits[rows]
    best = np.lexsort((-evidence_bits, sweep))[np.flatnonzero(starts_sweep)]
    best_row = rows[best]
    polynomial = validated.matches.polynomial[best_row]
    station: Int = channel[best].astype(np.int32)
    plane = np.full(len(tick), UNKNOWN, np.int32)
    ticks_per_bit = np.full(len(tick), validated.bits.ticks_per_bit)
    for number in np.unique(station).tolist():
        if number in rotors:
            of_station = np.flatnonzero(station == number)
            plane[of_station] = identify_planes(
                *rotors[number].rotation_and_phase(tick[of_station])
            )
            ticks_per_bit[of_station] = rotors[number].ticks_per_bit
    # The count follows from the sweep's own bits, because the estimated phase averages over
    # seconds, within which a rotor wanders by a microsecond.
    bit = (tick - validated.bits.start_tick[best_row]) / ticks_per_bit
    count = np.maximum(validated.matches.index[best_row] + bit, 0.0)
    return DecodedSweeps(
        tick, np.full(len(tick), sensor, np.int32), station, polynomial, plane, count
    )


def _burst_centres(validated: ValidatedBursts, rows: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return weight [bits] and centre [ticks] of the light of some bursts, (n,) each.

    Within the range that agrees, each bit has its reliability as weight, and a bit that does not
    match a negative one. On recordings the centre scatters by 0.2 us, half as much as the middle
    between the outer edges.
    """
    bits, matches = validated.bits, validated.matches
    begin = matches.begin[rows].astype(np.int64)
    size = matches.end[rows] - begin
    burst = np.repeat(np.arange(len(rows)), size)
    bit = np.arange(len(burst)) - np.repeat(np.cumsum(size) - size - begin, size)
    value = bits.value[bits.first[rows][burst] + bit] / MAX_SOFT_BIT
    states = lfsr.state_at(matches.index[rows][burst] + bit, matches.polynomial[rows][burst])
    value = np.where(states >> (lfsr.REGISTER_BITS - 1) > 0, value, -value)
    weight = np.bincount(burst, value, len(rows)).astype(float)
    centre: Array = np.bincount(burst, value * (bit + 0.5), len(rows)) / weight
    return weight, bits.start_tick[rows] + centre * bits.ticks_per_bit


# ---- light planes


def identify_planes(rotation: NDArray[np.int64], phase: Array) -> NDArray[np.int32]:
    """Identify the light plane of each sweep of one station over one photodiode.

    Both planes pass once per rotation, the second about a third of a rotation after the first.
    If both were received, the earlier one is the first. A single sweep is assigned to the plane
    whose sweeps in neighbouring pairs had a similar phase.

    Parameters
    ----------
    rotation : (n,) int64 ndarray
        Ascending; the sweeps of a rotation ascend in ``phase``.
    phase : (n,) ndarray
        Phase of the rotor, 0 to below 1 rotation.

    Returns
    -------
    (n,) int32 ndarray
        0, 1, or -1 if ambiguous: a single sweep without neighbours, a third one in a rotation.
    """
    n = len(rotation)
    plane = np.full(n, UNKNOWN, np.int32)
    if n == 0:
        return plane
    starts_rotation = np.r_[True, np.diff(rotation) != 0]
    size = np.bincount(np.cumsum(starts_rotation) - 1)
    first = np.flatnonzero(starts_rotation)[size == 2]
    delay = phase[first + 1] - phase[first] if len(first) else np.zeros(0)
    pair = first[(delay > MIN_PLANE_DELAY_TURNS) & (delay < MAX_PLANE_DELAY_TURNS)]
    plane[pair], plane[pair + 1] = 0, 1
    is_paired = np.zeros(n, bool)
    is_paired[pair] = is_paired[pair + 1] = True
    if len(pair):
        single = np.flatnonzero(~is_paired)
        plane[single] = _planes_by_neighbours(single, rotation, phase, pair)
    # A plane passes once per rotation. If two sweeps are assigned to it, both are ambiguous.
    is_duplicate = np.r_[False, (np.diff(rotation) == 0) & (np.diff(plane) == 0) & (plane[1:] >= 0)]
    is_duplicate[:-1] |= is_duplicate[1:]
    plane[is_duplicate & ~is_paired] = UNKNOWN
    return plane


def _planes_by_neighbours(
    rows: NDArray[np.int64], rotation: NDArray[np.int64], phase: Array, pair: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the plane (k,) whose sweeps in the nearest pairs had the phase of sweeps ``rows``."""
    after = np.searchsorted(pair, rows)
    distance = np.ones((2, len(rows)))
    for neighbour in (pair[np.maximum(after - 1, 0)], pair[np.minimum(after, len(pair) - 1)]):
        is_recent = np.abs(rotation[neighbour] - rotation[rows]) <= MAX_PLANE_TRACK_ROTATIONS
        for plane in (0, 1):
            difference = np.abs(phase[neighbour + plane] - phase[rows])
            difference = np.where(is_recent, difference, 1.0)
            distance[plane] = np.minimum(distance[plane], difference)
    closest, other = np.min(distance, axis=0), np.max(distance, axis=0)
    is_unique = (closest < PLANE_TOLERANCE_TURNS) & (other > PLANE_TOLERANCE_TURNS)
    return np.where(is_unique, np.argmin(distance, 0), UNKNOWN)


# ---- stations


def _report_station(
    channel: int,
    sweeps: DecodedSweeps,
    photodiodes: Sequence[ValidatedBursts],
    rotor: Rotor | None,
    rate_hz: float,
) -> tuple[StationReport, list[SolverWarning]]:
    """Return the report on one station, and warnings about it."""
    rows = np.flatnonzero(sweeps.channel == channel)
    if rotor is None:
        return StationReport(channel, sweeps=len(rows)), []
    warnings = []
    if rotor.restart_count:
        message = f"the station on channel {channel} restarted during the recording"
        warnings.append(SolverWarning("station_restarted", message))
    frames = decode_frames(slow_bits(sweeps.tick[rows], sweeps.polynomial[rows], rotor))
    valid_frames = [frame for frame in frames if frame.is_valid]
    data, data_warnings = latest_factory_data(channel, valid_frames)
    report = StationReport(
        channel,
        id=None if data is None else data.id,
        period_ticks=rotor.period_48mhz_ticks(rate_hz),
        sweeps=len(rows),
        missed=sum(
            _count_missed(sensor, validated, sweeps, rows, rotor, rate_hz)
            for sensor, validated in enumerate(photodiodes)
        ),
        calibration=None if data is None else data.calibration,
        frames=len(valid_frames),
        damaged=len(frames) - len(valid_frames),
        acceleration=None if data is None else data.acceleration,
    )
    return report, warnings + data_warnings


def latest_factory_data(
    channel: int, frames: Sequence[OotxFrame]
) -> tuple[FactoryData | None, list[SolverWarning]]:
    """Decode the latest usable frame of a station, and check its channel."""
    warnings = []
    for frame in reversed(frames):
        try:
            data = decode_factory_data(frame.payload)
        except InputError as error:
            message = f"invalid factory data of channel {channel}: {error}"
            warnings.append(SolverWarning("invalid_factory_data", message))
            continue
        if data.channel != channel:
            message = (
                f"the factory data of the station on channel {channel} name channel "
                f"{data.channel}; the channel was changed during the recording, or the data are "
                "those of another station"
            )
            warnings.append(SolverWarning("channel_mismatch", message))
        return data, warnings
    return None, warnings


def slow_bits(tick: Array, polynomial: Int, rotor: Rotor) -> NDArray[np.int8]:
    """Return the slow bit of each rotation between the first and the last sweep of a station.

    Parameters
    ----------
    tick, polynomial : (n,) ndarray
        Sweeps of the station, ascending in time.
    rotor : Rotor

    Returns
    -------
    (m,) int8 ndarray
        0, 1, or -1 if the rotation has no sweep or its sweeps disagree. Long gaps are shortened
        to :data:`MAX_SLOW_BIT_GAP_ROTATIONS`, over which no frame extends.
    """
    rotation, _ = rotor.rotation_and_phase(tick)
    step = np.clip(np.diff(rotation, prepend=rotation[0]), 0, MAX_SLOW_BIT_GAP_ROTATIONS)
    return vote_slow_bits(np.cumsum(step), polynomial)


def vote_slow_bits(rotation: NDArray[np.int64], polynomial: Int) -> NDArray[np.int8]:
    """Return the slow bit of each rotation from 0 on, by the majority of its sweeps (n,)."""
    votes = np.bincount(rotation, np.where(slow_bit_of(polynomial) > 0, 1, -1))
    has_sweep = np.bincount(rotation) > 0
    return np.where(has_sweep & (votes != 0), votes > 0, MISSING_BIT).astype(np.int8)


def _count_missed(
    sensor: int,
    validated: ValidatedBursts,
    sweeps: DecodedSweeps,
    rows: NDArray[np.int64],
    rotor: Rotor,
    rate_hz: float,
) -> int:
    """Count rejected bursts at times at which a plane of a station (sweeps ``rows``) was due."""
    rejected = np.flatnonzero(~validated.is_accepted & (validated.continued_burst < 0))
    own = rows[sweeps.sensor[rows] == sensor]
    if not len(rejected) or not len(own):
        return 0
    bursts = validated.bursts
    centre = bursts.start_tick[rejected] + bursts.duration_s[rejected] / 2 * rate_hz
    _, phase = rotor.rotation_and_phase(centre)
    is_due = np.zeros(len(rejected), bool)
    is_decoded = np.zeros(len(rejected), bool)
    for plane in (0, 1):
        track = own[sweeps.plane[own] == plane]
        if not len(track):
            continue
        tick = sweeps.tick[track]
        track_phase = sweeps.count[track] / period_counts(sweeps.channel[track])
        after = np.clip(np.searchsorted(tick, centre), 1, max(1, len(track) - 1))
        after = np.minimum(after, len(track) - 1)
        for neighbour in (np.maximum(after - 1, 0), after):
            interval = np.abs(tick[neighbour] - centre)
            error = np.abs(track_phase[neighbour] - phase) * rotor.period_tick
            is_due |= (interval < TRACK_WINDOW_S * rate_hz) & (error < MAX_SWEEP_S * rate_hz)
            # The plane's sweep of this very rotation was decoded from another burst.
            is_decoded |= interval < MAX_SWEEP_S * rate_hz
    return int(np.count_nonzero(is_due & ~is_decoded))
