"""Each burst judged by what all of them say of the rotors.

A burst is read if it says what the rotor of its station leads one to expect; the weaker it is,
the nearer it is looked for. Where not one rotor is known, as of three sweeps, those bursts are read
that stand on their own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import channel_of, period_counts
from locatk.core.lighthouse.demodulation.bursts import Bursts
from locatk.core.lighthouse.demodulation.identification import (
    SequenceMatches,
    expect,
    identify_sequences,
)
from locatk.core.lighthouse.demodulation.rotor import AGREE_S, SEED, Rotor, RotorSet, zeros
from locatk.core.lighthouse.demodulation.soft_bits import SoftBits, soft_bits
from locatk.core.lighthouse.demodulation.weak_bursts import match_fragments

Array = NDArray[np.float64]

EXPECTED = 20.0
"""Evidence in bits that is enough where a rotor says the same: it leaves a hundred places of
2^22, and for each station an accident in a thousand bursts of clear bits that are noise."""

PLACES = 14
"""Bits before and after the place that a rotor tells, at which a weak burst is looked for: 2 us
for the rotor, and some for the noise before the first edge."""


@dataclass(frozen=True)
class ValidatedBursts:
    """The bursts of one photodiode, (n,) ascending in time, and what they say.

    Attributes
    ----------
    bursts, bits, matches
        As split, demodulated and identified.
    read : (n,) bool ndarray
        Which were read.
    beside : (n,) int64 ndarray
        Of a fragment at the rim of a beam: row of the burst whose sequence it continues;
        -1 for all others.
    off_s : (n,) float64 ndarray
        From the rotor of its channel, in seconds; ``nan`` where there is none.
    rejected : dict of str to int
        Reason to number of bursts that were neither read nor continue one.
    """

    bursts: Bursts
    bits: SoftBits
    matches: SequenceMatches
    read: NDArray[np.bool_]
    beside: NDArray[np.int64]
    off_s: Array
    rejected: dict[str, int]


def identified(bursts: Bursts) -> tuple[SoftBits, SequenceMatches]:
    """What bursts say by themselves."""
    bits = soft_bits(bursts)
    return bits, identify_sequences(bits)


def validate_bursts(
    bursts: Bursts, bits: SoftBits, matches: SequenceMatches, found: RotorSet
) -> ValidatedBursts:
    """Judge the bursts of one photodiode by the rotors of all."""
    rate_hz = bursts.rate_hz
    alone = matches.certain()
    if found.rotors:
        off_s = _off_rotor(bits, matches, found.rotors, rate_hz)
        agrees = np.abs(off_s) <= AGREE_S
        # What stands on its own is not talked into something else.
        weak = ~alone & ~(agrees & matches.certain(SEED))
        matches, helped = _expected(bits, matches, weak, found)
        off_s = _off_rotor(bits, matches, found.rotors, rate_hz)
        agrees = np.abs(off_s) <= AGREE_S
        read = agrees & (matches.certain(SEED) | helped)
    else:
        off_s = np.full(len(bursts), np.nan)
        doubled = np.isin(channel_of(matches.polynomial), found.doubled)
        read = alone & ~doubled
    beside = match_fragments(bursts, bits, matches, read)
    left = ~read & (beside < 0)
    doubled = alone & np.isin(channel_of(matches.polynomial), found.doubled)
    rejected = {
        "burst_of_doubled_channel": int(np.count_nonzero(left & doubled)),
        "burst_off_rotor": int(np.count_nonzero(left & alone & ~doubled)),
        "burst_not_read": int(np.count_nonzero(left & ~alone)),
    }
    return ValidatedBursts(bursts, bits, matches, read, beside, off_s, rejected)


def _off_rotor(
    bits: SoftBits, matches: SequenceMatches, rotors: dict[int, Rotor], rate_hz: float
) -> Array:
    """Seconds (n,) by which bursts are late for the rotor of their channel."""
    off = np.full(len(bits), np.nan)
    channel = channel_of(matches.polynomial)
    for number, rotor in rotors.items():
        mine = np.flatnonzero((channel == number) & (matches.polynomial >= 0))
        start = zeros(bits.tick[mine], matches.index[mine], number, rotor.period)
        _, place = rotor.turn(start)
        off[mine] = (place - np.rint(place)) * rotor.period / rate_hz
    return off


def _expected(
    bits: SoftBits, matches: SequenceMatches, weak: NDArray[np.bool_], found: RotorSet
) -> tuple[SequenceMatches, NDArray[np.bool_]]:
    """SequenceMatches with the weak ones looked for where the rotors say, and which were found so."""
    rows = np.flatnonzero(weak & (np.diff(bits.first) > 0))
    helped = np.zeros(len(bits), bool)
    if not len(rows):
        return matches, helped
    some = _rows(bits, rows)
    polynomial, index = [], []
    for number, rotor in found.rotors.items():
        _, place = rotor.turn(some.tick)
        for bit in (0, 1):
            polynomial.append(np.full(len(rows), 2 * (number - 1) + bit, np.int32))
            index.append(np.rint(place * period_counts(number)).astype(np.int64))
    best = expect(some, np.stack(polynomial, axis=1), np.stack(index, axis=1), PLACES)
    good = best.certain(EXPECTED)
    helped[rows[good]] = True
    columns = {}
    for field in fields(SequenceMatches):
        columns[field.name] = getattr(matches, field.name).copy()
        columns[field.name][rows[good]] = getattr(best, field.name)[good]
    return SequenceMatches(**columns), helped


def _rows(bits: SoftBits, rows: NDArray[np.int64]) -> SoftBits:
    """Some bursts of all."""
    size = np.diff(bits.first)
    chosen = np.zeros(len(bits), bool)
    chosen[rows] = True
    return SoftBits(
        bits.value[np.repeat(chosen, size)],
        np.concatenate([[0], np.cumsum(size[rows])]),
        bits.tick[rows],
        bits.ticks_per_bit,
    )
