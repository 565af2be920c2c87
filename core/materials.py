"""What artifacts are made of: grades of magnet, and the lines of a bill of materials."""

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
"""Remanence of sintered NdFeB by grade at 20 degrees C, from what makers list (K&J
Magnetics, Vormag); it falls by 0.12 % a degree."""


@dataclass(frozen=True)
class Item:
    """A line of a bill of materials.

    Attributes
    ----------
    part : str
    count : int
    detail : str
        What to buy, in words.
    price_usd : float or None
        Upper limit for one, where the paper names one.
    source : str
        Of the price.
    """

    part: str
    count: int
    detail: str
    price_usd: float | None = None
    source: str = ""


def remanence(grade: str) -> float:
    """Remanence in tesla of a grade as ``"N52"``: the middle of what is listed.

    Raises
    ------
    InputError
        A grade that is not in :data:`GRADES_T`.
    """
    if grade not in GRADES_T:
        raise InputError(f"no grade {grade!r}", hint=f"Known grades: {', '.join(GRADES_T)}")
    return round(sum(GRADES_T[grade]) / 2, 4)
