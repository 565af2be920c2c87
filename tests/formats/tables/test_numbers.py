"""Numbers in text tables: one strict parser, as that of other programs."""

from __future__ import annotations

import pytest

from locatk.formats.tables.numbers import parse_number


@pytest.mark.parametrize(
    ("text", "value"),
    [("1000", 1000.0), (" -1.5e-3 ", -0.0015), ("+.5", 0.5), ("7.", 7.0), ("1E400", float("inf"))],
)
def test_decimal_numbers(text: str, value: float) -> None:
    assert parse_number(text) == value


@pytest.mark.parametrize("text", ["1_000", "\u0661\u0665", "\uff11", "0x10", "1,5", "", "1 2"])
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"number|float"):
        parse_number(text)
