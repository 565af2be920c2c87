"""Delimited text: blocks parsed at once equal cells parsed one by one, and errors name the line."""

from __future__ import annotations

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError
from locatk.formats.tables import delimited
from locatk.formats.tables.delimited import parse_numbers, read_number_rows, read_table

CELLS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.sampled_from(["+1", ".5", "5.", "-0.0", "1e5", "1E-300", "4.9e-324", "1e400", "1e-400"]),
    st.text("0123456789.eE+-", max_size=6),
)


def by_cell(text: str, separator: str) -> list[list[float]] | None:
    try:
        return [[float(cell) for cell in line.split(separator)] for line in text.split("\n")]
    except ValueError:
        return None


@pytest.mark.slow
@pytest.mark.parametrize("with_arrow", [False, True])
@pytest.mark.parametrize("separator", [",", " "])
@settings(max_examples=50, deadline=None)  # pyarrow is imported in the first example
@given(rows=st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1, max_size=5))
@example(rows=[("+1", "2", "3")])
@example(rows=[("1e400", "2", "3")])
@example(rows=[("1-2", "2", "3")])
@example(rows=[("1", "", "3")])
def test_a_block_equals_its_cells(
    separator: str, with_arrow: bool, rows: list[tuple[str, str, str]]
) -> None:
    if with_arrow:
        pytest.importorskip("pyarrow")
    text = "\n".join(map(separator.join, rows))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(delimited, "MIN_ARROW_BYTES", 0 if with_arrow else 1 << 60)
        parsed = parse_numbers(text.encode(), 3, separator)
    expected = by_cell(text, separator)
    if parsed is None:
        return
    assert expected is not None
    assert parsed.values.tolist() == expected
    assert np.array_equal(np.signbit(parsed.values), np.signbit(expected))
    cells = [
        text.encode()[start:stop].decode()
        for start, stop in zip(parsed.start.ravel(), parsed.stop.ravel(), strict=True)
    ]
    assert cells == [cell for row in rows for cell in row]


@pytest.mark.parametrize("with_arrow", [False, True])
def test_ordinary_numbers_are_parsed_at_once(
    monkeypatch: pytest.MonkeyPatch, with_arrow: bool
) -> None:
    if with_arrow:
        pytest.importorskip("pyarrow")
    monkeypatch.setattr(delimited, "MIN_ARROW_BYTES", 0 if with_arrow else 1 << 60)
    values = np.random.default_rng(1).normal(size=(50, 4)) * 10.0 ** np.arange(-6, 6, 3)
    block = "".join(",".join(map(repr, row)) + "\n" for row in values.tolist()).encode()
    parsed = parse_numbers(block, 4, ",")
    assert parsed is not None
    assert np.array_equal(parsed.values, values)
    if with_arrow:
        assert np.array_equal(delimited._parse_with_arrow(block, 4, ","), values)


@pytest.mark.parametrize(
    "text",
    [
        "1,2\n3\n",
        "1,2,3\n",
        "1,2,3,4\n",
        "1\n2\n",
        "1,2\n\n3,4\n",
        "1,,2\n",
        "1,2\n3,x\n",
        "nan,1\n",
        "1, 2\n",
        "",
    ],
)
def test_irregular_blocks_are_refused(text: str) -> None:
    assert parse_numbers(text.encode(), 2, ",") is None


@pytest.mark.parametrize("text", ["# c\n1.5 2\n2.5 3\n", "1.5 2\n\n2.5  3\n", "1.5\t2\n2.5 3"])
def test_rows_of_numbers(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rows.txt"
    path.write_text(text)
    table = read_number_rows(path, ("t", "x"), hint="t x", time_column="t")
    assert table.epoch_times_ns("t").tolist() == [1_500_000_000, 2_500_000_000]
    assert table.floats("x").tolist() == [2, 3]
    lines = [k for k, line in enumerate(text.split("\n"), 1) if line and line[0] != "#"]
    assert list(table.lines) == lines
    for read in (lambda: table.floats("x", high=2), lambda: table.integers("x", 3, 9)):
        with pytest.raises(InputError, match="in column 'x' should be"):
            read()


def test_a_number_that_overflows_is_quoted_as_written(tmp_path: Path) -> None:
    path = tmp_path / "rows.txt"
    path.write_text("1.5 2\n2.5 1e400\n")
    table = read_number_rows(path, ("t", "x"), hint="t x", time_column="t")
    with pytest.raises(InputError, match=r"rows\.txt:2: 1e400 in column 'x' should be a finite "):
        table.floats("x")


def test_missing_cells(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("A,b\n1,\n NaN ,2\n\n3,4\n")
    table = read_table(path)
    assert list(table.columns) == ["a", "b"]
    assert table.lines == [2, 3, 5]
    np.testing.assert_array_equal(table.floats("a", allow_missing=True), [1, np.nan, 3])
    with pytest.raises(InputError, match="NaN in column 'a' should be a finite number") as error:
        table.floats("a")
    assert error.value.where == 3
    with pytest.raises(InputError, match="empty cell in column 'b'"):
        table.floats("b")
    with pytest.raises(FormatError, match="columns 'c', 'd' are missing"):
        table.require("a", "c", "d")


def test_numpy_accepts_what_the_check_lets_pass() -> None:
    """The check of a block relies on loadtxt refusing cells such as 1-2 or 1.2.3."""
    for cell in ("1-2", "1.2.3", "e", "+-1", "1e"):
        with pytest.raises(ValueError, match="could not convert"):
            np.loadtxt(io.BytesIO(f"{cell},1\n".encode()), delimiter=",", comments=None)


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(st.integers(0, 2**63 - 1), st.floats(-1e3, 1e3, allow_nan=False)),
        min_size=1,
        max_size=5,
    )
)
def test_times_are_equal_on_both_paths(rows: list[tuple[int, float]]) -> None:
    text = "".join(f"{ns // 10**9}.{ns % 10**9:09d} {x!r}\n" for ns, x in rows)
    tables = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "poses.txt"
        for tail in ("", "# a comment behind the rows\n"):  # which is not read at once
            path.write_text(text + tail)
            tables.append(read_number_rows(path, ("t", "x"), hint="", time_column="t"))
    at_once, by_word = tables
    assert not by_word.numbers
    for name in ("t", "x"):
        assert at_once.floats(name).tolist() == by_word.floats(name).tolist()
    times = [table.epoch_times_ns("t").tolist() for table in tables]
    assert times[0] == times[1] == [ns for ns, _ in rows]


def test_zero_bytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_bytes(b"1.5 2\n2.5 3\0\0\0\n")
    with pytest.raises(FormatError, match="zero bytes in a text file") as caught:
        read_number_rows(path, ("t", "x"), hint="", time_column="t")
    assert caught.value.where == 2


def test_tables_of_many_cells_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("a,b\n" + "1,2\n" * 3)
    monkeypatch.setattr(delimited, "MAX_CELLS", 12)
    assert len(read_table(path)) == 3
    path.write_text("a,b\n" + "1,2\n" * 4)
    with pytest.raises(FormatError, match="more than 12 cells") as caught:
        read_table(path)
    assert caught.value.where == 5
