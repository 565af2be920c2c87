"""What a floor of landmarks is made of: a bill of materials, and counts by pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, PATTERNS
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.materials import GRADES_T, Item

FERRITE_T = (0.20, 0.45)
"""Remanence of sintered hard ferrite, Y8T to Y40 (SJ/T 10410-2000, as makers list
it: http://magneticalloy.com/ferrite-magnet.htm)."""

SPARES_PERCENT = 5.0


@dataclass(frozen=True)
class PatternCount:
    """How often a pattern is laid.

    Attributes
    ----------
    number : int
        The paper's, 1 to 6.
    letters : str
    codes : tuple of (code, count)
        In which orientations, ascending.
    """

    number: int
    letters: str
    codes: tuple[tuple[int, int], ...]

    @property
    def landmarks(self) -> int:
        """Of all orientations."""
        return sum(count for _, count in self.codes)


def patterns(floor: FloorMap) -> tuple[PatternCount, ...]:
    """The patterns that occur, by number."""
    laid = [int(floor.codes[cell]) for cell in floor.cells()]
    counts = {code: laid.count(code) for code in range(CODE_COUNT)}
    found = []
    for number, letters in enumerate(PATTERNS, 1):
        codes = [(c, n) for c, n in counts.items() if n and PATTERN_OF[c] == number]
        if codes:
            found.append(PatternCount(number, letters, tuple(codes)))
    return tuple(found)


def material(remanence_t: float) -> str:
    """What kind of magnet has this remanence, to ask a shop for.

    Examples
    --------
    >>> material(1.2), material(0.4)
    ('NdFeB N35', 'ferrite')
    """
    near = 0.005
    grades = [
        grade for grade, (low, high) in GRADES_T.items() if low - near <= remanence_t <= high + near
    ]
    if grades:
        return f"NdFeB {' or '.join(grades)}"
    if FERRITE_T[0] <= remanence_t <= FERRITE_T[1]:
        return "ferrite"
    return "magnet"


def bill(floor: FloorMap, spares_percent: float = SPARES_PERCENT) -> tuple[Item, ...]:
    """What it takes to lay the floor: four bars a landmark, spares, and how to fix them.

    Raises
    ------
    InputError
        Spares of less than nothing, or of more than ten times the bars.
    """
    if not 0 <= spares_percent <= 1000:
        raise InputError(f"spares of {spares_percent:g} %", hint="Give 0 to 1000")
    geometry, landmarks = floor.geometry, len(floor.cells())
    length, width, height = (
        1e3 * side for side in (geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m)
    )
    bars = 4 * landmarks
    spares = math.ceil(bars * spares_percent / 100 - 1e-9)
    size = (
        f"{length:g} x {width:g} x {height:g} mm {material(geometry.remanence_t)}, Br "
        f"{geometry.remanence_t:g} T, magnetised along its {length:g} mm"
    )
    area_cm2 = (bars + spares) * length * width / 100
    tape_m = (bars + spares) * length / 1e3
    items = [Item("bar magnet", bars, f"{size}; {landmarks} landmarks of 4")]
    if spares:
        items.append(
            Item(
                "bar magnet, spare", spares, f"{size}; one for each {100 / spares_percent:.3g} bars"
            )
        )
    return (
        *items,
        Item(
            "adhesive",
            1,
            f"two-part epoxy for {area_cm2:.0f} cm2 (about {area_cm2 * 0.03:.0f} g at 0.3 mm), or "
            f"double-sided tape {width:g} mm wide, {tape_m:.1f} m",
        ),
        Item("compass", 1, "or a bar whose north pole is marked, to test polarity"),
        Item("marker", 1, "to mark the north end of each bar before it is laid"),
        Item("chalk line", 1, f"with a tape measure; cells are {1e3 * floor.pitch_m:g} mm apart"),
    )
