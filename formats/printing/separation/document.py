"""A document without black ink, so that dots printed over it are the only black there is.

Cameras for dots look in the infrared, where black ink (carbon) is dark and the other three
inks are clear: black text under the dots hides them, text of cyan, magenta and yellow does
not (HP's patent US 7903281 is about just this). So
black becomes a mix of the other three, everywhere where the document names a colour.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pikepdf
from pikepdf import Array, Dictionary, Name, Pdf, PdfInlineImage, Stream

from locatk.formats.printing.separation import colours
from locatk.formats.printing.separation import images as pictures
from locatk.formats.printing.separation.colours import Space
from locatk.formats.printing.separation.images import Left
from locatk.formats.printing.separation.operators import rewrite

BROKEN = (
    pikepdf.PdfError,
    pikepdf.DataDecodingError,
    pikepdf.models.PdfParsingError,
    *(ValueError, TypeError, KeyError, IndexError, AttributeError),
)
"""What reading a damaged object raises."""

BLACK = b"1 1 1 0 k 1 1 1 0 K\n"
"""What a page starts with, instead of black."""


@dataclass(frozen=True)
class Scope:
    """Resources as they were, in which names are looked up, and as they become."""

    was: pikepdf.Object
    made: pikepdf.Object


class Stripper:
    """Makes content of one document without black.

    Nothing is changed in place, as the same object may also serve where black is not ink
    (soft masks); the new objects share what is the same. What cannot be converted stays as
    it is and is counted.

    Attributes
    ----------
    left : Counter of str
        What still prints black, and how often it occurs.
    """

    def __init__(self, pdf: Pdf) -> None:
        self.left: Counter[str] = Counter()
        self._pdf = pdf
        self._inks = pictures.inks_space(pdf)
        self._made: dict[tuple[str, tuple[int, int]], Any] = {}

    def form(self, stream: Stream, outer: Scope | None = None, *, starts: bool) -> Stream:
        """A form or tiling pattern without black, as a new stream.

        Parameters
        ----------
        stream : Stream
        outer : Scope, optional
            Resources of what paints it, for forms that have none of their own.
        starts : bool
            Nobody has set a colour before it, so it starts with black.

        Raises
        ------
        PdfError
            Its content cannot be parsed.
        """

        def fill(made: Stream) -> None:
            own = stream.get("/Resources")
            scope = outer if own is None and outer else self._scope(own or Dictionary())
            made.Resources = scope.made
            if "/Group" in stream and "/CS" in stream.Group:
                # Blending in RGB turns all into RGB, and the printer that into black.
                made.Group = copy.copy(stream.Group)
                made.Group.CS = Name.DeviceCMYK
            data = self._content(stream, scope, starts)
            made.write(BLACK + data if starts else data)

        made: Stream = self._once("form", stream, fill)
        return made

    def _once(self, role: str, found: Any, fill: Callable[[Any], None]) -> Any:
        """A copy of ``found`` that ``fill`` has filled; the same one each time."""
        key = (role, found.objgen)
        if found.is_indirect and key in self._made:
            return self._made[key]
        made = self._pdf.make_indirect(copy.copy(found))
        if found.is_indirect:
            self._made[key] = made  # before it is filled: it may hold itself
        fill(made)
        return made

    def _try(self, what: str, found: Any, convert: Callable[[], Any]) -> Any:
        """What ``convert`` makes of ``found``; ``found`` itself, counted, where it cannot."""
        key = (what, found.objgen)
        if found.is_indirect and key in self._made:
            return self._made[key]
        try:
            made = convert()
        except Left as reason:
            self.left[str(reason)] += 1
            made = found
        except BROKEN:
            self.left[f"{what} that are damaged"] += 1
            made = found
        if found.is_indirect:
            made = self._pdf.make_indirect(made)
            self._made[key] = made
        return made

    def _scope(self, found: pikepdf.Object) -> Scope:
        def fill(made: pikepdf.Object) -> None:
            scope = Scope(found, made)
            jobs = {
                "/Shading": self._shading,
                "/Pattern": self._pattern,
                "/XObject": self._xobject,
                "/Font": self._font,
            }
            # All of them first, as content may add to what is not converted yet.
            for key in jobs:
                made[key] = copy.copy(found.get(key, Dictionary()))
            for key, convert in jobs.items():
                for name, item in found.get(key, Dictionary()).items():
                    if isinstance(item, Dictionary | Stream):
                        made[key][name] = convert(item, scope)
            spaces = found.get("/ColorSpace")
            if spaces is not None:
                kept = {name: self._kept_space(item, spaces) for name, item in spaces.items()}
                made.ColorSpace = Dictionary({k: v for k, v in kept.items() if v is not None})

        return Scope(found, self._once("resources", found, fill))

    def _xobject(self, item: Any, scope: Scope) -> Any:
        kind = str(item.get("/Subtype"))
        if kind == "/Form":
            return self._try("forms", item, lambda: self.form(item, scope, starts=False))
        if kind == "/Image":
            spaces = scope.was.get("/ColorSpace")
            convert = lambda: pictures.picture(self._pdf, item, spaces, self._inks)  # noqa: E731
            return self._try("images", item, convert)
        return item

    def _shading(self, item: Any, scope: Scope) -> Any:
        spaces = scope.was.get("/ColorSpace")
        convert = lambda: pictures.shading(self._pdf, item, spaces, self._inks)  # noqa: E731
        return self._try("shadings", item, convert)

    def _pattern(self, item: Any, scope: Scope) -> Any:
        if int(item.get("/PatternType", 0)) == 1:
            if int(item.get("/PaintType", 1)) != 1:
                return item  # a stencil, in the colour that comes with its name
            return self._try("patterns", item, lambda: self.form(item, scope, starts=True))

        def fill(made: pikepdf.Object) -> None:
            made.Shading = self._shading(item.Shading, scope)

        return self._once("pattern", item, fill) if "/Shading" in item else item

    def _font(self, item: Any, scope: Scope) -> Any:
        if str(item.get("/Subtype")) != "/Type3":
            return item

        def fill(made: pikepdf.Object) -> None:
            own = self._scope(item.Resources) if "/Resources" in item else scope
            made.Resources = own.made
            made.CharProcs = Dictionary(
                {name: self._glyph(glyph, own) for name, glyph in item.CharProcs.items()}
            )

        return self._try("fonts", item, lambda: self._once("font", item, fill))

    def _glyph(self, glyph: Any, scope: Scope) -> Any:
        if b"d1" in glyph.read_bytes()[:200]:
            return glyph  # a stencil: its own colours do not count
        return self._once(
            "glyph", glyph, lambda made: made.write(self._content(glyph, scope, False))
        )

    def _content(self, stream: Stream, scope: Scope, starts: bool) -> bytes:
        spaces = scope.was.get("/ColorSpace")

        def look_up(name: pikepdf.Object) -> Space | pikepdf.Object | None:
            """A space, the array of a pattern's, or None for what cannot be converted."""
            found = None if spaces is None else spaces.get(str(name))
            if str(name) == "/Pattern":
                return Array([name])
            if isinstance(found, Array) and len(found) and str(found[0]) == "/Pattern":
                return found
            return self._space(name, spaces)

        return rewrite(
            stream,
            look_up,
            lambda found: self._space(found, spaces),
            lambda image: self._name_inline(image, scope),
            self.left,
            starts=starts,
        )

    def _name_inline(self, image: PdfInlineImage, scope: Scope) -> Name:
        """The name of an image that stood in the content itself, and is none any more."""
        stream = self._pdf.make_stream(b"")
        for key, value in image.obj.items():
            stream[key] = value
        _, _, data = image.unparse().partition(b"\nID\n")
        filters: Any = image.obj.get("/Filter")
        parameters: Any = image.obj.get("/DecodeParms")
        data = data.removesuffix(b"EI")
        stream.write(data, filter=filters, decode_parms=parameters, type_check=False)
        held = scope.made.XObject
        number = len(held)
        while (name := f"/Inline{number}") in held:
            number += 1
        stream.Subtype = Name.Image
        held[name] = self._xobject(stream, scope)
        return Name(name)

    def _space(self, found: pikepdf.Object, spaces: pikepdf.Object | None) -> Space | None:
        try:
            return colours.space(found, spaces)
        except BROKEN:
            return None

    def _kept_space(self, found: pikepdf.Object, spaces: pikepdf.Object) -> Any:
        """What the name of a colour space has to stand for in the end, None for nothing."""
        if isinstance(found, Array) and len(found) > 1 and str(found[0]) == "/Pattern":
            if self._space(found[1], spaces) is not None:
                return Array([Name.Pattern, Name.DeviceCMYK])
            return found
        return found if self._space(found, spaces) is None else None
