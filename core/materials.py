"""Materials of printed and built infrastructure: magnets, and items of a bill of materials."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from locatk.core.errors import InputError

NDFEB_REMANENCES_T = {
    "N35": (1.17, 1.22),
    "N38": (1.22, 1.26),
    "N40": (1.25, 1.29),
    "N42": (1.28, 1.32),
    "N45": (1.32, 1.38),
    "N48": (1.37, 1.42),
    "N50": (1.39, 1.45),
    "N52": (1.42, 1.48),
}
"""Lowest and highest remanence of sintered NdFeB at 20 degrees C by grade, in tesla, as listed by
manufacturers (K&J Magnetics, Vormag). It falls by 0.12 % per degree."""

FERRITE_REMANENCES_T = (0.20, 0.45)
"""Lowest and highest remanence of sintered hard ferrite, grades Y8T to Y40 (SJ/T 10410-2000, as
listed by manufacturers: http://magneticalloy.com/ferrite-magnet.htm)."""

REMANENCE_TOLERANCE_T = 0.005
"""Tolerance of a remanence that is compared with the listed range of a grade."""

MAX_REMANENCE_T = 2.0
"""Remanence above any permanent magnet; a larger value is probably in another unit."""


@dataclass(frozen=True)
class Price:
    """Price of one piece of a part.

    Attributes
    ----------
    amount : float
    currency : str
        Code of ISO 4217, as in ``"USD"``.
    date : str
        Day, month or year of the price, as in ``"2024-11"``.
    source : str
    """

    amount: float
    currency: str
    date: str
    source: str


@dataclass(frozen=True)
class BillItem:
    """Item of a bill of materials.

    Attributes
    ----------
    part : str
    count : int
    detail : str
        Description for buying it.
    price : Price or None
        Price of one piece, if it is known.
    """

    part: str
    count: int
    detail: str
    price: Price | None = None

    @property
    def amount(self) -> float | None:
        """Price of all pieces."""
        return None if self.price is None else round(self.count * self.price.amount, 4)


@dataclass(frozen=True)
class BillTotal:
    """Sum of the items of a bill that have a price, and the parts without one."""

    amount: float
    currency: str
    parts_without_price: tuple[str, ...]

    @property
    def text(self) -> str:
        """The total in words, as in ``"total 3.75 USD, incomplete: no price of glue"``."""
        if not self.currency:
            return "no total, no part has a price"
        total = f"total {self.amount:.2f} {self.currency}"
        if not self.parts_without_price:
            return total
        return f"{total}, incomplete: no price of {', '.join(self.parts_without_price)}"


def total_of(items: Sequence[BillItem]) -> BillTotal:
    """Add the prices of a bill.

    Raises
    ------
    InputError
        The prices are in several currencies.
    """
    prices = [item.price for item in items if item.price is not None]
    currencies = sorted({price.currency for price in prices})
    if len(currencies) > 1:
        raise InputError(
            f"prices in {' and '.join(currencies)}", hint="Convert all prices to one currency"
        )
    amount = sum(item.amount or 0.0 for item in items)
    missing = dict.fromkeys(priced_part(item) for item in items if item.price is None)
    return BillTotal(round(amount, 4), "".join(currencies), tuple(missing))


@dataclass(frozen=True)
class PriceList:
    """Prices and working times of a user.

    Attributes
    ----------
    parts : mapping of str to Price
        By part.
    work_minutes : mapping of str to float
        Minutes for one piece of each work, as in :data:`locatk.core.advice.work.WORK_MINUTES`.
    """

    parts: Mapping[str, Price] = field(default_factory=dict)
    work_minutes: Mapping[str, float] = field(default_factory=dict)


def priced_part(item: BillItem) -> str:
    """Return the part whose price an item has: that of ``"bar magnet, spare"`` is a bar magnet."""
    return item.part.split(",")[0]


def split_bill(
    items: Sequence[BillItem], robot_parts: Collection[str]
) -> tuple[tuple[BillItem, ...], tuple[BillItem, ...]]:
    """Return the items of the infrastructure, and those of robots, whose parts are given."""
    return (
        tuple(item for item in items if item.part not in robot_parts),
        tuple(item for item in items if item.part in robot_parts),
    )


def with_prices(
    items: Sequence[BillItem], prices: Mapping[str, Price] | None
) -> tuple[BillItem, ...]:
    """Return items with the prices of their parts; None keeps the published prices."""
    if prices is None:
        return tuple(items)
    return tuple(replace(item, price=prices.get(priced_part(item))) for item in items)


def remanence_of_grade(grade: str) -> float:
    """Return the remanence in tesla of a grade as ``"N52"``, the middle of its listed range.

    Raises
    ------
    InputError
        The grade is not in :data:`NDFEB_REMANENCES_T`.
    """
    if grade not in NDFEB_REMANENCES_T:
        raise InputError(
            f"no grade {grade!r}", hint=f"Known grades: {', '.join(NDFEB_REMANENCES_T)}"
        )
    return round(sum(NDFEB_REMANENCES_T[grade]) / 2, 4)


def magnet_material(remanence_t: float) -> str:
    """Return the kind of magnet with this remanence, as a supplier lists it.

    Examples
    --------
    >>> magnet_material(1.2), magnet_material(0.4)
    ('NdFeB N35', 'ferrite')
    """
    grades = [
        grade
        for grade, (low, high) in NDFEB_REMANENCES_T.items()
        if low - REMANENCE_TOLERANCE_T <= remanence_t <= high + REMANENCE_TOLERANCE_T
    ]
    if grades:
        return f"NdFeB {' or '.join(grades)}"
    low, high = FERRITE_REMANENCES_T
    return "ferrite" if low <= remanence_t <= high else "magnet"


def size_mm_text(*sides_m: float) -> str:
    """Format the sides of a part in mm.

    Examples
    --------
    >>> size_mm_text(0.002, 0.0005)
    '2 x 0.5 mm'
    """
    return " x ".join(f"{side * 1e3:g}" for side in sides_m) + " mm"
