"""Damaged input of every parser of Lighthouse's light: an error that says so, or a result.

``LOCATK_FUZZ_SECONDS`` is the time of all parsers together. What fails is told with
``LOCATK_FUZZ_START=<seed>:<number>``, with which it is the first thing that is tried.
"""

from __future__ import annotations

import gzip
import importlib.util
import io
import itertools
import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from locatk.cli.info import lighthouse as info_lighthouse
from locatk.core.errors import LocatkError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.demodulation import ootx
from locatk.core.lighthouse.demodulation.pipeline import demodulate_recording
from locatk.core.lighthouse.published.light_decoding import (
    decode_recording,
    decode_windows,
    sample_windows,
)
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.recording import Edges, StationReport
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.formats.artifacts import receiver as receivers
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.descriptions.lighthouse import describe_recording
from locatk.formats.exporters.crazyflie import dumps_config
from locatk.formats.importers.crazyflie import read_config
from locatk.formats.importers.crazyflie_csv import read_crazyflie_csv
from locatk.formats.importers.crazyflie_usd.recording import read_crazyflie_usd
from locatk.formats.importers.dotbot.log import read_dotbot_log
from locatk.formats.importers.imported_session import ImportedSession
from locatk.formats.importers.libsurvive.device import read_stored_calibrations
from locatk.formats.importers.libsurvive.recording import read_libsurvive
from locatk.formats.importers.saleae.recording import read_capture, read_saleae
from locatk.formats.sessions import observations
from locatk.formats.sessions import station_reports as heard
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

SECONDS = float(os.environ.get("LOCATK_FUZZ_SECONDS", "2"))
SEED, FIRST = (int(n) for n in os.environ.get("LOCATK_FUZZ_START", "8:0").split(":"))

HANGS_S = 60
"""Longer than any of the small inputs takes on the busiest machine."""

WHOLE_WAY = 6
"""Of so many inputs one goes all the way into a session and out of it."""

RATE = 40_000_000

# ---- what is damaged: small and as the tools write it


def light(seconds: float = 0.25, channels: Sequence[int] = (1, 2), bits: int = 90) -> list[int]:
    """Samples at which the level changes in the light of stations on a photodiode at rest."""
    found: list[float] = []
    for channel in channels:
        period = float(period_counts(channel))
        for rotation in range(int(seconds * 6e6 / period)):
            for turn in (0.31, 0.66):
                index = int(turn * period) + 40 * channel
                polynomial = 2 * (channel - 1) + (rotation * 7 % 13 < 6)
                state = lfsr.state_at(index + np.arange(bits), np.full(bits, polynomial))
                ones = np.flatnonzero(state >> 16 & 1)
                start = rotation * period + index + 3_000 * channel
                found += (start + np.concatenate([np.arange(bits + 1), ones + 0.5])).tolist()
    return np.unique(np.rint(np.array(found) * (RATE / 6e6))).astype(int).tolist()


LIGHT = light()


def varint(samples: int) -> bytes:
    value = samples - 1
    groups = []
    while value >> (7 * len(groups) + 6):
        groups.append(value >> 7 * len(groups) & 0x7F)
    coded = [value >> 7 * len(groups) | (0x40 if groups else 0)]
    coded += [group | (0x80 if k else 0) for k, group in reversed(list(enumerate(groups)))]
    return bytes(coded)


def captured(edges: Sequence[int], chunk: int = 3_000_000) -> bytes:
    """``digital-N.bin`` of a capture."""
    borders = list(range(0, edges[-1] + chunk + 1, chunk))
    coded = b"<SALEAE>" + struct.pack("<iiBdQdHQ", 1, 100, 1, RATE, 1_710_177_920_662, 0.7, 0,
                                      len(borders) - 1)  # fmt: skip
    for begin, end in itertools.pairwise(borders):
        inside = [edge for edge in edges if begin < edge < end]
        stops = [begin, *inside, end]
        runs = b"".join(varint(b - a) for a, b in itertools.pairwise(stops))
        level = sum(edge <= begin for edge in edges) & 1
        coded += struct.pack("<6Q", begin, end, end - begin, RATE, 1, len(runs)) + runs
        coded += struct.pack("<QQQI", 1, 0, 0, level)
    return coded


META = json.dumps(
    {
        "version": 16,
        "data": {
            "captureStartTime": {
                "unixTimeMilliseconds": 1_710_177_920_662,
                "fractionalMilliseconds": 0.7922,
            },
            "rowsSettings": [
                {"name": "TS4231", "channel": {"type": "Digital", "deviceChannel": 4}},
                {"name": "supply", "channel": {"type": "Analog", "deviceChannel": 0}},
            ],
        },
        "binData": [{"type": "Digital", "deviceChannel": 4, "file": "./digital-4.bin"}],
    }
).encode()


def archive(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return packed.getvalue()


def tables(edges: Sequence[int]) -> list[bytes]:
    """The three kinds of CSV export."""
    ns = [round(edge * 1e9 / RATE) for edge in edges]
    stamps = [str(np.datetime64(1_710_177_920_000_000_000 + each, "ns")) for each in ns]
    seconds = [f"{each / 1e9:.9f}" for each in ns]
    return [
        "\n".join(
            [head, *(f"{text}{comma}{k & 1 ^ 1}{comma}0" for k, text in enumerate(texts)), ""]
        ).encode()
        for head, comma, texts in (
            ("Time[s], Channel 0, Channel 1", ", ", [f"{text}000000" for text in seconds]),
            ("Time [s],Channel 0,Channel 1", ",", seconds),
            ("Time [s],Data,Envelope", ",", [f"{text}Z" for text in stamps]),
        )
    ]


def exports(edges: Sequence[int]) -> list[bytes]:
    """Both versions of the binary export."""
    times = [edge / RATE for edge in edges]
    numbers = struct.pack(f"<{len(times)}d", *times)
    first = struct.pack("<iiIddQ", 0, 0, 0, 0.0, times[-1] + 1e-3, len(times)) + numbers
    second = struct.pack("<iiQIdddQ", 1, 0, 1, 0, RATE, 0.0, times[-1] + 1e-3, len(times)) + numbers
    return [b"<SALEAE>" + first, b"<SALEAE>" + second]


def payload(number: int = 0x4CC60647, channel: int = 1) -> bytes:
    parameters = (0.0, 0.002192, -0.05075, 0.04794)
    rest = (0.09, 0.19, 2, 127, -2, 1.865, 2.307, -0.0057, -0.006, 127 + channel, 0)
    waves = (1.3, 2.0, 0.2, 0.1)
    return struct.pack("<HIeeeeBBeebbbeeeeBBeeeeH", 6, number, *parameters, 0, 9, *rest, *waves, 7)


DEVICE = {
    "device_serial_number": "LHR-1",
    "model_number": "test tracker",
    "head": {"plus_x": [1, 0, 0], "plus_z": [0, 0, -1], "position": [0.0, 0.04, 0.05]},
    "imu": {"plus_x": [0, -1, 0], "plus_z": [0, 0, -1], "position": [0.01, 0.02, 0.06]},
    "lighthouse_config": {
        "modelNormals": [[0, 0, 2], [0, 1, 0], [1, 0, 0]],
        "modelPoints": [[0.0, 0.04, 0.05], [0.1, 0.04, 0.05], [0.0, 0.14, 0.05]],
    },
}


def recording(seconds: float = 0.5) -> bytes:
    """A recording of libsurvive: two stations, a tracker of three photodiodes."""
    bits, lines = ootx.encode_frame(payload()), []
    for channel in (0, 3):
        period = 8 * float(period_counts(channel + 1)) / 48e6
        for n in range(int(seconds / period)):
            at = n * period + 0.001 * channel
            told = [(at, f"Y {channel} {{}} {bits[n % len(bits)]} 0")]
            told += [
                (
                    at + (0.33 * (plane + 1) + 0.001 * sensor) * period,
                    f"W {channel} {sensor} {{}} 0",
                )
                for sensor in range(3)
                for plane in (1, 2)
            ]
            lines += [(t, f"WM0 {text.format(int(4.2e9 + t * 48e6) % 2**32)}") for t, text in told]
    lines.sort()
    head = [
        "0.000100 INFO LOG hello WM0",
        "0.000200 OPTION report-in-imu i 0",
        f"0.000300 WM0 CONFIG {json.dumps(DEVICE)}",
        "0.000400 0 LH_POSE 0.1 2.0 0.3 0.7 0.1 0.1 0.7 1288046151",
    ]
    poses = [f"{0.01 * k:.6f} WM0 POSE {k}.0 0.1 0.2 1.0 0.0 0.0 0.0" for k in range(20)]
    body = [f"{t + 0.002:.6f} {line}" for t, line in lines]
    return ("\r\n".join([*head, *body, *poses]) + "\r\n").encode()


STORED = b"""{"v":"0",
"lighthouse0":{ "index":"0", "id":"1288046151", "mode":"0", "OOTXSet":"1",
"fcalphase":["0.000000","0.002192"], "fcaltilt":["-0.050751","0.047943"],
"fcalcurve":["0.090149","0.189087"], "fcalgibpha":["1.865234","2.306641"],
"fcalgibmag":["-0.005749","-0.006054"], "fcalogeephase":["1.0","2.0"], "fcalogeemag":["0.1","0.2"]
} }"""

LOGS = [
    b"".join(
        b"timestamp=2024-05-31T12:03:%09.6fZ level=info logger=pydotbot event=lh2-processed "
        b"source=f5242ee32b1d3456 poly=%d lfsr_index=%d db_time=%d\n"
        % (8 + 0.02 * k, k % 4, 30000 + 9 * k, (2**32 - 90_000 + 20_000 * k) % 2**32)
        for k in range(20)
    ),
    b"".join(
        b"timestamp=2023-07-24T17:11:%02dZ event=lh2-4 source=r1 sweep_0_poly=0 sweep_0_off=2 "
        b"sweep_0_bits=%d sweep_1_poly=3 sweep_1_off=0 sweep_1_bits=%d\n"
        % (k, 12345678901234567890 + k, 9876543210987654321 + k)
        for k in range(10)
    ),
    b'{"source": "de", "note": "poly=9", "poly": 5, "lfsr_index": 36560, "db_time": 376960, '
    b'"event": "lh2-processed", "timestamp": "2023-07-24T17:11:36.074800Z"}\n' * 4,
    b"2023-07-24 17:11:36 [info] \x1b[1mlh2\x1b[0m x=0.58 \x1b[36mc0\x1b[0m=82189 c1=39797\n" * 4,
]


def crazyflie_logs() -> list[bytes]:
    """Logs of a Crazyflie's micro SD card of both versions, and with the firmware's angles."""
    path = Path(__file__).parents[2] / "crazyflie.py"
    spec = importlib.util.spec_from_file_location("crazyflie_of_the_fuzzer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    flight = module.Flight(2.2)
    ways = ({"version": 1}, {"quaternion": False}, {"frames": False, "angles": True})
    rng = np.random.default_rng(1)
    return [module.write_flight(flight, rng, **way).data() for way in ways]


def crazyflie_tables() -> list[bytes]:
    """Log variables of a Crazyflie as CSV, in columns and in rows."""
    names = ["acc.x", "acc.y", "acc.z", "stateEstimate.x", "stateEstimate.y", "stateEstimate.z"]
    names += [f"stateEstimate.{name}" for name in ("roll", "pitch", "yaw")]
    names += [f"lighthouse.rawAngle0{axis}lh2" for axis in "xy"]
    wide = [",".join(["Timestamp", *names])]
    wide += [",".join([str(10 * k), *(f"{0.1 * j + k}" for j in range(11))]) for k in range(20)]
    rows = ["time_s,name,value"]
    rows += [f"{0.01 * k:.2f},{name},{0.1 * k}" for k in range(20) for name in names]
    return ["\n".join([*lines, ""]).encode() for lines in (wide, rows)]


FACTORY = ootx.decode_factory_data(payload()).calibration
SCENE = Scene(
    stations=(Station(1, np.array([1.0, 2.0, 3.0]), np.eye(3), FACTORY, 0x4CC60647),),
    markers=(Marker("a", np.zeros(3)),),
    scale="markers",
    calibrations={2: FACTORY},
    ids={2: 0xFF22226, 3: 12},
)
HEARD = (
    StationReport(1, 0x4CC60647, 958985.25, 40, 1, FACTORY, 11, 0),
    StationReport(4, None, None, 7, 3, None, 0, 2),
)

# ---- how it is damaged

ODD_NUMBERS = [
    *(b"0", b"-1", b"1", b"16", b"17", b"31", b"32", b"255", b"131070", b"131071", b"4294967295"),
    *(b"4294967296", b"9223372036854775807", b"18446744073709551616", b"-9223372036854775809"),
    *(b"1e308", b"1e309", b"-1e-320", b"nan", b"inf", b"-inf", b"0x10", b"1_0", b"9" * 400),
    *(b"", b"1.5", b".", b"00000000000000000012", b"\xd9\xa3", b"true", b"null", b"[]", b"{}"),
]
"""Texts in the place of numbers."""

ODD_BYTES = [
    *(b"\0" * 8, b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\x01" + b"\0" * 7, b"\0\0\0\x80"),
    *(struct.pack("<d", value) for value in (np.nan, np.inf, -1.0, 1e300, 24e6, 5e-324)),
    *(struct.pack("<Q", 1 << power) for power in (16, 31, 32, 36, 48, 60)),
]
"""Bytes in the place of binary numbers."""

NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def damaged(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """``data`` with some faults; what is spliced in comes from ``others``."""
    text = data.isascii()
    for _ in range(int(rng.geometric(0.6))):
        if not data:
            return data
        at, size = int(rng.integers(len(data))), int(2 ** rng.uniform(0, 12))
        # Text is refused for most other faults long before its numbers are looked at.
        kind = 7 if text and rng.random() < 0.5 else int(rng.integers(8))
        if kind == 0:  # a bit
            data = data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]
        elif kind == 1:  # noise
            data = data[:at] + rng.bytes(min(size, 64)) + data[at + size :]
        elif kind == 2:  # the end is missing
            data = data[:at]
        elif kind == 3:  # a hole
            data = data[:at] + data[at + size :]
        elif kind == 4:  # a part again
            data = data[:at] + data[at : at + size] * int(rng.integers(2, 5)) + data[at + size :]
        elif kind == 5:  # a part of another
            other = others[int(rng.integers(len(others)))]
            start = int(rng.integers(len(other) + 1))
            data = data[:at] + other[start : start + size] + data[at + size :]
        elif kind == 6:  # a binary number, mostly in the head
            at = at if rng.random() < 0.3 else int(rng.integers(min(len(data), 160)))
            odd = ODD_BYTES[int(rng.integers(len(ODD_BYTES)))]
            data = data[:at] + odd + data[at + len(odd) :]
        else:  # a number of a text
            found = list(NUMBER.finditer(data[:100_000]))
            if found:
                old = found[int(rng.integers(len(found)))]
                new = ODD_NUMBERS[int(rng.integers(len(ODD_NUMBERS)))]
                data = data[: old.start()] + new + data[old.end() :]
    return data


# ---- what reads it


def imported(session: ImportedSession, folder: Path) -> None:
    """What was imported is written without complaint, and is read again as it was."""
    try:
        written(session, folder / "run.mcap")
    except LocatkError as error:
        raise AssertionError("what was imported cannot be written or read again") from error


def written(session: ImportedSession, path: Path) -> None:
    observations.write_session(
        path,
        system="lighthouse",
        sweeps=session.sweeps,
        scene=session.scene,
        truth=session.truth,
        facts=session.facts,
        stations=session.stations,
        receivers=session.receivers,
        imu=session.imu,
        onboard=session.onboard,
        overwrite=True,
    )
    for text in (*session.warnings, session.lost or "", *session.facts.values()):
        assert "\n" not in text
    again = Session.open(path)
    if len(session.sweeps):
        sweeps = observations.read_sweeps(again)
        assert sorted(sweeps.count.tolist()) == sorted(session.sweeps.count.tolist())
    assert sum(map(len, observations.read_imu(again))) == sum(map(len, session.imu))
    assert sum(map(len, observations.read_onboard(again))) == sum(map(len, session.onboard))
    assert len(observations.read_station_reports(again)) == len(session.stations)
    assert observations.read_receivers(again).keys() == session.receivers.keys()
    observations.read_scene(again)
    assert len(observations.read_truth(again)) == len(session.truth)


Attempt = Callable[[np.random.Generator, Path, bool], None]
"""Damages something by the generator and reads it from the folder, perhaps on to a session."""


def of_files(name: str, whole: Sequence[bytes], read: Callable[[Path, bool], Any]) -> Attempt:
    """Files damaged as bytes."""

    def attempt(rng: np.random.Generator, folder: Path, further: bool) -> None:
        path = folder / name
        path.write_bytes(damaged(whole[int(rng.integers(len(whole)))], whole, rng))
        read(path, further)

    return attempt


def importer(read: Callable[[Path], ImportedSession]) -> Callable[[Path, bool], None]:
    def run(path: Path, further: bool) -> None:
        session = read(path)
        if further:
            imported(session, path.parent)

    return run


def saleae(path: Path, further: bool) -> None:
    if further:
        imported(read_saleae([path]), path.parent)
    else:
        capture = read_capture(path)
        assert capture.facts()
        for edges in capture.edges:
            assert np.all(np.diff(edges.tick) > 0)


def members(rng: np.random.Generator, folder: Path, further: bool) -> None:
    """What is in a capture is damaged, its archive is whole."""
    content = {"digital-4.bin": captured(SHORT), "meta.json": META}
    name = ("digital-4.bin", "meta.json")[int(rng.random() < 0.3)]
    content[name] = damaged(content[name], list(content.values()), rng)
    (folder / "run.sal").write_bytes(archive(content, zipfile.ZIP_STORED))
    saleae(folder / "run.sal", further)


def packed_text(rng: np.random.Generator, folder: Path, further: bool) -> None:
    """A recording that was damaged before it was packed."""
    text = gzip.compress(damaged(recording(), [STORED, *LOGS], rng), 1)
    (folder / "run.rec.gz").write_bytes(text)
    importer(lambda path: read_libsurvive([path], stations=True))(folder / "run.rec.gz", further)


def records(rng: np.random.Generator, folder: Path, further: bool) -> None:
    """Metadata and attachments of a session, damaged before it was written."""
    texts = [artifacts.dumps_scene(SCENE).encode(), receivers.dumps_receiver(DECK).encode()]
    scene, receiver = (damaged(text, texts, rng) if rng.random() < 0.3 else text for text in texts)
    names = [f"station-{channel}" for channel in (1, 4)]
    whole = [heard.station_record(station) for station in HEARD]
    entries = [text.encode() for record in whole for text in record.values()]
    path = folder / "run.mcap"
    with SessionWriter(path, system="lighthouse", overwrite=True) as writer:
        writer.attach("scene.toml", scene, "application/toml")
        writer.attach("receiver.toml", receiver, "application/toml")
        for name, record in zip(names, whole, strict=True):
            for key, value in record.items():
                if rng.random() < 0.3:
                    record[key] = damaged(value.encode(), entries, rng).decode("utf-8", "replace")
            if rng.random() < 0.2:
                name = damaged(name.encode(), entries, rng).decode("utf-8", "replace")
            writer.metadata(name, record)
    if further:
        path.write_bytes(damaged(path.read_bytes(), entries, rng))
    session = Session.open(path, damaged_ok=True)
    info_lighthouse.station_table(describe_recording(session)["stations"])
    observations.read_station_reports(session)
    observations.read_receivers(session)


def slow_bits(rng: np.random.Generator, folder: Path, further: bool) -> None:
    """Slow bits of a station, and frames whose checksum is right."""
    content = bytearray(payload())
    if further:
        for place in rng.integers(0, len(content), 3):
            content[place] = int(rng.integers(256))
    one = ootx.encode_frame(bytes(content))
    bits = np.tile(one, 3)[int(rng.integers(len(one))) :][: int(rng.integers(1400))]
    wrong = rng.random(len(bits)) < 10 ** rng.uniform(-4, -1)
    bits = np.where(wrong, rng.integers(-1, 2, len(bits)), bits).astype(np.int8)
    if rng.random() < 0.3 and len(bits):
        at = int(rng.integers(len(bits)))
        bits = np.concatenate([bits[:at], bits[at : at + 40], bits[at:]])
    for frame in ootx.decode_frames(bits):
        if frame.is_valid:
            # Of a frame with a right checksum nothing else may come than was sent.
            assert frame.payload == content
            ootx.decode_factory_data(frame.payload)
    ootx.decode_factory_data(
        rng.bytes(int(rng.integers(40, 46))) if rng.random() < 0.1 else content
    )


def windows(rng: np.random.Generator, folder: Path, further: bool) -> None:
    """Windows of 64 bytes as the paper's receiver samples them."""
    starts = np.array(LIGHT)[np.flatnonzero(np.diff(LIGHT, prepend=-99_999) > 2000)]
    found = sample_windows(edges_of(np.array(LIGHT)), starts[:40])
    data = damaged(found.tobytes(), [rng.bytes(64), bytes(64), b"\xff" * 64], rng)
    data = data[: len(data) // 64 * 64]
    decodes = decode_windows(np.frombuffer(data, np.uint8).reshape(-1, 64))
    assert len(decodes.index) == len(data) // 64


def edges_of(tick: np.ndarray, rate: float = RATE, first: bool = True) -> Edges:
    end = int(tick[-1]) + 1 if len(tick) else 1
    return Edges(tick.astype(np.int64), rate, rate, first, end)


def edges(rng: np.random.Generator, folder: Path, further: bool) -> None:
    """Edges that came, did not come, came twice, at another rate, moved, or of nothing."""
    tick, rate = np.array(LIGHT), float(RATE)
    for _ in range(int(rng.integers(1, 4))):
        if len(tick) < 2:
            break
        at, size = int(rng.integers(len(tick))), int(2 ** rng.uniform(0, 12))
        kind = int(rng.integers(8))
        if kind == 0:
            tick = np.delete(tick, np.flatnonzero(rng.random(len(tick)) < 10 ** rng.uniform(-4, 0)))
        elif kind == 1:
            more = rng.integers(tick[0], tick[-1] + 1, int(10 ** rng.uniform(0, 4)))
            tick = np.concatenate([tick, more])
        elif kind == 2:
            tick = tick[at : at + size]
        elif kind == 3:
            tick = np.concatenate([tick[:at], tick[at:] + int(10 ** rng.uniform(0, 14))])
        elif kind == 4:
            tick = tick + rng.integers(-3, 4, len(tick))
        elif kind == 5:
            tick = tick[0] + np.round((tick - tick[0]) * rng.uniform(0.2, 3.0)).astype(np.int64)
        elif kind == 6:
            rate = float(rng.choice([1.0, 12e6, 24e6, 25e6, 1e9, 1e11]))
        else:
            tick = np.concatenate([tick, tick + int(rng.integers(1, 300_000))])
        tick = np.unique(tick)
    lines = [edges_of(tick, rate, bool(rng.random() < 0.5))]
    if rng.random() < 0.3:
        lines.append(edges_of(tick[: int(rng.integers(len(tick) + 1))], rate))
    if further:
        decode_recording(lines)
        return
    sweeps = demodulate_recording(lines).sweeps
    assert np.all(np.isfinite(sweeps.tick))
    assert np.all(np.isfinite(sweeps.count))
    assert np.all(np.diff(sweeps.tick) >= 0)


SHORT = light(0.1)
FILES: dict[str, tuple[str, Sequence[bytes], Callable[[Path, bool], Any]]] = {
    "capture": (
        "run.sal",
        [archive({"digital-4.bin": captured(SHORT), "meta.json": META}, how) for how in (0, 8)],
        saleae,
    ),
    "csv": ("run.csv", tables(SHORT), saleae),
    "export": ("digital_4.bin", [*exports(SHORT), captured(SHORT)], saleae),
    "libsurvive": (
        "run.rec",
        [recording(), gzip.compress(recording(), 1)],
        importer(lambda path: read_libsurvive([path], stations=True)),
    ),
    "libsurvive-stored": ("run.json", [STORED], lambda path, _: read_stored_calibrations(path)),
    "dotbot-log": ("pydotbot.log", LOGS, importer(lambda path: read_dotbot_log([path]))),
    "crazyflie-usd": (
        "log00",
        crazyflie_logs(),
        importer(lambda path: read_crazyflie_usd([path])),
    ),
    "crazyflie-csv": (
        "log.csv",
        crazyflie_tables(),
        importer(lambda path: read_crazyflie_csv([path])),
    ),
    "crazyflie": (
        "config.yaml",
        [dumps_config(SCENE).encode()],
        lambda path, _: artifacts.loads_scene(artifacts.dumps_scene(read_config(path))),
    ),
    "scene": (
        "scene.toml",
        [artifacts.dumps_scene(SCENE).encode()],
        lambda path, _: artifacts.loads_scene(artifacts.dumps_scene(artifacts.read_scene(path))),
    ),
    "receiver": (
        "receiver.toml",
        [receivers.dumps_receiver(DECK).encode()],
        lambda path, _: receivers.loads_receiver(
            receivers.dumps_receiver(receivers.read_receiver(path))
        ),
    ),
}
"""Name of the file, contents as they should be, and what reads it."""

PARSERS: dict[str, Attempt] = {
    **{name: of_files(*each) for name, each in FILES.items()},
    "members": members,
    "text of a recording": packed_text,
    "records": records,
    "slow bits": slow_bits,
    "windows": windows,
    "edges": edges,
}


class Hangs(Exception):
    """Raised where an input takes far too long."""


def stop(number: int, frame: FrameType | None) -> None:
    raise Hangs(f"not read in {HANGS_S} s")


@pytest.mark.parametrize("name", FILES)
def test_what_is_damaged_here_was_whole(name: str, tmp_path: Path) -> None:
    file, contents, read = FILES[name]
    for content in contents:
        (tmp_path / file).write_bytes(content)
        read(tmp_path / file, True)


def is_refused(attempt: Attempt, rng: np.random.Generator, folder: Path, further: bool) -> bool:
    """Whether it is an error of ours, of one line."""
    try:
        attempt(rng, folder, further)
    except LocatkError as error:
        text = str(error)
    else:
        return False
    assert "\n" not in text
    return True


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_damaged_input_is_an_error_of_ours_or_is_read(name: str, tmp_path: Path) -> None:
    attempt, number = PARSERS[name], FIRST
    until = time.monotonic() + SECONDS / len(PARSERS)
    refused = 0
    before = signal.signal(signal.SIGALRM, stop)
    try:
        while time.monotonic() < until or number < FIRST + 10:
            rng = np.random.default_rng([SEED, zlib.crc32(name.encode()), number])
            signal.alarm(HANGS_S)
            try:
                refused += is_refused(attempt, rng, tmp_path, number % WHOLE_WAY == 0)
            except BaseException as error:
                error.add_note(f"{name}: try it again with LOCATK_FUZZ_START={SEED}:{number}")
                raise
            number += 1
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    print(f"{name}: {number - FIRST} inputs, {refused} refused")


# ---- memory

ROOM_BYTES = 600 << 20
"""What a reader of a small hostile file may take beside the program itself."""

GUARDED = """
import resource, sys
from pathlib import Path
from locatk.core.errors import LocatkError
from locatk.formats.artifacts.receiver import read_receiver
from locatk.formats.artifacts.scene import read_scene
from locatk.formats.importers.crazyflie import read_config
from locatk.formats.importers.dotbot.log import read_dotbot_log
from locatk.formats.importers.libsurvive.recording import read_libsurvive
from locatk.formats.importers.saleae.recording import read_saleae
readers = {
    "sal": lambda path: read_saleae([path]), "csv": lambda path: read_saleae([path]),
    "bin": lambda path: read_saleae([path]), "gz": lambda path: read_libsurvive([path]),
    "log": lambda path: read_dotbot_log([path]), "yaml": read_config,
    "scene": read_scene, "receiver": read_receiver,
}
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        readers[path.suffix[1:]](path)
    except LocatkError as error:
        print(path.name, "refused")
    else:
        print(path.name, "read")
"""


def squeezed(head: bytes, piece: bytes, mebibytes: int) -> bytes:
    """gzip of a piece again and again."""
    pack = zlib.compressobj(1, wbits=31)
    block = piece * ((1 << 20) // len(piece))
    return b"".join(
        [pack.compress(head), *(pack.compress(block) for _ in range(mebibytes)), pack.flush()]
    )


def long_chunks(mebibytes: int) -> bytes:
    """A channel of a capture that is nothing but edges."""
    size = 1 << 20
    head = struct.pack("<iiBdQdHQ", 1, 100, 1, RATE, 0, 0.0, 0, mebibytes)
    chunks = (
        struct.pack("<6Q", k * size, (k + 1) * size, size, RATE, 1, size) + bytes(size + 8)
        for k in range(mebibytes)
    )
    return b"".join([b"<SALEAE>", head, *chunks])


def bombs() -> dict[str, bytes]:
    """Small files that tell of much, by their names."""
    claims = struct.pack("<iiIddQ", 0, 0, 0, 0.0, 1.0, 1 << 60)
    deep = b"[" * 200_000
    return {
        "edges.sal": archive({"digital-4.bin": long_chunks(24)}),
        "claims.bin": b"<SALEAE>" + claims + bytes(800),
        "wide.csv": b"Time [s]," + b"A," * 400_000 + b"A\n0.1,0\n",
        "line.csv": b"Time [s],A\n" + b"0" * (32 << 20),
        "sweeps.gz": squeezed(recording(), b"1.1 WM0 W 1 1 1 0\n", 128),
        "names.gz": squeezed(b"", b"".join(b"1 n%d POSE 1 1 1 1 1 1 1\n" % k for k in range(9000)),
                             1),
        "line.gz": squeezed(b"0.1 OPTION v i 100\n", b"x", 128),
        "line.log": LOGS[0] + b"poly=1 lfsr_index=" + b"9" * (32 << 20),
        "deep.log": b'{"lfsr_index": ' + deep + b"\n",
        "deep.yaml": b"geos: " + deep,
        "twice.yaml": b"a: &a [x, x]\n" + b"".join(
            b"b%d: &b%d [*%s, *%s]\n" % (k, k, name, name)
            for k in range(60) for name in [b"b%d" % (k - 1) if k else b"a"]),
        "deep.scene": b"format = " + deep,
        "many.receiver": b"position_mm = [" + b"[0, 0, 0]," * 50_000 + b"]",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux tells its memory there")
def test_small_files_take_little_memory(tmp_path: Path) -> None:
    made = bombs()
    for name, content in made.items():
        (tmp_path / name).write_bytes(content)
    command = [sys.executable, "-c", GUARDED, str(tmp_path), str(ROOM_BYTES)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=len(made) * HANGS_S)
    assert ran.returncode == 0, ran.stderr
    said = dict(line.split() for line in ran.stdout.splitlines())
    # Of the log the other lines are whole.
    assert said == {name: "read" if name == "line.log" else "refused" for name in made}
