"""What a tag is made of: discs, and a bill of materials."""

from __future__ import annotations

from locatk.core.errors import InputError
from locatk.core.materials import Item, remanence
from locatk.core.polaris.tag import Magnet, Tags

_PAPER_DISCS_M = ((2e-3, 0.5e-3), (1e-3, 0.5e-3))


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
