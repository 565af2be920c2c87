"""The DotBot gateway's payloads, against published values and against what can come."""

from __future__ import annotations

import struct
from collections import defaultdict
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.recording import Sweeps
from locatk.formats.devices.dotbot_gateway import (
    MAX_WINDOWS,
    OLD_READINGS,
    READINGS,
    SWEEPS,
    TIMED_SWEEPS,
    GatewayDecoder,
    encode,
    encode_hdlc,
    robot_address,
)
from locatk.formats.devices.interface import Batch, Options, Recording
from locatk.formats.importers.dotbot.recording import read_dotbot

ROBOT = 0x5037BA3E25BBDA90
NODE = "5037ba3e25bbda90"

WINDOWS = (
    (0b1110000100011111111001110010111000000100001001100011001010001110, 1, 3),
    (0b1011101111101010101101010010101010100100111101101001000111011100, 1, 1),
)
"""Bits, polynomial and offset, of PyDotBot's ``test_lighthouse2.py``."""

COUNTS = (49341 - 3, 85887 - 1)
"""It finds these after the offset; the first bits come that much earlier."""


def old(kind: int, content: bytes, version: int = 8, source: int = ROBOT) -> bytes:
    return struct.pack("<QQHBBIB", 0, source, 0x2442, 0, version, 123, kind) + content


def new(kind: int, content: bytes, source: int = ROBOT) -> bytes:
    return struct.pack("<BBQQB", 1, 16, 0, source, kind) + content


def mari(kind: int, content: bytes, source: int = ROBOT) -> bytes:
    return struct.pack("<BBBHQQBB", 3, 3, 16, 0xD0B0, 0, source, 0x11, kind) + content


def windows(*given: tuple[int, int, int]) -> bytes:
    return b"".join(struct.pack("<QBb", *window) for window in given)


ADVERTISEMENT = struct.pack("<BhIIHbbBiiIIB", 3, -90, 1234, 567, 2950, 1, -1, 0, 5, 6, 7, 8, 9)
PROCESSED = struct.pack("<BII", 5, 71_000, 0xFFFFFFF0)


def decode(*payloads: bytes) -> tuple[dict[str, Batch], GatewayDecoder]:
    """Batches of one feed by kind, of payloads that are framed for it."""
    decoder = GatewayDecoder(Options())
    batches = decoder.feed(b"".join(map(encode_hdlc, payloads))) + decoder.finish()
    found = {batch.stream.kind: batch for batch in batches}
    assert len(found) == len(batches)
    return found, decoder


def columns(batch: Batch) -> dict[str, Any]:
    return {name: column.tolist() for name, column in batch.columns.items()}


@pytest.mark.parametrize(
    "payload",
    [
        old(2, windows(*WINDOWS)),
        old(2, windows(*WINDOWS), version=9),
        new(13, b"\x02" + windows(*WINDOWS)),
        mari(13, b"\x02" + windows(*WINDOWS)),
        old(6, struct.pack("<h", 45) + windows(*WINDOWS)),
    ],
)
def test_windows_of_bits(payload: bytes) -> None:
    found, decoder = decode(payload)
    captures, sweeps = found["captures"], found["lighthouse"]
    assert captures.stream.node == sweeps.stream.node == NODE
    assert columns(captures) == {
        "sensor": [0, 0],
        "bits": [bits for bits, _, _ in WINDOWS],
        "polynomial": [1, 1],
        "bit_offset": [3, 1],
    }
    assert captures.columns["bits"].dtype == np.uint64
    assert columns(sweeps) == {
        "sensor": [0, 0],
        "channel": [1, 1],
        "polynomial": [1, 1],
        "sweep": [-1, -1],
        "count": [float(count) for count in COUNTS],
    }
    assert sweeps.tick is None
    assert sweeps.stream.ticks is None
    assert sweeps.end.tolist() == [len(encode_hdlc(payload))] * 2
    assert (decoder.counts.frames, decoder.counts.unknown) == (1, 0)


@pytest.mark.parametrize("header", [new, mari])
def test_one_window(header: Any) -> None:
    found, _ = decode(header(2, windows(WINDOWS[1])))
    assert columns(found["lighthouse"])["count"] == [COUNTS[1]]
    assert columns(found["captures"])["bit_offset"] == [1]


@pytest.mark.parametrize("header", [new, mari])
@pytest.mark.parametrize("n", [1, 3, MAX_WINDOWS])
def test_any_number_of_windows(header: Any, n: int) -> None:
    count = np.arange(n) * 7001
    bits = lfsr.bits_at(count, 9).tolist()
    given = [(b, 9, k % 9) for k, b in enumerate(bits)]
    found, _ = decode(header(13, bytes([n]) + windows(*given)))
    assert columns(found["lighthouse"])["count"] == count.tolist()
    assert set(columns(found["lighthouse"])["channel"]) == {5}


@given(
    st.integers(0, lfsr.SEQUENCE_LENGTH - 1),
    st.integers(0, 31),
    st.integers(0, 47),
    st.integers(0, 2**64),
)
def test_count_is_that_of_the_first_bit(
    count: int, polynomial: int, offset: int, noise: int
) -> None:
    # Bits that are not trusted may say anything.
    trusted = (1 << 64 - offset) - 1
    bits = int(lfsr.bits_at(count, polynomial)) & trusted | noise % 2**64 & ~trusted
    found, _ = decode(old(2, windows((bits, polynomial, offset), (0, 255, 0))))
    assert columns(found["lighthouse"])["count"] == [count]
    assert columns(found["captures"])["polynomial"] == [polynomial, -1]


@pytest.mark.parametrize(
    "window", [(0, 3, 0), (1, 3, 0), (WINDOWS[0][0], 32, 3), (WINDOWS[0][0], 1, -1), (3, 1, 48)]
)
def test_window_without_a_place(window: tuple[int, int, int]) -> None:
    found, decoder = decode(new(2, windows(window)))
    assert set(found) == {"captures"}
    assert columns(found["captures"])["bits"] == [window[0]]
    assert columns(found["captures"])["bit_offset"] == [window[2]]
    assert (decoder.counts.frames, decoder.counts.unknown) == (1, 0)


@pytest.mark.parametrize(
    "payload",
    [
        old(12, PROCESSED, version=9),
        old(11, PROCESSED, version=9),
        new(12, PROCESSED),
        mari(12, PROCESSED),
    ],
)
def test_processed_data(payload: bytes) -> None:
    found, _ = decode(payload)
    sweeps = found["lighthouse"]
    assert sweeps.stream.node == NODE
    assert sweeps.stream.ticks == TIMED_SWEEPS.ticks
    assert columns(sweeps) == {
        "sensor": [0],
        "channel": [3],
        "polynomial": [5],
        "sweep": [-1],
        "count": [71_000.0],
    }
    assert sweeps.tick is not None
    assert sweeps.tick.tolist() == [0xFFFFFFF0]


@pytest.mark.parametrize(
    "marked", [(255, 1000, 0), (5, 0xFFFFFFFF, 0), (5, lfsr.SEQUENCE_LENGTH, 0)]
)
def test_processed_data_that_a_robot_marks_as_wrong(marked: tuple[int, int, int]) -> None:
    found, decoder = decode(new(12, struct.pack("<BII", *marked)))
    assert found == {}
    assert (decoder.counts.frames, decoder.counts.unknown) == (1, 0)


def test_robot_data_has_a_direction() -> None:
    payloads = [old(6, struct.pack("<h", value) + windows(*WINDOWS)) for value in (45, -180, -1000)]
    readings = decode(*payloads)[0]["readings"]
    assert readings.stream.names == OLD_READINGS.names
    np.testing.assert_array_equal(
        readings.columns["value"],
        [[45, *[np.nan] * 3], [-180, *[np.nan] * 3], [np.nan] * 4],
    )


def test_location_of_old() -> None:
    readings = decode(old(3, struct.pack("<III", 500_000, 250_000, 0)))[0]["readings"]
    assert readings.stream.names == OLD_READINGS.names
    np.testing.assert_allclose(readings.columns["value"], [[np.nan, 0.5, 0.25, 0]])


@pytest.mark.parametrize("header", [new, mari])
def test_advertisement(header: Any) -> None:
    nowhere = struct.pack("<BhIIH", 0, -1000, 2**32 - 1, 2**32 - 1, 0) + bytes(20)
    payloads = [
        header(6, content) for content in (ADVERTISEMENT, nowhere, ADVERTISEMENT + bytes(8))
    ]
    readings = decode(*payloads)[0]["readings"]
    assert readings.stream.names == READINGS.names
    told = [-90, 1.234, 0.567, 2.95]
    expected = [told, [np.nan, np.nan, np.nan, 0], told]
    np.testing.assert_allclose(readings.columns["value"], expected)


def test_calibration_firmware() -> None:
    found, decoder = decode(struct.pack("<BII", 1, 49341, 85887), struct.pack("<BII", 16, 1, 2))
    sweeps = found["lighthouse"]
    assert sweeps.stream == SWEEPS
    assert columns(sweeps) == {
        "sensor": [0, 0],
        "channel": [2, 2],
        "polynomial": [-1, -1],
        "sweep": [-1, -1],
        "count": [49341.0, 85887.0],
    }
    assert (decoder.counts.frames, decoder.counts.unknown) == (2, 1)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x05" + bytes(43),  # the gateway tells of itself
        b"\x01" + struct.pack("<Q", ROBOT),  # a robot joins: no counts of a station
        old(4, b""),
        old(2, windows(*WINDOWS), version=7),
        old(2, windows(WINDOWS[0])),
        new(13, b"\x03" + windows(*WINDOWS)),
        new(14, bytes(37)),
        mari(12, PROCESSED)[1:],
        b"\x04" + mari(12, PROCESSED)[1:],
        new(12, PROCESSED) + b"\x00",
    ],
)
def test_what_is_not_known_is_counted(payload: bytes) -> None:
    found, decoder = decode(payload)
    assert found == {}
    assert (decoder.counts.frames, decoder.counts.unknown, decoder.counts.bad) == (1, 1, 0)


@given(st.lists(st.binary(max_size=70), max_size=5))
@settings(deadline=None)
def test_any_payload_is_taken(payloads: list[bytes]) -> None:
    decoder = GatewayDecoder(Options())
    decoder.feed(b"".join(map(encode_hdlc, payloads)))
    assert decoder.counts.frames == len(payloads)


def mixed() -> bytes:
    """Frames of all generations and of several robots, in one stream."""
    kinds = []
    for k in range(12):
        bits = lfsr.bits_at(1000 * k + np.arange(2), 2).tolist()
        pair = windows(*((b, 2, 0) for b in bits))
        kinds += [
            old(2, pair, source=k % 3),
            new(12, struct.pack("<BII", 7, 100 + k, 5 * k), source=10),
            mari(12, struct.pack("<BII", 7, 200 + k, 5 * k), source=10),
            old(6, struct.pack("<h", k) + pair, source=k % 2),
            old(4, b""),
            new(6, ADVERTISEMENT, source=10),
            struct.pack("<BII", 0, k, 2 * k),
        ]
    return b"}x" + b"".join(map(encode_hdlc, kinds))


MIXED = mixed()


def flattened(batches: list[Batch]) -> dict[Any, list[Any]]:
    """Records of each stream as rows."""
    found: dict[Any, list[Any]] = defaultdict(list)
    for batch in batches:
        assert len(batch)
        tick = [None] * len(batch) if batch.tick is None else batch.tick.tolist()
        values = [batch.columns[name].tolist() for name in sorted(batch.columns)]
        found[batch.stream] += map(repr, zip(batch.end.tolist(), tick, *values, strict=True))
    return dict(found)


@pytest.mark.slow
@given(st.lists(st.integers(0, len(MIXED)), max_size=30))
@settings(deadline=None)
def test_pieces_do_not_matter(cuts: list[int]) -> None:
    whole, cut = GatewayDecoder(Options()), GatewayDecoder(Options())
    expected = flattened(whole.feed(MIXED))
    pieces = [MIXED[a:b] for a, b in pairwise([0, *sorted(cuts), len(MIXED)])]
    assert flattened([batch for piece in pieces for batch in cut.feed(piece)]) == expected
    assert cut.counts == whole.counts
    assert cut.counts.unknown == 12


def test_robots_are_kept_apart_and_in_order() -> None:
    found = flattened(GatewayDecoder(Options()).feed(MIXED))
    nodes = {(stream.kind, stream.node) for stream in found}
    names = [f"{k:016x}" for k in (0, 1, 2, 10)]
    assert nodes == {
        *(("captures", name) for name in names[:3]),
        *(("lighthouse", name) for name in [*names, ""]),
        *(("readings", name) for name in [*names[:2], names[3]]),
    }
    for stream, batch in ((b.stream, b) for b in GatewayDecoder(Options()).feed(MIXED)):
        assert np.all(np.diff(batch.end) >= 0)
        if stream.node == names[3] and stream.kind == "lighthouse":
            # Two generations of one robot, in turn.
            assert batch.columns["count"].tolist() == [
                base + k for k in range(12) for base in (100, 200)
            ]


@cache
def clean_rows() -> dict[Any, set[Any]]:
    batches = GatewayDecoder(Options()).feed(MIXED)
    return {stream: set(rows) for stream, rows in flattened(batches).items()}


@given(st.lists(st.tuples(st.integers(0, len(MIXED) - 1), st.integers(0, 7)), max_size=3))
@settings(max_examples=30, deadline=None)
def test_flipped_bits_make_no_wrong_record(flips: list[tuple[int, int]]) -> None:
    data = bytearray(MIXED)
    for place, bit in flips:
        data[place] ^= 1 << bit
    got = flattened(GatewayDecoder(Options()).feed(bytes(data)))
    for stream, rows in got.items():
        assert set(rows) <= clean_rows()[stream]


def test_nothing_but_noise() -> None:
    rng = np.random.default_rng(4)
    decoder = GatewayDecoder(Options())
    for _ in range(30):
        assert decoder.feed(rng.bytes(20_000)) == []
    assert decoder.feed(b"\x55" * 2_000_000) == []
    assert decoder.counts.bad == 0
    assert flattened(decoder.feed(b"~" + MIXED)) != {}


def test_connection_lost_and_there_again() -> None:
    decoder = GatewayDecoder(Options())
    frame = encode_hdlc(new(12, PROCESSED))
    assert len(decoder.feed(frame + frame[:9])) == 1
    assert decoder.restart() == []
    (batch,) = decoder.feed(frame[9:] + frame)
    assert batch.end.tolist() == [3 * len(frame)]
    assert (decoder.counts.frames, decoder.counts.bad, decoder.counts.lost) == (2, 0, 0)


def back(sweeps: Sweeps) -> dict[str, Batch]:
    decoder = GatewayDecoder(Options())
    data = b"".join(sent for _, sent in encode(Recording(sweeps=sweeps)))
    batches = decoder.feed(data)
    assert (decoder.counts.bad, decoder.counts.unknown, decoder.counts.skipped) == (0, 0, 0)
    return {batch.stream.node: batch for batch in batches}


@pytest.mark.slow
@pytest.mark.parametrize(
    "recording",
    ["twoLH-2D_scene/dataset/lighthouse/data.csv", "twoLH-3D_scene/dataset/data_all.csv"],
)
def test_published_recording(data: Path, recording: str) -> None:
    sweeps = read_dotbot([data / "lighthouse" / recording]).sweeps
    found = back(sweeps)
    assert set(found) == {f"{robot_address(name):016x}" for name in sweeps.devices}
    for k, name in enumerate(sweeps.devices):
        mine, batch = sweeps.device == k, found[f"{robot_address(name):016x}"]
        assert np.array_equal(batch.columns["count"], sweeps.count[mine])
        assert np.array_equal(batch.columns["channel"], sweeps.channel[mine])
        assert batch.tick is not None
        assert np.array_equal(batch.tick, sweeps.time_ns[mine] // 1000 % 2**32)


def test_addresses_come_of_names() -> None:
    assert robot_address(NODE) == robot_address(NODE.upper()) == ROBOT
    assert robot_address("robot") == 0x42AEE783ABE8D4A6
    names = ["robot", "Robot", "r", "", "0", NODE[:-1]]
    assert len({robot_address(name) for name in names}) == len(names)


def test_encoded_frames_bear_their_time() -> None:
    count = np.array([100.4, 200.0, 300.0, 400.0, np.nan, -1.0])
    n = len(count)
    sweeps = Sweeps(
        ("a", NODE),
        np.array([5_000, 2_000, 2_000, 9_000, 9_000, 9_000]),
        np.array([0, 1, 0, 1, 0, 0], np.int32),
        np.array([0, 0, 0, 1, 0, 0], np.int32),
        np.full(n, 4, np.int32),
        np.array([-1, 7, 6, 6, 6, 6], np.int32),
        np.full(n, -1, np.int32),
        count,
    )
    sent = list(encode(Recording(sweeps=sweeps)))
    assert [time for time, _ in sent] == [2_000, 5_000]
    found = back(sweeps)
    assert columns(found[NODE])["polynomial"] == [7]
    assert columns(found[f"{robot_address('a'):016x}"])["count"] == [300, 100]
    assert columns(found[f"{robot_address('a'):016x}"])["polynomial"] == [6, 6]


def test_nothing_that_a_robot_could_see() -> None:
    with pytest.raises(InputError, match="no sweeps") as error:
        encode(Recording())
    assert error.value.hint
