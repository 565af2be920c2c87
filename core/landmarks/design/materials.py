"""Bill of materials of a floor of landmarks, and the number of landmarks of each pattern."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import PATTERN_OF, PATTERNS
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.materials import BillItem, magnet_material, size_mm_text

SPARES_PERCENT = 5.0
"""Default of the bars to buy in addition, in percent of the bars of the floor."""

MAX_SPARES_PERCENT = 1000.0
"""Largest percentage of spare bars; a larger one is probably a number of bars."""

PARTS = ("bar magnet", "adhesive", "compass", "marker", "chalk line")
"""Parts of :func:`bill_of_materials`; spares have the price of their part."""

EPOXY_G_PER_CM2 = 0.03
"""Mass of a layer of epoxy 0.3 mm thick, at 1 g/cm3."""


@dataclass(frozen=True)
class PatternCount:
    """Number of landmarks of one pattern on a floor.

    Attributes
    ----------
    number : int
        Number of the pattern in the paper, 1 to 6.
    letters : str
    codes : tuple of (code, count)
        Orientations that occur, in ascending order of the codes.
    """

    number: int
    letters: str
    codes: tuple[tuple[int, int], ...]

    @property
    def landmarks(self) -> int:
        """Number of landmarks in all orientations."""
        return sum(count for _, count in self.codes)


def count_patterns(floor: FloorMap) -> tuple[PatternCount, ...]:
    """Count the landmarks of each pattern that occurs, in the order of the patterns' numbers."""
    counts = Counter(int(floor.codes[cell]) for cell in floor.cells())
    patterns = []
    for number, letters in enumerate(PATTERNS, 1):
        codes = [(code, counts[code]) for code in sorted(counts) if PATTERN_OF[code] == number]
        if codes:
            patterns.append(PatternCount(number, letters, tuple(codes)))
    return tuple(patterns)


def bill_of_materials(
    floor: FloorMap, spares_percent: float = SPARES_PERCENT
) -> tuple[BillItem, ...]:
    """List the parts of a floor: four bars for each landmark, spares, and means of fixing them.

    Raises
    ------
    InputError
        The spares are negative or more than :data:`MAX_SPARES_PERCENT`.
    """
    if not 0 <= spares_percent <= MAX_SPARES_PERCENT:
        raise InputError(
            f"spares of {spares_percent:g} %", hint=f"Give 0 to {MAX_SPARES_PERCENT:g}"
        )
    geometry, landmarks = floor.geometry, len(floor.cells())
    length, width = 1e3 * geometry.bar_length_m, 1e3 * geometry.bar_width_m
    bars = 4 * landmarks
    spares = math.ceil(bars * spares_percent / 100 - 1e-9)
    size = size_mm_text(geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m)
    bar = (
        f"{size} {magnet_material(geometry.remanence_t)}, Br {geometry.remanence_t:g} T, "
        f"magnetised along its {length:g} mm"
    )
    area_cm2 = (bars + spares) * length * width / 100
    tape_m = (bars + spares) * length / 1e3
    items = [BillItem("bar magnet", bars, f"{bar}; {landmarks} landmarks of 4")]
    if spares:
        interval = 100 / spares_percent
        items.append(
            BillItem("bar magnet, spare", spares, f"{bar}; one for each {interval:.3g} bars")
        )
    return (
        *items,
        BillItem(
            "adhesive",
            1,
            f"two-part epoxy for {area_cm2:.0f} cm2 (about {area_cm2 * EPOXY_G_PER_CM2:.0f} g at "
            f"0.3 mm), or double-sided tape {width:g} mm wide, {tape_m:.1f} m",
        ),
        BillItem("compass", 1, "or a bar whose north pole is marked, to test polarity"),
        BillItem("marker", 1, "to mark the north end of each bar before it is laid"),
        BillItem(
            "chalk line", 1, f"with a tape measure; cells are {1e3 * floor.pitch_m:g} mm apart"
        ),
    )
