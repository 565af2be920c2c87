"""Rotors from decoded bursts: period, phase over time, silences, restarts, two on a channel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.lighthouse.demodulation.rotor import (
    MAX_ROTOR_RESIDUAL_S,
    MIN_SEGMENT_BURSTS,
    Rotor,
    RotorSet,
    _estimate_period,
    _link_segments,
    _select_disjoint,
    find_rotors,
)

Array = NDArray[np.float64]
RATE = 40e6
TICKS = {1: 959000, 4: 949000, 16: 887000}


@dataclass
class Decoded:
    """Bursts as the decoder would hand them over, sorted at the end."""

    noise: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    rows: list[Array] = field(default_factory=list)

    def station(
        self,
        channel: int,
        since_s: float,
        until_s: float,
        *,
        zero_s: float = 0.003,
        ppm: float = 0.0,
        wrong: float = 0.0,
        scatter_s: float = 2e-7,
        wander: Array | None = None,
    ) -> None:
        """Two sweeps a rotation; ``wander`` is amplitude and seconds of a slow sine."""
        turn = TICKS[channel] / 48e6 * (1 + ppm * 1e-6)
        k = np.repeat(np.arange(int((until_s - since_s) / turn)), 2)
        zero = since_s + zero_s + k * turn
        if wander is not None:
            zero = zero + wander[0] * np.sin(2 * np.pi * zero / wander[1])
        index = np.rint(np.tile([0.3, 0.62], len(k) // 2) * TICKS[channel] / 8)
        time = zero + index / 6e6 * (1 + ppm * 1e-6)
        time += self.noise.normal(0, scatter_s, len(time))
        off = self.noise.random(len(time)) < wrong
        index[off] = self.noise.integers(0, 131_071, off.sum())
        polynomial = 2 * (channel - 1) + k % 2
        self.rows.append(np.stack([time * RATE, polynomial, index, np.full(len(k), 60.0)]))

    def accidents(self, number: int, until_s: float, polynomials: int = 32) -> None:
        rows = [
            self.noise.uniform(0, until_s * RATE, number),
            self.noise.integers(0, polynomials, number),
            self.noise.integers(0, 131_071, number),
            np.full(number, 30.0),
        ]
        self.rows.append(np.stack(rows))

    def found(self) -> RotorSet:
        table = np.concatenate(self.rows, axis=1)
        tick, polynomial, index, evidence = table[:, np.argsort(table[0])]
        return find_rotors(
            tick, polynomial.astype(np.int32), index.astype(np.int64), evidence, RATE
        )


def lateness(rotor: Rotor, zero_s: Array) -> Array:
    """Seconds by which a rotor's zeros are later than the true ones."""
    _, place = rotor.rotation_and_phase(zero_s * RATE)
    return -(place - np.rint(place)) * rotor.period_tick / RATE


def test_period_and_phase_through_wander_and_wrong_decodes() -> None:
    drawn = Decoded()
    wander = np.array([4e-7, 37.0])
    drawn.station(1, 0, 60, ppm=-15.49, wrong=0.1, wander=wander)
    drawn.station(16, 0, 60, ppm=23.4, wrong=0.1, zero_s=0.001)
    found = drawn.found()
    assert found.doubled_channels == ()
    assert sorted(found.rotors) == [1, 16]
    assert found.rotors[1].period_deviation_ppm(RATE) == pytest.approx(-15.49, abs=0.02)
    assert found.rotors[16].period_deviation_ppm(RATE) == pytest.approx(23.4, abs=0.01)
    zero = 0.003 + np.arange(3000) * 959000 / 48e6 * (1 - 15.49e-6)
    zero = zero + wander[0] * np.sin(2 * np.pi * zero / wander[1])
    assert np.abs(lateness(found.rotors[1], zero)).max() < 1.5e-7
    assert found.rotors[1].sigma_tick / RATE == pytest.approx(2e-7, rel=0.1)
    assert found.rotors[1].burst_count == pytest.approx(0.9 * 6000, rel=0.02)


def test_a_rotation_and_a_place_in_it() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 10, ppm=5)
    rotor = drawn.found().rotors[4]
    turn = 949000 / 48e6 * (1 + 5e-6)
    rotation, place = rotor.rotation_and_phase(
        (0.003 + (np.array([0.2, 7.5, 300.9])) * turn) * RATE
    )
    assert rotation.tolist() == [0, 7, 300]
    assert place == pytest.approx([0.2, 0.5, 0.9], abs=1e-4)
    assert rotor.period_48mhz_ticks(RATE) == pytest.approx(949000 * (1 + 5e-6), rel=1e-8)


@pytest.mark.parametrize("ppm", [-190.0, 190.0])
def test_clocks_that_are_far_off(ppm: float) -> None:
    drawn = Decoded()
    drawn.station(4, 0, 5, ppm=ppm)
    assert drawn.found().rotors[4].period_deviation_ppm(RATE) == pytest.approx(ppm, abs=0.1)


def test_a_clock_that_drifts_by_far_more_than_a_sweep_scatters() -> None:
    # 0.3 ppm in ten minutes: 45 us from any line.
    drawn = Decoded()
    drawn.station(4, 0, 600, wander=np.array([4.5e-5, 1200.0]), wrong=0.05)
    rotor = drawn.found().rotors[4]
    assert rotor.burst_count > 0.94 * 60_000
    assert rotor.restart_count == 0


def test_few_bursts() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 0.03)
    assert len(drawn.rows[0].T) == 2
    assert drawn.found().rotors == {}
    drawn.station(1, 0, 0.05)
    assert len(drawn.rows[1].T) == MIN_SEGMENT_BURSTS
    assert list(drawn.found().rotors) == [1]
    none = np.zeros(0)
    empty = find_rotors(none, none.astype(np.int32), none.astype(np.int64), none, RATE)
    assert empty == RotorSet({}, ())


def test_one_second_is_enough() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 1, ppm=11, wrong=0.2)
    drawn.accidents(300, 1.0)
    assert drawn.found().rotors[4].period_deviation_ppm(RATE) == pytest.approx(11, abs=0.3)


def test_accidents_make_no_rotor() -> None:
    for seed in range(20):
        drawn = Decoded(np.random.default_rng(seed))
        drawn.accidents(3000, 30.0)
        assert drawn.found() == RotorSet({}, ())


def test_many_accidents_do_not_hide_a_rotor() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 30, ppm=-8, wrong=0.1)
    drawn.accidents(3000, 30.0, polynomials=8)
    found = drawn.found()
    assert list(found.rotors) == [4]
    assert found.rotors[4].period_deviation_ppm(RATE) == pytest.approx(-8, abs=0.02)
    # Those that lie right by accident, 4 us of 20 ms, count as well.
    assert found.rotors[4].burst_count == pytest.approx(0.9 * 3034, rel=0.02)


@pytest.mark.parametrize("ppm", [0.0, 6.0, -40.0])
def test_two_stations_on_a_channel(ppm: float) -> None:
    drawn = Decoded()
    drawn.station(4, 0, 20, wrong=0.1)
    drawn.station(4, 0, 20, zero_s=0.0101, ppm=ppm, wrong=0.1)
    drawn.station(1, 0, 20)
    found = drawn.found()
    assert found.doubled_channels == (4,)
    assert list(found.rotors) == [1]


def test_two_stations_on_a_channel_for_a_part_of_the_time() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 20)
    drawn.station(4, 8, 14, zero_s=0.0101)
    assert drawn.found().doubled_channels == (4,)


@pytest.mark.parametrize("shift_s", [2e-4, 8e-4])
def test_two_stations_on_a_channel_whose_phases_cross(shift_s: float) -> None:
    drawn = Decoded()
    drawn.station(4, 0, 60)
    drawn.station(4, 0, 60, zero_s=0.003 + shift_s, ppm=-shift_s / 30 * 1e6)
    assert drawn.found().doubled_channels == (4,)


@pytest.mark.parametrize("ppm", [0.0, 1.0])
def test_a_station_that_is_switched_off_and_on(ppm: float) -> None:
    drawn = Decoded()
    drawn.station(4, 0, 10, wrong=0.1)
    drawn.station(4, 15, 25, zero_s=0.0101, ppm=ppm, wrong=0.1)
    found = drawn.found()
    assert found.doubled_channels == ()
    rotor = found.rotors[4]
    assert rotor.restart_count == 1
    assert rotor.burst_count == pytest.approx(0.9 * 2022, rel=0.02)
    assert rotor.period_deviation_ppm(RATE) == pytest.approx(ppm / 2, abs=0.05)
    turn = 949000 / 48e6
    for since, zero, rate in ((0, 0.003, 0.0), (15, 0.0101, ppm)):
        # Also in the last rotation before the silence, and the first after it.
        times = since + zero + np.arange(505) * turn * (1 + rate * 1e-6)
        assert np.abs(lateness(rotor, times)).max() < MAX_ROTOR_RESIDUAL_S
        assert np.abs(lateness(rotor, times + 0.9 * turn) - 0.1 * turn).max() < MAX_ROTOR_RESIDUAL_S


def test_out_of_sight_for_long() -> None:
    # Nobody can count the rotations of two hours; what came before and after stands.
    drawn = Decoded()
    for since in (0.0, 7200.0, 7300.0):
        drawn.station(4, since, since + 10, ppm=12, zero_s=0.003 + since * 3e-7)
    rotor = drawn.found().rotors[4]
    assert rotor.burst_count > 0.99 * 3 * 1010
    assert rotor.period_deviation_ppm(RATE) == pytest.approx(12, abs=0.02)
    # Nothing is spent on the silence.
    assert len(rotor.knot_tick) < 100


def test_sees_each_rotation_by_several_photodiodes() -> None:
    drawn = Decoded()
    for _ in range(24):
        drawn.station(4, 0, 4, ppm=3)
    found = drawn.found()
    assert found.doubled_channels == ()
    assert found.rotors[4].burst_count == sum(len(rows.T) for rows in drawn.rows)


def test_absurd_times_end() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 2)
    drawn.station(4, 1e9, 1e9 + 2)
    found = drawn.found()
    assert len(found.rotors[4].knot_tick) < 20


# ---- thresholds

PERIOD = 8e5  # ticks of 40 MHz


@pytest.mark.parametrize(("shift_s", "sizes"), [(3.4e-6, [12]), (3.6e-6, [6, 6])])
def test_link_error_grows_with_the_interval(shift_s: float, sizes: list[int]) -> None:
    # 3 us, and 2 ppm of at most 12 rotations between linked bursts: 3.48 us.
    zero = np.concatenate([np.arange(6) * PERIOD, np.arange(10, 16) * PERIOD + shift_s * RATE])
    assert [len(rows) for rows in _link_segments(zero, PERIOD, RATE)] == sizes


@pytest.mark.parametrize(("gap", "sizes"), [(50, [8]), (51, [4, 4])])
def test_segments_end_after_a_gap_of_50_rotations(gap: int, sizes: list[int]) -> None:
    zero = np.concatenate([np.arange(4), 3 + gap + np.arange(4)]) * PERIOD
    assert [len(rows) for rows in _link_segments(zero, PERIOD, RATE)] == sizes


@pytest.mark.parametrize(("between", "sizes"), [(7, [8]), (8, [4, 4])])
def test_links_skip_at_most_seven_wrong_bursts(between: int, sizes: list[int]) -> None:
    wrong = (3.1 + 0.09 * np.arange(between) + 0.002 * np.arange(between) ** 2) * PERIOD
    zero = np.concatenate([np.arange(4) * PERIOD, wrong, np.arange(4, 8) * PERIOD])
    assert np.all(np.diff(zero) > 0)
    assert [len(rows) for rows in _link_segments(zero, PERIOD, RATE)] == sizes


@pytest.mark.parametrize(("number", "sizes"), [(3, []), (4, [4])])
def test_a_segment_has_four_bursts(number: int, sizes: list[int]) -> None:
    segments = _link_segments(np.arange(number) * PERIOD, PERIOD, RATE)
    assert [len(rows) for rows in segments] == sizes


def test_overlapping_segments_are_excluded() -> None:
    long, inside, after = np.arange(0, 40, 2), np.arange(11, 21, 2), np.arange(40, 44)
    selected, excluded = _select_disjoint([long, inside, after])
    assert [rows.tolist() for rows in selected] == [long.tolist(), after.tolist()]
    assert excluded == len(inside)
    # One that begins before a selected one and ends in it overlaps too.
    selected, excluded = _select_disjoint([np.arange(10, 20), np.array([5, 6, 7, 12])])
    assert [rows[0] for rows in selected] == [10]
    assert excluded == 4


@pytest.mark.parametrize(("seconds", "doubled"), [(1.7, ()), (2.4, (4,))])
def test_a_tenth_of_the_bursts_makes_a_second_station(
    seconds: float, doubled: tuple[int, ...]
) -> None:
    # 1.7 s are 8.4 % of the first station's bursts, 2.4 s are 12 %.
    drawn = Decoded()
    drawn.station(4, 0, 20)
    drawn.station(4, 8, 8 + seconds, zero_s=0.0101)
    assert drawn.found().doubled_channels == doubled


@pytest.mark.parametrize(("evidence_bits", "channels"), [(27.9, []), (28.0, [4])])
def test_bursts_of_little_evidence_do_not_vote(evidence_bits: float, channels: list[int]) -> None:
    drawn = Decoded()
    drawn.station(4, 0, 1)
    drawn.rows[0][3] = evidence_bits
    assert list(drawn.found().rotors) == channels


@pytest.mark.parametrize(("ppm", "expected"), [(195.0, 195.0), (-195.0, -195.0), (205.0, 0.0)])
def test_periods_beyond_the_clocks_are_not_estimated(ppm: float, expected: float) -> None:
    drawn = Decoded()
    drawn.station(4, 0, 4, ppm=ppm, scatter_s=0.0)
    tick, _, index, _ = drawn.rows[0]
    period = _estimate_period(4, tick, index.astype(np.int64), RATE)
    nominal = TICKS[4] / 48e6 * RATE
    assert (period / nominal - 1) * 1e6 == pytest.approx(expected, abs=1.0)


@pytest.mark.parametrize(("shift_s", "restarts"), [(15e-6, 0), (50e-6, 1), (-50e-6, 1)])
def test_a_restart_is_a_shift_of_more_than_20_us(shift_s: float, restarts: int) -> None:
    drawn = Decoded()
    turn = TICKS[4] / 48e6
    drawn.station(4, 0, 5)
    drawn.station(4, 300 * turn, 300 * turn + 5, zero_s=0.003 + shift_s)
    assert drawn.found().rotors[4].restart_count == restarts


def test_start_is_the_inverse_of_rotation_and_phase() -> None:
    drawn = Decoded()
    drawn.station(4, 0, 20, ppm=5, wander=np.array([1e-5, 11.0]))
    rotor = drawn.found().rotors[4]
    rotation = np.arange(0, 900, 7)
    start = rotor.start_tick(rotation)
    number, phase = rotor.rotation_and_phase(start + 0.25 * rotor.period_tick)
    assert np.array_equal(number, rotation)
    assert phase == pytest.approx(np.full(len(rotation), 0.25), abs=5e-6)
