"""CSV exports of Logic 1 and 2: the edges of one column, whatever else changes beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import LocatkError
from locatk.formats.importers.saleae import csv_export as saleae_csv
from locatk.formats.importers.saleae.digital_lines import MIN_RUNS, estimate_resolution
from locatk.formats.importers.saleae.recording import read_capture, read_light

LOGIC_1 = ("Time[s], {}, {}", "{:.15f}", ", ")
LOGIC_2 = ("Time [s],{},{}", "{:.9f}", ",")


def rows_of(
    edges: Sequence[Sequence[int]], levels: Sequence[int], start: int
) -> list[tuple[int, tuple[int, ...]]]:
    """(nanosecond, level of each line) at the start and wherever a line changes."""
    rows = [(start, tuple(levels))]
    for tick in sorted(set().union(*edges)):
        rows.append(
            (
                tick,
                tuple(
                    level ^ (sum(edge <= tick for edge in line) & 1)
                    for line, level in zip(edges, levels, strict=True)
                ),
            )
        )
    return rows


def write(
    path: Path,
    rows: Sequence[tuple[int, Sequence[object]]],
    style: tuple[str, str, str] = LOGIC_2,
    names: Sequence[str] = ("Channel 0", "Channel 1"),
    end: str = "\n",
) -> Path:
    head, form, comma = style
    lines = [head.format(*names)]
    lines += [comma.join([form.format(ns / 1e9), *map(str, levels)]) for ns, levels in rows]
    path.write_bytes((end.join(lines) + end).encode())
    return path


def light(rate_mhz: float = 100, bursts: int = 20, seed: int = 3) -> np.ndarray:
    """Nanoseconds of edges of 6 Mbit/s biphase-mark code in bursts, sampled; its clock is
    another one than the analyser's."""
    noise, ns, at = np.random.default_rng(seed), [], 40_000.0
    for _ in range(bursts):
        at += noise.uniform(100_000, 101_000)
        for bit in noise.integers(0, 2, 60):
            ns += [at + 1000 / 12, at + 1000 / 6] if bit else [at + 1000 / 6]
            at += 1000 / 6
    samples = np.unique(np.round(np.array(ns) * rate_mhz / 1000))
    return np.round(samples * 1000 / rate_mhz).astype(np.int64)


def single(ticks: np.ndarray, level: int = 0) -> list[tuple[int, tuple[int, ...]]]:
    """Rows of one line beside one that never changes."""
    levels = level ^ (np.arange(len(ticks) + 1) & 1)
    return list(zip([0, *ticks.tolist()], zip(levels, levels * 0, strict=True), strict=True))


def fails(
    path: Path, words: str, where: int | None = None, channels: Sequence[str | int] = ()
) -> LocatkError:
    with pytest.raises(LocatkError) as caught:
        read_light(path, channels)
    error = caught.value
    assert words in error.message
    assert error.where == where
    assert str(path) in str(error)
    assert "\n" not in str(error)
    assert error.hint
    return error


# ---- every edge


ascending = st.lists(st.integers(1, 10**8), min_size=1, max_size=25).map(np.cumsum)


@pytest.mark.slow
@settings(max_examples=120, deadline=None)
@given(
    st.tuples(ascending, ascending),
    st.tuples(st.integers(0, 1), st.integers(0, 1)),
    st.integers(-(10**13), 10**13),
    st.sampled_from([LOGIC_1, LOGIC_2]),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from([20, 100, 1 << 22]),
)
def test_the_edges_of_each_column(
    tmp_path_factory: pytest.TempPathFactory,
    ticks: tuple[np.ndarray, np.ndarray],
    levels: tuple[int, int],
    start: int,
    style: tuple[str, str, str],
    end: str,
    block: int,
) -> None:
    edges = [(start + line).tolist() for line in ticks]
    rows = rows_of(edges, levels, start)
    path = write(tmp_path_factory.mktemp("csv") / "run.csv", rows, style, end=end)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(saleae_csv, "BLOCK_BYTES", block)
        read = read_light(path, [1, 0])
    for line, want, level in zip(read, edges[::-1], levels[::-1], strict=True):
        assert line.tick.tolist() == want
        assert line.rises == (level == 0)
        assert line.end_tick == rows[-1][0] + 1
        assert (line.rate_hz, line.start_ns) == (1e9, 0)


@settings(max_examples=60, deadline=None)
@given(ascending, st.integers(0, 1), st.sampled_from(["Z", "", "+00:00", "-07:00", "+0530"]))
def test_times_of_day(
    tmp_path_factory: pytest.TempPathFactory, ticks: np.ndarray, level: int, zone: str
) -> None:
    start = 1_710_177_920_662_792_200
    offset = {"-07:00": -420, "+0530": 330}.get(zone, 0) * 60_000_000_000
    stamps = start + offset + np.array([0, *ticks])
    lines = ["Time [s],Channel 4"]
    for k, stamp in enumerate(stamps):
        lines.append(f"{np.datetime64(int(stamp), 'ns')}{zone},{level ^ k & 1}")
    path = tmp_path_factory.mktemp("csv") / "digital.csv"
    path.write_text("\n".join(lines) + "\n")
    (read,) = read_light(path, [4])
    assert read.tick.tolist() == ticks.tolist()
    assert read.start_ns == start
    assert read.rises == (level == 0)
    assert read.end_tick == ticks[-1] + 1


def test_rows_without_data_are_no_edges(tmp_path: Path) -> None:
    states = ["X1", "01", "00", "1X", "XX", "11", "X0", "00", "XX"]
    path = write(tmp_path / "run.csv", [(k * 1000, tuple(s)) for k, s in enumerate(states)])
    first, second = read_light(path, ["Channel 0", "Channel 1"])
    # 1 before the gap and after it is no edge; 1 before and 0 after is one, where data begin.
    assert first.tick.tolist() == [3000, 7000]
    assert first.rises
    assert second.tick.tolist() == [2000, 5000, 6000]
    assert not second.rises


def test_both_ways_of_reading_agree(tmp_path: Path) -> None:
    """A blank line has the whole block read row by row."""
    ticks = light(rate_mhz=24)
    path = write(tmp_path / "run.csv", single(ticks), LOGIC_1)
    (regular,) = read_light(path)
    path.write_text(path.read_text() + "\n")
    (any_,) = read_light(path)
    assert regular.tick.tolist() == any_.tick.tolist() == ticks.tolist()


# ---- rates


@pytest.mark.slow
@pytest.mark.parametrize(
    "mhz", [24, 25, 30, 32, 40, 48, 50, 62.5, 80, 100, 125, 160, 200, 250, 500]
)
def test_the_resolution_shows_in_the_times(tmp_path: Path, mhz: float) -> None:
    ticks = light(mhz)
    (edges,) = read_light(write(tmp_path / "run.csv", single(ticks)))
    assert edges.tick.tolist() == ticks.tolist()
    assert edges.resolution_hz == pytest.approx(mhz * 1e6)
    shifted = estimate_resolution(ticks[5:] - 77)  # times relative to a marker
    assert shifted == pytest.approx(mhz * 1e6)


def test_the_resolution_of_few_or_random_times() -> None:
    assert estimate_resolution(np.arange(MIN_RUNS - 1) * 1000) == 1e9
    random = np.cumsum(np.random.default_rng(1).integers(50, 90, 500))
    assert estimate_resolution(random) == 1e9
    assert estimate_resolution(random * 2) == 5e8


@pytest.mark.parametrize("channels", [(), (0,)])
@pytest.mark.parametrize("mhz", [8, 10, 12, 16, 20])
def test_a_rate_too_low_is_refused(tmp_path: Path, mhz: int, channels: tuple[int, ...]) -> None:
    path = write(tmp_path / "run.csv", single(light(mhz, bursts=60)))
    error = fails(path, f"sampled at {mhz} MHz", channels=channels)
    assert "24 MHz or more" in str(error.hint)


# ---- which column


def test_light_is_chosen_by_what_is_on_it(tmp_path: Path) -> None:
    ticks = light(bursts=6)
    bursts = np.flatnonzero(np.diff(ticks, prepend=-100_000) > 5000)
    envelope = sorted({*(ticks[bursts] - 200), *(ticks[np.roll(bursts, -1) - 1] + 200)})
    rows = rows_of([envelope, ticks.tolist()], (1, 0), 0)
    path = write(tmp_path / "run.csv", rows, names=("Data", "Envelope"))
    capture = read_capture(path)
    assert capture.names == ("'Envelope'",)
    assert capture.edges[0].tick.tolist() == ticks.tolist()
    facts = capture.facts()
    assert facts["left out"] == "'Data'"
    assert facts["resolution"] == "100 MHz"
    assert "start" not in facts
    assert str(len(ticks)) in facts["light"]


def test_no_light(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", single(np.arange(1, 300) * 40))
    error = fails(path, "no light")
    assert "'Channel 0': 299 edges" in str(error.hint)
    assert "'Channel 1': 0 edges" in str(error.hint)
    assert fails(path, "no line 'Channel 7'", channels=["Channel 7"]).hint == (
        "The capture has 'Channel 0', 'Channel 1'"
    )
    write(path, single(light()), names=("A", "A"))
    fails(path, "several lines 'a'", channels=["a"])
    assert len(read_light(path)) == 1


# ---- damage


@pytest.mark.parametrize(
    ("text", "words", "where"),
    [
        ("", "empty file", None),
        ("Time [s],Channel 0\n", "a header and no rows", 1),
        ("Time [s]\n0.1\n", "a table of 1 columns", 1),
        ("Start,Data\n0.1,0\n", "neither a capture", 1),
        ("{}\n", "neither a capture", 1),
        ('"Time [s],Channel 0\n0.1,0\n', "neither a capture", 1),
        ("Time [s],A\n0.1,0\n0.1,1\n", "does not ascend", 3),
        ("Time [s],A\n0.2,0\n\n0.1,1\n", "does not ascend", 4),
        ("Time [s],A\n0.1,0\nnan,1\n", "'nan' is not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n1e9,1\n", "'1e9' is not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n1e999,1\n", "not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n1_0,1\n", "not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n1.2.3,1\n", "not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n,1\n", "'' is not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n0.2,nan\n", "'nan' instead of a level", 3),
        ("Time [s],A\n0.1,0\n0.2,3.3\n", "'3.3' instead of a level", 3),
        ("Time [s],A\n0.1,0\n0.2,2\n", "'2' instead of a level", 3),
        ("Time [s],A\n0.1,0\n0.2,01\n", "'01' instead of a level", 3),
        ("Time [s],A\n0.1,0\n0.2,\n", "'' instead of a level", 3),
        ("Time [s],A\n0.1,0\n0.2\n", "1 cell in a row of 2", 3),
        ("Time [s],A\n0.1,0\n0.2,1,1\n", "3 cells in a row of 2", 3),
        ("Time [s],A\n0.1 2,0\n,1\n", "not a number of seconds", 2),
        ("Time [s],A\n2024-03-11T17:25:20Z,0\n0.2,1\n", "not a time in ISO 8601", 3),
        ("Time [s],A\n2024-02-30T17:25:20Z,0\n", "does not exist", 2),
        ("Time [s],A\n0.1,0\n2024-03-11T17:25:20Z,1\n", "not a number of seconds", 3),
        ("Time [s],A\n0.1,0\n0.2,\0\n", "instead of a level", 3),
        ("Time [s]," + "A," * 2000 + "A\n0.1,0\n", "a table of 2002 columns", 1),
        ("Time [s],A\n" + "0" * 200_000, "a line of more than", None),
    ],
)
@pytest.mark.parametrize("block", [10, 1 << 22])
def test_a_damaged_table_is_refused_by_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    text: str,
    words: str,
    where: int | None,
    block: int,
) -> None:
    monkeypatch.setattr(saleae_csv, "BLOCK_BYTES", block)
    path = tmp_path / "run.csv"
    path.write_text(text)
    if "more than" in words and block > 10:
        words, where = "1 cell in a row of 2", 2  # the file ends before it is too long
    fails(path, words, where, ["A"])


def test_bytes_that_are_not_text(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(b"Time [s],A\n0.1,0\n0.2,\xff\n")
    fails(path, "not text", 3, ["A"])
    path.write_text("Time [s],A\n0.1,0\n0.2,1\n", encoding="utf-16")
    fails(path, "neither a capture", 1)
    path.write_text("Time [s],A\n0.1,0\n0.2,1\n", encoding="utf-8-sig")
    assert read_light(path, ["A"])[0].tick.tolist() == [200_000_000]


TABLES = [
    b"Time[s], Channel 0, Channel 1\n-0.5, 0, 1\n0.0000001, 1, 1\n0.0000002, 0, 0\n",
    b"Time [s],Channel 0\n2024-03-11T17:25:20.5Z,0\n2024-03-11T17:25:21.5Z,1\n",
]


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damage_raises_nothing_but_what_it_should(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    whole = bytearray(data.draw(st.sampled_from(TABLES)))
    letters = st.sampled_from(list(b'0129-+.eXTZ, \n\r"\0\xff'))
    for _ in range(data.draw(st.integers(0, 5))):
        at = data.draw(st.integers(0, len(whole)))
        whole[at : at + data.draw(st.integers(0, 2))] = [data.draw(letters)]
    path = tmp_path_factory.mktemp("fuzz") / "run.csv"
    path.write_bytes(whole)
    try:
        (edges,) = read_light(path, [0])
    except LocatkError as error:
        caught = error
    else:
        assert np.all(np.diff(edges.tick) > 0)
        assert not len(edges) or edges.tick[-1] < edges.end_tick
        return
    assert "\n" not in str(caught)
    assert caught.hint


# ---- published captures


@pytest.mark.parametrize(
    ("name", "line", "edges", "mhz", "first", "end"),
    [
        ("take1", "'Channel 0'", 14_286, 100, 2_552_830, 1_002_392_041),
        ("about_4m", "'Channel 4'", 7_440, 500, -136, 999_811_515),
    ],
)
def test_published_captures(
    data: Path, name: str, line: str, edges: int, mhz: float, first: int, end: int
) -> None:
    capture = read_capture(data / "lighthouse" / "fpga" / f"{name}.csv")
    assert capture.names == (line,)
    (read,) = capture.edges
    assert len(read) == edges
    assert read.resolution_hz == mhz * 1e6
    assert (read.tick[0], read.end_tick, read.rises) == (first, end, True)
    # The same, by the plainest loop.
    ticks, before = [], None
    for row in (data / "lighthouse" / "fpga" / f"{name}.csv").read_text().splitlines()[1:]:
        seconds, level, _ = row.split(", ")
        if before is not None and level != before:
            ticks.append(round(float(seconds) * 1e9))
        before = level
    assert read.tick.tolist() == ticks
