"""Lines of text: what they say, and that pieces, damage and boot messages do no harm."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.trajectory import Trajectory
from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Batch, Counts, Options, Recording, Stream, Ticks
from locatk.formats.devices.lines import decoder as lines
from locatk.formats.devices.lines.columns import interpret_columns
from locatk.formats.devices.lines.decoder import MAX_LINE_BYTES, LineDecoder

Pieces = Sequence[bytes]


def decode(*pieces: bytes, columns: tuple[str, ...] = ()) -> tuple[LineDecoder, list[Batch]]:
    decoder = LineDecoder(Options(columns))
    batches = [batch for piece in pieces for batch in decoder.feed(piece)]
    return decoder, batches + decoder.finish()


def joined(batches: Sequence[Batch]) -> dict[Stream, dict[str, Any]]:
    """All records by stream, as lists; a column that only some batches have is left out."""
    streams: dict[Stream, dict[str, list[Any]]] = {}
    for batch in batches:
        fields = {"end": batch.end, **batch.columns}
        if batch.tick is not None:
            fields["tick"] = batch.tick
        if batch.sequence is not None:
            fields["sequence"] = batch.sequence
        records = streams.setdefault(batch.stream, {name: [] for name in fields})
        for name, column in fields.items():
            if name in records:
                assert len(column) == len(batch)
                records[name] += column.tolist()
    return streams


def same(batches: Sequence[Batch], others: Sequence[Batch]) -> bool:
    one, other = ({repr(k): repr(v) for k, v in joined(each).items()} for each in (batches, others))
    return one == other


def only(batches: Sequence[Batch], kind: str) -> tuple[Stream, dict[str, Any]]:
    """The one stream of a kind."""
    found = [(stream, of) for stream, of in joined(batches).items() if stream.kind == kind]
    assert len(found) == 1
    return found[0]


def texts(batches: Sequence[Batch]) -> list[str]:
    return [line for b in batches if b.stream.kind == "log" for line in b.columns["text"]]


def values(batches: Sequence[Batch]) -> dict[tuple[str, ...], list[list[float]]]:
    return {
        stream.names: of["value"]
        for stream, of in joined(batches).items()
        if stream.kind == "readings"
    }


# ---- numbers


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("separator", [b",", b";", b"\t", b" ", b", ", b"  "])
def test_numbers_with_a_header(separator: bytes, end: bytes) -> None:
    rows = [b"t_ms,u_v,i_a", b"1,2.5,-3", b"2,.5,1e3"]
    data = b"".join(row.replace(b",", separator) + end for row in rows)
    decoder, batches = decode(data)
    stream, records = only(batches, "readings")
    assert stream == Stream("readings", names=("u_v", "i_a"), ticks=Ticks(1e6))
    assert records["value"] == [[2.5, -3], [0.5, 1000]]
    assert records["tick"] == [1000, 2000]
    last = data.rindex(end[:1]) + 1
    assert records["end"][-1] == last
    assert decoder.counts == Counts(bytes=len(data), frames=3)


def test_numbers_without_a_header() -> None:
    decoder, batches = decode(b"\n1,2\n3,4\n5,6\n")
    assert values(batches) == {("c0", "c1"): [[1, 2], [3, 4], [5, 6]]}
    assert decoder.counts.frames == 3


@pytest.mark.parametrize("half", [b"3,4", b"3,4,5", b",4,5", b"", b"7", b"3,", b"\xf1,4,5", b"-"])
def test_the_first_line_may_be_half(half: bytes) -> None:
    """Its first number may have lost digits, whatever the number of cells."""
    decoder, batches = decode(half + b"\n10,20,30\n11,21,31\n")
    assert values(batches) == {("c0", "c1", "c2"): [[10, 20, 30], [11, 21, 31]]}
    assert (decoder.counts.bad, decoder.counts.skipped) == (0, 0)


def test_columns_named_by_the_user() -> None:
    names = ("micros", "b0x_ut", "b0y_ut", "b0z_ut")
    decoder, batches = decode(b"9,9\n1 2 3 4\n5 6 7 8\n", columns=names)
    stream, records = only(batches, "magnetometers")
    assert stream == Stream("magnetometers", sensors=1, ticks=Ticks(1e6, 32))
    np.testing.assert_allclose(records["b_tesla"], np.array([[2, 3, 4], [6, 7, 8]]) * 1e-6)
    assert records["tick"] == [1, 5]
    assert decoder.counts == Counts(bytes=20, frames=2)


def test_a_header_beside_columns_named_by_the_user_is_passed_over() -> None:
    data = b"a,b\n1,2\nx_m,y_m\n3,4\nu,v\n5,6\n"
    decoder, batches = decode(data, columns=("u", "v"))
    assert values(batches) == {("u", "v"): [[1, 2], [3, 4], [5, 6]]}
    assert texts(batches) == ["a,b", "x_m,y_m"]
    assert decoder.counts.frames == 6


def test_two_columns_of_one_name() -> None:
    with pytest.raises(InputError, match="'u'"):
        LineDecoder(Options(("u", "v", "u")))


def test_a_header_comes_again_after_a_reboot() -> None:
    data = b"seq,v_mv\n7,1\n8,2\nhello\nseq,v_mv\n0,3\n1,4\n"
    decoder, batches = decode(data)
    _, records = only(batches, "readings")
    assert records["value"] == [[1], [2], [3], [4]]
    assert records["sequence"] == [7, 8, 0, 1]
    assert texts(batches) == ["hello"]
    assert decoder.counts == Counts(bytes=len(data), frames=7)


@pytest.mark.parametrize("damaged", [b"1", b"1,2,3", b"1,2x", b"\xff\xff"])
def test_a_damaged_line_after_the_header(damaged: bytes) -> None:
    decoder, batches = decode(b"u,v\n" + damaged + b"\n3,4\n5,6\n")
    assert values(batches) == {("u", "v"): [[3, 4], [5, 6]]}
    assert (texts(batches), decoder.counts.bad) == ([], 1)


def test_another_header_names_the_columns_anew() -> None:
    data = b"a,b,c\n1,2,3\nx_m,y_m,heading_rad\n4,5,6\nd,e\n7,8\n"
    _, batches = decode(data)
    assert values(batches) == {("a", "b", "c"): [[1, 2, 3]], ("d", "e"): [[7, 8]]}
    _, odometry = only(batches, "odometry")
    assert [odometry[key] for key in ("x_m", "y_m", "heading_rad")] == [[4], [5], [6]]


def test_names_after_numbers_without() -> None:
    _, batches = decode(b"\n1,2,3\n4,5,6\nu,v,w\n7,8,9\n")
    assert values(batches) == {
        ("c0", "c1", "c2"): [[1, 2, 3], [4, 5, 6]],
        ("u", "v", "w"): [[7, 8, 9]],
    }


@pytest.mark.parametrize(
    "said",
    [
        b"MLX90393 found",
        b"sensor init ok",
        b"Ready",
        b"WARN, overrun",
        b"I (324) wifi: connected",
        b"\x1b[0;32mI (5) boot: done\x1b[0m",
        b"==========",
        b"x, no numbers here.",
        b"IP: 192.168.0.1",
        b"Temp\xc3\xa9rature ?",
        b"boot at 2026-01-02 12:00:00",
    ],
)
def test_messages_are_no_names_and_not_wrong(said: bytes) -> None:
    data = b"u,v,w\n1,2,3\n" + said + b"\n4,5,6\n" + said + b"\n" + said + b"\n7,8,9\n"
    decoder, batches = decode(data)
    assert values(batches) == {("u", "v", "w"): [[1, 2, 3], [4, 5, 6], [7, 8, 9]]}
    assert len(texts(batches)) == 3
    assert all("\x1b" not in text for text in texts(batches))
    assert decoder.counts == Counts(bytes=len(data), frames=7)
    before, batches = decode(said + b"\n" + said + b"\n1,2,3\n4,5,6\n")
    assert values(batches) == {("c0", "c1", "c2"): [[1, 2, 3], [4, 5, 6]]}
    assert before.counts.bad == 0


def test_names_that_no_numbers_follow_are_words() -> None:
    decoder, batches = decode(b"one_a,two_b\nthree_c,four_d\n1,2,3\n4,5,6\nu_a,v_b")
    assert texts(batches) == ["one_a,two_b", "three_c,four_d"]
    assert values(batches) == {("c0", "c1", "c2"): [[1, 2, 3], [4, 5, 6]]}
    decoder, batches = decode(b"one_a,two_b\n")
    assert texts(batches) == ["one_a,two_b"]
    assert decoder.counts.frames == 1


@pytest.mark.parametrize(
    "header",
    [b"# u,v_mv,w", b'"u","v_mv","w"', b"u: v_mv: w:", b"u\tv_mv\tw", b"%u;v_mv;w", b"u,v_mv,w,"],
)
def test_headers_as_people_write_them(header: bytes) -> None:
    _, batches = decode(b"\n" + header + b"\n1,2,3\n")
    assert values(batches) == {("u", "v_mv", "w"): [[1, 2, 3]]}


def test_a_separator_at_the_end() -> None:
    decoder, batches = decode(b"\n1,2,\n3,4,\n5,6\n7,8,\n9,,\n")
    (value,) = values(batches).values()
    np.testing.assert_array_equal(value, [[1, 2], [3, 4], [5, 6], [7, 8], [9, np.nan]])
    decoder, batches = decode(b"u,v,w\n1,2,3,\n4,5,\n" + b"6,7,8,\n" * 3)
    (value,) = values(batches).values()
    np.testing.assert_array_equal(value, [[1, 2, 3], [4, 5, np.nan], *[[6, 7, 8]] * 3])
    assert decoder.counts.bad == 0


def test_empty_cells_at_the_end_without_a_header() -> None:
    decoder, batches = decode(b"\n1,2,,\n3,4,,\n5,6,7,8\n9,1,,\n2,3,4,5\n")
    nan = math.nan
    (value,) = values(batches).values()
    expected = [[1, 2, nan, nan], [3, 4, nan, nan], [5, 6, 7, 8], [9, 1, nan, nan], [2, 3, 4, 5]]
    np.testing.assert_array_equal(value, expected)
    assert decoder.counts.bad == 0


def test_cells_without_a_value() -> None:
    data = b"u,v,w\n1,,3\n,nan,NaN\n , ,6\n-nan,inf,ovf\n,,\n"
    decoder, batches = decode(data)
    (value,) = values(batches).values()
    nan, inf = math.nan, math.inf
    np.testing.assert_array_equal(value, [[1, nan, 3], [nan, nan, 6], [nan, inf, inf]])
    # A line in which nothing was measured is right, and no record.
    assert decoder.counts == Counts(bytes=len(data), frames=6)


@pytest.mark.parametrize(
    "wrong",
    [b"1,2", b"1,2,3,4", b"1,2x,3", b"1,2,3\x00", b"1,2,\xb3", b"1,-,3", b"1,2 3,4", b"\x80"],
)
def test_wrong_lines_are_counted_and_left_out(wrong: bytes) -> None:
    data = b"u,v,w\n1,2,3\n" + wrong + b"\n4,5,6\n"
    decoder, batches = decode(data)
    assert values(batches) == {("u", "v", "w"): [[1, 2, 3], [4, 5, 6]]}
    assert texts(batches) == []
    assert decoder.counts == Counts(len(data), frames=3, bad=1, skipped=len(wrong) + 1)


def test_wrong_numbers_among_right_ones_after_half_a_line() -> None:
    decoder, batches = decode(b"5,6\n1,2,3\n1,-,3\n4,5,6\n", columns=("u", "v", "w"))
    assert values(batches) == {("u", "v", "w"): [[1, 2, 3], [4, 5, 6]]}
    assert (decoder.counts.bad, decoder.counts.skipped) == (1, 6)


def test_garbage_before_the_first_line_is_no_error() -> None:
    decoder, batches = decode(b"\xff\xfe\n\x80\x81\x82\n\x00\x01\n" + b"u,v\n1,2\n")
    assert decoder.counts.bad == decoder.counts.skipped == 0
    assert values(batches) == {("u", "v"): [[1, 2]]}


def test_a_wrong_line_does_not_define_the_columns() -> None:
    decoder, batches = decode(b"\n1,2\n1,2,3\n4,5,6\n7,8\n9,10,11\n")
    assert values(batches) == {("c0", "c1", "c2"): [[1, 2, 3], [4, 5, 6], [9, 10, 11]]}
    assert decoder.counts.bad == 1


def test_numbers_without_names_may_become_more() -> None:
    _, batches = decode(b"\n1,2\n3,4\n1,2,3\n4,5,6\n7,8,9\n")
    assert values(batches) == {
        ("c0", "c1"): [[1, 2], [3, 4]],
        ("c0", "c1", "c2"): [[1, 2, 3], [4, 5, 6], [7, 8, 9]],
    }


def test_a_lone_line_is_given_at_the_end() -> None:
    decoder = LineDecoder(Options())
    assert decoder.feed(b"\n1,2\n") == []
    assert values(decoder.finish()) == {("c0", "c1"): [[1, 2]]}


def test_more_numbers_than_names_are_said_once() -> None:
    decoder, _ = decode(b"u,v\n1,2\n" + b"1,2,3\n" * 50 + b"1,2\n")
    assert decoder.counts.bad == 50
    assert decoder.remarks == ["lines of another length are skipped: 2 columns have names"]


def test_the_longest_line() -> None:
    long = b"1," * (MAX_LINE_BYTES // 2)
    for line, bad in (
        (long, 1),
        (long + b"1", 1),
        (b"x" * MAX_LINE_BYTES, 0),
        (b"x" * (MAX_LINE_BYTES + 1), 1),
    ):
        data = b"u,v\n1,2\n" + line + b"\n3,4\n"
        for pieces in ([data], [data[i : i + 1000] for i in range(0, len(data), 1000)]):
            decoder, batches = decode(*pieces)
            assert values(batches) == {("u", "v"): [[1, 2], [3, 4]]}
            assert decoder.counts.bad == bad
            assert decoder.counts.skipped == bad * (len(line) + 1)


def test_memory_is_bounded() -> None:
    decoder = LineDecoder(Options())
    for _ in range(20):
        assert decoder.feed(b"7" * 100_000) == []
    assert len(decoder._tail) <= 2 * MAX_LINE_BYTES
    noise = np.random.default_rng(0)
    for _ in range(20):
        names = "".join(f"n{n}:1\n" for n in noise.integers(0, 10**9, 20))
        decoder.feed(names.encode() + noise.bytes(1000))
    assert len(decoder._pair_tables) <= 256
    assert len(decoder._pair_lines._known) <= 256


def test_after_a_restart_the_columns_stay() -> None:
    decoder = LineDecoder(Options())
    batches = decoder.feed(b"seq,v\n1,1\n2,2\n3,")
    batches += decoder.restart()
    batches += decoder.feed(b"3\n100,4\n101,5\n")
    _, records = only(batches + decoder.finish(), "readings")
    assert records["value"] == [[1], [2], [4], [5]]
    assert decoder.counts.lost == decoder.counts.bad == decoder.counts.skipped == 0


# ---- counters and clocks


@pytest.mark.parametrize(
    ("counts", "lost"),
    [
        ([1, 2, 3, 4], 0),
        ([1, 2, 5, 6], 2),
        ([1, 2, 5, 8, 9], 4),
        ([253, 254, 255, 0, 1], 0),
        ([253, 254, 1, 2], 2),
        ([65534, 65535, 1, 2], 1),
        ([500, 501, 0, 1, 2], 0),
        ([7, 8, 90000, 10, 11], 0),
        ([7, 8, 90000, 90001], 89991),
        ([7, 7, 7, 8, 8], 0),
        ([12345, 3, 4, 5], 0),
    ],
)
def test_what_a_counter_tells(counts: list[int], lost: int) -> None:
    data = "seq,v\n" + "".join(f"{count},1\n" for count in counts)
    for step in (1, 7, len(data)):
        pieces = [data[i : i + step].encode() for i in range(0, len(data), step)]
        decoder, batches = decode(*pieces)
        assert decoder.counts.lost == lost
        assert only(batches, "readings")[1]["sequence"] == counts


def test_a_counter_or_clock_that_cannot_be() -> None:
    data = b"seq,t_ms,v\n1,1,1\n,2,2\n2.5,2,2\n-1,2,2\n3,,3\n3,-1,3\n4,4,4\n"
    decoder, batches = decode(data)
    _, records = only(batches, "readings")
    assert (records["value"], records["tick"]) == ([[1], [4]], [1000, 4000])
    assert (decoder.counts.frames, decoder.counts.bad) == (3, 5)


@pytest.mark.parametrize(
    ("name", "cell", "ticks", "tick"),
    [
        ("t_ms", "12.5", Ticks(1e6), 12500),
        ("millis", "12", Ticks(1e6), 12000),
        ("time_s", "1760000000.123457", Ticks(1e6), 1760000000123457),
        ("Timestamp [us]", "12", Ticks(1e6, 32), 12),
        ("time_ns", "12999", Ticks(1e6), 13),
        ("micros", "4294967295", Ticks(1e6, 32), 4294967295),
        ("t_us", "4294967296", Ticks(1e6), 4294967296),
    ],
)
def test_clocks(name: str, cell: str, ticks: Ticks, tick: int) -> None:
    _, batches = decode(f"{name},v\n{cell},1\n".encode())
    stream, records = only(batches, "readings")
    assert (stream.ticks, records["tick"], stream.names) == (ticks, [tick], ("v",))


@pytest.mark.filterwarnings("error")
def test_infinite_clocks_are_damaged() -> None:
    decoder, batches = decode(b"t_s,a\n1,2\n2,3\n1e308,4\n-1e308,5\n3,6\n")
    _, columns = only(batches, "readings")
    assert np.concatenate([columns["value"]]).ravel().tolist() == [2, 3, 6]
    assert decoder.counts.bad == 2


def test_a_clock_that_counts_beyond_32_bits() -> None:
    data = "t_us,v\n" + "".join(f"{(1 << 32) + k},{k}\n" for k in (-2, -1, 0, -1, 1))
    for step in (3, len(data)):
        _, batches = decode(*(data[i : i + step].encode() for i in range(0, len(data), step)))
        streams = {stream.ticks: of["value"] for stream, of in joined(batches).items()}
        assert streams == {Ticks(1e6, 32): [[-2], [-1]], Ticks(1e6): [[0], [-1], [1]]}


# ---- names and values


@pytest.mark.parametrize(
    "line",
    [
        b"a:1,b_v:2.5",
        b"a: 1, b_v: 2.5",
        b"a:1 b_v:2.5",
        b"a: 1  b_v:2.5 ",
        b"a:1\tb_v:2.5",
        b"a:1;b_v:2.5;",
        b"a : 1 , b_v : 2.5,",
    ],
)
def test_names_and_values(line: bytes) -> None:
    decoder, batches = decode(b"\n" + line + b"\n" + line.replace(b"2.5", b"-7e2") + b"\n")
    assert values(batches) == {("a", "b_v"): [[1, 2.5], [1, -700]]}
    assert decoder.counts.frames == 2


def test_names_tell_what_values_are_there_too() -> None:
    data = b"\nt_ms:5,b1x_ut:1,b1y_ut:2,b1z_ut:3,temp_c:21\nmode:3\n" * 2
    _, batches = decode(data)
    stream, records = only(batches, "magnetometers")
    assert (stream.sensors, records["tick"]) == (1, [5000, 5000])
    assert records["temperature_celsius"] == [21, 21]
    assert values(batches) == {("mode",): [[3], [3]]}


def test_values_that_are_none() -> None:
    decoder, batches = decode(b"\na:1,b:2\na:1.2.3,b:2\na:x1,b:2,c:3\na:1,a:2\na:nan,b:ovf\n")
    (value,) = values(batches).values()
    np.testing.assert_array_equal(value, [[1, 2], [np.nan, np.inf]])
    assert decoder.counts.bad == 2
    assert texts(batches) == ["a:1.2.3,b:2"]


def test_several_lines_of_one_kind_of_record_stay_in_order() -> None:
    """Two sets of names, of which both tell odometry."""
    data = b"".join(
        b"x_m:%d,y_m:0,heading_rad:0\n" % n
        if n % 3
        else b"x_m:%d,y_m:0,heading_rad:0,seq:%d,u:1\n" % (n, n)
        for n in range(1, 30)
    )
    _, batches = decode(b"\n" + data)
    _, odometry = only(batches, "odometry")
    assert odometry["x_m"] == list(range(1, 30))
    assert odometry["end"] == sorted(odometry["end"])
    told = [
        b.sequence.tolist()
        for b in batches
        if b.stream.kind == "odometry" and b.sequence is not None
    ]
    assert [count for counts in told for count in counts] == list(range(3, 30, 3))


@pytest.mark.parametrize(
    ("line", "names", "points", "ticks"),
    [
        (">a:1.5", ("a",), [[1.5]], None),
        (">a:1.5|np", ("a",), [[1.5]], None),
        (">a:1.5|", ("a",), [[1.5]], None),
        (">a:1500:2", ("a",), [[2]], [1500000]),
        (">a:1:2;3:4", ("a",), [[2], [4]], [1000, 3000]),
        (">a:1:2;3:4§km²|np", ("a[km²]",), [[2], [4]], [1000, 3000]),
        (">way:1:2|xy", ("way.x", "way.y"), [[1, 2]], None),
        (">way:1:2:30;3:4:40|xy,np", ("way.x", "way.y"), [[1, 2], [3, 4]], [30000, 40000]),
        (">way:1:2:3§m|xyz", ("way.x[m]", "way.y[m]", "way.z[m]"), [[1, 2, 3]], None),
        (">a,chart:5", ("a",), [[5]], None),
        (">1627551892437:5", ("1627551892437",), [[5]], None),
    ],
)
def test_teleplot(
    line: str, names: tuple[str, ...], points: list[list[float]], ticks: list[int] | None
) -> None:
    decoder, batches = decode(line.encode() + b"\r\n")
    stream, records = only(batches, "readings")
    assert (stream.names, records["value"], records.get("tick")) == (names, points, ticks)
    assert stream.ticks == (Ticks(1e6) if ticks else None)
    assert decoder.counts.frames == 1


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (">state:Turned On|t", "state: Turned On"),
        (">state:1627551892437:Off|t", "state: Off"),
        (">state:1:a;2:b|t", "state: a; b"),
        (">:Hello world", "Hello world"),
        (">state:idle", "state: idle"),
        ("> prompt", "prompt"),
    ],
)
def test_teleplot_text(line: str, text: str) -> None:
    decoder, batches = decode(line.encode() + b"\n")
    assert texts(batches) == [text]
    assert decoder.counts.frames == 1


def test_teleplot_pictures_and_damage() -> None:
    decoder, batches = decode(b">a:1\n>3D|c:S:cube:W:2\n>a:1.2.3\n>a:1:2:3\n>a:-1:2\n")
    assert values(batches) == {("a",): [[1]]}
    counts = decoder.counts
    assert (counts.frames, counts.unknown, counts.bad) == (2, 1, 3)


# ---- what names mean


@pytest.mark.parametrize(
    ("unit", "factor"), [("T", 1), ("mT", 1e-3), ("uT", 1e-6), ("nT", 1e-9), ("gauss", 1e-4)]
)
def test_magnetometers(unit: str, factor: float) -> None:
    names = [f"b{k}{axis}_{unit}" for axis in "zyx" for k in (2, 1)]
    _, batches = decode(",".join(names).encode() + b"\n1,2,3,4,5,6\n,,,,,\n1,2,3,4,5,nan\n")
    stream, records = only(batches, "magnetometers")
    assert stream.sensors == 2
    expected = np.array([[6, 4, 2, 5, 3, 1], [np.nan, 4, 2, 5, 3, 1]]) * factor
    np.testing.assert_allclose(records["b_tesla"], expected)


@pytest.mark.parametrize(
    "names",
    ["b0x_ut,b0y_ut", "b0x_ut,b0y_ut,b0z_ut,b2x_ut,b2y_ut,b2z_ut", "b2x_ut,b2y_ut,b2z_ut"],
)
def test_magnetometers_that_are_not_whole_are_readings(names: str) -> None:
    layout = interpret_columns(names.split(","))
    assert [part.stream.kind for part in layout.parts] == ["readings"]
    assert len(layout.remarks) == 1


def test_what_has_no_unit_is_a_reading_and_said() -> None:
    decoder, batches = decode(b"bx,by,bz,hall_left,x,t\n1,2,3,4,5,6\n")
    assert list(values(batches)) == [("bx", "by", "bz", "hall_left", "x", "t")]
    assert decoder.remarks == ["the unit of column 'bx' is missing: name it bx_ut"]


def test_hall_sensors_and_slower_odometry() -> None:
    data = (
        b"t_ms,hall_right_mt,hall_front_gauss,x_mm,y_cm,heading_deg,battery_v\n"
        b"1,1,10,,,,\n2,2,20,1000,100,180,7.4\n3,3,30,1,,2,\n4,,,,,,\n"
    )
    decoder, batches = decode(data)
    stream, halls = only(batches, "halls")
    assert stream.names == ("front", "right")
    np.testing.assert_allclose(halls["b_tesla"], np.array([[1, 1], [2, 2], [3, 3]]) * 1e-3)
    _, odometry = only(batches, "odometry")
    assert (odometry["x_m"], odometry["y_m"], odometry["tick"]) == ([1], [1], [2000])
    assert odometry["heading_rad"] == [pytest.approx(math.pi)]
    assert values(batches) == {("battery_v",): [[7.4]]}
    assert decoder.counts.frames == 5


def test_hall_sensors_of_other_names_stay_as_they_come() -> None:
    stream = interpret_columns(["hall_b_mt", "hall_a_mt"]).parts[0].stream
    assert (stream.sensors, stream.names) == (2, ("b", "a"))


def test_infinite_fields_are_none() -> None:
    _, batches = decode(b"bx_ut,by_ut,bz_ut\n1,inf,ovf\n")
    np.testing.assert_array_equal(
        only(batches, "magnetometers")[1]["b_tesla"], [[1e-6, np.nan, np.nan]]
    )


# ---- any pieces

LINES = st.sampled_from(
    [
        b"t_us,b0x_ut,b0y_ut,b0z_ut",
        b"1,2,3,4",
        b"5,6,7,8",
        b"9,,nan,1e-3",
        b"4294967296,1,2,3",
        b"1,2,3,4,",
        b"-1,0,0,0",
        b"1,2,3",
        b"a,b,c",
        b"1;2;3",
        b"1 2 3 4",
        b"1.5",
        b"2.5",
        b"word",
        b"two words",
        b"1,-,3,4",
        b"a,n,e,N",
        b"nan,nan,nan",
        b"a:1,b:2",
        b"a:3,b:4",
        b"a:5",
        b"a: b:",
        b"bx_ut:1,by_ut:2,bz_ut:3",
        b">a:1",
        b">a:2:3",
        b">a:2:3;4:5\xc2\xa7V",
        b">a:t|t",
        b"\x1b[0mx\x1b[1m",
        b"\xff\x00\x01",
        b"caf\xc3\xa9",
        b"",
        b" ",
        b"seq,v",
        b"1,1",
        b"2,1",
        b"9,1",
        b"x" * 300,
    ]
)
TEXT = st.lists(
    st.tuples(
        st.one_of(LINES, LINES, st.binary(max_size=12)), st.sampled_from([b"\n", b"\r\n", b"\r"])
    ),
    max_size=40,
).map(lambda lines: b"".join(line + end for line, end in lines))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    data=TEXT,
    cuts=st.lists(st.integers(0, 600), max_size=20),
    named=st.booleans(),
    piece=st.sampled_from([7, 50, 1 << 16]),
)
@example(data=b"u,v\r\n1,2\r\n3,4\r", cuts=[4, 5, 9, 10], named=False, piece=50)
@example(data=b"\n1,2\n3,4\n1,-\n", cuts=[9], named=False, piece=50)
def test_any_pieces_give_the_same(data: bytes, cuts: list[int], named: bool, piece: int) -> None:
    """Nor does it matter how many bytes and lines are looked at together."""
    columns = ("t_us", "u", "v", "w") if named else ()
    whole, expected = decode(data, columns=columns)
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    pieces = [data[a:b] for a, b in pairwise(edges)]
    bytewise = [data[i : i + 1] for i in range(len(data))]
    for split in (pieces, bytewise, [data]):
        with patch.object(lines, "PIECE_BYTES", piece), patch.object(lines, "FIRST_SPAN_LINES", 2):
            decoder, batches = decode(*split, columns=columns)
        assert same(batches, expected)
        assert decoder.counts == whole.counts
        assert decoder.remarks == whole.remarks
    for records in joined(expected).values():
        assert records["end"] == sorted(records["end"])
        assert all(0 < end <= len(data) for end in records["end"])
    assert whole.counts.skipped <= len(data)


@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=3000))
def test_noise_does_no_harm(data: bytes) -> None:
    _, batches = decode(data)
    for batch in batches:
        assert len(batch) > 0
        assert all(len(column) == len(batch) for column in batch.columns.values())


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    damage=st.lists(
        st.tuples(st.integers(0, 10**6), st.sampled_from("lfa")), min_size=1, max_size=5
    ),
)
def test_damage_costs_the_lines_that_it_hits(seed: int, damage: list[tuple[int, str]]) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.integers(100, 999, (200, 3)) / 8
    data = bytearray(b"u_v,v_v,w_v\n")
    starts = []
    for row in rows.tolist():
        starts.append(len(data))
        data += b"%.3f,%.3f,%.3f\n" % tuple(row)
    hit = set()
    for place, how in sorted(damage, reverse=True):
        place = starts[0] + place % (len(data) - starts[0])
        number = int(np.searchsorted(starts, place, "right")) - 1
        hit |= {number, number + 1} if data[place] == 10 or how != "f" else {number}
        hit |= {number + 1} if how == "a" else set()
        if how == "l":
            del data[place]
        elif how == "f":
            data[place] ^= 1 << int(rng.integers(8))
        else:
            data[place:place] = rng.bytes(1)
        starts = [s + (s > place) * {"l": -1, "f": 0, "a": 1}[how] for s in starts]
    _, batches = decode(bytes(data))
    found = {tuple(row) for rows in values(batches).values() for row in rows}
    for number, row in enumerate(rows.tolist()):
        assert number in hit or tuple(row) in found
    assert sum(tuple(row) not in set(map(tuple, rows.tolist())) for row in found) <= 2 * len(hit)


# ---- a recording as lines


def recording() -> Recording:
    rng = np.random.default_rng(3)
    sensor_ns = 1_760_000_000_000_000_000 + np.arange(50) * 10_000_000
    pose_ns = sensor_ns[::5] + 3_000_000
    heading = np.linspace(0, 3, len(pose_ns))
    place = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(pose_ns))])
    field = rng.normal(0, 50e-6, (50, 3, 3))
    field[7, 1] = np.nan
    unknown = np.full((len(pose_ns), 6, 6), np.nan)
    quaternion = quaternion_from_heading(heading)
    sensors = HallSensors()
    return Recording(
        samples=[Samples("bar", SensorArray(bar(3, 0.04)), sensor_ns, field)],
        halls=[HallSamples("robot", sensors, sensor_ns[::2], rng.normal(0, 1e-3, (25, 4)))],
        odometry=[Trajectory("robot", "odometry", pose_ns, place, quaternion, unknown)],
    )


def test_a_recording_comes_back() -> None:
    said = recording()
    frames = list(find_device("lines").encode(said))
    times = [time_ns for time_ns, _ in frames]
    assert times == sorted(times)
    decoder, batches = decode(*(line for _, line in frames))
    start_ns = times[0]
    samples, halls, odometry = said.samples[0], said.halls[0], said.odometry[0]
    _, found = only(batches, "magnetometers")
    np.testing.assert_allclose(
        found["b_tesla"], samples.field_t.reshape(50, 9), rtol=0, atol=0.6e-10
    )
    np.testing.assert_array_equal(found["tick"], (samples.time_ns - start_ns) // 1000)
    stream, found = only(batches, "halls")
    assert stream.names == halls.sensors.names
    np.testing.assert_allclose(found["b_tesla"], halls.field_t, rtol=0, atol=0.6e-10)
    np.testing.assert_array_equal(found["tick"], (halls.time_ns - start_ns) // 1000)
    _, found = only(batches, "odometry")
    np.testing.assert_allclose(found["x_m"], odometry.position[:, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["heading_rad"], np.linspace(0, 3, 10), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found["tick"], (odometry.time_ns - start_ns) // 1000)
    assert decoder.counts.bad == 0
    assert decoder.counts.frames == len(frames)


def refused() -> Iterator[tuple[Recording, str]]:
    said = recording()
    yield Recording(), "no magnetometers, hall sensors or odometry"
    yield Recording(samples=[*said.samples, *said.samples]), "samples of 2 devices"
    yield Recording(odometry=[*said.odometry, *said.odometry]), "odometry of 2 devices"


@pytest.mark.parametrize(("said", "words"), list(refused()))
def test_what_lines_do_not_tell(said: Recording, words: str) -> None:
    with pytest.raises(InputError, match=words):
        find_device("lines").encode(said)
