"""Damaged input of every parser of Lighthouse's light: an error that says so, or a result.

``LOCATK_FUZZ_SECONDS`` is the time of all parsers together. What fails is told with
``LOCATK_FUZZ_START=<seed>:<number>``, with which it is the first thing that is tried.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import resource
import signal
import struct
import subprocess
import sys
import time
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import LocatkError
from locatk.core.lighthouse import lfsr, ootx, paper_light, paper_receive
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.light import Edges
from locatk.core.lighthouse.receive import receive
from locatk.formats import artifacts, crazyflie, observations, receivers
from locatk.formats.importers.dotbot_log import read_dotbot_log
from locatk.formats.importers.libsurvive import read_libsurvive
from locatk.formats.importers.libsurvive_device import read_stored
from locatk.formats.importers.saleae import read_capture
from locatk.formats.importers.saleae_session import read_saleae
from locatk.formats.importers.sweeps import ImportedSession
from locatk.formats.session import Session
from locatk.formats.session_writer import SessionWriter

SECONDS = float(os.environ.get("LOCATK_FUZZ_SECONDS", "8"))
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
    for begin, end in zip(borders[:-1], borders[1:], strict=True):
        inside = [edge for edge in edges if begin < edge < end]
        stops = [begin, *inside, end]
        runs = b"".join(varint(b - a) for a, b in zip(stops[:-1], stops[1:], strict=True))
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
    bits, lines = ootx.encode(payload()), []
    for channel in (0, 3):
        period = 8 * float(period_counts(channel + 1)) / 48e6
        for n in range(int(seconds / period)):
            at = n * period + 0.001 * channel
            told = [(at, f"Y {channel} {{}} {bits[n % len(bits)]} 0")]
            told += [
                (at + (0.33 * (plane + 1) + 0.001 * sensor) * period, f"W {channel} {sensor} {{}} 0")
                for sensor in range(3)
                for plane in (0, 1)
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

SCENE = artifacts.dumps_scene(
    replace(
        crazyflie.loads_config(
            crazyflie.dumps_config(
                artifacts.Scene(
                    (
                        artifacts.Station(
                            1,
                            np.array([1.0, 2.0, 3.0]),
                            np.eye(3),
                            ootx.factory_data(payload()).calibration,
                            0x4CC60647,
                        ),
                    ),
                    calibrations={2: ootx.factory_data(payload()).calibration},
                    ids={2: 0xFF22226},
                    scale="markers",
                )
            )
        ),
        markers=(artifacts.Marker("a", np.zeros(3)),),
        ids={3: 12, 2: 0xFF22226},
    )
)
CONFIG = crazyflie.dumps_config(artifacts.SCENE_FILE and artifacts_scene) if False else ""
