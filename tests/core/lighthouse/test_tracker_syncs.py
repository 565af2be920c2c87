"""Rotors from the syncs of a tracker: outliers, conflicting bits, smoothing."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.lighthouse.demodulation.tracker_syncs import TrackerRotor, fit_rotor

PERIOD = 959_000.0


def fit(tick: np.ndarray, bit: np.ndarray | None = None) -> TrackerRotor:
    """The rotor of channel 1 that fits syncs."""
    bits = np.zeros(len(tick), np.int32) if bit is None else bit
    rotor = fit_rotor(tick, bits, PERIOD)
    assert rotor is not None
    return rotor


@pytest.mark.parametrize(("off_ticks", "rejected"), [(380.0, 0), (420.0, 20)])
def test_syncs_far_from_the_phase_are_outliers(off_ticks: float, rejected: int) -> None:
    # A block, so that the median of neighbours does not reject it.
    tick = np.arange(100) * PERIOD
    tick[40:60] += off_ticks
    assert fit(tick).rejected == rejected


@pytest.mark.parametrize(("off_ticks", "rejected"), [(95.0, 0), (-95.0, 0), (105.0, 1)])
def test_syncs_far_from_their_neighbours_are_outliers(off_ticks: float, rejected: int) -> None:
    tick = np.arange(50) * PERIOD
    tick[20] += off_ticks
    assert fit(tick).rejected == rejected


@pytest.mark.parametrize(("ppm", "is_rotor"), [(290.0, True), (-290.0, True), (310.0, False)])
def test_a_rotor_deviates_by_300_ppm_at_most(ppm: float, is_rotor: bool) -> None:
    tick = np.arange(50) * PERIOD * (1 + ppm * 1e-6)
    assert (fit_rotor(tick, np.zeros(50, np.int32), PERIOD) is not None) == is_rotor


def test_of_conflicting_bits_none_is_taken() -> None:
    tick = np.concatenate([np.arange(20) * PERIOD, [5 * PERIOD + 3.0, 7 * PERIOD + 3.0]])
    bit = np.zeros(22, np.int32)
    bit[20] = 1
    rotor = fit(tick, bit)
    assert len(rotor.zero_tick) == 20
    assert rotor.slow_bit.tolist() == [0] * 5 + [-1] + [0] * 14


def test_wander_is_smoothed_over_five_rotations_without_a_gap() -> None:
    number = np.concatenate([np.arange(20), np.arange(21, 40)])
    noise = np.random.default_rng(0).normal(0, 5.0, len(number))
    rotor = fit(number * PERIOD + noise)
    residual = rotor.zero_tick - number * PERIOD
    # The filter reproduces lines, so that the fitted one does not matter.
    weights = np.array([-3, 12, 17, 12, -3]) / 35
    assert residual[10] == pytest.approx(weights @ noise[8:13], abs=1e-3)
    # The two rotations on both sides of the gap keep their measured time.
    kept = [18, 19, 20, 21]
    assert residual[kept] == pytest.approx(noise[kept], abs=1e-3)


@pytest.mark.parametrize(("rotations", "is_known"), [(49.5, True), (50.5, False)])
def test_the_phase_is_known_for_50_rotations_around_a_sync(
    rotations: float, is_known: bool
) -> None:
    rotor = fit(np.arange(10) * PERIOD)
    phase, bit = rotor.phase_and_bit(np.array([(9 + rotations) * PERIOD, -rotations * PERIOD]))
    assert np.all(np.isfinite(phase) == is_known)
    assert bit.tolist() == [-1, -1]
