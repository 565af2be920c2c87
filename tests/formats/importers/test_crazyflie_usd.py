"""Logs of a Crazyflie's micro SD card: the format, clocks, events, and what damage does to them."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import zlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.geometry import matrix_from_quaternion
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.receiver import DECK
from locatk.formats.importers.crazyflie_usd.log_file import UsdLog, parse_usd_log, read_usd_log
from locatk.formats.importers.crazyflie_usd.recording import clock_rates, read_crazyflie_usd
from locatk.formats.importers.crazyflie_usd.variables import decompress_quaternions
from locatk.formats.importers.imported_session import ImportedSession

PATH = Path("log00")
START_NS = 1_000_000_000
"""Time of the first event in a session without dates."""


def small_log(crazyflie: ModuleType, version: int = 2) -> Any:
    log = crazyflie.UsdWriter(version)
    log.event_type(65535, "fixedFrequency", "acc.x:f range.zrange:H")
    log.event_type(4, "estDistance", "id:B distance:e")
    log.event_type(9, "estFlow", "timestamp:B")
    for k in range(6):
        log.add(1.0 + 0.01 * k, 65535, 0.5 * k, 40 + k)
        log.add(1.002 + 0.01 * k, 4, k, 0.25 * k)
    return log


# ---- the file


@pytest.mark.parametrize("version", [1, 2])
def test_events_are_read_by_name(crazyflie: ModuleType, version: int) -> None:
    log = parse_usd_log(small_log(crazyflie, version).data(), PATH)
    assert (log.version, log.damage, log.omitted) == (version, None, 0)
    assert list(log.events) == ["fixedFrequency", "estDistance", "estFlow"]
    fixed, distance = log.events["fixedFrequency"], log.events["estDistance"]
    np.testing.assert_array_equal(fixed.columns["acc.x"], 0.5 * np.arange(6))
    np.testing.assert_array_equal(fixed.columns["range.zrange"], np.arange(40, 46))
    np.testing.assert_array_equal(distance.columns["id"], np.arange(6))
    np.testing.assert_array_equal(distance.columns["distance"], 0.25 * np.arange(6))
    np.testing.assert_allclose(fixed.time_s, 1.0 + 0.01 * np.arange(6), atol=log.resolution_s)
    assert len(log.events["estFlow"]) == 0


TYPES = {"B": (0, 255), "b": (-128, 127), "H": (0, 65535), "h": (-32768, 32767),
         "I": (0, 2**32 - 1), "i": (-(2**31), 2**31 - 1)}  # fmt: skip


@given(seed=st.integers(0, 2**32 - 1), version=st.sampled_from([1, 2]))
def test_any_types_and_events_are_read(crazyflie: ModuleType, seed: int, version: int) -> None:
    rng = np.random.default_rng(seed)
    log = crazyflie.UsdWriter(version)

    def draw_names(count: int) -> list[str]:
        """Names of printable characters that differ in lower case."""
        sizes = rng.integers(1, 20, count)
        texts = (bytes(rng.integers(33, 127, size).tolist()).decode() for size in sizes)
        return list({text.lower(): text for text in texts}.values())

    def draw_value(letter: str) -> float:
        if letter not in TYPES:
            return float(rng.choice([0.0, -1.5, 512.0, np.inf]))
        low, high = TYPES[letter]
        return int(rng.choice([low, high, rng.integers(low, high, endpoint=True)]))

    numbers = rng.choice(65536, 4, replace=False).tolist()
    for number, name in zip(numbers, draw_names(rng.integers(1, 5)), strict=False):
        variables = draw_names(rng.integers(0, 6))
        letters = rng.choice([*TYPES, "f", "e"], len(variables)).tolist()
        log.types[number] = (name, list(zip(variables, letters, strict=True)))
    expected: dict[str, list[tuple[float, ...]]] = {name: [] for name, _ in log.types.values()}
    for k in range(rng.integers(0, 12)):
        number = int(rng.choice(list(log.types)))
        name, pairs = log.types[number]
        values = tuple(draw_value(letter) for _, letter in pairs)
        log.add(0.004 * k, number, *values)
        expected[name].append(values)
    read = parse_usd_log(log.data(), PATH)
    assert read.damage is None
    for name, rows in expected.items():
        event = read.events[name]
        assert len(event) == len(rows)
        columns = list(event.columns.values())
        assert [tuple(c[k] for c in columns) for k in range(len(rows))] == rows


@pytest.mark.parametrize("version", [1, 2])
def test_a_log_torn_at_any_byte_keeps_its_complete_events(
    crazyflie: ModuleType, version: int
) -> None:
    log = small_log(crazyflie, version)
    whole = log.data()
    header = len(log.header())
    sizes = np.cumsum([6 + (0 if version == 1 else 4) + size for size in 6 * [6, 3]])
    for end in range(len(whole)):
        if end < header:
            with pytest.raises(FormatError):
                parse_usd_log(whole[:end], PATH)
            continue
        read = parse_usd_log(whole[:end], PATH)
        assert sum(map(len, read.events.values())) == np.count_nonzero(sizes <= end - header)
        assert read.damage is not None


def test_a_wrong_checksum_is_reported(crazyflie: ModuleType) -> None:
    data = bytearray(small_log(crazyflie).data())
    data[-12] ^= 1  # a value of the last event
    read = parse_usd_log(bytes(data), PATH)
    assert read.damage is not None
    assert "checksum is wrong" in read.damage
    assert len(read.events["estDistance"]) == 6


def test_the_part_behind_a_damaged_time_is_not_read(crazyflie: ModuleType) -> None:
    """A damaged number of an event may be that of a shorter one, and all behind is shifted."""
    log = small_log(crazyflie)
    data = bytearray(log.data())
    position = len(log.header()) + 3 * (16 + 13)
    assert struct.unpack_from("<H", data, position)[0] == 65535
    data[position : position + 2] = struct.pack("<H", 4)
    read = parse_usd_log(bytes(data), PATH)
    assert read.damage is not None
    assert len(read.events["fixedFrequency"]) == 3
    assert len(read.events["estDistance"]) <= 4


def test_a_torn_log_of_sweeps_continues_after_a_long_gap(crazyflie: ModuleType) -> None:
    log = crazyflie.UsdWriter()
    log.event_type(7, "estSweepAngle", "sweepAngle:f")
    for k, time in enumerate([5.0, 5.1, 5.2, 505.2, 505.3, 505.4, 505.5]):
        log.add(time, 7, k)
    read = parse_usd_log(log.data(crc=False), PATH)
    assert len(read.events["estSweepAngle"]) == 7
    assert read.damage is not None
    assert "no complete event" not in read.damage
    # The time of one event is damaged: those behind it do not follow it.
    log.events[3] = (90_000.0, 7, (3,))
    read = parse_usd_log(log.data(crc=False, in_order=False), PATH)
    assert len(read.events["estSweepAngle"]) == 3


def test_zeros_behind_a_log_are_no_events(crazyflie: ModuleType) -> None:
    """A file system may have reserved space; 0 is also the number of an event."""
    log = small_log(crazyflie)
    log.event_type(0, "estGyroscope", "")
    read = parse_usd_log(log.data(crc=False) + bytes(400), PATH)
    assert sum(map(len, read.events.values())) == 12
    assert read.omitted == 0
    assert read.damage is not None
    assert "400 bytes" in read.damage


def test_the_longer_part_is_read_if_the_clock_was_set_to_zero(crazyflie: ModuleType) -> None:
    log = crazyflie.UsdWriter()
    log.event_type(65535, "fixedFrequency", "acc.x:f")
    for k, time in enumerate([50.0, 50.1, 50.2, 0.001, 0.1, 0.2, 0.3]):
        log.add(time, 65535, k)
    read = parse_usd_log(log.data(in_order=False), PATH)
    assert read.omitted == 3
    assert read.damage is None
    np.testing.assert_array_equal(read.events["fixedFrequency"].columns["acc.x"], [3, 4, 5, 6])


def test_other_files_are_refused(crazyflie: ModuleType) -> None:
    whole = small_log(crazyflie).data()
    third = whole[:1] + b"\3\0" + whole[3:]
    for data, text in (
        (b"", "not a log"),
        (b"Timestamp,acc.x\n1,2\n", "not a log"),
        (third + struct.pack("<I", zlib.crc32(third)), "version 3"),
        (whole.replace(b"acc.x(f)", b"acc.x(q)"), "unknown type"),
        (whole.replace(b"acc.x(f)", b"acc.x[f]"), "unknown type"),
        (whole.replace(b"range.zrange(H)", b"Acc.X(H)"), "two variables 'Acc.X'"),
        (whole.replace(b"\4\0estDistance", b"\x09\0estDistance"), "same name or number"),
        (whole.replace(b"estFlow", b"estF\xffow"), "damaged"),
    ):
        with pytest.raises(FormatError, match=text) as error:
            parse_usd_log(data, PATH)
        assert error.value.file == "log00"
        assert error.value.hint


@given(seed=st.integers(0, 2**32 - 1), changes=st.integers(1, 20), version=st.sampled_from([1, 2]))
def test_damaged_logs_are_read_or_refused(
    crazyflie: ModuleType, seed: int, changes: int, version: int
) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(small_log(crazyflie, version).data())
    for position in rng.integers(0, len(data), changes):
        data[position] = rng.integers(256)
    try:
        read = parse_usd_log(bytes(data), PATH)
    except LocatkError:
        return
    assert isinstance(read, UsdLog)


# ---- a session


def write(log: Any, folder: Path, **how: Any) -> Path:
    path = folder / "log00"
    path.write_bytes(log.data(**how))
    return path


def time_s(session: ImportedSession, offset_s: float = 0.0) -> np.ndarray:
    return (session.sweeps.time_ns - START_NS) * 1e-9 + offset_s


def check_sweeps(
    session: ImportedSession, flight: Any, *, tolerance_s: float, angle_rad: float = 1e-4
) -> None:
    """Every sweep is the one of the flight that was nearest in time, at the right angle."""
    sweeps, truth, times = session.sweeps, flight.crossings(), time_s(session)
    assert np.all(np.diff(times) >= 0)
    wrong = 0
    for channel in np.unique(sweeps.channel):
        for plane in (0, 1):
            for sensor in range(4):
                mine = (sweeps.channel == channel) & (sweeps.sweep == plane)
                mine &= sweeps.sensor == sensor
                of_truth = (truth["channel"] == channel) & (truth["plane"] == plane)
                of_truth &= truth["sensor"] == sensor
                light = truth["t"][of_truth]
                nearest = np.abs(light - times[mine][:, None]).argmin(axis=1)
                assert np.abs(light[nearest] - times[mine]).max() < tolerance_s
                turns = sweeps.count[mine] / period_counts(channel)
                error = 2 * np.pi * np.abs(turns - truth["fraction"][of_truth][nearest])
                wrong += np.count_nonzero(error > angle_rad)
    assert wrong <= 2e-3 * len(sweeps)


@pytest.mark.parametrize(("version", "rate"), [(2, 84 / 85), (2, 0.98906), (2, 1.0), (1, 1.0)])
def test_a_flight_becomes_a_session(
    crazyflie: ModuleType, tmp_path: Path, version: int, rate: float
) -> None:
    flight = crazyflie.Flight(6.0)
    log = crazyflie.write_flight(flight, np.random.default_rng(1), version=version, rate=rate)
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert session.lost is None
    assert session.warnings == []
    assert session.facts["not_used"] == "pm.vbat, range.zrange"
    assert len(session.sweeps) > 0.95 * sum(event[1] == 11 for event in log.events)
    check_sweeps(session, flight, tolerance_s=1e-4 if version == 2 else 1e-3)
    assert f"ran at {rate:.4f}"[:-1] in session.facts["clock"]
    np.testing.assert_array_equal(session.receivers["crazyflie"].position_m, DECK.position_m)

    [imu], [track] = session.imu, session.onboard
    assert (imu.device, track.device) == ("crazyflie", "crazyflie")
    tolerance_s = 1e-4 if version == 2 else 1.1e-3
    t = (imu.time_ns - START_NS) * 1e-9
    np.testing.assert_allclose(t, np.arange(len(t)) / 100, atol=tolerance_s)
    exact = np.arange(len(t)) / 100
    np.testing.assert_allclose(imu.acceleration, flight.acceleration(exact), atol=1e-5)
    np.testing.assert_allclose(imu.angular_rate, flight.angular_rate(exact), atol=1e-5)
    np.testing.assert_allclose(track.position, flight.position(exact), atol=1e-6)
    rotation = matrix_from_quaternion(track.quaternion)
    np.testing.assert_allclose(rotation, flight.rotation(exact), atol=1e-6)


def test_euler_angles_replace_a_quaternion(crazyflie: ModuleType, tmp_path: Path) -> None:
    """The logged pitch has the opposite sign."""
    flight = crazyflie.Flight(3.0)
    log = crazyflie.write_flight(flight, np.random.default_rng(1), quaternion=False)
    [track] = read_crazyflie_usd([write(log, tmp_path)]).onboard
    rotation = matrix_from_quaternion(track.quaternion)
    np.testing.assert_allclose(rotation, flight.rotation(np.arange(len(track)) / 100), atol=1e-6)


def test_compressed_estimates_are_read(crazyflie: ModuleType, tmp_path: Path) -> None:
    flight = crazyflie.Flight(3.0)
    log = crazyflie.write_flight(flight, np.random.default_rng(1))
    log.types.pop(65535)
    log.events = [event for event in log.events if event[1] != 65535]
    names = "stateEstimateZ.x:h stateEstimateZ.y:h stateEstimateZ.z:h stateEstimateZ.quat:I"
    log.event_type(65535, "fixedFrequency", names)
    t = np.arange(0, 3, 0.01)
    packed = compress(crazyflie.to_quaternion(flight.rotation(t)))
    for time, position, quaternion in zip(t, flight.position(t), packed, strict=True):
        log.add(31.7 + 84 / 85 * time, 65535, *np.rint(1e3 * position).astype(int), quaternion)
    [track] = read_crazyflie_usd([write(log, tmp_path)]).onboard
    np.testing.assert_allclose(track.position, flight.position(t), atol=6e-4)
    rotation = matrix_from_quaternion(track.quaternion)
    np.testing.assert_allclose(rotation, flight.rotation(t), atol=5e-3)


def compress(quaternions: np.ndarray) -> list[int]:
    """Pack quaternions x y z w as documented in the firmware's ``quatcompress.h``."""
    packed = []
    for q in quaternions:
        largest = int(np.argmax(np.abs(q)))
        q = q * np.sign(q[largest])
        number = largest
        for k in range(4):
            if k != largest:
                magnitude = int(511 * abs(q[k]) / np.sqrt(0.5) + 0.5)
                number = number << 10 | int(q[k] < 0) << 9 | magnitude
        packed.append(number)
    return packed


@given(st.integers(0, 2**32 - 1))
def test_quaternions_survive_compression(seed: int) -> None:
    q = np.random.default_rng(seed).normal(size=(20, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    read = decompress_quaternions(np.array(compress(q), np.uint32))
    np.testing.assert_allclose(np.abs(np.sum(q * read, axis=1)), 1.0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("source", "rate"), [("angles", 84 / 85), ("estimator", 1.0)])
def test_angles_of_the_firmware_are_dated(
    crazyflie: ModuleType, tmp_path: Path, source: str, rate: float
) -> None:
    flight = crazyflie.Flight(22.0)
    rng = np.random.default_rng(2)
    log = crazyflie.write_flight(flight, rng, frames=False, rate=rate, **{source: True})
    session = read_crazyflie_usd([write(log, tmp_path)])
    check_sweeps(session, flight, tolerance_s=5e-4)
    # The rotors are up to 8 ppm off, over 22 s.
    [imu] = session.imu
    t = (imu.time_ns - START_NS) * 1e-9
    np.testing.assert_allclose(t, np.arange(len(t)) / 100, atol=1e-3)


def test_repeated_angles_are_dropped(crazyflie: ModuleType, tmp_path: Path) -> None:
    log = crazyflie.write_flight(
        crazyflie.Flight(11.0), np.random.default_rng(2), frames=False, angles=True
    )
    before = len(read_crazyflie_usd([write(log, tmp_path)]).sweeps)
    again = [(time + 1e-4, number, values) for time, number, values in log.events if number == 12]
    log.events += again[:400]
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert len(session.sweeps) == before
    assert "400 events" in session.facts["repeated"] or "repeat" in session.facts["repeated"]


def test_the_best_source_is_used(crazyflie: ModuleType, tmp_path: Path) -> None:
    log = crazyflie.write_flight(
        crazyflie.Flight(11.0), np.random.default_rng(3), angles=True, estimator=True
    )
    path = write(log, tmp_path)
    assert (
        "events lhUartFrame; not used: lhAngle, estSweepAngle"
        in (read_crazyflie_usd([path]).facts["sweeps"])
    )
    facts = read_crazyflie_usd([path], sweeps="estimator").facts
    assert "events estSweepAngle" in facts["sweeps"]
    alone = crazyflie.write_flight(crazyflie.Flight(3.0), np.random.default_rng(3))
    with pytest.raises(InputError, match="no event lhAngle") as error:
        read_crazyflie_usd([write(alone, tmp_path)], sweeps="lhangle")
    assert error.value.hint == "Give --sweeps uart"


@pytest.mark.parametrize("limit", [2, 4, 16])
def test_unknown_stations_have_the_number_of_the_build(
    crazyflie: ModuleType, tmp_path: Path, limit: int
) -> None:
    flight = crazyflie.Flight(3.0)
    log = crazyflie.write_flight(flight, np.random.default_rng(4), unknown_station=limit)
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert set(session.sweeps.channel.tolist()) == {1, 2}
    check_sweeps(session, flight, tolerance_s=1e-3)


def test_one_wrong_offset_of_an_unknown_station_does_no_harm(
    crazyflie: ModuleType, tmp_path: Path
) -> None:
    log = crazyflie.write_flight(crazyflie.Flight(3.0), np.random.default_rng(4))
    frames = [k for k, event in enumerate(log.events) if event[1] == 11]
    first = next(k for k in frames if log.events[k][2][1] == 4)
    time_s, number, values = log.events[first]
    log.events[first] = (time_s, number, (*values[:2], 4000, *values[3:]))
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert len(session.sweeps) > 0.95 * len(frames)


@pytest.mark.parametrize("rate", [84 / 85, 0.98906, 1.0])
def test_a_gap_of_many_wraps_of_the_short_counter(
    crazyflie: ModuleType, tmp_path: Path, rate: float
) -> None:
    """A clock that is 1.2 % slow is wrong by more than half of a wrap after 30 s."""
    flight = crazyflie.Flight(60.0)
    log = crazyflie.write_flight(flight, np.random.default_rng(4), rate=rate, imu_hz=100)
    name, variables = log.types[11]
    log.types[11] = (name, [each for each in variables if each[0] != "timestamp2FPGA"])
    gap = range(round(31.7 + 5 * rate), round(31.7 + 55 * rate))
    log.events = [
        (time_s, number, values if number != 11 else (*values[:4], values[5]))
        for time_s, number, values in log.events
        if number != 11 or int(time_s) not in gap
    ]
    session = read_crazyflie_usd([write(log, tmp_path)])
    check_sweeps(session, flight, tolerance_s=1e-4)


def test_a_station_with_the_largest_number_is_one(crazyflie: ModuleType, tmp_path: Path) -> None:
    """Station 2 of a build for 16, from which no frame is unknown."""
    flight = crazyflie.Flight(3.0, stations=crazyflie.stations(3))
    log = crazyflie.write_flight(flight, np.random.default_rng(4), unknown=0.0)
    log.events = [e for e in log.events if e[1] != 11 or e[2][1] != 4]
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert set(session.sweeps.channel.tolist()) == {1, 2, 3}


def test_clock_rates_follow_from_the_cycle(crazyflie: ModuleType) -> None:
    for rate, version, expected in ((84 / 85, 2, 0.988), (1.0, 2, 1.0), (1.0, 1, 1.0)):
        log = crazyflie.UsdWriter(version)
        log.event_type(65535, "fixedFrequency", "acc.x:f")
        for k in range(50):
            log.add(5 + rate * 0.01 * k, 65535, 0.0)
        [(low, high)] = clock_rates(parse_usd_log(log.data(), PATH))
        assert low < expected < high
    log.events = []
    assert len(clock_rates(parse_usd_log(log.data(), PATH))) == 1
    log.version = 2
    assert len(clock_rates(parse_usd_log(log.data(), PATH))) == 2


def test_the_next_source_replaces_an_unusable_one(crazyflie: ModuleType, tmp_path: Path) -> None:
    log = crazyflie.write_flight(crazyflie.Flight(3.0), np.random.default_rng(3), angles=True)
    frames = [event for event in log.events if event[1] == 11]
    log.events = [event for event in log.events if event[1] != 11] + frames[:4]
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert "events lhAngle" in session.facts["sweeps"]
    assert session.warnings[0] == "none of the 4 events lhUartFrame is usable"


def test_many_rejected_frames_are_reported(crazyflie: ModuleType, tmp_path: Path) -> None:
    stations = crazyflie.stations(3)
    stations[2].channel = 2  # two stations on one channel
    flight = crazyflie.Flight(3.0, stations=stations)
    log = crazyflie.write_flight(flight, np.random.default_rng(5))
    session = read_crazyflie_usd([write(log, tmp_path)])
    assert set(session.sweeps.channel.tolist()) == {1}
    [warning] = session.warnings
    assert "of a station whose rotor is not regular" in warning


def test_a_torn_log_is_imported_with_its_loss(crazyflie: ModuleType, tmp_path: Path) -> None:
    log = crazyflie.write_flight(crazyflie.Flight(3.0), np.random.default_rng(5))
    path = tmp_path / "log00"
    path.write_bytes(log.data(crc=False)[:-7])
    session = read_crazyflie_usd([path])
    assert session.lost is not None
    assert "no checksum" in session.lost
    assert len(session.sweeps) > 1000


def test_logs_without_sweeps_are_refused(crazyflie: ModuleType, tmp_path: Path) -> None:
    path = write(small_log(crazyflie), tmp_path)
    with pytest.raises(FormatError, match="no sweeps") as error:
        read_crazyflie_usd([path])
    assert "fixedFrequency" in str(error.value.hint)
    with pytest.raises(InputError, match="several logs"):
        read_crazyflie_usd([path, path])
    log = crazyflie.write_flight(crazyflie.Flight(3.0), np.random.default_rng(5))
    log.events = [e for e in log.events if e[1] != 11] + [e for e in log.events if e[1] == 11][:5]
    with pytest.raises(InputError, match="none of the 5 events lhUartFrame is usable"):
        read_crazyflie_usd([write(log, tmp_path)])


def test_calibrations_come_from_the_configuration(crazyflie: ModuleType, tmp_path: Path) -> None:
    path = write(crazyflie.write_flight(crazyflie.Flight(2.5), np.random.default_rng(6)), tmp_path)
    config = tmp_path / "system.yaml"
    config.write_text(yaml.safe_dump(crazyflie.system_config(crazyflie.stations())))
    scene = read_crazyflie_usd([path], config=config).scene
    assert scene is not None
    assert scene.stations == ()
    assert sorted(scene.calibrations) == [1, 2]
    assert scene.calibrations[1].source == "factory"
    assert scene.ids == {1: 1001, 2: 1002}
    scene = read_crazyflie_usd([path], config=config, stations=True).scene
    assert scene is not None
    assert [station.channel for station in scene.stations] == [1, 2]
    with pytest.raises(InputError, match="no configuration"):
        read_crazyflie_usd([path], stations=True)


def test_a_configuration_of_cflib_is_read(crazyflie: ModuleType, tmp_path: Path) -> None:
    """Written by cflib (GPL), as a program in an environment of its own."""
    python = os.environ.get("LOCATK_CFLIB_PYTHON")
    if not python:
        pytest.skip("LOCATK_CFLIB_PYTHON does not name a Python with cflib")
    program = """
import sys
from cflib.crazyflie.mem.lighthouse_memory import LighthouseBsCalibration, LighthouseBsGeometry
from cflib.localization import LighthouseConfigFileManager
geometry, calibration = LighthouseBsGeometry(), LighthouseBsCalibration()
geometry.origin, geometry.valid = [1.0, 2.0, 3.0], True
geometry.rotation_matrix = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
calibration.uid, calibration.valid = 1234, True
calibration.sweeps[1].tilt, calibration.sweeps[1].gibmag = 0.046, 0.005
LighthouseConfigFileManager.write(sys.argv[1], {1: geometry}, {1: calibration}, 2)
"""
    config = tmp_path / "system.yaml"
    subprocess.run([python, "-c", program, str(config)], check=True)
    path = write(crazyflie.write_flight(crazyflie.Flight(2.5), np.random.default_rng(6)), tmp_path)
    scene = read_crazyflie_usd([path], config=config, stations=True).scene
    assert scene is not None
    [station] = scene.stations
    assert (station.channel, station.id) == (2, 1234)
    np.testing.assert_array_equal(station.position, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(station.rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    assert station.calibration.source == "factory"


def test_a_receiver_has_a_place_on_its_device(crazyflie: ModuleType, tmp_path: Path) -> None:
    path = write(crazyflie.write_flight(crazyflie.Flight(2.5), np.random.default_rng(6)), tmp_path)
    session = read_crazyflie_usd(
        [path], receiver="bolt", mounting=(1.0, 2.0, 12.0, 90.0), device="b"
    )
    receiver = session.receivers["b"]
    assert receiver.name == "crazyflie-bolt"
    np.testing.assert_allclose(receiver.position_m[2], [1e-3 - 7.5e-3, 17e-3, 12e-3], atol=1e-12)
    with pytest.raises(LocatkError, match=r"nobody\.toml"):
        read_crazyflie_usd([path], receiver="nobody.toml")


@pytest.mark.slow
def test_a_flight_is_solved(locatk: Any, crazyflie: ModuleType, tmp_path: Path) -> None:
    flight = crazyflie.Flight(8.0, 0.8)
    log = write(crazyflie.write_flight(flight, np.random.default_rng(7)), tmp_path)
    config, out = tmp_path / "system.yaml", tmp_path / "flight.mcap"
    config.write_text(yaml.safe_dump(crazyflie.system_config(flight.stations)))
    imported = locatk(
        "import", "crazyflie-usd", log, "--config", config, "--stations", "-o", out, "--json"
    )
    assert imported.exit_code == 0, imported.stderr
    solved = locatk("solve", out, "-o", tmp_path / "solved.mcap")
    assert solved.exit_code == 0, solved.stderr
    truth = tmp_path / "truth.tum"
    t = np.arange(0, 8, 0.005)
    pose = np.hstack([flight.position(t), crazyflie.to_quaternion(flight.rotation(t))])
    np.savetxt(truth, np.column_stack([1.0 + t, pose]), "%.9f")

    for arguments, limit in ((["solved.mcap"], 1.0), (["flight.mcap", "--onboard"], 0.2)):
        arguments[0] = str(tmp_path / arguments[0])
        result = locatk("eval", *arguments, "--truth", truth, "--json")
        assert result.exit_code == 0, result.stderr
        assert 1e3 * json.loads(result.stdout)["median_m"] < limit


def test_the_command_reports_losses(locatk: Any, crazyflie: ModuleType, tmp_path: Path) -> None:
    log = crazyflie.write_flight(crazyflie.Flight(2.5), np.random.default_rng(8))
    path = tmp_path / "log00"
    path.write_bytes(log.data(crc=False))
    result = locatk("import", "crazyflie-usd", path, "-o", tmp_path / "out.mcap")
    assert result.exit_code == 3
    assert "no checksum" in result.stderr
    assert "250 samples of the IMU, 250 on-board poses" in result.stderr
    result = locatk("import", "crazyflie-usd", tmp_path / "out.mcap", "-o", tmp_path / "b.mcap")
    assert result.exit_code == 1
    assert "not a log of a Crazyflie's micro SD card" in result.stderr
    assert "Traceback" not in result.stderr
    result = locatk("import", "crazyflie-usd", path, "-o", "x.mcap", "--mounting", "1,2")
    assert result.exit_code == 2
    assert read_usd_log(path).damage is not None
