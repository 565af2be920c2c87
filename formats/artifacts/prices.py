"""Prices of the parts of bills of materials, ``prices.toml``, which users edit."""

from __future__ import annotations

import os
from typing import Any

from locatk.core.landmarks.design.materials import PARTS as LANDMARK_PARTS
from locatk.core.materials import Price
from locatk.core.polaris.design.materials import PARTS as TAG_PARTS
from locatk.core.polaris.design.materials import PUBLISHED_PRICES
from locatk.formats.artifacts.kinds import InvalidValueError, Number, Text, nearest_key_hint
from locatk.formats.artifacts.schema import Artifact, Key, Table, Tables, Values

PARTS = (*TAG_PARTS, *LANDMARK_PARTS)
"""Parts that can have a price."""

Prices = dict[str, Price]
"""Prices by part."""


def _item_of(values: Values) -> Values:
    if values["part"] not in PARTS:
        hint = nearest_key_hint(values["part"], PARTS)
        raise InvalidValueError(f"no part {values['part']!r}", "part", hint)
    if values["price"] is not None:
        for key in ("currency", "date", "source"):
            if not values[key].strip():
                raise InvalidValueError(f"a price needs its {key}", key, "Write it as text")
    return values


def _prices_of(values: Values) -> Prices:
    items = values["parts"]
    names = [item["part"] for item in items]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise InvalidValueError(
                f"{name!r} occurs twice", f"parts[{number}]", "Keep one of the two"
            )
    prices = {
        item["part"]: Price(item["price"], item["currency"], item["date"], item["source"])
        for item in items
        if item["price"] is not None
    }
    currencies = sorted({price.currency for price in prices.values()})
    if len(currencies) > 1:
        raise InvalidValueError(
            f"prices in {' and '.join(currencies)}", "parts", "Convert all prices to one currency"
        )
    return prices


def _values_of(prices: Prices) -> dict[str, Any]:
    unknown = {"price": None, "currency": "", "date": "", "source": ""}
    rows = []
    for part in PARTS:
        price = prices.get(part)
        known = unknown if price is None else {**vars(price), "price": price.amount}
        rows.append({"part": part, **known})
    return {"parts": rows}


PRICES: Artifact[Prices] = Artifact(
    "prices.toml",
    "locatk-prices",
    Table(
        (
            Key(
                "parts",
                Tables(
                    Table(
                        (
                            Key("part", Text(is_blank_allowed=False), "name in the bill"),
                            Key(
                                "price",
                                Number(0.0, hint="Leave the key out if the price is unknown"),
                                "price of one piece; without the key it is unknown",
                                default=None,
                                default_text="unknown",
                            ),
                            Key("currency", Text(), "as in `USD`; one for all parts", default=""),
                            Key("date", Text(), "day, month or year of the price", default=""),
                            Key("source", Text(), "shop or document of the price", default=""),
                        ),
                        _item_of,
                    )
                ),
            ),
        ),
        _prices_of,
        _values_of,
    ),
    comment="Prices of one piece: enter price, currency, date and source of the parts you buy.",
)
"""Prices as a file."""


def prices_template() -> str:
    """Return the text of a file with all parts, and the prices that the papers state."""
    return PRICES.dumps(PUBLISHED_PRICES)


def read_prices(path: str | os.PathLike[str] | None) -> Prices | None:
    """Read a file of prices; return None if there is none.

    Raises
    ------
    MissingDataError, ArtifactError
        See :meth:`locatk.formats.artifacts.schema.Artifact.read`.
    """
    return None if path is None else PRICES.read(path)
