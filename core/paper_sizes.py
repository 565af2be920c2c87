"""Sizes of printing paper: sheets by name or by width and height, and rolls by width."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from locatk.core.errors import InputError

PAPER_SIZES_MM = {
    "A0": (841.0, 1189.0),
    "A1": (594.0, 841.0),
    "A2": (420.0, 594.0),
    "A3": (297.0, 420.0),
    "A4": (210.0, 297.0),
    "A5": (148.0, 210.0),
    "Letter": (215.9, 279.4),
    "Tabloid": (279.4, 431.8),
}
"""Width and height of papers by their names (ISO 216, ANSI/ASME Y14.1)."""

MAX_PAPER_MM = 100_000.0
"""Largest width or height of a sheet; a larger one is probably a wrong unit."""

MAX_ROLL_WIDTH_MM = 5_000.0
"""Largest width of a roll: the widest printers in use take 5 m."""

PAPER_NAME_TOLERANCE_MM = 1.0
"""Largest difference between the sides of a page and those of a paper of that name."""

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, '"': 25.4}
"""Units in which sizes are given, in mm."""

_NUMBER, _UNIT = r"(\d+(?:\.\d+)?)", r"(mm|cm|m|in|\")?"
_SIZE = re.compile(rf"{_NUMBER}\s*x\s*{_NUMBER}\s*{_UNIT}", re.IGNORECASE | re.ASCII)
_ROLL = re.compile(rf"roll:{_NUMBER}\s*{_UNIT}", re.IGNORECASE | re.ASCII)


@dataclass(frozen=True)
class Paper:
    """Sheets of one size, or a roll, whose height is infinite."""

    name: str
    size_mm: tuple[float, float]

    @property
    def is_roll(self) -> bool:
        return math.isinf(self.size_mm[1])


def parse_paper(text: str) -> Paper:
    """Return a paper by name or size as :func:`paper_size` does, or a roll as ``"roll:914mm"``.

    Raises
    ------
    InputError
        There is no such paper.

    Examples
    --------
    >>> parse_paper("roll:914mm").size_mm
    (914.0, inf)
    """
    text = text.strip()
    if not text.lower().startswith("roll"):
        return Paper(*paper_size(text))
    match = _ROLL.fullmatch(text)
    width = _millimetres(match[1], match[2]) if match else 0.0
    if not 0 < width <= MAX_ROLL_WIDTH_MM:
        raise InputError(
            f"no paper {text!r}", hint="A roll is named by its width: roll:914mm or roll:36in"
        )
    return Paper(f"roll:{width:g}mm", (width, math.inf))


def paper_size(text: str, *, landscape: bool | None = None) -> tuple[str, tuple[float, float]]:
    """Return the name, and the width and height in mm, of a paper.

    Parameters
    ----------
    text : str
        A name in :data:`PAPER_SIZES_MM`, in upper or lower case, or width and height with a unit
        of :data:`UNITS_MM`, by default mm: ``"600x3000mm"``, ``"24x36in"``.
    landscape : bool, optional
        Rotate it so that its width is the longer (True) or the shorter (False) side.

    Raises
    ------
    InputError
        There is no such paper.

    Examples
    --------
    >>> paper_size("a4", landscape=True)
    ('A4', (297.0, 210.0))
    >>> paper_size("600x3000mm")
    ('600x3000', (600.0, 3000.0))
    >>> paper_size("24x36in")
    ('609.6x914.4', (609.6, 914.4))
    """
    names = {name.lower(): name for name in PAPER_SIZES_MM}
    match = _SIZE.fullmatch(text.strip())
    if match:
        width, height = (_millimetres(side, match[3]) for side in match.groups()[:2])
        name = f"{width:g}x{height:g}"
        if not all(0 < side <= MAX_PAPER_MM for side in (width, height)):
            raise InputError(
                f"a paper of {name} mm", hint=f"Sides are above 0 and up to {MAX_PAPER_MM:g} mm"
            )
    elif text.strip().lower() in names:
        name = names[text.strip().lower()]
        width, height = PAPER_SIZES_MM[name]
    else:
        raise InputError(
            f"no paper {text!r}",
            hint=f"Use {', '.join(PAPER_SIZES_MM)} or a size, as in 600x3000mm or 24x36in",
        )
    if landscape is not None and landscape != (width > height):
        width, height = height, width
    return name, (width, height)


def _millimetres(number: str, unit: str | None) -> float:
    # Rounded to a nanometre: 0.6 m is 600 mm.
    return round(float(number) * UNITS_MM[(unit or "mm").lower()], 6)


def paper_name(page_mm: tuple[float, float]) -> str:
    """Return the name of the paper of this size, in either orientation; otherwise ``"WxH"``."""
    for name, sides in PAPER_SIZES_MM.items():
        pairs = zip(sorted(page_mm), sorted(sides), strict=True)
        if all(abs(side - known) <= PAPER_NAME_TOLERANCE_MM for side, known in pairs):
            return name
    return "x".join(f"{side:.0f}" for side in page_mm)
