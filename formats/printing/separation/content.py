"""PDF content without black ink, so that only the dots printed over it are black.

Cameras for dots work in the infrared, in which black ink (carbon) is dark and the other three inks
are transparent: black text below the dots hides them, text in cyan, magenta and yellow does not
(HP's patent US 7903281 describes this). Black is therefore replaced by a mix of the other three
wherever the document specifies a colour: in content streams (:func:`rewrite_colours`), and in the
resources that they use (:class:`BlackRemover`).
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np
import pikepdf
from pikepdf import Array, Dictionary, Name, Operator, Pdf, PdfInlineImage, Stream

from locatk.formats.printing.separation import colours, images, instructions
from locatk.formats.printing.separation.colours import ColourSpace
from locatk.formats.printing.separation.images import NotConvertible
from locatk.formats.printing.separation.instructions import INLINE_IMAGE

DAMAGE_ERRORS = (
    pikepdf.PdfError,
    pikepdf.DataDecodingError,
    pikepdf.models.PdfParsingError,
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError),
)
"""Exceptions raised when a damaged object is read."""

INITIAL_COLOURS = b"1 1 1 0 k 1 1 1 0 K\n"
"""Operators that replace the initial black of a page."""


# ---- content streams


@dataclass(frozen=True)
class PatternSpace:
    """Current colour space of patterns; colours of uncoloured ones are of the space ``base``."""

    base: ColourSpace | None


INHERITED = "inherited"
"""Current colour space of a form that has not set one: that of its caller."""

CurrentSpace = ColourSpace | PatternSpace | str | None
"""Current colour space; None if it cannot be converted."""

DEVICE_OPERATORS = {"g": colours.GREY, "rg": colours.RGB, "k": colours.CMYK}
"""Operators that set colour and space; in upper case for lines."""

COLOUR_OPERATORS = {"sc", "scn", "SC", "SCN"}


Instruction = tuple[Sequence[Any], Operator]
"""Operands and operator."""

BLOCK_INSTRUCTIONS = 10_000
"""Instructions that are in memory at the same time."""


def rewrite_colours(
    stream: Stream,
    look_up: Callable[[Name], Any],
    base: Callable[[pikepdf.Object], ColourSpace | None],
    inline: Callable[[PdfInlineImage], Name],
    left: Counter[str],
    *,
    starts: bool,
) -> bytes:
    """Return the content of ``stream`` with all colours in cyan, magenta and yellow.

    Parameters
    ----------
    stream : Stream
    look_up : callable
        Maps the name of a colour space to its ColourSpace, to the Array of a pattern space, or to
        None if it cannot be converted.
    base : callable
        Maps the colours of a pattern space to their ColourSpace, or to None.
    inline : callable
        Maps an inline image to the name of the resource that replaces it.
    left : Counter of str
        Counts the objects that remain unchanged.
    starts : bool
        True if the content starts with the initial colour of a page, not with that of a caller.

    Raises
    ------
    PdfError
        The content cannot be parsed.
    """
    current: list[CurrentSpace] = [colours.GREY if starts else INHERITED] * 2
    stack: list[list[CurrentSpace]] = []
    paint = _Paint()
    out: list[Instruction] = []
    done: list[bytes] = []

    def convert(operator: str, operands: list[Any]) -> None:
        instruction: Instruction = (operands, Operator(operator))
        if operator == "q":
            stack.append(current.copy())
        elif operator == "Q" and stack:
            current[:] = stack.pop()
        elif operator.lower() in DEVICE_OPERATORS:
            current[operator.isupper()] = DEVICE_OPERATORS[operator.lower()]
            instruction = _converted(instruction, DEVICE_OPERATORS[operator.lower()], paint, left)
        elif operator in ("cs", "CS"):
            name = operands[0] if operands else None
            space = look_up(name) if isinstance(name, Name) else None
            if isinstance(space, pikepdf.Array):
                space = PatternSpace(base(space[1]) if len(space) > 1 else None)
            current[operator.isupper()] = space
            if isinstance(space, ColourSpace):
                instruction = paint(space, space.initial, operator)
        elif operator in COLOUR_OPERATORS:
            instruction = _converted(instruction, current[operator.isupper()], paint, left)
        elif operator == INLINE_IMAGE and not operands[0].image_mask:
            instruction = ([inline(operands[0])], Operator("Do"))
        out.append(instruction)
        if len(out) == BLOCK_INSTRUCTIONS:
            done.append(pikepdf.unparse_content_stream(out))
            out.clear()

    instructions.follow(stream, convert)
    return b"\n".join([*done, pikepdf.unparse_content_stream(out)])


class _Paint:
    """Creates the instructions that set a colour, with a cache."""

    def __init__(self) -> None:
        self._cache: dict[tuple[int, tuple[float, ...]], tuple[Any, ...]] = {}

    def numbers(self, space: ColourSpace, values: tuple[float, ...]) -> tuple[Any, ...]:
        """Return cyan, magenta, yellow and zero black as numbers of a content stream."""
        key = (id(space), values)
        if key not in self._cache:
            cmy = space.cmy(np.array([values]))[0]
            self._cache[key] = tuple(Decimal(f"{value:.4g}") for value in (*cmy, 0.0))
        return self._cache[key]

    def __call__(self, space: ColourSpace, values: tuple[float, ...], operator: str) -> Instruction:
        return self.numbers(space, values), Operator("K" if operator.isupper() else "k")


def _converted(
    instruction: Instruction, current: CurrentSpace, paint: _Paint, left: Counter[str]
) -> Instruction:
    """Return the instruction that sets the same colour without black."""
    operator = str(instruction[1])
    operands = list(instruction[0])
    pattern = operands.pop() if operands and isinstance(operands[-1], Name) else None
    if pattern is not None and not operands:
        return instruction  # a pattern with colours of its own
    if current == INHERITED:
        current = colours.BY_COMPONENTS.get(len(operands))
        current = PatternSpace(current) if pattern is not None else current
    if isinstance(current, PatternSpace):
        current = current.base if pattern is not None else None
    elif pattern is not None:
        current = None
    if not isinstance(current, ColourSpace):
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


# ---- resources


@dataclass(frozen=True)
class ResourceScope:
    """Resources of the original, in which names are looked up, and the converted ones."""

    original: pikepdf.Object
    converted: pikepdf.Object


class BlackRemover:
    """Converts content of one document to cyan, magenta and yellow.

    Objects are not changed in place, since the same object may also be used in soft masks, in
    which black is not ink; new objects share unchanged parts. Objects that cannot be converted
    remain unchanged and are counted.

    Attributes
    ----------
    left : Counter of str
        Kinds of objects that are still black, and their numbers.
    """

    def __init__(self, pdf: Pdf) -> None:
        self.left: Counter[str] = Counter()
        self._pdf = pdf
        self._inks = images.inks_space(pdf)
        self._converted: dict[tuple[str, tuple[int, int]], Any] = {}

    def form(self, stream: Stream, outer: ResourceScope | None = None, *, starts: bool) -> Stream:
        """Return a form or tiling pattern without black, as a new stream.

        Parameters
        ----------
        stream : Stream
        outer : ResourceScope, optional
            Resources of the content that paints it, for forms without resources.
        starts : bool
            True if no colour was set before, so that it starts with black.

        Raises
        ------
        PdfError
            The content cannot be parsed.
        """

        def fill(converted: Stream) -> None:
            own = stream.get("/Resources")
            scope = outer if own is None and outer else self._scope(own or Dictionary())
            converted.Resources = scope.converted
            if "/Group" in stream and "/CS" in stream.Group:
                # Blending in RGB converts all colours to RGB, which the printer converts to black.
                converted.Group = copy.copy(stream.Group)
                converted.Group.CS = Name.DeviceCMYK
            data = self._content(stream, scope, starts)
            converted.write(INITIAL_COLOURS + data if starts else data)

        converted: Stream = self._once("form", stream, fill)
        return converted

    def _once(self, role: str, original: Any, fill: Callable[[Any], None]) -> Any:
        """Return a copy of ``original`` that is completed by ``fill``; the same one each time."""
        key = (role, original.objgen)
        if original.is_indirect and key in self._converted:
            return self._converted[key]
        converted = self._pdf.make_indirect(copy.copy(original))
        if original.is_indirect:
            self._converted[key] = converted  # before it is completed: it may contain itself
        fill(converted)
        return converted

    def _try(self, kind: str, original: Any, convert: Callable[[], Any]) -> Any:
        """Return the result of ``convert``, or ``original`` (and count it) if it fails."""
        key = (kind, original.objgen)
        if original.is_indirect and key in self._converted:
            return self._converted[key]
        try:
            converted = convert()
        except NotConvertible as reason:
            self.left[str(reason)] += 1
            converted = original
        except DAMAGE_ERRORS:
            self.left[f"{kind} that are damaged"] += 1
            converted = original
        if original.is_indirect:
            converted = self._pdf.make_indirect(converted)
            self._converted[key] = converted
        return converted

    def _scope(self, original: pikepdf.Object) -> ResourceScope:
        def fill(converted: pikepdf.Object) -> None:
            scope = ResourceScope(original, converted)
            jobs = {
                "/Shading": self._shading,
                "/Pattern": self._pattern,
                "/XObject": self._xobject,
                "/Font": self._font,
            }
            # Copy all first, since content may add to resources that are not converted yet.
            for key in jobs:
                converted[key] = copy.copy(original.get(key, Dictionary()))
            for key, convert in jobs.items():
                for name, item in original.get(key, Dictionary()).items():
                    if isinstance(item, Dictionary | Stream):
                        converted[key][name] = convert(item, scope)
            spaces = original.get("/ColorSpace")
            if spaces is not None:
                kept = {name: self._kept_space(item, spaces) for name, item in spaces.items()}
                converted.ColorSpace = Dictionary({k: v for k, v in kept.items() if v is not None})

        return ResourceScope(original, self._once("resources", original, fill))

    def _xobject(self, item: Any, scope: ResourceScope) -> Any:
        kind = str(item.get("/Subtype"))
        if kind == "/Form":
            return self._try("forms", item, lambda: self.form(item, scope, starts=False))
        if kind == "/Image":
            spaces = scope.original.get("/ColorSpace")
            convert = lambda: images.convert_image(self._pdf, item, spaces, self._inks)  # noqa: E731
            return self._try("images", item, convert)
        return item

    def _shading(self, item: Any, scope: ResourceScope) -> Any:
        spaces = scope.original.get("/ColorSpace")
        convert = lambda: images.convert_shading(self._pdf, item, spaces, self._inks)  # noqa: E731
        return self._try("shadings", item, convert)

    def _pattern(self, item: Any, scope: ResourceScope) -> Any:
        if int(item.get("/PatternType", 0)) == 1:
            if int(item.get("/PaintType", 1)) != 1:
                return item  # a stencil, in the colour given with its name
            return self._try("patterns", item, lambda: self.form(item, scope, starts=True))

        def fill(converted: pikepdf.Object) -> None:
            converted.Shading = self._shading(item.Shading, scope)

        return self._once("pattern", item, fill) if "/Shading" in item else item

    def _font(self, item: Any, scope: ResourceScope) -> Any:
        if str(item.get("/Subtype")) != "/Type3":
            return item

        def fill(converted: pikepdf.Object) -> None:
            own = self._scope(item.Resources) if "/Resources" in item else scope
            converted.Resources = own.converted
            converted.CharProcs = Dictionary(
                {name: self._glyph(glyph, own) for name, glyph in item.CharProcs.items()}
            )

        return self._try("fonts", item, lambda: self._once("font", item, fill))

    def _glyph(self, glyph: Any, scope: ResourceScope) -> Any:
        if b"d1" in glyph.read_bytes()[:200]:
            return glyph  # a stencil: its own colours are ignored
        return self._once(
            "glyph", glyph, lambda converted: converted.write(self._content(glyph, scope, False))
        )

    def _content(self, stream: Stream, scope: ResourceScope, starts: bool) -> bytes:
        spaces = scope.original.get("/ColorSpace")

        def look_up(name: pikepdf.Object) -> ColourSpace | pikepdf.Object | None:
            """Return a space, the array of a pattern space, or None if it cannot be converted."""
            original = None if spaces is None else spaces.get(str(name))
            if str(name) == "/Pattern":
                return Array([name])
            if isinstance(original, Array) and len(original) and str(original[0]) == "/Pattern":
                return original
            return self._space(name, spaces)

        return rewrite_colours(
            stream,
            look_up,
            lambda original: self._space(original, spaces),
            lambda image: self._name_inline(image, scope),
            self.left,
            starts=starts,
        )

    def _name_inline(self, image: PdfInlineImage, scope: ResourceScope) -> Name:
        """Add an inline image to the resources, and return its name."""
        stream = images.inline_stream(self._pdf, image)
        resources = scope.converted.XObject
        number = len(resources)
        while (name := f"/Inline{number}") in resources:
            number += 1
        resources[name] = self._xobject(stream, scope)
        return Name(name)

    def _space(self, original: pikepdf.Object, spaces: pikepdf.Object | None) -> ColourSpace | None:
        try:
            return colours.read_convertible_space(original, spaces)
        except DAMAGE_ERRORS:
            return None

    def _kept_space(self, original: pikepdf.Object, spaces: pikepdf.Object) -> Any:
        """Return the converted colour space of a name, or None if no content uses it any more."""
        if isinstance(original, Array) and len(original) > 1 and str(original[0]) == "/Pattern":
            if self._space(original[1], spaces) is not None:
                return Array([Name.Pattern, Name.DeviceCMYK])
            return original
        return original if self._space(original, spaces) is None else None
