"""docs/crazyflie_stream.py: run as a program with a stand-in for cflib, and recorded."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.simulation.session import SimulationOptions, simulate
from locatk.core.simulation import SESSION_START_NS
from locatk.formats.artifacts.receiver import RECEIVER_FILE, dumps_receiver
from locatk.formats.capture.ingestion import SerialIntake
from locatk.formats.capture.reader_thread import ReceivedData
from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Options, Stream, Ticks
from locatk.formats.devices.locatk_frames.decoder import FrameDecoder
from locatk.formats.devices.locatk_frames.framing import encode_frame
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD
from locatk.formats.sessions.observations import read_imu, read_onboard, read_sweeps
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

LIMIT_S = 30.0

DECK_HZ = 24e6 * (1 - 7e-6)
"""Clock of the deck, as the computer sees it."""

STM_HZ = 1000 * (1 + 12e-6)

DELAY_S = 0.002
"""Of all packets."""

SYNCHRONIZATION_S = 2.0
"""Time after which the clocks are synchronized."""

MAX_CLOCK_ERROR_S = 0.004
"""Of times after that: the smallest delays on a busy machine differ."""

PULSE_TICKS = 290
"""Width of a pulse, which its middle is later than its start by half of."""

FIRST_STAMP = (1 << 24) - 700
"""The clock of the log wraps after 0.7 s."""

ABSENT = 0x7FFF


# ---- packets, as crazyflie-firmware writes them (lighthouse_transmit.c)


def passage(
    channel: int, slow_bit: int, offset: int, reference: int, delays: dict[int, int]
) -> bytes:
    head = channel - 1 << 20 | slow_bit << 17 | offset
    delay = [delays.get(sensor, ABSENT) for sensor in range(4)]
    times = (reference & 0xFFFFFF).to_bytes(3, "little") + struct.pack("<4h", *delay)
    return head.to_bytes(3, "little") + times


def passages_of(sweeps: Sweeps, start_ns: int) -> list[tuple[float, bytes]]:
    """Times in s and records of a deck; the second pulse of a passage has the offset."""
    time_s = (sweeps.time_ns - start_ns) * 1e-9
    start = np.rint(time_s * DECK_HZ).astype(np.int64) + 16_000_000
    found = []
    for polynomial in np.unique(sweeps.polynomial):
        rows = np.flatnonzero(sweeps.polynomial == polynomial)
        for group in np.split(rows, np.flatnonzero(np.diff(start[rows]) > 10_000) + 1):
            first = group[min(1, len(group) - 1)]
            reference = int(start[first])
            # The starts agree with the counts, to a tick.
            steps = np.rint(4 * (sweeps.count[group] - sweeps.count[first])).astype(int)
            delays = {
                int(s): int(d) + PULSE_TICKS // 2
                for s, d in zip(sweeps.sensor[group], steps, strict=True)
            }
            offset = round(sweeps.count[first])
            number = int(polynomial)
            data = passage(number // 2 + 1, number % 2, offset, reference, delays)
            found.append((float(time_s[group].max()), data))
    return sorted(found)


def packets_of(passages: list[tuple[float, bytes]]) -> list[tuple[float, bytes]]:
    """Packets of two records, which leave with the second one."""
    pairs = zip(passages[::2], passages[1::2], strict=False)
    return [(second[0], first[1] + second[1]) for first, second in pairs]


# ---- decoding


def decoded(*payloads: bytes) -> tuple[dict[str, NDArray[Any]], FrameDecoder]:
    decoder = FrameDecoder(Options())
    head = struct.Struct("<BBHI")
    hello = encode_frame(head.pack(1, 0, 0, 5) + struct.pack("<B3xI", 1, 1000))
    frames = [encode_frame(head.pack(10, 0, k, 5) + p) for k, p in enumerate(payloads, 1)]
    wire = b"".join([hello, *frames])
    batches = [batch for batch in decoder.feed(wire) if batch.stream.kind != "log"]
    decoder.finish()
    stream = Stream("lighthouse", sensors=4, ticks=Ticks(24e6, 24, "deck"))
    assert all(batch.stream == stream for batch in batches)
    names = ("sensor", "channel", "polynomial", "sweep", "count")
    columns = {name: np.concatenate([[], *(b.columns[name] for b in batches)]) for name in names}
    columns["tick"] = np.concatenate([[], *(b.tick for b in batches if b.tick is not None)])
    return columns, decoder


def test_a_passage_over_four_photodiodes() -> None:
    # The reference is the start of the pulse of sensor 1; delays include half of each width.
    columns, decoder = decoded(passage(3, 1, 40_000, 1000, {1: 145, 0: -55, 3: 1200, 2: 1100}))
    assert columns["sensor"].tolist() == [0, 1, 2, 3]
    assert set(columns["channel"]) == {3}
    assert set(columns["polynomial"]) == {5}
    assert set(columns["sweep"]) == {-1}
    assert columns["count"].tolist() == [40_000 + d / 4 for d in (-200, 0, 955, 1055)]
    assert columns["tick"].tolist() == [800, 1000, 1955, 2055]
    assert (decoder.counts.frames, decoder.counts.bad, decoder.remarks) == (2, 0, [])


def test_times_ascend_and_wrap_with_the_clock_of_the_deck() -> None:
    columns, _ = decoded(passage(1, 0, 30_000, 0xFFFFF0, {3: 160, 0: 170, 1: 4000, 2: -100}))
    assert columns["sensor"].tolist() == [2, 3, 0, 1]
    assert columns["tick"].tolist() == [0xFFFFF0 - 260, 0xFFFFF0, 0xFFFFFA, 3840 - 16]


@pytest.mark.parametrize(
    ("delays", "half_width"),
    [
        ([-300, 145, 500, 900], 145),  # the second pulse has the offset
        ([148, 185, 900, 990], 185),  # although the first one could have it, too
        ([-900, -800, 130, 900], 130),  # only the third one can
        ([-900, 20, 190, 400], 190),  # the one with the most typical delay
        ([160], 160),
        ([-900, -800, -700, 2000], 150),  # its pulse was replaced by a later one
        ([-900, 900], 150),
    ],
)
def test_sweeps_refer_to_the_starts_of_pulses(delays: list[int], half_width: int) -> None:
    columns, _ = decoded(passage(1, 0, 40_000, 50_000, dict(enumerate(delays))))
    assert columns["count"].tolist() == [40_000 + (d - half_width) / 4 for d in delays]


def test_published_frames_give_the_same_sweeps_by_wire_and_by_radio(
    published_frames: list[dict[str, Any]],
) -> None:
    wire, packets = b"\xff" * 12, []
    delays: dict[int, tuple[int, int]] = {}
    channel, reference, offset = -1, 0, 0
    for each in published_frames:
        sensor, tick, width, number, position, word = each.values()
        head = 0xFC if number is None else number << 2
        fields = ((head | sensor, 1), (width, 2), (position, 3), (word, 3), (tick, 3))
        wire += b"".join(value.to_bytes(size, "little") for value, size in fields)
        # As lighthouse_transmit.c: a record when all four photodiodes were lit.
        delays[sensor] = tick, width // 2
        if number is not None and channel < 0:
            channel, reference = number, tick
        if position:
            reference, offset = tick, position
        if len(delays) == 4:
            sent = {key: start + half - reference for key, (start, half) in delays.items()}
            packets.append(passage(channel // 2 + 1, channel % 2, offset, reference, sent))
            delays, channel, offset = {}, -1, 0
    by_radio, _ = decoded(packets[0] + packets[1], packets[2] + packets[3])
    deck = find_device("lighthouse-deck").create_decoder(Options())
    batches = [*deck.feed(wire), *deck.finish()]
    for name in ("sensor", "channel", "polynomial", "count"):
        by_wire = np.concatenate([batch.columns[name] for batch in batches])
        # Widths of the pulses of a passage differ by 29 ticks at most, counts by an eighth of it.
        tolerance = 29 / 8 if name == "count" else 0
        np.testing.assert_allclose(by_radio[name], by_wire, atol=tolerance, rtol=0)
    assert len(by_radio["count"]) == 16


def test_photodiodes_without_light_give_no_sweep() -> None:
    columns, decoder = decoded(passage(16, 0, 30_000, 0, {2: 140}))
    assert columns["sensor"].tolist() == [2]
    assert columns["channel"].tolist() == [16]
    assert decoder.remarks == []


@pytest.mark.parametrize(
    ("data", "used"),
    [
        (passage(1, 0, 0, 0, {0: 100, 1: 200}), 0),  # no offset
        (passage(1, 0, 30_000, 0, {0: 100, 1: 10_001, 2: -10_001}), 1),  # another passage
        (passage(1, 0, 30, 0, {0: 100, 1: -21}), 1),  # before the rotor's zero
    ],
)
def test_pulses_that_belong_to_no_sweep_are_reported(data: bytes, used: int) -> None:
    columns, decoder = decoded(data, passage(2, 0, 40_000, 50, {0: 10}))
    assert len(columns["sensor"]) == used + 1
    total = sum(d != ABSENT for d in struct.unpack("<4h", data[6:])) + 1
    assert decoder.remarks == [
        f"{total - used - 1} of {total} pulses of the Lighthouse deck are in no sweep: their "
        "passage has no offset, or they are of another one"
    ]


def test_only_a_deck_has_its_photodiodes() -> None:
    device = find_device("locatk")
    deck = Stream("lighthouse", sensors=4)
    assert device.default_artifacts(deck) == {RECEIVER_FILE: dumps_receiver(DECK)}
    for stream in (Stream("lighthouse"), Stream("halls", sensors=4), Stream("imu")):
        assert device.default_artifacts(stream) == {}


@pytest.mark.parametrize(
    "data", [b"", bytes(13), bytes(15), b"\0\0\x04" + bytes(11), b"\0\0\x08" + bytes(11)]
)
def test_what_is_no_passage_is_a_bad_frame(data: bytes) -> None:
    columns, decoder = decoded(data)
    assert not len(columns["sensor"])
    assert (decoder.counts.frames, decoder.counts.bad) == (1, 1)


# ---- the script


@pytest.fixture(scope="module")
def script(root: Path) -> Path:
    return root / "docs" / "crazyflie_stream.py"


@pytest.fixture(scope="module")
def stand_in(root: Path) -> Path:
    return root / "tests" / "data" / "cflib_stand_in"


@pytest.fixture(scope="module")
def module(script: Path, stand_in: Path) -> Iterator[ModuleType]:
    """The script as a program of a user imports it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(stand_in))
        for name in [name for name in sys.modules if name.partition(".")[0] == "cflib"]:
            patch.delitem(sys.modules, name)
        spec = importlib.util.spec_from_file_location("crazyflie_stream", script)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module


@given(st.binary(max_size=240), st.integers(0, 1 << 20), st.integers(0, 1 << 40))
def test_frames_are_those_of_the_protocol(
    module: ModuleType, payload: bytes, sequence: int, tick: int
) -> None:
    content = struct.pack("<BBHI", 10, 0, sequence & 0xFFFF, tick & 0xFFFFFFFF) + payload
    assert module.encode_frame(10, sequence, tick, payload) == encode_frame(content)


def test_attitude_has_its_pitch_reversed(module: ModuleType) -> None:
    angles = np.random.default_rng(1).uniform(-180, 180, (50, 3))
    for roll, pitch, yaw in angles:
        expected = Rotation.from_euler("ZYX", [yaw, -pitch, roll], degrees=True)
        found = Rotation.from_quat(module.quaternion_xyzw(roll, pitch, yaw))
        assert (expected.inv() * found).magnitude() < 1e-9
    # Nose up: the firmware's pitch is positive, a rotation about the left axis is negative.
    assert Rotation.from_quat(module.quaternion_xyzw(0, 90, 0)).apply([1, 0, 0])[2] > 0.99


def test_lost_packets_are_counted_in_spite_of_jitter(module: ModuleType) -> None:
    block = module.LogBlock("imu", 10, ())
    stamps = [0, 13, 20, 27, 40, 50, 90, 101, 109]
    assert [block.count_lost(stamp) for stamp in stamps] == [0, 0, 0, 0, 0, 0, 3, 0, 0]
    assert block.lost == 3


@dataclass
class Flight:
    """What the Crazyflie sends, and what shall come of it."""

    lines: list[tuple[Any, ...]] = field(default_factory=list)
    sweeps: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    """Polynomial, sensor, count, and time in s since the first one."""
    lost: int = 0

    def write(self, path: Path) -> Path:
        lines = sorted(self.lines, key=lambda line: line[0])
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        return path


LOST_PACKETS = range(160, 167)


def simulated_flight(duration_s: float, seed: int = 5) -> Flight:
    options = SimulationOptions(
        planar=False, receiver=DECK, report_hz=50, duration_s=2 * duration_s, seed=seed
    )
    sweeps = simulate(options).sweeps
    # In the first half it is carried from marker to marker, without sweeps in between.
    sweeps = sweeps.take(sweeps.time_ns >= SESSION_START_NS + round(duration_s * 1e9))
    start_ns = int(sweeps.time_ns[0])
    columns = (sweeps.polynomial, sweeps.sensor, sweeps.count, (sweeps.time_ns - start_ns) * 1e-9)
    flight = Flight(sweeps=np.stack(columns, axis=1), lost=len(LOST_PACKETS))
    for time_s, data in packets_of(passages_of(sweeps, start_ns)):
        flight.lines.append((time_s + DELAY_S, "raw", data.hex()))
    for index in range(int(100 * duration_s)):
        stamp, time_s = FIRST_STAMP + 10 * index, 10 * index / STM_HZ + DELAY_S
        if index not in LOST_PACKETS:
            values = [0.001 * index, 0.5, 1.0, 90.0, -180.0, 0.01 * index]
            flight.lines.append((time_s, "log", "acc.x", stamp % (1 << 24), values))
        if index % 2 == 0:
            # Of the same time, but stamped by another task.
            values = [0.01 * index, 2.0, 0.5, 10.0, 20.0, 0.5 * index]
            stamp = (stamp + 3) % (1 << 24)
            flight.lines.append((time_s + 0.003, "log", "stateEstimate.x", stamp, values))
    return flight


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running(
    python: Path | str, script: Path, *words: object, **variables: str
) -> Iterator[subprocess.Popen[str]]:
    """The script as a program of its own, which ends with the block at the latest."""
    process = subprocess.Popen(
        [str(python), str(script), *map(str, words)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **variables},
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def check_recording(path: Path, flight: Flight) -> None:
    """Check that a recording holds what was sent, at its times."""
    session = Session.open(path)
    assert int(session.metadata()[CAPTURE_RECORD]["lost"]) == flight.lost

    sweeps = read_sweeps(session)
    found = np.stack([sweeps.polynomial, sweeps.sensor, sweeps.count], axis=1)
    assert len(found) > 0.9 * len(flight.sweeps)
    # The recording lasts longer than the flight: the last sweeps are the same.
    sent = flight.sweeps[np.argsort(flight.sweeps[:, 3])]
    last = np.flatnonzero(np.abs(sent[:, :3] - found[-1]).max(axis=1) < 0.51)[-1]
    assert last >= len(sent) - 5
    time_s = (sweeps.time_ns - sweeps.time_ns[-1]) * 1e-9 + sent[last, 3]
    for row, received_s in zip(found, time_s, strict=True):
        tolerance_s = MAX_CLOCK_ERROR_S if received_s > SYNCHRONIZATION_S else 0.1
        near = np.abs(sent[:, 3] - received_s) < tolerance_s
        assert (np.abs(sent[near, :3] - row).max(axis=1) < 0.51).any(), (row, received_s)

    (imu,) = read_imu(session)
    expected = np.array([0.5 * 9.80665, 9.80665, np.pi / 2, -np.pi])
    values = np.hstack([imu.acceleration[:, 1:], imu.angular_rate[:, :2]])
    np.testing.assert_allclose(values, np.tile(expected, (len(imu), 1)), rtol=1e-6)
    index = np.rint(imu.acceleration[:, 0] / 9.80665 * 1000)
    delay_s = (imu.time_ns - imu.time_ns[0]) * 1e-9 - index / 100
    assert np.ptp(delay_s[index > 100 * SYNCHRONIZATION_S]) < MAX_CLOCK_ERROR_S
    assert np.abs(np.degrees(imu.angular_rate[:, 2]) - 0.01 * index).max() < 1e-4

    (track,) = read_onboard(session)
    assert track.device == imu.device == "robot"
    index = np.rint(track.position[:, 0] * 100)
    delay_s = (track.time_ns - imu.time_ns[0]) * 1e-9 - index / 100
    assert np.ptp(delay_s[index > 100 * SYNCHRONIZATION_S]) < MAX_CLOCK_ERROR_S
    np.testing.assert_allclose(track.position[:, 1:], np.tile([2.0, 0.5], (len(track), 1)))
    expected_rotation = Rotation.from_euler(
        "ZYX",
        np.stack([0.5 * index, np.full(len(index), -20.0), np.full(len(index), 10.0)], 1),
        degrees=True,
    )
    found_rotation = Rotation.from_quat(track.quaternion)
    assert (expected_rotation.inv() * found_rotation).magnitude().max() < 1e-5


@pytest.mark.slow
def test_a_flight_is_recorded(
    script: Path, stand_in: Path, tmp_path: Path, locatk: Callable[..., Result]
) -> None:
    flight, port = simulated_flight(5.0), free_port()
    recording, diary = tmp_path / "run.mcap", tmp_path / "diary"
    variables = {
        "PYTHONPATH": str(stand_in),
        "CRAZYFLIE_FLIGHT": str(flight.write(tmp_path / "flight.jsonl")),
        "CRAZYFLIE_DIARY": str(diary),
    }
    arguments = ("radio://stand-in", "--port", port)
    with running(sys.executable, script, *arguments, **variables) as process:
        words = (f"socket://127.0.0.1:{port}", "--wait", "10s", "--duration", "6s")
        result = locatk("capture", *words, "-o", recording, "--json")
        process.send_signal(signal.SIGINT)
        _, messages = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, messages
    assert result.exit_code == 3, result.output  # The radio lost packets.
    report = json.loads(result.stdout)
    assert (report["device"], report["system"]) == ("locatk", "lighthouse")
    attached = [each.name for each in Session.open(recording).attachments()]
    assert attached == ["receiver.toml"]
    check_recording(recording, flight)
    # The stream is switched off before the link is closed, and cflib misread no packet of it.
    asked = diary.read_text().splitlines()
    assert asked[:3] == ["start imu", "start poses", "lighthouse.enLhRawStream=1"]
    assert asked[3:] == ["stop imu", "stop poses", "lighthouse.enLhRawStream=0", "close"]
    assert f"{flight.lost} of" in messages


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variables", "words", "said"),
    [
        ({}, ["radio://0/80/2M"], "Error: radio://0/80/2M: Couldn't load link driver: no"),
        (
            {"CRAZYFLIE_PARAMETERS": "deck.bcLighthouse4"},
            ["radio://stand-in"],
            "Error: radio://stand-in: the firmware has no parameter lighthouse.enLhRawStream",
        ),
        (
            {},
            ["radio://stand-in", "--port", "70000"],
            "Error: radio://stand-in: cannot listen at 127.0.0.1:70000",
        ),
        ({"PYTHONPATH": ""}, [], "Error: cflib cannot be imported (No module named 'cflib')."),
        ({}, ["radio://stand-in"], "Error: radio://stand-in: connection lost (Too many packets"),
    ],
)
def test_errors_are_one_line(
    variables: dict[str, str],
    words: list[str],
    said: str,
    script: Path,
    stand_in: Path,
    tmp_path: Path,
) -> None:
    if variables.get("PYTHONPATH") == "" and importlib.util.find_spec("cflib") is not None:
        pytest.skip("cflib is installed")
    flight = Flight([(0.1, "lost")]).write(tmp_path / "flight.jsonl")
    environment = {
        "PYTHONPATH": str(stand_in),
        "CRAZYFLIE_FLIGHT": str(flight),
        "CRAZYFLIE_DIARY": str(tmp_path / "diary"),
        **variables,
    }
    arguments = words if "--port" in words else [*words, "--port", free_port()]
    with running(sys.executable, script, *arguments, **environment) as process:
        _, messages = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1, messages
    assert "Traceback" not in messages
    errors = [line for line in messages.splitlines() if line.startswith("Error: ")]
    assert len(errors) == 1, messages
    assert errors[0].startswith(said)
    assert "Hint: " in messages


# ---- with cflib itself


class UdpCrazyflie(threading.Thread):
    """Crazyflie behind ``udp://``, as far as cflib talks to it: CRTP of protocol version 10.

    Sources: documentation of the Crazy RealTime Protocol, https://www.bitcraze.io/documentation/
    repository/crazyflie-firmware/master/functional-areas/crtp/.
    """

    PARAMETERS = ("deck.bcLighthouse4", "lighthouse.enLhRawStream")
    VARIABLES = tuple(
        [f"{group}.{axis}" for group in ("acc", "gyro", "stateEstimate") for axis in "xyz"]
        + [f"stateEstimate.{angle}" for angle in ("roll", "pitch", "yaw")]
    )

    def __init__(self, flight: Flight) -> None:
        super().__init__(daemon=True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.uri = f"udp://127.0.0.1:{self._socket.getsockname()[1]}"
        self._client: Any = None
        self._flight = flight
        self.values = dict.fromkeys(self.PARAMETERS, 0) | {"deck.bcLighthouse4": 1}
        self.blocks: dict[int, list[str]] = {}
        self.started: set[int] = set()
        self.asked: list[str] = []

    def run(self) -> None:
        while True:
            packet, self._client = self._socket.recvfrom(64)
            self.answer(packet[0] >> 4, packet[0] & 3, packet[1:])

    def send(self, port: int, channel: int, data: bytes) -> None:
        self._socket.sendto(bytes([port << 4 | channel]) + data, self._client)

    def answer(self, port: int, channel: int, data: bytes) -> None:
        if (port, channel) == (15, 1):
            self.send(port, channel, b"Bitcraze Crazyflie\0")
        elif (port, channel) == (15, 0):  # ping
            self.send(port, channel, data)
        elif (port, channel) == (13, 1):  # version of the protocol
            self.send(port, channel, data[:1] + b"\x0a")
        elif (port, channel) == (4, 0):  # no memories
            self.send(port, channel, data[:1] + b"\0")
        elif channel == 0 and port in (2, 5):
            self.describe(port, data)
        elif port == 5:
            self.configure(data)
        elif port == 2:
            name = self.PARAMETERS[int.from_bytes(data[:2], "little")]
            if channel == 2:
                self.values[name] = data[2]
                self.asked.append(f"{name}={data[2]}")
                if data[2]:
                    threading.Thread(target=self.play, daemon=True).start()
                self.send(port, channel, data)
            else:
                self.send(port, channel, data[:2] + bytes([0, self.values[name]]))

    def describe(self, port: int, data: bytes) -> None:
        """Answer to questions about the table of contents."""
        names = self.PARAMETERS if port == 2 else self.VARIABLES
        if data[0] == 3:
            self.send(port, 0, data[:1] + struct.pack("<HI", len(names), 0x1000 * port))
        else:
            text = names[int.from_bytes(data[1:3], "little")].replace(".", "\0") + "\0"
            kind = b"\x08" if port == 2 else b"\x07"  # uint8_t, float
            self.send(port, 0, data[:3] + kind + text.encode())

    def configure(self, data: bytes) -> None:
        """Answer to commands about blocks of the log."""
        command, block = data[0], data[1] if len(data) > 1 else 0
        if command in (6, 7):
            entries = struct.iter_unpack("<BH", data[2:])
            self.blocks.setdefault(block, []).extend(self.VARIABLES[k] for _, k in entries)
        elif command == 3:
            self.started.add(block)
            self.asked.append(f"start {self.blocks[block][0]} {10 * data[2]} ms")
        elif command == 4:
            self.started.discard(block)
            self.asked.append(f"stop {self.blocks[block][0]}")
        self.send(5, 1, bytes([command, block, 0]))

    def play(self) -> None:
        start = time.monotonic()
        for time_s, kind, *rest in sorted(self._flight.lines, key=lambda line: line[0]):
            time.sleep(max(0.0, start + time_s - time.monotonic()))
            if not self.values["lighthouse.enLhRawStream"]:
                return
            if kind == "raw":
                self.send(6, 3, bytes.fromhex(rest[0]))
                continue
            first, stamp, values = rest
            for block in list(self.started):
                if self.blocks[block][0] == first:
                    assert len(values) == len(self.blocks[block])
                    head = bytes([block]) + stamp.to_bytes(3, "little")
                    self.send(5, 2, head + struct.pack(f"<{len(values)}f", *values))


def python_with_cflib() -> str:
    """Python of an environment with cflib, which is not one of locatk's packages."""
    python = os.environ.get("LOCATK_CFLIB_PYTHON")
    if python is None:
        pytest.skip("no environment with cflib (see LOCATK_CFLIB_PYTHON)")
    return python


@pytest.mark.slow
def test_cflib_understands_what_the_script_asks(
    script: Path, tmp_path: Path, locatk: Callable[..., Result]
) -> None:
    python = python_with_cflib()
    flight, port = simulated_flight(5.0), free_port()
    crazyflie = UdpCrazyflie(flight)
    crazyflie.start()
    recording = tmp_path / "run.mcap"
    words = (f"socket://127.0.0.1:{port}", "--wait", "20s", "--duration", "6s", "-o", recording)
    with running(python, script, crazyflie.uri, "--port", port) as process:
        result = locatk("capture", *words)
        process.send_signal(signal.SIGINT)
        _, messages = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, result.exit_code) == (0, 3), messages + result.output
    assert "Traceback" not in messages
    check_recording(recording, flight)
    start, stop = ["start acc.x 10 ms", "start stateEstimate.x 20 ms"], ["stop acc.x"]
    assert crazyflie.asked[0] == start[0]
    assert set(crazyflie.asked[:3]) == {*start, "lighthouse.enLhRawStream=1"}
    assert {*stop, "stop stateEstimate.x", "lighthouse.enLhRawStream=0"} == set(crazyflie.asked[3:])


# ---- to poses


def raw_packets(flight: Any, rng: np.random.Generator) -> list[tuple[float, bytes]]:
    """Times in s and packets of a deck whose clock is 7 ppm slow."""
    found = []
    crossings = flight.crossings()
    key = crossings["channel"] * 10_000_000 + crossings["turn"] * 2 + crossings["plane"]
    slow_bits = rng.integers(0, 2, (17, int(crossings["turn"].max()) + 1))
    for number in np.unique(key):
        rows = np.flatnonzero(key == number)
        channel, turn = int(crossings["channel"][rows[0]]), int(crossings["turn"][rows[0]])
        seen = rows[rng.random(len(rows)) < 0.97]
        if len(seen) < 2:
            continue
        tick = np.rint(crossings["t"][seen] * DECK_HZ).astype(int)
        reference = int(tick[1])
        period = {1: 959_000, 2: 957_000, 3: 953_000}[channel] / 8
        offset = round(crossings["fraction"][seen[1]] * period)
        delay = tick - reference + PULSE_TICKS // 2
        delays = dict(zip(crossings["sensor"][seen].tolist(), delay, strict=True))
        bit = int(slow_bits[channel, turn])
        found.append((crossings["t"][seen].max(), passage(channel, bit, offset, reference, delays)))
    return packets_of(sorted(found))


@pytest.mark.slow
def test_the_stream_of_a_flight_is_solved(
    crazyflie: ModuleType, module: ModuleType, tmp_path: Path, locatk: Callable[..., Result]
) -> None:
    """Frames of the script, delayed by the radio, of a flight that another simulator made."""
    rng = np.random.default_rng(4)
    flight = crazyflie.Flight(seconds=10.0)
    start_ns = 1_800_000_000_000_000_000
    packets = [
        (time_s, module.LIGHTHOUSE_DECK, 0, data) for time_s, data in raw_packets(flight, rng)
    ]
    time_s = np.arange(0.0, flight.seconds, 0.02)
    quaternion = Rotation.from_matrix(flight.rotation(time_s)).as_quat()
    for t, position, q in zip(time_s, flight.position(time_s), quaternion, strict=True):
        packets.append((t, module.POSE, round(1000 * t), module.encode_series((*position, *q))))
    arrivals = np.array([packet[0] for packet in packets]) + 0.002
    arrivals += rng.exponential(0.004, len(packets))
    order = np.argsort(arrivals, kind="stable")
    intake = SerialIntake("crazyflie", "socket://here:1", "locatk")
    run = tmp_path / "run.mcap"
    with SessionWriter(run, system="lighthouse") as writer:
        writer.attach_toml(RECEIVER_FILE, dumps_receiver(DECK))
        stamped = []
        hello = struct.pack("<B3xI", 1, 1000)
        data = module.encode_frame(module.HELLO, 0, 0, hello)
        for sequence, index in enumerate(order.tolist(), 1):
            _, kind, tick, payload = packets[index]
            data += module.encode_frame(kind, sequence, tick, payload)
            received = ReceivedData(start_ns + int(arrivals[index] * 1e9), data, len(data))
            stamped += intake.take([received])
            data = b""
        for each in [*stamped, *intake.finish()]:
            writer.write(each.topic, each.message, each.time_ns, each.publish_ns)
    assert intake.remarks() == []
    solved = tmp_path / "solved.mcap"
    assert locatk("solve", run, "-o", solved).exit_code == 0
    # What the Crazyflie sends as its own estimate is the truth here. It has another clock, which
    # is synchronized after some seconds.
    result = locatk("eval", run, "--onboard", "--truth", solved, "--align", "se3", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["n"] > 450
    assert figures["median_m"] < 0.003
    assert figures["p95_m"] < 0.008
    assert figures["ape"]["rotation_deg"]["median"] < 0.3
