"""Files that name the columns of a table: as printed, and with mistakes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError
from locatk.formats.importers.any_table.columns import guess_columns
from locatk.formats.importers.any_table.mapping import (
    TableMapping,
    dumps_mapping,
    read_mapping,
)
from locatk.formats.sessions import field_samples
from locatk.formats.sessions.reader import Session
from locatk.formats.tables.clocks import parse_clock
from locatk.formats.tables.delimited import Table

KEYS = ["t", "device", "b0x", "b0y", "b0z", "front", "heading", "count0_ch4", "ax", "channel"]


@settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(
    headers=st.lists(
        st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12)
        .map(lambda name: name.strip().lower())
        .filter(lambda name: name and name == name.strip().lower()),
        min_size=len(KEYS),
        max_size=len(KEYS),
        unique=True,
    ),
    units=st.permutations(["ut", "rad", "m/s2"]),
    clock=st.sampled_from([None, "us, 32 bit", "24 MHz, 24 bit"]),
)
def test_what_is_printed_names_the_same_columns(
    headers: list[str], units: list[str], clock: str | None, tmp_path: Path
) -> None:
    """Any header, also with separators, quotes and equal signs, is found again."""
    columns = dict(zip(KEYS, headers, strict=True))
    table = Table(tmp_path / "log.csv", {name: ["2.5"] for name in headers}, [2])
    stated = TableMapping(columns, tuple(units), None if clock is None else parse_clock(clock))
    guess = guess_columns(table, columns, units, clock=stated.clock)
    path = tmp_path / "lab.toml"
    path.write_text(dumps_mapping(guess, stated), encoding="utf-8")
    read = read_mapping(path)
    assert (read.columns, read.units, read.clock) == (columns, stated.units, stated.clock)
    assert guess_columns(table, read.columns, read.units, clock=read.clock) == guess


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ('clocks = "us"', "lab.toml:clocks: unknown key 'clocks'", "Did you mean clock?"),
        ('b0x = "mag"', "lab.toml:b0x: unknown key 'b0x'", "below the line [columns]"),
        ('[columns]\nb0q = "m"', "lab.toml:columns: unknown column key 'b0q'", "Keys: t, "),
        ('[columns]\nheadin = "m"', "unknown column key 'headin'", "Did you mean heading?"),
        ("[columns]\nt = 3", "lab.toml:columns.t: expected the header of a column", ""),
        ('[columns]\nt = " "', "not a blank string", ""),
        ('columns = "t"', "lab.toml:columns: expected a table, not a string", ""),
        ('units = ["furlong"]', "lab.toml:units: unknown unit 'furlong'", "Use one of"),
        ('units = ["ms", "s"]', "lab.toml:units: two units of time", ""),
        ("units = 3", "lab.toml:units: expected a list of units", ""),
        ('clock = "us, 3 bit"', "lab.toml:clock: a counter of 3 bits", "8 to 64"),
        ("clock = 32", "lab.toml:clock: expected a clock", ""),
        ("clock = ", "not valid TOML", ""),
    ],
)
def test_mistakes_are_named(text: str, message: str, hint: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    with pytest.raises(ArtifactError) as error:
        read_mapping(path)
    assert message in str(error.value)
    assert hint in (error.value.hint or "")
    assert "\n" not in f"{error.value}{error.value.hint}"


def test_options_override_a_mapping() -> None:
    lab = TableMapping({"t": "a", "b0x": "b"}, ("ms", "ut"), parse_clock("ms"))
    merged = lab.merge(TableMapping({"t": "c", "b1x": "B"}, ("nt",), None))
    # A header that an option gives another key loses the one of the file.
    assert merged.columns == {"t": "c", "b1x": "B"}
    assert merged.units == ("ms", "nt")
    assert merged.clock == lab.clock


# ---- on the command line


def test_the_recognised_columns_are_a_mapping(locatk: Callable[..., Any], tmp_path: Path) -> None:
    log, lab = tmp_path / "log.csv", tmp_path / "lab.toml"
    log.write_text(
        "Zeit;Mag0 X;Mag0 Y;Mag0 Z\n4294967;20;1;40\n4294967,2;21;2;41\n0,1;22;3;42\n0,2;23;4;43\n"
    )
    options = ("--columns", "t=Zeit", "--units", "ut", "--clock", "ms, 32 bit of us")
    first, again = tmp_path / "first.mcap", tmp_path / "again.mcap"
    result = locatk("import", "table", log, *options, "-o", first)
    assert result.exit_code == 0, result.stderr
    printed = result.stderr.split("--mapping):\n")[1].split("\n\n4 samples")[0]
    assert printed == (
        'clock = "ms, 32 bit of us"\nunits = ["ut"]\n\n[columns]\nt = "zeit"\n'
        'b0x = "mag0 x"\nb0y = "mag0 y"\nb0z = "mag0 z"'
    )
    lab.write_text(printed)
    result = locatk("import", "table", log, "--mapping", lab, "-o", again)
    assert result.exit_code == 0, result.stderr
    samples = [field_samples.read_magnetometers(Session.open(p))[0] for p in (first, again)]
    assert samples[0].time_ns.tolist() == samples[1].time_ns.tolist()
    assert (samples[0].time_ns - samples[0].time_ns[0]).tolist() == [0, 200000, 396000, 496000]
    assert samples[0].field_t.tolist() == samples[1].field_t.tolist()


@pytest.mark.parametrize(
    ("options", "problem", "hint"),
    [
        ((), "log.csv:4: the time goes backwards by 4.29497e+06 s", '--clock "ms, 32 bit"'),
        (("--clock", "parsec"), "'parsec' is not a clock", '"us, 32 bit"'),
        (("--columns", "b0w=bx"), "unknown column key 'b0w'", "Keys: "),
        (("--columns", "b0x=none"), "column 'none' is missing", "The header has"),
    ],
)
def test_problems_are_one_line_with_a_remedy(
    options: tuple[str, ...],
    problem: str,
    hint: str,
    locatk: Callable[..., Any],
    tmp_path: Path,
) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t_ms,bx_ut,by_ut,bz_ut\n4294967288,1,2,43\n4294967292,1,3,43\n0,3,4,43\n")
    result = locatk("import", "table", log, *options, "-o", tmp_path / "run.mcap")
    assert result.exit_code == 1
    line = result.stderr.splitlines()[-1]
    assert line.startswith("Error: ")
    assert problem in line
    assert hint in line
    assert not (tmp_path / "run.mcap").exists()
