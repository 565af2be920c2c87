"""Prices of parts and minutes of work, ``prices.toml``, which users edit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from locatk.core.advice.work import WORK_MINUTES
from locatk.core.dots.design.camera_materials import PAPER_PRICES as CAMERA_PRICES
from locatk.core.dots.design.camera_materials import PARTS as CAMERA_PARTS
from locatk.core.landmarks.design.materials import PARTS as LANDMARK_PARTS
from locatk.core.lighthouse.design.materials import PARTS as STATION_PARTS
from locatk.core.lighthouse.design.materials import PUBLISHED_PRICES as STATION_PRICES
from locatk.core.materials import Price, PriceList
from locatk.core.polaris.design.materials import PARTS as TAG_PARTS
from locatk.core.polaris.design.materials import PUBLISHED_PRICES as TAG_PRICES
from locatk.formats.artifacts.kinds import (
    InvalidValueError,
    Number,
    Text,
    nearest_key_hint,
)
from locatk.formats.artifacts.schema import (
    Artifact,
    Key,
    Table,
    Tables,
    Values,
    refuse_repeated,
)

PARTS = tuple(
    dict.fromkeys(
        (
            *TAG_PARTS,
            *LANDMARK_PARTS,
            *STATION_PARTS,
            *CAMERA_PARTS,
            "printed sheet",
            "computer",
            "hall sensor",
        )
    )
)
"""Parts that can have a price, of all bills of materials and of `locatk advise`."""

OF_ONE_TYPE = ("disc magnet", "image sensor", "lens")
"""Parts whose published price is that of one type only: a bill has it for this type."""

PUBLISHED_PRICES = {
    part: price
    for part, price in {**TAG_PRICES, **STATION_PRICES, **CAMERA_PRICES}.items()
    if part not in OF_ONE_TYPE
}
"""Prices that the papers state for parts of any type."""


def _item_of(values: Values) -> Values:
    if values["part"] not in PARTS:
        hint = nearest_key_hint(values["part"], PARTS)
        raise InvalidValueError(f"no part {values['part']!r}", "part", hint)
    if values["price"] is not None:
        for key in ("currency", "date", "source"):
            if not values[key].strip():
                raise InvalidValueError(f"a price needs its {key}", key, "Write it as text")
    return values


def _step_of(values: Values) -> Values:
    if values["step"] not in WORK_MINUTES:
        hint = nearest_key_hint(values["step"], WORK_MINUTES)
        raise InvalidValueError(f"no step {values['step']!r}", "step", hint)
    return values


def _prices_of(values: Values) -> PriceList:
    refuse_repeated((item["part"] for item in values["parts"]), "parts", "part")
    refuse_repeated((item["step"] for item in values["work"]), "work", "step")
    prices = {
        item["part"]: Price(item["price"], item["currency"], item["date"], item["source"])
        for item in values["parts"]
        if item["price"] is not None
    }
    return PriceList(prices, {item["step"]: item["minutes"] for item in values["work"]})


def _values_of(prices: PriceList) -> dict[str, Any]:
    unknown = {"price": None, "currency": "", "date": "", "source": ""}
    rows = []
    for part in PARTS:
        price = prices.parts.get(part)
        known = unknown if price is None else {**vars(price), "price": price.amount}
        rows.append({"part": part, **known})
    work = [{"step": step, "minutes": value} for step, value in prices.work_minutes.items()]
    return {"parts": rows, "work": work}


PRICES: Artifact[PriceList] = Artifact(
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
                            Key("currency", Text(), "as in `USD`", default=""),
                            Key("date", Text(), "day, month or year of the price", default=""),
                            Key("source", Text(), "shop or document of the price", default=""),
                        ),
                        _item_of,
                    )
                ),
            ),
            Key(
                "work",
                Tables(
                    Table(
                        (
                            Key("step", Text(is_blank_allowed=False), "work of an installation"),
                            Key(
                                "minutes",
                                Number(0.0, hint="Give 0 or more minutes"),
                                "minutes for one piece",
                            ),
                        ),
                        _step_of,
                    )
                ),
                default=(),
            ),
        ),
        _prices_of,
        _values_of,
    ),
    comment="Prices of one piece: enter price, currency, date and source of the parts you buy.\n"
    "Work: minutes for one piece of each step, used by `locatk advise`.",
)
"""Prices as a file."""


def prices_template() -> str:
    """Return the text of a file with all parts and steps of work, and the published prices."""
    return PRICES.dumps(PriceList(PUBLISHED_PRICES, WORK_MINUTES))


def read_price_list(path: str | os.PathLike[str] | None) -> PriceList | None:
    """Read a file of prices and minutes of work; return None if there is none.

    Raises
    ------
    MissingDataError, ArtifactError
        See :meth:`locatk.formats.artifacts.schema.Artifact.read`.
    """
    return None if path is None else PRICES.read(path)


def read_prices(path: str | os.PathLike[str] | None) -> Mapping[str, Price] | None:
    """Read the prices of a file as :func:`read_price_list`; return None if there is none."""
    prices = read_price_list(path)
    return None if prices is None else prices.parts
