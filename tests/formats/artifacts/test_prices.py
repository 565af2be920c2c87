"""Prices of bills of materials."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from locatk.core.advice.work import WORK_MINUTES
from locatk.core.errors import ArtifactError, InputError
from locatk.core.landmarks.design.materials import bill_of_materials as floor_bill
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.materials import BillItem, Price, priced_part, total_of, with_prices
from locatk.core.polaris.design.materials import bill_of_materials as tag_bill
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts.prices import (
    PARTS,
    PRICES,
    prices_template,
    read_price_list,
    read_prices,
)
from locatk.formats.exporters.bill_of_materials import bill_rows, write_bill

HEAD = 'format = "locatk-prices"\nformat_version = 1\n'


def part(name: str, price: float, currency: str = "EUR", date: str = "2026-11-02") -> str:
    return (
        f'[[parts]]\npart = "{name}"\nprice = {price}\ncurrency = "{currency}"\n'
        f'date = "{date}"\nsource = "shop"\n'
    )


def test_the_template_has_every_part_and_the_published_prices(tmp_path: Path) -> None:
    floor = FloorMap(np.array([[1, 2], [3, 4]]))
    items = (*tag_bill(Tags(), 9, "MLX90393"), *floor_bill(floor))
    assert {priced_part(item) for item in items} < set(PARTS)
    text = prices_template()
    assert text.count("[[parts]]") == len(PARTS)
    path = tmp_path / "prices.toml"
    path.write_text(text)
    prices = read_price_list(path)
    assert prices is not None
    amounts = {name: price.amount for name, price in prices.parts.items()}
    # Polaris paper, sections 7.1 and 7.2; Lighthouse paper, section I; dots paper, Table II.
    assert (amounts["base station"], amounts["magnetometer"]) == (200.0, 2.0)
    assert (amounts["lens mount"], amounts["resistor"]) == (0.17, 0.29)
    # The published prices of these are those of one type, and a file has one price for all.
    assert not {"disc magnet", "image sensor", "lens"} & set(amounts)
    assert prices.work_minutes == WORK_MINUTES
    bill = with_prices(tag_bill(Tags(), 9, "MLX90393"), prices.parts)
    assert {item.part for item in bill if item.price is not None} == {"magnetometer"}


def test_bills_are_added() -> None:
    prices = PRICES.loads(HEAD + part("bar magnet", 0.5) + part("compass", 9)).parts
    items = with_prices(
        [BillItem("bar magnet", 80, ""), BillItem("bar magnet, spare", 4, "")], prices
    )
    total = total_of(items)
    assert (total.amount, total.currency, total.text) == (42.0, "EUR", "total 42.00 EUR")
    items = (*items, BillItem("glue", 1, ""), BillItem("marker", 1, ""))
    assert total_of(items).text == "total 42.00 EUR, incomplete: no price of glue, marker"
    assert [row["sum"] for row in bill_rows(items)] == [40.0, 2.0, None, None]
    assert total_of(items[2:]).text == "no total, no part has a price"
    with pytest.raises(InputError, match="EUR and USD"):
        total_of([*items, BillItem("x", 1, "", Price(1.0, "USD", "2024", "y"))])


def test_a_file_of_prices_replaces_all_published_ones(tmp_path: Path) -> None:
    prices = PRICES.loads(HEAD + part("glue", 4.0)).parts
    items = with_prices(tag_bill(Tags(), 9, "MLX90393"), prices)
    assert [item.part for item in items if item.price is not None] == ["glue"]
    path = tmp_path / "bill.csv"
    write_bill(path, items, overwrite=False)
    with path.open(newline="") as stream:
        last = list(csv.DictReader(stream))[-1]
    assert (last["part"], last["sum"], last["currency"]) == ("total", "4.0", "EUR")
    assert "disc magnet" in last["detail"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (part("glue", -1), "at least 0"),
        (part("glue", 1).replace("price", "prise"), "unknown key 'prise'"),
        (part("glu", 1), "no part 'glu'"),
        (part("glue", 1) + '[[work]]\nstep = "lay a shee"\nminutes = 3\n', "no step"),
        (part("glue", 1) + '[[work]]\nstep = "lay a sheet"\nminutes = -3\n', "at least 0"),
        (part("glue", 1) + part("glue", 2), "glue"),
        (part("glue", 1, date=""), "needs its date"),
        (part("glue", float("nan")), "finite"),
    ],
)
def test_wrong_prices_are_one_line_with_a_hint(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "prices.toml"
    path.write_text(HEAD + text)
    with pytest.raises(ArtifactError, match=problem) as caught:
        read_prices(path)
    assert "\n" not in str(caught.value)
    assert caught.value.hint
