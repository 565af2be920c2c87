"""Decimal numbers in text, as all programs write them."""

from __future__ import annotations


def parse_number(text: str) -> float:
    """Return a decimal number in ASCII, with or without an exponent; also ``nan`` and ``inf``.

    ``float`` accepts underscores and the digits of all scripts as well. A cell such as ``1_000``
    is refused by the parsers of tables (numpy, pandas, pyarrow), and rather damaged than a number.

    Raises
    ------
    ValueError
        ``text`` is not such a number.
    """
    return float(plain_number(text))


def plain_number(text: str) -> str:
    """Return a text unchanged if it consists of characters of decimal numbers.

    Raises
    ------
    ValueError
        It contains an underscore, or is not ASCII.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"{text!r} is not a number")
    return text
