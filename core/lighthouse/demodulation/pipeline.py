"""From the light on photodiodes to sweeps: the road that a recording of edges takes.

Bursts are read one by one (:mod:`~locatk.core.lighthouse.demodulation.soft_bits`, :mod:`~locatk.core.lighthouse.demodulation.identification`). What they say of the rotors
is put together (:mod:`~locatk.core.lighthouse.demodulation.rotor`), and each burst is judged by that (:mod:`~locatk.core.lighthouse.demodulation.burst_validation`). The bursts of
a sweep are one sweep, dated by the middle of its light. The slow bits of each station spell its
factory data (:mod:`~locatk.core.lighthouse.demodulation.ootx`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import channel_of, period_counts, slow_bit_of
from locatk.core.lighthouse.demodulation import ootx
from locatk.core.lighthouse.demodulation.burst_validation import (
    ValidatedBursts,
    identified,
    validate_bursts,
)
from locatk.core.lighthouse.demodulation.bursts import Bursts, is_mocap_flash, split_bursts
from locatk.core.lighthouse.demodulation.identification import SequenceMatches
from locatk.core.lighthouse.demodulation.planes import planes_of
from locatk.core.lighthouse.demodulation.rotor import Rotor, RotorSet, find_rotors
from locatk.core.lighthouse.demodulation.soft_bits import CERTAIN, SoftBits
from locatk.core.lighthouse.demodulation.weak_bursts import BESIDE_S
from locatk.core.lighthouse.recording import UNKNOWN, Edges, StationReport

Array = NDArray[np.float64]
Int = NDArray[np.int32]

SHORTEST_S = 5e-6
"""Of a burst that is looked at: 30 bits, of which 17 are one look-up."""

LONGEST_SILENCE = 500
"""Rotations without a sweep that are counted: more than a frame of factory data has."""

TRACK_S = 0.25
"""Sweeps of a station this far before and after tell where its light is expected."""


@dataclass(frozen=True)
class DecodedSweeps:
    """Sweeps that passed photodiodes, (n,) each, ascending in time.

    Attributes
    ----------
    tick : float64 ndarray
        When the middle of the light passed, in ticks of the recorder.
    sensor, channel, polynomial, plane : int32 ndarray
        Photodiode from 0, station from 1, polynomial, and which of its two planes (-1 where
        nothing tells).
    count : float64 ndarray
        Steps of 6 MHz since the rotor's zero, as its station's own clock counts: the index of
        the bit that was sent when the middle passed.
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
    """What a recording of light says.

    Attributes
    ----------
    sweeps : DecodedSweeps
    readings : tuple of ValidatedBursts
        The bursts of each photodiode.
    rotors : dict of int to Rotor
        By channel.
    stations : tuple of StationReport
        Ascending in channel.
    flashes : int
        Bursts of motion capture cameras, which were dropped.
    notes : tuple of str
        What is doubtful or left out, one line each.
    """

    sweeps: DecodedSweeps
    readings: tuple[ValidatedBursts, ...]
    rotors: dict[int, Rotor]
    stations: tuple[StationReport, ...]
    flashes: int
    notes: tuple[str, ...]


def demodulate_recording(lines: Sequence[Edges]) -> DemodulatedRecording:
    """Sweeps, rotors and factory data of a recording.

    Parameters
    ----------
    lines : sequence of Edges
        One a photodiode, all by the clock of one recorder.

    Raises
    ------
    InputError
        No light of a base station, a rate too low, lines of different clocks, or nothing but a
        channel on which two stations send.
    """
    if not lines:
        raise InputError("no line of light to read")
    rate_hz = lines[0].rate_hz
    if any(edges.rate_hz != rate_hz for edges in lines):
        raise InputError("lines of light that were recorded by different clocks")
    flashes, heard = 0, []
    for edges in lines:
        bursts = split_bursts(edges)
        flash = is_mocap_flash(bursts)
        flashes += int(np.count_nonzero(flash))
        bursts = bursts.take(~flash & (bursts.duration_s > SHORTEST_S))
        heard.append((bursts, *identified(bursts)))
    found = _rotors(heard, rate_hz)
    readings = tuple(validate_bursts(*each, found) for each in heard)
    notes = []
    if found.doubled:
        listed = ", ".join(map(str, found.doubled))
        notes.append(f"more than one station sends on channel {listed}: its sweeps are left out")
    if flashes:
        notes.append(f"{flashes} flashes of motion capture cameras were dropped")
    if not any(np.any(each.read) for each in readings):
        if found.doubled:
            raise InputError(notes[0], hint="Give each station a channel of its own")
        number = sum(len(each.bursts) for each in readings)
        raise InputError(
            f"no light of a base station among {number} bursts",
            hint="Record the photodiode's data line, with a station in sight",
        )
    sweeps = _sweeps(readings, found.rotors, rate_hz)
    stations = tuple(
        _station(int(number), sweeps, readings, found.rotors.get(int(number)), rate_hz, notes)
        for number in np.unique(sweeps.channel)
    )
    return DemodulatedRecording(sweeps, readings, found.rotors, stations, flashes, tuple(notes))


def _rotors(heard: list[tuple[Bursts, SoftBits, SequenceMatches]], rate_hz: float) -> RotorSet:
    """Of all photodiodes together: they see the same rotors by the same clock."""
    tick = np.concatenate([bits.tick for _, bits, _ in heard])
    polynomial = np.concatenate([m.polynomial for _, _, m in heard])
    index = np.concatenate([m.index for _, _, m in heard])
    evidence = np.concatenate([np.where(m.consistent, m.evidence, 0.0) for _, _, m in heard])
    order = np.argsort(tick, kind="stable")
    return find_rotors(tick[order], polynomial[order], index[order], evidence[order], rate_hz)


# ---- sweeps


def _sweeps(
    readings: Sequence[ValidatedBursts], rotors: dict[int, Rotor], rate_hz: float
) -> DecodedSweeps:
    """The bursts of each sweep put together."""
    parts = [_sweeps_of(k, reading, rotors, rate_hz) for k, reading in enumerate(readings)]
    columns = [
        np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(DecodedSweeps)
    ]
    order = np.argsort(columns[0], kind="stable")
    return DecodedSweeps(*(column[order] for column in columns))


def _sweeps_of(
    sensor: int, reading: ValidatedBursts, rotors: dict[int, Rotor], rate_hz: float
) -> DecodedSweeps:
    """Sweeps of one photodiode, station by station."""
    rows = np.flatnonzero(reading.read)
    if not len(rows):
        none = np.zeros(0, np.int32)
        return DecodedSweeps(np.zeros(0), none, none, none, none, np.zeros(0))
    weight, middle = _middles(reading, rows)
    channel = channel_of(reading.matches.polynomial[rows])
    order = np.lexsort((middle, channel))
    rows, weight, middle, channel = rows[order], weight[order], middle[order], channel[order]
    fresh = np.r_[True, (np.diff(channel) != 0) | (np.diff(middle) > BESIDE_S * rate_hz)]
    group = np.cumsum(fresh) - 1
    tick = np.bincount(group, weight * middle) / np.bincount(group, weight)
    # Of the bursts of a sweep the one with the most evidence says its polynomial.
    best = np.lexsort((-reading.matches.evidence[rows], group))[np.flatnonzero(fresh)]
    first = rows[best]
    polynomial = reading.matches.polynomial[first]
    station: Int = channel[best].astype(np.int32)
    plane = np.full(len(tick), UNKNOWN, np.int32)
    ticks_per_bit = np.full(len(tick), reading.bits.ticks_per_bit)
    for number in np.unique(station).tolist():
        if number in rotors:
            mine = np.flatnonzero(station == number)
            plane[mine] = planes_of(*rotors[number].turn(tick[mine]))
            ticks_per_bit[mine] = rotors[number].ticks_per_bit
    # By the sweep's own bits: a rotor runs ahead and falls behind by a microsecond within
    # seconds, and its station counts from where it is.
    bit = (tick - reading.bits.tick[first]) / ticks_per_bit
    count = np.maximum(reading.matches.index[first] + bit, 0.0)
    return DecodedSweeps(
        tick, np.full(len(tick), sensor, np.int32), station, polynomial, plane, count
    )


def _middles(reading: ValidatedBursts, rows: NDArray[np.int64]) -> tuple[Array, Array]:
    """How much of its sequence each burst shows, in bits, and the middle of that, in ticks.

    In the stretch that agrees, each bit counts by how sure it is, and one that contradicts
    against its place. On recordings it scatters by a fifth of a microsecond, half as much as
    the middle between the outer edges.
    """
    bits, matches = reading.bits, reading.matches
    begin = matches.begin[rows].astype(np.int64)
    size = matches.end[rows] - begin
    burst = np.repeat(np.arange(len(rows)), size)
    place = np.arange(len(burst)) - np.repeat(np.cumsum(size) - size - begin, size)
    value = bits.value[bits.first[rows][burst] + place] / CERTAIN
    expected = lfsr.state_at(matches.index[rows][burst] + place, matches.polynomial[rows][burst])
    value = np.where(expected >> (lfsr.BITS - 1) > 0, value, -value)
    weight = np.bincount(burst, value, len(rows)).astype(float)
    middle: Array = np.bincount(burst, value * (place + 0.5), len(rows)) / weight
    return weight, bits.tick[rows] + middle * bits.ticks_per_bit


# ---- stations


def _station(
    number: int,
    sweeps: DecodedSweeps,
    readings: Sequence[ValidatedBursts],
    rotor: Rotor | None,
    rate_hz: float,
    notes: list[str],
) -> StationReport:
    """All that is known of one station."""
    mine = np.flatnonzero(sweeps.channel == number)
    if rotor is None:
        return StationReport(number, sweeps=len(mine))
    if rotor.restarts:
        notes.append(f"the station on channel {number} started anew while recording")
    slow = slow_bits(sweeps.tick[mine], sweeps.polynomial[mine], rotor)
    frames = ootx.frames(slow)
    right = [frame for frame in frames if frame.right]
    data = None
    for frame in reversed(right):
        try:
            data = ootx.factory_data(frame.payload)
            break
        except InputError as error:
            notes.append(f"factory data of channel {number} cannot be: {error}")
    if data is not None and data.channel != number:
        notes.append(
            f"the station on channel {number} says it is on channel {data.channel}: it was "
            "switched over while recording, or its data is another's"
        )
    return StationReport(
        number,
        id=None if data is None else data.id,
        period_ticks=rotor.period_ticks(rate_hz),
        sweeps=len(mine),
        missed=sum(
            _missed(sensor, reading, sweeps, mine, rotor, rate_hz)
            for sensor, reading in enumerate(readings)
        ),
        calibration=None if data is None else data.calibration,
        frames=len(right),
        damaged=len(frames) - len(right),
    )


def slow_bits(tick: Array, polynomial: Int, rotor: Rotor) -> NDArray[np.int8]:
    """Slow bit of each rotation, from the first to the last that was heard; -1 where none was
    heard, or its sweeps contradict each other. Sweeps ascend in time."""
    rotation, _ = rotor.turn(tick)
    # Over a longer silence no frame is put together.
    rotation = np.cumsum(np.clip(np.diff(rotation, prepend=rotation[0]), 0, LONGEST_SILENCE))
    votes = np.bincount(rotation, np.where(slow_bit_of(polynomial) > 0, 1, -1))
    heard = np.bincount(rotation) > 0
    return np.where(heard & (votes != 0), votes > 0, -1).astype(np.int8)


def _missed(
    sensor: int,
    reading: ValidatedBursts,
    sweeps: DecodedSweeps,
    mine: NDArray[np.int64],
    rotor: Rotor,
    rate_hz: float,
) -> int:
    """Bursts that came when a plane of this station was expected, and were not read."""
    left = np.flatnonzero(~reading.read & (reading.beside < 0))
    own = mine[sweeps.sensor[mine] == sensor]
    if not len(left) or not len(own):
        return 0
    when = reading.bursts.start[left] + reading.bursts.duration_s[left] / 2 * rate_hz
    _, place = rotor.turn(when)
    late = np.ones(len(left), bool)
    found = np.zeros(len(left), bool)
    for plane in (0, 1):
        track = own[sweeps.plane[own] == plane]
        if not len(track):
            continue
        tick, known = sweeps.tick[track], sweeps.count[track] / period_counts(sweeps.channel[track])
        at = np.clip(np.searchsorted(tick, when), 1, max(1, len(track) - 1))
        at = np.minimum(at, len(track) - 1)
        for near in (np.maximum(at - 1, 0), at):
            close = np.abs(tick[near] - when) < TRACK_S * rate_hz
            found |= close & (np.abs(known[near] - place) * rotor.period < BESIDE_S * rate_hz)
            # A plane that was read in this very rotation was not missed.
            late &= ~(np.abs(tick[near] - when) < BESIDE_S * rate_hz)
    return int(np.count_nonzero(found & late))
