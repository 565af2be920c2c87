"""Validate the bursts of a photodiode against the rotors of all base stations.

**Validation.** A burst is accepted if its sequence index agrees with the phase of its station's
rotor. A weak burst is compared with the sequences that the rotors predict for its time, and then
needs less evidence. If no rotor is known, as in a recording of three sweeps, only bursts with
enough evidence of their own are accepted.

**Fragments.** At the rim of a beam the receiver follows only the long runs of the light, and with
a delay of a quarter of a bit. Such a fragment cannot be identified by itself. The accepted burst
next to it predicts which part of the sequence the fragment should show. The fragment is compared
with that part, and with decoys: other parts of the same sequence. It continues the burst if
hardly any decoy resembles it as much.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import channel_of, period_counts
from locatk.core.lighthouse.demodulation.identification import (
    SequenceMatches,
    identify_sequences,
    match_expected,
)
from locatk.core.lighthouse.demodulation.rotor import (
    MAX_ROTOR_RESIDUAL_S,
    MIN_VOTE_EVIDENCE_BITS,
    Rotor,
    RotorSet,
    rotor_zero_ticks,
)
from locatk.core.lighthouse.demodulation.soft_bits import (
    BIT_HZ,
    Bursts,
    SoftBits,
    demodulate_bursts,
)

Array = NDArray[np.float64]

MIN_EXPECTED_EVIDENCE_BITS = 20.0
"""Evidence that suffices if a rotor predicts the same sequence. About a hundred of 2^22 hypotheses
remain, so that per station one in a thousand bursts of clear noise is accepted."""

INDEX_SEARCH_RADIUS_BITS = 14
"""Bits before and after the predicted index at which a weak burst is searched: 2 us for the rotor,
and a margin for noise before the first edge."""

MAX_SWEEP_S = 100e-6
"""Longest duration of a sweep, including both rims of the beam."""

WEAK_LIGHT_DELAY_BITS = 0.25
"""Delay of weak light, measured on oneLH_2D and twoLH_2D of DotBots/alvarado23lighthouse. The
benchmark scores another capture."""

SAMPLES_PER_BIT = 8
"""Samples per bit of the levels that are compared."""

DECOY_COUNT = 1000
"""Number of other parts of the sequence, at steps of one bit, that a fragment is compared with."""

MIN_DECOY_DISTANCE_BITS = 10
"""Distance of the nearest decoys from the predicted part."""

MAX_DECOY_FRACTION = 0.005
"""Largest fraction of decoys that may resemble a fragment as much as the predicted part does."""

MAX_FRAGMENT_BITS = 400
"""Longer fragments are compared up to this length."""


@dataclass(frozen=True)
class ValidatedBursts:
    """Bursts of one photodiode with the result of their validation, (n,) ascending in time.

    Attributes
    ----------
    bursts, bits, matches
        As split, demodulated and identified. Matches of weak bursts are those that the rotors
        predict.
    is_accepted : (n,) bool ndarray
        True for bursts that agree with a rotor, or need none.
    continued_burst : (n,) int64 ndarray
        For a fragment: row of the accepted burst whose sequence it continues; -1 for all others.
    rotor_residual_s : (n,) float64 ndarray
        Delay relative to the rotor of its channel, in seconds; ``nan`` if there is none.
    rejected : dict of str to int
        Number of bursts that are neither accepted nor continue an accepted one, by reason.
    """

    bursts: Bursts
    bits: SoftBits
    matches: SequenceMatches
    is_accepted: NDArray[np.bool_]
    continued_burst: NDArray[np.int64]
    rotor_residual_s: Array
    rejected: dict[str, int]


def identify_bursts(bursts: Bursts) -> tuple[SoftBits, SequenceMatches]:
    """Demodulate bursts and identify their sequences without knowledge of rotors."""
    bits = demodulate_bursts(bursts)
    return bits, identify_sequences(bits)


def validate_bursts(
    bursts: Bursts, bits: SoftBits, matches: SequenceMatches, rotor_set: RotorSet
) -> ValidatedBursts:
    """Validate the bursts of one photodiode against the rotors of all base stations.

    Parameters
    ----------
    bursts : Bursts
    bits, matches
        Result of :func:`identify_bursts`.
    rotor_set : RotorSet
        From the bursts of all photodiodes.
    """
    rate_hz = bursts.rate_hz
    is_standalone = matches.is_certain()
    if rotor_set.rotors:
        residual_s = _rotor_residual_s(bits, matches, rotor_set.rotors, rate_hz)
        agrees = np.abs(residual_s) <= MAX_ROTOR_RESIDUAL_S
        # A standalone match is never replaced by one that a rotor predicts.
        is_weak = ~is_standalone & ~(agrees & matches.is_certain(MIN_VOTE_EVIDENCE_BITS))
        matches, is_replaced = _match_predicted(bits, matches, is_weak, rotor_set)
        residual_s = _rotor_residual_s(bits, matches, rotor_set.rotors, rate_hz)
        agrees = np.abs(residual_s) <= MAX_ROTOR_RESIDUAL_S
        is_accepted = agrees & (matches.is_certain(MIN_VOTE_EVIDENCE_BITS) | is_replaced)
    else:
        residual_s = np.full(len(bursts), np.nan)
        is_doubled = np.isin(channel_of(matches.polynomial), rotor_set.doubled_channels)
        is_accepted = is_standalone & ~is_doubled
    continued_burst = match_fragments(bursts, bits, matches, is_accepted)
    is_left = ~is_accepted & (continued_burst < 0)
    is_doubled = is_standalone & np.isin(channel_of(matches.polynomial), rotor_set.doubled_channels)
    rejected = {
        "burst_of_doubled_channel": int(np.count_nonzero(is_left & is_doubled)),
        "burst_off_rotor": int(np.count_nonzero(is_left & is_standalone & ~is_doubled)),
        "burst_not_read": int(np.count_nonzero(is_left & ~is_standalone)),
    }
    return ValidatedBursts(
        bursts, bits, matches, is_accepted, continued_burst, residual_s, rejected
    )


def _rotor_residual_s(
    bits: SoftBits, matches: SequenceMatches, rotors: dict[int, Rotor], rate_hz: float
) -> Array:
    """Return the delay (n,) of bursts relative to the rotor of their channel, in seconds."""
    residual_s = np.full(len(bits), np.nan)
    channels = channel_of(matches.polynomial)
    for channel, rotor in rotors.items():
        rows = np.flatnonzero((channels == channel) & (matches.polynomial >= 0))
        zero = rotor_zero_ticks(
            bits.start_tick[rows], matches.index[rows], channel, rotor.period_tick
        )
        _, phase = rotor.rotation_and_phase(zero)
        residual_s[rows] = (phase - np.rint(phase)) * rotor.period_tick / rate_hz
    return residual_s


def _match_predicted(
    bits: SoftBits, matches: SequenceMatches, is_weak: NDArray[np.bool_], rotor_set: RotorSet
) -> tuple[SequenceMatches, NDArray[np.bool_]]:
    """Replace matches of weak bursts by those that rotors predict, if there is enough evidence.

    Returns all matches, and a mask (n,) of the replaced ones.
    """
    rows = np.flatnonzero(is_weak & (np.diff(bits.first) > 0))
    is_replaced = np.zeros(len(bits), bool)
    if not len(rows):
        return matches, is_replaced
    weak_bits = bits.take(rows)
    polynomial, index = [], []
    for channel, rotor in rotor_set.rotors.items():
        _, phase = rotor.rotation_and_phase(weak_bits.start_tick)
        for slow_bit in (0, 1):
            polynomial.append(np.full(len(rows), 2 * (channel - 1) + slow_bit, np.int32))
            index.append(np.rint(phase * period_counts(channel)).astype(np.int64))
    best = match_expected(
        weak_bits,
        np.stack(polynomial, axis=1),
        np.stack(index, axis=1),
        INDEX_SEARCH_RADIUS_BITS,
    )
    is_match = best.is_certain(MIN_EXPECTED_EVIDENCE_BITS)
    is_replaced[rows[is_match]] = True
    columns = {}
    for field in fields(SequenceMatches):
        columns[field.name] = getattr(matches, field.name).copy()
        columns[field.name][rows[is_match]] = getattr(best, field.name)[is_match]
    return SequenceMatches(**columns), is_replaced


# ---- fragments


def match_fragments(
    bursts: Bursts, bits: SoftBits, matches: SequenceMatches, is_accepted: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Find the accepted burst whose sequence each fragment continues.

    Parameters
    ----------
    bursts, bits, matches
        One row per burst, ascending in time.
    is_accepted : (n,) bool ndarray
        True for accepted bursts. All others are candidates for fragments.

    Returns
    -------
    (n,) int64 ndarray
        Row of the accepted burst; -1 for accepted bursts and for those that continue none.
    """
    continued_burst = np.full(len(bursts), -1, np.int64)
    accepted, candidates = np.flatnonzero(is_accepted), np.flatnonzero(~is_accepted)
    if not len(accepted) or not len(candidates):
        return continued_burst
    begin, start = bits.start_tick[accepted], bursts.start_tick[candidates].astype(float)
    after = np.searchsorted(begin, start)
    sides = np.stack([np.maximum(after - 1, 0), np.minimum(after, len(accepted) - 1)])
    nearest = sides[np.argmin(np.abs(begin[sides] - start), axis=0), np.arange(len(start))]
    is_close = np.abs(begin[nearest] - start) <= MAX_SWEEP_S * bursts.rate_hz
    for row, mate in zip(candidates[is_close], accepted[nearest[is_close]], strict=True):
        bit = (bursts.start_tick[row] - bits.start_tick[mate]) / bits.ticks_per_bit
        bit += matches.index[mate]
        fraction = decoy_fraction(bursts, row, int(matches.polynomial[mate]), float(bit))
        if fraction <= MAX_DECOY_FRACTION:
            continued_burst[row] = mate
    return continued_burst


def decoy_fraction(bursts: Bursts, row: int, polynomial: int, bit: float) -> float:
    """Return the fraction of decoys that resemble a fragment as much as its predicted part.

    Parameters
    ----------
    bursts : Bursts
    row : int
        Index of the fragment in ``bursts``.
    polynomial : int
        0 to 31.
    bit : float
        Predicted index in the sequence at the fragment's first edge, without the delay of weak
        light.

    Returns
    -------
    float
        0 to 1; 1 if the fragment is shorter than a bit.
    """
    edge = bursts.tick[bursts.first[row] : bursts.first[row + 1]]
    ticks_per_sample = bursts.rate_hz / BIT_HZ / SAMPLES_PER_BIT
    samples = min(
        MAX_FRAGMENT_BITS * SAMPLES_PER_BIT, int(np.ceil((edge[-1] - edge[0]) / ticks_per_sample))
    )
    if samples < SAMPLES_PER_BIT:
        return 1.0
    # Levels are taken in the middle of samples, because edges of a 40 MHz recorder are often at
    # their borders.
    time = edge[0] + (np.arange(samples) + 0.5) * ticks_per_sample
    rising = (np.searchsorted(edge, time, side="right") - 1) % 2 == (0 if bursts.rises[row] else 1)
    level = np.where(rising, 1.0, -1.0)
    level -= level.mean()
    bit -= WEAK_LIGHT_DELAY_BITS
    whole, part = int(np.floor(bit)), bit - np.floor(bit)
    # The predicted part is row `half` of `parts`; decoys are those at some distance from it.
    half = DECOY_COUNT // 2 + MIN_DECOY_DISTANCE_BITS
    length = len(time) // SAMPLES_PER_BIT + 2
    expected = _slow_level(polynomial, whole - half, 2 * half + length)
    skip = round(part * SAMPLES_PER_BIT + 0.5)
    parts = np.lib.stride_tricks.sliding_window_view(expected[skip:], len(time))[::SAMPLES_PER_BIT]
    similarity = np.abs(_correlation(parts, level))
    before = similarity[: half - MIN_DECOY_DISTANCE_BITS]
    after = similarity[half + MIN_DECOY_DISTANCE_BITS : 2 * half]
    return float(np.mean(np.concatenate([before, after]) >= similarity[half]))


def _slow_level(polynomial: int, index: int, bits: int) -> Array:
    """Return the level of a sequence after a low-pass that removes runs shorter than a bit."""
    ones = lfsr.state_at(index + np.arange(bits), polynomial) >> (lfsr.REGISTER_BITS - 1)
    flips = np.full(2 * bits, -1.0)
    flips[1::2] = np.where(ones > 0, -1.0, 1.0)
    level = np.repeat(np.cumprod(flips), SAMPLES_PER_BIT // 2)
    slow: Array = np.convolve(level, np.full(SAMPLES_PER_BIT, 1.0 / SAMPLES_PER_BIT), "same")
    return slow


def _correlation(rows: Array, level: Array) -> Array:
    """Return Pearson's correlation of each row with ``level``, whose mean is zero."""
    norm = np.sqrt(np.maximum(rows.var(axis=1) * rows.shape[1], 1e-12))
    coefficient: Array = rows @ level / (norm * max(1e-6, float(np.linalg.norm(level))))
    return coefficient
