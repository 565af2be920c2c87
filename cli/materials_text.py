"""Text of a bill of materials."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.core.materials import BillItem

MAX_DETAIL_CHARACTERS = 36
"""Width of the column of details; longer ones take several rows."""


def materials_text(items: Sequence[BillItem]) -> str:
    """Format a bill of materials, its total, and the sources of its prices, in 80 columns."""
    from locatk.core.materials import priced_part, total_of

    rows: list[tuple[object, ...]] = []
    sources: dict[str, dict[str, None]] = {}
    for item in items:
        each = total = ""
        if item.price is not None:
            each, total = f"{item.price.amount:g}", f"{item.amount:.2f}"
            source = f"{item.price.source}, {item.price.date}"
            sources.setdefault(source, {})[priced_part(item)] = None
        detail, *more = textwrap.wrap(item.detail, MAX_DETAIL_CHARACTERS) or [""]
        rows.append((item.part, item.count, detail, each, total))
        rows += [("", "", line, "", "") for line in more]
    bill = total_of(items)
    head = ("material", "count", "", "each", f"sum {bill.currency}".strip())
    lines = [f"{bill.text[0].upper()}{bill.text[1:]}."]
    lines += [f"{', '.join(parts)}: {source}" for source, parts in sources.items()]
    return "\n".join(
        [console.table(head, rows), "", *(console.wrapped(line, indent=0) for line in lines)]
    )
