"""From light to sweeps: drawn here with all that goes wrong, and published."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import PARAMETERS
from locatk.core.lighthouse.demodulation import ootx
from locatk.core.lighthouse.demodulation.pipeline import (
    DemodulatedRecording,
    _count_missed,
    demodulate_recording,
    latest_factory_data,
    slow_bits,
)
from locatk.core.lighthouse.demodulation.rotor import Rotor
from locatk.core.lighthouse.recording import Edges

CAPTURE = "benchmarks/demodulation_code/logic_analyser_capture.sal"


def codes(got: DemodulatedRecording) -> list[str]:
    """Codes of the warnings about a recording."""
    return [warning.code for warning in got.warnings]


def paired(got: DemodulatedRecording, passed: Any, path: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rows of caught sweeps and of the true ones that they are."""
    sweeps = got.sweeps
    time = sweeps.tick / path.rate_hz / (1 + path.clock_ppm * 1e-6)
    at = np.searchsorted(passed.time_s, time)
    row = np.full(len(time), -1)
    for step in range(-4, 5):
        near = np.clip(at + step, 0, len(passed.time_s) - 1)
        own = (passed.channel[near] == sweeps.channel) & (passed.sensor[near] == sweeps.sensor)
        own &= np.abs(passed.time_s[near] - time) < 5e-6
        row[own] = near[own]
    caught = np.flatnonzero(row >= 0)
    return caught, row[caught]


def factory(channel: int, number: int) -> tuple[int, ...]:
    """Slow bits of a station's factory data."""
    numbers = np.array([0, 0.002, -0.05, 0.047], "<f2").tobytes()
    more = np.array([0.09, 0.19], "<f2").tobytes()
    last = np.array([1.8, 2.3, -0.005, -0.006], "<f2").tobytes()
    payload = struct.pack("<HI", 0x0A08, number) + numbers + b"\1\x0f" + more + b"\2\x7f\xfe"
    payload += last + bytes([0x80 | channel - 1, 0]) + bytes(8) + b"\x46\x09"
    return tuple(ootx.encode_frame(payload).tolist())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_hz", "resolution_hz"),
    [(24e6, None), (40e6, None), (1e9, 5e8), (1e9, 24e6)],
)
def test_all_at_once(light: Any, rate_hz: float, resolution_hz: float | None) -> None:
    path = light.Receiving(
        rate_hz=rate_hz, resolution_hz=resolution_hz, clock_ppm=20, delay_s=2e-8, jitter_s=8e-9,
        rim_s=2e-6, lost=0.03, missing=0.05, spoiled=0.1,
    )  # fmt: skip
    senders = [
        light.Sender(1, ppm=-15, wander=lambda time: 3e-7 * np.sin(0.5 * time)),
        light.Sender(2, zero_s=0.001, ppm=12),
        light.Sender(16, zero_s=0.007, ppm=30),
    ]
    lines, passed = light.of(senders, 5.0, path, sensors=2)
    got = demodulate_recording(lines)
    caught, row = paired(got, passed, path)
    clean = np.count_nonzero(~passed.spoiled)
    # Where two stations shine at once a sweep is lost, or its middle is; and a fragment of a
    # spoiled one may look right.
    assert clean * 0.985 < len(caught) <= len(got.sweeps) < clean * 1.005
    assert np.mean(passed.polynomial[row] != got.sweeps.polynomial[caught]) < 5e-4
    assert np.mean(passed.plane[row] != got.sweeps.plane[caught]) < 2e-3
    off = got.sweeps.count[caught] - passed.count[row]
    assert abs(np.median(off)) < 0.15
    assert np.percentile(np.abs(off), 50) < 1.5
    assert np.percentile(np.abs(off), 95) < 6
    time = got.sweeps.tick[caught] / rate_hz / (1 + 20e-6)
    assert np.percentile(np.abs(time - passed.time_s[row]), 50) < 2.5e-7
    for sender in senders:
        ppm = got.rotors[sender.channel].period_deviation_ppm(rate_hz)
        assert ppm == pytest.approx(sender.ppm + 20, abs=0.15)
    for station in got.stations:
        rate = np.mean(~passed.spoiled[passed.channel == station.channel])
        assert station.decode_rate == pytest.approx(rate, abs=0.02)


def test_clean_light_to_a_fraction_of_a_bit(light: Any) -> None:
    path = light.Receiving(rate_hz=100e6)
    lines, passed = light.of([light.Sender(3, ppm=8)], 5.0, path)
    got = demodulate_recording(lines)
    off = np.abs(got.sweeps.count - passed.count)
    assert np.median(off) < 0.3
    assert off.max() < 1.5
    assert np.array_equal(got.sweeps.polynomial, passed.polynomial)
    assert np.array_equal(got.sweeps.plane, passed.plane)


@pytest.mark.slow
@pytest.mark.parametrize("first", [1, 5, 9, 13])
def test_each_channel(light: Any, first: int) -> None:
    channels = range(first, first + 4)
    senders = [light.Sender(c, ppm=c, zero_s=0.0007 * c, slow=(0, 1)) for c in channels]
    lines, passed = light.of(senders, 1.0)
    got = demodulate_recording(lines)
    assert [station.channel for station in got.stations] == list(channels)
    assert set(got.sweeps.polynomial.tolist()) == set(passed.polynomial.tolist())
    for station in got.stations:
        nominal = light.ticks[station.channel]
        assert station.period_ticks == pytest.approx(
            nominal * (1 + station.channel * 1e-6), rel=2e-7
        )


@pytest.mark.slow
def test_factory_data_of_two_stations(light: Any) -> None:
    senders = [
        light.Sender(4, slow=factory(4, 0xABCDEF01)),
        light.Sender(9, slow=factory(9, 0x12345678), zero_s=0.002),
    ]
    path = light.Receiving(missing=0.1, spoiled=0.05, rim_s=1e-6)
    lines, _ = light.of(senders, 20.0, path)
    got = demodulate_recording(lines)
    assert [station.id for station in got.stations] == [0xABCDEF01, 0x12345678]
    for station in got.stations:
        assert station.calibration is not None
        assert station.calibration.source == "factory"
        assert station.frames >= 1
        assert station.damaged == 0
    assert got.warnings == ()


def test_a_station_that_reports_another_channel(light: Any) -> None:
    lines, _ = light.of([light.Sender(4, slow=factory(7, 5))], 10.0)
    got = demodulate_recording(lines)
    (warning,) = got.warnings
    assert warning.code == "channel_mismatch"
    assert "channel 4" in warning.message
    assert "channel 7" in warning.message


@pytest.mark.slow
def test_missed_sweeps_are_counted(light: Any) -> None:
    path = light.Receiving(spoiled=0.1, rim_s=1e-6)
    lines, passed = light.of([light.Sender(2)], 10.0, path, sensors=2)
    (station,) = demodulate_recording(lines).stations
    assert station.missed == pytest.approx(passed.spoiled.sum(), rel=0.03)
    assert station.decode_rate == pytest.approx(0.9, abs=0.015)
    # What did not arrive is not missed.
    lines, _ = light.of([light.Sender(2)], 5.0, light.Receiving(missing=0.3))
    assert demodulate_recording(lines).stations[0].decode_rate == 1.0


def test_motion_capture_is_dropped(light: Any) -> None:
    noise = np.random.default_rng(0)
    flashes = []
    for start in np.arange(0.0013, 2.9, 0.0101):
        rise = start + np.arange(noise.integers(100, 1000)) * 1e-6 + noise.uniform(0, 1e-6)
        flashes += [rise, rise + 5e-7]
    other = np.concatenate(flashes) + noise.normal(0, 8e-9, sum(map(len, flashes)))
    senders = [light.Sender(1), light.Sender(2, zero_s=0.0012)]
    lines, passed = light.of(senders, 3.0, others=[np.sort(other)])
    got = demodulate_recording(lines)
    assert got.mocap_flashes == pytest.approx(len(flashes) / 2, rel=0.06)
    assert codes(got) == ["mocap_flashes"]
    caught, row = paired(got, passed, light.Receiving())
    assert len(got.sweeps) <= len(caught) + 2
    # A sweep under a flash is lost; all others are not.
    lit = np.zeros(len(passed.time_s), bool)
    for rise in flashes[::2]:
        lit |= (passed.time_s > rise[0] - 2e-5) & (passed.time_s < rise[-1] + 2e-5)
    assert np.isin(np.flatnonzero(~lit), row).mean() > 0.99
    assert set(got.rotors) == {1, 2}


@pytest.mark.slow
def test_light_that_does_not_end(light: Any) -> None:
    # A tenth of a second without a gap, right behind a sweep, is one burst.
    (line,), passed = light.of([light.Sender(3)], 0.7)
    last = line.tick[np.searchsorted(line.tick, 0.4 * 40e6) - 1] + 80
    tick = np.union1d(line.tick, last + 9 * np.arange(440_000))
    got = demodulate_recording([replace(line, tick=tick)])
    left = passed.time_s[(passed.time_s < 0.3999) | (passed.time_s > 0.5)]
    assert len(left) - 4 <= len(got.sweeps) <= len(left) + 2


@pytest.mark.slow
def test_two_stations_on_one_channel(light: Any) -> None:
    doubled = [light.Sender(3), light.Sender(3, zero_s=0.011, ppm=5)]
    lines, passed = light.of([*doubled, light.Sender(9, zero_s=0.002)], 5.0)
    got = demodulate_recording(lines)
    assert set(got.sweeps.channel.tolist()) == {9}
    assert len(got.sweeps) > 0.97 * np.count_nonzero(passed.channel == 9)
    assert codes(got) == ["doubled_channel"]
    assert "more than one station sends on channel 3" in got.warnings[0].message
    lines, _ = light.of(doubled, 5.0)
    with pytest.raises(InputError, match="more than one station sends on channel 3"):
        demodulate_recording(lines)


def test_stations_come_and_go(light: Any) -> None:
    senders = [
        light.Sender(1, zero_s=0.001),
        light.Sender(3, since_s=3.0),
        light.Sender(7, until_s=2.5, zero_s=0.004),
    ]
    path = light.Receiving(spoiled=0.1)
    lines, passed = light.of(senders, 6.0, path)
    got = demodulate_recording(lines)
    assert [station.channel for station in got.stations] == [1, 3, 7]
    for station in got.stations:
        sent = np.count_nonzero((passed.channel == station.channel) & ~passed.spoiled)
        assert station.sweeps == pytest.approx(sent, rel=0.02)


def test_a_station_that_is_switched_off_and_on(light: Any) -> None:
    senders = [light.Sender(3, until_s=3), light.Sender(3, zero_s=0.0111, since_s=5)]
    path = light.Receiving(spoiled=0.1)
    lines, passed = light.of(senders, 9.0, path)
    got = demodulate_recording(lines)
    caught, row = paired(got, passed, path)
    assert len(caught) >= np.count_nonzero(~passed.spoiled)
    assert np.abs(got.sweeps.count[caught] - passed.count[row]).max() < 5
    assert np.array_equal(got.sweeps.plane[caught], passed.plane[row])
    assert codes(got) == ["station_restarted"]
    assert "channel 3" in got.warnings[0].message


def test_a_silence_of_two_hours(light: Any) -> None:
    path = light.Receiving()
    first, passed = light.of([light.Sender(3, ppm=4)], 6.0, path)
    second, later = light.of([light.Sender(3, ppm=4.2, zero_s=0.0077)], 6.0, path, seed=2)
    shift = round(7200 * path.rate_hz)
    tick = np.concatenate([first[0].tick, second[0].tick + shift])
    got = demodulate_recording([replace(first[0], tick=tick, end_tick=int(tick[-1]) + 1)])
    assert len(got.sweeps) == len(passed.time_s) + len(later.time_s)
    for part, offset in ((passed, 0.0), (later, 7200.0)):
        rows = np.searchsorted(got.sweeps.tick / path.rate_hz, part.time_s + offset - 1e-5)
        assert np.abs(got.sweeps.count[rows] - part.count).max() < 3
        assert np.array_equal(got.sweeps.plane[rows], part.plane)
    (station,) = got.stations
    assert station.missed == 0


def test_three_sweeps_and_short_recordings(light: Any) -> None:
    lines, passed = light.of([light.Sender(3, until_s=0.03)], 1.0, light.Receiving(missing=0.3))
    got = demodulate_recording(lines)
    assert len(got.sweeps) == len(passed.time_s) < 4
    assert got.rotors == {}
    assert np.abs(got.sweeps.count - passed.count).max() < 2
    assert got.stations[0].period_ticks is None
    lines, passed = light.of([light.Sender(3), light.Sender(5, zero_s=0.001)], 1.0)
    assert len(demodulate_recording(lines).sweeps) == len(passed.time_s)


def test_one_plane_only(light: Any) -> None:
    lines, passed = light.of([light.Sender(3, planes=(lambda time: 0.3,))], 2.0)
    got = demodulate_recording(lines)
    assert len(got.sweeps) == len(passed.time_s)
    assert np.all(got.sweeps.plane == -1)


@pytest.mark.parametrize("seed", range(3))
def test_no_light_of_a_station(light: Any, seed: int) -> None:
    noise = np.random.default_rng(seed)
    run = noise.choice([8.3e-8, 1.67e-7, 2.5e-7, 6e-8], 300_000)
    run[noise.random(len(run)) < 0.01] = 3e-4
    with pytest.raises(InputError, match="no light of a base station among"):
        demodulate_recording([light.edges(np.cumsum(run), 1.0)])


def test_nothing_to_read(light: Any) -> None:
    with pytest.raises(InputError, match="no data line"):
        demodulate_recording([])
    empty = Edges(np.zeros(0, np.int64), 40e6, 40e6, True, 100)
    with pytest.raises(InputError, match="among 0 bursts"):
        demodulate_recording([empty])
    # A photodiode in the shadow beside one in the light.
    (line,), passed = light.of([light.Sender(3)], 1.0)
    got = demodulate_recording([empty, line])
    assert len(got.sweeps) == len(passed.time_s)
    assert np.all(got.sweeps.sensor == 1)
    with pytest.raises(InputError, match="too few"):
        demodulate_recording([light.edges(line.tick / 40e6, 1.0, light.Receiving(rate_hz=20e6))])
    with pytest.raises(InputError, match="different clocks"):
        demodulate_recording([line, replace(empty, rate_hz=50e6, resolution_hz=50e6)])


def test_a_jump_of_a_clock_ends(light: Any) -> None:
    (line,), passed = light.of([light.Sender(3)], 1.0)
    tick = line.tick.copy()
    tick[len(tick) // 2 :] += 2**52
    got = demodulate_recording([replace(line, tick=tick, end_tick=int(tick[-1]) + 1)])
    assert len(got.sweeps) >= len(passed.time_s) - 1


@pytest.mark.slow
def test_the_published_capture(published: Callable[[str], Edges]) -> None:
    got = demodulate_recording([published(CAPTURE)])
    (reading,) = got.photodiodes
    assert len(reading.bursts) == 11_136
    taken = reading.is_accepted | (reading.continued_burst >= 0)
    assert taken.mean() >= 0.985
    assert np.all(reading.matches.polynomial[reading.is_accepted] < 4)
    assert np.mean(np.abs(reading.rotor_residual_s[reading.is_accepted]) < 1e-6) > 0.999
    first, second = got.stations
    assert (first.id, second.id) == (0x4CC60647, 0x0FF22226)
    assert first.frames >= 3
    assert second.frames >= 2
    assert (first.damaged, second.damaged) == (0, 0)
    assert got.rotors[1].period_deviation_ppm(40e6) == pytest.approx(-15.49, abs=0.05)
    assert got.rotors[2].period_deviation_ppm(40e6) == pytest.approx(-18.69, abs=0.05)
    assert first.calibration is not None
    names = ("phase", "tilt", "curve", "gibphase", "gibmag")
    columns = [first.calibration.sweeps[:, PARAMETERS.index(name)].tolist() for name in names]
    assert np.ravel(columns).tolist() == pytest.approx(
        [0, 0.002192, -0.05075, 0.04794, 0.09015, 0.1891, 1.865, 2.307, -0.00575, -0.006054],
        rel=1e-3,
    )


@pytest.mark.parametrize(("name", "least"), [("fpga/take1.csv", 103), ("fpga/about_4m.csv", 95)])
def test_published_captures_of_the_deck(
    published: Callable[[str], Edges], name: str, least: int
) -> None:
    got = demodulate_recording([published(name)])
    (reading,) = got.photodiodes
    assert len(reading.bursts) == 103
    assert reading.is_accepted.sum() >= least
    assert set(got.sweeps.channel.tolist()) == {7}
    assert got.rotors[7].period_deviation_ppm(1e9) == pytest.approx(-12, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("rate_hz", "least"), [(24e6, 0.94), (32e6, 0.97)])
def test_the_published_capture_at_lower_rates(
    published: Callable[[str], Edges], light: Any, rate_hz: float, least: float
) -> None:
    edges = published(CAPTURE)
    lower = light.edges(edges.tick[:800_000] / 40e6, 20.0, light.Receiving(rate_hz=rate_hz))
    got = demodulate_recording([lower])
    (reading,) = got.photodiodes
    assert (reading.is_accepted | (reading.continued_burst >= 0)).mean() > least
    assert np.all(reading.matches.polynomial[reading.is_accepted] < 4)


def test_a_rotor_that_wanders_within_seconds_does_not_move_a_standing_photodiode(
    data: Path,
) -> None:
    """A sweep counts by its own bits: by the followed phase these scatter by 1.08 and 3.05."""
    from locatk.formats.importers.saleae.recording import read_light

    for name, plane, limit in (("take1", 0, 0.6), ("about_4m", 1, 2.6)):
        caught = demodulate_recording(
            read_light(data / "lighthouse" / "fpga" / f"{name}.csv")
        ).sweeps
        count = caught.count[caught.plane == plane]
        assert len(count) > 45
        assert 1.4826 * np.median(np.abs(count - np.median(count))) < limit


# ---- stages


def test_slow_bits_of_rotations() -> None:
    rotor = Rotor(3, 100.0, 0.0, np.array([0.0, 1e6]), np.zeros(2), 9, 0, 1.0)
    tick = np.array([10.0, 40.0, 110.0, 140.0, 310.0, 100_010.0])
    bits = slow_bits(tick, np.array([4, 5, 5, 5, 4, 5], np.int32), rotor)
    # Sweeps of rotation 0 disagree, rotation 2 has none, and 997 rotations become 500.
    assert bits[:4].tolist() == [-1, 1, -1, 0]
    assert len(bits) == 3 + 500 + 1
    assert bits[-1] == 1
    assert np.all(bits[4:-1] == -1)


def test_the_latest_usable_factory_data() -> None:
    valid = ootx.decode_frames(factory(4, 17))[0]
    broken = bytearray(valid.payload)
    broken[8:10] = struct.pack("<H", 0x7E00)
    frames = [valid, replace(valid, payload=bytes(broken))]
    data, warnings = latest_factory_data(4, frames)
    assert data is not None
    assert data.id == 17
    assert [warning.code for warning in warnings] == ["invalid_factory_data"]
    data, warnings = latest_factory_data(5, [valid])
    assert data is not None
    assert [warning.code for warning in warnings] == ["channel_mismatch"]
    assert latest_factory_data(4, []) == (None, [])


def test_the_light_of_a_doubled_channel_alone_is_an_error_with_a_remedy(light: Any) -> None:
    senders = [light.Sender(3), light.Sender(3, zero_s=0.011)]
    lines, _ = light.of(senders, 2.0)
    with pytest.raises(InputError, match="more than one station") as raised:
        demodulate_recording(lines)
    assert raised.value.hint == "Set each station to a channel of its own"


def test_a_rejected_burst_near_a_decoded_sweep_is_not_missed(light: Any) -> None:
    (line,), _ = light.of([light.Sender(2)], 2.0)
    got = demodulate_recording([line])
    validated, rotor = got.photodiodes[0], got.rotors[2]
    rows = np.arange(len(got.sweeps))
    accepted = validated.is_accepted.copy()
    accepted[20] = False
    rejected = replace(validated, is_accepted=accepted)
    # Its sweep was decoded, as from another burst; without that sweep it was missed.
    assert _count_missed(0, rejected, got.sweeps, rows, rotor, line.rate_hz) == 0
    others = np.delete(rows, 20)
    assert _count_missed(0, rejected, got.sweeps, others, rotor, line.rate_hz) == 1
