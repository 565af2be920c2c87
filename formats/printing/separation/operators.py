"""The operators of a PDF content stream that set a colour, set without black."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np
import pikepdf
from pikepdf import Name, Operator, PdfInlineImage, Stream

from locatk.formats.printing.separation import colours
from locatk.formats.printing.separation.colours import Space


@dataclass(frozen=True)
class Pattern:
    """Current colour space: patterns, whose stencils take colours of ``base``."""

    base: Space | None


INHERITED = "inherited"
"""Current colour space of a form before it has set one: that of its caller."""

UNKNOWN = None
"""Current colour space that cannot be converted."""

Current = Space | Pattern | str | None

DEVICE = {"g": colours.GREY, "rg": colours.RGB, "k": colours.CMYK}
"""What sets colour and space at once; the same in capitals for lines."""

SETS = {"sc", "scn", "SC", "SCN"}


def rewrite(
    stream: Stream,
    look_up: Callable[[Name], Any],
    base: Callable[[pikepdf.Object], Space | None],
    inline: Callable[[PdfInlineImage], Name],
    left: Counter[str],
    *,
    starts: bool,
) -> bytes:
    """The content of ``stream`` with all colours in cyan, magenta and yellow.

    Parameters
    ----------
    stream : Stream
    look_up : callable
        From the name of a colour space to its Space, to the Array of a pattern space, or to
        None where it cannot be converted.
    base : callable
        From the colours of a pattern space to their Space, or None.
    inline : callable
        From an image in the content to the name of one in the resources that replaces it.
    left : Counter of str
        Counts what stays as it is.
    starts : bool
        It starts with the colour that pages start with, and not with that of a caller.

    Raises
    ------
    PdfError
        It cannot be parsed.
    """
    current: list[Current] = [colours.GREY if starts else INHERITED] * 2
    stack: list[list[Current]] = []
    paint = _Paint()
    out: list[Any] = []
    instruction: Any
    for instruction in pikepdf.parse_content_stream(stream):
        operator = str(instruction.operator)
        if operator == "q":
            stack.append(current.copy())
        elif operator == "Q":
            current = stack.pop() if stack else current
        elif operator.lower() in DEVICE:
            current[operator.isupper()] = DEVICE[operator.lower()]
            instruction = _converted(instruction, DEVICE[operator.lower()], paint, left)
        elif operator in ("cs", "CS"):
            name = instruction.operands[0] if len(instruction.operands) else None
            found = look_up(name) if isinstance(name, Name) else None
            if isinstance(found, pikepdf.Array):
                found = Pattern(base(found[1]) if len(found) > 1 else None)
            current[operator.isupper()] = found
            if isinstance(found, Space):
                instruction = paint(found, found.initial, operator)
        elif operator in SETS:
            instruction = _converted(instruction, current[operator.isupper()], paint, left)
        elif operator == "INLINE IMAGE" and not instruction.iimage.image_mask:
            instruction = ([inline(instruction.iimage)], Operator("Do"))
        out.append(instruction)
    return pikepdf.unparse_content_stream(out)


class _Paint:
    """Makes the instruction that sets a colour; remembers those it has made."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, tuple[float, ...]], tuple[Any, ...]] = {}

    def numbers(self, found: Space, values: tuple[float, ...]) -> tuple[Any, ...]:
        """Cyan, magenta, yellow and no black, as a content stream writes them."""
        key = (id(found), values)
        if key not in self._known:
            cmy = found.cmy(np.array([values]))[0]
            self._known[key] = tuple(Decimal(f"{value:.4g}") for value in (*cmy, 0.0))
        return self._known[key]

    def __call__(
        self, found: Space, values: tuple[float, ...], operator: str
    ) -> tuple[Sequence[Any], Operator]:
        return self.numbers(found, values), Operator("K" if operator.isupper() else "k")


def _converted(instruction: Any, current: Current, paint: _Paint, left: Counter[str]) -> Any:
    """The instruction that sets the same colour without black."""
    operator = str(instruction.operator)
    operands = list(instruction.operands)
    pattern = operands.pop() if operands and isinstance(operands[-1], Name) else None
    if pattern is not None and not operands:
        return instruction  # a pattern with colours of its own
    if current == INHERITED:
        current = colours.BY_COMPONENTS.get(len(operands))
        current = Pattern(current) if pattern is not None else current
    if isinstance(current, Pattern):
        current = current.base if pattern is not None else None
    elif pattern is not None:
        current = None
    if not isinstance(current, Space):
        left["colours in a spot or Lab colour space"] += 1
        return instruction
    try:
        values = tuple(float(operand) for operand in operands)
    except (TypeError, ValueError):
        values = ()
    if len(values) != current.components:
        left["colours that are damaged"] += 1
        return instruction
    if pattern is not None:
        return ([*paint.numbers(current, values), pattern], Operator(operator))
    return paint(current, values, operator)
