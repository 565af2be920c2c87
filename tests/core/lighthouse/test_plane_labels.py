"""Planes, channels and counts of pulses without labels, on simulated flights."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.plane_labels import (
    LabelledPulses,
    assign_planes,
    label_planes,
    label_pulses,
    track_rotor,
)

Columns = dict[str, np.ndarray]


def label(frames: Columns) -> LabelledPulses:
    return label_pulses(*(frames[name] for name in ("tick", "sensor", "channel", "offset")))


def errors(frames: Columns, labels: LabelledPulses) -> tuple[np.ndarray, np.ndarray]:
    """Whether each label is right, and the errors of the angles of those [rad]."""
    row = labels.row
    is_right = (labels.channel == frames["true_channel"][row]) & (
        labels.plane == frames["plane"][row]
    )
    angle = 2 * np.pi * (labels.count / period_counts(labels.channel) - frames["fraction"][row])
    return is_right, angle[is_right]


@pytest.mark.parametrize(("count", "speed"), [(1, 1.0), (2, 0.0), (2, 2.0), (3, 1.0)])
def test_pulses_of_a_deck_are_labelled(crazyflie: ModuleType, count: int, speed: float) -> None:
    flight = crazyflie.Flight(10.0, speed, crazyflie.stations(count))
    frames = crazyflie.deck_frames(flight, np.random.default_rng(11))
    labels = label(frames)
    is_right, angle = errors(frames, labels)
    # Half of the pulses have no channel, and 5 % of the passages are hidden.
    assert np.mean(frames["channel"] > 0) < 0.6
    assert len(labels.row) >= 0.96 * len(frames["tick"])
    assert np.mean(~is_right) <= 1e-3
    # A tick is 13 urad, the jitter 1.5 ticks.
    assert np.sqrt(np.mean(angle**2)) < 24e-6
    assert np.abs(angle).max() < 200e-6
    assert len(labels.row) + sum(labels.rejected.values()) == len(frames["tick"])
    assert np.all(np.diff(labels.row) > 0)


def test_order_of_the_pulses_does_not_matter(crazyflie: ModuleType) -> None:
    frames = crazyflie.deck_frames(crazyflie.Flight(3.0), np.random.default_rng(2))
    shuffled = np.random.default_rng(3).permutation(len(frames["tick"]))
    labels = label(frames)
    again = label({name: values[shuffled] for name, values in frames.items()})
    order = np.argsort(shuffled[again.row])
    np.testing.assert_array_equal(shuffled[again.row][order], labels.row)
    np.testing.assert_array_equal(again.plane[order], labels.plane)
    np.testing.assert_allclose(again.count[order], labels.count, atol=1e-6)
    assert again.rejected == labels.rejected


def test_a_single_photodiode_is_labelled(crazyflie: ModuleType) -> None:
    """One photodiode has no groups of four, which the firmware needs."""
    frames = crazyflie.deck_frames(
        crazyflie.Flight(6.0), np.random.default_rng(4), unknown=0.3, lost=0.0
    )
    alone = frames["sensor"] == 2
    frames = {name: values[alone] for name, values in frames.items()}
    known = np.random.default_rng(5).random(len(frames["tick"])) < 0.7
    nominal = period_counts(frames["true_channel"])
    frames["channel"] = np.where(known, frames["true_channel"], -1)
    frames["offset"] = np.where(known, 4 * np.rint(frames["fraction"] * nominal), 0).astype(int)
    labels = label(frames)
    is_right, _ = errors(frames, labels)
    assert len(labels.row) >= 0.9 * len(frames["tick"])
    assert np.mean(~is_right) <= 1e-3


def test_noise_is_rejected(crazyflie: ModuleType) -> None:
    frames = crazyflie.deck_frames(crazyflie.Flight(6.0), np.random.default_rng(6))
    rng = np.random.default_rng(7)
    n = len(frames["tick"])
    noise = {name: np.zeros(n, np.int64) for name in frames}
    noise["tick"] = rng.integers(0, frames["tick"].max(), n)
    noise["sensor"] = rng.integers(0, 4, n)
    noise["channel"][:] = -1
    both = {name: np.concatenate([frames[name], noise[name]]) for name in frames}
    labels = label(both)
    # By chance 1e-3 agree with each of two planes of two stations, or are near a passage.
    assert np.mean(labels.row >= n) < 0.01
    assert np.count_nonzero(labels.row < n) >= 0.9 * n


def test_a_station_without_a_regular_rotor_is_refused(crazyflie: ModuleType) -> None:
    frames = crazyflie.deck_frames(crazyflie.Flight(3.0), np.random.default_rng(8))
    rng = np.random.default_rng(9)
    stray = rng.choice(len(frames["tick"]), 40, replace=False)
    frames["channel"][stray] = 9
    frames["offset"][stray] = 4 * rng.integers(1, 100_000, 40)
    labels = label(frames)
    assert set(labels.channel.tolist()) == {1, 2}
    assert labels.rejected["rotor_unknown"] == 40


def test_two_stations_on_one_channel_are_refused(crazyflie: ModuleType) -> None:
    stations = crazyflie.stations(2)
    stations[1].channel = 1
    frames = crazyflie.deck_frames(
        crazyflie.Flight(4.0, 0.5, stations), np.random.default_rng(10), wrong_offset=0.0
    )
    assert len(label(frames).row) == 0


def test_a_rotor_that_was_restarted_keeps_its_counts(crazyflie: ModuleType) -> None:
    frames = crazyflie.deck_frames(crazyflie.Flight(8.0), np.random.default_rng(12))
    late = (frames["t"] > 4.0) & (frames["true_channel"] == 2)
    frames["tick"] = frames["tick"] + np.where(late, 123_456, 0)
    labels = label(frames)
    is_right, angle = errors(frames, labels)
    assert len(labels.row) >= 0.85 * len(frames["tick"])
    assert np.mean(~is_right) <= 2e-3
    assert np.abs(angle).max() < 200e-6


def test_wrong_offsets_are_found(crazyflie: ModuleType) -> None:
    frames = crazyflie.deck_frames(
        crazyflie.Flight(5.0), np.random.default_rng(13), wrong_offset=0.05
    )
    labels = label(frames)
    rejected = labels.rejected["offset_contradicts_rotor"]
    assert 0.03 < rejected / np.count_nonzero(frames["offset"]) < 0.07
    assert np.abs(errors(frames, labels)[1]).max() < 200e-6


def test_no_pulses_have_no_labels() -> None:
    nothing = np.zeros(0, np.int64)
    assert len(label_pulses(nothing, nothing, nothing, nothing).row) == 0
    unknown = np.full(5, -1)
    labels = label_pulses(np.arange(5) * 10**6, np.zeros(5, int), unknown, np.zeros(5, int))
    assert labels.rejected == {"channel_unknown": 5}


@given(
    ppm=st.floats(-150, 150),
    zero=st.floats(0, 479_500),
    seed=st.integers(0, 2**32 - 1),
    wander=st.floats(0, 20),
)
def test_the_phase_of_a_rotor_is_followed(
    ppm: float, zero: float, seed: int, wander: float
) -> None:
    rng = np.random.default_rng(seed)
    period = 479_500.0
    turn = np.sort(rng.integers(0, 400, 500))
    true_zero = zero + turn * period * (1 + ppm * 1e-6) + wander * np.sin(turn / 150)
    offset = 4 * rng.integers(20_000, 100_000, 500)
    tick = np.rint(true_zero + offset * (1 + ppm * 1e-6) + rng.normal(0, 1.5, 500)).astype(np.int64)
    offset[rng.random(500) < 0.03] = 40_000
    track = track_rotor(tick, offset, period)
    assert track is not None
    error = track.phase_at(np.rint(true_zero).astype(np.int64)) - true_zero
    error -= period * np.rint(error / period)
    assert np.abs(error).max() < 4  # 0.2 us, 50 urad


# ---- pauses and stray pulses, by a simulation of regular passages


def intermittent(
    rng: np.random.Generator, starts_s: np.ndarray, seconds: float, channels: tuple[int, ...]
) -> Columns:
    """Frames of a moving deck that receives light for ``seconds`` from each of ``starts_s``.

    The rotors wander by 12 to 32 ticks of 24 MHz within a minute.
    """
    parts = []
    for channel in channels:
        period = {1: 479_500, 2: 478_500, 3: 476_500, 4: 474_500}[channel]
        turns = [np.arange(int(s * 24e6 / period), int((s + seconds) * 24e6 / period))
                 for s in starts_s]  # fmt: skip
        turn = np.concatenate(turns)
        t = turn * period / 24e6
        ppm, begin, minute = rng.uniform(-1e-4, 1e-4), rng.uniform(0, 6.28), rng.uniform(40, 80)
        zero = rng.uniform(0, period) + turn * period * (1 + ppm)
        zero += rng.uniform(12, 32) * np.sin(2 * np.pi * t / minute + begin)
        for plane in (0, 1):
            is_hidden = rng.random(len(turn)) < 0.05
            for sensor in range(4):
                path = 0.04 * np.sin(t + begin) + (-1) ** plane * 0.02 * np.sin(1.3 * t)
                fraction = (1 + plane) / 3 + path + 0.0007 * sensor
                light = zero + fraction * period * (1 + ppm) + rng.normal(0, 1.5, len(turn))
                row = np.ones(len(turn), np.int64)
                columns = (np.rint(light), sensor * row, channel * row, plane * row, fraction)
                is_received = ~is_hidden & (rng.random(len(turn)) >= 0.03)
                parts.append(np.column_stack(columns)[is_received])
    table = np.concatenate(parts)
    table = table[np.argsort(table[:, 0])]
    tick, sensor, channel, plane = table[:, :4].astype(np.int64).T
    group = np.cumsum(np.diff(tick, prepend=tick[0]) > 10_000)
    is_known = (np.diff(group, prepend=-1) == 0) & (rng.random(len(tick)) < 0.7)
    offset = np.zeros(len(tick), np.int64)
    for each in channels:
        mine = np.flatnonzero(is_known & (channel == each))
        chosen = mine[np.unique(group[mine], return_index=True)[1]]
        nominal = {1: 119_875, 2: 119_625, 3: 119_125, 4: 118_625}[each]
        offset[chosen] = 4 * np.rint(table[chosen, 4] * nominal)
    return {
        "tick": tick, "sensor": sensor, "channel": np.where(is_known, channel, -1),
        "offset": offset, "true_channel": channel, "plane": plane, "fraction": table[:, 4],
    }  # fmt: skip


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize(("seconds", "pause_s"), [(3, 1), (0.3, 5), (0.7, 20), (0.3, 60), (3, 60)])
def test_light_is_labelled_before_and_after_a_pause(
    seconds: float, pause_s: float, count: int
) -> None:
    """In a pause the phase of a rotor changes by more than between two averages."""
    starts_s = np.arange(5) * (seconds + pause_s)
    channels = tuple(range(1, count + 1))
    frames = intermittent(np.random.default_rng(20), starts_s, seconds, channels)
    labels = label(frames)
    is_right, angle = errors(frames, labels)
    assert labels.rejected.get("rotor_unknown", 0) == 0
    assert len(labels.row) >= 0.85 * len(frames["tick"])
    assert np.mean(~is_right) <= 2e-3
    assert np.abs(angle).max() < 200e-6


@pytest.mark.parametrize("restart_ticks", [123_456, 200])
def test_a_rotor_that_restarts_in_a_pause_has_no_wrong_phase(restart_ticks: int) -> None:
    """A shift by chance of a few microseconds is not noticed, and does no harm."""
    frames = intermittent(np.random.default_rng(21), np.array([0.0, 7.0]), 2.0, (1,))
    frames["tick"] = frames["tick"] + np.where(frames["tick"] > 5 * 24e6, restart_ticks, 0)
    labels = label(frames)
    is_right, angle = errors(frames, labels)
    assert is_right.all()
    assert np.abs(angle).max() < 250e-6
    assert len(labels.row) >= 0.8 * len(frames["tick"])


@pytest.mark.parametrize(("span", "most"), [(2, 1.0e-3), (3, 1.6e-3), (4, 0.0), (10, 0.0)])
def test_chance_agreements_of_a_stray_pulse_are_few(span: int, most: float) -> None:
    """A photodiode is hit in each ``span``-th rotation, and by other light in between."""
    rng = np.random.default_rng(22)
    n, period = 4000, 479_500
    zero = np.arange(n) * span * period
    offset = np.tile([4 * 40_000, 4 * 80_000], n)
    tick = np.repeat(zero, 2) + offset
    stray = zero + rng.integers(period, span * period, n)
    nothing = np.zeros(3 * n, np.int64)
    labels = label_pulses(
        np.concatenate([tick, stray]),
        nothing,
        np.repeat([1, 1, -1], n),
        np.concatenate([offset, np.zeros(n, np.int64)]),
    )
    assert np.count_nonzero(labels.row < 2 * n) == 2 * n
    chance = np.count_nonzero(labels.row >= 2 * n) / n / 2
    assert chance <= most + 3 * np.sqrt(most / n / 2)


def test_one_pulse_of_a_photodiode_is_labelled_in_a_rotation() -> None:
    """Of several ones of unknown channel in a passage, it is the nearest to the path."""
    n, period = 40, 479_500
    turn = np.repeat(np.arange(n), 8)
    sensor, plane = np.tile(np.arange(4), 2 * n), np.tile(np.repeat([0, 1], 4), n)
    offset = 4 * (40_000 + 40_000 * plane + 100 * sensor)
    tick = turn * period + offset
    channel = np.ones(8 * n, np.int64)
    lost = np.flatnonzero((turn == 20) & (sensor == 2) & (plane == 1))
    channel[lost], offset[lost] = -1, 0
    more = tick[lost] + np.array([-60, 90, 2_000])  # 0.8 to 26 mrad away
    unknown = np.full(3, -1)
    labels = label_pulses(
        np.append(tick, more),
        np.append(sensor, [2, 2, 2]),
        np.append(channel, unknown),
        np.append(offset, np.zeros(3, np.int64)),
    )
    np.testing.assert_array_equal(labels.row, np.arange(8 * n))
    np.testing.assert_array_equal(labels.plane, plane)
    assert labels.rejected == {"channel_unknown": 3}


# ---- planes


def passages(flight: object) -> Columns:
    """Sweeps of a flight with a number for each passage."""
    truth: Columns = flight.crossings()  # type: ignore[attr-defined]
    key = truth["channel"] * 10**7 + truth["turn"] * 2 + truth["plane"]
    truth["passage"] = np.unique(key, return_inverse=True)[1]
    return truth


@pytest.mark.parametrize("turned_deg", [0, 45, -45])
@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_planes_follow_from_neighbouring_rotations(
    crazyflie: ModuleType, turned_deg: float, hidden: float
) -> None:
    """Passages without a partner, also far beside the station's axis, and reflections."""
    stations = crazyflie.stations(2)
    turn = crazyflie.rotations(np.deg2rad([turned_deg]), np.zeros(1), np.zeros(1))[0]
    for station in stations:
        station.rotation = station.rotation @ turn
    truth = passages(crazyflie.Flight(8.0, 1.5, stations))
    rng = np.random.default_rng(14)
    n = truth["passage"].max() + 1
    is_kept = (rng.random(n) >= hidden)[truth["passage"]]
    shift = np.where(rng.random(n) < 0.05, rng.uniform(-0.3, 0.3, n), 0.0)[truth["passage"]]
    fraction = np.clip(truth["fraction"] + shift, 0.02, 0.98)
    duration = (truth["t"] - truth["zero"]) / truth["fraction"]
    time_ns = np.rint((truth["zero"] + fraction * duration) * 1e9).astype(np.int64)
    count = fraction * period_counts(truth["channel"])
    plane = assign_planes(time_ns[is_kept], truth["channel"][is_kept], count[is_kept])
    is_direct = shift[is_kept] == 0
    is_wrong = (plane >= 0) & (plane != truth["plane"][is_kept])
    assert np.mean(is_wrong[is_direct]) < 1e-3
    assert np.mean(plane[is_direct] < 0) < 0.01
    # Half of the reflections are further away than a quarter of the angle between the planes.
    assert np.mean(plane[~is_direct] < 0) > 0.3


def test_a_lone_passage_is_labelled_near_the_axis_only() -> None:
    phases = np.array([0.2, 0.35, 0.45, 0.55, 0.65, 0.9])
    planes = [int(label_planes(np.zeros(1, np.int64), phases[k : k + 1])[0]) for k in range(6)]
    assert planes == [0, 0, -1, -1, 1, 1]


def test_a_lone_passage_beside_its_neighbours_is_ambiguous() -> None:
    """A reflection near the axis, in a rotation without direct light."""
    rotation = np.append(np.repeat(np.arange(10), 2), 10)
    phase = np.append(np.tile([0.35, 0.68], 10), 0.2)
    assert label_planes(rotation, phase)[-1] == -1


def test_three_passages_without_neighbours_are_ambiguous() -> None:
    rotation = np.zeros(3, np.int64)
    assert label_planes(rotation, np.array([0.3, 0.5, 0.7])).tolist() == [-1, -1, -1]


def test_a_pair_that_contradicts_its_neighbours_is_not_trusted() -> None:
    """In one rotation the first plane is hidden, and the second one has a reflection."""
    rotation = np.repeat(np.arange(11), 2)
    phase = np.tile([0.35, 0.68], 11)
    phase[10:12] = [0.68, 0.9]
    plane = label_planes(rotation, phase)
    assert plane[10:12].tolist() == [1, -1]
    np.testing.assert_array_equal(np.delete(plane, [10, 11]), np.tile([0, 1], 10))
