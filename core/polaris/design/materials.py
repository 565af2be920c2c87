"""Magnets and bill of materials of a tag."""

from __future__ import annotations

import math

from locatk.core.errors import InputError
from locatk.core.materials import MAX_REMANENCE_T, BillItem, Price, remanence_of_grade, size_mm_text
from locatk.core.polaris.tag import Magnet, Tags

PAPER_DISCS_M = ((2e-3, 0.5e-3), (1e-3, 0.5e-3))
"""Diameter and height of the discs of the Polaris paper (section 7.2)."""

PAPER_DISC_PRICE = Price(0.015, "USD", "2024-11", "upper limit, Polaris paper, section 7.2")
"""Price of these discs, as stated by the authors (ACM MobiCom 2024)."""

MAGNETOMETER_PRICE = Price(2.0, "USD", "2024-11", "upper limit, Polaris paper, section 7.1")
"""Price of an MLX90393, as stated by the authors (ACM MobiCom 2024)."""

PUBLISHED_PRICES = {"disc magnet": PAPER_DISC_PRICE, "magnetometer": MAGNETOMETER_PRICE}
"""Prices of the paper by part."""

PARTS = ("disc magnet", "substrate", "glue", "magnetometer", "microcontroller")
"""Parts of :func:`bill_of_materials`."""

SUBSTRATE = "PVC sheet 0.2 mm"
"""Substrate of the tags of the Polaris paper (section 7.2)."""

MAX_DISC_SIDE_M = 1.0
"""Size above any disc magnet; a larger value is probably in another unit."""


def disc_magnet(
    diameter_m: float,
    height_m: float,
    *,
    grade: str = "",
    remanence_t: float | None = None,
) -> Magnet:
    """Return a disc magnet of a grade, or with a measured remanence.

    Raises
    ------
    InputError
        A size or the remanence is impossible, or neither grade nor remanence is given.
    """
    if remanence_t is None:
        remanence_t = remanence_of_grade(grade)
    if not (0 < diameter_m < MAX_DISC_SIDE_M and 0 < height_m < MAX_DISC_SIDE_M):
        raise InputError(f"no disc of {size_mm_text(diameter_m, height_m)}")
    if not 0 < remanence_t <= MAX_REMANENCE_T:
        raise InputError(
            f"no magnet has a remanence of {remanence_t:g} T",
            hint="Give tesla: N52 has 1.45",
        )
    return Magnet(diameter_m, height_m, remanence_t, grade)


def bill_of_materials(
    tags: Tags, sensors: int, sensor: str, count: int = 1
) -> tuple[BillItem, ...]:
    """List the parts of tags and one array of sensors (Polaris paper, sections 7.1 and 7.2)."""
    magnet = tags.magnet
    is_paper_disc = any(
        math.isclose(magnet.diameter_m, diameter_m, abs_tol=1e-6)
        and math.isclose(magnet.height_m, height_m, abs_tol=1e-6)
        for diameter_m, height_m in PAPER_DISCS_M
    )
    side_mm = tags.order * tags.spacing_m * 1e3
    strength = magnet.grade or f"of {magnet.remanence_t:g} T"
    return (
        BillItem(
            "disc magnet",
            tags.magnets * count,
            f"{size_mm_text(magnet.diameter_m, magnet.height_m)} NdFeB {strength}, magnetised "
            "across, north marked",
            PAPER_DISC_PRICE if is_paper_disc else None,
        ),
        BillItem("substrate", count, f"{side_mm:.0f} x {side_mm:.0f} mm, {SUBSTRATE}"),
        BillItem("glue", 1, "industrial, thin"),
        BillItem("magnetometer", sensors, sensor, MAGNETOMETER_PRICE),
        BillItem("microcontroller", 1, "SPI at 2 MHz; USB or Bluetooth LE to the computer"),
    )
