"""Search for black ink in the pages of a PDF.

Cameras for dots work in the infrared, in which black ink is as dark as the dots (see
:mod:`~locatk.formats.printing.separation.content`). :class:`BlackFinder` finds painted colours that
a printer prints with black ink. Hidden layers, almost transparent paint, and drawings outside of
the page do not count. Drawings that something else clips or covers do.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pikepdf import Array, Dictionary, Matrix, Name, Pdf, PdfImage, Rectangle, Stream

from locatk.formats.printing.separation import colours, instructions
from locatk.formats.printing.separation.colours import ColourSpace, numbers
from locatk.formats.printing.separation.content import (
    COLOUR_OPERATORS,
    DAMAGE_ERRORS,
    DEVICE_OPERATORS,
)
from locatk.formats.printing.separation.images import BLOCK_PIXELS, inline_stream, read_values
from locatk.formats.printing.separation.instructions import INLINE_IMAGE

MIN_BLACK = 1 / 36
"""Amount of black ink that covers as much paper as dots of 1/6 pitch do: (1/6)^2.

As a halftone, it gives as many dark spots as the pattern has. Paint of this opacity or less has no
more ink than that in any colour, and counts as not black."""

MITER_FACTOR = 5.0
"""Largest distance of an outline from its path, in line widths: half of the miter limit of 10."""

TEXT_HEIGHT_EM = 2.0
"""Largest distance of a glyph from the line on which it is, in font sizes."""

HALF_LINE_LENGTH = 1e9
"""Reach of a line of text to both sides, in its units; without the font, its ends are unknown."""

FILL_OPERATORS = {"f", "F", "f*", "B", "B*", "b", "b*"}
STROKE_OPERATORS = {"S", "s", "B", "B*", "b", "b*"}
PATH_OPERATORS = {"m", "l", "c", "v", "y", "re"}
PATH_END_OPERATORS = {*FILL_OPERATORS, *STROKE_OPERATORS, "n"}
TEXT_POSITION_OPERATORS = {"BT", "Tm", "Td", "TD", "T*", "'", '"'}
TEXT_OPERATORS = {"Tj", "TJ", "'", '"'}

FILLED_TEXT, STROKED_TEXT, INVISIBLE_TEXT = {0, 2, 4, 6}, {1, 2, 5, 6}, 3
"""Text rendering modes (ISO 32000-1 table 106); recognized text on scans is invisible."""

MAX_IMAGE_PIXELS = 50_000_000
"""Largest image that is decoded, in 0.4 GB; larger ones count as black."""

MAX_INSTRUCTIONS = 2_000_000
"""Most instructions of a document that are examined, in about 10 s.

A vector map of 11 MB has about 0.3 million.
"""

MAX_DOMAIN_TYPE = 3
"""Last type of shadings whose colours are a function over the shading's own domain, 0 to 1 if it
has none; those of meshes are one over the range of their values."""

SHADING_STEPS = 64
"""Colours of a shading that are examined."""


@dataclass
class _State:
    """Graphics state; pairs are of fill and stroke.

    Attributes
    ----------
    black : (bool, bool)
        True if the colour is black.
    visible : (bool, bool)
        False if almost transparent.
    spaces : (ColourSpace or None, ColourSpace or None)
    font : Dictionary or None
    text_mode : int
    font_size : float
        Font size.
    line_width : float
    matrix : Matrix
        From the units of drawings to those of the page.
    """

    black: tuple[bool, bool] = (True, True)
    visible: tuple[bool, bool] = (True, True)
    spaces: tuple[ColourSpace | None, ColourSpace | None] = (colours.GREY, colours.GREY)
    font: Any = None
    text_mode: int = 0
    font_size: float = 0.0
    line_width: float = 1.0
    matrix: Matrix = field(default_factory=Matrix)

    def inherited(self) -> _State:
        """Return the state in which a form or a glyph begins."""
        return _State(self.black, self.visible)

    def paints(self, *, fill: bool = False, stroke: bool = False) -> bool:
        """Return True if filling, or stroking, gives black."""
        is_black = [
            black and visible for black, visible in zip(self.black, self.visible, strict=True)
        ]
        return (fill and is_black[0]) or (stroke and is_black[1])


class BlackFinder:
    """Finds out if content of one document is printed with black ink.

    Damaged objects and spot colours of an unknown composition count as not black. Images and
    shadings that cannot be decoded, forms that are nested too deeply, and all that follows the
    first :data:`MAX_INSTRUCTIONS` count as black.
    """

    def __init__(self, pdf: Pdf) -> None:
        self._found: dict[tuple[Any, ...], bool] = {}
        self._instructions = 0
        try:
            self._hidden_layers = frozenset(_hidden_layers(pdf))
        except DAMAGE_ERRORS:
            self._hidden_layers = frozenset()

    def is_black(self, form: Stream, area: Rectangle) -> bool:
        """Return True if a page, given as a form, is printed with black ink within an area."""
        return self._content(form, form.get("/Resources", Dictionary()), _State(), area)

    def _cached(self, key: tuple[Any, ...], item: Any, find: Callable[[], bool]) -> bool:
        """Return the result of ``find`` for an object, which is called only once."""
        if item.is_indirect and (*key, item.objgen) in self._found:
            return self._found[*key, item.objgen]
        if item.is_indirect:
            self._found[*key, item.objgen] = False  # until it is known: it may contain itself
        try:
            is_black = find()
        except RecursionError:
            is_black = True
        except DAMAGE_ERRORS:
            is_black = False
        if item.is_indirect:
            self._found[*key, item.objgen] = is_black
        return is_black

    def _content(
        self, stream: Stream, resources: Any, initial: _State, area: Rectangle | None = None
    ) -> bool:
        """Return True if a content stream is black.

        ``area`` is the page in the units of the stream; without it, everything is on the page.
        """
        find = lambda: _ContentWalk(self, resources, initial, area).is_black(stream)  # noqa: E731
        corners = area and (*area.lower_left, *area.upper_right)
        key = ("content", *initial.black, *initial.visible, corners)
        return self._cached(key, stream, find)

    def count_instruction(self) -> bool:
        """Count an instruction; return True if there are too many to examine."""
        self._instructions += 1
        return self._instructions > MAX_INSTRUCTIONS

    def is_hidden(self, layer: Any) -> bool:
        """Return True if a layer (optional content group or membership) is not printed."""
        if not isinstance(layer, Dictionary):
            return False
        if layer.get("/Type") != "/OCMD":
            return layer.objgen in self._hidden_layers
        members: Any = layer.get("/OCGs", Array())
        groups = [item for item in (members if isinstance(members, Array) else [members]) if item]
        if "/VE" in layer or not groups:
            return False
        hidden = [group.objgen in self._hidden_layers for group in groups]
        policy = str(layer.get("/P", "/AnyOn"))
        return {
            "/AllOn": any(hidden),
            "/AnyOff": not any(hidden),
            "/AllOff": not all(hidden),
        }.get(policy, all(hidden))

    def is_black_xobject(
        self, item: Any, resources: Any, state: _State, area: Rectangle | None
    ) -> bool:
        """Return True if a form or an image is black."""
        if self.is_hidden(item.get("/OC")):
            return False
        if item.get("/Subtype") != "/Form":
            if not state.visible[0] or _is_outside(UNIT_SQUARE, state.matrix, area):
                return False
            if item.get("/ImageMask", False):
                return state.black[0]
            spaces = resources.get("/ColorSpace")
            return self._cached(("image",), item, lambda: _is_black_image(item, spaces))
        inner = state.inherited()
        if "/Group" in item:  # the opacity is that of the group
            if not state.visible[0]:
                return False
            inner.visible = (True, True)
        matrix = Matrix(*item.Matrix) @ state.matrix if "/Matrix" in item else state.matrix
        if _is_outside(Rectangle(item.BBox), matrix, area):
            return False
        # Only content that is not moved, such as that of a page with comments, knows the page: the
        # search in a form must not depend on where it is drawn.
        return self._content(
            item, item.get("/Resources", resources), inner, area if matrix == Matrix() else None
        )

    def is_black_pattern(self, item: Any, resources: Any, is_uncoloured_black: bool) -> bool:
        """Return True if a pattern is black."""
        if "/Shading" in item:
            return self.is_black_shading(item.Shading, resources)
        if int(item.get("/PaintType", 1)) == 2:
            return is_uncoloured_black
        return self._content(item, item.get("/Resources", resources), _State())

    def is_black_shading(self, item: Any, resources: Any) -> bool:
        """Return True if a shading is black."""
        spaces = resources.get("/ColorSpace")
        return self._cached(("shading",), item, lambda: _is_black_shading(item, spaces))

    def is_black_text(self, state: _State, resources: Any) -> bool:
        """Return True if text is black."""
        font = state.font
        if font is None or font.get("/Subtype") != "/Type3":
            fill, stroke = (state.text_mode in modes for modes in (FILLED_TEXT, STROKED_TEXT))
            return state.paints(fill=fill, stroke=stroke)
        if state.text_mode == INVISIBLE_TEXT:
            return False
        # These glyphs are drawings, on which other modes have no effect.
        inner = state.inherited()
        glyphs = [glyph for _, glyph in font.CharProcs.items()]
        resources = font.get("/Resources", resources)
        return any(self._content(glyph, resources, inner) for glyph in glyphs)


UNIT_SQUARE = Rectangle(0, 0, 1, 1)
"""Square that each image fills, in its own units."""


class _ContentWalk:
    """Walk through the operators of one content stream."""

    def __init__(
        self, finder: BlackFinder, resources: Any, initial: _State, area: Rectangle | None
    ) -> None:
        self._finder, self._resources, self._area = finder, resources, area
        self._state = copy.copy(initial)
        self._stack: list[_State] = []
        # For each open sequence of marked content, True if it is of a hidden layer.
        self._sequences: list[bool] = []
        self._path: list[tuple[float, float]] = []
        # Start of the current line of text; None if it is unknown.
        self._line: Matrix | None = None

    def is_black(self, stream: Stream) -> bool:
        """Return True at the first black operator."""
        return instructions.follow(stream, self._follow)

    def _follow(self, operator: str, operands: Any) -> bool:
        """Return True if the operator paints in black; viewers ignore those that are damaged."""
        if self._finder.count_instruction():
            return True
        try:
            return self._paints_black(operator, operands)
        except RecursionError:
            return True
        except DAMAGE_ERRORS:
            return False

    def _paints_black(self, operator: str, operands: Any) -> bool:
        """Follow the graphics state; return True if the operator paints in black."""
        if operator in PATH_OPERATORS:
            self._extend_path(operator, operands)
            return False
        state, is_stroke = self._state, operator.isupper()
        if operator == "q":
            self._stack.append(copy.copy(state))
        elif operator == "Q" and self._stack:
            self._state = self._stack.pop()
        elif operator == "cm":
            state.matrix = _matrix(operands) @ state.matrix
        elif operator == "w":
            state.line_width = float(operands[0])
        elif operator == "gs":
            self._set_parameters(self._resource("/ExtGState", operands[0]))
        elif operator.lower() in DEVICE_OPERATORS:
            self._set_space(is_stroke, DEVICE_OPERATORS[operator.lower()])
            self._set_black(is_stroke, self._is_black_colour(is_stroke, operands))
        elif operator in ("cs", "CS"):
            space = self._read_space(operands[0])
            self._set_space(is_stroke, space)
            self._set_black(is_stroke, space is not None and _is_black(space, [space.initial]))
        elif operator in COLOUR_OPERATORS:
            self._set_black(is_stroke, self._is_black_colour(is_stroke, operands))
        elif operator in ("BMC", "BDC"):
            self._sequences.append(False)  # Also if its operands are damaged, it ends at an EMC.
            self._sequences[-1] = operator == "BDC" and self._is_hidden(*operands)
        elif operator == "EMC":
            del self._sequences[-1:]
        elif operator == "Tf":
            state.font = self._resource("/Font", operands[0])
            state.font_size = float(operands[1])
        elif operator == "Tr":
            state.text_mode = int(operands[0])
        elif operator in TEXT_POSITION_OPERATORS:
            self._move_text(operator, operands)
        try:
            return not any(self._sequences) and self._paints(operator, operands)
        finally:
            if operator in PATH_END_OPERATORS:
                self._path.clear()

    def _paints(self, operator: str, operands: Any) -> bool:
        """Return True if an operator that is not hidden paints in black."""
        state = self._state
        if operator in TEXT_OPERATORS:
            return (
                self._finder.is_black_text(state, self._resources) and not self._is_text_outside()
            )
        if operator == "Do":
            item = self._resource("/XObject", operands[0])
            return item is not None and self._finder.is_black_xobject(
                item, self._resources, state, self._area
            )
        if operator == "sh":
            item = self._resource("/Shading", operands[0])
            return (
                item is not None
                and state.visible[0]
                and self._finder.is_black_shading(item, self._resources)
            )
        if operator == INLINE_IMAGE:
            if not state.visible[0] or _is_outside(UNIT_SQUARE, state.matrix, self._area):
                return False
            image = operands[0]
            if image.image_mask:
                return state.black[0]
            with Pdf.new() as pdf:
                stream = inline_stream(pdf, image)
                return _is_black_image(stream, self._resources.get("/ColorSpace"))
        fill = state.paints(fill=operator in FILL_OPERATORS)
        stroke = state.paints(stroke=operator in STROKE_OPERATORS)
        return (fill or stroke) and not self._is_path_outside(stroke)

    # ---- state

    def _set_space(self, is_stroke: bool, space: ColourSpace | None) -> None:
        self._state.spaces = _replaced(self._state.spaces, is_stroke, space)

    def _set_black(self, is_stroke: bool, is_black: bool) -> None:
        self._state.black = _replaced(self._state.black, is_stroke, is_black)

    def _set_parameters(self, parameters: Any) -> None:
        for is_stroke, key in enumerate(("/ca", "/CA")):
            if parameters is not None and key in parameters:
                is_visible = float(parameters[key]) > MIN_BLACK
                self._state.visible = _replaced(self._state.visible, is_stroke, is_visible)
        if parameters is not None and "/LW" in parameters:
            self._state.line_width = float(parameters.LW)
        if parameters is not None and "/Font" in parameters:
            self._state.font, self._state.font_size = (
                parameters.Font[0],
                float(parameters.Font[1]),
            )

    def _is_hidden(self, tag: Any, properties: Any) -> bool:
        if str(tag) != "/OC":
            return False
        return self._finder.is_hidden(self._resource("/Properties", properties))

    # ---- position

    def _extend_path(self, operator: str, operands: Any) -> None:
        if self._area is None or not any(self._state.black):
            return
        values = [float(value) for value in operands]
        if operator == "re":
            values[2:] = values[0] + values[2], values[1] + values[3]
        self._path += zip(values[::2], values[1::2], strict=True)

    def _is_path_outside(self, is_stroked: bool) -> bool:
        if self._area is None or not self._path:
            return False
        x, y = zip(*self._path, strict=True)
        extent = MITER_FACTOR * abs(self._state.line_width) if is_stroked else 0.0
        box = Rectangle(min(x) - extent, min(y) - extent, max(x) + extent, max(y) + extent)
        return _is_outside(box, self._state.matrix, self._area)

    def _move_text(self, operator: str, operands: Any) -> None:
        if operator == "BT":
            self._line = Matrix()
        elif operator == "Tm":
            self._line = _matrix(operands)
        elif operator in ("Td", "TD") and self._line is not None:
            self._line = Matrix().translated(float(operands[0]), float(operands[1])) @ self._line
        else:  # to the next line, at a distance that is not followed
            self._line = None

    def _is_text_outside(self) -> bool:
        font = self._state.font
        if self._line is None or font is None or font.get("/Subtype") == "/Type3":
            return False
        encoding = font.get("/Encoding")
        if str(encoding).endswith("V") or isinstance(encoding, Stream):
            return False  # possibly vertical
        height = TEXT_HEIGHT_EM * abs(self._state.font_size)
        line = Rectangle(-HALF_LINE_LENGTH, -height, HALF_LINE_LENGTH, height)
        return _is_outside(line, self._line @ self._state.matrix, self._area)

    # ---- resources

    def _resource(self, kind: str, name: Any) -> Any:
        return self._resources.get(kind, Dictionary()).get(str(name))

    def _read_space(self, name: Any) -> ColourSpace | None:
        """Return a colour space; that of its colours for a pattern space."""
        spaces = self._resources.get("/ColorSpace")
        definition = None if spaces is None else spaces.get(str(name))
        if isinstance(definition, Array) and len(definition) > 1 and definition[0] == "/Pattern":
            return colours.read_colour_space(definition[1], spaces)
        return colours.read_colour_space(name, spaces)

    def _is_black_colour(self, is_stroke: bool, operands: Any) -> bool:
        space = self._state.spaces[is_stroke]
        values = [float(value) for value in operands if not isinstance(value, Name)]
        is_black = (
            space is not None and len(values) == space.components and _is_black(space, [values])
        )
        if len(operands) and isinstance(operands[-1], Name):
            item = self._resource("/Pattern", operands[-1])
            return item is not None and self._finder.is_black_pattern(
                item, self._resources, is_black
            )
        return is_black


def _is_black(space: ColourSpace, values: Any) -> bool:
    return bool((space.black(np.asarray(values, float)) > MIN_BLACK).any())


def _replaced(pair: tuple[Any, Any], index: int, value: Any) -> tuple[Any, Any]:
    """Return a pair with another value at an index."""
    return (pair[0], value) if index else (value, pair[1])


def _matrix(operands: Any) -> Matrix:
    return Matrix(*(float(value) for value in operands))


def _is_outside(box: Rectangle, matrix: Matrix, area: Rectangle | None) -> bool:
    """Return True if a box, in the units before the matrix, does not touch an area."""
    if area is None:
        return False
    drawn = matrix.transform(box)
    return (
        drawn.urx < area.llx or drawn.llx > area.urx or drawn.ury < area.lly or drawn.lly > area.ury
    )


def _hidden_layers(pdf: Pdf) -> Iterator[tuple[int, int]]:
    """Yield the object numbers of the layers that are not printed."""
    properties = pdf.Root.get("/OCProperties")
    if properties is None:
        return
    default = properties.D
    is_off = str(default.get("/BaseState", "/ON")) == "/OFF"
    hidden = {group.objgen for group in (properties.OCGs if is_off else ())}
    hidden -= {group.objgen for group in default.get("/ON", ())} if is_off else set()
    hidden |= {group.objgen for group in default.get("/OFF", ())}
    for usage in default.get("/AS", ()):
        if str(usage.get("/Event")) == "/Print":  # the state of these differs for printing
            hidden -= {group.objgen for group in usage.get("/OCGs", ())}
    yield from hidden


def _is_black_image(image: Stream, named: Any) -> bool:
    """Return True if a pixel of an image is black; also if the image cannot be decoded."""
    if int(image.Width) * int(image.Height) > MAX_IMAGE_PIXELS:
        return True
    try:
        space = colours.read_colour_space(image.get("/ColorSpace"), named)
        # PdfImage makes RGB of masked CMYK, in which a mix of the other three inks looks black.
        is_masked_cmyk = space == colours.CMYK and ("/SMask" in image or "/Mask" in image)
        if space is not None and (
            is_masked_cmyk or space.kind in ("tint", "inks") or not space.is_convertible
        ):
            # PdfImage does not read the others.
            return any(_is_black(space, values) for values in read_values(image, space))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # loss of bits
            picture = PdfImage(image).as_pil_image()
        is_cmyk = picture.mode == "CMYK"
        pixels = np.asarray(picture if is_cmyk else picture.convert("RGBA"))
    except Exception:  # decoders raise their own kinds
        return True
    space = colours.CMYK if is_cmyk else colours.RGB
    # Without the pixels that are almost transparent, which are black in many images.
    is_visible = pixels[..., 3] > 255 * MIN_BLACK
    samples = pixels.reshape(-1, 4) if is_cmyk else pixels[is_visible][:, :3]
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
    domain: Any = (0.0, 1.0)
    if "/Domain" in shaded:
        domain = numbers(shaded.Domain)
    elif int(shaded.ShadingType) > MAX_DOMAIN_TYPE and isinstance(function, Dictionary | Stream):
        domain = numbers(function.Domain)
    along = np.linspace(domain[0], domain[1], SHADING_STEPS)
    return transform is None or _is_black(space, transform(along))
