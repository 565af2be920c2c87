"""Dots over the pages of a document.

:func:`overlay` lays page after page of one PDF over another at true size and place, and
returns an :class:`Overlaid`: the bytes, and what could not be freed of black.
"""

from __future__ import annotations

import copy
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pikepdf
from pikepdf import Array, Dictionary, Name, Pdf, Stream

from locatk.core.dots.sheet import MM_PER_INCH
from locatk.core.errors import FormatError, InputError
from locatk.formats.files import read_bytes
from locatk.formats.printing.separation.document import BROKEN, Stripper

MM_PER_POINT = MM_PER_INCH / 72

TOLERANCE_MM = 0.1
"""By how much a stamp may differ in size from the page that it goes on."""

PRINTS, HIDDEN = 4, 2
"""Flags of annotations (ISO 32000-1 table 165)."""


@dataclass(frozen=True)
class Overlaid:
    """What :func:`overlay` made.

    Attributes
    ----------
    data : bytes
        The PDF.
    pages : int
    left_black : dict of str to int
        Where the document keeps black although it was to go: what it is, in the plural
        ("shadings of a mesh in CMYK"), and how many. Empty: only the stamp is black.
    dropped : int
        Comments that would print but that say not how they look; each viewer draws them
        in its own way, and they are gone.
    """

    data: bytes
    pages: int
    left_black: dict[str, int] = field(default_factory=dict)
    dropped: int = 0


@dataclass(frozen=True)
class _Frame:
    """What is seen of a page: its crop box in the page's units, from the lower left."""

    left: float
    bottom: float
    right: float
    top: float
    rotation: int
    unit: float

    @classmethod
    def of(cls, page: pikepdf.Object) -> _Frame:
        media = _box(page.MediaBox)
        crop = _box(page.get("/CropBox", page.MediaBox))
        left, bottom = max(media[0], crop[0]), max(media[1], crop[1])
        right, top = min(media[2], crop[2]), min(media[3], crop[3])
        rotation = int(page.get("/Rotate", 0)) % 360
        unit = float(page.get("/UserUnit", 1))
        if right <= left or top <= bottom or unit <= 0 or rotation % 90:
            raise ValueError("a page of no size")
        return cls(left, bottom, right, top, rotation, unit)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height as displayed."""
        width, height = (self.right - self.left), (self.top - self.bottom)
        if self.rotation % 180:
            width, height = height, width
        return width * self.unit * MM_PER_POINT, height * self.unit * MM_PER_POINT

    def onto(self, stamp: _Frame) -> str:
        """Matrix (for ``cm``) that lays what is seen upright over ``stamp``."""
        x, y = {
            0: (self.left, self.bottom),
            90: (self.right, self.bottom),
            180: (self.right, self.top),
            270: (self.left, self.top),
        }[self.rotation]
        cos = {0: 1, 90: 0, 180: -1, 270: 0}[self.rotation]
        sin = {0: 0, 90: 1, 180: 0, 270: -1}[self.rotation]
        scale = self.unit / stamp.unit
        a, b, c, d = scale * cos, -scale * sin, scale * sin, scale * cos
        e, f = stamp.left - a * x - c * y, stamp.bottom - b * x - d * y
        return " ".join(str(_plain(value)) for value in (a, b, c, d, e, f))


def page_sizes(path: str | os.PathLike[str]) -> list[tuple[float, float]]:
    """Width and height of each page in mm, as a viewer shows it and a printer prints it.

    That is its crop box, in its unit, turned by its rotation.

    Raises
    ------
    MissingDataError
        There is no such file.
    FormatError
        It is no PDF, is damaged, is encrypted or has no page.
    """
    with _opened(path) as pdf:
        return [_Frame.of(page.obj).size_mm for page in pdf.pages]


def overlay(
    document: str | os.PathLike[str],
    stamp: bytes,
    *,
    strip_black: bool,
    progress: Callable[[int, int], None] | None = None,
) -> Overlaid:
    """Lay page i of ``stamp`` over page i of a document.

    Nothing is scaled; the lower left corner of the stamp lies on that of the page as it is
    shown. The stamp's fonts are stored once, its inks and its overprint are kept, and
    nothing of the document covers it: comments and filled-in forms become part of the page
    below, as they would print.

    Parameters
    ----------
    document : path
        The PDF below.
    stamp : bytes
        A PDF of as many pages, each of the size that :func:`page_sizes` tells, not
        rotated.
    strip_black : bool
        Make all that is black or grey in the document of cyan, magenta and yellow.
    progress : callable, optional
        Called with the number of pages that are done and the number of all.

    Returns
    -------
    Overlaid
        The same input gives the same bytes.

    Raises
    ------
    MissingDataError, FormatError
        As :func:`page_sizes`.
    InputError
        The stamp has another number of pages, or one of another size.
    """
    with _opened(document) as pdf, Pdf.open(io.BytesIO(stamp)) as stamps:
        if len(stamps.pages) != len(pdf.pages):
            raise InputError(
                f"{len(stamps.pages)} pages to lay over {len(pdf.pages)}", file=document
            )
        dropped = _flatten(pdf)
        stripper = Stripper(pdf) if strip_black else None
        for number, page in enumerate(pdf.pages, 1):
            try:
                _lay(pdf, page, stamps, stamps.pages[number - 1], stripper)
            except InputError as error:
                raise InputError(error.message, file=document, where=f"page {number}") from None
            if progress is not None:
                progress(number, len(pdf.pages))
        if "/ViewerPreferences" not in pdf.Root:
            pdf.Root.ViewerPreferences = Dictionary()
        pdf.Root.ViewerPreferences.PrintScaling = Name("/None")
        target = io.BytesIO()
        pdf.save(
            target,
            min_version=max(stamps.pdf_version, "1.4"),
            object_stream_mode=pikepdf.ObjectStreamMode.generate,
            deterministic_id=True,
        )
        left = {} if stripper is None else dict(sorted(stripper.left.items()))
        return Overlaid(target.getvalue(), len(pdf.pages), left, dropped)


def _lay(
    pdf: Pdf, page: pikepdf.Page, stamps: Pdf, stamp: pikepdf.Page, stripper: Stripper | None
) -> None:
    frame, its = _Frame.of(page.obj), _Frame.of(stamp.obj)
    if its.rotation:
        raise InputError("a stamp that is rotated")
    if any(abs(a - b) > TOLERANCE_MM for a, b in zip(frame.size_mm, its.size_mm, strict=True)):
        sizes = (*its.size_mm, *frame.size_mm)
        raise InputError("a stamp of {:.2f} x {:.2f} mm on {:.2f} x {:.2f} mm".format(*sizes))
    below = _as_form(pdf, page.obj)
    if stripper is not None:
        below = stripper.form(below, starts=True)
    above = pdf.copy_foreign(_as_form(stamps, stamp.obj))
    # The page becomes the stamp's, whose size is a whole number of the printer's pixels, and
    # the document a form below: neither's state, blending or profiles reach the other.
    for key in list(page.obj.keys()):
        if key not in ("/Type", "/Parent"):
            del page.obj[key]
    page.obj.MediaBox = Array([_plain(value) for value in _box(stamp.obj.MediaBox)])
    if "/TrimBox" in stamp.obj:
        page.obj.TrimBox = Array([_plain(value) for value in _box(stamp.obj.TrimBox)])
    if its.unit != 1:
        page.obj.UserUnit = _plain(its.unit)
    page.obj.Resources = Dictionary(XObject=Dictionary(Below=below, Dots=above))
    page.obj.Contents = pdf.make_stream(f"q {frame.onto(its)} cm /Below Do Q /Dots Do".encode())


def _as_form(pdf: Pdf, page: pikepdf.Object) -> Stream:
    """What a page draws, as a form in the page's own coordinates."""
    contents = page.get("/Contents")
    if isinstance(contents, Stream):
        made = copy.copy(contents)  # its bytes stay packed as they are
    else:
        parts = [] if contents is None else [item.read_bytes() for item in contents]
        made = pdf.make_stream(b"\n".join(parts))
    made.Type, made.Subtype = Name.XObject, Name.Form
    made.BBox = Array([_plain(value) for value in _box(page.MediaBox)])
    made.Resources = page.get("/Resources", Dictionary())
    if "/Group" in page:
        made.Group = page.Group
    return pdf.make_indirect(made)


def _flatten(pdf: Pdf) -> int:
    """Draw what is annotated into the pages; the number of what cannot be drawn."""
    if "/AcroForm" in pdf.Root and pdf.Root.AcroForm.get("/NeedAppearances", False):
        pdf.generate_appearance_streams()
    dropped = 0
    for page in pdf.pages:
        for note in page.obj.get("/Annots", ()):
            flags = int(note.get("/F", 0))
            drawn = "/AP" in note or str(note.get("/Subtype")) in ("/Link", "/Popup", "/Widget")
            dropped += bool(flags & PRINTS) and not flags & HIDDEN and not drawn
        if "/Annots" in page.obj:
            # As a form, the page cannot leave a state behind that displaces the notes.
            below = _as_form(pdf, page.obj)
            if "/Group" in below:
                del below.Group
            page.obj.Resources = Dictionary(XObject=Dictionary(Below=below))
            page.obj.Contents = pdf.make_stream(b"/Below Do")
    pdf.flatten_annotations("print")
    if "/AcroForm" in pdf.Root:
        del pdf.Root.AcroForm
    return dropped


def _box(found: Any) -> tuple[float, float, float, float]:
    """Left, bottom, right, top of a rectangle, which any two corners may give."""
    a, b, c, d = (float(value) for value in found)
    return min(a, c), min(b, d), max(a, c), max(b, d)


def _plain(value: float) -> float | int:
    return int(value) if value == int(value) else round(value, 6)


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[Pdf]:
    """A document that can be read whole; what goes wrong with it later is damage, too."""
    if b"%PDF-" not in read_bytes(path, 1024):
        raise FormatError("not a PDF", file=path)
    try:
        # Without repairing, which may lose pages and not say so.
        with Pdf.open(os.fspath(path), attempt_recovery=False) as pdf:
            if pdf.is_encrypted:
                raise _encrypted(path)
            if len(pdf.pages) == 0:
                raise FormatError("a PDF without pages", file=path)
            yield pdf
    except pikepdf.PasswordError:
        raise _encrypted(path) from None
    except InputError:
        raise
    except BROKEN as error:
        raise FormatError(
            f"a damaged PDF ({_first_line(error)})",
            file=path,
            hint="print it into a new PDF from a viewer, look whether all is there, and use that",
        ) from error


def _encrypted(path: str | os.PathLike[str]) -> FormatError:
    return FormatError(
        "an encrypted PDF",
        file=path,
        hint="save it without password and restrictions, as with `qpdf --decrypt IN.pdf OUT.pdf`",
    )


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
