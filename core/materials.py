"""Materials of artifacts: magnet grades, and the items of a bill of materials."""

from __future__ import annotations

from dataclasses import dataclass

from locatk.core.errors import InputError

GRADES_T = {
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


@dataclass(frozen=True)
class Item:
    """Item of a bill of materials.

    Attributes
    ----------
    part : str
    count : int
    detail : str
        Description for buying it.
    price_usd : float or None
        Upper limit of the price of one piece, if the paper gives one.
    source : str
        Source of the price.
    """

    part: str
    count: int
    detail: str
    price_usd: float | None = None
    source: str = ""


def remanence(grade: str) -> float:
    """Return the remanence in tesla of a grade as ``"N52"``, the middle of its listed range.

    Raises
    ------
    InputError
        The grade is not in :data:`GRADES_T`.
    """
    if grade not in GRADES_T:
        raise InputError(f"no grade {grade!r}", hint=f"Known grades: {', '.join(GRADES_T)}")
    return round(sum(GRADES_T[grade]) / 2, 4)
