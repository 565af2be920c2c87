"""Recordings of libsurvive: lines, rotors, clocks, frames, and what damage does to them."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError, LocatkError, MissingDataError
from locatk.core.geometry import matrix_from_quaternion
from locatk.core.lighthouse.calibration import predict_angles
from locatk.core.lighthouse.channels import period_counts, period_ticks
from locatk.core.lighthouse.demodulation.ootx import encode_frame
from locatk.core.lighthouse.demodulation.tracker_syncs import fit_rotor
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene.gravity import (
    estimate_up,
    station_ups,
    up_from_acceleration,
    with_ups,
)
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.importers.libsurvive import rec_file
from locatk.formats.importers.libsurvive.device import read_stored_calibrations
from locatk.formats.importers.libsurvive.rec_file import read_rec_file
from locatk.formats.importers.libsurvive.recording import read_libsurvive
from locatk.formats.importers.libsurvive.sweeps import assign_planes, read_device_sweeps

PUBLISHED = "lighthouse/libsurvive/tracker-cal-attempt.rec.gz"

CONFIG = {
    "device_serial_number": "LHR-1",
    "model_number": "test tracker",
    "head": {"plus_x": [1, 0, 0], "plus_z": [0, 0, -1], "position": [0.0, 0.04, 0.05]},
    "imu": {"plus_x": [0, -1, 0], "plus_z": [0, 0, -1], "position": [0.01, 0.02, 0.06]},
    "lighthouse_config": {
        "channelMap": [3, 2, 1, 0],
        "modelNormals": [[0, 0, 2], [0, 1, 0], [1, 0, 0], [0, 0, 1]],
        "modelPoints": [[0.0, 0.04, 0.05], [0.1, 0.04, 0.05], [0.0, 0.14, 0.05], [0, 0.04, 0.15]],
    },
}


def payload(number: int, channel: int) -> bytes:
    """Factory data of a station."""
    parameters = (0.0, -0.005, -0.05, 0.046)
    rest = (0.1, 0.2, 2, 127, -3, 1.5, 1.7, -0.005, -0.004, 0x7F + channel, 0, 1.3, 2.0, 0.2, 0.1)
    return struct.pack("<HIeeeeBBeebbbeeeeBBeeeeH", 6, number, *parameters, 0, 9, *rest, 7)


@dataclass
class Room:
    """Two stations and a tracker at rest, whose light and lines are made by the clock.

    Rotors run even but for ``wander``; the tracker's counter is ``ppm`` fast and starts at
    ``first``; the host writes lines late by up to ``late_s``.
    """

    seconds: float = 1.0
    channels: tuple[int, ...] = (4, 12)
    ppm: float = 40.0
    first: int = 123_456_789
    late_s: float = 0.008
    wander: float = 0.0
    device: str = "WM0"
    seed: int = 1
    says: int = 0
    lines: list[tuple[float, str]] = field(default_factory=list)
    ticks: dict[str, float] = field(default_factory=dict)

    def turns(self, channel: int) -> np.ndarray:
        """(4, 2) turn at which each sensor meets each plane."""
        return np.array([1 / 3, 2 / 3]) + 0.002 * channel + 0.001 * np.arange(4)[:, None]

    def build(self, heard: Callable[[int, int], bool] = lambda channel, rotation: True) -> Room:
        rng = np.random.default_rng(self.seed)
        rate = 48e6 * (1 + self.ppm * 1e-6)
        for channel in self.channels:
            bits = encode_frame(payload(0x10 + channel, self.says or channel))
            period = float(period_ticks(channel)) / 48e6 * (1 + 1e-6 * channel)
            zero = np.arange(int(self.seconds / period)) * period + 0.001 * channel
            slow = np.sin(np.arange(len(zero)) / 3.0 + channel) * self.wander / 48e6
            zero = zero + slow
            for n in range(len(zero) - 1):
                if heard(channel, n):
                    self.add(zero[n], rate, "Y", channel, f"{{}} {bits[n % len(bits)]} 0", rng)
                for sensor, pair in enumerate(self.turns(channel)):
                    for plane, turn in enumerate(pair):
                        at = zero[n] + turn * (zero[n + 1] - zero[n])
                        self.add(at, rate, "W", channel, f"{sensor} {{}} {{}}", rng, plane)
        self.lines.sort(key=lambda line: line[0])
        return self

    def add(
        self,
        at: float,
        rate: float,
        kind: str,
        channel: int,
        values: str,
        rng: np.random.Generator,
        plane: int = 0,
    ) -> None:
        half_ticks = int(np.rint(2 * (self.first + at * rate)))
        timecode = half_ticks // 2 % (1 << 32)
        written = at + rng.uniform(0.001, 0.001 + self.late_s)
        text = values.format(timecode, half_ticks % 2)
        line = f"{self.device} {kind} {channel - 1} {text}"
        self.lines.append((written, line))
        self.ticks[line] = half_ticks / 2

    def text(self, *more: str, config: bool = True) -> bytes:
        lines = [f"0.000100 INFO LOG hello {self.device}", "0.000200 OPTION v i 100"]
        if config:
            lines.append(f"0.000300 {self.device} CONFIG {json.dumps(CONFIG)}")
        lines += [f"{t:0.6f} {line}" for t, line in self.lines]
        return ("\r\n".join([*lines, *more]) + "\r\n").encode()

    def write(self, folder: Path, *more: str, config: bool = True) -> Path:
        file = folder / "some.rec.gz"
        file.write_bytes(gzip.compress(self.text(*more, config=config), 1))
        return file


def turn_errors(room: Room, sweeps: Sweeps) -> np.ndarray:
    """Error of each sweep's turn, in ticks of a rotation."""
    turn = sweeps.count / period_counts(sweeps.channel)
    table = np.zeros((17, 4, 2))
    for channel in room.channels:
        table[channel] = room.turns(channel)
    truth = table[sweeps.channel, sweeps.sensor, sweeps.sweep]
    return (turn - truth) * period_ticks(sweeps.channel)


@pytest.fixture(scope="module")
def room() -> Room:
    return Room().build()


def test_turns_do_not_depend_on_the_trackers_clock(tmp_path: Path, room: Room) -> None:
    session = read_libsurvive([room.write(tmp_path)])
    assert len(session.sweeps) == sum(" W " in line for _, line in room.lines)
    assert session.lost is None
    assert session.warnings == []
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0
    # A clock 1000 times as wrong as a resonator bends nothing either, but is told.
    fast = Room(ppm=250.0).build()
    told = read_libsurvive([fast.write(tmp_path)])
    assert np.abs(turn_errors(fast, told.sweeps)).max() < 1.0
    for station, channel in zip(told.stations, fast.channels, strict=True):
        nominal = period_ticks(channel) * (1 + 1e-6 * channel) * (1 + 250e-6)
        assert station.period_ticks == pytest.approx(nominal, rel=3e-7)


def test_times_are_smooth_where_lines_come_in_bursts(tmp_path: Path) -> None:
    room = Room(seconds=4.0, late_s=0.03).build()
    session = read_libsurvive([room.write(tmp_path)])
    ticks = np.sort([tick for line, tick in room.ticks.items() if " W " in line])
    time = session.sweeps.time_ns - session.sweeps.time_ns[0]
    truth = (ticks - ticks[0]) / (48e6 * (1 + room.ppm * 1e-6)) * 1e9
    # The rate over four seconds is as good as the latest lines are early; the rest is smooth.
    rate = (time[-1] - time[0]) / (truth[-1] - truth[0])
    assert abs(rate - 1) < 5e-4
    assert np.abs(time - rate * truth).max() < 100.0
    assert abs(session.sweeps.time_ns[0] * 1e-9 - (ticks[0] - room.first) / 48e6) < 0.005


def test_rotors_that_wander_are_followed(tmp_path: Path) -> None:
    room = Room(seconds=2.0, wander=20.0).build()
    error = turn_errors(room, read_libsurvive([room.write(tmp_path)]).sweeps)
    assert np.sqrt(np.mean(error**2)) < 1.5


def test_wrong_late_and_missing_syncs_shift_no_sweep(tmp_path: Path) -> None:
    room = Room(seconds=4.0).build(lambda channel, n: n % 7 != 3)
    rng = np.random.default_rng(4)
    wrong = 0
    for k, (time, line) in enumerate(room.lines):
        words = line.split()
        if words[1] == "Y" and rng.random() < 0.1:
            words[3] = str((int(words[3]) + int(rng.integers(300, 900_000))) % (1 << 32))
            room.lines[k] = (time, " ".join(words))
            wrong += 1
    assert wrong > 20
    session = read_libsurvive([room.write(tmp_path)])
    # Wrong turns are told, but for syncs that are wrong by whole turns or nothing.
    assert np.abs(turn_errors(room, session.sweeps)).max() < 2.0
    kept = session.sweeps.polynomial >= 0
    assert 0.6 < np.mean(kept) < 0.9
    assert np.all(session.sweeps.polynomial[kept] >> 1 == session.sweeps.channel[kept] - 1)


def test_counters_start_again_and_hosts_add_wrong_upper_bits(tmp_path: Path) -> None:
    # The 32 bits end after 1.5 s. As trackers do, lines before it have the bits of after it.
    room = Room(seconds=3.0, first=(1 << 32) - 72_000_000).build()
    changed = 0
    for k, (time, line) in enumerate(room.lines):
        words = line.split()
        place = 3 if words[1] == "Y" else 4
        left = (1 << 32) - int(words[place])
        if 0 < left < 300_000:
            words[place] = str(int(words[place]) % (1 << 24))
            room.lines[k] = (time, " ".join(words))
            changed += 1
    assert changed > 1
    session = read_libsurvive([room.write(tmp_path)])
    assert session.lost is None
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0
    assert session.facts["timecodes"].startswith(f"{changed} had")
    assert np.ptp(session.sweeps.time_ns) < 3_100_000_000


def test_a_tracker_that_starts_again_and_a_timecode_of_nowhere(tmp_path: Path) -> None:
    room = Room(seconds=3.0).build()
    for k, (time, line) in enumerate(room.lines):
        words = line.split()
        place = 3 if words[1] == "Y" else 4
        if time > 1.5:
            words[place] = str((int(words[place]) + 2_000_000_000) % (1 << 32))
        if k in (100, 200):
            words[place] = str((int(words[place]) + 1_000_000_000) % (1 << 32))
        room.lines[k] = (time, " ".join(words))
    session = read_libsurvive([room.write(tmp_path)])
    assert session.warnings == ["the counter of WM0 restarted 1 times"]
    assert session.lost == "2 lines with a timecode that contradicts its time"
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0
    assert np.ptp(session.sweeps.time_ns) < 3_100_000_000


@pytest.mark.slow
def test_factory_data_comes_from_the_syncs(tmp_path: Path) -> None:
    room = Room(seconds=19.0, channels=(4, 12)).build(lambda channel, n: n % 150 != 3)
    session = read_libsurvive([room.write(tmp_path)])
    assert [s.channel for s in session.stations] == [4, 12]
    for station in session.stations:
        assert station.id == 0x10 + station.channel
        assert station.frames >= 1
        assert station.damaged == 0
        assert station.calibration is not None
        assert station.calibration.source == "factory"
        assert station.calibration.sweeps[:, 1] == pytest.approx([-0.05, 0.046], abs=1e-4)
        assert station.sweeps == np.count_nonzero(session.sweeps.channel == station.channel)
    assert session.scene is not None
    assert session.scene.ids == {4: 0x14, 12: 0x1C}
    assert sorted(session.scene.calibrations) == [4, 12]
    assert session.scene.stations == ()


def test_factory_data_of_another_channel_is_not_used(tmp_path: Path) -> None:
    file = Room(seconds=10.0, channels=(4,), says=5).build().write(tmp_path)
    session = read_libsurvive([file])
    assert session.scene is None
    assert session.stations[0].calibration is None
    assert session.stations[0].frames == 1
    assert len(session.warnings) == 1
    assert "00000014 is of channel 5" in session.warnings[0]


def test_stations_of_the_recording_are_taken_only_where_asked_for(tmp_path: Path) -> None:
    room = Room(seconds=10.0, channels=(4, 12)).build()
    # Upright, looking along the world's -y: libsurvive's z is back, y up.
    half = np.sqrt(0.5)
    pose = f"9.9 3 LH_POSE 1.000000 2.000000 3.000000 {half} {half} 0 0 20"
    file = room.write(tmp_path, "1.0 3 LH_POSE 9 9 9 1 0 0 0", pose)
    scene = read_libsurvive([file]).scene
    assert scene is not None
    assert scene.stations == ()
    session = read_libsurvive([file], stations=True)
    assert session.scene is not None
    (station,) = session.scene.stations
    assert session.scene.scale == "device"
    assert station.channel == 4
    assert station.id == 0x14
    assert station.position.tolist() == [1.0, 2.0, 3.0]
    # (w, x) = 90 degrees about x: libsurvive's -z goes to y, y to z, x stays.
    expected = np.stack([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], axis=1)
    assert station.rotation == pytest.approx(expected, abs=1e-6)
    assert list(session.scene.calibrations) == [12]
    assert session.warnings == ["channel 12: the recording has no pose of the station"]


def test_photodiodes_are_in_the_axes_of_the_recorded_poses(tmp_path: Path, room: Room) -> None:
    receiver = read_libsurvive([room.write(tmp_path)]).receivers["WM0"]
    # The head's x is the device's x, its z the device's -z, so its y the device's -y.
    head = [[0, 0, 0], [0.1, 0, 0], [0, -0.1, 0], [0, 0, -0.1]]
    assert receiver.position_m == pytest.approx(np.array(head), abs=1e-9)
    assert receiver.normal is not None
    assert receiver.normal[0] == pytest.approx([0, 0, -1])
    assert receiver.name == "test tracker"
    told = room.write(tmp_path, "0.1 OPTION report-in-imu b 1")
    imu = read_libsurvive([told]).receivers["WM0"].position_m
    assert imu[0] == pytest.approx([-0.02, 0.01, 0.01], abs=1e-9)


def test_truth_is_another_systems_poses_before_its_own(tmp_path: Path, room: Room) -> None:
    own = "0.5 WM0 POSE 1 2 3 1 0 0 0"
    session = read_libsurvive([room.write(tmp_path, own)])
    assert session.truth[0].frame == "libsurvive"
    assert session.truth[0].position.tolist() == [[1, 2, 3]]
    replay = [
        "0.7 replay_WM0 EXTERNAL_POSE 4 5 6 0 0 2 0",
        "0.6 replay_WM0 EXTERNAL_POSE 7 8 9 1 0 0 0",
        "0.7 replay_WM0 EXTERNAL_POSE 4 5 7 0 0 2 0",
        "0.8 replay_WM0 EXTERNAL_POSE 4 5 7 0 0 0 0",
        "0.8 other EXTERNAL_POSE 4 5 7 0 0 1 0",
    ]
    session = read_libsurvive([room.write(tmp_path, own, *replay)])
    (truth,) = session.truth
    assert truth.device == "WM0"
    assert truth.time_ns.tolist() == [600_000_000, 700_000_000]
    assert truth.position.tolist() == [[7, 8, 9], [4, 5, 7]]
    assert truth.quaternion.tolist() == [[0, 0, 0, 1], [0, 1, 0, 0]]
    assert len(session.warnings) == 2
    serial = "0.7 LHR-1 EXTERNAL_POSE 4 5 6 0 0 2 0"
    session = read_libsurvive([room.write(tmp_path, own, serial)])
    assert session.truth[0].frame == "libsurvive-external"


def test_several_devices_are_heard_apart(tmp_path: Path, room: Room) -> None:
    second = Room(device="WM1", ppm=-30.0, first=7, seed=9).build()
    both = Room(lines=sorted([*room.lines, *second.lines]))
    session = read_libsurvive([both.write(tmp_path)])
    assert sorted(session.sweeps.devices) == ["WM0", "WM1"]
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0
    assert np.all(np.diff(session.sweeps.time_ns) >= 0)
    assert session.warnings == ["the recording has no configuration of WM1"]
    # The same light, by two clocks: the sweeps are a millisecond of lateness apart at most.
    for channel in room.channels:
        times = [
            session.sweeps.time_ns[
                (session.sweeps.channel == channel) & (session.sweeps.device == d)
            ][:8]
            for d in (0, 1)
        ]
        assert np.abs(times[0] - times[1]).max() < 2_000_000


def test_two_rotors_on_one_channel_are_told(tmp_path: Path, room: Room) -> None:
    other = Room(channels=(12,), seed=3).build()
    lines = []
    for time, line in other.lines:
        words = line.split()
        if words[1] == "Y":
            words[3] = str(int(words[3]) + 400_000)
            lines.append((time, " ".join(words)))
    both = Room(lines=sorted([*room.lines, *lines]))
    warnings = read_libsurvive([both.write(tmp_path)]).warnings
    assert len(warnings) == 1
    assert warnings[0].startswith("channel 12: ")
    assert "second station" in warnings[0]


def test_planes_that_meet_in_the_middle() -> None:
    period = 949_000.0
    tick = np.arange(200) * period

    def told(*turns: float) -> list[int]:
        turn = np.repeat(turns, 200)
        return assign_planes(turn, np.tile(tick, len(turns)) + turn * period, period)[
            ::200
        ].tolist()

    assert told(0.30, 0.65) == [0, 1]
    # Far to the right the second plane comes before half a turn, far to the left the first
    # after it: what else the photodiodes met tells.
    assert told(0.20, 0.45, 0.55) == [0, 1, 1]
    assert told(0.38, 0.43, 0.75) == [0, 0, 1]
    assert told(0.30, 0.58, 0.62) == [0, 1, 1]
    assert told(0.40, 0.50, 0.60) == [0, -1, 1]
    assert told(0.50) == [-1]
    # A plane that was not seen for seconds tells nothing.
    turn = np.r_[0.45, 0.38, 0.75]
    assert assign_planes(turn, np.array([0, 400, 400]) * period, period).tolist() == [-1, 0, 1]


def test_rotors_need_four_syncs_of_one_rhythm() -> None:
    rng = np.random.default_rng(0)
    bit = np.zeros(50, np.int32)
    assert fit_rotor(np.zeros(0), bit[:0], 959e3) is None
    assert fit_rotor(np.arange(3) * 959e3, bit[:3], 959e3) is None
    assert fit_rotor(np.full(50, 77.0), bit, 959e3) is None
    assert fit_rotor(np.repeat([0.0, 959e3, 2 * 959e3], 9), bit[:27], 959e3) is None
    assert fit_rotor(np.arange(50) * 911e3, bit, 959e3) is None
    assert fit_rotor(rng.uniform(0, 1e9, 50), bit, 959e3) is None
    rotor = fit_rotor(np.arange(4) * 959e3 + 5e12, bit[:4], 959e3)
    assert rotor is not None
    turn, told = rotor.phase_and_bit(5e12 + np.array([0.25, 1.5, 3.25, 60.0, -40.5, -60.0]) * 959e3)
    assert turn[[0, 1, 2, 4]] == pytest.approx([0.25, 0.5, 0.25, 0.5], abs=1e-6)
    assert np.isnan(turn[[3, 5]]).all()
    assert told.tolist() == [0, 0, 0, -1, -1, -1]


def test_silence_between_syncs_is_of_unknown_bits(tmp_path: Path) -> None:
    number = np.r_[0:10, 20:30, 90_000:90_010]
    rotor = fit_rotor(number * 959_000.0, np.ones(30, np.int32), 959e3)
    assert rotor is not None
    bits = rotor.slow_bits()
    assert np.count_nonzero(bits == 1) == 30
    assert bits[:30].tolist() == [1] * 10 + [-1] * 10 + [1] * 10
    assert len(bits) < 1000


def test_other_lines_are_counted_and_damaged_ones_told(tmp_path: Path, room: Room) -> None:
    strange = [
        "0.5 WM0 W 3 1 123",
        "0.5 WM0 W 3 1 99999999999 0",
        "0.5 WM0 W 16 1 9999 0",
        "0.5 WM0 W 3 1 4294967296 0",
        "0.5 WM0 Y 3 x 0 0",
        "nan WM0 Y 3 1 0 0",
        "\x00\xff\xfe",
        "0.5 WM0 POSE 1 2 3 nan 0 0 0",
        "0.5 WM0 POSE 1 2 3",
        "0.5 WM0 i 3 1 0 0 0 0 0 0 0 0 0 0",
        "0.5 SPHERE WM0_3 0.05 255 1 2 3",
    ]
    session = read_libsurvive([room.write(tmp_path, *strange)])
    assert session.lost == "9 damaged lines"
    assert session.truth == []
    assert "1 i" in session.facts["skipped"]
    assert "1 SPHERE" in session.facts["skipped"]
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0


def test_a_damaged_time_shifts_no_other(tmp_path: Path) -> None:
    """The clock is told by the lines that are least late; one that came too early is none."""
    room = Room(seconds=3.0).build()
    whole = read_libsurvive([room.write(tmp_path)])
    at = next(k for k, (time, line) in enumerate(room.lines) if time > 2 and " W " in line)
    room.lines[at] = (room.lines[at][0] - 1.5, room.lines[at][1])
    session = read_libsurvive([room.write(tmp_path)])
    assert session.lost is None
    assert np.abs(session.sweeps.time_ns - whole.sweeps.time_ns).max() < 1_000_000


def test_sweeps_before_the_recording_are_left_out(tmp_path: Path) -> None:
    room = Room().build()
    room.lines = [(max(0.0, time - 0.3), line) for time, line in room.lines]
    session = read_libsurvive([room.write(tmp_path)])
    assert session.sweeps.time_ns.min() >= 0
    assert "sweeps before the recording began" in str(session.lost)


def test_photodiodes_at_one_place_do_not_keep_the_sweeps_out(tmp_path: Path) -> None:
    config = json.loads(json.dumps(CONFIG))
    config["lighthouse_config"]["modelPoints"][1] = config["lighthouse_config"]["modelPoints"][0]
    room = Room().build()
    room.lines.insert(0, (0.0, f"WM0 CONFIG {json.dumps(config)}"))
    session = read_libsurvive([room.write(tmp_path, config=False)])
    assert session.receivers == {}
    assert "two sensors at the position of sensor 0" in session.warnings[0]
    assert len(session.sweeps) == sum(" W " in line for _, line in room.lines)


def test_sweeps_of_no_photodiode_and_no_rotor_are_left_out(tmp_path: Path, room: Room) -> None:
    sweep = next(line for _, line in room.lines if " W 3 " in line).split()
    more = [
        f"0.5 WM0 W 3 4 {sweep[4]} 0",
        f"0.5 WM0 W 9 1 {sweep[4]} 0",
    ]
    session = read_libsurvive([room.write(tmp_path, *more)])
    assert session.lost == (
        "1 sweep far from any sync, 1 sweep of photodiodes missing in the device's configuration"
    )
    assert set(session.sweeps.channel.tolist()) == {4, 12}
    without = read_libsurvive([room.write(tmp_path, *more, config=False)])
    assert without.receivers == {}
    assert without.lost == "1 sweep far from any sync"


@pytest.mark.parametrize("packed", [True, False])
def test_recordings_that_break_off_give_what_was_read(
    tmp_path: Path, room: Room, packed: bool
) -> None:
    whole = room.text()
    file = tmp_path / "cut.rec"
    if packed:
        data = gzip.compress(whole)
        file.write_bytes(data[: len(data) * 2 // 3])
    else:
        file.write_bytes(whole[: len(whole) * 2 // 3])
    session = read_libsurvive([file])
    if packed:
        assert session.lost is not None
        assert session.lost.startswith("the archive is truncated")
    assert 0.3 < len(session.sweeps) / sum(" W " in line for _, line in room.lines) < 0.9
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0


def test_archives_of_several_members_and_damaged_ones(tmp_path: Path, room: Room) -> None:
    text = room.text()
    half = text.index(b"\n", len(text) // 2) + 1
    file = tmp_path / "two.rec.gz"
    file.write_bytes(gzip.compress(text[:half]) + gzip.compress(text[half:]))
    whole = read_libsurvive([file])
    assert whole.lost is None
    assert len(whole.sweeps) == sum(" W " in line for _, line in room.lines)
    file.write_bytes(gzip.compress(text[:half]) + b"rubbish that is no gzip")
    assert str(read_libsurvive([file]).lost).startswith("the archive is damaged")


@pytest.mark.slow
def test_bombs_are_read_to_a_limit(
    tmp_path: Path, room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rec_file, "BLOCK_BYTES", 1 << 15)
    monkeypatch.setattr(rec_file, "MAX_LINE_BYTES", 1 << 16)
    monkeypatch.setattr(rec_file, "MAX_BYTES", 2 << 20)
    file = tmp_path / "bomb.rec.gz"
    file.write_bytes(gzip.compress(room.text() + b"x" * (8 << 20)))
    session = read_libsurvive([file])
    assert str(session.lost).startswith("only the first 2 MB were read")
    assert np.abs(turn_errors(room, session.sweeps)).max() < 1.0
    # What packs as nothing that was measured does is not read on, nor are lines without end.
    dense = b"1.1 WM0 POSE 0 0 0 1 0 0 0\r\n" * 40_000
    file.write_bytes(gzip.compress(room.text() + dense))
    monkeypatch.setattr(rec_file, "MAX_LINES", 20_000)
    assert str(read_libsurvive([file]).lost).startswith("only the first 2")
    monkeypatch.setattr(rec_file, "MIN_COMPRESSION_CHECK_BYTES", 1 << 18)
    monkeypatch.setattr(rec_file, "MAX_COMPRESSION_RATIO", 4)
    assert "unlike a recording" in str(read_libsurvive([file]).lost)


def test_what_is_no_recording(tmp_path: Path, room: Room) -> None:
    def refused(content: bytes | str, kind: type[LocatkError], word: str) -> None:
        file = tmp_path / "no.rec"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(kind, match=word) as caught:
            read_libsurvive([file])
        assert "\n" not in str(caught.value)

    refused(b"", FormatError, "not a recording of libsurvive")
    refused(b"\x1f\x8b", FormatError, "not a recording of libsurvive")
    refused(bytes(range(256)) * 50, FormatError, "not a recording of libsurvive")
    refused("a,b,c\n1,2,3\n", FormatError, "not a recording of libsurvive")
    refused("0.1 HMD L X 3 0 123456 1234567 3000 0\n0.1 HMD C 1 2 3\n", FormatError, "V1")
    refused("0.1 OPTION v i 100\n0.2 WM0 Y 3 1 0 0\n", FormatError, "without a sweep")
    sweeps = "\n".join(line for line in room.text().decode().splitlines() if " Y " not in line)
    refused(sweeps, InputError, "no sweep of a station with a known rotor")
    with pytest.raises(MissingDataError):
        read_libsurvive([tmp_path / "absent.rec"])
    with pytest.raises(MissingDataError):
        read_libsurvive([])
    with pytest.raises(FormatError):
        read_libsurvive([tmp_path])
    with pytest.raises(InputError, match="several recordings"):
        read_libsurvive([tmp_path / "a.rec", tmp_path / "b.rec"])


@pytest.mark.parametrize(
    "config",
    [
        "{",
        "[" * 100_000,
        "[]",
        '{"lighthouse_config": 3}',
        '{"lighthouse_config": {"modelPoints": [[1, 2]]}}',
        '{"lighthouse_config": {"modelPoints": [[1e999, 2, 3]]}}',
        '{"lighthouse_config": {"modelPoints": [[100, 2, 3]]}}',
        '{"modelPoints": [[0, 0, 0]], "modelNormals": [[0, 0, 0]]}',
        '{"modelPoints": [[0, 0, 0]], "head": {"plus_x": [1, 0], "plus_z": [1]}}',
        '{"modelPoints": [[0, 0, 0]], "head": {"plus_x": [1, 0, 0], "plus_z": [1, 0, 0]}}',
        '{"modelPoints": [[0, 0, 0]], "head": {"plus_x": [[1], 0], "plus_z": {}}}',
        '{"modelPoints": [[0, 0, 0]], "trackref_from_head": [0, 0, 0, 0, 0, 0, 0]}',
        '{"modelPoints": [[0, 0, 0]], "trackref_from_head": [0, 0, 0, 1, "x", 0, 0]}',
    ],
)
def test_a_wrong_configuration_is_told_and_left_out(
    tmp_path: Path, room: Room, config: str
) -> None:
    file = room.write(tmp_path, f"0.9 WM0 CONFIG {config}", config=False)
    session = read_libsurvive([file])
    assert session.receivers == {}
    assert len(session.warnings) == 1
    assert session.warnings[0].startswith("WM0: ")


def test_older_configurations_have_poses_of_seven_numbers(tmp_path: Path, room: Room) -> None:
    config = (
        '{"modelPoints": [[1, 2, 3], [0, 0, 0],], "trackref_from_head": '
        "[0, 0, 0.7071067811865476, 0.7071067811865476, 1, 1, 1]}"
    )
    file = room.write(tmp_path, f"0.9 WM0 CONFIG {config}", config=False)
    session = read_libsurvive([file])
    assert session.receivers["WM0"].position_m[0] == pytest.approx([1, 0, 2])


STORED = """"v":"0",
"poser":"MPFIT"
"lighthouse0":{
"id":"1083618720",
"mode":"3",
"fcalphase":["0.000000000000","-0.006382000167"],
"fcaltilt":["-0.050262000412","0.045623999089"],
"fcalcurve":["0.022507000715","0.190430000424"],
"fcalgibpha":["1.605468988419","1.793944954872"],
"fcalgibmag":["-0.006107000168","-0.006328999996"],
"fcalogeephase":["1.362305045128","2.062500000000"],
"fcalogeemag":["0.206664994359","0.187500000000"],
"OOTXSet":"1"
}
"lighthouse1":{
"id":"5",
"OOTXSet":"0"
}
"""


def test_stored_calibrations(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    file.write_text(STORED)
    stored = read_stored_calibrations(file)
    assert list(stored) == [1083618720]
    first, second = stored[1083618720].sweeps
    expected = [0.0, -0.050262, 0.022507, -0.006107, 1.605469, 0.206665, 1.362305]
    assert first == pytest.approx(expected, abs=1e-7)
    assert second[0] == pytest.approx(-0.006382)
    for wrong in ("{}", "", STORED.replace('"fcaltilt"', '"x"'), STORED.replace("0.045", "nan")):
        file.write_text(wrong)
        with pytest.raises(FormatError):
            read_stored_calibrations(file)
    with pytest.raises(MissingDataError):
        read_stored_calibrations(tmp_path / "absent.json")


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damage_of_any_kind_is_an_error_or_a_warning(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(Room(seconds=0.3).build().text("0.2 WM0 POSE 1 2 3 1 0 0 0"))
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(content) - 1))
        match data.draw(st.sampled_from(["flip", "cut", "insert", "digits", "repeat", "end"])):
            case "flip":
                content[at] ^= 1 << data.draw(st.integers(0, 7))
            case "cut":
                del content[at : at + data.draw(st.integers(1, 300))]
            case "insert":
                content[at:at] = data.draw(st.binary(min_size=1, max_size=40))
            case "digits":
                content[at:at] = b"9" * data.draw(st.integers(1, 30))
            case "repeat":
                content[at:at] = content[at : at + 2000]
            case "end":
                del content[at + 1 :]
        if not content:
            break
    file = tmp_path / "damaged.rec"
    packed = gzip.compress(bytes(content), 1)
    if data.draw(st.booleans()):
        damaged = bytearray(packed)
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
        packed = bytes(damaged)
    file.write_bytes(packed if data.draw(st.booleans()) else bytes(content))
    try:
        session = read_libsurvive([file], stations=True)
    except LocatkError:
        return
    sweeps = session.sweeps
    assert np.all((sweeps.count >= 0) & (sweeps.count <= period_counts(sweeps.channel)))
    assert np.all(np.diff(sweeps.time_ns) >= 0)


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0, 1e9),
            st.sampled_from(["Y", "W"]),
            st.integers(0, 15),
            st.integers(0, (1 << 32) - 1),
        ),
        min_size=1,
        max_size=60,
    )
)
def test_lines_of_any_numbers(
    tmp_path_factory: pytest.TempPathFactory, lines: list[tuple[float, str, int, int]]
) -> None:
    file = tmp_path_factory.getbasetemp() / "any.rec"
    text = [
        f"{t:.6f} T Y {c} {k} 1 0" if kind == "Y" else f"{t:.6f} T W {c} 0 {k} 1"
        for t, kind, c, k in lines
    ]
    file.write_text("\n".join(text))
    try:
        session = read_libsurvive([file])
    except LocatkError:
        return
    assert len(session.sweeps) > 0


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300), st.integers(0, len(STORED)))
def test_stored_configurations_of_any_bytes(
    tmp_path_factory: pytest.TempPathFactory, rubbish: bytes, at: int
) -> None:
    file = tmp_path_factory.getbasetemp() / "any.json"
    file.write_bytes(STORED[:at].encode() + rubbish + STORED[at:].encode())
    with suppress(LocatkError):
        read_stored_calibrations(file)


# ---- the published recording


@pytest.fixture(scope="module")
def published(data: Path) -> Path:
    file = data / PUBLISHED
    if not file.is_file():
        pytest.skip(f"{file} is absent")
    return file


@pytest.fixture(scope="module")
def imported(published: Path) -> ImportedSession:
    return read_libsurvive([published], stations=True)


@pytest.mark.slow
def test_published_calibrations_are_those_that_libsurvive_stored(
    published: Path, imported: ImportedSession
) -> None:
    session = imported
    stored = read_stored_calibrations(published.with_name(published.name + ".json"))
    assert session.lost is None
    assert session.warnings == []
    assert len(session.sweeps) == 138_259
    assert [s.channel for s in session.stations] == [1, 4, 8, 12]
    assert np.all(session.sweeps.sweep >= 0)
    for station in session.stations:
        assert station.id is not None
        assert station.calibration is not None
        assert station.frames >= 5
        assert station.damaged == 0
        # Six decimals are stored.
        difference = np.abs(station.calibration.sweeps - stored[station.id].sweeps)
        assert difference.max() < 5.1e-7
        assert station.period_ticks is not None
        assert abs(station.period_ticks / period_ticks(station.channel) - 1) < 10e-6


@pytest.mark.slow
def test_published_accelerometers_agree_with_the_level_of_the_tracker(
    imported: ImportedSession,
) -> None:
    """libsurvive levels its world by the tracker's IMU, independent of the stations."""
    assert imported.scene is not None
    ups = {
        each.channel: up
        for each in imported.stations
        if each.acceleration and (up := up_from_acceleration(each.acceleration)) is not None
    }
    measured = station_ups(with_ups(imported.scene, ups))
    up = estimate_up(measured)
    assert up is not None
    assert up.direction is not None
    assert (len(up.used), up.contradicting) == (4, ())
    inclinations = [np.degrees(np.arccos(each.direction[2])) for each in measured]
    assert inclinations == pytest.approx([2.7, 3.7, 1.2, 1.8], abs=0.1)
    assert np.degrees(np.arccos(up.direction[2])) < 1.5
    assert imported.scene.is_level


@pytest.mark.slow
def test_published_angles_are_libsurvives_but_for_the_noise_of_single_syncs(
    published: Path,
) -> None:
    recording = read_rec_file(published, angles=True)
    heard = read_device_sweeps(recording, 0)
    sweeps, angles = recording.sweeps.take(heard.row), recording.angles

    def name(lines: rec_file.Columns) -> np.ndarray:
        return (lines.channel.astype(np.int64) * 1000 + lines.sensor) * (1 << 33) + lines.timecode

    order = np.argsort(name(sweeps))
    found = order[np.searchsorted(name(sweeps)[order], name(angles))]
    assert np.array_equal(name(sweeps)[found], name(angles))
    assert np.array_equal(heard.plane[found], angles.flag)
    difference = 2 * np.pi * heard.revolution[found] + ROTOR_ZERO_RAD[angles.flag] - angles.angle
    # A sync is some 10 ticks from where the rotor was: 0.07 mrad.
    assert np.sqrt(np.mean(difference**2)) < 5e-5
    assert np.abs(difference).max() < 5e-4
    assert abs(np.mean(difference)) < 1e-6


@pytest.mark.slow
def test_published_poses_photodiodes_and_stations_are_of_one_frame(
    imported: ImportedSession,
) -> None:
    session = imported
    assert session.scene is not None
    (truth,) = session.truth
    rotation = matrix_from_quaternion(np.median(truth.quaternion, axis=0))
    places = session.receivers["WM0"].position_m @ rotation.T + np.median(truth.position, axis=0)
    sweeps = session.sweeps
    assert len(session.scene.stations) == 4
    for station in session.scene.stations:
        ours = sweeps.channel == station.channel
        local = (places - station.position) @ station.rotation
        predicted = predict_angles(local, station.calibration)
        seen = 2 * np.pi * sweeps.count[ours] / period_counts(station.channel)
        seen += ROTOR_ZERO_RAD[sweeps.sweep[ours]]
        residual = seen - predicted[sweeps.sensor[ours], sweeps.sweep[ours]]
        # In the axes of the imu, or of the model, it is 10 mrad and more.
        assert np.median(np.abs(residual)) < 4e-4
