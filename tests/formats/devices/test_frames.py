"""Frames of the locatk protocol, from bytes to records."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Batch, Options, Stream, Ticks
from locatk.formats.devices.locatk_frames import payloads
from locatk.formats.devices.locatk_frames.decoder import PIECE_BYTES, FrameDecoder
from locatk.formats.devices.locatk_frames.framing import MAX_WIRE_BYTES
from locatk.formats.devices.locatk_frames.payloads import FrameWriter, Type

MHZ = Ticks(1_000_000, 32)
HALLS = payloads.series([[1.0, 2.0]], 0)
SWEEP: dict[str, Any] = {
    "tick": [5],
    "sensor": [1],
    "channel": [16],
    "polynomial": [31],
    "sweep": [1],
    "count": [1234.5],
}
CAPTURE: dict[str, Any] = {
    "tick": [5],
    "sensor": [1],
    "polynomial": [31],
    "bit_offset": [-3],
    "bits": [1 << 63 | 1],
}


def listed(batches: list[Batch]) -> dict[Stream, list[tuple[Any, ...]]]:
    """Records of each stream, comparable."""
    found: dict[Stream, list[tuple[Any, ...]]] = {}
    for batch in batches:
        assert batch.tick is not None
        assert batch.sequence is not None
        assert len(batch.end) == len(batch.tick) == len(batch.sequence) > 0
        for n in range(len(batch)):
            values = {name: repr(column[n]) for name, column in sorted(batch.columns.items())}
            stamps = int(batch.end[n]), int(batch.tick[n]), int(batch.sequence[n])
            found.setdefault(batch.stream, []).append((*stamps, values))
    return found


def decoded(wire: bytes, cuts: tuple[int, ...] | list[int] = ()) -> tuple[Any, FrameDecoder]:
    decoder = FrameDecoder(Options())
    edges = sorted({0, len(wire), *(cut % (len(wire) + 1) for cut in cuts)})
    batches = [each for a, b in pairwise(edges) for each in decoder.feed(wire[a:b])]
    batches += decoder.finish()
    return batches, decoder


def one(type: int, payload: bytes, tick: int = 7) -> tuple[Batch, FrameDecoder]:
    batches, decoder = decoded(FrameWriter().frame(type, tick, payload))
    assert len(batches) == 1
    return batches[0], decoder


def test_the_device_is_known() -> None:
    assert isinstance(find_device("locatk").create_decoder(Options()), FrameDecoder)


def test_magnetometers() -> None:
    field = np.arange(18, dtype=float).reshape(2, 3, 3)
    field[1, 2, 2] = np.nan
    payload = payloads.series(field, 500, temperature=[20.5, np.nan])
    batch, decoder = one(Type.MAGNETOMETERS, payload)
    assert batch.stream == Stream("magnetometers", sensors=3, ticks=MHZ)
    np.testing.assert_allclose(batch.columns["b_tesla"], field.reshape(2, 9) * 1e-6, rtol=1e-15)
    np.testing.assert_array_equal(batch.columns["temperature_celsius"], [20.5, np.nan])
    assert batch.tick is not None
    assert batch.tick.tolist() == [7, 507]
    assert batch.end.tolist() == [decoder.counts.bytes] * 2
    assert (decoder.counts.frames, decoder.counts.bad, decoder.counts.skipped) == (1, 0, 0)


def test_magnetometers_as_counts() -> None:
    counts = np.array([[[-32768, -32767, 32767]], [[0, 1, -1]]])
    batch, _ = one(Type.MAGNETOMETERS, payloads.series(counts, 1, scale=0.25))
    expected = np.where(counts == -32768, np.nan, counts * 0.25e-6).reshape(2, 3)
    np.testing.assert_allclose(batch.columns["b_tesla"], expected, rtol=1e-15)
    assert set(batch.columns) == {"b_tesla"}


@pytest.mark.parametrize("scale", [None, 97.5])
def test_halls(scale: float | None) -> None:
    batch, _ = one(Type.HALLS, payloads.series([[1, -2, 3, 4], [5, 6, 7, 8]], 10, scale=scale))
    assert batch.stream == Stream("halls", sensors=4, ticks=MHZ)
    expected = np.array([[1, -2, 3, 4], [5, 6, 7, 8]]) * (scale or 1) * 1e-6
    np.testing.assert_allclose(batch.columns["b_tesla"], expected, rtol=1e-15)


def test_odometry() -> None:
    poses = np.array([[0.5, -0.25, 3.125], [1.5, 2.5, -3.0]])
    batch, _ = one(Type.ODOMETRY, payloads.odometry(poses, 20_000))
    assert batch.stream == Stream("odometry", ticks=MHZ)
    found = [batch.columns[name] for name in ("x_m", "y_m", "heading_rad")]
    np.testing.assert_array_equal(np.transpose(found), poses)


def test_imu() -> None:
    samples = np.arange(12, dtype=float).reshape(2, 6)
    samples[1, 3:] = np.nan  # The gyroscope was not sampled.
    batch, _ = one(Type.IMU, payloads.series(samples[:, None], 10))
    assert batch.stream == Stream("imu", ticks=MHZ)
    np.testing.assert_array_equal(batch.columns["acceleration_m_s2"], samples[:, :3])
    np.testing.assert_array_equal(batch.columns["angular_rate_rad_s"], samples[:, 3:])
    assert batch.tick is not None
    assert batch.tick.tolist() == [7, 17]


def test_poses_of_the_device() -> None:
    poses = np.array([[1, 2, 3, 0.0, 0.0, 0.6, 0.8], [4, 5, 6, 0.0, 0.0, 0.0, 1.004]])
    batch, _ = one(Type.POSE, payloads.series(poses[:, None], 20))
    assert batch.stream == Stream("poses", ticks=MHZ)
    np.testing.assert_array_equal(batch.columns["position_m"], poses[:, :3])
    expected = [[0, 0, 0.6, 0.8], [0, 0, 0, 1]]  # rounded quaternions have their length again
    np.testing.assert_allclose(batch.columns["quaternion_xyzw"], expected, atol=1e-7)


def test_lighthouse_sweeps() -> None:
    payload = payloads.sweeps(
        [9, 2**32 - 1, 11],
        sensor=[0, 255, 2],
        channel=[1, 16, 3],
        polynomial=[-1, 31, 4],
        sweep=[-1, 0, 1],
        count=[0, 131071.99609375, 7.5],
    )
    batch, _ = one(Type.LIGHTHOUSE_SWEEP, payload)
    assert batch.stream == Stream("lighthouse", ticks=MHZ)
    assert batch.tick is not None
    assert batch.tick.tolist() == [9, 2**32 - 1, 11]
    assert {name: column.tolist() for name, column in batch.columns.items()} == {
        "sensor": [0, 255, 2],
        "channel": [1, 16, 3],
        "polynomial": [-1, 31, 4],
        "sweep": [-1, 0, 1],
        "count": [0, 131071.99609375, 7.5],
    }


def test_lighthouse_captures() -> None:
    bits = [2**64 - 1, 0x0123456789ABCDEF]
    batch, _ = one(
        Type.LIGHTHOUSE_CAPTURE, payloads.captures([3, 4], [0, 1], [-1, 9], [-128, 127], bits)
    )
    assert batch.stream == Stream("captures", ticks=MHZ)
    assert batch.columns["bits"].tolist() == bits
    assert batch.columns["bits"].dtype == np.uint64
    assert batch.columns["polynomial"].tolist() == [-1, 9]
    assert batch.columns["bit_offset"].tolist() == [-128, 127]


def test_text() -> None:
    batch, _ = one(Type.TEXT, payloads.text(4, "zu heiß"))
    assert batch.stream == Stream("log", ticks=MHZ)
    assert batch.columns["level"].tolist() == [4]
    assert batch.columns["text"].tolist() == ["zu heiß"]
    batch, _ = one(Type.TEXT, b"\x02" + "20 °C".encode("latin-1"))
    assert batch.columns["text"].tolist() == ["20 \\xb0C"]  # not lost, though no UTF-8


def changed(payload: bytes, place: int, *values: int) -> bytes:
    return payload[:place] + bytes(values) + payload[place + len(values) :]


INFINITE = bytes.fromhex("0000807f")
SIGNALLING_NAN = bytes.fromhex("0100807f")

WRONG = {
    "no header of a series": (Type.HALLS, b"\x01\x01\x00"),
    "no payload": (Type.ODOMETRY, b""),
    "a value too many": (Type.HALLS, HALLS + bytes(4)),
    "a byte too few": (Type.HALLS, HALLS[:-1]),
    "no sensor": (Type.HALLS, changed(HALLS, 0, 0)[:8]),
    "no sample": (Type.HALLS, changed(HALLS, 1, 0)[:8]),
    "unknown flag": (Type.HALLS, changed(HALLS, 2, 4)),
    "temperature of hall sensors": (Type.HALLS, changed(HALLS, 2, 2) + bytes(4)),
    "not reserved": (Type.HALLS, changed(HALLS, 3, 1)),
    "infinite field": (Type.HALLS, HALLS[:-4] + INFINITE),
    "infinite temperature": (
        Type.MAGNETOMETERS, payloads.series([[[1, 2, 3]]], 0, temperature=[np.inf]),
    ),
    "samples at one time": (Type.HALLS, payloads.series([[1.0], [2.0]], 0)),
    "longer than ticks tell": (Type.HALLS, payloads.series([[1.0]] * 3, 1 << 30)),
    "no scale": (Type.HALLS, payloads.series([[1]], 0, scale=0)),
    "negative scale": (Type.HALLS, payloads.series([[1]], 0, scale=-1)),
    "scale that is no number": (Type.HALLS, payloads.series([[1]], 0, scale=np.nan)),
    "odometry of two": (Type.ODOMETRY, payloads.series(np.ones((1, 2, 3)), 0)),
    "odometry as counts": (Type.ODOMETRY, payloads.series(np.ones((1, 1, 3)), 0, scale=1)),
    "odometry that is no number": (Type.ODOMETRY, payloads.odometry([[0, 0, np.nan]], 0)),
    "imu of two": (Type.IMU, payloads.series(np.ones((1, 2, 6)), 0)),
    "imu of three values": (Type.IMU, payloads.series(np.ones((1, 1, 3)), 0)),
    "infinite acceleration": (Type.IMU, payloads.series([[[np.inf] * 6]], 0)),
    "pose of six values": (Type.POSE, payloads.series(np.ones((1, 1, 6)), 0)),
    "pose that is no number": (Type.POSE, payloads.series([[[np.nan, 0, 0, 0, 0, 0, 1]]], 0)),
    "quaternion that is no number": (Type.POSE, payloads.series([[[0] * 6 + [np.nan]]], 0)),
    "quaternion of length 1.1": (Type.POSE, payloads.series([[[0] * 6 + [1.1]]], 0)),
    "quaternion of length 0": (Type.POSE, payloads.series([[[0] * 7]], 0)),
    "no passage": (Type.LIGHTHOUSE_DECK, b""),
    "half a passage": (Type.LIGHTHOUSE_DECK, bytes(7)),
    "not reserved in a passage": (Type.LIGHTHOUSE_DECK, bytes([0, 0, 4]) + bytes(11)),
    "no sweep": (Type.LIGHTHOUSE_SWEEP, b""),
    "half a sweep": (Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**SWEEP)[:6]),
    "channel 17": (Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**{**SWEEP, "channel": [17]})),
    "channel 0": (Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**{**SWEEP, "channel": [0]})),
    "polynomial 40": (Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**{**SWEEP, "polynomial": [40]})),
    "polynomial -2": (Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**{**SWEEP, "polynomial": [-2]})),
    "sweep 2": (Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**{**SWEEP, "sweep": [2]})),
    "count beyond the sequence": (
        Type.LIGHTHOUSE_SWEEP, payloads.sweeps(**{**SWEEP, "count": [1 << 17]}),
    ),
    "half a capture": (Type.LIGHTHOUSE_CAPTURE, payloads.captures(**CAPTURE)[:8]),
    "capture of polynomial 32": (
        Type.LIGHTHOUSE_CAPTURE, payloads.captures(**{**CAPTURE, "polynomial": [32]}),
    ),
    "not reserved in a capture": (
        Type.LIGHTHOUSE_CAPTURE, changed(payloads.captures(**CAPTURE), 7, 1),
    ),
    "no level": (Type.TEXT, b""),
    "level 0": (Type.TEXT, b"\x00words"),
    "level 6": (Type.TEXT, b"\x06words"),
    "short hello": (Type.HELLO, payloads.hello(1, "")[:-1]),
    "hello of version 0": (Type.HELLO, changed(payloads.hello(1, ""), 0, 0)),
    "not reserved in a hello": (Type.HELLO, changed(payloads.hello(1, ""), 2, 1)),
    "hello of a clock that stands": (Type.HELLO, payloads.hello(0, "")),
}  # fmt: skip


def test_content_that_cannot_be_is_bad() -> None:
    for what, (kind, payload) in WRONG.items():
        writer = FrameWriter()
        first = writer.frame(Type.HALLS, 1, HALLS)
        wrong = writer.frame(kind, 2, payload)
        batches, decoder = decoded(first + wrong + writer.frame(Type.HALLS, 3, HALLS))
        assert [batch.tick.tolist() for batch in batches] == [[1, 3]], what
        counts = decoder.counts
        assert (counts.frames, counts.bad, counts.lost, counts.unknown) == (2, 1, 0, 0), what
        assert counts.skipped == len(wrong), what


@pytest.mark.filterwarnings("error")
def test_any_nan_says_that_there_is_nothing() -> None:
    warm = payloads.series([[[1, 2, 3]]], 0, temperature=[20])
    batch, _ = one(Type.MAGNETOMETERS, warm[:-8] + SIGNALLING_NAN * 2)
    assert np.isnan(batch.columns["b_tesla"]).tolist() == [[False, False, True]]
    assert np.isnan(batch.columns["temperature_celsius"]).all()
    counts = payloads.series([[1]], 0, scale=1)
    _, decoder = decoded(
        FrameWriter().frame(Type.HALLS, 0, counts[:8] + SIGNALLING_NAN + counts[12:])
    )
    assert decoder.counts.bad == 1


def test_the_right_ones_of_a_layout_are_kept() -> None:
    writer = FrameWriter()
    wire = b"".join(
        writer.frame(
            Type.LIGHTHOUSE_SWEEP, n, payloads.sweeps(**{**SWEEP, "tick": [n], "channel": [n]})
        )
        for n in range(20)
    )
    batches, decoder = decoded(wire)
    assert [batch.tick.tolist() for batch in batches] == [list(range(1, 17))]
    assert (decoder.counts.frames, decoder.counts.bad) == (16, 4)


def test_unknown_types_are_counted() -> None:
    writer = FrameWriter()
    wire = writer.frame(200, 1, b"?") + writer.frame(0, 1, b"") + writer.frame(4, 1, HALLS)
    batches, decoder = decoded(wire)
    assert len(batches) == 1
    counts = decoder.counts
    assert (counts.frames, counts.unknown, counts.bad, counts.skipped) == (3, 2, 0, 0)


def test_nodes_are_streams_of_their_own() -> None:
    wire = b"".join(FrameWriter(node).frame(Type.HALLS, node, HALLS) for node in (0, 1, 255, 0))
    batches, decoder = decoded(wire)
    assert {batch.stream.node: batch.tick.tolist() for batch in batches} == {
        "": [0, 0],
        "1": [1],
        "255": [255],
    }
    assert decoder.counts.lost == 0


def test_ticks_start_again() -> None:
    batch, _ = one(Type.HALLS, payloads.series([[1.0]] * 4, 0x1000), tick=0xFFFFE000)
    assert batch.tick is not None
    assert batch.tick.tolist() == [0xFFFFE000, 0xFFFFF000, 0, 0x1000]


def numbered(*sequences: int, type: Type = Type.HALLS, node: int = 0) -> bytes:
    writer = FrameWriter(node)
    payload = payloads.hello(1_000_000, "it") if type == Type.HELLO else HALLS
    wire = b""
    for writer.sequence in sequences:
        wire += writer.frame(type, 0, payload)
        writer.sequence = 0
    return wire


@pytest.mark.parametrize(
    ("wire", "lost"),
    [
        (numbered(77, 78, 79), 0),
        (numbered(0, 2, 3, 7), 4),
        (numbered(65534, 65535, 0, 1), 0),
        (numbered(65530, 3), 8),
        (numbered(5, 5, 6), 0),  # twice the same
        (numbered(5, 6, 5, 6, 7), 0),
        (numbered(40_000, 0, 1), 25_535),  # could be
        (numbered(30_000, 0, 1), 0),  # restarted, without a HELLO
        (numbered(40_000) + numbered(0, type=Type.HELLO) + numbered(1, 2), 0),
        (numbered(40_000) + numbered(3, type=Type.HELLO), 25_538),
        (numbered(1, 2) + numbered(9, node=1) + numbered(3) + numbered(11, node=1), 1),
    ],
)
def test_what_is_lost(wire: bytes, lost: int) -> None:
    for cuts in ([], range(0, len(wire), 5), range(len(wire))):
        assert decoded(wire, list(cuts))[1].counts.lost == lost


def test_nothing_is_lost_while_nobody_listens() -> None:
    decoder = FrameDecoder(Options())
    decoder.feed(numbered(5, 6) + numbered(500, node=1) + b"half a fra")
    assert decoder.restart() == []
    decoder.feed(b"me\0" + numbered(900, 902) + numbered(1000, node=1))
    assert (decoder.counts.lost, decoder.counts.bad, decoder.counts.skipped) == (1, 0, 0)


def test_a_changed_rate_holds_from_its_hello_on() -> None:
    writer, other = FrameWriter(), FrameWriter(3)
    wire = b""
    for n, hz in enumerate((1_000_000, 32_768, 16_000_000)):
        wire += writer.frame(Type.HALLS, 10 * n, HALLS)
        wire += writer.frame(Type.HELLO, 10 * n + 1, payloads.hello(hz, "clock 1"))
        wire += other.frame(Type.HALLS, 10 * n + 2, HALLS)
        wire += writer.frame(Type.HALLS, 10 * n + 3, HALLS)
    whole, decoder = decoded(wire)
    ticks = {
        (each.stream.kind, each.stream.node, each.stream.ticks.hz): each.tick.tolist()
        for each in whole
    }
    assert ticks == {
        ("halls", "", 1_000_000): [0, 3, 10],
        ("halls", "", 32_768): [13, 20],
        ("halls", "", 16_000_000): [23],
        ("halls", "3", 1_000_000): [2, 12, 22],
        ("log", "", 1_000_000): [1],
        ("log", "", 32_768): [11],
        ("log", "", 16_000_000): [21],
    }
    pieces, _ = decoded(wire, list(range(0, len(wire), 3)))
    assert listed(pieces) == listed(whole)
    assert decoder.remarks == [
        "node 3 did not send its tick rate, which is assumed to be 1000000 Hz"
    ]


@pytest.mark.parametrize("cuts", [[], list(range(300))])
def test_records_before_the_first_hello_are_remarked(cuts: list[int]) -> None:
    writer = FrameWriter()
    wire = writer.frame(Type.HALLS, 0, HALLS)
    wire += writer.frame(Type.HELLO, 0, payloads.hello(32_768, "slow"))
    wire += writer.frame(Type.HELLO, 0, payloads.hello(32_768, "slow"))
    _, decoder = decoded(wire, cuts)
    assert decoder.remarks == [
        "the tick rate of the device is 32768 Hz; 1000000 Hz was assumed for the records before "
        "its HELLO"
    ]
    hello = FrameWriter().frame(Type.HELLO, 0, payloads.hello(32_768, "slow"))
    assert decoded(hello + wire, cuts)[1].remarks == []


def test_hello_is_logged_where_it_tells_anything() -> None:
    wire = numbered(4, 5, 6, type=Type.HELLO) + numbered(7)
    wire += numbered(0, 1, type=Type.HELLO)
    for cuts in ([], range(len(wire))):
        batches, decoder = decoded(wire, list(cuts))
        lines = [
            line
            for each in batches
            if each.stream.kind == "log"
            for line in zip(each.columns["level"].tolist(), each.columns["text"], strict=True)
        ]
        assert lines == [
            (2, "hello from it, 1000000 ticks/s"),
            (3, "restarted: it, 1000000 ticks/s"),
        ]
        assert (decoder.counts.lost, decoder.remarks) == (0, [])


def test_a_newer_version_is_remarked_once() -> None:
    writer = FrameWriter()
    hello = changed(payloads.hello(1_000_000, "new"), 0, 2)
    wire = b"".join(writer.frame(Type.HELLO, n, hello) for n in range(3))
    _, decoder = decoded(wire)
    assert decoder.remarks == [
        "the device uses version 2 of the protocol; this locatk supports version 1"
    ]


def test_records_of_several_layouts_stay_in_order() -> None:
    writer = FrameWriter()
    random = np.random.default_rng(3)
    wire, ticks = b"", []
    for n in range(200):
        k = int(random.integers(1, 5))
        scale = 0.5 if random.random() < 0.5 else None
        wire += writer.frame(Type.HALLS, 10 * n, payloads.series([[1, 2]] * k, 2, scale=scale))
        ticks += [10 * n + 2 * i for i in range(k)]
    batches, _ = decoded(wire)
    assert [batch.tick.tolist() for batch in batches] == [ticks]
    assert (np.diff(batches[0].end) >= 0).all()


def test_a_temperature_now_and_then() -> None:
    writer = FrameWriter()
    wire = b""
    for n in range(9):
        temperature = [20.0 + n] if n in (3, 4, 8) else None
        payload = payloads.series([[[1, 2, 3]]], 0, temperature=temperature)
        wire += writer.frame(Type.MAGNETOMETERS, n, payload)
    whole, _ = decoded(wire)
    assert [batch.tick.tolist() for batch in whole] == [[0, 1, 2], [3, 4], [5, 6, 7], [8]]
    assert ["temperature_celsius" in batch.columns for batch in whole] == [False, True] * 2
    assert whole[1].columns["temperature_celsius"].tolist() == [23.0, 24.0]
    pieces, _ = decoded(wire, list(range(0, len(wire), 7)))
    assert listed(pieces) == listed(whole)


def deck_passages(random: np.random.Generator, count: int) -> bytes:
    """Records, some without an offset, and with photodiodes in the dark."""
    records = b""
    for _ in range(count):
        head = int(random.integers(0, 2)) * (1 << 17 | int(random.integers(1, 1 << 17)))
        delays = random.choice([-300, 0, 150, 9_999, 10_001, 0x7FFF], 4).astype("<i2")
        records += head.to_bytes(3, "little") + random.bytes(3) + delays.tobytes()
    return records


def some_frames(count: int, seed: int, nodes: int = 3) -> list[bytes]:
    """Frames of all types from random values."""
    random = np.random.default_rng(seed)
    writers = [FrameWriter(node) for node in range(nodes)]
    frames = []
    for n in range(count):
        k, sensors = int(random.integers(1, 5)), int(random.integers(1, 4))
        near = random.integers(0, 3, (k, sensors, 3)).astype(float)
        field = np.where(random.random(near.shape) < 0.5, near, random.normal(0, 50, near.shape))
        ticks = 1000 * n + np.arange(k)
        kinds = {
            Type.HELLO: payloads.hello(int(random.choice([1_000_000, 32_768])), "x" * n),
            Type.TEXT: payloads.text(1 + n % 5, f"line {n}" * int(random.integers(0, 50))),
            Type.MAGNETOMETERS: payloads.series(field, 9, temperature=np.arange(k)),
            Type.HALLS: payloads.series(field[..., 0].astype(int), 9, scale=0.5),
            Type.ODOMETRY: payloads.odometry(field[:, 0], 9),
            Type.LIGHTHOUSE_SWEEP: payloads.sweeps(
                ticks, [0] * k, [1 + n % 16] * k, [n % 32] * k, [1] * k, random.random(k) * 1e5
            ),
            Type.LIGHTHOUSE_CAPTURE: payloads.captures(
                ticks, [0] * k, [n % 32] * k, [0] * k, random.integers(0, 1 << 62, k)
            ),
            Type.IMU: payloads.series(random.normal(size=(k, 1, 6)), 9),
            Type.POSE: payloads.series([[[*random.normal(size=3), 0, 0, 0, 1]]], 9),
            Type.LIGHTHOUSE_DECK: deck_passages(random, k),
            Type(3): payloads.series(field, 9),
        }
        type = Type(int(random.integers(1, 11)))
        frames.append(writers[int(random.integers(0, nodes))].frame(type, 1000 * n, kinds[type]))
    return frames


@pytest.mark.slow
@settings(deadline=None)
@given(st.integers(0, 1 << 32), st.lists(st.integers(0, 1 << 16), max_size=40))
def test_any_split_gives_the_same(seed: int, cuts: list[int]) -> None:
    random = np.random.default_rng(seed)
    wire = bytearray(b"".join(some_frames(30, seed)))
    for place in random.integers(0, len(wire), seed % 5).tolist():
        wire[place] ^= 1 << place % 8
    whole, decoder = decoded(bytes(wire))
    pieces, other = decoded(bytes(wire), cuts)
    assert listed(pieces) == listed(whole)
    assert other.counts == decoder.counts
    assert other.remarks == decoder.remarks


@pytest.mark.slow
def test_more_than_is_decoded_at_once() -> None:
    frames = some_frames(3000, 11)
    wire = b"".join(frames)
    assert len(wire) > PIECE_BYTES
    whole, decoder = decoded(wire)
    pieces, other = decoded(wire, list(range(0, len(wire), 1013)))
    assert listed(pieces) == listed(whole)
    assert other.counts == decoder.counts
    assert (decoder.counts.frames, decoder.counts.bad, decoder.counts.lost) == (3000, 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_faults_cost_their_frames_alone(seed: int) -> None:
    random = np.random.default_rng(seed)
    frames = some_frames(120, seed, nodes=1)
    edges = np.cumsum([0, *map(len, frames)])
    wire = bytearray(b"".join(frames))
    hit = set()
    for place in np.sort(random.integers(0, len(wire) - 1, 12))[::-1].tolist():
        frame = int(np.searchsorted(edges, place, "right")) - 1
        fault = int(random.integers(0, 3))
        hit.add(frame)
        if fault == 0:
            hit |= {frame + 1} if wire[place] == 0 else set()
            wire[place] ^= 1 << int(random.integers(0, 8))
        elif fault == 1:
            hit |= {frame + 1} if wire[place] == 0 else set()
            del wire[place]
        else:
            wire.insert(place, int(random.integers(0, 256)))
    batches, decoder = decoded(bytes(wire))
    expected = decoded(b"".join(frames))[0]

    def told(records: Any) -> set[tuple[int, str]]:
        return {
            (sequence, repr(values))
            for stream, rows in listed(records).items()
            for _, _, sequence, values in rows
            if stream.kind != "log"
        }

    assert told(batches) <= told(expected)
    missing = {sequence for sequence, _ in told(expected) - told(batches)}
    assert missing <= hit
    assert decoder.counts.lost <= 120 - decoder.counts.frames


def test_garbage_needs_no_memory() -> None:
    random = np.random.default_rng(1)
    decoder = FrameDecoder(Options())
    first = numbered(1)
    decoder.feed(first)
    for size in (1_000_000, 300, 70_000):
        noise = random.integers(1, 256, size).astype(np.uint8).tobytes()
        assert decoder.feed(noise) == []
        assert len(decoder._deframer._tail) <= MAX_WIRE_BYTES + 1
    batches = decoder.feed(b"\0" + numbered(2))
    assert [batch.end.tolist() for batch in batches] == [[decoder.counts.bytes]]
    assert (decoder.counts.bad, decoder.counts.skipped) == (1, 1_070_301)


@settings(deadline=None)
@given(st.binary(max_size=600))
def test_no_bytes_are_too_strange(data: bytes) -> None:
    assert decoded(data)[1].counts.frames == 0


@pytest.mark.slow
@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 9), st.binary(max_size=40)), max_size=20))
def test_no_payload_is_too_strange(sent: list[tuple[int, bytes]]) -> None:
    writer = FrameWriter()
    wire = b"".join(writer.frame(type, 0, payload) for type, payload in sent)
    counts = decoded(wire)[1].counts
    assert counts.frames + counts.bad == len(sent)
    assert counts.lost == 0
