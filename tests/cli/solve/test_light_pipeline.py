"""From infrared edges to poses, from the command line: the light is drawn here.

Stations turn, bend their planes as real units do, and tell their factory data in their slow
bits; a photodiode's data line is sampled as an analyser does, and written by encoders of this
module. Nothing of the way under test takes part but the angles at which a calibrated plane
meets a point, and the frame of factory data, which have tests of their own.
"""

from __future__ import annotations

import gzip
import itertools
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.calibration import Calibration, predict_angles
from locatk.core.lighthouse.demodulation.ootx import encode_frame
from locatk.formats.sessions.observations import read_sweeps, read_trajectories
from locatk.formats.sessions.reader import Session

START_MS = 1_710_177_920_662
POLYNOMIALS = (0x1D258, 0x17E04, 0x1FF6B, 0x13F67)
TICKS = (959_000, 957_000)
"""Of 48 MHz, of channels 1 and 2 (crazyflie-firmware, pulse_processor_v2.c)."""

UNITS = (
    ("0.0 -0.047882 0.057678 0.00219 1.704102 -0.368164 1.700195",
     "-0.006214 0.041382 0.348877 -0.003235 0.12085 -0.299072 2.0625"),
    ("0.0 -0.05075 0.09015 -0.00575 1.865 0.0 0.0", "0.002192 0.04794 0.1891 -0.006054 2.307 0 0"),
)  # fmt: skip
"""Factory calibrations of real stations (libsurvive-extras-data, MIT; alvarado23lighthouse,
BSD-3): phase, tilt, curve, gibmag, gibphase, ogeemag, ogeephase of both planes."""

Array = np.ndarray[Any, np.dtype[Any]]
Places = Callable[[Array], Array]


@cache
def sequence(polynomial: int) -> Array:
    """Bits of a polynomial's sequence, by the register itself."""
    state, taps, bits = 1, POLYNOMIALS[polynomial], []
    for _ in range((1 << 17) - 1):
        bits.append(state >> 16)
        state = (state << 1 | (state & taps).bit_count() & 1) & 0x1FFFF
    return np.array(bits, bool)


@dataclass(frozen=True)
class Lamp:
    """A station: where it is and looks to, its rotor and its factory data."""

    channel: int
    position: tuple[float, float, float]
    target: tuple[float, float, float]
    unit: int
    number: int
    ppm: float
    zero_s: float

    @property
    def calibration(self) -> Calibration:
        rows = [np.array(row.split(), float).astype(np.float16) for row in UNITS[self.unit]]
        return Calibration(np.array(rows, float), "factory")

    @property
    def rotation(self) -> Array:
        forward = np.subtract(self.target, self.position)
        forward /= np.linalg.norm(forward)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left)
        return np.stack([forward, left, np.cross(forward, left)], axis=1)

    @property
    def payload(self) -> bytes:
        (phase, tilt, curve, gibmag, gibphase, ogeemag, ogeephase) = self.calibration.sweeps.T
        return struct.pack(
            "<HIeeeeBBeebbbeeeeBBeeeeH",
            *(6, self.number, *phase, *tilt, 3, 9, *curve, 2, 127, -2, *gibphase, *gibmag),
            *(127 + self.channel, 0, *ogeephase, *ogeemag, 77),
        )

    def bursts(self, where: Places, seconds: float, bits: int) -> tuple[Array, list[Array]]:
        """Starts of the bursts, and the edges of each, in seconds."""
        ticks = TICKS[self.channel - 1]
        period = ticks / 48e6 * (1 + 1e-6 * self.ppm)
        zero = self.zero_s + np.arange(int((seconds - self.zero_s) / period) - 1) * period
        turn = np.tile([1 / 3, 2 / 3], (len(zero), 1))
        for _ in range(5):
            local = (where(zero[:, None] + turn * period) - self.position) @ self.rotation
            angle = predict_angles(local, self.calibration)[..., [0, 1], [0, 1]]
            turn = angle / (2 * np.pi) + [1 / 3, 2 / 3]
        slow = np.resize(encode_frame(self.payload), len(zero))
        index = np.floor(turn * ticks / 8).astype(int) - bits // 2
        starts, edges = [], []
        for rotation, plane in itertools.product(range(len(zero)), (0, 1)):
            first = index[rotation, plane]
            places = first + np.arange(bits)
            ones = sequence(2 * (self.channel - 1) + slow[rotation])[places]
            steps = np.concatenate([places, places[-1:] + 1, places[ones] + 0.5])
            edges.append(zero[rotation] + np.sort(steps) * (period / (ticks / 8)))
            starts.append(edges[-1][0])
        return np.array(starts), edges


LAMPS = (
    Lamp(1, (-1.8, -1.4, 1.9), (0.1, 0.0, 0.3), 0, 0x4CC60647, -15.5, 0.0031),
    Lamp(2, (1.9, -1.2, 2.1), (0.0, 0.2, 0.2), 1, 0x0FF22226, -18.7, 0.0093),
)


def light(
    where: Places,
    seconds: float,
    lamps: Sequence[Lamp] = LAMPS,
    *,
    rate: float = 40e6,
    bits: int = 80,
) -> Array:
    """Samples at which the data line changes."""
    noise = np.random.default_rng(5)
    parts = [lamp.bursts(where, seconds, bits) for lamp in lamps]
    starts = np.concatenate([part[0] for part in parts])
    edges = [each for part in parts for each in part[1]]
    kept, free = [], 0.0
    for number in np.argsort(starts):  # beams that meet a photodiode at once are no bits at all
        if starts[number] > free:
            kept.append(edges[number])
            free = edges[number][-1] + 3e-6
    seen = np.concatenate(kept)
    return np.unique(np.rint((seen + noise.normal(0, 4e-9, len(seen))) * rate).astype(np.int64))


# ---- files of Logic 2


def captured(edges: Array, rate: int = 40_000_000) -> bytes:
    """``digital-N.bin``: one chunk, of run lengths."""
    runs = np.diff(edges, prepend=0, append=edges[-1] + rate // 100) - 1
    coded = bytearray()
    for run in runs.tolist():
        if run < 64:
            coded.append(run)
            continue
        groups = []
        while run >> 6:
            groups.append(run & 0x7F)
            run >>= 7
        coded.append(run | 0x40)
        coded += bytes(group | 0x80 for group in groups[:0:-1]) + bytes(groups[:1])
    end = int(runs.sum()) + len(runs)
    head = struct.pack("<iiBdQdHQ", 1, 100, 1, rate, START_MS, 0.0, 0, 1)
    chunk = struct.pack("<6Q", 0, end, end, rate, 1, len(coded)) + bytes(coded)
    return b"<SALEAE>" + head + chunk + struct.pack("<QQQI", 1, 0, 0, 0)


def capture(path: Path, *lines: Array) -> Path:
    meta = {"data": {"rowsSettings": []}, "binData": []}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for number, edges in enumerate(lines):
            packed.writestr(f"digital-{number}.bin", captured(edges))
        packed.writestr("meta.json", json.dumps(meta))
    return path


def table(path: Path, edges: Array, rate: float = 40e6) -> Path:
    """A CSV export with a line that never changes beside the light."""
    rows = [f"{tick / rate:.9f},{k & 1 ^ 1},1" for k, tick in enumerate(edges.tolist())]
    path.write_text("\n".join(["Time [s],Light,Supply", "0.000000000,0,1", *rows, ""]))
    return path


# ---- places

STOPS = np.array(
    [[-0.4, -0.3, 0.0], [0.5, -0.35, 0.1], [0.45, 0.4, 0.0], [-0.35, 0.45, 0.25], [0.0, 0.1, 0.5]]
)


def tour(stops: Array, leg_s: float, stay_s: float) -> Places:
    """From stop to stop, at rest on each in the middle of its leg."""

    def where(time: Array) -> Array:
        turn = np.clip(np.asarray(time, float) / leg_s - 0.5, 0, len(stops) - 1)
        whole = np.minimum(np.floor(turn).astype(int), len(stops) - 2)
        share = stay_s / leg_s / 2
        part = np.clip((turn - whole - share) / (1 - 2 * share), 0, 1)
        smooth = part * part * (3 - 2 * part)
        return stops[whole] + smooth[..., None] * (stops[whole + 1] - stops[whole])

    return where


def markers(path: Path, stops: Array, leg_s: float, stay_s: float, **more: object) -> Path:
    """A scene of places that the photodiode rested on."""
    lines = ['format = "locatk-lighthouse-scene"', "format_version = 1"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in more.items()]
    for number, place in enumerate(stops):
        middle = START_MS + 1e3 * (number + 0.5) * leg_s
        start, end = (np.datetime64(round(middle + side * 450 * stay_s), "ms") for side in (-1, 1))
        lines += [
            "[[markers]]",
            f'name = "stop {number}"',
            f"position_mm = {(1000 * place).tolist()}",
            "[[markers.sightings]]",
            'device = "photodiode"',
            f'start = "{start}Z"',
            f'end = "{end}Z"',
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


def answer(result: Any, status: int = 0) -> dict[str, Any]:
    """What ``--json`` says; stdout has nothing else."""
    assert result.exit_code == status, result.stderr
    return json.loads(result.stdout)


def errors(solution: Path, where: Places) -> Array:
    """Distances in metres of the poses from where the photodiode was."""
    (track,) = read_trajectories(solution)
    assert len(track) > 50
    return np.linalg.norm(track.position - where((track.time_ns - START_MS * 10**6) / 1e9), axis=1)


# ---- the whole way


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Places]:
    """A capture of ten seconds, in which both stations tell all of their factory data."""
    leg_s = 10.0 / len(STOPS)
    where = tour(STOPS, leg_s, 0.8)
    folder = tmp_path_factory.mktemp("light")
    # Not told that it is no floor: four of the five stops lie nearly on a plane.
    markers(folder / "scene.toml", STOPS, leg_s, 0.8)
    return capture(folder / "run.sal", light(where, 10.0)), where


def test_a_capture_becomes_poses(locatk, minute: tuple[Path, Places], tmp_path: Path) -> None:
    source, where = minute
    run, solved, scene = (tmp_path / name for name in ("run.mcap", "solved.mcap", "scene.toml"))
    told = answer(locatk("import", "saleae", source, "-o", run, "--json"))
    for lamp, station in zip(LAMPS, told["stations"], strict=True):
        assert (station["channel"], station["id"]) == (lamp.channel, f"{lamp.number:08x}")
        assert station["calibration"] == "factory"
        assert station["frames"] >= 1
        assert station["ppm"] == pytest.approx(lamp.ppm, abs=0.05)
        assert station["decode_rate"] > 0.99
    facts = answer(locatk("info", run, "--json"))
    assert [station["id"] for station in facts["stations"]] == [lamp.number for lamp in LAMPS]
    assert facts["sweeps"] == told["sweeps"] > 1900
    assert facts["metadata"]["facts"]["false polynomials"].startswith("0 of 1,9")
    options = ("--artifact", source.with_name("scene.toml"), "--save-scene", scene)
    [entry] = answer(locatk("solve", run, "-o", solved, *options, "--json"))["sessions"]
    assert {each["calibration"] for each in entry["detections"]} == {"factory"}
    off = errors(solved, where)
    assert np.median(off) < 1e-3
    assert np.quantile(off, 0.99) < 3e-3
    known = answer(locatk("info", solved, "--json"))
    for lamp, station in zip(LAMPS, known["stations"], strict=True):
        assert station["position_m"] == pytest.approx(lamp.position, abs=5e-3)
    # The stations that were solved serve a Crazyflie, and are read from its file again.
    config, again = tmp_path / "config.yaml", tmp_path / "again.toml"
    export = ("export", scene, "--format", "crazyflie-config", "-o", config)
    assert locatk(*export).exit_code == 0
    back = answer(locatk("import", "crazyflie-config", config, "-o", again, "--json"))
    assert back["warnings"] == []
    assert [each["id"] for each in back["stations"]] == [each["id"] for each in told["stations"]]


@pytest.fixture(scope="module")
def second() -> tuple[Array, Places]:
    """Light of both stations for two seconds, and where it was received."""
    where = tour(STOPS[:4], 0.5, 0.2)
    return light(where, 2.0), where


@pytest.mark.slow
def test_a_table_without_factory_data_is_solved_up_to_scale(
    locatk, second: tuple[Array, Places], tmp_path: Path
) -> None:
    run, solved = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    source = table(tmp_path / "run.csv", second[0])
    told = answer(locatk("import", "saleae", source, "-o", run, "--device", "wand", "--json"))
    assert told["devices"] == ["wand"]
    assert [station["id"] for station in told["stations"]] == [None, None]
    assert [station["frames"] for station in told["stations"]] == [0, 0]
    space = markers(tmp_path / "scene.toml", STOPS[:0], 0.5, 0.2, planar=False)
    result = locatk("solve", run, "-o", solved, "--artifact", space, "--json")
    assert answer(result)["sessions"][0]["poses"] > 50
    assert "unit scale" in result.stderr
    (track,) = read_trajectories(solved)
    # Distances between the four stops are in proportion: of real stations' planes only the
    # middle of all is known.
    places = np.array([
        np.median(track.position[np.abs(track.time_ns / 1e9 - 0.25 - 0.5 * k) < 0.07], axis=0)
        for k in range(4)
    ])  # fmt: skip
    pairs = np.array(list(itertools.combinations(range(4), 2))).T
    ratio = np.linalg.norm(places[pairs[0]] - places[pairs[1]], axis=1) / np.linalg.norm(
        STOPS[pairs[0]] - STOPS[pairs[1]], axis=1
    )
    assert np.ptp(ratio) / np.mean(ratio) < 0.03


def test_the_published_method_on_the_same_light(
    locatk, second: tuple[Array, Places], tmp_path: Path
) -> None:
    source = capture(tmp_path / "run.sal", light(second[1], 1.0, bits=170))
    soft, paper = tmp_path / "soft.mcap", tmp_path / "paper.mcap"
    answer(locatk("import", "saleae", source, "-o", soft, "--json"))
    answer(locatk("import", "saleae", source, "-o", paper, "--method", "paper", "--json"))
    channels = [read_sweeps(Session.open(path)).channel.tolist() for path in (soft, paper)]
    assert set(channels[0]) == {1, 2}
    assert 0.5 * len(channels[0]) < len(channels[1]) <= len(channels[0])


def test_limits_of_the_published_method_are_reported(locatk, data: Path, tmp_path: Path) -> None:
    """The station of this recording is on channel 7."""
    source, run = data / "lighthouse" / "fpga" / "take1.csv", tmp_path / "run.mcap"
    told = answer(locatk("import", "saleae", source, "-o", run, "--method", "paper", "--json"))
    assert told["sweeps"] < 20
    assert "knows only channels 1 to 4" in told["warnings"][0]


def test_two_photodiodes_are_two_sensors(
    locatk, second: tuple[Array, Places], tmp_path: Path
) -> None:
    edges, where = second
    other = light(lambda time: where(time) + [0.1, 0.0, 0.0], 2.0)
    source, run = capture(tmp_path / "run.sal", edges, other), tmp_path / "run.mcap"
    answer(locatk("import", "saleae", source, "-o", run, "--json"))
    sensors = read_sweeps(Session.open(run)).sensor
    counts = np.bincount(sensors)
    assert len(counts) == 2
    assert abs(int(counts[0]) - int(counts[1])) < 10
    # Told by number, in the order of the sensors.
    swapped = tmp_path / "swapped.mcap"
    args = ("--channel", 1, "--channel", 0, "-o", swapped, "--json")
    answer(locatk("import", "saleae", source, *args))
    assert np.bincount(read_sweeps(Session.open(swapped)).sensor).tolist() == counts[::-1].tolist()


# ---- section 4: what goes wrong


def refused(result: Any, output: Path, *words: str, status: int = 1) -> None:
    """One line with a hint, no traceback, nothing on stdout, no output."""
    assert result.exit_code == status, result.stderr
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("Error: ")
    assert " Hint: " in line
    for word in words:
        assert word in line
    assert not output.exists()
    assert not [path for path in output.parent.iterdir() if path.name.startswith(".")]


def test_one_station_needs_a_floor(locatk, tmp_path: Path) -> None:
    floor = STOPS[:4] * [1, 1, 0]
    where, leg_s = tour(floor, 0.5, 0.3), 0.5
    source = capture(tmp_path / "run.sal", light(where, 2.0, LAMPS[:1]))
    run, solved = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    answer(locatk("import", "saleae", source, "-o", run, "--json"))
    refused(locatk("solve", run, "-o", solved), solved, "one station needs 4 visited markers")
    scene = markers(tmp_path / "scene.toml", floor, leg_s, 0.3, planar=True)
    answer(locatk("solve", run, "-o", solved, "--artifact", scene, "--json"))
    assert np.quantile(errors(solved, where), 0.95) < 5e-3


def test_two_stations_on_one_channel(locatk, second: tuple[Array, Places], tmp_path: Path) -> None:
    first, other = LAMPS
    twin = Lamp(1, other.position, other.target, 1, 0xABCDEF01, 12.0, 0.0087)
    run = tmp_path / "run.mcap"
    source = capture(tmp_path / "both.sal", light(second[1], 2.0, (first, twin)))
    result = locatk("import", "saleae", source, "-o", run)
    refused(result, run, "more than one station sends on channel 1", "channel of its own")
    # Beside a station on another channel that one is kept, and what is lost is said.
    source = capture(tmp_path / "three.sal", light(second[1], 2.0, (first, twin, other)))
    told = answer(locatk("import", "saleae", source, "-o", run, "--json"), 3)
    assert [station["channel"] for station in told["stations"]] == [2]
    assert any("more than one station sends on channel 1" in text for text in told["warnings"])
    assert set(read_sweeps(Session.open(run)).channel.tolist()) == {2}


def test_a_rate_too_low(locatk, second: tuple[Array, Places], tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    slow = light(second[1], 0.5, rate=12e6)
    for source in (
        table(tmp_path / "run.csv", slow, 12e6),
        capture_at(tmp_path / "run.sal", slow, 12_000_000),
    ):
        refused(locatk("import", "saleae", source, "-o", run), run, "sampled at 12 MHz", "24 MHz")


def capture_at(path: Path, edges: Array, rate: int) -> Path:
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("digital-0.bin", captured(edges, rate))
    return path


def test_no_light(locatk, tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    clock = np.arange(1, 200_000) * 20
    source = capture(tmp_path / "clock.sal", clock)
    refused(locatk("import", "saleae", source, "-o", run), run, "no light", "--channel")
    noise = np.cumsum(np.random.default_rng(2).choice([3, 3, 7], 60_000))
    noise += np.arange(60_000) // 120 * 40_000  # bursts of bits that are of no station
    source = capture(tmp_path / "noise.sal", noise)
    refused(locatk("import", "saleae", source, "-o", run), run, "no light of a base station")
    dark = np.zeros(0, np.int64)
    source = capture_at(tmp_path / "dark.sal", np.append(dark, 1), 40_000_000)
    refused(locatk("import", "saleae", source, "-o", run), run, "no light")


def test_damaged_and_other_files(locatk, second: tuple[Array, Places], tmp_path: Path) -> None:
    run, source = tmp_path / "run.mcap", capture(tmp_path / "run.sal", second[0])
    whole = source.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 4]) + whole[middle + 1 :]
    for name, content, words in (
        ("cut.sal", whole[:middle], "damaged archive"),
        ("flipped.sal", flipped, str(tmp_path / "flipped.sal")),
        ("empty.sal", b"", "empty file"),
        ("text.csv", b"a,b\n1,2\n", "neither a capture"),
        ("picture.png", b"\x89PNG\r\n\x1a\n" + bytes(100), "neither a capture"),
    ):
        (tmp_path / name).write_bytes(content)
        refused(locatk("import", "saleae", tmp_path / name, "-o", run), run, words)
    refused(locatk("import", "saleae", tmp_path, "-o", run), run, "a folder")
    missing = tmp_path / "nowhere.sal"
    refused(locatk("import", "saleae", missing, "-o", run), run, "nowhere.sal")
    both = locatk("import", "saleae", source, source, "-o", run)
    refused(both, run, "takes one PATH", status=2)
    wrong = locatk("import", "saleae", source, "-o", run, "--channel", 9)
    refused(wrong, run, "no line '9'", "'Channel 0'")
    for name in ("", " ", "a\nb", "x" * 65):
        result = locatk("import", "saleae", source, "-o", run, "--device", name)
        refused(result, run, "printable", status=2)
    run.write_bytes(b"kept")
    result = locatk("import", "saleae", source, "-o", run)
    assert (result.exit_code, run.read_bytes()) == (1, b"kept")
    assert "--overwrite" in result.stderr
    assert locatk("import", "saleae", source, "-o", run, "--overwrite", "-q").exit_code == 0
    assert len(read_sweeps(Session.open(run))) > 300
    result = locatk("import", "saleae", source, "-o", source, "--overwrite")
    assert (result.exit_code, source.read_bytes()) == (1, whole)


@pytest.mark.slow
def test_an_interrupt_leaves_nothing(process, second: tuple[Array, Places], tmp_path: Path) -> None:
    source, run = capture(tmp_path / "run.sal", second[0]), tmp_path / "run.mcap"
    endless = (
        "import sys, locatk.formats.sessions.observations as o\n"
        "whole = o.sweep_messages\n"
        "def forever(sweeps):\n"
        "    while True:\n"
        "        yield from whole(sweeps)[0]\n"
        "        print('writing', file=sys.stderr, flush=True)\n"
        "o.sweep_messages = lambda sweeps: [forever(sweeps)]\n"
    )
    child = process("import", "saleae", source, "-o", run, first=endless)
    child.until("writing")
    assert child.stop() == 130
    assert child.stdout == ""
    assert "Traceback" not in child.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.sal"]


# ---- published recordings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ids", "sweeps"),
    [
        ("benchmarks/demodulation_code/logic_analyser_capture.sal", ["4cc60647", "0ff22226"],
         10_600),
        ("benchmarks/twoLH_2D/Logic_analyser_capture.sal", [None, None], 880),
        ("fpga/take1.csv", [None], 103),
        ("fpga/about_4m.csv", [None], 95),
    ],
)  # fmt: skip
def test_published_light(
    locatk, data: Path, tmp_path: Path, name: str, ids: list[str | None], sweeps: int
) -> None:
    run = tmp_path / "run.mcap"
    told = answer(locatk("import", "saleae", data / "lighthouse" / name, "-o", run, "--json"))
    assert set(told) == {
        *("version", "output", "format", "sweeps", "devices", "truth_poses", "stations"),
        *("imu_samples", "onboard_poses"),
        "warnings",
    }
    assert [station["id"] for station in told["stations"]] == ids
    assert told["sweeps"] >= sweeps
    assert len(read_sweeps(Session.open(run))) == told["sweeps"]


@pytest.mark.slow
def test_published_capture_of_a_photodiode_at_rest(locatk, data: Path, tmp_path: Path) -> None:
    """It shows two stations from one place: the sweeps are there, a scene is not."""
    run, solved = tmp_path / "run.mcap", tmp_path / "solved.mcap"
    source = data / "lighthouse" / "benchmarks" / "oneLH_2D" / "Logic_analyser_capture.sal"
    told = answer(locatk("import", "saleae", source, "-o", run, "--json"))
    assert len(told["stations"]) == 2
    refused(locatk("solve", run, "-o", solved), solved, "stood still")


@pytest.mark.slow
def test_published_tracker_complete_and_truncated(locatk, data: Path, tmp_path: Path) -> None:
    source = data / "lighthouse" / "libsurvive" / "tracker-cal-attempt.rec.gz"
    run, part = tmp_path / "run.mcap", tmp_path / "part.rec.gz"
    told = answer(locatk("import", "libsurvive", source, "-o", run, "--json"))
    assert [station["channel"] for station in told["stations"]] == [1, 4, 8, 12]
    assert {station["calibration"] for station in told["stations"]} == {"factory"}
    assert all(abs(station["ppm"]) < 10 for station in told["stations"])
    assert told["truth_poses"] > 7000
    shown = json.loads(locatk("info", run, "--json").stdout)
    ids = [int(station["id"], 16) for station in told["stations"]]
    assert [station["id"] for station in shown["stations"]] == ids
    [receiver] = shown["receivers"]
    assert (receiver["device"], receiver["sensors"]) == ("WM0", 22)
    part.write_bytes(source.read_bytes()[:1_000_000])
    cut = tmp_path / "cut.mcap"
    result = locatk("import", "libsurvive", part, "-o", cut, "--json")
    less = answer(result, 3)
    assert "the archive is truncated" in result.stderr
    assert 10_000 < less["sweeps"] < told["sweeps"]
    assert len(read_sweeps(Session.open(cut))) == less["sweeps"]
    part.write_bytes(gzip.compress(b"no recording\n"))
    refused(locatk("import", "libsurvive", part, "-o", tmp_path / "none.mcap"),
            tmp_path / "none.mcap", "not a recording of libsurvive")  # fmt: skip
