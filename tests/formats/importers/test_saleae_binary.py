"""Binary files of Logic 2, alone and in captures: every edge arrives, damage is refused."""

from __future__ import annotations

import itertools
import json
import struct
import tracemalloc
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError, LocatkError, MissingDataError
from locatk.core.lighthouse.recording import Edges
from locatk.formats.benchmarks import infrared
from locatk.formats.importers.saleae import digital_lines as saleae_lines
from locatk.formats.importers.saleae.recording import read_capture, read_light

RATE = 40_000_000
START_MS, FRACTION = 1_710_177_920_662, 0.7922
START_NS = 1_710_177_920_662_792_200
NOISE = np.random.default_rng(8)

# ---- an encoder of its own, run by run


def varint(samples: int) -> bytes:
    groups = []
    value = samples - 1
    while value >> (7 * len(groups)) >> 6:
        groups.append((value >> (7 * len(groups))) & 0x7F)
    lead = value >> (7 * len(groups))
    coded = [lead | (0x40 if groups else 0)]
    for k in reversed(range(len(groups))):
        coded.append(groups[k] | (0x80 if k else 0))
    return bytes(coded)


def channel(
    edges: Sequence[int],
    borders: Sequence[int],
    *,
    level: int = 0,
    rate: int = RATE,
    start: tuple[int, float] = (START_MS, FRACTION),
    indexed: bool = True,
) -> bytes:
    """``digital-N.bin`` of chunks between ``borders``, the first of which is the start."""
    coded = b"<SALEAE>" + struct.pack("<ii", 1, 100)
    coded += struct.pack("<BdQdHQ", 1, rate, *start, 0, len(borders) - 1)
    for begin, end in itertools.pairwise(borders):
        inside = [edge for edge in edges if begin < edge < end]
        at = level ^ (sum(edge <= begin for edge in edges) & 1)
        stops = [*inside, end]
        runs = b"".join(varint(b - a) for a, b in zip([begin, *inside], stops, strict=True))
        coded += struct.pack("<6Q", begin, end, end - begin, rate, 1, len(runs)) + runs
        coded += struct.pack("<QQQI", 1, 0, 0, at) if indexed else struct.pack("<Q", 0)
    return coded


def meta(names: dict[int, str], start: tuple[float, float] = (START_MS, FRACTION)) -> str:
    def of(number: int) -> dict[str, object]:
        return {"category": "legacy", "type": "Digital", "deviceChannel": number}

    analog = {"type": "Analog", "deviceChannel": 0}
    rows = [{"name": name, "channel": of(number)} for number, name in names.items()]
    return json.dumps(
        {
            "version": 16,
            "data": {
                "captureStartTime": {
                    "unixTimeMilliseconds": start[0],
                    "fractionalMilliseconds": start[1],
                },
                "rowsSettings": [*rows, {"name": "supply", "channel": analog}],
            },
            "binData": [
                *({**of(number), "file": f"./digital-{number}.bin"} for number in names),
                {**analog, "file": "./analog-0.bin"},
            ],
        }
    )


def archive(path: Path, members: dict[str, bytes | str]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members.items():
            packed.writestr(name, content)
    return path


def capture(path: Path, channels: dict[str, bytes]) -> Path:
    """A capture of channels 4, 5, ... of these names."""
    members: dict[str, bytes | str] = {
        f"digital-{number}.bin": content for number, content in enumerate(channels.values(), 4)
    }
    return archive(path, {**members, "meta.json": meta(dict(enumerate(channels, 4)))})


def export(edges: Sequence[float], *, level: int = 0, span: tuple[float, float]) -> bytes:
    head = struct.pack("<iiIddQ", 0, 0, level, *span, len(edges))
    return b"<SALEAE>" + head + struct.pack(f"<{len(edges)}d", *edges)


def light(bursts: int = 12, bits: int = 60, rate: int = RATE, seed: int = 1) -> list[int]:
    """Edges of biphase-mark code of 6 Mbit/s in bursts, in samples."""
    ns, at = [], 20_000.0
    noise = np.random.default_rng(seed)
    for _ in range(bursts):
        for bit in noise.integers(0, 2, bits):
            ns += [at + 1000 / 12, at + 1000 / 6] if bit else [at + 1000 / 6]
            at += 1000 / 6
        at += 100_000
    return np.unique(np.round(np.array(ns) * rate / 1e9).astype(int)).tolist()


def clock(n: int = 2000, period: int = 7) -> list[int]:
    return list(range(10, 10 + n * period, period))


def in_bursts(edges: Sequence[int], size: int = 100, pause: int = 4000) -> list[int]:
    """The same with a pause after each ``size`` edges."""
    return [edge + k // size * pause for k, edge in enumerate(edges)]


def borders_of(edges: Sequence[int], size: int = 5000) -> list[int]:
    return list(range(0, edges[-1] + size + 1, size))


def fails(path: Path, words: str, channels: Sequence[str | int] = ()) -> LocatkError:
    """The error is one line that names the file and says ``words``."""
    with pytest.raises(LocatkError) as caught:
        read_light(path, channels)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert caught.value.hint
    return caught.value


# ---- captures


@st.composite
def lines(draw: st.DrawFn) -> tuple[list[int], list[int]]:
    """Ascending edges and borders, some of which fall on one another."""
    start = draw(st.integers(0, 3)) * 1_000_000_000
    steps = st.one_of(st.integers(1, 9), st.integers(60, 70), st.integers(1, 3_000_000))
    edges = start + np.cumsum(draw(st.lists(steps, min_size=1, max_size=60)))
    end = int(edges[-1]) + draw(st.integers(1, 100))
    free = st.lists(st.integers(start + 1, end - 1), max_size=4)
    chosen = set(draw(st.lists(st.sampled_from(edges.tolist()), max_size=4))) | set(draw(free))
    return edges.tolist(), [start, *sorted(chosen - {start}), end]


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(lines(), st.integers(0, 1), st.sampled_from([1, 40, 1 << 17]))
def test_every_edge_arrives_also_on_the_border_of_chunks(
    tmp_path_factory: pytest.TempPathFactory,
    line: tuple[list[int], list[int]],
    level: int,
    batch: int,
) -> None:
    edges, borders = line
    path = tmp_path_factory.mktemp("sal") / "run.sal"
    capture(path, {"light": channel(edges, borders, level=level)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("locatk.formats.importers.saleae.logic2.BATCH_BYTES", batch)
        (read,) = read_light(path, ["light"])
    assert read.tick.dtype == np.int64
    assert read.tick.tolist() == edges
    assert read.rises == (level == 0)
    assert read.end_tick == borders[-1]
    assert (read.rate_hz, read.resolution_hz, read.start_ns) == (RATE, RATE, START_NS)


def test_without_an_index_the_level_goes_on(tmp_path: Path) -> None:
    edges = [100, 200, 300, 5000, 9000]
    coded = channel(edges, [0, 250, 400, 10_000], indexed=False)
    (read,) = read_light(capture(tmp_path / "run.sal", {"a": coded}), [4])
    assert read.tick.tolist() == edges
    assert read.rises


def test_runs_of_one_to_five_bytes(tmp_path: Path) -> None:
    steps = [1, 64, 65, 8192, 8193, 1 << 20, (1 << 20) + 1, 1 << 27, (1 << 27) + 1, 1 << 34, 5]
    assert {len(varint(step)) for step in steps} == {1, 2, 3, 4, 5}
    edges = np.cumsum(steps).tolist()
    path = capture(tmp_path / "run.sal", {"a": channel(edges, [0, edges[-1] + 9])})
    assert read_light(path, ["a"])[0].tick.tolist() == edges


def test_a_channel_without_edges(tmp_path: Path) -> None:
    path = capture(tmp_path / "run.sal", {"idle": channel([], [0, 1000, 2000])})
    (read,) = read_light(path, ["idle"])
    assert len(read) == 0
    assert read.end_tick == 2000
    fails(path, "no light")


def test_light_is_told_from_other_lines_by_what_is_on_it(tmp_path: Path) -> None:
    first, second = light(), light(seed=2)
    serial = np.unique(np.cumsum(NOISE.geometric(0.5, 4000)) * 10 // 3).tolist()  # 12 Mbit/s
    busy = clock(80, 5000)
    channels = {
        name: channel(edges, borders_of(edges))
        for name, edges in {
            "busy": busy,
            "data B": second,
            "clock": clock(),
            "clock in bursts": in_bursts(clock()),
            "serial": serial,
            "serial in bursts": in_bursts(serial),
            "light without pauses": light(bursts=1, bits=2000),
            "data A": first,
        }.items()
    }
    read = read_capture(capture(tmp_path / "run.sal", channels))
    assert [edges.tick.tolist() for edges in read.edges] == [second, first]
    assert read.names == ("'data B' (channel 5)", "'data A' (channel 11)")
    facts = read.facts()
    assert facts["resolution"] == "40 MHz"
    assert facts["start"] == "2024-03-11T17:25:20.662792200Z"
    assert "'clock' (channel 6)" in facts["left out"]
    assert f"'data A' (channel 11): {len(first):,} edges" in facts["light"]


def test_channels_by_number_and_name_in_the_order_asked_for(tmp_path: Path) -> None:
    path = capture(
        tmp_path / "run.sal",
        {"one": channel([3], [0, 9]), "Two": channel([4], [0, 9]), "two": channel([5], [0, 9])},
    )
    assert [edges.tick.tolist() for edges in read_light(path, ["5", "ONE"])] == [[4], [3]]
    assert read_light(path, [6])[0].tick.tolist() == [5]
    error = fails(path, "no line '7'", ["7"])
    assert error.hint == "The capture has 'one' (channel 4), 'Two' (channel 5), 'two' (channel 6)"
    fails(path, "several lines 'two'", ["two"])
    fails(path, "named twice", ["one", 4])


def test_no_light_names_the_lines_and_the_option(tmp_path: Path) -> None:
    path = capture(tmp_path / "run.sal", {"clk": channel(clock(), borders_of(clock()))})
    error = fails(path, "no light")
    assert "'clk' (channel 4): 2,000 edges" in str(error.hint)
    assert "--channel" in str(error.hint)


@pytest.mark.parametrize("channels", [(), ("light",)])
def test_a_rate_too_low_is_refused(tmp_path: Path, channels: tuple[str, ...]) -> None:
    slow = light(rate=20_000_000)
    coded = channel(slow, borders_of(slow), rate=20_000_000)
    path = capture(tmp_path / "run.sal", {"light": coded})
    assert "24 MHz" in str(fails(path, "20 MHz", channels).hint)
    enough = light(rate=24_000_000)
    coded = channel(enough, borders_of(enough), rate=24_000_000)
    assert read_light(capture(path, {"light": coded}))[0].tick.tolist() == enough


@pytest.mark.parametrize(
    "told",
    [
        None,
        "",
        "{",
        "[]",
        "[" * 100_000,
        '{"data": [], "binData": 4}',
        '{"data": {"rowsSettings": [{"name": 4, "channel": 7}, 9, {"channel": {}}]}}',
        json.dumps({"binData": [{"type": "Digital", "deviceChannel": "4"}]}),
    ],
)
def test_a_capture_does_without_its_meta(tmp_path: Path, told: str | None) -> None:
    members: dict[str, bytes | str] = {"digital-4.bin": channel([100, 200], [0, 300])}
    path = archive(tmp_path / "run.sal", members | ({} if told is None else {"meta.json": told}))
    (read,) = read_light(path, ["Channel 4"])
    assert read.start_ns == START_NS


def test_the_start_of_the_meta_where_the_header_has_none(tmp_path: Path) -> None:
    coded = channel([100], [0, 300], start=(0, float("nan")))
    path = capture(tmp_path / "run.sal", {"a": coded})
    assert read_light(path, ["a"])[0].start_ns == START_NS
    unknown = {"digital-4.bin": coded, "meta.json": meta({4: "a"}, (1e300, -1))}
    assert read_light(archive(path, unknown), ["a"])[0].start_ns == 0


def test_names_are_fit_for_a_terminal(tmp_path: Path) -> None:
    name = "light\n\x1b[31m" + "a" * 100
    path = capture(tmp_path / "run.sal", {name: channel([100], [0, 300])})
    (shown,) = read_capture(path, [4]).names
    assert shown.isprintable()
    assert len(shown) < 80


# ---- damage


GOOD = channel([100, 200, 300, 450], [0, 250, 500])


def patched(offset: int, form: str, value: float) -> bytes:
    coded = bytearray(GOOD)
    struct.pack_into(form, coded, offset, value)
    return bytes(coded)


@pytest.mark.parametrize(
    ("coded", "words"),
    [
        (b"", "not a binary file"),
        (GOOD[:40], "end of file"),
        (GOOD[:-1], "end of file"),
        (GOOD + b"\0", "more bytes"),
        (patched(8, "<i", 7), "unknown version 7"),
        (patched(0x11, "<d", 0), "sampling rate"),
        (patched(0x11, "<d", float("nan")), "sampling rate"),
        (patched(0x11, "<d", 2e7), "per second in a file of 2e+07"),
        (patched(0x2B, "<Q", 2**63), "end of file"),
        (patched(0x2B, "<Q", 1), "more bytes"),
        (patched(0x33, "<Q", 1), "a chunk of 250 samples from 1"),
        (patched(0x33 + 16, "<Q", 0), "a chunk of 0 samples"),
        (patched(0x33 + 40, "<Q", 2**60), "bytes"),
        (patched(0x33 + 40, "<Q", 0), "a chunk of 0 bytes"),
        (patched(0x33 + 48, "<B", 0), "runs of"),
        (patched(0x33 + 48, "<B", 0xC1), "unknown code"),
        (patched(0x33 + 48 + 4, "<B", 0x40), "inside a run"),
        (patched(0x33 + 81 + 48 + 3, "<B", 0x40), "inside a run"),
        (patched(0x33 + 48 + 5, "<Q", 2**40), "index entries"),
        (patched(0x33 + 48 + 29, "<I", 2), "index does not begin"),
        (channel([100], [0, 250, 500]) + channel([], [600, 700])[0x33:], "more bytes"),
    ],
)
def test_a_damaged_channel_is_refused(tmp_path: Path, coded: bytes, words: str) -> None:
    error = fails(capture(tmp_path / "run.sal", {"a": coded}), words, ["a"])
    assert "digital-4.bin" in str(error)


def test_chunks_that_do_not_follow_one_another(tmp_path: Path) -> None:
    one, other = channel([100], [0, 250]), channel([400], [251, 500])
    coded = one[:0x2B] + struct.pack("<Q", 2) + one[0x33:] + other[0x33:]
    fails(capture(tmp_path / "run.sal", {"a": coded}), "begins at sample 251", ["a"])


def test_archives_that_are_none_or_lack_channels(tmp_path: Path) -> None:
    path = tmp_path / "run.sal"
    whole = capture(path, {"a": GOOD, "b": GOOD}).read_bytes()
    for cut in (4, 60, len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:cut])
        fails(path, "damaged archive", ["a"])
    flipped = bytearray(whole)
    flipped[50] ^= 4
    path.write_bytes(flipped)
    fails(path, "damaged archive", ["a"])
    fails(archive(path, {"digital-4.bin": GOOD, "meta.json": meta({4: "a", 5: "b"})}), "digital-5")
    fails(archive(path, {"analog-0.bin": b"", "meta.json": meta({})}), "no digital channel")
    fails(archive(path, {}), "no digital channel")
    fails(archive(path, {"digital-4.bin": export([], span=(0, 1))}), "an export inside")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as packed:
        packed.writestr("digital-4.bin", GOOD)
    fails(path, "compression")
    path.write_bytes(b"")
    fails(path, "empty file")
    path.write_text("Notes on my capture\n")
    fails(path, "neither a capture")
    fails(tmp_path, "a folder")
    with pytest.raises(MissingDataError, match="no such file"):
        read_light(tmp_path / "none.sal")


@pytest.mark.slow
def test_a_bomb_takes_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = 1 << 20  # an edge at each of a million samples, packed a thousand times
    one = struct.pack("<6Q", 0, size, size, RATE, 1, size) + bytes(size) + struct.pack("<Q", 0)
    head = channel([], [0, 1])[:0x2B]
    chunks = b"".join(struct.pack("<QQ", k * size, (k + 1) * size) + one[16:] for k in range(24))
    path = capture(tmp_path / "bomb.sal", {"a": head + struct.pack("<Q", 24) + chunks})
    assert path.stat().st_size < 100_000
    del one, chunks
    tracemalloc.start()
    try:
        fails(path, "no light")
        monkeypatch.setattr(saleae_lines, "MAX_EDGES", 3_000_000)
        fails(path, "more than 3,000,000 edges", ["a"])
        assert tracemalloc.get_traced_memory()[1] < 150e6
    finally:
        tracemalloc.stop()
    monkeypatch.setattr("locatk.formats.importers.saleae.logic2.MAX_CAPTURE_BYTES", 1 << 20)
    fails(path, "more than 1,048,576")


@pytest.mark.slow
def test_a_clock_that_never_ends_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is looked at as far as a line could be read; damage after that does not matter."""
    edges, clock = light(), list(range(5, 200_000, 5))
    members = {
        "light": channel(edges, borders_of(edges)),
        "clock": channel(clock, borders_of(clock)),
    }
    monkeypatch.setattr("locatk.formats.importers.saleae.logic2.BATCH_BYTES", 1000)
    monkeypatch.setattr(saleae_lines, "MAX_EDGES", 5_000)
    members["clock"] = members["clock"][:-9]
    found = read_capture(capture(tmp_path / "run.sal", members))
    assert found.names == ("'light' (channel 4)",)
    assert found.edges[0].tick.tolist() == edges


FEW = channel(light(2, 20), borders_of(light(2, 20), 997))
FEW_EXPORTED = export([tick / RATE for tick in light(2, 20)], span=(0, 1))


@pytest.mark.slow
@settings(max_examples=90, deadline=None)
@given(st.data())
def test_damage_raises_nothing_but_what_it_should(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    kind = data.draw(st.sampled_from(["archive", "member", "export"]))
    path = tmp_path_factory.mktemp("fuzz") / "run.sal"
    coded = FEW
    if kind == "archive":
        whole = capture(path, {"a": coded}).read_bytes()
    else:
        whole = coded if kind == "member" else FEW_EXPORTED
    damaged = bytearray(whole)
    spots = st.one_of(st.integers(0, min(130, len(whole) - 1)), st.integers(0, len(whole) - 1))
    for at in data.draw(st.lists(spots, max_size=6)):
        damaged[at] = data.draw(st.one_of(st.sampled_from([0, 1, 127, 255]), st.integers(0, 255)))
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(whole))) :]
    if kind == "member" and data.draw(st.booleans()):
        archive(path, {"digital-4.bin": bytes(damaged)})
    else:
        path.write_bytes(damaged)
    for channels in ((), (4,)):
        try:
            for edges in read_light(path, channels):
                check(edges)
        except LocatkError as error:
            caught = error
        else:
            continue
        assert "\n" not in str(caught)
        assert caught.hint


def check(edges: Edges) -> None:
    """What the contract of edges promises."""
    assert np.all(np.diff(edges.tick) > 0)
    assert not len(edges) or edges.tick[-1] < edges.end_tick
    assert 23e6 <= edges.resolution_hz <= edges.rate_hz


# ---- files outside an archive


def test_a_channel_outside_its_archive(tmp_path: Path) -> None:
    edges = light()
    path = tmp_path / "digital-4.bin"
    path.write_bytes(channel(edges, borders_of(edges)))
    read = read_capture(path)
    assert read.edges[0].tick.tolist() == edges
    assert (read.names, read.format) == (("'Channel 4'",), "saleae-binary")


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 10**7), max_size=40), st.integers(0, 1), st.integers(-(10**12), 10**12)
)
def test_an_export_arrives_to_the_nanosecond(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int], level: int, start: int
) -> None:
    ticks = start + np.cumsum(steps, dtype=np.int64)
    end = start + sum(steps) + 7
    path = tmp_path_factory.mktemp("bin") / "digital_3.bin"
    path.write_bytes(export((ticks / 1e9).tolist(), level=level, span=(start / 1e9, end / 1e9)))
    (read,) = read_light(path, [3])
    assert read.tick.tolist() == ticks.tolist()
    assert read.end_tick == end
    assert not len(ticks) or read.rises == (level == 0)
    assert read.rate_hz == 1e9


@pytest.mark.parametrize("times", [1, 2, 1 << 17])
def test_an_export_of_version_1_with_a_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    monkeypatch.setattr("locatk.formats.importers.saleae.logic2.EXPORT_BATCH_EDGES", times)

    def chunk(level: int, begin: float, end: float, times: list[float]) -> bytes:
        head = struct.pack("<IdddQ", level, 5e7, begin, end, len(times))
        return head + struct.pack(f"<{len(times)}d", *times)

    first, same, other = (
        chunk(0, 0, 0.001, [0.0002, 0.0004, 0.0006]),
        chunk(1, 0.002, 0.003, [0.0025]),
        chunk(1, 0.004, 0.005, [0.0045]),
    )
    path = tmp_path / "digital_0.bin"
    path.write_bytes(b"<SALEAE>" + struct.pack("<iiQ", 1, 0, 3) + first + same + other)
    (read,) = read_light(path, [0])
    ms = [0.2, 0.4, 0.6, 2.5, 4.0, 4.5]  # at 4.0 the level is another one than before the gap
    assert read.tick.tolist() == [round(t * 1_000_000) for t in ms]
    assert (read.rises, read.end_tick, read.resolution_hz) == (True, 5_000_000, 5e7)


@pytest.mark.parametrize(
    ("coded", "words"),
    [
        (export([0.1, 0.1], span=(0, 1)), "not after the one before"),
        (export([0.2, 0.1], span=(0, 1)), "not after the one before"),
        (export([float("nan")], span=(0, 1)), "not a number of seconds"),
        (export([1e300], span=(0, 1)), "not a number of seconds"),
        (export([1.5], span=(0, 1)), "but the data end"),
        (export([], span=(1, 0)), "data from"),
        (export([], span=(0, 1), level=2), "a level of 2"),
        (export([0.1, 0.2], span=(0, 1))[:-8], "end of file"),
        (export([0.1], span=(0, 1)) + b"\0" * 8, "more bytes"),
        (b"<SALEAE>" + struct.pack("<iiIddQ", 0, 0, 0, 0, 1, 2**63), "end of file"),
        (b"<SALEAE>" + struct.pack("<ii", 0, 1), "an analog channel"),
        (b"<SALEAE>" + struct.pack("<ii", 2, 0), "unknown version 2"),
    ],
)
def test_a_damaged_export_is_refused(tmp_path: Path, coded: bytes, words: str) -> None:
    path = tmp_path / "digital_0.bin"
    path.write_bytes(coded)
    fails(path, words, [0])


# ---- published captures


def run_by_run(coded: bytes, chunks: int) -> tuple[list[int], int]:
    """Edges of the first chunks by the plainest loop, and the level at the start. All entries
    of an index have to agree with the runs: (sample, byte, level) inside the chunk."""
    at, edges, level, entry = 0x33, [], None, 0
    for _ in range(chunks):
        start, _, _, _, _, size = struct.unpack_from("<6Q", coded, at)
        at += 48
        first, stop, sample, ends = at, at + size, start, []
        places = {0: (0, 0)}
        while at < stop:
            byte = coded[at]
            at += 1
            value, more = byte & 63, byte & 64
            while more:
                value, more = value << 7 | coded[at] & 127, coded[at] & 128
                at += 1
            sample += value + 1
            ends.append(sample)
            places[at - first] = (sample - start, len(ends) & 1)
        entries, _, _, begins = struct.unpack_from("<QQQI", coded, at)
        for k in range(entries):
            inside, byte, there = struct.unpack_from("<QQI", coded, at + 8 + 20 * k)
            assert (inside, there ^ begins) == places[byte]
        at += 8 + 20 * entries
        if level is None:
            entry = begins
        elif level != begins:
            edges.append(start)
        edges += ends[:-1]
        level = begins ^ (len(ends) - 1 & 1)
    return edges, entry


CAPTURES = {
    "demodulation_code/logic_analyser_capture.sal": (2_196_684, 54.079488, 1620),
    "oneLH_2D/Logic_analyser_capture.sal": (1_447_820, 37.0130944, 1102),
    "twoLH_2D/Logic_analyser_capture.sal": (182_294, 4.6014464, 137),
}
"""Edges inside chunks are 2,196,682 in the first; two more are right on a border."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CAPTURES)
def test_published_captures(data: Path, name: str) -> None:
    path = data / "lighthouse" / "benchmarks" / name
    count, seconds, chunks = CAPTURES[name]
    read = read_capture(path)
    (edges,) = read.edges
    assert "Data' (channel 4)" in read.names[0]
    assert len(edges) == count
    assert edges.duration_s == seconds
    assert edges.rate_hz == edges.resolution_hz == 40e6
    check(edges)
    with zipfile.ZipFile(path) as packed:
        for number, line in zip([4, 5, 6], read_light(path, [4, 5, 6]), strict=True):
            some, level = run_by_run(packed.read(f"digital-{number}.bin"), min(chunks, 150))
            assert line.tick[: len(some)].tolist() == some
            assert line.rises == (level == 0)


def test_a_bit_flip_in_a_published_capture_is_found(data: Path, tmp_path: Path) -> None:
    whole = (
        data / "lighthouse" / "benchmarks" / "twoLH_2D" / "Logic_analyser_capture.sal"
    ).read_bytes()
    for at in NOISE.integers(100, 70_000, 8):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(NOISE.integers(0, 8))
        path = tmp_path / "run.sal"
        path.write_bytes(damaged)
        with pytest.raises(InputError):
            read_light(path)


# ---- digital lines that are no light


def pulses(widths_us: Sequence[float], pause_us: float = 1000.0) -> list[int]:
    """Edges of a line that is high for each of ``widths_us``, in samples."""
    steps = [step for width in widths_us for step in (pause_us, width)]
    return np.round(np.cumsum(steps) * RATE / 1e6).astype(int).tolist()


def test_durations_of_the_stages_of_a_firmware(tmp_path: Path) -> None:
    """Table III of the Lighthouse paper is read from lines beside that of the light."""
    recorded = {
        "demodulation_code/logic": {
            "demodulate_light()": [600.0, 650.0],
            "determine_polynomial()": [120.0, 140.0],
            "reverse_count_p()": [50.0],
        },
        "oneLH_2D/Logic": {"count_to_camera()": [137.0, 138.0], "apply_homography()": [3.5, 3.5]},
        "twoLH_2D/Logic": {"count_to_camera()": [137.0], "twoLH_2D": [6.0]},
    }
    for name, lines in recorded.items():
        path = tmp_path / "benchmarks" / f"{name}_analyser_capture.sal"
        path.parent.mkdir(parents=True)
        edges = {"LH2 - Data": light(), **{key: pulses(value) for key, value in lines.items()}}
        capture(path, {key: channel(value, [0, RATE // 100]) for key, value in edges.items()})
    found = {row.name: row for row in infrared.firmware_figures(tmp_path)}
    assert {name.removeprefix("microcontroller"): row.value for name, row in found.items()} == {
        ", demodulation: mean": pytest.approx(625.0),
        ", demodulation: SD": pytest.approx(25.0),
        ", polynomial: mean": pytest.approx(130.0),
        ", polynomial: SD": pytest.approx(10.0),
        ", LFSR index: mean": pytest.approx(50.0),
        ", LFSR index: SD": pytest.approx(0.0),
        ", position, one station: mean": pytest.approx(141.0),
        ", position, two stations: mean": pytest.approx(143.0),
        ": load": pytest.approx(100 * (1250 + 260 + 50) / 10_000),
        ": captures with an index": pytest.approx(50.0),
    }
    # A capture without the line is refused, with the lines that it has.
    (tmp_path / "benchmarks/oneLH_2D/Logic_analyser_capture.sal").write_bytes(
        (tmp_path / "benchmarks/twoLH_2D/Logic_analyser_capture.sal").read_bytes()
    )
    with pytest.raises(InputError, match="apply_homography"):
        infrared.firmware_figures(tmp_path)


@pytest.mark.parametrize(("level", "widths_us"), [(0, [2.0, 3.0]), (1, [3.0])])
def test_a_pulse_is_between_a_rising_and_a_falling_edge(
    tmp_path: Path, level: int, widths_us: list[float]
) -> None:
    # Edges at 1, 3, 6 and 9 us, and one at 20 us without a following edge if the line starts low.
    edges = [40, 120, 240, 360, 800] if level == 0 else [40, 120, 240, 360]
    coded = channel(edges, [0, 4000], level=level)
    (line,) = read_light(capture(tmp_path / "run.sal", {"busy": coded}), ["busy"])
    found = infrared.pulse_widths_us(line)
    assert found.tolist() == pytest.approx(widths_us)
