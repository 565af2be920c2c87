"""Bill of materials of a camera over printed dots."""

from __future__ import annotations

from locatk.core.materials import BillItem, Price
from locatk.core.units import length_text

PAPER_PRICES = {
    "lens": Price(1.90, "EUR", "2016", "Hostettler et al., ICRA 2016, Table II"),
    "lens mount": Price(0.17, "EUR", "2016", "Hostettler et al., ICRA 2016, Table II"),
    "image sensor": Price(12.86, "EUR", "2016", "Hostettler et al., ICRA 2016, Table II"),
    "infrared LED": Price(0.46, "EUR", "2016", "Hostettler et al., ICRA 2016, Table II"),
    "LED switch": Price(0.06, "EUR", "2016", "Hostettler et al., ICRA 2016, Table II"),
    "resistor": Price(0.29, "EUR", "2016", "Hostettler et al., ICRA 2016, Table II"),
}
"""Prices of the paper's parts: a lens of 5.5 mm, the MT9V034, three VSMY3850."""

PAPER_SENSOR, PAPER_FOCAL_M = "MT9V034", 5.5e-3
"""Sensor and lens to which these prices belong."""

PARTS = ("image sensor", "lens", "lens mount", "infrared LED", "LED switch", "resistor", "holder")
"""Parts of :func:`camera_materials`."""

LEDS = 3
"""Number of LEDs about the lens (paper, III-A)."""


def camera_materials(
    sensor: str, focal_m: float, wavelength_m: float, *, is_colour: bool = False
) -> tuple[BillItem, ...]:
    """List the parts of one camera, as in Table II of the paper, without the computer."""
    is_paper_sensor = sensor.lower().startswith(PAPER_SENSOR.lower())
    is_paper_lens = abs(focal_m - PAPER_FOCAL_M) < 1e-6
    return (
        BillItem(
            "image sensor",
            1,
            f"{sensor}, without infrared filter" if is_colour else sensor,
            PAPER_PRICES["image sensor"] if is_paper_sensor else None,
        ),
        BillItem(
            "lens",
            1,
            f"M12 thread, {length_text(focal_m)}, no infrared filter",
            PAPER_PRICES["lens"] if is_paper_lens else None,
        ),
        BillItem("lens mount", 1, "M12 thread, height to be focused", PAPER_PRICES["lens mount"]),
        BillItem(
            "infrared LED", LEDS, f"{wavelength_m * 1e9:.0f} nm", PAPER_PRICES["infrared LED"]
        ),
        BillItem("LED switch", 1, "MOSFET, as BSS138", PAPER_PRICES["LED switch"]),
        BillItem("resistor", LEDS, "0.1 %, for equal LEDs", PAPER_PRICES["resistor"]),
        BillItem("holder", 1, "printed, as drawn by locatk camera design --holder"),
    )
