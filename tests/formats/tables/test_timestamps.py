"""Time stamps in text: exact conversion, one by one and many at once."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.formats.tables import timestamps as ts


@given(st.integers(-(2**63), 2**63 - 1))
def test_epoch_seconds_lose_no_nanosecond(time_ns: int) -> None:
    assert ts.parse_decimal_time(ts.format_epoch_seconds(time_ns)) == time_ns


@pytest.mark.parametrize(
    ("text", "unit", "time_ns"),
    [
        ("1690218696.0748", "s", 1690218696074800000),
        ("1.690218696074800000e+09", "s", 1690218696074800000),
        ("1", "s", 10**9),
        ("-0.5", "s", -(10**9) // 2),
        ("0.00000000051", "s", 1),
        (" 2 ", "s", 2 * 10**9),
        ("1690218696074.8", "ms", 1690218696074800000),
        ("1690218696074800000", "ns", 1690218696074800000),
    ],
)
def test_decimal_times(text: str, unit: str, time_ns: int) -> None:
    assert ts.parse_decimal_time(text, unit) == time_ns


@pytest.mark.parametrize(
    "text",
    [
        "",
        "now",
        "nan",
        "inf",
        "1e400",
        "1e10",
        "9223372037",
        "1,5",
        "0x10",
        "1.2.3",
        "1e999999",
        "1_0",
        "\u0661",
    ],
)
def test_text_that_is_not_a_time(text: str) -> None:
    with pytest.raises(ValueError, match="time"):
        ts.parse_decimal_time(text)
    with pytest.raises(ValueError, match="time"):
        ts.parse_decimal_times(["1.5", text])


@pytest.mark.slow
@settings(max_examples=50)
@given(
    st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=5), st.integers(0, 12), st.booleans()
)
def test_many_times_at_once_equal_single_ones(
    times_ns: list[int], characters: int, shorten: bool
) -> None:
    texts = [ts.format_epoch_seconds(time_ns) for time_ns in times_ns]
    cells = [text[: len(text) - 9 + characters] for text in texts]
    cells = [cell.rstrip("0") for cell in cells] if shorten else cells
    expected = [ts.parse_decimal_time(cell) for cell in cells]
    assert ts.parse_decimal_times(cells).tolist() == expected


@pytest.mark.parametrize(
    ("text", "time_ns"),
    [
        ("2023-07-24T17:11:36.0748Z", 1690218696074800000),
        ("2023-07-24 17:11:36.074800000", 1690218696074800000),
        ("2023-07-24T17:11:36.0748000009+00:00", 1690218696074800000),
        ("2023-07-24T19:11:36.0748+02:00", 1690218696074800000),
        ("2023-07-24T12:41:36.0748-0430", 1690218696074800000),
    ],
)
def test_iso_times(text: str, time_ns: int) -> None:
    assert ts.is_iso_time(text)
    assert ts.parse_iso_time(text, utc_only=False) == time_ns
    if text.endswith(("02:00", "0430")):
        with pytest.raises(ValueError, match="zone"):
            ts.parse_iso_time(text)
    else:
        assert ts.parse_iso_time(text) == time_ns


@pytest.mark.parametrize("text", ["2023-02-30T00:00:00Z", "2023-07-24", "1950-01-01T00:00:00Z", ""])
def test_text_that_is_not_an_iso_time(text: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        ts.parse_iso_time(text)


def test_zero_bytes_are_no_times() -> None:
    with pytest.raises(ValueError, match="not a time"):
        ts.parse_decimal_times(["1.5\0"])
