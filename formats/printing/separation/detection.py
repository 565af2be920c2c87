"""Search for black ink in the pages of a PDF.

Cameras for dots work in the infrared, in which black ink is as dark as the dots (see
:mod:`~locatk.formats.printing.separation.content`). :class:`BlackFinder` finds painted colours that
a printer prints with black ink; it does not find out if something else covers them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pikepdf
from pikepdf import Array, Dictionary, Name, Pdf, PdfImage, Stream

from locatk.formats.printing.separation import colours
from locatk.formats.printing.separation.colours import ColourSpace, numbers
from locatk.formats.printing.separation.content import (
    COLOUR_OPERATORS,
    DAMAGE_ERRORS,
    DEVICE_OPERATORS,
)
from locatk.formats.printing.separation.images import BLOCK_PIXELS, inline_stream

MIN_BLACK = 1 / 36
"""Amount of black ink that covers as much paper as dots of 1/6 pitch do: (1/6)^2.

As a halftone, it gives as many dark spots as the pattern has."""

FILLING = {"f", "F", "f*", "B", "B*", "b", "b*"}
STROKING = {"S", "s", "B", "B*", "b", "b*"}
SHOWING = {"Tj", "TJ", "'", '"'}

FILLED_TEXT, STROKED_TEXT = {0, 2, 4, 6}, {1, 2, 5, 6}
"""Text rendering modes (ISO 32000-1 table 106); 3 is invisible, as of recognized text on scans."""

MAX_IMAGE_PIXELS = 50_000_000
"""Largest image that is decoded, in 0.4 GB; larger ones count as black."""

SHADING_STEPS = 64
"""Colours of a shading that are examined."""


class BlackFinder:
    """Finds out if content of one document is printed with black ink.

    Damaged objects, spot colours of an unknown composition and Lab colours count as not black.
    Images and shadings that cannot be decoded count as black.
    """

    def __init__(self) -> None:
        self._found: dict[tuple[Any, ...], bool] = {}

    def is_black(self, form: Stream) -> bool:
        """Return True if a page, given as a form, is printed with black ink."""
        return self._content(form, form.get("/Resources", Dictionary()), (True, True))

    def _once(self, key: tuple[Any, ...], item: Any, find: Callable[[], bool]) -> bool:
        """Return the result of ``find`` for an object, which is called only once."""
        if item.is_indirect and (*key, item.objgen) in self._found:
            return self._found[*key, item.objgen]
        if item.is_indirect:
            self._found[*key, item.objgen] = False  # until it is known: it may contain itself
        try:
            is_black = find()
        except DAMAGE_ERRORS:
            is_black = False
        if item.is_indirect:
            self._found[*key, item.objgen] = is_black
        return is_black

    def _content(self, stream: Stream, resources: Any, initial: tuple[bool, bool]) -> bool:
        """Return True if a content stream is black.

        ``initial`` tells if fill and stroke are black when it begins.
        """
        find = lambda: _Walk(self, resources, initial).is_black(stream)  # noqa: E731
        return self._once(("content", *initial), stream, find)

    def xobject(self, item: Any, resources: Any, current: tuple[bool, bool]) -> bool:
        """Return True if a form or an image is black."""
        if item.get("/Subtype") == "/Form":
            return self._content(item, item.get("/Resources", resources), current)
        if item.get("/ImageMask", False):
            return current[0]
        return self._once(("image",), item, lambda: _is_black_image(item))

    def pattern(self, item: Any, resources: Any, is_uncoloured_black: bool) -> bool:
        """Return True if a pattern is black."""
        if "/Shading" in item:
            return self.shading(item.Shading, resources)
        if int(item.get("/PaintType", 1)) == 2:
            return is_uncoloured_black
        return self._content(item, item.get("/Resources", resources), (True, True))

    def shading(self, item: Any, resources: Any) -> bool:
        """Return True if a shading is black."""
        spaces = resources.get("/ColorSpace")
        return self._once(("shading",), item, lambda: _is_black_shading(item, spaces))

    def font(self, item: Any, resources: Any, current: tuple[bool, bool]) -> bool:
        """Return True if text of a font is black."""
        if item is None or item.get("/Subtype") != "/Type3":
            return any(current)
        inner = item.get("/Resources", resources)
        return any(self._content(glyph, inner, current) for _, glyph in item.CharProcs.items())


class _Walk:
    """Walk through the operators of one content stream."""

    def __init__(self, finder: BlackFinder, resources: Any, initial: tuple[bool, bool]) -> None:
        self._finder, self._resources = finder, resources
        # Fill and stroke: black or not, and the colour space.
        self._black = list(initial)
        self._spaces: list[ColourSpace | None] = [colours.GREY, colours.GREY]
        self._font: Any = None
        self._text_mode = 0
        self._stack: list[tuple[Any, ...]] = []

    def is_black(self, stream: Stream) -> bool:
        """Return True at the first black operator."""
        with warnings.catch_warnings():
            # Content that ends early is drawn up to there.
            warnings.simplefilter("ignore", UserWarning)
            instructions: Any = pikepdf.parse_content_stream(stream)
        return any(self._paints_black(str(item.operator), item.operands) for item in instructions)

    def _paints_black(self, operator: str, operands: Any) -> bool:
        """Follow the graphics state; return True if the operator paints in black."""
        is_line = operator.isupper()
        if operator == "q":
            state = (list(self._black), list(self._spaces), self._font, self._text_mode)
            self._stack.append(state)
        elif operator == "Q" and self._stack:
            self._black, self._spaces, self._font, self._text_mode = self._stack.pop()
        elif operator.lower() in DEVICE_OPERATORS:
            self._spaces[is_line] = DEVICE_OPERATORS[operator.lower()]
            self._black[is_line] = self._is_black_colour(self._spaces[is_line], operands)
        elif operator in ("cs", "CS"):
            space = self._read_space(operands[0])
            self._spaces[is_line] = space
            self._black[is_line] = space is not None and _is_black(space, [space.initial])
        elif operator in COLOUR_OPERATORS:
            self._black[is_line] = self._is_black_colour(self._spaces[is_line], operands)
        elif operator == "Tf":
            self._font = self._resource("/Font", operands[0])
        elif operator == "Tr":
            self._text_mode = int(operands[0])
        elif operator in SHOWING:
            return self._shows_black()
        elif operator == "Do":
            item = self._resource("/XObject", operands[0])
            current = (self._black[0], self._black[1])
            return item is not None and self._finder.xobject(item, self._resources, current)
        elif operator == "sh":
            item = self._resource("/Shading", operands[0])
            return item is not None and self._finder.shading(item, self._resources)
        elif operator == "INLINE IMAGE":
            image = operands[0]
            if image.image_mask:
                return self._black[0]
            with Pdf.new() as pdf:
                return _is_black_image(inline_stream(pdf, image))
        return (operator in FILLING and self._black[0]) or (operator in STROKING and self._black[1])

    def _shows_black(self) -> bool:
        fill = self._black[0] and self._text_mode in FILLED_TEXT
        stroke = self._black[1] and self._text_mode in STROKED_TEXT
        return self._finder.font(self._font, self._resources, (fill, stroke))

    def _resource(self, kind: str, name: Any) -> Any:
        return self._resources.get(kind, Dictionary()).get(str(name))

    def _read_space(self, name: Any) -> ColourSpace | None:
        """Return a colour space; that of its colours for a pattern space."""
        spaces = self._resources.get("/ColorSpace")
        definition = None if spaces is None else spaces.get(str(name))
        if isinstance(definition, Array) and len(definition) > 1 and definition[0] == "/Pattern":
            return colours.read_colour_space(definition[1], spaces)
        return colours.read_colour_space(name, spaces)

    def _is_black_colour(self, space: ColourSpace | None, operands: Any) -> bool:
        values = [float(value) for value in operands if not isinstance(value, Name)]
        is_black = (
            space is not None and len(values) == space.components and _is_black(space, [values])
        )
        if len(operands) and isinstance(operands[-1], Name):
            item = self._resource("/Pattern", operands[-1])
            return item is not None and self._finder.pattern(item, self._resources, is_black)
        return is_black


def _is_black(space: ColourSpace, values: Any) -> bool:
    return bool((space.black(np.asarray(values, float)) > MIN_BLACK).any())


def _is_black_image(image: Stream) -> bool:
    """Return True if a pixel of an image is black; also if the image cannot be decoded."""
    if int(image.Width) * int(image.Height) > MAX_IMAGE_PIXELS:
        return True
    try:
        picture = PdfImage(image).as_pil_image()
        is_cmyk = picture.mode == "CMYK"
        pixels = np.asarray(picture if is_cmyk else picture.convert("RGBA"))
    except Exception:  # decoders raise their own kinds
        return True
    space = colours.CMYK if is_cmyk else colours.RGB
    # Without the pixels that are wholly transparent, which are black in many images.
    samples = pixels.reshape(-1, 4) if is_cmyk else pixels[pixels[..., 3] > 0][:, :3]
    return any(
        _is_black(space, samples[start : start + BLOCK_PIXELS] / 255.0)
        for start in range(0, len(samples), BLOCK_PIXELS)
    )


def _is_black_shading(shaded: Any, spaces: Any) -> bool:
    """Return True if a shading has a black colour; also for formulas, and meshes of colours."""
    space = colours.read_colour_space(shaded.get("/ColorSpace"), spaces)
    function = shaded.get("/Function")
    if space is None or function is None or int(shaded.ShadingType) == 1:
        return space is not None
    transform = colours.read_function(function)
    domain = numbers(function.Domain) if isinstance(function, Dictionary | Stream) else (0.0, 1.0)
    along = np.linspace(domain[0], domain[1], SHADING_STEPS)
    return transform is None or _is_black(space, transform(along))
