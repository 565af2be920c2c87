"""Materials of printed and built infrastructure: magnets, and items of a bill of materials."""

from __future__ import annotations

from dataclasses import dataclass

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
class BillItem:
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
