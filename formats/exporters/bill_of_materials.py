"""Bills of materials as CSV, for a spreadsheet, and as values for JSON."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from typing import Any

from locatk.core.materials import BillItem, total_of
from locatk.core.printable import spreadsheet_text
from locatk.formats.output import atomic_write

COLUMNS = (
    "part",
    "count",
    "detail",
    "unit_price",
    "currency",
    "sum",
    "price_date",
    "price_source",
)

TEXT_COLUMNS = ("part", "detail", "currency", "price_date", "price_source")


def bill_rows(items: Sequence[BillItem]) -> list[dict[str, Any]]:
    """Return the items with the keys :data:`COLUMNS`; unknown values are None."""
    rows = []
    for item in items:
        price = item.price
        prices = (
            (None,) * 5
            if price is None
            else (price.amount, price.currency, item.amount, price.date, price.source)
        )
        values = (item.part, item.count, item.detail, *prices)
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def total_entry(items: Sequence[BillItem]) -> dict[str, Any]:
    """Return the total as values for JSON; the amount is None if no part has a price."""
    total = total_of(items)
    return {
        "amount": total.amount if total.currency else None,
        "currency": total.currency or None,
        "parts_without_price": total.parts_without_price,
    }


def write_bill(path: str | os.PathLike[str], items: Sequence[BillItem], *, overwrite: bool) -> None:
    """Write items as CSV with :data:`COLUMNS`, one a line, and a last line with the total.

    Unknown prices are empty; the detail of the total names the parts without a price.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    total = total_of(items)
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        table = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        table.writeheader()
        for row in bill_rows(items):
            for column in TEXT_COLUMNS:
                row[column] = spreadsheet_text(row[column] or "")
            table.writerow(row)
        missing = ", ".join(total.parts_without_price)
        table.writerow(
            {
                "part": "total",
                "detail": f"incomplete: no price of {missing}" if missing else "",
                "currency": total.currency,
                "sum": total.amount if total.currency else None,
            }
        )
