"""Bills of materials as CSV, for a spreadsheet."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence

from locatk.core.materials import BillItem
from locatk.core.printable import spreadsheet_text
from locatk.formats.output import atomic_write

COLUMNS = ("part", "count", "detail", "price_usd", "source")


def write_bill(path: str | os.PathLike[str], items: Sequence[BillItem], *, overwrite: bool) -> None:
    """Write items as CSV with :data:`COLUMNS`, one a line; an unknown price is empty.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    with atomic_write(path, overwrite=overwrite, mode="w") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(COLUMNS)
        for item in items:
            price = "" if item.price_usd is None else f"{item.price_usd:g}"
            part, detail, source = map(spreadsheet_text, (item.part, item.detail, item.source))
            table.writerow((part, item.count, detail, price, source))
