"""Names of columns: units, declared kinds, and the columns that a reader needs."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.formats.tables.delimited import read_table
from locatk.formats.tables.quantities import (
    UNITS,
    ColumnKind,
    find_columns,
    match_column,
    split_unit,
)

KINDS = (
    ColumnKind("sequence", re.compile("seq")),
    ColumnKind("field", re.compile("b([xyz])"), ("field",)),
    ColumnKind("position", re.compile("(x|y)"), ("length",)),
)

EVERY_UNIT = [unit for units in UNITS.values() for unit in units]


@pytest.mark.parametrize(
    ("name", "bare", "unit"),
    [
        ("b0x_ut", "b0x", "ut"),
        ("B0X (uT)", "b0x", "ut"),
        ("b0x[\u00b5T]", "b0x", "ut"),
        ("heading [deg]", "heading", "deg"),
        ("hall_left", "hall_left", ""),
        ("x", "x", ""),
        ("battery_v", "battery", "v"),
        ("_m", "_m", ""),
    ],
)
def test_units_in_names(name: str, bare: str, unit: str) -> None:
    assert split_unit(name) == (bare, unit)


@given(
    st.sampled_from(["x", "hall_left", "b0x"]),
    st.sampled_from(EVERY_UNIT),
    st.sampled_from(["{}_{}", "{} [{}]", "{}[{}]", "{} ({})", "{}({})"]),
    st.booleans(),
)
def test_a_unit_is_found_in_every_spelling(
    name: str, unit: str, spelling: str, capitals: bool
) -> None:
    text = spelling.format(name, unit)
    assert split_unit(text.upper() if capitals else text) == (name, unit)


@pytest.mark.parametrize(
    ("name", "field", "key", "factor"),
    [
        ("seq", "sequence", (), 1.0),
        ("bx_mT", "field", ("x",), 1e-3),
        ("y [mm]", "position", ("y",), 1e-3),
    ],
)
def test_declared_kinds(name: str, field: str, key: tuple[str, ...], factor: float) -> None:
    match = match_column(name, KINDS)
    assert match is not None
    assert (match.kind.field, match.key, match.factor) == (field, key, factor)


def test_a_name_without_a_unit_has_no_factor() -> None:
    match = match_column("bx", KINDS)
    assert match is not None
    assert math.isnan(match.factor)
    for name in ("seq_ms", "bx_mm", "z_mm", "speed"):
        assert match_column(name, KINDS) is None


def test_a_sensor_may_be_named_like_a_unit(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t_s,hall_t\n1,2\n")
    columns = find_columns(
        read_table(path), {"t": ("time",), "hall_t": ("field", "voltage")}, {}, {}
    )
    assert (columns["hall_t"].name, columns["hall_t"].unit) == ("hall_t", "t")
    assert columns["t"].in_si().tolist() == [1e9]
