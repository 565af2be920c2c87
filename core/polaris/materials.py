"""What a tag is made of: grades of magnet, and a bill of materials."""

from __future__ import annotations

from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.polaris.tag import Magnet, Tags

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

_PAPER_DISCS_M = ((2e-3, 0.5e-3), (1e-3, 0.5e-3))


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


def disc(
    diameter_m: float,
    height_m: float,
    *,
    grade: str = "",
    remanence_t: float | None = None,
) -> Magnet:
    """A disc of a grade, of a remanence, or of a grade whose remanence was measured.

    Raises
    ------
    InputError
        A size or a remanence that cannot be, or neither grade nor remanence.
    """
    if remanence_t is None:
        remanence_t = remanence(grade)
    if not (0 < diameter_m < 1 and 0 < height_m < 1):
        raise InputError(f"no disc of {diameter_m * 1e3:g} x {height_m * 1e3:g} mm")
    if not 0 < remanence_t <= 2:
        raise InputError(
            f"a remanence of {remanence_t:g} T is that of no magnet",
            hint="Give tesla: N52 has 1.45",
        )
    return Magnet(diameter_m, height_m, remanence_t, grade)


def bill(tags: Tags, sensors: int, sensor: str, count: int = 1) -> tuple[Item, ...]:
    """What ``count`` tags and one array of ``sensors`` take (Polaris sections 7.1 and 7.2)."""
    magnet = tags.magnet
    size = f"{magnet.diameter_m * 1e3:g} x {magnet.height_m * 1e3:g} mm"
    known = any(
        abs(magnet.diameter_m - d) < 1e-6 and abs(magnet.height_m - h) < 1e-6
        for d, h in _PAPER_DISCS_M
    )
    side = tags.order * tags.spacing_m * 1e3
    strength = magnet.grade or f"of {magnet.remanence_t:g} T"
    return (
        Item(
            "disc magnet",
            tags.magnets * count,
            f"{size} NdFeB {strength}, magnetised across, north marked",
            0.015 if known else None,
            "Polaris 7.2" if known else "",
        ),
        Item("substrate", count, f"{side:.0f} x {side:.0f} mm, PVC sheet 0.2 mm"),
        Item("glue", 1, "industrial, thin"),
        Item("magnetometer", sensors, sensor, 2.0, "Polaris 7.1"),
        Item("microcontroller", 1, "SPI at 2 MHz; USB or Bluetooth LE to the computer"),
    )
